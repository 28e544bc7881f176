"""The files of a live trajectory."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import VioError
from vio.files.atomic import atomic_write_text
from vio.files.trajectories import write_tum
from vio.geometry.lie import FloatArray
from vio.live.live_odometry import LiveOdometry
from vio.records import BodyFrame, Trajectory


def live_trajectory(odometry: LiveOdometry, poses: Sequence[tuple[int, FloatArray]]) -> Trajectory:
    """Return times in ns and poses (4, 4), one at least, as the trajectory of an odometry's
    body.
    """
    body: BodyFrame = "imu" if odometry.motion == "imu" else "cam0"
    times = np.array([time_ns for time_ns, _ in poses], dtype=np.int64)
    return Trajectory(np.array([T for _, T in poses]), times, body)


def write_results(
    folder: Path, odometry: LiveOdometry, poses: Sequence[tuple[int, FloatArray]]
) -> None:
    """Write `trajectory.tum` and, once it is estimated, the calibration as `camchain-imucam.yaml`.

    Raises:
        DataError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_tum(folder / "trajectory.tum", live_trajectory(odometry, poses))
    with contextlib.suppress(VioError):  # of a rig that no calibration file holds
        atomic_write_text(
            folder / "camchain-imucam.yaml", kalibr_text(odometry.calibrated_rig().rig)
        )
