"""Batched pyramidal Lucas-Kanade in torch, between any pairs of images, on CPU or CUDA.

Each track has the index of its source and target image, so one call tracks in time, from left to right and back.
Pyramid, derivatives, windows and stopping rule are those of OpenCV's `calcOpticalFlowPyrLK`, so that results agree.
Reference: Bouguet, Pyramidal implementation of the Lucas Kanade feature tracker, Intel (2001).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from vio.errors import MissingDependencyError
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, Image, IntArray

if TYPE_CHECKING:
    import torch

Tensor: TypeAlias = "torch.Tensor"

_MIN_EIGENVALUE = 1e-4  # of the mean squared derivative matrix, gray levels over 255 as in OpenCV
_PYRAMID_TAPS = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
_SCHARR_TAPS = (3 / 16, 10 / 16, 3 / 16)


class TorchFlow:
    """Tracks points between images of one size; keeps the device and the settings of the search."""

    def __init__(
        self,
        *,
        window_px: int = 15,
        levels: int = 3,
        iterations: int = 30,
        epsilon_px: float = 0.01,
        device: str = "cpu",
    ) -> None:
        """Set up the tracker.

        Args:
            window_px: odd side of the tracking window.
            levels: image levels coarser than the full one.
            iterations: largest number of iterations per level.
            epsilon_px: step below which a track has converged on its level.
            device: "cpu" or "cuda".

        Raises:
            MissingDependencyError: torch is not installed.
            ConfigError: CUDA is requested but absent.
        """
        try:
            import torch  # noqa: F401
        except ImportError as error:
            raise MissingDependencyError(
                f"tracking with torch needs torch ({error}); install it with: pip install 'stereo-vio[learned]'"
            ) from error
        from .weights import pick_device

        self._device = pick_device(device)
        self._window_px, self._levels = window_px, levels
        self._iterations, self._epsilon_px = iterations, epsilon_px

    def pyramid(self, images: Sequence[Image]) -> list[Tensor]:
        """Levels (K, H, W), finest first, of K images of one size; made once for all tracks that use them."""
        import torch

        stack = torch.from_numpy(np.stack(images).astype(np.float32)).to(self._device)
        levels = [stack]
        for _ in range(self._levels):
            if min(levels[-1].shape[1:]) // 2 <= self._window_px:
                break
            levels.append(_pyrdown(levels[-1]))
        return levels

    def track(
        self, pyramid: list[Tensor], source: IntArray, target: IntArray, points: FloatArray, guess: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Track points from their source to their target images.

        Args:
            pyramid: levels of the images, from `pyramid`.
            source: index of the source image (N,) of each point.
            target: index of the target image (N,) of each point.
            points: pixels (N, 2) in the source images.
            guess: pixels (N, 2) in the target images to start from.

        Returns:
            Pixels (N, 2), and a mask (N,) of those found: textured enough, and not outside the image.
        """
        import torch

        if len(points) == 0:
            return np.zeros((0, 2)), np.zeros(0, dtype=np.bool_)
        with torch.inference_mode():
            start = torch.from_numpy(points.astype(np.float32)).to(self._device)
            place = torch.from_numpy(guess.astype(np.float32)).to(self._device)
            images = torch.from_numpy(source).to(self._device), torch.from_numpy(target).to(self._device)
            found = torch.ones(len(points), dtype=torch.bool, device=self._device)
            top = len(pyramid) - 1
            for level in range(top, -1, -1):
                scale = 0.5**level
                here, textured = self._on_level(pyramid[level], images, start * scale, place * scale)
                inside = _inside(here, pyramid[level], self._window_px)
                found = found & textured & inside if level == 0 else found
                # As in OpenCV, a point that cannot be tracked on a level keeps the result of the coarser level.
                place = torch.where((textured & inside)[:, None], here / scale, place)
            pixels = place.double().cpu().numpy()
            good = found.cpu().numpy()
        return np.asarray(pixels, dtype=np.float64), np.asarray(good, dtype=np.bool_)

    def _on_level(
        self, level: Tensor, images: tuple[Tensor, Tensor], start: Tensor, place: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Gauss-Newton on one level (K, H, W) from pixels (N, 2); return pixels and the mask of textured windows."""
        import torch

        source, target = images
        offset = torch.arange(self._window_px, device=level.device, dtype=torch.float32) - (self._window_px - 1) / 2
        patch = _sample(level, source, start, offset)
        gu, gv = (_sample(slope, source, start, offset) for slope in _derivatives(level))
        a, b, d = (gu * gu).mean(1), (gu * gv).mean(1), (gv * gv).mean(1)
        least = (a + d - torch.sqrt((a - d) ** 2 + 4 * b * b)) / 2
        textured = (least / 255.0**2 * 1024.0 >= _MIN_EIGENVALUE) & (a * d - b * b > 1e-12)
        determinant = torch.where(textured, a * d - b * b, 1.0)
        active = textured.nonzero()[:, 0]
        place = place.clone()
        for _ in range(self._iterations):
            if len(active) == 0:
                break
            difference = _sample(level, target[active], place[active], offset) - patch[active]
            p, q = (difference * gu[active]).mean(1), (difference * gv[active]).mean(1)
            A, B, D = a[active], b[active], d[active]
            step = torch.stack([B * q - D * p, B * p - A * q], dim=1) / determinant[active][:, None]
            place[active] += step
            active = active[(step * step).sum(1) > self._epsilon_px**2]
        return place, textured


def _pyrdown(level: Tensor) -> Tensor:
    """Half of an image stack (K, H, W), by binomial taps with mirrored borders, rounded as 8-bit images are."""
    import torch

    F = torch.nn.functional
    taps = torch.tensor(_PYRAMID_TAPS, device=level.device)
    padded = F.pad(level[:, None], (2, 2, 2, 2), mode="reflect")
    rows = F.conv2d(padded, taps.view(1, 1, 1, 5), stride=(1, 2))
    return torch.floor(F.conv2d(rows, taps.view(1, 1, 5, 1), stride=(2, 1))[:, 0] + 0.5)


def _derivatives(level: Tensor) -> tuple[Tensor, Tensor]:
    """Scharr derivatives along u and v (K, H, W), gray levels per pixel."""
    import torch

    F = torch.nn.functional
    smooth = torch.tensor(_SCHARR_TAPS, device=level.device)
    slope = torch.tensor((-0.5, 0.0, 0.5), device=level.device)
    padded = F.pad(level[:, None], (1, 1, 1, 1), mode="reflect")
    gu = F.conv2d(F.conv2d(padded, slope.view(1, 1, 1, 3)), smooth.view(1, 1, 3, 1))
    gv = F.conv2d(F.conv2d(padded, smooth.view(1, 1, 1, 3)), slope.view(1, 1, 3, 1))
    return gu[:, 0], gv[:, 0]


def _sample(level: Tensor, image: Tensor, centre: Tensor, offset: Tensor) -> Tensor:
    """Values (N, S) of windows around centres (N, 2) in images (N,) of a stack (K, H, W), interpolated linearly."""
    import torch

    height, width = level.shape[1:]
    base = torch.floor(centre)
    fraction = centre - base
    column = base[:, :1] + offset
    row = base[:, 1:] + offset
    flat = level.reshape(-1)

    def value(du: int, dv: int) -> Tensor:
        u = (column + du).long().clamp(0, width - 1)
        v = (row + dv).long().clamp(0, height - 1)
        return flat[(image[:, None, None] * height + v[:, :, None]) * width + u[:, None, :]]

    a, b = fraction[:, 0, None, None], fraction[:, 1, None, None]
    upper = value(0, 0) * (1 - a) + value(1, 0) * a
    lower = value(0, 1) * (1 - a) + value(1, 1) * a
    return (upper * (1 - b) + lower * b).reshape(len(centre), -1)


def _inside(place: Tensor, level: Tensor, window_px: int) -> Tensor:
    """Mask (N,) of finite pixels (N, 2) whose window overlaps the image."""
    import torch

    height, width = level.shape[1:]
    margin = (window_px - 1) / 2
    u, v = place[:, 0], place[:, 1]
    touching = (u >= -margin) & (u < width + margin) & (v >= -margin) & (v < height + margin)
    return touching & torch.isfinite(place).all(dim=1)
