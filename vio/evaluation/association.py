"""Pair the poses of two trajectories, by nearest time or by frame number, one to one, without
interpolation.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.errors import EvaluationError
from vio.files.epochs import epoch_hint
from vio.files.stamps import ASSUMED_STEP_NS
from vio.records import NS_PER_S, IntArray, Trajectory

AssociationMode: TypeAlias = Literal["time", "frame"]
_LONG_STEP_S = 2.0  # between poses of no reference, from which on their unit may be another one
_SMALLER_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
_COMMON = 0.5  # of the span of an estimate, that the reference covers
_SAME_CLOCK = 0.5  # of the times of either, that the other has to the nanosecond
_LONGEST_S = 1e9  # fits integer nanoseconds


@dataclass(frozen=True, slots=True)
class Coverage:
    """The compared share of estimate and reference."""

    estimate: float  # fraction of the estimate's poses that had a reference
    # fraction of the reference's time (or frame) span between first and last match
    reference_span: float | None
    longest_gap_s: float | None  # between matched poses; None: one pose, or association by frame


def associate(
    estimate: Trajectory, reference: Trajectory, *, max_time_difference_s: float = 0.01
) -> tuple[AssociationMode, IntArray, IntArray]:
    """Pair poses one to one: the mode, rows of the estimate (M,) and rows of the reference (M,), M
    >= 1.

    By time where both have times, else by frame number: row k of a trajectory without frame numbers
    is frame k. Times that were assumed, as of a recording that has none, count as none, unless
    they are the reference's.

    Raises:
        EvaluationError: no poses match.
    """
    if len(estimate) == 0 or len(reference) == 0:
        raise EvaluationError(
            f"cannot compare {len(estimate)} estimated poses with {len(reference)} reference poses"
        )
    # an assumed time is the number of its frame in other units
    by_number = (
        reference.frame_indices is not None
        and _has_assumed_times(estimate)
        and not _are_times_of(reference, estimate)
    )
    if estimate.times_ns is not None and reference.times_ns is not None and not by_number:
        rows, reference_rows = _by_time(
            estimate.times_ns, reference.times_ns, max_time_difference_s
        )
        return "time", rows, reference_rows
    if (
        reference.times_ns is not None
        and reference.frame_indices is None
        and len(estimate) != len(reference)
    ):
        raise EvaluationError(
            f"the estimate has {len(estimate)} poses without times and the reference "
            f"{len(reference)} poses with times "
            "but no frame numbers; give the estimate with times (TUM form)"
        )
    frames = _frames(estimate)
    reference_frames = _frames(reference)
    _, rows, reference_rows = np.intersect1d(
        frames, reference_frames, assume_unique=True, return_indices=True
    )
    if len(rows) == 0:
        raise EvaluationError(
            f"no common frame: the estimate has frames {frames[0]} to {frames[-1]}, the reference "
            f"{reference_frames[0]} to {reference_frames[-1]}; give the reference of this recording"
        )
    return "frame", rows.astype(np.int64), reference_rows.astype(np.int64)


def _has_assumed_times(estimate: Trajectory) -> bool:
    """Return whether the times of numbered frames are those of frames without any."""
    frames = estimate.frame_indices
    if frames is None or estimate.times_ns is None:
        return False
    return np.array_equal(estimate.times_ns, ASSUMED_STEP_NS * frames)


def _are_times_of(reference: Trajectory, estimate: Trajectory) -> bool:
    """Return whether most times of an estimate, where it overlaps a reference, are the reference's:
    then they are of a clock that ticks as assumed ones do, and numbers may count other frames.
    """
    own = estimate.times_ns
    other = reference.times_ns
    if own is None or other is None:
        return False
    first = max(own[0], other[0])
    last = min(own[-1], other[-1])
    fewest = min(((t >= first) & (t <= last)).sum() for t in (own, other))
    common = np.intersect1d(own, other, assume_unique=True)
    return bool(fewest > 1 and len(common) > _SAME_CLOCK * fewest)


def _by_time(
    times_ns: IntArray, reference_ns: IntArray, max_difference_s: float
) -> tuple[IntArray, IntArray]:
    """Return the rows of poses at the same times, at least one.

    Raises:
        EvaluationError: there is none, or the largest difference is no usable number.
    """
    if not 0 <= max_difference_s <= _LONGEST_S:
        limit = f"the largest time difference is 0 to {_LONGEST_S:g} s"
        raise EvaluationError(f"{limit}, got {max_difference_s:g} s")
    most_ns = round(max_difference_s * NS_PER_S)
    rows, reference_rows = associate_times(times_ns, reference_ns, max_difference_ns=most_ns)
    if len(rows) == 0:
        raise EvaluationError(_no_common_time(times_ns, reference_ns, max_difference_s))
    return rows, reference_rows


def associate_times(
    times_a_ns: npt.ArrayLike, times_b_ns: npt.ArrayLike, *, max_difference_ns: int
) -> tuple[IntArray, IntArray]:
    """Pair two increasing clocks one to one and in order, closest pairs first; return row indices
    (M,) into each.

    A pair is at most `max_difference_ns` apart. Of equally close pairs the earlier one is chosen.
    """
    a = np.asarray(times_a_ns, dtype=np.int64)
    b = np.asarray(times_b_ns, dtype=np.int64)
    low = np.searchsorted(b, a - max_difference_ns, side="left")
    count = np.searchsorted(b, a + max_difference_ns, side="right") - low
    i = np.repeat(np.arange(len(a)), count)
    begins = np.repeat(np.cumsum(count) - count, count)
    j = np.arange(len(i)) - begins + np.repeat(low, count)
    gap_ns = np.abs(a[i] - b[j])
    order = np.lexsort((j, i, gap_ns))
    # pairs of rows further away cannot cross: each is within the largest difference
    first = np.searchsorted(a, a - 2 * max_difference_ns, side="left").tolist()
    end = np.searchsorted(a, a + 2 * max_difference_ns, side="right").tolist()
    taken = [-1] * len(a)  # row of b, of each of a
    for row_a, row_b in zip(i[order].tolist(), j[order].tolist(), strict=True):
        if taken[row_a] >= 0:
            continue
        before = next((k for k in range(row_a - 1, first[row_a] - 1, -1) if taken[k] >= 0), None)
        after = next((k for k in range(row_a + 1, end[row_a]) if taken[k] >= 0), None)
        above = before is None or taken[before] < row_b
        if above and (after is None or taken[after] > row_b):
            taken[row_a] = row_b
    rows_b = np.array(taken, dtype=np.int64)
    rows_a = np.flatnonzero(rows_b >= 0)
    return rows_a, rows_b[rows_a]


def coverage(
    estimate: Trajectory,
    reference: Trajectory,
    mode: AssociationMode,
    rows: IntArray,
    reference_rows: IntArray,
) -> Coverage:
    """Return which part of both trajectories the matched rows (M,) of both are."""
    clock = (
        reference.times_ns
        if mode == "time" and reference.times_ns is not None
        else _frames(reference)
    )
    span = int(clock[-1] - clock[0])
    if estimate.times_ns is None:
        gaps = None
    else:
        gaps = np.diff(estimate.times_ns[rows])
    reference_span = None
    if span:
        reference_span = int(clock[reference_rows[-1]] - clock[reference_rows[0]]) / span
    if gaps is None or len(gaps) == 0:
        longest_gap_s = None
    else:
        longest_gap_s = int(gaps.max()) / NS_PER_S
    return Coverage(
        estimate=len(rows) / len(estimate),
        reference_span=reference_span,
        longest_gap_s=longest_gap_s,
    )


def _no_common_time(estimate_ns: IntArray, reference_ns: IntArray, limit_s: float) -> str:
    """Format how the two clocks relate to each other."""
    after = np.searchsorted(reference_ns, estimate_ns)
    left = np.clip(after - 1, 0, None)
    right = np.clip(after, None, len(reference_ns) - 1)
    nearest = np.minimum(
        np.abs(estimate_ns - reference_ns[left]), np.abs(estimate_ns - reference_ns[right])
    )
    spans = [
        f"{t[0] / NS_PER_S:.3f} to {t[-1] / NS_PER_S:.3f} s" for t in (estimate_ns, reference_ns)
    ]
    own, other = ((int(t[0]), int(t[-1])) for t in (estimate_ns, reference_ns))
    apart = own[1] < other[0] or other[1] < own[0]
    hint = epoch_hint(own, other, "the reference") if apart else ""
    return (
        f"no poses within {limit_s:g} s of each other: the estimate covers {spans[0]}, the "
        f"reference {spans[1]}, "
        f"closest pair {nearest.min() / NS_PER_S:.6g} s; check the clocks or allow a larger "
        f"difference{_unit_hint(estimate_ns, reference_ns) or hint}"
    )


def _unit_hint(estimate_ns: IntArray, reference_ns: IntArray) -> str:
    """Return in which unit the reference's times would cover the estimate; empty: in none, or their
    poses are as near to each other as poses are.
    """
    if len(reference_ns) < 2 or np.median(np.diff(reference_ns)) < _LONG_STEP_S * NS_PER_S:
        return ""
    own = estimate_ns[[0, -1]] / NS_PER_S
    shares = {}
    for unit, factor in _SMALLER_UNITS.items():
        other = reference_ns[[0, -1]] / NS_PER_S / factor
        common = min(own[1], other[1]) - max(own[0], other[0])
        if common > _COMMON * (own[1] - own[0]):
            shares[unit] = common / max(own[1] - own[0], other[1] - other[0])
    if not shares:
        return ""
    best = max(shares, key=shares.__getitem__)
    return (
        f"; if the reference's times are {best}, they cover the estimate: divide them by "
        f"{_SMALLER_UNITS[best]:.0f}"
    )


def _frames(trajectory: Trajectory) -> IntArray:
    if trajectory.frame_indices is not None:
        return trajectory.frame_indices
    return np.arange(len(trajectory), dtype=np.int64)


def take(trajectory: Trajectory, rows: IntArray) -> Trajectory:
    """Return rows (M,) of a trajectory."""
    times_ns = None
    if trajectory.times_ns is not None:
        times_ns = trajectory.times_ns[rows]
    return replace(
        trajectory,
        T_world_body=trajectory.T_world_body[rows],
        times_ns=times_ns,
        frame_indices=_frames(trajectory)[rows],
    )
