"""4Seasons' calibration of its undistorted images: `undistorted_calib_0.txt`, `…_1.txt` and
`undistorted_calib_stereo.txt`.

A camera's file is that of DSO: `Pinhole fx fy cx cy …`, the image size, `crop`, and the size again.
The stereo file is a matrix (4, 4) that maps coordinates of the left camera to the right one, as its
first number of translation, -0.300, says; the published description has it the other way round. Where
a file of this form has the right camera on the left one's left, it is read the other way round, and
this is said. The cameras' original calibration, `camchain.yaml`, is Kalibr's. `Transformations.txt` of
a recording has, below the comment `TS_cam_imu`, a translation x y z and a quaternion x y z w that map
coordinates of the IMU to the left camera.
Reference: Wenzel et al., 4Seasons: a cross-season dataset for multi-weather SLAM (2020), and its tools.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming, numbers_in
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import Size
from vio.errors import CalibrationError
from vio.files.text import read_numbers, text_lines
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import (
    FloatArray,
    checked_transform,
    rotation_from_quat_xyzw,
    se3_from_parts,
    se3_inverse,
)
from vio.geometry.stereo import intrinsic_matrix

STEREO = "undistorted_calib_stereo.txt"
TRANSFORMS = "Transformations.txt"


def is_four_seasons(path: Path) -> bool:
    """Return whether a file is one of the three."""
    return path.name.startswith("undistorted_calib_") and (path.parent / STEREO).is_file()


def read_four_seasons(path: Path, size: Size | None) -> Rig:
    """Read the three files.

    Raises:
        CalibrationError: a file is missing or malformed, or the images have another size.
    """
    folder = path.parent
    cam0, cam1 = (_camera(folder / f"undistorted_calib_{k}.txt") for k in range(2))
    if size is not None and size != (cam0.width, cam0.height):
        raise CalibrationError(
            f"{folder}: is for undistorted images of {cam0.width} x {cam0.height} pixels, not of "
            f"{size[0]} x {size[1]}; give undistorted_images, or --calibration camchain.yaml"
        )
    file = folder / STEREO
    T = checked_transform(read_numbers(file, 4).reshape(-1, 4), str(file))
    notes: tuple[str, ...] = ()
    if T[0, 3] > 0:
        T = se3_inverse(T)
        notes = (f"{file}: doubtful: it is read as the pose of the right camera in the left one",)
    with naming(folder):
        return checked_rig(Rig(cam0, cam1, T, notes=notes), folder)


def read_imu_transform(path: Path) -> FloatArray:
    """Return `T_cam0_imu` (4, 4) of a recording's `Transformations.txt`.

    Raises:
        CalibrationError: it has none, or it is malformed.
    """
    lines = [line.strip() for _, line in text_lines(path) if line.strip()]
    at = next((k for k, line in enumerate(lines) if "TS_cam_imu" in line), len(lines))
    if at + 1 >= len(lines):
        raise CalibrationError(f"{path}: has no TS_cam_imu, the pose of the IMU; copy it again")
    values = numbers_in(lines[at + 1].replace(",", " "), 7, f"{path}, TS_cam_imu")
    q = values[3:] / max(float(np.linalg.norm(values[3:])), 1e-9)
    T = se3_from_parts(rotation_from_quat_xyzw(q), values[:3])
    return checked_transform(T, f"{path}, TS_cam_imu")


def _camera(path: Path) -> CameraModel:
    lines = []
    if path.is_file():
        lines = [line.split() for _, line in text_lines(path) if line.strip()]
    if len(lines) < 2 or lines[0][0].lower() != "pinhole" or len(lines[0]) < 5:
        raise CalibrationError(
            f"{path}: is missing or not of the form 'Pinhole fx fy cx cy …' with the size below"
        )
    try:
        fx, fy, cx, cy = (float(x) for x in lines[0][1:5])
        size = [float(x) for x in lines[1][:2]]
    except ValueError as error:
        raise CalibrationError(f"{path}: holds no number ({error}); copy it again") from error
    width, height = image_size(size, str(path))
    K = intrinsic_matrix(fx, fy, cx, cy)
    with naming(path):
        return camera_from_matrix(K, width, height)
