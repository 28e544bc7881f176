"""The map behind a trajectory: keyframes, tracks across them, points from many views, poses from points.

Everything stands in the rectified left camera: poses are `T_world_cam0`, pixels `z = [ul vl ur vr]`. What a bundle
adjuster or an exporter needs is prepared here, with numpy alone.
"""
