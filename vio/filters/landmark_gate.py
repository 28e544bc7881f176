"""Which landmarks of the state may be used: a moving point, or a track that slipped, must not steer
the pose.

A landmark stays in the state for many frames and is known to millimetres, so a slow mover passes a
test of single frames against the pixel noise. Two tests are made: its newest pixels against what
all *other* measurements predict, and a running sum of these tests.
"""

from __future__ import annotations

import numpy as np

from vio.filters import gate_loops as loops
from vio.filters.prior import Fit
from vio.filters.track_records import Views
from vio.filters.window import Window
from vio.filters.window_fit import WindowFit
from vio.filters.window_posterior import landmark_covariance
from vio.filters.window_tracks import chi_square_table
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, IntArray

_MEMORY = 0.8  # weight of the past in the running sum
# running sum above which a landmark is dropped: 4.5 standard deviations of it
_DROP = 4.5 / np.sqrt(1 - _MEMORY**2)


def leave_one_out_nis(
    r: FloatArray, J: FloatArray, covariance: FloatArray, weight: FloatArray, variance: float
) -> FloatArray:
    """Normalised innovations squared (K,) of landmarks' pixels, predicted without these very
    pixels.

    With `R` the variance that a pixel entered the fit with, and `C` the posterior covariance of
    what the pixels depend on, the point relative to the camera and the stereo calibration, the
    residual of the prediction without it is `R (R I - J C J')^-1 r`, and its covariance
    `R^2 (R I - J C J')^-1 - R I + variance I`, exactly in a linear problem.

    Args:
        r: residuals after the fit (K, 4), pixels, zero where not measured.
        J: their Jacobians by the n quantities that they depend on (K, 4, n), zero where not
            measured.
        covariance: of these after the fit (K, n, n).
        weight: robust weights (K,) that the pixels entered the fit with.
        variance: of one pixel coordinate, px^2.
    """
    nis: FloatArray = np.empty(len(r))
    loops.leave_out(r, J, covariance, weight, variance, nis)
    return nis


class LandmarkGate:
    """Remembers how well each landmark has agreed with everything else."""

    def __init__(self, probability: float) -> None:
        self._limits = chi_square_table(probability)
        self._score: dict[int, float] = {}

    def test(
        self, fit: WindowFit, window: Window, pixels: Views, fitted: Fit
    ) -> tuple[BoolArray, BoolArray]:
        """Judge the landmarks (K,) of a window by their newest pixels after a fit, see `check`."""
        at = fit.landmark_residuals(window, pixels)
        variance = fit.tracks.variance
        # that they entered the fit with
        weight = at.weight * (variance / fit.variance)
        nis = leave_one_out_nis(
            at.r,
            fit.landmark_jacobian(window, pixels, at),
            landmark_covariance(window, fitted),
            weight,
            variance,
        )
        dof = np.maximum(np.any(at.J, axis=2).sum(axis=1), 1)
        return self.check(window.landmark_ids, nis, dof)

    def check(self, ids: IntArray, nis: FloatArray, dof: IntArray) -> tuple[BoolArray, BoolArray]:
        """Judge the landmarks of a frame.

        Args:
            ids: all landmarks that the frame shows (K,).
            nis: their normalised innovations squared (K,).
            dof: degrees of freedom (K,), 2 or 3.

        Returns:
            Masks (K,): pixels that may be used, and landmarks to be dropped.
        """
        before = np.array([self._score.get(i, 0.0) for i in ids.tolist()])
        score = _MEMORY * before + (nis - dof) / np.sqrt(2.0 * dof)
        dropped: BoolArray = score > _DROP
        self._score = dict(zip(ids[~dropped].tolist(), score[~dropped].tolist(), strict=True))
        used: BoolArray = (nis <= self._limits[dof]) & ~dropped
        return used, dropped
