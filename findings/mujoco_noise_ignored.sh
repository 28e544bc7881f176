#!/usr/bin/env bash
# MuJoCo 4.0.0: `noise` of a gyro or an accelerometer is read, kept in `sensor_noise` and written back into XML, and adds nothing to the readings. Up to 3.1.3 the flag `sensornoise` added it.
# Guessed: a standard deviation in the model of a sensor is that of its readings, as of Gazebo's `<noise>`; at least whoever states one is warned.
# Matters here: an IMU simulated from such a model is perfect. A VIO looks better than it is, its noise densities, taken from that same model, make covariances too large, and a
# consistency check (NEES, NIS) of either says nothing. Add white noise and the walk of the biases to `sensordata`: sigma = density * sqrt(rate).
# Source: https://github.com/google-deepmind/mujoco/discussions/1602 (points to the changelog of 3.1.4); https://mujoco.readthedocs.io/en/stable/XMLreference.html; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/4.0.0" mujoco==4.0.0 numpy==2.4.6
python3 -m pip --quiet --disable-pip-version-check install --no-compile --no-deps --target "$folder/3.1.3" mujoco==3.1.3
for release in 4.0.0 3.1.3; do
    PYTHONPATH="$folder/$release:$folder/4.0.0" python3 - <<'PYTHON'
import warnings

import mujoco
import numpy as np

GYRO, ACCELEROMETER = 0.05, 0.8  # standard deviations: rad/s, m/s^2
old = mujoco.__version__ == "3.1.3"
model = mujoco.MjModel.from_xml_string(f"""
<mujoco>
  {'<option><flag sensornoise="enable"/></option>' if old else ""}
  <worldbody>
    <body pos="0 0 1"><site name="imu"/></body>
  </worldbody>
  <sensor>
    <gyro site="imu" noise="{GYRO}"/>
    <accelerometer site="imu" noise="{ACCELEROMETER}"/>
  </sensor>
</mujoco>""")
data = mujoco.MjData(model)
readings = []
with warnings.catch_warnings():
    warnings.simplefilter("error")
    for _ in range(2000):
        mujoco.mj_step(model, data)
        readings.append(data.sensordata.copy())
scatter = np.std(readings, axis=0)
print(f"MuJoCo {mujoco.__version__}: stated standard deviations {model.sensor_noise}")
print(f"    of 2000 readings at rest: gyro {scatter[:3].max():.3g} rad/s, accelerometer {scatter[3:].max():.3g} m/s^2; last {readings[-1].round(3)}")
assert np.array_equal(model.sensor_noise, (GYRO, ACCELEROMETER))
if old:
    assert np.allclose(scatter[:3], GYRO, rtol=0.1) and np.allclose(scatter[3:], ACCELEROMETER, rtol=0.1)
else:
    assert scatter.max() < 1e-9
    spec = mujoco.MjSpec.from_string("<mujoco><worldbody><site name='imu'/></worldbody><sensor><gyro site='imu' noise='0.05'/></sensor></mujoco>")
    spec.compile()
    assert 'noise="0.05"' in spec.to_xml()
PYTHON
done
