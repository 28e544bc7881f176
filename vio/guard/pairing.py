"""Left images that were paired with the right images of another frame from the start.

Rows of a true pair agree. While the rig moves, those of a left image and the right one of the frame
before or after agree less. In the first frames, corners of both left images are searched along the
rows of this right image and of the one before; the pairing in which clearly more of them match in
several frames is the right one.

A right image that belongs to the *next* left one (it came early) is held back for it. One that
belongs to the left image *before* (it is late) is marked, as its left image is gone already.
"""

from __future__ import annotations

from collections.abc import Iterable

from vio.findings import Finding
from vio.frontend.right_delay import PairingCounts
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.image_change import image_change
from vio.guard.image_check import FrameImages, ImageCheck, images_of
from vio.guard.probe import RowProbe
from vio.records import Image, StereoFrame

_FRAMES = 3  # that must tell, all alike
_MAX_TESTS = 40  # frames in which the rig moves, after which the pairing counts as right
_MIN_POINTS = 30  # corners in a frame
_MIN_CHANGE = 2.0  # of the left image since the last frame, gray levels at the common contrast
_STRIDE = 4  # of the pixels that are compared
_MIN_SHARE = 0.4  # of the corners that match in the best pairing
_CLEARLY = 1.3  # times as many as in both others


def told_delay(counts: PairingCounts) -> int | None:
    """Return the frames by which a right image is late; None: this frame does not tell."""
    by_delay = {0: counts.same, 1: counts.late, -1: counts.early}
    best = max(by_delay, key=lambda delay: by_delay[delay])
    others = max(count for delay, count in by_delay.items() if delay != best)
    clear = by_delay[best] >= max(_MIN_SHARE * counts.points, _CLEARLY * others)
    return best if clear and counts.points >= _MIN_POINTS else None


class PairingCheck(ImageCheck):
    """Finds in the first frames that right images are a frame late or early."""

    def __init__(self, probe: RowProbe) -> None:
        super().__init__()
        self._probe = probe
        self._last: tuple[Image, Image, FloatArray] | None = None  # halves, and left corners
        self._votes: list[int] = []
        self._tests = 0
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
            change = image_change(left[::_STRIDE, ::_STRIDE], last[0][::_STRIDE, ::_STRIDE])
            if change < _MIN_CHANGE:
                return
        points = self._probe.corners(left)
        self._last = left.copy(), right.copy(), points
        if last is None:
            return
        counts = PairingCounts(
            points=min(len(points), len(last[2])),
            same=self._probe.on_rows(left, right, points),
            late=self._probe.on_rows(last[0], right, last[2]),
            early=self._probe.on_rows(left, last[1], points),
        )
        self._count(images.index, counts)

    def _count(self, index: int, counts: PairingCounts) -> None:
        """Count what a frame tells, and decide once enough frames tell the same."""
        self._tests += 1
        told = told_delay(counts)
        if told is not None:
            self._votes.append(told)
        recent = self._votes[-_FRAMES:]
        if len(recent) == _FRAMES and len(set(recent)) == 1:
            self._decide(index, recent[0])
        elif self._tests >= _MAX_TESTS:
            self._decide(index, 0)

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
