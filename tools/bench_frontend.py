"""Error, track length and time per stage of every front end, on rendered and on real images.

    python tools/bench_frontend.py [--names klt orb sift] [--clips room street kitti_0039] [--repeat 3] [--edges]
        [--json FILE]

Rendered clips and TartanAir have ground truth for every pixel. On KITTI the features of one frame are triangulated,
moved by one rigid motion fitted to the pair, and compared with the tracked pixels; and separately by the true motion.
Real clips are read from the folder in VIO_DATA. One thread; times are medians with quartiles over all frames but the
first, over all repetitions. On a shared machine, compare figures of one call only.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vio.config import load_config
from vio.datasets import open_dataset
from vio.datasets.images import load_gray
from vio.errors import VioError
from vio.frontend import build_frontend
from vio.frontend.outliers import fit_motion, pixel_errors
from vio.geometry.distortion import StereoRig, rectified_camera
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import StereoCamera, triangulate
from vio.numerics.threads import one_blas_thread
from vio.records import BoolArray, FrontendOutput, Observations, Recording, StereoFrame
from vio.sim.effects import SensorEffects, apply_effects
from vio.sim.motion import MotionSpline, car_loop, hand_held
from vio.sim.oracle import OracleFrontend, OracleSettings
from vio.sim.render import correspondence
from vio.sim.rigs import kitti_like_rig, small_rig
from vio.sim.sequence import SimulatedRecording, simulate, views
from vio.sim.world import World, room, street

Truth = Callable[[int, FloatArray], tuple[FloatArray, BoolArray]]  # frame, left pixels (N, 2): true pixels, visible


@dataclass(frozen=True)
class Clip:
    """Frames with their ground truth."""

    name: str
    camera: StereoCamera
    frames: list[StereoFrame]
    in_next: Truth | None  # true pixels in the next left image
    in_right: Truth | None  # true pixels in the right image
    poses: FloatArray | None = None  # (F, 4, 4) T_world_cam0, ground truth
    evaluated: tuple[int, ...] | None = None  # transitions k -> k + 1 used for temporal figures; None: all
    simulation: SimulatedRecording | None = None


# --- rendered clips ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Scene:
    world: World
    rig: StereoRig
    motion: MotionSpline
    rate_hz: float
    first_s: float


def _room_scene() -> _Scene:
    return _Scene(room(seed=1), small_rig(752, 480), hand_held(duration_s=8.0), 20.0, 3.0)


def _street_scene() -> _Scene:
    return _Scene(street(seed=4), kitti_like_rig(), car_loop(duration_s=8.0, start_m=12.0, seed=4), 10.0, 0.5)


def _rendered(scene: _Scene, count: int, *, exposure_ms: float = 0.0, exact_blur: bool = False) -> SimulatedRecording:
    step_ns = round(1e9 / scene.rate_hz)
    times = scene.motion.start_ns + round(scene.first_s * 1e9) + step_ns * np.arange(count)
    effects = SensorEffects(blur_exposure_ms=exposure_ms, blur_exact=exact_blur)
    return SimulatedRecording(simulate(scene.world, scene.rig, scene.motion, frame_times_ns=times, effects=effects))


def _truths(recording: SimulatedRecording) -> tuple[Truth, Truth]:
    simulation = recording.simulation

    def in_next(k: int, uv: FloatArray) -> tuple[FloatArray, BoolArray]:
        now, later = (views(simulation, int(simulation.taken_ns[i]))[0] for i in (k, k + 1))
        return correspondence(simulation.world, now, later, uv)

    def in_right(k: int, uv: FloatArray) -> tuple[FloatArray, BoolArray]:
        return correspondence(simulation.world, *views(simulation, int(simulation.taken_ns[k])), uv)

    return in_next, in_right


def _with_effects(
    name: str,
    recording: SimulatedRecording,
    radiance: list[tuple[Any, Any]],
    effects_of: Callable[[int], SensorEffects],
    evaluated: tuple[int, ...] | None = None,
) -> Clip:
    frames = []
    for k, pair in enumerate(radiance):
        time_ns = int(recording.simulation.taken_ns[k])
        left, right = (
            apply_effects(image, effects_of(k), time_ns=time_ns, frame_index=k, camera=i, seed=5)
            for i, image in enumerate(pair)
        )
        frames.append(StereoFrame(k, time_ns, left, right))
    camera = rectified_camera(recording.simulation.rig)
    return Clip(name, camera, frames, *_truths(recording), evaluated=evaluated, simulation=recording)


def rendered_clips(wanted: set[str], count: int) -> Iterator[Clip]:
    """Render the wanted clips; clips of one scene share their noise-free images."""
    plain = SensorEffects(read_noise=1.5)
    period = 5  # frames between steps of the exposure
    steps = tuple(range(period - 1, count - 1, period))
    room_effects: dict[str, tuple[Callable[[int], SensorEffects], tuple[int, ...] | None]] = {
        "room": (lambda k: plain, None),
        "room_exposure_step": (lambda k: replace(plain, exposure=1.3 if (k // period) % 2 else 1.0), steps),
        "room_gain_0.6": (lambda k: replace(plain, right_gain=0.6), None),
        "room_gain_1.6": (lambda k: replace(plain, right_gain=1.6), None),
        "room_noise_5": (lambda k: replace(plain, read_noise=5.0), None),
        "room_dark": (lambda k: replace(plain, exposure=0.25), None),
        "room_night": (lambda k: replace(plain, exposure=0.05, read_noise=0.5), None),
    }
    if wanted & (room_effects.keys() | {"room_blur_5px"}):
        scene = _room_scene()
        recording = _rendered(scene, count)
        times = recording.simulation.taken_ns
        if wanted & room_effects.keys():
            radiance = [recording.radiance(int(t)) for t in times]
            for name, (effects_of, evaluated) in room_effects.items():
                if name in wanted:
                    yield _with_effects(name, recording, radiance, effects_of, evaluated)
        if "room_blur_5px" in wanted:
            speed = [
                np.median(np.linalg.norm(recording.flow(0, int(a), int(b)), axis=2))
                for a, b in zip(times[:-1:4], times[1::4], strict=False)
            ]
            shutter_ms = 5.0 / float(np.mean(speed)) * 1e3 / scene.rate_hz
            blurred = _rendered(scene, count, exposure_ms=shutter_ms)
            radiance = [blurred.radiance(int(t)) for t in times]
            yield _with_effects("room_blur_5px", blurred, radiance, lambda k: plain)
    if "street" in wanted:
        recording = _rendered(_street_scene(), count)
        radiance = [recording.radiance(int(t)) for t in recording.simulation.taken_ns]
        yield _with_effects("street", recording, radiance, lambda k: plain)


# --- real clips -------------------------------------------------------------------------------------------------------


def kitti_clip(folder: Path, name: str, count: int | None) -> Clip:
    """Read a folder in KITTI odometry layout with its poses."""
    dataset = open_dataset(str(folder))
    frames = [event for event in dataset.events(0, count) if isinstance(event, StereoFrame)]
    reference = dataset.recording.reference
    poses = None
    if reference is not None:
        T_cam0_imu = dataset.recording.T_cam0_imu
        poses = (reference if T_cam0_imu is None else reference.in_cam0(T_cam0_imu)).T_world_body[: len(frames)]
    return Clip(name, dataset.recording.camera, frames, None, None, poses)


def tartanair_clip(folder: Path) -> Clip:
    """Read the TartanAir v2 clip with its dense flow and depth. Reference: Wang et al., TartanAir (IROS 2020)."""
    lefts = sorted((folder / "image_lcam_front").glob("*.png"))
    rights = sorted((folder / "image_rcam_front").glob("*.png"))
    frames = [
        StereoFrame(k, k * 100_000_000, load_gray(left)[0], load_gray(right)[0])
        for k, (left, right) in enumerate(zip(lefts, rights, strict=True))
    ]
    depth = [
        np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)).view("<f4")[..., 0]
        for path in sorted((folder / "depth_lcam_front").glob("*.png"))
    ]
    flow = [
        (np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))[..., :2].astype(np.float32) - 32768) / 64
        for path in sorted((folder / "flow_lcam_front").glob("*.png"))
    ]
    camera = StereoCamera(320.0, 320.0, 320.0, 320.0, 0.25, 640, 640)

    def sampled(dense: Any, uv: FloatArray) -> Any:
        at = uv.astype(np.float32)
        return cv2.remap(np.ascontiguousarray(dense), at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR)[0]

    def smooth(k: int, uv: FloatArray) -> BoolArray:
        """Mask (N,) of pixels whose 7x7 surroundings differ by less than 5 % in depth: elsewhere truth is ambiguous."""
        nearest, farthest = (f(depth[k], np.ones((7, 7), np.uint8)) for f in (cv2.erode, cv2.dilate))
        row, column = (np.clip(np.rint(uv[:, i]).astype(int), 0, 639) for i in (1, 0))
        return np.asarray(farthest[row, column] < 1.05 * nearest[row, column])

    def in_next(k: int, uv: FloatArray) -> tuple[FloatArray, BoolArray]:
        there = uv + sampled(flow[k], uv)
        return there, smooth(k, uv) & (there > 8).all(axis=1) & (there < 631).all(axis=1)

    def in_right(k: int, uv: FloatArray) -> tuple[FloatArray, BoolArray]:
        disparity = camera.fu * camera.baseline_m / sampled(depth[k], uv)
        there = uv - np.stack([disparity, np.zeros(len(uv))], axis=1)
        return there, smooth(k, uv) & (there[:, 0] > 0)

    return Clip("tartanair2_clip", camera, frames, in_next, in_right)


RENDERED = (
    "room",
    "street",
    "room_exposure_step",
    "room_gain_0.6",
    "room_gain_1.6",
    "room_blur_5px",
    "room_noise_5",
    "room_dark",
    "room_night",
)
REAL = ("kitti_0039", "kitti_06_head", "tartanair2_clip")


def data_folder() -> Path:
    """The folder of real recordings."""
    return Path(os.environ.get("VIO_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")


def clips(wanted: set[str], count: int, real_count: int | None = None) -> Iterator[Clip]:
    """Make the clips by name; real clips without a folder are skipped with a warning."""
    yield from rendered_clips(wanted, count)
    data = data_folder()
    for name in REAL:
        if name in wanted:
            if not (data / name).is_dir():
                logging.getLogger(__name__).warning("no %s in %s (VIO_DATA): skipped", name, data)
                continue
            yield (
                tartanair_clip(data / name) if name == "tartanair2_clip" else kitti_clip(data / name, name, real_count)
            )


# --- measuring --------------------------------------------------------------------------------------------------------

Builder = Callable[[Clip], Any]  # a new front end for a clip


def run(clip: Clip, build: Builder) -> list[tuple[FrontendOutput, float]]:
    """Outputs of a new front end, with the milliseconds per frame."""
    frontend = build(clip)
    results = []
    for frame in clip.frames:
        start = time.perf_counter()
        output = frontend.process(frame)
        results.append((output, 1e3 * (time.perf_counter() - start)))
    return results


def temporal_errors(clip: Clip, seen: list[Observations], k: int) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Errors (N,) px of the features of frame k in the next one, and masks (N,) of those tracked and those visible."""
    assert clip.in_next is not None
    there, visible = clip.in_next(k, seen[k].z[:, :2])
    visible &= _within(clip, there)
    found, row = _rows(seen[k].ids, seen[k + 1].ids)
    if len(seen[k + 1]) == 0:
        return np.zeros(len(found)), found, visible
    return np.linalg.norm(seen[k + 1].z[row, :2] - there, axis=1), found, visible


def disparity_errors(clip: Clip, seen: list[Observations], k: int) -> tuple[FloatArray, BoolArray]:
    """Signed errors (N,) px of the disparities of frame k, and the mask (N,) of those with ground truth."""
    assert clip.in_right is not None
    there, visible = clip.in_right(k, seen[k].z[:, :2])
    return there[:, 0] - seen[k].z[:, 2], visible & seen[k].has_right


EDGE_PX = (4.0, 8.0)  # the second is about the half side of klt's patch
_EDGE_STEP = 1.05  # ratio of depths between neighbouring pixels of two surfaces


def edge_distance(clip: Clip, k: int, uv: FloatArray) -> FloatArray:
    """Distances (N,) px of left pixels (N, 2) from the nearest depth step between two surfaces."""
    assert clip.simulation is not None
    depth, surface = clip.simulation.depth(0, int(clip.simulation.simulation.taken_ns[k]))
    square = np.ones((2, 2), np.uint8)
    near, far, low, high = (
        operation(image.astype(np.float32), square)
        for image in (np.where(np.isfinite(depth), depth, 1e6), surface)
        for operation in (cv2.erode, cv2.dilate)
    )
    edge = (far > _EDGE_STEP * near) & (low != high)
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, 5)
    at = np.rint(uv).astype(np.int64)
    return np.asarray(distance[at[:, 1], at[:, 0]], dtype=np.float64)


def edge_figures(clip: Clip, seen: list[Observations]) -> dict[str, Any]:
    """Share of the features, and of their errors above 1 px, that are near a depth step, by distance in px."""
    rows: dict[str, list[FloatArray]] = {"temporal": [], "disparity": []}
    for k in range(len(seen)):
        distance = edge_distance(clip, k, seen[k].z[:, :2])
        error, evaluated = disparity_errors(clip, seen, k)
        rows["disparity"].append(np.stack([np.abs(error), distance], axis=1)[evaluated])
        if k + 1 < len(seen):
            error, found, visible = temporal_errors(clip, seen, k)
            rows["temporal"].append(np.stack([error, distance], axis=1)[found & visible])
    figures = {}
    for name, parts in rows.items():
        error, distance = np.concatenate(parts).T
        wrong = error > 1
        figures[name] = {
            "errors": int(wrong.sum()),
            "errors_near": {str(r): float(np.mean(distance[wrong] <= r)) for r in EDGE_PX if wrong.any()},
            "features_near": {str(r): float(np.mean(distance <= r)) for r in EDGE_PX},
            "wrong_elsewhere": {str(r): float(np.mean(wrong[distance > r])) for r in EDGE_PX},
        }
    return figures


def accuracy(clip: Clip, outputs: list[FrontendOutput]) -> dict[str, Any]:
    """Errors against the truth, stereo counts and track lengths."""
    seen = [output.observations for output in outputs]
    ids = np.concatenate([o.ids for o in seen])
    lengths = np.unique(ids, return_counts=True)[1]
    stereo = np.array([int(o.has_right.sum()) for o in seen])
    figures: dict[str, Any] = {
        "stereo_observations": {"least": int(stereo.min()), "median": float(np.median(stereo))},
        "track_length": {
            "median": float(np.median(lengths)) if len(lengths) else 0.0,
            "mean": float(lengths.mean()) if len(lengths) else 0.0,
            "tracks": len(lengths),
        },
    }
    if clip.in_next is not None and clip.in_right is not None:
        temporal, shown, kept = [], 0, 0
        for k in range(len(seen) - 1) if clip.evaluated is None else clip.evaluated:
            error, found, visible = temporal_errors(clip, seen, k)
            temporal.append(error[found & visible])
            shown, kept = shown + int(visible.sum()), kept + int((found & visible).sum())
        figures["temporal_px"] = _summary(np.concatenate(temporal))
        figures["survived"] = kept / max(shown, 1)
        evaluated = [disparity_errors(clip, seen, k) for k in range(len(seen))]
        figures["disparity_px"] = _summary(np.concatenate([error[mask] for error, mask in evaluated]))
    elif clip.poses is not None:
        figures |= _rigid_figures(clip, seen)
    return figures


def _within(clip: Clip, uv: FloatArray) -> BoolArray:
    assert clip.camera.width is not None
    assert clip.camera.height is not None
    margin = 10.0
    return (
        (uv >= margin).all(axis=1) & (uv[:, 0] < clip.camera.width - margin) & (uv[:, 1] < clip.camera.height - margin)
    )


def _rows(ids: Any, later: Any) -> tuple[BoolArray, Any]:
    """Mask of the ids that are among the later ones, and their rows there (arbitrary where not)."""
    order = np.argsort(later)
    if len(later) == 0:
        return np.zeros(len(ids), dtype=np.bool_), np.zeros(len(ids), dtype=np.int64)
    row = order[np.minimum(np.searchsorted(later[order], ids), len(later) - 1)]
    return later[row] == ids, row


_FIT_PX = 1.0  # reprojection error under the fitted motion above which a feature has little weight


def _rigid_figures(clip: Clip, seen: list[Observations]) -> dict[str, Any]:
    """Reprojection of stereo points into the next frame, under a motion fitted to each pair and under the truth."""
    assert clip.poses is not None
    fitted, raw = [], []
    for k in range(len(seen) - 1):
        stereo = seen[k].take(seen[k].has_right)
        found, row = _rows(stereo.ids, seen[k + 1].ids)
        p, valid = triangulate(clip.camera, stereo.z)
        used = found & valid
        pixels = seen[k + 1].z[row[used], :2]
        T_true = se3_inverse(clip.poses[k + 1]) @ clip.poses[k]
        T = fit_motion(clip.camera, p[used], pixels, T_true, _FIT_PX)
        raw.append(pixel_errors(clip.camera, T_true, p[used], pixels))
        if T is not None:
            fitted.append(pixel_errors(clip.camera, T, p[used], pixels))
    return {
        "reprojection_fitted_px": _summary(np.concatenate(fitted)),
        "reprojection_truth_px": _summary(np.concatenate(raw)),
        "fitted_pairs": len(fitted),
        "pairs": len(seen) - 1,
    }


def _summary(error: FloatArray) -> dict[str, float]:
    """Median and 95 % of absolute errors (N,), the signed median, and the share above 1 px."""
    if len(error) == 0:
        return {"count": 0}
    size = np.abs(error)
    return {
        "median": float(np.median(size)),
        "p95": float(np.percentile(size, 95)),
        "bias": float(np.median(error)),
        "beyond_1px": float(np.mean(size > 1)),
        "count": len(error),
    }


def timing(runs: list[list[tuple[FrontendOutput, float]]]) -> dict[str, list[float]]:
    """Quartiles [25, 50, 75 %] in milliseconds of every stage and of the whole frame, without first frames."""
    frames = [frame for results in runs for frame in results[1:]]
    stages = dict.fromkeys(stage for output, _ in frames for stage in output.stages_ms)
    columns = {stage: [output.stages_ms.get(stage, 0.0) for output, _ in frames] for stage in stages}
    columns["frame"] = [ms for _, ms in frames]
    return {stage: [float(q) for q in np.percentile(values, [25, 50, 75])] for stage, values in columns.items()}


KORNIA = {
    "kornia-gftt-sift": {"detector": "gftt", "descriptor": "sift"},
    "kornia-aliked-t16": {"detector": "aliked", "detector_weights": "aliked/aliked-t16.pth"},
    "kornia-aliked-n16": {
        "detector": "aliked",
        "aliked_model": "aliked-n16",
        "detector_weights": "aliked/aliked-n16.pth",
    },
    "kornia-keynet-mkd": {
        "detector": "keynet",
        "detector_weights": "keynet/keynet_pytorch.pth",
        "descriptor": "mkd",
        "descriptor_weights": "mkd/mkd-cart-64.pth",
    },
    "kornia-keynet-affnet-mkd": {
        "detector": "keynet",
        "detector_weights": "keynet/keynet_pytorch.pth",
        "descriptor": "mkd",
        "descriptor_weights": "mkd/mkd-cart-64.pth",
        "affine_weights": "affnet/AffNet.pth",
        "orientation_weights": "affnet/OriNet.pth",
    },
}  # variants of the front end `kornia`, with weights from the folder `weights` of VIO_DATA


def kornia_options(name: str, weights: Path) -> dict[str, str | Path]:
    """Settings of `frontend.learned` of a variant of kornia, with files in the folder of weights; else empty."""
    options = KORNIA.get(name, {})
    return {key: weights / value if key.endswith("_weights") else value for key, value in options.items()}


NAMES = ("klt", "orb", "sift", "oracle", *KORNIA)


def builders(names: list[str], overrides: list[str]) -> dict[str, Builder]:
    """Builders of the front ends for a clip, with settings overridden by `key=value` below `frontend.`."""

    def builder(name: str) -> Builder:
        if name == "oracle":
            return _oracle
        learned = [f"learned.{key}={value}" for key, value in kornia_options(name, data_folder() / "weights").items()]
        settings = load_config(None, [f"frontend.{override}" for override in [*learned, *overrides]]).frontend
        kind = "kornia" if name in KORNIA else name
        return lambda clip: build_frontend(kind, clip.camera, settings, _ClipDataset(clip))

    return {name: builder(name) for name in names}


def _oracle(clip: Clip) -> Any:
    assert clip.simulation is not None
    return OracleFrontend(clip.simulation.simulation, OracleSettings(max_features=350, sigma_px=0.0))


class _ClipDataset:
    """A clip in the form of a dataset, for the builders."""

    def __init__(self, clip: Clip) -> None:
        times = np.array([frame.time_ns for frame in clip.frames])
        self.recording = Recording("clip", Path(clip.name), clip.camera, None, times, True, frozenset(), None)
        self._frames = clip.frames

    def events(self, start: int = 0, stop: int | None = None, *, images: bool = True) -> Iterator[StereoFrame]:
        yield from self._frames[start:stop]

    def observations(self, index: int) -> Observations | None:
        return None


def table(results: dict[str, dict[str, Any]]) -> str:
    """Format the results as one Markdown table per clip."""
    lines = []
    for clip_name, by_name in results.items():
        real = any("reprojection_fitted_px" in figures for figures in by_name.values())
        first = "fitted reprojection px: median, 95 %" if real else "temporal px: median, 95 %, > 1 px; survived"
        second = "under the true poses" if real else "disparity px: median, 95 %, bias, > 1 px"
        lines += [
            f"\n{clip_name}",
            f"| | {first} | {second} | stereo matches: least, median | track length: median, mean | ms |",
            "|---|---|---|---|---|---|",
        ]
        for name, f in by_name.items():
            if real:
                fit, raw = f["reprojection_fitted_px"], f["reprojection_truth_px"]
                cells = [f"{fit['median']:.3f}, {fit['p95']:.3f}", f"{raw['median']:.2f}, {raw['p95']:.2f}"]
            else:
                t, d = f["temporal_px"], f["disparity_px"]
                cells = [
                    _cell(t, "median", "p95", "beyond_1px") + f"; {100 * f['survived']:.0f} %",
                    _cell(d, "median", "p95", "bias", "beyond_1px"),
                ]
            rows, length, ms = f["stereo_observations"], f["track_length"], f["ms"]["frame"]
            cells += [
                f"{rows['least']}, {rows['median']:.0f}",
                f"{length['median']:.0f}, {length['mean']:.1f}",
                f"{ms[1]:.1f} ({ms[0]:.1f}, {ms[2]:.1f})",
            ]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        for name, f in by_name.items():
            for kind, near in f.get("edges", {}).items():
                lines.append(
                    f"{name}: of {near['errors']} {kind} errors above 1 px, "
                    + ", ".join(f"{100 * share:.0f} % within {r} px" for r, share in near["errors_near"].items())
                    + " of a depth step; of all features "
                    + ", ".join(f"{100 * share:.0f} %" for share in near["features_near"].values())
                    + "; wrong elsewhere "
                    + ", ".join(f"{100 * share:.2f} %" for share in near["wrong_elsewhere"].values())
                )
    return "\n".join(lines)


def _cell(summary: dict[str, float], *keys: str) -> str:
    if summary["count"] == 0:
        return "none"
    return ", ".join(f"{100 * summary[k]:.1f} %" if k == "beyond_1px" else f"{summary[k]:.3f}" for k in keys)


def main() -> int:
    """Run the benchmark; print tables, and write JSON if requested."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--names", nargs="+", default=["klt", "orb", "sift", "oracle"], choices=NAMES)
    parser.add_argument("--clips", nargs="+", default=[*RENDERED, *REAL], choices=[*RENDERED, *REAL])
    parser.add_argument("--frames", type=int, default=40, help="frames of each rendered clip")
    parser.add_argument("--real-frames", type=int, help="frames of each KITTI clip (default: all)")
    parser.add_argument("--repeat", type=int, default=1, help="repetitions, for the times")
    parser.add_argument(
        "--set", action="append", default=[], help="setting below `frontend.`, such as grid.target_features=800"
    )
    parser.add_argument("--edges", action="store_true", help="also report the errors near depth steps (rendered)")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    results: dict[str, dict[str, Any]] = {}
    try:
        with one_blas_thread():
            for clip in clips(set(args.clips), args.frames, args.real_frames):
                results[clip.name] = measure(clip, builders(args.names, args.set), args.repeat, edges=args.edges)
    except VioError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table(results))
    if args.json is not None:
        args.json.write_text(json.dumps(results, indent=1), encoding="utf-8")
    return 0


def measure(clip: Clip, build: dict[str, Builder], repeat: int, *, edges: bool) -> dict[str, Any]:
    """Figures of each front end on one clip; repetitions alternate, so that load on the machine affects all equally."""
    runs: dict[str, list[list[tuple[FrontendOutput, float]]]] = {name: [] for name in build}
    for _ in range(repeat):
        for name in build:
            if name == "oracle" and clip.simulation is None:
                continue
            runs[name].append(run(clip, build[name]))
    figures = {}
    for name, results in runs.items():
        if not results:
            continue
        outputs = [output for output, _ in results[0]]
        figures[name] = accuracy(clip, outputs) | {"ms": timing(results)}
        if edges and clip.simulation is not None:
            figures[name]["edges"] = edge_figures(clip, [output.observations for output in outputs])
    return figures


if __name__ == "__main__":
    raise SystemExit(main())
