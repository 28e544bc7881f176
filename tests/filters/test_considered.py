"""Constants of the rig that are considered: the covariance has how the estimate follows them,
which moves nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.filters.test_filter_truth import CAMERA, SETTINGS, Course, fly
from vio.cameras.rectification_error import CONSIDERED
from vio.filters.prior import Prior
from vio.filters.scale_test import ScaleTest
from vio.geometry.lie import se3_inverse, se3_log
from vio.records import MotionSource, Observations

ROUND = Course(20, 2.0, velocity=(0.4, 0.5, 0.0), yaw_rate=0.2, depth=(2.0, 8.0), features=80)
SIGMAS = {"baseline": 0.005, "focal": 0.003, "u": 0.001, "v": 0.001}
ON = replace(SETTINGS, stereo_baseline_sigma=SIGMAS["baseline"], stereo_focal_sigma=SIGMAS["focal"])
OFF = 1e-6  # small enough for gates and weights to stay as they are


def _seen_by(constant: str, off: float, seen: Observations) -> Observations:
    """What a camera sees of which one constant is off."""
    z = seen.z.copy()
    centre = np.array([CAMERA.cu, CAMERA.cv, CAMERA.cu, CAMERA.cv])
    if constant == "baseline":
        z[:, 2] = z[:, 0] - (z[:, 0] - z[:, 2]) * np.exp(off)
    elif constant == "focal":
        z = centre + (z - centre) * np.exp(off)
    else:
        z += off * CAMERA.fu * np.array([constant == "u", constant == "v"] * 2)
    return replace(seen, z=z)


@pytest.mark.parametrize("motion", [None, "imu"])
@pytest.mark.parametrize("field", ["off", "on"])
def test_the_covariance_says_how_the_pose_follows_the_rig(
    motion: MotionSource | None, field: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against runs on images in which one constant is off at a time. What an IMU leaves open of a
    scale that is off by more is added to it (`test_scale_test.py`).
    """
    monkeypatch.setattr(ScaleTest, "doubt", lambda self: 0.0)
    settings = replace(ON, calibrate_stereo=field)
    known = replace(settings, stereo_baseline_sigma=0.0, stereo_focal_sigma=0.0)
    run, exact = fly(ROUND, motion, settings), fly(ROUND, motion, known)
    T = run.last_pose
    # Not to the bit: BLAS may round products that also have the constants' columns in another way.
    np.testing.assert_allclose(T, exact.last_pose, rtol=0, atol=1e-9)
    expected = np.zeros((6, 6))
    for constant, sigma in SIGMAS.items():
        of_rig = fly(ROUND, motion, known, spoil=lambda k, seen, c=constant: _seen_by(c, OFF, seen))  # type: ignore[misc]
        moved = se3_log(se3_inverse(T) @ of_rig.last_pose) / OFF * sigma
        expected += np.outer(moved, moved)
    added = run.estimates[-1].covariance - exact.estimates[-1].covariance
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.sqrt(np.diag(added)), scale, rtol=0.1)
    if motion is None:  # with an IMU, yaw is measured at a tilt that is an estimate, too
        np.testing.assert_allclose(
            added / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.1
        )


def test_the_covariances_of_points_say_how_they_follow_the_rig() -> None:
    """Against runs on images in which one constant is off at a time: points of tracks and
    landmarks of the state.
    """
    known = replace(ON, stereo_baseline_sigma=0.0, stereo_focal_sigma=0.0)
    run, exact = (fly(ROUND, None, settings).filter.landmarks() for settings in (ON, known))
    np.testing.assert_array_equal(run.ids, exact.ids)
    added = np.trace(run.covariance - exact.covariance, axis1=1, axis2=2)
    expected = np.zeros(len(run.ids))
    for constant, sigma in SIGMAS.items():
        of_rig = fly(
            ROUND, None, known, spoil=lambda k, seen, c=constant: _seen_by(c, OFF, seen)
        ).filter.landmarks()  # type: ignore[misc]
        np.testing.assert_array_equal(run.ids, of_rig.ids)
        expected += np.sum((of_rig.p_world - exact.p_world) ** 2, axis=1) * (sigma / OFF) ** 2
    ratio = np.sqrt(added / expected)
    assert len(ratio) > 100
    np.testing.assert_allclose(np.quantile(ratio, [0.05, 0.5, 0.95]), 1, atol=0.2)


@pytest.mark.parametrize("scaled", [False, True])
def test_a_prior_follows_its_constants(scaled: bool) -> None:
    """Against the same equations with one constant known and taken out of prior and measurement."""
    rng, D = np.random.default_rng(3), 4
    P, moved = np.diag(rng.uniform(0.5, 2.0, D)), rng.normal(size=D) * scaled
    V = rng.normal(size=(D, 1 + CONSIDERED))
    H, r, C = rng.normal(size=(2, D)), rng.normal(size=2), rng.normal(size=(2, CONSIDERED))
    columns = np.column_stack([H @ moved, C])

    def absorbed(constants: np.ndarray) -> Prior:
        prior = Prior(P.copy())
        prior.scale_test, prior.error_D_constants = ScaleTest(), V.copy()
        prior.delta = -V @ constants
        prior.absorb(
            H.T @ H,
            H.T @ (r - columns @ constants),
            scaled=moved if scaled else None,
            considered=H.T @ C,
        )
        return prior

    without = absorbed(np.zeros(1 + CONSIDERED))
    for k, one in enumerate(np.eye(1 + CONSIDERED)):
        difference = without.delta - absorbed(one).delta
        np.testing.assert_allclose(without.error_D_constants[:, k], difference, atol=1e-12)


def test_squared_distance_of_the_means_leaves_out_what_is_known_or_a_copy() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(4, 4)) * [[1e-3], [1.0], [30.0], [1.0]]
    prior = Prior(root @ root.T)
    prior.delta = rng.normal(size=4)
    plain = float(prior.delta @ np.linalg.solve(prior.P, prior.delta))
    assert prior.squared_distance(slice(None)) == (pytest.approx(plain), 4)
    own = prior.delta[1:3]
    part = float(own @ np.linalg.solve(prior.P[1:3, 1:3], own))
    assert prior.squared_distance(slice(1, 3)) == (pytest.approx(part), 2)
    prior.insert(2, np.zeros((3, 3)))
    prior.insert_dependent(7, np.eye(2, 7), np.zeros((2, 2)), np.zeros(2))
    assert prior.squared_distance(slice(None)) == (pytest.approx(plain), 4)
