"""Each limit of the filters' rules, from both sides."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from vio.errors import CalibrationError
from vio.filters.imu_gaps import ImuHistory
from vio.filters.inputs import checked_extrinsics
from vio.filters.noise import MotionNoise, StepErrors
from vio.filters.overdispersion import Overdispersion
from vio.filters.scale_test import ScaleTest, is_clear
from vio.records import ImuSample

Says = Callable[[float], bool]


# The test of the scale


def _tested(log: float, information: float, frames: int = 1) -> ScaleTest:
    """A test that was told a logarithm of the scale with some information over some frames."""
    test = ScaleTest()
    V = np.array([1.0])
    for _ in range(frames):
        each = information / frames
        test.absorb(V, each * V, np.array([each * log]), np.zeros((1, 1)))
    for _ in range(frames):
        test.end_frame()
    return test


def _contradicted(log: float, information: float, frames: int = 2) -> bool:
    test = _tested(log, information, frames)
    for _ in range(frames):
        test.end_frame()
    return test.is_confirmed


SCALE: dict[str, tuple[Says, float, float]] = {
    "length": (lambda x: _contradicted(x, 1e6), 0.036, 0.044),
    "sigmas": (lambda x: _contradicted(x, 300.0), 0.3, 0.4),
    "prior": (lambda x: _tested(0.2, 100.0).estimate()[0] < x, 0.087, 0.115),
    "noise of frames": (lambda x: _contradicted(x, 1e4, 300), 0.046, 0.054),
    "clear": (lambda x: is_clear(np.array([x, 0.0, 0.0]), np.eye(3)), 9.0, 11.0),
    "doubt: by the sensor": (lambda x: _tested(0.05, 1e4).doubt() < x, 0.030, 0.036),
    "doubt: as usual": (lambda x: _tested(0.02, 1e4).doubt() < x, 0.0055, 0.0068),
}


# Process noise


def _step(size: float, remaining: float = 0.1) -> StepErrors:
    return StepErrors(np.full(6, size), np.eye(6), np.eye(6), remaining * np.eye(6))


def _factor(steps: int, size: float = 3.0, remaining: float = 0.1) -> float:
    noise = MotionNoise(1.0, 0.1, 10.0)
    for _ in range(steps):
        noise.update(_step(size, remaining))
    return float(noise.factors[0])


def _factor_after_calm() -> float:
    """By how much a surprise raises the factor after a long time without any."""
    noise = MotionNoise(1.0, 0.01, 100.0)
    for _ in range(600):
        noise.update(_step(0.267))
    before = float(noise.factors[0])
    for _ in range(10):
        noise.update(_step(5.0))
    return float(noise.factors[0]) / before


NOISE: dict[str, tuple[Says, float, float]] = {
    "summed steps": (lambda n: _factor(int(n)) != 1.0, 9, 10),
    "informed share": (lambda x: _factor(10, remaining=1.0 - x) != 1.0, 0.26, 0.34),
    "first step": (lambda x: _factor(10) < x, 1.7, 1.87),
    "later steps": (lambda x: _factor_after_calm() < x, 1.11, 1.145),
    "surprise": (lambda x: bool(_step(x).missing_noise()[0]), 2.4, 2.85),
}


# Gaps of an IMU


def _history(count: int = 400, period_ms: float = 5.0, spread: float = 1.0) -> ImuHistory:
    rng = np.random.default_rng(0)
    history = ImuHistory()
    walk = np.cumsum(spread * rng.normal(size=(count, 6)), axis=0) * 0.05
    history.take([ImuSample(round(k * 1e6 * period_ms), w[:3], w[3:]) for k, w in enumerate(walk)])
    return history


def _is_gap(periods: float) -> bool:
    times = np.array([0.0, 5e6, 5e6 + 5e6 * periods, 1e7 + 5e6 * periods])
    hidden = _history().hidden(times, times)
    return hidden is not None and hidden.gap


def _is_slow(period_ms: float) -> bool:
    times = 1e6 * period_ms * np.arange(4)
    return _history(period_ms=period_ms).hidden(times, times) is not None


def _cuts_of_slow(period_ms: float) -> int:
    times = 1e6 * period_ms * np.arange(2)
    hidden = _history(period_ms=period_ms).hidden(times, times)
    return 0 if hidden is None else len(hidden.cuts_ns) - 1


def _hidden_rad(gap_s: float, samples: int = 400, period_ms: float = 5.0) -> float:
    """Standard deviation of the turn that a gap hides."""
    times = np.array([0.0, 1e9 * gap_s])
    hidden = _history(samples, period_ms).hidden(times, times)
    assert hidden is not None
    return float(np.sqrt(hidden.variance[1].sum()))


def _hidden_after_turns(quiet: int) -> float:
    """What a gap hides after so many samples at rest, which follow quick turns."""
    rng = np.random.default_rng(0)
    history = ImuHistory()
    for k in range(600 + quiet):
        gyro = (3.0 if k < 600 else 0.01) * rng.normal(size=3)
        history.take([ImuSample(5_000_000 * k, gyro, gyro)])
    times = np.array([0.0, 5e8])
    hidden = history.hidden(times, times)
    assert hidden is not None
    return float(np.sqrt(hidden.variance[1].sum()))


GAPS: dict[str, tuple[Says, float, float]] = {
    "long": (_is_gap, 1.35, 1.65),
    "slow": (_is_slow, 27.0, 33.0),
    "slow: cuts": (lambda n: _cuts_of_slow(60.0) < n, 6, 7),
    "few samples": (lambda n: _hidden_rad(0.5, int(n)) < 0.1, 9, 10),
    "longest lag": (lambda x: _hidden_rad(1.4) / _hidden_rad(0.7) < x, 2.2, 2.42),
    "memory": (lambda n: _hidden_after_turns(int(n)) < 0.1, 340, 460),
}


# Errors that neighbours have in common, and what a filter is given


def _overdispersed(
    tracks: int, apart_rad: float = 10.0, between: int = 0, ratio: float = 1.0
) -> float:
    """The factor after tracks with scores of a size, of which two at a time end, some frames apart
    in time and some radians apart in direction.
    """
    learned = Overdispersion()
    for k in range(tracks // 2):
        for n in range(2):
            learned.add(
                np.array([2 * k + n]),
                np.array([[0.1 + 6.0 * k + n * apart_rad, 0.1]]),
                np.full((1, 6), np.sqrt(ratio)),
                np.ones((1, 6)),
            )
            for _ in range(between if n == 0 else 9 - between):
                nothing = np.zeros((0, 6))
                learned.add(np.zeros(0, np.int64), np.zeros((0, 2)), nothing, nothing)
    return learned.factor


def _takes_extrinsics(far_m: float) -> bool:
    T = np.eye(4)
    T[0, 3] = far_m
    try:
        checked_extrinsics(T)
    except CalibrationError:
        return False
    return True


INPUTS: dict[str, tuple[Says, float, float]] = {
    "common errors: before any track": (lambda x: Overdispersion().factor < x, 2.2, 2.8),
    "common errors: prior": (lambda x: _overdispersed(30) < x, 1.69, 1.81),
    "common errors: neighbours": (lambda x: _overdispersed(400, x) < 1.5, 0.08, 0.12),
    "common errors: frames": (lambda n: _overdispersed(400, 0.0, int(n)) < 1.5, 4, 6),
    "far IMU": (lambda x: not _takes_extrinsics(x), 900.0, 1100.0),
}
TABLES = {
    f"{what}: {name}": row
    for what, table in (("scale", SCALE), ("noise", NOISE), ("gaps", GAPS), ("inputs", INPUTS))
    for name, row in table.items()
}


@pytest.mark.parametrize(("says", "below", "above"), TABLES.values(), ids=TABLES)
def test_limits_of_filters(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
