"""Continuous motion: a B-spline for the position and a cumulative B-spline on SO(3) for the
attitude.

Degree 5 with uniform knots, so velocity, acceleration and angular rate are analytic.
Reference: Sommer, Usenko, Schubert, Demmel, Cremers, Efficient derivative computation for
cumulative B-splines on Lie
groups (2020): cumulative basis, and the recurrence of the angular rate.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cache
from math import comb, factorial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.sparse.linalg

from vio.errors import DataError, SimulationError
from vio.files.text import check_increasing
from vio.files.trajectories import read_trajectory
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp, so3_log
from vio.numerics.kinds import Tolerance
from vio.records import S_PER_NS, BoolArray, IntArray

logger = logging.getLogger(__name__)

_DEGREE = 5
_K = _DEGREE + 1  # control points that a pose depends on


@dataclass(frozen=True, slots=True)
class _CarMotion:
    """How a simulated car and a hand-held rig begin to move."""

    speed_mps: float = 10.0  # of a car on straights
    acceleration_mps2: float = 2.0  # of a car along the road, at most
    ramp_s: float = 2.0  # from standstill to full speed of a hand-held rig


_CAR = _CarMotion()


@dataclass(frozen=True, slots=True)
class _SmoothingRules:
    """How poses are smoothed to a spline."""

    robust_steps: Tolerance[int] = 8
    outlier_sigmas: float = 5.0
    outlier_floor: tuple[float, float] = (
        0.002,
        0.01,
    )  # m, rad: smaller residuals are smoothing, not outliers
    rotation_steps: Tolerance[int] = 12
    rotation_tolerance_rad: Tolerance[float] = 1e-10


_SMOOTHING = _SmoothingRules()


@dataclass(frozen=True, slots=True)
class MotionSpline:
    """A body's motion: uniform B-splines, defined from `start_ns` to `end_ns`."""

    start_ns: int
    knot_s: float  # seconds between knots
    p_control: FloatArray  # (M, 3) control positions, world, m
    R_control: FloatArray  # (M, 3, 3) control attitudes R_world_imu

    @property
    def end_ns(self) -> int:
        """Last nanosecond at which the motion is defined."""
        return self.start_ns + int(
            np.floor((len(self.p_control) - _DEGREE) * self.knot_s / S_PER_NS)
        )


@dataclass(frozen=True, slots=True)
class MotionState:
    """A motion at N times."""

    time_ns: IntArray  # (N,)
    T_world_imu: FloatArray  # (N, 4, 4)
    velocity_world: FloatArray  # (N, 3) m/s
    acceleration_world: FloatArray  # (N, 3) m/s^2, without gravity
    angular_velocity: FloatArray  # (N, 3) rad/s, imu frame


@dataclass(frozen=True, slots=True)
class FitReport:
    """Residuals of a fitted spline."""

    samples: int
    rejected: int  # samples rejected as outliers
    position_rms_m: float  # over the samples kept
    position_max_m: float
    rotation_rms_rad: float
    rotation_max_rad: float


@cache
def _blending() -> FloatArray:
    """Matrix (6, 6) of the uniform B-spline: row i, column j is the factor of u^j in the weight of
    control point i.

    Reference: Qin, General matrix representations for B-splines (1998), as given by Sommer et al.
    """
    out = np.zeros((_K, _K))
    for s, n in np.ndindex(_K, _K):
        total = sum(
            (-1.0) ** (i - s) * comb(_K, i - s) * float(_K - 1 - i) ** (_K - 1 - n)
            for i in range(s, _K)
        )
        out[s, n] = comb(_K - 1, n) / factorial(_K - 1) * total
    return out


def _weights(u: FloatArray, derivative: int) -> FloatArray:
    """Weights (N, 6) of the control points at fractions u (N,) of a knot interval, or their
    derivative in u.
    """
    powers = np.zeros((len(u), _K))
    for n in range(derivative, _K):
        powers[:, n] = factorial(n) / factorial(n - derivative) * u ** (n - derivative)
    return powers @ _blending().T


def _locate(spline: MotionSpline, times_ns: npt.ArrayLike) -> tuple[IntArray, IntArray, FloatArray]:
    """Times (N,), first control point (N,) and fraction (N,) of each."""
    t = np.atleast_1d(np.asarray(times_ns, dtype=np.int64))
    if len(t) and (t.min() < spline.start_ns or t.max() > spline.end_ns):
        raise SimulationError(
            f"the motion is defined from {spline.start_ns} to {spline.end_ns} ns; "
            f"requested {t.min()} to {t.max()}: shorten the request or lengthen the trajectory"
        )
    position: FloatArray = np.multiply(
        t - spline.start_ns, S_PER_NS / spline.knot_s, dtype=np.float64
    )
    segments = len(spline.p_control) - _DEGREE
    first = np.clip(np.floor(position).astype(np.int64), 0, segments - 1)
    return t, first, position - first


def motion_at(spline: MotionSpline, times_ns: npt.ArrayLike) -> MotionState:
    """Pose, velocities and acceleration at times (N,) in nanoseconds.

    Raises:
        SimulationError: a time is outside the motion.
    """
    t, first, u = _locate(spline, times_ns)
    index = first[:, None] + np.arange(_K)
    rate = 1 / spline.knot_s
    weights = [_weights(u, derivative) * rate**derivative for derivative in range(3)]
    p, v, a = (np.einsum("nk,nki->ni", w, spline.p_control[index]) for w in weights)
    # Cumulative weights: the sum of the weights from j on.
    b, b1 = (np.cumsum(w[:, ::-1], axis=1)[:, ::-1] for w in weights[:2])
    R_control = spline.R_control[index]
    R = R_control[:, 0]
    omega = np.zeros((len(t), 3))
    for j in range(1, _K):
        d = so3_log(np.swapaxes(R_control[:, j - 1], 1, 2) @ R_control[:, j])
        A = so3_exp(b[:, j, None] * d)
        R = R @ A
        turned = (np.swapaxes(A, 1, 2) @ omega[..., None])[..., 0]
        omega = turned + b1[:, j, None] * d
    return MotionState(t, se3_from_parts(R, p), v, a, omega)


def fit_spline(
    times_ns: npt.ArrayLike,
    T_world_imu: npt.ArrayLike,
    *,
    knot_s: float = 0.1,
    robust: bool = False,
) -> tuple[MotionSpline, FitReport]:
    """Fit a spline to poses (N, 4, 4) at strictly increasing times (N,) by least squares.

    The attitude is fitted by Gauss-Newton steps: the residual rotation vectors are fitted like a
    position and moved into the control attitudes. With `robust`, samples farther than 5 robust
    standard deviations (and 2 mm or 10 mrad) are rejected.

    Raises:
        DataError: times do not increase, values are not finite, or there are too few poses.
    """
    t, T = _check_record(times_ns, T_world_imu)
    span = (t[-1] - t[0]) * S_PER_NS
    segments = max(1, int(np.ceil(span / knot_s - 1e-9)))
    step = span / segments * (1 + 1e-12)
    position = np.minimum((t - t[0]) * S_PER_NS / step, segments - 1e-9)
    first = np.floor(position).astype(np.int64)
    weights = _weights(position - first, 0)
    columns = (first[:, None] + np.arange(_K)).ravel()
    places = np.repeat(np.arange(len(t)), _K), columns
    design = scipy.sparse.csr_matrix((weights.ravel(), places), shape=(len(t), segments + _DEGREE))
    keep = np.ones(len(t), dtype=np.bool_)
    p_control, R_control = _fit(design, T, keep)

    def residuals() -> tuple[FloatArray, FloatArray]:
        """Distances (N,) in metres and angles (N,) in radians between spline and samples."""
        R = _attitude(R_control, first, weights)
        distance = np.linalg.norm(design @ p_control - T[:, :3, 3], axis=1)
        R_difference = np.swapaxes(R, 1, 2) @ T[:, :3, :3]
        return distance, np.linalg.norm(so3_log(R_difference), axis=1)

    distance, angle = residuals()
    for _ in range(_SMOOTHING.robust_steps if robust else 0):
        good = (distance < _limit(distance[keep], _SMOOTHING.outlier_floor[0])) & (
            angle < _limit(angle[keep], _SMOOTHING.outlier_floor[1])
        )
        if np.array_equal(good, keep):
            break
        keep = good
        p_control, R_control = _fit(design, T, keep)
        distance, angle = residuals()
    spline = MotionSpline(int(t[0]), step, p_control, R_control)
    left = [
        (float(np.sqrt(np.mean(r[keep] ** 2))), float(r[keep].max())) for r in (distance, angle)
    ]
    return spline, FitReport(len(t), int((~keep).sum()), *left[0], *left[1])


def _check_record(
    times_ns: npt.ArrayLike, T_world_imu: npt.ArrayLike
) -> tuple[IntArray, FloatArray]:
    t = np.asarray(times_ns, dtype=np.int64).reshape(-1)
    T = np.asarray(T_world_imu, dtype=np.float64)
    if T.shape != (len(t), 4, 4):
        raise DataError(
            f"{len(t)} times for poses of shape {T.shape}; give one 4x4 pose for each time"
        )
    if len(t) < 2:
        raise DataError(f"a trajectory needs at least two poses, got {len(t)}")
    if not np.all(np.isfinite(T)):
        raise DataError(
            f"pose {int(np.argwhere(~np.isfinite(T))[0, 0])} of the trajectory is not finite; "
            "remove it"
        )
    return check_increasing(t, lambda k: f"pose {k} of the trajectory"), T


def _fit(
    design: scipy.sparse.csr_matrix, T: FloatArray, keep: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Control positions (M, 3) and attitudes (M, 3, 3); a small curvature penalty determines
    them within gaps.
    """
    A = design[keep]
    p = T[keep, :3, 3]
    R = T[keep, :3, :3]
    m = A.shape[1]
    curvature = scipy.sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(m - 2, m))
    smooth = 1e-7 * (curvature.T @ curvature)
    normal = A.T @ A + smooth + 1e-12 * scipy.sparse.identity(m)
    factor = scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(normal))
    middle = p.mean(axis=0)
    p_control = factor.solve(A.T @ (p - middle)) + middle
    # Initialise each control point from the sample nearest to its largest weight.
    sample = np.asarray(A @ np.arange(m, dtype=np.float64)).ravel()
    nearest = (
        np.abs(np.interp(np.arange(m), sample, np.arange(len(sample)))).round().astype(np.int64)
    )
    R_control: FloatArray = R[nearest]
    first = A.indices.reshape(-1, _K)[:, 0]
    weights = A.data.reshape(-1, _K)
    for _ in range(_SMOOTHING.rotation_steps):
        residual = so3_log(np.swapaxes(_attitude(R_control, first, weights), 1, 2) @ R)
        delta = factor.solve(A.T @ residual)
        R_control = R_control @ so3_exp(delta)
        if np.abs(delta).max() < _SMOOTHING.rotation_tolerance_rad:
            break
    return p_control, R_control


def _attitude(R_control: FloatArray, first: IntArray, weights: FloatArray) -> FloatArray:
    """Attitudes (N, 3, 3) of the cumulative spline from plain weights (N, k)."""
    cumulative = np.cumsum(weights[:, ::-1], axis=1)[:, ::-1]
    R = R_control[first]
    for j in range(1, weights.shape[1]):
        before = np.swapaxes(R_control[first + j - 1], 1, 2)
        d = so3_log(before @ R_control[first + j])
        R = R @ so3_exp(cumulative[:, j, None] * d)
    return R


def _limit(kept: FloatArray, floor: float) -> float:
    """Largest residual that still counts as noise."""
    return max(floor, float(_SMOOTHING.outlier_sigmas * 1.4826 * np.median(kept)))


def spline_from_waypoints(
    T_world_imu: npt.ArrayLike, interval_s: float, *, start_ns: int = 0
) -> MotionSpline:
    """Return a smooth motion through waypoints (N, 4, 4) at equal intervals.

    Raises:
        DataError: fewer than two waypoints, or one is not finite.
    """
    T = np.asarray(T_world_imu, dtype=np.float64)
    since_start_ns = np.arange(len(T)) * (interval_s / S_PER_NS)
    times = start_ns + np.round(since_start_ns).astype(np.int64)
    spline, report = fit_spline(times, T, knot_s=interval_s)
    logger.debug(
        "waypoints met within %.2g m, %.2g rad", report.position_max_m, report.rotation_max_rad
    )
    return spline


def rotate_body_axes(spline: MotionSpline, R_body_imu: npt.ArrayLike) -> MotionSpline:
    """Express a body's motion in rotated IMU axes: `R_world_imu = R_world_body R_body_imu`."""
    return replace(spline, R_control=spline.R_control @ np.asarray(R_body_imu, dtype=np.float64))


# --- ready motions
# --------------------------------------------------------------------------------------------------


def look_rotation(forward: npt.ArrayLike) -> FloatArray:
    """Attitudes (..., 3, 3) of a body with x along `forward` (..., 3), y left, z as far up as
    possible.
    """
    x = np.asarray(forward, dtype=np.float64)
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    y = np.cross(np.broadcast_to([0.0, 0.0, 1.0], x.shape), x)
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def car_loop(
    *,
    loop_m: tuple[float, float] = (110.0, 70.0),
    corner_m: float = 7.0,
    duration_s: float | None = None,
    height_m: float = 0.93,
    start_m: float = 0.0,
    seed: int = 0,
    start_ns: int = 0,
) -> MotionSpline:
    """Drive counter-clockwise along a rectangle with rounded corners, slower in them, with small
    suspension motion.

    It drives 10 m/s on the straights; the lateral acceleration in corners is at most 2.5 m/s^2.

    Args:
        loop_m: extent of the centre line along x and y, about the origin; the same as `street`'s.
        corner_m: radius of the corners.
        duration_s: length of the record; None drives one loop.
        height_m: height of the body above the ground; 0.93 puts `kitti_like_rig`'s cameras at 1.65.
        start_m: where on the loop to start, from the middle of the lower side.
        seed: of the small motions of the suspension and the steering.
        start_ns: time of the first pose.
    """
    if corner_m <= 0 or min(loop_m) <= 2 * corner_m:
        raise SimulationError(
            f"corners of {corner_m:g} m do not fit a loop of {loop_m[0]:g} x {loop_m[1]:g} m"
        )
    straight = np.array(loop_m) - 2 * corner_m
    length = 2 * float(straight.sum()) + 2 * np.pi * corner_m
    step = 0.05
    s = np.arange(0.0, length, step)
    curvature = np.zeros(len(s))
    edge = straight[0] / 2
    for side in (straight[1], straight[0], straight[1], straight[0] / 2):
        curvature[(s >= edge) & (s < edge + np.pi / 2 * corner_m)] = 1 / corner_m
        edge += np.pi / 2 * corner_m + side
    speed = np.minimum(_CAR.speed_mps, np.sqrt(2.5 / np.maximum(curvature, 1e-6)))
    speed = _smooth_periodic(_limit_acceleration(speed, step), 6.0 / step)
    curvature = _smooth_periodic(curvature, 2.0 / step)
    heading = np.cumsum(curvature) * step
    heading *= 2 * np.pi / heading[-1]
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    xy = np.cumsum(ahead * step, axis=0)
    xy -= np.linspace(0, 1, len(s))[:, None] * xy[-1]  # close the loop
    xy -= (xy.max(axis=0) + xy.min(axis=0)) / 2
    clock = np.cumsum(step / speed)
    if duration_s is None:
        duration = float(clock[-1])
    else:
        duration = duration_s
    offset = float(np.interp(start_m % length, s, clock))
    t = np.arange(0.0, duration + 0.05, 0.05)
    loops, phase = np.divmod(t + offset, clock[-1])
    where = np.interp(phase, clock, s)
    yaw = np.interp(where, s, heading) + 2 * np.pi * loops
    sway = _sway(t, seed, np.array([0.004, 0.006, 0.004, 0.012]), (0.3, 1.6))
    p = np.stack(
        [*(np.interp(where, s, xy[:, i]) for i in range(2)), height_m + sway[:, 3]], axis=1
    )
    none = 0 * yaw
    turn = np.stack([none, none, yaw + sway[:, 2]], 1)
    tilt = np.stack([sway[:, 0], sway[:, 1], none], 1)
    R = so3_exp(turn) @ so3_exp(tilt)
    times = start_ns + np.round(t / S_PER_NS).astype(np.int64)
    return fit_spline(times, se3_from_parts(R, p), knot_s=0.2)[0]


def _smooth_periodic(values: FloatArray, width: float) -> FloatArray:
    """Convolve with a raised cosine `width` samples wide, around the loop."""
    n = max(3, int(width) | 1)
    kernel = np.hanning(n + 2)[1:-1]
    padded = np.concatenate([values[-n:], values, values[:n]])
    return np.convolve(padded, kernel / kernel.sum(), mode="same")[n:-n]


def _limit_acceleration(speed: FloatArray, step: float) -> FloatArray:
    """Lower speeds so that braking and accelerating stay within a limit, around the loop."""
    square = np.concatenate([speed, speed, speed]) ** 2
    for order in (range(1, len(square)), range(len(square) - 2, -1, -1)):
        shift = -1 if order.step > 0 else 1
        for i in order:
            square[i] = min(square[i], square[i + shift] + 2 * _CAR.acceleration_mps2 * step)
    n = len(speed)
    return np.sqrt(square[n : 2 * n])


def _sway(
    t: FloatArray, seed: int, amplitude: FloatArray, band_hz: tuple[float, float]
) -> FloatArray:
    """Smooth random motions (N, C) of given standard deviations, summed from sines in a
    frequency band.
    """
    rng = np.random.default_rng([seed, 11])
    out = np.zeros((len(t), len(amplitude)))
    for channel, size in enumerate(amplitude):
        frequency = rng.uniform(*band_hz, 8)
        phase = rng.uniform(0, 2 * np.pi, 8)
        waves = np.sin(2 * np.pi * frequency * t[:, None] + phase)
        out[:, channel] = size / 2 * waves.sum(axis=1)
    return out


def hand_held(
    *,
    centre: npt.ArrayLike = (0.0, 0.0, 1.4),
    extent: npt.ArrayLike = (1.6, 1.1, 0.35),
    duration_s: float = 30.0,
    period_s: float = 12.0,
    still_s: float = 0.0,
    seed: int = 0,
    start_ns: int = 0,
) -> MotionSpline:
    """Carry the body around a room: a Lissajous path about `centre`, looking along the path and to
    the sides.

    The IMU axes are forward, left, up; for EuRoC's rig, whose body looks along its z axis, apply
    `rotate_body_axes(spline, R_FLU_EUROC_IMU)`.

    Args:
        centre: middle of the path, m.
        extent: half of the path's size along x, y, z, m.
        duration_s: length of the record.
        period_s: duration of one round.
        still_s: duration of standstill at the start.
        seed: of the phases and of the viewing direction.
        start_ns: time of the first pose.
    """
    t = np.arange(0.0, duration_s + 0.025, 0.025)
    moving = np.maximum(t - still_s, 0.0)
    phase = _ramped_time(moving)
    rng = np.random.default_rng([seed, 12])
    w = 2 * np.pi / period_s
    shift = rng.uniform(0, 2 * np.pi, 3)
    angle = w * phase
    around = angle + shift[0]
    height = np.sin(1.7 * angle + shift[1])
    loop = np.stack([np.cos(around), np.sin(around), height], axis=1)
    p = np.asarray(centre, dtype=np.float64) + np.asarray(extent, dtype=np.float64) * loop
    shake = _sway(phase, seed + 1, np.array([0.06, 0.06, 0.15, 0.012, 0.012, 0.012]), (0.1, 0.7))
    swing = 0.35 * np.sin(0.6 * angle + shift[2])
    yaw = angle + shift[0] + np.pi / 2 + swing
    zero = np.zeros_like(t)
    turn = np.stack([zero, zero, yaw + shake[:, 2]], 1)
    tilt = np.stack([shake[:, 0], shake[:, 1], zero], 1)
    R = so3_exp(turn) @ so3_exp(tilt)
    times = start_ns + np.round(t / S_PER_NS).astype(np.int64)
    return fit_spline(times, se3_from_parts(R, p + shake[:, 3:]), knot_s=0.1)[0]


def _ramped_time(t: FloatArray) -> FloatArray:
    """Warped time: its rate grows smoothly (quintic) from 0 at standstill to 1 over the ramp."""
    u = np.clip(t / _CAR.ramp_s, 0.0, 1.0)
    integral = u**4 * (2.5 + u * (u - 3))  # of 10 u^3 - 15 u^4 + 6 u^5
    return _CAR.ramp_s * integral + np.maximum(t - _CAR.ramp_s, 0.0)


# --- recorded motion
# ------------------------------------------------------------------------------------------------


def recorded_motion(path: Path) -> tuple[MotionSpline, FitReport]:
    """Smooth a recorded ground truth (TUM file of the IMU's poses) so that it is twice
    differentiable.

    Raises:
        DataError: the file cannot be used, or describes the camera; the message names it.
    """
    truth = read_trajectory(path, fmt="tum")
    if truth.body != "imu" or truth.times_ns is None or len(truth) < 2:
        raise DataError(
            f"{path}: describes {len(truth)} poses of {truth.body}; give two or more of the IMU"
        )
    times = truth.times_ns
    gap_s = float(np.diff(times).max()) * S_PER_NS
    if gap_s > 0.5:
        logger.warning("%s has a gap of %.2f s; the motion is interpolated there", path, gap_s)
    spline, report = fit_spline(times, truth.T_world_body, robust=True)
    within = (
        f"{1e3 * report.position_rms_m:.1f} mm and {1e3 * report.rotation_rms_rad:.2f} mrad rms"
    )
    logger.info(
        "%s: spline within %s, %d of %d poses rejected",
        path,
        within,
        report.rejected,
        report.samples,
    )
    return spline, report
