"""Images in the forms that tracking needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from vio.records import BoolArray, Image

FloatImage: TypeAlias = npt.NDArray[np.float32]  # (H, W) gray levels
Patches: TypeAlias = npt.NDArray[np.float32]  # (N, h, w) gray levels


@dataclass(frozen=True, slots=True)
class View:
    """One image in the forms that tracking needs."""

    full: FloatImage  # (H, W) gray levels
    half: Image  # (H/2, W/2) by `half_image`


def half_image(image: Image) -> Image:
    """The image at half resolution; pixel (u, v) of the full image is at (u/2, v/2) there."""
    return np.asarray(cv2.pyrDown(image), dtype=np.uint8)


def inside(image: Image | FloatImage, points: npt.NDArray[np.float64], margin: float) -> BoolArray:
    """Mask (N,) of finite points (N, 2) at least `margin` pixels away from the image's outermost pixel centres."""
    height, width = image.shape
    u, v = points[:, 0], points[:, 1]
    return (u >= margin) & (u <= width - 1 - margin) & (v >= margin) & (v <= height - 1 - margin)
