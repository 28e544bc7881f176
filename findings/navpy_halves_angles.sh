#!/usr/bin/env bash
# navpy 1.0: `angle2quat` halves the arrays of angles it is given, in place: after the call yaw, pitch and roll are half of what they were, and a second call returns other attitudes. Only for
# arrays of floats in radians: scalars, lists, and degrees are left alone, so its own examples show nothing.
# Guessed: a conversion of angles to quaternions reads its arguments.
# Matters here: logs have attitudes as arrays of roll, pitch and yaw. Whatever is done with them after the conversion, headings against a VIO's, plots, a second file, is of half the
# angles, smooth and without a warning; run twice in a notebook, a quarter. Pass copies.
# Source: https://github.com/NavPy/NavPy, navpy/core/navpy.py; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" --no-deps navpy==1.0 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
import navpy

print("navpy", version("navpy"))
DEGREES = np.array([10.0, 80.0, 170.0])
yaw, pitch, roll = np.radians(DEGREES), np.radians([5.0, 0.0, -5.0]), np.radians([1.0, 2.0, 3.0])
first = navpy.angle2quat(yaw, pitch, roll)
print(f"yaw {DEGREES} degrees; after the first call {np.degrees(yaw).round(3)}")
second = navpy.angle2quat(yaw, pitch, roll)
print(f"    after the second {np.degrees(yaw).round(3)}; q0 {first[0].round(4)}, then {second[0].round(4)}")
assert np.allclose(np.degrees(yaw), DEGREES / 4)
headings = [np.degrees(navpy.quat2angle(*quaternions)[0]) for quaternions in (first, second)]
print(f"    headings of the quaternions: {headings[0].round(2)}, then {headings[1].round(2)} degrees")
assert np.allclose(headings[0], DEGREES) and np.allclose(headings[1], DEGREES / 2)
one = np.radians(DEGREES)
same = navpy.angle2quat(one, one, one)[0]  # one array for all three is divided by eight before it is used
right = navpy.angle2quat(*np.radians([DEGREES] * 3).copy())[0]
print(f"    the same array as yaw, pitch and roll: q0 {same.round(4)} for {right.round(4)}")
assert not np.allclose(same, right, atol=0.01)
degrees, listed = DEGREES.copy(), list(np.radians(DEGREES))
navpy.angle2quat(degrees, degrees, degrees, input_unit="deg")
navpy.angle2quat(listed, listed, listed)
assert np.array_equal(degrees, DEGREES) and np.allclose(listed, np.radians(DEGREES))
PYTHON
