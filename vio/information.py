"""What a feature says of the camera's motion, and which few features say most together.

Letters are those of docs/selection.md. A motion of the camera is `T_curr_prev = exp(xi) T_hat` with `xi = [rho; phi]`;
a feature at `p` in the current camera frame moves with it as `p <- exp(xi) p`. What N features say of K motions is
kept as factors `L` (N, K, 3, 6) with information `L' L`, in units of one over the covariance of xi.
References: Carlone & Karaman, Attention and anticipation in fast visual-inertial navigation (2019); Zhao & Vela, Good
feature matching (2020).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray, so3_hat, transform_points
from vio.geometry.stereo import StereoCamera, left_rays, project, triangulate, z_D_p_cam
from vio.records import BoolArray, IntArray, MotionPrior, Observations

_BATCH = 6  # candidates evaluated exactly at first; doubled until the best is certain
_EYE = np.eye(3)
_TIE = 1e-10  # relative difference below which two gains are the same


def motion_rows(camera: StereoCamera, p_cam: FloatArray) -> FloatArray:
    """How the pixels `[ul, sqrt(2) v, ur]` of points (..., 3) move with the camera: (..., 3, 6) per metre and radian.

    The two vertical coordinates of a stereo pixel measure one quantity; their mean, times the square root of two,
    carries the noise of one pixel coordinate as `ul` and `ur` do, so the three rows are independent and equally good.
    """
    J = z_D_p_cam(camera, p_cam)[..., :3, :].copy()
    J[..., 1, :] *= np.sqrt(2.0)
    return np.concatenate([J, -J @ so3_hat(p_cam)], axis=-1)


def row_weights(sightings: npt.ArrayLike, has_right: BoolArray) -> FloatArray:
    """Information (..., 3) of the rows of `motion_rows`, in units of one over the variance of a pixel coordinate.

    Args:
        sightings: (...) by how many stereo sightings the point is known beforehand; it may be a fraction.
        has_right: (...) False: the point is seen in the left image only now.

    A point known by n stereo sightings has its three pixels predicted with a variance of `1 / n`; what a new
    sighting says of the motion is `S^-1` with `S = 1 + 1 / n`. In the left image `v` alone has twice the variance of
    the mean. Nothing is said of a motion by a point that was not known before it.
    """
    n = np.asarray(sightings, dtype=np.float64)
    both = n / (n + 1)
    right = np.asarray(has_right, dtype=np.float64)
    return np.stack([both, np.where(has_right, both, n / (2 * n + 1)), right * both], axis=-1)


def prior_information(motion: MotionPrior | None) -> FloatArray:
    """Information (6, 6) on a motion before any feature speaks; broad where no filter tells (1 m, 0.1 rad)."""
    if motion is None:
        return np.diag([1.0] * 3 + [1e2] * 3)
    # A covariance may be singular where a state is known.
    return np.asarray(np.linalg.inv(motion.covariance + np.diag([1e-10] * 3 + [1e-12] * 3)), dtype=np.float64)


def log_det_gain(prior: FloatArray, L: FloatArray) -> float:
    """Half the log-determinant (nats) that features add to the information on K motions.

    Args:
        prior: (K, 6, 6) information before.
        L: (S, K, 3, 6) factors of the features.
    """
    after = prior + np.einsum("skai,skaj->kij", L, L)
    return float(0.5 * np.sum(np.linalg.slogdet(after)[1] - np.linalg.slogdet(prior)[1]))


@dataclass(frozen=True, slots=True)
class Greedy:
    """What a greedy choice found."""

    order: IntArray  # (S,) rows in the order in which they were chosen, those kept first
    gain: FloatArray  # (N,) nats gained when the row was chosen; rows left out: an upper bound of what they would add


def lazy_greedy(prior: FloatArray, L: FloatArray, ids: IntArray, budget: int, kept: BoolArray) -> Greedy:
    """Choose up to `budget` of N features that together add most to the log-determinant, one at a time.

    The result is that of evaluating every candidate in every round, at least (1 - 1/e) of the best possible, as
    the gain of a feature only shrinks while others are chosen. Only the candidates with the largest upper bounds are
    evaluated: with `A = L M L'` (3, 3), `log det(I + A) <= 3 log(1 + tr A / 3)`, and the traces of all candidates are
    one product with `M`. Ties go to the smaller id. Features that add nothing are left out.
    References: Nemhauser, Wolsey & Fisher (1978); Minoux, Accelerated greedy algorithms (1978), here with a bound that
    is computed anew instead of the last gain.

    Args:
        prior: (K, 6, 6) information before, positive definite.
        L: (N, K, 3, 6).
        ids: (N,) for ties.
        budget: how many in all.
        kept: (N,) features that count as chosen beforehand; no more than the budget.
    """
    N, K = L.shape[:2]
    delta = np.swapaxes(L, -1, -2) @ L
    flat = np.ascontiguousarray(np.swapaxes(delta.reshape(N, K, 36), 0, 1))
    information = prior + delta[kept].sum(axis=0)
    open_ = np.where(kept, 0.0, 1.0)
    gain = np.zeros(N)
    order = np.flatnonzero(kept).tolist()
    while True:
        M = np.linalg.inv(information)
        traces = (flat @ (M.reshape(K, 36, 1) / 3))[..., 0]
        bound = np.multiply.reduce(traces + 1.0, axis=0) * open_  # exp of two thirds of the bound in nats
        if len(order) >= budget or len(order) >= N:
            break
        rows, exact = _best_exact(L, M, bound, open_)
        best = float(exact.max(initial=0.0))
        if best <= 0.0:
            break
        tied = rows[exact >= best * (1 - _TIE)]
        pick = int(tied[ids[tied].argmin()])
        order.append(pick)
        gain[pick], open_[pick] = best, 0.0
        information = information + delta[pick]
    left = open_ > 0
    gain[left] = 1.5 * np.log(bound[left])
    return Greedy(np.array(order, dtype=np.int64), gain)


def _best_exact(L: FloatArray, M: FloatArray, bound: FloatArray, open_: FloatArray) -> tuple[IntArray, FloatArray]:
    """Rows (R,) that hold all candidates of largest gain, and the gains (R,) in nats; closed rows gain nothing."""
    count = _BATCH
    while True:
        if count < len(bound):
            ranked = np.argpartition(bound, len(bound) - count - 1)[len(bound) - count - 1 :]
            rows, next_bound = ranked[1:], bound[ranked[0]]
        else:
            rows, next_bound = np.arange(len(bound)), 0.0
        some = L[rows]
        A = (some @ M) @ some.swapaxes(-1, -2) + _EYE
        exact = 0.5 * np.log(np.multiply.reduce(np.linalg.det(A), axis=1)) * open_[rows]
        if next_bound <= 1.0 or 1.5 * np.log(next_bound) < exact.max() * (1 - _TIE):
            return rows, exact
        count *= 2


@dataclass(frozen=True, slots=True)
class _Seen:
    """What is known of the features of the last frame, in the order of their ids."""

    ids: IntArray  # (N,)
    p_cam: FloatArray  # (N, 3) in that frame's camera; arbitrary where not placed
    placed: BoolArray  # (N,)
    age: IntArray  # (N,) frames in a row in which the feature was seen
    sightings: IntArray  # (N,) stereo sightings in a row that were chosen

    def find(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """Rows (M,) of given ids, and which of them are there."""
        if not len(self.ids):
            return np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=np.bool_)
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return at, self.ids[at] == ids


_NOTHING_SEEN = _Seen(
    np.zeros(0, dtype=np.int64),
    np.zeros((0, 3)),
    np.zeros(0, dtype=np.bool_),
    np.zeros(0, dtype=np.int64),
    np.zeros(0, dtype=np.int64),
)


class _Survival:
    """How probably a feature of a given age is seen again in the next frame, counted as the record goes."""

    _AGES = 7  # ages 1, 2-3, 4-7, …, 64 and more
    _HITS, _TRIALS = 9.0, 10.0  # what is believed before anything is counted

    def __init__(self) -> None:
        self._hits = np.full(self._AGES, self._HITS)
        self._trials = np.full(self._AGES, self._TRIALS)

    def count(self, age: IntArray, again: BoolArray) -> None:
        """Take in which features of an age (N,) were seen again (N,)."""
        group = self._group(age)
        self._trials += np.bincount(group, minlength=self._AGES)
        self._hits += np.bincount(group[again], minlength=self._AGES)

    def probability(self, age: IntArray) -> FloatArray:
        """Return the probability (N,) for features of an age (N,)."""
        return (self._hits / self._trials)[self._group(age)]

    def _group(self, age: IntArray) -> IntArray:
        return np.minimum(np.log2(np.maximum(age, 1)).astype(np.int64), self._AGES - 1)


class MotionInformation:
    """What the features of each frame say of the camera's motion, given which of them the filter has used before."""

    _MIN_DEPTH, _MAX_DEPTH = 0.5, 400.0  # baselines; beyond, the filters do not use a point
    _DOUBTED = 3.0  # sigmas off the expected motion at which a feature's word counts half

    def __init__(self, camera: StereoCamera, horizon_frames: int, pixel_sigma_px: float) -> None:
        self._camera, self._sigma = camera, pixel_sigma_px
        self._steps = (0, *sorted({1, horizon_frames}))  # 0: the last motion, 1: the next one, …
        self._seen, self._survival = _NOTHING_SEEN, _Survival()

    def look(self, observations: Observations, motion: MotionPrior | None) -> FloatArray:
        """Take in one frame and return what each row says of K motions, (N, K, 3, 6), equations (S3) to (S5).

        The motions are the last one, the next one and the one at the horizon; the expected motion is taken to go on.
        """
        ids, last = observations.ids, self._seen
        T_curr_prev = np.eye(4) if motion is None else motion.T_curr_prev
        at, known = last.find(ids)
        self._survival.count(last.age, np.isin(last.ids, ids))
        age, sightings = np.ones(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=np.int64)
        age[known] += last.age[at[known]]
        sightings[known] = last.sightings[at[known]]
        expected, was_placed = np.zeros((len(ids), 3)), np.zeros(len(ids), dtype=np.bool_)
        expected[known] = transform_points(T_curr_prev, last.p_cam[at[known]])
        was_placed[known] = last.placed[at[known]]
        p_cam, placed = self._place(observations, expected, was_placed & (sightings > 0))
        self._seen = _Seen(ids, p_cam, placed, age, sightings)
        L = self._factors(observations, T_curr_prev)
        if motion is not None:
            both = placed & was_placed & observations.has_right
            L[both] *= np.sqrt(self._trust(observations.z[both], expected[both], motion))[:, None, None, None]
        return L

    def use(self, observations: Observations, chosen: BoolArray) -> None:
        """Note which rows (N,) of the frame just seen the filter uses."""
        seen, order = self._seen, np.argsort(observations.ids)
        sightings = np.where(chosen & ~observations.stale, seen.sightings + (observations.has_right & seen.placed), 0)
        self._seen = _Seen(seen.ids[order], seen.p_cam[order], seen.placed[order], seen.age[order], sightings[order])

    def _place(
        self, observations: Observations, expected: FloatArray, was_used: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """Points (N, 3) in the camera and which (N,) can be used: by stereo, or by the depth that is expected."""
        camera, z = self._camera, observations.z
        p_cam, placed = triangulate(camera, z)
        placed &= observations.has_right
        left_only = ~observations.has_right & was_used
        if left_only.any():
            p_cam[left_only] = left_rays(camera, z[left_only, :2]) * expected[left_only, 2:]
            placed |= left_only
        baselines = p_cam[:, 2] / camera.baseline_m
        return p_cam, placed & ~observations.stale & (baselines > self._MIN_DEPTH) & (baselines < self._MAX_DEPTH)

    def _trust(self, z: FloatArray, expected: FloatArray, motion: MotionPrior) -> FloatArray:
        """How far features (N,) are believed, from 0 to 1, by how well their pixels fit the expected motion."""
        ahead = expected[:, 2] > self._MIN_DEPTH * self._camera.baseline_m
        safe = np.where(ahead[:, None], expected, [0.0, 0.0, 1.0])
        off = z - project(self._camera, safe)
        r = np.stack([off[:, 0], (off[:, 1] + off[:, 3]) / np.sqrt(2), off[:, 2]], axis=1)
        G = motion_rows(self._camera, safe)
        # Two sightings, this one and the one that placed the point.
        S = G @ motion.covariance @ np.swapaxes(G, 1, 2) + 2 * self._sigma**2 * np.eye(3)
        squares = np.einsum("ni,ni->n", r, np.linalg.solve(S, r[..., None])[..., 0])
        return np.asarray(ahead / (1 + squares / self._DOUBTED**2))

    def _factors(self, observations: Observations, T_curr_prev: FloatArray) -> FloatArray:
        placed = self._seen.placed
        L = np.zeros((len(placed), len(self._steps), 3, 6))
        now, right, n = self._seen.p_cam[placed], observations.has_right[placed], self._seen.sightings[placed]
        survival = self._survival.probability(self._seen.age[placed])
        weight = row_weights(n, right)
        for k, step in enumerate(self._steps):
            p = transform_points(np.linalg.matrix_power(T_curr_prev, step), now)
            ahead = p[:, 2] > self._MIN_DEPTH * self._camera.baseline_m
            safe = np.where(ahead[:, None], p, [0.0, 0.0, 1.0])
            if step:
                z = project(self._camera, safe)
                weight = row_weights(n + step * right, right & self._inside(z[:, 2], z[:, 3]))
                weight *= (survival**step * (ahead & self._inside(z[:, 0], z[:, 1])))[:, None]
            L[placed, k] = motion_rows(self._camera, safe) * np.sqrt(weight)[..., None]
        return L / self._sigma

    def _inside(self, u: FloatArray, v: FloatArray) -> BoolArray:
        """Which pixels lie in the image; where its size is unknown, the principal point is taken for its centre."""
        width, height = self._camera.width or 2 * self._camera.cu, self._camera.height or 2 * self._camera.cv
        return np.asarray((u >= 0) & (u < width) & (v >= 0) & (v < height))
