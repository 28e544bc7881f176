"""The left camera's motion from its stereo tracks alone, frame to frame: the reference for every motion sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.calibration.findings import NotObservable
from vio.geometry.lie import FloatArray, se3_exp, se3_log, so3_hat
from vio.geometry.stereo import StereoCamera, depth_of, project, triangulate, z_D_p_cam
from vio.records import FeatureTracks, IntArray

_MIN_LINKS = 8  # tracks needed between two frames
_MIN_DISPARITY_PX = 2.0
_WIDTHS_PX = (30.0, 15.0, 8.0, 4.0, 2.0, 2.0)  # robust width per iteration, decreasing to exclude outliers
_MIN_DEPTH_M = 0.5
_DEGENERATE = 1e-9  # relative size of a normal matrix's smallest eigenvalue below which a motion is not determined
_LEAST_TWISTS = 40  # frame intervals for a calibration
_LARGEST_GAP_S = 0.25
_NS = 1e-9


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """The left camera's motion over those intervals between successive frames whose tracks determine it."""

    times_ns: IntArray  # (F,) of all frames
    frames: IntArray  # (K,) earlier frame of each interval, increasing
    twists: FloatArray  # (K, 6) [v; omega] of cam0 in cam0, m/s and rad/s: p_next = exp(-dt twist^) p


def stereo_twists(camera: StereoCamera, tracks: FeatureTracks, times_ns: IntArray, guess: FloatArray) -> CameraMotion:
    """Estimate the camera's twist from each frame to the next by robust Gauss-Newton on the stereo reprojection.

    Args:
        camera: rectified pair.
        tracks: features; stale rows are left out.
        times_ns: (F,) frame times.
        guess: (F - 1, 6) starting twists, cam0 frame, m/s and rad/s.
    """
    earlier, later = _links(tracks)
    p, valid = triangulate(camera, tracks.z[earlier], min_disparity_px=_MIN_DISPARITY_PX)
    p, earlier, later = p[valid], earlier[valid], later[valid]
    count = np.bincount(tracks.frames[earlier], minlength=len(times_ns))[tracks.frames[earlier]]
    enough = count >= _MIN_LINKS
    p, later, of = p[enough], later[enough], tracks.frames[earlier][enough]
    frames, begins, group = np.unique(of, return_index=True, return_inverse=True)
    if not len(frames):
        return CameraMotion(times_ns, frames.astype(np.int64), np.zeros((0, 6)))
    dt = (np.diff(times_ns) * _NS)[frames]
    T_next_prev = se3_exp(-dt[:, None] * guess[frames])
    determined = np.ones(len(frames), dtype=np.bool_)
    for width in _WIDTHS_PX:
        T = T_next_prev[group]
        q = np.einsum("nij,nj->ni", T[:, :3, :3], p) + T[:, :3, 3]
        ahead = depth_of(camera, q) > _MIN_DEPTH_M
        q = np.where(ahead[:, None], q, [0.0, 0.0, 1.0])
        r = tracks.z[later] - project(camera, q)
        weight = ahead / (1 + np.sum(r**2, axis=1) / width**2) ** 2
        z_D_p = z_D_p_cam(camera, q)
        z_D_xi = np.concatenate([z_D_p, -z_D_p @ so3_hat(q)], axis=2)
        weighted = z_D_xi * weight[:, None, None]
        normal = np.add.reduceat(np.swapaxes(weighted, 1, 2) @ z_D_xi, begins)
        gradient = np.add.reduceat(np.einsum("nij,ni->nj", weighted, r), begins)
        spread = np.linalg.eigvalsh(normal)
        determined &= spread[:, 0] > _DEGENERATE * spread[:, -1]
        normal[~determined] = np.eye(6)
        gradient[~determined] = 0
        T_next_prev = se3_exp(np.linalg.solve(normal, gradient[..., None])[..., 0]) @ T_next_prev
    twists = -se3_log(T_next_prev) / dt[:, None]
    return CameraMotion(times_ns, frames[determined].astype(np.int64), twists[determined])


def _links(tracks: FeatureTracks) -> tuple[IntArray, IntArray]:
    """Return rows (L,) and (L,) of the same id in successive frames, not stale and with a right match, by frame."""
    frames, usable = tracks.frames, tracks.has_right & ~tracks.stale
    order = np.lexsort((frames, tracks.ids))
    a, b = order[:-1], order[1:]
    linked = (tracks.ids[a] == tracks.ids[b]) & (frames[a] + 1 == frames[b]) & usable[a] & usable[b]
    a, b = a[linked], b[linked]
    by_frame = np.argsort(a, kind="stable")
    return a[by_frame], b[by_frame]


def camera_motion(camera: StereoCamera, tracks: FeatureTracks, times_ns: IntArray) -> CameraMotion | NotObservable:
    """Estimate the camera's motion for a calibration; not observable if too few short intervals have one.

    Args:
        camera: rectified pair.
        tracks: stereo features.
        times_ns: (F,) frame times.
    """
    found = stereo_twists(camera, tracks, times_ns, np.zeros((len(times_ns) - 1, 6)))
    dt = np.diff(times_ns)[found.frames] * _NS
    brief = dt < _LARGEST_GAP_S
    found = CameraMotion(times_ns, found.frames[brief], found.twists[brief])
    if len(found.frames) < _LEAST_TWISTS:
        gap = float(np.median(np.diff(times_ns))) * _NS if len(times_ns) > 1 else float("inf")
        return NotObservable(
            "IMU-camera calibration",
            f"only {len(found.frames)} frame intervals determine the camera's motion ({_LEAST_TWISTS} needed; frames "
            f"are {gap:.3g} s apart); too few images, too far apart, or too little texture",
        )
    return found
