"""Between two frames: the motion model propagates the navigation state and predicts the camera's
motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.errors import EstimationError
from vio.filters.error_state import ErrorState
from vio.filters.navigation import (
    DIM,
    NO_STEP,
    Growth,
    ImuMotion,
    NavState,
    Transition,
    TwistMotion,
)
from vio.filters.noise import MotionNoise, StepErrors
from vio.filters.online_calibration import NO_TWIST, Twist, body_twist, walk_variances
from vio.filters.settings import MsckfSettings
from vio.filters.window import Window
from vio.geometry.lie import FloatArray, se3_adjoint, se3_inverse, se3_log
from vio.imu.settings import ImuSettings
from vio.records import ImuSample, MotionPrior, MotionSample, MotionSource

# Factors on the motion model's densities: at the start, at least, at most.
IMU_FACTORS = (1.0, 1.0, 50.0)
_TWIST_FACTORS = (1.0, 0.1, 10.0)


class _TiltRules(NamedTuple):
    """How an uncertain tilt counts."""

    # A start with a large uncertainty of the tilt is linearised far from the truth, which shows as
    # process noise.
    factor_per_tilt_sigma: float = 1 / np.radians(8.0)
    max_start_factor: float = 5.0
    # standard deviation of a predicted rotation beyond which its pixels start no search
    useless_rad: float = 0.2


_TILT = _TiltRules()
# standard deviation of a rotation beyond which the errors of poses before and after it are not
# linear
_LINEAR_RAD = 1.0


@dataclass(frozen=True, slots=True)
class FramePosterior:
    """Covariances after a frame, with all that was seen."""

    own: FloatArray  # (15 + C, 15 + C) of navigation state and calibration
    with_newest: FloatArray  # (15 + C + 6, 15 + C + 6) the same, and the newest clone's after it
    T_world_imu: FloatArray  # (4, 4) of the navigation state

    @classmethod
    def begun(cls, window: Window) -> FramePosterior:
        """Take over the covariance of a window without clones."""
        D = window.state.size
        with_newest = np.zeros((D + 6, D + 6))
        with_newest[:D, :D] = window.prior.P
        return cls(window.prior.P.copy(), with_newest, window.nav.T_world_imu)

    @classmethod
    def of(cls, window: Window, P: FloatArray) -> FramePosterior:
        """Take over the part of the covariance P (k, k) of a window's errors."""
        own = window.state.own
        newest = window.state.clone(-1)
        D = own.stop
        with_newest = np.empty((D + 6, D + 6))
        with_newest[:D, :D] = P[own, own]
        with_newest[:D, D:] = P[own, newest]
        with_newest[D:, :D] = P[newest, own]
        with_newest[D:, D:] = P[newest, newest]
        return cls(with_newest[:D, :D], with_newest, window.nav.T_world_imu)

    def transformed(self, window: Window, M: FloatArray) -> FramePosterior:
        """Return the covariances after `Window.turn_world`, which returned M."""
        own = window.state.own
        rows = np.r_[window.state.own, window.state.clone(-1)]
        turn = M[np.ix_(rows, rows)]
        return FramePosterior(
            M[own, own] @ self.own @ M[own, own].T,
            turn @ self.with_newest @ turn.T,
            window.nav.T_world_imu,
        )


@dataclass(frozen=True, slots=True)
class _Coming:
    """A step that begins where the navigation state is."""

    body_ns: int  # its end
    step: Transition
    growth: Growth  # since the last frame, with it


_I3 = np.eye(3)
_I6 = np.eye(6)
_POSE = np.eye(6, DIM)  # the pose of a navigation state
_NOTHING = FramePosterior(np.zeros((DIM, DIM)), np.zeros((DIM + 6, DIM + 6)), np.eye(4))


class Propagation:
    """The motion model, its noise, and how far it has carried the navigation state."""

    def __init__(
        self, source: MotionSource | None, settings: MsckfSettings, imu: ImuSettings
    ) -> None:
        """Prepare; no window exists yet."""
        self.source = source
        self.motion: ImuMotion | TwistMotion = (
            ImuMotion(settings, imu) if source == "imu" else TwistMotion(settings)
        )
        self.walk = walk_variances(settings)  # a second
        self.noise = self.unknown_noise()
        self.time_ns = 0
        self.body_ns = 0  # time of the navigation state, on the IMU's clock
        self.blind = False  # the last frame showed nothing
        self.posterior = _NOTHING  # after the last frame that showed something
        # the same with the uncertainty of the rig's scale, which corrects nothing
        self.reported = _NOTHING
        self.since_frame = NO_STEP  # how the error has grown since then
        self.gyro: FloatArray | None = None  # (3,) mean rate measured over the last step
        self._coming: _Coming | None = None  # the step that `predict` has integrated
        # the last transition since the last frame, and of what
        self._grown: tuple[NavState, Growth, FramePosterior, ErrorState, FloatArray] | None = None
        self._twist: tuple[NavState, Growth, Twist] | None = None  # the last one, and of what
        # too
        self._camera: (
            tuple[NavState, Growth, float, tuple[FloatArray, FloatArray, FloatArray]] | None
        ) = None

    def unknown_noise(self) -> MotionNoise:
        """The motion model's noise where nothing was learned of it."""
        if self.source == "imu":
            return MotionNoise(*IMU_FACTORS)
        return MotionNoise(*_TWIST_FACTORS)

    def begin(self, window: Window, time_ns: int, body_ns: int) -> None:
        """Go on from a window without clones, at the times of a frame and of the navigation
        state.
        """
        self.forget()
        self.time_ns = time_ns
        self.body_ns = body_ns
        self.posterior = self.reported = FramePosterior.begun(window)

    def forget(self) -> None:
        """Forget the last frame and the steps since."""
        self.gyro = None
        self.blind = False
        self.since_frame = NO_STEP
        self._coming = None

    @property
    def is_lost(self) -> bool:
        """Whether no feature and no sensor has related poses to each other for so long that the
        rotation is lost.
        """
        of_rotation = self.since_frame.Q[3:6, 3:6]
        return (
            self.blind
            and self.source is None
            and bool(np.linalg.eigvalsh(of_rotation)[-1] > _LINEAR_RAD**2)
        )

    def end_step(self) -> None:
        """Let the next step begin at the present frame."""
        self.since_frame = NO_STEP

    def step_errors(
        self, window: Window, predicted: FloatArray, expected: FloatArray, remaining: FloatArray
    ) -> StepErrors:
        """Return the errors of the step since the last frame, after a fit.

        It is the camera's motion, seen from the body, so that a new estimate of the extrinsics is
        no motion.

        Args:
            window: after the fit.
            predicted: (4, 4) motion of the camera.
            expected: covariance (6, 6) of that, world's side.
            remaining: the same of the fitted motion.
        """
        moved = window.camera_move_since(-2)
        A = se3_adjoint(se3_inverse(window.nav.T_world_imu))
        process = A @ self.since_frame.Q[:6, :6] @ A.T
        B = se3_adjoint(se3_inverse(window.calibration.T_cam0_imu))
        correction = B @ se3_log(se3_inverse(predicted) @ moved)
        return StepErrors(correction, A @ expected @ A.T, process, A @ remaining @ A.T)

    def take(self, sample: MotionSample) -> None:
        """Take a motion sample, which may change what the next step looks like."""
        self.motion.take(sample)
        self._coming = None

    def take_imu(self, samples: Sequence[ImuSample]) -> None:
        """Take samples of an IMU at once, see `take`."""
        assert isinstance(self.motion, ImuMotion)
        self.motion.take_all(samples)
        self._coming = None

    def advance(self, window: Window, time_ns: int) -> None:
        """Carry the navigation state on to a frame or sample."""
        body_ns = self.body_time(window, time_ns)
        if body_ns > self.body_ns:
            coming = self.coming(window, body_ns)
            step = coming.step
            self.motion.forget_before(body_ns)
            walk = window.calibration.variances(self.walk) * ((body_ns - self.body_ns) * 1e-9)
            window.propagate(step, walk)
            self.since_frame = coming.growth
            self.gyro = step.gyro
            self.body_ns = body_ns
        self._coming = None
        self.time_ns = time_ns

    def coming(self, window: Window, body_ns: int) -> _Coming:
        """The motion model's step from the present state; what `predict` has integrated is not
        integrated again.
        """
        if self._coming is None or self._coming.body_ns != body_ns:
            step = self.motion.advance(window.nav, self.body_ns, body_ns, self.noise.factors)
            self._coming = _Coming(body_ns, step, self.since_frame.then(step))
        return self._coming

    def body_time(self, window: Window, time_ns: int) -> int:
        """The time on the IMU's clock to which the navigation state is carried for a frame."""
        if "time_offset" not in window.state.blocks or not isinstance(self.motion, ImuMotion):
            return time_ns
        return self.motion.covered(time_ns + round(1e9 * window.calibration.time_offset_s))

    def measure(self, window: Window) -> None:
        """Absorb the velocity that was just taken, if any."""
        measurement = self.motion.measurement(window.nav)
        if measurement is None:
            return
        if self.blind:
            window.measure(measurement)
        else:  # the frame's fit will move the means, and better
            window.absorb_measurement(measurement)

    def predict(self, window: Window, time_ns: int) -> tuple[FloatArray, MotionPrior] | None:
        """Predict the camera's pose (4, 4) `T_cam0_world` at a coming frame and its motion.

        None: not well enough.
        """
        nav = window.nav
        growth = self.since_frame
        body_ns = self.body_time(window, time_ns)
        if body_ns > self.body_ns:
            try:
                coming = self.coming(window, body_ns)
            except EstimationError:  # the update will say it
                return None
            nav = coming.step.nav
            growth = coming.growth
        T_cam0_imu = window.calibration.T_cam0_imu
        late_s = (body_ns - time_ns) * 1e-9
        (T_world_imu, *_), expected = self.exposure(window, nav, growth, late_s)
        T_cam0_world = T_cam0_imu @ se3_inverse(T_world_imu)
        T_curr_prev = T_cam0_world @ window.clones.T_world_imu[-1] @ se3_inverse(T_cam0_imu)
        # T_curr_prev = exp(A (xi_prev - xi_curr)) T_hat with A = Ad(T_cam0_world)
        A = se3_adjoint(T_cam0_world)
        measured = self.source is not None and not growth.bridged
        motion = MotionPrior(T_curr_prev, A @ expected @ A.T, measured)
        of_rotation = motion.covariance[3:, 3:]  # no eigenvalue is larger than its trace
        if (
            of_rotation.trace() > _TILT.useless_rad**2
            and np.linalg.eigvalsh(of_rotation)[-1] > _TILT.useless_rad**2
        ):
            return None
        return T_cam0_world, motion

    def exposure(
        self, window: Window, nav: NavState, growth: Growth, late_s: float
    ) -> tuple[tuple[FloatArray, FloatArray, FloatArray], FloatArray]:
        """Predict the camera at a frame; what `predict` has asked for, `update` finds.

        Args:
            window: the window.
            nav: the navigation state at the frame.
            growth: since the last frame.
            late_s: the navigation state's time on the IMU's clock minus the frame's stamp.

        Returns:
            What `Window.camera_D_own` returns, and the covariance (6, 6) of `xi_curr - xi_prev`, of
            the camera, where the errors have grown since the last frame.
        """
        last = self._camera
        twist = self.twist(window, nav, growth)
        if last is None or last[0] is not nav or last[1] is not growth or last[2] != late_s:
            T, J = window.camera_at(late_s, twist, nav)
            if not window.calibration.moves_camera and "imu_terms" not in window.state.blocks:
                M = growth.Phi[:6] - _POSE
                P = self.posterior.own[:DIM, :DIM]
                moved = M @ P @ M.T + growth.Q[:6, :6]
            else:
                M = np.concatenate([J @ self.grown(window, nav, growth), -_I6], axis=1)
                J_step = J[:, :DIM]
                moved = M @ self.posterior.with_newest @ M.T + J_step @ growth.Q @ J_step.T
            last = self._camera = nav, growth, late_s, (T, J, moved)
        T, J, moved = last[3]
        noise = window.exposure_noise(T, late_s, twist)
        return (T, J, noise), moved + noise

    def grown(self, window: Window, nav: NavState, growth: Growth) -> FloatArray:
        """Transition (15 + C, 15 + C) of the errors of navigation state and calibration since
        the last frame.
        """
        known = self._grown
        if (
            known is None
            or known[0] is not nav
            or known[1] is not growth
            or known[2] is not self.posterior
            or known[3] is not window.state
        ):
            T_before = self.posterior.T_world_imu
            out = window.calibration.transition(window.state, growth, nav.T_world_imu, T_before)
            known = self._grown = nav, growth, self.posterior, window.state, out
        return known[4]

    def twist(self, window: Window, nav: NavState, growth: Growth) -> Twist:
        """The body's twist, and how well it is known; equation (C3)."""
        if not isinstance(self.motion, ImuMotion) or "time_offset" not in window.state.blocks:
            return NO_TWIST
        if self._twist is not None and self._twist[0] is nav and self._twist[1] is growth:
            return self._twist[2]
        R = nav.T_world_imu[:3, :3]
        own = window.state.motion
        rate_D_error = self.motion.rate_D_error(nav)
        if own.stop == DIM:
            Phi = growth.Phi
        else:
            Phi = self.grown(window, nav, growth)[own, own]
        P = Phi @ self.posterior.own[own, own] @ Phi.T
        P[:DIM, :DIM] += growth.Q
        covariance = np.zeros((6, 6))
        # v = exp(phi) v_hat + xi_v, seen from the body turned by phi
        covariance[:3, :3] = R.T @ P[6:9, 6:9] @ R
        by_gyro = _I3 * self.motion.rate_variance(self.noise.factors)
        covariance[3:, 3:] = rate_D_error @ P @ rate_D_error.T + by_gyro
        twist = Twist(body_twist(nav.T_world_imu, nav.velocity, nav.rate), covariance)
        self._twist = nav, growth, twist
        return twist

    @property
    def late_s(self) -> float:
        """The navigation state's time on the IMU's clock minus the last frame's stamp."""
        return (self.body_ns - self.time_ns) * 1e-9

    def own_covariance(self, window: Window) -> FloatArray:
        """Covariance (15 + C, 15 + C) of navigation state and calibration at the time of the last
        event, reported.

        It is upright: errors against the world that gravity shows at present.
        """
        if not self.blind:
            return self.reported.own
        grow = self.grown(window, window.nav, self.since_frame)
        out: FloatArray = grow @ self.reported.own @ grow.T
        out[:DIM, :DIM] += self.since_frame.Q
        return out

    def exposed(self, window: Window, own: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Upright pose (4, 4) of the body at the newest exposure, and the covariance (6, 6) of the
        reported one.

        Args:
            window: the window.
            own: `own_covariance`.
        """
        if "time_offset" not in window.state.blocks:
            J = window.since_first(window.state.own_identity[:6])
            return window.nav.T_world_imu, J @ own @ J.T
        if not self.blind:
            with_newest = self.reported.with_newest
            J = np.eye(6, len(with_newest), len(own))  # of the camera, and back to the body
            newest_D_error = window.body_D_error()[-6:]
            J[:, : len(own)] += window.since_first(newest_D_error)[:, : len(own)]
            return window.clones.T_world_imu[-1], J @ with_newest @ J.T
        T, J, noise = window.camera_D_own(
            self.late_s, self.twist(window, window.nav, self.since_frame)
        )
        if "extrinsics" in window.state.blocks:
            J[:, window.state.blocks["extrinsics"]] = 0.0  # of the body
        J = window.since_first(J)
        return T, J @ own @ J.T + noise


def first_imu_noise(P: FloatArray) -> MotionNoise:
    """The IMU's noise at a start whose navigation state has the covariance P (15, 15)."""
    tilt_sigma = float(np.sqrt(P[3:5, 3:5].diagonal().max()))
    start = min(IMU_FACTORS[0] + _TILT.factor_per_tilt_sigma * tilt_sigma, _TILT.max_start_factor)
    return MotionNoise(start, *IMU_FACTORS[1:])
