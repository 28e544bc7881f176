"""A new start of the sliding-window filter from its last good state, after it diverged."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from vio.dataclass import dataclass
from vio.errors import EstimationError
from vio.filters.navigation import DIM, ImuMotion, NavState, TwistMotion
from vio.filters.online_calibration import Calibration, body_twist
from vio.geometry.lie import FloatArray, se3_adjoint, se3_exp, se3_from_parts, so3_hat
from vio.geometry.upright import rotated
from vio.records import NS_PER_S, Estimate

# A divergence begins before it shows, so the last good attitude is taken to be off by a few degrees
# already.
_ROTATION_SIGMA_RAD = np.radians(2.0)
_MIN_SPEED_MPS = 1.0  # the last velocity may have been wrong by itself, and by this
# for which the last velocity and rate are believed; beyond it the pose is held
_EXTRAPOLATED_S = 0.5
_RATE_SIGMA_RADPS = 1.0  # of a body that nothing measures: a turn within a second is not seen
_ANY_ROTATION_RAD = math.pi / math.sqrt(3.0)  # standard deviation of an angle that may be any


@dataclass(frozen=True, slots=True)
class GoodState:
    """What is kept of the last frame whose update was plausible."""

    frame_index: int
    time_ns: int
    nav: NavState
    # (15 + C, 15 + C) of navigation state and calibration, with all that was seen
    covariance: FloatArray
    calibration: Calibration


def required(good: GoodState | None) -> GoodState:
    """Return the state to start again from.

    Raises:
        EstimationError: there is none.
    """
    if good is None:
        raise EstimationError(
            "msckf has no good state to start again from; check calibration and first frames"
        )
    return good


def restarted(
    good: GoodState, time_ns: int, motion: ImuMotion | TwistMotion
) -> tuple[NavState, FloatArray]:
    """Return the navigation state at a later time and its covariance (15, 15), both from the last
    good state.

    The pose is carried on with the last velocity and rate for half a second at most. Its covariance
    grows by what a body of that speed may have done in between; velocity and biases begin anew.
    Errors are right-invariant: an error `n_r` of the body's attitude alone moves `rho` by `p^ n_r`.

    Args:
        good: the state to go on from.
        time_ns: of the frame to go on with.
        motion: the filter's motion model.
    """
    elapsed_s = (time_ns - good.time_ns) * 1e-9
    nav = good.nav
    T = good.nav.T_world_imu
    velocity = motion.velocity_world(nav)
    twist = body_twist(T, velocity, nav.rate)
    moved = replace(nav, T_world_imu=T @ se3_exp(min(elapsed_s, _EXTRAPOLATED_S) * twist))
    position, rotation = _unseen_motion(velocity, elapsed_s)
    J = np.eye(6)
    J[:3, 3:] = so3_hat(moved.T_world_imu[:3, 3])
    P = np.zeros((DIM, DIM))
    sigma = np.repeat([position, rotation], 3)
    P[:6, :6] = good.covariance[:6, :6] + J @ np.diag(sigma**2) @ J.T
    P[6:, 6:] = motion.start_covariance()[6:, 6:]
    return moved, P


def as_good_state(last: GoodState, good: Estimate) -> GoodState:
    """Return the state of an estimate, in the form of the last plausible one, whose calibration it
    keeps.
    """
    R = last.calibration.R_upright_world
    T = se3_from_parts(R, np.zeros(3)) @ good.T_world_imu
    velocity = last.nav.velocity
    if good.velocity_world is not None:
        velocity = R @ good.velocity_world
    covariance = last.covariance.copy()
    A = se3_adjoint(T)
    covariance[:6, :6] = A @ good.covariance @ A.T
    nav = replace(last.nav, T_world_imu=T, velocity=velocity)
    return replace(last, time_ns=good.time_ns, nav=nav, covariance=covariance)


def held_covariance(good: Estimate, new: Estimate, up: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of a pose whose position and yaw were held since a good
    estimate, and whose tilt is that of a new start, `[rho; phi]` in the body.

    Args:
        good: the last estimate that could be used.
        new: the estimate of the new start, in the same world.
        up: (3,) the axis of the yaw, world.
    """
    elapsed_s = (new.time_ns - good.time_ns) / NS_PER_S
    if good.velocity_world is None:
        velocity = np.zeros(3)
    else:
        velocity = good.velocity_world
    position, rotation = _unseen_motion(velocity, elapsed_s)
    R_good = good.T_world_imu[:3, :3]
    up_good = R_good.T @ up
    of_yaw = float(up_good @ good.covariance[3:, 3:] @ up_good) + rotation**2
    of_position = rotated(R_good, good.covariance[:3, :3]) + position**2 * np.eye(3)
    R = new.T_world_imu[:3, :3]
    about_up = np.outer(R.T @ up, R.T @ up)
    P = np.zeros((6, 6))
    P[:3, :3] = rotated(R.T, of_position)
    tilt_sigma = new.tilt_sigma_rad or 0.0
    P[3:, 3:] = of_yaw * about_up + tilt_sigma**2 * (np.eye(3) - about_up)
    return P


def _unseen_motion(velocity: FloatArray, elapsed_s: float) -> tuple[float, float]:
    """Standard deviations of how far, m, and by which angle, rad, a body has moved that had a
    velocity (3,) when it was last seen.
    """
    position = (float(np.linalg.norm(velocity)) + _MIN_SPEED_MPS) * elapsed_s
    rotation = float(np.hypot(_ROTATION_SIGMA_RAD, _RATE_SIGMA_RADPS * elapsed_s))
    return position, min(rotation, _ANY_ROTATION_RAD)
