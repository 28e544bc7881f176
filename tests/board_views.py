"""Views of a board for tests: exact corners with noise, and rendered recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vio.datasets.images import write_png
from vio.geometry.distortion import CameraModel, project_point
from vio.geometry.lie import (
    FloatArray,
    se3_from_parts,
    se3_inverse,
    so3_exp,
    transform_points,
)
from vio.records import BoolArray, Image, ImuRecord, IntArray
from vio.targets.corners import Corners
from vio.targets.description import Target
from vio.targets.rendering import BoardRenderer, Exposure, board_points
from vio.targets.views import View

GRID = Target("aprilgrid", 6, 6, 0.088, 0.3)
LEFT = CameraModel(460, 461, 372.5, 241.5, 752, 480, "radtan", (-0.28, 0.07, 2e-4, 1e-4))
RIGHT = CameraModel(458, 457.5, 378, 236, 752, 480, "radtan", (-0.27, 0.065, -2e-4, 3e-4))
T_RIGHT_LEFT = se3_from_parts(so3_exp([0.004, -0.01, 0.006]), [-0.11, 0.0005, 0.001])


@dataclass(frozen=True)
class Flaws:
    """What is wrong with corners."""

    noise_px: float = 0.05
    bow_m: tuple[float, float] = (0.0, 0.0)
    wrong_share: float = 0.0  # of the corners, which are 10 px off
    moved_m: float = 0.0  # of the board between the exposures of left and right


def board_pose(target: Target, rng: np.random.Generator, nearest_m: float = 0.4) -> FloatArray:
    """A pose of the board in front of the left camera."""
    z = rng.uniform(nearest_m, 3 * nearest_m)
    R = so3_exp(rng.normal(size=3) * [0.4, 0.4, 0.3])
    p = np.array([rng.uniform(-0.45, 0.45) * z, rng.uniform(-0.3, 0.3) * z, z])
    return se3_from_parts(R, p - R @ [*(0.5 * np.array(target.extent_m)), 0.0])


def made_views(
    seed: int,
    count: int = 30,
    flaws: Flaws | None = None,
    cameras: tuple[CameraModel, ...] = (LEFT, RIGHT),
) -> list[View]:
    """Views with enough corners in all images."""
    rng = np.random.default_rng(seed)
    flaws = flaws or Flaws()
    points = board_points(GRID, np.array(flaws.bow_m))
    views: list[View] = []
    while len(views) < count:
        T_left_board = board_pose(GRID, rng)
        found = []
        for k, camera in enumerate(cameras):
            T = T_left_board if k == 0 else T_RIGHT_LEFT @ T_left_board
            if k and flaws.moved_m:
                T = T.copy()
                T[:3, 3] += flaws.moved_m * rng.normal(size=3)
            uv, seen = project_point(camera, transform_points(T, points))
            limit = np.array([camera.width, camera.height]) - 5
            ids = np.flatnonzero(seen & (uv > 4).all(axis=1) & (uv < limit).all(axis=1))
            noisy = uv[ids] + flaws.noise_px * rng.normal(size=(len(ids), 2))
            wrong = rng.random(len(ids)) < flaws.wrong_share
            noisy[wrong] += 10 * rng.normal(size=(int(wrong.sum()), 2))
            found.append(Corners(ids, noisy))
        if min(len(one) for one in found) >= 20:
            views.append(View(len(views) * 100_000_000, tuple(found)))
    return views


def render_twice(target: Target, camera: CameraModel, distance_m: float) -> Image:
    """An image that shows the board twice, side by side."""
    renderer = BoardRenderer(target, camera)
    width, height = target.extent_m
    middle = camera.width // 2
    parts = []
    for x, part in ((-1.1 * width, slice(None, middle)), (0.1 * width, slice(middle, None))):
        T = se3_from_parts(so3_exp([0.1, -0.1, 0.05]), [x, -0.5 * height, distance_m])
        parts.append(renderer.render(T, Exposure(0.6, 2.0))[:, part])
    return np.hstack(parts)


def poses_around(
    camera: CameraModel, count: int, seed: int = 0, max_deg: float = 75.0
) -> list[FloatArray]:
    """Poses of the board before one wide camera, in all directions up to an angle off the axis."""
    rng = np.random.default_rng(seed)
    points = board_points(GRID)
    middle = points.mean(axis=0)
    poses: list[FloatArray] = []
    while len(poses) < count:
        theta = np.radians(max_deg) * np.sqrt(rng.uniform())
        around = rng.uniform(-np.pi, np.pi)
        toward = so3_exp(theta * np.array([-np.sin(around), np.cos(around), 0.0]))
        R = toward @ so3_exp(rng.normal(size=3) * [0.3, 0.3, 0.3])
        T = se3_from_parts(R, toward[:, 2] * rng.uniform(0.35, 0.8) - R @ middle)
        if len(_ids_inside(camera, *project_point(camera, transform_points(T, points)))) >= 30:
            poses.append(T)
    return poses


def _ids_inside(camera: CameraModel, uv: FloatArray, seen: BoolArray) -> IntArray:
    limit = np.array([camera.width, camera.height]) - 3
    return np.flatnonzero(seen & (uv > 2).all(axis=1) & (uv < limit).all(axis=1))


def views_around(camera: CameraModel, count: int, seed: int = 0) -> list[View]:
    """Views at `poses_around`, with corners of 0.05 px."""
    rng = np.random.default_rng(seed)
    views: list[View] = []
    for T in poses_around(camera, count, seed):
        uv, seen = project_point(camera, transform_points(T, board_points(GRID)))
        ids = _ids_inside(camera, uv, seen)
        noisy = uv[ids] + 0.05 * rng.normal(size=(len(ids), 2))
        views.append(View(len(views) * 100_000_000, (Corners(ids, noisy),)))
    return views


SMALL = Target("aprilgrid", 3, 4, 0.08, 0.3)
SMALL_LEFT = CameraModel(230, 231, 186, 121, 376, 240, "radtan", (-0.25, 0.06, 1e-4, 1e-4))
SMALL_RIGHT = CameraModel(231, 230, 189, 118, 376, 240, "radtan", (-0.26, 0.06, 1e-4, -1e-4))


def render_pairs(folder: Path, count: int, seed: int = 0, target: Target = SMALL) -> Path:
    """Write small rendered pairs into `left` and `right`."""
    rng = np.random.default_rng(seed)
    renderers = [BoardRenderer(target, camera) for camera in (SMALL_LEFT, SMALL_RIGHT)]
    for name in ("left", "right"):
        (folder / name).mkdir(parents=True)
    for k in range(count):
        T_left_board = board_pose(target, rng, nearest_m=0.25)
        for name, renderer, T in zip(
            ("left", "right"),
            renderers,
            (T_left_board, T_RIGHT_LEFT @ T_left_board),
            strict=True,
        ):
            image = renderer.render(T, Exposure(0.6, 2.0, seed=100 * k + len(name)))
            write_png(folder / name / f"{k:04d}.png", image)
    return folder


def render_record(folder: Path, seconds: float, seed: int, rate_hz: float = 5.0) -> Path:
    """Write the images of one camera that a hand moves before a board, and its IMU's samples."""
    from tests.calibration.test_camera_imu import OFFSET_S, T_CAM_IMU, hand_imu, hand_pose

    (folder / "left").mkdir(parents=True)
    shots = np.arange(0.2, seconds - 0.2, 1 / rate_hz)
    centre = np.array([*(0.5 * np.array(SMALL.extent_m)), 0.0])
    R = so3_exp([0.3, 0.2, 0.1])
    T_cam_board = se3_from_parts(R, [0.0, 0.0, 0.5] - R @ centre)
    T_world_board = se3_inverse(T_CAM_IMU) @ T_cam_board
    poses = T_CAM_IMU @ se3_inverse(hand_pose(shots, seed, 1.0)) @ T_world_board
    renderer = BoardRenderer(SMALL, SMALL_LEFT)
    for k, T in enumerate(poses):
        image = renderer.render(T, Exposure(0.6, 2.0, seed=k))
        write_png(folder / "left" / f"{k:04d}.png", image)
    times = [f"{second - OFFSET_S:.9f}" for second in shots.tolist()]
    (folder / "times.txt").write_text("\n".join(times) + "\n")
    write_imu(folder / "imu.csv", hand_imu(seed, seconds, np.zeros(15)))
    return folder


def write_imu(file: Path, imu: ImuRecord) -> None:
    """Write samples as a plain folder has them."""
    rows = np.column_stack([1e-9 * imu.times_ns, imu.gyro, imu.accel])
    header = "timestamp,wx,wy,wz,ax,ay,az"
    np.savetxt(file, rows, "%.9f", ",", header=header, comments="")
