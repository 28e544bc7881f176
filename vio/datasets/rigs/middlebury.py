"""Middlebury's `calib.txt`, which ETH3D's two-view stereo has as well: a rectified pair.

`cam0=[f 0 cx0; 0 f cy; 0 0 1]` and `cam1=[…]` in pixels, `baseline=` in millimetres, `width=` and
`height=` of the images. `doffs=` is cx1 - cx0, and stands in the matrices already.
Reference: the description of the Middlebury Stereo Datasets, 2014.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import Size, no_image_size
from vio.errors import CalibrationError
from vio.files.text import text_lines
from vio.geometry.lie import FloatArray, se3_from_parts

_MM = 1e-3
_ENTRY = re.compile(r"\s*(\w+)\s*=\s*(.*?)\s*")


def read_middlebury(path: Path, size: Size | None) -> Rig | None:
    """Read the pair; None: the text file does not state `cam0`, `cam1` and `baseline`.

    Raises:
        CalibrationError: an entry is malformed, or no image size is stated or given.
    """
    entries = _entries(path)
    if not {"cam0", "cam1", "baseline"} <= entries.keys():
        return None
    stated = "width" in entries and "height" in entries
    if not stated and size is None:
        raise no_image_size(path)
    if stated:
        size = image_size([_number(entries, key, path) for key in ("width", "height")], str(path))
    assert size is not None
    baseline_m = _MM * _number(entries, "baseline", path)
    if not baseline_m > 0:
        raise CalibrationError(
            f"{path}: baseline is {entries['baseline']}; it must be positive, in millimetres"
        )
    K0, K1 = (_matrix(entries[key], f"{path}, {key}") for key in ("cam0", "cam1"))
    with naming(path):
        cam0, cam1 = (camera_from_matrix(K, *size, "pinhole", ()) for K in (K0, K1))
        if (K0 == K1).all():
            rig = Rig.rectified(cam0.fu, cam0.fv, cam0.cu, cam0.cv, baseline_m, *size)
        else:
            rig = Rig(cam0, cam1, se3_from_parts(np.eye(3), [-baseline_m, 0.0, 0.0]))
    return checked_rig(rig, path, size_stated=stated)


def _entries(path: Path) -> Mapping[str, str]:
    """Return the lines `name=value` of a file."""
    found = (_ENTRY.fullmatch(line.strip()) for _, line in text_lines(path))
    return {entry[1]: entry[2] for entry in found if entry is not None}


def _number(entries: Mapping[str, str], key: str, path: Path) -> float:
    try:
        return float(entries[key])
    except ValueError as error:
        raise CalibrationError(f"{path}: {key} is {entries[key]!r}, no number") from error


def _matrix(text: str, where: str) -> FloatArray:
    """Return a matrix (3, 3) between brackets, its rows between semicolons."""
    try:
        rows = [row.replace(",", " ").split() for row in text.strip("[] ").split(";")]
        K = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise CalibrationError(f"{where}: {text[:40]!r} is no matrix of 3 x 3 numbers") from error
    if K.shape != (3, 3):
        raise CalibrationError(f"{where}: {text[:40]!r} is no matrix of 3 x 3 numbers")
    return K
