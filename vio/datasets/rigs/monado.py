"""Monado's own `calibration_v2` JSON of a stereo pair.

`cameras`: two, left first, each with `model` (`pinhole_radtan5`, `fisheye_equidistant4`), `intrinsics`,
`distortion` and `resolution`. `opencv_stereo_calibrate` has `rotation` (9 numbers by rows) and
`translation`, R and T of OpenCV's `stereoCalibrate`: they map coordinates of the left camera to the
right one. The unit of T is that of the board, and taken to be the metre. There is no IMU.
Reference: Monado's `t_file.cpp` (`t_stereo_camera_calibration_from_json_v2`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.opencv import coefficients_of
from vio.datasets.rigs.plausible import checked_rig, unit_doubt
from vio.datasets.rigs.source import Source
from vio.datasets.yaml_files import Entries, matrix, numbers, section, tool_lens
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import checked_transform
from vio.geometry.stereo import intrinsic_matrix

_POSE = "opencv_stereo_calibrate"


def matches(entries: Entries) -> bool:
    """Return whether entries are those of Monado's calibration of a pair."""
    return _POSE in entries and isinstance(entries.get("cameras"), list)


def read(source: Source) -> Rig:
    """Read the pair.

    Raises:
        CalibrationError: an entry is missing or impossible, or a lens model is not read.
    """
    where = source.where
    items = source.entries["cameras"]
    if not isinstance(items, list) or len(items) != 2:
        raise CalibrationError(f"{where}: cameras does not hold two; copy the calibration again")
    cam0, cam1 = (_camera(item, f"{where}, camera {k}") for k, item in enumerate(items))
    pose = section(source.entries, _POSE, where)
    R = matrix(pose.get("rotation"), (3, 3), f"{where}, rotation")
    T = matrix(pose.get("translation"), None, f"{where}, translation").ravel()
    if T.shape != (3,):
        raise CalibrationError(f"{where}: translation holds {len(T)} numbers, not 3")
    T_cam1_cam0 = checked_transform(np.column_stack([R, T]), f"{where}, rotation")
    with naming(where):
        rig = checked_rig(Rig(cam0, cam1, T_cam1_cam0), where)
    doubt = unit_doubt(float(np.linalg.norm(T)), where)
    return rig if doubt is None else rig.noting(doubt)


def _camera(item: Mapping[str, Any], where: str) -> CameraModel:
    model, names = tool_lens("monado", item.get("model"), f"{where}, model")
    block = section(item, "intrinsics", where)
    fx, fy, cx, cy = (numbers(block, name, where, 1)[0] for name in ("fx", "fy", "cx", "cy"))
    bend = section(item, "distortion", where)
    D = tuple(numbers(bend, name, where, 1)[0] for name in names)
    stated = section(item, "resolution", where)
    size = image_size([numbers(stated, name, where, 1)[0] for name in ("width", "height")], where)
    K = intrinsic_matrix(fx, fy, cx, cy)
    with naming(where):
        return camera_from_matrix(K, *size, model, coefficients_of(model, D))
