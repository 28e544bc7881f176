"""Calibration from a recording: stereo extrinsics, IMU-camera rotation, lever arm, time offset.

The package works on rays, tracks and motion samples. It depends on numpy and scipy only, not on
readers, so that readers may use it. Standard deviations come from a jackknife over blocks of the
recording, so that they include correlated errors. Values that the motion or the scene leaves
unobservable are not estimated.
"""
