"""Rates, gaps and jitter of a recording's clocks."""

from __future__ import annotations

import numpy as np

from vio.imu.clocks import judge_clocks
from vio.inspection.finding import Part
from vio.numerics.robust import robust_sigma
from vio.records import NS_PER_S, IntArray, Recording

_GAP = 1.5  # intervals longer than this multiple of the median are gaps
_LEAST_IMU_HZ = 50.0  # as the readers say it


def frames_part(recording: Recording) -> Part:
    """Describe the frames' stamps."""
    times = recording.frame_times_ns
    facts = clock_facts(times)
    text = f"{len(times)} frames{_text(facts)}"
    faults = ["a run needs at least two frames; give a longer recording"] if len(times) < 2 else []
    return Part("frames", text, facts, faults)


def imu_clock_part(recording: Recording, times_ns: IntArray) -> Part:
    """Describe the IMU's stamps, and how they cover the frames."""
    facts = clock_facts(times_ns)
    faults = []
    if facts["rate_hz"] is not None and facts["rate_hz"] < _LEAST_IMU_HZ:
        faults.append(
            f"{facts['rate_hz']:.3g} Hz are too few to integrate the motion between images; record at least "
            f"{_LEAST_IMU_HZ:g} Hz, or use --motion none"
        )
    overlap = [finding.message for finding in judge_clocks(recording.frame_times_ns, times_ns)]
    inside = (recording.frame_times_ns >= times_ns[0]) & (recording.frame_times_ns <= times_ns[-1])
    text = f"{len(times_ns)} samples{_text(facts)}; they cover {100 * float(inside.mean()):.0f} % of the frames"
    return Part("IMU", text, {**facts, "covered": float(inside.mean())}, [*faults, *overlap])


def clock_facts(times_ns: IntArray) -> dict[str, float | int | None]:
    """Return duration, median rate, jitter (robust standard deviation of the intervals), and gaps of stamps (N,)."""
    if len(times_ns) < 2:
        return {"count": len(times_ns), "duration_s": 0.0, "rate_hz": None}
    steps = np.diff(times_ns).astype(np.float64) / NS_PER_S
    median = float(np.median(steps))
    gaps = steps > _GAP * median
    return {
        "count": len(times_ns),
        "duration_s": float(times_ns[-1] - times_ns[0]) / NS_PER_S,
        "rate_hz": 1 / median,
        "jitter_ms": 1e3 * robust_sigma(steps - median),
        "gaps": int(gaps.sum()),
        "longest_gap_s": float(steps.max()) if gaps.any() else 0.0,
    }


def _text(facts: dict[str, float | int | None]) -> str:
    if facts["rate_hz"] is None:
        return ""
    gaps = f", {facts['gaps']} gaps, the longest {facts['longest_gap_s']:.3g} s" if facts["gaps"] else ", no gap"
    return f" in {facts['duration_s']:.2f} s, {facts['rate_hz']:.4g} Hz, jitter {facts['jitter_ms']:.3g} ms{gaps}"
