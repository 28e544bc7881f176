"""One task, wherever it is done: render what it needs, start a process, try again where that is
lost.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vio.bench.identity import ROOT
from vio.errors import DataError, VioError
from vio.files.atomic import lock_path
from vio.numerics.kinds import Capacity

try:
    import fcntl
except ImportError:  # Windows: two tasks may render the same; the second result replaces the first
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)
RETRIES = 2  # of a process that was killed: memory may be free again by then
_LAST_WORDS: Capacity[int] = 2000  # characters of stderr that a report of a crash is taken from
_running: set[subprocess.Popen[str]] = set()
_lock = threading.Lock()


def perform_job(job: dict[str, Any], cache: str) -> dict[str, Any]:
    """Do one task in a process of its own, again where that is killed; return its record, which
    may be a failure.
    """
    try:
        Path(cache).mkdir(parents=True, exist_ok=True)
        job = rendered_sources(job, Path(cache))
        lost = 0
        while True:
            record, number = _in_process(job, Path(cache))
            if record is not None:
                record["lost_processes"] = lost
                return record
            lost += 1
            if lost > RETRIES:
                hint = (
                    "; out of memory? Use fewer --workers"
                    if number == getattr(signal, "SIGKILL", 9)
                    else ""
                )
                name = signal.Signals(number).name
                return failed(f"its process was ended by {name}, {lost} times{hint}", keep=False)
    except VioError as error:
        return failed(" ".join(str(error).split()), keep=False)
    except OSError as error:
        return failed(
            f"cannot use {error.filename or cache}: {error.strerror or error}", keep=False
        )


def rendered_sources(job: dict[str, Any], cache: Path) -> dict[str, Any]:
    """Return a job with the folders of its renders as sources; they are made now unless they are
    there.
    """
    job = {**job, "first": job.get("first") and dict(job["first"])}
    for part in (job, job["first"]):
        if part is not None and part["render"] is not None:
            part["source"] = str(_rendered(part["render"], cache))
    return job


def failed(reason: str, *, keep: bool) -> dict[str, Any]:
    """Return the record of a task that has no result, for a reason in one line.

    `keep`: the same would happen again, so that the task need not be repeated.
    """
    return {
        "figures": {},
        "measured": {},
        "failure": reason,
        "keep": keep,
        "curve": None,
        "trajectory": None,
    }


def end_processes() -> None:
    """End all processes of this one's tasks."""
    with _lock:
        for process in _running:
            process.kill()


def _in_process(job: dict[str, Any], cache: Path) -> tuple[dict[str, Any] | None, int]:
    """Run one worker; return its record, or None and the signal that ended it."""
    with _task_folder(cache) as folder:
        job = {**job, "scratch": str(folder)}
        (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
        try:
            status, words = _call(
                [sys.executable, "-m", "vio.bench.worker", str(folder)], job.get("time_limit_s")
            )
        except subprocess.TimeoutExpired as late:
            return failed(
                f"it took longer than the time limit of {late.timeout:g} s", keep=False
            ), 0
        result = folder / "result.json"
        if result.is_file():
            record: dict[str, Any] = json.loads(result.read_text(encoding="utf-8"))
            return record, 0
    if status < 0:
        return None, -status
    last = (words.strip() or "no message").splitlines()[-1]
    return failed(f"the program failed, please report it: {last}", keep=False), 0


def _rendered(render: dict[str, Any], cache: Path) -> Path:
    """Return the folder of a rendered recording, made now unless it is there."""
    folder = cache / "renders" / render["key"]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_name(f".{folder.name}.lock").open("w") as stream:
        if fcntl is not None:  # another process of this machine that has it is waited for
            fcntl.flock(stream, fcntl.LOCK_EX)
        if not folder.is_dir():
            command = [
                sys.executable,
                "-m",
                "vio",
                "render",
                *render["words"],
                "--workers",
                "1",
                "--out",
                str(folder),
            ]
            status, words = _call([*command, "--json"])
            if status:
                last = (words.strip() or f"exit status {status}").splitlines()[-1]
                raise DataError(
                    f"vio render {' '.join(render['words'])}: {last.removeprefix('error: ')}"
                )
    return folder


def _call(command: list[str], limit_s: float | None = None) -> tuple[int, str]:
    """Run a command that ends with this process; return its status and the end of its stderr."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    }
    with tempfile.TemporaryFile(mode="w+", encoding="utf-8", errors="replace") as words:
        process = subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=words,
            text=True,
        )
        with _lock:
            _running.add(process)
        try:
            status = process.wait(limit_s)
        finally:
            with _lock:
                _running.discard(process)
            process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
        words.seek(0)
        text = words.read()
    return status, text[-_LAST_WORDS:]


@contextlib.contextmanager
def _task_folder(cache: Path) -> Iterator[Path]:
    """A folder for one task, locked meanwhile; those without a lock, which killed processes
    left, are removed.
    """
    for left in cache.glob("task-*") if fcntl is not None else ():
        if (taken := lock_path(left)) is not None:
            shutil.rmtree(left, ignore_errors=True)
            os.close(taken)
    while True:
        folder = Path(tempfile.mkdtemp(prefix="task-", dir=cache))
        lock = lock_path(folder)
        if folder.is_dir():  # another process may have taken it for a leftover before it was locked
            break
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            os.close(lock)
