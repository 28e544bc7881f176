"""Small image patches around many points at once, without a loop over the points."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from vio.records import BoolArray, Image, IntArray

FloatImage: TypeAlias = npt.NDArray[np.float32]  # (H, W) gray levels
Patches: TypeAlias = npt.NDArray[np.float32]  # (N, h, w) gray levels


def inside(image: Image | FloatImage, points: npt.NDArray[np.float64], margin: float) -> BoolArray:
    """Mask (N,) of finite points (N, 2) at least `margin` pixels away from the image's outermost pixel centres."""
    height, width = image.shape
    u, v = points[:, 0], points[:, 1]
    return (u >= margin) & (u <= width - 1 - margin) & (v >= margin) & (v <= height - 1 - margin)


def integer_patches(image: Image, top_left: IntArray, height: int, width: int) -> Patches:
    """Patches (N, height, width) whose first pixel is `top_left` (N, 2) `[u v]`; all must lie inside the image."""
    windows = sliding_window_view(image, (height, width))
    return windows[top_left[:, 1], top_left[:, 0]].astype(np.float32)
