"""The rectified camera in compiled loops: `vio.geometry.stereo` for one point at a time."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics.compiled import compiled

Lens: TypeAlias = tuple[float, float, float, float, bool]  # fu, fv, cu, cv, whether the projection is a cylinder


def lens_of(camera: StereoCamera) -> Lens:
    """Return the intrinsics of both rectified images, as compiled functions take them."""
    return camera.fu, camera.fv, camera.cu, camera.cv, camera.is_cylinder


@compiled
def moved_pixel(lens: Lens, T: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Left pixel u, v and depth of a point that a motion T (4, 4) takes into the camera's frame."""
    fu, fv, cu, cv, cylinder = lens
    depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    across = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    down = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    if cylinder:
        v = fv * np.arctan2(down, depth) + cv
        depth = np.sqrt(down * down + depth * depth)
    else:
        v = fv * down / depth + cv
    return fu * across / depth + cu, v, depth


@compiled
def point_at(lens: Lens, u: float, v: float, depth: float) -> tuple[float, float, float]:
    """Point in the camera's frame at a left pixel and a depth (`depth_of`)."""
    fu, fv, cu, cv, cylinder = lens
    y = (v - cv) / fv
    if cylinder:
        return (u - cu) / fu * depth, np.sin(y) * depth, np.cos(y) * depth
    return (u - cu) / fu * depth, y * depth, depth
