"""Corners of a blurred image, by alignment of the board's print, which is blurred as much.

A corner's saddle point moves under blur, towards or from what else is printed near it, and the
window that `cv2.cornerSubPix` needs then holds other edges. So the print around the corner is
drawn as its neighbours' homography shows it, blurred, and moved, turned and stretched until it
agrees with the image.
Reference: Baker & Matthews, Lucas-Kanade 20 years on: a unifying framework (2004), the inverse
compositional algorithm, with gain and offset of the gray values.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity, Tolerance
from vio.numerics.robust import median
from vio.records import Image, IntArray
from vio.targets.description import Target
from vio.targets.homography import mapped
from vio.targets.printing import printed_light


class _PrintRules(NamedTuple):
    """How the blurred print is drawn."""

    module_texels: int = 8  # a module
    max_texture_px: Capacity[int] = 4096
    # of a tag or square: paper around the print, which is known to be light
    margin_share: float = 0.1
    finer_samples: int = 2  # samples along a side of a pixel, where blur is below
    fine_below_px: float = 1.8
    apron_sigmas: float = 3.0
    corners_at_once: Capacity[int] = 64  # corners that are drawn in one image


_PRINT = _PrintRules()


class _WindowRules(NamedTuple):
    """The window that is aligned, and its alignment."""

    min_half_px: int = 6  # half the side of the window that is aligned
    max_half_px: int = 24
    half_share: float = 0.5  # of a tag's or square's side
    half_sigmas: float = 2.0
    weight_share: float = 0.6  # of the half side: standard deviation of the weights
    max_steps: Tolerance[int] = 12
    max_step_px: float = 1.5
    converged_px: Tolerance[float] = 1e-3
    min_known_share: float = 0.3  # of a window's weight
    tried_corners: int = 12


_WINDOW = _WindowRules()
_BLURS_PX = (0.7, 1.4, 2.0, 2.8, 4.0, 5.6)  # that are tried


class PrintAligner:
    """Aligns the print of one board around its corners."""

    def __init__(self, target: Target) -> None:
        self._target = target
        self._points = target.points_m
        module = target.size_m / (10 if target.kind == "aprilgrid" else 16)
        self._margin_m = _PRINT.margin_share * target.size_m
        longest = max(target.extent_m) + 2 * self._margin_m
        self._texels = min(
            _PRINT.module_texels / module, _PRINT.max_texture_px / longest
        )  # a metre
        self._light = printed_light(target, self._texels, self._margin_m).astype(np.float32)

    def aligned(
        self, image: Image, ids: IntArray, uv: FloatArray, H: FloatArray, sigma_px: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return pixels (K, 2) of corners that homographies (K, 3, 3) predict at `uv` (K, 2), and
        the correlation (K,) of image and print there.

        Args:
            image: (H, W) gray values.
            ids: (K,) rows of `Target.points_m`.
            uv: predicted pixels.
            H: from the board's plane, metres, to pixels.
            sigma_px: standard deviation of the image's blur.
        """
        out = uv.copy()
        like = np.zeros(len(ids))
        halves = self._half_sides(uv, H, ids, sigma_px)
        for half in np.unique(halves).tolist():
            rows = np.flatnonzero(halves == half)
            for part in np.array_split(rows, -(-len(rows) // _PRINT.corners_at_once)):
                out[part], like[part] = self._aligned(image, uv[part], H[part], half, sigma_px)
        return out, like

    def blur_px(self, image: Image, ids: IntArray, uv: FloatArray, H: FloatArray) -> float:
        """Return the standard deviation in pixels of an image's blur: that by which the print
        agrees best with the image around corners (K,), see `aligned`.
        """
        few = np.linspace(0, len(ids) - 1, min(len(ids), _WINDOW.tried_corners)).astype(int)
        best = -1.0
        found = _BLURS_PX[0]
        for sigma in _BLURS_PX:
            agreement = median(self.aligned(image, ids[few], uv[few], H[few], sigma)[1])
            if agreement < best:
                break
            best = agreement
            found = sigma
        return found

    def _half_sides(
        self, uv: FloatArray, H: FloatArray, ids: IntArray, sigma_px: float
    ) -> IntArray:
        """Half the side (K,) of each corner's window, pixels, in steps of two."""
        step = self._target.size_m
        around = self._points[ids][:, None] + step * np.array(
            [
                [1.0, 0],
                [-1, 0],
                [0, 1],
                [0, -1],
            ]
        )
        side = np.linalg.norm(mapped(H, around) - uv[:, None], axis=2).mean(axis=1)
        half = np.maximum(_WINDOW.half_share * side, _WINDOW.half_sigmas * sigma_px)
        return np.asarray(
            2 * np.rint(0.5 * np.clip(half, _WINDOW.min_half_px, _WINDOW.max_half_px)), np.int64
        )

    def _aligned(
        self, image: Image, uv: FloatArray, H: FloatArray, half: int, sigma_px: float
    ) -> tuple[FloatArray, FloatArray]:
        import cv2

        model, weight = self._drawn(uv, H, half, sigma_px)
        across = model[:, 1:-1, 2:] - model[:, 1:-1, :-2]
        down = model[:, 2:, 1:-1] - model[:, :-2, 1:-1]
        D_u = 0.5 * across.reshape(len(uv), -1)
        D_v = 0.5 * down.reshape(len(uv), -1)
        light = model[:, 1:-1, 1:-1].reshape(len(uv), -1)
        weight = weight[:, 1:-1, 1:-1].reshape(len(uv), -1)
        steps = np.arange(-half, half + 1, dtype=np.float64)
        window = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        x, y = (window / half).T
        moves = [D_u, D_v, D_u * x, D_u * y, D_v * x, D_v * y]
        A = np.stack([*moves, light, np.ones_like(light)], axis=2)
        WA = A * weight[..., None]
        normal = np.swapaxes(WA, 1, 2) @ A + 1e-9 * np.eye(A.shape[2])
        at = uv.copy()
        shape = np.tile(np.eye(2), (len(uv), 1, 1))
        values = np.zeros_like(light)
        limit = max(0.5 * half, 1.0)
        for _ in range(_WINDOW.max_steps):
            place = (at[:, None] + window @ np.swapaxes(shape, 1, 2)).astype(np.float32)
            sampled = cv2.remap(
                image,
                np.ascontiguousarray(place[..., 0]),
                np.ascontiguousarray(place[..., 1]),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            values = np.asarray(sampled, dtype=np.float64)
            found = np.linalg.solve(normal, np.einsum("ksp,ks->kp", WA, values)[..., None])[..., 0]
            # The image is the print moved by d: its values are gain (light + d . gradient).
            gain = np.where(np.abs(found[:, 6]) < 1e-3, 1e-3, found[:, 6])
            step = np.clip(found[:, :6] / gain[:, None], -_WINDOW.max_step_px, _WINDOW.max_step_px)
            at = np.clip(at - step[:, :2], uv - limit, uv + limit)
            shape = shape - step[:, 2:].reshape(-1, 2, 2) / half
            if float(np.abs(step).max(initial=0.0)) < _WINDOW.converged_px:
                break
        return at, _correlation(values, light, weight)

    def _drawn(
        self, uv: FloatArray, H: FloatArray, half: int, sigma_px: float
    ) -> tuple[FloatArray, FloatArray]:
        """The print around corners as the image shows it, (K, S, S) with one pixel more on each
        side of the window, and the weights of its pixels.
        """
        import cv2

        finer = _PRINT.finer_samples if sigma_px < _PRINT.fine_below_px else 1
        apron = int(np.ceil(_PRINT.apron_sigmas * sigma_px))
        reach = half + 1 + apron
        count = 2 * reach + 1
        fine = (np.arange(finer * count) - 0.5 * (finer * count - 1)) / finer
        offset = np.stack(np.meshgrid(fine, fine), axis=-1).reshape(-1, 2)
        inverse = np.asarray(np.linalg.inv(H), dtype=np.float64)
        board = mapped(inverse, uv[:, None] + offset)
        texel = ((board + self._margin_m) * self._texels - 0.5).reshape(-1, finer * count, 2)
        texel = np.clip(texel, -1e4, 3e4).astype(np.float32)
        rows, cols = self._light.shape
        drawn = cv2.remap(
            self._light,
            np.ascontiguousarray(texel[..., 0]),
            np.ascontiguousarray(texel[..., 1]),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        below_end = (texel[..., 0] < cols) & (texel[..., 1] < rows)
        known = (texel > -0.5).all(axis=2) & below_end
        stack = np.dstack([drawn, known.astype(np.float32)])
        blurred = cv2.GaussianBlur(
            stack, (0, 0), finer * sigma_px, borderType=cv2.BORDER_REPLICATE
        ).reshape(len(uv), finer * count, finer * count, 2)
        inner = blurred[:, finer * apron : finer * (count - apron)]
        inner = inner[:, :, finer * apron : finer * (count - apron)]
        parts = [inner[:, i::finer, k::finer] for i in range(finer) for k in range(finer)]
        coarse = sum(parts[1:], start=parts[0]) / finer**2
        steps = np.arange(-half - 1, half + 2)
        near = np.exp(-0.5 * np.square(steps / (_WINDOW.weight_share * half)))
        weight = near[:, None] * near / near.sum() ** 2 * (coarse[..., 1] > 0.98)
        return np.asarray(coarse[..., 0], dtype=np.float64), weight


def _correlation(values: FloatArray, light: FloatArray, weight: FloatArray) -> FloatArray:
    """Normalised correlation (K,) of gray values and print (K, S) by weights (K, S)."""
    known = weight.sum(axis=1)
    total = np.maximum(known, 1e-9)[:, None]
    a = values - (values * weight).sum(axis=1, keepdims=True) / total
    b = light - (light * weight).sum(axis=1, keepdims=True) / total
    length = np.sqrt((weight * a**2).sum(axis=1) * (weight * b**2).sum(axis=1))
    like = (weight * a * b).sum(axis=1) / np.maximum(length, 1e-9)
    return np.where(known > _WINDOW.min_known_share, like, 0.0)
