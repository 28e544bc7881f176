"""Points from many views: where they begin, how they converge, how far views are believed, and
their elimination.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.jacobians import numeric_jacobian
from tests.numpy_twins import inverse_depth, moved, point_D_pose
from tests.replaced_rules import replaced
from vio.filters.multiview import (
    CAUCHY,
    first_points,
    linearised_points,
    refine_points,
    residuals,
    robust_weights,
    track_information,
)
from vio.filters.stereo_calibration import eliminate_points
from vio.filters.track_records import Residuals, Views
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, project

CAMERA = StereoCamera(460.0, 458.0, 370.0, 240.0, 0.11, 752, 480)
T_CAM0_WORLD = se3_exp(np.cumsum(np.random.default_rng(0).normal(0, 0.2, (4, 6)), axis=0))


def _points(n: int) -> FloatArray:
    p_cam = np.random.default_rng(1).uniform([-1.0, -0.8, 3.0], [1.0, 0.8, 6.0], (n, 3))
    return transform_points(se3_inverse(T_CAM0_WORLD[0]), p_cam)


def _views(p: FloatArray) -> Views:
    z = np.array([[project(CAMERA, transform_points(T, q)) for T in T_CAM0_WORLD] for q in p])
    return Views(z, np.ones_like(z))


def test_first_points_of_exact_views_are_the_points() -> None:
    p = _points(6)
    views = _views(p)
    views.weight[0, :3] = 0.0  # seen in the newest clone alone
    views.weight[1, 1:] = 0.0  # seen in the oldest clone alone
    views.weight[2, [0, 1, 3], 2:] = 0.0  # one stereo view
    views.weight[3, :, 2:] = 0.0  # none: parallax
    views.z[3, :, 2:] = 0.0
    views.z[3, -1, 0] += 200.0
    # left views of the newest clone and one other: no pose that is known well
    views.weight[5, :2] = 0.0
    views.weight[5, :, 2:] = 0.0
    # the newest view's disparity is the largest, and its pose is not yet corrected
    views.z[4, -1, 0] += 200.0
    found, known = first_points(CAMERA, T_CAM0_WORLD, views)
    assert known.tolist() == [True, True, True, True, True, False]
    np.testing.assert_allclose(found[known], p[known], atol=1e-6)


def test_a_view_is_believed_less_the_worse_it_fits_beside_the_others_of_its_clone() -> None:
    r = np.zeros((5, 2, 4))
    r[:, 0, 0] = [0.0, 1.0, 1.0, 1.0, 12.0]  # one wrong track
    r[:, 1, 0] = 10.0  # a pose that is off as a whole
    J = np.ones((5, 2, 4, 3))
    J[1, 0] = 0.0  # not seen
    weights = robust_weights(
        Residuals(r, J, np.ones(5, dtype=np.bool_), np.ones(r.shape)), sigma2=0.25
    )
    # the median of 0, 1, 1, 144 over that of chi-square with 3 degrees of freedom
    scale2 = 1.0 / 2.37
    expected = 1 / (1 + np.array([0.0, 1.0, 1.0, 144.0]) / (4 * scale2 * CAUCHY**2))
    np.testing.assert_allclose(weights[[0, 2, 3, 4], 0], expected)
    assert weights[1, 0] == 0.0
    np.testing.assert_allclose(weights[:, 1], 1 / (1 + 2.37 / (4 * CAUCHY**2)))
    quiet = robust_weights(
        Residuals(r * 1e-3, J, np.ones(5, dtype=np.bool_), np.ones(r.shape)), sigma2=0.25
    )
    # never below the noise
    np.testing.assert_allclose(quiet[4, 0], 1 / (1 + 144e-6 / (4 * 0.25 * CAUCHY**2)))


def test_rays_of_left_views_meet_before_any_iteration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "vio.filters.multiview._TRIANGULATION",
        replaced("vio.filters.multiview._TRIANGULATION", parallax_steps=0),
    )
    p = _points(5)
    found, known = first_points(CAMERA, T_CAM0_WORLD, _left_only(_views(p)))
    assert known.all()
    np.testing.assert_allclose(found, p, atol=1e-9)


def test_points_follow_the_clones_as_their_triangulation_does() -> None:
    p = _points(1)
    views = _left_only(_views(p))
    at = residuals(CAMERA, T_CAM0_WORLD, p, views)
    info = track_information(CAMERA, T_CAM0_WORLD, at, p, np.ones((1, 4)))

    def triangulated(xi: FloatArray) -> FloatArray:
        moved = T_CAM0_WORLD @ se3_exp(-xi.reshape(-1, 6))  # the body is the camera
        return refine_points(CAMERA, moved, p, views, 10, 1e6)[0]

    numeric = numeric_jacobian(triangulated, np.zeros(24), eps=1e-5)
    np.testing.assert_allclose(
        info.point_D_clones(np.arange(1))[0], numeric, atol=1e-4 * np.abs(numeric).max()
    )


@pytest.mark.parametrize("disparity", [0.0, -0.4])
def test_stereo_view_without_disparity_is_a_point_at_infinity(disparity: float) -> None:
    z = np.array([[300.0, 200.0, 300.0 - disparity, 200.0]])
    views = Views(np.tile(z, (1, 4, 1)), np.ones((1, 4, 4)))
    p, known = first_points(CAMERA, T_CAM0_WORLD, views)
    assert known.all()
    p_cam = transform_points(T_CAM0_WORLD[0], p)[0]
    np.testing.assert_allclose(project(CAMERA, p_cam)[:2], z[0, :2], atol=1e-6)
    assert p_cam[2] > 1e4


def _left_only(views: Views) -> Views:
    return Views(views.z, views.weight * np.array([1.0, 1.0, 0.0, 0.0]))


@pytest.mark.parametrize("factor", [0.2, 0.5, 3.0, 1e3, -1.0])
@pytest.mark.parametrize("left_only", [False, True])
def test_points_converge_from_poor_starts_and_stay_ahead(factor: float, left_only: bool) -> None:
    """From depths that are wrong by a factor, and from behind the cameras, in eight steps."""
    p = _points(20)
    views = _left_only(_views(p)) if left_only else _views(p)
    centre = se3_inverse(T_CAM0_WORLD[0])[:3, 3]
    found = centre + factor * (p - centre)
    for _ in range(8):
        found = refine_points(CAMERA, T_CAM0_WORLD, found, views, 1, 1e6)
        assert np.all(residuals(CAMERA, T_CAM0_WORLD, found, views).ahead)
    np.testing.assert_allclose(found, p, atol=1e-4)


@pytest.mark.parametrize("depth_m", [3.3, 4.5, 20.0])
def test_a_step_from_far_away_does_not_pass_a_camera_that_came_nearer(depth_m: float) -> None:
    """Cameras drive forwards; to first order in the inverse depth the point would lie behind the
    last of them.
    """
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, 2, 3] = [0.0, -1.0, -2.0, -3.0]
    p = np.array([[0.3, -0.2, depth_m]])
    z = np.array([[project(CAMERA, transform_points(T_i, p[0])) for T_i in T]])
    views = _left_only(Views(z, np.ones_like(z)))
    found = p * 1e3
    for _ in range(12):
        found = refine_points(CAMERA, T, found, views, 1, 1e6)
        assert residuals(CAMERA, T, found, views).ahead.all()
    np.testing.assert_allclose(found, p, rtol=1e-4)


def _sideways(
    spread_m: float, depth_m: float, left_only: bool
) -> tuple[FloatArray, FloatArray, Residuals]:
    """Five cameras within a spread, eight points at a depth, and their residuals with half a
    pixel of noise.
    """
    rng = np.random.default_rng(3)
    twists = np.column_stack(
        [rng.uniform(-0.5, 0.5, (5, 3)) * spread_m, rng.normal(0, 0.02, (5, 3))]
    )
    T = se3_exp(twists) @ se3_exp([3.0, -2.0, 1.0, 0.4, -0.8, 1.1])
    p_cam = np.column_stack([rng.uniform(-0.4, 0.4, (8, 2)), np.ones(8)]) * depth_m
    p = transform_points(se3_inverse(T[0]), p_cam)
    z = np.array([[project(CAMERA, transform_points(T_i, q)) for T_i in T] for q in p])
    views = Views(z + rng.normal(0, 0.5, z.shape), np.ones_like(z))
    return T, p, residuals(CAMERA, T, p, _left_only(views) if left_only else views)


def _by_null_space(T: FloatArray, p: FloatArray, at: Residuals) -> FloatArray:
    """Information about the clones by QR of the same system, the prior's row (M6) included."""
    N, A, B = len(T), np.zeros((6 * len(T), 6 * len(T))), point_D_pose(p)
    seen = at.z_D_p[:, :, 1].any(axis=2)
    q = inverse_depth(CAMERA, T, p, seen)
    for f in range(len(p)):
        H, H_point = np.zeros((4 * N + 1, 6 * N)), np.zeros((4 * N + 1, 3))
        for n in range(N):
            H[4 * n : 4 * n + 4, 6 * n : 6 * n + 6] = at.z_D_p[f, n] @ B[f]
            H_point[4 * n : 4 * n + 4] = at.z_D_p[f, n]
        a = q.anchor[f]
        H[-1, 6 * a : 6 * a + 6], H_point[-1] = 1e-3 * q.q_D_p[f, 2] @ B[f], 1e-3 * q.q_D_p[f, 2]
        scaled = H_point @ q.p_D_q[f]
        null = np.linalg.qr(scaled, mode="complete")[0][:, 3:].T
        A += (null @ H).T @ (null @ H)
    return A


@pytest.mark.parametrize("left_only", [False, True])
@pytest.mark.parametrize("depth_m", [0.5, 5.0, 1e3, 1e5])
@pytest.mark.parametrize("spread_m", [1e-8, 1e-6, 1e-5, 1e-3, 0.1, 10.0])
def test_elimination_holds_whatever_the_parallax(
    spread_m: float, depth_m: float, left_only: bool
) -> None:
    """No failure, no information on where or how the world lies, and what a QR of the same system
    gives.

    Without scaled coordinates and a prior, cameras 1e-5 m apart gave 60 per m^2 on their common
    translation, and 1e-6 m a Cholesky factorisation that failed.
    """
    T, p, at = _sideways(spread_m, depth_m, left_only)
    seen = at.z_D_p[:, :, 1].any(axis=2)
    at, p = at.take(seen.sum(axis=1) >= 2), p[seen.sum(axis=1) >= 2]
    info = track_information(CAMERA, T, at, p, np.ones(at.r.shape[:2]))
    A, b = eliminate_points(info, np.ones(len(p), dtype=np.bool_))
    before = np.einsum("fnik,fkj->nij", info.G.reshape(len(p), 5, 6, 3), info.q_D_clone)
    for direction in np.eye(6):
        common = np.tile(direction, len(T))
        assert abs(common @ A @ common) <= 1e-7 * sum(direction @ D @ direction for D in before)
        assert abs(common @ b) <= 1e-7 * np.abs(info.gradient).sum()
    unit = 1 / np.sqrt(np.concatenate([np.diag(D) for D in before]) + 1e-30)
    np.testing.assert_allclose(
        A * np.outer(unit, unit), _by_null_space(T, p, at) * np.outer(unit, unit), atol=1e-7
    )
    assert np.linalg.eigvalsh(A * np.outer(unit, unit))[0] > -1e-7


@pytest.mark.parametrize("left_only", [False, True])
def test_coordinates_of_a_point_equal_central_differences(left_only: bool) -> None:
    T, p, at = _sideways(0.5, 5.0, left_only)
    q = track_information(CAMERA, T, at, p, np.ones(at.r.shape[:2])).q
    assert q.anchor.tolist() == [0] * 8
    T_0 = T[0]

    def coordinates(x: FloatArray) -> FloatArray:
        x_cam = transform_points(T_0, x)
        return CAMERA.fu * np.array(
            [x_cam[0] / x_cam[2], x_cam[1] / x_cam[2], CAMERA.baseline_m / x_cam[2]]
        )

    for f in range(8):
        np.testing.assert_allclose(q.q_D_p[f], numeric_jacobian(coordinates, p[f]), atol=1e-5)
        np.testing.assert_allclose(q.q_D_p[f] @ q.p_D_q[f], np.eye(3), atol=1e-12)
        dq = np.array([3.0, -2.0, 1.5])
        after = coordinates(moved(q, np.tile(dq, (8, 1)), np.inf)[f])
        np.testing.assert_allclose(after, coordinates(p[f]) + dq, atol=1e-9)


@pytest.mark.parametrize(
    ("spread_m", "enough"), [(1e-3, False), (0.02, False), (0.5, True), (1.45, True)]
)
def test_left_views_need_the_parallax_of_a_baseline_and_stereo_views_none(
    spread_m: float, enough: bool
) -> None:
    for left_only in (True, False):
        T, p, at = _sideways(spread_m, 5.0, left_only)
        views = Views(np.zeros_like(at.r), np.ones_like(at.r))
        seen = _left_only(views) if left_only else views
        found = linearised_points(CAMERA, T, p, seen, 0, 1.0)[2]
        assert np.all(found == (enough or not left_only))


def test_weak_prior_is_outweighed_by_one_stereo_view() -> None:
    T, p, at = _sideways(1e-6, 5.0, False)
    stereo = track_information(CAMERA, T, at, p, np.ones((8, 5)))
    left = track_information(CAMERA, T, *_sideways(1e-6, 5.0, True)[2:], p, np.ones((8, 5)))
    np.testing.assert_allclose(left.C[:, 2, 2], 1e-6, rtol=1e-3)
    assert np.all(stereo.C[:, 2, 2] > 1e5 * left.C[:, 2, 2])


def test_depth_sigma_and_covariance_are_those_of_the_inverted_information() -> None:
    p = _points(5)
    at = residuals(CAMERA, T_CAM0_WORLD, p, _views(p))
    info = track_information(CAMERA, T_CAM0_WORLD, at, p, np.ones((5, 4)))
    inverse = np.linalg.inv(info.C)
    np.testing.assert_allclose(
        info.relative_depth_sigma(), np.sqrt(inverse[:, 2, 2]) / info.q.disparity, rtol=1e-9
    )
    p_D_q, chosen = info.q.p_D_q, np.array([3, 1])
    expected = (p_D_q @ inverse @ np.swapaxes(p_D_q, 1, 2))[chosen]
    np.testing.assert_allclose(info.point_covariance(chosen), expected, rtol=1e-9)
