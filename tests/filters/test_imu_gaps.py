"""Samples that are late, lost, or have not come: asynchronous frames, gaps, an IMU that begins
late or ends early.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU, Flight
from vio.evaluation.consistency import nees, nees_bounds
from vio.filters.imu_gaps import ImuHistory
from vio.filters.msckf import Msckf
from vio.filters.navigation import ImuMotion, NavState
from vio.filters.settings import MsckfSettings
from vio.findings import Finding
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, se3_log
from vio.imu.settings import DEFAULT_IMU, ImuSettings
from vio.live.processor import Due, EventOrder
from vio.monitor.run import RunMonitor
from vio.records import Event, ImuSample, StereoFrame, UpdateReport, VelocitySample

QUIET = MsckfSettings()
FLIGHT = Flight(frames=200)
PHASES = (0.1, 0.5, 0.9)


def _sample(time_ns: int) -> ImuSample:
    return ImuSample(time_ns, np.zeros(3), np.array([0.0, 0.0, 9.81]))


def _frame(index: int, time_ns: int) -> StereoFrame:
    return StereoFrame(index, time_ns, None, None)


def _order(events: list[Event]) -> list[int]:
    """Times of samples and, negative, numbers of frames."""
    return [-e.index if isinstance(e, StereoFrame) else e.time_ns for e in _ordered(events)]


def _ordered(events: list[Event]) -> list[Event]:
    order = EventOrder(wait_for_imu=True)
    return [e for event in events for e in _listed(order.add(event))] + _listed(order.flush())


def _listed(due: Iterable[Due]) -> list[Event]:
    return [e for step in due for e in (*step.samples, step.frame) if e is not None]


def test_a_frame_waits_for_the_sample_after_it() -> None:
    assert _order(
        [_sample(10), _frame(1, 15), _sample(20), _sample(30), _frame(2, 35), _sample(40)]
    ) == [*(10, 20, -1, 30, 40, -2)]


def test_a_frame_waits_for_the_sample_after_its_exposure_by_the_estimated_offset() -> None:
    order = EventOrder(wait_for_imu=True)
    order.exposed_after_ns = 12
    assert [e.time_ns for k in (10, 20, 30) for e in _listed(order.add(_sample(k)))] == []
    assert [e.time_ns for e in _listed(order.add(_frame(1, 15)))] == [10, 20, 30, 15]
    assert list(order.add(_frame(2, 19))) == []
    assert [e.time_ns for e in _listed(order.add(_sample(40)))] == [40, 19]


def test_a_frame_waits_until_one_a_tenth_of_a_second_newer_has_come() -> None:
    ms = 1_000_000
    early = [_frame(1, 5 * ms), _frame(2, 55 * ms), _frame(3, 104 * ms)]
    assert _order([*early, _sample(110 * ms)]) == [110 * ms, -1, -2, -3], (
        "the sample may still come"
    )
    assert _order([*early, _frame(4, 105 * ms), _sample(110 * ms)]) == [-1, 110 * ms, -2, -3, -4]


def test_samples_at_once_are_released_as_one_by_one() -> None:
    samples = [_sample(k) for k in (10, 20, 30, 40, 50)]
    together = EventOrder(wait_for_imu=True)
    together.exposed_after_ns = 12
    held = [*together.add(_frame(1, 15)), *together.add(_frame(2, 33))]
    assert held == []
    found = _listed(together.add_samples(samples)) + _listed(together.flush())
    alone = EventOrder(wait_for_imu=True)
    alone.exposed_after_ns = 12
    events = [_frame(1, 15), _frame(2, 33), *samples]
    expected = [e for event in events for e in _listed(alone.add(event))] + _listed(alone.flush())
    times = [10, 20, 30, 15, 40, 50, 33]
    assert [e.time_ns for e in found] == [e.time_ns for e in expected] == times


def test_a_frame_waits_no_longer_than_to_the_end() -> None:
    assert _order([_sample(1), _frame(1, 5), _frame(2, 15)]) == [1, -1, -2]


def test_a_frame_with_a_sample_at_its_own_time_does_not_wait() -> None:
    order = EventOrder(wait_for_imu=True)
    assert list(order.add(_sample(10))) == []
    due = _listed(order.add(_frame(1, 10)))
    assert [type(event) for event in due] == [ImuSample, StereoFrame]


def test_without_an_imu_a_frame_passes_at_once() -> None:
    order = EventOrder(wait_for_imu=False)
    velocities = [VelocitySample(k, np.zeros(3), np.zeros(3)) for k in (10, 15, 20)]
    assert [list(order.add(velocity)) for velocity in velocities] == [[], [], []]
    assert _listed(order.add(frame := _frame(1, 15))) == [*velocities[:2], frame]
    assert _listed(order.flush()) == velocities[2:]


@given(st.integers(-90, 90))
def test_the_order_does_not_depend_on_the_arrival(late_ms: int) -> None:
    """Frames and IMU samples arrive on two streams, one behind the other by up to the longest
    wait.
    """
    ms = 1_000_000
    samples: list[Event] = [_sample(5 * ms * k) for k in range(60)]
    frames: list[Event] = [_frame(k + 1, ms * (33 * k + 7)) for k in range(8)]
    arrival = {
        id(e): e.time_ns + (late_ms * ms if isinstance(e, StereoFrame) else 0)
        for e in [*samples, *frames]
    }
    mixed = sorted([*samples, *frames], key=lambda e: arrival[id(e)])
    assert _order(mixed) == _order(sorted([*samples, *frames], key=lambda e: e.time_ns))


# The step in units of its noise


def _brisk(t: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """The flight five times as fast: R, p, v, a, omega, with angular accelerations of 8 rad/s^2."""
    R, p, v, a, omega = FLIGHT.state(5 * t)
    return R, p, 5 * v, 25 * a, 5 * omega


@cache
def _step_errors() -> dict[tuple[float, bool], list[float]]:
    """Squared errors of rotation, velocity and position (9 numbers) by their Q, of steps that end
    between samples.

    100 Hz, white noise as in the data sheet; a frame lies `phase` of a period after a sample, and
    the sample after it has come or not. The samples before are the same for all phases.
    """
    rate, out = 100.0, dict[tuple[float, bool], list[float]]()
    for start_s, seed in product((2.2, 3.1, 4.7, 6.3), range(20)):
        motion, rng = ImuMotion(QUIET), np.random.default_rng(seed)
        last = round(start_s * rate) + 5
        for k in range(last - 205, last + 2):
            if k == last + 1:
                _step(motion, last, False, out)
            R, _, _, a, omega = _brisk(k / rate)
            gyro = omega + rng.normal(0, DEFAULT_IMU.gyro_noise_density * np.sqrt(rate), 3)
            accel = R.T @ (a + np.array([0, 0, 9.81])) + rng.normal(
                0, DEFAULT_IMU.accel_noise_density * np.sqrt(rate), 3
            )
            motion.take(ImuSample(k * 10_000_000, gyro, accel))
        _step(motion, last, True, out)
    return out


def _step(
    fed: ImuMotion, last: int, wait: bool, out: dict[tuple[float, bool], list[float]]
) -> None:
    """Add the squared errors of the steps from five samples before the last one to each phase
    after it.
    """
    R, p, v, *_ = _brisk(t0 := (last - 5) / 100.0)
    nav = NavState(se3_from_parts(R, p), v, *np.zeros((3, 3)))
    for phase in PHASES:
        step = deepcopy(fed).advance(
            nav, round(t0 * 1e9), round((t1 := (last + phase) / 100.0) * 1e9)
        )
        R, p, v, *_ = _brisk(t1)
        xi = se3_log(se3_from_parts(R, p) @ se3_inverse(step.nav.T_world_imu))
        error = np.concatenate([xi, v - step.nav.velocity])
        whitened = np.linalg.solve(np.linalg.cholesky(step.Q[:9, :9] + 1e-18 * np.eye(9)), error)
        out.setdefault((phase, wait), []).append(float(whitened @ whitened))


@pytest.mark.parametrize("wait", [True, False])
@pytest.mark.parametrize("phase", PHASES)
def test_a_step_that_ends_between_two_samples_is_as_good_as_its_noise(
    phase: float, wait: bool
) -> None:
    """Interpolated, or held with the noise grown: the squared error stays below the 95 % bound
    of its Q.
    """
    values = _step_errors()[phase, wait]
    assert np.mean(values) < 9 * 1.25, np.mean(values)  # without, 15 and 40 at the later two phases


# Gaps


def _without(first_s: float, length_s: float) -> type[Flight]:
    """A flight whose IMU is silent for a while."""

    class Gappy(Flight):
        def imu(self, noise: np.random.Generator, bias: FloatArray) -> list[ImuSample]:
            samples = super().imu(noise, bias)
            return [x for x in samples if not first_s < x.time_ns * 1e-9 < first_s + length_s]

    return Gappy


@pytest.mark.parametrize("length_s", [0.1, 0.4, 1.0, 3.0])
def test_images_carry_a_gap_while_turning_and_accelerating(length_s: float) -> None:
    """Errors stay those of images, and the NEES of the motion since before the gap stays within
    its bound.
    """
    # A mount known to 1 cm, seen for two seconds, adds 6 mm, and a stereo field that is not known
    # yet as much.
    settings = MsckfSettings(
        calibrate_camera_imu="none",
        calibrate_stereo="off",
        stereo_baseline_sigma=0.0,
        stereo_focal_sigma=0.0,
    )
    seeds, first = 5, 40
    errors, covariances = [], []
    frames = first + 10 + round(20 * length_s)
    for seed in range(seeds):
        e, C, _ = _without(0.05 * first + 0.012, length_s)(frames).run(settings, "imu", seed)
        errors.append(e)
        covariances.append(C)
    e, C = np.array(errors), np.array(covariances)
    # the start's error, before the gap, is not its doing
    since = e[:, first:, :3] - e[:, first - 1 : first, :3]
    assert np.linalg.norm(since, axis=-1).max() < 0.05
    values = np.array([nees(e[s, first:], C[s, first:]) for s in range(seeds)]).mean(axis=0)
    assert np.mean(values < nees_bounds(6, seeds)[1]) >= 0.9, values


def test_a_clean_imu_is_integrated_as_ever() -> None:
    """No sample is missing: nothing is cut, and nothing is added to the noise."""
    motion = ImuMotion(QUIET)
    for k in range(100):
        motion.take(_sample(5_000_000 * k + (k % 3) * 500_000))  # a jittering clock
    zero = np.zeros(3)
    step = motion.advance(NavState(np.eye(4), zero, zero, zero, zero), 100_000_000, 150_000_000)
    assert not step.bridged
    np.testing.assert_allclose(
        np.diag(step.Q)[3:6], DEFAULT_IMU.gyro_noise_density**2 * 0.05, rtol=1e-9
    )


def test_a_gap_hides_what_a_brownian_bridge_hides_and_a_hold_what_brownian_motion_does() -> None:
    """Signals that are random walks of known diffusion: q T^3 / 12 between samples, q T^3 / 3
    after the last.
    """
    rng, q, T = np.random.default_rng(1), 4.0, 0.08
    imu = ImuSettings(gyro_noise_density=1e-9, accel_noise_density=1e-9)
    zero = np.zeros(3)
    ratios = []
    for _ in range(30):
        motion = ImuMotion(QUIET, imu)
        walk = np.cumsum(rng.normal(0, np.sqrt(q * 0.005), (400, 3)), axis=0)
        for k in [*range(384), 399]:
            motion.take(ImuSample(5_000_000 * k, zero, walk[k]))
        held = round(1.995e9 + 1e9 * T)
        found = []
        for a, b in ((1_915_000_000, 1_995_000_000), (1_995_000_000, held)):
            step = motion.advance(NavState(np.eye(4), zero, zero, zero, zero), a, b)
            assert step.bridged
            found.append(step.Q[6, 6])
        ratios.append(np.array(found) / [q * T**3 / 12, q * T**3 / 3])
    mean = np.mean(ratios, axis=0)  # of the worst of three axes, so somewhat above one
    assert np.all((mean > 1.0) & (mean < 1.6)), mean


def test_a_gap_longer_than_the_memory_hides_what_the_signal_did_before_it() -> None:
    """After three seconds of silence come ten quiet samples: what was learned before is not
    forgotten for them.
    """
    rng, found = np.random.default_rng(2), []
    loud, quiet = rng.normal(0, 0.5, (400, 2, 3)), rng.normal(0, 1e-3, (10, 2, 3))
    for silence in (100, 600):  # periods of 5 ms
        motion, zero = ImuMotion(QUIET), np.zeros(3)
        for k in range(400):
            motion.take(ImuSample(5_000_000 * k, *loud[k]))
        for k in range(10):
            motion.take(ImuSample(5_000_000 * (399 + silence + k), *quiet[k]))
        state = NavState(np.eye(4), zero, zero, zero, zero)
        end = 5_000_000 * (399 + silence)
        step = motion.advance(state, 1_995_000_000, end)
        # white noise: the mean rate is off by as much
        found.append(np.sqrt(step.Q[3, 3]) / (5e-3 * silence))
    assert 0.5 < found[1] / found[0] < 2.0


# What the run says


def _lines(times_s: list[float], frames_s: list[float]) -> list[str]:
    return [finding.message for finding in _findings(times_s, frames_s)]


def _findings(times_s: list[float], frames_s: list[float]) -> list[Finding]:
    monitor = RunMonitor(CAMERA, T_CAM0_IMU, imu=True)
    flight, rng = Flight(), np.random.default_rng(0)
    events: list[Event] = [_sample(round(1e9 * t)) for t in times_s]
    events += [_frame(k, round(1e9 * t)) for k, t in enumerate(frames_s)]
    for event in _ordered(sorted(events, key=lambda e: e.time_ns)):
        if isinstance(event, StereoFrame):
            monitor.observations(
                replace(flight.observe(0, 0.5, rng), frame_index=event.index, time_ns=event.time_ns)
            )
        else:
            monitor.samples([event])
    monitor.close()
    return [f for f in monitor.findings if f.message.startswith(("frame", "no IMU"))]


FRAMES_S = [0.05 * k for k in range(100)]


def _imu_s(*silences: tuple[float, float]) -> list[float]:
    times = np.arange(-100, 1020) * 0.005
    return [float(t) for t in times if not any(a < t < b for a, b in silences)]


def test_a_clean_imu_is_not_talked_of() -> None:
    assert _lines(_imu_s(), FRAMES_S) == []


@pytest.mark.parametrize("length_s", [0.12, 0.4, 1.0, 3.0])
def test_every_gap_is_told_once_with_its_length(length_s: float) -> None:
    lines = _lines(_imu_s((1.0, 1.0 + length_s), (4.2, 4.4)), FRAMES_S)
    first, second = (line for line in lines if "no IMU sample for" in line)
    assert f"no IMU sample for {length_s:.2f} s from 1000000000 ns; carried by images" in first
    assert "no IMU sample for 0.20 s from 4200000000 ns" in second


def test_a_gap_is_found_while_it_lasts_and_holds_from_its_first_frame_to_its_last() -> None:
    begun, ended = _findings(_imu_s((1.0, 3.0)), FRAMES_S)
    assert begun.frame == 23  # 0.1 s is no gap
    assert begun.first_frame == 21
    assert begun.lasts
    assert ended.ended
    assert ended.frame is not None
    assert 57 <= ended.frame <= 60


def test_an_imu_that_ends_early_is_told() -> None:
    begun, last = _findings(_imu_s((3.0, 99.0)), FRAMES_S)
    assert begun.frame == 63
    assert begun.first_frame == 61
    assert begun.lasts
    assert last.message == (
        "frame 99: no IMU sample for 1.95 s from 3000000000 ns to the end of the run; carried by "
        "images"
    )


def test_an_imu_that_begins_late_or_never_is_told() -> None:
    begun, ended = _findings(_imu_s((-1.0, 2.02)), FRAMES_S)
    assert begun.message.startswith("frame 3: no IMU sample yet, 0.15 s after frame 0")
    assert begun.first_frame == 0
    assert begun.lasts
    assert ended.ended
    assert ended.message.startswith(
        "frame 39: the first IMU sample came 2.02 s after frame 0; until then 39 frames were "
        "carried by"
    )
    begun, last = _findings([], FRAMES_S)
    assert begun.lasts
    assert last.message == "no IMU sample in any of 100 frames: all were carried by images alone"


def test_frames_wait_for_an_imu_that_begins_late() -> None:
    """Sixty frames pass without a pose, and without an error."""
    settings, flight = MsckfSettings(), Flight(100)
    filt = Msckf(CAMERA, T_CAM0_IMU, settings, motion="imu")
    rng = np.random.default_rng(0)
    reports = [filt.update(flight.observe(k, 0.5, rng)) for k in range(60)]
    assert reports == [UpdateReport(0, 0, 0, 0, None, None)] * 60
    assert filt.estimate().time_ns == 59 * STEP_NS
    for sample in flight.imu(rng, np.zeros(6)):
        if 59 * STEP_NS < sample.time_ns <= 60 * STEP_NS:
            filt.propagate(sample)
    filt.update(flight.observe(60, 0.5, rng))
    # a filter that has started, on a held sample
    assert filt.update(flight.observe(61, 0.5, rng)).used > 30


@pytest.mark.parametrize(("motion", "useful"), [(None, False), ("imu", True)])
def test_a_prediction_over_seconds_is_made_by_an_imu_alone(
    motion: str | None, useful: bool
) -> None:
    """Images alone know nothing of a turn after three seconds, so no track is searched where
    they put it.
    """
    flight = Flight(8)
    _, _, filt = flight.run(MsckfSettings(), motion, limit=30)
    assert filt.predict(8 * STEP_NS) is not None
    if motion == "imu":
        for sample in Flight(80).imu(np.random.default_rng(1), np.zeros(6)):
            if sample.time_ns > 7 * STEP_NS:
                filt.propagate(sample)
    assert (filt.predict(7 * STEP_NS + 3_000_000_000) is not None) is useful


@pytest.mark.parametrize(("rate_hz", "slow"), [(5, True), (20, True), (50, False), (200, False)])
def test_a_slow_imu_hides_motion_between_its_samples(rate_hz: int, slow: bool) -> None:
    """Straight lines between samples 0.2 s apart are bridges; nothing is missing, so no gap."""
    history = ImuHistory()
    rng = np.random.default_rng(0)
    times_ns = np.arange(0, 2_000_000_000, 1_000_000_000 // rate_hz)
    samples = [ImuSample(int(t), *rng.normal(0, 1, (2, 3))) for t in times_ns]
    history.take(samples)
    cuts_ns = np.array([times_ns[-3], times_ns[-2]], dtype=np.float64)
    hidden = history.hidden(cuts_ns, times_ns.astype(np.float64))
    assert (hidden is not None) == slow
    if hidden is not None:
        assert not hidden.gap
        assert (hidden.variance.sum(axis=1) > 0).all()
