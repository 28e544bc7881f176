"""Bundle adjustment over a saved run's keyframes, and alignment of its other frames to the result."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vio.config import Config, merge
from vio.errors import ConfigError, EvaluationError
from vio.evaluation.trajectories import evaluate
from vio.files.inputs import read_input
from vio.files.yaml_text import MOST_BYTES, read_yaml
from vio.offline.colmap.adjustment import Adjustment, PositionPriors, adjust
from vio.offline.keyframes import choose_keyframes
from vio.offline.loop_tracks import loop_pairs
from vio.offline.points import build_tracks, landmarks_of
from vio.offline.poses import fill_between, position_covariances, position_difference_m
from vio.offline.saved_run import SavedRun
from vio.records import IntArray, Landmarks, Trajectory
from vio.runs.pipeline import run as process

log = logging.getLogger(__name__)

STEPS = 4  # that `progress` counts
_MOST_SIGMAS = 3.0  # by which refined poses and the run's may differ


@dataclass(frozen=True, slots=True)
class Refinement:
    """A run after bundle adjustment."""

    trajectory: Trajectory  # of the left camera, every frame of the run
    landmarks: Landmarks
    adjustment: Adjustment
    keyframes: IntArray  # (K,) rows of the trajectory
    loops: int  # whose matches took part
    aligned: int  # frames between keyframes that were aligned to the refined points
    with_priors: bool
    moved_rms_m: float  # RMS displacement from the run, or from its poses in the map, after SE(3) alignment
    ate_before_m: float | None  # against the reference in the recording; None without one
    ate_m: float | None  # likewise, after refinement


def refine_run(
    run: SavedRun, *, most: int | None, priors: bool, threads: int, progress: Callable[[int], None]
) -> Refinement:
    """Bundle-adjust the keyframes of a run under its stereo rig, and align the other frames to the refined points.

    The features that agree with the loops of a run with a map are points across the loop, and the poses to begin with
    are those in the map.

    Args:
        run: the run.
        most: largest number of keyframes; None: as many as needed.
        priors: use the filter's camera positions and covariances as priors, if the filter reproduces the run.
        threads: of the solver; one makes the result repeatable.
        progress: called with the number of steps done.

    Raises:
        ConfigError: priors were asked for of a run that closed loops.
        VioError: the run has too few views or no consistent track, or the solver failed.
    """
    path = run.tracked
    if priors and path.loops:
        raise ConfigError(f"{path.where}: its loops moved the poses away from the filter's; leave --priors out")
    keyframes = choose_keyframes(path, most=most)
    T_world_cam0 = path.trajectory.T_world_body[keyframes]
    tracks = build_tracks(path, keyframes, T_world_cam0)
    held = _priors(run, keyframes) if priors else None
    progress(1)
    rounds = iter((2, 3))
    done = adjust(
        path.camera, T_world_cam0, tracks, priors=held, threads=threads, progress=lambda: progress(next(rounds))
    )
    poses, aligned = fill_between(path, keyframes, done.T_world_cam0, done.tracks)
    progress(STEPS)
    refined = replace(path.trajectory, T_world_body=poses)
    before, after = _scores(run, refined)
    moved_rms_m = position_difference_m(path.trajectory, refined)
    if path.sigmas is not None:
        sigma_m = float(np.sqrt(np.mean(path.sigmas[:, 0] ** 2)))
        if moved_rms_m > _MOST_SIGMAS * sigma_m:
            log.warning(
                "the refined poses are %.2g m (rms) from the run's, %.1f times its standard deviation of %.2g m: "
                "images that show little do not hold poses alone, as an IMU does; compare both before you use them",
                moved_rms_m,
                moved_rms_m / sigma_m,
                sigma_m,
            )
    return Refinement(
        trajectory=refined,
        landmarks=landmarks_of(path.camera, done.T_world_cam0, done.tracks, done.sigma_px),
        adjustment=done,
        keyframes=keyframes,
        loops=len(loop_pairs(path.loops, path.frames[keyframes])),
        aligned=aligned,
        with_priors=held is not None,
        moved_rms_m=moved_rms_m,
        ate_before_m=before,
        ate_m=after,
    )


def _scores(run: SavedRun, refined: Trajectory) -> tuple[float | None, float | None]:
    """Return ATE before and after, against the reference in the recording; None without one."""
    truth = run.truth
    if truth is None:
        return None, None
    try:
        before, after = (
            float(evaluate(t, truth.trajectory, T_cam0_imu=truth.T_cam0_imu).as_dict()["ate_m"])
            for t in (run.tracked.trajectory, refined)
        )
    except EvaluationError as error:
        log.warning("the reference was not used: %s", error)
        return None, None
    return before, after


def _priors(run: SavedRun, keyframes: IntArray) -> PositionPriors | None:
    """Replay the filter on its saved observations for the poses' covariances; None if it does not reproduce the run."""
    where, frames = run.tracked.where, run.tracked.frames
    replayed = process(
        run.dataset, _estimator_settings(where / "config.yaml"), start=int(frames[0]), stop=int(frames[-1]) + 1
    )
    poses = replayed.trajectory.in_cam0(replayed.T_cam0_body).T_world_body
    if len(poses) != len(frames) or np.abs(poses - run.tracked.trajectory.T_world_body).max() > 1e-6:
        log.warning("the filter does not reproduce %s (other version or settings); refining without priors", where)
        return None
    chosen = [replayed.estimates[int(k)] for k in keyframes]
    return PositionPriors(poses[keyframes, :3, 3], position_covariances(chosen, run.T_cam0_imu))


def _estimator_settings(path: Path) -> Config:
    """Return the settings of a run without those of front end and reader, which the replay does not need."""
    try:
        values = read_yaml(read_input(path, MOST_BYTES).decode("utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {path} ({error}); repeat the run") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds no settings; repeat the run")
    kept = {key: value for key, value in values.items() if key not in ("frontend", "dataset")}
    return merge(Config(), kept, where=str(path))
