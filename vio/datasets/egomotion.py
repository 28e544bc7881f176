"""Camera motion from stereo tracks alone, frame to frame: the yardstick for a file's extrinsics and velocities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.datasets.tracks import FeatureTracks
from vio.geometry.lie import FloatArray, se3_exp, se3_log, so3_hat
from vio.geometry.stereo import StereoCamera, project, triangulate, z_D_p_cam
from vio.records import IntArray

_MIN_LINKS = 8  # tracks needed between two frames
_MIN_DISPARITY_PX = 2.0
_WIDTHS_PX = (30.0, 15.0, 8.0, 4.0, 2.0, 2.0)  # robust width per iteration, shrinking past the outliers
_MIN_DEPTH_M = 0.5
_DEGENERATE = 1e-9  # relative size of a normal matrix's smallest eigenvalue below which a motion is not determined
_MIN_INTERVALS = 40  # frame intervals needed to judge a lever arm
_BLOCKS = 12  # of the jackknife
_LEAST_SIGMA = 0.1  # a jackknife over few blocks is not believed below this
_LOG_ODDS = 10.0  # log-likelihood ratio that decides between two lever arms
_HUBER = 2.0  # standard deviations
_REWEIGHTINGS = 4
_RIDGE = 1e-9  # keeps the fit solvable where a recording never accelerates or never turns


@dataclass(frozen=True, slots=True)
class StereoTwists:
    """Camera twists between successive frames, where the tracks determine them."""

    frames: IntArray  # (K,) number of the earlier frame
    twists: FloatArray  # (K, 6) [v; omega] of cam0 in cam0, m/s and rad/s: p_next = exp(-dt twist^) p


def stereo_twists(camera: StereoCamera, tracks: FeatureTracks, times_ns: IntArray, guess: FloatArray) -> StereoTwists:
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
        return StereoTwists(frames.astype(np.int64), np.zeros((0, 6)))
    dt = (np.diff(times_ns) * 1e-9)[frames]
    T_next_prev = se3_exp(-dt[:, None] * guess[frames])
    determined = np.ones(len(frames), dtype=np.bool_)
    for width in _WIDTHS_PX:
        T = T_next_prev[group]
        q = np.einsum("nij,nj->ni", T[:, :3, :3], p) + T[:, :3, 3]
        ahead = q[:, 2] > _MIN_DEPTH_M
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
    return StereoTwists(frames[determined].astype(np.int64), twists[determined])


def _links(tracks: FeatureTracks) -> tuple[IntArray, IntArray]:
    """Rows (L,) and (L,) of the same id in successive frames, both fresh and with a right match, ordered by frame."""
    frames, usable = tracks.frames, tracks.has_right & ~tracks.stale
    order = np.lexsort((frames, tracks.ids))
    a, b = order[:-1], order[1:]
    linked = (tracks.ids[a] == tracks.ids[b]) & (frames[a] + 1 == frames[b]) & usable[a] & usable[b]
    a, b = a[linked], b[linked]
    by_frame = np.argsort(a, kind="stable")
    return a[by_frame], b[by_frame]


@dataclass(frozen=True, slots=True)
class LeverVerdict:
    """Which of two camera positions in the IMU frame agrees with velocities and features."""

    better: int | None  # 0 or 1; None: the motion does not tell them apart
    place: float  # where the data put the camera on the line between the two: -1 at the first, +1 at the second
    place_sigma: float  # standard error of `place`; infinite where nothing could be measured
    intervals: int  # frame intervals used


def judge_levers(
    camera: StereoCamera,
    tracks: FeatureTracks,
    times_ns: IntArray,
    velocities: FloatArray,
    R_cam0_imu: FloatArray,
    levers: tuple[FloatArray, FloatArray],
) -> LeverVerdict:
    """Decide between two positions of cam0 in the IMU frame by the rigid-body law `v_cam = v_imu + omega x lever`.

    The camera's velocity and rotation rate come from the stereo tracks, v_imu from the file (its noise averages out).
    What else can make the two velocities differ is fitted beside the lever arm, for each axis: a constant, a part in
    proportion to speed (scale, misalignment), to acceleration (clock offset), and to yaw rate times squared speed
    (the side slip of tyres, which else passes for half a metre of lever arm). The standard error is a jackknife over
    blocks of the recording, so that it covers errors that last.

    Args:
        camera: rectified pair.
        tracks: features.
        times_ns: (F,) frame times.
        velocities: (F, 6) [v; omega] of the body, imu frame, m/s and rad/s.
        R_cam0_imu: (3, 3).
        levers: the two candidates, (3,) metres in the imu frame.
    """
    middle = (velocities[:-1] + velocities[1:]) / 2
    turned = np.concatenate([middle[:, :3] @ R_cam0_imu.T, middle[:, 3:] @ R_cam0_imu.T], axis=1)
    seen = stereo_twists(camera, tracks, times_ns, turned)
    count = len(seen.frames)
    if count < _MIN_INTERVALS:
        return LeverVerdict(None, 0.0, float("inf"), count)
    v_cam, omega = seen.twists[:, :3] @ R_cam0_imu, seen.twists[:, 3:] @ R_cam0_imu
    centre, half = (levers[1] + levers[0]) / 2, (levers[1] - levers[0]) / 2
    y = v_cam - middle[seen.frames, :3] - np.cross(omega, centre)
    speed = np.linalg.norm(v_cam, axis=1)
    yaw_rate = omega[:, np.argmax(omega.std(axis=0))]
    nuisance = np.stack([np.ones(count), speed, np.gradient(speed), yaw_rate * speed**2], axis=1)
    signal = np.cross(omega, half)
    every = np.arange(count)
    place = _fit_place(y, signal, nuisance)
    left_out = [np.setdiff1d(every, block) for block in np.array_split(every, _BLOCKS)]
    again = np.array([_fit_place(y[keep], signal[keep], nuisance[keep]) for keep in left_out])
    sigma = max(float(np.sqrt((_BLOCKS - 1) * np.mean((again - again.mean()) ** 2))), _LEAST_SIGMA)
    better = int(place > 0) if 2 * abs(place) / sigma**2 > _LOG_ODDS else None
    return LeverVerdict(better, place, sigma, count)


def _fit_place(y: FloatArray, signal: FloatArray, nuisance: FloatArray) -> float:
    """Fit `y = place * signal + nuisance c` (N, 3) robustly, c apart for each axis; the axes share `place`."""
    top = bottom = 0.0
    for axis in range(3):
        X = np.concatenate([signal[:, axis : axis + 1], nuisance], axis=1)
        scale = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        weight, sigma, x = np.ones(len(X)), 1.0, np.zeros(X.shape[1])
        normal = np.eye(X.shape[1])
        for _ in range(_REWEIGHTINGS):
            weighted = X / scale * weight[:, None]
            normal = weighted.T @ (X / scale) + _RIDGE * np.eye(X.shape[1])
            x = np.linalg.solve(normal, weighted.T @ y[:, axis]) / scale
            r = y[:, axis] - X @ x
            sigma = max(float(1.4826 * np.median(np.abs(r))), 1e-9)
            weight = np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(r), 1e-12))
        variance = float(np.linalg.inv(normal)[0, 0]) * (sigma / scale[0]) ** 2
        top += x[0] / variance
        bottom += 1 / variance
    return top / bottom
