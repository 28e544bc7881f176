"""The left camera's motion from its stereo tracks alone, frame to frame: the reference for every
motion sensor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.calibration.findings import NotObservable
from vio.cameras.projection import CameraArgs, camera_args, turn_to
from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray, se3_exp, se3_log
from vio.geometry.stereo import StereoCamera, triangulate
from vio.numerics.compiled import compiled, move_by_twist, solve_positive
from vio.numerics.kinds import Tolerance
from vio.records import S_PER_NS, BoolArray, FeatureTracks, IntArray


class _MotionRules(NamedTuple):
    """When tracks determine the camera's motion between two frames."""

    min_links: int = 8  # tracks needed between two frames
    min_disparity_px: float = 2.0
    min_twists: int = 40  # frame intervals for a calibration
    max_gap_s: float = 0.25


_MOTION = _MotionRules()
# robust width per iteration, decreasing to exclude outliers
_WIDTHS_PX = (30.0, 15.0, 8.0, 4.0, 2.0, 2.0)
_MIN_DEPTH_M = 0.5
# relative size of a normal matrix's smallest eigenvalue below which a motion is not determined
_DEGENERATE: Tolerance[float] = 1e-9


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """The left camera's motion over those intervals between successive frames whose tracks
    determine it.
    """

    times_ns: IntArray  # (F,) of all frames
    frames: IntArray  # (K,) earlier frame of each interval, increasing
    # (K, 6) [v; omega] of cam0 in cam0, m/s and rad/s: p_next = exp(-dt twist^) p
    twists: FloatArray


def stereo_twists(
    camera: StereoCamera, tracks: FeatureTracks, times_ns: IntArray, guess: FloatArray
) -> CameraMotion:
    """Estimate the camera's twist from each frame to the next by robust Gauss-Newton on the stereo
    reprojection.

    Args:
        camera: rectified pair.
        tracks: features; stale rows are left out.
        times_ns: (F,) frame times.
        guess: (F - 1, 6) starting twists, cam0 frame, m/s and rad/s.
    """
    earlier, later = _links(tracks)
    p, valid = triangulate(camera, tracks.z[earlier], min_disparity_px=_MOTION.min_disparity_px)
    p = p[valid]
    earlier = earlier[valid]
    later = later[valid]
    count = np.bincount(tracks.frames[earlier], minlength=len(times_ns))[tracks.frames[earlier]]
    enough = count >= _MOTION.min_links
    p = p[enough]
    later = later[enough]
    of = tracks.frames[earlier][enough]
    frames, begins = np.unique(of, return_index=True)
    if not len(frames):
        return CameraMotion(times_ns, frames.astype(np.int64), np.zeros((0, 6)))
    dt = (np.diff(times_ns) * S_PER_NS)[frames]
    T_next_prev = se3_exp(-dt[:, None] * guess[frames])
    determined = np.empty(len(frames), dtype=np.bool_)
    _fit_motions(
        camera_args(camera), p, tracks.z[later], np.append(begins, len(p)), T_next_prev, determined
    )
    twists = -se3_log(T_next_prev) / dt[:, None]
    return CameraMotion(times_ns, frames[determined].astype(np.int64), twists[determined])


@compiled
def _fit_motions(
    camera: CameraArgs,
    p: FloatArray,
    z: FloatArray,
    begins: IntArray,
    T: FloatArray,
    determined: BoolArray,
) -> None:
    """Move motions (K, 4, 4) so that points (L, 3) come to pixels (L, 4), and write which are
    determined (K,).

    Motion k is that of the points from `begins[k]` (K + 1,) on.
    """
    normal = np.empty((6, 6))
    shifted = np.empty((6, 6))
    xi = np.empty(6)
    none = np.empty(6)
    for k in range(len(T)):
        determined[k] = True
        for width in _WIDTHS_PX:
            for i in range(6):
                xi[i] = 0.0
                for j in range(6):
                    normal[i, j] = 0.0
            for m in range(begins[k], begins[k + 1]):
                _add_point(camera, p[m], z[m], width * width, T[k], normal, xi)
            for i in range(6):
                none[i] = 0.0
            _shift(normal, shifted)
            solve_positive(shifted, none)  # not a number where it is not positive
            if none[0] != 0.0:
                determined[k] = False
                break
            solve_positive(normal, xi)
            move_by_twist(xi, T[k])


@compiled
def _shift(normal: FloatArray, out: FloatArray) -> None:
    """Write the lower triangle of normal equations (6, 6) less the share of their trace at which
    they are degenerate.
    """
    trace = 0.0
    for i in range(6):
        trace += normal[i, i]
    for i in range(6):
        for j in range(i + 1):
            out[i, j] = normal[i, j] - (_DEGENERATE * trace if i == j else 0.0)


@compiled
def _add_point(
    camera: CameraArgs,
    p: FloatArray,
    z: FloatArray,
    width2: float,
    T: FloatArray,
    normal: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add what a point's pixels (4,) say of a motion (4, 4) to normal equations (6, 6) and (6,),
    if it is ahead.
    """
    fu, fv, cu, cv, baseline, _ = camera
    q = np.empty(3)
    row = np.empty(6)
    D = np.empty(3)
    for i in range(3):
        q[i] = T[i, 0] * p[0] + T[i, 1] * p[1] + T[i, 2] * p[2] + T[i, 3]
    azimuth, s, c, y, depth = turn_to(camera, q[1], q[2])
    if not depth > _MIN_DEPTH_M:
        return
    u = fu * q[0] / depth
    v = fv * y / depth
    r0 = z[0] - u - cu
    r1 = z[1] - v - fv * azimuth - cv
    r3 = z[3] - v - fv * azimuth - cv
    r2 = z[2] - (u - fu * baseline / depth) - cu
    weight = 1.0 / (1.0 + (r0 * r0 + r1 * r1 + r2 * r2 + r3 * r3) / width2) ** 2
    residuals = (r0, r1, r2, r3)
    for a in range(4):
        r = residuals[a]
        if a % 2 == 0:
            across = u if a == 0 else u - fu * baseline / depth
            D[0] = fu / depth
            D[1] = -across * s / depth
            D[2] = -across * c / depth
        else:
            D[0] = 0.0
            D[1] = (fv * c - v * s) / depth
            D[2] = (-fv * s - v * c) / depth
        row[0] = D[0]
        row[1] = D[1]
        row[2] = D[2]
        row[3] = q[1] * D[2] - q[2] * D[1]
        row[4] = q[2] * D[0] - q[0] * D[2]
        row[5] = q[0] * D[1] - q[1] * D[0]
        for i in range(6):
            gradient[i] += weight * row[i] * r
            for j in range(i + 1):
                normal[i, j] += weight * row[i] * row[j]


def _links(tracks: FeatureTracks) -> tuple[IntArray, IntArray]:
    """Return rows (L,) and (L,) of the same id in successive frames, not stale and with a right
    match, by frame.
    """
    frames = tracks.frames
    usable = tracks.has_right & ~tracks.stale
    order = np.lexsort((frames, tracks.ids))
    a = order[:-1]
    b = order[1:]
    same_track = tracks.ids[a] == tracks.ids[b]
    next_frame = frames[a] + 1 == frames[b]
    linked = same_track & next_frame & usable[a] & usable[b]
    a = a[linked]
    b = b[linked]
    by_frame = np.argsort(a, kind="stable")
    return a[by_frame], b[by_frame]


def camera_motion(
    camera: StereoCamera, tracks: FeatureTracks, times_ns: IntArray
) -> CameraMotion | NotObservable:
    """Estimate the camera's motion for a calibration; not observable if too few short intervals
    have one.

    Args:
        camera: rectified pair.
        tracks: stereo features.
        times_ns: (F,) frame times.
    """
    found = stereo_twists(camera, tracks, times_ns, np.zeros((len(times_ns) - 1, 6)))
    dt = np.diff(times_ns)[found.frames] * S_PER_NS
    brief = dt < _MOTION.max_gap_s
    found = CameraMotion(times_ns, found.frames[brief], found.twists[brief])
    if len(found.frames) < _MOTION.min_twists:
        if len(times_ns) > 1:
            gap = float(np.median(np.diff(times_ns))) * S_PER_NS
        else:
            gap = float("inf")
        return NotObservable(
            "IMU-camera calibration",
            f"only {len(found.frames)} frame intervals determine the camera's motion "
            f"({_MOTION.min_twists} needed; frames "
            f"are {gap:.3g} s apart); too few images, too far apart, or too little texture",
        )
    return found
