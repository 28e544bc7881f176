"""What a recording says about its own calibration: stereo extrinsics, IMU-camera rotation, lever arm, time offset.

Own geometry on rays, tracks and motion samples; numpy and scipy only, and no reader, so that readers may ask it.
Every estimate comes with standard deviations from a jackknife over blocks of the recording, so that they cover errors
that last, and is withheld where the motion or the scene leaves it open.
"""
