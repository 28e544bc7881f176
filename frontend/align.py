"""Batched sub-pixel alignment of small templates, by Gauss-Newton over an affine warp, gain and
offset.

The inverse-compositional form uses the gradients of the template in every iteration: an iteration
costs one interpolation of the image under each template, and a template is prepared only once. A
warp (2, 3) maps template offsets `[x, y, 1]` to image pixels `[u, v]`. Pixels count by a Gaussian
window: what is at the rim may be at another depth. The loops over pixels are compiled;
`tests/numpy_twins.py` holds the same alignment in NumPy.
Reference: Baker & Matthews, Lucas-Kanade 20 years on, IJCV (2004).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.frontend.patches import Patches
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled, compiled_sums, dot, invert_positive
from vio.numerics.kinds import Tolerance
from vio.records import BoolArray, Image, IntArray

_PARAMETERS = 8  # shift u, v; gain; offset; linear part in row-major order
_ROW_PARAMETERS = 6  # the same without the second row of the linear part


class _FitSigmas(NamedTuple):
    """Standard deviations that the alignment takes for given."""

    # standard deviation of a feature's row in the other image of a rectified pair
    row_px: float = 0.3
    # standard deviation between the two images of one patch, after gain and offset
    gray: float = 4.0
    window_share: float = 0.4  # standard deviation of the window over the radius of a template


_SIGMAS = _FitSigmas()
_ROW_WEIGHT = (_SIGMAS.gray / _SIGMAS.row_px) ** 2
MAX_MOVE_PX = 2.5  # of a fitted pixel from its start; beyond, it has left the correlation peak
# step at which a template has converged; the remaining error is a small fraction of it
_DONE_PX: Tolerance[float] = 0.05
_MIN_SCORE = 0.1  # that a standard deviation is computed with
_MAX_SCORE: Tolerance[float] = 0.99999
_MAX_STEP_PX = 1.0
_MAX_LINEAR_STEP = 0.3
_DAMPING: Tolerance[float] = (
    1e-6  # relative to the diagonal: limits the step in weakly textured directions
)
# of the radius, up to which a template must be inside the image: most of its weight
INSIDE = 2.0 * _SIGMAS.window_share
# anchors are cut at multiples of this fraction of a pixel, where the weights of float32 are exact
_SUBPIXELS = 32
ITERATIONS = 5  # of a feature that is followed
MIN_CORRELATION = 0.8  # normalised, with the anchor; below, it is another patch
FLAT_RMS = 1.0  # gray levels; a patch with less contrast matches anything

Pixels = npt.NDArray[np.float32]  # gray levels and what is computed from them
Pairs = npt.NDArray[np.uint16]  # of neighbouring pixels
_PAIR = np.dtype("<u2")


@dataclass(frozen=True, slots=True)
class Templates:
    """Discs prepared for alignment.

    S pixels each, those of `disc`, with the weights of `window`.
    """

    patch: npt.NDArray[np.float32]  # (N, S) weight times gray levels minus their weighted mean
    gradient: npt.NDArray[np.float32]  # (N, 2, S) weight times gradient along u and v
    energy: npt.NDArray[np.float32]  # (N,) weighted sum of squares of gray levels minus their mean
    inverse: npt.NDArray[np.float32]  # (N, 8, 8) of the normal matrix
    row_inverse: npt.NDArray[np.float32]  # (N, 6, 6) the same, with the expected row as a prior
    # (N, 3) px, (F1) of the last alignment: of u, v, and u along a row; 0: none yet
    sigma: npt.NDArray[np.float32]


def empty_templates(count: int, radius: int) -> Templates:
    """Allocate `count` empty templates of a radius."""
    size = disc(radius).shape[1]
    shapes = (
        (size,),
        (2, size),
        (),
        (_PARAMETERS, _PARAMETERS),
        (_ROW_PARAMETERS, _ROW_PARAMETERS),
        (3,),
    )
    return Templates(*(np.zeros((count, *shape), np.float32) for shape in shapes))


@lru_cache(maxsize=8)
def offsets(radius: int) -> Pixels:
    """Offsets (2, (2r + 1)^2) `[x, y]` of the pixels of a square patch from its centre, row by
    row; read-only.
    """
    out = (
        np.mgrid[-radius : radius + 1, -radius : radius + 1][::-1].astype(np.float32).reshape(2, -1)
    )
    out.flags.writeable = False
    return out


@lru_cache(maxsize=8)
def disc(radius: int) -> Pixels:
    """Offsets (2, S) `[x, y]` of the pixels of a template from its centre, row by row;
    read-only.
    """
    square = offsets(radius)
    inside = (square**2).sum(axis=0) <= (radius + 0.5) ** 2
    out = np.ascontiguousarray(square[:, inside])
    out.flags.writeable = False
    return out


@lru_cache(maxsize=8)
def window(radius: int) -> Pixels:
    """Weights (S,) of a template's pixels, which sum to the number of independent pixels that
    they are worth.
    """
    weight = np.exp(
        -0.5
        * (disc(radius).astype(np.float64) ** 2).sum(axis=0)
        / (_SIGMAS.window_share * radius) ** 2
    )
    out = (weight * weight.sum() / (weight @ weight)).astype(np.float32)
    out.flags.writeable = False
    return out


@lru_cache(maxsize=8)
def _radius(size: int) -> int:
    """Radius of the template that has `size` pixels."""
    return next(radius for radius in range(1, size) if disc(radius).shape[1] == size)


def warped_patches(image: Image, warp: FloatArray, radius: int) -> Pixels:
    """Gray levels (N, S) of an image at the pixels of a square patch under warps (N, 2, 3)."""
    return _gray_levels(image, warp, offsets(radius))


def warped_discs(image: Image, warp: FloatArray, radius: int) -> Pixels:
    """Gray levels (N, S) of an image at the pixels of a template under warps (N, 2, 3)."""
    return _gray_levels(image, warp, disc(radius))


def _gray_levels(image: Image, warp: FloatArray, xy: Pixels) -> Pixels:
    """Gray levels (N, S) at `warp @ [x, y, 1]` (N, 2, 3), interpolated linearly; the image's
    border is repeated.
    """
    out = np.empty((len(warp), xy.shape[1]), dtype=np.float32)
    image = np.ascontiguousarray(image)
    _sample_all(image, _pairs(image), warp, xy, out)
    return out


def _pairs(image: Image) -> Pairs:
    """Each pixel of an image (H, W), row by row, and the next one, as one number; shares the
    image's memory.
    """
    return np.ndarray(image.size - 1, _PAIR, image, strides=(1,))


@compiled
def _sample_all(image: Image, pairs: Pairs, warp: FloatArray, xy: Pixels, out: Pixels) -> None:
    size = xy.shape[1]
    at = np.empty(size, np.int32)
    part = np.empty((2, size), np.float32)
    for n in range(len(warp)):
        _sample(image, pairs, warp[n], xy, at, part, out[n])


@compiled
def _sample(
    image: Image,
    pairs: Pairs,
    warp: FloatArray,
    xy: Pixels,
    at: npt.NDArray[np.int32],
    part: Pixels,
    out: Pixels,
) -> None:
    """Write the gray levels (S,) under one warp (2, 3) into `out`; `at` (S,) and `part` (2, S)
    are overwritten.
    """
    height, width = image.shape
    radius = -xy[1, 0]
    reach_u = radius * (abs(warp[0, 0]) + abs(warp[0, 1]))
    reach_v = radius * (abs(warp[1, 0]) + abs(warp[1, 1]))
    # False also for a warp that is not finite.
    if not (
        reach_u <= warp[0, 2] < width - 1.001 - reach_u
        and reach_v <= warp[1, 2] < height - 1.001 - reach_v
    ):
        _sample_border(image, warp, xy, out)
        return
    # Pixels are counted from the patch's corner, where float32 is exact enough.
    first_u = int(warp[0, 2] - reach_u)
    first_v = int(warp[1, 2] - reach_v)
    u_x = np.float32(warp[0, 0])
    u_y = np.float32(warp[0, 1])
    u_1 = np.float32(warp[0, 2] - first_u)
    v_x = np.float32(warp[1, 0])
    v_y = np.float32(warp[1, 1])
    v_1 = np.float32(warp[1, 2] - first_v)
    row = np.int32(width)
    for k in range(len(at)):
        u = u_x * xy[0, k] + u_y * xy[1, k] + u_1
        v = v_x * xy[0, k] + v_y * xy[1, k] + v_1
        i = np.int32(u)
        j = np.int32(v)
        part[0, k] = u - np.float32(i)
        part[1, k] = v - np.float32(j)
        at[k] = np.int32(j * row) + i
    # Unsigned indices are not checked for being negative.
    pixels = pairs[first_v * width + first_u :]
    below_them = pairs[(first_v + 1) * width + first_u :]
    for k in range(len(at)):  # the four pixels in one number
        p = np.uint32(at[k])
        at[k] = np.int32(pixels[p]) | np.int32(below_them[p]) << np.int32(16)
    byte = np.int32(255)
    for k in range(len(at)):
        four = at[k]
        a = np.float32(four & byte)
        b = np.float32(four >> np.int32(8) & byte)
        c = np.float32(four >> np.int32(16) & byte)
        d = np.float32(four >> np.int32(24) & byte)
        above = a + part[0, k] * (b - a)
        below = c + part[0, k] * (d - c)
        out[k] = above + part[1, k] * (below - above)


@compiled
def _sample_border(image: Image, warp: FloatArray, xy: Pixels, out: Pixels) -> None:
    """Write the gray levels (S,) under one warp (2, 3) into `out`, pixels outside the image from
    its border.
    """
    height, width = image.shape
    for k in range(len(out)):
        u = _clamped(warp[0, 0] * xy[0, k] + warp[0, 1] * xy[1, k] + warp[0, 2], width - 1.0)
        v = _clamped(warp[1, 0] * xy[0, k] + warp[1, 1] * xy[1, k] + warp[1, 2], height - 1.0)
        i = min(int(u), width - 2)
        j = min(int(v), height - 2)
        a = float(image[j, i])
        b = float(image[j, i + 1])
        c = float(image[j + 1, i])
        d = float(image[j + 1, i + 1])
        above = a + (u - i) * (b - a)
        below = c + (u - i) * (d - c)
        out[k] = above + (v - j) * (below - above)


@compiled
def _clamped(value: float, most: float) -> float:
    """The value between 0 and `most`; 0 for one that is not a number."""
    if not value > 0.0:
        return 0.0
    return min(value, most)


def cut_patches(image: Image, centres: FloatArray, radius: int) -> Patches:
    """Patches (N, 2r+3, 2r+3) around sub-pixel points (N, 2), one pixel wider than the template
    made of them.
    """
    side = 2 * radius + 3
    out = np.empty((len(centres), side, side), np.float32)
    image = np.ascontiguousarray(image)
    beyond = np.empty(len(centres), np.int64)
    count = _cut_all(image, centres, out, beyond)
    if count:
        rows = beyond[:count]
        at_border = warped_patches(image, shift_warps(centres[rows]), radius + 1)
        out[rows] = at_border.reshape(-1, side, side)
    return out


@compiled
def _cut_all(image: Image, centres: FloatArray, out: Patches, beyond: IntArray) -> int:
    """Write patches (N, s, s) around points (N, 2), interpolated linearly; return the number of
    those that reach beyond the image, whose rows are written into `beyond` (N,).
    """
    height, width = image.shape
    side = out.shape[1]
    radius = side // 2
    count = 0
    for n in range(len(centres)):
        u = centres[n, 0] - radius
        v = centres[n, 1] - radius
        # False also for a point that is not finite.
        if not (0.0 <= u < width - side - 0.001 and 0.0 <= v < height - side - 0.001):
            beyond[count] = n
            count += 1
            continue
        first = int(u)
        top = int(v)
        right = np.float32(u - first)
        down = np.float32(v - top)
        for y in range(side):
            above = image[top + y, first : first + side + 1]
            below = image[top + y + 1, first : first + side + 1]
            row = out[n, y]
            for x in range(side):
                a = np.float32(above[x])
                b = np.float32(above[x + 1])
                c = np.float32(below[x])
                d = np.float32(below[x + 1])
                upper = a + right * (b - a)
                lower = c + right * (d - c)
                row[x] = upper + down * (lower - upper)
    return count


def rounded(centres: FloatArray) -> FloatArray:
    """Points rounded to the fraction of a pixel at which `cut_patches` cuts exactly."""
    return np.rint(centres * _SUBPIXELS) / _SUBPIXELS


def templates(wide: Patches) -> Templates:
    """Prepare templates from patches (N, 2r+3, 2r+3) cut by `cut_patches`."""
    out = empty_templates(len(wide), wide.shape[1] // 2 - 1)
    replace_templates(out, np.arange(len(wide)), wide)
    return out


def replace_templates(store: Templates, slots: IntArray, wide: Patches) -> None:
    """Prepare templates from patches (N, 2r+3, 2r+3) in rows (N,) of others."""
    radius = wide.shape[1] // 2 - 1
    columns = _Columns(store.patch, store.gradient, store.energy, store.inverse)
    _prepare(wide, disc_of(radius), slots, columns, store.row_inverse)


class Disc(NamedTuple):
    """The pixels of a template."""

    xy: Pixels  # (2, S) as of `disc`
    weights: Pixels  # (S,) as of `window`


@lru_cache(maxsize=8)
def disc_of(radius: int) -> Disc:
    """Return the pixels of a template with their weights."""
    return Disc(disc(radius), window(radius))


class _Columns(NamedTuple):
    """Columns of templates, as in `Templates`; the inverse is that of all or of the row's
    parameters.
    """

    patch: Pixels
    gradient: Pixels
    energy: Pixels
    inverse: Pixels


class _RowPrior(NamedTuple):
    """The expected image rows (N,) of the centres, and their weight; without weight, not read."""

    rows: FloatArray
    weight: float


class _Aligned(NamedTuple):
    """What an alignment writes."""

    warp: FloatArray  # (N, 2, 3) refined in place
    score: FloatArray  # (N,) correlations
    sigma: Pixels  # (M, 3) of which rows (N,) are written


@compiled
def _prepare(wide: Patches, of: Disc, slots: IntArray, out: _Columns, row_inverse: Pixels) -> None:
    """Write rows (N,) of the columns of templates."""
    xy = of.xy
    weights = of.weights
    patch = out.patch
    gradient = out.gradient
    energy = out.energy
    size = xy.shape[1]
    side = wide.shape[1]
    basis = np.empty((_PARAMETERS, size))
    normal = np.empty((_PARAMETERS, _PARAMETERS))
    on_row = np.empty((_ROW_PARAMETERS, _ROW_PARAMETERS))
    at = np.empty(size, np.int64)
    for k in range(size):
        at[k] = (side // 2 + int(xy[1, k])) * side + side // 2 + int(xy[0, k])
    for n, slot in enumerate(slots):
        pixels = wide[n].reshape(side * side)
        mean = _weighted_mean(pixels, at, weights)
        energy[slot] = 0.0
        for k in range(size):
            x = xy[0, k]
            y = xy[1, k]
            weight = weights[k]
            i = at[k]
            centred = pixels[i] - mean
            gu = (pixels[i + 1] - pixels[i - 1]) / np.float32(2.0)
            gv = (pixels[i + side] - pixels[i - side]) / np.float32(2.0)
            patch[slot, k] = weight * centred
            gradient[slot, 0, k] = weight * gu
            gradient[slot, 1, k] = weight * gv
            energy[slot] += weight * centred * centred
            root = np.sqrt(weight)
            gu = root * gu
            gv = root * gv
            basis[0, k] = gu
            basis[1, k] = gv
            basis[2, k] = root * centred
            basis[3, k] = root
            basis[4, k] = gu * x
            basis[5, k] = gu * y
            basis[6, k] = gv * x
            basis[7, k] = gv * y
        for i in range(_PARAMETERS):
            for j in range(i + 1):
                normal[i, j] = dot(basis[i], basis[j])
            normal[i, i] += _DAMPING * normal[i, i] + 1e-6
        invert_positive(normal, out.inverse[slot])
        for i in range(_ROW_PARAMETERS):
            for j in range(i + 1):
                on_row[i, j] = normal[i, j]
        on_row[1, 1] += _ROW_WEIGHT
        invert_positive(on_row, row_inverse[slot])


@compiled
def _weighted_mean(pixels: Pixels, at: IntArray, weights: Pixels) -> np.float32:
    """Mean of the pixels at indices (S,), by their weights (S,)."""
    total = sum_of_weights = 0.0
    for k in range(len(at)):
        total += weights[k] * pixels[at[k]]
        sum_of_weights += weights[k]
    return np.float32(total / sum_of_weights)


def align(
    store: Templates,
    slots: IntArray,
    image: Image,
    warp: FloatArray,
    iterations: int,
    rows: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Refine warps (N, 2, 3) from templates to the image.

    Args:
        store: templates (M,).
        slots: rows (N,) of the templates to align.
        image: the image to align with.
        warp: initial warps (N, 2, 3).
        iterations: largest number of iterations.
        rows: expected image rows (N,) of the centres, as in the other image of a rectified pair:
            the expected row acts as a prior on the centre, and the warp shears and stretches along
            rows only.

    Returns:
        The refined warps (N, 2, 3), and the normalised correlation (N,) just before the last step;
        -1 where the template's centre comes too close to the image border for most of the window to
        fit. `store.sigma` holds the standard deviations then, equation (F1).
    """
    radius = _radius(store.patch.shape[1])
    warp, score = warp.copy(), np.empty(len(warp))
    inverse, row_weight = (store.inverse, 0.0) if rows is None else (store.row_inverse, _ROW_WEIGHT)
    expected = score if rows is None else rows  # not read without a weight
    columns = _Columns(store.patch, store.gradient, store.energy, inverse)
    image = np.ascontiguousarray(image)
    _refine(
        columns,
        disc_of(radius),
        slots,
        (image, _pairs(image)),
        _RowPrior(expected, row_weight),
        iterations,
        _Aligned(warp, score, store.sigma),
    )
    return warp, score


@compiled
def _refine(
    templates: _Columns,
    of: Disc,
    slots: IntArray,
    images: tuple[Image, Pairs],
    prior: _RowPrior,
    iterations: int,
    out: _Aligned,
) -> None:
    """Refine the warps of templates in rows (N,), by an image and its pairs of pixels."""
    patch = templates.patch
    gradient = templates.gradient
    energy = templates.energy
    inverse = templates.inverse
    xy = of.xy
    weights = of.weights
    image, pairs = images
    row_weight = prior.weight
    warp = out.warp
    score = out.score
    sigma = out.sigma
    pixels = patch.shape[1]
    parameters = inverse.shape[1]
    size = 0.0
    for k in range(pixels):
        size += weights[k]
    margin = 1.0 - INSIDE * xy[1, 0]
    last_u = image.shape[1] - 1.0
    last_v = image.shape[0] - 1.0
    at = np.empty(pixels, np.int32)
    part = np.empty((2, pixels), np.float32)
    view = np.empty(pixels, np.float32)
    moments = np.empty(_PARAMETERS, np.float32)
    fit = np.empty(_PARAMETERS)
    for i in range(_PARAMETERS):
        fit[i] = 0.0
    for n, slot in enumerate(slots):
        score[n] = -1.0
        for _ in range(iterations):
            _sample(image, pairs, warp[n], xy, at, part, view)
            square = _moments(patch[slot], gradient[slot], weights, view, xy, moments)
            score[n] = _correlation(energy[slot], moments[2], square - moments[3] ** 2 / size, size)
            if row_weight > 0.0:
                gain = max(moments[2] / max(energy[slot], 1.0), 0.1)
                moments[1] += row_weight * gain * (warp[n, 1, 2] - prior.rows[n])
            for i in range(parameters):
                fit[i] = 0.0
                for j in range(parameters):
                    fit[i] += inverse[slot, i, j] * moments[j]
            # The image under the current warp is gain * template(step(x)) + offset, so the inverse
            # step is applied.
            gain = max(fit[2], 0.1)
            for i in range(parameters):
                fit[i] /= gain
            _undo(warp[n], fit)
            if max(abs(fit[0]), abs(fit[1])) <= _DONE_PX:
                break
        share = 1.0 / min(max(score[n], _MIN_SCORE), _MAX_SCORE) ** 2 - 1.0
        gray2 = share * energy[slot] / size
        if row_weight > 0.0:
            sigma[slot, 2] = np.sqrt(gray2 * inverse[slot, 0, 0])
        else:
            sigma[slot, 0] = np.sqrt(gray2 * inverse[slot, 0, 0])
            sigma[slot, 1] = np.sqrt(gray2 * inverse[slot, 1, 1])
        u = warp[n, 0, 2]
        v = warp[n, 1, 2]
        if not (margin <= u <= last_u - margin and margin <= v <= last_v - margin):
            score[n] = -1.0


@compiled_sums
def _moments(
    patch: Pixels, gradient: Pixels, weights: Pixels, view: Pixels, xy: Pixels, out: Pixels
) -> np.float32:
    """Write the weighted products (8,) of pixels (S,) with the derivatives by the parameters.

    Returns:
        The weighted sum of their squares.
    """
    zero = np.float32(0.0)
    u = zero
    v = zero
    like = zero
    total = zero
    u_x = zero
    u_y = zero
    v_x = zero
    v_y = zero
    square = zero
    for k in range(len(view)):
        gray = view[k]
        gu = gradient[0, k] * gray
        gv = gradient[1, k] * gray
        u += gu
        v += gv
        u_x += xy[0, k] * gu
        u_y += xy[1, k] * gu
        v_x += xy[0, k] * gv
        v_y += xy[1, k] * gv
        like += patch[k] * gray
        weighted = weights[k] * gray
        total += weighted
        square += weighted * gray
    out[0] = u
    out[1] = v
    out[2] = like
    out[3] = total
    out[4] = u_x
    out[5] = u_y
    out[6] = v_x
    out[7] = v_y
    return square


@compiled
def _undo(warp: FloatArray, fit: FloatArray) -> None:
    """Apply the inverse of the step `x -> (I + linear) x + shift` to a warp (2, 3) in place;
    parameters (8,).
    """
    du = min(max(fit[0], -_MAX_STEP_PX), _MAX_STEP_PX)
    dv = min(max(fit[1], -_MAX_STEP_PX), _MAX_STEP_PX)
    a = 1.0 + min(max(fit[4], -_MAX_LINEAR_STEP), _MAX_LINEAR_STEP)
    b = min(max(fit[5], -_MAX_LINEAR_STEP), _MAX_LINEAR_STEP)
    c = min(max(fit[6], -_MAX_LINEAR_STEP), _MAX_LINEAR_STEP)
    d = 1.0 + min(max(fit[7], -_MAX_LINEAR_STEP), _MAX_LINEAR_STEP)
    det = a * d - b * c
    for i in range(2):
        x = (warp[i, 0] * d - warp[i, 1] * c) / det
        y = (warp[i, 1] * a - warp[i, 0] * b) / det
        warp[i, 0] = x
        warp[i, 1] = y
        warp[i, 2] -= x * du + y * dv


@compiled
def _correlation(energy: float, product: float, other: float, size: float) -> float:
    """Normalised correlation of a patch of known energy with pixels of energy `other`; -1 if
    either is flat.
    """
    flat = FLAT_RMS**2 * size
    if not (other > flat and energy > flat):
        return -1.0
    return product / np.sqrt(np.float64(other) * energy)


def shift_warps(centres: FloatArray) -> FloatArray:
    """Warps (N, 2, 3) that put the template's centre at image points (N, 2), without rotation or
    scale.
    """
    warp = np.zeros((len(centres), 2, 3))
    warp[:, 0, 0] = warp[:, 1, 1] = 1.0
    warp[:, :, 2] = centres
    return warp


def on_peak(pixels: FloatArray, start: FloatArray) -> BoolArray:
    """Mask (N,) of fitted pixels (N, 2) near their start (N, 2); others have left the
    correlation peak.
    """
    moved = np.abs(pixels - start) <= MAX_MOVE_PX
    return moved[:, 0] & moved[:, 1]


@compiled
def is_on_peak(du: float, dv: float) -> bool:
    """Whether one fitted pixel is near its start, as `on_peak` says."""
    return abs(du) <= MAX_MOVE_PX and abs(dv) <= MAX_MOVE_PX


def template_points(warp: FloatArray, offset: FloatArray) -> FloatArray:
    """Image points (N, 2) of template points, given as offsets (N, 2) from the centre, under
    warps (N, 2, 3).
    """
    turned = (warp[:, :, :2] @ offset[:, :, None])[:, :, 0]
    return np.asarray(warp[:, :, 2] + turned)


def scale_change(warp: FloatArray) -> FloatArray:
    """Scale (N,) of warps (N, 2, 3): the square root of the change of area; tiny where the warp
    is mirrored.
    """
    A = warp[:, :, :2]
    determinant = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    return np.sqrt(np.maximum(determinant, 1e-6))
