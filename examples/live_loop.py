"""Odometry one sample at a time, as a robot has them, with poses between frames for a controller.

python examples/live_loop.py RECORDING          # stands in for the cameras and the IMU
"""

import sys

import numpy as np

import vio
from vio.errors import DataError

source = vio.open_dataset(sys.argv[1])
recording = source.recording
use_imu = "imu" in recording.motion
config = vio.load_config(overrides=[f"motion={'imu' if use_imu else 'none'}"])
T_cam0_imu = recording.T_cam0_imu if recording.T_cam0_imu is not None else np.eye(4)
odometry = vio.Odometry(recording.camera, config, T_cam0_imu=T_cam0_imu)

for event in source.events():
    try:
        if hasattr(event, "left"):  # a pair of images; a live camera gives the time and two arrays
            odometry.add_stereo(event.time_ns, event.left, event.right)
        elif use_imu:  # a sample of the IMU: rad/s and m/s^2
            odometry.add_imu(event.time_ns, event.gyro, event.accel)
    except DataError as error:  # a bad sample or image changes nothing
        print("refused:", error)
        continue
    if odometry.estimate is not None and hasattr(event, "left"):
        x, y, z = odometry.estimate.T_world_imu[:3, 3]
        sigma = np.sqrt(np.trace(odometry.estimate.covariance[:3, :3]))
        print(f"{odometry.estimate.time_ns * 1e-9:.3f} s  {x:8.3f} {y:8.3f} {z:8.3f} m  +- {sigma:.3f} m")

odometry.finish()
ahead = odometry.predict(odometry.estimate.time_ns + 20_000_000)  # 20 ms after the newest frame
print("20 ms later:", ahead.T_world_imu[:3, 3].round(3))
for line in odometry.warnings:
    print("warning:", line)
