"""Run recordings with faults of camera and IMU, and in healthy variants, and write docs/faults.md.

    python -m tools.faults --data DIR [--workers N] [--work DIR]
    python -m tools.faults --data DIR --only RECORDING … --variants VARIANT … [--set key=value]
    python -m tools.faults --table

The first form runs all of `RUNS` (half an hour on two cores) and keeps the figures with commit,
machine and date in docs/faults.json; an interrupted call goes on where it stopped, by a file of its
commit in `--work`. The second prints a JSON line for each run and writes nothing; a variant is a
name or a group. The third writes the page from the figures kept.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tools.faults import GROUPS
from tools.faults.changes import Changed, Period
from tools.faults.page import page
from vio import __version__, evaluate, load_config, open_dataset
from vio.bench.identity import commit_of, machine, package_versions
from vio.errors import VioError
from vio.files.atomic import atomic_write_text
from vio.files.trajectories import read_trajectory
from vio.runs.pipeline import RunResult, run

ROOT = Path(__file__).resolve().parents[2]
FIGURES = ROOT / "docs/faults.json"
PAGE = ROOT / "docs/faults.md"
_BEGIN = 0.4  # of a fault: shares of the recording; how long it lasts at most
_END = 0.8
_LENGTH_NS = 3_000_000_000


@dataclass(frozen=True, slots=True)
class Sequence:
    """A recording, and what is run of it."""

    source: str  # among the recordings, as docs/results.md says
    motion: str
    groups: tuple[str, ...]
    reference: str | None = None  # a file in its folder, where the recording itself holds none


RUNS = (
    Sequence("euroc/MH_01_head", "none", ("healthy", "cameras")),
    Sequence("euroc/MH_01_head", "imu", ("healthy", "cameras", "imu")),
    Sequence("karlsruhe_0019_alarm", "none", ("healthy",), "ins_positions.tum"),
    Sequence("kitti_05_clip", "none", ("healthy", "cameras")),
    Sequence("karlsruhe_0019_head", "none", ("healthy",), "ins_positions.tum"),
    Sequence("kitti_03_head", "none", ("healthy",)),
    Sequence("kitti_06_head", "none", ("healthy",)),
    Sequence("kitti_0039", "none", ("healthy",)),
)
Task = tuple[Sequence, str, str]  # with the names of group and variant


def tasks(only: Iterable[str] = (), variants: Iterable[str] = ()) -> Iterator[Task]:
    """Yield what is to be run: of all, or of some recordings and variants (or groups), by name."""
    only = set(only)
    variants = set(variants)
    for sequence in RUNS:
        if not only or Path(sequence.source).name in only:
            for group in sequence.groups:
                for name in GROUPS[group]:
                    if not variants or variants & {group, name}:
                        yield sequence, group, name


def run_task(task: Task, data: Path, overrides: tuple[str, ...] = ()) -> dict[str, Any]:
    """Run one variant of a recording, and return what the page shows of it."""
    logging.basicConfig(level=logging.ERROR)
    sequence, group, name = task
    source = data / sequence.source
    dataset = open_dataset(source)
    recording = dataset.recording
    if sequence.reference is not None:
        recording = replace(recording, reference=read_trajectory(source / sequence.reference))
    first, last = recording.frame_times_ns[[0, -1]].tolist()
    begin, end = (first + round(share * (last - first)) for share in (_BEGIN, _END))
    known = Changed(dataset, recording, iter)
    changed = GROUPS[group][name](known, Period(begin, min(end, begin + _LENGTH_NS)))
    out: dict[str, Any] = {
        "recording": source.name,
        "motion": sequence.motion,
        "group": group,
        "variant": name,
    }
    try:
        result = run(changed, load_config(overrides=[f"motion={sequence.motion}", *overrides]))
    except VioError as error:
        return out | {"error": f"{type(error).__name__}: {error}".replace(str(source), source.name)}
    return out | _figures(result)


def _figures(result: RunResult) -> dict[str, Any]:
    covariance = np.array(result.estimates.column("covariance"))
    sigma_m = float(np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2).max()))
    assert result.recording.reference is not None
    errors_m = evaluate(
        result.trajectory, result.recording.reference, T_cam0_imu=result.T_cam0_body
    ).ate_m
    ratio = errors_m.max / max(sigma_m, 1e-9)
    return {
        "ate_m": errors_m.rmse,
        "sigma_m": sigma_m,
        "ratio": ratio,
        "codes": list(dict.fromkeys(finding.code for finding in result.findings)),
    }


def write(facts: dict[str, Any]) -> None:
    """Write the figures, one run a line, and their page."""
    head = json.dumps({name: value for name, value in facts.items() if name != "runs"})
    rows = ",\n".join(json.dumps(row, ensure_ascii=False) for row in facts["runs"])
    atomic_write_text(FIGURES, f'{head[:-1]}, "runs": [\n{rows}\n]}}\n')
    atomic_write_text(PAGE, page(facts))


def main() -> int:
    """Run what the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, metavar="DIR", help="the recordings (make results VIO_DATA=DIR)"
    )
    parser.add_argument(
        "--work", type=Path, default=Path("results"), metavar="DIR", help="rows of unfinished calls"
    )
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes")
    parser.add_argument("--only", nargs="+", default=[], metavar="RECORDING")
    parser.add_argument("--variants", nargs="+", default=[], metavar="VARIANT")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="key=value")
    parser.add_argument(
        "--table", action="store_true", help="run nothing, write the page from docs/faults.json"
    )
    options = parser.parse_args()
    if options.table:
        write(json.loads(FIGURES.read_text(encoding="utf-8")))
        return 0
    if options.data is None or not options.data.is_dir():
        parser.error(
            "--data takes the folder of recordings; the end of docs/results.md says what lies there"
        )
    work = partial(run_task, data=options.data, overrides=tuple(options.overrides))
    if options.only or options.variants or options.overrides:
        for row in _run(work, list(tasks(options.only, options.variants)), options.workers):
            print(json.dumps(row, ensure_ascii=False), flush=True)
        return 0
    commit = commit_of(ROOT)
    kept = options.work / f"faults-{commit}.jsonl"
    options.work.mkdir(parents=True, exist_ok=True)
    done = {_key(row): row for row in _rows(kept)}
    wanted = {
        (Path(s.source).name, s.motion, group, name): (s, group, name) for s, group, name in tasks()
    }
    atomic_write_text(kept, "".join(f"{json.dumps(row)}\n" for row in done.values()))
    with kept.open("a") as file:
        for row in _run(
            work, [task for key, task in wanted.items() if key not in done], options.workers
        ):
            done[_key(row)] = row
            print(json.dumps(row), file=file, flush=True)
    facts: dict[str, Any] = {"version": __version__, "commit": commit, "machine": machine()}
    facts |= {
        "packages": package_versions(),
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    write(facts | {"runs": [done[key] for key in wanted]})
    return 0


def _rows(kept: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of an interrupted call; one that is not whole is run again."""
    for line in kept.read_text().splitlines(keepends=True) if kept.is_file() else ():
        if line.endswith("\n"):
            yield json.loads(line)


def _run(
    work: Callable[[Task], dict[str, Any]], wanted: list[Task], workers: int
) -> Iterator[dict[str, Any]]:
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(work, wanted)


def _key(row: dict[str, Any]) -> tuple[str, ...]:
    """What names a run."""
    return tuple(row[name] for name in ("recording", "motion", "group", "variant"))


if __name__ == "__main__":
    sys.exit(main())
