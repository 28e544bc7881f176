"""How an IMU was sampled: each rule just inside its limit and just outside."""

from __future__ import annotations

import numpy as np
import pytest

from vio.geometry.lie import FloatArray
from vio.imu.faults import ImuSampleCheck
from vio.imu.sampling import burst_length, repeated_readings, sampling_notes
from vio.monitor.samples import Samples
from vio.records import ImuRecord, ImuSample, IntArray


def _runs(lengths: list[int]) -> FloatArray:
    """Readings (N, 6), each so often in a row; the first and the last run count for nothing."""
    each = np.arange(len(lengths) + 2, dtype=np.float64)
    return np.repeat(each, [1, *lengths, 1])[:, None] * np.ones(6)


@pytest.mark.parametrize(("alike", "repeats"), [(75, 0), (85, 4)])
def test_most_readings_of_a_driver_that_repeats_are_repeated_as_often(
    alike: int, repeats: int
) -> None:
    assert repeated_readings(_runs([4] * alike + [1] * (100 - alike))) == repeats


@pytest.mark.parametrize(("runs", "repeats"), [(19, 0), (20, 4)])
def test_few_readings_show_no_repetition(runs: int, repeats: int) -> None:
    assert repeated_readings(_runs([4] * runs)) == repeats


@pytest.mark.parametrize(("length", "repeats"), [(2, 0), (3, 3)])
def test_readings_that_are_given_twice_are_two_equal_ones(length: int, repeats: int) -> None:
    assert repeated_readings(_runs([length] * 100)) == repeats


def _bursts(short: list[float], count: int = 100) -> IntArray:
    """Stamps in bursts, by the steps inside one over the mean step."""
    pause = len(short) + 1 - sum(short)
    steps = np.tile([*short, pause], count)
    return np.cumsum(np.append(0.0, steps) * 5e6).astype(np.int64)


@pytest.mark.parametrize(("step", "length"), [(0.16, 3), (0.24, 0)])
def test_steps_inside_a_burst_are_far_shorter_than_the_mean(step: float, length: int) -> None:
    assert burst_length(_bursts([step] * 2)) == length


@pytest.mark.parametrize(("some", "length"), [(0.3, 9), (0.5, 0)])
def test_most_of_the_time_passes_between_bursts(some: float, length: int) -> None:
    assert burst_length(_bursts([0.1] * 5 + [some] * 3)) == length


@pytest.mark.parametrize(("count", "length"), [(19, 0), (20, 3)])
def test_few_pauses_show_no_bursts(count: int, length: int) -> None:
    assert burst_length(_bursts([0.1] * 2, count)) == length


@pytest.mark.parametrize(("rate_hz", "notes"), [(45, 1), (55, 0)])
def test_an_imu_below_fifty_hertz_is_too_slow(rate_hz: int, notes: int) -> None:
    values = np.random.default_rng(0).normal(0, 1, (200, 6))
    times_ns = np.arange(200) * (10**9 // rate_hz)
    record = ImuRecord(times_ns, values[:, :3], values[:, 3:])
    assert len(sampling_notes(record, "imu.csv")) == notes


@pytest.mark.parametrize(
    ("step_ms", "gap_ms", "found"),
    [(5, 95, False), (5, 105, True), (20, 150, False), (20, 170, True)],
)
def test_a_gap_is_long_and_far_longer_than_a_step(step_ms: int, gap_ms: int, found: bool) -> None:
    times_ms = np.arange(100) * step_ms
    times_ms[50:] += gap_ms - step_ms
    noise = np.random.default_rng(0).normal(0, 1, (100, 6))
    samples = Samples()
    samples.add(
        [ImuSample(int(t) * 1_000_000, v[:3], v[3:]) for t, v in zip(times_ms, noise, strict=True)]
    )
    assert [f.fault for f in samples.check_new(keep=True)] == ["IMU gap"] * found


def _kept(gyro: FloatArray, step_ns: int = 5_000_000) -> tuple[list[ImuSample], list[str]]:
    """The samples that pass, and the faults that are found, of a gyro (N,) about x."""
    noise = np.random.default_rng(1).normal(0, 0.01, (len(gyro), 6))
    samples = [
        ImuSample(k * step_ns, v[:3] + np.array([g, 0, 0]), v[3:] + np.array([0, 0, 9.81]))
        for k, (g, v) in enumerate(zip(gyro, noise, strict=True))
    ]
    check = ImuSampleCheck()
    passed = check.take_all(samples)
    return passed, [fault.kind for fault in check.new_faults()]


@pytest.mark.parametrize(("before", "found"), [(15, False), (25, True)])
def test_a_spike_needs_a_history(before: int, found: bool) -> None:
    gyro = np.zeros(60)
    gyro[before] = 5.0
    assert (_kept(gyro)[1] == ["gyro spike"]) == found


@pytest.mark.parametrize(("sigmas", "found"), [(0.7, False), (1.4, True)])
def test_a_spike_is_far_beyond_the_changes_of_motion(sigmas: float, found: bool) -> None:
    """Robust standard deviations of the changes, over thirty."""
    gyro = np.zeros(200)
    gyro[100] = sigmas * 30 * 0.01 * np.sqrt(2)
    assert (_kept(gyro, 40_000_000)[1] == ["gyro spike"]) == found


@pytest.mark.parametrize(("left", "found"), [(0.2, True), (0.3, False)])
def test_a_shock_does_not_come_back_at_once(left: float, found: bool) -> None:
    gyro = np.zeros(200)
    gyro[100] = 1.5
    gyro[101:] = 1.5 * left
    assert (_kept(gyro)[1] == ["gyro spike"]) == found
