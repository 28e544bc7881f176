#!/usr/bin/env bash
# evo 1.38.1: projected into the plane xz (`--project_to_plane xz`, `PosePath3D.project`), headings lie between -90 and 90 degrees: one of 120 becomes 60. It is the second of three
# Euler angles, and only the first and the third go all round: in xy and yz projections are right. Of a car that drives a circle, the exact trajectory in a world turned by
# 30 degrees has a relative pose error of 0.43 m for steps of 0.63 m (0 without projection), and one whose cameras look backwards a rotation error of 104 degrees instead of 180.
# Guessed: the projection of a rotation about the normal of the plane is that rotation.
# Matters here: xz is the plane of a camera's own axes (x right, z ahead), those of KITTI's poses and of a trajectory that begins with the first camera: one projects to leave out
# heights, which its ground truth has badly. Errors of rotation of estimates that are wrong shrink, and relative errors of right ones grow, from the first turn beyond 90 degrees on.
# Source: `project` in evo/core/trajectory.py; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" evo==1.38.1 numpy==2.4.6 scipy==1.17.1
HOME="$folder" PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from evo.core import metrics
from evo.core.trajectory import Plane, PoseTrajectory3D
from scipy.spatial.transform import Rotation

HEADINGS = np.linspace(0, 2 * np.pi, 200)


def drive(plane, world_deg=0.0, camera_deg=0.0):
    """A circle of 20 m in the plane, turned in the world, with the camera turned in the car."""
    normal = {Plane.XZ: "y", Plane.XY: "z"}[plane]
    ahead = np.array([0, 0, 1.0] if plane == Plane.XZ else [1.0, 0, 0])
    aside = np.cross({"y": [0, 1.0, 0], "z": [0, 0, 1.0]}[normal], ahead)
    world = Rotation.from_euler(normal, world_deg, degrees=True).as_matrix()
    poses = []
    for heading in HEADINGS:
        pose = np.eye(4)
        pose[:3, :3] = world @ Rotation.from_euler(normal, heading + np.radians(camera_deg)).as_matrix()
        pose[:3, 3] = world @ (20 * np.sin(heading) * ahead + 20 * (1 - np.cos(heading)) * aside)
        poses.append(pose)
    return PoseTrajectory3D(poses_se3=poses, timestamps=np.arange(len(poses)) * 0.1)


def errors(reference, estimate):
    """Root mean squares: absolute rotations in degrees, relative translations from pose to pose in metres."""
    absolute = metrics.APE(metrics.PoseRelation.rotation_angle_deg)
    relative = metrics.RPE(metrics.PoseRelation.translation_part, 1, metrics.Unit.frames, all_pairs=True)
    for metric in (absolute, relative):
        metric.process_data((reference, estimate))
    return [metric.get_statistic(metrics.StatisticsType.rmse) for metric in (absolute, relative)]


print("evo", version("evo"))
for plane in (Plane.XY, Plane.XZ):
    for name, world_deg, camera_deg in (("world turned by 30", 30.0, 0.0), ("cameras backwards", 0.0, 180.0)):
        found = {}
        for projected in (False, True):
            both = drive(plane), drive(plane, world_deg, camera_deg)
            if projected:
                for trajectory in both:
                    trajectory.project(plane)
            found[projected] = errors(*both)
        print(f"{plane.value}, {name}: rotations {found[False][0]:.1f} degrees, projected {found[True][0]:.1f};", end=" ")
        print(f"relative translations {found[False][1]:.3f} m, projected {found[True][1]:.3f} m")
        if plane == Plane.XY:
            assert np.allclose(found[True], found[False], atol=1e-6)
        elif world_deg:
            assert found[False][1] < 1e-6 < 0.3 < found[True][1]
        else:
            assert abs(found[False][0] - 180) < 1e-3 and found[True][0] < 120
PYTHON
