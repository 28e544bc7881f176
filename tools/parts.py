"""The nine parts of the package, from the lowest to the highest, and which module is in which.

A module imports from its own part and from parts below it. `docs/architecture.md` describes the
parts; `tests/project/test_architecture.py` holds every import to their order.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

# From below to above; a name ends at a dot: `vio.offline.reproduce` is closer than `vio.offline`.
PARTS: dict[str, tuple[str, ...]] = {
    "base": (
        "vio._version",
        "vio.dataclass",
        "vio.errors",
        "vio.setting",
        "vio.records",
        "vio.protocols",
        "vio.findings",
        "vio.integrity",
        "vio.numerics",
        "vio.geometry",
        "vio.cameras",
        "vio.files",
        "vio.imu",
        "vio.evaluation",
    ),
    "estimator": ("vio.frontend", "vio.selection", "vio.filters"),
    "guards": ("vio.calibration", "vio.guard", "vio.monitor"),
    "input and output": ("vio.datasets", "vio.interop"),
    "maps": ("vio.mapping", "vio.dense", "vio.earth"),
    "runs and live": (
        "vio.config",
        "vio.live",
        "vio.runs",
        "vio.sources",
        "vio.ros2",
        "vio.mavlink",
        "vio.view",
        "vio.report",
    ),
    "offline": ("vio.inspection", "vio.targets", "vio.sources.board", "vio.offline"),
    "laboratory": (
        "vio.sim",
        "vio.bench",
        "vio.testing",
        "vio.course",
        "vio.offline.reproduce",
    ),
    "command line": ("vio.cli", "vio.__main__", "vio"),
}
_PART_OF = {name: part for part, names in PARTS.items() for name in names}
ORDER = {part: place for place, part in enumerate(PARTS)}


def part_of(module: str) -> str:
    """Return the part of a module, by the longest name of `PARTS` that holds it.

    Raises:
        KeyError: no part has it; only `vio` itself has the name of the whole package.
    """
    name = module
    while name not in _PART_OF or (name == "vio" and module != "vio"):
        name, dot, _ = name.rpartition(".")
        if not dot:
            raise KeyError(f"{module} is in no part: give its package one in tools/parts.py")
    return _PART_OF[name]


def source_files(root: Path) -> dict[str, Path]:
    """Return the files of a checkout's packages by the names of their modules."""
    files = {}
    for path in sorted([*(root / "vio").rglob("*.py"), *(root / "frontend").rglob("*.py")]):
        parts = path.relative_to(root).with_suffix("").parts
        if parts[:2] == ("vio", "frontend"):  # some versions of Python follow the link
            continue
        parts = parts if parts[0] == "vio" else ("vio", *parts)
        files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return files


def read_edges(root: Path) -> list[tuple[str, str]]:
    """Return who imports whom, (module, imported module), all of the package, each pair once.

    Imports inside functions and those that only a type checker reads count.
    """
    files = source_files(root)
    return sorted(
        {
            (module, imported)
            for module, path in files.items()
            for name in _imported(path)
            if (imported := _module(name, files)) and imported != module
        }
    )


def wrong_way(edges: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the imports of a part that is above the importing one."""
    return [
        (module, imported)
        for module, imported in edges
        if ORDER[part_of(imported)] > ORDER[part_of(module)]
    ]


def _imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _module(name: str, files: dict[str, Path]) -> str:
    """`vio.filters.window.Window` is a name of the module `vio.filters.window`."""
    if name in files:
        return name
    module = name.rpartition(".")[0]
    return module if module in files else ""
