"""Selectors of the observations that enter the filter's update.

The paper sorts features by how often they are seen and keeps the first seventh. `visibility` does
that frame by frame with the counts so far; `visibility_whole` counts over the whole record first,
as the paper does. `information` keeps the features that together add most information on the
camera's motion. docs/notes/selection.md compares them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.errors import ConfigError
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics.kinds import Capacity
from vio.protocols import Selector
from vio.records import BoolArray, IntArray, MotionPrior, Observations, Selection
from vio.selection.information import (
    MotionInformation,
    lazy_greedy,
    log_det_gain,
    prior_information,
)
from vio.setting import Section, setting


class _SelectionRules(NamedTuple):
    """Which observations are kept."""

    min_kept: int = 12  # observations of a frame, where a share of them is kept
    # the gain is summed over the last motion, the next one and the one so many frames ahead
    horizon_frames: int = 4
    pixel_sigma_px: float = 0.5  # standard deviation of one pixel coordinate


_SELECTION = _SelectionRules()
# features whose observations are counted, 20 MB; a live run has no end
_MOST_COUNTED: Capacity[int] = 100_000

SelectorName = Literal["all", "visibility", "visibility_whole", "information"]


@dataclass(frozen=True, slots=True)
class SelectorSettings(Section):
    """Which observations enter the update."""

    section: ClassVar[str] = "selector"

    name: SelectorName = setting(
        "all",
        "visibility: the most often seen so far; visibility_whole: in the whole record, as the "
        "paper does (precomputed features only); information: those that add most on the camera's "
        "motion",
    )
    budget: int | None = setting(
        None, "observations kept of a frame; null: the share below", at_least=1
    )
    keep_fraction: float = setting(
        1 / 7, "share of the features that is kept; the paper keeps 1/7", above=0, at_most=1
    )


class _VisibilityCount:
    """Counts the frames in which each feature has been observed."""

    def __init__(self) -> None:
        self._count: OrderedDict[int, int] = OrderedDict()  # the newest observed last

    def add(self, ids: IntArray) -> FloatArray:
        """Count one more observation of each id (N,) and return the counts (N,)."""
        count = self._count
        for i in ids.tolist():
            count[i] = count.get(i, 0) + 1
            count.move_to_end(i)
        return np.array([count[i] for i in ids.tolist()], dtype=np.float64)

    def forget(self, most: int) -> None:
        """Forget the ids that were not observed for longest, all but so many."""
        while len(self._count) > most:
            self._count.popitem(last=False)

    def ranked_ids(self) -> list[int]:
        """Return all ids, most often observed first; ties by id, so that the order is
        reproducible.
        """
        return [i for i, _ in sorted(self._count.items(), key=lambda item: (-item[1], item[0]))]


def _budget(s: SelectorSettings, n: int) -> int:
    """Return how many of n rows may be chosen."""
    return min(
        n,
        max(int(np.ceil(n * s.keep_fraction)), _SELECTION.min_kept)
        if s.budget is None
        else s.budget,
    )


def _best(settings: SelectorSettings, score: FloatArray, ids: IntArray) -> BoolArray:
    """Choose the rows of largest score; ties go to the smaller id."""
    chosen = np.zeros(len(score), dtype=np.bool_)
    chosen[np.lexsort((ids, -score))[: _budget(settings, len(score))]] = True
    return chosen


class KeepAll:
    """Keeps every observation."""

    def select(self, observations: Observations, motion: MotionPrior | None = None) -> Selection:
        """Choose all rows."""
        n = len(observations)
        return Selection(np.ones(n, dtype=np.bool_), np.zeros(n), "all")


class CausalVisibility:
    """Ranks the features of each frame by their number of observations so far."""

    def __init__(self, settings: SelectorSettings) -> None:
        self._seen = _VisibilityCount()
        self._settings = settings

    def select(self, observations: Observations, motion: MotionPrior | None = None) -> Selection:
        """Choose the most often observed rows; ties go to the older feature."""
        score = self._seen.add(observations.ids)
        self._seen.forget(_MOST_COUNTED)
        chosen = _best(self._settings, score, observations.ids)
        return Selection(chosen, score, f"most seen so far, {chosen.sum()} of {len(score)}")


class WholeRecordVisibility:
    """The paper's selection: rank all features of the record by visibility and keep the first share
    of them.

    With a budget, the best-ranked features of each frame are kept.
    """

    def __init__(self, record: Iterable[Observations], settings: SelectorSettings) -> None:
        counts = _VisibilityCount()
        for frame in record:
            counts.add(frame.ids)
        ranked = counts.ranked_ids()
        self._rank = {feature: position for position, feature in enumerate(ranked)}
        self._kept = int(len(ranked) * settings.keep_fraction)
        self._settings = settings

    def select(self, observations: Observations, motion: MotionPrior | None = None) -> Selection:
        """Choose the rows whose feature is in the kept share of the whole record, or the
        best-ranked ones.
        """
        rank = np.array([self._rank[i] for i in observations.ids.tolist()], dtype=np.float64)
        if self._settings.budget is not None:
            chosen = _best(self._settings, -rank, observations.ids)
            return Selection(
                chosen, -rank, f"most seen in the record, {chosen.sum()} of {len(rank)}"
            )
        return Selection(
            rank < self._kept, -rank, f"most seen in the record, {self._kept} of {len(self._rank)}"
        )


class InformationGain:
    """The features with the largest joint information on the last and the coming motions
    (docs/notes/selection.md).
    """

    def __init__(self, settings: SelectorSettings, camera: StereoCamera) -> None:
        self._settings = settings
        self._model = MotionInformation(
            camera, _SELECTION.horizon_frames, _SELECTION.pixel_sigma_px
        )

    def select(self, observations: Observations, motion: MotionPrior | None = None) -> Selection:
        """Choose rows greedily by their gain in the log-determinant."""
        ids = observations.ids
        L = self._model.add_frame(observations, motion)
        prior = np.repeat(prior_information(motion)[None], L.shape[1], axis=0)
        greedy = lazy_greedy(prior, L, ids, _budget(self._settings, len(ids)))
        chosen = np.zeros(len(ids), dtype=np.bool_)
        chosen[greedy.order] = True
        self._model.mark_used(observations, chosen)
        nats = log_det_gain(prior, L[chosen])
        return Selection(chosen, greedy.gain, f"{nats:.1f} nats from {chosen.sum()} of {len(ids)}")


def build_selector(
    settings: SelectorSettings,
    *,
    whole_record: Callable[[], Iterable[Observations]] | None,
    camera: StereoCamera | None = None,
) -> Selector:
    """Build the selector named in the settings.

    `whole_record` yields all observations of the record, None where they are not available in
    advance; the information selector needs the camera.

    Raises:
        ConfigError: the recording lacks data that the selector needs.
    """
    if settings.name == "visibility_whole":
        if whole_record is None:
            raise ConfigError(
                "selector visibility_whole needs the whole record in advance: run once with "
                "--save-observations "
                "and process that file, or use selector.name=visibility"
            )
        return WholeRecordVisibility(whole_record(), settings)
    if settings.name == "information":
        if camera is None:
            raise ConfigError(
                "selector information needs the calibration of the cameras; use visibility"
            )
        return InformationGain(settings, camera)
    if settings.name == "visibility":
        return CausalVisibility(settings)
    return KeepAll()
