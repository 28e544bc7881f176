"""Settings of the front ends. Lengths that should follow the image size are given as fractions of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

from vio.setting import Section, setting


@dataclass(frozen=True, slots=True)
class GridSettings(Section):
    """How many features every front end that looks at images keeps, and how evenly they lie."""

    section: ClassVar[str] = "frontend.grid"

    target_features: int = setting(400, "features to keep alive; new ones are added below this number", at_least=1)
    cell_features: int = setting(4, "features wanted in one grid cell; the cell size follows from it", at_least=1)
    min_distance: float = setting(
        0.15, "least distance between features, over the spacing of a uniform grid of them", at_least=0, at_most=1
    )


@dataclass(frozen=True, slots=True)
class DisparitySettings(Section):
    """Which disparities a stereo match may have."""

    section: ClassVar[str] = "frontend.disparity"

    max_disparity: float = setting(0.16, "largest disparity, over the image width", above=0, at_most=1)
    min_disparity_px: float = setting(0.3, "smallest disparity of a stereo match", unit="px", at_least=0)


@dataclass(frozen=True, slots=True)
class ConsensusSettings(Section):
    """The vote on the camera's motion; how far a feature may lie from it is each front end's `consensus_px`."""

    section: ClassVar[str] = "frontend.consensus"

    samples: int = setting(96, "random minimal sets tried for the consensus motion", at_least=1)
    sure_share: float = setting(
        0.7,
        "share of features that must follow the expected motion, refined, for no samples to be tried",
        at_least=0,
        at_most=1,
    )
    prior_max_deviation_deg: float = setting(
        1.0, "a consensus that turns away from the predicted rotation by more is distrusted", unit="deg", at_least=0
    )
    prior_min_support: float = setting(
        0.4,
        "points that follow the predicted motion only, over the consensus' inliers, for it to replace the consensus",
        at_least=0,
    )
    seed: int = setting(0, "seed of the sampling; equal seeds give equal bits", at_least=0)


@dataclass(frozen=True, slots=True)
class KltSettings(Section):
    """Corners tracked by pyramidal Lucas-Kanade; one set of defaults serves 640x360 to 1242x375."""

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
        "where corners are few, weaker ones are taken, down to this many times the gradient of the image's noise",
        at_least=0,
    )
    spare_corners: float = setting(
        1.5, "corners tried beyond the missing ones, over their number; the best in stereo are kept", at_least=0
    )
    mask: Path | None = setting(None, "image of the recording's size; where it is black no corner is taken")
    equalise: Literal["none", "clahe"] = setting("none", "local contrast equalisation before everything else")
    window_px: int = setting(
        11, "side of the tracking window, in pixels of the half-resolution image", unit="px", at_least=3
    )
    pyramid_levels: int = setting(
        2, "image levels coarser than half resolution when tracking in time", at_least=0, at_most=8
    )
    trusted_levels: int = setting(
        1, "the same where the last motion or the filter predicts the pixels", at_least=0, at_most=8
    )
    iterations: int = setting(20, "largest number of Lucas-Kanade iterations a level", at_least=1)
    max_forward_backward_px: float = setting(1.5, "largest error after tracking there and back", unit="px", above=0)
    consensus_px: float = setting(
        1.0, "largest distance from where the consensus motion puts a feature", unit="px", above=0
    )
    anchor_radius_px: int = setting(
        7, "half side of the patch that a feature is aligned with for life", unit="px", at_least=2
    )
    min_anchor_correlation: float = setting(
        0.8, "smallest normalised correlation with that patch; below, it is renewed", at_least=-1, at_most=1
    )
    max_anchor_scale: float = setting(1.25, "change of scale at which that patch is renewed", at_least=1)
    max_epipolar_px: float = setting(1.0, "largest difference of the rows of a stereo match", unit="px", above=0)
    min_correlation: float = setting(0.8, "smallest normalised correlation of a stereo match", at_least=-1, at_most=1)
    min_peak_margin: float = setting(
        0.03, "least lead in correlation over the second-best place in the row", at_least=0
    )
    circle_check: bool = setting(
        False, "track the right pixels in time as well; a right match that they do not lead to is dropped"
    )
    max_circle_px: float = setting(2.0, "largest distance between the two, for the circle check", unit="px", above=0)
    probation_frames: int = setting(
        1, "frames for which a new corner must hold, in time and stereo, before it is shown", at_least=0
    )
    wanted_life_frames: int = setting(7, "frames for which a new corner should stay in the image", at_least=0)
    least_features: float = setting(
        0.7,
        "share of the features to keep alive, below which corners that leave sooner are taken too",
        at_least=0,
        at_most=1,
    )
    max_blind_frames: int = setting(
        5, "frames without contrast that are passed over before all tracks are given up; 0: none", at_least=0
    )
    max_left_only_frames: int = setting(10, "frames that a feature may go on without a right match", at_least=0)


@dataclass(frozen=True, slots=True)
class MatchSettings(Section):
    """Key points matched by descriptor; for the front ends orb, sift and kornia."""

    section: ClassVar[str] = "frontend.match"

    max_keypoints: int = setting(1200, "key points extracted from each image", at_least=1)
    ratio: float = setting(0.8, "largest distance of descriptors, over that of the second-nearest", above=0, at_most=1)
    search_radius: float = setting(
        0.06, "half side of the search about the predicted pixel, over the image width", above=0, at_most=1
    )
    max_epipolar_px: float = setting(1.5, "largest difference of the rows of a stereo match", unit="px", above=0)
    refine: Literal["none", "align"] = setting(
        "align", "align the patches of matched key points to a fraction of a pixel"
    )
    consensus_px: float = setting(
        1.5, "largest distance from where the consensus motion puts a feature", unit="px", above=0
    )


@dataclass(frozen=True, slots=True)
class LearnedSettings(Section):
    """The front end `kornia`: detector and descriptor run by torch."""

    section: ClassVar[str] = "frontend.learned"

    detector: Literal["gftt", "harris", "keynet", "aliked", "disk", "xfeat"] = setting(
        "gftt", "what finds and, for aliked, disk and xfeat, also describes; gftt and harris need no weights"
    )
    descriptor: Literal["sift", "mkd", "hardnet", "hynet", "sosnet"] = setting(
        "sift", "what describes the patches of gftt, harris and keynet; sift needs no weights"
    )
    detector_weights: Path | None = setting(None, "weights of keynet, aliked, disk or xfeat")
    descriptor_weights: Path | None = setting(None, "weights of mkd, hardnet, hynet or sosnet")
    affine_weights: Path | None = setting(None, "weights of AffNet, for affine patches; None: upright square patches")
    orientation_weights: Path | None = setting(None, "weights of OriNet, for turned patches; None: upright")
    matcher: Literal["nearest", "lightglue"] = setting("nearest", "mutual nearest with ratio, or LightGlue")
    matcher_weights: Path | None = setting(None, "weights of LightGlue for the descriptor in use")
    aliked_model: Literal["aliked-t16", "aliked-n16", "aliked-n16rot", "aliked-n32"] = setting(
        "aliked-t16", "the size of ALIKED that the weights are of"
    )
    device: Literal["cpu", "cuda"] = setting("cpu", "where torch computes; half precision on cuda")


@dataclass(frozen=True, slots=True)
class FrontendSettings(Section):
    """Which front end runs, and its settings."""

    section: ClassVar[str] = "frontend"

    name: Literal["auto", "klt", "orb", "sift", "kornia", "precomputed"] = setting(
        "auto", "auto: klt where the recording has images, precomputed where it has features only"
    )
    features: Path | None = setting(
        None, "observation log or feature file to take in place of the recording's own, for the precomputed front end"
    )
    prior: bool = setting(True, "let the filter tell the front end where it expects the features")
    grid: GridSettings = field(default_factory=GridSettings)
    disparity: DisparitySettings = field(default_factory=DisparitySettings)
    consensus: ConsensusSettings = field(default_factory=ConsensusSettings)
    klt: KltSettings = field(default_factory=KltSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    learned: LearnedSettings = field(default_factory=LearnedSettings)
