"""The figures of a map: errors in it, its loops against ground truth, and how soon a place is found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.bench.figures import pose_nees
from vio.errors import EvaluationError
from vio.evaluation.trajectories import Evaluation, evaluate
from vio.geometry.lie import FloatArray, se3_inverse, so3_log
from vio.mapping.map_store import MapStore
from vio.records import NS_PER_S, IntArray, Trajectory
from vio.runs.mapped import MappedRun
from vio.runs.pipeline import RunResult

# A keyframe is at a place seen before where a keyframe of an earlier visit is so near and looks the same way.
_REVISIT_M, _REVISIT_DEG, _REVISIT_NS = 3.0, 30.0, 10 * NS_PER_S
_FALSE_M, _FALSE_DEG = 0.5, 5.0  # error of a loop's motion from which it is false


@dataclass(frozen=True, slots=True)
class LoopScore:
    """The loops of a map against the true poses of its keyframes."""

    loops: int  # kept
    false: int
    error_m: float | None  # median over the loops
    recall: float | None  # share of the keyframes at a place seen before of which a loop was kept; None: there is none


def map_figures(result: RunResult, truth: Evaluation, reference: Trajectory, store: Path | None) -> dict[str, Any]:
    """Return the figures of a run with a map by name; those that are undefined are left out.

    Args:
        result: of the run.
        truth: its odometry against the reference.
        reference: ground truth.
        store: the map that the run built; None: it was localised in one of another session.

    Raises:
        VioError: the poses in the map cannot be compared, or the map's file is damaged.
    """
    mapped = result.mapped
    assert mapped is not None
    final = replace(result.trajectory, T_world_body=mapped.T_map_body)
    frames = np.array(result.estimates.column("index"))
    figures: dict[str, Any] = {
        "map_ate_m": evaluate(final, reference, T_cam0_imu=result.T_cam0_body).ate_m.rmse,
        "placed": len(mapped.causal) / len(frames),
    }
    figures |= _causal_figures(result, mapped, reference)
    if store is not None:
        T_true = truth.reference.in_imu(result.T_cam0_body).T_world_body
        score = loop_score(store, frames[truth.rows], T_true, result.T_cam0_body)
        figures |= {"loops": score.loops, "loops_false": score.false}
        figures |= {"loop_error_m": score.error_m, "loop_recall": score.recall}
    return {name: value for name, value in figures.items() if value is not None}


def _causal_figures(result: RunResult, mapped: MappedRun, reference: Trajectory) -> dict[str, float]:
    """Return when the first place was known, and the error and NEES of the poses in the map as known at the time."""
    causal = mapped.causal
    if not len(causal):
        return {}
    times_ns = np.array(causal["time_ns"])
    T, P = np.array(causal["T_map_body"]), np.array(causal["covariance"])
    began_ns = int(np.asarray(result.estimates.column("time_ns"))[0])
    figures = {"place_s": (int(times_ns[0]) - began_ns) / NS_PER_S}
    try:
        score = evaluate(Trajectory(T, times_ns, result.body), reference, T_cam0_imu=result.T_cam0_body)
    except EvaluationError:  # known for too short a time
        return figures
    figures["map_causal_ate_m"] = score.ate_m.rmse
    known = np.isfinite(P[score.rows]).all(axis=(1, 2))
    part = replace(score, rows=score.rows[known], reference=_rows(score.reference, known))
    values = pose_nees(part, T, P, result.T_cam0_body, upright=False) if known.any() else None
    if values is None:
        return figures
    quantiles = {f"map_nees_{q}": float(np.percentile(values, q)) for q in (50, 95)}
    return {**figures, "map_nees": float(values.mean()), **quantiles}


def _rows(trajectory: Trajectory, chosen: Any) -> Trajectory:
    times_ns, indices = trajectory.times_ns, trajectory.frame_indices
    return replace(
        trajectory,
        T_world_body=trajectory.T_world_body[chosen],
        times_ns=None if times_ns is None else times_ns[chosen],
        frame_indices=None if indices is None else indices[chosen],
    )


def loop_score(store: Path, frames: IntArray, T_world_body: FloatArray, T_cam0_body: FloatArray) -> LoopScore:
    """Score the loops of a map of one session.

    Args:
        store: the map's file.
        frames: (M,) numbers of the frames with a true pose.
        T_world_body: (M, 4, 4) these poses.
        T_cam0_body: (4, 4) extrinsics.

    Raises:
        DataError: the file is damaged.
    """
    held = MapStore(store, read_only=True)
    try:
        keyframes, loops = held.keyframes(), [loop for loop in held.loops() if loop.kept]
    finally:
        held.close()
    T_world_cam = dict(zip(frames.tolist(), T_world_body @ se3_inverse(T_cam0_body), strict=True))
    true = {k: T_world_cam[row.frame] for k, row in enumerate(keyframes) if row.frame in T_world_cam}
    errors = []
    for loop in loops:
        if loop.first in true and loop.second in true:
            E = se3_inverse(loop.pose.T_i_j) @ se3_inverse(true[loop.first]) @ true[loop.second]
            errors.append((float(np.linalg.norm(E[:3, 3])), float(np.degrees(np.linalg.norm(so3_log(E[:3, :3]))))))
    false = sum(metres > _FALSE_M or degrees > _FALSE_DEG for metres, degrees in errors)
    times_ns = np.array([row.time_ns for row in keyframes], dtype=np.int64)
    revisits = _revisits(true, times_ns)
    found = {loop.second for loop in loops}
    return LoopScore(
        loops=len(loops),
        false=false,
        error_m=float(np.median([metres for metres, _ in errors])) if errors else None,
        recall=len(revisits & found) / len(revisits) if revisits else None,
    )


def _revisits(T_world_cam: dict[int, FloatArray], times_ns: IntArray) -> set[int]:
    """Return the keyframes at a place that an earlier one has seen, by number."""
    numbers = sorted(T_world_cam)
    T = np.array([T_world_cam[k] for k in numbers]).reshape(-1, 4, 4)
    out = set[int]()
    for row, k in enumerate(numbers):
        before = T[:row][times_ns[numbers[:row]] <= times_ns[k] - _REVISIT_NS]
        near = np.linalg.norm(before[:, :3, 3] - T[row, :3, 3], axis=1) <= _REVISIT_M
        along = before[:, :3, 2] @ T[row, :3, 2] >= np.cos(np.radians(_REVISIT_DEG))
        if (near & along).any():
            out.add(k)
    return out
