"""The IMU's lever arm: estimated from its accelerometer, or chosen between two candidates by
velocities.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vio.calibration.egomotion import CameraMotion, stereo_twists
from vio.calibration.findings import NotObservable
from vio.calibration.inertial import ImuAlignment, Rates
from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, so3_exp
from vio.geometry.stereo import StereoCamera
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import jackknife, robust_sigma
from vio.records import S_PER_NS, FeatureTracks, IntArray


@dataclass(frozen=True, slots=True)
class _FitRules:
    """How a lever arm is fitted."""

    blocks: Tolerance[int] = 10  # of the jackknife over windows
    max_sigma_m: float = 0.02  # with a larger standard deviation the value is not observable
    window_s: float = 1.0
    min_windows: int = 12
    huber: float = 2.0  # standard deviations
    reweightings: Tolerance[int] = 4
    # keeps the fit solvable where a recording never accelerates or never rotates
    ridge: Tolerance[float] = 1e-9


_FIT = _FitRules()


@dataclass(frozen=True, slots=True)
class _JudgeRules:
    """How two lever arms are compared."""

    min_intervals: int = 40  # frame intervals needed to judge two lever arms
    judged_blocks: Tolerance[int] = 12  # of the jackknife over them
    min_sigma: float = 0.1  # lower bound: a jackknife over few blocks is unreliable below this
    log_odds: float = 10.0  # log-likelihood ratio that decides between two lever arms


_JUDGE = _JudgeRules()


@dataclass(frozen=True, slots=True)
class LeverArm:
    """The IMU's position in the left camera's frame."""

    t_cam0_imu: FloatArray  # (3,) metres
    sigma_m: FloatArray  # (3,)
    windows: int


def estimate_lever_arm(
    motion: CameraMotion, rates: Rates, alignment: ImuAlignment
) -> LeverArm | NotObservable:
    """Estimate the IMU's position in the left camera's frame from accelerometer and camera motion.

    Over windows of one second, the doubly integrated specific force must agree with the camera's
    motion and the lever arm. Start velocity and gravity are free in every window, the accelerometer
    bias is common.
    """
    what = "lever arm"
    if not rates.inertial:
        return NotObservable(what, "the recording contains velocities, no accelerometer")
    if alignment.weak is not None:
        return NotObservable(what, f"the motion leaves unobservable the {alignment.weak}")
    blocks = _windows(motion, rates, alignment)
    if len(blocks) < _FIT.min_windows:
        return NotObservable(
            what,
            f"only {len(blocks)} windows of {_FIT.window_s:g} s are without tracking loss "
            f"({_FIT.min_windows} needed)",
        )
    x = _solve_windows(blocks)
    refits = [
        _solve_windows([b for k, b in enumerate(blocks) if k % _FIT.blocks != left_out])
        for left_out in range(_FIT.blocks)
    ]
    sigma = jackknife(refits)[:3]
    if sigma.max() > _FIT.max_sigma_m:
        axis = "xyz"[int(np.argmax(sigma))]
        return NotObservable(
            what,
            f"the camera rotates too little: the standard deviation is {sigma.max():.3f} m along "
            f"{axis} of cam0",
        )
    return LeverArm(x[:3], sigma, len(blocks))


def _windows(
    motion: CameraMotion, rates: Rates, alignment: ImuAlignment
) -> list[tuple[FloatArray, FloatArray]]:
    """Return each window's Jacobian and right side w.r.t. `[t_cam0_imu; bias]`, with the
    nuisances projected out.
    """
    origin = int(motion.times_ns[0])
    t_imu = _seconds(rates.times_ns, origin) - alignment.time_offset_s
    t_frame = _seconds(motion.times_ns, origin)
    gyro = rates.angular - alignment.gyro_bias
    steps: dict[int, FloatArray] = dict(zip(motion.frames.tolist(), motion.twists, strict=True))
    out = []
    first = 0
    while first < len(t_frame) - 1:
        last = first
        while last in steps and t_frame[last] - t_frame[first] < _FIT.window_s:
            last += 1
        whole = t_frame[last] - t_frame[first] >= 0.8 * _FIT.window_s
        inside = t_imu[0] <= t_frame[first] and t_imu[-1] >= t_frame[last]
        if not (whole and inside):
            first = max(last, first + 1)
            continue
        out.append(
            _window(
                steps,
                t_frame[first : last + 1],
                first,
                t_imu,
                gyro,
                rates.linear,
                alignment.R_cam0_imu,
            )
        )
        first = last
    return out


def _seconds(times_ns: IntArray, origin_ns: int) -> FloatArray:
    return np.asarray((times_ns - origin_ns) * S_PER_NS, dtype=np.float64)


def _window(
    steps: dict[int, FloatArray],
    t: FloatArray,
    first: int,
    t_imu: FloatArray,
    gyro: FloatArray,
    force: FloatArray,
    R_cam0_imu: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    n = len(t) - 1
    T = np.eye(4)
    T_start_cam = []
    for k in range(n):
        step_s = t[k + 1] - t[k]
        T = T @ se3_inverse(se3_exp(-step_s * steps[first + k]))
        T_start_cam.append(T)
    poses = np.array(T_start_cam)
    s = _integrals(t, t_imu, gyro, force, R_cam0_imu)
    elapsed = t[1:] - t[0]
    turned = poses[:, :3, :3] - np.eye(3)
    rows = np.concatenate([turned, s[:, :, 1:]], axis=2).reshape(3 * n, 6)
    right = (s[:, :, 0] - poses[:, :3, 3]).reshape(3 * n)
    seconds = elapsed[:, None, None]
    by_velocity = seconds * np.eye(3)
    by_gravity = seconds**2 / 2 * np.eye(3)
    nuisance = np.concatenate([by_velocity, by_gravity], axis=2).reshape(3 * n, 6)
    Q = np.linalg.qr(nuisance, mode="complete")[0][:, 6:]
    return Q.T @ rows, Q.T @ right


def _integrals(
    t: FloatArray, t_imu: FloatArray, gyro: FloatArray, force: FloatArray, R_cam0_imu: FloatArray
) -> FloatArray:
    """Return double integrals (n, 3, 4) at t[1:] of force (column 0) and rotation (columns 1 to
    3), in cam0(t0).
    """
    low, high = np.searchsorted(t_imu, [t[0], t[-1]])
    knots = np.unique(np.concatenate([t, t_imu[low:high]]))
    omega, f = (
        np.stack([np.interp(knots, t_imu, values[:, k]) for k in range(3)], axis=1)
        for values in (gyro, force)
    )
    dt = np.diff(knots)
    turns = so3_exp(dt[:, None] * (omega[1:] + omega[:-1]) / 2)
    R = [R_cam0_imu]
    for turn in turns:
        R.append(R[-1] @ turn)
    rotation = np.array(R)
    value = np.concatenate([(rotation @ f[..., None]), rotation], axis=2)  # (m, 3, 4)
    mean = (value[1:] + value[:-1]) / 2
    gained = np.cumsum(dt[:, None, None] * mean, axis=0)
    velocity = np.concatenate([np.zeros((1, 3, 4)), gained])
    third = (
        dt[:, None, None] * velocity[:-1]
        + dt[:, None, None] ** 2 * (2 * value[:-1] + value[1:]) / 6
    )
    position = np.concatenate([np.zeros((1, 3, 4)), np.cumsum(third, axis=0)])
    return position[np.searchsorted(knots, t[1:])]


def _solve_windows(blocks: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Solve robust least squares over the windows, each weighted as a whole."""
    weights: FloatArray = np.ones(len(blocks))
    x: FloatArray = np.zeros(6)
    for _ in range(6):
        weighted = list(zip(weights, blocks, strict=True))
        normal = sum((w * A.T @ A for w, (A, _) in weighted), 1e-9 * np.eye(6))
        right = sum((w * A.T @ b for w, (A, b) in weighted), np.zeros(6))
        x = np.linalg.solve(normal, right)
        residuals = [A @ x - b for A, b in blocks]
        rms = np.array([np.sqrt(np.mean(r**2)) for r in residuals])
        usual = max(float(np.median(rms)), 1e-9)
        weights = 1 / (1 + (rms / usual) ** 2) ** 2
    return x


@dataclass(frozen=True, slots=True)
class LeverArmVerdict:
    """Which of two camera positions in the IMU frame agrees with velocities and features."""

    better: int | None  # 0 or 1; None: the motion does not distinguish them
    # estimated position of the camera on the line between the two: -1 at the first, +1 at the
    # second
    place: float
    place_sigma: float  # standard error of `place`; infinite where nothing could be measured
    intervals: int  # frame intervals used


def judge_lever_arms(
    camera: StereoCamera,
    tracks: FeatureTracks,
    times_ns: IntArray,
    velocities: FloatArray,
    R_cam0_imu: FloatArray,
    lever_arms: tuple[FloatArray, FloatArray],
) -> LeverArmVerdict:
    """Decide between two positions l of cam0 in the IMU frame by `v_cam = v_imu + omega x l` of a
    rigid body.

    The camera's velocity and rotation rate come from the stereo tracks, v_imu from the file (its
    noise averages out). Other causes of a velocity difference are fitted together with the lever
    arm, for each axis: a constant, and terms proportional to speed (scale, misalignment), to
    acceleration (clock offset), and to yaw rate times squared speed (side slip of the tyres, which
    otherwise looks like half a metre of lever arm). The standard error is a jackknife over blocks
    of the recording, so that it includes correlated errors.

    Args:
        camera: rectified pair.
        tracks: features.
        times_ns: (F,) frame times.
        velocities: (F, 6) [v; omega] of the body, imu frame, m/s and rad/s.
        R_cam0_imu: (3, 3).
        lever_arms: the two candidates, (3,) metres in the imu frame.
    """
    middle = (velocities[:-1] + velocities[1:]) / 2
    R_imu_cam0 = R_cam0_imu.T
    turned = np.concatenate([middle[:, :3] @ R_imu_cam0, middle[:, 3:] @ R_imu_cam0], axis=1)
    seen = stereo_twists(camera, tracks, times_ns, turned)
    count = len(seen.frames)
    if count < _JUDGE.min_intervals:
        return LeverArmVerdict(None, 0.0, float("inf"), count)
    v_cam = seen.twists[:, :3] @ R_cam0_imu
    omega = seen.twists[:, 3:] @ R_cam0_imu
    centre = (lever_arms[1] + lever_arms[0]) / 2
    half = (lever_arms[1] - lever_arms[0]) / 2
    y = v_cam - middle[seen.frames, :3] - np.cross(omega, centre)
    speed = np.linalg.norm(v_cam, axis=1)
    yaw_rate = omega[:, np.argmax(omega.std(axis=0))]
    sideways = yaw_rate * speed**2
    nuisance = np.stack([np.ones(count), speed, np.gradient(speed), sideways], axis=1)
    signal = np.cross(omega, half)
    every = np.arange(count)
    place = _fit_place(y, signal, nuisance)
    left_out = [np.setdiff1d(every, block) for block in np.array_split(every, _JUDGE.judged_blocks)]
    refits = [_fit_place(y[keep], signal[keep], nuisance[keep]) for keep in left_out]
    sigma = max(float(jackknife(refits)), _JUDGE.min_sigma)
    better = None
    if 2 * abs(place) / sigma**2 > _JUDGE.log_odds:
        better = int(place > 0)
    return LeverArmVerdict(better, place, sigma, count)


def _fit_place(y: FloatArray, signal: FloatArray, nuisance: FloatArray) -> float:
    """Fit `y = place * signal + nuisance c` (N, 3) robustly, with c per axis and a common
    `place`.
    """
    top = bottom = 0.0
    for axis in range(3):
        X = np.concatenate([signal[:, axis : axis + 1], nuisance], axis=1)
        scale = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        weight = np.ones(len(X))
        sigma = 1.0
        x = np.zeros(X.shape[1])
        normal = np.eye(X.shape[1])
        for _ in range(_FIT.reweightings):
            weighted = X / scale * weight[:, None]
            normal = weighted.T @ (X / scale) + _FIT.ridge * np.eye(X.shape[1])
            x = np.linalg.solve(normal, weighted.T @ y[:, axis]) / scale
            r = y[:, axis] - X @ x
            sigma = max(robust_sigma(r), 1e-9)
            weight = np.minimum(1.0, _FIT.huber * sigma / np.maximum(np.abs(r), 1e-12))
        inverse = np.linalg.inv(normal)
        variance = float(inverse[0, 0]) * (sigma / scale[0]) ** 2
        top += x[0] / variance
        bottom += 1 / variance
    return top / bottom
