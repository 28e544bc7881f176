"""Export of keyframes and points in nerfstudio's format."""

from __future__ import annotations

import json

import numpy as np

from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.offline.colmap import HALF_PX
from vio.offline.colmap.model import ModelImages


def nerfstudio_transforms(camera: StereoCamera, T_world_cam0: FloatArray, names: ModelImages) -> str:
    """Return the text of nerfstudio's `transforms.json`; the point cloud is `points.ply` in the same folder.

    Poses are camera to world with x right, y up, z back (OpenGL); the world frame is that of the run, metric.
    """
    T_cam0_cam1 = np.eye(4)
    T_cam0_cam1[0, 3] = camera.baseline_m
    to_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": name, "transform_matrix": (T @ to_opengl).tolist()}
        for k, T_world in enumerate(T_world_cam0)
        for name, T in ((names.left[k], T_world), (names.right[k], T_world @ T_cam0_cam1))
    ]
    document = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fu,
        "fl_y": camera.fv,
        "cx": camera.cu + HALF_PX,
        "cy": camera.cv + HALF_PX,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "ply_file_path": "points.ply",
        "frames": frames,
    }
    return json.dumps(document, indent=1) + "\n"
