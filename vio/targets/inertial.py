"""A camera and an IMU by a board: extrinsics, time offset, gravity and biases.

The board's poses in the camera are measurements; states of the IMU at the exposures, joined by its
preintegrated samples, are adjusted to them. The start comes from the rotations alone: of the rates
of camera and gyroscope, and of the mean force, which is up. No guess is needed, at rest or moving.
References: Furgale, Rehder & Siegwart, Unified temporal and spatial calibration for multi-sensor
systems (2013), for the problem; `vio.imu.preintegration` for the IMU's terms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from vio.calibration.egomotion import CameraMotion
from vio.calibration.findings import NotObservable
from vio.calibration.gyro import align_gyro
from vio.calibration.inertial import Rates
from vio.errors import DataError
from vio.filters.imu_terms import CHOSEN, IMU_TERMS, ImuTerms, calibrated, term_sigmas
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_inverse, se3_log, so3_exp
from vio.imu.preintegration import BodyStates, Preintegrated, Readings, preintegrate
from vio.imu.settings import DEFAULT_IMU
from vio.numerics.kinds import Tolerance
from vio.numerics.least_squares import Damping
from vio.numerics.robust import median
from vio.records import NS_PER_S, ImuDensities, ImuRecord, IntArray
from vio.targets.imu_checks import check_imu

_STATE = 15  # of a view: xi of its pose, velocity, biases
_SHARED = 9  # xi of `T_cam0_imu exp(xi)`, time, two turns of gravity; then the IMU's terms


class _Iterations(NamedTuple):
    """Steps of the adjustment."""

    max_steps: Tolerance[int] = 20
    converged_share: Tolerance[float] = 1e-5  # relative change of the cost
    numeric_step: Tolerance[float] = 1e-6
    term_step: Tolerance[float] = 1e-4
    gauge_weight: Tolerance[float] = 1e-9
    max_damping: Tolerance[float] = 1e6


_ITERATIONS = _Iterations()


class _ViewRules(NamedTuple):
    """How much a view counts."""

    min_views: int = 20
    max_step_s: float = 1.0  # between views from which rates are taken for the start
    # chi-square over its degrees of freedom at which a view's weight is a quarter
    quarter_chi: float = 9.0
    min_mean_chi: float = 1.0


_VIEWS = _ViewRules()
_MAX_CHI = 4.0  # squared residuals over those expected, beyond which they are named
_HOPELESS_DEG = 10.0  # standard deviation of a rotation that then says nothing
_BIAS_SIGMA = np.repeat([0.1, 0.5], 3)  # at the first view, rad/s and m/s^2


class _WeakRules(NamedTuple):
    """Standard deviations beyond which a quantity is called weak."""

    rotation_deg: float = 0.2  # standard deviations beyond which a quantity is called weak
    translation_m: float = 0.005
    time_s: float = 1e-3


_WEAK = _WeakRules()


class _SizeRules(NamedTuple):
    """When the board's size is off."""

    min_sigmas: float = 4.0  # by which the board's size must be off to be named
    min_share: float = 0.02  # and by how much: accelerometers are off by 1 %


_SIZE = _SizeRules()


class _DriftRules(NamedTuple):
    """When the clocks drift against each other."""

    min_sigmas: float = 5.0
    min_s: float = 1e-3  # over the record


_DRIFT = _DriftRules()


@dataclass(frozen=True, slots=True)
class BoardPoses:
    """The board as the left camera saw it."""

    times_ns: IntArray  # (K,) by the camera's clock
    T_cam0_board: FloatArray  # (K, 4, 4)
    information: FloatArray  # (K, 6, 6) of xi in `exp(xi) T_cam0_board`, by the corners' noise
    xi_D_lens: FloatArray  # (K, 6, S) likewise by the unknowns that all views share, see `Layout`
    lens_covariance: FloatArray  # (S, S) of those


@dataclass(frozen=True, slots=True)
class CameraImu:
    """A camera and an IMU as calibrated."""

    T_cam0_imu: FloatArray  # (4, 4)
    time_offset_s: float  # a frame stamped t was exposed at t + offset of the IMU's clock
    gyro_bias: FloatArray  # (3,) rad/s, at the first view
    accel_bias: FloatArray  # (3,) m/s^2
    up_board: FloatArray  # (3,) unit vector against gravity in the board's frame
    covariance: FloatArray  # (7, 7) of xi in `T_cam0_imu exp(xi)`, [rho; phi], and the time offset
    # squared whitened residuals over degrees of freedom, or of the poses alone, where more; 1
    # expected; more inflates the covariance
    chi: float
    views: int
    weak: tuple[str, ...]  # what the motion hardly shows or contradicts, with what to record
    terms: FloatArray  # (15,) scale and misalignment, see `vio.records.IMU_ENTRIES`
    term_sigmas: FloatArray  # (15,) 0: not estimated
    board_scale: float  # size of the board as the IMU sees it over that of the file
    board_scale_sigma: float


@dataclass(frozen=True, slots=True)
class _States:
    body: BodyStates
    T_cam0_imu: FloatArray
    offset_s: float
    R_world_board: FloatArray  # (3, 3) the world's z axis is up
    terms: FloatArray  # (15,) scale and misalignment of the IMU


@dataclass(frozen=True, slots=True)
class _Motions:
    """What the IMU measured between the views, and how that follows its terms."""

    steps: Preintegrated
    terms: FloatArray  # (15,) with which it was integrated
    r_D_terms: FloatArray  # (F, 9, T) of the residuals by those that are estimated


def calibrate_imu(
    poses: BoardPoses,
    imu: ImuRecord,
    densities: ImuDensities,
    gravity_mps2: float = DEFAULT_IMU.gravity_mps2,
    terms: ImuTerms = "off",
) -> CameraImu:
    """Calibrate a camera and an IMU.

    Args:
        poses: of the board.
        imu: its samples.
        densities: its noise.
        gravity_mps2: strength of gravity.
        terms: which of the IMU's scales and misalignments are estimated, see
            `vio.filters.imu_terms`.

    Raises:
        DataError: units, axes, signs or stamps of the IMU are wrong, too few views lie within its
            record, the motion shows no rotation, or IMU and poses contradict each other.
    """
    offset_s = check_imu(poses.times_ns, poses.T_cam0_board, _rotation_sigma(poses), imu)
    apart_ns = round(NS_PER_S * offset_s)
    at_imu = replace(poses, times_ns=poses.times_ns + apart_ns)
    problem = _Problem(at_imu, imu, densities, gravity_mps2, CHOSEN[terms])
    found = problem.result(problem.solve(problem.start()))
    if not apart_ns:
        return found
    offset_s = found.time_offset_s + apart_ns / NS_PER_S
    return replace(found, time_offset_s=offset_s, weak=(*found.weak, _clocks_apart(offset_s)))


class _Problem:
    def __init__(
        self,
        poses: BoardPoses,
        imu: ImuRecord,
        densities: ImuDensities,
        gravity: float,
        chosen: IntArray,
    ) -> None:
        self._chosen = chosen  # (T,) terms of the IMU that are estimated
        self._shared = _SHARED + len(chosen)
        self._r_D_terms: FloatArray | None = None
        self._origin = int(imu.times_ns[0])
        inside = (poses.times_ns > imu.times_ns[0]) & (poses.times_ns < imu.times_ns[-1])
        if inside.sum() < _VIEWS.min_views:
            raise DataError(
                f"{int(inside.sum())} views of the board lie within the IMU's record, and "
                f"{_VIEWS.min_views} are needed: check that both clocks are one and in nanoseconds, and "
                "record a minute of the board with images and IMU"
            )
        self.poses = BoardPoses(
            poses.times_ns[inside],
            poses.T_cam0_board[inside],
            poses.information[inside],
            poses.xi_D_lens[inside],
            poses.lens_covariance,
        )
        self._imu = imu
        self._gravity = gravity
        seconds = _seconds(imu.times_ns, self._origin)
        self._readings = Readings(seconds, imu.gyro, imu.accel, densities)
        self._seconds = _seconds(self.poses.times_ns, self._origin)
        self._root = np.swapaxes(np.linalg.cholesky(self.poses.information), 1, 2)

    def start(self) -> _States:
        """Return states from the rotations and the mean force."""
        T_board_cam = se3_inverse(self.poses.T_cam0_board)
        steps = np.diff(self._seconds)
        frames = np.flatnonzero(steps < _VIEWS.max_step_s)
        moved = se3_inverse(T_board_cam[frames]) @ T_board_cam[frames + 1]
        twists = se3_log(moved) / steps[frames, None]
        motion = CameraMotion(self.poses.times_ns, frames, twists)
        rates = Rates(self._imu.times_ns, self._imu.gyro, self._imu.accel, True)
        found = align_gyro(motion, rates)
        if isinstance(found, NotObservable):
            raise DataError(
                f"{found}: turn the rig about all three axes before the board, quickly but without "
                "blur, and move it to and fro"
            )
        T_cam0_imu = se3_from_parts(found.R_cam0_imu, np.zeros(3))
        T_board_imu = T_board_cam @ T_cam0_imu
        at = self._seconds + found.time_offset_s
        force = self._at(self._imu.accel, at)
        up = np.einsum("kij,kj->i", T_board_imu[:, :3, :3], force)
        R_world_board = _turn_to_z(up / np.linalg.norm(up))
        T_world_imu = se3_from_parts(R_world_board, np.zeros(3)) @ T_board_imu
        velocity = np.gradient(T_world_imu[:, :3, 3], self._seconds, axis=0)
        bias = np.zeros((len(at), 6))
        bias[:, :3] = found.gyro_bias
        body = BodyStates(T_world_imu, velocity, bias)
        return _States(body, T_cam0_imu, found.time_offset_s, R_world_board, np.zeros(IMU_TERMS))

    def _at(self, values: FloatArray, seconds: FloatArray) -> FloatArray:
        t = self._readings.seconds
        return np.stack([np.interp(seconds, t, values[:, k]) for k in range(3)], axis=1)

    def solve(self, at: _States) -> _States:
        """Return the optimum, by Levenberg-Marquardt."""
        damping = Damping(_ITERATIONS.max_damping)
        before = np.inf
        for _ in range(_ITERATIONS.max_steps):
            steps = self._motions(at)
            weight = self._weights(at)
            H, g, cost = self._system(at, steps, weight)
            new = damping.step(
                partial(self._after_step, at, H, g),
                partial(self._cost, steps=steps, w=weight),
                cost,
            )
            if new is None:
                return at
            at = self._with_offset_applied(new[0])
            if abs(before - cost) < _ITERATIONS.converged_share * cost:
                return at
            before = cost
        return at

    def _after_step(
        self, at: _States, H: csc_matrix, g: FloatArray, damping: float
    ) -> tuple[_States, float]:
        return self._moved(at, splu(csc_matrix(H + damping * _diagonal(H))).solve(g))

    def _preintegrated(self, at: _States) -> Preintegrated:
        seconds = self._seconds + at.offset_s
        readings = self._readings
        if len(self._chosen):
            both = calibrated(np.concatenate([readings.gyro, readings.accel], axis=1), at.terms)
            readings = replace(readings, gyro=both[:, :3], accel=both[:, 3:])
        return preintegrate(readings, seconds[:-1], seconds[1:], at.body.bias[:-1])

    def _motions(self, at: _States) -> _Motions:
        steps = self._preintegrated(at)
        if self._r_D_terms is None:
            # They hardly depend on the states.
            i = at.body.take(slice(None, -1))
            j = at.body.take(slice(1, None))
            before = steps.residual(i, j, self._gravity)
            self._r_D_terms = np.zeros((*before.shape, len(self._chosen)))
            for k, term in enumerate(self._chosen.tolist()):
                moved = replace(
                    at, terms=at.terms + _ITERATIONS.term_step * np.eye(IMU_TERMS)[term]
                )
                after = self._preintegrated(moved).residual(i, j, self._gravity)
                self._r_D_terms[:, :, k] = (after - before) / _ITERATIONS.term_step
        return _Motions(steps, at.terms, self._r_D_terms)

    def _moved(self, at: _States, x: FloatArray) -> tuple[_States, float]:
        K = len(self._seconds)
        shared = x[_STATE * K :]
        turn = so3_exp(np.array([shared[7], shared[8], 0.0]))
        terms = at.terms.copy()
        terms[self._chosen] += shared[_SHARED:]
        states = _States(
            at.body.moved(x[: _STATE * K].reshape(K, _STATE)),
            at.T_cam0_imu @ se3_exp(shared[:6]),
            at.offset_s,
            turn @ at.R_world_board,
            terms,
        )
        return states, float(shared[6])

    def _twists(self, at: _States) -> FloatArray:
        gyro = self._at(self._imu.gyro, self._seconds + at.offset_s)
        R = at.body.T_world_imu[:, :3, :3]
        v = np.einsum("kji,kj->ki", R, at.body.velocity)
        return np.concatenate([v, gyro - at.body.bias[:, :3]], axis=1)

    def _with_offset_applied(self, moved: tuple[_States, float]) -> _States:
        """Return states at the exposures by the time offset that a step has found."""
        at, late_s = moved
        twists = self._twists(at)
        body = replace(at.body, T_world_imu=at.body.T_world_imu @ se3_exp(late_s * twists))
        return replace(at, body=body, offset_s=at.offset_s + late_s)

    def _camera(
        self, at: _States, late_s: float | FloatArray = 0.0, scale: float = 1.0
    ) -> FloatArray:
        """Whitened residuals (K, 6) of the board's poses, exposed late by a time, or by one for
        each view (K,), of a board that is larger than its description.
        """
        T_world_imu = at.body.T_world_imu @ se3_exp(
            np.asarray(late_s)[..., None] * self._twists(at)
        )
        T_world_board = se3_from_parts(at.R_world_board, np.zeros(3))
        expected = at.T_cam0_imu @ se3_inverse(T_world_imu) @ T_world_board
        measured = self.poses.T_cam0_board.copy()
        measured[:, :3, 3] *= scale
        r = se3_log(measured @ se3_inverse(expected))
        return np.asarray(np.einsum("kij,kj->ki", self._root, r))

    def _pose_scale(self, at: _States) -> float:
        """Factor by which the variances of the poses are larger than stated."""
        chi = np.mean(self._camera(at) ** 2, axis=1)
        return max(float(np.median(chi)), _VIEWS.min_mean_chi)

    def _weights(self, at: _States) -> FloatArray:
        chi = np.mean(self._camera(at) ** 2, axis=1)
        scale = self._pose_scale(at)
        return np.asarray(1 / (1 + chi / (_VIEWS.quarter_chi * scale)) / np.sqrt(scale))

    def _inertial(self, at: _States, motions: _Motions) -> FloatArray:
        i = at.body.take(slice(None, -1))
        j = at.body.take(slice(1, None))
        r = motions.steps.residual(i, j, self._gravity)
        if len(self._chosen):
            r = r + motions.r_D_terms @ (at.terms - motions.terms)[self._chosen]
        return np.asarray(np.einsum("fij,fj->fi", _whitening(motions.steps.covariance), r))

    def _walk_sigmas(self) -> FloatArray:
        d = self._readings.densities
        return np.sqrt(np.diff(self._seconds))[:, None] * np.repeat([d.gyro_walk, d.accel_walk], 3)

    def _cost(self, moved: tuple[_States, float], steps: _Motions, w: FloatArray) -> float:
        at, late_s = moved
        cost = float(np.sum((w[:, None] * self._camera(at, late_s)) ** 2))
        cost += float(np.sum(self._inertial(at, steps) ** 2))
        cost += float(np.sum((np.diff(at.body.bias, axis=0) / self._walk_sigmas()) ** 2))
        cost += float(np.sum((at.terms[self._chosen] / term_sigmas()[self._chosen]) ** 2))
        return cost + float(np.sum((at.body.bias[0] / _BIAS_SIGMA) ** 2))

    def _camera_jacobian(self, at: _States) -> tuple[FloatArray, FloatArray]:
        """Derivatives (K, 6, 15) and (K, 6, 9) of the whitened residuals, by differences."""
        K = len(self._seconds)
        own = np.zeros((K, 6, _STATE))
        shared = np.zeros((K, 6, _SHARED))
        for k in range(_STATE + _SHARED):
            ends = []
            for sign in (1.0, -1.0):
                x = np.zeros(_STATE * K + self._shared)
                step = sign * _ITERATIONS.numeric_step
                if k < _STATE:
                    x[k : _STATE * K : _STATE] = step
                else:
                    x[_STATE * K + k - _STATE] = step
                ends.append(self._camera(*self._moved(at, x)))
            D = (ends[0] - ends[1]) / (2 * _ITERATIONS.numeric_step)
            if k < _STATE:
                own[:, :, k] = D
            else:
                shared[:, :, k - _STATE] = D
        return own, shared

    def _system(
        self, at: _States, motions: _Motions, w: FloatArray, further: FloatArray | None = None
    ) -> tuple[csc_matrix, FloatArray, float]:
        """Normal equations; `further`: derivatives (K, 6, E) of the poses' whitened residuals by
        unknowns that come last.
        """
        steps = motions.steps
        K = len(self._seconds)
        extra = 0 if further is None else further.shape[2]
        rows = _Rows(_STATE * K + self._shared + extra)
        own, shared = self._camera_jacobian(at)
        scale = w[:, None, None]
        states = np.arange(K)
        common = np.tile(_STATE * K + np.arange(_SHARED), (K, 1))
        columns = _STATE * states[:, None] + np.arange(_STATE)
        blocks = [(columns, scale * own), (common, scale * shared)]
        if further is not None:
            last = np.tile(_STATE * K + self._shared + np.arange(extra), (K, 1))
            blocks.append((last, scale * further))
        rows.add(w[:, None] * self._camera(at), blocks)
        r, A, B = steps.linearised(
            at.body.take(slice(None, -1)), at.body.take(slice(1, None)), self._gravity
        )
        W = _whitening(steps.covariance)
        r = np.einsum("fij,fj->fi", W, r)
        blocks = [
            (columns[:-1], W @ A),
            (columns[1:], W @ B),
        ]
        if len(self._chosen):
            term_columns = _STATE * K + _SHARED + np.arange(len(self._chosen))
            blocks.append((np.tile(term_columns, (K - 1, 1)), W @ motions.r_D_terms))
            sigma = term_sigmas()[self._chosen]
            prior = np.diag(1 / sigma)[None]
            rows.add((at.terms[self._chosen] / sigma)[None], [(term_columns[None], prior)])
        rows.add(r, blocks)
        inverse = 1 / self._walk_sigmas()
        change = np.diff(at.body.bias, axis=0) * inverse
        D = inverse[:, :, None] * np.eye(6)
        rows.add(
            change,
            [
                (columns[:-1, 9:], -D),
                (columns[1:, 9:], D),
            ],
        )
        rows.add(
            (at.body.bias[:1] / _BIAS_SIGMA), [(columns[:1, 9:], np.diag(1 / _BIAS_SIGMA)[None])]
        )
        return rows.normal()

    def result(self, at: _States) -> CameraImu:
        """Return the calibration with its covariance.

        Raises:
            DataError: camera and IMU contradict each other.
        """
        motions = self._motions(at)
        weight = self._weights(at)
        by_lens = self._root @ self.poses.xi_D_lens
        extras = (self._camera_by_scale(at), self._camera_by_drift(at))
        further = np.concatenate([*extras, by_lens], axis=2)
        H, g, cost = self._system(at, motions, weight, further)
        chi = cost / self._freedom()
        worst_chi = max(chi, self._pose_scale(at))
        shared = self._shared_covariance(H, self._shared, chi)
        P = shared[:7, :7]
        rotation_deg = float(np.degrees(np.sqrt(np.diag(P)[3:6].max())))
        if worst_chi > _MAX_CHI and rotation_deg > _HOPELESS_DEG:
            raise DataError(
                f"the IMU cannot be used: it contradicts the board's poses {np.sqrt(worst_chi):.0f} "
                "times more than its noise explains: an axis may be dead, clipped or of another "
                "unit than the others, or samples are missing"
            )
        sigmas = np.zeros(IMU_TERMS)
        sigmas[self._chosen] = np.sqrt(np.diag(shared)[_SHARED:])
        off, off_sigma = self._extra(H, g, 0, chi)
        drift, drift_sigma = self._extra(H, g, 1, chi)
        return CameraImu(
            at.T_cam0_imu,
            at.offset_s,
            at.body.bias[0, :3],
            at.body.bias[0, 3:],
            at.R_world_board[2],
            P,
            worst_chi,
            len(self._seconds),
            (
                *_disagreement_findings(worst_chi),
                *_drift_findings(drift, drift_sigma, float(np.ptp(self._seconds))),
                *_size_findings(off, off_sigma),
                *_weak(np.sqrt(np.diag(P))),
            ),
            at.terms,
            sigmas,
            1 + off,
            off_sigma,
        )

    def _camera_by_scale(self, at: _States) -> FloatArray:
        """Derivative (K, 6, 1) of the poses' whitened residuals by the board's scale."""
        ends = [self._camera(at, scale=1 + sign * _ITERATIONS.numeric_step) for sign in (1.0, -1.0)]
        return np.asarray((ends[0] - ends[1]) / (2 * _ITERATIONS.numeric_step))[:, :, None]

    def _camera_by_drift(self, at: _States) -> FloatArray:
        """Derivative (K, 6, 1) of the poses' whitened residuals by the rate of one clock against
        the other, about the middle of the record.
        """
        from_middle = self._seconds - self._seconds.mean()
        ends = [self._camera(at, sign * _ITERATIONS.numeric_step * from_middle) for sign in (1, -1)]
        return np.asarray((ends[0] - ends[1]) / (2 * _ITERATIONS.numeric_step))[:, :, None]

    def _extra(self, H: csc_matrix, g: FloatArray, which: int, chi: float) -> tuple[float, float]:
        """Return an unknown that was taken as zero, and its standard deviation, if it were free
        alone.

        Args:
            H: normal equations, the extra unknowns and the lens last.
            g: their right-hand side.
            which: of the extra unknowns.
            chi: as `_shared_covariance` takes it.
        """
        count = _STATE * len(self._seconds) + self._shared
        order = np.arange(H.shape[0])
        order[[count, count + which]] = order[[count + which, count]]
        turned = H[order][:, order]
        free = order[: count + 1]
        value = float(splu(H[free][:, free].tocsc()).solve(g[free])[-1])
        variance = self._shared_covariance(turned, self._shared + 1, chi)[-1, -1]
        return value, float(np.sqrt(variance))

    def _freedom(self) -> int:
        """Residuals of poses, motions, bias walks and priors, less the unknowns."""
        steps = len(self._seconds) - 1
        residuals = 6 * len(self._seconds) + (9 + 6) * steps + 6 + len(self._chosen)
        return residuals - _STATE * len(self._seconds) - self._shared

    def _shared_covariance(self, H: csc_matrix, count: int, chi: float) -> FloatArray:
        """Covariance of the unknowns (count,) that follow the views' states.

        Noise of corners and IMU averages out over the views. An error of the lens does not: all
        poses have it in common, so its effect on the optimum is added.

        Args:
            H: normal equations, extra unknowns and the lens last.
            count: of the unknowns, those behind them taken as known.
            chi: squared residuals over those expected, by which noise is inflated.
        """
        first = _STATE * len(self._seconds)
        free = first + count
        lens = H.shape[0] - len(self.poses.lens_covariance)
        wanted = np.zeros((free, count))
        wanted[first + np.arange(count), np.arange(count)] = 1
        solved = splu(H[:free, :free].tocsc()).solve(wanted)
        by_lens = -solved.T @ H[:free, lens:].toarray()
        P = max(chi, 1.0) * solved[first:] + by_lens @ self.poses.lens_covariance @ by_lens.T
        return np.asarray(0.5 * (P + P.T))


def _seconds(times_ns: IntArray, origin_ns: int) -> FloatArray:
    return np.asarray((times_ns - origin_ns) * 1e-9, dtype=np.float64)


def _rotation_sigma(poses: BoardPoses) -> float:
    """Standard deviation in radians of the board's usual rotation about one axis."""
    information = median(np.trace(poses.information[:, 3:, 3:], axis1=1, axis2=2) / 3)
    return float(1 / np.sqrt(information))


def _clocks_apart(offset_s: float) -> str:
    return (
        f"the IMU's clock is ahead of the camera's by {offset_s:+.3f} s: check which moments both "
        "stamp, and that the offset is the same in every recording"
    )


def _weak(sigma: FloatArray) -> tuple[str, ...]:
    """Return what the motion hardly shows."""
    out: list[str] = []
    for k, axis in enumerate("xyz"):
        if sigma[k] > _WEAK.translation_m:
            out.append(
                f"the IMU's position along its {axis} is known to {1e3 * sigma[k]:.0f} mm: turn "
                "the rig faster, about the other two axes"
            )
        if np.degrees(sigma[3 + k]) > _WEAK.rotation_deg:
            out.append(
                f"the rotation about the IMU's {axis} is known to "
                f"{np.degrees(sigma[3 + k]):.2f} deg: turn the rig about the other axes, too"
            )
    if sigma[6] > _WEAK.time_s:
        out.append(f"the time offset is known to {1e3 * sigma[6]:.1f} ms: turn the rig faster")
    return tuple(out)


def _drift_findings(drift: float, sigma: float, seconds: float) -> tuple[str, ...]:
    """Return whether one clock is faster than the other."""
    apart_s = abs(drift) * seconds
    if abs(drift) < _DRIFT.min_sigmas * sigma or apart_s < _DRIFT.min_s:
        return ()
    word = "slower" if drift > 0 else "faster"
    return (
        f"the camera's clock is {1e6 * abs(drift):.0f} ± {1e6 * sigma:.0f} ppm {word} than the IMU's, "
        f"{1e3 * apart_s:.1f} ms over the record: stamp both by one clock, and by measured times, "
        "not by nominal rates",
    )


def _disagreement_findings(chi: float) -> tuple[str, ...]:
    """Return whether camera and IMU differ by much more than their noise explains."""
    if chi < _MAX_CHI:
        return ()
    return (
        f"camera and IMU differ {np.sqrt(chi):.1f} times more than their noise explains (stated "
        "noise too small, axes whose scale is off, vibration, rolling shutter, or unsteady "
        "stamps), and the standard deviations may be too small: give the noise by --imu-noise, or "
        "estimate scales by --imu-terms scale",
    )


def _size_findings(off: float, sigma: float) -> tuple[str, ...]:
    """Return whether the IMU sees a board of another size."""
    if abs(off) < max(_SIZE.min_sigmas * sigma, _SIZE.min_share):
        return ()
    word = "larger" if off > 0 else "smaller"
    return (
        f"by the IMU the board is {100 * abs(off):.1f} ± {100 * sigma:.1f} % {word} than in the "
        "target file: measure the side of a tag or square, and give it by --size; if it is right, "
        "the accelerometer's scale is off (--imu-terms scale)",
    )


def _turn_to_z(up: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) that brings a unit vector to the z axis by the shortest way."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        if up[2] > 0:
            return np.eye(3)
        return np.diag([1.0, -1.0, -1.0])
    return so3_exp(axis / sine * np.arctan2(sine, up[2]))


def _whitening(covariance: FloatArray) -> FloatArray:
    """Matrices (F, 9, 9) that whiten residuals of these covariances."""
    floor = 1e-16 * np.eye(covariance.shape[1])
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance + floor)))


def _diagonal(H: csc_matrix) -> csc_matrix:
    values = np.maximum(H.diagonal(), _ITERATIONS.gauge_weight)
    index: npt.NDArray[np.int64] = np.arange(len(values))
    return csc_matrix((values, (index, index)), shape=H.shape)


class _Rows:
    """Residuals and the blocks of their derivatives, for normal equations."""

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self._rows = 0
        self._residuals: list[FloatArray] = []
        self._parts: list[tuple[IntArray, IntArray, FloatArray]] = []

    def add(self, r: FloatArray, blocks: list[tuple[IntArray, FloatArray]]) -> None:
        """Add residuals (F, m), and derivatives (F, m, n) by columns (F, n)."""
        count, size = r.shape
        rows = self._rows + np.arange(count * size).reshape(count, size)
        for columns, D in blocks:
            at = np.broadcast_to(rows[:, :, None], D.shape)
            by = np.broadcast_to(columns[:, None, :], D.shape)
            self._parts.append((at.ravel(), by.ravel(), np.asarray(D).ravel()))
        self._residuals.append(r.ravel())
        self._rows += count * size

    def normal(self) -> tuple[csc_matrix, FloatArray, float]:
        """Return H, the right-hand side of the step, and the sum of squares."""
        at, by, values = (np.concatenate([part[k] for part in self._parts]) for k in range(3))
        J = coo_matrix((values, (at, by)), shape=(self._rows, self._columns)).tocsc()
        r = np.concatenate(self._residuals)
        H = csc_matrix(J.T @ J)
        return H + _ITERATIONS.gauge_weight * _eye(self._columns), -(J.T @ r), float(r @ r)


def _eye(size: int) -> csc_matrix:
    index: npt.NDArray[np.int64] = np.arange(size)
    return csc_matrix((np.ones(size), (index, index)), shape=(size, size))
