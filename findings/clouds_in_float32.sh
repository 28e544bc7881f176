#!/usr/bin/env bash
# trimesh 5.2.0 (PLY, GLB) and pypcd4 1.5.1: points of float64 become float32 without a word, so points in UTM
# coordinates move by up to 0.25 m to the north and lie on planes half a metre apart. laspy 2.7.0 rounds to 1 cm unless scales are set.
# Guessed: as exact as what was given; PLY, PCD and NumPy have doubles, and trimesh's text formats keep them.
# Matters here: a cloud that was put on the earth with the transformation of `vio georeference` is destroyed by saving it. Save it in
# the local frame beside that transformation, as this project does, or subtract an origin.
# Source: what comes back from each; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" trimesh==5.2.0 pypcd4==1.5.1 \
    laspy==2.7.0 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - "$folder" <<'PYTHON'
import io
import sys
from importlib.metadata import version
from pathlib import Path

import laspy
import numpy as np
import pypcd4
import trimesh

MUNICH = np.array([691000.0, 5334000.0, 500.0])
points = MUNICH + np.random.default_rng(0).uniform(-5, 5, (1000, 3))


def of_trimesh(kind):
    file = trimesh.PointCloud(points).export(file_type=kind)
    read = trimesh.load(io.BytesIO(file if isinstance(file, bytes) else file.encode()), file_type=kind)
    return (read if hasattr(read, "vertices") else next(iter(read.geometry.values()))).vertices


def of_pypcd4():
    path = Path(sys.argv[1], "cloud.pcd")
    pypcd4.PointCloud.from_xyz_points(points).save(path)
    return pypcd4.PointCloud.from_path(path).numpy(("x", "y", "z"))


def of_laspy():
    file = laspy.create()
    file.x, file.y, file.z = points.T
    return file.xyz


MADE = {
    "trimesh PLY": lambda: of_trimesh("ply"),
    "trimesh GLB": lambda: of_trimesh("glb"),
    "trimesh XYZ": lambda: of_trimesh("xyz"),
    "pypcd4": of_pypcd4,
    "laspy": of_laspy,
}
print({name: version(name) for name in ("trimesh", "pypcd4", "laspy")})
north = {}
for name, make in MADE.items():
    off = np.abs(np.asarray(make(), dtype=np.float64) - points).max(axis=0)
    north[name] = off[1]
    print(f"{name}: largest error east, north, up: {np.round(off, 4)} m")
for name in ("trimesh PLY", "trimesh GLB", "pypcd4"):
    assert 0.2 < north[name] < 0.26
assert north["trimesh XYZ"] < 1e-6 and 0.004 < north["laspy"] < 0.0051
PYTHON
