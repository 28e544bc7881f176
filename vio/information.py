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

from vio.geometry.lie import FloatArray, so3_hat
from vio.geometry.stereo import StereoCamera, z_D_p_cam
from vio.records import BoolArray, IntArray, MotionPrior

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
