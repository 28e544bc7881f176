"""A whole bench: tasks from the store or an engine, and the tables, the report and the list of
results.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from vio._version import __version__
from vio.bench.engines import run_here, run_on_dask
from vio.bench.execute import failed
from vio.bench.identity import (
    ROOT,
    Identity,
    InputDigests,
    code_digest,
    commit_of,
    digest_of,
    machine,
    package_versions,
)
from vio.bench.report import latex_of, write_bench_report
from vio.bench.rigs import agreement_lines, agreements
from vio.bench.store import Record, Store
from vio.bench.suite import Suite
from vio.bench.tables import (
    SUCCESS_COVERAGE,
    Outcome,
    csv_of_rows,
    csv_of_runs,
    markdown,
    summary_rows,
)
from vio.bench.tasks import Task, tasks_of
from vio.bench.worker import reference_fault
from vio.errors import DataError
from vio.files.atomic import atomic_write_text, check_writable, locked_folder
from vio.files.inputs import read_input
from vio.files.printable import json_text
from vio.protocols import Progress

log = logging.getLogger(__name__)
RESULTS = "bench.json"
_OF_FIELDS = (
    "By how much the disparities that two runs on one rig find to be off differ over the image. Stated: "
    "the standard deviation of the difference. Its NEES is 1 for independent drives with a rig that "
    "has not moved, and below 1 for runs on the same images."
)
FILES = (RESULTS, "tables.md", "tables.tex", "table.csv", "runs.csv", "report.html")


@dataclass(frozen=True, slots=True)
class Place:
    """Where a bench finds and keeps things, and what does its tasks."""

    data: Path  # the recordings
    out: Path  # tables and report
    cache: Path  # results of tasks, renders, digests: shared by all benches that name it
    workers: int = 1
    scheduler: str | None = None  # address of a Dask scheduler in the place of processes here
    identity: Identity = "content"
    peers: Path | None = None  # SEQUENCE.SYSTEM.tum


@dataclass(frozen=True, slots=True)
class Result:
    """What a bench found."""

    outcomes: tuple[Outcome, ...]
    reused: int  # of them taken from the store
    facts: dict[str, Any]  # as in bench.json

    @property
    def failures(self) -> tuple[Outcome, ...]:
        """Runs without a result."""
        return tuple(outcome for outcome in self.outcomes if outcome.failure is not None)


def bench(suite: Suite, place: Place, progress: Progress = lambda done, total: None) -> Result:
    """Run all tasks of a suite that have no result yet, and write tables and report.

    Raises:
        VioError: the folders cannot be written, or the scheduler is missing.
    """
    check_writable(place.out)
    store = Store(place.cache / "results")
    digests = InputDigests(place.cache / "inputs.json", place.identity)
    tasks = tasks_of(suite, place.data, digests, place.peers)
    digests.save()
    with locked_folder(place.out):
        records, missing = _known_and_missing(tasks, store)
        reused = len(records)
        wrong = _wrong_references(missing)
        missing = {key: job for key, job in missing.items() if key not in wrong}
        tasks = [replace(task, failure=wrong.get(task.key, task.failure)) for task in tasks]
        _warn_of_failures(tasks)
        progress(len(tasks) - len(missing), len(tasks))
        cache = str(place.cache.absolute())
        if place.scheduler is not None and missing:
            results = run_on_dask(missing, cache, address=place.scheduler)
        else:
            results = run_here(missing, cache, workers=place.workers)
        for key, record in results:
            if record.pop("keep", True):
                store.put(key, record)
            records[key] = _without_poses(record)
            progress(len(tasks) - len(missing) + len(records) - reused, len(tasks))
        return _write(suite, place, tasks, records, store, reused)


def _warn_of_failures(tasks: Iterable[Task]) -> None:
    """Log once for each sequence why it cannot be run."""
    failures = {task.sequence: task.failure for task in tasks if task.failure is not None}
    for sequence, why in failures.items():
        log.warning("%s cannot be run: %s", sequence, why)


def _known_and_missing(
    tasks: Iterable[Task], store: Store
) -> tuple[dict[str, Record], dict[str, dict[str, Any]]]:
    """Return the results that are there and the jobs of those that are not, by key.

    The largest is first: a long one that begins last keeps all others waiting.
    """
    records: dict[str, Record] = {}
    missing: dict[str, dict[str, Any]] = {}
    for task in sorted(tasks, key=lambda task: -task.size):
        if task.failure is None and task.key not in records:
            record = store.get(task.key)
            if record is None:
                missing[task.key] = task.job
            else:
                records[task.key] = _without_poses(record)
    return records, missing


def read_bench(folder: Path) -> tuple[tuple[Outcome, ...], dict[str, Any]]:
    """Read the results of a bench's folder, and what it says of itself.

    Raises:
        DataError: it is no bench's folder, or damaged.
    """
    path = folder / RESULTS
    try:
        facts = json.loads(read_input(path))
        outcomes = tuple(Outcome(**{**values, "curve": None}) for values in facts["outcomes"])
    except FileNotFoundError as error:
        raise DataError(
            f"{folder}: no results (it has no {RESULTS}); give the --out folder of a vio bench"
        ) from error
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise DataError(
            f"{path}: is damaged ({error}); repeat the bench, finished tasks are not run again"
        ) from error
    return outcomes, facts


def _wrong_references(jobs: Mapping[str, dict[str, Any]]) -> dict[str, str]:
    """Return why the ground truth of some tasks cannot be that of their recording; each is read
    once.
    """
    faults: dict[str, str | None] = {}
    wrong = {}
    for key, job in jobs.items():
        if job["source"] is not None and job["kind"] == "run":
            inputs = digest_of([job[name] for name in ("source", "reference", "start", "stop")])
            if inputs not in faults:
                faults[inputs] = reference_fault(job)
            if (why := faults[inputs]) is not None:
                wrong[key] = why
    return wrong


def _without_poses(record: Record) -> Record:
    """Return a record for tables alone: ten thousand trajectories would fill the memory."""
    return {name: value for name, value in record.items() if name != "trajectory"}


def _write_trajectories(
    folder: Path, tasks: Iterable[Task], records: Mapping[str, Record], store: Store
) -> None:
    """Write the poses of each run that has some, in TUM's form."""
    folder.mkdir(exist_ok=True)
    for task in tasks:
        poses = None
        if task.key in records:
            poses = (store.get(task.key) or {}).get("trajectory")
        if poses is not None:
            atomic_write_text(
                folder / f"{task.sequence}.{task.system}.{task.seed}.tum",
                "\n".join([*poses, ""]),
            )


def _write(
    suite: Suite,
    place: Place,
    tasks: Sequence[Task],
    records: Mapping[str, Record],
    store: Store,
    reused: int,
) -> Result:
    rigs = {sequence.name: sequence.rig for sequence in suite.sequences}
    outcomes = tuple(
        replace(_outcome(task, records, suite.success_percent), rig=rigs[task.sequence])
        for task in tasks
    )
    facts = {
        "suite": suite.name,
        "version": __version__,
        "commit": commit_of(ROOT),
        "machine": machine(),
        "code": code_digest(),
        "packages": package_versions(),
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "seeds": list(suite.seeds),
        "titles": dict(suite.titles),
        "drawn_each_seed": [s.name for s in suite.sequences if s.render_each_seed],
        "outcomes": [outcome.as_dict() for outcome in outcomes],
    }
    rows = summary_rows(outcomes)
    tables = markdown(suite, rows, outcomes, facts)
    if agreed := agreements(suite, outcomes):
        facts["rigs"] = [one.as_dict() for one in agreed]
        tables += "\n".join(
            [f"\n## Stereo fields of one rig\n\n{_OF_FIELDS}\n", *agreement_lines(agreed), ""]
        )
    texts = {
        "tables.md": tables,
        "tables.tex": latex_of(tables),
        "table.csv": csv_of_rows(rows),
        "runs.csv": csv_of_runs(outcomes),
        RESULTS: json_text(facts, indent=1) + "\n",
    }
    for name, text in texts.items():
        atomic_write_text(place.out / name, text)
    write_bench_report(place.out / "report.html", suite, rows, outcomes, facts)
    _write_trajectories(place.out / "trajectories", tasks, records, store)
    return Result(outcomes, reused, facts)


def _outcome(task: Task, records: Mapping[str, Record], success_percent: float) -> Outcome:
    if task.failure is None:
        record = records.get(task.key)
    else:
        record = failed(task.failure, keep=False)
    if record is None:
        record = failed("it was not done", keep=False)
    return Outcome(
        sequence=task.sequence,
        system=task.system,
        seed=task.seed,
        key=task.key,
        figures=record["figures"],
        measured=record["measured"],
        failure=record["failure"],
        curve=record["curve"],
        warnings=tuple(record.get("warnings", ())),
        notes=tuple(record.get("notes", ())),
        absent=record.get("absent", {}),
        stereo_field=record.get("stereo_field"),
        succeeded=has_succeeded(record, success_percent),
    )


def has_succeeded(record: Record, percent: float) -> bool | None:
    """Whether a run ended with a small error over most frames.

    None: without a reference, or at rest.
    """
    if record["failure"] is not None:
        return False
    ate_m, length_m, covered = (
        record["figures"].get(name) for name in ("ate_m", "reference_m", "coverage")
    )
    if ate_m is None or not length_m:
        return None
    return bool(
        ate_m < percent / 100 * length_m and covered is not None and covered >= SUCCESS_COVERAGE
    )
