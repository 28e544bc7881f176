"""Consistency of the sliding-window filter, with the noise known and learned.

    python -m tools.consistency [--motions imu none velocity] [--variants VARIANT …] [--runs 20]
    [--seconds 7.5]
        [--pixel-sigma 1.0] [--features 60] [--landmarks 30] [--outliers 0.0] [--imu-offset-ms 0.0]
        [--jobs 2]

Monte-Carlo flights through exact points, with exact noise: pixels, IMU and its biases, velocities,
and the place and yaw of the start are drawn from the very distributions that the filter assumes.
Each flight is flown once by every variant, with the same noise. Prints tables in Markdown;
docs/notes/consistency.md sums them up.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, get_args
from unittest.mock import patch

import numpy as np

from vio.errors import VioError
from vio.evaluation.consistency import nees, nees_bounds
from vio.filters import imu_start, navigation, window_tracks
from vio.filters.msckf import Msckf
from vio.filters.navigation import NavState
from vio.filters.noise import MotionNoise
from vio.filters.settings import MsckfSettings
from vio.filters.track_records import Residuals
from vio.filters.window import Window
from vio.filters.window_tracks import WindowTracks
from vio.geometry.lie import (
    FloatArray,
    se3_adjoint,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    se3_log,
    so3_exp,
    so3_hat,
    so3_log,
    transform_points,
)
from vio.geometry.stereo import StereoCamera, project
from vio.imu.settings import ImuSettings
from vio.numerics.threads import one_blas_thread
from vio.records import (
    BoolArray,
    ImuSample,
    IntArray,
    MotionSample,
    MotionSource,
    Observations,
    VelocitySample,
    observations,
)

Motion = Literal["imu", "none", "velocity"]
Start = Literal["uncertain", "known"]
Variant = Literal["right-invariant", "right-invariant, noise learned"]
Group = tuple[Motion, Start, Variant]

CAMERA = StereoCamera(460.0, 458.0, 370.0, 240.0, 0.11, 752, 480)
T_CAM0_IMU = se3_from_parts(
    np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.05, -0.02, 0.1])
)
IMU = ImuSettings(gyro_bias_sigma_radps=0.02, accel_bias_sigma_mps2=0.05)
_FRAME_NS = 50_000_000
_IMU_NS = 5_000_000
SAMPLES = _FRAME_NS // _IMU_NS  # of the IMU in a frame
# Standard deviations of the first position, m, and of the first yaw, rad.
_START: dict[Start, tuple[float, float]] = {
    "uncertain": (0.05, np.radians(1.0)),
    "known": (0.0, 0.0),
}
_MOTIONS: tuple[Motion, ...] = get_args(Motion)
_VARIANTS: tuple[Variant, ...] = get_args(Variant)
_MEASURES = {
    "pose": 6,
    "position": 3,
    "orientation": 3,
    "yaw": 1,
    "velocity": 3,
    "gyro bias": 3,
    "accel bias": 3,
}


class JudgedTracks(WindowTracks):
    """Remembers how well the tracks of each frame fit."""

    def __init__(self, camera: StereoCamera, settings: MsckfSettings) -> None:
        super().__init__(camera, settings)
        self.nis: list[float] = []

    def gate(self, at: Residuals) -> tuple[BoolArray, FloatArray, IntArray]:
        """Gate as always, and note the mean."""
        good, nis, dof = super().gate(at)
        self.nis.append(float(np.mean(nis / dof)) if len(nis) else float("nan"))
        return good, nis, dof


class UncertainStart(Msckf):
    """The sliding-window filter, uncertain of its first place and yaw."""

    def __init__(
        self,
        settings: MsckfSettings,
        motion: MotionSource | None,
        *,
        start: Start,
        learn_noise: bool,
    ) -> None:
        super().__init__(CAMERA, T_CAM0_IMU, settings, motion=motion, imu=IMU)
        self._start = _START[start]
        self._begun = False
        self._learn_noise = learn_noise
        self._frame.fit.tracks = self._judged = JudgedTracks(CAMERA, settings)

    @property
    def nis(self) -> list[float]:
        """Of every frame, the tracks' mean squared residual per degree of freedom."""
        return self._judged.nis

    def _measure(self) -> None:
        """Right after the start, once, make place and yaw uncertain."""
        if not self._begun:
            if not self._learn_noise:
                self._propagation.noise = MotionNoise(1.0, 1.0, 1.0)
            position_sigma, yaw_sigma = self._start
            P = self._started().prior.P
            P[:3, :3] += np.eye(3) * position_sigma**2
            P[5, 5] += yaw_sigma**2
            self._begun = True
        super()._measure()

    def _keep_first_attitude(self, window: Window) -> None:
        """The errors are judged in the world that gravity keeps upright."""

    @property
    def nav(self) -> NavState:
        """The navigation state."""
        return self._started().nav

    @property
    def nav_covariance(self) -> FloatArray:
        """Covariance (15, 15) of the navigation state's right-invariant error."""
        return self._propagation.posterior.own


# The flights


@dataclass(frozen=True, slots=True)
class Scenario:
    """What every flight shares."""

    seconds: float = 7.5
    pixel_sigma_px: float = 1.0
    features: int = 60
    landmarks: int = 30
    outliers: float = 0.0  # share of the features that are mismatched by up to 40 px in every frame
    imu_offset_s: float = 0.0  # of the IMU's samples against the frames, less than one sample

    @property
    def frames(self) -> int:
        """How many."""
        return round(self.seconds * 1e9 / _FRAME_NS)

    def settings(self, *, learn_noise: bool) -> MsckfSettings:
        """Return the filter's settings: the truth about all noise, or, to learn it, where
        learning starts.
        """
        s = MsckfSettings(
            max_landmarks=self.landmarks,
            pixel_sigma_px=self.pixel_sigma_px,
            calibrate_camera_imu="none",  # the other variants know the errors of the motion alone
            calibrate_imu="off",
            calibrate_stereo="off",
            stereo_baseline_sigma=0.0,
            stereo_focal_sigma=0.0,  # the rig is exact
        )
        if learn_noise:
            return s
        return replace(s, pixel_sigma_max_px=self.pixel_sigma_px)

    @contextmanager
    def priors(self, *, learn_noise: bool) -> Iterator[None]:
        """Inside the block, use the priors of these flights and, unless it is learned, the true
        pixel noise.
        """
        least_px = window_tracks.MIN_PIXEL_SIGMA_PX if learn_noise else self.pixel_sigma_px
        with (
            patch.object(imu_start, "START_TILT_SIGMA_DEG", 1.0),
            patch.object(navigation, "START_VELOCITY_SIGMA_MPS", 2.0),
            patch.object(window_tracks, "MIN_PIXEL_SIGMA_PX", least_px),
        ):
            yield


class Flight:
    """Rounds through a room, looking ahead, with a nodding and rolling body."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        walls = rng.uniform([-7, -7, -2], [7, 7, 3], (3000, 3))
        side = rng.integers(0, 4, len(walls))
        for k, (axis, value) in enumerate([(0, -7.0), (0, 7.0), (1, -7.0), (1, 7.0)]):
            walls[side == k, axis] = value + rng.uniform(-1.5, 1.5, int((side == k).sum()))
        self.points = walls

    def state(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rotations (K, 3, 3), positions (K, 3) and velocities (K, 3) at times (K,), s."""
        w = 2 * np.pi / 16.0
        h = 1e-4

        def position(s: FloatArray) -> FloatArray:
            x = 3.5 * np.sin(w * s)
            y = 1.7 * np.sin(2 * w * s)
            return np.stack([x, y, 0.5 * np.sin(0.9 * s)], axis=1)

        yaw = 2 * np.pi * t / 25.0 + 0.3 * np.sin(0.7 * t)
        zero = np.zeros_like(t)
        tilt = np.stack([0.1 * np.sin(1.1 * t), 0.12 * np.sin(0.9 * t), zero], axis=1)
        R = so3_exp(np.stack([zero, zero, yaw], axis=1)) @ so3_exp(tilt)
        return R, position(t), (position(t + h) - position(t - h)) / (2 * h)

    def rates(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Angular rates (K, 3), rad/s, and specific forces (K, 3), m/s^2, of the body at times
        (K,).
        """
        h = 1e-4
        R, _, _ = self.state(t)
        (R0, _, v0) = self.state(t - h)
        (R1, _, v1) = self.state(t + h)
        omega = so3_log(np.swapaxes(R0, 1, 2) @ R1) / (2 * h)
        a = (v1 - v0) / (2 * h) + [0.0, 0.0, 9.81]
        return omega, (np.swapaxes(R, 1, 2) @ a[..., None])[..., 0]

    def imu(
        self,
        samples: range,
        noise: np.random.Generator,
        s: ImuSettings,
        offset_s: float = 0.0,
        clock_s: float = 0.0,
    ) -> tuple[list[ImuSample], FloatArray]:
        """Samples at 200 Hz, and the biases (K, 6) in them: drawn from the prior, then walking.

        Args:
            samples: their numbers; 0 is at the first frame.
            noise: of sensor and biases.
            s: what they are drawn from.
            offset_s: of the samples against the frames.
            clock_s: by which their stamps are ahead of the frames' clock.
        """
        k = np.array(samples)
        n = len(samples)
        dt = _IMU_NS * 1e-9
        walk = np.repeat([s.gyro_bias_walk, s.accel_bias_walk], 3) * np.sqrt(dt)
        steps = noise.normal(0, 1, (n, 6)) * walk
        steps[0] = noise.normal(0, np.repeat([s.gyro_bias_sigma_radps, s.accel_bias_sigma_mps2], 3))
        bias = np.cumsum(steps, axis=0)
        white = np.repeat([s.gyro_noise_density, s.accel_noise_density], 3) / np.sqrt(dt)
        exact = np.concatenate(self.rates(k.astype(np.float64) * dt + offset_s), axis=1)
        read = exact + bias + noise.normal(0, 1, (n, 6)) * white
        stamps = k * _IMU_NS + round(1e9 * offset_s) + round(1e9 * clock_s)
        return [
            ImuSample(t, x[:3], x[3:]) for t, x in zip(stamps.tolist(), read, strict=True)
        ], bias

    def velocities(
        self, frames: int, noise: np.random.Generator, s: MsckfSettings
    ) -> list[VelocitySample]:
        """Samples at the frames, with white noise and a constant bias of the rate."""
        t = _times(frames)
        R, _, v = self.state(t)
        linear = (np.swapaxes(R, 1, 2) @ v[..., None])[..., 0] + noise.normal(
            0, s.linear_velocity_sigma_mps, v.shape
        )
        bias = noise.normal(0, navigation.RATE_BIAS_SIGMA_RADPS, 3)
        angular = self.rates(t)[0] + bias + noise.normal(0, s.angular_rate_sigma_radps, v.shape)
        return [VelocitySample(k * _FRAME_NS, linear[k], angular[k]) for k in range(frames)]

    def frame(
        self, k: int, T_world_imu: FloatArray, scenario: Scenario, noise: np.random.Generator
    ) -> Observations:
        """What the cameras see: of the points in view those with the lowest numbers, so that
        tracks last.
        """
        p = transform_points(T_CAM0_IMU @ se3_inverse(T_world_imu), self.points)
        near = (p[:, 2] > 0.8) & (p[:, 2] < 14)
        z = project(CAMERA, np.where(near[:, None], p, [0.0, 0.0, 10.0]))
        inside = near & (z[:, 2] > 5) & (z[:, 0] < 747) & (z[:, 1] > 5) & (z[:, 1] < 475)
        ids = np.flatnonzero(inside)[: scenario.features]
        seen = z[ids] + noise.normal(0, scenario.pixel_sigma_px, (len(ids), 4))
        if scenario.outliers:
            wrong = noise.random(len(ids)) < scenario.outliers
            seen += wrong[:, None] * noise.uniform(-40, 40, (len(ids), 2))[:, [0, 1, 0, 1]]
        return observations(k, k * _FRAME_NS, ids, seen)


def _times(frames: int) -> FloatArray:
    """Times (F,) of the frames, s."""
    return np.arange(frames, dtype=np.float64) * (_FRAME_NS * 1e-9)


@dataclass(frozen=True, slots=True)
class Job:
    """One flight by one variant."""

    scenario: Scenario
    motion: Motion
    start: Start
    variant: Variant
    seed: int


@dataclass(frozen=True, slots=True)
class Record:
    """What one flight showed; arrays hold an entry per frame."""

    job: Job
    nees: dict[str, FloatArray]  # (F,) by measure
    nis: FloatArray  # (F,) mean squared residual of the tracks per degree of freedom
    yaw_sigma_deg: FloatArray  # (F,)
    yaw_error_deg: FloatArray  # (F,)
    position_m: FloatArray  # (F,) error, the drawn start included
    orientation_deg: FloatArray  # (F,)
    drift_m: float  # error of the last position as seen from the first pose


@one_blas_thread()
def fly(job: Job) -> Record:
    """Fly once."""
    learn = job.variant == "right-invariant, noise learned"
    with job.scenario.priors(learn_noise=learn):
        return _fly(job, learn)


def _fly(job: Job, learn: bool) -> Record:
    scenario = job.scenario
    flight = Flight()
    settings = scenario.settings(learn_noise=learn)
    source = None if job.motion == "none" else job.motion
    filt = UncertainStart(settings, source, start=job.start, learn_noise=learn)
    noise = np.random.default_rng(job.seed)
    R, p, v = flight.state(_times(scenario.frames))
    T = se3_from_parts(R, p)
    samples: list[MotionSample] = []
    bias: FloatArray = np.zeros((scenario.frames, 6))
    if job.motion == "imu":
        imu, walked = flight.imu(
            range(SAMPLES * scenario.frames + 1), noise, IMU, scenario.imu_offset_s
        )
        samples = list(imu)
        bias = walked[::SAMPLES][: scenario.frames]
    elif job.motion == "velocity":
        samples = list(flight.velocities(scenario.frames, noise, settings))
    start = np.zeros(6)
    position_sigma, yaw_sigma = _START[job.start]
    start[:3] = noise.normal(0, position_sigma, 3)
    start[5] = noise.normal(0, yaw_sigma)

    navs = []
    covariances = []
    fed_ns = -1
    for k in range(scenario.frames):
        # As in the pipeline, a frame waits for the first IMU sample at or after its exposure.
        while samples and fed_ns < k * _FRAME_NS:
            fed_ns = samples[0].time_ns
            filt.propagate(samples.pop(0))
        filt.update(flight.frame(k, T[k], scenario, noise))
        navs.append(filt.nav)
        covariances.append(filt.nav_covariance)
    shift = se3_exp(start) @ _start_shift(T[0], navs[0].T_world_imu, upright=job.motion == "imu")
    T = shift @ T
    v = v @ shift[:3, :3].T
    return _record(job, T, v, bias, navs, np.array(covariances), filt.nis)


def _start_shift(T_true: FloatArray, T_estimate: FloatArray, *, upright: bool) -> FloatArray:
    """The transform that puts the first true pose onto the estimate's; upright: by position and
    yaw alone.
    """
    shift = T_estimate @ se3_inverse(T_true)
    if not upright:
        return shift
    # The estimate's first yaw is an exact choice; its tilt is an estimate like any other.
    yaw = np.arctan2(shift[1, 0] - shift[0, 1], shift[0, 0] + shift[1, 1])
    R = so3_exp([0.0, 0.0, yaw])
    return se3_from_parts(R, T_estimate[:3, 3] - R @ T_true[:3, 3])


def _record(
    job: Job,
    T: FloatArray,
    v: FloatArray,
    bias: FloatArray,
    navs: list[NavState],
    P: FloatArray,
    nis: list[float],
) -> Record:
    """Errors against what the filter said of them, P (F, 15, 15), in the world that gravity
    keeps upright.
    """
    T_hat = np.array([n.T_world_imu for n in navs])
    to_body = se3_adjoint(se3_inverse(T_hat))
    pose_covariance = to_body @ P[:, :6, :6] @ np.swapaxes(to_body, 1, 2)
    xi = se3_log(se3_inverse(T) @ T_hat)
    world = se3_log(T @ se3_inverse(T_hat))
    values = {
        "pose": nees(xi, pose_covariance),
        "position": nees(xi[:, :3], pose_covariance[:, :3, :3]),
        "orientation": nees(xi[:, 3:], pose_covariance[:, 3:, 3:]),
        "yaw": world[:, 5] ** 2 / P[:, 5, 5],
    }
    if job.motion == "imu":
        v_hat = np.array([n.velocity for n in navs])
        H = np.concatenate([-so3_hat(v_hat), np.tile(np.eye(3), (len(navs), 1, 1))], axis=2)
        values["velocity"] = nees(v - v_hat, H @ P[:, 3:9, 3:9] @ np.swapaxes(H, 1, 2))
        values["gyro bias"] = nees(
            bias[:, :3] - np.array([n.gyro_bias for n in navs]), P[:, 9:12, 9:12]
        )
        values["accel bias"] = nees(
            bias[:, 3:] - np.array([n.accel_bias for n in navs]), P[:, 12:, 12:]
        )
    last = se3_log(se3_inverse(se3_inverse(T[0]) @ T[-1]) @ se3_inverse(T_hat[0]) @ T_hat[-1])
    return Record(
        job,
        values,
        np.array(nis),
        np.degrees(np.sqrt(P[:, 5, 5])),
        np.degrees(np.abs(world[:, 5])),
        np.linalg.norm(xi[:, :3], axis=1),
        np.degrees(np.linalg.norm(xi[:, 3:], axis=1)),
        float(np.linalg.norm(last[:3])),
    )


# The comparison


def main() -> int:
    """Fly everything and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    usual = Scenario()
    parser.add_argument("--motions", nargs="+", default=list(_MOTIONS), choices=_MOTIONS)
    parser.add_argument("--variants", nargs="+", default=list(_VARIANTS), choices=_VARIANTS)
    parser.add_argument("--runs", type=int, default=20, help="flights per motion model and variant")
    parser.add_argument("--seconds", type=float, default=usual.seconds, help="length of a flight")
    parser.add_argument(
        "--pixel-sigma", type=float, default=usual.pixel_sigma_px, help="noise of a pixel"
    )
    parser.add_argument(
        "--features", type=int, default=usual.features, help="points seen in a frame"
    )
    parser.add_argument(
        "--landmarks", type=int, default=usual.landmarks, help="most landmarks in the state"
    )
    parser.add_argument("--outliers", type=float, default=0.0, help="share of mismatched features")
    parser.add_argument(
        "--imu-offset-ms", type=float, default=0.0, help="of the IMU's samples against the frames"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    args = parser.parse_args()
    scenario = Scenario(
        args.seconds,
        args.pixel_sigma,
        args.features,
        args.landmarks,
        args.outliers,
        args.imu_offset_ms * 1e-3,
    )
    # Every motion model from an uncertain start, the IMU from a known one too.
    groups: list[Group] = [
        (motion, "uncertain", variant) for motion, variant in product(args.motions, args.variants)
    ]
    groups += [("imu", "known", variant) for variant in args.variants if "imu" in args.motions]
    jobs = [Job(scenario, *group, seed=seed) for seed, group in product(range(args.runs), groups)]
    records: dict[Group, list[Record]] = {group: [] for group in groups}
    try:
        with ProcessPoolExecutor(max(args.jobs, 1)) as pool:
            for k, (job, record) in enumerate(zip(jobs, pool.map(fly, jobs), strict=True), start=1):
                group = (job.motion, job.start, job.variant)
                records[group].append(record)
                print(f"{k}/{len(jobs)} {' '.join(group)} {job.seed}", file=sys.stderr)
    except VioError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{_nees_table(records)}\n\n{_error_table(records)}\n")
    return 0


def _nees_table(records: Mapping[Group, Sequence[Record]]) -> str:
    """Return NEES by measure in Markdown, without the first frame, where the pose is what was
    drawn.
    """
    lines = [
        "Mean NEES ± its standard error over the runs (share of the frames inside the 95 % band)",
        "",
        "| motion, start | variant | "
        + " | ".join(f"{m} ({d})" for m, d in _MEASURES.items())
        + " | NIS (1) |",
        "|---|---" + "|---:" * (len(_MEASURES) + 1) + "|",
    ]
    for (motion, start, variant), runs in records.items():
        cells = [
            _nees_cell(np.array([r.nees[m][1:] for r in runs]), dimension)
            if m in runs[0].nees
            else "–"
            for m, dimension in _MEASURES.items()
        ]
        nis = np.nanmean([r.nis[1:] for r in runs])
        lines.append(f"| {motion}, {start} | {variant} | {' | '.join(cells)} | {nis:.2f} |")
    return "\n".join(lines)


def _nees_cell(values: FloatArray, dimension: int) -> str:
    """Tell NEES (R, F) over runs and frames."""
    runs = len(values)
    mean = values.mean(axis=0)
    low, high = nees_bounds(dimension, runs)
    inside = np.mean((mean >= low) & (mean <= high))
    error = values.mean(axis=1).std(ddof=min(runs - 1, 1)) / np.sqrt(runs)
    digits = 1 if mean.mean() >= 20 else 2
    return f"{mean.mean():.{digits}f} ± {error:.{digits}f} ({100 * inside:.0f} %)"


def _error_table(records: Mapping[Group, Sequence[Record]]) -> str:
    """Return what the filter estimates for yaw beside the errors, likewise."""
    lines = [
        "| motion, start | variant | yaw sigma at 1 s (deg) | least | at the end | yaw error at "
        "the end, RMS "
        "| position RMSE (m) | orientation RMSE (deg) | drift at the end, RMS (m) |",
        "|---|---" + "|---:" * 7 + "|",
    ]
    for (motion, start, variant), runs in records.items():
        sigma = np.sqrt(np.mean([r.yaw_sigma_deg[1:] ** 2 for r in runs], axis=0))
        second = min(round(1e9 / _FRAME_NS), len(sigma)) - 1
        cells = [
            f"{x:.3f}"
            for x in (
                sigma[second],
                sigma.min(),
                sigma[-1],
                _rms(r.yaw_error_deg[-1] for r in runs),
            )
        ]
        cells.append(f"{_rms(r.position_m[1:] for r in runs):.4f}")
        cells.append(f"{_rms(r.orientation_deg[1:] for r in runs):.3f}")
        cells.append(f"{_rms(r.drift_m for r in runs):.4f}")
        lines.append(f"| {motion}, {start} | {variant} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _rms(values: Iterable[float | FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.array([*values]) ** 2)))


if __name__ == "__main__":
    sys.exit(main())
