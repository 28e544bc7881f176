"""The figures of one trajectory against its reference, as the tables of a bench show them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from vio.errors import EvaluationError
from vio.evaluation.association import associate_times
from vio.evaluation.consistency import nees
from vio.evaluation.trajectories import Evaluation
from vio.geometry.lie import FloatArray, se3_inverse, se3_log
from vio.geometry.upright import yaw_and_position
from vio.numerics.kinds import Capacity, Tolerance
from vio.records import NS_PER_S, BoolArray, IntArray, Trajectory

_OF_REFERENCE = (
    "ate_sim3_m",
    "scale_error_percent",
    "rpe_m",
    "drift_percent",
    "drift_deg_per_100m",
    "nees",
)
_OF_LOOPS = ("loops", "loops_false", "loop_error_m", "loop_recall")
_OF_PLACES = ("placed", "place_s", "map_causal_ate_m", "map_nees", "map_nees_50", "map_nees_95")
_OF_COVERS = ("again_s", "placed_again")
_OF_MAPS = ("map_ate_m", "placed_wrong", *_OF_LOOPS, *_OF_PLACES, *_OF_COVERS)
_CURVE: Capacity[int] = 240  # points of the error over time that are kept; a report shows no more
_QUANTILES = (0, 5, 25, 50, 75, 95, 100)
_FRAME_NS = 10_000_000  # a pose within 10 ms of a frame is that frame's, as in `vio eval`
# Condition of a pose covariance below which it is inverted: the first frames of a run know their
# pose exactly.
_MAX_CONDITION: Tolerance[float] = 1e14


def figures_of(evaluation: Evaluation, *, positions_only: bool) -> dict[str, Any]:
    """Return the figures of an evaluation by name; None where they are undefined.

    With `positions_only` the reference has no orientations, and all that needs them is None.
    """
    scores = evaluation.as_dict()
    truth_m = evaluation.reference_path_length_m
    scale_free = evaluation.scale_free
    rpe, kitti = (None, None) if positions_only else (evaluation.rpe, evaluation.kitti)
    return {
        "ate_m": scores["ate_m"],
        "ate_max_m": evaluation.ate_m.max,
        "ate_sim3_m": None if scale_free is None else scale_free.ate_m,
        "scale_error_percent": None if scale_free is None else 100 * abs(scale_free.scale - 1),
        "ate_deg": None if positions_only else scores["ate_deg"],
        "rpe_m": None if rpe is None else rpe.trans_rmse_m,
        "rpe_deg": None if rpe is None else rpe.rot_rmse_deg,
        "drift_percent": None if kitti is None else kitti.t_err_percent,
        "drift_deg_per_100m": None if kitti is None else kitti.r_err_deg_per_100m,
        "length_ratio": None if not truth_m > 0 else evaluation.matched_path_length_m / truth_m,
        "matched": evaluation.matched,
        "reference_m": truth_m,
    }


def coverage(frame_times_ns: IntArray, trajectory: Trajectory) -> float:
    """Return the share of frames (F,) that have a pose."""
    if trajectory.times_ns is None:
        return min(len(trajectory) / len(frame_times_ns), 1.0)
    rows, _ = associate_times(frame_times_ns, trajectory.times_ns, max_difference_ns=_FRAME_NS)
    return len(rows) / len(frame_times_ns)


def pose_nees(
    evaluation: Evaluation,
    T_world_imu: FloatArray,
    covariances: FloatArray,
    T_cam0_imu: FloatArray,
    *,
    upright: BoolArray | bool,
    T_world_true: FloatArray | None = None,
) -> FloatArray | None:
    """Return the NEES (M,) of the poses, 6 in the mean for a consistent filter; None: no covariance
    can be inverted.

    The world frames are identified at the first matched pose: all of it where the filter's world is
    that of its first frame, position and yaw where both worlds are upright, as the first
    inclination is then estimated like any other.

    Args:
        evaluation: which poses match which of the reference.
        T_world_imu: (N, 4, 4) all estimated poses.
        covariances: (N, 6, 6) of xi in T_imu_world = exp(xi) T_imu_world_hat.
        T_cam0_imu: (4, 4) extrinsics.
        upright: (N,) or one for all, whether both worlds have z up; where that ends, they are
            identified anew.
        T_world_true: (4, 4) of the reference's world in the filter's; None: as said above.
    """
    truth = evaluation.reference.in_imu(T_cam0_imu).T_world_body
    T = T_world_imu[evaluation.rows]
    P = covariances[evaluation.rows]
    upright = np.broadcast_to(upright, len(T_world_imu))[evaluation.rows]
    errors = np.empty((len(T), 6))
    for rows in (np.flatnonzero(upright), np.flatnonzero(~upright)):
        if len(rows):
            a = T[rows[0]]
            b = truth[rows[0]]
            if upright[rows[0]]:
                first = yaw_and_position(a, b)
            else:
                first = a @ se3_inverse(b)
            world = first if T_world_true is None else T_world_true
            errors[rows] = se3_log(se3_inverse(world @ truth[rows]) @ T[rows])
    invertible = np.linalg.cond(P) < _MAX_CONDITION
    if not invertible.any():
        return None
    try:
        return nees(errors[invertible], P[invertible])
    except EvaluationError:
        return None


def nees_figures(values: FloatArray, name: str) -> dict[str, float]:
    """Return mean, median and 95 % of NEES (M,), by names that begin with `name`."""
    return {
        name: float(values.mean()),
        **{f"{name}_{q}": float(np.percentile(values, q)) for q in (50, 95)},
    }


def absent_reasons(
    figures: Mapping[str, Any], *, has_reference: bool, positions_only: bool, peer: bool
) -> dict[str, str]:
    """Return why figures are undefined, by name."""
    why = dict.fromkeys(("ate_m", *_OF_REFERENCE), "the recording has no ground truth")
    if has_reference:
        why = {
            **dict.fromkeys(
                ("ate_sim3_m", "scale_error_percent"), "the positions do not determine a scale"
            ),
            **dict.fromkeys(
                ("drift_percent", "drift_deg_per_100m"),
                "the path is shorter than the drift's lengths",
            ),
            "nees": "the ground truth is no more exact than the estimate",
        }
        if positions_only:
            why |= dict.fromkeys(
                ("rpe_m", *_OF_REFERENCE[-3:]), "the ground truth has no orientations"
            )
    why |= {
        "refused_share": "no observation was offered",
        "cpu_ms": "too few frames for a mean",
        "landmarks_m": "there are no surveyed landmarks",
        **dict.fromkeys(("innovation_px", "innovation_ratio"), "no observation was used"),
        "map_ate_m": "there was no map",
        **dict.fromkeys(_OF_LOOPS, "no map was built"),
        **dict.fromkeys(_OF_PLACES, "no place was found in a map"),
        "placed_wrong": "places are compared in the map of another session",
        **dict.fromkeys(_OF_COVERS, "nothing covered the cameras"),
    }
    if figures.get("placed_again") is not None:
        why["again_s"] = "the place was not found again"
    if figures.get("loops") is not None:
        no_loop = dict.fromkeys(("loop_error_m", *_OF_PLACES[-3:]), "there is no loop")
        why |= {**no_loop, "loop_recall": "no place was seen again"}
    if peer:
        own = ("nees", "refused_share", "cpu_ms", "memory_mib", *_OF_MAPS)
        why |= dict.fromkeys(own, "a trajectory of another system does not say")
        if figures.get("ate_m") is None:
            why |= dict.fromkeys(("ate_m", *_OF_REFERENCE), "its poses are those in a map")
    why |= dict.fromkeys(("nees_50", "nees_95"), why["nees"])
    return {name: text for name, text in why.items() if figures.get(name) is None}


def error_curve(evaluation: Evaluation, times_ns: IntArray | None) -> dict[str, list[float]]:
    """Return the position error over time and its quantiles, for plots.

    `times_ns` (N,) are those of the trajectory's poses; None: frames stand for seconds.
    """
    rows = evaluation.rows
    seconds = (
        rows.astype(float) if times_ns is None else (times_ns[rows] - times_ns[rows[0]]) / NS_PER_S
    )
    count = min(_CURVE, len(rows))
    picked = np.unique(np.linspace(0, len(rows) - 1, count).round().astype(int))
    return {
        "seconds": _rounded(seconds[picked], 3),
        "error_m": _rounded(evaluation.errors_m[picked], 6),
        "quantiles_m": _rounded(np.percentile(evaluation.errors_m, _QUANTILES), 6),
    }


def between(trajectory: Trajectory, first_ns: int, last_ns: int) -> Trajectory:
    """Return the poses within a span of time, 10 ms at each end included."""
    if trajectory.times_ns is None:
        return trajectory
    inside = (trajectory.times_ns >= first_ns - _FRAME_NS) & (
        trajectory.times_ns <= last_ns + _FRAME_NS
    )
    indices = trajectory.frame_indices
    frame_indices = None
    if indices is not None:
        frame_indices = indices[inside]
    return replace(
        trajectory,
        T_world_body=trajectory.T_world_body[inside],
        times_ns=trajectory.times_ns[inside],
        frame_indices=frame_indices,
    )


def _rounded(values: npt.ArrayLike, digits: int) -> list[float]:
    return [round(float(v), digits) for v in np.asarray(values)]
