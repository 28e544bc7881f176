"""Small plain folders, for tests of their reader and users."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from tests.euroc_maker import RADTAN_RIG, noise_image, truth_poses
from vio.cameras.rig import Rig
from vio.datasets.rigs.kalibr import kalibr_text
from vio.geometry.distortion import StereoRig
from vio.geometry.lie import quat_xyzw_from_rotation, se3_inverse

STEP_S = 0.05


def rig_of(stereo: StereoRig, *, imu: bool = True) -> Rig:
    """Return a `StereoRig` as a `Rig`."""
    T_cam0_imu = se3_inverse(stereo.T_imu_cam0)
    return Rig(
        stereo.cam0,
        stereo.cam1,
        se3_inverse(stereo.T_imu_cam1) @ stereo.T_imu_cam0,
        T_cam0_imu if imu else None,
    )


def make_plain(
    folder: Path,
    frames: int = 4,
    *,
    folders: tuple[str, str] = ("left", "right"),
    name: Callable[[int, int], str] = lambda side, k: f"{k}.png",
    rig: StereoRig = RADTAN_RIG,
    imu: bool = True,
    times: bool = True,
    calibration: bool = True,
    reference: bool = True,
) -> Path:
    """Write a plain folder of noise images, 20 Hz, with an IMU of 200 Hz from 10 ms before to 10
    ms after.
    """
    rng = np.random.default_rng(frames)
    for side, (part, camera) in enumerate(zip(folders, (rig.cam0, rig.cam1), strict=True)):
        (folder / part).mkdir(parents=True)
        for k in range(frames):
            assert cv2.imwrite(str(folder / part / name(side, k)), noise_image(rng, camera))
    stamps = [1700000000_000000000 + round(k * STEP_S * 1e9) for k in range(frames)]
    if times:
        (folder / "times.txt").write_text(
            "".join(f"{t // 10**9}.{t % 10**9:09d}\n" for t in stamps)
        )
    if calibration:
        (folder / "camchain-imucam.yaml").write_text(kalibr_text(rig_of(rig)))
    if imu:
        rows = [f"{t},{k}.5,0.1,-0.2,0.25,9.81,{-k}" for k, t in enumerate(imu_stamps(stamps))]
        (folder / "imu.csv").write_text(
            "#timestamp [ns],wx,wy,wz,ax,ay,az\n" + "\n".join(rows) + "\n"
        )
    if reference:
        poses = truth_poses(frames)
        q = quat_xyzw_from_rotation(poses[:, :3, :3])
        lines = [
            f"{t // 10**9}.{t % 10**9:09d} "
            + " ".join(map(repr, [*map(float, T[:3, 3]), *map(float, x)]))
            for t, T, x in zip(stamps, poses, q, strict=True)
        ]
        (folder / "reference.tum").write_text("# body: imu\n" + "\n".join(lines) + "\n")
    return folder


def imu_stamps(stamps: list[int]) -> list[int]:
    """Times of the IMU, 5 ms apart."""
    return list(range(stamps[0] - 10_000_000, stamps[-1] + 10_000_001, 5_000_000))
