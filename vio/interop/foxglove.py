"""Foxglove's SDK: `FrameTransform`, `Odometry`, `CameraCalibration` and `PointCloud`.

`Odometry.pose_covariance` is that of ROS: about fixed axes. Messages of the SDK cannot be read
back by attribute; they are for a server or an MCAP file.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vio.errors import CalibrationError
from vio.geometry.lie import FloatArray, quat_xyzw_from_rotation
from vio.geometry.stereo import StereoCamera
from vio.interop.loading import package
from vio.interop.ros import to_fixed_axes_covariance
from vio.records import NS_PER_S, Landmarks

_INSTALL = "foxglove-sdk>=0.30,<1"
_FLOAT_BYTES = np.dtype(np.float32).itemsize


def _messages() -> Any:
    return package("foxglove.messages", _INSTALL)


def _stamp(time_ns: int) -> Any:
    return _messages().Timestamp(time_ns // NS_PER_S, time_ns % NS_PER_S)


def _parts(T: FloatArray) -> tuple[Any, Any]:
    """Return the translation and the quaternion of a transform (4, 4)."""
    m = _messages()
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = quat_xyzw_from_rotation(T[:3, :3]).tolist()
    return m.Vector3(x=x, y=y, z=z), m.Quaternion(x=qx, y=qy, z=qz, w=qw)


def to_frame_transform(time_ns: int, parent: str, child: str, T_parent_child: FloatArray) -> Any:
    """Return a transform (4, 4) that maps the child's coordinates to the parent's."""
    translation, rotation = _parts(T_parent_child)
    return _messages().FrameTransform(
        timestamp=_stamp(time_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=translation,
        rotation=rotation,
    )


def to_odometry(
    time_ns: int, world: str, body: str, T_world_body: FloatArray, covariance: FloatArray
) -> Any:
    """Return a pose (4, 4) of a body and the covariance (6, 6) of xi on its side."""
    m = _messages()
    position, orientation = _parts(T_world_body)
    return m.Odometry(
        timestamp=_stamp(time_ns),
        frame_id=world,
        body_frame_id=body,
        pose=m.Pose(position=position, orientation=orientation),
        pose_covariance=to_fixed_axes_covariance(T_world_body, covariance).ravel().tolist(),
    )


def to_camera_calibration(time_ns: int, frame: str, camera: StereoCamera) -> Any:
    """Return the left camera of a rectified pair.

    Raises:
        CalibrationError: the images are cylinders, or their size is not known.
    """
    if camera.projection != "pinhole" or camera.width is None or camera.height is None:
        raise CalibrationError(
            "a CameraCalibration of Foxglove needs a pinhole's image of known size; set "
            "dataset.projection to pinhole and run on images"
        )
    return _messages().CameraCalibration(
        timestamp=_stamp(time_ns),
        frame_id=frame,
        width=camera.width,
        height=camera.height,
        distortion_model="plumb_bob",
        D=[0.0] * 5,
        K=camera.K.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([camera.K, np.zeros(3)]).ravel().tolist(),
    )


def to_point_cloud(time_ns: int, frame: str, landmarks: Landmarks) -> Any:
    """Return landmarks as x y z and `sigma`, their standard deviation (root mean square over the
    axes), in float32.
    """
    m = _messages()
    sigmas = np.sqrt(np.trace(landmarks.covariance, axis1=1, axis2=2) / 3.0)
    rows = np.column_stack([landmarks.p_world, sigmas]).astype("<f4")
    names = ("x", "y", "z", "sigma")
    fields = [
        m.PackedElementField(
            name=name, offset=_FLOAT_BYTES * k, type=m.PackedElementFieldNumericType.Float32
        )
        for k, name in enumerate(names)
    ]
    translation, rotation = _parts(np.eye(4))
    return m.PointCloud(
        timestamp=_stamp(time_ns),
        frame_id=frame,
        pose=m.Pose(position=translation, orientation=rotation),
        point_stride=_FLOAT_BYTES * len(names),
        fields=fields,
        data=rows.tobytes(),
    )
