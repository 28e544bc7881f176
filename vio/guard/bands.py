"""Bands of brightness that move through the images, as flickering light makes with a rolling
shutter: taken out.

The bands are constant along a row. Rectified cameras see the same rows, so the difference of their
row means changes slowly, whatever the scene and the motion; bands that differ between the cameras
change it from frame to frame. Once they have been seen, each image's smoothed row means are
replaced by the image's mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from vio.findings import begun
from vio.frontend.patches import mean_and_contrast
from vio.geometry.lie import FloatArray
from vio.guard.image_check import FrameImages, ImageCheck
from vio.numerics.kinds import Capacity
from vio.records import Image


@dataclass(frozen=True, slots=True)
class _BandRules:
    """When bands are taken out, and from what they are measured."""

    # Change of the difference of row means in a frame, gray levels (root mean square over the
    # rows). Measured: up to 7 on recordings without a fault, up to 19 where the right camera is
    # late, 70 and more by bands of 25 %.
    min_change: float = 25.0
    frames: int = 3  # such frames among the last ones before bands are taken out
    memory: int = 10  # frames
    # of an image over the other's: a camera that goes dark now and then has no bands
    min_contrast: float = 0.3
    stride_px: Capacity[int] = 8  # of the pixels that the contrast is computed from
    # standard deviation: bands are wider, and horizontal edges of the scene are narrower
    smooth_sigma_rows: float = 3.0


_BANDS = _BandRules()


class BandRemoval(ImageCheck):
    """Detects bands and takes them out from then on."""

    def __init__(self) -> None:
        super().__init__()
        self._last: FloatArray | None = None  # (H,) difference of row means in the last frame
        self._changed: list[int] = []  # frames with a change beyond the limit
        self._active = False

    def inspect(self, images: FrameImages) -> FrameImages:
        """Return the images without bands."""
        left, right = images.raw
        return images.with_raw(self.flatten(images.index, left, right))

    def flatten(self, index: int, left: Image, right: Image) -> tuple[Image, Image]:
        """Return both images (H, W) of a frame, without bands where there are such."""
        rows_left = _row_means(left)
        rows_right = _row_means(right)
        contrast = sorted(mean_and_contrast(image, _BANDS.stride_px)[1] for image in (left, right))
        if not self._active and contrast[0] > _BANDS.min_contrast * contrast[1]:
            self._detect(index, _smoothed(_without_gain(rows_left, rows_right)))
        if not self._active:
            return left, right
        return _flattened(left, _smoothed(rows_left)), _flattened(right, _smoothed(rows_right))

    def _detect(self, index: int, difference: FloatArray) -> None:
        centred = difference - _mean(difference)
        if self._last is not None and self._last.shape == centred.shape:
            change = math.sqrt(_mean((centred - self._last) ** 2))
            self._changed = [k for k in self._changed if index - k < _BANDS.memory] + [index] * (
                change > _BANDS.min_change
            )
        self._last = centred
        if len(self._changed) >= _BANDS.frames:
            self._active = True
            text = (
                "bands of brightness move through the images, differently in both "
                "cameras (flickering light, or an unstable exposure); they are taken out row by row"
            )
            self._found.append(begun("bands", index, text, self._changed[0]))


def _row_means(image: Image) -> FloatArray:
    """Mean gray level (H,) of each row."""
    # Sums of integers are vectorised: a twentieth of the time of means, which OpenCV takes as
    # these, times 1 / width.
    sums = np.asarray(cv2.reduce(image, 1, cv2.REDUCE_SUM, dtype=cv2.CV_32S))
    return sums.ravel() * (1.0 / image.shape[1])


def _without_gain(left: FloatArray, right: FloatArray) -> FloatArray:
    """Difference (H,) of row means at one mean gray level: cameras that set their exposure alone
    make no bands.
    """
    a = max(_mean(left), 1.0)
    b = max(_mean(right), 1.0)
    return (left / a - right / b) * ((a + b) / 2)


def _mean(values: FloatArray) -> float:
    """Mean (), as NumPy takes it, with a fifth of its calls."""
    return float(np.add.reduce(values, axis=None)) / values.size


def _smoothed(rows: FloatArray) -> FloatArray:
    """Values (H,) of rows, smoothed over a few of them."""
    line = rows[None]  # filtered in a tenth of the time that a column takes
    return np.asarray(
        cv2.GaussianBlur(line, (0, 1), sigmaX=_BANDS.smooth_sigma_rows, sigmaY=1.0),
        dtype=np.float64,
    )[0]


def _flattened(image: Image, rows: FloatArray) -> Image:
    """The image with rows of equal mean."""
    off = (rows - _mean(rows)).astype(np.float32)
    return np.clip(np.rint(image.astype(np.float32) - off[:, None]), 0, 255).astype(np.uint8)
