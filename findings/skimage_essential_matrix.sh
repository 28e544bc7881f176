#!/usr/bin/env bash
# scikit-image 0.26.0: `EssentialMatrixTransform.from_estimate` of exact points, without noise or outliers, is the essential matrix of another rotation: about
# 1 degree off, with residuals of points up to 0.009 in normalised coordinates, 3.5 px at a focal length of 400 px. It makes the two singular values equal
# while the points are still shifted and scaled for the sake of the numbers, and they are not equal any more when that is undone (1 to 0.96).
# The direction of the translation is right. `FundamentalMatrixTransform` of the same points is exact, and so is OpenCV's `findEssentialMat`.
# Guessed: an estimate is exact for exact points, and what it returns is an essential matrix.
# Matters here: relative rotations of image pairs are wrong by what a filter drifts in minutes. RANSAC around it (`skimage.measure.ransac`, one pixel) calls
# nearly all points inliers and returns the same wrong rotation. Use the fundamental matrix of normalised points, and make its singular values equal then.
# Source: skimage/transform/_geometric.py, EssentialMatrixTransform._estimate; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" scikit-image==0.26.0 scipy==1.17.1 \
    opencv-python-headless==4.14.0.94 numpy==2.3.5
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import cv2
import numpy as np
import skimage
from scipy.spatial.transform import Rotation
from skimage.measure import ransac
from skimage.transform import EssentialMatrixTransform, FundamentalMatrixTransform

R = Rotation.from_rotvec([0.02, 0.1, -0.05]).as_matrix()
t = np.array([0.5, 0.05, 0.02])


def errors(E):
    """Error of the rotation (of the nearer of its two) and of the translation's direction, degrees; ratio of the singular values."""
    U, S, V = np.linalg.svd(E)
    U, V = U * np.sign(np.linalg.det(U)), V * np.sign(np.linalg.det(V))
    W = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    turned = min(Rotation.from_matrix(U @ w @ V @ R.T).magnitude() for w in (W, W.T))
    aside = np.linalg.norm(np.cross(U[:, 2], t / np.linalg.norm(t)))
    return np.rad2deg([turned, aside]).tolist() + [S[1] / S[0]]


print("scikit-image", skimage.__version__, "OpenCV", cv2.__version__)
kept = []
found = {"essential": [], "ransac": [], "fundamental": [], "opencv": []}
residuals = []
for seed in range(6):
    points = np.random.default_rng(seed).uniform([-2, -1.5, 4], [2, 1.5, 12], (80, 3))
    first, second = (p[:, :2] / p[:, 2:] for p in (points, points @ R.T + t))
    essential = EssentialMatrixTransform.from_estimate(first, second)
    residuals.append(float(np.abs(essential.residuals(first, second)).max()))
    found["essential"].append(errors(essential.params))
    found["fundamental"].append(errors(FundamentalMatrixTransform.from_estimate(first, second).params))
    found["opencv"].append(errors(cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.999, 1e-4)[0]))
    model, inliers = ransac((first, second), EssentialMatrixTransform, 8, 1 / 400, max_trials=50, rng=seed)
    kept.append(float(inliers.mean()))
    found["ransac"].append(errors(model.params))
    exact = EssentialMatrixTransform(rotation=R, translation=t / np.linalg.norm(t))
    assert np.abs(exact.residuals(first, second)).max() < 1e-12  # the same convention
for name, rows in found.items():
    turned, aside, ratio = np.array(rows).T
    print(f"{name}: rotations {turned.min():.4f} to {turned.max():.4f} degrees off, directions up to {aside.max():.4f} degrees, singular values 1 to {ratio.min():.3f}")
print("largest residual of the essential matrices:", round(max(residuals), 4),
      "- RANSAC within a pixel of 400 keeps", [round(share, 2) for share in kept])
rows = {name: np.array(values) for name, values in found.items()}
assert rows["essential"][:, 0].min() > 0.4 and rows["essential"][:, 2].max() < 0.98
assert rows["essential"][:, 1].max() < 1e-3
assert max(residuals) > 3e-3
assert min(kept) > 0.9 and rows["ransac"][:, 0].min() > 0.3
for name in ("fundamental", "opencv"):
    assert rows[name][:, :2].max() < 1e-3, name
PYTHON
