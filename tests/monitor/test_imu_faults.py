"""IMU samples that are spikes or repeat to the last bit: left out, named, and without effect on
the poses.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, T_CAM0_IMU, Flight
from vio.filters.navigation import ImuMotion
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import FloatArray
from vio.imu.clocks import SampleCoverage
from vio.imu.faults import ImuSampleCheck
from vio.imu.sampling import sampling_notes
from vio.live.processor import EventOrder
from vio.monitor.imu_faults import ImuFaultReport
from vio.monitor.run import RunMonitor
from vio.monitor.samples import Samples
from vio.records import Event, ImuRecord, ImuSample, IntArray, StereoFrame

FRAMES = 60
AXES = np.eye(3)
# number, sample, the last one before 1.5 s
Change = Callable[[int, ImuSample, ImuSample], ImuSample]


class Faulty(Flight):
    """A flight whose IMU is at fault."""

    def __init__(self, change: Change) -> None:
        super().__init__(FRAMES)
        self.change = change

    def imu(self, noise: np.random.Generator, bias: FloatArray) -> list[ImuSample]:
        samples = super().imu(noise, bias)
        return [self.change(k, x, samples[300]) for k, x in enumerate(samples)]


@lru_cache(maxsize=1)
def _clean() -> float:
    return _rms(Flight(FRAMES))


def _rms(flight: Flight) -> float:
    errors, _, _ = flight.run(MsckfSettings(), "imu", limit=30)
    return float(np.sqrt(np.mean(errors[:, :3] ** 2) * 3))


def _one_gyro_spike(k: int, x: ImuSample, _: ImuSample) -> ImuSample:
    return replace(x, gyro=x.gyro + 30.0 * AXES[1]) if k == 355 else x


def _two_per_mille(k: int, x: ImuSample, _: ImuSample) -> ImuSample:
    return (
        replace(x, gyro=x.gyro - 30.0 * AXES[2], accel=x.accel + 100.0 * AXES[1])
        if k % 187 == 110
        else x
    )


def _zeros(k: int, x: ImuSample, _: ImuSample) -> ImuSample:
    return replace(x, gyro=np.zeros(3), accel=np.zeros(3)) if 300 < k < 500 else x


def _stuck(k: int, x: ImuSample, last: ImuSample) -> ImuSample:
    return replace(x, gyro=last.gyro, accel=last.accel) if 300 < k < 500 else x


def _dead_gyro(k: int, x: ImuSample, _: ImuSample) -> ImuSample:
    return replace(x, gyro=np.zeros(3)) if 300 < k < 500 else x


@pytest.mark.parametrize("fault", [_two_per_mille, _dead_gyro])
def test_faulty_samples_do_not_move_the_poses(fault: Change) -> None:
    """0.5 px of noise alone leave a centimetre; before, spikes brought 0.4 m and a dead IMU
    metres.
    """
    assert _rms(Faulty(fault)) < 1.3 * _clean()


def _passed(samples: list[ImuSample]) -> tuple[list[int], list[str]]:
    """Numbers of the samples that pass, and the kinds of the faults."""
    check = ImuSampleCheck()
    usable = [u.time_ns // 5_000_000 for x in samples for u in check.take_all([x])]
    return usable, [f.kind for f in check.new_faults()]


def _samples(values: FloatArray) -> list[ImuSample]:
    """200 Hz samples from readings (N, 6)."""
    return [ImuSample(5_000_000 * k, v[:3], v[3:]) for k, v in enumerate(values)]


def _noise(count: int, scale: float = 0.01) -> FloatArray:
    """Readings (N, 6) at standstill."""
    out = np.random.default_rng(3).normal(0, scale, (count, 6))
    out[:, 5] += 9.81
    return out


def test_clean_samples_pass_at_once() -> None:
    check = ImuSampleCheck()
    assert all(check.take_all([x]) == [x] for x in _samples(_noise(1000)))
    assert check.new_faults() == ()


def test_a_real_step_and_a_real_shock_pass() -> None:
    """A step stays; a shock rings for longer than a sample: both are measured motion."""
    step = _noise(400)
    step[300:, 1] += 5.0
    assert _passed(_samples(step)) == (list(range(400)), [])
    shock = _noise(400)
    shock[300:312, 5] += 120 * np.exp(-np.arange(12) / 3) * np.cos(np.arange(12) * 0.9)
    assert _passed(_samples(shock)) == (list(range(400)), [])


def _turning(count: int) -> FloatArray:
    """Readings (N, 6) of a body that turns to and fro about x, up to 1 rad/s."""
    out = _noise(count)
    out[:, 0] += np.sin(np.arange(count) / 60)
    return out


def test_readings_at_the_end_of_the_range_are_left_out_from_the_fifth_on() -> None:
    values = _turning(1600)
    over = np.abs(values[:, 0]) > 0.7
    values[:, :3] = np.clip(values[:, :3], -0.7, 0.7)
    samples = _samples(values)
    passed, kinds = _passed(samples)
    left_out = np.ones(1600, dtype=np.bool_)
    left_out[passed] = False
    assert not left_out[~over].any()
    first = np.flatnonzero(over)[0]
    assert left_out[over].sum() >= over.sum() - 6
    assert not left_out[: first + 3].any()  # a reading that repeats once or twice is chance
    assert set(kinds) == {"gyro clipped"}
    # whatever the batches are
    check = ImuSampleCheck()
    batches = [samples[k : k + 37] for k in range(0, 1600, 37)]
    together = [u.time_ns // 5_000_000 for batch in batches for u in check.take_all(batch)]
    assert together == passed
    assert {fault.size for fault in check.new_faults()} == {0.7}


def test_a_range_that_is_exceeded_was_none() -> None:
    """A governor that holds 0.7 rad/s to the last bit for a while, and then turns faster."""
    values = _turning(1600)
    held = np.arange(100, 500)
    values[held, 0] = np.clip(values[held, 0], -0.7, 0.7)
    passed, _ = _passed(_samples(values))
    assert set(range(501, 1600)) <= set(passed)


@pytest.mark.parametrize("size", [1, 7, 1600])
def test_ends_of_ranges_are_found_alike_in_batches_of_any_size(size: int) -> None:
    """Six rows of readings at an end that was none, then four at the true one; a live IMU gives
    its samples one by one.
    """
    values = _turning(1600)
    starts = np.arange(200, 1600, 140)
    for k, start in enumerate(starts.tolist()):
        values[start : start + 20, 0] = 2.0 if k < 6 else 3.0
    samples = _samples(values)
    check = ImuSampleCheck()
    passed: list[int] = []
    for k in range(0, 1600, size):
        passed += [u.time_ns // 5_000_000 for u in check.take_all(samples[k : k + size])]
    faults = check.new_faults()
    assert [fault.start_ns // 5_000_000 for fault in faults if fault.size == 2.0][1:] == (
        starts[1:6].tolist()
    )
    assert [fault.start_ns // 5_000_000 for fault in faults if fault.size == 3.0][1:] == (
        starts[7:].tolist()
    )
    assert len(faults) == len(starts)
    assert 1600 - len(passed) == 20 * len(starts) - sum(
        fault.start_ns // 5_000_000 - start
        for fault, start in zip(faults, starts.tolist(), strict=True)
    )


def test_neither_filter_nor_report_keeps_each_fault() -> None:
    """A gyro at the end of its range at every turn of a vibration has many in a second."""
    values = _turning(4000)
    values[np.arange(4000) % 20 < 8, 0] = 2.0
    samples = _samples(values)
    motion, report = ImuMotion(MsckfSettings()), ImuFaultReport()
    sizes = []
    for part in (samples[:2000], samples[2000:]):
        for sample in part:
            motion.take(sample)
            assert len(motion.samples) <= len(part)  # which takes what is new
            report.samples([sample])
        motion._kept.clear()
        sizes.append(len(pickle.dumps((motion._check, report))))
    assert "2 rad/s, 198 times" in report.finish()[0].message
    assert sizes[1] < sizes[0] + 1000


@pytest.mark.parametrize("step", [0.02, 0.2])
def test_coarse_steps_are_no_end_of_a_range(step: float) -> None:
    values = np.round(_turning(1600) / step) * step
    values[:, 5] = 9.81 + _noise(1600)[:, 0]
    assert _passed(_samples(values)) == (list(range(1600)), [])


def test_a_steady_turn_without_noise_is_no_end_of_a_range() -> None:
    values = np.zeros((800, 6))
    values[:, 0] = np.minimum(np.arange(800) / 200, 1.0)
    values[:, 3:] = np.column_stack([np.sin(np.arange(800) / 90)] * 3) + 5.0
    assert "gyro clipped" not in _passed(_samples(values))[1]


def test_vibration_that_fills_the_band_passes() -> None:
    """The spike's limit follows the record: what vibrates by 4 rad/s is not called a spike at
    10.
    """
    values = _noise(1000)
    values[:, :3] += np.random.default_rng(4).normal(0, 4.0, (1000, 3))
    assert _passed(_samples(values)) == (list(range(1000)), [])


def test_a_spike_is_left_out_and_the_rest_passes() -> None:
    values = _noise(400)
    values[300, 2] += 30.0
    usable, faults = _passed(_samples(values))
    assert usable == [k for k in range(400) if k != 300]
    assert faults == ["gyro spike"]


def test_coarse_quantisation_at_standstill_is_not_stuck() -> None:
    """Readings rounded so that most repeat, from the start on, or held by the driver to a lower
    rate.
    """
    coarse = np.round(_noise(2000, 0.01) / 0.05) * 0.05
    assert np.mean(np.all(coarse[1:] == coarse[:-1], axis=1)) > 0.7
    assert _passed(_samples(coarse)) == (list(range(2000)), [])
    held = _noise(2000)
    held[:, 3:] = np.repeat(held[::4, 3:], 4, axis=0)
    assert _passed(_samples(held)) == (list(range(2000)), [])


def test_a_reading_given_twice_is_not_a_second_measurement_but_no_fault_either() -> None:
    values = _noise(400)
    values[200] = values[199]
    usable, faults = _passed(_samples(values))
    assert sorted(usable) == list(range(400))
    assert faults == []


def _lines(samples: list[ImuSample]) -> list[str]:
    return _monitored(samples).lines


def _monitored(samples: list[ImuSample]) -> RunMonitor:
    """A run monitor at the end, with the flight's features at every tenth sample."""
    monitor, flight = RunMonitor(CAMERA, T_CAM0_IMU, imu=True), Flight(FRAMES)
    rng = np.random.default_rng(0)
    events: list[Event] = [
        *samples,
        *(StereoFrame(k, k * 50_000_000, None, None) for k in range(FRAMES)),
    ]
    order = EventOrder(wait_for_imu=True)
    ready = [d for event in sorted(events, key=lambda e: e.time_ns) for d in order.add(event)]
    for due in [*ready, *order.flush()]:
        monitor.samples(due.samples)
        if due.frame is not None:
            monitor.observations(flight.observe(due.frame.index, 0.1, rng))
    monitor.close()
    return monitor


def _faulty(change: Change) -> list[ImuSample]:
    return Faulty(change).imu(np.random.default_rng(1), np.zeros(6))


def test_a_clean_imu_gives_no_line() -> None:
    assert _lines(Flight(FRAMES).imu(np.random.default_rng(1), np.zeros(6))) == []


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (
            _one_gyro_spike,
            ["gyro spike: one sample at 1775000000 ns is 30 rad/s from both its neighbours"],
        ),
        (
            _two_per_mille,
            [
                "gyro spike: one sample at",
                "accelerometer spike: one",
                "3 of 601 IMU samples were gyro spikes",
                "3 of",
            ],
        ),
        (
            _zeros,
            [
                "frame 31: the IMU reads zero in all axes since 1505000000 ns",
                "the IMU gives new readings again, after 0.99 s of zeros",
            ],
        ),
        (
            _stuck,
            [
                "frame 31: the IMU repeats one reading to the last bit since 1500000000 ns",
                "the IMU gives new readings again, after 1.00 s of one reading",
            ],
        ),
        (
            _dead_gyro,
            [
                "frame 36: the gyro reads zero in all axes since 1505000000 ns",
                "the gyro gives new readings again, after 0.99 s of zeros",
            ],
        ),
    ],
)
def test_each_fault_is_named_and_no_other_cause(fault: Change, expected: list[str]) -> None:
    lines = _lines(_faulty(fault))
    assert len(lines) == len(expected), lines
    for line, part in zip(lines, expected, strict=True):
        assert part in line


def test_an_imu_that_is_stuck_to_the_end_is_reported() -> None:
    (line,) = _lines(
        _faulty(lambda k, x, last: x if k <= 300 else replace(x, gyro=last.gyro, accel=last.accel))
    )
    assert "repeats one reading to the last bit since 1500000000 ns" in line


def test_an_imu_that_is_stuck_is_found_while_it_is_and_holds_from_its_first_frame() -> None:
    monitor = _monitored(_faulty(_stuck))
    begun, ended = monitor.findings
    assert begun.frame == 31  # exposed at 1.55 s; the reading is of 1.5 s
    assert begun.first_frame == 31
    assert begun.lasts
    assert ended.ended
    assert ended.frame == 50


def test_zeros_from_the_start_are_found() -> None:
    """Not even gravity is read, so no usual readings are needed to compare them with."""
    zero = np.zeros(3)
    monitor = _monitored(_faulty(lambda k, x, last: replace(x, gyro=zero, accel=zero)))
    (finding,) = monitor.findings  # no word of clocks
    assert finding.code == "imu-readings"
    assert finding.first_frame == 1


def test_samples_that_are_missing_for_seconds_are_no_matter_of_clocks() -> None:
    """Frames without samples between others that have them; at either end the clocks may be
    shifted.
    """

    def at_end(covered_s: Callable[[float], bool], begin_s: float, end_s: float) -> list[str]:
        coverage, last_ns = SampleCoverage(), None
        for k in range(200):
            last_ns = k * 50_000_000 if covered_s(0.05 * k) else last_ns
            coverage.frame(k * 50_000_000, last_ns)
        return [f.fault for f in coverage.at_end((round(begin_s * 1e9), round(end_s * 1e9)), 5e6)]

    assert at_end(lambda t: not 4 < t < 7, 0, 10) == []
    assert at_end(lambda t: t < 7, 0, 7) == ["clocks overlap in part"]
    assert at_end(lambda t: t > 4, 4, 10) == ["clocks overlap in part"]


def test_samples_that_come_behind_their_frames_are_no_matter_of_clocks() -> None:
    """Live use under load: frames pass before their samples, which come in the end."""
    coverage = SampleCoverage()
    for k in range(200):
        coverage.frame(k * 50_000_000, min(k, 100) * 50_000_000)
    assert coverage.at_end((0, 10**10), 5e6) == []


@pytest.mark.parametrize("kind", ["planar turn", "turn while it sways"])
def test_a_simulator_without_noise_is_not_saturated(kind: str) -> None:
    """Gyro readings of exactly 0 at rest, and of one value in a steady turn, are no range."""
    samples = Samples()
    for k in range(800):
        moving = 200 <= k < 600
        ramp = np.clip((k - 200) / 100, 0, 1) * np.clip((600 - k) / 100, 0, 1) if moving else 0.0
        gyro = np.array([0.0, 0.0, 0.5 * ramp])
        if kind == "turn while it sways":
            gyro[:2] = moving * 0.2 * np.sin(0.01 * (k - 200)) ** 2
        force = np.array([0.1 * ramp, 0.0, 9.81])
        samples.add([ImuSample(k * 5_000_000, gyro, force)])
    assert samples.check_new(keep=True) == []


def test_a_range_that_ends_is_still_named() -> None:
    rng = np.random.default_rng(1)
    samples = Samples()
    for k in range(800):
        clipped = float(np.clip(6 * np.sin(0.02 * k), -4, 4))
        gyro = np.array([clipped, *rng.normal(0, 1e-3, 2)])
        force = np.array([0, 0, 9.81]) + rng.normal(0, 0.01, 3)
        samples.add([ImuSample(k * 5_000_000, gyro, force)])
    assert [f.fault for f in samples.check_new(keep=True)] == ["saturation"]


def _record(times_ns: IntArray, repeats: int) -> ImuRecord:
    rng = np.random.default_rng(2)
    values = np.repeat(rng.normal(0, 1, (len(times_ns) // repeats + 1, 6)), repeats, axis=0)
    return ImuRecord(times_ns, values[: len(times_ns), :3], values[: len(times_ns), 3:])


def test_readings_given_again_and_again_are_named_with_the_true_rate() -> None:
    times_ns = 5_000_000 * np.arange(700)
    (repeated, slow) = sampling_notes(_record(times_ns, 7), "imu.csv")
    assert "each reading is given 7 times, so the IMU has 28.6 Hz, not 200" in repeated
    assert "28.6 Hz, too few" in slow
    assert sampling_notes(_record(times_ns, 1), "imu.csv") == ()
    still = ImuRecord(times_ns, np.zeros((700, 3)) + 0.1, np.zeros((700, 3)) + 9.8)
    assert sampling_notes(still, "imu.csv") == ()


def test_stamps_in_bursts_are_named_with_the_mean_rate() -> None:
    k = np.arange(1000)
    times_ns = 50_000_000 * (k // 10) + 100_000 * (k % 10)
    (note,) = sampling_notes(_record(times_ns, 1), "imu.csv")
    assert "come in bursts of 10" in note
    assert "202 Hz in the mean" in note
    gaps = np.cumsum(np.where(k % 200 == 199, 900_000_000, 5_000_000))
    assert sampling_notes(_record(gaps, 1), "imu.csv") == ()


@pytest.mark.parametrize("fault", [_one_gyro_spike, _two_per_mille, _zeros, _stuck, _dead_gyro])
def test_samples_of_a_frame_at_once_are_judged_as_one_by_one(fault: Change) -> None:
    samples = Faulty(fault).imu(np.random.default_rng(3), np.zeros(6))
    single, at_once = ImuSampleCheck(), ImuSampleCheck()
    expected = [x.time_ns for sample in samples for x in single.take_all([sample])]
    cuts = np.cumsum(np.random.default_rng(4).integers(0, 25, len(samples)))
    parts = np.split(np.arange(len(samples)), cuts[cuts < len(samples)])
    got = [x.time_ns for part in parts for x in at_once.take_all([samples[k] for k in part])]
    assert got == expected
    assert at_once.new_faults() == single.new_faults()
    assert len(got) < len(samples)
