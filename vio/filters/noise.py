"""How noisy the motion model really is, learned from how far each prediction was off once the images had spoken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.geometry.lie import FloatArray

_STEPS = 10  # over which corrections are added up: errors that last show only in their sum
_GAIN = 0.5  # how fast the factors follow, per sum
_MEDIAN = 0.79  # of chi-square with 3 degrees of freedom, over 3
_SURPRISE = 9.0  # squared correction over its variance, from which a step is taken for an exception
_MOST = 1e6
_PARTS = slice(0, 3), slice(3, 6)  # translation, rotation
_TELLING = 0.3  # share of the predicted variance that the images must have removed for a step to count


@dataclass(frozen=True, slots=True)
class StepErrors:
    """One predicted step beside what the images made of it, in the body frame, `[rho; phi]`, m and rad."""

    correction: FloatArray  # (6,) what the images added to the predicted motion
    expected: FloatArray  # (6, 6) covariance of the predicted motion
    process: FloatArray  # (6, 6) the part of it that the motion model's noise added in this step
    remaining: FloatArray  # (6, 6) covariance of the motion after the update

    def traces(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Variances (2,) of translation and rotation: expected, remaining, process."""
        expected, remaining, process = (
            np.array([np.trace(C[p, p]) for p in _PARTS]) for C in (self.expected, self.remaining, self.process)
        )
        return expected, remaining, process

    def missing_noise(self) -> FloatArray:
        """By how many times (2,) its own the process noise was too small to explain the correction; 0 where it was not.

        A shock, a saturated sensor, or a step of the vehicle that its model cannot make.
        """
        before, after, added = self.traces()
        out = np.zeros(2)
        for k, part in enumerate(_PARTS):
            removed = before[k] - after[k]
            ratio = float(self.correction[part] @ self.correction[part]) / max(removed, 1e-30)
            if removed > _TELLING * before[k] and ratio > _SURPRISE:
                out[k] = min((ratio - 1) * before[k] / max(added[k], 1e-30), _MOST)
        return out


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

    def follow(self, step: StepErrors) -> None:
        """Learn from one step."""
        before, after, added = step.traces()
        if np.any(before - after < _TELLING * before):
            return
        self._removed += before - after
        self._share += added / before
        self._sum += step.correction
        self._steps += 1
        if self._steps < _STEPS:
            return
        for k, part in enumerate(_PARTS):
            ratio = float(np.clip(self._sum[part] @ self._sum[part] / self._removed[k] / _MEDIAN, 0.25, 4.0))
            share = self._share[k] / self._steps
            self.factors[k] = np.clip(self.factors[k] * ratio ** (0.5 * _GAIN * share), *self._bounds)
        self._sum[:], self._removed[:], self._share[:], self._steps = 0, 0, 0, 0
