"""A calibration file as its reader takes it, and the rig of what most formats state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.cameras.rig import Rig
from vio.dataclass import dataclass
from vio.datasets.common import naming
from vio.datasets.yaml_files import Entries
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, se3_inverse
from vio.records import ImuDensities

Size = tuple[int, int]
_MIN_BESIDE = 0.7  # share of a baseline along x, below which cameras are not side by side
_CLEARLY_BESIDE = 0.95  # likewise, above which they surely are


def no_image_size(path: Path) -> CalibrationError:
    """The error of a file of a format that states no image size, where the caller gives none."""
    return CalibrationError(
        f"{path}: states no image size; pass image_size=(W, H), or give a file that states it, "
        "such as 'vio run FOLDER --save-calibration rig.yaml' writes"
    )


@dataclass(frozen=True, slots=True)
class Source:
    """A calibration file, and what its caller knows of the images."""

    path: Path
    entries: Entries  # of YAML, JSON, XML or an INI file
    image_size: Size | None = None  # width and height in pixels, where known
    cameras: int | None = None  # that are asked for; None: whichever there are

    @property
    def where(self) -> str:
        """The file, for messages."""
        return str(self.path)


@dataclass(frozen=True, slots=True)
class ImuSheet:
    """What a calibration states of its IMU besides the cameras' poses."""

    noise: ImuDensities | None = None
    time_offset_s: float = 0.0  # a frame stamped t was exposed at t + offset of the IMU's clock
    notes: tuple[str, ...] = ()


def stereo_pose_on_imu(T_imu_cam0: FloatArray, T_imu_cam1: FloatArray, where: str) -> FloatArray:
    """Return `T_cam1_cam0` (4, 4) of two cameras on an IMU, or on another body.

    Args:
        T_imu_cam0: (4, 4), maps coordinates of the left camera to the IMU.
        T_imu_cam1: likewise of the right camera.
        where: the file, for messages.

    Raises:
        CalibrationError: see `check_direction`.
    """
    T_cam1_cam0 = se3_inverse(T_imu_cam1) @ T_imu_cam0
    check_direction(T_cam1_cam0, T_imu_cam1 @ se3_inverse(T_imu_cam0), where)
    return T_cam1_cam0


def check_direction(T_cam1_cam0: FloatArray, inverse: FloatArray, where: str) -> None:
    """Check that poses on the IMU map as their entry says.

    Args:
        T_cam1_cam0: (4, 4) by the poses.
        inverse: (4, 4), as it would be by the inverse of both.
        where: the file, for messages.

    Raises:
        CalibrationError: the right camera is not beside the left one, and would be if the poses
            mapped the other way round.
    """
    if _beside(T_cam1_cam0) < _MIN_BESIDE and _beside(inverse) > _CLEARLY_BESIDE:
        x, y, z = se3_inverse(T_cam1_cam0)[:3, 3]
        raise CalibrationError(
            f"{where}: by the poses of the cameras on the IMU the right camera is at {x:.3f}, {y:.3f}, "
            f"{z:.3f} m in the left one, not beside it; with both poses inverted it is, "
            f"{np.linalg.norm(inverse[:3, 3]):.4g} m away: they map the other way than this entry "
            "does; invert both"
        )


def _beside(T_cam1_cam0: FloatArray) -> float:
    """Return the share of a baseline that is along the left camera's x axis, -1 to 1."""
    position = se3_inverse(T_cam1_cam0)[:3, 3]
    length = float(np.linalg.norm(position))
    return float(position[0]) / length if length > 0 else 0.0


def first_cameras(items: Sequence[object], where: str) -> list[dict[str, Any]]:
    """Return the blocks of the first two cameras of a list, or of the only one; what further ones are
    is not read.

    Raises:
        CalibrationError: one is no block.
    """
    for k, item in enumerate(items[:2]):
        if not isinstance(item, dict):
            raise CalibrationError(
                f"{where}, camera {k}: is {item!r:.40}, no block of entries; copy the calibration again"
            )
    return [item for item in items[:2] if isinstance(item, dict)]


def rig_of_poses(
    cameras: Sequence[CameraModel],
    T_imu_cams: Sequence[FloatArray],
    where: str,
    imu: ImuSheet | None = None,
    *,
    count: int | None = None,
) -> Rig:
    """Return the rig of one camera or of the first two, mounted on an IMU.

    Args:
        cameras: as calibrated; further ones are named in a note.
        T_imu_cams: (4, 4) each, map coordinates of the camera to the IMU.
        where: the file, for messages.
        imu: what is known of the IMU; None: there is none, the poses are on some body.
        count: of the cameras of the file, where not all are given.

    Raises:
        CalibrationError: there is no camera.
    """
    if not cameras:
        raise CalibrationError(f"{where}: holds no camera; copy the calibration again")
    notes = imu.notes if imu is not None else ()
    count = count or len(cameras)
    if count > 2:
        notes = (*notes, f"{where}: of {count} cameras the first two are used")
    known = imu or ImuSheet()
    T_cam0_imu = se3_inverse(T_imu_cams[0])
    body = T_cam0_imu if imu is not None else None
    T_cam1_cam0 = None
    if len(cameras) > 1:
        T_cam1_cam0 = stereo_pose_on_imu(T_imu_cams[0], T_imu_cams[1], where)
    with naming(where):
        if len(cameras) == 1:
            rig = Rig(cameras[0], T_cam0_imu=body, imu_noise=known.noise)
        else:
            rig = Rig(cameras[0], cameras[1], T_cam1_cam0, body, known.noise)
        return replace(rig, time_offset_s=known.time_offset_s, notes=notes)
