"""Rotation and time offset between gyro and camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.calibration.egomotion import CameraMotion
from vio.calibration.findings import NotObservable
from vio.calibration.inertial import ImuAlignment, Rates
from vio.geometry.lie import FloatArray, nearest_rotation, so3_exp, so3_log
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import jackknife, robust_sigma
from vio.records import S_PER_NS, BoolArray

_BLOCKS: Tolerance[int] = 10  # of the jackknife


@dataclass(frozen=True, slots=True)
class _FitRules:
    """How the rotation to the gyro and the time offset are fitted."""

    min_intervals: int = 40  # between frames, with samples: fewer state too small deviations
    rotation_deg: float = 1.0  # standard deviation of the rotation beyond which it is called weak
    largest_offset_s: float = 0.1
    offset_step_s: Tolerance[float] = 0.004
    # rad/s per m/s: weight of a velocity's error relative to a rotation rate's
    velocity_weight: float = 0.02


_FIT = _FitRules()
TIME_OFFSET_S = 0.005
_MIN_RATE_RADPS = 0.02  # spread of the rotation rate below which the alignment is unobservable


def align_gyro(motion: CameraMotion, rates: Rates) -> ImuAlignment | NotObservable:
    """Estimate rotation, time offset and gyro bias that align the gyro's rotations with those of
    the camera.

    Model, for each frame interval:
    `omega_cam dt = R_cam0_imu (integral of gyro over the shifted interval - b dt)`. Velocities of a
    `velocity` recording are used as directions, since a car rotates about one axis only.
    """
    what = "IMU-camera rotation and time offset"
    if float(np.linalg.norm(motion.twists[:, 3:].std(axis=0))) < _MIN_RATE_RADPS:
        return NotObservable(what, "the camera does not rotate")
    problem = _GyroProblem(motion, rates)
    keep = problem.covered
    if (count := int(keep.sum())) < _FIT.min_intervals:
        return NotObservable(
            what,
            f"only {count} intervals between frames have samples of the sensor "
            f"({_FIT.min_intervals} needed); check that both have one clock",
        )
    offset = problem.coarse_offset()
    solution = problem.fit(problem.start(offset), keep)
    sigma = problem.spread(solution, keep)
    refits = []
    for block in np.array_split(np.flatnonzero(keep), _BLOCKS):
        part = keep.copy()
        part[block] = False
        refits.append(problem.fit(solution, part))
    R_back = so3_exp(solution[:3]).T
    turns = np.array([so3_log(so3_exp(x[:3]) @ R_back) for x in refits])
    errors = jackknife(np.concatenate([turns, np.array(refits)[:, 3:]], axis=1))
    errors = np.maximum(errors, problem.formal_sigma(solution, keep, sigma))
    rotation_sigma = np.degrees(errors[:3])
    weak = None
    if rotation_sigma.max() > _FIT.rotation_deg:
        weak = "rotation about one axis (too little rotation about the others)"
    if errors[3] > TIME_OFFSET_S:
        weak = (
            f"{weak} and time offset" if weak else "time offset (the rotation rate hardly changes)"
        )
    return ImuAlignment(
        R_cam0_imu=so3_exp(solution[:3]),
        rotation_sigma_deg=rotation_sigma,
        time_offset_s=float(solution[3]),
        time_offset_sigma_s=float(errors[3]),
        gyro_bias=solution[4:],
        residual_radps=sigma,
        intervals=count,
        weak=weak,
    )


class _GyroProblem:
    """Residuals of `align_gyro`; parameters are [rotation vector (3), offset (1), bias (3)]."""

    def __init__(self, motion: CameraMotion, rates: Rates) -> None:
        self._origin = int(motion.times_ns[0])
        self._t = (rates.times_ns - self._origin) * S_PER_NS
        twice_mean = rates.angular[1:] + rates.angular[:-1]
        steps = np.diff(self._t)[:, None] * twice_mean / 2
        self._turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        self._begin = (motion.times_ns[motion.frames] - self._origin) * S_PER_NS
        self._end = (motion.times_ns[motion.frames + 1] - self._origin) * S_PER_NS
        self._dt = self._end - self._begin
        self._omega = motion.twists[:, 3:]
        margin = _FIT.largest_offset_s
        inside = (self._begin >= self._t[0]) & (self._end <= self._t[-1])
        after_begin = self._begin - margin >= self._t[0]
        before_end = self._end + margin <= self._t[-1]
        shiftable = after_begin & before_end
        self.covered: BoolArray = shiftable if shiftable.sum() > 0.5 * inside.sum() else inside
        self._velocities: tuple[FloatArray, FloatArray] | None = None
        if not rates.inertial:
            middle = (self._begin + self._end) / 2
            v_imu = np.stack(
                [np.interp(middle, self._t, rates.linear[:, k]) for k in range(3)], axis=1
            )
            self._velocities = motion.twists[:, :3], v_imu

    def gyro(self, offset: float) -> FloatArray:
        """Return the mean rotation rate (K, 3) of each interval, imu frame."""
        turned = [
            np.interp(at + offset, self._t, self._turned[:, k])
            for k in range(3)
            for at in (self._end, self._begin)
        ]
        return (
            np.stack([turned[2 * k] - turned[2 * k + 1] for k in range(3)], axis=1)
            / self._dt[:, None]
        )

    def coarse_offset(self) -> float:
        """Return the offset at which the magnitudes of the two rotation rates agree best."""
        camera_rates = np.linalg.norm(self._omega, axis=1)[self.covered]
        offsets = np.arange(
            -_FIT.largest_offset_s, _FIT.largest_offset_s + 1e-9, _FIT.offset_step_s
        )
        scores = []
        for offset in offsets:
            gyro_rates = np.linalg.norm(self.gyro(offset), axis=1)[self.covered]
            scores.append(float(np.median(np.abs(gyro_rates - camera_rates))))
        return float(offsets[int(np.argmin(scores))])

    def start(self, offset: float) -> FloatArray:
        """Return the closed-form solution at one offset.

        Reference: Wahba's problem by SVD (Markley 1988).
        """
        gyro = self.gyro(offset)[self.covered]
        omega = self._omega[self.covered]
        C = (omega - np.median(omega, axis=0)).T @ (gyro - np.median(gyro, axis=0))
        if self._velocities is not None:
            v_cam, v_imu = (v[self.covered] for v in self._velocities)
            C = C + 1e-2 * (v_cam.T @ v_imu)
        return np.concatenate([so3_log(nearest_rotation(C)), [offset], np.zeros(3)])

    def residuals(self, x: FloatArray) -> FloatArray:
        """Return differences (K, 3 or 6) of the rates, and of the velocities where they are
        known.
        """
        R = so3_exp(x[:3])
        turning = self._omega - (self.gyro(float(x[3])) - x[4:]) @ R.T
        if self._velocities is None:
            return turning
        v_cam, v_imu = self._velocities
        return np.concatenate([turning, (v_cam - v_imu @ R.T) * _FIT.velocity_weight], axis=1)

    def fit(self, x: FloatArray, keep: BoolArray) -> FloatArray:
        """Fit by robust least squares from `x` on some of the intervals."""
        from scipy.optimize import least_squares  # every run imports this module, and few fit

        start = x
        for _ in range(2):
            scale = self.spread(start, keep)
            found = least_squares(
                lambda y, s=scale: self.residuals(y)[keep].ravel() / s,
                start,
                loss="soft_l1",
                x_scale=np.array([1e-2] * 3 + [1e-3] + [1e-3] * 3),
                diff_step=1e-5,
            )
            start = found.x
        return start

    def spread(self, x: FloatArray, keep: BoolArray) -> float:
        """Return the robust standard deviation of one residual."""
        return max(robust_sigma(self.residuals(x)[keep]), 1e-6)

    def formal_sigma(self, x: FloatArray, keep: BoolArray, sigma: float) -> FloatArray:
        """Return standard deviations (7,) for independent residuals; large in unobservable
        directions.
        """
        J = np.empty((self.residuals(x)[keep].size, 7))
        for k, h in enumerate([1e-4] * 3 + [1e-3] + [1e-4] * 3):
            step = np.zeros(7)
            step[k] = h
            if k < 3:  # a rotation on the camera's side, as in the jackknife
                plus, minus = (
                    np.concatenate([so3_log(so3_exp(s * step[:3]) @ so3_exp(x[:3])), x[3:]])
                    for s in (1.0, -1.0)
                )
            else:
                plus = x + step
                minus = x - step
            change = self.residuals(plus) - self.residuals(minus)
            J[:, k] = change[keep].ravel() / (2 * h)
        scale = np.maximum(np.linalg.norm(J, axis=0), 1e-12)
        information = (J / scale).T @ (J / scale) + 1e-12 * np.eye(7)
        return sigma * np.sqrt(np.diag(np.linalg.inv(information))) / scale
