"""Torn images: some of their rows are those of the frame before, as where a buffer is read while the
next image is written to it.

Such rows are equal to the last bit, which noise prevents in two exposures. What always is, such as
a border, or a part of a rendered scene that does not move, was so in the frame before as well.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.findings import Finding
from vio.guard.image_check import FrameImages, ImageCheck
from vio.numerics.kinds import Capacity
from vio.records import BoolArray, Image


class _TornRules(NamedTuple):
    """When an image is torn."""

    stride_px: Capacity[int] = 8  # every eighth column of an image is compared …
    first_columns: Capacity[int] = 8  # … so many of them before the others
    # share of the rows with texture that are equal, and were not before
    min_share: float = 0.1
    min_contrast: float = 8.0  # gray levels, standard deviation of a row with texture
    clear_frames: int = 20  # without one, before the next is another event


_TORN = _TornRules()


class TornImages(ImageCheck):
    """Leaves out frames whose left image is torn, and right images that are."""

    def __init__(self) -> None:
        super().__init__()
        self._last: tuple[Image, ...] = ()  # every some column of the images of the frame before
        self._equal: tuple[BoolArray, ...] = ()  # (H,) its rows equal to those before it
        self._clear = _TORN.clear_frames  # frames in a row

    def inspect(self, images: FrameImages) -> FrameImages:
        """Leave out a frame, or mark its right image, where one is torn."""
        sparse = tuple(image[:, :: _TORN.stride_px].copy() for image in images.raw)
        last = self._last
        before = self._equal
        self._last = sparse
        if [image.shape for image in last] != [image.shape for image in sparse]:
            self._equal = tuple(np.ones(len(image), dtype=np.bool_) for image in sparse)
            return images
        self._equal = tuple(_equal_rows(a, b) for a, b in zip(sparse, last, strict=True))
        shares = [
            _torn_share(image, equal, was)
            for image, equal, was in zip(sparse, self._equal, before, strict=True)
        ]
        self._clear += 1
        if not any(shares):
            return images
        self._report(images.index, shares)
        if shares[0]:
            return images.marked(skipped=True)
        return images.marked(right_usable=False)

    def _report(self, index: int, shares: list[float]) -> None:
        """Report a torn frame, once per event, by the shares of its images' rows."""
        clear = self._clear
        self._clear = 0
        if clear < _TORN.clear_frames:
            return
        side = "left" if shares[0] else "right"
        message = (
            f"frame {index}: the image is torn: {100 * max(shares):.0f} % of the rows of the "
            f"{side} one are those of the frame before; torn images are left out"
        )
        self._found.append(Finding("frames-repeated", message, index))


def _equal_rows(image: Image, other: Image) -> BoolArray:
    """Which rows (H,) of two images (H, W') are the same; in most frames none has the same first
    pixels.
    """
    first = _TORN.first_columns
    begin_alike: BoolArray = (image[:, :first] == other[:, :first]).all(axis=1)
    if not begin_alike.any():
        return begin_alike
    equal: BoolArray = (image == other).all(axis=1)
    return equal


def _torn_share(image: Image, equal: BoolArray, was_equal: BoolArray) -> float:
    """Share of the rows with texture that are equal to those of the frame before, and were not
    before; 0: the image is not torn.

    Args:
        image: (H, W').
        equal: (H,) rows equal to those of the frame before.
        was_equal: (H,) those that were so in the frame before.
    """
    new = equal & ~was_equal
    if equal.all() or not (new[0] or new[-1]):
        return 0.0
    textured = image.std(axis=1) >= _TORN.min_contrast
    count = int(textured.sum())
    share = int((new & textured).sum()) / count if count else 0.0
    unequal = int((~equal & textured).sum()) / count if count else 0.0
    return share if min(share, unequal) >= _TORN.min_share else 0.0
