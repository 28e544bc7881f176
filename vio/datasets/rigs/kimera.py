"""Kimera's `LeftCameraParams.yaml` and `RightCameraParams.yaml`, with `ImuParams.yaml` beside them.

They are EuRoC's `sensor.yaml` in one folder: `T_BS` maps coordinates of the sensor to the body. The
time shift, `imu_time_shift` (older: `imu_shift`), is added to the cameras' stamps to have the IMU's.
Reference: Kimera-VIO's `ImuParams.yaml` ("t_imu0 = t_cam0 + imu_shift").
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.euroc_files import read_camera_yaml, read_imu_yaml
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import ImuSheet, rig_of_poses
from vio.datasets.sides import pairs_of
from vio.datasets.yaml_files import numbers, read_yaml_file
from vio.geometry.lie import se3_inverse

_IMU = ("ImuParams.yaml", "ImuParams.yml", "imu.yaml", "imu_params.yaml", "imu0.yaml")
_SHIFTS = ("imu_time_shift", "imu_shift")


def pair_beside(path: Path) -> tuple[Path, Path] | None:
    """Return the left and the right file of the pair of which a file is one; None: it is alone."""
    names = sorted(file.name for file in path.parent.iterdir() if file.suffix == path.suffix)
    found = [pair for pair in pairs_of(names) if path.name in pair]
    if len(found) != 1:
        return None
    return path.with_name(found[0][0]), path.with_name(found[0][1])


def read_kimera(left: Path, right: Path) -> Rig:
    """Read the files of two cameras and, beside them, the IMU's.

    Raises:
        CalibrationError: an entry is missing or impossible.
    """
    models, T_body_cams = zip(*(read_camera_yaml(file) for file in (left, right)), strict=True)
    imu = next((f for name in _IMU if (f := left.parent / name).is_file()), None)
    T_body_imu = np.eye(4)
    sheet = None
    if imu is not None:
        T_body_imu, noise = read_imu_yaml(imu)
        entries = read_yaml_file(imu)
        shifts = [numbers(entries, key, imu, 1)[0] for key in _SHIFTS if key in entries]
        sheet = ImuSheet(noise, shifts[0] if shifts else 0.0)
    T_imu_cams = [se3_inverse(T_body_imu) @ T for T in T_body_cams]
    rig = rig_of_poses(list(models), T_imu_cams, str(left), sheet or ImuSheet())
    return checked_rig(rig, left)
