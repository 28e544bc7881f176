"""How soon a rig that was carried off in the dark finds its place in a map again: rendered, with and without an IMU.

    python tools/bench_kidnapped.py [--width 376] [--json FILE]

A hall of 18 m is mapped in one flight (8 s at each end, and the way between). A second flight, half the light and more
noise, spends 4 s at one end, 5 s in the dark in which it is carried 10 m to the other end, and 4 s there. Told are the
time from the first lit frame until poses in the map are right to 5 cm, the share of frames that are from then on, and
normalised squared errors by the stated covariance (6 expected), before, in and after the dark.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.config import Config, MotionName
from vio.evaluation.trajectories import align_poses
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, se3_log
from vio.records import BoolArray, Image, IntArray
from vio.runs.pipeline import run
from vio.sim.effects import SensorEffects
from vio.sim.imu import ImuNoise
from vio.sim.motion import MotionSpline, evaluate, fit_spline, hand_held, rotate_body_axes
from vio.sim.rigs import R_FLU_EUROC_IMU, euroc_rectified_rig
from vio.sim.scenarios import scaled
from vio.sim.sequence import SimulatedRecording, Simulation, simulate
from vio.sim.world import World, room

RATE_HZ = 20.0
ENDS = -5.0, 5.0  # x of the middle of both flights at the ends, m
RIGHT_M = 0.05


class Kept(SimulatedRecording):
    """A simulated recording whose images are rendered once, and show nothing but noise while it is dark."""

    def __init__(self, simulation: Simulation, dark_s: tuple[float, float] | None = None) -> None:
        """Store the plan."""
        super().__init__(simulation)
        self._images: dict[int, tuple[Image, Image]] = {}
        t = 1e-9 * (simulation.stamps_ns - simulation.stamps_ns[0])
        self.dark = np.zeros(len(t), dtype=np.bool_) if dark_s is None else (t >= dark_s[0]) & (t < dark_s[1])

    def images(self, index: int) -> tuple[Image, Image]:
        """Render both images (H, W) of one frame, unless it is dark."""
        if self.dark[index]:
            camera, rng = self.simulation.rig.cam0, np.random.default_rng([self.simulation.seed, index])
            noise = np.abs(rng.normal(0, 1.5, (2, camera.height, camera.width))).astype(np.uint8)
            return noise[0], noise[1]
        if index not in self._images:
            self._images[index] = super().images(index)
        return self._images[index]


def flight(seed: int, stay_s: float, way_s: float) -> MotionSpline:
    """Around one end of the hall, to the other end, and around it."""
    total = 2 * stay_s + way_s
    spline = hand_held(centre=(0.0, 0.0, 1.4), extent=(1.3, 1.2, 0.25), duration_s=total + 1.0, period_s=9.0, seed=seed)
    t = np.arange(0.0, total + 0.75, 0.025)
    times = np.round(1e9 * t).astype(np.int64)
    T = evaluate(spline, times).T_world_imu.copy()
    u = np.clip((t - stay_s) / way_s, 0.0, 1.0)
    T[:, 0, 3] += ENDS[0] + (ENDS[1] - ENDS[0]) * u**3 * (10 - 15 * u + 6 * u**2)
    return rotate_body_axes(fit_spline(times, T, knot_s=0.1)[0], R_FLU_EUROC_IMU)


def hall() -> World:
    """A furnished hall of 18 x 6 m."""
    x = np.linspace(-7.0, 7.0, 60)
    clear = np.concatenate([np.stack([x, 0 * x + y, 0 * x + 1.4], axis=1) for y in (-1.4, 0.0, 1.4)])
    bounds = ((-9.0, -3.0, 0.0), (9.0, 3.0, 2.8))
    return room(3, bounds=bounds, furniture=16, pictures=24, keep_clear=clear, texel_m=0.006)


def recordings(width: int) -> tuple[Kept, Kept]:
    """The flight that makes the map, and the one that is carried off."""
    world, rig = hall(), scaled(euroc_rectified_rig(), width)
    known = simulate(world, rig, flight(1, 8.0, 5.0), rate_hz=RATE_HZ, imu=ImuNoise(), seed=1)
    dim = SensorEffects(exposure=0.5, read_noise=1.5, full_well=8000.0)
    carried = simulate(world, rig, flight(2, 4.0, 5.0), rate_hz=RATE_HZ, imu=ImuNoise(), effects=dim, seed=2)
    return Kept(known), Kept(carried, (4.0, 9.0))


def measure(known: Kept, carried: Kept, motion: MotionName, folder: Path) -> dict[str, Any]:
    """Map one flight and localise the other one."""
    config = replace(Config(), motion=motion)
    path = folder / f"{motion}.map"
    mapped = run(known, config, map_file=path).mapped
    found = run(carried, config, map_file=path, localise=True).mapped
    assert mapped is not None
    assert found is not None
    truth, was = carried.reference.T_world_body, known.reference.T_world_body
    frame = align_poses(mapped.T_map_body, was[: len(mapped.T_map_body)], "se3")
    A, rows = se3_from_parts(frame.R, frame.t), found.causal[np.isfinite(found.causal["covariance"][:, 0, 0])]
    index = rows["index"]
    r = se3_log(se3_inverse(A @ rows["T_map_body"]) @ truth[index])
    squared = np.einsum("ni,ni->n", r, np.linalg.solve(rows["covariance"], r[..., None])[..., 0])
    return summary(carried.dark, index, np.linalg.norm(r[:, :3], axis=1), squared)


def summary(dark: BoolArray, index: IntArray, error: FloatArray, squared: FloatArray) -> dict[str, Any]:
    """What the errors (N,) of frames `index` say; those without a place are not among them."""
    begins, ends = int(np.argmax(dark)), int(len(dark) - np.argmax(dark[::-1]))
    before, within, after = index < begins, (index >= begins) & (index < ends), index >= ends
    right = index[after & (error < RIGHT_M)]
    first = int(right[0]) if len(right) else None
    since = after & (index >= (first if first is not None else len(dark)))
    return {
        "first_placed_s": float(index[0] / RATE_HZ) if len(index) else None,
        "found_again_s": None if first is None else (first - ends) / RATE_HZ,
        "right_since": float(np.mean(error[since] < RIGHT_M)) if since.any() else 0.0,
        "median_mm": 1e3 * float(np.median(error[since])) if since.any() else None,
        "placed_in_the_dark": int(within.sum()) / max(ends - begins, 1),
        "largest_in_the_dark_m": float(error[within].max(initial=0.0)),
        "squared_before": float(squared[before].mean()) if before.any() else None,
        "squared_dark": float(squared[within].mean()) if within.any() else None,
        "squared_after": float(squared[since].mean()) if since.any() else None,
    }


def main() -> None:
    """Measure with and without an IMU."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=376)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    known, carried = recordings(arguments.width)
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        motions: tuple[MotionName, ...] = ("imu", "none")
        for motion in motions:
            results[motion] = measure(known, carried, motion, Path(folder))
            print(motion, json.dumps(results[motion]), flush=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
