"""Figures of one run with a fault: covered by what was stated, flagged and when, silent."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from vio.errors import EvaluationError
from vio.evaluation.association import associate
from vio.findings import INTEGRITIES, Finding
from vio.geometry.lie import FloatArray, se3_inverse, transform_points
from vio.geometry.upright import yaw_and_position
from vio.records import BoolArray, IntArray, Trajectory
from vio.runs.pipeline import RunResult

COVERED = 3.0  # standard deviations
WORSE = 1.2  # times the ratio of the recording as it is: no worse than that
SOON_FRAMES = 10
_SETTLED_FRAMES = 5  # the first poses are millimetres apart, with a stated sigma near zero
_MIN_SIGMA_M = 1e-4
UNUSABLE = INTEGRITIES.index("unusable")


def code_of(line: str) -> str:
    """Return an error's line up to its first explanation, without numbers and without the frame."""
    without_place = re.sub(r"^frame \d+: ", "", line)
    return re.sub(r"[-+]?\d[\d.]*", "#", re.split(r"[:;] ", without_place)[0])


def new_flags(findings: Iterable[Finding], usual: Iterable[str]) -> list[Finding]:
    """Return what a run found to be other than nominal, less the codes of the recording as it is."""
    known = set(usual)
    return [f for f in findings if f.effect != "nominal" and f.code not in known]


def flagged_frame(flags: Iterable[Finding], onset: int) -> int | None:
    """Return the frame of the first flag from an onset on; None: there is none.

    What holds for the whole recording was found at its end.
    """
    frames = [flag.frame for flag in flags if flag.frame is not None and flag.frame >= onset]
    return min(frames, default=None)


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Errors of the poses of a run relative to the first one, beside what it stated."""

    frames: IntArray  # (N,) their numbers
    error_m: FloatArray  # (N,)
    sigma_m: FloatArray  # (N,) root of the trace of the stated covariance of the position
    unusable: BoolArray  # (N,) the run says that the pose may not be used

    @property
    def ratio(self) -> FloatArray:
        """Error over stated standard deviation (N,)."""
        return self.error_m / self.sigma_m


def pose_errors(result: RunResult, truth_sigma_m: float) -> PoseErrors:
    """Compare a run's positions with the reference, whose world is identified at the first pose.

    That is the whole pose where the estimate's world is that of its first frame, and position and
    yaw where both are upright, as the first tilt is an estimate like any other; where that ends,
    the worlds are identified anew.

    Args:
        result: of a run whose recording has a reference with orientations.
        truth_sigma_m: accuracy of the reference, which is added to what was stated.

    Raises:
        EvaluationError: no pose has a reference.
    """
    reference = result.recording.reference
    if reference is None:
        raise EvaluationError(f"{result.recording.path} has no reference")
    extrinsics = result.T_cam0_body
    in_body: Trajectory = (
        reference.in_imu(extrinsics) if result.body == "imu" else reference.in_cam0(extrinsics)
    )
    estimate = result.trajectory
    _, rows, reference_rows = associate(estimate, in_body.numbered())
    T_est = estimate.T_world_body[rows]
    T_ref = in_body.T_world_body[reference_rows]
    error_m = _errors_m(T_est, T_ref, _is_upright(result)[rows])
    covariances = np.array(result.estimates.column("covariance"))[rows]
    variance = np.trace(covariances[:, :3, :3], axis1=1, axis2=2)
    sigma_m = np.sqrt(variance + truth_sigma_m**2 + _MIN_SIGMA_M**2)
    indices = np.array(result.estimates.column("index"))[rows]
    unusable = np.array(result.estimates.column("integrity"))[rows] == UNUSABLE
    kept = slice(_SETTLED_FRAMES, None)
    return PoseErrors(indices[kept], error_m[kept], sigma_m[kept], unusable[kept])


def _is_upright(result: RunResult) -> BoolArray:
    """Whether the world of each estimate (N,) is the one that gravity shows at present."""
    gravity = np.array(result.estimates.column("gravity_world"), dtype=np.float64)
    tilt = np.array(result.estimates.column("tilt_sigma_rad"), dtype=np.float64)
    stays = np.isfinite(gravity.reshape(len(gravity), -1)).all(axis=1)
    return np.asarray(np.isfinite(tilt) & ~stays, dtype=np.bool_)


def _errors_m(T_est: FloatArray, T_ref: FloatArray, upright: BoolArray) -> FloatArray:
    """Errors (M,) of the positions of paired poses (M, 4, 4); see `pose_errors`."""
    error_m = np.empty(len(T_est))
    for rows in (np.flatnonzero(upright), np.flatnonzero(~upright)):
        if len(rows):
            first_est = T_est[rows[0]]
            first_ref = T_ref[rows[0]]
            T_world_ref = (
                yaw_and_position(first_est, first_ref)
                if upright[rows[0]]
                else first_est @ se3_inverse(first_ref)
            )
            p_ref = transform_points(T_world_ref, T_ref[rows, :3, 3])
            error_m[rows] = np.linalg.norm(T_est[rows, :3, 3] - p_ref, axis=1)
    return error_m


@dataclass(frozen=True, slots=True)
class Usual:
    """What is known of a recording as it is."""

    codes: tuple[str, ...] = ()  # of what is found in it
    ratio: float = 0.0  # its largest error over the stated standard deviation


def score(result: RunResult, usual: Usual, onset: int, truth_sigma_m: float) -> dict[str, Any]:
    """Return the figures of a run with a fault that begins at a frame."""
    errors = pose_errors(result, truth_sigma_m)
    ratio = errors.ratio
    worst = int(np.argmax(ratio))
    is_beyond = ratio > max(COVERED, WORSE * usual.ratio)
    beyond = errors.frames[is_beyond]
    said = new_flags(result.findings, usual.codes)
    flagged = flagged_frame(said, onset)
    covered = not len(beyond)
    return {
        "covered": covered,
        "ratio": float(ratio[worst]),
        "worst_frame": int(errors.frames[worst]),
        "error_m": float(errors.error_m[worst]),
        "sigma_m": float(errors.sigma_m[worst]),
        "beyond_since": None if covered else int(beyond[0]),
        "misleading": int(np.count_nonzero(is_beyond & ~errors.unusable)),
        "flagged_after": None if flagged is None else flagged - onset,
        "said": list(dict.fromkeys(flag.code for flag in said)),
        "silent": not covered and flagged is None,
    }
