"""Files of a rig that was calibrated with a board: Kalibr, ROS, OpenCV, Basalt, and a report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vio.cameras.rig import Rig
from vio.datasets.rigs.kalibr import kalibr_text
from vio.datasets.yaml_files import densities_text
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.rectify import rectifying_rotations
from vio.records import ImuDensities

CAMCHAIN = "camchain-imucam.yaml"
IMU = "imu.yaml"
# of basalt-headers' `calibration.hpp`
_BASALT_NOISE = ImuDensities(gyro=2.82e-4, gyro_walk=1e-4, accel=0.016, accel_walk=1e-3)


def write_rig(folder: Path, rig: Rig) -> list[str]:
    """Write a rig in every form that holds it, into an existing folder; return the names."""
    written = {CAMCHAIN: kalibr_text(rig)}
    if rig.imu_noise is not None:
        written[IMU] = densities_text(rig.imu_noise, units=True)
    if rig.cam1 is not None:
        written |= _pair_texts(rig)
    if (basalt := basalt_text(rig)) is not None:
        written["basalt.json"] = basalt
    for name, text in written.items():
        (folder / name).write_text(text, encoding="utf-8")
    return list(written)


def _pair_texts(rig: Rig) -> dict[str, str]:
    """Return the files of OpenCV and ROS of a pair, where these know the lens model."""
    out: dict[str, str] = {}
    if all(camera.lens.files.opencv for camera in rig.cameras):
        out["stereo.yml"] = opencv_text(rig)
    if all(_ros_name(camera) is not None for camera in rig.cameras):
        P = _projections(rig)
        for k, (name, camera) in enumerate(zip(("left", "right"), rig.cameras, strict=True)):
            out[f"{name}.yaml"] = _camera_info_text(name, camera, *P[k])
    return out


def _projections(rig: Rig) -> list[tuple[FloatArray, FloatArray]]:
    """Rotation (3, 3) and projection (3, 4) of each rectified camera."""
    camera = rig.camera
    R0, R1 = rectifying_rotations(rig.stereo)[:2]
    P0 = np.zeros((3, 4))
    P0[:, :3] = camera.K
    P1 = P0.copy()
    P1[0, 3] = -camera.fu * camera.baseline_m
    return [(R0, P0), (R1, P1)]


def _ros_name(camera: CameraModel) -> str | None:
    return camera.lens.files.ros.get(len(camera.coefficients))


def _camera_info_text(name: str, camera: CameraModel, R: FloatArray, P: FloatArray) -> str:
    coefficients = list(camera.coefficients)
    model = _ros_name(camera)
    if model == "plumb_bob":
        coefficients = [*coefficients, *[0.0] * (5 - len(coefficients))]

    def block(values: FloatArray) -> dict[str, Any]:
        rows, cols = np.atleast_2d(values).shape
        return {"rows": rows, "cols": cols, "data": [float(x) for x in np.ravel(values)]}

    sheet = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": block(camera.K),
        "distortion_model": model,
        "distortion_coefficients": block(np.array(coefficients)),
        "rectification_matrix": block(R),
        "projection_matrix": block(P),
    }
    return yaml.safe_dump(sheet, sort_keys=False, default_flow_style=None)


def opencv_text(rig: Rig) -> str:
    """Return a pair as OpenCV's FileStorage: M1 D1 M2 D2 R T and the image size."""
    cam1, T = rig.right
    lines = ["%YAML:1.0", "---", f"image_width: {cam1.width}", f"image_height: {cam1.height}"]
    entries = {
        "M1": rig.cam0.K,
        "D1": np.atleast_2d(rig.cam0.coefficients or (0.0,) * 4),
        "M2": cam1.K,
        "D2": np.atleast_2d(cam1.coefficients or (0.0,) * 4),
        "R": T[:3, :3],
        "T": T[:3, 3:],
    }
    for key, M in entries.items():
        values = ", ".join(repr(float(x)) for x in np.ravel(M))
        lines += [
            f"{key}: !!opencv-matrix",
            f"   rows: {M.shape[0]}",
            f"   cols: {M.shape[1]}",
            "   dt: d",
            f"   data: [ {values} ]",
        ]
    return "\n".join(lines) + "\n"


def basalt_text(rig: Rig, imu_hz: float = 200.0) -> str | None:
    """Return a rig as Basalt's calibration; None: Basalt knows no such lens."""
    intrinsics = [_basalt_camera(camera) for camera in rig.cameras]
    if None in intrinsics:
        return None
    if rig.T_cam0_imu is None:
        T_imu_cam0 = np.eye(4)
    else:
        T_imu_cam0 = se3_inverse(rig.T_cam0_imu)
    poses = [T_imu_cam0]
    if rig.cam1 is not None:
        poses.append(T_imu_cam0 @ se3_inverse(rig.right[1]))
    value: dict[str, Any] = {
        "T_imu_cam": [_basalt_pose(T) for T in poses],
        "intrinsics": intrinsics,
        "resolution": [[camera.width, camera.height] for camera in rig.cameras],
        "calib_accel_bias": [0.0] * 9,
        "calib_gyro_bias": [0.0] * 12,
        "cam_time_offset_ns": round(1e9 * rig.time_offset_s),
        "vignette": [],
        "imu_update_rate": imu_hz,
    }
    # Basalt reads no file without them; these are its own where the rig states none
    noise = rig.imu_noise or _BASALT_NOISE
    value |= {
        "accel_noise_std": [noise.accel] * 3,
        "gyro_noise_std": [noise.gyro] * 3,
        "accel_bias_std": [noise.accel_walk] * 3,
        "gyro_bias_std": [noise.gyro_walk] * 3,
    }
    return json.dumps({"value0": value}, indent=2) + "\n"


def _basalt_camera(camera: CameraModel) -> dict[str, Any] | None:
    names = camera.lens.files
    if names.basalt is None:
        return None
    missing = len(camera.lens.parameters) - len(camera.coefficients)
    full = (*camera.coefficients, *[0.0] * missing)
    values = {
        "fx": camera.fu,
        "fy": camera.fv,
        "cx": camera.cu,
        "cy": camera.cv,
        **dict(zip(camera.lens.parameters, full, strict=True)),
        **names.basalt_constants,
    }
    return {"camera_type": names.basalt, "intrinsics": values}


def _basalt_pose(T: FloatArray) -> dict[str, float]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    px, py, pz = T[:3, 3].tolist()
    return {"px": px, "py": py, "pz": pz, "qx": x, "qy": y, "qz": z, "qw": w}
