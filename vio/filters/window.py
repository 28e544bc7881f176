"""The window: means of navigation state, calibration, clones and landmarks, and the prior over all
their errors.

The error of a clone is that of the camera's pose, equation (C2), so the calibration of camera and
IMU enters where a clone is made and nowhere else. `vio.filters.error_state` says where each error
is, `vio.filters.prior` holds the covariance.
"""

from __future__ import annotations

from dataclasses import field, replace
from functools import lru_cache

import numpy as np

from vio.dataclass import dataclass
from vio.filters import pose_loops as loops
from vio.filters.error_state import ErrorState
from vio.filters.navigation import DIM, ImuMotion, Measurement, NavState, Transition, TwistMotion
from vio.filters.online_calibration import BLOCKS, NO_TWIST, Calibration, Twist
from vio.filters.prior import Fit, Prior
from vio.filters.scale_test import is_clear, scaled_nav
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


@dataclass(frozen=True, slots=True)
class Clones:
    """The clones of a window, oldest first: the fields of `Clone` in arrays."""

    frame_indices: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (N,)
    times_ns: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (N,)
    T_world_imu: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (N, 4, 4)
    velocities: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (N, 3)

    def __len__(self) -> int:
        return self.times_ns.size

    def __getitem__(self, index: int) -> Clone:
        number = int(self.frame_indices[index])
        time_ns = int(self.times_ns[index])
        return Clone(number, time_ns, self.T_world_imu[index], self.velocities[index])

    def with_newest(self, clone: Clone) -> Clones:
        """Return the clones and a newer one."""
        return Clones(
            np.concatenate([self.frame_indices, [clone.frame_index]]),
            np.concatenate([self.times_ns, [clone.time_ns]]),
            np.concatenate([self.T_world_imu, clone.T_world_imu[None]]),
            np.concatenate([self.velocities, clone.velocity[None]]),
        )

    def without_oldest(self) -> Clones:
        """Return all but the first."""
        return Clones(
            self.frame_indices[1:], self.times_ns[1:], self.T_world_imu[1:], self.velocities[1:]
        )

    def turned(self, R: FloatArray) -> Clones:
        """Return the same in a world that is turned by R (3, 3)."""
        velocities = np.array([R @ v for v in self.velocities])
        return replace(
            self,
            T_world_imu=se3_from_parts(R, np.zeros(3)) @ self.T_world_imu,
            velocities=velocities,
        )


_I3 = np.eye(3)
_NO_CALIBRATION = Calibration(np.eye(4))


@lru_cache(maxsize=64)
def _error_state(
    calibration: tuple[tuple[str, int], ...], clones: int, landmarks: int
) -> ErrorState:
    return ErrorState(dict(calibration), clones, landmarks)


class Window:
    """The states of the sliding-window filter."""

    def __init__(
        self,
        motion: ImuMotion | TwistMotion,
        nav: NavState,
        P: FloatArray,
        calibration: Calibration = _NO_CALIBRATION,
    ) -> None:
        """Begin without clones.

        Args:
            motion: the motion model.
            nav: the navigation state.
            P: covariance (15 + C, 15 + C) of the errors of navigation state and calibration.
            calibration: its means.
        """
        self.motion = motion
        self.nav = nav
        self.calibration = calibration
        self.clones = Clones()
        self.landmark_ids: IntArray = np.zeros(0, dtype=np.int64)
        self.landmarks: FloatArray = np.zeros((0, 3))
        self.prior = Prior(P)
        self._lay_out()
        # the cameras' poses (N, 4, 4), of these poses of the body, by this calibration
        self._cameras: tuple[FloatArray, FloatArray, FloatArray] | None = None
        self.clocks_compared = False  # whether exposures follow the time offset's error, (C2)

    def _lay_out(self) -> None:
        """Find the rows of all errors, after a change of which there are."""
        blocks = tuple(self.calibration.estimated.items())
        self.state = _error_state(blocks, len(self.clones), len(self.landmarks))

    def T_cam0_world(self, first: int = 0) -> FloatArray:
        """Camera poses (N, 4, 4) at the exposures from one on."""
        T = self.clones.T_world_imu
        T_cam0_imu = self.calibration.T_cam0_imu
        known = self._cameras
        if known is None or known[0] is not T or known[1] is not T_cam0_imu:
            out: FloatArray = np.empty(T.shape)
            loops.camera_poses(T_cam0_imu, T, out)
            known = self._cameras = T, T_cam0_imu, out
        return known[2][first:]

    def body_D_error(self) -> FloatArray:
        """Jacobian (6N, k) of the errors of the body's poses at the exposures by the first k, to
        theirs: (C3).
        """
        state = self.state
        out = np.eye(6 * len(self.clones), state.clones.stop, state.clones.start)
        if "extrinsics" in state.blocks:
            back = se3_inverse(self.nav.T_world_imu)
            moved = se3_adjoint(self.clones.T_world_imu @ back)
            out[:, state.blocks["extrinsics"]] = moved.reshape(-1, 6)
        return out

    def camera_move_since(self, index: int) -> FloatArray:
        """Motion (4, 4) `T_clone_newest` of cam0 from a clone to the newest one."""
        T = self.calibration.T_cam0_imu
        poses = self.clones.T_world_imu
        move = se3_inverse(poses[index]) @ poses[-1]
        out: FloatArray = T @ move @ se3_inverse(T)
        return out

    def propagate(self, step: Transition, walk: FloatArray | None = None) -> None:
        """Move the navigation state by one step of its motion model.

        Args:
            step: the step.
            walk: variances (C,) that the constants of the calibration gain by their random walk;
                None: nothing.
        """
        state = self.state
        prior = self.prior
        before = self.nav
        nav = step.nav
        Phi = self.calibration.transition(state, step, nav.T_world_imu, before.T_world_imu)
        own = state.own
        T_cam0_imu = self.calibration.T_cam0_imu
        V = prior.error_D_constants
        V[own] = Phi @ V[own]
        scaled = scaled_nav(before.T_world_imu, before.velocity, T_cam0_imu)
        V[:DIM, 0] += step.Phi @ scaled - scaled_nav(nav.T_world_imu, nav.velocity, T_cam0_imu)
        self.nav = nav
        P = prior.to_change()
        P[own] = Phi @ P[own]
        P[:, own] = P[:, own] @ Phi.T
        P[:DIM, :DIM] += step.Q
        if walk is not None:
            P[state.calibration, state.calibration] += self.calibration.in_world(
                walk, self.nav.T_world_imu
            )
        prior.delta[own] = Phi @ prior.delta[own]

    def estimate_block(self, name: str, calibration: Calibration, covariance: FloatArray) -> None:
        """Make states of a block of the calibration.

        Args:
            name: of the block.
            calibration: that estimates it, with its first means.
            covariance: of its errors (n, n), which depend on no other.
        """
        self.calibration = calibration
        self._lay_out()
        self.prior.insert(self.state.blocks[name].start, covariance)

    def keep_first_attitude(self, calibration: Calibration) -> None:
        """Make a state of the oldest clone's attitude, which stays when the clone is dropped,
        equation (N14).

        Args:
            calibration: that estimates the block `first_attitude`.
        """
        first = self.state.clone(0)
        phi = slice(first.start + 3, first.stop)
        J = np.eye(3, first.stop, phi.start)
        self.calibration = calibration
        self.prior.insert_dependent(
            first.start, J, np.zeros((3, 3)), self.prior.error_D_constants[phi, 0]
        )
        self._lay_out()

    def since_first(self, out_D_error: FloatArray) -> FloatArray:
        """Turn Jacobians (6k, D) of poses into those of the same in the world that is reported,
        equation (N14).
        """
        if "first_attitude" in self.state.blocks:
            out_D_error = out_D_error.copy()
            rows = out_D_error.reshape(-1, 6, out_D_error.shape[1])
            rows[:, 3:, self.state.blocks["first_attitude"]] -= _I3
        return out_D_error

    @property
    def last_step_s(self) -> float:
        """Time between the two newest clones."""
        times_ns = self.clones.times_ns
        return float(times_ns[-1] - times_ns[-2]) * 1e-9

    def move_newest(self, turn: FloatArray, shift: FloatArray) -> None:
        """Turn the body by a rotation (3,) about itself and shift it by (3,), world frame, in the
        newest clone and the navigation state; with them goes what is known of them.
        """
        R = so3_exp(turn)

        def moved(T_world_imu: FloatArray) -> FloatArray:
            return se3_from_parts(R @ T_world_imu[:3, :3], T_world_imu[:3, 3] + shift)

        self.nav = replace(self.nav, T_world_imu=moved(self.nav.T_world_imu))
        poses = self.clones.T_world_imu.copy()
        poses[-1] = moved(poses[-1])
        self.clones = replace(self.clones, T_world_imu=poses)

    def inflate_process_noise(self, extra: FloatArray) -> None:
        """Add noise (15, 15) to the last step, as if its motion had been known less; the newest
        clone ends it.
        """
        J = np.zeros((self.state.size, DIM))
        J[:DIM] = np.eye(DIM)
        J[self.state.clone(-1), :6] = np.eye(6)
        J[self.state.landmarks, 3:6] = so3_hat(self.landmarks).reshape(-1, 3)
        self.prior.P = self.prior.P + J @ extra @ J.T

    def compare_clocks(self, time_ns: int, late_s: float, twist: Twist) -> None:
        """Let exposures follow the error of the time offset from now on, equation (C2).

        Until here the navigation state was that of an exposure by the offset believed, so it is the
        state that an error of the offset has moved, and not the next exposure.

        Args:
            time_ns: stamp of the coming frame.
            late_s: the navigation state's time on the IMU's clock minus that stamp.
            twist: of the body, and how well it is known.
        """
        self.clocks_compared = True
        _, camera_D_own, noise = self.camera_D_own(late_s, twist)
        offset = self.state.blocks["time_offset"].start
        to_nav = np.eye(self.state.size)
        moved = camera_D_own[:, offset]
        to_nav[:6, offset] = -moved
        before = self.clones[-1]
        acceleration = (self.nav.velocity - before.velocity) / (1e-9 * (time_ns - before.time_ns))
        to_nav[6:9, offset] = np.cross(moved[3:], self.nav.velocity) - acceleration
        self.prior.transform(to_nav)
        self.prior.P[:6, :6] += noise

    def add_clone(
        self,
        frame_index: int,
        time_ns: int,
        exposure: tuple[FloatArray, FloatArray, FloatArray] | None = None,
    ) -> None:
        """Add the pose at an exposure as the newest clone; landmarks are anchored to its rotation
        from now on.

        Args:
            frame_index: the frame's number.
            time_ns: the frame's stamp.
            exposure: what `camera_D_own` has returned for it; None: the navigation state is that of
                the exposure.
        """
        T, camera_D_own, noise = self.camera_D_own(0.0, NO_TWIST) if exposure is None else exposure
        of_scale = self.prior.error_D_constants[self.state.own, 0].copy()
        nav = self.nav
        T_cam0_imu = self.calibration.T_cam0_imu
        of_scale[:DIM] += scaled_nav(nav.T_world_imu, nav.velocity, T_cam0_imu)
        scaled_clone = scaled_nav(T, nav.velocity, T_cam0_imu)[:6]
        self.prior.insert_dependent(
            self.state.clones.stop, camera_D_own, noise, camera_D_own @ of_scale - scaled_clone
        )
        self.clones = self.clones.with_newest(Clone(frame_index, time_ns, T, self.nav.velocity))
        self._lay_out()
        if len(self.landmarks):
            self._anchor_to_newest(self.state.clone(-2).start + 3)

    def camera_D_own(
        self, late_s: float, twist: Twist
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the body's pose and the Jacobian of `camera_at`, and the covariance of
        `exposure_noise`.
        """
        T, J = self.camera_at(late_s, twist, self.nav)
        return T, J, self.exposure_noise(T, late_s, twist)

    def camera_at(
        self, late_s: float, twist: Twist, nav: NavState
    ) -> tuple[FloatArray, FloatArray]:
        """How errors of navigation state and calibration move the camera at an exposure, equation
        (C2).

        Args:
            late_s: the navigation state's time on the IMU's clock minus the frame's stamp.
            twist: of the body at the exposure.
            nav: the navigation state.

        Returns:
            The body's pose (4, 4) at the exposure, and the Jacobian (6, 15 + C).
        """
        T = nav.T_world_imu
        state = self.state
        calibration = self.calibration
        J = state.own_identity[:6].copy()
        exposed = T
        compared = self.clocks_compared and "time_offset" in state.blocks
        if "time_offset" in state.blocks:
            exposed = T @ se3_exp(twist.mean * (calibration.time_offset_s - late_s))
        for name in calibration.estimated:
            seen = twist if compared else None
            column = BLOCKS[name].camera_D_error(T, exposed, seen)
            if column is not None:
                J[:, state.blocks[name]] = column
        return exposed, J

    def exposure_noise(self, T_world_imu: FloatArray, late_s: float, twist: Twist) -> FloatArray:
        """Covariance (6, 6) of the camera at an exposure of the body (4, 4), by an uncertain
        twist over its offset.
        """
        if not self.clocks_compared or "time_offset" not in self.state.blocks:
            return np.zeros((6, 6))
        A = se3_adjoint(T_world_imu)
        row = self.state.blocks["time_offset"].start
        spread = float(self.prior.P[row, row]) + (self.calibration.time_offset_s - late_s) ** 2
        out: FloatArray = A @ twist.covariance @ A.T * spread
        return out

    def _anchor_to_newest(self, previous_rotation: int) -> None:
        """Measure the landmarks' errors from the newest exposure's rotation: xi_f += p^ (phi_new
        - phi_old).
        """
        first = self.state.landmarks.start
        newest = self.state.clone(-1).start + 3
        turn = slice(newest, newest + 3)
        before = slice(previous_rotation, previous_rotation + 3)
        p_cross = so3_hat(self.landmarks).reshape(-1, 3)
        P = self.prior.to_change()
        delta = self.prior.delta
        P[first:] += p_cross @ (P[turn] - P[before])
        difference = P[first:, turn] - P[first:, before]
        P[first:, first:] += difference @ p_cross.T
        P[:first, first:] = P[first:, :first].T
        delta[first:] += p_cross @ (delta[turn] - delta[before])
        V = self.prior.error_D_constants
        V[first:] += p_cross @ (V[turn] - V[before])

    def drop_oldest_clone(self) -> None:
        """Forget the oldest clone."""
        self.prior.keep(np.delete(np.arange(self.state.size), self.state.clone(0)))
        self.clones = self.clones.without_oldest()
        self._lay_out()

    def keep_landmarks(self, chosen: BoolArray) -> None:
        """Forget the landmarks outside a mask (M,)."""
        if chosen.all():
            return
        rows = np.concatenate(
            [np.ones(self.state.landmarks.start, dtype=np.bool_), np.repeat(chosen, 3)]
        )
        self.prior.keep(rows.nonzero()[0])
        self.landmark_ids = self.landmark_ids[chosen]
        self.landmarks = self.landmarks[chosen]
        self._lay_out()

    def add_landmarks(
        self,
        ids: IntArray,
        p_world: FloatArray,
        A: FloatArray,
        covariance: FloatArray,
        by_considered: FloatArray | None = None,
    ) -> None:
        """Add landmarks (K, 3) whose errors are `A xi + B c + noise`.

        A is (3K, D), the noise's covariance (K, 3, 3), B (3K, 4) by the constants considered; None:
        zero.
        """
        self.prior.append(A, covariance, by_considered)
        self.landmark_ids = np.concatenate([self.landmark_ids, ids])
        self.landmarks = np.concatenate([self.landmarks, p_world])
        self._lay_out()

    def optimum(
        self, information: FloatArray, vector: FloatArray, size: int
    ) -> tuple[Fit, FloatArray]:
        """Where the prior and information of pixels (D, D) and (D,) agree best, see
        `Prior.optimum`.
        """
        return self.prior.optimum(information, vector, size, self.state.first_of_pixels)

    def absorb(
        self,
        information: FloatArray,
        vector: FloatArray,
        scaled: FloatArray | None = None,
        repeated: float = 1.0,
        considered: FloatArray | None = None,
    ) -> None:
        """Absorb measurements into the prior, see `Prior.absorb`; the means stay where they are.

        Args:
            information: (D, D).
            vector: (D,).
            scaled: for measurements in metres.
            repeated: for pixels, the factor by which they repeat what was said of the rectification
                error.
            considered: for pixels, the part (D, 4) of the constants considered.
        """
        partly = (
            (self.state.blocks["stereo_field"], repeated)
            if repeated > 1 and "stereo_field" in self.state.blocks
            else None
        )
        self.prior.absorb(
            information, vector, self.state.first_of_pixels, scaled, partly, considered
        )

    def absorb_measurement(self, measurement: Measurement) -> None:
        """Absorb a measurement of the navigation state; the means stay where they are."""
        RiH = np.linalg.solve(measurement.R, measurement.H)
        own = slice(0, measurement.H.shape[1])
        information = np.zeros_like(self.prior.P)
        information[own, own] = measurement.H.T @ RiH
        vector = np.zeros(self.state.size)
        vector[own] = RiH.T @ measurement.residual
        scaled = None
        test = self.prior.scale_test
        if (
            measurement.metric
            and test is not None
            and is_clear(self.nav.velocity, self.prior.P[6:9, 6:9])
        ):
            scaled = np.zeros(self.state.size)
            nav = self.nav
            T_cam0_imu = self.calibration.T_cam0_imu
            scaled[:DIM] = scaled_nav(nav.T_world_imu, nav.velocity, T_cam0_imu)
        self.absorb(information, vector, scaled)

    def measure(self, measurement: Measurement) -> None:
        """Absorb a measurement of the navigation state and move the means to the new prior."""
        self.absorb_measurement(measurement)
        self.relinearise(-self.prior.delta)

    def relinearise(self, error: FloatArray) -> None:
        """Move the means by an error vector (D,); the prior stays where it is."""
        state = self.state
        of_clones = error[state.clones]
        clones = self.clones
        moves = of_clones.reshape(-1, 6).copy()
        T = clones.T_world_imu.copy()
        velocities = clones.velocities
        if "extrinsics" in state.blocks:
            of_extrinsics = error[state.blocks["extrinsics"]]
            loops.add_extrinsic_moves(T, self.nav.T_world_imu, of_extrinsics, moves)
        move_poses(moves, T)
        if len(self.landmarks):
            before = self._landmarks_seen()
            self.landmarks = self.landmarks.copy()
            loops.move_points(of_clones[-3:], error[state.landmarks].reshape(-1, 3), self.landmarks)
        if isinstance(self.motion, ImuMotion):
            ages = (clones.times_ns[-1] - clones.times_ns) * 1e-9
            R = 0.5 * (T[:, :3, :3] + T[-1, :3, :3])
            velocities = self.motion.corrected_earlier(velocities, R, ages, error[state.motion])
        self.clones = Clones(clones.frame_indices, clones.times_ns, T, velocities)
        if self.calibration.estimated:
            self.calibration = self.calibration.corrected(
                error[state.calibration], self.nav.T_world_imu
            )
        self.nav = self.motion.corrected(self.nav, error[state.motion])
        self.prior.delta = self.prior.delta + error
        if len(self.landmarks):
            self._move_constants(self._landmarks_seen() - before)

    def _landmarks_seen(self) -> FloatArray:
        """Landmarks (M, 3) from the newest camera's centre, along the world's axes."""
        T = self.T_cam0_world(-1)[0]
        return self.landmarks + T[:3, :3].T @ T[:3, 3]

    def _move_constants(self, moved: FloatArray) -> None:
        """Let how landmarks depend on baseline and focal length follow their means, equation (S5).

        A world that is scaled with the baseline changes no pixel. Where landmarks depend on it as
        at their means before, their pixels would say something of the constants all the same, and
        an IMU, which forgets nothing, turns that into tilt and velocity.

        Args:
            moved: by how much landmarks (M, 3) have moved against the newest camera.
        """
        rows = self.state.landmarks
        V = self.prior.error_D_constants
        V[rows, 1] += moved.reshape(-1)
        axis = self.T_cam0_world(-1)[0, 2, :3]
        V[rows, 2] += ((moved @ axis)[:, None] * axis).reshape(-1)

    def turn_world(self, yaw: float, yaw_D_tilt: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Turn the whole world about its z axis, and let the errors' yaw hang on the present tilt,
        equation (N13).

        Args:
            yaw: rad; no residual changes by it.
            yaw_D_tilt: (3,) by the navigation state's phi, for the yaw of all poses alike.

        Returns:
            R (3, 3), which takes points of the old world to the new one, and M (D, D), which does
            so with errors.
        """
        R = so3_exp([0.0, 0.0, yaw])
        state = self.state
        prior = self.prior
        M = np.eye(state.size)
        M[[5, *range(state.clones.start + 5, state.clones.stop, 6)], 3:6] += yaw_D_tilt
        in_world = [*range(0, 9, 3), *range(state.clones.start, state.size, 3)]
        if "extrinsics" in state.blocks:
            in_world += range(state.blocks["extrinsics"].start, state.blocks["extrinsics"].stop, 3)
        turn = np.eye(state.size)
        for k in in_world:
            turn[k : k + 3, k : k + 3] = R
        M = turn @ M
        T = se3_from_parts(R, np.zeros(3))
        self.nav = replace(
            self.nav, T_world_imu=T @ self.nav.T_world_imu, velocity=R @ self.nav.velocity
        )
        self.clones = self.clones.turned(R)
        self.landmarks = self.landmarks @ R.T
        P = M @ prior.P @ M.T
        prior.P = 0.5 * (P + P.T)
        prior.delta = turn @ prior.delta
        prior.error_D_constants = M @ prior.error_D_constants
        return R, M
