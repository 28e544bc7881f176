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
from vio.records import S_PER_NS, Observations, shared_rows


class _ViewRules(NamedTuple):
    """When the view is another one."""

    frames: int = 5  # before, whose shares are usual
    # Before, too: from the first frames on velocity and tilt are still found, in steps that nothing
    # predicts.
    begin_s: float = 0.3
    usual_share: float = 0.5  # of a frame's features that the next one shows again, at least
    min_features: int = 30  # of a frame that tells
    # at most, over the usual one, where a motion sensor carries the pose …
    lost_share: float = 0.25
    # … and by images alone: KITTI, rooms and flights with 0.2 to 2 seconds cut out come to 0.40 and
    # less; healthy ones have such frames, too (rain, blank walls), near where they are expected
    lost_share_alone: float = 0.42
    # Median innovation of those over its standard deviation, which by images alone allows for a
    # rig that brakes: recordings, cut, 2.1 and more. In rain, 0.8 at most; at a blank wall 1.6.
    min_sigmas: float = 2.0
    # The same where most are found again, and a motion sensor says how the rig moved: as long as the
    # record of MH_01 lacks half a second, 28 and 39; of healthy recordings single frames come to 4.
    apart_sigmas: float = 12.0
    text_frames: int = 3  # whose view is another one, before their spacing tells
    # after one such frame, in which others belong to the same event
    apart_frames: int = 10


_VIEW = _ViewRules()
_TEXT_PERIOD = 11  # frames from a number that ends a ten to the next, in the order of text


class ViewChange:
    """Reports each frame whose view does not continue that of the frame before."""

    def __init__(self) -> None:
        # the last frames that showed enough
        self._frames = deque[Observations](maxlen=_VIEW.frames + 2)
        # frames since the last one that was apart from its prediction
        self._since_apart = _VIEW.apart_frames
        self._lost: list[int] = []  # frames whose view was another one
        self._first_ns: int | None = None  # of the first frame

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
        if self._first_ns is None:
            self._first_ns = seen.time_ns
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
        lost_share = _VIEW.lost_share if measured else _VIEW.lost_share_alone
        if shares[-1] <= lost_share * usual:
            index = seen.frame_index
            self._lost.append(index)
            as_text = _in_order_of_text(self._lost)
            return [_lost(index, (len(frames[-2]), again[-1]), measured=measured, as_text=as_text)]
        begun = (seen.time_ns - self._first_ns) * S_PER_NS >= _VIEW.begin_s
        is_apart = imu and begun and _VIEW.apart_sigmas <= sigmas < np.inf
        if is_apart and self._since_apart > _VIEW.apart_frames:
            self._since_apart = 0
            return [_apart(seen.frame_index, sigmas)]
        return []


def _shown_again(before: Observations, after: Observations) -> int:
    """Return the number of features of a frame that the next one shows."""
    return len(shared_rows(before.ids, after.ids)[0])


def _in_order_of_text(lost: list[int]) -> bool:
    """Whether frames whose view is another one come as those of images numbered in the order of
    text do: 1, 10 to 19, 2, 20 to 29, with a jump before and after each number that ends a ten.
    """
    steps = {last - first for first in lost for last in lost}
    return len(lost) >= _VIEW.text_frames and {1, _TEXT_PERIOD} <= steps


def _lost(index: int, features: tuple[int, int], *, measured: bool, as_text: bool) -> Finding:
    """The finding on a frame that shows some features of the frame before again.

    `features`: those of the frame before, and those of them that it shows.
    """
    before, again = features
    figures = {"features_before": float(before), "features_again": float(again)}
    seen = (
        f"frame {index}: {again} of the {before} features of the frame before were found again, and "
        "not where they were expected: the view is another one"
    )
    if as_text:
        seen += (
            f", as {_TEXT_PERIOD} frames earlier and in pairs, which images do that were numbered in "
            "the order of text (1, 10, 11, …, 2); order them by their numbers"
        )
    if measured:
        message = f"{seen}; the pose is a prediction by the motion sensor"
        return Finding("no-features", message, index, figures=figures)
    if not as_text:
        seen += ", as after a jolt, a covered lens, or where parts of recordings are joined"
    message = f"{seen}; how the rig moved in between is not known"
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
