"""Where tasks are done: processes of this machine, or a Dask cluster.

Both do the same with each task.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, as_completed
from typing import Any

from vio.bench.execute import end_processes, failed, perform_job
from vio.bench.identity import code_and_packages
from vio.errors import MissingDependencyError, VioError, extra_text
from vio.numerics.kinds import Capacity

log = logging.getLogger(__name__)
Job = dict[str, Any]
Record = dict[str, Any]
Perform = Callable[[Job, str], Record]
_POLL_S: Capacity[float] = 0.5


def run_here(
    jobs: Mapping[str, Job], cache: str, *, workers: int, perform: Perform = perform_job
) -> Iterator[tuple[str, Record]]:
    """Yield key and record of each job as it is done, by up to `workers` processes of this
    machine at a time.
    """
    with ThreadPoolExecutor(workers) as pool:
        futures: dict[Future[Record], str] = {
            pool.submit(perform, job, cache): key for key, job in jobs.items()
        }
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:  # also where the consumer stops: nothing goes on behind it
            pool.shutdown(wait=False, cancel_futures=True)
            end_processes()


def run_on_dask(
    jobs: Mapping[str, Job], cache: str, *, address: str, wait_s: float = 300.0
) -> Iterator[tuple[str, Record]]:
    """Yield key and record of each job as it is done by the workers of the Dask scheduler at an
    address.

    A worker that is lost costs its tasks a repetition. A scheduler that is lost is waited for,
    `wait_s` at most, and what has not come back is sent again. `cache` is a folder on the workers.

    Raises:
        MissingDependencyError: Dask is not installed.
        VioError: there is no scheduler at the address, or it did not come back.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingDependencyError(f"--scheduler needs Dask; {extra_text('cluster')}") from error
    connect: Any = Client  # its annotations are incomplete
    pending = dict(jobs)
    last_s = time.monotonic()
    first = True
    while pending:
        try:
            with connect(address, timeout=min(wait_s, 10.0), set_as_default=False) as client:
                if first:
                    _check_workers(client, pending)
                first = False
                last_s = time.monotonic()
                for key, record in _session(client, pending, cache):
                    del pending[key]
                    yield key, record
        except ImportError as error:
            raise VioError(
                f"a Dask worker cannot import stereo-vio ({error}); install it there, the same "
                "version"
            ) from error
        except (OSError, TimeoutError, ValueError) as error:
            if first or time.monotonic() - last_s > wait_s:
                raise _no_scheduler(address, error) from error
        if pending:
            log.warning(
                "the scheduler %s was lost; waiting for it with %d tasks left",
                address,
                len(pending),
            )
            time.sleep(_POLL_S)


def _no_scheduler(address: str, error: Exception) -> VioError:
    why = " ".join(str(error).split()) or type(error).__name__
    return VioError(
        f"no Dask scheduler at {address} ({why}); start one with dask scheduler, and workers with "
        "dask worker"
    )


def _check_workers(client: Any, jobs: Mapping[str, Job]) -> None:
    """Refuse workers whose results would be others, before the first task; one that comes later
    refuses its tasks.
    """
    wanted = next(((job["code"], job["packages"]) for job in jobs.values() if "code" in job), None)
    if wanted is None:
        return
    found: dict[str, tuple[str, dict[str, str]]] = client.run(code_and_packages)
    for address, (code, packages) in found.items():
        differ = [
            f"{name} {packages.get(name)}"
            for name, version in wanted[1].items()
            if packages.get(name) != version
        ]
        if code != wanted[0] or differ:
            what = f"packages ({', '.join(differ)})" if differ else "code"
            raise VioError(
                f"the Dask worker {address} has other {what} than this command; install the same "
                "versions"
            )


def _session(client: Any, jobs: Mapping[str, Job], cache: str) -> Iterator[tuple[str, Record]]:
    """Yield what one connection to the scheduler brings; return when it is lost, or all is done."""
    from distributed import KilledWorker

    futures = {
        client.submit(perform_job, job, cache, key=f"vio-{key}", pure=False): key
        for key, job in list(jobs.items())
    }
    while futures:
        done = [future for future in futures if future.done()]
        if not done:
            if client.status != "running":
                return
            time.sleep(_POLL_S)
        for future in done:
            key = futures.pop(future)
            try:
                record = future.result()
            except CancelledError:  # as all are when the scheduler is lost
                return
            except KilledWorker as error:
                record = failed(" ".join(str(error).split()), keep=False)
            future.release()
            yield key, record
