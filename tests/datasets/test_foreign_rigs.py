"""Calibrations of other tools, against the rig that they state in another form."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vio
from tests import calibration_forms as forms
from tests.calibration_forms import FORMS, Form, table
from vio.cameras.rig import Rig
from vio.errors import CalibrationError

ROOT = Path(__file__).parents[2]
BEGIN = "<!-- table of formats, by tests.calibration_forms -->"


def _close(found: Rig, truth: Rig) -> None:
    for a, b in zip(found.cameras, truth.cameras, strict=True):
        assert (a.model, a.width, a.height) == (b.model, b.width, b.height)
        pixels = [[c.fu, c.fv, c.cu, c.cv] for c in (a, b)]
        np.testing.assert_allclose(pixels[0], pixels[1], atol=1e-9)
        count = max(len(a.coefficients), len(b.coefficients))
        bends = [[*c.coefficients, *[0.0] * 8][:count] for c in (a, b)]
        np.testing.assert_allclose(bends[0], bends[1], atol=1e-12)
    np.testing.assert_allclose(found.right[1], truth.right[1], atol=1e-9)
    assert (found.T_cam0_imu is None) == (truth.T_cam0_imu is None)
    if truth.T_cam0_imu is not None and found.T_cam0_imu is not None:
        np.testing.assert_allclose(found.T_cam0_imu, truth.T_cam0_imu, atol=1e-9)
    assert (found.imu_noise is None) == (truth.imu_noise is None)
    if truth.imu_noise is not None and found.imu_noise is not None:
        for name in ("gyro", "gyro_walk", "accel", "accel_walk"):
            assert getattr(found.imu_noise, name) == pytest.approx(getattr(truth.imu_noise, name))
    assert found.time_offset_s == pytest.approx(truth.time_offset_s, abs=1e-12)


@pytest.mark.parametrize("form", [f for f in FORMS if f.truth], ids=lambda f: f"{f.name} {f.files}")
def test_every_form_of_a_rig_is_read_as_that_rig(form: Form, tmp_path: Path) -> None:
    rig = vio.load_rig(form.write(tmp_path), image_size=form.known_size)
    assert form.truth is not None
    _close(rig, form.truth)


# a form, and what its file calls the lens
UNKNOWN_LENSES: dict[str, tuple[Callable[[Path], Path], str, str]] = {
    "Kalibr": (forms.kalibr, "camera_model: pinhole", "camera_model: trioptar"),
    "Kalibr's distortion": (forms.kalibr, "model: radtan", "model: trioptar"),
    "OpenVINS": (forms.openvins, "model: radtan", "model: trioptar"),
    "Kimera": (forms.kimera, "camera_model: pinhole", "camera_model: trioptar"),
    "Kimera's distortion": (forms.kimera, "radial-tangential", "trioptar"),
    "camodocal": (lambda f: forms.vins("radtan", f), "PINHOLE", "TRIOPTAR"),
    "camodocal's SCARAMUZZA": (lambda f: forms.vins("radtan", f), "PINHOLE", "SCARAMUZZA"),
    "ORB-SLAM3": (lambda f: forms.orbslam3("radtan", f), '"PinHole"', '"Trioptar"'),
    "Basalt": (lambda f: forms.basalt("eucm", f), '"eucm"', '"trioptar"'),
    "Monado": (forms.monado, "pinhole_radtan5", "trioptar"),
    "DepthAI": (forms.depthai, '"cameraType": 0', '"cameraType": 77'),
    "OKVIS": (forms.okvis, "type: radialtangential", "type: trioptar"),
    "OKVIS2": (forms.okvis2_eucm, "cam_model: eucm", "cam_model: trioptar"),
    "SVO": (forms.ncamera, "type: pinhole", "type: trioptar"),
    "SVO's distortion": (forms.ncamera, "type: radial-tangential", "type: trioptar"),
}


@pytest.mark.parametrize("tool", UNKNOWN_LENSES)
def test_a_lens_that_is_not_known_is_refused_by_its_name(tool: str, tmp_path: Path) -> None:
    write, known, other = UNKNOWN_LENSES[tool]
    path = write(tmp_path)
    changed = 0
    for file in tmp_path.iterdir():
        text = file.read_text()
        changed += known in text
        file.write_text(text.replace(known, other))
    assert changed
    name = other.split(": ")[-1].strip('"')
    with pytest.raises(CalibrationError, match=f"(?i){name}.* not (read|supported)") as found:
        vio.load_rig(path)
    assert "\n" not in str(found.value)


def test_table_of_formats_is_what_the_readers_do() -> None:
    page = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
    assert table() == page.split(BEGIN)[1].split("<!-- end -->")[0].strip()


def _scene(folder: Path, change: Callable[[list[Any]], None], lens: str = "pinhole") -> Path:
    """cuVSLAM's scene, after a change of its list of cameras."""
    path = forms.edex(
        folder, forms.rectified_rig() if lens == "pinhole" else forms.true_rig(), lens
    )
    scene = json.loads(path.read_text())
    change(scene[0]["cameras"])
    path.write_text(json.dumps(scene))
    return path


def _set(key: str, value: object) -> Callable[[list[Any]], None]:
    def change(cameras: list[Any]) -> None:
        for camera in cameras:
            camera["intrinsics"][key] = value

    return change


def test_a_scene_may_call_its_lens_fisheye4(tmp_path: Path) -> None:
    path = forms.edex(tmp_path, forms.true_rig("equidistant"), "fisheye")
    path.write_text(path.read_text().replace('"fisheye"', '"fisheye4"'))
    _close(vio.load_rig(path), forms.imu_free(forms.true_rig("equidistant")))


@pytest.mark.parametrize("model", ["pinhole", None])
def test_distortion_without_its_model_is_refused(model: str | None, tmp_path: Path) -> None:
    def change(cameras: list[Any]) -> None:
        _set("distortion_params", [-0.2, 0.05, 0, 0, 0])(cameras)
        for camera in cameras:
            del camera["intrinsics"]["distortion_model"]
            if model is not None:
                camera["intrinsics"]["distortion_model"] = model

    path = _scene(tmp_path, change)
    with pytest.raises(
        CalibrationError, match="camera 0: states distortion_params, which a pinhole"
    ):
        vio.load_rig(path)
    for none in (None, [], [0.0] * 5):
        _close(
            vio.load_rig(_scene(tmp_path, _set("distortion_params", none))),
            forms.imu_free(forms.rectified_rig()),
        )


def _third(path: Path, whole: Callable[[Any], list[Any]], change: Callable[[Any], Any]) -> None:
    data = json.loads(path.read_text())
    cameras = whole(data)
    cameras.append(change(copy.deepcopy(cameras[-1])))
    path.write_text(json.dumps(data))


def test_a_third_camera_is_not_read(tmp_path: Path) -> None:
    def ftheta(camera: Any) -> Any:
        camera["intrinsics"]["distortion_model"] = "ftheta"
        return camera

    path = _scene(tmp_path, lambda cameras: None)
    _third(path, lambda data: data[0]["cameras"], ftheta)
    rig = vio.load_rig(path)
    _close(rig, forms.imu_free(forms.rectified_rig()))
    assert any("of 3 cameras the first two are used" in note for note in rig.notes)
    path = forms.spectacular(tmp_path)
    _third(path, lambda data: data["cameras"], lambda camera: {**camera, "model": "ftheta"})
    assert any(
        "of 3 cameras the first two" in note
        for note in vio.load_rig(path, image_size=forms.SIZE).notes
    )
    path = forms.basalt("eucm", tmp_path) / "calibration.json"
    value = json.loads(path.read_text())["value0"]
    for key in ("T_imu_cam", "intrinsics", "resolution"):
        value[key].append(None)
    path.write_text(json.dumps({"value0": value}))
    assert any(
        "of 3 cameras the first two" in note
        for note in vio.load_rig(path, image_size=forms.SIZE).notes
    )


@pytest.mark.parametrize("item", [None, 7])
def test_a_camera_that_is_no_block_is_refused(item: object, tmp_path: Path) -> None:
    for write, keys in (
        (lambda: _scene(tmp_path, lambda cameras: None), (0, "cameras")),
        (lambda: forms.spectacular(tmp_path), ("cameras",)),
        (lambda: forms.basalt("eucm", tmp_path) / "calibration.json", ("value0", "intrinsics")),
        (lambda: forms.basalt("eucm", tmp_path) / "calibration.json", ("value0", "T_imu_cam")),
    ):
        path = write()
        data = json.loads(path.read_text())
        cameras = data
        for key in keys:
            cameras = cameras[key]
        cameras[1] = item
        path.write_text(json.dumps(data))
        with pytest.raises(CalibrationError, match=f"camera 1: is {item}, no block of entries"):
            vio.load_rig(path, image_size=forms.SIZE)


@pytest.mark.parametrize("block", [False, True])
@pytest.mark.parametrize("setup", ["RGBD", "monocular"])
def test_settings_of_one_camera_are_no_stereo_rig(setup: str, block: bool, tmp_path: Path) -> None:
    path = forms.openvslam(tmp_path, block=block)
    depths = "Preprocessing: {depthmap_factor: 5000.0}" if block else "depthmap_factor: 5000.0"
    text = (
        path.read_text().replace("setup: stereo", f"setup: {setup}").replace("k1: 0.0", "k1: 0.26")
    )
    path.write_text(f"{text}{depths}\n")
    rig = vio.load_rig(path)
    assert len(rig.cameras) == 1
    assert rig.cam0.coefficients[0] == 0.26
    assert rig.depth_factor == (5000.0 if setup == "RGBD" else None)


@pytest.mark.parametrize("block", [False, True])
def test_intrinsics_of_open3d_are_those_of_one_camera(block: bool, tmp_path: Path) -> None:
    rig = vio.load_rig(forms.open3d(tmp_path, block=block))
    assert rig.cam0 == forms.rectified_rig().cam0
    assert rig.cam1 is None


NAMED_NUMBERS = {
    "calibration.yaml": "fx: 700.0\nfy: 700.0\ncx: 640.0\ncy: 360.0\nbaseline: 0.11\n",
    "calibration.json": '{"f": 700, "cx": 640, "cy": 360, "baseline_m": 0.11}',
    "calib.txt": "# by hand\nfx = 700\nfy = 700  # pixels\ncx = 640\ncy = 360\nbaseline_mm = 110\n",
    "camera.json": '{"intrinsic": {"fx": 700, "fy": 700, "u0": 640, "v0": 360}, '
    '"extrinsic": {"baseline": 0.11, "pitch": 0.03, "x": 1.7}}',
    "stereodemo_calibration.json": '{"width": 1280, "height": 720, "fx": 700, "fy": 700, '
    '"cx0": 640, "cx1": 640, "cy": 360, "baseline_meters": 0.11, "depth_range": [0.3, 20]}',
    "K.txt": "700 0 640 0 700 360 0 0 1\n0.11\n",
    "intrinsics.txt": "700 0 640\n0 700 360\n0 0 1\n0.11\n",
}


@pytest.mark.parametrize("name", NAMED_NUMBERS)
def test_the_numbers_of_a_rectified_pair_are_a_calibration(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(NAMED_NUMBERS[name])
    rig = vio.load_rig(tmp_path, image_size=forms.SIZE)
    _close(rig, forms.imu_free(forms.rectified_rig()))
    assert rig.is_rectified
    assert not rig.notes


def test_the_numbers_of_a_rectified_pair_state_what_they_are_of(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(f"{NAMED_NUMBERS['calibration.yaml']}cx1: 652.0\nwidth: 1280\nheight: 720\n")
    rig = vio.load_rig(path)
    assert (rig.cam0.cu, rig.right[0].cu) == (640.0, 652.0)
    for lens in ("k1: 0.0\n", "distortion: [0, 0, 0, 0]\n"):
        path.write_text(NAMED_NUMBERS["calibration.yaml"] + lens)
        assert vio.load_rig(path, image_size=forms.SIZE).is_rectified
    for lens in ("k1: -0.2\n", "distortion: [-0.2, 0, 0, 0]\n"):
        path.write_text(NAMED_NUMBERS["calibration.yaml"] + lens)
        with pytest.raises(CalibrationError, match=r"states a distortion .* and a baseline alone"):
            vio.load_rig(path, image_size=forms.SIZE)
    path.write_text(NAMED_NUMBERS["calibration.yaml"].replace("0.11", "110"))
    notes = vio.load_rig(path, image_size=forms.SIZE).notes
    assert any("name it baseline_mm" in note for note in notes)
    path.write_text(NAMED_NUMBERS["calibration.yaml"].replace("0.11", "-0.11"))
    with pytest.raises(CalibrationError, match="baseline must be positive"):
        vio.load_rig(path, image_size=forms.SIZE)
    with pytest.raises(CalibrationError, match="states no image size"):
        vio.load_rig(path)


def test_nine_numbers_in_a_line_may_be_a_matrix(tmp_path: Path) -> None:
    path = tmp_path / "K.txt"
    path.write_text("700 0 640 0 701 360 0 0 1\n")
    camera = vio.load_rig(path, image_size=forms.SIZE).cam0
    assert (camera.fu, camera.fv, camera.cu, camera.cv) == (700, 701, 640, 360)
    assert not camera.coefficients
