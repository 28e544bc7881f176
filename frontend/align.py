"""Batched sub-pixel alignment of small templates, by Gauss-Newton over an affine warp, gain and offset.

The inverse-compositional form uses the gradients of the template in every iteration: an iteration costs one
interpolation of the image under each template, and a template is prepared only once. A warp (2, 3) maps
template offsets `[x, y, 1]` to image pixels `[u, v]`.
Reference: Baker & Matthews, Lucas-Kanade 20 years on, IJCV (2004).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray
from vio.records import BoolArray, IntArray

from .patches import FloatImage, Patches, inside

_PARAMETERS = 8  # shift u, v; gain; offset; linear part in row-major order
_ROW_PARAMETERS = 6  # the same without the second row of the linear part
_ROW_SIGMA_PX = 0.3  # standard deviation of a feature's row in the other image of a rectified pair
_GRAY_SIGMA = 4.0  # standard deviation between the two images of one patch, after gain and offset
_ROW_WEIGHT = (_GRAY_SIGMA / _ROW_SIGMA_PX) ** 2
_MAX_MOVE_PX = 2.5
_DONE_PX = 0.05  # step at which a template has converged; the remaining error is a small fraction of it
_MAX_STEP_PX = 1.0
_MAX_LINEAR_STEP = 0.3
_DAMPING = 1e-6  # relative to the diagonal: limits the step in weakly textured directions
_SUBPIXELS = 32  # cv2.remap rounds coordinates to this fraction of a pixel, so shifts are rounded beforehand
_REMAP_ROWS = 30_000  # cv2.remap takes fewer than 32768 rows
FLAT_RMS = 1.0  # gray levels; a patch with less contrast matches anything


@dataclass(frozen=True, slots=True)
class Templates:
    """Patches prepared for alignment; S = (2r + 1)^2 pixels each."""

    patch: npt.NDArray[np.float32]  # (N, S) gray levels minus their mean
    gradient: npt.NDArray[np.float32]  # (N, 2, S) along u and v
    energy: npt.NDArray[np.float32]  # (N,) sum of squares of the patch
    inverse: npt.NDArray[np.float32]  # (N, 8, 8) of the normal matrix
    row_inverse: npt.NDArray[np.float32]  # (N, 6, 6) the same, with the expected row as a prior


def empty_templates(count: int, radius: int) -> Templates:
    """Allocate `count` empty templates of a radius."""
    size = (2 * radius + 1) ** 2
    shapes = ((size,), (2, size), (), (_PARAMETERS, _PARAMETERS), (_ROW_PARAMETERS, _ROW_PARAMETERS))
    return Templates(*(np.zeros((count, *shape), np.float32) for shape in shapes))


@lru_cache(maxsize=8)
def offsets(radius: int) -> npt.NDArray[np.float32]:
    """Offsets (3, S) `[x, y, 1]` of the pixels of a patch from its centre, in row-major order; read-only."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(np.float32).reshape(2, -1)
    out = np.stack([x, y, np.ones_like(x)])
    out.flags.writeable = False
    return out


def warped_patches(image: FloatImage, warp: FloatArray, radius: int) -> npt.NDArray[np.float32]:
    """Gray levels (N, S) at `warp @ [x, y, 1]` (N, 2, 3), interpolated linearly; the image's border is repeated.

    Coordinates are rounded to 1/32 pixel.
    """
    if len(warp) == 0:
        return np.zeros((0, (2 * radius + 1) ** 2), dtype=np.float32)
    uv = (warp.reshape(-1, 3).astype(np.float32) @ offsets(radius)).reshape(len(warp), 2, -1)
    u, v = np.ascontiguousarray(uv[:, 0]), np.ascontiguousarray(uv[:, 1])
    parts = [
        cv2.remap(
            image, u[k : k + _REMAP_ROWS], v[k : k + _REMAP_ROWS], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        for k in range(0, len(warp), _REMAP_ROWS)
    ]
    return np.asarray(parts[0] if len(parts) == 1 else np.concatenate(parts), dtype=np.float32)


def cut_patches(image: FloatImage, centres: FloatArray, radius: int) -> Patches:
    """Patches (N, 2r+3, 2r+3) around sub-pixel points (N, 2), one pixel wider than the template made of them."""
    side = 2 * radius + 3
    return warped_patches(image, shift_warps(centres), radius + 1).reshape(-1, side, side)


def rounded(centres: FloatArray) -> FloatArray:
    """Points rounded to the fraction of a pixel at which `cut_patches` cuts exactly."""
    return np.rint(centres * _SUBPIXELS) / _SUBPIXELS


def templates(wide: Patches) -> Templates:
    """Prepare templates from patches (N, 2r+3, 2r+3) cut by `cut_patches`."""
    n, radius = len(wide), wide.shape[1] // 2 - 1
    flat = (n, (2 * radius + 1) ** 2)
    patch = wide[:, 1:-1, 1:-1].reshape(flat)
    gu = ((wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2).reshape(flat)
    gv = ((wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2).reshape(flat)
    x, y, one = offsets(radius)
    centred = patch - patch.mean(axis=1, keepdims=True, dtype=np.float32)
    basis = np.stack([gu, gv, centred, np.broadcast_to(one, patch.shape), gu * x, gu * y, gv * x, gv * y], axis=1)
    normal = (basis @ basis.transpose(0, 2, 1)).astype(np.float64)
    normal += (_DAMPING * np.einsum("nii->ni", normal) + 1e-6)[:, :, None] * np.eye(_PARAMETERS)
    on_row = normal[:, :_ROW_PARAMETERS, :_ROW_PARAMETERS].copy()
    on_row[:, 1, 1] += _ROW_WEIGHT
    return Templates(
        patch=centred,
        gradient=np.stack([gu, gv], axis=1),
        energy=np.einsum("ns,ns->n", centred, centred),
        inverse=np.linalg.inv(normal).astype(np.float32),
        row_inverse=np.linalg.inv(on_row).astype(np.float32),
    )


def align(
    store: Templates,
    slots: IntArray,
    image: FloatImage,
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
        rows: expected image rows (N,) of the centres, as in the other image of a rectified pair: the expected
            row acts as a prior on the centre, and the warp shears and stretches along rows only.

    Returns:
        The refined warps (N, 2, 3), and the normalised correlation (N,) just before the last step; -1 where the
        template's centre comes too close to the image border for the patch to fit.
    """
    n, radius = len(warp), int(store.patch.shape[1] ** 0.5) // 2
    warp, score = warp.copy(), np.full(n, -1.0)
    active = np.arange(n)
    inverse = store.inverse if rows is None else store.row_inverse
    for _ in range(iterations):
        if len(active) == 0:
            break
        chosen, here = slots[active], warp[active]
        here[:, :, 2] = rounded(here[:, :, 2])
        view = warped_patches(image, here, radius)
        moments = _moments(store, chosen, view, radius)
        score[active] = _correlation(store.energy[chosen], moments, view)
        if rows is not None:
            gain = np.maximum(moments[:, 2] / np.maximum(store.energy[chosen], 1.0), 0.1)
            moments[:, 1] += np.float32(_ROW_WEIGHT) * gain * (here[:, 1, 2] - rows[active]).astype(np.float32)
        size = inverse.shape[1]
        fit = (inverse[chosen] @ moments[:, :size, None])[:, :, 0].astype(np.float64)
        # The image under the current warp is gain * template(step(x)) + offset, so the inverse step is applied.
        fit /= np.maximum(fit[:, 2:3], 0.1)
        shift = np.clip(fit[:, :2], -_MAX_STEP_PX, _MAX_STEP_PX)
        linear = np.zeros((len(active), 4))
        linear[:, : size - 4] = np.clip(fit[:, 4:], -_MAX_LINEAR_STEP, _MAX_LINEAR_STEP)
        warp[active] = _undo(here, shift, linear)
        active = active[np.abs(fit[:, :2]).max(axis=1) > _DONE_PX]
    return warp, np.where(inside(image, warp[:, :, 2], radius + 1), score, -1.0)


def _moments(store: Templates, chosen: IntArray, view: npt.NDArray[np.float32], radius: int) -> npt.NDArray[np.float32]:
    """Products (N, 8) of pixels (N, S) with the derivatives by the parameters; the linear part comes last."""
    size = view.shape[1]
    by_gradient = ((store.gradient[chosen] * view[:, None]).reshape(-1, size) @ offsets(radius).T).reshape(-1, 2, 3)
    out = np.empty((len(view), _PARAMETERS), dtype=np.float32)
    out[:, :2] = by_gradient[:, :, 2]
    out[:, 2] = np.einsum("ns,ns->n", store.patch[chosen], view)
    out[:, 3] = view.sum(axis=1)
    out[:, 4:] = by_gradient[:, :, :2].reshape(-1, 4)
    return out


def _undo(warp: FloatArray, shift: FloatArray, linear: FloatArray) -> FloatArray:
    """`warp` (N, 2, 3) after the inverse of the step `x -> (I + linear) x + shift`, given as (N, 2) and (N, 4)."""
    a, b, c, d = 1.0 + linear[:, 0], linear[:, 1], linear[:, 2], 1.0 + linear[:, 3]
    inverse = np.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2) / (a * d - b * c)[:, None, None]
    out = np.empty_like(warp)
    out[:, :, :2] = warp[:, :, :2] @ inverse
    out[:, :, 2] = warp[:, :, 2] - (out[:, :, :2] @ shift[:, :, None])[:, :, 0]
    return out


def _correlation(
    energy: npt.NDArray[np.float32], moments: npt.NDArray[np.float32], view: npt.NDArray[np.float32]
) -> FloatArray:
    """Normalised correlation (N,) of patches of known energy with pixels (N, S); -1 where either has no contrast."""
    size = view.shape[1]
    other = np.maximum(np.einsum("ns,ns->n", view, view) - moments[:, 3] ** 2 / size, 0.0)
    flat = FLAT_RMS**2 * size
    good = (other > flat) & (energy > flat)
    norm = np.sqrt(np.where(good, other.astype(np.float64) * energy, 1.0))
    return np.where(good, moments[:, 2] / norm, -1.0)


def shift_warps(centres: FloatArray) -> FloatArray:
    """Warps (N, 2, 3) that put the template's centre at image points (N, 2), without rotation or scale."""
    warp = np.zeros((len(centres), 2, 3))
    warp[:, 0, 0] = warp[:, 1, 1] = 1.0
    warp[:, :, 2] = centres
    return warp


def on_peak(pixels: FloatArray, start: FloatArray) -> BoolArray:
    """Mask (N,) of fitted pixels (N, 2) near their start (N, 2); others have left the correlation peak."""
    return np.asarray(np.abs(pixels - start).max(axis=1) <= _MAX_MOVE_PX)


def template_points(warp: FloatArray, offset: FloatArray) -> FloatArray:
    """Image points (N, 2) of template points, given as offsets (N, 2) from the centre, under warps (N, 2, 3)."""
    return np.asarray(warp[:, :, 2] + (warp[:, :, :2] @ offset[:, :, None])[:, :, 0])


def scale_change(warp: FloatArray) -> FloatArray:
    """Scale (N,) of warps (N, 2, 3): the square root of the change of area; tiny where the warp is mirrored."""
    A = warp[:, :, :2]
    return np.sqrt(np.maximum(A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0], 1e-6))
