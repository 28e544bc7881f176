"""Figures of live use: how old results are when they come, how many frames are left out, and
whether that is normal.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vio.numerics.kinds import Capacity


class _FigureRules(NamedTuple):
    """When a computer is too slow."""

    kept_results: Capacity[int] = 1000  # results that the median and the bound of 95 % are taken of
    # frames without a result, of which the oldest are forgotten: more than a queue has memory for
    kept_arrivals: Capacity[int] = 10_000
    # results older than that, one after another, mean that the computer is too slow
    late_s: float = 0.5
    late_results: int = 10
    max_left_out_frames: int = 10  # of the newest hundred frames


_FIGURES = _FigureRules()


@dataclass(frozen=True, slots=True)
class LiveFigures:
    """How a live odometry keeps up.

    Latency is the time from the call that brings a frame to its result.
    """

    results: int  # frames with a result
    dropped: int  # frames left out because too many waited
    refused: int  # calls that the odometry refused after they had been taken
    waiting: int  # frames in the queue
    latency_median_ms: float | None  # of the newest thousand results; None: there are none
    latency_95_ms: float | None
    latency_worst_ms: float | None  # of all results

    def __str__(self) -> str:
        """Say it in words."""
        refused = f", {self.refused} calls refused" if self.refused else ""
        text = f"{self.results} frames with a pose, {self.dropped} left out{refused}"
        if self.latency_median_ms is None:
            return text
        return (
            f"{text}; latency {self.latency_median_ms:.0f} ms (median), "
            f"{self.latency_95_ms:.0f} (95 %), {self.latency_worst_ms:.0f} (worst)"
        )


class LiveMonitor:
    """Measures latency and counts frames that are left out.

    Frames are noted by one thread, results by another.
    """

    def __init__(self, *, judges_latency: bool) -> None:
        """Begin; latency is judged where frames come at a camera's rate, so that late results
        mean a slow computer.
        """
        self._judges = judges_latency
        # time of the frame, ns, and of its arrival, s
        self._arrived = deque[tuple[int, float]](maxlen=_FIGURES.kept_arrivals)
        self._lock = threading.Lock()  # of these
        self._latencies_s: deque[float] = deque(maxlen=_FIGURES.kept_results)
        self._left_out: deque[bool] = deque(maxlen=100)
        self._late = 0  # results in a row
        self._worst_s = 0.0
        self._warned = False
        self.results = self.dropped = self.refused = 0

    def arrived(self, time_ns: int) -> None:
        """Note a frame before it is put into the queue."""
        with self._lock:
            self._arrived.append((time_ns, time.perf_counter()))

    def queued(self, *, fits: bool) -> None:
        """Note whether there was room for a frame; else, one that had waited longer was left
        out.
        """
        self.dropped += not fits
        self._left_out.append(not fits)

    def result(self, time_ns: int) -> str | None:
        """Note the result of a frame; return what is to be said once of a computer that falls
        behind.
        """
        now = time.perf_counter()
        arrived_s = self._take_arrival(time_ns)
        if arrived_s is None:
            return None
        latency = now - arrived_s
        self.results += 1
        self._latencies_s.append(latency)
        self._worst_s = max(self._worst_s, latency)
        if latency > _FIGURES.late_s:
            self._late = self._late + 1
        else:
            self._late = 0
        left_out = sum(self._left_out)
        if (
            self._warned
            or not self._judges
            or (self._late < _FIGURES.late_results and left_out < _FIGURES.max_left_out_frames)
        ):
            return None
        self._warned = True
        lost = ""
        if left_out:
            lost = f", {left_out} of the last {len(self._left_out)} frames left out"
        return f"falling behind by {latency:.1f} s{lost}: use --config fast, or set dataset.max_frame_rate"

    def _take_arrival(self, time_ns: int) -> float | None:
        """Return when the newest frame of a time arrived, and forget it and those before; None: none
        of this time did.

        After a reset, times may begin again at or below those of frames that never had a result.
        """
        with self._lock:
            last = len(self._arrived) - 1
            times = reversed(self._arrived)
            back = next((k for k, (t, _) in enumerate(times) if t == time_ns), None)
            if back is None:
                return None
            for _ in range(last - back):
                self._arrived.popleft()
            return self._arrived.popleft()[1]

    def figures(self, waiting: int) -> LiveFigures:
        """Return the figures so far, with the number of frames in the queue."""
        if not self._latencies_s:
            return LiveFigures(0, self.dropped, self.refused, waiting, None, None, None)
        median, most = 1e3 * np.percentile(list(self._latencies_s), [50, 95])
        found = float(median), float(most), 1e3 * self._worst_s
        return LiveFigures(self.results, self.dropped, self.refused, waiting, *found)
