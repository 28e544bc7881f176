"""Poses written as matrices over several lines, or in a file each: joined to one line a pose.

ScanNet, 7-Scenes and others have a folder of files with one matrix each, numbered as the images;
Redwood's and Open3D's logs have a line of three numbers above each matrix.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vio.errors import DataError
from vio.files.text import lines_of

_SIDE = 4  # rows and columns of a pose
_ABOVE = 3  # numbers of the line above a matrix in Redwood's log
_COUNTS = (_SIDE * (_SIDE - 1), _SIDE * _SIDE)  # numbers of a pose
_LAST = [0.0, 0.0, 0.0, 1.0]
_SUFFIXES = (".txt", ".pose", ".csv")
# a time with decimals, but not the 0.000123 of cam0.000123
_NUMBER = re.compile(r"\d{9,}\.\d+|(?<![A-Za-z\d.])\d+\.\d+|\d+")


def joined_matrices(rows: Sequence[str]) -> tuple[list[str], list[int]] | None:
    """Return matrices of 4 x 4 that go over four rows each as one row of 16 numbers, and which row
    each begins at; None: these are none.
    """
    cells = [row.replace(",", " ").split() for row in rows]
    counts = [len(row) for row in cells]
    matrix = [_SIDE] * _SIDE
    for block in (matrix, [_ABOVE, *matrix]):
        size = len(block)
        if len(rows) < size or len(rows) % size or counts != block * (len(rows) // size):
            continue
        firsts = list(range(size - _SIDE, len(rows), size))
        if all(_are_last(cells[first + _SIDE - 1]) for first in firsts):
            joined = [" ".join(map(" ".join, cells[k : k + _SIDE])) for k in firsts]
            return joined, firsts
    return None


def _are_last(cells: Sequence[str]) -> bool:
    """Return whether these are the last row of a pose."""
    try:
        return [float(cell) for cell in cells] == _LAST
    except ValueError:
        return False


def are_matrix_files(folder: Path) -> bool:
    """Return whether a folder holds numbered text files, and nothing but numbers in the first."""
    files = _numbered_files(folder)
    if not files:
        return False
    try:
        return len(_numbers_of(files[0][2])) in _COUNTS
    except DataError:
        return False


def matrices_of_files(folder: Path) -> tuple[list[str], list[str]]:
    """Return the poses of a folder of files with one matrix each, as rows of 12 or 16 numbers, and
    the number in the name of each, in their order. Those that are not finite, as where a scanner
    was lost, are left out.

    Raises:
        DataError: the folder holds none, or a file is no single pose.
    """
    files = _numbered_files(folder)
    if not files:
        raise DataError(
            f"{folder}: is a folder; give one file of all poses, a line each, or a folder of numbered files "
            "with one 4 x 4 matrix each"
        )
    rows = []
    names = []
    for _, name, path in files:
        numbers = _numbers_of(path)
        if len(numbers) not in _COUNTS:
            raise DataError(
                f"{path}: holds {len(numbers)} numbers, not the 16 of a 4 x 4 pose (or 12); give one file of "
                "all poses, a line each"
            )
        if np.isfinite(list(map(float, numbers))).all():
            rows.append(" ".join(numbers))
            names.append(name)
    if not rows:
        raise DataError(f"{folder}: no pose is finite; give the poses of the images")
    return rows, names


def _numbered_files(folder: Path) -> list[tuple[float, str, Path]]:
    """Return the text files of a folder by the last numbers in their names that differ, which stand
    before them as a value and as written; empty where some have none, or there is one file.
    """
    named: list[tuple[list[str], Path]] = []
    for path in folder.iterdir():
        if path.suffix in _SUFFIXES and not path.name.startswith(".") and path.is_file():
            named.append((_NUMBER.findall(path.stem), path))
    if len(named) < 2:
        return []
    for place in range(1, min(len(numbers) for numbers, _ in named) + 1):
        files = [(float(numbers[-place]), numbers[-place], path) for numbers, path in named]
        if len({value for value, _, _ in files}) == len(files):
            return sorted(files)
    return []


def _numbers_of(path: Path) -> list[str]:
    """Return the numbers of a file, as written.

    Raises:
        DataError: it cannot be read, or holds something else.
    """
    texts = " ".join(text for _, text in lines_of(path)).replace(",", " ").split()
    for text in texts:
        try:
            float(text)
        except ValueError as error:
            raise DataError(f"{path}: {error}; give the 16 numbers of a 4 x 4 pose") from error
    return texts
