"""Stereo visual-inertial odometry: datasets, filters, selection, evaluation and results.

Importing this package loads nothing heavy; in particular it never imports torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from vio._version import __version__

if TYPE_CHECKING:
    from vio.cameras.rig import Rig
    from vio.config import load_config
    from vio.datasets import open_dataset
    from vio.datasets.observation_log import write_observations
    from vio.datasets.rigs import load_rig
    from vio.evaluation.trajectories import evaluate
    from vio.integrity import protection_level
    from vio.live.build import MapUse, Parts
    from vio.live.live_odometry import LiveOdometry
    from vio.live.odometry import Odometry
    from vio.runs.pipeline import RunControl, run

__all__ = [
    "LiveOdometry",
    "MapUse",
    "Odometry",
    "Parts",
    "Rig",
    "RunControl",
    "__version__",
    "evaluate",
    "load_config",
    "load_rig",
    "open_dataset",
    "protection_level",
    "run",
    "write_observations",
]

_MODULES = {  # loaded when the name is first used
    "LiveOdometry": "vio.live.live_odometry",
    "MapUse": "vio.live.build",
    "Odometry": "vio.live.odometry",
    "Parts": "vio.live.build",
    "Rig": "vio.cameras.rig",
    "RunControl": "vio.runs.pipeline",
    "evaluate": "vio.evaluation.trajectories",
    "load_config": "vio.config",
    "load_rig": "vio.datasets.rigs",
    "open_dataset": "vio.datasets",
    "protection_level": "vio.integrity",
    "run": "vio.runs.pipeline",
    "write_observations": "vio.datasets.observation_log",
}


def __getattr__(name: str) -> object:
    """Load a public name from its module."""
    if name not in _MODULES:
        raise AttributeError(f"module 'vio' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
