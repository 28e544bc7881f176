"""What lies in a recording's folder and is not used."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vio.datasets.images import SUFFIXES

# No data, or other files of a calibration that was read.
_SILENT = ("readme*", "license*", "*.md", "simulation.json", "rectification.json", "conversion.json", "calib_*_to_*")
_SHEETS = (".yaml", ".yml")  # a calibration may lie in several
_NAMED = 12  # of a list


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the parts of a recording lie."""

    root: Path  # the folder that was given
    base: Path  # holds the image folders: the root, or its mav0
    left: Path  # folder of the images, or video
    right: Path


def unused_note(layout: Layout, used: Sequence[Path]) -> list[str]:
    """Return a note that names what lies in the folder and was not read; files in `used` need not exist."""
    kept = {path.absolute() for path in (layout.left, layout.right, *used) if path.exists()}
    sheets = {path.parent for path in kept if path.suffix in _SHEETS}
    kept |= {parent for path in kept for parent in path.parents}
    images = [side for side in (layout.left, layout.right) if side.is_dir()]
    found = []
    for folder in dict.fromkeys((layout.root, layout.base, *images, *(side.parent for side in images))):
        for child in sorted(folder.iterdir()) if layout.root in (folder, *folder.parents) else ():
            if child.name.startswith(".") or any(fnmatch.fnmatch(child.name.lower(), form) for form in _SILENT):
                continue
            suffix, path = child.suffix.lower(), child.absolute()
            read = suffix in SUFFIXES if folder in images else suffix in _SHEETS and path.parent in sheets
            if not read and path not in kept:
                found.append(str(child.relative_to(layout.root)) + ("/" if child.is_dir() else ""))
    return [f"not used: {listed(found)}"] if found else []


def listed(names: Sequence[str]) -> str:
    """Return the first names, and how many more there are."""
    shown = ", ".join(names[:_NAMED]) or "none"
    return f"{shown} and {len(names) - _NAMED} more" if len(names) > _NAMED else shown
