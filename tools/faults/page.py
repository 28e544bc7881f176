"""The page of the documentation on faults and healthy variants, made of the figures of their
runs.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from vio.bench.tables import provenance

_PAGE = """# Faults and healthy variants

Real recordings, changed in memory by `python -m tools.faults`; ATE in millimetres after SE(3) alignment.
{provenance}.

## Healthy variants

What a good rig may deliver: no check may act on it. The mirrored pair has exchanged cameras, so the path of the other
camera is estimated, and compared with its own truth. Numbers in brackets: lines that are said of the variant, but not
of the recording as it is.

{healthy}

## Faults

From 40 % of the recording on, for three seconds or to its last fifth, unless the name says otherwise. *Ratio*: largest
error over the largest stated standard deviation of a position; images alone, and short recordings with little motion,
state too little already without a fault. What was said is cut to its beginning.

{faults}
"""
Row = Mapping[str, Any]


def page(facts: Mapping[str, Any]) -> str:
    """Return the page, Markdown: healthy variants, and faults."""
    healthy = [row for row in facts["runs"] if row["group"] == "healthy"]
    faults = [row for row in facts["runs"] if row["group"] != "healthy"]
    tables = {
        "healthy": "\n".join(_healthy_table(healthy)),
        "faults": "\n".join(_fault_table(faults)),
    }
    return _PAGE.format(provenance=provenance(facts), **tables)


def _healthy_table(rows: Sequence[Row]) -> list[str]:
    """ATE of each variant on each recording, with the lines that are said of it but not of the
    recording as it is.
    """
    heads = list(dict.fromkeys((row["recording"], row["motion"]) for row in rows))
    cells = {(row["recording"], row["motion"], row["variant"]): row for row in rows}
    lines = ["| variant | " + " | ".join(f"{name}, {motion}" for name, motion in heads) + " |"]
    lines.append("|---|" + "---|" * len(heads))
    notes: list[str] = []
    for variant in dict.fromkeys(row["variant"] for row in rows):
        shown = []
        for head in heads:
            row = cells.get((*head, variant), {})
            clean = cells.get((*head, "clean"), {})
            extra = (
                [row["error"]]
                if "error" in row
                else _unlike(row.get("said", []), clean.get("said", []))
            )
            marks = "".join(f" [{len(notes) + k}]" for k in range(1, len(extra) + 1))
            notes += [f"{head[0]}, {head[1]}, {variant}: {line}" for line in extra]
            shown.append(_millimetres(row) + marks if row else "")
        lines.append(f"| {variant} | " + " | ".join(shown) + " |")
    return [*lines, *([""] if notes else []), *(f"{k}. {note}" for k, note in enumerate(notes, 1))]


def _fault_table(rows: Sequence[Row]) -> list[str]:
    lines = ["| recording | fault | ATE mm | ratio | said |", "|---|---|---|---|---|"]
    for row in rows:
        lines_said = [
            re.sub(r"^(frame \d+|gyro \w+|accelerometer \w+): ", "", line)
            for line in row.get("said", [])
        ]
        said = row.get("error") or "; ".join(
            dict.fromkeys(re.split(r"[:;,] ", line)[0] for line in lines_said)
        )
        ratio = f"{row['ratio']:.1f}" if "ratio" in row else ""
        name = f"{row['recording']}, {row['motion']} | {row['group']}: {row['variant']}"
        lines.append(f"| {name} | {_millimetres(row)} | {ratio} | {said} |")
    return lines


def _unlike(said: Sequence[str], usual: Sequence[str]) -> list[str]:
    """The lines that differ from the usual ones by more than numbers."""
    known = {re.sub(r"[\d.]+", "", line) for line in usual}
    return [line for line in said if re.sub(r"[\d.]+", "", line) not in known]


def _millimetres(row: Row) -> str:
    if "ate_m" not in row:
        return "–"
    error_mm = 1e3 * row["ate_m"]
    return f"{error_mm:.0f}" if error_mm >= 100 else f"{error_mm:.3g}"
