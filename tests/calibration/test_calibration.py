"""Estimates against exact synthetic motion; unobservable values; faults of given calibrations."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from vio.calibration.egomotion import CameraMotion, _fit_motions, camera_motion
from vio.calibration.findings import NotObservable
from vio.calibration.gyro import align_gyro
from vio.calibration.inertial import ImuAlignment, rates_of
from vio.calibration.lever_arm import estimate_lever_arm
from vio.calibration.stereo import (
    RayMatches,
    StereoEstimate,
    epipolar_angles,
    join_matches,
    refine_stereo,
    row_residuals,
)
from vio.calibration.verdicts import judge_exchange, judge_imu, judge_stereo
from vio.cameras.projection import camera_args
from vio.evaluation.errors_along_path import rotation_angle_deg
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, se3_log, so3_exp
from vio.geometry.stereo import StereoCamera, project
from vio.offline import calibrate
from vio.offline.self_calibration import NAMES, SelfCalibration
from vio.records import FeatureTracks, ImuSample, feature_tracks
from vio.sim.imu import ImuNoise, simulate_imu
from vio.sim.motion import MotionSpline, hand_held, motion_at

T_CAM0_CAM1 = se3_from_parts(so3_exp([0.014, -0.002, 0.003]), [0.11, 0.0002, -0.0009])
SIGMA_RAD = 3e-4


def _matches(
    *,
    nearest_m: float = 1.5,
    farthest_m: float = 12.0,
    per_pair: int = 120,
    pairs: int = 12,
    outliers: float = 0.1,
) -> RayMatches:
    rng = np.random.default_rng(5)
    parts = []
    for pair in range(pairs):
        depth = rng.uniform(nearest_m, farthest_m, per_pair)
        plane = rng.uniform([-0.8, -0.5], [0.8, 0.5], (per_pair, 2))
        p0 = np.concatenate([plane, np.ones((per_pair, 1))], axis=1) * depth[:, None]
        p1 = (p0 - T_CAM0_CAM1[:3, 3]) @ T_CAM0_CAM1[:3, :3]
        wrong = rng.random(per_pair) < outliers
        p1[wrong] = p1[rng.permutation(per_pair)][wrong]
        rays = [p / np.linalg.norm(p, axis=1, keepdims=True) for p in (p0, p1)]
        rays = [r + SIGMA_RAD * rng.standard_normal(r.shape) for r in rays]
        parts.append(
            RayMatches(
                np.full(per_pair, pair),
                *(r / np.linalg.norm(r, axis=1, keepdims=True) for r in rays),
            )
        )
    return join_matches(parts)


def _direction(T: FloatArray) -> FloatArray:
    out: FloatArray = T[:3, 3] / np.linalg.norm(T[:3, 3])
    return out


@pytest.fixture(scope="module")
def matches() -> RayMatches:
    return _matches()


@pytest.fixture(scope="module")
def estimate(matches: RayMatches) -> StereoEstimate:
    start = so3_exp(np.radians([0.2, -0.2, 0.1])) @ T_CAM0_CAM1[:3, :3].T
    found = refine_stereo(matches, start, np.array([1.0, 0.0, 0.0]))
    assert isinstance(found, StereoEstimate)
    return found


# --- left and right
# -------------------------------------------------------------------------------------------------


def test_exact_rays_have_no_epipolar_angle() -> None:
    p0 = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 9], (50, 3))
    p1 = (p0 - T_CAM0_CAM1[:3, 3]) @ T_CAM0_CAM1[:3, :3]
    exact = RayMatches(
        np.zeros(50, dtype=np.int64),
        *(p / np.linalg.norm(p, axis=1, keepdims=True) for p in (p0, p1)),
    )
    assert (
        np.abs(epipolar_angles(T_CAM0_CAM1[:3, :3].T, _direction(T_CAM0_CAM1), exact)).max() < 1e-12
    )
    turned = epipolar_angles(
        so3_exp([0.01, 0, 0]) @ T_CAM0_CAM1[:3, :3].T, _direction(T_CAM0_CAM1), exact
    )
    assert np.median(np.abs(turned)) == pytest.approx(0.01, rel=0.1), (
        "a pitch of 10 mrad moves every ray off by that"
    )


def test_stereo_extrinsics_have_consistent_standard_deviations(estimate: StereoEstimate) -> None:
    turn = float(rotation_angle_deg(estimate.R_cam1_cam0 @ T_CAM0_CAM1[:3, :3]))
    swing = np.degrees(np.linalg.norm(np.cross(estimate.direction, _direction(T_CAM0_CAM1))))
    assert turn < max(0.05, 4 * estimate.rotation_sigma_deg)
    assert swing < max(0.1, 4 * estimate.direction_sigma_deg)
    # what a lens model may leave, which pairs cannot tell from yaw
    assert 0.15 < estimate.rotation_sigma_deg < 0.2
    assert estimate.rotation_sigmas_deg is not None
    pitch, yaw, roll = estimate.rotation_sigmas_deg.tolist()
    assert max(pitch, roll) < 0.02 < 0.2 < yaw < 0.4, "a tangential distortion looks like a yaw"
    assert 1000 < estimate.matches < 1350, "the gross outliers are left out"
    assert estimate.residual_deg == pytest.approx(np.degrees(SIGMA_RAD) * np.sqrt(2), rel=0.25)


def test_a_residual_distortion_of_a_wide_lens_is_no_wrong_baseline() -> None:
    matches = _matches(pairs=5, per_pair=300, outliers=0.0)
    off = np.arccos(matches.ray0[:, 2:])
    # 0.15 deg at the edge, 0 on the axis
    cubic = np.radians(0.15) * (off / np.quantile(off, 0.95)) ** 3
    across = matches.ray0[:, :2] / np.linalg.norm(matches.ray0[:, :2], axis=1, keepdims=True)
    bent = replace(
        matches, ray0=np.concatenate([np.sin(off + cubic) * across, np.cos(off + cubic)], axis=1)
    )
    found = refine_stereo(bent, T_CAM0_CAM1[:3, :3].T, _direction(T_CAM0_CAM1))
    swing = np.degrees(np.linalg.norm(np.cross(found.direction, _direction(T_CAM0_CAM1))))
    assert swing > 0.3, "the distortion passes for a direction of the baseline"
    assert swing < 3 * found.direction_sigma_deg
    assert judge_stereo(found, T_CAM0_CAM1, bent) == ()


@pytest.mark.parametrize(
    ("matches", "because"),
    [
        (_matches(per_pair=8, pairs=4), "too few, do not overlap, or have no texture"),
        (_matches(pairs=2), "in 2 pairs"),
        (_matches(nearest_m=400, farthest_m=2000, outliers=0.0), "all points may be far away"),
    ],
    ids=["few", "two pairs", "far away"],
)
def test_unobservable_extrinsics_give_a_reason(matches: RayMatches, because: str) -> None:
    found = refine_stereo(matches, T_CAM0_CAM1[:3, :3].T, _direction(T_CAM0_CAM1))
    assert isinstance(found, NotObservable)
    assert "not observable because" in str(found)
    assert because in str(found)


def _changed(turn_deg: tuple[float, float, float] = (0, 0, 0), sign: float = 1.0) -> FloatArray:
    return se3_from_parts(
        T_CAM0_CAM1[:3, :3] @ so3_exp(np.radians(turn_deg)), sign * T_CAM0_CAM1[:3, 3]
    )


@pytest.mark.parametrize(
    ("given", "faults"),
    [
        (T_CAM0_CAM1, []),
        (_changed((1, 0, 0)), ["left-right rotation wrong"]),
        (_changed((0, 1, 0)), ["left-right rotation wrong"]),
        (_changed((0, 0, 1)), ["left-right rotation wrong"]),
        (_changed(sign=-1), ["baseline translation inverted"]),
        (se3_inverse(T_CAM0_CAM1), ["cameras swapped"]),
        (se3_from_parts(T_CAM0_CAM1[:3, :3], [0.11, 0.011, 0]), ["baseline direction wrong"]),
    ],
    ids=["right", "pitch", "yaw", "roll", "translation", "inverse", "direction"],
)
def test_reports_a_wrong_stereo_calibration(
    estimate: StereoEstimate, matches: RayMatches, given: FloatArray, faults: list[str]
) -> None:
    findings = judge_stereo(estimate, given, matches)
    assert [f.fault for f in findings] == faults
    if faults == ["left-right rotation wrong"]:
        assert "off by 1.0" in findings[0].detail or "off by 0.9" in findings[0].detail


@pytest.mark.parametrize(
    ("segments", "sigma_deg", "turn_deg", "is_named"),
    [
        (4, 0.002, 0.04, False),
        (4, 0.002, 0.06, True),
        (4, 0.02, 0.09, False),  # five standard deviations
        (4, 0.02, 0.11, True),
        (None, 0.002, 0.28, False),  # single pairs: lens models look like turns
        (None, 0.002, 0.32, True),
    ],
)
def test_turns_are_named_from_what_the_images_can_tell_on(
    estimate: StereoEstimate,
    matches: RayMatches,
    segments: int | None,
    sigma_deg: float,
    turn_deg: float,
    is_named: bool,
) -> None:
    exact = replace(
        estimate,
        R_cam1_cam0=T_CAM0_CAM1[:3, :3].T,
        direction=_direction(T_CAM0_CAM1),
        rotation_sigma_deg=sigma_deg,
        segments=segments,
    )
    found = judge_stereo(exact, _changed((turn_deg, 0.0, 0.0)), matches)
    assert [f.fault for f in found] == ["left-right rotation wrong"] * is_named


def test_reports_exchanged_images(matches: RayMatches) -> None:
    swapped = RayMatches(matches.pair, matches.ray1, matches.ray0)
    inverse = se3_inverse(T_CAM0_CAM1)
    found = refine_stereo(swapped, inverse[:3, :3].T, _direction(inverse))
    assert isinstance(found, StereoEstimate)
    assert [f.fault for f in judge_stereo(found, T_CAM0_CAM1, swapped)] == ["cameras swapped"]
    assert [f.fault for f in judge_exchange(swapped, matches, T_CAM0_CAM1)] == ["cameras swapped"]
    assert judge_exchange(matches, swapped, T_CAM0_CAM1) == ()


def test_row_residuals_are_resolved_over_the_image() -> None:
    rng = np.random.default_rng(1)
    ul, v = rng.uniform(100, 640, 4000), rng.uniform(0, 480, 4000)
    slope = 0.001 * (ul - 320)
    z = np.stack([ul, v + slope, ul - rng.uniform(2, 40, 4000), v], axis=1)
    rows = row_residuals(z, 640, 480)
    assert not isinstance(rows, NotObservable)
    assert rows.positive_disparity == 1.0
    assert np.isnan(rows.grid_px).sum() == 0
    assert (np.diff(rows.grid_px, axis=1) > 0.1).all(), (
        "the residual grows to the right, as it was made to"
    )
    assert isinstance(row_residuals(z[:20], 640, 480), NotObservable)


# --- inertial sensor
# ------------------------------------------------------------------------------------------------

T_CAM0_IMU = se3_from_parts(
    so3_exp([0.1, -0.2, 0.05]) @ np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), [0.06, -0.04, 0.1]
)
RATE_HZ = 20.0


def _seen(spline: MotionSpline, *, noise: float = 1.0) -> CameraMotion:
    """Return the camera's exact twists with noise like that of stereo tracks."""
    times_ns = np.arange(
        spline.start_ns + 200_000_000, spline.end_ns - 200_000_000, int(1e9 / RATE_HZ)
    )
    state = motion_at(spline, times_ns)
    T_world_cam = state.T_world_imu @ se3_inverse(T_CAM0_IMU)
    steps = se3_inverse(T_world_cam[:-1]) @ T_world_cam[1:]
    twists = se3_log(steps) * RATE_HZ
    rng = np.random.default_rng(3)
    twists += (
        noise
        * RATE_HZ
        * np.concatenate(
            [
                4e-4 * rng.standard_normal((len(twists), 3)),
                1e-4 * rng.standard_normal((len(twists), 3)),
            ],
            axis=1,
        )
    )
    return CameraMotion(times_ns, np.arange(len(twists)), twists)


@pytest.fixture(scope="module")
def spline() -> MotionSpline:
    return hand_held(duration_s=40.0, seed=3)


@pytest.fixture(scope="module")
def samples(spline: MotionSpline) -> tuple[ImuSample, ...]:
    record = simulate_imu(spline, rate_hz=200.0, noise=ImuNoise(), seed=2)
    rows = zip(record.times_ns.tolist(), record.gyro, record.accel, strict=True)
    return tuple(ImuSample(*row) for row in rows)


@pytest.mark.parametrize("shift_ms", [0.0, 10.0, -35.0])
def test_estimates_rotation_offset_and_lever_arm(
    spline: MotionSpline, samples: tuple[ImuSample, ...], shift_ms: float
) -> None:
    late = tuple(replace(s, time_ns=s.time_ns + int(shift_ms * 1e6)) for s in samples)
    rates, motion = rates_of(late), _seen(spline)
    found = align_gyro(motion, rates)
    assert found.weak is None
    assert float(rotation_angle_deg(found.R_cam0_imu @ T_CAM0_IMU[:3, :3].T)) < 0.1
    assert 1e3 * found.time_offset_s == pytest.approx(shift_ms, abs=0.5)
    lever_arm = estimate_lever_arm(motion, rates, found)
    np.testing.assert_allclose(lever_arm.t_cam0_imu, T_CAM0_IMU[:3, 3], atol=0.01)
    assert (np.abs(lever_arm.t_cam0_imu - T_CAM0_IMU[:3, 3]) < 5 * lever_arm.sigma_m + 1e-3).all()
    faults = [f.fault for f in judge_imu(found, lever_arm, T_CAM0_IMU)]
    assert faults == ([] if shift_ms == 0 else ["clocks apart"])


def test_reports_a_wrong_imu_calibration(
    spline: MotionSpline, samples: tuple[ImuSample, ...]
) -> None:
    motion, rates = _seen(spline), rates_of(samples)
    found = align_gyro(motion, rates)
    assert isinstance(found, ImuAlignment)
    lever_arm = estimate_lever_arm(motion, rates, found)
    R, t = T_CAM0_IMU[:3, :3], T_CAM0_IMU[:3, 3]
    for given, fault in (
        (se3_from_parts(so3_exp(np.radians([0, 1, 0])) @ R, t), "IMU-camera rotation wrong"),
        (se3_from_parts(R.T, t), "IMU-camera rotation inverted"),
        (se3_from_parts(R, -t), "IMU-camera translation inverted"),
        (se3_from_parts(R, -R.T @ t), "IMU-camera translation inverted"),
        (se3_from_parts(R, t + np.array([0, 0.2, 0.3])), "IMU-camera translation wrong"),
    ):
        assert [f.fault for f in judge_imu(found, lever_arm, given)] == [fault]


@pytest.mark.parametrize(("noise_radps", "is_weak"), [(0.165, False), (0.19, True)])
def test_a_time_offset_known_to_five_milliseconds_is_enough(
    spline: MotionSpline, samples: tuple[ImuSample, ...], noise_radps: float, is_weak: bool
) -> None:
    motion = _seen(spline)
    noise = np.random.default_rng(5).normal(0.0, noise_radps, (len(motion.twists), 3))
    twists = motion.twists + np.hstack([np.zeros_like(noise), noise])
    found = align_gyro(replace(motion, twists=twists), rates_of(samples))
    assert found.time_offset_sigma_s == pytest.approx(0.005, rel=0.15)  # control
    assert ("time offset" in found.weak) == is_weak


@pytest.mark.parametrize(("depth_m", "is_determined"), [(4300.0, True), (4900.0, False)])
def test_points_that_are_kilometres_away_determine_no_translation(
    depth_m: float, is_determined: bool
) -> None:
    camera = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)
    rays = np.column_stack([np.random.default_rng(0).uniform(-1.0, 1.0, (60, 2)), np.ones(60)])
    points = depth_m * rays
    T = np.eye(4)[None]
    determined = np.zeros(1, dtype=np.bool_)
    _fit_motions(
        camera_args(camera), points, project(camera, points), np.array([0, 60]), T, determined
    )
    assert determined.tolist() == [is_determined]


def test_alignment_is_unobservable_without_rotation(
    samples: tuple[ImuSample, ...], spline: MotionSpline
) -> None:
    motion = _seen(spline)
    straight = replace(motion, twists=motion.twists * [1, 1, 1, 0, 0, 0])
    found = align_gyro(straight, rates_of(samples))
    assert isinstance(found, NotObservable)
    assert str(found).endswith("not observable because the camera does not rotate")


@pytest.mark.parametrize(("covered", "is_known"), [(0, False), (8, False), (37, False), (43, True)])
def test_alignment_is_unobservable_where_samples_cover_few_frames(
    samples: tuple[ImuSample, ...], spline: MotionSpline, covered: int, is_known: bool
) -> None:
    """Few told a time offset that was off by fifteen stated standard deviations, none told NaN."""
    motion = _seen(spline)
    end_ns = motion.times_ns[covered] + 110_000_000
    begin_ns = motion.times_ns[0] - 110_000_000
    few = tuple(s for s in samples if begin_ns < s.time_ns < end_ns)
    found = align_gyro(motion, rates_of(few))
    assert isinstance(found, ImuAlignment) == is_known
    if not is_known:
        assert "intervals between frames have samples of the sensor (40 needed)" in str(found)


def test_rotation_about_one_axis_leaves_the_alignment_about_it_unobservable() -> None:
    rng = np.random.default_rng(0)
    times_ns = np.arange(0, 20_000_000_000, 50_000_000)
    rate = 0.5 * np.sin(1.3 * 1e-9 * times_ns)
    imu_ns = np.arange(-500_000_000, 20_500_000_000, 5_000_000)
    samples = [
        ImuSample(
            int(t),
            np.array([0, 0, 0.5 * np.sin(1.3e-9 * t)]) + 1e-3 * rng.standard_normal(3),
            np.array([0, 0, 9.81]),
        )
        for t in imu_ns
    ]
    middle = (rate[1:] + rate[:-1]) / 2
    twists = np.zeros((len(middle), 6))
    twists[:, 3:] = np.outer(middle, T_CAM0_IMU[:3, 2]) + 1e-3 * rng.standard_normal(
        (len(middle), 3)
    )
    motion = CameraMotion(times_ns, np.arange(len(middle)), twists)
    found = align_gyro(motion, rates_of(samples))
    assert "rotation about one axis" in found.weak
    lever_arm = estimate_lever_arm(motion, rates_of(samples), found)
    assert isinstance(lever_arm, NotObservable)


def test_rejects_missing_tracks() -> None:
    none = feature_tracks({}, 5)
    found = camera_motion(StereoCamera(400, 400, 320, 240, 0.1), none, np.arange(5) * 1_000_000_000)
    assert isinstance(found, NotObservable)
    assert "1 s apart" in found.because


@pytest.mark.parametrize(("sigma_deg", "is_used"), [(0.02, True), (1.5, False)])
def test_motion_is_used_where_it_tells_more_than_single_pairs(
    sigma_deg: float,
    is_used: bool,
    estimate: StereoEstimate,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Twelve frames at standstill: their bundle adjustment had a yaw of -0.64 degrees, sigma 1.5."""
    camera = StereoCamera(700.0, 700.0, 600.0, 180.0, 0.5, 1200, 370)
    recording = SimpleNamespace(camera=camera, frame_times_ns=np.arange(3))
    source = SimpleNamespace(
        dataset=SimpleNamespace(recording=recording),
        image_size=lambda z: (1199.0, 369.0),
        rectifying=lambda: None,
    )
    n = len(NAMES)
    covariance = np.radians(sigma_deg) ** 2 / 3 * np.eye(n)
    found = SelfCalibration(np.zeros(n), np.zeros(n), covariance, 1, 100, 0.3, 36)
    monkeypatch.setattr(calibrate, "_segments", lambda *_: ["a piece"])
    monkeypatch.setattr(calibrate, "self_calibrate", lambda *_, **__: found)
    z = np.zeros((0, 4))
    none = np.zeros(0, dtype=np.bool_)
    tracks = FeatureTracks(np.zeros(4, dtype=np.int64), np.zeros(0, dtype=np.int64), z, none, none)
    stereo, _, in_motion = calibrate._measure_in_motion(source, estimate, tracks)  # type: ignore[arg-type]
    assert (in_motion is not None) == is_used
    assert (stereo is estimate) != is_used
