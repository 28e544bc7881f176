"""What people, light, glare and exposure of simulated scenes are like, measured: each within a
tenth or two of what it is made to be.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from vio.geometry.lie import FloatArray, se3_from_parts, so3_log
from vio.sim import glare
from vio.sim.effects import SensorEffects
from vio.sim.export import _levels
from vio.sim.exposure import _control
from vio.sim.glare import _ghosts, _halo
from vio.sim.lighting import Light, Lighting, illumination
from vio.sim.motion import _limit, _ramped_time, car_loop, motion_at
from vio.sim.people import Walk, _clearance, along_walks, walking_people

MS = 1_000_000
LONG = Walk(np.zeros(3), np.array([100.0, 0.0, 0.0]), 1.2, 0.0, 0)
SHORT = Walk(np.zeros(3), np.array([3.0, 0.0, 0.0]), 1.0, 0.0, 0)


# People


def _trunk(walk: Walk, seconds: float = 20.0) -> FloatArray:
    box = walking_people([walk], seed=0)[1]
    return np.array([box.motion(t) for t in range(0, round(1000 * MS * seconds), 5 * MS)])


def _sway() -> FloatArray:
    T = _trunk(LONG)
    axis = np.array([so3_log(R) for R in T[:, :3, :3]])
    middle = T[:, :3, 3] - T[:, :3, 2] * np.median(T[:, 2, 3])
    return np.column_stack([middle[:, 1], T[:, 2, 3], axis[:, 2], axis[:, 0]])


def _amplitude(column: int) -> float:
    return float(np.ptp(_sway()[:, column])) / 2


def _steps_per_s() -> float:
    side = np.sign(_sway()[:, 0])
    return float(np.count_nonzero(np.diff(side[side != 0]))) / 20.0


def _pause_s() -> float:
    x = _trunk(SHORT, 25.2)[:, 0, 3]
    still = np.abs(np.diff(x)) < 1e-3
    return float(still.sum()) * 0.005 / 6


def _aside_m(height_m: float, x_m: float) -> float:
    """Distance of a camera beside a person, and above one."""
    return _clearance(LONG, np.array([0]), np.array([[x_m, 0.0, height_m]]))


# Light

WINDOW = Light(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.5 * np.eye(3)[:2], 1.0, 200.0)
SUN = Light(
    np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]), np.zeros((2, 3)), 1.0, 200.0, True
)


def _lit(point: list[float], normal: list[float]) -> float:
    return float(illumination(Lighting((WINDOW,), 0.0), [point], normal)[0])


def _is_lit_below(box_top_m: float) -> bool:
    """Whether a point on the ground under a flat box is lit by the sun."""
    pose = se3_from_parts(np.eye(3), np.array([0.0, 0.0, box_top_m / 2]))
    half = np.array([[0.5, 0.5, box_top_m / 2]])
    lighting = Lighting((SUN,), 0.0, pose[None], half)
    return float(illumination(lighting, [[0.0, 0.0, 0.0]], [0.0, 0.0, 1.0])[0]) > 0.5


# Glare


def _seen_at(angle_rad: float, *, distant: bool = False) -> float:
    """Light of a source in a direction at an angle from it, over the source's."""
    light = SUN if distant else WINDOW
    rays = np.array([np.sin(angle_rad), 0.0, np.cos(angle_rad)], dtype=np.float32)
    return float(_halo(rays.reshape(3, 1, 1), np.array([0.0, 0.0, 1.0]), light)[0, 0]) / 200.0


def _ghost_levels(source_deg: float) -> FloatArray:
    x, y = np.meshgrid(np.linspace(-1.6, 1.6, 801), np.linspace(-0.4, 0.4, 201))
    rays = np.stack([x, y, np.ones_like(x)]).astype(np.float32)
    angle = np.radians(source_deg)
    source = np.array([np.sin(angle), 0.0, np.cos(angle)])
    return np.asarray(_ghosts(rays, source, np.float32(1.0)), dtype=np.float64)


def _ghost_reach_deg() -> float:
    return float(max(deg for deg in range(20, 80) if _ghost_levels(deg).any()))


def _ghost_share(place: float) -> float:
    """Level of the ghost at a place on the line from a source through the axis."""
    return float(_ghost_levels(40.0)[100, round(400 + 250 * place * np.tan(np.radians(40.0)))])


def _ghost_area() -> float:
    return float((_ghost_levels(40.0) > 1.0).sum()) * (3.2 / 800) ** 2


# Exposure


def _exposed(octaves: float, frames: int = 40, **effects: float) -> FloatArray:
    """Octaves by which the exposure has changed, frame by frame, after the scene became darker."""
    radiance = np.full((frames, 4), 95.0)
    radiance[10:] *= 2.0**-octaves
    shutter, gain, _ = _control(radiance, SensorEffects(auto_exposure=True, **effects), 0, 3)
    changed: FloatArray = np.log2(shutter * gain / (shutter[0] * gain[0]))
    return changed


def _first_change() -> float:
    return float(np.flatnonzero(np.abs(_exposed(0.3)) > 1e-6)[0] - 10)


def _changes() -> FloatArray:
    """Frames of the changes after a large step."""
    steps = np.diff(_exposed(3.0, shutter_max_ms=1e6))
    return np.flatnonzero(np.abs(steps) > 1e-6)


def _largest_change() -> float:
    return float(np.abs(np.diff(_exposed(3.0, shutter_max_ms=1e6))).max())


def _share_of_error() -> float:
    return float(_exposed(0.5)[np.flatnonzero(np.abs(_exposed(0.5)) > 1e-6)[0]]) / 0.5


def _left_alone(octaves: float) -> bool:
    return bool(np.abs(_exposed(octaves)).max() < 1e-6)


def _shortest_ms() -> float:
    shutter, _, _ = _control(np.full((90, 4), 1e7), SensorEffects(auto_exposure=True), 0, 3)
    return float(shutter.min())


def _gains(seed: int) -> FloatArray:
    """All gains of a camera, which it takes where scenes are the darker."""
    effects = SensorEffects(auto_exposure=True, gain_max=8.0)
    dark = [np.full((1, 4), 95.0 * 2.0 ** (-0.2 * k)) for k in range(80)]
    return np.unique([_control(radiance, effects, 0, seed)[1][0] for radiance in dark])


def _gain_step() -> float:
    gains = _gains(3)
    return float((gains[-1] / gains[0]) ** (1 / (len(gains) - 1)))


def _gain_error() -> float:
    dark = np.full((1, 4), 1e-3)
    effects = SensorEffects(auto_exposure=True, gain_max=8.0)
    gains = [_control(dark, effects, 0, seed)[1][0] for seed in range(300)]
    return float(np.std(gains) / 8.0)


# What is seen of a source


def _source(distance_m: float, light: Light = WINDOW) -> tuple[FloatArray, float]:
    """Points of a source that are visible where the ray to each meets something so far away, and
    their light over the source's.
    """
    pose = np.eye(4)
    pose[2, 3] = 10.0
    view: Any = SimpleNamespace(T_world_cam=pose)
    met = SimpleNamespace(found=np.ones(9, np.bool_), distance=np.full(9, distance_m))
    if light.distant:
        met = SimpleNamespace(found=np.ones(1, np.bool_), distance=np.full(1, distance_m))
    surfaces: Any = None
    with patch.object(glare, "cast", lambda *_: met):
        return glare._sources(light, view, surfaces)


def _sky_m() -> float:
    """How far away something is at least that is taken for the sky."""
    return float(min(m for m in range(50, 200) if len(_source(m, SUN)[0])))


# Motion and depth images


def _car_speeds() -> FloatArray:
    motion = car_loop()
    times = np.arange(motion.start_ns, motion.end_ns, 50 * MS)
    return np.asarray(np.linalg.norm(motion_at(motion, times).velocity_world, axis=1))


def _half_way_s() -> float:
    """When a rig that begins to move has half of its speed."""
    t = np.linspace(0.0, 5.0, 5001)
    return float(t[np.searchsorted(np.gradient(_ramped_time(t), t), 0.5)])


def _outlying() -> float:
    """Residuals that are no noise, in standard deviations."""
    kept = np.abs(np.random.default_rng(0).normal(size=100_000))
    return _limit(kept, 0.0)


def _depths(z: float) -> FloatArray:
    levels = _levels(np.full((100, 100), z), np.random.default_rng(0))
    return np.asarray(levels / 5000.0)


def _depth_ends() -> FloatArray:
    known = [z for z in np.arange(0.1, 20.0, 0.05) if (_depths(z) > 0).all()]
    return np.array([known[0], known[-1]])


FIGURES: dict[str, tuple[Callable[[], float], float, float]] = {
    "people: steps": (_steps_per_s, 1.5, 2.1),
    "people: pause": (_pause_s, 1.0, 1.45),
    "people: sway": (lambda: _amplitude(0), 0.025, 0.036),
    "people: bob": (lambda: _amplitude(1), 0.0105, 0.015),
    "people: twist": (lambda: _amplitude(2), 0.068, 0.095),
    "people: lean": (lambda: _amplitude(3), 0.025, 0.036),
    "people: aside": (lambda: _aside_m(1.0, 1.0), 0.62, 0.78),
    "people: above": (lambda: _aside_m(3.0, 0.0), 1.0, 1.4),
    "people: way": (lambda: float(along_walks([LONG])[:, 2].mean()), 0.25, 0.35),
    "window: near": (lambda: _lit([0.0, 0.0, 0.05], [0.0, 0.0, -1.0]), 2.5, 3.5),
    "window: aside": (lambda: _lit([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]), 0.29, 0.41),
    "shadow": (lambda: 1000.0 * max(h for h in range(1, 40) if _is_lit_below(1e-3 * h)), 8e3, 12e3),
    "halo": (lambda: _seen_at(0.0), 0.03, 0.041),
    "halo: half of it": (lambda: _seen_at(0.12) / _seen_at(0.0), 0.42, 0.58),
    "sun": (lambda: _seen_at(0.0, distant=True), 2.6, 3.5),
    "sun: a quarter of it": (
        lambda: _seen_at(0.012, distant=True) / _seen_at(0.0, distant=True),
        0.21,
        0.31,
    ),
    "ghosts: reach": (_ghost_reach_deg, 45.0, 58.0),
    "ghosts: level": (lambda: float(_ghost_levels(40.0).max()), 36.0, 47.0),
    "ghosts: area": (_ghost_area, 0.01, 0.05),
    "exposure: first change": (_first_change, 2.0, 2.0),
    "exposure: every": (lambda: float(np.diff(_changes()).min()), 3.0, 3.0),
    "exposure: largest change": (_largest_change, 0.52, 0.68),
    "exposure: share of the error": (_share_of_error, 0.52, 0.68),
    "exposure: gain step": (_gain_step, 1.3, 1.55),
    "exposure: gain error": (_gain_error, 0.042, 0.06),
    "window: light": (lambda: 9 * _source(10.0)[1], 0.17, 0.23),
    "sun: light": (lambda: _source(1e3, SUN)[1], 0.021, 0.029),
    "sun: sky": (_sky_m, 90.0, 110.0),
    "car: speed": (lambda: float(_car_speeds().max()), 9.0, 11.0),
    "car: acceleration": (
        lambda: float(np.abs(np.diff(_car_speeds()) / 0.05).max()),
        1.5,
        2.2,
    ),
    "rig: begins": (_half_way_s, 0.85, 1.15),
    "poses: outlying": (_outlying, 4.5, 5.5),
    "depth: noise": (lambda: float(_depths(4.0).std()), 0.021, 0.027),
    "depth: level": (lambda: float(_depths(2.0).mean()), 1.9, 2.1),
    "depth: nearest": (lambda: float(_depth_ends()[0]), 0.35, 0.5),
    "depth: farthest": (lambda: float(_depth_ends()[1]), 7.0, 9.0),
    "exposure: shortest": (_shortest_ms, 0.017, 0.023),
}


@pytest.mark.parametrize(("measured", "low", "high"), FIGURES.values(), ids=FIGURES)
def test_figures_of_scenes(measured: Callable[[], float], low: float, high: float) -> None:
    assert low <= measured() <= high


@pytest.mark.parametrize(("octaves", "alone"), [(0.085, True), (0.115, False)])
def test_small_changes_of_light_leave_the_exposure_alone(octaves: float, alone: bool) -> None:
    assert _left_alone(octaves) == alone
