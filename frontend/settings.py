"""Settings of the front ends. Lengths that should follow the image size are given as fractions of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from vio.setting import setting


@dataclass(frozen=True, slots=True)
class KltSettings:
    """Corners tracked by pyramidal Lucas-Kanade; one set of defaults serves 640x360 to 1242x375."""

    target_features: int = setting(350, "features to keep alive; new corners are added below this number")
    cell_features: int = setting(4, "features wanted in one grid cell; the cell size follows from it")
    min_distance: float = setting(0.3, "least distance between features, over the spacing of a uniform grid of them")
    min_gradient: float = setting(
        1.8, "least gradient of a corner in its weakest direction, root mean square over 5x5 pixels", unit="gray/px"
    )
    spare_corners: float = setting(
        1.0, "corners tried beyond the missing ones, over their number; those with a right match are kept first"
    )
    equalise: Literal["none", "clahe"] = setting("none", "local contrast equalisation before everything else")
    window_px: int = setting(15, "side of the tracking window", unit="px")
    pyramid_levels: int = setting(3, "coarser image levels above the full one when tracking in time")
    iterations: int = setting(30, "largest number of Lucas-Kanade iterations a level")
    guess: Literal["previous", "velocity", "motion"] = setting(
        "motion",
        "start of the search where the filter predicts nothing: old pixel, pixel velocity, or last camera motion",
    )
    max_forward_backward_px: float = setting(0.5, "largest error after tracking there and back", unit="px")
    consensus_px: float = setting(1.0, "largest distance from where the consensus motion puts a feature", unit="px")
    consensus_samples: int = setting(96, "random minimal sets tried for the consensus motion")
    prior_max_deviation_deg: float = setting(
        1.0, "a consensus that turns away from the predicted rotation by more is distrusted", unit="deg"
    )
    prior_min_support: float = setting(
        0.4, "share of the consensus' inliers that the predicted motion needs to replace it"
    )
    anchor_radius_px: int = setting(6, "half side of the patch that a feature is aligned with for life", unit="px")
    min_anchor_correlation: float = setting(
        0.8, "smallest normalised correlation with that patch; below, it is renewed"
    )
    max_anchor_scale: float = setting(1.8, "change of scale at which that patch is renewed")
    max_disparity: float = setting(0.16, "largest disparity, over the image width")
    min_disparity_px: float = setting(0.3, "smallest disparity of a stereo match", unit="px")
    max_epipolar_px: float = setting(1.0, "largest difference of the rows of a stereo match", unit="px")
    stereo_radius_px: int = setting(6, "half side of the patch matched between left and right", unit="px")
    min_correlation: float = setting(0.8, "smallest normalised correlation of a stereo match")
    min_peak_margin: float = setting(0.03, "least lead in correlation over the second-best place in the row")
    max_left_only_frames: int = setting(10, "frames that a feature may go on without a right match")
    seed: int = setting(0, "seed of the consensus sampling; equal seeds give equal bits")


@dataclass(frozen=True, slots=True)
class FrontendSettings:
    """Which front end runs, and its settings."""

    name: Literal["auto", "klt", "precomputed"] = setting(
        "auto", "auto: klt where the recording has images, precomputed where it has features only"
    )
    features: Path | None = setting(
        None, "observation log or feature file to take in place of the recording's own, for the precomputed front end"
    )
    klt: KltSettings = field(default_factory=KltSettings, metadata={"doc": "corner tracking", "unit": ""})
