"""Dots of a projector beside the cameras, as depth cameras have for blank walls: taken out.

The dots are seen from about where they come from, so they stay in the image while the scene moves
through it, and pull the estimate towards rest. They are bright and small: what an opening of the
image takes away keeps its place from one image to the next, and neither what a closing fills nor the
coarse image does. An object that moves with the rig, a still rig and the sensor's fixed pattern keep
all of them.
Reference: Serra, Image analysis and mathematical morphology (1982), for opening and closing.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from vio.findings import Finding
from vio.geometry.lie import FloatArray
from vio.guard.image_check import FrameImages, ImageCheck
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
    coarse_sigma_px: float = 3.0  # of the half image
    rows: Capacity[int] = 6  # of blocks
    columns: Capacity[int] = 8
    # of the opening: a dot is smaller than 5 px, in images over 1000 px wide than 7
    opening_px: int = 5
    width_px: int = 200  # a pixel more for so many


_DOTS = _DotRules()
_CODE = "projected-dots"
_SMALL = np.ones((3, 3), dtype=np.uint8)  # pixels of the half image


class ProjectedDots(ImageCheck):
    """Detects projected dots and takes them out from then on."""

    def __init__(self) -> None:
        super().__init__()
        self._last: tuple[int, FloatArray] | None = None  # time and blocks of an image
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
        blocks = _blocks(images.halves[0])
        self._last = time_ns, blocks
        if last is None or elapsed_s > _DOTS.max_s or last[1].shape != blocks.shape:
            return
        correlations = np.einsum("pbi,pbi->pb", last[1], blocks)
        bright, dark, coarse = (median(part) for part in correlations)
        is_sign = bright >= _DOTS.min_correlation and bright - max(dark, coarse) >= _DOTS.min_excess
        if not is_sign and coarse < _DOTS.moved_correlation:
            self._since = images.index
        self._signs.append((images.index, is_sign))
        signs = [index for index, shows in self._signs if shows]
        if len(signs) < _DOTS.signs:
            return
        self._active = True
        message = (
            f"frame {images.index}: small bright spots stay in the images while the scene moves: "
            "the dots of an infrared projector; they are taken out, which costs accuracy; switch "
            "the projector off, or use the images without it"
        )
        figures = {"correlation": bright}
        since = min(self._since, signs[0])
        self._found.append(
            Finding(_CODE, message, images.index, since, lasts=True, figures=figures)
        )


def without_dots(image: Image) -> Image:
    """Return an image (H, W) without small bright spots."""
    size = max(_DOTS.opening_px, 2 * (image.shape[1] // (2 * _DOTS.width_px)) + 1)
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.morphologyEx(image, cv2.MORPH_OPEN, element), dtype=np.uint8)


def _blocks(half: Image) -> FloatArray:
    """Small bright spots, small dark ones and the coarse image (3, B, pixels) in blocks of an image
    at half resolution, each block less its mean and of norm 1.
    """
    height = half.shape[0] // _DOTS.rows
    width = half.shape[1] // _DOTS.columns
    part: npt.NDArray[np.float64] = np.empty((3, _DOTS.rows * height, _DOTS.columns * width))
    seen = half[: part.shape[1], : part.shape[2]]
    part[0] = cv2.morphologyEx(seen, cv2.MORPH_TOPHAT, _SMALL)
    part[1] = cv2.morphologyEx(seen, cv2.MORPH_BLACKHAT, _SMALL)
    part[2] = cv2.GaussianBlur(seen, (0, 0), _DOTS.coarse_sigma_px)
    grid = part.reshape(3, _DOTS.rows, height, _DOTS.columns, width).swapaxes(2, 3)
    blocks = grid.reshape(3, _DOTS.rows * _DOTS.columns, height * width)
    blocks -= blocks.mean(axis=2, keepdims=True)
    norms = np.sqrt(np.einsum("pbi,pbi->pb", blocks, blocks))
    out: FloatArray = blocks / np.maximum(norms, 1e-6)[:, :, None]
    return out
