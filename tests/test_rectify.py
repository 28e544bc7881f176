"""Rectification: aligned rows, rotations that agree with OpenCV's, errors for impossible rigs."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from vio.errors import CalibrationError
from vio.geometry.distortion import StereoRig, project_point
from vio.geometry.lie import se3_exp, se3_from_parts, se3_inverse, so3_exp, transform_points
from vio.geometry.rectify import rectify, rectify_pixels, rectifying_rotations
from vio.geometry.stereo import project
from vio.sim.rigs import euroc_like_rig, fisheye_rig, small_rig

RIGS = {"radtan": euroc_like_rig, "equidistant": fisheye_rig, "rectified": small_rig}


def _points_imu(rig: StereoRig, n: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    direction = np.column_stack([rng.uniform(-0.5, 0.5, n), rng.uniform(-0.35, 0.35, n), np.ones(n)])
    return transform_points(rig.T_imu_cam0, direction * rng.uniform(0.8, 30, (n, 1)))


@pytest.mark.parametrize("name", RIGS)
def test_rectified_raw_pixels_equal_the_rectified_projection(name: str) -> None:
    """The whole chain against the stereo model: distort, undistort, rotate; rows agree and so does the disparity."""
    rig = RIGS[name]()
    done = rectify(rig)
    points = _points_imu(rig, 300)
    expected = project(done.camera, transform_points(done.T_rect0_imu, points))
    for camera, T_imu_cam, R, columns in (
        (rig.cam0, rig.T_imu_cam0, done.R_rect_cam0, [0, 1]),
        (rig.cam1, rig.T_imu_cam1, done.R_rect_cam1, [2, 3]),
    ):
        raw, seen = project_point(camera, transform_points(se3_inverse(T_imu_cam), points))
        rectified, valid = rectify_pixels(camera, R, done.camera, raw)
        assert seen.mean() > 0.9
        np.testing.assert_allclose(rectified[seen & valid], expected[seen & valid][:, columns], atol=1e-5)


@pytest.mark.parametrize("name", RIGS)
def test_maps_are_the_inverse_of_rectifying_pixels(name: str) -> None:
    rig = RIGS[name]()
    done = rectify(rig)
    for camera, R, (map_u, map_v) in ((rig.cam0, done.R_rect_cam0, done.map0), (rig.cam1, done.R_rect_cam1, done.map1)):
        assert map_u.min() > -0.6, "pixels from outside the image"
        assert map_u.max() < camera.width - 0.4
        assert map_v.min() > -0.6
        assert map_v.max() < camera.height - 0.4
        v, u = np.mgrid[0 : camera.height : 37, 0 : camera.width : 41]
        raw = np.stack([map_u[v, u], map_v[v, u]], axis=-1).reshape(-1, 2)
        back, valid = rectify_pixels(camera, R, done.camera, raw)
        assert valid.all()
        np.testing.assert_allclose(back, np.stack([u, v], axis=-1).reshape(-1, 2), atol=2e-3)


def test_a_rectified_rig_is_unchanged() -> None:
    rig = small_rig()
    done = rectify(rig)
    np.testing.assert_allclose(done.R_rect_cam0, np.eye(3), atol=1e-12)
    assert done.camera.fu == pytest.approx(rig.cam0.fu)
    assert done.camera.cu == pytest.approx(rig.cam0.cu)
    assert done.camera.cv == pytest.approx(rig.cam0.cv)


def test_rotations_agree_with_opencv() -> None:
    """OpenCV splits the rotation between the cameras differently, which leaves a rotation about the baseline."""
    rig = euroc_like_rig()
    R_rect_cam0, R_rect_cam1, baseline = rectifying_rotations(rig)
    T_cam1_cam0 = se3_inverse(rig.T_cam0_cam1)
    R1, R2, *_ = cv2.stereoRectify(
        rig.cam0.K,
        np.array([rig.cam0.coefficients]),
        rig.cam1.K,
        np.array([rig.cam1.coefficients]),
        (752, 480),
        np.ascontiguousarray(T_cam1_cam0[:3, :3]),
        np.ascontiguousarray(T_cam1_cam0[:3, 3:]),
    )
    for ours, theirs in ((R_rect_cam0, R1), (R_rect_cam1, R2)):
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-6)
    turn = R_rect_cam0 @ R1.T
    np.testing.assert_allclose(turn, R_rect_cam1 @ R2.T, atol=1e-6)
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 0.5
    assert baseline == pytest.approx(0.11007784, abs=1e-6)


def test_rejects_invalid_rigs() -> None:
    rig = euroc_like_rig()
    swapped = replace(rig, T_imu_cam0=rig.T_imu_cam1, T_imu_cam1=rig.T_imu_cam0)
    with pytest.raises(CalibrationError, match="swapped"):
        rectify(swapped)
    with pytest.raises(CalibrationError, match="baseline is zero"):
        rectify(replace(rig, T_imu_cam1=rig.T_imu_cam0))
    behind = rig.T_imu_cam0 @ se3_from_parts(so3_exp([0, np.pi, 0]), [0.1, 0, 0])
    with pytest.raises(CalibrationError, match=r"opposite directions|rotate the"):
        rectify(replace(rig, T_imu_cam1=behind))
    aside = rig.T_imu_cam0 @ se3_exp([0.1, 0, 0, 0, 1.4, 0])
    with pytest.raises(CalibrationError, match=r"share no field of view|rotate the"):
        rectify(replace(rig, T_imu_cam1=aside))
