"""Images of a board with exact corners, for tests and for measuring the detector.

A pixel's value is the mean of the board over its area, by rays through a finer grid of pixels; then
come blur, noise and rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vio.geometry.distortion import CameraModel, project_point, unproject_pixel
from vio.geometry.lie import FloatArray, se3_inverse, transform_points
from vio.records import Image
from vio.targets.description import Target
from vio.targets.printing import printed_light

DARK = 35.0  # gray values of print, paper and background
LIGHT = 210.0
AROUND = 120.0
_TEXELS = 12  # in a module, so that its edges are those of texels
_FINER = 3  # rays along a side of a pixel


@dataclass(frozen=True, slots=True)
class Exposure:
    """How an image is degraded."""

    blur_px: float = 0.7  # standard deviation
    noise: float = 3.0  # standard deviation, gray values
    seed: int = 0


SHARP = Exposure()


def texture(target: Target) -> tuple[FloatArray, float, float]:
    """Return the board as an image, its texels per metre, and the margin around it in metres."""
    module = target.size_m / 10
    if target.kind != "aprilgrid":
        module = target.size_m / 16
    scale = _TEXELS / module
    margin = 0.5 * target.size_m
    light = printed_light(target, scale, margin)
    return np.where(light > 0, LIGHT, DARK), scale, margin


def bow_depth(bow: FloatArray, target: Target, points_m: FloatArray) -> FloatArray:
    """Return the depth (N,) in metres of points (N, 2) of a board that is bent.

    The bow (2,) is the height of the middle over the edges, along x and along y, metres.
    """
    half = 0.5 * np.array(target.extent_m)
    relative = (points_m - half) / half
    return np.asarray((1 - relative**2) @ bow)


def board_points(target: Target, bow: FloatArray | None = None) -> FloatArray:
    """Return the corners (N, 3) of a board in its frame, metres."""
    flat = target.points_m
    if bow is None:
        depth = np.zeros(len(flat))
    else:
        depth = bow_depth(bow, target, flat)
    return np.column_stack([flat, depth])


class BoardRenderer:
    """Renders a board by one camera."""

    def __init__(self, target: Target, camera: CameraModel) -> None:
        self.target = target
        self.camera = camera
        self._texture = texture(target)
        steps = (np.arange(_FINER) - 0.5 * (_FINER - 1)) / _FINER
        u = (np.arange(camera.width)[:, None] + steps).ravel()
        v = (np.arange(camera.height)[:, None] + steps).ravel()
        grid = np.stack(np.meshgrid(u, v), axis=-1)
        self._rays, self._valid = unproject_pixel(camera, grid)

    def render(
        self, T_cam_board: FloatArray, exposure: Exposure = SHARP, bow: FloatArray | None = None
    ) -> Image:
        """Return the image (H, W) of a board at a pose (4, 4)."""
        import cv2

        image, scale, margin = self._texture
        T_board_cam = se3_inverse(T_cam_board)
        rays = self._rays @ T_board_cam[:3, :3].T
        start = T_board_cam[:3, 3]
        depth = np.zeros(rays.shape[:2])
        toward = np.where(np.abs(rays[..., 2]) < 1e-9, 1e-9, rays[..., 2])
        for _ in range(1 if bow is None else 3):
            distance = (depth - start[2]) / toward
            at = start[:2] + distance[..., None] * rays[..., :2]
            if bow is not None:
                depth = bow_depth(bow, self.target, at.reshape(-1, 2)).reshape(depth.shape)
        texel = (at + margin) * scale - 0.5
        seen = self._valid & (distance > 0)
        texel = np.where(seen[..., None], np.clip(texel, -9, 30_000), -9).astype(np.float32)
        fine = cv2.remap(
            image.astype(np.float32),
            np.ascontiguousarray(texel[..., 0]),
            np.ascontiguousarray(texel[..., 1]),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=AROUND,
        )
        c = self.camera
        values = fine.reshape(c.height, _FINER, c.width, _FINER).mean(axis=(1, 3))
        if exposure.blur_px > 0:
            values = cv2.GaussianBlur(values, (0, 0), exposure.blur_px)
        rng = np.random.default_rng(exposure.seed)
        values = values + exposure.noise * rng.standard_normal(values.shape)
        return np.clip(np.rint(values), 0, 255).astype(np.uint8)

    def corners(
        self, T_cam_board: FloatArray, bow: FloatArray | None = None
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Return the exact pixels (N, 2) of all corners, and whether each (N,) is in the image."""
        p_cam = transform_points(T_cam_board, board_points(self.target, bow))
        uv, valid = project_point(self.camera, p_cam)
        c = self.camera
        below_end = (uv[:, 0] < c.width - 0.5) & (uv[:, 1] < c.height - 0.5)
        inside = (uv > -0.5).all(axis=1) & below_end
        return uv, valid & inside
