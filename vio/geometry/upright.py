"""The upright view of a run: which way is up, and which is ahead, in its world frame."""

from __future__ import annotations

import numpy as np

from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, so3_exp

# horizontal part of the first optical axis below which the camera looks up or down: the path then
# leads
_LEVEL = 0.1


def upright_axes(T_world_cam0: FloatArray, up_world: FloatArray | None = None) -> FloatArray:
    """Return the rotation (3, 3) whose rows are right, ahead and up in the world frame, at the
    first camera pose.

    Args:
        T_world_cam0: poses (N, 4, 4) of the left camera.
        up_world: (3,) opposite to gravity where it is known; None: cameras are mounted upright, so
            the upper edge of the first image shows.
    """
    first = T_world_cam0[0]
    if up_world is None:
        up = -first[:3, 1]
    else:
        up = np.asarray(up_world, dtype=np.float64)
    up = up / np.linalg.norm(up)
    towards_end = T_world_cam0[-1, :3, 3] - first[:3, 3]
    for ahead in (first[:3, 2], towards_end, *np.eye(3)):
        level = ahead - up * (up @ ahead)
        if np.linalg.norm(level) > _LEVEL * max(float(np.linalg.norm(ahead)), 1e-9):
            break
    level = level / np.linalg.norm(level)
    return np.stack([np.cross(level, up), level, up])


def upright_view(
    T_world_body: FloatArray,
    T_cam0_body: FloatArray,
    motion: str | None,
    gravity_world: FloatArray | None = None,
) -> FloatArray:
    """Return the transform (4, 4) from the world of a run to right, ahead and up at its first pose.

    Args:
        T_world_body: poses (N, 4, 4) of the run.
        T_cam0_body: (4, 4) of its body in the left camera.
        motion: see `up_of`.
        gravity_world: see `up_of`.
    """
    R = upright_axes(T_world_body @ se3_inverse(T_cam0_body), up_of(motion, gravity_world))
    return se3_from_parts(R, -R @ T_world_body[0, :3, 3])


def rotated(R: FloatArray, P: FloatArray) -> FloatArray:
    """Return covariances (..., 3, 3) in a frame that R (..., 3, 3) takes the vectors to.

    With `T_world_body = T_hat exp(-xi)`, an error of the body's pose moves its position by R rho in
    the world.
    """
    return R @ P @ np.swapaxes(R, -1, -2)


def up_of(motion: str | None, gravity_world: FloatArray | None) -> FloatArray | None:
    """Return the up direction (3,) of a run's world frame; None where only an IMU could tell and
    there was none.

    Args:
        motion: the run's motion input; with an IMU the world began upright, z up.
        gravity_world: (3,) of the newest estimate, where gravity is known better than that.
    """
    if gravity_world is not None and np.isfinite(gravity_world).all():
        return -np.asarray(gravity_world, dtype=np.float64)
    return np.array([0.0, 0.0, 1.0]) if motion == "imu" else None


def attitude_deg(R_view_cam0: FloatArray) -> FloatArray:
    """Return heading, pitch and roll (N, 3) of cameras (N, 3, 3) in the upright frame, degrees;
    heading is unwrapped.

    Heading is that of the optical axis, to the right of ahead; pitch its elevation; roll turns the
    right side down.
    """
    ahead = R_view_cam0[:, :, 2]
    right = R_view_cam0[:, :, 0]
    up = -R_view_cam0[:, :, 1]
    heading = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 1]))
    pitch = np.arcsin(np.clip(ahead[:, 2], -1, 1))
    roll = np.arctan2(-right[:, 2], up[:, 2])
    return np.degrees(np.stack([heading, pitch, roll], axis=1))


def rotation_to_up(up: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) that takes a unit vector (3,) to the z axis, by the shortest
    turn.
    """
    axis = np.cross(up, [0.0, 0.0, 1.0])
    s = float(np.linalg.norm(axis))
    c = float(up[2])
    if s < 1e-9:
        if c > 0:
            return np.eye(3)
        return so3_exp([np.pi, 0.0, 0.0])
    return so3_exp(axis / s * np.arctan2(s, c))


def mean_up(up: FloatArray, sigma_rad: FloatArray) -> FloatArray:
    """Return the direction (3,) that verticals (N, 3) with standard deviations (N,) say in the
    mean.
    """
    total: FloatArray = (up / np.maximum(sigma_rad, 1e-6)[:, None] ** 2).sum(axis=0)
    return total / np.linalg.norm(total)


def up_in(T_map: FloatArray, T_world: FloatArray, up_world: FloatArray) -> FloatArray:
    """Return the mean direction (3,) that is up in a map, by poses (N, 4, 4) there and the same in
    the world of a run.

    Args:
        T_map: in the map.
        T_world: the same in the world of the run.
        up_world: (3,).
    """
    up: FloatArray = (T_map[:, :3, :3] @ np.swapaxes(T_world[:, :3, :3], 1, 2) @ up_world).sum(
        axis=0
    )
    return up / np.linalg.norm(up)


def nearest_yaw(M: FloatArray) -> float:
    """Return the angle of the turn about z that is nearest to a matrix (3, 3), a rotation or a
    sum of some.
    """
    sine = M[1, 0] - M[0, 1]
    cosine = M[0, 0] + M[1, 1]
    return float(np.arctan2(sine, cosine))


def yaw_and_position(T: FloatArray, T_other: FloatArray) -> FloatArray:
    """Return the motion (4, 4) of an upright world that brings a pose (4, 4) in it nearest to one
    in another, T.

    It is a turn about the vertical and a shift: what two upright worlds may differ by.
    """
    yaw_rad = nearest_yaw(T[:3, :3] @ T_other[:3, :3].T)
    R = so3_exp(np.array([0.0, 0.0, yaw_rad]))
    return se3_from_parts(R, T[:3, 3] - R @ T_other[:3, 3])
