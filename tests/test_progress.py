"""The progress bar, drawn on a terminal that is a string."""

from __future__ import annotations

import io

import pytest

from vio.cli.progress import ProgressBar


class Terminal(io.StringIO):
    """What was drawn, as a terminal would have shown it line by line."""

    def isatty(self) -> bool:
        return True

    def frames(self) -> list[str]:
        """Every line that was ever drawn over the one before."""
        return self.getvalue().rstrip("\n").split("\r")[1:]

    def screen(self) -> str:
        """What stands there in the end: later characters lie over earlier ones."""
        shown = ""
        for frame in self.frames():
            shown = frame + shown[len(frame) :]
        return shown.rstrip()


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_the_bar_says_how_far_how_fast_and_how_long() -> None:
    terminal, clock = Terminal(), Clock()
    bar = ProgressBar("drive", 40, unit="frames", stream=terminal, clock=clock)
    clock.now += 2.0
    bar.update(10)
    assert terminal.screen() == "drive [" + "#" * 7 + "-" * 23 + "] 10/40 5.0 frames/s 0:00:02 0:00:06 left"
    clock.now += 3700.0
    bar.update(40)
    bar.close()
    assert terminal.screen() == "drive [" + "#" * 30 + "] 40/40 0.0 frames/s 1:01:42"
    assert terminal.getvalue().endswith("\n")
    assert terminal.getvalue().count("\n") == 1


def test_steps_are_counted_though_they_are_not_all_drawn() -> None:
    terminal, clock = Terminal(), Clock()
    with ProgressBar("rows", 1000, stream=terminal, clock=clock) as bar:
        for _ in range(1000):
            clock.now += 0.01
            bar.advance()
    assert 90 < len(terminal.frames()) < 110
    assert "1000/1000" in terminal.screen()


def test_a_total_may_come_later() -> None:
    terminal, clock = Terminal(), Clock()
    with ProgressBar("check", stream=terminal, clock=clock) as bar:
        bar.update(3)
        assert terminal.screen() == "check 3/? 0:00:00"
        clock.now += 1.0
        bar.update(4, 8)
        assert "4/8" in terminal.screen()
        assert terminal.screen().endswith("0:00:01 left")


def test_a_line_never_wraps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "24")
    terminal = Terminal()
    with ProgressBar("a recording with a long name", 10, stream=terminal) as bar:
        bar.update(5)
    assert all(len(frame) <= 23 for frame in terminal.frames())


def test_the_bar_is_left_when_the_work_fails() -> None:
    terminal = Terminal()

    def work() -> None:
        with ProgressBar("drive", 4, stream=terminal) as bar:
            bar.update(2)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()
    assert terminal.getvalue().endswith("\n"), "the error's line stands below the bar"


def test_nothing_is_drawn_where_stderr_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressBar("drive", 4) as bar:
        bar.update(2)
        bar.advance()
    assert capsys.readouterr() == ("", "")


def test_a_bar_without_steps_leaves_no_line() -> None:
    terminal = Terminal()
    ProgressBar("drive", 4, stream=terminal).close()
    assert terminal.getvalue() == ""
