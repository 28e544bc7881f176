"""A right camera that has turned in its mount during a run: its disparities are off by as much at
all depths from one frame on, and stay so.

What stays is taken out of all later matches, so that depths are again those of the pair as it was. A
pair that shakes, or whose cameras expose apart while the rig turns, is off by another amount in each
frame: while it does so, the offset of every frame is measured, also where it is too small to lose
matches by, as depths would follow it else.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from vio.findings import Finder, Finding

_FRAMES = 6  # in a row whose offsets agree: cameras that expose apart in a turn ramp up
_AGREE = 0.05  # of their mean: largest deviation
_MIN_OFFSET_PX = 0.3  # an offset that is smaller is that of noise
_RECENT = 20  # frames, of which so many are off where a pair shakes
_SHAKING = 5
_CODE = "right-camera-turned"


class RightTurn(Finder):
    """Finds an offset of disparities that stays, and reports it."""

    def __init__(self, focal_px: float) -> None:
        super().__init__()
        self._focal_px = focal_px
        self._turn_px = 0.0  # that stays, and is taken out
        self._were_off = deque[bool](maxlen=_RECENT)
        self._offsets: list[float] = []  # of the last frames in a row that were off, pixels

    @property
    def may_stay(self) -> bool:
        """Whether the last frame was off, or so many of the last ones that the pair shakes."""
        return bool(self._offsets) or self._shakes

    @property
    def _shakes(self) -> bool:
        return sum(self._were_off) >= _SHAKING

    def is_offset(self, offset_px: float | None) -> bool:
        """Whether disparities are off by more than noise; of a pair that shakes, all are."""
        return offset_px is not None and (self._is_off(offset_px) or self._shakes)

    def _is_off(self, offset_px: float) -> bool:
        return abs(offset_px - self._turn_px) > _MIN_OFFSET_PX

    def frame(self, index: int, offset_px: float | None) -> float | None:
        """Take by how much the disparities of a frame are off, against those of the pair as it was.

        None: they are not, or nothing is known.

        Returns:
            The offset that stays, from now on; None: none does.
        """
        off = offset_px is not None and self._is_off(offset_px)
        self._were_off.append(off)
        if offset_px is None or not off:
            self._offsets = []
            return None
        self._offsets = [*self._offsets, offset_px][-_FRAMES:]
        offsets = np.array(self._offsets)
        stays = float(offsets.mean())
        if len(offsets) < _FRAMES or np.abs(offsets - stays).max() > _AGREE * abs(stays):
            return None
        self._turn_px = stays
        self._offsets = []
        self._were_off.clear()
        turned_deg = float(np.degrees(np.arctan(stays / self._focal_px)))
        message = (
            f"frame {index}: the right camera has turned by {abs(turned_deg):.2g} degrees about the "
            f"vertical: since frame {index - _FRAMES + 1} all disparities are off by {stays:.2g} px; "
            "that is taken out; fix its mount, and calibrate anew"
        )
        figures = {"turned_deg": turned_deg, "offset_px": stays}
        self._found.append(Finding(_CODE, message, index, index - _FRAMES + 1, figures=figures))
        return stays
