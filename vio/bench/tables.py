"""Tables of a bench: each sequence and system over its seeds, each system over the sequences; Markdown and CSV."""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vio.bench.suite import Suite
from vio.files.printable import printable


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

    def value(self, metric: Metric) -> float | None:
        """Return a figure; None: undefined, or the run failed."""
        if self.failure is not None:
            return None
        value = (self.measured if metric.measured else self.figures).get(metric.name)
        return None if value is None else float(value)

    def as_dict(self) -> dict[str, Any]:
        """Return everything but the curve, for JSON."""
        names = ("sequence", "system", "seed", "key", "figures", "measured", "failure")
        return {**{name: getattr(self, name) for name in names}, "warnings": list(self.warnings)}


@dataclass(frozen=True, slots=True)
class Cell:
    """One figure over seeds, or over sequences."""

    median: float
    worst: float
    spread: float  # largest minus smallest
    count: int


@dataclass(frozen=True, slots=True)
class Row:
    """One sequence with one system over its seeds."""

    sequence: str
    system: str
    is_peer: bool
    runs: int
    failed: int
    cells: Mapping[str, Cell]  # by name of the metric; absent where undefined


def summary_rows(outcomes: Iterable[Outcome]) -> list[Row]:
    """Return one row for each sequence and system, in the order of the sequences."""
    groups: dict[str, dict[str, list[Outcome]]] = {}
    for outcome in outcomes:
        groups.setdefault(outcome.sequence, {}).setdefault(outcome.system, []).append(outcome)
    return [_row(group) for systems in groups.values() for group in systems.values()]


def _row(group: Sequence[Outcome]) -> Row:
    cells = {metric.name: cell for metric in METRICS if (cell := cell_of((o.value(metric) for o in group), metric))}
    first = group[0]
    failed = sum(o.failure is not None for o in group)
    return Row(first.sequence, first.system, first.seed is None, len(group), failed, cells)


def cell_of(values: Iterable[float | None], metric: Metric) -> Cell | None:
    """Summarise the values that are defined; None: there is none."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    worst = min(known) if metric.larger_is_better else max(known)
    return Cell(statistics.median(known), worst, max(known) - min(known), len(known))


def summary_of(rows: Iterable[Row]) -> dict[str, tuple[int, int, dict[str, Cell]]]:
    """Return by system: sequences with a result, all its sequences, and the medians of these over the sequences."""
    by_system: dict[str, list[Row]] = {}
    for row in rows:
        by_system.setdefault(row.system, []).append(row)
    out = {}
    for system, own in by_system.items():
        medians = {
            metric.name: cell
            for metric in METRICS
            if (cell := cell_of((r.cells[metric.name].median for r in own if metric.name in r.cells), metric))
        }
        out[system] = (sum(row.failed == 0 for row in own), len(own), medians)
    return out


# --- text -----------------------------------------------------------------------------------------------------------


def number(value: float, digits: int) -> str:
    """Return a number with so many significant digits, never in exponents."""
    if value == 0:
        return "0"
    text = f"{value:.{digits}g}"
    return f"{value:.{digits + 5}f}".rstrip("0").rstrip(".") if "e-" in text else f"{float(text):.12g}"


def cell_text(cell: Cell | None, metric: Metric) -> str:
    """Return `median` or, over several seeds, `median (smallest to largest)`."""
    if cell is None:
        return "–"
    middle = number(cell.median, metric.digits)
    if cell.count == 1 or cell.spread == 0:
        return middle
    other = cell.worst - cell.spread if not metric.larger_is_better else cell.worst + cell.spread
    low, high = sorted((cell.worst, other))
    return f"{middle} ({number(low, metric.digits)} to {number(high, metric.digits)})"


def markdown(suite: Suite, rows: Sequence[Row], outcomes: Sequence[Outcome], facts: Mapping[str, Any]) -> str:
    """Return all tables of a bench."""
    seeds = f", seeds {', '.join(map(str, suite.seeds))}" if len(suite.seeds) > 1 else ""
    parts = [
        f"# {suite.name}\n\nstereo-vio {facts['version']}, code {facts['code'][:12]}, {_versions(facts)}{seeds}.\n",
        "## ATE in m\n\nMedian over the seeds. Published figures are their sources', under their conditions.\n\n"
        + "\n".join(ate_matrix(suite, rows)),
        "## All figures\n\nMedian over the seeds (smallest to largest).\n\n" + "\n".join(full_table(rows)),
        "## Systems\n\nMedian and worst over the sequences of the medians over seeds.\n\n"
        + "\n".join(system_table(rows)),
    ]
    if reasons := list(failure_lines(outcomes)):
        parts.append("## Without a result\n\n" + "\n".join(reasons))
    if suite.published:
        lines = [f"- {p.system}: {p.source}" for p in suite.published]
        parts.append("## Sources of published figures\n\n" + "\n".join(lines))
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def _versions(facts: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {version}" for name, version in facts["packages"].items())


def ate_matrix(suite: Suite, rows: Sequence[Row]) -> Iterator[str]:
    """Yield the table of ATE: sequences down, systems across; the smallest measured one bold."""
    metric = METRICS[0]
    systems = list(dict.fromkeys(row.system for row in sorted(rows, key=lambda row: row.is_peer)))
    published = [p for p in suite.published if "ate_m" in p.figures]
    yield _line(["sequence", *systems, *(f"{p.system} (published)" for p in published)])
    yield "|---|" + "---:|" * (len(systems) + len(published))
    by_sequence: dict[str, dict[str, Row]] = {}
    for row in rows:
        by_sequence.setdefault(row.sequence, {})[row.system] = row
    for sequence, cells in by_sequence.items():
        medians = {s: row.cells["ate_m"].median for s, row in cells.items() if "ate_m" in row.cells and not row.failed}
        texts = []
        for system in systems:
            own = cells.get(system)
            text = "" if own is None else "failed" if own.failed else cell_text(own.cells.get("ate_m"), metric)
            best = len(medians) > 1 and medians.get(system) == min(medians.values())
            texts.append(f"**{text}**" if best else text)
        texts += [_published_text(p.figures["ate_m"].get(sequence)) for p in published]
        yield _line([sequence, *texts])


def _published_text(value: float | None) -> str:
    return "" if value is None else f"{value:g}"


def full_table(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the table of all figures."""
    yield _line(["sequence", "system", *(metric.title for metric in METRICS), "runs"])
    yield "|---|---|" + "---:|" * (len(METRICS) + 1)
    for row in rows:
        runs = f"{row.runs}" if not row.failed else f"{row.runs - row.failed} of {row.runs}"
        texts = [cell_text(row.cells.get(metric.name), metric) for metric in METRICS]
        yield _line([row.sequence, row.system, *texts, "" if row.is_peer else runs])


def system_table(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the table of systems over the sequences."""
    yield _line(["system", "sequences", *(metric.title for metric in METRICS)])
    yield "|---|---:|" + "---:|" * len(METRICS)
    for system, (done, count, cells) in summary_of(rows).items():
        texts = []
        for metric in METRICS:
            cell = cells.get(metric.name)
            worst = "" if cell is None or cell.count == 1 else f", worst {number(cell.worst, metric.digits)}"
            texts.append("–" if cell is None else f"{number(cell.median, metric.digits)}{worst}")
        yield _line([system, f"{done} of {count}", *texts])


def failure_lines(outcomes: Iterable[Outcome]) -> Iterator[str]:
    """Yield one line for each run without a result: why."""
    for o in outcomes:
        if o.failure is not None:
            seed = "" if o.seed is None else f", seed {o.seed}"
            yield f"- {o.sequence}, {o.system}{seed}: {printable(o.failure)}"


def csv_of_rows(rows: Iterable[Row]) -> str:
    """Return one line for each sequence and system: median, worst and spread of each figure over the seeds."""
    parts = ("median", "worst", "spread")
    head = ["sequence", "system", "runs", "failed", *(f"{m.name}_{part}" for m in METRICS for part in parts)]
    lines = []
    for row in rows:
        cells = [row.cells.get(metric.name) for metric in METRICS]
        values = ["" if cell is None else repr(getattr(cell, part)) for cell in cells for part in parts]
        lines.append([row.sequence, row.system, str(row.runs), str(row.failed), *values])
    return _csv([head, *lines])


def csv_of_runs(outcomes: Iterable[Outcome]) -> str:
    """Return one line for each run."""
    head = ["sequence", "system", "seed", *(metric.name for metric in METRICS), "failure", "key"]
    lines = []
    for o in outcomes:
        values = [o.value(metric) for metric in METRICS]
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
