"""A bound of the position error, as navigation receivers state it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.errors import ConfigError
from vio.geometry.lie import FloatArray
from vio.numerics.statistics import chi_square_quantile
from vio.records import Estimate

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class ProtectionLevel:
    """What contains the true position with a probability."""

    horizontal_m: float  # radius of a circle in the horizontal plane
    vertical_m: float  # half height
    probability: float


def protection_level(estimate: Estimate, probability: float = 0.997) -> ProtectionLevel:
    """Return the protection level of a position, by its covariance.

    The circle has the radius of the largest axis of the ellipse of the horizontal error, which
    contains it with at least the probability.

    Args:
        estimate: its world is upright where an IMU has shown the vertical
            (`Estimate.gravity_world`); else up is the first camera's -y, as the body is cam0.
        probability: between 0 and 1.

    Raises:
        ConfigError: the probability is not between 0 and 1.

    Reference: RTCA DO-229, appendix J, for the form.
    """
    if not 0.0 < probability < 1.0:
        raise ConfigError(f"the probability of a protection level is in (0, 1), not {probability}")
    P = position_covariance(estimate)
    up = _up(estimate)
    across = np.eye(3) - np.outer(up, up)
    horizontal = across @ P @ across
    largest = float(np.linalg.eigvalsh(horizontal)[-1])
    vertical = float(up @ P @ up)
    return ProtectionLevel(
        horizontal_m=float(np.sqrt(chi_square_quantile(probability, 2) * max(largest, 0.0))),
        vertical_m=float(np.sqrt(chi_square_quantile(probability, 1) * max(vertical, 0.0))),
        probability=probability,
    )


def position_covariance(estimate: Estimate) -> FloatArray:
    """Return the covariance (3, 3) of the body's position in the world, m^2.

    With `T_imu_world = exp(xi) T_hat` the position is that of `T_hat^-1 exp(-xi)`: it moves by
    `-R rho`.
    """
    R = estimate.T_world_imu[:3, :3]
    return np.asarray(R @ estimate.covariance[:3, :3] @ R.T)


def _up(estimate: Estimate) -> FloatArray:
    """The vertical (3,) in the world, as far as it is known."""
    gravity = estimate.gravity_world
    if gravity is not None:
        return np.asarray(-gravity / np.linalg.norm(gravity))
    if estimate.tilt_sigma_rad is None and estimate.gyro_bias is None:
        return np.array([0.0, -1.0, 0.0])
    return _UP
