"""One self-contained HTML page: text, tables and figures, with plotly's script embedded once."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Collection, Mapping, Sequence
from html import escape
from pathlib import Path

from vio._version import __version__
from vio.files.atomic import atomic_write_text
from vio.files.inputs import read_input
from vio.files.printable import printable
from vio.report.compared import apart, compared_figures
from vio.report.figures import ReportSection, sections
from vio.report.words import calibration_findings, summary
from vio.runs.curves import COLOURS, curves_of
from vio.runs.files import MeshFile, RunFile
from vio.runs.finished import FinishedRun

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1d2733; background: #f4f6f8; margin: 0; }
main { max-width: 1180px; margin: 0 auto; padding: 24px; }
h1 { font-size: 24px; margin: 0 0 4px; } h2 { font-size: 18px; margin: 0 0 4px; }
section { background: #fff; border: 1px solid #dfe4ea; border-radius: 6px; padding: 16px 20px; margin: 16px 0; }
p { margin: 4px 0; } .remark { color: #5b6876; font-size: 13px; }
table { border-collapse: collapse; } th, td { text-align: left; padding: 3px 18px 3px 0; font-weight: normal; }
thead th { border-bottom: 1px solid #c4ccd5; font-weight: 600; } tbody th { color: #5b6876; }
td { font-variant-numeric: tabular-nums; } li { margin: 3px 0; overflow-wrap: anywhere; }
.swatch { display: inline-block; width: 11px; height: 11px; border-radius: 2px; margin-right: 6px; }
.scroll { overflow-x: auto; } img { max-width: 100%; } code { overflow-wrap: anywhere; }
"""


def write_report(path: Path, runs: Sequence[FinishedRun]) -> None:
    """Write the page about one or several runs.

    Args:
        path: the file, replaced at once when it is complete.
        runs: in the order of their colours; the first 8 get one each.

    Raises:
        VioError: the file cannot be written.
    """
    atomic_write_text(path, page(runs))


def page(runs: Sequence[FinishedRun]) -> str:
    """Return the page about one or several runs as HTML."""
    from plotly.offline import get_plotlyjs

    title = _text(", ".join(run.name for run in runs))
    path, *figures = (
        _figure(section, number) for number, section in enumerate(sections(runs, curves_of(runs)))
    )
    warnings = _lists(
        "Warnings and notes",
        runs,
        [[str(line) for line in run.metrics.get("warnings") or []] for run in runs],
    )
    calibration = _lists("Calibration", runs, [calibration_findings(run.metrics) for run in runs])
    parts = [_words(runs), warnings, path, _key_figures(runs), calibration, _images(runs), *figures]
    parts.append(_settings(runs))
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        '<meta name="viewport" content="width=device-width, '
        f'initial-scale=1"><style>{_STYLE}</style>'
        f"<script>{get_plotlyjs()}</script></head>\n<body><main><h1>{title}</h1>"
        f'<p class="remark">stereo-vio {_text(__version__)}</p>\n'
        + "\n".join(parts)
        + "\n</main></body></html>\n"
    )


def _words(runs: Sequence[FinishedRun]) -> str:
    paragraphs = []
    for run, colour in zip(runs, [*COLOURS, *COLOURS], strict=False):
        head = f'<h2><span class="swatch" style="background:{colour}"></span>{_text(run.name)}</h2>'
        command = run.metrics.get("command")
        typed = f"<p><code>{_text(str(command))}</code></p>" if command else ""
        text = f"<p>{_text(' '.join(summary(run)))}</p>"
        paragraphs.append((head if len(runs) > 1 else "<h2>Summary</h2>") + text + typed)
    return f"<section>{''.join(paragraphs)}</section>"


def _images(runs: Sequence[FinishedRun]) -> str:
    """Show the annotated image that each run kept, and the picture of its mesh."""
    features = _pictures(runs, Path(RunFile.FEATURES), "jpeg")
    meshes = _pictures(runs, Path(MeshFile.FOLDER, MeshFile.PICTURE), "png")
    remark = (
        '<p class="remark">The left image half-way through the run. Gray circles have no match '
        "in the right image.</p>"
    )
    out = (
        f"<section><h2>Features and disparities</h2>{remark}{features}</section>"
        if features
        else ""
    )
    return out + (f"<section><h2>Mesh</h2>{meshes}</section>" if meshes else "")


def _pictures(runs: Sequence[FinishedRun], name: Path, kind: str) -> str:
    """Return an image file of each run's folder that has it."""
    shown = []
    for run in runs:
        if (file := run.folder / name).is_file():
            data = b64encode(read_input(file)).decode("ascii")
            head = f"<p>{_text(run.name)}</p>" if len(runs) > 1 else ""
            shown.append(
                f'{head}<img alt="{_text(name.stem)}" src="data:image/{kind};base64,{data}">'
            )
    return "".join(shown)


def _lists(title: str, runs: Sequence[FinishedRun], lines: Sequence[Sequence[str]]) -> str:
    """Return a section with the lines of each run that has any; nothing where none has."""
    lists = [
        (f"<p>{_text(run.name)}</p>" if len(runs) > 1 else "")
        + f"<ul>{''.join(f'<li>{_text(line)}</li>' for line in found)}</ul>"
        for run, found in zip(runs, lines, strict=True)
        if found
    ]
    return f"<section><h2>{title}</h2>{''.join(lists)}</section>" if lists else ""


def _key_figures(runs: Sequence[FinishedRun]) -> str:
    found = compared_figures(runs)
    names = [run.name for run in runs]
    rows = {name: [text for text, _ in cells] for name, cells in found.items()}
    best = {
        (name, k)
        for name, cells in found.items()
        for k, (_, is_best) in enumerate(cells)
        if is_best
    }
    if len(runs) == 1:
        return _table("Figures", names, rows)
    between = [apart(runs[0], run) for run in runs[1:]]
    if any(between):
        cells = ["" if other is None else str(other) for other in between]
        rows[f"distance from {runs[0].name}"] = ["–", *(cell or "–" for cell in cells)]
    remark = f"In brackets the change from {runs[0].name}; bold: the best." if best else ""
    return _table("Figures", names, rows, best, remark)


def _settings(runs: Sequence[FinishedRun]) -> str:
    rows = {}
    for key in sorted({key for run in runs for key in run.changed}):
        default = next(run.changed[key][1] for run in runs if key in run.changed)
        rows[key] = [
            str(v) for v in (default, *(run.changed.get(key, (default,))[0] for run in runs))
        ]
    if not rows:
        return "<section><h2>Settings</h2><p>All settings have their defaults.</p></section>"
    return _table(
        "Settings that differ from the default", ["default", *(run.name for run in runs)], rows
    )


def _table(
    title: str,
    columns: Sequence[str],
    rows: Mapping[str, Sequence[str]],
    bold: Collection[tuple[str, int]] = (),
    remark: str = "",
) -> str:
    """Return a section with a table of named columns and rows; `bold`: cells by row and column."""
    head = "".join(f"<th>{_text(name)}</th>" for name in columns)
    body = ""
    for name, cells in rows.items():
        body += f"<tr><th>{_text(name)}</th>"
        for k, cell in enumerate(cells):
            text = _text(cell)
            body += f"<td><b>{text}</b></td>" if (name, k) in bold else f"<td>{text}</td>"
        body += "</tr>"
    said = f'<p class="remark">{_text(remark)}</p>' if remark else ""
    table = f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<section><h2>{title}</h2>{said}<div class="scroll">{table}</div></section>'


def _figure(section: ReportSection, number: int) -> str:
    drawing = section.figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id=f"figure-{number}",
        config={"displaylogo": False},
    )
    remark = f'<p class="remark">{_text(section.remark)}</p>' if section.remark else ""
    return f"<section><h2>{_text(section.title)}</h2>{remark}{drawing}</section>"


def _text(value: str) -> str:
    """Return text for HTML; control characters and surrogates of file names are escaped."""
    return escape(printable(value))
