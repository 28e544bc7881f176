"""Faults of a gyro or of the extrinsics, found by comparing its rates with those of the camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.evaluation.errors_along_path import rotation_angle_deg
from vio.geometry.lie import FloatArray, nearest_rotation, so3_exp
from vio.imu.findings import InertialFault, InertialFinding
from vio.monitor.accelerometer import AXES_WORSE, axes_text, signed_permutations
from vio.monitor.force_fit import Evidence
from vio.monitor.gyro_fit import AGREES, FAR_OFFSETS_S, GyroFit, agreed_until
from vio.monitor.turned_imu import Turn


class _ExcessRules(NamedTuple):
    """When the gyro explains too little of the rotation."""

    # share of the rotation that the best linear map leaves unexplained
    disagreeing_share: float = 0.5
    # likewise that the gyro as it is given leaves: one that never turns leaves 1
    as_none: float = 0.9
    min_intervals: int = 20  # that show the latter at the end of a short run
    # excess allowed where readings are clipped, which rotates and shortens the gyro's rates
    clipped_share: float = 0.5
    brief_share: float = 0.7  # likewise with fewer intervals than in the first evaluation


_EXCESS = _ExcessRules()
_POWER_OF_TEN = 0.02  # of the decimal logarithm of a factor that is one: 5 %


@dataclass(frozen=True, slots=True)
class _Explanation:
    """A mistake that would explain the gyro's rates."""

    fault: InertialFault
    C: FloatArray  # (3, 3) map from gyro to camera that it implies
    seen: str
    explanation: str


def judge_gyro(evidence: Evidence, unit: float) -> list[InertialFinding]:
    """Compare the gyro's rates, mapped by the given rotation, with the camera's; forces times
    `unit` are m/s^2.
    """
    gyro_fit = evidence.gyro_fit
    R = evidence.R_cam0_imu
    brief = evidence.brief
    dead = gyro_fit.dead_axes(R)
    if dead and not evidence.clipped:
        return [_dead(gyro_fit, R, dead)]
    if evidence.turn is not None:
        C = so3_exp(evidence.turn.rotation) @ R
        return [turned_finding(evidence.turn, R), *_judge_scale(evidence, C)]
    excess = gyro_fit.excess(R, 1.0)
    if gyro_fit.unexplained > AGREES:
        # the best map may be chance, as where clocks are far apart; what is given is not
        misfit = gyro_fit.unexplained + excess**2
        enough = not brief or (evidence.last and gyro_fit.count >= _EXCESS.min_intervals)
        is_none = misfit > _EXCESS.as_none and enough
        is_off = gyro_fit.unexplained > _EXCESS.disagreeing_share and not brief
        if is_off or (is_none and not evidence.clipped):
            return [_or_since(_disagreement(gyro_fit), evidence)]
        return []
    limit = max(
        gyro_fit.tolerance, _EXCESS.clipped_share * evidence.clipped, _EXCESS.brief_share * brief
    )
    if excess < limit:
        return []
    if gyro_fit.is_chance:
        enough = not brief or (evidence.last and gyro_fit.count >= _EXCESS.min_intervals)
        if enough and not evidence.clipped:
            return [_or_since(_disagreement(gyro_fit), evidence)]
        return []
    if gyro_fit.fits(R):
        return _judge_scale(evidence, R)
    if not evidence.force_final:
        return []
    return _name_mistake(evidence, unit)


def _name_mistake(evidence: Evidence, unit: float) -> list[InertialFinding]:
    """Return which mistake in the given rotation, which does not fit, explains the gyro's rates;
    nothing where that stays open.
    """
    gyro_fit = evidence.gyro_fit
    R = evidence.R_cam0_imu
    seen = _contradiction(gyro_fit, R)
    likely = _explanations(R, gyro_alone=_gyro_alone(evidence, unit))
    uncertain = evidence.brief or evidence.clipped
    # A bias that jumps, or a mount that has turned a little, is explained by some rotation, too.
    far = gyro_fit.excess(R, max(gyro_fit.scale(R), 0.0)) > _EXCESS.disagreeing_share
    for mistake in chain(likely, () if uncertain else _free_explanations(gyro_fit.S_cg)):
        if gyro_fit.fits(mistake.C):
            seen = f"{seen}, and {mistake.seen}"
            finding = InertialFinding(mistake.fault, seen, mistake.explanation, certain=far)
            return [finding, *_judge_scale(evidence, mistake.C)]
    if uncertain:
        return []
    stretch = np.linalg.svd(gyro_fit.A, compute_uv=False)
    finding = InertialFinding(
        "gyro units",
        f"{seen}, and no rotation fits: the best linear map stretches by {_triple_text(stretch)}",
        "the gyro's axes have different scales, or images or samples of some time are missing though "
        "the stamps go on",
    )
    return [_or_since(finding, evidence)]


def _dead(gyro_fit: GyroFit, R: FloatArray, axes: list[int]) -> InertialFinding:
    """The finding of a gyro that shows nothing of rotations about some axes, mapped by a rotation
    (3, 3).
    """
    by_camera = (R.T @ gyro_fit.S_cc @ R).diagonal()[axes].sum()
    by_gyro = gyro_fit.S_gg.diagonal()[axes].sum()
    camera, gyro = np.degrees(np.sqrt([by_camera, by_gyro]))
    return InertialFinding(
        "gyro dead",
        f"about {' and '.join('xyz'[axis] for axis in axes)} of the IMU the camera rotates at "
        f"{camera:.1f} deg/s (RMS), the gyro at {gyro:.1f} deg/s, while the rest agrees",
        "the gyro is dead there, or its columns are missing or another sensor's",
    )


def _gyro_alone(evidence: Evidence, unit: float) -> bool:
    """Return whether the accelerometer agrees with the given rotation, so that only the gyro is
    at fault.
    """
    if evidence.force is None:
        return False
    best = nearest_rotation(evidence.gyro_fit.S_cg)
    return evidence.force.cost(evidence.R_cam0_imu * unit) * AXES_WORSE < evidence.force.cost(
        best * unit
    )


def _contradiction(gyro_fit: GyroFit, R: FloatArray) -> str:
    """Describe how far the given rotation (3, 3) contradicts the gyro, and which rotation fits
    best.
    """
    best = nearest_rotation(gyro_fit.S_cg)
    near = f"; the best rotation is {rotation_angle_deg(best @ R.T):.0f} deg from the given one"
    few = {1: "one axis", 2: "two axes"}.get(gyro_fit.axes)
    about = "" if few is None else f" (it rotates about {few} only, so other explanations fit, too)"
    share = gyro_fit.excess(R, max(gyro_fit.scale(R), 0.0))
    return (
        f"with the given T_cam0_imu {100 * share:.0f} % of the camera's rotation contradicts the "
        "gyro"
        f"{near if gyro_fit.fits(best) else ''}{about}"
    )


def _disagreement(gyro_fit: GyroFit) -> InertialFinding:
    rate = np.degrees(float(np.sqrt(np.trace(gyro_fit.S_cc))))
    gyro_rms = float(np.sqrt(np.trace(gyro_fit.S_gg)))
    by_gyro = (
        f"the gyro explains {100 * (1 - gyro_fit.unexplained):.0f} % of it at the best clock offset "
        f"within {FAR_OFFSETS_S[-1]:g} s"
    )
    if gyro_fit.is_chance:
        by_gyro = f"by no rotation the gyro's rates agree with it, within {FAR_OFFSETS_S[-1]:g} s"
    return InertialFinding(
        "gyro disagrees",
        f"the camera rotates at {rate:.1f} deg/s (RMS) and {by_gyro} (the gyro's own RMS is "
        f"{gyro_rms:.3g})",
        "the IMU's file may belong to another recording, the clocks may be further apart, the gyro "
        "may be dead, or the images may be in another order than that of their times, or show "
        "something that moves with the camera",
    )


def backwards(gyro_fit: GyroFit) -> InertialFinding:
    """The finding of a gyro that disagrees with images whose order is reversed."""
    return replace(
        _disagreement(gyro_fit),
        explanation="with the order of the images reversed the gyro agrees: they run backwards; "
        "number them in the order of their exposures, or reverse the list of their times",
    )


def _or_since(finding: InertialFinding, evidence: Evidence) -> InertialFinding:
    """A finding of readings that are of no use as they are: where they have agreed at first,
    something has happened since.
    """
    if evidence.record is None:
        return finding
    until_s = agreed_until(evidence.record, _EXCESS.min_intervals, evidence.R_cam0_imu)
    if until_s is None:
        return finding
    return replace(
        finding,
        fault="gyro disagrees",
        factor=None,
        seen=f"{finding.seen}, though it agrees until {until_s:.1f} s after the first frame compared",
        explanation="since then images or samples of some time are missing though the stamps go on, "
        "a clock has jumped, the IMU has turned on the rig, or its driver was started again with "
        "other settings",
    )


def _judge_scale(evidence: Evidence, C: FloatArray) -> list[InertialFinding]:
    """Judge the gyro's unit by the factor on a map (3, 3) to the camera, unless its effect is
    negligible.
    """
    gyro_fit = evidence.gyro_fit
    scale = gyro_fit.scale(C)
    if gyro_fit.excess(C, 1.0) < gyro_fit.tolerance or (evidence.clipped and 0.5 < scale < 2.0):
        return []
    seen = (
        f"the gyro must be multiplied by {scale:.4g} to agree with the images "
        f"(then {100 * gyro_fit.unexplained:.1f} % differ)"
    )
    named = {
        np.pi / 180: "the gyro is in deg/s: multiply its readings by pi/180",
        180 / np.pi: "the gyro was converted from deg/s twice: multiply its readings by 180/pi",
        np.pi / 180e3: "the gyro is in mdeg/s: multiply its readings by pi/180000",
        1e-3: "the gyro is in mrad/s: divide its readings by 1000",
    }
    odd = "the gyro's scale is wrong, or the camera's focal length is; rad/s are expected"
    power = round(float(np.log10(scale)))
    if power != 0 and abs(np.log10(scale) - power) < _POWER_OF_TEN:
        odd += f"; or all times, of images and IMU, are {10.0**-power:g} times the true ones (their unit)"
    factor = next((factor for factor in named if abs(np.log(scale / factor)) < 0.15), None)
    if factor is None:
        return [InertialFinding("gyro units", seen, odd)]
    finding = InertialFinding("gyro units", seen, named[factor], factor=factor)
    return [_or_since(finding, evidence)]


def _explanations(R: FloatArray, *, gyro_alone: bool) -> Iterator[_Explanation]:
    """Yield the known mistakes, the likeliest first."""
    if not gyro_alone:
        yield _Explanation(
            "extrinsics inverted",
            R.T,
            "the inverse of its rotation fits",
            "T_imu_cam0 was given as T_cam0_imu; invert the transform",
        )
    yield _Explanation(
        "gyro sign",
        -R,
        "the inverted gyro fits",
        "the gyro's rates are left-handed (all three have the wrong sign); change the sign of its "
        "readings",
    )
    if not gyro_alone:
        yield _Explanation(
            "extrinsics rotation",
            np.eye(3),
            "the identity fits",
            "IMU and camera have the same axes in these files; the rotation of T_cam0_imu should "
            "be the identity",
        )
    for P in signed_permutations():
        # The recording contains P^T times the true rates, so that R P maps it to the camera.
        explanation = f"the gyro's axes contain {axes_text(P.T)} in place of [+x +y +z]"
        mirrored = np.linalg.det(P) < 0
        if mirrored or gyro_alone:
            explanation += (
                f"{', a left-handed frame' if mirrored else ''}; correct their order and signs"
            )
            yield _Explanation("gyro axes", R @ P, "exchanged axes fit", explanation)
        else:
            explanation = (
                f"T_cam0_imu belongs to other IMU axes, or {explanation}; "
                f"its rotation should be {_matrix_text(R @ P)}"
            )
            yield _Explanation(
                "extrinsics rotation",
                R @ P,
                "a rotation by multiples of 90 degrees fits",
                explanation,
            )


def _free_explanations(S_cg: FloatArray) -> Iterator[_Explanation]:
    """Yield the best rotation and reflection by moments (3, 3).

    Reference: Markley 1988, Wahba's problem by SVD.
    """
    best = nearest_rotation(S_cg)
    yield _Explanation(
        "extrinsics rotation",
        best,
        "another rotation fits",
        f"the rotation of T_cam0_imu should be about {_matrix_text(best)}; run `vio calibrate`",
    )
    yield _Explanation(
        "gyro axes",
        -nearest_rotation(-S_cg),  # rotations with the wrong sign are those of a reflection
        "a mirrored frame fits",
        "the gyro's axes are left-handed; check their order and signs",
    )


def turned_finding(turn: Turn, R_cam0_imu: FloatArray) -> InertialFinding:
    """The finding of a turn against the given rotation (3, 3)."""
    degrees = np.degrees(np.linalg.norm(turn.rotation))
    R = so3_exp(turn.rotation) @ R_cam0_imu
    turned = R_cam0_imu.T @ turn.rotation
    return InertialFinding(
        "extrinsics rotation",
        f"the gyro is turned by {degrees:.1f} deg against the camera, beyond the given T_cam0_imu "
        f"(standard deviation {np.degrees(turn.sigma):.1g} deg)",
        f"the rotation of T_cam0_imu should be {_matrix_text(R, 4)}; run `vio calibrate`",
        turn_rad=(float(turned[0]), float(turned[1]), float(turned[2])),
    )


def _matrix_text(R: FloatArray, digits: int = 3) -> str:
    return "[" + ", ".join(_triple_text(row, digits) for row in R) + "]"


def _triple_text(v: npt.NDArray[np.floating], digits: int = 3) -> str:
    return f"[{v[0]:.{digits}f}, {v[1]:.{digits}f}, {v[2]:.{digits}f}]"
