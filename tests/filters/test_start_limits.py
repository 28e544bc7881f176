"""Each limit of one camera's start, of jumps of a gyro, of fits and of the paper's filter, from both
sides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, T_CAM0_IMU
from vio.errors import DivergedError
from vio.filters.alignment import Bearings, FreeMotion, gyro_bias
from vio.filters.imu_jump import Contradiction, GyroJump, ShownMotion
from vio.filters.landmark_gate import LandmarkGate
from vio.filters.mono_start import MonoStarter, _disagreement, is_still
from vio.filters.msckf import _check_sane
from vio.filters.multiview import linearised_points
from vio.filters.navigation import Growth, ImuMotion, NavState
from vio.filters.rig_calibration import RigCalibration
from vio.filters.settings import MsckfSettings, VislamSettings
from vio.filters.step_by_images import explained_share, is_lost, linked_points, step_by_images
from vio.filters.stereo_calibration import VerticalDisparityModel
from vio.filters.track_records import Residuals, Views
from vio.filters.vislam import Vislam
from vio.filters.vislam_motion import DriftingTwist
from vio.filters.window_fit import WindowFit
from vio.filters.window_posterior import scale_sigma
from vio.filters.window_tracks import WindowTracks
from vio.geometry.lie import FloatArray, se3_exp, transform_points
from vio.geometry.stereo import StereoCamera, project, z_D_p_cam
from vio.imu.settings import DEFAULT_IMU
from vio.records import ImuSample, Observations, VelocitySample, observations

Says = Callable[[float], bool]
SETTINGS = MsckfSettings()
MONO = StereoCamera(460.0, 458.0, 370.0, 240.0, 0.1, 752, 480, kind="mono")
REST = NavState(np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
STEP_NS = 50_000_000


# The start of one camera


def _frames(count: int, features: int = 40, px_a_frame: float = 0.0) -> list[Observations]:
    z = np.random.default_rng(0).uniform(50.0, 400.0, (features, 4))
    return [
        observations(
            k, STEP_NS * k, np.arange(features), z + np.array([px_a_frame * k, 0.0, 0.0, 0.0])
        )
        for k in range(count)
    ]


def _resting_samples(seconds: float) -> list[ImuSample]:
    rng = np.random.default_rng(0)
    return [
        ImuSample(
            5_000_000 * k,
            0.01 * DEFAULT_IMU.gyro_noise_density * rng.normal(size=3),
            np.array([0.0, 0.0, 9.81]),
        )
        for k in range(round(200 * seconds))
    ]


def _still(features: int = 40, px: float = 0.0) -> bool:
    """Whether features that move by some pixels in half a second, beside an IMU at rest, are at a
    standstill.
    """
    frames = _frames(11, features, px / 10.0)
    return is_still(frames, _resting_samples(0.55), DEFAULT_IMU)


class _Attempts(MonoStarter):
    """Counts attempts to start in motion."""

    attempts = 0

    def _moving_start(self, motion: ImuMotion) -> None:
        self.attempts += 1


def _starter() -> MonoStarter:
    return MonoStarter(MONO, T_CAM0_IMU, SETTINGS, DEFAULT_IMU)


def _attempted(frames: int, step_s: float) -> _Attempts:
    starter = _Attempts(MONO, T_CAM0_IMU, SETTINGS, DEFAULT_IMU)
    motion = ImuMotion(SETTINGS)
    motion.take_all([ImuSample(0, np.zeros(3), np.array([0.0, 0.0, 9.81]))])
    for k, seen in enumerate(_frames(frames)):
        starter.try_frame(replace(seen, time_ns=round(1e9 * step_s * k)), motion)
    return starter


def _views(frames: int) -> int:
    starter = _starter()
    starter._frames.extend(_frames(frames))
    return len(starter._views())


def _chosen(features: int) -> int:
    """Features that a start takes of so many."""
    tracks = WindowTracks(MONO, _starter()._settings)
    for k, seen in enumerate(_frames(3, features)):
        tracks.table.add_frame(k, seen)
    return len(tracks.choose(3))


def _persists(seconds: float) -> bool:
    starter = _starter()
    starter._contradiction_persists(0)
    return starter._contradiction_persists(round(1e9 * seconds))


def _begins(sigma: float, features: int = 40) -> bool:
    """Whether a start whose scale has a standard deviation is taken."""
    starter: Any = _starter()
    starter._frames.extend(_frames(13, features))
    starter._aligned = lambda *_: REST
    starter._fit = lambda *_: (REST, np.eye(15), sigma)
    return starter._moving_start(ImuMotion(SETTINGS)) is not None


def _start_noise_px(px: float) -> float:
    tracks = SimpleNamespace(
        variance=1.0, gate=lambda _: (None, np.full(40, px**2 * 8.34), np.full(40, 9))
    )
    _starter()._follow_noise(tracks, SimpleNamespace(at=None))  # type: ignore[arg-type]
    return float(np.sqrt(tracks.variance))


def _disagrees(squared: float) -> bool:
    """Whether means that are so far from a prior of three errors contradict it."""
    prior: Any = SimpleNamespace(squared_distance=lambda _: (squared, 3))
    return _disagreement(prior, slice(0, 3)) > 1.0


def _bias_share(sigma_radps: float = 0.1, shared: int = 100, bias: float = 1e-3) -> float:
    """Share of a gyro's bias that directions of some features in two views tell, beside a prior."""
    rng = np.random.default_rng(3)
    p = rng.uniform([-2.0, -2.0, 3.0], [2.0, 2.0, 6.0], (shared, 3))
    turned = se3_exp([0.3, 0.1, 0.0, 0.0, bias, 0.0])
    second = transform_points(turned, p)
    rays = np.stack([p, second], axis=1)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    motion = FreeMotion(
        np.array([0.0, 1.0]),
        np.tile(np.eye(3), (2, 1, 1)),
        np.zeros((2, 3)),
        np.stack([np.zeros((3, 3)), np.eye(3)]),
    )
    seen = np.ones((shared, 2), dtype=np.bool_)
    return float(-gyro_bias(Bearings(rays, seen, np.zeros(3)), motion, sigma_radps)[1] / bias)


START: dict[str, tuple[Says, float, float]] = {
    "still: features": (lambda n: _still(int(n)), 19, 20),
    "still: motion": (lambda x: not _still(px=x), 0.43, 0.57),
    "attempts: seconds": (lambda x: _attempted(5, x / 4.0).attempts > 0, 0.5, 0.7),
    "attempts: frames": (lambda n: _attempted(int(n), 0.4).attempts > 0, 4, 5),
    "kept frames": (lambda n: len(_attempted(int(n), 0.25)._frames) < n, 13, 14),
    "views": (lambda n: _views(int(n)) < n, 16, 17),
    "features: largest number": (lambda n: _chosen(int(n)) < n, 150, 151),
    "features: least number": (lambda n: _begins(0.01, int(n)), 19, 20),
    "scale": (lambda x: not _begins(x), 0.085, 0.115),
    "contradiction: seconds": (_persists, 4.3, 5.7),
    "contradiction: distance": (_disagrees, 14.5, 18.0),
    "noise": (lambda x: _start_noise_px(x) > _start_noise_px(0.0), 0.13, 0.17),
    "rotation: shared features": (lambda n: _bias_share(shared=int(n)) > 0.0, 7, 8),
    "rotation: by features": (lambda x: _bias_share(x) > 0.5, 0.0032, 0.0045),
}


# A gyro that jumps


def _asked(off: list[bool], ratio: float = 9.0) -> bool:
    """Whether a gyro is asked that the images contradict, after steps that were off or not."""
    jump = GyroJump()
    for each in off:
        jump.take(off=each)
    return jump.is_asked(ratio)


def _settled(off: list[bool]) -> bool:
    return _asked([False] * 40 + off)


def _changed(sigmas: float) -> bool:
    jump = GyroJump()
    sigma = np.array([0.01, 0.0, 0.0])
    jump.doubt(np.zeros(3), sigma)
    return jump.agrees(sigmas * sigma, 0.0 * sigma) is not None


def _repeats(less: float) -> bool:
    jump = GyroJump()
    rate = np.array([0.1, 0.0, 0.0])
    jump.repeats(rate)
    return jump.repeats((1.0 - less) * rate)


def _turn(tracks: int = 60, views: int = 6, agreeing: float = 1.0, sigmas: float = 200.0) -> bool:
    """Whether tracks of some views show a rotation of so many standard deviations, which a share
    of them follows.
    """
    rng = np.random.default_rng(0)
    p = rng.uniform([-2.0, -1.0, 3.0], [2.0, 1.0, 6.0], (tracks, 3))
    J = np.zeros((tracks, 9, 4, 3))
    J[:, 9 - views :] = z_D_p_cam(CAMERA, p)[:, None]
    r = np.zeros((tracks, 9, 4))
    r[:, -1] = np.einsum("fki,fi->fk", J[:, -1], np.cross([0.0, 1e-4 * sigmas, 0.0], p))
    wrong = round((1.0 - agreeing) * tracks)
    r[:wrong, -1] += rng.choice([-60.0, 60.0], (wrong, 4))
    at = Residuals(r, J, np.ones(tracks, np.bool_), np.ones(r.shape))
    predicted: Any = SimpleNamespace(at=at, p_world=p, variance=1e-4)
    nav = SimpleNamespace(T_world_imu=np.eye(4))
    window: Any = SimpleNamespace(nav=nav, clones=None, move_newest=lambda turn, shift: None)
    left = at._replace(r=np.where(np.abs(r) > 30.0, r, 0.0))
    there: Any = SimpleNamespace(at=left, p_world=p, variance=1e-4)
    motion = ShownMotion(window, 1e-8 * np.eye(6), lambda: there)
    return motion.find(predicted) is not None


def _doubts_bias(radps: float, steps: int = 40) -> bool:
    """Whether a rate by which images contradict a gyro in two steps makes its bias uncertain."""
    lacking: list[FloatArray] = []
    window: Any = SimpleNamespace(
        last_step_s=0.05,
        nav=SimpleNamespace(gyro_bias=np.zeros(3)),
        prior=SimpleNamespace(P=np.eye(15)),
        move_newest=lambda turn, shift: None,
        inflate_process_noise=lacking.append,
    )
    noise = np.zeros((2, 15, 15))
    noise[1, 3:6, 3:6] = np.eye(3)
    shown = Contradiction(np.array([0.05 * radps, 0.0, 0.0]), None)
    jump = GyroJump()
    for _ in range(steps):
        jump.take(off=False)
    for _ in range(2):
        jump.doubt_step(
            window, shown, Growth(np.eye(15), noise.sum(axis=0), noise, False, np.eye(15))
        )
    return bool(lacking[-1][9:12, 9:12].any())


JUMP: dict[str, tuple[Says, float, float]] = {
    "first steps": (lambda n: _asked([False] * int(n)), 20, 21),
    "start": (lambda n: _doubts_bias(0.1, int(n)), 30, 31),
    "steps that are off": (lambda n: not _settled([True] * int(n) + [False] * 3), 3, 4),
    "newest steps": (lambda n: not _settled([True] * int(n)), 6, 7),
    "quiet steps": (lambda n: _settled([True] * 4 + [False] * int(n)), 19, 20),
    "innovations": (lambda x: _asked([False] * 40, x), 1.2, 1.6),
    "significance": (lambda x: _turn(sigmas=x), 8.5, 11.5),
    "bias": (_changed, 2.6, 3.4),
    "largest bias": (lambda x: not _doubts_bias(x), 0.43, 0.57),
    "alike": (lambda x: not _repeats(x), 0.43, 0.57),
    "old views": (lambda n: _turn(views=int(n) + 1), 3, 4),
    "old tracks": (lambda n: _turn(int(n)), 14, 15),
    "agreeing tracks": (lambda x: _turn(agreeing=x), 0.74, 0.86),
}


# Steps by images


def _step_views(count: int, wrong: int = 0, noise_px: float = 0.1) -> Views:
    rng = np.random.default_rng(1)
    p = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(4, 8, count)])
    later = transform_points(se3_exp([0.1, -0.05, -0.4, 0.02, 0.05, -0.03]), p)
    later[:wrong, 2] += rng.uniform(1.0, 9.0, wrong)
    z = np.stack([project(CAMERA, p), project(CAMERA, later)], axis=1)
    return Views(z + rng.normal(0, noise_px, z.shape), np.ones(z.shape))


def _steps(count: int, right: float = 1.0) -> bool:
    views = _step_views(count, round((1.0 - right) * count))
    return step_by_images(CAMERA, *linked_points(CAMERA, views)) is not None


def _linked(disparity_px: float) -> int:
    z = np.tile([300.0, 200.0, 300.0 - disparity_px, 200.0], (5, 2, 1))
    return len(linked_points(CAMERA, Views(z, np.ones(z.shape)))[0])


def _explained(off_px: float) -> bool:
    p = np.array([[0.0, 0.0, 5.0]])
    seen = project(CAMERA, p) + np.array([off_px, 0.0, 0.0, 0.0])
    return explained_share(CAMERA, np.eye(4), p, seen) > 0.0


def _pulled_px() -> float:
    """By how many pixels features that are off by 8 px, three of ten, pull the rotation of the
    others.
    """
    rng = np.random.default_rng(2)
    p = np.column_stack([rng.uniform(-1, 1, (200, 2)), rng.uniform(10, 20, 200)])
    z = project(CAMERA, p)
    z[:60, [0, 2]] += 8.0
    T = step_by_images(CAMERA, p, z)
    assert T is not None
    return float(np.median((project(CAMERA, transform_points(T, p)) - project(CAMERA, p))[60:, 0]))


def _lost(usable: float = 1.0, off_px: float = 0.0) -> bool:
    tracks: Any = SimpleNamespace(
        rows=np.arange(round(100 * usable)), newest_innovation=lambda: off_px
    )
    nothing: Any = SimpleNamespace()
    return is_lost(nothing, nothing, tracks, 100, Views(np.zeros((0, 4)), np.zeros((0, 4))))


STEPS: dict[str, tuple[Says, float, float]] = {
    "features": (lambda n: _steps(int(n)), 11, 12),
    "features that agree": (lambda x: _steps(100, x), 0.45, 0.55),
    "disparity": (lambda x: _linked(x) > 0, 1.7, 2.3),
    "explained": (lambda x: not _explained(x), 3.5, 4.5),
    "pulled": (lambda x: _pulled_px() < x, 0.3, 0.6),
    "lost: usable tracks": (lambda x: not _lost(x), 0.45, 0.55),
    "lost: pixels": (lambda x: _lost(off_px=x), 13.0, 17.0),
}


# Fits, gates and rows


class _Fit(WindowFit):
    """A fit whose steps leave given residuals."""

    def __init__(self, residuals: list[float]) -> None:
        super().__init__(RigCalibration(CAMERA, SETTINGS), SETTINGS)
        self.left = residuals
        self.steps = 0

    def information(self, *_: object) -> Any:
        return np.eye(1), np.zeros(1), None

    def move_to_optimum(self, *_: object) -> Any:
        self.steps += 1

    def linearise(self, *_: object) -> Any:
        px = self.left.pop(0)
        return SimpleNamespace(rows=[], stereo=None, newest_innovation=lambda: px)


def _fit_steps(first_px: float, residuals: list[float]) -> int:
    fit = _Fit(residuals)
    tracks: Any = SimpleNamespace(rows=[], stereo=None)
    nothing: Any = None
    fit.fit(nothing, tracks, nothing, first_px)
    return fit.steps


def _dropped(score: float, frames: int = 60) -> bool:
    """Whether a landmark is dropped whose pixels are off by so many standard deviations of a
    chi-square in each frame.
    """
    gate = LandmarkGate(0.9999)
    dof = np.array([3])
    nis = dof + score * np.sqrt(2.0 * dof)
    return any(gate.check(np.array([1]), nis, dof)[1][0] for _ in range(frames))


def _rows(matches: int = 100, offset_px: float = 1.0, at: FloatArray | None = None) -> Observations:
    z = np.random.default_rng(0).uniform(50.0, 400.0, (matches, 4))
    if at is not None:
        z[:] = at
    z[:, 2] = z[:, 0] - 20.0
    z[:, 3] = z[:, 1] + offset_px
    return observations(0, 0, np.arange(matches), z)


def _offset_px(matches: int) -> float | None:
    model = VerticalDisparityModel(CAMERA)
    model.update(_rows(matches))
    return model.offset_px


def _learned_rows(frames: int) -> float:
    """The offset of rows, px, after 50 frames of one pixel and some of none."""
    model = VerticalDisparityModel(CAMERA)
    for _ in range(50):
        model.update(_rows())
    for _ in range(frames):
        model.update(_rows(offset_px=0.0))
    return float(CAMERA.fv * model.coefficients[0])


def _unseen_rows() -> float:
    """Standard deviation of a slope of rows that matches in one place do not show, over that of a
    match.
    """
    model = VerticalDisparityModel(CAMERA)
    seen = _rows(at=np.array([CAMERA.cu, CAMERA.cv, 0.0, 0.0]))
    z = seen.z.copy()
    z[:, 3] += np.where(np.arange(len(z)) % 2, 0.1, -0.1)
    model.update(replace(seen, z=z))
    return float(np.sqrt(model.covariance[1, 1])) * CAMERA.fv / 0.1


def _moved_rows(frames: int) -> bool:
    model = VerticalDisparityModel(CAMERA)
    for k in range(frames):
        model.update(_rows(offset_px=0.0 if k == 0 else 3.0))
    return model.moved_px > 0.0


def _depth_known(parallax_px: float, camera: StereoCamera) -> bool:
    """Whether a depth is known that two left views, apart by so many pixels for the point at 5 m,
    tell.
    """
    depth_m = 5.0
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = -parallax_px * depth_m / camera.fu
    p = np.array([[0.0, 0.0, depth_m]])
    z = np.stack([project(camera, transform_points(t, p)) for t in T], axis=1)
    weight = np.zeros(z.shape)
    weight[..., :2] = 1.0
    views = Views(z, weight)
    return bool(linearised_points(camera, T, p, views, 0, 1.0)[2][0])


def _too_fast(speed_mps: float) -> bool:
    nav = replace(REST, velocity=np.array([speed_mps, 0.0, 0.0]))
    window: Any = SimpleNamespace(prior=SimpleNamespace(P=np.eye(1)), nav=nav)
    try:
        _check_sane(window, np.eye(1), "imu", 0)
    except DivergedError:
        return True
    return False


def _has_scale(moved_m: float) -> bool:
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = moved_m
    posterior: Any = SimpleNamespace(clones=SimpleNamespace(T_world_imu=T), P=np.eye(12))
    return scale_sigma(posterior) is not None


FITS: dict[str, tuple[Says, float, float]] = {
    "steps: far": (lambda x: _fit_steps(x, [0.1 * x, 0.0]) > 1, 0.43, 0.57),
    "steps: progress": (lambda x: _fit_steps(9.0, [9.0 / x, 9.0 / x]) > 1, 1.15, 1.4),
    "steps: largest number": (
        lambda n: _fit_steps(9e9, [9e9 * 0.5 ** (k + 1) for k in range(9)]) < n,
        4,
        5,
    ),
    "landmark: dropped": (_dropped, 1.35, 1.65),
    "rows: matches": (lambda n: _offset_px(int(n)) is not None, 29, 30),
    "rows: memory": (lambda n: _learned_rows(int(n)) < 0.5, 25, 42),
    "rows: prior": (lambda x: _unseen_rows() < x, 5.5, 9.5),
    "rows: moved": (lambda n: _moved_rows(int(n)), 5, 6),
    "depth: by parallax": (lambda x: _depth_known(x, CAMERA), 9.3, 11.2),
    "depth: of one camera": (lambda x: _depth_known(x, MONO), 8.0, 11.5),
    "speed": (_too_fast, 85.0, 115.0),
    "motion that has a scale": (_has_scale, 0.85e-3, 1.15e-3),
}


# The paper's filter


def _vislam(**changes: Any) -> Vislam:
    settings = replace(VislamSettings(), **{"motion_model": "twist", **changes})
    return Vislam(CAMERA, np.eye(4), settings, motion_sensor=False)


def _seen_at(depth_m: float, count: int = 8, frame: int = 0) -> Observations:
    rng = np.random.default_rng(0)
    p = np.column_stack([rng.uniform(-0.3, 0.3, (count, 2)) * depth_m, np.full(count, depth_m)])
    return observations(frame, STEP_NS * frame, np.arange(count), project(CAMERA, p))


def _maps(depth_m: float) -> bool:
    return _vislam().update(_seen_at(depth_m)).initialised > 0


def _landmark_gain(sigma_m: float) -> float:
    """How far a first landmark at 5 m follows a second view of it, at a known pose, that locates it
    sideways with a standard deviation.
    """
    px_per_m = CAMERA.fu / 5.0
    settings = {"landmark_prior": "isotropic", "mode": "mapping", "gate_probability": None}
    vislam = _vislam(pixel_sigma_px=sigma_m * px_per_m * np.sqrt(2.0), **settings)
    seen = observations(0, 0, [1], project(CAMERA, np.array([[0.0, 0.0, 5.0]])))
    vislam.update(seen)
    vislam.update(
        replace(seen, frame_index=1, time_ns=STEP_NS, z=seen.z + np.tile([0.1 * px_per_m, 0.0], 2))
    )
    return float(vislam.landmarks().p_world[0, 0]) / 0.1


def _pose_updated(features: int) -> bool:
    vislam = _vislam()
    vislam.update(_seen_at(5.0, features))
    vislam.update(_seen_at(5.0, features, 1))
    return bool(np.trace(vislam.estimate().covariance) < 0.1)


def _start_gain(row: int, sigma: float) -> float:
    """How much of a velocity or rate of a standard deviation is believed at the start."""
    name = "linear_velocity_sigma_mps" if row < 3 else "angular_rate_sigma_radps"
    motion = DriftingTwist(replace(VislamSettings(), **{name: sigma}))  # type: ignore[arg-type]
    state = motion.take(motion.start(np.eye(4)), VelocitySample(0, np.ones(3), np.ones(3)))
    assert state.twist is not None
    return float(state.twist[row])


VISLAM: dict[str, tuple[Says, float, float]] = {
    "near": (_maps, 0.26, 0.34),
    "far": (lambda x: not _maps(x), 130.0, 170.0),
    "features": (lambda n: _pose_updated(int(n)), 2, 3),
    "first landmark": (lambda x: _landmark_gain(x) < 0.5, 0.85, 1.15),
    "velocity": (lambda x: _start_gain(0, x) < 0.5, 8.5, 11.5),
    "rate": (lambda x: _start_gain(3, x) < 0.5, 0.85, 1.15),
}
TABLES = {
    f"{what}: {name}": row
    for what, table in (
        ("start", START),
        ("jump", JUMP),
        ("steps", STEPS),
        ("fits", FITS),
        ("vislam", VISLAM),
    )
    for name, row in table.items()
}


@pytest.mark.parametrize(("says", "below", "above"), TABLES.values(), ids=TABLES)
def test_limits_of_starts_and_fits(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
