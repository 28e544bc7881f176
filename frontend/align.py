"""Sub-pixel alignment of many small templates at once, by Gauss-Newton over warp, gain and offset.

The gradients of the template serve in every iteration (inverse-compositional form), so one iteration costs one
interpolation of the image under each template. The warp maps template offsets `[x, y, 1]` to image pixels `[u, v, 1]`.
Reference: Baker & Matthews, Lucas-Kanade 20 years on, IJCV (2004).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from frontend.patches import Patches, bilinear_patches, inside, warped_patches
from vio.geometry.lie import FloatArray
from vio.records import Image

# "shift": translation. "row": also shear and stretch along the row, as the two views of a slanted surface in a
# rectified pair differ. "affine": any linear map of the patch, as between two times.
Warp: TypeAlias = Literal["shift", "row", "affine"]
_PARAMETERS: dict[Warp, int] = {"shift": 4, "row": 6, "affine": 8}

_DONE_PX = 0.03  # the last step is taken; what then remains is a small fraction of it
_MAX_STEP_PX = 1.0
_MAX_LINEAR_STEP = 0.3
_DAMPING = 1e-6  # relative to the diagonal: weakly textured directions move slowly instead of wildly
FLAT_RMS = 1.0  # gray levels; a patch with less contrast matches anything


@dataclass(frozen=True, slots=True)
class Templates:
    """Patches with their gradients, ready to be found again."""

    patch: Patches  # (N, 2r+1, 2r+1)
    basis: npt.NDArray[np.float32]  # (N, 8, (2r+1)^2) derivatives by du, dv, gain, offset, and the linear part by rows


def cut_patches(image: Image, centres: FloatArray, radius: int) -> Patches:
    """Patches (N, 2r+3, 2r+3) around sub-pixel points (N, 2), one pixel wider than the template made of them."""
    return bilinear_patches(image, centres, radius + 1)


def templates(wide: Patches) -> Templates:
    """Prepare templates from patches (N, 2r+3, 2r+3) cut by `cut_patches`."""
    patch = np.ascontiguousarray(wide[:, 1:-1, 1:-1])
    gu = (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2
    gv = (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2
    radius = patch.shape[1] // 2
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(np.float32)
    basis = np.stack([gu, gv, patch, np.ones_like(patch), gu * x, gu * y, gv * x, gv * y], axis=1)
    return Templates(patch, basis.reshape(len(patch), 8, patch.shape[1] ** 2))


def align(
    template: Templates, image: Image, warp: FloatArray, kind: Warp, iterations: int
) -> tuple[FloatArray, FloatArray]:
    """Refine warps (N, 3, 3) from templates to the image, freeing what `kind` names.

    Returns:
        The refined warps (N, 3, 3), and the normalised correlation (N,) under them, -1 where the template's centre
        comes too close to the image border for the patch to fit.
    """
    n, radius, size = len(warp), template.patch.shape[1] // 2, _PARAMETERS[kind]
    warp = warp.copy()
    if n == 0:
        return warp, np.zeros(0)
    used = template.basis[:, :size]
    normal = (used @ used.transpose(0, 2, 1)).astype(np.float64)
    diagonal = np.einsum("nii->ni", normal)
    solver = np.linalg.inv(normal + (_DAMPING * diagonal + 1e-6)[:, :, None] * np.eye(size)).astype(np.float32) @ used
    active = np.arange(n)
    for _ in range(iterations):
        view = warped_patches(image, warp[active], radius).reshape(len(active), -1, 1)
        fit = (solver[active] @ view)[:, :, 0].astype(np.float64)
        # The image under the current warp is gain * template(step(x)) + offset, so the step is undone.
        fit /= np.maximum(fit[:, 2:3], 0.1)
        step = np.tile(np.eye(3), (len(active), 1, 1))
        step[:, :2, 2] = np.clip(fit[:, :2], -_MAX_STEP_PX, _MAX_STEP_PX)
        linear = np.zeros((len(active), 4))
        linear[:, : size - 4] = np.clip(fit[:, 4:], -_MAX_LINEAR_STEP, _MAX_LINEAR_STEP)
        step[:, :2, :2] += linear.reshape(-1, 2, 2)
        warp[active] = warp[active] @ np.linalg.inv(step)
        active = active[np.abs(fit[:, :2]).max(axis=1) > _DONE_PX]
        if len(active) == 0:
            break
    score = correlation(template.patch, warped_patches(image, warp, radius))
    return warp, np.where(inside(image, warp[:, :2, 2], radius + 1), score, -1.0)


def shift_warps(centres: FloatArray) -> FloatArray:
    """Warps (N, 3, 3) that put the template's centre at image points (N, 2), unturned and unscaled."""
    warp = np.tile(np.eye(3), (len(centres), 1, 1))
    warp[:, :2, 2] = centres
    return warp


def correlation(a: Patches, b: Patches) -> FloatArray:
    """Normalised correlation (N,) of patches (N, h, w); -1 where one has no contrast."""
    a = a - a.mean(axis=(1, 2), keepdims=True)
    b = b - b.mean(axis=(1, 2), keepdims=True)
    aa, bb = np.einsum("nhw,nhw->n", a, a), np.einsum("nhw,nhw->n", b, b)
    flat = FLAT_RMS**2 * a.shape[1] * a.shape[2]
    good = (aa > flat) & (bb > flat)
    return np.where(good, np.einsum("nhw,nhw->n", a, b) / np.sqrt(np.where(good, aa * bb, 1.0)), -1.0)
