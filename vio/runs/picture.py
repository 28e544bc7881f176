"""Plots of a run, drawn with matplotlib without its global state."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vio.evaluation.trajectories import Evaluation
from vio.records import STAGES
from vio.geometry.lie import FloatArray, transform_points
from vio.runs.pipeline import RunResult
from vio.files.printable import printable
from vio.records import RIGHT_TERMS
from vio.geometry.upright import attitude_deg, up_of, upright_axes

log = logging.getLogger(__name__)

_ESTIMATE, _REFERENCE, _DEAD_RECKONING, _LANDMARKS = "#1f5fbf", "#111111", "#d9822b", "#9aa5b1"
_STAGE_COLOURS = ("#c9d1d9", "#6aa2d8", "#b7a2d8", "#e8b04b", "#1f5fbf")
_MOVED_SIGMAS = 3.0  # a stereo calibration that ends within so many standard deviations of zero is not drawn
_STANDS_M = 2.0  # extent of a path below which the landmarks set the limits of the map
_SIGMAS = 3.0  # half width of the bands
# Of the panels, as shares of the figure and of a panel. A layout that matplotlib finds by itself draws all twice.
_MARGINS = {"left": 0.06, "right": 0.985, "bottom": 0.06, "top": 0.925, "wspace": 0.18, "hspace": 0.26}


def plot_run(path: Path, result: RunResult, evaluation: Evaluation | None, dead_reckoning: Evaluation | None) -> None:
    """Plot the map from above, and height, attitude, errors, feature counts and times over the frames; write a PNG.

    A picture that cannot be drawn or written gives a warning: it must not cost the results of the run.

    Args:
        path: the PNG to write.
        result: the run.
        evaluation: the trajectory against the reference; None without one.
        dead_reckoning: dead reckoning against the reference; None without one.
    """
    write_picture(path, lambda: _figure(result, evaluation, dead_reckoning))


def write_picture(path: Path, draw: Callable[[], Any]) -> None:
    """Write the matplotlib figure that `draw` returns as a PNG; a failure gives a warning and leaves no file."""
    try:
        stream = io.BytesIO()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)  # another script
            draw().savefig(stream, format="png")
        path.write_bytes(stream.getvalue())
    except Exception as error:
        log.warning("%s was not drawn (%s: %s)", path.name, type(error).__name__, " ".join(str(error).split()))
        log.debug("the traceback of the picture", exc_info=True)
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def _figure(result: RunResult, evaluation: Evaluation | None, dead_reckoning: Evaluation | None) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 9), dpi=110)
    calibrated = has_calibration_panel(result)
    grid = figure.add_gridspec(6 if calibrated else 5, 2, width_ratios=(1.25, 1), **_MARGINS)
    R_view_world = _axes(result)
    _draw_map(figure.add_subplot(grid[:, 0]), R_view_world, result, evaluation, dead_reckoning)
    seconds = np.array(result.frames.column("time_ns") - result.frames[0].time_ns) * 1e-9
    _draw_error(figure.add_subplot(grid[0, 1]), seconds, result, evaluation, dead_reckoning)
    _draw_height(figure.add_subplot(grid[1, 1]), seconds, R_view_world, result, evaluation)
    _draw_attitude(figure.add_subplot(grid[2, 1]), seconds, R_view_world, result)
    _draw_counts(figure.add_subplot(grid[3, 1]), seconds, result)
    _draw_time(figure.add_subplot(grid[4, 1]), seconds, result)
    if calibrated:
        _draw_calibration(figure.add_subplot(grid[5, 1]), seconds, result)
    for axes in figure.axes[1:-1]:  # all of them have the time axis of the last one
        axes.tick_params(labelbottom=False)
        axes.set_xlabel("")
    figure.suptitle(_title(result, evaluation), fontsize=12, parse_math=False)  # a $ in a file name is no formula
    return figure


def has_calibration_panel(result: RunResult) -> bool:
    """Return whether the stereo calibration was estimated, and ended off by more than its standard deviations."""
    field = result.estimates[-1].stereo_field
    if field is None:
        return False
    sigma = np.sqrt(np.diag(field.covariance))
    return bool(np.any(np.abs(field.coefficients) > _MOVED_SIGMAS * sigma))


def _draw_calibration(axes: Any, seconds: FloatArray, result: RunResult) -> None:
    """Draw the right columns' coefficients of (R3) with a standard deviation, and how far the rows are off."""
    f = result.recording.camera.fu
    fields = [estimate.stereo_field for estimate in result.estimates]
    has = np.array([field is not None for field in fields])
    known = [field for field in fields if field is not None]
    values = f * np.array([field.coefficients[:RIGHT_TERMS] for field in known])
    sigmas = f * np.array([np.sqrt(np.diag(field.covariance)[:RIGHT_TERMS]) for field in known])
    colours = (_ESTIMATE, _DEAD_RECKONING, "#3a9d5d", "#8a5fb0")
    names = ("all columns", "along u", "with radius²", "with radius⁴")
    for k, (name, colour) in enumerate(zip(names, colours, strict=True)):
        axes.plot(seconds[has], values[:, k], color=colour, lw=1.2, label=name)
        axes.fill_between(
            seconds[has], values[:, k] - sigmas[:, k], values[:, k] + sigmas[:, k], color=colour, alpha=0.2, lw=0
        )
    axes.plot(seconds[has], [field.rows_rms_px for field in known], color=_LANDMARKS, lw=1.2, label="rows, rms")
    axes.set_title("stereo calibration is off by", fontsize=9, loc="left")
    axes.set_ylabel("px")
    axes.set_xlabel("time in the recording (s)")
    axes.set_xlim(0, max(float(seconds[-1]), 1e-3))
    axes.legend(loc="best", fontsize=8, ncols=4)
    axes.grid(alpha=0.25)


def _title(result: RunResult, evaluation: Evaluation | None) -> str:
    name = f"{printable(result.recording.path.name)}: {result.config.backend}, motion {result.motion or 'none'}"
    if evaluation is None:
        return f"{name}, no reference"
    scores = evaluation.as_dict()
    drift = scores["t_err_percent"]
    return f"{name}, ATE {scores['ate_m']:.3f} m" + ("" if drift is None else f", drift {drift:.2f} %")


def _axes(result: RunResult) -> FloatArray:
    """Return the rotation (3, 3) from the run's world to right, ahead and up at its start."""
    gravity = result.estimates[-1].gravity_world
    cam0 = result.trajectory.in_cam0(result.T_cam0_body).T_world_body
    return upright_axes(cam0, up_of(result.motion, gravity))


def _draw_map(
    axes: Any,
    R_view_world: FloatArray,
    result: RunResult,
    evaluation: Evaluation | None,
    dead_reckoning: Evaluation | None,
) -> None:
    """Draw trajectories and landmarks from above, right and ahead at the start."""
    if evaluation is None:
        T_ref_world, R_view_ref = np.eye(4), R_view_world
        curves = [("estimate", result.trajectory.in_cam0(result.T_cam0_body).positions, _ESTIMATE, "-", 1.8)]
    else:
        T_ref_world, R_view_ref = evaluation.T_ref_est, R_view_world @ evaluation.T_ref_est[:3, :3].T
        curves = [
            ("ground truth", evaluation.reference.positions, _REFERENCE, "-", 3.0),
            ("estimate", evaluation.aligned.positions, _ESTIMATE, "-", 1.6),
        ]
        if dead_reckoning is not None:
            curves.insert(1, ("dead reckoning", dead_reckoning.aligned.positions, _DEAD_RECKONING, "--", 1.2))
    origin = curves[0][1][0]

    def seen(positions: FloatArray) -> FloatArray:
        return np.asarray((positions - origin) @ R_view_ref[:2].T)

    points = seen(transform_points(T_ref_world, result.landmarks.p_world))
    low, high = _view(np.concatenate([seen(c[1]) for c in curves]), points)
    inside = np.all((points >= low) & (points <= high), axis=1)
    axes.scatter(*points[inside].T, s=1.2, c=_LANDMARKS, linewidths=0, label="landmarks", rasterized=True)
    for label, positions, colour, style, width in curves:
        axes.plot(*seen(positions).T, color=colour, ls=style, lw=width, label=label)
    axes.plot(0, 0, "o", color=_REFERENCE, ms=6, mfc="white", label="start")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title("from above", fontsize=9, loc="left")
    axes.set_xlabel("right of the start (m)")
    axes.set_ylabel("ahead of the start (m)")
    axes.legend(loc="best", fontsize=9, markerscale=1.5)
    axes.grid(alpha=0.25)


def _view(paths: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return plot limits that contain all paths (N, 2) and a margin; of a rig that stands, most landmarks (M, 2)."""
    low, high = paths.min(axis=0), paths.max(axis=0)
    if float((high - low).max()) < _STANDS_M and len(points):
        near = np.percentile(points, (10, 90), axis=0)  # without a few triangulated far off
        low, high = np.minimum(low, near[0]), np.maximum(high, near[1])
    margin = max(0.15 * float((high - low).max()), 1.0)
    return low - margin, high + margin


def _draw_height(
    axes: Any, seconds: FloatArray, R_view_world: FloatArray, result: RunResult, evaluation: Evaluation | None
) -> None:
    """Draw the height above the start with a band of three standard deviations."""
    T = result.trajectory.T_world_body
    up = R_view_world[2]
    height = (T[:, :3, 3] - T[0, :3, 3]) @ up
    # T_world_body = T_hat exp(-xi): the body's error rho moves the position by R rho.
    along = np.einsum("i,nij->nj", up, T[:, :3, :3])
    P = np.array([e.covariance[:3, :3] for e in result.estimates])
    sigma = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", along, P, along), 0.0))
    if evaluation is not None:
        truth = evaluation.reference.positions - evaluation.T_ref_est[:3, 3]
        true_up = truth @ (evaluation.T_ref_est[:3, :3] @ up) - T[0, :3, 3] @ up
        if evaluation.reference.body == result.trajectory.body:
            axes.plot(seconds[evaluation.rows], true_up, color=_REFERENCE, lw=2.0, label="ground truth")
    axes.fill_between(seconds, height - _SIGMAS * sigma, height + _SIGMAS * sigma, color=_ESTIMATE, alpha=0.2, lw=0)
    axes.plot(seconds, height, color=_ESTIMATE, lw=1.3, label="estimate, 3σ")
    spread = max(float(np.ptp(height)), 0.1)
    axes.set_ylim(height.min() - 0.5 * spread, height.max() + 0.5 * spread)
    axes.set_ylabel("height (m)")
    axes.set_xlim(0, max(float(seconds[-1]), 1e-3))
    axes.legend(loc="best", fontsize=8, ncols=2)
    axes.grid(alpha=0.25)


def _draw_attitude(axes: Any, seconds: FloatArray, R_view_world: FloatArray, result: RunResult) -> None:
    """Draw the left camera's heading, pitch and roll."""
    cam0 = result.trajectory.in_cam0(result.T_cam0_body).T_world_body
    angles = attitude_deg(R_view_world @ cam0[:, :3, :3])
    for k, (name, colour) in enumerate((("heading", _ESTIMATE), ("pitch", _DEAD_RECKONING), ("roll", "#3a9d5d"))):
        axes.plot(seconds, angles[:, k], color=colour, lw=1.2, label=name)
    axes.set_ylabel("attitude (deg)")
    axes.set_xlim(0, max(float(seconds[-1]), 1e-3))
    axes.legend(loc="best", fontsize=8, ncols=3)
    axes.grid(alpha=0.25)


def _draw_error(
    axes: Any,
    seconds: FloatArray,
    result: RunResult,
    evaluation: Evaluation | None,
    dead_reckoning: Evaluation | None,
) -> None:
    axes.grid(alpha=0.25)
    axes.set_xlim(0, max(float(seconds[-1]), 1e-3))
    if evaluation is None:
        sigma = np.sqrt([np.trace(e.covariance[:3, :3]) for e in result.estimates])
        axes.plot(seconds, sigma, color=_ESTIMATE, lw=1.2)
        axes.set_ylabel("position σ (m)")
        axes.set_title("no reference: the filter's own uncertainty", fontsize=9, loc="left")
        return
    axes.plot(seconds[evaluation.rows], evaluation.errors_m, color=_ESTIMATE, lw=1.4, label="estimate")
    if dead_reckoning is not None:
        axes.plot(seconds[dead_reckoning.rows], dead_reckoning.errors_m, "--", color=_DEAD_RECKONING, lw=1.1)
    axes.set_ylabel("position error (m)")
    axes.set_ylim(bottom=0)


def _binned(seconds: FloatArray, values: FloatArray, bins: int = 250) -> tuple[FloatArray, FloatArray]:
    """Return medians over equal groups of frames, so that a thousand frames remain a readable curve."""
    groups = np.array_split(np.arange(len(seconds)), min(bins, len(seconds)))
    return np.array([seconds[g].mean() for g in groups]), np.array([np.median(values[g]) for g in groups])


def _draw_counts(axes: Any, seconds: FloatArray, result: RunResult) -> None:
    for name, colour in (("matched", _LANDMARKS), ("selected", _DEAD_RECKONING), ("used", _ESTIMATE)):
        counts = np.array([getattr(f, name) for f in result.frames])
        axes.plot(*_binned(seconds, counts), color=colour, lw=1.2, label=name)
    axes.set_ylabel("features")
    axes.set_ylim(bottom=0)
    axes.set_xlim(0, max(float(seconds[-1]), 1e-3))
    axes.legend(loc="best", fontsize=8, ncols=3)
    axes.grid(alpha=0.25)


def _draw_time(axes: Any, seconds: FloatArray, result: RunResult) -> None:
    values = []
    for stage in STAGES:
        times, medians = _binned(seconds, np.array([getattr(f, f"{stage}_ms") for f in result.frames]))
        values.append(medians)
    axes.stackplot(times, values, labels=STAGES, colors=_STAGE_COLOURS, linewidth=0)
    axes.set_ylabel("time (ms)")
    axes.set_xlabel("time in the recording (s)")
    axes.set_xlim(0, max(float(seconds[-1]), 1e-3))
    total = np.sum(values, axis=0)
    axes.set_ylim(0, max(1.2 * float(np.percentile(total, 98)), 1.0))
    axes.legend(loc="upper right", fontsize=8, ncols=5)
    axes.grid(alpha=0.25)
