"""Each limit of the monitor's rules, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from vio.findings import Finding
from vio.geometry.lie import FloatArray, so3_exp
from vio.monitor.accelerometer import judge_up
from vio.monitor.contradiction import ImuContradiction
from vio.monitor.gyro_fit import GyroFit
from vio.monitor.health import RefusalReport, RunHealth
from vio.monitor.integrity import IntegrityMonitor
from vio.monitor.samples import Samples, judge_exchange, judge_size
from vio.records import (
    Estimate,
    ImuSample,
    StereoFieldEstimate,
    StereoScaleEstimate,
    UpdateReport,
    observations,
)

Says = Callable[[float], bool]
SEEN = UpdateReport(50, 2, 1, 30, 0.3, 1.0)
UNSEEN = UpdateReport(0, 0, 0, 30, None, None)


def _estimate(seconds: float, x: float = 0.0, **more: object) -> Estimate:
    T = np.eye(4)
    T[0, 3] = x
    return replace(Estimate(round(1e9 * seconds), T, 1e-4 * np.eye(6)), **more)  # type: ignore[arg-type]


# What a filter reports


def _run(times_s: list[float], report: UpdateReport = SEEN, **last: object) -> list[str]:
    """Codes of what is found in frames at some times, the last of which has a report and estimate
    of its own.
    """
    health = RunHealth()
    found: list[Finding] = []
    for k, seconds in enumerate(times_s):
        is_last = k == len(times_s) - 1
        estimate = _estimate(seconds, **(last if is_last else {}))
        found += health.frame(k, report if is_last else SEEN, estimate)
    return [finding.code for finding in found]


def _gap(gap_s: float, usual_s: float = 0.05, steps: int = 20) -> bool:
    times = [usual_s * k for k in range(steps + 1)]
    return "frames-missing" in _run([*times, times[-1] + gap_s])


def _gap_after_slower_frames(fast: int) -> bool:
    steps = [0.4] * 40 + [0.05] * fast + [1.2]
    return "frames-missing" in _run([0.0, *np.cumsum(steps).tolist()])


def _off(percent: float, sigma: float) -> bool:
    scale = StereoScaleEstimate(
        np.array([np.log1p(percent / 100), 0.0]), np.diag([(sigma / 100) ** 2, 0.0])
    )
    return bool(RunHealth().scale(0, _estimate(0.0, stereo_scale=scale)))


def _other_pair(rows_px: float) -> bool:
    field = StereoFieldEstimate(np.zeros(8), np.eye(8), rows_px)
    return "other-calibration" in _run([0.0], stereo_field=field)


def _restarts(after_s: float) -> bool:
    health = RunHealth()
    health.restarted(0, "why", _estimate(0.0))
    return bool(health.restarted(1, "why", _estimate(after_s)))


def _refused(
    share: float, frames: int = 25, step_s: float = 0.05, ratio: float = 1.0, imu: bool = False
) -> list[str]:
    report = RefusalReport(imu=imu)
    rng = np.random.default_rng(0)
    found: list[Finding] = []
    for k in range(frames):
        z = rng.uniform(0.0, 400.0, (100, 4))
        seen = observations(k, round(1e9 * step_s) * k, np.arange(100), z)
        gone = rng.permutation(100)[: round(100 * share)]
        update = UpdateReport(
            100 - len(gone), len(gone), 0, 0, 0.3, 1.0, gone, innovation_ratio=ratio
        )
        found += report.frame(seen, update, _estimate(step_s * k))
    return [finding.message for finding in found]


def _refused_in_one_place(side: float) -> bool:
    """Whether features that are refused in a corner, of a share of both sides, are said to be
    there.
    """
    report = RefusalReport(imu=False)
    rng = np.random.default_rng(0)
    found: list[Finding] = []
    for k in range(25):
        z = rng.uniform(0.0, 400.0, (600, 4))
        seen = observations(k, 50_000_000 * k, np.arange(600), z)
        gone = np.flatnonzero((z[:, 0] < 400.0 * side) & (z[:, 1] < 400.0))
        update = UpdateReport(10, 90, 0, 0, 0.3, 1.0, gone)
        found += report.frame(seen, update, _estimate(0.05 * k))
    return "lie together" in found[0].message


HEALTH: dict[str, tuple[Says, float, float]] = {
    "gap": (_gap, 0.45, 0.6),
    "gap: usual steps": (lambda x: _gap(x, 0.2), 0.9, 1.15),
    "gap: known steps": (lambda n: _gap(0.6, 0.05, int(n)), 4, 5),
    "gap: recent steps": (lambda n: _gap_after_slower_frames(int(n)), 21, 29),
    "features": (lambda x: "no-features" in _run([0.0, 0.1, 0.1 + x], UNSEEN), 0.9, 1.1),
    "rig: length": (lambda x: _off(x, 0.01), 0.9, 1.15),
    "rig: sigmas": (lambda x: _off(x, 1.0), 2.7, 3.4),
    "rig: rows": (_other_pair, 9.0, 11.0),
    "restarts": (_restarts, 0.9, 1.1),
    "speed": (lambda x: "estimate-implausible" in _run([0.0, 0.1], x=0.1 * x), 90.0, 110.0),
    "gyro bias": (
        lambda x: "estimate-implausible" in _run([0.0], gyro_bias=np.array([x, 0, 0])),
        0.45,
        0.55,
    ),
    "accelerometer bias": (
        lambda x: "estimate-implausible" in _run([0.0], accel_bias=np.array([x, 0, 0])),
        2.7,
        3.3,
    ),
    "refused: share": (lambda x: bool(_refused(x)), 0.37, 0.43),
    "refused: span": (lambda n: bool(_refused(0.9, int(n))), 20, 21),
    "refused: frames": (lambda x: not _refused(0.9, 9, x), 0.45, 0.6),
    "refused: contradicted": (
        lambda x: "where the IMU predicts" in _refused(0.9, ratio=x, imu=True)[0],
        1.8,
        2.2,
    ),
    "refused: spread": (lambda x: not _refused_in_one_place(x), 0.33, 0.5),
}


@pytest.mark.parametrize(("says", "below", "above"), HEALTH.values(), ids=HEALTH)
def test_limits_of_estimates(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


# What contradicts an IMU


def _contradicted(ratios: list[float]) -> list[str]:
    monitor = ImuContradiction()
    found = [f for k, ratio in enumerate(ratios) for f in monitor.frame(k, ratio)]
    return [f"-{f.code}" if f.ended else f.code for f in found]


def _grown(ratio: float, frames: int = 5) -> bool:
    """Whether a covariance that grows is inflated, after frames with a ratio."""
    monitor = IntegrityMonitor()
    for k in range(frames):
        monitor.take_innovation(ratio)
        given = replace(_estimate(0.1 * k), covariance=(1 + k) * 1e-4 * np.eye(6))
        judged = monitor.judged(k, given)
    return judged is not given


def _doubt_m(seconds: float, speed_mps: float) -> float:
    """What the position of a frame may be off by in an unusable second."""
    monitor = IntegrityMonitor()
    for k in range(3):
        monitor.judged(k, _estimate(0.1 * k, speed_mps * 0.1 * k))
    monitor.take(Finding("object-or-scene", "", 3, lasts=True))
    for k in (3, 4):
        seconds_now = 0.3 + seconds * (k - 3)
        judged = monitor.judged(k, _estimate(seconds_now, 0.2 * speed_mps))
    return float(np.sqrt(judged.covariance[0, 0]))


def _scale_marks(doubts: list[float]) -> int:
    monitor = IntegrityMonitor()
    monitor.take_scale_doubt(10, 0.0)
    for k, doubt in enumerate(doubts):
        monitor.take_scale_doubt(11 + k, doubt)
    return len(monitor.take_marks())


CONTRADICTION: dict[str, tuple[Says, float, float]] = {
    "sigmas": (lambda x: _contradicted([x] * 24) != [], 3.7, 4.3),
    "newest": (lambda n: _contradicted(([5.0] * 5 + [1.5] * int(n)) * 6) == [], 1, 2),
    "sum": (lambda n: _contradicted([1.0] * 3 + [30.0] * int(n)) != [], 7, 8),
    "of a frame": (lambda x: _contradicted([1.0] * 3 + [x] * 9) != [], 9.0, 10.5),
    "quiet": (lambda n: len(_contradicted([8.0] * 20 + [0.5] * int(n))) == 2, 19, 20),
    "innovations": (_grown, 1.8, 2.2),
    "innovations: frames": (lambda n: _grown(9.0, int(n)), 4, 5),
    "standstill": (lambda x: _doubt_m(x, 0.0) > 1.0, 8.5, 11.5),
    "scale": (lambda x: _scale_marks([x]) > 0, 0.0045, 0.0055),
    "scale: levels": (lambda x: _scale_marks([0.0052, x]) > 1, 0.0070, 0.0082),
}


@pytest.mark.parametrize(("says", "below", "above"), CONTRADICTION.values(), ids=CONTRADICTION)
def test_limits_of_innovations(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


# Readings


def _readings(gyro: FloatArray, times_s: FloatArray | None = None) -> list[str]:
    times_s = 0.01 * np.arange(len(gyro)) if times_s is None else times_s
    rng = np.random.default_rng(1)
    samples = Samples()
    samples.add(
        [
            ImuSample(round(1e9 * t), np.array([x, *rng.normal(0, 0.1, 2)]), rng.normal(9, 1, 3))
            for t, x in zip(times_s, gyro, strict=True)
        ]
    )
    return [finding.fault for finding in samples.check_new(keep=True)]


def _missing(gap_s: float, usual_s: float = 0.005) -> bool:
    times = usual_s * np.arange(200)
    times[100:] += gap_s - usual_s
    return "IMU gap" in _readings(np.random.default_rng(0).normal(size=200), times)


def _clipped(run: int, levels: int = 0, share_held: float = 0.0) -> bool:
    """Whether readings that stay at their largest value are those of a range that ends."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=400)
    if levels:
        x = np.round(x / np.ptp(x) * levels)
        x = np.where(x == x.max(), x.max() - 1, x)
    held = rng.random(400) < share_held
    for k in range(1, 400):
        if held[k]:
            x[k] = x[k - 1]
    x[200 : 200 + run] = x.max() + 1.0
    return "saturation" in _readings(x)


def _size_kind(seconds: float) -> bool:
    """Whether readings in g are said to be."""
    times = (1e9 * 0.01 * np.arange(round(100 * seconds) + 1)).astype(np.int64)
    accel = np.tile([0.0, 0.0, 1.0], (len(times), 1))
    return judge_size(times, accel).finding is not None


def _averaged(period_s: float) -> bool:
    """Whether readings in g beside a vibration of a period are: averaged, they are steady."""
    times_s = 0.005 * np.arange(2000)
    accel = np.zeros((2000, 3))
    accel[:, 2] = 1.0 + 2.5 * np.sin(2 * np.pi * times_s / period_s)
    size = judge_size((1e9 * times_s).astype(np.int64), accel)
    return size.finding is None or "in g" not in size.finding.explanation


def _exchanged(gravity: float = 1.0, varies: float = 0.0, accel: float = 0.0) -> bool:
    """Whether readings are called those of the other sensor: the gyro's are so many times gravity,
    and vary by a share (robust deviation), the accelerometer's are a share of gravity.
    """
    times = (1e9 * 0.2 * np.arange(202)).astype(np.int64)
    values = np.zeros((202, 6))
    signs = np.repeat([-1.0, 0.0, 1.0], [67, 68, 67]) / 1.4826
    values[:, 1] = 9.80665 * gravity * (1.0 + varies * signs)
    values[:, 3] = 9.80665 * accel
    return judge_exchange(times, values) is not None


READINGS: dict[str, tuple[Says, float, float]] = {
    "gap": (_missing, 0.09, 0.11),
    "gap: usual steps": (lambda x: _missing(x, 0.02), 0.14, 0.18),
    "clipped: run": (lambda n: _clipped(int(n)), 4, 5),
    "clipped: levels": (lambda n: _clipped(8, int(n)), 21, 28),
    "clipped: chance": (lambda n: _clipped(int(n), share_held=0.5), 20, 35),
    "size: time": (_size_kind, 0.9, 1.1),
    "size: averaged": (_averaged, 0.2, 0.33),
    "exchanged: little": (lambda x: _exchanged(x), 0.7, 0.8),
    "exchanged: much": (lambda x: not _exchanged(x), 1.2, 1.3),
    "exchanged: steady": (lambda x: not _exchanged(varies=x), 0.27, 0.33),
    "exchanged: gravity": (lambda x: not _exchanged(accel=x), 0.45, 0.55),
}


@pytest.mark.parametrize(("says", "below", "above"), READINGS.values(), ids=READINGS)
def test_limits_of_readings(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


# The gyro and gravity beside the camera


def _gyro_fit(
    rate: float = 1.0, noise: float = 1e-6, unexplained: float = 0.0, count: int = 10_000
) -> GyroFit:
    """A gyro that measures the camera's rates about one axis, or about all of them alike."""
    S = rate**2 * np.eye(3)
    none = np.zeros((0, 3))
    return GyroFit(
        0.0, S, S, S, np.eye(3), np.zeros(3), unexplained, noise, count, none, none, none,
        np.zeros(0, np.bool_), np.zeros(0),
    )  # fmt: skip


def _turned(deg: float) -> FloatArray:
    return so3_exp([0.0, np.radians(deg), 0.0])


def _upside_down(deg: float, share: float = 1.0) -> bool:
    """Whether a camera is said to be, by forces that show the sky so far from below it."""
    angle = np.radians(deg)
    down = np.array([np.sin(angle), np.cos(angle), 0.0])
    forces = np.where(np.arange(100)[:, None] < round(100 * share), down, [0.0, -1.0, 0.0])
    return bool(judge_up(9.81 * forces, np.eye(3), measured=True))


BESIDE: dict[str, tuple[Says, float, float]] = {
    "gyro: rate": (lambda x: _gyro_fit(x).axes > 0, 0.018, 0.022),
    "gyro: clear of noise": (lambda x: _gyro_fit(x, 0.1).axes > 0, 0.45, 0.55),
    "gyro: fits": (lambda x: not _gyro_fit().fits(_turned(x)), 12.0, 16.0),
    "gyro: by chance": (lambda n: _gyro_fit(unexplained=0.5, count=int(n)).tolerance < 0.5, 55, 65),
    "up: angle": (lambda x: not _upside_down(x), 56.0, 64.0),
    "up: share": (lambda x: _upside_down(0.0, x), 0.93, 0.97),
}


@pytest.mark.parametrize(("says", "below", "above"), BESIDE.values(), ids=BESIDE)
def test_limits_of_gyro_and_gravity(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
