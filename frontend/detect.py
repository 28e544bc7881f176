"""Corner detection for new tracks: strongest first, spread over a grid, at a minimum distance
from tracked features.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from vio.errors import ConfigError
from vio.files.inputs import read_input
from vio.frontend.settings import GridSettings
from vio.frontend.tracks import ANCHOR_REACH_PX
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled
from vio.records import BoolArray, Image, IntArray

Response = npt.NDArray[np.float32]


class _CornerRules(NamedTuple):
    """Which corners are taken."""

    cell_features: int = 4  # target number of features per grid cell; determines the cell size
    min_distance_share: float = 0.15  # between features, over the spacing of a uniform grid of them
    # of a corner in its weakest direction, gray levels per pixel: root mean square over 6x6 pixels
    min_gradient: float = 1.0
    # the same, over that of the strongest corner of its grid cell
    min_relative_gradient: float = 0.15
    # where corners are few: down to so many times the gradient of the image noise
    min_gradient_over_noise: float = 5.0


_CORNERS = _CornerRules()
# The outermost pixels of the half image have no corners: their anchor would not fit into the full
# image.
_BORDER_PX = ANCHOR_REACH_PX // 2 + 2
# zero on planes and straight edges
_CURVATURE = np.array(
    [
        [1, -2, 1],
        [-2, 4, -2],
        [1, -2, 1],
    ],
    dtype=np.float32,
)
# mean absolute value; the norm of the kernel is 6
_CURVATURE_OF_UNIT_NOISE = 6.0 * math.sqrt(2.0 / math.pi)
_ROUNDING_NOISE = 1.0 / math.sqrt(12.0)  # of whole gray levels
_GRADIENT_OF_UNIT_NOISE = math.sqrt(12.0) / 8.0  # of the Sobel derivative, gray levels per pixel


def feature_spacing(width: int, height: int, grid: GridSettings) -> float:
    """Spacing in pixels of `target_features` points spread evenly over the image."""
    return math.sqrt(width * height / grid.target_features)


def min_distance_px(width: int, height: int, grid: GridSettings) -> int:
    """Least distance in pixels between features in an image of this size."""
    return max(2, round(_CORNERS.min_distance_share * feature_spacing(width, height, grid)))


def grid_shape(width: int, height: int, grid: GridSettings) -> tuple[int, int]:
    """Rows and columns of the balancing grid: nearly square cells that hold `_CELL_FEATURES`
    features each.
    """
    cell = feature_spacing(width, height, grid) * math.sqrt(_CORNERS.cell_features)
    return max(1, round(height / cell)), max(1, round(width / cell))


def cell_index(points: FloatArray, width: int, height: int, shape: tuple[int, int]) -> IntArray:
    """Index (N,) of the grid cell, in row-major order, that contains each point (N, 2)."""
    out = np.empty(len(points), dtype=np.int64)
    _cells(
        np.ascontiguousarray(points, dtype=np.float64),
        shape,
        shape[1] / width,
        shape[0] / height,
        out,
    )
    return out


@compiled
def _cells(
    points: FloatArray, shape: tuple[int, int], per_u: float, per_v: float, out: IntArray
) -> None:
    """Write the cells (N,) of `cell_index`; `per_u` and `per_v` are cells a pixel."""
    rows, columns = shape
    for n in range(len(points)):
        column = int(points[n, 0] * per_u)
        row = int(points[n, 1] * per_v)
        out[n] = min(max(row, 0), rows - 1) * columns + min(max(column, 0), columns - 1)


def corner_response(image: Image) -> Response:
    """Smaller eigenvalue (H, W) of the structure tensor, as mean squared gradient in the weakest
    direction.

    Gradients are Sobel's, and the mean is over 3x3 pixels; the outermost two pixels are zero. Unit:
    squared gray levels per squared pixel. Reference: Shi & Tomasi, Good features to track, CVPR
    (1994).
    """
    response = np.zeros(image.shape, dtype=np.float32)
    _write_response(np.ascontiguousarray(image), response)
    return response


@compiled
def _write_response(image: Image, out: Response) -> None:
    """Write `corner_response` inside the outermost two pixels.

    All sums are whole numbers below 2^24, and so exact.
    """
    height, width = image.shape
    inner = width - 2
    unit = np.float32(1.0 / (2.0 * 9.0 * 64.0))
    two = np.float32(2.0)
    four = np.float32(4.0)
    uu = np.empty((3, inner), np.float32)
    uv = np.empty((3, inner), np.float32)
    vv = np.empty((3, inner), np.float32)
    sums = np.empty((3, inner), np.float32)
    for y in range(1, height - 1):
        above = image[y - 1]
        here = image[y]
        below = image[y + 1]
        row = y % 3
        above_1 = above[1:]
        above_2 = above[2:]
        here_2 = here[2:]
        below_1 = below[1:]
        below_2 = below[2:]
        for x in range(inner):
            a = np.float32(above[x])
            b = np.float32(above_1[x])
            c = np.float32(above_2[x])
            d = np.float32(below[x])
            e = np.float32(below_1[x])
            f = np.float32(below_2[x])
            along_u = (c - a) + two * (np.float32(here_2[x]) - np.float32(here[x])) + (f - d)
            along_v = (d - a) + two * (e - b) + (f - c)
            uu[row, x] = along_u * along_u
            uv[row, x] = along_u * along_v
            vv[row, x] = along_v * along_v
        if y < 3:
            continue
        for x in range(inner):
            sums[0, x] = uu[0, x] + uu[1, x] + uu[2, x]
            sums[1, x] = uv[0, x] + uv[1, x] + uv[2, x]
            sums[2, x] = vv[0, x] + vv[1, x] + vv[2, x]
        line = out[y - 1, 2:]
        p = sums[0]
        q = sums[1]
        r = sums[2]
        p_1 = p[1:]
        p_2 = p[2:]
        q_1 = q[1:]
        q_2 = q[2:]
        r_1 = r[1:]
        r_2 = r[2:]
        for x in range(inner - 2):
            a = p[x] + p_1[x] + p_2[x]
            b = q[x] + q_1[x] + q_2[x]
            c = r[x] + r_1[x] + r_2[x]
            line[x] = unit * ((a + c) - np.sqrt((a - c) * (a - c) + four * b * b))


def noise_gradient(image: Image) -> float:
    """Upper bound of the root mean square gradient due to the noise of an image (H, W), in gray
    levels per pixel.

    Fine texture and the rounding to gray levels count as noise.
    Reference: Immerkær, Fast noise variance estimation, CVIU (1996).
    """
    curvature = cv2.filter2D(image, cv2.CV_32F, _CURVATURE)
    sigma = float(cv2.norm(curvature, cv2.NORM_L1)) / curvature.size / _CURVATURE_OF_UNIT_NOISE
    return _GRADIENT_OF_UNIT_NOISE * max(sigma, _ROUNDING_NOISE)


def local_maxima(
    response: Response, occupied: FloatArray, distance: int, border: int, least: float
) -> IntArray:
    """Pixels (K, 2) `[u v]` that are the largest response within `distance` and not near `occupied`
    (N, 2).

    Distances are in the maximum norm. The outermost `border` pixels and responses below `least` are
    excluded.
    """
    height, width = response.shape
    taken = np.rint(occupied).astype(np.int64)
    np.maximum(np.minimum(taken, [width - 1, height - 1]), 0, out=taken)
    free = response.copy()
    found = np.empty((response.size, 2), dtype=np.int64)
    count = _find_maxima(free, taken, distance, border, np.float32(max(least, 1e-12)), found)
    return found[:count].copy()


@compiled
def _find_maxima(
    free: Response, taken: IntArray, distance: int, border: int, least: np.float32, found: IntArray
) -> int:
    """Clear responses near taken pixels (N, 2), and write the pixels of the maxima of the rest;
    return their number.
    """
    height, width = free.shape
    for n in range(len(taken)):
        for v in range(max(taken[n, 1] - distance, 0), min(taken[n, 1] + distance + 1, height)):
            for u in range(max(taken[n, 0] - distance, 0), min(taken[n, 0] + distance + 1, width)):
                free[v, u] = 0.0
    count = 0
    inner = width - 2 * border
    # of a row: no less than `least`, nor than its neighbours
    largest = np.zeros((inner + 7) // 8 * 8, dtype=np.uint8)
    eights = largest.view(np.uint64)
    for v in range(border, height - border):
        here = free[v, border:]
        before = free[v, border - 1 :]
        after = free[v, border + 1 :]
        above = free[v - 1, border:]
        below = free[v + 1, border:]
        for u in range(inner):  # without branches: as vectors
            across = (here[u] >= before[u]) & (here[u] >= after[u])
            largest[u] = (here[u] >= least) & across & (here[u] >= above[u]) & (here[u] >= below[u])
        for block in range(len(eights)):
            if eights[block] == 0:
                continue
            for u in range(8 * block + border, min(8 * block + 8, inner) + border):
                if largest[u - border] and _is_largest(free, u, v, distance):
                    found[count, 0] = u
                    found[count, 1] = v
                    count += 1
    return count


@compiled
def _is_largest(free: Response, u: int, v: int, distance: int) -> bool:
    """Whether no response within a distance of a pixel is larger."""
    height, width = free.shape
    for y in range(max(v - distance, 0), min(v + distance + 1, height)):
        for x in range(max(u - distance, 0), min(u + distance + 1, width)):
            if free[y, x] > free[v, u]:
                return False
    return True


def detect_corners(
    half: Image,
    occupied: FloatArray,
    wanted: int,
    grid: GridSettings,
    allowed: BoolArray | None = None,
) -> FloatArray:
    """Find up to `wanted` new corners (K, 2), sub-pixel, where the grid has few tracked points
    `occupied` (N, 2).

    Corners are detected at half resolution: they are tracked for longer, at a quarter of the cost.
    The emptiest cells are filled first, each with its strongest corners, up to twice a cell's even
    share; corners much weaker than the best of their cell are dropped. If too few corners are
    strong, as in the dark, the strongest of the weak ones are added if they exceed the image noise.

    Args:
        half: image (H/2, W/2) at half resolution.
        occupied: tracked points in pixels of the full image.
        wanted: largest number of corners.
        grid: number of features.
        allowed: mask (H/2, W/2) of pixels that may be corners; None: all.

    Returns:
        Corners in pixels of the full image, best first.
    """
    height, width = half.shape
    if wanted <= 0 or min(height, width) <= 4 * _BORDER_PX:
        return np.zeros((0, 2))
    # A gradient per pixel of the full image is half of one per pixel of the half image.
    response = corner_response(half)
    response /= np.float32(4.0)
    if allowed is not None:
        response = np.where(allowed, response, np.float32(0.0))
    corners = _candidates(half, response, occupied, grid)
    shape = grid_shape(2 * width, 2 * height, grid)
    cell = cell_index(2 * corners.astype(np.float64), 2 * width, 2 * height, shape)
    strength = response[corners[:, 1], corners[:, 0]]
    share = np.float32(_CORNERS.min_relative_gradient**2)
    kept = np.empty(len(cell), dtype=np.bool_)
    _keep_strong(strength, cell, share, np.zeros(shape[0] * shape[1], dtype=np.float32), kept)
    rows = kept.nonzero()[0]
    # Ties are ordered by cell, then row by row, so that equal images give equal corners.
    place = (cell * height + corners[:, 1]) * width + corners[:, 0]
    rows = rows[np.lexsort((place[rows], -strength[rows]))]
    level = filling(
        cell[rows], cell_index(occupied, 2 * width, 2 * height, shape), shape[0] * shape[1]
    )
    order = level.argsort(kind="stable")
    best = order[level[order] < 2 * _CORNERS.cell_features]
    chosen = corners[rows[best[:wanted]]]
    peaks = np.empty((len(chosen), 2))
    _refine_peaks(response, chosen, peaks)
    return 2.0 * peaks


@compiled
def _keep_strong(
    strength: Response, cell: IntArray, share: np.float32, strongest: Response, kept: BoolArray
) -> None:
    """Write the mask (K,) of corners with a share of the strength of the strongest in their
    cell; (C,) are zeros.
    """
    for k in range(len(cell)):
        strongest[cell[k]] = max(strongest[cell[k]], strength[k])
    for k in range(len(cell)):
        kept[k] = strength[k] >= share * strongest[cell[k]]


def _candidates(
    half: Image, response: Response, occupied: FloatArray, grid: GridSettings
) -> IntArray:
    """Corner pixels (K, 2) of the half image; if these are too few, weaker ones, strongest
    first.
    """
    height, width = half.shape
    distance = max(1, min_distance_px(2 * width, 2 * height, grid) // 2)
    found = local_maxima(response, occupied / 2, distance, _BORDER_PX, _CORNERS.min_gradient**2)
    missing = grid.target_features - len(occupied)
    if len(found) >= missing:
        return found
    floor = _CORNERS.min_gradient_over_noise * noise_gradient(half) / 2.0
    if floor >= _CORNERS.min_gradient:
        return found
    weaker = local_maxima(response, occupied / 2, distance, _BORDER_PX, floor**2)
    strength = response[weaker[:, 1], weaker[:, 0]]
    best_first = np.argsort(-strength, kind="stable")
    return weaker[best_first[:missing]]


def filling(cell: IntArray, occupied: IntArray, cells: int) -> IntArray:
    """Number (N,) of features in the cell of each point before it is added, if points are added in
    their order.

    Sorting the points by this number fills all cells evenly, the emptiest first.

    Args:
        cell: index of the cell (N,) of each point.
        occupied: index of the cell (M,) of each existing feature.
        cells: number of cells.
    """
    filled = np.empty(len(cell), dtype=np.int64)
    held = np.bincount(occupied, minlength=cells)
    _fill(cell, held, filled)
    return filled


@compiled
def _fill(cell: IntArray, held: IntArray, filled: IntArray) -> None:
    """Write the numbers (N,) of `filling`; those of features in the cells (C,) are counted up."""
    for n in range(len(cell)):
        filled[n] = held[cell[n]]
        held[cell[n]] += 1


def load_mask(path: Path) -> Image:
    """Read the image (H, W) whose black pixels are excluded from corner detection.

    Raises:
        ConfigError: the file cannot be read or does not decode.
    """
    fault = "it is no image, or damaged"
    mask = None
    try:
        data = np.frombuffer(read_input(path), np.uint8)
        mask = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except (OSError, cv2.error) as error:  # OpenCV's of an empty file
        fault = getattr(error, "strerror", None) or fault
    if mask is None:
        raise ConfigError(
            f"frontend.klt.mask: {path} cannot be read as an image ({fault}); give a PNG of the "
            "recording's size"
        )
    return np.asarray(mask)


def half_mask(mask: Image, shape: tuple[int, ...]) -> BoolArray:
    """The mask (H, W) at half resolution, (H/2, W/2): True where all neighbouring pixels are
    allowed.

    Raises:
        ConfigError: the mask has another shape than the images, or excludes all of them.
    """
    if mask.shape != shape:
        raise ConfigError(
            f"frontend.klt.mask is {mask.shape[1]}x{mask.shape[0]}, but the images are "
            f"{shape[1]}x{shape[0]}; "
            "give a mask of the recording's size"
        )
    if not mask.any():
        raise ConfigError(
            "frontend.klt.mask is black all over, which excludes every pixel; make white what is to be "
            "tracked (transparency counts for nothing)"
        )
    solid = np.asarray(cv2.erode(mask, np.ones((3, 3), np.uint8)))
    return np.asarray(solid[::2, ::2] > 0)


@compiled
def _refine_peaks(response: Response, pixels: IntArray, out: FloatArray) -> None:
    """Write the peaks (K, 2) of a response, sub-pixel by a parabola through the pixels next to
    these (K, 2).
    """
    for k in range(len(pixels)):
        u = pixels[k, 0]
        v = pixels[k, 1]
        out[k, 0] = u + _vertex(response[v, u - 1], response[v, u], response[v, u + 1])
        out[k, 1] = v + _vertex(response[v - 1, u], response[v, u], response[v + 1, u])


@compiled
def _vertex(before: np.float32, centre: np.float32, after: np.float32) -> float:
    """Offset of the largest value of a parabola from the middle one of three, at most half a
    step.
    """
    first = np.float64(before)
    last = np.float64(after)
    curvature = first - 2.0 * np.float64(centre) + last
    return min(max((first - last) / 2.0 / curvature, -0.5), 0.5) if curvature < 0.0 else 0.0
