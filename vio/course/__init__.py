"""The course: notebooks with tasks, their solutions, and what `vio course` copies of them."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from vio.errors import DataError
from vio.files.atomic import atomic_write_bytes
from vio.files.inputs import read_input

_SOLUTION = "_solution.ipynb"  # end of the name


def copy_course(folder: Path, *, solutions: bool = False) -> list[Path]:
    """Copy the tasks, and on request their solutions, into a folder, which is made where it is
    missing.

    Returns:
        The files. One that is there already with the same content stays.

    Raises:
        DataError: a file of that name has another content, such as a student's work.
    """
    contents = {folder / name: content for name, content in _files(solutions=solutions).items()}
    for path, content in contents.items():
        if path.exists() and (not path.is_file() or read_input(path) != content):
            raise DataError(
                f"{path}: exists and differs, perhaps by your work; name another folder"
            )
    folder.mkdir(parents=True, exist_ok=True)
    for path, content in contents.items():
        if not path.exists():
            atomic_write_bytes(path, content)
    return list(contents)


def _files(*, solutions: bool) -> dict[str, bytes]:
    """Return the content of the course's files by name, in their order."""
    entries = {entry.name: entry for entry in resources.files(__name__).iterdir()}
    names = [name for name in sorted(entries) if _is_copied(name)]
    if not solutions:
        names = [name for name in names if not name.endswith(_SOLUTION)]
    return {name: entries[name].read_bytes() for name in names}


def _is_copied(name: str) -> bool:
    return name.endswith(".ipynb") or name == "README.md"
