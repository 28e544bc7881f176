"""pycolmap: `Rigid3d`, cameras, rigs and frames, and the covariance of a pose.

COLMAP's poses are `T_cam_world`, and the centre of its top-left pixel is at (0.5, 0.5).
`BACovariance.get_cam_cov_from_world` states rotations first and as *half* angles about the camera's
axes, as Ceres moves a quaternion, then the plain vector of the translation.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vio.cameras.rig import Rig
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel
from vio.geometry.lenses.registry import LENSES
from vio.geometry.lie import FloatArray, checked_transform, so3_hat
from vio.geometry.stereo import HALF_PX
from vio.interop.loading import checked_covariance, package

_INSTALL = "pycolmap>=4.2,<5"
_LEFT = 1  # camera ids
_RIGHT = 2


def to_rigid3d(T: FloatArray) -> Any:
    """Return a transform (4, 4) as `pycolmap.Rigid3d`."""
    rows = np.ascontiguousarray(checked_transform(T, "pose")[:3])
    return package("pycolmap", _INSTALL).Rigid3d(rows)


def from_rigid3d(transform: Any) -> FloatArray:
    """Return a `pycolmap.Rigid3d` as a transform (4, 4)."""
    return checked_transform(transform.matrix(), "pycolmap.Rigid3d")


def _to_half_angles(T_cam_world: FloatArray) -> FloatArray:
    """Return the derivative (6, 6) of COLMAP's [half angles; translation] by xi = [rho; phi] in
    T_cam_world = exp(xi) T_hat.

    R = exp(phi) R_hat and t = t_hat + rho + phi x t_hat, to first order.
    """
    out = np.zeros((6, 6))
    out[:3, 3:] = 0.5 * np.eye(3)
    out[3:, :3] = np.eye(3)
    out[3:, 3:] = -so3_hat(T_cam_world[:3, 3])
    return out


def to_cam_from_world_covariance(T_cam_world: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return a camera's covariance (6, 6) of xi, on the camera's side, as
    `BACovariance.get_cam_cov_from_world` states it.
    """
    turn = _to_half_angles(T_cam_world)
    return turn @ checked_covariance(covariance) @ turn.T


def from_cam_from_world_covariance(T_cam_world: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return what `BACovariance.get_cam_cov_from_world` states as the covariance (6, 6) of xi on
    the camera's side: of the camera's pose in the world, as `Estimate.covariance`.
    """
    back = np.linalg.inv(_to_half_angles(T_cam_world))
    return back @ checked_covariance(covariance) @ back.T


def to_camera(lens: CameraModel, camera_id: int = _LEFT) -> Any:
    """Return a camera as `pycolmap.Camera`.

    Raises:
        CalibrationError: COLMAP has no such lens model.
    """
    found = lens.lens.files.colmap.get(len(lens.coefficients))
    if found is None:
        raise CalibrationError(
            f"COLMAP has no lens model {lens.model} with {len(lens.coefficients)} coefficients; "
            "rectify the images first (vio rectify)"
        )
    name, count = found
    coefficients = [*lens.coefficients, *[0.0] * (count - len(lens.coefficients))]
    centre = [lens.cu + HALF_PX, lens.cv + HALF_PX]
    return package("pycolmap", _INSTALL).Camera(
        camera_id=camera_id,
        model=name,
        width=lens.width,
        height=lens.height,
        params=[lens.fu, lens.fv, *centre, *coefficients],
        has_prior_focal_length=True,
    )


def from_camera(camera: Any) -> CameraModel:
    """Return a `pycolmap.Camera`.

    Raises:
        CalibrationError: we have no such lens model.
    """
    name = camera.model.name
    known = {word: one.name for one in LENSES.values() for word, _ in one.files.colmap.values()}
    if name not in known:
        raise CalibrationError(
            f"the lens model {name} of COLMAP is not one of {', '.join(known)}; undistort the "
            "model's images first"
        )
    fu, fv, cu, cv, *coefficients = np.asarray(camera.params).tolist()
    centre = (cu - HALF_PX, cv - HALF_PX)
    size = (int(camera.width), int(camera.height))
    return CameraModel(fu, fv, *centre, *size, known[name], tuple(coefficients))


def to_rig(rig: Rig, rig_id: int = 1) -> tuple[Any, tuple[Any, ...]]:
    """Return a rig as `pycolmap.Rig` with the left camera as its reference, and its cameras, whose
    ids are 1 and 2.
    """
    cameras = [to_camera(rig.cam0, _LEFT)]
    made = package("pycolmap", _INSTALL).Rig(rig_id=rig_id)
    made.add_ref_sensor(cameras[0].sensor_id)
    if rig.cam1 is not None and rig.T_cam1_cam0 is not None:
        cameras.append(to_camera(rig.cam1, _RIGHT))
        made.add_sensor(cameras[1].sensor_id, to_rigid3d(rig.T_cam1_cam0))
    return made, tuple(cameras)


def from_rig(rig: Any, cameras: tuple[Any, ...], T_cam0_imu: FloatArray | None = None) -> Rig:
    """Return a `pycolmap.Rig` of one or two cameras, the first of them its reference; COLMAP holds
    no IMU.

    Raises:
        CalibrationError: a lens model is not known, or the first camera is not the reference.
    """
    if not rig.is_ref_sensor(cameras[0].sensor_id):
        raise CalibrationError(
            "the first camera is not the reference of COLMAP's rig; give the reference first"
        )
    lenses = [from_camera(camera) for camera in cameras]
    if len(lenses) == 1:
        return Rig(lenses[0], None, None, T_cam0_imu)
    T_cam1_cam0 = from_rigid3d(rig.sensor_from_rig(cameras[1].sensor_id))
    return Rig(lenses[0], lenses[1], T_cam1_cam0, T_cam0_imu)


def to_frame(T_cam0_world: FloatArray, frame_id: int, rig_id: int = 1) -> Any:
    """Return a pose (4, 4) of the left camera as `pycolmap.Frame` of the rig that `to_rig` makes."""
    frame = package("pycolmap", _INSTALL).Frame(frame_id=frame_id, rig_id=rig_id)
    frame.rig_from_world = to_rigid3d(T_cam0_world)
    return frame


def from_frame(frame: Any) -> FloatArray:
    """Return the pose `T_cam0_world` (4, 4) of a `pycolmap.Frame` whose reference is the left
    camera.
    """
    return from_rigid3d(frame.rig_from_world)
