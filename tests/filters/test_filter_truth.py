"""What the filter claims of itself holds where it is tempted to claim more: standstill, rows,
movers, smoothing.

An exact world, constant motion, noise as the filter is told it. Bounds are chi-square quantiles of
the filter's own covariance, or the physics of the scenario.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.stats import chi2

from tests.replaced_rules import replaced
from tests.true_world import TrueWorld
from vio.filters import imu_start, navigation
from vio.filters.msckf import Msckf
from vio.filters.settings import MsckfSettings
from vio.filters.window import Window
from vio.filters.window_fit import WindowFit
from vio.filters.window_tracks import LinearTracks, WindowTracks
from vio.geometry.lie import (
    FloatArray,
    se3_from_parts,
    se3_inverse,
    se3_log,
    so3_exp,
    transform_points,
)
from vio.geometry.stereo import StereoCamera, project
from vio.imu.settings import DEFAULT_IMU
from vio.records import (
    BoolArray,
    Estimate,
    ImuSample,
    IntArray,
    MotionSource,
    Observations,
    UpdateReport,
    observations,
)

CAMERA = StereoCamera(460.0, 458.0, 370.0, 240.0, 0.11, 752, 480)
T_CAM0_IMU = se3_from_parts(
    np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.05, -0.02, 0.1])
)
# the rig is exact
SETTINGS = MsckfSettings(calibrate_stereo="off", stereo_baseline_sigma=0.0, stereo_focal_sigma=0.0)
_IMU_HZ = 200
Spoil = Callable[[int, Observations], Observations]


@dataclass(frozen=True, slots=True)
class Course:
    """A body of constant velocity and yaw rate, ahead of it points at random; what its camera
    and IMU measure.
    """

    hz: int
    seconds: float
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m/s, world
    yaw_rate: float = 0.0  # rad/s
    depth: tuple[float, float] = (3.0, 8.0)  # m, of the points
    pixel_sigma_px: float = 0.05
    features: int = 60
    bias: tuple[float, ...] = (0.0,) * 6  # of gyro (rad/s) and accelerometer (m/s^2)
    movers: float = 0.0  # share of the points that begin to move
    movers_from_s: float = 0.0
    movers_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m/s

    @property
    def frames(self) -> int:
        """How many."""
        return round(self.seconds * self.hz)

    def pose(self, t: float) -> FloatArray:
        """`T_world_imu` (4, 4) at a time in seconds."""
        return se3_from_parts(so3_exp([0, 0, self.yaw_rate * t]), np.array(self.velocity) * t)

    def moving(self, ids: IntArray) -> BoolArray:
        """Which points move, for good once they have begun."""
        out: BoolArray = ids % 10 < 10 * self.movers
        return out

    def points(self, t: float) -> FloatArray:
        """Points of the world (800, 3) at a time."""
        d, y, z = (
            np.random.default_rng(99)
            .uniform([self.depth[0], -1, -0.5], [self.depth[1], 1, 0.5], (800, 3))
            .T
        )
        moved = max(t - self.movers_from_s, 0.0) * np.array(self.movers_velocity)
        return np.column_stack([d, y * d, z * d]) + np.outer(self.moving(np.arange(800)), moved)

    def observe(self, k: int, rng: np.random.Generator) -> Observations:
        """What frame k shows."""
        t = k / self.hz
        p = transform_points(T_CAM0_IMU @ se3_inverse(self.pose(t)), self.points(t))
        ahead = p[:, 2] > 0.5
        z = project(CAMERA, np.where(ahead[:, None], p, [0.0, 0.0, 10.0]))
        ids = np.flatnonzero(
            ahead & (z[:, 2] > 2) & (z[:, 0] < 750) & (z[:, 1] > 2) & (z[:, 1] < 478)
        )
        ids = ids[: self.features]
        return observations(
            k, k * 10**9 // self.hz, ids, z[ids] + rng.normal(0, self.pixel_sigma_px, (len(ids), 4))
        )

    def imu(self, k: int, rng: np.random.Generator) -> ImuSample:
        """IMU sample k, with white noise and constant biases."""
        R, root = self.pose(k / _IMU_HZ)[:3, :3], np.sqrt(_IMU_HZ)
        gyro = (
            np.array([0, 0, self.yaw_rate])
            + rng.normal(0, DEFAULT_IMU.gyro_noise_density * root, 3)
            + self.bias[:3]
        )
        accel = (
            R.T @ [0, 0, 9.81]
            + rng.normal(0, DEFAULT_IMU.accel_noise_density * root, 3)
            + self.bias[3:]
        )
        return ImuSample(k * 10**9 // _IMU_HZ, gyro, accel)


@dataclass(slots=True)
class Run:
    """What the filter said of each frame."""

    filter: Msckf
    course: Course
    # (4, 4) of each frame's world in the true one
    T_world_estimated: list[FloatArray] = field(default_factory=list)
    estimates: list[Estimate] = field(default_factory=list)
    reports: list[UpdateReport] = field(default_factory=list)
    navigation: list[FloatArray] = field(default_factory=list)  # (15, 15) covariances

    @property
    def last_pose(self) -> FloatArray:
        """The last estimated pose (4, 4) in the true world."""
        return np.asarray(self.T_world_estimated[-1] @ self.estimates[-1].T_world_imu)

    def error(self, k: int, estimate: Estimate | None = None) -> FloatArray:
        """Pose error (6,) of frame k on the body's side, as `Estimate` defines it."""
        T = self.T_world_estimated[k] @ (estimate or self.estimates[k]).T_world_imu
        return se3_log(se3_inverse(self.course.pose(k / self.course.hz)) @ T)

    def velocity_error(self, k: int, estimate: Estimate | None = None) -> FloatArray:
        """Velocity error (3,) of frame k, world."""
        v = (estimate or self.estimates[k]).velocity_world
        return np.asarray(self.T_world_estimated[k][:3, :3] @ v - self.course.velocity)


def fly(
    course: Course,
    motion: MotionSource | None,
    settings: MsckfSettings = SETTINGS,
    seed: int = 0,
    spoil: Spoil | None = None,
    each: Callable[[Run], None] | None = None,
) -> Run:
    """Drive the filter along a course.

    The estimate's world is put where the first pose says, see `TrueWorld`.
    """
    rng_imu, rng = np.random.default_rng(1000 + seed), np.random.default_rng(seed)
    run, fed = Run(Msckf(CAMERA, T_CAM0_IMU, settings, motion=motion), course), 0
    world = TrueWorld(run.filter, upright=motion == "imu")
    for k in range(course.frames):
        while motion == "imu" and fed * course.hz <= (k + 1) * _IMU_HZ:
            run.filter.propagate(course.imu(fed, rng_imu))
            fed += 1
        seen = course.observe(k, rng)
        run.reports.append(run.filter.update(seen if spoil is None else spoil(k, seen)))
        estimate = run.filter.estimate()
        world.meet(k, course.pose(k / course.hz))
        run.T_world_estimated.append(world.T)
        run.estimates.append(estimate)
        run.navigation.append(run.filter._propagation.posterior.own[:15, :15].copy())
        if each is not None:
            each(run)
    return run


def squared(error: FloatArray, covariance: FloatArray) -> float:
    """Normalised error squared."""
    return float(error @ np.linalg.solve(covariance, error))


def zero_velocities(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Count the measurements of the navigation state; there is no other than zero velocity
    without velocity samples.
    """
    applied: list[int] = []
    absorb = Window.absorb_measurement

    def spy(window: Window, measurement: object) -> None:
        applied.append(window.clones[-1].frame_index)
        absorb(window, measurement)  # type: ignore[arg-type]

    monkeypatch.setattr(Window, "absorb_measurement", spy)
    return applied


# Standstill

FAR = Course(30, 3.0, velocity=(0.2, 0.0, 0.0), depth=(15.0, 30.0))


@pytest.mark.parametrize("motion", [None, "imu"])
def test_slow_motion_before_a_far_scene_is_no_standstill(
    monkeypatch: pytest.MonkeyPatch, motion: MotionSource | None
) -> None:
    """0.2 m/s at 30 Hz before points at 15 to 30 m: less than a quarter of a pixel per frame."""
    applied, runs = zero_velocities(monkeypatch), range(2)
    position, velocity, yaw = 0.0, 0.0, 0.0
    for seed in runs:
        run = fly(FAR, motion, seed=seed)
        error, P, nav = run.error(-1 % FAR.frames), run.estimates[-1].covariance, run.navigation[-1]
        position += squared(error[:3], P[:3, :3])
        yaw += error[5] ** 2 / P[5, 5]
        velocity += squared(run.velocity_error(FAR.frames - 1), nav[6:9, 6:9])
        assert np.linalg.norm(run.velocity_error(FAR.frames - 1)) < 0.1
    assert not applied
    assert position < chi2.ppf(0.999, 3 * len(runs))
    assert velocity < chi2.ppf(0.999, 3 * len(runs))
    assert yaw < chi2.ppf(0.999, len(runs))


def test_a_motion_that_images_cannot_tell_is_no_standstill_either(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two pixels of noise: the motion over a window is smaller than its standard deviation, and
    yet 0.2 m/s.
    """
    applied = zero_velocities(monkeypatch)
    run = fly(
        replace(FAR, pixel_sigma_px=2.0, features=20), None, replace(SETTINGS, pixel_sigma_px=2.0)
    )
    assert not applied
    last = FAR.frames - 1
    assert squared(run.velocity_error(last), run.navigation[last][6:9, 6:9]) < chi2.ppf(0.999, 3)


def test_slow_turn_leaves_the_gyro_bias_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """0.02 rad/s at 60 Hz: a sixth of a pixel per frame, which is no bias of the gyro."""
    applied = zero_velocities(monkeypatch)
    course = Course(60, 2.5, yaw_rate=0.02, features=40)
    run = fly(course, "imu")
    error = run.estimates[-1].gyro_bias
    assert squared(error, run.navigation[-1][9:12, 9:12]) < chi2.ppf(0.999, 3)
    assert np.linalg.norm(error) < 0.002
    assert squared(run.error(course.frames - 1), run.estimates[-1].covariance) < chi2.ppf(0.999, 6)
    assert not applied


@pytest.mark.parametrize("motion", [None, "imu"])
@pytest.mark.parametrize(
    ("velocity", "yaw_rate"),
    [((1e-3, 0.0, 0.0), 0.0), ((0.0, 1e-3, 0.0), 0.0), ((0.0, 0.0, 0.0), np.radians(0.05))],
)
def test_creep_and_slow_turns_are_followed(
    motion: MotionSource | None, velocity: tuple[float, float, float], yaw_rate: float
) -> None:
    """1 mm/s and 0.05 deg/s: taken for rest or not, pose and gyro bias stay within their
    covariance.
    """
    course = Course(20, 6.0, velocity=velocity, yaw_rate=yaw_rate, features=40)
    run = fly(course, motion)
    last = course.frames - 1
    assert squared(run.error(last), run.estimates[last].covariance) < chi2.ppf(0.999, 6)
    travelled, turned = 6e-3 * (yaw_rate == 0), 6 * yaw_rate
    error = run.error(last)
    assert np.linalg.norm(error[:3]) < max(0.25 * travelled, 1.5e-3)
    assert abs(error[5]) < max(0.1 * turned, 1e-3)
    if motion == "imu":
        bias = run.estimates[last].gyro_bias
        assert squared(bias, run.navigation[last][9:12, 9:12]) < chi2.ppf(0.999, 3)


@pytest.mark.parametrize("motion", [None, "imu"])
def test_standstill_is_found_and_holds_the_position(
    monkeypatch: pytest.MonkeyPatch, motion: MotionSource | None
) -> None:
    """The position scatters by less than 0.2 mm on each axis and does not drift, with 0.05 px of
    noise.

    Zero velocity is measured once per window of frames, and, at a test level of 95 %, in nearly
    every one.
    """
    applied = zero_velocities(monkeypatch)
    course = Course(20, 7.0, features=120)
    run = fly(course, motion)
    windows = course.frames // SETTINGS.clones
    assert windows - 3 <= len(applied) <= windows
    assert np.diff(applied).min() >= SETTINGS.clones - 1
    p = np.array([e.T_world_imu[:3, 3] for e in run.estimates[40:]])
    assert np.sqrt(np.mean((p - p.mean(axis=0)) ** 2)) < 2e-4
    assert np.linalg.norm(p[50:].mean(axis=0) - p[:50].mean(axis=0)) < 2e-4
    last = course.frames - 1
    assert squared(run.error(last), run.estimates[last].covariance) < chi2.ppf(0.999, 6)
    applied.clear()
    fly(replace(course, seconds=1.0), motion, replace(SETTINGS, zero_velocity=False))
    assert not applied


# Rows

WALK = Course(20, 2.0, velocity=(0.5, 0.3, 0.0), yaw_rate=0.3, depth=(2.0, 6.0), pixel_sigma_px=0.5)


@pytest.mark.parametrize("motion", [None, "imu"])
def test_a_field_of_row_errors_in_the_right_image_changes_no_bit(
    motion: MotionSource | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`vl - vr = -7 xn yn` pixels, as a pair whose calibration is off shows it: `v` is measured
    once, on the left.
    """

    def field_of_rows(k: int, seen: Observations) -> Observations:
        z = seen.z.copy()
        z[:, 3] += 7 * (z[:, 0] - CAMERA.cu) / CAMERA.fu * (z[:, 1] - CAMERA.cv) / CAMERA.fv
        return replace(seen, z=z)

    # With more tilt, yaw about two verticals would be compared.
    monkeypatch.setattr(imu_start, "START_TILT_SIGMA_DEG", 1.0)
    settings = replace(SETTINGS, calibrate_stereo="off")
    plain, bent = fly(WALK, motion, settings), fly(WALK, motion, settings, spoil=field_of_rows)
    for a, b in zip(plain.estimates, bent.estimates, strict=True):
        np.testing.assert_array_equal(a.T_world_imu, b.T_world_imu)
        np.testing.assert_array_equal(a.covariance, b.covariance)
    assert plain.reports == bent.reports
    assert squared(bent.error(WALK.frames - 1), bent.estimates[-1].covariance) < chi2.ppf(0.999, 6)


# Movers

CROWD = Course(
    20,
    5.0,
    velocity=(0.3, 0.2, 0.0),
    depth=(3.0, 9.0),
    pixel_sigma_px=0.3,
    features=100,
    movers=0.3,
    movers_from_s=2.0,
    movers_velocity=(0.0, 0.3, 0.0),
)


@pytest.mark.parametrize("motion", [None, "imu"])
def test_points_that_begin_to_move_do_not_steer(motion: MotionSource | None) -> None:
    """Three points in ten begin to move at 0.3 m/s; three seconds later the landmarks are of those
    that stand.

    The NEES is averaged over the second half of two flights; frames of a flight are correlated over
    a window, so the two stretches of 30 frames hold about six independent poses.
    """
    values = []
    for seed in range(2):
        run = fly(CROWD, motion, seed=seed)
        window = run.filter._window
        assert len(window.landmark_ids) > 20
        assert CROWD.moving(window.landmark_ids).sum() <= 1
        values += [
            squared(run.error(k), run.estimates[k].covariance) for k in range(70, CROWD.frames)
        ]
    assert np.mean(values) < chi2.ppf(0.999, 6 * 6) / 6


@pytest.fixture(scope="module")
def walked() -> Run:
    """A filter with landmarks, before the last frame of a walk."""
    return fly(replace(WALK, seconds=1.95), None)


def _next_frame(
    run: Run, moved: BoolArray | None = None, px: float = 0.0
) -> tuple[Msckf, UpdateReport, Observations]:
    """The filter after the next frame, in which rows (F,) are moved by pixels along u."""
    filt, k = copy.deepcopy(run.filter), run.course.frames
    seen = run.course.observe(k, np.random.default_rng(77))
    if moved is not None:
        seen = replace(seen, z=seen.z + px * np.outer(moved, [1.0, 0, 1, 0]))
    return filt, filt.update(seen), seen


def test_landmarks_out_of_place_are_gated_reported_and_without_effect(walked: Run) -> None:
    """Five landmarks jump by 15 px: they are used no more, each is counted, and the estimate
    stays where it was.
    """
    clean, report, seen = _next_frame(walked)
    chosen = walked.filter._window.landmark_ids[:5]
    moved = np.isin(seen.ids, chosen)
    assert moved.sum() == 5
    jumped, spoiled, _ = _next_frame(walked, moved, 15.0)
    assert spoiled.used + spoiled.gated == report.used + report.gated
    assert 5 <= spoiled.gated - report.gated <= 6  # one more may fail beside them
    a, b = clean.estimate(), jumped.estimate()
    difference = se3_log(se3_inverse(a.T_world_imu) @ b.T_world_imu)
    assert squared(difference, a.covariance) < 3.0  # of 6; five landmarks less are another estimate
    window = jumped._window
    assert not np.isin(chosen, window.landmark_ids).any()  # dropped


def test_gated_tracks_do_not_steer(walked: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same tracks fail the gate twice, once with a bias of a pixel in the newest frame: the
    same estimate.
    """
    linearised: list[IntArray] = []
    without_wrong_views, gate = WindowTracks.without_wrong_views, WindowTracks.gate

    def remember(self: WindowTracks, tracks: LinearTracks) -> LinearTracks:
        out = without_wrong_views(self, tracks)
        linearised.append(self.table.ids(out.rows))
        return out

    def refuse(self: WindowTracks, at: object) -> tuple[object, ...]:
        good, *rest = gate(self, at)  # type: ignore[arg-type]
        return good & (linearised[-1] % 3 != 0), *rest

    monkeypatch.setattr(WindowTracks, "without_wrong_views", remember)
    monkeypatch.setattr(WindowTracks, "gate", refuse)
    clean, report, seen = _next_frame(walked)
    moved = (seen.ids % 3 == 0) & ~np.isin(seen.ids, walked.filter._window.landmark_ids)
    assert 5 < moved.sum() < 0.5 * len(seen)
    biased, spoiled, _ = _next_frame(walked, moved, 1.0)
    assert report.gated >= moved.sum()
    assert spoiled.used == report.used
    a, b = clean.estimate(), biased.estimate()
    difference = se3_log(se3_inverse(a.T_world_imu) @ b.T_world_imu)
    # They change where the others are linearised, and the pixel noise by a step of its slow
    # learning.
    assert squared(difference, a.covariance) < 0.01


# Smoothing


@pytest.mark.parametrize("motion", [None, "imu"])
def test_smoothed_estimates_carry_their_own_covariance_and_velocity(
    motion: MotionSource | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five frames later a pose is known better, by as much as its covariance says: NEES over six
    seeded runs.

    Velocities: images alone know them better from both sides. With an IMU the newest velocity is
    carried back, which adds the accelerometer's noise over the lag and no more.
    """
    monkeypatch.setattr(imu_start, "START_TILT_SIGMA_DEG", 1.0)
    monkeypatch.setattr(navigation, "START_VELOCITY_SIGMA_MPS", 2.0)
    runs, lag, settings = 6, 5, SETTINGS
    course = replace(WALK, seconds=1.5, bias=(0.01, -0.02, 0.01, 0.05, -0.03, 0.02))
    nees, causal_mps, smoothed_mps = [], [], []
    for seed in range(runs):
        smoothed: dict[int, Estimate] = {}

        def remember(run: Run, smoothed: dict[int, Estimate] = smoothed) -> None:
            k = len(run.estimates) - 1 - lag
            estimate = run.filter.smoothed(k) if k >= 12 else None
            if estimate is not None:
                smoothed[k] = estimate

        run = fly(course, motion, settings, seed, each=remember)
        assert list(smoothed) == list(range(12, course.frames - lag))
        for k, estimate in smoothed.items():
            assert estimate.time_ns == run.estimates[k].time_ns
            gained = run.estimates[k].covariance - estimate.covariance
            assert np.trace(gained[:3, :3]) > 0
            assert np.trace(gained[3:, 3:]) > 0
        nees.append([squared(run.error(k, e), e.covariance) for k, e in smoothed.items()])
        smoothed_mps.append([run.velocity_error(k, e) for k, e in smoothed.items()])
        causal_mps.append([run.velocity_error(k) for k in smoothed])
        assert run.filter.smoothed(0) is None  # has left the window
    mean = np.mean(nees, axis=0)
    low, high = chi2.ppf([0.025, 0.975], 6 * runs) / runs
    assert np.mean(mean < high) >= 0.9
    # the filter starts with five times the IMU's noise by its data sheet
    assert mean.mean() > 0.6 * low
    causal, late = (float(np.mean(np.square(e))) for e in (causal_mps, smoothed_mps))
    extra = DEFAULT_IMU.accel_noise_density**2 * lag / course.hz if motion == "imu" else 0.0
    assert late < causal + extra
    if motion is None:
        assert late < 0.5 * causal


def test_the_newest_smoothed_estimate_is_the_causal_one(walked: Run) -> None:
    filt = walked.filter
    newest, causal = filt.smoothed(walked.course.frames - 1), filt.estimate()
    np.testing.assert_allclose(newest.T_world_imu, causal.T_world_imu, atol=1e-12)
    # The causal covariance is the prior's and that of the tracks that go on, in the same frame.
    np.testing.assert_allclose(newest.covariance, causal.covariance, rtol=1e-6, atol=1e-15)


# Frames that are noisier than the others


@pytest.mark.usefixtures("white_noise")
def test_blurred_frames_count_less() -> None:
    """Twelve frames with five times the variance that the first thirty have taught: errors as their
    covariance says.

    With the information of sharp frames their NEES is 14 of 6.
    """
    course = Course(20, 2.0, (0.4, 0.5, 0.0), yaw_rate=0.2, depth=(2.0, 8.0), pixel_sigma_px=0.1)
    values = []
    for seed in range(12):
        blur = np.random.default_rng(77 + seed).normal(0.0, 0.2, (12, 400, 4))

        def spoil(k: int, seen: Observations, blur: FloatArray = blur) -> Observations:
            return replace(seen, z=seen.z + blur[k - 30, : len(seen)]) if 30 <= k < 42 else seen

        run = fly(course, None, seed=seed, spoil=spoil)
        values.append(squared(run.error(38), run.estimates[38].covariance))
    assert np.mean(values) < chi2.ppf(0.999, 6 * len(values)) / len(values)


# Errors that outlast a track


@pytest.mark.parametrize("walk_px", [0.0, 0.04])
def test_poses_are_as_good_as_stated_where_errors_of_tracks_walk(walk_px: float) -> None:
    """Both cameras follow a point that walks away from its place.

    With `k` of (R7) alone NEES is 23 of 6; white errors do not pay for those that last.
    """
    course = Course(20, 3.0, (0.4, 0.5, 0.0), yaw_rate=0.2, depth=(2.0, 8.0))
    values = []
    for seed in range(12):
        steps = np.random.default_rng(50 + seed).normal(0, walk_px, (course.frames, 800, 2))
        walked = np.cumsum(steps, axis=0)

        def spoil(k: int, seen: Observations, walked: FloatArray = walked) -> Observations:
            return replace(seen, z=seen.z + np.tile(walked[k, seen.ids], 2))

        run = fly(course, None, seed=seed, spoil=spoil)
        values.append(squared(run.error(59), run.estimates[59].covariance))
    low, high = chi2.ppf([0.001, 0.999], 6 * len(values)) / len(values)
    assert low < np.mean(values) < high


# Landmarks beside a factor on the information of pixels


@pytest.mark.parametrize("factor", [1.0, 8.0])
def test_landmarks_are_gated_with_the_variance_that_they_entered_with(
    factor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the measurements are those of landmarks; none is out of place.

    Of white noise 1 % is refused, at most.
    """
    monkeypatch.setattr("vio.filters.overdispersion.PRIOR_FACTOR", factor)
    monkeypatch.setattr(
        "vio.filters.overdispersion._CLUSTERS",
        replaced("vio.filters.overdispersion._CLUSTERS", prior_tracks=1e9),
    )
    course = Course(20, 3.0, (0.4, 0.5, 0.0), yaw_rate=0.2, depth=(2.0, 8.0), features=40)
    refused = offered = 0
    for seed in range(4):
        for report in fly(
            course, None, replace(SETTINGS, max_landmarks=20, max_features=10), seed=seed
        ).reports:
            offered += len(report.landmark_ids)
            refused += len(np.intersect1d(report.gated_ids, report.landmark_ids))
    assert refused < 0.02 * offered
    assert offered > 2000


# Steps of a fit


@pytest.mark.parametrize(
    ("innovation", "residuals", "steps"),
    [
        (136.7, [52.5, 10.5, 0.48, 0.25], 4),  # MH_01 after 1.85 s without frames
        (3.0, [0.2, 0.2], 2),
        (3.0, [2.9], 1),  # comes no nearer
        (0.4, [0.1], 1),  # was near
    ],
)
def test_a_fit_goes_on_while_it_was_far_and_comes_nearer(
    innovation: float, residuals: list[float], steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Tracks:
        rows = np.arange(3)
        stereo = None

        def __init__(self, residual: float) -> None:
            self._residual = residual

        def newest_innovation(self) -> float:
            return self._residual

    update, left = WindowFit.__new__(WindowFit), [Tracks(r) for r in residuals]
    monkeypatch.setattr(update, "information", lambda *_: (np.eye(1), np.zeros(1), None))
    monkeypatch.setattr(update, "move_to_optimum", lambda *_: None)
    monkeypatch.setattr(update, "linearise", lambda *_: left.pop(0))
    tracks, _ = update.fit(None, Tracks(innovation), None, innovation)  # type: ignore[arg-type]
    assert len(residuals) - len(left) == steps
    assert tracks.newest_innovation() == residuals[steps - 1]
