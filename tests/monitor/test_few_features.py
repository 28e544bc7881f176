"""So few features that nothing tells the scene from what moves on its own."""

from __future__ import annotations

import numpy as np

from tests.filters.test_msckf import CAMERA, STEP_NS, Flight
from vio.config import load_config
from vio.findings import Finding
from vio.live.odometry import Odometry
from vio.monitor.few_features import FewFeatures
from vio.records import UpdateReport


def _found(used: list[int], *, measured: bool = False) -> list[Finding]:
    check = FewFeatures()
    reports = [UpdateReport(n, 0, 0, 0, 0.3, 1.0) for n in used]
    return [f for k, r in enumerate(reports) for f in check.frame(k, r, measured=measured)]


def test_three_frames_in_a_row_with_few_features_are_named_from_the_first_on() -> None:
    (found,) = _found([100, 100, 24, 24, 24])
    assert (found.code, found.effect, found.frame, found.first_frame) == (
        "few-features",
        "degraded",
        4,
        2,
    )
    assert found.lasts
    assert found.figures["doubted_share"] == 1.0
    assert _found([100, 100, 25, 25, 25]) == []
    assert _found([100, 24, 24, 100, 24, 24, 100]) == []


def test_it_ends_after_three_frames_with_enough() -> None:
    begun, ended = _found([100, *[10] * 4, 30, 30, 10, 30, 30, 30])
    assert (begun.frame, ended.frame, ended.ended) == (3, 10, True)


def test_frames_without_features_are_a_prediction() -> None:
    assert _found([100, *[0] * 9, 100]) == []
    assert [f.frame for f in _found([100, 10, 0, 10, 0, 10])] == [5]


def test_the_first_frame_and_a_motion_sensor_need_none() -> None:
    assert _found([0, 0, 10, 10, 10]) == []
    assert _found([100, *[10] * 9], measured=True) == []


def _integrities(features: int, *overrides: str) -> list[str]:
    """Of images alone along a flight; from frame 15 on the features are few."""
    config = load_config(overrides=["motion=none", "frontend.checks=false", *overrides])
    odometry = Odometry(CAMERA, config)
    flight = Flight(30)
    noise = np.random.default_rng(1)
    integrities = []
    for k in range(30):
        seen = flight.observe(k, 0.1, noise, 60 if k < 15 else features)
        estimate = odometry.add_observations(k * STEP_NS, seen.ids, seen.z)
        assert estimate is not None
        integrities.append(estimate.integrity)
    return integrities


def test_images_alone_are_degraded_while_features_are_few() -> None:
    assert _integrities(60) == ["nominal"] * 30
    first = _integrities(18).index("degraded")
    assert 17 <= first <= 19
    assert _integrities(18)[first:] == ["degraded"] * (30 - first)


def test_few_features_that_a_selector_keeps_are_enough() -> None:
    assert set(_integrities(60, "selector.name=visibility", "selector.budget=18")) == {"nominal"}
