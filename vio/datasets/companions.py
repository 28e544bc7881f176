"""What is beside the images of a plain recording: calibration, motion samples, ground truth, and the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from vio.cameras.camera_rig import CameraRig, Undistorter
from vio.cameras.rig import Rectifier, Rig
from vio.datasets.common import naming
from vio.datasets.kitti import read_extrinsics
from vio.datasets.overlap import check_overlap, reference_of_body
from vio.datasets.rigs import find_calibration
from vio.datasets.samples import imu_samples, in_time_order
from vio.datasets.tables import read_imu_table, read_velocity_table
from vio.datasets.unused import Layout
from vio.errors import CalibrationError, DataError
from vio.files.trajectories import read_trajectory
from vio.records import NS_PER_S, IntArray, MotionSample, MotionSource, Trajectory

AnyRig = TypeVar("AnyRig", Rig, CameraRig)
IMU_FILES = ("imu.csv", "imu.txt", "imu0.csv", "imu_data.csv", "imu0/data.csv")
_REFERENCES = (
    "reference.tum",
    "reference.txt",
    "groundtruth.tum",
    "groundtruth_tum.txt",
    "groundtruth.txt",
    "gt_imu.csv",
    "mocap0/data.csv",
    "state_groundtruth_estimate0/data.csv",
    "poses.txt",
)
_CALIBRATION_FOLDERS = ("", "dso", "calibration", "calib")


def calibration_beside(layout: Layout) -> Path | None:
    """Return the calibration file of a recording; None: there is none."""
    above = [layout.root.parent] if layout.root.name == "mav0" else []
    for base in dict.fromkeys((layout.root, layout.base, *above)):
        for inside in _CALIBRATION_FOLDERS:
            if (base / inside).is_dir() and (found := find_calibration(base / inside)) is not None:
                return found
    return None


def find_calibration_of(layout: Layout) -> Path:
    """Return the calibration file of a recording.

    Raises:
        CalibrationError: there is none; the message names the known forms.
    """
    if (found := calibration_beside(layout)) is not None:
        return found
    raise CalibrationError(
        f"{layout.root}: no calibration; add one as calibration.yaml (Kalibr's camchain, OpenCV's M1 D1 M2 D2 R T), "
        "calib.txt (KITTI's) or another that vio.load_rig reads, or name it with --calibration FILE"
    )


def with_extrinsics(rig: AnyRig, layout: Layout, file: Path) -> tuple[AnyRig, list[Path]]:
    """Add `T_cam0_imu.txt` where the calibration itself has none."""
    path = layout.root / "T_cam0_imu.txt"
    if rig.T_cam0_imu is not None or not path.is_file():
        return rig, [path] if file.name == "calib.txt" else []
    return replace(rig, T_cam0_imu=read_extrinsics(path)), [path]


def read_motion(
    layout: Layout, rig: Rig | CameraRig, times_ns: IntArray, timed: bool
) -> tuple[Sequence[MotionSample], list[Path], list[str]]:
    """Read the IMU and the velocities, on the clock of the images; return the samples, their files and notes."""
    imu = next((f for base in (layout.root, layout.base) for n in IMU_FILES if (f := base / n).is_file()), None)
    velocity = layout.root / "velocity.csv"
    files = [f for f in (imu, velocity) if f is not None and f.is_file()]
    if not files:
        return (), [], []
    if not timed:
        raise DataError(f"{files[0]}: needs the times of the images on the same clock; add times.txt, or remove it")
    if rig.T_cam0_imu is None:
        raise CalibrationError(
            f"{files[0]}: needs the pose of its sensor; add T_cam0_imu.txt (IMU to left camera), or use a calibration "
            "with T_cam_imu (Kalibr's camchain-imucam), or remove the file to use the images alone"
        )
    parts: list[Sequence[MotionSample]] = []
    notes: list[str] = []
    if imu is not None:
        record, found = read_imu_table(imu)
        shift_ns = round(rig.time_offset_s * NS_PER_S)
        record = replace(record, times_ns=record.times_ns - shift_ns)
        notes += found
        if shift_ns:
            notes.append(f"the IMU's stamps are moved by {-1e3 * rig.time_offset_s:+.3f} ms, as the calibration states")
        check_overlap(times_ns, record.times_ns, imu)
        parts.append(imu_samples(record))
    if velocity.is_file():
        speeds = read_velocity_table(velocity)
        check_overlap(times_ns, speeds.times_ns, velocity)
        parts.append(speeds)
    return in_time_order(*parts), files, notes


def sources_of(files: Sequence[Path]) -> frozenset[MotionSource]:
    """Return the kinds of motion samples that files hold."""
    return frozenset("velocity" if file.name == "velocity.csv" else "imu" for file in files)


def read_reference(
    layout: Layout, rig: Rig | CameraRig, rectifier: Rectifier | Undistorter, times_ns: IntArray
) -> tuple[Trajectory | None, Path | None]:
    """Read the ground truth as that of the body: the IMU, or the rectified left camera where there is none."""
    bases = (layout.root, layout.base, layout.root / "dso")
    file = next((f for n in _REFERENCES for base in bases if (f := base / n).is_file()), None)
    if file is None:
        return None, None
    truth = read_trajectory(file)
    if truth.times_ns is None:
        if len(truth) > len(times_ns):
            raise DataError(f"{file} holds {len(truth)} poses for {len(times_ns)} pairs; give one line for each pair")
        truth = replace(truth, times_ns=times_ns[: len(truth)], frame_indices=np.arange(len(truth)))
    with naming(file):
        return reference_of_body(truth, rig, rectifier), file


# --- what is not used -----------------------------------------------------------------------------------------------
