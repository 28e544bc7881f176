"""Where a predicted motion lets pixels be."""

from __future__ import annotations

import numpy as np

from tests.frontend.test_frontend_scene import CAMERA
from tests.jacobians import numeric_jacobian
from vio.frontend.expected_motion import pixel_D_motion
from vio.geometry.lie import se3_exp, transform_points
from vio.geometry.stereo import project


def test_left_pixels_follow_the_motion() -> None:
    p = np.random.default_rng(2).uniform([-2, -1, 3], [2, 1, 12], (5, 3))
    expected = numeric_jacobian(
        lambda xi: project(CAMERA, transform_points(se3_exp(xi), p))[:, :2], np.zeros(6)
    )
    np.testing.assert_allclose(pixel_D_motion(CAMERA, p).reshape(-1, 6), expected, atol=1e-4)
