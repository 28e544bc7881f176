"""Faults of an IMU, its clock or its extrinsics, and their messages."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

from vio.dataclass import dataclass

InertialFault: TypeAlias = Literal[
    "clocks without overlap",
    "clocks overlap in part",
    "clocks apart",
    "accelerometer units",
    "gravity removed",
    "gyro units",
    "gyro sign",
    "gyro axes",
    "gyro dead",
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
    "camera scale",
]

# A second finding of a group would repeat the first.
_GROUPS: dict[str, tuple[InertialFault, ...]] = {
    "overlap": ("clocks without overlap", "clocks overlap in part", "clocks apart"),
    "size": ("accelerometer units", "gravity removed"),
    "rotation": (
        "gyro sign",
        "gyro axes",
        "gyro dead",
        "gyro disagrees",
        "extrinsics inverted",
        "extrinsics rotation",
    ),
    "force": ("accelerometer sign", "accelerometer axes", "upside down"),
}
# With any of these the readings are of no use to a filter, unless a factor on them is all that is
# wrong.
_UNUSABLE = {
    *_GROUPS["size"],
    *_GROUPS["rotation"],
    "gyro units",
    "accelerometer sign",
    "accelerometer axes",
}
# Clocks further apart are none that a filter which begins with them together can be left to find.
MAX_FOLLOWED_OFFSET_S = 0.1


_CODES: dict[InertialFault, str] = {
    "clocks without overlap": "imu-clock",
    "clocks overlap in part": "imu-clock",
    "clocks apart": "imu-clock",
    "accelerometer units": "imu-units",
    "gravity removed": "imu-units",
    "gyro units": "imu-units",
    "gyro sign": "imu-axes",
    "gyro axes": "imu-axes",
    "gyro dead": "imu-readings",
    "gyro disagrees": "imu-disagrees",
    "extrinsics inverted": "imu-axes",
    "extrinsics rotation": "imu-axes",
    "extrinsics translation": "imu-axes",
    "accelerometer sign": "imu-axes",
    "accelerometer axes": "imu-axes",
    "upside down": "imu-axes",
    "saturation": "imu-saturated",
    "IMU gap": "imu-gap",
    "camera stamps": "imu-clock",
    "camera turns": "imu-disagrees",
    "camera scale": "scale-off",
}


@dataclass(frozen=True, slots=True)
class ImuVerdict:
    """What is left of an IMU by what was found."""

    usable: bool = True
    gyro_factor: float = 1.0  # on its readings
    accel_factor: float = 1.0
    # by which both readings are turned, rad, of the IMU's frame
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # they look useless, which is not certain yet, or why is not known
    in_doubt: bool = False

    @property
    def used(self) -> bool:
        """Whether readings are used, for now."""
        return self.usable and not self.in_doubt

    def after(self, finding: InertialFinding) -> ImuVerdict:
        """Return the verdict with one more finding."""
        if not finding.is_disabling:
            return self
        if finding.turn_rad is not None:
            return replace(self, turn_rad=finding.turn_rad)
        if finding.factor is None:
            return replace(self, usable=False)
        if finding.fault == "gyro units":
            return replace(self, gyro_factor=finding.factor)
        return replace(self, accel_factor=finding.factor)


@dataclass(frozen=True, slots=True)
class InertialFinding:
    """One fault of the IMU, its clock or its extrinsics."""

    fault: InertialFault
    seen: str  # the observation, with figures
    explanation: str  # the likely cause, and what to do
    certain: bool = True  # False: a hint; correct data can look like this
    # that takes the unit of these readings to rad/s or m/s^2; None: none does
    factor: float | None = None
    # a frame stamped t was exposed at t + this of the IMU's clock; None: not what was found
    offset_s: float | None = None
    # that turns the readings as the given extrinsics want them, of the IMU's frame; None: none does
    turn_rad: tuple[float, float, float] | None = None

    @property
    def code(self) -> str:
        """Its code in `vio.findings`."""
        return _CODES[self.fault] if self.certain else "imu-suspected"

    @property
    def is_disabling(self) -> bool:
        """Whether the readings are of no use to a filter, unless they are multiplied by a factor or
        turned.
        """
        too_far = self.offset_s is not None and abs(self.offset_s) > MAX_FOLLOWED_OFFSET_S
        return self.certain and (self.fault in _UNUSABLE or too_far)

    @property
    def message(self) -> str:
        """One line for the log."""
        return f"{self.fault}: {self.seen}; {self.explanation}"

    @property
    def group(self) -> str:
        """The group of related faults; only one finding of each is reported."""
        return next((name for name, faults in _GROUPS.items() if self.fault in faults), self.fault)
