"""`vio bench` on a real Dask scheduler with two workers, one of which is killed, and which is
restarted itself.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.commands import PATIENCE_S, wait_for
from tests.dataset_makers import make_drive, make_mat, utias_arrays
from vio.bench.bench import Place, Result, bench
from vio.bench.engines import run_on_dask
from vio.bench.identity import ROOT, InputDigests
from vio.bench.suite import suite_from
from vio.bench.tasks import tasks_of
from vio.bench.worker import perform
from vio.errors import VioError

distributed = pytest.importorskip("distributed", reason="needs the extra cluster")


class Cluster:
    """Processes of `dask scheduler` and `dask worker` on this machine: two workers stand for two
    machines.
    """

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self._port}"
        self._folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []

    def scheduler(self) -> subprocess.Popen[bytes]:
        """Start a scheduler on always the same port."""
        return self._start(
            "scheduler", "--host", "127.0.0.1", "--port", str(self._port), "--no-dashboard"
        )

    def worker(self) -> subprocess.Popen[bytes]:
        """Start a worker for one task at a time."""
        options = (
            "--no-nanny",
            "--nthreads",
            "1",
            "--no-dashboard",
            "--local-directory",
            str(self._folder),
        )
        return self._start("worker", self.address, *options)

    def wait_for_workers(self, number: int) -> None:
        """Return when the scheduler knows so many."""
        with distributed.Client(self.address, timeout=PATIENCE_S, set_as_default=False) as client:
            client.wait_for_workers(number, timeout=PATIENCE_S)

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        environment = os.environ | {
            "PYTHONPATH": str(ROOT),
            "DASK_DISTRIBUTED__WORKER__MEMORY__TERMINATE": "false",
        }
        command = [sys.executable, "-m", "dask", *words]
        with (self._folder / "dask.log").open("ab") as log:
            process = subprocess.Popen(
                command, env=environment, cwd=self._folder, stdout=log, stderr=log
            )
        self._processes.append(process)
        return process

    def stop(self) -> None:
        """End all processes."""
        for process in self._processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    with contextlib.closing(_Closing(Cluster(tmp_path))) as held:
        yield held.cluster


class _Closing:
    def __init__(self, cluster: Cluster) -> None:
        self.cluster = cluster

    def close(self) -> None:
        self.cluster.stop()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals")
def test_lost_workers_and_a_lost_scheduler_cost_no_row(cluster: Cluster, tmp_path: Path) -> None:
    """Two machines' worth of workers, one killed in its task, the scheduler restarted, a corrupt
    recording among good.

    The table is complete, the failed row says why, and all figures are those of a run in this
    process, to the bit.
    """
    sequences = {f"drive{k}": f"drive{k}.mat" for k in range(2)}
    for k, name in enumerate(sequences.values()):
        make_mat(tmp_path / name, utias_arrays(make_drive(12, seed=k, pixel_sigma=0.3)))
    (tmp_path / "corrupt.mat").write_bytes((tmp_path / "drive0.mat").read_bytes()[:3000])
    given = {
        "sequences": {"corrupt": "corrupt.mat", **sequences},
        "configurations": {"images": {"motion": "none"}},
    }
    suite = suite_from(given, tmp_path / "suite.yaml")
    scheduler = cluster.scheduler()
    workers = [cluster.worker(), cluster.worker()]
    cluster.wait_for_workers(2)  # else the first may do all tasks before the second has come
    cache = tmp_path / "cache"
    place = Place(data=tmp_path, out=tmp_path / "out", cache=cache, scheduler=cluster.address)
    found: list[Result] = []
    driver = threading.Thread(target=lambda: found.append(bench(suite, place)))
    driver.start()
    wait_for(lambda: len(list(cache.glob("task-*/job.json"))) == 2)  # both are at work
    os.kill(workers[0].pid, signal.SIGKILL)
    wait_for(lambda: any(cache.glob("results/*/*.json")))
    os.kill(scheduler.pid, signal.SIGKILL)
    cluster.scheduler()
    cluster.worker()
    driver.join(PATIENCE_S)
    assert found, (tmp_path / "dask.log").read_text(errors="replace")[-2000:]
    outcomes = {o.sequence: o for o in found[0].outcomes}
    assert [o.sequence for o in found[0].failures] == ["corrupt"]
    assert "corrupt.mat" in (outcomes["corrupt"].failure or "")
    for task in tasks_of(suite, tmp_path, InputDigests(tmp_path / "inputs.json")):
        if task.sequence in sequences:
            assert (
                perform({**task.job, "scratch": str(tmp_path)})["figures"]
                == outcomes[task.sequence].figures
            )


def test_no_scheduler_is_an_error_in_one_line(tmp_path: Path) -> None:
    jobs: dict[str, Any] = {"key": {}}
    with pytest.raises(
        VioError, match=r"no Dask scheduler at tcp://127\.0\.0\.1:9.*start one"
    ) as error:
        list(run_on_dask(jobs, str(tmp_path), address="tcp://127.0.0.1:9", wait_s=0.3))
    assert "\n" not in str(error.value)
