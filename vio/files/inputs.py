"""Reading of files that others wrote: regular ones, up to a size.

A pipe without a writer would block for ever, a device never end, and a file of many gigabytes fill
the memory.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from vio.numerics.kinds import Capacity

MAX_BYTES: Capacity[int] = 2**30  # of a text file: an hour of IMU at 1 kHz is half of that
# `vio eval <(command) …` reads a pipe with a writer.
_READABLE = (os.devnull, "/dev/fd/", "/proc/self/fd/", "/dev/stdin")


def check_regular(path: Path) -> None:
    """Raise OSError, with a reason in its `strerror`, unless a path names a file that can be read
    to its end.

    Folders pass: what opens one raises its own OSError.
    """
    mode = os.stat(path).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)) and not os.fspath(path).startswith(_READABLE):
        raise OSError(errno.EINVAL, "it is a pipe, socket or device, no file", os.fspath(path))


def read_input(path: Path, most_bytes: int = MAX_BYTES) -> bytes:
    """Read a whole file.

    Raises:
        OSError: it cannot be read, is no regular file or larger than the limit; `strerror` says
            which.
    """
    check_regular(path)
    with path.open("rb") as stream:
        # A buffer of the file's size: one of `most_bytes` costs five times as much as reading an
        # image does.
        size = os.fstat(stream.fileno()).st_size
        data = stream.read(size + 1 if 0 < size < most_bytes else most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"it has more than {most_bytes / 2**20:g} MiB", os.fspath(path))
    return data
