"""What a report draws of a run, in an upright frame: right, ahead and up at the run's start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vio.evaluation.trajectories import align_poses, settle_rotation
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, transform_points
from vio.geometry.upright import attitude_deg, up_of, upright_axes
from vio.runs.finished import FinishedRun

_MOST = 3000  # samples of a curve; more are not seen on a screen
_MOST_POINTS = 6000


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
    loops: FloatArray  # (L, 2, 3) from a frame to the keyframe of this run that it sees again; those that were kept


@dataclass(frozen=True, slots=True)
class Curves:
    """A run at N of its frames."""

    seconds: FloatArray  # (N,) since the first frame
    position: FloatArray  # (N, 3) right, ahead, up, metres
    position_sigma: FloatArray  # (N, 3)
    attitude: (
        FloatArray  # (N, 3) heading (to the right), pitch (up), roll (right side down) of the left camera, degrees
    )
    attitude_sigma: FloatArray  # (N, 3)
    velocity: FloatArray  # (N, 3) right, ahead, up, m/s; NaN where the filter has none
    velocity_sigma: FloatArray  # (N, 3)
    points: FloatArray  # (M, 3) landmarks
    dead_reckoning: FloatArray | None  # (K, 3)
    truth: Truth | None
    mapped: Mapped | None  # None: the run had no map
    draws_truth: bool  # whether it is the first of its recording, whose truth is drawn once


def curves_of(runs: Sequence[FinishedRun]) -> list[Curves]:
    """Return the curves of runs; those of one recording with a reference share its frame, and lie upon one another."""
    views: dict[str, FloatArray] = {}  # by recording
    curves = []
    for run in runs:
        source = str(run.metrics.get("source"))
        first = source not in views
        if first and run.evaluation is not None:
            views[source] = _view_of_reference(run)
        curves.append(_curves(run, views.get(source), first))
    return curves


def _view_of_reference(run: FinishedRun) -> FloatArray:
    """Return the transform (4, 4) from the reference's world to the upright frame of a run that has one."""
    assert run.evaluation is not None
    R = _axes(run) @ run.evaluation.T_ref_est[:3, :3].T
    return se3_from_parts(R, -R @ _reference_body(run)[0, :3, 3])


def _reference_body(run: FinishedRun) -> FloatArray:
    """Return the reference's poses (M, 4, 4) of the body that the run describes."""
    assert run.evaluation is not None
    reference, T_cam0_imu = run.evaluation.reference, run.T_cam0_body
    own = reference.in_imu(T_cam0_imu) if run.trajectory.body == "imu" else reference.in_cam0(T_cam0_imu)
    return own.T_world_body


def _axes(run: FinishedRun) -> FloatArray:
    cam0 = run.trajectory.in_cam0(run.T_cam0_body).T_world_body
    return upright_axes(cam0, up_of(run.metrics.get("motion"), np.array(run.estimates["gravity_world"][-1])))


def _curves(run: FinishedRun, view_ref: FloatArray | None, first: bool) -> Curves:
    if run.evaluation is not None and view_ref is not None:
        T_view_world = view_ref @ run.evaluation.T_ref_est
    else:
        R = _axes(run)
        T_view_world = se3_from_parts(R, -R @ run.trajectory.positions[0])
    rows = thinned(len(run.estimates))
    estimates = run.estimates[rows]
    R_view_world = T_view_world[:3, :3]
    R_view_body = R_view_world @ estimates["T_world_imu"][:, :3, :3]
    position_P, rotation_P = (R_view_body @ estimates["covariance"][:, k : k + 3, k : k + 3] for k in (0, 3))
    position_P, rotation_P = (P @ np.swapaxes(R_view_body, 1, 2) for P in (position_P, rotation_P))
    R_view_cam0 = R_view_body @ run.T_cam0_body[:3, :3].T if run.trajectory.body == "imu" else R_view_body
    velocity_P = R_view_world @ estimates["velocity_covariance"] @ R_view_world.T
    reckoned = run.dead_reckoning
    points = run.points[_chosen_points(run)]
    return Curves(
        seconds=run.seconds[rows],
        position=transform_points(T_view_world, estimates["T_world_imu"][:, :3, 3]),
        position_sigma=_sigmas(position_P),
        attitude=attitude_deg(R_view_cam0),
        attitude_sigma=_attitude_sigma(R_view_cam0, rotation_P),
        velocity=estimates["velocity_world"] @ R_view_world.T,
        velocity_sigma=_sigmas(velocity_P),
        points=transform_points(T_view_world, points),
        dead_reckoning=None
        if reckoned is None
        else transform_points(T_view_world, reckoned.positions[thinned(len(reckoned))]),
        truth=None if run.evaluation is None or view_ref is None else _truth(run, view_ref),
        mapped=_mapped(run, T_view_world, view_ref),
        draws_truth=first,
    )


def _mapped(run: FinishedRun, T_view_world: FloatArray, view_ref: FloatArray | None) -> Mapped | None:
    """Return a run in its map: aligned with the reference as the run itself is, else so that the first poses agree."""
    if run.mapped is None:
        return None
    T = run.mapped.T_world_body
    T_view_map = T_view_world @ run.trajectory.T_world_body[0] @ se3_inverse(T[0])
    if run.evaluation is not None and view_ref is not None:
        found = run.evaluation
        truth = _reference_body(run)
        alignment = settle_rotation(align_poses(T[found.rows], truth, "se3"), T[found.rows], truth)
        T_view_map = view_ref @ se3_from_parts(alignment.R, alignment.t)
    place = {int(index): row for row, index in enumerate(run.estimates["index"])}
    ends = [(loop.frame, loop.keyframe_frame) for loop in run.loops if loop.kept]
    rows = [(place[a], place[b]) for a, b in ends if a in place and b is not None and b in place]
    p: FloatArray = transform_points(T_view_map, T[:, :3, 3])
    return Mapped(
        position=p[thinned(len(p))],
        keyframes=transform_points(T_view_map, run.map_keyframes.T_map_body[:, :3, 3]),
        loops=p[np.array(rows, dtype=np.int64).reshape(-1, 2)],
    )


def _truth(run: FinishedRun, view_ref: FloatArray) -> Truth:
    evaluation = run.evaluation
    assert evaluation is not None
    rows = thinned(len(evaluation.rows))
    cam0 = view_ref @ evaluation.reference.in_cam0(run.T_cam0_body).T_world_body[rows]
    return Truth(
        seconds=run.seconds[evaluation.rows[rows]],
        position=(view_ref @ _reference_body(run)[rows])[:, :3, 3],
        attitude=attitude_deg(cam0[:, :3, :3]),
        error_m=evaluation.errors_m[rows],
        error_deg=evaluation.errors_deg[rows],
    )


def _attitude_sigma(R_view_cam0: FloatArray, P: FloatArray) -> FloatArray:
    """Return the standard deviations (N, 3) of rotations about the vertical, the camera's right and its optical axis.

    Args:
        R_view_cam0: attitudes (N, 3, 3).
        P: covariance (N, 3, 3) of rotations in the upright frame, rad^2.
    """
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), R_view_cam0[:, :, 0].shape)
    axes = np.stack([up, R_view_cam0[:, :, 0], R_view_cam0[:, :, 2]], axis=1)  # (N, axis, 3)
    return np.degrees(np.sqrt(np.maximum(np.einsum("nai,nij,naj->na", axes, P, axes), 0.0)))


def _sigmas(P: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0.0))


def thinned(count: int, most: int = _MOST) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return at most `most` row numbers of `count`, evenly spread, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _chosen_points(run: FinishedRun) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the row numbers of the landmarks to draw: the most certain ones, relative to their distance."""
    if len(run.points) <= _MOST_POINTS:
        return np.arange(len(run.points))
    return np.sort(np.argsort(run.point_sigmas, kind="stable")[:_MOST_POINTS])
