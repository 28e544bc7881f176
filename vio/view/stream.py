"""Where a run is shown: a window, a browser, or a file."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from vio.errors import NOTE, ConfigError, DataError, extra_text
from vio.numerics.kinds import Capacity

if TYPE_CHECKING:
    import rerun as rr

log = logging.getLogger(__name__)

_WEB_PORT = 9090
_APPLICATION = "stereo-vio"  # rerun's name of the program, which stands in the head of its files
_RRD = b"RRF"  # what a file of rerun begins with
_HEAD_BYTES: Capacity[int] = 4096  # of a file, among which the program is named


def open_stream(where: str, name: str) -> tuple[rr.RecordingStream, str | None]:
    """Return a stream into the viewer (`spawn`), a file (`*.rrd`) or a browser (`web`), and the
    address of the latter.

    Raises:
        ConfigError: rerun is not installed, `where` is something else, or there is no screen for a
            window.
        DataError: the file cannot be written.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise ConfigError(f"--view needs rerun; {extra_text('view')}") from error
    stream = rr.RecordingStream(_APPLICATION, recording_id=None)
    stream.send_recording_name(name)
    address = None
    if where == "spawn":
        if sys.platform.startswith("linux") and not (
            os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        ):
            raise ConfigError("--view: there is no screen here; use --view web, or --view FILE.rrd")
        stream.spawn()
    elif where == "web":
        served = stream.serve_grpc()
        rr.serve_web_viewer(web_port=_WEB_PORT, connect_to=served, open_browser=False)
        address = f"http://127.0.0.1:{_WEB_PORT}/?url={quote(served, safe='')}"
    elif where.endswith(".rrd"):
        _check_file(Path(where))
        stream.save(Path(where))
    else:
        raise ConfigError(
            f"--view {where}: takes nothing (a window), web, or a file *.rrd; write SOURCE before "
            "it"
        )
    return stream, address


def _check_file(path: Path) -> None:
    """Raise DataError where a file cannot be written; what it holds stays until the first frame
    comes.
    """
    if not path.parent.is_dir():
        raise DataError(f"{path}: its folder does not exist; create it or choose another")
    try:
        if not _is_replaceable(path):
            raise DataError(
                f"{path} exists and was not made by this command; remove it, or choose another name"
            )
        path.open("ab").close()
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror})") from error


def _is_replaceable(path: Path) -> bool:
    """Whether a file is not there, empty, or a recording that this program made."""
    if not os.path.lexists(path):
        return True
    if path.is_symlink() or not path.is_file():
        return False
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    return not head or (head.startswith(_RRD) and _APPLICATION.encode() in head)


def wait_for_interrupt(address: str) -> None:
    """Serve the page until Ctrl-C."""
    log.log(NOTE, "shown at %s; Ctrl-C ends the server", address)
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            time.sleep(3600)
