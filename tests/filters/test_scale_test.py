"""The scale of the calibrated baseline against that of IMU or velocities: found where it is off,
silent where not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.filters.test_filter_truth import CAMERA, SETTINGS, T_CAM0_IMU, Course, fly
from tests.filters.test_online_calibration import CAMERA as HAND_HELD
from tests.filters.test_online_calibration import OFF, Shaking, _fly
from vio.filters.msckf import Msckf
from vio.filters.prior import Prior
from vio.filters.scale_test import ScaleTest
from vio.geometry.stereo import StereoCamera
from vio.records import Observations, StereoScaleEstimate, VelocitySample

CAR = Course(
    10, 4.0, velocity=(4.0, 0.5, 0.0), yaw_rate=0.05, depth=(4.0, 40.0), pixel_sigma_px=0.3
)


def _drive(camera: StereoCamera) -> StereoScaleEstimate | None:
    """What a drive along `CAR` with velocities at 50 Hz finds of the scale."""
    rng, filt = np.random.default_rng(0), Msckf(camera, T_CAM0_IMU, SETTINGS, motion="velocity")
    for k in range(CAR.frames):
        for j in range(max(5 * k - 4, 0), 5 * k + 1):
            R, turn = CAR.pose(j / 50)[:3, :3], np.array([0.0, 0.0, CAR.yaw_rate])
            v, rate = R.T @ CAR.velocity + rng.normal(0, 0.5, 3), turn + rng.normal(0, 0.05, 3)
            filt.propagate(VelocitySample(j * 20_000_000, v, rate))
        filt.update(CAR.observe(k, rng))
    return filt.estimate().stereo_scale


def test_velocities_find_a_baseline_that_is_off_by_10_percent() -> None:
    short = replace(CAMERA, baseline_m=CAMERA.baseline_m / 1.1)
    scale = _drive(short)
    percent, sigma = scale.percent()["baseline"]
    assert abs(percent - 10.0) < 3 * sigma
    assert percent > 5 * sigma
    assert _drive(CAMERA) is None


def test_an_imu_finds_a_baseline_that_is_off_by_10_percent() -> None:
    flight, short = Shaking(240), replace(HAND_HELD, baseline_m=HAND_HELD.baseline_m / 1.1)
    run = _fly(flight, OFF, 0, xi=np.zeros(6), offset_s=0.0, camera=short)
    scale = run.estimates[-1].stereo_scale
    percent, sigma = scale.percent()["baseline"]
    assert abs(percent - 10.0) < 3 * sigma
    assert percent > 5 * sigma
    assert _fly(flight, OFF, 0, xi=np.zeros(6), offset_s=0.0).estimates[-1].stereo_scale is None


def test_relinearised_images_alone_say_nothing_of_the_scale() -> None:
    """With errors of a world that keeps its scale, whose direction follows the estimates, 2 of
    the 10 % were left.
    """
    sigmas: list[float] = []

    def each(run: object) -> None:
        window = run.filter._window  # type: ignore[attr-defined]
        if window.prior.scale_test is None:
            window.prior.scale_test = ScaleTest()
        sigmas.append(window.prior.scale_test.estimate()[1])

    fly(
        Course(20, 2.5, velocity=(0.5, 0.3, 0.0), yaw_rate=0.3, pixel_sigma_px=0.3), None, each=each
    )
    assert sigmas[-1] > 0.99 * sigmas[0]


def test_nothing_is_said_of_the_baseline_without_right_views() -> None:
    """The scale is the sensor's then; 6 s of a flight from left images ended 17 % off, laid on
    the baseline.
    """

    def left_only(k: int, seen: Observations) -> Observations:
        return replace(seen, has_right=np.zeros(len(seen), dtype=np.bool_))

    window = fly(Course(20, 0.3), "imu", spoil=left_only).filter._window
    assert window.prior.scale_test is None


def test_the_noise_of_a_standstill_is_no_motion() -> None:
    """Zero velocity is zero at any scale; the accelerometer's noise is worth less than one of
    information a frame.
    """
    run = fly(Course(20, 2.0, pixel_sigma_px=0.3), "imu")
    test = run.filter._window.prior.scale_test  # type: ignore[union-attr]
    assert test.estimate()[1] ** -2 - 0.1**-2 < run.course.frames
    assert run.estimates[-1].stereo_scale is None


@pytest.mark.parametrize("scaled", [False, True])
def test_the_test_equals_a_filter_with_the_scale_as_a_state(scaled: bool) -> None:
    """Two measurements of four errors, some of which depend on the scale; against dense
    equations in five unknowns.
    """
    rng, D, sigma = np.random.default_rng(3), 4, 0.1
    P, moved = np.diag(rng.uniform(0.5, 2.0, D)), rng.normal(size=D) * scaled
    prior = Prior(P)
    prior.scale_test = ScaleTest()
    prior.error_D_constants[:, 0] = rng.normal(size=D)
    joint, vector = np.zeros((D + 1, D + 1)), np.zeros(D + 1)
    J = np.column_stack([np.eye(D), -prior.error_D_constants[:, 0]])  # the prior: x - V s
    joint += J.T @ np.linalg.solve(P, J)
    joint[D, D] += sigma**-2
    for _ in range(2):
        H, r = rng.normal(size=(2, D)), rng.normal(size=2)
        prior.absorb(H.T @ H, H.T @ r, scaled=moved if scaled else None)
        row = np.column_stack([H, H @ moved])
        joint, vector = joint + row.T @ row, vector + row.T @ r
    covariance = np.linalg.inv(joint)
    s, s_sigma = prior.scale_test.estimate()
    np.testing.assert_allclose(s, (covariance @ vector)[D])
    np.testing.assert_allclose(s_sigma, np.sqrt(covariance[D, D]))
    V = prior.error_D_constants[:, 0]
    np.testing.assert_allclose(V * s_sigma**2, covariance[:D, D])
    np.testing.assert_allclose(V * s - prior.delta, (covariance @ vector)[:D])


def test_information_that_rounding_makes_negative_is_passed_over() -> None:
    """Found by the soak, after a clock that stepped by an hour: complex standard deviations ended
    the node.
    """
    test = ScaleTest()
    before = test.estimate()
    W = np.array([1e16])
    P = np.array([[1e-16 * (1 + 1e-7)]])
    test.absorb(np.ones(1), W, np.array([1e12]), P)
    test.end_frame()
    assert test.estimate() == before
    assert not test.is_confirmed


def measured(log: float, sigma: float) -> ScaleTest:
    """A test that has measured a logarithm of the scale with a standard deviation."""
    test = ScaleTest()
    H = np.array([1.0])
    test.absorb(H, H / sigma**2, np.array([log / sigma**2]), np.zeros((1, 1)))
    return test


def test_without_a_measurement_the_calibrated_scale_counts() -> None:
    assert ScaleTest().doubt() == 0.0


def test_the_doubt_is_the_mixture_of_a_right_and_a_wrong_calibration() -> None:
    """Its weights by sampling: calibrations are drawn, and those kept that show what was measured."""
    log, sigma = 0.05, 0.02
    rng = np.random.default_rng(5)
    draws = 2_000_000
    is_wrong = rng.random(draws) < 0.25
    scale = np.where(is_wrong, rng.normal(0.0, 0.1, draws), 0.0)
    shown = scale + rng.normal(0.0, np.where(is_wrong, sigma, np.hypot(sigma, 0.02)))
    kept = np.abs(shown - log) < 0.002
    mean = scale[kept & is_wrong].mean()
    expected = np.sqrt(is_wrong[kept].mean()) * mean
    assert measured(log, sigma).doubt() == pytest.approx(expected, rel=0.05)


def test_the_doubt_covers_what_is_measured_clearly_and_is_small_where_the_sensor_agrees() -> None:
    assert measured(0.08, 0.01).doubt() > 0.07
    assert measured(0.01, 0.01).doubt() < 0.005


def test_what_an_imu_says_of_a_wrong_baseline_is_in_the_covariance() -> None:
    flight = Shaking(240)
    settings = replace(OFF, stereo_baseline_sigma=0.003)
    short = replace(HAND_HELD, baseline_m=HAND_HELD.baseline_m / 1.1)
    for camera, low, high in ((short, 0.05, 0.15), (HAND_HELD, 0.0, 0.02)):
        run = _fly(flight, settings, 0, xi=np.zeros(6), offset_s=0.0, camera=camera)
        last = max(run.estimates[200:], key=lambda e: float(np.linalg.norm(e.T_world_imu[:3, 3])))
        sigma_m = float(np.sqrt(np.trace(last.covariance[:3, :3])))
        share = sigma_m / float(np.linalg.norm(last.T_world_imu[:3, 3]))
        assert low <= share <= high


def after(frames: int, information: float, vector: float) -> ScaleTest:
    """A test after some frames, with what their measurements add up to."""
    test = measured(vector / information, information**-0.5)
    for _ in range(frames):
        test.end_frame()
    return test


def test_what_the_sensors_noise_explains_is_hardly_any_doubt() -> None:
    """A second of slow motion: its information may be that of the accelerometer's noise."""
    assert after(0, 36.0, 21.6).doubt() > 0.05
    assert after(40, 36.0, 21.6).doubt() < 0.03
    assert after(1000, 100.0, 90.0).doubt() < 0.03  # standstill


def test_the_share_of_noise_in_what_was_measured_is_not_known() -> None:
    """By sampling: calibrations and shares are drawn, and those kept that show what was measured."""
    frames, information, vector = 97, 2091.0, -59.0  # a flight of a baseline 10 % too long
    rng = np.random.default_rng(5)
    draws = 2_000_000
    is_wrong = rng.random(draws) < 0.25
    scale = rng.normal(0.0, np.where(is_wrong, 0.1, 0.02))
    by_noise = frames * rng.uniform(0.1, 1.0, draws)
    by_motion = information - by_noise
    shown = by_noise + by_motion * scale + np.sqrt(by_motion) * rng.normal(size=draws)
    kept = np.abs(shown - vector) < 4.0
    mean = (vector - by_noise[kept & is_wrong]) / (by_motion[kept & is_wrong] + 100.0)
    expected = np.sqrt(is_wrong[kept].mean() * (mean**2).mean())
    assert after(frames, information, vector).doubt() == pytest.approx(expected, rel=0.1)


def test_noise_may_hide_that_the_scale_is_smaller() -> None:
    """Noise passes for a larger scale only: it makes up for a part of one that is smaller."""
    assert after(97, 2091.0, -59.0).doubt() > 2.0 * after(0, 2091.0, -59.0).doubt()


def test_what_a_diverged_filter_says_of_the_scale_is_passed_over() -> None:
    test = ScaleTest()
    for remaining in (2.0, np.nan, np.inf):
        test.absorb(np.ones(1), 400.0 * np.ones(1), np.array([remaining]), np.zeros((1, 1)))
        assert np.allclose(test.estimate(), (2.0 / 500.0, 500.0**-0.5))
