"""Plots of a run and of several trajectories, drawn with matplotlib without its global state."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from vio.errors import EvaluationError, VioError
from vio.evaluation.trajectories import Evaluation, metres_text, metres_texts
from vio.files.atomic import atomic_write_bytes
from vio.files.printable import printable
from vio.files.tables import Rows
from vio.geometry.lie import FloatArray
from vio.records import S_PER_NS, STAGES, IntArray
from vio.runs.curves import (
    FEATURE_WORDS,
    SIGMAS,
    STAGE_COLOURS,
    Curves,
    DrawnRun,
    binned,
    colours,
    draw,
    stereo_curves,
)
from vio.runs.pipeline import RunResult

log = logging.getLogger(__name__)

_ESTIMATE = "#1f5fbf"
_REFERENCE = "#111111"
_DEAD_RECKONING = "#d9822b"
_LANDMARKS = "#9aa5b1"
_GREEN = "#3a9d5d"
_DEGRADED = "#e8b94a"  # behind the curves, while estimates are less certain …
_UNUSABLE = "#d64545"  # … or not to be used
_PURPLE = "#8a5fb0"


class _AxisRules(NamedTuple):
    """What axes show."""

    # a stereo calibration that ends within so many standard deviations of zero is not drawn
    moved_sigmas: float = 3.0
    min_margin_m: float = 0.02  # about a rig that stands
    millimetres_below_m: float = 0.02  # largest error of trajectories that are compared
    headroom: float = 1.3  # of the largest value to the end of an axis
    bins: int = 250  # of the curves that are medians over frames


_AXES = _AxisRules()
# Of the panels, as shares of the figure and of a panel. A layout that matplotlib finds by itself
# draws all twice.
_MARGINS = {
    "left": 0.06,
    "right": 0.985,
    "bottom": 0.06,
    "top": 0.925,
    "wspace": 0.18,
    "hspace": 0.26,
}


@dataclass(frozen=True, slots=True)
class RunPicture:
    """The map from above, and height, attitude, errors, feature counts and times over the frames of
    a run.

    It keeps copies, and so can be drawn when the files that the run grew in are gone.
    """

    run: DrawnRun
    frames: Rows  # (N,) rows of `vio.runs.tables.FRAME`
    dead_reckoning: Evaluation | None  # against the reference; None without one
    title: str
    focal: float | None  # of the panel of the stereo calibration; None: there is none

    @classmethod
    def of(
        cls, result: RunResult, evaluation: Evaluation | None, dead_reckoning: Evaluation | None
    ) -> RunPicture:
        """Keep what is drawn of a run, its trajectory and dead reckoning compared with a
        reference (None: without).
        """
        drawn = DrawnRun(
            np.array(result.estimates.rows),
            result.T_cam0_body,
            result.motion,
            evaluation,
            result.dead_reckoning,
            result.landmarks.p_world,
        )
        focal = result.recording.camera.fu if has_calibration_panel(result) else None
        return cls(
            drawn, np.array(result.frames.rows), dead_reckoning, _title(result, evaluation), focal
        )

    def write(self, path: Path) -> None:
        """Write a PNG; a picture that cannot be drawn or written gives a warning: the results do
        not depend on it.
        """
        write_picture(path, lambda: _figure(self))


def write_picture(path: Path, draw: Callable[[], Any]) -> None:
    """Write the matplotlib figure that `draw` returns as a PNG; a failure gives a warning and
    leaves no file.

    Raises:
        VioError: `draw` raised it.
    """
    try:
        stream = io.BytesIO()
        with warnings.catch_warnings():
            # another script
            warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)
            # a tenth larger, sooner
            draw().savefig(stream, format="png", pil_kwargs={"compress_level": 1})
        atomic_write_bytes(path, stream.getvalue())
    except VioError:  # what was asked for cannot be drawn of these data
        raise
    except Exception as error:
        log.warning(
            "%s was not drawn (%s: %s)",
            path.name,
            type(error).__name__,
            " ".join(str(error).split()),
        )
        log.debug("the traceback of the picture", exc_info=True)
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def _figure_class() -> Any:
    """Load matplotlib without the texts of help that it writes for each of its classes, a third
    of its loading time.
    """
    from matplotlib import artist

    written = artist.kwdoc
    artist.kwdoc = lambda _: ""  # type: ignore[assignment]
    try:
        from matplotlib.figure import Figure
    finally:
        artist.kwdoc = written
    return Figure


def _figure(picture: RunPicture) -> Any:
    Figure = _figure_class()
    figure = Figure(figsize=(13, 9), dpi=110)
    curves = draw(picture.run, picture.run.view_of_reference())
    calibrated = picture.focal is not None
    grid = figure.add_gridspec(6 if calibrated else 5, 2, width_ratios=(1.25, 1), **_MARGINS)
    _draw_map(figure.add_subplot(grid[:, 0]), curves)
    panels = [figure.add_subplot(grid[row, 1]) for row in range(6 if calibrated else 5)]
    _draw_error(panels[0], curves, picture.dead_reckoning)
    _draw_height(panels[1], curves)
    _draw_attitude(panels[2], curves)
    _draw_counts(panels[3], curves.seconds, picture.frames)
    _draw_time(panels[4], curves.seconds, picture.frames)
    if picture.focal is not None:
        _draw_calibration(panels[5], curves.seconds, picture.run.estimates, picture.focal)
    for axes in panels:
        axes.set_xlim(0, max(float(curves.seconds[-1]), 1e-3))
        axes.grid(alpha=0.25)
        _shade(axes, curves.seconds, picture.frames["integrity"])
        axes.tick_params(labelbottom=axes is panels[-1])  # all have the time axis of the last one
    panels[-1].set_xlabel("time in the recording (s)")
    # a $ in a file name is no formula
    figure.suptitle(picture.title, fontsize=12, parse_math=False)
    return figure


def _shade(axes: Any, seconds: FloatArray, integrity: IntArray) -> None:
    """Shade the time (N,) of the estimates that are degraded or unusable."""
    for state, colour in ((1, _DEGRADED), (2, _UNUSABLE)):
        held = np.concatenate([[0], integrity == state, [0]]).astype(np.int8)
        edges = np.flatnonzero(np.diff(held)).reshape(-1, 2)
        for first, end in edges.tolist():
            last = min(end, len(seconds) - 1)
            axes.axvspan(seconds[first], seconds[last], color=colour, alpha=0.25, lw=0)


def has_calibration_panel(result: RunResult) -> bool:
    """Return whether the stereo calibration was estimated, and ended off by more than its
    standard deviations.
    """
    field = result.estimates[-1].stereo_field
    if field is None:
        return False
    sigma = np.sqrt(np.diag(field.covariance))
    return bool(np.any(np.abs(field.coefficients) > _AXES.moved_sigmas * sigma))


def _title(result: RunResult, evaluation: Evaluation | None) -> str:
    name = f"{printable(result.recording.path.name)}: {result.config.backend}, motion {result.motion or 'none'}"
    if evaluation is None:
        return f"{name}, no reference"
    drift = evaluation.as_dict()["t_err_percent"]
    ate = metres_text(evaluation.ate_m.rmse)
    return f"{name}, ATE {ate}" + ("" if drift is None else f", drift {drift:.2f} %")


def _draw_map(axes: Any, curves: Curves) -> None:
    """Draw trajectories and landmarks from above, right and ahead at the start."""
    paths = [("estimate", curves.position, _ESTIMATE, "-", 1.8 if curves.truth is None else 1.6)]
    if curves.dead_reckoning is not None:
        paths.insert(0, ("dead reckoning", curves.dead_reckoning, _DEAD_RECKONING, "--", 1.2))
    if curves.truth is not None:
        paths.insert(0, ("ground truth", curves.truth.position, _REFERENCE, "-", 3.0))
    points = curves.points[:, :2]
    box = axes.get_position()
    shape = box.width * axes.figure.get_figwidth() / (box.height * axes.figure.get_figheight())
    low, high = _view(
        np.concatenate([path[1][:, :2] for path in paths if path[0] != "dead reckoning"]), shape
    )
    inside = np.all((points >= low) & (points <= high), axis=1)
    axes.scatter(
        *points[inside].T, s=1.2, c=_LANDMARKS, linewidths=0, label="landmarks", rasterized=True
    )
    for label, positions, colour, style, width in paths:
        axes.plot(*positions[:, :2].T, color=colour, ls=style, lw=width, label=label)
    for label, mark, position in (
        ("start", "o", curves.position[0]),
        ("end", "D", curves.position[-1]),
    ):
        axes.plot(*position[:2], mark, color=_REFERENCE, ms=6, mfc="white", label=label)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="box")
    axes.set_title("from above", fontsize=9, loc="left")
    axes.set_xlabel("right of the start (m)")
    axes.set_ylabel("ahead of the start (m)")
    axes.legend(loc="best", fontsize=9, markerscale=1.5)
    axes.grid(alpha=0.25)


def _view(paths: FloatArray, shape: float) -> tuple[FloatArray, FloatArray]:
    """Return limits of a panel whose width is `shape` times its height: all paths (N, 2), a
    margin, equal scales.
    """
    low = paths.min(axis=0)
    high = paths.max(axis=0)
    size = high - low + 2 * max(0.1 * float((high - low).max()), _AXES.min_margin_m)
    width = max(size[0], shape * size[1])
    height = max(size[1], size[0] / shape)
    half = 0.5 * np.array([width, height])
    return 0.5 * (low + high) - half, 0.5 * (low + high) + half


def _draw_error(axes: Any, curves: Curves, dead_reckoning: Evaluation | None) -> None:
    if curves.truth is None:
        axes.plot(
            curves.seconds, np.linalg.norm(curves.position_sigma, axis=1), color=_ESTIMATE, lw=1.2
        )
        axes.set_ylabel("position σ (m)")
        axes.set_title("no reference: the filter's own uncertainty", fontsize=9, loc="left")
        return
    axes.plot(curves.truth.seconds, curves.truth.error_m, color=_ESTIMATE, lw=1.4, label="estimate")
    if dead_reckoning is not None:
        seconds = curves.seconds[dead_reckoning.rows]
        axes.plot(seconds, dead_reckoning.errors_m, "--", color=_DEAD_RECKONING, lw=1.1)
    axes.set_ylabel("position error (m)")
    # dead reckoning may leave the panel
    axes.set_ylim(0, _AXES.headroom * max(float(curves.truth.error_m.max()), 1e-6))


def _legend_above(axes: Any) -> None:
    """Put a panel's legend above it, where it hides no curve."""
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 0.98),
        borderaxespad=0.0,
        borderpad=0.1,
        columnspacing=1.2,
        handlelength=1.6,
        fontsize=8,
        frameon=False,
        ncols=len(axes.get_legend_handles_labels()[1]),
    )


def _draw_height(axes: Any, curves: Curves) -> None:
    """Draw the height above the start with a band of three standard deviations."""
    height = curves.position[:, 2]
    band = SIGMAS * curves.position_sigma[:, 2]
    if curves.truth is not None:
        axes.plot(
            curves.truth.seconds,
            curves.truth.position[:, 2],
            color=_REFERENCE,
            lw=2.0,
            label="ground truth",
        )
    axes.fill_between(
        curves.seconds, height - band, height + band, color=_ESTIMATE, alpha=0.2, lw=0
    )
    axes.plot(curves.seconds, height, color=_ESTIMATE, lw=1.3, label="estimate, 3σ")
    spread = max(float(np.ptp(height)), 0.1)
    axes.set_ylim(height.min() - 0.5 * spread, height.max() + 0.5 * spread)
    axes.set_ylabel("height (m)")
    _legend_above(axes)


def _draw_attitude(axes: Any, curves: Curves) -> None:
    """Draw the left camera's heading, pitch and roll."""
    for k, (name, colour) in enumerate(
        (
            ("heading", _ESTIMATE),
            ("pitch", _DEAD_RECKONING),
            ("roll", _GREEN),
        )
    ):
        axes.plot(curves.seconds, curves.attitude[:, k], color=colour, lw=1.2, label=name)
    axes.set_ylabel("attitude (deg)")
    _legend_above(axes)


def _draw_counts(axes: Any, seconds: FloatArray, frames: Rows) -> None:
    for name, colour in (
        ("selected", _DEAD_RECKONING),
        ("matched", _LANDMARKS),
        ("used", _ESTIMATE),
    ):
        axes.plot(
            *binned(seconds, frames[name], _AXES.bins),
            color=colour,
            lw=1.2,
            label=FEATURE_WORDS[name],
        )
    axes.set_ylabel("features")
    axes.set_ylim(bottom=0)
    _legend_above(axes)


def _draw_time(axes: Any, seconds: FloatArray, frames: Rows) -> None:
    times, _ = binned(seconds, seconds, _AXES.bins)
    medians = [binned(seconds, frames[f"{stage}_ms"], _AXES.bins)[1] for stage in STAGES]
    axes.stackplot(times, medians, labels=STAGES, colors=STAGE_COLOURS, linewidth=0)
    axes.set_ylabel("time (ms)")
    # frames that compile leave the panel
    axes.set_ylim(0, max(2 * float(np.median(np.sum(medians, axis=0))), 1.0))
    _legend_above(axes)


def _draw_calibration(axes: Any, seconds: FloatArray, estimates: Rows, focal: float) -> None:
    """Draw the right columns' coefficients of (R3) with a standard deviation, and how far the
    rows are off.
    """
    values, sigmas = stereo_curves(estimates, focal)
    names = ("all columns", "along u", "with radius²", "with radius⁴")
    for name, colour, v, sigma in zip(
        names, (_ESTIMATE, _DEAD_RECKONING, _GREEN, _PURPLE), values.T, sigmas.T, strict=True
    ):
        axes.plot(seconds, v, color=colour, lw=1.2, label=name)
        axes.fill_between(seconds, v - sigma, v + sigma, color=colour, alpha=0.2, lw=0)
    axes.plot(seconds, estimates["stereo_rows_rms_px"], color=_LANDMARKS, lw=1.2, label="rows, rms")
    axes.set_ylabel("stereo off by (px)")
    _legend_above(axes)


@dataclass(frozen=True, slots=True)
class Compared:
    """What is drawn of trajectories beside a reference."""

    # axes of the reference's world, such as "xz", in which paths are drawn; None: the plane in
    # which the reference extends furthest
    axes: str | None = None
    columns: tuple[str, ...] = ("position",)  # panels, of `COMPARED_COLUMNS`
    over: Literal["distance", "time"] = "distance"


def draw_comparison(results: Mapping[str, Evaluation], shown: Compared = Compared()) -> Any:
    """Draw evaluations against one reference, by name: paths, and curves along them.

    Raises:
        EvaluationError: curves over time are asked for, and a reference has no times.
    """
    Figure = _figure_class()
    height = max(5.6, 2.2 * len(shown.columns))
    figure = Figure(figsize=(12, height), dpi=110, layout="constrained")
    grid = figure.add_gridspec(len(shown.columns), 2, width_ratios=(1, 1.2))
    _compare_paths(figure.add_subplot(grid[:, 0]), results, shown.axes)
    for row, column in enumerate(shown.columns):
        panel = figure.add_subplot(grid[row, 1])
        _compare_curves(panel, results, column, shown.over)
        if row == 0:
            panel.set_title("after alignment", fontsize=9, loc="left")
        panel.tick_params(labelbottom=row == len(shown.columns) - 1)
    panel.set_xlabel("time (s)" if shown.over == "time" else "distance along the reference (m)")
    return figure


def _compare_paths(axes: Any, results: Mapping[str, Evaluation], chosen: str | None) -> None:
    """Draw the paths in a plane, with their start and end."""
    truth = max((r.reference.positions for r in results.values()), key=len)
    if chosen is None:
        origin = truth[0]
        plane = np.linalg.svd(truth - truth.mean(axis=0), full_matrices=False)[2][:2]
        labels = ["along the longest extent (m)", "across (m)"]
    else:
        origin = np.zeros(3)
        plane = np.eye(3)[["xyz".index(axis) for axis in chosen]]
        labels = [f"{axis} (m)" for axis in chosen]
    flat = (truth - origin) @ plane.T
    axes.plot(*flat.T, color=_REFERENCE, lw=3.0, label="reference")
    ates = metres_texts(*(r.ate_m.rmse for r in results.values()))
    for (name, r), ate, colour in zip(results.items(), ates, colours(len(results)), strict=True):
        label = f"{name}: ATE {ate}"
        axes.plot(*((r.aligned.positions - origin) @ plane.T).T, color=colour, lw=1.4, label=label)
    axes.plot(*flat[0], "o", color=_REFERENCE, ms=6, mfc="white", label="start")
    axes.plot(*flat[-1], "D", color=_REFERENCE, ms=6, mfc="white", label="end")
    axes.set_aspect("equal", "datalim")
    axes.set(xlabel=labels[0], ylabel=labels[1], title="paths")
    axes.grid(alpha=0.25)
    # below the panel, where it hides no path
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12), frameon=False, ncols=2)


def _compare_curves(
    panel: Any, results: Mapping[str, Evaluation], column: str, over: Literal["distance", "time"]
) -> None:
    """Draw one quantity of all trajectories."""
    values, label = COMPARED_COLUMNS[column]
    largest = max(float(r.errors_m.max()) for r in results.values())
    factor = 1.0
    if column == "position" and largest < _AXES.millimetres_below_m:
        factor = 1e3
        label = label.replace("(m)", "(mm)")
    for (name, r), colour in zip(results.items(), colours(len(results)), strict=True):
        curve = factor * values(r)
        panel.plot(_abscissa(name, r, over), curve, color=colour, lw=1.4)
    if column in "xyz":
        longest = max(results, key=lambda name: results[name].matched)
        r = results[longest]
        truth = r.reference.positions[:, "xyz".index(column)]
        panel.plot(_abscissa(longest, r, over), truth, ":", color=_REFERENCE, lw=1.2)
    else:
        panel.set_ylim(bottom=0)
    panel.set_ylabel(label)
    panel.grid(alpha=0.25)


def _abscissa(name: str, r: Evaluation, over: Literal["distance", "time"]) -> FloatArray:
    """Return the distance on the reference, or the time since its first pose, of M poses."""
    if over == "distance":
        steps = np.linalg.norm(np.diff(r.reference.positions, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])
    times_ns = r.reference.times_ns
    if times_ns is None:
        times_ns = r.aligned.times_ns
        times_ns = None if times_ns is None else times_ns[r.rows]
    if times_ns is None:
        raise EvaluationError(
            f"{name}: neither it nor the reference has times; use --over distance"
        )
    return np.asarray((times_ns - times_ns[0]) * S_PER_NS, dtype=np.float64)


def _component(axis: int) -> Callable[[Evaluation], FloatArray]:
    return lambda r: r.aligned.positions[r.rows, axis]


# What may be drawn of a comparison: values (M,) of an evaluation, and the axis' label.
COMPARED_COLUMNS: dict[str, tuple[Callable[[Evaluation], FloatArray], str]] = {
    "position": (lambda r: r.errors_m, "position error (m)"),
    "attitude": (lambda r: r.errors_deg, "attitude error (deg)"),
    **{axis: (_component(k), f"{axis} (m)") for k, axis in enumerate("xyz")},
}
