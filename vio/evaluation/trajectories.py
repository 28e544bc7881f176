"""Compare a trajectory with a reference: ATE, RPE and the KITTI drift metric. `N` poses, `M`
matched pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, is_dataclass, replace
from typing import Any, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.errors import EvaluationError
from vio.evaluation.alignment import (
    Alignment,
    AlignMode,
    RotationSource,
    align_poses,
    apply_alignment,
    deviation_about_path,
    extent_m,
    settle_rotation,
)
from vio.evaluation.association import AssociationMode, Coverage, associate, coverage, take
from vio.evaluation.errors_along_path import (
    ErrorStatistics,
    KittiError,
    RelativeError,
    drift,
    error_statistics,
    kitti_error,
    path_length_m,
    relative_error_distance,
    relative_error_frames,
    rotation_angle_deg,
)
from vio.evaluation.quaternion_order import settled_orders
from vio.evaluation.reference_axes import attitude_note
from vio.evaluation.reference_faults import lever_arm_note, position_fault
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.records import NS_PER_S, BodyFrame, IntArray, Trajectory


class _WordingRules(NamedTuple):
    """How figures are stated."""

    millimetres_below_m: float = 0.01  # lengths in words
    # over shorter lengths a drift for 100 m says nothing that a reader can picture
    short_m: float = 10.0
    # of a position from the origin: farther than the sun, and squares do not overflow
    farthest_m: float = 1e12


_WORDING = _WordingRules()


@dataclass(frozen=True, slots=True)
class _SuspicionRules:
    """When a reference is called one of another unit, clock or recording."""

    # ratio of path lengths above which the reference may be another recording's
    path_ratio: float = 1.5
    # a ratio of path lengths so near one of these is no chance; odometry without a scale has any
    # ratio
    unit_share: float = 0.1
    # of the extent of the reference: error after an alignment with scale, below which shapes agree
    alike_share: float = 0.05
    path_min_m: float = 1.0  # paths below this may consist of noise
    matched_share: float = 0.5  # of the shorter trajectory; below, clocks or recordings may differ
    # span of the matched poses, of the estimate; below, the figures are those of a part
    matched_estimate: float = 0.2


_SUSPECT = _SuspicionRules()
_UNITS = {"millimetres": 1000.0, "centimetres": 100.0}
# Of an evaluation, as it holds them.
_FIGURES = (
    *(
        "align",
        "association",
        "body",
        "matched",
        "coverage",
        "path_length_m",
        "matched_path_length_m",
    ),
    *("reference_path_length_m", "scale", "rotation_from"),
)
MIN_POSES = 3  # that determine a scale, and make a figure


@dataclass(frozen=True, slots=True)
class ScaleFree:
    """The scale of an estimate, and its error after a similarity alignment: a wrong baseline
    makes the scale alone.
    """

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
    # None: the record is shorter than every length that was asked for, or than 1 m
    kitti: KittiError | None
    # (4, 4) alignment of `settle_rotation`; under sim3 the estimate is scaled first
    T_ref_est: FloatArray
    rows: IntArray  # (M,) matched rows of the estimate
    # (M,) distance to the reference after the alignment of `align_poses`, the least squares
    errors_m: FloatArray
    errors_deg: FloatArray  # (M,) rotation angle to the reference after alignment by T_ref_est
    # the whole estimate (N) in the reference's world and body frame, by T_ref_est
    aligned: Trajectory
    # the matched poses (M) of the reference; row k matches row rows[k] of the estimate
    reference: Trajectory
    scale_free: ScaleFree | None = None  # None: positions do not determine a scale
    # signs of a reference of another recording, or in other conventions
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON: `ate_m` is the RMSE, undefined metrics are None, arrays
        are omitted.
        """
        kitti = self.kitti
        return {
            **{name: _plain(getattr(self, name)) for name in _FIGURES},
            "ate_m": self.ate_m.rmse,
            "ate_deg": self.ate_deg.rmse,
            "scale_free": _plain(self.scale_free),
            "ate_statistics_m": asdict(self.ate_m),
            "ate_statistics_deg": asdict(self.ate_deg),
            "rpe": _plain(self.rpe),
            "rpe_distance": _plain(self.rpe_distance),
            "t_err_percent": None if kitti is None else kitti.t_err_percent,
            "r_err_deg_per_100m": None if kitti is None else kitti.r_err_deg_per_100m,
            "drift_lengths_m": [] if kitti is None else list(kitti.lengths_m),
            "kitti_segments": 0 if kitti is None else kitti.segments,
            "kitti_per_length": [] if kitti is None else [asdict(row) for row in kitti.per_length],
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
    """Evaluate an estimate against a reference, in the frame (cam0 or IMU) that the reference
    describes.

    Args:
        estimate: N poses.
        reference: associated by time where both have times, else by frame number; it may cover part
            of the estimate.
        align: rigid, rigid with scale, the first matched poses made equal, or none (both must then
            describe the same body in the same world). All metrics are those of the aligned
            estimate, so `sim3` removes the scale error from the relative ones too.
        lengths_m: path lengths of the KITTI metric; None: KITTI's 100 to 800 m, and where the
            reference's path is too short for all of them, the first set with a segment of 10 to 80
            m and 1 to 8 m. `KittiError.lengths_m` names them: drift over short lengths contains
            more of the noise of single poses.
        max_time_difference_s: poses further apart in time are not compared.
        T_cam0_imu: extrinsic (4, 4), needed where the two trajectories describe different frames.
        rpe_delta_frames: distance of the pairs of `Evaluation.rpe`, in matched poses.
        rpe_delta_m: distance of the pairs of `Evaluation.rpe_distance`, in metres of the
            reference's path.

    Raises:
        EvaluationError: nothing to compare, different frames without an extrinsic or without an
            alignment, non-finite poses, or an alignment that the data do not determine (the scale
            of a motionless estimate).
        TypeError: one is no trajectory, such as the path of one.
    """
    for name, given in (("estimate", estimate), ("reference", reference)):
        if not isinstance(given, Trajectory):
            raise TypeError(
                f"{name}: give a Trajectory, as vio.run(...).trajectory or "
                f"vio.files.trajectories.read_trajectory(path), not {type(given).__name__}"
            )
    if align not in get_args(AlignMode):
        raise EvaluationError(
            f"unknown alignment {align!r}; choose one of {', '.join(get_args(AlignMode))}"
        )
    _require_finite("estimate", estimate)
    _require_finite("reference", reference)
    if align == "none" and estimate.body != reference.body:
        raise EvaluationError(
            f"align none needs both in one world, but the estimate describes {estimate.body} and "
            "the reference "
            f"{reference.body}, whose world frames differ; take align first, or se3"
        )
    estimate, reference, order_notes = settled_orders(estimate, reference, max_time_difference_s)
    association, rows, reference_rows = associate(
        estimate, reference, max_time_difference_s=max_time_difference_s
    )
    moved = _in_frame_of(estimate, reference, T_cam0_imu)
    T_est = moved.T_world_body[rows]
    T_ref = reference.T_world_body[reference_rows]
    closest = align_poses(T_est, T_ref, align)
    errors_m = np.linalg.norm(apply_alignment(closest, T_est)[:, :3, 3] - T_ref[:, :3, 3], axis=1)
    alignment = settle_rotation(closest, T_est, T_ref)
    aligned = replace(moved, T_world_body=apply_alignment(alignment, moved.T_world_body))
    T_aligned = aligned.T_world_body[rows]
    errors_deg = rotation_angle_deg(se3_inverse(T_ref) @ T_aligned)
    fault = position_fault(moved, reference, T_est, T_ref, _clock_of(reference, reference_rows))
    scale_free = _scale_free(T_est, T_ref)
    return Evaluation(
        align=align,
        association=association,
        body=reference.body,
        matched=len(rows),
        coverage=coverage(moved, reference, association, rows, reference_rows),
        path_length_m=path_length_m(moved.positions),
        matched_path_length_m=path_length_m(T_est[:, :3, 3]),
        reference_path_length_m=path_length_m(T_ref[:, :3, 3]),
        scale=alignment.scale,
        rotation_from=alignment.rotation_from,
        ate_m=error_statistics(errors_m),
        ate_deg=error_statistics(errors_deg),
        rpe=relative_error_frames(T_aligned, T_ref, rpe_delta_frames),
        rpe_distance=None
        if rpe_delta_m is None
        else relative_error_distance(T_aligned, T_ref, rpe_delta_m),
        kitti=drift(T_aligned, T_ref)
        if lengths_m is None
        else kitti_error(T_aligned, T_ref, lengths_m),
        T_ref_est=se3_from_parts(alignment.R, alignment.t),
        rows=rows,
        errors_m=errors_m,
        errors_deg=errors_deg,
        aligned=aligned,
        reference=take(reference, reference_rows),
        scale_free=scale_free,
        notes=(
            *_notes(
                path_length_m(T_aligned[:, :3, 3]),
                path_length_m(T_ref[:, :3, 3]),
                rows,
                moved,
                reference,
                scale_free,
            ),
            *(_row_note(moved, reference) if association == "frame" else ()),
            *order_notes,
            *(
                ((fault,) if fault is not None else ())
                or _positions_alone(estimate, reference)
                or (
                    *_attitude_notes(alignment, T_est, T_ref, T_aligned),
                    *_arm_notes(T_est, T_ref, scale_free),
                )
            ),
        ),
    )


def _clock_of(reference: Trajectory, rows: IntArray) -> IntArray:
    """Return the times of rows (M,), or the numbers of their frames where there are none."""
    chosen = take(reference, rows)
    clock = chosen.frame_indices if chosen.times_ns is None else chosen.times_ns
    assert clock is not None  # rows are numbered
    return clock


def _scale_free(T_est: FloatArray, T_ref: FloatArray) -> ScaleFree | None:
    """Return the scale of M poses (M, 4, 4) and their error without it.

    None with too few poses or without motion.
    """
    if len(T_est) < MIN_POSES:
        return None
    try:
        fit = align_poses(T_est, T_ref, "sim3")
    except EvaluationError:
        return None
    errors = np.linalg.norm(apply_alignment(fit, T_est)[:, :3, 3] - T_ref[:, :3, 3], axis=1)
    return ScaleFree(1 / fit.scale, error_statistics(errors).rmse)


def metres_text(value_m: float) -> str:
    """Return a length with its unit: millimetres below a centimetre, else metres with three
    decimals.
    """
    return metres_texts(value_m)[0]


def metres_texts(*values_m: float) -> list[str]:
    """Return lengths that are compared with one another, all in the unit of the smallest."""
    if min(values_m, default=np.inf) < _WORDING.millimetres_below_m:
        return [f"{1e3 * v:.0f} mm" if v >= 1.0 else f"{1e3 * v:.3g} mm" for v in values_m]
    return [f"{v:.3f} m" for v in values_m]


def lengths_text(lengths_m: Sequence[float]) -> str:
    """Return path lengths in words: `10 to 50 m`."""
    first = min(lengths_m)
    last = max(lengths_m)
    if first == last:
        return f"{first:g} m"
    return f"{first:g} to {last:g} m"


def rotation_drift_text(deg_per_100m: float, lengths_m: Sequence[float], digits: int = 3) -> str:
    """Return a drift of rotation with its unit: `0.039 deg/100 m`, or by the metre where no
    length has ten metres.
    """
    if max(lengths_m) < _WORDING.short_m:
        return f"{deg_per_100m / 100:.{digits}f} deg/m"
    return f"{deg_per_100m:.{digits}f} deg/100 m"


def _plain(value: Any) -> Any:
    """Return a record as a dictionary, and anything else as it is."""
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return value


def _require_finite(name: str, trajectory: Trajectory) -> None:
    bad = ~(np.abs(trajectory.T_world_body.reshape(-1, 16)) < _WORDING.farthest_m).all(axis=1)
    if bad.any():
        raise EvaluationError(
            f"pose {int(np.argmax(bad))} of the {name} is not finite ({int(bad.sum())} of "
            f"{len(trajectory)} are not); "
            "remove such poses or check why the estimator diverged"
        )


def _in_frame_of(
    estimate: Trajectory, reference: Trajectory, T_cam0_imu: npt.ArrayLike | None
) -> Trajectory:
    """Return the estimate in the reference's body frame, so that no lever arm enters the errors."""
    if estimate.body == reference.body:
        return estimate
    if T_cam0_imu is None:
        raise EvaluationError(
            f"the estimate describes {estimate.body} and the reference {reference.body}; give the "
            "extrinsic T_cam0_imu"
        )
    T = np.asarray(T_cam0_imu, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise EvaluationError(f"T_cam0_imu must be a finite 4x4 transform, got shape {T.shape}")
    if reference.body == "cam0":
        return estimate.in_cam0(T)
    return estimate.in_imu(T)


def _notes(
    estimate_m: float,
    reference_m: float,
    rows: IntArray,
    estimate: Trajectory,
    reference: Trajectory,
    scale_free: ScaleFree | None,
) -> tuple[str, ...]:
    """Name signs that the reference belongs to another recording, or has another scale."""
    notes = []
    short, long = sorted((estimate_m, reference_m))
    if long > _SUSPECT.path_min_m and long > _SUSPECT.path_ratio * short:
        units = {
            name: size
            for name, size in _UNITS.items()
            if abs(long / max(short, 1e-12) / size - 1) < _SUSPECT.unit_share
        }
        which = "the reference" if reference_m > estimate_m else "the estimate"
        if units:
            what = f"{which} seems to be in {next(iter(units))}"
        elif scale_free is not None and scale_free.ate_m < _SUSPECT.alike_share * (
            extent_m(estimate.T_world_body[rows, :3, 3]) / scale_free.scale
        ):
            what = (
                f"scaled by {1 / scale_free.scale:.3g}, the estimate follows it to "
                f"{metres_text(scale_free.ate_m)}: its lengths have no scale, as of one camera alone, "
                "or a wrong one (baseline, unit of a calibration); --align sim3 leaves it out"
            )
        else:
            what = "is it the reference of this recording?"
        notes.append(
            f"over the same poses the estimate travels {estimate_m:.1f} m and the reference "
            f"{reference_m:.1f} m; {what}"
        )
    span = float(rows[-1] - rows[0]) / max(len(estimate) - 1, 1)
    if len(estimate) > 1 and span < _SUSPECT.matched_estimate:
        notes.append(
            f"the reference covers {100 * span:.0f} % of the estimate: the figures are those of "
            "this part"
        )
    shorter = min(len(estimate), len(reference))
    if len(rows) < _SUSPECT.matched_share * shorter:
        notes.append(
            f"only {len(rows)} poses match, of {len(estimate)} of the estimate and "
            f"{len(reference)} of the reference; {_counted(estimate, reference)}"
        )
    return tuple(notes)


def _counted(estimate: Trajectory, reference: Trajectory) -> str:
    """Return why few poses match: times that count, or a clock or recording of its own."""
    for name, trajectory in (("estimate", estimate), ("reference", reference)):
        times_ns = trajectory.times_ns
        if times_ns is not None and (np.diff(times_ns) == NS_PER_S).all():
            return (
                f"the times of the {name} count by one, as numbers of frames do: give it with times "
                "(TUM form)"
            )
    return "is it the reference of this recording, on the same clock?"


def _row_note(estimate: Trajectory, reference: Trajectory) -> tuple[str, ...]:
    """Doubt that rows are frames where a trajectory states neither frames nor times, and has more or
    fewer poses than the other has frames.
    """
    named = {"estimate": estimate, "reference": reference}
    bare = [name for name, t in named.items() if t.times_ns is None and t.frame_indices is None]
    ends = {
        name: len(t) if t.frame_indices is None else int(t.frame_indices[-1]) + 1
        for name, t in named.items()
    }
    if not bare or ends["estimate"] == ends["reference"]:
        return ()
    which = " and the ".join(bare)
    return (
        f"row k of the {which} is taken for frame k, for want of times; the estimate has "
        f"{ends['estimate']} frames and the reference {ends['reference']}: where images were lost, "
        "errors are false; give both with times (TUM form)",
    )


def _positions_alone(estimate: Trajectory, reference: Trajectory) -> tuple[str, ...]:
    """Say that a trajectory has no orientations, so that only positions are compared."""
    return tuple(
        f"the {name} has positions without orientations: attitude, RPE and drift, which use them, "
        "say nothing of the error"
        for name, trajectory in (("estimate", estimate), ("reference", reference))
        if trajectory.orientations == "none"
    )


def _arm_notes(
    T_est: FloatArray, T_ref: FloatArray, scale_free: ScaleFree | None
) -> tuple[str, ...]:
    """Name a reference of M poses (M, 4, 4) that describes another point of the body."""
    note = None if scale_free is None else lever_arm_note(T_est, T_ref)
    return () if note is None else (note,)


def _attitude_notes(
    alignment: Alignment, T_est: FloatArray, T_ref: FloatArray, T_aligned: FloatArray
) -> tuple[str, ...]:
    """Name what explains a large attitude error of M poses (M, 4, 4) whose positions were
    aligned.
    """
    if alignment.rotation_from not in ("positions", "direction and orientations"):
        return ()
    sigma = (
        deviation_about_path(alignment, T_est, T_ref)[1]
        if alignment.rotation_from == "positions"
        else 0.0
    )
    note = attitude_note(T_aligned[:, :3, :3], T_ref[:, :3, :3], sigma, alignment.R)
    return () if note is None else (note,)
