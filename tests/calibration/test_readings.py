"""Other readings of a rig's calibration: signs, orders and models of its lenses, mirrored images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.calibration_forms import true_rig
from vio.calibration.readings import other_reading
from vio.findings import Finding
from vio.geometry.distortion import CameraModel, StereoRig, project_point
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, so3_exp
from vio.geometry.rectify import rectified_cameras, rectify_pixels
from vio.monitor.reading import ReadingCheck
from vio.records import observations

Coefficients = tuple[float, ...]
Pixels = tuple[FloatArray, FloatArray]


def _pair(model: str = "radtan") -> StereoRig:
    rig = true_rig(model)
    assert rig.cam1 is not None
    assert rig.T_cam1_cam0 is not None
    return StereoRig(rig.cam0, rig.cam1, np.eye(4), se3_inverse(rig.T_cam1_cam0))


def _raw(rig: StereoRig) -> Pixels:
    """Return where both cameras see points from half a metre on, with noise of a tenth of a pixel."""
    rng = np.random.default_rng(5)
    depth = rng.uniform(0.5, 6.0, 4000)
    tangents = rng.uniform(-1, 1, (4000, 2)) * [0.8, 0.5]
    p_cam0 = np.column_stack([tangents * depth[:, None], depth])
    T_cam1_cam0 = se3_inverse(rig.T_cam0_cam1)
    p_cam1 = p_cam0 @ T_cam1_cam0[:3, :3].T + T_cam1_cam0[:3, 3]
    seen = []
    inside = np.ones(len(depth), dtype=np.bool_)
    for camera, points in ((rig.cam0, p_cam0), (rig.cam1, p_cam1)):
        uv, ahead = project_point(camera, points)
        uv = uv + rng.normal(0, 0.1, uv.shape)
        inside &= ahead & (uv >= 0).all(axis=1) & (uv < [camera.width, camera.height]).all(axis=1)
        seen.append(uv)
    return seen[0][inside], seen[1][inside]


def _matches(rig: StereoRig, raw: Pixels) -> FloatArray:
    """Return `[ul vl ur vr]` of raw pixels, rectified by a rig."""
    made = rectified_cameras(rig)
    sides = zip((rig.cam0, rig.cam1), (made.R_rect_cam0, made.R_rect_cam1), raw, strict=True)
    (left, seen0), (right, seen1) = (rectify_pixels(c, R, made.camera, uv) for c, R, uv in sides)
    return np.hstack([left, right])[seen0 & seen1]


def _said(rig: StereoRig, raw: Pixels) -> str:
    return str(other_reading(rig, rectified_cameras(rig).camera, _matches(rig, raw)))


def _lenses(
    rig: StereoRig, change: Callable[[Coefficients], Coefficients], model: str | None = None
) -> StereoRig:
    def of(camera: CameraModel) -> CameraModel:
        coefficients = change(camera.coefficients)
        return replace(camera, coefficients=coefficients, model=model or camera.model)

    return replace(rig, cam0=of(rig.cam0), cam1=of(rig.cam1))


@pytest.mark.parametrize(
    ("change", "model", "words"),
    [
        (lambda k: tuple(-x for x in k), None, "coefficients have the other sign"),
        (lambda k: (k[0], k[2], k[3], k[1]), None, "in the order k1 p1 p2 k2"),
        (lambda k: (k[2], k[3], k[0], k[1]), None, "in the order p1 p2 k1 k2"),
        (lambda k: k, "equidistant", "distortion is radial-tangential"),
    ],
)
def test_lenses_that_are_read_wrongly_are_named(
    change: Callable[[Coefficients], Coefficients], model: str | None, words: str
) -> None:
    rig = _pair()
    assert words in _said(_lenses(rig, change, model), _raw(rig))


def test_a_fisheye_read_as_radial_is_named() -> None:
    rig = _lenses(_pair(), lambda _: (-0.1, 0.05, -0.03, 0.01), "equidistant")
    read = _lenses(rig, lambda k: k, "radtan")
    assert "distortion is equidistant (fisheye)" in _said(read, _raw(rig))


def test_images_that_are_undistorted_already_are_named() -> None:
    rig = _pair()
    plain = _lenses(rig, lambda _: (), "pinhole")
    assert "the images are undistorted already" in _said(rig, _raw(plain))


@pytest.mark.parametrize("shift_px", [0, 40], ids=["one centre", "two centres"])
def test_images_that_are_rectified_already_are_named(shift_px: float) -> None:
    rig = _pair()
    z = _matches(rig, _raw(rig))
    words = "the images are rectified already"
    assert words in _said(rig, (z[:, :2], z[:, 2:] + [shift_px, 0]))
    assert words not in _said(rig, (z[:, :2], z[:, 2:] + [0, 3]))  # or cut in another place


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda uv: uv * [1, -1] + [0, 719], "both images are flipped, top to bottom"),
        (lambda uv: [1279, 719] - uv, "both images are upside down"),
        (lambda uv: uv * [-1, 1] + [1279, 0], "both images are mirrored"),
    ],
)
def test_images_that_were_mirrored_or_turned_are_named(
    change: Callable[[FloatArray], FloatArray], words: str
) -> None:
    rig = _pair()
    left, right = _raw(rig)
    assert words in _said(rig, (change(left), change(right)))


def test_exchanged_intrinsics_and_an_inverse_rotation_are_named() -> None:
    rig = _pair()
    exchanged = replace(rig, cam0=rig.cam1, cam1=rig.cam0)
    assert "intrinsics of left and right are exchanged" in _said(exchanged, _raw(rig))
    T = rig.T_cam0_cam1
    inverse = replace(rig, T_imu_cam1=se3_from_parts(T[:3, :3].T, T[:3, 3]))
    assert "rotation between the cameras is the inverse one" in _said(inverse, _raw(rig))


@pytest.mark.parametrize("turn", [(0.02, 0, 0), (0, 0.02, 0), (0, 0, 0.02), (-0.008, 0.01, -0.006)])
def test_a_camera_that_was_moved_is_no_other_reading(turn: tuple[float, float, float]) -> None:
    rig = _pair()
    moved = replace(rig, T_imu_cam1=rig.T_imu_cam1 @ se3_from_parts(so3_exp(turn), np.zeros(3)))
    assert _said(rig, _raw(rig)) == "None"
    assert _said(moved, _raw(rig)) == "None"


def test_lenses_that_were_calibrated_a_little_wrongly_are_no_other_reading() -> None:
    rig = _pair()
    assert _said(_lenses(rig, lambda k: tuple(1.2 * x for x in k)), _raw(rig)) == "None"


def test_a_run_names_another_reading_once_rows_are_off() -> None:
    rig = _pair()
    read = _lenses(rig, lambda k: tuple(-x for x in k))
    z = _matches(read, _raw(rig))
    off = Finding("stereo-calibration-off", "rows differ", 0, figures={"rows_rms_px": 1.0})

    def findings_of(known: list[Finding]) -> list[Finding]:
        check = ReadingCheck(read, rectified_cameras(read).camera)
        found: list[Finding] = []
        for k in range(60):
            rows = slice(50 * k, 50 * k + 50)
            seen = observations(k, k, np.arange(len(z[rows])), z[rows])
            finding = check.frame(seen, [*known, *found])
            found += [] if finding is None else [finding]
        return found

    (found,) = findings_of([off])
    assert found.code == "calibration-misread"
    assert found.first_frame == 0
    assert findings_of([]) == []
