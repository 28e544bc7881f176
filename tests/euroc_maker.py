"""Small EuRoC folders and KITTI raw drives, for tests of their readers and users."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from vio.geometry.distortion import CameraModel, StereoRig
from vio.geometry.lie import (
    FloatArray,
    quat_xyzw_from_rotation,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    so3_exp,
)

START_NS = 1403715273262142976
STEP_NS = 50_000_000
WIDTH, HEIGHT = 64, 48

T_IMU_CAM0 = se3_from_parts(
    np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ so3_exp([0.02, -0.01, 0.015]),
    [-0.02, -0.065, 0.01],
)
_T_CAM0_CAM1 = se3_from_parts(so3_exp([0.004, -0.006, 0.003]), [0.11, 0.0004, -0.0006])
_CAM0 = CameraModel(41.0, 40.8, 31.2, 24.1, WIDTH, HEIGHT, "radtan", (-0.28, 0.07, 2e-4, 2e-5))
_CAM1 = CameraModel(40.9, 40.7, 32.1, 23.6, WIDTH, HEIGHT, "radtan", (-0.28, 0.07, -1e-4, -3e-5))
RADTAN_RIG = StereoRig(_CAM0, _CAM1, T_IMU_CAM0, T_IMU_CAM0 @ _T_CAM0_CAM1)
EQUIDISTANT_RIG = replace(
    RADTAN_RIG,
    cam0=replace(_CAM0, model="equidistant", coefficients=(-0.01, 0.006, -0.004, 0.0006)),
    cam1=replace(_CAM1, model="equidistant", coefficients=(-0.013, 0.007, -0.004, 0.0005)),
)
_PINHOLE = CameraModel(40.0, 40.0, 31.5, 23.5, WIDTH, HEIGHT)
RECTIFIED_RIG = StereoRig(
    _PINHOLE, _PINHOLE, T_IMU_CAM0, T_IMU_CAM0 @ se3_from_parts(np.eye(3), [0.11, 0, 0])
)

IMU_HEADER = "#timestamp [ns],w_x [rad s^-1],w_y,w_z,a_x [m s^-2],a_y,a_z"
IMU_YAML = """%YAML:1.0
#Default imu sensor yaml file
sensor_type: imu
T_BS:
  cols: 4
  rows: 4
  data: [{rows}]
rate_hz: 200
gyroscope_noise_density: 1.6968e-04     # [ rad / s / sqrt(Hz) ]
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
"""


def camera_stamps(frames: int) -> list[int]:
    """Times of the images, nanoseconds."""
    return [START_NS + k * STEP_NS for k in range(frames)]


def imu_stamps(frames: int) -> list[int]:
    """Times of the IMU, 5 ms apart, from before the first image to after the last; some are
    those of an image.
    """
    first, last = START_NS - 2 * 5_000_000, START_NS + (frames - 1) * STEP_NS + 2 * 5_000_000
    return list(range(first, last + 1, 5_000_000))


def sensor_yaml(camera: CameraModel, T_body_cam: FloatArray) -> str:
    """A camera's `sensor.yaml` as EuRoC's are written."""
    model = {
        "radtan": "radial-tangential",
        "equidistant": "equidistant",
        "pinhole": "radial-tangential",
    }[camera.model]
    numbers = ", ".join(map(repr, (camera.fu, camera.fv, camera.cu, camera.cv)))
    return (
        "%YAML:1.0\n# General sensor definitions.\nsensor_type: camera\ncomment: made camera\n\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{matrix(T_body_cam)}]\n\nrate_hz: 20\n"
        f"resolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{numbers}] #fu, fv, cu, cv\n"
        f"distortion_model: {model}\n"
        f"distortion_coefficients: [{', '.join(map(repr, camera.coefficients or (0.0,) * 4))}]\n"
    )


def matrix(T: FloatArray) -> str:
    """Sixteen numbers with all digits."""
    return ", ".join(repr(float(x)) for x in np.ravel(T))


def truth_poses(frames: int) -> FloatArray:
    """Poses (F, 4, 4) of the IMU."""
    return np.array(
        [se3_exp(0.1 * k * np.array([1.0, 0.4, -0.2, 0.1, -0.3, 0.2])) for k in range(frames)]
    )


def make_euroc(
    folder: Path,
    frames: int = 4,
    *,
    rig: StereoRig = RADTAN_RIG,
    imu: bool = True,
    truth: str | None = "state",
    suffix: str = ".png",
    right_offsets_ns: Sequence[int] | int = 0,
) -> Path:
    """Write an EuRoC folder of noise images; `truth` is "state" (EuRoC's csv), "tum" or None."""
    offsets = (
        [right_offsets_ns] * frames if isinstance(right_offsets_ns, int) else list(right_offsets_ns)
    )
    rng = np.random.default_rng(frames)
    stamps = camera_stamps(frames)
    for name, camera, T, times in (
        ("cam0", rig.cam0, rig.T_imu_cam0, stamps),
        ("cam1", rig.cam1, rig.T_imu_cam1, [t + o for t, o in zip(stamps, offsets, strict=True)]),
    ):
        data = folder / "mav0" / name / "data"
        data.mkdir(parents=True)
        (data.parent / "sensor.yaml").write_text(sensor_yaml(camera, T))
        (data.parent / "data.csv").write_text(
            "#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\n" for t in times)
        )
        for t in times:
            assert cv2.imwrite(str(data / f"{t}{suffix}"), noise_image(rng, camera))
    if imu:
        write_imu(folder / "mav0" / "imu0", frames)
    poses = truth_poses(frames)
    q = quat_xyzw_from_rotation(poses[:, :3, :3])
    if truth == "state":
        (folder / "mav0" / "state_groundtruth_estimate0").mkdir()
        rows = [
            [t, *T[:3, 3], *np.roll(x, 1), *np.zeros(9)]
            for t, T, x in zip(stamps, poses, q, strict=True)
        ]
        text = "#timestamp, p, q_wxyz, v, b_w, b_a\n" + "".join(
            ",".join(map(str, row)) + "\n" for row in rows
        )
        (folder / "mav0" / "state_groundtruth_estimate0" / "data.csv").write_text(text)
    elif truth == "tum":
        lines = [
            f"{t // 10**9}.{t % 10**9:09d} " + " ".join(map(str, [*T[:3, 3], *x]))
            for t, T, x in zip(stamps, poses, q, strict=True)
        ]
        (folder / "groundtruth_tum.txt").write_text(
            "# timestamp(s) tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n"
        )
    return folder


def noise_image(rng: np.random.Generator, camera: CameraModel) -> np.ndarray:
    """A smooth random image, so that interpolation methods agree within a few gray levels."""
    image = rng.integers(0, 256, (camera.height, camera.width)).astype(np.float32)
    smooth = cv2.GaussianBlur(image, (0, 0), 2.0)
    return np.asarray(np.clip(128 + 5 * (smooth - 128), 0, 255), dtype=np.uint8)


def write_imu(folder: Path, frames: int, T_body_imu: FloatArray | None = None) -> None:
    """Write `imu0` with readings that identify their sample."""
    folder.mkdir(exist_ok=True)
    (folder / "sensor.yaml").write_text(
        IMU_YAML.format(rows=matrix(np.eye(4) if T_body_imu is None else T_body_imu))
    )
    rows = [f"{t},{k}.5,0.1,-0.2,9.81,{-k},0.25" for k, t in enumerate(imu_stamps(frames))]
    (folder / "data.csv").write_text("\n".join([IMU_HEADER, *rows]) + "\n")


# --- KITTI raw
# --------------------------------------------------------------------------------------------------

T_CAM0_VELO = se3_from_parts(
    np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]) @ so3_exp([0.01, 0.005, 0]), [0, -0.08, -0.27]
)
T_VELO_IMU = se3_from_parts(so3_exp([0.001, 0.002, -0.01]), [-0.81, 0.32, -0.8])
KITTI_RIG = StereoRig(
    replace(_CAM0, coefficients=(-0.37, 0.2, 2e-3, 1e-3, -0.07)),
    replace(_CAM1, coefficients=(-0.36, 0.18, 1e-3, -6e-4, -0.05)),
    np.eye(4),
    _T_CAM0_CAM1,
)
RECT_SIZE = (56, 40)


def calib_cam_to_cam() -> str:
    """`calib_cam_to_cam.txt` of `KITTI_RIG`; rectified cameras of 56 x 40 pixels, 38 px focal
    length, 11 cm apart.
    """
    rig, T_cam1_cam0 = KITTI_RIG, se3_inverse(KITTI_RIG.T_cam0_cam1)
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    for k, camera, T, shift in (
        ("00", rig.cam0, np.eye(4), 0.0),
        ("01", rig.cam1, T_cam1_cam0, -38.0 * 0.11),
    ):
        entries: dict[str, npt.ArrayLike] = {
            "S": (camera.width, camera.height),
            "K": camera.K,
            "D": camera.coefficients,
            "R": T[:3, :3],
            "T": T[:3, 3],
            "S_rect": RECT_SIZE,
            "R_rect": so3_exp([0.004, 0.01, -0.002]),
            "P_rect": np.array([[38.0, 0, 27, shift], [0, 38, 19, 0], [0, 0, 1, 0]]),
        }
        lines += [
            f"{name}_{k}: {' '.join(f'{x:.12e}' for x in np.ravel(value))}"
            for name, value in entries.items()
        ]
    return "\n".join(lines) + "\n"


def rigid_text(T: FloatArray) -> str:
    """`calib_velo_to_cam.txt` and the like."""
    R, t = (" ".join(f"{x:.12e}" for x in np.ravel(part)) for part in (T[:3, :3], T[:3, 3]))
    return f"calib_time: 15-Mar-2012 11:37:16\nR: {R}\nT: {t}\n"


def make_kitti_raw(
    folder: Path,
    numbers: Sequence[int] = (100, 101, 102, 103),
    *,
    rectified: bool = False,
    above: bool = False,
) -> Path:
    """Write a drive; with `above`, its calibration is in the parent folder, as in KITTI's
    layout.
    """
    drive = folder / "2011_09_26_drive_0039_extract" if above else folder
    rng = np.random.default_rng(0)
    small = replace(KITTI_RIG.cam0, width=RECT_SIZE[0], height=RECT_SIZE[1])
    for name in ("image_00", "image_01"):
        (drive / name / "data").mkdir(parents=True)
        for number in numbers:
            image = noise_image(rng, small if rectified else KITTI_RIG.cam0)
            assert cv2.imwrite(str(drive / name / "data" / f"{number:010d}.png"), image)
    (folder / "calib_cam_to_cam.txt").write_text(calib_cam_to_cam())
    (folder / "calib_velo_to_cam.txt").write_text(
        rigid_text(T_CAM0_VELO) + "delta_f: 0 0\ndelta_c: 0 0\n"
    )
    (folder / "calib_imu_to_velo.txt").write_text(rigid_text(T_VELO_IMU))
    return drive
