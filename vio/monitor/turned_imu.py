"""An IMU that is turned against its calibration by degrees: the rotation of `T_cam0_imu` that the
rates of gyro and camera show.

The fit of one rotation to vectors in two frames is Wahba's problem; near the given rotation it is
linear. About an axis that nothing turns across, it shows nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.geometry.lie import FloatArray, so3_exp
from vio.monitor.gyro_fit import AGREES, FIRST_EVALUATION, GyroFit
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import jackknife

_BLOCKS: Tolerance[int] = 10  # of the record, for the jackknife
_STEPS: Tolerance[int] = 8  # of the linear fit, which begins at no turn
_DAMPING: Tolerance[float] = 1e-9
_I3 = np.eye(3)
# axes of a cross product: component k is that of the next and the last one, less the reverse
_NEXT = [1, 2, 0]
_LAST = [2, 0, 1]


class _TurnRules(NamedTuple):
    """When the IMU is turned against its calibration."""

    # Healthy recordings come to 1.1 (images rendered along flights of EuRoC, their real IMU, turns
    # about two axes) and calibrations by hand to 3; 4 cost a filter eight times its accuracy.
    min_deg: float = 3.5
    # beyond it, swapped axes or the inverse transform are likelier
    max_deg: float = 40.0
    sigmas: float = 6.0  # standard deviations of the turn, in its most uncertain direction


_TURN = _TurnRules()


class Turn(NamedTuple):
    """How the gyro is turned against the camera, beyond the given rotation."""

    rotation: FloatArray  # (3,) of the camera's frame, rad: true = exp(rotation) given
    scale: float  # of the gyro
    sigma: float  # standard deviation of its most uncertain component, rad


def turn_of_gyro(gyro_fit: GyroFit, R_cam0_imu: FloatArray) -> Turn:
    """Fit the rotation and the scale by which the gyro's rates, mapped by a rotation (3, 3), become
    the camera's.
    """
    weight = gyro_fit.weight
    camera = gyro_fit.camera
    gyro = gyro_fit.gyro @ R_cam0_imu.T
    blocks = np.arange(len(weight)) * _BLOCKS // len(weight)
    kept = np.arange(-1, _BLOCKS)[:, None] != blocks  # by the first fit everything
    rotations, scales = _fits(camera, gyro, weight * kept)
    return Turn(rotations[0], float(scales[0]), float(jackknife(rotations[1:]).max()))


def _fits(
    camera: FloatArray, gyro: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the rotations (M, 3) and the scales (M,) of rates (K, 3), means removed, by least
    squares with weights (M, K) each.

    The rates' moments hold all that is needed of them, so a step does not go through the record.
    """
    w = weights / weights.sum(axis=1, keepdims=True)
    weighed = np.swapaxes(gyro - (w @ gyro)[:, None], 1, 2) * w[:, None]
    gyro_gyro = weighed @ gyro
    gyro_camera = weighed @ camera
    diagonal = np.arange(3)
    total = gyro_gyro[:, diagonal, diagonal].sum(axis=1)
    rotation = np.zeros((len(w), 3))
    scale = np.ones(len(w))
    for _ in range(_STEPS):
        R = so3_exp(rotation)
        cross = R @ gyro_camera
        scale = cross[:, diagonal, diagonal].sum(axis=1) / total
        torque = cross[:, _NEXT, _LAST] - cross[:, _LAST, _NEXT]  # mean of turned x camera
        # damped: about the only axis of all rotation nothing is known
        information = (1.0 + _DAMPING) * total[:, None, None] * _I3
        information -= R @ gyro_gyro @ np.swapaxes(R, 1, 2)
        turn = np.linalg.solve(information, torque[..., None])[..., 0]
        rotation = rotation + turn / scale[:, None]
    return rotation, scale


def judge_turn(gyro_fit: GyroFit, R_cam0_imu: FloatArray, *, clipped: bool) -> Turn | None:
    """Return the turn of an IMU whose calibration is clearly wrong by degrees; None: it is not,
    or too little is known of it.

    Args:
        gyro_fit: the gyro's rates beside the camera's.
        R_cam0_imu: (3, 3) as given.
        clipped: readings were at the end of the range, which shortens and turns the rates.
    """
    is_known = gyro_fit.unexplained < AGREES and gyro_fit.axes > 1
    used = int(np.count_nonzero(gyro_fit.weight))
    if not is_known or used < FIRST_EVALUATION or clipped:
        return None
    turn = turn_of_gyro(gyro_fit, R_cam0_imu)
    angle = float(np.linalg.norm(turn.rotation))
    is_turn = np.radians(_TURN.min_deg) < angle < np.radians(_TURN.max_deg)
    if is_turn and angle > _TURN.sigmas * turn.sigma:
        return turn
    return None
