"""ETH3D's SLAM recordings with two cameras: `rgb` and `rgb2`, which is the *left* one.

`calibration.txt` and `calibration2.txt` have `fx fy cx cy` of undistorted images, whose size they do not
state. `extrinsics_1_2.txt`, 3 x 4 numbers in metres, maps coordinates of camera 2 to camera 1, so from left to
right. `groundtruth.txt` has the poses of camera 1, the right one.
Reference: https://www.eth3d.net/slam_documentation ("RGB stereo data").
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from vio.cameras.rig import Rig
from vio.datasets.common import naming
from vio.datasets.rigs.bare import read_bare
from vio.datasets.rigs.source import Size
from vio.errors import CalibrationError
from vio.files.text import read_numbers
from vio.geometry.lie import checked_transform
from vio.records import Trajectory

EXTRINSICS = "extrinsics_1_2.txt"
FOLDERS = ("rgb2", "rgb")  # left and right
_CALIBRATIONS = ("calibration2.txt", "calibration.txt")


def is_eth3d(folder: Path) -> bool:
    """Return whether a folder has the calibration of the pair, and both folders of images."""
    files = (EXTRINSICS, *_CALIBRATIONS)
    there = all((folder / name).is_file() for name in files)
    return there and all((folder / name).is_dir() for name in FOLDERS)


def read_eth3d(path: Path, size: Size | None) -> Rig:
    """Read the three files of the pair, given the path of the extrinsics.

    Raises:
        CalibrationError: a file is missing or malformed, or no image size is given.
    """
    folder = path.parent
    left, right = (read_bare(folder / name, size) for name in _CALIBRATIONS)
    numbers = read_numbers(path, 4)
    if numbers.shape != (3, 4):
        raise CalibrationError(f"{path}: holds {len(numbers)} rows of 4 numbers, not 3")
    T_right_left = checked_transform(numbers, str(path))
    with naming(path):
        return Rig(left.cam0, right.cam0, T_right_left, notes=(*left.notes, *right.notes))


def truth_of_left(truth: Trajectory, rig: Rig) -> Trajectory:
    """Return the poses of the right camera, as the files have them, as those of the left one."""
    _, T_right_left = rig.right
    return replace(truth, T_world_body=truth.T_world_body @ T_right_left, body="cam0")
