"""Dictionaries of arrays that `numpy.save` pickled into an `.npy`, read without running what a
pickle may hold.
"""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from vio.datasets.common import check_array_bytes
from vio.errors import DataError
from vio.files.inputs import check_regular

_NPY = b"\x93NUMPY"
# what arrays and numbers are made by; NumPy 1 calls its private package `core`, NumPy 2 `_core`
_OF_ARRAYS = frozenset(
    {
        ("numpy", "dtype"),
        ("numpy", "ndarray"),
        ("numpy.core.multiarray", "_reconstruct"),
        ("numpy.core.multiarray", "scalar"),
        ("numpy.core.numeric", "_frombuffer"),
        ("_codecs", "encode"),
    }
)
# what a damaged pickle also raises
_UNPICKLED = (
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    EOFError,
    ImportError,
    MemoryError,
    OverflowError,
    SyntaxError,
)


def begins_as_npy(path: Path) -> bool:
    """Return whether a file begins as one array of NumPy's, `.npy`.

    Raises:
        OSError: it cannot be read, or is a pipe or a device.
    """
    check_regular(path)
    with path.open("rb") as stream:
        return stream.read(len(_NPY)) == _NPY


def is_pickled_dictionary(path: Path) -> bool:
    """Return whether a file is an `.npy` with one object, as `numpy.save` writes a dictionary.

    Raises:
        OSError: it cannot be read, or is a pipe or a device.
    """
    check_regular(path)
    with path.open("rb") as stream:
        try:
            return _npy_header(stream) == ((), np.dtype(object))
        except ValueError:
            return False


def _npy_header(stream: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read the shape and the type that an `.npy` states; ValueError: it is none."""
    if np.lib.format.read_magic(stream)[0] == 1:
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    return shape, dtype


class _ArraysAlone(pickle.Unpickler):
    """Unpickles arrays and numbers in lists and dictionaries; anything else, which could run code
    of the file's, is refused.
    """

    def find_class(self, module: str, name: str) -> Any:
        if (module.replace("numpy._core", "numpy.core"), name) in _OF_ARRAYS:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"it holds an object of {module}.{name}, which is not loaded")


def read_pickled_arrays(path: Path) -> Mapping[str, np.ndarray]:
    """Read the arrays of a dictionary that `numpy.save` pickled; members that are None, or lists of
    no array's form, are left out.

    Raises:
        DataError: the file is missing or damaged, or holds anything but arrays and numbers by name.
    """
    try:
        check_regular(path)
        with path.open("rb") as stream:
            _npy_header(stream)
            found = _ArraysAlone(stream).load().item()
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}; give a readable file"
        ) from error
    except (pickle.UnpicklingError, *_UNPICKLED) as error:
        raise DataError(
            f"{path}: no arrays can be read of it ({error}); save them by name with numpy.savez"
        ) from error
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found):
        raise DataError(
            f"{path}: holds no arrays by name, but {type(found).__name__}; save them with numpy.savez"
        )
    arrays = {}
    for name, value in found.items():
        with contextlib.suppress(ValueError):  # rows of different lengths
            if value is not None:
                arrays[name] = np.asarray(value)
    check_array_bytes({name: array.nbytes for name, array in arrays.items()}, path)
    return arrays
