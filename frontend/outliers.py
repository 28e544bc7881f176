"""Outlier rejection for tracks: RANSAC on the camera motion between two frames.

Points triangulated in the previous frame are fitted to their pixels in the current one. Minimal
sets of three points are solved by Gauss-Newton from an expected motion, all sets at once; the best
motion is refined on its inliers.
Reference: Fischler & Bolles, Random sample consensus, CACM (1981); Torr & Zisserman, MLESAC, CVIU
(2000), for the truncated cost; Geiger et al., StereoScan, IV (2011), for Gauss-Newton on minimal
sets of stereo points.

Without depth, left pixels of two frames give a consensus on a rotation and a direction of
translation.
Reference: Nistér, An efficient solution to the five-point relative pose problem, PAMI (2004); Kneip
et al., Finding the exact rotation between two images independently of the translation, ECCV (2012),
for the case of pure rotation.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from vio.cameras.projection import CameraArgs, camera_args, moved_pixel, point_at, turn_to
from vio.dataclass import dataclass
from vio.frontend.columns import share_of
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp, so3_log, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, facing, left_rays, project
from vio.numerics.compiled import compiled, move_by_twist, solve_positive
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import median
from vio.records import BoolArray, IntArray

_MIN_DEPTH_M = 0.05
_LEAST_AHEAD_M = 1e-3  # of the nearest end of an epipolar line's part


class _RansacRules(NamedTuple):
    """When points agree on a motion."""

    samples: int = 96  # random minimal sets of RANSAC
    # inliers of the prior motion only, over the consensus', above which it replaces the consensus
    prior_min_support_share: float = 0.4
    min_points: int = 8  # with fewer points, a consensus may be chance
    min_share: float = 0.2  # smallest share of inliers of a consensus
    max_refine_steps: Tolerance[int] = 6
    # change of a motion, in radians and metres, below which it is not refined further
    converged_change: Tolerance[float] = 3e-6


_RANSAC = _RansacRules()


class _ConsensusRules(NamedTuple):
    """How the motion of the scene is found, and what contradicts it."""

    # share of inliers of the refined expected motion above which RANSAC is skipped
    sure_share: float = 0.7
    # of the consensus rotation from the prior, before a motion near the prior is tried
    prior_max_deviation_deg: float = 1.0
    prior_points: int = 64  # predicted pixels that are used
    prior_px: float = 2.0  # median distance from them below which a motion represents them
    # change of that motion, in radians and metres, below which it is not refined further
    prior_converged: Tolerance[float] = 1e-4
    max_sample_steps: Tolerance[int] = 5
    damping: Tolerance[float] = 1e-4
    # two views constrain a track in one direction only, so most tracks must be inliers
    min_bearing_share: float = 0.5
    # share of inliers of a predicted rotation above which no other rotation is tried
    sure_bearing_share: float = 0.9
    # that no better motion is left, at which sampling ends; at two thirds as many are found
    five_point_confidence: Tolerance[float] = 0.999
    epsilon: Tolerance[float] = 1e-9  # added to denominators
    # of a cylinder's ray: beyond 60 degrees off the axis a pinhole's pixels are four times as
    # large
    min_forward: float = 0.5


_CONSENSUS = _ConsensusRules()
_STILL = np.eye(4)  # no motion


@dataclass(frozen=True, slots=True)
class RansacProblem:
    """Camera, threshold and random generator of a RANSAC run."""

    camera: StereoCamera
    limit_px: float  # inlier threshold on the reprojection error
    # source of the samples; the same state gives the same result to the bit
    rng: np.random.Generator


@dataclass(frozen=True, slots=True)
class Consensus:
    """The camera motion with most inliers."""

    T_curr_prev: FloatArray  # (4, 4) maps the previous cam0 frame into the current one
    inliers: BoolArray  # (N,)


def pixel_errors(
    camera: StereoCamera, T_curr_prev: FloatArray, p_prev: FloatArray, pixels: FloatArray
) -> FloatArray:
    """Distances (..., N) in pixels between points (N, 3) moved by motions (..., 4, 4) and pixels
    (N, 2).

    Points behind the camera have infinite distance.
    """
    T = np.ascontiguousarray(T_curr_prev)
    motions = T[None] if T.ndim == 2 else T.reshape(-1, 4, 4)
    points = np.ascontiguousarray(p_prev)
    seen = np.ascontiguousarray(pixels)
    out = np.empty((len(motions), len(points)))
    _distances(camera_args(camera), motions, points, seen, out)
    return out[0] if T.ndim == 2 else out.reshape(*T.shape[:-2], len(points))


@compiled
def _distances(
    camera: CameraArgs, T: FloatArray, points: FloatArray, pixels: FloatArray, out: FloatArray
) -> None:
    """Write the distances (H, N) of points (N, 3) moved by motions (H, 4, 4) from pixels (N, 2)."""
    for h in range(len(T)):
        motion = T[h]
        for n in range(len(points)):
            u, v, depth = moved_pixel(camera, motion, points[n, 0], points[n, 1], points[n, 2])
            du = u - pixels[n, 0]
            dv = v - pixels[n, 1]
            out[h, n] = np.sqrt(du * du + dv * dv) if depth > _MIN_DEPTH_M else np.inf


def _gauss_newton(
    camera: StereoCamera,
    T: FloatArray,
    p_prev: FloatArray,
    pixels: FloatArray,
    weight: FloatArray,
    *,
    steps: int,
    free: slice,
) -> FloatArray:
    """Refine motions (H, 4, 4), each on its own points (H, K, 3), pixels (H, K, 2) and weights (H,
    K).

    `free` selects the part of the twist `[rho; phi]` that is estimated: all of it, or the
    translation alone.
    """
    T = np.array(T, order="C")  # of one layout, so that one version is compiled
    points = np.ascontiguousarray(p_prev)
    seen = np.ascontiguousarray(pixels)
    w = np.ascontiguousarray(weight)
    _iterate(camera_args(camera), T, _Seen(points, seen, w), _Steps(np.inf, steps, free.stop, 0.0))
    return T


class _Seen(NamedTuple):
    """Points before each of H motions, and their pixels after it."""

    points: FloatArray  # (H, K, 3)
    pixels: FloatArray  # (H, K, 2)
    weight: FloatArray  # (H, K)


class _Steps(NamedTuple):
    """Gauss-Newton steps on motions."""

    scale_px: float  # of the weights of Geman and McClure, which multiply others; infinite: of none
    iterations: int  # at most
    free: int  # how many entries of the twist `[rho; phi]` are estimated, from its beginning
    converged: float  # a motion is done when no entry of it changes by this


class _Normal(NamedTuple):
    """Normal equations of a twist, of which the first F entries are estimated."""

    A: FloatArray  # (F, F), lower triangle
    xi: FloatArray  # (6,) their vector, then the step
    u_D_xi: FloatArray  # (6,) room for the Jacobian of a pixel's column
    v_D_xi: FloatArray  # (6,) and row


@compiled
def _pixel_D_twist(
    camera: CameraArgs,
    point: tuple[float, float, float],
    turn: tuple[float, float, float],
    u_D_xi: FloatArray,
    v_D_xi: FloatArray,
) -> None:
    """Write how the pixel of a point moves with the camera's twist (6,).

    The point is x / z, y / z and z in the camera turned to it; the turn is its azimuth, its sine
    and cosine.
    """
    fu = camera[0]
    fv = camera[1]
    a, b, z = point
    azimuth, s, c = turn
    # pixel_D_point circledot(point)
    u_D_xi[0] = fu / z
    u_D_xi[1] = 0.0
    u_D_xi[2] = -fu * a / z
    u_D_xi[3] = -fu * a * b
    u_D_xi[4] = fu * (1.0 + a * a)
    u_D_xi[5] = -fu * b
    v_D_xi[0] = 0.0
    v_D_xi[1] = fv / z
    v_D_xi[2] = -fv * b / z
    v_D_xi[3] = -fv * (1.0 + b * b)
    v_D_xi[4] = fv * a * b
    v_D_xi[5] = fv * a
    if azimuth != 0.0:
        for i in range(1, 5, 3):  # back from the turned camera
            u_D_xi[i], u_D_xi[i + 1] = (
                c * u_D_xi[i] + s * u_D_xi[i + 1],
                c * u_D_xi[i + 1] - s * u_D_xi[i],
            )
            v_D_xi[i], v_D_xi[i + 1] = (
                c * v_D_xi[i] + s * v_D_xi[i + 1],
                c * v_D_xi[i + 1] - s * v_D_xi[i],
            )


@compiled
def _move_to(T: FloatArray, moved: FloatArray) -> float:
    """Overwrite a motion (4, 4) by another one; return the largest change of an entry."""
    change = 0.0
    for i in range(4):
        for j in range(4):
            change = max(change, abs(moved[i, j] - T[i, j]))
            T[i, j] = moved[i, j]
    return change


@compiled
def _clear(normal: _Normal) -> None:
    """Write zeros into normal equations."""
    for i in range(6):
        normal.xi[i] = 0.0
    for i in range(len(normal.A)):
        for j in range(i + 1):
            normal.A[i, j] = 0.0


@compiled
def _add_points(
    camera: CameraArgs, T: FloatArray, seen: _Seen, h: int, scale_px: float, normal: _Normal
) -> None:
    """Add what the points of hypothesis h say of its motion (4, 4) to normal equations."""
    fu, fv, cu, cv, _, _ = camera
    points = seen.points
    pixels = seen.pixels
    A = normal.A
    xi = normal.xi
    u_D_xi = normal.u_D_xi
    v_D_xi = normal.v_D_xi
    for n in range(points.shape[1]):
        px = points[h, n, 0]
        py = points[h, n, 1]
        pz = points[h, n, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        azimuth, s, c, y, z = turn_to(camera, y, z)
        w2 = seen.weight[h, n] ** 2
        if not z > _MIN_DEPTH_M or w2 == 0.0:
            continue
        a = x / z
        b = y / z
        du = pixels[h, n, 0] - fu * a - cu
        dv = pixels[h, n, 1] - fv * b - cv - fv * azimuth
        u = fu * x / z + cu
        v = fv * y / z + fv * azimuth + cv
        # as `_distances`
        error = np.sqrt((u - pixels[h, n, 0]) ** 2 + (v - pixels[h, n, 1]) ** 2)
        if not error < 3.0 * scale_px:
            continue
        robust = 1.0 / (1.0 + (error / scale_px) ** 2)
        w2 *= robust * robust
        _pixel_D_twist(camera, (a, b, z), (azimuth, s, c), u_D_xi, v_D_xi)
        for i in range(len(A)):
            xi[i] += w2 * (u_D_xi[i] * du + v_D_xi[i] * dv)
            for j in range(i + 1):
                A[i, j] += w2 * (u_D_xi[i] * u_D_xi[j] + v_D_xi[i] * v_D_xi[j])


@compiled
def _solve(normal: _Normal) -> None:
    """Replace the vector of normal equations by their damped and limited step."""
    A = normal.A
    xi = normal.xi
    free = len(A)
    trace = 0.0
    for i in range(free):
        trace += A[i, i]
    for i in range(free):
        A[i, i] += _CONSENSUS.damping * trace / free + 1e-9
    solve_positive(A, xi)
    for i in range(free):
        xi[i] = min(max(xi[i], -5.0), 5.0)


@compiled
def _iterate(camera: CameraArgs, T: FloatArray, seen: _Seen, steps: _Steps) -> None:
    """Gauss-Newton on the first entries of the twists of motions (H, 4, 4), in place; see
    `_gauss_newton`.
    """
    free = steps.free
    normal = _Normal(np.empty((free, free)), np.empty(6), np.empty(6), np.empty(6))
    moved = np.empty((4, 4))
    for h in range(len(T)):
        for _ in range(steps.iterations):
            _clear(normal)
            _add_points(camera, T[h], seen, h, steps.scale_px, normal)
            _solve(normal)
            for i in range(4):
                for j in range(4):
                    moved[i, j] = T[h, i, j]
            move_by_twist(normal.xi, moved)
            if _move_to(T[h], moved) < steps.converged:
                break


def _refine(
    camera: StereoCamera,
    T: FloatArray,
    p_prev: FloatArray,
    pixels: FloatArray,
    scale_px: float,
    free: slice,
    converged: float = _RANSAC.converged_change,
) -> FloatArray:
    """Refine one motion (4, 4) on all points, with Geman-McClure weights."""
    T = np.array(T[None], order="C")
    points = np.ascontiguousarray(p_prev)
    seen = np.ascontiguousarray(pixels)
    equal = np.ones((1, len(p_prev)))
    _iterate(
        camera_args(camera),
        T,
        _Seen(points[None], seen[None], equal),
        _Steps(scale_px, _RANSAC.max_refine_steps, free.stop, converged),
    )
    return T[0]


def _ransac(
    problem: RansacProblem, p_prev: FloatArray, pixels: FloatArray, starts: FloatArray, free: slice
) -> tuple[FloatArray, BoolArray]:
    """Return the best motion (4, 4) over minimal sets and the starts (S, 4, 4) themselves, with
    its inliers (N,).
    """
    camera = problem.camera
    limit = problem.limit_px
    begin = starts[_best_start(camera, starts, p_prev, pixels, limit)]
    refined = _refine(camera, begin, p_prev, pixels, limit / 2, free)
    inliers = pixel_errors(camera, refined, p_prev, pixels) <= limit
    if share_of(inliers) >= _CONSENSUS.sure_share:
        return refined, inliers
    sets = problem.rng.integers(0, len(p_prev), size=(_RANSAC.samples, 3))
    T = np.broadcast_to(begin, (len(sets), 4, 4))
    T = _gauss_newton(
        camera,
        T,
        p_prev[sets],
        pixels[sets],
        np.ones(sets.shape),
        steps=_CONSENSUS.max_sample_steps,
        free=free,
    )
    T = np.concatenate([starts, refined[None], T])
    cost = np.minimum(pixel_errors(camera, T, p_prev, pixels), limit) ** 2
    best = _refine(camera, T[int(np.argmin(cost.sum(axis=1)))], p_prev, pixels, limit / 2, free)
    return best, pixel_errors(camera, best, p_prev, pixels) <= limit


def best_motion(
    problem: RansacProblem, p_prev: FloatArray, pixels: FloatArray, starts: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the motion (4, 4) with most inliers among points (N, 3) and pixels (N, 2), and their
    mask (N,).

    Unlike a consensus it may have few inliers; `starts` (S, 4, 4) are tried besides minimal sets.
    """
    return _ransac(problem, p_prev, pixels, starts, slice(0, 6))


def _best_start(
    camera: StereoCamera, starts: FloatArray, p_prev: FloatArray, pixels: FloatArray, limit: float
) -> int:
    """Return the index of the start with the smallest median error; errors far beyond the limit
    are clipped.
    """
    errors = np.minimum(pixel_errors(camera, starts, p_prev, pixels), 1e3 * limit)
    errors.sort(axis=1)
    count = errors.shape[1]
    return int(np.argmin(errors[:, (count - 1) // 2] + errors[:, count // 2]))  # twice the medians


@dataclass(frozen=True, slots=True)
class MotionPriors:
    """What is expected of the motion from the previous to the current cam0 frame."""

    R: FloatArray | None = None  # (3, 3); None: not known
    T: FloatArray | None = None  # (4, 4) `T_curr_prev`, likewise


def static_tracks(
    problem: RansacProblem,
    left: FloatArray,
    p_prev: FloatArray,
    has_depth: BoolArray,
    pixels: FloatArray,
    expected: FloatArray,
    priors: MotionPriors,
) -> tuple[BoolArray, Consensus | None]:
    """Find the tracks of static points: by the tracks with depth, else by two-view geometry of the
    left images.

    Args:
        problem: camera, thresholds and random generator.
        left: left pixels (N, 2) in the previous frame.
        p_prev: points (N, 3) triangulated there, metres, previous cam0 frame; arbitrary where
            `has_depth` is False.
        has_depth: mask (N,) of tracks with known depth.
        pixels: left pixels (N, 2) in the current frame.
        expected: motion (4, 4) `T_curr_prev` to start from.
        priors: of the motion.

    Returns:
        Mask (N,) of the tracks to keep, and the consensus motion of the tracks with depth (its
        inliers are a mask over these tracks), or None. With a motion, all tracks without depth are
        kept: the caller may check them against it.
    """
    motion = rigid_consensus(
        problem, p_prev[has_depth], pixels[has_depth], expected, priors.R, priors.T
    )
    keep = np.ones(len(left), dtype=np.bool_)
    if motion is not None:
        keep[has_depth] = motion.inliers
    elif (
        agree := bearing_consensus(problem, left, pixels, expected[:3, :3], priors.R)
    ) is not None:
        keep = agree
    return keep, motion


def rigid_consensus(
    problem: RansacProblem,
    p_prev: FloatArray,
    pixels: FloatArray,
    expected: FloatArray,
    R_prior: FloatArray | None,
    T_prior: FloatArray | None,
) -> Consensus | None:
    """Estimate the camera motion from static points.

    A large moving object can win the consensus. If the consensus rotation deviates from a prior
    rotation (`R_prior`), the best motion with the prior rotation replaces it; if the consensus
    deviates from a prior motion (`T_prior`), the motion refined from the prior does. Either needs
    enough inliers among the outliers of the consensus, relative to the number of its inliers.

    Args:
        problem: camera, thresholds and random generator.
        p_prev: points (N, 3) triangulated in the previous frame, metres, previous cam0 frame.
        pixels: left pixels (N, 2) of the same points in the current frame.
        expected: motion (4, 4) `T_curr_prev` to start from.
        R_prior: prior rotation (3, 3) from the previous to the current cam0 frame, or None.
        T_prior: prior motion (4, 4) `T_curr_prev`, or None.

    Returns:
        None with too few points or too few inliers.
    """
    if len(p_prev) < _RANSAC.min_points:
        return None
    starts = [expected, _STILL]
    if R_prior is not None:
        starts.append(se3_from_parts(R_prior, expected[:3, 3]))
    if T_prior is not None:
        starts.append(T_prior)
    T, inliers = _ransac(problem, p_prev, pixels, np.array(starts), slice(0, 6))
    # Only outliers of the consensus support another motion: a prior that agrees with the consensus
    # is not tried.
    count = int(inliers.sum())
    needed = max(_RANSAC.min_points, _RANSAC.prior_min_support_share * count)
    if len(inliers) - count >= needed:
        for T_near in _prior_candidates(problem, p_prev, pixels, T, expected, R_prior, T_prior):
            kept = pixel_errors(problem.camera, T_near, p_prev, pixels) <= problem.limit_px
            if (kept & ~inliers).sum() >= needed:
                T = _refine(
                    problem.camera,
                    T_near,
                    p_prev[kept],
                    pixels[kept],
                    problem.limit_px / 2,
                    slice(0, 6),
                )
                inliers = pixel_errors(problem.camera, T, p_prev, pixels) <= problem.limit_px
                count = int(inliers.sum())
                break
    if count < max(_RANSAC.min_points, _RANSAC.min_share * len(inliers)):
        return None
    return Consensus(T, inliers)


def _prior_candidates(
    problem: RansacProblem,
    p_prev: FloatArray,
    pixels: FloatArray,
    T: FloatArray,
    expected: FloatArray,
    R_prior: FloatArray | None,
    T_prior: FloatArray | None,
) -> list[FloatArray]:
    """Return motions (4, 4) near the priors that the consensus motion `T` (4, 4) deviates from."""
    near: list[FloatArray] = []
    if T_prior is not None and not _motions_agree(problem.camera, T, T_prior, p_prev):
        near.append(_refine(problem.camera, T_prior, p_prev, pixels, problem.limit_px, slice(0, 6)))
    if (
        R_prior is not None
        and _rotation_difference_deg(T, R_prior) > _CONSENSUS.prior_max_deviation_deg
    ):
        fixed = np.stack([se3_from_parts(R_prior, t) for t in (expected[:3, 3], np.zeros(3))])
        near.append(_ransac(problem, p_prev, pixels, fixed, slice(0, 3))[0])
    return near


def _motions_agree(
    camera: StereoCamera, T: FloatArray, T_other: FloatArray, p_prev: FloatArray
) -> bool:
    """Whether two motions (4, 4) project most points (N, 3) to nearly the same pixels."""
    moved = transform_points(T, p_prev)
    ahead = depth_of(camera, moved) > _MIN_DEPTH_M
    if not ahead.any():
        return False
    gap = pixel_errors(camera, T_other, p_prev[ahead], project(camera, moved[ahead])[:, :2])
    return bool(median(gap) <= _CONSENSUS.prior_px)


def _rotation_difference_deg(T: FloatArray, R: FloatArray) -> float:
    """Angle between the rotation of a motion (4, 4) and a predicted rotation (3, 3)."""
    turn_rad = np.linalg.norm(so3_log(T[:3, :3] @ R.T))
    return float(np.degrees(turn_rad))


def epipolar_distance(
    camera: StereoCamera,
    T_curr_prev: FloatArray,
    previous: FloatArray,
    current: FloatArray,
    near_m: float,
) -> FloatArray:
    """Distance (N,) in pixels from the part of the epipolar line between depth `near_m` and
    infinity.

    `previous` and `current` are left pixels (N, 2). Unlike the epipolar line, the segment stays
    defined when the camera only turns or stands still: it shrinks to a point.
    """
    out = np.empty(len(previous))
    T = np.ascontiguousarray(T_curr_prev)
    before = np.ascontiguousarray(previous)
    after = np.ascontiguousarray(current)
    _epipolar_distances(camera_args(camera), T, before, after, near_m, out)
    return out


@compiled
def _least_depth_before(
    T: FloatArray, ray: tuple[float, float, float], turn: tuple[float, float], near_m: float
) -> float:
    """Depth of the nearest point on a ray of unit depth that a motion (4, 4) leaves ahead of the
    camera: `near_m`, or more where the camera passes that.

    The turn is sine and cosine of the angle of the camera in which it is to be ahead.
    """
    x, y, z = ray
    s, c = turn
    along = s * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z)
    along += c * (T[2, 0] * x + T[2, 1] * y + T[2, 2] * z)
    shift = s * T[1, 3] + c * T[2, 3]
    if along > 0.0 and near_m * along + shift < _LEAST_AHEAD_M:
        return (_LEAST_AHEAD_M - shift) / along
    return near_m


@compiled
def _epipolar_distances(
    camera: CameraArgs,
    T: FloatArray,
    before: FloatArray,
    after: FloatArray,
    near_m: float,
    out: FloatArray,
) -> None:
    """Write the distances (N,) of `epipolar_distance`."""
    fu, fv, cu, cv, _, cylinder = camera
    end = np.empty((2, 2))  # pixels of the point at infinity and of the nearest one
    for n in range(len(out)):
        x, y, z = point_at(camera, before[n, 0], before[n, 1], 1.0)
        u = after[n, 0]
        v = after[n, 1]
        s = 0.0
        c = 1.0
        if cylinder:  # turned as by `vio.geometry.stereo.facing`
            s = np.sin((v - cv) / fv)
            c = np.cos((v - cv) / fv)
            v = cv
        nearest = _least_depth_before(T, (x, y, z), (s, c), near_m)
        for i in range(2):
            length, moved = (1.0, 0.0) if i == 0 else (nearest, 1.0)
            across = length * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z) + moved * T[0, 3]
            down = length * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z) + moved * T[1, 3]
            ahead = length * (T[2, 0] * x + T[2, 1] * y + T[2, 2] * z) + moved * T[2, 3]
            depth = max(s * down + c * ahead, _LEAST_AHEAD_M)
            end[i, 0] = fu * across / depth + cu
            end[i, 1] = fv * (c * down - s * ahead) / depth + cv
        off_u = u - end[0, 0]
        off_v = v - end[0, 1]
        along_u = end[1, 0] - end[0, 0]
        along_v = end[1, 1] - end[0, 1]
        position = (off_u * along_u + off_v * along_v) / max(
            along_u * along_u + along_v * along_v, 1e-12
        )
        position = min(max(position, 0.0), 1.0)
        out[n] = np.sqrt((off_u - position * along_u) ** 2 + (off_v - position * along_v) ** 2)


def predicted_motion(
    camera: StereoCamera, p_prev: FloatArray, pixels: FloatArray, expected: FloatArray
) -> FloatArray | None:
    """Estimate a start motion (4, 4) from some of the predicted pixels; return `expected` if it
    already fits them.

    None with too few points, or if no motion fits most of them.
    """
    few = slice(None, None, max(1, len(p_prev) // _CONSENSUS.prior_points))
    p = p_prev[few]
    z = pixels[few]
    if len(p) < _RANSAC.min_points:
        return None
    T = expected
    weight = np.ones((1, len(p)))
    for _ in range(_CONSENSUS.max_sample_steps):
        if median(pixel_errors(camera, T, p, z)) <= _CONSENSUS.prior_px:
            return T
        T = _gauss_newton(camera, T[None], p[None], z[None], weight, steps=1, free=slice(0, 6))[0]
    T = _refine(
        camera, T, p, z, _CONSENSUS.prior_px, slice(0, 6), converged=_CONSENSUS.prior_converged
    )
    if median(pixel_errors(camera, T, p, z)) <= _CONSENSUS.prior_px:
        return T
    return None


# --- two views, no depth
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _TwoViews:
    """The same features in two left images."""

    before: FloatArray  # (N, 3) rays of unit depth, previous cam0 frame
    after: FloatArray  # (N, 2) pixels, current
    rays: FloatArray  # (N, 3) rays of unit depth through them


def bearing_consensus(
    problem: RansacProblem,
    previous: FloatArray,
    current: FloatArray,
    expected_R: FloatArray,
    R_prior: FloatArray | None,
) -> BoolArray | None:
    """Find the tracks that are consistent with one camera motion at some depth.

    A rotation and a direction of translation constrain every feature to an epipolar ray: it starts
    at the pixel of infinite depth, given by the rotation alone, and extends towards nearer points.
    A feature with little parallax is near the start of its ray under any translation, so that
    standstill and pure rotation lose no track. With known rotation, two features give the
    direction; without, five give both.

    Args:
        problem: camera, thresholds and random generator.
        previous: left pixels (N, 2) in the previous frame.
        current: left pixels (N, 2) in the current frame.
        expected_R: rotation (3, 3) from the previous to the current cam0 frame to start from.
        R_prior: the same as a prior, or None; see `rigid_consensus`.

    Returns:
        Mask (N,) of the inliers; None with too few tracks, or if most are outliers.
    """
    if len(previous) < _RANSAC.min_points:
        return None
    camera = problem.camera
    seen = _TwoViews(left_rays(camera, previous), current, left_rays(camera, current))
    near_prior = None
    if R_prior is not None:
        near_prior = _bearing_inliers(problem, seen, _bearing_ransac(problem, seen, [R_prior]))
        if near_prior.mean() >= _CONSENSUS.sure_bearing_share:
            return near_prior
    rotations = [expected_R, _pure_rotation(problem, seen)]
    T = _bearing_ransac(problem, seen, rotations, _five_point(problem, previous, current))
    kept = _bearing_inliers(problem, seen, T)
    if (
        R_prior is not None
        and near_prior is not None
        and _rotation_difference_deg(T, R_prior) > _CONSENSUS.prior_max_deviation_deg
    ):
        # A wrong prior shares some inliers with the consensus: only outliers of the consensus
        # support the prior.
        supported = (near_prior & ~kept).sum() >= max(
            _RANSAC.min_points, _RANSAC.prior_min_support_share * kept.sum()
        )
        kept = near_prior if supported else kept
    return (
        kept
        if kept.sum() >= max(_RANSAC.min_points, _CONSENSUS.min_bearing_share * len(kept))
        else None
    )


def _ray_distance(
    camera: StereoCamera, seen: _TwoViews, R: FloatArray, t: FloatArray
) -> FloatArray:
    """Distances (..., N) in pixels from the epipolar rays of rotations (..., 3, 3) and directions
    (..., 3).

    A ray is the part of the epipolar line at positive depth; before its start, the distance to the
    start is used.
    """
    after, turned = facing(camera, seen.after, seen.before @ np.swapaxes(R, -1, -2))
    t = facing(camera, seen.after, t[..., None, :])[1]
    ahead = turned[..., 2] > _MIN_DEPTH_M
    depth = np.where(ahead, turned[..., 2], 1.0)
    x = turned[..., 0] / depth
    y = turned[..., 1] / depth
    off_u = after[:, 0] - camera.fu * x - camera.cu
    off_v = after[:, 1] - camera.fv * y - camera.cv
    way_u = camera.fu * (t[..., 0] - x * t[..., 2])
    way_v = camera.fv * (t[..., 1] - y * t[..., 2])
    along = np.maximum(off_u * way_u + off_v * way_v, 0.0) / (
        way_u**2 + way_v**2 + _CONSENSUS.epsilon
    )
    distance = np.hypot(off_u - along * way_u, off_v - along * way_v)
    return np.where(ahead, distance, np.inf)


def _bearing_inliers(problem: RansacProblem, seen: _TwoViews, T: FloatArray) -> BoolArray:
    """Mask (N,) of the inliers of a motion (4, 4)."""
    distance_px = _ray_distance(problem.camera, seen, T[:3, :3], T[:3, 3])
    return np.asarray(distance_px <= problem.limit_px)


def _cost(problem: RansacProblem, seen: _TwoViews, R: FloatArray, t: FloatArray) -> FloatArray:
    """Truncated squared distances, summed over the tracks (...)."""
    return np.asarray(
        (np.minimum(_ray_distance(problem.camera, seen, R, t), problem.limit_px) ** 2).sum(axis=-1)
    )


def _bearing_ransac(
    problem: RansacProblem,
    seen: _TwoViews,
    rotations: list[FloatArray],
    others: FloatArray | None = None,
) -> FloatArray:
    """Return the best rotation and direction of translation, as a motion (4, 4) with a unit
    translation.

    For each rotation, pairs of tracks give the direction; `others` (K, 4, 4) are further candidate
    motions.
    """
    models = [np.zeros((0, 4, 4)) if others is None else others]
    pairs = _pairs(len(seen.before), problem)
    for R in rotations:
        # Epipolar constraint on the direction of translation: t . (R f x g) = 0.
        normal = np.cross(seen.before @ R.T, seen.rays)
        t = np.cross(normal[pairs[:, 0]], normal[pairs[:, 1]])
        length = np.linalg.norm(t, axis=1, keepdims=True)
        # A degenerate pair gives no direction; use an arbitrary one.
        t = np.where(
            length > 0.0, t / np.maximum(length, np.finfo(np.float64).tiny), [0.0, 0.0, 1.0]
        )
        models += [
            se3_from_parts(np.broadcast_to(R, (len(t), 3, 3)), sign * t) for sign in (1.0, -1.0)
        ]
    T = np.concatenate(models)
    cost = _cost(problem, seen, T[:, :3, :3], T[:, :3, 3])
    best = T[int(np.argmin(cost))]
    for _ in range(_RANSAC.max_refine_steps):
        better = _bearing_step(problem, seen, best)
        if _cost(problem, seen, better[:3, :3], better[:3, 3]) >= _cost(
            problem, seen, best[:3, :3], best[:3, 3]
        ):
            break
        best = better
    return best


def _bearing_step(problem: RansacProblem, seen: _TwoViews, T: FloatArray) -> FloatArray:
    """One Gauss-Newton step of a motion (4, 4) with unit translation, on the distances from
    epipolar lines.
    """
    camera = problem.camera
    limit = problem.limit_px
    R = T[:3, :3]
    t = T[:3, 3]
    turned = seen.before @ R.T
    line = np.cross(t, turned)
    normal = facing(camera, seen.after, line)[1]
    length = np.hypot(normal[:, 0] / camera.fu, normal[:, 1] / camera.fv)
    scale = length + _CONSENSUS.epsilon
    distance = _ray_distance(camera, seen, R, t)
    weight = (
        np.where(
            distance < 1.5 * limit, 1.0 / (1.0 + (np.minimum(distance, 1e6) / limit * 2) ** 2), 0.0
        )
        / scale
    )
    residual = weight * np.einsum("ni,ni->n", seen.rays, line)
    plane = np.linalg.svd(t[None])[2][1:]  # two directions perpendicular to the translation
    r_D_turn = np.cross(turned, np.cross(seen.rays, t))
    r_D_t = np.cross(turned, seen.rays) @ plane.T
    J = weight[:, None] * np.concatenate([r_D_turn, r_D_t], axis=1)
    A = J.T @ J
    step = -np.linalg.solve(
        A + (_CONSENSUS.damping * np.trace(A) / 5 + _CONSENSUS.epsilon) * np.eye(5), J.T @ residual
    )
    moved = t + step[3:] @ plane
    return se3_from_parts(so3_exp(step[:3]) @ R, moved / np.linalg.norm(moved))


def _pure_rotation(problem: RansacProblem, seen: _TwoViews) -> FloatArray:
    """Estimate the pure rotation (3, 3) with most inliers: from pairs of tracks, then refined on
    its inliers.
    """
    f, g = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (seen.before, seen.rays))
    pairs = _pairs(len(f), problem)
    R = _triads(g, pairs) @ np.swapaxes(_triads(f, pairs), 1, 2)
    still = np.zeros(3)
    cost = _cost(problem, seen, R, np.broadcast_to(still, (len(R), 3)))
    R_best = R[int(np.argmin(cost))]
    near = _ray_distance(problem.camera, seen, R_best, still) <= problem.limit_px
    # Reference: Kabsch, A solution for the best rotation to relate two sets of vectors, Acta Cryst.
    # (1976).
    U, _, Vt = np.linalg.svd(g[near].T @ f[near])
    handedness = np.linalg.det(U @ Vt)
    return np.asarray(U @ np.diag([1.0, 1.0, handedness]) @ Vt)


def _pairs(count: int, problem: RansacProblem) -> IntArray:
    """Random pairs (H, 2) of different indices below `count`."""
    first = problem.rng.integers(0, count, size=_RANSAC.samples)
    return np.stack(
        [first, (first + problem.rng.integers(1, count, size=len(first))) % count], axis=1
    )


def _triads(rays: FloatArray, pairs: IntArray) -> FloatArray:
    """Right-handed orthonormal axes (H, 3, 3) in columns, spanned by pairs (H, 2) of unit rays
    (N, 3).
    """
    a = rays[pairs[:, 0]]
    b = rays[pairs[:, 1]]
    across = np.cross(a, b)
    across = across / (np.linalg.norm(across, axis=1, keepdims=True) + _CONSENSUS.epsilon)
    return np.stack([a, across, np.cross(a, across)], axis=2)


def _five_point(
    problem: RansacProblem, previous: FloatArray, current: FloatArray
) -> FloatArray | None:
    """Motions (K, 4, 4) with unit translation, decomposed from the best essential matrices.

    None if none fits.
    """
    camera = problem.camera
    if camera.is_cylinder:
        previous, current = _pinhole_pixels(camera, previous, current)
        if len(current) < _RANSAC.min_points:
            return None
    params = cv2.UsacParams()
    params.confidence = _CONSENSUS.five_point_confidence
    params.threshold = problem.limit_px
    params.maxIterations = 10 * _RANSAC.samples
    params.randomGeneratorState = int(problem.rng.integers(0, 2**31 - 1))
    params.isParallel = False
    K = camera.K
    none = np.zeros(4)
    essential, _ = cv2.findEssentialMat(previous, current, K, K, none, none, params)
    if essential is None or len(essential) < 3 or not np.isfinite(essential).all():
        return None
    motions = []
    for E in np.asarray(essential, dtype=np.float64).reshape(-1, 3, 3):
        R_a, R_b, t = cv2.decomposeEssentialMat(E)
        motions += [se3_from_parts(R, sign * t[:, 0]) for R in (R_a, R_b) for sign in (1.0, -1.0)]
    return np.stack(motions)


def _pinhole_pixels(
    camera: StereoCamera, previous: FloatArray, current: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pixels (K, 2) and (K, 2) that a pinhole of the same intrinsics shows in the place of a
    cylinder's (N, 2).
    """
    rays = [left_rays(camera, pixels) for pixels in (previous, current)]
    ahead = np.all(
        [r[:, 2] > _CONSENSUS.min_forward * np.linalg.norm(r, axis=1) for r in rays], axis=0
    )
    a, b = (
        r[ahead, :2] / r[ahead, 2:] * [camera.fu, camera.fv] + [camera.cu, camera.cv] for r in rays
    )
    return a, b
