"""Each limit of matching, fusing and drawing surfaces, from both sides."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from vio.dense import preview, surface
from vio.dense.stereo_depth import StereoMatcher, slant
from vio.dense.surface import Mesh, extract_surface
from vio.dense.voxel_grid import VoxelGrid
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera

Says = Callable[[float], bool]
CAMERA = StereoCamera(400.0, 400.0, 160.0, 60.0, 0.1, 320, 120)
VOXEL_M = 0.05


# Matching


def _texture(seed: int, blur_px: float = 0.8) -> FloatArray:
    noise = np.random.default_rng(seed).integers(0, 256, (120, 360)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), blur_px) - 128.0
    return np.clip(1.8 * smooth, -128.0, 127.0).astype(np.float64) + 128.0


def _moved(image: FloatArray, right_px: float) -> FloatArray:
    u, v = np.meshgrid(np.arange(360, dtype=np.float32), np.arange(120, dtype=np.float32))
    moved = cv2.remap(
        image.astype(np.float32),
        u - np.float32(right_px),
        v,
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REFLECT,
    )
    return moved.astype(np.float64)


def _disparity(left: FloatArray, right: FloatArray) -> FloatArray:
    """What is matched, pixels, 0 where nothing is."""
    gray = [np.clip(image[:, :320], 0, 255).astype(np.uint8) for image in (left, right)]
    depth = StereoMatcher(CAMERA, 320).depth(gray[0], gray[1])
    scale = CAMERA.fu * CAMERA.baseline_m
    return np.where(depth > 0, scale / np.maximum(depth, 1e-3), 0.0)


def _island_is_kept(side_px: int, nearer_px: float) -> bool:
    """Whether a square is matched that is nearer than its background at 8 pixels."""
    right = _texture(1)
    left = _moved(right, 8.0)
    nearer = _texture(2)
    rows = slice(50, 50 + side_px)
    left[rows, 150 : 150 + side_px] = nearer[rows, 150 : 150 + side_px]
    first = 142 - int(np.ceil(nearer_px))
    moved = _moved(nearer, -8.0 - nearer_px)
    right[rows, first : first + side_px] = moved[rows, first : first + side_px]
    found = _disparity(left, right)[rows, 150 : 150 + side_px]
    return bool((found > 8.0 + nearer_px / 2).mean() > 0.4)


def _matched(contrast: float) -> tuple[float, float]:
    """Shares of pixels that are matched, and rightly, at a disparity of 8 pixels, of a texture in
    noise of 10 gray values.
    """
    texture = 128.0 + contrast * (_texture(2, 2.0) - 128.0) / 128.0
    noise = 10.0 * np.random.default_rng(0).normal(size=(2, 120, 320))
    found = _disparity(texture[:, :320] + noise[0], texture[:, 8:328] + noise[1])[:, 60:300]
    return float((found > 0).mean()), float((np.abs(found - 8.0) < 1.0).mean())


# The direction of a surface


def _direction_is_known(half_width_px: int) -> bool:
    """Whether the direction of a slanting strip is measured in its middle."""
    u = (np.arange(320) - CAMERA.cu) / CAMERA.fu
    depth = np.tile(1.0 / (0.5 + 0.5 * u), (120, 1))
    depth[:, : 160 - half_width_px] = 0.0
    depth[:, 160 + half_width_px + 1 :] = 0.0
    return bool(slant(depth.astype(np.float32), CAMERA)[60, 160] < 0.9)


def _off_by_ripple(period_px: float) -> float:
    """How much a wall facing the camera appears turned that has a ripple."""
    phase = 2.0 * np.pi * np.arange(320) / period_px
    depth = np.tile(1.0 / (0.5 + 0.02 * np.sin(phase)), (120, 1)).astype(np.float32)
    return float(1.0 - slant(depth, CAMERA)[60, 40:280].min())


def _least_slant() -> float:
    """Of a floor 1 m below, up to the horizon."""
    v = (np.arange(120) - 20) / CAMERA.fv
    depth = np.where(v > 1e-3, 1.0 / np.maximum(v, 1e-3), 0.0)
    camera = StereoCamera(400.0, 400.0, 160.0, 20.0, 0.1, 320, 120)
    wide = np.repeat(depth[:, None], 320, axis=1).astype(np.float32)
    return float(slant(wide, camera)[30:, 160].min())


# Fusing


def _fused(depths_m: list[float]) -> VoxelGrid:
    """A wall, by images at distances."""
    grid = VoxelGrid(VOXEL_M)
    for depth_m in depths_m:
        depth = np.full((120, 320), depth_m, np.float32)
        grid.fuse(depth, np.full((120, 320), 128, np.uint8), CAMERA, np.eye(4), 4.0)
    return grid


def _seen_depth() -> float:
    """How thick a layer before and behind a wall is sampled, voxels."""
    with _fused([1.0]) as grid:
        seen = set[int]()
        for first, block in grid.padded():
            inner = block["seen"][1:-1, 1:-1, 1:-1]
            seen |= {int(first[2] + k) for k in np.nonzero(inner)[2]}
    return float(max(seen) - min(seen))


def _wall_m(images: int) -> float:
    """Where a wall is said to be by many images at 1 m and some later ones a voxel behind it."""
    with _fused([1.0] * 150 + [1.0 + VOXEL_M] * images) as grid:
        return float(np.median(extract_surface(grid).vertices[:, 2]))


def _has_surface(images: int) -> bool:
    with _fused([1.0] * images) as grid:
        return len(extract_surface(grid).vertices) > 0


def _piece_is_kept(triangles: int) -> bool:
    at = np.arange(triangles + 2)
    points = np.column_stack([0.5 * at, at % 2, 0 * at]).astype(np.float32)
    rows = np.stack([at[:-2], at[1:-1], at[2:]], axis=1)
    colours = np.zeros((len(points), 3), np.uint8)
    return len(surface._tidied(points, colours, rows).triangles) > 0


# Drawing


def _is_drawn(away: float) -> bool:
    """Whether a square is, seen from above and behind, that faces away by so much."""
    axes = preview._view(np.array([0.0, 1.0]))
    p = np.random.default_rng(0).uniform(-1.0, 1.0, (4000, 2)) @ axes[:2]
    normal = np.array([np.sqrt(1.0 - away**2), 0.0, away]) @ axes
    mesh = Mesh(
        p.astype(np.float32),
        np.tile(normal, (len(p), 1)).astype(np.float32),
        np.zeros((len(p), 3), np.uint8),
        np.zeros((0, 3), np.uint32),
    )
    path = np.array([[0.0, 0.0, 0.0], [0.0, 1e-3, 0.0]])
    image = preview.preview(mesh, path, np.eye(3), 0.01)
    return bool((image == 0).all(axis=2).sum() > 1000)


def _lines(y_m: float, z_m: float, gray: FloatArray) -> tuple[FloatArray, FloatArray]:
    x = np.linspace(-1.0, 1.0, len(gray))
    p = np.column_stack([x, np.full(len(x), y_m), np.full(len(x), z_m)])
    return p, np.repeat(gray[:, None], 3, axis=1)


def _focal_length() -> float:
    """Of a picture, in its widths, by two equal lines of which one is a metre farther away."""
    near, dark = _lines(-0.3, 0.0, np.full(500, 0.0))
    far, light = _lines(0.3, 1.0, np.full(500, 100.0))
    p = np.concatenate([near, far])
    image = preview._splat(p, np.concatenate([dark, light]), np.full(1000, 1e-6), 1000)[..., 0]
    widths = [float(np.ptp(np.nonzero(image == gray)[1])) for gray in (0, 100)]
    return 1.0 / (2.0 * (1.0 / widths[1] - 1.0 / widths[0])) / image.shape[1]


def _share_in_picture() -> float:
    """Of a line that is as long as the picture allows, and is the lighter the farther aside."""
    line, gray = _lines(0.0, 0.0, 200.0 * np.abs(np.linspace(-1.0, 1.0, 5000)))
    order = np.argsort(-gray[:, 0])  # the last one, which is to be in the picture, is in its middle
    image = preview._splat(line[order], gray[order], np.full(5000, 1e-6), 1)[..., 0]
    return float(image[image <= 200].max()) / 200.0


LIMITS: dict[str, tuple[Says, float, float]] = {
    "match: speckle": (lambda n: _island_is_kept(int(n), 8.0), 15, 16),
    "match: step in a surface": (lambda x: not _island_is_kept(11, x), 3.2, 3.8),
    "match: by chance": (lambda x: _matched(0.0)[0] < x, 0.08, 0.14),
    "match: block": (lambda x: _matched(35.0)[1] < x, 0.41, 0.51),
    "direction: steps": (lambda n: _direction_is_known(int(n)), 11, 12),
    "direction: mean": (lambda n: _off_by_ripple(n) < 0.01, 8, 9),
    "direction: grazing": (lambda x: _least_slant() < x, 0.045, 0.055),
    "fuse: layer": (lambda x: _seen_depth() < x, 6.5, 7.5),
    "fuse: changed": (lambda n: _wall_m(int(n)) > 1.0 + 0.5 * VOXEL_M, 40, 50),
    "fuse: images": (lambda n: _has_surface(int(n)), 2, 3),
    "mesh: piece": (lambda n: _piece_is_kept(int(n)), 99, 100),
    "picture: faces away": (lambda x: not _is_drawn(x), 0.09, 0.11),
    "picture: focal length": (lambda x: _focal_length() < x, 1.0, 1.2),
    "picture: share": (lambda x: _share_in_picture() < x, 0.97, 0.99),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_surfaces(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
