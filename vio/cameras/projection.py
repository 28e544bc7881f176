"""The rectified camera in compiled loops: `vio.geometry.stereo` for one point at a time."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Capacity

# fu, fv, cu, cv (pixels), baseline (m), whether the projection is a cylinder
CameraArgs: TypeAlias = tuple[float, float, float, float, float, bool]


_MAX_KNOWN: Capacity[int] = 8
# the last ones, newest first; by identity, as a camera's hash costs more than the answer
_known: list[tuple[StereoCamera, CameraArgs]] = []


def camera_args(camera: StereoCamera) -> CameraArgs:
    """Return the intrinsics of both rectified images, as compiled functions take them."""
    for known, args in _known:
        if known is camera:
            return args
    fu = float(camera.fu)
    fv = float(camera.fv)
    cu = float(camera.cu)
    cv = float(camera.cv)
    args = fu, fv, cu, cv, float(camera.baseline_m), camera.is_cylinder
    _known.insert(0, (camera, args))
    del _known[_MAX_KNOWN:]
    return args


@compiled
def turn_to(camera: CameraArgs, y: float, z: float) -> tuple[float, float, float, float, float]:
    """Turn the camera about its baseline to a point, as `vio.geometry.stereo.facing` does; a
    pinhole stays.

    Returns:
        The azimuth (radians), its sine and cosine, and y and z of the point in the turned camera: z
        is the depth of `depth_of`, and the point is seen in row `fv y / z + fv azimuth + cv`.
    """
    if camera[5]:
        azimuth = np.arctan2(y, z)
        return azimuth, np.sin(azimuth), np.cos(azimuth), 0.0, np.sqrt(y * y + z * z)
    return 0.0, 0.0, 1.0, y, z


@compiled
def moved_pixel(
    camera: CameraArgs, T: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Left pixel u, v and depth of a point that a motion T (4, 4) takes into the camera's frame."""
    fu, fv, cu, cv, _, _ = camera
    ahead = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    across = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    down = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    azimuth, _, _, below, depth = turn_to(camera, down, ahead)
    return fu * across / depth + cu, fv * below / depth + fv * azimuth + cv, depth


@compiled
def point_at(camera: CameraArgs, u: float, v: float, depth: float) -> tuple[float, float, float]:
    """Point in the camera's frame at a left pixel and a depth (`depth_of`)."""
    fu, fv, cu, cv, _, cylinder = camera
    y = (v - cv) / fv
    if cylinder:
        return (u - cu) / fu * depth, np.sin(y) * depth, np.cos(y) * depth
    return (u - cu) / fu * depth, y * depth, depth
