"""Settings of the front ends.

Lengths that scale with the image size are given as fractions of it.
"""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import ClassVar, Literal

from vio.dataclass import dataclass
from vio.setting import Section, setting


@dataclass(frozen=True, slots=True)
class GridSettings(Section):
    """Number of the features of every image-based front end."""

    section: ClassVar[str] = "frontend.grid"

    target_features: int = setting(
        400, "number of features to track; new ones are added below it", at_least=1, at_most=5000
    )


@dataclass(frozen=True, slots=True)
class DisparitySettings(Section):
    """Largest disparity of a stereo match."""

    section: ClassVar[str] = "frontend.disparity"

    max_disparity: float = setting(
        0.16,
        "largest disparity, over the image width; up to 0.64 where the scene is nearer",
        above=0,
        at_most=1,
    )


@dataclass(frozen=True, slots=True)
class ConsensusSettings(Section):
    """RANSAC on the camera motion."""

    section: ClassVar[str] = "frontend.consensus"

    seed: int = setting(
        0, "seed of the sampling; equal seeds give identical results", at_least=0, at_most=2**32 - 1
    )


@dataclass(frozen=True, slots=True)
class KltSettings(Section):
    """The images, for `orb`, `sift` and `kornia` too, and the pyramid of Lucas-Kanade; the defaults
    suit images from 640x360 to 1242x375.
    """

    section: ClassVar[str] = "frontend.klt"

    mask: Path | None = setting(
        None, "image of the recording's size; black pixels are excluded from corner detection"
    )
    equalise: Literal["none", "clahe"] = setting(
        "none", "local contrast equalisation of the input images"
    )
    pyramid_levels: int = setting(
        2, "image levels coarser than half resolution when tracking in time", at_least=0, at_most=8
    )


@dataclass(frozen=True, slots=True)
class MatchSettings(Section):
    """Key points matched by descriptor; for the front ends orb, sift and kornia."""

    section: ClassVar[str] = "frontend.match"

    max_keypoints: int = setting(
        1200, "key points extracted from each left image", at_least=1, at_most=20000
    )


@dataclass(frozen=True, slots=True)
class LearnedSettings(Section):
    """The front end `kornia`: detector and descriptor in torch."""

    section: ClassVar[str] = "frontend.learned"

    detector: Literal["gftt", "harris", "keynet", "aliked", "disk", "xfeat"] = setting(
        "gftt",
        "detector; aliked, disk and xfeat are also the descriptor; gftt and harris need no weights",
    )
    descriptor: Literal["sift", "mkd", "hardnet", "hynet", "sosnet"] = setting(
        "sift", "descriptor of the patches of gftt, harris and keynet; sift needs no weights"
    )
    detector_weights: Path | None = setting(None, "weights of keynet, aliked, disk or xfeat")
    descriptor_weights: Path | None = setting(None, "weights of mkd, hardnet, hynet or sosnet")
    affine_weights: Path | None = setting(
        None, "weights of AffNet, for affine patches; None: upright square patches"
    )
    orientation_weights: Path | None = setting(
        None, "weights of OriNet, for oriented patches; None: upright"
    )
    matcher: Literal["nearest", "lightglue"] = setting(
        "nearest", "mutual nearest neighbours with ratio test, or LightGlue"
    )
    matcher_weights: Path | None = setting(None, "weights of LightGlue for the descriptor in use")
    aliked_model: Literal["aliked-t16", "aliked-n16", "aliked-n16rot", "aliked-n32"] = setting(
        "aliked-t16", "ALIKED model of the weights"
    )
    device: Literal["cpu", "cuda"] = setting("cpu", "device of torch; half precision on cuda")


@dataclass(frozen=True, slots=True)
class FrontendSettings(Section):
    """Selection of the front end, and its settings."""

    section: ClassVar[str] = "frontend"

    name: Literal["auto", "klt", "orb", "sift", "kornia", "precomputed"] = setting(
        "auto", "auto: klt where the recording has images, precomputed where it has features only"
    )
    features: Path | None = setting(
        None,
        "observation log or feature file to use instead of the recording's own, for the "
        "precomputed front end",
    )
    prior: bool = setting(True, "give the front end the filter's prediction of the feature pixels")
    checks: bool = setting(
        True,
        "leave out images and features that contradict the camera; false: for comparisons",
    )
    readout_ms: float | None = setting(
        None,
        "rolling shutter: time from the exposure of the first row to that of the last, negative if "
        "the last row is first; null: the calibration's (Kalibr's line_delay), or what the run finds; "
        "0: none",
        unit="ms",
        at_least=-100,
        at_most=100,
    )
    grid: GridSettings = field(default_factory=GridSettings)
    disparity: DisparitySettings = field(default_factory=DisparitySettings)
    consensus: ConsensusSettings = field(default_factory=ConsensusSettings)
    klt: KltSettings = field(default_factory=KltSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    learned: LearnedSettings = field(default_factory=LearnedSettings)
