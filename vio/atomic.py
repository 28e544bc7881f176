"""Atomic writing of files and folders."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shutil
import uuid
from collections.abc import Collection, Iterator
from pathlib import Path

from vio.errors import DataError, VioError

logger = logging.getLogger(__name__)

_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def _sibling(path: Path, kind: str) -> Path:
    """Return a unique hidden name beside `path`, on the same file system, so that a rename is atomic."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.{kind}")


def _unwritable(path: Path, error: OSError) -> DataError:
    return DataError(f"cannot write {path}: {error.strerror or error}; choose a writable path with enough free space")


def atomic_write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a file atomically: it holds either its old content or all of the new. Its folder must exist.

    Raises:
        DataError: the folder is missing or not writable, or the disk is full.
    """
    target = Path(path)
    partial = _sibling(target, "partial")
    try:
        try:
            with partial.open("xb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise _unwritable(target, error) from error


def atomic_write_text(path: str | os.PathLike[str], text: str) -> None:
    r"""Write a UTF-8 text file with `\n` line ends, atomically; its folder must exist.

    Raises:
        DataError: the folder is missing or not writable, or the disk is full.
    """
    atomic_write_bytes(path, text.encode("utf-8"))


@contextlib.contextmanager
def atomic_folder(
    path: str | os.PathLike[str], *, replace: bool, marker: str | None = None, own: Collection[str] | None = None
) -> Iterator[Path]:
    """Yield a temporary folder that becomes `path` when the block succeeds, and is removed when it fails.

    Missing parent folders are created (and removed again on failure). With `replace`, an old folder is moved aside at
    the end and removed only after the new one is in place; it must be empty or hold the file named by `marker`, and
    only names in `own` where those are given, so that a mistyped path never deletes a user's own files.

    Raises:
        VioError: `path` exists and may not be replaced.
        DataError: the parent is not writable, or the disk is full.
    """
    target = Path(path).absolute()
    check_replaceable(target, replace, marker, own)
    partial = _sibling(target, "partial")
    parents = [parent for parent in target.parents if not parent.exists()]
    done = False
    try:
        try:
            partial.mkdir(parents=True)
        except OSError as error:
            raise _unwritable(target, error) from error
        try:
            yield partial
        except OSError as error:
            if error.errno in _NO_SPACE:
                raise _unwritable(target, error) from error
            raise
        check_replaceable(target, replace, marker, own)  # another process may have created it meanwhile
        try:
            _swap_in(partial, target)
        except OSError as error:
            raise _unwritable(target, error) from error
        done = True
    finally:
        if not done:
            shutil.rmtree(partial, ignore_errors=True)
            for parent in parents:
                with contextlib.suppress(OSError):
                    parent.rmdir()


def check_replaceable(target: Path, replace: bool, marker: str | None, own: Collection[str] | None = None) -> None:
    """Raise VioError unless `target` is free or may be replaced under the rules of `atomic_folder`."""
    if not os.path.lexists(target):
        return
    if not replace:
        raise VioError(f"{target} exists already; choose another path, remove it, or allow it to be replaced")
    if target.is_symlink() or not target.is_dir():
        raise VioError(f"{target} is not a folder and will not be replaced; choose another path")
    if any(target.iterdir()) and (marker is None or not (target / marker).is_file()):
        wanted = "" if marker is None else f" (it has no {marker})"
        raise VioError(f"{target} was not made by this program{wanted} and will not be replaced; choose another path")
    foreign = [] if own is None else sorted(path.name for path in target.iterdir() if path.name not in own)
    if foreign:
        names = ", ".join(foreign[:3]) + (" and more" if len(foreign) > 3 else "")
        raise VioError(
            f"{target} holds {names} beside an earlier result and will not be replaced; move that away, or choose "
            "another path"
        )


def _swap_in(partial: Path, target: Path) -> None:
    """Rename `partial` to `target`, and remove the old folder only after that."""
    if not target.exists():
        partial.rename(target)
        return
    old = _sibling(target, "old")
    target.rename(old)
    try:
        partial.rename(target)
    except OSError:
        old.rename(target)
        raise
    try:
        shutil.rmtree(old)
    except OSError as error:
        logger.warning("%s is written, but the folder it replaced is still at %s: %s", target, old, error)
