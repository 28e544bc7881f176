"""Where the features of the last frame are expected in the coming one: by a prior, or by a motion of the camera."""

from __future__ import annotations

import numpy as np

from vio.geometry.lie import FloatArray, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.records import IntArray, TrackPrior

_ROTATION_SLACK = 1e-3  # how far a predicted rotation may be from one
_MIN_DEPTH_M = 0.1


def usable_prior(prior: TrackPrior | None) -> TrackPrior | None:
    """The part of a prior that says something: rows of finite left pixels, one an id, and a rotation that is one."""
    if prior is None:
        return None
    ids, first = np.unique(prior.ids, return_index=True)
    finite = np.isfinite(prior.z[first, :2]).all(axis=1)
    R = prior.R_cam_prev
    if R is not None and not (np.isfinite(R).all() and np.abs(R @ R.T - np.eye(3)).max() < _ROTATION_SLACK):
        R = None
    if R is None and not finite.any():
        return None
    return TrackPrior(ids[finite], prior.z[first[finite]], R)


def told_pixels(ids: IntArray, prior: TrackPrior) -> tuple[IntArray, FloatArray]:
    """Rows (K,) of the ids (N,) that a usable prior names, and the left pixels (K, 2) where it expects them."""
    _, rows, given = np.intersect1d(ids, prior.ids, assume_unique=True, return_indices=True)
    return rows, prior.z[given, :2]


def moved_pixels(camera: StereoCamera, T_curr_prev: FloatArray, p_prev: FloatArray, left: FloatArray) -> FloatArray:
    """Left pixels (N, 2) of points (N, 3) after a camera motion; those that end up behind keep their pixels `left`."""
    moved = transform_points(T_curr_prev, p_prev)
    ahead = moved[:, 2] > _MIN_DEPTH_M
    pixels = project(camera, np.where(ahead[:, None], moved, [0.0, 0.0, 1.0]))[:, :2]
    return np.where(ahead[:, None], pixels, left)
