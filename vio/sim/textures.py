"""Procedural textures with detail at every scale, and the mip chains they are sampled from.

Each texture is painted once for its surface from its own seed, at full size, so nothing repeats.
Values are linear intensities in gray levels of a well exposed image, uint8.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from vio.errors import SimulationError
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity
from vio.records import Image

TextureKind: TypeAlias = Literal[
    "wall", "bare", "plaster", "floor", "ceiling", "wood", "picture", "crate", "facade", "asphalt", "sky",
    "skyline", "window", "clothes", "skin",
]  # fmt: skip
_Canvas: TypeAlias = npt.NDArray[np.float32]


class _TextureRules(NamedTuple):
    """Sizes of textures."""

    # texels of repeated border around each level, for the interpolation kernel
    gutter_texels: int = 3
    max_side_texels: Capacity[int] = 32000  # cv2.remap addresses its source with 16-bit integers
    min_level_texels: int = 4
    max_marks: int = 6000  # of one kind on one surface
    coarse_texels: int = 16  # of the shorter side of the copy that exposure is metered on


_TEXTURE = _TextureRules()
LEVELS_PER_OCTAVE = 2


@dataclass(frozen=True, slots=True)
class MipTexture:
    """A texture and its smaller copies (each 1/sqrt(2) of the one before) packed into one page."""

    page: Image  # (H, W)
    size: tuple[int, int]  # texels of level 0: along s, along t
    # (L, 4) scale_s, scale_t, offset_s, offset_t: level-0 texels to page pixels
    levels: npt.NDArray[np.float32]
    gain: float = 1.0  # radiance over the page's gray levels

    def coarse(self, share: FloatArray) -> FloatArray:
        """Radiance (N,) at places (N, 2) given as shares of width and height, of a copy about 16
        texels small.
        """
        sizes = self.levels[:, :2] * self.size  # texels of each level
        level = self.levels[
            int(np.argmin(np.abs(np.log2(sizes.min(axis=1) / _TEXTURE.coarse_texels))))
        ]
        x, y = (np.clip(share, 0, 1) * self.size * level[:2] + level[2:]).T
        height, width = self.page.shape
        column = np.clip(np.rint(x), 0, width - 1).astype(int)
        row = np.clip(np.rint(y), 0, height - 1).astype(int)
        return self.page[row, column] * float(self.gain)


def build_mips(texture: Image) -> MipTexture:
    """Pack a texture (H, W) and its half-octave mip levels into one page.

    A level-0 coordinate U in [0, W], texel centres at the halves, maps to `scale * U + offset` on
    the page.
    """
    height, width = texture.shape
    if width > _TEXTURE.max_side_texels:
        raise SimulationError(
            f"a texture of {width} texels is too wide; choose a coarser texel size"
        )
    levels = [texture]
    step = 0
    while min(levels[-1].shape) > _TEXTURE.min_level_texels:
        step += 1
        scale = 2.0 ** (-step / LEVELS_PER_OCTAVE)
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        # From the level an octave up: area averaging over at least two texels each way.
        if step >= LEVELS_PER_OCTAVE:
            source = levels[step - LEVELS_PER_OCTAVE]
        else:
            source = levels[0]
        levels.append(
            np.ascontiguousarray(cv2.resize(source, size, interpolation=cv2.INTER_AREA)).reshape(
                size[::-1]
            )
        )
    return _pack(levels)


def _pack(levels: list[Image]) -> MipTexture:
    """Place the levels on shelves: the widest decides the page, smaller ones fill the gaps."""
    page_width = levels[0].shape[1] + 2 * _TEXTURE.gutter_texels
    shelves: list[list[int]] = []  # top, height, filled width
    places: list[tuple[int, int]] = []
    bottom = 0
    for level in levels:
        h = level.shape[0] + 2 * _TEXTURE.gutter_texels
        w = level.shape[1] + 2 * _TEXTURE.gutter_texels
        shelf = next((s for s in shelves if h <= s[1] and s[2] + w <= page_width), None)
        if shelf is None:
            shelf = [bottom, h, 0]
            shelves.append(shelf)
            bottom += h
        places.append((shelf[0], shelf[2]))
        shelf[2] += w
    if bottom > _TEXTURE.max_side_texels:
        raise SimulationError(
            f"a texture page of {bottom} rows is too tall; choose a coarser texel size"
        )
    page = np.zeros((bottom, page_width), dtype=np.uint8)
    rows = []
    height, width = levels[0].shape
    for level, (top, left) in zip(levels, places, strict=True):
        padded = cv2.copyMakeBorder(
            level,
            _TEXTURE.gutter_texels,
            _TEXTURE.gutter_texels,
            _TEXTURE.gutter_texels,
            _TEXTURE.gutter_texels,
            cv2.BORDER_REPLICATE,
        )
        page[top : top + padded.shape[0], left : left + padded.shape[1]] = padded
        rows.append(
            (
                level.shape[1] / width,
                level.shape[0] / height,
                left + _TEXTURE.gutter_texels - 0.5,
                top + _TEXTURE.gutter_texels - 0.5,
            )
        )
    return MipTexture(page, (width, height), np.array(rows, dtype=np.float32))


def paint(kind: TextureKind, size_m: FloatArray, texel_m: float, rng: np.random.Generator) -> Image:
    """Draw one texture (H, W) for a surface of `size_m` (along s, along t) metres."""
    width, height = (max(8, round(float(side) / texel_m)) for side in size_m)
    canvas = _PAINTERS[kind](width, height, 1.0 / texel_m, rng)
    return np.clip(canvas + 0.5, 4, 251).astype(np.uint8)


def lit(texture: Image, light: FloatArray, rng: np.random.Generator) -> tuple[Image, float]:
    """Multiply a texture (H, W) by light (R, C), given at the middles of as many equal cells.

    Returns:
        The texture under that light over its brightest value, rounded with dither so that no steps
        appear in the dark, and that value, by which the texture is to be multiplied.
    """
    gain = float(light.max())
    relative = (light / gain).astype(np.float32)
    shaded = cv2.resize(relative, texture.shape[::-1], interpolation=cv2.INTER_LINEAR) * texture
    shaded = shaded + rng.random(shaded.shape, dtype=np.float32)
    return np.clip(shaded, 0, 255).astype(np.uint8), gain


def octave_noise(
    width: int,
    height: int,
    rng: np.random.Generator,
    *,
    coarsest_texels: float,
    falloff: float = 0.8,
) -> _Canvas:
    """Zero-mean value noise (height, width) of about unit standard deviation, summed over octaves.

    Args:
        coarsest_texels: wavelength of the first octave.
        falloff: amplitude of an octave relative to the one before.
    """
    wavelengths = [max(coarsest_texels, 1.0)]
    while wavelengths[-1] / 2 >= 1.0:
        wavelengths.append(wavelengths[-1] / 2)
    noise: _Canvas | None = None
    amplitude = 1.0
    power = 0.0
    for wavelength in wavelengths:
        rows = int(np.ceil(height / wavelength)) + 3
        columns = int(np.ceil(width / wavelength)) + 3
        shape = (rows, columns)
        fresh = (rng.random(shape, dtype=np.float32) - 0.5) * np.float32(3.4 * amplitude)
        if noise is None:
            noise = fresh
        else:
            grown = cv2.resize(
                noise, (2 * noise.shape[1], 2 * noise.shape[0]), interpolation=cv2.INTER_LINEAR
            )
            grown = grown.astype(np.float32)[: shape[0], : shape[1]]
            noise = grown + fresh[: grown.shape[0], : grown.shape[1]]
        power += amplitude**2
        amplitude *= falloff
    assert noise is not None
    if wavelengths[-1] > 1.0:
        rows, columns = noise.shape[:2]
        longest = wavelengths[-1]
        full = (round(columns * longest), round(rows * longest))
        noise = cv2.resize(noise, full, interpolation=cv2.INTER_CUBIC).astype(np.float32)
    return np.ascontiguousarray(noise[:height, :width]) / np.float32(np.sqrt(power))


def _rectangles(
    canvas: _Canvas,
    rng: np.random.Generator,
    count: int,
    side: tuple[float, float],
    contrast: float,
) -> None:
    """Add axis-aligned rectangles with log-uniform sides (texels) to the canvas."""
    log_low = np.log(max(side[0], 1.5))
    log_high = np.log(max(side[1], 2.0))
    size = np.exp(rng.uniform(log_low, log_high, (count, 2)))
    extent = np.array(canvas.shape[::-1])
    low = -size / 2 + rng.random((count, 2)) * (extent + size / 2)
    change = rng.uniform(-contrast, contrast, count).astype(np.float32)
    box = np.maximum(np.hstack([low, low + size]), 0).astype(np.int64).tolist()
    for (x0, y0, x1, y1), delta in zip(box, change, strict=True):
        canvas[y0:y1, x0:x1] += delta


def _polygons(
    canvas: _Canvas,
    rng: np.random.Generator,
    count: int,
    side: tuple[float, float],
    contrast: float,
) -> None:
    """Add rotated polygons of three to five corners with smooth edges to the canvas."""
    log_low = np.log(max(side[0], 2.0))
    log_high = np.log(max(side[1], 3.0))
    radius = np.exp(rng.uniform(log_low, log_high, (count, 1)))
    angle = np.sort(rng.uniform(0, 2 * np.pi, (count, 5)), axis=1)
    reach = radius * rng.uniform(0.6, 1, (count, 5))
    extent = np.array(canvas.shape[::-1])
    centre = rng.random((count, 1, 2)) * extent
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = centre + reach[..., None] * direction
    low = np.clip(np.floor(points.min(axis=1)) - 1, 0, extent).astype(np.int64)
    high = np.clip(np.ceil(points.max(axis=1)) + 2, 0, extent).astype(np.int64)
    fixed = np.round((points - low[:, None]) * 16).astype(np.int32)
    corners = rng.integers(3, 6, count).tolist()
    change = (rng.uniform(-contrast, contrast, count) / 255).astype(np.float32)
    for i, (x0, y0, x1, y1) in enumerate(np.hstack([low, high]).tolist()):
        if x1 <= x0 or y1 <= y0:
            continue
        mask = np.zeros((y1 - y0, x1 - x0), dtype=np.uint8)
        cv2.fillPoly(mask, [fixed[i, : corners[i]]], 255, lineType=cv2.LINE_AA, shift=4)
        canvas[y0:y1, x0:x1] += mask * change[i]


def _scatter(
    canvas: _Canvas, per_m: float, rng: np.random.Generator, *, density: float, contrast: float
) -> None:
    """Add marks of every size from half a metre to a centimetre, more of the smaller ones."""
    height, width = canvas.shape
    area = width * height / per_m**2
    for low, high, weight in (
        (0.15, 0.5, 1.5),
        (0.05, 0.15, 8.0),
        (0.015, 0.05, 30.0),
    ):
        if high * per_m < 2.5:
            continue
        count = min(int(area * density * weight), 2 * _TEXTURE.max_marks)
        sides = (low * per_m, high * per_m)
        _rectangles(canvas, rng, count // 2, sides, contrast)
        _polygons(canvas, rng, count - count // 2, (sides[0] / 2, sides[1] / 2), contrast)


def _light(width: int, height: int, rng: np.random.Generator) -> _Canvas:
    """Smooth illumination (height, width) about 1."""
    grid = rng.uniform(0.8, 1.15, (3, 4)).astype(np.float32)
    return cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32)


def _noise(
    width: int,
    height: int,
    per_m: float,
    rng: np.random.Generator,
    coarsest_m: float,
    falloff: float,
) -> _Canvas:
    return octave_noise(width, height, rng, coarsest_texels=coarsest_m * per_m, falloff=falloff)


def _wall(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    canvas = 128 + 30 * _noise(width, height, per_m, rng, 1.0, 0.85)
    _scatter(canvas, per_m, rng, density=1.6, contrast=60)
    for _ in range(int(width * height / per_m**2 / 3)):
        _poster(canvas, per_m, rng)
    return canvas * _light(width, height, rng)


def _poster(canvas: _Canvas, per_m: float, rng: np.random.Generator) -> None:
    """Add one poster with its own content to a wall."""
    height, width = canvas.shape
    w, h = (int(x) for x in rng.uniform(0.3, 0.9, 2) * per_m)
    if w < 12 or h < 12 or w >= width or h >= height:
        return
    x = int(rng.integers(0, width - w))
    y = int(rng.integers(0, height - h))
    canvas[y : y + h, x : x + w] = _picture(w, h, per_m, rng)


def _bare(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    return np.full((height, width), 150.0, dtype=np.float32)


def _plaster(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    """A painted wall: stains fainter than a sensor's noise, a socket or hook here and there, a
    skirting board.
    """
    canvas = np.ascontiguousarray(
        150 + 1.5 * _noise(width, height, per_m, rng, 1.5, 0.7), dtype=np.float32
    )
    for _ in range(int(width * height / per_m**2 / 2) + 1):
        side = rng.choice([0.08, 0.02]) * per_m
        place = rng.uniform((0, 0.3 * height), (width, height - side))
        _fill(canvas, (*place, max(side, 2), max(side, 2)), 150 + float(rng.choice([-70.0, 40.0])))
    _fill(canvas, (0, height - 0.08 * per_m, width, 0.08 * per_m), 95.0)
    return canvas


def _picture(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    canvas = rng.uniform(70, 180) + 35 * _noise(width, height, per_m, rng, 0.4, 0.9)
    canvas = np.ascontiguousarray(canvas, dtype=np.float32)
    _polygons(canvas, rng, 14, (0.08 * width, 0.3 * width), 90)
    _rectangles(canvas, rng, 12, (0.03 * width, 0.3 * width), 80)
    _polygons(canvas, rng, 40, (0.01 * width, 0.06 * width), 100)
    frame = max(1, round(0.02 * per_m))
    shade = rng.choice([25.0, 60.0, 215.0])
    canvas[:frame] = shade
    canvas[-frame:] = shade
    canvas[:, :frame] = shade
    canvas[:, -frame:] = shade
    return canvas


def _floor(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    """Planks of varying length and shade, with rugs and marks."""
    canvas = 110 + 22 * _noise(width, height, per_m, rng, 2.0, 0.9)
    plank = 0.14 * per_m
    for row in range(int(height / plank) + 1):
        top = round(row * plank)
        bottom = round((row + 1) * plank)
        x = -rng.uniform(0, 1.5) * per_m
        while x < width:
            length = rng.uniform(0.6, 1.9) * per_m
            left = max(0, round(x))
            right = max(0, round(x + length))
            canvas[top:bottom, left:right] += np.float32(rng.uniform(-26, 26))
            canvas[top:bottom, left : left + max(1, round(0.005 * per_m))] -= 45
            x += length
        canvas[top : top + max(1, round(0.005 * per_m))] -= 40
    _scatter(canvas, per_m, rng, density=0.9, contrast=45)
    return canvas * _light(width, height, rng)


def _ceiling(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    canvas = 150 + 22 * _noise(width, height, per_m, rng, 1.5, 0.85)
    _scatter(canvas, per_m, rng, density=0.6, contrast=40)
    return canvas * _light(width, height, rng)


def _wood(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    """Grain: noise stretched along s, with knots, labels and handles."""
    stretched = octave_noise(
        max(8, width // 6), height, rng, coarsest_texels=0.15 * per_m, falloff=0.9
    )
    grain = cv2.resize(stretched, (width, height), interpolation=cv2.INTER_CUBIC)
    canvas = rng.uniform(80, 150) + 24 * grain + 16 * _noise(width, height, per_m, rng, 0.3, 0.95)
    canvas = np.ascontiguousarray(canvas, dtype=np.float32)
    _scatter(canvas, per_m, rng, density=3.5, contrast=60)
    return _edged(canvas, per_m, rng)


def _crate(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    canvas = rng.uniform(85, 165) + 32 * _noise(width, height, per_m, rng, 0.5, 0.9)
    canvas = np.ascontiguousarray(canvas, dtype=np.float32)
    side = min(width, height)
    _rectangles(canvas, rng, 10, (0.1 * side, 0.5 * side), 55)
    _scatter(canvas, per_m, rng, density=4.0, contrast=70)
    return _edged(canvas, per_m, rng)


def _edged(canvas: _Canvas, per_m: float, rng: np.random.Generator) -> _Canvas:
    """Darken a thin rim, so that boxes are distinguishable."""
    rim = max(1, round(0.012 * per_m))
    rows = (canvas[:rim], canvas[-rim:])
    columns = (canvas[:, :rim], canvas[:, -rim:])
    for edge in (*rows, *columns):
        edge *= 0.45
    return canvas * np.float32(rng.uniform(0.75, 1.15))


def _facade(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    """A building facade: masonry, window rows with differing content, a door, signs, stains."""
    canvas = rng.uniform(95, 160) + 20 * _noise(width, height, per_m, rng, 3.0, 0.88)
    canvas = np.ascontiguousarray(canvas, dtype=np.float32)
    course = rng.uniform(0.25, 0.4) * per_m
    for row in range(int(height / course) + 1):
        top = round(row * course)
        bottom = round((row + 1) * course)
        x = -rng.uniform(0, 1) * per_m
        while x < width:
            length = rng.uniform(0.4, 1.1) * per_m
            canvas[top:bottom, max(0, round(x)) : max(0, round(x + length))] += np.float32(
                rng.uniform(-14, 14)
            )
            x += length
    _scatter(canvas, per_m, rng, density=0.35, contrast=40)
    storey = rng.uniform(2.6, 3.3) * per_m
    bay = rng.uniform(1.7, 2.8) * per_m
    wide = rng.uniform(0.45, 0.65) * bay
    tall = rng.uniform(0.45, 0.6) * storey
    for floor in range(int(height / storey)):
        for column in range(int(width / bay)):
            centre = np.array([(column + 0.5) * bay, height - (floor + 0.55) * storey])
            centre += rng.normal(0, 0.04, 2) * per_m
            size = np.array([wide, tall]) * rng.uniform(0.9, 1.1, 2)
            if rng.random() < 0.93:
                _window(canvas, centre, size, per_m, rng)
    for _ in range(int(width / per_m / 3) + 1):
        w = rng.uniform(0.6, 2.5) * per_m
        h = rng.uniform(0.3, 0.9) * per_m
        x = rng.uniform(0, max(1, width - w))
        y = rng.uniform(height * 0.35, height - h)
        _panel(canvas, (x, y, w, h), per_m, rng)
    return canvas * _light(width, height, rng)


def _window(
    canvas: _Canvas, centre: FloatArray, size: FloatArray, per_m: float, rng: np.random.Generator
) -> None:
    x, y = centre - size / 2
    w, h = size
    rim = 0.09 * per_m
    _fill(
        canvas,
        (x - rim, y - rim, w + 2 * rim, h + 2 * rim),
        float(rng.choice([200.0, 60.0, 175.0])),
    )
    _panel(canvas, (x, y, w, h), per_m, rng, dark=True)
    if rng.random() < 0.7:
        _fill(canvas, (x + w / 2 - rim / 3, y, 2 * rim / 3, h), 190.0)
    if rng.random() < 0.7:
        _fill(canvas, (x, y + h * rng.uniform(0.3, 0.6), w, 2 * rim / 3), 190.0)
    sill = (x - 1.6 * rim, y + h + rim, w + 3.2 * rim, rim)
    _fill(canvas, sill, rng.uniform(150, 225))


def _panel(
    canvas: _Canvas,
    box: tuple[float, float, float, float],
    per_m: float,
    rng: np.random.Generator,
    *,
    dark: bool = False,
) -> None:
    """Fill a box (x, y, width, height in texels) with content of its own: a pane, a sign, a
    shutter.
    """
    region = _region(canvas, box)
    if region.size == 0:
        return
    h, w = region.shape
    fresh = octave_noise(w, h, rng, coarsest_texels=0.5 * per_m, falloff=0.85)
    if dark:
        region[:] = rng.uniform(35, 80) + 14 * fresh
    else:
        region[:] = rng.uniform(60, 200) + 22 * fresh
    _rectangles(region, rng, 7, (0.08 * w, 0.6 * w), 45)
    _polygons(region, rng, 4, (0.04 * w, 0.25 * w), 60)


def _region(canvas: _Canvas, box: tuple[float, float, float, float]) -> _Canvas:
    x, y, w, h = box
    top = max(0, round(y))
    bottom = max(0, round(y + h))
    left = max(0, round(x))
    right = max(0, round(x + w))
    return canvas[top:bottom, left:right]


def _fill(canvas: _Canvas, box: tuple[float, float, float, float], value: float) -> None:
    _region(canvas, box)[:] = value


def _asphalt(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    """Road: grain, repair patches, cracks, worn paint, manhole covers."""
    canvas = 95 + 24 * _noise(width, height, per_m, rng, 4.0, 0.92)
    canvas = np.ascontiguousarray(canvas, dtype=np.float32)
    area = width * height / per_m**2
    _rectangles(
        canvas, rng, min(int(area / 12), _TEXTURE.max_marks), (0.4 * per_m, 3.0 * per_m), 22
    )
    _polygons(canvas, rng, min(int(area / 3), _TEXTURE.max_marks), (0.05 * per_m, 0.4 * per_m), 45)
    if 0.08 * per_m > 2:
        _polygons(
            canvas,
            rng,
            min(int(area * 2.5), 2 * _TEXTURE.max_marks),
            (0.02 * per_m, 0.08 * per_m),
            70,
        )
    for _ in range(min(int(area / 8), _TEXTURE.max_marks)):
        steps = rng.normal(0, 0.35, (12, 2)).cumsum(axis=0) * per_m
        points = rng.uniform((0, 0), (width, height)) + steps
        dark = float(rng.uniform(25, 55))
        cv2.polylines(
            canvas,
            [np.round(points * 16).astype(np.int32)],
            False,
            dark,
            max(1, round(0.02 * per_m)),
            shift=4,
        )
    for _ in range(min(int(area / 25), _TEXTURE.max_marks)):
        x, y = rng.uniform((0, 0), (width, height))
        _fill(
            canvas,
            (x, y, rng.uniform(0.12, 2.0) * per_m, rng.uniform(0.1, 0.5) * per_m),
            rng.uniform(150, 220),
        )
    return canvas


def _sky(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    clouds = octave_noise(width, height, rng, coarsest_texels=width / 5, falloff=0.6)
    return np.asarray(205 + 22 * clouds, dtype=np.float32)


def _skyline(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    """Far hills and towers under a plain sky; t runs downwards."""
    canvas = np.asarray(
        210 + 8 * octave_noise(width, height, rng, coarsest_texels=height / 2, falloff=0.6)
    )
    ridge = np.interp(
        np.arange(width), np.linspace(0, width, 40), height * rng.uniform(0.6, 0.8, 40)
    )
    hill = np.arange(height)[:, None] > ridge[None]
    canvas[hill] = (
        120 + 25 * octave_noise(width, height, rng, coarsest_texels=height / 3, falloff=0.85)
    )[hill]
    for _ in range(60):
        w = rng.uniform(0.006, 0.03) * width
        h = rng.uniform(0.15, 0.5) * height
        x = rng.uniform(0, width - w)
        box = (x, height * 0.95 - h, w, h)
        _fill(canvas, box, rng.uniform(60, 150))
        region = _region(canvas, box)
        _rectangles(region, rng, 60, (0.03 * w, 0.15 * w), 60)
    return canvas.astype(np.float32)


def _glass(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    """A window against the light: bright panes, dark bars and frame."""
    canvas = np.full((height, width), 235.0, dtype=np.float32)
    bar = max(2, round(0.05 * per_m))
    rows = (canvas[:bar], canvas[-bar:])
    columns = (canvas[:, :bar], canvas[:, -bar:])
    for edge in (*rows, *columns):
        edge[:] = 12.0
    for count, along in (
        (max(2, round(width / per_m / 0.8)), width),
        (max(2, round(height / per_m / 0.9)), height),
    ):
        for k in range(1, count):
            at = round(k * along / count)
            if along == width:
                canvas[:, at - bar // 2 : at + bar // 2 + 1] = 12.0
            else:
                canvas[at - bar // 2 : at + bar // 2 + 1] = 12.0
    return canvas


def _clothes(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    """Cloth: one shade with soft folds, sometimes a stripe or a print."""
    canvas = rng.choice([35.0, 60.0, 95.0, 150.0]) + 9 * _noise(
        width, height, per_m, rng, 0.25, 0.6
    )
    canvas = np.ascontiguousarray(canvas, dtype=np.float32)
    if rng.random() < 0.5:
        x = rng.uniform(0.2, 0.5)
        y = rng.uniform(0.1, 0.5)
        w = rng.uniform(0.2, 0.5)
        h = rng.uniform(0.1, 0.3)
        _fill(canvas, (x * width, y * height, w * width, h * height), rng.uniform(40, 200))
    return canvas


def _skin(width: int, height: int, per_m: float, rng: np.random.Generator) -> _Canvas:
    return np.asarray(140 + 8 * _noise(width, height, per_m, rng, 0.1, 0.7), dtype=np.float32)


_PAINTERS: dict[TextureKind, Callable[[int, int, float, np.random.Generator], _Canvas]] = {
    "wall": _wall,
    "bare": _bare,
    "plaster": _plaster,
    "floor": _floor,
    "ceiling": _ceiling,
    "wood": _wood,
    "picture": _picture,
    "crate": _crate,
    "facade": _facade,
    "asphalt": _asphalt,
    "sky": _sky,
    "skyline": _skyline,
    "window": _glass,
    "clothes": _clothes,
    "skin": _skin,
}
