"""Take figures of benches into docs/bench_results.json, and write the tables made of them into the documents.

Tables stand between `<!-- bench: NAME -->` and `<!-- end bench -->` in docs/results.md and README.md; the suites are
run by `tools/results.py`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vio.bench.bench import read_bench
from vio.bench.tables import METRICS, Outcome, Row, cell_text, number, summary_rows

ROOT = Path(__file__).resolve().parent.parent
FIGURES = "docs/bench_results.json"
DOCUMENTS = ("docs/results.md", "README.md")
_KEPT = ("ate_m", "rpe_m", "drift_percent", "drift_deg_per_100m", "coverage", "nees", "length_ratio")
_MEASURED = ("cpu_ms", "memory_mib")
_DIGITS = 6  # significant, of figures in the file
_BY_NAME = {metric.name: metric for metric in METRICS}


@dataclass(frozen=True, slots=True)
class Line:
    """One row of a table beside other systems."""

    label: str
    suite: str
    sequence: str
    ours: str  # configuration
    peers: Mapping[str, str]  # by column: the system's name in the suite


_IMAGES = {"Basalt": "basalt", "libviso2": "viso2"}
_IMU = {"Basalt": "basalt_imu", "Basalt, images alone": "basalt_images", "OpenVINS": "openvins_imu"}
REAL = (
    Line("KITTI raw 0039, 110 frames, images alone", "real", "kitti_0039", "images", _IMAGES),
    Line("KITTI odometry 06, first 30 frames, images alone", "real", "kitti_06_head", "images", _IMAGES),
    Line("KITTI odometry 03, first 50 frames, images alone", "real", "kitti_03_head", "images", _IMAGES),
    Line("Karlsruhe 0019, first 50 frames, images alone", "real", "karlsruhe_0019_head", "images", _IMAGES),
    Line("EuRoC MH_01, 90 frames, images alone", "real", "MH_01_head", "images", {"Basalt": "basalt_images"}),
    Line("EuRoC MH_01, 90 frames, with IMU", "real_imu", "MH_01_head", "imu", {"Basalt": "basalt_imu"}),
)
RENDERED = (
    Line("flight along V1_02, its real IMU", "flights", "v102_real", "imu", _IMU),
    Line("flight along V1_02, simulated IMU", "flights", "v102_sim", "imu", _IMU),
    Line("flight along MH_03, its real IMU", "flights", "mh03_real", "imu", _IMU),
)


class Benches:
    """Figures of all benches of the file."""

    def __init__(self, data: Mapping[str, Any]) -> None:
        self._rows = {name: summary_rows(_outcome(values) for values in facts["runs"]) for name, facts in data.items()}

    def rows(self, suite: str) -> list[Row]:
        """Return all rows of a suite."""
        return self._rows.get(suite, [])

    def row(self, suite: str, sequence: str, system: str) -> Row | None:
        """Return one row; None: there is none."""
        return next((r for r in self.rows(suite) if (r.sequence, r.system) == (sequence, system)), None)


def _outcome(values: Sequence[Any]) -> Outcome:
    sequence, system, seed, figures, measured, failure = values
    return Outcome(sequence, system, seed, "", figures, measured, failure, None)


def read_figures(root: Path = ROOT) -> dict[str, Any]:
    """Read docs/bench_results.json; empty where there is none."""
    path = root / FIGURES
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


def taken(folder: Path) -> tuple[str, dict[str, Any]]:
    """Return a bench's name and the figures that are kept of it."""
    outcomes, facts = read_bench(folder)
    runs = [
        [o.sequence, o.system, o.seed, _rounded(o.figures, _KEPT), _rounded(o.measured, _MEASURED), o.failure]
        for o in outcomes
    ]
    return facts["suite"], {"code": facts["code"][:12], "packages": facts["packages"], "runs": runs}


def _rounded(values: Mapping[str, Any], names: Sequence[str]) -> dict[str, float | None]:
    return {
        name: None if values[name] is None else float(f"{values[name]:.{_DIGITS}g}") for name in names if name in values
    }


# --- tables ---------------------------------------------------------------------------------------------------------


def _text(row: Row | None) -> str:
    """ATE in metres over the seeds, with the share of frames where it is not all of them."""
    if row is None or "ate_m" not in row.cells:
        return "–"
    cell = row.cells["ate_m"]
    text = cell_text(replace(cell, spread=0.0), _BY_NAME["ate_m"])
    covered = row.cells["coverage"].median
    return text if covered > 0.995 else f"{text} ({100 * covered:.0f} % of the frames)"


def _cell(row: Row, name: str) -> str:
    return cell_text(row.cells[name], _BY_NAME[name]) if name in row.cells else "–"


def _beside(benches: Benches, lines: Sequence[Line], columns: Sequence[str]) -> Iterator[str]:
    yield f"| ATE m | stereo-vio | {' | '.join(columns)} |"
    yield "|---|" + "---:|" * (len(columns) + 1)
    for line in lines:
        rows = [benches.row(line.suite, line.sequence, line.ours)]
        rows += [benches.row(line.suite, line.sequence, line.peers.get(column, "")) for column in columns]
        known = [row.cells["ate_m"].median for row in rows if row is not None and "ate_m" in row.cells]
        cells = [f"**{_text(row)}**" if row and row.cells["ate_m"].median == min(known) else _text(row) for row in rows]
        yield f"| {line.label} | {' | '.join(cells)} |"


def _real(benches: Benches) -> Iterator[str]:
    return _beside(benches, REAL, ("Basalt", "libviso2"))


def _rendered(benches: Benches) -> Iterator[str]:
    return _beside(benches, RENDERED, ("Basalt", "Basalt, images alone", "OpenVINS"))


def _readme(benches: Benches) -> Iterator[str]:
    chosen = (REAL[0], REAL[2], REAL[3], REAL[5], RENDERED[0], RENDERED[2])
    named = [line if line in REAL else replace(line, label=f"rendered {line.label}") for line in chosen]
    return _beside(benches, named, ("Basalt", "libviso2", "OpenVINS"))


def _details(benches: Benches) -> Iterator[str]:
    """Drift, seeds, CPU and memory of our own runs."""
    metrics = [_BY_NAME[n] for n in ("ate_m", "rpe_m", "drift_percent", "drift_deg_per_100m", "cpu_ms", "memory_mib")]
    yield f"| stereo-vio | {' | '.join(metric.title for metric in metrics)} |"
    yield "|---|" + "---:|" * len(metrics)
    for line in (*REAL, *RENDERED):
        row = benches.row(line.suite, line.sequence, line.ours)
        if row is not None:
            yield f"| {line.label} | {' | '.join(_cell(row, m.name) for m in metrics)} |"


def _suite(benches: Benches) -> Iterator[str]:
    """The rendered suite: both configurations beside each other."""
    titles = ("ATE m", "drift %", "coverage", "NEES of 6")
    names = ("ate_m", "drift_percent", "coverage", "nees")
    yield f"| sequence | configuration | {' | '.join(titles)} | failed |"
    yield "|---|---|" + "---:|" * (len(names) + 1)
    for row in benches.rows("rendered"):
        cells = [_cell(row, name) for name in names]
        yield f"| {row.sequence} | {row.system} | {' | '.join(cells)} | {number(row.failed, 3)} of {row.runs} |"


TABLES: Mapping[str, Callable[[Benches], Iterator[str]]] = {
    "real": _real,
    "rendered": _rendered,
    "details": _details,
    "suite": _suite,
    "readme": _readme,
}


def with_tables(text: str, benches: Benches) -> str:
    """Return a document with all its marked tables written anew."""

    def table(found: re.Match[str]) -> str:
        lines = "\n".join(TABLES[found[1]](benches))
        return f"<!-- bench: {found[1]} -->\n{lines}\n<!-- end bench -->"

    return re.sub(r"<!-- bench: (\w+) -->\n.*?<!-- end bench -->", table, text, flags=re.DOTALL)


def write(folders: Sequence[Path]) -> None:
    """Take the figures of output folders of vio bench, and write the file and the tables."""
    figures = {**read_figures(), **dict(taken(folder) for folder in folders)}
    lines = ",\n".join(
        f'{json.dumps(name)}: {{"code": "{facts["code"]}", "packages": {json.dumps(facts["packages"])}, "runs": [\n'
        + ",\n".join(json.dumps(run) for run in facts["runs"])
        + "\n]}"
        for name, facts in sorted(figures.items())
    )
    (ROOT / FIGURES).write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
    for name in DOCUMENTS:
        path = ROOT / name
        path.write_text(with_tables(path.read_text(encoding="utf-8"), Benches(figures)), encoding="utf-8", newline="\n")
