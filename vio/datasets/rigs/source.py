"""A calibration file as its reader takes it, and the rig of what most formats state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from vio.cameras.rig import Rig
from vio.dataclass import dataclass
from vio.datasets.common import naming
from vio.datasets.yaml_files import Entries
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, se3_inverse
from vio.records import ImuDensities

Size = tuple[int, int]


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


def rig_of_poses(
    cameras: Sequence[CameraModel],
    T_imu_cams: Sequence[FloatArray],
    where: str,
    imu: ImuSheet | None = None,
) -> Rig:
    """Return the rig of one camera or of the first two, mounted on an IMU.

    Args:
        cameras: as calibrated; further ones are named in a note.
        T_imu_cams: (4, 4) each, map coordinates of the camera to the IMU.
        where: the file, for messages.
        imu: what is known of the IMU; None: there is none, the poses are on some body.

    Raises:
        CalibrationError: there is no camera.
    """
    if not cameras:
        raise CalibrationError(f"{where}: holds no camera; copy the calibration again")
    notes = imu.notes if imu is not None else ()
    if len(cameras) > 2:
        notes = (*notes, f"{where}: of {len(cameras)} cameras the first two are used")
    known = imu or ImuSheet()
    T_cam0_imu = se3_inverse(T_imu_cams[0])
    body = T_cam0_imu if imu is not None else None
    with naming(where):
        if len(cameras) == 1:
            rig = Rig(cameras[0], T_cam0_imu=body, imu_noise=known.noise)
        else:
            T_cam1_cam0 = se3_inverse(T_imu_cams[1]) @ T_imu_cams[0]
            rig = Rig(cameras[0], cameras[1], T_cam1_cam0, body, known.noise)
        return replace(rig, time_offset_s=known.time_offset_s, notes=notes)
