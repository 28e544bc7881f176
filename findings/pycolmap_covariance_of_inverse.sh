#!/usr/bin/env bash
# pycolmap 4.2.1: `get_covariance_for_inverse` takes a covariance of [rotation; translation] on the left of the pose as a
# group (translation moved by the rotation's lever), not that of half angles and of the plain vector of the translation,
# which its bundle adjustment states. Its result for a covariance of the latter kind is not that of the inverse.
# Guessed: functions for covariances in one module share a tangent.
# Matters here: what COLMAP's adjustment states must be converted before it may be inverted or composed.
# Source: pycolmap.get_covariance_for_inverse against 200 000 samples in both tangents; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pycolmap==4.2.1 numpy==2.4.6 scipy==1.17.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

rng = np.random.default_rng(0)
pose = RigidTransform.from_components([0.5, -1.0, 2.0], Rotation.from_rotvec([0.3, -0.4, 0.8]))
given = np.diag([1.0, 2, 3, 4, 5, 6]) * 1e-6
stated = pycolmap.get_covariance_for_inverse(
    pycolmap.Rigid3d(np.ascontiguousarray(pose.as_matrix()[:3])), given
)
drawn = rng.multivariate_normal(np.zeros(6), given, size=200_000)
# as a group: exp(d) pose
group = ((RigidTransform.from_exp_coords(drawn) * pose).inv() * pose).as_exp_coords()
# as the adjustment: half angles on the left, and the plain vector
half = RigidTransform.from_components(
    pose.translation + drawn[:, 3:], Rotation.from_rotvec(2.0 * drawn[:, :3]) * pose.rotation
).inv()
back = (half.rotation * pose.inv().rotation.inv()).as_rotvec() / 2.0
plain = np.hstack([back, half.translation - pose.inv().translation])
print("pycolmap", pycolmap.__version__)
for name, errors, fits in (("group", group, True), ("half angles, plain vector", plain, False)):
    found = errors.T @ errors / len(errors)
    difference = np.abs(found - stated).max() / np.abs(stated).max()
    print(f"{name}: differs from what pycolmap states by {100 * difference:.1f} % of the largest entry")
    assert (difference < 0.03) == fits
PYTHON
