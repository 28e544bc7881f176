"""Features followed by forward-backward Lucas-Kanade at half resolution, with brightness matching;
pixels are of the full image.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import cv2
import numpy as np

from vio.dataclass import dataclass
from vio.frontend.patches import ImageLevels, inside, mean_and_contrast
from vio.frontend.tracks import ANCHOR_REACH_PX, PreviousFrame, Tracks
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Capacity, Tolerance
from vio.records import BoolArray, Image


@dataclass(frozen=True, slots=True)
class _Flow:
    """How features are followed by Lucas-Kanade, and found again."""

    window_px: int = 11  # side of the window, of the half-resolution image
    lk_epsilon_px: Tolerance[float] = 0.02  # of the half-resolution image
    lk_min_eigenvalue: Tolerance[float] = 1e-4  # as OpenCV's own default
    # share of lost points above which tracking is repeated with all pyramid levels
    retry_share: float = 0.25
    lost_share: float = 0.5  # the same for the last attempt, which starts from the old pixels
    stride: Capacity[int] = 4  # brightness is computed from every fourth pixel of the half image
    min_contrast: float = 1.0  # gray levels, lower bound of the contrast in the gain
    max_contrast_change: float = 0.06  # relative change of contrast, and
    # change of the mean gray level, up to which images are not adjusted
    max_mean_change: float = 6.0
    max_gain: float = 4.0


_FLOW = _Flow()


class _TrackingRules(NamedTuple):
    """How flow is tracked and checked."""

    trusted_levels: int = 1  # pyramid levels above half resolution where the pixels are predicted
    iterations: Tolerance[int] = 20  # per level
    max_forward_backward_px: float = 1.5


_TRACKING = _TrackingRules()


class Flow(Protocol):
    """How the features of a frame are followed into the left image of the next one, and where new
    ones may be found.
    """

    def see(self, image: Image) -> bool:
        """Take the left image (H, W) of a frame, before features are followed into it or found;
        return whether that has cost a stage of its own.
        """

    def follow(
        self, previous: PreviousFrame, image: ImageLevels, guess: FloatArray, *, trusted: bool
    ) -> tuple[FloatArray, BoolArray]:
        """Return the pixels (N, 2) of the previous frame's features in the left image, and a mask
        (N,) of those found.

        Args:
            previous: the previous frame, N features.
            image: the current left image.
            guess: predicted pixels (N, 2) in it.
            trusted: whether the guess comes from a prior or from a motion with consensus.
        """

    def keep(self, tracks: Tracks) -> None:
        """Take the features after a frame, with new ones."""


class LucasKanade:
    """Follows features by forward-backward Lucas-Kanade."""

    def __init__(self, levels: int) -> None:
        """Prepare, with the pyramid levels above half resolution."""
        self._levels = levels

    def see(self, image: Image) -> bool:
        """Nothing is asked of an image beforehand."""
        return False

    def follow(
        self, previous: PreviousFrame, image: ImageLevels, guess: FloatArray, *, trusted: bool
    ) -> tuple[FloatArray, BoolArray]:
        """Return pixels (N, 2) of features and a mask (N,) of those found; see `Flow`."""
        last = previous.left.half
        left = previous.tracks.left
        return track_with_retries(last, image, left, guess, trusted, self._levels)

    def keep(self, tracks: Tracks) -> None:
        """Nothing is kept of features."""


def track_with_retries(
    last: Image,
    view: ImageLevels,
    points: FloatArray,
    guess: FloatArray,
    trusted: bool,
    levels: int,
) -> tuple[FloatArray, BoolArray]:
    """Track points from the last image into the current one; repeat with a wider search where many
    are lost.

    A trusted guess is searched with few pyramid levels first. If many points are lost, all levels
    are used. If most are still lost, the guess is discarded and the search starts from the old
    pixels.

    Args:
        last: last image (H/2, W/2) at half resolution.
        view: the current image.
        points: pixels (N, 2) in the last image.
        guess: pixels (N, 2) in the current image to start from.
        trusted: whether the guess comes from a prior or from a motion with consensus.
        levels: pyramid levels above half resolution.

    Returns:
        Pixels (N, 2), and a mask (N,) of those found.
    """
    last = match_brightness(last, view.half)
    few = min(_TRACKING.trusted_levels, levels) if trusted else levels
    found, good = _track_forward_backward(last, view, points, guess, few, trusted=trusted)
    attempts = (
        [(guess, _FLOW.retry_share), (points, _FLOW.lost_share)]
        if trusted
        else [(points, _FLOW.lost_share)]
    )
    for start, share in attempts:
        retry = (~good).nonzero()[0]
        if len(retry) <= share * len(points):
            break
        found[retry], good[retry] = _track_forward_backward(
            last, view, points[retry], start[retry], levels, trusted=False
        )
    return found, good


def match_brightness(image: Image, other: Image) -> Image:
    """Adjust an image to another's mean and contrast if they differ clearly: Lucas-Kanade
    compares gray levels.
    """
    (mean, contrast), (other_mean, other_contrast) = (
        mean_and_contrast(part, _FLOW.stride) for part in (image, other)
    )
    gain = other_contrast / max(contrast, _FLOW.min_contrast)
    if (
        abs(gain - 1) < _FLOW.max_contrast_change and abs(other_mean - mean) < _FLOW.max_mean_change
    ) or gain <= 0:
        return image
    gain = min(max(gain, 1 / _FLOW.max_gain), _FLOW.max_gain)
    levels = gain * (np.arange(256) - mean) + other_mean
    return np.asarray(
        cv2.LUT(image, np.clip(np.rint(levels), 0, 255).astype(np.uint8)), dtype=np.uint8
    )


def _track_forward_backward(
    last: Image,
    view: ImageLevels,
    points: FloatArray,
    guess: FloatArray,
    levels: int,
    *,
    trusted: bool,
) -> tuple[FloatArray, BoolArray]:
    """Track points (N, 2) forward and backward; return the new pixels and the mask of consistent
    ones.

    Points found where a trusted guess expects them, to the same tolerance, are not tracked
    backward: two independent sources agree on them, and alignment with the anchor is to come.
    """
    forward, good = _flow(last, view.half, points, guess, levels)
    good &= inside(view.full, forward, ANCHOR_REACH_PX + 2)
    tolerance = _TRACKING.max_forward_backward_px
    doubtful = (good & _apart(forward, guess, tolerance) if trusted else good).nonzero()[0]
    if len(doubtful):
        before = points.take(doubtful, axis=0)
        backward, seen_back = _flow(view.half, last, forward.take(doubtful, axis=0), before, levels)
        good[doubtful] = seen_back & ~_apart(backward, before, tolerance)
    return forward, good


def _apart(points: FloatArray, others: FloatArray, distance: float) -> BoolArray:
    """Mask (N,) of points (N, 2) that are further than a distance from others (N, 2)."""
    out = np.empty(len(points), dtype=np.bool_)
    _mark_apart(points, others, distance, out)
    return out


@compiled
def _mark_apart(points: FloatArray, others: FloatArray, distance: float, out: BoolArray) -> None:
    for n in range(len(points)):
        du = points[n, 0] - others[n, 0]
        dv = points[n, 1] - others[n, 1]
        out[n] = not np.sqrt(du * du + dv * dv) <= distance


def _flow(
    source: Image, target: Image, points: FloatArray, guess: FloatArray, levels: int
) -> tuple[FloatArray, BoolArray]:
    """Track points (N, 2) between half-resolution images, all in pixels of the full image.

    Returns:
        The new pixels (N, 2), and a mask (N,) of those found; the others stay where they were.
    """
    pixels, seen = lucas_kanade(
        source,
        target,
        points / 2,
        guess / 2,
        PyramidSearch(_FLOW.window_px, levels, _TRACKING.iterations, _FLOW.lk_epsilon_px),
    )
    pixels *= 2
    lost = (~seen).nonzero()[0]
    pixels[lost] = points[lost]
    return pixels, seen


@dataclass(frozen=True, slots=True)
class PyramidSearch:
    """How Lucas-Kanade searches."""

    window_px: int  # side of the window
    levels: int  # of the pyramids beside the images themselves
    iterations: int  # largest number per level
    epsilon_px: float  # step below which a point has converged


def lucas_kanade(
    source: Image,
    target: Image,
    points: FloatArray,
    guess: FloatArray,
    search: PyramidSearch,
) -> tuple[FloatArray, BoolArray]:
    """Track points by OpenCV's pyramidal Lucas-Kanade.

    Args:
        source: image (H, W) that contains the points.
        target: image (H, W) to find them in.
        points: pixels (N, 2).
        guess: pixels (N, 2) to start from.
        search: windows, levels and steps.

    Returns:
        Pixels (N, 2), arbitrary where not found, and a mask (N,) of those found.
    """
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        points.astype(np.float32).reshape(-1, 1, 2),
        guess.astype(np.float32).reshape(-1, 1, 2),
        winSize=(search.window_px, search.window_px),
        maxLevel=search.levels,
        criteria=(
            cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT,
            search.iterations,
            search.epsilon_px,
        ),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_FLOW.lk_min_eigenvalue,
    )
    pixels = found[:, 0].astype(np.float64)
    is_found = status[:, 0] == 1
    return pixels, is_found & np.isfinite(pixels).all(axis=1)
