"""The map behind a run: keyframes, tracks across them, points from many views, poses from points.

Everything stands in the rectified left camera: poses are `T_world_cam0`, pixels `z = [ul vl ur vr]`. What a bundle
adjuster or an exporter needs from a run's folder is prepared here, with numpy alone.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.datasets import open_dataset
from vio.datasets.common import read_npz
from vio.datasets.features import FeatureDataset
from vio.datasets.observation_log import read_observation_log
from vio.errors import DataError, EstimationError, EvaluationError
from vio.evaluation import align_poses, apply_alignment, evaluate, rotation_angle_deg
from vio.geometry.lie import FloatArray, nearest_rotation, se3_exp, se3_inverse, so3_hat, transform_points
from vio.geometry.stereo import StereoCamera, project, triangulate, z_D_p_cam
from vio.records import (
    BoolArray,
    Estimate,
    FeatureTracks,
    Image,
    IntArray,
    Landmarks,
    Recording,
    StereoFrame,
    Trajectory,
)
from vio.run_folder import MARKER
from vio.trajectory_io import read_trajectory

OBSERVATIONS = "observations.npz"
_MIN_DISPARITY_PX = 0.5
_MIN_DEPTH_M = 0.05
_POINT_STEPS = 8
_POSE_STEPS = 12
_LEAST_POSE_ROWS = 6
_ALL_FRAMES = 300  # a shorter run is adjusted whole
_SCENE_SHARE = 0.08  # of the median depth: a new keyframe is due after moving so far …
_TURN_DEG = 6.0  # … or turning so far
_LEAST_STRETCH = 20  # frames
_SCALE_SIGMA = 0.02  # a scale less certain than this is not stated
_LEAST_MOTIONS = 8  # keyframes needed to say which motions stand out
_OUTLYING = 6.0  # robust standard deviations
_LEAST_SIGMA_M = 1e-4  # of a prior: the first pose of a filter is certain by definition


@dataclass(frozen=True, slots=True)
class SavedRun:
    """What a run's folder holds, with the observations that led to it."""

    folder: Path
    source: str  # the recording as `kind:path`, the one that the images came from
    dataset: FeatureDataset  # observations of every frame
    trajectory: Trajectory  # of the left camera, one pose a frame, with times and frame numbers
    T_cam0_imu: FloatArray  # (4, 4)
    metrics: dict[str, Any]

    @property
    def camera(self) -> StereoCamera:
        """The rectified pair."""
        return self.dataset.recording.camera

    @property
    def frames(self) -> IntArray:
        """Frame number (N,) of each pose."""
        assert self.trajectory.frame_indices is not None
        return self.trajectory.frame_indices


@dataclass(frozen=True, slots=True)
class PointTracks:
    """Points of the map and where the keyframes see them."""

    ids: IntArray  # (M,) feature ids
    p_world: FloatArray  # (M, 3) metres
    point: IntArray  # (R,) index of the point that a row shows
    keyframe: IntArray  # (R,) index of the keyframe of a row; rows are ordered by keyframe
    z: FloatArray  # (R, 4) rectified pixels
    has_right: BoolArray  # (R,)


def read_saved_run(folder: Path) -> SavedRun:
    """Read the folder of `vio run --save-observations`.

    Raises:
        DataError: no such folder, or the observations were not saved.
    """
    marker = folder / MARKER
    if not marker.is_file():
        raise DataError(f"{folder}: no run folder (it has no {MARKER}); give a folder that `vio run` wrote")
    log = folder / OBSERVATIONS
    if not log.is_file():
        raise DataError(f"{folder} has no {OBSERVATIONS}; repeat its run with --save-observations")
    metrics = json.loads(marker.read_text(encoding="utf-8"))
    dataset = read_observation_log(log)
    T_cam0_imu = np.array(metrics["T_cam0_imu"], dtype=np.float64)
    trajectory = read_trajectory(folder / "trajectory.tum")
    frames = trajectory.frame_indices
    if frames is None or not np.array_equal(frames, dataset.present) or not np.isfinite(trajectory.T_world_body).all():
        raise DataError(f"{folder}: trajectory.tum and {OBSERVATIONS} are not of one whole run; repeat the run")
    return SavedRun(folder, _original_source(log), dataset, trajectory.in_cam0(T_cam0_imu), T_cam0_imu, metrics)


def _original_source(log: Path) -> str:
    """The recording that holds the images, through any number of replayed logs."""
    source = str(read_npz(log)["source"])
    kind, _, path = source.partition(":")
    seen = {log.resolve()}
    while kind == "log" and Path(path).is_file() and Path(path).resolve() not in seen:
        seen.add(Path(path).resolve())
        source = str(read_npz(Path(path))["source"])
        kind, _, path = source.partition(":")
    return source


# --- keyframes and tracks -------------------------------------------------------------------------------------------


def choose_keyframes(run: SavedRun, *, most: int | None = None) -> IntArray:
    """Rows (K,) of the trajectory that become keyframes: first and last, and whenever the view has changed enough.

    Enough is a share of the scene's median depth or a few degrees. Where that gives more than `most`, both limits grow.
    Without `most`, a short run gives all of its frames.

    Raises:
        DataError: the run is shorter than two frames.
    """
    T = run.trajectory.T_world_body
    if len(T) < 2:
        raise DataError(f"{run.folder}: a run of {len(T)} frames has no two views; process more of the recording")
    step_m = _SCENE_SHARE * _median_depth_m(run)
    if len(T) <= (_ALL_FRAMES if most is None else most):
        return np.arange(len(T))
    factor = 1.0
    while True:
        chosen = [0]
        for k in range(1, len(T)):
            moved = float(np.linalg.norm(T[k, :3, 3] - T[chosen[-1], :3, 3]))
            turned = float(rotation_angle_deg(T[chosen[-1], :3, :3].T @ T[k, :3, :3]))
            if moved >= factor * step_m or turned >= factor * _TURN_DEG:
                chosen.append(k)
        if chosen[-1] != len(T) - 1:
            chosen.append(len(T) - 1)
        if most is None or len(chosen) <= max(most, 2):
            return np.array(chosen, dtype=np.int64)
        factor *= 1.15


def _median_depth_m(run: SavedRun) -> float:
    tracks = run.dataset.tracks
    disparity = (tracks.z[:, 0] - tracks.z[:, 2])[tracks.has_right & ~tracks.stale]
    disparity = disparity[disparity > _MIN_DISPARITY_PX]
    if not len(disparity):
        raise EstimationError(
            f"{run.folder}: not observable because no feature has a right match with a positive disparity; check that "
            "left and right are not swapped and that the scene has texture"
        )
    return float(run.camera.fu * run.camera.baseline_m / np.median(disparity))


def build_tracks(
    run: SavedRun, keyframes: IntArray, T_world_cam0: FloatArray, *, gate_px: float = 3.0, least_views: int = 2
) -> PointTracks:
    """Turn a run's observations in keyframes into points, each seen in at least `least_views` of them.

    Args:
        run: the run.
        keyframes: (K,) rows of the trajectory.
        T_world_cam0: (K, 4, 4) poses of the keyframes.
        gate_px: a row whose reprojection is off by more (in any coordinate) is an outlier and left out.
        least_views: keyframes that must see a point.

    Raises:
        EstimationError: no track survives.
    """
    rows = [run.dataset.tracks.at(int(run.frames[k]), 0) for k in keyframes]
    fresh = [o.take(~o.stale) for o in rows]
    ids = np.concatenate([o.ids for o in fresh])
    keyframe = np.repeat(np.arange(len(keyframes)), [len(o) for o in fresh])
    z = np.concatenate([o.z for o in fresh])
    has_right = np.concatenate([o.has_right for o in fresh])
    names, point = np.unique(ids, return_inverse=True)
    tracks = PointTracks(names, np.zeros((len(names), 3)), point.astype(np.int64), keyframe, z, has_right)
    tracks = _kept(tracks, np.ones(len(point), dtype=np.bool_), least_views)
    for _ in range(3):
        if not len(tracks.ids):
            break
        p_world, valid = triangulate_tracks(run.camera, T_world_cam0, tracks)
        tracks = replace(tracks, p_world=p_world)
        residual, ahead = reprojection(run.camera, T_world_cam0, tracks)
        good = ahead & valid[tracks.point] & (np.abs(residual).max(axis=1) < gate_px)
        tracks = _kept(tracks, good, least_views)
        if good.all():
            break
    if not len(tracks.ids):
        raise EstimationError(
            f"{run.folder}: not observable because no feature is seen consistently in {least_views} keyframes; the "
            "views do not overlap, the scene has no texture, or the run's poses are wrong"
        )
    return tracks


def _kept(tracks: PointTracks, rows: BoolArray, least_views: int) -> PointTracks:
    """The tracks without some rows, and without points that have then too few views or no stereo row."""
    count = len(tracks.ids)
    views = np.bincount(tracks.point[rows], minlength=count)
    stereo = np.bincount(tracks.point[rows & tracks.has_right], minlength=count)
    points = (views >= least_views) & (stereo > 0)
    rows = rows & points[tracks.point]
    renumbered = np.cumsum(points) - 1
    return PointTracks(
        ids=tracks.ids[points],
        p_world=tracks.p_world[points],
        point=renumbered[tracks.point[rows]],
        keyframe=tracks.keyframe[rows],
        z=tracks.z[rows],
        has_right=tracks.has_right[rows],
    )


def keep_rows(tracks: PointTracks, rows: BoolArray, *, least_views: int = 2) -> PointTracks:
    """Return the tracks with the rows (R,) named by a mask, and without points that have then too few views."""
    return _kept(tracks, rows, least_views)


def reprojection(camera: StereoCamera, T_world_cam0: FloatArray, tracks: PointTracks) -> tuple[FloatArray, BoolArray]:
    """Residuals (R, 4) `z - prediction` in pixels, zero for absent right pixels, and a mask (R,) of points ahead."""
    T_cam0_world = se3_inverse(T_world_cam0)
    q, ahead = _in_camera(T_cam0_world, tracks)
    residual = tracks.z - project(camera, q)
    residual[~tracks.has_right, 2:] = 0
    return residual, ahead


def _in_camera(T_cam0_world: FloatArray, tracks: PointTracks) -> tuple[FloatArray, BoolArray]:
    T = T_cam0_world[tracks.keyframe]
    q = np.einsum("nij,nj->ni", T[:, :3, :3], tracks.p_world[tracks.point]) + T[:, :3, 3]
    ahead = q[:, 2] > _MIN_DEPTH_M
    return np.where(ahead[:, None], q, [0.0, 0.0, 1.0]), ahead


def triangulate_tracks(
    camera: StereoCamera, T_world_cam0: FloatArray, tracks: PointTracks, *, width_px: float = 1.0
) -> tuple[FloatArray, BoolArray]:
    """Points (M, 3) of all views by robust Gauss-Newton, and a mask (M,) of those determined.

    Starts from the stereo pair with the largest disparity; a Geman-McClure weight of `width_px` bounds outliers.
    """
    count = len(tracks.ids)
    disparity = np.where(tracks.has_right, tracks.z[:, 0] - tracks.z[:, 2], -np.inf)
    order = np.lexsort((disparity, tracks.point))
    last = np.searchsorted(tracks.point[order], np.arange(count), side="right") - 1
    best = order[last]
    p_cam, valid = triangulate(camera, tracks.z[best], min_disparity_px=_MIN_DISPARITY_PX)
    valid &= tracks.has_right[best]
    p_cam = np.where(valid[:, None], p_cam, [0.0, 0.0, 1.0])
    start = T_world_cam0[tracks.keyframe[best]]
    p_world = np.einsum("nij,nj->ni", start[:, :3, :3], p_cam) + start[:, :3, 3]
    T_cam0_world = se3_inverse(T_world_cam0)
    R = T_cam0_world[tracks.keyframe, :3, :3]
    by_point = np.argsort(tracks.point, kind="stable")
    begins = np.searchsorted(tracks.point[by_point], np.arange(count))
    for step in range(_POINT_STEPS):
        q, ahead = _in_camera(T_cam0_world, replace(tracks, p_world=p_world))
        r = tracks.z - project(camera, q)
        H = z_D_p_cam(camera, q) @ R
        r[~tracks.has_right, 2:] = 0
        H[~tracks.has_right, 2:] = 0
        width = width_px * 2.0 ** max(3 - step, 0)
        weight = ahead / (1 + np.sum(r**2, axis=1) / width**2) ** 2
        weighted = H * weight[:, None, None]
        normal = np.add.reduceat((np.swapaxes(weighted, 1, 2) @ H)[by_point], begins)
        gradient = np.add.reduceat(np.einsum("nij,ni->nj", weighted, r)[by_point], begins)
        spread = np.linalg.eigvalsh(normal)
        solvable = spread[:, 0] > 1e-12 * np.maximum(spread[:, -1], 1e-12)
        normal[~solvable] = np.eye(3)
        gradient[~solvable] = 0
        valid &= solvable
        p_world = p_world + np.linalg.solve(normal, gradient[..., None])[..., 0]
    return p_world, valid & np.isfinite(p_world).all(axis=1)


def align_to_points(
    camera: StereoCamera,
    T_world_cam0: FloatArray,
    p_world: FloatArray,
    z: FloatArray,
    has_right: BoolArray,
    *,
    width_px: float = 1.0,
) -> FloatArray | None:
    """Pose (4, 4) of one frame from known points (P, 3) and their pixels (P, 4); None: too few of them fit.

    Robust Gauss-Newton from `T_world_cam0`.
    """
    T_cam0_world = se3_inverse(T_world_cam0)
    weight = np.zeros(len(z))
    for step in range(_POSE_STEPS):
        q = transform_points(T_cam0_world, p_world)
        ahead = q[:, 2] > _MIN_DEPTH_M
        q = np.where(ahead[:, None], q, [0.0, 0.0, 1.0])
        r = z - project(camera, q)
        z_D_p = z_D_p_cam(camera, q)
        H = np.concatenate([z_D_p, -z_D_p @ so3_hat(q)], axis=2)
        r[~has_right, 2:] = 0
        H[~has_right, 2:] = 0
        width = width_px * 2.0 ** max(4 - step, 0)
        weight = ahead / (1 + np.sum(r**2, axis=1) / width**2) ** 2
        if (weight > 0.25).sum() < _LEAST_POSE_ROWS:
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
    run: SavedRun, keyframes: IntArray, T_world_keyframes: FloatArray, tracks: PointTracks
) -> tuple[FloatArray, int]:
    """Poses (N, 4, 4) of every frame once the keyframes have moved, and how many came from points.

    A frame between keyframes is aligned to the refined points that it sees; where too few are seen it keeps its
    motion relative to the keyframe before it.
    """
    old = run.trajectory.T_world_body
    before = np.clip(np.searchsorted(keyframes, np.arange(len(old)), side="right") - 1, 0, None)
    out = T_world_keyframes[before] @ se3_inverse(old[keyframes[before]]) @ old
    aligned = 0
    for k in np.setdiff1d(np.arange(len(old)), keyframes):
        seen = run.dataset.tracks.at(int(run.frames[k]), 0)
        seen = seen.take(~seen.stale)
        place = np.clip(np.searchsorted(tracks.ids, seen.ids), 0, len(tracks.ids) - 1)
        known = tracks.ids[place] == seen.ids
        pose = align_to_points(run.camera, out[k], tracks.p_world[place[known]], seen.z[known], seen.has_right[known])
        if pose is not None:
            out[k] = pose
            aligned += 1
    return out, aligned


# --- statistics -----------------------------------------------------------------------------------------------------


def landmarks_of(camera: StereoCamera, T_world_cam0: FloatArray, tracks: PointTracks, sigma_px: float) -> Landmarks:
    """The points as landmarks; covariances for fixed poses and `sigma_px` a pixel coordinate."""
    T_cam0_world = se3_inverse(T_world_cam0)
    q, _ = _in_camera(T_cam0_world, tracks)
    H = z_D_p_cam(camera, q) @ T_cam0_world[tracks.keyframe, :3, :3]
    H[~tracks.has_right, 2:] = 0
    information = np.zeros((len(tracks.ids), 3, 3))
    np.add.at(information, tracks.point, np.swapaxes(H, 1, 2) @ H)
    covariance: FloatArray = sigma_px**2 * np.asarray(np.linalg.pinv(information, hermitian=True), dtype=np.float64)
    return Landmarks(tracks.ids, tracks.p_world, covariance)


def position_covariances(estimates: Sequence[Estimate], T_cam0_imu: FloatArray) -> FloatArray:
    """Covariances (K, 3, 3) of the left camera's position in the world, from those of `xi` (docs/conventions.md).

    `T_imu_world = exp(xi) T_hat` moves a point c fixed in the body by `R_world_imu (-rho + c x phi)`.
    """
    c = se3_inverse(T_cam0_imu)[:3, 3]
    p_D_xi = np.concatenate([-np.eye(3), so3_hat(c)], axis=1)
    R = np.array([e.T_world_imu[:3, :3] for e in estimates])
    P = np.array([e.covariance for e in estimates])
    J = R @ p_D_xi
    out: FloatArray = J @ P @ np.swapaxes(J, 1, 2) + _LEAST_SIGMA_M**2 * np.eye(3)
    return out


def position_difference_m(one: Trajectory, other: Trajectory) -> float:
    """Root mean square distance of paired positions after SE(3) alignment."""
    alignment = align_poses(one.T_world_body, other.T_world_body, "se3")
    aligned = apply_alignment(alignment, one.T_world_body)
    return float(np.sqrt(np.mean(np.sum((aligned[:, :3, 3] - other.positions) ** 2, axis=1))))


# --- images ---------------------------------------------------------------------------------------------------------


def with_poses(run: SavedRun, folder: Path) -> SavedRun:
    """The run with the poses of another folder, such as that of `vio refine`.

    Raises:
        DataError: that folder does not exist or describes other frames.
    """
    if not (folder / "trajectory.tum").is_file():
        raise DataError(f"{folder} holds no trajectory; make it with `vio refine {run.folder}`")
    trajectory = read_trajectory(folder / "trajectory.tum").in_cam0(run.T_cam0_imu)
    if trajectory.frame_indices is None or not np.array_equal(trajectory.frame_indices, run.frames):
        raise DataError(f"{folder} describes other frames than {run.folder}; refine again")
    return replace(run, trajectory=trajectory)


def stereo_frames(run: SavedRun, source: str | None, rows: IntArray) -> Iterator[StereoFrame]:
    """Yield the rectified image pairs of rows (K,) of the trajectory, in order.

    Args:
        run: the run.
        source: the recording, where it is not at the place that the run names.
        rows: increasing.

    Raises:
        DataError: the recording is gone, holds no images, has another camera, or a frame cannot be read.
    """
    try:
        dataset = open_dataset(source or run.source)
    except DataError as error:
        raise DataError(
            f"the images of {run.folder} are not to be had: {error}; name the recording with --source"
        ) from error
    recording = dataset.recording
    if not recording.has_images:
        raise DataError(f"{source or run.source} holds no images; name the recording with --source or use --no-images")
    ours, theirs = run.camera, recording.camera
    if not np.allclose(
        [ours.fu, ours.fv, ours.cu, ours.cv, ours.baseline_m],
        [theirs.fu, theirs.fv, theirs.cu, theirs.cv, theirs.baseline_m],
        rtol=1e-9,
    ):
        raise DataError(f"{recording.path} has another calibration than the run {run.folder}; repeat the run")
    for row in rows.tolist():
        index = int(run.frames[row])
        found = [e for e in dataset.events(index, index + 1) if isinstance(e, StereoFrame)]
        if not found or found[0].left is None or found[0].right is None:
            raise DataError(f"{recording.path}: frame {index} cannot be read; see the warnings above")
        yield found[0]


def sample_gray(image: Image, uv: FloatArray) -> FloatArray:
    """Gray values (N,) of the pixels nearest to (N, 2)."""
    u = np.clip(np.rint(uv[:, 0]).astype(int), 0, image.shape[1] - 1)
    v = np.clip(np.rint(uv[:, 1]).astype(int), 0, image.shape[0] - 1)
    out: FloatArray = image[v, u].astype(np.float64)
    return out


def write_png(path: Path, image: Image) -> None:
    """Write a gray image (H, W); the folder must exist."""
    import cv2

    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    path.write_bytes(data.tobytes())


# --- comparison -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch between keyframes over which two trajectories move differently."""

    first_frame: int
    last_frame: int
    difference_m: float  # largest difference of the motions between neighbouring keyframes
    difference_deg: float


@dataclass(frozen=True, slots=True)
class Comparison:
    """A second opinion on a run's keyframes."""

    total: int  # keyframes compared
    frames: IntArray  # (R,) frame numbers
    aligned: FloatArray  # (R, 4, 4) the other poses in the run's world, after SE(3) alignment
    difference_m: FloatArray  # (R,)
    difference_deg: FloatArray  # (R,)
    ate_m: float  # after SE(3) alignment
    ate_deg: float
    scale: float | None  # length of the other trajectory over the run's; None: see why_no_scale
    scale_sigma: float | None  # standard error
    why_no_scale: str | None
    segments: tuple[Segment, ...]
    reference_ate_m: float | None  # of the other poses, against ground truth
    reference_scale: float | None  # length of the other trajectory over that of ground truth
    run_reference_ate_m: float | None  # of the run at the same keyframes


def compare_keyframes(run: SavedRun, rows: IntArray, T_other_cam0: FloatArray) -> Comparison:
    """Compare poses (R, 4, 4) of the left camera from elsewhere with those of the run at rows (R,) of its trajectory.

    Reference: Umeyama (1991) for the alignment, as in `vio.evaluation`.
    """
    own = run.trajectory.T_world_body[rows]
    aligned = apply_alignment(align_poses(T_other_cam0, own, "se3"), T_other_cam0)
    difference_m = np.linalg.norm(aligned[:, :3, 3] - own[:, :3, 3], axis=1)
    # Rotations are compared apart: a straight path leaves the roll of an alignment by positions open.
    turn = nearest_rotation(np.einsum("nij,nkj->ik", own[:, :3, :3], T_other_cam0[:, :3, :3]))
    difference_deg = rotation_angle_deg(np.swapaxes(own[:, :3, :3], 1, 2) @ turn @ T_other_cam0[:, :3, :3])
    scale, sigma, why = _scale_ratio(T_other_cam0, own, float(np.sqrt(np.mean(difference_m**2))))
    against = _against_reference(run, rows, T_other_cam0)
    return Comparison(
        total=len(rows),
        frames=run.frames[rows],
        aligned=aligned,
        difference_m=difference_m,
        difference_deg=difference_deg,
        ate_m=float(np.sqrt(np.mean(difference_m**2))),
        ate_deg=float(np.sqrt(np.mean(difference_deg**2))),
        scale=scale,
        scale_sigma=sigma,
        why_no_scale=why,
        segments=_disagreements(run.frames[rows], own, T_other_cam0),
        reference_ate_m=against[0],
        reference_scale=against[1],
        run_reference_ate_m=against[2],
    )


def _scale_ratio(T_other: FloatArray, T_own: FloatArray, ate_m: float) -> tuple[float | None, float | None, str | None]:
    """Length of the other trajectory over one's own with its standard error, or why there is none."""
    p = T_own[:, :3, 3]
    extent = float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1))))
    if len(p) < 3:
        return None, None, f"only {len(p)} keyframes are connected"
    try:
        alignment = align_poses(T_other, T_own, "sim3")
    except EvaluationError:
        return None, None, "the camera does not move (pure rotation or standstill)"
    rest = apply_alignment(alignment, T_other)[:, :3, 3] - p
    sigma = float(np.sqrt(np.mean(np.sum(rest**2, axis=1)))) / (extent * np.sqrt(len(p)))
    if sigma > _SCALE_SIGMA:
        return None, None, f"the camera moves over {extent:.3g} m only, against differences of {ate_m:.2g} m"
    return 1 / alignment.scale, sigma, None


def _disagreements(frames: IntArray, T_own: FloatArray, T_other: FloatArray) -> tuple[Segment, ...]:
    """Stretches where motions between neighbouring keyframes differ far more than they usually do."""
    if len(frames) < _LEAST_MOTIONS:
        return ()
    motion_own = se3_inverse(T_own[:-1]) @ T_own[1:]
    motion_other = se3_inverse(T_other[:-1]) @ T_other[1:]
    off_m = np.linalg.norm(motion_own[:, :3, 3] - motion_other[:, :3, 3], axis=1)
    off_deg = rotation_angle_deg(np.swapaxes(motion_own[:, :3, :3], 1, 2) @ motion_other[:, :3, :3])
    bad = _stands_out(off_m) | _stands_out(off_deg)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(np.int8)))
    return tuple(
        Segment(int(frames[a]), int(frames[b]), float(off_m[a:b].max()), float(off_deg[a:b].max()))
        for a, b in edges.reshape(-1, 2).tolist()
    )


def _stands_out(values: FloatArray) -> BoolArray:
    middle = float(np.median(values))
    return values > middle + _OUTLYING * max(1.4826 * float(np.median(np.abs(values - middle))), 0.1 * middle, 1e-9)


def _against_reference(
    run: SavedRun, rows: IntArray, T_other_cam0: FloatArray
) -> tuple[float | None, float | None, float | None]:
    """ATE of the other poses, their scale, and ATE of the run's, against the recording's ground truth."""
    reference = run.dataset.recording.reference
    if reference is None:
        return None, None, None
    own = replace(
        run.trajectory,
        T_world_body=run.trajectory.T_world_body[rows],
        times_ns=None if run.trajectory.times_ns is None else run.trajectory.times_ns[rows],
        frame_indices=run.frames[rows],
    )
    other = replace(own, T_world_body=T_other_cam0)
    try:
        ate, of_run = (
            float(evaluate(t, reference, T_cam0_imu=run.T_cam0_imu).as_dict()["ate_m"]) for t in (other, own)
        )
        scale = float(evaluate(other, reference, align="sim3", T_cam0_imu=run.T_cam0_imu).as_dict()["scale"])
    except EvaluationError:
        return None, None, None
    return ate, 1 / scale, of_run


def tracked_stretches(
    recording: Recording, tracks: FeatureTracks, frames: IntArray, twists: FloatArray, *, longest: int, most: int
) -> list[SavedRun]:
    """Pieces of a recording, with poses chained from frame to frame, as if each were a run of its own.

    Args:
        recording: whose features they are.
        tracks: stereo features.
        frames: (K,) earlier frame of each interval with a known motion, increasing.
        twists: (K, 6) of cam0 over it, [v; omega].
        longest: frames of a piece.
        most: pieces, spread over the recording.
    """
    breaks = np.flatnonzero(np.diff(frames) != 1) + 1
    parts = [
        part[k : k + longest] for part in np.split(np.arange(len(frames)), breaks) for k in range(0, len(part), longest)
    ]
    parts = [part for part in parts if len(part) >= min(longest, _LEAST_STRETCH)]
    out: list[SavedRun] = []
    if not parts:
        return out
    for part in (parts[k] for k in np.unique(np.linspace(0, len(parts) - 1, most).astype(int))):
        indices = np.arange(frames[part[0]], frames[part[-1]] + 2)
        times_ns = recording.frame_times_ns[indices]
        poses = [np.eye(4)]
        for step, dt_ns in zip(twists[part], np.diff(times_ns), strict=True):
            poses.append(poses[-1] @ se3_exp(1e-9 * float(dt_ns) * step))
        trajectory = Trajectory(np.array(poses), times_ns, "cam0", indices)
        stale = np.zeros(len(recording.frame_times_ns), dtype=np.bool_)
        dataset = FeatureDataset(recording, tracks, (), indices, stale)
        out.append(SavedRun(recording.path, str(recording.path), dataset, trajectory, np.eye(4), {}))
    return out
