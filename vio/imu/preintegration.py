"""Motions that an IMU measured between pairs of times, with their covariances and derivatives by
the biases.

Rotation, velocity and position gathered from one keyframe to the next do not depend on the pose and
velocity there, so that an adjustment of these need not integrate again. Samples are joined by
straight lines, each step takes the reading in its middle, and the reading's force acts along the
rotation of the middle.
Reference: Forster, Carlone, Dellaert & Scaramuzza, On-manifold preintegration for real-time
visual-inertial odometry, IEEE Transactions on Robotics (2017), equations (33), (35), (38), (44),
(45) and appendices A to C.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.geometry.lie import (
    FloatArray,
    se3_exp,
    so3_exp,
    so3_hat,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
)
from vio.numerics.robust import median
from vio.records import ImuDensities

_LONG_PERIODS = 3.0  # samples further apart than so many median periods lack some between
# what a vehicle that manoeuvres may do there, (rad/s)^2 and (m/s^2)^2
_UNKNOWN = np.repeat([1.0, 3.0], 3) ** 2


@dataclass(frozen=True, slots=True)
class Readings:
    """An IMU's samples and their noise."""

    seconds: FloatArray  # (N,) increasing
    gyro: FloatArray  # (N, 3) rad/s
    accel: FloatArray  # (N, 3) specific force, m/s^2
    densities: ImuDensities


@dataclass(frozen=True, slots=True)
class BodyStates:
    """Poses, velocities and biases at K times, or at one end of each of K intervals."""

    T_world_imu: FloatArray  # (K, 4, 4); the world's z axis is up
    velocity: FloatArray  # (K, 3) in the world, m/s
    bias: FloatArray  # (K, 6) of gyro (rad/s) and accelerometer (m/s^2)

    def take(self, rows: slice) -> BodyStates:
        """Return some of them."""
        return BodyStates(self.T_world_imu[rows], self.velocity[rows], self.bias[rows])

    def moved(self, x: FloatArray) -> BodyStates:
        """Return states moved by x (K, 15): xi of `T_world_imu exp(xi)`, [rho; phi], velocities
        and biases added.
        """
        return BodyStates(
            self.T_world_imu @ se3_exp(x[:, :6]), self.velocity + x[:, 6:9], self.bias + x[:, 9:]
        )


@dataclass(frozen=True, slots=True)
class Preintegrated:
    """What an IMU measured over F intervals: errors are of [phi; v; p], phi in `R exp(phi)`."""

    seconds: FloatArray  # (F,) their lengths
    R: FloatArray  # (F, 3, 3) rotation from the end's axes to those of the start
    v: FloatArray  # (F, 3) gathered velocity, without gravity, in the axes of the start, m/s
    p: FloatArray  # (F, 3) gathered displacement, likewise, m
    covariance: FloatArray  # (F, 9, 9) of the errors by white noise
    D_bias: FloatArray  # (F, 9, 6) of the errors by the biases of gyro and accelerometer
    bias: FloatArray  # (F, 6) that was taken off the readings

    def residual(self, i: BodyStates, j: BodyStates, gravity_mps2: float) -> FloatArray:
        """Return residuals (F, 9) of intervals from states i to states j (F each), Forster's
        (45).
        """
        out: FloatArray = self._residual(i, j, gravity_mps2)[0]
        return out

    def _residual(self, i: BodyStates, j: BodyStates, gravity: float) -> tuple[FloatArray, ...]:
        dt = self.seconds[:, None]
        by_bias = np.einsum("fij,fj->fi", self.D_bias, i.bias - self.bias)
        R_i = i.T_world_imu[:, :3, :3]
        R_j = j.T_world_imu[:, :3, :3]
        g = np.array([0.0, 0.0, -gravity])
        dv = np.einsum("fji,fj->fi", R_i, j.velocity - i.velocity - g * dt)
        moved = (
            j.T_world_imu[:, :3, 3] - i.T_world_imu[:, :3, 3] - i.velocity * dt - 0.5 * g * dt**2
        )
        dp = np.einsum("fji,fj->fi", R_i, moved)
        measured = self.R @ so3_exp(by_bias[:, :3])
        r_R = so3_log(np.swapaxes(measured, 1, 2) @ np.swapaxes(R_i, 1, 2) @ R_j)
        r = np.concatenate(
            [r_R, dv - self.v - by_bias[:, 3:6], dp - self.p - by_bias[:, 6:]], axis=1
        )
        return r, dv, dp, by_bias

    def linearised(
        self, i: BodyStates, j: BodyStates, gravity_mps2: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return residuals (F, 9) and their derivatives (F, 9, 15) by the states i and j, see
        `BodyStates.moved`.
        """
        r, dv, dp, by_bias = self._residual(i, j, gravity_mps2)
        count = len(r)
        dt = self.seconds[:, None, None]
        R_i = i.T_world_imu[:, :3, :3]
        R_j = j.T_world_imu[:, :3, :3]
        to_i = np.swapaxes(R_i, 1, 2)
        by_phi_j = so3_left_jacobian_inverse(-r[:, :3])  # the right Jacobian's inverse
        A = np.zeros((count, 9, 15))
        B = np.zeros((count, 9, 15))
        A[:, :3, 3:6] = -by_phi_j @ np.swapaxes(R_j, 1, 2) @ R_i
        B[:, :3, 3:6] = by_phi_j
        turn = np.swapaxes(so3_exp(r[:, :3]), 1, 2) @ so3_left_jacobian(-by_bias[:, :3])
        A[:, :3, 9:12] = -by_phi_j @ turn @ self.D_bias[:, :3, :3]
        A[:, 3:6, 3:6] = so3_hat(dv)
        A[:, 6:, 3:6] = so3_hat(dp)
        A[:, 3:6, 6:9] = -to_i
        B[:, 3:6, 6:9] = to_i
        A[:, 6:, 6:9] = -to_i * dt
        A[:, 6:, :3] = -np.eye(3)
        B[:, 6:, :3] = to_i @ R_j
        A[:, 3:, 9:] = -self.D_bias[:, 3:]
        return r, A, B


def preintegrate(
    readings: Readings, start_s: FloatArray, end_s: FloatArray, bias: FloatArray
) -> Preintegrated:
    """Integrate readings over intervals from `start_s` to `end_s` (F,) with biases (F, 6) taken
    off.

    Beyond the first and the last sample their values go on. There, and where samples are missing,
    the mean of a step is known to `_UNKNOWN` alone.
    """
    t = readings.seconds
    values = np.concatenate([readings.gyro, readings.accel], axis=1)
    count = len(start_s)
    R = np.tile(np.eye(3), (count, 1, 1))
    v = np.zeros((count, 3))
    p = np.zeros((count, 3))
    P = np.zeros((count, 9, 9))
    D = np.zeros((count, 9, 6))
    spacing = np.concatenate([[np.inf], np.diff(t), [np.inf]])
    lacks_samples = spacing > _LONG_PERIODS * median(spacing[1:-1])
    white = np.repeat(np.square([readings.densities.gyro, readings.densities.accel]), 3)
    first = np.searchsorted(t, start_s, side="right")
    last = np.searchsorted(t, end_s, side="left")
    for n in range(int((last - first).max(initial=-1)) + 1):
        # Step n goes to sample first + n, or to the interval's end.
        here = np.minimum(first + n, last)
        if n == 0:
            begin = start_s
        else:
            begin = np.minimum(t[np.minimum(first + n - 1, len(t) - 1)], end_s)
        begin = np.where(first + n > last, end_s, begin)
        end = np.where(here < last, t[np.minimum(here, len(t) - 1)], end_s)
        dt = np.maximum(end - begin, 0.0)
        middle = 0.5 * (begin + end)
        reading = np.stack([np.interp(middle, t, values[:, k]) for k in range(6)], axis=1) - bias
        gyro = reading[:, :3]
        force = reading[:, 3:]
        h = dt[:, None]
        half_turn = so3_exp(0.5 * h * gyro)
        turn = so3_exp(h * gyro)
        R_mid = R @ half_turn
        acceleration = np.einsum("fij,fj->fi", R_mid, force)
        H = h[:, :, None]
        A = np.tile(np.eye(9), (count, 1, 1))
        A[:, :3, :3] = np.swapaxes(turn, 1, 2)
        lever = -R @ so3_hat(np.einsum("fij,fj->fi", half_turn, force))
        A[:, 3:6, :3] = lever * H
        A[:, 6:, :3] = 0.5 * lever * H**2
        A[:, 6:, 3:6] = np.eye(3) * H
        # How the step follows the reading; half a step's turn acts on the force, too.
        N = np.zeros((count, 9, 6))
        half = -R_mid @ so3_hat(force) @ so3_left_jacobian(-0.5 * h * gyro) * (0.5 * H)
        N[:, :3, :3] = so3_left_jacobian(-h * gyro) * H
        N[:, 3:6, :3] = half * H
        N[:, 6:, :3] = 0.5 * half * H**2
        N[:, 3:6, 3:] = R_mid * H
        N[:, 6:, 3:] = 0.5 * R_mid * H**2
        after = np.searchsorted(t, middle)
        gap = lacks_samples[after, None]
        # of the mean over the step
        variance = white / np.maximum(h, 1e-12) + np.where(gap, _UNKNOWN, 0.0)
        Q = (N * variance[:, None, :]) @ np.swapaxes(N, 1, 2)
        P = A @ P @ np.swapaxes(A, 1, 2) + Q
        D = A @ D - N
        p = p + v * h + 0.5 * acceleration * h**2
        v = v + acceleration * h
        R = R @ turn
    return Preintegrated(end_s - start_s, R, v, p, P, D, bias)
