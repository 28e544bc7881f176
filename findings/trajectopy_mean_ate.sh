#!/usr/bin/env bash
# trajectopy 5.1.2: the ATE of `ate` (`pos_ate`) is the mean of the distances after alignment. The root mean square, which the TUM
# benchmark, evo and ours call ATE, is its `pos_dev_rms`: where errors are 1 m in a tenth of the poses and 0.1 m elsewhere, the two
# are 0.19 and 0.33 m.
# Guessed: an ATE is a root mean square.
# Matters here: its figures lie below ours and below published ones for one and the same trajectory, so a system looks better by
# the tool that measured it. Compare ours with `pos_dev_rms`, or its ATE with the mean that `vio eval` prints.
# Source: trajectopy.ate against the two sums written out; Sturm et al. (2012) for the root mean square; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" trajectopy==5.1.2 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
import trajectopy

times = np.arange(200) * 0.1
level = np.zeros((200, 3))
turning = trajectopy.Rotations.from_euler("zyx", np.column_stack([0.3 * times, level[:, :2]]))
true = np.column_stack([10 * np.cos(0.3 * times), 10 * np.sin(0.3 * times), np.sin(times)])
distances = np.where(np.arange(200) % 10 == 0, 1.0, 0.1)
reference, estimate = (
    trajectopy.Trajectory(trajectopy.Positions(points), turning, timestamps=times)
    for points in (true, true + distances[:, None] * [0.0, 0.0, 1.0])
)
stated = trajectopy.ate(estimate, reference, align=False)
mean = distances.mean()
root = np.sqrt((distances**2).mean())
print("trajectopy", version("trajectopy"))
print(f"pos_ate {stated.pos_ate:.4f} m, pos_dev_rms {stated.pos_dev_rms:.4f} m")
print(f"mean {mean:.4f} m, root mean square {root:.4f} m")
assert abs(stated.pos_ate - mean) < 0.002 < 0.1 < root - stated.pos_ate
PYTHON
