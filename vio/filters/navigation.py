"""Motion models of the sliding-window filter: raw IMU, or a body twist that drifts.

Both carry a navigation state with a 15-dimensional error whose first six entries are the pose's
`[rho; phi]`, right-invariant: `T_world_imu = exp(xi) T_hat`. The rest is
`[xi_v; gyro bias; accel bias]` for the IMU, with `v = exp(phi) v_hat + xi_v`, and
`[twist; gyro bias]` for the twist. Equation numbers are those of docs/math.md.
References: Barrau & Bonnabel, The invariant extended Kalman filter as a stable observer (2017);
Hartley et al., Contact-aided invariant extended Kalman filtering for robot state estimation (2020).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.errors import EstimationError
from vio.filters import pose_loops as loops
from vio.filters.imu_gaps import Hidden, ImuHistory
from vio.filters.imu_start import imu_start
from vio.filters.imu_terms import (
    ENTRIES,
    IMU_TERMS,
    calibrated,
    chosen_terms,
    significant,
    tilt_columns,
    usual_reading,
)
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import (
    FloatArray,
    se3_adjoint,
    se3_exp,
    se3_from_parts,
    se3_left_jacobian,
    so3_hat,
)
from vio.geometry.upright import rotation_to_up
from vio.imu.faults import ImuSampleCheck, readings_of
from vio.imu.settings import DEFAULT_IMU, ImuSettings
from vio.numerics.compiled import move_by_twist
from vio.records import ImuSample, MotionSample, VelocitySample, imu_matrices

DIM = 15  # error dimensions of the navigation state
UNSCALED: FloatArray = np.ones(2)  # factors on the noise: translation, rotation


class _SampleRules(NamedTuple):
    """What stands for samples that have not come."""

    # by which samples may end before an exposure and its pose is still taken from its twist
    extrapolated_ns: int = 30_000_000
    usual_interval_s: float = 0.005  # between two samples of a usual IMU, where only one has come


_SAMPLES = _SampleRules()
_NO_TERMS: FloatArray = np.zeros(IMU_TERMS)
START_VELOCITY_SIGMA_MPS = 10.0  # initial standard deviation of the velocity
ZERO_VELOCITY_SIGMA_MPS = 0.02  # standard deviation of the velocity in a zero-velocity measurement
ZERO_RATE_SIGMA_RADPS = 0.01  # the same of the angular rate
RATE_BIAS_SIGMA_RADPS = 0.02  # initial standard deviation of the bias of a measured angular rate


class _RatePriors(NamedTuple):
    """What is known of the angular rate without an IMU."""

    bias_walk: float = 1.0e-4  # random walk of that bias, rad/s/sqrt(s)
    start_sigma_radps: float = 1.0  # initial standard deviation of the angular rate without an IMU


_RATE = _RatePriors()


@dataclass(frozen=True, slots=True)
class NavState:
    """Where the body is and how it moves."""

    T_world_imu: FloatArray  # (4, 4)
    velocity: FloatArray  # (3,) IMU model: world frame; twist model: body frame; m/s
    # (3,) body frame, rad/s; IMU model: what the gyro reads now less its bias, no state of its own
    rate: FloatArray
    gyro_bias: FloatArray  # (3,) rad/s
    accel_bias: FloatArray  # (3,) m/s^2; twist model: unused, zero
    # (15,) scale and misalignment, equation (A1)
    imu_terms: FloatArray = field(default_factory=lambda: _NO_TERMS)


@dataclass(frozen=True, slots=True)
class MotionUncertainty:
    """How well velocity and biases are known."""

    velocity_covariance: FloatArray  # (3, 3) world, (m/s)^2
    gyro_bias_sigma: FloatArray  # (3,) rad/s
    accel_bias_sigma: FloatArray  # (3,) m/s^2; zero where it is not estimated


@dataclass(frozen=True, slots=True)
class Transition:
    """One step of a motion model."""

    nav: NavState
    Phi: FloatArray  # (15, 15)
    Q: FloatArray  # (15, 15)
    # (2, 15, 15) of Q, what the translation's and what the rotation's noise brought
    Q_parts: FloatArray
    # (3,) mean rate that the gyro measured over the step, rad/s; None: it did not
    gyro: FloatArray | None = None
    # whether IMU samples were missing, so that Q says nothing of the sensors' noise
    bridged: bool = False
    Phi_imu: FloatArray | None = None  # (15, I) by the IMU's terms; None: they are known


@dataclass(frozen=True, slots=True)
class Growth:
    """How the navigation state's error has grown over some steps."""

    Phi: FloatArray  # (15, 15)
    Q: FloatArray  # (15, 15)
    Q_parts: FloatArray  # (2, 15, 15) as in Transition
    bridged: bool = False  # in one of the steps
    Phi_imu: FloatArray | None = None  # (15, I) as in Transition

    def then(self, step: Transition) -> Growth:
        """Append a step."""
        if self is NO_STEP:
            return Growth(step.Phi, step.Q, step.Q_parts, step.bridged, step.Phi_imu)
        Phi = step.Phi
        Q = Phi @ self.Q @ Phi.T + step.Q
        Q_parts = Phi @ self.Q_parts @ Phi.T + step.Q_parts
        Phi_imu = step.Phi_imu
        if Phi_imu is not None and self.Phi_imu is not None:
            Phi_imu = Phi @ self.Phi_imu + Phi_imu
        return Growth(Phi @ self.Phi, Q, Q_parts, self.bridged or step.bridged, Phi_imu)


_I3 = np.eye(3)
_NO_COLUMNS = loops.TermColumns(np.zeros((0, 6)), ENTRIES[:0], np.zeros((DIM, 0)))
NO_STEP = Growth(np.eye(DIM), np.zeros((DIM, DIM)), np.zeros((2, DIM, DIM)))


@dataclass(frozen=True, slots=True)
class Measurement:
    """A linear measurement of the errors of navigation state and IMU terms: residual = H error +
    noise.
    """

    H: FloatArray  # (k, 15 + I)
    residual: FloatArray  # (k,)
    R: FloatArray  # (k, k)
    # whether it is a velocity in m/s; standstill is standstill whatever the scale
    metric: bool = False


class ImuMotion:
    """Gyro and accelerometer, gravity, two biases that walk."""

    biases = slice(9, DIM)  # rows of the navigation error

    def __init__(self, settings: MsckfSettings, imu: ImuSettings = DEFAULT_IMU) -> None:
        self._imu = imu
        self._chosen = chosen_terms(settings)  # the IMU's terms that are estimated
        self._entries = ENTRIES[self._chosen]
        # (6,) mean reading `[gyro, accel]` of the last second; kept where terms are estimated.
        self._usual: FloatArray | None = None
        self._gravity = np.array([0.0, 0.0, -imu.gravity_mps2])
        self._walks = np.array([imu.gyro_bias_walk, imu.accel_bias_walk])
        self._new: list[ImuSample] = []  # not checked yet
        self._kept: list[ImuSample] = []
        self._history = ImuHistory()
        self._check = ImuSampleCheck()

    def take(self, sample: MotionSample) -> None:
        """Keep a sample until the interval that needs it; leave out faulty ones."""
        assert isinstance(sample, ImuSample)
        self._new.append(sample)

    def take_all(self, samples: Sequence[ImuSample]) -> None:
        """Keep samples, see `take`."""
        self._new += samples

    @property
    def samples(self) -> Sequence[ImuSample]:
        """The samples that are kept, in order of time; new ones are checked here, all since the
        last use at once.
        """
        if self._new:
            usable = self._check.take_all(self._new)
            self._check.new_faults()  # which the monitor reports, are not kept
            self._new = []
            self._kept += usable
            self._history.take(usable)
        return self._kept

    @property
    def ready(self) -> bool:
        """Whether there is a sample to start with."""
        return bool(self.samples)

    def start(self, time_ns: int) -> tuple[NavState, FloatArray]:
        """Return the state at the first frame and its covariance (15, 15), from the last half
        second of samples.

        Roll and pitch from the mean specific force, whose acceleration has the standard deviation
        that the readings suggest; a gyro bias where they show a standstill (`imu_start`). Tilt and
        accelerometer bias are correlated, as either explains the same reading: equation (N10).
        Position and yaw are the world's; the velocity is unknown.

        Raises:
            EstimationError: the accelerometer reads nothing.
        """
        s = self._imu
        begin = imu_start(self.samples, time_ns, s)
        R = rotation_to_up(begin.force / np.linalg.norm(begin.force))
        T = se3_from_parts(R, np.zeros(3))
        nav = NavState(T, np.zeros(3), begin.rate - begin.gyro_bias, begin.gyro_bias, np.zeros(3))
        known = s.accel_bias_sigma_mps2 / s.gravity_mps2  # tilt that the first second leaves, rad
        sigmas = np.concatenate(
            [
                np.zeros(5),
                [
                    _yaw_sigma(
                        np.hypot(begin.accel_sigma_mps2, s.accel_bias_sigma_mps2) / s.gravity_mps2,
                        known,
                    )
                ],
                np.full(3, START_VELOCITY_SIGMA_MPS),
                np.full(3, begin.gyro_bias_sigma_radps),
                np.full(3, s.accel_bias_sigma_mps2),
            ]
        )
        P = np.diag(sigmas**2)
        # g^ phi = R db_a + acceleration, solved for phi
        tilt_D_accel = -so3_hat(self._gravity) / s.gravity_mps2**2
        tilt_D_bias = tilt_D_accel @ R
        P[3:6, 12:15] = tilt_D_bias * s.accel_bias_sigma_mps2**2
        P[12:15, 3:6] = P[3:6, 12:15].T
        P[3:6, 3:6] += (
            tilt_D_accel @ tilt_D_accel.T * (begin.accel_sigma_mps2**2 + s.accel_bias_sigma_mps2**2)
        )
        return nav, P

    def start_covariance(self) -> FloatArray:
        """Covariance (15, 15) of velocity and biases of which nothing is known; that of the pose
        is zero.
        """
        s = self._imu
        sigmas = [
            0.0,
            0.0,
            START_VELOCITY_SIGMA_MPS,
            s.gyro_bias_sigma_radps,
            s.accel_bias_sigma_mps2,
        ]
        return np.diag(np.repeat(sigmas, 3) ** 2)

    def advance(
        self, nav: NavState, start_ns: int, end_ns: int, factors: FloatArray = UNSCALED
    ) -> Transition:
        """Integrate from one time to another, equations (N1) to (N4); factors (2,) scale
        accelerometer and gyro noise.

        Where samples are missing, it interpolates, or holds the last one, and adds what that may
        hide to the noise: equations (N11) and (N12).

        Raises:
            EstimationError: there is no sample at all.
        """
        times, raw, hidden = self._interval(start_ns, end_ns)
        s = self._imu
        steps = len(times) - 1
        densities = factors * [s.accel_noise_density, s.gyro_noise_density]
        variance = np.zeros((2, steps)) if hidden is None else hidden.variance
        T = nav.T_world_imu.copy()
        v = nav.velocity.copy()
        turned = np.zeros(3)
        total = float(times[-1]) * 1e-9
        Phi = NO_STEP.Phi.copy()
        Q_parts = np.zeros((2, DIM, DIM))
        Q = np.empty((DIM, DIM))
        bias = np.concatenate([nav.gyro_bias, nav.accel_bias])
        noise = loops.ImuNoise(densities, self._walks, variance)
        step = loops.ImuStep(T, v, turned, Phi, Q_parts, Q)
        readings = raw
        terms = _NO_COLUMNS
        Phi_imu = None
        if len(self._chosen):
            readings = calibrated(raw, nav.imu_terms)
            if self._usual is None:
                levers = raw
            else:
                levers = significant(raw, self._usual, total, densities)
            Phi_imu = np.zeros((DIM, len(self._chosen)))
            terms = loops.TermColumns(levers, self._entries, Phi_imu)
        loops.integrate(times, readings, bias, self._gravity, noise, terms, step)
        moved = NavState(
            T, v, readings[-1, :3] - nav.gyro_bias, nav.gyro_bias, nav.accel_bias, nav.imu_terms
        )
        if hidden is not None and hidden.gap:
            return Transition(moved, Phi, Q, Q_parts, bridged=True, Phi_imu=Phi_imu)
        return Transition(
            moved, Phi, Q, Q_parts, turned / max(total, 1e-9) + nav.gyro_bias, Phi_imu=Phi_imu
        )

    def tilt_D_terms(self, nav: NavState) -> FloatArray:
        """How errors of the IMU's terms move the attitude's error (3, I) of a state that `start`
        has returned: (A4).
        """
        return tilt_columns(nav.T_world_imu, self._gravity)[:, self._chosen]

    def rate_D_error(self, nav: NavState) -> FloatArray:
        """Jacobian (3, 15 + I) of the present rate by the errors of navigation state and IMU
        terms.
        """
        out = np.zeros((3, DIM + len(self._chosen)))
        out[:, 9:12] = -_I3
        if len(self._chosen):
            out[:, DIM:] = self._rate_D_terms(nav, nav.rate + nav.gyro_bias)
        return out

    def _rate_D_terms(self, nav: NavState, rate: FloatArray) -> FloatArray:
        """How a calibrated rate (3,), with its bias, moves with the estimated terms (3, I): (A2)."""
        out = np.empty((3, len(self._entries)))
        loops.write_terms_of_rate(imu_matrices(nav.imu_terms)[1], rate, self._entries, out)
        return out

    def forget_before(self, time_ns: int) -> None:
        """Drop the samples that no interval from this time on needs."""
        samples = self.samples
        keep = 0
        for sample in samples[1:]:
            if sample.time_ns > time_ns:
                break
            keep += 1
        if keep and len(self._chosen):
            seconds = (samples[keep].time_ns - samples[0].time_ns) * 1e-9
            self._usual = usual_reading(self._usual, readings_of(samples[:keep]), seconds)
        self._kept = self._kept[keep:]

    def measurement(self, nav: NavState) -> Measurement | None:
        """The IMU drives the state and measures nothing."""
        return None

    def zero_velocity(self, nav: NavState, gyro: FloatArray | None) -> Measurement | None:
        """Rest as a measurement, equation (N7): no velocity, and the gyro, calibrated, reads its
        bias.

        None where the gyro contradicts.
        """
        if gyro is None:
            return None
        s = self._imu
        turn = gyro - nav.gyro_bias
        if np.abs(turn).max() > 3 * (ZERO_RATE_SIGMA_RADPS + s.gyro_bias_sigma_radps):
            return None
        H = np.zeros((6, DIM + len(self._chosen)))
        H[:3, 3:6] = -so3_hat(nav.velocity)
        H[:3, 6:9] = np.eye(3)
        H[3:, 9:12] = np.eye(3)
        if len(self._chosen):
            H[3:, DIM:] = -self._rate_D_terms(nav, gyro)
        sigmas = np.repeat([ZERO_VELOCITY_SIGMA_MPS, ZERO_RATE_SIGMA_RADPS], 3)
        return Measurement(H, np.concatenate([-nav.velocity, turn]), np.diag(sigmas**2))

    def velocity_world(self, nav: NavState) -> FloatArray:
        """Velocity (3,) in the world frame."""
        return nav.velocity

    def uncertainty(self, nav: NavState, P: FloatArray) -> MotionUncertainty:
        """Return the uncertainty of velocity and biases, from the covariance (15, 15) of the
        error.
        """
        # v = exp(phi) v_hat + xi_v
        velocity_D_error = np.concatenate([-so3_hat(nav.velocity), _I3], axis=1)
        sigmas = np.sqrt(P.diagonal()[9:15])
        return MotionUncertainty(
            velocity_D_error @ P[3:9, 3:9] @ velocity_D_error.T, sigmas[:3], sigmas[3:]
        )

    def corrected(self, nav: NavState, error: FloatArray) -> NavState:
        """Return the state moved by an error (15 + I,)."""
        T = nav.T_world_imu.copy()
        v = nav.velocity.copy()
        move_by_twist(error[:6], T)
        loops.move_points(error[3:6], error[None, 6:9], v[None])
        rate = nav.rate - error[9:12]
        terms = nav.imu_terms
        if len(self._chosen):
            by_terms = error[DIM : DIM + len(self._chosen)]
            # exact, as the rate is linear in the terms
            rate = rate + self._rate_D_terms(nav, nav.rate + nav.gyro_bias) @ by_terms
            terms = terms.copy()
            terms[self._chosen] += by_terms
        return NavState(
            T, v, rate, nav.gyro_bias + error[9:12], nav.accel_bias + error[12:15], terms
        )

    def corrected_earlier(
        self, velocities: FloatArray, R_world_imu: FloatArray, ages_s: FloatArray, error: FloatArray
    ) -> FloatArray:
        """Return velocities as a present error moves them: (N2) back, with the accelerometer's bias
        and terms.

        Args:
            velocities: (N, 3) of the past, world, the present one last.
            R_world_imu: (N, 3, 3) mean attitudes from then to now.
            ages_s: (N,) seconds from then to now.
            error: (15 + I,) of the present state.
        """
        out: FloatArray = velocities.copy()
        loops.move_earlier_velocities(
            self._gravity, ages_s, np.ascontiguousarray(R_world_imu), error, self._entries, out
        )
        return out

    def rate_variance(self, factors: FloatArray) -> float:
        """Variance (rad/s)^2 of the rate that the gyro reads in one sample; factors (2,) as in
        `advance`.
        """
        # new samples come into the history here
        period_ns = self._history.period_ns() if self.samples else 0.0
        period_s = period_ns * 1e-9 if period_ns > 0 else _SAMPLES.usual_interval_s
        return float((factors[1] * self._imu.gyro_noise_density) ** 2 / period_s)

    def covered(self, time_ns: int) -> int:
        """The latest time, up to a given one, that the samples reach; the given one where they
        end long before.
        """
        latest = self.samples[-1].time_ns
        return time_ns if time_ns - latest > _SAMPLES.extrapolated_ns else min(time_ns, latest)

    def _interval(self, start_ns: int, end_ns: int) -> tuple[FloatArray, FloatArray, Hidden | None]:
        """Times relative to the start (K,) in ns, readings `[gyro, accel]` (K, 6), and what gaps
        hide.

        Values are interpolated between samples and held beyond the first and the last; None: no
        sample is missing.
        """
        samples = self.samples
        if not samples:
            raise EstimationError(
                f"no IMU sample before {end_ns} ns; check that IMU and camera share a clock"
            )
        t = np.array([float(x.time_ns - start_ns) for x in samples])
        end = float(end_ns - start_ns)
        cuts = np.concatenate([[0.0], t[(t > 0) & (t < end)], [end]])
        hidden = self._history.hidden(cuts, t)
        if hidden is not None:
            cuts = hidden.cuts_ns
        readings = np.empty((len(cuts), 6))
        loops.interpolate(cuts, t, readings_of(samples), readings)
        return cuts, readings, hidden


class TwistMotion:
    """The body twist is a state that drifts with white acceleration; velocity samples, if any,
    measure it.

    This is `vio.filters.vislam_motion.DriftingTwist` with the error on the world side and a bias of
    the angular rate.
    """

    biases = slice(12, DIM)  # that of the measured rate

    def __init__(self, settings: MsckfSettings) -> None:
        s = self._settings = settings
        self._density = np.repeat([s.acceleration_density, s.angular_acceleration_density], 3) ** 2
        self._pending: VelocitySample | None = None

    @property
    def ready(self) -> bool:
        """Whether enough is known to start: always."""
        return True

    def take(self, sample: MotionSample) -> None:
        """Keep a sample for the measurement that follows."""
        assert isinstance(sample, VelocitySample)
        self._pending = sample

    def start(self, time_ns: int) -> tuple[NavState, FloatArray]:
        """Return the state at the first frame and its covariance (15, 15): the world is where
        the body is.
        """
        zero = np.zeros(3)
        return NavState(np.eye(4), zero, zero, zero, zero), self.start_covariance()

    def start_covariance(self) -> FloatArray:
        """Covariance (15, 15) of twist and rate bias of which nothing is known; that of the pose
        is zero.
        """
        sigmas = [
            0.0,
            0.0,
            START_VELOCITY_SIGMA_MPS,
            _RATE.start_sigma_radps,
            RATE_BIAS_SIGMA_RADPS,
        ]
        return np.diag(np.repeat(sigmas, 3) ** 2)

    def advance(
        self, nav: NavState, start_ns: int, end_ns: int, factors: FloatArray = UNSCALED
    ) -> Transition:
        """Carry pose and twist over a time, equations (N5) and (N6); factors (2,) scale linear
        and angular noise.
        """
        tau = (end_ns - start_ns) * 1e-9
        u = np.concatenate([nav.velocity, nav.rate])
        T = nav.T_world_imu
        moved = T @ se3_exp(tau * u)
        # T exp(tau (u + du)) = exp(tau Ad(T) J_l(tau u) du) T exp(tau u)
        xi_D_twist = tau * se3_adjoint(T) @ se3_left_jacobian(tau * u)
        Phi = np.eye(DIM)
        Phi[:6, 6:12] = xi_D_twist
        Q_parts = np.zeros((2, DIM, DIM))
        for k, part in enumerate(Q_parts):
            density = np.zeros(6)
            density[3 * k : 3 * k + 3] = self._density[3 * k : 3 * k + 3] * factors[k] ** 2
            D = np.diag(density)
            part[:6, :6] = xi_D_twist @ D @ xi_D_twist.T * (tau / 3)
            part[:6, 6:12] = xi_D_twist @ D * (tau / 2)
            part[6:12, :6] = part[:6, 6:12].T
            part[6:12, 6:12] = D * tau
        Q = Q_parts.sum(axis=0)
        Q[12:, 12:] = np.eye(3) * (_RATE.bias_walk**2 * tau)
        return Transition(replace(nav, T_world_imu=moved), Phi, Q, Q_parts)

    def forget_before(self, time_ns: int) -> None:
        """Nothing is kept beyond the sample that is measured next."""

    def measurement(self, nav: NavState) -> Measurement | None:
        """The velocity sample that has just been taken, if any."""
        sample = self._pending
        self._pending = None
        if sample is None:
            return None
        s = self._settings
        H = np.zeros((6, DIM))
        H[:, 6:12] = np.eye(6)
        H[3:, 12:15] = np.eye(3)
        residual = np.concatenate(
            [sample.linear - nav.velocity, sample.angular - nav.rate - nav.gyro_bias]
        )
        sigmas = np.repeat([s.linear_velocity_sigma_mps, s.angular_rate_sigma_radps], 3)
        return Measurement(H, residual, np.diag(sigmas**2), metric=True)

    def zero_velocity(self, nav: NavState, gyro: FloatArray | None) -> Measurement:
        """Rest as a measurement: no twist."""
        H = np.zeros((6, DIM))
        H[:, 6:12] = np.eye(6)
        sigmas = np.repeat([ZERO_VELOCITY_SIGMA_MPS, ZERO_RATE_SIGMA_RADPS], 3)
        return Measurement(H, -np.concatenate([nav.velocity, nav.rate]), np.diag(sigmas**2))

    def velocity_world(self, nav: NavState) -> FloatArray:
        """Velocity (3,) in the world frame."""
        out: FloatArray = nav.T_world_imu[:3, :3] @ nav.velocity
        return out

    def uncertainty(self, nav: NavState, P: FloatArray) -> MotionUncertainty:
        """Return the uncertainty of velocity and biases, from the covariance (15, 15) of the
        error.
        """
        R = nav.T_world_imu[:3, :3]  # v_world = exp(phi) R (v_hat + delta)
        velocity_D_error = np.concatenate([-so3_hat(R @ nav.velocity), R], axis=1)
        velocity_P: FloatArray = velocity_D_error @ P[3:9, 3:9] @ velocity_D_error.T
        return MotionUncertainty(velocity_P, np.sqrt(np.diag(P)[12:15]), np.zeros(3))

    def corrected(self, nav: NavState, error: FloatArray) -> NavState:
        """Return the state moved by an error (15,)."""
        return NavState(
            se3_exp(error[:6]) @ nav.T_world_imu,
            nav.velocity + error[6:9],
            nav.rate + error[9:12],
            nav.gyro_bias + error[12:15],
            nav.accel_bias,
        )


def _yaw_sigma(tilt_sigma: float, known_sigma: float) -> float:
    """What corrections of the first tilt leave of yaw, rad: two turns about level axes make a turn
    about the vertical.

    The filter takes out the second order, (N13), for as long as the first frame is in its window;
    the third vanishes about the vertical, and of the fourth `x^4 / 24` remains (Baker, Campbell &
    Hausdorff). Later corrections are of the size of the tilt that is known by then, and their
    second order `x^2 / 2` stays.
    """
    return float(np.hypot(tilt_sigma**4 / 24, known_sigma**2 / 2))
