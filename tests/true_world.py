"""The world of a filter's estimates in the true one."""

from __future__ import annotations

import numpy as np

from vio.filters.msckf import Msckf
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, so3_exp


class TrueWorld:
    """Puts estimates where the truth is: by the first pose, which the filter takes as known.

    With an IMU that is its position and yaw, as the world is upright then and the first tilt is an
    estimate like any other. Where the world stays that of the first frames, equation (N14), it is
    the whole pose as it was known then.
    """

    def __init__(self, filt: Msckf, *, upright: bool) -> None:
        self._filter, self._upright = filt, upright
        self._index: int | None = None  # of the first frame
        self._first_true: FloatArray = np.eye(4)
        # its estimate with all frames that it is in one window with
        self._first: FloatArray = np.eye(4)
        self.T: FloatArray = np.eye(4)  # takes points of the estimates' world to the true one

    def meet(self, index: int, T_true: FloatArray) -> FloatArray:
        """Take the newest frame's number and true pose (4, 4); return the estimated one in the
        true world.
        """
        estimate = self._filter.estimate()
        if self._index is None:
            self._index, self._first_true = index, T_true
            self.T = T_true @ se3_inverse(estimate.T_world_imu)
            if self._upright:
                R = self.T[:3, :3]
                yaw = so3_exp([0, 0, np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])])
                self.T = se3_from_parts(yaw, T_true[:3, 3] - yaw @ estimate.T_world_imu[:3, 3])
        first = self._filter.smoothed(self._index)
        if estimate.gravity_world is None:
            self._first = estimate.T_world_imu if first is None else first.T_world_imu
        elif self._upright:
            self.T = self._first_true @ se3_inverse(self._first)
        return np.asarray(self.T @ estimate.T_world_imu)
