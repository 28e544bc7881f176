"""Predefined stereo rigs: KITTI-like, EuRoC-like, fisheye, wide, and a small one for demos and
tests.
"""

from __future__ import annotations

import numpy as np

from vio.geometry.distortion import CameraModel, StereoRig, rig_from_rectified
from vio.geometry.lie import FloatArray, nearest_rotation, se3_inverse
from vio.geometry.stereo import StereoCamera

# Camera axes (right, down, forward) in a body frame with x forward, y left, z up.
_R_CAM_FORWARD_BODY = np.array(
    [
        [0.0, -1.0, 0.0],
        [0.0, 0.0, -1.0],
        [1.0, 0.0, 0.0],
    ]
)

# Axes of EuRoC's IMU (up, right, forward) in a body with x forward, y left, z up.
R_FLU_EUROC_IMU = np.array(
    [
        [0.0, 0.0, 1.0],
        [0.0, -1.0, 0.0],
        [1.0, 0.0, 0.0],
    ]
)


def _forward_T_cam0_imu(cam0_in_imu: tuple[float, float, float]) -> FloatArray:
    T = np.eye(4)
    T[:3, :3] = _R_CAM_FORWARD_BODY
    T[:3, 3] = -_R_CAM_FORWARD_BODY @ np.asarray(cam0_in_imu)
    return T


def small_rig(width: int = 640, height: int = 360) -> StereoRig:
    """Rectified rig for demos and tests: about 77 degrees wide, 12 cm baseline, IMU axes
    forward, left, up.
    """
    f = 0.625 * width
    camera = StereoCamera(f, f, (width - 1) / 2, (height - 1) / 2, 0.12, width, height)
    return rig_from_rectified(camera, _forward_T_cam0_imu((0.05, 0.06, 0.02)))


def kitti_like_rig(width: int = 1242) -> StereoRig:
    """Rectified rig like KITTI's gray pair (1242x375, 0.537 m), scaled to any width.

    The IMU is behind, below and to the left of the left camera, its axes forward, left, up.
    Reference: Geiger et al., Vision meets robotics: the KITTI dataset (2013).
    """
    scale = width / 1242
    f = 721.5377 * scale
    camera = StereoCamera(
        f,
        f,
        (609.5593 + 0.5) * scale - 0.5,
        (172.854 + 0.5) * scale - 0.5,
        0.5371657,
        width,
        round(375 * scale),
    )
    return rig_from_rectified(camera, _forward_T_cam0_imu((1.0891, -0.3141, 0.7195)))


def euroc_like_rig() -> StereoRig:
    """EuRoC's VI-Sensor: 752x480, radial-tangential, unrectified, with the published calibration of
    V1.

    Reference: Burri et al., The EuRoC micro aerial vehicle datasets (2016), sensor.yaml of
    V1_01_easy.
    """
    T_imu_cam0 = np.array(
        [
            [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
            [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
            [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    T_imu_cam1 = np.array(
        [
            [0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
            [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
            [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    for T in (T_imu_cam0, T_imu_cam1):
        T[:3, :3] = nearest_rotation(T[:3, :3])
    lens0 = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    lens1 = (-0.28368365, 0.07451284, -0.00010473, -3.555907e-05)
    cam0 = CameraModel(458.654, 457.296, 367.215, 248.375, 752, 480, "radtan", lens0)
    cam1 = CameraModel(457.587, 456.134, 379.999, 255.238, 752, 480, "radtan", lens1)
    return StereoRig(cam0, cam1, T_imu_cam0, T_imu_cam1)


def euroc_rectified_rig() -> StereoRig:
    """Rectified 752x480 pair mounted as EuRoC's: the same body, focal length and baseline,
    without distortion.
    """
    rig = euroc_like_rig()
    baseline = float(np.linalg.norm(rig.T_cam0_cam1[:3, 3]))
    camera = StereoCamera(458.0, 458.0, 375.5, 239.5, baseline, 752, 480)
    return rig_from_rectified(camera, se3_inverse(rig.T_imu_cam0))


def fisheye_rig(width: int = 640, height: int = 480) -> StereoRig:
    """Unrectified equidistant (fisheye) pair, about 130 degrees wide, slightly toed, IMU axes
    forward, left, up.
    """
    f = 0.44 * width
    lens0 = (-0.012, 0.006, -0.004, 0.0006)
    lens1 = (-0.013, 0.007, -0.004, 0.0005)
    cam0 = CameraModel(f, f, 0.49 * width, 0.505 * height, width, height, "equidistant", lens0)
    centre1 = 0.503 * width, 0.497 * height
    cam1 = CameraModel(f * 1.003, f * 1.002, *centre1, width, height, "equidistant", lens1)
    T_imu_cam0 = se3_inverse(_forward_T_cam0_imu((0.04, 0.055, 0.01)))
    toe = 0.01
    T_cam0_cam1 = np.eye(4)
    T_cam0_cam1[:3, :3] = [
        [np.cos(toe), 0, -np.sin(toe)],
        [0, 1, 0],
        [np.sin(toe), 0, np.cos(toe)],
    ]
    T_cam0_cam1[:3, 3] = [0.11, 0.001, -0.002]
    return StereoRig(cam0, cam1, T_imu_cam0, T_imu_cam0 @ T_cam0_cam1)


def wide_rig(width: int = 512) -> StereoRig:
    """Unrectified equidistant pair like TUM-VI's: square images, 154 degrees across and 220 from
    corner to corner.

    The lenses are those of its 512x512 calibration, with the two cameras pitched against each other
    by 2.7 degrees as there; IMU axes forward, left, up.
    Reference: Schubert et al., The TUM VI benchmark for evaluating visual-inertial odometry (2018).
    """
    s = width / 512
    lens0 = (0.003482389, 0.000715035, -0.002053236, 0.000202937)
    lens1 = (0.003400317, 0.001766278, -0.002663126, 0.000329952)
    cam0 = CameraModel(
        190.98 * s, 190.97 * s, 254.93 * s, 256.90 * s, width, width, "equidistant", lens0
    )
    cam1 = CameraModel(
        190.44 * s, 190.43 * s, 252.60 * s, 254.92 * s, width, width, "equidistant", lens1
    )
    T_imu_cam0 = se3_inverse(_forward_T_cam0_imu((0.04, 0.0505, 0.01)))
    pitch = 0.0469
    T_cam1_cam0 = np.eye(4)
    T_cam1_cam0[1:3, 1:3] = [
        [np.cos(pitch), -np.sin(pitch)],
        [np.sin(pitch), np.cos(pitch)],
    ]
    T_cam1_cam0[:3, 3] = [-0.10092, -0.00196, -0.00147]
    return StereoRig(cam0, cam1, T_imu_cam0, T_imu_cam0 @ se3_inverse(T_cam1_cam0))
