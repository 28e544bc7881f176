#!/usr/bin/env bash
# SciPy 1.17.1: `RotationSpline` returns rotations for times before its first and after its last one: its cubics go on. Of a rig that nods and looks round at 40 degrees a second, known ten times a
# second without any error, they are off by 2 degrees one interval after the end, by 67 after five. `Slerp` of the same module raises a ValueError.
# Guessed: what Slerp refuses ("Interpolation times must be within the range"), RotationSpline refuses, too; its text says nothing about times outside.
# Matters here: ground truth often ends before the images do; poses, or rates for a simulated gyro (`order=1`: 287 degrees a second too fast), come for their times without a warning, though nobody
# measured them. `vio eval` pairs poses within a tolerance only.
# Source: https://docs.scipy.org/doc/scipy/reference/generated/scipy.spatial.transform.RotationSpline.html, and that of Slerp; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" scipy==1.17.1 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import numpy as np
import scipy
from scipy.spatial.transform import Rotation, RotationSpline, Slerp


def true(time):
    """Attitude at a time, s: a steady turn, and pitch and roll that sway."""
    return Rotation.from_euler("ZYX", [0.4 * time, 0.3 * np.sin(2 * time), 0.2 * np.cos(3 * time)])


def rate(time):
    """Turn in degrees a second."""
    return np.degrees((true(time - 1e-5).inv() * true(time + 1e-5)).magnitude() / 2e-5)


times = np.linspace(0, 2, 21)
known = Rotation.concatenate([true(time) for time in times])
spline, slerp = RotationSpline(times, known), Slerp(times, known)
print("SciPy", scipy.__version__)
off, too_fast = {}, {}
for time in (0.95, 1.95, 2.1, 2.5, 5.0, -0.5):
    off[time] = np.degrees((spline(time) * true(time).inv()).magnitude())
    too_fast[time] = np.degrees(np.linalg.norm(spline(time, 1))) - rate(time)
    try:
        slerp(time)
        other = "returns a rotation"
    except ValueError as error:
        other = f"{error}"
    print(f"known from 0 to 2 s, asked for {time} s: {off[time]:.3f} degrees off, {too_fast[time]:+.1f} degrees/s of {rate(time):.1f}; Slerp: {other}")
    assert other.startswith("returns") == (0 <= time <= 2)
assert off[0.95] < 0.01 and off[1.95] < 0.2 and 1 < off[2.1] < 3 and off[2.5] > 50 and off[-0.5] > 20
assert too_fast[2.5] > 100
PYTHON
