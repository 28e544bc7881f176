"""A new start of the sliding-window filter from its last good state, after it diverged."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from vio.dataclass import dataclass
from vio.errors import EstimationError
from vio.filters.navigation import DIM, ImuMotion, NavState, TwistMotion
from vio.filters.online_calibration import Calibration, body_twist
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import FloatArray, se3_exp, so3_hat

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
    good: GoodState, time_ns: int, motion: ImuMotion | TwistMotion, settings: MsckfSettings
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
        settings: initial standard deviations.
    """
    elapsed_s = (time_ns - good.time_ns) * 1e-9
    nav = good.nav
    T = good.nav.T_world_imu
    velocity = motion.velocity_world(nav)
    twist = body_twist(T, velocity, nav.rate)
    moved = replace(nav, T_world_imu=T @ se3_exp(min(elapsed_s, _EXTRAPOLATED_S) * twist))
    speed = float(np.linalg.norm(velocity)) + _MIN_SPEED_MPS
    position = speed * elapsed_s
    rotation = float(np.hypot(_ROTATION_SIGMA_RAD, _RATE_SIGMA_RADPS * elapsed_s))
    rotation = min(rotation, _ANY_ROTATION_RAD)
    J = np.eye(6)
    J[:3, 3:] = so3_hat(moved.T_world_imu[:3, 3])
    P = np.zeros((DIM, DIM))
    P[:6, :6] = good.covariance[:6, :6] + J @ np.diag(np.repeat([position, rotation], 3) ** 2) @ J.T
    P[6:, 6:] = motion.start_covariance(settings)[6:, 6:]
    return moved, P
