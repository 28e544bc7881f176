"""Estimates of the stereo calibration that move further than they may, and what positions may be
off by then.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vio.cameras.rectification_error import ErrorColumns
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.monitor.calibration_drift import CalibrationDrift, ScaleDrift
from vio.monitor.integrity import IntegrityMonitor
from vio.monitor.run import RunMonitor
from vio.numerics.statistics import chi_square_quantile
from vio.records import (
    FIELD_TERMS,
    Estimate,
    Observations,
    StereoFieldEstimate,
    UpdateReport,
    observations,
)

CAMERA = StereoCamera(fu=400.0, fv=400.0, cu=320.0, cv=240.0, baseline_m=0.1, width=640, height=480)
PRIOR_SIGMA = 2e-3
KNOWN_SIGMA = 2e-4


def seen(k: int, disparity_px: float = 8.0) -> Observations:
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(60, 600, 8), np.linspace(40, 440, 6)))
    z = np.column_stack([u, v, u - disparity_px, v])
    return observations(k, k * 50_000_000, np.arange(len(z)), z)


def estimate(k: int, coefficients: FloatArray, sigma: float) -> Estimate:
    field = StereoFieldEstimate(coefficients, sigma**2 * np.eye(FIELD_TERMS))
    T = np.eye(4)
    T[2, 3] = 0.1 * k
    return replace(Estimate(k * 50_000_000, T, 1e-8 * np.eye(6)), stereo_field=field)


def drifts(field_of: list[FloatArray], sigma_of: list[float]) -> list[ScaleDrift]:
    check = CalibrationDrift(CAMERA)
    return [
        check.frame(seen(k), estimate(k, x, s))
        for k, (x, s) in enumerate(zip(field_of, sigma_of, strict=True))
    ]


def constant_yaw(yaw: float) -> FloatArray:
    x = np.zeros(FIELD_TERMS)
    x[0] = yaw
    return x


def test_an_estimate_that_converges_is_in_no_doubt() -> None:
    """Its prior was off by three standard deviations, and it is learned within ten frames."""
    fields = [constant_yaw(3 * PRIOR_SIGMA * min(k / 10, 1.0)) for k in range(80)]
    sigmas = [max(PRIOR_SIGMA * (1.0 - k / 10), KNOWN_SIGMA) for k in range(80)]
    found = drifts(fields, sigmas)
    assert max(d.share for d in found[20:]) == 0.0
    assert drifts([constant_yaw(0.0)] * 20 + [constant_yaw(KNOWN_SIGMA)] * 20, sigmas[10:50])[
        -1
    ] == ScaleDrift(0.0, 0)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_camera_that_sags_leaves_lengths_in_doubt_by_what_disparities_are_off(
    sign: float,
) -> None:
    """0.1 degrees move all disparities by 0.7 of 8 px."""
    yaw = sign * np.radians(0.1)
    ramp = [constant_yaw(yaw * np.clip((k - 40) / 15, 0.0, 1.0)) for k in range(80)]
    found = drifts(ramp, [PRIOR_SIGMA] + [KNOWN_SIGMA] * 79)
    assert max(d.share for d in found[:41]) == 0.0
    off = 400.0 * abs(yaw) / 8.0
    largest = max(found, key=lambda d: d.share)
    assert 0.9 * off < largest.share < off
    assert largest.frames in (20, 40)
    assert found[-1].share > 0.9 * off  # a later frame still sees it over forty frames


def test_terms_that_move_and_leave_lengths_as_they_are_enlarge_what_is_stated() -> None:
    """A term of which disparities on both sides are off in turn."""
    tilt = np.zeros(FIELD_TERMS)
    tilt[1] = 100 * KNOWN_SIGMA
    found = drifts([0 * tilt] * 20 + [tilt] * 20, [PRIOR_SIGMA] + [KNOWN_SIGMA] * 39)
    assert max(d.share for d in found[:20]) == 0.0
    assert found[25].share > 5 * KNOWN_SIGMA * 400.0 / 8.0


def test_terms_that_move_enlarge_what_is_stated_now() -> None:
    """Healthy fisheye lenses at streets came to eleven times the sigma by what was stated before."""
    tilt = np.zeros(FIELD_TERMS)
    tilt[1] = 40 * KNOWN_SIGMA
    before, now = 4 * KNOWN_SIGMA, KNOWN_SIGMA
    sigmas = [PRIOR_SIGMA] + [before] * 19 + [now] * 20
    found = drifts([0 * tilt] * 20 + [tilt] * 20, sigmas)[20]
    factor = np.sqrt((tilt[1] / before) ** 2 / chi_square_quantile(0.999, FIELD_TERMS) - 1.0)
    z = seen(0).z
    disparity = z[:, 0] - z[:, 2]
    J = ErrorColumns(CAMERA, np.arange(FIELD_TERMS)).jacobian(z)
    by_field = disparity @ (J[:, 0] - J[:, 2]) / (disparity @ disparity)
    assert found.share == pytest.approx(factor * now * np.linalg.norm(by_field))


def test_a_back_end_that_holds_terms_constant_is_judged_by_the_others() -> None:
    covariance = np.zeros((FIELD_TERMS, FIELD_TERMS))
    check = CalibrationDrift(CAMERA)
    for k in range(40):
        yaw = 0.0 if k < 30 else 0.01
        covariance[0, 0] = (PRIOR_SIGMA if k == 0 else KNOWN_SIGMA) ** 2
        field = StereoFieldEstimate(constant_yaw(yaw), covariance.copy())
        given = replace(estimate(k, constant_yaw(yaw), KNOWN_SIGMA), stereo_field=field)
        share = check.frame(seen(k), given).share
        assert (share > 0.4) == (k >= 30)  # of 0.5


def test_without_right_pixels_or_a_field_nothing_is_judged() -> None:
    check = CalibrationDrift(CAMERA)
    for k in range(60):
        now = seen(k)
        blind = replace(now, has_right=np.zeros(len(now), dtype=np.bool_))
        yaw = constant_yaw(0.0 if k < 30 else 0.01)
        assert check.frame(blind, estimate(k, yaw, KNOWN_SIGMA)).share == 0.0
        bare = replace(estimate(k, yaw, KNOWN_SIGMA), stereo_field=None)
        assert CalibrationDrift(CAMERA).frame(now, bare).share == 0.0


def sigmas_m(doubted: range, frames: int = 100, share: float = 0.02) -> FloatArray:
    monitor = IntegrityMonitor()
    out = []
    for k in range(frames):
        monitor.take_drift(share if k in doubted else 0.0, 20)
        judged = monitor.judged(k, estimate(k, constant_yaw(0.0), KNOWN_SIGMA))
        assert judged.integrity == "nominal"
        out.append(np.sqrt(judged.covariance[0, 0] - 1e-8))
    return np.array(out)


def test_positions_are_in_doubt_by_the_path_on_which_the_calibration_moved() -> None:
    """Steps of 0.1 m; the doubt is seen from frame 50 to 59 and looks 20 frames back."""
    found = sigmas_m(range(50, 60))
    np.testing.assert_array_equal(found[:50], 0.0)
    share = found[50] / (20 * 0.1)
    assert 0.02 / 1.5 <= share <= 0.02
    np.testing.assert_allclose(found[59:], share * 29 * 0.1)


def test_a_doubt_below_what_is_stated_anyway_changes_nothing() -> None:
    np.testing.assert_array_equal(sigmas_m(range(50, 60), share=0.002), 0.0)


def test_frames_before_a_drift_was_seen_are_marked_once() -> None:
    monitor = IntegrityMonitor()
    marks = []
    for k in range(100):
        monitor.take_drift(0.02 if k >= 50 else 0.0, 20)
        monitor.judged(k, estimate(k, constant_yaw(0.0), KNOWN_SIGMA))
        marks += monitor.take_marks()
    assert [(m.since, m.before, m.integrity) for m in marks] == [(30, 50, "nominal")]
    assert 0.02 / 1.5 <= marks[0].share <= 0.02


def test_a_run_states_what_a_camera_that_sags_lets_positions_be_off_by() -> None:
    """Half of the 8 px at the end, over 40 frames and 4 m; without a sag nothing is added."""
    for yaw, least_m, most_m in ((0.0, 0.0, 0.0), (0.01, 0.5, 4.0)):
        monitor = RunMonitor(CAMERA, np.eye(4), imu=False)
        for k in range(80):
            now = constant_yaw(yaw * np.clip((k - 40) / 20, 0.0, 1.0))
            given = estimate(k, now, PRIOR_SIGMA if k == 0 else KNOWN_SIGMA)
            monitor.observations(seen(k))
            monitor.update(k, UpdateReport(48, 0, 0, 0, 0.1, 1.0), given, measured=False)
            judged = monitor.judged(k, given)
        sigma_m = np.sqrt(max(judged.covariance[0, 0] - given.covariance[0, 0], 0.0))
        assert judged.integrity == "nominal"
        assert least_m <= sigma_m <= most_m


@pytest.mark.parametrize("anew", [False, True])
def test_a_new_start_of_the_filter_is_no_drift_of_the_calibration(anew: bool) -> None:
    """It gives up what it knew, so estimates vary by more than was stated before."""
    rng = np.random.default_rng(3)
    monitor = RunMonitor(CAMERA, np.eye(4), imu=False)
    for k in range(80):
        sigma = PRIOR_SIGMA if k == 0 or 40 <= k < 50 else KNOWN_SIGMA
        given = estimate(k, sigma * rng.standard_normal(FIELD_TERMS) / 2, sigma)
        monitor.observations(seen(k))
        if k == 40 and anew:
            monitor.begun_anew(k, given.time_ns - 50_000_000, given)
        elif k == 40:
            monitor.restarted(k, "it diverged", given)
        monitor.update(k, UpdateReport(48, 0, 0, 0, 0.1, 1.0), given, measured=False)
        monitor.judged(k, given)
    assert all(mark.integrity != "nominal" for mark in monitor.take_marks())
