#!/usr/bin/env bash
# pycpd 2.0.0: `RigidRegistration` ("Rigid registration") estimates a scale too, and takes `scale=False` without a word and without effect: two scans of one
# room, of which the second sees less of it, fit with a scale of 1.26. trimesh 5.2.0: `registration.icp` does so too, 1.03 here, and its text names no scale;
# `procrustes`, whose defaults it takes, mirrors half of all planes with noise. There `scale=False, reflection=False` works.
# Guessed: rigid means rotation and translation, and so does ICP, as in Open3D and small_gicp.
# Matters here: clouds of a stereo map registered to a laser's are stretched until they fit; the scale of the estimate is the very thing to be judged.
# Source: pycpd/rigid_registration.py; help(trimesh.registration.icp); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" \
    pycpd==2.0.0 trimesh==5.2.0 scipy==1.17.1 numpy==2.4.6 rtree==1.4.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
import pycpd
import trimesh
from scipy.spatial.transform import Rotation


def scan(random, count, extent_m):
    """Return points of three planes that meet in a corner, as far as they are within an extent of it."""
    points = random.uniform(0.0, 3.0, (count, 3))
    points[np.arange(count), random.integers(0, 3, count)] = 0.0
    return points[(points < extent_m).all(axis=1)]


random = np.random.default_rng(0)
room, part = scan(random, 1500, 3.0), scan(random, 1500, 2.4)
moved = part @ Rotation.from_rotvec([0.0, 0.0, 0.1]).as_matrix().T + [0.1, -0.05, 0.05]


def error_m(fitted):
    """Return the mean distance of points from where they are in the room."""
    return float(np.linalg.norm(fitted - part[: len(fitted)], axis=1).mean())


print(f"pycpd {version('pycpd')}, trimesh {trimesh.__version__}; true scale 1")
scales = {}
for options in ({}, {"scale": False}):
    fitted, (scale, _, _) = pycpd.RigidRegistration(X=room[:500], Y=moved[:300], **options).register()
    scales["pycpd", len(options)] = scale
    print(f"pycpd {options}: scale {scale:.3f}, error {error_m(fitted):.3f} m")
for options in ({}, {"scale": False, "reflection": False}):
    matrix, fitted, _ = trimesh.registration.icp(moved, room, max_iterations=100, **options)
    scales["trimesh", len(options)] = scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    print(f"trimesh {options}: scale {scale:.3f}, error {error_m(fitted):.3f} m")
plane = random.uniform(-1.0, 1.0, (200, 3)) * [1.0, 1.0, 0.0]
noisy = [plane + random.normal(0.0, 0.02, plane.shape) for _ in range(200)]
mirrored = sum(np.linalg.det(trimesh.registration.procrustes(one, other)[0][:3, :3]) < 0.0 for one, other in zip(noisy[::2], noisy[1::2]))
print(f"trimesh procrustes, a plane with noise: mirrored in {mirrored} of 100")
assert scales["pycpd", 0] == scales["pycpd", 1] > 1.1
assert 1.02 < scales["trimesh", 0] < 1.1 and abs(scales["trimesh", 2] - 1.0) < 1e-6
assert mirrored > 20
PYTHON
