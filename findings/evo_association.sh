#!/usr/bin/env bash
# evo 1.38.1: `sync.associate_trajectories` may match one pose of a reference with two of an estimate, and whether it does depends
# on which of the two has more poses: where the reference is longer, also by poses at other times, both poses of the estimate are
# kept; where it is shorter, only one. So the number of pairs, and the ATE, change with poses of the reference that match nothing.
# Guessed: one to one, the same for both orders.
# Matters here: an ATE of evo weighs doubled poses twice (a recorder that wrote some poses twice, 40 Hz beside 20 Hz within its
# limit); ours pairs one to one, and the two differ then.
# Source: evo.core.sync; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" evo==1.38.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D


def still(times):
    n = len(times)
    return PoseTrajectory3D(np.zeros((n, 3)), np.tile([1.0, 0, 0, 0], (n, 1)), np.array(times))


estimate = still([0.0, 0.004, 0.1, 0.104, 0.2, 0.3])  # two poses are there twice, 4 ms apart
short = still([0.0, 0.1, 0.2, 0.3])
long = still([0.0, 0.1, 0.2, 0.3, 0.9, 1.0, 1.1])  # the same, and three poses later
pairs = [
    sync.associate_trajectories(reference, estimate, max_diff=0.01)[0].timestamps.tolist()
    for reference in (short, long)
]
print("evo", version("evo"), "reference stamps of the pairs, short reference:", pairs[0])
print("long reference:", pairs[1])
assert pairs == [[0.0, 0.1, 0.2, 0.3], [0.0, 0.0, 0.1, 0.1, 0.2, 0.3]]
PYTHON
