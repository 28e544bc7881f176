"""What is drawn of a run, in an upright frame: right, ahead and up at the run's start."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vio.evaluation.alignment import align_poses, settle_rotation
from vio.evaluation.trajectories import Evaluation
from vio.files.tables import Rows
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, transform_points
from vio.geometry.upright import attitude_deg, rotated, upright_view
from vio.numerics.arrays import distinct
from vio.numerics.kinds import Capacity
from vio.records import RIGHT_TERMS, Trajectory
from vio.runs.finished import FinishedRun

SIGMAS = 3.0  # half width of the bands
COLOURS = ("#1f5fbf", "#d9822b", "#2e8b57", "#a83279", "#7a5195", "#0f8b8d", "#b5533c", "#6b7280")
STAGE_COLOURS = ("#c9d1d9", "#6aa2d8", "#b7a2d8", "#e8b04b", "#1f5fbf")
# what counts of features in a run's table are called
FEATURE_WORDS = {
    "selected": "selected",
    "matched": "with a right match",
    "used": "used",
}


def colours(count: int) -> list[str]:
    """Return the colours of so many runs, the first ones again where they run out."""
    return list(itertools.islice(itertools.cycle(COLOURS), count))


class _CurveLimits(NamedTuple):
    """How much of a curve is drawn."""

    max_samples: Capacity[int] = 3000  # samples of a curve; more are not seen on a screen
    max_points: Capacity[int] = 6000


_LIMITS = _CurveLimits()


@dataclass(frozen=True, slots=True)
class DrawnRun:
    """A run in memory or of a folder, as its curves need it."""

    estimates: Rows  # (N,) rows of `vio.runs.tables.ESTIMATE`
    T_cam0_body: FloatArray  # (4, 4)
    motion: str | None  # input
    evaluation: Evaluation | None  # against the reference, if there is one
    dead_reckoning: Trajectory | None
    points: FloatArray  # (M, 3) landmarks, world

    def view(self) -> FloatArray:
        """Return `T_view_world` (4, 4) of the run alone."""
        T = self.estimates["T_world_imu"]
        gravity = np.array(self.estimates["gravity_world"][-1])
        return upright_view(T, self.T_cam0_body, self.motion, gravity)

    def view_of_reference(self) -> FloatArray | None:
        """Return the transform (4, 4) from the reference's world to an upright frame.

        None: there is none.
        """
        if self.evaluation is None:
            return None
        R = self.view()[:3, :3] @ self.evaluation.T_ref_est[:3, :3].T
        return se3_from_parts(R, -R @ self.reference_body()[0, :3, 3])

    def reference_body(self) -> FloatArray:
        """Return the reference's poses (M, 4, 4) of the body that the run describes."""
        assert self.evaluation is not None
        return self.evaluation.reference.in_cam0(self.T_cam0_body).T_world_body @ self.T_cam0_body


@dataclass(frozen=True, slots=True)
class Truth:
    """The reference of a run, at K of its frames."""

    seconds: FloatArray  # (K,)
    position: FloatArray  # (K, 3) right, ahead, up, metres
    attitude: FloatArray  # (K, 3) heading, pitch, roll of the left camera, degrees
    error_m: FloatArray  # (K,) distance of the estimate after alignment
    error_deg: FloatArray  # (K,)


@dataclass(frozen=True, slots=True)
class Mapped:
    """A run in its map, turned so that both are upright and begin at the same place."""

    position: FloatArray  # (N, 3) right, ahead, up, metres
    keyframes: FloatArray  # (K, 3)
    # (L, 2, 3) from a frame to the keyframe of this run that it sees again; those that were kept
    loops: FloatArray


@dataclass(frozen=True, slots=True)
class Curves:
    """A run at N of its frames."""

    T_view_world: FloatArray  # (4, 4)
    seconds: FloatArray  # (N,) since the first frame
    position: FloatArray  # (N, 3) right, ahead, up, metres
    position_sigma: FloatArray  # (N, 3)
    attitude: (
        # (N, 3) heading (to the right), pitch (up), roll (right side down) of the left camera,
        # degrees
        FloatArray
    )
    attitude_sigma: FloatArray  # (N, 3)
    velocity: FloatArray  # (N, 3) right, ahead, up, m/s; NaN where the filter has none
    velocity_sigma: FloatArray  # (N, 3)
    points: FloatArray  # (M, 3) landmarks
    dead_reckoning: FloatArray | None  # (K, 3)
    truth: Truth | None
    mapped: Mapped | None = None  # None: the run had no map
    draws_truth: bool = True  # whether it is the first of its recording, whose truth is drawn once


def curves_of(runs: Sequence[FinishedRun]) -> list[Curves]:
    """Return the curves of runs; those of one recording with a reference share its frame, and
    lie upon one another.
    """
    views: dict[str, FloatArray] = {}  # by recording
    curves = []
    for run in runs:
        source = str(run.metrics.get("source"))
        points = run.points[_chosen_points(run)]
        drawn = DrawnRun(
            run.estimates,
            run.T_cam0_body,
            run.metrics.get("motion"),
            run.evaluation,
            run.dead_reckoning,
            points,
        )
        first = source not in views
        view = drawn.view_of_reference() if first else views[source]
        if view is not None:
            views[source] = view
        found = draw(drawn, view, most=_LIMITS.max_samples)
        curves.append(
            replace(found, mapped=_mapped(run, drawn, found.T_view_world, view), draws_truth=first)
        )
    return curves


def draw(run: DrawnRun, view_ref: FloatArray | None, *, most: int | None = None) -> Curves:
    """Return the curves of one run, with at most `most` samples each (None: all).

    `view_ref` is the transform (4, 4) from its reference's world; None: its own view.
    """
    T_view_world = run.view()
    if run.evaluation is not None and view_ref is not None:
        T_view_world = view_ref @ run.evaluation.T_ref_est
    times = run.estimates["time_ns"]
    seconds = np.asarray((times - times[0]) * 1e-9, dtype=np.float64)
    rows = thinned(len(seconds), most)
    estimates = run.estimates[rows]
    R_view_world = T_view_world[:3, :3]
    R_view_body = R_view_world @ estimates["T_world_imu"][:, :3, :3]
    position_P, rotation_P = (
        rotated(R_view_body, estimates["covariance"][:, k : k + 3, k : k + 3]) for k in (0, 3)
    )
    R_view_cam0 = R_view_body @ run.T_cam0_body[:3, :3].T
    reckoned = run.dead_reckoning
    dead_reckoning = None
    if reckoned is not None:
        dead_reckoning = transform_points(
            T_view_world, reckoned.positions[thinned(len(reckoned), most)]
        )
    if run.evaluation is None or view_ref is None:
        truth = None
    else:
        truth = _truth(run, run.evaluation, view_ref, most)
    return Curves(
        T_view_world=T_view_world,
        seconds=seconds[rows],
        position=transform_points(T_view_world, estimates["T_world_imu"][:, :3, 3]),
        position_sigma=_sigmas(position_P),
        attitude=attitude_deg(R_view_cam0),
        attitude_sigma=_attitude_sigma(R_view_cam0, rotation_P),
        velocity=estimates["velocity_world"] @ R_view_world.T,
        velocity_sigma=_sigmas(rotated(R_view_world, estimates["velocity_covariance"])),
        points=transform_points(T_view_world, run.points),
        dead_reckoning=dead_reckoning,
        truth=truth,
    )


def stereo_curves(estimates: Rows, focal: float) -> tuple[FloatArray, FloatArray]:
    """Return what right columns are off by (N, 4) as (R3) has it, and standard deviations, in
    units of `focal`.
    """
    P = np.diagonal(estimates["stereo_field_covariance"], axis1=1, axis2=2)[:, :RIGHT_TERMS]
    return focal * estimates["stereo_field"][:, :RIGHT_TERMS], focal * np.sqrt(np.maximum(P, 0.0))


def binned(seconds: FloatArray, values: FloatArray, bins: int) -> tuple[FloatArray, FloatArray]:
    """Return mean times and medians over equal groups of frames, so that thousands remain a
    readable curve.
    """
    groups = np.array_split(np.arange(len(seconds)), min(bins, len(seconds)))
    return np.array([seconds[g].mean() for g in groups]), np.array(
        [np.median(values[g]) for g in groups]
    )


def _mapped(
    run: FinishedRun, drawn: DrawnRun, T_view_world: FloatArray, view_ref: FloatArray | None
) -> Mapped | None:
    """Return a run in its map: aligned with the reference as the run itself is, else so that the
    first poses agree.
    """
    if run.mapped is None:
        return None
    T = run.mapped.T_world_body
    T_view_map = T_view_world @ run.trajectory.T_world_body[0] @ se3_inverse(T[0])
    if run.evaluation is not None and view_ref is not None:
        found = run.evaluation
        truth = drawn.reference_body()
        alignment = settle_rotation(align_poses(T[found.rows], truth, "se3"), T[found.rows], truth)
        T_view_map = view_ref @ se3_from_parts(alignment.R, alignment.t)
    rows = list(_rows_of_loops(run))
    p: FloatArray = transform_points(T_view_map, T[:, :3, 3])
    return Mapped(
        position=p[thinned(len(p))],
        keyframes=transform_points(T_view_map, run.map_keyframes.T_map_body[:, :3, 3]),
        loops=p[np.array(rows, dtype=np.int64).reshape(-1, 2)],
    )


def _rows_of_loops(run: FinishedRun) -> Iterator[tuple[int, int]]:
    """Yield the rows of the two poses that each kept loop of a run connects."""
    place = {int(index): row for row, index in enumerate(run.estimates["index"])}
    for loop in run.loops:
        earlier = loop.keyframe_frame
        if loop.kept and earlier is not None and {loop.frame, earlier} <= place.keys():
            yield place[loop.frame], place[earlier]


def _truth(run: DrawnRun, evaluation: Evaluation, view_ref: FloatArray, most: int | None) -> Truth:
    rows = thinned(len(evaluation.rows), most)
    times = run.estimates["time_ns"]
    body = view_ref @ run.reference_body()[rows]
    return Truth(
        seconds=np.asarray((times[evaluation.rows[rows]] - times[0]) * 1e-9, dtype=np.float64),
        position=body[:, :3, 3],
        attitude=attitude_deg(body[:, :3, :3] @ run.T_cam0_body[:3, :3].T),
        error_m=evaluation.errors_m[rows],
        error_deg=evaluation.errors_deg[rows],
    )


def _attitude_sigma(R_view_cam0: FloatArray, P: FloatArray) -> FloatArray:
    """Return the standard deviations (N, 3) of rotations about the vertical, the camera's right and
    its optical axis.

    P (N, 3, 3) is the covariance of rotations in the upright frame, rad^2, in which the attitudes
    (N, 3, 3) are.
    """
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), R_view_cam0[:, :, 0].shape)
    axes = np.stack([up, R_view_cam0[:, :, 0], R_view_cam0[:, :, 2]], axis=1)  # (N, axis, 3)
    return np.degrees(np.sqrt(np.maximum(np.einsum("nai,nij,naj->na", axes, P, axes), 0.0)))


def _sigmas(P: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))


def thinned(
    count: int, most: int | None = _LIMITS.max_samples
) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return at most `most` row numbers of `count` (None: all), evenly spread, with the first
    and the last.
    """
    return distinct(np.linspace(0, count - 1, min(count, most or count)).round().astype(np.int64))


def _chosen_points(run: FinishedRun) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the row numbers of the landmarks to draw: the most certain ones, relative to their
    distance.
    """
    if len(run.points) <= _LIMITS.max_points:
        return np.arange(len(run.points))
    return np.sort(np.argsort(run.point_sigmas, kind="stable")[: _LIMITS.max_points])
