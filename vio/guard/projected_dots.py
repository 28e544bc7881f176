"""Dots of a projector beside the cameras, as depth cameras have for blank walls: taken out.

The dots are seen from about where they come from, so they stay in the image while the scene moves
through it, and pull the estimate towards rest. They are bright and small: what an opening of the
image takes away keeps its place from one image to the next, and neither what a closing fills nor the
coarse image does. An object that moves with the rig, a still rig and the sensor's fixed pattern keep
all of them.
Reference: Serra, Image analysis and mathematical morphology (1982), for opening and closing.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np

from vio.findings import begun
from vio.geometry.lie import FloatArray
from vio.guard.image_check import FrameImages, ImageCheck
from vio.numerics.compiled import compiled_sums
from vio.numerics.kinds import Capacity
from vio.numerics.robust import median
from vio.records import NS_PER_S, Image


class _DotRules(NamedTuple):
    """When there are dots, and how large they may be."""

    # between images that are compared: the scene has moved by more than a dot, which moves along
    # the row as its depth changes
    min_s: float = 0.2
    max_s: float = 1.0
    # Correlation of small bright spots between two images, the median over the blocks, and by how
    # much it exceeds that of small dark spots and of the coarse image. Rendered dots: 0.6 and 0.4;
    # without, also with the fixed pattern of a sensor, at most 0.02 in excess, once 0.11.
    min_correlation: float = 0.25
    min_excess: float = 0.15
    # of the coarse image, below which the scene has moved
    moved_correlation: float = 0.3
    signs: int = 3  # such comparisons among …
    newest: int = 10  # … the newest ones
    coarse_px: Capacity[int] = 4  # of the half image, averaged first
    coarse_sigma_px: float = 3.0  # of the half image, with that average
    rows: Capacity[int] = 6  # of blocks
    columns: Capacity[int] = 8
    # of the opening: a dot is smaller than 5 px, in images over 1000 px wide than 7
    opening_px: int = 5
    width_px: int = 200  # a pixel more for so many


_DOTS = _DotRules()
_CODE = "projected-dots"
# pixels of the averaged image: an average over n of them has a variance of (n^2 - 1) / 12
_COARSE_SIGMA = (
    math.sqrt(_DOTS.coarse_sigma_px**2 - (_DOTS.coarse_px**2 - 1) / 12) / _DOTS.coarse_px
)
_Parts: TypeAlias = tuple[Image, Image, Image]
_SMALL = np.ones((3, 3), dtype=np.uint8)  # pixels of the half image


class ProjectedDots(ImageCheck):
    """Detects projected dots and takes them out from then on."""

    def __init__(self) -> None:
        super().__init__()
        self._last: tuple[int, _Parts] | None = None  # time and parts of an image
        # comparisons: the frame, and whether it shows dots
        self._signs = deque[tuple[int, bool]](maxlen=_DOTS.newest)
        self._active = False  # there are dots
        self._since = 0  # frame from which on they may have been there

    def inspect(self, images: FrameImages) -> FrameImages:
        """Return the images without dots."""
        if not self._active:
            self._look(images)
        if not self._active:
            return images
        return images.with_raw(tuple(without_dots(image) for image in images.raw))

    def _look(self, images: FrameImages) -> None:
        """Compare the left image with one of a moment before, unless it has fewer pixels than
        blocks.
        """
        height, width = images.halves[0].shape
        if height < _DOTS.rows or width < _DOTS.columns:
            return
        time_ns = images.frame.time_ns
        if self._last is None:
            elapsed_s = np.inf
        else:
            elapsed_s = (time_ns - self._last[0]) / NS_PER_S
        if elapsed_s < _DOTS.min_s:
            return
        last = self._last
        parts = _parts(images.halves[0])
        self._last = time_ns, parts
        if last is None or elapsed_s > _DOTS.max_s or last[1][0].shape != parts[0].shape:
            return
        bright, dark, coarse = (
            median(_correlations(before, now)) for before, now in zip(last[1], parts, strict=True)
        )
        is_sign = bright >= _DOTS.min_correlation and bright - max(dark, coarse) >= _DOTS.min_excess
        if not is_sign and coarse < _DOTS.moved_correlation:
            self._since = images.index
        self._signs.append((images.index, is_sign))
        signs = [index for index, shows in self._signs if shows]
        if len(signs) < _DOTS.signs:
            return
        self._active = True
        text = (
            "small bright spots stay in the images while the scene moves: "
            "the dots of an infrared projector; they are taken out, which costs accuracy; switch "
            "the projector off, or use the images without it"
        )
        figures = {"correlation": bright}
        since = min(self._since, signs[0])
        self._found.append(begun(_CODE, images.index, text, since, figures=figures))


def without_dots(image: Image) -> Image:
    """Return an image (H, W) without small bright spots."""
    size = max(_DOTS.opening_px, 2 * (image.shape[1] // (2 * _DOTS.width_px)) + 1)
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.morphologyEx(image, cv2.MORPH_OPEN, element), dtype=np.uint8)


def _parts(half: Image) -> _Parts:
    """Small bright spots (H, W), small dark ones and the coarse image (H / 4, W / 4) of an image at
    half resolution.
    """
    height, width = half.shape
    size = max(width // _DOTS.coarse_px, _DOTS.columns), max(height // _DOTS.coarse_px, _DOTS.rows)
    averaged = cv2.resize(half, size, interpolation=cv2.INTER_AREA)
    parts = (
        cv2.morphologyEx(half, cv2.MORPH_TOPHAT, _SMALL),
        cv2.morphologyEx(half, cv2.MORPH_BLACKHAT, _SMALL),
        cv2.GaussianBlur(averaged, (0, 0), _COARSE_SIGMA),
    )
    bright, dark, coarse = (np.asarray(part, dtype=np.uint8) for part in parts)
    return bright, dark, coarse


def _correlations(before: Image, now: Image) -> FloatArray:
    """Correlations (B,) of two images (H, W) in each block; 0 where one is uniform.

    Rows and columns beyond whole blocks are left out.
    """
    out: FloatArray = np.empty(_DOTS.rows * _DOTS.columns)
    _correlate(before, now, _DOTS.rows, _DOTS.columns, out)
    return out


@compiled_sums
def _correlate(before: Image, now: Image, rows: int, columns: int, out: FloatArray) -> None:
    height, width = now.shape
    high = height // rows
    wide = width // columns
    count = float(high * wide)
    for block in range(rows * columns):
        v = block // columns * high
        u = block % columns * wide
        a = b = aa = bb = ab = 0.0
        for i in range(v, v + high):
            # whole numbers that single precision holds exactly, over a row of a block
            row_a = row_b = row_aa = row_bb = row_ab = np.float32(0.0)
            of_before = before[i, u : u + wide]
            of_now = now[i, u : u + wide]
            for j in range(wide):
                x = np.float32(of_before[j])
                y = np.float32(of_now[j])
                row_a += x
                row_b += y
                row_aa += x * x
                row_bb += y * y
                row_ab += x * y
            a += float(row_a)
            b += float(row_b)
            aa += float(row_aa)
            bb += float(row_bb)
            ab += float(row_ab)
        spread = (count * aa - a * a) * (count * bb - b * b)
        out[block] = (count * ab - a * b) / np.sqrt(spread) if spread > 0.0 else 0.0
