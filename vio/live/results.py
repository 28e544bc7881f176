"""The files of a live trajectory: they grow as the poses come, so that a process that dies leaves
them.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import DataError, VioError
from vio.files.atomic import atomic_write_text, open_own
from vio.files.trajectories import tum_text, write_tum
from vio.geometry.lie import FloatArray
from vio.live.live_odometry import LiveOdometry
from vio.records import BodyFrame, Trajectory

_TRAJECTORY = "trajectory.tum"
_FLUSH_S = 1.0


def live_body(odometry: LiveOdometry) -> BodyFrame:
    """Return whose poses an odometry estimates."""
    return "imu" if odometry.motion == "imu" else "cam0"


def live_trajectory(odometry: LiveOdometry, poses: Sequence[tuple[int, FloatArray]]) -> Trajectory:
    """Return times in ns and poses (4, 4), one at least, as the trajectory of an odometry's
    body.
    """
    times = np.array([time_ns for time_ns, _ in poses], dtype=np.int64)
    return Trajectory(np.array([T for _, T in poses]), times, live_body(odometry))


class GrowingTrajectory:
    """`trajectory.tum` in a folder, a second behind the poses at most.

    An earlier trajectory, of before a reset or of another process, keeps its poses as
    `trajectory-N.tum`.
    """

    def __init__(self, folder: Path, body: BodyFrame) -> None:
        """Prepare; files begin with the first pose."""
        self._folder = folder
        self._body = body
        self._stream: BinaryIO | None = None
        self._flushed_s = 0.0

    def add(self, time_ns: int, T_world_body: FloatArray) -> None:
        """Take a pose.

        Raises:
            DataError: the folder cannot be written.
        """
        try:
            begins = self._stream is None
            stream = self._stream or self._begin()
            text = tum_text(
                np.array([time_ns]), T_world_body[None], body=self._body if begins else None
            )
            stream.write(text.encode())
            if time.monotonic() - self._flushed_s > _FLUSH_S:
                self.flush()
        except OSError as error:
            raise DataError(f"cannot write {self.path}: {error.strerror or error}") from error

    @property
    def path(self) -> Path:
        """The file of the present trajectory."""
        return self._folder / _TRAJECTORY

    @property
    def has_poses(self) -> bool:
        """Whether the present trajectory has a pose."""
        return self._stream is not None

    def flush(self) -> None:
        """Bring all poses to the disk."""
        if self._stream is not None:
            self._stream.flush()
            os.fsync(self._stream.fileno())
        self._flushed_s = time.monotonic()

    def close(self) -> None:
        """End the trajectory; the next pose begins another."""
        if self._stream is not None:
            self.flush()
            self._stream.close()
            self._stream = None

    def _begin(self) -> BinaryIO:
        self._folder.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            numbers = itertools.count(1)
            names = (self._folder / f"trajectory-{n}.tum" for n in numbers)
            self.path.rename(next(name for name in names if not name.exists()))
        self._stream = open_own(self.path, "wb")
        return self._stream


def write_calibration(folder: Path, odometry: LiveOdometry) -> None:
    """Write the calibration as `camchain-imucam.yaml`, once it is estimated.

    Raises:
        DataError: the folder cannot be written.
    """
    try:
        text = kalibr_text(odometry.calibrated_rig().rig)
    except VioError:  # of a rig that no calibration file holds
        return
    folder.mkdir(parents=True, exist_ok=True)
    atomic_write_text(folder / "camchain-imucam.yaml", text)


def write_results(
    folder: Path, odometry: LiveOdometry, poses: Sequence[tuple[int, FloatArray]]
) -> None:
    """Write `trajectory.tum` and, once it is estimated, the calibration as `camchain-imucam.yaml`.

    Raises:
        DataError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_tum(folder / _TRAJECTORY, live_trajectory(odometry, poses))
    write_calibration(folder, odometry)
