"""Replay of features tracked elsewhere: from a course file, or from the observations of an
earlier run.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from vio.errors import DataError
from vio.records import FrontendOutput, IntArray, Observations, StereoFrame, TrackPrior


class PrecomputedFrontend:
    """Return recorded observations in place of tracking."""

    def __init__(self, source: Callable[[int], Observations | None]) -> None:
        self._source = source  # frame index to observations, such as `Dataset.observations`
        self._previous: IntArray = np.zeros(0, dtype=np.int64)
        self._highest = -1

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Return the recorded observations of the frame, unchanged; images and prior are not used.

        Raises:
            DataError: the recording has no observations of this frame.
        """
        start = time.perf_counter()
        found = self._source(frame.index)
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
