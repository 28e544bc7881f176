"""Bundle adjustment of keyframes with an IMU: poses, velocities, biases, points, and what the rig
is off by.

Factors: stereo pixels of tracks and of points that loops join, the IMU's motions from keyframe to
keyframe (`vio.imu.preintegration`), the walks of its biases, and priors of the rig. Where images
show little, the IMU holds the poses, which is what a bundle adjustment of images alone lacks.
Gauss-Newton with Levenberg's damping; points are eliminated (Schur complement), the rest is one
sparse system. Pixels have Geman-McClure's weights, which begin wide. Ceres, as pycolmap has it,
takes no factors in Python but pixels and priors of poses.
References: Triggs et al., Bundle adjustment: a modern synthesis (2000); the covariance: White,
Maximum likelihood estimation of misspecified models (1982), clustered as by Liang & Zeger (1986).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.sparse import (
    block_array,
    bsr_matrix,
    coo_matrix,
    csc_matrix,
    csr_matrix,
    diags_array,
    hstack,
    vstack,
)

from vio.cameras.rectification_error import METRIC_TERMS, ErrorColumns, error_basis
from vio.filters.overdispersion import CELL_RAD
from vio.geometry.lie import FloatArray, se3_adjoint, se3_exp, se3_inverse, so3_hat
from vio.geometry.stereo import StereoCamera, project, z_D_p_cam
from vio.imu.preintegration import BodyStates, Preintegrated, Readings, preintegrate
from vio.numerics import sparse
from vio.numerics.kinds import Tolerance
from vio.numerics.least_squares import Damping
from vio.offline.points import MIN_DEPTH_M, PointTracks
from vio.records import FIELD_TERMS, ROW_TERMS, IntArray


@dataclass(frozen=True, slots=True)
class _AdjustmentRules:
    """How an adjustment with the IMU descends."""

    # states of a keyframe: xi of its pose, velocity, biases of gyro and accelerometer
    own: int = 15
    width_sigmas: float = 3.0  # standard deviations at which a row's weight is a quarter …
    wider_steps: int = 2  # … doubled in so many first steps, once each
    settled_steps: int = 7  # steps after which neither width nor preintegration change
    # of the cost, from step to step: what goes on is rows that turn into outliers, and moves no
    # pose
    converged_share: Tolerance[float] = 1e-4
    max_steps: Tolerance[int] = 25
    first_damping: Tolerance[float] = 1e-6
    max_damping: Tolerance[float] = 1e3
    # tracks that end within it in one cell of directions share their errors, as in (R7)
    cell_s: float = 1.0
    # inverse standard deviation, 1/m and 1/rad, of position and heading of the first keyframe
    gauge_weight: Tolerance[float] = 1e4


_ADJUSTMENT = _AdjustmentRules()
_FIELD = FIELD_TERMS + ROW_TERMS
_METRIC_COLUMNS: IntArray = np.arange(FIELD_TERMS, FIELD_TERMS + METRIC_TERMS + 2)
# Field, baseline, focal length, centre, extrinsics, time, accelerometer.
_SHARED = _FIELD + METRIC_TERMS + 2 + 6 + 1 + 1


@dataclass(frozen=True, slots=True)
class RigPrior:
    """What the rig may be off by: 27 states of unit variance, of which none is known at the
    start.
    """

    field: FloatArray  # (15, 15) coefficients of (R3) and (R2) by the states, focal lengths
    field_at_start: FloatArray  # (15,) the states that were taken out of the pixels
    # (4,) standard deviations of log baseline, log focal length, principal point / focal length
    metric: FloatArray
    extrinsics: FloatArray  # (6,) of xi in T_cam0_imu = T_hat exp(xi), m and rad
    time_s: float
    accel_scale: float

    @property
    def at_start(self) -> FloatArray:
        """Distance (27,) of the start from what the prior expects."""
        return np.concatenate([self.field_at_start, np.zeros(_SHARED - _FIELD)])


@dataclass(frozen=True, slots=True)
class Fit:
    """States of an adjustment."""

    body: BodyStates  # of the keyframes
    p_world: FloatArray  # (M, 3)
    rig: FloatArray  # (27,) of `RigPrior`


@dataclass(frozen=True, slots=True)
class Optimum:
    """Where an adjustment ended."""

    at: Fit
    converged: bool
    pixels: float  # mean squared error of the pixels that agree, 1 expected
    inertial: float  # likewise of the IMU's motions
    # (C, 6, 6) of xi in `T_world_cam0 exp(xi)` of the keyframes asked for, since the first one
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class InertialAdjustment:
    """What is adjusted: keyframes with their rows of pixels, and the IMU between them."""

    camera: StereoCamera
    tracks: PointTracks  # with points to begin with
    seconds: FloatArray  # (K,) exposures by the IMU's clock
    readings: Readings
    T_cam0_imu: FloatArray  # (4, 4)
    prior: RigPrior
    sigma_px: FloatArray  # (R,) of each row
    bias_sigma: FloatArray  # (6,) of the biases at the first keyframe, rad/s and m/s^2
    gravity_mps2: float

    def solve(
        self,
        body: BodyStates,
        covariance_of: IntArray | None = None,
        progress: Callable[[], None] = lambda: None,
    ) -> Optimum:
        """Return the optimum from some states on.

        Args:
            body: states of the keyframes to begin with.
            covariance_of: (C,) keyframes whose covariance is wanted.
            progress: called before each step; what it raises ends the adjustment.
        """
        at, steps, converged = self._descend(body, progress)
        squared, _ = self._squared(at)
        r = self._inertial_residual(at, steps)
        covariance = np.zeros((0, 6, 6))
        if covariance_of is not None:
            progress()
            system = self._system(at, steps, _ADJUSTMENT.width_sigmas)
            covariance = system.covariance(
                self._cameras_by_states(at, covariance_of), self._clusters()
            )
        pixels = float(np.mean(squared[squared < _ADJUSTMENT.width_sigmas**2])) / 3
        return Optimum(at, converged, pixels, float(np.mean(r**2)), covariance)

    def _descend(
        self, body: BodyStates, progress: Callable[[], None]
    ) -> tuple[Fit, Preintegrated, bool]:
        at = Fit(body, self.tracks.p_world, np.zeros(_SHARED))
        damping = Damping(_ADJUSTMENT.max_damping, value=_ADJUSTMENT.first_damping)
        steps = self._preintegrated(body)
        for n in range(_ADJUSTMENT.max_steps):
            progress()
            width = _ADJUSTMENT.width_sigmas * 2.0 ** max(_ADJUSTMENT.wider_steps - n, 0)
            if n in (1, 3, 6):
                steps = self._preintegrated(at.body)
            system = self._system(at, steps, width)
            before = self._cost(at, steps, width)
            new = damping.step(
                partial(self._after_step, at, system),
                partial(self._cost, steps=steps, width=width),
                before,
            )
            if new is None:
                return at, steps, n > _ADJUSTMENT.settled_steps
            at, after = new
            if (
                n > _ADJUSTMENT.settled_steps
                and before - after < _ADJUSTMENT.converged_share * before
            ):
                return at, steps, True
        return at, steps, False

    def _after_step(self, at: Fit, system: _System, damping: float) -> Fit:
        return self._moved(at, *system.step(damping))

    def corrected_pixels(self, at: Fit) -> FloatArray:
        """Return the rows' pixels (R, 4) without what the rig is off by; right rows stay as they
        are.
        """
        r, q, _ = self._pixels(at)
        z = self.tracks.z.copy()
        z[:, :3] = np.where(
            self.tracks.has_right[:, None] | (np.arange(3) < 2),
            project(self.camera, q)[:, :3] + r,
            z[:, :3],
        )
        return z

    def _preintegrated(self, body: BodyStates) -> Preintegrated:
        return preintegrate(self.readings, self.seconds[:-1], self.seconds[1:], body.bias[:-1])

    def _moved(self, at: Fit, own: FloatArray, points: FloatArray, rig: FloatArray) -> Fit:
        return Fit(at.body.moved(own), at.p_world + points, at.rig + rig)

    # Pixels

    def _twists(self, at: Fit) -> FloatArray:
        """Twists (K, 6) of the body, in its axes."""
        t = self.readings.seconds
        gyro = np.stack(
            [np.interp(self.seconds, t, self.readings.gyro[:, k]) for k in range(3)], axis=1
        )
        v = np.einsum("kji,kj->ki", at.body.T_world_imu[:, :3, :3], at.body.velocity)
        return np.concatenate([v, gyro - at.body.bias[:, :3]], axis=1)

    def cameras(self, at: Fit) -> FloatArray:
        """Poses (K, 4, 4) of the left camera in the world."""
        e, t = self._extrinsics(at.rig)
        T_world_imu = at.body.T_world_imu @ se3_exp(t * self._twists(at))
        return np.asarray(T_world_imu @ se3_exp(-e) @ se3_inverse(self.T_cam0_imu))

    def _cameras_by_states(self, at: Fit, keyframes: IntArray) -> csr_matrix:
        """Derivatives (6C, 15K + 27) of xi in `T_world_cam0 exp(xi)` of keyframes (C,),
        extrinsics to first order.
        """
        K = len(self.seconds)
        first = _FIELD + METRIC_TERMS + 2
        cam_D_imu = se3_adjoint(
            se3_inverse(self.cameras(at)[keyframes]) @ at.body.T_world_imu[keyframes]
        )
        out = np.zeros((len(keyframes), 6, _ADJUSTMENT.own + _SHARED))
        out[:, :, :6] = cam_D_imu
        out[:, :, _ADJUSTMENT.own + first : _ADJUSTMENT.own + first + 6] = (
            -se3_adjoint(self.T_cam0_imu) * self.prior.extrinsics
        )
        twists = self.prior.time_s * self._twists(at)[keyframes]
        out[:, :, _ADJUSTMENT.own + first + 6] = np.einsum("cij,cj->ci", cam_D_imu, twists)
        own = _blocks(
            np.arange(len(keyframes)), keyframes, out[:, :, : _ADJUSTMENT.own], len(keyframes), K
        )
        return hstack([own, csr_matrix(out[:, :, _ADJUSTMENT.own :].reshape(-1, _SHARED))]).tocsr()

    def _clusters(self) -> IntArray:
        """Return numbers (M,) of the clusters of points: where and when their tracks end."""
        tracks = self.tracks
        c = self.camera
        last = np.zeros(len(self.tracks.ids), dtype=np.int64)
        last[tracks.point] = np.arange(len(tracks.point))  # rows are ordered by keyframe
        pixels = tracks.z[last, :2]
        across, down = (pixels - [c.cu, c.cv]).T / [[c.fu], [c.fv]]
        seconds = self.seconds[tracks.keyframe[last]]
        cells = np.stack(
            [np.arctan(across) / CELL_RAD, np.arctan(down) / CELL_RAD, seconds / _ADJUSTMENT.cell_s]
        )
        return np.asarray(np.unique(np.floor(cells), axis=1, return_inverse=True)[1]).ravel()

    def _extrinsics(self, rig: FloatArray) -> tuple[FloatArray, float]:
        n = _FIELD + METRIC_TERMS + 2
        extrinsics = rig[n : n + 6] * self.prior.extrinsics
        delay_s = float(rig[n + 6] * self.prior.time_s)
        return extrinsics, delay_s

    def _pixels(self, at: Fit) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (R, 3) of [ul vl ur], points in the camera (R, 3), and residuals by the
        rig's terms (R, 3, 19).
        """
        tracks = self.tracks
        prior = self.prior
        T = se3_inverse(self.cameras(at))[tracks.keyframe]
        p_world = at.p_world[tracks.point]
        q = np.einsum("rij,rj->ri", T[:, :3, :3], p_world) + T[:, :3, 3]
        q = np.where((q[:, 2] > MIN_DEPTH_M)[:, None], q, [0.0, 0.0, MIN_DEPTH_M])
        # Where points are expected: at noisy pixels, a longer baseline would pass for less noise.
        expected = project(self.camera, q)
        by_field = error_basis(self.camera, expected) @ prior.field
        by_metric = ErrorColumns(self.camera, _METRIC_COLUMNS).jacobian(expected) * prior.metric
        D = np.concatenate([by_field, by_metric], axis=2)[:, :3]
        r = (tracks.z - expected)[:, :3] - D @ at.rig[: D.shape[2]]
        r[~tracks.has_right, 2] = 0
        D[~tracks.has_right, 2] = 0
        return r, q, -D

    def _squared(self, at: Fit) -> tuple[FloatArray, FloatArray]:
        r, q, _ = self._pixels(at)
        return np.sum(r**2, axis=1) / self.sigma_px**2, q

    # IMU

    def _inertial_residual(self, at: Fit, steps: Preintegrated) -> FloatArray:
        """Whitened residuals (F, 9)."""
        i = at.body.take(slice(None, -1))
        j = at.body.take(slice(1, None))
        r = self._scaled(at, steps).residual(i, j, self.gravity_mps2)
        return np.asarray(np.einsum("fij,fj->fi", _whitening(steps), r))

    def _scaled(self, at: Fit, steps: Preintegrated) -> Preintegrated:
        factor = 1 + self.prior.accel_scale * at.rig[-1]
        return replace(steps, v=factor * steps.v, p=factor * steps.p)

    def _walk_sigmas(self) -> FloatArray:
        d = self.readings.densities
        return np.sqrt(np.diff(self.seconds))[:, None] * np.repeat([d.gyro_walk, d.accel_walk], 3)

    def _cost(self, at: Fit, steps: Preintegrated, width: float) -> float:
        squared, _ = self._squared(at)
        limit = 3 * width**2
        cost = float(np.sum(squared / (1 + squared / limit)))
        cost += float(np.sum(self._inertial_residual(at, steps) ** 2))
        cost += float(np.sum((np.diff(at.body.bias, axis=0) / self._walk_sigmas()) ** 2))
        cost += float(np.sum((at.body.bias[0] / self.bias_sigma) ** 2))
        return cost + float(np.sum((self.prior.at_start + at.rig) ** 2))

    # Normal equations

    def _system(self, at: Fit, steps: Preintegrated, width: float) -> _System:
        tracks = self.tracks
        K = len(self.seconds)
        count = len(self.tracks.point)
        columns = _ADJUSTMENT.own * K + _SHARED
        r, q, r_D_rig = self._pixels(at)
        squared = np.sum(r**2, axis=1) / self.sigma_px**2
        weight = 1 / (self.sigma_px * (1 + squared / (3 * width**2)))
        R_cam_imu = (self.T_cam0_imu @ se3_exp(self._extrinsics(at.rig)[0]))[:3]
        p_imu = (q - R_cam_imu[:, 3]) @ R_cam_imu[:, :3]
        r_D_q = -z_D_p_cam(self.camera, q)[:, :3]
        r_D_q[~tracks.has_right, 2] = 0
        by_imu = r_D_q @ R_cam_imu[:, :3]
        r_D_xi = np.concatenate([-by_imu, by_imu @ so3_hat(p_imu)], axis=2)
        T_cam_world = se3_inverse(self.cameras(at))[tracks.keyframe]
        r_D_point = r_D_q @ T_cam_world[:, :3, :3] * weight[:, None, None]
        twist = self._twists(at)[tracks.keyframe]
        late = (r_D_xi @ twist[:, :, None]) * self.prior.time_s
        shared = np.concatenate(
            [r_D_rig, -r_D_xi * self.prior.extrinsics, late, np.zeros((count, 3, 1))], axis=2
        )
        # Velocity and gyro bias act on a pixel by the twist alone, to second order: left out.
        e = r * weight[:, None]
        own = r_D_xi * weight[:, None, None]
        others, other_e = self._other_rows(at, steps, columns)
        return _System(
            tracks, own, r_D_point, shared * weight[:, None, None], e, others, other_e, K
        )

    def _other_rows(
        self, at: Fit, steps: Preintegrated, columns: int
    ) -> tuple[csr_matrix, FloatArray]:
        """Jacobian and residuals of IMU, walks, priors and what fixes the world, whitened."""
        K = len(self.seconds)
        F = len(self.seconds) - 1
        i = at.body.take(slice(None, -1))
        j = at.body.take(slice(1, None))
        r, A, B = self._scaled(at, steps).linearised(i, j, self.gravity_mps2)
        W = _whitening(steps)
        n = np.arange(F)
        own = _ADJUSTMENT.own * K
        S = np.zeros((F, 9, _SHARED))
        S[:, 3:6, -1] = -self.prior.accel_scale * steps.v
        S[:, 6:, -1] = -self.prior.accel_scale * steps.p
        to_first = _blocks(n, n, W @ A, F, K)
        to_second = _blocks(n, n + 1, W @ B, F, K)
        imu = to_first + to_second
        parts = [hstack([imu, csr_matrix((W @ S).reshape(9 * F, _SHARED))])]
        errors = [np.einsum("fij,fj->fi", W, r).ravel()]
        walk = np.zeros((F, 6, _ADJUSTMENT.own))
        walk[:, np.arange(6), 9 + np.arange(6)] = 1 / self._walk_sigmas()
        walks = _blocks(n, n + 1, walk, F, K) - _blocks(n, n, walk, F, K)
        parts.append(hstack([walks, csr_matrix((6 * F, _SHARED))]))
        errors.append((np.diff(at.body.bias, axis=0) / self._walk_sigmas()).ravel())
        single = np.arange(6), 9 + np.arange(6)
        parts.append(csr_matrix((1 / self.bias_sigma, single), shape=(6, columns)))
        errors.append(at.body.bias[0] / self.bias_sigma)
        rig = np.arange(_SHARED)
        parts.append(csr_matrix((np.ones(_SHARED), (rig, own + rig)), shape=(_SHARED, columns)))
        errors.append(self.prior.at_start + at.rig)
        gauge = np.zeros((4, columns))
        R = at.body.T_world_imu[0, :3, :3]
        gauge[:3, :3] = _ADJUSTMENT.gauge_weight * R
        gauge[3, 3:6] = _ADJUSTMENT.gauge_weight * R[2]
        parts.append(csr_matrix(gauge))
        errors.append(np.zeros(4))
        return vstack(parts).tocsr(), np.concatenate(errors)


@dataclass(frozen=True, slots=True)
class _Points:
    """Normal equations of the points, of which `V p = -(e + by_pose' xi + by_rig s)`."""

    V_inverse: FloatArray  # (M, 3, 3)
    e: FloatArray  # (M, 3)
    by_pose: bsr_matrix  # (6K, 3M)
    by_rig: FloatArray  # (M, 3, 27)


@dataclass(frozen=True, slots=True)
class _System:
    """A linearised problem: rows of pixels `own xi + points p + rig s + e`, and
    `others x + other_e` beside them.
    """

    tracks: PointTracks
    own: FloatArray  # (R, 3, 6) by the pose of the row's keyframe
    points: FloatArray  # (R, 3, 3) by its point
    rig: FloatArray  # (R, 3, 27)
    e: FloatArray  # (R, 3)
    others: csr_matrix  # by the states of all keyframes, 15 each, and of the rig
    other_e: FloatArray
    keyframes: int

    def step(self, damping: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the changes of the keyframes (K, 15), points (M, 3) and rig (27,)."""
        N, g, points = self._reduced(damping)
        x = -sparse.factors(N)(g)
        own = x[: _ADJUSTMENT.own * self.keyframes].reshape(-1, _ADJUSTMENT.own)
        s = x[_ADJUSTMENT.own * self.keyframes :]
        by_poses = (points.by_pose.T @ own[:, :6].ravel()).reshape(-1, 3)
        p = -np.einsum("mij,mj->mi", points.V_inverse, points.e + by_poses + points.by_rig @ s)
        return own, p, s

    def covariance(self, D: csr_matrix, clusters: IntArray) -> FloatArray:
        """Covariances (C, 6, 6) of `D x` (6C, 15K + 27) by the squared scores of clusters of points
        (M,).

        Pixels of a cluster share errors, so that their score, `J' r` without the points, varies
        more than the normal matrix says: `N^-1 (sum s s' + M) N^-1`, with M that of all else.
        """
        N, _, points = self._reduced(0.0)
        e = self._without_points(points)
        rows = np.arange(len(self.e))
        own = np.pad(np.einsum("rai,ra->ri", self.own, e), ((0, 0), (0, _ADJUSTMENT.own - 6)))[
            :, None
        ]
        of_poses = _blocks(rows, self.tracks.keyframe, own, len(rows), self.keyframes)
        scores = hstack([of_poses, csr_matrix(np.einsum("rai,ra->ri", self.rig, e))])
        summed = csr_matrix((np.ones(len(rows)), (clusters[self.tracks.point], rows))) @ scores
        return sparse.marginals(N, D, 6, vstack([summed, self.others]).tocsr())

    def _without_points(self, points: _Points) -> FloatArray:
        """Return the residuals (R, 3) that are left where the points follow."""
        p = np.einsum("mij,mj->mi", points.V_inverse, points.e)
        return np.asarray(self.e - np.einsum("rij,rj->ri", self.points, p[self.tracks.point]))

    def _reduced(self, damping: float) -> tuple[csc_matrix, FloatArray, _Points]:
        """Return normal matrix and gradient of keyframes and rig without the points, and what
        gives those.
        """
        point = self.tracks.point
        keyframe = self.tracks.keyframe
        K = self.keyframes
        M = len(self.tracks.ids)
        own_T = np.swapaxes(self.own, 1, 2)
        points_T = np.swapaxes(self.points, 1, 2)
        V = _sums(point, points_T @ self.points, M)
        trace = np.maximum(np.trace(V, axis1=1, axis2=2), 1e-9)
        V_inverse = np.linalg.inv(V + (1e-9 + damping) * trace[:, None, None] * np.eye(3))
        V_e = _sums(point, np.einsum("rij,ri->rj", self.points, self.e), M)
        # Poses, rig and points by points, then without them.
        W = own_T @ self.points
        WV = W @ V_inverse[point]
        W_rig = _sums(point, points_T @ self.rig, M)
        V_rig = V_inverse @ W_rig
        begins = np.searchsorted(keyframe, np.arange(K + 1))
        by_point = bsr_matrix((W, point, begins), shape=(6 * K, 3 * M))
        poses = _diagonal(_sums(keyframe, own_T @ self.own, K)) - (
            bsr_matrix((WV, point, begins), shape=(6 * K, 3 * M)) @ by_point.T
        )
        mixed = _sums(keyframe, own_T @ self.rig - W @ V_rig[point], K).reshape(6 * K, _SHARED)
        rig = _product(self.rig, self.rig) - _product(W_rig, V_rig)
        eliminated = _Points(V_inverse, V_e, by_point, W_rig)
        e = self._without_points(eliminated)
        g = np.zeros(_ADJUSTMENT.own * K + _SHARED)
        g[: _ADJUSTMENT.own * K].reshape(K, _ADJUSTMENT.own)[:, :6] = _sums(
            keyframe, np.einsum("rai,ra->ri", self.own, e), K
        )
        g[_ADJUSTMENT.own * K :] = np.einsum("rai,ra->i", self.rig, e)
        g += self.others.T @ self.other_e
        places = np.concatenate(
            [
                (_ADJUSTMENT.own * np.arange(K)[:, None] + np.arange(6)).ravel(),
                _ADJUSTMENT.own * K + np.arange(_SHARED),
            ]
        )
        seen = block_array([[poses, mixed], [mixed.T, rig]], format="coo")
        N = coo_matrix(
            (seen.data, (places[seen.row], places[seen.col])), shape=(len(g), len(g))
        ).tocsc()
        N = N + (self.others.T @ self.others).tocsc()
        N = N + damping * diags_array(N.diagonal(), format="csc")
        return N, g, eliminated


def _whitening(steps: Preintegrated) -> FloatArray:
    """What whitens the residuals of motions (F, 9, 9)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(steps.covariance + 1e-14 * np.eye(9))))


def _sums(groups: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Sum values (N, ...) by group (N,), (count, ...)."""
    flat = values.reshape(len(values), -1)
    sums = (
        csr_matrix(
            (np.ones(len(groups)), (groups, np.arange(len(groups)))), shape=(count, len(groups))
        )
        @ flat
    )
    return np.asarray(sums).reshape(count, *values.shape[1:])


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Sum of a^T b over all rows (..., n)."""
    flat_a = a.reshape(-1, a.shape[-1])
    flat_b = b.reshape(-1, b.shape[-1])
    return np.asarray(flat_a.T @ flat_b)


def _diagonal(blocks: FloatArray) -> bsr_matrix:
    n = np.arange(len(blocks))
    return bsr_matrix((blocks, n, np.append(n, len(n))), shape=(6 * len(n), 6 * len(n)))


def _blocks(
    rows: IntArray, columns: IntArray, values: FloatArray, count: int, width: int
) -> csr_matrix:
    """A sparse matrix with blocks (N, a, b) at block rows and columns (N,), of `count` by
    `width` blocks.
    """
    _, a, b = values.shape
    r = (
        a * rows[:, None, None] + np.arange(a)[None, :, None] + np.zeros((1, 1, b), dtype=np.int64)
    ).ravel()
    c = (
        b * columns[:, None, None]
        + np.arange(b)[None, None, :]
        + np.zeros((1, a, 1), dtype=np.int64)
    ).ravel()
    out = coo_matrix((values.ravel(), (r, c)), shape=(a * count, b * width)).tocsr()
    out.eliminate_zeros()
    return out
