"""Bundle adjustment over a saved run's keyframes, and alignment of its other frames to the
result.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vio.config import Config, merge
from vio.errors import ConfigError, EvaluationError
from vio.files.inputs import read_input
from vio.files.yaml_text import MAX_BYTES, read_yaml
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, so3_hat, transform_points
from vio.geometry.stereo import StereoCamera, project, z_D_p_cam
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import robust_sigma
from vio.offline.colmap.adjustment import Adjustment, PositionPriors, adjust
from vio.offline.comparison import aligned_distance_m
from vio.offline.inertial_refinement import InertialRun, adjust_with_imu, inertial_keyframes
from vio.offline.keyframes import TrackedPath, choose_keyframes
from vio.offline.loop_tracks import loop_pairs
from vio.offline.points import MIN_DEPTH_M, PointTracks, build_tracks, landmarks_of, reprojection
from vio.offline.saved_run import SavedRun
from vio.records import BoolArray, Estimate, IntArray, Landmarks, Trajectory
from vio.runs.files import RunFile
from vio.runs.finished import read_estimates
from vio.runs.mapped import corrected
from vio.runs.pipeline import run as process

log = logging.getLogger(__name__)

STEPS = 4  # that `progress` counts
_MAX_SIGMAS = 3.0  # by which refined poses and the run's may differ


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
    with_imu: bool
    # RMS displacement from the run, or from its poses in the map, after SE(3) alignment
    moved_rms_m: float
    ate_before_m: float | None  # against the reference in the recording; None without one
    ate_m: float | None  # likewise, after refinement


def _check_choice(run: SavedRun, *, priors: bool, imu: bool) -> None:
    """Raise ConfigError where a run cannot be refined with what was asked for."""
    path = run.tracked
    if priors and path.loops:
        raise ConfigError(
            f"{path.where}: its loops moved the poses away from the filter's; leave --priors out"
        )
    has_imu = run.metrics.get("motion") == "imu" and (path.where / RunFile.ESTIMATES).is_file()
    if imu and (priors or not has_imu or run.dataset.recording.camera.is_cylinder):
        raise ConfigError(
            f"{path.where}: --imu takes a run with an IMU and a pinhole pair, and no --priors "
            "filter"
        )


def _warn_of_distance(path: TrackedPath, moved_rms_m: float) -> None:
    """Say so where the refined poses are far from the run's, beside its standard deviations."""
    if path.sigmas is None:
        return
    sigma_m = float(np.sqrt(np.mean(path.sigmas[:, 0] ** 2)))
    if moved_rms_m > _MAX_SIGMAS * sigma_m:
        log.warning(
            "the refined poses are %.2g m (rms) from the run's, %.1f times its standard "
            "deviation of %.2g m: "
            "images that show little do not hold poses alone, as an IMU does; compare both "
            "before you use them",
            moved_rms_m,
            moved_rms_m / sigma_m,
            sigma_m,
        )


def refine_run(
    run: SavedRun,
    *,
    most: int | None,
    priors: bool,
    threads: int,
    progress: Callable[[int], None],
    imu: bool = False,
) -> Refinement:
    """Bundle-adjust the keyframes of a run under its stereo rig, and take the other frames along.

    Without IMU they are aligned to the refined points; with one, they keep the odometry's motion
    between keyframes.

    The features that agree with the loops of a run with a map are points across the loop, and the
    poses to begin with are those in the map.

    Args:
        run: the run.
        most: largest number of keyframes; None: as many as needed.
        priors: use the filter's camera positions and covariances as priors, if the filter
            reproduces the run.
        threads: of the solver; one makes the result repeatable.
        progress: called with the number of steps done.
        imu: take in the IMU, and find what the rig is off by.

    Raises:
        ConfigError: priors were asked for of a run that closed loops, or the IMU of one that used
            none.
        VioError: the run has too few views or no consistent track, or the solver failed.
    """
    path = run.tracked
    _check_choice(run, priors=priors, imu=imu)
    rounds = iter((2, 3))
    held = None
    if imu:
        keyframes = inertial_keyframes(path, most)
        progress(1)
        done = _adjusted_with_imu(run, keyframes)
        progress(3)
        T = path.trajectory.T_world_body
        number = np.arange(len(path.frames))
        poses = corrected(T, number, keyframes, done.T_world_cam0, T[keyframes])
        aligned = 0
    else:
        keyframes = choose_keyframes(path, most=most)
        T_world_cam0 = path.trajectory.T_world_body[keyframes]
        tracks = build_tracks(path, keyframes, T_world_cam0)
        held = _priors(run, keyframes) if priors else None
        progress(1)
        done = adjust(
            path.camera,
            T_world_cam0,
            tracks,
            priors=held,
            threads=threads,
            progress=lambda: progress(next(rounds)),
        )
        poses, aligned = fill_between(path, keyframes, done.T_world_cam0, done.tracks)
    progress(STEPS)
    refined = replace(path.trajectory, T_world_body=poses)
    before, after = _scores(run, refined)
    moved_rms_m = aligned_distance_m(path.trajectory.T_world_body, refined.T_world_body)
    _warn_of_distance(path, moved_rms_m)
    return Refinement(
        trajectory=refined,
        landmarks=landmarks_of(path.camera, done.T_world_cam0, done.tracks, done.sigma_px),
        adjustment=done,
        keyframes=keyframes,
        loops=len(loop_pairs(path.loops, path.frames[keyframes])),
        aligned=aligned,
        with_priors=held is not None,
        with_imu=imu,
        moved_rms_m=moved_rms_m,
        ate_before_m=before,
        ate_m=after,
    )


def _adjusted_with_imu(run: SavedRun, keyframes: IntArray) -> Adjustment:
    path = run.tracked
    known = read_estimates(path.where / RunFile.ESTIMATES)
    settings = _estimator_settings(path.where / "config.yaml")
    taken = InertialRun(
        path, known, run.dataset.motion, run.T_cam0_imu, run.field, settings.msckf, settings.imu
    )
    done = adjust_with_imu(taken, keyframes)
    T = path.trajectory.T_world_body[keyframes], done.T_world_cam0
    before, after = (
        reprojection(path.camera, *at)[0] for at in zip(T, (done.before, done.after), strict=True)
    )
    return Adjustment(
        T_world_cam0=done.T_world_cam0,
        tracks=done.after,
        rms_before_px=float(np.sqrt(np.mean(before[:, :3] ** 2))),
        rms_after_px=float(np.sqrt(np.mean(after[:, :3] ** 2))),
        rows_dropped=0,
        sigma_px=robust_sigma(after[~done.after.by_loop][:, :3]),
    )


def _scores(run: SavedRun, refined: Trajectory) -> tuple[float | None, float | None]:
    """Return ATE before and after, against the reference in the recording; None without one."""
    if run.truth is None:
        return None, None
    try:
        return run.truth.ate_m(run.tracked.trajectory), run.truth.ate_m(refined)
    except EvaluationError as error:
        log.warning("the reference was not used: %s", error)
        return None, None


def _priors(run: SavedRun, keyframes: IntArray) -> PositionPriors | None:
    """Replay the filter on its saved observations for the poses' covariances.

    None if it does not reproduce the run.
    """
    where = run.tracked.where
    frames = run.tracked.frames
    replayed = process(
        run.dataset,
        _estimator_settings(where / "config.yaml"),
        start=int(frames[0]),
        stop=int(frames[-1]) + 1,
    )
    poses = replayed.trajectory.in_cam0(replayed.T_cam0_body).T_world_body
    if (
        len(poses) != len(frames)
        or np.abs(poses - run.tracked.trajectory.T_world_body).max() > 1e-6
    ):
        log.warning(
            "the filter does not reproduce %s (other version or settings); refining without priors",
            where,
        )
        return None
    chosen = [replayed.estimates[int(k)] for k in keyframes]
    return PositionPriors(poses[keyframes, :3, 3], position_covariances(chosen, run.T_cam0_imu))


def _estimator_settings(path: Path) -> Config:
    """Return the settings of a run without those of front end and reader, which the replay does
    not need.
    """
    try:
        values = read_yaml(read_input(path, MAX_BYTES).decode("utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {path} ({error}); repeat the run") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds no settings; repeat the run")
    kept = {key: value for key, value in values.items() if key not in ("frontend", "dataset")}
    return merge(Config(), kept, where=str(path))


@dataclass(frozen=True, slots=True)
class _PriorRules:
    """Which rows a prior of poses is made of."""

    max_pose_steps: Tolerance[int] = 12
    min_rows: int = 6
    # of a prior: the first pose of a filter has no uncertainty by definition
    min_sigma_m: Tolerance[float] = 1e-4


_PRIOR = _PriorRules()


def align_to_points(
    camera: StereoCamera,
    T_world_cam0: FloatArray,
    p_world: FloatArray,
    z: FloatArray,
    has_right: BoolArray,
) -> FloatArray | None:
    """Estimate one frame's pose (4, 4) from known points (P, 3) and pixels (P, 4); None: too few of
    them fit.

    Robust Gauss-Newton from `T_world_cam0`.
    """
    T_cam0_world = se3_inverse(T_world_cam0)
    weight = np.zeros(len(z))
    for step in range(_PRIOR.max_pose_steps):
        q = transform_points(T_cam0_world, p_world)
        ahead = q[:, 2] > MIN_DEPTH_M
        q = np.where(ahead[:, None], q, [0.0, 0.0, 1.0])
        r = z - project(camera, q)
        z_D_p = z_D_p_cam(camera, q)
        H = np.concatenate([z_D_p, -z_D_p @ so3_hat(q)], axis=2)
        r[~has_right, 2:] = 0
        H[~has_right, 2:] = 0
        width = 2.0 ** max(4 - step, 0)
        weight = ahead / (1 + np.sum(r**2, axis=1) / width**2) ** 2
        if (weight > 0.25).sum() < _PRIOR.min_rows:
            return None
        weighted = H * weight[:, None, None]
        normal = np.einsum("nki,nkj->ij", weighted, H)
        if np.linalg.cond(normal) > 1e12:
            return None
        xi = np.linalg.solve(normal, np.einsum("nki,nk->i", weighted, r))
        T_cam0_world = se3_exp(xi) @ T_cam0_world
        if step > 5 and np.abs(xi).max() < 1e-7:
            break
    return se3_inverse(T_cam0_world)


def fill_between(
    run: TrackedPath, keyframes: IntArray, T_world_keyframes: FloatArray, tracks: PointTracks
) -> tuple[FloatArray, int]:
    """Return poses (N, 4, 4) of all frames after the keyframes were adjusted, and how many come
    from points.

    A frame between keyframes is aligned to the refined points that it observes; with too few of
    them it keeps its motion relative to the previous keyframe.
    """
    old = run.trajectory.T_world_body
    before = np.clip(np.searchsorted(keyframes, np.arange(len(old)), side="right") - 1, 0, None)
    out = T_world_keyframes[before] @ se3_inverse(old[keyframes[before]]) @ old
    aligned = 0
    for k in np.setdiff1d(np.arange(len(old)), keyframes):
        seen = run.fresh(int(k))
        place = np.clip(np.searchsorted(tracks.ids, seen.ids), 0, len(tracks.ids) - 1)
        known = tracks.ids[place] == seen.ids
        pose = align_to_points(
            run.camera, out[k], tracks.p_world[place[known]], seen.z[known], seen.has_right[known]
        )
        if pose is not None:
            out[k] = pose
            aligned += 1
    return out, aligned


def position_covariances(estimates: Sequence[Estimate], T_cam0_imu: FloatArray) -> FloatArray:
    """Return covariances (K, 3, 3) of the left camera's position in the world, from `xi`
    (docs/conventions.md).

    `T_imu_world = exp(xi) T_hat` moves a point c fixed in the body by
    `R_world_imu (-rho + c x phi)`.
    """
    c = se3_inverse(T_cam0_imu)[:3, 3]
    p_D_xi = np.concatenate([-np.eye(3), so3_hat(c)], axis=1)
    R = np.array([e.T_world_imu[:3, :3] for e in estimates])
    P = np.array([e.covariance for e in estimates])
    J = R @ p_D_xi
    return J @ P @ np.swapaxes(J, 1, 2) + _PRIOR.min_sigma_m**2 * np.eye(3)
