"""The second process that compiles at the first run of a machine."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from vio import warm_up
from vio.filters import track_loops

COMPARE = """
import sys
from numba.core.dispatcher import Dispatcher
from vio import load_config, open_dataset, run
from vio.filters import pose_loops, track_loops
from vio.warm_up import warm_up

warm_up()
modules = pose_loops, track_loops
loops = [f for m in modules for f in vars(m).values() if isinstance(f, Dispatcher) and f.__module__ == m.__name__]
known = {f: len(f.signatures) for f in loops}
assert sum(map(bool, known.values())) > 20
for settings in (["motion=imu"], ["motion=none", "msckf.calibrate_stereo='on'"]):
    run(open_dataset(sys.argv[1]), load_config(overrides=settings))
print("new:", [f.py_func.__name__ for f in loops if len(f.signatures) > known[f]])
"""


class _Process:
    """A process that does nothing."""

    started: list[list[str]]

    def __init__(self, command: list[str], **_: object) -> None:
        self.started.append(command)
        self.ended = False

    def kill(self) -> None:
        self.ended = True

    def wait(self) -> None:
        assert self.ended


def test_the_filters_loops_that_it_compiles_are_those_that_runs_call(flight: Path) -> None:
    command = [sys.executable, "-c", COMPARE, str(flight)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "new: []\n"


@pytest.mark.parametrize(
    ("cached", "processors", "expected"),
    [("nothing", 2, 1), ("stale", 2, 1), ("fresh", 2, 0), ("nothing", 1, 0), ("unwritable", 2, 0)],
)
def test_it_starts_only_where_nothing_is_cached_and_a_processor_is_free(
    cached: str, processors: int, expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Stats:
        cache_path = None if cached == "unwritable" else str(tmp_path)

    class Loop:
        stats = Stats()

    source = tmp_path / "source.py"
    source.write_text("")
    if cached in ("stale", "fresh"):
        index = tmp_path / "track_loops.eliminate_tracks-1.py310.nbi"
        index.write_text("")
        later = source.stat().st_mtime_ns + (10**9 if cached == "fresh" else -(10**9))
        os.utime(index, ns=(later, later))
    monkeypatch.setattr(track_loops, "eliminate_tracks", Loop())
    monkeypatch.setattr(track_loops, "__file__", str(source))
    monkeypatch.setattr(warm_up, "_free_processors", lambda: processors)
    monkeypatch.setattr(_Process, "started", [], raising=False)
    monkeypatch.setattr(subprocess, "Popen", _Process)
    with warm_up.compiling_beside():
        assert len(_Process.started) == expected


def test_processors_that_others_keep_busy_are_not_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    for load, free in ((0.2, 2.0), (1.0, 2.0), (2.5, 0.5)):
        monkeypatch.setattr(os, "getloadavg", lambda load=load: (load, 9.0, 9.0), raising=False)
        assert warm_up._free_processors() == free


def test_a_run_goes_on_where_no_process_can_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError("no more processes")

    monkeypatch.setattr(warm_up, "_is_cold", lambda: True)
    monkeypatch.setattr(warm_up, "_free_processors", lambda: 2.0)
    monkeypatch.setattr(subprocess, "Popen", refuse)
    with warm_up.compiling_beside():
        pass
