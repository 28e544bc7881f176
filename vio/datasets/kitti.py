"""KITTI odometry folders: the official layout, and a self-contained one with motion and extrinsics.

Official: `sequences/NN/` with `image_0 image_1 calib.txt times.txt` (and `image_2 image_3` in colour), poses in
`../../poses/NN.txt`. Self-contained: the same folder with, when present, `poses.txt`, `velocity.csv` (body velocity
and angular rate in the IMU frame) and `T_cam0_imu.txt`.

KITTI's poses and `T_cam0_imu.txt` describe camera 0. Where the colour pair is used, the left camera is camera 2, some
6 cm beside it, and this reader's cam0 is the camera used: both are transformed to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vio.datasets.common import check_intrinsics, clock_ns, naming, numbers_in
from vio.datasets.image_pairs import ImageDataset, ImageSize, measured_images, pair_images
from vio.datasets.settings import DatasetSettings
from vio.datasets.tables import VELOCITY_HEADER, read_velocity_table
from vio.datasets.unused import Layout, unused_note
from vio.errors import CalibrationError, DataError
from vio.files.text import exact_text, read_numbers, seconds_text, text_lines, write_text
from vio.files.trajectories import read_trajectory
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts, se3_inverse
from vio.geometry.stereo import StereoCamera
from vio.records import IntArray, Recording, Trajectory, VelocitySample

_GRAY, _COLOUR = (0, 1), (2, 3)
_RECTIFIED = 0.02  # allowed offset of the right camera from the left one's x axis, as a share of the baseline
_OFF_AXIS_NOTE_M = 1e-3  # an offset from that axis above this is noted


@dataclass(frozen=True, slots=True)
class _Calibration:
    camera: StereoCamera  # without image size
    T_left_cam0: FloatArray  # (4, 4) from KITTI's camera 0 to the left camera used
    off_axis_m: float  # distance of the right camera from the left one's x axis


def read_kitti(path: Path, settings: DatasetSettings) -> ImageDataset:
    """Read a KITTI odometry folder.

    Raises:
        DataError: files are missing, counts differ or a clock is wrong; the message names file and remedy.
        CalibrationError: the calibration is missing or invalid.
    """
    cameras = _choose_cameras(path, settings.colour)
    calibration = read_calibration(path / "calib.txt", cameras)
    pairs = pair_images(*(path / f"image_{k}" for k in cameras))
    times_ns = _read_times(path / "times.txt", path / f"image_{cameras[0]}", len(pairs))
    measured, (width, height), white, depth_notes = measured_images(pairs)
    size = ImageSize(width, height, measured)
    motion = _read_velocity(path / "velocity.csv", times_ns)
    T_cam0_imu = read_extrinsics(path / "T_cam0_imu.txt")
    if motion and T_cam0_imu is None:
        raise CalibrationError(
            f"{path}: velocity.csv needs T_cam0_imu.txt, the transform from the IMU to camera 0; add it, or "
            "remove velocity.csv to use the images alone"
        )
    notes = list(depth_notes)
    if calibration.off_axis_m > _OFF_AXIS_NOTE_M:
        notes.append(
            f"the camera of image_{cameras[1]} is {1e3 * calibration.off_axis_m:.1f} mm off the x axis of that of "
            f"image_{cameras[0]}; the pair is treated as rectified anyway"
        )
    layout = Layout(path, path, *(path / f"image_{k}" for k in cameras))
    poses = _poses_file(path)
    used = [path / name for name in ("calib.txt", "times.txt", "velocity.csv", "T_cam0_imu.txt")]
    notes += unused_note(layout, used if poses is None else [*used, poses])
    recording = Recording(
        kind="kitti",
        path=path,
        camera=replace(calibration.camera, width=size.width, height=size.height),
        T_cam0_imu=None if T_cam0_imu is None else calibration.T_left_cam0 @ T_cam0_imu,
        frame_times_ns=times_ns,
        has_images=True,
        motion=frozenset({"velocity"}) if motion else frozenset(),
        reference=None if poses is None else _read_reference(poses, times_ns, calibration.T_left_cam0),
        notes=tuple(notes),
    )
    return ImageDataset(recording, motion, (size, size), settings, pairs, white=white)


def is_kitti_folder(path: Path) -> bool:
    """Return whether a folder looks like a KITTI sequence."""
    return any((path / f"image_{k}").is_dir() for k in range(4))


def _choose_cameras(path: Path, colour: bool | None) -> tuple[int, int]:
    wanted = [_GRAY, _COLOUR] if colour is None else [_COLOUR] if colour else [_GRAY]
    for cameras in wanted:
        if (path / f"image_{cameras[0]}").is_dir() and (path / f"image_{cameras[1]}").is_dir():
            return cameras
    looked = " or ".join(f"image_{a} with image_{b}" for a, b in wanted)
    hint = "" if colour is None else f" (dataset.colour is {str(colour).lower()})"
    raise DataError(f"{path}: holds no {looked}{hint}; give a KITTI odometry folder with both images of each pair")


def read_calibration(path: Path, cameras: tuple[int, int]) -> _Calibration:
    """Read `P0: … P1: …` (12 numbers each, other lines are ignored) for a left and a right camera.

    Raises:
        CalibrationError: the file or a matrix is missing, malformed, or describes no rectified pair.
    """
    if not path.is_file():
        raise CalibrationError(f"{path} is missing; it holds the projection matrices P0 and P1 of the rectified pair")
    left, right = (_projection(path, f"P{k}") for k in cameras)
    names = f"P{cameras[0]} and P{cameras[1]}"
    if not np.allclose(left[:, :3], right[:, :3], rtol=1e-6):
        raise CalibrationError(f"{path}: {names} differ in focal length or centre; the pair is not rectified")
    K = left[:, :3]
    offsets = [np.linalg.solve(K, P[:, 3]) for P in (left, right)]
    x, y, z = offsets[0] - offsets[1]  # the right camera in the left camera's frame
    if not x > 0:
        raise CalibrationError(
            f"{path}: {names} imply a stereo baseline of {x:g} m; it must be positive (the right camera's fourth "
            "column is -focal * baseline), so check for equal or exchanged matrices"
        )
    off_axis = float(np.hypot(y, z))
    if off_axis > _RECTIFIED * x:
        raise CalibrationError(
            f"{path}: {names} put the right camera {off_axis:g} m off the left one's x axis; rectify"
        )
    with naming(path):
        camera = StereoCamera(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), float(x))
    return _Calibration(camera, se3_from_parts(np.eye(3), offsets[0]), off_axis)


def _projection(path: Path, name: str) -> FloatArray:
    """Read one projection matrix (3, 4) `K [I | t]`."""
    found = [(number, line.split(":", 1)[1]) for number, line in text_lines(path) if line.startswith(f"{name}:")]
    if len(found) != 1:
        raise CalibrationError(
            f"{path}: {len(found)} lines begin with '{name}:', and KITTI's calib.txt has one; give that file, or the "
            "calibration of another tool as .yaml or .xml"
        )
    number, values = found[0]
    where = f"{path}, line {number}: {name}"
    P = numbers_in(values, 12, where).reshape(3, 4)
    check_intrinsics(P[:, :3], where)
    return P


def _read_times(path: Path, folder: Path, count: int) -> IntArray:
    if not path.is_file():
        raise DataError(f"{path} is missing; it holds one time in seconds for each image")
    seconds = read_numbers(path, 1)[:, 0]
    if len(seconds) != count:
        raise DataError(
            f"{path} holds {len(seconds)} times and {folder} {count} images; there must be one time an image"
        )
    return clock_ns(seconds, lambda k: f"{path}, line {k + 1}")


def _read_velocity(path: Path, frame_times_ns: IntArray) -> Sequence[VelocitySample]:
    if not path.is_file():
        return ()
    samples = read_velocity_table(path)
    if samples.times_ns[-1] < frame_times_ns[0] or samples.times_ns[0] > frame_times_ns[-1]:
        raise DataError(
            f"{path}: no velocity is within the time of the images (times.txt); use the same clock for both"
        )
    return samples


def read_extrinsics(path: Path) -> FloatArray | None:
    """Read `T_cam0_imu` from three or four lines of four numbers, or one line of 12."""
    if not path.is_file():
        return None
    lines = text_lines(path)
    columns = len(lines[0][1].split()) if lines else 0
    if columns not in (4, 12) or (columns == 4 and len(lines) not in (3, 4)) or (columns == 12 and len(lines) != 1):
        raise CalibrationError(
            f"{path}: expected three or four lines of four numbers, the transform from IMU to camera 0"
        )
    return checked_transform(read_numbers(path, columns).reshape(-1, 4), str(path))


def _poses_file(path: Path) -> Path | None:
    """Return the ground truth of a folder, or of a sequence of KITTI's own; None: there is none."""
    absolute = path.absolute()
    candidates = [path / "poses.txt", absolute.parent.parent / "poses" / f"{absolute.name}.txt"]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _read_reference(file: Path, times_ns: IntArray, T_left_cam0: FloatArray) -> Trajectory:
    """Read the ground truth of camera 0 and move it, and the world, to the left camera; identity stays identity."""
    poses = read_trajectory(file, fmt="kitti").T_world_body
    if len(poses) > len(times_ns):
        raise DataError(f"{file} holds {len(poses)} poses for {len(times_ns)} images; give one line for each image")
    moved = T_left_cam0 @ poses @ se3_inverse(T_left_cam0) if np.any(T_left_cam0 != np.eye(4)) else poses
    return Trajectory(moved, times_ns[: len(poses)], "cam0", np.arange(len(poses)))


# --- writing --------------------------------------------------------------------------------------------------------


def write_calibration(folder: Path, camera: StereoCamera, T_cam0_imu: FloatArray | None) -> None:
    """Write `calib.txt` and, where the IMU's pose (4, 4) is known, `T_cam0_imu.txt`, with all digits."""
    P0 = np.column_stack([camera.K, np.zeros(3)])
    P1 = P0.copy()
    P1[0, 3] = -camera.fu * camera.baseline_m
    write_text(folder / "calib.txt", "".join(f"P{k}: {exact_text(P)}\n" for k, P in enumerate((P0, P1))))
    if T_cam0_imu is not None:
        write_text(folder / "T_cam0_imu.txt", "".join(f"{exact_text(row)}\n" for row in T_cam0_imu[:3]))


def write_times(folder: Path, times_ns: IntArray) -> None:
    """Write `times.txt`: seconds since the first of the times (N,), exact to the nanosecond."""
    write_text(folder / "times.txt", "".join(f"{seconds_text(t)}\n" for t in (times_ns - times_ns[0]).tolist()))


def write_velocity(folder: Path, samples: Sequence[VelocitySample], start_ns: int) -> None:
    """Write `velocity.csv` with all digits, in seconds since `start_ns`."""
    rows = (f"{seconds_text(s.time_ns - start_ns)},{exact_text([*s.linear, *s.angular], ',')}" for s in samples)
    write_text(folder / "velocity.csv", "\n".join([VELOCITY_HEADER, *rows]) + "\n")
