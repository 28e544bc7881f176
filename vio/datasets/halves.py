"""Images of one camera whose halves show one scene, as of a pair side by side in the size of one."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.datasets.images import UnreadableImageError
from vio.numerics.arrays import distinct
from vio.numerics.kinds import Tolerance
from vio.records import Image

FloatImage: TypeAlias = npt.NDArray[np.float32]


class _HalvesRules(NamedTuple):
    """When two halves of an image show one scene."""

    images: int = 5  # spread over the recording
    width_px: Tolerance[int] = 96  # to which halves are reduced
    blur_px: Tolerance[float] = 6.0  # of what is taken off them
    most_aside: float = 0.25  # of the width, by which they are shifted against one another
    most_rows: int = 3  # likewise, of halves so small
    # halves of one camera's images correlate by 0.05 to 0.18 (median), those of pairs by 0.44 to 0.97
    least_correlation: float = 0.35
    strip: float = 1 / 3  # of a half's width, which is looked for elsewhere in that half
    own_lobe_px: Tolerance[int] = 8  # around its place, where a strip is like itself
    # of that of the halves, above which a scene repeats itself; 0.2 to 0.55 of it in pairs, 0.8 to 1.5
    # in views of bricks, boards, fences and a tilted horizon
    most_alike: float = 0.7


_RULES = _HalvesRules()


def halves_note(count: int, load: Callable[[int], Image]) -> str | None:
    """Return a doubt about images whose halves show one scene; None: they do not, or cannot be read.

    Args:
        count: of the images.
        load: reads one of them (H, W); called with increasing numbers.
    """
    wanted = distinct(np.linspace(0, count - 1, min(count, _RULES.images)).astype(int))
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
    """Return the largest normalised correlation of an image's halves, shifted against one another; 0:
    the left half is as much like itself elsewhere.

    Each row is taken without its mean: what is alike along rows, as a horizon is, tells nothing.
    """
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
    left, right = (half - half.mean(axis=1, keepdims=True) for half in (left, right))
    aside = round(_RULES.most_aside * _RULES.width_px)
    found = float(_alike(left, slice(aside, size[0] - aside), right).max())
    strip = round(_RULES.strip * _RULES.width_px)
    for start in (0, size[0] - strip):
        of_strip = _alike(left, slice(start, start + strip), left)
        elsewhere = np.abs(np.arange(of_strip.shape[1]) - start) > _RULES.own_lobe_px
        if of_strip[:, elsewhere].max() > _RULES.most_alike * found:
            return 0.0
    return found


def _alike(half: FloatImage, columns: slice, other: FloatImage) -> FloatImage:
    """Return the normalised correlation of some columns of a half with another one (H, W), at each
    shift against it (rows, columns).
    """
    import cv2

    part = np.ascontiguousarray(half[_RULES.most_rows : len(half) - _RULES.most_rows, columns])
    if not part.any() or not other.any():
        shape = [n - m + 1 for n, m in zip(other.shape, part.shape, strict=True)]
        return np.zeros(shape, dtype=np.float32)
    return cv2.matchTemplate(other, part, cv2.TM_CCORR_NORMED).astype(np.float32)
