"""KITTI odometry: the calibration files read, and the files of a sequence written.

KITTI's poses and `T_cam0_imu.txt` describe camera 0. Where the colour pair is used, the left camera
is camera 2, some 6 cm beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vio.dataclass import dataclass
from vio.datasets.common import check_intrinsics, naming, numbers_in
from vio.datasets.tables import VELOCITY_HEADER
from vio.errors import CalibrationError
from vio.files.text import exact_text, read_numbers, seconds_text, text_lines, write_text
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts
from vio.geometry.rectify import vertical_fault
from vio.geometry.stereo import StereoCamera
from vio.records import IntArray, VelocitySample

# allowed offset of the right camera from the left one's x axis, as a share of the baseline
RECTIFIED_SHARE = 0.02


@dataclass(frozen=True, slots=True)
class _Calibration:
    camera: StereoCamera  # without image size
    T_left_cam0: FloatArray  # (4, 4) from KITTI's camera 0 to the left camera used
    off_axis_m: float  # distance of the right camera from the left one's x axis


def read_calibration(path: Path, cameras: tuple[int, int]) -> _Calibration:
    """Read `P0: … P1: …` (12 numbers each, other lines are ignored) for a left and a right camera.

    Raises:
        CalibrationError: the file or a matrix is missing, malformed, or describes no rectified
            pair.
    """
    if not path.is_file():
        raise CalibrationError(
            f"{path} is missing; it holds the projection matrices P0 and P1 of the rectified pair"
        )
    left, right = (_projection(path, f"P{k}") for k in cameras)
    names = f"P{cameras[0]} and P{cameras[1]}"
    if not np.allclose(left[:, :3], right[:, :3], rtol=1e-6):
        raise CalibrationError(
            f"{path}: {names} differ in focal length or centre; the pair is not rectified"
        )
    K = left[:, :3]
    offsets = [np.linalg.solve(K, P[:, 3]) for P in (left, right)]
    x, y, z = offsets[0] - offsets[1]  # the right camera in the left camera's frame
    if (fault := vertical_fault(np.array([x, y, z]))) is not None:
        raise CalibrationError(f"{path}: {fault}")
    if not x > 0:
        raise CalibrationError(
            f"{path}: {names} imply a stereo baseline of {x:g} m; it must be positive (the right "
            "camera's fourth "
            "column is -focal * baseline), so check for equal or exchanged matrices"
        )
    off_axis = float(np.hypot(y, z))
    if off_axis > RECTIFIED_SHARE * x:
        raise CalibrationError(
            f"{path}: {names} put the right camera {off_axis:g} m off the left one's x axis; "
            "rectify"
        )
    with naming(path):
        camera = StereoCamera(
            float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), float(x)
        )
    return _Calibration(camera, se3_from_parts(np.eye(3), offsets[0]), off_axis)


def _projection(path: Path, name: str) -> FloatArray:
    """Read one projection matrix (3, 4) `K [I | t]`."""
    found = [
        (number, line.split(":", 1)[1])
        for number, line in text_lines(path)
        if line.startswith(f"{name}:")
    ]
    if len(found) != 1:
        raise CalibrationError(
            f"{path}: {len(found)} lines begin with '{name}:', and KITTI's calib.txt has one; give "
            "that file, or the "
            "calibration of another tool as .yaml or .xml"
        )
    number, values = found[0]
    where = f"{path}, line {number}: {name}"
    P = numbers_in(values, 12, where).reshape(3, 4)
    check_intrinsics(P[:, :3], where)
    return P


def read_extrinsics(path: Path) -> FloatArray | None:
    """Read `T_cam0_imu` from three or four lines of four numbers, or one line of 12."""
    if not path.is_file():
        return None
    lines = text_lines(path)
    columns = len(lines[0][1].split()) if lines else 0
    if (
        columns not in (4, 12)
        or (columns == 4 and len(lines) not in (3, 4))
        or (columns == 12 and len(lines) != 1)
    ):
        raise CalibrationError(
            f"{path}: expected three or four lines of four numbers, the transform from IMU to "
            "camera 0"
        )
    return checked_transform(read_numbers(path, columns).reshape(-1, 4), str(path))


# --- writing
# --------------------------------------------------------------------------------------------------


def write_calibration(folder: Path, camera: StereoCamera, T_cam0_imu: FloatArray | None) -> None:
    """Write `calib.txt` and, where the IMU's pose (4, 4) is known, `T_cam0_imu.txt`, with all
    digits.
    """
    P0 = np.column_stack([camera.K, np.zeros(3)])
    P1 = P0.copy()
    P1[0, 3] = -camera.fu * camera.baseline_m
    write_text(
        folder / "calib.txt", "".join(f"P{k}: {exact_text(P)}\n" for k, P in enumerate((P0, P1)))
    )
    if T_cam0_imu is not None:
        write_text(
            folder / "T_cam0_imu.txt", "".join(f"{exact_text(row)}\n" for row in T_cam0_imu[:3])
        )


def write_times(folder: Path, times_ns: IntArray) -> None:
    """Write `times.txt`: seconds since the first of the times (N,), exact to the nanosecond."""
    write_text(
        folder / "times.txt",
        "".join(f"{seconds_text(t)}\n" for t in (times_ns - times_ns[0]).tolist()),
    )


def write_velocity(folder: Path, samples: Sequence[VelocitySample], start_ns: int) -> None:
    """Write `velocity.csv` with all digits, in seconds since `start_ns`."""
    rows = (
        f"{seconds_text(s.time_ns - start_ns)},{exact_text([*s.linear, *s.angular], ',')}"
        for s in samples
    )
    write_text(folder / "velocity.csv", "\n".join([VELOCITY_HEADER, *rows]) + "\n")
