"""The motion since the last frame by its stereo points alone, for where the prediction of it is so
far off that features lie behind the camera: no Gauss-Newton step comes back from there.

Images alone go on as fast as before through a gap; a vehicle that has stopped meanwhile is then
predicted tens of metres ahead. What is found here is where the fit begins, nothing more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.filters.track_records import Views
from vio.filters.window import Window
from vio.filters.window_fit import WindowFit
from vio.filters.window_tracks import LinearTracks
from vio.geometry.lie import (
    FloatArray,
    circledot,
    se3_exp,
    se3_inverse,
    se3_log,
    so3_exp,
    so3_left_jacobian_inverse,
    transform_points,
)
from vio.geometry.stereo import StereoCamera, depth_of, project, triangulate, z_D_p_cam
from vio.records import IntArray


class _StepRules(NamedTuple):
    """When two frames show a motion."""

    min_links: int = 12  # features that both frames show with a depth
    min_disparity_px: float = 2.0
    near_px: float = 4.0  # features that a motion explains are off by less
    min_share: float = 0.5  # of the features, that it must explain


_STEP = _StepRules()


class _LostRules(NamedTuple):
    """Where a fit does not begin at the predicted pose."""

    min_usable_share: float = 0.5  # of the tracks and landmarks, that have a usable point there
    max_start_px: float = 15.0  # by which they are off


_LOST = _LostRules()
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
        damped = A + 1e-9 * np.trace(A) * np.eye(6)
        T = se3_exp(np.linalg.solve(damped, b)) @ T
    if explained_share(camera, T, p_prev, z) >= _STEP.min_share:
        return T
    return None


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


def is_lost(
    fit: WindowFit, window: Window, tracks: LinearTracks, given: int, pixels: Views
) -> bool:
    """Whether the predicted pose is too far off for a fit to begin there: of the tracks that
    were given, fewer than half could be linearised, or they or the landmarks are far off.
    """
    innovation = tracks.newest_innovation()
    lost = len(tracks.rows) < _LOST.min_usable_share * given
    if lost or (innovation is not None and innovation > _LOST.max_start_px):
        return True
    if len(pixels.z) <= given or len(window.clones) < 2:
        return False
    T = window.T_cam0_world(-1)[0]
    share = explained_share(
        fit.camera,
        T,
        window.landmarks,
        fit.corrected(window, pixels).z,
        _LOST.max_start_px,
    )
    return share < _LOST.min_usable_share


def begin_by_images(fit: WindowFit, window: Window, rows: IntArray, pixels: Views) -> None:
    """Move the newest pose to where the images alone have it; the prior stays where it is, and
    so do points.
    """
    clones = len(window.clones)
    if clones < 2:
        return
    T = window.T_cam0_world(clones - 2)
    camera = fit.camera
    p, z = linked_points(camera, fit.views(window, rows))
    p = np.concatenate([p, transform_points(T[0], window.landmarks)])
    z = np.concatenate([z, fit.corrected(window, pixels).z])
    step = step_by_images(camera, p, z)
    if step is None:
        return
    xi = se3_log(se3_inverse(step @ T[0]) @ T[1])  # of the body, as of the camera: world's side
    state = window.state
    error = np.zeros(state.size)
    error[:6] = xi
    error[state.clone(-1)] = xi
    landmarks = window.landmarks
    kept = (landmarks - landmarks @ so3_exp(xi[3:]).T) @ so3_left_jacobian_inverse(xi[3:]).T
    error[state.landmarks] = kept.reshape(-1)
    window.relinearise(error)
