"""The page of the documentation on faults that were drawn, and its tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from tools.faults.kinds import KINDS
from tools.faults.scores import COVERED, SOON_FRAMES
from vio.filters.settings import MsckfSettings

Row: TypeAlias = dict[str, Any]
_FAR = 10.0  # standard deviations
_PAGE = """# Faults that are drawn

`python -m tools.faults.draws` draws faults of short recordings and renders (2 to 11 s) from a seed. Commit {commit},
seeds {seeds}.

*Covered*: the position, relative to the first pose, is within {covered:g} stated standard deviations (root of the
trace) in every frame, or at most a fifth further off than in the recording as it is. *Flagged*: a
[finding](findings.md) that the recording as it is does not have makes estimates degraded or unusable; *soon*
within {soon} frames of the fault's first frame. *Silent*: neither covered
nor flagged. *Refused*: the run ends with an error. Kinds marked * were kept aside at first.

{summary}

## By kind

{kinds}

## Healthy variants

These must not be flagged.

{healthy}
"""


def page(rows: Sequence[Row], commit: str) -> str:
    """Return the page, Markdown."""
    kinds, healthy = tables(rows)
    faults = [row for row in rows if row.get("half")]
    seeds = ", ".join(str(seed) for seed in sorted({row["seed"] for row in rows if "seed" in row}))
    return _PAGE.format(
        commit=commit,
        seeds=seeds,
        covered=COVERED,
        soon=SOON_FRAMES,
        summary=summary(faults),
        kinds=kinds,
        healthy=healthy,
    )


def is_observable(row: Row) -> bool:
    """Whether the sensors of a draw can show its fault.

    By images alone a wrong focal length or baseline is another scale of the scene: what is stated
    of the scale is the calibration's own uncertainty, whatever the images show.
    """
    return row["motion"] is not None or KINDS[row["kind"]].by_images


def summary(faults: Sequence[Row]) -> str:
    """Return what share of faults is covered or flagged soon: of all, and of those that the
    sensors can show; and how the errors of the others compare with the stated scale.
    """
    shown = [row for row in faults if is_observable(row)]
    others = [row for row in faults if not is_observable(row) and "error" not in row]
    lines = [
        f"- all {len(faults)} faults: {_good_share(faults)} covered or flagged soon, "
        f"{_far_silent(faults)} silent beyond {_FAR:g} standard deviations;",
        f"- the {len(shown)} that the sensors can show: {_good_share(shown)}, "
        f"{_far_silent(shown)} silent beyond {_FAR:g}.",
    ]
    if others:
        settings = MsckfSettings()
        prior = 100 * float(np.hypot(settings.stereo_baseline_sigma, settings.stereo_focal_sigma))
        sizes = np.array([row["size"] for row in others]) / prior
        times = np.array([row["ratio"] for row in others]) / sizes
        lines.append(
            f"\nThe other {len(others)} have a focal length or baseline that is off by "
            f"{sizes.min():.2g} to {sizes.max():.2g} times the {prior:.2g} % that the settings state "
            "as the calibration's standard deviation, and images alone, which cannot show it. Over "
            f"the stated sigma, their errors are {times.min():.2g} to {times.max():.2g} times that "
            "(median "
            f"{np.median(times):.2g}): what is stated holds for calibrations as good as the "
            "settings say (`msckf.stereo_baseline_sigma`, `msckf.stereo_focal_sigma`)."
        )
    return "\n".join(lines)


def _is_good(row: Row) -> bool:
    return "error" in row or row["covered"] or _is_soon(row)


def _good_share(rows: Sequence[Row]) -> str:
    return f"{100 * sum(map(_is_good, rows)) / len(rows):.0f} %" if rows else "none"


def _far_silent(rows: Sequence[Row]) -> int:
    return sum("error" not in row and row["silent"] and row["ratio"] > _FAR for row in rows)


def tables(rows: Sequence[Row]) -> tuple[str, str]:
    """Return the tables of faults by kind and of healthy variants, Markdown."""
    faults = [row for row in rows if row.get("half")]
    healthy = [row for row in rows if "half" in row and row["half"] is None]
    return _kinds_table(faults), _healthy_table(healthy)


def _kinds_table(rows: Sequence[Row]) -> str:
    head = (
        "| kind | sizes | draws | covered | flagged soon | later | silent | beyond 10 sigma, silent "
        "| refused | covered or soon | error over sigma: median, worst | ATE over clean: median, "
        "worst |"
    )
    lines = [head, "|---" * 12 + "|"]
    for name, kind in KINDS.items():
        own = [row for row in rows if row["kind"] == name]
        if own:
            mark = "*" if own[0]["half"] == "kept" else ""
            same = kind.smallest == kind.largest
            sizes = "" if same else f"{kind.smallest:g} to {kind.largest:g} {kind.unit}"
            lines.append(f"| {kind.group}: {name}{mark} | {sizes} | {_figures(own)} |")
    return "\n".join([*lines, f"| all | | {_figures(rows)} |"])


def _figures(rows: Sequence[Row]) -> str:
    """The cells of a table's line from the number of draws on."""
    refused = [row for row in rows if "error" in row]
    ended = [row for row in rows if "error" not in row]
    covered = sum(row["covered"] for row in ended)
    soon = [row for row in ended if _is_soon(row)]
    later = sum(row["flagged_after"] is not None and not _is_soon(row) for row in ended)
    silent = sum(row["silent"] for row in ended)
    share = _good_share(rows) if rows else ""
    ratios = _spread([row["ratio"] for row in ended])
    ates = _spread([row["ate_m"] / row["clean_ate_m"] for row in ended if row["clean_ate_m"]])
    counts = (len(rows), covered, len(soon), later, silent, _far_silent(rows), len(refused))
    return " | ".join([*map(str, counts), share, ratios, ates])


def _is_soon(row: Row) -> bool:
    after = row["flagged_after"]
    return after is not None and after <= SOON_FRAMES


def _spread(values: Sequence[float]) -> str:
    return f"{np.median(values):.2g}, {max(values):.3g}" if values else ""


def _healthy_table(rows: Sequence[Row]) -> str:
    flagged = [row for row in rows if row.get("said") or "error" in row]
    drawn = ", ".join(dict.fromkeys(row["kind"] for row in rows))
    lines = [f"{len(flagged)} of {len(rows)} are flagged ({drawn})."]
    if flagged:
        lines += ["", "| variant | flagged | said |", "|---|---|---|"]
    for name in dict.fromkeys(row["kind"] for row in flagged):
        own = [row for row in flagged if row["kind"] == name]
        said = dict.fromkeys(line for row in own for line in row.get("said", [row.get("error")]))
        lines.append(f"| {name} | {len(own)} | {'; '.join(said)} |")
    return "\n".join(lines)
