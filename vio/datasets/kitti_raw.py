"""KITTI raw drives: gray images of cameras 00 and 01 with KITTI's three calibration files.

`DRIVE/image_00/data/0000000000.png`, `DRIVE/image_01/data/…`, and `calib_cam_to_cam.txt calib_velo_to_cam.txt
calib_imu_to_velo.txt` in the drive or a folder above it, as KITTI lays them out by date. The drives named `_extract`
are unrectified: they are rectified as they are read, with rotations computed here (`R_rect_00` and `P_rect_00` belong
to KITTI's). The drives named `_sync` are rectified already, and used with `P_rect_00`, `P_rect_01` and `R_rect_00`; the
image size distinguishes the two.

In KITTI's files `R_0k`, `T_0k` map coordinates of camera 0 to camera k. The IMU's record (`oxts`) is not read.
Reference: Geiger et al., Vision meets robotics: the KITTI dataset (2013).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vio.cameras.rig import Rectifier, rectifier_of
from vio.datasets.common import check_intrinsics, image_size, naming, numbers_in
from vio.datasets.image_pairs import ImagePairs, ImageSize, first_readable, full_scale, pair_images
from vio.datasets.rectified import RectifiedDataset
from vio.datasets.settings import DatasetSettings
from vio.datasets.tables import drive_times
from vio.datasets.unused import Layout, unused_note
from vio.errors import CalibrationError, DataError
from vio.files.text import text_lines
from vio.geometry.distortion import CameraModel, DistortionModel, StereoRig
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts, se3_inverse
from vio.records import IntArray, Recording

CAMERAS = "calib_cam_to_cam.txt"
VELO = "calib_velo_to_cam.txt"
IMU = "calib_imu_to_velo.txt"
_FRAME_NS = 100_000_000
_MAX_PARENTS = 3


@dataclass(frozen=True, slots=True)
class KittiRawCalibration:
    """The calibration of the gray pair, raw and as KITTI rectified it."""

    cam0: CameraModel  # raw
    cam1: CameraModel  # raw
    T_cam1_cam0: FloatArray  # (4, 4) between the raw cameras
    rect0: CameraModel  # of the rectified images, pinhole
    rect1: CameraModel
    T_rect1_rect0: FloatArray  # (4, 4)
    R_rect_cam0: FloatArray  # (3, 3) from the raw to the rectified left camera
    R_rect_cam1: FloatArray  # (3, 3)


def is_kitti_raw_folder(path: Path) -> bool:
    """Return whether a folder looks like a KITTI raw drive."""
    return (path / "image_00").is_dir()


def read_kitti_raw(path: Path, settings: DatasetSettings) -> RectifiedDataset:
    """Read the gray pair of a KITTI raw drive.

    Raises:
        DataError: images are missing, counts differ or a clock is wrong; the message names file and remedy.
        CalibrationError: the calibration is missing or invalid.
    """
    for name in ("image_00", "image_01"):
        if not (path / name / "data").is_dir():
            raise DataError(
                f"{path}: holds no {name}/data; give a KITTI raw drive with image_00/data and image_01/data"
            )
    pairs = pair_images(path / "image_00" / "data", path / "image_01" / "data")
    calibration_path = _find(path, CAMERAS)
    if calibration_path is None:
        raise CalibrationError(
            f"{path}: {CAMERAS} is neither there nor in the folders above; copy KITTI's calibration of that day there"
        )
    calibration = read_cam_to_cam(calibration_path)
    T_cam0_imu, imu_notes = read_imu_pose(path)
    numbers = _frame_numbers(pairs)
    times_ns, time_notes = _read_times(path / "image_00" / "timestamps.txt", numbers)
    rectifier = _rectifier(calibration, T_cam0_imu, pairs, settings, calibration_path)
    white, depth_notes = full_scale(pairs)
    layout = Layout(path, path, path / "image_00" / "data", path / "image_01" / "data")
    twin = path / "image_01" / "timestamps.txt"  # both cameras have one trigger: those of the left one serve
    used = [calibration_path, path / "image_00" / "timestamps.txt", twin, _find(path, VELO), _find(path, IMU)]
    unused = unused_note(layout, [file for file in used if file is not None])
    recording = Recording(
        kind="kitti_raw",
        path=path,
        camera=rectifier.camera,
        T_cam0_imu=None if T_cam0_imu is None else rectifier.T_rect0_imu,
        frame_times_ns=times_ns,
        has_images=True,
        motion=frozenset(),
        reference=None,
        notes=(*time_notes, *imu_notes, *depth_notes, *rectifier.notes, *unused),
    )
    cameras = (rectifier.rig.cam0, rectifier.rig.cam1)
    sizes = tuple(ImageSize(camera.width, camera.height, calibration_path) for camera in cameras)
    return RectifiedDataset(recording, (), sizes, settings, pairs, rectifier, white=white)


def _find(path: Path, name: str) -> Path | None:
    """Find a calibration file in a folder or its parents."""
    absolute = path.absolute()
    folders = [absolute, *absolute.parents[:_MAX_PARENTS]]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def _rectifier(
    calibration: KittiRawCalibration,
    T_cam0_imu: FloatArray | None,
    pairs: ImagePairs,
    settings: DatasetSettings,
    where: Path,
) -> Rectifier:
    """Build the rectifier of raw images; images of the rectified size pass through unchanged."""
    c = calibration
    T_imu_cam0 = np.eye(4) if T_cam0_imu is None else se3_inverse(T_cam0_imu)
    raw, rectified = (c.cam0.width, c.cam0.height), (c.rect0.width, c.rect0.height)
    size = first_readable(pairs)[1].shape[::-1]
    if size == rectified and raw != rectified:
        T_imu_rect0 = T_imu_cam0 @ se3_from_parts(c.R_rect_cam0.T, np.zeros(3))
        rig = StereoRig(c.rect0, c.rect1, T_imu_rect0, T_imu_rect0 @ se3_inverse(c.T_rect1_rect0))
    elif size == raw:
        rig = StereoRig(c.cam0, c.cam1, T_imu_cam0, T_imu_cam0 @ se3_inverse(c.T_cam1_cam0))
    else:
        raise DataError(
            f"{pairs[0][0].parent}: images are {size[0]} x {size[1]} pixels but {where} is for {raw[0]} x {raw[1]} "
            f"(raw) or {rectified[0]} x {rectified[1]} (rectified); give the calibration of these images"
        )
    with naming(where):
        return rectifier_of(rig, settings.interpolation, settings.projection)


# --- calibration ----------------------------------------------------------------------------------------------------


def read_cam_to_cam(path: Path) -> KittiRawCalibration:
    """Read the gray pair's entries of `calib_cam_to_cam.txt`.

    Raises:
        CalibrationError: an entry is missing, malformed or impossible.
    """
    entries = _read_entries(path)
    raw, rect, offsets = [], [], []
    for k in ("00", "01"):
        size = _size(entries, f"S_{k}", path)
        K = _entry(entries, f"K_{k}", 9, path)
        D = _entry(entries, f"D_{k}", 5, path)
        raw.append(_camera(K.reshape(3, 3), size, tuple(D.tolist()), f"{path}, camera {k}"))
        size = _size(entries, f"S_rect_{k}", path)
        P = _entry(entries, f"P_rect_{k}", 12, path).reshape(3, 4)
        rect.append(_camera(P[:, :3], size, (), f"{path}, P_rect_{k}"))
        offsets.append(np.linalg.solve(P[:, :3], P[:, 3]))
    return KittiRawCalibration(
        cam0=raw[0],
        cam1=raw[1],
        T_cam1_cam0=_transform(entries, path, "R_01", "T_01") @ se3_inverse(_transform(entries, path, "R_00", "T_00")),
        rect0=rect[0],
        rect1=rect[1],
        T_rect1_rect0=se3_from_parts(np.eye(3), offsets[1] - offsets[0]),
        R_rect_cam0=_transform(entries, path, "R_rect_00")[:3, :3],
        R_rect_cam1=_transform(entries, path, "R_rect_01")[:3, :3],
    )


def _camera(K: FloatArray, size: tuple[int, int], coefficients: tuple[float, ...], where: str) -> CameraModel:
    check_intrinsics(K, where)
    kind: DistortionModel = "radtan" if coefficients else "pinhole"
    with naming(where):
        fu, fv, cu, cv = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        return CameraModel(fu, fv, cu, cv, *size, kind, coefficients)


def _size(entries: Mapping[str, str], name: str, path: Path) -> tuple[int, int]:
    return image_size(_entry(entries, name, 2, path).tolist(), f"{path}, {name}")


def _transform(entries: Mapping[str, str], path: Path, rotation: str, translation: str | None = None) -> FloatArray:
    """Return the transform (4, 4) of two entries, or of a rotation alone."""
    R = _entry(entries, rotation, 9, path).reshape(3, 3)
    t = np.zeros(3) if translation is None else _entry(entries, translation, 3, path)
    return checked_transform(np.column_stack([R, t]), f"{path}, {rotation}")


def read_imu_pose(path: Path) -> tuple[FloatArray | None, tuple[str, ...]]:
    """`T_cam0_imu` (4, 4) of the raw camera 0, through the laser scanner's frame; None where a file is missing."""
    velo, imu = _find(path, VELO), _find(path, IMU)
    if velo is None or imu is None:
        lacking = " and ".join(name for name, found in ((VELO, velo), (IMU, imu)) if found is None)
        return None, (f"{path}: {lacking} not found; the pose of the IMU is unknown, and poses describe the camera",)
    T_cam0_velo, T_velo_imu = (_transform(_read_entries(file), file, "R", "T") for file in (velo, imu))
    return T_cam0_velo @ T_velo_imu, ()


def _read_entries(path: Path) -> dict[str, str]:
    """Read the lines `name: values`."""
    entries: dict[str, str] = {}
    for number, line in text_lines(path):
        name, colon, values = line.partition(":")
        if not line.strip():
            continue
        if not colon or name in entries:
            what = "repeats an entry" if colon else "is not of the form 'name: values'"
            raise CalibrationError(f"{path}, line {number}: {what} ({line[:40]!r}); copy the calibration again")
        entries[name] = values
    return entries


def _entry(entries: Mapping[str, str], name: str, count: int, path: Path) -> FloatArray:
    if name not in entries:
        raise CalibrationError(f"{path}: has no entry {name}; copy the calibration again")
    return numbers_in(entries[name], count, f"{path}: {name}")


# --- clock ----------------------------------------------------------------------------------------------------------


def _frame_numbers(pairs: ImagePairs) -> IntArray:
    """Read the frame numbers (F,) from the image names."""
    bad = next((left for left, _ in pairs if not re.fullmatch(r"\d{1,18}", left.stem)), None)
    if bad is not None:
        raise DataError(f"{bad}: an image of KITTI raw is named by its frame number (0000000000.png); rename it")
    numbers = np.array([int(left.stem) for left, _ in pairs], dtype=np.int64)
    if (np.diff(numbers) <= 0).any():
        k = int(np.argmax(np.diff(numbers) <= 0))
        raise DataError(
            f"{pairs[k + 1][0]}: its frame number does not increase after {pairs[k][0].name}; name all images with the "
            "same number of digits"
        )
    return numbers


def _read_times(path: Path, numbers: IntArray) -> tuple[IntArray, tuple[str, ...]]:
    """Return times (F,) of the images, and a note where they follow from the frame numbers."""
    if not path.is_file():
        note = f"{path} is missing; times follow from the frame numbers at 10 Hz"
        return numbers * _FRAME_NS, (note,)
    return drive_times(path, numbers), ()
