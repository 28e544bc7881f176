"""Stereo rectification: a rotation and a lookup map for each of two cameras.

The rectified cameras share the direction of the baseline as x axis, and the mean of the two optical axes, made
perpendicular to it, as z axis. References: Fusiello, Trucco & Verri, A compact algorithm for rectification of stereo
pairs (2000); Loop & Zhang, Computing rectifying homographies for stereo vision (1999) on splitting the rotation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, StereoRig, project_point, unproject_pixel
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.geometry.stereo import StereoCamera, left_rays, one_camera

MapArray = npt.NDArray[np.float32]
Interpolation: TypeAlias = Literal["linear", "cubic", "lanczos4"]

_BORDER_SAMPLES = 60  # points along each image border that determine the common field of view
_MAX_TANGENT = 1.4  # beyond about 54 degrees off axis a planar image only stretches pixels
_MIN_TANGENT_WIDTH = 0.1
_MAX_ROTATION_DEG = 30.0  # a camera that needs a larger rotation is not one half of a stereo pair


@dataclass(frozen=True, slots=True)
class RectifiedPair:
    """The rectified cameras of a rig."""

    camera: StereoCamera
    R_rect_cam0: FloatArray  # (3, 3)
    R_rect_cam1: FloatArray  # (3, 3)
    T_rect0_imu: FloatArray  # (4, 4) extrinsics of the rectified left camera


@dataclass(frozen=True, slots=True)
class Rectification(RectifiedPair):
    """The rectified cameras of a rig, and the maps of its images."""

    map0: tuple[MapArray, MapArray]  # (H, W) each: source u and v of every rectified pixel, for cv2.remap
    map1: tuple[MapArray, MapArray]


def rectify(rig: StereoRig) -> Rectification:
    """Find the rectified pair of a rig and its maps; its images have the size of the left one and no invalid border.

    Raises:
        CalibrationError: the cameras coincide, diverge, are swapped, or share no field of view.
    """
    pair = rectified_cameras(rig)
    return Rectification(
        camera=pair.camera,
        R_rect_cam0=pair.R_rect_cam0,
        R_rect_cam1=pair.R_rect_cam1,
        T_rect0_imu=pair.T_rect0_imu,
        map0=_lookup(pair.camera, rig.cam0, pair.R_rect_cam0),
        map1=_lookup(pair.camera, rig.cam1, pair.R_rect_cam1),
    )


def rectified_cameras(rig: StereoRig) -> RectifiedPair:
    """Find the rectified pair of a rig, without the maps of its images.

    Raises:
        CalibrationError: as `rectify`.
    """
    R_rect_cam0, R_rect_cam1, baseline_m = rectifying_rotations(rig)
    low0, high0 = _inner_rectangle(rig.cam0, R_rect_cam0)
    low1, high1 = _inner_rectangle(rig.cam1, R_rect_cam1)
    low, high = np.maximum(low0, low1), np.minimum(high0, high1)
    extent = high - low
    if extent.min() < _MIN_TANGENT_WIDTH:
        raise CalibrationError("the two cameras share no field of view; check the extrinsics T_BS of both cameras")
    width, height = rig.cam0.width, rig.cam0.height
    # One focal length for both axes, large enough that the shared field of view fills the image along both.
    f = float(max((width - 1) / extent[0], (height - 1) / extent[1]))
    centre = (low + high) / 2
    cu, cv = (width - 1) / 2 - f * centre[0], (height - 1) / 2 - f * centre[1]
    camera = StereoCamera(f, f, float(cu), float(cv), baseline_m, width, height)
    T_cam0_imu = se3_inverse(rig.T_imu_cam0)
    return RectifiedPair(
        camera=camera,
        R_rect_cam0=R_rect_cam0,
        R_rect_cam1=R_rect_cam1,
        T_rect0_imu=se3_from_parts(R_rect_cam0, np.zeros(3)) @ T_cam0_imu,
    )


def rectifying_rotations(rig: StereoRig) -> tuple[FloatArray, FloatArray, float]:
    """Return `R_rect_cam0`, `R_rect_cam1` (3, 3) and the baseline in metres.

    Raises:
        CalibrationError: the cameras coincide, or a rectifying rotation is too large.
    """
    T_cam0_cam1 = rig.T_cam0_cam1
    t, R_cam0_cam1 = T_cam0_cam1[:3, 3], T_cam0_cam1[:3, :3]
    baseline_m = float(np.linalg.norm(t))
    if baseline_m < 1e-6:
        raise CalibrationError("both cameras have the same position: the baseline is zero; check both T_BS")
    x = t / baseline_m
    forward = np.array([0.0, 0, 1]) + R_cam0_cam1[:, 2]
    z = forward - (forward @ x) * x
    if np.linalg.norm(z) < 1e-6:
        raise CalibrationError("the cameras look along their baseline, or in opposite directions; check both T_BS")
    z /= np.linalg.norm(z)
    R_rect_cam0 = np.stack([x, np.cross(z, x), z])
    R_rect_cam1 = R_rect_cam0 @ R_cam0_cam1
    for name, R in (("left", R_rect_cam0), ("right", R_rect_cam1)):
        angle_deg = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
        if angle_deg > _MAX_ROTATION_DEG:
            raise CalibrationError(
                f"rectifying would rotate the {name} camera by {angle_deg:.0f} deg; cam1 must be to the right of cam0, "
                "so the cameras may be swapped, or an extrinsic T_BS inverted"
            )
    return R_rect_cam0, R_rect_cam1, baseline_m


def rectify_pixels(
    camera: CameraModel, R_rect_cam: FloatArray, rectified: StereoCamera, uv: npt.ArrayLike
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Rectified pixels (N, 2) of raw pixels (N, 2) of one camera, and a mask (N,) of valid ones.

    Both rectified cameras share their intrinsics, so this applies to left and right alike.
    """
    ray, valid = unproject_pixel(camera, uv)
    ray = ray @ R_rect_cam.T
    valid = valid & (ray[..., 2] > 1e-6)
    plane = ray[..., :2] / np.where(valid, ray[..., 2], 1.0)[..., None]
    return plane * (rectified.fu, rectified.fv) + (rectified.cu, rectified.cv), valid


def _inner_rectangle(camera: CameraModel, R_rect_cam: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners (2,), (2,) of the largest axis-parallel box on the rectified plane z = 1 inside the image's outline."""
    w, h = camera.width - 1.0, camera.height - 1.0
    s = np.linspace(0, 1, _BORDER_SAMPLES)
    sides = {
        "left": np.stack([0 * s, h * s], axis=1),
        "right": np.stack([0 * s + w, h * s], axis=1),
        "top": np.stack([w * s, 0 * s], axis=1),
        "bottom": np.stack([w * s, 0 * s + h], axis=1),
    }
    plane = {}
    for name, uv in sides.items():
        ray, valid = unproject_pixel(camera, uv)
        ray = ray @ R_rect_cam.T
        ahead = valid & (ray[:, 2] > 0.1)
        # A border point behind the camera, or outside the lens model's range, sets no bound.
        direction = {"left": [-1, 0], "right": [1, 0], "top": [0, -1], "bottom": [0, 1]}[name]
        far = np.array(direction, dtype=np.float64) * 1e9
        plane[name] = np.where(ahead[:, None], ray[:, :2] / np.where(ahead, ray[:, 2], 1.0)[:, None], far)
    low = np.array([plane["left"][:, 0].max(), plane["top"][:, 1].max()])
    high = np.array([plane["right"][:, 0].min(), plane["bottom"][:, 1].min()])
    return np.maximum(low, -_MAX_TANGENT), np.minimum(high, _MAX_TANGENT)


def _lookup(rectified: StereoCamera, camera: CameraModel, R_rect_cam: FloatArray) -> tuple[MapArray, MapArray]:
    assert rectified.width is not None
    assert rectified.height is not None
    pixels = np.stack(np.meshgrid(np.arange(rectified.width), np.arange(rectified.height)), axis=-1)
    rays = left_rays(rectified, pixels)
    uv, valid = project_point(camera, rays @ R_rect_cam)
    uv = np.where(valid[..., None], uv, -1e4)
    return uv[..., 0].astype(np.float32), uv[..., 1].astype(np.float32)


def undistorted(camera: CameraModel) -> tuple[StereoCamera, tuple[MapArray, MapArray]]:
    """Return one camera without its distortion, looking the same way, and the map of its images.

    The images keep their size and have no invalid border.
    """
    low, high = _inner_rectangle(camera, np.eye(3))
    f = float(max((camera.width - 1) / (high - low)[0], (camera.height - 1) / (high - low)[1]))
    cu, cv = np.array([camera.width - 1, camera.height - 1]) / 2 - f * (low + high) / 2
    out = one_camera(f, f, float(cu), float(cv), camera.width, camera.height)
    return out, _lookup(out, camera, np.eye(3))
