"""The data that one evaluation of a run judges an IMU by."""

from __future__ import annotations

from dataclasses import dataclass

from vio.geometry.lie import FloatArray
from vio.monitor.force_fit import ForceFit
from vio.monitor.gyro_fit import GyroFit

FIRST_EVALUATION = 60  # intervals before the first evaluation; there are fewer only at the end of a short run


@dataclass(frozen=True, slots=True)
class Evidence:
    """The fits of gyro and accelerometer to the images, and the state of the check."""

    R_cam0_imu: FloatArray  # (3, 3) as given
    gyro_fit: GyroFit
    force: ForceFit | None  # None: too few windows without tracking loss, or the readings have no unit
    early_force: ForceFit | None  # likewise, from fewer windows: enough for axes that are clearly wrong
    force_final: bool  # `force` will not improve: what it leaves undecided is judged without it
    clipped: bool  # readings at the end of the range were found, which make rotations appear smaller
    last: bool  # no later evaluation will follow

    @property
    def brief(self) -> bool:
        """Whether there are fewer intervals than in any evaluation during a run."""
        return self.gyro_fit.count < FIRST_EVALUATION
