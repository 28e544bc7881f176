"""A picture of panels with axes: lines by OpenCV, text by Pillow, in a fifth of the time that matplotlib takes."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray

Limits: TypeAlias = tuple[float, float]
Box: TypeAlias = tuple[int, int, int, int]  # left, top, right, bottom, pixels
Pixels: TypeAlias = npt.NDArray[np.int32]

_FONT = Path("mpl-data", "fonts", "ttf", "DejaVuSans.ttf")  # of matplotlib: it has all the signs that pictures use
_INK, _FRAME, _GRID = "#1a1a1a", "#000000", "#ebebeb"
_SUBPIXEL_BITS = 4
_FAR_PX = 1e5  # from a panel; points further away are moved there
_MARGIN = 0.05  # of the values to the end of an axis
_SPACE_PX, _MOST_TICKS = (70.0, 30.0), 9  # between ticks, at least
_TICK_PX, _LEGEND_PX = 5, 8
_DASH_PX, _GAP_PX = 8.0, 5.0


def rgb(colour: str) -> tuple[int, int, int]:
    """Return the red, green and blue of `#rrggbb`."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


@cache
def _font(size: float) -> Any:
    from PIL import ImageFont

    found = importlib.util.find_spec("matplotlib")
    files = [Path(folder) / _FONT for folder in (found.submodule_search_locations if found else None) or ()]
    file = next((file for file in files if file.is_file()), None)
    return ImageFont.load_default(size) if file is None else ImageFont.truetype(str(file), size)


class Canvas:
    """A white picture of a size, pixels."""

    def __init__(self, width: int, height: int) -> None:
        self.pixels = np.full((height, width, 3), 255, dtype=np.uint8)  # red, green, blue
        self._texts: list[Callable[[Any], None]] = []

    def text(self, at: tuple[float, float], text: str, size: float, anchor: str) -> None:
        """Write a text; `anchor` is Pillow's: of its box, the part that is `at` u, v."""
        self._texts.append(lambda image: image[1].text(at, text, fill=rgb(_INK), font=_font(size), anchor=anchor))

    def upright(self, at: tuple[float, float], text: str, size: float) -> None:
        """Write a text from below to above, with the middle of its left side `at` u, v."""

        def write(image: Any) -> None:
            from PIL import Image, ImageDraw

            width = int(_font(size).getlength(text)) + 2
            mask = Image.new("L", (width, int(1.4 * size)))
            ImageDraw.Draw(mask).text((width / 2, mask.height / 2), text, fill=255, font=_font(size), anchor="mm")
            turned = mask.transpose(Image.Transpose.ROTATE_90)
            image[0].paste(rgb(_INK), (round(at[0]), round(at[1] - width / 2)), turned)

        self._texts.append(write)

    def png(self) -> bytes:
        """Return the file."""
        from PIL import Image, ImageDraw

        image = Image.fromarray(self.pixels)
        writable = image, ImageDraw.Draw(image)
        for write in self._texts:
            write(writable)
        written = cv2.cvtColor(np.asarray(image), cv2.COLOR_RGB2BGR)
        return bytes(cv2.imencode(".png", written, [cv2.IMWRITE_PNG_COMPRESSION, 2])[1])


@dataclass(slots=True)
class Panel:
    """Curves in a box of a canvas, with a frame, ticks and a legend; drawn by `draw`, in the order of the calls."""

    box: Box
    x_limits: Limits | None = None  # None: those of the values
    y_limits: Limits | None = None
    _steps: list[Callable[[Any], None]] = field(default_factory=list)
    _values: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    _legend: list[tuple[str, str, str, int]] = field(default_factory=list)  # label, kind, colour, width

    def line(
        self, x: FloatArray, y: FloatArray, colour: str, width: int = 1, *, label: str = "", dashed: bool = False
    ) -> None:
        """Draw a curve (N,); values that are not finite interrupt it."""
        self._add(x, y, label, "dashed" if dashed else "line", colour, width)

        def draw(view: Any) -> None:
            uv = self._pixels(x, y)
            gaps = np.flatnonzero(~np.isfinite(uv).all(axis=1))
            for piece in np.split(uv, gaps):
                part = piece[np.isfinite(piece).all(axis=1)]
                parts = [_fixed(p) for p in (_dashes(part) if dashed else [part])]
                cv2.polylines(view, parts, False, rgb(colour), width, cv2.LINE_AA, _SUBPIXEL_BITS)

        self._steps.append(draw)

    def band(
        self, x: FloatArray, low: FloatArray, high: FloatArray, colour: str, alpha: float, label: str = ""
    ) -> None:
        """Fill between two curves (N,)."""
        self._add(np.concatenate([x, x]), np.concatenate([low, high]), label, "patch", colour, 0)

        def draw(view: Any) -> None:
            edge = self._pixels(np.concatenate([x, x[::-1]]), np.concatenate([low, high[::-1]]))
            filled = view.copy()
            edge = edge[np.isfinite(edge).all(axis=1)]
            cv2.fillPoly(filled, [_fixed(edge)], rgb(colour), cv2.LINE_AA, _SUBPIXEL_BITS)
            cv2.addWeighted(filled, alpha, view, 1.0 - alpha, 0.0, dst=view)

        self._steps.append(draw)

    def dots(self, x: FloatArray, y: FloatArray, colour: str, label: str = "") -> None:
        """Draw points (N,), a pixel each; they do not count for the limits."""
        if label:
            self._legend.append((label, "dot", colour, 2))

        def draw(view: Any) -> None:
            uv = np.rint(self._pixels(x, y))
            inside = np.all((uv >= 0) & (uv < [view.shape[1], view.shape[0]]), axis=1)
            u, v = uv[inside].astype(np.int64).T
            view[v, u] = rgb(colour)

        self._steps.append(draw)

    def ring(self, x: float, y: float, colour: str, label: str) -> None:
        """Draw a circle around a point, white inside."""
        self._legend.append((label, "ring", colour, 2))
        self._steps.append(lambda view: _ring(view, self._pixels(np.array([x]), np.array([y]))[0], colour))

    def draw(
        self,
        canvas: Canvas,
        *,
        title: str = "",
        x_label: str = "",
        y_label: str = "",
        legend: int = 0,
        x_ticks: bool = True,
    ) -> None:
        """Draw the panel; its legend has so many columns (0: there is none)."""
        left, top, right, bottom = self.box
        self.x_limits = self.x_limits or _limits([x for x, _ in self._values])
        self.y_limits = self.y_limits or _limits([y for _, y in self._values])
        view = canvas.pixels[top:bottom, left:right]
        frame = canvas.pixels
        for value, text in ticks(self.x_limits, min((right - left) / _SPACE_PX[0], _MOST_TICKS)):
            u = round(self._pixels(np.array([value]), np.zeros(1))[0, 0])
            view[:, min(u, right - left - 1)] = rgb(_GRID)
            frame[bottom : bottom + _TICK_PX, left + u] = rgb(_FRAME)
            if x_ticks:
                canvas.text((left + u, bottom + _TICK_PX + 4), text, 15, "ma")
        for value, text in ticks(self.y_limits, min((bottom - top) / _SPACE_PX[1], _MOST_TICKS)):
            v = round(self._pixels(np.zeros(1), np.array([value]))[0, 1])
            view[min(v, bottom - top - 1)] = rgb(_GRID)
            frame[top + v, left - _TICK_PX : left] = rgb(_FRAME)
            canvas.text((left - _TICK_PX - 4, top + v), text, 15, "rm")
        drawn = np.ascontiguousarray(view)
        for step in self._steps:
            step(drawn)
        if legend and self._legend:
            self._draw_legend(canvas, drawn, legend)
        view[:] = drawn
        cv2.rectangle(canvas.pixels, (left, top), (right, bottom), rgb(_FRAME), 1)
        canvas.text((left, top - 5), title, 14, "lb")
        canvas.text(((left + right) / 2, bottom + 30), x_label, 15, "ma")
        canvas.upright((max(left - 88, 2), (top + bottom) / 2), y_label, 15)

    def _add(self, x: FloatArray, y: FloatArray, label: str, kind: str, colour: str, width: int) -> None:
        self._values.append((x, y))
        if label:
            self._legend.append((label, kind, colour, width))

    def _pixels(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Pixels (N, 2) of values (N,), from the corner of the box."""
        assert self.x_limits is not None
        assert self.y_limits is not None
        left, top, right, bottom = self.box
        (x_low, x_high), (y_low, y_high) = self.x_limits, self.y_limits
        u = (np.asarray(x) - x_low) / (x_high - x_low) * (right - left)
        v = (y_high - np.asarray(y)) / (y_high - y_low) * (bottom - top)
        return np.clip(np.stack([u, v], axis=1), -_FAR_PX, _FAR_PX)

    def _draw_legend(self, canvas: Canvas, view: Any, columns: int) -> None:
        """Draw the labels where they cover the least of the curves."""
        size, step, handle = 13, 20, 30
        rows = -(-len(self._legend) // columns)
        groups = [self._legend[k : k + rows] for k in range(0, len(self._legend), rows)]
        widths = [handle + 22 + int(max(_font(size).getlength(entry[0]) for entry in group)) for group in groups]
        width, height = sum(widths) + _LEGEND_PX, rows * step + _LEGEND_PX
        if width > view.shape[1] and columns > 1:
            self._draw_legend(canvas, view, columns - 1)
            return
        most_u, most_v = view.shape[1] - width - _LEGEND_PX, view.shape[0] - height - _LEGEND_PX
        places = [(u, v) for v in (_LEGEND_PX, most_v, most_v // 2) for u in (most_u, _LEGEND_PX, most_u // 2)]
        grid = np.array(rgb(_GRID), dtype=np.uint8)
        covered = (view != 255).any(axis=2) & (view != grid).any(axis=2)

        def hidden(at: tuple[int, int]) -> int:
            return int(covered[max(at[1], 0) : at[1] + height, max(at[0], 0) : at[0] + width].sum())

        u, v = (max(at, 0) for at in min(places, key=hidden))
        under = view[v : v + height, u : u + width]
        under[:] = cv2.addWeighted(under, 0.2, np.full_like(under, 255), 0.8, 0.0)
        cv2.rectangle(view, (u, v), (u + width, v + height), (204, 204, 204), 1)
        left, top = self.box[:2]
        for group, wide in zip(groups, widths, strict=True):
            for row, (label, kind, colour, thick) in enumerate(group):
                middle = v + _LEGEND_PX // 2 + step * row + step // 2
                _draw_handle(view, np.array([u + 10.0, middle]), handle - 8.0, kind, colour, thick)
                canvas.text((left + u + handle + 10, top + middle), label, size, "lm")
            u += wide


def ticks(limits: Limits, most: float) -> list[tuple[float, str]]:
    """Return round values between two limits, at most so many steps apart, and their texts."""
    low, high = limits
    least = (high - low) / max(most, 1.0)
    power = 10.0 ** math.floor(math.log10(least))
    step = next(k * power for k in (1.0, 2.0, 2.5, 5.0, 10.0) if k * power >= least * (1 - 1e-9))
    decimals = max(0, -math.floor(math.log10(step) + 1e-9) + (round(step / power, 6) == 2.5))
    counts = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    if decimals > 6 or max(abs(low), abs(high)) >= 1e7:
        return [(k * step, f"{k * step:.3g}".replace("-", "−")) for k in counts]
    return [(k * step, f"{k * step + 0.0:.{decimals}f}".replace("-", "−")) for k in counts]


def _limits(values: Sequence[FloatArray]) -> Limits:
    """Return the limits of finite values, with a margin."""
    together = np.concatenate(values) if values else np.zeros(0)
    together = together[np.isfinite(together)]
    low, high = (float(together.min()), float(together.max())) if len(together) else (0.0, 1.0)
    margin = _MARGIN * (high - low) or max(0.05 * abs(high), 1e-3)
    return low - margin, high + margin


def _fixed(uv: FloatArray) -> Pixels:
    """Pixels (N, 2) as OpenCV takes fractions of them."""
    return np.rint(uv * 2**_SUBPIXEL_BITS).astype(np.int32)


def _dashes(uv: FloatArray) -> list[FloatArray]:
    """Return the dashes of a curve (N, 2)."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(uv, axis=0), axis=1))])
    starts = np.arange(0.0, min(along[-1], _FAR_PX) if len(along) else 0.0, _DASH_PX + _GAP_PX)
    at = starts[:, None] + np.linspace(0.0, _DASH_PX, 5)
    return list(np.stack([np.interp(at, along, uv[:, k]) for k in range(2)], axis=2)) if len(uv) > 1 else []


def _ring(view: Any, centre: FloatArray, colour: str) -> None:
    at = _fixed(centre)
    for radius, fill in ((5.2, rgb(colour)), (3.6, (255, 255, 255))):
        size = int(radius * 2**_SUBPIXEL_BITS)
        cv2.circle(view, (int(at[0]), int(at[1])), size, fill, -1, cv2.LINE_AA, _SUBPIXEL_BITS)


def _draw_handle(view: Any, at: FloatArray, length: float, kind: str, colour: str, width: int) -> None:
    """Draw what stands beside a label, from its left end on."""
    ends = np.array([at, [at[0] + length, at[1]]])
    if kind == "ring":
        _ring(view, ends.mean(axis=0), colour)
    elif kind == "dot":
        centre = ends.mean(axis=0).astype(np.int64)
        view[centre[1] - 1 : centre[1] + 1, centre[0] - 1 : centre[0] + 1] = rgb(colour)
    elif kind == "patch":
        (u, v), half = at.astype(np.int64), 5
        view[v - half : v + half, u : u + int(length)] = rgb(colour)
    else:
        parts = _dashes(ends) if kind == "dashed" else [ends]
        cv2.polylines(view, [_fixed(p) for p in parts], False, rgb(colour), width, cv2.LINE_AA, _SUBPIXEL_BITS)
