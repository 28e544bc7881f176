"""Whether the IMU contradicts the images: named within ten frames, and only then."""

from __future__ import annotations

import pytest

from vio.findings import Finding
from vio.monitor.contradiction import ImuContradiction

# median innovations over their standard deviations, frame by frame from the second one on, of runs
# on MH_01's head as it is, with an IMU whose clock is off by 0.17 s, whose axes are swapped, and
# that is turned by 18 degrees
MH_01 = [0.0, 0.5, 1.1, 0.8, 1.1, 0.8, 0.7, 0.6, 0.7, 0.8, 0.9, 1.3, 1.1, 1.2, 1.0, 1.2, 1.2, 1.2]
CLOCK = [0.1, 5.0, 14.9, 17.2, 21.7, 20.4, 7.0, 9.5, 7.9, 8.2, 7.3, 6.0, 3.8, 11.8, 7.8, 14.8]
AXES = [0.2, 2.6, 26.3, 31.8, 32.3, 8.8, 30.7, 12.0, 15.0, 8.5, 19.9, 12.5, 19.5, 43.2, 45.8]
TURNED = [0.0, 0.9, 4.6, 7.5, 13.2, 10.3, 10.4, 9.3, 17.1, 14.6, 16.0, 14.3, 6.2, 16.4, 12.1]
# images rendered along the poses of V1_02's motion capture, beside its real IMU: its worst frames
V1_02 = [2.5, 1.8, 3.3, 2.8, 4.1, 5.8, 2.3, 1.7, 2.2, 2.9, 3.0, 4.3, 1.1, 3.4, 6.9, 7.8, 2.0, 4.6]
V1_02 += [2.3, 3.4, 2.9, 2.4, 2.9, 2.8, 1.4, 2.4, 2.1, 2.9, 1.2, 3.7, 5.9]


def _found(ratios: list[float]) -> list[Finding]:
    monitor = ImuContradiction()
    return [f for k, ratio in enumerate(ratios, 1) for f in monitor.frame(k, ratio)]


@pytest.mark.parametrize("ratios", [CLOCK, AXES, TURNED], ids=["clock", "axes", "turned"])
def test_an_imu_that_contradicts_the_images_is_named_within_ten_frames(
    ratios: list[float],
) -> None:
    (found,) = _found(ratios)
    assert found.code == "imu-disagrees"
    assert found.frame is not None
    assert found.frame <= 10


@pytest.mark.parametrize("ratios", [MH_01, V1_02], ids=["MH_01", "V1_02"])
def test_an_imu_that_agrees_is_not_named(ratios: list[float]) -> None:
    assert not _found(ratios)


def test_a_shock_is_no_contradiction() -> None:
    assert not _found([30.0 if k in (20, 21, 24, 25) else 1.0 for k in range(60)])


def test_an_event_has_one_beginning_and_one_end() -> None:
    found = _found([1.0] * 5 + [9.0] * 12 + [1.0] * 40 + [9.0] * 6)
    assert [(f.frame, f.first_frame, f.ended) for f in found] == [
        (11, 6, False),
        (37, 37, True),
        (63, 58, False),
    ]
    assert found[0].figures["innovation_ratio"] == 9.0


def test_frames_without_features_say_nothing() -> None:
    monitor = ImuContradiction()
    assert not any(monitor.frame(k, None) for k in range(30))


def test_an_imu_that_is_left_out_contradicts_nothing() -> None:
    monitor = ImuContradiction()
    assert not monitor.end(0)
    found = [finding for k in range(8) for finding in monitor.frame(k, 9.0)]
    assert len(found) == 1
    (ended,) = monitor.end(8)
    assert ended.ended
    assert not monitor.end(9)
