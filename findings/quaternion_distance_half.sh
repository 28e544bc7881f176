#!/usr/bin/env bash
# spatialmath-python 1.1.18, rowan 1.3.2: the distance between two rotations is half the angle between them. `UnitQuaternion.angdist` of spatialmath returns
# 5 degrees where `SO3.angdist` of the same package, for the same two rotations, returns 10; `rowan.geometry.sym_intrinsic_distance`
# returns 5 too, and `intrinsic_distance` 5 or 175 by the sign of the quaternions. SciPy and pytransform3d 3.17.0's `quaternion_dist` return the whole angle.
# Guessed: what is called an angular distance, a geodesic one or an intrinsic one is the angle of the rotation from the one to the other, in each class of it.
# Matters here: a rotational error of a trajectory (RPE, drift in degrees per metre), or a test of a calibration against a tolerance, is twice as good as it
# is, depending on the class or the package that computed it. `metric=4` of `UnitQuaternion.angdist` is the angle.
# Source: spatialmath/quaternion.py and pose3d.py, tables of metrics (defaults 3 and 6); rowan/geometry; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" spatialmath-python==1.1.18 rowan==1.3.2 \
    pytransform3d==3.17.0 scipy==1.17.1 numpy==2.3.5
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
import rowan
from pytransform3d.rotations import quaternion_dist
from scipy.spatial.transform import Rotation
from spatialmath import SO3, UnitQuaternion

print({name: version(name) for name in ("spatialmath-python", "rowan", "pytransform3d", "scipy")})
rng = np.random.default_rng(0)
first = Rotation.random(rng=rng)
axis = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
for angle in (10.0, 90.0, 170.0):
    second = Rotation.from_rotvec(np.deg2rad(angle) * axis) * first
    a, b = (r.as_quat(canonical=True, scalar_first=True) for r in (first, second))
    found = {
        "scipy": (first.inv() * second).magnitude(),
        "pytransform3d": quaternion_dist(a, b),
        "spatialmath SO3": SO3(first.as_matrix()).angdist(SO3(second.as_matrix())),
        "spatialmath UnitQuaternion": UnitQuaternion(a).angdist(UnitQuaternion(b)),
        "rowan": float(rowan.geometry.sym_intrinsic_distance(a, b)),
    }
    found = {name: float(np.rad2deg(value)) for name, value in found.items()}
    print(f"{angle:.0f} degrees:", {name: round(value, 3) for name, value in found.items()})
    for name, share in zip(found, (1, 1, 1, 0.5, 0.5), strict=True):
        assert abs(found[name] - share * angle) < 1e-3, name
    signs = sorted(float(np.rad2deg(rowan.geometry.intrinsic_distance(a, sign * b))) for sign in (1, -1))
    print("  rowan's intrinsic_distance, the same rotation as q and as -q:", [round(value, 3) for value in signs])
    assert np.allclose(signs, [angle / 2, 180 - angle / 2], atol=1e-3)
    assert abs(np.rad2deg(UnitQuaternion(a).angdist(UnitQuaternion(b), metric=4)) - angle) < 1e-3
PYTHON
