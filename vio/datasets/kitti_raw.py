"""The calibration files of KITTI raw drives:
`calib_cam_to_cam.txt calib_velo_to_cam.txt calib_imu_to_velo.txt`.

They lie in the drive or a folder above it. `R_0k`, `T_0k` map coordinates of camera 0 to camera k.
Reference: Geiger et al., Vision meets robotics: the KITTI dataset (2013).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vio.dataclass import dataclass
from vio.datasets.common import check_intrinsics, image_size, naming, numbers_in
from vio.errors import CalibrationError
from vio.files.text import text_lines
from vio.geometry.distortion import CameraModel, DistortionModel
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts, se3_inverse

CAMERAS = "calib_cam_to_cam.txt"
PERSPECTIVE = "perspective.txt"  # of KITTI-360, in the same form
VELO = "calib_velo_to_cam.txt"
IMU = "calib_imu_to_velo.txt"
_MAX_PARENTS = 3
_DRIVING_STEREO = ("101", "103")  # its left and its right camera


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


def find_above(path: Path, name: str) -> Path | None:
    """Find a calibration file in a folder or its parents."""
    absolute = path.absolute()
    folders = [absolute, *absolute.parents[:_MAX_PARENTS]]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def read_cam_to_cam(path: Path) -> KittiRawCalibration:
    """Read the gray pair's entries of `calib_cam_to_cam.txt`.

    Raises:
        CalibrationError: an entry is missing, malformed or impossible.
    """
    entries = _read_entries(path)
    raw = []
    rect = []
    offsets = []
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
        T_cam1_cam0=_transform(entries, path, "R_01", "T_01")
        @ se3_inverse(_transform(entries, path, "R_00", "T_00")),
        rect0=rect[0],
        rect1=rect[1],
        T_rect1_rect0=se3_from_parts(np.eye(3), offsets[1] - offsets[0]),
        R_rect_cam0=_transform(entries, path, "R_rect_00")[:3, :3],
        R_rect_cam1=_transform(entries, path, "R_rect_01")[:3, :3],
    )


def read_perspective(path: Path) -> tuple[CameraModel, CameraModel, FloatArray]:
    """Return KITTI-360's rectified cameras and `T_rect1_rect0` (4, 4) of `perspective.txt`, whose
    published images are rectified.

    Raises:
        CalibrationError: an entry is missing, malformed or impossible.
    """
    entries = _read_entries(path)
    cameras = []
    offsets = []
    for k in ("00", "01"):
        size = _size(entries, f"S_rect_{k}", path)
        P = _entry(entries, f"P_rect_{k}", 12, path).reshape(3, 4)
        cameras.append(_camera(P[:, :3], size, (), f"{path}, P_rect_{k}"))
        offsets.append(np.linalg.solve(P[:, :3], P[:, 3]))
    return cameras[0], cameras[1], se3_from_parts(np.eye(3), offsets[1] - offsets[0])


def is_driving_stereo(path: Path) -> bool:
    """Return whether a text file has DrivingStereo's cameras, numbered 101 and 103."""
    return any(line.startswith(f"P_rect_{_DRIVING_STEREO[0]}:") for _, line in text_lines(path))


def read_driving_stereo(path: Path) -> tuple[CameraModel, CameraModel, FloatArray]:
    """Return DrivingStereo's rectified cameras and `T_rect1_rect0` (4, 4), whose published images
    are rectified.

    The baseline is that of the raw cameras, `R_101 T_101 R_103 T_103`, as the last column of
    `P_rect_103` is that of whole images in the files of half ones too.
    Reference: Yang et al., DrivingStereo (2019), and public reports of its half-size calibrations.

    Raises:
        CalibrationError: an entry is missing, malformed or impossible.
    """
    entries = _read_entries(path)
    cameras = []
    poses = []
    for k in _DRIVING_STEREO:
        size = _size(entries, f"S_rect_{k}", path)
        P = _entry(entries, f"P_rect_{k}", 12, path).reshape(3, 4)
        cameras.append(_camera(P[:, :3], size, (), f"{path}, P_rect_{k}"))
        poses.append(_transform(entries, path, f"R_{k}", f"T_{k}"))
    baseline_m = float(np.linalg.norm((poses[1] @ se3_inverse(poses[0]))[:3, 3]))
    return cameras[0], cameras[1], se3_from_parts(np.eye(3), [-baseline_m, 0.0, 0.0])


def _camera(
    K: FloatArray, size: tuple[int, int], coefficients: tuple[float, ...], where: str
) -> CameraModel:
    check_intrinsics(K, where)
    kind: DistortionModel = "radtan" if coefficients else "pinhole"
    with naming(where):
        fu, fv, cu, cv = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        return CameraModel(fu, fv, cu, cv, *size, kind, coefficients)


def _size(entries: Mapping[str, str], name: str, path: Path) -> tuple[int, int]:
    return image_size(_entry(entries, name, 2, path).tolist(), f"{path}, {name}")


def _transform(
    entries: Mapping[str, str], path: Path, rotation: str, translation: str | None = None
) -> FloatArray:
    """Return the transform (4, 4) of two entries, or of a rotation alone."""
    R = _entry(entries, rotation, 9, path).reshape(3, 3)
    if translation is None:
        t = np.zeros(3)
    else:
        t = _entry(entries, translation, 3, path)
    return checked_transform(np.column_stack([R, t]), f"{path}, {rotation}")


def read_imu_pose(path: Path) -> tuple[FloatArray | None, tuple[str, ...]]:
    """`T_cam0_imu` (4, 4) of the raw camera 0, through the laser scanner's frame.

    None where a file is missing.
    """
    velo = find_above(path, VELO)
    imu = find_above(path, IMU)
    if velo is None or imu is None:
        lacking = " and ".join(name for name, found in ((VELO, velo), (IMU, imu)) if found is None)
        return None, (
            f"{path}: {lacking} not found; the pose of the IMU is unknown, and poses describe the "
            "camera",
        )
    T_cam0_velo, T_velo_imu = (
        _transform(_read_entries(file), file, "R", "T") for file in (velo, imu)
    )
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
            raise CalibrationError(
                f"{path}, line {number}: {what} ({line[:40]!r}); copy the calibration again"
            )
        entries[name] = values
    return entries


def _entry(entries: Mapping[str, str], name: str, count: int, path: Path) -> FloatArray:
    if name not in entries:
        raise CalibrationError(f"{path}: has no entry {name}; copy the calibration again")
    return numbers_in(entries[name], count, f"{path}: {name}")
