"""Calibration files as a `Rig`, of the tools that people calibrate with and the data sets that
they use, detected from the content (`formats.py`).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vio.datasets.rigs.formats import find_calibration, load_rig
    from vio.datasets.rigs.kitti_odometry import kitti_rig

__all__ = ["find_calibration", "kitti_rig", "load_rig"]

_MODULES = {  # loaded when the name is first used: `formats` loads the readers of all formats
    "find_calibration": "formats",
    "kitti_rig": "kitti_odometry",
    "load_rig": "formats",
}


def __getattr__(name: str) -> object:
    """Load a public name when it is first used."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"vio.datasets.rigs.{_MODULES[name]}"), name)
