"""Errors of dense depth and of the fused mesh against rendered truth, by distance: the table of docs/mesh.md.

python -m tools.dense_accuracy [FRAMES]
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.spatial import cKDTree

from vio.dense.stereo_depth import StereoMatcher, depth_errors, farthest_m
from vio.dense.surface import extract_surface
from vio.dense.voxel_grid import TRUNCATION, VoxelGrid
from vio.geometry.distortion import rectified_camera
from vio.geometry.lie import transform_points
from vio.sim.scenarios import Scenario, plan
from vio.sim.sequence import SimulatedRecording, views

_SCENES = (
    ("room, 752x480, baseline 0.11 m", Scenario(scene="room", rig="euroc-rectified"), 0.02, (0.5, 1, 2, 4, 8)),
    (
        "street, 1242x375, baseline 0.54 m",
        Scenario(scene="street", trajectory="car", rig="kitti", imu="none", rate_hz=10),
        0.1,
        (2, 5, 10, 20, 40),
    ),
)
_EVERY = 3  # frames


def main(frames: int) -> None:
    """Print one table for each scene."""
    for name, scenario, voxel_m, edges in _SCENES:
        recording = SimulatedRecording(plan(scenario))
        simulation = recording.simulation
        camera = rectified_camera(simulation.rig)
        matcher = StereoMatcher(camera, simulation.rig.cam0.width)
        depths, truths, points = [], [], []
        far_m = farthest_m(camera, TRUNCATION * voxel_m)
        with VoxelGrid(voxel_m) as grid:
            for index in range(0, _EVERY * frames, _EVERY):
                left, right = recording.images(index)
                time_ns = int(simulation.taken_ns[index])
                truth, _ = recording.depth(0, time_ns)
                T = views(simulation, time_ns)[0].T_world_cam
                depth = matcher.depth(left, right)
                grid.fuse(depth, left, camera, T, far_m)
                depths.append(depth)
                truths.append(truth)
                v, u = np.nonzero(truth < far_m)
                rays = np.stack([(u - camera.cu) / camera.fu, (v - camera.cv) / camera.fv, np.ones(len(u))], axis=1)
                points.append(transform_points(T, rays * truth[v, u][:, None]))
            mesh = extract_surface(grid)
        print(f"{name}, {frames} frames\n  distance m   known   median   90 % mm")
        for e in depth_errors(np.array(depths), np.array(truths), np.array(edges, dtype=np.float64)):
            span = f"{e.nearest_m:g} to {e.farthest_m:g}"
            print(f"  {span:<10} {100 * e.known:5.0f} % {1e3 * e.median_m:8.1f} {1e3 * e.percentile_90_m:9.1f}")
        off, _ = cKDTree(np.concatenate(points)).query(mesh.vertices)
        median, high = np.percentile(1e3 * off, (50, 90))
        print(f"  mesh to {far_m:.1f} m, voxels {voxel_m:g} m: {median:.1f} and {high:.1f} mm, {len(off)} vertices\n")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 12)
