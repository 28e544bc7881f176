#!/usr/bin/env bash
# Drake 1.51.1: `Accelerometer(body, X_BS)` measures no gravity: 0 for a rig at rest, 9.81 m/s^2 downwards in free fall. Its third argument, `gravity_vector`, is zeros unless given, and is not taken
# from the plant, whose gravity is (0, 0, -9.81).
# Guessed: "This sensor measures the proper acceleration", as the class begins: 9.81 m/s^2 upwards at rest, 0 in free fall, by default.
# Matters here: recordings of an IMU simulated so have no gravity, from which a VIO takes roll and pitch: a rig at rest has readings of 0 in every attitude. Accelerations are there, so curves look
# alive. Pass `plant.gravity_field().gravity_vector()`.
# Source: https://drake.mit.edu/pydrake/pydrake.systems.sensors.html, Accelerometer; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/packages" drake==1.51.1 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import Accelerometer

ATTITUDE = RollPitchYaw(np.radians([10, 20, 30])).ToRotationMatrix()


def readings(falls):
    """Return what two accelerometers of one body measure, in the world's axes: by default, and with gravity given."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    body = plant.AddRigidBody("rig", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
    if not falls:
        plant.WeldFrames(plant.world_frame(), body.body_frame(), RigidTransform(ATTITUDE, [0, 0, 1]))
    plant.Finalize()
    gravity = plant.gravity_field().gravity_vector()
    sensors = [Accelerometer(body, RigidTransform()), Accelerometer(body, RigidTransform(), gravity)]
    for sensor in sensors:
        builder.AddSystem(sensor)
        builder.Connect(plant.get_body_poses_output_port(), sensor.GetInputPort("body_poses"))
        builder.Connect(plant.get_body_spatial_velocities_output_port(), sensor.GetInputPort("body_spatial_velocities"))
        builder.Connect(plant.get_body_spatial_accelerations_output_port(), sensor.GetInputPort("body_spatial_accelerations"))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    if falls:
        plant.SetFreeBodyPose(plant.GetMyMutableContextFromRoot(context), body, RigidTransform(ATTITUDE, [0, 0, 1]))
    measured = [sensor.get_output_port().Eval(sensor.GetMyContextFromRoot(context)) for sensor in sensors]
    return gravity, [ATTITUDE.matrix() @ reading for reading in measured]


print("Drake", version("drake"))
for falls in (False, True):
    gravity, (default, given) = readings(falls)
    print(f"{'free fall' if falls else 'at rest'}, gravity of the plant {gravity}: by default {default.round(3) + 0.0}, with gravity_vector {given.round(3) + 0.0} m/s^2")
    proper = np.zeros(3) if falls else -gravity
    assert np.allclose(given, proper, atol=1e-9) and np.allclose(default, proper + gravity, atol=1e-9)
assert "measures the proper acceleration" in Accelerometer.__doc__
PYTHON
