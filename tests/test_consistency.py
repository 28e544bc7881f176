"""The ablation of the error's definition: that the variants are what they are called, and what each does to yaw."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from tests.numerics import numeric_jacobian
from tools.consistency import FirstEstimates, Flight, Job, Motion, Record, Scenario, StandardErrors, Variant, fly
from vio.evaluation.consistency import nees_bounds
from vio.filters.navigation import DIM, ImuMotion, NavState, TwistMotion
from vio.filters.settings import MsckfSettings
from vio.filters.window import Window
from vio.geometry.lie import FloatArray, se3_exp, so3_log

LANDMARKS = np.array([[4.0, 1.0, 0.5], [6.0, -2.0, 1.0]])


def _fill(kind: type[Window], motion: str) -> Window:
    """Three clones on a moving body and two landmarks, under a full covariance."""
    model = ImuMotion(MsckfSettings()) if motion == "imu" else TwistMotion(MsckfSettings())
    rng = np.random.default_rng(0)
    root = rng.normal(size=(DIM, DIM)) * 0.05
    nav = NavState(np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    window = Window(model, nav, root @ root.T)
    for k in range(3):
        move = se3_exp(rng.normal(0, [0.5, 0.5, 0.5, 0.2, 0.2, 0.2]))
        nav = NavState(move @ window.nav.T_world_imu, rng.normal(size=3), np.zeros(3), np.zeros(3), np.zeros(3))
        window.nav = nav
        window.add_clone(k, k)
        window.prior.P[:DIM, :DIM] += np.eye(DIM) * 1e-3
    A = rng.normal(size=(6, len(window.prior.P))) * 0.3
    window.add_landmarks(np.array([3, 8]), LANDMARKS, A, np.array([np.eye(3) * 1e-3] * 2))
    return kind.over(window) if issubclass(kind, StandardErrors) else window


def _usual_difference(a: Window, b: Window) -> FloatArray:
    """Means of a minus means of b, in the usual errors."""
    poses = [(a.nav.T_world_imu, b.nav.T_world_imu)]
    poses += [(x, y) for x, y in zip(a.clones.T_world_imu, b.clones.T_world_imu, strict=True)]
    changes = [np.concatenate([x[:3, 3] - y[:3, 3], so3_log(x[:3, :3] @ y[:3, :3].T)]) for x, y in poses]
    rest = [a.nav.velocity - b.nav.velocity, a.nav.rate - b.nav.rate]
    if isinstance(a.motion, ImuMotion):
        rest = rest[:1]
    rest.append(a.nav.gyro_bias - b.nav.gyro_bias)
    if isinstance(a.motion, ImuMotion):
        rest.append(a.nav.accel_bias - b.nav.accel_bias)
    return np.concatenate([changes[0], *rest, *changes[1:], (a.landmarks - b.landmarks).ravel()])


@pytest.mark.parametrize("motion", ["imu", "none"])
def test_jacobian_of_the_usual_errors_equals_central_differences(motion: str) -> None:
    """Move the shipped window by a right-invariant error and look at what that is in the usual ones."""
    at = _fill(StandardErrors, motion)
    assert isinstance(at, StandardErrors)

    def moved(error: FloatArray) -> FloatArray:
        window = _fill(Window, motion)
        window.relinearise(error)
        return _usual_difference(window, at)

    numeric = numeric_jacobian(moved, np.zeros(len(at.prior.P)))
    np.testing.assert_allclose(at.standard_D_error(), numeric, atol=1e-7)


def test_standard_errors_keep_the_usual_prior_when_the_means_move() -> None:
    window = _fill(StandardErrors, "imu")
    assert isinstance(window, StandardErrors)
    start, before = _fill(StandardErrors, "imu"), window.standard_D_error()
    P_usual = before @ window.prior.P @ before.T
    window.relinearise(np.random.default_rng(1).normal(0, 0.1, len(window.prior.P)))
    after = window.standard_D_error()
    np.testing.assert_allclose(after @ window.prior.P @ after.T, P_usual, atol=1e-12)
    np.testing.assert_allclose(after @ window.prior.delta, _usual_difference(window, start), atol=1e-12)
    assert np.abs(after - before).max() > 0.1  # so the window's own covariance did change
    assert np.abs(window.prior.P - start.prior.P).max() > 1e-3


def test_first_estimates_keep_their_linearisation_point_and_give_the_same_covariance() -> None:
    window = _fill(FirstEstimates, "imu")
    assert isinstance(window, FirstEstimates)
    start, M = _fill(FirstEstimates, "imu"), window.standard_D_error()
    window.relinearise(np.random.default_rng(1).normal(0, 0.1, len(window.prior.P)))
    np.testing.assert_array_equal(window.prior.P, start.prior.P)
    np.testing.assert_array_equal(window.standard_D_error(), M)
    np.testing.assert_allclose(M @ window.prior.delta, _usual_difference(window, start), atol=1e-12)
    # The output is in right-invariant errors at the present means: the same usual errors by another Jacobian.
    present = StandardErrors(window.motion, window.nav, np.eye(DIM)).standard_D_error()
    output = present @ window.right_invariant(window.prior.P[:DIM, :DIM]) @ present.T
    np.testing.assert_allclose(output, (M @ window.prior.P @ M.T)[:DIM, :DIM], atol=1e-12)


def test_first_estimates_follow_clones_and_landmarks() -> None:
    window = _fill(FirstEstimates, "imu")
    assert isinstance(window, FirstEstimates)
    window.relinearise(np.full(len(window.prior.P), 0.05))
    _, positions, _ = window.linearisation_point()
    window.drop_oldest_clone()
    window.keep_landmarks(np.array([False, True]))
    _, kept, landmarks = window.linearisation_point()
    np.testing.assert_array_equal(kept, positions[1:])
    np.testing.assert_array_equal(landmarks, LANDMARKS[1:])
    assert np.abs(window.landmarks - landmarks).max() > 0.01


def test_flight_and_its_imu_agree() -> None:
    """Integrating the exact rates gives the exact states: what the Monte-Carlo calls the truth is one."""
    flight = Flight()
    t = np.arange(0.0, 2.0, 0.005)
    rng = np.random.default_rng(0)
    quiet = MsckfSettings(
        gyro_noise_density=1e-9, accel_noise_density=1e-9, gyro_bias_sigma_radps=0, accel_bias_sigma_mps2=0,
        gyro_bias_walk=0, accel_bias_walk=0,
    )  # fmt: skip
    motion = ImuMotion(quiet)
    samples, bias = flight.imu(range(401), rng, quiet)
    assert not bias.any()
    for sample in samples:
        motion.take(sample)
    R, p, v = flight.state(t[[0, -1]])
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, p
    end = motion.advance(NavState(T[0], v[0], *np.zeros((3, 3))), 0, round(t[-1] * 1e9)).nav
    np.testing.assert_allclose(end.T_world_imu, T[1], atol=2e-4)
    np.testing.assert_allclose(end.velocity, v[1], atol=2e-4)


@cache
def _record(motion: Motion, variant: Variant, seed: int) -> Record:
    return fly(Job(Scenario(seconds=1.0), motion, "uncertain", variant, seed))


@pytest.mark.parametrize("motion", ["imu", "none"])
def test_standard_errors_gain_yaw_from_nothing_and_the_others_do_not(motion: Motion) -> None:
    """No image and no IMU observes yaw: one degree of uncertainty at the start must still be there at the end."""
    for seed in range(2):
        for variant in ("right-invariant", "first estimates"):
            sigma = _record(motion, variant, seed).yaw_sigma_deg
            assert sigma[0] == pytest.approx(1.0, rel=1e-4)
            assert sigma.min() > 0.999
            assert sigma.max() < 1.05
        assert _record(motion, "standard", seed).yaw_sigma_deg[-1] < 0.75


def test_navigation_state_is_consistent_with_known_noise() -> None:
    """Mean NEES over 20 flights whose start is drawn from its covariance: two-sided, for all that is estimated."""
    runs = 20
    scenario = Scenario(seconds=0.8, features=30)
    records = [fly(Job(scenario, "imu", "uncertain", "right-invariant", seed)) for seed in range(runs)]
    for measure, d in (("pose", 6), ("position", 3), ("orientation", 3), ("velocity", 3), ("gyro bias", 3)):
        mean = np.mean([r.nees[measure][1:] for r in records], axis=0)
        low, high = nees_bounds(d, runs)
        assert low < mean.mean() < high, f"{measure}: mean NEES {mean.mean():.2f}, bounds {low:.2f} to {high:.2f}"
    nis = np.mean([r.nis[5:] for r in records])
    assert 0.9 < nis < 1.1
