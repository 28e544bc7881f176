"""Calibrations as people have them: entries that contradict one another, a camera in each file, and
matrices of CameraInfo that state no pair.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io
import yaml
from scipy.io import loadmat, savemat

import vio
from tests import calibration_forms as forms
from tests.calibration_forms import SIZE, T_CAM0_IMU, T_CAM1_CAM0
from vio.cameras.rig import Rig
from vio.datasets.rigs.camera_info import CameraInfo, rig_from_camera_infos
from vio.datasets.rigs.kalibr import kalibr_text
from vio.datasets.rigs.source import stereo_pose_on_imu
from vio.datasets.unused import Layout, unused_note
from vio.errors import CalibrationError, DataError
from vio.geometry.distortion import DistortionModel


def _doubts(rig: Rig) -> list[str]:
    return [note for note in rig.notes if "doubtful" in note]


# --- ORB-SLAM's baseline is stated twice


@pytest.mark.parametrize(
    ("write", "pattern", "key"),
    [
        (forms.orbslam_old, "Camera.bf: ", "Camera.bf / Camera.fx"),
        (lambda folder: forms.orbslam3("radtan", folder), "", "Stereo.b"),
    ],
    ids=["old", "new"],
)
def test_two_baselines_of_orb_slam_are_doubted(
    write: Callable[[Path], Path], pattern: str, key: str, tmp_path: Path
) -> None:
    write(tmp_path)
    file = tmp_path / "EuRoC.yaml"
    assert not _doubts(vio.load_rig(file))
    lines = file.read_text().splitlines()
    focal = (
        next(float(line.split()[1]) for line in lines if line.startswith("Camera.fx"))
        if pattern
        else 0
    )
    kept = [line for line in lines if not pattern or not line.startswith(pattern)]
    for baseline, is_doubted in ((0.1105, False), (0.06, True)):
        stated = f"Camera.bf: {focal * baseline}" if pattern else f"Stereo.b: {baseline}"
        file.write_text("\n".join([*kept, stated]) + "\n")
        doubts = _doubts(vio.load_rig(file))
        assert bool(doubts) is is_doubted
    assert f"{key} one of 0.06 m" in doubts[0]


# --- Kalibr's calibrations with an IMU, one camera in a file


def _files_of_one_camera(folder: Path, names: tuple[str, str]) -> None:
    forms.kalibr(folder)
    chain = yaml.safe_load((folder / "camchain-imucam.yaml").read_text())
    (folder / "camchain-imucam.yaml").unlink()
    chain["cam1"].pop("T_cn_cnm1")
    for name, block in zip(names, ("cam0", "cam1"), strict=True):
        (folder / name).write_text(yaml.safe_dump({"cam0": chain[block]}))


@pytest.mark.parametrize("names", [("cam0-imu.yaml", "cam1-imu.yaml"), ("left.yaml", "right.yaml")])
def test_two_files_of_one_camera_on_the_imu_are_a_pair(
    names: tuple[str, str], tmp_path: Path
) -> None:
    _files_of_one_camera(tmp_path, names)
    for path in (tmp_path, tmp_path / names[0], tmp_path / names[1]):
        rig = vio.load_rig(path)
        np.testing.assert_allclose(rig.right[1], T_CAM1_CAM0, atol=1e-9)
        assert rig.T_cam0_imu is not None
        np.testing.assert_allclose(rig.T_cam0_imu, T_CAM0_IMU, atol=1e-9)
        assert any(f"{names[1]} the right one" in note for note in rig.notes)
    assert vio.load_rig(tmp_path / names[0], cameras=1).cam1 is None
    (tmp_path / names[1]).unlink()
    assert vio.load_rig(tmp_path / names[0]).cam1 is None


# --- Middlebury

MIDDLEBURY = """cam0=[{f} 0 640.5; 0 {f} 360; 0 0 1]
cam1=[{f} 0 {cx1}; 0 {f} 360; 0 0 1]
doffs={doffs}
baseline=110.5
width=1280
height=720
ndisp=280
"""


@pytest.mark.parametrize("doffs", [0.0, 31.25])
def test_middlebury_is_read(doffs: float, tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(MIDDLEBURY.format(f=700.25, cx1=640.5 + doffs, doffs=doffs))
    rig = vio.load_rig(tmp_path)
    cam1, T_cam1_cam0 = rig.right
    assert (rig.cam0.width, rig.cam0.height) == SIZE
    assert (rig.cam0.fu, rig.cam0.cu, cam1.cu - rig.cam0.cu) == (700.25, 640.5, doffs)
    np.testing.assert_allclose(T_cam1_cam0[:3, 3], [-0.1105, 0.0, 0.0], atol=1e-12)
    assert not rig.notes


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("baseline=110.5", "baseline=-110.5", "baseline is -110.5; it must be positive"),
        ("baseline=110.5", "baseline=x", "baseline is 'x', no number"),
        ("; 0 0 1]", "]", "is no matrix of 3 x 3 numbers"),
        ("cam0=[7", "cam0=[a", "is no matrix of 3 x 3 numbers"),
        ("width=1280\n", "", "states no image size"),
    ],
)
def test_bad_files_of_middlebury_are_refused(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    text = MIDDLEBURY.format(f=700.25, cx1=640.5, doffs=0)
    assert old in text
    (tmp_path / "calib.txt").write_text(text.replace(old, new))
    with pytest.raises(CalibrationError, match=message):
        vio.load_rig(tmp_path)


# --- DepthAI


def test_a_device_that_was_not_calibrated_says_so(tmp_path: Path) -> None:
    file = forms.depthai(tmp_path)
    value = json.loads(file.read_text())
    value["stereoRectificationData"] = {"leftCameraSocket": 255, "rightCameraSocket": 255}
    file.write_text(json.dumps(value))
    expected = forms.true_rig()
    np.testing.assert_allclose(vio.load_rig(file).right[1], expected.right[1], atol=1e-9)
    file.write_text(json.dumps({**value, "cameraData": []}))
    with pytest.raises(CalibrationError, match="was never written; take the factory's"):
        vio.load_rig(file)


# --- CameraInfo


def _info(where: str, shift: float) -> CameraInfo:
    K = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    P = np.column_stack([K, [shift, 0, 0]])
    return CameraInfo(where, 640, 480, "plumb_bob", (0.0,) * 5, K, np.eye(3), P)


@pytest.mark.parametrize(
    ("left", "right", "message"),
    [
        (0.0, 0.0, "P.0, 3. is 0 here and of the left camera, so no baseline is stated"),
        (-44.0, -44.0, "P.0, 3. is -44 here and of the left camera, so both are at one place"),
        (0.0, 44.0, "baseline of -0.11 m.*or its sign is wrong: .* it is -44"),
    ],
)
def test_infos_without_a_baseline_say_why(left: float, right: float, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        rig_from_camera_infos([_info("l", left), _info("r", right)])


@pytest.mark.parametrize(("shift", "is_doubted"), [(-0.11, True), (-44.0, False), (-4.0, False)])
def test_a_baseline_in_metres_in_the_place_of_a_product_is_doubted(
    shift: float, is_doubted: bool
) -> None:
    doubts = _doubts(rig_from_camera_infos([_info("l", 0.0), _info("r", shift)]))
    assert bool(doubts) is is_doubted
    assert not doubts or "if it is the baseline itself, 0.11 m" in doubts[0]


@pytest.mark.parametrize("broken", ["K", "R", "P"])
@pytest.mark.parametrize("side", [0, 1])
def test_a_matrix_written_from_integers_is_named(broken: str, side: int) -> None:
    """As rosbags writes an array of int64 to a field of float64: the bits remain."""
    infos = [_info("l", 0.0), _info("r", -40.0)]
    assert rig_from_camera_infos(infos).cam1 is not None
    bits = getattr(infos[side], broken).astype(np.int64).view(np.float64)
    infos[side] = replace(infos[side], **{broken: bits})
    with pytest.raises(CalibrationError, match=f"{'lr'[side]}: {broken} .* array of integers"):
        rig_from_camera_infos(infos)


# --- poses on the IMU that map the other way


def test_poses_on_the_imu_that_were_inverted_are_called_so(tmp_path: Path) -> None:
    """They were called a vertical pair, whose images should be turned."""
    T_imu_cam0 = np.array([[0.0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]])
    T_imu_cam1 = T_imu_cam0 @ np.linalg.inv(T_CAM1_CAM0)
    with pytest.raises(CalibrationError, match=r"with both poses inverted it is, 0\.11 m away"):
        stereo_pose_on_imu(np.linalg.inv(T_imu_cam0), np.linalg.inv(T_imu_cam1), "a.yaml")
    np.testing.assert_allclose(stereo_pose_on_imu(T_imu_cam0, T_imu_cam1, "a"), T_CAM1_CAM0)
    forms.kalibr(tmp_path)
    file = tmp_path / "camchain-imucam.yaml"
    chain = yaml.safe_load(file.read_text())
    for name, T in (("cam0", T_imu_cam0), ("cam1", T_imu_cam1)):
        chain[name]["T_cam_imu"] = T.tolist()
        chain[name].pop("T_cn_cnm1", None)
    file.write_text(yaml.safe_dump(chain))
    with pytest.raises(CalibrationError, match="they map the other way than this entry does"):
        vio.load_rig(file)


def test_pairs_that_are_above_one_another_either_way_are_no_inverse() -> None:
    below = np.eye(4)
    below[1, 3] = 0.11
    stereo_pose_on_imu(np.eye(4), below, "a")


# --- sizes and matrices that were edited or cut


@pytest.mark.parametrize("size", [(1920, 1080), (1280, 720)])
def test_intrinsics_kept_for_larger_images_are_doubted(
    size: tuple[int, int], tmp_path: Path
) -> None:
    forms.orbslam3("radtan", tmp_path)
    file = tmp_path / "EuRoC.yaml"
    text = file.read_text().replace(f"Camera.width: {SIZE[0]}", f"Camera.width: {size[0]}")
    file.write_text(text.replace(f"Camera.height: {SIZE[1]}", f"Camera.height: {size[1]}"))
    doubts = _doubts(vio.load_rig(file))
    assert bool(doubts) is (size != SIZE)
    assert not doubts or "is the middle of images of about 1274 x 723" in doubts[0]


def test_a_camera_matrix_that_is_nine_numbers_of_a_projection_is_read(tmp_path: Path) -> None:
    """RTAB-Map wrote the first nine numbers of three rows of four."""
    for name, shift in (("left", 0.0), ("right", -44.0)):
        P = np.array([[400.0, 0, 320, shift], [0, 410, 240, 0], [0, 0, 1, 0]])
        entries: dict[str, object] = {
            "image_width": 640,
            "image_height": 480,
            "distortion_model": "plumb_bob",
        }
        cut = np.column_stack([P[:, :3], np.zeros(3)]).ravel()[:9]
        matrices = {
            "camera_matrix": cut.reshape(3, 3),
            "rectification_matrix": np.eye(3),
            "projection_matrix": P,
            "distortion_coefficients": np.zeros((1, 5)),
        }
        for key, M in matrices.items():
            entries[key] = {"rows": len(M), "cols": len(M[0]), "data": M.ravel().tolist()}
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(entries))
    rig = vio.load_rig(tmp_path)
    assert (rig.cam0.fu, rig.cam0.fv, rig.cam0.cu, rig.cam0.cv) == (400, 410, 320, 240)
    assert rig.right[1][0, 3] == pytest.approx(-0.11)


def test_settings_that_name_a_left_and_a_right_file_are_the_pair(tmp_path: Path) -> None:
    """The cameras' files alone have no poses, though their names are those of a pair of ROS."""
    expected = vio.load_rig(forms.vins("radtan", tmp_path))
    for k, side in enumerate(("left", "right")):
        (tmp_path / f"cam{k}_mei.yaml").rename(tmp_path / f"{side}.yaml")
    settings = tmp_path / "euroc_stereo_imu_config.yaml"
    text = settings.read_text().replace("cam0_mei", "left").replace("cam1_mei", "right")
    settings.rename(tmp_path / "zed.yaml").write_text(text)
    rig = vio.load_rig(tmp_path)
    assert (rig.cam0, rig.cam1) == (expected.cam0, expected.cam1)
    (tmp_path / "cam0").mkdir()
    (tmp_path / "other.yaml").write_text("a: 1\n")
    layout = Layout(tmp_path, tmp_path, tmp_path / "cam0", tmp_path / "cam0")
    assert unused_note(layout, [tmp_path / "zed.yaml"]) == ["not used: other.yaml"]


# --- what a calibration states and the estimate does not use


def _imu_of_openvins(scale: float) -> dict[str, object]:
    noise = {
        f"{sensor}_{kind}": 1e-3
        for sensor in ("accelerometer", "gyroscope")
        for kind in ("noise_density", "random_walk")
    }
    return {**noise, "Tw": np.diag([scale, 1.0, 1.0]).tolist(), "Ta": np.eye(3).tolist()}


@pytest.mark.parametrize(("scale", "is_said"), [(1.05, True), (1.0005, False)])
def test_scale_and_misalignment_of_an_imu_are_said_to_be_left_out(
    scale: float, is_said: bool, tmp_path: Path
) -> None:
    forms.kalibr(tmp_path)
    sheet = _imu_of_openvins(scale)
    for content in ({"imu0": sheet}, sheet):
        (tmp_path / "imu.yaml").write_text(yaml.safe_dump(content))
        notes = vio.load_rig(tmp_path).notes
        assert any("Tw (up to 5 % off" in note for note in notes) is is_said
    sheet = {**_imu_of_openvins(1.0), "gyroscopes": {"M": np.diag([scale, 1, 1]).tolist()}}
    (tmp_path / "imu.yaml").write_text(yaml.safe_dump(sheet))
    assert any("gyroscopes: M (up to" in n for n in vio.load_rig(tmp_path).notes) is is_said


@pytest.mark.parametrize(("delay_s", "readout_s"), [(3e-5, 0.0216), (-3e-5, -0.0216), (1e-6, 0.0)])
def test_a_rolling_shutter_is_read_and_written(
    delay_s: float, readout_s: float, tmp_path: Path
) -> None:
    forms.kalibr(tmp_path)
    file = tmp_path / "camchain-imucam.yaml"
    chain = yaml.safe_load(file.read_text())
    chain["cam0"]["line_delay"] = delay_s
    file.write_text(yaml.safe_dump(chain))
    rig = vio.load_rig(file)
    said = f"rolling shutter of {1e3 * readout_s:.1f} ms from the first row"
    assert any(said in note for note in rig.notes) is (readout_s != 0.0)
    for camera in (rig.camera, rig.rectifier().camera, rig.left_alone().rectifier().camera):
        assert camera.readout_s == pytest.approx(readout_s, rel=1e-12)
    file.write_text(kalibr_text(rig))
    assert vio.load_rig(file).readout_s == pytest.approx(readout_s, rel=1e-12)


@pytest.mark.parametrize(("rolls", "readout_s"), [(1, 0.025), (0, 0.0)])
def test_the_rolling_shutter_of_vins_is_read(rolls: int, readout_s: float, tmp_path: Path) -> None:
    file = forms.vins("radtan", tmp_path) / "euroc_stereo_imu_config.yaml"
    file.write_text(file.read_text() + f"rolling_shutter: {rolls}\nrolling_shutter_tr: 0.025\n")
    assert vio.load_rig(file).readout_s == readout_s
    file.write_text(file.read_text().replace("0.025", "25.0"))
    if rolls:
        with pytest.raises(CalibrationError, match=r"euroc_stereo.*readout time .* 25 s"):
            vio.load_rig(file)


def test_a_readout_in_milliseconds_is_refused() -> None:
    rig = forms.true_rig()
    with pytest.raises(CalibrationError, match="readout time of the shutter is 20 s"):
        replace(rig, readout_s=20.0)


# --- matrices of NumPy and MATLAB


def _matrices(rig: Rig) -> dict[str, np.ndarray]:
    """The matrices of a pair by names of a common tutorial."""
    cam1, T = rig.right
    named = {}
    for side, camera in (("L", rig.cam0), ("R", cam1)):
        named |= {f"mtx{side}": camera.K, f"dist{side}": np.array([camera.coefficients])}
    return {**named, "R": T[:3, :3], "T": T[:3, 3:]}


def test_arrays_of_numpy_are_read(tmp_path: Path) -> None:
    truth = forms.true_rig()
    file = tmp_path / "stereo.npz"
    np.savez(file, **_matrices(truth))
    rig = vio.load_rig(file, image_size=SIZE)
    np.testing.assert_allclose(rig.right[1], truth.right[1], atol=1e-12)
    np.testing.assert_allclose(rig.cam0.coefficients, truth.cam0.coefficients)


_NAMES_OF_SIDES = [
    ("cameraMatrixLeft", "cameraMatrixRight", "distCoeffsLeft", "distCoeffsRight"),
    ("left_mtx", "right_mtx", "left_dist", "right_dist"),
    ("K_l", "K_r", "D_l", "D_r"),
    ("Camera_Matrix_1", "Camera_Matrix_2", "Dist_Coefs_1", "Dist_Coefs_2"),
    ("K0", "K1", "D0", "D1"),  # of which K1 and D1 are the left camera's elsewhere
    ("cameraMatrix0", "cameraMatrix1", "distCoeffs0", "distCoeffs1"),
]


@pytest.mark.parametrize("names", _NAMES_OF_SIDES, ids=lambda names: names[0])
def test_matrices_are_known_by_their_sides(names: tuple[str, ...], tmp_path: Path) -> None:
    truth = forms.true_rig()
    found = _matrices(truth)
    named = dict(zip(names, (found[n] for n in ("mtxL", "mtxR", "distL", "distR")), strict=True))
    maps = np.zeros((SIZE[1], SIZE[0], 2))  # of pixels, as are kept with a calibration
    np.savez(tmp_path / "any.npz", **named, rot=found["R"], trans=found["T"], maps=maps)
    rig = vio.load_rig(tmp_path, image_size=SIZE)
    assert rig.cam0.K.tolist() == truth.cam0.K.tolist()
    assert rig.right[0].K.tolist() == truth.right[0].K.tolist()
    np.testing.assert_allclose(rig.right[0].coefficients, truth.right[0].coefficients)


@pytest.mark.parametrize("names", [("k1", "k2"), ("m0", "m1"), ("d0", "d1"), ("k0", "k1")])
def test_numbers_are_no_matrices_of_sides(names: tuple[str, str], tmp_path: Path) -> None:
    truth = forms.true_rig()
    np.savez(tmp_path / "stereo.npz", **_matrices(truth), **dict.fromkeys(names, 0.1))
    rig = vio.load_rig(tmp_path / "stereo.npz", image_size=SIZE)
    assert rig.cam0.K.tolist() == truth.cam0.K.tolist()
    np.testing.assert_allclose(rig.cam0.coefficients, truth.cam0.coefficients)
    (tmp_path / "one.yaml").write_text(f"fx: 450.0\n{names[0]}: -0.3\n{names[1]}: 0.1\n")
    with pytest.raises(CalibrationError, match="is no calibration of a known format"):
        vio.load_rig(tmp_path / "one.yaml", image_size=SIZE)


def test_a_report_of_kalibr_is_no_calibration(tmp_path: Path) -> None:
    file = tmp_path / "camera-results-cam.txt"
    file.write_text("Calibration results \n====================\nCamera-system parameters:\n")
    with pytest.raises(CalibrationError, match="is Kalibr's report in words; give the camchain-"):
        vio.load_rig(file, image_size=SIZE)


def test_cameras_without_the_pose_of_the_right_one_are_refused(tmp_path: Path) -> None:
    matrices = _matrices(forms.true_rig())
    np.savez(tmp_path / "intrinsics.npz", **{n: m for n, m in matrices.items() if n not in "RT"})
    with pytest.raises(CalibrationError, match="has no R and no T, the pose of the right camera"):
        vio.load_rig(tmp_path / "intrinsics.npz", image_size=SIZE)


def test_archives_without_plain_arrays_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "stereo.npz"
    np.savez(file, mtxL=np.array([{"a": 1}], dtype=object))
    with pytest.raises(CalibrationError, match="no archive of NumPy with plain arrays"):
        vio.load_rig(file, image_size=SIZE)
    file.write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(CalibrationError, match="no archive of NumPy with plain arrays"):
        vio.load_rig(file, image_size=SIZE)


def test_a_transposed_matrix_is_called_so(tmp_path: Path) -> None:
    matrices = _matrices(forms.true_rig())
    np.savez(tmp_path / "stereo.npz", **{**matrices, "mtxL": matrices["mtxL"].T})
    with pytest.raises(CalibrationError, match="it is transposed, as MATLAB has it"):
        vio.load_rig(tmp_path / "stereo.npz", image_size=SIZE)


# --- MATLAB, messages of ROS, and settings that name a calibration


def _matlab(folder: Path, **changes: object) -> Path:
    file = forms.matlab_json(folder)
    entries = json.loads(file.read_text())
    for name, value in changes.items():
        for place in (entries, entries["CameraParameters1"]):
            if name in place:
                place[name] = value
    file.write_text(json.dumps(entries))
    return file


def test_the_first_pixel_of_matlab_is_one(tmp_path: Path) -> None:
    K = json.loads(forms.matlab_json(tmp_path).read_text())["CameraParameters1"]["K"]
    assert vio.load_rig(tmp_path / "stereo.json").cam0.cu == pytest.approx(K[0][2] - 1)


def test_a_board_in_metres_that_matlab_calls_millimetres_is_doubted(tmp_path: Path) -> None:
    pose = {"R": T_CAM1_CAM0[:3, :3].tolist(), "Translation": T_CAM1_CAM0[:3, 3].tolist()}
    (doubt,) = _doubts(vio.load_rig(_matlab(tmp_path, PoseCamera2=pose)))
    assert "which puts the cameras 0.00011 m apart" in doubt
    assert not _doubts(vio.load_rig(_matlab(tmp_path)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"WorldUnits": "inches"}, "states lengths in 'inches', which is not read"),
        ({"K": [[700, 3, 640], [0, 700, 360], [0, 0, 1]]}, "has a skew of 3 px"),
        ({"CameraParameters2": 3}, "has no block 'CameraParameters2:'"),
        ({"PoseCamera2": 3}, "RotationOfCamera2 holds 1 values, expected 3 x 3"),
    ],
)
def test_matlab_files_that_are_not_read_say_why(
    changes: dict[str, object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError, match=message):
        vio.load_rig(_matlab(tmp_path, **changes))


def test_other_files_of_matlab_are_no_calibration(tmp_path: Path) -> None:
    savemat(tmp_path / "stereo.mat", {"a": np.eye(3)})
    with pytest.raises(CalibrationError, match="is no calibration of a known format"):
        vio.load_rig(tmp_path / "stereo.mat")
    with pytest.raises(CalibrationError, match="holds no calibration"):
        vio.load_rig(tmp_path)
    forms.matlab(tmp_path)
    assert vio.load_rig(tmp_path).cam0.width == SIZE[0]


def test_objects_of_matlab_are_named(tmp_path: Path) -> None:
    file = forms.matlab(tmp_path)
    held = "scipy.io.whosmat"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            held,
            lambda _: [("None", (1, 1), "opaque"), ("__function_workspace__", (1, 9), "uint8")],
        )
        with pytest.raises(DataError, match=r"toStruct\(stereoParams\)"):
            vio.load_rig(file)


def test_an_object_of_matlab_among_other_variables_is_named(tmp_path: Path) -> None:
    savemat(tmp_path / "stereo.mat", {"squareSize": 25.0, "a": np.eye(3)})
    held = [("squareSize", (1, 1), "double"), ("a", (3, 3), "double"), ("None", (1, 1), "opaque")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scipy.io.whosmat", lambda _: held)
        with pytest.raises(CalibrationError, match=r"toStruct\(stereoParams\)"):
            vio.load_rig(tmp_path / "stereo.mat")


@pytest.mark.parametrize("names", [("results",), ("results", "calibration", "stereoParams")])
def test_structures_of_matlab_may_lie_within_others(names: tuple[str, ...], tmp_path: Path) -> None:
    expected = vio.load_rig(forms.matlab(tmp_path))
    entries = loadmat(tmp_path / "stereo.mat", simplify_cells=True)["s"]
    for name in names:
        entries = {name: entries, "date": "today"}
    savemat(tmp_path / "stereo.mat", {"workspace": entries})
    rig = vio.load_rig(tmp_path / "stereo.mat")
    np.testing.assert_array_equal(rig.T_cam1_cam0, expected.T_cam1_cam0)
    assert rig.cam0 == expected.cam0


def test_opencvs_matrices_may_be_in_a_file_of_matlab(tmp_path: Path) -> None:
    """R and T are also names of Bouguet's toolbox."""
    K = np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]])
    T = np.array([[-0.11], [0.0], [0.0]])
    entries = {"K1": K, "K2": K, "D1": np.zeros(5), "D2": np.zeros(5), "R": np.eye(3), "T": T}
    savemat(tmp_path / "stereo.mat", entries)
    rig = vio.load_rig(tmp_path / "stereo.mat", image_size=SIZE)
    assert rig.T_cam1_cam0 is not None
    assert rig.T_cam1_cam0[0, 3] == pytest.approx(-0.11)


def _message(camera: int, old: bool) -> str:
    rig = forms.true_rig()
    c = rig.cameras[camera]
    R0, R1, P0, P1 = cv2.stereoRectify(
        rig.cam0.K, np.array(rig.cam0.coefficients), rig.right[0].K, np.array(rig.right[0].coefficients),
        SIZE, T_CAM1_CAM0[:3, :3], T_CAM1_CAM0[:3, 3], flags=cv2.CALIB_ZERO_DISPARITY,
    )[:4]  # fmt: skip
    R, P = ((R0, P0), (R1, P1))[camera]
    names = "DKRP" if old else "dkrp"
    matrices = zip(names, ([*c.coefficients, 0.0], c.K, R, P), strict=True)
    head = {"height": SIZE[1], "width": SIZE[0], "distortion_model": "plumb_bob"}
    body = {**head, **{name: np.ravel(m).tolist() for name, m in matrices}}
    stamp = (
        "header: \n  stamp: \n    secs: 1\n    nsecs: 2\n"
        if old
        else "header:\n  stamp:\n    sec: 1\n"
    )
    return f"{stamp}{yaml.safe_dump(body)}---\n"


@pytest.mark.parametrize("old", [True, False], ids=["ROS 1", "ROS 2"])
@pytest.mark.parametrize("messages", [1, 3])
def test_messages_as_ros_prints_them_are_read(old: bool, messages: int, tmp_path: Path) -> None:
    for k, side in enumerate(("left", "right")):
        (tmp_path / f"{side}.yaml").write_text(messages * _message(k, old))
    rig = vio.load_rig(tmp_path)
    np.testing.assert_allclose(rig.right[1], T_CAM1_CAM0, atol=1e-9)
    assert rig.cam0.fu == pytest.approx(forms.true_rig().cam0.fu)


def test_two_documents_in_a_file_are_no_calibration(tmp_path: Path) -> None:
    file = tmp_path / "left.yaml"
    file.write_text(_message(0, True) + "other: 1\n")
    with pytest.raises(CalibrationError, match="expected a single document"):
        vio.load_rig(file)


def test_settings_of_openvins_name_their_camchain(tmp_path: Path) -> None:
    forms.openvins(tmp_path)
    settings = tmp_path / "estimator_config.yaml"
    settings.write_text(
        '%YAML:1.0\nuse_stereo: true\nrelative_config_imu: "kalibr_imu_chain.yaml"\n'
        'relative_config_imucam: "kalibr_imucam_chain.yaml"\n'
    )
    rig = vio.load_rig(settings)
    np.testing.assert_allclose(rig.right[1], T_CAM1_CAM0, atol=1e-9)
    assert rig.T_cam0_imu is not None
    assert vio.load_rig(settings, cameras=1).cameras == rig.cameras[:1]


def test_matrices_in_a_block_for_each_camera_are_read(tmp_path: Path) -> None:
    rig = forms.true_rig()
    blocks = {
        side: {"K": c.K.tolist(), "D": list(c.coefficients)}
        for side, c in zip(("left", "right"), rig.cameras, strict=True)
    }
    pose = {"R": T_CAM1_CAM0[:3, :3].tolist(), "T": T_CAM1_CAM0[:3, 3].tolist()}
    (tmp_path / "rig.json").write_text(json.dumps({**blocks, **pose}))
    read = vio.load_rig(tmp_path / "rig.json", image_size=SIZE)
    np.testing.assert_allclose(read.right[1], T_CAM1_CAM0, atol=1e-12)
    assert read.cameras == rig.cameras


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "ost.txt",
            "# oST version 5.0 parameters\n\n[image]\n\nwidth\n640\n",
            "give the left.yaml and right",
        ),
        (
            "cameras.txt",
            "# Camera list with one line of data per camera:\n1 PINHOLE 640 480 1 1 1 1\n",
            "COLMAP",
        ),
        (
            "aprilgrid.yaml",
            "target_type: aprilgrid\ntagCols: 6\n",
            "describes a board to calibrate with",
        ),
        (
            "imu.yaml",
            "gyroscope_noise_density: 0.001\nupdate_rate: 200\n",
            "describes an IMU alone",
        ),
    ],
)
def test_files_beside_a_calibration_are_called_what_they_are(
    name: str, text: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CalibrationError, match=message):
        vio.load_rig(tmp_path / name, image_size=SIZE)


def _in_blocks(model: DistortionModel, **pose: object) -> dict[str, object]:
    rig = forms.true_rig(model)
    entries: dict[str, object] = dict(pose)
    for side, c in zip(("left", "right"), rig.cameras, strict=True):
        entries[side] = {"camera_matrix": c.K.tolist(), "dist_coeffs": list(c.coefficients)}
    return entries


_POSE = {"R": T_CAM1_CAM0[:3, :3].tolist(), "T": T_CAM1_CAM0[:3, 3].tolist()}


@pytest.mark.parametrize("sides", [("left", "right"), ("left",)])
@pytest.mark.parametrize("pose", [_POSE, {"stereo": _POSE}], ids=["beside", "in a block"])
def test_blocks_of_sides_state_size_and_lens(
    sides: tuple[str, ...], pose: dict[str, object], tmp_path: Path
) -> None:
    entries = _in_blocks("equidistant", **pose)
    for side in sides:
        block = entries[side]
        assert isinstance(block, dict)
        block |= {"distortion_model": "equidistant", "width": SIZE[0], "height": SIZE[1]}
    (tmp_path / "stereo.yaml").write_text(yaml.safe_dump(entries))
    rig = vio.load_rig(tmp_path / "stereo.yaml")
    assert rig.cam0.model == "equidistant"
    assert (rig.cam0.width, rig.cam0.height) == SIZE
    np.testing.assert_allclose(rig.right[1], T_CAM1_CAM0, atol=1e-9)


@pytest.mark.parametrize("name", ["sub/kalibr_imucam_chain.yaml", "''", "1"])
def test_settings_of_openvins_name_a_file_of_another_folder(name: str, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    forms.openvins(tmp_path / "sub")
    settings = tmp_path / "estimator_config.yaml"
    settings.write_text(f"%YAML:1.0\nrelative_config_imucam: {name}\n")
    if name.startswith("sub"):
        assert vio.load_rig(settings).cam0.width == SIZE[0]
    else:
        with pytest.raises(CalibrationError, match="relative_config_imucam names no file"):
            vio.load_rig(settings)


def test_arrays_of_a_recording_beside_a_calibration_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    savemat(tmp_path / "data.mat", {"points": np.zeros((3, 5000)), "rate": 10.0})
    forms.matlab(tmp_path)
    read: list[list[str]] = []
    whole = scipy.io.loadmat

    def loadmat(path: Path, **options: Any) -> Any:
        read.append(options["variable_names"])
        return whole(path, **options)

    monkeypatch.setattr(scipy.io, "loadmat", loadmat)
    assert vio.load_rig(tmp_path).cam0.width == SIZE[0]
    assert ["rate"] in read
    assert not any("points" in names for names in read)
