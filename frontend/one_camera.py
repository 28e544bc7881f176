"""Depths of the tracked features without a right camera: of the filter's points, or of depth
images.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.frontend.prediction import prior_depths
from vio.frontend.tracks import Tracks
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera, left_rays
from vio.records import BoolArray, TrackPrior

# Disparities of four neighbouring pixels on a surface differ by less, also where it is seen at a
# slant of 80 degrees; at the outline of an object they differ by more, and which side a feature
# lies on is not known.
_MAX_SLOPE_PX = 1.0
_MIN_DEPTH_M = 0.05


def with_prior_depths(camera: StereoCamera, tracks: Tracks, prior: TrackPrior | None) -> Tracks:
    """Return the features with the points that a prior has for them, at their present left
    pixels.
    """
    if prior is None:
        return tracks
    depth, known = prior_depths(camera, np.where(tracks.shown, tracks.ids, -1), prior)
    point = np.where(known[:, None], left_rays(camera, tracks.left) * depth[:, None], tracks.point)
    return replace(tracks, point=point, has_point=tracks.has_point | known)


def with_depths(camera: StereoCamera, tracks: Tracks, depth_m: FloatArray) -> Tracks:
    """Return the features with a virtual right pixel and a point where a depth image (H, W) knows
    their depth.

    `ur = ul - fu baseline / depth`, and `vr = vl`. The features keep the points that they had where
    it does not.
    """
    disparity, known = disparities(camera, tracks.left, depth_m)
    right = np.stack([tracks.left[:, 0] - disparity, tracks.left[:, 1]], axis=1)
    depth = camera.fu * camera.baseline_m / np.where(known, disparity, 1.0)
    point = np.where(known[:, None], left_rays(camera, tracks.left) * depth[:, None], tracks.point)
    return replace(
        tracks, right=right, has_right=known, point=point, has_point=tracks.has_point | known
    )


def disparities(
    camera: StereoCamera, pixels: FloatArray, depth_m: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Virtual disparities (N,) at left pixels (N, 2), and a mask (N,) of those that the depth image
    knows.

    A plane's disparity is linear in the pixels, so the disparities of the four pixels around are
    interpolated. All of them must have a depth, and lie on one surface.
    """
    height, width = depth_m.shape
    u = pixels[:, 0]
    v = pixels[:, 1]
    in_columns = (u >= 0) & (u <= width - 1)
    in_rows = (v >= 0) & (v <= height - 1)
    inside = in_columns & in_rows
    x = np.clip(np.floor(np.where(inside, u, 0.0)), 0, width - 2).astype(np.int64)
    y = np.clip(np.floor(np.where(inside, v, 0.0)), 0, height - 2).astype(np.int64)
    right = x + 1
    below = y + 1
    corners = np.stack([depth_m[y, x], depth_m[y, right], depth_m[below, x], depth_m[below, right]])
    has_depth = inside & np.all(np.isfinite(corners) & (corners > _MIN_DEPTH_M), axis=0)
    d = camera.fu * camera.baseline_m / np.where(has_depth, corners, 1.0)
    a = u - x
    b = v - y
    upper = (1 - a) * d[0] + a * d[1]
    lower = (1 - a) * d[2] + a * d[3]
    out = (1 - b) * upper + b * lower
    known: BoolArray = has_depth & (np.ptp(d, axis=0) <= _MAX_SLOPE_PX)
    return np.where(known, out, 0.0), known
