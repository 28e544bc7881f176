"""Priors, random walks and weights of the filters, by what an estimate makes of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, T_CAM0_IMU
from vio.errors import DataError
from vio.filters import rig_calibration
from vio.filters.imu_terms import significant, term_sigmas, usual_reading
from vio.filters.inputs import InputOrder
from vio.filters.navigation import NO_STEP, ImuMotion, Measurement, NavState, TwistMotion
from vio.filters.online_calibration import Calibration, prior_variances, walk_variances
from vio.filters.propagation import Propagation, first_imu_noise
from vio.filters.restart import GoodState, restarted
from vio.filters.settings import MsckfSettings
from vio.filters.track_records import Residuals
from vio.filters.tracks import precision
from vio.filters.window_tracks import WindowTracks, chi_square_table
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.imu.settings import DEFAULT_IMU
from vio.records import ImuSample, VelocitySample, observations

Says = Callable[[float], bool]
SETTINGS = MsckfSettings()
ALL_TERMS = MsckfSettings(calibrate_imu="full")
REST = NavState(np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))


def _gain(P: FloatArray, measured: Measurement, row: int, state: int) -> float:
    """By how much of a residual in a row of a measurement one entry of the state moves."""
    H = measured.H
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + measured.R)
    return float(K[state, row])


# What a motion model begins with


def _velocity_gain(sigma_mps: float) -> float:
    settings = replace(SETTINGS, linear_velocity_sigma_mps=sigma_mps)
    return _start_gain(settings, 0, 6)


def _rate_gain(sigma_radps: float, known: bool) -> float:
    """Gain of the rate, or where images know that already, of its bias."""
    settings = replace(SETTINGS, angular_rate_sigma_radps=sigma_radps)
    return _start_gain(settings, 3, 12 if known else 9, known=known)


def _start_gain(settings: MsckfSettings, row: int, state: int, known: bool = False) -> float:
    motion = TwistMotion(settings)
    motion.take(VelocitySample(0, np.ones(3), np.ones(3)))
    measured = motion.measurement(REST)
    assert measured is not None
    P = motion.start_covariance()
    if known:
        P[9:12, 9:12] = 0.0
    return _gain(P, measured, row, state)


def _rest_gain(sigma: float, state: int) -> float:
    """Gain of a standstill on a velocity or rate of a standard deviation."""
    measured = TwistMotion(SETTINGS).zero_velocity(REST, None)
    return _gain(sigma**2 * np.eye(15), measured, state - 6, state)


def _walked(seconds: float) -> float:
    """Standard deviation of a rate's bias after some time."""
    step = TwistMotion(SETTINGS).advance(REST, 0, round(1e9 * seconds))
    return float(np.sqrt(step.Q[12, 12]))


def _imu(samples: int, period_ms: float = 5.0) -> ImuMotion:
    motion = ImuMotion(SETTINGS)
    force = np.array([0.1, 0.2, 9.8])
    motion.take_all(
        [ImuSample(round(1e6 * period_ms * k), 0.01 * force * k, force) for k in range(samples)]
    )
    return motion


def _noise_of_rate(samples: int, period_ms: float = 5.0) -> float:
    return _imu(samples, period_ms).rate_variance(np.ones(2))


def _is_reached(late_ms: float) -> bool:
    """Whether a frame so long after the last sample is estimated at its own time."""
    motion = _imu(5)
    time_ns = 20_000_000 + round(1e6 * late_ms)
    return motion.covered(time_ns) == time_ns


def _first_noise(kind: str) -> float:
    """Noise density of the first step, over that of the settings."""
    if kind == "imu":
        propagation = Propagation("imu", SETTINGS, DEFAULT_IMU)
        propagation.motion = _imu(5)
        density = DEFAULT_IMU.accel_noise_density
    else:
        propagation = Propagation(None, SETTINGS, DEFAULT_IMU)
        density = SETTINGS.acceleration_density
    step = propagation.motion.advance(REST, 0, 20_000_000, propagation.noise.factors)
    return float(np.sqrt(step.Q[6, 6] / 0.02)) / density


def _tilted_noise(tilt_deg: float) -> float:
    P = np.zeros((15, 15))
    P[3:5, 3:5] = np.radians(tilt_deg) ** 2 * np.eye(2)
    return float(first_imu_noise(P).factors[0])


def _is_lost(seconds: float) -> bool:
    """Whether a rotation is lost after some time without features or sensor, in which a drifting
    rate of 1 rad/s in a second turns the body by `seconds ** 1.5 / sqrt(3)`.
    """
    propagation = Propagation(
        None, replace(SETTINGS, angular_acceleration_density=1.0), DEFAULT_IMU
    )
    step = propagation.motion.advance(REST, 0, round(1e9 * seconds))
    propagation.blind = True
    propagation.since_frame = NO_STEP.then(step)
    return propagation.is_lost


MOTION: dict[str, tuple[Says, float, float]] = {
    "velocity": (lambda x: _velocity_gain(x) < 0.5, 8.5, 11.5),
    "rate": (lambda x: _rate_gain(x, known=False) < 0.5, 0.85, 1.15),
    "bias of the rate": (lambda x: _rate_gain(x, known=True) < 0.5, 0.017, 0.023),
    "standstill: velocity": (lambda x: _rest_gain(x, 6) > 0.5, 0.017, 0.023),
    "standstill: rate": (lambda x: _rest_gain(x, 9) > 0.5, 0.0085, 0.0115),
    "walk of the bias": (lambda s: _walked(s) > 1e-3, 80.0, 120.0),
    "usual period": (lambda ms: _noise_of_rate(1) > _noise_of_rate(9, ms), 4.2, 5.8),
    "samples end": (_is_reached, 27.0, 33.0),
    "first noise of an IMU": (lambda x: _first_noise("imu") < x, 0.85, 1.15),
    "first noise without sensor": (lambda x: _first_noise("none") < x, 0.85, 1.15),
    "tilt: largest noise": (lambda x: _tilted_noise(x) == _tilted_noise(90.0), 28.0, 36.0),
    "rotation is lost": (_is_lost, 1.3, 1.6),
}


# A new start


def _unseen(seconds: float) -> tuple[float, float, float]:
    """After some time in which a body that flew at 4 m/s was not seen: how far it is taken to have
    moved, and standard deviations of that, m, and of its rotation, rad.
    """
    nav = replace(REST, velocity=np.array([4.0, 0.0, 0.0]))
    good = GoodState(0, 0, nav, np.zeros((15, 15)), Calibration(T_CAM0_IMU))
    moved, P = restarted(good, round(1e9 * seconds), TwistMotion(SETTINGS))
    return (
        float(moved.T_world_imu[0, 3]),
        float(np.sqrt(P[0, 0])),
        float(np.sqrt(P[5, 5])),
    )


RESTART: dict[str, tuple[Says, float, float]] = {
    "as fast as before": (lambda s: _unseen(s)[0] == _unseen(9.0)[0], 0.42, 0.58),
    "slower than 1 m/s": (lambda x: _unseen(0.1)[1] < x * 0.1, 4.8, 5.2),
    "turns": (lambda x: _unseen(1.0)[2] < x, 0.85, 1.15),
}


# Calibration


def _gain_of(sigma: float, measured: float) -> float:
    return sigma**2 / (sigma**2 + measured**2)


def _walk(name: str, row: int, seconds: float) -> float:
    """Standard deviation that a constant has moved by in some time."""
    return float(np.sqrt(walk_variances(ALL_TERMS)[name][row] * seconds))


def _share_walked(name: str, row: int, seconds: float) -> float:
    """The same, over the initial one."""
    return _walk(name, row, seconds) / float(np.sqrt(prior_variances(ALL_TERMS)[name][row]))


def _field(rows: float) -> FloatArray:
    """Standard deviations of the right columns' field, in focal lengths, by that of the rows."""
    return rig_calibration.field_sigmas(CAMERA, rows * CAMERA.fu, 1e-3)


def _doubt_of_bent_field() -> float:
    """What a field that grows with the square of x makes of the scale, over what it would if its
    mean over the image were the square of the largest x.
    """
    settings = replace(SETTINGS, stereo_baseline_sigma=0.01, stereo_focal_sigma=0.0)
    camera = StereoCamera(100.0, 100.0, 100.0, 100.0, 0.1, 200, 200)
    field = np.zeros(8)
    field[2] = 1.0
    doubt = rig_calibration.field_doubt(camera, settings, field, np.zeros((8, 8)))
    return doubt / 0.01 * np.radians(settings.stereo_yaw_sigma_deg)


def _lever(deviation: float) -> bool:
    """Whether readings that deviate for a second, in noise of one, say something of a scale."""
    usual = np.zeros(6)
    readings = np.array([deviation, 0.0, 0.0, deviation, 0.0, 0.0])
    return bool(significant(readings[None], usual, 1.0, np.ones(2)).any())


CALIBRATION: dict[str, tuple[Says, float, float]] = {
    "IMU: scale": (lambda x: _gain_of(term_sigmas()[0], x) < 0.5, 0.0085, 0.0115),
    "IMU: misalignment": (
        lambda deg: _gain_of(term_sigmas().min(), np.radians(deg)) < 0.5,
        0.43,
        0.57,
    ),
    "IMU: walk": (lambda s: _share_walked("imu_terms", 0, s) > 1.0, 3e4, 5e4),
    "IMU: lever in noise": (_lever, 20.0, 25.0),
    "IMU: averaged": (lambda s: usual_reading(np.zeros(6), np.ones((1, 6)), s)[0] > 0.5, 0.6, 0.8),
    "extrinsics: rotation": (
        lambda s: np.degrees(_walk("extrinsics", 3, s)) > 0.02,
        80.0,
        120.0,
    ),
    "extrinsics: translation": (lambda s: _walk("extrinsics", 0, s) > 1e-3, 80.0, 120.0),
    "time offset": (lambda s: _walk("time_offset", 0, s) > 2e-5, 80.0, 120.0),
    "field: walk": (lambda s: _share_walked("stereo_field", 0, s) > 1.0, 2000.0, 3000.0),
    "field: least": (lambda x: _field(x)[1] > _field(0.0)[1], 1.45e-4, 1.9e-4),
    "field: largest": (lambda x: _field(x)[1] == _field(1.0)[1], 5.8e-4, 7.5e-4),
    "field: columns by rows": (lambda x: _field(3e-4)[1] < x * 3e-4, 2.6, 3.4),
    "field: common": (lambda x: _field(x / 3.0)[7] > _field(0.0)[7], 0.85e-3, 1.15e-3),
    "field: radial": (lambda x: _field(1e-3)[4] < x * _field(1e-3)[6], 4.3, 5.7),
    "field: mean of a bent one": (lambda x: _doubt_of_bent_field() < x, 0.40, 0.435),
    "principal point": (
        lambda x: rig_calibration.constant_sigmas(SETTINGS)[2] < x * SETTINGS.stereo_focal_sigma,
        0.28,
        0.39,
    ),
}


# Pixels


def _noise(
    ratio: float, tracks: int = 100, freedom: int = 10, fitted: float = 0.0, before: int = 0
) -> float:
    """Learned variance of a pixel over that before, in a frame in which the median of squared
    residuals has a ratio to what was believed then; so many frames before it had the right one.
    """
    settings = replace(SETTINGS, pixel_sigma_max_px=1e6, pixel_sigma_px=1.0)
    learner = WindowTracks(CAMERA, settings)
    dof = np.full(tracks, freedom)
    median = chi_square_table(0.5)[dof]
    for _ in range(before):
        learner.update_pixel_noise(median * (1.0 - 3.0 / dof.sum()), dof, 0.0)
    start = learner.variance
    learner.update_pixel_noise(median * ratio, dof, fitted)
    return learner.variance / start


def _learned_px(px: float, camera: StereoCamera = CAMERA) -> float:
    """The noise that is learned of pixels that have it."""
    settings = replace(SETTINGS, pixel_sigma_px=0.5)
    learner = WindowTracks(camera, settings)
    dof = np.full(100, 10)
    for _ in range(200):
        squares = np.full(100, chi_square_table(0.5)[10]) * px**2 / learner.variance
        learner.update_pixel_noise(squares, dof, 0.0)
    return float(np.sqrt(learner.variance))


ONE = StereoCamera(460.0, 458.0, 370.0, 240.0, 0.1, 752, 480, kind="mono")


def _gated(square: float, tracks: int = 20, views: int = 3) -> tuple[float, int]:
    """By how much larger the noise of a frame counts whose residuals are so much larger, and the
    degrees of freedom of its tracks, whose views are of the left camera.
    """
    learner = WindowTracks(CAMERA, SETTINGS)
    J = np.zeros((tracks, views, 4, 3))
    J[:, :, :2] = 1.0
    r = np.zeros((tracks, views, 4))
    expected = chi_square_table(0.25)[min(2 * views - 3, 199)]
    r[:, 0, 0] = np.sqrt(square * expected * learner.variance)
    dof = learner.gate(Residuals(r, J, np.ones(tracks, np.bool_), np.ones(r.shape)))[2]
    return learner.common_noise, int(dof[0])


def _agree(share: float) -> bool:
    J = np.zeros((100, 3, 4, 3))
    J[:, :, :2] = 1.0
    r = np.zeros((100, 3, 4))
    r[round(100 * share) :, -1, 0] = 100.0
    learner = WindowTracks(CAMERA, SETTINGS)
    return learner.agree(Residuals(r, J, np.ones(100, np.bool_), np.ones(r.shape)))


def _going_on(clones: int = 4, most: int = 100) -> int:
    """Tracks that are chosen though they go on, beside more that end than may be used."""
    learner = WindowTracks(CAMERA, replace(SETTINGS, max_features=most))
    z = np.random.default_rng(0).uniform(10.0, 300.0, (400, 4))
    for k in range(clones):
        ids = np.arange(400)
        used = ids[(ids < 200) | (k > 0)] if k < clones - 1 else ids[200:]
        learner.table.add_frame(k, observations(k, k, used, z[used]))
    rows = learner.choose(clones)
    seen = learner.table.seen(rows)
    return int((seen[:, clones - 1] & ~seen[:, 0]).sum())


def _weights(sigma: float) -> FloatArray:
    """Weights of a pixel of a standard deviation over that of its frame's median."""
    sigmas = np.ones((21, 3), dtype=np.float32)
    sigmas[0] = sigma
    seen = observations(0, 0, np.arange(21), np.ones((21, 4)))
    return precision(replace(seen, sigma=sigmas))[0]


def _accepts(size: float) -> bool:
    order = InputOrder("filter")
    try:
        order.sample(ImuSample(0, np.zeros(3), np.array([size, 0.0, 0.0])))
    except DataError:
        return False
    return True


PIXELS: dict[str, tuple[Says, float, float]] = {
    "noise: tracks": (lambda n: _noise(2.0, tracks=int(n)) > 1.2, 14, 15),
    "noise: least": (lambda x: _learned_px(x) > 1.001 * _learned_px(0.0), 0.026, 0.034),
    "noise: least of one camera": (
        lambda x: _learned_px(x, ONE) > 1.001 * _learned_px(0.0, ONE),
        0.087,
        0.115,
    ),
    "noise: first frame": (lambda x: np.log(_noise(4.0)) < x * np.log(4.0), 0.89, 0.925),
    "noise: later frames": (
        lambda x: np.log(_noise(3.0, before=200)) < x * np.log(3.0),
        0.043,
        0.058,
    ),
    "noise: largest change": (
        lambda x: _noise(x, before=200) == _noise(99.0, before=200),
        3.4,
        4.6,
    ),
    "noise: freedom": (lambda n: _noise(n / 15.0, 15, 1, 6.0) > 1.0, 5, 6.5),
    "frame: largest noise": (lambda x: _gated(x)[0] == _gated(99.0)[0], 3.4, 4.6),
    "frame: freedom": (lambda n: _gated(1.0, 3, int(n))[1] == _gated(1.0, 3, 160)[1], 98, 103),
    "frame: agrees": (_agree, 0.75, 0.85),
    "chosen: going on": (lambda n: _going_on() < n, 9, 11),
    "stated: least weight": (lambda x: _weights(x)[0] == _weights(99.0)[0], 8.5, 11.5),
    "stated: largest weight": (lambda x: _weights(1.0 / x)[0] == _weights(1e-3)[0], 2.6, 3.4),
    "samples": (lambda x: not _accepts(x), 0.85e6, 1.15e6),
}
TABLES = {
    f"{what}: {name}": row
    for what, table in (
        ("motion", MOTION),
        ("restart", RESTART),
        ("calibration", CALIBRATION),
        ("pixels", PIXELS),
    )
    for name, row in table.items()
}


@pytest.mark.parametrize(("says", "below", "above"), TABLES.values(), ids=TABLES)
def test_priors_of_filters(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


def test_rows_are_off_by_focal_lengths_of_rows() -> None:
    """Of pixels that are not square."""
    camera = StereoCamera(800.0, 400.0, 320.0, 120.0, 0.1, 640, 240)
    assert rig_calibration.rows_off(camera, 1.0) == 1.0 / 400.0
    square = replace(camera, fu=400.0)
    np.testing.assert_array_equal(
        rig_calibration.field_sigmas(camera, 1.0, 1e-3),
        rig_calibration.field_sigmas(square, 1.0, 1e-3),
    )
