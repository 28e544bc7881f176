"""Calibration files as a `CameraRig`: one camera of any format that a stereo calibration has, or of its own."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from vio.cameras.camera_rig import CameraRig
from vio.cameras.rig import camera_from_matrix
from vio.datasets.common import naming
from vio.datasets.euroc_files import read_camera_yaml, read_imu_yaml
from vio.datasets.rigs import KNOWN, find_calibration, load_rig
from vio.datasets.rigs.kalibr import is_one_camera, read_one_camera
from vio.datasets.yaml_files import Entries, matrix, numbers, read_yaml
from vio.errors import CalibrationError
from vio.geometry.distortion import DistortionModel
from vio.geometry.lie import se3_inverse


def load_camera(path: str | os.PathLike[str], *, image_size: tuple[int, int] | None = None) -> CameraRig:
    """Read the calibration of one camera; of a stereo calibration, that of the left one.

    Args:
        path: a calibration file, or a folder that holds one: Kalibr's camchain with cam0, EuRoC's cam0/sensor.yaml,
            ROS's CameraInfo, or any that `vio.load_rig` reads.
        image_size: width and height of the images in pixels, for formats that do not state it.

    Raises:
        CalibrationError: there is no calibration of a known format, or an entry is missing or impossible.
    """
    file = Path(path)
    if file.is_dir():
        found = find_calibration(file)
        if found is None:
            raise CalibrationError(f"{file}: holds no calibration; looked for {KNOWN}")
        file = found
    if file.suffix.lower() in (".yaml", ".yml") and file.is_file():
        entries = read_yaml(file, "the camera's calibration")
        if is_one_camera(entries):
            return read_one_camera(file)
        if "T_BS" in entries:
            return _euroc(file)
        if "camera_matrix" in entries and "image_width" in entries:
            return _camera_info(entries, file)
    rig = load_rig(file, image_size=image_size)
    return CameraRig(rig.cam0, rig.T_cam0_imu, rig.imu_noise, rig.time_offset_s, rig.notes)


def _euroc(path: Path) -> CameraRig:
    """Read a camera's `sensor.yaml` and, where it is beside it, `imu0/sensor.yaml`."""
    model, T_body_cam = read_camera_yaml(path)
    T_body_imu, noise = np.eye(4), None
    if (imu := path.parent.parent / "imu0" / "sensor.yaml").is_file():
        T_body_imu, noise = read_imu_yaml(imu)
    return CameraRig(model, se3_inverse(T_body_cam) @ T_body_imu, noise)


def _camera_info(entries: Entries, path: Path) -> CameraRig:
    """Read the raw camera of a CameraInfo file."""
    where = str(path)
    width, height = (round(numbers(entries, key, where, 1)[0]) for key in ("image_width", "image_height"))
    K = matrix(entries["camera_matrix"], (3, 3), f"{where}, camera_matrix")
    D = entries.get("distortion_coefficients")
    values = numbers(D, "data", where) if isinstance(D, dict) else ()
    fisheye = entries.get("distortion_model") in ("equidistant", "fisheye")
    model: DistortionModel = "equidistant" if fisheye else "radtan"
    with naming(path):
        return CameraRig(camera_from_matrix(K, width, height, model, values, "camera_matrix"))
