"""The motion since the last frame by its stereo points alone, for where the prediction of it is so
far off that features lie behind the camera: no Gauss-Newton step comes back from there.

Images alone go on as fast as before through a gap; a vehicle that has stopped meanwhile is then
predicted tens of metres ahead. What is found here is where the fit begins, nothing more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.filters.track_records import Views
from vio.geometry.lie import FloatArray, circledot, se3_exp, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, project, triangulate, z_D_p_cam


class _StepRules(NamedTuple):
    """When two frames show a motion."""

    min_links: int = 12  # features that both frames show with a depth
    min_disparity_px: float = 2.0
    near_px: float = 4.0  # features that a motion explains are off by less
    min_share: float = 0.5  # of the features, that it must explain


_STEP = _StepRules()
_WIDTHS_PX = (60.0, 30.0, 15.0, 8.0, 4.0, 4.0)  # of the robust fit, one a step


def linked_points(camera: StereoCamera, views: Views) -> tuple[FloatArray, FloatArray]:
    """Return points (K, 3), previous camera frame, and pixels (K, 4) of what both of the last two
    frames show with a depth.

    Args:
        camera: the rectified pair.
        views: of tracks (F, N, 4), the newest frame last; without the rectification error.
    """
    both = np.all(views.weight[:, -2:, :3] > 0, axis=(1, 2))
    p, known = triangulate(camera, views.z[both, -2], min_disparity_px=_STEP.min_disparity_px)
    return p[known], views.z[both, -1][known]


def step_by_images(camera: StereoCamera, p_prev: FloatArray, z: FloatArray) -> FloatArray | None:
    """Return the motion (4, 4) `T_curr_prev` of the left camera between two frames.

    None: too few features are given, or no motion explains half of them.

    Args:
        camera: the rectified pair.
        p_prev: (K, 3) points in the previous camera's frame.
        z: (K, 4) their pixels now, without the rectification error; the right row is not used.
    """
    T = np.eye(4)
    for width in _WIDTHS_PX:
        moved = transform_points(T, p_prev)
        ahead = depth_of(camera, moved) > 0.0
        if int(ahead.sum()) < _STEP.min_links:
            return None
        r = (z[ahead] - project(camera, moved[ahead]))[:, :3]
        J = z_D_p_cam(camera, moved[ahead])[:, :3] @ circledot(moved[ahead])[:, :3]
        weight = 1.0 / (1.0 + np.sum(r**2, axis=1) / width**2)
        A = np.einsum("f,fki,fkj->ij", weight, J, J)
        b = np.einsum("f,fki,fk->i", weight, J, r)
        T = se3_exp(np.linalg.solve(A + 1e-9 * np.trace(A) * np.eye(6), b)) @ T
    return T if explained_share(camera, T, p_prev, z) >= _STEP.min_share else None


def explained_share(
    camera: StereoCamera,
    T_curr_prev: FloatArray,
    p_prev: FloatArray,
    z: FloatArray,
    near_px: float = _STEP.near_px,
) -> float:
    """Return the share of points (K, 3) that a motion (4, 4) brings within some pixels of theirs
    (K, 4).
    """
    moved = transform_points(T_curr_prev, p_prev)
    ahead = depth_of(camera, moved) > 0.0
    off = np.linalg.norm((z[ahead] - project(camera, moved[ahead]))[:, :3], axis=1)
    return float(np.sum(off < near_px)) / max(len(p_prev), 1)
