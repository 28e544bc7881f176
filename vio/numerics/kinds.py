"""Kinds of constants that decide nothing.

A constant decides where it separates two outcomes that a user could tell apart. One that is
declared with a kind of this module does not: half as much or half as little of it is to change no
result beyond rounding, so no test is asked to notice (`tools/mutate.py`). The comment beside it says
what it limits.
"""

from __future__ import annotations

from typing import Annotated, TypeAlias, TypeVar

T = TypeVar("T")

# Where a series of steps ends, how long the steps of a numeric derivative are, into how many blocks a
# jackknife divides, what counts as zero, what stands for infinity: results agree to the precision
# that is asked of them.
Tolerance: TypeAlias = Annotated[T, "tolerance"]
# Of memory, queues, batches and pauses, and of what is done beforehand: time and memory differ,
# results do not.
Capacity: TypeAlias = Annotated[T, "capacity"]
