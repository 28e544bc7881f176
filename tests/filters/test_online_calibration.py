"""Online calibration of camera and IMU: its Jacobians, what it finds on exact flights, and that
off means off.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU, Flight, _world_points
from tests.jacobians import numeric_jacobian
from tests.true_world import TrueWorld
from vio.errors import ConfigError
from vio.filters import online_calibration
from vio.filters.msckf import Msckf
from vio.filters.navigation import DIM, ImuMotion, NavState, Transition
from vio.filters.online_calibration import Twist, body_twist, first_calibration
from vio.filters.settings import MsckfSettings
from vio.filters.window import Window
from vio.geometry.lie import (
    FloatArray,
    se3_adjoint,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    se3_log,
    so3_exp,
    so3_hat,
    so3_log,
)
from vio.geometry.stereo import StereoCamera
from vio.imu.settings import DEFAULT_IMU
from vio.records import Estimate, ImuSample

# the stereo pair
EXACT = MsckfSettings(
    calibrate_stereo="off", stereo_baseline_sigma=0.0, stereo_focal_sigma=0.0, calibrate_imu="off"
)
BOTH = replace(EXACT, calibrate_camera_imu="both")
OFF = replace(EXACT, calibrate_camera_imu="none")


@pytest.fixture
def no_walk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Estimate the calibration as constants."""
    still = online_calibration._WALKS._replace(
        extrinsic_rotation_deg=0.0, extrinsic_translation_m=0.0, time_offset_s=0.0
    )
    monkeypatch.setattr(online_calibration, "_WALKS", still)


class Shaking(Flight):
    """A flight that turns about all axes as fast as a hand does, so that everything is
    observable.
    """

    def state(self, t: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        if self.still:
            return super().state(t)
        _, p, v, a, _ = super().state(t)

        def attitude(s: float) -> FloatArray:
            return so3_exp([0, 0, 0.5 * np.sin(2.3 * s)]) @ so3_exp(
                [0.4 * np.sin(2.9 * s), 0.4 * np.sin(1.9 * s), 0]
            )

        h = 1e-5
        omega = so3_log(attitude(t - h).T @ attitude(t + h)) / (2 * h)
        return attitude(t), p, v, a, omega


class Straight(Flight):
    """A flight at constant velocity."""

    def state(self, t: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        v = np.array([0.0, 1.5, 0.5])
        return np.eye(3), v * t, v, np.zeros(3), np.zeros(3)


@dataclass(frozen=True, slots=True)
class Run:
    """What a run left behind, beside the truth."""

    positions: FloatArray  # (frames, 3) error of the body in the world, m
    estimates: list[Estimate]
    T_cam0_imu_error: FloatArray  # (frames, 6) xi in truth = T_hat exp(xi)
    time_offset_error_s: FloatArray  # (frames,)

    @property
    def rms_m(self) -> float:
        """Root mean square of the position error after the first 5 s."""
        return float(np.sqrt(np.mean(np.sum(self.positions[100:] ** 2, axis=1))))

    def calibration_nees(self, k: int) -> float:
        """Squared error of all seven at a frame, over their covariance; offset and extrinsics
        taken one by one.
        """
        e, xi = self.estimates[k], self.T_cam0_imu_error[k]
        out = xi @ np.linalg.solve(e.T_cam0_imu_covariance, xi)
        return float(out + (self.time_offset_error_s[k] / e.time_offset_sigma_s) ** 2)


def _samples(flight: Flight, offset_s: float, noise: np.random.Generator) -> list[ImuSample]:
    """IMU samples at 200 Hz whose stamps are `offset_s` ahead of the frames' clock."""
    bias = noise.normal(0, [0.02] * 3 + [0.05] * 3)
    sigmas = np.repeat(
        [DEFAULT_IMU.gyro_noise_density, DEFAULT_IMU.accel_noise_density], 3
    ) * np.sqrt(200.0)
    out = []
    for k in range(-20, 10 * flight.frames + 20):
        R, _, _, a, omega = flight.state(k / 200)
        reading = (
            np.concatenate([omega, R.T @ (a + np.array([0, 0, 9.81]))])
            + bias
            + noise.normal(0, sigmas)
        )
        out.append(ImuSample(5_000_000 * k + round(1e9 * offset_s), reading[:3], reading[3:]))
    return out


def fly_with(
    filt: Msckf, flight: Flight, samples: list[ImuSample], noise: np.random.Generator, sigma: float
) -> tuple[list[Estimate], FloatArray]:
    """Feed a filter with a flight; return its estimates and the errors of their positions
    (frames, 3), m.
    """
    estimates: list[Estimate] = []
    positions, fed, world = [], 0, TrueWorld(filt, upright=True)
    for k in range(flight.frames):
        # As in the pipeline: with the sample at or after the exposure, by the offset estimated so
        # far.
        exposed_ns = k * STEP_NS + round(
            1e9 * max((estimates[-1].time_offset_s or 0.0) if estimates else 0.0, 0.0)
        )
        while fed == 0 or samples[fed - 1].time_ns < exposed_ns:
            filt.propagate(samples[fed])
            fed += 1
        filt.update(flight.observe(k, sigma, noise, 40))
        e = filt.estimate()
        estimates.append(e)
        T_true = flight.T_world_imu(k)
        positions.append((world.meet(k, T_true) - T_true)[:3, 3])
    return estimates, np.array(positions)


def _fly(
    flight: Flight,
    settings: MsckfSettings,
    seed: int,
    *,
    xi: FloatArray,
    offset_s: float,
    sigma: float = 0.5,
    camera: StereoCamera = CAMERA,
) -> Run:
    """Run the filter with extrinsics off by xi, clocks off by a time, and another camera than
    the one that sees.
    """
    noise = np.random.default_rng(seed)
    filt = Msckf(camera, T_CAM0_IMU @ se3_exp(xi), settings, motion="imu")
    estimates, positions = fly_with(filt, flight, _samples(flight, offset_s, noise), noise, sigma)
    found = [T_CAM0_IMU if e.T_cam0_imu is None else e.T_cam0_imu for e in estimates]
    offsets = np.array([e.time_offset_s or 0.0 for e in estimates])
    return Run(
        positions,
        estimates,
        np.array([se3_log(se3_inverse(T) @ T_CAM0_IMU) for T in found]),
        offsets - offset_s,
    )


def _drawn(seed: int) -> tuple[FloatArray, float]:
    """Errors of extrinsics (6,) and clock as the priors of the settings expect them."""
    rng = np.random.default_rng(5000 + seed)
    sigmas = [BOTH.extrinsic_translation_sigma_m, np.radians(BOTH.extrinsic_rotation_sigma_deg)]
    return rng.normal(0, np.repeat(sigmas, 3)), float(rng.normal(0, BOTH.time_offset_sigma_s))


def _off_by(seed: int) -> FloatArray:
    """An error (6,) of 2 cm and 1 degree in some direction."""
    rng = np.random.default_rng(seed)
    rho, phi = rng.normal(size=(2, 3))
    return np.concatenate(
        [0.02 * rho / np.linalg.norm(rho), np.radians(1.0) * phi / np.linalg.norm(phi)]
    )


# Jacobians


def _window(clones: int = 5, late_s: float = 0.0) -> Window:
    """Clones of a shaking flight; the body's twist is known exactly."""
    calibration = first_calibration(T_CAM0_IMU, BOTH, "imu")
    zero = np.zeros(3)
    root = np.random.default_rng(0).normal(size=(DIM + 7, DIM + 7)) * 0.01
    window = Window(
        ImuMotion(BOTH), NavState(np.eye(4), zero, zero, zero, zero), root @ root.T, calibration
    )
    window.clocks_compared = True
    for k in range(clones):
        _add_clone(window, k, late_s)
    return window


def _add_clone(window: Window, k: int, late_s: float = 0.0) -> None:
    R, p, v, _, omega = Shaking().state(0.3 + 0.05 * k)
    window.nav = NavState(se3_from_parts(R, p), v, omega, np.zeros(3), np.zeros(3))
    window.add_clone(k, k * STEP_NS, window.camera_D_own(late_s, _twist(window.nav)))


def _twist(nav: NavState) -> Twist:
    return Twist(body_twist(nav.T_world_imu, nav.velocity, nav.rate), np.zeros((6, 6)))


def _moved(window: Window, error: FloatArray) -> Window:
    out = copy.deepcopy(window)
    out.relinearise(error)
    return out


def _camera_error(T_cam0_world: FloatArray, T_moved: FloatArray) -> FloatArray:
    """World-side error (6,) of a camera's pose."""
    return se3_log(se3_inverse(T_moved) @ T_cam0_world)


def test_jacobian_of_the_cloned_camera_equals_central_differences() -> None:
    """(C2): errors of pose, extrinsics and offset, and the pose that the camera has with them."""
    window = _window(clones=0, late_s=0.0)
    R, p, v, _, omega = Shaking().state(0.7)
    window.nav = NavState(se3_from_parts(R, p), v, omega, np.zeros(3), np.zeros(3))
    twist, calibration = _twist(window.nav), window.calibration
    exposed, analytic, noise = window.camera_D_own(0.004, twist)
    T_before = calibration.T_cam0_imu @ se3_inverse(exposed)

    def camera(error: FloatArray) -> FloatArray:
        corrected = calibration.corrected(error[DIM:], window.nav.T_world_imu)
        body = (
            se3_exp(error[:6])
            @ window.nav.T_world_imu
            @ se3_exp(twist.mean * (corrected.time_offset_s - 0.004))
        )
        return _camera_error(T_before, corrected.T_cam0_imu @ se3_inverse(body))

    numeric = numeric_jacobian(camera, np.zeros(DIM + 7))
    np.testing.assert_allclose(analytic, numeric, atol=1e-6)
    np.testing.assert_array_equal(noise, 0.0)
    for name in ("extrinsics", "time_offset"):
        column = online_calibration.BLOCKS[name].camera_D_error(
            window.nav.T_world_imu, exposed, twist
        )
        np.testing.assert_allclose(column, numeric[:, window.state.blocks[name]], atol=1e-6)


def test_moving_the_means_moves_cameras_and_bodies_as_their_errors_say() -> None:
    window = _window()
    cameras, bodies = window.T_cam0_world(), window.clones.T_world_imu

    def moves(error: FloatArray) -> FloatArray:
        moved = _moved(window, np.concatenate([error[:6], np.zeros(9), error[6:]]))
        by_camera = [
            _camera_error(a, b) for a, b in zip(cameras, moved.T_cam0_world(), strict=True)
        ]
        by_body = [
            se3_log(b @ se3_inverse(a))
            for a, b in zip(bodies, moved.clones.T_world_imu, strict=True)
        ]
        return np.concatenate([*by_camera, *by_body])

    numeric = numeric_jacobian(moves, np.zeros(6 + 7 + 30))
    np.testing.assert_allclose(numeric[:30, 13:], np.eye(30), atol=1e-6)
    np.testing.assert_allclose(numeric[:30, :13], 0.0, atol=1e-6)
    np.testing.assert_allclose(numeric[30:, 6:], window.body_D_error()[:, DIM:], atol=1e-6)


def test_the_extrinsics_error_moves_with_the_body() -> None:
    """(C4): a wrong mount stays the same wrong mount, and its random walk is that of the mount."""
    window, delta = _window(clones=0), np.array([0.01, -0.02, 0.03, 0.01, 0.02, -0.01])
    R, p, *_ = Shaking().state(0.9)
    nav = NavState(se3_from_parts(R, p), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    rows = np.r_[window.state.blocks["extrinsics"]]
    P = np.zeros_like(window.prior.P)
    before = se3_adjoint(window.nav.T_world_imu) @ delta
    P[np.ix_(rows, rows)], window.prior.delta[rows] = np.outer(before, before), before
    window.prior.P = P
    walk = np.r_[np.full(6, 1e-6), 0.0]
    window.propagate(
        Transition(nav, np.eye(DIM), np.zeros((DIM, DIM)), np.zeros((2, DIM, DIM))), walk
    )
    back = se3_adjoint(se3_inverse(nav.T_world_imu))
    np.testing.assert_allclose(back @ window.prior.delta[rows], delta, atol=1e-12)
    own = back @ window.prior.P[np.ix_(rows, rows)] @ back.T
    np.testing.assert_allclose(own, np.outer(delta, delta) + 1e-6 * np.eye(6), atol=1e-12)


def test_exposures_are_where_the_images_saw_them_when_the_clocks_are_first_compared() -> None:
    """Whatever the offset: the body's pose and velocity at the IMU's time are what it makes
    uncertain.
    """
    window = _window(clones=1)
    row = window.state.clones.start - 1
    window.prior.P[row], window.prior.P[:, row] = 0.0, 0.0
    window.prior.P[row, row] = sigma2 = BOTH.time_offset_sigma_s**2
    early, late = (NavState(*parts) for parts in (_nav_parts(0.3), _nav_parts(0.35)))
    window.clocks_compared, window.nav, twist = False, late, _twist(late)
    window.clones = replace(window.clones, velocities=early.velocity[None])
    own, (_, J, _) = slice(0, window.state.clones.start), window.camera_D_own(0.0, twist)
    without_offset = J @ window.prior.P[own, own] @ J.T
    window.compare_clocks(STEP_NS, 0.0, twist)
    window.add_clone(1, STEP_NS, window.camera_D_own(0.0, twist))
    new = window.state.clone(1)
    np.testing.assert_allclose(window.prior.P[new, row], 0.0, atol=1e-12)
    np.testing.assert_allclose(window.prior.P[new, new], without_offset, atol=1e-12)

    def moved(offset_s: float) -> FloatArray:
        """The state an offset later, from the one before it, in the filter's errors."""
        T = late.T_world_imu @ se3_exp(twist.mean * offset_s)
        xi = se3_log(late.T_world_imu @ se3_inverse(T))
        acceleration = (late.velocity - early.velocity) / 0.05
        return np.concatenate(
            [xi, late.velocity - so3_exp(xi[3:]) @ (late.velocity + acceleration * offset_s)]
        )

    lever = (moved(1e-6) - moved(-1e-6)) / 2e-6
    np.testing.assert_allclose(window.prior.P[:9, row] / sigma2, lever, atol=1e-6)


def _nav_parts(t: float) -> tuple[FloatArray, ...]:
    R, p, v, _, omega = Shaking().state(t)
    return se3_from_parts(R, p), v, omega, np.zeros(3), np.zeros(3)


def test_a_twist_within_its_noise_teaches_nothing_and_adds_its_noise() -> None:
    """(C3): a twist of one standard deviation has no lever on the offset, one of fifty nearly
    its whole.
    """
    sigma = np.diag([1e-2, 1e-2, 1e-2, 1e-3, 1e-3, 1e-3])
    unknown, known = (Twist(np.full(6, k) * np.diag(sigma), sigma**2) for k in (1.0, 50.0))
    np.testing.assert_array_equal(unknown.significant(), 0.0)
    np.testing.assert_allclose(known.significant(), known.mean, rtol=2e-3)
    window = _window(clones=1)
    row = window.state.clones.start - 1
    window.nav = replace(window.nav, T_world_imu=np.eye(4))
    _, _, noise = window.camera_D_own(window.calibration.time_offset_s - 0.004, unknown)
    np.testing.assert_allclose(noise, sigma**2 * (window.prior.P[row, row] + 0.004**2), atol=1e-6)


def test_new_anchor_of_the_landmarks_changes_no_prediction() -> None:
    """Where the camera will see a landmark, by all errors together: the same before and after
    the anchor moves.
    """
    window = _window()
    points = _world_points(window.T_cam0_world(), 2)
    A = np.random.default_rng(1).normal(size=(6, len(window.prior.P))) * 0.3
    window.add_landmarks(np.array([3, 8]), points, A, np.array([np.eye(3) * 1e-3] * 2))

    def spreads(window: Window, anchor: int) -> FloatArray:
        """Covariance of `dp` of the first landmark, as it stands in the world."""
        J = np.zeros((3, 6 * len(window.clones)))
        J[:, 6 * anchor + 3 : 6 * anchor + 6] = -so3_hat(points[0])
        J = window.state.jacobian(J)
        J[:, window.state.landmarks.start : window.state.landmarks.start + 3] = np.eye(3)
        out: FloatArray = J @ window.prior.P @ J.T
        return out

    before = spreads(window, 4)
    _add_clone(window, 5)
    np.testing.assert_allclose(spreads(window, 5), before, rtol=1e-9, atol=1e-12)


def test_velocities_follow_the_flow_back_in_time() -> None:
    """Correct a state and integrate, or integrate and correct: the earlier velocity is the same
    to first order.
    """
    motion = ImuMotion(EXACT)
    for k in range(41):
        motion.take(ImuSample(5_000_000 * k, np.array([0.3, -0.2, 0.5]), np.array([0.4, 0.1, 9.7])))
    early = NavState(
        se3_exp([1, 2, 3, 0.1, -0.2, 0.3]), np.array([1.0, -0.5, 0.3]), *np.zeros((3, 3))
    )
    step = motion.advance(early, 0, 200_000_000)
    rng = np.random.default_rng(0)
    e = np.concatenate([rng.normal(0, 1e-4, 9), np.zeros(3), rng.normal(0, 1e-3, 3)])
    truth = motion.corrected(early, e).velocity
    R = 0.5 * (early.T_world_imu + step.nav.T_world_imu)[None, :3, :3]
    got = motion.corrected_earlier(early.velocity[None], R, np.array([0.2]), step.Phi @ e)[0]
    np.testing.assert_allclose(got, truth, atol=5e-7)
    assert np.linalg.norm(truth - early.velocity) > 1e-5


def test_pose_at_an_exposure_follows_the_time_offset() -> None:
    window = _window(clones=1, late_s=0.0)
    window.calibration = window.calibration.corrected(
        np.array([0.0, 0, 0, 0, 0, 0, 0.006]), np.eye(4)
    )
    R, p, *_ = Shaking().state(0.3 + 0.002)
    exposed, *_ = window.camera_D_own(0.004, _twist(window.nav))
    np.testing.assert_allclose(exposed, se3_from_parts(R, p), atol=2e-5)
    fixed = Window(window.motion, window.nav, np.eye(DIM))
    np.testing.assert_array_equal(
        fixed.camera_D_own(0.004, _twist(window.nav))[0], window.nav.T_world_imu
    )


def test_the_random_walk_of_the_field_is_that_of_the_mount_whatever_the_prior() -> None:
    walks = [
        online_calibration.walk_variances(MsckfSettings(stereo_yaw_sigma_deg=yaw_deg))[
            "stereo_field"
        ]
        for yaw_deg in (0.05, 0.2)
    ]
    np.testing.assert_array_equal(walks[1], walks[0])
    assert np.sqrt(walks[0][0]) == pytest.approx(np.radians(0.001))


# On exact flights


@pytest.mark.usefixtures("no_walk")
@pytest.mark.parametrize("seed", range(2))
def test_wrong_calibration_is_found(seed: int) -> None:
    """One degree, two centimetres, eight milliseconds, either way round, after 10 s of motion
    about all axes.
    """
    flight, offset_s = Shaking(200), 0.008 * (-1) ** seed
    run = _fly(flight, BOTH, seed, xi=_off_by(seed), offset_s=offset_s)
    e, xi = run.estimates[-1], run.T_cam0_imu_error[-1]
    assert np.all(np.abs(xi) < 3 * np.sqrt(np.diag(e.T_cam0_imu_covariance)))
    assert abs(run.time_offset_error_s[-1]) < 3 * e.time_offset_sigma_s
    assert np.degrees(np.linalg.norm(xi[3:])) < 0.1
    assert np.linalg.norm(xi[:3]) < 0.012
    assert abs(run.time_offset_error_s[-1]) < 0.5e-3
    without = _fly(flight, OFF, seed, xi=_off_by(seed), offset_s=offset_s)
    assert run.rms_m < 0.8 * without.rms_m


@pytest.mark.usefixtures("no_walk")
def test_a_baseline_that_is_off_by_10_percent_is_found_where_it_is_in_doubt() -> None:
    """The accelerometer tells the scale; without landmarks until it does, as they bias what is
    open.
    """
    wide = replace(BOTH, calibrate_scale="on", stereo_baseline_sigma=0.05)
    short = replace(CAMERA, baseline_m=CAMERA.baseline_m / 1.1)
    run = _fly(Shaking(160), wide, 0, xi=np.zeros(6), offset_s=0.0, camera=short)
    scale = run.estimates[-1].stereo_scale
    percent, sigma = scale.percent()["baseline"]
    assert abs(percent - 10.0) < 3 * sigma
    assert percent > 5 * sigma


@pytest.mark.usefixtures("no_walk")
def test_covariance_of_the_calibration_can_be_believed() -> None:
    """Errors drawn from the prior: NEES of all seven, which should be 7 on average."""
    values = []
    for seed in range(4):
        xi, offset_s = _drawn(seed)
        run = _fly(Shaking(121), BOTH, seed, xi=xi, offset_s=offset_s)
        values += [run.calibration_nees(k) for k in (60, 90, 120)]
    assert np.mean(values) < 14.0, values
    assert np.median(values) > 0.5, values


@pytest.mark.usefixtures("no_walk")
def test_right_calibration_is_not_made_worse() -> None:
    flight = Shaking(160)
    on, off = (_fly(flight, s, 3, xi=np.zeros(6), offset_s=0.0).rms_m for s in (BOTH, OFF))
    assert on < 1.3 * off


@pytest.mark.usefixtures("no_walk")
def test_standing_still_says_nothing_of_camera_and_imu() -> None:
    """Neither arm nor mount nor clock shows without motion, and no correction of the first tilt
    stands in for it.
    """
    run = _fly(Shaking(100, still=True), BOTH, 0, xi=np.zeros(6), offset_s=0.0, sigma=0.1)
    e = run.estimates[-1]
    # No direction may shrink, whatever the axes.
    prior = np.repeat(
        [BOTH.extrinsic_translation_sigma_m, np.radians(BOTH.extrinsic_rotation_sigma_deg)], 3
    )
    assert np.linalg.eigvalsh(e.T_cam0_imu_covariance / np.outer(prior, prior))[0] > 0.95**2
    assert e.time_offset_sigma_s > 0.98 * BOTH.time_offset_sigma_s
    assert np.all(np.abs(run.T_cam0_imu_error[-1]) < 0.1 * prior)
    assert abs(run.time_offset_error_s[-1]) < 0.1 * BOTH.time_offset_sigma_s


@pytest.mark.parametrize(
    ("calibrate", "extrinsics", "timing"),
    [("extrinsics", True, False), ("time_offset", False, True)],
)
def test_each_alone(calibrate: str, extrinsics: bool, timing: bool) -> None:
    settings = replace(EXACT, calibrate_camera_imu=calibrate)  # type: ignore[arg-type]
    xi = _off_by(0) if extrinsics else np.zeros(6)
    run = _fly(Shaking(140), settings, 0, xi=xi, offset_s=0.008 * timing)
    e = run.estimates[-1]
    assert (e.T_cam0_imu is not None, e.time_offset_s is not None) == (extrinsics, timing)
    assert np.degrees(np.linalg.norm(run.T_cam0_imu_error[-1][3:])) < 0.2
    if timing:
        assert e.time_offset_sigma_s < 1e-3
        assert abs(run.time_offset_error_s[-1]) < 3 * e.time_offset_sigma_s


def test_off_tells_nothing_and_needs_an_imu_when_on() -> None:
    run = _fly(Shaking(3), OFF, 0, xi=np.zeros(6), offset_s=0.0)
    assert run.estimates[-1].T_cam0_imu is None
    assert run.estimates[-1].time_offset_sigma_s is None
    with pytest.raises(ConfigError, match="--motion imu"):
        Msckf(CAMERA, T_CAM0_IMU, BOTH, motion=None)


def test_auto_estimates_the_time_offset_where_there_is_an_imu() -> None:
    run = _fly(
        Shaking(3), replace(EXACT, calibrate_camera_imu="auto"), 0, xi=np.zeros(6), offset_s=0.0
    )
    assert run.estimates[-1].T_cam0_imu is None
    assert run.estimates[-1].time_offset_sigma_s is not None
    assert not first_calibration(
        T_CAM0_IMU, replace(EXACT, calibrate_camera_imu="auto"), None
    ).moves_camera


@pytest.mark.usefixtures("no_walk")
def test_constant_velocity_says_nothing_of_the_clocks() -> None:
    """The first velocities are not known, and their product with the offset's error is no
    measurement of it.

    With exposures that follow the offset from the first frame on, 5 ms became 2; 4.66 are left.
    """
    run = _fly(Straight(60), BOTH, 0, xi=np.zeros(6), offset_s=0.008)
    sigma_s = run.estimates[-1].time_offset_sigma_s
    assert sigma_s > 0.9 * BOTH.time_offset_sigma_s
