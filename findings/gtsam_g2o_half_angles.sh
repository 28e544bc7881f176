#!/usr/bin/env bash
# gtsam 4.3.0 and g2o (g2opy 2.3.0): one file, two problems. In an edge `EDGE_SE3:QUAT` the information of the rotation is, for g2o, that
# of the vector part of a quaternion, which is half of the angle; gtsam's `readG2o` takes it for that of the angle, and `writeG2o` writes
# it so. An edge that is off by an angle costs four times as much in gtsam, one that is off by metres the same in both.
# Guessed: the library that reads and writes the other's format weighs rotations as the other does.
# Matters here: who writes covariances of ours (radians) into a g2o file, has to multiply the information of rotations by 4 for g2o and
# leave it for gtsam; a pose graph that went through both trusts rotations twice too much or too little (standard deviation).
# Source: its author in https://github.com/RainerKuemmerle/g2o/issues/699 (the order is x y z qx qy qz); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" gtsam==4.3.0 g2opy==2.3.0 numpy==2.2.6
export PYTHONPATH="$folder/packages" FOLDER="$folder"
cat > "$folder/common.py" <<'PYTHON'
import math
import os
from pathlib import Path

OFF = 0.02  # metres, or radians
IDENTITY = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"  # upper triangle (6, 6)
HALF = OFF / 2
POSES = {
    "translation": f"{OFF} 0 0 0 0 0 1",
    "rotation": f"0 0 0 {math.sin(HALF)!r} 0 0 {math.cos(HALF)!r}",
}


def file_of(name):
    """Write two poses, and an edge that says that they are equal."""
    file = Path(os.environ["FOLDER"], f"{name}.g2o")
    file.write_text(
        f"VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 {POSES[name]}\n"
        f"EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1 {IDENTITY}\n"
    )
    return str(file)
PYTHON
PYTHONPATH="$folder/packages:$folder" python3 - <<'PYTHON'
from importlib.metadata import version

import gtsam
from common import OFF, POSES, file_of

chi2 = {}
for name in POSES:
    graph, values = gtsam.readG2o(file_of(name), True)
    chi2[name] = 2 * graph.error(values) / OFF**2
print("gtsam", version("gtsam"), "chi square over the square of what it is off by:", chi2)
assert all(abs(value - 1) < 1e-3 for value in chi2.values())
PYTHON
PYTHONPATH="$folder/packages:$folder" python3 - <<'PYTHON'
from importlib.metadata import version

import g2opy as g2o
from common import OFF, POSES, file_of

chi2 = {}
for name in POSES:
    graph = g2o.SparseOptimizer()
    assert graph.load(file_of(name))
    solver = g2o.BlockSolverSE3(g2o.LinearSolverEigenSE3())
    graph.set_algorithm(g2o.OptimizationAlgorithmLevenberg(solver))
    graph.initialize_optimization()
    graph.compute_active_errors()
    chi2[name] = graph.active_chi2() / OFF**2
print("g2opy", version("g2opy"), chi2)
assert abs(chi2["translation"] - 1) < 1e-3
assert abs(chi2["rotation"] - 0.25) < 1e-3
PYTHON
