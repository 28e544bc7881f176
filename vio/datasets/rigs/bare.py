"""The intrinsics of one camera as bare numbers in a text file, as folders of RGB-D images have them.

`fx fy cx cy` in a line, with `k1 k2 p1 p2 [k3]` behind (ETH3D's `calibration.txt` has the four), or
a matrix of 3 x 3 or 4 x 4 numbers (`intrinsics.txt`, ScanNet's `intrinsic_color.txt`). Pixels;
neither the size of the images nor the unit of depths is stated. Of a rectified pair, the nine
numbers of the matrix in a line, and the baseline in metres in the next (FoundationStereo's
`K.txt`).
Reference: ETH3D's SLAM documentation ("fx fy cx cy"); Schops et al., BAD SLAM (2019).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import check_intrinsics, naming
from vio.datasets.rigs.plausible import baseline_doubt, checked_rig
from vio.datasets.rigs.source import Size, no_image_size
from vio.errors import CalibrationError
from vio.files.text import text_lines
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import intrinsic_matrix

# `458,654 457,296 367,215 248,375`: commas within numbers, and white space between them
_DECIMAL_COMMAS = re.compile(r"(?=.*,)[+-]?\d+(?:,\d+)?(?:[\s;]+[+-]?\d+(?:,\d+)?)+")
NAMES = (
    "calibration.txt",
    "intrinsics.txt",
    "camera-intrinsics.txt",
    "intrinsic_color.txt",
    "intrinsic.txt",
    "K.txt",
)


def is_bare(path: Path) -> bool:
    """Return whether a text file holds the numbers of one camera and nothing else."""
    return _numbers(path) is not None or _of_pair(path) is not None


def read_bare(path: Path, size: Size | None) -> Rig:
    """Read the camera, or the rectified pair.

    Raises:
        CalibrationError: the numbers are no intrinsics, or no image size is given.
    """
    if (pair := _of_pair(path)) is not None:
        K, baseline_m = pair
        if size is None:
            raise no_image_size(path)
        with naming(path):
            check_intrinsics(K, "the matrix")
            fu, fv, cu, cv = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
            rig = Rig.rectified(fu, fv, cu, cv, baseline_m, *size)
        rig = checked_rig(rig, path, size_stated=False)
        doubt = baseline_doubt(baseline_m, path)
        return rig if doubt is None else rig.noting(doubt)
    rows = _numbers(path)
    if rows is None:
        raise CalibrationError(f"{path}: is neither 'fx fy cx cy' nor a matrix of 3 x 3 numbers")
    if size is None:
        raise no_image_size(path)
    bend: list[float] = []
    if len(rows) == 1 and _is_flat_matrix(rows[0]):
        K = rows[0].reshape(3, 3)
    elif len(rows) == 1:
        fx, fy, cx, cy, *bend = rows[0].tolist()
        K = intrinsic_matrix(fx, fy, cx, cy)
    else:
        K = rows[:3, :3]
    with naming(path):
        rig = Rig(camera_from_matrix(K, *size, "radtan", bend))
    return checked_rig(rig, path, size_stated=False)


def _of_pair(path: Path) -> tuple[FloatArray, float] | None:
    """Return a matrix (3, 3), in one row or three, with the baseline of a pair in the row below;
    None: the file holds something else.
    """
    rows = _rows_of_numbers(path)
    if rows is None or [len(row) for row in rows] not in ([9, 1], [3, 3, 3, 1]):
        return None
    return np.concatenate(rows[:-1]).reshape(3, 3), rows[-1][0]


def _is_flat_matrix(row: FloatArray) -> bool:
    """Return whether nine numbers are those of an intrinsic matrix, row by row."""
    return len(row) == 9 and row[[1, 3, 6, 7, 8]].tolist() == [0, 0, 0, 0, 1]


def _numbers(path: Path) -> FloatArray | None:
    """Return one row of 4, 8 or 9 numbers, or a matrix; None: the file holds something else."""
    rows = _rows_of_numbers(path)
    if rows is None:
        return None
    widths = {len(row) for row in rows}
    one = len(rows) == 1 and widths <= {4, 8, 9}
    square = widths in ({3}, {4}) and len(rows) in widths
    return np.array(rows) if one or square else None


def _rows_of_numbers(path: Path) -> list[list[float]] | None:
    """Return the first five lines that are no comments; None: they hold something else."""
    lines = [line.strip() for _, line in text_lines(path) if line.strip()[:1] not in ("#", "")]
    if any(_DECIMAL_COMMAS.fullmatch(line) for line in lines):
        lines = [line.replace(",", ".") for line in lines]
    try:
        return [[float(x) for x in re.split(r"[\s,;]+", line) if x] for line in lines[:5]]
    except ValueError:
        return None
