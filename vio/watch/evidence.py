"""What one look at a run has to judge an IMU by, before anything is judged."""

from __future__ import annotations

from dataclasses import dataclass

from vio.geometry.lie import FloatArray
from vio.watch.force import ForceFit
from vio.watch.turning import Turning

FIRST_LOOK = 60  # intervals before the first look; fewer are there only when a run ends


@dataclass(frozen=True, slots=True)
class Evidence:
    """The fits of gyro and accelerometer to the images, and the state of the watch."""

    R_cam0_imu: FloatArray  # (3, 3) as given
    turning: Turning
    force: ForceFit | None  # None: too few windows are tracked throughout, or the readings have no unit
    told: bool  # `force` will not come to know more: what it leaves open is judged without it
    clipped: bool  # readings at the end of the range were found, which make turns look smaller
    last: bool  # no later look will follow

    @property
    def brief(self) -> bool:
        """Whether this is less than any look during a run has."""
        return self.turning.count < FIRST_LOOK
