#!/usr/bin/env bash
# Pinocchio 4.1.0: `getFrameAcceleration` is the spatial acceleration, also in the axes of the world and about the frame's own origin (LOCAL_WORLD_ALIGNED):
# its linear part lacks the centripetal acceleration. A car that drives a circle at 10 m/s and 0.5 rad/s has 0 instead of 5 m/s^2, a camera on a turning arm 0 too.
# `getFrameClassicalAcceleration` is the second derivative of the position, which an accelerometer measures beside gravity.
# Guessed: the function with the plain name, in the frame of the sensor, is what a sensor there feels; its twin `getFrameVelocity` is so.
# Matters here: IMU samples that a simulated robot gets from it contradict its images in each curve, by the speed times the rate; on a straight line all
# is right. A filter takes the difference for a bias or for tilt. `vio render` takes the second derivative of its positions, so it is not concerned.
# Source: the documentation of both functions in pinocchio/algorithm/frames.hpp; the positions' second differences; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pin==4.1.0 numpy==2.4.6
site=$(echo "$folder"/packages/cmeel.prefix/lib/python3*/site-packages)
PYTHONPATH="$folder/packages:$site" python3 - <<'PYTHON'
import numpy as np
import pinocchio as pin

STEP_S = 1e-4


def model_of(joint):
    """Return a model of one joint and the id of a sensor half a metre ahead of it."""
    model = pin.Model()
    index = model.addJoint(0, joint, pin.SE3.Identity(), "joint")
    ahead = pin.SE3(np.eye(3), np.array([0.5, 0.0, 0.0]))
    return model, model.addFrame(pin.Frame("imu", index, 0, ahead, pin.FrameType.SENSOR))


def position(model, sensor, q):
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[sensor].translation.copy()


print("Pinocchio", pin.__version__)
car = np.array([10.0, 0.0, 0.0, 0.0, 0.0, 0.5])  # forwards, and turning left; constant in its own axes
for name, joint, speed in (("arm", pin.JointModelRZ(), np.array([2.0])), ("car", pin.JointModelFreeFlyer(), car)):
    model, sensor = model_of(joint)
    q = pin.integrate(model, pin.neutral(model), 0.7 * speed)
    data = model.createData()
    pin.forwardKinematics(model, data, q, speed, 0.0 * speed)
    pin.updateFramePlacements(model, data)
    path = [position(model, sensor, pin.integrate(model, q, k * STEP_S * speed)) for k in (-1, 0, 1)]
    velocity, true = (path[2] - path[0]) / (2 * STEP_S), (path[2] - 2 * path[1] + path[0]) / STEP_S**2
    axes = pin.LOCAL_WORLD_ALIGNED
    plain = pin.getFrameAcceleration(model, data, sensor, axes).linear
    classical = pin.getFrameClassicalAcceleration(model, data, sensor, axes).linear
    in_sensor = pin.getFrameAcceleration(model, data, sensor, pin.LOCAL).linear
    print(f"{name}: true {np.linalg.norm(true):.2f} m/s^2, getFrameAcceleration {np.linalg.norm(plain):.2f}, classical {np.linalg.norm(classical):.2f}")
    assert np.allclose(pin.getFrameVelocity(model, data, sensor, axes).linear, velocity, atol=1e-4)
    assert np.allclose(classical, true, atol=1e-3) and np.linalg.norm(true) > 1.9
    assert np.abs(plain).max() < 1e-9 and np.abs(in_sensor).max() < 1e-9
PYTHON
