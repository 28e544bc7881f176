"""Scale and misalignment of the IMU as states: Jacobians, what a flight shows, what standstill
does not, off is off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU, Flight
from tests.filters.test_navigation import MOVING as WITHOUT_TERMS
from tests.filters.test_online_calibration import Shaking, fly_with
from tests.jacobians import numeric_jacobian
from tests.numpy_twins import gyro_D_terms
from vio.cli.running import _calibration_rows
from vio.config import Config
from vio.errors import ConfigError
from vio.filters import imu_terms
from vio.filters.imu_terms import (
    CHOSEN,
    IMU_TERMS,
    accel_D_terms,
    chosen_terms,
    significant,
)
from vio.filters.mono_msckf import MonoMsckf
from vio.filters.msckf import Msckf
from vio.filters.navigation import DIM, NO_STEP, ImuMotion, NavState
from vio.filters.settings import MsckfSettings
from vio.filters.supervised import SupervisedMsckf
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_inverse, se3_log, so3_log
from vio.geometry.stereo import CameraKind
from vio.geometry.upright import rotation_to_up
from vio.imu.settings import DEFAULT_IMU
from vio.live.build import build_backend
from vio.live.prediction import PosePredictor
from vio.records import Estimate, ImuSample, MotionSource, imu_matrices
from vio.runs.checkpoint import load_checkpoint, save_checkpoint
from vio.runs.folder import imu_calibration

T_IMU_CAM0 = se3_inverse(T_CAM0_IMU)
# the stereo pair
EXACT = MsckfSettings(calibrate_stereo="off", stereo_baseline_sigma=0.0, stereo_focal_sigma=0.0)
OFF = replace(EXACT, calibrate_camera_imu="none", calibrate_imu="off")
FULL = replace(EXACT, calibrate_camera_imu="none", calibrate_imu="full")  # the terms alone
GRAVITY = np.array([0.0, 0.0, -9.81])
TERMS = np.random.default_rng(3).normal(0, 0.02, IMU_TERMS)
MOVING = replace(WITHOUT_TERMS, imu_terms=TERMS)
OFF_BY_1_PERCENT = (
    np.array([1, -1, 0.7, 0.87, -0.6, 0.8, -1, 0.8, 1, 0.87, 0.6, -0.87, 0.5, -0.8, 0.7]) * 0.01
)


def _motion(settings: MsckfSettings, hz: int = 2000, seconds: float = 0.1) -> ImuMotion:
    motion = ImuMotion(settings)
    for k in range(round(hz * seconds) + 1):
        t = k / hz
        gyro = np.array([1.5 * np.sin(3 * t), -1.4, 1 + 3 * t])
        motion.take(ImuSample(round(1e9 * t), gyro, np.array([3 + t, 4 * np.cos(9 * t), 9.81])))
    return motion


def _error(nav: NavState, other: NavState) -> FloatArray:
    """Error (9,) `[rho phi xi_v]` from one state to another."""
    R = other.T_world_imu[:3, :3] @ nav.T_world_imu[:3, :3].T
    xi = se3_log(other.T_world_imu @ se3_inverse(nav.T_world_imu))
    return np.concatenate([xi, other.velocity - R @ nav.velocity])


def test_jacobian_of_a_step_equals_central_differences() -> None:
    """(A3), of every term, far from zero terms and biases; the biases' own columns stay right
    beside them.
    """
    motion = _motion(FULL)
    step = motion.advance(MOVING, 0, 100_000_000)

    def after(error: FloatArray) -> FloatArray:
        start = motion.corrected(MOVING, np.concatenate([np.zeros(9), error]))
        return _error(step.nav, motion.advance(start, 0, 100_000_000).nav)

    numeric = numeric_jacobian(after, np.zeros(6 + IMU_TERMS))
    np.testing.assert_allclose(step.Phi_imu[:9], numeric[:, 6:], atol=2e-5)
    # of bias: by the step's first attitude
    np.testing.assert_allclose(step.Phi[:9, 9:], numeric[:, :6], atol=2e-3)
    assert np.abs(numeric[:, 6:]).max(axis=0).min() > 1e-3
    assert not step.Phi_imu[9:].any()


def test_steps_compose() -> None:
    motion = _motion(FULL, hz=200)
    whole, first = (motion.advance(MOVING, 0, end) for end in (100_000_000, 40_000_000))
    growth = NO_STEP.then(first).then(motion.advance(first.nav, 40_000_000, 100_000_000))
    np.testing.assert_allclose(growth.Phi_imu, whole.Phi_imu, atol=1e-9)


def test_calibrated_readings_and_rates_depend_on_the_terms_linearly() -> None:
    """(A2): entries of the matrices of (A1), upper triangular for the accelerometer."""
    reading = np.array([0.3, -1.2, 9.5])
    for k, jacobian in enumerate((accel_D_terms, gyro_D_terms)):
        moved = (imu_matrices(TERMS)[k] - np.eye(3)) @ reading
        np.testing.assert_allclose(jacobian(reading) @ TERMS, moved, atol=1e-14)
        numeric = numeric_jacobian(lambda x, k=k: imu_matrices(x)[k] @ reading, TERMS)
        np.testing.assert_allclose(jacobian(reading), numeric, atol=1e-8)
    assert not np.tril(imu_matrices(TERMS)[0], -1).any()
    motion = ImuMotion(FULL)

    def rate(error: FloatArray) -> FloatArray:
        return motion.corrected(MOVING, error).rate

    np.testing.assert_allclose(
        motion.rate_D_error(MOVING), numeric_jacobian(rate, np.zeros(DIM + 15)), atol=1e-8
    )


def test_first_tilt_follows_the_terms() -> None:
    """(A4): the attitude that another calibration of the same reading gives, yaw apart."""
    force = np.array([2.0, -3.0, 9.0])
    force *= 9.81 / np.linalg.norm(force)

    def attitude(terms: FloatArray) -> FloatArray:
        up = imu_matrices(terms)[0] @ force
        return rotation_to_up(up / np.linalg.norm(up))

    R = attitude(np.zeros(15))
    numeric = numeric_jacobian(lambda x: so3_log(attitude(x) @ R.T)[:2], np.zeros(15))
    first = replace(MOVING, T_world_imu=se3_from_parts(R, np.zeros(3)))
    analytic = ImuMotion(FULL).tilt_D_terms(first)
    np.testing.assert_allclose(analytic[:2], numeric, atol=1e-8)
    np.testing.assert_allclose(analytic[2], 0.0, atol=1e-14)

    filt = Msckf(CAMERA, T_CAM0_IMU, FULL, motion="imu")
    filt.propagate(ImuSample(0, np.zeros(3), force))
    filt.update(Flight().observe(0, 0.5, np.random.default_rng(0), 40))
    P = filt._started().prior.P
    np.testing.assert_allclose(
        P[3:6, DIM : DIM + 15], analytic @ P[DIM : DIM + 15, DIM : DIM + 15], atol=1e-12
    )
    assert np.abs(P[3:6, DIM : DIM + 15]).max() > 1e-5


def test_rest_is_measured_by_the_calibrated_gyro() -> None:
    # a step's mean reading, calibrated
    motion, gyro = ImuMotion(FULL), np.array([0.03, -0.02, 0.05])
    raw = np.linalg.solve(imu_matrices(TERMS)[1], gyro)
    measurement = motion.zero_velocity(MOVING, gyro)

    def residual(error: FloatArray) -> FloatArray:
        nav = motion.corrected(MOVING, error)
        return np.concatenate([-nav.velocity, imu_matrices(nav.imu_terms)[1] @ raw - nav.gyro_bias])

    np.testing.assert_allclose(measurement.residual, residual(np.zeros(DIM + 15)), atol=1e-12)
    np.testing.assert_allclose(
        -measurement.H, numeric_jacobian(residual, np.zeros(DIM + 15)), atol=1e-8
    )


def test_earlier_velocities_follow_the_terms() -> None:
    """Correct a state and integrate, or integrate and correct: the accelerometer's terms move no
    earlier velocity.
    """
    motion = _motion(FULL, hz=200)
    early = replace(MOVING, accel_bias=np.zeros(3), imu_terms=np.zeros(15))
    step = motion.advance(early, 0, 100_000_000)
    error = np.concatenate(
        [np.zeros(DIM), np.random.default_rng(0).normal(0, 1e-4, 6), np.zeros(9)]
    )
    now = np.concatenate([step.Phi_imu @ error[DIM:], error[DIM:]])
    R = 0.5 * (early.T_world_imu + step.nav.T_world_imu)[:3, :3]
    velocities = np.array([early.velocity, step.nav.velocity])
    got = motion.corrected_earlier(
        velocities, np.array([R, step.nav.T_world_imu[:3, :3]]), np.array([0.1, 0.0]), now
    )
    np.testing.assert_allclose(got[1], motion.corrected(step.nav, now).velocity, atol=1e-12)
    assert np.abs(got[1] - velocities[1]).max() > 5e-5
    np.testing.assert_allclose(got[0], early.velocity, atol=3e-6)


# On exact flights


@dataclass(frozen=True, slots=True)
class Run:
    """What a run left behind, beside the truth."""

    rms_m: float  # of the body's place in the world, after the first fifth of the flight
    estimates: list[Estimate]

    @property
    def terms(self) -> tuple[FloatArray, FloatArray]:
        """The terms at the end and their standard deviations (15,)."""
        last = self.estimates[-1]
        return last.imu_terms, last.imu_terms_sigma


def _samples(flight: Flight, terms: FloatArray, noise: np.random.Generator) -> list[ImuSample]:
    """IMU samples at 200 Hz with biases of 0.02 rad/s and 0.05 m/s^2 of an IMU that is off by
    terms.
    """
    M_accel, M_gyro = imu_matrices(terms)
    bias = noise.normal(0, [0.02] * 3 + [0.05] * 3)
    sigmas = np.repeat(
        [DEFAULT_IMU.gyro_noise_density, DEFAULT_IMU.accel_noise_density], 3
    ) * np.sqrt(200.0)
    out = []
    for k in range(-20, 10 * flight.frames + 20):
        R, _, _, a, omega = flight.state(k / 200)
        white = bias + noise.normal(0, sigmas)
        gyro, accel = (
            np.linalg.solve(M, x) for M, x in ((M_gyro, omega), (M_accel, R.T @ (a - GRAVITY)))
        )
        out.append(ImuSample(5_000_000 * k, gyro + white[:3], accel + white[3:]))
    return out


def _fly(
    flight: Flight,
    settings: MsckfSettings,
    terms: FloatArray,
    *,
    sigma: float = 0.5,
    T_cam0_imu: FloatArray = T_CAM0_IMU,
    offset_ns: int = 0,
) -> Run:
    noise = np.random.default_rng(0)
    filt = Msckf(CAMERA, T_cam0_imu, settings, motion="imu")
    samples = [replace(s, time_ns=s.time_ns + offset_ns) for s in _samples(flight, terms, noise)]
    estimates, errors = fly_with(filt, flight, samples, noise, sigma)
    rms = float(np.sqrt(np.mean(np.sum(errors[flight.frames // 5 :] ** 2, axis=1))))
    return Run(rms, estimates)


@pytest.fixture(scope="module")
def found() -> Run:
    """Ten seconds of motion about all axes with an IMU that is off by 1 % and half a degree."""
    return _fly(Shaking(200), FULL, OFF_BY_1_PERCENT)


def test_an_excited_flight_shows_all_terms(found: Run) -> None:
    terms, sigmas = found.terms
    assert np.all(np.abs(terms - OFF_BY_1_PERCENT) < 3 * sigmas)
    assert sigmas[6:].max() < 1e-3
    assert sigmas[:2].max() < 4e-3
    assert found.rms_m < 0.02  # 0.13 m with the readings as they are


def test_predicted_motions_are_as_uncertain_as_the_terms() -> None:
    """In the second half second the rotations that a wrong gyro predicts have a NEES of 2 of 3;
    off, it would be 14.
    """
    noise, flight = np.random.default_rng(0), Shaking(20)
    filt = Msckf(CAMERA, T_CAM0_IMU, FULL, motion="imu")
    samples, squared = _samples(flight, OFF_BY_1_PERCENT, noise), []
    for k in range(20):
        while samples[0].time_ns <= (k + 1) * STEP_NS:
            filt.propagate(samples.pop(0))
        filt.update(flight.observe(k, 0.5, noise, 40))
        predicted = filt.predict((k + 1) * STEP_NS)
        if k >= 9 and predicted is not None:
            T_moved = (
                T_CAM0_IMU
                @ se3_inverse(flight.T_world_imu(k + 1))
                @ flight.T_world_imu(k)
                @ T_IMU_CAM0
            )
            phi = se3_log(T_moved @ se3_inverse(predicted.motion.T_curr_prev))[3:]
            squared.append(phi @ np.linalg.solve(predicted.motion.covariance[3:, 3:], phi))
    assert len(squared) == 11
    assert 0.5 < np.mean(squared) < 4.5

    step = filt._propagation.coming(filt._started(), 20 * STEP_NS).step
    grown = filt._propagation.grown(filt._started(), step.nav, NO_STEP.then(step))
    np.testing.assert_array_equal(
        grown[:DIM, : DIM + 15], np.concatenate([step.Phi, step.Phi_imu], axis=1)
    )
    np.testing.assert_array_equal(grown[:DIM, DIM + 15 :], 0.0)  # of the first attitude
    np.testing.assert_array_equal(grown[DIM:], np.eye(18, DIM + 18, DIM))


def test_standstill_shows_what_gravity_tells_and_no_more() -> None:
    """Gravity's size is one number, which the scale along it and the bias share; 4 s of noise
    show nothing else.
    """
    terms, sigmas = _fly(Shaking(80, still=True), FULL, OFF_BY_1_PERCENT, sigma=0.1).terms
    prior = np.where(np.isin(np.arange(15), CHOSEN["scale"]), 0.01, np.radians(0.5))
    prior[2] = (0.01**-2 + (DEFAULT_IMU.accel_bias_sigma_mps2 / 9.81) ** -2) ** -0.5
    np.testing.assert_allclose(sigmas / prior, 1.0, atol=0.01)
    terms[2] -= 0.05 / 9.81 * (1 - (prior[2] / 0.01) ** 2)  # of the bias
    assert np.abs(terms / prior).max() < 0.1


def test_noise_is_no_lever() -> None:
    """(A5): a deviation within twenty standard deviations counts as none, one of two hundred as
    nearly itself.
    """
    usual, density = np.array([0.02, 0, 0, 0, 0, 9.8]), np.array([1e-2, 1e-3])
    sigmas = np.repeat([1e-3, 1e-2], 3) / np.sqrt(0.04)
    for deviations, kept in ((20 / np.sqrt(3), 0.0), (200 / np.sqrt(3), 1.0)):
        readings = usual + deviations * sigmas * np.ones((9, 1))
        got = significant(readings, usual, 0.04, density)
        np.testing.assert_allclose(got, usual + kept * (readings - usual), rtol=7e-3)


def test_all_that_can_be_off_is_found_beside_the_terms() -> None:
    """Of the IMU half a degree, 1 cm, 4 ms, 1 % and half a degree of misalignment, while the
    stereo field is zero.
    """
    both = replace(FULL, calibrate_camera_imu="both", calibrate_stereo="on")
    xi = np.concatenate(
        [0.01 * np.array([0.6, -0.6, 0.5]), np.radians(0.5) * np.array([0.6, 0.6, -0.5])]
    )
    run = _fly(
        Shaking(140),
        both,
        OFF_BY_1_PERCENT,
        T_cam0_imu=T_CAM0_IMU @ se3_exp(xi),
        offset_ns=4_000_000,
    )
    terms, sigmas = run.terms
    assert np.all(np.abs(terms - OFF_BY_1_PERCENT) < 3.5 * sigmas)
    last = run.estimates[-1]
    error = se3_log(se3_inverse(last.T_cam0_imu) @ T_CAM0_IMU)
    # chi-square, 0.999 of 6
    assert error @ np.linalg.solve(last.T_cam0_imu_covariance, error) < 22.5
    assert abs(last.time_offset_s - 0.004) < 1e-3
    field = last.stereo_field
    # 0.999 of 8
    assert field.coefficients @ np.linalg.solve(field.covariance, field.coefficients) < 26.1
    assert run.rms_m < 0.04


def test_a_stereo_field_that_begins_later_finds_its_place_behind_the_terms() -> None:
    # begins in a frame
    filt = Msckf(CAMERA, T_CAM0_IMU, replace(FULL, calibrate_stereo="on"), motion="imu")
    flight, noise = Shaking(20), np.random.default_rng(0)
    for sample in _samples(flight, np.zeros(15), noise)[:26]:
        filt.propagate(sample)
    for k in range(2):
        filt.update(flight.observe(k, 0.5, noise, 40))
    estimate = filt.estimate()
    right = np.sqrt(np.diag(estimate.stereo_field.covariance))
    # not 1 %, of a scale
    assert right[0] == pytest.approx(np.radians(FULL.stereo_yaw_sigma_deg), rel=0.3)
    assert estimate.imu_terms_sigma[:2] == pytest.approx([0.01, 0.01], rel=0.1)


# On and off


def test_terms_that_are_known_are_no_error_and_scales_alone_no_misalignment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With priors of zero the flight is that without terms; `scale` leaves misalignments where
    they are.
    """
    off = _fly(Shaking(20), OFF, np.zeros(15))
    with monkeypatch.context() as patch:
        patch.setattr(imu_terms, "_PRIORS", imu_terms._PRIORS._replace(scale_sigma=0.0))
        patch.setattr(imu_terms, "_PRIORS", imu_terms._PRIORS._replace(misalignment_sigma_deg=0.0))
        on = _fly(Shaking(20), FULL, np.zeros(15))
    np.testing.assert_allclose(
        on.estimates[-1].T_world_imu, off.estimates[-1].T_world_imu, atol=1e-6
    )
    np.testing.assert_allclose(
        on.estimates[-1].covariance, off.estimates[-1].covariance, rtol=1e-3, atol=1e-9
    )
    assert off.estimates[-1].imu_terms is None
    scales, sigmas = _fly(Shaking(20), replace(OFF, calibrate_imu="scale"), OFF_BY_1_PERCENT).terms
    assert (
        np.flatnonzero(sigmas).tolist()
        == CHOSEN["scale"].tolist()
        == np.flatnonzero(scales).tolist()
    )


@pytest.mark.parametrize(
    ("kind", "motion", "estimated"),
    [
        ("stereo", "imu", True),
        ("rgbd", "imu", True),
        ("mono", "imu", False),
        ("stereo", None, False),
    ],
)
def test_terms_are_estimated_by_default_where_a_pair_has_an_imu(
    kind: CameraKind, motion: MotionSource | None, estimated: bool
) -> None:
    noise = np.random.default_rng(0)
    flight = Shaking(3)
    filt = build_backend(replace(CAMERA, kind=kind), T_CAM0_IMU, Config(), motion)
    if motion is not None:
        for sample in _samples(flight, np.zeros(15), noise):
            filt.propagate(sample)
    filt.update(flight.observe(0, 0.5, noise, 40))
    terms = filt.estimate().imu_terms if kind != "mono" else None
    assert (terms is not None) == estimated
    if kind == "mono":
        assert isinstance(filt, MonoMsckf)
        assert filt._settings.calibrate_imu == "off"


def test_extrinsics_leave_the_scales_to_be_estimated() -> None:
    """The rotation from IMU to camera would trade against misalignments."""
    for calibrate, chosen in (("none", "full"), ("time_offset", "full"), ("both", "scale")):
        settings = MsckfSettings(calibrate_camera_imu=calibrate)  # type: ignore[arg-type]
        np.testing.assert_array_equal(chosen_terms(settings), CHOSEN[chosen])  # type: ignore[index]


def test_off_carries_nothing() -> None:
    step = _motion(OFF).advance(replace(MOVING, imu_terms=np.zeros(15)), 0, 100_000_000)
    assert step.Phi_imu is None
    assert not step.nav.imu_terms.any()


@pytest.mark.parametrize(
    ("kind", "motion", "why"), [("stereo", None, "--motion imu"), ("mono", "imu", "stereo pair")]
)
def test_says_what_it_needs(kind: CameraKind, motion: MotionSource | None, why: str) -> None:
    with pytest.raises(
        ConfigError, match=rf"msckf.calibrate_imu: full needs .*{why}.*set it to auto"
    ):
        build_backend(replace(CAMERA, kind=kind), T_CAM0_IMU, Config(msckf=FULL), motion)


@pytest.mark.usefixtures("white_noise")
def test_survives_a_late_imu_a_gap_a_checkpoint_and_a_restart(tmp_path: Path) -> None:
    """Images alone stand in for a late IMU; after a restart the terms stay, with the first
    covariance.
    """
    noise, flight = np.random.default_rng(0), Shaking(60)
    samples = [s for s in _samples(flight, OFF_BY_1_PERCENT, noise) if s.time_ns > 10 * STEP_NS]
    samples = [s for s in samples if not 25 * STEP_NS < s.time_ns < 29 * STEP_NS]
    filters, dataset = (
        [SupervisedMsckf(CAMERA, T_CAM0_IMU, FULL)],
        SimpleNamespace(observations=None),
    )
    for k in range(50):
        if k == 45:
            save_checkpoint(tmp_path / "state", filters[0], dataset)
            filters.append(load_checkpoint(tmp_path / "state", dataset))
        now = [s for s in samples if (k - 1) * STEP_NS < s.time_ns <= k * STEP_NS]
        seen = flight.observe(k, 0.5, noise, 40)
        for filt in filters:
            for sample in now:
                filt.propagate(sample)
            filt.update(seen)
            assert (filt.estimate().imu_terms is None) == (k <= 10)
    before, resumed = (filt.estimate() for filt in filters)
    np.testing.assert_array_equal(before.imu_terms, resumed.imu_terms)
    np.testing.assert_array_equal(before.T_world_imu, resumed.T_world_imu)
    filters[0].restart(flight.observe(50, 0.5, noise, 40))
    after = filters[0].estimate()
    assert before.imu_terms_sigma[6:9].max() < 0.6 * after.imu_terms_sigma[6:9].min()
    np.testing.assert_allclose(after.imu_terms, before.imu_terms, atol=1e-3)


def test_predicted_poses_between_frames_use_the_terms() -> None:
    M_accel, M_gyro = imu_matrices(TERMS)
    reading = np.linalg.solve(M_accel, np.array([1.0, 0.0, 9.81]))
    estimate = Estimate(0, np.eye(4), np.eye(6), velocity_world=np.zeros(3), imu_terms=TERMS)
    predictor = PosePredictor(9.81)
    predictor.estimate(estimate)
    for k in range(21):
        predictor.sample(ImuSample(5_000_000 * k, np.linalg.solve(M_gyro, np.zeros(3)), reading))
    got = predictor.predict(100_000_000)
    np.testing.assert_allclose(got.velocity_world, [0.1, 0, 0], atol=6e-3)
    np.testing.assert_allclose(got.velocity_world[1:], 0.0, atol=1e-12)


def test_summary_and_metrics_state_the_terms() -> None:
    sigmas = np.where(np.isin(np.arange(15), CHOSEN["scale"]), 5e-4, np.radians(0.03))
    last = Estimate(0, np.eye(4), np.eye(6), imu_terms=OFF_BY_1_PERCENT, imu_terms_sigma=sigmas)
    stated = imu_calibration(SimpleNamespace(estimates=[last]))
    assert stated["accelerometer"]["scale_percent"] == pytest.approx(
        {"x": 1.0, "y": -1.0, "z": 0.7}
    )
    assert list(stated["gyro"]["misalignment_deg"]) == ["xy", "xz", "yz", "yx", "zx", "zy"]
    rows = _calibration_rows({"stereo_scale": None, "camera_imu": None, "imu": stated})
    assert rows[0] == (
        "IMU",
        "accelerometer scale x +1.00 ± 0.05, y -1.00 ± 0.05, z +0.70 ± 0.05 %",
    )
    assert rows[1] == ("", "accelerometer misalignment 0.76 ± 0.05 deg")
    unclear = replace(last, imu_terms_sigma=np.abs(OFF_BY_1_PERCENT) / 2.9)
    stated = imu_calibration(SimpleNamespace(estimates=[unclear]))
    assert not _calibration_rows({"stereo_scale": None, "camera_imu": None, "imu": stated})
    turned = np.where(np.arange(15) == 3, np.radians(0.3), 0.0)  # x by y of the accelerometer
    one = replace(last, imu_terms=turned, imu_terms_sigma=np.full(15, np.radians(0.09)))
    stated = imu_calibration(SimpleNamespace(estimates=[one]))
    assert _calibration_rows({"stereo_scale": None, "camera_imu": None, "imu": stated}) == [
        ("IMU", "accelerometer misalignment 0.30 ± 0.16 deg")
    ]
