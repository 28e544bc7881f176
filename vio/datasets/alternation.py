"""Images of one stream that alternate between two views, as of a pair whose images come in turns."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vio.datasets.images import UnreadableImageError
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Tolerance
from vio.records import Image


class _AlternationRules(NamedTuple):
    """When the shift from image to image changes its direction each time."""

    frames: int = 16  # that follow one another
    width_px: Tolerance[int] = 96  # to which images are reduced
    min_shift_px: float = 0.2  # of images so small
    sigmas: float = 6.0  # motion and shaking of one camera come to 1


_RULES = _AlternationRules()


def alternating_note(count: int, load: Callable[[int], Image]) -> str | None:
    """Return a doubt about images that alternate between two views; None: they do not, or cannot be
    read.

    The first images and those in the middle are looked at.

    Args:
        count: of the images.
        load: reads one of them (H, W); called with increasing numbers.
    """
    if count < _RULES.frames:
        return None
    later = max(_RULES.frames, (count - _RULES.frames) // 2)
    for first in (0, later) if later + _RULES.frames <= count else (0,):
        try:
            images = [load(k) for k in range(first, first + _RULES.frames)]
        except UnreadableImageError:
            return None
        if len({image.shape for image in images}) == 1 and _alternate(_shifts(images)):
            return (
                "doubtful: the images alternate between two views: those of a left and a right camera "
                "seem to come in turns; put them into two folders, left and right"
            )
    return None


def _alternate(shifts: FloatArray) -> bool:
    """Return whether shifts (N,) change in turns by far more than they vary about a steady motion."""
    k = np.arange(len(shifts))
    A = np.stack([np.ones(len(k)), k, (-1.0) ** k], axis=1)
    x = np.linalg.lstsq(A, shifts, rcond=None)[0]
    left = shifts - A @ x
    variance = float(left @ left) / (len(k) - A.shape[1]) * np.linalg.inv(A.T @ A)[2, 2]
    return abs(float(x[2])) > max(_RULES.min_shift_px, _RULES.sigmas * float(variance**0.5))


def _shifts(images: list[Image]) -> FloatArray:
    """Return by how much each image is shifted to the side against the one before (N - 1,), in
    pixels of reduced ones.
    """
    import cv2

    height, width = images[0].shape
    size = (_RULES.width_px, max(_RULES.width_px * height // width, 2))
    small = [
        cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) for image in images
    ]
    window = cv2.createHanningWindow(size, cv2.CV_32F)
    pairs = itertools.pairwise(small)
    return np.array([cv2.phaseCorrelate(a, b, window)[0][0] for a, b in pairs])
