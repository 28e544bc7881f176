"""Tables of a bench: each sequence and system over its seeds, each system over the sequences.

Markdown and CSV.
"""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any

from vio.bench.suite import PUBLISHED_MEAN, Suite
from vio.files.printable import printable

SUCCESS_COVERAGE = 0.9  # of the frames, which a run must have poses of to succeed
_ALL_FRAMES = 0.995


@dataclass(frozen=True, slots=True)
class Metric:
    """A figure of the tables."""

    name: str  # in figures, or in what was measured
    title: str
    digits: int  # significant
    larger_is_better: bool = False
    measured: bool = False  # not a property of the estimate: repetitions differ


METRICS = (
    Metric("ate_m", "ATE m", 3),
    Metric("ate_sim3_m", "ATE Sim(3) m", 3),
    Metric("scale_error_percent", "scale off %", 3),
    Metric("rpe_m", "RPE m", 3),
    Metric("drift_percent", "drift %", 3),
    Metric("drift_deg_per_100m", "deg/100 m", 3),
    Metric("coverage", "coverage", 3, larger_is_better=True),
    Metric("nees", "NEES of 6", 3),
    Metric("refused_share", "refused", 2),
    Metric("cpu_ms", "CPU ms a frame", 3, measured=True),
    Metric("memory_mib", "peak MiB", 3, measured=True),
)
# For tables that ask for them, and runs.csv.
MORE_METRICS = (
    Metric("nees_50", "NEES median", 3),
    Metric("nees_95", "NEES 95 %", 3),
    Metric("landmarks_m", "landmarks m", 3),
    Metric("used_per_frame", "used a frame", 3),
    Metric("landmarks", "landmarks", 5),
    Metric("innovation_px", "innovation px", 3),
    Metric("innovation_ratio", "innovation over its sigma", 2),
    Metric("reference_m", "length m", 3),
    Metric("frames", "frames", 6),
    Metric("wall_ms", "wall ms", 3, measured=True),
    Metric("wall_95_ms", "wall ms, 95 %", 3, measured=True),
    Metric("frontend_ms", "front end ms", 3, measured=True),
    Metric("filter_ms", "filter ms", 3, measured=True),
)
OF_MAPS = (
    Metric("map_ate_m", "ATE m in the map", 3),
    Metric("map_causal_ate_m", "causal ATE m in the map", 3),
    Metric("placed", "frames localised", 3, larger_is_better=True),
    Metric("place_s", "first localised s", 3),
    Metric("placed_wrong", "wrong places", 3),
    Metric("again_s", "localised again s", 3),
    Metric("placed_again", "frames localised again", 3, larger_is_better=True),
    Metric("loops", "loops", 4),
    Metric("loops_false", "false loops", 3),
    Metric("loop_error_m", "loop error m", 3),
    Metric("loop_recall", "loop recall", 3, larger_is_better=True),
    Metric("map_nees", "NEES in the map", 3),
    Metric("map_nees_50", "NEES in the map, median", 3),
    Metric("map_nees_95", "NEES in the map, 95 %", 3),
)
BY_NAME = {metric.name: metric for metric in (*METRICS, *MORE_METRICS, *OF_MAPS)}


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run, or one trajectory of another system."""

    sequence: str
    system: str
    seed: int | None  # None: another system's
    key: str
    figures: Mapping[str, Any]
    measured: Mapping[str, Any]
    failure: str | None
    curve: Mapping[str, Any] | None
    warnings: Sequence[str] = ()
    # signs of a reference of another recording or body, or in other conventions
    notes: Sequence[str] = ()
    absent: Mapping[str, str] = field(default_factory=dict)  # by name of an undefined figure: why
    succeeded: bool | None = None  # None: undefined, without a reference
    rig: str | None = None  # that took the sequence; None: one of its own
    # what was found that the stereo calibration is off by, as `DisparityField.as_dict` returns it
    stereo_field: Mapping[str, Any] | None = None

    def value(self, metric: Metric) -> float | None:
        """Return a figure; None: undefined, or the run failed."""
        if self.failure is not None:
            return None
        value = (self.measured if metric.measured else self.figures).get(metric.name)
        return None if value is None else float(value)

    def as_dict(self) -> dict[str, Any]:
        """Return everything but the curve, for JSON."""
        names = (
            "sequence",
            "system",
            "seed",
            "key",
            "figures",
            "measured",
            "failure",
            "absent",
            "succeeded",
            "rig",
            "stereo_field",
        )
        return {
            **{name: getattr(self, name) for name in names},
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }


@dataclass(frozen=True, slots=True)
class Cell:
    """One figure over seeds, or over sequences."""

    median: float
    worst: float
    spread: float  # largest minus smallest
    count: int
    mean: float
    sd: float  # of a sample; 0 of one value


@dataclass(frozen=True, slots=True)
class Row:
    """One sequence with one system over its seeds."""

    sequence: str
    system: str
    is_peer: bool
    runs: int
    failed: int
    cells: Mapping[str, Cell]  # by name of the metric; absent where undefined
    absent: Mapping[str, str] = field(default_factory=dict)  # and then why
    succeeded: int | None = None  # of the runs; None: undefined
    failure: str | None = None  # of the first run without a result


def summary_rows(outcomes: Iterable[Outcome]) -> list[Row]:
    """Return one row for each sequence and system, in the order of the sequences."""
    groups: dict[str, dict[str, list[Outcome]]] = {}
    for outcome in outcomes:
        groups.setdefault(outcome.sequence, {}).setdefault(outcome.system, []).append(outcome)
    return [_row(group) for systems in groups.values() for group in systems.values()]


def _row(group: Sequence[Outcome]) -> Row:
    cells = {
        m.name: cell for m in BY_NAME.values() if (cell := cell_of((o.value(m) for o in group), m))
    }
    first = group[0]
    absent = dict[str, str]()
    for o in reversed(group):
        absent |= o.absent
    judged = [o.succeeded for o in group if o.succeeded is not None]
    failures = [o.failure for o in group if o.failure is not None]
    return Row(
        first.sequence,
        first.system,
        first.seed is None,
        len(group),
        len(failures),
        cells,
        absent,
        sum(judged) if judged else None,
        next(iter(failures), None),
    )


def cell_of(values: Iterable[float | None], metric: Metric) -> Cell | None:
    """Summarise the values that are defined; None: there is none."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    worst = min(known) if metric.larger_is_better else max(known)
    sd = 0.0
    if len(known) > 1:
        sd = statistics.stdev(known)
    return Cell(
        statistics.median(known),
        worst,
        max(known) - min(known),
        len(known),
        statistics.fmean(known),
        sd,
    )


def summary_of(rows: Iterable[Row]) -> dict[str, tuple[int, int, dict[str, Cell]]]:
    """Return by system: sequences with a result, all its sequences, and the medians of these
    over the sequences.
    """
    by_system: dict[str, list[Row]] = {}
    for row in rows:
        by_system.setdefault(row.system, []).append(row)
    out = {}
    for system, own in by_system.items():
        medians = {name: [r.cells[name].median for r in own if name in r.cells] for name in BY_NAME}
        cells = {
            name: cell for name, known in medians.items() if (cell := cell_of(known, BY_NAME[name]))
        }
        out[system] = (sum(row.failed == 0 for row in own), len(own), cells)
    return out


# --- text
# --------------------------------------------------------------------------------------------------


def number(value: float, digits: int) -> str:
    """Return a number with so many significant digits, never in exponents."""
    return f"{Decimal(f'{value:.{digits}g}'):f}"


def _padded(value: float, digits: int) -> str:
    """Return a number with so many significant digits, zeros at its end included."""
    return f"{Decimal(f'{value:#.{digits}g}'):f}"


def cell_text(
    cell: Cell, metric: Metric, runs: int | None = None, *, for_documents: bool = False
) -> str:
    """Return `median` or, where values differ, `median (mean ± standard deviation)`, with n
    where it is not `runs`. `for_documents` leaves out the mean, and gives the standard deviation
    with the median's decimals, where it has any of these.
    """
    differs = cell.count > 1 and cell.spread > 0
    if for_documents:
        whole = float(cell.median).is_integer()
        if whole:
            text = number(cell.median, metric.digits)
        else:
            text = _padded(cell.median, metric.digits)
        digits = len(text.partition(".")[2])
        sd = min(f"{cell.sd:.{digits}f}", _padded(cell.sd, 2), key=len)
        text += f" ± {sd}" if differs and float(sd) else ""
    else:
        text = number(cell.median, metric.digits)
        if differs:
            text += f" ({number(cell.mean, metric.digits)} ± {number(cell.sd, 2)})"
    if runs in (None, cell.count):
        return text
    return f"{text}, n = {cell.count}"


class Notes:
    """Why figures are undefined, numbered as they are asked for."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}

    def dash(self, row: Row, metric: Metric) -> str:
        """Return the text of an undefined figure."""
        lost = None
        if row.failed == row.runs:
            lost = f"no result: {row.failure}"
        return self.because(lost or row.absent.get(metric.name, "not reported"))

    def because(self, why: str) -> str:
        """Return a dash with the number of a reason."""
        return f"– [{self._numbers.setdefault(why, len(self._numbers) + 1)}]"

    def lines(self) -> Iterator[str]:
        """Yield the notes below the table."""
        if self._numbers:
            yield ""
            yield "; ".join(f"[{k}] {printable(why)}" for why, k in self._numbers.items()) + "."


def row_text(row: Row, metric: Metric, notes: Notes, *, for_documents: bool = False) -> str:
    """Return one figure of a row, or a dash with the number of its reason."""
    cell = row.cells.get(metric.name)
    if cell is None:
        return notes.dash(row, metric)
    return cell_text(cell, metric, row.runs, for_documents=for_documents)


def markdown(
    suite: Suite, rows: Sequence[Row], outcomes: Sequence[Outcome], facts: Mapping[str, Any]
) -> str:
    """Return all tables of a bench."""
    seeds = ""
    if len(suite.seeds) > 1:
        seeds = f", seeds {', '.join(map(str, suite.seeds))}"
    parts = [
        f"# {suite.name}\n\n{provenance(facts)}{seeds}.\n",
        "## ATE in m\n\nMedian over the seeds (mean ± standard deviation).\n\n"
        + "\n".join(matrix(rows)),
        "## All figures\n\nMedian over the seeds (mean ± standard deviation), n as in the column "
        "of runs where nothing "
        f"else is said. Success: share of the runs whose ATE is below {suite.success_percent:g} % "
        "of the path and that "
        f"cover {100 * SUCCESS_COVERAGE:g} % of the frames.\n\n" + "\n".join(full_table(rows)),
        "## Systems\n\nMedian and worst over the sequences of the medians over seeds; n in "
        "brackets.\n\n" + "\n".join(system_table(rows)),
    ]
    if mapped := [row for row in rows if any(metric.name in row.cells for metric in OF_MAPS)]:
        parts.append("## Maps\n\n" + "\n".join(full_table(mapped, OF_MAPS)))
    if failures := _failures(outcomes):
        parts.append("## Without a result\n\n" + "\n".join(failures))
    if doubts := _doubts(outcomes):
        parts.append("## Doubts about the ground truth\n\n" + "\n".join(doubts))
    if suite.published:
        parts.append(
            "## Published figures\n\nTheir sources', under their conditions; ours above are "
            "causal, over all frames, "
            "without loops, after SE(3) alignment.\n\n" + "\n".join(published_table(suite))
        )
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def _failures(outcomes: Sequence[Outcome]) -> list[str]:
    """Return a line for each run without a result."""
    lines = []
    for o in outcomes:
        if o.failure is not None:
            if o.seed is None:
                seed = ""
            else:
                seed = f", seed {o.seed}"
            lines.append(f"- {o.sequence}, {o.system}{seed}: {printable(o.failure)}")
    return lines


def _doubts(outcomes: Sequence[Outcome]) -> list[str]:
    """Return a line for each note on a ground truth, once for all seeds."""
    noted = dict.fromkeys((o.sequence, o.system, note) for o in outcomes for note in o.notes)
    return [f"- {sequence}, {system}: {printable(note)}" for sequence, system, note in noted]


def provenance(facts: Mapping[str, Any]) -> str:
    """Return which code made the figures, where and when."""
    versions = ", ".join(f"{name} {version}" for name, version in facts["packages"].items())
    known = (facts.get(name) for name in ("commit", "machine", "written"))
    commit, machine, written = (str(value) if value else "unknown" for value in known)
    return f"stereo-vio {facts['version']}, commit {commit}, {written[:10]}, {machine}; {versions}"


def matrix(
    rows: Sequence[Row],
    metric: Metric = METRICS[0],
    systems: Sequence[str] = (),
    titles: Mapping[str, str] | None = None,
    *,
    for_documents: bool = False,
) -> Iterator[str]:
    """Yield the table of one figure: sequences down, systems across; the smallest of a line in
    bold.

    `systems` are the columns; none: all, ours first. `titles` are those of sequences and systems,
    by name. `for_documents` gives a median without the mean.
    """
    named = titles or {}
    columns = _chosen_systems(rows, systems)
    notes = Notes()
    yield _line([metric.title, *(named.get(s, s) for s in columns)])
    yield "|---|" + "---:|" * len(columns)
    for sequence, own in _by_sequence(rows).items():
        best = _best_systems({s: own[s] for s in columns if s in own}, metric)
        texts = []
        for system in columns:
            text = _cell_text(own.get(system), metric, notes, for_documents=for_documents)
            texts.append(f"**{text}**" if system in best else text)
        yield _line([named.get(sequence, sequence), *texts])
    yield from notes.lines()


def _chosen_systems(rows: Iterable[Row], chosen: Sequence[str]) -> list[str]:
    """Return the chosen ones of the systems in the rows; none chosen: all, ours first."""
    known = dict.fromkeys(row.system for row in sorted(rows, key=lambda row: row.is_peer))
    if chosen:
        return [system for system in chosen if system in known]
    return list(known)


def _by_sequence(rows: Iterable[Row]) -> dict[str, dict[str, Row]]:
    """Return the rows by sequence, then by system."""
    out: dict[str, dict[str, Row]] = {}
    for row in rows:
        out.setdefault(row.sequence, {})[row.system] = row
    return out


def _best_systems(own: Mapping[str, Row], metric: Metric) -> list[str]:
    """Return the systems with the best figure of a sequence; none where only one has any."""
    medians = {
        s: r.cells[metric.name].median
        for s, r in own.items()
        if metric.name in r.cells and not r.failed
    }
    if len(medians) < 2:
        return []
    best = (max if metric.larger_is_better else min)(medians.values())
    return [system for system, median in medians.items() if median == best]


def _cell_text(
    row: Row | None, metric: Metric, notes: Notes, *, for_documents: bool = False
) -> str:
    """Return a figure of a system and a sequence as it is in the table."""
    if row is None:
        return notes.because("there is no trajectory of this system")
    if row.failed:
        return f"failed {row.failed} of {row.runs}"
    return row_text(row, metric, notes, for_documents=for_documents) + _part(row, metric)


def _part(row: Row, metric: Metric) -> str:
    """Say which share of the frames has a pose, where it is not all of them."""
    cell = row.cells.get("coverage")
    if (
        cell is None
        or metric.name == "coverage"
        or metric.name not in row.cells
        or cell.median > _ALL_FRAMES
    ):
        return ""
    return f" [{100 * cell.median:.0f} % of the frames]"


def published_table(suite: Suite) -> Iterator[str]:
    """Yield published figures with their conditions: systems down, sequences across, then the
    mean and the source.
    """
    for name in dict.fromkeys(name for p in suite.published for name in p.figures):
        entries = [p for p in suite.published if name in p.figures]
        sequences = [
            s.name for s in suite.sequences if any(s.name in p.figures[name] for p in entries)
        ]
        conditions = ["sensors", "causal", "alignment", "loops"]
        yield _line([BY_NAME[name].title, *conditions, *sequences, "mean", "source"])
        yield "|---|---|---|---|---|" + "---:|" * (len(sequences) + 1) + "---|"
        for p in entries:
            figures = _published_cells(p.figures[name], sequences)
            yield _line([p.system, *p.conditions, *figures, p.source])
        yield ""
    yield "– : the source has no figure of this sequence."


def _published_cells(figures: Mapping[str, float], sequences: Sequence[str]) -> list[str]:
    """Return the figures of the sequences, then the mean: as stated, else ours of those figures."""
    texts = [f"{figures[s]:g}" if s in figures else "–" for s in sequences]
    values = [figures[s] for s in sequences if s in figures]
    if PUBLISHED_MEAN in figures:
        mean = f"{figures[PUBLISHED_MEAN]:g} as stated"
    elif values:
        mean = f"{number(statistics.fmean(values), 3)} over {len(values)}"
    else:
        mean = "–"
    return [*texts, mean]


def full_table(
    rows: Sequence[Row],
    metrics: Sequence[Metric] = METRICS,
    titles: Mapping[str, str] | None = None,
    *,
    for_documents: bool = False,
    success: bool = False,
) -> Iterator[str]:
    """Yield the table of all figures: a line for each sequence and system.

    `for_documents` leaves out runs and success (unless asked for), and sequence or system where
    there is one alone.
    """
    named = titles or {}
    notes = Notes()
    names = _names_that_differ(rows) if for_documents else ["sequence", "system"]
    last = ["runs", "success"] if success or not for_documents else []
    yield _line([*names, *(metric.title for metric in metrics), *last])
    yield "|" + "---|" * len(names) + "---:|" * (len(metrics) + len(last))
    labels_of_rows = _labels(rows, names, named, once=for_documents)
    for row, labels in zip(rows, labels_of_rows, strict=True):
        texts = [row_text(row, metric, notes, for_documents=for_documents) for metric in metrics]
        yield _line([*labels, *texts, *(_runs_and_success(row) if last else [])])
    yield from notes.lines()


def _labels(
    rows: Sequence[Row], names: Sequence[str], titles: Mapping[str, str], *, once: bool
) -> Iterator[list[str]]:
    """Yield the labels of each row; `once` leaves the first of several empty where it repeats."""
    before = ""
    for row in rows:
        labels = [titles.get(getattr(row, name), getattr(row, name)) for name in names]
        first = labels[0]
        if once and len(labels) > 1 and first == before:
            labels[0] = ""
        before = first
        yield labels


def _names_that_differ(rows: Sequence[Row]) -> list[str]:
    """Return which of sequence and system takes several values; where neither does, the system."""
    names = ["sequence", "system"]
    return [name for name in names if len({getattr(row, name) for row in rows}) > 1] or names[1:]


def _runs_and_success(row: Row) -> list[str]:
    """Return the cells of how many runs gave a result, and how many of them a good one."""
    if row.failed:
        runs = f"{row.runs - row.failed} of {row.runs}"
    else:
        runs = f"{row.runs}"
    if row.succeeded is None:
        share = "–"
    else:
        share = f"{100 * row.succeeded / row.runs:.0f} %"
    return [runs, share]


def system_table(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the table of systems over the sequences."""
    yield _line(["system", "sequences", *(metric.title for metric in METRICS), "success"])
    yield "|---|---:|" + "---:|" * (len(METRICS) + 1)
    for system, (done, count, cells) in summary_of(rows).items():
        texts = [_median_and_worst(cells.get(metric.name), metric) for metric in METRICS]
        success = _success_of(row for row in rows if row.system == system)
        yield _line([system, f"{done} of {count}", *texts, success])


def _median_and_worst(cell: Cell | None, metric: Metric) -> str:
    """Return a figure over the sequences as text, with their number in brackets."""
    if cell is None:
        return "–"
    if cell.count == 1:
        worst = ""
    else:
        worst = f", worst {number(cell.worst, metric.digits)}"
    return f"{number(cell.median, metric.digits)}{worst} ({cell.count})"


def _success_of(rows: Iterable[Row]) -> str:
    """Return the share of the runs that succeeded, over the rows that can say so."""
    judged = [row for row in rows if row.succeeded is not None]
    runs = sum(row.runs for row in judged)
    succeeded = sum(row.succeeded or 0 for row in judged)
    if not runs:
        return "–"
    return f"{100 * succeeded / runs:.0f} % of {runs}"


def csv_of_rows(rows: Iterable[Row]) -> str:
    """Return one line for each sequence and system: each figure over the seeds."""
    parts = ("median", "worst", "spread", "mean", "sd", "count")
    head = ["sequence", "system", "runs", "failed", "succeeded"]
    head += [f"{m.name}_{part}" for m in METRICS for part in parts]
    lines = []
    for row in rows:
        cells = [row.cells.get(metric.name) for metric in METRICS]
        values = [
            "" if cell is None else repr(getattr(cell, part)) for cell in cells for part in parts
        ]
        if row.succeeded is None:
            succeeded = ""
        else:
            succeeded = str(row.succeeded)
        lines.append([row.sequence, row.system, str(row.runs), str(row.failed), succeeded, *values])
    return _csv([head, *lines])


def csv_of_runs(outcomes: Iterable[Outcome]) -> str:
    """Return one line for each run."""
    head = ["sequence", "system", "seed", *BY_NAME, "failure", "key"]
    lines = []
    for o in outcomes:
        values = [o.value(metric) for metric in BY_NAME.values()]
        texts = ["" if value is None else repr(value) for value in values]
        seed = "" if o.seed is None else str(o.seed)
        lines.append([o.sequence, o.system, seed, *texts, printable(o.failure or ""), o.key])
    return _csv([head, *lines])


def _csv(lines: Iterable[Sequence[str]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(lines)
    return stream.getvalue()


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"
