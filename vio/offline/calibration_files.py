"""Files of a measured calibration: Kalibr's camchain and EuRoC's sensor.yaml."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from vio.calibration.inertial import ImuAlignment
from vio.calibration.lever_arm import LeverArm
from vio.calibration.stereo import StereoEstimate
from vio.calibration.stereo_field import rig_off_by
from vio.cameras.rig import Rig
from vio.datasets.euroc_files import camera_yaml, median_rate_hz
from vio.datasets.image_pairs import ImageDataset
from vio.datasets.rigs.kalibr import kalibr_text
from vio.geometry.distortion import StereoRig
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.offline.calibrate import CalibrationReport

_USUAL_RATE_HZ = 20.0  # where there are no time stamps to derive it from


CAMCHAIN = "camchain-imucam.yaml"


def write_calibration_report(folder: Path, report: CalibrationReport) -> None:
    """Write the measured calibration in both formats, with the given values where it is not
    observable.

    Nothing is written for features without an image size. The folder must exist.
    """
    rig = report.source.rig
    if rig is None:
        return
    stereo = _measured_stereo(report, rig)
    T_cam0_imu, offset_s = _measured_imu(report, rig)
    T_imu_cam0 = se3_inverse(T_cam0_imu)
    poses = {"cam0": T_imu_cam0, "cam1": T_imu_cam0 @ se3_inverse(stereo.right[1])}
    cameras = dict(zip(("cam0", "cam1"), stereo.cameras, strict=True))
    dataset = report.source.dataset
    if dataset is None:
        times = np.zeros(0, dtype=np.int64)
    else:
        times = dataset.recording.frame_times_ns
    rate_hz = median_rate_hz(times) or _USUAL_RATE_HZ
    for name, camera in cameras.items():
        if camera.lens.files.sensor_yaml is None:
            continue  # Kalibr's file has names for the other models
        (folder / name).mkdir()
        (folder / name / "sensor.yaml").write_text(
            camera_yaml(camera, poses[name], comment=f"{name}, by vio calibrate", rate_hz=rate_hz),
            encoding="utf-8",
        )
    measured = replace(stereo, T_cam0_imu=T_cam0_imu, time_offset_s=offset_s)
    (folder / CAMCHAIN).write_text(kalibr_text(measured), encoding="utf-8")


def _measured_stereo(report: CalibrationReport, given: StereoRig) -> Rig:
    """Return the cameras as measured, with the given length of the baseline, focal length and
    principal point.
    """
    rig = Rig(given.cam0, given.cam1, se3_inverse(given.T_cam0_cam1))
    if not isinstance(report.stereo, StereoEstimate):
        return rig
    length = float(np.linalg.norm(given.T_cam0_cam1[:3, 3]))
    R = report.stereo.R_cam1_cam0
    # what lenses and principal point share with the rotation, is apart there
    if report.in_motion is not None:
        rig = rig_off_by(rig, report.in_motion.rig_parameters())
        R = rig.right[1][:3, :3]
    return replace(rig, T_cam1_cam0=se3_from_parts(R, -length * R @ report.stereo.direction))


def _measured_imu(report: CalibrationReport, rig: StereoRig) -> tuple[FloatArray, float]:
    """Return `T_cam0_imu` (4, 4) of the raw left camera, and the IMU's clock minus the camera's
    in seconds.
    """
    T_cam0_imu = se3_inverse(rig.T_imu_cam0)
    offset_s = 0.0
    alignment = report.imu.alignment
    lever_arm = report.imu.lever_arm
    dataset = report.source.dataset
    R_rect_cam0 = np.eye(3)  # the motion was measured with the rectified camera
    if isinstance(dataset, ImageDataset) and dataset.rectifier.maps is not None:
        R_rect_cam0 = (dataset.rectifier.T_rect0_imu @ rig.T_imu_cam0)[:3, :3]
    if isinstance(alignment, ImuAlignment) and alignment.weak is None:
        T_cam0_imu = se3_from_parts(R_rect_cam0.T @ alignment.R_cam0_imu, T_cam0_imu[:3, 3])
        offset_s = alignment.time_offset_s
    if isinstance(lever_arm, LeverArm):
        T_cam0_imu = se3_from_parts(T_cam0_imu[:3, :3], R_rect_cam0.T @ lever_arm.t_cam0_imu)
    return T_cam0_imu, offset_s
