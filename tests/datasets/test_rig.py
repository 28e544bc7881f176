"""The rig of a recording or a caller: built from matrices, read from the calibration files that
people have.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

import vio
from tests.euroc_maker import EQUIDISTANT_RIG, RADTAN_RIG, calib_cam_to_cam, make_euroc, rigid_text
from vio.cameras.rig import Rig, remap
from vio.datasets.kitti import write_calibration
from vio.datasets.rigs.camera_info import CameraInfo, rig_from_camera_infos
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, StereoRig, project_point, unproject_pixel
from vio.geometry.lenses.registry import LENSES as LENS_MODELS
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_inverse, so3_exp
from vio.geometry.rectify import lookup, rectified_cameras
from vio.records import ImuDensities

LENSES = {
    "unified": CameraModel(
        660.0, 661.0, 320.0, 240.0, 640, 480, "unified", (1.4, -0.2, 0.05, 1e-3, -2e-3)
    ),
    "unified, no distortion": CameraModel(300.0, 301.0, 320.0, 240.0, 640, 480, "unified", (0.9,)),
    "double sphere": CameraModel(
        170.0, 171.0, 320.0, 240.0, 640, 480, "double_sphere", (-0.25, 0.57)
    ),
    "rational": CameraModel(
        400.0,
        401.0,
        320.0,
        240.0,
        640,
        480,
        "radtan",
        (0.3, -0.1, 1e-4, 2e-4, 0.01, 0.6, -0.12, 0.03),
    ),
}
T_CAM1_CAM0 = se3_from_parts(so3_exp([0.004, -0.006, 0.003]), [-0.11, 0.0004, -0.0006])
T_CAM0_IMU = se3_exp([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])
NOISE = ImuDensities(1.7e-4, 1.9e-5, 2e-3, 3e-3)
RIG = Rig(RADTAN_RIG.cam0, RADTAN_RIG.cam1, T_CAM1_CAM0, T_CAM0_IMU, NOISE, -0.0125)


def assert_same(a: Rig, b: Rig, atol: float = 1e-9) -> None:
    for x, y in ((a.cam0, b.cam0), (a.cam1, b.cam1)):
        assert (x.model, x.width, x.height) == (y.model, y.width, y.height)
        np.testing.assert_allclose([x.fu, x.fv, x.cu, x.cv], [y.fu, y.fv, y.cu, y.cv], atol=atol)
        np.testing.assert_allclose(x.coefficients, y.coefficients, atol=atol)
    np.testing.assert_allclose(a.T_cam1_cam0, b.T_cam1_cam0, atol=atol)
    assert (a.T_cam0_imu is None) == (b.T_cam0_imu is None)
    if a.T_cam0_imu is not None and b.T_cam0_imu is not None:
        np.testing.assert_allclose(a.T_cam0_imu, b.T_cam0_imu, atol=atol)
    assert a.imu_noise == b.imu_noise
    assert a.time_offset_s == pytest.approx(b.time_offset_s)


# --- lens models
# --------------------------------------------------------------------------------------------------


def _points() -> FloatArray:
    rng = np.random.default_rng(3)
    return rng.uniform([-0.9, -0.7, 1.0], [0.9, 0.7, 1.0], (60, 3)) * rng.uniform(0.5, 20, (60, 1))


@pytest.mark.parametrize("name", LENSES)
def test_pixels_of_every_lens_lead_back_to_their_rays(name: str) -> None:
    camera, points = LENSES[name], _points()
    uv, valid = project_point(camera, points)
    ray, found = unproject_pixel(camera, uv)
    assert valid.all()
    assert found.all()
    np.testing.assert_allclose(
        ray, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-8
    )


def test_double_sphere_with_one_centre_is_the_unified_model_in_other_parameters() -> None:
    """Usenko et al., section 2: `alpha / (1 - alpha)` is Mei's xi, and focal lengths scale by
    `1 - alpha`.
    """
    points = np.random.default_rng(4).normal(size=(200, 3))
    a, valid_a = LENS_MODELS["double_sphere"].project((0.0, 0.6), points)
    b, valid_b = LENS_MODELS["unified"].project((1.5,), points)
    np.testing.assert_array_equal(valid_a, valid_b)
    np.testing.assert_allclose(a[valid_a] * (1 - 0.6), b[valid_a], rtol=1e-12, atol=1e-12)


def test_unified_without_its_parameter_is_a_pinhole() -> None:
    points = _points()
    pinhole = CameraModel(300.0, 301.0, 320.0, 240.0, 640, 480)
    np.testing.assert_allclose(
        project_point(replace(pinhole, model="unified", coefficients=(0.0,)), points)[0],
        project_point(pinhole, points)[0],
        atol=1e-9,
    )


def test_rational_model_is_valid_up_to_its_fold() -> None:
    """Brute force along the u axis, as for the polynomial."""
    camera = CameraModel(1.0, 1.0, 0.0, 0.0, 2, 2, "radtan", (-0.3, 0.05, 0, 0, 0, 0.1, 0.02, 0.0))
    r = np.arange(1, 4000) * 1e-3
    _, valid = project_point(camera, np.column_stack([r, 0 * r, np.ones_like(r)]))
    factor = (1 - 0.3 * r**2 + 0.05 * r**4) / (1 + 0.1 * r**2 + 0.02 * r**4)
    fold = int(np.argmax(np.diff(r * factor) < 0))
    assert 500 < fold < 3900
    assert valid[: fold - 1].all()
    assert not valid[fold + 2 :].any()


def test_rejects_impossible_spheres() -> None:
    for model, coefficients, message in (
        ("unified", (-0.5,), "xi must not be negative"),
        ("double_sphere", (0.5, 1.2), "check their order"),
    ):
        with pytest.raises(CalibrationError, match=message):
            CameraModel(300, 300, 320, 240, 640, 480, model, coefficients)


# --- from matrices
# --------------------------------------------------------------------------------------------------


def test_rectified_rig_from_numbers_passes_images_through() -> None:
    rig = vio.Rig.rectified(400.0, 410.0, 320.0, 240.0, 0.12, 640, 480, T_CAM0_IMU[:3])
    assert rig.is_rectified
    assert rig.camera == replace(
        rig.camera, fu=400.0, fv=410.0, cu=320.0, cv=240.0, width=640, height=480
    )
    assert rig.camera.baseline_m == pytest.approx(0.12, abs=1e-15)
    np.testing.assert_array_equal(rig.T_rect0_imu, T_CAM0_IMU)
    left, right = np.random.default_rng(0).integers(0, 256, (2, 480, 640)).astype(np.uint8)
    same = rig.rectifier()(left, right)
    assert same[0] is left
    assert same[1] is right
    assert vio.Rig.rectified(400.0, 410.0, 320.0, 240.0, 0.12, 640, 480).T_rect0_imu is None


def test_raw_rig_from_matrices_is_rectified_as_a_recording_of_these_cameras() -> None:
    a, b = RADTAN_RIG.cam0, RADTAN_RIG.cam1
    rig = Rig.raw(
        a.K,
        b.K,
        T_CAM1_CAM0,
        a.width,
        a.height,
        model="radtan",
        distortion0=a.coefficients,
        distortion1=b.coefficients,
    )
    assert not rig.is_rectified
    rectifier = rig.rectifier()
    assert rectifier.camera == rig.camera
    expected = rectified_cameras(StereoRig(a, b, np.eye(4), se3_inverse(T_CAM1_CAM0)))
    sides = ((a, expected.R_rect_cam0), (b, expected.R_rect_cam1))
    both = [lookup(expected.camera, lens, R) for lens, R in sides]
    assert rectifier.maps is not None
    assert rig.T_rect0_imu is None
    raw = np.random.default_rng(0).integers(0, 256, (2, 480, 640)).astype(np.uint8)
    for interpolation in ("linear", "cubic", "lanczos4"):
        rectified = replace(rectifier, interpolation=interpolation)(*raw)
        for image, done, maps in zip(raw, rectified, both, strict=True):
            # by maps of floats, which OpenCV 5 does not round to 1/32 px
            again = remap(image, maps, interpolation)
            np.testing.assert_allclose(
                done.astype(int), again, rtol=0, atol=0 if cv2.__version__ < "5" else 8
            )


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: Rig.rectified(400, 400, 320, 240, -0.1, 640, 480),
            "stereo baseline must be positive, got -0.1 m",
        ),
        (lambda: Rig.rectified(0, 400, 320, 240, 0.1, 640, 480), "focal lengths must be positive"),
        (lambda: Rig.raw(np.eye(4), np.eye(3), np.eye(4), 640, 480), "K0 is no intrinsic matrix"),
        (
            lambda: Rig.raw(np.eye(3).T * 400, np.eye(3), np.eye(4), 640, 480),
            "K0 is no intrinsic matrix",
        ),
        (
            lambda: Rig.raw(
                [[400, 3, 320], [0, 400, 240], [0, 0, 1]], np.eye(3), np.eye(4), 640, 480
            ),
            "a skew of 3 px",
        ),
        (
            lambda: Rig.rectified(400, 400, 320, 240, 0.1, 640, 480, np.eye(3)),
            "T_cam0_imu: not a finite 3x4 or 4x4",
        ),
        (
            lambda: Rig.rectified(400, 400, 320, 240, 0.1, 640, 480, 2 * np.eye(4)),
            "T_cam0_imu: the last row of the transform is",
        ),
        (
            lambda: replace(RIG, T_cam1_cam0=np.diag([1.0, 1, -1, 1])),
            "T_cam1_cam0: not a rotation but a reflection",
        ),
        (lambda: replace(RIG, time_offset_s=float("nan")), "give finite seconds"),
    ],
)
def test_rejects_impossible_rigs(build: Callable[[], Rig], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        build()


# --- files
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", ["radtan", "equidistant", "pinhole", "unified", "double sphere"])
def test_camchain_is_read_as_written(lens: str, tmp_path: Path) -> None:
    cameras = {
        "radtan": (RADTAN_RIG.cam0, RADTAN_RIG.cam1),
        "equidistant": (EQUIDISTANT_RIG.cam0, EQUIDISTANT_RIG.cam1),
        "pinhole": (
            CameraModel(400, 401, 320, 240, 640, 480),
            CameraModel(402, 403, 321, 241, 640, 480),
        ),
    }
    cam0, cam1 = cameras.get(lens) or (LENSES[lens], LENSES[lens])
    rig = replace(RIG, cam0=cam0, cam1=cam1)
    (tmp_path / "camchain-imucam.yaml").write_text(kalibr_text(rig))
    (tmp_path / "imu.yaml").write_text(
        "accelerometer_noise_density: 2e-3\naccelerometer_random_walk: "
        "3.0e-3\ngyroscope_noise_density: 1.7e-04\n"
        "gyroscope_random_walk: 1.9e-05\nrostopic: /imu0\nupdate_rate: 200.0\n"
    )
    for path in (tmp_path, tmp_path / "camchain-imucam.yaml"):
        assert_same(vio.load_rig(path), rig)


def test_what_calibrate_writes_is_read(tmp_path: Path) -> None:
    from vio.cli import main

    source = make_euroc(tmp_path / "flight", frames=4)
    assert main(["calibrate", str(source), "--out", str(tmp_path / "out"), "--json"]) == 0
    measured, given = vio.load_rig(tmp_path / "out" / "camchain-imucam.yaml"), vio.load_rig(source)
    assert_same(replace(measured, imu_noise=given.imu_noise), given)


def test_camchain_without_imu_and_with_a_third_camera(tmp_path: Path) -> None:
    chain = yaml.safe_load(kalibr_text(replace(RIG, T_cam0_imu=None)))
    chain["cam2"] = chain["cam0"]
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(chain))
    rig = vio.load_rig(tmp_path)
    assert rig.T_cam0_imu is None
    assert rig.imu_noise is None
    assert [note.split(": ", 1)[1] for note in rig.notes] == ["cam0 and cam1 are used, cam2 not"]


def test_camchain_without_the_chain_takes_the_stereo_pose_through_the_imu(tmp_path: Path) -> None:
    chain = yaml.safe_load(kalibr_text(RIG))
    del chain["cam1"]["T_cn_cnm1"]
    (tmp_path / "camchain-imucam.yaml").write_text(yaml.safe_dump(chain))
    np.testing.assert_allclose(vio.load_rig(tmp_path).T_cam1_cam0, T_CAM1_CAM0, atol=1e-12)


def test_euroc_folder_as_a_rig_is_that_of_its_reader(tmp_path: Path) -> None:
    from vio.datasets import open_dataset

    folder = make_euroc(tmp_path, rig=EQUIDISTANT_RIG)
    recording = open_dataset(folder).recording
    for path in (folder, folder / "mav0", folder / "mav0" / "cam0" / "sensor.yaml"):
        rig = vio.load_rig(path)
        np.testing.assert_allclose(rig.T_rect0_imu, recording.T_cam0_imu, atol=1e-12)
        assert rig.camera.fu == pytest.approx(recording.camera.fu, abs=1e-9)
        assert rig.imu_noise.accel_walk == 3e-3


def test_kitti_calibrations(tmp_path: Path) -> None:
    rig = Rig.rectified(700.0, 700.0, 600.0, 180.0, 0.54, 1242, 375, T_CAM0_IMU)
    write_calibration(tmp_path, rig.camera, T_CAM0_IMU)
    assert_same(vio.load_rig(tmp_path, image_size=(1242, 375)), rig)
    with pytest.raises(
        CalibrationError,
        match=r"calib\.txt: states no image size; pass image_size=\(W, H\), or .*--save-calibration",
    ):
        vio.load_rig(tmp_path)


def test_kitti_raw_calibration_is_chosen_by_the_image_size(tmp_path: Path) -> None:
    (tmp_path / "calib_cam_to_cam.txt").write_text(calib_cam_to_cam())
    assert not vio.load_rig(tmp_path).is_rectified
    rectified = vio.load_rig(tmp_path, image_size=(56, 40))
    assert rectified.camera.baseline_m == pytest.approx(0.11)
    assert rectified.T_cam0_imu is None
    with pytest.raises(
        CalibrationError, match=r"is for images of 64 x 48 \(raw\) or 56 x 40 .*, not 10 x 10"
    ):
        vio.load_rig(tmp_path, image_size=(10, 10))
    (tmp_path / "calib_velo_to_cam.txt").write_text(rigid_text(se3_inverse(T_CAM0_IMU)))
    (tmp_path / "calib_imu_to_velo.txt").write_text(rigid_text(T_CAM0_IMU @ T_CAM0_IMU))
    T = vio.load_rig(tmp_path).T_cam0_imu
    np.testing.assert_allclose(T, T_CAM0_IMU, atol=1e-9)


def opencv_matrices() -> dict[str, FloatArray]:
    """`stereoCalibrate` and `stereoRectify` of the test rig."""
    a, b = RIG.cam0, RIG.cam1
    D = [np.array([*c.coefficients, 0.0]) for c in (a, b)]
    R, T = T_CAM1_CAM0[:3, :3], T_CAM1_CAM0[:3, 3]
    R1, R2, P1, P2, *_ = cv2.stereoRectify(a.K, D[0], b.K, D[1], (a.width, a.height), R, T[:, None])
    return {
        "M1": a.K,
        "D1": D[0],
        "M2": b.K,
        "D2": D[1],
        "R": R,
        "T": T,
        "R1": R1,
        "R2": R2,
        "P1": P1,
        "P2": P2,
    }


def write_storage(path: Path, entries: dict[str, FloatArray], size: tuple[int, int] | None) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, np.atleast_2d(value))
    if size is not None:
        storage.write("image_width", size[0])
        storage.write("image_height", size[1])
    storage.release()
    return path


@pytest.mark.parametrize("name", ["stereo.yml", "stereo.xml", "calib.yml"])
def test_opencv_storage_is_read(name: str, tmp_path: Path) -> None:
    write_storage(tmp_path / name, opencv_matrices(), (64, 48))
    bare = replace(RIG, T_cam0_imu=None, imu_noise=None, time_offset_s=0.0)
    five = [replace(c, coefficients=(*c.coefficients, 0.0)) for c in (RIG.cam0, RIG.cam1)]
    assert_same(vio.load_rig(tmp_path), replace(bare, cam0=five[0], cam1=five[1]))


def test_opencv_names_of_other_scripts_and_two_files(tmp_path: Path) -> None:
    whole = opencv_matrices()
    intrinsics = {k: v for k, v in whole.items() if k[0] in "MD"}
    write_storage(tmp_path / "intrinsics.yml", intrinsics, None)
    write_storage(
        tmp_path / "extrinsics.yml", {k: v for k, v in whole.items() if k[0] not in "MD"}, None
    )
    rig = vio.load_rig(tmp_path, image_size=(64, 48))
    np.testing.assert_allclose(rig.T_cam1_cam0, T_CAM1_CAM0, atol=1e-12)
    with pytest.raises(
        CalibrationError, match=r"intrinsics\.yml: states no image size; add 'image_width: W'"
    ):
        vio.load_rig(tmp_path)
    # ORB-SLAM's names, where the pose follows from the rectification alone.
    names = {"M1": "LEFT.K", "D1": "LEFT.D", "R1": "LEFT.R", "P1": "LEFT.P"}
    names |= {"M2": "RIGHT.K", "D2": "RIGHT.D", "R2": "RIGHT.R", "P2": "RIGHT.P"}
    text = "%YAML:1.0\nLEFT.width: 64\nLEFT.height: 48\n"
    for ours, theirs in names.items():
        rows = np.atleast_2d(whole[ours])
        text += f"{theirs}: !!opencv-matrix\n  rows: {rows.shape[0]}\n  cols: {rows.shape[1]}\n  dt: d\n"
        text += f"  data: {np.ravel(rows).tolist()}\n"
    (tmp_path / "orb.yaml").write_text(text)
    np.testing.assert_allclose(
        vio.load_rig(tmp_path / "orb.yaml").T_cam1_cam0, T_CAM1_CAM0, atol=1e-9
    )


def test_opencv_rectified_matrices_alone_and_a_board_in_millimetres(tmp_path: Path) -> None:
    whole = opencv_matrices()
    path = write_storage(tmp_path / "r.yml", {k: whole[k] for k in ("P1", "P2")}, (64, 48))
    rig = vio.load_rig(path)
    assert rig.is_rectified
    assert rig.camera.baseline_m == pytest.approx(0.11, abs=1e-3)
    assert "taken to be rectified" in rig.notes[0]
    path = write_storage(tmp_path / "mm.yml", {**whole, "T": 1000 * whole["T"]}, (64, 48))
    assert (
        "T puts the cameras 110.002 m apart, if its unit is the metre; where the board was measured in millimetres"
        in vio.load_rig(path).notes[0]
    )


def test_four_opencv_coefficients_are_said_to_be_read_as_radial_and_tangential(
    tmp_path: Path,
) -> None:
    whole = {k: v[:4] if k in ("D1", "D2") else v for k, v in opencv_matrices().items()}
    path = write_storage(tmp_path / "s.yml", whole, (64, 48))
    rig = vio.load_rig(path)
    assert rig.cam0.model == "radtan"
    assert "four coefficients without a model's name are read as k1 k2 p1 p2" in rig.notes[0]
    path.write_text(path.read_text() + "distortion_model: equidistant\n")
    rig = vio.load_rig(path)
    assert rig.cam0.model == "equidistant"
    assert rig.notes == ()


def ros_yaml(K: FloatArray, D: FloatArray, R: FloatArray, P: FloatArray, name: str) -> str:
    def block(value: FloatArray, rows: int) -> str:
        return (
            f"\n  rows: {rows}\n  cols: {value.size // rows}\n  data: {np.ravel(value).tolist()}\n"
        )

    return (
        f"image_width: 64\nimage_height: 48\ncamera_name: {name}\ncamera_matrix:{block(K, 3)}"
        f"distortion_model: plumb_bob\ndistortion_coefficients:{block(D, 1)}"
        f"rectification_matrix:{block(R, 3)}projection_matrix:{block(P, 3)}"
    )


def write_ros_pair(folder: Path) -> Path:
    m = opencv_matrices()
    (folder / "left.yaml").write_text(ros_yaml(m["M1"], m["D1"], m["R1"], m["P1"], "left"))
    (folder / "right.yaml").write_text(ros_yaml(m["M2"], m["D2"], m["R2"], m["P2"], "right"))
    return folder


def test_ros_pair_is_read(tmp_path: Path) -> None:
    write_ros_pair(tmp_path)
    for path in (tmp_path, tmp_path / "left.yaml", tmp_path / "right.yaml"):
        rig = vio.load_rig(path)
        np.testing.assert_allclose(rig.T_cam1_cam0, T_CAM1_CAM0, atol=1e-9)
        assert rig.cam1.coefficients[:4] == RIG.cam1.coefficients


def test_a_projection_that_was_computed_in_single_precision_is_one(tmp_path: Path) -> None:
    m = opencv_matrices()
    P = m["P2"].copy()
    P[1, 0] = -2e-5  # of products whose terms are hundreds of pixels
    P[2, :3] += [3e-8, -6e-8, 1.2e-7]
    write_ros_pair(tmp_path)
    (tmp_path / "right.yaml").write_text(ros_yaml(m["M2"], m["D2"], m["R2"], P, "right"))
    np.testing.assert_allclose(vio.load_rig(tmp_path).T_cam1_cam0, T_CAM1_CAM0, atol=1e-6)


BOOFCV = """<boofcv.struct.calib.StereoParameters>
  <left><cx>156.2</cx><cy>123.7</cy><flipY>false</flipY><fx>262.3</fx><fy>263.4</fy><height>240</height>
    <radial><double>-0.36</double><double>0.17</double></radial><skew>0.0</skew><width>320</width></left>
  <right><cx>159.2</cx><cy>122.9</cy><flipY>false</flipY><fx>263.2</fx><fy>264.3</fy><height>240</height>
    <radial><double>-0.35</double><double>0.16</double></radial><skew>0.0</skew><width>320</width></right>
  <rightToLeft><r><data>{data}</data><numCols>3</numCols><numRows>3</numRows></r>
    <t><x>{x}</x><y>{y}</y><z>{z}</z></t></rightToLeft>
</boofcv.struct.calib.StereoParameters>"""


def test_boofcv_is_read(tmp_path: Path) -> None:
    T = se3_inverse(T_CAM1_CAM0)
    data = "".join(f"<double>{x!r}</double>" for x in np.ravel(T[:3, :3]).tolist())
    x, y, z = T[:3, 3].tolist()
    (tmp_path / "stereo.xml").write_text(BOOFCV.format(data=data, x=x, y=y, z=z))
    rig = vio.load_rig(tmp_path)
    np.testing.assert_allclose(rig.T_cam1_cam0, T_CAM1_CAM0, atol=1e-12)
    assert rig.cam0.coefficients == (-0.36, 0.17, 0.0, 0.0)


# --- read in silence before
# ------------------------------------------------------------------------------------------------


def test_fisheye_without_distortion_is_no_pinhole(tmp_path: Path) -> None:
    """An ideal fisheye, as simulators publish it; 27 % off at 45 degrees as a pinhole."""
    write_ros_pair(tmp_path)
    for name in ("left.yaml", "right.yaml"):
        text = (tmp_path / name).read_text().replace("plumb_bob", "equidistant")
        lines = text.split("distortion_coefficients:")
        zeros = "\n  rows: 1\n  cols: 4\n  data: [0.0, 0.0, 0.0, 0.0]\nrectification"
        (tmp_path / name).write_text(
            lines[0] + "distortion_coefficients:" + zeros + lines[1].split("rectification", 1)[1]
        )
    rig = vio.load_rig(tmp_path)
    assert [c.model for c in rig.cameras] == ["equidistant"] * 2
    at_45_deg = project_point(rig.cam0, [1.0, 0.0, 1.0])[0][0]
    assert at_45_deg - rig.cam0.cu == pytest.approx(np.pi / 4 * rig.cam0.fu)


def test_printed_camera_info_is_read_as_the_file(tmp_path: Path) -> None:
    """As `ros2 topic echo --once /left/camera_info` prints it."""
    m = opencv_matrices()
    for side, k in (("left", 1), ("right", 2)):
        values = {"d": m[f"D{k}"], "k": m[f"M{k}"], "r": m[f"R{k}"], "p": m[f"P{k}"]}
        text = "header:\n  frame_id: x\nheight: 48\nwidth: 64\ndistortion_model: plumb_bob\n"
        text += "".join(f"{n}: {np.ravel(v).tolist()}\n" for n, v in values.items())
        text += "binning_x: 0\nbinning_y: 0\nroi:\n  x_offset: 0\n  width: 0\n  height: 0\n"
        (tmp_path / f"{side}.yaml").write_text(text)
    rig = vio.load_rig(tmp_path)
    np.testing.assert_allclose(rig.right[1], T_CAM1_CAM0, atol=1e-9)
    assert rig.cam1.coefficients[:4] == RIG.cam1.coefficients


@pytest.mark.parametrize("roi", [None, (8, 4, 48, 40)])
def test_camera_info_of_a_binned_part_describes_its_images(
    roi: tuple[int, int, int, int] | None,
) -> None:
    """A pixel u of the sensor is (u - x_offset) / binning_x, as image_geometry has it."""
    m = opencv_matrices()
    info = CameraInfo("t", 64, 48, "plumb_bob", RIG.cam0.coefficients, m["M1"], m["R1"], m["P1"])
    right = replace(
        info, D=RIG.cam1.coefficients, K=m["M2"], R=m["R2"], P=m["P2"], binning=(2, 2), roi=roi
    )
    infos = [replace(info, binning=(2, 2), roi=roi), right]
    x, y, width, height = roi or (0, 0, 64, 48)
    whole = rig_from_camera_infos([info, replace(right, binning=(1, 1), roi=None)])
    rig = rig_from_camera_infos(infos, image_size=(width // 2, height // 2))
    np.testing.assert_allclose(rig.right[1], T_CAM1_CAM0, atol=1e-9)
    for found, full in zip(rig.cameras, whole.cameras, strict=True):
        assert (found.width, found.height) == (width // 2, height // 2)
        at = project_point(full, [0.1, 0.2, 1.0])[0]
        part = (at - (x, y)) / 2
        np.testing.assert_allclose(project_point(found, [0.1, 0.2, 1.0])[0], part, atol=1e-9)
    same = rig_from_camera_infos(infos, image_size=(64, 48))
    assert same.cam0 == whole.cam0, "images of the whole sensor are neither binned nor a part"


@pytest.mark.parametrize("binning", [(1, 1), (2, 2)])
def test_rectified_images_keep_their_own_principal_points(binning: tuple[int, int]) -> None:
    """As of cameras rectified without CALIB_ZERO_DISPARITY: each has a P of its own."""
    P_left = np.array([[400.0, 0, 320, 0], [0, 400, 240, 0], [0, 0, 1, 0]])
    P_right = np.array([[400.0, 0, 330, -48], [0, 400, 240, 0], [0, 0, 1, 0]])
    left = CameraInfo("t", 640, 480, "", (), P_left[:, :3], np.eye(3), P_left, binning)
    right = replace(left, K=P_right[:, :3], P=P_right)
    size = (640 // binning[0], 480 // binning[1])
    rig = rig_from_camera_infos([left, right], rectified=True, image_size=size)
    assert not rig.is_rectified
    point = np.array([1.0, 0.5, 8.0])
    in_right = rig.right[1] @ [*point, 1.0]
    for camera, in_camera, P in zip(
        rig.cameras, (point, in_right[:3]), (P_left, P_right), strict=True
    ):
        shown = P @ [*point, 1.0]
        pixel = project_point(camera, in_camera)[0]
        np.testing.assert_allclose(pixel, shown[:2] / shown[2] / binning, atol=1e-9)
    alike = replace(right, P=P_right - [[0, 0, 10, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    assert rig_from_camera_infos([left, alike], rectified=True, image_size=size).is_rectified


def test_halved_images_of_a_calibration_without_a_size_are_doubted(tmp_path: Path) -> None:
    camera = Rig.rectified(400.0, 400.0, 305.0, 250.0, 0.12, 640, 480).camera
    write_calibration(tmp_path, camera, None)
    assert vio.load_rig(tmp_path, image_size=(640, 480)).notes == ()
    (note,) = vio.load_rig(tmp_path, image_size=(384, 288)).notes
    assert "the middle of images of about 610 x 500 pixels, not of 384 x 288" in note
    (note,) = vio.load_rig(tmp_path, image_size=(640, 360)).notes
    assert "if they were cropped, subtract what was cut" in note
    with pytest.raises(CalibrationError, match="principal point 305, 250 lies outside images"):
        vio.load_rig(tmp_path, image_size=(320, 240))


def test_opencv_matrices_with_a_model_that_opencv_lacks_keep_its_coefficients(
    tmp_path: Path,
) -> None:
    """Of other tools, which write the same form."""
    m = opencv_matrices()
    path = write_storage(
        tmp_path / "stereo.yml",
        {**m, "D1": np.array([0.93]), "D2": np.array([0.92])},
        (RIG.cam0.width, RIG.cam0.height),
    )
    path.write_text(path.read_text() + "distortion_model: fov\n")
    rig = vio.load_rig(path)
    assert [(c.model, c.coefficients) for c in rig.cameras] == [("fov", (0.93,)), ("fov", (0.92,))]


# Twice the principal point over the size of the images, of real cameras.
_REAL_CENTRES = {
    "KITTI 03": (0.982, 0.922),
    "KITTI 06": (0.982, 0.990),
    "KITTI raw, left": (0.991, 0.911),
    "Karlsruhe": (0.946, 1.044),
    "EuRoC, rectified": (0.969, 1.059),
    "EuRoC, right": (1.011, 1.063),
    "TUM-VI": (0.987, 0.997),
    "Bumblebee 2": (0.976, 1.031),
}


@pytest.mark.parametrize("name", _REAL_CENTRES)
@pytest.mark.parametrize(("scale", "doubted"), [(1.0, False), (0.8, True), (1.25, True)])
def test_scaled_images_of_real_cameras_are_doubted(
    name: str, scale: float, doubted: bool, tmp_path: Path
) -> None:
    u, v = 0.5 * np.array(_REAL_CENTRES[name]) * (1000, 600)
    write_calibration(tmp_path, Rig.rectified(700.0, 700.0, u, v, 0.12, 1000, 600).camera, None)
    size = (round(1000 * scale), round(600 * scale))
    notes = vio.load_rig(tmp_path, image_size=size).notes
    assert any("if they were scaled" in note for note in notes) == doubted


@pytest.mark.parametrize(
    ("scale", "doubted"), [(0.93, True), (0.97, False), (1.03, False), (1.07, True)]
)
def test_images_scaled_by_a_fifteenth_are_doubted(
    scale: float, doubted: bool, tmp_path: Path
) -> None:
    write_calibration(tmp_path, Rig.rectified(700.0, 700.0, 500, 300, 0.12, 1000, 600).camera, None)
    size = (round(1000 * scale), round(600 * scale))
    (note,) = vio.load_rig(tmp_path, image_size=size).notes
    assert ("doubtful" in note) == doubted


def test_principal_point_outside_stated_images_is_refused(tmp_path: Path) -> None:
    make = _camchain(lambda c: c["cam1"].update(intrinsics=[40.0, 40.0, 70.0, 24.0]))
    with pytest.raises(CalibrationError, match="principal point 70, 24 lies outside images"):
        vio.load_rig(make(tmp_path))


def test_translation_in_squares_of_the_board_is_doubted(tmp_path: Path) -> None:
    """OpenCV's own sample writes squares of 1; here they are of 25 mm."""
    whole = opencv_matrices()
    path = write_storage(tmp_path / "s.yml", {**whole, "T": 40 * whole["T"]}, (64, 48))
    (note,) = vio.load_rig(path).notes
    assert "4.40009 m apart" in note
    assert "which makes 0.11 m of squares of 25 mm" in note
    path = write_storage(tmp_path / "m.yml", {**whole, "T": 5 * whole["T"]}, (64, 48))
    assert vio.load_rig(path).notes == (), "0.55 m is a car's"


def test_pose_of_the_camera_on_the_imu_is_taken_as_its_inverse(tmp_path: Path) -> None:
    def turn(chain: dict[str, dict[str, object]]) -> None:
        for name in ("cam0", "cam1"):
            T = np.array(chain[name].pop("T_cam_imu"))
            chain[name]["T_imu_cam"] = se3_inverse(T).tolist()

    assert_same(vio.load_rig(_camchain(turn)(tmp_path)), replace(RIG, imu_noise=None))

    def contradict(chain: dict[str, dict[str, object]]) -> None:
        chain["cam0"]["T_imu_cam"] = np.array(chain["cam0"]["T_cam_imu"]).tolist()

    with pytest.raises(CalibrationError, match="T_cam_imu is not the inverse of T_imu_cam"):
        vio.load_rig(_camchain(contradict)(tmp_path))


def test_one_file_of_a_pair_is_said_to_be_one_camera(tmp_path: Path) -> None:
    write_ros_pair(tmp_path)
    (tmp_path / "left.yaml").unlink()
    (note,) = vio.load_rig(tmp_path / "right.yaml").notes
    assert "is read as one camera, and seems to be one of a pair" in note
    assert vio.load_rig(tmp_path / "right.yaml", cameras=1).notes == ()


def test_first_two_of_three_cameras_are_the_pair(tmp_path: Path) -> None:
    write_ros_pair(tmp_path)
    shutil.copy(tmp_path / "right.yaml", tmp_path / "cam2.yaml")
    (tmp_path / "left.yaml").rename(tmp_path / "cam0.yaml")
    (tmp_path / "right.yaml").rename(tmp_path / "cam1.yaml")
    np.testing.assert_allclose(vio.load_rig(tmp_path).right[1], T_CAM1_CAM0, atol=1e-9)


@pytest.mark.parametrize("names", [("cam_l", "cam_r"), ("ost_1", "ost_2"), ("CamLeft", "CamRight")])
def test_pairs_of_ros_files_by_other_names(names: tuple[str, str], tmp_path: Path) -> None:
    write_ros_pair(tmp_path)
    for old, new in zip(("left", "right"), names, strict=True):
        (tmp_path / f"{old}.yaml").rename(tmp_path / f"{new}.yaml")
    for path in (tmp_path, tmp_path / f"{names[1]}.yaml"):
        np.testing.assert_allclose(vio.load_rig(path).right[1], T_CAM1_CAM0, atol=1e-9)


def test_projections_with_centres_of_their_own_are_those_of_two_pinholes(tmp_path: Path) -> None:
    """As stereoRectify gives them without CALIB_ZERO_DISPARITY."""
    P0 = np.array([[40.0, 0, 32, 0], [0, 40, 24, 0], [0, 0, 1, 0]])
    P1 = np.array([[40.0, 0, 35, -8], [0, 40, 24, 0], [0, 0, 1, 0]])
    rig = vio.load_rig(write_storage(tmp_path / "p.yml", {"P1": P0, "P2": P1}, (64, 48)))
    point = np.array([1.0, 0.5, 8.0, 1.0])
    for camera, in_camera, P in zip(
        rig.cameras, (point, rig.right[1] @ point), (P0, P1), strict=True
    ):
        shown = P @ point
        np.testing.assert_allclose(project_point(camera, in_camera[:3])[0], shown[:2] / shown[2])
    P1[1, 2] = 26.0
    with pytest.raises(CalibrationError, match="differ in focal length or in cy"):
        vio.load_rig(write_storage(tmp_path / "q.yml", {"P1": P0, "P2": P1}, (64, 48)))


def test_projections_may_have_fewer_digits_than_each_other(tmp_path: Path) -> None:
    P0 = np.array([[435.2046959714599, 0, 32, 0], [0, 435.2046959714599, 24, 0], [0, 0, 1, 0]])
    P1 = np.array(
        [[435.2046959715, 0, 32.0000000001, -8], [0, 435.2046959715, 24, 0], [0, 0, 1, 0]]
    )
    rig = vio.load_rig(write_storage(tmp_path / "p.yml", {"P1": P0, "P2": P1}, (64, 48)))
    assert rig.cam0 == rig.right[0]


def test_a_calibration_is_found_beside_arrays_of_a_recording(tmp_path: Path) -> None:
    for k in range(50):
        np.savez(tmp_path / f"depth_{k}.npz", k1=np.zeros(()), k2=np.zeros(()))
    write_storage(tmp_path / "ours.yml", opencv_matrices(), (64, 48))
    np.testing.assert_allclose(vio.load_rig(tmp_path).cam0.K, RIG.cam0.K)


def test_vertical_pairs_are_called_that(tmp_path: Path) -> None:
    down = replace(RIG, T_cam1_cam0=se3_from_parts(np.eye(3), [0.001, -0.2, 0.0]))
    with pytest.raises(CalibrationError, match=r"a vertical pair: the cameras are 0\.2 m apart"):
        down.rectifier()
    P0 = np.array([[40.0, 0, 32, 0], [0, 40, 24, 0], [0, 0, 1, 0]])
    P1 = P0.copy()
    P1[1, 3] = -8.0
    path = write_storage(tmp_path / "p.yml", {"P1": P0, "P2": P1}, (64, 48))
    with pytest.raises(CalibrationError, match="a vertical pair"):
        vio.load_rig(path)


def test_camchain_beside_the_yaml_of_another_tool(tmp_path: Path) -> None:
    path = _camchain(lambda c: None)(tmp_path)
    (tmp_path / "euroc_imu_orb.yaml").write_text("%YAML:1.0\na: 1\n  b:[1, 2\nViewer.Size:2\n")
    assert_same(vio.load_rig(path), replace(RIG, imu_noise=None))


def test_yaml_as_opencv_alone_reads_it(tmp_path: Path) -> None:
    path = write_storage(tmp_path / "s.yml", opencv_matrices(), (64, 48))
    text = path.read_text().replace("data: [", "data:[").replace("image_width: ", "image_width:")
    assert "data:[" in text
    path.write_text(text + "Viewer.PointSize:2\n")
    np.testing.assert_allclose(vio.load_rig(path).right[1], T_CAM1_CAM0, atol=1e-12)


def test_boofcv_with_capital_letters_and_a_calibration_in_xml(tmp_path: Path) -> None:
    T = se3_inverse(T_CAM1_CAM0)
    data = "".join(f"<double>{x!r}</double>" for x in np.ravel(T[:3, :3]).tolist())
    x, y, z = T[:3, 3].tolist()
    text = BOOFCV.format(data=data, x=x, y=y, z=z)
    for small, capital in (("<r>", "<R>"), ("</r>", "</R>"), ("<t>", "<T>"), ("</t>", "</T>")):
        text = text.replace(small, capital)
    (tmp_path / "calib.xml").write_text(text)
    np.testing.assert_allclose(vio.load_rig(tmp_path).right[1], T_CAM1_CAM0, atol=1e-12)


# --- bad files
# --------------------------------------------------------------------------------------------------


def _camchain(change: Callable[[dict[str, dict[str, object]]], object]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        chain = yaml.safe_load(kalibr_text(RIG))
        change(chain)
        (folder / "camchain.yaml").write_text(yaml.safe_dump(chain))
        return folder / "camchain.yaml"

    return make


def _text(name: str, text: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_text(text, encoding="utf-8")
        return folder / name

    return make


def _storage(**change: FloatArray | None) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        whole = {k: v for k, v in (opencv_matrices() | change).items() if v is not None}
        return write_storage(folder / "stereo.yml", whole, (64, 48))

    return make


def _swapped_ros(folder: Path) -> Path:
    write_ros_pair(folder)
    shutil.move(folder / "left.yaml", folder / "spare.yaml")
    shutil.move(folder / "right.yaml", folder / "left.yaml")
    return Path(shutil.move(folder / "spare.yaml", folder / "right.yaml"))


def _turned_projection(side: str) -> FloatArray:
    """P (3, 4) of a camera as ROS's camera_calibration writes it for fisheye cameras."""
    m = opencv_matrices()
    return np.column_stack([m["M" + side] @ m["R" + side], m["P" + side][:, 3]])


def _ros_with_turned_projections(folder: Path) -> Path:
    m = opencv_matrices()
    for name, side in (("left", "1"), ("right", "2")):
        K, D, R = (m[key + side] for key in "MDR")
        (folder / f"{name}.yaml").write_text(ros_yaml(K, D, R, _turned_projection(side), name))
    return folder


def _ros_with_a_transposed_projection(folder: Path) -> Path:
    m = opencv_matrices()
    projection = np.column_stack([m["P2"][:, :3].T, m["P2"][:, 3]])
    write_ros_pair(folder)
    (folder / "right.yaml").write_text(ros_yaml(m["M2"], m["D2"], m["R2"], projection, "right"))
    return folder


def _lonely_ros(folder: Path) -> Path:
    (write_ros_pair(folder) / "right.yaml").unlink()
    return folder / "left.yaml"


BAD = {
    "no such file": (
        lambda f: f / "none.yaml",
        r"none\.yaml does not exist; give Kalibr's camchain",
    ),
    "empty folder": (lambda f: f, "holds no calibration; looked for Kalibr's"),
    "another YAML file": (
        _text("a.yaml", "colour: green\n"),
        "is no calibration of a known format",
    ),
    "no YAML": (_text("a.yaml", "cam0: [1, 2\n"), "not a YAML file"),
    "a list": (_text("a.yaml", "- 1\n- 2\n"), "holds no calibration"),
    "YAML with tags": (
        _text("a.yaml", "cam0: !!python/object/apply:os.system ['ls']\n"),
        "write plain numbers",
    ),
    "deeply nested YAML": (_text("a.yaml", "a: " + "[" * 1200 + "]" * 1200), "not a YAML file"),
    "binary": (_text("a.yaml", "\0\1\2"), "not a YAML file"),
    "one camera": (
        _camchain(lambda c: c.pop("cam1")),
        "is the calibration of one camera; name the pair",
    ),
    "no pose": (
        _camchain(lambda c: (c["cam1"].pop("T_cn_cnm1"), c["cam1"].pop("T_cam_imu"))),
        "states no pose of cam1; add T_cn_cnm1",
    ),
    "no resolution": (
        _camchain(lambda c: c["cam0"].pop("resolution")),
        "cam0: has no entry 'resolution'",
    ),
    "three intrinsics": (
        _camchain(lambda c: c["cam0"].update(intrinsics=[1, 2, 3])),
        r"cam0: 'intrinsics' is \[1, 2, 3\] instead of 4 finite numbers",
    ),
    "unknown projection": (
        _camchain(lambda c: c["cam1"].update(camera_model="ocam")),
        "'ocam' is not read",
    ),
    "unknown distortion": (
        _camchain(lambda c: c["cam1"].update(distortion_model="thin-prism")),
        "'thin-prism' is not read",
    ),
    "a reflection": (
        _camchain(lambda c: c["cam1"].update(T_cn_cnm1=np.diag([1.0, 1, -1, 1]).tolist())),
        "T_cn_cnm1: not a rotation but a reflection",
    ),
    "text for a number": (
        _camchain(lambda c: c["cam0"].update(distortion_coeffs=["a", 0, 0, 0])),
        "'distortion_coeffs' is .* instead of finite numbers",
    ),
    "intrinsics of zero": (
        _camchain(lambda c: c["cam0"].update(intrinsics=[0, 400, 320, 240])),
        "focal lengths and image size must be positive",
    ),
    "notes as .txt": (
        _text("notes.txt", "fx=458 b=0.11\n"),
        "notes.txt: is no calibration of a known format",
    ),
    "OpenCV without T": (_storage(T=None, R2=None), "has no T, the pose of the right camera"),
    "OpenCV with a rotation vector": (_storage(R=np.zeros((3, 1))), "R holds 3 numbers"),
    "OpenCV with the projection of ROS's fisheye pairs": (
        _storage(R=None, T=None, P2=_turned_projection("2")),
        "P2 holds K R, which camera_calibration writes for fisheye cameras, in the place",
    ),
    "OpenCV of larger images": (
        _storage(M2=np.array([[400.0, 0, 70], [0, 400, 24], [0, 0, 1]])),
        "the principal point 70, 24 lies outside images of 64 x 48 pixels; it is the calibration "
        "of images of another",
    ),
    "OpenCV with six coefficients": (
        _storage(D1=np.ones(6)),
        "6 distortion coefficients; OpenCV has 4, 5",
    ),
    "OpenCV with a tilted sensor": (
        _storage(D1=np.ones(14)),
        "thin-prism or tilt coefficients are not read",
    ),
    "XML with entities": (
        _text("stereo.xml", '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>'),
        "declares entities",
    ),
    "no XML": (_text("stereo.xml", "<a><b></a>"), "not an XML file"),
    "half of BoofCV": (
        _text("stereo.xml", "<x.StereoParameters><left/></x.StereoParameters>"),
        "finite numbers|no entry",
    ),
    "ROS, one file": (_lonely_ros, "is the calibration of one camera; name the pair"),
    "ROS, swapped": (_swapped_ros, "P gives a stereo baseline of -0.11"),
    "ROS, fisheye": (
        _ros_with_turned_projections,
        "P holds K R, which camera_calibration writes for fisheye cameras, in the place",
    ),
    "ROS, transposed": (
        _ros_with_a_transposed_projection,
        r"right\.yaml: P holds a matrix that is none of a camera in the place",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_calibrations_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    make, message = BAD[name]
    with pytest.raises(CalibrationError, match=message) as caught:
        vio.load_rig(make(tmp_path), cameras=2)
    assert "\n" not in str(caught.value).strip()


def test_disagreeing_poses_of_a_camchain_are_said(tmp_path: Path) -> None:
    chain = yaml.safe_load(kalibr_text(RIG))
    chain["cam1"]["T_cam_imu"][0][3] += 0.01
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(chain))
    assert "disagree; T_cn_cnm1 is used" in vio.load_rig(tmp_path).notes[0]


# --- real data
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "baseline_m", "imu"),
    [
        ("tumvi_room1_head", 0.10095, True),
        ("boofcv_library", 0.12005, False),
        ("euroc/MH_01_head", 0.11008, True),
    ],
)
def test_real_calibrations(name: str, baseline_m: float, imu: bool, data_dir: Path) -> None:
    rig = vio.load_rig(data_dir / name)
    assert rig.camera.baseline_m == pytest.approx(baseline_m, abs=1e-5)
    assert (rig.T_cam0_imu is not None) == imu
    assert (rig.imu_noise is not None) == imu


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"path": None}, "named by one path, as text or pathlib.Path, not by NoneType"),
        ({"image_size": (375, 1242, 3)}, "give the width and the height of the images, as"),
        ({"image_size": ((375, 1242), 3)}, "give the width and the height of the images, as"),
        ({"image_size": (np.nan, 375)}, "image_size: an image of nan x 375 pixels; give whole"),
        ({"image_size": 1242}, "give the width and the height of the images, as"),
        ({"cameras": "2"}, "cameras is '2'; give 1, 2 or None"),
    ],
)
def test_names_what_a_call_gives_in_the_place_of_an_argument(
    tmp_path: Path, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(CalibrationError, match=re.escape(message)):
        vio.load_rig(**{"path": tmp_path, **arguments})


def test_names_a_rotation_and_a_translation_in_the_place_of_one_matrix() -> None:
    K = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    pair: Any = (np.eye(3), [-0.1, 0, 0])
    with pytest.raises(CalibrationError, match=r"T_cam1_cam0: .*give one matrix \[R t\]"):
        vio.Rig.raw(K, K, pair, 640, 480)
