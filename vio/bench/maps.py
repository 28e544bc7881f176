"""The figures of a map: errors in it, its loops against ground truth, how soon a place is found,
and found again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.bench.figures import nees_figures, pose_nees
from vio.errors import EvaluationError
from vio.evaluation.errors_along_path import rotation_angle_deg
from vio.evaluation.trajectories import Evaluation, evaluate
from vio.geometry.lie import FloatArray, se3_inverse, so3_log
from vio.mapping.map_store import LoopRow, MapStore
from vio.protocols import Dataset
from vio.records import (
    NS_PER_S,
    BoolArray,
    Event,
    IntArray,
    Observations,
    Recording,
    StereoFrame,
    Trajectory,
)
from vio.runs.pipeline import RunResult


@dataclass(frozen=True, slots=True)
class _LoopRules:
    """What counts as a revisit, a false loop, and a place."""

    # A keyframe is at a place seen before where a keyframe of an earlier visit is so near and looks
    # the same way.
    revisit_m: float = 3.0
    revisit_deg: float = 30.0
    false_m: float = 0.5  # error of a loop's motion, or of a place, from which it is false
    false_deg: float = 5.0
    # stated standard deviation of a position beyond which a frame is not localised
    placed_m: float = 1.0


_LOOPS = _LoopRules()
_REVISIT_NS = 10 * NS_PER_S


@dataclass(frozen=True, slots=True)
class Covered:
    """A recording whose cameras are covered for a while: black images, and a motion sensor that
    goes on.
    """

    source: Dataset
    spans: tuple[tuple[int, int], ...]  # first frame, and the one after the last

    @property
    def recording(self) -> Recording:
        """That of the source."""
        return self.source.recording

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        """Yield the events of some frames."""
        for event in self.source.events(start, stop, images=images):
            if isinstance(event, StereoFrame) and any(
                first <= event.index < end for first, end in self.spans
            ):
                left, right = (
                    None if image is None else np.zeros_like(image)
                    for image in (event.left, event.right)
                )
                event = replace(event, left=left, right=right)
            yield event

    def observations(self, index: int) -> Observations | None:
        """Return nothing: it is images that are covered."""
        return None


def map_figures(
    result: RunResult,
    truth: Evaluation,
    reference: Trajectory,
    *,
    store: Path | None,
    T_ref_map: FloatArray | None,
    covered: Sequence[tuple[int, int]],
) -> dict[str, Any]:
    """Return the figures of a run with a map by name; those that are undefined are left out.

    Args:
        result: of the run.
        truth: its odometry against the reference.
        reference: ground truth.
        store: the map that the run built; None: it was localised in one of another session.
        T_ref_map: (4, 4) world of the reference from the map of another session; None: not known.
        covered: first frame, and the one after the last, of each time that the cameras were
            covered.

    Raises:
        VioError: the poses in the map cannot be compared, or the map's file is damaged.
    """
    mapped = result.mapped
    assert mapped is not None
    final = replace(result.trajectory, T_world_body=mapped.T_map_body)
    figures: dict[str, Any] = {
        "map_ate_m": evaluate(final, reference, T_cam0_imu=result.T_cam0_body).ate_m.rmse
    }
    P_position = mapped.causal["covariance"][:, :3, :3]
    known = np.trace(P_position, axis1=1, axis2=2) < _LOOPS.placed_m**2
    for first, end in covered:  # where the cameras show nothing, a pose is no place
        known &= (mapped.causal["index"] < first) | (mapped.causal["index"] >= end)
    placed = mapped.causal[known]
    frames, times_ns = (np.array(result.estimates.column(name)) for name in ("index", "time_ns"))
    figures |= placement_figures(frames, times_ns, np.isin(frames, placed["index"]), covered)
    causal = Trajectory(np.array(placed["T_map_body"]), np.array(placed["time_ns"]), result.body)
    figures |= _causal_figures(
        causal, np.array(placed["covariance"]), reference, result.T_cam0_body, T_ref_map
    )
    if store is not None:
        if mapped.loops:  # else its poses are the odometry's
            held = mapped.in_map
            upright = result.motion == "imu"
            built = Trajectory(held.T_map_body, held.time_ns, result.body, held.frame)
            score = evaluate(built, reference, T_cam0_imu=result.T_cam0_body)
            values = pose_nees(
                score, held.T_map_body, held.covariance, result.T_cam0_body, upright=upright
            )
            figures |= {} if values is None else nees_figures(values, "map_nees")
        T_true = truth.reference.in_imu(result.T_cam0_body).T_world_body
        figures |= loop_figures(store, frames[truth.rows], T_true, result.T_cam0_body)
    return {name: value for name, value in figures.items() if value is not None}


def placement_figures(
    frames: IntArray, times_ns: IntArray, placed: BoolArray, covered: Sequence[tuple[int, int]]
) -> dict[str, float | None]:
    """Return how many frames are localised, how soon the first is, and the same after the cameras
    were covered.

    Args:
        frames: (N,) numbers of the frames with an estimate.
        times_ns: (N,) their times.
        placed: (N,) which of them are localised at the time.
        covered: first frame, and the one after the last, of each time that the cameras were
            covered.
    """
    figures: dict[str, float | None] = {"placed": float(placed.mean())}
    if placed.any():
        figures["place_s"] = float(times_ns[placed][0] - times_ns[0]) / NS_PER_S
    ends = [first for first, _ in covered[1:]] + [int(frames[-1]) + 1]
    spans = zip([end for _, end in covered], ends, strict=False)
    after = [seen for end, until in spans if (seen := (frames >= end) & (frames < until)).any()]
    if after:
        figures["placed_again"] = float(placed[np.any(after, axis=0)].mean())
        if all(placed[seen].any() for seen in after):  # of several, the longest
            figures["again_s"] = (
                max(float(times_ns[seen & placed][0] - times_ns[seen][0]) for seen in after)
                / NS_PER_S
            )
    return figures


def _causal_figures(
    causal: Trajectory,
    covariances: FloatArray,
    reference: Trajectory,
    T_cam0_body: FloatArray,
    T_ref_map: FloatArray | None,
) -> dict[str, float]:
    """Return the error of the localised poses as known at the time; in another session's map,
    NEES and false share.
    """
    try:
        score = evaluate(causal, reference, T_cam0_imu=T_cam0_body)
    except EvaluationError:  # known for too short a time
        return {}
    figures = {"map_causal_ate_m": score.ate_m.rmse}
    if T_ref_map is not None:
        T_true = score.reference.in_imu(T_cam0_body).T_world_body
        figures["placed_wrong"] = wrong_share(T_ref_map @ causal.T_world_body[score.rows], T_true)
        T = causal.T_world_body
        world = se3_inverse(T_ref_map)
        values = pose_nees(score, T, covariances, T_cam0_body, upright=False, T_world_true=world)
        figures |= {} if values is None else nees_figures(values, "map_nees")
    return figures


def wrong_share(T: FloatArray, T_true: FloatArray) -> float:
    """Return the share of poses (M, 4, 4) that are false, as a loop is."""
    E = se3_inverse(T_true) @ T
    return float(
        np.mean(
            (np.linalg.norm(E[:, :3, 3], axis=1) > _LOOPS.false_m)
            | (rotation_angle_deg(E) > _LOOPS.false_deg)
        )
    )


def loop_figures(
    store: Path, frames: IntArray, T_world_body: FloatArray, T_cam0_body: FloatArray
) -> dict[str, float | None]:
    """Return figures of the loops that a map of one session kept, against the true poses (M, 4, 4)
    of frames (M,).

    The error is the median over the loops; recall the share of the keyframes at a place seen before
    of which a loop was kept, None where there is none. Extrinsics are (4, 4).

    Raises:
        DataError: the file is damaged.
    """
    with contextlib.closing(MapStore(store, read_only=True)) as held:
        keyframes = held.keyframes()
        loops = [loop for loop in held.loops() if loop.kept]
    T_world_cam = dict(zip(frames.tolist(), T_world_body @ se3_inverse(T_cam0_body), strict=True))
    true = {
        k: T_world_cam[row.frame] for k, row in enumerate(keyframes) if row.frame in T_world_cam
    }
    errors = list(_loop_errors(loops, true))
    false = sum(map(_is_false, errors))
    times_ns = np.array([row.time_ns for row in keyframes], dtype=np.int64)
    revisits = _revisits(true, times_ns)
    found = {loop.second for loop in loops}
    return {
        "loops": len(loops),
        "loops_false": false,
        "loop_error_m": float(np.median(errors, axis=0)[0]) if errors else None,
        "loop_recall": len(revisits & found) / len(revisits) if revisits else None,
    }


def _loop_errors(
    loops: Iterable[LoopRow], T_world_cam: Mapping[int, FloatArray]
) -> Iterator[tuple[float, float]]:
    """Yield what each loop between keyframes of known poses (4, 4) is off by, in m and degrees."""
    for loop in loops:
        if loop.first in T_world_cam and loop.second in T_world_cam:
            T_i_j = se3_inverse(T_world_cam[loop.first]) @ T_world_cam[loop.second]
            E = se3_inverse(loop.pose.T_i_j) @ T_i_j
            degrees = float(np.degrees(np.linalg.norm(so3_log(E[:3, :3]))))
            yield float(np.linalg.norm(E[:3, 3])), degrees


def _is_false(error: tuple[float, float]) -> bool:
    metres, degrees = error
    return metres > _LOOPS.false_m or degrees > _LOOPS.false_deg


def _revisits(T_world_cam: dict[int, FloatArray], times_ns: IntArray) -> set[int]:
    """Return the keyframes at a place that an earlier one has seen, by number."""
    numbers = sorted(T_world_cam)
    T = np.array([T_world_cam[k] for k in numbers]).reshape(-1, 4, 4)
    out = set[int]()
    for row, k in enumerate(numbers):
        before = T[:row][times_ns[numbers[:row]] <= times_ns[k] - _REVISIT_NS]
        distance_m = np.linalg.norm(before[:, :3, 3] - T[row, :3, 3], axis=1)
        near = distance_m <= _LOOPS.revisit_m
        cosine = before[:, :3, 2] @ T[row, :3, 2]
        along = cosine >= np.cos(np.radians(_LOOPS.revisit_deg))
        if (near & along).any():
            out.add(k)
    return out
