"""Whether the IMU contradicts the images: named within fifteen frames, and only then."""

from __future__ import annotations

import pytest

from vio.findings import Finding
from vio.monitor.contradiction import ImuContradiction

# median innovations over their standard deviations, frame by frame from the second one on, of runs
# on MH_01's head as it is, with an IMU whose clock is off by 0.17 and -0.1 s, and that is turned by
# 18 degrees
MH_01 = [0.0, 0.5, 1.1, 0.8, 1.1, 0.8, 0.7, 0.6, 0.7, 0.8, 0.9, 1.3, 1.1, 1.2, 1.0, 1.2, 1.2, 1.2]
CLOCK = [0.1, 5.0, 14.9, 17.2, 21.7, 20.4, 7.0, 9.5, 7.9, 8.2, 7.3, 6.0, 3.8, 11.8, 7.8, 14.8, 7.9]
CLOCK += [7.1, 5.6, 25.9, 21.6, 14.3, 13.4, 17.6, 10.1, 24.2, 6.9]
EARLY = [0.1, 3.9, 19.8, 12.7, 7.5, 10.0, 22.7, 11.8, 17.6, 10.0, 12.0, 11.3, 3.6, 6.3, 9.1, 7.6]
EARLY += [15.1, 25.6, 24.1, 14.2, 17.3, 19.3, 26.0, 25.2, 10.3, 31.2, 7.0]
TURNED = [0.1, 1.7, 5.7, 9.7, 10.1, 9.6, 7.9, 7.4, 10.8, 5.4, 8.1, 6.6, 7.7, 13.2, 14.6, 3.0, 21.4]
TURNED += [16.1, 4.4, 14.7, 19.3, 3.4, 9.5, 18.9, 3.0, 6.1, 4.5, 6.6, 6.1]
# images rendered along the poses of V1_02's motion capture, beside its real IMU: its worst frames
V1_02 = [2.5, 1.8, 3.3, 2.8, 4.1, 5.8, 2.3, 1.7, 2.2, 2.9, 3.0, 4.3, 1.1, 3.4, 6.9, 7.8, 2.0, 4.6]
# likewise MH_03, from its first frames on: vibrations that the filter learns
MH_03 = [1.0, 1.5, 6.6, 9.6, 2.0, 9.1, 1.9, 10.5, 7.5, 9.9, 12.9, 5.3, 3.4, 1.9, 3.4, 4.0, 3.6, 5.0]
MH_03 += [3.9, 5.1, 4.2, 2.0, 2.3, 2.5, 3.2, 8.2, 3.5, 2.2, 3.5, 6.0, 4.1, 2.5, 1.0, 1.0, 3.4, 4.7]
V1_02 += [2.3, 3.4, 2.9, 2.4, 2.9, 2.8, 1.4, 2.4, 2.1, 2.9, 1.2, 3.7, 5.9]


def _found(ratios: list[float]) -> list[Finding]:
    monitor = ImuContradiction()
    return [f for k, ratio in enumerate(ratios, 1) for f in monitor.frame(k, ratio)]


@pytest.mark.parametrize("ratios", [CLOCK, EARLY, TURNED], ids=["clock", "early", "turned"])
def test_an_imu_that_contradicts_the_images_is_named_within_fifteen_frames(
    ratios: list[float],
) -> None:
    (found,) = _found(ratios)
    assert found.code == "imu-disagrees"
    assert found.frame is not None
    assert found.frame <= 15
    assert found.first_frame is not None
    assert found.first_frame <= 3


@pytest.mark.parametrize("ratios", [MH_01, V1_02, MH_03], ids=["MH_01", "V1_02", "MH_03"])
def test_an_imu_that_agrees_is_not_named(ratios: list[float]) -> None:
    assert not _found(ratios)


def test_as_many_frames_as_stated_are_needed() -> None:
    assert not _found([5.0] * 19 + [1.0] * 30)
    assert _found([5.0] * 20)


def test_frames_that_are_further_off_are_needed_less_often() -> None:
    assert not _found([30.0] * 7 + [1.0] * 30)
    assert [f.frame for f in _found([1.0] * 5 + [30.0] * 8)] == [13]
    assert [f.frame for f in _found([1.0] * 5 + [9.0] * 10)] == [15]


def test_a_shock_is_no_contradiction() -> None:
    assert not _found([30.0 if k in (20, 21, 24, 25) else 1.0 for k in range(60)])


def test_an_event_has_one_beginning_and_one_end() -> None:
    found = _found([1.0] * 5 + [9.0] * 24 + [1.0] * 40 + [9.0] * 20)
    assert [(f.frame, f.first_frame, f.ended) for f in found] == [
        (15, 6, False),
        (49, 49, True),
        (79, 70, False),
    ]
    assert found[0].figures["innovation_ratio"] == 9.0


def test_frames_without_features_say_nothing() -> None:
    monitor = ImuContradiction()
    assert not any(monitor.frame(k, None) for k in range(30))


def test_an_imu_that_is_left_out_contradicts_nothing() -> None:
    monitor = ImuContradiction()
    assert not monitor.end(0)
    found = [finding for k in range(20) for finding in monitor.frame(k, 9.0)]
    assert len(found) == 1
    (ended,) = monitor.end(20)
    assert ended.ended
    assert not monitor.end(21)
