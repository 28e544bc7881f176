"""Faults of an accelerometer or of the lever arm, by its readings and the camera's motion;
exchanged axes.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from vio.calibration.egomotion import CameraMotion
from vio.calibration.findings import NotObservable
from vio.calibration.inertial import ImuAlignment, Rates
from vio.calibration.lever_arm import estimate_lever_arm
from vio.calibration.verdicts import judge_imu
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.imu.findings import InertialFinding
from vio.monitor.force_fit import MIN_WINDOWS, WINDOW_S, Evidence, ForceFit
from vio.monitor.gyro_fit import GyroFit
from vio.monitor.motion import Record
from vio.monitor.samples import Size, gravity_removed
from vio.records import S_PER_NS

log = logging.getLogger(__name__)


class _AxesRules(NamedTuple):
    """When axes or signs of the accelerometer are others."""

    sign_sigmas: float = 6.0
    # likewise of axes, and of the opposite sign, in fewer or shorter windows; right axes came to at
    # most 1.2 in 178 pieces of flights and drives
    worse_early: float = 9.0
    upside_down_cosine: float = 0.5  # cosine between image-down and up: within 60 degrees
    upside_down_share: float = 0.95


_AXES = _AxesRules()
AXES_WORSE = 3.0  # ratio of the given axes' squared misfit to that of others


class _OtherScale(NamedTuple):
    """When the camera's motion is of another scale than the readings."""

    # Factor on the camera's motion from which on it is judged here; smaller ones are estimated
    # while running. Of right baselines it came to 0.96 to 1.11 in windows of 4 s and more of two
    # flights.
    min_factor: float = 3.0
    # of the camera's squared path, which the scaled readings leave a part of
    explained_ratio: float = 4.0


_OTHER = _OtherScale()


def signed_permutations() -> Iterator[FloatArray]:
    """Yield all 48 maps that exchange and invert axes; those that change least come first."""
    every = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    yield from sorted(every, key=lambda P: -float(np.trace(P)))


def axes_text(P: FloatArray) -> str:
    """Return how true readings of x y z appear in the recording, e.g. `[+y -x +z]`."""
    return (
        "["
        + " ".join(
            f"{'+' if row.sum() > 0 else '-'}{'xyz'[int(np.argmax(np.abs(row)))]}" for row in P
        )
        + "]"
    )


def resolve_size(size: Size, evidence: Evidence) -> Size:
    """Resolve an ambiguous magnitude: use the images' accelerations to test whether the readings
    are in m/s^2.
    """
    if size.clear or size.finding is None or size.unit is None:
        return size
    if evidence.force is not None:
        scale, sigma = evidence.force.sign(evidence.R_cam0_imu)
        if 0 < scale < 0.5 * size.unit - _AXES.sign_sigmas * sigma:
            seen = f"{size.finding.seen}, though the images' accelerations are only {scale:.2f} times its own"
            return Size(gravity_removed(seen), None)
    return size if evidence.force_final else Size(None, size.unit)


def judge_force(
    evidence: Evidence, unit: float, camera: StereoCamera | None
) -> tuple[list[InertialFinding], bool]:
    """Judge axes and sign of the accelerometer, whose readings times `unit` are m/s^2, and the
    scale of a pair's motion, if one is given; and if the sign is known.
    """
    gyro_fit = evidence.gyro_fit
    force = evidence.force
    R = evidence.R_cam0_imu
    readings = gyro_fit.force[gyro_fit.covered]
    if evidence.early_force is not None:
        wrong = _wrong_axes(evidence.early_force, R * unit)
        if wrong is None and force is None:
            wrong = _opposite(evidence.early_force, R * unit)
        if wrong is not None:
            return [wrong], True
        if camera is not None and evidence.early_force.window_s == WINDOW_S:
            scaled = _wrong_scale(evidence.early_force, R * unit, camera)
            if scaled is not None:
                return [scaled], True
    if force is not None:
        scale, sigma = force.sign(R * unit)
        if abs(scale) > _AXES.sign_sigmas * sigma and 0.5 < abs(scale) < 2.0:
            return (
                [_wrong_sign(scale, sigma)] if scale < 0 else judge_up(readings, R, measured=True)
            ), True
    return (judge_up(readings, R, measured=False) if evidence.last else []), False


def _wrong_sign(scale: float, sigma: float) -> InertialFinding:
    return InertialFinding(
        "accelerometer sign",
        f"the images' accelerations are {scale:+.2f} times (standard deviation {sigma:.2f}) those "
        "of the accelerometer",
        "all readings have the wrong sign (specific force is +9.8 m/s^2 upwards at standstill); "
        "change it",
    )


def _opposite(force: ForceFit, C: FloatArray) -> InertialFinding | None:
    """Return that the negative of a map (3, 3) fits so much better that two windows suffice."""
    if force.cost(-C) * _AXES.worse_early > force.cost(C):
        return None
    return _wrong_sign(*force.sign(C))


def _wrong_scale(force: ForceFit, C: FloatArray, camera: StereoCamera) -> InertialFinding | None:
    """Return that the camera's accelerations are several times those of the accelerometer, as where
    a baseline is in squares of a board or in centimetres, or depths are in another unit.

    Smaller ones are no evidence, as noise of the accelerometer makes the factor small.
    """
    if camera.kind == "mono":
        return None
    scale, sigma = force.sign(C)
    if scale < _OTHER.min_factor or scale < _AXES.sign_sigmas * sigma:
        return None
    best = force.cost(scale * C)
    if best * AXES_WORSE > force.cost(C) or best * _OTHER.explained_ratio > force.cost(0 * C):
        return None
    seen = (
        f"the camera's accelerations are {scale:.3g} times (standard deviation {sigma:.2g}) those "
        "of the accelerometer, while the gyro agrees"
    )
    if camera.kind == "rgbd":
        remedy = "depths are too large by this factor: give their unit (dataset.depth_factor)"
    else:
        remedy = (
            f"a baseline of {camera.baseline_m:.4g} m would be {camera.baseline_m / scale:.3g} m: "
            "give the translation between the cameras in metres"
        )
    return InertialFinding(
        "camera scale", seen, f"{remedy}; all lengths of the run are too long by it"
    )


def _wrong_axes(force: ForceFit, C: FloatArray) -> InertialFinding | None:
    """Return exchanged axes of the accelerometer that fit clearly better than the given map (3,
    3) to the camera.
    """
    given = force.cost(C)
    others = [P for P in signed_permutations() if abs(np.trace(P)) < 2.5]
    costs = [force.cost(C @ P) for P in others]
    k = int(np.argmin(costs))
    worse = AXES_WORSE if force.windows >= MIN_WINDOWS else _AXES.worse_early
    # Neither the given axes nor their negative may explain the readings: the sign is judged
    # separately.
    if costs[k] * worse > min(given, force.cost(-C)):
        return None
    return InertialFinding(
        "accelerometer axes",
        "with the given axes the accelerometer deviates from the camera's path by "
        f"{100 * np.sqrt(given):.1f} cm over "
        f"{force.window_s:g} s, with others by {100 * np.sqrt(costs[k]):.1f} cm, while the gyro agrees",
        f"its axes contain {axes_text(others[k].T)} in place of [+x +y +z]; correct their order "
        "and signs",
    )


def judge_up(force: FloatArray, R_cam0_imu: FloatArray, *, measured: bool) -> list[InertialFinding]:
    """Return a hint if the accelerometer's 'up' points down in nearly all images.

    Args:
        force: (K, 3) mean specific forces, imu frame, any unit.
        R_cam0_imu: (3, 3).
        measured: whether motion has shown that the accelerometer's sign is right.
    """
    up = force @ R_cam0_imu.T
    down_in_image = up[:, 1] / np.maximum(np.linalg.norm(up, axis=1), 1e-9)
    share = 0.0
    if len(up):
        share = float(np.mean(down_in_image > _AXES.upside_down_cosine))
    if share < _AXES.upside_down_share:
        return []
    explanation = (
        "the camera is mounted upside down, or gravity was added with the wrong sign (a + g in "
        "place of a - g), which "
        "motion alone cannot distinguish"
        if measured
        else "the camera is mounted upside down, or the accelerometer's sign, that of its gravity, "
        "or T_cam0_imu is "
        "wrong; the motion is too small to decide"
    )
    return [
        InertialFinding(
            "upside down",
            f"the accelerometer's 'up' points down in the image in {100 * share:.0f} % of the "
            "frames",
            f"{explanation}; unless the camera is upside down, the estimated world will be",
            certain=False,
        )
    ]


def judge_lever_arm(
    record: Record, gyro_fit: GyroFit, T_cam0_imu: FloatArray, rates: Rates
) -> list[InertialFinding]:
    """Report an inverted lever arm by the fit of `vio calibrate`; nothing if the motion does not
    determine it.

    `T_cam0_imu` (4, 4) is as given; the gyro must agree with its rotation.
    """
    times_ns = record.origin_ns + np.round(
        np.concatenate([record.begin, record.end[-1:]]) / S_PER_NS
    ).astype(np.int64)
    # whose interval ends where the next frame is
    frames = np.flatnonzero(np.append(record.joined[1:], True))
    motion = CameraMotion(times_ns, frames.astype(np.int64), record.twists[frames])
    alignment = ImuAlignment(
        R_cam0_imu=T_cam0_imu[:3, :3],
        rotation_sigma_deg=np.zeros(3),
        time_offset_s=gyro_fit.offset_s,
        time_offset_sigma_s=0.0,
        gyro_bias=np.asarray(
            -np.linalg.lstsq(gyro_fit.A, gyro_fit.b, rcond=None)[0], dtype=np.float64
        ),
        residual_radps=gyro_fit.noise_radps,
        intervals=gyro_fit.count,
        weak=None,
    )
    lever_arm = estimate_lever_arm(motion, rates, alignment)
    if isinstance(lever_arm, NotObservable):
        log.info("the translation of T_cam0_imu was not checked: %s", lever_arm)
        return []
    faults = judge_imu(alignment, lever_arm, T_cam0_imu)
    return [
        InertialFinding(
            "extrinsics translation",
            fault.detail,
            "the translation of T_cam0_imu has the wrong sign or belongs to the inverse transform; "
            "it must be the "
            "IMU's position in the left camera's frame",
        )
        for fault in faults
        if fault.fault == "IMU-camera translation inverted"
    ]
