"""The map of a run at its end: its poses adjusted with the IMU, where loops hold them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from vio.calibration.stereo_field import DisplacementField
from vio.errors import VioError
from vio.evaluation.trajectories import metres_text
from vio.geometry.lie import FloatArray, se3_adjoint, se3_inverse, se3_log
from vio.geometry.upright import yaw_and_position
from vio.mapping.map_store import MapStore
from vio.numerics.kinds import Capacity
from vio.offline.inertial_refinement import (
    InertialRefinement,
    InertialRun,
    adjust_with_imu,
    inertial_keyframes,
)
from vio.offline.keyframes import TrackedPath
from vio.offline.saved_run import closing_loops, without_field
from vio.records import IntArray, MapKeyframes, feature_tracks
from vio.runs.mapped import MappedRun, corrected
from vio.runs.pipeline import RunResult

# of the adjustment, four a second: its time and memory grow with them
MAX_KEYFRAMES: Capacity[int] = 1500
_MAX_SIGMAS = 3.0  # by which it may move the map, by the map's covariance


def adjust_map(
    result: RunResult, map_file: Path, should_stop: Callable[[], str | None] = lambda: None
) -> RunResult:
    """Return a run with the poses of its map adjusted with the IMU, and write them to the map's
    file.

    Without an IMU or loops of the run's own, and of a run that ended early, nothing changes. Where
    the adjustment does not converge or contradicts the map, the map stays as it is, and
    `MappedRun.adjustment` says so.

    Args:
        result: a run with a map and its observations.
        map_file: that map.
        should_stop: asked before each step; a reason ends the adjustment.

    Raises:
        DataError: the map's file cannot be written.
    """
    mapped = result.mapped
    if (
        mapped is None
        or result.motion != "imu"
        or result.stopped is not None
        or not closing_loops(mapped.loops)
    ):
        return result
    try:
        adjusted = _adjusted(result, mapped, should_stop)
    except VioError as error:
        return replace(result, mapped=replace(mapped, adjustment=f"not with the IMU: {error}"))
    own = adjusted.in_map.own
    T_cam = adjusted.in_map.T_map_body[own] @ se3_inverse(result.T_cam0_body)
    with contextlib.closing(MapStore(map_file)) as store:
        store.set_adjusted(dict(zip(adjusted.in_map.keyframe[own].tolist(), T_cam, strict=True)))
        store.commit()
    return replace(result, mapped=adjusted)


def _solve(
    run: InertialRun,
    keyframes: IntArray,
    covariance_of: IntArray,
    should_stop: Callable[[], str | None],
) -> InertialRefinement:
    """Return the adjusted keyframes; raise VioError with the reason why there are none."""

    def go_on() -> None:
        if (reason := should_stop()) is not None:
            raise VioError(reason)

    try:
        done = adjust_with_imu(run, keyframes, covariance_of=covariance_of, progress=go_on)
    except (RuntimeError, np.linalg.LinAlgError) as error:  # of a matrix without an inverse
        raise VioError(f"it has no optimum ({error})") from error
    if not done.best.converged:
        raise VioError("it did not converge")
    return done


def _adjusted(
    result: RunResult, mapped: MappedRun, should_stop: Callable[[], str | None]
) -> MappedRun:
    """Return the adjusted map; raise VioError with the reason why there is none."""
    began = time.perf_counter()
    in_map = mapped.in_map
    if result.observations is None or result.motion_samples is None:
        raise VioError("the run has not kept what it observed")
    if not in_map.own.all():
        raise VioError("the map has keyframes of other sessions, which it does not know")
    path = _path(result, mapped)
    T_cam0_body = result.T_cam0_body
    keyframes = inertial_keyframes(path, None)
    if len(keyframes) > MAX_KEYFRAMES:
        raise VioError(f"it would need {len(keyframes)} keyframes, {MAX_KEYFRAMES} at most")
    seen = feature_tracks(
        {o.frame_index: o for o in (result.observations[int(k)] for k in keyframes)},
        len(result.recording.frame_times_ns),
    )
    stereo_field = result.estimates[-1].stereo_field
    field = None
    path = replace(path, tracks=seen)
    if stereo_field is not None:
        field = DisplacementField.of(path.camera, stereo_field)
        path = without_field(path, field)
    # A keyframe of the map is less than a quarter of a second after one of the adjustment.
    rows = np.searchsorted(path.frames, in_map.frame)
    near, of_near = np.unique(
        np.searchsorted(keyframes, rows, side="right") - 1, return_inverse=True
    )
    run = InertialRun(
        path,
        result.estimates.rows,
        result.motion_samples,
        T_cam0_body,
        field,
        result.config.msckf,
        result.config.imu,
    )

    done = _solve(run, keyframes, near, should_stop)
    T = path.trajectory.T_world_body
    number = np.arange(len(path.frames))
    T_map_body = corrected(T, number, keyframes, done.T_world_cam0, T[keyframes]) @ T_cam0_body
    A = se3_adjoint(se3_inverse(T_map_body[rows]) @ done.T_world_cam0[near][of_near])
    P = A @ done.best.covariance[of_near] @ np.swapaxes(A, 1, 2)
    sigmas = _sigmas_moved(in_map, T_map_body[rows])
    moved_m = float(
        np.sqrt(np.mean(np.sum((T_map_body - mapped.T_map_body)[:, :3, 3] ** 2, axis=1)))
    )
    size = f"by {metres_text(moved_m)} (rms), {sigmas:.1f} of the map's standard deviations"
    if sigmas > _MAX_SIGMAS:
        raise VioError(f"it would move the map {size}: one of them is wrong")
    text = f"with the IMU at {len(keyframes)} keyframes, in {time.perf_counter() - began:.0f} s; moved {size}"
    return replace(
        mapped,
        T_map_body=T_map_body,
        in_map=replace(in_map, T_map_body=T_map_body[rows], covariance=P),
        adjustment=text,
    )


def _path(result: RunResult, mapped: MappedRun) -> TrackedPath:
    """Return the path of a run in its map, without what it observed."""
    trajectory = replace(result.trajectory, T_world_body=mapped.T_map_body).in_cam0(
        result.T_cam0_body
    )
    camera = result.recording.camera
    return TrackedPath(
        result.recording.path,
        camera,
        trajectory,
        feature_tracks({}, 0),
        closing_loops(mapped.loops),
    )


def _sigmas_moved(in_map: MapKeyframes, T_map_body: FloatArray) -> float:
    """By how many standard deviations of the map its keyframes but the first move to poses (K, 4,
    4), in the median.

    The covariance is relative to the position and the yaw of the first keyframe, as both worlds are
    upright: the adjustment may shift the whole map and turn it about the vertical.
    """
    before = in_map.T_map_body
    after = T_map_body
    xi = se3_log(se3_inverse(before[1:]) @ yaw_and_position(before[0], after[0]) @ after[1:])
    squared = np.einsum(
        "ki,ki->k", xi, np.linalg.solve(in_map.covariance[1:], xi[:, :, None])[:, :, 0]
    )
    return float(np.sqrt(np.median(squared) / 6))
