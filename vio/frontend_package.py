"""The front-end package `frontend` that belongs to this `vio`, whatever else is called `frontend`.

A script's own folder comes first on Python's path, so a folder `frontend/` beside it is found in place of ours. The two
packages are therefore told apart by their place: ours is the one beside `vio/`, in a checkout as in an installation.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

_FOLDER = Path(__file__).resolve().parent.parent / "frontend"
_OTHER_NAME = "vio._frontend"  # what ours is called where the name `frontend` belongs to another package


def frontend_module(name: str = "") -> ModuleType:
    """Import a module of our front end, such as "settings"; "": the package itself.

    It is imported as `frontend`, or under another name where a foreign package has that one. Its own imports are
    relative, so that both work.

    Raises:
        ModuleNotFoundError: there is no such module, or the installation lacks the folder `frontend`.
    """
    package = _package_name()
    return importlib.import_module(f"{package}.{name}" if name else package)


@cache
def _package_name() -> str:
    """Return the name of our package, and load it under another one where `frontend` is a foreign package."""
    if _is_ours(_found("frontend")):
        return "frontend"
    start = _FOLDER / "__init__.py"
    if not start.is_file():
        raise ModuleNotFoundError(
            f"{_FOLDER} is missing: the front end is installed beside vio; install stereo-vio again", name="frontend"
        )
    spec = importlib.util.spec_from_file_location(_OTHER_NAME, start, submodule_search_locations=[str(_FOLDER)])
    assert spec is not None
    assert spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    sys.modules[_OTHER_NAME] = package
    spec.loader.exec_module(package)
    return _OTHER_NAME


def _found(name: str) -> str | None:
    """Return the file of the package that `import` would give, without importing it."""
    loaded = sys.modules.get(name)
    if loaded is not None:
        return getattr(loaded, "__file__", None)
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):  # a broken foreign package
        return None
    return None if spec is None else spec.origin


def _is_ours(file: str | None) -> bool:
    return file is not None and Path(file).resolve().parent == _FOLDER
