"""Faults of a given calibration, found by comparison with the measured one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vio.calibration.findings import Fault, Finding, NotObservable
from vio.calibration.gyro import TIME_OFFSET_S
from vio.calibration.inertial import ImuAlignment, Rates
from vio.calibration.lever_arm import LeverArm, judge_lever_arms
from vio.calibration.stereo import RayMatches, StereoEstimate, epipolar_spread, too_few
from vio.evaluation.errors_along_path import rotation_angle_deg
from vio.geometry.lie import FloatArray, so3_log
from vio.geometry.stereo import StereoCamera
from vio.records import FeatureTracks, IntArray


@dataclass(frozen=True, slots=True)
class _Explanations:
    """When a common mistake explains a difference."""

    # spread of the given calibration's epipolar angles over that of the measured one
    clearly_worse: float = 2.0
    exchanged_deg: float = 0.2  # largest epipolar angle of a calibration that fits
    # a direction so close to the negative of another is taken as inverted
    opposite_deg: float = 20.0
    inverse_deg: float = 5.0  # an inverse that fits so well is taken as the explanation


_EXPLAINS = _Explanations()


@dataclass(frozen=True, slots=True)
class _NamedDifferences:
    """Differences from a calibration above which they are called a fault."""

    sigmas: float = 5.0  # a difference must exceed so many standard deviations …
    rotation_deg: float = 0.3  # … and these limits, to be called a fault
    # where motion has separated a rotation from the lens model: half a pixel of disparity
    in_motion_deg: float = 0.05
    direction_deg: float = 1.0
    imu_rotation_deg: float = 0.5
    lever_arm_m: float = 0.03
    offset_s: float = 0.002


_NAMED = _NamedDifferences()


# --- left and right
# -------------------------------------------------------------------------------------------------


def judge_stereo(
    estimate: StereoEstimate, T_cam0_cam1: FloatArray, inliers: RayMatches
) -> tuple[Finding, ...]:
    """Compare measured left-right extrinsics with given ones (4, 4).

    The order of the cameras is measured, too: cam1 must be on the positive x side of cam0. From
    single pairs, a difference is a fault only if the given extrinsics explain the matches clearly
    worse: a slightly wrong lens model looks like a few tenths of a degree of yaw.
    """
    R_given = T_cam0_cam1[:3, :3].T
    given = _unit(T_cam0_cam1[:3, 3])
    swapped = _judge_order(estimate, R_given, given)
    if swapped is not None:
        return (swapped,)
    clear = estimate.segments is not None or (
        epipolar_spread(R_given, given, inliers)
        > _EXPLAINS.clearly_worse
        * epipolar_spread(estimate.R_cam1_cam0, estimate.direction, inliers)
    )
    found: dict[Fault, str] = {}
    swing_deg = _between_deg(estimate.direction, given)
    if _opposite(estimate, given):
        found["baseline translation inverted"] = (
            f"the calibration puts cam1 at {_triple(given)}, the images at "
            f"{_triple(estimate.direction)} (unit vectors "
            "in cam0); the translation has the wrong sign, or the transform is the inverse one"
        )
    elif swing_deg > _swing_limit_deg(estimate) and clear:
        sigma_deg = estimate.direction_sigma_deg
        found["baseline direction wrong"] = (
            f"off by {swing_deg:.2f} deg (standard deviation {sigma_deg:.2f})"
        )
    turn = so3_log(estimate.R_cam1_cam0 @ R_given.T)
    turn_deg = float(np.degrees(np.linalg.norm(turn)))
    if turn_deg > _turn_limit_deg(estimate) and clear:
        x, y, z = np.degrees(turn)
        found["left-right rotation wrong"] = (
            f"off by {turn_deg:.2f} deg ({x:+.2f} {y:+.2f} {z:+.2f} about x y z of cam1; standard "
            "deviation "
            f"{estimate.rotation_sigma_deg:.3f})"
        )
    return tuple(Finding(*each) for each in found.items())


def _judge_order(
    estimate: StereoEstimate, R_given: FloatArray, given: FloatArray
) -> Finding | None:
    """Check whether cam1 is the left camera, in the images or in the calibration (rotation (3,
    3), direction (3,)).
    """
    if estimate.direction[0] < -0.5:
        return Finding(
            "cameras swapped",
            "the images of cam1 are taken from the left of those of cam0 (measured baseline "
            "direction "
            f"{_triple(estimate.direction)} in cam0); exchange the two folders, or the two "
            "calibrations with them",
        )
    limit_deg = _turn_limit_deg(estimate)
    differs = float(rotation_angle_deg(estimate.R_cam1_cam0 @ R_given.T)) > limit_deg
    inverse_fits = float(rotation_angle_deg(estimate.R_cam1_cam0 @ R_given)) < limit_deg
    if _opposite(estimate, given) and differs and inverse_fits:
        return Finding(
            "cameras swapped",
            "the calibration is that of the two cameras exchanged, or the inverse transform: its "
            "inverse fits",
        )
    return None


def _opposite(estimate: StereoEstimate, given: FloatArray) -> bool:
    return _between_deg(estimate.direction, given) > 180 - max(
        _swing_limit_deg(estimate), _EXPLAINS.opposite_deg
    )


def _turn_limit_deg(estimate: StereoEstimate) -> float:
    if estimate.segments is None:
        least = _NAMED.rotation_deg
    else:
        least = _NAMED.in_motion_deg
    return max(least, _NAMED.sigmas * estimate.rotation_sigma_deg)


def _swing_limit_deg(estimate: StereoEstimate) -> float:
    return max(_NAMED.direction_deg, _NAMED.sigmas * estimate.direction_sigma_deg)


def judge_exchange(
    matches: RayMatches, exchanged: RayMatches, T_cam0_cam1: FloatArray
) -> tuple[Finding, ...]:
    """Check whether the given calibration (4, 4) fits the images much better with the two cameras'
    images exchanged.

    Args:
        matches: rays by the cameras as the recording has them.
        exchanged: the same matches, with the images of the two cameras exchanged.
        T_cam0_cam1: given pose of cam1 in cam0.
    """
    if too_few(matches) is not None or too_few(exchanged) is not None:
        return ()
    R = T_cam0_cam1[:3, :3].T
    direction = _unit(T_cam0_cam1[:3, 3])
    as_given, other_way = (
        float(np.degrees(epipolar_spread(R, direction, m))) for m in (matches, exchanged)
    )
    if other_way * _EXPLAINS.clearly_worse > as_given or other_way > _EXPLAINS.exchanged_deg:
        return ()
    return (
        Finding(
            "cameras swapped",
            f"the calibration fits the images to {other_way:.3f} deg with cam0 and cam1 exchanged, "
            "and to "
            f"{as_given:.3f} deg as given; exchange the two image folders",
        ),
    )


# --- inertial sensor
# ------------------------------------------------------------------------------------------------


def judge_imu(
    alignment: ImuAlignment, lever_arm: LeverArm | NotObservable, T_cam0_imu: FloatArray
) -> tuple[Finding, ...]:
    """Compare measured IMU-camera extrinsics and clocks with a given transform (4, 4)."""
    found = [*_judge_rotation(alignment, T_cam0_imu[:3, :3])]
    if isinstance(lever_arm, LeverArm):
        found += _judge_translation(lever_arm, T_cam0_imu)
    limit_s = max(_NAMED.offset_s, _NAMED.sigmas * alignment.time_offset_sigma_s)
    if alignment.time_offset_sigma_s < TIME_OFFSET_S and abs(alignment.time_offset_s) > limit_s:
        off_ms = 1e3 * alignment.time_offset_s
        sigma_ms = 1e3 * alignment.time_offset_sigma_s
        found.append(
            Finding(
                "clocks apart",
                f"IMU minus camera {off_ms:+.2f} ms (standard deviation {sigma_ms:.2f})",
            )
        )
    return tuple(found)


def _judge_rotation(alignment: ImuAlignment, R: FloatArray) -> Iterator[Finding]:
    """Compare the measured rotation with a given one (3, 3) and with its inverse."""
    off = so3_log(alignment.R_cam0_imu @ R.T)
    sigma = np.maximum(alignment.rotation_sigma_deg, 1e-3)
    if not (
        np.abs(np.degrees(off)) > np.maximum(_NAMED.imu_rotation_deg, _NAMED.sigmas * sigma)
    ).any():
        return
    inverse_deg = float(rotation_angle_deg(alignment.R_cam0_imu @ R))
    if inverse_deg < max(_EXPLAINS.inverse_deg, _NAMED.sigmas * float(sigma.max())):
        yield Finding(
            "IMU-camera rotation inverted",
            f"the inverse of the given one fits to {inverse_deg:.2f} deg",
        )
        return
    x, y, z = np.degrees(off)
    yield Finding(
        "IMU-camera rotation wrong",
        f"off by {float(np.degrees(np.linalg.norm(off))):.2f} deg ({x:+.2f} {y:+.2f} {z:+.2f} "
        "about x y z of cam0; "
        f"standard deviations {sigma[0]:.2f} {sigma[1]:.2f} {sigma[2]:.2f})",
    )


def _judge_translation(lever_arm: LeverArm, T_cam0_imu: FloatArray) -> Iterator[Finding]:
    """Compare the measured translation with a given one, and with its likely confusions."""
    R = T_cam0_imu[:3, :3]
    t = T_cam0_imu[:3, 3]
    off_m = float(np.linalg.norm(lever_arm.t_cam0_imu - t))
    sigma_m = float(np.linalg.norm(lever_arm.sigma_m))
    if off_m <= max(_NAMED.lever_arm_m, _NAMED.sigmas * sigma_m):
        return
    others = {
        "its negative": -t,
        "as the camera's position in the IMU frame it": -R @ t,
        "the inverse transform": -R.T @ t,
    }
    nearest = min(
        others, key=lambda name: float(np.linalg.norm(lever_arm.t_cam0_imu - others[name]))
    )
    near_m = float(np.linalg.norm(lever_arm.t_cam0_imu - others[nearest]))
    if near_m < 0.5 * off_m:
        yield Finding(
            "IMU-camera translation inverted",
            f"measured {_triple(lever_arm.t_cam0_imu)} m, given {_triple(t)} m; {nearest} fits to "
            f"{near_m:.3f} m",
        )
        return
    yield Finding(
        "IMU-camera translation wrong",
        f"measured {_triple(lever_arm.t_cam0_imu)} m (standard deviations "
        f"{_triple(lever_arm.sigma_m)}), "
        f"given {_triple(t)} m",
    )


def judge_velocity_lever_arm(
    camera: StereoCamera,
    tracks: FeatureTracks,
    times_ns: IntArray,
    rates: Rates,
    T_cam0_imu: FloatArray,
) -> tuple[Finding, ...]:
    """Check whether the translation of a recording with velocities is the camera's position in the
    IMU frame.

    Args:
        camera: rectified pair.
        tracks: features.
        times_ns: (F,) frame times.
        rates: velocities.
        T_cam0_imu: (4, 4) as given.
    """
    R = T_cam0_imu[:3, :3]
    t = T_cam0_imu[:3, 3]
    both = np.concatenate([rates.linear, rates.angular], axis=1)
    at = times_ns - times_ns[0]
    clock = rates.times_ns - times_ns[0]
    velocities = np.stack([np.interp(at, clock, both[:, k]) for k in range(6)], axis=1)
    verdict = judge_lever_arms(camera, tracks, times_ns, velocities, R, (-R.T @ t, t))
    if verdict.better != 1:
        return ()
    x, y, z = -R @ t
    return (
        Finding(
            "IMU-camera translation inverted",
            f"velocities and features give the camera's position as {verdict.place:+.2f} +- "
            f"{verdict.place_sigma:.2f} "
            "between that of the transform (-1) and its translation taken as a position in the "
            "IMU frame (+1); "
            f"the translation must be -R t = ({x:.3f}, {y:.3f}, {z:.3f}) m",
        ),
    )


def _unit(v: FloatArray) -> FloatArray:
    return v / np.linalg.norm(v)


def _between_deg(a: FloatArray, b: FloatArray) -> float:
    sine = np.linalg.norm(np.cross(a, b))
    return float(np.degrees(np.arctan2(sine, a @ b)))


def _triple(v: FloatArray) -> str:
    return f"({v[0]:.3f}, {v[1]:.3f}, {v[2]:.3f})"
