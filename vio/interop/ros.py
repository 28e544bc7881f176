"""ROS 1 and 2: `geometry_msgs/PoseWithCovariance`.

Its covariance is that of x y z and of rotations about the fixed axes x y z of the frame in which
the pose is given, not those of the body. Reference: the definition of the message.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vio.geometry.lie import (
    FloatArray,
    checked_transform,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
    se3_from_parts,
)
from vio.interop.loading import checked_covariance, package

_PACKAGE = "geometry_msgs/msg/"
_NAMES = ("Point", "Quaternion", "Pose", "PoseWithCovariance")


def to_fixed_axes_covariance(T_world_body: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of x y z and of rotations about the world's axes.

    Args:
        T_world_body: (4, 4).
        covariance: (6, 6) of xi on the body's side, [rho; phi].

    To first order xi moves the position by R rho and the orientation by R phi about the world's
    axes; R is the rotation of T_world_body.
    """
    turn = np.kron(np.eye(2), np.asarray(T_world_body, dtype=np.float64)[:3, :3])
    return turn @ checked_covariance(covariance) @ turn.T


def from_fixed_axes_covariance(T_world_body: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of xi on the body's side, of one about the world's axes."""
    turn = np.kron(np.eye(2), np.asarray(T_world_body, dtype=np.float64)[:3, :3].T)
    return turn @ checked_covariance(covariance) @ turn.T


def to_pose_with_covariance(
    T_world_body: FloatArray,
    covariance: FloatArray,
    types: Mapping[str, Callable[..., Any]] | None = None,
) -> Any:
    """Return a pose (4, 4) and its covariance (6, 6) as a `PoseWithCovariance`.

    Args:
        T_world_body: the pose.
        covariance: of xi on the body's side.
        types: classes by name (`geometry_msgs/msg/Pose`), as `types` of a type store of rosbags;
            None: those of the installed ROS.

    Raises:
        MissingDependencyError: there are no types, and no ROS is installed.
    """
    T = checked_transform(T_world_body, "pose")
    point, quaternion, pose, whole = _types(types)
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = quat_xyzw_from_rotation(T[:3, :3]).tolist()
    return whole(
        pose=pose(position=point(x=x, y=y, z=z), orientation=quaternion(x=qx, y=qy, z=qz, w=qw)),
        covariance=to_fixed_axes_covariance(T, covariance).ravel(),
    )


def from_pose_with_covariance(message: Any) -> tuple[FloatArray, FloatArray]:
    """Return the pose (4, 4) of a `PoseWithCovariance`, and the covariance (6, 6) of xi on the
    body's side.
    """
    p = message.pose.position
    q = message.pose.orientation
    R = rotation_from_quat_xyzw([q.x, q.y, q.z, q.w])
    T = checked_transform(se3_from_parts(R, [p.x, p.y, p.z]), "PoseWithCovariance")
    stated = np.asarray(message.covariance, dtype=np.float64).reshape(6, 6)
    return T, from_fixed_axes_covariance(T, stated)


def _types(types: Mapping[str, Callable[..., Any]] | None) -> list[Callable[..., Any]]:
    if types is not None:
        return [types[_PACKAGE + name] for name in _NAMES]
    module = package("geometry_msgs.msg", "rosbags (and give types), or source a ROS installation")
    return [getattr(module, name) for name in _NAMES]
