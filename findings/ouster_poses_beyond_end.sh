#!/usr/bin/env bash
# ouster-sdk 1.0.1: `interp_pose` returns poses for times before the first and after the last pose that it was given: it goes on with the last twist, however far.
# A car that stops turning where its poses end drives on in a circle: 24 m off after 5 s. `pose_at_timestamp` of the same package raises where no columns
# are on both sides, as its text says, and SciPy's Slerp raises, too; the text of `interp_pose` is silent. In between it follows a screw: 0.25 m beside the
# chord of two poses 1 s apart at 10 m/s and 0.2 rad/s.
# Guessed: an interpolation refuses what is outside, or keeps its end as numpy.interp does.
# Matters here: a trajectory that begins after the lidar's recording or ends before it, and is given to this function to undo the motion in its scans or to
# build a map, has poses that nobody measured, and nothing tells which. `vio` pairs poses within a tolerance only.
# Source: ouster/sdk/_bindings/client.pyi, interp_pose and pose_at_timestamp; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" ouster-sdk==1.0.1 scipy==1.17.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from ouster.sdk.core import interp_pose
from scipy.spatial.transform import Rotation, Slerp

SPEED, RATE = 10.0, 0.2  # m/s forwards, rad/s to the left


def pose(time):
    """Pose of a car on a circle (4, 4), m."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, 0, RATE * time]).as_matrix()
    T[:3, 3] = SPEED / RATE * np.array([np.sin(RATE * time), 1 - np.cos(RATE * time), 0])
    return T


times = np.arange(0.0, 3.0)  # s
known = np.stack([pose(t) for t in times])
print("ouster-sdk", version("ouster-sdk"))
for time in (-5.0, 7.0, 60.0):
    found = interp_pose(np.array([time]), times, known)[0]
    print(f"poses from 0 to 2 s, asked for {time} s: position {found[:3, 3].round(2)}, heading {Rotation.from_matrix(found[:3, :3]).magnitude():.2f} rad")
    assert np.allclose(found, pose(time), atol=1e-6)
straight = known[-1][:3, 3] + 5.0 * SPEED * known[-1][:3, 0]
off = np.linalg.norm(interp_pose(np.array([7.0]), times, known)[0][:3, 3] - straight)
print(f"beside a car that went straight on from there, after 5 s: {off:.1f} m")
assert off > 20
try:
    Slerp(times, Rotation.from_matrix(known[:, :3, :3]))([7.0])
    raise SystemExit("SciPy's Slerp goes beyond its end, too")
except ValueError as error:
    print("SciPy:", error)
middle = interp_pose(np.array([0.5]), times, known)[0][:3, 3]
print(f"half way, from the chord: {np.linalg.norm(middle - (known[0] + known[1])[:3, 3] / 2):.3f} m")
assert np.allclose(middle, pose(0.5)[:3, 3], atol=1e-6)
PYTHON
