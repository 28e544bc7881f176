#!/usr/bin/env bash
# ouster-sdk 1.0.1: in one `SensorInfo` the poses of the IMU and of the lidar in the sensor, `imu_to_sensor_transform` and `lidar_to_sensor_transform`, have translations in millimetres, the pose
# of the sensor on the vehicle, `sensor_to_body`, has metres, and so do points (`XYZLut`) and poses. Texts and names have no unit (that of `lidar_origin_to_beam_origin_mm` has).
# Multiplied as they are, they put the IMU of an OS1 15 m away from the sensor instead of 15 mm.
# Guessed: homogeneous transforms of one class, of which the product is the pose of the IMU on the vehicle, have one unit; and that of the points.
# Matters here: it is the lever arm of a lidar's IMU, as a lidar-inertial odometry or a reference for a VIO takes it. At 0.5 rad/s it adds 3.3 m/s^2. The offset of the lidar, 36 mm, multiplied so, is 36 m
# of height, which an alignment of trajectories hides.
# Source: ouster/sdk/_bindings/client.pyi, SensorInfo; https://github.com/ouster-lidar/ouster-ros, src/os_ros.cpp, whose transform_to_tf_msg multiplies by 1e-3; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" ouster-sdk==1.0.1 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from ouster.sdk.core import LidarMode, SensorInfo, XYZLut

info = SensorInfo.from_default(LidarMode._1024x10)
ranges = np.full((info.format.pixels_per_column, info.format.columns_per_frame), 10_000, np.uint32)  # mm


def points(**change):
    """Return the points (N, 3) of 10 m in all directions, of a sensor with other transforms."""
    for name, T in change.items():
        setattr(info, name, T)
    return XYZLut(info, use_extrinsics=True)(ranges).reshape(-1, 3)


print("ouster-sdk", version("ouster-sdk"), info.prod_line)
imu, lidar = info.imu_to_sensor_transform.copy(), info.lidar_to_sensor_transform.copy()
print("imu_to_sensor_transform:", imu[:3, 3], " lidar_to_sensor_transform:", lidar[:3, 3])
first = points()
print(f"points are {np.linalg.norm(first, axis=1).mean():.2f} from the origin for ranges of 10 m")
assert abs(np.linalg.norm(first, axis=1).mean() - 10) < 0.1

moved = {}
for name, T in (("sensor_to_body", np.eye(4)), ("lidar_to_sensor_transform", lidar)):
    there = T.copy()
    there[:3, 3] += [0, 0, 100]
    moved[name] = (points(**{name: there}) - first).mean(0)[2]
    setattr(info, name, T)
    print(f"100 more along z of {name}: points are {moved[name]:.3f} m higher")
assert abs(moved["sensor_to_body"] - 100) < 1e-3 and abs(moved["lidar_to_sensor_transform"] - 0.1) < 1e-3

arm = (np.eye(4) @ imu)[:3, 3]  # of the IMU, of a sensor in the origin of the vehicle
print(f"sensor_to_body @ imu_to_sensor_transform: the IMU is {np.linalg.norm(arm):.2f} from the sensor;",
      f"at 0.5 rad/s that is {0.25 * np.linalg.norm(arm[:2]):.1f} m/s^2, or {0.25 * np.linalg.norm(arm[:2]) / 1000:.4f}")
assert 14 < np.linalg.norm(arm) < 17
for name in ("imu_to_sensor_transform", "lidar_to_sensor_transform", "sensor_to_body"):
    text = (getattr(SensorInfo, name).__doc__ or "").strip()
    print(f"{name}: {text!r}")
    assert "mm" not in text.split() and "millimet" not in text.lower()
PYTHON
