"""Steps of a clock during a recording: stamps go back, or leap ahead, while messages go on being
recorded.

A computer whose clock is set back stamps the messages after it with times that were given before,
and sorted by their stamps two periods interleave. The order of recording tells them apart: at a
step the stamps go back, and stay behind the recorder's clock by as much. A message that is recorded
late goes back, too, but into a place that no other message had.

Of a clock that is set forward the stamps leave a gap where the recording has none. The cameras alone
may do that otherwise, as they lose frames while their latency falls: so all streams must leap alike.
A clock of stamps and of the recorder that leaps cannot be told from a pause of the recording.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vio.numerics.robust import median
from vio.records import NS_PER_S, IntArray


class _BackRules(NamedTuple):
    """When stamps that go back are a step of the clock."""

    min_step_ns: int = 10_000_000  # smaller corrections are those of a clock that is steered
    # messages on either side that tell how far stamps are behind the recorder's clock
    messages_around: int = 20
    # messages are recorded within this time after they are stamped
    recorded_within_ns: int = 100_000_000
    alike_share: float = 0.25  # of a step, by which those of several topics may differ to be one
    min_behind_share: float = 0.8  # of the messages after a step are behind by it
    min_early_share: float = 0.5  # of the messages after a step whose stamps were given before it


_BACK = _BackRules()
_TOGETHER_NS = NS_PER_S  # steps of several topics within this time are one


class _LeapRules(NamedTuple):
    """When stamps that leap ahead are a step of the clock."""

    min_ns: int = 100_000_000  # a leap that is less passes for a gap of some frames
    min_streams: int = 2  # streams that leap together


_LEAP = _LeapRules()


@dataclass(frozen=True, slots=True)
class ClockStep:
    """A clock that was set, and the first message after it of each topic concerned."""

    size_ns: int  # by which it was set back; of one that was set forward, below 0
    logged_ns: int  # when
    first: Mapping[str, int]  # row in the order of recording, by topic

    def note(self, begin_ns: int) -> str:
        """Return what was found and done, given when the recording began."""
        size_s = self.size_ns / NS_PER_S
        topics = ", ".join(sorted(self.first))
        way = "back" if size_s > 0 else "forward"
        purpose = "no two periods mix" if size_s > 0 else "there is no gap"
        return (
            f"the clock was set {way} by {abs(size_s):.3f} s at "
            f"{(self.logged_ns - begin_ns) / NS_PER_S:.2f} s of the recording ({topics}): what was "
            f"recorded after it is moved by {size_s:+.3f} s, so that {purpose}"
        )


@dataclass(frozen=True, slots=True)
class _Found:
    """A step of one topic."""

    topic: str
    row: int
    size_ns: float
    logged_ns: int


def mended(
    streams: Mapping[str, tuple[IntArray, IntArray]],
) -> tuple[dict[str, IntArray], list[ClockStep]]:
    """Return the stamps of each topic with the steps of its clock taken out, and these steps.

    Args:
        streams: stamps (N,) and times of recording (N,) of each topic, in the order of recording.
    """
    stamps = {topic: times.copy() for topic, (times, _) in streams.items()}
    logged = {topic: log for topic, (_, log) in streams.items()}
    found = [step for topic in stamps for step in _steps_of(topic, stamps[topic], logged[topic])]
    steps = []
    for together in _joined(found):
        size_ns = _common_size(together, stamps)
        first = {step.topic: step.row for step in together}
        begin_ns = min(step.logged_ns for step in together)
        others = stamps.keys() - first.keys()
        first |= _rows_without_descent(others, stamps, logged, (begin_ns, size_ns))
        steps.append(ClockStep(size_ns, begin_ns, first))
        _take_out(steps[-1], stamps)
    for leap in _leaps(stamps, logged):
        _take_out(leap, stamps)
        steps.append(leap)
    return stamps, steps


def _rows_without_descent(
    topics: Iterable[str],
    stamps: Mapping[str, IntArray],
    logged: Mapping[str, IntArray],
    step_ns: tuple[int, int],
) -> dict[str, int]:
    """Return the row of a step in each topic whose stamps do not descend there.

    `step_ns` is when it was logged, and its size; topics without it are absent.
    """
    rows = {t: _row_without_descent(stamps[t], logged[t], *step_ns) for t in topics}
    return {topic: row for topic, row in rows.items() if row is not None}


def _take_out(step: ClockStep, stamps: dict[str, IntArray]) -> None:
    """Move the stamps from a step on, in place."""
    for topic, row in step.first.items():
        stamps[topic][row:] += step.size_ns


def _leaps(stamps: Mapping[str, IntArray], logged: Mapping[str, IntArray]) -> list[ClockStep]:
    """Return the steps forward that all topics share, two at least."""
    found = [leap for topic in stamps for leap in _leaps_of(topic, stamps[topic], logged[topic])]
    steps = []
    for together in _joined(found):
        if len(together) < _LEAP.min_streams:
            continue
        best = max(together, key=lambda leap: len(stamps[leap.topic]))
        first = {leap.topic: leap.row for leap in together}
        begin_ns = min(leap.logged_ns for leap in together)
        if any(_goes_on(logged[topic], begin_ns) for topic in stamps.keys() - first.keys()):
            continue
        steps.append(ClockStep(-round(best.size_ns), begin_ns, first))
    return steps


def _goes_on(logged: IntArray, time_ns: int) -> bool:
    """Whether a topic has messages enough on either side of a time to show a leap."""
    before = int(np.searchsorted(logged, time_ns))
    return min(before, len(logged) - before) >= _BACK.messages_around


def _leaps_of(topic: str, stamps: IntArray, logged: IntArray) -> list[_Found]:
    """Return the steps forward of one topic, with their sizes above 0."""
    usual_ns = _usual_ns(stamps)
    gap_ns = np.diff(stamps) - np.diff(logged)  # that the recorder's clock did not see
    found = []
    for row in (np.flatnonzero(gap_ns > max(_LEAP.min_ns, usual_ns)) + 1).tolist():
        before = (logged - stamps)[max(row - _BACK.messages_around, 0) : row]
        after = (logged - stamps)[row : row + _BACK.messages_around]
        size_ns = median(before) - median(after)
        late_ns = np.abs(np.concatenate([before - median(before), after - median(after)]))
        is_steady = np.mean(late_ns < _BACK.alike_share * size_ns) > _BACK.min_behind_share
        if is_steady and abs(size_ns - gap_ns[row - 1]) < _BACK.alike_share * size_ns:
            found.append(_Found(topic, row, size_ns, int(logged[row])))
    return found


def _steps_of(topic: str, stamps: IntArray, logged: IntArray) -> list[_Found]:
    """Return the steps of one topic, in the order of recording."""
    times = stamps.copy()
    found: list[_Found] = []
    row = 0
    while row < len(times):
        highest = np.maximum.accumulate(times)
        back = np.flatnonzero(times[1:] < highest[:-1]) + 1
        step = None
        for k in back[back > row].tolist():
            step = _size_of_step(times, logged, k, int(highest[k - 1]))
            if step is not None:
                row = k
                break
        if step is None:
            break
        found.append(_Found(topic, row, step, int(logged[row])))
        times[row:] += round(step)
    return found


def _size_of_step(times: IntArray, logged: IntArray, row: int, last_ns: int) -> float | None:
    """Return by how much the clock was set back before a message; None: it was not.

    Args:
        times: stamps (N,), whose earlier steps are taken out.
        logged: times of recording (N,).
        row: the message, which is stamped earlier than one before it.
        last_ns: the last stamp before it.
    """
    size_ns = _fallen_behind(times, logged, row)
    if size_ns < max(_BACK.min_step_ns, 0.5 * (last_ns - int(times[row]))):
        return None
    after = times[row : row + _BACK.messages_around]
    after = after[after <= last_ns]
    half_ns = _usual_ns(np.unique(times)) / 2
    earlier = times[:row]
    if after.max() < earlier.min():  # before the recording began
        return size_ns
    same = (earlier >= after.min() - half_ns) & (earlier <= after.max() + half_ns)
    if same.sum() >= _BACK.min_early_share * len(after):
        return size_ns
    return None


def _usual_ns(times: IntArray) -> float:
    """Return the usual interval of stamps (N,); of one stamp 0."""
    return median(np.diff(times)) if len(times) > 1 else 0.0


def _fallen_behind(times: IntArray, logged: IntArray, row: int) -> float:
    """Return by how much more stamps are behind the recorder's clock after a message than before
    it; 0 where not all of those after it are.
    """
    first = max(row - _BACK.messages_around, 0)
    around = slice(first, row + _BACK.messages_around)
    behind = (logged[around] - times[around]).astype(np.float64)
    more = behind[row - first :] - median(behind[: row - first])
    size_ns = median(more)
    if np.mean(more > 0.5 * size_ns) > _BACK.min_behind_share:
        return size_ns
    return 0.0


def _joined(found: Sequence[_Found]) -> list[list[_Found]]:
    """Return the steps of several topics that are one."""
    groups: list[list[_Found]] = []
    for step in sorted(found, key=lambda each: each.logged_ns):
        last = groups[-1] if groups else []
        alike = last and abs(step.size_ns - last[0].size_ns) <= max(
            _BACK.alike_share * last[0].size_ns, _BACK.min_step_ns
        )
        near = last and step.logged_ns - last[0].logged_ns <= _TOGETHER_NS
        if alike and near and step.topic not in {each.topic for each in last}:
            last.append(step)
        else:
            groups.append([step])
    return groups


def _common_size(together: Sequence[_Found], stamps: Mapping[str, IntArray]) -> int:
    """Return the size of a step of several topics: that of the one with most messages, and no less
    than lets the stamps of each go on.
    """
    best = max(together, key=lambda step: len(stamps[step.topic]))
    before = stamps[best.topic][: best.row]
    back_ns = int(before.max()) - int(stamps[best.topic][best.row])
    return round(max(best.size_ns, back_ns + _usual_ns(before)))


def _row_without_descent(
    times: IntArray, logged: IntArray, begin_ns: int, size_ns: int
) -> int | None:
    """Return the first message after a step of a topic whose stamps did not go back, as its
    messages are further apart than the step; None: its clock was not set.
    """
    low, high = np.searchsorted(
        logged, [begin_ns - _BACK.recorded_within_ns, begin_ns + _BACK.recorded_within_ns]
    ).tolist()
    if low == 0 or high == len(times):
        return None
    behind = (logged - times).astype(np.float64)
    before = median(behind[max(low - _BACK.messages_around, 0) : low])
    after = median(behind[high : high + _BACK.messages_around])
    if abs(after - before - size_ns) > 0.5 * size_ns:
        return None
    return low + int(np.argmax(behind[low:] > (before + after) / 2))
