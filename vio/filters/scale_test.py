"""Test while running whether IMU or velocities contradict the scale that the calibrated baseline
gives.

The filter takes the scale for known. Beside it runs the estimate of its logarithm `s` that the
filter would have with it as a state, from how the prior's mean depends on it: Friedland's
separate-bias filter, equations (S1) to (S3) of docs/math.md. It costs one vector and changes
nothing: what it finds is reported, and how the errors depend on the scale gives what an uncertain
baseline adds to their covariance, equation (S4).
Reference: Friedland, Treatment of bias in recursive filtering, IEEE TAC (1969).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.filters import pose_loops as loops
from vio.geometry.lie import FloatArray
from vio.numerics.statistics import squared_distance


class _ScaleRules(NamedTuple):
    """When a motion sensor contradicts the scale."""

    # of the logarithm; a unit that is wrong is off by more, and is found as well
    log_sigma: float = 0.1
    # More than correct baselines show (docs/notes/design_decisions.md, contradiction of the scale).
    min_log: float = 0.04
    min_sigmas: float = 5.0
    # The accelerometer's noise is in the motion that is held against the images, and there passes
    # for motion at twice the scale. It has three degrees of freedom in a frame, of which images
    # determine a part: 0.1 of information on a recording of standstill, with more where the real
    # noise is that of the settings. One is allowed for.
    information_by_noise: float = 1.0
    # A velocity's squared standard deviations beyond which its own error makes less than 3 % of
    # what it says of the scale.
    clear_squared_sigmas: float = 100.0


_SCALE = _ScaleRules()
# Of rigs whose scale is as calibrated, what the test finds has this standard deviation beside its
# own: half of the least that it reports.
_USUAL_SIGMA = 0.5 * _SCALE.min_log
# Weight of a wrong calibration before anything was measured. What it adds is small where the sensor
# agrees, whatever the weight.
_WRONG_SHARE = 0.25
_WEIGHTS = np.array([1.0 - _WRONG_SHARE, _WRONG_SHARE])  # of a right and a wrong calibration
_VARIANCES = np.array([_USUAL_SIGMA, _SCALE.log_sigma]) ** 2  # likewise, of the logarithm
# of the information that is allowed for noise: from that at standstill on, all are as likely
_NOISE_SHARES = np.linspace(0.1, 1.0, 10)
_MAX_BY_NOISE = 0.99  # of what was measured: all of it would leave nothing to judge by


def is_clear(velocity: FloatArray, covariance: FloatArray) -> bool:
    """Whether a velocity (3,) of a covariance (3, 3) is far enough from its noise to tell the
    scale.
    """
    return squared_distance(velocity, covariance, 1e-18) > _SCALE.clear_squared_sigmas


def scaled_nav(T_world_imu: FloatArray, velocity: FloatArray, T_cam0_imu: FloatArray) -> FloatArray:
    """How the error (15,) of a navigation state, of pose (4, 4) and velocity (3,), moves with the
    logarithm of the world's scale, equation (S1).
    """
    out: FloatArray = np.empty(15)
    loops.scale_nav(T_world_imu, T_cam0_imu, velocity, out)
    return out


class ScaleTest:
    """The estimate of the logarithm of the scale beside a filter of D errors that takes it for
    zero.

    The errors are those of a world that is scaled with s, so no pixel depends on it, whatever the
    estimates: relinearising cannot pass for knowledge of the scale.
    """

    def __init__(self) -> None:
        """Start without knowledge."""
        self._frames = 0  # since the start
        # at which of them the scale was contradicted without a break since; 0: it is not
        self._doubted = 0
        self._information = _SCALE.log_sigma**-2
        self._vector = 0.0
        # whether as many frames again have contradicted it as it took to find
        self.is_confirmed = False

    def end_frame(self) -> None:
        """Count a frame, and ask whether the scale is contradicted."""
        self._frames += 1
        if not self._contradicted:
            self._doubted = 0
        elif not self._doubted:
            self._doubted = self._frames
        self.is_confirmed |= self._doubted > 0 and self._frames >= 2 * self._doubted

    def absorb(self, V: FloatArray, W: FloatArray, remaining: FloatArray, P: FloatArray) -> None:
        """Take in measurements that the filter has absorbed, equations (S2) and (S3).

        Args:
            V: how the errors (D,) depend on the scale, for measurements in metres those of the
                scaled world.
            W: their information (D, D) times V, (D,).
            remaining: their information vector (D,) at the means after them.
            P: covariance of the errors (D, D) after them.

        What they say is 0 or more; where positions are known to kilometres only, after a clock that
        stepped by an hour, rounding may leave less than the start had, and they are passed over. So
        are those of a filter that has diverged, as a new start keeps what is known of the scale.
        """
        information = self._information + float(V @ W - W @ P @ W)
        vector = self._vector + float(V @ remaining)
        if not information >= _SCALE.log_sigma**-2 or not np.isfinite(vector):
            return
        self._information = information
        self._vector = vector

    def estimate(self) -> tuple[float, float]:
        """Logarithm of the true scale over the filter's, and its standard deviation."""
        return self._vector / self._information, self._information**-0.5

    def doubt(self) -> float:
        """By what the scale may be off beside what is reported, as a standard deviation over it.

        The calibration is right, or it is not and the scale is anywhere: a mixture of two normal
        distributions, whose weights follow from what was measured by Bayes' rule. So does the share
        of it that is the sensor's noise, which is not known: a scale that noise may explain, or
        hide, is not refused. Without a measurement it is zero: then the calibration counts.
        """
        measured = self._information - _SCALE.log_sigma**-2
        if measured <= 0.0:
            return 0.0
        # what noise adds to information and vector alike
        by_noise = _NOISE_SHARES * min(
            _SCALE.information_by_noise * self._frames, _MAX_BY_NOISE * measured
        )
        information = measured - by_noise
        vector = self._vector - by_noise
        variances = _VARIANCES[:, None] + 1.0 / information
        likelihoods = -0.5 * ((vector / information) ** 2 / variances + np.log(variances))
        weights = _WEIGHTS[:, None] * np.exp(likelihoods - likelihoods.max())
        logs = vector / (information + _SCALE.log_sigma**-2)  # of a wrong calibration
        return float(np.sqrt(weights[1] @ logs**2 / weights.sum()))

    @property
    def _contradicted(self) -> bool:
        """Whether the scale is off significantly, by more than is harmless and than the sensor's
        noise explains.
        """
        s, sigma = self.estimate()
        return abs(s) > max(
            _SCALE.min_log + _SCALE.information_by_noise * self._frames / self._information,
            _SCALE.min_sigmas * sigma,
        )
