"""One rig in the forms of the tools that people calibrate with, and how each form is read.

`python -m tests.calibration_forms` prints the table of docs/recordings.md.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from scipy.io import savemat

import vio
from vio.cameras.rig import Rig
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import VioError
from vio.geometry.distortion import CameraModel, DistortionModel
from vio.geometry.lie import (
    FloatArray,
    quat_xyzw_from_rotation,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    so3_exp,
    so3_log,
)
from vio.records import ImuDensities

SIZE = (1280, 720)
OFFSET_S = 0.0125  # the truth: a frame stamped t was exposed at t + offset of the IMU's clock
NOISE = ImuDensities(1.7e-4, 1.9e-5, 2e-3, 3e-3)
T_CAM1_CAM0 = se3_from_parts(so3_exp([0.004, -0.006, 0.003]), [-0.11, 0.0004, -0.0006])
T_CAM0_IMU = se3_exp([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])
_INTRINSICS = ((701.0, 702.5, 637.0, 361.5), (703.0, 704.0, 641.5, 357.0))
_BENDS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "radtan": ((-0.28, 0.07, 2e-4, 1e-5), (-0.29, 0.08, -1e-4, 3e-5)),
    "equidistant": ((0.003, 0.0007, -0.002, 0.0002), (0.0035, 0.0008, -0.0021, 0.0003)),
    "unified": ((1.2, -0.2, 0.05, 1e-3, -2e-3), (1.25, -0.21, 0.06, 1e-3, -1e-3)),
    "double_sphere": ((-0.25, 0.57), (-0.24, 0.58)),
    "eucm": ((0.61, 1.1), (0.62, 1.05)),
    "fov": ((0.93,), (0.92,)),
    "pinhole": ((), ()),
}


def true_rig(model: str = "radtan") -> Rig:
    """Return the rig with lenses of a model."""
    cam0, cam1 = (
        CameraModel(*K, *SIZE, model, D) for K, D in zip(_INTRINSICS, _BENDS[model], strict=True)
    )
    return Rig(cam0, cam1, T_CAM1_CAM0, T_CAM0_IMU, NOISE, OFFSET_S)


def rectified_rig() -> Rig:
    """Return a rectified pair."""
    return Rig.rectified(700.0, 700.0, 640.0, 360.0, 0.11, *SIZE, T_CAM0_IMU, imu_noise=NOISE)


@dataclass(frozen=True, slots=True)
class Form:
    """A format of calibration files."""

    name: str  # of the tool or the data set
    files: str  # as the table names them
    write: Callable[[Path], Path]  # into an empty folder; returns what is given to load_rig
    truth: Rig | None  # what it states; None: it is refused
    known_size: tuple[int, int] | None = None  # of the images, where the file states none
    row: bool = True  # of the table


def imu_free(rig: Rig) -> Rig:
    """Return a rig as a file without an IMU states it."""
    return replace(rig, T_cam0_imu=None, imu_noise=None, time_offset_s=0.0)


def verdict(form: Form) -> str:
    """Return how a form is read, as its row of the table says it."""
    with tempfile.TemporaryDirectory() as folder:
        path = form.write(Path(folder))
        try:
            rig = vio.load_rig(path, image_size=form.known_size)
        except VioError as error:
            return f"refused: {_plain(str(error), folder)}"
    doubts = [note for note in rig.notes if "doubtful" in note]
    if not doubts:
        return "✓"
    doubt = _plain(doubts[0], folder).removeprefix("doubtful: ")
    return f"read with a doubt: {doubt.split('; ')[0]} …"  # the message goes on with remedies


def _plain(message: str, folder: str) -> str:
    """Return a message without the path of its file."""
    return message.replace(f"{folder}/", "…/").split(": ", 1)[-1].replace("|", "/")


def table() -> str:
    """Return the rows of the table."""
    rows = [f"| {form.name} | {form.files} | {verdict(form)} |" for form in FORMS if form.row]
    return "\n".join(["| format | files | how |", "|---|---|---|", *rows])


# --- writers
# --------------------------------------------------------------------------------------------------


def _save(folder: Path, name: str, text: str) -> Path:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def _flat(T: FloatArray) -> str:
    return ", ".join(repr(float(x)) for x in np.ravel(T))


def _cv(name: str, M: FloatArray, space: str = " ") -> str:
    rows, cols = np.atleast_2d(M).shape
    return (
        f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n"
        f"   data:{space}[{_flat(M)}]\n"
    )


def _poses(rig: Rig) -> tuple[FloatArray, FloatArray]:
    """Return `T_imu_cam` of both cameras."""
    assert rig.T_cam0_imu is not None
    T_imu_cam0 = se3_inverse(rig.T_cam0_imu)
    return T_imu_cam0, T_imu_cam0 @ se3_inverse(rig.right[1])


def _intrinsics(c: CameraModel) -> tuple[float, float, float, float]:
    return c.fu, c.fv, c.cu, c.cv


def kalibr(folder: Path, model: str = "radtan") -> Path:
    """As Kalibr names the model (its `ConfigReader.py`); what stands before the focal lengths."""
    kinds = {
        "radtan": ("pinhole", "radtan", 0),
        "fov": ("pinhole", "fov", 0),
        "eucm": ("eucm", "none", 2),
        "double_sphere": ("ds", "none", 2),
        "unified": ("omni", "radtan", 1),
    }
    kind, bend, leading = kinds[model]
    chain = yaml.safe_load(kalibr_text(replace(true_rig(), imu_noise=None)))
    for name, c in zip(("cam0", "cam1"), true_rig(model).cameras, strict=True):
        chain[name] |= {
            "camera_model": kind,
            "distortion_model": bend,
            "distortion_coeffs": list(c.coefficients[leading:]),
            "intrinsics": [*c.coefficients[:leading], *_intrinsics(c)],
        }
    return _save(folder, "camchain-imucam.yaml", yaml.safe_dump(chain))


def openvins(folder: Path) -> Path:
    """With `T_imu_cam` in the place of `T_cam_imu`, and no stereo pose."""
    chain = yaml.safe_load(kalibr_text(true_rig()))
    for name, T in zip(("cam0", "cam1"), _poses(true_rig()), strict=True):
        del chain[name]["T_cam_imu"]
        chain[name]["T_imu_cam"] = T.tolist()
    del chain["cam1"]["T_cn_cnm1"]
    sheet = (
        "%YAML:1.0\n\nimu0:\n  T_i_b:\n    - [1.0, 0.0, 0.0, 0.0]\n    - [0.0, 1.0, 0.0, 0.0]\n"
        "    - [0.0, 0.0, 1.0, 0.0]\n    - [0.0, 0.0, 0.0, 1.0]\n"
        f"  accelerometer_noise_density: {NOISE.accel}\n"
        f"  accelerometer_random_walk: {NOISE.accel_walk}\n"
        f"  gyroscope_noise_density: {NOISE.gyro}\n  gyroscope_random_walk: {NOISE.gyro_walk}\n"
        "  model: kalibr\n  update_rate: 200.0\n"
    )
    _save(folder, "kalibr_imu_chain.yaml", sheet)
    _save(folder, "kalibr_imucam_chain.yaml", "%YAML:1.0\n\n" + yaml.safe_dump(chain))
    return folder


def _orbslam_imu(rig: Rig, name: str) -> str:
    return _cv(name, _poses(rig)[0]) + (
        f"IMU.NoiseGyro: {NOISE.gyro}\nIMU.NoiseAcc: {NOISE.accel}\n"
        f"IMU.GyroWalk: {NOISE.gyro_walk}\nIMU.AccWalk: {NOISE.accel_walk}\nIMU.Frequency: 200\n"
    )


def _orbslam_camera(name: str, c: CameraModel) -> str:
    keys = "k1 k2 k3 k4" if c.model == "equidistant" else "k1 k2 p1 p2"
    values = zip(["fx", "fy", "cx", "cy"], _intrinsics(c), strict=True)
    text = "".join(f"{name}.{key}: {value}\n" for key, value in values)
    bend = zip(keys.split(), c.coefficients, strict=False)
    return text + "".join(f"{name}.{key}: {value}\n" for key, value in bend)


def orbslam3(model: str, folder: Path) -> Path:
    rig = true_rig(model)
    kind = "KannalaBrandt8" if model == "equidistant" else "PinHole"
    text = f'%YAML:1.0\n\nFile.version: "1.0"\n\nCamera.type: "{kind}"\n'
    text += _orbslam_camera("Camera1", rig.cam0) + _orbslam_camera("Camera2", rig.right[0])
    text += f"Camera.width: {SIZE[0]}\nCamera.height: {SIZE[1]}\nCamera.fps: 20\n"
    text += _cv("Stereo.T_c1_c2", se3_inverse(T_CAM1_CAM0)) + "Stereo.ThDepth: 60.0\n"
    text += _orbslam_imu(rig, "IMU.T_b_c1") + "Viewer.PointSize:2\n"
    _save(folder, "EuRoC.yaml", text)
    return folder


def orbslam3_rectified(folder: Path) -> Path:
    rig = rectified_rig()
    text = '%YAML:1.0\nFile.version: "1.0"\nCamera.type: "Rectified"\n'
    text += _orbslam_camera("Camera1", rig.cam0)
    text += f"Stereo.b: 0.11\nCamera.width: {SIZE[0]}\nCamera.height: {SIZE[1]}\n"
    return _save(folder, "RealSense_D435i.yaml", text + _orbslam_imu(rig, "IMU.T_b_c1"))


def orbslam2_rectified(folder: Path) -> Path:
    """As ORB-SLAM2's KITTI00-02.yaml, which states no size."""
    c = rectified_rig().cam0
    text = "%YAML:1.0\n\n" + _orbslam_camera("Camera", c)
    text += "Camera.k1: 0.0\nCamera.k2: 0.0\nCamera.p1: 0.0\nCamera.p2: 0.0\n"
    return _save(folder, "KITTI00-02.yaml", text + f"Camera.bf: {c.fu * 0.11}\nThDepth: 35\n")


def orbslam_old(folder: Path) -> Path:
    """`LEFT.K` with OpenCV's lax YAML; the pose follows from the rectification."""
    import cv2

    rig = true_rig()
    cams = [rig.cam0, rig.right[0]]
    D = [np.array([*c.coefficients, 0.0]) for c in cams]
    R = T_CAM1_CAM0[:3, :3]
    t = T_CAM1_CAM0[:3, 3:]
    R0, R1, P0, P1, *_ = cv2.stereoRectify(cams[0].K, D[0], cams[1].K, D[1], SIZE, R, t)
    text = f'%YAML:1.0\n\nCamera.type: "PinHole"\nCamera.fx: {P0[0, 0]}\nCamera.fy: {P0[0, 0]}\n'
    text += f"Camera.cx: {P0[0, 2]}\nCamera.cy: {P0[1, 2]}\nCamera.k1: 0.0\n"
    text += f"Camera.bf: {-P1[0, 3]}\n" + _orbslam_imu(rig, "Tbc")
    for side, c, d, R_rect, P in zip(("LEFT", "RIGHT"), cams, D, (R0, R1), (P0, P1), strict=True):
        text += f"{side}.height: {SIZE[1]}\n{side}.width: {SIZE[0]}\n"
        for name, M in (("D", d), ("K", c.K), ("R", R_rect), ("P", P)):
            text += _cv(f"{side}.{name}", np.asarray(M, dtype=np.float64), space="")
    return _save(folder, "EuRoC.yaml", text + "Viewer.PointSize:2\n")


def _camodocal(c: CameraModel) -> str:
    text = f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\n"
    fu, fv, cu, cv = _intrinsics(c)
    if c.model == "equidistant":
        names = zip(
            ["k2", "k3", "k4", "k5", "mu", "mv", "u0", "v0"],
            (*c.coefficients, fu, fv, cu, cv),
            strict=True,
        )
        body = "".join(f"   {name}: {value}\n" for name, value in names)
        return f"%YAML:1.0\n---\nmodel_type: KANNALA_BRANDT\n{text}projection_parameters:\n{body}"
    bend = c.coefficients
    head = "%YAML:1.0\n---\nmodel_type: PINHOLE\ncamera_name: camera\n" + text
    keys = ["fx", "fy", "cx", "cy"]
    if c.model == "unified":
        head = f"%YAML:1.0\n---\nmodel_type: MEI\n{text}mirror_parameters:\n   xi: {bend[0]}\n"
        bend = bend[1:]
        keys = ["gamma1", "gamma2", "u0", "v0"]
    head += "distortion_parameters:\n"
    head += "".join(f"   {k}: {v}\n" for k, v in zip(["k1", "k2", "p1", "p2"], bend, strict=True))
    head += "projection_parameters:\n"
    return head + "".join(f"   {k}: {v}\n" for k, v in zip(keys, (fu, fv, cu, cv), strict=True))


def vins(model: str, folder: Path) -> Path:
    rig = true_rig(model)
    for k, c in enumerate(rig.cameras):
        _save(folder, f"cam{k}_mei.yaml", _camodocal(c))
    text = "%YAML:1.0\n\nimu: 1\nnum_of_cam: 2\n\n"
    text += 'cam0_calib: "cam0_mei.yaml"\ncam1_calib: "cam1_mei.yaml"\n'
    text += f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\nestimate_extrinsic: 0\n"
    for k, T in enumerate(_poses(rig)):
        text += _cv(f"body_T_cam{k}", T)
    text += (
        f"acc_n: 0.1\ngyr_n: 0.01\nacc_w: 0.001\ngyr_w: 0.0001\nestimate_td: 0\ntd: {OFFSET_S}\n"
    )
    _save(folder, "euroc_stereo_imu_config.yaml", text)
    return folder


def basalt(model: str, folder: Path) -> Path:
    rig = true_rig(model)
    kinds = {"equidistant": "kb4", "double_sphere": "ds", "eucm": "eucm", "fov": "fov"}
    names = {
        "equidistant": "k1 k2 k3 k4",
        "double_sphere": "xi alpha",
        "eucm": "alpha beta",
        "fov": "w",
    }[model].split()
    poses = []
    lenses = []
    for c, T in zip(rig.cameras, _poses(rig), strict=True):
        keys = ("px", "py", "pz", "qx", "qy", "qz", "qw")
        values = (*T[:3, 3].tolist(), *quat_xyzw_from_rotation(T[:3, :3]).tolist())
        poses.append(dict(zip(keys, values, strict=True)))
        numbers = dict(zip(("fx", "fy", "cx", "cy"), _intrinsics(c), strict=True))
        numbers |= dict(zip(names, c.coefficients, strict=True))
        lenses.append({"camera_type": kinds[model], "intrinsics": numbers})
    value = {
        "T_imu_cam": poses,
        "intrinsics": lenses,
        "resolution": [list(SIZE)] * 2,
        "calib_accel_bias": [0.0] * 9,
        "calib_gyro_bias": [0.0] * 12,
        "imu_update_rate": 200.0,
        "accel_noise_std": [NOISE.accel] * 3,
        "gyro_noise_std": [NOISE.gyro] * 3,
        "accel_bias_std": [NOISE.accel_walk] * 3,
        "gyro_bias_std": [NOISE.gyro_walk] * 3,
        "cam_time_offset_ns": round(OFFSET_S * 1e9),
        "vignette": [],
    }
    _save(folder, "calibration.json", json.dumps({"value0": value}))
    return folder


def basalt_ucm(folder: Path) -> Path:
    """The double sphere with one centre, which Basalt writes without `xi`."""
    text = (basalt("double_sphere", folder) / "calibration.json").read_text()
    sheet = json.loads(text)
    for lens in sheet["value0"]["intrinsics"]:
        lens["camera_type"] = "ucm"
        del lens["intrinsics"]["xi"]
    _save(folder, "calibration.json", json.dumps(sheet))
    return folder


def one_centre() -> Rig:
    """Return the rig with double spheres of one centre."""
    rig = true_rig("double_sphere")
    cam0, cam1 = (replace(c, coefficients=(0.0, c.coefficients[1])) for c in rig.cameras)
    return replace(rig, cam0=cam0, cam1=cam1)


def monado(folder: Path, model: str = "radtan") -> Path:
    """As its `t_file.cpp` writes it."""
    rig = true_rig(model)
    kinds = {
        "radtan": ("pinhole_radtan5", "k1 k2 p1 p2 k3"),
        "equidistant": ("fisheye_equidistant4", "k1 k2 k3 k4"),
    }
    kind, names = kinds[model]
    cameras = []
    for c in rig.cameras:
        D = dict(zip(names.split(), [*c.coefficients, 0.0], strict=False))
        K = dict(zip(("fx", "fy", "cx", "cy"), _intrinsics(c), strict=True))
        size = dict(zip(("width", "height"), SIZE, strict=True))
        cameras.append({"model": kind, "intrinsics": K, "distortion": D, "resolution": size})
    R = T_CAM1_CAM0[:3, :3].ravel().tolist()
    pose = {"rotation": R, "translation": T_CAM1_CAM0[:3, 3].tolist()}
    sheet = {"metadata": {"version": 2}, "cameras": cameras, "opencv_stereo_calibrate": pose}
    return _save(folder, "calibration.json", json.dumps(sheet))


def depthai_of(folder: Path, kind: int, model: str = "radtan") -> Path:
    """With a `cameraType`, and the lenses of a model."""
    path = depthai(folder)
    sheet = json.loads(path.read_text())
    lenses = true_rig(model).cameras
    for socket, block in sheet["cameraData"]:
        block["cameraType"] = kind
        lens = lenses[1 if socket == 2 else 0]
        block["distortionCoeff"] = [*lens.coefficients, *[0.0] * (14 - len(lens.coefficients))]
    return _save(folder, path.name, json.dumps(sheet))


def depthai(folder: Path, *, inverted: bool = False) -> Path:
    """Left and right are linked through the colour camera between them, in centimetres."""
    rig = true_rig()
    T_rgb_left = se3_from_parts(so3_exp([0.01, 0.02, -0.01]), [-0.05, 0.001, 0.002])
    T_rgb_right = T_rgb_left @ se3_inverse(T_CAM1_CAM0)

    def link(T: FloatArray | None, to: int) -> dict[str, object]:
        if T is None:
            zero = dict.fromkeys("xyz", 0.0)
            return {"rotationMatrix": [], "toCameraSocket": to, "translation": zero}
        T = se3_inverse(T) if inverted else T
        shift = dict(zip("xyz", (100 * T[:3, 3]).tolist(), strict=True))
        return {"rotationMatrix": T[:3, :3].tolist(), "toCameraSocket": to, "translation": shift}

    data = []
    ends = ((0, None, -1), (1, T_rgb_left, 0), (2, T_rgb_right, 0))
    for socket, T, to in ends:
        c = rig.right[0] if socket == 2 else rig.cam0
        block = {
            "cameraType": 0,
            "distortionCoeff": [*c.coefficients, *[0.0] * 10],
            "extrinsics": link(T, to),
            "height": SIZE[1],
            "intrinsicMatrix": c.K.tolist(),
            "width": SIZE[0],
        }
        data.append([socket, block])
    assert rig.T_cam0_imu is not None
    sheet = {
        "boardName": "BW1098OBC",
        "cameraData": data,
        "imuExtrinsics": link(rig.T_cam0_imu, 1),
        "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2},
    }
    return _save(folder, "oak_calib.json", json.dumps(sheet))


def zed_x(folder: Path) -> Path:
    """The distortion in sections of its own, here of a fisheye."""
    path = zed(folder) / "SN21531.conf"
    kept = [
        line
        for line in path.read_text().splitlines()
        if line[:2] not in ("k1", "k2", "k3", "p1", "p2")
    ]
    for side, c in zip(("LEFT", "RIGHT"), true_rig("equidistant").cameras, strict=True):
        kept.append(f"[{side}_DISTO]")
        kept += [f"k{k} = {value}" for k, value in enumerate(c.coefficients, start=1)]
    return _save(folder, "SN21531.conf", "\n".join(kept) + "\n").parent


def zed(folder: Path) -> Path:
    rig = true_rig()
    text = ""
    for side, c in zip(("LEFT", "RIGHT"), rig.cameras, strict=True):
        for name, scale in (("HD", 1.0), ("VGA", 672 / 1280)):
            text += f"[{side}_CAM_{name}]\n"
            for key, value in zip(["fx", "fy", "cx", "cy"], _intrinsics(c), strict=True):
                text += f"{key}={value * scale}\n"
            bend = zip(["k1", "k2", "p1", "p2"], c.coefficients, strict=True)
            text += "".join(f"{key}={value}\n" for key, value in bend) + "k3=0\n\n"
    x, y, z = (1000 * T_CAM1_CAM0[:3, 3]).tolist()
    rx, cv, rz = so3_log(T_CAM1_CAM0[:3, :3]).tolist()
    text += f"[STEREO]\nBaseline={-x}\nTY={y}\nTZ={z}\n"
    text += "".join(f"RX_{n}={rx}\nCV_{n}={cv}\nRZ_{n}={rz}\n" for n in ("HD", "VGA"))
    _save(folder, "SN21531.conf", text)
    return folder


def mrpt(folder: Path) -> Path:
    """With the comments that its tool writes."""
    rig = true_rig()
    text = "# Left camera calibration parameters:\n"
    for side, c in zip(("LEFT", "RIGHT"), rig.cameras, strict=True):
        text += f"[CAMERA_PARAMS_{side}]\nresolution = [{c.width} {c.height}]\n"
        for key, value in zip(("fx", "fy", "cx", "cy"), _intrinsics(c), strict=True):
            text += f"{key} = {value}  // +/- 0.1\n"
        bend = " ".join(map(repr, (*c.coefficients, 0.0)))
        text += f"dist = [{bend}]    // The order is: [K1 K2 T1 T2 K3]\n"
    T = se3_inverse(T_CAM1_CAM0)
    x, y, z, w = quat_xyzw_from_rotation(T[:3, :3]).tolist()
    pose = " ".join(map(repr, (*T[:3, 3].tolist(), w, x, y, z)))
    text += f"[CAMERA_PARAMS_LEFT2RIGHT_POSE]\npose_quaternion = [{pose}]\n"
    return _save(folder, "calib.ini", text)


def mrpt2(folder: Path) -> Path:
    """With k4 to k6, as MRPT 2 writes it, which states a model."""
    file = mrpt(folder)
    text = file.read_text().replace("0.0]    //", "0.0 0 0 0 ]    //")
    file.write_text(text.replace("dist =", "distortion_model = plumb_bob\ndist ="))
    return file


def mrpt2_fisheye(folder: Path) -> Path:
    """Of a rig whose lenses are OpenCV's fisheye: four coefficients."""
    file = mrpt(folder)
    lines = file.read_text().splitlines()
    places = [k for k, line in enumerate(lines) if line.startswith("dist =")]
    for place, camera in zip(places, true_rig("equidistant").cameras, strict=True):
        bend = " ".join(map(repr, camera.coefficients))
        lines[place] = f"distortion_model = kannala_brandt\ndist = [{bend} ]"
    file.write_text("\n".join(lines) + "\n")
    return file


def mrpt_text(folder: Path) -> Path:
    """As the Malaga sets name it."""
    return mrpt(folder).rename(folder / "camera_params_raw_1280x720.txt")


def dsec(folder: Path) -> Path:
    """Of four cameras, those of images in the middle; R_rect of each maps to its rectified one."""
    camera, other = rectified_rig().cameras
    turns = [se3_exp([0, 0, 0, 0.01, -0.02, 0.03]), se3_exp([0, 0, 0, -0.02, 0.01, 0.01])]
    T_21 = se3_inverse(turns[1]) @ rectified_rig().right[1] @ turns[0]
    stated = {
        name: {"camera_matrix": list(_intrinsics(c)), "resolution": list(SIZE)}
        for name, c in (("camRect0", other), ("camRect1", camera), ("camRect2", other))
    }
    stated["cam0"] = {"camera_matrix": [555.0, 555.0, 340.0, 215.0], "resolution": [640, 480]}
    poses = {"T_10": np.eye(4), "T_21": T_21} | {
        f"R_rect{k}": T[:3, :3] for k, T in enumerate(turns, start=1)
    }
    data = {"intrinsics": stated, "extrinsics": {key: T.tolist() for key, T in poses.items()}}
    return _save(folder, "cam_to_cam.yaml", yaml.safe_dump(data))


def driving_stereo(folder: Path) -> Path:
    """Of half images: the last column of P_rect_103 is that of whole ones."""
    c = rectified_rig().cam0
    poses = (se3_exp([0, 0, 0, 0.01, -0.02, 0.03]), se3_exp([0, 0, 0, -0.02, 0.01, 0.01]))
    poses = (poses[0], poses[1] @ rectified_rig().right[1] @ poses[0])
    text = "calib_time: 2018-07-09\n"
    for name, T, column in zip(("101", "103"), poses, (0.0, -2 * 0.11 * c.fu), strict=True):
        P = [c.fu, 0, c.cu, column, 0, c.fv, c.cv, 0, 0, 0, 1, 0]
        rows = {
            "S": (1762, 800), "K": (c.fu, 0, c.cu, 0, c.fv, c.cv, 0, 0, 1), "D": (-0.3, 0.1, 0, 0, 0),
            "R": T[:3, :3].ravel(), "T": T[:3, 3], "S_rect": SIZE, "P_rect": P,
        }  # fmt: skip
        for key, values in rows.items():
            text += f"{key}_{name}: {' '.join(repr(float(x)) for x in values)}\n"
    return _save(folder, "2018-07-09-16-11-56.txt", text)


def virtual_kitti(folder: Path) -> Path:
    """Its size is not stated; all frames have one rig."""
    lenses = "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]\n"
    poses = "frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1\n"
    rig = rectified_rig()
    T_cam0_world = se3_exp([1.0, -2.0, 3.0, 0.1, -0.2, 0.3])
    for frame in range(2):
        for k, c in enumerate(rig.cameras):
            T = (rig.right[1] if k else np.eye(4)) @ T_cam0_world
            lenses += f"{frame} {k} {' '.join(map(repr, _intrinsics(c)))}\n"
            poses += f"{frame} {k} {' '.join(map(repr, T.ravel().tolist()))}\n"
    _save(folder, "extrinsic.txt", poses)
    return _save(folder, "intrinsic.txt", lenses)


def open3d(folder: Path, *, block: bool = False) -> Path:
    """Column by column; in a block where the pose is beside it."""
    c = rectified_rig().cam0
    K = [c.fu, 0.0, 0.0, 0.0, c.fv, 0.0, c.cu, c.cv, 1.0]
    data = {"width": c.width, "height": c.height, "intrinsic_matrix": K}
    stated = {"extrinsic": np.eye(4).ravel().tolist(), "intrinsic": data} if block else data
    return _save(folder, "camera_intrinsic.json", json.dumps(stated))


def okvis(folder: Path) -> Path:
    """The time shift has the opposite sign of Kalibr's."""
    rig = true_rig()
    text = "%YAML:1.0\ncameras:\n"
    for c, T in zip(rig.cameras, _poses(rig), strict=True):
        text += f"     - {{T_SC:\n        [{_flat(T)}],\n        image_dimension: {list(SIZE)},\n"
        text += f"        distortion_coefficients: {list(c.coefficients)},\n"
        text += "        distortion_type: radialtangential,\n"
        text += f"        focal_length: [{c.fu}, {c.fv}],\n"
        text += f"        principal_point: [{c.cu}, {c.cv}],\n        slam_use: okvis}}\n\n"
    text += f"camera_parameters:\n    image_delay: {-OFFSET_S}\nimu_parameters:\n    use: true\n"
    text += f"    sigma_g_c: {NOISE.gyro}\n    sigma_a_c: {NOISE.accel}\n"
    text += f"    sigma_gw_c: {NOISE.gyro_walk}\n    sigma_aw_c: {NOISE.accel_walk}\n"
    text += "    T_BS:\n        [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]\n"
    return _save(folder, "euroc.yaml", text)


def okvis2_eucm(folder: Path) -> Path:
    """The extended unified model, whose parameters stand in an entry of their own."""
    text = okvis(folder).read_text()
    rig = true_rig("eucm")
    for c, like in zip(rig.cameras, true_rig().cameras, strict=True):
        old = f"distortion_coefficients: {list(like.coefficients)},"
        new = "distortion_coefficients: [0.0, 0.0, 0.0, 0.0],"
        new += f" cam_model: eucm, eucm_parameters: {list(c.coefficients)},"
        text = text.replace(old, new, 1)
    return _save(folder, "euroc.yaml", text)


def ncamera(folder: Path, model: str = "radtan") -> Path:
    rig = true_rig(model)
    name = {"radtan": "radial-tangential", "fov": "fisheye"}[model]
    cameras = []
    for k, (c, T) in enumerate(zip(rig.cameras, _poses(rig), strict=True)):

        def block(values: FloatArray) -> dict[str, object]:
            rows, cols = values.shape
            return {"rows": rows, "cols": cols, "data": values.ravel().tolist()}

        lens = {
            "label": f"cam{k}",
            "image_width": SIZE[0],
            "image_height": SIZE[1],
            "type": "pinhole",
            "intrinsics": block(np.array(_intrinsics(c))[:, None]),
            "distortion": {
                "type": name,
                "parameters": block(np.array(c.coefficients)[:, None]),
            },
        }
        cameras.append({"camera": lens, "T_B_C": block(T)})
    imu = {
        "delay_imu_cam": -OFFSET_S,
        "sigma_omega_c": NOISE.gyro,
        "sigma_acc_c": NOISE.accel,
        "sigma_omega_bias_c": NOISE.gyro_walk,
        "sigma_acc_bias_c": NOISE.accel_walk,
    }
    sheet = {"label": "rig", "cameras": cameras, "imu_params": imu}
    return _save(folder, "ncamera.yaml", yaml.safe_dump(sheet, sort_keys=False))


def maplab(folder: Path) -> Path:
    """`sensors.yaml`, with the inverse pose."""
    path = ncamera(folder)
    sheet = yaml.safe_load(path.read_text())
    for item in sheet["cameras"]:
        block = item.pop("T_B_C")
        T = np.array(block["data"]).reshape(4, 4)
        item["T_C_B"] = {**block, "data": se3_inverse(T).ravel().tolist()}
    path.unlink()
    sensor = {"sensor_type": "NCAMERA", "cameras": sheet["cameras"]}
    return _save(folder, "sensors.yaml", yaml.safe_dump({"sensors": [sensor]}))


def kimera(folder: Path) -> Path:
    rig = true_rig()
    for name, c, T in zip(("Left", "Right"), rig.cameras, _poses(rig), strict=True):
        text = f"%YAML:1.0\ncamera_id: {name.lower()}_cam\nT_BS:\n  cols: 4\n  rows: 4\n"
        text += f"  data: [{_flat(T)}]\nrate_hz: 20\nresolution: {list(SIZE)}\n"
        text += f"camera_model: pinhole\nintrinsics: {list(_intrinsics(c))}\n"
        text += "distortion_model: radial-tangential\n"
        text += f"distortion_coefficients: {list(c.coefficients)}\n"
        _save(folder, f"{name}CameraParams.yaml", text)
    text = f"%YAML:1.0\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{_flat(np.eye(4))}]\n"
    text += f"gyroscope_noise_density: {NOISE.gyro}\ngyroscope_random_walk: {NOISE.gyro_walk}\n"
    text += f"accelerometer_noise_density: {NOISE.accel}\n"
    text += f"accelerometer_random_walk: {NOISE.accel_walk}\nimu_time_shift: {OFFSET_S}\n"
    _save(folder, "ImuParams.yaml", text)
    return folder


def four_seasons(folder: Path) -> Path:
    c = rectified_rig().cam0
    text = (
        f"Pinhole {c.fu} {c.fv} {c.cu} {c.cv} 0\n{SIZE[0]} {SIZE[1]}\ncrop\n{SIZE[0]} {SIZE[1]}\n"
    )
    for k in range(2):
        _save(folder, f"undistorted_calib_{k}.txt", text)
    rows = "\n".join(" ".join(map(repr, row)) for row in rectified_rig().right[1].tolist())
    _save(folder, "undistorted_calib_stereo.txt", rows + "\n")
    return folder


def _opencv(folder: Path, scale: float, *, sized: bool) -> Path:
    rig = true_rig()
    text = "%YAML:1.0\n---\n"
    text += f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\n" if sized else ""
    for k, c in enumerate(rig.cameras, start=1):
        text += _cv(f"M{k}", c.K) + _cv(f"D{k}", np.array([*c.coefficients, 0.0]))
    text += _cv("R", T_CAM1_CAM0[:3, :3]) + _cv("T", scale * T_CAM1_CAM0[:3, 3:])
    return _save(folder, "stereo.yml", text)


def opencv_omnidir(folder: Path) -> Path:
    """As the sample `omni_stereo_calibration.cpp` of OpenCV's contributions writes it."""
    rig = true_rig("unified")
    text = f"%YAML:1.0\n---\nimage_width: {SIZE[0]}\nimage_height: {SIZE[1]}\n"
    for k, c in enumerate(rig.cameras, start=1):
        text += _cv(f"camera_matrix_{k}", c.K)
        text += _cv(f"distortion_coefficients_{k}", np.array(c.coefficients[1:]))
        text += f"xi_{k}: {c.coefficients[0]}\n"
    turn = so3_log(T_CAM1_CAM0[:3, :3])
    text += _cv("rvec", turn[:, None]) + _cv("tvec", T_CAM1_CAM0[:3, 3:])
    return _save(folder, "out_camera_params_stereo.yml", text)


def _opencv_other_names(folder: Path) -> Path:
    """The distortion by a name that is not known."""
    path = _opencv(folder, 1.0, sized=True)
    text = (
        path.read_text()
        .replace("D1:", "leftLensDistortion:")
        .replace("D2:", "rightLensDistortion:")
    )
    return _save(folder, path.name, text)


def openvslam(folder: Path, *, block: bool = False) -> Path:
    """OpenVSLAM's settings of a rectified pair; stella_vslam's, which have a block."""
    c = rectified_rig().cam0
    values: dict[str, object] = {
        "setup": "stereo",
        "model": "perspective",
        **dict(zip(("fx", "fy", "cx", "cy"), _intrinsics(c), strict=True)),
        **dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0),
        "cols": c.width,
        "rows": c.height,
        "focal_x_baseline": c.fu * 0.11,
    }
    if block:
        return _save(folder, "config.yaml", yaml.safe_dump({"Camera": values}))
    text = "".join(f"Camera.{key}: {value}\n" for key, value in values.items())
    return _save(folder, "config.yaml", text)


def stella_raw(folder: Path) -> Path:
    """stella_vslam's settings of raw images, which it rectifies."""
    import cv2

    cams = true_rig().cameras
    D = [np.array([*c.coefficients, 0.0]) for c in cams]
    R, t = T_CAM1_CAM0[:3, :3], T_CAM1_CAM0[:3, 3:]
    R0, R1, P0, P1, *_ = cv2.stereoRectify(cams[0].K, D[0], cams[1].K, D[1], SIZE, R, t)
    settings = yaml.safe_load(openvslam(folder, block=True).read_text())
    for key, value in (("fx", P0[0, 0]), ("fy", P0[1, 1]), ("cx", P0[0, 2]), ("cy", P0[1, 2])):
        settings["Camera"][key] = float(value)
    settings["Camera"]["focal_x_baseline"] = float(-P1[0, 3])
    block: dict[str, object] = {"model": "perspective"}
    for side, c, d, turn in zip(("left", "right"), cams, D, (R0, R1), strict=True):
        matrices = {"K": c.K, "D": d, "R": np.asarray(turn)}
        block |= {f"{name}_{side}": M.ravel().tolist() for name, M in matrices.items()}
    return _save(folder, "config.yaml", yaml.safe_dump({**settings, "StereoRectifier": block}))


_EDEX_PLACES = {
    "pinhole": (),
    "brown": (0, 1, 4, 2, 3),
    "fisheye": (0, 1, 2, 3),
    "polynomial": (0, 1, 2, 3, 4, 5, 6, 7),
}


def edex(folder: Path, rig: Rig, lens: str) -> Path:
    """cuVSLAM's scene, in OpenGL's axes."""
    flip = np.diag([1.0, -1.0, -1.0])
    cameras = []
    for c, T_rig_cam in zip(rig.cameras, (np.eye(4), se3_inverse(rig.right[1])), strict=True):
        D = (*c.coefficients, *[0.0] * 8)
        intrinsics = {
            "distortion_model": lens,
            "distortion_params": [D[k] for k in _EDEX_PLACES[lens]],
            "focal": [c.fu, c.fv],
            "principal": [c.cu, c.cv],
            "size": [c.width, c.height],
        }
        turned = np.column_stack([flip @ T_rig_cam[:3, :3] @ flip, flip @ T_rig_cam[:3, 3]])
        cameras.append({"intrinsics": intrinsics, "transform": turned.tolist()})
    scene = [
        {"version": "0.9", "cameras": cameras},
        {"fps": 10, "sequence": [["a.png"], ["b.png"]]},
    ]
    return _save(folder, "stereo.edex", json.dumps(scene))


def spectacular(folder: Path, model: DistortionModel = "radtan") -> Path:
    """The calibration of Spectacular AI's SDK."""
    rig = true_rig(model)
    names = {"pinhole": "pinhole", "radtan": "brown-conrady", "equidistant": "kannala-brandt4"}
    cameras = []
    for c, T in zip(rig.cameras, (T_CAM0_IMU, T_CAM1_CAM0 @ T_CAM0_IMU), strict=True):
        D = [*c.coefficients, *[0.0] * (4 if model == "radtan" else 0)]
        cameras.append(
            {
                "model": names[model],
                "focalLengthX": c.fu,
                "focalLengthY": c.fv,
                "principalPointX": c.cu,
                "principalPointY": c.cv,
                "distortionCoefficients": D,
                "imuToCamera": T.tolist(),
            }
        )
    return _save(folder, "calibration.json", json.dumps({"cameras": cameras}))


_FIRST_PIXEL = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])  # is (1, 1) in MATLAB


def _of_matlab(rig: Rig, unit: str) -> dict[str, object]:
    """What `toStruct` makes of `stereoParameters`: rows times matrices, and the first pixel is (1, 1)."""
    factor = {"millimeters": 1e3, "m": 1.0}[unit]
    cameras: dict[str, object] = {}
    for k, c in enumerate(rig.cameras, start=1):
        cameras[f"CameraParameters{k}"] = {
            "RadialDistortion": np.array(c.coefficients[:2]),
            "TangentialDistortion": np.array(c.coefficients[2:4]),
            "ImageSize": np.array([c.height, c.width], dtype=np.float64),
            "WorldUnits": unit,
            "IntrinsicMatrix": (c.K + _FIRST_PIXEL).T,
            "Version": {"Major": 1.0, "Minor": 3.0},
        }
    pose = {
        "RotationOfCamera2": T_CAM1_CAM0[:3, :3].T,
        "TranslationOfCamera2": factor * T_CAM1_CAM0[:3, 3],
    }
    return {**cameras, **pose}


def matlab(folder: Path, unit: str = "millimeters") -> Path:
    """`save('stereo.mat', 's', '-v7')` of that structure."""
    savemat(folder / "stereo.mat", {"s": _of_matlab(true_rig(), unit)})
    return folder / "stereo.mat"


def matlab_json(folder: Path) -> Path:
    """`jsonencode(stereoParams)` of MATLAB R2022b or later, with columns times matrices."""
    rig = true_rig()
    entries: dict[str, object] = {}
    for k, c in enumerate(rig.cameras, start=1):
        entries[f"CameraParameters{k}"] = {
            "K": (c.K + _FIRST_PIXEL).tolist(),
            "RadialDistortion": list(c.coefficients[:2]),
            "TangentialDistortion": list(c.coefficients[2:4]),
            "ImageSize": [c.height, c.width],
        }
    R, t = T_CAM1_CAM0[:3, :3], 1e3 * T_CAM1_CAM0[:3, 3]
    entries |= {"PoseCamera2": {"R": R.tolist(), "Translation": t.tolist()}, "WorldUnits": "mm"}
    return _save(folder, "stereo.json", json.dumps(entries))


def bouguet(folder: Path) -> Path:
    """The results of Bouguet's toolbox."""
    rig = true_rig()
    found: dict[str, object] = {"R": T_CAM1_CAM0[:3, :3], "T": 1e3 * T_CAM1_CAM0[:3, 3:]}
    for side, c in zip(("left", "right"), rig.cameras, strict=True):
        found |= {
            f"fc_{side}": np.array([[c.fu], [c.fv]]),
            f"cc_{side}": np.array([[c.cu], [c.cv]]),
            f"alpha_c_{side}": 0.0,
            f"kc_{side}": np.array([[*c.coefficients, 0.0]]).T,
        }
    savemat(
        folder / "Calib_Results_stereo.mat", {**found, "nx": 1280.0, "ny": 720.0, "om": np.zeros(3)}
    )
    return folder / "Calib_Results_stereo.mat"


def _kitti(folder: Path) -> Path:
    c = rectified_rig().cam0
    P0 = np.column_stack([c.K, np.zeros(3)])
    P1 = P0.copy()
    P1[0, 3] = -c.fu * 0.11
    text = "".join(
        f"P{k}: {' '.join(map(repr, P.ravel().tolist()))}\n" for k, P in enumerate((P0, P1))
    )
    return _save(folder, "calib.txt", text)


def _boofcv(folder: Path, unit: float) -> Path:
    rig = true_rig()
    sheet: dict[str, object] = {}
    for side, c in zip(("left", "right"), rig.cameras, strict=True):
        names = ("fx", "fy", "cx", "cy", "width", "height", "skew")
        lens = dict(zip(names, (*_intrinsics(c), *SIZE, 0.0), strict=True))
        bend = {
            "radial": list(c.coefficients[:2]),
            "t1": c.coefficients[2],
            "t2": c.coefficients[3],
        }
        sheet[side] = {"pinhole": lens, "radial_tangential": bend}
    T = se3_inverse(T_CAM1_CAM0)
    x, y, z = (unit * T[:3, 3]).tolist()
    sheet["rightToLeft"] = {"rotation": T[:3, :3].ravel().tolist(), "x": x, "y": y, "z": z}
    return _save(folder, "stereo.yaml", yaml.safe_dump(sheet))


_OF_KALIBR = {
    "pinhole-fov": "fov",
    "omni-radtan": "unified",
    "ds-none": "double_sphere",
    "eucm-none": "eucm",
}
_LONGER = replace(
    imu_free(true_rig()),
    T_cam1_cam0=se3_from_parts(T_CAM1_CAM0[:3, :3], 40 * T_CAM1_CAM0[:3, 3]),
)
_NO_NOISE = replace(true_rig(), imu_noise=None)
_NO_SHIFT = replace(true_rig(), time_offset_s=0.0)
FORMS = (
    Form("Kalibr", "`camchain-imucam.yaml`", kalibr, _NO_NOISE),
    *(
        Form(
            "Kalibr",
            f"likewise, `{name}`",
            partial(kalibr, model=model),
            replace(true_rig(model), imu_noise=None),
            row=False,
        )
        for name, model in _OF_KALIBR.items()
    ),
    Form("OpenVINS", "`kalibr_imucam_chain.yaml` with `T_imu_cam`", openvins, true_rig()),
    Form("ORB-SLAM3", "`File.version`, `PinHole`", lambda f: orbslam3("radtan", f), _NO_SHIFT),
    Form(
        "ORB-SLAM3",
        "`File.version`, `KannalaBrandt8`",
        lambda f: orbslam3("equidistant", f),
        replace(true_rig("equidistant"), time_offset_s=0.0),
        row=False,
    ),
    Form("ORB-SLAM3", "`File.version`, `Rectified`", orbslam3_rectified, rectified_rig()),
    Form("ORB-SLAM2, 3", "`LEFT.K` … `RIGHT.P`, `Tbc`", orbslam_old, _NO_SHIFT),
    Form(
        "ORB-SLAM2",
        "`Camera.fx`, `Camera.bf`, no size",
        orbslam2_rectified,
        imu_free(rectified_rig()),
        SIZE,
    ),
    Form("OpenVSLAM", "`Camera.focal_x_baseline`", openvslam, imu_free(rectified_rig())),
    Form("stella_vslam", "`Camera:`", lambda f: openvslam(f, block=True), imu_free(rectified_rig())),
    Form("stella_vslam", "likewise, `StereoRectifier:`", stella_raw, imu_free(true_rig())),
    Form(
        "VINS-Fusion",
        "settings and camodocal's `PINHOLE`",
        lambda f: vins("radtan", f),
        _NO_NOISE,
    ),
    Form(
        "VINS-Fusion",
        "likewise, `MEI`",
        lambda f: vins("unified", f),
        replace(true_rig("unified"), imu_noise=None),
        row=False,
    ),
    Form(
        "VINS-Fusion",
        "likewise, `KANNALA_BRANDT`",
        lambda f: vins("equidistant", f),
        replace(true_rig("equidistant"), imu_noise=None),
        row=False,
    ),
    Form("Basalt", "`calibration.json`, `ds`", lambda f: basalt("double_sphere", f), true_rig("double_sphere")),
    Form("Basalt", "likewise, `kb4`", lambda f: basalt("equidistant", f), true_rig("equidistant"), row=False),
    Form("Basalt", "likewise, `eucm`", lambda f: basalt("eucm", f), true_rig("eucm"), row=False),
    Form("Basalt", "likewise, `ucm`", basalt_ucm, one_centre(), row=False),
    Form("Basalt", "likewise, `fov`", lambda f: basalt("fov", f), true_rig("fov"), row=False),
    Form(
        "DepthAI",
        "JSON of an OAK, linked through the colour camera",
        depthai,
        replace(true_rig(), imu_noise=None, time_offset_s=0.0),
    ),
    Form(
        "DepthAI",
        "likewise, links the other way round",
        lambda f: depthai(f, inverted=True),
        replace(true_rig(), imu_noise=None, time_offset_s=0.0),
        row=False,
    ),
    Form(
        "DepthAI",
        "likewise, fisheye (`cameraType` 1)",
        lambda f: depthai_of(f, 1, "equidistant"),
        replace(true_rig("equidistant"), imu_noise=None, time_offset_s=0.0),
        row=False,
    ),
    Form("DepthAI", "likewise, `cameraType` 3", lambda f: depthai_of(f, 3), None, row=False),
    Form("cuVSLAM", "`stereo.edex`", lambda f: edex(f, true_rig(), "brown"), imu_free(true_rig())),
    Form(
        "cuVSLAM",
        "likewise, `fisheye`",
        lambda f: edex(f, true_rig("equidistant"), "fisheye"),
        imu_free(true_rig("equidistant")),
        row=False,
    ),
    Form(
        "cuVSLAM",
        "likewise, `pinhole`",
        lambda f: edex(f, rectified_rig(), "pinhole"),
        imu_free(rectified_rig()),
        row=False,
    ),
    Form(
        "cuVSLAM",
        "likewise, `polynomial`",
        lambda f: edex(f, true_rig(), "polynomial"),
        imu_free(true_rig()),
        row=False,
    ),
    Form(
        "Spectacular AI",
        "`calibration.json`, no size",
        spectacular,
        replace(true_rig(), imu_noise=None, time_offset_s=0.0),
        SIZE,
    ),
    Form(
        "Spectacular AI",
        "likewise, `kannala-brandt4`",
        lambda f: spectacular(f, "equidistant"),
        replace(true_rig("equidistant"), imu_noise=None, time_offset_s=0.0),
        SIZE,
        row=False,
    ),
    Form("Monado", "`calibration_v2` JSON, `pinhole_radtan5`", monado, imu_free(true_rig())),
    Form(
        "Monado",
        "likewise, `fisheye_equidistant4`",
        lambda f: monado(f, "equidistant"),
        imu_free(true_rig("equidistant")),
        row=False,
    ),
    Form("ZED", "`SN*.conf`", zed, imu_free(true_rig()), SIZE),
    Form("ZED", "`SN*.conf` with `LEFT_DISTO`, fisheye", zed_x, imu_free(true_rig("equidistant")), SIZE, row=False),
    Form("ZED", "`SN*.conf`, images of another size", zed, None, (640, 480)),
    Form("MRPT", "`calib.ini`", mrpt, imu_free(true_rig()), row=False),
    Form("MRPT", "likewise of MRPT 2", mrpt2, imu_free(true_rig()), row=False),
    Form("MRPT", "likewise of MRPT 2, fisheye", mrpt2_fisheye, imu_free(true_rig("equidistant")), row=False),
    Form("MRPT", "`camera_params_raw_*.txt` of Malaga", mrpt_text, imu_free(true_rig()), row=False),
    Form("DSEC", "`cam_to_cam.yaml`", dsec, imu_free(rectified_rig()), row=False),
    Form("DrivingStereo", "`half-image-calib`", driving_stereo, imu_free(rectified_rig()), row=False),
    Form("Virtual KITTI", "`intrinsic.txt`", virtual_kitti, imu_free(rectified_rig()), SIZE, row=False),
    Form("OKVIS, OKVIS2", "`cameras:` with `T_SC`", okvis, true_rig()),
    Form("OKVIS2", "likewise, `cam_model: eucm`", okvis2_eucm, true_rig("eucm"), row=False),
    Form("maplab, SVO", "`cameras:` with `T_B_C`", ncamera, true_rig()),
    Form("maplab, SVO", "likewise, `fisheye`: the field-of-view model", lambda f: ncamera(f, "fov"), true_rig("fov")),
    Form(
        "maplab",
        "`sensors.yaml` with `T_C_B`",
        maplab,
        replace(true_rig(), imu_noise=None, time_offset_s=0.0),
    ),
    Form("Kimera", "`LeftCameraParams.yaml`, `ImuParams.yaml`", kimera, true_rig()),
    Form("4Seasons", "`undistorted_calib_*.txt`", four_seasons, imu_free(rectified_rig()), row=False),
    Form("OpenCV", "`M1 D1 M2 D2 R T`, size stated", lambda f: _opencv(f, 1.0, sized=True), imu_free(true_rig())),
    Form("OpenCV", "likewise, T in squares of the board", lambda f: _opencv(f, 40.0, sized=True), _LONGER),
    Form("OpenCV", "likewise, no size, images of half of it", lambda f: _opencv(f, 1.0, sized=False), None, (640, 360)),
    Form("OpenCV", "`omnidir`: `xi_1`, `rvec`, `tvec`", opencv_omnidir, imu_free(true_rig("unified"))),
    Form("OpenCV", "distortion by an unknown name", _opencv_other_names, None, row=False),
    Form("MATLAB", "`stereoParameters` as a structure, `.mat`", matlab, imu_free(true_rig())),
    Form("MATLAB", "likewise, JSON of R2022b", matlab_json, imu_free(true_rig()), row=False),
    Form("MATLAB", "likewise, in metres", lambda f: matlab(f, "m"), imu_free(true_rig()), row=False),
    Form("Bouguet's toolbox", "`Calib_Results_stereo.mat`", bouguet, imu_free(true_rig())),
    Form("KITTI", "`calib.txt`", _kitti, imu_free(rectified_rig()), SIZE),
    Form("KITTI", "`calib.txt`, images of 0.6 of its size", _kitti, None, (768, 432)),
    Form("BoofCV", "`stereo.yaml`", lambda f: _boofcv(f, 1.0), imu_free(true_rig())),
    Form("BoofCV", "`stereo.yaml`, in millimetres", lambda f: _boofcv(f, 1000.0), None),
)  # fmt: skip

if __name__ == "__main__":
    sys.stdout.write(table() + "\n")
