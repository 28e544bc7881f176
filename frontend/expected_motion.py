"""A predicted motion of the camera, and how far motions that are fitted to points are off it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray, circledot, se3_inverse, se3_log, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, z_D_p_cam
from vio.numerics.robust import median
from vio.numerics.statistics import chi_square_quantile, squared_distance
from vio.records import MotionPrior

AGREEMENT_PROBABILITY = 0.9999  # of a motion that agrees with the prediction to pass the test
AGREEMENT_LIMIT = float(chi_square_quantile(AGREEMENT_PROBABILITY, 6))  # of its squared distance


class _ErrorRules(NamedTuple):
    """What motions that are fitted to points are off by."""

    bound_sigmas: float = 3.0  # of the bound of the disparities' error
    pixel_sigma: float = 0.5  # of a point's position by its depth and its track
    # errors of neighbours have much in common: a fit is no better than that of so many points
    independent_points: int = 50
    # of the length of a fitted translation: depths of one frame have errors in common
    scale_sigma: float = 0.01


_ERRORS = _ErrorRules()


@dataclass(frozen=True, slots=True)
class ExpectedMotion:
    """A predicted motion, and what fits to points are off by beside it."""

    camera: StereoCamera
    prior: MotionPrior
    disparity_error_px: float  # see `choose_motion`

    def distance(self, T: FloatArray, p_prev: FloatArray) -> float:
        """Squared distance of a motion (4, 4), fitted to points (N, 3), from the prediction, over
        their covariance.
        """
        p = transform_points(T, p_prev)
        J = pixel_D_motion(self.camera, p).reshape(-1, 6)
        points = min(len(p), _ERRORS.independent_points)
        information = points * J.T @ J / len(p) + 1e-9 * np.eye(6)
        fit = _ERRORS.pixel_sigma**2 * np.linalg.inv(information)
        moved_m2 = float(T[:3, 3] @ T[:3, 3])
        fit[:3, :3] += _ERRORS.scale_sigma**2 * moved_m2 * np.eye(3)
        if self.disparity_error_px > 0.0:
            # a translation is off as its depths are; one that no sensor has measured is, too
            depth = median(depth_of(self.camera, p_prev))
            f_baseline = self.camera.fu * self.camera.baseline_m
            scale = self.disparity_error_px / _ERRORS.bound_sigmas * depth / f_baseline
            if not self.prior.measured:
                t = self.prior.T_curr_prev[:3, 3]
                moved_m2 += float(t @ t)
            fit[:3, :3] += scale**2 * moved_m2 * np.eye(3)
        return self._distance(T, self.prior.covariance + fit)

    def is_beyond(self, T: FloatArray, limit: float) -> bool:
        """Whether a motion (4, 4) is further off than a limit over the prediction's covariance
        alone: that of a fit to points is added only if it is.
        """
        return self._distance(T, self.prior.covariance) > limit

    def _distance(self, T: FloatArray, covariance: FloatArray) -> float:
        xi = se3_log(T @ se3_inverse(self.prior.T_curr_prev))
        return squared_distance(xi, covariance, 0.0)


def pixel_D_motion(camera: StereoCamera, p: FloatArray) -> FloatArray:
    """Jacobian (N, 2, 6) of the left pixels of points (N, 3) by the camera's motion,
    `[rho; phi]`.
    """
    J: FloatArray = z_D_p_cam(camera, p)[:, :2] @ circledot(p)[:, :3]
    return J
