"""What an interval without IMU samples may hide: process noise for interpolation over a gap, and
for a held sample.

Between samples the signal is a straight line, after the last one it is held. What the true signal
does beside that is a Brownian motion: pinned at both ends over a gap (a bridge), at one end where a
sample is held. Its size is learned from the samples before: the mean squared change over a lag, the
structure function D. Equations (N11) and (N12) of docs/math.md. Reference: Kolmogorov's structure
function, as in Monin & Yaglom, Statistical fluid mechanics (1975).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vio.dataclass import dataclass
from vio.filters.pose_loops import lacks_samples
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity, Tolerance
from vio.numerics.robust import median
from vio.records import S_PER_NS, ImuSample, IntArray


@dataclass(frozen=True, slots=True)
class _GapRules:
    """What missing IMU samples may hide."""

    memory_s: float = 2.0  # samples that the structure function is learned from
    max_samples: Capacity[int] = 8000  # of them, whatever their stamps say
    # half of it; beyond, the signal is taken to have changed as much as it ever does
    longest_lag_s: float = 1.0
    min_samples: int = 10  # with fewer the signal is not characterised
    # of the samples in memory, 1 / 8: so many new ones change their median little
    measured_share: int = 8
    # an interval longer than so many median periods lacks a sample; jitter of the clock stays
    # below
    long_periods: float = 1.5
    # between samples; a slower IMU misses motions that matter, and its straight lines are
    # bridges, too
    slow_ns: float = 30e6
    slow_cut_ns: float = 10e6  # of its intervals
    shortest_cut_ns: Tolerance[float] = 1e6  # of a gap, for the integration
    max_cuts: Capacity[int] = 1000


_GAPS = _GapRules()
# D then: accelerometer (m/s^2)^2, gyro (rad/s)^2, of a vehicle that manoeuvres
_UNKNOWN = np.array([3.0, 1.0]) ** 2


@dataclass(frozen=True, slots=True)
class Hidden:
    """An interval that lacks samples, cut finely, and what it may hide."""

    cuts_ns: FloatArray  # (K,) increasing
    # (2, K - 1) of the integrals of accelerometer and gyro over each step, m^2/s^2 and rad^2
    variance: FloatArray
    # whether samples are missing; False: the last one is held for less than the time to the next
    gap: bool


class ImuHistory:
    """The samples of the last two seconds but for gaps, and how much their signals change in a
    given time.
    """

    def __init__(self) -> None:
        self._samples: list[ImuSample] = []
        self._period = 0.0  # median distance, and samples since it was computed
        self._unmeasured = 0

    def take(self, samples: Sequence[ImuSample]) -> None:
        """Take samples in order of time and drop what is too old: a gap, however long, makes
        none so.
        """
        self._samples += samples
        self._unmeasured += len(samples)
        kept = min(len(self._samples), _GAPS.max_samples)
        while True:
            if self._unmeasured >= kept // _GAPS.measured_share:
                self._measure(kept)
            if kept * self._period <= _GAPS.memory_s / S_PER_NS:
                break
            kept -= 1
        del self._samples[: len(self._samples) - kept]

    def period_ns(self) -> float:
        """Median distance of the samples, up to a few of them ago; 0 where there are not two."""
        if self._unmeasured >= len(self._samples) // _GAPS.measured_share:
            self._measure(len(self._samples))
        return self._period

    def _measure(self, last: int) -> None:
        """Measure the median distance of the last few samples."""
        kept = self._samples[len(self._samples) - last :]
        times = np.array([x.time_ns for x in kept], dtype=np.int64)
        if len(times) > 1:
            self._period = median(np.diff(times))
        else:
            self._period = 0.0
        self._unmeasured = 0

    def hidden(self, cuts_ns: FloatArray, times_ns: FloatArray) -> Hidden | None:
        """Cut the parts of an interval that lack samples finely, and say what they hide; None: none
        are missing.

        Args:
            cuts_ns: (K,) where an integration would step: its ends and the samples between.
            times_ns: (S,) of the samples at hand, on the same scale, increasing.
        """
        period_ns = self.period_ns()
        longest_ns = _GAPS.long_periods * period_ns
        if not lacks_samples(cuts_ns, times_ns, min(longest_ns, _GAPS.slow_ns)):
            return None
        after = np.searchsorted(times_ns, 0.5 * (cuts_ns[1:] + cuts_ns[:-1]))
        left = np.concatenate([[-np.inf], times_ns])[after]  # the samples around each step
        right = np.concatenate([times_ns, [np.inf]])[after]
        held = np.isinf(right - left)
        until_cut = np.minimum(cuts_ns[1:] - left, right - cuts_ns[:-1])
        silent = np.where(held, until_cut, right - left)
        gap = silent > longest_ns
        uncertain = gap | held | (silent > _GAPS.slow_ns)
        cut_ns = (
            _GAPS.slow_cut_ns
            if period_ns > _GAPS.slow_ns
            else max(period_ns, _GAPS.shortest_cut_ns)
        )
        counts = np.where(uncertain, np.ceil(np.diff(cuts_ns) / cut_ns), 1)
        parts = np.clip(counts, 1, _GAPS.max_cuts).astype(np.int64)
        ends = [
            np.linspace(a, b, n + 1)[:-1]
            for a, b, n in zip(cuts_ns[:-1], cuts_ns[1:], parts, strict=True)
        ]
        cuts = np.concatenate([*ends, cuts_ns[-1:]])
        left, right, uncertain = (np.repeat(x, parts) for x in (left, right, uncertain))
        variance = np.where(
            uncertain,
            self._hidden_variance(cuts * S_PER_NS, left * S_PER_NS, right * S_PER_NS),
            0.0,
        )
        return Hidden(cuts, variance, bool(gap.any()))

    def _hidden_variance(self, cuts: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
        """Variance (2, K - 1) that each step adds to the integrals, equations (N11) and (N12),
        by Simpson's rule.
        """
        lags, change = self._structure()

        def rate(t: FloatArray) -> FloatArray:
            held = np.isinf(left) | np.isinf(right)
            age = np.minimum(np.abs(t - left), np.abs(right - t))  # of a held sample
            T = np.where(held, 1.0, right - left)
            bridge = np.maximum(t - left, 0) ** 2 * np.maximum(right - t, 0) / T**2
            out = [
                np.where(
                    held,
                    np.interp(age, lags, D) * np.minimum(age, _GAPS.longest_lag_s),
                    np.interp(T, lags, D) * bridge,
                )
                for D in change
            ]
            return np.array(out)

        with np.errstate(invalid="ignore"):  # a bridge that has no end, which `held` leaves out
            a = cuts[:-1]
            b = cuts[1:]
            total: FloatArray = (rate(a) + 4 * rate(0.5 * (a + b)) + rate(b)) / 6 * (b - a)
        return total

    def _structure(self) -> tuple[FloatArray, FloatArray]:
        """Lags (L,) in s and the mean squared change (2, L) of accelerometer and gyro over them,
        of the worst axis.
        """
        if len(self._samples) < _GAPS.min_samples:
            return np.array([0.0, 1.0]), np.stack([_UNKNOWN, _UNKNOWN], axis=1)
        times = np.array([x.time_ns for x in self._samples], dtype=np.int64)
        period = self.period_ns()
        lags = [0.0]
        change = [np.zeros(2)]
        lag = period
        while lag <= _GAPS.longest_lag_s / S_PER_NS and times[-1] - times[0] >= lag:
            pairs = _pairs(times, lag, 0.5 * period)
            if len(pairs):
                lags.append(lag * S_PER_NS)
                change.append(np.array([self._change(pairs, "accel"), self._change(pairs, "gyro")]))
            lag *= 2**0.5
        return np.array(lags), np.array(change).T

    def _change(self, pairs: IntArray, name: str) -> float:
        values = np.array([getattr(x, name) for x in self._samples])
        squares = (values[pairs[:, 1]] - values[pairs[:, 0]]) ** 2
        return float(squares.mean(axis=0).max())


def _pairs(times_ns: IntArray, lag_ns: float, tolerance_ns: float) -> IntArray:
    """Indices (P, 2) of samples that lie a lag apart, to a tolerance."""
    wanted = times_ns + lag_ns
    later = np.searchsorted(times_ns, wanted - tolerance_ns)
    first = np.flatnonzero(later < len(times_ns))
    later = later[first]
    near = np.abs(times_ns[later] - wanted[first]) <= tolerance_ns
    return np.stack([first[near], later[near]], axis=1)
