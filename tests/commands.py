"""Commands as tests call them: a render, a refusal, and a condition that another process fulfils."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

PATIENCE_S = 600.0  # ends a test that hangs; beside other work each process may take half a minute to start


def render(folder: Path, **options: str) -> Path:
    """Render a flight into `folder` and return it."""
    from vio.cli import main

    arguments = [word for name, value in options.items() for word in (f"--{name}", value)]
    assert main(["render", "--out", str(folder), "--json", "--workers", "1", *arguments]) == 0
    return folder


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return the error message of a command that must end with status 1."""
    from vio.cli import main

    assert main(list(arguments)) == 1
    return capsys.readouterr().err


def wait_for(holds: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
    """Wait until `holds` returns true; fail after `seconds`."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)
