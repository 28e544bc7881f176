"""Left images that were paired with the right images of another frame from the start.

Rows of a true pair agree. While the rig moves, those of a left image and the right one of the frame
before or after agree less, by another amount in each frame: a right camera that is pitched has rows that
are off by the same in all of them. In the first frames, corners of both left images are searched
along the rows of this right image and of the one before; the pairing in which clearly more of them
match is the right one, unless one difference of all rows explains the pairs as they came as well.
Where the pairs as they came are not the best, those of up to three frames apart are compared, too: of
images two frames apart, those one frame apart agree better than the pairs do.

A right image that belongs to a *later* left one (it came early) is held back for it. One that
belongs to a left image *before* (it is late) is marked, as its left image is gone already.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from vio.findings import Finding
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.image_change import has_moved
from vio.guard.image_check import FrameImages, ImageCheck, images_of
from vio.guard.probe import RowProbe
from vio.records import Image, IntArray, StereoFrame


class _PairingRules(NamedTuple):
    """When left images belong to the right images of another frame."""

    counted_frames: int = 3  # that must have been counted
    alike_frames: int = 2  # frames in a row after which the counts so far tell the same
    max_tests: int = 40  # frames in which the rig moves, after which the pairing counts as right
    min_points: int = 30  # corners in a frame
    near_frames: int = 3  # frames that images of a pair may be apart, at first …
    far_frames: int = 10  # … and where that does not tell
    min_share: float = 0.4  # of the corners that match in the best pairing
    clear_factor: float = 1.3  # times as many as in both others


_PAIRING = _PairingRules()


def told_delay(points: int, matched: Mapping[int, int]) -> int | None:
    """Return the frames by which a right image is late; None: these counts do not tell.

    Args:
        points: corners that were searched.
        matched: how many of them match, by the frames by which the right image may be late.
    """
    best = max(matched, key=lambda delay: matched[delay])
    others = max(count for delay, count in matched.items() if delay != best)
    clear = matched[best] >= max(_PAIRING.min_share * points, _PAIRING.clear_factor * others)
    return best if clear and points >= _PAIRING.min_points else None


@dataclass(frozen=True)
class _Halves:
    """The images of a frame (H/2, W/2) at half resolution."""

    left: Image
    right: Image
    probe: RowProbe

    @cached_property
    def corners(self) -> FloatArray:
        """Those of the left image (N, 2), pixels of the full image."""
        return self.probe.corners(self.left)


class _Wider:
    """Counts matches in all pairings of up to some frames."""

    def __init__(self, reach: int) -> None:
        self._reach = reach
        self._points = 0
        self._matched = dict.fromkeys(range(-reach, reach + 1), 0)
        self._near: dict[int, IntArray] = {}  # (K,) on rows a little above and below

    def delay(self, now: _Halves, before: Sequence[_Halves], probe: RowProbe) -> int | None:
        """Count the matches of a frame, and return the delay that all tell, unless a difference of
        all rows explains the pairs as they came as well.
        """
        if len(before) < self._reach:
            return None
        pairings = {0: (now, now)}
        for delay in range(1, self._reach + 1):
            earlier = before[-delay]
            pairings[delay] = earlier, now
            pairings[-delay] = now, earlier
        points = min(len(left.corners) for left, _ in pairings.values())
        if points < _PAIRING.min_points:
            return None
        self._points += points
        for delay, (left, right) in pairings.items():
            self._matched[delay] += probe.on_rows(left.left, right.right, left.corners)
        told = told_delay(self._points, self._matched)
        if told is None or told == 0:
            return told
        for delay in (0, told):
            left, right = pairings[delay]
            near = probe.near_rows(left.left, right.right, left.corners)
            self._near[delay] = self._near.get(delay, 0) + near
        if self._near[told].max() > self._near[0].max():
            return told
        return None


class PairingCheck(ImageCheck):
    """Finds in the first frames that right images are some frames late or early."""

    def __init__(self, probe: RowProbe) -> None:
        super().__init__()
        self._probe = probe
        self._last: _Halves | None = None  # the last frame that was counted
        self._recent = deque[_Halves](maxlen=_PAIRING.far_frames)  # the frames before this one
        self._told: list[int | None] = []  # by the counts so far, after each frame
        # of all frames: corners, and those that match in each pairing
        self._points = 0
        self._matched = {0: 0, 1: 0, -1: 0}
        # likewise of the frames in which the pairs are not the best ones
        self._wider = tuple(_Wider(n) for n in (_PAIRING.near_frames, _PAIRING.far_frames))
        self._held = deque[Image]()  # right images that belong to later left ones
        self._begun_again = False
        self.delay: int | None = None  # None: not decided yet

    def inspect(self, images: FrameImages) -> FrameImages:
        """Return the images in their right pairing, as far as it is known."""
        if self.delay is None:
            self._test(images)
        if self.delay is None or self.delay == 0:
            return images
        if self.delay < 0:
            images = self._with_held(images, -self.delay)
        else:
            images = images.marked(right_delay=self.delay)
        if images.skipped or self._begun_again:
            return images
        self._begun_again = True
        return images.marked(begin_again=True)

    def _test(self, images: FrameImages) -> None:
        if not (images.left_usable and images.right_usable):
            self._last = None
            self._recent.clear()
            return
        left, right = images.halves
        now = _Halves(left.copy(), right.copy(), self._probe)
        last = self._last
        moved = last is None or has_moved(left, last.left)
        if moved:
            self._last = now
        if moved and last is not None:
            self._count(images.index, now, last)
        if self.delay is None:
            self._recent.append(now)

    def _count(self, index: int, now: _Halves, last: _Halves) -> None:
        """Count the matches of a frame, and decide once those of enough frames tell."""
        given = self._on_rows(now, now)
        if self._looks_exchanged(now, given):
            self._last = None
            self._recent.clear()
            return
        points = min(len(now.corners), len(last.corners))
        if points >= _PAIRING.min_points:
            self._points += points
            self._matched[0] += given
            self._add({1: (last, now), -1: (now, last)}, self._matched)
        told = told_delay(self._points, self._matched)
        self._told.append(told if told == 0 else self._far_delay(now))
        recent = self._told[-_PAIRING.alike_frames :]
        if (
            len(self._told) >= _PAIRING.counted_frames
            and recent[0] is not None
            and len(set(recent)) == 1
        ):
            self._decide(index, recent[0])
        elif len(self._told) >= _PAIRING.max_tests:
            self._decide(index, 0)

    def _add(
        self, pairings: Mapping[int, tuple[_Halves, _Halves]], matched: dict[int, int]
    ) -> None:
        """Add how many corners of the left image of each pairing match in its right one."""
        for delay, (left, right) in pairings.items():
            matched[delay] += self._on_rows(left, right)

    def _on_rows(self, left: _Halves, right: _Halves) -> int:
        """Count the corners of one frame's left image that match in another one's right image."""
        return self._probe.on_rows(left.left, right.right, left.corners)

    def _looks_exchanged(self, now: _Halves, given: int) -> bool:
        """Whether the images of a frame match if left and right are exchanged, beside the number
        that match as given: the rows of an exchanged pair agree, those of images of two times do
        not.
        """
        corners = self._probe.corners(now.right)
        matched = self._probe.on_rows(now.right, now.left, corners)
        few = max(_PAIRING.min_share * len(corners), _PAIRING.clear_factor * given)
        return len(corners) >= _PAIRING.min_points and matched >= few

    def _far_delay(self, now: _Halves) -> int | None:
        """Return the delay that the frames before tell, the nearest of them first."""
        for counts in self._wider:
            if (told := counts.delay(now, self._recent, self._probe)) is not None:
                return told
        return None

    def _decide(self, index: int, delay: int) -> None:
        self.delay = delay
        self._last = None
        self._recent.clear()
        if delay == 0:
            return
        message = (
            f"frame {index}: each right image belongs to the left image of "
            f"{_frames_away(delay)} it, by the rows that match; the poses so far are wrong; pair "
            "the images by their times of exposure"
        )
        figures = {"delay_frames": float(delay)}
        self._found.append(Finding("pairs-shifted", message, index, 0, figures=figures))

    def _with_held(self, images: FrameImages, frames: int) -> FrameImages:
        """Return the left image with the right one that came some frames before."""
        self._held.append(images.raw[1].copy())
        if len(self._held) <= frames:
            return images.marked(skipped=True)
        return images.with_raw((images.raw[0], self._held.popleft()))


def _frames_away(delay: int) -> str:
    which = "before" if delay > 0 else "after"
    if abs(delay) == 1:
        return f"the frame {which}"
    return f"{abs(delay)} frames {which}"


def find_delay(frames: Iterable[StereoFrame], camera: StereoCamera) -> int | None:
    """Return by how many frames right images are late, by the first frames of a recording.

    Negative: they are early. None: the frames do not tell, as the rig does not move.
    """
    check = PairingCheck(RowProbe())
    if camera.kind != "stereo":
        return None
    for frame in frames:
        images = images_of(frame, pair=True)
        if images is not None:
            check.inspect(images)
        if check.delay is not None:
            return check.delay
    return None
