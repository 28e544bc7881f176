"""Corners of a detector of the caller's own: checked, and spread over the image."""

from __future__ import annotations

import numpy as np

from vio.errors import DataError
from vio.frontend.detect import cell_index, grid_shape, min_distance_px
from vio.frontend.settings import GridSettings
from vio.frontend.tracks import ANCHOR_REACH_PX
from vio.geometry.lie import FloatArray
from vio.protocols import Detector
from vio.records import BoolArray, Image

_BORDER_PX = ANCHOR_REACH_PX + 4  # from the image's edge; the template of a corner needs so much
_MAX_IN_CELL = 8  # corners that are added in one cell of the grid


def given_corners(
    detector: Detector,
    image: Image,
    occupied: FloatArray,
    wanted: int,
    grid: GridSettings,
    allowed: BoolArray | None = None,
) -> FloatArray:
    """Return up to `wanted` of a detector's corners (K, 2), best first, where no feature is.

    They keep the least distance between features, and no cell of the grid takes more than a few.

    Args:
        detector: finds corners, the best first.
        image: (H, W).
        occupied: tracked points (N, 2).
        wanted: largest number of corners.
        grid: number of features.
        allowed: mask (H/2, W/2) of pixels that may be corners; None: all.

    Raises:
        DataError: what the detector returns is not an array (K, 2) of finite pixels of the image.
    """
    if wanted <= 0:
        return np.zeros((0, 2))
    found = _checked(detector, detector.detect(image), image)
    height, width = image.shape
    border = np.array([_BORDER_PX, _BORDER_PX])
    good = np.all((found >= border) & (found < [width, height] - border), axis=1)
    if allowed is not None:
        last = np.array(allowed.shape)[::-1] - 1
        column, row = np.minimum(found.astype(np.int64) // 2, last).T
        good &= allowed[row, column]
    corners = np.ascontiguousarray(found[good])
    return corners[_spread(corners, occupied, wanted, image, grid)]


def _checked(detector: Detector, found: object, image: Image) -> FloatArray:
    """Return what a detector found as an array (K, 2)."""
    name = type(detector).__name__
    try:
        corners = np.asarray(found, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"{name}.detect() returned a {type(found).__name__}; it returns corners (K, 2) [u v]"
        ) from error
    if corners.size == 0:
        return np.zeros((0, 2))
    if corners.ndim != 2 or corners.shape[1] != 2 or not np.isfinite(corners).all():
        raise DataError(
            f"{name}.detect() returned an array {corners.shape}; it returns finite corners (K, 2), "
            "[u v] in pixels, best first"
        )
    height, width = image.shape
    if np.any((corners < -0.5) | (corners > [width - 0.5, height - 0.5])):
        raise DataError(
            f"{name}.detect() returned corners outside of the image of {width} x {height} pixels; "
            "each is [u v]: column, row"
        )
    return corners


def _spread(
    corners: FloatArray, occupied: FloatArray, wanted: int, image: Image, grid: GridSettings
) -> BoolArray:
    """Return the mask (K,) of the corners to add, in their order."""
    height, width = image.shape
    distance = min_distance_px(width, height, grid) - 1
    shape = grid_shape(width, height, grid)
    cell = cell_index(corners, width, height, shape)
    room = np.full(shape[0] * shape[1], _MAX_IN_CELL)
    taken = np.zeros(image.shape, dtype=np.bool_)
    chosen = np.zeros(len(corners), dtype=np.bool_)

    def take(u: int, v: int) -> None:
        rows = slice(max(v - distance, 0), v + distance + 1)
        columns = slice(max(u - distance, 0), u + distance + 1)
        taken[rows, columns] = True

    for u, v in np.rint(occupied).astype(np.int64).tolist():
        take(u, v)
    for k, (u, v) in enumerate(np.rint(corners).astype(np.int64).tolist()):
        if taken[v, u] or not room[cell[k]]:
            continue
        take(u, v)
        chosen[k] = True
        room[cell[k]] -= 1
        if chosen.sum() == wanted:
            break
    return chosen
