"""Files of a measured calibration: Kalibr's camchain and EuRoC's sensor.yaml."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vio.calibration.inertial import ImuAlignment
from vio.calibration.lever_arm import LeverArm
from vio.calibration.stereo import StereoEstimate
from vio.datasets.euroc_files import camera_yaml, median_rate_hz
from vio.datasets.rectified import RectifiedDataset
from vio.geometry.distortion import CameraModel, StereoRig
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.offline.calibrate import CalibrationReport

_KALIBR_MODELS = {"pinhole": "none", "radtan": "radtan", "equidistant": "equidistant"}
_USUAL_RATE_HZ = 20.0  # where there are no time stamps to derive it from


def write_calibration(folder: Path, report: CalibrationReport) -> None:
    """Write the measured calibration in both formats, with the given values where it is not observable.

    Nothing is written for features without an image size. The folder must exist.
    """
    rig = report.source.rig
    if rig is None:
        return
    T_cam0_cam1 = _measured_stereo(report, rig)
    T_cam0_imu, offset_s = _measured_imu(report, rig)
    T_imu_cam0 = se3_inverse(T_cam0_imu)
    poses = {"cam0": T_imu_cam0, "cam1": T_imu_cam0 @ T_cam0_cam1}
    cameras = {"cam0": rig.cam0, "cam1": rig.cam1}
    dataset = report.source.dataset
    times = np.zeros(0, dtype=np.int64) if dataset is None else dataset.recording.frame_times_ns
    rate_hz = median_rate_hz(times) or _USUAL_RATE_HZ
    for name, camera in cameras.items():
        (folder / name).mkdir()
        (folder / name / "sensor.yaml").write_text(
            camera_yaml(camera, poses[name], comment=f"{name}, by vio calibrate", rate_hz=rate_hz), encoding="utf-8"
        )
    (folder / "camchain-imucam.yaml").write_text(_kalibr(cameras, poses, T_cam0_cam1, offset_s), encoding="utf-8")


def _measured_stereo(report: CalibrationReport, rig: StereoRig) -> FloatArray:
    """Return `T_cam0_cam1` (4, 4) as measured, with the given length of the baseline."""
    if not isinstance(report.stereo, StereoEstimate):
        return rig.T_cam0_cam1
    length = float(np.linalg.norm(rig.T_cam0_cam1[:3, 3]))
    return se3_from_parts(report.stereo.R_cam1_cam0.T, length * report.stereo.direction)


def _measured_imu(report: CalibrationReport, rig: StereoRig) -> tuple[FloatArray, float]:
    """Return `T_cam0_imu` (4, 4) of the raw left camera, and the IMU's clock minus the camera's in seconds."""
    T_cam0_imu, offset_s = se3_inverse(rig.T_imu_cam0), 0.0
    alignment, lever_arm, dataset = report.imu.alignment, report.imu.lever_arm, report.source.dataset
    R_rect_cam0 = np.eye(3)  # the motion was measured with the rectified camera
    if isinstance(dataset, RectifiedDataset):
        R_rect_cam0 = (dataset.rectifier.T_rect0_imu @ rig.T_imu_cam0)[:3, :3]
    if isinstance(alignment, ImuAlignment) and alignment.weak is None:
        T_cam0_imu = se3_from_parts(R_rect_cam0.T @ alignment.R_cam0_imu, T_cam0_imu[:3, 3])
        offset_s = alignment.time_offset_s
    if isinstance(lever_arm, LeverArm):
        T_cam0_imu = se3_from_parts(T_cam0_imu[:3, :3], R_rect_cam0.T @ lever_arm.t_cam0_imu)
    return T_cam0_imu, offset_s


def _kalibr(
    cameras: Mapping[str, CameraModel], poses: Mapping[str, FloatArray], T_cam0_cam1: FloatArray, offset_s: float
) -> str:
    """Return Kalibr's camchain: `T_cam_imu` maps the IMU to the camera, `t_imu = t_cam + timeshift_cam_imu`.

    Args:
        cameras: by name.
        poses: (4, 4) `T_imu_cam` of each.
        T_cam0_cam1: (4, 4).
        offset_s: IMU's clock minus the camera's.
    """
    chain: dict[str, Any] = {}
    for name, camera in cameras.items():
        sheet: dict[str, Any] = {"T_cam_imu": se3_inverse(poses[name]).tolist()}
        if name == "cam1":
            sheet["T_cn_cnm1"] = se3_inverse(T_cam0_cam1).tolist()
        sheet |= {
            "camera_model": "pinhole",
            "distortion_model": _KALIBR_MODELS[camera.model],
            "distortion_coeffs": [float(c) for c in camera.coefficients[:4]],
            "intrinsics": [camera.fu, camera.fv, camera.cu, camera.cv],
            "resolution": [camera.width, camera.height],
            "timeshift_cam_imu": offset_s,
        }
        chain[name] = sheet
    return yaml.safe_dump(chain, sort_keys=False, default_flow_style=None)
