"""Errors of the motion between aligned poses: relative pose error and the KITTI drift metric."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.errors import EvaluationError
from vio.geometry.lie import FloatArray, se3_inverse, so3_log
from vio.numerics.robust import median

KITTI_LENGTHS_M: tuple[float, ...] = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_STEP_FRAMES = 10
RPE_DISTANCE_TOLERANCE = 0.1  # relative tolerance of a pair's path length


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


def relative_error_frames(T_est: FloatArray, T_ref: FloatArray, delta: int) -> RelativeError | None:
    """Relative pose error over every pair `delta` poses apart (M, 4, 4); None where there is no
    such pair.

    Raises:
        EvaluationError: `delta` is not positive.

    Reference: Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS (2012).
    """
    if delta < 1:
        raise EvaluationError(f"the distance of a pair must be at least 1 frame, got {delta}")
    first = np.arange(max(len(T_ref) - delta, 0))
    return _relative_error(T_est, T_ref, first, first + delta, float(delta), "frames")


def relative_error_distance(
    T_est: FloatArray, T_ref: FloatArray, delta_m: float
) -> RelativeError | None:
    """Relative pose error over pairs `delta_m` of the reference's path apart; None where there is
    no such pair.

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
    # the first of poses at one position
    before = np.searchsorted(travelled, travelled[beyond - 1], side="left")
    gap_before = target - travelled[before]
    at_beyond = travelled[np.minimum(beyond, n - 1)]
    gap_beyond = np.where(beyond < n, at_beyond - target, np.inf)
    last = np.where(gap_before <= gap_beyond, before, beyond)
    close = np.minimum(gap_before, gap_beyond) <= RPE_DISTANCE_TOLERANCE * delta_m
    return _relative_error(T_est, T_ref, first[close], last[close], delta_m, "m")


def kitti_error(
    T_est: FloatArray,
    T_ref: FloatArray,
    lengths_m: Sequence[float] = KITTI_LENGTHS_M,
    step_frames: int = KITTI_STEP_FRAMES,
) -> KittiError | None:
    """Compute the drift over segments of given path lengths, of paired poses (M, 4, 4); None where
    no segment fits.

    A segment starts at every `step_frames`-th pose and ends at the first one more than the length
    further along the reference's path. Its errors are divided by the length.

    Raises:
        EvaluationError: a length or the step is not positive.

    Reference: Geiger, Lenz & Urtasun, Are we ready for autonomous driving?, CVPR (2012), and its
    development kit.
    """
    if not all(np.isfinite(length) and length > 0 for length in lengths_m) or step_frames < 1:
        raise EvaluationError(
            f"segment lengths and step must be positive, got {list(lengths_m)} m, {step_frames}"
        )
    travelled = _cumulative_path_length(T_ref[:, :3, 3])
    per_length: list[LengthError] = []
    all_trans: list[FloatArray] = []
    all_rot: list[FloatArray] = []
    for length in lengths_m:
        first = np.arange(0, len(travelled), step_frames)
        last = np.searchsorted(travelled, travelled[first] + length, side="right")
        first = first[last < len(travelled)]
        last = last[last < len(travelled)]
        trans_m, rot_deg = _motion_errors(T_est, T_ref, first, last)
        all_trans.append(100 * trans_m / length)
        all_rot.append(100 * rot_deg / length)
        means = [
            float(errors[-1].mean()) if len(first) else None for errors in (all_trans, all_rot)
        ]
        per_length.append(LengthError(float(length), len(first), *means))
    segments = sum(row.segments for row in per_length)
    if segments == 0:
        return None
    t_err = np.concatenate(all_trans).mean()
    r_err = np.concatenate(all_rot).mean()
    return KittiError(float(t_err), float(r_err), segments, tuple(per_length))


def drift(T_est: FloatArray, T_ref: FloatArray) -> KittiError | None:
    """Compute the drift over KITTI's lengths, or where no segment fits over a tenth or a
    hundredth of them.
    """
    for divisor in (1, 10, 100):
        if error := kitti_error(T_est, T_ref, [length / divisor for length in KITTI_LENGTHS_M]):
            return error
    return None


def error_statistics(errors: npt.ArrayLike) -> ErrorStatistics:
    """Summarise errors (M,), M >= 1."""
    e = np.asarray(errors, dtype=np.float64)
    rmse = float(np.sqrt(np.mean(e * e)))
    return ErrorStatistics(rmse, float(e.mean()), median(e), float(e.max()))


def rotation_angle_deg(R: npt.ArrayLike) -> FloatArray:
    """Angles (...,) in [0, 180] degrees of rotations (..., 3, 3) or transforms (..., 4, 4)."""
    return np.degrees(
        np.linalg.norm(so3_log(np.asarray(R, dtype=np.float64)[..., :3, :3]), axis=-1)
    )


def path_length_m(positions: npt.ArrayLike) -> float:
    """Length of the polygon through positions (N, 3), metres; 0 for fewer than two."""
    return float(
        np.linalg.norm(np.diff(np.asarray(positions, dtype=np.float64), axis=0), axis=1).sum()
    )


def _cumulative_path_length(positions: FloatArray) -> FloatArray:
    """Path length (M,) from the first position to each, metres."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([np.zeros(1), np.cumsum(steps)])


def _motion_errors(
    T_est: FloatArray, T_ref: FloatArray, first: npt.NDArray[np.intp], last: npt.NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """Translation (metres) and rotation (degrees) errors (K,) of the motions from poses `first`
    to poses `last`.
    """
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
    return RelativeError(
        delta, unit, len(first), error_statistics(trans_m).rmse, error_statistics(rot_deg).rmse
    )
