"""Digests of inputs and code: two tasks with the same digest have the same result."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, Literal

from vio.datasets import MODULES
from vio.errors import DataError
from vio.files.atomic import atomic_write_text
from vio.numerics.kinds import Capacity

Identity = Literal["content", "stat"]
ROOT = Path(__file__).resolve().parent.parent.parent
_PACKAGES = ("numpy", "scipy", "opencv-python-headless", "numba")  # whose versions may change bits
_IMPORT = re.compile(r"^( *)(?:from|import) (vio[\w.]*)(?: import (\([^)]*\)|.*))?$", re.MULTILINE)
_BLOCK: Capacity[int] = 2**20


def digest_of(value: Any) -> str:
    """Return the SHA-256 of plain data as canonical JSON."""
    return hashlib.sha256(
        json.dumps(value, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


@cache
def code_digest() -> str:
    """Return the digest of all code that a run's figures depend on: what a task imports, at once
    or later.
    """
    return _digest_files(imported_code("vio.bench.worker", later=("vio.",)))


@cache
def render_code_digest() -> str:
    """Return the digest of all code that rendered images depend on: what `vio render` loads."""
    return _digest_files(imported_code("vio.cli.render", later=("vio.cli.render", "vio.sim.")))


def imported_code(root: str, later: tuple[str, ...]) -> list[str]:
    """Return our files that a module imports, and those that these import, relative to the
    installation.

    Of the command line only the module itself counts. Imports inside functions count in modules
    whose names begin as one of `later`.
    """
    found = set[str]()
    names = [root]
    while names:
        name = names.pop()
        path = Path(ROOT, *name.split("."))
        if path.is_dir():
            path = path / "__init__.py"
        else:
            path = path.with_suffix(".py")
        file = path.relative_to(ROOT).as_posix()
        is_ours = name.split(".")[0] == "vio" and (name == root or not name.startswith("vio.cli"))
        if is_ours and file not in found and path.is_file():
            found.add(file)
            names += _imports(path, inside=name.startswith(later))
            names.append(name.rpartition(".")[0])
            if name == "vio.datasets":  # which loads its readers by their names
                names += [f"vio.datasets.{reader}" for reader in MODULES]
    return sorted(found)


def _imports(path: Path, *, inside: bool) -> Iterator[str]:
    """Names that a file imports of ours, modules or what is in them; inside: in functions too.

    By the lines, as parsing all files takes seconds.
    """
    for indent, module, names in _IMPORT.findall(path.read_text(encoding="utf-8")):
        if inside or not indent:
            yield module
            yield from (f"{module}.{name}" for name in re.findall(r"\w+", names))


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that compute."""
    versions = {"python": ".".join(platform.python_version_tuple()[:2])}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # OpenCV under another of its names
            versions[name] = "unknown"
    return versions


def code_and_packages() -> tuple[str, dict[str, str]]:
    """Return what results depend on here beside inputs and settings."""
    return code_digest(), package_versions()


def commit_of(root: Path) -> str | None:
    """Return the commit of a checkout, with a + where its code was changed since.

    None: it is no checkout.
    """

    def git(*words: str) -> str:
        command = ["git", "-C", str(root), *words]
        return subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=30
        ).stdout.strip()

    try:
        return git("rev-parse", "--short=8", "HEAD") + (
            "+" if git("status", "--porcelain", "vio", "frontend") else ""
        )
    except (OSError, subprocess.SubprocessError):
        return None


def machine() -> str:
    """Return processors and operating system, without the name of the machine."""
    model = platform.processor() or platform.machine()
    try:
        names = re.findall(
            r"^model name\s*: (.+)$",
            Path("/proc/cpuinfo").read_text(encoding="utf-8"),
            re.MULTILINE,
        )
        model = names[0] if names else model
    except OSError:
        pass
    return f"{os.cpu_count()} x {' '.join(model.split())}, {platform.system()}"


class InputDigests:
    """Digests of recordings, remembered with sizes and times of change so that each content is
    read once.
    """

    def __init__(self, file: Path, identity: Identity = "content") -> None:
        """Read what is remembered in a JSON file.

        A recording is known by the bytes of its files (content), or by their names, sizes and times
        of change (stat).
        """
        self._file = file
        self._identity = identity
        self._known: dict[str, list[str]] = {}
        self._bytes: dict[Path, int] = {}
        try:
            self._known = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            self._known = {}

    def of(self, path: Path) -> str:
        """Return the digest of a file or folder, with what readers find beside it.

        Raises:
            DataError: it does not exist or cannot be read.
        """
        if not path.exists():
            raise DataError(f"{path} does not exist; name the folder of the recordings with --data")
        try:
            facts = [_stat(file, path) for file in _files(path)]
            self._bytes[path] = sum(size for _, size, _ in facts)
            signature = digest_of(facts)
            if self._identity == "stat":
                return f"stat:{signature}"
            return self._digest_of_content(path, signature)
        except OSError as error:
            raise DataError(
                f"cannot read {error.filename or path}: {error.strerror or error}"
            ) from error

    def _digest_of_content(self, path: Path, signature: str) -> str:
        """Return the digest of what the files hold; they are read where sizes and times changed."""
        known = self._known.get(str(path.absolute()))
        if known is None or known[0] != signature:
            contents = [[*_stat(f, path)[:2], _digest_file(f)] for f in _files(path)]
            known = [signature, digest_of(contents)]
            self._known[str(path.absolute())] = known
        return known[1]

    def bytes_of(self, path: Path) -> int:
        """Return the size of an input whose digest was asked for."""
        return self._bytes[path]

    def save(self) -> None:
        """Remember the digests.

        Raises:
            DataError: the file cannot be written.
        """
        self._file.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_text(self._file, json.dumps(self._known, indent=0) + "\n")


def _files(path: Path) -> list[Path]:
    """All files of a recording, in the order of their names."""
    if not path.is_dir():
        return [path]
    inside = [
        Path(folder, name) for folder, _, names in os.walk(path, followlinks=True) for name in names
    ]
    # KITTI: ground truth two levels up, calibration of a raw drive in the folder of its day.
    beside = [path.parent.parent / "poses" / f"{path.name}.txt", *path.parent.glob("calib_*.txt")]
    return sorted(inside) + [file for file in beside if file.is_file()]


def _stat(file: Path, root: Path) -> list[Any]:
    """Name relative to the recording, size, and time of change."""
    facts = file.stat()
    name = ""
    if file != root:
        name = os.path.relpath(file, root)
    return [name.replace(os.sep, "/"), facts.st_size, facts.st_mtime_ns]


def _digest_file(file: Path) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def _digest_files(names: Iterable[str]) -> str:
    return digest_of([[name, _digest_file(ROOT / name)] for name in names])
