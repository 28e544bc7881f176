"""Forward-backward Lucas-Kanade at half resolution, with brightness matching; pixels are of the
full image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vio.frontend.patches import ImageLevels, inside, mean_and_contrast
from vio.frontend.tracks import ANCHOR_REACH_PX
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled
from vio.records import BoolArray, Image

_WINDOW_PX = 11  # side of the window, of the half-resolution image
_TRUSTED_LEVELS = 1  # pyramid levels above half resolution where the pixels are predicted
_ITERATIONS = 20  # per level
_MAX_FORWARD_BACKWARD_PX = 1.5
_LK_EPSILON_PX = 0.02  # of the half-resolution image
_LK_MIN_EIGENVALUE = 1e-4  # as OpenCV's own default
_RETRY_SHARE = 0.25  # share of lost points above which tracking is repeated with all pyramid levels
_LOST_SHARE = 0.5  # the same for the last attempt, which starts from the old pixels
_STRIDE = 4  # brightness is computed from every fourth pixel of the half image
_MIN_CONTRAST = 1.0  # gray levels, lower bound of the contrast in the gain
_MAX_CONTRAST_CHANGE = 0.06  # relative change of contrast, and
_MAX_MEAN_CHANGE = 6.0  # change of the mean gray level, up to which images are not adjusted
_MAX_GAIN = 4.0


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
    few = min(_TRUSTED_LEVELS, levels) if trusted else levels
    found, good = _track_forward_backward(last, view, points, guess, few, trusted=trusted)
    attempts = (
        [(guess, _RETRY_SHARE), (points, _LOST_SHARE)] if trusted else [(points, _LOST_SHARE)]
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
        mean_and_contrast(part, _STRIDE) for part in (image, other)
    )
    gain = other_contrast / max(contrast, _MIN_CONTRAST)
    if (
        abs(gain - 1) < _MAX_CONTRAST_CHANGE and abs(other_mean - mean) < _MAX_MEAN_CHANGE
    ) or gain <= 0:
        return image
    gain = min(max(gain, 1 / _MAX_GAIN), _MAX_GAIN)
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
    tolerance = _MAX_FORWARD_BACKWARD_PX
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
        PyramidSearch(_WINDOW_PX, levels, _ITERATIONS, _LK_EPSILON_PX),
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
        minEigThreshold=_LK_MIN_EIGENVALUE,
    )
    pixels = np.asarray(found, dtype=np.float64).reshape(-1, 2)
    return pixels, (np.asarray(status).reshape(-1) == 1) & np.isfinite(pixels).all(axis=1)
