"""Atomic writing of files and folders.

What is being written lies beside its target, as `.NAME.<12 hex digits>.partial`, and is locked by
its process. The lock ends with the process, whatever ends that; the next write of the same target
removes what has none.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import shutil
import stat
import uuid
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, Literal

from vio.errors import DataError, VioError
from vio.numerics.kinds import Capacity

logger = logging.getLogger(__name__)

try:
    import fcntl
except ImportError:  # Windows: leftovers stay
    fcntl = None  # type: ignore[assignment]

_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Of `os.open`: neither follows a link nor waits for the reader of a pipe; text is written as it is.
_NO_LINK = sum(
    getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY")
)
# what makes the name of a file in the making a free one, and its kind
_LEFT_OVER = re.compile(r"[0-9a-f]{12}\.(partial|old)")
_PROBE_BYTES: Capacity[int] = 2**22  # what a run of a thousand frames writes, about


def _sibling(path: Path, kind: str) -> Path:
    """Return a unique hidden name beside `path`, on the same file system, so that a rename is
    atomic.
    """
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.{kind}")


def lock_path(path: Path) -> int | None:
    """Lock a file or folder for this process; return the descriptor that holds the lock, None if
    another holds it.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        return None
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            os.close(descriptor)
            return None
        # A file system without locks: nothing can be known to be left over.
    return descriptor


def _remove_leftovers(target: Path) -> None:
    """Remove what killed processes left of their attempts to write `target`."""
    if fcntl is None:
        return
    prefix = f".{target.name}."
    try:
        found = [
            path
            for path in target.parent.iterdir()
            if path.name.startswith(prefix) and _LEFT_OVER.fullmatch(path.name, len(prefix))
        ]
    except OSError:
        return
    for path in found:
        # killed between two renames: the only copy there is
        if path.suffix == ".old" and not target.exists():
            logger.warning(
                "%s is the earlier content of %s, kept when a process was killed", path, target
            )
        else:
            _remove_unlocked(path)


def _remove_unlocked(path: Path) -> None:
    """Remove a file or folder that no living process has locked."""
    descriptor = None if path.is_symlink() else lock_path(path)
    if descriptor is None:
        return
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()
    os.close(descriptor)


@contextlib.contextmanager
def _partial_folder(target: Path) -> Iterator[Path]:
    """Make and lock a folder for `target` to be written in; what was made and not renamed is
    removed at the end.
    """
    parents = [parent for parent in target.parents if not parent.exists()]
    partial: Path | None = None
    lock: int | None = None
    try:
        with _writing(target):
            # one may be taken for a leftover before it is locked
            while partial is None or not partial.is_dir():
                partial = _sibling(target, "partial")
                partial.mkdir(parents=True)
                lock = lock_path(partial)
        yield partial
    finally:
        if lock is not None:
            os.close(lock)
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
        _remove_empty(parents)


def _remove_empty(folders: Sequence[Path]) -> None:
    for folder in folders:
        with contextlib.suppress(OSError):  # not empty
            folder.rmdir()


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Raise DataError, which names the path, in the place of OSError."""
    try:
        yield
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> DataError:
    return DataError(
        f"cannot write {path}: {error.strerror or error}; choose a writable path with enough free "
        "space"
    )


def open_own(path: Path, mode: Literal["wb", "ab", "r+b"]) -> BinaryIO:
    """Open a file of this program's for writing, whose content `wb` removes; a link is not
    followed.

    Raises:
        DataError: it is a link, which could lead to another's file, or no file.
        OSError: it cannot be opened.
    """
    check_own(path)  # in words; what replaces it meanwhile is not opened
    flags = os.O_RDWR | (0 if mode == "r+b" else os.O_CREAT) | (os.O_APPEND if mode == "ab" else 0)
    descriptor = os.open(path, flags | _NO_LINK, 0o666)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise DataError(f"{path}: is no file; remove it, and repeat the command")
    if mode == "wb":
        os.ftruncate(descriptor, 0)
    return os.fdopen(descriptor, mode)


def check_own(path: Path) -> None:
    """Raise DataError where a file or folder of this program's is a link, which could lead to
    another's.
    """
    try:
        found = path.lstat()
    except OSError:  # opening it says why
        return
    if path.is_symlink() or (stat.S_ISREG(found.st_mode) and found.st_nlink > 1):
        raise DataError(
            f"{path}: is a link, and another file would be overwritten; remove it, and repeat the "
            "command"
        )


def atomic_write_bytes(path: str | os.PathLike[str], *parts: bytes | memoryview) -> None:
    """Write a file of parts, one behind the other, atomically: it holds either its old content or
    all of the new. Its folder must exist.

    Raises:
        DataError: the folder is missing or not writable, or the disk is full.
    """
    target = Path(path)
    _remove_leftovers(target)
    partial = _sibling(target, "partial")
    with _writing(target):
        try:
            with partial.open("xb") as stream:
                if fcntl is not None:
                    with contextlib.suppress(OSError):
                        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                for part in parts:
                    stream.write(part)
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)


def atomic_write_text(path: str | os.PathLike[str], text: str) -> None:
    r"""Write a UTF-8 text file with `\n` line ends, atomically; its folder must exist.

    Raises:
        DataError: the folder is missing or not writable, or the disk is full.
    """
    atomic_write_bytes(path, text.encode("utf-8"))


def check_new_file(path: Path, sign: bytes | None = None) -> None:
    """Refuse a file that would replace one which this program did not write.

    Args:
        path: to be written.
        sign: what our own files of this kind hold, which may be replaced; None: none can be
            distinguished from others.

    Raises:
        DataError: it exists and is another's.
    """
    if not path.exists():
        return
    with _writing(path):
        ours = sign is not None and path.is_file() and sign in path.read_bytes()
    if not ours:
        fault = "exists" if sign is None else "exists and was not made by this command"
        raise DataError(f"{path} {fault}; remove it, or choose another name")


@contextlib.contextmanager
def atomic_folder(
    path: str | os.PathLike[str],
    *,
    replace: bool,
    marker: str | None = None,
    own: Collection[str] | None = None,
) -> Iterator[Path]:
    """Yield a temporary folder that becomes `path` when the block succeeds, and is removed when it
    fails.

    Missing parent folders are created (and removed again on failure). With `replace`, an old folder
    is moved aside at the end and removed only after the new one is in place; it must be empty or
    hold the file named by `marker`, and only names in `own` where those are given, so that a
    mistyped path never deletes a user's own files.

    Raises:
        VioError: `path` exists and may not be replaced.
        DataError: the parent is not writable, or the disk is full.
    """
    target = Path(path).absolute()
    check_replaceable(target, replace, marker, own)
    _remove_leftovers(target)
    with _partial_folder(target) as partial:
        try:
            yield partial
        except OSError as error:
            if error.errno in _NO_SPACE:
                raise _unwritable(target, error) from error
            raise
        # another process may have created it meanwhile
        check_replaceable(target, replace, marker, own)
        with _writing(target):
            _swap_in(partial, target)


def check_replaceable(
    target: Path, replace: bool, marker: str | None, own: Collection[str] | None = None
) -> None:
    """Raise VioError unless `target` is free or may be replaced under the rules of
    `atomic_folder`.
    """
    if not os.path.lexists(target):
        return
    if not replace:
        raise VioError(
            f"{target} exists already; choose another path, remove it, or allow it to be replaced"
        )
    if target.is_symlink() or not target.is_dir():
        raise VioError(f"{target} is not a folder and will not be replaced; choose another path")
    held = sorted(path.name for path in target.iterdir())
    if held:
        _check_made_here(target, marker)
    if own is not None:
        _check_nothing_foreign(target, [name for name in held if name not in own])


def _check_made_here(target: Path, marker: str | None) -> None:
    """Raise VioError where a folder lacks the file by which an earlier result is recognised."""
    if marker is not None and (target / marker).is_file():
        return
    wanted = "" if marker is None else f" (it has no {marker})"
    raise VioError(
        f"{target} was not made by this program{wanted} and will not be replaced; choose "
        "another path"
    )


def _check_nothing_foreign(target: Path, foreign: list[str]) -> None:
    """Raise VioError where a folder holds files that are no part of an earlier result."""
    if not foreign:
        return
    names = ", ".join(foreign[:3]) + (" and more" if len(foreign) > 3 else "")
    raise VioError(
        f"{target} holds {names} beside an earlier result and will not be replaced; move that "
        "away, or choose another path"
    )


def check_spares(source: Path, target: Path) -> None:
    """Raise VioError if replacing a folder would remove the recording that it is made from."""
    own = source.resolve()
    there = target.resolve()
    if there == own or there in own.parents:
        raise VioError(
            f"{target}: holds the recording {source} itself and will not be replaced; choose "
            "another path"
        )


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check, before work of minutes begins, that a folder can be written: a few MiB beside it,
    which are removed again.

    Raises:
        DataError: no folder can be made there, or the disk is full.
    """
    target = Path(path).absolute()
    with _partial_folder(target) as partial, _writing(target):
        (partial / "probe").write_bytes(bytes(_PROBE_BYTES))


@contextlib.contextmanager
def locked_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Create a folder if it is missing and lock it for this process; one that is empty at the end
    is removed again.

    Raises:
        VioError: another process holds the lock.
        DataError: the folder cannot be created.
    """
    target = Path(path).absolute()
    missing = [folder for folder in (target, *target.parents) if not folder.exists()]
    with _writing(target):
        target.mkdir(parents=True, exist_ok=True)
    lock = lock_path(target)
    if lock is None:
        raise VioError(
            f"{target}: another process is writing into this folder; choose another path, or wait "
            "for it"
        )
    try:
        yield target
    finally:
        os.close(lock)
        _remove_empty(missing)


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
        logger.warning(
            "%s is written, but the folder it replaced is still at %s: %s", target, old, error
        )
