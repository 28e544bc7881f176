"""Features of another program that repeat numbers of the frame before.

A tracker that runs at half the rate gives all its features twice; one that has lost a point, or its
right pixel, may go on with the last pixel or disparity. Measured again, no number is the same to the
last bit, unless pixels are whole ones or parts of these, which are not looked at, or images without
noise show a rig at rest, where nothing else moves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vio.findings import Finder, Finding
from vio.geometry.lie import FloatArray, lengths
from vio.guard.match_check import Hysteresis, without_right
from vio.numerics.robust import median
from vio.records import BoolArray, Observations, shared_rows


@dataclass(frozen=True, slots=True)
class _RepeatRules:
    """When numbers that are equal were not measured."""

    min_shared: int = 20  # features of two frames, with fewer of which a frame tells nothing
    few: float = (
        0.5  # share of the features that repeat their pixels; else the rig may have stopped …
    )
    moved_px: float = 0.5  # … unless the last flow of the others (median) was more
    parts: int = 32  # of a pixel; where most pixels are whole parts, equal ones are no wonder
    same_px: float = 1e-6  # of disparities, which are differences
    named_share: float = 0.05  # of the features that are repeated in a frame that is reported


_REPEATS = _RepeatRules()
_CODE = "frames-repeated"


class RepeatedFeatures(Finder):
    """Removes features whose pixels were not measured anew, and right pixels whose disparity was
    not.
    """

    def __init__(self) -> None:
        super().__init__()
        self._before: Observations | None = None
        self._flow_px = 0.0  # of the last frame in which most features have moved
        self._state = Hysteresis(to_report=3, to_end=20, blind=40)

    def inspect(self, seen: Observations) -> Observations:
        """Return the features of a frame that were measured in it."""
        before = self._before
        self._before = seen
        if before is None:
            return seen
        old, new = shared_rows(before.ids, seen.ids)
        if len(new) < _REPEATS.min_shared or _is_coarse(seen.z[new, :2]):
            return seen
        z_old = before.z[old]
        z_new = seen.z[new]
        same = (z_old[:, :2] == z_new[:, :2]).all(axis=1)
        if same.mean() < _REPEATS.few:
            self._flow_px = median(lengths(z_new[~same, :2] - z_old[~same, :2]))
        if self._flow_px < _REPEATS.moved_px:
            return seen
        carried = before.has_right[old] & seen.has_right[new] & ~same & _same_depth(z_old, z_new)
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

    def _report(self, index: int, same: float, carried: float) -> None:
        state = self._state
        share = max(same, carried)
        state.show(index, share >= _REPEATS.named_share)
        if state.to_report():
            what = "pixels" if same >= carried else "disparities"
            message = (
                f"frame {index}: the {what} of {100 * share:.0f} % of the features are those of the "
                f"frame before to the last bit since frame {state.since}, though others move: they "
                "were not measured anew, and are left out; give what was measured in a frame alone"
            )
            self._found.append(
                Finding(_CODE, message, index, state.since, lasts=True, figures={"share": share})
            )
        if state.ends():
            message = f"frame {index}: features are measured anew again"
            self._found.append(Finding(_CODE, message, index, ended=True))


def _is_coarse(pixels: FloatArray) -> bool:
    """Whether most of some pixels (N, 2) are whole ones, or whole parts of one."""
    parts = pixels * _REPEATS.parts
    return bool(np.mean(parts == np.rint(parts)) > 0.5)


def _same_depth(before: FloatArray, now: FloatArray) -> BoolArray:
    """Which features (N,) have the disparity of the frame before, of those whose disparities are
    measured to less than parts of a pixel; pixels (N, 4).
    """
    disparity = now[:, 0] - now[:, 2]
    parts = disparity * _REPEATS.parts
    fine = np.abs(parts - np.rint(parts)) > _REPEATS.parts * _REPEATS.same_px
    return np.asarray(fine & (np.abs(before[:, 0] - before[:, 2] - disparity) < _REPEATS.same_px))
