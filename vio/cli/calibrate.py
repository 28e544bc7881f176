"""`vio calibrate`: what a recording says about its calibration."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from vio.calibration.egomotion import CameraMotion
    from vio.calibration.findings import Finding, NotObservable
    from vio.calibration.gyro import ImuAlignment
    from vio.calibration.levers import LeverArm
    from vio.calibration.stereo import RayMatches, RowResiduals, StereoEstimate
    from vio.geometry.distortion import StereoRig
    from vio.geometry.lie import FloatArray
    from vio.protocols import Dataset
    from vio.records import FeatureTracks, MotionSample, Recording

MARKER = "calibration.json"
_PAIRS = 30
_FRAMES = 1200
_STRETCH, _STRETCHES, _STRETCH_KEYFRAMES = 36, 6, 20  # frames, pieces, keyframes of each, for the rig in motion
_CROOKED_PX = 2.0  # rows further apart than this are matched wrongly or not at all
_HOPELESS = ("cameras swapped", "baseline translation inverted")  # features mean nothing then


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "calibrate",
        help="measure and check a calibration",
        description="Measure from a recording itself: left-right rotation and baseline direction (the length is taken "
        "as given), IMU-camera rotation, time offset and lever arm where the motion shows them; compare with the "
        "calibration given and name what is wrong. Writes a Kalibr-style and EuRoC-style YAML. Intrinsics are taken "
        "as given.",
    )
    parser.add_argument("source", metavar="SOURCE", help="a recording: folder or file, or kind:path")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for report and YAML (default calibrations/NAME)"
    )
    parser.add_argument(
        "--pairs", type=int, default=_PAIRS, metavar="N", help=f"stereo pairs matched (default {_PAIRS})"
    )
    parser.add_argument(
        "--frames", type=int, default=_FRAMES, metavar="N", help=f"frames tracked for the IMU (default {_FRAMES})"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(execute=execute)


@dataclass(frozen=True, slots=True)
class _Source:
    """A recording as given, before anything is believed of it."""

    path: Path
    rig: StereoRig | None  # as calibrated; None: features without an image size
    raw_pairs: tuple[tuple[Path, Path], ...]  # image files, unrectified where the cameras are; empty: features only
    dataset: Dataset | None  # None: the calibration is such that images cannot be rectified
    refused: str | None  # why not


@dataclass(frozen=True, slots=True)
class _Report:
    """All results."""

    source: _Source
    stereo: StereoEstimate | NotObservable
    rows: RowResiduals | NotObservable
    imu: ImuAlignment | NotObservable
    lever: LeverArm | NotObservable
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]


def execute(args: argparse.Namespace) -> int:
    """Run the subcommand."""
    import json

    from vio import colmap
    from vio.atomic import atomic_folder
    from vio.cli.running import free_folder, rendering
    from vio.errors import ConfigError
    from vio.threads import one_blas_thread

    if args.pairs < 1 or args.frames < 2:
        raise ConfigError("--pairs must be at least 1 and --frames at least 2")
    colmap.quiet()
    source = _open(args.source)
    with one_blas_thread(), rendering(f"calibrate {source.path.name}") as show:
        report = _measure(source, args.pairs, args.frames, show)
    out = args.out or free_folder(source.path, Path("calibrations"))
    facts = {"out": str(out), **_facts(report)}
    with atomic_folder(out, replace=True, marker=MARKER) as folder:
        _write_yaml(folder, report)
        (folder / MARKER).write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    if args.json:
        print(json.dumps(facts))
        return 0
    for name, value in _table(report):
        print(f"{name:<22} {value}")
    print(f"{'results':<22} {out}")
    return 0


# --- the recording --------------------------------------------------------------------------------------------------


def _open(text: str) -> _Source:
    """Open a recording with its calibration taken literally, even one that cannot be rectified with it."""
    from vio.datasets import DatasetSettings, open_dataset
    from vio.datasets.image_pairs import ImageDataset
    from vio.datasets.rectified import RectifiedDataset
    from vio.errors import CalibrationError
    from vio.geometry.distortion import rig_from_rectified

    try:
        dataset = open_dataset(text, DatasetSettings(extrinsics="literal"))
    except CalibrationError as error:
        found = _raw_euroc(Path(text.removeprefix("euroc:")), str(error))
        if found is None:
            raise
        return found
    recording = dataset.recording
    if isinstance(dataset, RectifiedDataset):
        return _Source(recording.path, dataset.rectifier.rig, dataset.pairs, dataset, None)
    import numpy as np

    known = recording.camera.width is not None
    T = np.eye(4) if recording.T_cam0_imu is None else recording.T_cam0_imu
    rig = rig_from_rectified(recording.camera, T) if known else None
    pairs = dataset.pairs if isinstance(dataset, ImageDataset) else ()
    return _Source(recording.path, rig, pairs, dataset, None)


def _raw_euroc(path: Path, refused: str) -> _Source | None:
    """An EuRoC folder whose cameras cannot be rectified: its rig and images as they stand; None: it is none."""
    from vio.datasets.euroc_files import read_camera_yaml
    from vio.datasets.image_pairs import pair_images
    from vio.geometry.distortion import StereoRig

    mav = path / "mav0" if (path / "mav0").is_dir() else path
    if not all((mav / name / "sensor.yaml").is_file() and (mav / name / "data").is_dir() for name in ("cam0", "cam1")):
        return None
    (cam0, T0), (cam1, T1) = (read_camera_yaml(mav / name / "sensor.yaml") for name in ("cam0", "cam1"))
    pairs = pair_images(mav / "cam0" / "data", mav / "cam1" / "data")
    return _Source(path, StereoRig(cam0, cam1, T0, T1), pairs, None, refused)


# --- measuring ------------------------------------------------------------------------------------------------------


def _measure(source: _Source, pairs: int, frames: int, show: Callable[[int, int], None]) -> _Report:
    from vio.calibration.egomotion import camera_motion
    from vio.calibration.findings import NotObservable
    from vio.calibration.stereo import RowResiduals, row_residuals
    from vio.calibration.verdicts import judge_exchange, judge_stereo

    notes = () if source.refused is None else (f"the reader refuses this calibration: {source.refused}",)
    tracks, samples = _tracks(source, frames) if not source.raw_pairs else (None, ())
    matches, z, exchanged = _stereo_matches(source, tracks, pairs, show)
    swapped = () if exchanged is None else judge_exchange(matches, exchanged, _given_baseline(source))
    stereo, matches = _stereo_estimate(matches)
    rows: RowResiduals | NotObservable
    rows = NotObservable("row alignment", "the images cannot be rectified")
    imu: ImuAlignment | NotObservable
    lever: LeverArm | NotObservable
    if source.dataset is None:
        why = "the left-right calibration must be mended first: it decides where features are and how far away"
        imu, lever = NotObservable("IMU-camera rotation and time offset", why), NotObservable("lever arm", why)
        return _Report(source, stereo, rows, imu, lever, swapped or _judged(source, stereo, matches), notes)
    rows = row_residuals(z, *_size(source, z))
    recording = source.dataset.recording
    findings = swapped or _judged(source, stereo, matches)
    crooked = isinstance(rows, RowResiduals) and abs(rows.median_px) + rows.spread_px > _CROOKED_PX
    if crooked or any(f.fault in _HOPELESS for f in findings):
        why = f"{findings[0].fault if findings else 'image rows do not match'}: mend that first, then measure again"
        imu, lever = NotObservable("IMU-camera rotation and time offset", why), NotObservable("lever arm", why)
        return _Report(source, stereo, rows, imu, lever, findings, notes)
    if tracks is None:
        tracks, samples = _tracks(source, frames, show)
    motion = camera_motion(recording.camera, tracks, recording.frame_times_ns)
    if not isinstance(motion, NotObservable) and not isinstance(stereo, NotObservable):
        stereo = _stereo_in_motion(source, stereo, tracks, motion)
        findings = judge_stereo(stereo, _given_baseline(source), matches)
    imu, lever, more = _measure_imu(recording, tracks, samples, motion)
    return _Report(source, stereo, rows, imu, lever, (*findings, *more), notes)


def _judged(source: _Source, stereo: StereoEstimate | NotObservable, matches: RayMatches) -> tuple[Finding, ...]:
    from vio.calibration.findings import NotObservable
    from vio.calibration.verdicts import judge_stereo

    return () if isinstance(stereo, NotObservable) else judge_stereo(stereo, _given_baseline(source), matches)


def _stereo_in_motion(
    source: _Source, stereo: StereoEstimate, tracks: FeatureTracks, motion: CameraMotion
) -> StereoEstimate:
    """The left-right extrinsics by bundle adjustment over stretches of video; as they were where that fails."""
    import logging
    from dataclasses import replace

    from vio import colmap
    from vio.calibration.stereo import combine_stereo
    from vio.errors import EstimationError
    from vio.mapping import build_tracks, choose_keyframes, tracked_stretches

    assert source.dataset is not None
    recording = source.dataset.recording
    width, height = _size(source, tracks.z)
    recording = replace(recording, camera=replace(recording.camera, width=int(width) + 1, height=int(height) + 1))
    R_rect0, R_rect1 = _rectifying(source) or (None, None)
    found = []
    for piece in tracked_stretches(recording, tracks, motion.frames, motion.twists, longest=_STRETCH, most=_STRETCHES):
        try:
            keyframes = choose_keyframes(piece, most=_STRETCH_KEYFRAMES)
            T_world_cam0 = piece.trajectory.T_world_body[keyframes]
            points = build_tracks(piece, keyframes, T_world_cam0, gate_px=8.0)
            R, direction = colmap.adjust_rig_in_motion(recording.camera, T_world_cam0, points)
        except EstimationError as error:
            logging.getLogger(__name__).warning("a stretch of video was left out: %s", error)
            continue
        if R_rect0 is not None and R_rect1 is not None:
            R, direction = R_rect1.T @ R @ R_rect0, R_rect0.T @ direction
        found.append((R, direction))
    return combine_stereo(stereo, found) or stereo


def _rectifying(source: _Source) -> tuple[FloatArray, FloatArray] | None:
    """Rotations of the raw cameras into the rectified ones; None: they are rectified."""
    from vio.datasets.rectified import RectifiedDataset
    from vio.geometry.rectify import rectifying_rotations

    if not isinstance(source.dataset, RectifiedDataset) or source.dataset.rectifier.maps is None:
        return None
    return rectifying_rotations(source.dataset.rectifier.rig)[:2]


def _stereo_matches(
    source: _Source, tracks: FeatureTracks | None, pairs: int, show: Callable[[int, int], None]
) -> tuple[RayMatches, FloatArray, RayMatches | None]:
    """Matches of spread pairs as rays of the raw cameras, and as rectified pixels `[ul vl ur vr]` where possible.

    Third, where the cameras differ, the same matches with each image taken for the other camera's.
    """
    import numpy as np

    from vio import colmap
    from vio.calibration.stereo import join_matches
    from vio.datasets.images import load_gray
    from vio.geometry.rectify import rectify_pixels

    if tracks is not None:
        return (*_track_matches(source, tracks, pairs), None)
    assert source.rig is not None
    rig, dataset = source.rig, source.dataset
    rotations = _rectifying(source)
    parts: list[RayMatches] = []
    exchanged: list[RayMatches] = []
    z: list[FloatArray] = []
    chosen = np.unique(np.linspace(0, len(source.raw_pairs) - 1, pairs).astype(int))
    for done, k in enumerate(chosen.tolist()):
        left, right = (load_gray(path)[0] for path in source.raw_pairs[k])
        uv0, uv1 = colmap.sift_matches(left, right)
        matches, valid = _rays(rig, uv0, uv1, k)
        parts.append(matches)
        exchanged.append(_rays(rig, uv1, uv0, k)[0])
        if dataset is not None:
            if rotations is not None:
                camera = dataset.recording.camera
                uv0, _ = rectify_pixels(rig.cam0, rotations[0], camera, uv0)
                uv1, _ = rectify_pixels(rig.cam1, rotations[1], camera, uv1)
            z.append(np.concatenate([uv0, uv1], axis=1)[valid])
        show(done + 1, len(chosen))
    differ = rig.cam0 != rig.cam1
    joined = np.concatenate([*z, np.zeros((0, 4))])
    return join_matches(parts), joined, join_matches(exchanged) if differ else None


def _rays(rig: StereoRig, uv0: FloatArray, uv1: FloatArray, pair: int) -> tuple[RayMatches, Any]:
    """Rays of matched pixels of both cameras, and which of the matches have them."""
    import numpy as np

    from vio.calibration.stereo import RayMatches
    from vio.geometry.distortion import unproject_pixel

    ray0, valid0 = unproject_pixel(rig.cam0, uv0)
    ray1, valid1 = unproject_pixel(rig.cam1, uv1)
    valid = valid0 & valid1 & (ray0[:, 2] > 0.1) & (ray1[:, 2] > 0.1)
    return RayMatches(np.full(int(valid.sum()), pair), ray0[valid], ray1[valid]), valid


def _track_matches(source: _Source, tracks: FeatureTracks, pairs: int) -> tuple[RayMatches, FloatArray]:
    """The stereo rows of spread frames of a feature file."""
    import numpy as np

    from vio.calibration.stereo import RayMatches

    assert source.dataset is not None
    camera = source.dataset.recording.camera
    frames = tracks.frames
    filled = np.unique(frames[tracks.has_right & ~tracks.stale])
    chosen = filled[np.unique(np.linspace(0, len(filled) - 1, 5 * pairs).astype(int))] if len(filled) else filled
    rows = np.isin(frames, chosen) & tracks.has_right & ~tracks.stale
    z = tracks.z[rows]

    def rays(uv: FloatArray) -> FloatArray:
        plane = (uv - (camera.cu, camera.cv)) / (camera.fu, camera.fv)
        ray = np.concatenate([plane, np.ones((len(uv), 1))], axis=1)
        out: FloatArray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
        return out

    return RayMatches(frames[rows], rays(z[:, :2]), rays(z[:, 2:])), z


def _stereo_estimate(matches: RayMatches) -> tuple[StereoEstimate | NotObservable, RayMatches]:
    """RANSAC, refinement on epipolar angles, bundle adjustment of the rig; with the matches that agree."""
    from dataclasses import replace

    import numpy as np

    from vio import colmap
    from vio.calibration.findings import NotObservable
    from vio.calibration.stereo import epipolar_angles, refine_stereo, too_few

    if few := too_few(matches):
        return few, matches
    start = colmap.relative_pose(matches)
    if start is None:
        return NotObservable("left-right extrinsics", "no rigid pose of cam1 explains the matches"), matches
    refined = refine_stereo(matches, *start)
    if isinstance(refined, NotObservable):
        return refined, matches
    angles = np.abs(epipolar_angles(refined.R_cam1_cam0, refined.direction, matches))
    inliers = matches.take(angles < max(4 * np.radians(refined.residual_deg), 1e-5))
    R, direction = colmap.adjust_rig(inliers, refined.R_cam1_cam0, refined.direction)
    return replace(refined, R_cam1_cam0=R, direction=direction), inliers


def _given_baseline(source: _Source) -> FloatArray:
    import numpy as np

    if source.rig is not None:
        return source.rig.T_cam0_cam1
    assert source.dataset is not None
    out = np.eye(4)
    out[0, 3] = source.dataset.recording.camera.baseline_m
    return out


def _size(source: _Source, z: FloatArray) -> tuple[float, float]:
    camera = None if source.dataset is None else source.dataset.recording.camera
    if camera is not None and camera.width is not None and camera.height is not None:
        return float(camera.width), float(camera.height)
    return (float(z[:, 0].max()) + 1, float(z[:, 1].max()) + 1) if len(z) else (1.0, 1.0)


def _tracks(
    source: _Source, frames: int, show: Callable[[int, int], None] = lambda done, total: None
) -> tuple[FeatureTracks, tuple[MotionSample, ...]]:
    """Stereo tracks of the first frames, from the file or by the front end, and the motion samples."""
    from frontend import build_frontend
    from frontend.settings import FrontendSettings
    from vio.datasets.features import FeatureDataset
    from vio.records import Observations, StereoFrame, feature_tracks

    dataset = source.dataset
    assert dataset is not None
    if isinstance(dataset, FeatureDataset):
        return dataset.tracks, dataset.motion
    recording = dataset.recording
    total = min(frames, len(recording.frame_times_ns))
    front = build_frontend("auto", recording.camera, FrontendSettings(), dataset)
    seen: dict[int, Observations] = {}
    samples: list[MotionSample] = []
    for event in dataset.events(0, total):
        if isinstance(event, StereoFrame):
            seen[event.index] = front.process(event).observations
            show(len(seen), total)
        else:
            samples.append(event)
    return feature_tracks(seen, len(recording.frame_times_ns)), tuple(samples)


def _measure_imu(
    recording: Recording,
    tracks: FeatureTracks,
    samples: tuple[MotionSample, ...],
    motion: CameraMotion | NotObservable,
) -> tuple[ImuAlignment | NotObservable, LeverArm | NotObservable, tuple[Finding, ...]]:
    from vio.calibration.findings import NotObservable
    from vio.calibration.gyro import align_gyro, rates_of
    from vio.calibration.levers import lever_arm
    from vio.calibration.verdicts import judge_imu, judge_velocity_lever

    if not samples:
        why = "the recording holds no motion sensor"
        return NotObservable("IMU-camera rotation and time offset", why), NotObservable("lever arm", why), ()
    rates = rates_of(samples)
    if isinstance(motion, NotObservable):
        return motion, NotObservable("lever arm", motion.because), ()
    imu = align_gyro(motion, rates)
    if isinstance(imu, NotObservable):
        return imu, NotObservable("lever arm", imu.because), ()
    lever = lever_arm(motion, rates, imu)
    given = recording.T_cam0_imu
    findings = () if given is None else judge_imu(imu, lever, given)
    if given is not None and not rates.inertial:
        findings = (*findings, *judge_velocity_lever(recording.camera, tracks, recording.frame_times_ns, rates, given))
    return imu, lever, findings


# --- reporting ------------------------------------------------------------------------------------------------------


def _facts(report: _Report) -> dict[str, Any]:
    from dataclasses import asdict, is_dataclass

    import numpy as np

    from vio.calibration.findings import NotObservable

    def plain(record: Any) -> Any:
        if isinstance(record, NotObservable):
            return {"verdict": str(record)}
        assert is_dataclass(record)
        assert not isinstance(record, type)
        out = {}
        for key, value in asdict(record).items():
            if isinstance(value, np.ndarray):
                value = _finite(value.tolist())
            out[key] = value
        return out

    return {
        "source": str(report.source.path),
        "stereo": plain(report.stereo),
        "rows": plain(report.rows),
        "imu": plain(report.imu),
        "lever_arm": plain(report.lever),
        "findings": [{"fault": f.fault, "detail": f.detail} for f in report.findings],
        "notes": list(report.notes),
    }


def _finite(values: Any) -> Any:
    """Nested lists of numbers with None for what is not finite: JSON knows no NaN."""
    import math

    if isinstance(values, list):
        return [_finite(value) for value in values]
    return values if math.isfinite(values) else None


def _table(report: _Report) -> list[tuple[str, str]]:
    import numpy as np

    from vio.calibration.gyro import ImuAlignment
    from vio.calibration.levers import LeverArm
    from vio.calibration.stereo import RowResiduals, StereoEstimate
    from vio.geometry.lie import so3_log

    rows: list[tuple[str, str]] = []
    stereo = report.stereo
    if isinstance(stereo, StereoEstimate):
        x, y, z = np.degrees(so3_log(stereo.R_cam1_cam0))
        u, v, w = stereo.direction
        rows += [
            (
                "left-right rotation",
                f"{x:+.4f} {y:+.4f} {z:+.4f} deg (cam0 to cam1), sigma {stereo.rotation_sigma_deg:.4f}",
            ),
            ("baseline direction", f"{u:+.5f} {v:+.5f} {w:+.5f} in cam0, sigma {stereo.direction_sigma_deg:.3f} deg"),
            (
                "matches",
                f"{stereo.matches} in {stereo.pairs} pairs, epipolar spread {60 * stereo.residual_deg:.2f} arcmin",
            ),
        ]
    else:
        rows.append(("left and right", str(stereo)))
    if isinstance(report.rows, RowResiduals):
        r = report.rows
        rows.append(
            (
                "rows vl - vr",
                f"median {r.median_px:+.3f} px, spread {r.spread_px:.3f} px; {100 * r.positive_disparity:.1f} % of "
                f"{r.matches} matches have a positive disparity",
            )
        )
        for line in r.grid_px:
            rows.append(("  over the image", " ".join("    –  " if np.isnan(c) else f"{c:+7.3f}" for c in line)))
    else:
        rows.append(("rows", str(report.rows)))
    if isinstance(report.imu, ImuAlignment):
        a = report.imu
        x, y, z = np.degrees(so3_log(a.R_cam0_imu))
        p, q, r_ = a.rotation_sigma_deg
        rows.append(
            ("IMU-camera rotation", f"{x:+.3f} {y:+.3f} {z:+.3f} deg (IMU to cam0), sigma {p:.3f} {q:.3f} {r_:.3f}")
        )
        rows.append(
            ("IMU minus camera clock", f"{1e3 * a.time_offset_s:+.2f} ms, sigma {1e3 * a.time_offset_sigma_s:.2f} ms")
        )
        if a.weak is not None:
            rows.append(("  not observable", f"the motion leaves open the {a.weak}"))
    else:
        rows.append(("IMU", str(report.imu)))
    if isinstance(report.lever, LeverArm):
        x, y, z = report.lever.t_cam0_imu
        p, q, r_ = report.lever.sigma_m
        rows.append(("IMU in cam0", f"{x:+.4f} {y:+.4f} {z:+.4f} m, sigma {p:.4f} {q:.4f} {r_:.4f}"))
    else:
        rows.append(("lever arm", str(report.lever)))
    rows += [("note", note) for note in report.notes]
    rows += [("FOUND", str(finding)) for finding in report.findings]
    if not report.findings:
        rows.append(("verdict", "no fault found in what could be observed"))
    return rows


def _write_yaml(folder: Path, report: _Report) -> None:
    """Write the measured calibration, given values in place of what could not be observed, in both forms."""
    import numpy as np

    from vio.calibration.gyro import ImuAlignment
    from vio.calibration.levers import LeverArm
    from vio.calibration.stereo import StereoEstimate
    from vio.datasets.euroc_files import camera_yaml
    from vio.datasets.rectified import RectifiedDataset
    from vio.geometry.lie import se3_from_parts, se3_inverse

    rig = report.source.rig
    if rig is None:
        return
    T_cam0_cam1 = rig.T_cam0_cam1
    if isinstance(report.stereo, StereoEstimate):
        length = float(np.linalg.norm(T_cam0_cam1[:3, 3]))
        T_cam0_cam1 = se3_from_parts(report.stereo.R_cam1_cam0.T, length * report.stereo.direction)
    T_cam0_imu = se3_inverse(rig.T_imu_cam0)
    dataset = report.source.dataset
    R_rect = np.eye(3)
    if isinstance(dataset, RectifiedDataset):
        R_rect = (dataset.rectifier.T_rect0_imu @ rig.T_imu_cam0)[:3, :3]
    offset_s = 0.0
    if isinstance(report.imu, ImuAlignment) and report.imu.weak is None:
        T_cam0_imu = se3_from_parts(R_rect.T @ report.imu.R_cam0_imu, T_cam0_imu[:3, 3])
        offset_s = report.imu.time_offset_s
    if isinstance(report.lever, LeverArm):
        T_cam0_imu = se3_from_parts(T_cam0_imu[:3, :3], R_rect.T @ report.lever.t_cam0_imu)
    T_imu_cam0 = se3_inverse(T_cam0_imu)
    poses = {"cam0": T_imu_cam0, "cam1": T_imu_cam0 @ T_cam0_cam1}
    cameras = {"cam0": rig.cam0, "cam1": rig.cam1}
    times = () if dataset is None else dataset.recording.frame_times_ns
    rate_hz = 1e9 / float(np.median(np.diff(times))) if len(times) > 1 else 20.0
    for name, camera in cameras.items():
        (folder / name).mkdir()
        (folder / name / "sensor.yaml").write_text(
            camera_yaml(camera, poses[name], comment=f"{name}, by vio calibrate", rate_hz=rate_hz), encoding="utf-8"
        )
    (folder / "camchain-imucam.yaml").write_text(_kalibr(cameras, poses, T_cam0_cam1, offset_s), encoding="utf-8")


def _kalibr(cameras: dict[str, Any], poses: dict[str, Any], T_cam0_cam1: Any, offset_s: float) -> str:
    """Kalibr's camchain: `T_cam_imu` maps the IMU to the camera, `t_imu = t_cam + timeshift_cam_imu`."""
    import yaml

    from vio.geometry.lie import se3_inverse

    models = {"pinhole": "none", "radtan": "radtan", "equidistant": "equidistant"}
    chain: dict[str, Any] = {}
    for name, camera in cameras.items():
        sheet: dict[str, Any] = {"T_cam_imu": se3_inverse(poses[name]).tolist()}
        if name == "cam1":
            sheet["T_cn_cnm1"] = se3_inverse(T_cam0_cam1).tolist()
        sheet |= {
            "camera_model": "pinhole",
            "distortion_model": models[camera.model],
            "distortion_coeffs": [float(c) for c in camera.coefficients[:4]],
            "intrinsics": [camera.fu, camera.fv, camera.cu, camera.cv],
            "resolution": [camera.width, camera.height],
            "timeshift_cam_imu": offset_s,
        }
        chain[name] = sheet
    return yaml.safe_dump(chain, sort_keys=False, default_flow_style=None)
