"""Motion models of the paper's filter: the input held from frame to frame, and a twist that drifts.

The state is `U = T_imu_world` with error xi in `U = exp(xi) U_hat`, and, where the model keeps one,
the body twist `u = [v; omega]` with an additive error. Equation numbers are those of docs/math.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vio.errors import EstimationError
from vio.filters.settings import VislamSettings
from vio.geometry.lie import FloatArray, se3_adjoint, se3_exp, se3_left_jacobian
from vio.records import VelocitySample

_START_VELOCITY_SIGMA_MPS = 10.0  # initial standard deviation of the linear velocity
_START_RATE_SIGMA_RADPS = 1.0  # the same of the angular rate


@dataclass(frozen=True, slots=True)
class PoseState:
    """What the motion model carries."""

    U: FloatArray  # (4, 4) T_imu_world
    # (6,) body velocity and rate, m/s and rad/s; None: not part of the state
    twist: FloatArray | None
    Sigma: FloatArray  # (6, 6) of xi, or (12, 12) of [xi; twist error]

    def corrected(self, correction: FloatArray, Sigma: FloatArray) -> PoseState:
        """Return the state moved by a correction (6,) or (12,), with a new covariance."""
        if self.twist is None:
            twist = None
        else:
            twist = self.twist + correction[6:]
        return PoseState(se3_exp(correction[:6]) @ self.U, twist, Sigma)


def predict(
    U: FloatArray, Sigma: FloatArray, u: FloatArray, tau_s: float, W: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Carry the pose over one time step, equations (P1) and (P2).

    Args:
        U: `T_imu_world` (4, 4).
        Sigma: covariance (6, 6) of xi in `U = exp(xi) U_hat`.
        u: body velocity and angular rate (6,), m/s and rad/s.
        tau_s: time step, seconds.
        W: noise covariance (6, 6) added over the step.
    """
    step = se3_exp(-tau_s * u)
    F = se3_adjoint(step)  # exp(-tau curly_hat(u))
    return step @ U, F @ Sigma @ F.T + W


def predict_twist(
    U: FloatArray, u: FloatArray, Sigma: FloatArray, tau_s: float, density: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Carry pose and twist over one time step of constant twist, equations (P10) and (P11).

    Args:
        U: `T_imu_world` (4, 4).
        u: body twist (6,), m/s and rad/s.
        Sigma: covariance (12, 12) of [xi; twist error].
        tau_s: time step, seconds.
        density: spectral density (6,) of the white acceleration, (m/s^2)^2/Hz and (rad/s^2)^2/Hz.
    """
    step = se3_exp(-tau_s * u)
    F = np.eye(12)
    F[:6, :6] = se3_adjoint(step)
    F[:6, 6:] = -tau_s * se3_left_jacobian(-tau_s * u)
    Q = np.diag(density)
    W = np.block(
        [
            [Q * tau_s**3 / 3, -Q * tau_s**2 / 2],
            [-Q * tau_s**2 / 2, Q * tau_s],
        ]
    )
    return step @ U, F @ Sigma @ F.T + W


class HeldInput:
    """The paper's model: each measured velocity is the input of the step, and W what it may be
    wrong by.
    """

    measures_at_once = False

    def __init__(self, settings: VislamSettings) -> None:
        self._settings = settings
        self._samples: list[VelocitySample] = []

    def start(self, U: FloatArray) -> PoseState:
        """Return the state at the first frame: the world is where the body is."""
        return PoseState(U, None, np.zeros((6, 6)))

    def take(self, state: PoseState, sample: VelocitySample) -> PoseState:
        """Keep a sample until the frame that needs it."""
        self._samples.append(sample)
        return state

    def predict(self, state: PoseState, start_ns: int, end_ns: int) -> PoseState:
        """Carry the state from one frame to the next.

        Raises:
            EstimationError: there is no sample.
        """
        U = state.U
        Sigma = state.Sigma
        for u, part_s in self._inputs_between(start_ns, end_ns):
            W = self._noise(part_s, part_s / ((end_ns - start_ns) * 1e-9))
            U, Sigma = predict(U, Sigma, u, part_s, W)
        return replace(state, U=U, Sigma=Sigma)

    def _inputs_between(self, start_ns: int, end_ns: int) -> list[tuple[FloatArray, float]]:
        """Split an interval at the samples within it: pairs of input (6,) and duration in
        seconds.
        """
        samples = self._samples
        if not samples:
            raise EstimationError(
                "no velocity sample before the second frame; use --motion none or check the clocks"
            )
        times = [s.time_ns for s in samples]
        inputs = np.array([np.concatenate([s.linear, s.angular]) for s in samples])
        cuts = [start_ns, *(t for t in times if start_ns < t < end_ns), end_ns]
        # Linear interpolation at the cuts, held constant outside the samples.
        at_cuts = np.stack([np.interp(cuts, times, column) for column in inputs.T], axis=1)
        past = int(np.searchsorted(times, end_ns, side="right"))
        self._samples = samples[max(past - 1, 0) :]
        first, second = {"midpoint": (0.5, 0.5), "start": (1.0, 0.0), "end": (0.0, 1.0)}[
            self._settings.input_at
        ]
        return [
            (first * at_cuts[k] + second * at_cuts[k + 1], (cuts[k + 1] - cuts[k]) * 1e-9)
            for k in range(len(cuts) - 1)
        ]

    def _noise(self, part_s: float, share_of_step: float) -> FloatArray:
        """W (6, 6) of a part of the step from one frame to the next."""
        s = self._settings
        sigmas = np.repeat([s.linear_velocity_sigma_mps, s.angular_rate_sigma_radps], 3)
        # The paper states standard deviations and adds them as variances once per frame, whatever
        # the step.
        return np.diag(sigmas * share_of_step if s.noise == "literal" else (sigmas * part_s) ** 2)


class DriftingTwist:
    """The body twist is a state that drifts with white acceleration; velocity samples, if any,
    measure it.

    With velocities as noisy as the paper's, 5 cm and 0.3 deg a step, the step before says as much
    of the next one as the sensor does; the two are weighed here instead of discarding one. Without
    velocities nothing else changes.
    Reference: Barfoot, Tong & Särkkä, Batch continuous-time trajectory estimation (2014), the
    white-noise-on- acceleration prior, here causal.
    """

    measures_at_once = True

    def __init__(self, settings: VislamSettings) -> None:
        s = settings
        self._density = np.repeat([s.acceleration_density, s.angular_acceleration_density], 3) ** 2
        self._sensor = np.diag(
            np.repeat([s.linear_velocity_sigma_mps, s.angular_rate_sigma_radps], 3) ** 2
        )
        self._start = np.repeat([_START_VELOCITY_SIGMA_MPS, _START_RATE_SIGMA_RADPS], 3) ** 2

    def start(self, U: FloatArray) -> PoseState:
        """Return the state at the first frame: the world is where the body is, its twist
        unknown.
        """
        return PoseState(U, np.zeros(6), np.diag(np.concatenate([np.zeros(6), self._start])))

    def take(self, state: PoseState, sample: VelocitySample) -> PoseState:
        """Update the twist with a sample of the state's time; a plain Kalman update, as the
        sensor is linear.
        """
        assert state.twist is not None
        Sigma = state.Sigma
        K = np.linalg.solve(Sigma[6:, 6:] + self._sensor, Sigma[6:]).T
        IKH = np.eye(12)
        IKH[:, 6:] -= K
        residual = np.concatenate([sample.linear, sample.angular]) - state.twist
        return state.corrected(K @ residual, IKH @ Sigma @ IKH.T + K @ self._sensor @ K.T)

    def with_inflated_covariance(self, state: PoseState, tau_s: float) -> PoseState:
        """Return the state with the last step's twist at least as uncertain as at the start."""
        start = np.diag(np.maximum(self._start - np.diag(state.Sigma)[6:], 0.0))
        inflation = np.block(
            [
                [start * tau_s**2, -start * tau_s],
                [-start * tau_s, start],
            ]
        )
        return replace(state, Sigma=state.Sigma + inflation)

    def predict(self, state: PoseState, start_ns: int, end_ns: int) -> PoseState:
        """Carry the state over the time between two events."""
        assert state.twist is not None
        tau_s = (end_ns - start_ns) * 1e-9
        U, Sigma = predict_twist(state.U, state.twist, state.Sigma, tau_s, self._density)
        return replace(state, U=U, Sigma=Sigma)
