"""Whether tracks fit the motion of one rigid scene as well as their patches fit.

What moves by itself, more slowly than an outlier, is part of the consensus, and the estimate is a
compromise: all tracks fit worse than before, while each patch fits as well as ever. Where noise or
blur set in, patches fit worse as well, and errors are as large as they say. The motion is doubted by
the share of the tracks, or of their variance, that it does not explain.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vio.findings import Finding, begun, ended
from vio.numerics.robust import median
from vio.records import Observations

if TYPE_CHECKING:
    from vio.guard.two_motions import Apart


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

    def frame(
        self, seen: Observations, misfit: float | None, apart: Apart | None = None
    ) -> list[Finding]:
        """Return what begins or ends with a frame.

        Args:
            seen: its features, with the standard deviations of their patches; without, misfits are
                not judged.
            misfit: as in `UpdateReport`; None: it is not judged, as a sensor measures the motion.
            apart: features that follow a second motion; None: there are none.
        """
        excess = None if misfit is None else self._excess(seen, misfit)
        if excess is None and apart is None and not self._disagree:
            return []
        is_beyond = apart is not None or (excess is not None and excess > _MISFIT.limit)
        self._clear = 0 if is_beyond else self._clear + 1
        if is_beyond and not self._disagree:
            self._disagree = True
            if apart is not None:
                return [_apart(seen.frame_index, apart)]
            assert excess is not None
            return [_begun(seen.frame_index, self._indices[0], excess)]
        if self._disagree and self._clear >= _MISFIT.clear_frames:
            self._disagree = False
            return [ended(_CODE, seen.frame_index, "tracks fit a common motion again")]
        return []

    def _excess(self, seen: Observations, misfit: float) -> float | None:
        """By how much tracks fit worse than their patches explain, of late; None: too few frames or
        features tell.
        """
        if seen.sigma is None:
            return None
        stated_px = seen.sigma[seen.sigma[:, 0] > 0.0, 0]
        if len(stated_px) < _MISFIT.min_features:
            return None
        self._indices.append(seen.frame_index)
        self._excesses.append(misfit / self._explained(median(stated_px)))
        if len(self._excesses) < _MISFIT.frames:
            return None
        return median(np.array(self._excesses))

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
    text = (
        "tracks fit a common motion worse than before, and than their patches "
        f"explain ({excess:.1f} times the variance): something moves with the rig or by itself, "
        "slowly or in much of the image, and the motion may be a compromise with it"
    )
    figures = {"excess": excess, "doubted_share": 1.0 - 1.0 / excess}
    return begun(_CODE, index, text, since, figures=figures)


def _apart(index: int, apart: Apart) -> Finding:
    how = "stay at the same pixels" if apart.still else "follow another motion"
    text = (
        f"{100 * apart.share:.0f} % of the tracks {how} while the others move: a part "
        "of the rig, a mirror or a reflection is in view, or an object moves slowly, and the motion "
        "may be a compromise with it"
    )
    figures = {"second_share": apart.share, "doubted_share": apart.share}
    return begun(_CODE, index, text, apart.since, figures=figures)
