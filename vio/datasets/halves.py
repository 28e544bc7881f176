"""Images of one camera whose halves show one scene, as of a pair side by side in the size of one."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vio.datasets.images import UnreadableImageError
from vio.numerics.kinds import Tolerance
from vio.records import Image


class _HalvesRules(NamedTuple):
    """When two halves of an image show one scene."""

    images: int = 5  # spread over the recording
    width_px: Tolerance[int] = 96  # to which halves are reduced
    blur_px: Tolerance[float] = 6.0  # of what is taken off them
    most_aside: float = 0.25  # of the width, by which they are shifted against one another
    most_rows: int = 3  # likewise, of halves so small
    # halves of one camera's images correlate by 0.09 to 0.33 (median), those of pairs by 0.55 to 0.92
    least_correlation: float = 0.45


_RULES = _HalvesRules()


def halves_note(count: int, load: Callable[[int], Image]) -> str | None:
    """Return a doubt about images whose halves show one scene; None: they do not, or cannot be read.

    Args:
        count: of the images.
        load: reads one of them (H, W); called with increasing numbers.
    """
    wanted = np.unique(np.linspace(0, count - 1, min(count, _RULES.images)).astype(int))
    try:
        found = [_correlation(load(k)) for k in wanted.tolist()]
    except UnreadableImageError:
        return None
    if not found or np.median(found) < _RULES.least_correlation:
        return None
    return (
        "doubtful: the left and the right half of the images show one scene: they seem to hold both "
        "images of a pair side by side, and are read as those of one camera; give the calibration of the "
        "pair, whose image size is that of a half, or write the halves into two folders, left and right"
    )


def _correlation(image: Image) -> float:
    """Return the largest normalised correlation of an image's halves, shifted against one another."""
    import cv2

    height, width = image.shape
    size = (
        _RULES.width_px,
        max(_RULES.width_px * height // max(width // 2, 1), 2 * _RULES.most_rows + 2),
    )
    left, right = (
        cv2.resize(half, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        for half in (image[:, : width // 2], image[:, width - width // 2 :])
    )
    left, right = (half - cv2.GaussianBlur(half, (0, 0), _RULES.blur_px) for half in (left, right))
    aside = round(_RULES.most_aside * _RULES.width_px)
    rows = _RULES.most_rows
    inner = left[rows : size[1] - rows, aside : size[0] - aside]
    if not inner.any() or not right.any():
        return 0.0
    return float(cv2.matchTemplate(right, np.ascontiguousarray(inner), cv2.TM_CCORR_NORMED).max())
