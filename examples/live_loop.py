"""Odometry beside the threads of a robot: an IMU driver, a camera driver and a controller that
wants poses in between.

python examples/live_loop.py RECORDING          # stands in for the drivers, in real time
"""

import sys
import threading
import time

import vio

source = vio.open_dataset(sys.argv[1])
recording = source.recording
images = [event for event in source.events(stop=100) if hasattr(event, "left")]
samples = [event for event in source.events(stop=100, images=False) if hasattr(event, "gyro")]


def in_real_time(events):  # replace both loops over it by your drivers' callbacks
    for event in events:
        time.sleep(max(0.0, start + (event.time_ns - images[0].time_ns) * 1e-9 - time.monotonic()))
        yield event


def imu_driver(live):
    for sample in in_real_time(samples):
        live.add_imu(sample.time_ns, sample.gyro, sample.accel)  # rad/s and m/s^2; returns at once


def camera_driver(live):
    for pair in in_real_time(images):
        # copied, and processed by the odometry's own thread
        live.add_stereo(pair.time_ns, pair.left, pair.right)


def controller(live):
    for estimate in live:  # ends when the odometry is closed
        newest = live.latest() or estimate  # where this loop lags, later than its own
        ahead = live.predict(newest.time_ns + 20_000_000)  # from the samples that have come since
        x, y, z = ahead.T_world_imu[:3, 3]
        print(f"{ahead.time_ns * 1e-9:.3f} s  {x:8.3f} {y:8.3f} {z:8.3f} m")


T_cam0_imu = recording.T_cam0_imu if samples else None  # images alone
with vio.LiveOdometry(recording.camera, T_cam0_imu=T_cam0_imu) as live:
    print("warming up", flush=True)
    live.warm_up()  # compiles and loads: the first frame then takes no longer than others
    drivers = [camera_driver, imu_driver] if live.motion == "imu" else [camera_driver]
    threads = [threading.Thread(target=work, args=(live,)) for work in (controller, *drivers)]
    start = time.monotonic()
    for thread in threads:
        thread.start()
    for thread in threads[1:]:
        thread.join()
threads[0].join()  # leaving the block has processed what was waiting
print(live.figures)
for line in live.warnings:
    print("warning:", line)
