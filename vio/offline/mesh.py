"""A coloured mesh of what a run saw: dense depth of its images, fused along its poses."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vio.dense.occupancy import OccupancyGrid, occupancy_grid
from vio.dense.preview import preview
from vio.dense.stereo_depth import DepthImage, StereoMatcher, depth_sigma_m, farthest_m
from vio.dense.surface import Mesh, extract_surface
from vio.dense.voxel_grid import TRUNCATION, VoxelGrid
from vio.errors import DataError
from vio.geometry.lie import FloatArray, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera
from vio.geometry.upright import up_in, upright_axes
from vio.mapping.map_store import KeyframeRow, MapStore
from vio.offline.keyframes import after_motion
from vio.offline.run_images import RunImages, run_images
from vio.records import Image, IntArray, StereoFrame, Trajectory
from vio.runs.finished import point_positions, up_of_odometry
from vio.runs.mapped import corrected, read_trajectories
from vio.runs.stated import read_metrics


@dataclass(frozen=True, slots=True)
class _MeshRules:
    """Which depths a mesh is made of."""

    voxel_share: float = 1 / 250  # of the landmarks' depth, at least
    # of the landmarks' depth: motion from one image that is used to the next; or turn
    step_share: float = 0.02
    step_deg: float = 4.0
    near_quantile: float = 0.25  # of the depths of landmarks
    coarse_share: float = 0.1  # of the landmarks' depth: larger voxels show no surface
    # z of the upward direction, 1.1 degrees, above which a map's z is taken for up
    level: float = 0.9998


_DEPTHS = _MeshRules()
_SIGMA_VOXELS = float(TRUNCATION)  # of a depth, beyond which it is not used


@dataclass(frozen=True, slots=True)
class MeshSource:
    """What a mesh is made from."""

    images: RunImages
    T_world_cam0: FloatArray  # (N, 4, 4) of the chosen frames
    frames: IntArray  # (N,) their numbers
    poses: str  # where the poses are from, for the results
    up_world: FloatArray | None  # (3,)
    voxel_m: float
    depth_m: float  # of the landmarks

    @property
    def far_m(self) -> float:
        """Depth up to which the images are used."""
        camera = self.images.camera
        return farthest_m(camera, _SIGMA_VOXELS * self.voxel_m)


@dataclass(frozen=True, slots=True)
class DenseMap:
    """A mesh with its floor plan and picture."""

    mesh: Mesh
    occupancy: OccupancyGrid | None
    picture: Image  # (H, W, 3)
    R_upright_world: FloatArray  # (3, 3)
    frames: int  # that were fused
    blocks: int


def _depth_and_voxel_m(
    folder: Path, camera: StereoCamera, T_world_cam0: FloatArray, voxel_m: float | None
) -> tuple[float, float]:
    """Return the depth of the landmarks that the poses (N, 4, 4) see, or that fits the distance of
    the samples, and this distance, or that which fits the depth.
    """
    if voxel_m is not None:
        return _landmark_depth_m(folder, T_world_cam0, voxel_m / _DEPTHS.voxel_share), voxel_m
    depth_m = _landmark_depth_m(folder, T_world_cam0, None)
    return depth_m, _voxel_m(camera, depth_m)


def mesh_source(folder: Path, map_file: Path | None, voxel_m: float | None) -> MeshSource:
    """Return what the mesh of a run is made from.

    Args:
        folder: of the run.
        map_file: a map that holds the run, for its poses; None: those of the run.
        voxel_m: distance of the samples; None: by the depth of the landmarks.

    Raises:
        DataError: it is no run's folder, or of one camera without depths, or the map does not hold
            the run.
    """
    metrics, T_cam0_imu = read_metrics(folder)
    images = run_images(folder, metrics)
    if images.seen.kind == "mono":
        raise DataError(
            f"{folder}: is a run of one camera without depth images; a mesh needs a stereo pair or "
            "depths"
        )
    trajectory, odometry = read_trajectories(folder)
    mapped = trajectory is not odometry
    if trajectory.frame_indices is None or trajectory.times_ns is None or len(trajectory) < 1:
        raise DataError(f"{folder}: its trajectory states no frames; repeat the run")
    # The landmarks and the vertical are those of the odometry's world.
    by_odometry = odometry.in_cam0(T_cam0_imu)
    T_odom = by_odometry.T_world_body
    T = (
        trajectory.in_cam0(T_cam0_imu).T_world_body
        if map_file is None
        else _poses_in_map(map_file, by_odometry)
    )
    depth_m, voxel_m = _depth_and_voxel_m(folder, images.camera, T_odom, voxel_m)
    chosen = np.array(
        after_motion(T, _DEPTHS.step_share * depth_m, _DEPTHS.step_deg), dtype=np.int64
    )
    up_odom = up_of_odometry(folder, metrics)
    if up_odom is None:
        up = None
    else:
        up = up_in(T, T_odom, up_odom)
    poses = "map" if mapped or map_file is not None else "odometry"
    return MeshSource(
        images, T[chosen], trajectory.frame_indices[chosen], poses, up, voxel_m, depth_m
    )


def build_mesh(
    made_from: MeshSource,
    *,
    source: str | None,
    most_blocks: int,
    progress: Callable[[int, int], None],
    stop: Callable[[], bool],
) -> DenseMap:
    """Fuse the depths of the chosen frames, and return their surface.

    Args:
        made_from: poses and images.
        source: the recording, if it is not at the path stored in the run.
        most_blocks: of voxels in memory.
        progress: called with (done, total) after each frame.
        stop: asked after each frame whether to leave the others out.

    Raises:
        DataError: the images are not available, or show no surface.
    """
    images = made_from.images
    voxel_m = made_from.voxel_m
    done = 0
    matcher: StereoMatcher | None = None
    with VoxelGrid(voxel_m, most_blocks=most_blocks) as grid:
        found = images.frames(made_from.frames, source, colour=True)
        for frame, T_world_cam0 in zip(found, made_from.T_world_cam0, strict=True):
            assert frame.left is not None
            if frame.depth is None and matcher is None:
                matcher = StereoMatcher(images.camera, frame.left.shape[1])
            grid.fuse(
                _depth_of(frame, matcher), frame.left, images.camera, T_world_cam0, made_from.far_m
            )
            done += 1
            progress(done, len(made_from.frames))
            if stop():
                break
        mesh = extract_surface(grid, least_seen=min(done, 3))
        blocks = len(grid)
    if not len(mesh.triangles):
        coarse = voxel_m > _DEPTHS.coarse_share * made_from.depth_m
        raise DataError(
            f"{images.where}: no surface was found within {made_from.far_m:.1f} m in {done} "
            f"images with voxels of {voxel_m:g} m; give {'smaller' if coarse else 'larger'} ones with "
            "--voxel, and see whether the run's poses are right"
        )
    R = upright_axes(made_from.T_world_cam0, made_from.up_world)
    if made_from.up_world is not None and made_from.up_world[2] > _DEPTHS.level:
        R = np.eye(3)  # the floor plan is in the run's own frame, whose z is up
    picture = preview(mesh, made_from.T_world_cam0[:done, :3, 3], R, voxel_m)
    return DenseMap(mesh, occupancy_grid(mesh, R, voxel_m), picture, R, done, blocks)


def _depth_of(frame: StereoFrame, matcher: StereoMatcher | None) -> DepthImage:
    """Return the depth of a frame: that of the depth image, or of the pair."""
    if frame.depth is not None:
        return frame.depth.astype(np.float32)
    assert frame.left is not None
    assert frame.right is not None
    assert matcher is not None
    return matcher.depth(_gray(frame.left), _gray(frame.right))


def _gray(image: Image) -> Image:
    import cv2

    return (
        image
        if image.ndim == 2
        else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    )


def _session_of(rows: Sequence[KeyframeRow], times_ns: Set[int]) -> list[KeyframeRow]:
    """Return the keyframes of a map's session that are all of these times; none: there is none."""
    for session in sorted({row.session for row in rows}):
        own = [row for row in rows if row.session == session]
        if all(row.time_ns in times_ns for row in own):
            return own
    return []


def _poses_in_map(file: Path, run: Trajectory) -> FloatArray:
    """Return the poses (N, 4, 4) of a run's frames in a map that holds it."""
    with contextlib.closing(MapStore(file, read_only=True)) as store:
        rows = store.keyframes()
    assert run.times_ns is not None
    assert run.frame_indices is not None
    place = {int(t): k for k, t in enumerate(run.times_ns.tolist())}
    own = _session_of(rows, place.keys())
    if own:
        at = [place[k.time_ns] for k in own]
        frames = run.frame_indices[at]
        T_map = np.array([k.T_map_cam for k in own])
        return corrected(run.T_world_body, run.frame_indices, frames, T_map, run.T_world_body[at])
    raise DataError(
        f"{file}: holds no session of this run; give the map that vio run --map FILE wrote in it"
    )


def _landmark_depth_m(folder: Path, T_world_cam0: FloatArray, otherwise_m: float | None) -> float:
    """Return the depth within which a quarter of the landmarks ahead are; far ones say little of
    the scene.
    """
    p = point_positions(folder)
    depths = [
        transform_points(se3_inverse(T), p)[:, 2]
        for T in T_world_cam0[:: max(1, len(T_world_cam0) // 50)]
    ]
    ahead = [float(np.quantile(z[z > 0], _DEPTHS.near_quantile)) for z in depths if (z > 0).any()]
    if not ahead and otherwise_m is not None:
        return otherwise_m
    if not ahead:
        raise DataError(
            f"{folder}: the run has no landmarks, so that nothing states the scene's size; give "
            "--voxel"
        )
    return float(np.median(ahead))


def _voxel_m(camera: StereoCamera, depth_m: float) -> float:
    """Return voxels with which surfaces are used at twice the landmarks' depth: 1, 2 or 5 times
    a power of ten.
    """
    length_m = max(
        _DEPTHS.voxel_share * depth_m, depth_sigma_m(camera, 2 * depth_m) / _SIGMA_VOXELS
    )
    power = 10.0 ** np.floor(np.log10(length_m))
    return float(power * max(m for m in (1, 2, 5) if m * power <= length_m * (1 + 1e-9)))


def facts_of(made_from: MeshSource, done: DenseMap) -> dict[str, Any]:
    """Return what is said of a mesh in its folder and by `--json`."""
    at = [made_from.far_m / 4, made_from.far_m / 2, made_from.far_m]
    size = np.ptp(done.mesh.vertices, axis=0)
    return {
        "frames": done.frames,
        "chosen": len(made_from.frames),
        "poses": made_from.poses,
        "voxel_m": made_from.voxel_m,
        "farthest_m": made_from.far_m,
        "depth_sigma_m": {f"{z:.2g}": depth_sigma_m(made_from.images.camera, z) for z in at},
        "blocks": done.blocks,
        "vertices": len(done.mesh.vertices),
        "triangles": len(done.mesh.triangles),
        "extent_m": size.tolist(),
        "R_upright_world": done.R_upright_world.tolist(),
    }
