"""Calibration files as a `Rig`, of the tools that people calibrate with and the data sets that
they use, detected from the content (`formats.py`).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vio.datasets.rigs.formats import find_calibration, kitti_rig, load_rig

__all__ = ["find_calibration", "kitti_rig", "load_rig"]


def __getattr__(name: str) -> object:
    """Load a public name with the readers of all formats, when it is first used."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("vio.datasets.rigs.formats"), name)
