"""evo: the arrays of a `PoseTrajectory3D`.

evo is under the GPL and is not imported here: `PoseTrajectory3D(**to_evo(trajectory))` makes one,
and `from_evo` reads its properties. Quaternions are w x y z. Times are seconds as float64, which
at today's dates hold steps of 240 ns.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vio.errors import DataError
from vio.geometry.lie import FloatArray, quat_xyzw_from_rotation
from vio.records import NS_PER_S, BodyFrame, Trajectory


def to_evo(trajectory: Trajectory) -> dict[str, FloatArray]:
    """Return the arguments of `evo.core.trajectory.PoseTrajectory3D`.

    Raises:
        DataError: the poses have no times.
    """
    if trajectory.times_ns is None:
        raise DataError("poses without times are no PoseTrajectory3D of evo; give them times")
    xyzw = quat_xyzw_from_rotation(trajectory.T_world_body[:, :3, :3])
    return {
        "positions_xyz": trajectory.positions.copy(),
        "orientations_quat_wxyz": np.roll(xyzw, 1, axis=1),
        "timestamps": trajectory.times_ns / NS_PER_S,
    }


def from_evo(trajectory: Any, body: BodyFrame) -> Trajectory:
    """Return a `PoseTrajectory3D` as a trajectory; evo does not say what its poses describe."""
    times_ns = np.rint(np.asarray(trajectory.timestamps) * NS_PER_S).astype(np.int64)
    poses = np.array(trajectory.poses_se3, dtype=np.float64)
    return Trajectory(poses, times_ns, body)
