"""Errors that a user can correct. Each message states what is wrong, where, and what to do."""

from __future__ import annotations

# Level of a log line that says what was found or assumed, and asks for nothing: between info and
# warning.
NOTE = 25


def extra_text(name: str) -> str:
    """Return how to install an extra of this package, for messages; it is on no package index."""
    return (
        f"install the extra {name}: python -m pip install '.[{name}]' in a clone, or "
        f"'FILE.whl[{name}]' with the wheel"
    )


class VioError(Exception):
    """An expected failure; the command line prints its message in one line and exits with 1."""


class ConfigError(VioError):
    """A setting is unknown, of the wrong type, or contradicts another."""


class DataError(VioError):
    """A recording, feature file or trajectory cannot be used as it is."""


class OrderError(DataError):
    """A time that is not after the last one."""


class CalibrationError(DataError):
    """A calibration is missing or invalid (zero baseline, reflected rotation, …)."""


class EstimationError(VioError):
    """The estimator cannot continue (divergence, failed initialisation)."""


class DivergedError(EstimationError):
    """The filter's state is no longer usable; a filter that can restart goes on from its last
    good state.
    """


class EvaluationError(VioError):
    """Two trajectories cannot be compared."""


class SimulationError(VioError):
    """A scene, trajectory or setting cannot be simulated as requested."""


class MissingDependencyError(VioError):
    """An optional package is needed; the message names the extra to install."""


class StoppedError(VioError):
    """A run ended before its recording, in order; its results so far are written."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status  # exit status of a command
