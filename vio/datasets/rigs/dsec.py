"""DSEC's `cam_to_cam.yaml`: two cameras of images between two event cameras, as rectified.

`intrinsics` has `cam1` (left) and `cam2` (right) of images, and `camRect1`, `camRect2` of the
rectified ones, which are those published: `camera_matrix` fx fy cx cy in pixels, `resolution` width
and height. `extrinsics`: `T_21` (4, 4) maps coordinates of cam1 to cam2, metres, and `R_rect1`,
`R_rect2` (3, 3) those of a camera to its rectified one.
Reference: Gehrig et al., DSEC: a stereo event camera dataset for driving scenarios (2021), data
format.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import Source
from vio.datasets.yaml_files import Entries, matrix, numbers, section
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import checked_transform, se3_inverse
from vio.geometry.stereo import intrinsic_matrix

_LEFT = "camRect1"
_RIGHT = "camRect2"


def matches(entries: Entries) -> bool:
    """Return whether entries are those of DSEC's cameras."""
    cameras = entries.get("intrinsics")
    return isinstance(cameras, dict) and {_LEFT, _RIGHT} <= cameras.keys()


def read(source: Source) -> Rig:
    """Read the rectified pair of images.

    Raises:
        CalibrationError: an entry is missing, malformed or impossible.
    """
    where = source.where
    cameras = section(source.entries, "intrinsics", where)
    cam0, cam1 = (_camera(cameras, name, where) for name in (_LEFT, _RIGHT))
    poses = section(source.entries, "extrinsics", where)
    R0, R1 = (
        matrix(poses.get(name), (3, 3), f"{where}, {name}") for name in ("R_rect1", "R_rect2")
    )
    turn0 = checked_transform(np.column_stack([R0, np.zeros(3)]), f"{where}, R_rect1")
    turn1 = checked_transform(np.column_stack([R1, np.zeros(3)]), f"{where}, R_rect2")
    T_21 = checked_transform(matrix(poses.get("T_21"), (4, 4), f"{where}, T_21"), f"{where}, T_21")
    with naming(where):
        return checked_rig(Rig(cam0, cam1, turn1 @ T_21 @ se3_inverse(turn0)), where)


def _camera(cameras: Mapping[str, Any], name: str, where: str) -> CameraModel:
    place = f"{where}, {name}"
    block = section(cameras, name, where)
    fx, fy, cx, cy = numbers(block, "camera_matrix", place, 4)
    size = image_size(list(numbers(block, "resolution", place, 2)), f"{place}, resolution")
    with naming(place):
        return camera_from_matrix(intrinsic_matrix(fx, fy, cx, cy), *size)
