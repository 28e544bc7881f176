"""Faults of an IMU, its clock or its extrinsics, and their messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

InertialFault: TypeAlias = Literal[
    "clocks without overlap",
    "clocks overlap in part",
    "clocks apart",
    "accelerometer units",
    "gravity removed",
    "gyro units",
    "gyro sign",
    "gyro axes",
    "gyro disagrees",
    "extrinsics inverted",
    "extrinsics rotation",
    "extrinsics translation",
    "accelerometer sign",
    "accelerometer axes",
    "upside down",
    "saturation",
    "IMU gap",
    "camera stamps",
    "camera turns",
]

# A second finding of a group would repeat the first.
_GROUPS: dict[InertialFault, str] = {
    "clocks without overlap": "overlap",
    "clocks overlap in part": "overlap",
    "clocks apart": "overlap",
    "accelerometer units": "size",
    "gravity removed": "size",
    "gyro sign": "rotation",
    "gyro axes": "rotation",
    "gyro disagrees": "rotation",
    "extrinsics inverted": "rotation",
    "extrinsics rotation": "rotation",
    "accelerometer sign": "force",
    "accelerometer axes": "force",
    "upside down": "force",
}


@dataclass(frozen=True, slots=True)
class InertialFinding:
    """One fault of the IMU, its clock or its extrinsics."""

    fault: InertialFault
    seen: str  # the observation, with figures
    explanation: str  # the likely cause, and what to do
    certain: bool = True  # False: a hint; correct data can look like this

    @property
    def message(self) -> str:
        """One line for the log."""
        return f"{self.fault}: {self.seen}; {self.explanation}"

    @property
    def group(self) -> str:
        """The group of related faults; only one finding of each is reported."""
        return _GROUPS.get(self.fault, self.fault)
