"""How samples and ground truth of other files fit the frames of a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from vio.cameras.rig import Rectifier, Rig
from vio.errors import DataError
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.imu.clocks import judge_clocks
from vio.records import IntArray, Trajectory


def check_overlap(frame_times_ns: IntArray, times_ns: IntArray, where: Path | str) -> None:
    """Raise DataError where no sample lies within the time of the images."""
    if times_ns[-1] < frame_times_ns[0] or times_ns[0] > frame_times_ns[-1]:
        (finding,) = judge_clocks(frame_times_ns, times_ns)
        raise DataError(f"{where}: no sample is within the time of the images; {finding.message}; or remove it")


def reference_of_body(truth: Trajectory, rig: Rig, rectifier: Rectifier) -> Trajectory:
    """Return ground truth of the raw left camera or of the IMU as that of the run's body.

    Raises:
        CalibrationError: poses of the IMU cannot be used, as its place is unknown.
    """
    if rig.T_cam0_imu is not None:
        return truth.in_imu(rig.T_cam0_imu)
    if truth.body == "imu":
        # Without extrinsics IMU and camera cannot be distinguished; a TUM file without a comment is the camera's.
        truth = replace(truth, body="cam0")
    R_rect_cam0: FloatArray = rectifier.T_rect0_imu[:3, :3]
    return replace(truth, T_world_body=truth.T_world_body @ se3_inverse(se3_from_parts(R_rect_cam0, np.zeros(3))))
