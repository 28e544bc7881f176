"""Watch a run's IMU for what makes it useless: units, signs, axes, extrinsics, clocks, clipping, silence.

Nothing here knows a filter. The camera's motion comes from the stereo tracks of consecutive frames, the gyro and the
accelerometer are fitted to it by *general* linear maps, and every named explanation (the given extrinsics, their
inverse, a permutation of axes, degrees, g, …) is then judged by how much worse it fits than the general map. A fault is
named only where the given calibration fails clearly and the explanation does not; equations (I1) to (I4) stand in
docs/inertial.md.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.calibration.egomotion import CameraMotion, stereo_twists
from vio.calibration.findings import NotObservable
from vio.calibration.gyro import ImuAlignment, Rates
from vio.calibration.levers import LeverArm, lever_arm
from vio.calibration.verdicts import judge_imu
from vio.evaluation import rotation_angle_deg
from vio.geometry.lie import FloatArray, se3_exp, so3_exp
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, ImuSample, IntArray, Observations, feature_tracks

log = logging.getLogger(__name__)

InertialFault: TypeAlias = Literal[
    "clocks without overlap",
    "clocks overlap in part",
    "clocks apart",
    "accelerometer units",
    "gravity removed",
    "gyro units",
    "gyro sign",
    "gyro axes",
    "gyro disagrees",
    "extrinsics inverted",
    "extrinsics rotation",
    "extrinsics translation",
    "accelerometer sign",
    "accelerometer axes",
    "upside down",
    "saturation",
    "IMU gap",
]


@dataclass(frozen=True, slots=True)
class InertialFinding:
    """One thing that is wrong with the IMU, its clock or its extrinsics."""

    fault: InertialFault
    seen: str  # what the data show, with figures
    explanation: str  # what would explain it, and what to do
    certain: bool = True  # False: a hint; correct data can look like this

    @property
    def message(self) -> str:
        """One line for the log."""
        return f"{self.fault}: {self.seen}; {self.explanation}"

    def __str__(self) -> str:
        return self.message


_NS = 1e-9
_GRAVITY = 9.80665

_TRACKS = 80  # of a frame that the camera's motion is computed from
_LEAST_LINKS = 15  # tracks between two frames
_BATCH = 20  # frames whose motion is computed at once
_LONGEST_INTERVAL_S = 0.25
_LEAST_AT_END = 20  # intervals for a verdict when the run ends
_FIRST_LOOKS = 60  # intervals between two looks, at first …
_LATER_LOOKS = 150  # … and when there are enough
_MEMORY_S = 60.0  # older samples and motions are forgotten
_ENOUGH = 400  # intervals of turning about all axes after which the watch ends

_LEAST_TURN_RADPS = 0.02  # a camera that turns less says nothing about a gyro
_CLEAR_OF_NOISE = 5.0  # the turning must exceed the noise of the images' rates by this factor
_DISAGREES = 0.5  # share of the turning that the best linear map leaves unexplained
_AGREES = 0.2  # likewise: below this, explanations are judged
_EXCESS = 0.2  # misfit over the best linear map, as a share of the turning: 11 degrees, or 20 % of scale
_EXCESS_CLIPPED = 0.5  # likewise where readings are clipped, which turns and shortens what the gyro shows
_EXCESS_BRIEF = 0.7  # likewise with fewer intervals than the first look has
_CHANCE = 30.0  # over the intervals, times the unexplained share: squared excess that the map's freedom may bring
_CLEARLY_WORSE = 2.0
_NAMED_OFFSET_S = 0.02
_NEAR_OFFSETS_S = np.arange(-0.1, 0.1001, 0.01)
_FAR_OFFSETS_S = np.arange(-5.0, 5.001, 0.025)

_WINDOW_S = 2.0  # of the accelerometer's fit
_LEAST_WINDOWS = 3
_SIGN_SIGMAS = 6.0
_AXES_WORSE = 3.0  # squared misfit of the given axes over that of others
_BIAS_PRIOR_MPS2 = 0.3
_LEVER_PRIOR_M = 1.0
_MISFIT_M = 0.02  # of a window's positions, to weigh the priors

_SMOOTH_S = 0.2  # readings are averaged over this much before their size is looked at
_LEAST_SIZE_S = 1.0
_UPSIDE_DOWN = 0.5  # cosine between image-down and up: within 60 degrees
_UPSIDE_SHARE = 0.95

_LEAST_RUN = 5  # equal readings at the extreme in a row
_LEAST_CHANCE = 1e-8  # of such a run by coarse steps alone
_LEAST_LEVELS = 20  # different readings around it
_GAP_S = 0.1
_GAP_STEPS = 8.0
_NO_IMU_FRAMES, _NO_IMU_S = 10, 0.4
_COVERED = 0.97


# --- clocks ---------------------------------------------------------------------------------------------------------


def judge_clocks(frame_times_ns: IntArray, imu_times_ns: IntArray) -> tuple[InertialFinding, ...]:
    """Say whether the IMU's stamps cover those of the frames, and what would explain it if they do not.

    Args:
        frame_times_ns: (F,) increasing.
        imu_times_ns: (S,) increasing.
    """
    if not len(frame_times_ns):
        return ()
    frames = int(frame_times_ns[0]), int(frame_times_ns[-1])
    if not len(imu_times_ns):
        return (_no_overlap(frames, None, 0.0),)
    imu = int(imu_times_ns[0]), int(imu_times_ns[-1])
    covered = float(np.mean((frame_times_ns >= imu[0]) & (frame_times_ns <= imu[1])))
    step_ns = float(np.median(np.diff(imu_times_ns))) if len(imu_times_ns) > 1 else 0.0
    if covered == 0.0:
        return (_no_overlap(frames, imu, step_ns),)
    uncovered_s = (1 - covered) * (frames[1] - frames[0]) * _NS
    return () if covered >= _COVERED or uncovered_s < 1.0 else (_part_overlap(frames, imu, step_ns, covered),)


def _no_overlap(frames: tuple[int, int], imu: tuple[int, int] | None, step_ns: float) -> InertialFinding:
    seen = f"frames from {frames[0]} to {frames[1]} ns"
    if imu is None:
        return InertialFinding(
            "clocks without overlap",
            f"{seen}, no IMU sample among them",
            "the IMU's stamps may count from another epoch or in another unit (ns, us, ms, s); give both one clock, "
            "or use --motion none",
        )
    seen = f"{seen}, IMU samples from {imu[0]} to {imu[1]} ns, no time in common"
    unit = _unit_of_clock(frames, imu, step_ns)
    if unit is not None:
        return InertialFinding("clocks without overlap", seen, unit)
    lengths = [(span[1] - span[0]) * _NS for span in (frames, imu)]
    offset_s = (imu[0] - frames[0]) * _NS
    alike = 0.5 < max(lengths[1], 1e-9) / max(lengths[0], 1e-9) < 2
    same = f"both last about as long ({lengths[0]:.1f} and {lengths[1]:.1f} s): " if alike else ""
    return InertialFinding(
        "clocks without overlap",
        seen,
        f"{same}the clocks may count from other epochs (the IMU starts {offset_s:+.3f} s from the frames), or the "
        "files belong to other recordings; move the IMU's stamps onto the camera's clock",
    )


def _part_overlap(frames: tuple[int, int], imu: tuple[int, int], step_ns: float, covered: float) -> InertialFinding:
    unit = _unit_of_clock(frames, imu, step_ns)
    return InertialFinding(
        "clocks overlap in part",
        f"frames from {frames[0]} to {frames[1]} ns, IMU samples from {imu[0]} to {imu[1]} ns: "
        f"{100 * covered:.1f} % of the frames have IMU samples",
        unit or "a file may be cut short, or the clocks may be shifted; use the frames that both cover, or other files",
    )


def _unit_of_clock(frames: tuple[int, int], imu: tuple[int, int], step_ns: float) -> str | None:
    """Name the power of 1000 that brings the IMU's stamps onto the frames', where there is one."""
    names = {3: "microseconds", 6: "milliseconds", 9: "seconds"}
    for power in (3, 6, 9, -3, -6, -9):
        factor = 10.0**power
        low, high = imu[0] * factor, imu[1] * factor
        shared = min(high, frames[1]) - max(low, frames[0])
        plausible = step_ns == 0 or 1e5 < step_ns * factor < 1e8  # 10 Hz to 10 kHz
        if plausible and shared > 0.5 * max(frames[1] - frames[0], 1):
            what = (
                f"the IMU's stamps are {names[power]}"
                if power > 0
                else f"the frames' stamps are {names[-power]} (or the IMU's were multiplied twice)"
            )
            return f"times 1e{power:+d} the IMU's stamps cover the frames: {what}, read as nanoseconds; convert them"
    return None


# --- camera motion and samples --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Intervals:
    """Frame intervals whose camera motion is known, in time order."""

    begin_ns: IntArray  # (K,)
    end_ns: IntArray  # (K,)
    twists: FloatArray  # (K, 6) [v; omega] of cam0, cam0 frame

    @property
    def dt(self) -> FloatArray:
        return np.asarray((self.end_ns - self.begin_ns) * _NS, dtype=np.float64)


class _Camera:
    """The left camera's twists from frame to frame, from a thinned set of tracks, a batch at a time."""

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        self._kept: list[Observations] = []
        self._guess: list[FloatArray] = []
        self._links: list[int] = []

    def frame(self, seen: Observations) -> _Intervals | None:
        """Take one frame; every `_BATCH` frames the motions since the last batch come back."""
        rows = np.flatnonzero(seen.has_right & ~seen.stale)
        if len(rows) > _TRACKS:
            # The same random choice of ids in every frame, so that tracks go on.
            lot = (seen.ids[rows] * np.int64(2654435761)) & np.int64(0xFFFFFFFF)
            rows = np.sort(rows[np.argpartition(lot, _TRACKS)[:_TRACKS]])
        kept = seen.take(rows)
        if self._kept:
            last = self._kept[-1]
            _, a, b = np.intersect1d(last.ids, kept.ids, assume_unique=True, return_indices=True)
            self._links.append(len(a))
            self._guess.append(self._turning(last, kept, kept.z[b, :2] - last.z[a, :2]))
        self._kept.append(kept)
        return self.flush() if len(self._kept) > _BATCH else None

    def _turning(self, last: Observations, kept: Observations, flow: FloatArray) -> FloatArray:
        """The twist that a pure turn would have, to start from: flow du = -fu wy dt, dv = fv wx dt."""
        out = np.zeros(6)
        dt = (kept.time_ns - last.time_ns) * _NS
        if len(flow) and dt > 0:
            du, dv = np.median(flow, axis=0)
            out[3], out[4] = dv / self._camera.fv / dt, -du / self._camera.fu / dt
        return out

    def flush(self) -> _Intervals | None:
        """The motions since the last batch; None: there are none."""
        if len(self._kept) < 2:
            return None
        kept, links = self._kept, np.array(self._links)
        tracks = feature_tracks(dict(enumerate(kept)), len(kept))
        times_ns = np.array([o.time_ns for o in kept], dtype=np.int64)
        found = stereo_twists(self._camera, tracks, times_ns, np.array(self._guess))
        good = (links[found.frames] >= _LEAST_LINKS) & (np.diff(times_ns)[found.frames] * _NS < _LONGEST_INTERVAL_S)
        frames = found.frames[good]
        self._kept, self._guess, self._links = kept[-1:], [], []
        return _Intervals(times_ns[frames], times_ns[frames + 1], found.twists[good])


class _Samples:
    """The IMU's readings of the last minute, and what is wrong with them by themselves."""

    def __init__(self) -> None:
        self._new: list[ImuSample] = []
        self._times: list[IntArray] = []
        self._values: list[FloatArray] = []
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._step_s: float | None = None

    @property
    def step_s(self) -> float:
        """The usual time between two readings; 0.0 before there are two."""
        if self._step_s is None and len(self._new) > 1:
            self._step_s = float(np.median(np.diff([s.time_ns for s in self._new]))) * _NS
        return self._step_s or 0.0

    def take(self, sample: ImuSample) -> None:
        if self.last_ns is not None and sample.time_ns <= self.last_ns:
            return  # readers refuse clocks that run backwards; a repeated reading says nothing new
        self.first_ns = sample.time_ns if self.first_ns is None else self.first_ns
        self.last_ns = sample.time_ns
        self._new.append(sample)

    def settle(self, *, keep: bool) -> list[InertialFinding]:
        """Look at the readings since the last call, and keep them or let them go."""
        if len(self._new) < 2:
            return []
        times = np.array([s.time_ns for s in self._new], dtype=np.int64)
        values = np.array([[*s.gyro, *s.accel] for s in self._new])
        before = self._times[-1][-1:] if self._times else times[:0]
        steps = np.diff(np.concatenate([before, times])) * _NS
        found = [*_gap(times, steps, self.step_s), *_saturation(times, values)]
        if keep:
            self._times.append(times)
            self._values.append(values)
            while self._times[-1][-1] - self._times[0][-1] > _MEMORY_S / _NS:
                del self._times[0], self._values[0]
        else:
            self._times, self._values = [times[-1:]], [values[-1:]]
        self._new = []
        return found

    def table(self) -> tuple[IntArray, FloatArray]:
        """Times (S,) and readings (S, 6) [gyro; accel]."""
        if not self._times:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 6))
        return np.concatenate(self._times), np.concatenate(self._values)


def _gap(times_ns: IntArray, steps: FloatArray, usual_s: float) -> Iterator[InertialFinding]:
    if not len(steps) or steps.max() <= max(_GAP_S, _GAP_STEPS * usual_s):
        return
    k = len(times_ns) - len(steps) + int(np.argmax(steps))
    yield InertialFinding(
        "IMU gap",
        f"no sample for {steps.max():.3f} s before {times_ns[k]} ns (samples are {1e3 * usual_s:.1f} ms apart)",
        "samples were lost on the way; the pose between is a guess from the samples on both sides",
    )


def _saturation(times_ns: IntArray, values: FloatArray) -> Iterator[InertialFinding]:
    """Runs of equal readings at the extreme of an axis that are no accident of coarse steps or held samples."""
    if len(values) < 4 * _LEAST_RUN:
        return
    equal = values[1:] == values[:-1]
    for axis in range(6):
        for extreme in (values[:, axis].max(), values[:, axis].min()):
            at = values[:, axis] == extreme
            if at.sum() < _LEAST_RUN or at.all():
                continue
            # Neighbours elsewhere that are equal by chance: a run of n happens with probability held^(n-1).
            held = float(np.mean(equal[~(at[1:] & at[:-1]), axis]))
            chance = np.log(_LEAST_CHANCE) / np.log(held) if held > 0 else 0.0
            run = _longest_run(at)
            if run < max(_LEAST_RUN, 1 + chance) or len(np.unique(values[:, axis])) < _LEAST_LEVELS:
                continue
            name, unit = ("gyro", "rad/s") if axis < 3 else ("accelerometer", "m/s^2")
            yield InertialFinding(
                "saturation",
                f"{int(at.sum())} samples of the {name}'s {'xyz'[axis % 3]} axis stand at {extreme:.4g} {unit}, {run} "
                f"in a row, near {times_ns[int(np.argmax(at))]} ns",
                "the motion exceeds the sensor's range; choose a larger range, and expect drift there",
            )
            return


def _longest_run(mask: BoolArray) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return int((edges[1::2] - edges[::2]).max()) if len(edges) else 0


@dataclass(frozen=True, slots=True)
class _Record:
    """Intervals and samples on one clock of seconds, with the running integrals of the readings."""

    t: FloatArray  # (S,)
    integral: FloatArray  # (S, 6) of [gyro; accel] over time
    begin: FloatArray  # (K,)
    end: FloatArray  # (K,)
    twists: FloatArray  # (K, 6)
    origin_ns: int

    def means(self, offsets: npt.NDArray[np.floating]) -> tuple[FloatArray, BoolArray]:
        """Mean readings (M, K, 6) over the intervals shifted by offsets (M,), and where (M, K) samples cover them."""
        edges = [edge[None, :] + offsets[:, None] for edge in (self.begin, self.end)]
        low, high = (
            np.stack([np.interp(at.ravel(), self.t, self.integral[:, k]).reshape(at.shape) for k in range(6)], axis=-1)
            for at in edges
        )
        covered = (edges[0] >= self.t[0]) & (edges[1] <= self.t[-1])
        holes = np.flatnonzero(np.diff(self.t) > _GAP_S)
        for k in holes:
            covered &= (edges[1] <= self.t[k]) | (edges[0] >= self.t[k + 1])
        return (high - low) / (self.end - self.begin)[None, :, None], covered


def _record(intervals: _Intervals, times_ns: IntArray, values: FloatArray) -> _Record:
    origin = int(intervals.begin_ns[0])
    t, begin, end = (
        np.asarray((x - origin) * _NS, dtype=np.float64) for x in (times_ns, intervals.begin_ns, intervals.end_ns)
    )
    steps = np.diff(t)[:, None] * (values[1:] + values[:-1]) / 2
    integral = np.concatenate([np.zeros((1, 6)), np.cumsum(steps, axis=0)])
    return _Record(t, integral, begin, end, intervals.twists, origin)


# --- gyro against images --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Turning:
    """Second moments of the camera's and the gyro's rates at one clock offset, and the best linear map, (I1)."""

    offset_s: float
    S_cc: FloatArray  # (3, 3) camera, weighted mean of products, (rad/s)^2
    S_cg: FloatArray  # (3, 3) camera and gyro
    S_gg: FloatArray  # (3, 3) gyro
    A: FloatArray  # (3, 3) camera rate = A gyro + b
    b: FloatArray  # (3,)
    unexplained: float  # share of the camera's turning that the map leaves, 0 to 1
    noise_radps: float  # of the images' rates, each axis, from their second differences
    count: int
    gyro: FloatArray  # (K, 3) mean rates
    force: FloatArray  # (K, 3) mean specific forces
    covered: BoolArray  # (K,)

    @property
    def turn_radps(self) -> FloatArray:
        """How much the camera turns about its three principal axes (3,), largest first."""
        out: FloatArray = np.sqrt(np.maximum(np.linalg.eigvalsh(self.S_cc)[::-1], 0))
        return out

    @property
    def axes(self) -> int:
        """About how many axes the camera turns clearly."""
        clear = max(_LEAST_TURN_RADPS, _CLEAR_OF_NOISE * self.noise_radps)
        return int(np.sum(self.turn_radps > clear))

    def scale(self, C: FloatArray) -> float:
        """The factor on an orthogonal map (3, 3) from gyro to camera that fits best."""
        return float(np.sum(C * self.S_cg) / max(float(np.trace(self.S_gg)), 1e-300))

    def excess(self, C: FloatArray, scale: float) -> float:
        """Misfit of `scale C` beyond that of the best linear map, as a share of the turning, (I2)."""
        total = float(np.trace(self.S_cc))
        misfit = total - 2 * scale * float(np.sum(C * self.S_cg)) + scale**2 * float(np.trace(self.S_gg))
        return float(np.sqrt(max(misfit / max(total, 1e-300) - self.unexplained, 0.0)))

    @property
    def tolerance(self) -> float:
        """The excess up to which a map passes as right."""
        return max(_EXCESS, float(np.sqrt(_CHANCE / max(self.count, 1) * self.unexplained)))


def _turning(record: _Record, least: int) -> _Turning | None:
    """Fit the camera's rates by the gyro's at the clock offset that serves best; None: too little turning to tell."""
    omega = record.twists[:, 3:]
    noise = 1.4826 * float(np.median(np.abs(np.diff(omega, 2, axis=0)))) / np.sqrt(6) if len(omega) > 4 else np.inf
    best = _at_offset(record, _NEAR_OFFSETS_S, least, noise)
    if best is None or best.axes == 0:
        return None
    if best.unexplained > _AGREES:
        far = _at_offset(record, _FAR_OFFSETS_S, max(least, len(omega) // 2), noise)
        best = far if far is not None and far.unexplained < 0.5 * best.unexplained else best
    for step in (0.01, 0.003):
        near = _at_offset(record, best.offset_s + step * np.arange(-2, 3), least, noise)
        best = near if near is not None and near.unexplained <= best.unexplained else best
    return best if best.axes else None


def _at_offset(record: _Record, offsets: npt.NDArray[np.floating], least: int, noise: float) -> _Turning | None:
    """The linear map at the best of some clock offsets, refitted without outliers."""
    means, covered = record.means(offsets)
    omega, gyro = record.twists[:, 3:], means[..., :3]
    enough = covered.sum(axis=1) >= least
    if not enough.any():
        return None
    shares = np.where(enough, _moments(omega, gyro, covered.astype(np.float64))[3], np.inf)
    k = int(np.argmin(shares))
    weight = covered[k].astype(np.float64)
    for _ in range(4):
        S_cc, S_cg, S_gg, share, A, b = (x[0] for x in _moments(omega, gyro[k : k + 1], weight[None]))
        r = np.linalg.norm(omega - gyro[k] @ A.T - b, axis=1)
        width = max(2 * 1.4826 * float(np.median(r[covered[k]])), 1e-6)
        weight = covered[k] / (1 + (r / width) ** 2) ** 2
    return _Turning(
        float(offsets[k]),
        S_cc,
        S_cg,
        S_gg,
        A,
        b,
        float(share),
        noise,
        int(covered[k].sum()),
        gyro[k],
        means[k, :, 3:],
        covered[k],
    )


def _moments(omega: FloatArray, gyro: FloatArray, weight: FloatArray) -> tuple[FloatArray, ...]:
    """Centred moments cc, cg, gg (M, 3, 3), unexplained share (M,), A (M, 3, 3) and b (M, 3), for weights (M, K)."""
    w = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    mean_c, mean_g = w @ omega, np.einsum("mk,mki->mi", w, gyro)
    c, g = omega[None] - mean_c[:, None], gyro - mean_g[:, None]
    cw = np.swapaxes(c * w[..., None], 1, 2)
    S_cc, S_cg, S_gg = cw @ c, cw @ g, np.swapaxes(g * w[..., None], 1, 2) @ g
    size = np.trace(S_gg, axis1=1, axis2=2)[:, None, None]
    A = np.linalg.solve(S_gg + (1e-9 * size + 1e-300) * np.eye(3), np.swapaxes(S_cg, 1, 2))
    A = np.swapaxes(A, 1, 2)
    total = np.trace(S_cc, axis1=1, axis2=2)
    share = 1 - np.sum(A * S_cg, axis=(1, 2)) / np.maximum(total, 1e-300)
    return S_cc, S_cg, S_gg, np.clip(share, 0.0, 1.0), A, mean_c - np.einsum("mij,mj->mi", A, mean_g)


# --- accelerometer against images -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _ForceFit:
    """Normal equations of `camera acceleration - gravity = A force + b` over windows, (I3): A by rows, b, lever."""

    N: FloatArray  # (W, 15, 15)
    h: FloatArray  # (W, 15)
    c: FloatArray  # (W,)
    weight: FloatArray  # (W,)

    def reduced(self, keep: BoolArray | None = None) -> tuple[FloatArray, FloatArray, float]:
        """Cost `c - 2 h a + a N a` of a linear map a (9,) alone: bias and lever arm take their best values."""
        w = self.weight if keep is None else self.weight * keep
        N, h, c = np.tensordot(w, self.N, 1), w @ self.h, float(w @ self.c)
        prior = _MISFIT_M**2 / np.repeat([_BIAS_PRIOR_MPS2, _LEVER_PRIOR_M], 3) ** 2
        K = np.linalg.solve(N[9:, 9:] + np.diag(prior), np.column_stack([N[9:, :9], h[9:]]))
        return N[:9, :9] - N[:9, 9:] @ K[:, :9], h[:9] - N[:9, 9:] @ K[:, 9], c - float(h[9:] @ K[:, 9])

    def cost(self, C: FloatArray) -> float:
        """Squared misfit (m^2) of a map (3, 3) from force to the camera frame."""
        N, h, c = self.reduced()
        a = C.reshape(9)
        return max(float(c - 2 * h @ a + a @ N @ a), 0.0)

    def sign(self, C: FloatArray) -> tuple[float, float]:
        """The factor on a map (3, 3) that fits best, and its standard error by a jackknife over windows."""
        a, values = C.reshape(9), []
        every = np.arange(len(self.c))
        for left_out in (-1, *every):
            N, h, _ = self.reduced(every != left_out)
            values.append(float(h @ a) / max(float(a @ N @ a), 1e-300))
        again = np.array(values[1:])
        return values[0], float(np.sqrt((len(again) - 1) * np.mean((again - again.mean()) ** 2)))


def _force_fit(record: _Record, turning: _Turning, lever: FloatArray) -> _ForceFit | None:
    """Normal equations over whole windows; None: too few of them are tracked throughout."""
    dt = record.end - record.begin
    omega = turning.gyro @ turning.A.T + turning.b if turning.unexplained < _AGREES else record.twists[:, 3:]
    joined = np.concatenate([[False], np.abs(record.begin[1:] - record.end[:-1]) < 1e-6])
    blocks = []
    first = 0
    while first < len(dt):
        last = first
        while last < len(dt) and turning.covered[last] and (last == first or joined[last]):
            last += 1
            if record.end[last - 1] - record.begin[first] >= _WINDOW_S:
                rows = slice(first, last)
                blocks.append(_force_window(dt[rows], omega[rows], record.twists[rows], turning.force[rows], lever))
                break
        first = max(last, first + 1)
    if len(blocks) < _LEAST_WINDOWS:
        return None
    N, h, c = (np.array([b[k] for b in blocks]) for k in range(3))
    fit = _ForceFit(N, h, c, np.ones(len(blocks)))
    full = np.concatenate(
        [[_MISFIT_M**2 / 400] * 9, _MISFIT_M**2 / np.repeat([_BIAS_PRIOR_MPS2, _LEVER_PRIOR_M], 3) ** 2]
    )
    for _ in range(4):
        x = np.linalg.solve(np.tensordot(fit.weight, N, 1) + np.diag(full), fit.weight @ h)
        misfit = np.maximum(c - 2 * h @ x + np.einsum("i,wij,j->w", x, N, x), 0)
        weight = 1 / (1 + misfit / max(4 * float(np.median(misfit)), 1e-9)) ** 2
        fit = _ForceFit(N, h, c, weight)
    return fit


def _force_window(
    dt: FloatArray, omega: FloatArray, twists: FloatArray, force: FloatArray, lever: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Normal equations of one window; start velocity and gravity, free in each, are projected out."""
    n = len(dt)
    steps = se3_exp(dt[:, None] * twists)[:, :3, 3]
    turns, halves = so3_exp(dt[:, None] * omega), so3_exp(dt[:, None] / 2 * omega)
    R = np.empty((n + 1, 3, 3))
    R[0] = np.eye(3)
    for k in range(n):
        R[k + 1] = R[k] @ turns[k]
    place = np.cumsum(np.einsum("nij,nj->ni", R[:-1], steps), axis=0)
    middle = R[:-1] @ halves
    gain = np.concatenate([np.einsum("nij,nl->nijl", middle, force).reshape(n, 3, 9), middle], axis=2)
    gain = dt[:, None, None] * gain
    velocity = np.concatenate([np.zeros((1, 3, 12)), np.cumsum(gain, axis=0)])[:-1]
    rows = np.cumsum(dt[:, None, None] * (velocity + gain / 2), axis=0)
    swing = R[1:] - np.eye(3)
    X = np.concatenate([rows, -swing], axis=2)
    y = place + swing @ lever  # the lever's correction to the given one is fitted
    since = np.cumsum(dt)
    Q = np.linalg.qr(np.stack([since, since**2], axis=1))[0]
    X = X - np.tensordot(Q, np.tensordot(Q, X, (0, 0)), (1, 0))
    y = y - Q @ (Q.T @ y)
    X, flat = X.reshape(3 * n, 15), y.reshape(3 * n)
    return X.T @ X / n, X.T @ flat / n, float(flat @ flat) / n


# --- verdicts -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Size:
    """How large the accelerometer's mean readings are, and what that means."""

    finding: InertialFinding | None
    unit: float | None  # factor that makes the readings m/s^2; None: there is none, as gravity is gone
    clear: bool = True  # False: biased readings without gravity can be of this size, too


def _judge_size(times_ns: IntArray, accel: FloatArray) -> _Size:
    """Judge the accelerometer's unit by the size of its mean readings."""
    t = np.asarray((times_ns - times_ns[0]) * _NS, dtype=np.float64)
    if t[-1] < _LEAST_SIZE_S:
        return _Size(None, 1.0)
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(np.diff(t)[:, None] * (accel[1:] + accel[:-1]) / 2, axis=0)])
    edges = np.arange(0.0, t[-1], _SMOOTH_S)
    mean = np.diff(np.stack([np.interp(edges, t, integral[:, k]) for k in range(3)], axis=1), axis=0) / _SMOOTH_S
    size = np.linalg.norm(mean, axis=1)
    median = float(np.median(size))
    spread = 1.4826 * float(np.median(np.abs(size - median))) / max(median, 1e-300)
    if 0.5 < median / _GRAVITY < 2.5:
        return _Size(None, 1.0)
    seen = f"the accelerometer's median size is {median:.4g} where gravity alone makes 9.8 m/s^2"
    units = {
        "g": (1.0, "in g: multiply by 9.81"),
        "mg": (1000.0, "in mg (multiply by 0.00981) or in cm/s^2 (divide by 100)"),
        "mm/s^2": (9807.0, "in mm/s^2: divide by 1000"),
    }
    for gravity, words in units.values():
        if 0.6 < median / gravity < 1.6 and spread < 0.3:
            finding = InertialFinding("accelerometer units", seen, f"the readings are {words}")
            clear = gravity > 1.0 or (abs(median - 1.0) < 0.1 and spread < 0.06)
            return _Size(finding, _GRAVITY / gravity, clear)
    if median < 0.5 * _GRAVITY and (spread >= 0.3 or median < 0.5):
        return _Size(_gravity_removed(f"{seen}, and it varies by {100 * spread:.0f} %"), None)
    finding = InertialFinding(
        "accelerometer units",
        f"{seen} (spread {100 * spread:.0f} %)",
        f"the unit or scale is unknown; a factor of {_GRAVITY / median:.4g} would make it 9.8",
    )
    return _Size(finding, _GRAVITY / median, median > 0.5 * _GRAVITY)


def _gravity_removed(seen: str) -> InertialFinding:
    return InertialFinding(
        "gravity removed",
        seen,
        "gravity has been taken out ('linear acceleration'), or the sensor is dead; a filter needs the raw specific "
        "force (+9.8 m/s^2 upwards at rest)",
    )


def _settle_size(size: _Size, force: _ForceFit | None, R: FloatArray, *, told: bool) -> _Size:
    """Where the size alone leaves it open, ask whether the accelerations are in m/s^2 all the same."""
    if size.clear or size.finding is None or size.unit is None:
        return size
    if force is not None:
        scale, sigma = force.sign(R)
        if 0 < scale < 0.5 * size.unit - _SIGN_SIGMAS * sigma:
            seen = f"{size.finding.seen}, though the images' accelerations are only {scale:.2f} times its own"
            return _Size(_gravity_removed(seen), None)
    return size if told else _Size(None, size.unit)


def _judge_offset(turning: _Turning, record: _Record, least: int) -> InertialFinding | None:
    """A clock offset that matters, where the turning shows it clearly."""
    if abs(turning.offset_s) < _NAMED_OFFSET_S or turning.unexplained > _AGREES:
        return None
    as_stamped = _at_offset(record, np.zeros(1), least, turning.noise_radps)
    if as_stamped is not None and as_stamped.unexplained < _CLEARLY_WORSE * turning.unexplained + 0.003:
        return None
    left = "cannot be compared" if as_stamped is None else f"leaves {100 * as_stamped.unexplained:.1f} % unexplained"
    return InertialFinding(
        "clocks apart",
        f"gyro and images turn together best when a frame stamped t is taken for t {turning.offset_s:+.3f} s of the "
        f"IMU's clock ({100 * turning.unexplained:.1f} % of the turning unexplained; without the shift it {left})",
        f"the IMU's clock is ahead of the camera's by {turning.offset_s:+.3f} s; subtract that from the IMU's stamps",
    )


def _signed_permutations() -> Iterator[FloatArray]:
    """All 48 maps that exchange and invert axes; those that change least come first."""
    every = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    yield from sorted(every, key=lambda P: -float(np.trace(P)))


def _axes_text(P: FloatArray) -> str:
    """How true readings of x y z appear in the record, e.g. `[+y -x +z]`."""
    return "[" + " ".join(f"{'+' if row.sum() > 0 else '-'}{'xyz'[int(np.argmax(np.abs(row)))]}" for row in P) + "]"


def _wahba(S: FloatArray, *, mirrored: bool) -> FloatArray:
    """The rotation, or the reflection, that maximises `tr(C^T S)`. Reference: Markley 1988."""
    U, _, Vt = np.linalg.svd(S)
    sign = np.sign(np.linalg.det(U @ Vt)) * (-1.0 if mirrored else 1.0)
    out: FloatArray = U @ np.diag([1.0, 1.0, sign]) @ Vt
    return out


def _judge_scale(scale: float, share: float) -> InertialFinding:
    seen = f"the gyro must be multiplied by {scale:.4g} to turn as the images do (then {100 * share:.1f} % differ)"
    named = {
        np.pi / 180: "the gyro is in deg/s: multiply its readings by pi/180",
        180 / np.pi: "the gyro was converted from deg/s twice: multiply its readings by 180/pi",
        np.pi / 180e3: "the gyro is in mdeg/s: multiply its readings by pi/180000",
        1e-3: "the gyro is in mrad/s: divide its readings by 1000",
    }
    for factor, words in named.items():
        if abs(np.log(scale / factor)) < 0.15:
            return InertialFinding("gyro units", seen, words)
    return InertialFinding(
        "gyro units", seen, "the gyro's scale is wrong, or the camera's focal length is; rad/s are expected"
    )


def _judge_gyro(
    turning: _Turning, R: FloatArray, force: _ForceFit | None, unit: float, *, told: bool, clipped: bool
) -> list[InertialFinding]:
    """Compare the gyro's turning, mapped by the given rotation (3, 3), with that of the images.

    Args:
        turning: the rates' moments and best linear map.
        R: (3, 3) from the IMU to the camera.
        force: tells whether gyro or extrinsics are at fault; None: unknown.
        unit: factor that makes the accelerometer's readings m/s^2.
        told: `force` will not come to know more; else axes are not judged without it.
        clipped: readings at the end of the range were found, which make turns look smaller.
    """
    brief = turning.count < _FIRST_LOOKS
    if turning.unexplained > _DISAGREES:
        return [] if brief else [_disagreement(turning)]
    limit = max(turning.tolerance, _EXCESS_CLIPPED if clipped else 0.0, _EXCESS_BRIEF if brief else 0.0)
    if turning.unexplained > _AGREES or turning.excess(R, 1.0) < limit:
        return []

    def fits(C: FloatArray) -> bool:
        scale = turning.scale(C)
        return scale > 0 and turning.excess(C, scale) < turning.tolerance

    def units(C: FloatArray) -> list[InertialFinding]:
        scale = turning.scale(C)
        harmless = turning.excess(C, 1.0) < turning.tolerance or (clipped and 0.5 < scale < 2.0)
        return [] if harmless else [_judge_scale(scale, turning.unexplained)]

    if fits(R):
        return units(R)
    if not told:
        return []
    whole = _wahba(turning.S_cg, mirrored=False)
    best = f"; the best rotation lies {rotation_angle_deg(whole @ R.T):.0f} deg from the given one" * fits(whole)
    few = {1: "one axis", 2: "two axes"}.get(turning.axes)
    about = "" if few is None else f" (it turns about {few} only, so other explanations fit, too)"
    share = turning.excess(R, max(turning.scale(R), 0.0))
    seen = (
        f"with the given T_cam0_imu {100 * share:.0f} % of the images' turning contradicts the gyro{best}{about}, and "
    )
    # Where the accelerometer sides with the given rotation, the gyro alone is at fault.
    gyro_alone = force is not None and force.cost(R * unit) * _AXES_WORSE < force.cost(whole * unit)
    for fault, C, what, explanation in _explanations(R, gyro_alone=gyro_alone):
        if fits(C):
            return [InertialFinding(fault, f"{seen}{what}", explanation), *units(C)]
    if brief or clipped:
        return []
    for fault, C, what, explanation in _free_explanations(turning.S_cg):
        if fits(C):
            return [InertialFinding(fault, f"{seen}{what}", explanation), *units(C)]
    stretch = np.linalg.svd(turning.A, compute_uv=False)
    return [
        InertialFinding(
            "gyro units",
            f"{seen}no rotation fits: the best linear map stretches by {_triple(stretch)}",
            "the gyro's axes have different scales, or one of them is dead",
        )
    ]


# A fault, the map (3, 3) from gyro to camera that it would mean, what is seen, and the explanation.
_Explanation: TypeAlias = tuple[InertialFault, FloatArray, str, str]


def _explanations(R: FloatArray, *, gyro_alone: bool) -> Iterator[_Explanation]:
    """Mistakes with a name, the likeliest first."""
    if not gyro_alone:
        yield (
            "extrinsics inverted",
            R.T,
            "the inverse of its rotation fits",
            "T_imu_cam0 was given as T_cam0_imu; invert the transform",
        )
    yield (
        "gyro sign",
        -R,
        "the inverted gyro fits",
        "the gyro turns left-handed (all three rates have the wrong sign); change the sign of its readings",
    )
    if not gyro_alone:
        yield (
            "extrinsics rotation",
            np.eye(3),
            "the identity fits",
            "IMU and camera have the same axes in these files; the rotation of T_cam0_imu should be the identity",
        )
    for P in _signed_permutations():
        # The record shows P^T of the true rates, so that R P maps it to the camera.
        words = f"the gyro's axes read {_axes_text(P.T)} where [+x +y +z] belong"
        if np.linalg.det(P) < 0:
            words = f"{words}, a left-handed frame; put them in order"
            yield "gyro axes", R @ P, "exchanged axes fit", words
        elif gyro_alone:
            yield "gyro axes", R @ P, "exchanged axes fit", f"{words}; put them in order"
        else:
            words = f"T_cam0_imu belongs to other IMU axes, or {words}; its rotation should be {_matrix(R @ P)}"
            yield "extrinsics rotation", R @ P, "a turn by quarter circles fits", words


def _free_explanations(S_cg: FloatArray) -> Iterator[_Explanation]:
    """The rotation and the reflection that fit best."""
    whole = _wahba(S_cg, mirrored=False)
    yield (
        "extrinsics rotation",
        whole,
        "another rotation fits",
        f"the rotation of T_cam0_imu should be about {_matrix(whole)}; run `vio calibrate`",
    )
    yield (
        "gyro axes",
        _wahba(S_cg, mirrored=True),
        "a mirrored frame fits",
        "the gyro's axes are left-handed; check their order and signs",
    )


def _disagreement(turning: _Turning) -> InertialFinding:
    rate = np.degrees(float(np.sqrt(np.trace(turning.S_cc))))
    felt = float(np.sqrt(np.trace(turning.S_gg)))
    return InertialFinding(
        "gyro disagrees",
        f"the images turn by {rate:.1f} deg/s (RMS) and the gyro explains {100 * (1 - turning.unexplained):.0f} % of "
        f"it at no better clock offset within {_FAR_OFFSETS_S[-1]:g} s (the gyro's own RMS is {felt:.3g})",
        "the IMU's file may belong to another recording, the clocks may be further apart, the gyro may be dead, or the "
        "images may show something that moves with the camera",
    )


def _judge_force(
    force: _ForceFit | None, turning: _Turning, R: FloatArray, unit: float, *, last: bool
) -> tuple[list[InertialFinding], bool]:
    """Judge axes and sign of the accelerometer, and say whether its sign was measured.

    Args:
        force: the fit to the images; None: too little.
        turning: what the gyro's fit left behind.
        R: (3, 3) from the IMU to the camera.
        unit: factor that makes the readings m/s^2.
        last: no better fit will come.
    """
    if force is not None:
        wrong = _wrong_axes(force, R * unit)
        if wrong is not None:
            return [wrong], True
        scale, sigma = force.sign(R * unit)
        if abs(scale) > _SIGN_SIGMAS * sigma and 0.5 < abs(scale) < 2.0:
            if scale < 0:
                return [
                    InertialFinding(
                        "accelerometer sign",
                        f"the images' accelerations are {scale:+.2f} times (standard deviation {sigma:.2f}) those "
                        "of the accelerometer",
                        "all readings have the wrong sign (specific force is +9.8 m/s^2 upwards at rest); change it",
                    )
                ], True
            return _upside_down(turning.force[turning.covered], R, measured=True), True
    return (_upside_down(turning.force[turning.covered], R, measured=False) if last else []), False


def _wrong_axes(force: _ForceFit, C: FloatArray) -> InertialFinding | None:
    """Exchanged axes of the accelerometer that fit clearly better than the given ones."""
    given = force.cost(C)
    others = [P for P in _signed_permutations() if abs(np.trace(P)) < 2.5]
    costs = [force.cost(C @ P) for P in others]
    k = int(np.argmin(costs))
    # Neither the given axes nor their negative may explain the readings: the sign is another matter.
    if costs[k] * _AXES_WORSE > min(given, force.cost(-C)):
        return None
    return InertialFinding(
        "accelerometer axes",
        f"with the given axes the accelerometer misses the images' path by {100 * np.sqrt(given):.1f} cm over "
        f"{_WINDOW_S:g} s, with others by {100 * np.sqrt(costs[k]):.1f} cm, while the gyro agrees",
        f"its axes read {_axes_text(others[k].T)} where [+x +y +z] belong; put them in order",
    )


def _upside_down(force: FloatArray, R: FloatArray, *, measured: bool) -> list[InertialFinding]:
    """A hint where the accelerometer's 'up' points down in the image all the time.

    Args:
        force: (K, 3) mean specific forces, imu frame, any unit.
        R: (3, 3) from the IMU to the camera.
        measured: whether motion has shown that the accelerometer's sign is right.
    """
    up = force @ R.T
    down_in_image = up[:, 1] / np.maximum(np.linalg.norm(up, axis=1), 1e-9)
    share = float(np.mean(down_in_image > _UPSIDE_DOWN)) if len(up) else 0.0
    if share < _UPSIDE_SHARE:
        return []
    explanation = (
        "the camera is mounted upside down, or gravity was added with the wrong sign (a + g in place of a - g), which "
        "motion alone cannot tell"
        if measured
        else "the camera is mounted upside down, or the accelerometer's sign, that of its gravity, or T_cam0_imu is "
        "wrong; the motion is too small to tell"
    )
    return [
        InertialFinding(
            "upside down",
            f"the accelerometer's 'up' points down in the image in {100 * share:.0f} % of the frames",
            f"{explanation}; the world will be upside down if it is not the camera",
            certain=False,
        )
    ]


def _judge_lever(record: _Record, turning: _Turning, T_cam0_imu: FloatArray, rates: Rates) -> InertialFinding | None:
    """The lever arm's inversion, by the fit of `vio calibrate`; None also where the motion does not show it."""
    times_ns = record.origin_ns + np.round(np.concatenate([record.begin, record.end[-1:]]) / _NS).astype(np.int64)
    frames = np.flatnonzero(np.concatenate([np.abs(record.begin[1:] - record.end[:-1]) < 1e-6, [True]]))
    motion = CameraMotion(times_ns, frames.astype(np.int64), record.twists[frames])
    bias = np.asarray(-np.linalg.lstsq(turning.A, turning.b, rcond=None)[0], dtype=np.float64)
    alignment = ImuAlignment(
        T_cam0_imu[:3, :3], np.zeros(3), turning.offset_s, 0.0, bias, turning.noise_radps, turning.count, None
    )
    lever: LeverArm | NotObservable = lever_arm(motion, rates, alignment)
    if isinstance(lever, NotObservable):
        log.info("the translation of T_cam0_imu was not checked: %s", lever)
        return None
    faults = judge_imu(alignment, lever, T_cam0_imu)
    detail = next((f.detail for f in faults if f.fault == "IMU-camera translation inverted"), None)
    if detail is None:
        return None
    return InertialFinding(
        "extrinsics translation",
        detail,
        "the translation of T_cam0_imu has the wrong sign or belongs to the inverse transform; it is the IMU's "
        "position in the left camera's frame",
    )


def _matrix(R: FloatArray) -> str:
    return "[" + ", ".join(_triple(row) for row in R) + "]"


def _triple(v: npt.NDArray[np.floating]) -> str:
    return f"[{v[0]:.3f}, {v[1]:.3f}, {v[2]:.3f}]"


# --- the watch ------------------------------------------------------------------------------------------------------

# A second finding of a group would say the same thing in other words.
_GROUPS: dict[InertialFault, str] = {
    "clocks without overlap": "overlap",
    "clocks overlap in part": "overlap",
    "clocks apart": "overlap",
    "accelerometer units": "size",
    "gravity removed": "size",
    "gyro sign": "rotation",
    "gyro axes": "rotation",
    "gyro disagrees": "rotation",
    "extrinsics inverted": "rotation",
    "extrinsics rotation": "rotation",
    "accelerometer sign": "force",
    "accelerometer axes": "force",
    "upside down": "force",
}


class InertialCheck:
    """Watches a run with raw IMU without touching it, and says once what is wrong.

    Give it every sample and every frame's observations in time order, log what `frame` and `finish` return. It stops
    comparing motions once it has seen enough turning about all axes; silences and clipping are watched to the end.
    """

    def __init__(self, camera: StereoCamera, T_cam0_imu: FloatArray) -> None:
        """Prepare.

        Args:
            camera: rectified pair that the observations belong to.
            T_cam0_imu: (4, 4) as the run uses it.
        """
        self._stereo, self._T = camera, np.array(T_cam0_imu, dtype=np.float64)
        self._said: set[str] = set()
        self._samples = _Samples()
        self._first_frame_ns: int | None = None
        self._last_frame_ns = 0
        self._frames = self._frames_covered = 0
        self.again()

    @property
    def done(self) -> bool:
        """Whether the comparison of motions has ended; `again` starts it anew."""
        return self._done

    def again(self) -> None:
        """Compare motions anew from here on; what was said before is not said twice."""
        self._camera = _Camera(self._stereo)
        self._intervals: list[_Intervals] = []
        self._since_look = self._seen = 0
        self._suspected: set[InertialFault] = set()
        self._done = False

    def imu(self, sample: ImuSample) -> None:
        """Take one sample."""
        self._samples.take(sample)

    def frame(self, observations: Observations) -> tuple[InertialFinding, ...]:
        """Take the observations of one frame, and return what has become clear with it."""
        time_ns = observations.time_ns
        self._first_frame_ns = time_ns if self._first_frame_ns is None else self._first_frame_ns
        self._last_frame_ns = time_ns
        self._frames += 1
        last_ns = self._samples.last_ns
        self._frames_covered += last_ns is not None and (time_ns - last_ns) * _NS <= _GAP_S
        found: list[InertialFinding] = []
        if self._frames_covered == 0 and self._frames >= _NO_IMU_FRAMES and self._seconds_of_frames() >= _NO_IMU_S:
            found = [self._no_overlap()]
        if not self._done:
            motion = self._camera.frame(observations)
            if motion is not None:
                found += self._samples.settle(keep=True)
                self._remember(motion)
                if self._since_look >= (_FIRST_LOOKS if self._seen < _ENOUGH else _LATER_LOOKS):
                    found += self._look(last=False)
        elif self._frames % _BATCH == 0:
            found += self._samples.settle(keep=False)
        return self._fresh(found)

    def finish(self) -> tuple[InertialFinding, ...]:
        """Return what the end of the run makes clear; call it also when the run fails."""
        found: list[InertialFinding] = []
        if self._frames and self._frames_covered == 0:
            found = [self._no_overlap()]
        elif self._frames and self._frames_covered < _COVERED * self._frames:
            found = self._part_covered()
        found += self._samples.settle(keep=not self._done)
        if not self._done:
            motion = self._camera.flush()
            if motion is not None:
                self._remember(motion)
            found += self._look(last=True)
        return self._fresh(found)

    def _seconds_of_frames(self) -> float:
        return 0.0 if self._first_frame_ns is None else (self._last_frame_ns - self._first_frame_ns) * _NS

    def _span_of_frames(self) -> tuple[int, int]:
        return (self._last_frame_ns if self._first_frame_ns is None else self._first_frame_ns), self._last_frame_ns

    def _no_overlap(self) -> InertialFinding:
        first, last = self._samples.first_ns, self._samples.last_ns
        span = None if first is None or last is None else (first, last)
        return _no_overlap(self._span_of_frames(), span, self._samples.step_s / _NS)

    def _part_covered(self) -> list[InertialFinding]:
        first, last = self._samples.first_ns, self._samples.last_ns
        share = self._frames_covered / self._frames
        if first is None or last is None or (1 - share) * self._seconds_of_frames() < 1.0:
            return []
        step_ns = self._samples.step_s / _NS
        return [_part_overlap(self._span_of_frames(), (first, last), step_ns, share)]

    def _remember(self, motion: _Intervals) -> None:
        if not len(motion.begin_ns):
            return
        self._intervals.append(motion)
        self._since_look += len(motion.begin_ns)
        self._seen += len(motion.begin_ns)
        while motion.end_ns[-1] - self._intervals[0].end_ns[-1] > _MEMORY_S / _NS:
            del self._intervals[0]

    def _look(self, *, last: bool) -> list[InertialFinding]:
        """Judge what is remembered; before the end, a fault must be found at two looks in a row."""
        self._since_look = 0
        found = self._judge(last=last)
        if last:
            return found
        confirmed = [f for f in found if f.fault in self._suspected]
        self._suspected = {f.fault for f in found}
        return confirmed

    def _judge(self, *, last: bool) -> list[InertialFinding]:
        times_ns, values = self._samples.table()
        if len(times_ns) < 2:
            return []
        size = _judge_size(times_ns, values[:, 3:])
        by_size = [] if size.finding is None else [size.finding]
        if not self._intervals:
            return by_size
        intervals = _Intervals(
            np.concatenate([i.begin_ns for i in self._intervals]),
            np.concatenate([i.end_ns for i in self._intervals]),
            np.concatenate([i.twists for i in self._intervals]),
        )
        least, R = _LEAST_AT_END, self._T[:3, :3]
        record = _record(intervals, times_ns, values)
        turning = _turning(record, least)
        if turning is None:
            means, covered = record.means(np.zeros(1))
            still = last and size.unit is not None and int(covered.sum()) >= least
            return [*by_size, *_upside_down(means[0, covered[0], 3:], R, measured=False)] if still else by_size
        force = None if size.unit is None else _force_fit(record, turning, self._T[:3, 3])
        # Which of gyro and extrinsics is at fault, the accelerometer tells: wait for it.
        told = force is not None or size.unit is None or last or turning.count >= _ENOUGH
        size = _settle_size(size, force, R, told=told)
        unit = size.unit
        offset = _judge_offset(turning, record, least)
        found = [f for f in (size.finding, offset) if f is not None]
        clipped = "saturation" in self._said
        rotation = _judge_gyro(turning, R, force, unit or 1.0, told=told, clipped=clipped)
        found += rotation
        measured = False
        if unit is not None and turning.unexplained < _AGREES and not any(f.fault != "gyro units" for f in rotation):
            forces, measured = _judge_force(force, turning, R, unit, last=last)
            found += forces
        enough = turning.count >= _ENOUGH and turning.axes == 3 and (measured or unit is None or bool(rotation))
        if not found and (last or enough) and turning.unexplained < _AGREES and measured:
            rates = Rates(times_ns, values[:, :3], values[:, 3:], True)
            lever = _judge_lever(record, turning, self._T, rates)
            found += [] if lever is None else [lever]
            if lever is not None and not last:
                self._suspected.add(lever.fault)
        self._done = enough and all(f.fault in self._suspected for f in found)
        return found

    def _fresh(self, found: Sequence[InertialFinding]) -> tuple[InertialFinding, ...]:
        """Leave out what was said before, by itself or in other words."""
        out = []
        for finding in found:
            group = _GROUPS.get(finding.fault, finding.fault)
            if group not in self._said:
                self._said.add(group)
                out.append(finding)
        return tuple(out)
