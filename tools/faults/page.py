"""The page of the documentation on faults and healthy variants, made of the figures of their
runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vio.bench.tables import provenance

_PAGE = """# Faults and healthy variants

Real recordings, changed in memory by `python -m tools.faults`; ATE in millimetres after SE(3) alignment, and the
[codes](findings.md) of what a run found that are not those of the recording as it is.
{provenance}.

## Healthy variants

What a good rig may deliver: no check may act on it. The mirrored pair has exchanged cameras, so the path of the other
camera is estimated, and compared with its own truth.

{healthy}

## Faults

From 40 % of the recording on, for three seconds or to its last fifth, unless the name says otherwise. *Ratio*: largest
error over the largest stated standard deviation of a position; images alone, and short recordings with little motion,
state too little already without a fault.

{faults}
"""
Row = Mapping[str, Any]


def page(facts: Mapping[str, Any]) -> str:
    """Return the page, Markdown: healthy variants, and faults."""
    rows = facts["runs"]
    usual = {_run(row): row["codes"] for row in rows if row["variant"] == "clean"}
    tables = {
        "healthy": _healthy_tables([row for row in rows if row["group"] == "healthy"], usual),
        "faults": _fault_tables([row for row in rows if row["group"] != "healthy"], usual),
    }
    return _PAGE.format(provenance=provenance(facts), **tables)


def _healthy_tables(rows: Sequence[Row], usual: Mapping[str, Sequence[str]]) -> str:
    """ATE of each variant on each recording, with the codes that only the variant has."""
    runs = list(dict.fromkeys(map(_run, rows)))
    cells = {(_run(row), row["variant"]): row for row in rows}
    lines = ["| variant | " + " | ".join(runs) + " |", "|---|" + "---|" * len(runs)]
    for variant in dict.fromkeys(row["variant"] for row in rows):
        shown = [
            " ".join(
                filter(
                    None, (_millimetres(cells[run, variant]), _found(cells[run, variant], usual))
                )
            )
            if (run, variant) in cells
            else ""
            for run in runs
        ]
        lines.append(f"| {variant} | " + " | ".join(shown) + " |")
    return "\n".join(lines)


def _fault_tables(rows: Sequence[Row], usual: Mapping[str, Sequence[str]]) -> str:
    """A table for each recording: error, ratio and codes of each fault."""
    tables = []
    for run in dict.fromkeys(map(_run, rows)):
        lines = [f"### {run}", "", "| fault | ATE mm | ratio | found |", "|---|---:|---:|---|"]
        for row in rows:
            if _run(row) == run:
                ratio = f"{row['ratio']:.1f}" if "ratio" in row else ""
                cells = f"{row['variant']} | {_millimetres(row)} | {ratio}"
                lines.append(f"| {cells} | {_found(row, usual)} |")
        tables.append("\n".join(lines))
    return "\n\n".join(tables)


def _run(row: Row) -> str:
    """The recording and the motion sensor of a row."""
    motion = {"none": "images alone", "imu": "with IMU"}
    return f"{row['recording']}, {motion.get(row['motion'], row['motion'])}"


def _found(row: Row, usual: Mapping[str, Sequence[str]]) -> str:
    """The codes of a run that the recording as it is has not, or its error."""
    if "error" in row:
        return ": ".join(str(row["error"]).split(": ")[:2])
    known = usual.get(_run(row), ())
    return ", ".join(f"`{code}`" for code in row["codes"] if code not in known)


def _millimetres(row: Row) -> str:
    if "ate_m" not in row:
        return "–"
    error_mm = 1e3 * row["ate_m"]
    return f"{error_mm:.0f}" if error_mm >= 100 else f"{error_mm:.3g}"
