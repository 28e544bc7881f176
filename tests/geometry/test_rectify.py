"""Rectification: aligned rows, rotations that agree with OpenCV's, errors for impossible rigs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from vio.errors import CalibrationError
from vio.geometry.distortion import StereoRig, project_point
from vio.geometry.lie import se3_exp, se3_from_parts, se3_inverse, so3_exp, transform_points
from vio.geometry.rectify import (
    lookup,
    pinhole_maps,
    pinhole_pixels,
    pinhole_within,
    projection_of,
    rectified_cameras,
    rectify_pixels,
    rectifying_rotations,
)
from vio.geometry.stereo import Projection, left_rays, project
from vio.sim.rigs import euroc_like_rig, fisheye_rig, kitti_like_rig, small_rig, wide_rig

RIGS = {
    "radtan": euroc_like_rig,
    "equidistant": fisheye_rig,
    "rectified": small_rig,
    "cylinder": wide_rig,
}


def _points_imu(rig: StereoRig, n: int, *, around: bool = False) -> np.ndarray:
    rng = np.random.default_rng(0)
    direction = np.column_stack(
        [rng.uniform(-0.5, 0.5, n), rng.uniform(-0.35, 0.35, n), np.ones(n)]
    )
    if around:  # the baseline, up to 75 degrees above and below
        azimuth = rng.uniform(-1.3, 1.3, n)
        direction[:, 1:] = np.column_stack([np.sin(azimuth), np.cos(azimuth)])
    return transform_points(rig.T_imu_cam0, direction * rng.uniform(0.8, 30, (n, 1)))


@pytest.mark.parametrize("name", RIGS)
def test_rectified_raw_pixels_equal_the_rectified_projection(name: str) -> None:
    """The whole chain against the stereo model: distort, undistort, rotate; rows agree and so
    does the disparity.
    """
    rig = RIGS[name]()
    done = rectified_cameras(rig, "auto")
    points = _points_imu(rig, 300, around=name == "cylinder")
    expected = project(done.camera, transform_points(done.T_rect0_imu, points))
    for camera, T_imu_cam, R, columns in (
        (rig.cam0, rig.T_imu_cam0, done.R_rect_cam0, [0, 1]),
        (rig.cam1, rig.T_imu_cam1, done.R_rect_cam1, [2, 3]),
    ):
        raw, seen = project_point(camera, transform_points(se3_inverse(T_imu_cam), points))
        rectified, valid = rectify_pixels(camera, R, done.camera, raw)
        assert seen.mean() > 0.9
        np.testing.assert_allclose(
            rectified[seen & valid], expected[seen & valid][:, columns], atol=1e-5
        )


@pytest.mark.parametrize("name", RIGS)
def test_maps_are_the_inverse_of_rectifying_pixels(name: str) -> None:
    rig = RIGS[name]()
    done = rectified_cameras(rig, "auto")
    for camera, R in ((rig.cam0, done.R_rect_cam0), (rig.cam1, done.R_rect_cam1)):
        map_u, map_v = lookup(done.camera, camera, R)
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
    done = rectified_cameras(rig)
    np.testing.assert_allclose(done.R_rect_cam0, np.eye(3), atol=1e-12)
    assert done.camera.fu == pytest.approx(rig.cam0.fu)
    assert done.camera.cu == pytest.approx(rig.cam0.cu)
    assert done.camera.cv == pytest.approx(rig.cam0.cv)


def test_rotations_agree_with_opencv() -> None:
    """OpenCV splits the rotation between the cameras differently, which leaves a rotation about
    the baseline.
    """
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
        rectified_cameras(swapped)
    with pytest.raises(CalibrationError, match="baseline is zero"):
        rectified_cameras(replace(rig, T_imu_cam1=rig.T_imu_cam0))
    behind = rig.T_imu_cam0 @ se3_from_parts(so3_exp([0, np.pi, 0]), [0.1, 0, 0])
    with pytest.raises(CalibrationError, match=r"opposite directions|rotate the"):
        rectified_cameras(replace(rig, T_imu_cam1=behind))
    aside = rig.T_imu_cam0 @ se3_exp([0.1, 0, 0, 0, 1.4, 0])
    with pytest.raises(CalibrationError, match=r"share no field of view|rotate the"):
        rectified_cameras(replace(rig, T_imu_cam1=aside))


@pytest.mark.parametrize(
    ("rig", "expected"),
    [
        (wide_rig, "cylinder"),
        (fisheye_rig, "pinhole"),
        (euroc_like_rig, "pinhole"),
        (kitti_like_rig, "pinhole"),
    ],
)
def test_only_lenses_that_a_pinhole_would_crop_above_and_below_get_a_cylinder(
    rig: Callable[[], StereoRig], expected: Projection
) -> None:
    assert projection_of(rig()) == expected
    assert rectified_cameras(rig(), "auto").camera.projection == expected
    assert rectified_cameras(rig()).camera.projection == "pinhole"


def test_a_cylinder_keeps_more_of_a_wide_lens_at_no_lower_resolution() -> None:
    rig = wide_rig()
    pinhole, cylinder = (
        rectified_cameras(rig, "pinhole").camera,
        rectified_cameras(rig, "cylinder").camera,
    )
    assert (cylinder.width, cylinder.height) == (rig.cam0.width, rig.cam0.height)
    assert cylinder.fu >= max(pinhole.fu, rig.cam0.fu)
    up, down = (left_rays(cylinder, [[cylinder.cu, v]])[0] for v in (0.0, 511.0))
    assert np.degrees(np.arctan2(down[1], down[2]) - np.arctan2(up[1], up[2])) > 145
    assert 2 * np.degrees(np.arctan(pinhole.height / 2 / pinhole.fv)) < 110


def test_a_cylinder_becomes_the_pinhole_inside_it() -> None:
    """For programs that know no cylinder: pixels and images of a pinhole of the same pose,
    nothing from outside.
    """
    cylinder = rectified_cameras(wide_rig(), "cylinder").camera
    pinhole = pinhole_within(cylinder)
    assert pinhole.projection == "pinhole"
    points = _points_imu(wide_rig(), 300, around=True)
    seen, expected = project(cylinder, points), project(pinhole, points)
    uv, inside = pinhole_pixels(cylinder, pinhole, seen[:, :2])
    np.testing.assert_allclose(uv[inside], expected[inside, :2], atol=1e-6)
    assert 0.2 < inside.mean() < 0.8
    assert (points[inside, 2] > 0).all()
    u, v = pinhole_maps(cylinder, pinhole)
    assert u.min() > -0.5
    assert v.min() > -0.5
    assert u.max() < 511.5
    assert v.max() < 511.5
