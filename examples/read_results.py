"""What a run left behind, as arrays: poses with covariance, speed, errors, time.

python examples/read_results.py RUN
"""

import sys
from pathlib import Path

import numpy as np

from vio.runs.finished import read_finished_run

run = read_finished_run(Path(sys.argv[1]))
T = run.estimates["T_world_imu"]  # (N, 4, 4)
# An error xi moves the pose as T_world_imu exp(-xi); in the world, the position's covariance is R P
# R'.
R, P = T[:, :3, :3], run.estimates["covariance"][:, :3, :3]
sigma = np.sqrt(np.diagonal(R @ P @ np.swapaxes(R, 1, 2), axis1=1, axis2=2))
speed = np.linalg.norm(run.estimates["velocity_world"], axis=1)

print(f"{len(T)} frames, {run.seconds[-1]:.2f} s, from {run.metrics['source']}")
print("last position ", T[-1, :3, 3].round(3), "+-", (3 * sigma[-1]).round(3), "m (3 sigma)")
print(f"speed          {np.nanmedian(speed):.2f} m/s in the median")
print(f"features used  {np.median(run.frames['used']):.0f} in the median")
print(f"filter         {run.frames['filter_ms'].mean():.1f} ms a frame")
if run.evaluation is not None:
    print(
        f"error          {run.evaluation.ate_m.rmse:.4f} m (ATE), at most "
        f"{run.evaluation.ate_m.max:.4f} m"
    )
for line in run.metrics["warnings"]:
    print("warning:", line)
