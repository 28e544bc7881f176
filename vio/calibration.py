"""What a recording says about its own calibration: stereo extrinsics, IMU-camera rotation, lever arm, time offset.

Own geometry on rays, tracks and motion samples; numpy and scipy only. Every estimate comes with standard deviations
from a jackknife over blocks of the recording, so that they cover errors that last, and is withheld where the motion or
the scene leaves it open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from scipy.optimize import least_squares

from vio.datasets.egomotion import stereo_twists
from vio.datasets.tracks import FeatureTracks
from vio.errors import EstimationError
from vio.evaluation import rotation_angle_deg
from vio.geometry.lie import FloatArray, nearest_rotation, se3_exp, se3_inverse, so3_exp, so3_log
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, ImuSample, IntArray, MotionSample

_BLOCKS = 10  # of a jackknife
_LEAST_MATCHES = 150
_LEAST_PAIRS = 3
_STEREO_ROTATION_DEG = 0.2  # standard deviations beyond these withhold a value …
_STEREO_DIRECTION_DEG = 2.0
_IMU_ROTATION_DEG = 1.0
_TIME_OFFSET_S = 0.005
_LEVER_M = 0.02
_LEAST_STRETCHES = 3
_LEAST_TWISTS = 40
_LEAST_TURN_RADPS = 0.02  # spread of the rotation rate below which gyro and images tell each other nothing
_LARGEST_OFFSET_S = 0.1
_OFFSET_STEP_S = 0.004
_WINDOW_S = 1.0
_LEAST_WINDOWS = 12
_LARGEST_GAP_S = 0.25
_NS = 1e-9


@dataclass(frozen=True, slots=True)
class RayMatches:
    """The same points seen by both cameras of a rig."""

    pair: IntArray  # (N,) number of the stereo pair
    ray0: FloatArray  # (N, 3) unit rays in cam0
    ray1: FloatArray  # (N, 3) unit rays in cam1

    def take(self, rows: BoolArray) -> RayMatches:
        """Return the rows named by a mask (N,)."""
        return RayMatches(self.pair[rows], self.ray0[rows], self.ray1[rows])


def join_matches(parts: Sequence[RayMatches]) -> RayMatches:
    """All matches of several pairs as one table."""
    none = np.zeros((0, 3))
    return RayMatches(
        np.concatenate([np.zeros(0, dtype=np.int64), *(m.pair for m in parts)]),
        np.concatenate([none, *(m.ray0 for m in parts)]),
        np.concatenate([none, *(m.ray1 for m in parts)]),
    )


@dataclass(frozen=True, slots=True)
class StereoEstimate:
    """Left-right extrinsics without scale."""

    R_cam1_cam0: FloatArray  # (3, 3)
    direction: FloatArray  # (3,) unit vector from cam0 to cam1, cam0 frame
    rotation_sigma_deg: float
    direction_sigma_deg: float
    matches: int  # inliers
    pairs: int
    residual_deg: float  # robust spread of the epipolar angle over single pairs
    stretches: int | None = None  # stretches of video behind the values; None: single pairs alone


@dataclass(frozen=True, slots=True)
class NotObservable:
    """Why there is no number."""

    what: str
    because: str

    def __str__(self) -> str:
        return f"{self.what} not observable because {self.because}"


# --- left and right -------------------------------------------------------------------------------------------------


def epipolar_angles(R_cam1_cam0: FloatArray, direction: FloatArray, matches: RayMatches) -> FloatArray:
    """Signed angles (N,) in radians between the rays of cam1 and the epipolar planes of those of cam0."""
    turned = matches.ray0 @ R_cam1_cam0.T
    normal = np.cross(R_cam1_cam0 @ direction, turned)
    length = np.linalg.norm(normal, axis=1)
    return np.sum(normal * matches.ray1, axis=1) / np.maximum(length, 1e-9)


def epipolar_spread(R_cam1_cam0: FloatArray, direction: FloatArray, matches: RayMatches) -> float:
    """Median size of the epipolar angles, radians."""
    return float(np.median(np.abs(epipolar_angles(R_cam1_cam0, direction, matches))))


def refine_stereo(
    matches: RayMatches, R_cam1_cam0: FloatArray, direction: FloatArray
) -> StereoEstimate | NotObservable:
    """Refine rotation and baseline direction on the epipolar angles, with standard deviations.

    Args:
        matches: candidate matches, outliers among them.
        R_cam1_cam0: (3, 3) where to start.
        direction: (3,) unit vector where to start, cam0 frame.
    """
    R, d = R_cam1_cam0, direction
    inliers = matches
    for gate in (np.radians(1.0), np.radians(0.3), None):
        angles = np.abs(epipolar_angles(R, d, matches))
        spread = (
            1.4826 * float(np.median(angles[angles < np.radians(1.0)])) if (angles < np.radians(1.0)).any() else 1.0
        )
        limit = gate if gate is not None else max(4 * spread, 1e-5)
        inliers = matches.take(angles < limit)
        if few := too_few(inliers):
            return few
        R, d = _fit_stereo(inliers, R, d, max(spread, 1e-6))
    spread = 1.4826 * float(np.median(np.abs(epipolar_angles(R, d, inliers))))
    again = []
    for left_out in _blocks(inliers.pair):
        kept = inliers.take(~left_out)
        again.append(_fit_stereo(kept, R, d, max(spread, 1e-6)))
    count = len(again)
    turns = np.array([so3_log(Rk @ R.T) for Rk, _ in again])
    swings = np.array([np.cross(d, dk) for _, dk in again])
    rotation_sigma = _jackknife_norm(turns, count)
    direction_sigma = _jackknife_norm(swings, count)
    if rotation_sigma > np.radians(_STEREO_ROTATION_DEG) or direction_sigma > np.radians(_STEREO_DIRECTION_DEG):
        return NotObservable(
            "left-right extrinsics",
            f"the matches leave {np.degrees(rotation_sigma):.2f} deg of rotation and {np.degrees(direction_sigma):.1f} "
            "deg of direction open; all points may be far away or on one plane",
        )
    pairs = len(np.unique(inliers.pair))
    return StereoEstimate(
        R,
        d,
        float(np.degrees(rotation_sigma)),
        float(np.degrees(direction_sigma)),
        len(inliers.pair),
        pairs,
        float(np.degrees(spread)),
    )


def too_few(matches: RayMatches) -> NotObservable | None:
    """Say why left-right extrinsics cannot be had from so few matches; None: there are enough."""
    pairs = len(np.unique(matches.pair))
    if len(matches.pair) >= _LEAST_MATCHES and pairs >= _LEAST_PAIRS:
        return None
    return NotObservable(
        "left-right extrinsics",
        f"only {len(matches.pair)} consistent matches in {pairs} pairs were found ({_LEAST_MATCHES} in {_LEAST_PAIRS} "
        "are needed); the images are too few, do not overlap, or have no texture",
    )


def _fit_stereo(matches: RayMatches, R: FloatArray, d: FloatArray, spread: float) -> tuple[FloatArray, FloatArray]:
    basis = _tangents(d)

    def moved(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        out = d + basis @ x[3:]
        return so3_exp(x[:3]) @ R, out / np.linalg.norm(out)

    found = least_squares(
        lambda x: epipolar_angles(*moved(x), matches) / spread, np.zeros(5), loss="soft_l1", x_scale=1e-2
    )
    return moved(found.x)


def _tangents(d: FloatArray) -> FloatArray:
    """Two unit vectors (3, 2) perpendicular to a direction and to each other."""
    out: FloatArray = np.linalg.svd(d[None, :])[2][1:].T
    return out


def _blocks(labels: IntArray) -> list[BoolArray]:
    """Masks (N,) of the rows of each of up to ten blocks of labels."""
    names = np.unique(labels)
    parts = np.array_split(names, min(_BLOCKS, len(names)))
    return [np.isin(labels, part) for part in parts]


def _jackknife_norm(values: FloatArray, count: int) -> float:
    """Standard error of a vector (its length) from its leave-one-block-out values (count, d)."""
    return float(np.sqrt((count - 1) * np.mean(np.sum((values - values.mean(axis=0)) ** 2, axis=1))))


def _jackknife(values: FloatArray) -> FloatArray:
    """Standard errors (d,) from leave-one-block-out values (count, d)."""
    out: FloatArray = np.sqrt((len(values) - 1) * np.mean((values - values.mean(axis=0)) ** 2, axis=0))
    return out


def combine_stereo(pairs: StereoEstimate, stretches: Sequence[tuple[FloatArray, FloatArray]]) -> StereoEstimate | None:
    """The mean of rotation and direction over stretches of video, with their standard errors; None: too uncertain.

    Args:
        pairs: what single pairs say, for its counts.
        stretches: at least three of `R_cam1_cam0` (3, 3) and direction (3,).
    """
    if len(stretches) < _LEAST_STRETCHES:
        return None
    R = nearest_rotation(np.sum([Rk for Rk, _ in stretches], axis=0))
    d = np.sum([dk for _, dk in stretches], axis=0)
    d = d / np.linalg.norm(d)
    count = len(stretches)
    turns = np.array([so3_log(Rk @ R.T) for Rk, _ in stretches])
    swings = np.array([np.cross(d, dk) for _, dk in stretches])
    rotation, direction = (float(np.degrees(np.sqrt(np.sum(v**2) / (count * (count - 1))))) for v in (turns, swings))
    if rotation > _STEREO_ROTATION_DEG or direction > _STEREO_DIRECTION_DEG:
        return None
    return replace(
        pairs,
        R_cam1_cam0=R,
        direction=d,
        rotation_sigma_deg=rotation,
        direction_sigma_deg=direction,
        stretches=count,
    )


@dataclass(frozen=True, slots=True)
class RowResiduals:
    """How well the rows of a rectified pair agree."""

    median_px: float  # of vl - vr
    spread_px: float  # robust standard deviation
    grid_px: FloatArray  # (3, 3) medians over the image, rows from the top; NaN where too few matches lie
    positive_disparity: float  # share of matches with ul > ur
    matches: int


def row_residuals(z: FloatArray, width: float, height: float) -> RowResiduals | NotObservable:
    """Describe the row differences of matches (N, 4) `[ul vl ur vr]` in rectified pixels."""
    if len(z) < _LEAST_MATCHES:
        return NotObservable("row alignment", f"only {len(z)} matches were found")
    off = z[:, 1] - z[:, 3]
    median = float(np.median(off))
    grid = np.full((3, 3), np.nan)
    column = np.clip((3 * z[:, 0] / width).astype(int), 0, 2)
    row = np.clip((3 * z[:, 1] / height).astype(int), 0, 2)
    for i in range(3):
        for j in range(3):
            here = off[(row == i) & (column == j)]
            if len(here) >= 15:
                grid[i, j] = np.median(here)
    return RowResiduals(
        median,
        1.4826 * float(np.median(np.abs(off - median))),
        grid,
        float(np.mean(z[:, 0] > z[:, 2])),
        len(z),
    )


# --- inertial sensor ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """The left camera's motion from frame to frame, by its stereo tracks alone."""

    times_ns: IntArray  # (F,) of all frames
    frames: IntArray  # (K,) earlier frame of each interval
    twists: FloatArray  # (K, 6) [v; omega], cam0 frame, m/s and rad/s


@dataclass(frozen=True, slots=True)
class ImuAlignment:
    """How gyro and camera lie to each other."""

    R_cam0_imu: FloatArray  # (3, 3)
    rotation_sigma_deg: FloatArray  # (3,) about the axes of cam0
    time_offset_s: float  # IMU clock minus camera clock: a frame stamped t was exposed at t + offset of the IMU's clock
    time_offset_sigma_s: float
    gyro_bias: FloatArray  # (3,) rad/s
    residual_radps: float  # robust spread of the rotation rates' difference, each axis
    intervals: int
    weak: str | None  # what the motion leaves open, in words


@dataclass(frozen=True, slots=True)
class LeverArm:
    """Where the IMU lies in the left camera's frame."""

    t_cam0_imu: FloatArray  # (3,) metres
    sigma_m: FloatArray  # (3,)
    windows: int


@dataclass(frozen=True, slots=True)
class Rates:
    """Motion samples as arrays."""

    times_ns: IntArray  # (S,)
    angular: FloatArray  # (S, 3) rad/s, imu frame
    linear: FloatArray  # (S, 3) specific force in m/s^2, or velocity in m/s
    inertial: bool  # the former


def rates_of(samples: Sequence[MotionSample]) -> Rates:
    """Motion samples of one kind as arrays.

    Raises:
        EstimationError: there is none.
    """
    if not samples:
        raise EstimationError("the recording holds no motion sensor; only the cameras can be calibrated")
    inertial = isinstance(samples[0], ImuSample)
    pairs = [(s.gyro, s.accel) if isinstance(s, ImuSample) else (s.angular, s.linear) for s in samples]
    return Rates(
        np.array([s.time_ns for s in samples], dtype=np.int64),
        np.array([p[0] for p in pairs]),
        np.array([p[1] for p in pairs]),
        inertial,
    )


def camera_motion(
    camera: StereoCamera, tracks: FeatureTracks, times_ns: IntArray, guess: FloatArray | None = None
) -> CameraMotion | NotObservable:
    """Estimate the camera's twist over each frame interval that its tracks determine.

    Args:
        camera: rectified pair.
        tracks: stereo features.
        times_ns: (F,) frame times.
        guess: (F - 1, 6) twists to start from; None: rest.
    """
    start = np.zeros((len(times_ns) - 1, 6)) if guess is None else guess
    found = stereo_twists(camera, tracks, times_ns, start)
    dt = np.diff(times_ns)[found.frames] * _NS
    frames, twists = found.frames[dt < _LARGEST_GAP_S], found.twists[dt < _LARGEST_GAP_S]
    if len(frames) < _LEAST_TWISTS:
        gap = float(np.median(np.diff(times_ns))) * _NS if len(times_ns) > 1 else float("inf")
        return NotObservable(
            "IMU-camera calibration",
            f"only {len(frames)} frame intervals give a motion of the camera ({_LEAST_TWISTS} are needed; frames are "
            f"{gap:.3g} s apart); too few images, too far apart, or too little texture",
        )
    return CameraMotion(times_ns, frames, twists)


def align_gyro(motion: CameraMotion, rates: Rates) -> ImuAlignment | NotObservable:
    """Find rotation, time offset and gyro bias that make the gyro's turns those of the camera.

    Model, for each frame interval: `omega_cam dt = R_cam0_imu (integral of gyro over the shifted interval - b dt)`.
    Velocities of a `velocity` recording take part as directions, since a car turns about one axis only.
    """
    if float(np.linalg.norm(motion.twists[:, 3:].std(axis=0))) < _LEAST_TURN_RADPS:
        return NotObservable("IMU-camera rotation and time offset", "the camera does not turn")
    problem = _GyroProblem(motion, rates)
    offset = problem.coarse_offset()
    keep = problem.covered
    solution = problem.fit(problem.start(offset), keep)
    sigma = problem.spread(solution, keep)
    blocks = np.array_split(np.flatnonzero(keep), _BLOCKS)
    again = []
    for block in blocks:
        part = keep.copy()
        part[block] = False
        again.append(problem.fit(solution, part))
    turns = np.array([so3_log(so3_exp(x[:3]) @ so3_exp(solution[:3]).T) for x in again])
    errors = _jackknife(np.concatenate([turns, np.array(again)[:, 3:]], axis=1))
    errors = np.maximum(errors, problem.formal_sigma(solution, keep, sigma))
    rotation_sigma = np.degrees(errors[:3])
    weak = None
    if rotation_sigma.max() > _IMU_ROTATION_DEG:
        weak = "rotation about one axis (the motion turns too little about the others)"
    if errors[3] > _TIME_OFFSET_S:
        weak = f"{weak} and time offset" if weak else "time offset (the rotation rate hardly changes)"
    return ImuAlignment(
        so3_exp(solution[:3]),
        rotation_sigma,
        float(solution[3]),
        float(errors[3]),
        solution[4:],
        sigma,
        int(keep.sum()),
        weak,
    )


class _GyroProblem:
    """Residuals of `align_gyro`; parameters are [rotation vector (3), offset (1), bias (3)]."""

    def __init__(self, motion: CameraMotion, rates: Rates) -> None:
        self._origin = int(motion.times_ns[0])
        self._t = (rates.times_ns - self._origin) * _NS
        steps = np.diff(self._t)[:, None] * (rates.angular[1:] + rates.angular[:-1]) / 2
        self._turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        self._begin = (motion.times_ns[motion.frames] - self._origin) * _NS
        self._end = (motion.times_ns[motion.frames + 1] - self._origin) * _NS
        self._dt = self._end - self._begin
        self._omega = motion.twists[:, 3:]
        margin = _LARGEST_OFFSET_S
        inside = (self._begin >= self._t[0]) & (self._end <= self._t[-1])
        shiftable = (self._begin - margin >= self._t[0]) & (self._end + margin <= self._t[-1])
        self.covered: BoolArray = shiftable if shiftable.sum() > 0.5 * inside.sum() else inside
        self._velocities: tuple[FloatArray, FloatArray] | None = None
        if not rates.inertial:
            middle = (self._begin + self._end) / 2
            v_imu = np.stack([np.interp(middle, self._t, rates.linear[:, k]) for k in range(3)], axis=1)
            self._velocities = motion.twists[:, :3], v_imu

    def gyro(self, offset: float) -> FloatArray:
        """Mean rotation rate (K, 3) of each interval, imu frame."""
        turned = [
            np.interp(at + offset, self._t, self._turned[:, k]) for k in range(3) for at in (self._end, self._begin)
        ]
        return np.stack([turned[2 * k] - turned[2 * k + 1] for k in range(3)], axis=1) / self._dt[:, None]

    def coarse_offset(self) -> float:
        """The offset at which the two rotation rates' magnitudes go best together."""
        seen = np.linalg.norm(self._omega, axis=1)[self.covered]
        offsets = np.arange(-_LARGEST_OFFSET_S, _LARGEST_OFFSET_S + 1e-9, _OFFSET_STEP_S)
        scores = []
        for offset in offsets:
            felt = np.linalg.norm(self.gyro(offset), axis=1)[self.covered]
            scores.append(float(np.median(np.abs(felt - seen))))
        return float(offsets[int(np.argmin(scores))])

    def start(self, offset: float) -> FloatArray:
        """Parameters from the closed form at one offset. Reference: Wahba's problem by SVD (Markley 1988)."""
        gyro, omega = self.gyro(offset)[self.covered], self._omega[self.covered]
        C = (omega - np.median(omega, axis=0)).T @ (gyro - np.median(gyro, axis=0))
        if self._velocities is not None:
            v_cam, v_imu = (v[self.covered] for v in self._velocities)
            C = C + 1e-2 * (v_cam.T @ v_imu)
        return np.concatenate([so3_log(nearest_rotation(C)), [offset], np.zeros(3)])

    def residuals(self, x: FloatArray) -> FloatArray:
        """Differences (K, 3 or 6) of the rates, and of the velocities where they are known."""
        R = so3_exp(x[:3])
        turning = self._omega - (self.gyro(float(x[3])) - x[4:]) @ R.T
        if self._velocities is None:
            return turning
        v_cam, v_imu = self._velocities
        return np.concatenate([turning, (v_cam - v_imu @ R.T) * _VELOCITY_WEIGHT], axis=1)

    def fit(self, x: FloatArray, keep: BoolArray) -> FloatArray:
        """Robust least squares from `x` on some of the intervals."""
        start = x
        for _ in range(2):
            scale = self.spread(start, keep)
            found = least_squares(
                lambda y, s=scale: self.residuals(y)[keep].ravel() / s,
                start,
                loss="soft_l1",
                x_scale=np.array([1e-2] * 3 + [1e-3] + [1e-3] * 3),
                diff_step=1e-5,
            )
            start = found.x
        out: FloatArray = start
        return out

    def spread(self, x: FloatArray, keep: BoolArray) -> float:
        """Robust standard deviation of one residual."""
        return max(1.4826 * float(np.median(np.abs(self.residuals(x)[keep]))), 1e-6)

    def formal_sigma(self, x: FloatArray, keep: BoolArray, sigma: float) -> FloatArray:
        """Standard deviations (7,) if residuals were independent; large where a direction is open."""
        J = np.empty((self.residuals(x)[keep].size, 7))
        for k, h in enumerate([1e-4] * 3 + [1e-3] + [1e-4] * 3):
            step = np.zeros(7)
            step[k] = h
            if k < 3:  # a turn on the camera's side, as the jackknife measures it
                plus, minus = (
                    np.concatenate([so3_log(so3_exp(s * step[:3]) @ so3_exp(x[:3])), x[3:]]) for s in (1.0, -1.0)
                )
            else:
                plus, minus = x + step, x - step
            J[:, k] = (self.residuals(plus) - self.residuals(minus))[keep].ravel() / (2 * h)
        scale = np.maximum(np.linalg.norm(J, axis=0), 1e-12)
        information = (J / scale).T @ (J / scale) + 1e-12 * np.eye(7)
        return sigma * np.sqrt(np.diag(np.linalg.inv(information))) / scale


_VELOCITY_WEIGHT = 0.02  # rad/s per m/s: what one velocity's error is worth beside a rotation rate's


def lever_arm(motion: CameraMotion, rates: Rates, alignment: ImuAlignment) -> LeverArm | NotObservable:
    """Find the IMU's position in the left camera's frame from accelerometer and camera motion.

    Over windows of a second, the doubly integrated specific force must move the IMU as the camera's motion and the
    lever arm say. Start velocity and gravity are free in every window, the accelerometer bias is common.
    """
    what = "lever arm"
    if not rates.inertial:
        return NotObservable(what, "the recording holds velocities, no accelerometer")
    if alignment.weak is not None:
        return NotObservable(what, f"the motion leaves open the {alignment.weak}")
    blocks = _windows(motion, rates, alignment)
    if len(blocks) < _LEAST_WINDOWS:
        return NotObservable(
            what, f"only {len(blocks)} stretches of {_WINDOW_S:g} s are tracked throughout ({_LEAST_WINDOWS} needed)"
        )
    x = _solve_windows(blocks)
    again = [
        _solve_windows([b for k, b in enumerate(blocks) if k % _BLOCKS != left_out]) for left_out in range(_BLOCKS)
    ]
    sigma = _jackknife(np.array(again))[:3]
    if sigma.max() > _LEVER_M:
        axis = "xyz"[int(np.argmax(sigma))]
        return NotObservable(
            what,
            f"the motion turns too little: it leaves {sigma.max():.3f} m open along {axis} of cam0",
        )
    return LeverArm(x[:3], sigma, len(blocks))


def _windows(motion: CameraMotion, rates: Rates, alignment: ImuAlignment) -> list[tuple[FloatArray, FloatArray]]:
    """For each window, the design (3n, 6) and the right side (3n,) of `[t_cam0_imu; bias]`, nuisances projected out."""
    origin = int(motion.times_ns[0])
    t_imu = _seconds(rates.times_ns, origin) - alignment.time_offset_s
    t_frame = _seconds(motion.times_ns, origin)
    gyro = rates.angular - alignment.gyro_bias
    steps: dict[int, FloatArray] = dict(zip(motion.frames.tolist(), motion.twists, strict=True))
    out = []
    first = 0
    while first < len(t_frame) - 1:
        last = first
        while last in steps and t_frame[last] - t_frame[first] < _WINDOW_S:
            last += 1
        whole = t_frame[last] - t_frame[first] >= 0.8 * _WINDOW_S
        inside = t_imu[0] <= t_frame[first] and t_imu[-1] >= t_frame[last]
        if not (whole and inside):
            first = max(last, first + 1)
            continue
        out.append(_window(steps, t_frame[first : last + 1], first, t_imu, gyro, rates.linear, alignment.R_cam0_imu))
        first = last
    return out


def _seconds(times_ns: IntArray, origin_ns: int) -> FloatArray:
    return np.asarray((times_ns - origin_ns) * _NS, dtype=np.float64)


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
        T = T @ se3_inverse(se3_exp(-(t[k + 1] - t[k]) * steps[first + k]))
        T_start_cam.append(T)
    poses = np.array(T_start_cam)
    s = _integrals(t, t_imu, gyro, force, R_cam0_imu)
    since = t[1:] - t[0]
    rows = np.concatenate([poses[:, :3, :3] - np.eye(3), s[:, :, 1:]], axis=2).reshape(3 * n, 6)
    right = (s[:, :, 0] - poses[:, :3, 3]).reshape(3 * n)
    nuisance = np.concatenate(
        [since[:, None, None] * np.eye(3), since[:, None, None] ** 2 / 2 * np.eye(3)], axis=2
    ).reshape(3 * n, 6)
    Q = np.linalg.qr(nuisance, mode="complete")[0][:, 6:]
    return Q.T @ rows, Q.T @ right


def _integrals(
    t: FloatArray, t_imu: FloatArray, gyro: FloatArray, force: FloatArray, R_cam0_imu: FloatArray
) -> FloatArray:
    """Double integrals (n, 3, 4) at t[1:] of the force (column 0) and of the rotation (columns 1 to 3), in cam0(t0)."""
    low, high = np.searchsorted(t_imu, [t[0], t[-1]])
    knots = np.unique(np.concatenate([t, t_imu[low:high]]))
    omega, f = (np.stack([np.interp(knots, t_imu, values[:, k]) for k in range(3)], axis=1) for values in (gyro, force))
    dt = np.diff(knots)
    turns = so3_exp(dt[:, None] * (omega[1:] + omega[:-1]) / 2)
    R = [R_cam0_imu]
    for turn in turns:
        R.append(R[-1] @ turn)
    rotation = np.array(R)
    value = np.concatenate([(rotation @ f[..., None]), rotation], axis=2)  # (m, 3, 4)
    mean = (value[1:] + value[:-1]) / 2
    velocity = np.concatenate([np.zeros((1, 3, 4)), np.cumsum(dt[:, None, None] * mean, axis=0)])
    third = dt[:, None, None] * velocity[:-1] + dt[:, None, None] ** 2 * (2 * value[:-1] + value[1:]) / 6
    position = np.concatenate([np.zeros((1, 3, 4)), np.cumsum(third, axis=0)])
    return position[np.searchsorted(knots, t[1:])]


def _solve_windows(blocks: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Robust least squares over the windows, each weighted as a whole."""
    weights: FloatArray = np.ones(len(blocks))
    x: FloatArray = np.zeros(6)
    for _ in range(6):
        normal = sum((w * A.T @ A for w, (A, _) in zip(weights, blocks, strict=True)), 1e-9 * np.eye(6))
        right = sum((w * A.T @ b for w, (A, b) in zip(weights, blocks, strict=True)), np.zeros(6))
        x = np.linalg.solve(normal, right)
        rms = np.array([np.sqrt(np.mean((A @ x - b) ** 2)) for A, b in blocks])
        weights = 1 / (1 + (rms / max(float(np.median(rms)), 1e-9)) ** 2) ** 2
    return x


# --- verdicts -------------------------------------------------------------------------------------------------------

Fault: TypeAlias = Literal[
    "cameras swapped",
    "baseline translation inverted",
    "left-right rotation wrong",
    "baseline direction wrong",
    "IMU-camera rotation wrong",
    "IMU-camera rotation inverted",
    "IMU-camera translation inverted",
    "IMU-camera translation wrong",
    "clocks apart",
]


@dataclass(frozen=True, slots=True)
class Finding:
    """One fault of a given calibration, in words with figures."""

    fault: Fault
    detail: str

    def __str__(self) -> str:
        return f"{self.fault}: {self.detail}"


def judge_stereo(estimate: StereoEstimate, T_cam0_cam1: FloatArray, inliers: RayMatches) -> tuple[Finding, ...]:
    """Compare measured left-right extrinsics with given ones (4, 4).

    Which camera is the left one is measured, too: cam1 must lie on the positive x side of cam0. From single
    pairs, a difference is a fault only where the given extrinsics explain the matches clearly worse: a slightly wrong
    lens model passes for a few tenths of a degree of yaw.
    """
    given = T_cam0_cam1[:3, 3] / np.linalg.norm(T_cam0_cam1[:3, 3])
    R_given = T_cam0_cam1[:3, :3].T
    turn_deg = float(rotation_angle_deg(estimate.R_cam1_cam0 @ R_given.T))
    swing_deg = _between_deg(estimate.direction, given)
    turn_limit = max(_NAMED_ROTATION_DEG, 5 * estimate.rotation_sigma_deg)
    swing_limit = max(_NAMED_DIRECTION_DEG, 5 * estimate.direction_sigma_deg)
    if estimate.direction[0] < -0.5:
        return (
            Finding(
                "cameras swapped",
                "the images of cam1 are taken from the left of those of cam0 (measured baseline direction "
                f"{_triple(estimate.direction)} in cam0); exchange the two folders, or the two calibrations with them",
            ),
        )
    found: list[Finding] = []
    clear = estimate.stretches is not None or (
        epipolar_spread(R_given, given, inliers)
        > _CLEARLY_WORSE * epipolar_spread(estimate.R_cam1_cam0, estimate.direction, inliers)
    )
    if swing_deg > 180 - max(swing_limit, 20.0):
        if turn_deg > turn_limit and float(rotation_angle_deg(estimate.R_cam1_cam0 @ R_given)) < turn_limit:
            return (
                Finding(
                    "cameras swapped",
                    "the calibration is that of the two cameras exchanged, or the inverse transform: its inverse fits",
                ),
            )
        found.append(
            Finding(
                "baseline translation inverted",
                f"the calibration puts cam1 at {_triple(given)}, the images at {_triple(estimate.direction)} (unit "
                "vectors in cam0); the translation has the wrong sign, or the transform is the inverse one",
            )
        )
    elif swing_deg > swing_limit and clear:
        found.append(
            Finding(
                "baseline direction wrong",
                f"off by {swing_deg:.2f} deg (standard deviation {estimate.direction_sigma_deg:.2f})",
            )
        )
    if turn_deg > turn_limit and clear:
        x, y, z = np.degrees(so3_log(estimate.R_cam1_cam0 @ R_given.T))
        found.append(
            Finding(
                "left-right rotation wrong",
                f"off by {turn_deg:.2f} deg ({x:+.2f} {y:+.2f} {z:+.2f} about x y z of cam1; standard deviation "
                f"{estimate.rotation_sigma_deg:.3f})",
            )
        )
    return tuple(found)


def judge_exchange(matches: RayMatches, exchanged: RayMatches, T_cam0_cam1: FloatArray) -> tuple[Finding, ...]:
    """Say whether the given calibration (4, 4) fits the images much better with the two cameras' images exchanged.

    Args:
        matches: rays by the cameras as the recording has them.
        exchanged: the same matches, each image taken for the other camera's.
        T_cam0_cam1: given pose of cam1 in cam0.
    """
    if too_few(matches) is not None or too_few(exchanged) is not None:
        return ()
    direction = T_cam0_cam1[:3, 3] / np.linalg.norm(T_cam0_cam1[:3, 3])
    as_given, other_way = (
        float(np.degrees(epipolar_spread(T_cam0_cam1[:3, :3].T, direction, m))) for m in (matches, exchanged)
    )
    if other_way * _CLEARLY_WORSE > as_given or other_way > _EXCHANGED_DEG:
        return ()
    return (
        Finding(
            "cameras swapped",
            f"with the images of cam0 and cam1 exchanged the calibration fits them to {other_way:.3f} deg, as they are "
            f"to {as_given:.3f} deg; exchange the two image folders",
        ),
    )


def judge_imu(alignment: ImuAlignment, lever: LeverArm | NotObservable, T_cam0_imu: FloatArray) -> tuple[Finding, ...]:
    """Compare measured IMU-camera extrinsics and clocks with a given transform (4, 4)."""
    found: list[Finding] = []
    R, t = T_cam0_imu[:3, :3], T_cam0_imu[:3, 3]
    off = so3_log(alignment.R_cam0_imu @ R.T)
    sigma = np.maximum(alignment.rotation_sigma_deg, 1e-3)
    significant = np.abs(np.degrees(off)) > np.maximum(_NAMED_IMU_ROTATION_DEG, 5 * sigma)
    turn_deg = float(np.degrees(np.linalg.norm(off)))
    inverse_deg = float(rotation_angle_deg(alignment.R_cam0_imu @ R))
    rotation_ok = not significant.any()
    if not rotation_ok and inverse_deg < max(5.0, 5 * float(sigma.max())):
        found.append(
            Finding("IMU-camera rotation inverted", f"the inverse of the given one fits to {inverse_deg:.2f} deg")
        )
    elif not rotation_ok:
        x, y, z = np.degrees(off)
        found.append(
            Finding(
                "IMU-camera rotation wrong",
                f"off by {turn_deg:.2f} deg ({x:+.2f} {y:+.2f} {z:+.2f} about x y z of cam0; standard deviations "
                f"{sigma[0]:.2f} {sigma[1]:.2f} {sigma[2]:.2f})",
            )
        )
    if isinstance(lever, LeverArm):
        off_m = float(np.linalg.norm(lever.t_cam0_imu - t))
        limit_m = max(_NAMED_LEVER_M, 5 * float(np.linalg.norm(lever.sigma_m)))
        others = {
            "its negative": -t,
            "as the camera's position in the IMU frame it": -R @ t,
            "the inverse transform": -R.T @ t,
        }
        nearest = min(others, key=lambda name: float(np.linalg.norm(lever.t_cam0_imu - others[name])))
        near_m = float(np.linalg.norm(lever.t_cam0_imu - others[nearest]))
        if off_m > limit_m and near_m < 0.5 * off_m:
            found.append(
                Finding(
                    "IMU-camera translation inverted",
                    f"measured {_triple(lever.t_cam0_imu)} m, given {_triple(t)} m; {nearest} fits to {near_m:.3f} m",
                )
            )
        elif off_m > limit_m:
            found.append(
                Finding(
                    "IMU-camera translation wrong",
                    f"measured {_triple(lever.t_cam0_imu)} m (standard deviations {_triple(lever.sigma_m)}), given "
                    f"{_triple(t)} m",
                )
            )
    if alignment.time_offset_sigma_s < _TIME_OFFSET_S and abs(alignment.time_offset_s) > max(
        _NAMED_OFFSET_S, 5 * alignment.time_offset_sigma_s
    ):
        found.append(
            Finding(
                "clocks apart",
                f"IMU minus camera {1e3 * alignment.time_offset_s:+.2f} ms (standard deviation "
                f"{1e3 * alignment.time_offset_sigma_s:.2f})",
            )
        )
    return tuple(found)


_CLEARLY_WORSE = 2.0  # spread of the given calibration's epipolar angles over that of the measured one
_EXCHANGED_DEG = 0.2  # largest epipolar angle of a calibration that fits
_NAMED_ROTATION_DEG = 0.3  # smaller differences are not called faults
_NAMED_DIRECTION_DEG = 1.0
_NAMED_IMU_ROTATION_DEG = 0.5
_NAMED_LEVER_M = 0.03
_NAMED_OFFSET_S = 0.002


def _between_deg(a: FloatArray, b: FloatArray) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def _triple(v: FloatArray) -> str:
    return f"({v[0]:.3f}, {v[1]:.3f}, {v[2]:.3f})"
