"""The interactive figures of a report, by plotly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vio.findings import INTEGRITIES
from vio.geometry.lie import FloatArray
from vio.report.compared import apart
from vio.runs.curves import (
    COLOURS,
    FEATURE_WORDS,
    SIGMAS,
    STAGE_COLOURS,
    Curves,
    Truth,
    binned,
    colours,
    stereo_curves,
    thinned,
)
from vio.runs.finished import FinishedRun
from vio.runs.pipeline import STAGES

if TYPE_CHECKING:
    import plotly.graph_objects as go

_TRUTH = "#111111"
_POINTS = "#9aa5b1"
_LOOPS = "#c82828"
_BULK = (10, 90)  # percentiles of the bands' edges that an axis shows at least
_LONGEST_SIDE = 1.5  # of the box in three dimensions, which is seen whole from the eye's place
_EYE = {"x": 1.2, "y": -1.2, "z": 0.8}
_ENDS = (("start", "circle-open", 0), ("end", "diamond-open", -1))  # name, symbol, row of a path
_AXES = ("right", "ahead", "up")


@dataclass(frozen=True, slots=True)
class ReportSection:
    """A part of the page."""

    title: str
    figure: go.Figure
    remark: str = ""  # how to read it


def sections(runs: Sequence[FinishedRun], curves: Sequence[Curves]) -> list[ReportSection]:
    """Return all figures that these runs have the data for."""
    found = [
        _paths(runs, curves),
        _path_3d(runs, curves),
        *_mapped(runs, curves),
        _position(runs, curves),
        _attitude(runs, curves),
    ]
    if any(np.isfinite(c.velocity).any() for c in curves):
        found.append(_velocity(runs, curves))
    if any(c.truth is not None for c in curves):
        found.append(_errors(runs, curves))
    found += _apart(runs)
    found += _integrity(runs)
    found += [_features(runs), _innovations(runs), *_biases(runs), _timing(runs), *_stereo(runs)]
    return found


def _paths(runs: Sequence[FinishedRun], curves: Sequence[Curves]) -> ReportSection:
    """Draw the path from above and from the side, with the landmarks."""
    figure = _subplots(1, 2, titles=("from above", "from the side"), shared=False)
    for column, (first, second) in enumerate(((0, 1), (1, 2)), start=1):
        low, high = _extent([c.position for c in curves], (first, second))
        points = curves[0].points[:, (first, second)]
        points = points[np.all((points >= low) & (points <= high), axis=1)]
        _line(
            figure,
            points,
            "landmarks",
            _POINTS,
            1,
            column,
            mode="markers",
            marker={"size": 2, "opacity": 0.6},
        )
        for truth in _truths(curves):
            _line(
                figure,
                truth.position[:, (first, second)],
                "ground truth",
                _TRUTH,
                1,
                column,
                width=3,
            )
        for run, curve, colour in zip(runs, curves, colours(len(runs)), strict=True):
            if curve.dead_reckoning is not None:
                if len(runs) == 1:
                    label = "dead reckoning"
                else:
                    label = f"{run.name}, dead reckoning"
                _line(
                    figure,
                    curve.dead_reckoning[:, (first, second)],
                    label,
                    colour,
                    1,
                    column,
                    dash="dash",
                    width=1,
                )
            _line(figure, curve.position[:, (first, second)], run.name, colour, 1, column)
        for curve in curves:
            for label, symbol, row in _ENDS:
                end = curve.position[[row]][:, (first, second)]
                marks = {"size": 9, "symbol": symbol}
                _line(figure, end, label, _TRUTH, 1, column, mode="markers", marker=marks)
        figure.update_xaxes(title_text=f"{_AXES[first]} (m)", row=1, col=column)
        figure.update_yaxes(title_text=f"{_AXES[second]} (m)", row=1, col=column)
        figure.update_yaxes(scaleanchor=f"x{'' if column == 1 else column}", row=1, col=column)
    figure.update_layout(height=560)
    return ReportSection("Path", figure, "Axes are right, ahead and up at the start.")


def _path_3d(runs: Sequence[FinishedRun], curves: Sequence[Curves]) -> ReportSection:
    """Draw the path in three dimensions, with equal scales."""
    import plotly.graph_objects as go

    figure = _subplots(1, 1, shared=False, kind="scene")
    paths = [("ground truth", truth.position, _TRUTH, 5) for truth in _truths(curves)]
    paths += [
        (run.name, c.position, colour, 3)
        for run, c, colour in zip(runs, curves, colours(len(runs)), strict=True)
    ]
    for label, p, colour, width in paths:
        x, y, z = (_short(p[:, axis]) for axis in range(3))
        line = {"color": colour, "width": width}
        figure.add_trace(
            go.Scatter3d(x=x, y=y, z=z, mode="lines", line=line, **_named(figure, label))
        )
    for curve in curves:
        for label, symbol, row in _ENDS:
            x, y, z = ([value] for value in _short(curve.position[row]))
            marker = {"size": 6, "color": _TRUTH, "symbol": symbol}
            figure.add_trace(
                go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, **_named(figure, label))
            )
    low, high = _extent([p for _, p, _, _ in paths], (0, 1, 2), 0.05, 0.02)
    points = curves[0].points[
        np.all((curves[0].points >= low) & (curves[0].points <= high), axis=1)
    ]
    x, y, z = (_short(points[:, axis]) for axis in range(3))
    marker = {"size": 1, "color": _POINTS, "opacity": 0.6}
    figure.add_trace(
        go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, **_named(figure, "landmarks"))
    )
    # Its view is as wide as it is high: a higher or narrower one cuts the path off on a phone.
    figure.update_layout(height=480, scene=_equal_scales(high - low), margin={"l": 0, "r": 0})
    return ReportSection("Path in three dimensions", figure, "Turn it with the mouse.")


def _equal_scales(span: FloatArray) -> dict[str, Any]:
    """Return the scene of a plot in three dimensions that shows a span (3,) in m."""
    axes = {
        f"{name}axis": {"title": f"{axis} (m)"} for name, axis in zip("xyz", _AXES, strict=True)
    }
    ratio = dict(zip("xyz", (_LONGEST_SIDE * span / span.max()).tolist(), strict=True))
    return {**axes, "aspectmode": "manual", "aspectratio": ratio, "camera": {"eye": _EYE}}


def _mapped(runs: Sequence[FinishedRun], curves: Sequence[Curves]) -> list[ReportSection]:
    """Draw the runs that had a map in it, from above, with keyframes and loops."""
    chosen = [
        (r, c.mapped, colour)
        for r, c, colour in zip(runs, curves, colours(len(runs)), strict=True)
        if c.mapped is not None
    ]
    if not chosen:
        return []
    figure = _subplots(1, 1, shared=False)
    for truth in _truths(curves):
        _line(figure, truth.position[:, :2], "ground truth", _TRUTH, 1, 1, width=3)
    for run, mapped, colour in chosen:
        if len(chosen) == 1:
            name = ""
        else:
            name = f"{run.name}, "
        marks = {"size": 5, "symbol": "circle-open"}
        _line(
            figure,
            mapped.keyframes[:, :2],
            f"{name}keyframes",
            _POINTS,
            1,
            1,
            mode="markers",
            marker=marks,
        )
        # One trace of separate strokes: rows of NaN part them.
        strokes = np.concatenate(
            [mapped.loops[:, :, :2], np.full((len(mapped.loops), 1, 2), np.nan)], axis=1
        )
        if len(strokes):
            _line(
                figure,
                strokes.reshape(-1, 2),
                f"{name}loops ({len(strokes)})",
                _LOOPS,
                1,
                1,
                width=1.2,
            )
        _line(figure, mapped.position[:, :2], f"{name}in the map", colour, 1, 1)
    figure.update_xaxes(title_text=f"{_AXES[0]} (m)", row=1, col=1)
    figure.update_yaxes(title_text=f"{_AXES[1]} (m)", scaleanchor="x", row=1, col=1)
    figure.update_layout(height=560)
    text = "Poses of all frames after the last optimisation; a loop joins a frame with the keyframe that it sees again."
    return [ReportSection("Map", figure, text)]


def _position(runs: Sequence[FinishedRun], curves: Sequence[Curves]) -> ReportSection:
    found = [(c.seconds, c.position, c.position_sigma) for c in curves]
    truths = [(truth.seconds, truth.position) for truth in _truths(curves)]
    figure = _three(runs, found, truths, [f"{a} (m)" for a in _AXES])
    return _over_time(
        "Position and height", figure, "Bands are three standard deviations of the filter."
    )


def _attitude(runs: Sequence[FinishedRun], curves: Sequence[Curves]) -> ReportSection:
    found = [(c.seconds, c.attitude, c.attitude_sigma) for c in curves]
    truths = [(truth.seconds, truth.attitude) for truth in _truths(curves)]
    figure = _three(runs, found, truths, ("heading (deg)", "pitch (deg)", "roll (deg)"))
    text = "Of the left camera: heading to the right, pitch up, roll with the right side down."
    return _over_time("Attitude", figure, text)


def _velocity(runs: Sequence[FinishedRun], curves: Sequence[Curves]) -> ReportSection:
    found = [(c.seconds, c.velocity, c.velocity_sigma) for c in curves]
    known = [truth for truth in _truths(curves) if len(truth.seconds) > 2]
    truths = [
        (truth.seconds, np.gradient(truth.position, truth.seconds, axis=0)) for truth in known
    ]
    figure = _three(runs, found, truths, [f"{a} (m/s)" for a in _AXES])
    return _over_time("Velocity", figure, "Ground truth: differences of its positions.")


def _three(
    runs: Sequence[FinishedRun],
    found: Sequence[tuple[FloatArray, FloatArray, FloatArray]],
    truths: Sequence[tuple[FloatArray, FloatArray]],
    names: Sequence[str],
) -> go.Figure:
    """Draw three components of runs over time: seconds (N,), values (N, 3), sigmas (N, 3) of
    each, and the truth's.
    """
    figure = _subplots(3, 1)
    for row, name in enumerate(names, start=1):
        for run, (seconds, values, sigmas), colour in zip(
            runs, found, colours(len(runs)), strict=True
        ):
            _band(figure, seconds, values[:, row - 1], sigmas[:, row - 1], run.name, colour, row)
        figure.update_yaxes(title_text=name, row=row, col=1)
    for seconds, values in truths:
        for row in (1, 2, 3):
            _xy(figure, seconds, values[:, row - 1], "ground truth", _TRUTH, row, dash="dot")
    return figure


def _truths(curves: Sequence[Curves]) -> list[Truth]:
    """Return the references, that of each recording once."""
    return [c.truth for c in curves if c.truth is not None and c.draws_truth]


def _errors(runs: Sequence[FinishedRun], curves: Sequence[Curves]) -> ReportSection:
    figure = _subplots(2, 1)
    for run, curve, colour in zip(runs, curves, colours(len(runs)), strict=True):
        if curve.truth is not None:
            _xy(figure, curve.truth.seconds, curve.truth.error_m, run.name, colour, 1)
            _xy(figure, curve.truth.seconds, curve.truth.error_deg, run.name, colour, 2)
    figure.update_yaxes(title_text="position (m)", rangemode="tozero", row=1, col=1)
    figure.update_yaxes(title_text="attitude (deg)", rangemode="tozero", row=2, col=1)
    return _over_time(
        "Errors", figure, "Against the reference, after one rigid alignment of the whole path."
    )


def _apart(runs: Sequence[FinishedRun]) -> list[ReportSection]:
    """Draw how far runs of one recording are from the first of them."""
    between = [apart(runs[0], run) for run in runs[1:]]
    if not any(between):
        return []
    figure = _subplots(1, 1)
    for run, found, colour in zip(runs[1:], between, colours(len(runs))[1:], strict=True):
        if found is not None:
            rows = thinned(len(found.seconds))
            _xy(figure, found.seconds[rows], found.distance_m[rows], run.name, colour, 1)
    figure.update_layout(showlegend=True)
    figure.update_yaxes(title_text="distance (m)", rangemode="tozero", row=1, col=1)
    text = "At the frames that both have, after one rigid alignment of the whole path."
    return [_over_time(f"Distance from {runs[0].name}", figure, text)]


def _integrity(runs: Sequence[FinishedRun]) -> list[ReportSection]:
    """Draw the integrity of runs that had a finding that matters."""
    chosen = [
        (run, colour)
        for run, colour in zip(runs, colours(len(runs)), strict=True)
        if "integrity" in run.frames and run.frames["integrity"].any()
    ]
    if not chosen:
        return []
    figure = _subplots(1, 1)
    for run, colour in chosen:
        _frame_curve(figure, run, "integrity", run.name, colour, 1)
    figure.update_yaxes(
        tickvals=[0, 1, 2], ticktext=list(INTEGRITIES), range=[-0.1, 2.1], row=1, col=1
    )
    text = "Whether estimates may be used, by what was found in images, sensors and estimate."
    return [_over_time("Integrity", figure, text)]


def _features(runs: Sequence[FinishedRun]) -> ReportSection:
    figure = _subplots(1, 1)
    for run, colour in zip(runs, colours(len(runs)), strict=True):
        for name, dash in (("selected", "dash"), ("matched", "dot"), ("used", "solid")):
            words = FEATURE_WORDS[name]
            if len(runs) == 1:
                label = words
            else:
                label = f"{run.name}, {words}"
            shade = (
                colour
                if len(runs) > 1
                else {"matched": _POINTS, "selected": COLOURS[1], "used": COLOURS[0]}[name]
            )
            _frame_curve(
                figure, run, name, label, shade, 1, dash=dash if len(runs) > 1 else "solid"
            )
    figure.update_yaxes(title_text="features", rangemode="tozero", row=1, col=1)
    return _over_time(
        "Features",
        figure,
        "Chosen by the selector, of those in the left image; with a match in the right one; used "
        "by the filter.",
    )


def _innovations(runs: Sequence[FinishedRun]) -> ReportSection:
    shown = {
        "innovation_median_px": "innovations (px)",
        "innovation_ratio": "innovations / σ",
        "nis_per_dof": "residuals² / σ²",
    }
    shown = {
        name: title for name, title in shown.items() if any(name in run.frames for run in runs)
    }
    figure = _subplots(len(shown), 1)
    for row, (name, title) in enumerate(shown.items(), start=1):
        for run, colour in zip(runs, colours(len(runs)), strict=True):
            if name in run.frames:
                _frame_curve(figure, run, name, run.name, colour, row)
        figure.update_yaxes(title_text=title, rangemode="tozero", row=row, col=1)
    text = (
        "Innovations: how far features lie from where the filter expects them, and that over its "
        "standard deviation (median): 1 is consistent, less is cautious, more is overconfident. "
        "Residuals: what the update leaves of tracks, squared, over the noise (NIS per degree of "
        "freedom)."
    )
    return _over_time("Innovations and residuals", figure, text)


def _biases(runs: Sequence[FinishedRun]) -> list[ReportSection]:
    """Draw the biases of runs with an IMU."""
    chosen = [
        (run, c)
        for run, c in zip(runs, colours(len(runs)), strict=True)
        if run.metrics.get("motion") == "imu"
    ]
    if not chosen:
        return []
    figure = _subplots(3, 2, titles=("gyroscope", "accelerometer"))
    for run, colour in chosen:
        rows = thinned(len(run.estimates))
        for column, (name, factor) in enumerate(
            (("gyro_bias", np.degrees(1.0)), ("accel_bias", 1.0)), start=1
        ):
            values, sigmas = (factor * run.estimates[key][rows] for key in (name, f"{name}_sigma"))
            for axis in range(3):
                _band(
                    figure,
                    run.seconds[rows],
                    values[:, axis],
                    sigmas[:, axis],
                    run.name,
                    colour,
                    axis + 1,
                    column,
                )
    for axis, name in enumerate("xyz"):
        figure.update_yaxes(title_text=f"{name} (deg/s)", row=axis + 1, col=1)
        figure.update_yaxes(title_text=f"{name} (m/s²)", row=axis + 1, col=2)
    return [
        _over_time("IMU biases", figure, "Axes of the IMU; bands are three standard deviations.")
    ]


def _timing(runs: Sequence[FinishedRun]) -> ReportSection:
    titles: Sequence[str] = ()
    if len(runs) > 1:
        titles = [run.name for run in runs]
    figure = _subplots(len(runs), 1, titles=titles)
    for row, run in enumerate(runs, start=1):
        for stage, shade in zip(STAGES, STAGE_COLOURS, strict=True):
            seconds, median = binned(run.seconds, np.nan_to_num(run.frames[f"{stage}_ms"]), 600)
            more: dict[str, Any] = {
                "stackgroup": "stages",
                "line": {"width": 0},
                "fillcolor": shade,
            }
            _xy(figure, seconds, median, stage, shade, row, **more)
        figure.update_yaxes(title_text="ms a frame", row=row, col=1)
    return _over_time(
        "Time",
        figure,
        "Wall time by stage; long runs are shown by the medians of groups of frames.",
    )


def _stereo(runs: Sequence[FinishedRun]) -> list[ReportSection]:
    """Draw what the stereo calibration is off by, of runs that estimated it."""
    chosen = [
        (run, c)
        for run, c in zip(runs, colours(len(runs)), strict=True)
        if np.isfinite(run.estimates["stereo_field"]).any()
    ]
    if not chosen:
        return []
    figure = _subplots(1, 1)
    for run, colour in chosen:
        rows = thinned(len(run.estimates))
        values, sigmas = stereo_curves(run.estimates[rows], focal=1e3)
        _band(figure, run.seconds[rows], values[:, 0], sigmas[:, 0], run.name, colour, 1)
    figure.update_yaxes(title_text="a0 (1/1000 focal length)", row=1, col=1)
    text = "By how much right columns are off at the image's centre; three standard deviations."
    return [_over_time("Stereo calibration", figure, text)]


# --- drawing
# --------------------------------------------------------------------------------------------------


def _subplots(
    rows: int, columns: int, *, titles: Sequence[str] = (), shared: bool = True, kind: str = "xy"
) -> go.Figure:
    from plotly.subplots import make_subplots

    vertical_spacing = None
    if rows > 1:
        vertical_spacing = 0.25 / rows**1.5
    figure = make_subplots(
        rows=rows,
        cols=columns,
        subplot_titles=list(titles) or None,
        specs=[[{"type": kind}] * columns] * rows,
        shared_xaxes="all" if shared else False,
        vertical_spacing=vertical_spacing,
        horizontal_spacing=0.09,
    )
    figure.update_layout(
        template="plotly_white",
        margin={"l": 60, "r": 30, "t": 64 if titles else 30, "b": 44},
        legend={
            "orientation": "h",
            "y": 1.08 if titles else 1.02,
            "yanchor": "bottom",
            "x": 0,
            "xanchor": "left",
        },
        modebar={"orientation": "v"},
        font={"family": "system-ui, sans-serif", "size": 12},
        height=max(170 * rows, 300) + 60,
    )
    return figure


def _over_time(title: str, figure: go.Figure, remark: str) -> ReportSection:
    for row, columns in enumerate(figure._grid_ref, start=1):
        for column in range(1, len(columns) + 1):
            _fit_bands(figure, row, column)
    figure.update_xaxes(title_text="time in the recording (s)", row=len(figure._grid_ref))
    return ReportSection(title, figure, remark)


def _fit_bands(figure: go.Figure, row: int, column: int) -> None:
    """Set an axis by its curves and the bulk of their bands: a filter that does not yet know has
    bands without end.
    """
    traces = list(figure.select_traces(row=row, col=column))
    bands = [t for t in traces if t.fill == "toself"]
    curves = [t for t in traces if t.fill != "toself"]
    values = [np.array(t.y, dtype=np.float64) for t in curves]
    if not bands or not values:
        return
    edges = np.concatenate([np.array(t.y, dtype=np.float64) for t in bands])
    shown = np.concatenate([*values, np.nanpercentile(edges, _BULK)])
    low = float(np.nanmin(shown))
    high = float(np.nanmax(shown))
    margin = 0.05 * max(high - low, 1e-9)
    figure.update_yaxes(range=[low - margin, high + margin], row=row, col=column)


def _named(figure: go.Figure, label: str) -> dict[str, Any]:
    """Return what ties traces of one label together: one entry in the legend shows and hides
    them all.
    """
    return {
        "name": label,
        "legendgroup": label,
        "showlegend": all(trace.name != label for trace in figure.data),
    }


def _line(
    figure: go.Figure,
    points: FloatArray,
    label: str,
    colour: str,
    row: int,
    column: int,
    *,
    dash: str = "solid",
    width: float = 1.8,
    **more: Any,
) -> None:
    """Draw a path (N, 2) in a plane."""
    import plotly.graph_objects as go

    line = {"color": colour, "dash": dash, "width": width}
    more = {"mode": "lines", **more}
    if "marker" in more:
        more["marker"] = {"color": colour, **more["marker"]}
    trace = go.Scatter(
        x=_short(points[:, 0]), y=_short(points[:, 1]), line=line, **_named(figure, label), **more
    )
    figure.add_trace(trace, row=row, col=column)


def _xy(
    figure: go.Figure,
    x: FloatArray,
    y: FloatArray,
    label: str,
    colour: str,
    row: int,
    column: int = 1,
    **more: Any,
) -> None:
    """Draw a curve (N,) over time."""
    import plotly.graph_objects as go

    more["line"] = {
        "color": colour,
        "width": 1.5,
        "dash": more.pop("dash", "solid"),
        **more.get("line", {}),
    }
    trace = go.Scatter(x=_short(x), y=_short(y), mode="lines", **_named(figure, label), **more)
    figure.add_trace(trace, row=row, col=column)


def _band(
    figure: go.Figure,
    x: FloatArray,
    y: FloatArray,
    sigma: FloatArray,
    label: str,
    colour: str,
    row: int,
    column: int = 1,
) -> None:
    """Draw a curve (N,) with a band of three standard deviations."""
    import plotly.graph_objects as go

    if np.isfinite(sigma).any():
        red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
        edges = np.concatenate([y + SIGMAS * sigma, (y - SIGMAS * sigma)[::-1]])
        band = go.Scatter(
            x=_short(np.concatenate([x, x[::-1]])),
            y=_short(edges),
            fill="toself",
            fillcolor=f"rgba({red},{green},{blue},0.15)",
            line={"width": 0},
            hoverinfo="skip",
            legendgroup=label,
            showlegend=False,
        )
        figure.add_trace(band, row=row, col=column)
    _xy(figure, x, y, label, colour, row, column)


def _frame_curve(
    figure: go.Figure,
    run: FinishedRun,
    name: str,
    label: str,
    colour: str,
    row: int,
    *,
    dash: str = "solid",
) -> None:
    rows = thinned(len(run.estimates))
    _xy(figure, run.seconds[rows], run.frames[name][rows], label, colour, row, dash=dash)


def _extent(
    paths: Sequence[FloatArray], axes: tuple[int, ...], share: float = 0.25, least_m: float = 0.05
) -> tuple[FloatArray, FloatArray]:
    """Return the corners of the box around paths with a margin (a share of the longest side),
    metres.
    """
    every = np.concatenate(paths)[:, axes]
    low = every.min(axis=0)
    high = every.max(axis=0)
    margin = max(share * float((high - low).max()), least_m)
    return low - margin, high + margin


def _short(values: FloatArray) -> list[float | None]:
    """Return values with six digits, which a screen does not distinguish from all of them, None
    for NaN.
    """
    return [None if v != v else float(f"{v:.6g}") for v in values.tolist()]
