"""The rectified stereo camera: round trips, the paper's matrix, Jacobians, invalid calibrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.jacobians import numeric_jacobian
from vio.errors import CalibrationError
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import (
    PROJECTIONS,
    Projection,
    StereoCamera,
    depth_of,
    facing,
    left_rays,
    p_cam_D_z,
    project,
    triangulate,
    z_D_p_cam,
)

properties = settings(max_examples=60, deadline=None)

cameras = st.builds(
    StereoCamera,
    fu=st.floats(100, 2000),
    fv=st.floats(100, 2000),
    cu=st.floats(0, 2000),
    cv=st.floats(0, 2000),
    baseline_m=st.floats(0.05, 1.0),
)
points = st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(0.5, 80)).map(np.array)
cylinders = cameras.map(lambda camera: replace(camera, projection="cylinder"))
around = st.tuples(st.floats(-20, 20), st.floats(0.5, 20), st.floats(-2.8, 2.8)).map(
    lambda p: np.array([p[0], p[1] * np.sin(p[2]), p[1] * np.cos(p[2])])
)  # all about the baseline
both = st.tuples(cameras, points) | st.tuples(cylinders, around)


@properties
@given(both)
def test_triangulate_undoes_project(seen: tuple[StereoCamera, FloatArray]) -> None:
    camera, p = seen
    back, valid = triangulate(camera, project(camera, p)[None], min_disparity_px=1e-3)
    assert valid.all()
    np.testing.assert_allclose(back[0], p, rtol=1e-8, atol=1e-8)


@properties
@given(both)
def test_left_rays_lead_to_the_points(seen: tuple[StereoCamera, FloatArray]) -> None:
    camera, p = seen
    pixels, depth = np.broadcast_to(project(camera, p)[:2], (2, 3, 2)), depth_of(camera, p)
    np.testing.assert_allclose(
        left_rays(camera, pixels) * depth, np.broadcast_to(p, (2, 3, 3)), rtol=1e-8, atol=1e-8
    )


@properties
@given(cameras, points)
def test_project_is_the_papers_matrix_times_pi(camera: StereoCamera, p: FloatArray) -> None:
    q = np.append(p, 1.0)
    np.testing.assert_allclose(project(camera, p), camera.M @ (q / q[2]), rtol=1e-12, atol=1e-9)


@properties
@given(cameras, points)
def test_project_is_two_pinholes_a_baseline_apart(camera: StereoCamera, p: FloatArray) -> None:
    left, right = camera.K @ p, camera.K @ (p - [camera.baseline_m, 0, 0])
    expected = np.concatenate([left[:2] / left[2], right[:2] / right[2]])
    np.testing.assert_allclose(project(camera, p), expected, rtol=1e-12, atol=1e-9)


@properties
@given(both)
def test_z_D_p_cam_equals_central_differences(seen: tuple[StereoCamera, FloatArray]) -> None:
    camera, p = seen
    numeric = numeric_jacobian(
        lambda x: project(camera, x), p, eps=1e-5 * float(depth_of(camera, p))
    )
    analytic = z_D_p_cam(camera, p)
    np.testing.assert_allclose(analytic, numeric, rtol=1e-6, atol=1e-6 * np.abs(analytic).max())


@pytest.mark.parametrize("name", ["pinhole", "cylinder"])
def test_derivatives_of_rows_and_depths_equal_central_differences(name: Projection) -> None:
    rows, yz = PROJECTIONS[name], np.array([-1.3, 2.1])
    y, z = yz
    depth = rows.depth(y, z)

    def row(at: FloatArray) -> FloatArray:
        return rows.row(at[0], at[1], rows.depth(at[0], at[1]), 300.0)

    np.testing.assert_allclose(
        [rows.depth_D_yz(y, z, depth)], numeric_jacobian(lambda at: rows.depth(*at), yz), atol=1e-8
    )
    np.testing.assert_allclose(
        [rows.row_D_yz(y, z, depth, 300.0)], numeric_jacobian(row, yz), atol=1e-5
    )
    numeric = numeric_jacobian(lambda at: np.stack(rows.ray(at[0])), np.array([0.7]))
    np.testing.assert_allclose(np.array([rows.ray_D_row(np.float64(0.7))]).T, numeric, atol=1e-8)


@properties
@given(both)
def test_p_cam_D_z_equals_central_differences(seen: tuple[StereoCamera, FloatArray]) -> None:
    camera, p = seen
    z = project(camera, p)
    eps = 1e-5 * (z[0] - z[2])
    numeric = numeric_jacobian(
        lambda x: triangulate(camera, x[None], min_disparity_px=1e-6)[0][0], z, eps=eps
    )
    analytic = p_cam_D_z(camera, z)
    np.testing.assert_allclose(analytic, numeric, rtol=1e-6, atol=1e-6 * np.abs(analytic).max())


@properties
@given(both)
def test_the_two_jacobians_are_inverse_on_the_image_of_a_point(
    seen: tuple[StereoCamera, FloatArray],
) -> None:
    camera, p = seen
    product = p_cam_D_z(camera, project(camera, p)) @ z_D_p_cam(camera, p)
    np.testing.assert_allclose(product, np.eye(3), atol=1e-7)


@properties
@given(cylinders, around)
def test_a_cylinder_is_the_pinhole_turned_about_the_baseline_to_each_row(
    camera: StereoCamera, p: FloatArray
) -> None:
    """Columns are those of the turned pinhole exactly, also beyond 90 degrees; the row is its
    middle row.
    """
    z, pinhole = project(camera, p), replace(camera, projection="pinhole")
    pixels, turned = facing(camera, z[None, :2], p[None])
    np.testing.assert_allclose(
        project(pinhole, turned[0]), [z[0], camera.cv, z[2], camera.cv], rtol=1e-9, atol=1e-6
    )
    np.testing.assert_allclose(pixels, [[z[0], camera.cv]], rtol=1e-12)
    assert turned[0, 2] > 0
    ahead = np.array([p[0], 0.0, np.hypot(p[1], p[2])])
    np.testing.assert_allclose(
        project(camera, ahead), project(pinhole, ahead), rtol=1e-9, atol=1e-6
    )


@properties
@given(cameras, points)
def test_a_pinhole_faces_ahead(camera: StereoCamera, p: FloatArray) -> None:
    pixels, same = facing(camera, project(camera, p)[None, :2], p[None])
    np.testing.assert_array_equal(same, p[None])
    np.testing.assert_array_equal(pixels, project(camera, p)[None, :2])


@pytest.fixture
def camera() -> StereoCamera:
    return StereoCamera(
        fu=700.0, fv=690.0, cu=600.0, cv=180.0, baseline_m=0.54, width=1242, height=375
    )


def test_hand_computed_pixels(camera: StereoCamera) -> None:
    np.testing.assert_allclose(
        project(camera, [1.0, -2.0, 10.0]), [670.0, 42.0, 670.0 - 37.8, 42.0], atol=1e-12
    )


def test_batches_equal_single_calls(camera: StereoCamera) -> None:
    p = np.random.default_rng(0).uniform([-5, -5, 2], [5, 5, 30], size=(2, 4, 3))
    z = project(camera, p)
    for index in np.ndindex(2, 4):
        np.testing.assert_array_equal(z[index], project(camera, p[index]))
        np.testing.assert_array_equal(z_D_p_cam(camera, p)[index], z_D_p_cam(camera, p[index]))
        np.testing.assert_array_equal(p_cam_D_z(camera, z)[index], p_cam_D_z(camera, z[index]))


def test_unusable_pixels_are_masked_and_stay_finite(camera: StereoCamera) -> None:
    z = np.array(
        [
            [650.0, 200.0, 640.0, 200.0],  # fine
            [650.0, 200.0, 650.0, 200.0],  # at infinity
            [640.0, 200.0, 650.0, 200.0],  # behind, or the cameras are swapped
            [650.05, 200.0, 650.0, 200.0],  # too far away
            [np.nan, 200.0, 640.0, 200.0],
            [650.0, 200.0, 640.0, np.inf],
        ]
    )
    p, valid = triangulate(camera, z)
    np.testing.assert_array_equal(valid, [True, False, False, False, False, False])
    assert np.isfinite(p).all()
    assert p[0, 2] == pytest.approx(700 * 0.54 / 10)
    assert triangulate(camera, z[3:4], min_disparity_px=0.01)[1].all()


def test_the_vertical_coordinate_is_the_mean_of_both_images(camera: StereoCamera) -> None:
    p, _ = triangulate(camera, np.array([[650.0, 200.0, 640.0, 202.0]]))
    assert p[0, 1] == pytest.approx((201.0 - 180.0) / 690.0 * p[0, 2])


def test_no_observations_give_no_points(camera: StereoCamera) -> None:
    p, valid = triangulate(camera, np.zeros((0, 4)))
    assert p.shape == (0, 3)
    assert valid.shape == (0,)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"baseline_m": 0.0}, "baseline must be positive"),
        ({"baseline_m": -0.5}, "cameras are swapped"),
        ({"fu": 0.0}, "focal lengths must be positive"),
        ({"fv": -700.0}, "focal lengths must be positive"),
        ({"cu": float("nan")}, "not finite"),
        ({"fu": float("inf")}, "not finite"),
        ({"baseline_m": float("nan")}, "not finite"),
    ],
)
def test_rejects_invalid_stereo_calibrations(change: dict[str, float], match: str) -> None:
    v = {"fu": 700.0, "fv": 700.0, "cu": 600.0, "cv": 180.0, "baseline_m": 0.54} | change
    with pytest.raises(CalibrationError, match=match):
        StereoCamera(v["fu"], v["fv"], v["cu"], v["cv"], v["baseline_m"])
