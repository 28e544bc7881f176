"""The window after a frame: its poses with the covariance of everything that has been seen,
until the next frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.dataclass import dataclass
from vio.filters import pose_loops as loops
from vio.filters.navigation import ImuMotion
from vio.filters.prior import Fit
from vio.filters.window import Clones, Window
from vio.geometry.lie import FloatArray, se3_adjoint, se3_from_parts, se3_inverse, se3_log, so3_hat
from vio.geometry.relative_pose import RelativePose
from vio.numerics.kinds import Tolerance
from vio.numerics.statistics import chi_square_quantile, squared_distance
from vio.records import Estimate

# of the largest eigenvalue of a correlation: less is rounding
_GIVEN_RANK: Tolerance[float] = 1e-10
_MIN_MOTION_M = 1e-3  # of all poses from the oldest one: less has no scale
_STATIONARY_LIMIT = float(chi_square_quantile(0.95, 6))  # of the motion over the window


@dataclass(frozen=True, slots=True)
class WindowPosterior:
    """Smoothed poses: each has seen the frames after it, up to the newest."""

    clones: Clones
    P: FloatArray  # (6N, 6N) covariance of their right-invariant errors
    reported: FloatArray  # (6N, 6N) the same with the uncertainty of the rig's scale
    gyro_bias: FloatArray  # (3,) rad/s, of the newest frame
    accel_bias: FloatArray  # (3,) m/s^2, of the newest frame
    has_imu: bool  # whether the clones' velocities are smoothed, too
    # (3, 3) as in Calibration; P and the clones are upright, `reported` and `estimate` not
    R_upright_world: FloatArray

    @classmethod
    def of(
        cls, window: Window, P: FloatArray, reported: FloatArray | None = None
    ) -> WindowPosterior:
        """Take over the body's poses at the window's exposures, with the covariances (k, k) up
        to theirs.
        """
        reported = P if reported is None else reported
        rows = window.state.clones
        own = P[rows, rows], reported[rows, rows]
        if "extrinsics" in window.state.blocks:
            J = window.body_D_error()
            J_reported = window.since_first(J)
            own = J @ P @ J.T, J_reported @ reported @ J_reported.T
        elif "first_attitude" in window.state.blocks:
            since: FloatArray = np.empty(own[1].shape)
            loops.take_since_first(
                reported, rows.start, window.state.blocks["first_attitude"].start, since
            )
            own = own[0], since
        has_imu = isinstance(window.motion, ImuMotion)
        R = window.calibration.R_upright_world
        return cls(window.clones, *own, window.nav.gyro_bias, window.nav.accel_bias, has_imu, R)

    def rotated(self, R: FloatArray) -> WindowPosterior:
        """Return the same in a world that is turned by R (3, 3)."""
        turn = np.kron(np.eye(2 * len(self.clones)), R)
        P = turn @ self.P @ turn.T
        reported = turn @ self.reported @ turn.T
        return replace(self, clones=self.clones.turned(R), P=P, reported=reported)

    def estimate(self, frame_index: int) -> Estimate | None:
        """Return the smoothed estimate at a frame of the window.

        None where the frame is not in it.
        """
        index = self._place(frame_index)
        if index is None:
            return None
        clone = self.clones[index]
        rows = slice(6 * index, 6 * index + 6)
        A = se3_adjoint(se3_inverse(clone.T_world_imu))
        R = self.R_upright_world.T
        return Estimate(
            clone.time_ns,
            se3_from_parts(R, np.zeros(3)) @ clone.T_world_imu,
            A @ self.reported[rows, rows] @ A.T,
            velocity_world=R @ (clone.velocity if self.has_imu else self._velocities()[index]),
            gyro_bias=self.gyro_bias,
            accel_bias=self.accel_bias,
        )

    def _velocities(self) -> FloatArray:
        """World velocities (N, 3) by the smoothed poses around each: a drifting twist keeps only
        its newest.
        """
        if len(self.clones) < 2:
            return self.clones.velocities
        t = (self.clones.times_ns - self.clones.times_ns[0]) * 1e-9
        return np.asarray(
            np.gradient(self.clones.T_world_imu[:, :3, 3], t, axis=0), dtype=np.float64
        )

    def _place(self, frame_index: int) -> int | None:
        """Which clone is that of a frame; None: it is not in the window."""
        found = (self.clones.frame_indices == frame_index).nonzero()[0]
        return int(found[0]) if len(found) else None

    def motion(self, older: int, newer: int) -> RelativePose | None:
        """Return the body's motion between two frames of the window; None where one of them is not
        in it.

        With right-invariant errors, `T_i^-1 T_j = T_ij_hat exp(Ad(T_j_hat^-1) (xi_j - xi_i))`.
        """
        i = self._place(older)
        j = self._place(newer)
        if i is None or j is None:
            return None
        T_i = self.clones.T_world_imu[i]
        T_j = self.clones.T_world_imu[j]
        a = slice(6 * i, 6 * i + 6)
        b = slice(6 * j, 6 * j + 6)
        A = se3_adjoint(se3_inverse(T_j))
        C = A @ self._difference(a, b) @ A.T
        return RelativePose(se3_inverse(T_i) @ T_j, C)

    def _difference(self, a: slice, b: slice) -> FloatArray:
        """Covariance of the difference of two parts of the error vector."""
        P = self.P
        return P[a, a] + P[b, b] - P[a, b] - P[b, a]

    def is_stationary(self, velocity_sigma_mps: float, rate_sigma_radps: float) -> bool:
        """Test whether the motion from the oldest to the newest clone is indistinguishable from
        none.

        The displacement, with its covariance, knows depth, frame rate and motion sensor. The test
        concludes only where it has the power to: the mean velocity and rate over the window must be
        known to better than the given standard deviations, those of the zero-velocity measurement
        that may follow.
        """
        old = self.clones[0]
        new = self.clones[-1]
        seconds = (new.time_ns - old.time_ns) * 1e-9
        if seconds <= 0:
            return False
        a = slice(0, 6)
        b = slice(len(self.P) - 6, None)
        T_old_world = se3_inverse(old.T_world_imu)
        A = se3_adjoint(T_old_world)
        C = A @ self._difference(a, b) @ A.T
        limit = _STATIONARY_LIMIT  # no eigenvalue of C is larger than its trace
        most = float(C.trace()) + 6e-18
        moved = new.T_world_imu[:3, 3] - old.T_world_imu[:3, 3]
        if float(moved @ moved) > limit * most:  # rho is no shorter, as |J_l(phi) rho| <= |rho|
            return False
        xi = se3_log(T_old_world @ new.T_world_imu)
        if float(xi @ xi) > limit * most:
            return False
        largest = (
            np.sqrt([np.linalg.eigvalsh(C[p, p])[-1] for p in (slice(0, 3), slice(3, 6))]) / seconds
        )
        if largest[0] > velocity_sigma_mps or largest[1] > rate_sigma_radps:
            return False
        return squared_distance(xi, C, 1e-18) < limit


def given(P: FloatArray, rows: slice) -> FloatArray:
    """Covariance (k, k) of errors of covariance P (k, k) where those of `rows` are known, which
    have none there.
    """
    known = P[rows, rows]
    scale = np.sqrt(known.diagonal())
    scale[scale == 0] = np.inf  # known already
    values, vectors = np.linalg.eigh(known / (scale[:, None] * scale))
    independent = values > _GIVEN_RANK
    whitening = vectors[:, independent] / np.sqrt(values[independent])
    half = whitening.T @ (P[rows] / scale[:, None])
    out: FloatArray = P - half.T @ half
    out[rows] = 0.0
    out[:, rows] = 0.0
    return out


def scale_sigma(posterior: WindowPosterior) -> float | None:
    """Standard deviation of the scale of the motion over the window, over it; None where there is
    no motion.

    It is that of the factor by which the poses' positions, from the oldest one on, are longer than
    the truth.
    """
    T = posterior.clones.T_world_imu
    p = T[:, :3, 3] - T[0, :3, 3]
    length2 = float(np.sum(p**2))
    if length2 < _MIN_MOTION_M**2:
        return None
    # p = exp(phi) p_hat + rho, less that of the oldest pose
    moves = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(T), 3, 3)), -so3_hat(T[:, :3, 3])], axis=2
    )
    row = np.einsum("ki,kij->kj", p, moves)
    row[0] -= p.sum(axis=0) @ moves[0]
    row = row.ravel() / length2
    return float(np.sqrt(max(row @ posterior.P @ row, 0.0)))


def move_covariance(window: Window, index: int, fitted: Fit) -> FloatArray:
    """Covariance (6, 6) of `xi_newest - xi_clone` after a fit of all errors."""
    S = fitted.whitened(
        fitted.rows(window.state.clone(-1)) - fitted.rows(window.state.clone(index))
    )
    return S @ S.T


def landmark_covariance(window: Window, fitted: Fit) -> FloatArray:
    """Covariance (M, 3 + S, 3 + S) of what a landmark's pixels depend on, after a fit of all
    errors.

    That is `xi_f - xi_rho`, the landmark relative to the newest exposure, and the coefficients of
    the stereo calibration.
    """
    state = window.state
    M = len(window.landmarks)
    n = len(fitted.prior.L)
    exposure = state.clone(-1).start
    S = state.stereo.stop - state.stereo.start
    position = fitted.rows(slice(exposure, exposure + 3))
    J_L = np.empty((3 * M + S, n))
    np.subtract(
        fitted.rows(state.landmarks).reshape(M, 3, n), position, out=J_L[: 3 * M].reshape(M, 3, n)
    )
    J_L[3 * M :] = fitted.rows(state.stereo)
    root = fitted.whitened(J_L)
    out: FloatArray = np.empty((M, 3 + S, 3 + S))
    loops.take_blocks(root @ root.T, out)
    return out
