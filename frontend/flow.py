"""Lucas-Kanade at half resolution, there and back, between images of one brightness; pixels are of the full image."""

from __future__ import annotations

import cv2
import numpy as np

from frontend.patches import View, inside
from frontend.settings import KltSettings
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, Image

_LK_EPSILON_PX = 0.02  # of the half-resolution image
_LK_MIN_EIGENVALUE = 1e-4  # as OpenCV's own default
_RETRY_SHARE = 0.25  # share of failures at which tracking is tried again with all pyramid levels
_LOST_SHARE = 0.5  # the same for the last attempt, from the old pixels
_SPARSE = 4  # every so many pixels of the half image tell its brightness
_SPARSE_CONTRAST = 1.0  # gray levels; less is no contrast to compare
_BLIND_CONTRAST = 0.1  # share of the last image's contrast below which an image shows nothing
_SAME_GAIN = 0.06  # change of contrast, and
_SAME_LEVEL = 6.0  # of the mean gray level, that tracking bears
_MAX_GAIN = 4.0


def follow(
    last: Image, view: View, points: FloatArray, guess: FloatArray, trusted: bool, settings: KltSettings
) -> tuple[FloatArray, BoolArray]:
    """Follow points of the last image into the present one.

    Where the guess is trusted, few pyramid levels are searched; should many fail, all levels; should most fail even so,
    the guess as a whole was wrong, and the search starts from where the points were.

    Args:
        last: last image (H/2, W/2) at half resolution.
        view: the present image.
        points: pixels (N, 2) in the last image.
        guess: pixels (N, 2) in the present one to start from.
        trusted: whether the guess is known to be good.
        settings: of the tracking.

    Returns:
        Pixels (N, 2), and a mask (N,) of those found.
    """
    last = as_bright(last, view.half)
    few = min(settings.trusted_levels, settings.pyramid_levels) if trusted else settings.pyramid_levels
    found, good = _both_ways(last, view, points, guess, few, settings)
    attempts = [(guess, _RETRY_SHARE), (points, _LOST_SHARE)] if trusted else [(points, _LOST_SHARE)]
    for start, share in attempts:
        retry = np.flatnonzero(~good)
        if len(retry) <= share * len(points):
            break
        found[retry], good[retry] = _both_ways(
            last, view, points[retry], start[retry], settings.pyramid_levels, settings
        )
    return found, good


def circle_gaps(
    last: Image, present: Image, before: FloatArray, after: FloatArray, settings: KltSettings
) -> FloatArray:
    """Distances (N,) in pixels between right pixels and where tracking in the right images leads; infinite where lost.

    Args:
        last: last right image (H/2, W/2) at half resolution.
        present: present one.
        before: right pixels (N, 2) matched in the last frame.
        after: right pixels (N, 2) matched in the present one.
        settings: of the tracking.
    """
    if len(before) == 0:
        return np.zeros(0)
    found, seen = _flow(last, present, before, after, settings.trusted_levels, settings)
    return np.where(seen, np.linalg.norm(found - after, axis=1), np.inf)


def shows_nothing(image: Image, last: Image) -> bool:
    """Whether an image (H, W) has next to no contrast where the last one had: black, saturated or covered."""
    return _contrast(image) < _BLIND_CONTRAST * _contrast(last)


def as_bright(image: Image, other: Image) -> Image:
    """The image with the other's mean and contrast where they differ clearly: Lucas-Kanade compares gray levels."""
    a, b = (part[::_SPARSE, ::_SPARSE].astype(np.float64) for part in (image, other))
    gain = float(b.std() / max(a.std(), _SPARSE_CONTRAST))
    if (abs(gain - 1) < _SAME_GAIN and abs(float(b.mean() - a.mean())) < _SAME_LEVEL) or gain <= 0:
        return image
    gain = min(max(gain, 1 / _MAX_GAIN), _MAX_GAIN)
    levels = gain * (np.arange(256) - a.mean()) + b.mean()
    return np.asarray(cv2.LUT(image, np.clip(np.rint(levels), 0, 255).astype(np.uint8)), dtype=np.uint8)


def _contrast(image: Image) -> float:
    """Standard deviation of an image's gray levels, from a sparse grid of them."""
    return float(image[::_SPARSE, ::_SPARSE].astype(np.float64).std())


def _both_ways(
    last: Image, view: View, points: FloatArray, guess: FloatArray, levels: int, settings: KltSettings
) -> tuple[FloatArray, BoolArray]:
    """Track points (N, 2) forth and back; return the new pixels and the mask of those that came back."""
    forth, seen = _flow(last, view.half, points, guess, levels, settings)
    back, seen_back = _flow(view.half, last, forth, points, levels, settings)
    error = np.linalg.norm(back - points, axis=1)
    margin = settings.anchor_radius_px + 2
    good = seen & seen_back & (error <= settings.max_forward_backward_px) & inside(view.full, forth, margin)
    return forth, good


def _flow(
    source: Image, target: Image, points: FloatArray, guess: FloatArray, levels: int, settings: KltSettings
) -> tuple[FloatArray, BoolArray]:
    """Track points (N, 2) between half-resolution images, all in pixels of the full image.

    Returns:
        The new pixels (N, 2), and a mask (N,) of those found; the others stay where they were.
    """
    half, seen = lucas_kanade(
        source,
        target,
        points / 2,
        guess / 2,
        window_px=settings.window_px,
        levels=levels,
        iterations=settings.iterations,
        epsilon_px=_LK_EPSILON_PX,
    )
    return np.where(seen[:, None], 2 * half, points), seen


def lucas_kanade(
    source: Image,
    target: Image,
    points: FloatArray,
    guess: FloatArray,
    *,
    window_px: int,
    levels: int,
    iterations: int,
    epsilon_px: float,
) -> tuple[FloatArray, BoolArray]:
    """Track points by OpenCV's pyramidal Lucas-Kanade.

    Args:
        source: image (H, W) that the points lie in.
        target: image (H, W) to find them in.
        points: pixels (N, 2).
        guess: pixels (N, 2) to start from.
        window_px: side of the window.
        levels: pyramid levels beside the images themselves.
        iterations: largest number of steps a level.
        epsilon_px: step below which a point has settled.

    Returns:
        Pixels (N, 2), arbitrary where not found, and a mask (N,) of those found.
    """
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        points.astype(np.float32).reshape(-1, 1, 2),
        guess.astype(np.float32).reshape(-1, 1, 2),
        winSize=(window_px, window_px),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, iterations, epsilon_px),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_LK_MIN_EIGENVALUE,
    )
    pixels = np.asarray(found, dtype=np.float64).reshape(-1, 2)
    return pixels, (np.asarray(status).reshape(-1) == 1) & np.isfinite(pixels).all(axis=1)
