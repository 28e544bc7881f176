"""Small image patches around many points at once, without a loop over the points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from vio.records import BoolArray, Image, IntArray

Patches = npt.NDArray[np.float32]  # (N, h, w) gray levels


def inside(image: Image, points: npt.NDArray[np.float64], margin: float) -> BoolArray:
    """Mask (N,) of finite points (N, 2) at least `margin` pixels away from the image's outermost pixel centres."""
    height, width = image.shape
    u, v = points[:, 0], points[:, 1]
    return (u >= margin) & (u <= width - 1 - margin) & (v >= margin) & (v <= height - 1 - margin)


def integer_patches(image: Image, top_left: IntArray, height: int, width: int) -> Patches:
    """Patches (N, height, width) whose first pixel is `top_left` (N, 2) `[u v]`; all must lie inside the image."""
    windows = sliding_window_view(image, (height, width))
    return windows[top_left[:, 1], top_left[:, 0]].astype(np.float32)


def bilinear_patches(image: Image, centres: npt.NDArray[np.float64], radius: int) -> Patches:
    """Patches (N, 2r+1, 2r+1) centred at sub-pixel points (N, 2), interpolated linearly.

    Points closer than `radius + 1` pixels to the border are moved inwards: mask them out with `inside`.
    """
    height, width = image.shape
    limit = np.array([width - radius - 2, height - radius - 2])
    base = np.clip(np.floor(centres).astype(np.int64), radius, limit)
    fraction = np.clip(centres - base, 0.0, 1.0).astype(np.float32)
    block = integer_patches(image, base - radius, 2 * radius + 2, 2 * radius + 2)
    a, b = fraction[:, 0, None, None], fraction[:, 1, None, None]
    rows = block[:, :, :-1] + a * (block[:, :, 1:] - block[:, :, :-1])
    return rows[:, :-1] + b * (rows[:, 1:] - rows[:, :-1])


def warped_patches(image: Image, warp: npt.NDArray[np.float64], radius: int) -> Patches:
    """Patches (N, 2r+1, 2r+1) at `warp @ [x, y, 1]` (N, 3, 3) of the offsets x, y in -r..r, interpolated linearly.

    Pixels outside the image repeat its border.
    """
    height, width = image.shape
    offset = np.arange(-radius, radius + 1, dtype=np.float32)
    A = warp[:, :2].astype(np.float32)[..., None, None]
    u = A[:, 0, 0] * offset + (A[:, 0, 1] * offset[:, None] + A[:, 0, 2])
    v = A[:, 1, 0] * offset + (A[:, 1, 1] * offset[:, None] + A[:, 1, 2])
    np.clip(u, 0.0, width - 1.01, out=u)
    np.clip(v, 0.0, height - 1.01, out=v)
    iu, iv = u.astype(np.int32), v.astype(np.int32)
    u -= iu
    v -= iv
    index = iv * np.int32(width) + iu
    flat = image.reshape(-1)
    top, bottom = flat.take(index).astype(np.float32), flat.take(index + np.int32(width)).astype(np.float32)
    top += u * (flat.take(index + np.int32(1)) - top)
    bottom += u * (flat.take(index + np.int32(width + 1)) - bottom)
    bottom -= top
    bottom *= v
    bottom += top
    return bottom
