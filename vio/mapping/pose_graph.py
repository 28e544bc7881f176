"""The optimum of a graph of camera poses: odometry between keyframes, gravity, and loops that may
be wrong.

Equations (G1) to (G5) of docs/math.md. Gauss-Newton on SE(3) over a sparse normal matrix. Loops are
truncated least squares by graduated non-convexity (Yang et al., 2020): one that contradicts the
others ends with weight zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from vio.geometry.lie import (
    FloatArray,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_left_jacobian,
    se3_log,
    so3_hat,
)
from vio.geometry.relative_pose import RelativePose
from vio.numerics import sparse
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import CUT_OFF_PROBABILITY, MU_GROWTH, truncated_weights
from vio.numerics.statistics import chi_square_quantile
from vio.records import BoolArray, IntArray


@dataclass(frozen=True, slots=True)
class _GncRules:
    """Graduated non-convexity."""

    max_steps: Tolerance[int] = 15
    max_gnc_steps: Tolerance[int] = 30
    converged: Tolerance[float] = 1e-6  # largest change, m and rad


_GNC = _GncRules()
# by which (G7) weighs an error xi: |R - R'|_F^2 = 2 |phi|^2
_FRAME_METRIC = np.repeat([1.0, 2.0], 3)


@dataclass(frozen=True, slots=True)
class Edges:
    """Measured motions between pairs of poses."""

    first: IntArray  # (E,) index of pose i
    second: IntArray  # (E,) index of pose j
    T_i_j: FloatArray  # (E, 4, 4)
    information: FloatArray  # (E, 6, 6) inverse covariance of xi in T_i_j = T_hat exp(xi)

    def __len__(self) -> int:
        return len(self.first)

    @classmethod
    def of(cls, rows: Sequence[tuple[int, int, RelativePose]]) -> Edges:
        """Collect edges (i, j, motion)."""
        first = [i for i, _, _ in rows]
        second = [j for _, j, _ in rows]
        poses = [pose for _, _, pose in rows]
        covariance = np.array([pose.covariance for pose in poses]).reshape(-1, 6, 6)
        return cls(
            np.array(first, dtype=np.int64),
            np.array(second, dtype=np.int64),
            np.array([pose.T_i_j for pose in poses]).reshape(-1, 4, 4),
            np.linalg.inv(covariance),
        )


@dataclass(frozen=True, slots=True)
class UpDirections:
    """The direction of the vertical, as the IMU gives it in each camera."""

    pose: IntArray  # (U,) index
    up_cam: FloatArray  # (U, 3) unit vector
    sigma_rad: FloatArray  # (U,)


@dataclass(frozen=True, slots=True)
class Optimum:
    """Poses that fit a graph best."""

    T_map_cam: FloatArray  # (K, 4, 4)
    kept: BoolArray  # (L,) loops that agree with the rest
    weight: FloatArray  # (L,) of each loop, 0 to 1


def optimise(
    T_map_cam: FloatArray,
    odometry: Edges,
    loops: Edges,
    up_directions: UpDirections,
    fixed: BoolArray,
    *,
    levelled: int | None = None,
) -> Optimum:
    """Return the poses (K, 4, 4) that minimise the squared errors of odometry, gravity and
    truncated loops.

    Args:
        T_map_cam: (K, 4, 4) where to start; the map's z axis is up if there are up_directions.
        odometry: edges that are trusted.
        loops: edges that may be wrong.
        up_directions: directions of the vertical.
        fixed: (K,) poses that stay; of a connected component without one of them, the first does.
        levelled: one of the fixed poses whose position and heading alone stay, so that its roll and
            pitch follow the up_directions; None: all of them stay.
    """
    free = _Free(fixed, levelled)
    limit = float(chi_square_quantile(CUT_OFF_PROBABILITY, 6))
    T = T_map_cam.copy()
    weight = np.ones(len(loops))
    if not len(loops):
        return Optimum(
            _descend(T, odometry, loops, weight, up_directions, free, _GNC.max_steps),
            weight > 0.5,
            weight,
        )
    T = _descend(T, odometry, loops, weight, up_directions, free, _GNC.max_steps)
    squared = _squared(T, loops)
    worst = float(squared.max())
    if worst > limit:  # else every loop fits with full weight, and there is nothing to decide
        mu = limit / (2 * worst - limit)
        for _ in range(_GNC.max_gnc_steps):
            weight = truncated_weights(squared, mu, limit)
            T = _descend(T, odometry, loops, weight, up_directions, free, 2)
            squared = _squared(T, loops)
            if ((weight == 0) | (weight == 1)).all() and mu > 1:
                break
            mu *= MU_GROWTH
        weight = (squared < limit).astype(np.float64)
        T = _descend(T, odometry, loops, weight, up_directions, free, _GNC.max_steps)
    return Optimum(T, weight > 0.5, weight)


def _squared(T: FloatArray, edges: Edges) -> FloatArray:
    r = residual(T, edges)
    out: FloatArray = np.einsum("ei,eij,ej->e", r, edges.information, r)
    return out


def residual(T: FloatArray, edges: Edges) -> FloatArray:
    """Residuals (E, 6) of edges at poses (K, 4, 4): `log(T_i_j^-1 T_i^-1 T_j)`, equation (G1)."""
    out: FloatArray = se3_log(
        se3_inverse(edges.T_i_j) @ se3_inverse(T[edges.first]) @ T[edges.second]
    )
    return out


def r_D_poses(T: FloatArray, edges: Edges, r: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Jacobians (E, 6, 6) of `residual` with respect to xi_i and xi_j in T <- T exp(xi),
    equation (G2).
    """
    # the right Jacobian's inverse
    r_D_j = np.asarray(np.linalg.inv(se3_left_jacobian(-r)), dtype=np.float64)
    return -r_D_j @ se3_adjoint(se3_inverse(T[edges.second]) @ T[edges.first]), r_D_j


def up_residual(T: FloatArray, up_directions: UpDirections) -> tuple[FloatArray, FloatArray]:
    """Residuals (U, 3) `R^T e_z - up_cam` at poses (K, 4, 4), and their Jacobians (U, 3, 6),
    equation (G3).
    """
    up = T[up_directions.pose, 2, :3]  # R^T e_z
    D = np.zeros((len(up), 3, 6))
    D[:, :, 3:] = so3_hat(up)
    return up - up_directions.up_cam, D


@dataclass(frozen=True, slots=True)
class _Free:
    """What of the poses may move."""

    fixed: BoolArray  # (K,)
    levelled: int | None  # a fixed pose that may rotate about the horizontal axes of the map

    def directions(self, T: FloatArray) -> csc_matrix:
        """Columns (6K, F) of the changes xi of the poses (K, 4, 4) that are free."""
        rows = np.flatnonzero(np.repeat(~self.fixed, 6))
        columns = np.arange(len(rows))
        values = np.ones(len(rows))
        if self.levelled is not None:
            # T exp([0; R^T a]) rotates a pose about its position and the axis a of the map: the
            # first two rows of R.
            rows = np.concatenate([rows, np.tile(6 * self.levelled + np.arange(3, 6), 2)])
            columns = np.concatenate([columns, np.repeat(len(columns) + np.arange(2), 3)])
            values = np.concatenate([values, T[self.levelled, :2, :3].ravel()])
        return coo_matrix(
            (values, (rows, columns)), shape=(6 * len(T), int(columns.max(initial=-1)) + 1)
        ).tocsc()


def _descend(
    T: FloatArray,
    odometry: Edges,
    loops: Edges,
    weight: FloatArray,
    up_directions: UpDirections,
    free: _Free,
    steps: int,
) -> FloatArray:
    """Gauss-Newton with fixed weights (L,) of the loops."""
    free = replace(free, fixed=_anchored(free.fixed, odometry, loops, weight))
    for _ in range(steps):
        xi = _step(T, odometry, loops, weight, up_directions, free)
        T = T @ se3_exp(xi)
        if np.abs(xi).max(initial=0.0) < _GNC.converged:
            break
    return T


def _anchored(fixed: BoolArray, odometry: Edges, loops: Edges, weight: FloatArray) -> BoolArray:
    """Return the poses (K,) that stay: those given, and the first of each piece that no weight
    joins to one of them.
    """
    held = weight > 0
    ends = (
        np.concatenate([odometry.first, loops.first[held]]),
        np.concatenate([odometry.second, loops.second[held]]),
    )
    links = coo_matrix((np.ones(len(ends[0])), ends), shape=(len(fixed), len(fixed)))
    pieces, piece = connected_components(links, directed=False)
    loose = ~np.isin(np.arange(pieces), piece[fixed])
    out = fixed.copy()
    out[np.unique(piece, return_index=True)[1][loose]] = True
    return out


def _step(
    T: FloatArray,
    odometry: Edges,
    loops: Edges,
    weight: FloatArray,
    up_directions: UpDirections,
    free: _Free,
) -> FloatArray:
    """Solve the normal equations (G4) for xi (K, 6)."""
    H, gradient, P = _normal(T, odometry, loops, weight, up_directions, free)
    return np.asarray(P @ sparse.factors(H, 6)(P.T @ gradient)).reshape(len(T), 6)


def marginals(
    T: FloatArray,
    odometry: Edges,
    loops: Edges,
    up_directions: UpDirections,
    fixed: BoolArray,
    poses: IntArray,
    *,
    levelled: int | None = None,
    frame: FloatArray | None = None,
) -> FloatArray:
    """Return the covariances (C, 6, 6) of xi in `T exp(xi)` of some poses (C,) of an optimum (K, 4,
    4), by (G4).

    The other arguments are those of `optimise`; all loops count, and what stays is exact.

    Args:
        frame: (K,) weights of the poses that define the frame by where they stand on average, (G9);
            None: it is that in which the fixed poses stay.
    """
    weight = np.ones(len(loops))
    free = _Free(_anchored(fixed, odometry, loops, weight), levelled)
    H, _, P = _normal(T, odometry, loops, weight, up_directions, free)
    D = P.tocsr()[(6 * poses[:, None] + np.arange(6)).ravel()]
    if frame is not None:
        A = se3_adjoint(se3_inverse(T))
        AW = frame[:, None, None] * np.swapaxes(A, 1, 2) * _FRAME_METRIC
        # (6, 6K) twist of the frame by xi
        mean = np.linalg.solve(np.sum(AW @ A, axis=0), np.swapaxes(AW, 0, 1).reshape(6, -1))
        D = D - csr_matrix(np.concatenate(A[poses]) @ mean @ P)
    return sparse.marginals(H, D.tocsr(), 6, block=6)


def _normal(
    T: FloatArray,
    odometry: Edges,
    loops: Edges,
    weight: FloatArray,
    up_directions: UpDirections,
    free: _Free,
) -> tuple[csc_matrix, FloatArray, csc_matrix]:
    """Return the normal matrix (F, F) of (G4) for what is free, the right-hand side (6K,) of
    all, and the columns.
    """
    count = len(T)
    blocks: list[tuple[IntArray, IntArray, FloatArray]] = []
    gradient = np.zeros((count, 6))
    for edges, scale in ((odometry, np.ones(len(odometry))), (loops, weight)):
        if not len(edges):
            continue
        r = residual(T, edges)
        A, B = r_D_poses(T, edges, r)
        W = edges.information * scale[:, None, None]
        AW = np.swapaxes(A, 1, 2) @ W
        BW = np.swapaxes(B, 1, 2) @ W
        i = edges.first
        j = edges.second
        AB = AW @ B
        blocks += [
            (i, i, AW @ A),
            (j, j, BW @ B),
            (i, j, AB),
            (j, i, np.swapaxes(AB, 1, 2)),
        ]
        np.add.at(gradient, i, -np.einsum("eij,ej->ei", AW, r))
        np.add.at(gradient, j, -np.einsum("eij,ej->ei", BW, r))
    if len(up_directions.pose):
        r, D = up_residual(T, up_directions)
        D = D / up_directions.sigma_rad[:, None, None]
        r = r / up_directions.sigma_rad[:, None]
        blocks.append((up_directions.pose, up_directions.pose, np.swapaxes(D, 1, 2) @ D))
        np.add.at(gradient, up_directions.pose, -np.einsum("eji,ej->ei", D, r))
    P = free.directions(T)
    return (P.T @ _sparse(blocks, count) @ P).tocsc(), gradient.ravel(), P


def _sparse(blocks: list[tuple[IntArray, IntArray, FloatArray]], count: int) -> coo_matrix:
    """Assemble 6 x 6 blocks at block rows and columns into a sparse matrix (6K, 6K) in columns."""
    inner_row, inner_column = np.divmod(np.arange(36), 6)
    rows = np.concatenate([(6 * i[:, None] + inner_row).ravel() for i, _, _ in blocks])
    columns = np.concatenate([(6 * j[:, None] + inner_column).ravel() for _, j, _ in blocks])
    values = np.concatenate([M.reshape(-1) for _, _, M in blocks])
    return coo_matrix((values, (rows, columns)), shape=(6 * count, 6 * count)).tocsr()
