"""Points from many views: where they begin, how far each view is believed, and what is too far."""

from __future__ import annotations

import numpy as np

from vio.filters.multiview import CAUCHY, Residuals, Views, first_points, robust_weights, within
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
    p = _points(5)
    views = _views(p)
    views.weight[0, :3] = 0.0  # seen in the newest clone alone
    views.weight[1, 1:] = 0.0  # seen in the oldest clone alone
    views.weight[2, [0, 1, 3], 2:] = 0.0  # one stereo view
    views.weight[3, :, 2:] = 0.0  # none
    views.z[3, :, 2:] = 0.0
    views.z[4, -1, 0] += 200.0  # the newest view's disparity is the largest, and its pose is not yet corrected
    found, known = first_points(CAMERA, T_CAM0_WORLD, views)
    assert known.tolist() == [True, True, True, False, True]
    np.testing.assert_allclose(found[known], p[known], atol=1e-9)


def test_a_view_is_believed_less_the_worse_it_fits_beside_the_others_of_its_clone() -> None:
    r = np.zeros((5, 2, 4))
    r[:, 0, 0] = [0.0, 1.0, 1.0, 1.0, 12.0]  # one wrong track
    r[:, 1, 0] = 10.0  # a pose that is off as a whole
    J = np.ones((5, 2, 4, 3))
    J[1, 0] = 0.0  # not seen
    weights = robust_weights(Residuals(r, J, np.ones(5, dtype=np.bool_)), sigma2=0.25)
    scale2 = 1.0 / 2.37  # the median of 0, 1, 1, 144 over that of chi-square with 3 degrees of freedom
    expected = 1 / (1 + np.array([0.0, 1.0, 1.0, 144.0]) / (4 * scale2 * CAUCHY**2))
    np.testing.assert_allclose(weights[[0, 2, 3, 4], 0], expected)
    assert weights[1, 0] == 0.0
    np.testing.assert_allclose(weights[:, 1], 1 / (1 + 2.37 / (4 * CAUCHY**2)))
    quiet = robust_weights(Residuals(r * 1e-3, J, np.ones(5, dtype=np.bool_)), sigma2=0.25)
    np.testing.assert_allclose(quiet[4, 0], 1 / (1 + 144e-6 / (4 * 0.25 * CAUCHY**2)))  # never below the noise


def test_points_too_far_or_not_finite_are_told() -> None:
    p_cam = np.array([[0.0, 0, 5], [0, 0, 50], [0, 0, -50], [40, 0, 5], [np.nan, 0, 5]])
    p = p_cam @ T_CAM0_WORLD[-1, :3, :3] + se3_inverse(T_CAM0_WORLD[-1])[:3, 3]
    assert within(CAMERA, T_CAM0_WORLD, p, 44.0).tolist() == [True, False, False, True, False]
