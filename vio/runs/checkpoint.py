"""The state of an unfinished run in a file, from which it goes on to the same bits.

The file is a line of JSON, which says what program wrote it, and a pickle. Loading accepts the classes of the estimator
and of NumPy only, so a file from elsewhere cannot call anything else.
"""

from __future__ import annotations

import io
import json
import pickle
import platform
from pathlib import Path
from typing import Any

import numpy as np

from vio._version import __version__
from vio.files.atomic import atomic_write_bytes
from vio.errors import DataError
from vio.protocols import Dataset

_FORMAT = "stereo-vio checkpoint"
_PACKAGES = (
    *("vio.filters.", "vio.frontend.", "vio.geometry.", "vio.imu.", "vio.live.", "vio.mapping.", "vio.monitor."),
    "vio.selection.",
)
_MODULES = ("vio.config", "vio.datasets.frame_rate", "vio.datasets.settings", "vio.records", "vio.runs.pipeline", "vio.runs.dead_reckoning")
_OTHERS = {
    ("collections", "deque"),
    ("builtins", "set"),
    ("builtins", "frozenset"),
    ("builtins", "slice"),
    ("builtins", "complex"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy.random._pickle", "__bit_generator_ctor"),
    ("numpy.random._pickle", "__generator_ctor"),
    ("numpy.random._pcg64", "PCG64"),
    ("numpy.random.bit_generator", "__pyx_unpickle_SeedSequence"),
    ("numpy.random.bit_generator", "SeedSequence"),
}


class NotSavableError(Exception):
    """A part of the run holds what cannot be saved."""


def save_checkpoint(path: Path, state: Any, dataset: Dataset) -> None:
    """Write a state atomically; the recording itself, where the state refers to it, is left out.

    Raises:
        NotSavableError: a part of the state cannot be saved.
        DataError: the file cannot be written.
    """
    stream = io.BytesIO()
    stream.write(json.dumps(_program()).encode() + b"\n")
    try:
        _Pickler(stream, dataset).dump(state)
    except (TypeError, AttributeError, pickle.PicklingError) as error:
        raise NotSavableError(str(error)) from error
    atomic_write_bytes(path, stream.getvalue())


def load_checkpoint(path: Path, dataset: Dataset) -> Any:
    """Read a state; what referred to the recording refers to `dataset` then.

    Raises:
        DataError: the file is damaged, or another program wrote it.
    """
    try:
        data = path.read_bytes()
        head, _, body = data.partition(b"\n")
        written, now = json.loads(head), _program()
        if written != now:
            differ = ", ".join(
                f"{key} {written.get(key)}, now {now[key]}" for key in now if written.get(key) != now[key]
            )
            raise DataError(f"{path}: was written by another program ({differ}); repeat the run from its start")
        return _Unpickler(io.BytesIO(body), dataset).load()
    except (OSError, ValueError, AttributeError, TypeError, KeyError, EOFError, pickle.UnpicklingError) as error:
        raise DataError(f"{path}: is damaged ({error}); repeat the run from its start") from error


def _program() -> dict[str, str]:
    """What must be equal for equal bits."""
    import cv2
    import numba

    return {
        "format": _FORMAT,
        "version": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "numba": numba.__version__,
    }


class _Pickler(pickle.Pickler):
    def __init__(self, stream: io.BytesIO, dataset: Dataset) -> None:
        super().__init__(stream, protocol=5)
        self._dataset = dataset

    def persistent_id(self, obj: Any) -> str | None:
        if obj is self._dataset:
            return "dataset"
        if getattr(obj, "__self__", None) is self._dataset and getattr(obj, "__name__", "") == "observations":
            return "observations"
        return None


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: io.BytesIO, dataset: Dataset) -> None:
        super().__init__(stream)
        self._dataset = dataset

    def find_class(self, module: str, name: str) -> Any:
        ours = module in _MODULES or module.startswith(_PACKAGES)
        if not ours and (module, name) not in _OTHERS:
            raise pickle.UnpicklingError(f"{module}.{name} does not belong into a checkpoint")
        found = super().find_class(module, name)
        if ours and not isinstance(found, type):
            raise pickle.UnpicklingError(f"{module}.{name} is no class")
        return found

    def persistent_load(self, pid: Any) -> Any:
        return {"dataset": self._dataset, "observations": self._dataset.observations}[pid]
