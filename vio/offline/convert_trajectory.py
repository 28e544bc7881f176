"""Write a trajectory in the form of TUM, KITTI or EuRoC."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from vio.datasets.image_times import time_lines
from vio.datasets.kitti import read_extrinsics
from vio.datasets.rigs import load_rig
from vio.errors import CalibrationError, DataError
from vio.files.stamps import POSE_PACE, parse_stamps
from vio.files.trajectories import (
    TrajectoryFormat,
    read_trajectory,
    write_euroc,
    write_kitti,
    write_tum,
)
from vio.geometry.lie import FloatArray
from vio.protocols import Dataset
from vio.records import BodyFrame, IntArray, Trajectory

logger = logging.getLogger(__name__)

_Writer: TypeAlias = Callable[[Path, Trajectory], None]
_WRITERS: dict[TrajectoryFormat, _Writer] = {
    "tum": write_tum,
    "kitti": write_kitti,
    "euroc": write_euroc,
}
_BODIES: dict[TrajectoryFormat, BodyFrame] = {"kitti": "cam0", "euroc": "imu"}


def convert_trajectory(
    source: Path,
    out: Path,
    form: TrajectoryFormat,
    *,
    times: Path | None = None,
    calibration: Path | None = None,
) -> Trajectory:
    """Write a trajectory file in another form; the world frame stays, the body becomes that of the
    form.

    Args:
        source: a TUM, KITTI or EuRoC trajectory.
        out: the file to write.
        form: "tum" (the body stays as it is), "kitti" (cam0) or "euroc" (IMU).
        times: of the poses of a KITTI file, one a line.
        calibration: a rig with the IMU's pose, or `T_cam0_imu.txt`, for a change between IMU and
            cam0.

    Returns:
        The trajectory as written.

    Raises:
        DataError: a file cannot be used, or times are missing.
        CalibrationError: the body changes, and the calibration does not say how.
    """
    trajectory = read_trajectory(source)
    if trajectory.orientations == "w first, assumed":  # of lines with commas, which have either
        logger.warning(
            "%s: does not state the order of its quaternions: they are read with w first; if w comes "
            "last, name the columns in its header (qx,qy,qz,qw)",
            source,
        )
    if times is not None:
        trajectory = replace(trajectory, times_ns=_read_times(times, len(trajectory)))
    if trajectory.times_ns is None and form != "kitti":
        raise DataError(
            f"{source}: states no times, which {form} form needs; name them with --times FILE, one "
            "a line"
        )
    body = _BODIES.get(form, trajectory.body)
    if trajectory.body != body:
        trajectory = _described_by(trajectory, body, source, calibration)
    _WRITERS[form](out, trajectory)
    return trajectory


def write_reference(dataset: Dataset, out: Path) -> Trajectory:
    """Write the ground truth of a recording in TUM form.

    Raises:
        DataError: there is none.
    """
    truth = dataset.recording.reference
    if truth is None:
        raise DataError(
            f"{dataset.recording.path}: has no ground truth to write as a TUM file; choose another "
            "--to"
        )
    write_tum(out, truth)
    return truth


def _described_by(
    trajectory: Trajectory, body: BodyFrame, source: Path, calibration: Path | None
) -> Trajectory:
    if calibration is None:
        raise CalibrationError(
            f"{source}: describes {trajectory.body}, not {body} as the form must; give "
            "--calibration FILE with the "
            f"IMU's pose, or say '# body: {body}' in a comment of its first lines (TUM) if that is "
            "what it describes"
        )
    T_cam0_imu = _extrinsics(calibration)
    if body == "cam0":
        return trajectory.in_cam0(T_cam0_imu)
    return trajectory.in_imu(T_cam0_imu)


def _extrinsics(path: Path) -> FloatArray:
    """Read `T_cam0_imu` (4, 4) of a rig, or from a file of the matrix alone."""
    if path.name == "T_cam0_imu.txt":
        T = read_extrinsics(path)
    else:
        T = load_rig(path).T_cam0_imu
    if T is None:
        raise CalibrationError(
            f"{path}: states no pose of the IMU; give a calibration with T_cam_imu"
        )
    return T


def _read_times(path: Path, count: int) -> IntArray:
    rows, stated = time_lines(path)
    if len(rows) != count:
        raise DataError(
            f"{path} holds {len(rows)} times for {count} poses; there must be one a line"
        )
    doubts = list[str]()
    times_ns = parse_stamps(
        [fields[0] for _, fields in rows],
        lambda k: f"{path}, line {rows[k][0]}",
        stated,
        pace=POSE_PACE,
        doubts=doubts,
    )
    for doubt in doubts:
        logger.warning("%s", doubt)
    return times_ns
