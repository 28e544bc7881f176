"""One self-contained HTML page: text, tables and figures, with plotly's script embedded once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from vio.files.atomic import atomic_write_text
from vio.files.inputs import read_input
from vio.report.compared import apart, compared_figures
from vio.report.figures import ReportSection, sections
from vio.report.html import document, image, table, text
from vio.report.words import calibration_findings, summary
from vio.runs.curves import colours, curves_of
from vio.runs.files import MeshFile, RunFile
from vio.runs.finished import FinishedRun


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

    title = ", ".join(run.name for run in runs)
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
    return document(title, parts, f"<script>{get_plotlyjs()}</script>")


def _words(runs: Sequence[FinishedRun]) -> str:
    paragraphs = []
    for run, colour in zip(runs, colours(len(runs)), strict=True):
        head = f'<h2><span class="swatch" style="background:{colour}"></span>{text(run.name)}</h2>'
        command = run.metrics.get("command")
        typed = ""
        if command:
            typed = f"<p><code>{text(str(command))}</code></p>"
        said = f"<p>{text(' '.join(summary(run)))}</p>"
        paragraphs.append((head if len(runs) > 1 else "<h2>Summary</h2>") + said + typed)
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
            head = ""
            if len(runs) > 1:
                head = f"<p>{text(run.name)}</p>"
            shown.append(head + image(read_input(file), kind, name.stem))
    return "".join(shown)


def _lists(title: str, runs: Sequence[FinishedRun], lines: Sequence[Sequence[str]]) -> str:
    """Return a section with the lines of each run that has any; nothing where none has."""
    lists = [
        (f"<p>{text(run.name)}</p>" if len(runs) > 1 else "")
        + f"<ul>{''.join(f'<li>{text(line)}</li>' for line in found)}</ul>"
        for run, found in zip(runs, lines, strict=True)
        if found
    ]
    if not lists:
        return ""
    return f"<section><h2>{title}</h2>{''.join(lists)}</section>"


def _key_figures(runs: Sequence[FinishedRun]) -> str:
    found = compared_figures(runs)
    names = [run.name for run in runs]
    rows = {name: [text for text, _ in cells] for name, cells in found.items()}
    if len(runs) == 1:
        return table("Figures", names, rows)
    best = _best_cells(found)
    distances = _distances(runs)
    if any(distances):
        rows[f"distance from {runs[0].name}"] = ["–", *(text or "–" for text in distances)]
    remark = f"In brackets the change from {runs[0].name}; bold: the best." if best else ""
    return table("Figures", names, rows, best, remark)


def _distances(runs: Sequence[FinishedRun]) -> list[str]:
    """Return how far each other run is from the first, as text; empty: they are not comparable."""
    return [str(apart(runs[0], run) or "") for run in runs[1:]]


def _best_cells(figures: Mapping[str, Sequence[tuple[str, bool]]]) -> set[tuple[str, int]]:
    """Return row and column of the figures that are the best."""
    return {
        (name, k)
        for name, cells in figures.items()
        for k, (_, is_best) in enumerate(cells)
        if is_best
    }


def _settings(runs: Sequence[FinishedRun]) -> str:
    rows = {}
    for key in sorted({key for run in runs for key in run.changed}):
        default = next(run.changed[key][1] for run in runs if key in run.changed)
        rows[key] = [
            str(v) for v in (default, *(run.changed.get(key, (default,))[0] for run in runs))
        ]
    if not rows:
        return "<section><h2>Settings</h2><p>All settings have their defaults.</p></section>"
    return table(
        "Settings that differ from the default", ["default", *(run.name for run in runs)], rows
    )


def _figure(section: ReportSection, number: int) -> str:
    drawing = section.figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id=f"figure-{number}",
        config={"displaylogo": False, "responsive": True},
    )
    remark = ""
    if section.remark:
        remark = f'<p class="remark">{text(section.remark)}</p>'
    return f"<section><h2>{text(section.title)}</h2>{remark}{drawing}</section>"
