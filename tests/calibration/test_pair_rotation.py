"""The rotation of a right camera, by points whose rotation and lens are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vio.calibration.pair_rotation import (
    rotation_by_motion,
    rotation_by_rows,
    turned_pixels,
)
from vio.geometry.lie import FloatArray, se3_exp, so3_exp, transform_points
from vio.geometry.stereo import StereoCamera

CAMERA = StereoCamera(718.0, 718.0, 620.0, 188.0, 0.54, 1241, 376)
MOVED = se3_exp(np.array([0.02, -0.03, -1.0, 0.001, 0.012, -0.002]))  # a drive, T_second_first
STILL = np.eye(4)


def deg(*angles: float) -> FloatArray:
    return np.radians(angles)


def points(seed: int = 0, count: int = 250) -> FloatArray:
    """Points (N, 3) of the left camera in view, 6 to 80 m away."""
    rng = np.random.default_rng(seed)
    depth = np.exp(rng.uniform(np.log(6.0), np.log(80.0), count))
    u = rng.uniform(150, 1200, count)
    v = rng.uniform(10, 366, count)
    return np.stack([(u - 620) / 718, (v - 188) / 718, np.ones(count)], axis=1) * depth[:, None]


def seen(p: FloatArray, rotation: FloatArray, p2: float = 0.0, seed: int = 1) -> FloatArray:
    """Pixels (N, 4) with a noise of 0.2 px; the right camera is turned and has a distortion."""
    right = (p - [CAMERA.baseline_m, 0, 0]) @ so3_exp(rotation).T
    out = []
    for q, bent in ((p, 0.0), (right, p2)):
        x, y = q[:, 0] / q[:, 2], q[:, 1] / q[:, 2]
        r2 = x * x + y * y
        out += [718 * (x + bent * (r2 + 2 * x * x)) + 620, 718 * (y + bent * 2 * x * y) + 188]
    z = np.stack(out, axis=1)
    return z + np.random.default_rng(seed).normal(0, 0.2, z.shape)


def with_wrong(z: FloatArray, share: float) -> FloatArray:
    """Pixels of which a share have right ones of other points."""
    wrong = np.arange(round(share * len(z)))
    out = z.copy()
    out[wrong, 2:] = np.roll(z[wrong, 2:], 1, axis=0)
    return out


@pytest.mark.parametrize("angles", [(0, 0, 0), (1.9, 0, 0), (0, 0, -1.9), (0.7, -0.4, 1.2)])
def test_rows_of_one_pair_tell_pitch_and_roll_among_wrong_matches(angles: tuple[float]) -> None:
    found = rotation_by_rows(CAMERA, with_wrong(seen(points(), deg(*angles)), 0.2))
    assert found is not None
    off = np.abs(found.rotation - deg(*angles))
    assert np.degrees(off[[0, 2]]).max() < 0.02
    assert (off < 4 * found.sigmas).all()
    assert 0.75 < found.share < 0.85


def test_a_tangential_distortion_looks_like_a_yaw_in_rows() -> None:
    """By (R2): 2 p2 = 0.006 rad = 0.34 degrees, and motion tells them apart."""
    p = points()
    first = seen(p, deg(0, 0, 0), p2=0.003)
    second = seen(transform_points(MOVED, p), deg(0, 0, 0), p2=0.003, seed=2)
    rows = rotation_by_rows(CAMERA, first)
    assert rows is not None
    assert np.degrees(rows.rotation[1]) == pytest.approx(0.34, abs=0.1)
    both = rotation_by_motion(CAMERA, first, second, rows.rotation)
    assert both is not None
    assert abs(np.degrees(both.rotation[1])) < 0.05


@pytest.mark.parametrize("yaw", [-2.0, -0.3, 0.3, 2.0])
def test_motion_tells_the_yaw_as_well_as_it_says(yaw: float) -> None:
    turned = deg(0.3, yaw, -0.5)
    scores = []
    for seed in range(12):
        p = points(seed)
        first = with_wrong(seen(p, turned, p2=0.001, seed=seed), 0.1)
        second = seen(transform_points(MOVED, p), turned, p2=0.001, seed=100 + seed)
        rows = rotation_by_rows(CAMERA, first)
        assert rows is not None
        both = rotation_by_motion(CAMERA, first, second, rows.rotation)
        assert both is not None
        error = both.rotation - turned
        assert np.degrees(np.abs(error)).max() < 0.08
        scores.append(error @ np.linalg.solve(both.covariance, error))
    # chi-square of 3 x 12 degrees of freedom: 95 % in 21 to 54; pixels count as 0.3 px at least
    assert 5 < sum(scores) < 54


def test_without_motion_the_lens_bounds_what_is_known_of_the_yaw() -> None:
    p = points()
    turned = deg(0.3, 0.5, -0.5)
    first = seen(p, turned, p2=0.003)
    rows = rotation_by_rows(CAMERA, first)
    assert rows is not None
    both = rotation_by_motion(CAMERA, first, seen(p, turned, p2=0.003, seed=2), rows.rotation)
    assert both is not None
    # 2 x 0.002 rad is 0.23 degrees
    assert np.degrees(both.sigmas[1]) == pytest.approx(0.23, abs=0.05)
    assert abs(both.rotation[1] - turned[1]) < 3 * both.sigmas[1]
    assert np.degrees(np.abs(both.rotation - turned)[[0, 2]]).max() < 0.03


def test_few_or_contradictory_points_tell_nothing() -> None:
    rng = np.random.default_rng(3)
    p = points(count=20)
    z = seen(p, deg(0, 0, 0))
    assert rotation_by_rows(CAMERA, z) is None
    assert rotation_by_motion(CAMERA, z, z, np.zeros(3)) is None
    scattered = rng.uniform(0, 376, (60, 4))
    found = rotation_by_rows(CAMERA, scattered)
    assert found is None or found.share < 0.5


def test_a_homography_turns_pixels() -> None:
    p = points()
    turned = deg(0.5, -0.8, 1.5)
    ideal = seen(p, np.zeros(3), seed=4)
    noise = ideal[:, 2:] - seen(p, np.zeros(3), seed=5)[:, 2:]
    H = turned_pixels(CAMERA, turned)
    z = np.column_stack([ideal[:, 2:], np.ones(len(p))]) @ H.T
    away = z[:, :2] / z[:, 2:] - seen(p, turned, seed=5)[:, 2:]
    np.testing.assert_allclose(away, noise, atol=0.15)


def test_opencvs_random_numbers_stay_the_callers() -> None:
    """A seed set here would start the caller's sequence anew, and no function used here has one."""
    p = points()
    cv2.setRNGSeed(7)
    expected = cv2.randu(np.zeros((1, 3)), 0, 1).copy()
    cv2.setRNGSeed(7)
    first = seen(p, deg(0, 0, 0))
    second = seen(transform_points(MOVED, p), deg(0, 0, 0), seed=2)
    assert rotation_by_motion(CAMERA, first, second, np.zeros(3)) is not None
    np.testing.assert_array_equal(cv2.randu(np.zeros((1, 3)), 0, 1), expected)
