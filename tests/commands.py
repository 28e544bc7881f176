"""Commands as tests call them: a render, a refusal, and a condition that another process
fulfils.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

# ends a test that hangs; beside other work each process may take half a minute to start
PATIENCE_S = 600.0


def render(folder: Path, **options: str) -> Path:
    """Render a flight into `folder` and return it."""
    from vio.cli import main

    arguments = [word for name, value in options.items() for word in (f"--{name}", value)]
    assert main(["render", "--out", str(folder), "--json", "--workers", "1", *arguments]) == 0
    return folder


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Return the error of a command, which must end with status 1 and print this one line alone."""
    from vio.cli import main

    capsys.readouterr()
    assert main([*map(str, arguments)]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1, printed.err
    return printed.err


def json_of(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> Any:
    """Return the object that a command prints with `--json`; it must succeed and print nothing
    else.
    """
    from vio.cli import main

    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == 0
    out = capsys.readouterr().out
    assert out.count("\n") == 1, "one object, nothing else, on stdout"
    return json.loads(out)


def wait_for(holds: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
    """Wait until `holds` returns true; fail after `seconds`."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)
