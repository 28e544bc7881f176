"""The simulator's expected errors."""

from __future__ import annotations

from vio.errors import VioError


class SimulationError(VioError):
    """A scene, trajectory or setting cannot be simulated as requested."""
