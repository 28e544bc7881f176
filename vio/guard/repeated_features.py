"""Features of another program that repeat numbers of the frame before.

A tracker that runs at half the rate gives all its features twice; one that has lost a point, or its
right pixel, may go on with the last pixel or disparity. Measured again, no number is the same to the
last bit, unless

- pixels, disparities or depths are multiples of a step, as of images that were made smaller: then
  features repeat one of two numbers, or have those of each other, about as often;
- images without noise show a rig at rest, where nothing else moves;
- a rig without noise moves along its images' plane, where no depth changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vio.findings import Finder, begun, ended
from vio.geometry.lie import FloatArray, lengths
from vio.guard.match_check import Hysteresis, without_right
from vio.numerics.robust import median
from vio.records import BoolArray, Observations, shared_rows


@dataclass(frozen=True, slots=True)
class _RepeatRules:
    """When numbers that are equal were not measured."""

    min_shared: int = 20  # features of two frames, with fewer of which a frame tells nothing
    # share of the features that repeat their pixels; else the rig may have stopped …
    few: float = 0.5
    moved_px: float = 0.5  # … unless the last flow of the others (median) was more
    most: float = 0.95  # share of the features that repeat their pixels …
    longest: int = 5  # … in so many frames in a row at most; longer, it is a rig at rest
    by_chance: float = 0.05  # numbers that a step makes equal, over the repeated ones
    coincidences: float = 0.002  # share of all that are equal without a step
    memory: float = 0.97  # per frame, of their counts
    same_px: float = 1e-6  # of disparities, which are differences
    exact_px: float = 1e-3  # how well a motion of the plane explains pixels without noise (median)
    named_share: float = 0.05  # of the features that are repeated in a frame that is reported


_REPEATS = _RepeatRules()
_CODE = "frames-repeated"


class _Chances:
    """Whether numbers are equal because they are multiples of a step."""

    def __init__(self) -> None:
        self._alike = 0.0  # numbers that only a step makes equal
        self._repeated = 0.0
        self._all = 0.0

    def see(self, alike: int, repeated: int, of: int) -> None:
        """Take the counts of a frame, and of all its numbers."""
        self._alike = _REPEATS.memory * self._alike + alike
        self._repeated = _REPEATS.memory * self._repeated + repeated
        self._all = _REPEATS.memory * self._all + of

    def explain(self) -> bool:
        """Return whether a step explains the repeated ones."""
        least = max(_REPEATS.by_chance * self._repeated, _REPEATS.coincidences * self._all)
        return self._alike > least


class RepeatedFeatures(Finder):
    """Removes features whose pixels were not measured anew, and right pixels whose disparity was
    not.
    """

    def __init__(self) -> None:
        super().__init__()
        self._before: Observations | None = None
        self._flow_px = 0.0  # of the last frame in which most features have moved
        self._unmoved = 0  # frames in a row in which hardly any has
        self._pixels = _Chances()
        self._disparities = _Chances()
        self._state = Hysteresis(to_report=3, to_end=20, blind=40)

    def inspect(self, seen: Observations) -> Observations:
        """Return the features of a frame that were measured in it."""
        before = self._before
        self._before = seen
        if before is None:
            return seen
        old, new = shared_rows(before.ids, seen.ids)
        if len(new) < _REPEATS.min_shared:
            self._unmoved = 0
            return seen
        z_old = before.z[old]
        z_new = seen.z[new]
        same = self._same_pixels(z_old, z_new)
        if self._flow_px < _REPEATS.moved_px:
            return seen
        pair = before.has_right[old] & seen.has_right[new]
        carried = self._same_disparities(z_old, z_new, pair) & ~same
        if self._pixels.explain() or self._unmoved > _REPEATS.longest:
            same[:] = False
        self._report(seen.frame_index, float(same.mean()), float(carried.mean()))
        if carried.any():
            dropped = np.zeros(len(seen), dtype=np.bool_)
            dropped[new[carried]] = True
            seen = without_right(seen, dropped)
        if not same.any():
            return seen
        stale = seen.stale.copy()
        stale[new[same]] = True
        return replace(seen, stale=stale)

    def _same_pixels(self, before: FloatArray, now: FloatArray) -> BoolArray:
        """Which features (N,) have the left pixel of the frame before; pixels (N, 4)."""
        equal = before[:, :2] == now[:, :2]
        same = equal.all(axis=1)
        share = float(same.mean())
        self._unmoved = self._unmoved + 1 if share > _REPEATS.most else 0
        if share < _REPEATS.few:
            flow = now[~same, :2] - before[~same, :2]
            self._flow_px = median(lengths(flow))
            alike = int((equal.any(axis=1) & ~same).sum())
            self._pixels.see(alike, int(same.sum()), len(now))
        return same

    def _same_disparities(self, before: FloatArray, now: FloatArray, pair: BoolArray) -> BoolArray:
        """Which features (N,) have the disparity of the frame before and must not have it; pixels
        (N, 4), and which have right ones in both.
        """
        was = before[:, 0] - before[:, 2]
        disparity = now[:, 0] - now[:, 2]
        same = pair & (np.abs(was - disparity) < _REPEATS.same_px)
        others = np.diff(np.sort(disparity[pair]))
        alike = int((others < _REPEATS.same_px).sum())
        self._disparities.see(alike, int(same.sum()), int(pair.sum()))
        if same.any() and (self._disparities.explain() or _in_plane(before[pair], now[pair])):
            same[:] = False
        return same

    def _report(self, index: int, same: float, carried: float) -> None:
        state = self._state
        share = max(same, carried)
        state.show(index, share >= _REPEATS.named_share)
        if state.to_report():
            what = "pixels" if same >= carried else "disparities"
            text = (
                f"the {what} of {100 * share:.0f} % of the features are those of the "
                f"frame before to the last bit since frame {state.since}, though others move: they "
                "were not measured anew, and are left out; give what was measured in a frame alone"
            )
            self._found.append(begun(_CODE, index, text, state.since, figures={"share": share}))
        if state.ends():
            self._found.append(ended(_CODE, index, "features are measured anew again"))


def _in_plane(before: FloatArray, now: FloatArray) -> bool:
    """Whether a motion along the images' plane, or about their axis, takes pixels (N, 4) of the frame
    before to those of the next one: a turn and, by the disparity, a shift.
    """
    disparity = before[:, 0] - before[:, 2]
    terms = np.column_stack([before[:, :2], disparity, np.ones(len(before))])
    if len(terms) <= 2 * terms.shape[1]:
        return True
    fit = np.linalg.lstsq(terms, now[:, :2], rcond=None)[0]
    return median(lengths(now[:, :2] - terms @ fit)) < _REPEATS.exact_px
