"""Stamps as people write them, in integer nanoseconds: in a unit that is stated, else by their size
and by how far apart they are.

Seconds since 1970 in s, ms, us and ns differ in size, and stamps since the boot of a device or
since the start of a recording do not: 9,000,000,000,000 is two and a half hours in ns, and a date
in the year 2255 in ms. What tells them is how far apart they are, as a camera takes an image every
few milliseconds to seconds. A reading that the size alone would not give is a doubt, which names
both.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from vio.dataclass import dataclass
from vio.errors import DataError
from vio.files.text import INT64_MAX, check_increasing
from vio.records import IntArray

TimeUnit: TypeAlias = Literal["s", "ms", "us", "ns"]
_POWERS: dict[str, int] = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # of ten, to nanoseconds
_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
# Stamps of 1973 and later in ns, us and ms; smaller ones are seconds from any zero.
_SIZES: tuple[tuple[TimeUnit, Decimal], ...] = (
    ("ns", Decimal("1e17")),
    ("us", Decimal("1e14")),
    ("ms", Decimal("1e11")),
)
ASSUMED_STEP_NS = 100_000_000  # between frames of a recording without times
_DECADES = 1000.0  # between two units
_FEWEST_STEPS = 2  # which tell a unit: two frames may share an arrival
_ODD_STEP = 0.5  # of the median interval: frames that jitter differ by less
_SECONDS_AND_NANOSECONDS = re.compile(r"(\d{1,12})\.(\d{1,9})")


@dataclass(frozen=True, slots=True)
class Pace:
    """How far apart entries of a kind are."""

    what: str  # entries, for messages
    least_s: float  # closer ones are not believed
    most_s: float  # nor are ones further apart
    # Other units are tried so that the median interval is between this and a thousand times it.
    usual_s: float

    def believes(self, apart_s: float) -> bool:
        """Tell whether entries of the kind may be this far apart."""
        return self.least_s <= apart_s <= self.most_s

    def fault(self, times_ns: IntArray) -> str | None:
        """Return why times (N,) are no nanoseconds; None: they may be, or are too few to tell."""
        steps = times_ns[1:] - times_ns[:-1]
        if len(steps) < _FEWEST_STEPS or steps.max() >= round(1e9 * self.least_s):
            return None
        return (
            f"{self.what} come {int(np.median(steps))} ns apart, which no sensor does: their times are "
            "numbers, milliseconds or microseconds; give integer nanoseconds"
        )


FRAME_PACE = Pace("frames", 1e-3, 5.0, 2e-3)
SAMPLE_PACE = Pace("samples", 1e-5, 0.5, 5e-5)
POSE_PACE = Pace("poses", 1e-4, 60.0, 1e-3)


def parse_stamps(
    texts: Sequence[str],
    where: Callable[[int], str],
    unit: str | None = None,
    *,
    pace: Pace | None = None,
    doubts: list[str] | None = None,
    increasing: bool = True,
) -> IntArray:
    """Parse stamps (N,) as exact decimals.

    Args:
        texts: one stamp each.
        where: returns the place of an entry, for messages.
        unit: "s", "ms", "us" or "ns"; None: by the size of the first (seconds since 1970 or since
            the start, or milliseconds, microseconds or nanoseconds since 1970), and by `pace`.
        pace: how far apart the entries may be, which decides where no unit is stated; None: the
            size alone decides.
        doubts: where to note that a unit was taken by the pace, with both readings.
        increasing: whether they must strictly increase.

    Raises:
        DataError: a stamp is no number, or not later than the one before, or its nanoseconds lack
            their leading zeros.
    """
    values = [_decimal(text, where, k) for k, text in enumerate(texts)]
    if unit is None:
        unit = _unit_of(values, where, pace, doubts)
    power = _POWERS[unit]
    limit = Decimal(INT64_MAX).scaleb(-power)
    for k, value in enumerate(values):
        # abs() would round, which no context can do with an exponent of any size
        if value.copy_abs() > limit:
            remedy = "divide nanoseconds by 1e9, or state their unit in a header ([ns])"
            raise DataError(f"{where(k)}: {texts[k]!r} is out of range for a time; {remedy}")
    times_ns = np.array(
        [int(value.scaleb(power).to_integral_value()) for value in values], dtype=np.int64
    )
    if unit == "s":
        _check_leading_zeros(texts, times_ns, where)
    return check_increasing(times_ns, where) if increasing else times_ns


def check_digits(texts: Sequence[str], where: Callable[[int], str]) -> None:
    """Raise DataError where a count of nanoseconds, microseconds or milliseconds was put behind the
    points of names, in any order, without its leading zeros.

    Then no decimals begin with a zero, and entries are as far apart as counts and not as decimals.
    Names whose zeros at the end were cut differ in length, too.
    """
    parts = [text.partition(".") for text in texts]
    ends = [end for _, _, end in parts]
    digits = max(map(len, ends))
    shorter = next((k for k, end in enumerate(ends) if len(end) < digits), None)
    if digits < 2 or shorter is None or any(len(end) > 1 and end[0] == "0" for end in ends):
        return
    counted = [f"{whole}.{end:0>{digits}}" for whole, _, end in parts]
    if _odd_steps(counted) >= _odd_steps(texts):
        return
    unit = {3: "milliseconds", 6: "microseconds"}.get(digits, "nanoseconds")
    raise DataError(
        f"{where(shorter)}: {unit} lack their leading zeros, as entries are evenly apart only with "
        f"them; write {counted[shorter]} for {texts[shorter]}"
    )


def _odd_steps(texts: Sequence[str]) -> int:
    """Return how many intervals between times in seconds, in order, are far from the median one."""
    times = np.sort([float(text) for text in texts])
    steps = np.diff(times - times[0])
    usual = np.median(steps) if len(steps) else 0.0
    return int((np.abs(steps - usual) > _ODD_STEP * usual).sum())


def _check_leading_zeros(
    texts: Sequence[str], times_ns: IntArray, where: Callable[[int], str]
) -> None:
    """Raise DataError where nanoseconds were put behind a point without their leading zeros:
    1700000000.50000000 for 1700000000 s and 50,000,000 ns.

    They go back as decimals, and increase as seconds and nanoseconds.
    """
    back = np.flatnonzero(np.diff(times_ns) <= 0)
    parts = []
    if len(back):
        parts = [_SECONDS_AND_NANOSECONDS.fullmatch(text) for text in texts]
    found = [(int(part[1]), int(part[2])) for part in parts if part is not None]
    is_complete = len(found) == len(texts)
    if not is_complete or not found or any(a >= b for a, b in pairwise(found)):
        return
    k = int(back[0])
    raise DataError(
        f"{where(k)}: the clock runs backwards ({texts[k + 1]} s after {texts[k]} s), as nanoseconds "
        f"lack their leading zeros; write {found[k][0]}.{found[k][1]:09d} for {texts[k]}"
    )


def _decimal(text: str, where: Callable[[int], str], row: int) -> Decimal:
    try:
        value = Decimal(text)
    except InvalidOperation:
        value = Decimal("NaN")
    if not value.is_finite():
        raise DataError(f"{where(row)}: {text!r} is no time; remove or correct that entry")
    return value


def _unit_of(
    values: Sequence[Decimal],
    where: Callable[[int], str],
    pace: Pace | None,
    doubts: list[str] | None,
) -> TimeUnit:
    """Return the unit by size; where that makes the entries too close or too far, that by pace."""
    size = values[0].copy_abs()
    by_size: TimeUnit = next((unit for unit, least in _SIZES if size >= least), "s")
    if pace is None or len(values) < 2 or max(map(Decimal.copy_abs, values)) > INT64_MAX:
        return by_size
    mean = float(values[-1] - values[0]) / (len(values) - 1)
    if pace.believes(mean * _seconds(by_size)):
        return by_size
    steps = [float(b - a) for a, b in pairwise(values)]
    step = float(np.median(steps))
    if pace.believes(step * _seconds(by_size)):
        return by_size
    by_pace = _unit_by_pace(step, values[-1], pace)
    if by_pace is not None and doubts is not None:
        doubts.append(_doubt(where(0), pace, step, by_pace, by_size))
    return by_pace or by_size


def _doubt(place: str, pace: Pace, step: float, taken: TimeUnit, other: TimeUnit) -> str:
    """Return what is said of stamps whose unit was taken by their median step."""
    return (
        f"{place}: its times are taken for {_NAMES[taken]} ({pace.what} "
        f"{step * _seconds(taken):.4g} s apart), as they would be {step * _seconds(other):.4g} s "
        f"apart in {_NAMES[other]}; if that is wrong, state the unit in a header, as '# time [s]'"
    )


def _unit_by_pace(step: float, last: Decimal, pace: Pace) -> TimeUnit | None:
    """Return the unit in which a median step is usual and the last stamp fits; None: there is
    none.
    """
    units: tuple[TimeUnit, ...] = ("s", "ms", "us", "ns")
    for unit in units:
        usual = pace.usual_s <= step * _seconds(unit) < _DECADES * pace.usual_s
        if usual and last.copy_abs() <= Decimal(INT64_MAX).scaleb(-_POWERS[unit]):
            return unit
    return None


def _seconds(unit: str) -> float:
    return 10.0 ** (_POWERS[unit] - 9)
