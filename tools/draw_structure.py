"""The figure of docs/architecture.md: every package, what it imports, and in which layer it stands.

    python -m tools.draw_structure docs/images/structure.png [--root CHECKOUT]

A package here is a package or a single module directly in `vio/`; `frontend/` is `vio.frontend`. It
is one layer above the highest one that it imports. Arrows point at what is imported; those that a
longer path implies are left out, and so are those to the foundation (records, protocols, geometry,
errors, setting, numerics, files), which nearly everything imports. Imports inside functions count.
An import that closes a cycle is red. A colour is a part of `tools/parts.py`.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from tools.parts import PARTS, part_of

FOUNDATION = (
    "vio.records",
    "vio.protocols",
    "vio.geometry",
    "vio.errors",
    "vio.setting",
    "vio.numerics",
    "vio.files",
)
_COLOURS = {
    "base": "#e9e9e9",
    "estimator": "#cfe3cf",
    "guards": "#f0c9c9",
    "input and output": "#f3e3b3",
    "maps": "#c9e4e4",
    "runs and live": "#c5d8f0",
    "offline": "#e3cfc0",
    "laboratory": "#dcd3ea",
    "command line": "#ffffff",
}
_CLOSING = "#c23b5a"
_WIDTH = 1.0
_HEIGHT = 0.62


@dataclass(frozen=True, slots=True)
class Package:
    """A package or a module, and what it imports of the others."""

    name: str
    lines: int
    files: int
    imports: frozenset[str]


def read_packages(root: Path) -> dict[str, Package]:
    """Return all packages of a checkout by name."""
    files: dict[str, list[Path]] = {}
    for path in sorted([*(root / "vio").rglob("*.py"), *(root / "frontend").rglob("*.py")]):
        parts = path.relative_to(root).with_suffix("").parts
        name = _package_of(".".join(parts if parts[0] == "vio" else ("vio", *parts)))
        if name not in ("vio.__init__", "vio.__main__", "vio._version"):
            files.setdefault(name, []).append(path)
    packages = {}
    for name, paths in files.items():
        texts = [path.read_text(encoding="utf-8") for path in paths]
        imported = frozenset(
            {_package_of(module) for text in texts for module in _imports(text)} & set(files)
        )
        lines = sum(len(text.splitlines()) for text in texts)
        packages[name] = Package(name, lines, len(paths), imported - {name})
    return packages


def _package_of(module: str) -> str:
    """`vio.filters.window` lies in the package `vio.filters`."""
    return ".".join(module.split(".")[:2])


def _imports(text: str) -> Iterator[str]:
    """Modules that a text imports anywhere, but for those that only a type checker reads."""
    skipped: set[int] = set()
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.If)
            and isinstance(node.test, ast.Name)
            and node.test.id == "TYPE_CHECKING"
        ):
            skipped.update(id(child) for statement in node.body for child in ast.walk(statement))
        elif id(node) not in skipped and isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif (
            id(node) not in skipped
            and isinstance(node, ast.ImportFrom)
            and node.module
            and not node.level
        ):
            # `from vio import calibration` names a package, `from vio.records import Image`
            # something in one.
            yield from (
                (f"vio.{alias.name}" for alias in node.names)
                if node.module == "vio"
                else [node.module]
            )


def layers(packages: Mapping[str, Package]) -> tuple[dict[str, int], list[tuple[str, str]]]:
    """Return the layer of each package, 0 the lowest, and the imports (from, to) that close a
    cycle.
    """
    layer: dict[str, int] = {}
    closing: list[tuple[str, str]] = []

    def visit(name: str, above: tuple[str, ...]) -> int:
        if name not in layer:
            below = []
            for other in sorted(packages[name].imports):
                if other in (*above, name):
                    closing.append((name, other))
                else:
                    below.append(visit(other, (*above, name)))
            layer[name] = 1 + max(below, default=-1)
        return layer[name]

    for name in sorted(packages):
        visit(name, ())
    return layer, closing


def drawn_arrows(packages: Mapping[str, Package]) -> list[tuple[str, str]]:
    """Imports between packages without cycles that no longer way implies."""

    @cache
    def reached(name: str) -> frozenset[str]:
        return packages[name].imports.union(*(reached(n) for n in packages[name].imports))

    return [
        (name, other)
        for name, package in packages.items()
        for other in sorted(package.imports)
        if not any(other in reached(via) for via in package.imports - {other})
    ]


def draw(packages: Mapping[str, Package], path: Path) -> None:
    """Write the figure as PNG."""
    upper = {
        n: replace(r, imports=r.imports - set(FOUNDATION))
        for n, r in packages.items()
        if n not in FOUNDATION
    }
    level, closing = layers(upper)
    straight = {
        n: replace(r, imports=r.imports - {b for a, b in closing if a == n})
        for n, r in upper.items()
    }
    place = _places(straight, level, [n for n in FOUNDATION if n in packages])
    across = max(x for x, _ in place.values()) + 1.3
    up = max(y for _, y in place.values()) + 1.0
    figure = Figure(figsize=(1.45 * across, 0.95 * up), dpi=100)
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    axes.set_xlim(-0.15, across - 0.15)
    axes.set_ylim(-0.15, up - 0.15)
    axes.axis("off")
    for name, other in [*drawn_arrows(straight), *closing]:
        colour = _CLOSING if (name, other) in closing else "#8a93a0"
        (x0, y0) = place[name]
        (x1, y1) = place[other]
        rad = 0.12 if y0 - y1 > 1.5 else 0  # a long way goes around the packages between
        style: dict[str, Any] = {
            "connectionstyle": f"arc3,rad={rad}",
            "arrowstyle": "-|>",
            "shrinkA": 0,
            "shrinkB": 0,
        }
        end = (x1 + _WIDTH / 2, y1 + _HEIGHT)
        start = (x0 + _WIDTH / 2, y0)
        axes.annotate("", end, start, arrowprops={**style, "color": colour, "lw": 0.9}, zorder=1)
    for name, (x, y) in place.items():
        colour = _COLOURS[part_of(name)]
        corners = "round,pad=0,rounding_size=0.06"
        axes.add_patch(
            FancyBboxPatch((x, y), _WIDTH, _HEIGHT, boxstyle=corners, fc=colour, ec="#55606e")
        )
        package = packages[name]
        label = name.removeprefix("vio.") + ("/" if package.files > 1 else "")
        axes.text(
            x + _WIDTH / 2, y + 0.39, label, ha="center", va="center", fontsize=9, weight="bold"
        )
        files = f", {package.files} files" if package.files > 1 else ""
        axes.text(
            x + _WIDTH / 2,
            y + 0.17,
            f"{package.lines} lines{files}",
            ha="center",
            va="center",
            fontsize=6.5,
        )
    for row, part in enumerate(PARTS):
        y = up - 0.45 - 0.21 * row
        corners = "round,pad=0,rounding_size=0.03"
        axes.add_patch(
            FancyBboxPatch((0.0, y), 0.2, 0.14, boxstyle=corners, fc=_COLOURS[part], ec="#55606e")
        )
        axes.text(0.28, y + 0.07, part, va="center", fontsize=8)
    figure.savefig(path)


def _places(
    packages: Mapping[str, Package], level: Mapping[str, int], ground: list[str]
) -> dict[str, tuple[float, float]]:
    """Lower left corners: the foundation as one row, above it a row a layer, packages near those
    they are tied to.
    """
    rows = [[n for n in sorted(packages) if level[n] == k] for k in range(max(level.values()) + 1)]
    across = 1.25 * max(len(row) for row in [ground, *rows])
    arrows = drawn_arrows(packages)
    tied = {
        n: [b for a, b in arrows if a == n] + [a for a, b in arrows if b == n] for n in packages
    }

    def spread(row: list[str]) -> dict[str, float]:
        return {name: across / len(row) * (i + 0.5) - _WIDTH / 2 for i, name in enumerate(row)}

    x = {name: at for row in rows for name, at in spread(row).items()}
    for _ in range(8):
        for row in [*rows[::-1], *rows]:
            row.sort(key=lambda n: float(np.mean([x[m] for m in tied[n]] or [x[n]])))
            x.update(spread(row))
    upper = {name: (x[name], 1.1 * (k + 1)) for k, row in enumerate(rows) for name in row}
    return {**{name: (at, 0.0) for name, at in spread(ground).items()}, **upper}


def main() -> int:
    """Draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="PNG to write")
    parser.add_argument(
        "--root", type=Path, default=Path(__file__).resolve().parents[1], help="the checkout"
    )
    args = parser.parse_args()
    packages = read_packages(args.root)
    draw(packages, args.out)
    sys.stdout.write(
        f"{len(packages)} packages, {sum(r.lines for r in packages.values())} lines: {args.out}\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
