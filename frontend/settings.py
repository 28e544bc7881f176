"""Settings of the front ends. Lengths that scale with the image size are given as fractions of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

from vio.setting import Section, setting


@dataclass(frozen=True, slots=True)
class GridSettings(Section):
    """Number and distribution of the features of every image-based front end."""

    section: ClassVar[str] = "frontend.grid"

    target_features: int = setting(
        400, "number of features to track; new ones are added below it", at_least=1, at_most=5000
    )
    cell_features: int = setting(
        4, "target number of features per grid cell; determines the cell size", at_least=1, at_most=1000
    )
    min_distance: float = setting(
        0.15, "least distance between features, over the spacing of a uniform grid of them", at_least=0, at_most=1
    )


@dataclass(frozen=True, slots=True)
class DisparitySettings(Section):
    """Range of disparities of a stereo match."""

    section: ClassVar[str] = "frontend.disparity"

    max_disparity: float = setting(0.16, "largest disparity, over the image width", above=0, at_most=1)
    min_disparity_px: float = setting(0.3, "smallest disparity of a stereo match", unit="px", at_least=0)


@dataclass(frozen=True, slots=True)
class ConsensusSettings(Section):
    """RANSAC on the camera motion; the inlier threshold is each front end's `consensus_px`."""

    section: ClassVar[str] = "frontend.consensus"

    samples: int = setting(96, "random minimal sets of RANSAC", at_least=1, at_most=10000)
    sure_share: float = setting(
        0.7,
        "share of inliers of the refined expected motion above which RANSAC is skipped",
        at_least=0,
        at_most=1,
    )
    prior_max_deviation_deg: float = setting(
        1.0,
        "largest deviation of the consensus rotation from the prior, before a motion near the prior is tried",
        unit="deg",
        at_least=0,
    )
    prior_min_support: float = setting(
        0.4,
        "inliers of the prior motion only, over those of the consensus, above which it replaces the consensus",
        at_least=0,
    )
    seed: int = setting(0, "seed of the sampling; equal seeds give identical results", at_least=0, at_most=2**32 - 1)


@dataclass(frozen=True, slots=True)
class KltSettings(Section):
    """Corners tracked by pyramidal Lucas-Kanade; the defaults suit images from 640x360 to 1242x375."""

    section: ClassVar[str] = "frontend.klt"

    min_gradient: float = setting(
        1.0,
        "least gradient of a corner in its weakest direction, root mean square over 6x6 pixels",
        unit="gray/px",
        at_least=0,
    )
    min_relative_gradient: float = setting(
        0.15, "the same, over that of the strongest corner of its grid cell", at_least=0, at_most=1
    )
    min_gradient_over_noise: float = setting(
        5.0,
        "where corners are few, weaker ones are added, down to this many times the gradient of the image noise",
        at_least=0,
    )
    spare_corners: float = setting(
        1.5,
        "extra corners tried, over the number of missing features; the best stereo matches are kept",
        at_least=0,
        at_most=20,
    )
    mask: Path | None = setting(None, "image of the recording's size; black pixels are excluded from corner detection")
    equalise: Literal["none", "clahe"] = setting("none", "local contrast equalisation of the input images")
    window_px: int = setting(
        11, "side of the tracking window, in pixels of the half-resolution image", unit="px", at_least=3, at_most=101
    )
    pyramid_levels: int = setting(
        2, "image levels coarser than half resolution when tracking in time", at_least=0, at_most=8
    )
    trusted_levels: int = setting(
        1, "the same where the pixels are predicted by the last motion or the filter", at_least=0, at_most=8
    )
    iterations: int = setting(20, "largest number of Lucas-Kanade iterations per level", at_least=1, at_most=1000)
    max_forward_backward_px: float = setting(1.5, "largest forward-backward error", unit="px", above=0)
    consensus_px: float = setting(
        1.0, "inlier threshold on the reprojection error under the consensus motion", unit="px", above=0
    )
    anchor_radius_px: int = setting(
        7, "half side of the anchor patch that a feature is aligned with", unit="px", at_least=2, at_most=50
    )
    min_anchor_correlation: float = setting(
        0.8, "smallest normalised correlation with the anchor; below, the anchor is replaced", at_least=-1, at_most=1
    )
    max_anchor_scale: float = setting(1.25, "change of scale at which the anchor is replaced", at_least=1)
    max_epipolar_px: float = setting(1.0, "largest row difference of a stereo match", unit="px", above=0)
    min_correlation: float = setting(0.8, "smallest normalised correlation of a stereo match", at_least=-1, at_most=1)
    min_peak_margin: float = setting(
        0.03, "smallest lead in correlation over the second-best match in the row", at_least=0
    )
    probation_frames: int = setting(
        1,
        "frames for which a new corner must be tracked, in time and stereo, before it is output",
        at_least=0,
        at_most=1000,
    )
    wanted_life_frames: int = setting(
        7, "frames for which a new corner should stay in the image", at_least=0, at_most=1000
    )
    least_features: float = setting(
        0.7,
        "share of target_features below which corners that leave the image sooner are added, too",
        at_least=0,
        at_most=1,
    )
    max_blind_frames: int = setting(
        5, "frames without contrast that are skipped before all tracks are dropped; 0: none", at_least=0
    )
    max_left_only_frames: int = setting(
        10, "largest number of consecutive frames of a feature without a right match", at_least=0
    )


@dataclass(frozen=True, slots=True)
class MatchSettings(Section):
    """Key points matched by descriptor; for the front ends orb, sift and kornia."""

    section: ClassVar[str] = "frontend.match"

    max_keypoints: int = setting(1200, "key points extracted from each image", at_least=1, at_most=20000)
    ratio: float = setting(0.8, "largest distance of descriptors, over that of the second-nearest", above=0, at_most=1)
    search_radius: float = setting(
        0.06, "half side of the search window around the predicted pixel, over the image width", above=0, at_most=1
    )
    max_epipolar_px: float = setting(1.5, "largest row difference of a stereo match", unit="px", above=0)
    refine: Literal["none", "align"] = setting(
        "align", "align the patches of matched key points to a fraction of a pixel"
    )
    consensus_px: float = setting(
        1.5, "inlier threshold on the reprojection error under the consensus motion", unit="px", above=0
    )


@dataclass(frozen=True, slots=True)
class LearnedSettings(Section):
    """The front end `kornia`: detector and descriptor in torch."""

    section: ClassVar[str] = "frontend.learned"

    detector: Literal["gftt", "harris", "keynet", "aliked", "disk", "xfeat"] = setting(
        "gftt", "detector; aliked, disk and xfeat are also the descriptor; gftt and harris need no weights"
    )
    descriptor: Literal["sift", "mkd", "hardnet", "hynet", "sosnet"] = setting(
        "sift", "descriptor of the patches of gftt, harris and keynet; sift needs no weights"
    )
    detector_weights: Path | None = setting(None, "weights of keynet, aliked, disk or xfeat")
    descriptor_weights: Path | None = setting(None, "weights of mkd, hardnet, hynet or sosnet")
    affine_weights: Path | None = setting(None, "weights of AffNet, for affine patches; None: upright square patches")
    orientation_weights: Path | None = setting(None, "weights of OriNet, for oriented patches; None: upright")
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
        None, "observation log or feature file to use instead of the recording's own, for the precomputed front end"
    )
    prior: bool = setting(True, "give the front end the filter's prediction of the feature pixels")
    grid: GridSettings = field(default_factory=GridSettings)
    disparity: DisparitySettings = field(default_factory=DisparitySettings)
    consensus: ConsensusSettings = field(default_factory=ConsensusSettings)
    klt: KltSettings = field(default_factory=KltSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    learned: LearnedSettings = field(default_factory=LearnedSettings)
