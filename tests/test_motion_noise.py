"""How noisy the motion model really is: what one step tells, and what many do."""

from __future__ import annotations

import numpy as np
import pytest

from vio.filters.noise import MotionNoise, StepErrors
from vio.geometry.lie import FloatArray


def _step(
    correction: FloatArray, *, expected: float = 4e-4, process: float = 1e-4, remaining: float = 1e-6
) -> StepErrors:
    """A step whose covariances are those of one axis, the same on all."""
    return StepErrors(correction, np.eye(6) * expected, np.eye(6) * process, np.eye(6) * remaining)


def test_noise_that_is_missing_would_have_explained_the_correction() -> None:
    shock = np.array([0.3, 0, 0, 0, 0, 0.02])
    step = _step(shock)
    missing = step.missing_noise()
    assert missing[1] == 0.0  # 0.02 rad is one sigma
    removed, wider = 3 * (4e-4 - 1e-6), 3 * (4e-4 + missing[0] * 1e-4)
    np.testing.assert_allclose(wider / (3 * 4e-4), 0.3**2 / removed)
    assert not _step(np.array([0.1, 0, 0, 0, 0, 0])).missing_noise().any()  # 3 sigma less a little


def test_images_that_tell_little_find_no_noise_missing() -> None:
    assert not _step(np.full(6, 5.0), remaining=3e-4).missing_noise().any()


def test_missing_noise_is_bounded_where_the_model_claims_none() -> None:
    assert _step(np.full(6, 5.0), process=0.0).missing_noise().tolist() == [1e6, 1e6]


@pytest.mark.parametrize("true", [0.5, 1.0, 6.0])
def test_factors_find_how_much_noisier_the_sensor_is(true: float) -> None:
    """Corrections as a sensor makes them whose noise is `true` times the data sheet's; the filter uses the factor."""
    noise, rng = MotionNoise(1.0, 0.1, 50.0), np.random.default_rng(0)
    sheet, factors = 1e-4, []
    for _ in range(3000):
        P = np.diag(sheet * np.repeat(noise.factors**2, 3))
        noise.follow(StepErrors(rng.normal(0, np.sqrt(sheet) * true, 6), P, P, np.eye(6) * 1e-9))
        factors.append(noise.factors.copy())
    np.testing.assert_allclose(np.mean(factors[1000:], axis=0), true, rtol=0.1)


def test_factors_of_translation_and_rotation_are_learned_apart_and_stay_in_bounds() -> None:
    noise = MotionNoise(1.0, 0.8, 1.5)
    for _ in range(200):
        noise.follow(_step(np.array([1.0, 1, 1, 0, 0, 0]), process=4e-4))
    np.testing.assert_array_equal(noise.factors, [1.5, 0.8])


def test_factors_wait_for_the_sum_and_pass_over_what_tells_little() -> None:
    noise = MotionNoise(5.0, 1.0, 50.0)
    for _ in range(9):
        noise.follow(_step(np.full(6, 1.0)))
        noise.follow(_step(np.full(6, 1.0), remaining=3.9e-4))
    np.testing.assert_array_equal(noise.factors, [5.0, 5.0])
    noise.follow(_step(np.full(6, 1.0)))
    np.testing.assert_allclose(noise.factors, 5.0 * 4.0 ** (0.5 * 0.5 * 0.25))  # a quarter of the doubt is the step's
