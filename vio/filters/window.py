"""The window: navigation state, clones and landmarks, and the one covariance over all their errors.

Layout of an error vector of length D: navigation state (15), calibration (C, the IMU's terms first), clones (6 each,
oldest first), landmarks (3 each). Only this module knows it. The error of a clone is that of the camera's pose,
equation (C2), so the calibration of camera and IMU enters where a clone is made and nowhere else. The means are the
newest estimates, at which everything is linearised; `P` and `prior_delta` describe the prior: by all absorbed
measurements, the true error of the means has mean `-prior_delta` and covariance `P`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import blas, lapack

from vio.filters import pose_loops as loops
from vio.filters import track_loops
from vio.filters.multiview import LandmarkResiduals
from vio.filters.navigation import DIM, ImuMotion, Measurement, NavState, Transition, TwistMotion
from vio.filters.online_calibration import Calibration, Twist
from vio.filters.scale_test import ScaleTest, is_clear
from vio.filters.separate_bias import SeparateBias
from vio.filters.stereo_calibration import METRIC_TERMS, StereoInformation
from vio.geometry.lie import (
    FloatArray,
    se3_adjoint,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    so3_exp,
    so3_hat,
)
from vio.numerics.compiled import move_poses
from vio.records import BoolArray, IntArray


@dataclass(frozen=True, slots=True)
class Clone:
    """The body when a frame was exposed: its camera's pose, seen through the present extrinsics."""

    frame_index: int
    time_ns: int  # the frame's stamp
    T_world_imu: FloatArray  # (4, 4)
    velocity: FloatArray  # (3,) as in NavState


_NO_CALIBRATION = Calibration(np.eye(4))
NO_TWIST = Twist(np.zeros(6), np.zeros((6, 6)))


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
        self._factors: dict[tuple[int, int], Factor] = {}  # of parts of P, since it changed
        self.nav = nav
        self.calibration = calibration
        self.clones: list[Clone] = []
        self.landmark_ids: IntArray = np.zeros(0, dtype=np.int64)
        self.landmarks: FloatArray = np.zeros((0, 3))
        self.P = P
        self.prior_delta: FloatArray = np.zeros(len(P))
        # Constants that are estimated beside the state; their vectors are transformed with the errors.
        self.scale_test: ScaleTest | None = None
        self.focal: SeparateBias | None = None  # the focal length's logarithm of (R4), where it is no state
        self.clocks_compared = False  # whether exposures follow the time offset's error, (C2)

    @property
    def P(self) -> FloatArray:
        """Covariance (D, D) of the prior."""
        return self._P

    @P.setter
    def P(self, P: FloatArray) -> None:
        self._P, self._factors = P, {}

    @property
    def calibration(self) -> Calibration:
        """The estimate of the rig's calibration."""
        return self._calibration

    @calibration.setter
    def calibration(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self.first_clone = DIM + calibration.dim  # row of the first clone, the one after the calibration's
        self.nav_dim = DIM + calibration.imu_dim  # errors of the navigation state and, after them, of the IMU's terms

    @property
    def _biases(self) -> list[SeparateBias]:
        """The constants that are estimated beside the state."""
        return [bias for bias in (self.scale_test, self.focal) if bias is not None]

    @property
    def first_landmark(self) -> int:
        """Row of the first landmark."""
        return self.first_clone + 6 * len(self.clones)

    def clone_rows(self, index: int) -> slice:
        """Rows of a clone."""
        start = self.first_clone + 6 * index
        return slice(start, start + 6)

    def exposures(self) -> FloatArray:
        """Poses (N, 4, 4) of the body when the frames were exposed."""
        return np.array([c.T_world_imu for c in self.clones])

    def T_cam0_world(self, first: int = 0) -> FloatArray:
        """Camera poses (N, 4, 4) at the exposures from one on."""
        T = np.array([c.T_world_imu for c in self.clones[first:]])
        out: FloatArray = np.empty(T.shape)
        loops.camera_poses(self.calibration.T_cam0_imu, T, out)
        return out

    def body_D_error(self) -> FloatArray:
        """Jacobian (6N, first_landmark) of the errors of the body's poses at the exposures, equation (C3)."""
        out = np.eye(6 * len(self.clones), self.first_landmark, self.first_clone)
        if self.calibration.extrinsics:
            back = se3_inverse(self.nav.T_world_imu)
            out[:, self.calibration.extrinsic_rows + DIM] = se3_adjoint(self.exposures() @ back).reshape(-1, 6)
        return out

    def exposure_errors(self, error: FloatArray) -> FloatArray:
        """How an error vector (D,) moves the cameras' poses (6N,)."""
        return error[self.first_clone : self.first_landmark]

    @property
    def stereo_rows(self) -> slice:
        """Rows of the stereo field's coefficients, empty where they are not estimated."""
        return slice(self.nav_dim, self.nav_dim + self.calibration.stereo_dim)

    def chain(self, out_D_exposures: FloatArray, out_D_stereo: FloatArray | None = None) -> FloatArray:
        """Turn Jacobians into Jacobians (..., D) by the error vector.

        Args:
            out_D_exposures: by the exposures' poses (..., 6N).
            out_D_stereo: by the stereo field's coefficients (..., S), where they are estimated.
        """
        out = np.zeros((*out_D_exposures.shape[:-1], len(self.P)))
        out[..., self.first_clone : self.first_landmark] = out_D_exposures
        if out_D_stereo is not None:
            out[..., self.stereo_rows] = out_D_stereo
        return out

    def add_landmarks_information(self, A: FloatArray, b: FloatArray, at: LandmarkResiduals, variance: float) -> None:
        """Add what the landmarks' pixels in their anchor, the newest clone, say: `dp = xi_f - xi_rho`; in place.

        Args:
            A: information about the errors (D, D).
            b: its vector (D,).
            at: their residuals.
            variance: of one pixel coordinate, px^2.
        """
        exposure = self.clone_rows(len(self.clones) - 1).start
        track_loops.add_landmarks(at.r, at.J, at.weight / variance, exposure, self.first_landmark, A, b)

    def lift_information(
        self, A: FloatArray, b: FloatArray, stereo: StereoInformation | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Turn information about exposures' poses (6N) into that about the error vector (D).

        Args:
            A: information matrix (6N, 6N).
            b: information vector (6N,).
            stereo: the part that concerns the stereo field, where it is estimated, beside poses and landmarks.
        """
        D, first = len(self.P), self.first_clone
        out, vector = np.zeros((D, D)), np.zeros(D)
        poses = slice(first, first + len(b))
        out[poses, poses], vector[poses] = A, b
        if stereo is not None:
            rows = self.stereo_rows
            out[rows, first:], out[first:, rows] = stereo.cross, stereo.cross.T
            out[rows, rows], vector[rows] = stereo.A, stereo.b
        return out, vector

    def lift_focal(self, said: StereoInformation) -> FloatArray:
        """Cross information (D,) of the errors and the focal length, the last of the calibration's terms given."""
        out = np.zeros(len(self.P))
        out[self.first_clone :] = said.cross[-1]
        out[self.stereo_rows] = said.A[-1, : self.calibration.stereo_dim]
        return out

    def scale_sigma(self) -> float:
        """The larger one of the standard deviations of baseline and focal length, over them; 0 where they are known."""
        if not self.calibration.metric:
            return 0.0
        end = self.stereo_rows.stop
        return float(np.sqrt(self.P.diagonal()[end - METRIC_TERMS : end].max(initial=0.0)))

    def camera_move_since(self, index: int) -> FloatArray:
        """Motion (4, 4) `T_clone_newest` of cam0 from a clone to the newest one."""
        T = self.calibration.T_cam0_imu
        move = se3_inverse(self.clones[index].T_world_imu) @ self.clones[-1].T_world_imu
        out: FloatArray = T @ move @ se3_inverse(T)
        return out

    def move_covariance(self, index: int, fitted: Fit) -> FloatArray:
        """Covariance (6, 6) of `xi_newest - xi_clone` after a fit of all errors."""
        newest, clone = self.clone_rows(len(self.clones) - 1), self.clone_rows(index)
        S = fitted.whitened(fitted.rows(newest.start, newest.stop) - fitted.rows(clone.start, clone.stop))
        return S @ S.T

    def landmark_covariance(self, fitted: Fit) -> FloatArray:
        """Covariance (M, 3 + S, 3 + S) of what a landmark's pixels depend on, after a fit of all errors.

        That is `xi_f - xi_rho`, the landmark relative to the newest exposure, and the coefficients of the stereo
        calibration.
        """
        M, S = len(self.landmarks), self.calibration.stereo_dim
        exposure = self.clone_rows(len(self.clones) - 1).start
        first, n = self.first_landmark, len(fitted.prior.L)
        moved = fitted.rows(first, first + 3 * M).reshape(M, 3, n) - fitted.rows(exposure, exposure + 3)
        root = fitted.whitened(moved)
        if S:
            stereo = fitted.whitened(fitted.rows(self.stereo_rows.start, self.stereo_rows.stop))
            root = np.concatenate([root, np.broadcast_to(stereo, (M, S, n))], axis=1)
        out: FloatArray = root @ np.swapaxes(root, 1, 2)
        return out

    def propagate(self, step: Transition, walk: FloatArray | None = None) -> None:
        """Move the navigation state by one step of its motion model.

        Args:
            step: the step.
            walk: what the calibration's random walk adds to its covariance (C, C), equation (C4); None: nothing.
        """
        Phi = np.eye(self.first_clone)
        Phi[:DIM, :DIM] = step.Phi
        if step.Phi_imu is not None:
            Phi[:DIM, DIM : self.nav_dim] = step.Phi_imu
        if self.calibration.extrinsics:
            rows = self.calibration.extrinsic_rows + DIM
            Phi[np.ix_(rows, rows)] = se3_adjoint(step.nav.T_world_imu @ se3_inverse(self.nav.T_world_imu))
        own = slice(0, len(Phi))
        for bias in self._biases:
            bias.error_D_bias[own] = Phi @ bias.error_D_bias[own]
        if self.scale_test is not None:
            V, before = self.scale_test.error_D_bias, self._scaled_nav(self.nav)
            V[:DIM] += step.Phi @ before - self._scaled_nav(step.nav)
        self.nav = step.nav
        P, self._factors = self.P, {}
        P[own] = Phi @ P[own]
        P[:, own] = P[:, own] @ Phi.T
        P[:DIM, :DIM] += step.Q
        if walk is not None:
            P[DIM : len(Phi), DIM : len(Phi)] += self.calibration.in_world(walk, self.nav.T_world_imu)
        self.prior_delta[own] = Phi @ self.prior_delta[own]

    def correlate_first_tilt(self, phi_D_terms: FloatArray) -> None:
        """Let the first attitude's error follow those of the IMU's terms (3, I), as equation (A4) has it."""
        J = np.eye(len(self.P))
        J[3:6, DIM : self.nav_dim] = phi_D_terms
        self.P = J @ self.P @ J.T

    def _scaled_nav(self, nav: NavState) -> FloatArray:
        """How the navigation state's error (15,) moves with the logarithm of the world's scale, equation (S1)."""
        T_world_cam0 = nav.T_world_imu @ se3_inverse(self.calibration.T_cam0_imu)
        return np.concatenate([T_world_cam0[:3, 3], np.zeros(3), nav.velocity, np.zeros(6)])

    def start_stereo_field(self, calibration: Calibration, covariance: FloatArray) -> None:
        """Add the stereo field's coefficients to the state.

        Args:
            calibration: with the coefficients' first estimate.
            covariance: of their errors (S, S).
        """
        self._insert(self.nav_dim, covariance, calibration)

    def _insert(self, first: int, covariance: FloatArray, calibration: Calibration) -> None:
        """Add errors with a covariance (S, S), from the row `first` on, of which a calibration has the means."""
        D, S = len(self.P), len(covariance)
        old = np.concatenate([np.arange(first), np.arange(first + S, D + S)])
        P, prior_delta = np.zeros((D + S, D + S)), np.zeros(D + S)
        P[np.ix_(old, old)], prior_delta[old] = self.P, self.prior_delta
        P[first : first + S, first : first + S] = covariance
        self.P, self.prior_delta, self.calibration = P, prior_delta, calibration
        for bias in self._biases:
            V, bias.error_D_bias = bias.error_D_bias, np.zeros(D + S)
            bias.error_D_bias[old] = V

    def free_focal_length(self, calibration: Calibration, covariance: FloatArray) -> None:
        """Make states of baseline and focal length; errors depend on them as was followed beside them, equation (S5).

        Args:
            calibration: with baseline and focal length as they were taken for known.
            covariance: of their logarithms (2, 2).
        """
        assert self.focal is not None
        D, first = len(self.P), self.stereo_rows.stop
        of_baseline = np.zeros(D) if self.scale_test is None else self.scale_test.error_D_bias + self.scaled()
        V = np.column_stack([of_baseline, self.focal.error_D_bias])
        self.focal = self.scale_test = None
        self._insert(first, np.zeros((METRIC_TERMS, METRIC_TERMS)), calibration)
        terms = np.arange(first, first + METRIC_TERMS)
        J = np.zeros((D + METRIC_TERMS, METRIC_TERMS))
        J[terms, np.arange(METRIC_TERMS)] = 1.0
        J[np.delete(np.arange(len(J)), terms)] = V
        self.P = self.P + J @ covariance @ J.T

    def scaled(self) -> FloatArray:
        """How all errors (D,) move with the logarithm of the world's scale, equation (S1)."""
        out = np.zeros(len(self.P))
        out[:DIM] = self._scaled_nav(self.nav)
        centres = (self.exposures() @ se3_inverse(self.calibration.T_cam0_imu))[:, :3, 3]
        out[self.first_clone : self.first_landmark].reshape(-1, 6)[:, :3] = centres
        out[self.first_landmark :] = self.landmarks.reshape(-1)
        return out

    def adopt_scale(self) -> float:
        """Scale the world, and move the prior, by what the scale test has found, equation (S4).

        Returns:
            The factor, by which the caller scales baseline and points.
        """
        assert self.scale_test is not None
        log, _ = self.scale_test.estimate()
        move = float(np.expm1(log)) * self.scaled()
        self.relinearise(move)
        self.prior_delta = self.prior_delta - move - log * self.scale_test.error_D_bias
        self.scale_test.adopt()
        return float(np.exp(log))

    def scale_covariance(self, information: FloatArray, P: FloatArray) -> FloatArray:
        """What the scale's uncertainty adds to the covariance (k, k) of the first errors, equation (S4).

        Args:
            information: about them (k, k), not yet absorbed.
            P: their covariance (k, k) with it, the scale known.
        """
        assert self.scale_test is not None
        V = self.scale_test.error_D_bias[: len(P)]
        V = V - P @ (information @ V) + self.scaled()[: len(P)]
        out: FloatArray = self.scale_test.estimate()[1] ** 2 * np.outer(V, V)
        return out

    def inflate_process_noise(self, extra: FloatArray) -> None:
        """Add noise (15, 15) to the last step, as if its motion had been known less; the newest clone ends it."""
        newest = self.clone_rows(len(self.clones) - 1)
        J = np.zeros((len(self.P), DIM))
        J[:DIM] = np.eye(DIM)
        J[newest, :6] = np.eye(6)
        J[self.first_landmark :, 3:6] = so3_hat(self.landmarks).reshape(-1, 3)
        self.P = self.P + J @ extra @ J.T

    def compare_clocks(self, time_ns: int, late_s: float, twist: Twist) -> None:
        """Let exposures follow the error of the time offset from now on, equation (C2).

        Until here the navigation state was that of an exposure by the offset believed, so it is the state that an error
        of the offset has moved, and not the next exposure.

        Args:
            time_ns: stamp of the coming frame.
            late_s: the navigation state's time on the IMU's clock minus that stamp.
            twist: of the body, and how well it is known.
        """
        self.clocks_compared = True
        _, camera_D_own, noise = self.camera_D_own(late_s, twist)
        D, moved = len(self.P), camera_D_own[:, -1]
        to_nav = np.eye(D)
        to_nav[:6, self.first_clone - 1] = -moved
        before = self.clones[-1]
        acceleration = (self.nav.velocity - before.velocity) / (1e-9 * (time_ns - before.time_ns))
        to_nav[6:9, self.first_clone - 1] = np.cross(moved[3:], self.nav.velocity) - acceleration
        self.P = to_nav @ self.P @ to_nav.T
        self.P[:6, :6] += noise
        self.prior_delta = to_nav @ self.prior_delta
        for bias in self._biases:
            bias.error_D_bias = to_nav @ bias.error_D_bias

    def add_clone(
        self, frame_index: int, time_ns: int, exposure: tuple[FloatArray, FloatArray, FloatArray] | None = None
    ) -> None:
        """Add the pose at an exposure as the newest clone; landmarks are anchored to its rotation from now on.

        Args:
            frame_index: the frame's number.
            time_ns: the frame's stamp.
            exposure: what `camera_D_own` has returned for it; None: the navigation state is that of the exposure.
        """
        T, camera_D_own, noise = self.camera_D_own(0.0, NO_TWIST) if exposure is None else exposure
        at, own, D = self.first_landmark, slice(0, self.first_clone), len(self.P)
        added, beside = camera_D_own @ self.P[own], self.P[:, own] @ camera_D_own.T  # exact copies without calibration
        block = added[:, own] @ camera_D_own.T + noise
        P = np.empty((D + 6, D + 6))
        new, end = slice(at, at + 6), slice(at + 6, D + 6)
        P[:at, :at], P[:at, end] = self.P[:at, :at], self.P[:at, at:]
        P[end, :at], P[end, end] = self.P[at:, :at], self.P[at:, at:]
        P[new, :at], P[new, end] = added[:, :at], added[:, at:]
        P[:at, new], P[end, new], P[new, new] = beside[:at], beside[at:], block
        delta = self.prior_delta
        self.prior_delta = np.concatenate([delta[:at], camera_D_own @ delta[own], delta[at:]])
        for bias in self._biases:
            V = bias.error_D_bias
            of_clone = self._scale_of_clone(T, camera_D_own) if bias is self.scale_test else camera_D_own @ V[own]
            bias.error_D_bias = np.concatenate([V[:at], of_clone, V[at:]])
        self.P = P
        self.clones.append(Clone(frame_index, time_ns, T, self.nav.velocity))
        if len(self.landmarks):
            self._anchor_to_newest(self.clone_rows(len(self.clones) - 2).start + 3)

    def _scale_of_clone(self, T_exposed: FloatArray, camera_D_own: FloatArray) -> FloatArray:
        """How the error (6,) of a clone of the navigation state depends on the scale, its own pose being scaled too."""
        assert self.scale_test is not None
        nav, V = self.nav, self.scale_test.error_D_bias[: self.first_clone].copy()
        V[:DIM] += self._scaled_nav(nav)
        out: FloatArray = camera_D_own @ V - self._scaled_nav(replace(nav, T_world_imu=T_exposed))[:6]
        return out

    def camera_D_own(
        self, late_s: float, twist: Twist, nav: NavState | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """How errors of navigation state and calibration move the camera at an exposure, equation (C2).

        Args:
            late_s: the navigation state's time on the IMU's clock minus the frame's stamp.
            twist: of the body at the exposure.
            nav: the navigation state; None: the window's.

        Returns:
            The body's pose (4, 4) at the exposure, the Jacobian (6, first_clone), and a noise covariance (6, 6).
        """
        T = self.nav.T_world_imu if nav is None else nav.T_world_imu
        J, calibration = np.eye(6, self.first_clone), self.calibration
        exposed = T
        if calibration.timing:
            exposed = T @ se3_exp(twist.mean * (calibration.time_offset_s - late_s))
        if calibration.extrinsics:
            J[:, calibration.extrinsic_rows + DIM] = -se3_adjoint(exposed @ se3_inverse(T))
        if not calibration.timing or not self.clocks_compared:
            return exposed, J, np.zeros((6, 6))
        A, row = se3_adjoint(exposed), self.first_clone - 1
        J[:, row] = A @ twist.significant()
        spread = float(self.P[row, row]) + (calibration.time_offset_s - late_s) ** 2
        return exposed, J, A @ twist.covariance @ A.T * spread

    def _anchor_to_newest(self, previous_rotation: int) -> None:
        """Measure the landmarks' errors from the newest exposure's rotation: xi_f += p^ (phi_new - phi_old)."""
        first, newest = self.first_landmark, self.clone_rows(len(self.clones) - 1).start + 3
        turn, before = slice(newest, newest + 3), slice(previous_rotation, previous_rotation + 3)
        p_cross = so3_hat(self.landmarks).reshape(-1, 3)
        P, delta, self._factors = self.P, self.prior_delta, {}
        P[first:] += p_cross @ (P[turn] - P[before])
        P[first:, first:] += (P[first:, turn] - P[first:, before]) @ p_cross.T
        P[:first, first:] = P[first:, :first].T
        delta[first:] += p_cross @ (delta[turn] - delta[before])
        for bias in self._biases:
            V = bias.error_D_bias
            V[first:] += p_cross @ (V[turn] - V[before])

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
        P = np.empty((len(rows), len(rows)))
        loops.take_rows(self.P, rows, P)
        self.P = P
        self.prior_delta = self.prior_delta[rows]
        for bias in self._biases:
            bias.error_D_bias = bias.error_D_bias[rows]

    def add_landmarks(
        self,
        ids: IntArray,
        p_world: FloatArray,
        A: FloatArray,
        covariance: FloatArray,
        point_D_focal: FloatArray | None = None,
    ) -> None:
        """Add landmarks (K, 3) whose errors are `A xi + noise`, with A (3K, D) and noise covariance (K, 3, 3).

        With `point_D_focal` (3K,), they depend on the focal length as well, where it is followed.
        """
        D, n = len(self.P), len(A)
        P = np.zeros((D + n, D + n))
        AP = A @ self.P
        P[:D, :D], P[D:, :D], P[:D, D:] = self.P, AP, AP.T
        P[D:, D:] = AP @ A.T
        for k, block in enumerate(covariance):
            P[D + 3 * k : D + 3 * k + 3, D + 3 * k : D + 3 * k + 3] += block
        self.prior_delta = np.concatenate([self.prior_delta, A @ self.prior_delta])
        for bias in self._biases:
            added = A @ bias.error_D_bias
            if bias is self.focal and point_D_focal is not None:
                added = added + point_D_focal
            bias.error_D_bias = np.concatenate([bias.error_D_bias, added])
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
        prior = self._prior_of(information, size)
        own = slice(prior.first, size)
        A, b = information[own, own], vector[own] + information[own, own] @ self.prior_delta[own]
        fitted = fit(prior, A)
        moved = fitted.move(b)
        shift: FloatArray = self.P[:, own] @ (b - A @ moved)  # the others follow by their correlation
        shift[own] = moved
        return fitted, shift - self.prior_delta

    def _prior_of(self, information: FloatArray, size: int) -> Factor:
        """The factor of the present covariance, up to row `size`, of the errors that information (D, D) is about.

        Pixels depend on no error of navigation state and extrinsics: then it is that of the errors after them, unless
        these are singular beyond rounding. It is computed once for all fits to one covariance.
        """
        first = self.nav_dim if self.calibration.stereo_dim else self.first_clone
        if information[:first].any():
            first = 0
        if (first, size) not in self._factors:
            self._factors[first, size] = factor(self.P[:size, :size], first)
        return self._factors[first, size]

    def absorb(
        self,
        information: FloatArray,
        vector: FloatArray,
        scaled: FloatArray | None = None,
        focal: FloatArray | None = None,
    ) -> None:
        """Absorb measurements into the prior.

        Args:
            information: `H' R^-1 H` (D, D) of the residuals at the present means.
            vector: `H' R^-1 r` (D,).
            scaled: for measurements in metres, how the errors (D,) move with the logarithm of the world's scale.
            focal: for pixels, `H' R^-1 h` (D,) with their derivatives h by the focal length's logarithm.
        """
        prior = self._prior_of(information, len(self.P))
        own = slice(prior.first, None)
        P = fit(prior, information[own, own]).covariance()
        self.prior_delta = self.prior_delta - P @ (vector + information @ self.prior_delta)
        self.P = P
        if self.scale_test is not None:
            self.scale_test.absorb(information, vector, -self.prior_delta, P, scaled)
        if self.focal is not None:
            self.focal.follow(information, P, focal)

    def measure(self, measurement: Measurement) -> None:
        """Absorb a measurement of the navigation state and move the means to the new prior."""
        self.absorb_measurement(measurement)
        self.relinearise(-self.prior_delta)

    def absorb_measurement(self, measurement: Measurement) -> None:
        """Absorb a measurement of the navigation state; the means stay where they are."""
        RiH, own = np.linalg.solve(measurement.R, measurement.H), slice(0, measurement.H.shape[1])
        information = np.zeros_like(self.P)
        information[own, own] = measurement.H.T @ RiH
        vector = np.zeros(len(self.P))
        vector[own] = RiH.T @ measurement.residual
        scaled = None
        if measurement.metric and self.scale_test is not None and is_clear(self.nav.velocity, self.P[6:9, 6:9]):
            scaled = np.zeros(len(self.P))
            scaled[:DIM] = self._scaled_nav(self.nav)
        self.absorb(information, vector, scaled)

    def relinearise(self, error: FloatArray) -> None:
        """Move the means by an error vector (D,); the prior stays where it is."""
        T, moves = self.exposures(), self.exposure_errors(error).reshape(-1, 6).copy()
        if self.calibration.extrinsics:
            eta = error[self.calibration.extrinsic_rows + DIM]
            loops.add_extrinsic_moves(T, self.nav.T_world_imu, eta, moves)
        move_poses(moves, T)
        if len(self.landmarks):
            self.landmarks = self.landmarks.copy()
            xi_f = error[self.first_landmark :].reshape(-1, 3)
            loops.move_points(self.exposure_errors(error)[-3:], xi_f, self.landmarks)
        velocities = [c.velocity for c in self.clones]
        if isinstance(self.motion, ImuMotion):
            velocities = self._corrected_velocities(self.motion, T, error[: self.nav_dim])
        self.clones = [
            Clone(c.frame_index, c.time_ns, pose, velocity)
            for c, pose, velocity in zip(self.clones, T, velocities, strict=True)
        ]
        if self.calibration.dim:
            own = error[DIM : self.first_clone]
            self.calibration = self.calibration.corrected(own, self.nav.T_world_imu)
        self.nav = self.motion.corrected(self.nav, error[: self.nav_dim])
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
        extrinsics = (self.calibration.extrinsic_rows + DIM)[::3].tolist()
        in_world = [*range(0, 9, 3), *extrinsics, *range(self.first_clone, D, 3)]
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
        for bias in self._biases:
            bias.error_D_bias = M @ bias.error_D_bias
        return R, M

    def _corrected_velocities(self, motion: ImuMotion, T_world_imu: FloatArray, error: FloatArray) -> list[FloatArray]:
        """The clones' velocities (3,), moved by the present error (15 + I,), at corrected poses (N, 4, 4)."""
        ages = np.array([self.clones[-1].time_ns - c.time_ns for c in self.clones]) * 1e-9
        R, earlier = T_world_imu[:, :3, :3], np.array([c.velocity for c in self.clones])
        return list(motion.corrected_earlier(earlier, 0.5 * (R + R[-1]), ages, error))


@dataclass(frozen=True, slots=True)
class Factor:
    """A covariance, and a factor of that of its last n errors: `P_n = L L'`."""

    P: FloatArray  # (D, D)
    L: FloatArray  # (n, n)
    triangular: bool  # by Cholesky; False: by the eigenvectors of a P that is singular beyond rounding

    @property
    def first(self) -> int:
        """Row of the first error that is factored."""
        return len(self.P) - len(self.L)


@dataclass(frozen=True, slots=True)
class Fit:
    """The covariance after a measurement of the last n errors in information form: `P_n_new = L (K K')^-1 L'`."""

    prior: Factor
    K_transposed: FloatArray  # (n, n) upper triangle, of `K K' = I + L' A L`, in LAPACK's order of columns

    def move(self, vector: FloatArray) -> FloatArray:
        """Return `P_n_new v` (n,), for the information vector v (n,) the shift of their mean."""
        L = self.prior.L
        out: FloatArray = L @ lapack.dpotrs(self.K_transposed, L.T @ vector, lower=0)[0]
        return out

    def rows(self, start: int, stop: int) -> FloatArray:
        """Return the rows (stop - start, n) of L that belong to rows of P: `J L` for a choice J of the errors."""
        first = self.prior.first
        return self.prior.L[start - first : stop - first]

    def whitened(self, J_L: FloatArray) -> FloatArray:
        """Return S (..., k, n) with `S S'` the covariance of `J error`, from `J L` (..., k, n)."""
        rows = np.ascontiguousarray(J_L).reshape(-1, J_L.shape[-1])
        S: FloatArray = blas.dtrsm(1.0, self.K_transposed, rows.T, lower=0, trans_a=1).T
        return S.reshape(J_L.shape)

    def covariance(self) -> FloatArray:
        """Return the covariance (D, D) of all errors: symmetric and positive by construction.

        That of the last n is `W' W`. With N the others' covariance with them before, times `L'^-1 K'^-1`, the others'
        covariance with them is `N W`, and their own is `N N'` and what it is given the last n.
        """
        P, L, first = self.prior.P, self.prior.L, self.prior.first
        W = blas.dtrsm(1.0, self.K_transposed, L.T, lower=0, trans_a=1)
        out: FloatArray = np.empty(P.shape)
        out[first:, first:] = W.T @ W
        if first:
            G: FloatArray = blas.dtrsm(1.0, L.T, P[:first, first:].T, lower=0, trans_a=1).T
            N = self.whitened(G)
            out[:first, first:] = N @ W
            out[first:, :first] = out[:first, first:].T
            out[:first, :first] = P[:first, :first] - G @ G.T + N @ N.T
            _keep_positive(out, P, first)
        return out


def _keep_positive(out: FloatArray, P: FloatArray, count: int) -> None:
    """Add to the first variances of a covariance what keeps it positive to rounding, also where P knows one exactly."""
    np.einsum("ii->i", out)[:count] += 1e-14 * P.diagonal()[:count] + 1e-24


def factor(P: FloatArray, first: int = 0) -> Factor:
    """Factor a covariance (D, D) from the row `first` on; the whole where that part is singular beyond rounding."""
    A = np.array(P[first:, first:], order="C")
    _keep_positive(A, A, len(A))
    upper, failed = lapack.dpotrf(A.T, lower=0, overwrite_a=1)
    if not failed:
        return Factor(P, upper.T, True)
    values, vectors = np.linalg.eigh(P)
    root: FloatArray = np.array(vectors * np.sqrt(np.maximum(values, 0.0)), dtype=np.float64, order="C")
    return Factor(P, root, False)


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
    return Fit(prior, K_transposed)


def posterior(P: FloatArray, information: FloatArray, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (D, D) and the shift of the mean (D,) after a measurement in information form."""
    P_new = fit(factor(P), information).covariance()
    return P_new, P_new @ vector
