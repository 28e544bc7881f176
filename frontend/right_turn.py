"""A right camera that has turned in its mount during a run: its disparities are off by as much at
all depths from one frame on, and stay so.

What stays is taken out of all later matches, so that depths are again those of the pair as it was. A
pair that shakes, or whose cameras expose apart while the rig turns, is off by another amount in each
frame: while it does so, the offset of every frame is measured, also where it is too small to lose
matches by, as depths would follow it else.

What is too small for that still moves all depths of a frame together. Its size over the last frames
says how much less the disparities of a frame are known than those of as many features by themselves.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from vio.findings import Finder, Finding
from vio.numerics.robust import robust_sigma


class _TurnRules(NamedTuple):
    """When the right camera has turned."""

    frames: int = 6  # in a row whose offsets agree: cameras that expose apart in a turn ramp up
    alike_share: float = 0.05  # of their mean: largest deviation
    min_offset_px: float = 0.3  # an offset that is smaller is that of noise
    jump_px: float = 0.5  # of all disparities since the frame before …
    # … and an angle: a drive whose calibration is off has 0.55 px, 0.044 degrees
    jump_rad: float = 0.07 * np.pi / 180.0


_TURN = _TurnRules()


class _ShakeRules(NamedTuple):
    """When a pair shakes."""

    recent_frames: int = 20  # frames, of which so many are off where a pair shakes
    shaking_frames: int = 5
    min_frames: int = 10  # whose common errors are known, before a pair is said to shake
    min_px: float = 0.12  # standard deviation of the common error …
    # … and of the angle: a drive whose calibration is off comes to 0.15 px, 0.012 degrees
    min_rad: float = 0.02 * np.pi / 180.0
    pixel_sigma_px: float = 0.3  # of one disparity


_SHAKE = _ShakeRules()
_CODE = "right-camera-turned"
_SHAKE_CODE = "right-camera-shakes"


def jump_limit_px(focal_px: float) -> float:
    """By how much all disparities change together, from one frame to the next, where a camera with
    this focal length has turned.
    """
    return max(_TURN.jump_px, focal_px * _TURN.jump_rad)


class RightTurn(Finder):
    """Finds an offset of disparities that stays, and reports it."""

    def __init__(self, focal_px: float) -> None:
        super().__init__()
        self._focal_px = focal_px
        self._turn_px = 0.0  # that stays, and is taken out
        self._were_off = deque[bool](maxlen=_SHAKE.recent_frames)
        self._offsets: list[float] = []  # of the last frames in a row that were off, pixels
        self._flow_px = 0.0  # by which features moved along u in a frame when a turn was found

    @property
    def may_stay(self) -> bool:
        """Whether the last frame was off, or so many of the last ones that the pair shakes."""
        return bool(self._offsets) or self._shakes

    @property
    def _shakes(self) -> bool:
        return sum(self._were_off) >= _SHAKE.shaking_frames

    def is_jump(self, common_px: float | None) -> bool:
        """Whether the disparities of a frame differ from those of the frame before by more than
        noise.
        """
        return common_px is not None and abs(common_px) > jump_limit_px(self._focal_px)

    def is_offset(self, offset_px: float | None) -> bool:
        """Whether disparities are off by more than noise; of a pair that shakes, all are."""
        return offset_px is not None and (self._is_off(offset_px) or self._shakes)

    def _is_off(self, offset_px: float) -> bool:
        return abs(offset_px - self._turn_px) > _TURN.min_offset_px

    def explained(self, index: int, delay: float) -> bool:
        """Return whether what was taken for a turn is what a right camera shows that is late by a
        delay in frames, which has been found since; then it is none.
        """
        shown_px = delay * self._flow_px
        if not abs(self._turn_px - shown_px) < 0.5 * abs(self._turn_px):
            return False
        self._turn_px = 0.0
        self._offsets = []
        self._were_off.clear()
        message = f"frame {index}: the right camera has not turned: it exposes at another time"
        self._found.append(Finding(_CODE, message, index, ended=True))
        return True

    def frame(self, index: int, offset_px: float | None, flow_px: float = 0.0) -> float | None:
        """Take by how much the disparities of a frame are off, against those of the pair as it was.

        Args:
            index: frame number.
            offset_px: by how much; None: they are not, or nothing is known.
            flow_px: by which features have moved along u in the time of a frame, median.

        Returns:
            The offset that stays, from now on; None: none does.
        """
        off = offset_px is not None and self._is_off(offset_px)
        self._were_off.append(off)
        if offset_px is None or not off:
            self._offsets = []
            return None
        self._offsets = [*self._offsets, offset_px][-_TURN.frames :]
        offsets = np.array(self._offsets)
        stays = float(offsets.mean())
        if len(offsets) < _TURN.frames or np.abs(offsets - stays).max() > _TURN.alike_share * abs(
            stays
        ):
            return None
        self._turn_px = stays
        self._flow_px = flow_px
        self._offsets = []
        self._were_off.clear()
        turned_deg = float(np.degrees(np.arctan(stays / self._focal_px)))
        message = (
            f"frame {index}: the right camera has turned by {abs(turned_deg):.2g} degrees about the "
            f"vertical: since frame {index - _TURN.frames + 1} all disparities are off by {stays:.2g} px; "
            "that is taken out; fix its mount, and calibrate anew"
        )
        figures = {"turned_deg": turned_deg, "offset_px": stays}
        self._found.append(
            Finding(_CODE, message, index, index - _TURN.frames + 1, figures=figures)
        )
        return stays


class PairShake(Finder):
    """Measures what the disparities of whole frames are off by, and reports a pair that shakes."""

    def __init__(self, focal_px: float) -> None:
        super().__init__()
        # of the common error, beyond which a pair is said to shake
        self.limit_px = max(_SHAKE.min_px, focal_px * _SHAKE.min_rad)
        self._common_px = deque[float](maxlen=_SHAKE.recent_frames)
        self._matched = 0
        self._reported = False
        # standard deviation of the common error of a frame's disparities, pixels
        self.sigma_px = 0.0

    @property
    def right_factor(self) -> float:
        """By how much larger the standard deviations of right pixels are, so that all of a frame
        together are as uncertain as what they have in common; 1: the pair is firm.
        """
        sigma_px = self.sigma_px
        if sigma_px <= self.limit_px:
            return 1.0
        return float(np.sqrt(1.0 + self._matched * (sigma_px / _SHAKE.pixel_sigma_px) ** 2))

    def frame(self, index: int, common_px: float | None, matched: int) -> None:
        """Take by how much the disparities of a frame's matches differ from those of the frame
        before (median); None: it is not known.
        """
        self._matched = matched
        if common_px is None:
            return
        self._common_px.append(common_px)
        self.sigma_px = self._measured_px()
        shakes = self.sigma_px > self.limit_px
        if shakes and not self._reported:
            self._reported = True
            message = (
                f"frame {index}: the disparities of whole frames scatter by {self.sigma_px:.2g} px: "
                "the right camera shakes in its mount, or the cameras do not expose together; its "
                "pixels count less; fix its mount, or synchronise the cameras"
            )
            figures = {"common_px": self.sigma_px}
            since = index - len(self._common_px) + 1
            self._found.append(
                Finding(_SHAKE_CODE, message, index, since, lasts=True, figures=figures)
            )
        elif self.sigma_px < 0.5 * self.limit_px:
            self._end(index)

    def explained(self, index: int) -> None:
        """Forget the errors so far: the right images are those of another time, which is known."""
        self._common_px.clear()
        self.sigma_px = 0.0
        self._end(index)

    def _end(self, index: int) -> None:
        if self._reported:
            self._reported = False
            message = f"frame {index}: the disparities of whole frames agree again"
            self._found.append(Finding(_SHAKE_CODE, message, index, ended=True))

    def _measured_px(self) -> float:
        """Size of the common errors, by their median: other events, as a car that passes, may be
        in almost half of the frames. A frame's error is the difference of two: its depths are those
        of the frame before.

        Errors of a pair that shakes are independent. Those of a calibration that is off change slowly
        as the rig turns: their size is that of the changes, where it is less.
        """
        if len(self._common_px) < _SHAKE.min_frames:
            return 0.0
        changes = np.diff(self._common_px)  # e - 2 e' + e'': six variances
        of_frames = robust_sigma(self._common_px) / math.sqrt(2.0)
        return min(of_frames, robust_sigma(changes) / math.sqrt(6.0))
