"""Images in the forms that tracking needs."""

from __future__ import annotations

from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.numerics.compiled import compiled
from vio.records import BoolArray, Image

Patches: TypeAlias = npt.NDArray[np.float32]  # (N, h, w) gray levels


@dataclass(frozen=True, slots=True)
class ImageLevels:
    """One image in the forms that tracking needs."""

    full: Image  # (H, W)
    half: Image  # (H/2, W/2) by `half_image`

    def kept(self) -> ImageLevels:
        """The image with pixels of its own: a reader may reuse its buffer."""
        return ImageLevels(self.full.copy(), self.half)


def half_image(image: Image) -> Image:
    """The image at half resolution; pixel (u, v) of the full image is at (u/2, v/2) there."""
    return np.asarray(cv2.pyrDown(image), dtype=np.uint8)


def inside(image: Image, points: npt.NDArray[np.float64], margin: float) -> BoolArray:
    """Mask (N,) of finite points (N, 2) at least `margin` pixels away from the image's outermost
    pixel centres.
    """
    height, width = image.shape
    u = points[:, 0]
    v = points[:, 1]
    in_columns = (u >= margin) & (u <= width - 1 - margin)
    in_rows = (v >= margin) & (v <= height - 1 - margin)
    return in_columns & in_rows


def mean_and_contrast(image: Image, stride: int) -> tuple[float, float]:
    """Mean and standard deviation of an image's gray levels, from every `stride`-th pixel of
    every `stride`-th row.
    """
    mean, contrast = statistics(image, stride)
    return float(mean), float(contrast)


@compiled
def statistics(image: Image, stride: int) -> tuple[float, float]:
    """Return what `mean_and_contrast` does, to compiled functions."""
    height, width = image.shape
    total = np.int64(0)
    squares = np.int64(0)
    count = 0
    for y in range(0, height, stride):
        for x in range(0, width, stride):
            gray = np.int64(image[y, x])
            total += gray
            squares += gray * gray
            count += 1
    mean = total / count
    return mean, np.sqrt(max(squares / count - mean * mean, 0.0))
