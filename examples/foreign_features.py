"""Features of another program, as a recording: ids and pixels of each frame, written once, run as
often as you like.

python examples/foreign_features.py OUT.npz
"""

import sys

import numpy as np

import vio

# In place of a tracker of yours: 300 points beside a straight road, seen by a pair that drives
# along it at 10 m/s.
rig = vio.Rig.rectified(fu=700, fv=700, cu=600, cv=180, baseline_m=0.5, width=1200, height=370)
rng = np.random.default_rng(1)
points = rng.uniform([-15, -4, 5], [15, 2, 80], (300, 3))  # x right, y down, z forward, metres
times_ns = np.arange(0, 3_000_000_000, 100_000_000)  # 10 frames a second, integer nanoseconds

frames = []
for seconds in times_ns * 1e-9:
    x, y, depth = (points - [0, 0, 10 * seconds]).T
    disparity = 700 * 0.5 / depth
    # ul vl ur vr, rectified pixels
    z = np.column_stack([600 + 700 * x / depth, 180 + 700 * y / depth] * 2)
    z[:, 2] -= disparity
    z += rng.normal(0, 0.3, z.shape)
    seen = (depth > 3) & (z > 0).all(axis=1) & (z[:, 0] < 1200) & (z[:, 1] < 370)
    ids = np.flatnonzero(seen)  # one id for one point
    frames.append((ids, z[seen], disparity[seen] > 3))  # those far away: left pixels only

vio.write_observations(sys.argv[1], rig, times_ns, frames)
result = vio.run(vio.open_dataset(sys.argv[1]), vio.load_config())
x, y, z = result.trajectory.positions[-1]
print(f"{len(frames)} frames; at the end {z:.2f} m ahead of 29.00, {np.hypot(x, y):.2f} m beside")
