"""The progress bar, drawn to a string that acts as a terminal."""

from __future__ import annotations

import io
import sys

import pytest

from vio.cli import waiting
from vio.cli.output import ProgressBar
from vio.errors import NOTE
from vio.view import stream


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def _terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Replace stderr; called in the test itself, since pytest sets its own after the fixtures."""
    out = Terminal()
    monkeypatch.setattr(sys, "stderr", out)
    return out


def test_advance_counts_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = _terminal(monkeypatch)
    with ProgressBar("drive", 40, unit="frames") as bar:
        for _ in range(40):
            bar.advance()
    last = terminal.getvalue().split("\r")[-1]
    assert last.startswith("drive: 100%")
    assert "40/40" in last
    assert "frames/s" in last


def test_total_may_be_given_later(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = _terminal(monkeypatch)
    with ProgressBar("check") as bar:
        bar.update(3)
        bar.update(4, 8)
    last = terminal.getvalue().split("\r")[-1]
    assert "4/8" in last
    assert "50%" in last


def test_the_next_part_of_the_work_is_named(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(waiting, "_LINES", waiting._LineRules(0.0, 0.0))
    with caplog.at_level(NOTE), ProgressBar("look for the board", unit="frames") as bar:
        bar.update(11, 11)
        bar.begin("compare halves")
        assert waiting._WORK[-1]() == "compare halves"
        bar.update(1, 2)
    assert caplog.messages == [
        "look for the board: 11 of 11 frames",
        "compare halves: 1 of 2 frames",
    ]
    terminal = _terminal(monkeypatch)
    with ProgressBar("drive", 4) as bar:
        bar.update(4)
        bar.begin("measure")
        bar.update(1, 2)
    last = terminal.getvalue().split("\r")[-1]
    assert last.startswith("measure:  50%")
    assert "1/2" in last


def test_bar_is_closed_when_the_work_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = _terminal(monkeypatch)

    def work() -> None:
        with ProgressBar("drive", 4) as bar:
            bar.update(2)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()
    assert terminal.getvalue().endswith("\n"), "the error is printed below the bar"


def test_draws_nothing_where_stderr_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressBar("drive", 4) as bar:
        bar.update(2, 9)
        bar.advance()
    assert capsys.readouterr() == ("", "")


def test_the_address_of_a_page_is_no_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(stream.time, "sleep", interrupted)
    with caplog.at_level(NOTE):
        stream.wait_for_interrupt("http://127.0.0.1:9090")
    assert [record.levelno for record in caplog.records] == [NOTE]
