"""Measurement of a recording's calibration from the recording itself, and comparison with the
given one.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vio.calibration.egomotion import CameraMotion, camera_motion, stereo_twists
from vio.calibration.findings import Finding, NotObservable
from vio.calibration.gyro import align_gyro
from vio.calibration.inertial import ImuAlignment, rates_of
from vio.calibration.intrinsics import Intrinsics, judge_intrinsics
from vio.calibration.lever_arm import LeverArm, estimate_lever_arm
from vio.calibration.pair_rotation import is_turned_by_rows
from vio.calibration.severity import StereoError
from vio.calibration.stereo import (
    RayMatches,
    RowResiduals,
    StereoEstimate,
    epipolar_angles,
    join_matches,
    refine_stereo,
    row_residuals,
    too_few,
)
from vio.calibration.stereo_field import PARAMETERS, field_of
from vio.calibration.verdicts import (
    judge_exchange,
    judge_imu,
    judge_stereo,
    judge_velocity_lever_arm,
)
from vio.datasets.image_pairs import gray_levels
from vio.datasets.images import load_gray
from vio.errors import EstimationError
from vio.geometry.distortion import StereoRig, unproject_pixel
from vio.geometry.lie import FloatArray, se3_from_parts, so3_log
from vio.geometry.rectify import rectify_pixels
from vio.geometry.stereo import StereoCamera, left_rays
from vio.offline.colmap.pairs import adjust_rig, relative_pose, sift_matches
from vio.offline.keyframes import choose_keyframes, tracked_segments
from vio.offline.points import build_tracks
from vio.offline.self_calibration import Segment, SelfCalibration, intrinsics_of, self_calibrate
from vio.offline.source import CalibrationSource, track
from vio.protocols import Dataset, Frontend
from vio.records import BoolArray, FeatureTracks, IntArray, MotionSample, Recording

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Segments:
    """Pieces of a recording that calibrate the rig in motion."""

    segment: int = 36  # frames, pieces, keyframes of each, for the rig in motion
    segments: int = 6
    keyframes: int = 20
    gate_px: float = 8.0  # wide: wrong extrinsics displace every point


_IN_MOTION = _Segments()


class _RoundRules(NamedTuple):
    """How a calibration is repeated."""

    # What the gate leaves of a camera that is far off is biased: it is measured again with what was
    # found taken out, until less than this is left.
    max_rounds: int = 5
    settled_deg: float = 0.05
    # a frame of a feature file contains fewer matches than a pair of images
    frames_per_pair: int = 5
    max_turn_deg: float = 15.0  # with a larger one, extrinsics are those of another rig
    # with larger row differences, features are matched wrongly or not at all
    max_row_offset_px: float = 2.0


_ROUND = _RoundRules()
_UNUSABLE = ("cameras swapped", "baseline translation inverted")  # features are unusable then

_ROWS = "row alignment"
_IMU = "IMU-camera rotation and time offset"
_LEVER_ARM = "lever arm"
_INTRINSICS = "focal length and principal point"
_NOT_TURNED = NotObservable(
    _INTRINSICS, "the right camera is turned: measure again with the calibration found here"
)
_NOT_TRACKED = NotObservable(_INTRINSICS, "no features were tracked")


@dataclass(frozen=True, slots=True)
class ImuReport:
    """Estimated extrinsics and clock offset of the motion sensor."""

    alignment: ImuAlignment | NotObservable
    lever_arm: LeverArm | NotObservable
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True, slots=True)
class CalibrationReport:
    """All results."""

    source: CalibrationSource
    stereo: StereoEstimate | NotObservable
    rows: RowResiduals | NotObservable
    imu: ImuReport
    stereo_findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    intrinsics: Intrinsics | NotObservable = _NOT_TRACKED
    in_motion: SelfCalibration | None = None  # by bundle adjustment; None: from single pairs alone
    # with the right camera as matches show it, where it is turned far: `in_motion` is beside that
    measured_again: bool = False

    @property
    def stereo_error(self) -> StereoError | None:
        """What rows and disparities are off by; None: the rows were not measured."""
        if not isinstance(self.rows, RowResiduals):
            return None
        seen_px = self.rows.disparity_px
        known = self.in_motion is not None and not self.measured_again
        if not known or self.source.dataset is None or seen_px <= 0:
            return StereoError(self.rows.rms_px, seen_px)
        assert self.in_motion is not None
        off, sigma = self.in_motion.disparity_off(self.source.dataset.recording.camera, seen_px)
        return StereoError(self.rows.rms_px, seen_px, off, sigma)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All faults found."""
        return (*self.stereo_findings, *self.imu.findings)


@dataclass(frozen=True, slots=True)
class _Matches:
    """Matches of left and right images."""

    rays: RayMatches  # of the raw cameras
    exchanged: RayMatches | None  # with the cameras exchanged; None: the cameras are equal
    z: FloatArray  # (N, 4) rectified pixels [ul vl ur vr]; empty where images cannot be rectified


def _notes(source: CalibrationSource) -> tuple[str, ...]:
    if source.rejection is None:
        return ()
    return (f"the reader rejects this calibration: {source.rejection}",)


def _judge_exchange_or_stereo(
    matches: _Matches,
    stereo: StereoEstimate | NotObservable,
    given: FloatArray,
    agreeing: RayMatches,
) -> tuple[Finding, ...]:
    """Judge whether the cameras are exchanged; where they are not, the given extrinsics."""
    findings: tuple[Finding, ...] = ()
    if matches.exchanged is not None:
        findings = judge_exchange(matches.rays, matches.exchanged, given)
    if not findings and isinstance(stereo, StereoEstimate):
        findings = judge_stereo(stereo, given, agreeing)
    return findings


def _again(
    source: CalibrationSource, stereo: StereoEstimate | NotObservable, findings: tuple[Finding, ...]
) -> CalibrationSource | None:
    """Return the data with the right camera as measured, where it is turned too far for features
    to be tracked; None: it is not, or nothing is known of it.
    """
    if not isinstance(stereo, StereoEstimate) or any(f.fault in _UNUSABLE for f in findings):
        return None
    given = source.T_cam0_cam1
    turn_deg = np.degrees(so3_log(stereo.R_cam1_cam0 @ given[:3, :3]))
    if not is_turned_by_rows(turn_deg) or np.linalg.norm(turn_deg) > _ROUND.max_turn_deg:
        return None
    R = stereo.R_cam1_cam0
    # its place is that given: the direction of a short baseline is measured badly
    return source.with_right(se3_from_parts(R, -R @ given[:3, 3]))


def _fault_of_rows(rows: RowResiduals | NotObservable, findings: tuple[Finding, ...]) -> str | None:
    """Return the fault for which features may not be of the same point; None: there is none."""
    misaligned = isinstance(rows, RowResiduals) and (
        abs(rows.median_px) + rows.spread_px > _ROUND.max_row_offset_px
    )
    if not misaligned and not any(f.fault in _UNUSABLE for f in findings):
        return None
    return findings[0].fault if findings else "image rows do not match"


def measure(
    source: CalibrationSource,
    build_frontend: Callable[[Dataset], Frontend],
    *,
    pairs: int,
    frames: int,
    begin: Callable[[str], None],
    progress: Callable[[int, int], None],
) -> CalibrationReport:
    """Measure a recording's calibration: first left and right, which everything else depends on.

    Args:
        source: the recording.
        build_frontend: makes the front end that tracks its images.
        pairs: stereo pairs to match.
        frames: frames to track for the motion sensor.
        begin: called with the part that comes next.
        progress: called with (done, total) of the part at work, where that is known.

    Raises:
        VioError: the recording cannot be read.
    """
    notes = _notes(source)
    tracked = None
    if source.raw_pairs:
        begin("match left and right")
        matches = _match_images(source, pairs, progress)
    else:
        assert source.dataset is not None
        begin("track features")
        tracked = track(source.dataset, build_frontend, frames, progress)
        matches = _match_tracks(source.dataset.recording, tracked[0], pairs)
    given = source.T_cam0_cam1
    stereo, agreeing = _measure_stereo(matches.rays)
    findings = _judge_exchange_or_stereo(matches, stereo, given, agreeing)
    if source.dataset is None:
        rows = NotObservable(_ROWS, "the images cannot be rectified")
        why = "the left-right calibration must be corrected first: it determines the positions and depths of features"
        return CalibrationReport(source, stereo, rows, _no_imu(why), findings, notes)
    described = row_residuals(matches.z, *source.image_size(matches.z))
    fault = _fault_of_rows(described, findings)
    if again := _again(source, stereo, findings):
        # features are tracked along rows that agree; what the given calibration is off by, is told
        # by the matches that need no rows
        report = measure(
            again, build_frontend, pairs=pairs, frames=frames, begin=begin, progress=progress
        )
        if report.in_motion is not None and isinstance(report.stereo, StereoEstimate):
            findings = judge_stereo(report.stereo, given, agreeing)
        return replace(
            report,
            rows=described,
            stereo_findings=findings,
            notes=notes,
            intrinsics=_NOT_TURNED,
            measured_again=True,
        )
    if fault is not None:
        why = f"{fault}: correct that first, then measure again"
        return CalibrationReport(source, stereo, described, _no_imu(why), findings, notes)
    recording = source.dataset.recording
    if tracked is None:
        begin("track features")
        tracked = track(source.dataset, build_frontend, frames, progress)
    tracks, samples = tracked
    in_motion: SelfCalibration | None = None
    intrinsics: Intrinsics | NotObservable = NotObservable(
        _INTRINSICS, "left and right could not be measured"
    )
    if isinstance(stereo, StereoEstimate):
        begin("adjust left and right in motion")
        stereo, intrinsics, in_motion = _measure_in_motion(source, stereo, tracks)
        findings = (*judge_stereo(stereo, given, agreeing), *judge_intrinsics(intrinsics))
    begin("adjust the motion sensor")
    motion = camera_motion(recording.camera, tracks, recording.frame_times_ns)
    imu = _measure_imu(recording, tracks, samples, motion)
    return CalibrationReport(source, stereo, described, imu, findings, notes, intrinsics, in_motion)


# --- left and right
# -------------------------------------------------------------------------------------------------


def _match_images(
    source: CalibrationSource, pairs: int, progress: Callable[[int, int], None]
) -> _Matches:
    """Return SIFT matches of spread pairs of images."""
    assert source.rig is not None
    rig = source.rig
    rotations = source.rectifying()
    rays: list[RayMatches] = []
    exchanged: list[RayMatches] = []
    z: list[FloatArray] = [np.zeros((0, 4))]
    levels, _ = gray_levels(source.raw_pairs)
    chosen = np.unique(
        np.linspace(0, len(source.raw_pairs) - 1, min(pairs, len(source.raw_pairs))).astype(int)
    )
    for done, k in enumerate(chosen.tolist()):
        left, right = (load_gray(path, levels)[0] for path in source.raw_pairs[k])
        uv0, uv1 = sift_matches(left, right)
        matches, valid = _rays(rig, uv0, uv1, k)
        rays.append(matches)
        exchanged.append(_rays(rig, uv1, uv0, k)[0])
        if source.dataset is not None:
            if rotations is not None:
                camera = source.dataset.recording.camera
                uv0, _ = rectify_pixels(rig.cam0, rotations[0], camera, uv0)
                uv1, _ = rectify_pixels(rig.cam1, rotations[1], camera, uv1)
            z.append(np.concatenate([uv0, uv1], axis=1)[valid])
        progress(done + 1, len(chosen))
    return _Matches(
        rays=join_matches(rays),
        exchanged=join_matches(exchanged) if rig.cam0 != rig.cam1 else None,
        z=np.concatenate(z),
    )


def _rays(
    rig: StereoRig, uv0: FloatArray, uv1: FloatArray, pair: int
) -> tuple[RayMatches, BoolArray]:
    """Return rays of matched pixels (N, 2) of both cameras, and a mask (N,) of the matches that
    have them.
    """
    ray0, valid0 = unproject_pixel(rig.cam0, uv0)
    ray1, valid1 = unproject_pixel(rig.cam1, uv1)
    valid = valid0 & valid1 & (ray0[:, 2] > 0.1) & (ray1[:, 2] > 0.1)
    return RayMatches(np.full(int(valid.sum()), pair), ray0[valid], ray1[valid]), valid


def _match_tracks(recording: Recording, tracks: FeatureTracks, pairs: int) -> _Matches:
    """Return the stereo rows of spread frames of a feature file."""
    frames = tracks.frames
    fresh = tracks.has_right & ~tracks.stale
    filled = np.unique(frames[fresh])
    spread = np.unique(np.linspace(0, len(filled) - 1, _ROUND.frames_per_pair * pairs).astype(int))
    rows = fresh & np.isin(frames, filled[spread] if len(filled) else filled)
    z = tracks.z[rows]
    # both cameras have the same intrinsics
    rays = (left_rays(recording.camera, uv) for uv in (z[:, :2], z[:, 2:]))
    ray0, ray1 = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    return _Matches(RayMatches(frames[rows], ray0, ray1), None, z)


def _measure_stereo(matches: RayMatches) -> tuple[StereoEstimate | NotObservable, RayMatches]:
    """Estimate by RANSAC, refinement on epipolar angles and bundle adjustment of the rig; also
    return the inliers.
    """
    if few := too_few(matches):
        return few, matches
    start = relative_pose(matches)
    if start is None:
        return NotObservable(
            "left-right extrinsics", "no rigid pose of cam1 explains the matches"
        ), matches
    refined = refine_stereo(matches, *start)
    if isinstance(refined, NotObservable):
        return refined, matches
    angles = np.abs(epipolar_angles(refined.R_cam1_cam0, refined.direction, matches))
    inliers = matches.take(angles < max(4 * np.radians(refined.residual_deg), 1e-5))
    R, direction = adjust_rig(inliers, refined.R_cam1_cam0, refined.direction)
    return replace(refined, R_cam1_cam0=R, direction=direction), inliers


def _measure_in_motion(
    source: CalibrationSource, stereo: StereoEstimate, tracks: FeatureTracks
) -> tuple[StereoEstimate, Intrinsics | NotObservable, SelfCalibration | None]:
    """Estimate the calibration by bundle adjustment over segments of video; unchanged where
    there are none, or the rig moves too little for them to tell more than single pairs.
    """
    assert source.dataset is not None
    width, height = source.image_size(tracks.z)
    recording = source.dataset.recording
    camera = replace(recording.camera, width=int(width) + 1, height=int(height) + 1)
    off: FloatArray = np.zeros(len(PARAMETERS))
    try:
        for _ in range(_ROUND.max_rounds):
            z = (
                field_of(camera, off).without(tracks.z, tracks.has_right)
                if np.any(off)
                else tracks.z
            )
            pieces = _segments(source, camera, replace(tracks, z=z), recording.frame_times_ns)
            if not pieces:
                return (
                    stereo,
                    NotObservable(
                        _INTRINSICS, "there are no six frames in a row whose motion is known"
                    ),
                    None,
                )
            step = self_calibrate(camera, pieces, intrinsics=False)
            held = step.after(off)
            if np.degrees(np.linalg.norm(so3_log(step.right_camera()[0]))) < _ROUND.settled_deg:
                break
            off = held.rig_parameters()
        free = self_calibrate(camera, pieces, intrinsics=True)
    except (EstimationError, np.linalg.LinAlgError) as error:
        log.warning("the motion was not used: %s", error)
        return stereo, NotObservable(_INTRINSICS, "its bundle adjustment failed"), None
    R, direction, rotation_deg, direction_deg = held.right_camera()
    if rotation_deg > _sigma_of_pairs_deg(stereo):
        return stereo, NotObservable(_INTRINSICS, "the rig hardly moves"), None
    if (rotations := source.rectifying()) is not None:
        R_rect_cam0, R_rect_cam1 = rotations
        R = R_rect_cam1.T @ R @ R_rect_cam0
        direction = R_rect_cam0.T @ direction
    found = replace(
        stereo,
        R_cam1_cam0=R,
        direction=direction,
        rotation_sigma_deg=rotation_deg,
        rotation_sigmas_deg=None,
        direction_sigma_deg=direction_deg,
        segments=held.segments,
    )
    return found, intrinsics_of(camera, free), held


def _sigma_of_pairs_deg(stereo: StereoEstimate) -> float:
    """Return the standard deviation of a rotation by single pairs, with what a lens leaves of it."""
    if stereo.rotation_sigmas_deg is None:
        return stereo.rotation_sigma_deg
    return max(stereo.rotation_sigma_deg, float(np.linalg.norm(stereo.rotation_sigmas_deg)))


def _segments(
    source: CalibrationSource, camera: StereoCamera, tracks: FeatureTracks, times_ns: IntArray
) -> list[Segment]:
    """Return keyframes, points and rows of pieces of the recording with tracked features."""
    motion = stereo_twists(camera, tracks, times_ns, np.zeros((len(times_ns) - 1, 6)))
    out = []
    for piece in tracked_segments(
        source.path, camera, tracks, motion, longest=_IN_MOTION.segment, most=_IN_MOTION.segments
    ):
        try:
            keyframes = choose_keyframes(piece, most=_IN_MOTION.keyframes)
            T_world_cam0 = piece.trajectory.T_world_body[keyframes]
            out.append(
                Segment(
                    T_world_cam0,
                    build_tracks(piece, keyframes, T_world_cam0, gate_px=_IN_MOTION.gate_px),
                    frames=len(piece.trajectory),
                )
            )
        except EstimationError as error:
            log.warning("a segment of video was left out: %s", error)
    return out


# --- motion sensor
# --------------------------------------------------------------------------------------------------


def _no_imu(why: str) -> ImuReport:
    return ImuReport(NotObservable(_IMU, why), NotObservable(_LEVER_ARM, why))


def _measure_imu(
    recording: Recording,
    tracks: FeatureTracks,
    samples: Sequence[MotionSample],
    motion: CameraMotion | NotObservable,
) -> ImuReport:
    if not samples:
        return _no_imu("the recording contains no motion sensor")
    if isinstance(motion, NotObservable):
        return ImuReport(motion, NotObservable(_LEVER_ARM, motion.because))
    rates = rates_of(samples)
    alignment = align_gyro(motion, rates)
    if isinstance(alignment, NotObservable):
        return ImuReport(alignment, NotObservable(_LEVER_ARM, alignment.because))
    lever_arm = estimate_lever_arm(motion, rates, alignment)
    given = recording.T_cam0_imu
    if given is None:
        return ImuReport(alignment, lever_arm)
    findings = judge_imu(alignment, lever_arm, given)
    if not rates.inertial:
        times_ns = recording.frame_times_ns
        findings = (
            *findings,
            *judge_velocity_lever_arm(recording.camera, tracks, times_ns, rates, given),
        )
    return ImuReport(alignment, lever_arm, findings)
