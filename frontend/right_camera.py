"""Whether the right image belongs to the left one: a frozen, covered or displaced right camera is
not used.

Two tests are made. *Images*: a right image that stays the same while the left one changes is
frozen; so is a left image that stays the same while the right one changes. *Matches*: points of
known depth, moved by the motion that the left image shows, must appear in the right image where
their depth says, but for an offset that all have in common (`frontend.stereo_fit`). Where most do
not, right and left contradict each other, and the frame is used with its left image alone until
they agree again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from vio.frontend.columns import share_of
from vio.frontend.image_check import FrameImages, ImageCheck
from vio.frontend.patches import mean_and_contrast, statistics
from vio.numerics.compiled import compiled, compiled_sums
from vio.records import BoolArray, Image

Cause: TypeAlias = Literal["frozen", "dark", "contradicts"]

_STRIDE = 4  # of the half-resolution images' pixels that are compared
# change of a frozen camera's image over that of the other's, at most: sensor noise is left
_FROZEN_SHARE = 0.3
# gray levels that both images are scaled to, so that neither exposure nor gain counts as a change
_CONTRAST = 50.0
# change of a frozen camera's image by noise of the sensor or an encoder, gray levels of these
_MOST_NOISE = 3.0
# the same of the other camera's image: where it changes by less, nothing can be concluded
_LEAST_CHANGE = 1.0
_CLIPPED = 250  # gray level from which a pixel of a resampled image may contain clipped ones
_LEAST_UNCLIPPED = 0.1  # share of the pixels
# how fast the usual ratio of the two changes is learned, which depends on gains and scene
_RATIO_GAIN = 0.1
_LEAST_POINTS = 20  # with fewer points of known depth, matches say nothing
# but so few suffice to agree, as hardly any wrong one is found where it should be
_LEAST_AGREEING = 6
# share of confirmed points below which the images contradict each other; usual is 0.8 to 1
_CONTRADICTS = 0.3
_AGREES = 0.6  # share above which they agree again
_FRAMES = 3  # in a row before it is said, or before images that agree are used again
_BLIND_FRAMES = 40  # after as many without points to test by, the right image is tried again
_DARK_SHARE = 0.1  # contrast of a dark or covered image over that of the other one

_BY_IMAGE: tuple[Cause, ...] = ("frozen", "dark")  # causes that the image itself shows

_SAID: dict[Cause, str] = {
    "frozen": "the right camera is frozen: its image does not change while the left one does",
    "dark": "the right camera is dark or covered: its image has no contrast while the left one has",
    "contradicts": "the right image contradicts the left one, as most points of known depth do not "
    "appear in it where "
    "they should; the right camera has been turned or covered, or has lost its synchronisation",
}


@dataclass(frozen=True, slots=True)
class _SparseImages:
    """Both images of a frame, sparsely sampled."""

    index: int
    left: Image
    right: Image


class RightCamera(ImageCheck):
    """Decides frame by frame whether the right image may be used."""

    def __init__(self) -> None:
        super().__init__()
        self._last: _SparseImages | None = None  # the last frame in which no image was frozen
        self._ratio = 1.0  # usual change of the right image over that of the left one
        self._cause: Cause | None = None  # why the right image is not used
        self._since = 0  # frame before the first such frame
        self._count = self._agreeing = self._untested = 0  # frames in a row
        self._left_frozen = 0  # frames in a row
        self._said = False

    @property
    def contradicts(self) -> bool:
        """Whether the right image is not used because its matches contradict the left one, for
        no known cause.
        """
        return self._cause == "contradicts"

    @property
    def usable(self) -> bool:
        """Whether the right image of the last frame was used."""
        return self._cause is None

    def explained(self) -> None:
        """Trust the right image again at once: another cause was found and taken out.

        What is not yet logged is not.
        """
        self._lines = []
        self._reset()

    def _reset(self) -> None:
        self._cause = None
        self._said = False
        self._count = self._agreeing = self._untested = 0

    def inspect(self, images: FrameImages) -> FrameImages | None:
        """Return None for a frozen left image, and mark frames whose right image is frozen or
        dark.
        """
        left, right = images.views
        if self.left_is_frozen(images.frame.index, left.half, right.half):
            return None
        lives = self._cause not in _BY_IMAGE
        return (
            images if lives == images.right_lives else replace(images, right_lives=lives)
        )  # a copy halves images anew

    def left_is_frozen(self, index: int, left: Image, right: Image) -> bool:
        """Compare the images (H/2, W/2) of a frame with those before; return whether the left one
        is frozen.

        A frozen or dark right image is noted: `usable` is False then.
        """
        now = _SparseImages(
            index, left[::_STRIDE, ::_STRIDE].copy(), right[::_STRIDE, ::_STRIDE].copy()
        )
        last = self._last
        if last is None:
            self._last = now
            return False
        if np.array_equal(now.left, last.left) and not np.array_equal(now.right, last.right):
            self._count_left(last.index, index)
            return True
        self._left_frozen = 0
        if mean_and_contrast(now.right, 1)[1] < _DARK_SHARE * mean_and_contrast(now.left, 1)[1]:
            self._distrust("dark", last.index, index)
            return False
        change_left = image_change(now.left, last.left)
        change_right = image_change(now.right, last.right)
        if _is_frozen(change_right / self._ratio, change_left):
            self._distrust("frozen", last.index, index)
            return False
        if self._cause is None and change_left > _LEAST_CHANGE:
            self._ratio += _RATIO_GAIN * (change_right / change_left - self._ratio)
        if self._cause in _BY_IMAGE:
            # its image is another one again; whether it fits is for the matches to say
            self._cause = "contradicts"
        self._last = now
        return False

    def doubts(self, matched: BoolArray) -> bool:
        """Whether so few of the points (K,) of known depth are where they should be that a cause
        is looked for.
        """
        return (
            self._cause not in _BY_IMAGE
            and len(matched) >= _LEAST_POINTS
            and share_of(matched) < _AGREES
        )

    def check_matches(self, index: int, matched: BoolArray, *, moved: bool) -> bool:
        """Judge the matches of a frame near their known depths, and return whether the right image
        may be used.

        Args:
            index: frame number.
            matched: which of the points (K,) of known depth were found in the right image where
                they should be.
            moved: whether the points were moved by a motion that the left image confirms.
        """
        if self._cause in _BY_IMAGE:
            return False
        tested = moved and len(matched) >= _LEAST_POINTS
        share = share_of(matched) if len(matched) else 0.0
        if self._cause is None:
            if tested and share < _CONTRADICTS:
                self._distrust("contradicts", index - 1, index)
            return self._cause is None
        agrees = moved and len(matched) >= _LEAST_AGREEING and share >= _AGREES
        self._untested = 0 if tested or agrees else self._untested + 1
        self._agreeing = self._agreeing + 1 if agrees else 0
        self._count += not agrees
        if self._agreeing >= _FRAMES or self._untested >= _BLIND_FRAMES:
            self._trust(index)
        elif self._count >= _FRAMES:
            self._say(index)
        return self._cause is None

    def try_again(self, index: int) -> None:
        """Use right images again that contradicted depths of which none is left, where no sensor
        measures the scale.

        Depths from the left images since then have an arbitrary scale, and would be contradicted
        for ever.
        """
        if self._cause == "contradicts":
            if self._said:
                self._lines.append(
                    f"frame {index}: no feature is left that contradicts the right images; they "
                    "are used again"
                )
            self._reset()

    def _distrust(self, cause: Cause, since: int, index: int) -> None:
        """Note a cause; one that lasts is reported once."""
        if self._cause is None:
            self._since = since
            self._count = 0
            self._untested = 0
        self._cause = cause
        self._agreeing = 0
        if cause != "contradicts":
            self._count += 1
            if self._count >= _FRAMES:
                self._say(index)

    def _say(self, index: int) -> None:
        assert self._cause is not None
        if not self._said:
            self._said = True
            self._lines.append(
                f"frame {index}: {_SAID[self._cause]}, since frame {self._since}; going on with "
                "the left images"
            )

    def _trust(self, index: int) -> None:
        if self._said:
            self._lines.append(
                f"frame {index}: the right images agree with the left ones again, and are used"
            )
        self._reset()

    def _count_left(self, since: int, index: int) -> None:
        """Count frames with a frozen left image, and report it once."""
        self._left_frozen += 1
        if self._left_frozen == _FRAMES:
            self._lines.append(
                f"frame {index}: the left camera is frozen: its image does not change since frame "
                f"{since} while the "
                "right one does; the right images alone follow what the last pair has seen"
            )


def image_change(image: Image, other: Image) -> float:
    """Mean absolute difference of two images, in gray levels at a common mean and contrast; 0:
    equal to the bit.

    Pixels at the end of the scale are left out, as far as others are left: an exposure that changes
    clips others.
    """
    return float(_CONTRAST * _change(image, other))


@compiled
def _change(image: Image, other: Image) -> float:
    """Return `image_change` over the contrast that images are scaled to."""
    kept = np.empty((2, image.size), dtype=np.uint8)
    count = _keep_unclipped(image, other, kept)
    if count < image.size and count / image.size > _LEAST_UNCLIPPED:
        return _difference(kept[:1, :count], kept[1:, :count])
    return _difference(image, other)


@compiled
def _keep_unclipped(image: Image, other: Image, kept: Image) -> int:
    """Write the pixels that are clipped in neither image one after another, and return their
    number.
    """
    height, width = image.shape
    count = 0
    for y in range(height):
        for x in range(width):
            kept[0, count] = image[y, x]
            kept[1, count] = other[y, x]
            count += (image[y, x] < _CLIPPED) & (other[y, x] < _CLIPPED)
    return count


@compiled_sums
def _difference(image: Image, other: Image) -> float:
    """Mean absolute difference of two images, each less its mean and over its contrast; 0: equal
    to the bit.
    """
    height, width = image.shape
    all_pixels = int(np.int64(1))  # no literal: see `vio.numerics.compiled`
    (mean, contrast) = statistics(image, all_pixels)
    (other_mean, other_contrast) = statistics(other, all_pixels)
    scale = max(contrast, 1.0)
    other_scale = max(other_contrast, 1.0)
    total = 0.0
    unlike = 0
    for y in range(height):
        for x in range(width):
            unlike += image[y, x] != other[y, x]
            total += abs((image[y, x] - mean) / scale - (other[y, x] - other_mean) / other_scale)
    return total / (height * width) if unlike else 0.0


def _is_frozen(change: float, other_change: float) -> bool:
    """Whether one image is the same as before while the other is not: to the bit, or up to
    noise.
    """
    if change == 0.0:
        return other_change > 0.0
    return change < _MOST_NOISE and other_change > max(_LEAST_CHANGE, change / _FROZEN_SHARE)
