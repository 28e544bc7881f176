"""Each limit of what an IMU's record shows by itself, from both sides."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from vio.geometry.lie import FloatArray
from vio.imu.clocks import SampleCoverage, judge_clocks
from vio.imu.faults import ImuFault, ImuSampleCheck
from vio.imu.preintegration import Readings, preintegrate
from vio.imu.sampling import burst_length, repeated_readings, sampling_notes
from vio.imu.standstill import blocks_agree
from vio.imu.two_sensors import joined_record
from vio.records import ImuDensities, ImuRecord, ImuSample

Says = Callable[[float], bool]
RNG = np.random.default_rng(0)
NOISE = RNG.normal(size=(4000, 6))


# Clocks


def _overlaps(covered: float, seconds: float) -> bool:
    """Whether stamps are taken for one clock's of which the IMU covers a share of the frames."""
    frames = np.linspace(0, 1e9 * seconds, 1001).astype(np.int64)
    imu = np.linspace(0, 1e9 * seconds * covered, 1000).astype(np.int64)
    return judge_clocks(frames, imu) == ()


def _missing(frames: int, seconds: float) -> bool:
    """Whether missing samples are reported after so many frames and so much time."""
    coverage = SampleCoverage()
    for time_ns in np.linspace(0, 1e9 * seconds, frames).astype(int):
        coverage.frame(int(time_ns), None)
    return bool(coverage.so_far(None, 0.0))


def _silence_is_reported(seconds: float, step_s: float) -> bool:
    """Whether a clock is doubted so long after samples of a step, none of which any frame had."""
    coverage = SampleCoverage()
    for k in range(20):
        coverage.frame(round(1e9 * (seconds - 0.05 * (19 - k))), None)
    return bool(coverage.so_far((-round(1e9 * step_s), 0), 1e9 * step_s))


def _is_covered(late_s: float) -> bool:
    """Whether frames have samples that end so long before each."""
    coverage = SampleCoverage()
    for k in range(40):
        coverage.frame(10**8 * k, 10**8 * k - round(1e9 * late_s))
    return not coverage.so_far((0, 1), 0.01)


CLOCKS: dict[str, tuple[Says, float, float]] = {
    "covered": (lambda x: _overlaps(x, 1e4), 0.965, 0.975),
    "uncovered seconds": (lambda s: not _overlaps(1.0 - s / 20.0, 20.0), 0.85, 1.15),
    "missing: frames": (lambda n: _missing(int(n), 2.0), 9, 10),
    "missing: seconds": (lambda s: _missing(40, s), 0.34, 0.46),
    "late": (lambda s: not _is_covered(s), 0.085, 0.115),
    "silent after few": (lambda s: _silence_is_reported(s, 0.0), 1.4, 1.6),
    "silent after slow ones": (lambda s: _silence_is_reported(s, 1.0), 1.9, 2.1),
}


# Rates


def _record(times_s: FloatArray, values: FloatArray) -> ImuRecord:
    return ImuRecord((1e9 * times_s).astype(np.int64), values[:, :3].copy(), values[:, 3:].copy())


def _is_slow(rate_hz: float, words: str = "too few to integrate") -> bool:
    record = _record(np.arange(200) / rate_hz, NOISE[:200])
    return any(words in note for note in sampling_notes(record, "imu"))


def _repeats(rows: int, often: int = 4, others: float = 0.0) -> bool:
    """Whether readings are said to be given again and again: each so often, but for a share that
    is given once.
    """
    counts = np.where(np.arange(rows) % 20 < 20 * others, 1, often)
    return repeated_readings(np.repeat(NOISE[:rows], counts, axis=0)) > 0


def _bursts(count: int = 40, within: float = 0.01, more: float = 0.0) -> bool:
    """Whether stamps come in bursts of five, whose steps are a share of the mean; `more`: of the
    time, that passes in other steps.
    """
    pause = 5.0 - 4.0 * within
    steps = np.tile([within] * 4 + [pause], count)
    other = more / (1.0 - more) * count * pause / 0.9
    steps = np.concatenate([steps, np.full(round(other), 0.9)])
    return burst_length(np.cumsum(1e7 * np.concatenate([[0.0], steps])).astype(np.int64)) > 0


RATES: dict[str, tuple[Says, float, float]] = {
    "slow": (lambda hz: not _is_slow(hz), 43.0, 57.0),
    "slow: unit": (lambda hz: not _is_slow(hz, "in another unit"), 1.8, 2.2),
    "repeated: rows": (lambda n: _repeats(int(n)), 21, 22),
    "repeated: times": (lambda n: _repeats(60, int(n)), 2, 3),
    "repeated: alike": (lambda x: not _repeats(400, others=x), 0.05, 0.35),
    "bursts: number": (lambda n: _bursts(int(n)), 19, 20),
    "bursts: steps": (lambda x: not _bursts(within=x), 0.17, 0.23),
    "bursts: pauses": (lambda x: not _bursts(200, more=x), 0.17, 0.23),
}


# Standstill, and two sensors


def _agree(sigmas: float, blocks: Sequence[int] = (0, 1, 2, 3, 4)) -> bool:
    """Whether means of readings over tenths of a second agree whose signs alternate."""
    times = -0.5 + 0.005 * np.arange(101)
    block = np.minimum((-times / 0.1).astype(int), 4)
    kept = np.isin(block, blocks)
    values = sigmas * np.outer(1.0 - 2.0 * (block % 2), [1.0, 0.0, 0.0])
    return blocks_agree(times[kept], values[kept], 1.0)


def _is_joined(gap_ms: float, step_ms: float = 5.0) -> bool:
    """Whether a gyro's readings are kept in a gap of the accelerometer."""
    accel_ns = np.concatenate(
        [np.arange(50) * step_ms, 50 * step_ms - step_ms + gap_ms + np.arange(50) * step_ms]
    )
    accel_ns = (1e6 * accel_ns).astype(np.int64)
    at = np.array([round(1e6 * (49 * step_ms + 0.5 * gap_ms))], dtype=np.int64)
    return joined_record((at, np.zeros((1, 3))), (accel_ns, np.zeros((100, 3)))) is not None


def _lacks(periods: float) -> bool:
    """Whether a step of so many periods between samples hides a motion."""
    t = np.concatenate([0.01 * np.arange(50), 0.49 + 0.01 * periods + 0.01 * np.arange(50)])
    densities = ImuDensities(1e-3, 1e-2, 1e-5, 1e-4)
    readings = Readings(t, np.zeros((100, 3)), np.zeros((100, 3)), densities)
    span = np.array([[0.4], [0.6]])
    found = preintegrate(readings, span[0], span[1], np.zeros((1, 6)))
    return bool(found.covariance[0, 0, 0] > 1e-5)


OTHERS: dict[str, tuple[Says, float, float]] = {
    # 5 blocks of twelve degrees of freedom: 4.8 x² of 32.9 times (5)² / 0.1
    "standstill: noise": (lambda x: not _agree(x), 36.0, 47.0),
    "standstill: blocks": (lambda n: _agree(0.0, range(int(n))), 3, 4),
    "two sensors: gap": (lambda x: not _is_joined(x), 90.0, 115.0),
    "two sensors: steps": (lambda x: not _is_joined(x, 25.0), 175.0, 230.0),
    "preintegrated: gap": (_lacks, 2.6, 3.4),
}


# Faults


def _faults(gyro: FloatArray, accel: FloatArray, times_s: FloatArray) -> list[ImuFault]:
    check = ImuSampleCheck()
    samples = [
        ImuSample(round(1e9 * t), g, a) for t, g, a in zip(times_s, gyro, accel, strict=True)
    ]
    for k in range(0, len(samples), 5):
        check.take_all(samples[k : k + 5])
    return list(check.new_faults())


def _spike(
    sigmas: float = 500.0,
    *,
    before: int = 100,
    noise: float = 0.1,
    back: float = 0.0,
    late: float = 1.0,
    period_s: float = 0.005,
    quiet: int = 0,
) -> bool:
    """Whether a reading is a spike that is off by so many standard deviations of the changes.

    After it, readings come back but for a share of that; it comes some periods late, and after so
    many samples with a hundredth of the noise.
    """
    count = before + quiet + 20
    gyro = noise * NOISE[:count, :3]
    gyro[before : before + quiet] *= 0.01
    times = period_s * np.arange(count)
    k = before + quiet
    times[k:] += period_s * (late - 1.0)
    changes = np.diff(gyro[:before, 0][-400:])
    size = sigmas * 1.4826 * float(np.median(np.abs(changes)))
    gyro[k, 0] = gyro[k - 1, 0] + size
    gyro[k + 1 :, 0] += back * size
    found = _faults(gyro, 9.8 + NOISE[:count, 3:], times)
    return any(fault.kind == "gyro spike" for fault in found)


def _stuck(
    repeats: int,
    before: int = 100,
    part: int = 6,
    period_s: float = 0.005,
    often: int = 0,
) -> bool:
    """Whether readings are stuck that repeat the one before so often, all six numbers or the gyro's
    three; earlier, each of some repeats the one before.
    """
    count = before + repeats + 1
    values = NOISE[:count].copy()
    values[:, 5] += 9.8
    for k in range(1, often + 1):
        values[4 * k, :part] = values[4 * k - 1, :part]
    values[before + 1 :, :part] = values[before, :part]
    found = _faults(values[:, :3], values[:, 3:], period_s * np.arange(count))
    return any("stuck" in fault.kind for fault in found)


def _passes(often: int) -> bool:
    """Whether a reading that repeats the one before passes at once, as some of 400 did."""
    values = NOISE[:401].copy()
    for k in range(1, often + 1):
        values[4 * k] = values[4 * k - 1]
    values[400] = values[399]
    samples = [ImuSample(5_000_000 * k, x[:3], x[3:]) for k, x in enumerate(values)]
    check = ImuSampleCheck()
    check.take_all(samples[:400])
    return len(check.take_all(samples[400:])) == 1


def _is_silent(count: int) -> bool:
    """Whether an IMU is stuck after so many repetitions of a reading without gravity."""
    values = NOISE[: 6 + count].copy()
    values[5:] = [0.1, 0.2, 0.3, 0.0, 0.0, 0.0]
    found = _faults(values[:, :3], values[:, 3:], 0.005 * np.arange(6 + count))
    return any("stuck" in fault.kind for fault in found)


def _clipped(beyond: float = 0.0, steady: int = 1) -> int:
    """How often a gyro begins to be clipped: at 10 rad/s for 60 samples, and again after a reading
    that is beyond that by a share. Its other axes change their direction after so many samples.
    """
    count = 300
    gyro = 0.1 * NOISE[:count, :3]
    direction = 1.0 - 2.0 * ((np.arange(count) // steady) % 2)
    gyro[:, 1] = gyro[:, 2] = 0.1 * np.cumsum(direction * (1.0 + 0.01 * np.arange(count)))
    gyro[100:160, 0] = 10.0
    gyro[200, 0] = 10.0 * (1.0 + beyond)
    gyro[250, 0] = 10.0
    found = _faults(gyro, 9.8 + NOISE[:count, 3:], 0.005 * np.arange(count))
    return sum(fault.kind == "gyro clipped" for fault in found)


FAULTS: dict[str, tuple[Says, float, float]] = {
    "spike: deviations": (lambda x: _spike(x, before=400), 25.0, 36.0),
    "spike: history": (lambda n: _spike(before=int(n)), 20, 21),
    "spike: impulse": (lambda x: _spike(x / 1.4e-4, noise=1e-4), 0.87, 1.13),
    "spike: returned": (lambda x: not _spike(60.0, before=400, back=x), 0.2, 0.3),
    "spike: late": (lambda x: not _spike(late=x), 2.6, 3.4),
    "spike: seconds": (lambda n: _spike(20.0, before=700, quiet=int(n)), 140, 175),
    "stuck: times": (lambda n: _stuck(int(n)), 3, 4),
    "stuck: without gravity": (lambda n: _is_silent(int(n)), 3, 4),
    "clipped: end": (lambda x: _clipped(x) < 2, 0.87e-3, 1.13e-3),
    "clipped: noise": (lambda n: _clipped(steady=int(n)) == 0, 5, 6),
    "stuck: history": (lambda n: _stuck(30, int(n)), 19, 20),
    "stuck: one sensor": (lambda n: _stuck(int(n), 400, 3), 48, 51),
    "stuck: rare": (lambda n: _passes(int(n)), 7, 8),
    "stuck: forgotten": (lambda n: _stuck(8, int(n), often=60), 420, 540),
}
TABLES = {
    f"{what}: {name}": row
    for what, table in (
        ("clocks", CLOCKS),
        ("rates", RATES),
        ("others", OTHERS),
        ("faults", FAULTS),
    )
    for name, row in table.items()
}


@pytest.mark.parametrize(("says", "below", "above"), TABLES.values(), ids=TABLES)
def test_limits_of_records_of_an_imu(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
