"""Whether tracks fit the motion of one rigid scene as well as their patches fit.

What moves by itself, more slowly than an outlier, is part of the consensus, and the estimate is a
compromise: all tracks fit worse than before, while each patch fits as well as ever. Where noise or
blur set in, patches fit worse as well, and errors are as large as they say.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from vio.findings import Finding
from vio.numerics.robust import median
from vio.records import Observations


class _MisfitRules(NamedTuple):
    """When tracks contradict one another."""

    frames: int = 5  # the newest, of which the median counts
    # Variance of the tracks' pixels, over the usual one and what patches explain of the change. In
    # healthy variants of six recordings at most 1.26, in fifteen others 1.44; with an object that moves
    # by less than an outlier 1.7 and more.
    limit: float = 1.6
    # that tracks last for: a contradiction is in their errors from then on
    before_frames: int = 10
    clear_frames: int = 20  # below the limit, in a row, before it is over
    # How fast it is learned what patches usually state, and the change of the variance from frame to
    # frame that is believed: as the filter learns its noise, which lags behind as much.
    gain: float = 0.05
    max_change: float = 4.0
    min_features: int = 30


_MISFIT = _MisfitRules()
_CODE = "tracks-disagree"


class TrackMisfit:
    """Reports that tracks fit no common motion, and when that is over."""

    def __init__(self) -> None:
        self._excesses = deque[float](maxlen=_MISFIT.frames)
        self._indices = deque[int](maxlen=_MISFIT.before_frames)
        self._usual = 0.0  # logarithm of the variance that patches state
        self._count = 0  # frames that it was learned from
        self._disagree = False  # as reported
        self._clear = 0  # frames in a row in which they do not

    def frame(self, seen: Observations, misfit: float) -> list[Finding]:
        """Return what begins or ends with a frame.

        Args:
            seen: its features, with the standard deviations of their patches; without, nothing is
                judged.
            misfit: as in `UpdateReport`.
        """
        if seen.sigma is None:
            return []
        stated_px = seen.sigma[seen.sigma[:, 0] > 0.0, 0]
        if len(stated_px) < _MISFIT.min_features:
            return []
        self._indices.append(seen.frame_index)
        self._excesses.append(misfit / self._explained(float(np.median(stated_px))))
        excess = median(np.array(self._excesses))
        is_beyond = len(self._excesses) == _MISFIT.frames and excess > _MISFIT.limit
        self._clear = 0 if is_beyond else self._clear + 1
        if is_beyond and not self._disagree:
            self._disagree = True
            return [_begun(seen.frame_index, self._indices[0], excess)]
        if self._disagree and self._clear >= _MISFIT.clear_frames:
            self._disagree = False
            message = f"frame {seen.frame_index}: tracks fit a common motion again"
            return [Finding(_CODE, message, seen.frame_index, ended=True)]
        return []

    def _explained(self, stated_px: float) -> float:
        """By how much a frame's patches fit worse than usual, as a ratio of variances, at least 1,
        by the standard deviation that they state.
        """
        stated = 2.0 * math.log(stated_px)
        self._count += 1
        change = stated - self._usual if self._count > 1 else 0.0
        self._usual = stated - change
        most = math.log(_MISFIT.max_change)
        self._usual += max(1.0 / self._count, _MISFIT.gain) * min(max(change, -most), most)
        return max(math.exp(change), 1.0)


def _begun(index: int, since: int, excess: float) -> Finding:
    message = (
        f"frame {index}: tracks fit a common motion worse than before, and than their patches "
        f"explain ({excess:.1f} times the variance): something moves with the rig or by itself, "
        "slowly or in much of the image, and the motion may be a compromise with it"
    )
    return Finding(_CODE, message, index, since, lasts=True, figures={"excess": excess})
