"""Each limit of aligning a blurred print, of drawing one, and of starting a lens, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pytest

from tests.board_views import GRID
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp
from vio.targets import blurred, start
from vio.targets.blurred import PrintAligner, _correlation
from vio.targets.rendering import SHARP, BoardRenderer, Exposure, texture
from vio.targets.start import board_pose, new_camera, one_camera
from vio.targets.views import Sightings

Says = Callable[[float], bool]
FACING = new_camera("radtan", 4, 200.0, (376, 240))
CORNER = 60  # in the middle of the board


# Blurred prints


def _aligner() -> Any:
    return PrintAligner(GRID)


def _seen(scale_px: float, corner: int = CORNER) -> tuple[FloatArray, FloatArray]:
    """A corner's pixel (1, 2) and homography, where a metre of the board is so many pixels."""
    H = np.diag([scale_px, scale_px, 1.0])
    H[:2, 2] = 200.0 - scale_px * GRID.points_m[corner]
    return np.array([[200.0, 200.0]]), H[None]


def _half_window(side_px: float, sigma_px: float = 0.7) -> int:
    """Of a corner of a tag of a size."""
    uv, H = _seen(side_px / GRID.size_m)
    return int(_aligner()._half_sides(uv, H, np.array([CORNER]), sigma_px)[0])


def _weight_at_edge() -> float:
    """Weight of a pixel at the edge of a window, over that in its middle."""
    half = 20
    weight = _aligner()._drawn(*_seen(1000.0), half, 1.0)[1][0]
    return float(weight[half + 1, 1] / weight[half + 1, half + 1])


def _known_share() -> float:
    """How far the paper beside the outermost tag is known, in sides of the tag."""
    weight = _aligner()._drawn(*_seen(400.0 / GRID.size_m, 0), 60, 0.2)[1][0]
    return float((weight[61, :61] > 0).sum()) / 400.0


def _drawn(sigma_px: float) -> int:
    """Samples along a side of what is drawn of a window of 17 pixels."""
    sides: list[int] = []
    remap = cv2.remap

    def recorded(image: Any, x: FloatArray, *more: Any, **options: Any) -> Any:
        sides.append(x.shape[1])
        return remap(image, x, *more, **options)

    with patch.object(cv2, "remap", recorded):
        _aligner()._drawn(*_seen(300.0), 8, sigma_px)
    return sides[0]


def _beside_window(sigma_px: float) -> int:
    """Pixels that are drawn beside a window, and one more, as its blur takes from there."""
    return (_drawn(sigma_px) - 19) // 2


def _module_texels() -> float:
    """Of a tag's module: the shortest run of one colour in the print."""
    changes = np.abs(np.diff(_aligner()._light, axis=1))
    return float(min(np.diff(np.flatnonzero(row)).min(initial=999) for row in changes))


T_CAM_BOARD = se3_from_parts(so3_exp([0.1, -0.15, 0.1]), [-0.33, -0.3, 0.7])


def _renderer() -> BoardRenderer:
    return BoardRenderer(GRID, FACING)


def _aligned(blur_px: float = 2.0) -> tuple[Any, ...]:
    """Image, corners, their exact pixels and homographies, of a blurred board."""
    renderer = _renderer()
    image = renderer.render(T_CAM_BOARD, Exposure(blur_px, 1.0))
    uv, is_seen = renderer.corners(T_CAM_BOARD)
    seen = np.flatnonzero(is_seen)
    K = np.array([[FACING.fu, 0, FACING.cu], [0, FACING.fv, FACING.cv], [0, 0, 1]])
    H = K @ T_CAM_BOARD[:3, [0, 1, 3]]
    return image, seen, uv[seen], np.tile(H, (len(seen), 1, 1))


def _found_blur_px(blur_px: float) -> float:
    return float(_aligner().blur_px(*_aligned(blur_px)))


def _corners_tried() -> int:
    counts: list[int] = []

    def aligned(image: Any, ids: Any, *more: Any) -> tuple[None, FloatArray]:
        counts.append(len(ids))
        return None, np.ones(1)

    aligner = _aligner()
    with patch.object(aligner, "aligned", aligned):
        aligner.blur_px(*_aligned())
    return counts[0]


def _first_step_px() -> float:
    """Of corners that are expected five pixels beside where they are, the largest."""
    image, ids, uv, H = _aligned(4.0)
    aside = uv + np.array([5.0, 0.0])
    moved = H.copy()
    moved[:, 0] += 5.0 * H[:, 2]
    with patch.object(blurred, "_WINDOW", blurred._WINDOW._replace(max_steps=1)):
        found, _ = _aligner().aligned(image, ids[:12], aside[:12], moved[:12], 4.0)
    return float(np.abs(found - aside[:12]).max())


def _is_compared(known: float) -> bool:
    values = np.arange(10.0)[None]
    return bool(_correlation(values, values, np.full((1, 10), known / 10))[0] > 0.9)


# A lens's start


def _sightings(focal_share: float, views: int = 10) -> Sightings:
    """Corners of the board in all of some views, by a camera with a focal length in widths."""
    focal = focal_share * 752
    camera = new_camera("equidistant" if focal_share < 0.5 else "radtan", 4, focal, (752, 480))
    renderer: Any = SimpleNamespace(target=GRID, camera=camera)
    rng = np.random.default_rng(0)
    uv = list[FloatArray]()
    for _ in range(views):
        R = so3_exp(rng.normal(size=3) * [0.3, 0.3, 0.2])
        p = np.array([0.0, 0.0, 1.2 * focal_share + 0.3]) - R @ [0.33, 0.33, 0.0]
        uv.append(BoardRenderer.corners(renderer, se3_from_parts(R, p))[0])
    n = len(GRID.points_m)
    return Sightings(
        GRID.points_m,
        views,
        1,
        np.repeat(np.arange(views), n),
        np.zeros(views * n, np.int64),
        np.tile(np.arange(n), views),
        np.concatenate(uv),
    )


def _adjusted_at_start(focal_share: float, views: int = 10) -> list[tuple[float, int]]:
    """Focal lengths over the right one of the starts that are adjusted, and the views of each."""
    calls: list[tuple[float, int]] = []

    def adjusted(camera: Any, seen: Sightings, steps: int) -> Any:
        calls.append((camera.fu / (752 * focal_share), seen.views))
        at = SimpleNamespace(cameras=(camera,))
        return SimpleNamespace(residuals_px=np.ones((1, 2)), at=at)

    lens: Any = ("equidistant", 4) if focal_share < 0.5 else ("radtan", 4)
    with patch.object(start, "_adjusted", adjusted):
        one_camera(_sightings(focal_share, views), (752, 480), *lens)
    return calls[:-1]  # the last one adjusts all views


def _has_pose(corners: int) -> bool:
    board = GRID.points_m[np.random.default_rng(0).permutation(len(GRID.points_m))[:corners]]
    uv = 100.0 + 300.0 * board
    return board_pose(FACING, board, uv) is not None


# Rendered boards


def _level(percent: float) -> float:
    """Gray value of an image without blur or noise that so many percent are darker than."""
    return float(np.percentile(_renderer().render(T_CAM_BOARD, Exposure(0.0, 0.0)), percent))


def _rendered_texels() -> float:
    """Of a tag's module."""
    return texture(GRID)[1] * GRID.size_m / 10


def _rays() -> float:
    """Along a side of a pixel."""
    return _renderer()._rays.shape[0] / FACING.height


def _noise() -> float:
    """Of an image as it is usually rendered: between a value and the next one, where nothing is."""
    plain = _renderer().render(T_CAM_BOARD)[:40, :40].astype(np.float64)
    return float(np.std(np.diff(plain)) / np.sqrt(2.0))


def _edge_width_px() -> float:
    """Standard deviation of what an edge is spread to, as usual, without that of a pixel."""
    T = se3_from_parts(np.eye(3), [-0.33, -0.33, 0.6])
    renderer = _renderer()
    image = renderer.render(T, replace(SHARP, noise=0.0)).astype(np.float64)
    left = renderer.corners(T)[0][0]
    at = round(float(left[0])) + np.arange(-6, 6)
    slope = -np.diff(image[round(float(left[1])) + 6, at[0] : at[-1] + 2])
    share = np.maximum(slope, 0.0) / np.maximum(slope, 0.0).sum()
    mean = share @ at
    return float(np.sqrt(share @ (at - mean) ** 2 - 1 / 12))


LIMITS: dict[str, tuple[Says, float, float]] = {
    "window: smallest": (lambda n: _half_window(1.0) < n, 6, 7),
    "window: largest": (lambda n: _half_window(500.0) < n, 24, 25),
    "window: share of a tag": (lambda x: _half_window(x) > 14, 29.0, 31.0),
    "window: of the blur": (lambda x: _half_window(1.0, x) > 6, 3.4, 3.6),
    "window: weight at its edge": (lambda x: _weight_at_edge() < x, 0.2, 0.3),
    "print: beside it": (lambda x: _known_share() < x, 0.09, 0.11),
    "print: sampled finer": (lambda x: _drawn(x) == _drawn(1.9), 1.7, 1.85),
    "print: samples": (lambda x: _drawn(1.7) / _drawn(1.9) < x, 1.9, 2.1),
    "print: beside a window": (lambda x: _beside_window(4.0) / 4.0 < x, 2.9, 3.1),
    "print: module": (lambda x: _module_texels() < x, 7.5, 8.5),
    "blur: least": (lambda x: _found_blur_px(0.5) < x, 0.6, 0.8),
    "blur: most": (lambda x: _found_blur_px(5.6) < x, 5.0, 6.0),
    "blur: corners": (lambda n: _corners_tried() < n, 12, 13),
    "aligned: step": (lambda x: _first_step_px() < x, 1.4, 1.6),
    "aligned: known": (_is_compared, 0.28, 0.32),
    "start: shortest": (lambda x: _adjusted_at_start(0.18)[0][0] < x, 0.85, 1.15),
    "start: longest": (lambda x: _adjusted_at_start(3.0)[0][0] < x, 0.85, 1.15),
    "start: adjusted": (lambda n: len(_adjusted_at_start(1.0)) < n, 2, 3),
    "start: views": (lambda n: _adjusted_at_start(1.0, int(n))[0][1] < n, 8, 9),
    "start: pose": (lambda n: _has_pose(int(n)), 5, 6),
    "rendered: dark": (lambda x: _level(5.0) < x, 32.0, 38.0),
    "rendered: around": (lambda x: _level(40.0) < x, 110.0, 130.0),
    "rendered: light": (lambda x: _level(95.0) < x, 195.0, 225.0),
    "rendered: module": (lambda x: _rendered_texels() < x, 11.0, 13.0),
    "rendered: rays": (lambda x: _rays() < x, 2.5, 3.5),
    "rendered: noise": (lambda x: _noise() < x, 2.7, 3.3),
    "rendered: blur": (lambda x: _edge_width_px() < x, 0.6, 0.8),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_prints(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
