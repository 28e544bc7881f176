"""Whether two keyframes show one place, and where they stand to each other.

Descriptors give pairs; PnP with RANSAC, in both directions, gives the motion; a least-squares fit
of all stereo pixels refines it. A pair that agrees with the motion from i to j but not with that
from j to i counts as wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, se3_log, so3_exp
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera, p_cam_D_z, project, triangulate
from vio.mapping.features import MAX_BITS, KeyframeFeatures
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Tolerance
from vio.numerics.statistics import chi_square_quantile
from vio.records import BoolArray, IntArray, LoopMatches

MIN_INLIERS = 20


@dataclass(frozen=True, slots=True)
class _Fitting:
    """How the motion of a loop is found and judged."""

    min_share: float = 0.25  # of the pairs that must agree; wrong pairs are at random
    worse: Tolerance[int] = 1000  # more than the 256 bits in which two descriptors can differ
    ratio: float = 0.85  # to the second-best descriptor
    max_pairs: int = 200  # that enter the fit, which takes 4 ms then
    ransac_px: float = 4.0
    ransac_steps: int = 300
    # that no better pose is left, at which sampling ends; at two thirds as many are found
    ransac_sure: Tolerance[float] = 0.999
    same_m: float = 0.1  # by which both directions may differ; metres, beside a share of the depth
    same_deg: float = 3.0
    same_depth: float = 0.05
    max_steps: Tolerance[int] = 10
    converged: Tolerance[float] = 1e-5  # change, m and rad
    gate: float = 3.0  # standard deviations, of a pixel coordinate
    # Floor of a loop's standard deviations: errors that its points share, such as those of the
    # calibration.
    floor_depth: float = 0.002
    floor_deg: float = 0.05
    # Variance of a pixel over the one assumed, which is one pixel at the scale of its level: key
    # points lie on whole pixels of their level, so that the errors are at least those of
    # rounding.
    min_variance: float = 1 / 12
    # of its standard deviations: key points of neighbouring levels and edges are not independent
    inflation: float = 2.0


_FITTING = _Fitting()
MIN_DISPARITY_PX = 1.0


@dataclass(frozen=True, slots=True)
class Verified:
    """A place seen again."""

    pose: RelativePose  # of camera j in camera i
    inliers: int
    pairs: int  # of descriptors
    matches: LoopMatches  # their pixels


def match(i: KeyframeFeatures, j: KeyframeFeatures) -> IntArray:
    """Pair features by descriptor: rows (K, 2) of i and j, each the other's best and clearly
    better than the next.
    """
    if len(i) < 2 or len(j) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    bits = _differing_bits(i, j)
    rows = np.arange(len(i))
    best = bits.argmin(axis=1)
    mutual = bits.argmin(axis=0)[best] == rows
    least = bits[rows, best]
    bits[rows, best] = _FITTING.worse
    good = np.flatnonzero(
        mutual & (least <= np.minimum(MAX_BITS, _FITTING.ratio * bits.min(axis=1)))
    )
    return np.stack([good, best[good]], axis=1)


def _differing_bits(i: KeyframeFeatures, j: KeyframeFeatures) -> npt.NDArray[np.int32]:
    """Hamming distances (N, M) of descriptors."""
    out = np.empty((len(i), len(j)), dtype=np.int32)
    a, b = (np.ascontiguousarray(f.descriptors).view(np.uint64) for f in (i, j))
    _count_bits(a, b, out)
    return out


@compiled
def _count_bits(
    a: npt.NDArray[np.uint64], b: npt.NDArray[np.uint64], out: npt.NDArray[np.int32]
) -> None:
    """Count in which bits the rows of two arrays (N, W) and (M, W) differ."""
    for i in range(len(a)):
        for j in range(len(b)):
            out[i, j] = differing_bits(a[i], b[j])


@compiled
def differing_bits(a: npt.NDArray[np.uint64], b: npt.NDArray[np.uint64]) -> np.uint64:
    """Count in which bits two descriptors (W,) differ, by sums over pairs, fours and bytes."""
    pairs = np.uint64(0x5555555555555555)
    fours = np.uint64(0x3333333333333333)
    bytes_ = np.uint64(0x0F0F0F0F0F0F0F0F)
    ones = np.uint64(0x0101010101010101)
    total = np.uint64(0)
    for w in range(len(a)):
        x = a[w] ^ b[w]
        x = x - ((x >> np.uint64(1)) & pairs)
        x = (x & fours) + ((x >> np.uint64(2)) & fours)
        x = (x + (x >> np.uint64(4))) & bytes_
        total += (x * ones) >> np.uint64(56)
    return total


def verify(
    camera_i: StereoCamera, i: KeyframeFeatures, camera_j: StereoCamera, j: KeyframeFeatures
) -> Verified | None:
    """Return where camera j stands in the frame of camera i; None: they do not show one place."""
    pairs = match(i, j)
    if len(pairs) < MIN_INLIERS:
        return None
    # features are in the order of their columns, so these are spread over the image
    if len(pairs) > _FITTING.max_pairs:
        pairs = pairs[np.linspace(0, len(pairs) - 1, _FITTING.max_pairs).astype(np.int64)]
    a, b = pairs.T
    T_j_i = _pnp(camera_i, i, a, camera_j, j, b)
    if T_j_i is None:
        T_i_j = None
    else:
        T_i_j = _pnp(camera_j, j, b, camera_i, i, a)
    if T_j_i is None or T_i_j is None:
        return None
    depth = _median_depth(camera_j, j, b)
    gap = se3_log(T_i_j @ T_j_i)
    apart_m = np.linalg.norm(gap[:3])
    apart_rad = np.linalg.norm(gap[3:])
    same_m = _FITTING.same_m + _FITTING.same_depth * depth
    if apart_m > same_m or apart_rad > np.radians(_FITTING.same_deg):
        return None
    fitted = _fit(camera_i, i, a, camera_j, j, b, T_i_j)
    if fitted is None:
        return None
    pose, good = fitted
    if good.sum() < max(MIN_INLIERS, _FITTING.min_share * len(pairs)):
        return None
    a = a[good]
    b = b[good]
    return Verified(pose, len(a), len(pairs), matches_of(i, a, j, b))


def matches_of(i: KeyframeFeatures, a: IntArray, j: KeyframeFeatures, b: IntArray) -> LoopMatches:
    """Return pairs (K,) of features as the images show them."""
    return LoopMatches(i.measured[a], j.measured[b], i.has_right[a], j.has_right[b])


def _points(
    camera: StereoCamera, f: KeyframeFeatures, rows: IntArray
) -> tuple[FloatArray, BoolArray]:
    p, valid = triangulate(camera, f.z[rows], min_disparity_px=MIN_DISPARITY_PX)
    return p, valid & f.has_right[rows]


def _median_depth(camera: StereoCamera, f: KeyframeFeatures, rows: IntArray) -> float:
    p, valid = _points(camera, f, rows)
    if not valid.any():
        return 0.0
    return float(np.median(p[valid, 2]))


def _pnp(
    camera_a: StereoCamera,
    a: KeyframeFeatures,
    rows_a: IntArray,
    camera_b: StereoCamera,
    b: KeyframeFeatures,
    rows_b: IntArray,
) -> FloatArray | None:
    """Return T_b_a (4, 4) from the stereo points of a and the left pixels of b.

    None: too few agree.
    """
    p, valid = _points(camera_a, a, rows_a)
    return pose_of_most(camera_b, p[valid], b.z[rows_b[valid], :2], MIN_INLIERS)


def pose_of_most(
    camera: StereoCamera, p: FloatArray, uv: FloatArray, least: int
) -> FloatArray | None:
    """Return the transform (4, 4) into a camera with which most points agree, by RANSAC over
    samples of three.

    Args:
        camera: the camera.
        p: points (K, 3).
        uv: left pixels (K, 2) that show them.
        least: how many must agree; with fewer the result is None.
    """
    if len(p) < least:
        return None
    done, rotation, translation, inliers = cv2.solvePnPRansac(
        p,
        uv,
        camera.K,
        None,
        iterationsCount=_FITTING.ransac_steps,
        reprojectionError=_FITTING.ransac_px,
        confidence=_FITTING.ransac_sure,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not done or inliers is None or len(inliers) < least:
        return None
    T = np.eye(4)
    T[:3, :3] = so3_exp(rotation[:, 0])
    T[:3, 3] = translation[:, 0]
    return T


def _fit(
    camera_i: StereoCamera,
    i: KeyframeFeatures,
    a: IntArray,
    camera_j: StereoCamera,
    j: KeyframeFeatures,
    b: IntArray,
    T_i_j: FloatArray,
) -> tuple[RelativePose, BoolArray] | None:
    """Fit the motion to the stereo pixels of both keyframes; return it and a mask (K,) of the pairs
    that agree.

    The pixels of j are predicted from the points of i, whose covariance is added to theirs; where i
    has no right pixel, the other way round.
    """
    forward = _points(camera_i, i, a)[1]
    order = np.concatenate([np.flatnonzero(forward), np.flatnonzero(~forward)])
    parts = (
        Terms(points_of(camera_i, i, a[forward]), camera_j, j, b[forward], inverse=True),
        Terms(points_of(camera_j, j, b[~forward]), camera_i, i, a[~forward], inverse=False),
    )
    fitted = fit_terms(parts, T_i_j)
    if fitted is None:
        return None
    good = np.zeros(len(a), dtype=np.bool_)
    good[order] = fitted.fits
    return fitted.motion(_median_depth(camera_j, j, b[good])), good


@dataclass(frozen=True, slots=True)
class Fitted:
    """The motion that fits pixels best."""

    T_i_j: FloatArray  # (4, 4)
    # (6, 6) information of xi in T_i_j = T_hat exp(xi), of pixels as good as they were assumed
    normal: FloatArray
    squared: FloatArray  # (K,) squared normalised residuals
    fits: BoolArray  # (K,) pairs that agree
    stereo: BoolArray  # (K,) pairs whose target has a right pixel

    def motion(self, depth_m: float) -> RelativePose:
        """Return it with a covariance; errors that all points share are in proportion to their
        median depth.
        """
        floor = np.repeat(
            [(_FITTING.floor_depth * depth_m) ** 2, np.radians(_FITTING.floor_deg) ** 2], 3
        )
        noise = _variance_factor(self.squared[self.fits], self.stereo[self.fits])
        covariance = noise * _FITTING.inflation**2 * np.asarray(
            np.linalg.inv(self.normal), dtype=np.float64
        ) + np.diag(floor)
        return RelativePose(self.T_i_j, covariance)


def covariance_by_shifts(
    terms: Terms, T_i_j: FloatArray, prior: RelativePose | None, dp: FloatArray, dz: FloatArray
) -> FloatArray:
    """Covariance (6, 6) of a fitted motion by independent errors that all its pairs share.

    Args:
        terms: pixels that were fitted.
        T_i_j: (4, 4) the motion.
        prior: that the fit had.
        dp: (K, 3, S) by how much one standard deviation of each error moves the points, m.
        dz: (K, 4, S) likewise the pixels that are predicted.
    """

    def step(terms: Terms) -> tuple[FloatArray, FloatArray]:
        normal = np.zeros((6, 6))
        pull = np.zeros(6)
        terms.add(T_i_j, _FITTING.gate, normal, pull)
        return normal, pull

    normal, pull = step(terms)
    P = _information(prior)
    pulls = []
    for s in range(dp.shape[-1]):
        shifted = terms.shifted(dp[..., s], dz[..., s])
        pulls.append(step(shifted)[1] - pull)
    xi = np.linalg.solve(normal + P, np.transpose(pulls))
    return np.asarray(xi @ xi.T)


def _information(prior: RelativePose | None) -> FloatArray:
    """Information (6, 6) of a prior; without one enough for the equations to have a solution."""
    if prior is None:
        return 1e-9 * np.eye(6)
    return np.asarray(np.linalg.inv(prior.covariance))


def fit_terms(
    parts: Sequence[Terms],
    T_i_j: FloatArray,
    *,
    prior: RelativePose | None = None,
    least: int = MIN_INLIERS,
) -> Fitted | None:
    """Fit a motion by iterated reweighted least squares; None: too few pixels agree.

    Residuals are [ul vl ur] (the right row says nothing new, see docs/math.md).

    Args:
        parts: pixels.
        T_i_j: (4, 4) where to start.
        prior: what else is known of the motion: it decides what the pixels leave open, and is not
            part of `normal`.
        least: number of pairs that must agree.
    """
    T = T_i_j
    normal = np.eye(6)
    P = _information(prior)
    squared = np.zeros(sum(len(part.stereo) for part in parts))
    for step in range(_FITTING.max_steps):
        width = _FITTING.gate * 2.0 ** max(2 - step, 0)
        normal = np.zeros((6, 6))
        pull = np.zeros(6)
        begin = 0
        for part in parts:
            squared[begin : begin + len(part.stereo)] = part.add(T, width, normal, pull)
            begin += len(part.stereo)
        fits: BoolArray = squared < 3 * _FITTING.gate**2
        if fits.sum() < least:
            return None
        if prior is not None:
            pull += P @ se3_log(se3_inverse(T) @ prior.T_i_j)
        xi = np.linalg.solve(normal + P, pull)
        T = T @ se3_exp(xi)
        if step > 2 and np.abs(xi).max() < _FITTING.converged:
            break
    return Fitted(T, normal, squared, fits, np.concatenate([part.stereo for part in parts]))


def _variance_factor(squared: FloatArray, stereo: BoolArray) -> float:
    """Return the variance of the pixels over the one assumed, by the median of the squared
    residuals (K,) of a fit.

    Of a left and a right pixel they have three degrees of freedom, of a left one alone two.
    """
    expected = np.where(stereo, *chi_square_quantile(0.5, [3, 2]))
    return max(float(np.median(squared / expected)), _FITTING.min_variance)


@dataclass(frozen=True, slots=True)
class StereoPoints:
    """Points by stereo pixels."""

    p: FloatArray  # (K, 3) m, in the frame of a camera; arbitrary where not valid
    covariance: FloatArray  # (K, 3, 3) m^2
    valid: BoolArray  # (K,)

    def take(self, rows: IntArray) -> StereoPoints:
        """Return some of the points."""
        return StereoPoints(self.p[rows], self.covariance[rows], self.valid[rows])


def points_of(camera: StereoCamera, f: KeyframeFeatures, rows: IntArray) -> StereoPoints:
    """Return the points that features (rows, (K,)) of a keyframe show, in the frame of its left
    camera.
    """
    p, valid = _points(camera, f, rows)
    z = np.where(valid[:, None], f.z[rows], project(camera, [0.0, 0.0, 1.0]))
    J = p_cam_D_z(camera, z)
    covariance = np.einsum("kij,klj,k->kil", J, J, f.sigma_px[rows] ** 2)
    return StereoPoints(np.where(valid[:, None], p, [0.0, 0.0, 1.0]), covariance, valid)


class Terms:
    """Residuals of the pixels of one keyframe, predicted from points in the frame of the other."""

    def __init__(
        self,
        source: StereoPoints,
        camera_t: StereoCamera,
        t: KeyframeFeatures,
        rows_t: IntArray,
        *,
        inverse: bool,
    ) -> None:
        """Prepare pairs (K,); those without a valid point count nothing.

        Args:
            source: points, in the frame of keyframe i, or j if not `inverse`.
            camera_t: of the other keyframe, whose pixels are predicted.
            t: its features.
            rows_t: (K,) features that show the points.
            inverse: whether the pixels are those of keyframe j, so that the inverse of T_i_j
                predicts them.
        """
        self._inverse = inverse
        self._camera = np.array(
            [camera_t.fu, camera_t.fv, camera_t.cu, camera_t.cv, camera_t.baseline_m]
        )
        self._p = source.p
        self._P = source.covariance
        self._used = source.valid
        self._z = t.z[rows_t]
        self.stereo = t.has_right[rows_t]
        self._variance = t.sigma_px[rows_t] ** 2

    def shifted(self, dp: FloatArray, dz: FloatArray) -> Terms:
        """Return them with points moved by dp (K, 3), m, and pixels by dz (K, 4)."""
        out = copy(self)
        out._p = self._p + dp
        out._z = self._z + dz
        return out

    def add(
        self, T_i_j: FloatArray, width: float, normal: FloatArray, pull: FloatArray
    ) -> FloatArray:
        """Add the normal equations of xi in T_i_j <- T_i_j exp(xi); return squared residuals (K,),
        infinite where none.

        Args:
            T_i_j: (4, 4).
            width: normalised residual at which a pair counts a quarter.
            normal: (6, 6), added to.
            pull: (6,) right-hand side, added to.
        """
        T_t_s = se3_inverse(T_i_j) if self._inverse else T_i_j
        squared = np.full(len(self._p), np.inf)
        pairs = _Pairs(self._p, self._P, self._used, self._z, self.stereo, self._variance)
        target = _Target(T_t_s, self._inverse, self._camera)
        _add_pairs(pairs, target, 3 * width**2, normal, pull, squared)
        return squared


class _Pairs(NamedTuple):
    """Points of one keyframe and the pixels of the other one that show them."""

    p: FloatArray  # (K, 3) m, in the frame of the former
    P: FloatArray  # (K, 3, 3) their covariances
    used: BoolArray  # (K,)
    z: FloatArray  # (K, 4) pixels
    stereo: BoolArray  # (K,) whether the right one is measured
    variance: FloatArray  # (K,) px^2


class _Target(NamedTuple):
    """The keyframe whose pixels are predicted."""

    T: FloatArray  # (4, 4) from the frame of the points to its own
    inverse: bool  # as of `Terms`
    camera: FloatArray  # fu, fv, cu, cv (pixels), baseline (m)


@compiled
def _pixel_covariance(
    M: FloatArray, P: FloatArray, variance: float, rows: int, C: FloatArray
) -> None:
    """Write the lower triangle of the covariance of the first pixels (3,) of a point, by its own
    (3, 3), the pixels' Jacobian by the point and their variance.
    """
    for i in range(rows):
        for j in range(i + 1):
            C[i, j] = variance if i == j else 0.0
            for a in range(3):
                for b in range(3):
                    C[i, j] += M[i, a] * P[a, b] * M[j, b]


@compiled
def _add_pairs(
    pairs: _Pairs,
    target: _Target,
    scale: float,
    normal: FloatArray,
    pull: FloatArray,
    squared: FloatArray,
) -> None:
    """Whiten the residuals of pairs (K,) by Cholesky, and add their normal equations."""
    p = pairs.p
    T = target.T
    A = np.zeros((3, 7))  # A: rows [J | r]; M: z_D_p
    M = np.zeros((3, 3))
    C = np.zeros((3, 3))
    q = np.zeros(3)
    for k in range(len(p)):
        for i in range(3):
            q[i] = T[i, 0] * p[k, 0] + T[i, 1] * p[k, 1] + T[i, 2] * p[k, 2] + T[i, 3]
        if not pairs.used[k] or q[2] <= 0.05:
            continue
        rows = 3 if pairs.stereo[k] else 2  # of a left pixel alone, two
        _linearise(p[k], q, pairs.z[k], target, A, M)
        _pixel_covariance(M, pairs.P[k], pairs.variance[k], rows, C)
        _whiten(C, A, rows)
        total = 0.0
        for i in range(rows):
            total += A[i, 6] ** 2
        squared[k] = total
        weight = 1.0 / (1.0 + total / scale) ** 2
        for i in range(rows):
            for a in range(6):
                pull[a] += weight * A[i, a] * A[i, 6]
                for b in range(6):
                    normal[a, b] += weight * A[i, a] * A[i, b]


@compiled
def _whiten(C: FloatArray, A: FloatArray, rows: int) -> None:
    """Replace C (3, 3) by its Cholesky factor L, and A (3, 7) by `L^-1 A`: so many rows of both."""
    for i in range(rows):
        for j in range(i):
            for n in range(j):
                C[i, j] -= C[i, n] * C[j, n]
            C[i, j] /= C[j, j]
            C[i, i] -= C[i, j] ** 2
            for c in range(7):
                A[i, c] -= C[i, j] * A[j, c]
        C[i, i] = np.sqrt(C[i, i])
        for c in range(7):
            A[i, c] /= C[i, i]


@compiled
def _compare_pixels(
    q: FloatArray, z: FloatArray, target: _Target, A: FloatArray, z_D_q: FloatArray
) -> None:
    """Write the residuals of pixels [ul vl ur] into the last column of A (3, 7), and their Jacobian
    (3, 3) by the point in the target.
    """
    fu, fv, cu, cv, baseline = target.camera
    for i in range(3):
        f = fv if i == 1 else fu
        across = q[1] if i == 1 else q[0] - (baseline if i == 2 else 0.0)
        z_D_q[i, 1 if i == 1 else 0] = f / q[2]
        z_D_q[i, 2] = -f * across / q[2] ** 2
        A[i, 6] = z[i] - (cv if i == 1 else cu) - f * across / q[2]


@compiled
def _linearise(
    p: FloatArray, q: FloatArray, z: FloatArray, target: _Target, A: FloatArray, M: FloatArray
) -> None:
    """Write Jacobian and residual [ul vl ur] of a point p (3,), at q in the target (3,), into A (3,
    7), z_D_p into M.

    `q = exp(-xi) T_hat^-1 p` if `inverse`, else `q = T_hat exp(xi) p`: its derivative is [-I, q^]
    or R [I, -p^].
    """
    T = target.T
    z_D_q = np.zeros((3, 3))
    _compare_pixels(q, z, target, A, z_D_q)
    for i in range(3):
        for c in range(3):
            M[i, c] = z_D_q[i, 0] * T[0, c] + z_D_q[i, 1] * T[1, c] + z_D_q[i, 2] * T[2, c]
        for c in range(3):
            a = (c + 1) % 3
            b = (c + 2) % 3
            if target.inverse:
                A[i, c] = -z_D_q[i, c]
                A[i, 3 + c] = z_D_q[i, a] * q[b] - z_D_q[i, b] * q[a]
            else:
                A[i, c] = M[i, c]
                A[i, 3 + c] = M[i, b] * p[a] - M[i, a] * p[b]
