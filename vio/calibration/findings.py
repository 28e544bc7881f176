"""Results other than values: why a quantity is not observable, and faults of a given
calibration.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

from vio.dataclass import dataclass

Fault: TypeAlias = Literal[
    "cameras swapped",
    "baseline translation inverted",
    "left-right rotation wrong",
    "baseline direction wrong",
    "focal length wrong",
    "principal point wrong",
    "IMU-camera rotation wrong",
    "IMU-camera rotation inverted",
    "IMU-camera translation inverted",
    "IMU-camera translation wrong",
    "clocks apart",
]


@dataclass(frozen=True, slots=True)
class NotObservable:
    """Replaces an estimate and gives the reason why there is none."""

    what: str
    because: str

    def __str__(self) -> str:
        return f"{self.what} not observable because {self.because}"


@dataclass(frozen=True, slots=True)
class Finding:
    """One fault of a given calibration, with a description and figures."""

    fault: Fault
    detail: str

    def __str__(self) -> str:
        return f"{self.fault}: {self.detail}"
