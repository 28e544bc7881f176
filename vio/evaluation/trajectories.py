"""Compare a trajectory with a reference: ATE, RPE, the KITTI drift metric, and NEES for filters.

Association is by nearest time or by frame number, one to one, without interpolation. `N` poses, `M` matched pairs.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from vio.errors import EvaluationError
from vio.evaluation.alignment import (
    Alignment,
    AlignMode,
    RotationSource,
    align_poses,
    apply_alignment,
    deviation_about_path,
    settle_rotation,
)
from vio.evaluation.reference_axes import attitude_note
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, so3_log
from vio.numerics.statistics import chi_square_quantile
from vio.records import NS_PER_S, BodyFrame, IntArray, Trajectory

AssociationMode: TypeAlias = Literal["time", "frame"]

KITTI_LENGTHS_M: tuple[float, ...] = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_STEP_FRAMES = 10
_MILLIMETRES_BELOW_M = 0.01  # lengths in words
_SHORT_M = 10.0  # over shorter lengths a drift for 100 m says nothing that a reader can picture
RPE_DISTANCE_TOLERANCE = 0.1  # relative tolerance of a pair's path length
_PATH_RATIO = 1.5  # ratio of path lengths above which the reference may be another recording's
_UNITS = {"millimetres": 1000.0, "centimetres": 100.0}
_UNIT_SHARE = 0.1  # a ratio of path lengths so near one of these is no chance; odometry without a scale has any ratio
_PATH_LEAST_M = 1.0  # paths below this may consist of noise
_MATCHED_SHARE = 0.5  # of the shorter trajectory; below, clocks or recordings may differ
_MATCHED_ESTIMATE = 0.2  # span of the matched poses, of the estimate; below, the figures are those of a part
LEAST_POSES = 3  # that determine a scale, and make a figure


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Summary of one error over all matched poses, in the unit given by its field name."""

    rmse: float
    mean: float
    median: float
    max: float


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Error of the motion between pairs of poses."""

    delta: float  # distance between the poses of a pair
    unit: Literal["frames", "m"]  # frames: matched poses; m: path length of the reference
    pairs: int
    trans_rmse_m: float
    rot_rmse_deg: float


@dataclass(frozen=True, slots=True)
class LengthError:
    """The KITTI metric for one path length; None where the record has no segment of this length."""

    length_m: float
    segments: int
    t_err_percent: float | None
    r_err_deg_per_100m: float | None


@dataclass(frozen=True, slots=True)
class KittiError:
    """The KITTI odometry metric: mean over all segments of all lengths."""

    t_err_percent: float
    r_err_deg_per_100m: float
    segments: int
    per_length: tuple[LengthError, ...]

    @property
    def lengths_m(self) -> tuple[float, ...]:
        """The path lengths of which the record has segments."""
        return tuple(row.length_m for row in self.per_length if row.segments)


@dataclass(frozen=True, slots=True)
class Coverage:
    """The compared share of estimate and reference."""

    estimate: float  # fraction of the estimate's poses that had a reference
    reference_span: float | None  # fraction of the reference's time (or frame) span between first and last match
    longest_gap_s: float | None  # between matched poses; None: one pose, or association by frame


@dataclass(frozen=True, slots=True)
class ScaleFree:
    """The scale of an estimate, and its error after a similarity alignment: a wrong baseline makes the scale alone."""

    scale: float  # of the estimate, over the reference's
    ate_m: float  # root mean square after a similarity alignment


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The evaluation of an estimate against a reference; undefined metrics are None."""

    align: AlignMode
    association: AssociationMode
    body: BodyFrame  # the body frame of both trajectories here: the reference's
    matched: int  # M
    coverage: Coverage
    path_length_m: float  # of the whole estimate, before any scaling
    matched_path_length_m: float  # of the estimate's matched poses, before any scaling
    reference_path_length_m: float  # of the reference's matched poses
    scale: float  # factor applied to the estimate; 1 unless align is sim3
    rotation_from: RotationSource  # what determined the rotation of T_ref_est, see `Alignment`
    ate_m: ErrorStatistics
    ate_deg: ErrorStatistics
    rpe: RelativeError | None  # over frames
    rpe_distance: RelativeError | None  # over metres, if requested
    kitti: KittiError | None  # None: the record is shorter than every length that was asked for, or than 1 m
    T_ref_est: FloatArray  # (4, 4) alignment of `settle_rotation`; under sim3 the estimate is scaled first
    rows: IntArray  # (M,) matched rows of the estimate
    errors_m: FloatArray  # (M,) distance to the reference after the alignment of `align_poses`, the least squares
    errors_deg: FloatArray  # (M,) rotation angle to the reference after alignment by T_ref_est
    aligned: Trajectory  # the whole estimate (N) in the reference's world and body frame, by T_ref_est
    reference: Trajectory  # the matched poses (M) of the reference; row k matches row rows[k] of the estimate
    scale_free: ScaleFree | None = None  # None: positions do not determine a scale
    notes: tuple[str, ...] = ()  # signs of a reference of another recording, or in other conventions

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON: `ate_m` is the RMSE, undefined metrics are None, arrays are omitted."""
        return {
            "align": self.align,
            "association": self.association,
            "body": self.body,
            "matched": self.matched,
            "coverage": _as_plain_dict(self.coverage),
            "path_length_m": self.path_length_m,
            "matched_path_length_m": self.matched_path_length_m,
            "reference_path_length_m": self.reference_path_length_m,
            "scale": self.scale,
            "rotation_from": self.rotation_from,
            "ate_m": self.ate_m.rmse,
            "ate_deg": self.ate_deg.rmse,
            "scale_free": _as_plain_dict(self.scale_free),
            "ate_statistics_m": _as_plain_dict(self.ate_m),
            "ate_statistics_deg": _as_plain_dict(self.ate_deg),
            "rpe": _as_plain_dict(self.rpe),
            "rpe_distance": _as_plain_dict(self.rpe_distance),
            "t_err_percent": None if self.kitti is None else self.kitti.t_err_percent,
            "r_err_deg_per_100m": None if self.kitti is None else self.kitti.r_err_deg_per_100m,
            "drift_lengths_m": [] if self.kitti is None else list(self.kitti.lengths_m),
            "kitti_segments": 0 if self.kitti is None else self.kitti.segments,
            "kitti_per_length": [] if self.kitti is None else [_as_plain_dict(row) for row in self.kitti.per_length],
            "notes": list(self.notes),
        }


def evaluate(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    align: AlignMode = "se3",
    lengths_m: Sequence[float] | None = None,
    max_time_difference_s: float = 0.01,
    T_cam0_imu: npt.ArrayLike | None = None,
    rpe_delta_frames: int = 1,
    rpe_delta_m: float | None = None,
) -> Evaluation:
    """Evaluate an estimate against a reference, in the frame (cam0 or IMU) that the reference describes.

    Args:
        estimate: N poses.
        reference: associated by time where both have times, else by frame number; it may cover part of the estimate.
        align: rigid, rigid with scale, the first matched poses made equal, or none (both must then describe the same
            body in the same world). All metrics are those of the aligned estimate, so `sim3` removes the scale error
            from the relative ones too.
        lengths_m: path lengths of the KITTI metric; None: KITTI's 100 to 800 m, and where the reference's path is
            too short for all of them, the first set with a segment of 10 to 80 m and 1 to 8 m. `KittiError.lengths_m`
            names them: drift over short lengths contains more of the noise of single poses.
        max_time_difference_s: poses further apart in time are not compared.
        T_cam0_imu: extrinsic (4, 4), needed where the two trajectories describe different frames.
        rpe_delta_frames: distance of the pairs of `Evaluation.rpe`, in matched poses.
        rpe_delta_m: distance of the pairs of `Evaluation.rpe_distance`, in metres of the reference's path.

    Raises:
        EvaluationError: nothing to compare, different frames without an extrinsic or without an alignment, non-finite
            poses, or an alignment that the data do not determine (the scale of a motionless estimate).
    """
    if align not in get_args(AlignMode):
        raise EvaluationError(f"unknown alignment {align!r}; choose one of {', '.join(get_args(AlignMode))}")
    _require_finite("estimate", estimate)
    _require_finite("reference", reference)
    if align == "none" and estimate.body != reference.body:
        raise EvaluationError(
            f"align none needs both in one world, but the estimate describes {estimate.body} and the reference "
            f"{reference.body}, whose world frames differ; take align first, or se3"
        )
    moved = _in_frame_of(estimate, reference, T_cam0_imu)
    association, rows, reference_rows = associate(moved, reference, max_time_difference_s=max_time_difference_s)
    T_est, T_ref = moved.T_world_body[rows], reference.T_world_body[reference_rows]
    closest = align_poses(T_est, T_ref, align)
    errors_m = np.linalg.norm(apply_alignment(closest, T_est)[:, :3, 3] - T_ref[:, :3, 3], axis=1)
    alignment = settle_rotation(closest, T_est, T_ref)
    aligned = replace(moved, T_world_body=apply_alignment(alignment, moved.T_world_body))
    T_aligned = aligned.T_world_body[rows]
    errors_deg = rotation_angle_deg(se3_inverse(T_ref) @ T_aligned)
    return Evaluation(
        align=align,
        association=association,
        body=reference.body,
        matched=len(rows),
        coverage=_coverage(moved, reference, association, rows, reference_rows),
        path_length_m=path_length_m(moved.positions),
        matched_path_length_m=path_length_m(T_est[:, :3, 3]),
        reference_path_length_m=path_length_m(T_ref[:, :3, 3]),
        scale=alignment.scale,
        rotation_from=alignment.rotation_from,
        ate_m=error_statistics(errors_m),
        ate_deg=error_statistics(errors_deg),
        rpe=relative_error_frames(T_aligned, T_ref, rpe_delta_frames),
        rpe_distance=None if rpe_delta_m is None else relative_error_distance(T_aligned, T_ref, rpe_delta_m),
        kitti=_drift(T_aligned, T_ref) if lengths_m is None else kitti_error(T_aligned, T_ref, lengths_m),
        T_ref_est=se3_from_parts(alignment.R, alignment.t),
        rows=rows,
        errors_m=errors_m,
        errors_deg=errors_deg,
        aligned=aligned,
        reference=_take(reference, reference_rows),
        scale_free=_scale_free(T_est, T_ref),
        notes=(
            *_notes(path_length_m(T_aligned[:, :3, 3]), path_length_m(T_ref[:, :3, 3]), rows, moved, reference),
            *_attitude_notes(alignment, T_est, T_ref, T_aligned),
        ),
    )


def associate(
    estimate: Trajectory, reference: Trajectory, *, max_time_difference_s: float = 0.01
) -> tuple[AssociationMode, IntArray, IntArray]:
    """Pair poses one to one: the mode, rows of the estimate (M,) and rows of the reference (M,), M >= 1.

    By time where both have times, else by frame number: row k of a trajectory without frame numbers is frame k.

    Raises:
        EvaluationError: no poses match.
    """
    if len(estimate) == 0 or len(reference) == 0:
        raise EvaluationError(f"cannot compare {len(estimate)} estimated poses with {len(reference)} reference poses")
    if estimate.times_ns is not None and reference.times_ns is not None:
        rows, reference_rows = associate_times(
            estimate.times_ns, reference.times_ns, max_difference_ns=_max_difference_ns(max_time_difference_s)
        )
        if len(rows) == 0:
            raise EvaluationError(_no_common_time(estimate.times_ns, reference.times_ns, max_time_difference_s))
        return "time", rows, reference_rows
    if reference.times_ns is not None and reference.frame_indices is None and len(estimate) != len(reference):
        raise EvaluationError(
            f"the estimate has {len(estimate)} poses without times and the reference {len(reference)} poses with times "
            "but no frame numbers; give the estimate with times (TUM form)"
        )
    frames, reference_frames = _frames(estimate), _frames(reference)
    _, rows, reference_rows = np.intersect1d(frames, reference_frames, assume_unique=True, return_indices=True)
    if len(rows) == 0:
        raise EvaluationError(
            f"no common frame: the estimate has frames {frames[0]} to {frames[-1]}, the reference "
            f"{reference_frames[0]} to {reference_frames[-1]}; give the reference of this recording"
        )
    return "frame", rows.astype(np.int64), reference_rows.astype(np.int64)


def associate_times(
    times_a_ns: npt.ArrayLike, times_b_ns: npt.ArrayLike, *, max_difference_ns: int
) -> tuple[IntArray, IntArray]:
    """Pair two increasing clocks one to one and in order, closest pairs first; return row indices (M,) into each.

    A pair is at most `max_difference_ns` apart. Of equally close pairs the earlier one is chosen.
    """
    a, b = np.asarray(times_a_ns, dtype=np.int64), np.asarray(times_b_ns, dtype=np.int64)
    low = np.searchsorted(b, a - max_difference_ns, side="left")
    count = np.searchsorted(b, a + max_difference_ns, side="right") - low
    i = np.repeat(np.arange(len(a)), count)
    j = np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(low, count)
    order = np.lexsort((j, i, np.abs(a[i] - b[j])))
    left: list[int] = []  # both stay ascending
    right: list[int] = []
    for row_a, row_b in zip(i[order].tolist(), j[order].tolist(), strict=True):
        k = bisect_left(left, row_a)
        free = k == len(left) or (left[k] != row_a and right[k] > row_b)
        if free and (k == 0 or right[k - 1] < row_b):
            left.insert(k, row_a)
            right.insert(k, row_b)
    return np.array(left, dtype=np.int64), np.array(right, dtype=np.int64)


def _scale_free(T_est: FloatArray, T_ref: FloatArray) -> ScaleFree | None:
    """Return the scale of M poses (M, 4, 4) and their error without it; None with too few poses or without motion."""
    if len(T_est) < LEAST_POSES:
        return None
    try:
        fit = align_poses(T_est, T_ref, "sim3")
    except EvaluationError:
        return None
    errors = np.linalg.norm(apply_alignment(fit, T_est)[:, :3, 3] - T_ref[:, :3, 3], axis=1)
    return ScaleFree(1 / fit.scale, error_statistics(errors).rmse)


def relative_error_frames(T_est: FloatArray, T_ref: FloatArray, delta: int) -> RelativeError | None:
    """Relative pose error over every pair `delta` poses apart (M, 4, 4); None where there is no such pair.

    Raises:
        EvaluationError: `delta` is not positive.

    Reference: Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS (2012).
    """
    if delta < 1:
        raise EvaluationError(f"the distance of a pair must be at least 1 frame, got {delta}")
    first = np.arange(max(len(T_ref) - delta, 0))
    return _relative_error(T_est, T_ref, first, first + delta, float(delta), "frames")


def relative_error_distance(T_est: FloatArray, T_ref: FloatArray, delta_m: float) -> RelativeError | None:
    """Relative pose error over pairs `delta_m` of the reference's path apart; None where there is no such pair.

    Each pose is paired with the later one whose path length from it comes closest, within
    `RPE_DISTANCE_TOLERANCE` of `delta_m`.

    Raises:
        EvaluationError: `delta_m` is not positive.
    """
    if not (np.isfinite(delta_m) and delta_m > 0):
        raise EvaluationError(f"the distance of a pair must be positive, got {delta_m:g} m")
    travelled = _cumulative_path_length(T_ref[:, :3, 3])
    n = len(travelled)
    first = np.arange(n)
    target = travelled + delta_m
    beyond = np.searchsorted(travelled, target, side="left")
    before = np.searchsorted(travelled, travelled[beyond - 1], side="left")  # the first of poses at one position
    gap_before = target - travelled[before]
    gap_beyond = np.where(beyond < n, travelled[np.minimum(beyond, n - 1)] - target, np.inf)
    last = np.where(gap_before <= gap_beyond, before, beyond)
    close = np.minimum(gap_before, gap_beyond) <= RPE_DISTANCE_TOLERANCE * delta_m
    return _relative_error(T_est, T_ref, first[close], last[close], delta_m, "m")


def kitti_error(
    T_est: FloatArray,
    T_ref: FloatArray,
    lengths_m: Sequence[float] = KITTI_LENGTHS_M,
    step_frames: int = KITTI_STEP_FRAMES,
) -> KittiError | None:
    """Compute the drift over segments of given path lengths, of paired poses (M, 4, 4); None where no segment fits.

    A segment starts at every `step_frames`-th pose and ends at the first one more than the length further along
    the reference's path. Its errors are divided by the length.

    Raises:
        EvaluationError: a length or the step is not positive.

    Reference: Geiger, Lenz & Urtasun, Are we ready for autonomous driving?, CVPR (2012), and its development kit.
    """
    if not all(np.isfinite(length) and length > 0 for length in lengths_m) or step_frames < 1:
        raise EvaluationError(f"segment lengths and step must be positive, got {list(lengths_m)} m, {step_frames}")
    travelled = _cumulative_path_length(T_ref[:, :3, 3])
    per_length: list[LengthError] = []
    all_trans: list[FloatArray] = []
    all_rot: list[FloatArray] = []
    for length in lengths_m:
        first = np.arange(0, len(travelled), step_frames)
        last = np.searchsorted(travelled, travelled[first] + length, side="right")
        first, last = first[last < len(travelled)], last[last < len(travelled)]
        trans_m, rot_deg = _motion_errors(T_est, T_ref, first, last)
        all_trans.append(100 * trans_m / length)
        all_rot.append(100 * rot_deg / length)
        found = len(first) > 0
        per_length.append(
            LengthError(
                float(length),
                len(first),
                float(all_trans[-1].mean()) if found else None,
                float(all_rot[-1].mean()) if found else None,
            )
        )
    segments = sum(row.segments for row in per_length)
    if segments == 0:
        return None
    t_err, r_err = np.concatenate(all_trans).mean(), np.concatenate(all_rot).mean()
    return KittiError(float(t_err), float(r_err), segments, tuple(per_length))


def metres_text(value_m: float) -> str:
    """Return a length with its unit: millimetres below a centimetre, else metres with three decimals."""
    return f"{1e3 * value_m:.3g} mm" if value_m < _MILLIMETRES_BELOW_M else f"{value_m:.3f} m"


def lengths_text(lengths_m: Sequence[float]) -> str:
    """Return path lengths in words: `10 to 50 m`."""
    first, last = min(lengths_m), max(lengths_m)
    return f"{first:g} m" if first == last else f"{first:g} to {last:g} m"


def rotation_drift_text(deg_per_100m: float, lengths_m: Sequence[float], digits: int = 3) -> str:
    """Return a drift of rotation with its unit: `0.039 deg/100 m`, or by the metre where no length has ten metres."""
    if max(lengths_m) < _SHORT_M:
        return f"{deg_per_100m / 100:.{digits}f} deg/m"
    return f"{deg_per_100m:.{digits}f} deg/100 m"


def _drift(T_est: FloatArray, T_ref: FloatArray) -> KittiError | None:
    """Compute the drift over KITTI's lengths, or where no segment fits over a tenth or a hundredth of them."""
    for divisor in (1, 10, 100):
        if error := kitti_error(T_est, T_ref, [length / divisor for length in KITTI_LENGTHS_M]):
            return error
    return None


def error_statistics(errors: npt.ArrayLike) -> ErrorStatistics:
    """Summarise errors (M,), M >= 1."""
    e = np.asarray(errors, dtype=np.float64)
    rmse = float(np.sqrt(np.mean(e * e)))
    return ErrorStatistics(rmse, float(e.mean()), float(np.median(e)), float(e.max()))


def rotation_angle_deg(R: npt.ArrayLike) -> FloatArray:
    """Angles (...,) in [0, 180] degrees of rotations (..., 3, 3) or transforms (..., 4, 4)."""
    return np.degrees(np.linalg.norm(so3_log(np.asarray(R, dtype=np.float64)[..., :3, :3]), axis=-1))


def path_length_m(positions: npt.ArrayLike) -> float:
    """Length of the polygon through positions (N, 3), metres; 0 for fewer than two."""
    return float(np.linalg.norm(np.diff(np.asarray(positions, dtype=np.float64), axis=0), axis=1).sum())


def nees(errors: npt.ArrayLike, covariances: npt.ArrayLike) -> FloatArray:
    """Normalised estimation error squared `e^T P^-1 e` (N,) of errors (N, d) and covariances (N, d, d).

    Raises:
        EvaluationError: a covariance is not positive definite.

    Reference: Bar-Shalom, Li & Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 5.4.
    """
    e, P = np.asarray(errors, dtype=np.float64), np.asarray(covariances, dtype=np.float64)
    if e.ndim != 2 or P.shape != (*e.shape, e.shape[1]):
        raise EvaluationError(f"NEES needs errors (N, d) and covariances (N, d, d), got {e.shape} and {P.shape}")
    if not (np.isfinite(e).all() and np.isfinite(P).all()):
        raise EvaluationError("NEES of errors or covariances that are not finite; the filter has diverged")
    try:
        L = np.linalg.cholesky(P)
    except np.linalg.LinAlgError as error:
        worst = int(np.argmin(np.linalg.eigvalsh(P)[:, 0]))
        raise EvaluationError(f"covariance {worst} is not positive definite; the filter is inconsistent") from error
    whitened = np.linalg.solve(L, e[..., None])[..., 0]
    out: FloatArray = np.sum(whitened * whitened, axis=1)
    return out


def nees_bounds(d: int, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Two-sided bounds of the NEES of a consistent d-dimensional estimate, averaged over independent runs.

    Raises:
        EvaluationError: an argument out of range.
    """
    if d < 1 or runs < 1 or not 0 < confidence < 1:
        raise EvaluationError(f"NEES bounds need d, runs >= 1 and 0 < confidence < 1, got {d}, {runs}, {confidence:g}")
    tail = (1 - confidence) / 2
    low, high = chi_square_quantile([tail, 1 - tail], d * runs) / runs
    return float(low), float(high)


def _as_plain_dict(record: Any) -> Any:
    """Convert a flat record of numbers to a dict; None stays None."""
    return {f.name: getattr(record, f.name) for f in fields(record)} if is_dataclass(record) else record


_FARTHEST_M = 1e12  # of a position from the origin: farther than the sun, and squares do not overflow
_LONGEST_S = 1e9  # fits integer nanoseconds


def _require_finite(name: str, trajectory: Trajectory) -> None:
    bad = ~(np.abs(trajectory.T_world_body.reshape(-1, 16)) < _FARTHEST_M).all(axis=1)
    if bad.any():
        raise EvaluationError(
            f"pose {int(np.argmax(bad))} of the {name} is not finite ({int(bad.sum())} of {len(trajectory)} are not); "
            "remove such poses or check why the estimator diverged"
        )


def _in_frame_of(estimate: Trajectory, reference: Trajectory, T_cam0_imu: npt.ArrayLike | None) -> Trajectory:
    """Return the estimate in the reference's body frame, so that no lever arm enters the errors."""
    if estimate.body == reference.body:
        return estimate
    if T_cam0_imu is None:
        raise EvaluationError(
            f"the estimate describes {estimate.body} and the reference {reference.body}; give the extrinsic T_cam0_imu"
        )
    T = np.asarray(T_cam0_imu, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise EvaluationError(f"T_cam0_imu must be a finite 4x4 transform, got shape {T.shape}")
    return estimate.in_cam0(T) if reference.body == "cam0" else estimate.in_imu(T)


def _max_difference_ns(seconds: float) -> int:
    if not 0 <= seconds <= _LONGEST_S:
        raise EvaluationError(f"the largest time difference is 0 to {_LONGEST_S:g} s, got {seconds:g} s")
    return round(seconds * NS_PER_S)


def _no_common_time(estimate_ns: IntArray, reference_ns: IntArray, limit_s: float) -> str:
    """Format how the two clocks relate to each other."""
    after = np.searchsorted(reference_ns, estimate_ns)
    left, right = np.clip(after - 1, 0, None), np.clip(after, None, len(reference_ns) - 1)
    nearest = np.minimum(np.abs(estimate_ns - reference_ns[left]), np.abs(estimate_ns - reference_ns[right]))
    spans = [f"{t[0] / NS_PER_S:.3f} to {t[-1] / NS_PER_S:.3f} s" for t in (estimate_ns, reference_ns)]
    return (
        f"no poses within {limit_s:g} s of each other: the estimate covers {spans[0]}, the reference {spans[1]}, "
        f"closest pair {nearest.min() / NS_PER_S:.6g} s; check the clocks or allow a larger difference"
    )


def _frames(trajectory: Trajectory) -> IntArray:
    if trajectory.frame_indices is not None:
        return trajectory.frame_indices
    return np.arange(len(trajectory), dtype=np.int64)


def _coverage(
    estimate: Trajectory, reference: Trajectory, mode: AssociationMode, rows: IntArray, reference_rows: IntArray
) -> Coverage:
    clock = reference.times_ns if mode == "time" and reference.times_ns is not None else _frames(reference)
    span = int(clock[-1] - clock[0])
    gaps = None if estimate.times_ns is None else np.diff(estimate.times_ns[rows])
    return Coverage(
        estimate=len(rows) / len(estimate),
        reference_span=int(clock[reference_rows[-1]] - clock[reference_rows[0]]) / span if span else None,
        longest_gap_s=None if gaps is None or len(gaps) == 0 else int(gaps.max()) / NS_PER_S,
    )


def _take(trajectory: Trajectory, rows: IntArray) -> Trajectory:
    return replace(
        trajectory,
        T_world_body=trajectory.T_world_body[rows],
        times_ns=None if trajectory.times_ns is None else trajectory.times_ns[rows],
        frame_indices=_frames(trajectory)[rows],
    )


def _notes(
    estimate_m: float, reference_m: float, rows: IntArray, estimate: Trajectory, reference: Trajectory
) -> tuple[str, ...]:
    """Name signs that the reference belongs to another recording."""
    notes = []
    short, long = sorted((estimate_m, reference_m))
    if long > _PATH_LEAST_M and long > _PATH_RATIO * short:
        units = {name: size for name, size in _UNITS.items() if abs(long / max(short, 1e-12) / size - 1) < _UNIT_SHARE}
        which = "the reference" if reference_m > estimate_m else "the estimate"
        what = f"{which} seems to be in {next(iter(units))}" if units else "is it the reference of this recording?"
        notes.append(
            f"over the same poses the estimate travels {estimate_m:.1f} m and the reference {reference_m:.1f} m; {what}"
        )
    span = float(rows[-1] - rows[0]) / max(len(estimate) - 1, 1)
    if len(estimate) > 1 and span < _MATCHED_ESTIMATE:
        notes.append(f"the reference covers {100 * span:.0f} % of the estimate: the figures are those of this part")
    shorter = min(len(estimate), len(reference))
    if len(rows) < _MATCHED_SHARE * shorter:
        notes.append(
            f"only {len(rows)} poses match, of {len(estimate)} of the estimate and {len(reference)} of the reference; "
            "is it the reference of this recording, on the same clock?"
        )
    return tuple(notes)


def _attitude_notes(
    alignment: Alignment, T_est: FloatArray, T_ref: FloatArray, T_aligned: FloatArray
) -> tuple[str, ...]:
    """Name what explains a large attitude error of M poses (M, 4, 4) whose positions were aligned."""
    if alignment.rotation_from not in ("positions", "direction and orientations"):
        return ()
    sigma = deviation_about_path(alignment, T_est, T_ref)[1] if alignment.rotation_from == "positions" else 0.0
    note = attitude_note(T_aligned[:, :3, :3], T_ref[:, :3, :3], sigma)
    return () if note is None else (note,)


def _cumulative_path_length(positions: FloatArray) -> FloatArray:
    """Path length (M,) from the first position to each, metres."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([np.zeros(1), np.cumsum(steps)])


def _motion_errors(
    T_est: FloatArray, T_ref: FloatArray, first: npt.NDArray[np.intp], last: npt.NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """Translation (metres) and rotation (degrees) errors (K,) of the motions from poses `first` to poses `last`."""
    motion_ref = se3_inverse(T_ref[first]) @ T_ref[last]
    motion_est = se3_inverse(T_est[first]) @ T_est[last]
    error = se3_inverse(motion_ref) @ motion_est
    return np.linalg.norm(error[:, :3, 3], axis=1), rotation_angle_deg(error)


def _relative_error(
    T_est: FloatArray,
    T_ref: FloatArray,
    first: npt.NDArray[np.intp],
    last: npt.NDArray[np.intp],
    delta: float,
    unit: Literal["frames", "m"],
) -> RelativeError | None:
    if len(first) == 0:
        return None
    trans_m, rot_deg = _motion_errors(T_est, T_ref, first, last)
    return RelativeError(delta, unit, len(first), error_statistics(trans_m).rmse, error_statistics(rot_deg).rmse)
