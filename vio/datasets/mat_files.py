"""Variables of MATLAB's files."""

from __future__ import annotations

import errno
import math
import zlib
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from vio.datasets.common import check_array_bytes
from vio.errors import DataError
from vio.files.inputs import check_regular

SUFFIX = ".mat"
Shapes: TypeAlias = Mapping[str, tuple[int, ...]]  # of variables, by name
HELD_OBJECT = (
    "holds an object of MATLAB's, which nothing else reads; save its numbers: "
    "s = toStruct(stereoParams); save('stereo.mat', 's', '-v7')"
)
_OBJECTS = ("opaque", "object")  # classes of what only MATLAB itself can read


def holds_object(path: Path) -> bool:
    """Return whether a MATLAB file that can be read holds an object, maybe beside other
    variables.
    """
    from scipy.io import whosmat

    return any(kind in _OBJECTS for _, _, kind in whosmat(path))


def read_variables(
    path: Path, wanted: Callable[[Shapes], Collection[str]], *, plain: bool = False
) -> tuple[Shapes, Mapping[str, Any]]:
    """Return the shapes of all variables of a MATLAB file, and some of them.

    Args:
        path: the file.
        wanted: names of those to read, if they are there, by the shapes of all.
        plain: structures become dictionaries, and arrays lose axes of length one.

    Raises:
        DataError: it cannot be read, is damaged or too large, or holds objects alone.
    """
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError

    damage = (
        MatReadError,
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        EOFError,
        MemoryError,
        zlib.error,
    )
    try:
        check_regular(path)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        held = whosmat(path)
        if held and all(kind in _OBJECTS or name.startswith("__") for name, _, kind in held):
            raise DataError(f"{path}: {HELD_OBJECT}")
        shapes = {name: shape for name, shape, _ in held}
        chosen = wanted(shapes)
        names = [name for name in shapes if name in chosen]
        check_array_bytes({name: 8 * math.prod(shapes[name]) for name in names}, path)
        found = loadmat(path, mat_dtype=True, variable_names=names, simplify_cells=plain)
    except NotImplementedError as error:
        raise DataError(f"{path}: a MATLAB 7.3 file; save it again with `save -v7`") from error
    except damage as error:
        raise DataError(f"{path}: is damaged or no MATLAB file ({error}); copy it again") from error
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}; copy it again") from error
    return shapes, found
