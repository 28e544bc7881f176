"""The lens models by their names. A new one is a file in this folder and a line here."""

from __future__ import annotations

from importlib import import_module

from vio.geometry.lenses.model import Lens

# Files of this folder; each has an instance `LENS`, whose name is the file's.
_FILES = (
    "pinhole",
    "radtan",
    "equidistant",
    "unified",
    "double_sphere",
    "eucm",
    "fov",
)
LENSES: dict[str, Lens] = {
    name: import_module(f"vio.geometry.lenses.{name}").LENS for name in _FILES
}
