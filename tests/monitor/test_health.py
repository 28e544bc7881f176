"""Run monitoring: no output on plausible runs, one line per event on others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA
from vio.filters.stereo_calibration import VerticalDisparityModel
from vio.monitor.health import RunHealth, is_corrected
from vio.records import (
    Estimate,
    StereoFieldEstimate,
    StereoScaleEstimate,
    UpdateReport,
    observations,
)

GOOD = UpdateReport(50, 2, 1, 30, 0.3, 1.0)
EMPTY = UpdateReport(0, 0, 0, 30, None, None)
STEP_NS = 50_000_000


def _estimate(k: int, x: float | None = None, **more: object) -> Estimate:
    T = np.eye(4)
    T[0, 3] = 0.05 * k if x is None else x
    return replace(Estimate(k * STEP_NS, T, np.eye(6) * 1e-4), **more)  # type: ignore[arg-type]


def _lines(reports: list[UpdateReport]) -> list[str]:
    health = RunHealth()
    return [
        finding.message
        for k, report in enumerate(reports)
        for finding in health.frame(k, report, _estimate(k))
    ]


def test_a_plausible_run_gives_no_warning() -> None:
    # half a second without features is tolerated
    assert _lines([GOOD] * 50 + [EMPTY] * 10 + [GOOD] * 50) == []


def test_reports_when_features_are_missing_and_when_they_are_back() -> None:
    gone, back = _lines([GOOD] * 10 + [EMPTY] * 45 + [GOOD] * 10)
    assert "no usable feature since frame 9" in gone
    assert "standard deviation of its position is 0.02 m" in gone
    assert back == "frame 55: features again, after 2.3 s without"


@pytest.mark.parametrize(
    ("percent", "sigma", "word"),
    [(5.0, 0.1, "longer"), (-5.0, 0.1, "shorter"), (0.9, 0.1, None), (5.0, 2.0, None)],
)
def test_reports_once_a_focal_length_that_differs_beyond_doubt_and_beyond_harm(
    percent: float, sigma: float, word: str | None
) -> None:
    scale = StereoScaleEstimate(
        np.array([0.0, np.log1p(percent / 100)]), np.diag([0.0, (sigma / 100) ** 2])
    )
    health = RunHealth()
    found = [f for k in range(5) for f in health.scale(k, _estimate(k, stereo_scale=scale))]
    lines = [finding.message for finding in found]
    assert [
        f"frame 0: the focal length is 5.0 % {word} than calibrated" in line for line in lines
    ] == [True] * (word is not None)


def test_a_scale_that_is_off_is_laid_on_baseline_or_focal_length_where_nothing_tells_them_apart() -> (
    None
):
    scale = StereoScaleEstimate(np.array([np.log(1.1), 0.0]), np.diag([0.01**2, 0.0]))
    (finding,) = RunHealth().scale(0, _estimate(0, stereo_scale=scale))
    line = finding.message
    assert "the baseline, or the focal length, is 10.0 % longer than calibrated" in line
    assert "check the sensor (unit, axes, clock)" in line


@pytest.mark.parametrize(("left", "named"), [(0.35, True), (0.45, False), (1.7, False)])
def test_a_baseline_that_nearly_vanishes_beside_a_sensor_may_be_images_in_reverse_order(
    left: float, named: bool
) -> None:
    scale = StereoScaleEstimate(np.array([np.log(left), 0.0]), np.diag([0.01**2, 0.0]))
    (finding,) = RunHealth().scale(0, _estimate(0, stereo_scale=scale))
    assert ("check the order of the images (against" in finding.message) == named


@pytest.mark.parametrize(
    ("rows_px", "words"), [(4.3, "in a smooth pattern"), (26.0, "left and right are exchanged")]
)
def test_rows_that_no_rig_comes_to_are_not_laid_on_the_calibration_alone(
    rows_px: float, words: str
) -> None:
    field = StereoFieldEstimate(np.zeros(8), np.eye(8), rows_px)
    (finding,) = RunHealth().frame(0, GOOD, _estimate(0, stereo_field=field))
    line = finding.message
    assert f"frame 0: the rows of left and right images differ by {rows_px:.2f} px (rms)" in line
    assert words in line


def _reports_rows(off_px: float, matches: int, noise_px: float, seed: int) -> bool:
    """Whether rows that are off are reported by a second of frames."""
    rng = np.random.default_rng(seed)
    model = VerticalDisparityModel(CAMERA)
    health = RunHealth()
    left = rng.uniform([0.0, 0.0], [750.0, 480.0], (matches, 2))
    right = left - np.column_stack([rng.uniform(3.0, 60.0, matches), np.full(matches, -off_px)])
    pixels = np.concatenate([left, right], axis=1)
    codes = []
    for k in range(20):
        z = pixels + rng.normal(0.0, noise_px, pixels.shape)
        model.update(observations(k, k * 50_000_000, np.arange(matches), z))
        rows = model.without_common(np.zeros(8))
        field = StereoFieldEstimate(np.zeros(8), np.eye(8), model.stated_px, rows, model.covariance)
        codes += [f.code for f in health.frame(k, GOOD, _estimate(k, stereo_field=field))]
    return "stereo-calibration-off" in codes


@pytest.mark.parametrize(("matches", "noise_px"), [(35, 0.2), (60, 0.3), (120, 0.5)])
def test_rows_are_off_beyond_what_the_noise_of_few_matches_explains(
    matches: int, noise_px: float
) -> None:
    """Of exact calibrations, 9 to 44 % were called off by the fit to the first frame's noise."""
    assert not any(_reports_rows(0.0, matches, noise_px, seed) for seed in range(20))
    assert all(_reports_rows(0.4, matches, noise_px, seed) for seed in range(20))


def test_rows_that_come_out_as_those_of_another_pair_are_named_once_more() -> None:
    health = RunHealth()
    found = [
        finding.code
        for k, rows_px in enumerate((0.42, 4.3, 13.9, 13.9, 0.42))
        for finding in health.frame(
            k, GOOD, _estimate(k, stereo_field=StereoFieldEstimate(np.zeros(8), np.eye(8), rows_px))
        )
    ]
    assert found == ["stereo-calibration-off", "other-calibration"]


def test_what_a_run_corrects_of_the_calibration_is_no_warning() -> None:
    for rows_px, corrected in ((0.42, True), (4.3, False), (26.0, False)):
        field = StereoFieldEstimate(np.zeros(8), np.eye(8), rows_px)
        (finding,) = RunHealth().frame(0, GOOD, _estimate(0, stereo_field=field))
        assert is_corrected(finding) == corrected
        assert ("px (rms)" in finding.message) != corrected  # the end of the run states the size


def test_a_restart_is_one_event_and_its_jump_is_not_reported_as_a_speed() -> None:
    health = RunHealth()
    assert health.frame(0, GOOD, _estimate(0)) == ()
    (finding,) = health.restarted(1, "msckf diverged at frame 1", _estimate(1, x=50.0))
    line = finding.message
    assert line.startswith(
        "frame 1: msckf diverged at frame 1; started again from the last good pose"
    )
    assert "standard deviation of its position is 0.02 m" in line
    assert health.frame(1, GOOD, _estimate(1, x=50.0)) == ()
    assert health.restarted(5, "again", _estimate(5, x=50.0)) == ()
    assert len(health.restarted(40, "again", _estimate(40, x=50.0))) == 1


def test_new_landmarks_alone_do_not_end_a_gap_without_features() -> None:
    fresh = replace(EMPTY, initialised=5)
    _, back = _lines([GOOD] * 10 + [EMPTY] * 30 + [fresh] * 10 + [GOOD])
    assert back == "frame 50: features again, after 2.1 s without"


def _gaps(times_s: list[float]) -> list[str]:
    health = RunHealth()
    estimates = [replace(_estimate(k, 0.0), time_ns=round(1e9 * t)) for k, t in enumerate(times_s)]
    return [f.message for k, e in enumerate(estimates) for f in health.frame(k, GOOD, e)]


def test_reports_a_time_without_frames_once() -> None:
    (line,) = _gaps([0.05 * k for k in range(20)] + [3.95 + 0.05 * k for k in range(20)])
    assert line.startswith(
        "frame 20: no frame for 3.00 s since frame 19; the motion in between is a prediction"
    )
    assert "standard deviation of the position is 0.017 m" in line


def test_slow_irregular_or_dropped_frames_are_no_gap() -> None:
    assert _gaps([1.0 * k for k in range(20)]) == []
    assert _gaps([0.05 * k for k in range(60) if k % 9 < 5]) == []
    rng = np.random.default_rng(0)
    assert _gaps(np.cumsum(rng.uniform(0.3, 1.5, 50)).tolist()) == []


def test_two_gaps_without_features_are_two_events() -> None:
    assert len(_lines([GOOD] * 5 + [EMPTY] * 30 + [GOOD] * 5 + [EMPTY] * 30 + [GOOD])) == 4


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"x": 400.0}, "m/s: the filter has diverged"),
        (
            {"gyro_bias": np.array([0.0, 0.9, 0.0])},
            "gyro bias is estimated as 0.9 rad/s, which no working sensor has",
        ),
        (
            {"accel_bias": np.array([0.0, 0.0, -6.0])},
            "accelerometer bias is estimated as 6 m/s^2, which no",
        ),
    ],
)
def test_reports_an_implausible_state_once(more: dict[str, object], message: str) -> None:
    health = RunHealth()
    assert health.frame(0, GOOD, _estimate(0)) == ()
    (finding,) = health.frame(1, GOOD, _estimate(1, **more))  # type: ignore[arg-type]
    assert message in finding.message
    assert finding.message.endswith("calibration, units and clocks")
    assert health.frame(2, GOOD, _estimate(2, **more)) == ()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("off_s", "sigma_s", "found"),
    [(0.017, 0.0, 0), (-0.025, 0.0, 1), (0.025, 0.004, 0), (0.04, 0.004, 1), (0.3, None, 1)],
)
def test_an_offset_of_clocks_that_the_rates_contradict_is_implausible(
    off_s: float, sigma_s: float | None, found: int
) -> None:
    """Beyond what the rates can tell, and three of the filter's own standard deviations."""
    health = RunHealth()
    estimate = _estimate(30, time_offset_s=0.05, time_offset_sigma_s=sigma_s)
    assert health.clock(30, estimate, None, 12) == []
    findings = health.clock(30, estimate, 0.05 - off_s, 12)
    assert [(f.code, f.frame, f.first_frame, f.lasts) for f in findings] == [
        ("estimate-implausible", 30, 12, True)
    ] * found
    assert health.clock(31, estimate, 0.05 - off_s, 12) == []
    health.begun_anew(32, estimate.time_ns, estimate)
    assert len(health.clock(32, estimate, 0.05 - off_s, 12)) == found


def test_an_offset_that_is_not_estimated_is_not_judged() -> None:
    assert RunHealth().clock(30, _estimate(30), 0.3, 12) == []


def _ends(ratios: list[float | None], more: dict[int, dict[str, object]]) -> list[int]:
    """The frames at which an implausible state is reported to have ended."""
    health = RunHealth()
    found = []
    for k, ratio in enumerate(ratios):
        report = replace(GOOD, innovation_ratio=ratio)
        found += health.frame(k, report, _estimate(k, **more.get(k, {})))  # type: ignore[arg-type]
    assert [f.frame for f in found if not f.ended] == [2]
    return [f.frame for f in found if f.ended]


WRONG: dict[str, object] = {"gyro_bias": np.array([0.0, 0.9, 0.0])}


@pytest.mark.parametrize(
    ("off", "again"), [(None, 102), (40, 140), (41, 141)], ids=["at once", "40", "41"]
)
def test_a_state_that_has_been_possible_for_long_is_so_again(off: int | None, again: int) -> None:
    """Five seconds after the last frame with an impossible one, or whose images contradict it."""
    usual: list[float | None] = [1.1] * 160
    assert _ends(usual, {2: WRONG} if off is None else {2: WRONG, off: WRONG}) == [again]
    if off is not None:
        usual[off] = 2.2
        assert _ends(usual, {2: WRONG}) == [again]
        usual[off] = None
        assert _ends(usual, {2: WRONG}) == [again]
        usual[off] = 1.8
        assert _ends(usual, {2: WRONG}) == [102]


def test_a_clock_that_has_jumped_does_not_come_back_by_itself() -> None:
    health = RunHealth()
    report = replace(GOOD, innovation_ratio=1.0)
    estimate = replace(_estimate(0), time_offset_s=0.0, time_offset_sigma_s=0.001)
    assert health.clock(0, estimate, 0.1, 0)
    assert not any(health.frame(k, report, _estimate(k)) for k in range(200))
