"""Selectors: which observations of a frame enter the filter's update, and why.

The paper sorts features by how often they are seen and keeps the first seventh. `visibility` does that frame by
frame with what is known so far; `visibility_whole` looks at the whole record first, as the paper does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vio.errors import ConfigError
from vio.geometry.lie import FloatArray
from vio.protocols import Selector
from vio.records import BoolArray, IntArray, MotionPrior, Observations, Selection
from vio.setting import setting

SelectorName = Literal["all", "visibility", "visibility_whole", "grid"]


@dataclass(frozen=True, slots=True)
class SelectorSettings:
    """Which observations enter the update."""

    name: SelectorName = setting(
        "all",
        "all; visibility: the most often seen so far; visibility_whole: the most often seen in the whole record, as "
        "the paper does (precomputed features only); grid: the most often seen of each image cell",
    )
    keep_fraction: float = setting(1 / 7, "share of the features that is kept; the paper keeps 1/7")
    minimum: int = setting(12, "keep at least this many observations of a frame (all but visibility_whole)")
    grid_columns: int = setting(8, "cells across the image for the grid selector")
    grid_rows: int = setting(4, "cells down the image for the grid selector")


class _VisibilityCount:
    """Counts in how many frames each feature has been seen."""

    def __init__(self) -> None:
        self._count: dict[int, int] = {}

    def add(self, ids: IntArray) -> FloatArray:
        """Count one more sighting of each id (N,) and return the counts (N,)."""
        count = self._count
        for i in ids.tolist():
            count[i] = count.get(i, 0) + 1
        return np.array([count[i] for i in ids.tolist()], dtype=np.float64)

    def ranked_ids(self) -> list[int]:
        """All ids, most often seen first; ties by id, so that the order never depends on the run."""
        return [i for i, _ in sorted(self._count.items(), key=lambda item: (-item[1], item[0]))]


class KeepAll:
    """Keeps every observation."""

    def select(self, observations: Observations, motion: MotionPrior | None = None) -> Selection:
        """Choose all rows."""
        n = len(observations)
        return Selection(np.ones(n, dtype=np.bool_), np.zeros(n), "all")


class CausalVisibility:
    """Ranks the features of each frame by how often they have been seen up to now."""

    def __init__(self, keep_fraction: float, minimum: int) -> None:
        self._seen, self._fraction, self._minimum = _VisibilityCount(), keep_fraction, minimum

    def select(self, observations: Observations, motion: MotionPrior | None = None) -> Selection:
        """Choose the most often seen rows; ties go to the older feature."""
        score = self._seen.add(observations.ids)
        budget = _budget(len(score), self._fraction, self._minimum)
        return Selection(_best(score, observations.ids, budget), score, f"most seen so far, {budget} of {len(score)}")


class WholeRecordVisibility:
    """The paper's selection: rank all features of the record by visibility and keep the first share of them."""

    def __init__(self, record: Iterable[Observations], keep_fraction: float) -> None:
        counts = _VisibilityCount()
        for frame in record:
            counts.add(frame.ids)
        ranked = counts.ranked_ids()
        self._rank = {feature: position for position, feature in enumerate(ranked)}
        self._kept = int(len(ranked) * keep_fraction)

    def select(self, observations: Observations, motion: MotionPrior | None = None) -> Selection:
        """Choose the rows whose feature belongs to the kept share of the whole record."""
        rank = np.array([self._rank[i] for i in observations.ids.tolist()], dtype=np.float64)
        return Selection(rank < self._kept, -rank, f"most seen in the record, {self._kept} of {len(self._rank)}")


class GridVisibility:
    """The most often seen features of each image cell, so that no image region is given up."""

    def __init__(self, settings: SelectorSettings, width: int, height: int) -> None:
        self._seen, self._settings, self._size = _VisibilityCount(), settings, (width, height)

    def select(self, observations: Observations, motion: MotionPrior | None = None) -> Selection:
        """Choose rows in rounds: the best of each cell, then the second best of each, until the budget is met."""
        s, (width, height) = self._settings, self._size
        score = self._seen.add(observations.ids)
        budget = _budget(len(score), s.keep_fraction, s.minimum)
        column = np.clip(observations.z[:, 0] * s.grid_columns // width, 0, s.grid_columns - 1)
        row = np.clip(observations.z[:, 1] * s.grid_rows // height, 0, s.grid_rows - 1)
        order = np.lexsort((observations.ids, -score, row * s.grid_columns + column))
        cell = (row * s.grid_columns + column)[order]
        starts = np.flatnonzero(np.diff(cell, prepend=-1))
        place_in_cell = np.arange(len(cell)) - np.repeat(starts, np.diff(starts, append=len(cell)))
        round_of = np.empty(len(score))
        round_of[order] = place_in_cell
        # Earlier rounds first; within a round the most often seen.
        by_round = np.lexsort((observations.ids, -score, round_of))
        chosen = np.zeros(len(score), dtype=np.bool_)
        chosen[by_round[:budget]] = True
        return Selection(chosen, score, f"most seen of each cell, {budget} of {len(score)}")


def _budget(n: int, fraction: float, minimum: int) -> int:
    return min(n, max(int(np.ceil(n * fraction)), minimum))


def _best(score: FloatArray, ids: IntArray, budget: int) -> BoolArray:
    chosen = np.zeros(len(score), dtype=np.bool_)
    chosen[np.lexsort((ids, -score))[:budget]] = True
    return chosen


def build_selector(
    settings: SelectorSettings,
    *,
    image_size: tuple[int, int] | None,
    whole_record: Callable[[], Iterable[Observations]] | None,
) -> Selector:
    """Build the selector named in the settings.

    Args:
        settings: the selector's section of the configuration.
        image_size: width and height in pixels; None where unknown (feature files).
        whole_record: yields all observations of the record; None where they are not known in advance.

    Raises:
        ConfigError: a setting is out of range, or the selector needs what the recording cannot give.
    """
    if not 0 < settings.keep_fraction <= 1:
        raise ConfigError(f"selector.keep_fraction must lie in (0, 1], got {settings.keep_fraction:g}")
    if settings.grid_columns < 1 or settings.grid_rows < 1 or settings.minimum < 0:
        raise ConfigError("selector.grid_columns and grid_rows must be at least 1, selector.minimum at least 0")
    if settings.name == "visibility_whole":
        if whole_record is None:
            raise ConfigError(
                "selector visibility_whole must know the whole record in advance: run once with --save-observations "
                "and process that file, or use selector.name=visibility"
            )
        return WholeRecordVisibility(whole_record(), settings.keep_fraction)
    if settings.name == "grid":
        if image_size is None:
            raise ConfigError("selector grid needs the image size, which this recording does not know; use visibility")
        return GridVisibility(settings, *image_size)
    if settings.name == "visibility":
        return CausalVisibility(settings.keep_fraction, settings.minimum)
    return KeepAll()
