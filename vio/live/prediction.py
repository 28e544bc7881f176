"""Poses between and after frames, at the rate of the IMU, without touching the filter."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vio.errors import DataError
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, se3_log, so3_exp
from vio.numerics.kinds import Capacity
from vio.records import (
    NS_PER_S,
    S_PER_NS,
    Estimate,
    ImuSample,
    MotionSample,
    VelocitySample,
    imu_matrices,
)


class _PredictionRules(NamedTuple):
    """How far a pose is carried on."""

    kept_ns: int = 2_000_000_000  # samples that a late estimate can be carried over
    max_step_s: float = 0.5  # a motion is held no longer than this beyond the last sample or frame
    max_states: Capacity[int] = (
        10_000  # after the newest estimate: beyond, older ones are forgotten
    )


_PREDICTION = _PredictionRules()
_ZERO: FloatArray = np.zeros(3)


@dataclass(frozen=True, slots=True)
class PredictedPose:
    """A pose by propagation alone."""

    time_ns: int
    T_world_imu: FloatArray  # (4, 4)
    velocity_world: FloatArray  # (3,) m/s


@dataclass(frozen=True, slots=True)
class _State:
    """Pose and velocity at a time, and the motion that is held from there on."""

    time_ns: int
    R: FloatArray  # (3, 3)
    p: FloatArray  # (3,)
    v: FloatArray  # (3,) world frame
    gyro: FloatArray  # (3,) body frame, without bias
    accel: FloatArray  # (3,) world frame, without gravity and bias


def _time_ns(state: _State) -> int:
    return state.time_ns


class PosePredictor:
    """Carries the newest estimate over the motion samples after it, on the camera's clock: samples
    are moved by the offset of the clocks where the filter estimates it.

    IMU: strapdown integration with the estimated biases. Velocities and images alone: the rate and
    velocity are held. One thread may predict while another adds: states are only appended, and
    replaced as a whole.
    """

    def __init__(self, gravity_mps2: float) -> None:
        self._gravity = np.array([0.0, 0.0, -gravity_mps2])
        self._samples: deque[MotionSample] = deque()
        self._bias: tuple[FloatArray, FloatArray] = (_ZERO, _ZERO)
        # accelerometer and gyro, equation (A1)
        self._matrices: tuple[FloatArray, FloatArray] | None = None
        self._offset_ns = 0  # of the sensor's clock from the camera's, as estimated
        self._last: Estimate | None = None
        self._states: list[_State] = []  # at the newest estimate and at the samples after it
        self._past: list[_State] = []  # at the estimates and samples of the last seconds before it

    def sample(self, sample: MotionSample) -> None:
        """Take a motion sample."""
        self._samples.append(sample)
        while sample.time_ns - self._samples[0].time_ns > _PREDICTION.kept_ns:
            self._samples.popleft()
        states = self._states
        if states and sample.time_ns - self._offset_ns > states[-1].time_ns:
            states.append(self._carried(states[-1], sample))
            if len(states) > _PREDICTION.max_states:
                self._states = [states[0], *states[-_PREDICTION.max_states // 2 :]]

    def estimate(self, estimate: Estimate) -> None:
        """Take a new estimate, and carry it over the samples that have come since."""
        gyro_bias = _ZERO if estimate.gyro_bias is None else estimate.gyro_bias
        accel_bias = _ZERO if estimate.accel_bias is None else estimate.accel_bias
        self._bias = gyro_bias, accel_bias
        if estimate.imu_terms is None:
            self._matrices = None
        else:
            self._matrices = imu_matrices(estimate.imu_terms)
        if estimate.gravity_world is not None:
            self._gravity = estimate.gravity_world
        if estimate.time_offset_s is not None:
            self._offset_ns = round(NS_PER_S * estimate.time_offset_s)
        omega, v = self._motion_of(estimate)
        state = _State(
            estimate.time_ns,
            estimate.T_world_imu[:3, :3],
            estimate.T_world_imu[:3, 3],
            v,
            omega,
            _ZERO,
        )
        states = [self._with_sample(state)]
        for sample in self._samples:
            if sample.time_ns - self._offset_ns > estimate.time_ns:
                states.append(self._carried(states[-1], sample))
        known = [*self._past, *self._states]
        first = bisect_left(known, estimate.time_ns - _PREDICTION.kept_ns, key=_time_ns)
        self._past = known[first : bisect_left(known, estimate.time_ns, key=_time_ns)]
        self._last = estimate
        self._states = states

    def predict(self, time_ns: int) -> PredictedPose:
        """Return the pose at a time; one of the last seconds is as it was known then.

        Raises:
            DataError: there is no estimate yet, or the time is seconds before the newest.
        """
        states = self._states
        if not states:
            raise DataError("no pose can be predicted before the first estimate")
        if time_ns < states[0].time_ns:
            newest_ns = states[0].time_ns
            states = self._past
            if not states or time_ns < states[0].time_ns:
                raise DataError(
                    f"{time_ns} ns is too long before the newest estimate at {newest_ns} ns; take "
                    "that one"
                )
        state = next(state for state in reversed(states) if state.time_ns <= time_ns)
        R, p, v = _moved(state, min((time_ns - state.time_ns) * S_PER_NS, _PREDICTION.max_step_s))
        return PredictedPose(time_ns, se3_from_parts(R, p), v)

    def _with_sample(self, state: _State) -> _State:
        """The state of an estimate with the motion of the newest sample up to it.

        Where the sensor is silent, or is not used any more, the motion stays that of the estimates.
        """
        until_ns = state.time_ns + self._offset_ns
        before = [sample for sample in self._samples if sample.time_ns <= until_ns]
        longest_ns = round(_PREDICTION.max_step_s * NS_PER_S)
        if not before or until_ns - before[-1].time_ns > longest_ns:
            return state
        return self._held(state, before[-1])

    def _motion_of(self, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
        """Body rate (3,) rad/s and world velocity (3,) m/s at an estimate, from the last two
        where it has none.
        """
        last = self._last
        omega = _ZERO
        v = _ZERO
        if last is not None and estimate.time_ns > last.time_ns:
            dt = (estimate.time_ns - last.time_ns) * S_PER_NS
            omega = se3_log(se3_inverse(last.T_world_imu) @ estimate.T_world_imu)[3:] / dt
            v = (estimate.T_world_imu[:3, 3] - last.T_world_imu[:3, 3]) / dt
        return omega, v if estimate.velocity_world is None else estimate.velocity_world

    def _held(self, state: _State, sample: MotionSample) -> _State:
        """The state with the motion of a sample, which holds from there on."""
        if isinstance(sample, VelocitySample):
            return _State(
                state.time_ns, state.R, state.p, state.R @ sample.linear, sample.angular, _ZERO
            )
        gyro, accel = self._unbiased(sample)
        return _State(
            state.time_ns, state.R, state.p, state.v, gyro, state.R @ accel + self._gravity
        )

    def _unbiased(self, sample: ImuSample) -> tuple[FloatArray, FloatArray]:
        """Rate and specific force (3,) of a sample without biases, and without scale and
        misalignment if estimated.
        """
        gyro = sample.gyro
        accel = sample.accel
        if self._matrices is not None:
            M_accel, M_gyro = self._matrices
            gyro = M_gyro @ gyro
            accel = M_accel @ accel
        return gyro - self._bias[0], accel - self._bias[1]

    def _carried(self, state: _State, sample: MotionSample) -> _State:
        """The state at a later sample; with an IMU by the mean of its readings at both ends."""
        time_ns = sample.time_ns - self._offset_ns
        dt = (time_ns - state.time_ns) * S_PER_NS
        if isinstance(sample, VelocitySample):
            R, p, v = _moved(state, dt)
            return self._held(_State(time_ns, R, p, v, state.gyro, state.accel), sample)
        gyro, accel = self._unbiased(sample)
        R = state.R @ so3_exp(0.5 * (state.gyro + gyro) * dt)
        force = R @ accel + self._gravity
        a = 0.5 * (state.accel + force)
        return _State(
            time_ns,
            R,
            state.p + state.v * dt + 0.5 * a * dt**2,
            state.v + a * dt,
            gyro,
            force,
        )


def _moved(state: _State, dt: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    R = state.R @ so3_exp(state.gyro * dt)
    p = state.p + state.v * dt + 0.5 * state.accel * dt**2
    v = state.v + state.accel * dt
    return R, p, v


class SharedPredictor:
    """A `PosePredictor` to which adding takes microseconds: what is added is integrated by who
    asks, or later.
    """

    def __init__(self, gravity_mps2: float) -> None:
        self._predictor = PosePredictor(gravity_mps2)
        self._added: deque[MotionSample | Estimate] = deque()
        self._lock = threading.Lock()

    def add(self, event: MotionSample | Estimate) -> None:
        """Take a motion sample or an estimate; samples come in order of time, and so do
        estimates.
        """
        self._added.append(event)

    def catch_up(self) -> None:
        """Integrate what was added, unless another thread is at it."""
        if self._lock.acquire(blocking=False):
            try:
                self._integrate()
            finally:
                self._lock.release()

    def predict(self, time_ns: int) -> PredictedPose:
        """Return the pose at a time, see `PosePredictor.predict`."""
        with self._lock:
            self._integrate()
            return self._predictor.predict(time_ns)

    def _integrate(self) -> None:
        while self._added:
            event = self._added.popleft()
            if isinstance(event, Estimate):
                self._predictor.estimate(event)
            else:
                self._predictor.sample(event)
