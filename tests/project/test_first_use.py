"""The first use on a machine: each wait has a line, loops are compiled in processes side by side,
and a signal ends a run that compiles.
"""

from __future__ import annotations

import io
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import vio.filters.track_loops
import vio.frontend.align
from tests.commands import wait_for
from vio.cli import waiting
from vio.cli.output import ProgressBar
from vio.cli.stopping import StopRequest
from vio.cli.waiting import SilenceBroken, line_due, stage, working
from vio.errors import NOTE
from vio.live import first_use
from vio.live.first_use import Part, compile_part, compiled_beside
from vio.numerics import compiling, prebuilt
from vio.numerics.compiled import LOOPS, compiled
from vio.records import RunMotion


def test_work_without_a_terminal_says_that_it_begins_and_how_far_it_is(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(waiting, "_LINES", waiting._LineRules(0.0, 0.0))
    with caplog.at_level(NOTE), ProgressBar("running x", 3, unit="frames", announced=True) as bar:
        bar.advance()
        bar.advance()
    assert caplog.messages == [
        "running x: 3 frames",
        "running x: 1 of 3 frames",
        "running x: 2 of 3 frames",
    ]


def test_the_clock_of_a_bar_goes_on_while_a_part_of_the_work_is_silent(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setattr(waiting, "_LINES", waiting._LineRules(0.1, 0.0))
    with caplog.at_level(NOTE), SilenceBroken("check"), ProgressBar("check x") as bar:
        bar.begin("check x: match images")
        drawn = terminal.getvalue().count("match images")
        wait_for(lambda: terminal.getvalue().count("match images") > drawn + 2)
    assert not caplog.messages


def test_short_work_is_silent_where_it_is_not_announced(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(NOTE), ProgressBar("convert x", 3) as bar:
        bar.update(3)
    assert not caplog.messages


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A loop that no cache holds, and its counts."""
    progress = compiling.Progress()
    monkeypatch.setattr(compiling, "PROGRESS", progress)
    namespace: dict[str, Any] = {}
    exec("def doubled(x):\n    return 2.0 * x\n", namespace)  # without a file, it has no cache
    loop = compiled(namespace["doubled"])
    yield loop, progress
    LOOPS.remove(loop)


def test_compiling_is_counted_and_said_every_few_seconds(
    uncompiled: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, progress = uncompiled
    monkeypatch.setattr(compiling, "_LINE_S", 0.0)
    with caplog.at_level(NOTE):
        assert loop(1.5) == 3.0
        assert loop(2.5) == 5.0
    assert (progress.compiled, progress.is_compiling) == (1, False)
    assert caplog.messages == ["compiling loops, once: 1 of about 170"]


def test_a_signal_ends_a_run_that_compiles_at_once() -> None:
    with StopRequest() as asked:
        signal.raise_signal(signal.SIGINT)  # after the present frame
    assert asked.reason() == "interrupted"
    with StopRequest() as asked, compiling.PROGRESS.waiting(), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    assert asked.reason() == "interrupted"


class _Helper:
    """A process that compiles, as a test sees it."""

    made: ClassVar[list[_Helper]] = []

    def __init__(self, command: list[str], stdout: int) -> None:
        self.part = command[-2]
        self.calls: list[str] = []
        self.stdout = io.BytesIO(b"...")
        self.made.append(self)

    def wait(self) -> None:
        self.calls.append("waited for")

    def terminate(self) -> None:
        self.calls.append("terminated")


@pytest.fixture
def helpers(monkeypatch: pytest.MonkeyPatch) -> list[_Helper]:
    """The processes that are started where nothing is compiled."""
    monkeypatch.setattr(prebuilt, "is_usable", lambda: False)
    monkeypatch.setattr(first_use, "is_cached", lambda: False)
    monkeypatch.setattr(subprocess, "Popen", _Helper)
    monkeypatch.setattr(_Helper, "made", [])
    return _Helper.made


def test_each_part_is_compiled_beside_and_waited_for(
    helpers: list[_Helper], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiling, "PROGRESS", compiling.Progress())  # says nothing at first
    with caplog.at_level(NOTE), compiled_beside(("frontend", "filter"), "imu"):
        assert compiling.before_first_call is not None
        with compiled_beside(("filter",), "imu"):  # as a run inside a demo
            compiling.before_first_call("vio.filters.track_loops")
            compiling.before_first_call("vio.cameras.projection")
    assert compiling.before_first_call is None
    frontend, filter_ = helpers
    assert (frontend.part, filter_.part) == ("frontend", "filter")
    assert frontend.calls == ["terminated", "waited for"]
    assert filter_.calls == ["waited for", "terminated", "waited for"]
    assert caplog.messages == [
        "compiling loops, once for this installation: about 60 s of computing"
    ]


def test_nothing_is_started_where_the_loops_are_at_hand(
    helpers: list[_Helper], monkeypatch: pytest.MonkeyPatch
) -> None:
    for found in (prebuilt, "is_usable"), (first_use, "is_cached"):
        with monkeypatch.context() as patch, compiled_beside((), "imu"):
            patch.setattr(*found, lambda: True)
            with compiled_beside(("filter",), "imu"):
                pass
    assert not helpers


@pytest.mark.parametrize(
    ("part", "motion", "module", "loops"),
    [
        ("filter", "imu", vio.filters.track_loops, ("square_tracks", "collect_tracks", "refine")),
        ("filter", "velocity", vio.filters.track_loops, ("square_tracks", "collect_tracks")),
        ("frontend", "none", vio.frontend.align, ("_refine",)),
    ],
)
def test_a_part_calls_the_loops_of_a_run(
    part: Part, motion: RunMotion, module: Any, loops: tuple[str, ...], monkeypatch: Any
) -> None:
    called = []
    for name in loops:
        loop = getattr(module, name)
        monkeypatch.setattr(
            module, name, lambda *a, _l=loop, _n=name: (called.append(_n), _l(*a))[1]
        )
    compile_part(part, motion)
    assert set(loops) & set(called)


def test_features_are_those_of_points_that_a_swaying_camera_sees() -> None:
    features = first_use._Features()
    before, z_before = features.seen(0, 0.0)
    after, z_after = features.seen(1, 0.1)
    both, rows, later = np.intersect1d(before, after, return_indices=True)
    assert len(both) > 50
    disparity = z_before[rows, 0] - z_before[rows, 2]
    moved = z_before[rows, 0] - z_after[later, 0]
    # the camera moves by its baseline: the left image then shows what the right one did
    np.testing.assert_allclose(moved, disparity, atol=6 * first_use._RUN.noise_px)


def test_a_process_compiles_a_part(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "vio.live.first_use", "filter", "none"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    assert set(done.stdout) <= {"."}


def test_one_count_is_of_all_processes_that_compile(
    helpers: list[_Helper], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    progress = compiling.Progress()
    monkeypatch.setattr(compiling, "PROGRESS", progress)
    monkeypatch.setattr(compiling, "_LINE_S", 0.0)

    def counts() -> list[int]:
        return [int(line.split()[3]) for line in caplog.messages if ", once: " in line]

    with caplog.at_level(NOTE), compiled_beside(("frontend", "filter"), "imu"):
        wait_for(lambda: len(counts()) == 6)
    assert sorted(counts()) == [1, 2, 3, 4, 5, 6]
    progress.compiled = compiling.USUAL_LOOPS + 1
    assert progress.line() == f"compiling loops, once: {compiling.USUAL_LOOPS + 1}"


def test_a_silent_wait_gets_a_line_that_says_what_goes_on(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(waiting, "_LINES", waiting._LineRules(0.05, 0.0))
    with caplog.at_level(NOTE), SilenceBroken("vio run"):
        wait_for(lambda: any(m.startswith("vio run, ") for m in caplog.messages))
        with ProgressBar("running x", 3, unit="frames"):
            wait_for(lambda: any("running x: 0 of 3 frames, " in m for m in caplog.messages))
            with stage("drawing"):
                wait_for(lambda: any("drawing, " in m for m in caplog.messages))
                with working(lambda: None):  # as a server does
                    time.sleep(0.1)
                    said = len(caplog.messages)
                    time.sleep(0.2)
                    assert len(caplog.messages) == said
    said = len(caplog.messages)
    time.sleep(0.2)
    assert len(caplog.messages) == said  # it ends with the block


def test_lines_become_rarer_where_the_work_takes_long() -> None:
    assert not line_due(4.0, 4.0)
    assert line_due(6.0, 6.0)
    assert not line_due(60.0, 11.0)
    assert line_due(60.0, 12.0)
    assert line_due(10_000.0, 30.0)
