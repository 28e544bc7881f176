#!/usr/bin/env bash
# spatialmath-python 1.1.18 and pytransform3d 3.17.0: `UnitQuaternion.interp` and `quaternion_slerp` go the long way round where two quaternions are more than 90 degrees apart as vectors: half-way
# between headings of 170 and -170 degrees they return 0. `SO3.interp` and `SE3.interp`, `pq_slerp` and `transform_sclerp` of the same packages return 180. `quaternion_slerp` does so between any two
# near attitudes, if one has w < 0.
# Guessed: interpolated attitudes lie between the two, as with SciPy's Slerp and the packages' own other functions. `shortest` and `shortest_path` are there, False by default.
# Matters here: attitudes of a reference between its samples, at the times of images. Where all have w >= 0, those of the interval in which the heading crosses 180 degrees are off by up to 180
# degrees, and all others are right. Pass True.
# Source: spatialmath/quaternion.py and pytransform3d's quaternion_slerp ("default: False"); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" spatialmath-python==1.1.18 pytransform3d==3.17.0 numpy==2.4.6 scipy==1.17.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from pytransform3d.rotations import quaternion_slerp
from pytransform3d.transformations import pq_slerp, transform_sclerp
from scipy.spatial.transform import Rotation, Slerp
from spatialmath import SE3, SO3, UnitQuaternion

print("spatialmath-python", version("spatialmath-python"), "pytransform3d", version("pytransform3d"))


def matrix(quaternion):
    """Return the 4 x 4 matrix of a quaternion, w first."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    return T


def ways(first, last):
    """Return the rotation half-way between two quaternions, w first, by each function."""
    unit = UnitQuaternion(first), UnitQuaternion(last)
    matrices = matrix(first), matrix(last)
    none = np.zeros(3)
    both = Rotation.from_quat([first, last], scalar_first=True)
    quaternions = {
        "spatialmath UnitQuaternion.interp": unit[0].interp(unit[1], 0.5).vec,
        "    with shortest=True": unit[0].interp(unit[1], 0.5, shortest=True).vec,
        "pytransform3d quaternion_slerp": quaternion_slerp(first, last, 0.5),
        "    with shortest_path=True": quaternion_slerp(first, last, 0.5, shortest_path=True),
        "pytransform3d pq_slerp": pq_slerp(np.r_[none, first], np.r_[none, last], 0.5)[3:],
    }
    found = {name: Rotation.from_quat(np.ravel(q), scalar_first=True) for name, q in quaternions.items()}
    found["spatialmath SO3.interp"] = Rotation.from_matrix(SO3(matrices[0][:3, :3]).interp(SO3(matrices[1][:3, :3]), 0.5).R)
    found["spatialmath SE3.interp"] = Rotation.from_matrix(SE3(matrices[0]).interp(SE3(matrices[1]), 0.5).R)
    found["pytransform3d transform_sclerp"] = Rotation.from_matrix(transform_sclerp(*matrices, 0.5)[:3, :3])
    found["SciPy Slerp"] = Slerp([0, 1], both)(0.5)
    return both, found


UNIT, SLERP = "spatialmath UnitQuaternion.interp", "pytransform3d quaternion_slerp"
heading = [Rotation.from_euler("z", angle, degrees=True).as_quat(scalar_first=True) for angle in (170, -170)]
tilted = Rotation.from_euler("ZYX", [40, 10, -5], degrees=True).as_quat(scalar_first=True)
near = Rotation.from_euler("ZYX", [44, 12, -5], degrees=True).as_quat(scalar_first=True)
for title, first, last, wrong in (
    ("headings 170 and -170 degrees, both with w >= 0", heading[0], heading[1], (UNIT, SLERP)),
    ("4 degrees of heading, the second with w < 0", tilted, -near, (SLERP,)),
    ("4 degrees of heading, both with w >= 0", tilted, near, ()),
):
    both, found = ways(first, last)
    apart = np.degrees((both[0].inv() * both[1]).magnitude())
    print(f"{title}: {apart:.1f} degrees apart; from the first to half-way:")
    for name, rotation in found.items():
        turn = np.degrees((both[0].inv() * rotation).magnitude())
        print(f"    {name}: {turn:.1f} degrees")
        expected = 180 - apart / 2 if name in wrong else apart / 2
        assert abs(turn - expected) < 0.01
PYTHON
