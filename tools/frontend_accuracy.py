"""Measure the accuracy of a front end on rendered images with known ground truth; print a table, or
JSON.

    python tools/frontend_accuracy.py [--frontend klt] [--set frontend.grid.target_features=800]
    [--json FILE]

Renders a room along a hand-held flight with a rectified 752x480 rig like EuRoC's: 300 frames, then
100 under each effect. Errors are relative to the exact correspondence: of the pixel in the previous
frame (`step`), of the first pixel of the track (`since birth`), and of the left pixel in the right
image (`disparity`).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vio.config import Config, load_config
from vio.errors import VioError
from vio.frontend import build_frontend
from vio.geometry.distortion import rectified_camera, unproject_pixel
from vio.geometry.lie import FloatArray
from vio.numerics.threads import one_blas_thread
from vio.protocols import Frontend
from vio.records import Image, IntArray, Observations, StereoFrame
from vio.sim.render import View, cast, correspondence, observe, surface_points
from vio.sim.scenarios import (
    EFFECTS,
    ParallelRecording,
    Scenario,
    conditions_of,
    default_workers,
    plan,
)
from vio.sim.sequence import SimulatedRecording, Simulation, views
from vio.sim.world import Surfaces, surfaces_at
from vio.testing import FrontendErrors, compare

SHOWN_EFFECTS = (
    "exposure", "gain", "gain-high", "blur", "noise", "dark", "bare-wall", "moving", "dropped", "duplicated",
)  # fmt: skip

_OUTLIER_PX = 1.0
# error above which a track at another depth than its point has moved to another surface
_CROSSED_PX = 1.5
_OTHER_DEPTH = 0.02  # relative
_RIM_PX = 3.0  # a feature this close to a nearer surface may be a point of its outline
_CROSSED_FRAMES = 3  # a track on the wrong surface for more frames counts as kept
_CORNERS = 150  # strongest corners of an image, for the recall of repeatable corners
_CORNER_GAP_PX = 24.0
_REPEATED_PX = 1.5  # distance from the true pixel up to which a corner is repeated
_COVERED_PX = 3.0  # distance up to which a track covers a corner


@dataclass(slots=True)
class Tally(FrontendErrors):
    """Errors and counts of a front end; arrays have one entry per observation, one array per
    frame.
    """

    since_birth: list[FloatArray] = field(default_factory=list)  # (N, 2) px
    # (N,) frames since birth, beside `since_birth`
    age: list[IntArray] = field(default_factory=list)
    frames_of: dict[int, int] = field(default_factory=dict)  # number of frames of each feature
    # Largest number of consecutive frames of each feature on another surface.
    crossed: dict[int, int] = field(default_factory=dict)
    corners: int = 0  # repeatable corners
    corners_covered: int = 0  # of these, covered by one track in both images


@dataclass
class _Birth:
    """Scene point of each feature's first observation, and of the nearest surface around its
    pixel.
    """

    frame: dict[int, int] = field(default_factory=dict)
    surface: dict[int, tuple[int, int]] = field(default_factory=dict)  # own, rim
    # (2, 2) m on the own surface, on the rim
    coordinates: dict[int, FloatArray] = field(default_factory=dict)
    # (2,) px from the rim's point to the feature
    offset: dict[int, FloatArray] = field(default_factory=dict)


def evaluate(simulation: Simulation, frames: Iterable[StereoFrame], frontend: Frontend) -> Tally:
    """Run a front end over rendered frames and compare its outputs with the ground truth."""
    tally = Tally()
    birth = _Birth()
    beyond = dict[int, int]()
    before: Observations | None = None
    image_before: Image | None = None
    for frame in frames:
        now = frontend.process(frame).observations
        now = now.take(~now.stale)
        compare(tally, simulation, before, now)
        for name in now.ids.tolist():
            tally.frames_of[name] = tally.frames_of.get(name, 0) + 1
        left = _left_view(simulation, frame.index)
        _evaluate_life(tally, birth, beyond, simulation, now, left, frame.index)
        if (
            before is not None
            and image_before is not None
            and frame.left is not None
            and frame.index % 5 == 0
        ):
            last = _left_view(simulation, before.frame_index)
            _evaluate_corners(
                tally, simulation, (before, image_before, last), (now, frame.left, left)
            )
        before = now
        image_before = frame.left
    return tally


def _left_view(simulation: Simulation, index: int) -> View:
    return views(simulation, int(simulation.taken_ns[index]))[0]


def _evaluate_life(
    tally: Tally,
    birth: _Birth,
    beyond: dict[int, int],
    simulation: Simulation,
    now: Observations,
    left: View,
    frame_index: int,
) -> None:
    """Compare each feature with the scene point of its first observation.

    A corner on an outline may be on the background by a fraction of a pixel and yet be a point of
    the outline: features detected within a few pixels of a nearer surface may follow either
    surface.
    """
    names = now.ids.tolist()
    if not names:
        return
    surfaces = surfaces_at(simulation.world, left.time_ns)
    rays, _ = unproject_pixel(left.camera, now.z[:, :2])
    hits = cast(surfaces, left.T_world_cam, rays)
    fresh = [k for k, name in enumerate(names) if name not in birth.frame]
    _begin(birth, [names[k] for k in fresh], surfaces, left, now.z[fresh, :2], frame_index)
    own, rim = np.array([birth.surface[name] for name in names]).T
    coordinates = np.array([birth.coordinates[name] for name in names])
    p_world = surface_points(surfaces, own, coordinates[:, 0])
    true, visible = observe(surfaces, left, p_world)
    error = now.z[:, :2] - true
    on_rim, _ = observe(surfaces, left, surface_points(surfaces, rim, coordinates[:, 1]))
    rim_error = now.z[:, :2] - on_rim - np.array([birth.offset[name] for name in names])
    follows_rim = np.linalg.norm(rim_error, axis=1) < np.linalg.norm(error, axis=1)
    age = frame_index - np.array([birth.frame[name] for name in names])
    old = visible & (age > 0)
    tally.since_birth.append(np.where(follows_rim[:, None], rim_error, error)[old])
    tally.age.append(age[old])
    distance = np.linalg.norm(p_world - left.T_world_cam[:3, 3], axis=1)
    elsewhere = np.abs(hits.distance - distance) > _OTHER_DEPTH * distance
    # Just behind an outline a point is occluded although its feature has a small error: that is not
    # a crossing yet.
    away = elsewhere & ((np.linalg.norm(error, axis=1) > _CROSSED_PX) | ~visible)
    away &= np.linalg.norm(rim_error, axis=1) > _CROSSED_PX
    for name, crossed in zip(names, away.tolist(), strict=True):
        beyond[name] = beyond.get(name, 0) + 1 if crossed else 0
        if crossed:
            tally.crossed[name] = max(tally.crossed.get(name, 0), beyond[name])


def _begin(
    birth: _Birth,
    names: list[int],
    surfaces: Surfaces,
    left: View,
    uv: FloatArray,
    frame_index: int,
) -> None:
    """Store the scene points of features (N,) at pixels (N, 2), and of the nearest surface
    around each.
    """
    if not names:
        return
    ring = np.concatenate(
        [
            [[0.0, 0.0]],
            _RIM_PX * np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]),
        ]
    )
    around = uv[:, None] + ring
    rays, _ = unproject_pixel(left.camera, around.reshape(-1, 2))
    hits = cast(surfaces, left.T_world_cam, rays)
    distance = np.where(hits.found, hits.distance, np.inf).reshape(len(uv), -1)
    surface = hits.surface.reshape(len(uv), -1)
    coordinates = hits.coordinates.reshape(len(uv), -1, 2)
    nearest = np.where(
        distance.min(axis=1) < (1 - _OTHER_DEPTH) * distance[:, 0], distance.argmin(axis=1), 0
    )
    for k, name in enumerate(names):
        rim = int(nearest[k])
        birth.frame[name] = frame_index
        birth.surface[name] = int(surface[k, 0]), int(surface[k, rim])
        birth.coordinates[name] = coordinates[k, [0, rim]]
        birth.offset[name] = -ring[rim]


def _evaluate_corners(
    tally: Tally,
    simulation: Simulation,
    before: tuple[Observations, Image, View],
    now: tuple[Observations, Image, View],
) -> None:
    """Count strong corners that are repeated in both images, and those that one track covers in
    both.
    """
    corners = _corners(before[1])
    again = _corners(now[1])
    if len(corners) == 0 or len(again) == 0:
        return
    true, visible = correspondence(simulation.world, before[2], now[2], corners)
    repeatable = visible & (_distances(true, again).min(axis=1) <= _REPEATED_PX)
    tally.corners += int(repeatable.sum())
    _, i, j = np.intersect1d(before[0].ids, now[0].ids, assume_unique=True, return_indices=True)
    if len(i) == 0:
        return
    here = _distances(corners, before[0].z[i, :2]) <= _COVERED_PX
    there = _distances(true, now[0].z[j, :2]) <= _COVERED_PX
    tally.corners_covered += int((repeatable & (here & there).any(axis=1)).sum())


def _corners(image: Image) -> FloatArray:
    found = cv2.goodFeaturesToTrack(image, _CORNERS, 0.02, _CORNER_GAP_PX, blockSize=5)
    return np.zeros((0, 2)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _distances(a: FloatArray, b: FloatArray) -> FloatArray:
    out: FloatArray = np.linalg.norm(a[:, None] - b[None], axis=2)
    return out


# --- figures
# --------------------------------------------------------------------------------------------------


def figures(tally: Tally) -> dict[str, Any]:
    """Reduce a tally to plain numbers; errors in pixels, shares from 0 to 1, None without
    observations.
    """
    lives = np.array(list(tally.frames_of.values()) or [0])
    tracked = int((lives > 1).sum())
    crossed = np.array(list(tally.crossed.values()), dtype=int)
    return {
        "frames": len(tally.features),
        "features_median": float(np.median(tally.features)),
        "features_least": int(min(tally.features)),
        "stereo_median": float(np.median(tally.matched)),
        "stereo_least": int(min(tally.matched)),
        "step": _errors(tally.step),
        "since_birth": _errors(tally.since_birth),
        "disparity": _errors([-error[:, 0] for error in tally.right]),
        "row": _errors([error[:, 1] for error in tally.right]),
        "life_mean": float(lives.mean()),
        "recall": tally.followed / tally.visible if tally.visible else None,
        "corner_recall": tally.corners_covered / tally.corners if tally.corners else None,
        "crossed": len(crossed) / tracked if tracked else None,
        "crossed_and_kept": int((crossed > _CROSSED_FRAMES).sum()) / tracked if tracked else None,
    }


def _errors(parts: Sequence[FloatArray]) -> dict[str, Any] | None:
    """Median, 95 % and outlier share of the absolute errors (N,) or (N, 2) of all frames, and
    their signed median.
    """
    if not any(map(len, parts)):
        return None
    error = np.concatenate(parts)
    size = np.abs(error) if error.ndim == 1 else np.linalg.norm(error, axis=1)
    bias = np.median(error, axis=0)
    return {
        "count": len(size),
        "median_px": float(np.median(size)),
        "p95_px": float(np.percentile(size, 95)),
        "outliers": float(np.mean(size > _OUTLIER_PX)),
        "bias_px": float(bias) if error.ndim == 1 else [float(x) for x in bias],
    }


def accuracy_scenario(
    effect: str | None, *, frames: int, width: int | None = None, seed: int = 1
) -> Scenario:
    """The room along a hand-held flight at 20 Hz; `effect` is a name of
    `vio.sim.scenarios.EFFECTS`.
    """
    conditions = conditions_of([] if effect is None else [effect])
    return Scenario(
        width=width, duration_s=frames / 20.0, conditions=conditions, imu="none", seed=seed
    )


def measure(scenario: Scenario, config: Config, *, workers: int) -> dict[str, Any]:
    """Render a scenario, run the configured front end over it, and return the figures."""
    simulation = plan(scenario)
    with (
        ParallelRecording(scenario, workers=workers, simulation=simulation) as parallel,
        one_blas_thread(),
    ):
        recording: SimulatedRecording = parallel if workers > 1 else SimulatedRecording(simulation)
        frontend = build_frontend(
            config.frontend.name, rectified_camera(simulation.rig), config.frontend, recording
        )
        return figures(
            evaluate(simulation, (recording.frame(k) for k in range(len(recording))), frontend)
        )


def table(results: dict[str, dict[str, Any]]) -> str:
    """Format the figures as a Markdown table."""
    head = (
        "| conditions | frames | features, stereo | step: median, 95 %, > 1 px | bias u, v "
        "| since birth: median, 95 %, > 1 px | disparity: median, 95 %, > 1 px, bias "
        "| life | recall | corners | crossed, kept |"
    )
    lines = [head, "|" + "---|" * head.count(" |")]
    for name, f in results.items():
        step = f["step"]
        row = f["disparity"]
        bias = "-" if step is None else f"{step['bias_px'][0]:.3f}, {step['bias_px'][1]:.3f}"
        cells = [
            name,
            f"{f['frames']}",
            f"{f['features_median']:.0f}, {f['stereo_median']:.0f}",
            _three(step),
            bias,
            _three(f["since_birth"]),
            _three(row) + ("" if row is None else f", {row['bias_px']:.3f}"),
            f"{f['life_mean']:.1f}",
            _percent(f["recall"]),
            _percent(f["corner_recall"]),
            f"{_percent(f['crossed'])}, {_percent(f['crossed_and_kept'])}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _three(errors: dict[str, Any] | None) -> str:
    if errors is None:
        return "-"
    return f"{errors['median_px']:.3f}, {errors['p95_px']:.3f}, {_percent(errors['outliers'])}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f} %"


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frontend", default="klt", metavar="NAME", help="front end (default klt)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="a.b=c", help="change a setting of it"
    )
    parser.add_argument(
        "--effects", default=",".join(SHOWN_EFFECTS), metavar="NAME,…", help="'' for none"
    )
    parser.add_argument("--frames", type=int, default=300, help="without effects (default 300)")
    parser.add_argument(
        "--effect-frames", type=int, default=100, help="under each effect (default 100)"
    )
    parser.add_argument("--width", type=int, metavar="PX", help="image width (default 752)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--workers", type=int, default=default_workers(300), help="rendering processes"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all figures")
    args = parser.parse_args(argv)
    effects = [name for name in args.effects.split(",") if name]
    try:
        unknown = [name for name in effects if name not in EFFECTS]
        if unknown:
            parser.error(f"no effect is called {unknown[0]}; choose from {', '.join(EFFECTS)}")
        config = load_config(None, [*args.set, f'frontend.name="{args.frontend}"'])
        results = {}
        for effect in [None, *effects]:
            frames = args.frames if effect is None else args.effect_frames
            scenario = accuracy_scenario(effect, frames=frames, width=args.width, seed=args.seed)
            results[effect or "none"] = measure(scenario, config, workers=args.workers)
            print(f"{effect or 'no effect'} done", file=sys.stderr)
    except VioError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table(results))
    if args.json is not None:
        args.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
