#!/usr/bin/env bash
# pypose 0.9.5: `nposes` of `metric.ape` and `metric.rpe`, "the number of poses to use for alignment", cuts the coordinates, not the poses: with 3 or more, all poses align, whatever the
# number. Of a trajectory that is exact for 5 s and then drifts to 5 m, the root mean square after alignment with the first 20 or 100 poses is 1.59 m, that of all poses, to the last digit;
# it is 2.03 m by definition, and by evo's `--n_to_align`. Numbers of 1 or 2 are an error about dimensions.
# Guessed: an option that is taken does what its text says.
# Matters here: aligning with the beginning alone is how drift is shown, since an alignment with all poses spreads it over the path. Such figures from this library are those of a full
# alignment and look better than those of other tools, ours among them, by a fifth here.
# Source: `ape` in pypose/metric/ape_rpe.py; evo's PosePath3D.align; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" torch==2.13.0 pypose==0.9.5 evo==1.38.1
HOME="$folder" PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
import pypose as pp
import torch
from evo.core.trajectory import PosePath3D

times = torch.arange(200, dtype=torch.float64) * 0.05
true = torch.stack([10 * torch.cos(0.3 * times), 10 * torch.sin(0.3 * times), torch.sin(times)], -1)
drift = true.clone()
drift[100:, 0] += 0.05 * torch.arange(100)
level = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(200, 4)
turn = pp.so3(torch.tensor([0.0, 0.0, 0.4], dtype=torch.float64)).Exp()
moved = turn.Act(drift) + torch.tensor([1.0, 2.0, 3.0])  # the estimate's own world
reference, estimate = (pp.SE3(torch.cat([points, level], -1)) for points in (true, moved))


def by_evo(count):
    first, second = (
        PosePath3D(positions_xyz=points.numpy(), orientations_quat_wxyz=np.tile([1.0, 0, 0, 0], (200, 1)))
        for points in (true, moved)
    )
    second.align(first, n=count)
    return np.sqrt(((second.positions_xyz - first.positions_xyz) ** 2).sum(1).mean())


print("pypose", version("pypose"), "evo", version("evo"))
defined = float(((drift - true) ** 2).sum(-1).mean().sqrt())
for count in (-1, 100, 20, 3):
    found = float(
        pp.metric.ape(times.clone(), reference, times.clone(), estimate, align=True, nposes=count, otype="RMSE")
    )
    print(f"aligned with {'all' if count < 0 else count} poses: pypose {found:.4f} m, evo {by_evo(count):.4f} m")
    assert abs(found - by_evo(-1)) < 1e-6
    if count in (100, 20):
        assert abs(by_evo(count) - defined) < 1e-6 < 0.3 < defined - found
PYTHON
