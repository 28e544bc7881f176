"""Predicted pixels of the tracked features in the next frame: from a prior, or from a camera
motion.
"""

from __future__ import annotations

import numpy as np

from vio.cameras.projection import CameraArgs, camera_args, moved_pixel, point_at, turn_to
from vio.frontend.patches import inside
from vio.frontend.tracks import Tracks
from vio.geometry.lie import FloatArray, se3_from_parts
from vio.geometry.stereo import StereoCamera
from vio.numerics.compiled import compiled, index_of
from vio.numerics.kinds import Tolerance
from vio.records import BoolArray, Image, IntArray, TrackPrior

_MIN_DEPTH_M = 0.1
_NEIGHBOURS = 3  # matched features whose median depth replaces an unknown one
_FAR_M: Tolerance[float] = 1e6  # depth assumed where too few features have one


def prior_pixels(ids: IntArray, prior: TrackPrior) -> tuple[IntArray, FloatArray]:
    """Rows (K,) of the ids (N,) that a usable prior contains, and the left pixels (K, 2) that it
    predicts.
    """
    rows, given = _common_rows(ids, prior)
    return rows, prior.z[given, :2]


def _common_rows(ids: IntArray, prior: TrackPrior) -> tuple[IntArray, IntArray]:
    """Rows (K,) of the ids (N,) that a usable prior contains, and its rows (K,) for them."""
    rows = np.empty(len(ids), dtype=np.int64)
    given = np.empty(len(ids), dtype=np.int64)
    count = _find(np.ascontiguousarray(ids), prior.ids, rows, given)
    return rows[:count], given[:count]


@compiled
def _find(ids: IntArray, increasing: IntArray, rows: IntArray, given: IntArray) -> int:
    """Write the rows (K,) of those ids (N,) that are among others (M,), and their rows there;
    return K.
    """
    count = 0
    for n in range(len(ids)):
        at = index_of(ids[n], increasing)
        if at >= 0:
            rows[count] = n
            given[count] = at
            count += 1
    return count


def prior_depths(
    camera: StereoCamera, ids: IntArray, prior: TrackPrior
) -> tuple[FloatArray, BoolArray]:
    """Depths (N,) that a usable prior predicts for ids (N,), metres, and a mask (N,) of those that
    it contains.

    Ids below zero are in no prior; depths outside the mask are one metre.
    """
    depth = np.ones(len(ids))
    known = np.zeros(len(ids), dtype=np.bool_)
    named = (ids >= 0).nonzero()[0]
    rows, given = _common_rows(ids[named], prior)
    disparity = prior.z[given, 0] - prior.z[given, 2]
    ahead = np.isfinite(disparity) & (disparity > 0)
    rows = named[rows[ahead]]
    depth[rows] = camera.fu * camera.baseline_m / disparity[ahead]
    known[rows] = True
    return depth, known


def moved_pixels(
    camera: StereoCamera, T_curr_prev: FloatArray, p_prev: FloatArray, left: FloatArray
) -> FloatArray:
    """Left pixels (N, 2) of points (N, 3) after a camera motion; points behind the camera keep
    their pixels `left`.
    """
    out = left.copy()
    _move(camera_args(camera), np.ascontiguousarray(T_curr_prev), np.ascontiguousarray(p_prev), out)
    return out


@compiled
def _move(camera: CameraArgs, T: FloatArray, points: FloatArray, pixels: FloatArray) -> None:
    """Replace the pixels (N, 2) of points (N, 3) that are ahead after a motion (4, 4) by those
    after it.
    """
    for n in range(len(points)):
        u, v, depth = moved_pixel(camera, T, points[n, 0], points[n, 1], points[n, 2])
        if depth > _MIN_DEPTH_M:
            pixels[n, 0] = u
            pixels[n, 1] = v


def guessed_pixels(
    camera: StereoCamera, old: Tracks, prior: TrackPrior | None, expected: FloatArray, image: Image
) -> FloatArray:
    """Predict the left pixels (N, 2) of features in the current frame: from the prior, else by the
    last motion.

    Args:
        camera: the rectified pair.
        old: features of the previous frame.
        prior: usable prior, or None.
        expected: motion (4, 4) `T_curr_prev` by the last one.
        image: the current left image.
    """
    if prior is not None and prior.R_cam_prev is not None:
        expected = se3_from_parts(prior.R_cam_prev, expected[:3, 3])
    guess = old.left.copy()
    _move_all(
        camera_args(camera),
        np.ascontiguousarray(expected),
        old.point,
        old.has_point,
        old.left,
        guess,
    )
    if prior is not None:
        rows, predicted = prior_rows(old, np.arange(len(old)), prior)
        guess[rows] = predicted
    # A prediction outside the image cannot be tracked; the search then starts at the old pixel.
    outside = ~inside(image, guess, 0.0)
    guess[outside] = old.left[outside]
    return guess


@compiled
def _move_all(
    camera: CameraArgs,
    T: FloatArray,
    point: FloatArray,
    has_point: BoolArray,
    left: FloatArray,
    pixels: FloatArray,
) -> None:
    """Replace left pixels (N, 2) as `_move` does; the depth of features without a point is that
    of their neighbours.
    """
    count = 0
    depth = np.empty(len(left))
    for n in range(len(left)):
        depth[n] = turn_to(camera, point[n, 1], point[n, 2])[4]
        count += has_point[n]
    for n in range(len(left)):
        x = point[n, 0]
        y = point[n, 1]
        z = point[n, 2]
        if not has_point[n]:
            away = _borrowed(left, depth, has_point, n) if count >= _NEIGHBOURS else _FAR_M
            x, y, z = point_at(camera, left[n, 0], left[n, 1], away)
        u, v, ahead = moved_pixel(camera, T, x, y, z)
        if ahead > _MIN_DEPTH_M:
            pixels[n, 0] = u
            pixels[n, 1] = v


@compiled
def _borrowed(pixels: FloatArray, depth: FloatArray, known: BoolArray, n: int) -> float:
    """Return the median depth of those three of the known pixels, of (N, 2), that are next to
    the n-th one.
    """
    gap = np.empty(_NEIGHBOURS)
    near = np.empty(_NEIGHBOURS)
    for i in range(_NEIGHBOURS):
        gap[i] = np.inf
    for k in range(len(pixels)):
        distance = abs(pixels[n, 0] - pixels[k, 0]) + abs(pixels[n, 1] - pixels[k, 1])
        if not (known[k] and distance < gap[2]):
            continue
        i = 2
        while i > 0 and distance < gap[i - 1]:  # kept in order
            gap[i] = gap[i - 1]
            near[i] = near[i - 1]
            i -= 1
        gap[i] = distance
        near[i] = depth[k]
    return max(min(near[0], near[1]), min(max(near[0], near[1]), near[2]))


def prior_rows(tracks: Tracks, rows: IntArray, prior: TrackPrior) -> tuple[IntArray, FloatArray]:
    """Return those of the rows that were output and are in a prior, and the left pixels (K, 2)
    that it predicts.
    """
    shown = rows[tracks.shown[rows]]
    named, predicted = prior_pixels(tracks.ids[shown], prior)
    return shown[named], predicted
