"""How noisy the motion model really is: what one step tells, and what many do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from vio.filters.noise import MotionNoise, StepErrors, whitened_correction
from vio.geometry.lie import FloatArray

_AXES = {
    "isotropic": (1.0, 1.0, 1.0),
    "one axis": (100.0, 1.0, 1.0),
    "two axes": (100.0, 100.0, 1.0),
}


def _step(
    correction: FloatArray,
    *,
    expected: float = 4e-4,
    process: float = 1e-4,
    remaining: float = 1e-6,
) -> StepErrors:
    """A step whose covariances are those of one axis, the same on all."""
    return StepErrors(correction, np.eye(6) * expected, np.eye(6) * process, np.eye(6) * remaining)


def _covariance(axes: tuple[float, float, float], seed: int) -> FloatArray:
    """A covariance (3, 3) of these variances along axes that are turned at random."""
    R, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    out: FloatArray = R @ np.diag(axes) @ R.T
    return out


def _draw(rng: np.random.Generator, P: FloatArray, truth: float, remaining: float) -> StepErrors:
    """A step whose sensor is noisier than P (6, 6) says by a factor; the images leave a share of P.

    The correction is what the images say of the prediction's error, a share `1 - remaining` of it
    and noise of their own, with covariance `P_true - P_remaining` where the factor is one.
    """
    gain = 1 - remaining
    images = rng.multivariate_normal(np.zeros(6), P * remaining / gain, method="cholesky")
    correction = gain * (
        rng.multivariate_normal(np.zeros(6), P * truth**2, method="cholesky") + images
    )
    return StepErrors(correction, P, P, P * remaining)


def test_noise_that_is_missing_would_have_explained_the_correction() -> None:
    shock = np.array([0.3, 0, 0, 0, 0, 0.02])
    step = _step(shock)
    missing = step.missing_noise()
    assert missing[1] == 0.0  # 0.02 rad is one sigma
    squared = 0.3**2 / (4e-4 - 1e-6)
    explained = 4e-4 + missing[0] * 1e-4  # variance on each axis of a step that knew it
    np.testing.assert_allclose(explained / 4e-4, squared / 3)
    # 4.5 sigma, chi-square 20.3 of 21.1
    assert not _step(np.array([0.09, 0, 0, 0, 0, 0])).missing_noise().any()
    assert _step(np.array([0.093, 0, 0, 0, 0, 0])).missing_noise()[0] > 0


def test_images_that_tell_little_find_no_noise_missing() -> None:
    assert not _step(np.full(6, 5.0), remaining=3e-4).missing_noise().any()


def test_missing_noise_is_bounded_where_the_model_claims_none() -> None:
    assert _step(np.full(6, 5.0), process=0.0).missing_noise().tolist() == [1e6, 1e6]


@pytest.mark.parametrize("axes", _AXES.values(), ids=_AXES)
@pytest.mark.parametrize("informed", [1, 2, 3])
def test_the_whitened_correction_is_chi_square_in_the_informed_directions(
    axes: tuple[float, float, float], informed: int
) -> None:
    """Any covariance, images that know only some directions: Kolmogorov-Smirnov on 2000
    corrections.
    """
    rng = np.random.default_rng(1)
    B = 1e-4 * _covariance(axes, 2)
    L = np.linalg.cholesky(B)
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    # shares of the predicted variance
    removed = np.where(np.arange(3) < informed, [0.9, 0.6, 0.4], 0.1)
    gained = L @ (Q * removed) @ Q.T @ L.T
    expected, remaining = np.eye(6), np.eye(6)
    expected[:3, :3], remaining[:3, :3] = B, B - gained
    process = 0.25 * expected
    root = L @ Q @ np.diag(np.sqrt(removed))
    values = []
    for _ in range(2000):
        correction = np.concatenate([root @ rng.normal(size=3), np.zeros(3)])
        test = whitened_correction(
            StepErrors(correction, expected, process, remaining), slice(0, 3)
        )
        assert test.dof == informed
        np.testing.assert_allclose(test.share, 0.25, rtol=1e-6)
        values.append(test.squared)
    assert kstest(values, chi2(informed).cdf).pvalue > 1e-3


def test_a_correction_without_covariance_or_information_says_nothing() -> None:
    for step in (
        _step(np.ones(6), expected=0.0, remaining=0.0),
        _step(np.ones(6), remaining=3.9e-4),
    ):
        test = whitened_correction(step, slice(0, 3))
        assert (test.squared, test.dof, test.share) == (0.0, 0, 0.0)


@pytest.mark.parametrize("axes", _AXES.values(), ids=_AXES)
@pytest.mark.parametrize("truth", [0.5, 1.0, 6.0])
def test_factors_find_how_much_noisier_the_sensor_is(
    axes: tuple[float, float, float], truth: float
) -> None:
    """Corrections as a sensor makes them whose noise is `truth` times the data sheet's; the filter
    uses the factor.

    Whatever the shape of the covariance: with one dominant axis an isotropic statistic settles at
    0.73.
    """
    noise, rng = MotionNoise(1.0, 0.1, 50.0), np.random.default_rng(0)
    sheet = np.zeros((6, 6))
    sheet[:3, :3], sheet[3:, 3:] = 1e-4 * _covariance(axes, 3), 1e-6 * _covariance(axes, 4)
    logs = []
    for _ in range(12000):
        scale = np.repeat(noise.factors, 3)
        P = sheet * np.outer(scale, scale)
        correction = rng.multivariate_normal(np.zeros(6), truth**2 * sheet, method="cholesky")
        noise.update(StepErrors(correction, P, P, P * 1e-6))
        logs.append(np.log(noise.factors))
    np.testing.assert_allclose(np.exp(np.mean(logs[2000:], axis=0)), truth, rtol=0.05)


@pytest.mark.parametrize("remaining", [0.1, 0.5])
def test_a_right_factor_stays_where_the_images_are_no_exact_truth(remaining: float) -> None:
    """The covariance of a correction is what the images removed, not all of the predicted
    variance.
    """
    noise, rng, logs = MotionNoise(1.0, 0.1, 50.0), np.random.default_rng(5), []
    sheet = np.zeros((6, 6))
    sheet[:3, :3], sheet[3:, 3:] = 1e-4 * _covariance((100.0, 1.0, 1.0), 3), 1e-6 * np.eye(3)
    for _ in range(12000):
        scale = np.repeat(noise.factors, 3)
        truth = 1 / noise.factors[0]  # of the translation; the rotation is not looked at here
        noise.update(_draw(rng, sheet * np.outer(scale, scale), truth, remaining))
        logs.append(np.log(noise.factors[0]))
    np.testing.assert_allclose(np.exp(np.mean(logs[2000:])), 1.0, rtol=0.05)


def test_factors_of_translation_and_rotation_are_learned_apart_and_stay_in_bounds() -> None:
    noise = MotionNoise(1.0, 0.8, 1.5)
    for _ in range(200):
        noise.update(_step(np.array([1.0, 1, 1, 0, 0, 0]), process=4e-4))
    np.testing.assert_array_equal(noise.factors, [1.5, 0.8])


def test_factors_wait_for_the_sum_and_pass_over_what_tells_little() -> None:
    noise = MotionNoise(5.0, 1.0, 50.0)
    for _ in range(9):
        noise.update(_step(np.full(6, 1.0)))
    np.testing.assert_array_equal(noise.factors, [5.0, 5.0])
    noise.update(_step(np.full(6, 1.0)))
    # Equation (N8): the first of the sums, whose probability is one; a quarter of the variance is
    # the steps' own.
    variance, H = 1.5**2 + 0.15**2, 2 / np.pi / 4
    # of the logarithm of the squared factor; the innovation is one
    change = variance * H / (H * variance * H + 1 / 3)
    np.testing.assert_allclose(noise.factors, 5.0 * np.exp(0.5 * change))
    learned = noise.factors.copy()
    for _ in range(10):
        noise.update(_step(np.full(6, 1.0), remaining=3.95e-4))
    np.testing.assert_array_equal(noise.factors, learned)


def test_a_single_wild_sum_moves_a_settled_factor_little() -> None:
    """The statistic is bounded: however large a correction, it counts as one improbable sum."""
    noise, rng = MotionNoise(1.0, 0.1, 50.0), np.random.default_rng(6)
    P = np.eye(6) * 1e-4
    for _ in range(3000):
        noise.update(
            StepErrors(
                rng.normal(0, 1e-2, 6),
                P * noise.factors[0] ** 2,
                P * noise.factors[0] ** 2,
                P * 1e-6,
            )
        )
    before = noise.factors.copy()
    for _ in range(10):
        noise.update(StepErrors(np.full(6, 1e3), P, P, P * 1e-6))
    assert np.all(noise.factors / before < 1.25)


def _seen(rng: np.random.Generator, P: float, sensor: float, images: float) -> StepErrors:
    """A step of a sensor of variance `sensor` that P is thought to be, on all axes; `images`:
    variance of the images.
    """
    gain = P / (P + images)
    correction = gain * rng.normal(0.0, np.sqrt(sensor + images), 6)
    return StepErrors(correction, P * np.eye(6), P * np.eye(6), (1 - gain) * P * np.eye(6))


def _learned(truth: float, steps: int, share: float = 0.05) -> FloatArray:
    """The factors after so many steps of a sensor that is worse than thought by a factor, and of
    images that would remove a share of the variance that is thought of.
    """
    noise = MotionNoise(1.0, 1.0, 50.0)
    rng = np.random.default_rng(3)
    images = (1 - share) / share
    for _ in range(steps):
        P = float(noise.factors.max()) ** 2
        noise.update(_seen(rng, P, truth**2, images))
    return noise.factors


def test_a_sensor_that_is_thought_far_better_than_the_images_is_found_out() -> None:
    """The images would remove a twentieth of its variance, which tells little; that corrections are
    exceptions sum after sum does.
    """
    assert np.all(_learned(10.0, 400) > 6.0)
    assert np.all(_learned(10.0, 400) < 15.0)


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_a_sensor_that_is_far_better_than_the_images_stays_what_it_is(share: float) -> None:
    assert np.all(_learned(1.0, 4000, share) < 1.2)


def _after(*sizes: float, remaining: float = 0.95) -> float:
    """The factor after sums of steps of these sizes, each of ten, whose images remove little."""
    noise = MotionNoise(1.0, 1.0, 50.0)
    for size in sizes:
        for k in range(10):
            left = remaining * np.eye(6)
            noise.update(StepErrors(np.full(6, size * (k == 9)), np.eye(6), np.eye(6), left))
    return float(noise.factors[0])


def test_one_exception_alone_is_no_noise() -> None:
    """As of a bias that jumps, and is estimated anew."""
    assert _after(20.0, 0.0, 20.0) == 1.0
    assert _after(20.0, 20.0) > 1.5


# chi-square of three for ten steps: 3 size^2 over 10 times the share removed, 11.3 at 0.99
LIMITS = [(1.3, 0.95, False), (1.45, 0.95, True), (20.0, 0.985, False), (20.0, 0.975, True)]


@pytest.mark.parametrize(("size", "remaining", "found"), LIMITS)
def test_exceptions_begin_at_one_of_a_hundred_where_images_remove_two_hundredths(
    size: float, remaining: float, found: bool
) -> None:
    assert (_after(size, size, remaining=remaining) > 1.0) == found
