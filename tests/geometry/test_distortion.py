"""The radial-tangential model with its optional further radial coefficients, against itself; see
test_sim_cameras.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.jacobians import numeric_jacobian
from vio.errors import CalibrationError
from vio.geometry.distortion import (
    CameraModel,
    project_point,
    rectified_camera,
    rig_from_rectified,
)
from vio.geometry.lenses.radtan import distort_by_xy, distorted
from vio.geometry.lie import se3_exp, se3_inverse
from vio.geometry.stereo import StereoCamera

# Camera 00 of KITTI's 2011_09_26.
KITTI = CameraModel(
    984.2439,
    980.8141,
    690.0,
    233.1966,
    1392,
    512,
    "radtan",
    (-0.3728755, 0.2037299, 2.219027e-3, 1.383707e-3, -0.07233722),
)


def _points(n: int = 200) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.column_stack(
        [rng.uniform(-0.75, 0.75, n), rng.uniform(-0.3, 0.3, n), np.ones(n)]
    ) * rng.uniform(1, 40, (n, 1))


def test_a_third_coefficient_of_zero_changes_nothing() -> None:
    four = CameraModel(400, 401, 320, 240, 640, 480, "radtan", (-0.28, 0.07, 2e-4, 2e-5))
    five = CameraModel(400, 401, 320, 240, 640, 480, "radtan", (-0.28, 0.07, 2e-4, 2e-5, 0.0))
    for a, b in zip(project_point(four, _points()), project_point(five, _points()), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("count", [4, 5, 8])
def test_jacobian_of_the_radial_tangential_model(count: int) -> None:
    """Newton's method takes it when pixels are undistorted."""
    coefficients = (-0.28, 0.07, 2e-4, 2e-5, 0.01, 0.02, 0.03, 0.004)[:count]
    for p in _points(20):
        xy = p[:2] / p[2]
        numeric = numeric_jacobian(lambda x: distorted(coefficients, x, np.True_)[0], xy)
        np.testing.assert_allclose(distort_by_xy(coefficients, xy), numeric, rtol=1e-6, atol=1e-8)


@settings(max_examples=100, deadline=None)
@given(st.tuples(st.floats(-0.6, 0.3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)))
def test_points_are_valid_up_to_the_fold_of_the_polynomial(k: tuple[float, float, float]) -> None:
    """Brute force: walk outwards along the u axis until the distorted radius stops growing."""
    k1, k2, k3 = k
    camera = CameraModel(1.0, 1.0, 0.0, 0.0, 2, 2, "radtan", (k1, k2, 0.0, 0.0, k3))
    r = np.arange(1, 3000) * 1e-3
    _, valid = project_point(camera, np.column_stack([r, 0 * r, np.ones_like(r)]))
    slope = 1 + 3 * k1 * r**2 + 5 * k2 * r**4 + 7 * k3 * r**6
    growing = np.logical_and.accumulate(slope > 0)
    ambiguous = slope < 0.01
    assert valid[: int(np.argmax(ambiguous)) if ambiguous.any() else None].all()
    if not growing.all():
        assert not valid[int(np.argmin(growing)) + 2 :].any()


@pytest.mark.parametrize("count", [1, 3, 6, 12])
def test_rejects_other_numbers_of_coefficients(count: int) -> None:
    with pytest.raises(
        CalibrationError, match=f"takes 4 distortion coefficients or 5 or 8, got {count}"
    ):
        CameraModel(400, 400, 320, 240, 640, 480, "radtan", (0.01,) * count)


def test_rejects_invalid_cameras() -> None:
    with pytest.raises(
        CalibrationError,
        match="unknown distortion model 'fisheye'; use one of pinhole, radtan, equi",
    ):
        CameraModel(400, 400, 320, 240, 640, 480, "fisheye", (0.1,))
    with pytest.raises(CalibrationError, match="are not finite"):
        CameraModel(400, np.nan, 320, 240, 640, 480)
    with pytest.raises(CalibrationError, match=r"must be positive, got fu=400, fv=0"):
        CameraModel(400, 0, 320, 240, 640, 480)
    with pytest.raises(CalibrationError, match="a rig needs the image size"):
        rig_from_rectified(StereoCamera(400, 400, 320, 240, 0.1), np.eye(4))


def test_rectified_pair_to_rig_round_trip() -> None:
    camera = StereoCamera(400.0, 410.0, 320.0, 240.0, 0.1, 640, 480)
    T_cam0_imu = se3_exp([0.1, -0.2, 0.3, 0.4, 0.5, 0.6])
    rig = rig_from_rectified(camera, T_cam0_imu)
    assert replace(rectified_camera(rig), baseline_m=0.1) == camera
    assert rectified_camera(rig).baseline_m == pytest.approx(0.1)
    np.testing.assert_allclose(se3_inverse(rig.T_imu_cam0), T_cam0_imu, atol=1e-12)
