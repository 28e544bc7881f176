"""The map behind a trajectory: keyframes, tracks across them, points from many views, poses from
points.

All poses are those of the rectified left camera, `T_world_cam0`; pixels are `z = [ul vl ur vr]`.
The package prepares the input of bundle adjustment and export, with numpy alone.
"""
