"""A board as a page to print, SVG or PDF, with a ruler: what is measured on paper is used."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vio.files.atomic import atomic_write_bytes, atomic_write_text
from vio.geometry.lie import FloatArray
from vio.targets.description import Target

_MM = 1000.0


class _Page(NamedTuple):
    """What is drawn beside the board."""

    margin_mm: float = 15.0
    ruler_mm: float = 25.0  # height of the strip below the board that holds ruler and words
    tick_mm: float = 10.0


_PAGE = _Page()


@dataclass(frozen=True, slots=True)
class Page:
    """Dark rectangles and words on paper, in millimetres from its top left corner."""

    width: float
    height: float
    rectangles: FloatArray  # (N, 4) left, top, right, bottom
    words: tuple[tuple[float, float, str], ...]  # where a line begins, and its text


def page_of(target: Target) -> Page:
    """Lay out a board and, below it, a ruler of whole centimetres."""
    board = target.dark_rectangles() * _MM
    shift = _PAGE.margin_mm - board[:, :2].min(axis=0)
    board = board + np.tile(shift, 2)
    right, bottom = board[:, 2:].max(axis=0).tolist()
    ruler_top = bottom + 8.0
    length = _PAGE.tick_mm * max(int((right - _PAGE.margin_mm) / _PAGE.tick_mm), 1)
    ticks = []
    for x in np.arange(0.0, length + 0.5, _PAGE.tick_mm).tolist():
        left = _PAGE.margin_mm + x
        ticks.append((left - 0.1, ruler_top, left + 0.1, ruler_top + 4.0))
    line = (_PAGE.margin_mm - 0.1, ruler_top, _PAGE.margin_mm + length + 0.1, ruler_top + 0.2)
    one = "tag with its border" if target.kind == "aprilgrid" else "square"
    words = (
        (_PAGE.margin_mm, ruler_top + 9.0, f"ruler {length:g} mm; {target}"),
        (
            _PAGE.margin_mm,
            ruler_top + 14.0,
            f"measure the side of a {one} over many of them, and write it into the target file",
        ),
    )
    rectangles = np.concatenate([board, np.array([*ticks, line])])
    return Page(right + _PAGE.margin_mm, ruler_top + _PAGE.ruler_mm, rectangles, words)


def printed_light(target: Target, texels_per_m: float, margin_m: float) -> FloatArray:
    """Return a board as an image (H, W) of ones where the paper is light and zeros where it is
    dark, with a margin around the pattern, of its outermost tags or squares.
    """
    width, height = (round((side + 2 * margin_m) * texels_per_m) for side in target.extent_m)
    out = np.ones((height, width))
    for rectangle in target.dark_rectangles():
        edges = np.rint((rectangle + margin_m) * texels_per_m).astype(int)
        left, top, right, bottom = np.maximum(edges, 0).tolist()
        out[top:bottom, left:right] = 0.0
    return out


def write_page(target: Target, path: Path) -> None:
    """Write a board as SVG or PDF, by the file's suffix.

    Raises:
        DataError: the file cannot be written.
    """
    page = page_of(target)
    if path.suffix.lower() == ".pdf":
        _write_pdf(page, path)
        return
    atomic_write_text(path, svg_text(page))


def svg_text(page: Page) -> str:
    """Return a page as SVG whose unit is the millimetre."""
    size = f'width="{page.width:.4f}mm" height="{page.height:.4f}mm"'
    box = f'viewBox="0 0 {page.width:.4f} {page.height:.4f}"'
    lines = [f'<svg xmlns="http://www.w3.org/2000/svg" {size} {box}>']
    lines.append('<rect width="100%" height="100%" fill="white"/>')
    lines.append('<g fill="black" shape-rendering="crispEdges">')
    for left, top, right, bottom in page.rectangles.tolist():
        at = f'x="{left:.4f}" y="{top:.4f}"'
        lines.append(f'<rect {at} width="{right - left:.4f}" height="{bottom - top:.4f}"/>')
    lines.append('</g><g font-family="sans-serif" font-size="3.5">')
    lines += [f'<text x="{x:.3f}" y="{y:.3f}">{text}</text>' for x, y, text in page.words]
    lines.append("</g></svg>")
    return "\n".join(lines) + "\n"


def _write_pdf(page: Page, path: Path) -> None:
    import io

    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.collections import PatchCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    figure = Figure(figsize=(page.width / 25.4, page.height / 25.4))
    FigureCanvasPdf(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, page.width)
    axes.set_ylim(page.height, 0)
    axes.axis("off")
    patches = [
        Rectangle((left, top), right - left, bottom - top)
        for left, top, right, bottom in page.rectangles.tolist()
    ]
    axes.add_collection(PatchCollection(patches, facecolor="black", linewidth=0))
    for x, y, text in page.words:
        axes.text(x, y, text, fontsize=9)
    out = io.BytesIO()
    figure.savefig(out, format="pdf")
    atomic_write_bytes(path, out.getvalue())
