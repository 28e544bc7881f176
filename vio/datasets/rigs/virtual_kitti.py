"""Virtual KITTI 2: `intrinsic.txt` and `extrinsic.txt` of a rendered pair, `Camera_0` and
`Camera_1`.

Below a header, a line for each frame and camera: its numbers, then `K[0,0] K[1,1] K[0,2] K[1,2]` in
pixels, or a matrix (4, 4) that maps world coordinates to the camera, metres. All frames have one
rig; the first one is read. Neither file states the size of the images. The matrices of camera 0 are
the ground truth.
Reference: Cabon et al., Virtual KITTI 2 (2020), and the description of its files.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import naming, numbers_in
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import Size, no_image_size
from vio.errors import CalibrationError, DataError
from vio.files.text import text_lines
from vio.geometry.lie import FloatArray, checked_transform, se3_inverse
from vio.geometry.stereo import intrinsic_matrix
from vio.records import Trajectory

EXTRINSICS = "extrinsic.txt"
_HEADER = ["frame", "cameraID"]


def is_virtual_kitti(path: Path) -> bool:
    """Return whether a text file begins with the header of the intrinsics."""
    return _begins(path, [*_HEADER, "K[0,0]"])


def read_virtual_kitti(path: Path, size: Size | None) -> Rig:
    """Read the pair, given the path of the intrinsics.

    Raises:
        CalibrationError: a file or a camera is missing, a number is impossible, or no image size is
            given.
    """
    if size is None:
        raise no_image_size(path)
    file = path.with_name(EXTRINSICS)
    if not file.is_file():
        raise CalibrationError(f"{path}: {EXTRINSICS} is not beside it; copy it there")
    lenses = _of_first_frame(path, 4)
    poses = _of_first_frame(file, 16)
    T_cam0_world, T_cam1_world = (
        checked_transform(pose.reshape(4, 4), f"{file}, camera {k}") for k, pose in enumerate(poses)
    )
    with naming(path):
        cam0, cam1 = (
            camera_from_matrix(intrinsic_matrix(*lens.tolist()), *size) for lens in lenses
        )
        rig = Rig(cam0, cam1, T_cam1_world @ se3_inverse(T_cam0_world))
    return checked_rig(rig, path, size_stated=False)


def poses_of_left(folder: Path) -> Trajectory | None:
    """Return the poses of the left camera that a recording's `extrinsic.txt` states, frame by
    frame; None: there is none, or frames are missing in it.

    Raises:
        CalibrationError: a line is malformed.
    """
    file = folder / EXTRINSICS
    if not file.is_file() or not _begins(file, [*_HEADER, "r1,1"]):
        return None
    lines = [(number, line) for number, line in text_lines(file) if line.strip()][1:]
    rows = [numbers_in(line, 18, f"{file}, line {number}") for number, line in lines]
    lefts = [(number, row) for (number, _), row in zip(lines, rows, strict=True) if row[1] == 0]
    if not lefts or [row[0] for _, row in lefts] != list(range(len(lefts))):
        return None
    T_cam_world = [
        checked_transform(row[2:].reshape(4, 4), f"{file}, line {number}") for number, row in lefts
    ]
    return Trajectory(se3_inverse(np.stack(T_cam_world)), None, "cam0")


def _begins(path: Path, header: list[str]) -> bool:
    """Return whether a file is a text whose first line begins with these words."""
    try:
        first = next((line.split() for _, line in text_lines(path)), [])
    except DataError:  # no text: another program's
        return False
    return first[: len(header)] == header


def _of_first_frame(path: Path, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the numbers (count,) of cameras 0 and 1 in the first two lines below the header."""
    lines = [line for _, line in text_lines(path) if line.strip()][1:3]
    found = [numbers_in(line, 2 + count, f"{path}, its first frame") for line in lines]
    cameras = [line[:2].astype(int).tolist() for line in found]
    if len(found) != 2 or cameras[0][0] != cameras[1][0] or [c for _, c in cameras] != [0, 1]:
        raise CalibrationError(
            f"{path}: its first frame has no lines of cameras 0 and 1; copy it again"
        )
    return found[0][2:], found[1][2:]
