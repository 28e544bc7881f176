"""Stereo visual-inertial odometry: datasets, filters, selection, evaluation and results.

Importing this package loads nothing heavy; in particular it never imports torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vio._version import __version__

if TYPE_CHECKING:
    from vio.datasets.rigs import load_rig
    from vio.rig import Rig

__all__ = ["Rig", "__version__", "load_rig"]

_LAZY = {"Rig": "vio.rig", "load_rig": "vio.datasets.rigs"}  # loaded when first used


def __getattr__(name: str) -> object:
    """Load a public name from its module."""
    if name not in _LAZY:
        raise AttributeError(f"module 'vio' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_LAZY[name]), name)
