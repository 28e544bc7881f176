"""Faults that are drawn, not chosen: kind, recording, size, moment and length from a seed.

    python -m tools.faults.draws --data DIR --seed S --draws N [--minutes M] [--kinds work|kept|all]
        [--recordings work|kept|all] [--kind NAME …] [--front-end NAME] [--out FILE]
    python -m tools.faults.draws --data DIR --seed S --one K
    python -m tools.faults.draws --table FILE …

The first form appends a JSON line for each draw to a file of `--work`; draws that it holds are not
run again, so an interrupted call goes on. Half of the kinds and recordings are `kept` aside: run
them at the end, not while working on the checks. Draw K of a seed is the same whatever N is; the
second form runs it alone. The third prints the distribution by kind, Markdown; with `--page`, it
writes docs/fault_draws.md.
"""

from __future__ import annotations

import argparse
import json
import logging
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from tools.faults.changes import Changed, Period
from tools.faults.drawn_page import page, tables
from tools.faults.healthy import HEALTHY
from tools.faults.kinds import HALVES, KINDS, Half, Kind
from tools.faults.recordings import SOURCES, Source, ready
from tools.faults.scores import Usual, code_of, new_flags, score
from vio import evaluate, load_config, open_dataset
from vio.bench.identity import commit_of
from vio.errors import VioError
from vio.files.atomic import atomic_write_text
from vio.protocols import Dataset
from vio.records import MotionSource
from vio.runs.pipeline import RunResult, run

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/fault_draws.md"
CLEAN = "clean"
HEALTHY_SHARE = 0.2  # of the draws
Choice: TypeAlias = Literal["work", "kept", "all"]
_BEGIN = 0.2, 0.7  # of a fault: shares of the recording
_LENGTH_S = 0.3, 4.0  # drawn evenly in its logarithm


@dataclass(frozen=True, slots=True)
class Draw:
    """A fault of a recording, or a healthy variant of it."""

    seed: int
    number: int
    source: str
    motion: MotionSource | None
    kind: str
    half: Half | None  # None: a healthy variant
    size: float
    begin: float  # share of the recording
    length_s: float

    @property
    def rng(self) -> np.random.Generator:
        """Random numbers for what the kind draws itself."""
        return np.random.default_rng([self.seed, self.number, 1])


def draw(seed: int, number: int, kinds: Sequence[str], sources: Sequence[Source]) -> Draw:
    """Return draw `number` of a seed, of some kinds and recordings."""
    rng = np.random.default_rng([seed, number, 0])
    healthy = rng.random() < HEALTHY_SHARE
    names = [name for name in HEALTHY if name != CLEAN] if healthy else list(kinds)
    name = names[int(rng.integers(len(names)))]
    kind = None if healthy else KINDS[name]
    usable = [
        (source, motion)
        for source in sources
        for motion in source.motions
        if kind is None or kind.group == "cameras" or motion == "imu"
    ]
    source, motion = usable[int(rng.integers(len(usable)))]
    begin = float(rng.uniform(*_BEGIN))
    length_s = float(np.exp(rng.uniform(*np.log(_LENGTH_S))))
    size = 1.0 if kind is None else kind.drawn_size(rng)
    half = None if kind is None else HALVES[name]
    return Draw(seed, number, source.name, motion, name, half, size, begin, length_s)


@dataclass(frozen=True, slots=True)
class Setup:
    """Where recordings and renders lie, and the front end that sees them."""

    data: Path
    work: Path
    front_end: str = "klt"


def run_clean(source: Source, motion: MotionSource | None, setup: Setup) -> dict[str, Any]:
    """Run a recording as it is."""
    dataset = _opened(source, setup)
    outcome = _run(dataset, source, motion, setup)
    row: dict[str, Any] = {"kind": CLEAN, "source": source.name, "motion": motion, "codes": []}
    if isinstance(outcome, VioError):
        return row | {"error": str(outcome)}
    row["codes"] = list(dict.fromkeys(flag.code for flag in new_flags(outcome.findings, ())))
    return row | {"ate_m": _ate_m(outcome)} | score(outcome, Usual(), 0, source.truth_sigma_m)


def run_draw(drawn: Draw, clean: dict[str, Any], setup: Setup) -> dict[str, Any]:
    """Run a draw, and compare it with its recording as it is."""
    source = next(s for s in SOURCES if s.name == drawn.source)
    kind = KINDS.get(drawn.kind) if drawn.half is not None else None
    dataset = _opened(source, setup)
    times_ns = dataset.recording.frame_times_ns[: source.frames]
    period = _period(drawn, times_ns)
    variant = HEALTHY[drawn.kind] if kind is None else kind.make(drawn.size, drawn.rng)
    changed = variant(dataset, period)
    onset = _onset(kind, period, times_ns)
    row: dict[str, Any] = asdict(drawn) | {"onset": onset, "clean_ate_m": clean.get("ate_m")}
    start = time.process_time()
    outcome = _run(changed, source, drawn.motion, setup)
    row["cpu_s"] = round(time.process_time() - start, 1)
    if isinstance(outcome, VioError):
        return row | {"error": code_of(str(outcome)), "flagged_after": None, "silent": False}
    row["ate_m"] = _ate_m(outcome)
    usual = Usual(tuple(clean["codes"]), clean.get("ratio", 0.0))
    return row | score(outcome, usual, onset, source.truth_sigma_m)


def _opened(source: Source, setup: Setup) -> Dataset:
    dataset = open_dataset(ready(source, setup.data, setup.work))
    return Changed(dataset, dataset.recording, iter)


def _period(drawn: Draw, times_ns: np.ndarray) -> Period:
    first, last = times_ns[[0, -1]].tolist()
    begin = first + round(drawn.begin * (last - first))
    return Period(begin, begin + round(1e9 * drawn.length_s))


def _onset(kind: Kind | None, period: Period, times_ns: np.ndarray) -> int:
    """The first frame that a fault concerns."""
    if kind is None or kind.lasting == "always":
        return 0
    return int(np.searchsorted(times_ns, period.begin_ns))


def _run(
    dataset: Dataset, source: Source, motion: MotionSource | None, setup: Setup
) -> RunResult | VioError:
    overrides = [f"motion={motion or 'none'}", f"frontend.name={setup.front_end}"]
    config = load_config(overrides=overrides)
    stop = source.frames
    stop = None if stop is None else min(stop, len(dataset.recording.frame_times_ns))
    try:
        return run(dataset, config, stop=stop)
    except VioError as error:
        return error


def _ate_m(result: RunResult) -> float:
    reference = result.recording.reference
    assert reference is not None
    return evaluate(result.trajectory, reference, T_cam0_imu=result.T_cam0_body).ate_m.rmse


def rows_of(path: Path) -> list[dict[str, Any]]:
    """Return the whole lines of a file of draws; a line that is cut is run again."""
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


Work: TypeAlias = Callable[[], dict[str, Any]]


def _rows_by(
    pool: ProcessPoolExecutor, works: Iterator[Work], workers: int, until: float
) -> Iterator[dict[str, Any]]:
    """Yield rows as they are done; nothing is begun after a time."""
    running: set[Future[dict[str, Any]]] = set()
    more = True
    while more or running:
        while more and len(running) < workers:
            work = next(works, None) if time.monotonic() < until else None
            more = work is not None
            if work is not None:
                running.add(pool.submit(work))
        done, running = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            yield future.result()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tools.faults.draws",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--data", type=Path, metavar="DIR", help="the recordings")
    parser.add_argument("--seed", type=int, default=0, metavar="S")
    parser.add_argument("--draws", type=int, default=500, metavar="N")
    parser.add_argument("--minutes", type=float, default=60.0, metavar="M")
    parser.add_argument("--kinds", choices=("work", "kept", "all"), default="work")
    parser.add_argument("--recordings", choices=("work", "kept", "all"), default="work")
    parser.add_argument("--kind", nargs="+", default=[], choices=sorted(KINDS), metavar="NAME")
    parser.add_argument("--one", type=int, metavar="K", help="run one draw and print its row")
    parser.add_argument("--front-end", default="klt", choices=("klt", "orb", "sift"))
    parser.add_argument("--workers", type=int, default=2, metavar="W")
    parser.add_argument(
        "--work", type=Path, default=Path("results"), metavar="DIR", help="renders and rows"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="rows (default: in --work)")
    parser.add_argument("--table", nargs="+", type=Path, metavar="FILE", help="print the table")
    parser.add_argument("--page", action="store_true", help=f"write docs/{PAGE.name} from --table")
    return parser


def main() -> int:
    """Run what the command line names."""
    parser = _parser()
    options = parser.parse_args()
    logging.basicConfig(level=logging.ERROR)
    if options.table:
        rows = [row for path in options.table for row in rows_of(path)]
        if options.page:
            atomic_write_text(PAGE, page(rows, commit_of(ROOT) or "unknown"))
        else:
            print("\n\n".join(tables(rows)))
        return 0
    if options.data is None or not options.data.is_dir():
        parser.error("--data takes the folder of recordings, as the end of docs/results.md says")
    kinds = options.kind or [n for n in KINDS if options.kinds in ("all", HALVES[n])]
    sources = [s for s in SOURCES if options.recordings in ("all", s.half)]
    setup = Setup(options.data, options.work / "renders", options.front_end)
    drawing = partial(draw, options.seed, kinds=kinds, sources=sources)
    if options.one is not None:
        drawn = drawing(options.one)
        source = next(s for s in sources if s.name == drawn.source)
        print(json.dumps(run_draw(drawn, run_clean(source, drawn.motion, setup), setup)))
        return 0
    _run_all([drawing(k) for k in range(options.draws)], sources, setup, options)
    return 0


def _run_all(
    drawn: Sequence[Draw], sources: Sequence[Source], setup: Setup, options: argparse.Namespace
) -> None:
    """Run the draws that a file does not hold yet, and add them to it."""
    for source in sources:
        ready(source, setup.data, setup.work)
    out = options.out or options.work / f"fault_draws-{options.seed}.jsonl"
    rows = rows_of(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    atomic_write_text(out, "".join(f"{json.dumps(row)}\n" for row in rows))
    until = time.monotonic() + 60 * options.minutes
    clean = {(r["source"], r["motion"]): r for r in rows if r["kind"] == CLEAN}
    done = {(r["seed"], r["number"]) for r in rows if r["kind"] != CLEAN}
    wanted = [d for d in drawn if (d.seed, d.number) not in done]
    by_name = {source.name: source for source in sources}
    needed = list(dict.fromkeys((d.source, d.motion) for d in wanted))
    # not forked: what rendered holds locks of threads
    spawned = multiprocessing.get_context("spawn")
    pools = ProcessPoolExecutor(options.workers, mp_context=spawned)
    with pools as pool, out.open("a", encoding="utf-8") as file:

        def kept(works: Iterator[Work]) -> Iterator[dict[str, Any]]:
            for row in _rows_by(pool, works, options.workers, until):
                print(json.dumps(row), file=file, flush=True)
                yield row

        missing = [key for key in needed if key not in clean]
        cleans = (partial(run_clean, by_name[name], motion, setup) for name, motion in missing)
        clean |= {(row["source"], row["motion"]): row for row in kept(cleans)}
        works = (
            partial(run_draw, d, clean[d.source, d.motion], setup)
            for d in wanted
            if (d.source, d.motion) in clean
        )
        for number, row in enumerate(kept(works), len(done) + 1):
            print(f"{number} {_line(row)}", file=sys.stderr, flush=True)


def _line(row: dict[str, Any]) -> str:
    """A row in one line for the terminal."""
    head = f"{row['source']}, {row['motion'] or 'images'}: {row['kind']} {row['size']:.3g}"
    if "error" in row:
        return f"{head}: refused, {row['error'][:60]}"
    after = row["flagged_after"]
    flagged = "silent" if row["silent"] else "not flagged" if after is None else f"after {after}"
    return f"{head}: {row['ratio']:.1f} sigma, {flagged}"


if __name__ == "__main__":
    sys.exit(main())
