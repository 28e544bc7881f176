"""How noisy the motion model really is, learned from how far each prediction was off once the images had spoken."""

from __future__ import annotations

import numpy as np

from vio.geometry.lie import FloatArray

_STEPS = 10  # over which corrections are added up: errors that last show only in their sum
_GAIN = 0.5  # how fast the factors follow, per sum
_MEDIAN = 0.79  # of chi-square with 3 degrees of freedom, over 3
_PARTS = slice(0, 3), slice(3, 6)  # translation, rotation
_TELLING = 0.3  # share of the predicted variance that the images must have removed for a step to count


class MotionNoise:
    """Factors on the motion model's noise densities, one for translation and one for rotation.

    A data sheet knows the sensor on the bench; vibration, misalignment and sampling add to it, by a factor that differs
    from rig to rig. The corrections that the images made to the predicted motion are compared with their covariance,
    the predicted minus the remaining one, which moves the factor a little. Corrections are added up over some steps:
    those of a filter whose noise is right are white, and errors that last, such as a gyro's scale, add up.
    Reference: Mehra, Approaches to adaptive filtering, IEEE TAC (1972), for matching the innovations' covariance.
    """

    def __init__(self, start: float, smallest: float, largest: float) -> None:
        """Start both factors at the same value and keep them between two bounds; all on standard deviations."""
        self.factors: FloatArray = np.array([start, start])  # translation, rotation
        self._bounds = smallest, largest
        self._sum: FloatArray = np.zeros(6)
        self._removed, self._share, self._steps = np.zeros(2), np.zeros(2), 0

    def follow(self, correction: FloatArray, expected: FloatArray, process: FloatArray, remaining: FloatArray) -> None:
        """Learn from one step.

        Args:
            correction: what the images added to the predicted motion (6,), `[rho; phi]` in the body frame, m and rad.
            expected: covariance (6, 6) of the predicted motion.
            process: the part of it that the motion model's noise added in this step (6, 6).
            remaining: covariance (6, 6) of the motion after the update.
        """
        before, after, added = (np.array([np.trace(C[p, p]) for p in _PARTS]) for C in (expected, remaining, process))
        if np.any(before - after < _TELLING * before):
            return
        self._removed += before - after
        self._share += added / before
        self._sum += correction
        self._steps += 1
        if self._steps < _STEPS:
            return
        for k, part in enumerate(_PARTS):
            ratio = float(np.clip(self._sum[part] @ self._sum[part] / self._removed[k] / _MEDIAN, 0.25, 4.0))
            share = self._share[k] / self._steps
            self.factors[k] = np.clip(self.factors[k] * ratio ** (0.5 * _GAIN * share), *self._bounds)
        self._sum[:], self._removed[:], self._share[:], self._steps = 0, 0, 0, 0
