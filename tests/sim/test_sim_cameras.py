"""Distortion models against OpenCV, their own inverse and central differences; the predefined
rigs.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.datasets.test_rig import LENSES
from tests.geometry.test_distortion import KITTI
from vio.errors import CalibrationError
from vio.geometry.distortion import (
    CameraModel,
    StereoRig,
    project_point,
    rectified_camera,
    rig_from_rectified,
    unproject_pixel,
)
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import project
from vio.sim.rigs import euroc_like_rig, euroc_rectified_rig, fisheye_rig, kitti_like_rig, small_rig

RIGS = {
    "euroc": euroc_like_rig(),
    "euroc_rectified": euroc_rectified_rig(),
    "fisheye": fisheye_rig(),
    "kitti": kitti_like_rig(),
    "small": small_rig(),
}
CAMERAS = {name: rig.cam0 for name, rig in RIGS.items()} | {"kitti_raw": KITTI}
# corners of boxes of points, m
_NEAR, _WIDE = ((-2, -1.2, 2), (2, 1.2, 6)), ((-6, -4, 1), (6, 4, 3))


def _pixels(camera: CameraModel, n: int = 15) -> FloatArray:
    u, v = np.meshgrid(
        np.linspace(-0.5, camera.width - 0.5, n), np.linspace(-0.5, camera.height - 0.5, n)
    )
    return np.stack([u, v], axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("name", CAMERAS)
def test_unprojection_inverts_projection_over_the_whole_image(name: str) -> None:
    camera = CAMERAS[name]
    uv = _pixels(camera)
    rays, found = unproject_pixel(camera, uv)
    back, valid = project_point(camera, 2.5 * rays)
    assert found.all()
    assert valid.all()
    np.testing.assert_allclose(back, uv, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("name", ["euroc", "small", "kitti_raw", "rational", "fisheye"])
def test_projection_agrees_with_opencv(name: str) -> None:
    camera = (CAMERAS | LENSES)[name]
    corners, opencv = (_WIDE, cv2.fisheye) if name == "fisheye" else (_NEAR, cv2)
    points = np.random.default_rng(1).uniform(*corners, (200, 3))
    distortion = np.array(camera.coefficients or (0.0,) * 4)
    expected, _ = opencv.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.K, distortion
    )
    np.testing.assert_allclose(project_point(camera, points)[0], expected[:, 0], atol=1e-9)


def test_points_behind_the_camera_and_beyond_the_model_are_invalid() -> None:
    folding = CameraModel(400, 400, 320, 240, 640, 480, "radtan", (-0.4, 0.0, 0.0, 0.0))
    _, valid = project_point(folding, [[0, 0, -1.0], [0.1, 0, 1.0], [1.2, 0, 1.0]])
    assert valid.tolist() == [False, True, False]
    # The polynomial x (1 - 0.4 x^2) never gets beyond 0.61, that is 563 px.
    assert unproject_pixel(folding, [[320 + 0.7 * 400, 240.0], [330.0, 240.0]])[1].tolist() == [
        False,
        True,
    ]


def test_a_raw_rig_has_no_rectified_camera() -> None:
    with pytest.raises(CalibrationError, match="not rectified"):
        rectified_camera(euroc_like_rig())


@pytest.mark.parametrize("name", ["euroc_rectified", "kitti", "small"])
def test_rectified_rigs_project_like_the_stereo_camera(name: str) -> None:
    rig = RIGS[name]
    camera = rectified_camera(rig)
    points = np.random.default_rng(3).uniform((-2, -1, 3), (2, 1, 9), (50, 3))
    in_cam1 = (points - rig.T_cam0_cam1[:3, 3]) @ rig.T_cam0_cam1[:3, :3]
    both = np.hstack([project_point(rig.cam0, points)[0], project_point(rig.cam1, in_cam1)[0]])
    np.testing.assert_allclose(both, project(camera, points), atol=1e-9)
    again = rig_from_rectified(camera, se3_inverse(rig.T_imu_cam0))
    np.testing.assert_allclose(again.T_imu_cam1, rig.T_imu_cam1, atol=1e-12)


@pytest.mark.parametrize("name", RIGS)
def test_rigs_are_proper(name: str) -> None:
    rig: StereoRig = RIGS[name]
    for T in (rig.T_imu_cam0, rig.T_imu_cam1):
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert rig.T_cam0_cam1[0, 3] > 0.05  # the right camera is to the right
