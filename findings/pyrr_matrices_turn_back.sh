#!/usr/bin/env bash
# pyrr 0.10.3: a quaternion and the matrix that pyrr makes of it turn vectors in opposite directions. `q * v` is the usual rotation; `q.matrix33 * v`, `Matrix33.from_quaternion(q) * v` and `Matrix44`'s are
# its inverse, though the matrix has the numbers of the usual one: `*` and pyrr's `apply_to_vector` multiply by the transpose, `@` of numpy does not. Products are reversed likewise: `a.matrix33 * b.matrix33`
# is the matrix of `b * a`. And a translation applies only from the last row of a `Matrix44`.
# Guessed: one package has one convention, and `*` and `@` of one matrix and one vector are the same.
# Matters here: a pose of a trajectory (x y z w, as pyrr has it) that is drawn or multiplied as a matrix is turned back: 60 degrees off for 30. Points of a map are in the right place at the first frame,
# where the attitude is the identity, and so in any test that starts there. `vio`'s matrices are those of numpy: `@`.
# Source: pyrr's issues 70, 96 and 101; pyrr/matrix33.py; SciPy's Rotation for comparison; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/packages" pyrr==0.10.3 scipy==1.17.1 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from pyrr import Matrix33, Matrix44, Quaternion, Vector3
from scipy.spatial.transform import Rotation

print("pyrr", version("pyrr"), "SciPy", version("scipy"))
v = np.array([1.0, 2.0, 3.0])
for degrees in (30.0, 90.0):
    true = Rotation.from_rotvec(np.radians(degrees) * np.array([2.0, -1.0, 2.0]) / 3)
    q = Quaternion(true.as_quat())
    turned = {
        "quaternion * v": q * Vector3(v),
        "q.matrix33 * v": q.matrix33 * Vector3(v),
        "Matrix33.from_quaternion(q) * v": Matrix33.from_quaternion(q) * Vector3(v),
        "Matrix44.from_quaternion(q) * v": Matrix44.from_quaternion(q) * Vector3(v),
        "q.matrix33 @ v": q.matrix33 @ v,
    }
    print(f"{degrees:.0f} degrees: SciPy {np.round(true.apply(v), 3).tolist()}, its inverse {np.round(true.inv().apply(v), 3).tolist()}")
    for name, result in turned.items():
        result = np.array(result.tolist())
        inverse = np.allclose(result, true.inv().apply(v), atol=1e-6)
        print(f"    {name}: {np.round(result, 3).tolist()}{', the inverse' if inverse else ''}")
        assert inverse == (name[-3:] == "* v" and name[0] != "q" or name.startswith("q.matrix33 *"))
        assert inverse or np.allclose(result, true.apply(v), atol=1e-6)
    assert np.allclose(q.matrix33.tolist(), true.as_matrix(), atol=1e-6)

a, b = Rotation.from_euler("z", 40, degrees=True), Rotation.from_euler("x", 70, degrees=True)
first, second = Quaternion(a.as_quat()), Quaternion(b.as_quat())
assert np.allclose((first * second).matrix33.tolist(), (a * b).as_matrix(), atol=1e-6)
assert np.allclose((first.matrix33 * second.matrix33).tolist(), (b * a).as_matrix(), atol=1e-6)
print("products: quaternions as SciPy's, matrices in the reverse order")
pose = np.eye(4)
pose[:3, 3] = 10.0, 0.0, 0.0
print("a pose with its translation in the last column moves a point to", (Matrix44(pose) * Vector3(v)).tolist(), "and in the last row to", (Matrix44(pose.T) * Vector3(v)).tolist())
assert (Matrix44(pose.T) * Vector3(v)).tolist() == [11, 2, 3] and (Matrix44(pose) * Vector3(v)).tolist() != [11, 2, 3]
PYTHON
