"""The compiled loops once more in NumPy, many at a time: slower and, for an eye used to arrays, easier to check."""

from __future__ import annotations

import numpy as np

from frontend.align import FLAT_RMS, Templates, offsets
from vio.geometry.lie import FloatArray, circledot, se3_exp
from vio.geometry.stereo import StereoCamera, project, z_D_p_cam

ROW_WEIGHT = (4.0 / 0.3) ** 2  # gray levels and pixels: those of `frontend.align`


def sampled(image: FloatArray, warp: FloatArray, radius: int) -> FloatArray:
    """Gray levels (N, S) at `warp @ [x, y, 1]` (N, 2, 3), interpolated linearly; the image's border is repeated."""
    x, y = offsets(radius).astype(np.float64)
    u, v = np.moveaxis(warp @ np.stack([x, y, np.ones_like(x)]), 1, 0)
    u, v = np.clip(u, 0, image.shape[1] - 1), np.clip(v, 0, image.shape[0] - 1)
    i, j = np.minimum(u.astype(int), image.shape[1] - 2), np.minimum(v.astype(int), image.shape[0] - 2)
    a, b = u - i, v - j
    above = (1 - a) * image[j, i] + a * image[j, i + 1]
    below = (1 - a) * image[j + 1, i] + a * image[j + 1, i + 1]
    out: FloatArray = (1 - b) * above + b * below
    return out


def prepared(wide: FloatArray) -> Templates:
    """Templates of patches (N, 2r+3, 2r+3), in double precision."""
    n, radius = len(wide), wide.shape[1] // 2 - 1
    flat = (n, (2 * radius + 1) ** 2)
    patch = wide[:, 1:-1, 1:-1].reshape(flat)
    gu = ((wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2).reshape(flat)
    gv = ((wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2).reshape(flat)
    x, y = offsets(radius).astype(np.float64)
    centred = patch - patch.mean(axis=1, keepdims=True)
    basis = np.stack([gu, gv, centred, np.ones(flat), gu * x, gu * y, gv * x, gv * y], axis=1)
    normal = basis @ basis.transpose(0, 2, 1)
    normal += (1e-6 * np.einsum("nii->ni", normal) + 1e-6)[:, :, None] * np.eye(8)
    on_row = normal[:, :6, :6].copy()
    on_row[:, 1, 1] += ROW_WEIGHT
    energy = np.sum(centred**2, axis=1)
    columns = (centred, np.stack([gu, gv], axis=1), energy, np.linalg.inv(normal), np.linalg.inv(on_row))
    return Templates(*columns)  # type: ignore[arg-type]  # float64


def aligned(
    store: Templates, image: FloatArray, warp: FloatArray, iterations: int, rows: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Warps (N, 2, 3) and correlations (N,) of `frontend.align.align`, all templates in step."""
    size, radius = store.patch.shape[1], int(store.patch.shape[1] ** 0.5) // 2
    x, y = offsets(radius).astype(np.float64)
    warp, score, active = warp.copy(), np.full(len(warp), -1.0), np.arange(len(warp))
    inverse = store.inverse if rows is None else store.row_inverse
    for _ in range(iterations):
        view, here = sampled(image, warp[active], radius), warp[active]
        patch, energy = store.patch[active], store.energy[active]
        gu, gv = np.moveaxis(store.gradient[active] * view[:, None], 1, 0)
        terms = [gu, gv, patch * view, view, gu * x, gu * y, gv * x, gv * y]
        moments = np.stack([term.sum(axis=1) for term in terms], axis=1)
        other = np.sum((view - view.mean(axis=1, keepdims=True)) ** 2, axis=1)
        flat = (other <= FLAT_RMS**2 * size) | (energy <= FLAT_RMS**2 * size)
        score[active] = np.where(flat, -1.0, moments[:, 2] / np.sqrt(np.where(flat, 1.0, other * energy)))
        if rows is not None:
            gain = np.maximum(moments[:, 2] / np.maximum(energy, 1.0), 0.1)
            moments[:, 1] += ROW_WEIGHT * gain * (here[:, 1, 2] - rows[active])
        parameters = inverse.shape[1]
        fit = np.zeros((len(active), 8))
        fit[:, :parameters] = (inverse[active] @ moments[:, :parameters, None])[:, :, 0]
        fit /= np.maximum(fit[:, 2:3], 0.1)
        step = np.eye(3) + np.zeros((len(active), 1, 1))
        step[:, :2, 2] = np.clip(fit[:, :2], -1.0, 1.0)
        step[:, :2, :2] += np.clip(fit[:, 4:], -0.3, 0.3).reshape(-1, 2, 2)
        warp[active] = here @ np.linalg.inv(step)
        active = active[np.abs(fit[:, :2]).max(axis=1) > 0.05]
    return warp, score


def moved_errors(camera: StereoCamera, T: FloatArray, p_prev: FloatArray, pixels: FloatArray) -> FloatArray:
    """Distances (..., N) between points (N, 3) moved by motions (..., 4, 4) and left pixels (N, 2)."""
    p = p_prev @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]
    ahead = p[..., 2] > 0.05
    distance = np.linalg.norm(project(camera, np.where(ahead[..., None], p, 1.0))[..., :2] - pixels, axis=-1)
    return np.where(ahead, distance, np.inf)


def gauss_newton(
    camera: StereoCamera,
    T: FloatArray,
    p_prev: FloatArray,
    pixels: FloatArray,
    weight: FloatArray,
    *,
    iterations: int,
    free: slice,
) -> FloatArray:
    """Motions (H, 4, 4), each refined on its own points (H, K, 3), pixels (H, K, 2) and weights (H, K)."""
    for _ in range(iterations):
        p = p_prev @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        ahead = p[..., 2] > 0.05
        p = np.where(ahead[..., None], p, np.array([0.0, 0.0, 1.0]))
        w = np.where(ahead, weight, 0.0)
        residual = pixels - project(camera, p)[..., :2]
        pixel_D_xi = z_D_p_cam(camera, p)[..., :2, :] @ circledot(p)[..., :3, free]
        n = pixel_D_xi.shape[-1]
        J = (pixel_D_xi * w[..., None, None]).reshape(len(T), -1, n)
        r = (residual * w[..., None]).reshape(len(T), -1, 1)
        A = np.swapaxes(J, 1, 2) @ J
        A = A + (1e-4 * np.trace(A, axis1=1, axis2=2)[:, None, None] / n + 1e-9) * np.eye(n)
        xi = np.zeros((len(T), 6))
        xi[:, free] = np.clip(np.linalg.solve(A, np.swapaxes(J, 1, 2) @ r)[..., 0], -5.0, 5.0)
        T = se3_exp(xi) @ T
    return T
