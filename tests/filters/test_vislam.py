"""The paper's filter: Jacobians, the dense forms it must equal, noise readings, and a simulated
drive.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.jacobians import numeric_jacobian
from vio.errors import ConfigError, EstimationError
from vio.filters.settings import VislamSettings
from vio.filters.vislam import Vislam, update_landmarks, update_pose, z_D_landmark, z_D_xi
from vio.filters.vislam_motion import predict, predict_twist
from vio.geometry.lie import (
    FloatArray,
    se3_curly_hat,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    se3_log,
    transform_points,
)
from vio.geometry.stereo import StereoCamera, project, triangulate
from vio.offline.reproduce import PAPER
from vio.records import ImuSample, Observations, VelocitySample, observations

CAMERA = StereoCamera(700.0, 710.0, 600.0, 180.0, 0.54, 1242, 375)
# The usual mounting: camera z is the body's x, camera x the body's -y.
T_CAM0_IMU = se3_from_parts(
    np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.1, 0.7, -1.1])
)
TAU_NS = 100_000_000


def _points_ahead(n: int, seed: int) -> FloatArray:
    """Points in the cam0 frame that both cameras see."""
    rng = np.random.default_rng(seed)
    z = np.column_stack(
        [rng.uniform(300, 1100, n), rng.uniform(20, 350, n), np.zeros(n), np.zeros(n)]
    )
    z[:, 3], z[:, 2] = z[:, 1], z[:, 0] - rng.uniform(8, 60, n)
    points, valid = triangulate(CAMERA, z)
    assert valid.all()
    return points


def _some_pose() -> FloatArray:
    return se3_exp(np.array([3.0, -2.0, 0.5, 0.1, -0.2, 0.7]))


def test_landmark_jacobian_equals_central_differences() -> None:
    U = _some_pose()
    m = transform_points(se3_inverse(T_CAM0_IMU @ U), _points_ahead(5, 0))
    analytic = z_D_landmark(CAMERA, T_CAM0_IMU, U, m)
    for i in range(len(m)):
        numeric = numeric_jacobian(
            lambda p: project(CAMERA, transform_points(T_CAM0_IMU @ U, p)), m[i]
        )
        np.testing.assert_allclose(analytic[i], numeric, rtol=1e-6, atol=1e-5)


def test_pose_jacobian_equals_central_differences() -> None:
    U = _some_pose()
    m = transform_points(se3_inverse(T_CAM0_IMU @ U), _points_ahead(5, 1))
    analytic = z_D_xi(CAMERA, T_CAM0_IMU, U, m)

    def pixels(xi: FloatArray) -> FloatArray:
        return project(CAMERA, transform_points(T_CAM0_IMU @ se3_exp(xi) @ U, m)).reshape(-1)

    np.testing.assert_allclose(
        analytic.reshape(-1, 6), numeric_jacobian(pixels, np.zeros(6)), rtol=1e-6, atol=1e-5
    )


def test_prediction_transports_the_error_as_the_covariance_says() -> None:
    """Perturb, then predict: the new error is F times the old one, exactly, as the flow is
    group-affine.
    """
    U, u, tau = _some_pose(), np.array([8.0, 0.3, -0.1, 0.02, -0.03, 0.4]), 0.1
    xi = np.array([0.3, -0.2, 0.1, 0.05, -0.02, 0.08])
    nominal, Sigma = predict(U, np.outer(xi, xi), u, tau, np.zeros((6, 6)))
    perturbed, _ = predict(se3_exp(xi) @ U, np.zeros((6, 6)), u, tau, np.zeros((6, 6)))
    moved = se3_log(perturbed @ se3_inverse(nominal))
    np.testing.assert_allclose(np.outer(moved, moved), Sigma, atol=1e-12)


def test_prediction_uses_the_curly_hat_of_the_paper() -> None:
    from scipy.linalg import expm

    u, tau, W = np.array([8.0, 0.3, -0.1, 0.02, -0.03, 0.4]), 0.1, np.diag(np.arange(1.0, 7.0))
    Sigma = np.diag([1.0, 2, 3, 4, 5, 6])
    F = expm(-tau * se3_curly_hat(u))
    np.testing.assert_allclose(
        predict(_some_pose(), Sigma, u, tau, W)[1], F @ Sigma @ F.T + W, rtol=1e-12
    )


def test_block_diagonal_mapping_equals_the_dense_filter() -> None:
    """The paper writes one 3M x 3M covariance; with a known pose only the diagonal blocks ever
    differ from zero.
    """
    U, n, variance = _some_pose(), 6, 4.0
    rng = np.random.default_rng(3)
    m = transform_points(se3_inverse(T_CAM0_IMU @ U), _points_ahead(n, 2))
    root = rng.normal(size=(n, 3, 3))
    P = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(3)
    dense_m, dense_P = m.copy().reshape(-1), np.zeros((3 * n, 3 * n))
    for i in range(n):
        dense_P[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = P[i]
    block_m, block_P = m.copy(), P.copy()

    for seen in (np.array([0, 2, 5]), np.array([1, 2, 3, 4]), np.arange(n)):
        H_blocks = z_D_landmark(CAMERA, T_CAM0_IMU, U, block_m[seen])
        z = project(CAMERA, transform_points(T_CAM0_IMU @ U, m[seen])) + rng.normal(
            0, 2, (len(seen), 4)
        )
        residual = z - project(CAMERA, transform_points(T_CAM0_IMU @ U, block_m[seen]))
        H = np.zeros((4 * len(seen), 3 * n))
        for row, landmark in enumerate(seen):
            H[4 * row : 4 * row + 4, 3 * landmark : 3 * landmark + 3] = H_blocks[row]
        S = H @ dense_P @ H.T + variance * np.eye(len(H))
        K = dense_P @ H.T @ np.linalg.inv(S)
        dense_m = dense_m + K @ residual.reshape(-1)
        dense_P = (np.eye(3 * n) - K @ H) @ dense_P
        block_m[seen], block_P[seen] = update_landmarks(
            block_m[seen], block_P[seen], H_blocks, residual, variance
        )
        np.testing.assert_allclose(block_m.reshape(-1), dense_m, atol=1e-9)
        for i in range(n):
            for j in range(n):
                expected = block_P[i] if i == j else np.zeros((3, 3))
                np.testing.assert_allclose(
                    dense_P[3 * i : 3 * i + 3, 3 * j : 3 * j + 3], expected, atol=1e-9
                )


def test_pose_update_equals_the_gain_form_of_the_paper() -> None:
    rng = np.random.default_rng(5)
    n = 7
    H, residual = rng.normal(size=(n, 4, 6)), rng.normal(size=(n, 4))
    root = rng.normal(size=(6, 6))
    Sigma = root @ root.T
    R = np.array([a @ a.T + np.eye(4) for a in rng.normal(size=(n, 4, 4))])
    xi, updated = update_pose(Sigma, H, residual, R)
    H_stack, R_dense = H.reshape(-1, 6), np.zeros((4 * n, 4 * n))
    for i in range(n):
        R_dense[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = R[i]
    K = Sigma @ H_stack.T @ np.linalg.inv(H_stack @ Sigma @ H_stack.T + R_dense)
    np.testing.assert_allclose(xi, K @ residual.reshape(-1), rtol=1e-8)
    np.testing.assert_allclose(updated, (np.eye(6) - K @ H_stack) @ Sigma, rtol=1e-7, atol=1e-10)


def test_each_landmark_is_moved_by_its_own_residual_only() -> None:
    """A bug of many published solutions: every landmark receives the sum of all corrections."""
    U = _some_pose()
    m = transform_points(se3_inverse(T_CAM0_IMU @ U), _points_ahead(3, 7))
    H = z_D_landmark(CAMERA, T_CAM0_IMU, U, m)
    residual = np.zeros((3, 4))
    residual[1] = [3.0, -1.0, 2.0, 1.0]
    moved, _ = update_landmarks(m, np.broadcast_to(np.eye(3), (3, 3, 3)), H, residual, 1.0)
    np.testing.assert_array_equal(moved[[0, 2]], m[[0, 2]])
    assert np.linalg.norm(moved[1] - m[1]) > 1e-3


def test_new_landmarks_doubt_is_that_of_its_pixels_seen_from_the_world() -> None:
    """Against central differences of the point in the world by its pixels."""
    settings = VislamSettings()
    filt = Vislam(CAMERA, T_CAM0_IMU, settings, motion_sensor=False)
    z = project(CAMERA, np.array([2.0, -1.0, 9.0]))
    filt.update(observations(0, 0, [1], z[None]))

    def in_the_world(pixels: FloatArray) -> FloatArray:
        return transform_points(se3_inverse(T_CAM0_IMU), triangulate(CAMERA, pixels[None])[0])[0]

    J = numeric_jacobian(in_the_world, z)
    np.testing.assert_allclose(
        filt.landmarks().covariance[0], settings.pixel_sigma_px**2 * J @ J.T, rtol=1e-5, atol=1e-9
    )


@pytest.mark.parametrize("tau_s", [0.05, 0.2])
def test_noise_readings_differ_as_named(tau_s: float) -> None:
    """Literal: the paper's numbers are variances per step.

    Consistent: standard deviations times the step.
    """
    expected = {
        "literal": np.repeat([0.5, 0.05], 3),
        "consistent": (np.repeat([0.5, 0.05], 3) * tau_s) ** 2,
    }
    for noise, variances in expected.items():
        settings = VislamSettings(motion_model="input", noise=noise)  # type: ignore[arg-type]
        filt = Vislam(CAMERA, T_CAM0_IMU, settings, motion_sensor=True)
        zero = np.zeros(3)
        filt.propagate(VelocitySample(0, zero, zero))
        filt.advance(0)
        filt.advance(int(tau_s * 1e9))
        np.testing.assert_allclose(np.diag(filt.estimate().covariance), variances, rtol=1e-9)


def test_literal_noise_counts_once_per_frame_however_many_samples() -> None:
    """The step of the paper is from frame to frame; two half steps must not add W twice in the
    literal reading.
    """
    covariances = []
    for times in ([0, TAU_NS], [0, TAU_NS // 2, TAU_NS]):
        filt = Vislam(CAMERA, T_CAM0_IMU, PAPER, motion_sensor=True)
        for t in times:
            filt.propagate(VelocitySample(t, np.zeros(3), np.zeros(3)))
            if t == 0:
                filt.advance(0)
        filt.advance(TAU_NS)
        covariances.append(filt.estimate().covariance)
    np.testing.assert_allclose(covariances[0], covariances[1], rtol=1e-12)


class _Drive:
    """A car-like drive with a known pose at each frame and points scattered along the way."""

    def __init__(self, frames: int = 60, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.u = np.column_stack(
            [np.full(frames, 8.0), np.zeros((frames, 4)), 0.3 * np.sin(np.arange(frames) / 15)]
        )
        poses = [np.eye(4)]
        for k in range(frames - 1):
            poses.append(poses[-1] @ se3_exp(0.1 * self.u[k]))
        self.T_world_imu = np.array(poses)
        self.points = np.column_stack(
            [rng.uniform(0, 70, 900), rng.uniform(-25, 25, 900), rng.uniform(-1, 6, 900)]
        )

    def observe(self, k: int, sigma_px: float, rng: np.random.Generator) -> Observations:
        p = transform_points(T_CAM0_IMU @ se3_inverse(self.T_world_imu[k]), self.points)
        near = (p[:, 2] > 2) & (p[:, 2] < 60)
        z = project(CAMERA, np.where(near[:, None], p, [0.0, 0.0, 10.0]))
        inside = (
            near
            & (z[:, 0] > 0)
            & (z[:, 2] > 0)
            & (z[:, 0] < 1242)
            & (z[:, 1] > 0)
            & (z[:, 1] < 375)
        )
        ids = np.flatnonzero(inside)
        return observations(k, k * TAU_NS, ids, z[ids] + rng.normal(0, sigma_px, (len(ids), 4)))

    def run(
        self,
        settings: VislamSettings,
        *,
        motion: bool,
        sigma_px: float = 0.5,
        noisy_input: bool = False,
    ) -> float:
        """Return the largest position error over the drive, metres."""
        rng = np.random.default_rng(1)
        filt = Vislam(CAMERA, T_CAM0_IMU, settings, motion_sensor=motion)
        errors = []
        for k, truth in enumerate(self.T_world_imu):
            noise = rng.normal(0, np.repeat([0.5, 0.05], 3)) if noisy_input else np.zeros(6)
            u = self.u[k] + noise
            filt.propagate(VelocitySample(k * TAU_NS, u[:3], u[3:]))
            filt.update(self.observe(k, sigma_px, rng))
            errors.append(np.linalg.norm(filt.estimate().T_world_imu[:3, 3] - truth[:3, 3]))
        return float(max(errors))


def test_dead_reckoning_with_exact_input_is_exact() -> None:
    settings = replace(VislamSettings(), mode="dead_reckoning", input_at="start")
    assert _Drive().run(settings, motion=True) < 1e-9


def test_poses_are_not_stored_one_step_late() -> None:
    """A bug of many published solutions; at 8 m/s one step is 0.8 m."""
    assert _Drive().run(VislamSettings(), motion=True, sigma_px=0.1) < 0.1
    assert _Drive().run(replace(PAPER, use_stale=False), motion=True, sigma_px=0.1) < 0.1


def test_fusion_beats_dead_reckoning_with_the_noise_of_the_paper() -> None:
    drive = _Drive()
    alone = drive.run(
        replace(VislamSettings(), mode="dead_reckoning"), motion=True, noisy_input=True
    )
    fused = drive.run(VislamSettings(), motion=True, noisy_input=True)
    assert fused < 0.5 * alone
    assert fused < 0.4


def test_images_alone_follow_a_drive_that_starts_in_motion() -> None:
    assert _Drive().run(VislamSettings(), motion=False) < 0.5


def test_the_twist_model_moves_the_error_as_its_covariance_says() -> None:
    """Perturb pose and twist, predict both, and compare with F times the perturbation, to first
    order.
    """
    U, u, tau = _some_pose(), np.array([8.0, 0.3, -0.1, 0.02, -0.03, 0.4]), 0.1

    def moved(error: FloatArray) -> FloatArray:
        nominal = se3_exp(-tau * u) @ U
        perturbed = se3_exp(-tau * (u + error[6:])) @ se3_exp(error[:6]) @ U
        return np.concatenate([se3_log(perturbed @ se3_inverse(nominal)), error[6:]])

    F = numeric_jacobian(moved, np.zeros(12))
    Sigma = np.diag(np.arange(1.0, 13.0))
    predicted, covariance = predict_twist(U, u, Sigma, tau, np.zeros(6))
    np.testing.assert_allclose(predicted, se3_exp(-tau * u) @ U)
    np.testing.assert_allclose(covariance, F @ Sigma @ F.T, rtol=1e-6, atol=1e-7)


def test_the_noise_of_the_twist_model_does_not_depend_on_how_the_time_is_cut() -> None:
    density = np.array([1.0, 1, 1, 0.1, 0.1, 0.1])
    whole = predict_twist(np.eye(4), np.zeros(6), np.zeros((12, 12)), 0.2, density)[1]
    half = predict_twist(np.eye(4), np.zeros(6), np.zeros((12, 12)), 0.1, density)[1]
    parts = predict_twist(np.eye(4), np.zeros(6), half, 0.1, density)[1]
    np.testing.assert_allclose(parts, whole, rtol=1e-12)


def test_a_sudden_turn_is_followed_although_the_motion_model_denies_it() -> None:
    """Full speed to standstill and half a radian of yaw within one frame: the features outvote
    the model.
    """
    drive = _Drive(frames=40)
    drive.T_world_imu[20:] = drive.T_world_imu[20] @ se3_exp(np.array([0.0, 0, 0, 0, 0, 0.5]))
    rng = np.random.default_rng(1)
    filt = Vislam(CAMERA, T_CAM0_IMU, VislamSettings(), motion_sensor=False)
    for k in range(40):
        filt.update(drive.observe(k, 0.5, rng))
    error = se3_log(se3_inverse(drive.T_world_imu[39]) @ filt.estimate().T_world_imu)
    assert np.linalg.norm(error[:3]) < 0.3
    assert np.linalg.norm(error[3:]) < 0.02


def test_mapping_leaves_the_pose_alone() -> None:
    drive, paper = _Drive(), replace(PAPER, use_stale=False)
    alone = drive.run(replace(paper, mode="dead_reckoning"), motion=True, noisy_input=True)
    mapped = drive.run(replace(paper, mode="mapping"), motion=True, noisy_input=True)
    assert mapped == pytest.approx(alone, abs=1e-12)


def test_gate_keeps_wrong_matches_out() -> None:
    drive, rng = _Drive(frames=25), np.random.default_rng(9)
    errors = {}
    for probability in (0.95, None):
        filt = Vislam(
            CAMERA, T_CAM0_IMU, VislamSettings(gate_probability=probability), motion_sensor=True
        )
        gated = 0
        for k in range(25):
            filt.propagate(VelocitySample(k * TAU_NS, drive.u[k, :3], drive.u[k, 3:]))
            seen = drive.observe(k, 0.5, rng)
            wrong = rng.random(len(seen)) < 0.15
            z = seen.z + np.where(
                wrong[:, None], rng.uniform(10, 40, (len(seen), 1)) * [1, 0, 1, 0], 0
            )
            gated += filt.update(observations(k, k * TAU_NS, seen.ids, z)).gated
        errors[probability] = np.linalg.norm(
            filt.estimate().T_world_imu[:3, 3] - drive.T_world_imu[24][:3, 3]
        )
        assert gated > 0  # without a gate these are landmarks that ended up behind the camera
    assert errors[0.95] < 0.5 * errors[None]


def test_left_only_stale_and_negative_disparities_do_not_enter() -> None:
    z = project(CAMERA, _points_ahead(4, 11))
    z[3, [0, 2]] = z[3, [2, 0]]  # the point would lie behind the cameras
    flags = np.array([True, False, False, False])
    filt = Vislam(CAMERA, T_CAM0_IMU, VislamSettings(), motion_sensor=False)
    report = filt.update(
        observations(0, 0, [5, 6, 7, 8], z, has_right=~flags, stale=np.roll(flags, 1))
    )
    assert report.initialised == 1
    np.testing.assert_array_equal(filt.landmarks().ids, [7])


def test_stale_observations_enter_when_asked_for() -> None:
    z = project(CAMERA, _points_ahead(2, 11))
    filt = Vislam(CAMERA, T_CAM0_IMU, VislamSettings(use_stale=True), motion_sensor=False)
    assert filt.update(observations(0, 0, [1, 2], z, stale=[True, True])).initialised == 2


def test_new_landmark_is_more_certain_when_near() -> None:
    points = np.array([[0.0, 0, 5], [0.0, 0, 40]])
    filt = Vislam(CAMERA, np.eye(4), VislamSettings(), motion_sensor=False)
    filt.update(observations(0, 0, [1, 2], project(CAMERA, points)))
    sigma = np.sqrt(filt.landmarks().covariance[:, 2, 2])
    # The depth's uncertainty grows with the square of the depth.
    assert sigma[1] / sigma[0] == pytest.approx(64.0, rel=1e-6)


def test_no_observations_let_the_covariance_grow() -> None:
    filt = Vislam(CAMERA, T_CAM0_IMU, VislamSettings(), motion_sensor=True)
    traces = []
    for k in range(5):
        filt.propagate(VelocitySample(k * TAU_NS, np.array([5.0, 0, 0]), np.zeros(3)))
        report = filt.update(observations(k, k * TAU_NS, [], np.zeros((0, 4))))
        assert report.used == 0
        assert report.nis_per_dof is None
        traces.append(np.trace(filt.estimate().covariance))
    assert all(b > a for a, b in pairwise(traces))


def test_raw_imu_is_refused_with_a_remedy() -> None:
    filt = Vislam(CAMERA, T_CAM0_IMU, VislamSettings(), motion_sensor=True)
    with pytest.raises(ConfigError, match="--motion none"):
        filt.propagate(ImuSample(0, np.zeros(3), np.zeros(3)))


def test_missing_velocities_are_an_error_that_says_so() -> None:
    filt = Vislam(CAMERA, T_CAM0_IMU, PAPER, motion_sensor=True)
    filt.update(observations(0, 0, [], np.zeros((0, 4))))
    with pytest.raises(EstimationError, match="no velocity sample"):
        filt.update(observations(1, TAU_NS, [], np.zeros((0, 4))))


def test_dead_reckoning_without_a_sensor_is_refused() -> None:
    for settings in (VislamSettings(mode="dead_reckoning"), PAPER):
        with pytest.raises(ConfigError, match="needs velocities"):
            Vislam(CAMERA, T_CAM0_IMU, settings, motion_sensor=False)


def test_the_map_grows_without_losing_a_landmark() -> None:
    filt = Vislam(CAMERA, np.eye(4), VislamSettings(), motion_sensor=False)
    points = _points_ahead(900, 4)
    for k, part in enumerate(np.array_split(np.arange(900), 3)):
        filt.update(observations(k, k * TAU_NS, part, project(CAMERA, points[part])))
    kept = filt.landmarks()
    assert sorted(kept.ids) == list(range(900))
    assert np.isfinite(kept.p_world).all()


@pytest.mark.parametrize("gap", [7, 10**9])
@pytest.mark.parametrize("seed", range(6))
def test_garbage_ends_in_an_error_of_ours_or_in_numbers(seed: int, gap: int) -> None:
    """Features that jump about at random, with gaps: never a NaN passed on, never a foreign
    exception.
    """
    rng = np.random.default_rng(seed)
    filt = Vislam(CAMERA, T_CAM0_IMU, VislamSettings(), motion_sensor=False)
    for k in range(120):
        n = int(rng.integers(0, 6))
        z = np.column_stack([rng.uniform(100, 1200, n), rng.uniform(0, 375, n), np.zeros((n, 2))])
        z[:, 2], z[:, 3] = z[:, 0] - rng.uniform(1, 90, n), z[:, 1]
        try:
            filt.update(observations(k, k * gap * TAU_NS, rng.permutation(12)[:n], z))
        except EstimationError as error:
            told = str(error)
            break
        assert np.isfinite(filt.estimate().T_world_imu).all()
        assert np.isfinite(filt.estimate().covariance).all()
    else:
        return
    assert f"frame {k}" in told
