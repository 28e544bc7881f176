"""A trajectory with its observations, and keyframe selection."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vio.calibration.egomotion import CameraMotion
from vio.errors import DataError, EstimationError
from vio.evaluation.errors_along_path import rotation_angle_deg
from vio.geometry.lie import FloatArray, se3_exp
from vio.geometry.stereo import DEPTH_DISPARITY_PX, StereoCamera
from vio.offline.loop_tracks import loop_pairs
from vio.records import FeatureTracks, IntArray, LoopEvent, Observations, Trajectory


@dataclass(frozen=True, slots=True)
class _KeyframeRules:
    """Which frames of a run become keyframes."""

    all_frames: int = 300  # in a shorter run, every frame is a keyframe
    scene_share: float = 0.08  # of the median depth: translation to a new keyframe …
    sparser: float = 1.15  # factor on both limits, from one attempt to the next
    lost_share: float = 0.2  # of the features that are seen, from keyframe to keyframe
    min_seen: int = 10  # features of a frame that may become a keyframe
    min_stretch: int = 20  # motions of a piece, where there are so many in a row
    # and where there are not: even then motion tells a yaw ten times better than rows, which a
    # tangential distortion moves alike (KITTI: 0.01 to 0.05 degrees off, for 0.5)
    shortest: int = 5
    loop_share: int = 3  # of the keyframes that may be spent on loops: one in three


_KEYFRAMES = _KeyframeRules()
_TURN_DEG = 6.0  # … or rotation to it


@dataclass(frozen=True, slots=True)
class TrackedPath:
    """The left camera's trajectory, and its observations of every frame."""

    where: Path  # the run's folder, or the recording, for messages
    camera: StereoCamera  # rectified pair
    trajectory: Trajectory  # of cam0, one pose a frame, with frame numbers
    tracks: FeatureTracks  # of all frames of the recording, by frame number
    # between two frames of the trajectory, whose poses agree with them
    loops: tuple[LoopEvent, ...] = ()
    # (N, 2) standard deviations of position (m) and attitude (deg) since the start
    sigmas: FloatArray | None = None

    @property
    def frames(self) -> IntArray:
        """Frame number (N,) of each pose."""
        assert self.trajectory.frame_indices is not None
        return self.trajectory.frame_indices

    def fresh(self, row: int) -> Observations:
        """Return the observations at one row of the trajectory, without stale ones."""
        seen = self.tracks.at(int(self.frames[row]), 0)
        return seen.take(~seen.stale)


def choose_keyframes(run: TrackedPath, *, most: int | None = None) -> IntArray:
    """Return the rows (K,) of the trajectory that become keyframes: first, last, and after enough
    motion.

    Enough is a share of the scene's median depth or a few degrees. Both limits are increased until
    there are at most `most`. Without `most`, all frames of a short run are keyframes. Both frames
    of a loop are keyframes; where that takes more than a third of `most`, only of some loops,
    spread over the run.

    Raises:
        DataError: the run is shorter than two frames.
    """
    T = run.trajectory.T_world_body
    if len(T) < 2:
        raise DataError(
            f"{run.where}: a run of {len(T)} frames has fewer than two views; process more frames"
        )
    step_m = _KEYFRAMES.scene_share * _median_depth_m(run)
    if len(T) <= (_KEYFRAMES.all_frames if most is None else most):
        return np.arange(len(T))
    ends = loop_ends(run, most)
    factor = 1.0
    while True:
        chosen = after_motion(T, factor * step_m, factor * _TURN_DEG)
        if chosen[-1] != len(T) - 1:
            chosen.append(len(T) - 1)
        if most is None or len(chosen) + len(ends) <= max(most, 2):
            return np.union1d(np.array(chosen, dtype=np.int64), ends)
        factor *= _KEYFRAMES.sparser


def after_motion(T: FloatArray, step_m: float, turn_deg: float) -> list[int]:
    """Return the rows of poses (N, 4, 4) after enough motion, or turn, since the row before; the
    first one too.
    """
    chosen = [0]
    for k in range(1, len(T)):
        last = T[chosen[-1]]
        moved = float(np.linalg.norm(T[k, :3, 3] - last[:3, 3]))
        turned = float(rotation_angle_deg(last[:3, :3].T @ T[k, :3, :3]))
        if moved >= step_m or turned >= turn_deg:
            chosen.append(k)
    return chosen


def keyframes_by_overlap(run: TrackedPath, *, most: int) -> IntArray:
    """Return the rows (K,) of the trajectory that become keyframes, close where the view changes
    fast.

    From one to the next an equal share of the features is lost, counted from frame to frame: a
    fifth, or more where that takes more than `most`. Both frames of loops are keyframes, as in
    `choose_keyframes`.

    Raises:
        DataError: the run is shorter than two frames.
    """
    if len(run.frames) < 2:
        raise DataError(
            f"{run.where}: a run of {len(run.frames)} frames has fewer than two views; process "
            "more frames"
        )
    _median_depth_m(run)
    if len(run.frames) <= most:
        return np.arange(len(run.frames))
    ends = loop_ends(run, most)
    ids = [run.fresh(k).ids for k in range(len(run.frames))]
    shown = [
        k for k in range(len(ids)) if k in (0, len(ids) - 1) or len(ids[k]) >= _KEYFRAMES.min_seen
    ]
    lost = [
        1 - np.isin(ids[a], ids[b]).mean() if len(ids[a]) else 0.0
        for a, b in itertools.pairwise(shown)
    ]
    total = np.concatenate([[0.0], np.cumsum(lost)])
    count = int(
        np.clip(np.ceil(total[-1] / _KEYFRAMES.lost_share) + 1, 2, max(most - len(ends), 2))
    )
    chosen = np.searchsorted(total, np.linspace(0, total[-1], count)).clip(0, len(shown) - 1)
    return np.union1d(np.array(shown)[np.append(chosen, len(shown) - 1)], ends)


def loop_ends(run: TrackedPath, most: int | None) -> IntArray:
    """Return the rows (E,) of the trajectory at which loops begin and end, at most a third of
    `most`.
    """
    pairs = loop_pairs(run.loops, run.frames)
    if most is not None:
        count = min(len(pairs), most // (2 * _KEYFRAMES.loop_share))
        pairs = (
            pairs[np.linspace(0, len(pairs) - 1, count).astype(np.int64)] if count else pairs[:0]
        )
    return np.unique(pairs)


def _median_depth_m(run: TrackedPath) -> float:
    tracks = run.tracks
    disparity = (tracks.z[:, 0] - tracks.z[:, 2])[tracks.has_right & ~tracks.stale]
    disparity = disparity[disparity > DEPTH_DISPARITY_PX]
    if not len(disparity):
        raise EstimationError(
            f"{run.where}: not observable because no feature has a right match with a positive "
            "disparity; check that "
            "left and right are not swapped and that the scene has texture"
        )
    return float(run.camera.fu * run.camera.baseline_m / np.median(disparity))


def tracked_segments(
    where: Path,
    camera: StereoCamera,
    tracks: FeatureTracks,
    motion: CameraMotion,
    *,
    longest: int,
    most: int,
) -> list[TrackedPath]:
    """Return pieces of a recording, with poses concatenated from frame to frame; short ones where
    there are no others.

    Args:
        where: the recording.
        camera: rectified pair.
        tracks: stereo features of the recording.
        motion: of the camera, where it was estimated.
        longest: frames of a piece.
        most: pieces, spread over the recording.
    """
    breaks = np.flatnonzero(np.diff(motion.frames) != 1) + 1
    rows = np.arange(len(motion.frames))
    parts = [
        part[k : k + longest]
        for part in np.split(rows, breaks)
        for k in range(0, len(part), longest)
    ]
    enough = min(longest, _KEYFRAMES.min_stretch)
    if all(len(part) < enough for part in parts):
        enough = min(longest, _KEYFRAMES.shortest)
    parts = [part for part in parts if len(part) >= enough]
    if not parts:
        return []
    out: list[TrackedPath] = []
    for part in (parts[k] for k in np.unique(np.linspace(0, len(parts) - 1, most).astype(int))):
        indices = np.arange(motion.frames[part[0]], motion.frames[part[-1]] + 2)
        times_ns = motion.times_ns[indices]
        poses = [np.eye(4)]
        for step, dt_ns in zip(motion.twists[part], np.diff(times_ns), strict=True):
            poses.append(poses[-1] @ se3_exp(1e-9 * float(dt_ns) * step))
        out.append(
            TrackedPath(
                where, camera, Trajectory(np.array(poses), times_ns, "cam0", indices), tracks
            )
        )
    return out
