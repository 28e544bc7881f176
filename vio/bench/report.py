"""The report of a bench: one HTML file with tables and SVG figures, which loads nothing from
elsewhere.
"""

from __future__ import annotations

import html
import io
import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vio.bench.suite import Suite
from vio.bench.tables import METRICS, Outcome, Row, markdown
from vio.files.atomic import atomic_write_text
from vio.numerics.kinds import Capacity

log = logging.getLogger(__name__)
_COLOURS = ("#1f5fbf", "#d9822b", "#5aa469", "#c23b5a", "#8e63b8", "#6b7785", "#b59f3b", "#2a9d8f")
_MAX_SEQUENCES = 24  # with figures of their own: the worst ones of a larger suite
_MAX_POINTS: Capacity[int] = 500  # of a box: evenly spaced among the sorted ones of a larger suite
_STYLE = (
    "body{font:15px/1.45 system-ui,sans-serif;max-width:1180px;margin:2em auto;padding:0 "
    "1em;color:#1b2733}"
    "table{border-collapse:collapse;font-size:13px;margin:1em 0;display:block;overflow-x:auto}"
    "td,th{border:1px solid #d4dbe2;padding:3px "
    "8px;text-align:right}td:first-child,th:first-child{text-align:left}"
    "th{background:#f1f4f7}tr:nth-child(even) td{background:#fafbfc}svg{max-width:100%;height:auto}"
    "h2{margin-top:2em}li{font-size:14px}"
)


def write_bench_report(
    path: Path,
    suite: Suite,
    rows: Sequence[Row],
    outcomes: Sequence[Outcome],
    facts: Mapping[str, Any],
) -> None:
    """Write the report.

    Raises:
        DataError: the file cannot be written.
    """
    shown = _worst_sequences(rows)
    figures = [
        (
            "Errors of each sequence",
            "Position errors: median, quartiles, 5 and 95 % over the frames. Of several seeds, the "
            "run of median ATE.",
            _boxes,
        ),
        ("Error over time", "Of several seeds, the run of the median ATE.", _curves),
    ]
    parts = [_as_html(markdown(suite, rows, outcomes, facts))]
    if any(o.curve for o in outcomes):
        note = (
            f" The {len(shown)} sequences with the largest errors."
            if len(shown) < len(suite.sequences)
            else ""
        )
        for title, text, draw in figures:
            parts.append(f"<h2>{title}</h2><p>{text}{note}</p>{_svg(draw(shown, outcomes))}")
        parts.append(
            "<h2>Systems</h2><p>ATE of all sequences with median and "
            f"quartiles.</p>{_svg(_system_boxes(rows))}"
        )
    title = html.escape(f"stereo-vio bench {suite.name}")
    head = f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
    atomic_write_text(path, f"{head}</head><body>{''.join(parts)}</body></html>\n")


def _worst_sequences(rows: Sequence[Row]) -> list[str]:
    """Return the sequences to draw, in the order of the table."""
    worst: dict[str, float] = {}
    for row in rows:
        cell = row.cells.get(METRICS[0].name)
        if cell is not None:
            worst[row.sequence] = max(worst.get(row.sequence, 0.0), cell.worst)
    chosen = set(sorted(worst, key=lambda name: -worst[name])[:_MAX_SEQUENCES])
    return [name for name in worst if name in chosen]


def _boxes(sequences: Sequence[str], outcomes: Sequence[Outcome]) -> Any:
    """Draw box plots of the errors: sequences across, systems side by side, on a logarithmic
    axis.
    """
    from matplotlib.figure import Figure

    systems = list(dict.fromkeys(o.system for o in outcomes if o.curve))
    width = max(6.0, 0.9 + 0.32 * len(sequences) * (len(systems) + 1))
    figure = Figure(figsize=(width, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for k, system in enumerate(systems):
        stats = []
        places = []
        for j, sequence in enumerate(sequences):
            known = _with_curve(outcomes, sequence, system)
            if known:
                stats.append(_box(_median_run(known)))
                places.append(j * (len(systems) + 1) + k)
        colour = _COLOURS[k % len(_COLOURS)]
        drawn = axes.bxp(
            stats, positions=places, widths=0.8, showfliers=False, patch_artist=True, manage_ticks=False,
            medianprops={"color": "white"}, boxprops={"facecolor": colour, "edgecolor": colour},
            whiskerprops={"color": colour}, capprops={"color": colour},
        )  # fmt: skip
        if drawn["boxes"]:
            drawn["boxes"][0].set_label(system)
    axes.set_xticks(
        [j * (len(systems) + 1) + (len(systems) - 1) / 2 for j in range(len(sequences))], sequences
    )
    labelrotation = 0
    if len(sequences) > 5:
        labelrotation = 35
    axes.tick_params(axis="x", labelrotation=labelrotation)
    axes.set_yscale("log")
    axes.set_ylabel("position error (m)")
    axes.grid(alpha=0.25, axis="y")
    axes.legend(fontsize=9, ncols=_legend_columns(systems, width - 1.0), loc="upper left")
    return figure


def _legend_columns(names: Sequence[str], width: float) -> int:
    """How many names fit beside one another in so many inches."""
    longest = max((len(name) for name in names), default=1)
    return int(np.clip(width / (0.6 + 0.08 * longest), 1, max(len(names), 1)))


def _curves(sequences: Sequence[str], outcomes: Sequence[Outcome]) -> Any:
    """Draw the error of each sequence over time, one plot each."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    columns = min(3, len(sequences))
    lines = -(-len(sequences) // columns)
    systems = list(dict.fromkeys(o.system for o in outcomes if o.curve))
    colours = {system: _COLOURS[k % len(_COLOURS)] for k, system in enumerate(systems)}
    wide = _legend_columns(systems, 4.0 * columns)
    height = 2.3 * lines + 0.2 * -(-len(systems) // wide)
    figure = Figure(figsize=(4.0 * columns, height), layout="constrained")
    for j, sequence in enumerate(sequences):
        axes = figure.add_subplot(lines, columns, j + 1)
        for system, colour in colours.items():
            known = _with_curve(outcomes, sequence, system)
            if known:
                curve = _median_run(known).curve
                assert curve is not None
                axes.plot(curve["seconds"], curve["error_m"], color=colour, lw=1.1, label=system)
        axes.set_title(sequence, fontsize=9, loc="left", parse_math=False)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.25)
        axes.tick_params(labelsize=8)
        if j % columns == 0:
            axes.set_ylabel("error (m)", fontsize=8)
    handles = [Line2D([], [], color=colour, label=system) for system, colour in colours.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=wide, fontsize=8)
    figure.supxlabel("time (s)", fontsize=9)
    return figure


def _with_curve(outcomes: Sequence[Outcome], sequence: str, system: str) -> list[Outcome]:
    """Return the runs of a sequence with a system of which the error over time is known."""
    return [o for o in outcomes if (o.sequence, o.system) == (sequence, system) and o.curve]


def _system_boxes(rows: Sequence[Row]) -> Any:
    """Draw the ATE of all sequences as one box for each system."""
    from matplotlib.figure import Figure

    name = METRICS[0].name
    values: dict[str, list[float]] = {}
    for row in rows:
        if name in row.cells:
            values.setdefault(row.system, []).append(row.cells[name].median)
    figure = Figure(figsize=(7.0, 0.9 + 0.4 * max(len(values), 1)), layout="constrained")
    axes = figure.add_subplot()
    for k, known in enumerate(values.values()):
        q1, median, q3 = (float(v) for v in np.percentile(known, (25, 50, 75)))
        axes.plot([q1, q3], [k, k], color="#c9d1d9", lw=10, solid_capstyle="butt", zorder=1)
        axes.plot([median, median], [k - 0.2, k + 0.2], color="#111111", lw=1.5)
        picked = np.unique(np.linspace(0, len(known) - 1, _MAX_POINTS).astype(int))
        shown = np.sort(known)[picked]
        axes.plot(shown, [k] * len(shown), ".", color=_COLOURS[k % len(_COLOURS)], ms=6, alpha=0.7)
    axes.set_xscale("log")
    axes.set_yticks(range(len(values)), list(values), parse_math=False)
    axes.set_ylim(len(values) - 0.5, -0.5)
    axes.set_xlabel("ATE (m)")
    axes.grid(alpha=0.25, axis="x")
    return figure


def _median_run(known: Sequence[Outcome]) -> Outcome:
    """Return the run whose ATE is the median among the seeds (the lower of two)."""
    ordered = sorted(known, key=lambda o: o.value(METRICS[0]) or 0.0)
    return ordered[(len(ordered) - 1) // 2]


def _box(outcome: Outcome) -> dict[str, Any]:
    assert outcome.curve is not None
    _, low, q1, median, q3, high, _ = (max(value, 1e-9) for value in outcome.curve["quantiles_m"])
    return {"whislo": low, "q1": q1, "med": median, "q3": q3, "whishi": high, "fliers": []}


def _svg(figure: Any) -> str:
    """Return a figure as SVG text without a date or random names, so that equal results make
    equal reports.
    """
    import matplotlib

    stream = io.StringIO()
    with matplotlib.rc_context(
        {"svg.hashsalt": "vio", "svg.fonttype": "none", "font.family": "sans-serif"}
    ):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]


def _as_html(text: str) -> str:
    """Return our own Markdown, headings, paragraphs, lists and tables, as HTML."""
    out: list[str] = []
    for block in re.split(r"\n{2,}", text.strip()):
        lines = block.splitlines()
        if found := re.match(r"(#+) (.*)", lines[0]):
            level = len(found[1])
            out.append(f"<h{level}>{_inline(found[2])}</h{level}>")
        elif lines[0].startswith("| "):
            out.append(_table(lines))
        elif lines[0].startswith("- "):
            out.append(
                "<ul>" + "".join(f"<li>{_inline(line[2:])}</li>" for line in lines) + "</ul>"
            )
        else:
            out.append(f"<p>{_inline(' '.join(lines))}</p>")
    return "".join(out)


def _table(lines: Sequence[str]) -> str:
    rows = [cells_of(line) for line in lines]
    head = "".join(f"<th>{_inline(cell)}</th>" for cell in rows[0])
    body = "".join(
        "<tr>" + "".join(f"<td>{_inline(cell)}</td>" for cell in row) + "</tr>" for row in rows[2:]
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _inline(text: str) -> str:
    escaped = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", html.escape(text))
    return re.sub(r"(https://[^\s<)]+[^\s<).,;])", r'<a href="\1">\1</a>', escaped)


_SPECIAL = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "–": "--", "°": r"$^\circ$", "×": r"$\times$",
}  # fmt: skip


def latex_of(markdown: str) -> str:
    """Return each table of a text of `vio.bench.tables` as LaTeX, with its heading and its
    paragraphs as comments.

    The preamble of the paper needs the packages booktabs and inputenc with utf8.
    """
    lines = ["% \\usepackage{booktabs}"]
    for line in markdown.splitlines():
        if re.fullmatch(r"\|[-:|]+\|", line):
            head = lines.pop()
            columns = ["r" if rule.endswith(":") else "l" for rule in line.strip("|").split("|")]
            lines += [rf"\begin{{tabular}}{{{''.join(columns)}}}", r"\toprule", head, r"\midrule"]
        elif line.startswith("| "):
            lines.append(" & ".join(_escaped(cell) for cell in cells_of(line)) + r" \\")
        else:
            if lines[-1].endswith(r"\\"):
                lines += [r"\bottomrule", r"\end{tabular}"]
            lines.append(f"% {line}".rstrip() if line else "")
    if lines[-1].endswith(r"\\"):
        lines += [r"\bottomrule", r"\end{tabular}"]
    return "\n".join(lines) + "\n"


def cells_of(line: str) -> list[str]:
    """Return the cells of a line of a Markdown table."""
    return [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def _escaped(cell: str) -> str:
    bold = re.fullmatch(r"\*\*(.+)\*\*", cell)
    text = "".join(_SPECIAL.get(letter, letter) for letter in (bold[1] if bold else cell))
    return rf"\textbf{{{text}}}" if bold else text
