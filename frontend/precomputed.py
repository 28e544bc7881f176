"""Replay of features tracked elsewhere: from a course file, or from the observations of an
earlier run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vio.errors import DataError
from vio.records import (
    FrontendOutput,
    IntArray,
    Observations,
    StereoFrame,
    TrackPrior,
    shared_rows,
)


class PrecomputedFrontend:
    """Return recorded observations in place of tracking."""

    def __init__(
        self,
        source: Callable[[int], Observations | None],
        *,
        checks_matches: bool = False,
        checks_repeats: bool = False,
    ) -> None:
        """Take what returns the observations of a frame by its index, such as
        `Dataset.observations`.

        Args:
            source: returns the observations of a frame.
            checks_matches: a run of this package made them, and has checked them.
            checks_repeats: those that repeat old pixels are marked, or taken on purpose.
        """
        self._source = source
        self.checks_matches = checks_matches
        self.checks_repeats = checks_repeats
        self.checks_objects = checks_matches
        # frames by which the right pixels are late, as `vio.guard.repairing.repaired` has it
        self.right_delay = 0
        self._previous: IntArray = np.zeros(0, dtype=np.int64)
        self._highest = -1

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Return the recorded observations of the frame, unchanged but for `right_delay`; images
        and prior are not used.

        Raises:
            DataError: the recording has no observations of this frame.
        """
        start = time.perf_counter()
        found = self._paired(frame.index)
        if found is None:
            raise DataError(
                f"frame {frame.index} has no precomputed observations; use a front end that reads "
                "images, "
                "or a feature file that covers this frame"
            )
        tracked = int(np.isin(found.ids, self._previous, assume_unique=True).sum())
        detected = int((found.ids > self._highest).sum())
        self._previous = found.ids
        self._highest = max(self._highest, int(found.ids.max(initial=-1)))
        stages_ms = {"replay": 1e3 * (time.perf_counter() - start)}
        return FrontendOutput(found, tracked, int(found.has_right.sum()), detected, stages_ms)

    def _paired(self, index: int) -> Observations | None:
        """Return the observations of a frame, left and right pixels of one exposure."""
        found = self._source(index)
        if found is None or self.right_delay == 0:
            return found
        after = self._source(index + 1)
        if after is None:
            return replace(found, has_right=np.zeros(len(found), dtype=np.bool_))
        if self.right_delay > 0:
            return with_right_of(found, after)
        early = with_right_of(after, found)
        return replace(early, frame_index=found.frame_index, time_ns=found.time_ns)


def with_right_of(seen: Observations, other: Observations) -> Observations:
    """Return the features of a frame with the right pixels that another frame shows of them.

    Those that it does not show have none.
    """
    rows, others = shared_rows(seen.ids, other.ids)
    z = seen.z.copy()
    z[rows, 2:] = other.z[others, 2:]
    has_right = np.zeros(len(seen), dtype=np.bool_)
    has_right[rows] = other.has_right[others]
    return replace(seen, z=z, has_right=has_right)
