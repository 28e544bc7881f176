"""Monitoring of a run: plausibility of images, IMU data and estimate.

It reports, and changes one thing: a frame whose images repeat an earlier exposure is dropped before
the front end, and a depth image that does so is left out of its frame. It also compares the
camera's rotations with the gyro's for the filter, which may then estimate the focal length, and
says once it is certain that the IMU is wrong, which `vio.live.imu_trial` acts on. Nothing else
depends on it.

This package does not depend on readers, front ends or filters.
"""
