#!/usr/bin/env bash
# gtsam 4.3.0: to `AttitudeFactorRot3` and `AttitudeFactorPose3` (the direction of gravity in the body) an attitude that is upside down fits exactly: the error is the sine of the
# angle between the two directions, so it falls again beyond 90 degrees and is 0 at 180. A body that starts 80 degrees off, in the right half, ends upside down with an error of 0
# by Levenberg-Marquardt; one that starts upside down stays, with a small covariance, whatever sigma is stated.
# Guessed: "angular difference between the rotated reference direction and the measured direction", as its documentation says, at least one that grows up to 180 degrees;
# `Unit3.localCoordinates` and `distance` of the same class do.
# Matters here: such factors level a rig at its start, or hold roll and pitch of a pose graph. Identity as first guess, where the accelerometer's axis points down, or a camera's
# axes taken for the body's, are far off; the whole map is then built upside down, with an error of 0 in the factor that should tell. Start from the accelerometer: a rotation
# that takes its direction to the vertical.
# Source: gtsam/navigation/doc/AttitudeFactor.ipynb (a later version adds that the Jacobian vanishes 180 degrees away); Unit3::error in gtsam/geometry/Unit3.cpp; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" gtsam==4.3.0 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import gtsam
import numpy as np

UP = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
print("gtsam", version("gtsam"))
factor = gtsam.AttitudeFactorRot3(0, UP, gtsam.noiseModel.Isotropic.Sigma(2, 0.01), UP)


def values(degrees):
    given = gtsam.Values()
    given.insert(0, gtsam.Rot3.Roll(np.radians(degrees)))
    return given


for degrees in (10, 60, 90, 120, 170, 180):
    size = np.linalg.norm(factor.unwhitenedError(values(degrees)))
    turned = gtsam.Rot3.Roll(np.radians(degrees)).rotate(UP)
    print(f"off by {degrees} degrees: error {size:.3f}, localCoordinates {np.linalg.norm(UP.localCoordinates(turned)):.3f}")
    assert abs(size - np.sin(np.radians(degrees))) < 1e-9
for degrees, upright in ((30, True), (60, True), (80, False), (170, False), (180, False)):
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    heading = gtsam.noiseModel.Diagonal.Sigmas(np.array([100.0, 100.0, 0.1]))  # roll and pitch free
    graph.add(gtsam.PriorFactorRot3(0, values(degrees).atRot3(0), heading))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values(degrees)).optimize()
    z = result.atRot3(0).matrix()[2, 2]
    sigmas = np.sqrt(np.diag(gtsam.Marginals(graph, result).marginalCovariance(0)))
    print(f"started {degrees} degrees off: its z-axis points {'up' if z > 0 else 'down'} ({z:.4f}), error {factor.error(result):.1e},",
          f"sigmas of roll and pitch {sigmas[:2].round(4)}")
    assert (z > 0.999) == upright and (z < -0.999) != upright
    assert factor.error(result) < 1e-6 and sigmas[:2].max() < 0.011
PYTHON
