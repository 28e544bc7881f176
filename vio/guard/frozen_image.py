"""A camera of the pair that is frozen, dark or covered, by the images themselves.

An image that stays the same, up to noise, while the other camera's changes is frozen. A left one
has changed just before, too: at a standstill it stays the same, and what covers the right one
changes that. One that is that of some frames ago, to the last bit, comes from a ring of buffers
that was read at the wrong place.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from vio.dataclass import dataclass
from vio.findings import begun, ended
from vio.frontend.patches import mean_and_contrast
from vio.guard.exposure import EarlierExposures, exposure_digest
from vio.guard.image_change import image_change
from vio.guard.image_check import FrameImages, ImageCheck
from vio.numerics.kinds import Capacity
from vio.records import Image

Cause: TypeAlias = Literal["right-image-frozen", "right-image-dark"]


@dataclass(frozen=True, slots=True)
class _FrozenRules:
    """When an image counts as frozen, or as dark."""

    stride: Capacity[int] = 4  # of the half-resolution images' pixels that are compared
    # change of a frozen camera's image over that of the other's, at most: sensor noise is left
    frozen_share: float = 0.3
    # change of a frozen camera's image by noise of the sensor or an encoder, gray levels at the
    # common contrast
    max_noise: float = 3.0
    # the same of the other camera's image: where it changes by less, nothing can be concluded
    min_change: float = 1.0
    # how fast the usual ratio of the two changes is learned, which depends on gains and scene
    ratio_gain: float = 0.1
    frames: int = 3  # in a row before it is reported
    dark_share: float = 0.1  # contrast of a dark or covered image over that of the other one


_FROZEN = _FrozenRules()

_SEEN: dict[Cause, str] = {
    "right-image-frozen": "the right camera is frozen: it gives earlier images again while the left "
    "one changes",
    "right-image-dark": "the right camera is dark or covered: its image has no contrast while the "
    "left one has",
}


@dataclass(frozen=True, slots=True)
class _SparseImages:
    """Both images of a frame, sparsely sampled."""

    index: int
    left: Image
    right: Image


class FrozenCamera(ImageCheck):
    """Marks frames in which one camera of the pair gives nothing new."""

    def __init__(self) -> None:
        super().__init__()
        self._last: _SparseImages | None = None  # the last frame in which no image was frozen
        # of each camera, in such frames
        self._earlier = EarlierExposures(), EarlierExposures()
        self._ratio = 1.0  # usual change of the right image over that of the left one
        # change of the left image in the last frame in which no image was frozen
        self._moved_left = 0.0
        self._cause: Cause | None = None  # why the right image is not used
        self._since = 0  # frame before the first such frame
        self._count = 0  # such frames in a row
        self._reported: Cause = "right-image-frozen"  # the cause that was reported last
        self._left_frozen = 0  # frames in a row

    def inspect(self, images: FrameImages) -> FrameImages:
        """Mark frames with a frozen left image, or with a frozen or dark right one."""
        left, right = images.halves
        if self.left_is_frozen(images.index, left, right):
            return images.marked(left_usable=False)
        return images if self._cause is None else images.marked(right_usable=False)

    @property
    def right_usable(self) -> bool:
        """Whether the right image of the last frame is neither frozen nor dark."""
        return self._cause is None

    def left_is_frozen(self, index: int, left: Image, right: Image) -> bool:
        """Compare the images (H/2, W/2) of a frame with those before; return whether the left one
        is frozen.

        A frozen or dark right image is noted: `right_usable` is False then.
        """
        now = _SparseImages(
            index,
            left[:: _FROZEN.stride, :: _FROZEN.stride].copy(),
            right[:: _FROZEN.stride, :: _FROZEN.stride].copy(),
        )
        last = self._last
        digests = exposure_digest([now.left]), exposure_digest([now.right])
        if last is None:
            self._keep(now, digests)
            return False
        left_again, right_again = (
            earlier.find(digest) is not None
            for earlier, digest in zip(self._earlier, digests, strict=True)
        )
        equal = np.array_equal(now.left, last.left) and not np.array_equal(now.right, last.right)
        if equal or (left_again and not right_again):
            self._count_left(last.index, index)
            return True
        is_dark = (
            mean_and_contrast(now.right, 1)[1]
            < _FROZEN.dark_share * mean_and_contrast(now.left, 1)[1]
        )
        change_left = image_change(now.left, last.left)
        change_right = image_change(now.right, last.right)
        has_stopped = change_left < _FROZEN.frozen_share * self._moved_left
        if not is_dark and has_stopped and _is_frozen(change_left * self._ratio, change_right):
            self._count_left(last.index, index)
            return True
        self._end_left(index)
        if is_dark:
            self._distrust("right-image-dark", last.index, index)
            return False
        again = right_again and not left_again
        if again or _is_frozen(change_right / self._ratio, change_left):
            self._distrust("right-image-frozen", last.index, index)
            return False
        if self._cause is not None:
            self._end_right(index)
        elif change_left > _FROZEN.min_change:
            self._ratio += _FROZEN.ratio_gain * (change_right / change_left - self._ratio)
        self._moved_left = change_left
        self._keep(now, digests)
        return False

    def _keep(self, now: _SparseImages, digests: tuple[bytes, bytes]) -> None:
        """Remember a frame in which no image is frozen, with the digests of its images."""
        self._last = now
        for earlier, digest in zip(self._earlier, digests, strict=True):
            earlier.add(now.index, digest)

    def _distrust(self, cause: Cause, since: int, index: int) -> None:
        """Count a frame whose right image is not used; one cause that lasts is reported once."""
        if self._cause is None:
            self._since = since
            self._count = 0
        self._cause = cause
        self._count += 1
        if self._count == _FROZEN.frames:
            self._reported = cause
            text = f"{_SEEN[cause]}, since frame {self._since}; going on with the left images"
            self._found.append(begun(cause, index, text, self._since + 1))

    def _end_right(self, index: int) -> None:
        assert self._cause is not None
        if self._count >= _FROZEN.frames:
            self._found.append(
                ended(self._reported, index, "the right camera gives new images again")
            )
        self._cause = None

    def _count_left(self, since: int, index: int) -> None:
        """Count frames with a frozen left image, and report it once."""
        self._left_frozen += 1
        if self._left_frozen == _FROZEN.frames:
            text = (
                "the left camera is frozen: it gives earlier images again since frame "
                f"{since} while the right one changes; the right images alone follow what the last "
                "pair has seen"
            )
            self._found.append(begun("left-image-frozen", index, text, since + 1))

    def _end_left(self, index: int) -> None:
        if self._left_frozen >= _FROZEN.frames:
            self._found.append(
                ended("left-image-frozen", index, "the left camera gives new images again")
            )
        self._left_frozen = 0


def _is_frozen(change: float, other_change: float) -> bool:
    """Whether one image is the same as before while the other is not: to the bit, or up to
    noise.
    """
    if change == 0.0:
        return other_change > 0.0
    return change < _FROZEN.max_noise and other_change > max(
        _FROZEN.min_change, change / _FROZEN.frozen_share
    )
