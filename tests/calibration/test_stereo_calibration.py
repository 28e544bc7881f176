"""Self-calibration of the stereo pair: its model, the learned rows, the elimination, and runs in an
exact world.

A right camera that is turned by a known angle, lenses with known distortion, and dense normal
equations are the references.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from tests.filters import test_filter_truth
from tests.filters.test_filter_truth import SETTINGS, Course, Run, Spoil, fly
from tests.filters.test_multiview import T_CAM0_WORLD
from tests.jacobians import numeric_jacobian
from tests.numpy_twins import point_D_pose, radial_focal
from vio.cameras.rectification_error import (
    TERMS,
    ErrorColumns,
    corrected_pixels,
    error_basis,
    vertical_disparity_terms,
)
from vio.filters.multiview import (
    _TRIANGULATION,
    TrackInformation,
    refine_points,
    residuals,
    track_information,
)
from vio.filters.stereo_calibration import (
    StereoColumns,
    StereoCorrection,
    VerticalDisparityModel,
    eliminate_points,
    stereo_columns,
)
from vio.filters.track_records import Residuals, Views
from vio.geometry.distortion import CameraModel, project_point
from vio.geometry.lie import FloatArray, se3_inverse, so3_exp, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.records import MotionSource, Observations, observations

# fu and fv differ, so that neither passes for both
CAMERA = StereoCamera(460.0, 440.0, 370.0, 240.0, 0.11, 752, 480)
CLONES = len(T_CAM0_WORLD)


# The model


def _distorted(
    rays: FloatArray, radial: tuple[float, float], tangential: tuple[float, float]
) -> FloatArray:
    """Pixels (..., 2) of rays through a lens with OpenCV's k1, k2 and p1, p2."""
    c = CAMERA
    lens = CameraModel(c.fu, c.fv, c.cu, c.cv, 752, 480, "radtan", (*radial, *tangential))
    return project_point(lens, rays)[0]


def _rays(camera: StereoCamera, uv: FloatArray) -> FloatArray:
    xy = (uv - [camera.cu, camera.cv]) / [camera.fu, camera.fv]
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)


def _grid() -> FloatArray:
    """Stereo pixels (N, 4) over the image at several disparities."""
    u, v, d = np.meshgrid(np.linspace(60, 700, 7), np.linspace(30, 450, 5), [2.0, 20.0, 50.0])
    return np.stack([u, v, u - d, v], axis=-1).reshape(-1, 4)


def test_error_jacobian_equals_central_differences_of_distorted_projections() -> None:
    """Both lenses distorted alike, columns of the right camera moved as (R3) says, and both
    scaled as by (R4).
    """
    z = _grid()

    def seen(s: FloatArray) -> FloatArray:
        left, right = (
            _distorted(_rays(CAMERA, z[:, c]), (s[4], s[5]), (s[6], s[7]))
            for c in (slice(0, 2), slice(2, 4))
        )
        x, y = _rays(CAMERA, z[:, 2:])[:, :2].T
        r2 = x * x + y * y
        right[:, 0] += CAMERA.fu * (s[0] + s[1] * x + s[2] * r2 + s[3] * r2 * r2)
        left = [CAMERA.cu, CAMERA.cv] + (left - [CAMERA.cu, CAMERA.cv]) * np.exp(s[9])
        right[:, 0] = CAMERA.cu + (right[:, 0] - CAMERA.cu) * np.exp(s[9])
        right[:, 0] += (z[:, 0] - z[:, 2]) * (1 - np.exp(s[8]))
        longer = radial_focal(CAMERA) @ s[4:6]
        moved = longer * (z[:, :2] - [CAMERA.cu, CAMERA.cv])
        left -= moved
        right[:, 0] -= moved[:, 0]
        right[:, 1] = z[:, 3]  # right rows are not measured
        return np.concatenate([left, right], axis=1)

    numeric = numeric_jacobian(seen, np.zeros(TERMS), eps=1e-6).reshape(-1, 4, TERMS)
    np.testing.assert_allclose(ErrorColumns(CAMERA).jacobian(z), numeric, atol=1e-4)


def test_what_both_lenses_do_to_rows_is_taken_off_those_of_the_right_camera() -> None:
    """The columns that follow from the rows then move with k1, k2, q1 and q2, by central
    differences.
    """
    z, rng = _grid(), np.random.default_rng(4)
    rows, rows_D_common = np.zeros(7), rng.normal(0, 0.1, (7, 4))

    def corrected(s: FloatArray) -> FloatArray:
        field = StereoCorrection(CAMERA, rows - rows_D_common @ s[4:8], s, np.arange(TERMS))
        return field.corrected(Views(z, np.ones(z.shape))).z

    numeric = numeric_jacobian(corrected, np.zeros(TERMS), eps=1e-6).reshape(-1, 4, TERMS)
    field = StereoCorrection(CAMERA, rows, np.zeros(TERMS), np.arange(TERMS), rows_D_common)
    np.testing.assert_allclose(field.columns().jacobian(z), -numeric, atol=1e-4)


def test_jacobian_rows_and_correction_are_of_the_same_terms() -> None:
    rng = np.random.default_rng(8)
    z = rng.uniform([100, 50, 50, 50], [700, 430, 650, 430], (20, 4))
    coefficients, rows = rng.normal(0, 1e-3, 8), np.append(rng.normal(0, 1e-3, 6), 0.0)
    basis, (own, common) = error_basis(CAMERA, z), vertical_disparity_terms(CAMERA, z)
    np.testing.assert_allclose(
        basis[:, :3, :8], ErrorColumns(CAMERA).jacobian(z)[:, :3, :8], rtol=1e-12
    )
    np.testing.assert_allclose(basis[:, 3, 8:], CAMERA.fv * own, rtol=1e-12)
    np.testing.assert_allclose(
        basis[:, 3, 4:8] - basis[:, 1, 4:8], CAMERA.fv * common, rtol=1e-9, atol=1e-9
    )
    found = corrected_pixels(CAMERA, np.append(coefficients, [0.0, 0.0]), rows, z, np.ones_like(z))
    np.testing.assert_allclose(
        (z - found)[:, :3], basis[:, :3] @ np.append(coefficients, rows), atol=1e-9
    )


def _right_columns(rows: VerticalDisparityModel, states: FloatArray, z: FloatArray) -> FloatArray:
    """The field (M,) of the right columns at pixels (M, 4)."""
    field = StereoCorrection(
        CAMERA, rows.coefficients, np.concatenate([states, np.zeros(2)]), np.arange(TERMS)
    )
    return (z - field.corrected(Views(z, np.ones(z.shape))).z)[:, 2]


def test_a_wrong_baseline_and_focal_length_are_taken_out_of_the_pixels() -> None:
    """(R4): what a pair of 3 % longer focal length and 7 % longer baseline sees, and back."""
    true = replace(
        CAMERA, fu=1.03 * CAMERA.fu, fv=1.03 * CAMERA.fv, baseline_m=1.07 * CAMERA.baseline_m
    )
    p = np.random.default_rng(3).uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 6.0], (20, 3))
    z, expected = project(true, p), project(CAMERA, p)
    scale = np.concatenate([np.zeros(8), np.log([1.07, 1.03])])
    field = StereoCorrection(CAMERA, np.zeros(7), scale, np.array([8, 9]))
    weight = np.tile([1.0, 1.0, 1.0, 0.0], (20, 1))
    weight[3, 2] = 0.0
    corrected = field.corrected(Views(z, weight)).z
    np.testing.assert_allclose(corrected[:, :2], expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(
        np.delete(corrected, 3, axis=0)[:, 2], np.delete(expected, 3, axis=0)[:, 2], atol=1e-9
    )
    assert corrected[3, 2] == z[3, 2]
    np.testing.assert_allclose(field.seen(expected), z, atol=1e-9)
    assert field.columns().jacobian(z).shape == (20, 4, 2)


def _turned_right(z: FloatArray, camera: StereoCamera, w: FloatArray) -> FloatArray:
    """Stereo pixels (N, 4) where the right camera is turned: its points p are seen as
    `exp(w) p`.
    """
    p = _rays(camera, z[:, 2:]) @ so3_exp(w).T
    out = z.copy()
    out[:, 2] = camera.fu * p[:, 0] / p[:, 2] + camera.cu
    out[:, 3] = camera.fv * p[:, 1] / p[:, 2] + camera.cv
    return out


@pytest.mark.parametrize("axis", range(3))
def test_rows_and_three_states_describe_a_turn_of_the_right_camera(axis: int) -> None:
    """0.01 deg about each axis: (R1) and (R2) as printed, and columns by (R3) from rows learned
    of (R2).
    """
    w = np.radians(0.01) * np.eye(3)[axis]
    z = _grid()
    moved = _turned_right(z, CAMERA, w) - z
    x, y = _rays(CAMERA, z[:, 2:])[:, :2].T
    du = w[1] - w[2] * y - w[0] * x * y + w[1] * x * x  # (R1)
    dv = -w[0] + w[2] * x + w[1] * x * y - w[0] * y * y  # (R2)
    np.testing.assert_allclose(moved[:, 2], CAMERA.fu * du, atol=1e-4)
    np.testing.assert_allclose(moved[:, 3], CAMERA.fv * dv, atol=1e-4)
    assert np.abs(moved[:, 2:]).max() > 0.05

    rows = _learned(z + moved)
    states = np.array([w[1], 0, w[1], 0, 0, 0, 0, 0])
    field = _right_columns(rows, states, z)
    np.testing.assert_allclose(field, moved[:, 2], atol=1e-3)


def test_rows_and_three_states_describe_tangential_distortion_of_the_right_lens() -> None:
    p1, p2 = 2e-4, -1e-4
    z = _grid()
    moved = z.copy()
    moved[:, 2:] = _distorted(_rays(CAMERA, z[:, 2:]), (0.0, 0.0), (p1, p2))
    states = np.array([0, 0, 3 * p2, 0, 0, 0, 0, 0])
    field = _right_columns(_learned(moved), states, z)
    np.testing.assert_allclose(field, (moved - z)[:, 2], atol=1e-3)
    assert np.abs((moved - z)[:, 2]).max() > 0.1


def test_a_right_camera_below_the_left_one_s_row_is_no_turn() -> None:
    """It moves the rows of near points alone, by its share of the baseline; no column follows
    from it.
    """
    z, below = _grid(), 6e-3
    moved = z.copy()
    moved[:, 3] -= below * (z[:, 0] - z[:, 2]) * CAMERA.fv / CAMERA.fu
    rows = _learned(moved)
    np.testing.assert_allclose(rows.coefficients, [0, 0, 0, 0, 0, 0, -below], atol=1e-5)
    assert np.abs(_right_columns(rows, np.zeros(8), z)).max() < 1e-2


# Rows


def _learned(
    z: FloatArray, camera: StereoCamera = CAMERA, frames: int = 50
) -> VerticalDisparityModel:
    rows = VerticalDisparityModel(camera)
    for k in range(frames):
        rows.update(observations(k, k, np.arange(len(z)), z))
    return rows


def test_rows_are_learned_among_mismatches() -> None:
    """200 frames of 100 matches, 0.3 px of noise, one match in five wrong by up to 20 px: the
    field to 0.02 px.
    """
    true, rng = np.array([2e-3, -3e-3, 1e-3, 4e-3, -2e-3, 3e-3, 6e-3]), np.random.default_rng(5)
    rows, grid = VerticalDisparityModel(CAMERA), _grid()

    def field(z: FloatArray, values: FloatArray = true) -> FloatArray:
        x, y = _rays(CAMERA, z[:, 2:])[:, :2].T
        d = (z[:, 0] - z[:, 2]) / CAMERA.fu
        return np.asarray(
            CAMERA.fv * np.stack([np.ones_like(x), x, y, x * y, x * x, y * y, d], axis=1) @ values
        )

    for k in range(200):
        u, v = rng.uniform([20, 20], [730, 460], (100, 2)).T
        z = np.stack([u, v, u - rng.uniform(2, 15, 100), v], axis=1)
        z[:, 3] += (
            field(z) + rng.normal(0, 0.3, 100) + (rng.random(100) < 0.2) * rng.uniform(-20, 20, 100)
        )
        rows.update(observations(k, k, np.arange(100), z))
    error = field(grid, rows.coefficients) - field(grid)
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert np.abs(field(grid)).max() > 1.0


def test_rows_without_what_both_lenses_do_to_near_points() -> None:
    """5e-3 of tangential distortion of both lenses bends the rows of near points; a turned right
    camera is left.
    """
    z, q2 = _grid(), 5e-3
    moved = _turned_right(z, CAMERA, np.array([0.0, 0.0, 1e-3]))
    left, right = (
        _distorted(_rays(CAMERA, moved[:, c]), (0.0, 0.0), (0.0, q2))
        for c in (slice(0, 2), slice(2, 4))
    )
    near = _learned(np.concatenate([left, right], axis=1))
    own = near.without_common(np.array([0, 0, 0, 0, 0, 0, 0, q2]))
    bare = _learned(moved).coefficients
    assert np.abs(near.coefficients - bare).max() > 2e-4
    assert np.abs(own - bare).max() < 5e-5
    numeric = numeric_jacobian(near.without_common, np.zeros(8))
    np.testing.assert_allclose(near.rows_D_common, -numeric[:, 4:], atol=1e-9)


def test_the_covariance_of_rows_covers_features_that_keep_their_error() -> None:
    """50 frames of the same 105 features, each with an error of its own of 0.3 px in all of
    them, 40 times.
    """
    z, rng, errors = _grid(), np.random.default_rng(7), []
    for _ in range(40):
        rows = _learned(z + rng.normal(0, 0.3, (len(z), 1)) * [0, 0, 0, 1])
        errors.append(rows.coefficients @ np.linalg.solve(rows.covariance, rows.coefficients))
    # chi-square with 7 degrees of freedom; 3.5 times the variance would give 2
    assert 4.1 < np.mean(errors) < 10.5


def test_rows_are_not_learned_from_few_matches_or_left_views() -> None:
    z = _grid()
    z[:, 3] += 2.0
    rows = VerticalDisparityModel(CAMERA)
    rows.update(observations(0, 0, np.arange(29), z[:29]))
    seen = observations(1, 1, np.arange(len(z)), z)
    rows.update(replace(seen, has_right=np.zeros(len(z), dtype=np.bool_)))
    np.testing.assert_array_equal(rows.coefficients, 0.0)


# Elimination


def _tracks() -> tuple[FloatArray, Views]:
    """Points (n, 3) and noisy views of them; some without right view, some not seen."""
    rng, n = np.random.default_rng(4), 6
    p_cam = rng.uniform([-1.0, -0.8, 3.0], [1.0, 0.8, 6.0], (n, 3))
    p = transform_points(se3_inverse(T_CAM0_WORLD[0]), p_cam)
    z = np.array([[project(CAMERA, transform_points(T, q)) for T in T_CAM0_WORLD] for q in p])
    weight = np.tile([1.0, 1.0, 1.0, 0.0], (n, CLONES, 1))
    weight[0, :, 2] = 0.0
    weight[1, 0] = 0.0
    weight[2, 2, 2] = 0.0
    return p, Views(z + rng.normal(0, 0.3, z.shape), weight)


def _linear() -> tuple[
    FloatArray, Residuals, TrackInformation, StereoColumns, FloatArray, FloatArray
]:
    p, views = _tracks()
    p = refine_points(CAMERA, T_CAM0_WORLD, p, views, 3, 10.0)
    at = residuals(CAMERA, T_CAM0_WORLD, p, views)
    weight = np.random.default_rng(8).uniform(0.3, 1.0, (len(p), CLONES))
    info = track_information(CAMERA, T_CAM0_WORLD, at, p, weight)
    wanted, z = ErrorColumns(CAMERA), views.z - at.r
    return p, at, info, stereo_columns(wanted, at, z, weight), wanted.jacobian(z), weight


def test_elimination_equals_the_schur_complement_with_the_coefficients_as_columns() -> None:
    """Dense normal equations in clones, coefficients and points, with the prior (M6) on each
    point's disparity.
    """
    p, at, info, columns, H, weight = _linear()
    F, clones, S = len(p), 6 * CLONES, TERMS
    first = clones + S  # of the points
    N, b = np.zeros((first + 3 * F, first + 3 * F)), np.zeros(first + 3 * F)
    chosen = np.arange(F) != 3
    for f in np.flatnonzero(chosen):
        B = point_D_pose(p[f : f + 1])[0]
        for n in range(CLONES):
            J = at.z_D_p[f, n]
            row = np.zeros((4, len(b)))
            row[:, 6 * n : 6 * n + 6], row[:, first + 3 * f : first + 3 * f + 3] = J @ B, J
            row[:, clones:first] = H[f, n] * np.any(J, axis=1)[:, None]
            N += weight[f, n] * row.T @ row
            b += weight[f, n] * row.T @ at.r[f, n]
            if n == info.q.anchor[f]:
                row = np.zeros((1, len(b)))
                row[0, 6 * n : 6 * n + 6] = info.q.q_D_p[f, 2] @ B
                row[0, first + 3 * f : first + 3 * f + 3] = info.q.q_D_p[f, 2]
                N += _TRIANGULATION.disparity_information * row.T @ row
    points = np.flatnonzero(np.diag(N) > 0)
    points = points[points >= first]
    K = np.linalg.solve(N[np.ix_(points, points)], N[points, :first]).T
    A, g = N[:first, :first] - K @ N[points, :first], b[:first] - K @ b[points]

    found, vector = eliminate_points(info, chosen, columns)
    scale = np.sqrt(np.abs(np.outer(np.diag(N)[:first], np.diag(N)[:first])))
    np.testing.assert_allclose(found / scale, A / scale, atol=1e-9)
    np.testing.assert_allclose(vector, g, rtol=1e-6, atol=1e-6)
    assert np.abs(found[clones:, :clones]).max() > 1.0


def test_points_follow_the_coefficients_as_their_triangulation_does() -> None:
    p, weight = _tracks()[0][:1], np.tile([1.0, 1.0, 1.0, 0.0], (1, CLONES, 1))
    z = np.array([[project(CAMERA, transform_points(T, p[0])) for T in T_CAM0_WORLD]])
    at = residuals(CAMERA, T_CAM0_WORLD, p, Views(z, weight))
    info = track_information(CAMERA, T_CAM0_WORLD, at, p, np.ones((1, CLONES)))
    columns = stereo_columns(ErrorColumns(CAMERA), at, z, np.ones((1, CLONES)))
    eliminate_points(info, np.ones(1, dtype=np.bool_), columns)

    def triangulated(s: FloatArray) -> FloatArray:
        field = StereoCorrection(CAMERA, np.zeros(7), s, np.arange(TERMS))
        return refine_points(CAMERA, T_CAM0_WORLD, p, field.corrected(Views(z, weight)), 10, 1e6)[0]

    numeric = numeric_jacobian(triangulated, np.zeros(TERMS), eps=1e-6)
    np.testing.assert_allclose(
        columns.point_D_stereo(info, np.arange(1))[0], numeric, atol=1e-4 * np.abs(numeric).max()
    )


# Runs

ON = replace(SETTINGS, calibrate_stereo="on")
TURN = np.radians(0.1)
STRAIGHT = Course(
    20, 5.0, velocity=(0.5, 0.3, 0.0), depth=(3.0, 12.0), pixel_sigma_px=0.3, features=100
)
ROUND = replace(STRAIGHT, velocity=(0.4, 0.5, 0.0), yaw_rate=0.2)


def _turn(angle: float) -> Spoil:
    """Turn the right camera of the exact world about its vertical axis."""

    def spoil(k: int, seen: Observations) -> Observations:
        return replace(
            seen, z=_turned_right(seen.z, test_filter_truth.CAMERA, np.array([0.0, angle, 0.0]))
        )

    return spoil


def _field(run: Run, k: int = -1) -> tuple[FloatArray, FloatArray]:
    """Coefficients (8,) and their standard deviations (8,) at a frame."""
    field = run.estimates[k].stereo_field
    return field.coefficients, np.sqrt(np.diag(field.covariance))


@cache
def _with_a_calibrated_rig(course: Course, motion: MotionSource | None, seed: int = 0) -> Run:
    """Fly once for all tests."""
    return fly(course, motion, ON, seed)


def _rms_m(run: Run) -> float:
    return float(
        np.sqrt(np.mean([np.sum(run.error(k)[:3] ** 2) for k in range(run.course.frames)]))
    )


@pytest.mark.slow
@pytest.mark.parametrize("motion", [None, "imu"])
def test_a_turned_right_camera_is_found_and_its_harm_undone(motion: MotionSource | None) -> None:
    """0.1 deg about the vertical axis: 0.8 px of disparity, which without calibration costs 3 %
    of the way.
    """
    level = _with_a_calibrated_rig(STRAIGHT, motion)
    turned = fly(STRAIGHT, motion, ON, spoil=_turn(TURN))
    ignored = fly(STRAIGHT, motion, replace(SETTINGS, calibrate_stereo="off"), spoil=_turn(TURN))
    found, sigma = _field(turned)
    assert abs(found[0] - TURN) < 3 * sigma[0]
    assert found[0] > 10 * sigma[0]
    assert _rms_m(turned) < 2 * _rms_m(level)
    assert _rms_m(turned) < 0.2 * _rms_m(ignored)


def test_a_right_camera_that_is_moved_in_flight_is_found_again() -> None:
    """By a pitch and a yaw of 0.6 deg after three frames: the rows that are off put the columns
    in doubt again.
    """
    turn = np.radians(0.6)

    def spoil(k: int, seen: Observations) -> Observations:
        moved = _turned_right(seen.z, test_filter_truth.CAMERA, np.array([turn, turn, 0.0]))
        return seen if k < 3 else replace(seen, z=moved)

    found, sigma = _field(fly(replace(STRAIGHT, seconds=0.5), None, ON, spoil=spoil))
    assert abs(found[0] - turn) < 3 * sigma[0]
    assert sigma[0] < 0.1 * turn


def test_no_landmark_enters_while_the_field_is_estimated() -> None:
    """Held at one linearisation, landmarks made the field too sure: 36 where 33 is the 0.999
    quantile, 5 without.
    """
    total = 0.0
    for seed in range(2):
        run = fly(replace(ROUND, seconds=3.0), "imu", ON, seed, spoil=_turn(TURN))
        assert not any(len(report.landmark_ids) for report in run.reports)
        field = run.estimates[-1].stereo_field
        total += test_filter_truth.squared(
            field.coefficients - TURN * np.eye(8)[[0, 2]].sum(axis=0), field.covariance
        )
    assert total < chi2.ppf(0.999, 16)


def _scaled(baseline: float, focal: float) -> Spoil:
    """What a pair sees whose baseline and focal length differ from the calibration by factors."""
    field = StereoCorrection(
        test_filter_truth.CAMERA,
        np.zeros(7),
        np.concatenate([np.zeros(8), np.log([baseline, focal])]),
        np.array([8, 9]),
    )

    def spoil(k: int, seen: Observations) -> Observations:
        return replace(seen, z=field.seen(seen.z))

    return spoil


def test_a_focal_length_that_is_off_by_5_percent_is_found() -> None:
    """The gyro tells how far the rig turned, and pixels how far the points went."""
    settings = replace(
        SETTINGS, calibrate_scale="on", stereo_baseline_sigma=0.0, stereo_focal_sigma=0.005
    )
    off, right = fly(ROUND, "imu", settings, spoil=_scaled(1.0, 1.05)), fly(ROUND, "imu", settings)
    for run, true in ((off, 5.0), (right, 0.0)):
        scale = run.estimates[-1].stereo_scale
        percent, sigma = scale.percent()["focal length"]
        assert abs(percent - true) < 3 * sigma
        assert sigma < 0.3
    assert _rms_m(off) < 0.008 < 3 * _rms_m(right)  # m


def test_distortion_of_both_lenses_is_no_focal_length() -> None:
    """Of near points it bends the rows; as the right camera's own, -0.03 made 1.95 +- 0.40 % of
    focal length.
    """
    c = test_filter_truth.CAMERA
    lens = CameraModel(c.fu, c.fv, c.cu, c.cv, 752, 480, "radtan", (-0.015, 0.0, 0.0, 0.0))

    def bent(k: int, seen: Observations) -> Observations:
        left, right = (
            project_point(lens, _rays(c, seen.z[:, s]))[0] for s in (slice(0, 2), slice(2, 4))
        )
        return replace(seen, z=np.concatenate([left, right], axis=1))

    run = fly(
        replace(ROUND, depth=(1.5, 8.0)),
        "imu",
        replace(ON, calibrate_scale="on", stereo_baseline_sigma=0.0, stereo_focal_sigma=0.05),
        spoil=bent,
    )
    scale = run.estimates[-1].stereo_scale
    percent, sigma = scale.percent()["focal length"]
    assert abs(percent) < 3 * sigma
    assert sigma < 0.6
    found, sigmas = _field(run)
    assert abs(found[4] + 0.015) < 3 * sigmas[4]


@pytest.mark.parametrize("motion", [None, "imu"])
def test_images_alone_say_nothing_of_the_scale(motion: MotionSource | None) -> None:
    run = fly(
        replace(ROUND, seconds=0.2),
        motion,
        replace(
            SETTINGS, calibrate_scale="on", stereo_baseline_sigma=0.0, stereo_focal_sigma=0.005
        ),
    )
    assert (run.estimates[-1].stereo_scale is None) == (motion is None)
    assert fly(replace(ROUND, seconds=0.2), motion, SETTINGS).estimates[-1].stereo_scale is None


@pytest.mark.slow
@pytest.mark.parametrize("course", [STRAIGHT, ROUND], ids=["straight", "round"])
def test_a_calibrated_rig_stays_calibrated(course: Course) -> None:
    """All coefficients within three standard deviations of zero.

    Linearised at the pixels that were seen, whose noise the residuals share, radial distortion
    ended 42 of them off.
    """
    for seed in range(2):
        found, sigma = _field(_with_a_calibrated_rig(course, None, seed))
        assert np.all(np.abs(found) < 3 * sigma)


@pytest.fixture(scope="module", params=[None, "imu"])
def still(request: pytest.FixtureRequest) -> Run:
    """Five seconds without motion."""
    return fly(replace(STRAIGHT, velocity=(0.0, 0.0, 0.0)), request.param, ON)


def test_standstill_tells_nothing_of_the_lenses_and_shifts_no_coefficient(still: Run) -> None:
    (_, before), (found, sigma) = _field(still, 0), _field(still)
    assert np.all(sigma[4:] > 0.98 * before[4:])
    assert np.all(np.abs(found) < 3 * sigma)


@pytest.mark.xfail(reason="known fault: the scatter of the estimated poses passes for parallax")
def test_standstill_tells_nothing_of_the_right_columns(still: Run) -> None:
    """Without motion every point has a depth that explains its disparity; a0 loses 22 to 24 % of
    its sigma in 5 s.

    Taking the field as known while the window rests cures it, but slow motion counts as rest then:
    images alone along V1_02 with `--realism real` came to 19 mm in place of 13 (means of three).
    """
    (_, before), (_, sigma) = _field(still, 0), _field(still)
    assert np.all(sigma[:4] > 0.98 * before[:4])
