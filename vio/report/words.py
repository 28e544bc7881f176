"""A finished run in words and in a table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vio.evaluation.errors_along_path import path_length_m
from vio.evaluation.trajectories import lengths_text, metres_texts, rotation_drift_text
from vio.records import STAGES
from vio.runs.folder import refused_share

if TYPE_CHECKING:
    from vio.runs.finished import FinishedRun

_MOTION = {"imu": "an IMU", "velocity": "velocities", "none": "images alone"}


def summary(run: FinishedRun) -> list[str]:
    """Return what happened in a run, one sentence a line."""
    m = run.metrics
    span_s = float(run.seconds[-1])
    frames = len(run.estimates)
    span = m.get("last_frame", 0) - m.get("first_frame", 0) + 1
    if span > frames:
        counted = f"{frames} of {span}"
    else:
        counted = str(frames)
    source = str(m.get("source", "")).replace("\\", "/").rstrip("/").rpartition("/")[2]
    lines = [
        f"{counted} frames of {source or 'a recording'} ({m.get('kind', 'unknown kind')}), "
        f"{span_s:.1f} s and "
        f"{path_length_m(run.trajectory.positions):.1f} m, processed from "
        f"{_MOTION.get(str(m.get('motion')), 'images alone')} by {m.get('backend', 'the filter')}."
    ]
    if m.get("complete") is False:
        why = m.get("stopped")
        lines.append(f"The run is not complete{f': {why}' if why else ''}.")
    evaluation = run.evaluation
    if evaluation is None:
        sigma = np.sqrt(np.trace(run.estimates["covariance"][-1][:3, :3]))
        lines.append(
            "There is no reference. The filter's own standard deviation of the last position is "
            f"{sigma:.3g} m."
        )
    else:
        share = 100 * evaluation.ate_m.rmse / max(evaluation.reference_path_length_m, 1e-9)
        rms, most = metres_texts(evaluation.ate_m.rmse, evaluation.ate_m.max)
        lines.append(
            f"The position error is {rms} (rms after alignment, {share:.2g} % of the "
            f"path), at most {most}; the attitude error "
            f"{evaluation.ate_deg.rmse:.2g} deg."
        )
        if evaluation.kitti is not None:
            lines.append(
                f"Drift over {lengths_text(evaluation.kitti.lengths_m)} is "
                f"{evaluation.kitti.t_err_percent:.2g} % and "
                f"{rotation_drift_text(evaluation.kitti.r_err_deg_per_100m, evaluation.kitti.lengths_m, 2)}."
            )
    lines.append(_speed(run))
    nis = (
        np.nanmedian(run.frames["nis_per_dof"])
        if np.isfinite(run.frames["nis_per_dof"]).any()
        else None
    )
    if nis is not None:
        lines.append(
            f"The squared residuals of tracks are {nis:.2g} of what their noise predicts (NIS per "
            "degree of freedom, median)."
        )
    warnings = m.get("warnings") or []
    many = f"{len(warnings)} warnings or notes, below."
    return [*lines, {0: "No warnings.", 1: "One warning or note, below."}.get(len(warnings), many)]


def _speed(run: FinishedRun) -> str:
    ms = float(np.nanmedian(_work_ms(run)))
    frames = len(run.estimates)
    span_s = float(run.seconds[-1])
    if frames < 2 or span_s <= 0:
        return f"A frame took {ms:.1f} ms in the median."
    given_ms = 1e3 * span_s / (frames - 1)
    verdict = "faster than" if ms < given_ms else "slower than"
    every = f"the recording has one every {given_ms:.1f} ms, so this is {verdict} real time"
    return f"A frame took {ms:.1f} ms in the median; {every}."


def _work_ms(run: FinishedRun) -> Any:
    return np.sum(
        [run.frames[f"{stage}_ms"] for stage in STAGES if f"{stage}_ms" in run.frames], axis=0
    )


def calibration_findings(metrics: Mapping[str, Any]) -> list[str]:
    """Return what a run found its calibration to be off by, one line each."""
    lines = []
    if field := metrics.get("stereo_field"):
        text = field.get("text")
        lines += [f"Stereo pair: {text}; corrected in this run."] if text else []
        lines += [] if field.get("rig") is None else list(field["rig"]["lines"])
    imu = [f"IMU: {line}" for line in camera_imu_findings(metrics)]
    return lines + scale_findings(metrics) + imu


def scale_findings(metrics: Mapping[str, Any]) -> list[str]:
    """Return what a run found of the cameras' scale, one line each; they are near zero where it
    is right.
    """
    return [
        f"{name.replace('_', ' ')} off by {x['percent']:+.2f} ± {x['sigma_percent']:.2f} %"
        for name, x in (metrics.get("stereo_scale") or {}).items()
    ]


def camera_imu_findings(metrics: Mapping[str, Any]) -> list[str]:
    """Return by how much a run corrected pose and clock of the IMU; near zero where these are
    right.
    """
    found = metrics.get("camera_imu") or {}
    words = []
    if "rotation_deg" in found:
        for key, unit, digits in (("rotation", "deg", 2), ("translation", "mm", 1)):
            size = math.hypot(*found[f"{key}_{unit}"])
            sigma = math.hypot(*found[f"{key}_sigma_{unit}"])
            words.append(f"{key} {size:.{digits}f} ± {sigma:.{digits}f} {unit}")
    if "time_offset_ms" in found:
        offset = f"{found['time_offset_ms']:+.2f} ± {found['time_offset_sigma_ms']:.2f} ms"
        words.append(f"time offset {offset}")
    return [f"corrections of its calibration: {', '.join(words)}"] if words else []


def run_figures(run: FinishedRun) -> dict[str, str]:
    """Return a run's figures for a table, in a fixed order; a dash where there is none."""
    m = run.metrics
    evaluation = run.evaluation
    work = _work_ms(run)
    kitti = None if evaluation is None else evaluation.kitti
    ate, largest = (
        ("–", "–")
        if evaluation is None
        else metres_texts(evaluation.ate_m.rmse, evaluation.ate_m.max)
    )
    refused = refused_share(run.frames["used"], run.frames["gated"])
    innovations = m.get("innovation_ratio")
    return {
        "frames": str(len(run.estimates)),
        "path": f"{path_length_m(run.trajectory.positions):.2f} m of {run.trajectory.body}",
        "back end": f"{m.get('backend', '–')}, motion {m.get('motion', '–')}",
        "ATE": ate,
        "largest error": largest,
        "attitude error (deg)": "–" if evaluation is None else f"{evaluation.ate_deg.rmse:.3f}",
        "drift (%)": "–" if kitti is None else f"{kitti.t_err_percent:.3f}",
        "drift of rotation": "–"
        if kitti is None
        else rotation_drift_text(kitti.r_err_deg_per_100m, kitti.lengths_m),
        "features used, median": f"{np.nanmedian(run.frames['used']):.0f}",
        "observations refused (%)": "–" if refused is None else f"{100 * refused:.1f}",
        "innovations over their σ, median": "–" if innovations is None else f"{innovations:.2g}",
        "ms a frame, median": f"{np.nanmedian(work):.1f}",
        "ms a frame, 95 %": f"{np.nanpercentile(work, 95):.1f}",
        "landmarks": str(len(run.points)),
        "warnings and notes": str(len(m.get("warnings") or [])),
        "version": str(m.get("version", "–")),
    }


def smaller_is_better(run: FinishedRun) -> dict[str, float | None]:
    """Return those of a run's figures that can be compared, by their names in `run_figures`."""
    evaluation = run.evaluation
    kitti = None if evaluation is None else evaluation.kitti
    work = _work_ms(run)
    return {
        "ATE": None if evaluation is None else evaluation.ate_m.rmse,
        "largest error": None if evaluation is None else evaluation.ate_m.max,
        "attitude error (deg)": None if evaluation is None else evaluation.ate_deg.rmse,
        "drift (%)": None if kitti is None else kitti.t_err_percent,
        "drift of rotation": None if kitti is None else kitti.r_err_deg_per_100m,
        "ms a frame, median": float(np.nanmedian(work)),
        "ms a frame, 95 %": float(np.nanpercentile(work, 95)),
    }
