"""How simulated scenes, textures and recordings are laid out, measured: each as it is made to be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from vio.errors import SimulationError
from vio.geometry.lie import FloatArray, se3_exp
from vio.records import IntArray, StereoFrame
from vio.sim import exposure, people, render, scenarios, sequence, textures, world
from vio.sim.effects import SensorEffects
from vio.sim.export import _truth_csv
from vio.sim.exposure import _control
from vio.sim.lighting import Lighting, illumination
from vio.sim.motion import car_loop, fit_spline, hand_held, motion_at
from vio.sim.oracle import OracleFrontend, OracleSettings
from vio.sim.people import plan_walks
from vio.sim.rigs import small_rig
from vio.sim.scenarios import Conditions, Scenario, plan
from vio.sim.sequence import SimulatedRecording, room_around, simulate
from vio.sim.textures import build_mips, paint
from vio.sim.world import MovingBox, Patch, World, check_clear, equal_doors, room, street

MS = 1_000_000


# Rooms and streets

EMPTY = room(0, furniture=0, pictures=0)


def _clear_m() -> float:
    """How close to a wall a camera may be."""

    def is_clear(distance_m: float) -> bool:
        try:
            check_clear(EMPTY, [[-4.0 + distance_m, 0.0, 1.0]])
        except SimulationError:
            return False
        return True

    return float(min(mm for mm in range(10, 200) if is_clear(mm / 1000))) / 1000


def _patches(scene: World, kind: str) -> list[Patch]:
    return [patch for patch in scene.textures._patches if patch.kind == kind]


def _doors() -> int:
    """How often the corridor of equal doors repeats."""
    twins = [patch.twins for patch in equal_doors().textures._patches if patch.twins is not None]
    return max(twins.count(k) for k in set(twins))


def _door_m() -> float:
    return float(equal_doors().bounds[1, 0]) / _doors()


def _street_m() -> float:
    """Width of a street whose middle is 50 m away."""
    return 2.0 * (float(street(0, loop_m=(100.0, 70.0)).bounds[1, 0]) - 50.0)


def _parked(seed: int) -> list[FloatArray]:
    """Middles of boxes at the road around a block of 110 x 70 m."""
    solids = world._roadside(np.array([55.0, 35.0]), np.random.default_rng(seed))
    return [s.T_world_box[:2, 3] for s in solids if s.half_size[0] > 1.0]


def _most_parked() -> int:
    return max(len(_parked(seed)) for seed in range(9))


def _corner_m() -> float:
    """Distance of the nearest parked box from a corner of the middle line, along it."""
    places = np.abs([p for seed in range(9) for p in _parked(seed)])
    aside = np.abs(places - [55.0, 35.0])
    return float(aside.max(axis=1).min())


def _onward_m() -> float:
    """How far houses stand beyond the street's outer edge."""
    scene = street(0)
    return max(abs(s.T_world_box[0, 3]) + s.half_size[0] for s in scene.solids) - 62.5


def _bare_share() -> float:
    counts = [len(_patches(street(0, bare_houses=True), kind)) for kind in ("plaster", "facade")]
    return counts[0] / sum(counts)


def _mover_light() -> float:
    box = MovingBox(np.full(3, 0.5), lambda time_ns: np.eye(4), texel_m=0.05)
    lit_room = room(0, furniture=0, pictures=0, windows=1, moving=(box,))
    return float(lit_room.textures[int(np.flatnonzero(lit_room.surfaces.mover)[0])].gain)


def _light_cells(side_m: float) -> int:
    """Along a surface."""
    axes = np.eye(3)
    surface = Patch(np.zeros(3), axes[0], axes[1], np.array([side_m, 1.0]), "wall", 0.1)
    return world._light_on(surface, Lighting((), 0.5)).shape[1]


def _ambient(scene: World) -> float:
    """Light of a lit scene where none of its lights shines."""
    lighting = scene.textures._lighting
    assert lighting is not None
    return float(illumination(replace(lighting, lights=()), np.zeros((1, 3)), np.eye(3)[2])[0])


def _sun_deg() -> float:
    lights = street(0, sunlit=True).lights
    return float(np.degrees(np.arcsin(-lights[0].normal[2])))


# Textures

NOISE = np.random.default_rng(0).integers(0, 255, (512, 512), dtype=np.uint8)


def _level_sides() -> FloatArray:
    return np.asarray(build_mips(NOISE).levels[:, 0] * 512.0, dtype=np.float64)


def _border_texels() -> float:
    """What is repeated around a level."""
    return float(build_mips(NOISE).page.shape[1] - 512) / 2.0


def _metered_texels() -> int:
    """Along the copy of a texture that exposure is metered on."""
    share = np.column_stack([np.linspace(0.0, 1.0, 5000), np.full(5000, 0.5)])
    return int(np.count_nonzero(np.diff(build_mips(NOISE).coarse(share)))) + 1


def _marks() -> int:
    """Of one kind on a very large road."""
    counts: list[int] = []

    def drawn(canvas: Any, rng: Any, count: int, *_: Any) -> None:
        counts.append(count)

    with (
        patch.object(textures, "_rectangles", drawn),
        patch.object(textures, "_polygons", drawn),
        patch.object(textures, "_fill", lambda *_: None),
    ):
        paint("asphalt", np.array([600.0, 600.0]), 2.0, np.random.default_rng(0))
    return counts[0]


# People, cameras and their exposure


def _times_apart_s() -> float:
    """Between the times at which a camera and a person are kept apart."""
    steps: list[float] = []

    def clearance(walk: Any, times: IntArray, path: Any) -> float:
        steps.append(float(np.median(np.diff(times))) * 1e-9)
        return 9.0

    motion = hand_held(duration_s=10.0)
    with patch.object(people, "_clearance", clearance):
        plan_walks(EMPTY, motion, 1, seed=0, reach_m=0.5, clearance_m=0.5)
    return min(steps)


def _camera_times_s() -> float:
    """Between the times at which a camera is looked for in walls."""
    counts: list[int] = []
    motion = hand_held(duration_s=2.0)
    with patch.object(sequence, "check_clear", lambda world, p, **_: counts.append(len(p))):
        times = motion.start_ns + np.array([0, 1000 * MS])
        sequence._check_cameras(EMPTY, small_rig(), motion, times)
    return 1.0 / (counts[0] - 1)


def _from_path_to_wall_m() -> float:
    motion = hand_held(duration_s=2.0)
    times = np.arange(motion.start_ns, motion.end_ns, 10 * MS)
    p = motion_at(motion, times).T_world_imu[:, :3, 3]
    return float((room_around(motion).bounds[1] - p.max(axis=0)).min())


def _metered_rays() -> list[int]:
    """Columns and rows of the grid that meters an image."""
    rays: list[FloatArray] = []

    def cast(surfaces: Any, T: Any, directions: FloatArray) -> Any:
        rays.append(directions)
        raise ZeroDivisionError

    with patch.object(exposure, "cast", cast), pytest.raises(ZeroDivisionError):
        exposure._meter(EMPTY, small_rig().cam0, np.eye(4)[None], np.zeros(1, np.int64))
    places = rays[0][:, :2] / rays[0][:, 2:]
    return [len(np.unique(places[:, k].round(9))) for k in (0, 1)]


def _quickest_change() -> int:
    """Frames from a change of light to that of the exposure, at least."""
    delays: list[int] = []
    for seed in range(20):
        radiance = np.full((40, 4), 95.0)
        radiance[10:] *= 0.5
        shutter = _control(radiance, SensorEffects(auto_exposure=True), 0, seed)[0]
        delays.append(int(np.flatnonzero(np.abs(shutter / shutter[0] - 1.0) > 1e-6)[0]) - 10)
    return min(delays)


def _blur_taps(length_px: float) -> int:
    """Samples along a blur of a length to each side."""
    taps: list[int] = []
    simulation = SimpleNamespace(effects=SensorEffects(auto_exposure=True, blur_samples=5))
    recording: Any = SimpleNamespace(
        simulation=simulation,
        flow=lambda *_: np.full((4, 4, 2), length_px),
        _sharp=lambda *_: None,
    )
    with patch.object(sequence, "blur_along_flow", lambda *args: taps.append(args[3])):
        SimulatedRecording._blurred(recording, 0, 0, 1.0)
    return taps[0]


SMALL = simulate(room(0), small_rig(480, 288), hand_held(duration_s=1.0), rate_hz=10.0)


def _most_in_cell() -> int:
    """Features of an oracle in a part of an image of 48 pixels a side, which has half as many."""
    oracle = OracleFrontend(SMALL, OracleSettings(max_features=30))
    oracle.process(StereoFrame(0, int(SMALL.stamps_ns[0]), None, None))
    cells = (oracle.exact(0)[:, :2] // 48).astype(int)
    return int(np.unique(cells, axis=0, return_counts=True)[1].max())


# Recordings


def _truth_s() -> float:
    """Between the rows of the ground truth that is written."""
    rows = _truth_csv(SimulatedRecording(SMALL)).splitlines()[1:]
    times = np.array([int(row.split(",")[0]) for row in rows])
    return float(np.median(np.diff(times))) * 1e-9


def _rejected(aside_m: float = 0.0, turned_rad: float = 0.0) -> int:
    """Of poses of a smooth motion, one of which is off."""
    times = 10 * MS * np.arange(200)
    T = np.tile(np.eye(4), (200, 1, 1))
    T[100] = T[100] @ se3_exp([aside_m, 0.0, 0.0, turned_rad, 0.0, 0.0])
    return fit_spline(times, T, robust=True)[1].rejected


def _margin_s() -> float:
    """Of motion before the first frame."""
    simulation = plan(Scenario(duration_s=1.0, rate_hz=100.0, width=64))
    return float(simulation.taken_ns[0] - simulation.motion.start_ns) * 1e-9


def _lead_m() -> float:
    """From a car to the one ahead."""
    motion = car_loop(duration_s=2.0)
    ahead = scenarios._traffic(motion, 0)[0].motion(motion.start_ns)[:3, 3]
    here = motion_at(motion, motion.start_ns).T_world_imu[0, :3, 3]
    return float(np.linalg.norm((ahead - here)[:2]))


def _windows() -> int:
    conditions = Conditions(lighting=True)
    return len(plan(Scenario(duration_s=1.0, width=64, conditions=conditions)).world.lights)


def _wall_gap_m() -> float:
    """From a wall to the middle of a box that moves along it."""
    motion = hand_held(duration_s=1.0)
    boxes = scenarios._boxes_along_walls(EMPTY, motion)
    ends = np.array([box.motion(motion.start_ns)[:2, 3] for box in boxes])
    return float(4.0 - np.abs(ends[:, 0]).max())


def _demo() -> Any:
    """The simulation of the demo's recording."""
    made: list[Any] = []
    with patch.object(
        scenarios, "export_kitti", lambda recording, *_, **__: made.append(recording)
    ):
        scenarios.write_demo_recording(Path("demo"))
    return made[0].simulation


def _demo_s() -> list[float]:
    """From frame to frame, and from the first to the last."""
    stamps = _demo().stamps_ns
    return [float(np.median(np.diff(stamps))) * 1e-9, float(np.ptp(stamps)) * 1e-9]


def _demo_begins_m() -> float:
    """How far along the loop."""
    ends = [_demo().motion, car_loop(duration_s=1.0, seed=4)]
    p = [motion_at(motion, motion.start_ns).T_world_imu[0, :3, 3] for motion in ends]
    return float(np.linalg.norm((p[0] - p[1])[:2]))


def _flow_grid_px() -> float:
    """Between the pixels at which optical flow is exact, of an image 480 pixels wide."""
    nodes: list[FloatArray] = []

    def correspondence(scene: Any, view: Any, other: Any, uv: FloatArray) -> Any:
        nodes.append(uv)
        raise ZeroDivisionError

    times = SMALL.taken_ns
    with (
        patch.object(sequence, "correspondence", correspondence),
        pytest.raises(ZeroDivisionError),
    ):
        SimulatedRecording(SMALL).flow(0, int(times[1]), int(times[2]))
    return 480.0 / (len(np.unique(nodes[0][:, 0])) - 2)


def _reach_knots() -> float:
    """For how long a motion changes where one of its control points does: a spline's degree and
    one more.
    """
    motion = hand_held(duration_s=4.0)
    moved = motion.p_control.copy()
    moved[len(moved) // 2, 0] += 1.0
    times = np.arange(motion.start_ns, motion.end_ns, 5 * MS)
    T = [motion_at(m, times).T_world_imu for m in (motion, replace(motion, p_control=moved))]
    changed = times[np.abs(T[0] - T[1]).max(axis=(1, 2)) > 1e-12]
    return float(np.ptp(changed)) * 1e-9 / motion.knot_s


def test_samples_of_a_fine_pixel_are_in_rows_and_columns_of_their_own() -> None:
    """Eight of them, symmetric about the middle."""
    at = np.sort(render._FINE.astype(np.float64), axis=0)
    assert at == pytest.approx(np.repeat((np.arange(8) - 3.5)[:, None] / 8, 2, axis=1))
    places = {tuple(place) for place in render._FINE.tolist()}
    assert places == {(-u, -v) for u, v in places}


FIGURES: dict[str, tuple[Callable[[], float], float, float]] = {
    "wall: clearance": (_clear_m, 0.045, 0.055),
    "doors": (_doors, 10, 10),
    "doors: apart": (_door_m, 2.9, 3.1),
    "street: width": (_street_m, 14.5, 15.5),
    "street: parked": (_most_parked, 33, 36),
    "street: corner": (_corner_m, 13.0, 15.0),
    "street: onward": (_onward_m, 78.0, 82.0),
    "street: bare houses": (_bare_share, 0.31, 0.36),
    "light: of what moves": (_mover_light, 0.65, 0.75),
    "light: cell": (lambda: 10.0 / _light_cells(10.0), 0.24, 0.26),
    "light: cells": (lambda: _light_cells(200.0), 400, 400),
    "light: room": (lambda: _ambient(room(0, windows=1)), 0.2, 0.24),
    "light: street": (lambda: _ambient(street(0, sunlit=True)), 0.37, 0.43),
    "light: sun": (_sun_deg, 16.0, 18.5),
    "texture: smallest": (lambda: _level_sides()[-1], 4, 4),
    "texture: step": (lambda: _level_sides()[0] / _level_sides()[2], 1.95, 2.05),
    "texture: border": (_border_texels, 3, 3),
    "texture: metered": (_metered_texels, 14, 18),
    "texture: marks": (_marks, 6000, 6000),
    "people: times": (_times_apart_s, 0.045, 0.055),
    "camera: times": (_camera_times_s, 0.018, 0.022),
    "flight: walls": (_from_path_to_wall_m, 1.1, 1.3),
    "exposure: columns": (lambda: _metered_rays()[0], 12, 12),
    "exposure: rows": (lambda: _metered_rays()[1], 8, 8),
    "exposure: quickest": (_quickest_change, 2, 2),
    "blur: samples": (lambda: _blur_taps(50.0), 21, 21),
    "blur: spacing": (lambda: 2.0 * 6.0 / (_blur_taps(6.0) - 1), 1.1, 1.3),
    "blur: exact flow": (_flow_grid_px, 15.0, 17.0),
    "oracle: in a cell": (_most_in_cell, 1, 1),
    "truth: steps": (_truth_s, 0.0045, 0.0055),
    "motion: reach": (_reach_knots, 5.8, 6.1),
    "flight: outlier": (lambda: _rejected(0.0024), 1, 1),
    "flight: smoothing": (lambda: _rejected(0.0019), 0, 0),
    "flight: turned outlier": (lambda: _rejected(0.0, 0.012), 1, 1),
    "flight: turned smoothing": (lambda: _rejected(0.0, 0.0095), 0, 0),
    "recording: margin": (_margin_s, 0.24, 0.26),
    "traffic: ahead": (_lead_m, 13.5, 14.5),
    "room: windows": (_windows, 2, 2),
    "room: lane": (_wall_gap_m, 0.36, 0.44),
    "demo: width": (lambda: _demo().rig.cam0.width, 800, 800),
    "demo: frames": (lambda: _demo_s()[0], 0.09, 0.11),
    "demo: time": (lambda: _demo_s()[1], 13.5, 14.5),
    "demo: begins": (_demo_begins_m, 11.0, 13.0),
}


@pytest.mark.parametrize(("measured", "low", "high"), FIGURES.values(), ids=FIGURES)
def test_figures_of_scenes(measured: Callable[[], float], low: float, high: float) -> None:
    assert low <= measured() <= high
