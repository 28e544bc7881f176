"""Small valid recordings written to a folder, for tests of the readers and their users."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
from scipy.io import savemat

from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_inverse, so3_exp, so3_log
from vio.geometry.stereo import StereoCamera, project

CAMERA = StereoCamera(700.0, 710.0, 600.0, 180.0, 0.54)
R_CAM0_IMU = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]) @ so3_exp([0.01, -0.02, 0.015])
LEVER_M = np.array([1.1, -0.3, 0.7])  # the camera's position in the imu frame
T_CAM0_IMU = se3_from_parts(R_CAM0_IMU, -R_CAM0_IMU @ LEVER_M)
FRAME_S = 0.1


@dataclass(frozen=True, slots=True)
class Drive:
    """A vehicle on a winding road and its features."""

    seconds: FloatArray  # (F,)
    T_world_imu: FloatArray  # (F, 4, 4)
    velocities: FloatArray  # (F, 6) [v; omega] from each pose to the next
    features: FloatArray  # (4, M, F), -1 where not seen
    points: FloatArray  # (M, 3) world


def make_drive(
    frames: int = 12, *, seed: int = 0, pixel_sigma: float = 0.0, yaw_rate: float = 0.4
) -> Drive:
    """Drive along a slalom between random points; the velocities integrate to the poses exactly."""
    rng = np.random.default_rng(seed)
    k = np.arange(frames)
    velocities = np.zeros((frames, 6))
    velocities[:, 0] = 6 + 2 * np.sin(k / 17)
    velocities[:, 5] = yaw_rate * np.sin(k / 11)
    T = [np.eye(4)]
    for u in velocities[:-1]:
        T.append(T[-1] @ se3_exp(FRAME_S * u))
    T_world_imu = np.array(T)
    anchors = rng.integers(0, frames, 25 * frames)
    ahead = rng.uniform([5, -9, -2], [30, 9, 3], (len(anchors), 3))
    points = (
        np.einsum("nij,nj->ni", T_world_imu[anchors, :3, :3], ahead) + T_world_imu[anchors, :3, 3]
    )
    features = np.full((4, len(points), frames), -1.0)
    for t in range(frames):
        T_cam_world = T_CAM0_IMU @ se3_inverse(T_world_imu[t])
        p = points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
        near = (p[:, 2] > 3) & (p[:, 2] < 30)
        z = project(CAMERA, np.where(near[:, None], p, [0.0, 0.0, 1.0]))
        seen = near & (z >= 0).all(axis=1) & (z[:, 0] < 1240) & (z[:, 1] < 370)
        features[:, seen, t] = z[seen].T + pixel_sigma * rng.standard_normal((4, int(seen.sum())))
    kept = (features[0] != -1).sum(axis=1) >= 2
    seconds = 1317386425.5 + FRAME_S * k
    return Drive(seconds, T_world_imu, velocities, features[:, kept], points[kept])


def ece276a_arrays(drive: Drive) -> dict[str, npt.NDArray[np.float64]]:
    """The arrays of an ECE276A file of the first kind, with a consistent `cam_T_imu`."""
    return {
        "time_stamps": drive.seconds[None],
        "features": drive.features,
        "linear_velocity": drive.velocities[:, :3].T,
        "rotational_velocity": drive.velocities[:, 3:].T,
        "K": CAMERA.K,
        "b": np.array(CAMERA.baseline_m),
        "cam_T_imu": T_CAM0_IMU,
    }


def ece276a_new_arrays(drive: Drive) -> dict[str, npt.NDArray[np.float64]]:
    """The arrays of an ECE276A file with the newer key names."""
    old = ece276a_arrays(drive)
    T_cam1_cam0 = se3_from_parts(np.eye(3), [-CAMERA.baseline_m, 0, 0])
    return {
        "timestamps": drive.seconds,
        "features": old["features"],
        "v_t": old["linear_velocity"],
        "w_t": old["rotational_velocity"],
        "K_l": CAMERA.K,
        "K_r": CAMERA.K,
        "extL_T_imu": T_CAM0_IMU,
        "extR_T_imu": T_cam1_cam0 @ T_CAM0_IMU,
    }


def make_npz(path: Path, arrays: Mapping[str, npt.NDArray[np.generic]]) -> Path:
    """Write arrays into an `.npz`."""
    with path.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type] # the stubs take every keyword for allow_pickle
    return path


def utias_arrays(drive: Drive) -> dict[str, npt.NDArray[np.float64]]:
    """The variables of a UTIAS file; velocities and poses cover three frames more than the
    features.
    """
    longer = np.pad(drive.velocities, ((0, 3), (0, 0)), mode="edge")
    poses = np.concatenate([drive.T_world_imu, np.tile(drive.T_world_imu[-1:], (3, 1, 1))])
    return {
        "y_k_j": np.swapaxes(drive.features, 1, 2),
        "t": drive.seconds[None],
        "v_vk_vk_i": longer[:, :3].T,
        "w_vk_vk_i": longer[:, 3:].T,
        "fu": np.array(CAMERA.fu),
        "fv": np.array(CAMERA.fv),
        "cu": np.array(CAMERA.cu),
        "cv": np.array(CAMERA.cv),
        "b": np.array(CAMERA.baseline_m),
        "C_c_v": R_CAM0_IMU,
        "rho_v_c_v": LEVER_M[:, None],
        "r_i_vk_i": poses[:, :3, 3].T,
        "theta_vk_i": so3_log(poses[:, :3, :3]).T,
    }


def make_mat(path: Path, arrays: Mapping[str, npt.NDArray[np.generic]]) -> Path:
    """Write variables into a MATLAB 5 file."""
    savemat(path, dict(arrays))
    return path


def make_images(folder: Path, frames: int, *, channels: int = 1, depth: int = 8) -> None:
    """Write small images (24 x 32) whose gray values differ from frame to frame."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(frames)
    for k in range(frames):
        shape = (24, 32) if channels == 1 else (24, 32, channels)
        dtype, top = (np.uint8, 256) if depth == 8 else (np.uint16, 65536)
        assert cv2.imwrite(str(folder / f"{k:06d}.png"), rng.integers(0, top, shape).astype(dtype))


def calib_text(*offsets_m: float) -> str:
    """The lines `P0: …` of rectified cameras at the given places on the x axis of camera 0."""
    lines = [
        f"P{k}: 7.0e+02 0 1.6e+01 {-700 * x:e} 0 7.0e+02 1.2e+01 0 0 0 1 0"
        for k, x in enumerate(offsets_m)
    ]
    return "\n".join([*lines, "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"]) + "\n"


def make_kitti(
    folder: Path,
    frames: int = 4,
    *,
    official: bool = False,
    gray: bool = True,
    colour: bool = False,
) -> Path:
    """Write a KITTI folder: self-contained with velocity and extrinsics, or official with poses two
    levels up.

    Camera 2 is 6 cm left of camera 0, as KITTI's does.
    """
    sequence = folder / "sequences" / "07" if official else folder
    drive = make_drive(max(frames, 2))
    for k in [*((0, 1) if gray else ()), *((2, 3) if colour else ())]:
        make_images(sequence / f"image_{k}", frames, channels=1 if k < 2 else 3)
    (sequence / "calib.txt").write_text(calib_text(0.0, 0.54, -0.06, 0.47))
    (sequence / "times.txt").write_text("".join(f"{FRAME_S * k:e}\n" for k in range(frames)))
    T_cam0_imu = T_CAM0_IMU
    T_cam0 = T_cam0_imu @ drive.T_world_imu[:frames] @ se3_inverse(T_cam0_imu)
    poses = "".join(" ".join(f"{value:.17e}" for value in T[:3].reshape(-1)) + "\n" for T in T_cam0)
    if official:
        (folder / "poses").mkdir()
        (folder / "poses" / "07.txt").write_text(poses)
        return sequence
    (sequence / "poses.txt").write_text(poses)
    (sequence / "T_cam0_imu.txt").write_text(
        "\n".join(" ".join(f"{v:.17e}" for v in row) for row in T_cam0_imu)
    )
    rows = [
        f"{FRAME_S * k:.6f},{','.join(map(repr, u.tolist()))}"
        for k, u in enumerate(drive.velocities[:frames])
    ]
    header = "time_s,vx_mps,vy_mps,vz_mps,wx_radps,wy_radps,wz_radps"
    (sequence / "velocity.csv").write_text("\n".join([header, *rows]) + "\n")
    return sequence


# --- corrupting the arrays
# ------------------------------------------------------------------------------------------

Arrays: TypeAlias = dict[str, np.ndarray]


def without(*keys: str) -> Callable[[Arrays], Arrays]:
    """Remove arrays."""
    return lambda arrays: {k: v for k, v in arrays.items() if k not in keys}


def changed(key: str, value: object) -> Callable[[Arrays], Arrays]:
    """Replace an array."""
    return lambda arrays: {**arrays, key: np.asarray(value)}


def edited(key: str, index: object, value: float) -> Callable[[Arrays], Arrays]:
    """Change entries of an array."""

    def edit(arrays: Arrays) -> Arrays:
        copy = arrays[key].copy()
        copy[index] = value
        return {**arrays, key: copy}

    return edit


def edit(file: Path, old: str, new: str) -> None:
    """Replace the first occurrence of a text that must be in a file."""
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
