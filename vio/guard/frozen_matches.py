"""A right camera that is frozen: its pixels stay while the left ones move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.findings import begun, ended
from vio.guard.match_check import Hysteresis, MatchCheck, SharedMatches, without_right
from vio.numerics.robust import median
from vio.records import Observations


@dataclass(frozen=True, slots=True)
class _FrozenRules:
    """When right pixels count as frozen."""

    min_matches: int = 8  # shared with the frame before, with fewer of which a frame tells nothing
    min_motion_px: float = 2.0  # of the left pixels in their median: where they move less, likewise
    frozen_share: float = 0.1  # motion of right pixels over that of the left ones, at most
    moving_share: float = 0.5  # share from which on the camera moves again; usual is 0.7 to 1.3


_FROZEN = _FrozenRules()
_CODE = "right-image-frozen"


class FrozenMatches(MatchCheck):
    """Removes the right pixels of a frozen camera."""

    def __init__(self) -> None:
        super().__init__()
        self._state = Hysteresis(to_report=3, to_end=1, blind=40)

    def inspect(self, seen: Observations, shared: SharedMatches) -> Observations:
        """Compare the motion of left and right pixels since the frame before."""
        index = seen.frame_index
        state = self._state
        state.show(index, _is_frozen(shared))
        if state.to_report():
            text = (
                f"the right camera is frozen since frame {state.since}: its pixels "
                "stay while the left ones move; going on with the left ones"
            )
            self._found.append(begun(_CODE, index, text, state.since))
        if state.ends():
            self._found.append(ended(_CODE, index, "the right pixels move again, and are used"))
        return seen if state.since is None else without_right(seen)


def _is_frozen(shared: SharedMatches) -> bool | None:
    """Whether the right pixels stay; None: the frame does not tell."""
    if len(shared) < _FROZEN.min_matches:
        return None
    moved = np.abs(shared.now - shared.before)
    left = median(moved[:, :2].max(axis=1))
    right = median(moved[:, 2:].max(axis=1))
    if left < _FROZEN.min_motion_px:
        return None
    if right <= _FROZEN.frozen_share * left:
        return True
    return False if right >= _FROZEN.moving_share * left else None
