"""What a killed, terminated or hindered process leaves on the disk, and when it says so."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from vio.cli.running import check_out
from vio.errors import DataError, VioError
from vio.files.atomic import atomic_folder, atomic_write_text, check_writable

HOLD = """
import sys, time
import vio.cli
from vio.files.atomic import atomic_folder

def hold(args):
    with atomic_folder(sys.argv[1], replace=True) as folder:
        (folder / "half.txt").write_text("half")
        print("writing", flush=True)
        time.sleep(60)

class Args: command, debug, execute = "hold", False, staticmethod(hold)
class Parser:
    def parse_known_args(self, argv): return Args, []
vio.cli.build_parser = Parser
sys.exit(vio.cli.main([]))
"""


def _take_interrupts() -> None:
    """Undo what shell and nohup do to background jobs: they ignore Ctrl-C and hang-ups, and so
    do their children.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def _writing(out: Path) -> subprocess.Popen[str]:
    """Start a process that writes a folder, and wait until it does."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=_take_interrupts,
    )
    assert process.stdout.readline() == "writing\n"
    return process


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGINT, 130)]
)
def test_signals_end_orderly(number: signal.Signals, status: int, tmp_path: Path) -> None:
    process = _writing(tmp_path / "deep" / "out")
    process.send_signal(number)
    _, err = process.communicate(timeout=30)
    assert process.returncode == status, err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_next_write_removes_what_a_killed_process_left(tmp_path: Path) -> None:
    process = _writing(tmp_path / "out")
    with atomic_folder(tmp_path / "out", replace=True):
        assert len(list(tmp_path.glob(".out.*.partial"))) == 2, "a living process keeps its own"
    (tmp_path / "out").rmdir()
    process.kill()
    process.communicate(timeout=30)
    left = list(tmp_path.glob(".out.*.partial"))
    assert [sorted(path.name for path in folder.iterdir()) for folder in left] == [["half.txt"]]
    (tmp_path / ".out.notes.partial").mkdir()  # not ours
    (tmp_path / ".outer.0123456789ab.partial").mkdir()  # of another target
    with atomic_folder(tmp_path / "out", replace=True) as folder:
        (folder / "whole.txt").write_text("whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        ".out.notes.partial",
        ".outer.0123456789ab.partial",
        "out",
    ]


def test_leftover_files_are_removed_and_the_only_copy_is_kept(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / ".a.txt.0123456789ab.partial").write_text("ha")
    atomic_write_text(tmp_path / "a.txt", "whole")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    # killed between moving the old folder away and the new one in
    (tmp_path / ".out.0123456789ab.old").mkdir()
    with atomic_folder(tmp_path / "out", replace=True):
        assert (tmp_path / ".out.0123456789ab.old").is_dir()
    assert "kept when a process was killed" in caplog.text
    with atomic_folder(tmp_path / "out", replace=True):
        assert not (tmp_path / ".out.0123456789ab.old").exists()


@pytest.mark.parametrize("place", ["/proc/runs/out", "{tmp}/file/out", "{tmp}/" + 240 * "x"])
def test_unwritable_out_is_said_before_the_first_frame(place: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("a file")
    with pytest.raises(VioError, match=r"cannot write .*; choose a writable path"):
        check_out(Path(place.format(tmp=tmp_path)))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_full_disk_is_said_before_the_first_frame(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk; the system reports both while writing."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(
            DataError, match=r"cannot write .*out: File too large; choose .* enough free space"
        ):
            check_writable(tmp_path / "deep" / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []
    check_writable(tmp_path / "deep" / "out")
    assert list(tmp_path.iterdir()) == []
