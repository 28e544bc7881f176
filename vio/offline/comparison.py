"""Comparison of two trajectories over the same keyframes: distance, scale, and segments that
disagree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vio.errors import EvaluationError
from vio.evaluation.alignment import align_poses, apply_alignment, extent_m
from vio.evaluation.association import take
from vio.evaluation.errors_along_path import path_length_m, rotation_angle_deg
from vio.evaluation.trajectories import evaluate
from vio.geometry.lie import FloatArray, nearest_rotation, se3_inverse
from vio.numerics.robust import robust_sigma
from vio.offline.keyframes import TrackedPath
from vio.records import BoolArray, IntArray, Trajectory


@dataclass(frozen=True, slots=True)
class _MotionRules:
    """How motions of two reconstructions are compared."""

    scale_sigma: float = 0.02  # a scale with a larger standard deviation is not reported
    min_motions: int = 8  # keyframes needed to detect outlying motions
    outlying: float = 6.0  # robust standard deviations
    # of the motion between two keyframes: beyond it, one of both trajectories has jumped there
    broken: float = 1.0


_MOTIONS = _MotionRules()


@dataclass(frozen=True, slots=True)
class _EndRules:
    """When the ends of two paths count as apart."""

    # What COLMAP's own path may be off by at its end, beside the run's standard deviations.
    share: float = 0.01
    deg: float = 0.5
    deg_per_m: float = 0.01
    sigmas: float = 3.0


_END = _EndRules()


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """A reference trajectory."""

    trajectory: Trajectory  # of the left camera or the IMU
    T_cam0_imu: FloatArray  # (4, 4)

    def ate_m(self, found: Trajectory) -> float:
        """Return the ATE (rms) of a trajectory after rigid alignment.

        EvaluationError where they do not meet.
        """
        return evaluate(found, self.trajectory, T_cam0_imu=self.T_cam0_imu).ate_m.rmse


@dataclass(frozen=True, slots=True)
class Segment:
    """A range of keyframes over which the motions of two trajectories differ."""

    first_frame: int
    last_frame: int
    difference_m: float  # largest difference of the motions between neighbouring keyframes
    difference_deg: float


@dataclass(frozen=True, slots=True)
class KeyframeComparison:
    """Comparison of a run's keyframes with other poses of the same frames."""

    total: int  # keyframes compared
    frames: IntArray  # (R,) frame numbers
    # (R,) keyframes of the longest segment without a gap, and without a jump of either trajectory
    piece: BoolArray
    pieces: int  # between gaps
    # (R, 4, 4) the other poses in the run's world, after SE(3) alignment of this piece
    aligned: FloatArray
    difference_m: FloatArray  # (R,)
    difference_deg: FloatArray  # (R,)
    ate_m: float  # of the piece
    ate_deg: float
    # by which the motion from the first to the last keyframe of the piece differs, at one scale
    end_m: float
    end_deg: float
    expected_end_m: float  # that it may differ by, by the run's covariance and COLMAP's own errors
    expected_end_deg: float
    scale: float | None  # length of the other trajectory over the run's; None: see why_no_scale
    scale_sigma: float | None  # standard error
    why_no_scale: str | None
    segments: tuple[Segment, ...]
    reference_ate_m: float | None  # of the other poses, against ground truth
    reference_scale: float | None  # length of the other trajectory over that of ground truth
    run_reference_ate_m: float | None  # of the run at the same keyframes


def compare_keyframes(
    run: TrackedPath,
    rows: IntArray,
    T_other_cam0: FloatArray,
    truth: GroundTruth | None = None,
    *,
    linked: BoolArray | None = None,
) -> KeyframeComparison:
    """Compare poses of the left camera from another source with those of a run.

    Args:
        run: the run.
        rows: (R,) rows of its trajectory.
        T_other_cam0: (R, 4, 4) poses from the other source at these rows, in any world frame.
        truth: ground truth to compare both with.
        linked: (R - 1,) whether the other source joins each keyframe to the next; motions where it
            does not are not compared. None: all of them.

    Reference: Umeyama (1991) for the alignment, as in `vio.evaluation.trajectories`.
    """
    own = run.trajectory.T_world_body[rows]
    if linked is None:
        linked = np.ones(len(rows) - 1, dtype=np.bool_)
    piece, pieces = _longest_piece(own, T_other_cam0, linked)
    aligned = apply_alignment(align_poses(T_other_cam0[piece], own[piece], "se3"), T_other_cam0)
    difference_m = np.linalg.norm(aligned[:, :3, 3] - own[:, :3, 3], axis=1)
    # Rotations are aligned separately: on a straight path an alignment by positions leaves the roll
    # unobservable.
    turn = nearest_rotation(
        np.einsum("nij,nkj->ik", own[piece, :3, :3], T_other_cam0[piece, :3, :3])
    )
    difference_deg = rotation_angle_deg(
        np.swapaxes(own[:, :3, :3], 1, 2) @ turn @ T_other_cam0[:, :3, :3]
    )
    ate_m, ate_deg = (
        float(np.sqrt(np.mean(d[piece] ** 2))) for d in (difference_m, difference_deg)
    )
    scale, sigma, why = _scale_ratio(T_other_cam0[piece], own[piece], ate_m)
    segments = _disagreements(run.frames[rows], own, T_other_cam0, linked)
    path_m = path_length_m(own[piece, :3, 3])
    ends = np.flatnonzero(piece)[[0, -1]]
    same = T_other_cam0.copy()  # of the run's length: another scale is said apart
    same[:, :3, 3] /= scale or 1.0
    end_m, end_deg = (float(d[0]) for d in motion_differences(own[ends], same[ends]))
    most_m, most_deg = _expected_end(run, rows[ends], path_m)
    off_m = max(end_m, aligned_distance_m(same[piece], own[piece]))
    if not segments and (off_m > most_m or end_deg > most_deg):
        first, last = run.frames[rows[ends]].tolist()
        segments = (Segment(first, last, off_m, end_deg),)
    against: tuple[float | None, float | None, float | None] = (None, None, None)
    if truth is not None:
        against = _against(truth, run, rows, T_other_cam0)
    return KeyframeComparison(
        total=len(rows),
        frames=run.frames[rows],
        piece=piece,
        pieces=pieces,
        aligned=aligned,
        difference_m=difference_m,
        difference_deg=difference_deg,
        ate_m=ate_m,
        ate_deg=ate_deg,
        end_m=end_m,
        end_deg=end_deg,
        expected_end_m=most_m,
        expected_end_deg=most_deg,
        scale=scale,
        scale_sigma=sigma,
        why_no_scale=why,
        segments=segments,
        reference_ate_m=against[0],
        reference_scale=against[1],
        run_reference_ate_m=against[2],
    )


def _expected_end(run: TrackedPath, ends: IntArray, path_m: float) -> tuple[float, float]:
    """Return by how much the motion between two rows (2,) of a right run may differ from
    COLMAP's, m and degrees.
    """
    sigma_m, sigma_deg = (0.0, 0.0) if run.sigmas is None else run.sigmas[ends[1]].tolist()
    by_colmap = _END.share * path_m, _END.deg + _END.deg_per_m * path_m
    return _END.sigmas * sigma_m + by_colmap[0], _END.sigmas * sigma_deg + by_colmap[1]


def aligned_distance_m(T_other: FloatArray, T_own: FloatArray) -> float:
    """Return the root mean square distance of the positions of paired poses (R, 4, 4) after
    SE(3) alignment.
    """
    aligned = apply_alignment(align_poses(T_other, T_own, "se3"), T_other)
    off = aligned[:, :3, 3] - T_own[:, :3, 3]
    squares = np.sum(off**2, axis=1)
    return float(np.sqrt(np.mean(squares)))


def _scale_ratio(
    T_other: FloatArray, T_own: FloatArray, ate_m: float
) -> tuple[float | None, float | None, str | None]:
    """Return the other trajectory's scale relative to the run with its standard error, or why
    there is none.
    """
    p = T_own[:, :3, 3]
    if len(p) < 3:
        return None, None, f"only {len(p)} keyframes are connected"
    try:
        alignment = align_poses(T_other, T_own, "sim3")
    except EvaluationError:
        return None, None, "the camera does not move (pure rotation or standstill)"
    residual = apply_alignment(alignment, T_other)[:, :3, 3] - p
    rms = float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))
    extent = extent_m(p)
    sigma = rms / (extent * np.sqrt(len(p)))
    if sigma > _MOTIONS.scale_sigma:
        return (
            None,
            None,
            f"the camera moves over {extent:.3g} m only, against differences of {ate_m:.2g} m",
        )
    return 1 / alignment.scale, sigma, None


def _disagreements(
    frames: IntArray, T_own: FloatArray, T_other: FloatArray, linked: BoolArray
) -> tuple[Segment, ...]:
    """Return segments where motions between neighbouring keyframes, where there is no gap,
    differ by outliers.
    """
    if linked.sum() < _MOTIONS.min_motions - 1:
        return ()
    off_m, off_deg = motion_differences(T_own, T_other)
    bad = _stands_out(off_m, linked) | _stands_out(off_deg, linked)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(np.int8)))
    segments = []
    for a, b in edges.reshape(-1, 2).tolist():
        most_m = float(off_m[a:b].max())
        most_deg = float(off_deg[a:b].max())
        segments.append(Segment(int(frames[a]), int(frames[b]), most_m, most_deg))
    return tuple(segments)


def _longest_piece(
    T_own: FloatArray, T_other: FloatArray, linked: BoolArray
) -> tuple[BoolArray, int]:
    """Return the rows (R,) of the longest segment without a gap in which no motion differs by more
    than its own length.

    And how many there are between gaps.
    """
    if len(T_own) < _MOTIONS.min_motions and linked.all():
        return np.ones(len(T_own), dtype=bool), 1
    moved_m = np.linalg.norm(np.diff(T_own[:, :3, 3], axis=0), axis=1)
    off_m, _ = motion_differences(T_own, T_other)
    broken = ~linked | _stands_out(off_m, linked) & (
        off_m > _MOTIONS.broken * np.maximum(moved_m, np.median(moved_m))
    )
    number = np.concatenate([[0], np.cumsum(broken)])
    piece: BoolArray = number == np.bincount(number).argmax()
    return piece, int((~linked).sum()) + 1


def motion_differences(T_own: FloatArray, T_other: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return by how much the motions between neighbouring poses (R, 4, 4) differ: (R - 1,)
    metres and degrees.
    """
    motion_own = se3_inverse(T_own[:-1]) @ T_own[1:]
    motion_other = se3_inverse(T_other[:-1]) @ T_other[1:]
    off_m: FloatArray = np.linalg.norm(motion_own[:, :3, 3] - motion_other[:, :3, 3], axis=1)
    return off_m, rotation_angle_deg(
        np.swapaxes(motion_own[:, :3, :3], 1, 2) @ motion_other[:, :3, :3]
    )


def _stands_out(values: FloatArray, linked: BoolArray) -> BoolArray:
    """Mask (R - 1,) of the values that stand out of those of steps without a gap."""
    usual = values[linked]
    if not len(usual):
        return np.zeros_like(linked)
    middle = float(np.median(usual))
    return linked & (
        values > middle + _MOTIONS.outlying * max(robust_sigma(usual - middle), 0.1 * middle, 1e-9)
    )


def _against(
    truth: GroundTruth, run: TrackedPath, rows: IntArray, T_other_cam0: FloatArray
) -> tuple[float | None, float | None, float | None]:
    """Return ATE and scale of the other poses, and ATE of the run.

    None where they cannot be compared.
    """
    own = take(run.trajectory, rows)
    other = replace(own, T_world_body=T_other_cam0)
    try:
        ate = truth.ate_m(other)
        of_run = truth.ate_m(own)
        scaled = evaluate(other, truth.trajectory, align="sim3", T_cam0_imu=truth.T_cam0_imu)
        scale = float(scaled.as_dict()["scale"])
    except EvaluationError:
        return None, None, None
    return ate, 1 / scale, of_run
