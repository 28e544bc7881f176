"""The information of features on the camera's motion, and a greedy choice of the most informative
subset.

Notation as in docs/notes/selection.md. A motion of the camera is `T_curr_prev = exp(xi) T_hat` with
`xi = [rho; phi]`; a feature at `p` in the current camera frame moves with it as `p <- exp(xi) p`.
The information of N features on K motions is stored as factors `L` (N, K, 3, 6) with `L' L` the
information matrix of xi.
References: Carlone & Karaman, Attention and anticipation in fast visual-inertial navigation (2019);
Zhao & Vela, Good feature matching (2020).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray, so3_hat, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, left_rays, project, triangulate, z_D_p_cam
from vio.numerics.kinds import Capacity, Tolerance
from vio.records import BoolArray, IntArray, MotionPrior, Observations

_BATCH: Capacity[int] = (
    6  # candidates evaluated exactly at first; doubled until the best is certain
)
_EYE = np.eye(3)
_TIE: Tolerance[float] = 1e-10  # relative difference below which two gains are the same


def motion_rows(camera: StereoCamera, p_cam: FloatArray) -> FloatArray:
    """Jacobian (..., 3, 6) of the pixels `[ul, sqrt(2) v, ur]` of points (..., 3) with respect to
    the camera's motion.

    The two vertical coordinates of a stereo pixel measure one quantity; their mean, times the
    square root of two, has the noise of one pixel coordinate as `ul` and `ur` do, so the three rows
    are independent with equal noise.
    """
    J = z_D_p_cam(camera, p_cam)[..., :3, :].copy()
    J[..., 1, :] *= np.sqrt(2.0)
    return np.concatenate([J, -J @ so3_hat(p_cam)], axis=-1)


def row_weights(sightings: npt.ArrayLike, has_right: BoolArray) -> FloatArray:
    """Information (..., 3) of the rows of `motion_rows`, in units of one over the variance of a
    pixel coordinate.

    Args:
        sightings: (...) number of earlier stereo observations of the point; it may be a fraction.
        has_right: (...) False: the point is now visible in the left image only.

    A point with n earlier stereo observations has its three pixels predicted with a variance of
    `1 / n`; the information of a new observation on the motion is `S^-1` with `S = 1 + 1 / n`. In
    the left image `v` alone has twice the variance of the mean. A new point adds no information on
    the motion before it.
    """
    n = np.asarray(sightings, dtype=np.float64)
    both = n / (n + 1)
    right = np.asarray(has_right, dtype=np.float64)
    return np.stack([both, np.where(has_right, both, n / (2 * n + 1)), right * both], axis=-1)


def prior_information(motion: MotionPrior | None) -> FloatArray:
    """Prior information (6, 6) on a motion; broad where no filter predicts it (1 m, 0.1 rad)."""
    if motion is None:
        return np.diag([1.0] * 3 + [1e2] * 3)
    # A covariance may be singular where a state is known.
    return np.asarray(
        np.linalg.inv(motion.covariance + np.diag([1e-10] * 3 + [1e-12] * 3)), dtype=np.float64
    )


def log_det_gain(prior: FloatArray, L: FloatArray) -> float:
    """Half the gain in log-determinant (nats) of the information on K motions from features.

    Args:
        prior: (K, 6, 6) information before.
        L: (S, K, 3, 6) factors of the features.
    """
    after = prior + np.einsum("skai,skaj->kij", L, L)
    return float(0.5 * np.sum(np.linalg.slogdet(after)[1] - np.linalg.slogdet(prior)[1]))


@dataclass(frozen=True, slots=True)
class Greedy:
    """The result of a greedy choice."""

    order: IntArray  # (S,) rows in the order in which they were chosen
    # (N,) nats gained when the row was chosen; other rows: an upper bound of their gain
    gain: FloatArray


def lazy_greedy(prior: FloatArray, L: FloatArray, ids: IntArray, budget: int) -> Greedy:
    """Choose up to `budget` of N features that together add most to the log-determinant, one at a
    time.

    The result equals that of evaluating every candidate in every round, at least (1 - 1/e) of the
    optimum, as the gain of a feature only decreases while others are chosen (submodularity). Only
    the candidates with the largest upper bounds are evaluated: with `A = L M L'` (3, 3),
    `log det(I + A) <= 3 log(1 + tr A / 3)`, and the traces of all candidates are one product with
    `M`. Ties go to the smaller id. Features without a gain are not chosen.
    References: Nemhauser, Wolsey & Fisher (1978); Minoux, Accelerated greedy algorithms (1978),
    here with a recomputed bound instead of the last gain.

    Args:
        prior: (K, 6, 6) information before, positive definite.
        L: (N, K, 3, 6).
        ids: (N,) for ties.
        budget: total number to choose.
    """
    N, K = L.shape[:2]
    delta = np.swapaxes(L, -1, -2) @ L
    flat = np.ascontiguousarray(np.swapaxes(delta.reshape(N, K, 36), 0, 1))
    information = prior
    available: FloatArray = np.ones(N)
    gain = np.zeros(N)
    order: list[int] = []
    while True:
        M: FloatArray = np.asarray(np.linalg.inv(information), dtype=np.float64)
        traces = (flat @ (M.reshape(K, 36, 1) / 3))[..., 0]
        # exp of two thirds of the bound in nats
        bound = np.multiply.reduce(traces + 1.0, axis=0) * available
        if len(order) >= budget or len(order) >= N:
            break
        rows, exact = _best_exact(L, M, bound, available)
        best = float(exact.max(initial=0.0))
        if best <= 0.0:
            break
        tied = rows[exact >= best * (1 - _TIE)]
        pick = int(tied[ids[tied].argmin()])
        order.append(pick)
        gain[pick] = best
        available[pick] = 0.0
        information = information + delta[pick]
    left = available > 0
    gain[left] = 1.5 * np.log(bound[left])
    return Greedy(np.array(order, dtype=np.int64), gain)


def _best_exact(
    L: FloatArray, M: FloatArray, bound: FloatArray, available: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Rows (R,) that include all candidates of largest gain, and the gains (R,) in nats; 0 for
    chosen rows.
    """
    count = _BATCH
    while True:
        if count < len(bound):
            ranked = np.argpartition(bound, len(bound) - count - 1)[len(bound) - count - 1 :]
            rows = ranked[1:]
            next_bound = bound[ranked[0]]
        else:
            rows = np.arange(len(bound))
            next_bound = 0.0
        some = L[rows]
        A = (some @ M) @ some.swapaxes(-1, -2) + _EYE
        exact = 0.5 * np.log(np.multiply.reduce(np.linalg.det(A), axis=1)) * available[rows]
        if next_bound <= 1.0 or 1.5 * np.log(next_bound) < exact.max() * (1 - _TIE):
            return rows, exact
        count *= 2


@dataclass(frozen=True, slots=True)
class _Tracked:
    """The features of the last frame, in the order of their ids."""

    ids: IntArray  # (N,)
    p_cam: FloatArray  # (N, 3) in that frame's camera; arbitrary where not valid
    valid: BoolArray  # (N,)
    age: IntArray  # (N,) consecutive frames in which the feature was observed
    sightings: IntArray  # (N,) consecutive stereo observations that were chosen

    def find(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """Rows (M,) of given ids, and a mask (M,) of those present."""
        if not len(self.ids):
            return np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=np.bool_)
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return at, self.ids[at] == ids


_NO_FEATURES = _Tracked(
    np.zeros(0, dtype=np.int64),
    np.zeros((0, 3)),
    np.zeros(0, dtype=np.bool_),
    np.zeros(0, dtype=np.int64),
    np.zeros(0, dtype=np.int64),
)


class _Survival:
    """The probability that a feature of a given age survives to the next frame, estimated
    online.
    """

    _AGES = 7  # ages 1, 2-3, 4-7, …, 64 and more
    _HITS = 9.0  # prior counts
    _TRIALS = 10.0

    def __init__(self) -> None:
        self._hits = np.full(self._AGES, self._HITS)
        self._trials = np.full(self._AGES, self._TRIALS)

    def count(self, age: IntArray, again: BoolArray) -> None:
        """Count which features of an age (N,) survived (N,)."""
        group = self._group(age)
        self._trials += np.bincount(group, minlength=self._AGES)
        self._hits += np.bincount(group[again], minlength=self._AGES)

    def probability(self, age: IntArray) -> FloatArray:
        """Return the probability (N,) for features of an age (N,)."""
        return (self._hits / self._trials)[self._group(age)]

    def _group(self, age: IntArray) -> IntArray:
        return np.minimum(np.log2(np.maximum(age, 1)).astype(np.int64), self._AGES - 1)


class MotionInformation:
    """Information of each frame's features on the camera's motion, given their earlier use by
    the filter.
    """

    _MIN_DEPTH = 0.5  # baselines; the filters use no point outside
    _MAX_DEPTH = 400.0
    # innovation in standard deviations at which a feature's weight is halved
    _HALF_WEIGHT_SIGMAS = 3.0

    def __init__(self, camera: StereoCamera, horizon_frames: int, pixel_sigma_px: float) -> None:
        self._camera = camera
        self._sigma = pixel_sigma_px
        self._steps = (0, *sorted({1, horizon_frames}))  # 0: the last motion, 1: the next one, …
        self._tracked = _NO_FEATURES
        self._survival = _Survival()

    def add_frame(self, observations: Observations, motion: MotionPrior | None) -> FloatArray:
        """Add one frame and return the factors (N, K, 3, 6) of its rows for K motions, equations
        (S3) to (S5).

        The motions are the last one, the next one and the one at the horizon, under constant
        predicted motion.
        """
        ids = observations.ids
        last = self._tracked
        if motion is None:
            T_curr_prev = np.eye(4)
        else:
            T_curr_prev = motion.T_curr_prev
        at, known = last.find(ids)
        self._survival.count(last.age, np.isin(last.ids, ids))
        age = np.ones(len(ids), dtype=np.int64)
        sightings = np.zeros(len(ids), dtype=np.int64)
        age[known] += last.age[at[known]]
        sightings[known] = last.sightings[at[known]]
        predicted = np.zeros((len(ids), 3))
        was_valid = np.zeros(len(ids), dtype=np.bool_)
        predicted[known] = transform_points(T_curr_prev, last.p_cam[at[known]])
        was_valid[known] = last.valid[at[known]]
        p_cam, valid = self._points(observations, predicted, was_valid & (sightings > 0))
        self._tracked = _Tracked(ids, p_cam, valid, age, sightings)
        L = self._factors(observations, T_curr_prev)
        if motion is not None:
            both = valid & was_valid & observations.has_right
            weight = self._consistency_weight(observations.z[both], predicted[both], motion)
            L[both] *= np.sqrt(weight)[:, None, None, None]
        return L

    def mark_used(self, observations: Observations, chosen: BoolArray) -> None:
        """Record which rows (N,) of the last added frame the filter uses."""
        tracked = self._tracked
        order = np.argsort(observations.ids)
        sightings = np.where(
            chosen & ~observations.stale,
            tracked.sightings + (observations.has_right & tracked.valid),
            0,
        )
        self._tracked = _Tracked(
            tracked.ids[order],
            tracked.p_cam[order],
            tracked.valid[order],
            tracked.age[order],
            sightings[order],
        )

    def _points(
        self, observations: Observations, predicted: FloatArray, was_used: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """Points (N, 3) in the camera frame and a mask (N,) of valid ones: by stereo, or by the
        predicted depth.
        """
        camera = self._camera
        z = observations.z
        p_cam, valid = triangulate(camera, z)
        valid &= observations.has_right
        left_only = ~observations.has_right & was_used
        if left_only.any():
            depth = depth_of(camera, predicted[left_only])[:, None]
            p_cam[left_only] = left_rays(camera, z[left_only, :2]) * depth
            valid |= left_only
        baselines = depth_of(camera, p_cam) / camera.baseline_m
        return p_cam, valid & ~observations.stale & (baselines > self._MIN_DEPTH) & (
            baselines < self._MAX_DEPTH
        )

    def _consistency_weight(
        self, z: FloatArray, predicted: FloatArray, motion: MotionPrior
    ) -> FloatArray:
        """Weights (N,) from 0 to 1 by the innovation of the pixels under the predicted motion
        (S4).
        """
        ahead = depth_of(self._camera, predicted) > self._MIN_DEPTH * self._camera.baseline_m
        safe = np.where(ahead[:, None], predicted, [0.0, 0.0, 1.0])
        off = z - project(self._camera, safe)
        of_rows = (off[:, 1] + off[:, 3]) / np.sqrt(2)
        r = np.stack([off[:, 0], of_rows, off[:, 2]], axis=1)
        G = motion_rows(self._camera, safe)
        # Noise of two observations: this one and the one that triangulated the point.
        by_motion = G @ motion.covariance @ np.swapaxes(G, 1, 2)
        S = by_motion + 2 * self._sigma**2 * np.eye(3)
        squares = np.einsum("ni,ni->n", r, np.linalg.solve(S, r[..., None])[..., 0])
        return np.asarray(ahead / (1 + squares / self._HALF_WEIGHT_SIGMAS**2))

    def _factors(self, observations: Observations, T_curr_prev: FloatArray) -> FloatArray:
        valid = self._tracked.valid
        L = np.zeros((len(valid), len(self._steps), 3, 6))
        now = self._tracked.p_cam[valid]
        right = observations.has_right[valid]
        n = self._tracked.sightings[valid]
        survival = self._survival.probability(self._tracked.age[valid])
        weight = row_weights(n, right)
        for k, step in enumerate(self._steps):
            p = transform_points(np.linalg.matrix_power(T_curr_prev, step), now)
            ahead = depth_of(self._camera, p) > self._MIN_DEPTH * self._camera.baseline_m
            safe = np.where(ahead[:, None], p, [0.0, 0.0, 1.0])
            if step:
                z = project(self._camera, safe)
                weight = row_weights(n + step * right, right & self._in_image(z[:, 2], z[:, 3]))
                seen = ahead & self._in_image(z[:, 0], z[:, 1])
                weight *= (survival**step * seen)[:, None]
            L[valid, k] = motion_rows(self._camera, safe) * np.sqrt(weight)[..., None]
        return L / self._sigma

    def _in_image(self, u: FloatArray, v: FloatArray) -> BoolArray:
        """Mask of pixels inside the image; where its size is unknown, the principal point is
        assumed its centre.
        """
        width = self._camera.width or 2 * self._camera.cu
        height = self._camera.height or 2 * self._camera.cv
        return np.asarray((u >= 0) & (u < width) & (v >= 0) & (v < height))
