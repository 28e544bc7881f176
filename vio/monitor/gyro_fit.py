"""The gyro's rates against those of the camera: the best linear map, at the best clock offset;
jitter of stamps.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray, nearest_rotation
from vio.imu.findings import MAX_FOLLOWED_OFFSET_S, InertialFinding
from vio.monitor.motion import Record
from vio.numerics.arrays import distinct
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import median, medians, robust_sigma, robust_sigmas
from vio.records import BoolArray


class _RateRules(NamedTuple):
    """When the gyro contradicts the camera's rotation."""

    min_rate_radps: float = 0.02  # a gyro is not judged where the camera rotates less
    clear_of_noise: float = 5.0  # the camera's rates must exceed their noise by this factor
    # misfit over the best linear map, as a share of the rotation: 11 degrees, or 20 % of scale
    excess_share: float = 0.2
    # over the intervals, times the unexplained share: squared excess due to the map's free
    # parameters
    chance_intervals: float = 30.0
    clearly_worse: float = 2.0
    named_offset_s: float = 0.02
    # of the rate about an axis: what one that is dead shows of it at most, and by how much one that
    # agrees is off
    dead_share: float = 0.3
    off_share: float = 0.3
    # Where a gyro has agreed up to some interval: of the rotation that it leaves, as it is given, and
    # by how much more what fits since leaves
    left_share: float = 0.1
    damping: Tolerance[float] = 0.01  # of that fit, where nothing turns
    lengths: Tolerance[int] = 20  # of a record, after which it is looked for


_RATES = _RateRules()
# share of the rotation that the best linear map leaves unexplained: below, explanations are judged
AGREES = 0.2
# intervals before the first evaluation; there are fewer only at the end of a short run
FIRST_EVALUATION = 60
_NEAR_OFFSETS_S = np.linspace(-MAX_FOLLOWED_OFFSET_S, MAX_FOLLOWED_OFFSET_S, 21)
FAR_OFFSETS_S = np.arange(-5.0, 5.001, 0.025)


class _JitterRules(NamedTuple):
    """When stamps jitter."""

    # Of stamps that jitter.
    min_intervals: int = 40
    min_rate_radps: float = 0.1  # where a millisecond is 0.1 mrad, about what the images resolve
    min_sigma_s: float = 5e-4  # standard deviation of the intervals; smaller does little harm
    min_correlation: float = 0.7


_JITTER = _JitterRules()
_I3 = np.eye(3)
# of the time missed by the gyro over the stamps' deviation: 1 for jitter, 0 for true intervals
_SLOPE = 0.7, 1.3


@dataclass(frozen=True, slots=True)
class GyroFit:
    """Second moments of the camera's and the gyro's rates at one clock offset, and the best
    linear map, (I1).
    """

    offset_s: float
    S_cc: FloatArray  # (3, 3) camera, weighted mean of products, (rad/s)^2
    S_cg: FloatArray  # (3, 3) camera and gyro
    S_gg: FloatArray  # (3, 3) gyro
    A: FloatArray  # (3, 3) camera rate = A gyro + b
    b: FloatArray  # (3,)
    unexplained: float  # share of the camera's rotation that the map leaves unexplained, 0 to 1
    noise_radps: float  # of the camera's rates, each axis
    count: int  # intervals with samples
    camera: FloatArray  # (K, 3) its rates in each interval, rad/s
    gyro: FloatArray  # (K, 3) mean rates of each interval, rad/s
    force: FloatArray  # (K, 3) mean specific forces, unit of the readings
    covered: BoolArray  # (K,) samples cover the interval
    weight: FloatArray  # (K,) robust weights at the best map, zero where not covered

    @property
    def rms_rates_radps(self) -> FloatArray:
        """RMS rates (3,) of the camera about its three principal axes, largest first."""
        out: FloatArray = np.sqrt(np.maximum(np.linalg.eigvalsh(self.S_cc)[::-1], 0))
        return out

    @property
    def axes(self) -> int:
        """Number of axes about which the camera clearly rotates."""
        return int(np.sum(self.rms_rates_radps > self._clear_radps))

    @property
    def _clear_radps(self) -> float:
        return max(_RATES.min_rate_radps, _RATES.clear_of_noise * self.noise_radps)

    def scale(self, C: FloatArray) -> float:
        """Return the best factor on an orthogonal map (3, 3) from gyro to camera."""
        return float(np.sum(C * self.S_cg) / max(float(np.trace(self.S_gg)), 1e-300))

    def excess(self, C: FloatArray, scale: float) -> float:
        """Return the misfit of `scale C` beyond that of the best linear map, as a share of the
        rotation, (I2).
        """
        total = float(np.trace(self.S_cc))
        misfit = (
            total - 2 * scale * float(np.sum(C * self.S_cg)) + scale**2 * float(np.trace(self.S_gg))
        )
        return float(np.sqrt(max(misfit / max(total, 1e-300) - self.unexplained, 0.0)))

    @property
    def tolerance(self) -> float:
        """The excess up to which a map is accepted."""
        return max(
            _RATES.excess_share,
            float(np.sqrt(_RATES.chance_intervals / max(self.count, 1) * self.unexplained)),
        )

    def dead_axes(self, R: FloatArray) -> list[int]:
        """Return which axes of a gyro show nothing of the rotation about them, while the others,
        mapped by a rotation (3, 3), show all; nothing: it is none of them, or all.
        """
        camera = self.camera[self.covered] @ R
        gyro = self.gyro[self.covered]
        # a few wrong rates of the camera are no rotation; what there is of the gyro's is
        total = np.minimum(robust_sigmas(camera - medians(camera)), camera.std(axis=0))
        shown = gyro.std(axis=0)
        off = (camera - gyro).std(axis=0)
        clear = total > self._clear_radps
        dead = clear & (shown < _RATES.dead_share * total)
        alive = clear & ~dead
        if not dead.any() or not alive.any():
            return []
        agree = off[~dead] < _RATES.off_share * np.maximum(total[~dead], total[dead].min())
        return dead.nonzero()[0].tolist() if agree.all() else []

    def fits(self, C: FloatArray) -> bool:
        """Return whether an orthogonal map (3, 3) from gyro to camera is accepted at its best
        scale.
        """
        scale = self.scale(C)
        return scale > 0 and self.excess(C, scale) < self.tolerance

    @property
    def is_chance(self) -> bool:
        """Whether the map fits at a clock offset of seconds and is neither a rotation nor a
        reflection: of hundreds of offsets, one brings some map of nine numbers near smooth rates.
        """
        if abs(self.offset_s) <= MAX_FOLLOWED_OFFSET_S:
            return False
        nearest = (nearest_rotation(self.S_cg), -nearest_rotation(-self.S_cg))
        return not any(self.fits(C) for C in nearest)


def fit_gyro(record: Record, least: int, noise_radps: float | None = None) -> GyroFit | None:
    """Fit the camera's rates by the gyro's at the best clock offset; None: too little rotation.

    `noise_radps`: of the camera's rates; None: by their second differences, which holds where
    intervals are short beside the motion.
    """
    omega = record.twists[:, 3:]
    noise = noise_radps
    if noise is None:
        if len(omega) > 4:
            noise = robust_sigma(np.diff(omega, 2, axis=0)) / np.sqrt(6)
        else:
            noise = np.inf
    best = _at_offset(record, _NEAR_OFFSETS_S, least, noise)
    if best is None or best.axes == 0:
        return None
    at_border = abs(best.offset_s) > _NEAR_OFFSETS_S[-2]
    if at_border or best.unexplained > AGREES:
        best = _search_far(record, best, least, noise)
    for step in (0.01, 0.003):
        near = _at_offset(record, best.offset_s + step * np.arange(-2, 3), least, noise)
        if near is not None and near.unexplained <= best.unexplained:
            best = near
    return best if best.axes else None


def fits_backwards(record: Record, least: int, R_cam0_imu: FloatArray) -> bool:
    """Return whether the gyro, mapped by the given rotation (3, 3), explains the camera's rotation
    once the order of the images is reversed.

    Shown backwards, the images make the inverse motions, the last one first. Intervals that are not
    those of a whole recording are at other times, where the gyro does not fit them.
    """
    both_ends = record.begin[0] + record.end[-1]
    mirrored = replace(
        record,
        begin=both_ends - record.end[::-1],
        end=both_ends - record.begin[::-1],
        twists=-record.twists[::-1],
    )
    found = fit_gyro(mirrored, least)
    if found is None or abs(found.offset_s) > MAX_FOLLOWED_OFFSET_S:
        return False
    return found.unexplained < AGREES and found.fits(R_cam0_imu)


def agreed_until(record: Record, least: int, R_cam0_imu: FloatArray) -> float | None:
    """Return until when, in seconds of a record's clock, the gyro, mapped by a rotation (3, 3),
    explains the camera's rotation, as it does not since; None: there is no such time, with `least`
    intervals before it and after.

    The map that fits best since must not fit before: one of a wrong scale of an axis does, where
    nothing has turned about it yet.
    """
    means, covered = record.means(np.zeros(1))
    gyro = means[0, covered[0], :3]
    camera = record.twists[covered[0], 3:] @ R_cam0_imu
    until = None
    if len(gyro) < 2 * least:
        return None
    for length in distinct(np.linspace(least, len(gyro) - least, _RATES.lengths).astype(np.int64)):
        turns, g = (x[:length] - x[:length].mean(axis=0) for x in (camera, gyro))
        since, g_since = (x[length:] - x[length:].mean(axis=0) for x in (camera, gyro))
        S = g_since.T @ g_since
        damped = S + (_RATES.damping * float(np.trace(S)) + 1e-300) * _I3
        D = np.linalg.solve(damped, g_since.T @ (since - g_since))
        total, as_given, as_since = (
            float(np.sum(x * x)) for x in (turns, turns - g, turns - g - g @ D)
        )
        is_clear = total > length * _RATES.min_rate_radps**2
        share = _RATES.left_share * total
        if is_clear and as_given < share and as_since - as_given > share:
            until = float(record.end[covered[0]][length - 1])
    return until


def _search_far(record: Record, near: GyroFit, least: int, noise: float) -> GyroFit:
    """Return the fit at a clock offset of seconds where it leaves far less than the near one."""
    far = _at_offset(record, FAR_OFFSETS_S, max(least, len(record.twists) // 2), noise)
    if far is not None and far.unexplained < 0.5 * near.unexplained:
        return far
    return near


def _at_offset(
    record: Record, offsets: npt.NDArray[np.floating], least: int, noise: float
) -> GyroFit | None:
    """Fit the linear map at the best of some clock offsets, then robustly."""
    means, covered = record.means(offsets)
    omega = record.twists[:, 3:]
    gyro = means[..., :3]
    enough = covered.sum(axis=1) >= least
    if not enough.any():
        return None
    shares = np.where(enough, _moments(omega, gyro, covered.astype(np.float64))[3], np.inf)
    k = int(np.argmin(shares))
    weight = covered[k].astype(np.float64)
    for _ in range(4):
        S_cc, S_cg, S_gg, share, A, b = (
            x[0] for x in _moments(omega, gyro[k : k + 1], weight[None])
        )
        r = np.linalg.norm(omega - gyro[k] @ A.T - b, axis=1)
        width = max(2 * robust_sigma(r[covered[k]]), 1e-6)
        weight = covered[k] / (1 + (r / width) ** 2) ** 2
    return GyroFit(
        offset_s=float(offsets[k]),
        S_cc=S_cc,
        S_cg=S_cg,
        S_gg=S_gg,
        A=A,
        b=b,
        unexplained=float(share),
        noise_radps=noise,
        count=int(covered[k].sum()),
        camera=omega,
        gyro=gyro[k],
        force=means[k, :, 3:],
        covered=covered[k],
        weight=weight,
    )


def _moments(omega: FloatArray, gyro: FloatArray, weight: FloatArray) -> tuple[FloatArray, ...]:
    """Return centred moments cc, cg, gg (M, 3, 3), unexplained share (M,), A (M, 3, 3), b (M, 3)
    for weights (M, K).
    """
    w = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    mean_c = w @ omega
    mean_g = np.einsum("mk,mki->mi", w, gyro)
    c = omega[None] - mean_c[:, None]
    g = gyro - mean_g[:, None]
    cw = (c * w[..., None]).swapaxes(1, 2)
    S_cc = cw @ c
    S_cg = cw @ g
    S_gg = (g * w[..., None]).swapaxes(1, 2) @ g
    size = _traces(S_gg)[:, None, None]
    A = np.linalg.solve(S_gg + (1e-9 * size + 1e-300) * _I3, S_cg.swapaxes(1, 2))
    A = A.swapaxes(1, 2)
    total = _traces(S_cc)
    share = 1 - np.sum(A * S_cg, axis=(1, 2)) / np.maximum(total, 1e-300)
    return (
        S_cc,
        S_cg,
        S_gg,
        np.minimum(np.maximum(share, 0.0), 1.0),
        A,
        mean_c - np.einsum("mij,mj->mi", A, mean_g),
    )


def _traces(S: FloatArray) -> FloatArray:
    """Traces (M,) of matrices (M, 3, 3)."""
    return S[:, 0, 0] + S[:, 1, 1] + S[:, 2, 2]


def judge_offset(gyro_fit: GyroFit, record: Record, least: int) -> InertialFinding | None:
    """Report a relevant clock offset, where the rotation determines it clearly."""
    if abs(gyro_fit.offset_s) < _RATES.named_offset_s or gyro_fit.unexplained > AGREES:
        return None
    if gyro_fit.is_chance:
        return None
    as_stamped = _at_offset(record, np.zeros(1), least, gyro_fit.noise_radps)
    if (
        as_stamped is not None
        and as_stamped.unexplained < _RATES.clearly_worse * gyro_fit.unexplained + 0.003
    ):
        return None
    left = (
        "cannot be compared"
        if as_stamped is None
        else f"leaves {100 * as_stamped.unexplained:.1f} % unexplained"
    )
    return InertialFinding(
        "clocks apart",
        "the rates of gyro and images agree best if a frame stamped t is at t "
        f"{gyro_fit.offset_s:+.3f} s of the "
        f"IMU's clock ({100 * gyro_fit.unexplained:.1f} % of the rotation unexplained; without the "
        f"shift it {left})",
        f"the IMU's clock is ahead of the camera's by {gyro_fit.offset_s:+.3f} s; subtract that "
        "from the IMU's stamps",
        offset_s=gyro_fit.offset_s,
    )


def judge_stamps(record: Record) -> InertialFinding | None:
    """Compare each interval's deviation from the usual one with the time that the camera's rotation
    took by the gyro.

    Over an interval of stamps `dt` the gyro turns at a mean rate `w`; the images show an angle `a`,
    so the exposures lay `a / w` apart. Where `a / w - dt` is the negative of `dt - median(dt)`, the
    stamps are wrong, not the exposures.
    """
    means, covered = record.means(np.zeros(1))
    gyro = np.linalg.norm(means[0, :, :3], axis=1)
    camera = np.linalg.norm(record.twists[:, 3:], axis=1)
    dt = record.end - record.begin
    usual = median(dt) if len(dt) else 0.0
    used = covered[0] & (gyro > _JITTER.min_rate_radps) & (np.abs(dt - usual) < 0.5 * usual)
    if used.sum() < _JITTER.min_intervals or robust_sigma(dt[used] - usual) < _JITTER.min_sigma_s:
        return None
    # the angle's error is the same everywhere, the time's error falls with the rate
    weight = gyro[used]
    deviation = weight * (dt[used] - usual)
    missed = weight * (dt[used] - dt[used] * camera[used] / gyro[used])
    slope = float(deviation @ missed / (deviation @ deviation))
    correlation = float(deviation @ missed / np.sqrt((deviation @ deviation) * (missed @ missed)))
    if not _SLOPE[0] < slope < _SLOPE[1] or correlation < _JITTER.min_correlation:
        return None
    jitter_ms = 1e3 * robust_sigma(dt[used] - usual) / np.sqrt(2)
    return InertialFinding(
        "camera stamps",
        f"the frames' intervals scatter as if each stamp were off by {jitter_ms:.1f} ms (standard "
        "deviation), but the "
        f"gyro shows exposures at a steady {1e3 * usual:.1f} ms",
        "the stamps jitter, perhaps taken when the image arrived; stamp frames at the exposure, by "
        "the camera's clock",
    )
