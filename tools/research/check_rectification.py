"""Check rectification: rows of matched points on real recordings, and tracking accuracy on rendered images.

    python tools/research/check_rectification.py rows FOLDER...      # |vl - vr| of matched points
    python tools/research/check_rectification.py tracking            # rectified against raw images, exact truth
    python tools/research/check_rectification.py resampling          # error and time of the interpolation

All print a table, or JSON with --json. The figures in docs/rectification.md are from this tool.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import get_args

import cv2
import numpy as np

from vio.cameras.rig import Rectifier
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.rectified import make_rectifier
from vio.errors import VioError
from vio.frontend.align import align, cut_patches, shift_warps, templates
from vio.frontend.flow import lucas_kanade
from vio.geometry.distortion import StereoRig, project_point, rig_from_rectified, unproject_pixel
from vio.geometry.lie import FloatArray
from vio.geometry.rectify import Interpolation, ProjectionMode, Rectification, rectify, rectify_pixels
from vio.records import BoolArray, Image, StereoFrame
from vio.sim.effects import SensorEffects, apply_effects
from vio.sim.motion import MotionSpline, evaluate, hand_held, rotate_body_axes
from vio.sim.render import View, camera_rays, correspondence, inside_image, render
from vio.sim.rigs import R_FLU_EUROC_IMU, euroc_like_rig
from vio.sim.world import World, room

_RATIO = 0.75  # of the best to the second best descriptor distance
_RANSAC_PX = 1.0
_WINDOW_PX = 21


@dataclass(frozen=True, slots=True)
class RowResidual:
    """Row differences of matched points; pixels of the rectified images."""

    recording: str
    points: str  # how the points were located
    pairs: int
    matches: int
    median_px: float  # of |vl - vr|
    p95_px: float
    bias_px: float  # median of vl - vr
    turn_deg: tuple[float, float, float]  # rotation of the right camera that minimises the residuals
    median_after_turn_px: float  # of |vl - vr| under that rotation: the matching error


def match_sift(left: Image, right: Image) -> tuple[FloatArray, FloatArray]:
    """Matched pixels (N, 2), (N, 2): mutual nearest SIFT descriptors, inliers of one common fundamental matrix.

    The matrix is estimated from these matches alone, without the assumption that rows agree.
    Reference: Lowe, Distinctive image features from scale-invariant keypoints (2004).
    """
    sift = cv2.SIFT.create(nfeatures=1500)
    (points0, words0), (points1, words1) = (sift.detectAndCompute(image, None) for image in (left, right))
    if words0 is None or words1 is None or len(words1) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(words1, words0)}
    good = [
        first
        for first, second in matcher.knnMatch(words0, words1, k=2)
        if first.distance < _RATIO * second.distance and back[first.trainIdx] == first.queryIdx
    ]
    pl = np.array([points0[m.queryIdx].pt for m in good]).reshape(-1, 2)
    pr = np.array([points1[m.trainIdx].pt for m in good]).reshape(-1, 2)
    if len(pl) < 15:
        return np.zeros((0, 2)), np.zeros((0, 2))
    cv2.setRNGSeed(0)
    _, mask = cv2.findFundamentalMat(pl, pr, cv2.FM_RANSAC, _RANSAC_PX, 0.999)
    inlier = np.zeros(len(pl), dtype=np.bool_) if mask is None else mask.reshape(-1).astype(np.bool_)
    return pl[inlier], pr[inlier]


def refined(left: Image, right: Image, pl: FloatArray, pr: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Right pixels (N, 2) moved in both directions until their patch fits the left one, and a mask of those kept."""
    uv, found = _flow(left, right, pl, pr, levels=0)
    return uv, found & (np.linalg.norm(uv - pr, axis=1) < 2.0)


def _flow(a: Image, b: Image, points: FloatArray, guess: FloatArray, *, levels: int) -> tuple[FloatArray, BoolArray]:
    """Pixels (N, 2) in image b of points (N, 2) in image a, to a thousandth of a pixel, and a mask of those found."""
    return lucas_kanade(a, b, points, guess, window_px=_WINDOW_PX, levels=levels, iterations=40, epsilon_px=1e-3)


def row_residuals(source: str, interpolation: Interpolation, projection: ProjectionMode) -> list[RowResidual]:
    """Measure a recording, with SIFT points and with refined points."""
    dataset = open_dataset(source, DatasetSettings(interpolation=interpolation, projection=projection))
    camera = dataset.recording.camera
    matched: dict[str, list[FloatArray]] = {"SIFT": [], "refined": []}
    pairs = 0
    for event in dataset.events():
        if not isinstance(event, StereoFrame) or event.left is None or event.right is None:
            continue
        pairs += 1
        pl, pr = match_sift(event.left, event.right)
        matched["SIFT"].append(np.hstack([pl, pr]))
        if len(pl):
            moved, kept = refined(event.left, event.right, pl, pr)
            matched["refined"].append(np.hstack([pl, moved])[kept])
    out = []
    for points, parts in matched.items():
        z = np.concatenate([np.zeros((0, 4)), *parts])
        if len(z) < 100:
            raise VioError(f"{source}: only {len(z)} points could be matched between left and right")
        dv = z[:, 1] - z[:, 3]
        median, p95 = (float(x) for x in np.percentile(np.abs(dv), [50, 95]))
        turn_rad, left_over = _best_turn((z[:, 2:] - (camera.cu, camera.cv)) / (camera.fu, camera.fv), dv, camera.fv)
        x, y, w = (float(a) for a in np.degrees(turn_rad))
        after = float(np.median(np.abs(left_over)))
        name = dataset.recording.path.name
        out.append(RowResidual(name, points, pairs, len(z), median, p95, float(np.median(dv)), (x, y, w), after))
    return out


def _best_turn(xy: FloatArray, dv: FloatArray, fv: float) -> tuple[FloatArray, FloatArray]:
    """Small rotation (3,) of the right camera, in radians, that fits row residuals (N,), and the remaining residuals.

    A ray [x, y, 1] rotated by phi moves by phi x ray, its row by fv (-(1 + y^2) phi_x + x y phi_y + x phi_z).
    Iteratively reweighted least squares, so that false matches have little weight.
    """
    x, y = xy[:, 0], xy[:, 1]
    A = fv * np.stack([-(1 + y * y), x * y, x], axis=1)
    phi = np.zeros(3, dtype=np.float64)
    for _ in range(20):
        weight = 1 / np.maximum(np.abs(dv - A @ phi), 0.05)
        phi = np.asarray(np.linalg.solve(A.T @ (weight[:, None] * A), A.T @ (weight * dv)))
    return phi, dv - A @ phi


# --- rectified images against raw images ------------------------------------------------------------------------------

_RAW, _IDEAL = "raw, points undistorted", "rendered rectified (no resampling)"
_METHODS: tuple[str, ...] = (_RAW, *(f"rectified, {name}" for name in get_args(Interpolation)), _IDEAL)
_STEPS = {"stereo": 0, "50 ms": 50_000_000, "250 ms": 250_000_000}
_LK, _ALIGNED = "Lucas-Kanade", "then aligned"
_TRACKERS = (_LK, _ALIGNED)
_BACK_PX = 0.5
_RADIUS = 6  # of the aligned patch
_CORRELATION = 0.85
_GUESS_PX = 1.5  # deviation of the starting points from the truth


@dataclass(frozen=True, slots=True)
class TrackingError:
    """End-point errors of tracked points on rendered EuRoC images; pixels of the rectified camera."""

    tracker: str
    images: str
    step: str  # stereo, or the time between two left images
    points: int  # the same for all kinds of images
    lost_percent: float  # of all visible points: lost by the tracker
    median_px: float
    p95_px: float
    rows_median_px: float  # of the vertical part of the error


@dataclass(frozen=True, slots=True)
class ResamplingError:
    """Error and time of an interpolation method."""

    interpolation: str
    rms_gray: float  # difference from the rectified image rendered directly, without noise
    ms_per_pair: float


@dataclass(frozen=True, slots=True)
class _Scene:
    """A flight through a rendered room, seen by EuRoC's raw cameras and by the rectified cameras."""

    world: World
    motion: MotionSpline
    raw: StereoRig
    ideal: StereoRig
    rectifiers: dict[str, Rectifier]
    done: Rectification


def make_scene(seed: int = 3) -> _Scene:
    """Plan the flight."""
    raw = euroc_like_rig()
    done = rectify(raw)
    names: tuple[Interpolation, ...] = get_args(Interpolation)
    rectifiers = {f"rectified, {name}": make_rectifier(raw, name, Path("euroc_like_rig")) for name in names}
    motion = rotate_body_axes(hand_held(seed=seed, duration_s=14.0), R_FLU_EUROC_IMU)
    return _Scene(room(seed), motion, raw, rig_from_rectified(done.camera, done.T_rect0_imu), rectifiers, done)


def _views(scene: _Scene, rig: StereoRig, time_ns: int) -> tuple[View, View]:
    T = evaluate(scene.motion, time_ns).T_world_imu[0]
    return View(rig.cam0, T @ rig.T_imu_cam0, time_ns), View(rig.cam1, T @ rig.T_imu_cam1, time_ns)


def _pictures(scene: _Scene, time_ns: int, noise: float) -> dict[str, tuple[Image, Image]]:
    """Left and right image of every kind at one time, with independent read noise."""
    effects = SensorEffects(read_noise=noise)
    out = {}
    for name, rig in ((_RAW, scene.raw), (_IDEAL, scene.ideal)):
        pair = []
        for camera, view in enumerate(_views(scene, rig, time_ns)):
            radiance = render(scene.world, camera_rays(view.camera), view.T_world_cam, time_ns)
            number = time_ns // 1_000_000
            pair.append(apply_effects(radiance, effects, time_ns=time_ns, frame_index=number, camera=camera, seed=7))
        out[name] = pair[0], pair[1]
    return out | {name: rectifier(*out[_RAW]) for name, rectifier in scene.rectifiers.items()}


def _track(first: Image, second: Image, start: FloatArray, guess: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Forward-backward Lucas-Kanade: pixels (N, 2) and a mask of consistent ones."""
    there, found = _flow(first, second, start, guess, levels=2)
    back, found_back = _flow(second, first, there, start, levels=2)
    return there, found & found_back & (np.linalg.norm(back - start, axis=1) < _BACK_PX)


def _align(
    first: Image, second: Image, start: FloatArray, guess: FloatArray, *, same_row: bool
) -> tuple[FloatArray, BoolArray]:
    """The front end's alignment, from the result of Lucas-Kanade: pixels (N, 2) and a mask of good fits."""
    prepared = templates(cut_patches(first, start, _RADIUS))
    rows = start[:, 1] if same_row else None
    warps, score = align(prepared, np.arange(len(start)), second, shift_warps(guess), 12, rows)
    return warps[:, :2, 2], score > _CORRELATION


def _to_raw(scene: _Scene, camera: int, uv: FloatArray) -> FloatArray:
    """Raw pixels (N, 2) of rectified pixels of one camera."""
    rig, done = scene.raw, scene.done
    R, model = (done.R_rect_cam0, rig.cam0) if camera == 0 else (done.R_rect_cam1, rig.cam1)
    rays, _ = unproject_pixel(scene.ideal.cam0, uv)
    return project_point(model, rays @ R)[0]


def _to_rectified(scene: _Scene, camera: int, uv: FloatArray) -> FloatArray:
    rig, done = scene.raw, scene.done
    R, model = (done.R_rect_cam0, rig.cam0) if camera == 0 else (done.R_rect_cam1, rig.cam1)
    return rectify_pixels(model, R, done.camera, uv)[0]


def tracking_errors(*, moments: int, noise: float = 1.5, seed: int = 3) -> list[TrackingError]:
    """Track the same surface points in raw, in rectified and in directly rendered rectified images."""
    scene = make_scene(seed)
    rng = np.random.default_rng(seed)
    errors: dict[tuple[str, str, str], list[FloatArray]] = {
        (t, s, m): [] for t in _TRACKERS for s in _STEPS for m in _METHODS
    }
    lost = {key: [0, 0] for key in errors}
    for at in np.linspace(2e9, 13e9, moments).astype(np.int64).tolist():
        here = _pictures(scene, at, noise)
        corners = cv2.goodFeaturesToTrack(here[_IDEAL][0], 300, 0.005, 12)
        uv = corners.reshape(-1, 2).astype(np.float64) + rng.uniform(-0.5, 0.5, (len(corners), 2))
        view = _views(scene, scene.ideal, at)
        for step, later_ns in _STEPS.items():
            stereo = later_ns == 0
            other = view[1] if stereo else _views(scene, scene.ideal, at + later_ns)[0]
            truth, visible = correspondence(scene.world, view[0], other, uv)
            visible &= inside_image(scene.ideal.cam0, truth, margin_px=12) & inside_image(
                scene.ideal.cam0, uv, margin_px=12
            )
            start, goal = uv[visible], truth[visible]
            guess = goal + _GUESS_PX * rng.standard_normal(goal.shape)
            there = here if stereo else _pictures(scene, at + later_ns, noise)
            camera = 1 if stereo else 0
            for tracker in _TRACKERS:
                ends, kept = {}, {}
                for name in _METHODS:
                    pair, raw = (here[name][0], there[name][camera]), name == _RAW
                    p, q = (_to_raw(scene, 0, start), _to_raw(scene, camera, guess)) if raw else (start, guess)
                    end, kept[name] = _track(*pair, p, q)
                    if tracker == _ALIGNED:
                        end, fits = _align(*pair, p, end, same_row=stereo and not raw)
                        kept[name] = kept[name] & fits
                    ends[name] = _to_rectified(scene, camera, end) if raw else end
                common = np.logical_and.reduce(list(kept.values()))
                for name in _METHODS:
                    errors[tracker, step, name].append((ends[name] - goal)[common])
                    lost[tracker, step, name][0] += int((~kept[name]).sum())
                    lost[tracker, step, name][1] += len(goal)
    return [_summary(key, np.concatenate(parts), *lost[key]) for key, parts in errors.items()]


def _summary(key: tuple[str, str, str], e: FloatArray, lost: int, tried: int) -> TrackingError:
    tracker, step, name = key
    median, p95 = (float(x) for x in np.percentile(np.linalg.norm(e, axis=1), [50, 95]))
    rows = float(np.median(np.abs(e[:, 1])))
    return TrackingError(tracker, name, step, len(e), 100 * lost / max(tried, 1), median, p95, rows)


def resampling_errors(*, moments: int, seed: int = 3) -> list[ResamplingError]:
    """Compare resampled with directly rendered rectified images, away from the border."""
    scene = make_scene(seed)
    square: dict[str, list[float]] = {name: [] for name in scene.rectifiers}
    spent_ms: dict[str, list[float]] = {name: [] for name in scene.rectifiers}
    for at in np.linspace(2e9, 13e9, moments).astype(np.int64).tolist():
        pictures = _pictures(scene, at, 0.0)
        for name, rectifier in scene.rectifiers.items():
            began = time.perf_counter()
            rectifier(*pictures[_RAW])
            spent_ms[name].append(1e3 * (time.perf_counter() - began))
            for ours, ideal in zip(pictures[name], pictures[_IDEAL], strict=True):
                difference = ours[8:-8, 8:-8].astype(np.float64) - ideal[8:-8, 8:-8]
                square[name].append(float(np.mean(difference**2)))
    return [
        ResamplingError(
            rectifier.interpolation, float(np.sqrt(np.mean(square[name]))), float(np.median(spent_ms[name]))
        )
        for name, rectifier in scene.rectifiers.items()
    ]


# --- command line -----------------------------------------------------------------------------------------------------


def _print_table(rows: Sequence[RowResidual | TrackingError | ResamplingError]) -> None:
    columns = list(asdict(rows[0]))
    cells = [columns, *([_cell(v) for v in asdict(row).values()] for row in rows)]
    widths = [max(len(line[c]) for line in cells) for c in range(len(columns))]
    for line in cells:
        print("  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip())


def _cell(value: object) -> str:
    if isinstance(value, tuple):
        return " ".join(f"{part:+.3f}" for part in value)
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the check that the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("check", choices=("rows", "tracking", "resampling"))
    parser.add_argument("folders", nargs="*", help="recordings (rows)")
    parser.add_argument("--interpolation", choices=get_args(Interpolation), default=DatasetSettings().interpolation)
    parser.add_argument("--projection", choices=get_args(ProjectionMode), default="pinhole", help="(rows)")
    parser.add_argument("--moments", type=int, default=12, help="rendered times (tracking, resampling; default 12)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_intermixed_args(argv)
    if args.check == "rows" and not args.folders:
        parser.error("rows needs at least one recording")
    cv2.setNumThreads(1)
    rows: Sequence[RowResidual | TrackingError | ResamplingError]
    try:
        if args.check == "rows":
            rows = [
                row for folder in args.folders for row in row_residuals(folder, args.interpolation, args.projection)
            ]
        elif args.check == "tracking":
            rows = tracking_errors(moments=args.moments)
        else:
            rows = resampling_errors(moments=args.moments)
    except VioError as error:
        print("error:", error, file=sys.stderr)
        return 1
    if args.json:
        print(json.dumps([asdict(row) for row in rows]))
    else:
        _print_table(rows)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
