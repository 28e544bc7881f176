"""The picture of a run."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vio.evaluation.trajectories import Evaluation, metres_text
from vio.files.printable import printable
from vio.files.tables import Rows
from vio.geometry.lie import FloatArray
from vio.records import STAGES
from vio.runs.canvas import Canvas, Panel
from vio.runs.curves import SIGMAS, STAGE_COLOURS, Curves, DrawnRun, binned, draw, stereo_curves
from vio.runs.pipeline import RunResult

log = logging.getLogger(__name__)

_ESTIMATE, _REFERENCE, _DEAD_RECKONING, _LANDMARKS = "#1f5fbf", "#111111", "#d9822b", "#9aa5b1"
_GREEN, _PURPLE = "#3a9d5d", "#8a5fb0"
_MOVED_SIGMAS = 3.0  # a stereo calibration that ends within so many standard deviations of zero is not drawn
_LEAST_MARGIN_M = 0.02  # about a rig that stands
_SCALE = 1.3  # of the largest value to the end of an axis
_BINS = 250  # of the curves that are medians over frames
_WIDTH, _HEIGHT = 1430, 990  # pixels, and so the rest
_LEFT, _MIDDLE_LEFT, _MIDDLE, _RIGHT = 95, 755, 870, 1410  # of the map, and of the panels beside it
_TOP, _BOTTOM, _SPACE = 75, 930, 27


@dataclass(frozen=True, slots=True)
class RunPicture:
    """The map from above, and height, attitude, errors, feature counts and times over the frames of a run.

    It keeps copies, and so can be drawn when the files that the run grew in are gone.
    """

    run: DrawnRun
    frames: Rows  # (N,) rows of `vio.runs.tables.FRAME`
    dead_reckoning: Evaluation | None  # against the reference; None without one
    title: str
    focal: float | None  # of the panel of the stereo calibration; None: there is none

    @classmethod
    def of(cls, result: RunResult, evaluation: Evaluation | None, dead_reckoning: Evaluation | None) -> RunPicture:
        """Keep what is drawn of a run, its trajectory and dead reckoning compared with a reference (None: without)."""
        drawn = DrawnRun(
            np.array(result.estimates.rows),
            result.T_cam0_body,
            result.motion,
            evaluation,
            result.dead_reckoning,
            result.landmarks.p_world,
        )
        focal = result.recording.camera.fu if has_calibration_panel(result) else None
        return cls(drawn, np.array(result.frames.rows), dead_reckoning, _title(result, evaluation), focal)

    def write(self, path: Path) -> None:
        """Write a PNG; a picture that cannot be drawn or written gives a warning: the results do not depend on it."""
        write_picture(path, lambda: _draw(self))


def figure_png(figure: Any) -> bytes:
    """Return the PNG of a matplotlib figure."""
    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)  # another script
        figure.savefig(stream, format="png", pil_kwargs={"compress_level": 1})  # a tenth larger, sooner
    return stream.getvalue()


def write_picture(path: Path, draw: Callable[[], bytes]) -> None:
    """Write the PNG that `draw` returns; a failure gives a warning and leaves no file."""
    try:
        path.write_bytes(draw())
    except Exception as error:
        log.warning("%s was not drawn (%s: %s)", path.name, type(error).__name__, " ".join(str(error).split()))
        log.debug("the traceback of the picture", exc_info=True)
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def _draw(picture: RunPicture) -> bytes:
    """Return the PNG of a picture."""
    canvas, curves = Canvas(_WIDTH, _HEIGHT), draw(picture.run, picture.run.view_of_reference())
    canvas.text((_WIDTH / 2, 16), picture.title, 18, "ma")
    _draw_map(canvas, curves)
    count = 5 if picture.focal is None else 6
    edges = np.linspace(_TOP, _BOTTOM + _SPACE, count + 1).round().astype(int)
    seconds = (0.0, max(float(curves.seconds[-1]), 1e-3))
    panels = [Panel((_MIDDLE, int(top), _RIGHT, int(end) - _SPACE), x_limits=seconds) for top, end in pairwise(edges)]
    shown: list[dict[str, Any]] = [
        _error_curves(panels[0], curves, picture.dead_reckoning),
        _height_curves(panels[1], curves),
        _attitude_curves(panels[2], curves),
        _count_curves(panels[3], curves.seconds, picture.frames),
        _time_curves(panels[4], curves.seconds, picture.frames),
    ]
    if picture.focal is not None:
        shown.append(_calibration_curves(panels[5], curves.seconds, picture.run.estimates, picture.focal))
    shown[-1] |= {"x_label": "time in the recording (s)"}
    for panel, how in zip(panels, shown, strict=True):
        panel.draw(canvas, x_ticks=panel is panels[-1], **how)
    return canvas.png()


def has_calibration_panel(result: RunResult) -> bool:
    """Return whether the stereo calibration was estimated, and ended off by more than its standard deviations."""
    field = result.estimates[-1].stereo_field
    if field is None:
        return False
    sigma = np.sqrt(np.diag(field.covariance))
    return bool(np.any(np.abs(field.coefficients) > _MOVED_SIGMAS * sigma))


def _title(result: RunResult, evaluation: Evaluation | None) -> str:
    name = f"{printable(result.recording.path.name)}: {result.config.backend}, motion {result.motion or 'none'}"
    if evaluation is None:
        return f"{name}, no reference"
    drift = evaluation.as_dict()["t_err_percent"]
    ate = metres_text(evaluation.ate_m.rmse)
    return f"{name}, ATE {ate}" + ("" if drift is None else f", drift {drift:.2f} %")


def _draw_map(canvas: Canvas, curves: Curves) -> None:
    """Draw trajectories and landmarks from above, right and ahead at the start."""
    box = _LEFT, _TOP, _MIDDLE_LEFT, _BOTTOM
    paths = [np.zeros((1, 3)), curves.position, *([] if curves.truth is None else [curves.truth.position])]
    low, high = _view(np.concatenate(paths)[:, :2], (box[2] - box[0]) / (box[3] - box[1]))
    panel = Panel(box, (low[0], high[0]), (low[1], high[1]))
    panel.dots(curves.points[:, 0], curves.points[:, 1], _LANDMARKS, "landmarks")
    if curves.truth is not None:
        panel.line(curves.truth.position[:, 0], curves.truth.position[:, 1], _REFERENCE, 4, label="ground truth")
    if (reckoned := curves.dead_reckoning) is not None:
        panel.line(reckoned[:, 0], reckoned[:, 1], _DEAD_RECKONING, label="dead reckoning", dashed=True)
    panel.line(curves.position[:, 0], curves.position[:, 1], _ESTIMATE, 2, label="estimate")
    panel.ring(0.0, 0.0, _REFERENCE, "start")
    across, ahead = "right of the start (m)", "ahead of the start (m)"
    panel.draw(canvas, title="from above", x_label=across, y_label=ahead, legend=1)


def _view(paths: FloatArray, shape: float) -> tuple[FloatArray, FloatArray]:
    """Return limits of a panel whose width is `shape` times its height: all paths (N, 2), a margin, equal scales."""
    low, high = paths.min(axis=0), paths.max(axis=0)
    size = high - low + 2 * max(0.1 * float((high - low).max()), _LEAST_MARGIN_M)
    half = 0.5 * np.array([max(size[0], shape * size[1]), max(size[1], size[0] / shape)])
    return 0.5 * (low + high) - half, 0.5 * (low + high) + half


def _error_curves(panel: Panel, curves: Curves, dead_reckoning: Evaluation | None) -> dict[str, Any]:
    if curves.truth is None:
        panel.line(curves.seconds, np.linalg.norm(curves.position_sigma, axis=1), _ESTIMATE)
        return {"y_label": "position σ (m)", "title": "no reference: the filter's own uncertainty"}
    panel.line(curves.truth.seconds, curves.truth.error_m, _ESTIMATE)
    if dead_reckoning is not None:
        panel.line(curves.seconds[dead_reckoning.rows], dead_reckoning.errors_m, _DEAD_RECKONING, dashed=True)
    panel.y_limits = 0.0, _SCALE * max(float(curves.truth.error_m.max()), 1e-6)  # dead reckoning may leave the panel
    return {"y_label": "position error (m)"}


def _height_curves(panel: Panel, curves: Curves) -> dict[str, Any]:
    """Add the height above the start with a band of three standard deviations."""
    height, band = curves.position[:, 2], SIGMAS * curves.position_sigma[:, 2]
    if curves.truth is not None:
        panel.line(curves.truth.seconds, curves.truth.position[:, 2], _REFERENCE, 2, label="ground truth")
    panel.band(curves.seconds, height - band, height + band, _ESTIMATE, 0.2)
    panel.line(curves.seconds, height, _ESTIMATE, label="estimate, 3σ")
    spread = max(float(np.ptp(height)), 0.1)
    panel.y_limits = float(height.min()) - 0.5 * spread, float(height.max()) + 0.5 * spread
    return {"y_label": "height (m)", "legend": 2}


def _attitude_curves(panel: Panel, curves: Curves) -> dict[str, Any]:
    """Add the left camera's heading, pitch and roll."""
    for k, (name, colour) in enumerate((("heading", _ESTIMATE), ("pitch", _DEAD_RECKONING), ("roll", _GREEN))):
        panel.line(curves.seconds, curves.attitude[:, k], colour, label=name)
    return {"y_label": "attitude (deg)", "legend": 3}


def _count_curves(panel: Panel, seconds: FloatArray, frames: Rows) -> dict[str, Any]:
    most = 1.0
    for name, colour in (("matched", _LANDMARKS), ("selected", _DEAD_RECKONING), ("used", _ESTIMATE)):
        times, counts = binned(seconds, frames[name], _BINS)
        panel.line(times, counts, colour, label=name)
        most = max(most, float(counts.max()))
    panel.y_limits = 0.0, 1.05 * most
    return {"y_label": "features", "legend": 3}


def _time_curves(panel: Panel, seconds: FloatArray, frames: Rows) -> dict[str, Any]:
    times, _ = binned(seconds, seconds, _BINS)
    total = np.zeros(len(times))
    for stage, colour in zip(STAGES, STAGE_COLOURS, strict=True):
        before, total = total, total + binned(seconds, frames[f"{stage}_ms"], _BINS)[1]
        panel.band(times, before, total, colour, 1.0, stage)
    panel.y_limits = 0.0, max(2 * float(np.median(total)), 1.0)  # frames that compile leave the panel
    return {"y_label": "time (ms)", "legend": 5}


def _calibration_curves(panel: Panel, seconds: FloatArray, estimates: Rows, focal: float) -> dict[str, Any]:
    """Add the right columns' coefficients of (R3) with a standard deviation, and how far the rows are off."""
    values, sigmas = stereo_curves(estimates, focal)
    names = ("all columns", "along u", "with radius²", "with radius⁴")
    for name, colour, v, sigma in zip(
        names, (_ESTIMATE, _DEAD_RECKONING, _GREEN, _PURPLE), values.T, sigmas.T, strict=True
    ):
        panel.band(seconds, v - sigma, v + sigma, colour, 0.2)
        panel.line(seconds, v, colour, label=name)
    panel.line(seconds, estimates["stereo_rows_rms_px"], _LANDMARKS, label="rows, rms")
    return {"title": "stereo calibration is off by", "y_label": "px", "legend": 5}
