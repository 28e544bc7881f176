"""Units, axes, signs and the clock of an IMU, by the poses of a board, before anything is adjusted.

The checks are those of a run (`vio.monitor`); here the rotation from the IMU to the camera is that
of the best linear map between both rates, as none is given.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.errors import DataError
from vio.geometry.lie import FloatArray, nearest_rotation, se3_inverse, se3_log
from vio.imu.clocks import judge_clocks
from vio.imu.findings import InertialFinding
from vio.monitor.accelerometer import judge_force, resolve_size
from vio.monitor.force_fit import Evidence, fit_force
from vio.monitor.gyro import judge_gyro
from vio.monitor.gyro_fit import AGREES, FAR_OFFSETS_S, GyroFit, fit_gyro
from vio.monitor.motion import Intervals, Record, record_of
from vio.monitor.samples import Size, judge_exchange, judge_size
from vio.numerics.robust import median
from vio.records import S_PER_NS, ImuRecord, IntArray


class _OffsetRules(NamedTuple):
    """When the clock's offset is found first."""

    max_step_s: float = 0.5  # between views whose poses give a rate
    min_intervals: int = 20
    min_offset_s: float = 0.05  # below, the adjustment finds the clock's offset by itself
    near_s: float = 0.15
    # of the rotation, beyond `near_s`: of hundreds of offsets, one explains the rest by chance
    max_far_unexplained: float = 0.05


_OFFSET = _OffsetRules()

_MIRRORED = InertialFinding(
    "gyro axes",
    "no rotation takes its rates to those of the camera, and a reflection does",
    "the gyro's axes are left-handed, or its rates have the wrong sign: correct order and signs "
    "of its columns",
)

_STILL_SHARE = 0.05  # of the rates seen and of gravity, below which the IMU's readings are noise
_STILL = InertialFinding(
    "gyro disagrees",
    "the IMU does not turn while the board turns before the camera",
    "the board was moved, not the rig: fix the board, and turn and move the rig before it, camera "
    "and IMU together",
)


def check_imu(
    times_ns: IntArray, T_cam0_board: FloatArray, rotation_sigma_rad: float, imu: ImuRecord
) -> float:
    """Return the offset of the clocks in seconds, roughly, where it is large, else 0.

    Args:
        times_ns: (K,) of the views.
        T_cam0_board: (K, 4, 4) the board's poses.
        rotation_sigma_rad: standard deviation of their rotations about one axis.
        imu: its samples; a frame stamped t was exposed at t + offset of their clock.

    Raises:
        DataError: units, axes, signs or stamps of the IMU are wrong; names what to change.
    """
    for finding in judge_clocks(times_ns, imu.times_ns):
        if finding.fault == "clocks without overlap":
            raise _error(finding)
    values = np.concatenate([imu.gyro, imu.accel], axis=1)
    if (exchanged := judge_exchange(imu.times_ns, values)) is not None:
        raise _error(exchanged)
    size = judge_size(imu.times_ns, imu.accel)
    intervals = _intervals(times_ns, T_cam0_board)
    gyro_fit = None
    if size.finding is None:
        found = []
    else:
        found = [size.finding]
    # With fewer, the adjustment says which rotation is missing.
    if len(intervals) >= _OFFSET.min_intervals:
        record = record_of(intervals, imu.times_ns, values)
        step_s = median(record.end - record.begin)
        gyro_fit = fit_gyro(record, _OFFSET.min_intervals, np.sqrt(2) * rotation_sigma_rad / step_s)
        if gyro_fit is not None:
            found = _judge(record, gyro_fit, size)
    for finding in found:
        if finding.certain:
            raise _error(finding)
    if gyro_fit is None:
        return 0.0
    if abs(gyro_fit.offset_s) > _OFFSET.min_offset_s:
        return gyro_fit.offset_s
    return 0.0


def _error(finding: InertialFinding) -> DataError:
    return DataError(f"the IMU cannot be used: {finding.message}")


def _intervals(times_ns: IntArray, T_cam0_board: FloatArray) -> Intervals:
    """Return the camera's motion between views that follow each other soon."""
    seconds = np.diff(times_ns) * S_PER_NS
    rows = np.flatnonzero((seconds > 0) & (seconds < _OFFSET.max_step_s))
    moved = T_cam0_board[rows] @ se3_inverse(T_cam0_board[rows + 1])
    twists = se3_log(moved) / seconds[rows, None]
    return Intervals(times_ns[rows], times_ns[rows + 1], twists)


def _agrees(gyro_fit: GyroFit) -> bool:
    """Return whether some linear map takes the gyro's rates to those of the camera."""
    is_near = abs(gyro_fit.offset_s) < _OFFSET.near_s
    return gyro_fit.unexplained <= (AGREES if is_near else _OFFSET.max_far_unexplained)


def _is_mirrored(gyro_fit: GyroFit, R: FloatArray) -> bool:
    """Whether the nearest orthogonal map fits and the nearest rotation (3, 3) does not."""
    fits_mirrored = gyro_fit.fits(_nearest_map(gyro_fit.S_cg))
    return gyro_fit.axes == 3 and fits_mirrored and not gyro_fit.fits(R)


def _evidence(record: Record, gyro_fit: GyroFit, size: Size, R: FloatArray) -> Evidence:
    """Return what both sensors show beside the board's poses, with a rotation (3, 3)."""
    if size.unit is None:
        force = None
    else:
        force = fit_force(record, gyro_fit, np.zeros(3))
    return Evidence(
        R_cam0_imu=R,
        gyro_fit=gyro_fit,
        force=force,
        early_force=force,
        force_final=True,
        clipped=False,
        last=True,
    )


def _judge(record: Record, gyro_fit: GyroFit, size: Size) -> list[InertialFinding]:
    """Compare the IMU with the board's poses, as `vio.monitor.inertial` compares it with tracks."""
    if not _agrees(gyro_fit):
        return [_STILL] if _is_still(record) else [_disagreement(gyro_fit)]
    R = nearest_rotation(gyro_fit.S_cg)
    if _is_mirrored(gyro_fit, R):
        return [_MIRRORED]
    evidence = _evidence(record, gyro_fit, size, R)
    size = resolve_size(size, evidence)
    found = judge_gyro(evidence, size.unit or 1.0)
    if size.finding is not None:
        found.append(size.finding)
    axes_agree = gyro_fit.axes == 3 and all(f.fault == "gyro units" for f in found)
    if not axes_agree or size.unit is None:
        return found
    return found + [_of_both_sensors(f) for f in judge_force(evidence, size.unit, None)[0]]


def _is_still(record: Record) -> bool:
    """Return whether neither sensor of the IMU moves while the board turns before the camera."""
    readings = record.means(np.zeros(1))[0][0]
    usual = np.median(readings, axis=0)
    turn, push = np.linalg.norm((readings - usual).reshape(-1, 2, 3), axis=2).T
    seen = np.linalg.norm(record.twists[:, 3:], axis=1)
    rests = median(push) < _STILL_SHARE * np.linalg.norm(usual[3:])
    return bool(rests and median(turn) < _STILL_SHARE * median(seen))


def _disagreement(gyro_fit: GyroFit) -> InertialFinding:
    return InertialFinding(
        "gyro disagrees",
        f"the gyro explains {100 * (1 - gyro_fit.unexplained):.0f} % of the camera's rotation, at "
        f"the best clock offset within {FAR_OFFSETS_S[-1]:g} s",
        "the IMU's file may be of another recording, the clocks may be further apart, or the gyro "
        "may be dead",
    )


def _nearest_map(M: FloatArray) -> FloatArray:
    """Return the orthogonal matrix (3, 3) nearest to a matrix, which may be a reflection."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ Vt)


def _of_both_sensors(finding: InertialFinding) -> InertialFinding:
    """Return a finding on the accelerometer's axes as one on both sensors: which one is wrong
    cannot be told, as the rotation between camera and IMU is the gyro's.
    """
    if finding.fault != "accelerometer axes":
        return finding
    return replace(
        finding,
        seen="the axes of the accelerometer are not those of the gyro",
        explanation=f"if those of the gyro are right, {finding.explanation}",
    )
