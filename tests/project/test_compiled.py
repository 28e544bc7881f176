"""Compiled loops: against the same in NumPy, and their cache on disk."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core import types

from tests import numpy_twins
from tests.frontend.test_frontend_patches import PLAIN, POINTS, picture
from vio.cameras.projection import camera_args
from vio.cameras.rectification_error import ErrorColumns
from vio.datasets import png_rows
from vio.filters import gate_loops, multiview, pose_loops, stereo_calibration, track_loops
from vio.filters.imu_terms import ENTRIES
from vio.filters.landmark_gate import leave_one_out_nis
from vio.filters.track_records import (
    ErrorRows,
    Information,
    LandmarkResiduals,
    Residuals,
    RowEquations,
    Views,
)
from vio.frontend import outliers, patches
from vio.frontend.align import (
    align,
    cut_patches,
    offsets,
    rounded,
    shift_warps,
    templates,
    warped_patches,
)
from vio.frontend.outliers import _gauss_newton, _refine, pixel_errors
from vio.frontend.prediction import _borrowed, moved_pixels
from vio.frontend.stereo_fit import _match, _Matches, _RightColumns
from vio.frontend.weighted_fit import add_equations
from vio.geometry.lie import (
    FloatArray,
    circledot,
    se3_adjoint,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    so3_exp,
    so3_hat,
    so3_left_jacobian,
    transform_points,
)
from vio.geometry.stereo import StereoCamera, project, triangulate
from vio.guard import image_change
from vio.numerics.compiled import Loop, eigenvectors, invert_positive, move_by_twist, solve_positive
from vio.records import imu_matrices

CAMERA = StereoCamera(fu=300.0, fv=310.0, cu=150.0, cv=100.0, baseline_m=0.1)
CAMERAS = {"pinhole": CAMERA, "cylinder": replace(CAMERA, projection="cylinder")}
both_cameras = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)


def test_patches_are_sampled_exactly_inside_the_image_and_at_its_border() -> None:
    # the right border
    across = np.stack([np.arange(284.0, 302.0, 0.7), np.linspace(40.0, 160.0, 26)], axis=1)
    # the lower border
    down = np.stack([np.linspace(40.0, 260.0, 26), np.arange(184.0, 202.0, 0.7)], axis=1)
    outside = [[0.0, 0.0], [298.6, 198.9], [-9.0, 50.0], [150.0, 1e9], [7.0, 7.0]]
    warp = shift_warps(np.concatenate([POINTS, across, down, outside]))
    warp[:, :, :2] += np.random.default_rng(3).normal(0, 0.2, (len(warp), 2, 2))
    image = PLAIN
    np.testing.assert_allclose(
        warped_patches(image, warp, 7), numpy_twins.sampled(PLAIN, warp, offsets(7)), atol=2e-3
    )


def test_warp_that_is_not_finite_samples_the_border() -> None:
    warp = shift_warps(POINTS[:3])
    warp[0, 0, 0], warp[1, 1, 2], warp[2, 0, 2] = np.nan, np.inf, -np.inf
    assert np.isfinite(warped_patches(PLAIN, warp, 7)).all()


@pytest.mark.parametrize("on_rows", [False, True])
def test_alignment_equals_numpy(on_rows: bool) -> None:
    other = picture(
        np.array(
            [
                [1.04, 0.03, -4.0],
                [-0.02 * (not on_rows), 1 - 0.03 * (not on_rows), 0.3],
                [0, 0, 1.0],
            ]
        )
    )
    image, centres = PLAIN, rounded(POINTS)
    rows = POINTS[:, 1] - 0.2 if on_rows else None
    start = shift_warps(POINTS + np.array([3.0, -0.3]))
    wide = cut_patches(image, centres, 7)
    twin, expected = numpy_twins.aligned(
        numpy_twins.prepared(wide.astype(np.float64)), 7, other, start, 5, rows
    )
    warp, score = align(templates(wide), np.arange(len(POINTS)), other, start, 5, rows)
    inside = score > -1.0  # elsewhere the patch has left the image
    assert inside.mean() > 0.8
    np.testing.assert_allclose(score[inside], expected[inside], atol=1e-4)
    # The last step may be taken by one and not by the other: it is below a twentieth of a pixel
    # there.
    gap = np.abs(warp - twin)[inside].max(axis=(1, 2))
    assert np.quantile(gap, 0.9) < 1e-3
    assert gap.max() < 0.02


@both_cameras
@pytest.mark.parametrize("free", [slice(0, 6), slice(0, 3)])
def test_gauss_newton_on_motions_equals_numpy(free: slice, camera: StereoCamera) -> None:
    """One of the points goes behind the camera, one has no weight, and one set of three is
    degenerate.
    """
    rng = np.random.default_rng(7)
    T = se3_exp(rng.normal(0, 0.1, (20, 6)))
    points = rng.uniform([-2, -2, 2], [2, 2, 8], (20, 3, 3))
    points[0, 0, 2], points[1] = -1.0, points[1, 0]
    pixels = rng.uniform([0, 0], [300, 200], (20, 3, 2))
    weight = rng.uniform(0, 1, (20, 3))
    weight[2, 1] = 0.0
    ours = _gauss_newton(camera, T, points, pixels, weight, steps=2, free=free)
    twin = numpy_twins.gauss_newton(camera, T, points, pixels, weight, steps=2, free=free)
    np.testing.assert_allclose(ours, twin, rtol=1e-6, atol=1e-6)


@both_cameras
def test_refinement_of_a_motion_equals_numpy(camera: StereoCamera) -> None:
    rng = np.random.default_rng(12)
    true, points = (
        se3_exp([0.1, 0.05, -0.2, 0.01, 0.02, -0.01]),
        rng.uniform([-2, -1, 3], [2, 1, 9], (60, 3)),
    )
    pixels = project(camera, transform_points(true, points))[:, :2] + rng.normal(0, 0.3, (60, 2))
    pixels[::5] += 40.0  # on something that moves
    ours = _refine(camera, np.eye(4), points, pixels, 60.0, slice(0, 6))
    twin = numpy_twins.refined_motion(camera, np.eye(4), points, pixels, 60.0, 3e-6)
    np.testing.assert_allclose(ours, twin, atol=1e-9)
    close = _refine(camera, ours, points, pixels, 5.0, slice(0, 6))
    np.testing.assert_allclose(
        close, numpy_twins.refined_motion(camera, ours, points, pixels, 5.0, 3e-6), atol=1e-9
    )
    assert np.abs(ours - np.eye(4)).max() > 0.05  # from both starts it moves
    assert np.abs(close - ours).max() > 0.01


@pytest.mark.parametrize("sigma", [0.5, np.inf])
def test_weighted_equations_equal_numpy(sigma: float) -> None:
    rng = np.random.default_rng(13)
    terms, model, start = rng.normal(size=(40, 5)), rng.normal(size=5), rng.normal(size=(5, 5))
    values = terms @ model + rng.normal(0, 1.0, 40)
    normal, moment = start.copy(), start[0].copy()
    count, squares = add_equations(terms, values, model, sigma, normal, moment)
    expected = numpy_twins.equations(terms, values, model, sigma)
    np.testing.assert_allclose(normal, start + expected[0], rtol=1e-10)
    np.testing.assert_allclose(moment, start[0] + expected[1], rtol=1e-10)
    np.testing.assert_allclose((count, squares), expected[2:], rtol=1e-10)


@both_cameras
def test_reprojection_errors_equal_numpy(camera: StereoCamera) -> None:
    rng = np.random.default_rng(8)
    T, points = (
        se3_exp(rng.normal(0, 0.3, (2, 5, 6))),
        rng.uniform([-2, -2, -1], [2, 2, 8], (30, 3)),
    )
    pixels = rng.uniform([0, 0], [300, 200], (30, 2))
    # too near to the line of the baseline
    points[0] = transform_points(se3_inverse(T[0, 0]), [0.3, 0.02, -0.01])
    expected = numpy_twins.moved_errors(camera, T, points, pixels)
    assert 0 < np.isinf(expected).sum() < 100
    np.testing.assert_allclose(pixel_errors(camera, T, points, pixels), expected, rtol=1e-10)
    np.testing.assert_allclose(
        pixel_errors(camera, T[0, 1], points, pixels), expected[0, 1], rtol=1e-10
    )


@both_cameras
def test_features_are_moved_and_triangulated_as_single_points_are_in_numpy(
    camera: StereoCamera,
) -> None:
    rng = np.random.default_rng(14)
    T, points = (
        se3_exp([0.1, -0.2, 0.3, 0.05, 0.1, -0.1]),
        rng.uniform([-2, -1, 2], [2, 1, 9], (40, 3)),
    )
    moved = transform_points(T, points)
    pixels = moved_pixels(camera, T, points, np.zeros((40, 2)))
    np.testing.assert_allclose(pixels, project(camera, moved)[:, :2], rtol=1e-10)

    z = project(camera, moved) + rng.normal(0, 0.3, (40, 4))
    z[3, 2], z[5, 2] = z[3, 0] - 0.05, z[5, 0] + 4.0  # too far away, and behind the cameras
    rows, point, has_point = np.arange(0, 40, 2), np.zeros((40, 3)), np.zeros(40, dtype=np.bool_)
    rows[1], rows[2] = 3, 5
    f_baseline = camera.fu * camera.baseline_m
    good, skew, right = (
        np.ones(20, dtype=np.bool_),
        np.arange(80.0).reshape(20, 2, 2),
        np.zeros((40, 2)),
    )
    good[5] = False
    skews, has_right, left = np.zeros((40, 2, 2)), np.zeros(40, dtype=np.bool_), z[:, :2].copy()
    columns = _RightColumns(right, has_right, skews, point, has_point)
    matches = _Matches(z[rows, 2:].copy(), skew, good)
    _match(camera_args(camera), f_baseline, left, rows, matches, columns)
    matched = rows[good]
    assert has_right.nonzero()[0].tolist() == sorted(matched.tolist())
    np.testing.assert_array_equal(right[matched], z[matched, 2:])
    np.testing.assert_array_equal(skews[matched], skew[good])
    rows = matched
    expected, valid = triangulate(camera, z[rows])
    assert not valid[1:3].any()
    np.testing.assert_array_equal(has_point[rows], valid)
    np.testing.assert_allclose(point[rows[valid]], expected[valid], rtol=1e-10)
    assert not point[~has_point].any()


def test_unknown_depths_are_the_median_of_the_three_nearest_known_ones() -> None:
    rng = np.random.default_rng(15)
    known, depth, pixels = (
        rng.uniform(0, 300, (50, 2)),
        rng.uniform(1, 9, 50),
        rng.uniform(0, 300, (20, 2)),
    )
    together, has_point = np.concatenate([pixels, known]), np.arange(70) >= 20
    depths = np.concatenate([np.full(20, np.nan), depth])
    found = [_borrowed(together, depths, has_point, n) for n in range(20)]
    nearest = np.argsort(np.abs(pixels[:, None] - known).sum(axis=2), axis=1)[:, :3]
    np.testing.assert_array_equal(found, np.median(depth[nearest], axis=1))


def test_no_loop_is_compiled_for_one_number_alone() -> None:
    """numba compiles a function anew for a whole number that another compiled function writes
    out as its argument.
    """
    raw = np.zeros((40, 31), dtype=np.uint8)
    png_rows.unfilter(raw, np.zeros((40, 30), dtype=np.uint8))
    assert image_change.image_change(PLAIN, PLAIN) == 0.0
    p = np.random.default_rng(16).uniform([-1, -1, 3], [1, 1, 9], (20, 3))
    _refine(CAMERA, np.eye(4), p, project(CAMERA, p)[:, :2], 1.0, slice(0, 6))
    loops = [
        f for module in (outliers, patches, png_rows, image_change) for f in vars(module).values()
    ]
    signatures = [s for f in loops if isinstance(f, Loop) for s in f.by_numba.signatures]
    assert signatures
    assert not [s for s in signatures if any(isinstance(part, types.Literal) for part in s)]


@pytest.mark.parametrize("size", [1e-9, 5e-3, 0.3, 3.0])
def test_move_by_twist_equals_the_exponential(size: float) -> None:
    rng = np.random.default_rng(9)
    xi, T = size * rng.normal(size=6), se3_exp(rng.normal(size=6))
    expected = se3_exp(xi) @ T
    move_by_twist(xi, T)
    np.testing.assert_allclose(T, expected, atol=1e-14)


def test_small_positive_systems_are_solved_and_inverted() -> None:
    J = np.random.default_rng(10).normal(size=(9, 6))
    A, b, inverse = J.T @ J, np.arange(6.0), np.zeros((6, 6))
    invert_positive(A, inverse)
    np.testing.assert_allclose(inverse @ A, np.eye(6), atol=1e-12)
    expected = np.linalg.solve(A, b)
    solve_positive(np.tril(A), b)
    np.testing.assert_allclose(b, expected, rtol=1e-10)


def _scene(camera: StereoCamera = CAMERA) -> tuple[FloatArray, FloatArray, Views]:
    """Forty points in five cameras, some of them unseen, without a right view, or (but of a
    cylinder) behind one.
    """
    rng = np.random.default_rng(11)
    T = se3_exp(np.cumsum(rng.normal(0, 0.1, (5, 6)), axis=0))
    p = rng.uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 6.0], (40, 3))
    p[0, 2] = -3.0
    if camera.is_cylinder:
        p[1:20, 1:] *= [3.0, -1.0]
        # nearly on the line of a baseline
        p[0] = transform_points(se3_inverse(T[1]), [0.5, 0.01, 0.0])
    z = np.stack([project(camera, transform_points(T_i, p)) for T_i in T], axis=1) + rng.normal(
        0, 0.5, (40, 5, 4)
    )
    weight = np.zeros((40, 5, 4))
    seen = rng.uniform(size=(40, 5)) < 0.8
    seen[:, 1] = True
    weight[seen] = [1.0, 1.0, 1.0, 0.0]
    weight[rng.uniform(size=(40, 5)) < 0.3, 2] = 0.0
    weight *= rng.uniform(0.3, 3.0, weight.shape)
    return T, p, Views(z, weight)


def _same(ours: Any, twin: Any) -> None:
    """Compare the arrays of two records."""
    for name in ours._fields:
        a, b = getattr(ours, name), getattr(twin, name)
        if isinstance(a, tuple):
            _same(a, b)
        else:
            np.testing.assert_allclose(
                a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max(initial=0.0), err_msg=name
            )


@both_cameras
def test_tracks_are_linearised_and_eliminated_as_in_numpy(camera: StereoCamera) -> None:
    T, p, views = _scene(camera)
    at = multiview.residuals(camera, T, p, views)
    _same(at, numpy_twins.residuals(camera, T, p, views))
    assert not at.ahead.all()
    at, p = at.take(at.ahead), p[at.ahead]
    weight = np.random.default_rng(12).uniform(0.1, 1.0, at.r.shape[:2])
    ours = multiview.track_information(camera, T, at, p, weight)
    _same(ours, numpy_twins.track_information(camera, T, at, p, weight))
    chosen = np.arange(len(p)) % 3 > 0
    found, expected = (
        stereo_calibration.eliminate_points(ours, chosen),
        numpy_twins.eliminate_points(ours, chosen),
    )
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9 * np.abs(b).max())


@both_cameras
def test_points_are_refined_chosen_and_weighed_as_in_numpy(camera: StereoCamera) -> None:
    T, p, views = _scene(camera)
    views.weight[5:15, :, 2] = 0.0
    views.weight[5:8, 2:, :2] = 0.0  # two views at most: little parallax
    start = p + np.random.default_rng(14).normal(0, 0.2, p.shape)
    start[3] = transform_points(se3_inverse(T[1]), [0.0, 0.0, 1e-3])
    ours = multiview.refine_points(camera, T, start, views, 3, 1.0)
    np.testing.assert_allclose(
        ours, numpy_twins.refined(camera, T, start, views, 3, 1.0), rtol=1e-6
    )
    ours[20] = np.nan
    for lens in (camera, replace(camera, kind="mono")):
        at = multiview.residuals(lens, T, ours, views)
        moved, there, _ = multiview.linearised_points(lens, T, start, views, 3, 1.0)
        np.testing.assert_array_equal(moved, multiview.refine_points(lens, T, start, views, 3, 1.0))
        _same(there, multiview.residuals(lens, T, moved, views))
        keep = multiview.linearised_points(lens, T, ours, views, 0, 1.0)[2]
        assert keep.tolist() == numpy_twins.usable_points(lens, T, ours, views, at).tolist()
        assert 0 < keep.sum() < len(keep)
    at = at.take(keep)
    at.z_D_p[:, 3] = 0.0  # a clone that saw nothing
    for sigma2 in (1e-6, 1.0):
        np.testing.assert_allclose(
            multiview.robust_weights(at, sigma2), numpy_twins.robust_weights(at, sigma2)
        )


def test_points_follow_the_clones_as_in_numpy() -> None:
    T, p, views = _scene()
    at = multiview.residuals(CAMERA, T, p, views)
    at, p = at.take(at.ahead), p[at.ahead]
    info = multiview.track_information(CAMERA, T, at, p, np.ones(at.r.shape[:2]))
    rng = np.random.default_rng(15)
    errors, other = rng.normal(0, 1e-3, 6 * len(T)), rng.normal(0, 1.0, (len(p), 3))
    np.testing.assert_allclose(
        info.moved_points(errors, other), numpy_twins.moved_points(info, errors, other)
    )


@pytest.mark.parametrize("count", [1, 2, 3, 10, 101])
def test_middle_is_the_median(count: int) -> None:
    values = np.random.default_rng(count).integers(0, 12, count).astype(np.float64)  # with ties
    assert track_loops.middle(values.copy()) == np.median(values)


def test_landmarks_are_added_as_in_numpy() -> None:
    rng = np.random.default_rng(16)
    r, J, w = rng.normal(size=(7, 4)), rng.normal(size=(7, 4, 3)), rng.uniform(size=7)
    by_terms, precision = rng.normal(size=(7, 4, 5)), rng.uniform(0.5, 2.0, (7, 4))
    J[2, 1] = r[2, 1] = 0.0  # not measured
    A, b, considered = np.zeros((33, 33)), np.zeros(33), np.zeros((33, 2))
    seen = LandmarkResiduals(r, J, w, precision)
    rows = ErrorRows(exposure=6, landmarks=12, stereo=3)
    track_loops.add_landmarks(seen, by_terms, rows, Information(A, b, considered))
    H = np.zeros((7, 4, 35))
    for k in range(7):
        H[k, :, 12 + 3 * k : 15 + 3 * k], H[k, :, 6:9] = J[k], -J[k]
    measured = (precision * np.any(J, axis=2))[..., None]
    H[..., 3:6], H[..., 33:] = by_terms[..., :3] * measured, by_terms[..., 3:] * measured
    joint = np.einsum("k,kai,kaj->ij", w, H, H)
    np.testing.assert_allclose(A, joint[:33, :33], atol=1e-12)
    np.testing.assert_allclose(considered, joint[:33, 33:], atol=1e-12)
    np.testing.assert_allclose(b, np.einsum("k,kai,ka->i", w, H, r)[:33], atol=1e-12)


def test_poses_and_velocities_move_as_in_numpy() -> None:
    rng = np.random.default_rng(17)
    T, T_cam0_imu, now = (
        se3_exp(rng.normal(size=(5, 6))),
        se3_exp(rng.normal(size=6)),
        se3_exp(rng.normal(size=6)),
    )
    eta, error, gravity = rng.normal(size=6), 0.1 * rng.normal(size=30), np.array([0.0, 0.0, -9.8])
    cameras, moves = np.empty(T.shape), np.zeros((5, 6))
    pose_loops.camera_poses(T_cam0_imu, T, cameras)
    np.testing.assert_allclose(cameras, T_cam0_imu @ se3_inverse(T), atol=1e-14)
    pose_loops.add_extrinsic_moves(T, now, eta, moves)
    np.testing.assert_allclose(moves, se3_adjoint(T @ se3_inverse(now)) @ eta, atol=1e-13)
    for size in (1e-4, 1.0):
        phi, xi, p = size * rng.normal(size=3), rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
        expected = p @ so3_exp(phi).T + xi @ so3_left_jacobian(phi).T
        pose_loops.move_points(phi, xi, p)
        np.testing.assert_allclose(p, expected, atol=1e-14)
    ages, velocities = np.arange(5) * 0.05, rng.normal(size=(5, 3))
    R = np.ascontiguousarray(T[:, :3, :3])
    for entries in (ENTRIES[:0], ENTRIES):
        moved = velocities.copy()
        pose_loops.move_earlier_velocities(
            gravity, ages, R, error[: 15 + len(entries)], entries, moved
        )
        expected = numpy_twins.moved_velocities(gravity, ages, R, error, velocities, entries)
        np.testing.assert_allclose(moved, expected, atol=1e-13)
    rows, part = np.array([0, 2, 3]), np.empty((3, 3))
    pose_loops.take_rows(cameras[0], rows, part)
    np.testing.assert_array_equal(part, cameras[0][np.ix_(rows, rows)])


def test_missing_samples_are_found() -> None:
    t = np.cumsum(np.random.default_rng(18).uniform(0.5, 1.5, 9))
    inside, longest = np.linspace(t[0], t[-1], 7), np.diff(t).max()
    assert not pose_loops.lacks_samples(inside, t, longest)
    assert pose_loops.lacks_samples(inside, t, longest - 1e-9)
    assert pose_loops.lacks_samples(inside, t[1:], longest)
    assert pose_loops.lacks_samples(inside, t[:-1], longest)


def test_the_imu_is_integrated_as_in_numpy() -> None:
    rng = np.random.default_rng(19)
    times = np.cumsum(rng.uniform(2e6, 8e6, 12))
    readings, bias, gravity = (
        rng.normal(size=(12, 6)),
        0.1 * rng.normal(size=6),
        np.array([0.0, 0.0, -9.8]),
    )
    densities, hidden = np.array([0.02, 0.003]), rng.uniform(0, 1e-4, (2, 11))
    T, v, turned = se3_exp(rng.normal(size=6)), rng.normal(size=3), np.zeros(3)
    given = times - times[0], readings, bias, gravity, densities, hidden
    R_k, p_k, v_k, biases, noise = numpy_twins.integrated(*given, T, v)
    Phi, Q, summed, walks = (
        np.eye(15),
        np.zeros((2, 15, 15)),
        np.empty((15, 15)),
        np.array([1e-4, 2e-3]),
    )
    levers = rng.normal(size=(12, 6))
    columns = np.zeros((15, 15))
    pose_loops.integrate(
        *given[:4],
        pose_loops.ImuNoise(densities, walks, hidden),
        pose_loops.TermColumns(levers, ENTRIES, columns),
        pose_loops.ImuStep(T, v, turned, Phi, Q, summed),
    )
    expected = numpy_twins.term_columns(given[0], levers, R_k, p_k, v_k, gravity)
    np.testing.assert_allclose(columns[:9], expected, atol=1e-13)
    assert not columns[9:].any()
    np.testing.assert_allclose(T, se3_from_parts(R_k[-1], p_k[-1]), atol=1e-13)
    np.testing.assert_allclose(v, v_k[-1], atol=1e-13)
    gyro = readings[:, :3] - bias[:3]
    np.testing.assert_allclose(
        turned, np.diff(times) * 1e-9 @ (gyro[1:] + gyro[:-1]) / 2, atol=1e-14
    )
    np.testing.assert_allclose(Phi[:9, 9:], biases, atol=1e-13)
    np.testing.assert_allclose(Q[:, :9, :9], noise, rtol=1e-9, atol=1e-16)
    assert not Q[:, 9:].any()
    assert not Q[:, :, 9:].any()
    seconds = 1e-9 * (times[-1] - times[0])
    np.testing.assert_allclose(
        Phi[:9, :9], numpy_twins.free_flow(np.array([seconds]), gravity)[0], rtol=1e-12
    )
    walked = np.diag(np.concatenate([np.zeros(9), np.repeat(walks**2 * seconds, 3)]))
    np.testing.assert_allclose(summed, Q[0] + Q[1] + walked, rtol=1e-12)
    cuts, found = (
        np.sort(np.append(rng.uniform(times[0] - 5e6, times[-1] + 5e6, 20), times[3])),
        np.empty((21, 6)),
    )
    pose_loops.interpolate(cuts, times, readings, found)
    np.testing.assert_array_equal(
        found, np.stack([np.interp(cuts, times, column) for column in readings.T], axis=1)
    )


def test_readings_are_calibrated_as_in_numpy() -> None:
    rng = np.random.default_rng(23)
    raw = rng.normal(size=(7, 6))
    terms = rng.normal(0.0, 0.1, len(ENTRIES))
    found = np.empty_like(raw)
    pose_loops.calibrate(raw, ENTRIES, terms, found)
    np.testing.assert_allclose(found, numpy_twins.calibrated(raw, terms), rtol=1e-13)
    M_gyro = imu_matrices(terms)[1]
    D = np.empty((3, len(ENTRIES)))
    pose_loops.write_terms_of_rate(M_gyro, raw[0, :3], ENTRIES, D)
    np.testing.assert_allclose(
        D, numpy_twins.gyro_D_terms(np.linalg.solve(M_gyro, raw[0, :3])), rtol=1e-12, atol=1e-14
    )


def test_small_symmetric_matrices_are_made_diagonal() -> None:
    rng = np.random.default_rng(31)
    for n in (1, 2, 3, 4, 6):
        root = rng.normal(size=(n, n))
        A, V = root @ np.diag(10.0 ** rng.uniform(-6, 6, n)) @ root.T, np.empty((n, n))
        found = A.copy()
        eigenvectors(found, V)
        np.testing.assert_allclose(
            V @ np.diag(found.diagonal()) @ V.T, A, atol=1e-13 * np.abs(A).max()
        )
        np.testing.assert_allclose(V.T @ V, np.eye(n), atol=1e-13)
        np.testing.assert_allclose(
            np.sort(found.diagonal()), np.linalg.eigvalsh(A), atol=1e-13 * np.abs(A).max()
        )


def test_corrections_and_landmarks_are_tested_as_in_numpy() -> None:
    rng = np.random.default_rng(32)
    root = rng.normal(size=(3, 6, 6))
    remaining, process, more = root @ np.swapaxes(root, 1, 2)
    expected, correction = remaining + 3 * process + more, rng.normal(size=6)
    for first in (0, 3):
        found = gate_loops.whiten_correction(correction, expected, process, remaining, first, 0.3)
        twin = numpy_twins.whitened_correction(
            correction, expected, process, remaining, slice(first, first + 3), 0.3
        )
        np.testing.assert_allclose(found, twin, rtol=1e-6)
    assert np.isnan(
        gate_loops.whiten_correction(
            correction, np.diag([9.0, 1, -1, 1, 1, 1]), process, remaining, 0, 0.3
        )[0]
    )
    assert gate_loops.whiten_correction(
        correction, np.zeros((6, 6)), process, remaining, 0, 0.3
    ) == (0.0, 0, 0.0)
    r, J, root = (
        rng.normal(size=(9, 4)),
        20 * rng.normal(size=(9, 4, 5)),
        0.01 * rng.normal(size=(9, 5, 5)),
    )
    weight, covariance = rng.uniform(0, 1, 9), root @ np.swapaxes(root, 1, 2)
    np.testing.assert_allclose(
        leave_one_out_nis(r, J, covariance, weight, 0.3),
        numpy_twins.leave_one_out_nis(r, J, covariance, weight, 0.3),
        rtol=1e-9,
    )


def test_errors_are_added_to_a_covariance_as_in_numpy() -> None:
    rng = np.random.default_rng(33)
    root = rng.normal(size=(20, 20))
    P, J, noise, at = (
        root @ root.T,
        rng.normal(size=(6, 9)) * (rng.uniform(size=(6, 9)) > 0.4),
        np.eye(6),
        12,
    )
    M = np.insert(np.eye(20), [at] * 6, np.pad(J, ((0, 0), (0, 11))), axis=0)
    expected, found = M @ P @ M.T, np.empty((26, 26))
    expected[at : at + 6, at : at + 6] += noise
    pose_loops.insert_rows(P, at, J, noise, found)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    A, blocks, found = (
        rng.normal(size=(6, 20)),
        np.stack([np.eye(3), 2 * np.eye(3)]),
        np.empty((26, 26)),
    )
    pose_loops.append_rows(P, A @ P, A, blocks, found)
    M = np.concatenate([np.eye(20), A])
    expected = M @ P @ M.T
    expected[20:, 20:] += np.diag([1.0, 1, 1, 2, 2, 2])
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


def test_information_and_covariances_find_their_places() -> None:
    rng = np.random.default_rng(35)
    size, estimated, considered, clones, stereo, D = 12, 3, 2, 8, 4, 26
    b = rng.normal(size=size + estimated + considered)
    root = rng.normal(size=(len(b), len(b)))
    A = root @ root.T
    own = np.concatenate([clones + np.arange(size), stereo + np.arange(estimated)])
    out, vector, by_considered = np.ones((D, D)), np.ones(D), np.ones((D, considered))
    information = Information(out, vector, by_considered)
    track_loops.place_information(A, b, 0.3, size, clones, stereo, information)
    expected, last = np.zeros((D, D)), len(own)
    expected[np.ix_(own, own)] = A[:last, :last] / 0.3
    np.testing.assert_array_equal(out, expected)
    np.testing.assert_array_equal(vector[own], b[:last] / 0.3)
    np.testing.assert_array_equal(by_considered[own], A[:last, last:] / 0.3)
    assert not np.delete(vector, own).any()
    assert not np.delete(by_considered, own, axis=0).any()
    P, J, found = np.cov(rng.normal(size=(D, 40))), np.zeros((12, D)), np.empty((12, 12))
    J[:, 10:22], J[3:6, 2:5], J[9:, 2:5] = np.eye(12), -np.eye(3), -np.eye(3)
    pose_loops.take_since_first(P, 10, 2, found)
    np.testing.assert_allclose(found, J @ P @ J.T, atol=1e-14)
    blocks = np.empty((7, 8, 8))
    pose_loops.take_blocks(P, blocks)
    for m, block in enumerate(blocks):
        rows = [*range(3 * m, 3 * m + 3), *range(21, 26)]
        np.testing.assert_array_equal(block, P[np.ix_(rows, rows)])


def test_rows_scores_and_gates_are_summed_as_in_numpy() -> None:
    rng = np.random.default_rng(36)
    basis, common, rows, weight = (
        rng.normal(size=(40, 7)),
        rng.normal(size=(40, 4)),
        rng.normal(size=40),
        rng.random(40),
    )
    A, b, C, solution = (
        rng.normal(size=(7, 7)),
        rng.normal(size=7),
        rng.normal(size=(7, 4)),
        rng.normal(size=7),
    )
    expected = [
        0.9 * old + (basis * weight[:, None]).T @ x
        for old, x in ((A, basis), (b, rows), (C, common))
    ]
    track_loops.add_rows(basis, common, rows, weight, 0.9, RowEquations(A, b, C))
    for found, twin in zip((A, b, C), expected, strict=True):
        np.testing.assert_allclose(found, twin, atol=1e-12)
    fitted = basis @ solution
    expected = [weight @ (rows - fitted) ** 2, weight.sum(), fitted @ fitted]
    np.testing.assert_allclose(
        track_loops.fitted_rows(basis, rows, weight, solution), expected, rtol=1e-12
    )
    scores, clusters, together, squares = (
        rng.normal(size=(5, 6)),
        np.array([2, 0, 2, 2, 1]),
        np.zeros((3, 6)),
        np.zeros(6),
    )
    track_loops.add_scores(clusters, scores, together, squares)
    sums = np.array([scores[clusters == k].sum(axis=0) for k in range(3)])
    np.testing.assert_allclose(together, sums, atol=1e-14)
    np.testing.assert_allclose(squares, (sums**2).sum(axis=0), atol=1e-13)
    r, J = rng.normal(size=(6, 5, 4)), rng.normal(size=(6, 5, 4, 3))
    J[..., 3, :], r[..., 3] = 0.0, 0.0
    J[0, 1:4], r[0, 1:4], J[1, 2, 2], r[1, 2, 2] = 0.0, 0.0, 0.0, 0.0
    of_views, counts = multiview.squared_residuals(
        Residuals(r, J, np.ones(6, np.bool_), np.ones(r.shape))
    )
    limits, wrong, enough = (
        np.array([0.0, 1.0, 2.0, 3.0, 4.0]),
        np.empty((6, 5), np.bool_),
        np.empty(6, np.bool_),
    )
    assert track_loops.mark_wrong_views(r, J, 1.1, limits, wrong, enough)
    np.testing.assert_array_equal(wrong, of_views > 1.1 * limits[counts])
    np.testing.assert_array_equal(enough, ((counts > 0) & ~wrong).sum(axis=1) >= 2)
    squares, dof = np.empty(6), np.empty(6, np.int64)
    track_loops.square_tracks(r, J, 0.7, 11, squares, dof)
    np.testing.assert_allclose(squares, of_views.sum(axis=1) / 0.7, rtol=1e-14)
    np.testing.assert_array_equal(dof, np.clip(counts.sum(axis=1) - 3, 1, 11))


def test_rows_of_a_table_are_found_by_id() -> None:
    rng = np.random.default_rng(34)
    known = rng.permutation(50)[:30].astype(np.int64)
    ordered = np.argsort(known)[:25]
    ids, rows = rng.permutation(60).astype(np.int64), np.empty(60, dtype=np.int64)
    place = {int(known[row]): int(row) for row in ordered}
    expected = [place.get(int(i), -1) for i in ids]
    assert track_loops.find_rows(ids, known[ordered], ordered, rows) == expected.count(-1)
    assert rows.tolist() == expected


def test_points_begin_where_two_left_rays_meet() -> None:
    rng = np.random.default_rng(37)
    T, p = se3_exp(rng.normal(0, 0.2, (4, 6))), rng.uniform([-2, -1, 4], [2, 1, 9], (12, 3))
    z = np.stack([project(CAMERA, transform_points(T_k, p)) for T_k in T], axis=1)
    weight, found, directions = (
        np.tile([1.0, 1.0, 0.0, 0.0], (12, 4, 1)),
        np.empty((12, 3)),
        np.empty((2, 2)),
    )
    weight[:6, 0] = 0.0
    track_loops.start_by_parallax(camera_args(CAMERA), (1e-3, 1e3), 1e-12, T, z, weight, found)
    np.testing.assert_allclose(found, p, rtol=1e-7)
    track_loops.write_directions(np.array([3, 7]), T[1], p, directions)
    x, y, d = transform_points(T[1], p[[3, 7]]).T
    np.testing.assert_allclose(
        directions, np.column_stack([np.arctan2(x, d), np.arctan2(y, np.hypot(x, d))]), rtol=1e-12
    )


def test_newest_residual_is_the_median_of_what_the_newest_clone_measured() -> None:
    T, p, views = _scene()
    at = multiview.residuals(CAMERA, T, p, views)
    measured = np.any(at.z_D_p[:, -1], axis=2)
    assert 0 < measured.sum() < measured.size
    assert track_loops.newest_residual(at.r, at.z_D_p) == np.median(np.abs(at.r[:, -1][measured]))
    at.z_D_p[:, -1] = 0.0
    assert track_loops.newest_residual(at.r, at.z_D_p) is None


def test_stereo_field_is_linearised_and_eliminated_as_in_numpy() -> None:
    T, p, views = _scene()
    rng = np.random.default_rng(13)
    rows, states = rng.normal(0, 0.01, 7), rng.normal(0, 0.01, 10)
    expected = numpy_twins.corrected(CAMERA, rows, states, views.z, views.weight)
    views = stereo_calibration.StereoCorrection(CAMERA, rows, states, np.arange(10)).corrected(
        views
    )
    np.testing.assert_allclose(views.z, expected, rtol=1e-12)
    at = multiview.residuals(CAMERA, T, p, views)
    at, p = at.take(at.ahead), p[at.ahead]
    weight = rng.uniform(0.1, 1.0, at.r.shape[:2])
    info = multiview.track_information(CAMERA, T, at, p, weight)
    H = ErrorColumns(CAMERA).jacobian(expected[: len(p)])
    np.testing.assert_allclose(
        H, numpy_twins.field_jacobian(CAMERA, expected[: len(p)]), rtol=1e-12, atol=1e-12
    )
    ours = stereo_calibration.stereo_columns(ErrorColumns(CAMERA), at, expected[: len(p)], weight)
    columns = numpy_twins.stereo_columns(at, H, info.q.p_D_q, weight)
    chosen = np.arange(len(p)) % 3 > 0
    A, b = stereo_calibration.eliminate_points(info, chosen, ours)
    np.testing.assert_allclose(
        ours.G[chosen], columns.G[chosen], rtol=1e-9, atol=1e-9 * np.abs(columns.G).max()
    )
    assert not ours.G[~chosen].any()
    twin = numpy_twins.eliminate_columns(columns, info, chosen)
    size = 6 * len(T)
    for found, expected in zip((A[size:, size:], A[size:, :size], b[size:]), twin, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(A, A.T, rtol=1e-9, atol=1e-9 * np.abs(A).max())
    clones = stereo_calibration.eliminate_points(info, chosen)
    np.testing.assert_allclose(
        A[:size, :size], clones[0], rtol=1e-9, atol=1e-9 * np.abs(clones[0]).max()
    )
    np.testing.assert_allclose(b[:size], clones[1], rtol=1e-9, atol=1e-9 * np.abs(clones[1]).max())
    rows = np.flatnonzero(chosen)
    scores, information = np.empty((2, len(rows), 6))
    centre = np.array([0.3, -0.2, 0.5])
    track_loops.score_drifts(rows, info, centre, 0.5, scores, information)
    for k, row in enumerate(rows):
        views = np.flatnonzero(np.any(info.G[row].reshape(len(T), 18), axis=1))
        drift = np.zeros((len(T), 6, 6))
        drift[:] = np.eye(6)
        drift[:, :3, 3:] = so3_hat(centre)
        along = (np.arange(len(T)) - views[0]) / max(views[-1] - views[0], 1) - 0.5
        drift *= np.where(
            (np.arange(len(T)) >= views[0]) & (np.arange(len(T)) <= views[-1]), along, 0.0
        )[:, None, None]
        alone = np.arange(len(p)) == row
        A_one, b_one = stereo_calibration.eliminate_points(info, alone)
        M = drift.reshape(-1, 6)
        np.testing.assert_allclose(
            scores[k], 2 * M.T @ b_one, rtol=1e-7, atol=1e-8 * np.abs(b_one).max()
        )
        np.testing.assert_allclose(
            information[k], 2 * np.diag(M.T @ A_one @ M), rtol=1e-7, atol=1e-9 * np.abs(A_one).max()
        )
    solved = np.linalg.solve(info.C[rows], np.swapaxes(ours.G[rows], 1, 2))
    np.testing.assert_allclose(
        ours.point_D_stereo(info, rows), -info.q.p_D_q[rows] @ solved, rtol=1e-9, atol=1e-12
    )
    covariance = (
        info.q.p_D_q[rows] @ np.linalg.inv(info.C[rows]) @ np.swapaxes(info.q.p_D_q[rows], 1, 2)
    )
    np.testing.assert_allclose(info.point_covariance(rows), covariance, rtol=1e-9, atol=1e-12)


def test_noise_is_taken_off_and_rows_are_weighed_as_in_numpy() -> None:
    rng = np.random.default_rng(21)
    root, mean = rng.normal(size=(6, 6)), rng.normal(size=6) * [5.0, 5.0, 5.0, 1.0, 1.0, 1.0]
    C, shrunk = root @ root.T, mean.copy()
    pose_loops.shrink_by_noise(C, 0.7, shrunk)
    for part in (slice(0, 3), slice(3, 6)):
        squared = mean[part] @ np.linalg.solve(C[part, part], mean[part])
        np.testing.assert_allclose(
            shrunk[part], mean[part] * np.sqrt(max(1 - 0.7 / squared, 0.0)), rtol=1e-9
        )
    residual, weight = rng.normal(1.0, 2.0, 41), np.empty(41)
    track_loops.weigh_rows(residual, 3.0, weight)
    centred = residual - np.median(residual)
    np.testing.assert_allclose(
        weight, 1 / (1 + (centred / (3 * 1.48 * np.median(np.abs(centred)))) ** 2)
    )


def test_innovations_are_those_of_numpy() -> None:
    T, p, views = _scene()
    at = multiview.residuals(CAMERA, T, p, views)
    root = np.random.default_rng(20).normal(0, 0.01, (6, 6))
    squared, pixels = np.empty(len(p)), np.empty(len(p), np.int64)
    track_loops.innovations(at.r, at.z_D_p, p, root @ root.T, 0.3, squared, pixels)
    J = at.z_D_p[:, -1] @ circledot(p)[:, :3]
    S = J @ (root @ root.T) @ np.swapaxes(J, 1, 2) + 0.3 * np.eye(4)
    expected = np.einsum("fi,fi->f", at.r[:, -1], np.linalg.solve(S, at.r[:, -1, :, None])[..., 0])
    np.testing.assert_allclose(squared, expected, rtol=1e-9)
    assert pixels.tolist() == np.any(at.z_D_p[:, -1], axis=2).sum(axis=1).tolist()


MODULE = """
from vio.numerics.compiled import compiled, has_compiled

@compiled
def doubled(x: float) -> float:
    return 2.0 * x
"""


def test_functions_run_where_no_cache_folder_is_writable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each folder that numba tries is a file, which stops even an administrator."""
    for name in ("__pycache__", "home"):
        (tmp_path / name).write_text("")
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    for variable in ("HOME", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.setenv(variable, str(tmp_path / "home"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "part.py").write_text(MODULE)
    spec = importlib.util.spec_from_file_location("part", tmp_path / "part.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.doubled(3.0) == 6.0


def test_two_processes_may_fill_the_cache_at_once(tmp_path: Path) -> None:
    (tmp_path / "part.py").write_text(MODULE)
    paths = [str(tmp_path), str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join(paths),
    }
    command = [sys.executable, "-c", "import part; print(part.doubled(4.0), part.has_compiled())"]
    both = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
        for _ in range(2)
    ]
    printed = [process.communicate()[0].strip() for process in both]
    assert set(printed) <= {"8.0 True", "8.0 False"}
    assert "8.0 True" in printed
    assert list((tmp_path / "cache").rglob("*.nbi"))
    assert subprocess.check_output(command, text=True, env=environment).strip() == "8.0 False"
