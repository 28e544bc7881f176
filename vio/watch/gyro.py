"""What is wrong with a gyro, or with the extrinsics, by its turning against that of the images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from vio.evaluation import rotation_angle_deg
from vio.geometry.lie import FloatArray, nearest_rotation
from vio.watch.accelerometer import AXES_WORSE
from vio.watch.axes import axes_text, matrix_text, signed_permutations, triple_text
from vio.watch.evidence import Evidence
from vio.watch.finding import InertialFault, InertialFinding
from vio.watch.turning import AGREES, FAR_OFFSETS_S, Turning

_DISAGREES = 0.5  # share of the turning that the best linear map leaves unexplained
_EXCESS_CLIPPED = 0.5  # excess allowed where readings are clipped, which turns and shortens what the gyro shows
_EXCESS_BRIEF = 0.7  # likewise with fewer intervals than the first look has


@dataclass(frozen=True, slots=True)
class _Explanation:
    """A mistake that would make the gyro turn as it does."""

    fault: InertialFault
    C: FloatArray  # (3, 3) map from gyro to camera that it would mean
    seen: str
    words: str


def judge_gyro(evidence: Evidence, unit: float) -> list[InertialFinding]:
    """Compare the gyro's turning, mapped by the given rotation, with that of the images.

    Args:
        evidence: the fits.
        unit: factor that makes the accelerometer's readings m/s^2.
    """
    turning, R, brief = evidence.turning, evidence.R_cam0_imu, evidence.brief
    if turning.unexplained > _DISAGREES:
        return [] if brief else [_disagreement(turning)]
    limit = max(turning.tolerance, _EXCESS_CLIPPED * evidence.clipped, _EXCESS_BRIEF * brief)
    if turning.unexplained > AGREES or turning.excess(R, 1.0) < limit:
        return []
    if turning.fits(R):
        return _judge_scale(evidence, R)
    if not evidence.told:
        return []
    seen = _contradiction(turning, R)
    likely = _explanations(R, gyro_alone=_gyro_alone(evidence, unit))
    doubtful = brief or evidence.clipped
    for mistake in chain(likely, () if doubtful else _free_explanations(turning.S_cg)):
        if turning.fits(mistake.C):
            finding = InertialFinding(mistake.fault, f"{seen}, and {mistake.seen}", mistake.words)
            return [finding, *_judge_scale(evidence, mistake.C)]
    if doubtful:
        return []
    stretch = np.linalg.svd(turning.A, compute_uv=False)
    return [
        InertialFinding(
            "gyro units",
            f"{seen}, and no rotation fits: the best linear map stretches by {triple_text(stretch)}",
            "the gyro's axes have different scales, or one of them is dead",
        )
    ]


def _gyro_alone(evidence: Evidence, unit: float) -> bool:
    """Whether the accelerometer sides with the given rotation, so that the gyro alone is at fault."""
    if evidence.force is None:
        return False
    best = nearest_rotation(evidence.turning.S_cg)
    return evidence.force.cost(evidence.R_cam0_imu * unit) * AXES_WORSE < evidence.force.cost(best * unit)


def _contradiction(turning: Turning, R: FloatArray) -> str:
    """Say how far the given rotation (3, 3) contradicts the gyro, and what fits best."""
    best = nearest_rotation(turning.S_cg)
    near = f"; the best rotation lies {rotation_angle_deg(best @ R.T):.0f} deg from the given one"
    few = {1: "one axis", 2: "two axes"}.get(turning.axes)
    about = "" if few is None else f" (it turns about {few} only, so other explanations fit, too)"
    share = turning.excess(R, max(turning.scale(R), 0.0))
    return (
        f"with the given T_cam0_imu {100 * share:.0f} % of the images' turning contradicts the gyro"
        f"{near if turning.fits(best) else ''}{about}"
    )


def _disagreement(turning: Turning) -> InertialFinding:
    rate = np.degrees(float(np.sqrt(np.trace(turning.S_cc))))
    felt = float(np.sqrt(np.trace(turning.S_gg)))
    return InertialFinding(
        "gyro disagrees",
        f"the images turn by {rate:.1f} deg/s (RMS) and the gyro explains {100 * (1 - turning.unexplained):.0f} % of "
        f"it at no better clock offset within {FAR_OFFSETS_S[-1]:g} s (the gyro's own RMS is {felt:.3g})",
        "the IMU's file may belong to another recording, the clocks may be further apart, the gyro may be dead, or the "
        "images may show something that moves with the camera",
    )


def _judge_scale(evidence: Evidence, C: FloatArray) -> list[InertialFinding]:
    """Judge the gyro's unit by the factor on a map (3, 3) to the camera, unless it does no harm."""
    turning = evidence.turning
    scale = turning.scale(C)
    if turning.excess(C, 1.0) < turning.tolerance or (evidence.clipped and 0.5 < scale < 2.0):
        return []
    seen = (
        f"the gyro must be multiplied by {scale:.4g} to turn as the images do "
        f"(then {100 * turning.unexplained:.1f} % differ)"
    )
    named = {
        np.pi / 180: "the gyro is in deg/s: multiply its readings by pi/180",
        180 / np.pi: "the gyro was converted from deg/s twice: multiply its readings by 180/pi",
        np.pi / 180e3: "the gyro is in mdeg/s: multiply its readings by pi/180000",
        1e-3: "the gyro is in mrad/s: divide its readings by 1000",
    }
    odd = "the gyro's scale is wrong, or the camera's focal length is; rad/s are expected"
    words = next((words for factor, words in named.items() if abs(np.log(scale / factor)) < 0.15), odd)
    return [InertialFinding("gyro units", seen, words)]


def _explanations(R: FloatArray, *, gyro_alone: bool) -> Iterator[_Explanation]:
    """Mistakes with a name, the likeliest first."""
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
        "the gyro turns left-handed (all three rates have the wrong sign); change the sign of its readings",
    )
    if not gyro_alone:
        yield _Explanation(
            "extrinsics rotation",
            np.eye(3),
            "the identity fits",
            "IMU and camera have the same axes in these files; the rotation of T_cam0_imu should be the identity",
        )
    for P in signed_permutations():
        # The record shows P^T of the true rates, so that R P maps it to the camera.
        words = f"the gyro's axes read {axes_text(P.T)} where [+x +y +z] belong"
        if np.linalg.det(P) < 0:
            words = f"{words}, a left-handed frame; put them in order"
            yield _Explanation("gyro axes", R @ P, "exchanged axes fit", words)
        elif gyro_alone:
            yield _Explanation("gyro axes", R @ P, "exchanged axes fit", f"{words}; put them in order")
        else:
            words = f"T_cam0_imu belongs to other IMU axes, or {words}; its rotation should be {matrix_text(R @ P)}"
            yield _Explanation("extrinsics rotation", R @ P, "a turn by quarter circles fits", words)


def _free_explanations(S_cg: FloatArray) -> Iterator[_Explanation]:
    """The rotation and the reflection that fit moments (3, 3) best. Reference: Markley 1988, Wahba's problem by SVD."""
    best = nearest_rotation(S_cg)
    yield _Explanation(
        "extrinsics rotation",
        best,
        "another rotation fits",
        f"the rotation of T_cam0_imu should be about {matrix_text(best)}; run `vio calibrate`",
    )
    yield _Explanation(
        "gyro axes",
        -nearest_rotation(-S_cg),  # turns with the wrong sign are those of a reflection
        "a mirrored frame fits",
        "the gyro's axes are left-handed; check their order and signs",
    )
