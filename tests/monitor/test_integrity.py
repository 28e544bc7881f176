"""Integrity of estimates: what holds, from which frame on, and what the covariance covers then."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tools.findings_page import page
from vio.errors import ConfigError
from vio.findings import CODES, Finding
from vio.geometry.lie import se3_exp, se3_inverse
from vio.integrity import position_covariance, protection_level
from vio.monitor.integrity import IntegrityMonitor, Mark, marked
from vio.records import Estimate

PAGE = Path(__file__).resolve().parents[2] / "docs" / "findings.md"
STEP_NS = 100_000_000


def estimate(k: int, speed_mps: float = 2.0) -> Estimate:
    T = np.eye(4)
    T[0, 3] = speed_mps * k * STEP_NS * 1e-9
    return Estimate(k * STEP_NS, T, 1e-4 * np.eye(6))


def judge(monitor: IntegrityMonitor, frames: range) -> list[Estimate]:
    return [monitor.judged(k, estimate(k)) for k in frames]


def test_estimates_are_nominal_and_unchanged_without_findings() -> None:
    given = estimate(3)
    assert IntegrityMonitor().judged(3, given) is given


def test_a_lasting_finding_holds_until_it_has_ended() -> None:
    monitor = IntegrityMonitor()
    monitor.take(Finding("right-image-frozen", "", 2, lasts=True))
    held = judge(monitor, range(2, 30))
    assert {e.integrity for e in held} == {"degraded"}
    assert held[0].findings == ("right-image-frozen",)
    np.testing.assert_array_equal(held[-1].covariance, estimate(0).covariance)
    monitor.take(Finding("right-image-frozen", "", 30, ended=True))
    assert judge(monitor, range(30, 31))[0].integrity == "nominal"


def test_an_event_does_not_end_what_lasts() -> None:
    """A spike of the accelerometer while the gyro is stuck, both of one code."""
    monitor = IntegrityMonitor()
    monitor.take(Finding("imu-readings", "", 0, lasts=True))
    judge(monitor, range(2))
    monitor.take(Finding("imu-readings", "", 2))
    assert {e.integrity for e in judge(monitor, range(2, 30))} == {"degraded"}


def test_an_event_without_an_end_counts_for_a_second() -> None:
    monitor = IntegrityMonitor()
    monitor.take(Finding("estimate-restarted", "", 0))
    states = [e.integrity for e in judge(monitor, range(15))]
    assert states == ["degraded"] * 10 + ["nominal"] * 5


def test_innovations_beyond_what_is_stated_inflate_the_covariance() -> None:
    """What it grows by meanwhile is larger by as much, until measurements make it known again."""
    monitor = IntegrityMonitor()

    def variances(ratio: float, stated: list[float]) -> list[float]:
        found = []
        for k, variance in enumerate(stated):
            monitor.take_innovation(ratio)
            given = replace(estimate(k), covariance=variance * np.eye(6))
            judged = monitor.judged(k, given)
            assert judged.integrity == "nominal"
            found.append(float(judged.covariance[0, 0]))
        return found

    usual = [1e-4, 2e-4, 1e-4, 2e-4, 3e-4]
    assert variances(2.0, usual) == usual
    assert variances(30.0, [4e-4]) == [4e-4]  # a shock
    assert variances(1.0, 5 * [4e-4]) == 5 * [4e-4]
    assert variances(6.0, [4e-4, 4e-4, 4e-4, 4e-4, 5e-4])[-1] == pytest.approx(5e-4 + 8e-4)
    assert variances(1.0, 6 * [5e-4])[-1] == pytest.approx(5e-4 + 8e-4)
    assert variances(1.0, [2.5e-4])[-1] == pytest.approx(2.5e-4 + 4e-4)
    again = IntegrityMonitor()
    again.go_on_from(monitor, [])
    monitor = again
    assert variances(1.0, [2.5e-4]) == [2.5e-4]


def test_distances_without_a_scale_are_uncertain_by_its_walk() -> None:
    """0.2 m a frame; a walk of 0.5 % in a frame is 5 % after 100."""
    monitor = IntegrityMonitor()

    def sigmas(frames: range, measured: bool | None) -> list[float]:
        found = []
        for k in frames:
            monitor.take_scale(measured=measured)
            judged = monitor.judged(k, replace(estimate(k), covariance=np.zeros((6, 6))))
            found.append(float(np.sqrt(judged.covariance[0, 0])))
        return found

    assert sigmas(range(10), True) == 10 * [0.0]
    walk = sigmas(range(10, 110), False)
    # the sum of a walk over n frames has a variance of n^3 / 3
    assert walk[-1] == pytest.approx(0.2 * 0.005 * np.sqrt(100**3 / 3), rel=0.02)
    assert sigmas(range(110, 115), None)[-1] > walk[-1]  # nothing is seen: it is not known again
    before = sigmas(range(115, 116), False)[0]
    # lengths are measured again, where the rig is is not
    assert sigmas(range(116, 130), True) == pytest.approx(14 * [before])


def test_information_leaves_an_estimate_nominal() -> None:
    monitor = IntegrityMonitor()
    monitor.take(Finding("stereo-calibration-off", "", 0))
    assert judge(monitor, range(1))[0].integrity == "nominal"


def test_the_worst_of_several_findings_counts() -> None:
    monitor = IntegrityMonitor()
    monitor.take(Finding("right-image-frozen", "", 0, lasts=True))
    monitor.take(Finding("object-or-scene", "", 0, lasts=True))
    (judged,) = judge(monitor, range(1))
    assert judged.integrity == "unusable"
    assert judged.findings == ("object-or-scene", "right-image-frozen")


def test_an_unusable_covariance_covers_any_motion_since_the_fault_began() -> None:
    monitor = IntegrityMonitor()
    judge(monitor, range(5))  # 2 m/s
    monitor.take(Finding("object-or-scene", "", 5, lasts=True))
    held = judge(monitor, range(5, 26))
    elapsed_s = 20 * STEP_NS * 1e-9
    sigma = float(np.sqrt(held[-1].covariance[0, 0]))
    assert sigma == pytest.approx(2.0 * elapsed_s, rel=0.01)
    assert np.sqrt(held[0].covariance[0, 0]) < 0.02
    # the motion is known again, where it began is not
    monitor.take(Finding("object-or-scene", "", 26, ended=True))
    (after, later) = judge(monitor, range(26, 28))
    assert after.integrity == "nominal"
    assert after.findings == ()
    for estimate_after in (after, later):
        assert np.sqrt(estimate_after.covariance[0, 0]) == pytest.approx(sigma, rel=1e-6)
    # a second fault adds to it, from the frame that it began at
    monitor.take(Finding("object-or-scene", "", 38, 28, lasts=True))
    judge(monitor, range(28, 38))
    (again,) = judge(monitor, range(38, 39))
    expected = np.hypot(sigma, 2.0 * 10 * STEP_NS * 1e-9)
    assert np.sqrt(again.covariance[0, 0]) == pytest.approx(expected, rel=0.01)


def test_frames_before_a_fault_was_found_are_marked() -> None:
    monitor = IntegrityMonitor()
    judge(monitor, range(8))
    monitor.take(Finding("right-contradicts-left", "", 8, 5, lasts=True))
    judge(monitor, range(8, 9))
    assert monitor.take_marks() == (Mark(5, 8, "degraded", "right-contradicts-left"),)
    assert monitor.take_marks() == ()
    late = marked(estimate(6), Mark(5, 8, "unusable", "pairs-shifted", share=1.0), 3.0)
    assert late.integrity == "unusable"
    assert late.covariance[1, 1] == pytest.approx(9.0, rel=1e-3)


def test_what_the_end_of_a_run_shows_of_all_frames_marks_them() -> None:
    """A scale that is off is off from the start, however late it was found."""
    monitor = IntegrityMonitor()
    for k in range(5):
        monitor.judged(k, estimate(k))
    monitor.take(Finding("scale-off", "40 times too long", 4, since=0, lasts=True))
    monitor.take(Finding("imu-clock", "apart", 4))
    monitor.close(4)
    assert monitor.take_marks() == (Mark(0, 5, "degraded", "scale-off"),)


def test_a_new_state_ends_what_was_found_of_the_old_one_and_nothing_else() -> None:
    """A scale that is off since the first frame is the rig's; one that the lost state showed since
    the last good estimate is not.
    """
    monitor = IntegrityMonitor()
    judge(monitor, range(5))
    monitor.take(Finding("scale-off", "of the rig", 5, since=0, lasts=True))
    monitor.take(Finding("estimate-implausible", "", 5, lasts=True))
    assert judge(monitor, range(5, 6))[0].integrity == "unusable"
    monitor.end_since(estimate(4).time_ns, "estimate-implausible", "scale-off")
    (after,) = judge(monitor, range(6, 7))
    assert (after.integrity, after.findings) == ("degraded", ("scale-off",))
    monitor.end_since(estimate(0).time_ns - 1, "scale-off")
    assert judge(monitor, range(7, 8))[0].integrity == "nominal"


def test_unknown_codes_are_refused() -> None:
    with pytest.raises(ConfigError, match="no finding 'something'"):
        Finding("something", "")


def test_a_finding_as_plain_values() -> None:
    finding = Finding("right-image-late", "text", 7, figures={"delay_ms": 5.0}, lasts=True)
    plain = finding.to_json()
    assert (plain["code"], plain["frame"], plain["since"]) == ("right-image-late", 7, 7)
    assert plain["effect"] == "degraded"
    assert plain["figures"] == {"delay_ms": 5.0}


def test_the_position_covariance_is_that_of_drawn_poses() -> None:
    rng = np.random.default_rng(1)
    root = 0.01 * rng.normal(size=(6, 6))
    T_world_imu = se3_exp([1.0, -2.0, 0.5, 0.4, 1.1, -0.3])
    given = Estimate(0, T_world_imu, root @ root.T)
    T_imu_world = se3_inverse(T_world_imu)
    drawn = [
        se3_inverse(se3_exp(root @ rng.normal(size=6)) @ T_imu_world)[:3, 3] for _ in range(4000)
    ]
    np.testing.assert_allclose(np.cov(np.array(drawn).T), position_covariance(given), atol=2e-5)


def test_a_protection_level_contains_the_position_as_often_as_stated() -> None:
    rng = np.random.default_rng(2)
    sigma = np.array([0.3, 0.3, 0.1])
    given = Estimate(0, np.eye(4), np.diag([*sigma**2, 0, 0, 0]).astype(float), tilt_sigma_rad=0.01)
    level = protection_level(given, 0.95)
    errors = rng.normal(size=(20000, 3)) * sigma
    inside = np.hypot(errors[:, 0], errors[:, 1]) <= level.horizontal_m
    assert inside.mean() == pytest.approx(0.95, abs=0.006)
    assert (np.abs(errors[:, 2]) <= level.vertical_m).mean() == pytest.approx(0.95, abs=0.006)


def test_without_an_imu_up_is_that_of_the_first_image() -> None:
    given = Estimate(0, np.eye(4), np.diag([1e-4, 4.0, 1e-4, 0, 0, 0]).astype(float))
    level = protection_level(given)
    assert level.vertical_m > 5.0
    assert level.horizontal_m < 0.1
    with pytest.raises(ConfigError, match=r"in \(0, 1\)"):
        protection_level(given, 1.0)


def test_the_page_of_findings_is_that_of_todays_codes() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), (
        "run: python -m tools.findings_page > docs/findings.md"
    )
    assert all(f"| `{name}` |" in page() for name in CODES)


# The scale


def scales_of(doubts: list[float]) -> list[float]:
    """What each frame's covariance has of the scale's doubt in the end, by its own and by marks."""
    monitor = IntegrityMonitor()
    variance = np.zeros(len(doubts))
    for k, doubt in enumerate(doubts):
        monitor.take_scale_doubt(k, doubt)
        for mark in monitor.take_marks():
            assert mark.before <= k
            variance[mark.since : mark.before] += mark.scale**2
        variance[k] += doubt**2
    return np.sqrt(variance).tolist()


@pytest.mark.parametrize(
    "doubts",
    [
        [0.0, 0.0, 0.03, 0.03, 0.08, 0.08],
        [0.0, 0.1, 0.001, 0.0, 0.05, 0.05],  # the first frames were misled
        [0.0, 0.02, 0.01, 0.03, 0.0, 0.015, 0.06],
    ],
)
def test_earlier_frames_get_what_later_ones_say_of_the_scale(doubts: list[float]) -> None:
    """To within a level, and hardly more than that of any frame."""
    final = scales_of(doubts)
    for k, sigma in enumerate(final):
        assert sigma >= max(doubts[k:]) / 1.5
        assert sigma <= 1.5 * max(doubts)


def test_a_small_doubt_of_the_scale_marks_nothing() -> None:
    monitor = IntegrityMonitor()
    for k in range(10):
        monitor.take_scale_doubt(k, 0.004)
    assert monitor.take_marks() == ()


def test_a_mark_of_the_scale_changes_the_covariance_alone() -> None:
    given = estimate(3)
    changed = marked(given, Mark(0, 5, "nominal", None, 0.05), 0.1)
    assert (changed.integrity, changed.findings) == ("nominal", ())
    np.testing.assert_allclose(
        np.diag(changed.covariance - given.covariance), [0.01, 0.01, 0.01, 0, 0, 0]
    )


def test_an_hour_of_frames_takes_little_memory() -> None:
    """A live run has no end; what began with an early frame is still known."""
    count = 20_000
    monitor = IntegrityMonitor()
    tracemalloc.start()
    for k in range(count):
        monitor.judged(k, estimate(k))
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 40 * count
    finding = Finding("images-held", "", count, 10)
    assert finding.effect == "unusable"
    monitor.take(finding)
    held = monitor.judged(count, estimate(count))
    moved_m = 2.0 * (count - 10) * STEP_NS * 1e-9
    assert np.sqrt(held.covariance[0, 0]) == pytest.approx(moved_m, rel=1e-3)


def test_a_share_of_the_motion_stays_in_doubt_after_its_finding_has_ended() -> None:
    """0.2 m a frame, of which a quarter is in doubt from frame 4 to 9."""
    monitor = IntegrityMonitor()
    judge(monitor, range(6))
    figures = {"doubted_share": 0.25}
    monitor.take(Finding("tracks-disagree", "", 6, 4, lasts=True, figures=figures))
    held = judge(monitor, range(6, 10))
    monitor.take(Finding("tracks-disagree", "", 10, ended=True))
    after = judge(monitor, range(10, 20))
    assert {e.integrity for e in held} == {"degraded"}
    assert {e.integrity for e in after} == {"nominal"}
    sigmas = [float(np.sqrt(e.covariance[0, 0])) for e in (*held, *after)]
    assert sigmas[0] == pytest.approx(0.25 * 0.4, rel=0.01)
    assert sigmas[3:] == pytest.approx(11 * [0.25 * 1.0], rel=0.01)
    assert monitor.take_marks() == (Mark(4, 6, "degraded", "tracks-disagree", share=0.25),)


def test_an_event_does_not_doubt_all_motion_since_a_small_share_of_it_was_in_doubt() -> None:
    """0.2 m a frame: a tenth of 60 frames, all of 3 frames before a second, and that second."""
    monitor = IntegrityMonitor()
    judge(monitor, range(1))
    figures = {"doubted_share": 0.1}
    monitor.take(Finding("tracks-disagree", "", 1, 0, lasts=True, figures=figures))
    judge(monitor, range(1, 61))
    monitor.take(Finding("view-changed", "", 61, 57))
    judge(monitor, range(61, 62))
    monitor.take(Finding("tracks-disagree", "", 62, ended=True))
    after = judge(monitor, range(62, 120))
    assert after[-1].integrity == "nominal"
    within_s = sum(e.integrity == "unusable" for e in after)
    doubted = 0.1 * 61 + 0.9 * 4 + within_s
    sigma_m = float(np.sqrt(after[-1].covariance[0, 0]))
    assert sigma_m == pytest.approx(0.2 * doubted, rel=0.01)


def test_a_doubt_that_is_said_again_goes_on() -> None:
    """0.2 m a frame, as an event of the same code follows before the one before it is over."""
    monitor = IntegrityMonitor()
    judge(monitor, range(4))
    for k in range(4, 20, 4):
        monitor.take(Finding("view-changed", "", k))
        last = judge(monitor, range(k, k + 4))[-1]
    assert float(np.sqrt(last.covariance[0, 0])) == pytest.approx(0.2 * 15, rel=0.01)
