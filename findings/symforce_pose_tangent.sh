#!/usr/bin/env bash
# symforce 0.12.0: a covariance of a `Pose3` that its `Optimizer` states has the rotation in the axes of the body and the translation in those of the
# world: the tangent of the pose is that of a rotation and of a plain vector, not of SE(3). Of a body with a heading of 90 degrees whose position is
# known to 1 m ahead, 0.1 m to the left and 0.01 m up, the standard deviations are (0.1, 1, 0.01), and rolls and pitches remain the body's.
# Guessed: one frame for all six numbers, the body's as in gtsam, or the world's as in ROS; the class is called a pose and composes as one.
# Matters here: our covariances, and gtsam's, are of the body's axes. Taken over number by number, along and across are swapped at 90 degrees, and the
# correlations of rotation with translation are wrong at any other heading; at heading 0, where one tests, nothing shows. `vio.interop` writes none for symforce.
# Source: symforce's Optimizer.compute_all_covariances and sym.Pose3.retract; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" symforce==0.12.0 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON' | grep -E "^(symforce|heading) " # the rest is symforce's log of times
import numpy as np
import symforce

symforce.set_epsilon_to_number()
import sym
import symforce.symbolic as sf
from symforce.opt.factor import Factor
from symforce.opt.optimizer import Optimizer
from symforce.values import Values

POSITION_M = np.array([1.0, 0.1, 0.01])  # standard deviations ahead, left and up
ROTATION_RAD = np.array([0.02, 0.002, 0.0002])  # about these three axes: roll, pitch, yaw


def position(pose: sf.Pose3, measured: sf.Pose3, weights: sf.V3, epsilon: sf.Scalar) -> sf.V3:
    in_body = measured.R.inverse() * (pose.t - measured.t)
    return sf.V3(*[w * x for w, x in zip(weights, in_body)])


def rotation(pose: sf.Pose3, measured: sf.Pose3, turn_weights: sf.V3, epsilon: sf.Scalar) -> sf.V3:
    in_body = (measured.R.inverse() * pose.R).to_tangent(epsilon)
    return sf.V3(*[w * x for w, x in zip(turn_weights, in_body)])


print("symforce", symforce.__version__)
for heading_deg in (0.0, 90.0):
    turn = sym.Rot3.from_yaw_pitch_roll(np.radians(heading_deg), 0.0, 0.0)
    pose = sym.Pose3(R=turn, t=np.array([5.0, 6.0, 7.0]))
    values = Values(
        pose=pose, measured=pose, weights=1 / POSITION_M, turn_weights=1 / ROTATION_RAD, epsilon=1e-9
    )
    factors = [
        Factor(keys=["pose", "measured", "weights", "epsilon"], residual=position),
        Factor(keys=["pose", "measured", "turn_weights", "epsilon"], residual=rotation),
    ]
    optimizer = Optimizer(factors=factors, optimized_keys=["pose"], params=Optimizer.Params(verbose=False))
    result = optimizer.optimize(values)
    sigmas = np.sqrt(np.diag(optimizer.compute_all_covariances(result.optimized_values)["pose"]))
    print(f"heading {heading_deg:.0f} degrees: rotation {sigmas[:3].round(5)} rad, translation {sigmas[3:].round(4)} m")
    assert np.allclose(sigmas[:3], ROTATION_RAD, rtol=1e-3)
    order = [0, 1, 2] if heading_deg == 0 else [1, 0, 2]
    assert np.allclose(sigmas[3:], POSITION_M[order], rtol=1e-3)
    ahead = pose.retract(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])).t - pose.t
    assert np.allclose(ahead, [1.0, 0.0, 0.0])  # of the world, whatever the heading
PYTHON
