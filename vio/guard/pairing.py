"""Left images that were paired with the right images of another frame from the start.

Rows of a true pair agree. While the rig moves, those of a left image and the right one of the frame
before or after agree less, by another amount in each frame: a right camera that is pitched has rows that
are off by the same in all of them. In the first frames, corners of both left images are searched
along the rows of this right image and of the one before; the pairing in which clearly more of them
match is the right one, unless one difference of all rows explains the pairs as they came as well.

A right image that belongs to the *next* left one (it came early) is held back for it. One that
belongs to the left image *before* (it is late) is marked, as its left image is gone already.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

from vio.findings import Finding
from vio.frontend.right_delay import PairingCounts
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.image_change import image_change
from vio.guard.image_check import FrameImages, ImageCheck, images_of
from vio.guard.probe import RowProbe
from vio.records import Image, IntArray, StereoFrame

# left and right image at half resolution, and the left corners (N, 2)
_Pairing: TypeAlias = tuple[Image, Image, FloatArray]


@dataclass(frozen=True, slots=True)
class _PairingRules:
    """When the first frames tell which images belong together."""

    frames: int = 3  # that must have been counted
    alike: int = 2  # frames in a row after which the counts so far tell the same
    max_tests: int = 40  # frames in which the rig moves, after which the pairing counts as right
    min_points: int = 30  # corners in a frame
    # of the left image since the last frame, gray levels at the common contrast
    min_change: float = 2.0
    stride: int = 4  # of the pixels that are compared
    min_share: float = 0.4  # of the corners that match in the best pairing
    clearly: float = 1.3  # times as many as in both others


_RULES = _PairingRules()


def told_delay(counts: PairingCounts) -> int | None:
    """Return the frames by which a right image is late; None: this frame does not tell."""
    by_delay = {0: counts.same, 1: counts.late, -1: counts.early}
    best = max(by_delay, key=lambda delay: by_delay[delay])
    others = max(count for delay, count in by_delay.items() if delay != best)
    clear = by_delay[best] >= max(_RULES.min_share * counts.points, _RULES.clearly * others)
    return best if clear and counts.points >= _RULES.min_points else None


class PairingCheck(ImageCheck):
    """Finds in the first frames that right images are a frame late or early."""

    def __init__(self, probe: RowProbe) -> None:
        super().__init__()
        self._probe = probe
        self._last: tuple[Image, Image, FloatArray] | None = None  # halves, and left corners
        self._told: list[int | None] = []  # by the counts so far, after each frame
        # of all frames: corners, and those that match in each pairing
        self._points = 0
        self._matched = {0: 0, 1: 0, -1: 0}
        self._near: dict[int, IntArray] = {}  # likewise (K,) on rows a little above and below
        self._held: Image | None = None  # right image that belongs to the next left one
        self._begun_again = False
        self.delay: int | None = None  # None: not decided yet

    def inspect(self, images: FrameImages) -> FrameImages:
        """Return the images in their right pairing, as far as it is known."""
        if self.delay is None:
            self._test(images)
        if self.delay is None or self.delay == 0:
            return images
        if self.delay == -1:
            images = self._with_held(images)
        else:
            images = images.marked(right_delay=1)
        if images.skipped or self._begun_again:
            return images
        self._begun_again = True
        return images.marked(begin_again=True)

    def _test(self, images: FrameImages) -> None:
        if not (images.left_usable and images.right_usable):
            self._last = None
            return
        left, right = images.halves
        last = self._last
        if last is not None:
            change = image_change(
                left[:: _RULES.stride, :: _RULES.stride],
                last[0][:: _RULES.stride, :: _RULES.stride],
            )
            if change < _RULES.min_change:
                return
        points = self._probe.corners(left)
        self._last = left.copy(), right.copy(), points
        if last is None:
            return
        self._count(
            images.index,
            min(len(points), len(last[2])),
            {0: (left, right, points), 1: (last[0], right, last[2]), -1: (left, last[1], points)},
        )

    def _count(self, index: int, points: int, pairings: dict[int, _Pairing]) -> None:
        """Count the matches of a frame, and decide once those of enough frames tell."""
        if points >= _RULES.min_points:
            self._points += points
            for delay, pairing in pairings.items():
                self._matched[delay] += self._probe.on_rows(*pairing)
        self._told.append(self._tells(pairings))
        recent = self._told[-_RULES.alike :]
        if len(self._told) >= _RULES.frames and recent[0] is not None and len(set(recent)) == 1:
            self._decide(index, recent[0])
        elif len(self._told) >= _RULES.max_tests:
            self._decide(index, 0)

    def _tells(self, pairings: dict[int, _Pairing]) -> int | None:
        """Return the delay that the frames so far tell, unless a difference of all rows explains
        the pairs as they came as well.
        """
        matched = self._matched
        told = told_delay(PairingCounts(self._points, matched[0], matched[1], matched[-1]))
        if told is None or told == 0:
            return told
        for delay in (0, told):
            near = self._probe.near_rows(*pairings[delay])
            self._near[delay] = self._near.get(delay, 0) + near
        return told if self._near[told].max() > self._near[0].max() else None

    def _decide(self, index: int, delay: int) -> None:
        self.delay = delay
        self._last = None
        if delay == 0:
            return
        which = "before" if delay == 1 else "after"
        message = (
            f"frame {index}: each right image belongs to the left image of the frame {which} it, "
            "by the rows that match; the poses so far are wrong; pair the images by their times of "
            "exposure"
        )
        figures = {"delay_frames": float(delay)}
        self._found.append(Finding("pairs-shifted", message, index, 0, figures=figures))

    def _with_held(self, images: FrameImages) -> FrameImages:
        """Return the left image with the right one that came with the frame before."""
        held = self._held
        self._held = images.raw[1].copy()
        if held is None:
            return images.marked(skipped=True)
        return images.with_raw((images.raw[0], held))


def find_delay(frames: Iterable[StereoFrame], camera: StereoCamera) -> int | None:
    """Return by how many frames right images are late, by the first frames of a recording.

    -1: they are a frame early. None: the frames do not tell, as the rig does not move.
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
