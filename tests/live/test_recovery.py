"""When a filter is begun anew, and from where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, Flight
from vio import Odometry, Parts
from vio.config import Config
from vio.live.recovery import IMPOSSIBLE, Recovery
from vio.protocols import Backend
from vio.records import (
    Estimate,
    Landmarks,
    MotionSample,
    Observations,
    UpdateReport,
    no_landmarks,
)


def _estimate(k: int, *, impossible: bool = False, unusable: bool = False) -> Estimate:
    return Estimate(
        k * 100_000_000,
        np.eye(4),
        np.eye(6),
        integrity="unusable" if impossible or unusable else "nominal",
        findings=(IMPOSSIBLE,) if impossible else (),
    )


def _begun(estimates: list[Estimate]) -> list[int]:
    """Frames at which a filter is begun anew."""
    recovery = Recovery()
    return [k for k, x in enumerate(estimates) if recovery.take(x) is not None]


def test_a_filter_that_worked_is_begun_anew_after_a_second() -> None:
    estimates = [_estimate(k, impossible=k >= 30) for k in range(45)]
    assert _begun(estimates) == [40]


def test_it_goes_on_from_the_last_estimate_that_could_be_used() -> None:
    recovery = Recovery()
    for k in range(30):
        recovery.take(_estimate(k))
    for k in range(30, 33):
        recovery.take(_estimate(k, unusable=True))
    taken = [recovery.take(_estimate(k, impossible=True)) for k in range(33, 44)]
    assert taken[-1] is not None
    assert taken[-1].time_ns == 2_900_000_000


@pytest.mark.parametrize("usable", [0, 19])
def test_a_filter_that_has_not_worked_for_two_seconds_is_left(usable: int) -> None:
    assert _begun([_estimate(k, impossible=k >= usable) for k in range(200)]) == []


def test_tries_that_fail_are_ever_rarer() -> None:
    estimates = [_estimate(k, impossible=k >= 30) for k in range(200)]
    assert _begun(estimates) == [40, 60, 100, 180]


def test_one_that_succeeds_counts_anew() -> None:
    estimates = [_estimate(k, impossible=30 <= k < 41 or k >= 70) for k in range(90)]
    assert _begun(estimates) == [40, 80]


class Breaking(Backend):
    """A back end whose state breaks at a frame, and which can be begun anew."""

    def __init__(self, frame: int) -> None:
        self.frame = frame
        self.begun_from: list[Estimate] = []
        self._now = Estimate(0, np.eye(4), 1e-4 * np.eye(6))

    def propagate(self, sample: MotionSample) -> None:
        """Take nothing."""

    def update(self, observations: Observations) -> UpdateReport:
        """Move on."""
        broken = observations.frame_index >= self.frame and not self.begun_from
        bias = np.full(3, 10.0 if broken else 0.1)
        self._now = replace(self._now, time_ns=observations.time_ns, accel_bias=bias)
        return UpdateReport(10, 0, 0, 0, 0.1, 1.0)

    def estimate(self) -> Estimate:
        """Return the state."""
        return self._now

    def landmarks(self) -> Landmarks:
        """Return none."""
        return no_landmarks()

    def begin_anew(self, good: Estimate) -> Estimate:
        """Note it."""
        self.begun_from.append(good)
        self._now = replace(self._now, accel_bias=np.zeros(3))
        return self._now


def test_a_run_goes_on_with_a_state_that_is_possible() -> None:
    """The estimate is marked while it is impossible, then usable again; it is said in one line."""
    backend = Breaking(60)
    odometry = Odometry(CAMERA, replace(Config(), motion="none"), parts=Parts(backend=backend))
    seen = Flight().observe(0, 0.0, np.random.default_rng(0))
    levels = []
    for k in range(120):
        estimate = odometry.add_observations(k * 50_000_000, seen.ids, seen.z)
        assert estimate is not None
        levels.append(estimate.integrity)
    assert set(levels[:60]) == {"nominal"}
    assert set(levels[60:80]) == {"unusable"}
    assert set(levels[80:100]) == {"degraded"}
    assert set(levels[101:]) == {"nominal"}
    assert [good.time_ns for good in backend.begun_from] == [59 * 50_000_000]
    codes = [finding.code for finding in odometry.findings]
    assert codes == ["estimate-implausible", "estimate-restarted"]
