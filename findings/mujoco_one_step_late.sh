#!/usr/bin/env bash
# MuJoCo 4.0.0: after `mj_step` the time, `qpos` and `qvel` are new, but the gyro and the pose of a camera are still those before the step.
# Read together, IMU and images are one step (2 ms by default) older than the ground truth and the time that they are stored with.
# Guessed: one state, at `data.time`. `mj_forward` after each step makes it one.
# Matters here: recordings of simulated rigs are a common test. Images and IMU are late by the same, so no time shift between them tells:
# a correct estimate has an error of speed times the step.
# Source: https://github.com/google-deepmind/mujoco/issues/889; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --no-deps --target "$folder/packages" \
    mujoco==4.0.0 mujoco-core==4.0.0 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import mujoco
import numpy as np

STEP_S = 0.005
model = mujoco.MjModel.from_xml_string(f"""<mujoco>
  <option timestep="{STEP_S}"/>
  <worldbody><body>
    <joint name="turn" type="hinge" axis="0 0 1"/>
    <geom type="box" size=".1 .1 .1" mass="1"/>
    <site name="imu"/>
    <camera name="camera" pos=".5 0 0"/>
  </body></worldbody>
  <actuator><motor joint="turn"/></actuator>
  <sensor><gyro site="imu"/></sensor>
</mujoco>""")
data = mujoco.MjData(model)
data.ctrl[0] = 0.05
for _ in range(400):
    mujoco.mj_step(model, data)


def steps_late():
    """Return by how many steps the gyro and the camera are behind the rate and the angle of the state."""
    x, y, _ = data.camera("camera").xpos
    gyro = (data.qvel[0] - data.sensordata[2]) / (data.qacc[0] * STEP_S)
    turned = np.remainder(data.qpos[0] - np.arctan2(y, x) + np.pi, 2 * np.pi) - np.pi
    camera = turned / (data.qvel[0] * STEP_S)
    return round(float(gyro), 3), round(float(camera), 3)


print(f"MuJoCo {mujoco.__version__}, time {data.time:.3f} s, rate {data.qvel[0]:.4f} rad/s, gyro {data.sensordata[2]:.4f} rad/s")
stepped = steps_late()
mujoco.mj_forward(model, data)
print("  steps that gyro and camera are late, after mj_step:", stepped, "after mj_forward:", steps_late())
assert np.allclose(stepped, 1.0, atol=0.01)
assert np.allclose(steps_late(), 0.0, atol=1e-6)
PYTHON
