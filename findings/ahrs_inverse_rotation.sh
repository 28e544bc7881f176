#!/usr/bin/env bash
# ahrs 0.4.0: from the same samples of an accelerometer and a magnetometer, AQUA and SAAM return the inverse of the
# rotation that Madgwick, Tilt, Fourati and Complementary return.
# Guessed: all estimators of one package return one rotation.
# Matters here: an attitude from such a filter as reference turns the wrong way, without an error at small angles
# being large.
# Source: ahrs.filters; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" ahrs==0.4.0 scipy==1.17.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from ahrs import filters
from scipy.spatial.transform import Rotation

sensor_to_world = Rotation.from_euler("zyx", [0.6, 0.3, -0.2])
count = 2000
acc = np.tile(sensor_to_world.inv().apply([0, 0, 9.81]), (count, 1))
mag = np.tile(sensor_to_world.inv().apply([20.0, 0, -43.0]), (count, 1))
gyr = np.zeros((count, 3))
print("ahrs", version("ahrs"))
for name in ("Madgwick", "Fourati", "Complementary", "Tilt", "AQUA", "SAAM"):
    data = {"acc": acc, "mag": mag}
    if name in ("Madgwick", "Fourati", "Complementary", "AQUA"):
        data |= {"gyr": gyr, "frequency": 100.0}
    found = Rotation.from_quat(getattr(filters, name)(**data).Q[-1], scalar_first=True)
    direct = np.degrees((found.inv() * sensor_to_world).magnitude())
    inverse = np.degrees((found * sensor_to_world).magnitude())
    print(f"{name}: {direct:.1f} deg from the rotation, {inverse:.1f} deg from its inverse")
    assert min(direct, inverse) < 1.0 < 30.0 < max(direct, inverse)
    assert (inverse < direct) == (name in ("AQUA", "SAAM"))
PYTHON
