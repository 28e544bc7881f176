"""Every command of `tools/` says what it does, and does nothing else, with `--help`."""

from __future__ import annotations

import ast
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def _is_command(path: Path) -> bool:
    """Return whether a file does something when it is run as a program."""
    return any(
        isinstance(node, ast.If) and "'__main__'" in ast.unparse(node.test)
        for node in ast.parse(path.read_text(encoding="utf-8")).body
    )


def _commands() -> list[str]:
    files = [path for path in sorted((ROOT / "tools").rglob("*.py")) if _is_command(path)]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files]
    return [name.removesuffix(".__main__") for name in names]


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize("command", _commands())
def test_tools_print_their_help(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [command, "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(command, run_name="__main__")
    assert ended.value.code == 0
    assert "usage:" in capsys.readouterr().out


def test_the_tools_that_are_commands_are_found() -> None:
    assert {"tools.mutate", "tools.faults", "tools.release"} <= set(_commands())
    assert "tools.faults.changes" not in _commands()
