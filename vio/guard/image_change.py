"""By how much an image differs from another one, whatever their exposures."""

from __future__ import annotations

import numpy as np

from vio.frontend.patches import statistics
from vio.numerics.compiled import compiled, compiled_sums
from vio.numerics.kinds import Capacity
from vio.records import Image

# gray levels that both images are scaled to, so that neither exposure nor gain counts as a change
_CONTRAST = 50.0
_CLIPPED = 250  # gray level from which a pixel of a resampled image may contain clipped ones
_MIN_UNCLIPPED = 0.1  # share of the pixels
_MIN_MOVED = 2.0  # gray levels at the common contrast, of an image after a motion
_STRIDE: Capacity[int] = 4  # of the pixels of half images that are compared for it


def image_change(image: Image, other: Image) -> float:
    """Mean absolute difference of two images, in gray levels at a common mean and contrast; 0:
    equal to the bit.

    Pixels at the end of the scale are left out, as far as others are left: an exposure that changes
    clips others.
    """
    return float(_CONTRAST * _change(image, other))


def has_moved(half: Image, before: Image) -> bool:
    """Whether the camera has moved between two of its images (H/2, W/2) at half resolution."""
    return image_change(half[::_STRIDE, ::_STRIDE], before[::_STRIDE, ::_STRIDE]) >= _MIN_MOVED


@compiled
def _change(image: Image, other: Image) -> float:
    """Return `image_change` over the contrast that images are scaled to."""
    kept = np.empty((2, image.size), dtype=np.uint8)
    count = _keep_unclipped(image, other, kept)
    if count < image.size and count / image.size > _MIN_UNCLIPPED:
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
