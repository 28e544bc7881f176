"""How much of what keyframes showed should be seen from a pose: a few points of each keyframe,
projected.
"""

from __future__ import annotations

import numpy as np

from vio.geometry.lie import FloatArray, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.mapping.map_graph import Rows
from vio.records import BoolArray, IntArray

_POINTS = 32  # of a keyframe; 0.8 kB
MIN_DEPTH_M = 0.1
# between two views of a point: beyond, descriptors have little in common
VIEW_COS = float(np.cos(np.radians(45.0)))
SCALES = 2.5  # between the distances of two views of a point, likewise


class Overlaps:
    """A few points of each keyframe, in the order in which keyframes were added."""

    def __init__(self) -> None:
        self._points = Rows(_POINTS, 3)  # in the keyframe's camera
        self._count = Rows()  # of stereo points

    def add(self, p: FloatArray) -> None:
        """Add a keyframe with its stereo points (N, 3), in the order of their columns."""
        chosen = np.linspace(0, len(p) - 1, _POINTS).astype(np.int64)
        self._points.append(p[chosen] if len(p) else np.full((_POINTS, 3), np.nan))
        self._count.append(len(p))

    def restore(self, points: FloatArray, count: IntArray) -> None:
        """Take the points (K, P, 3) and counts (K,) that `newest` gave of keyframes, in their
        order.
        """
        self._points.extend(points)
        self._count.extend(count)

    def newest(self, count: int) -> tuple[FloatArray, IntArray]:
        """Return the points (K, P, 3) of the newest keyframes, and how many stereo points each
        has (K,).
        """
        return self._points[-count:], self._count[-count:].astype(np.int64)

    def expected(
        self, rows: IntArray, T_map_cam: FloatArray, camera: StereoCamera, T_map_here: FloatArray
    ) -> FloatArray:
        """Return how many points of keyframes `rows` (R,), which stand at T_map_cam (R, 4, 4), a
        camera should see.

        Args:
            rows: keyframes.
            T_map_cam: (R, 4, 4) their poses.
            camera: the camera.
            T_map_here: (4, 4) its pose.
        """
        R_cam_map = np.swapaxes(T_map_cam[:, :3, :3], 1, 2)
        p = self._points[rows] @ R_cam_map + T_map_cam[:, None, :3, 3]
        q = transform_points(se3_inverse(T_map_here), p)
        ok = is_visible(p, T_map_cam[:, None, :3, 3], q, T_map_here[:3, 3])
        uv = project(camera, np.where(ok[..., None], q, [0.0, 0.0, 1.0]))
        ok &= (uv[..., :2] > 0).all(axis=-1)
        width = camera.width or np.inf
        height = camera.height or np.inf
        ok &= (uv[..., 0] < width) & (uv[..., 1] < height)
        out: FloatArray = ok.mean(axis=1) * self._count[rows]
        return out


def is_visible(p: FloatArray, there: FloatArray, q: FloatArray, here: FloatArray) -> BoolArray:
    """Mask (...) of points that a camera sees from about where another one saw them.

    Args:
        p: (..., 3) points.
        there: (..., 3) position of the camera that saw each, in the same frame.
        q: (..., 3) the points in the camera.
        here: (3,) position of the camera, in the frame of p.
    """
    then = p - there
    now = p - here
    away = np.linalg.norm(then, axis=-1)
    near = np.linalg.norm(now, axis=-1)
    cosine = np.einsum("...i,...i->...", then, now) / np.maximum(away * near, 1e-9)
    scale = away / np.maximum(near, 1e-9)
    out: BoolArray = (
        (q[..., 2] > MIN_DEPTH_M) & (cosine > VIEW_COS) & (scale > 1 / SCALES) & (scale < SCALES)
    )
    return out
