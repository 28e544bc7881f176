"""The motion model's process noise, learned from how much the images correct each predicted
motion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.filters import gate_loops as loops
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Tolerance
from vio.numerics.statistics import chi_square_cdf, chi_square_quantile


class _NoiseRules(NamedTuple):
    """How the process noise is learned from the corrections."""

    # over which corrections are summed: errors that last, such as a gyro's scale, show only in the
    # sum
    summed_steps: int = 10
    # share of its predicted variance that the images must have removed for a direction to count
    informed_share: float = 0.3
    # … and for one to count in which nearly nothing was removed, but what was is an exception: of a
    # sensor that is thought far better than the images, and is not
    doubted_share: float = 0.02
    # chi-square probability beyond which a sum is one; twice in a row is as rare as a single step
    exception_probability: float = 0.99
    # initial standard deviation of the logarithm of the squared factor
    log_variance_sigma: float = 1.5
    log_variance_walk: float = 0.15  # its random walk per sum of steps
    # chi-square probability beyond which a single step is an exception
    surprise_probability: float = 0.9999
    max_factor: Tolerance[float] = 1e6


_NOISE = _NoiseRules()
_SURPRISING = chi_square_quantile(_NOISE.surprise_probability, np.arange(1, 4)).tolist()
_EXCEPTIONAL = chi_square_quantile(_NOISE.exception_probability, np.arange(1, 4)).tolist()
TRANSLATION = slice(0, 3)  # of a motion (6,)
ROTATION = slice(3, 6)
_PARTS = TRANSLATION, ROTATION
SLIGHTLY_INFORMED = _NOISE.doubted_share
# d E[2 F_k(e^t x) - 1] / dt at t = 0 for x ~ chi-square(k), k = 0..3
_SENSITIVITY = (0.0, 1 / np.pi, 0.5, 2 / np.pi)


@dataclass(frozen=True, slots=True)
class StepErrors:
    """One predicted step, or the sum of several, and its correction by the images; body frame,
    `[rho; phi]`, m, rad.
    """

    correction: FloatArray  # (6,) what the images added to the predicted motion
    expected: FloatArray  # (6, 6) covariance of the predicted motion
    process: FloatArray  # (6, 6) the part of it that the motion model's noise added in this step
    remaining: FloatArray  # (6, 6) covariance of the motion after the update

    def __add__(self, other: StepErrors) -> StepErrors:
        """Sum the corrections of two steps; those of a filter with the right noise are
        uncorrelated.
        """
        return StepErrors(
            self.correction + other.correction,
            self.expected + other.expected,
            self.process + other.process,
            self.remaining + other.remaining,
        )

    def missing_noise(self) -> FloatArray:
        """By how many times (2,) its own the process noise was too small to explain the correction;
        0 where it was not.

        A shock, a saturated sensor, or a step of the vehicle that its model cannot make.
        """
        out = np.zeros(2)
        for k, part in enumerate(_PARTS):
            test = whitened_correction(self, part)
            if test.dof and test.squared > _SURPRISING[test.dof - 1]:
                out[k] = min(
                    (test.squared / test.dof - 1) / max(test.share, 1e-12), _NOISE.max_factor
                )
        return out


@dataclass(frozen=True, slots=True)
class WhitenedCorrection:
    """A correction in units of its own standard deviation, in the directions that the images
    inform.
    """

    squared: float  # chi-square distributed with `dof` degrees of freedom if the noise is right
    dof: int  # 0 to 3
    # of the predicted variance in these directions, what the process noise of the steps brought
    share: float


def whitened_correction(
    step: StepErrors, part: slice, informed_share: float = _NOISE.informed_share
) -> WhitenedCorrection:
    """Test one part (translation or rotation) of a correction against its covariance,
    `expected - remaining`.

    Directions are the eigenvectors of the removed share of the predicted covariance; those in which
    the images removed little say little about the motion model and are left out.
    """
    errors = step.correction, step.expected, step.process, step.remaining
    found = WhitenedCorrection(*loops.whiten_correction(*errors, part.start, informed_share))
    if math.isnan(found.squared):
        raise np.linalg.LinAlgError("the predicted covariance is not positive")
    return found


def turn_shown(step: StepErrors) -> FloatArray:
    """Return the rotation (3,) by which the images alone contradict a predicted one, from the share
    of it that a filter which trusts the prediction has corrected.

    With `expected` E and `remaining` R, the gain of a direct measurement of it is (E - R) E^-1;
    directions that the images hardly inform count as not contradicted.
    """
    E = step.expected[ROTATION, ROTATION]
    L = np.linalg.cholesky(E)
    whitened = np.linalg.solve(L, np.linalg.solve(L, E - step.remaining[ROTATION, ROTATION]).T)
    gains, directions = np.linalg.eigh(whitened)
    shown = directions.T @ np.linalg.solve(L, step.correction[ROTATION])
    informed = gains > _NOISE.doubted_share
    shown = np.where(informed, shown / np.maximum(gains, _NOISE.doubted_share), 0.0)
    return np.asarray(L @ directions @ shown, dtype=np.float64)


class MotionNoise:
    """Factors on the motion model's noise densities, one for translation and one for rotation.

    A data sheet describes the sensor on the bench; vibration, misalignment and sampling add to it,
    by a factor that differs from rig to rig. The corrections that the images make to the predicted
    motion are compared with their covariance: the squared whitened sum of ten of them is chi-square
    distributed if the factor is right. Its probability `F_k`, mapped to `y = 2 F_k - 1`, has mean
    zero and variance 1/3 then, whatever the degrees of freedom k, and is bounded, so that a few
    wild steps do no harm. A scalar Kalman filter on the logarithm of the squared factor takes `y`
    as its innovation: equation (N8).
    Reference: Mehra, Approaches to adaptive filtering, IEEE TAC (1972), for matching the
    innovations' covariance.
    """

    def __init__(self, start: float | FloatArray, smallest: float, largest: float) -> None:
        """Start both factors at one value or at two (2,), and keep them between bounds; all on
        standard deviations.
        """
        self.factors: FloatArray = np.ones(2) * start  # translation, rotation
        self._bounds = smallest, largest
        self._variance: FloatArray = np.full(2, _NOISE.log_variance_sigma**2)
        self._sum: StepErrors | None = None
        self._steps = 0
        # whether the last sum of each part was an exception
        self._exception = [False, False]

    def update(self, step: StepErrors) -> None:
        """Learn from one step."""
        if self._sum is None:
            self._sum = step
        else:
            self._sum = self._sum + step
        self._steps += 1
        if self._steps < _NOISE.summed_steps:
            return
        for k, part in enumerate(_PARTS):
            self._update_factor(k, self._test(self._sum, k, part))
        self._sum = None
        self._steps = 0

    def _test(self, step: StepErrors, k: int, part: slice) -> WhitenedCorrection:
        """Test one part of a sum of steps in the directions that the images inform, or in all, if
        it is an exception there for the second time in a row: a bias that jumps is one once.
        """
        informed = whitened_correction(step, part)
        every = whitened_correction(step, part, _NOISE.doubted_share)
        was_exception = self._exception[k]
        self._exception[k] = every.dof > 0 and every.squared > _EXCEPTIONAL[every.dof - 1]
        return every if was_exception and self._exception[k] else informed

    def _update_factor(self, k: int, test: WhitenedCorrection) -> None:
        self._variance[k] += _NOISE.log_variance_walk**2
        if not test.dof:
            return
        H = _SENSITIVITY[test.dof] * test.share
        gain = self._variance[k] * H / (H * self._variance[k] * H + 1 / 3)
        innovation = 2 * chi_square_cdf(test.squared, test.dof) - 1
        self._variance[k] *= 1 - gain * H
        changed = self.factors[k] * np.exp(0.5 * gain * innovation)
        self.factors[k] = np.clip(changed, *self._bounds)
