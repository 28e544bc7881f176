"""Whether the scene is another one from one frame to the next: what was seen is gone, and what is
left of it is not where the motion so far would bring it.

The camera was covered and carried, frames or parts of another recording follow without a gap in the
stamps, or it was turned or thrown faster than features can be followed. By images alone nothing
measures the motion in between, and the filter takes it to be as smooth as before: it cannot know how
far the rig is from there. A motion sensor has measured it, unless its samples lack the same time.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vio.findings import Finding
from vio.numerics.robust import median
from vio.records import Observations, shared_rows


class _ViewRules(NamedTuple):
    """When the view is another one."""

    frames: int = 5  # before, whose shares are usual
    usual_share: float = 0.5  # of a frame's features that the next one shows again, at least
    min_features: int = 30  # of a frame that tells
    # at most, over the usual one; KITTI with half a second cut out: 0.22 and less, rain: 0.32
    lost_share: float = 0.25
    # Median innovation of those over its standard deviation, which by images alone allows for a
    # rig that brakes: KITTI, cut, 2.1 to 4.7. In rain, 0.8 at most.
    min_sigmas: float = 2.0
    # The same where most are found again, and a motion sensor says how the rig moved: as long as the
    # record of MH_01 lacks half a second, 28 and 39; of healthy recordings single frames come to 4.
    apart_sigmas: float = 12.0
    # after one such frame, in which others belong to the same event
    apart_frames: int = 10


_VIEW = _ViewRules()


class ViewChange:
    """Reports each frame whose view does not continue that of the frame before."""

    def __init__(self) -> None:
        # the last frames that showed enough
        self._frames = deque[Observations](maxlen=_VIEW.frames + 2)
        # frames since the last one that was apart from its prediction
        self._since_apart = _VIEW.apart_frames

    def frame(
        self, seen: Observations, innovation_ratio: float | None, *, measured: bool, imu: bool
    ) -> list[Finding]:
        """Return what a frame shows.

        Args:
            seen: its features.
            innovation_ratio: as in `UpdateReport`; None: none of them was predicted.
            measured: whether a motion sensor carries the pose between frames.
            imu: whether it is an IMU, which has agreed so far: what contradicts the images for
                longer is no shock.
        """
        self._since_apart += 1
        if len(seen) < _VIEW.min_features:
            return []
        frames = self._frames
        frames.append(seen)
        sigmas = np.inf if innovation_ratio is None else innovation_ratio
        if sigmas < _VIEW.min_sigmas or len(frames) < _VIEW.frames + 2:
            return []
        again = [_shown_again(a, b) for a, b in pairwise(frames)]
        shares = [count / len(frame) for count, frame in zip(again, frames, strict=False)]
        usual = median(np.array(shares[:-1]))
        if usual < _VIEW.usual_share:
            return []
        if shares[-1] <= _VIEW.lost_share * usual:
            return [_lost(seen.frame_index, len(frames[-2]), again[-1], measured=measured)]
        is_apart = imu and _VIEW.apart_sigmas <= sigmas < np.inf
        if is_apart and self._since_apart > _VIEW.apart_frames:
            self._since_apart = 0
            return [_apart(seen.frame_index, sigmas)]
        return []


def _shown_again(before: Observations, after: Observations) -> int:
    """Return the number of features of a frame that the next one shows."""
    return len(shared_rows(before.ids, after.ids)[0])


def _lost(index: int, before: int, again: int, *, measured: bool) -> Finding:
    """The finding on a frame that shows `again` of the features `before`."""
    figures = {"features_before": float(before), "features_again": float(again)}
    seen = (
        f"frame {index}: {again} of the {before} features of the frame before were found again, and "
        "not where they were expected: the view is another one"
    )
    if measured:
        message = f"{seen}; the pose is a prediction by the motion sensor"
        return Finding("no-features", message, index, figures=figures)
    message = (
        f"{seen}, as after a jolt, a covered lens, or where parts of recordings are joined; how the "
        "rig moved in between is not known"
    )
    return Finding("view-changed", message, index, figures=figures)


def _apart(index: int, sigmas: float) -> Finding:
    """The finding on a frame in which the images contradict the sensor at once."""
    message = (
        f"frame {index}: all features lie {sigmas:.0f} standard deviations from where the motion "
        "sensor predicts them: it was shocked, or frames or samples of some time are missing "
        "though the stamps go on"
    )
    figures = {"innovation_ratio": sigmas}
    return Finding("imu-disagrees", message, index, figures=figures)
