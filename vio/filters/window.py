"""The window: navigation state, clones and landmarks, and the one covariance over all their errors.

Layout of an error vector of length D: navigation state (15), calibration (C = 0, 1, 6 or 7), clones (6 each, oldest
first), landmarks (3 each). Only this module knows it. The means are the newest estimates, at which everything is
linearised; `P` and `prior_delta` describe the prior: by all absorbed measurements, the true error of the means has mean
`-prior_delta` and covariance `P`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import blas, lapack

from vio.compiled import move_poses
from vio.filters.navigation import DIM, ImuMotion, Measurement, NavState, Transition, TwistMotion
from vio.filters.online_calibration import Calibration, body_twists, pose_D_calibration, with_calibration
from vio.filters.stereo_calibration import TERMS, StereoInformation
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_inverse, so3_exp, so3_hat, so3_left_jacobian
from vio.records import BoolArray, IntArray


@dataclass(frozen=True, slots=True)
class Clone:
    """The body at the time of a frame on the IMU's clock, by the time offset estimated then."""

    frame_index: int
    time_ns: int  # the frame's stamp
    T_world_imu: FloatArray  # (4, 4)
    velocity: FloatArray  # (3,) as in NavState; follows corrections only where the time offset is estimated
    rate: FloatArray  # (3,) likewise
    late_s: float = 0.0  # the pose's time on the IMU's clock minus the frame's stamp


_VELOCITY_SIGMA_MPS = 0.05  # m/s, for what a wrong calibration did to the velocity
_NO_CALIBRATION = Calibration(np.eye(4))


class Window:
    """State and covariance of the sliding-window filter; every change of the covariance happens here."""

    def __init__(
        self,
        motion: ImuMotion | TwistMotion,
        nav: NavState,
        P: FloatArray,
        calibration: Calibration = _NO_CALIBRATION,
    ) -> None:
        self.motion = motion
        self._L: Factor | None = None  # factor of P; None: not computed since P changed
        self.nav = nav
        self.calibration = calibration
        self.calibrating = False  # until then the calibration counts as known, its covariance stays
        self.clones: list[Clone] = []
        self.landmark_ids: IntArray = np.zeros(0, dtype=np.int64)
        self.landmarks: FloatArray = np.zeros((0, 3))
        self.P = P
        self.prior_delta: FloatArray = np.zeros(len(P))

    @property
    def P(self) -> FloatArray:
        """Covariance (D, D) of the prior."""
        return self._P

    @P.setter
    def P(self, P: FloatArray) -> None:
        self._P, self._L = P, None

    @property
    def first_clone(self) -> int:
        """Row of the first clone, the one after the calibration's."""
        return DIM + self.calibration.dim

    @property
    def first_landmark(self) -> int:
        """Row of the first landmark."""
        return self.first_clone + 6 * len(self.clones)

    def clone_rows(self, index: int) -> slice:
        """Rows of a clone."""
        start = self.first_clone + 6 * index
        return slice(start, start + 6)

    def exposures(self) -> FloatArray:
        """Poses (N, 4, 4) of the body when the frames were exposed, by the present time offset, equation (C1)."""
        T = np.array([c.T_world_imu for c in self.clones])
        if not self.calibration.timing:
            return T
        late = np.array([c.late_s for c in self.clones])
        out: FloatArray = T @ se3_exp(self._twists() * (self.calibration.time_offset_s - late)[:, None])
        return out

    def exposure(self, nav: NavState, late_s: float) -> FloatArray:
        """Pose (4, 4) at the exposure of a frame whose stamp a navigation state is late by, on the IMU's clock."""
        if not self.calibration.timing:
            return nav.T_world_imu
        twist = body_twists(nav.T_world_imu, nav.velocity, nav.rate)
        out: FloatArray = nav.T_world_imu @ se3_exp(twist * (self.calibration.time_offset_s - late_s))
        return out

    def T_cam0_world(self) -> FloatArray:
        """Camera poses (N, 4, 4) at all exposures."""
        out: FloatArray = self.calibration.T_cam0_imu @ se3_inverse(self.exposures())
        return out

    def _twists(self) -> FloatArray:
        """Body twists (N, 6) of the clones."""
        T = np.array([c.T_world_imu for c in self.clones])
        return body_twists(T, np.array([c.velocity for c in self.clones]), np.array([c.rate for c in self.clones]))

    def _pose_D_calibration(self) -> FloatArray:
        """What the calibration's errors do to the exposures' poses (6N, C)."""
        if not self.calibrating:
            return np.zeros((6 * len(self.clones), self.calibration.dim))
        poses = pose_D_calibration(self.exposures(), self._twists())
        full = np.concatenate([np.zeros((*poses.shape[:2], TERMS)), poses], axis=2)
        return full[:, :, self.calibration.columns].reshape(6 * len(full), -1)

    def current_pose(self, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pose (4, 4) at the newest exposure and its covariance (6, 6).

        Args:
            covariance: of the errors of navigation state and calibration (15 + C, 15 + C).
        """
        if not self.calibration.timing:
            return self.nav.T_world_imu, covariance[:6, :6]
        J = np.eye(6, self.first_clone)
        J[:, -1] = self._pose_D_calibration()[-6:, -1]
        return self.exposures()[-1], J @ covariance @ J.T

    def exposure_errors(self, error: FloatArray) -> FloatArray:
        """How an error vector (D,) moves the exposures' poses (6N,), up to where they move pixels."""
        clones = error[self.first_clone : self.first_landmark]
        return clones + self._pose_D_calibration() @ error[DIM : self.first_clone] if self.calibration.dim else clones

    @property
    def stereo_rows(self) -> slice:
        """Rows of the stereo field's coefficients, empty where they are not estimated."""
        return slice(DIM, DIM + self.calibration.stereo_dim)

    def chain(self, out_D_exposures: FloatArray, out_D_stereo: FloatArray | None = None) -> FloatArray:
        """Turn Jacobians into Jacobians (..., D) by the error vector.

        Args:
            out_D_exposures: by the exposures' poses (..., 6N).
            out_D_stereo: by the stereo field's coefficients (..., S), where they are estimated.
        """
        out = np.zeros((*out_D_exposures.shape[:-1], len(self.P)))
        out[..., self.first_clone : self.first_landmark] = out_D_exposures
        if self.calibration.dim:
            out[..., DIM : self.first_clone] = out_D_exposures @ self._pose_D_calibration()
        if out_D_stereo is not None:
            out[..., self.stereo_rows] += out_D_stereo
        return out

    def add_landmark_information(self, A: FloatArray, b: FloatArray, C: FloatArray, g: FloatArray) -> None:
        """Add what the landmarks' pixels in their anchor, the newest clone, say: `dp = xi_f - xi_rho`; in place.

        Args:
            A: information about exposures' poses and landmarks (6N + 3M, 6N + 3M).
            b: its vector (6N + 3M,).
            C: information about `dp` of each landmark (M, 3, 3).
            g: its vector (M, 3).
        """
        first = 6 * len(self.clones)
        rho, blocks = slice(first - 6, first - 3), C.reshape(-1, 3)
        A[rho, rho] += C.sum(axis=0)
        b[rho] -= g.sum(axis=0)
        own = first + np.arange(len(blocks)).reshape(-1, 3)
        A[own[:, :, None], own[:, None]] += C
        A[first:, rho] -= blocks
        A[rho, first:] -= blocks.T
        b[first:] += g.reshape(-1)

    def lift_information(
        self, A: FloatArray, b: FloatArray, stereo: StereoInformation | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Turn information about exposures' poses and landmarks (6N + 3M) into that about the error vector (D).

        Args:
            A: information matrix (6N + 3M, 6N + 3M).
            b: information vector (6N + 3M,).
            stereo: the part that concerns the stereo field, where it is estimated.
        """
        out, vector = np.zeros_like(self.P), np.zeros(len(self.P))
        M = self._pose_D_calibration()
        if self.calibrating:
            landmarks = np.zeros((3 * len(self.landmarks), self.calibration.dim))
            A, b = with_calibration(A, b, np.concatenate([M, landmarks]))
            out[DIM:, DIM:], vector[DIM:] = A, b
        else:
            first = self.first_clone
            out[first:, first:], vector[first:] = A, b
        if stereo is not None:
            rows = self.stereo_rows
            cross = np.concatenate([stereo.cross[:, : len(M)] @ M, stereo.cross], axis=1)  # (S, C + 6N + 3M)
            out[rows, DIM:] += cross
            out[DIM:, rows] += cross.T
            out[rows, rows] += stereo.A
            vector[rows] += stereo.b
        return out, vector

    def move_since(self, index: int) -> FloatArray:
        """Motion (4, 4) `T_clone_newest` of the body from a clone to the newest one."""
        out: FloatArray = se3_inverse(self.clones[index].T_world_imu) @ self.clones[-1].T_world_imu
        return out

    def move_covariance(self, index: int, fitted: Fit) -> FloatArray:
        """Covariance (6, 6) of `xi_newest - xi_clone` after a fit of all errors."""
        J = np.zeros((6, len(self.P)))
        J[:, self.clone_rows(len(self.clones) - 1)] = np.eye(6)
        J[:, self.clone_rows(index)] -= np.eye(6)
        S = fitted.spread(J)
        return S @ S.T

    def landmark_covariance(self, fitted: Fit) -> FloatArray:
        """Covariance (M, 3, 3) of `xi_f - xi_rho`, landmarks relative to the newest exposure, after a fit of all."""
        exposure = self.chain(np.eye(6 * len(self.clones))[-6:-3])  # (3, D)
        J = np.eye(3 * len(self.landmarks), len(self.P), self.first_landmark).reshape(-1, 3, len(self.P)) - exposure
        S = fitted.spread(J)
        out: FloatArray = S @ np.swapaxes(S, 1, 2)
        return out

    def propagate(self, step: Transition) -> None:
        """Move the navigation state by one step of its motion model."""
        self.nav = step.nav
        P, Phi, self._L = self.P, step.Phi, None
        P[:DIM] = Phi @ P[:DIM]
        P[:, :DIM] = P[:, :DIM] @ Phi.T
        P[:DIM, :DIM] += step.Q
        self.prior_delta[:DIM] = Phi @ self.prior_delta[:DIM]

    def start_calibration(self) -> None:
        """Take the calibration for uncertain from now on, equation (C4).

        What has been learned with a calibration that counted as known is how exposures and landmarks lie to each other
        and how fast they pass; all of it moves with the calibration's error as one, and body and IMU do not.
        """
        self.calibrating = True
        M, first = self._pose_D_calibration(), self.first_clone
        J = np.zeros((len(self.P), self.calibration.dim))
        J[6:9] = -so3_hat(self.nav.velocity) @ M[-3:]
        J[first : self.first_landmark] = np.tile(M[-6:], (len(self.clones), 1)) - M
        J[self.first_landmark :] = np.tile(M[-6:-3], (len(self.landmarks), 1))
        S = np.eye(len(self.P))
        S[:, DIM:first] += J
        P = S @ self.P @ S.T
        P[6:9, 6:9] += np.eye(3) * _VELOCITY_SIGMA_MPS**2
        self.P, self.prior_delta = 0.5 * (P + P.T), S @ self.prior_delta

    def start_stereo_field(self, calibration: Calibration, covariance: FloatArray) -> None:
        """Add the stereo field's coefficients to the state.

        Args:
            calibration: with the coefficients' first estimate.
            covariance: of their errors (S, S).
        """
        D, S = len(self.P), len(covariance)
        old = np.concatenate([np.arange(DIM), np.arange(DIM + S, D + S)])
        P, prior_delta = np.zeros((D + S, D + S)), np.zeros(D + S)
        P[np.ix_(old, old)], prior_delta[old] = self.P, self.prior_delta
        P[DIM : DIM + S, DIM : DIM + S] = covariance
        self.P, self.prior_delta, self.calibration = P, prior_delta, calibration

    def add_calibration_noise(self, extra: FloatArray) -> None:
        """Add noise (C, C) to the errors of what is being calibrated."""
        size = self.calibration.dim if self.calibrating else self.calibration.stereo_dim
        rows = slice(DIM, DIM + size)
        self.P[rows, rows] += extra[:size, :size]
        self._L = None

    def inflate_process_noise(self, extra: FloatArray) -> None:
        """Add noise (15, 15) to the last step, as if its motion had been known less; the newest clone ends it."""
        newest = self.clone_rows(len(self.clones) - 1)
        J = np.zeros((len(self.P), DIM))
        J[:DIM] = np.eye(DIM)
        J[newest, :6] = np.eye(6)
        J[self.first_landmark :, 3:6] = so3_hat(self.landmarks).reshape(-1, 3)
        self.P = self.P + J @ extra @ J.T

    def add_clone(self, frame_index: int, time_ns: int, late_s: float = 0.0) -> None:
        """Copy the pose as the newest clone; landmarks are anchored to its rotation from now on.

        Args:
            frame_index: the frame's number.
            time_ns: the frame's stamp.
            late_s: the navigation state's time on the IMU's clock minus that stamp.
        """
        at = self.first_landmark
        rows = np.concatenate([np.arange(at), np.arange(6), np.arange(at, len(self.P))])
        self.P = self.P[np.ix_(rows, rows)]
        self.prior_delta = self.prior_delta[rows]
        previous = len(self.clones) - 1
        nav = self.nav
        self.clones.append(Clone(frame_index, time_ns, nav.T_world_imu, nav.velocity, nav.rate, late_s))
        if len(self.landmarks):
            self._anchor_to_newest(self.clone_rows(previous).start + 3)

    def _anchor_to_newest(self, previous_rotation: int) -> None:
        """Measure the landmarks' errors from the newest exposure's rotation: xi_f += p^ (phi_new - phi_old)."""
        first, newest = self.first_landmark, self.clone_rows(len(self.clones) - 1).start + 3
        turn, before = slice(newest, newest + 3), slice(previous_rotation, previous_rotation + 3)
        p_cross = so3_hat(self.landmarks).reshape(-1, 3)
        P, delta, self._L = self.P, self.prior_delta, None
        move = p_cross @ (P[turn] - P[before])  # (3M, D)
        delta_move = p_cross @ (delta[turn] - delta[before])
        if self.calibration.dim:
            M = self._pose_D_calibration()
            own, J = slice(DIM, self.first_clone), p_cross @ (M[-3:] - M[-9:-6])
            move += J @ P[own]
            delta_move += J @ delta[own]
        P[first:] += move
        corner = (P[first:, turn] - P[first:, before]) @ p_cross.T
        if self.calibration.dim:
            corner += P[first:, own] @ J.T
        P[first:, first:] += corner
        P[:first, first:] = P[first:, :first].T
        delta[first:] += delta_move

    def drop_oldest_clone(self) -> None:
        """Forget the oldest clone."""
        self._keep_rows(np.delete(np.arange(len(self.P)), self.clone_rows(0)))
        self.clones = self.clones[1:]

    def keep_landmarks(self, chosen: BoolArray) -> None:
        """Forget the landmarks outside a mask (M,)."""
        if chosen.all():
            return
        rows = np.concatenate([np.ones(self.first_landmark, dtype=np.bool_), np.repeat(chosen, 3)])
        self._keep_rows(np.flatnonzero(rows))
        self.landmark_ids, self.landmarks = self.landmark_ids[chosen], self.landmarks[chosen]

    def _keep_rows(self, rows: IntArray) -> None:
        self.P = self.P[np.ix_(rows, rows)]
        self.prior_delta = self.prior_delta[rows]

    def add_landmarks(self, ids: IntArray, p_world: FloatArray, A: FloatArray, covariance: FloatArray) -> None:
        """Add landmarks (K, 3) whose errors are `A xi + noise`, with A (3K, D) and noise covariance (K, 3, 3)."""
        D, n = len(self.P), len(A)
        P = np.zeros((D + n, D + n))
        AP = A @ self.P
        P[:D, :D], P[D:, :D], P[:D, D:] = self.P, AP, AP.T
        P[D:, D:] = AP @ A.T
        for k, block in enumerate(covariance):
            P[D + 3 * k : D + 3 * k + 3, D + 3 * k : D + 3 * k + 3] += block
        self.prior_delta = np.concatenate([self.prior_delta, A @ self.prior_delta])
        self.P = 0.5 * (P + P.T)
        self.landmark_ids = np.concatenate([self.landmark_ids, ids])
        self.landmarks = np.concatenate([self.landmarks, p_world])

    def optimum(self, information: FloatArray, vector: FloatArray, size: int) -> tuple[Fit, FloatArray]:
        """Where the prior and given information agree best.

        Args:
            information: about the first `size` errors alone; the rest of (D, D) is zero.
            vector: (D,) likewise, at the present means.
            size: `k`.

        Returns:
            The fit, with the covariance (k, k) of the first errors there, and the error vector (D,) that moves the
            means there.
        """
        own = slice(0, size)
        A, b = information[own, own], vector[own] + information[own, own] @ self.prior_delta[own]
        fitted = fit(self._factor().leading(size), A)
        shift = fitted.move(b)
        if size < len(self.P):  # P (b - A shift) is the shift; the others follow by their correlation
            shift = np.concatenate([shift, self.P[size:, own] @ (b - A @ shift)])
        return fitted, shift - self.prior_delta

    def _factor(self) -> Factor:
        """The factor of the present covariance, computed once for all fits to it."""
        if self._L is None:
            self._L = factor(self.P)
        return self._L

    def absorb(self, information: FloatArray, vector: FloatArray) -> None:
        """Absorb measurements into the prior.

        Args:
            information: `H' R^-1 H` (D, D) of the residuals at the present means.
            vector: `H' R^-1 r` (D,).
        """
        P = fit(self._factor(), information).covariance()
        self.prior_delta = self.prior_delta - P @ (vector + information @ self.prior_delta)
        self.P = P

    def measure(self, measurement: Measurement) -> None:
        """Absorb a measurement of the navigation state and move the means to the new prior."""
        self.absorb_measurement(measurement)
        self.relinearise(-self.prior_delta)

    def absorb_measurement(self, measurement: Measurement) -> None:
        """Absorb a measurement of the navigation state; the means stay where they are."""
        RiH = np.linalg.solve(measurement.R, measurement.H)
        information = np.zeros_like(self.P)
        information[:DIM, :DIM] = measurement.H.T @ RiH
        vector = np.zeros(len(self.P))
        vector[:DIM] = RiH.T @ measurement.residual
        self.absorb(information, vector)

    def relinearise(self, error: FloatArray) -> None:
        """Move the means by an error vector (D,); the prior stays where it is."""
        self.nav = self.motion.corrected(self.nav, error[:DIM])
        T = np.array([c.T_world_imu for c in self.clones])
        move_poses(error[self.first_clone : self.first_landmark].reshape(-1, 6), T)
        if len(self.landmarks):
            phi = self.exposure_errors(error)[-3:]
            own = error[self.first_landmark :].reshape(-1, 3)
            self.landmarks = self.landmarks @ so3_exp(phi).T + own @ so3_left_jacobian(phi).T
        velocities, rate_error = [c.velocity for c in self.clones], np.zeros(3)
        if isinstance(self.motion, ImuMotion):
            velocities, rate_error = self._corrected_velocities(self.motion, T, error[:DIM]), error[9:12]
        self.clones = [
            Clone(c.frame_index, c.time_ns, pose, velocity, c.rate - rate_error, c.late_s)
            for c, pose, velocity in zip(self.clones, T, velocities, strict=True)
        ]
        if self.calibration.dim:
            self.calibration = self.calibration.corrected(error[DIM : self.first_clone])
        self.prior_delta = self.prior_delta + error

    def turn_world(self, yaw: float, yaw_D_tilt: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Turn the whole world about its z axis, and let the errors' yaw hang on the present tilt, equation (N13).

        Args:
            yaw: rad; no residual changes by it.
            yaw_D_tilt: (3,) by the navigation state's phi, for the yaw of all poses alike.

        Returns:
            R (3, 3), which takes points of the old world to the new one, and M (D, D), which does so with errors.
        """
        R, D = so3_exp([0.0, 0.0, yaw]), len(self.P)
        yaws = np.concatenate([[5], np.arange(self.first_clone + 5, self.first_landmark, 6)])
        M = np.eye(D)
        M[yaws, 3:6] += yaw_D_tilt
        in_world = [*range(0, 9, 3), *range(self.first_clone, D, 3)]
        turn = np.eye(D)
        for k in in_world:
            turn[k : k + 3, k : k + 3] = R
        M = turn @ M
        T = se3_from_parts(R, np.zeros(3))
        self.nav = replace(self.nav, T_world_imu=T @ self.nav.T_world_imu, velocity=R @ self.nav.velocity)
        self.clones = [replace(c, T_world_imu=T @ c.T_world_imu, velocity=R @ c.velocity) for c in self.clones]
        self.landmarks = self.landmarks @ R.T
        P = M @ self.P @ M.T
        self.P, self.prior_delta = 0.5 * (P + P.T), turn @ self.prior_delta
        return R, M

    def _corrected_velocities(self, motion: ImuMotion, T_world_imu: FloatArray, error: FloatArray) -> list[FloatArray]:
        """The clones' velocities (3,), moved by the navigation state's error (15,), at corrected poses (N, 4, 4)."""
        ages = np.array([self.clones[-1].time_ns - c.time_ns for c in self.clones]) * 1e-9
        R, earlier = T_world_imu[:, :3, :3], np.array([c.velocity for c in self.clones])
        return list(motion.corrected_earlier(earlier, 0.5 * (R + R[-1]), ages, error))


@dataclass(frozen=True, slots=True)
class Factor:
    """A covariance `P = L L'`."""

    L: FloatArray  # (D, D)
    triangular: bool  # by Cholesky; False: by the eigenvectors of a P that is singular beyond rounding

    def leading(self, size: int) -> Factor:
        """The factor of the covariance of the first errors alone."""
        if size == len(self.L):
            return self
        if self.triangular:
            return Factor(np.ascontiguousarray(self.L[:size, :size]), True)
        return factor(self.L[:size] @ self.L[:size].T)


@dataclass(frozen=True, slots=True)
class Fit:
    """The covariance after a measurement in information form, as factors: `P_new = L (K K')^-1 L'`."""

    L: FloatArray  # (D, D) of the prior
    K_transposed: FloatArray  # (D, D) upper triangle, of `K K' = I + L' A L`, in LAPACK's order of columns

    def move(self, vector: FloatArray) -> FloatArray:
        """Return `P_new v` (D,), for the information vector v (D,) the shift of the mean."""
        inner = lapack.dpotrs(self.K_transposed, self.L.T @ vector, lower=0)[0]
        out: FloatArray = self.L @ inner
        return out

    def spread(self, J: FloatArray) -> FloatArray:
        """Return S (..., k, D) with `S S'` the covariance of `J error`, for a Jacobian J (..., k, D)."""
        rows = np.ascontiguousarray((J @ self.L).reshape(-1, J.shape[-1]))
        S: FloatArray = blas.dtrsm(1.0, self.K_transposed, rows.T, lower=0, trans_a=1).T
        return S.reshape(J.shape)

    def covariance(self) -> FloatArray:
        """Return the covariance (D, D): symmetric and positive by construction."""
        W = blas.dtrsm(1.0, self.K_transposed, self.L.T, lower=0, trans_a=1)
        P_new: FloatArray = W.T @ W
        return P_new


def factor(P: FloatArray) -> Factor:
    """Factor a covariance (D, D)."""
    try:
        L = np.asarray(np.linalg.cholesky(P + np.diag(1e-14 * np.diag(P) + 1e-24)), dtype=np.float64)
        return Factor(L, True)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(P)
        root: FloatArray = np.array(vectors * np.sqrt(np.maximum(values, 0.0)), dtype=np.float64, order="C")
        return Factor(root, False)


def fit(prior: Factor, information: FloatArray) -> Fit:
    """Fit a prior to a measurement in information form (D, D).

    `(P^-1 + A)^-1` without an inverse of P, which is singular where states are copies or known. Of `I + L' A L = K K'`,
    only the triangle of K' is computed, in LAPACK's order of columns, in which the transpose of an array is free.

    Raises:
        numpy.linalg.LinAlgError: the information is not positive.
    """
    L = prior.L
    if prior.triangular:
        inner, _ = lapack.dsygst(information.T, L.T, itype=2, lower=0)
    else:
        inner = np.asfortranarray(L.T @ information @ L)
    np.einsum("ii->i", inner)[:] += 1.0
    K_transposed, failed = lapack.dpotrf(inner, lower=0, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("the information is not positive")
    return Fit(L, K_transposed)


def posterior(P: FloatArray, information: FloatArray, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (D, D) and the shift of the mean (D,) after a measurement in information form."""
    P_new = fit(factor(P), information).covariance()
    return P_new, P_new @ vector
