"""Named recordings: scene, trajectory, rig and effects define one plan, identical in every
process.
"""

from __future__ import annotations

import contextlib
import functools
import math
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from vio.errors import DataError, SimulationError
from vio.geometry.distortion import CameraModel, StereoRig
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts
from vio.numerics.kinds import Capacity
from vio.numerics.threads import start_worker
from vio.protocols import Progress
from vio.records import NS_PER_S, Image, ImuRecord, IntArray
from vio.setting import setting
from vio.sim.effects import CLEAN, SensorEffects
from vio.sim.export import export_kitti
from vio.sim.imu import ImuNoise, VelocityNoise
from vio.sim.miscalibration import CalibrationErrors, CalibrationSigmas
from vio.sim.motion import (
    MotionSpline,
    car_loop,
    hand_held,
    look_rotation,
    motion_at,
    rotate_body_axes,
    spline_from_waypoints,
)
from vio.sim.people import Walk, along_walks, plan_walks, walking_people
from vio.sim.rigs import (
    R_FLU_EUROC_IMU,
    euroc_like_rig,
    euroc_rectified_rig,
    fisheye_rig,
    kitti_like_rig,
    small_rig,
    wide_rig,
)
from vio.sim.sequence import (
    FrameFaults,
    SimulatedRecording,
    Simulation,
    read_flight,
    room_around,
    simulate,
)
from vio.sim.textures import TextureKind
from vio.sim.world import MovingBox, SceneName, World, corridor, equal_doors, room, street

ReadyMotion: TypeAlias = Literal["handheld", "car"]
RigName: TypeAlias = Literal["euroc", "euroc-rectified", "kitti", "fisheye", "wide", "small"]
VelocityName: TypeAlias = Literal["none", "paper", "exact"]

RIGS: dict[str, Callable[[], StereoRig]] = {
    "euroc": euroc_like_rig,
    "euroc-rectified": euroc_rectified_rig,
    "kitti": kitti_like_rig,
    "fisheye": fisheye_rig,
    "wide": wide_rig,
    "small": small_rig,
}
_EUROC_AXES = ("euroc", "euroc-rectified")  # rigs whose IMU axes are up, right, forward


class _Scene(NamedTuple):
    """Sizes of what the scenarios have in common."""

    # of motion before the first and after the last frame, for shutters and clock offsets
    margin_s: float = 0.25
    lead_m: float = 14.0  # to the car ahead
    windows: int = 2  # of a room with lighting
    wall_gap_m: float = 0.4  # from a wall to the middle of a box that moves along it


_SCENE = _Scene()
_AHEAD: Capacity[int] = 3  # pending frames per process

FLIGHT_FILES = ("groundtruth_tum.txt", "image_timestamps_ns.txt", "imu0.csv")


@dataclass(frozen=True, slots=True)
class Conditions:
    """Adverse conditions of a recording; the defaults are a well-lit scene and a good camera."""

    effects: SensorEffects = field(default_factory=SensorEffects)
    faults: FrameFaults = field(default_factory=FrameFaults)
    imu_noise: ImuNoise = field(default_factory=ImuNoise)  # of the simulated IMU
    calibration: CalibrationErrors = field(default_factory=CalibrationErrors)
    calibration_sigmas: CalibrationSigmas = field(default_factory=CalibrationSigmas)
    bare_wall: bool = setting(
        False, "two walls without texture; in the street a third of the houses"
    )
    moving: bool = setting(False, "boxes that move on their own")
    people: int = setting(0, "people who walk near the path")
    lighting: bool = setting(
        False, "light from two windows, in the street from a low sun; else even light"
    )


def _with_effects(**values: Any) -> Callable[[Conditions], Conditions]:
    return lambda conditions: replace(conditions, effects=replace(conditions.effects, **values))


def _with_faults(**values: float) -> Callable[[Conditions], Conditions]:
    return lambda conditions: replace(conditions, faults=replace(conditions.faults, **values))


EFFECTS: dict[str, Callable[[Conditions], Conditions]] = {
    "clean": lambda conditions: replace(conditions, effects=CLEAN),
    "exposure": _with_effects(exposure_swing=0.3),
    "gain": _with_effects(right_gain=0.6),
    "gain-high": _with_effects(right_gain=1.6),
    "blur": _with_effects(blur_exposure_ms=15.0),
    "noise": _with_effects(read_noise=5.0, full_well=5000.0),
    "dark": _with_effects(exposure=0.06, read_noise=1.5, full_well=10000.0),
    "bare-wall": lambda conditions: replace(conditions, bare_wall=True),
    "moving": lambda conditions: replace(conditions, moving=True),
    "dropped": _with_faults(dropped=0.1),
    "duplicated": _with_faults(duplicated=0.1),
    "time-offset": _with_faults(time_offset_ms=20.0),
}


def real_conditions(scene: SceneName, *, drawn_rig: bool = False) -> Conditions:
    """Return the conditions of `--realism real`, or `drawn`: what real cameras and places do,
    all at once.
    """
    outdoors = scene == "street"
    effects = SensorEffects(
        right_gain=0.85,
        vignetting=0.35,
        read_noise=0.8,
        full_well=8000.0,
        auto_exposure=True,
        shutter_ms=2.0 if outdoors else 14.0,
        shutter_max_ms=8.0 if outdoors else 15.0,
        camera_difference=0.15,
        glare=1.0,
    )
    return Conditions(
        effects=effects,
        calibration=CalibrationErrors(scale=0.0 if drawn_rig else 1.0),
        calibration_sigmas=CalibrationSigmas(scale=1.0 if drawn_rig else 0.0),
        bare_wall=True,
        moving=outdoors,
        people=12 if outdoors else 4,
        lighting=True,
    )


def conditions_of(names: Sequence[str], start: Conditions | None = None) -> Conditions:
    """Return the conditions that named effects produce, applied in order to those at the start
    (None: the defaults).

    Raises:
        SimulationError: there is no effect of that name.
    """
    conditions = Conditions() if start is None else start
    for name in names:
        if name not in EFFECTS:
            raise SimulationError(f"there is no effect {name!r}; choose from {', '.join(EFFECTS)}")
        conditions = EFFECTS[name](conditions)
    return conditions


@dataclass(frozen=True, slots=True)
class Scenario:
    """The picklable description of a recording, which other processes can rebuild it from."""

    scene: SceneName = "room"  # along a recorded trajectory a room is built around it
    trajectory: ReadyMotion | Path = "handheld"  # or a TUM file of the IMU's poses
    frame_times: Path | None = None  # one integer of nanoseconds a line; None: a fixed rate
    imu: Literal["simulated", "none"] | Path = "simulated"  # or a recorded one, EuRoC's csv
    velocity: VelocityName = "none"  # the paper's body velocity sensor
    rig: RigName = "euroc-rectified"
    width: int | None = None  # px; None: that of the rig
    rate_hz: float = 20.0
    duration_s: float | None = None  # None: 30 s, or all of a recorded trajectory
    conditions: Conditions = field(default_factory=Conditions)
    seed: int = 0


def plan(scenario: Scenario) -> Simulation:
    """Build scene, motion and sensors, and check that the recording can be simulated; nothing is
    rendered yet.

    Raises:
        SimulationError: a value is invalid, or a camera would be outside the scene or in a box.
        DataError: a recorded file cannot be used; the message names it.
    """
    _check(scenario)
    rig = scaled(RIGS[scenario.rig](), scenario.width)
    motion, times, record = (
        _recorded(scenario) if isinstance(scenario.trajectory, Path) else _ready(scenario)
    )
    imu: ImuNoise | ImuRecord | None = record
    if scenario.imu == "simulated":
        imu = scenario.conditions.imu_noise
    velocity = {"none": None, "paper": VelocityNoise(), "exact": VelocityNoise(0.0, 0.0)}[
        scenario.velocity
    ]
    return simulate(
        _world(scenario, motion),
        rig,
        motion,
        rate_hz=scenario.rate_hz,
        frame_times_ns=times,
        imu=imu,
        velocity=velocity,
        effects=scenario.conditions.effects,
        faults=scenario.conditions.faults,
        calibration_errors=scenario.conditions.calibration,
        calibration_sigmas=scenario.conditions.calibration_sigmas,
        seed=scenario.seed,
    )


def _check(scenario: Scenario) -> None:
    faults = scenario.conditions.faults
    if not (0 <= faults.dropped < 1 and 0 <= faults.duplicated < 1):
        raise SimulationError(
            "faults.dropped and faults.duplicated are shares of the frames, from 0 to below 1"
        )
    if scenario.width is not None and not 64 <= scenario.width <= 8192:
        raise SimulationError(
            f"images {scenario.width} px wide cannot be rendered; choose a width from 64 to 8192"
        )
    if not 0 < scenario.rate_hz <= 1000:
        raise SimulationError(
            f"{scenario.rate_hz:g} frames a second cannot be rendered; choose a rate up to 1000"
        )
    if scenario.duration_s is not None and not 0 < scenario.duration_s <= 36000:
        raise SimulationError(
            f"a recording of {scenario.duration_s:g} s cannot be rendered; choose up to 36000 s"
        )
    if scenario.seed < 0:
        raise SimulationError(f"the seed must not be negative, got {scenario.seed}")
    _check_effects(scenario)


def _check_effects(scenario: Scenario) -> None:
    """Raise SimulationError where the scene cannot have the effects that are asked for."""
    hard = scenario.conditions
    if not 0 <= hard.people <= 100:
        raise SimulationError(f"{hard.people} people cannot be placed; choose 0 to 100")
    if scenario.scene == "doors" and any((hard.bare_wall, hard.moving, hard.people, hard.lighting)):
        raise SimulationError("the corridor of equal doors has no effects of a scene; use corridor")


def scaled(rig: StereoRig, width: int | None) -> StereoRig:
    """Return the rig with images of another width and the same field of view; None: unchanged."""
    if width is None or width == rig.cam0.width:
        return rig

    def resized(camera: CameraModel) -> CameraModel:
        factor = width / camera.width
        return replace(
            camera,
            fu=camera.fu * factor,
            fv=camera.fv * factor,
            cu=(camera.cu + 0.5) * factor - 0.5,
            cv=(camera.cv + 0.5) * factor - 0.5,
            width=width,
            height=round(camera.height * factor),
        )

    return replace(rig, cam0=resized(rig.cam0), cam1=resized(rig.cam1))


# --- motion
# --------------------------------------------------------------------------------------------------


def _recorded(scenario: Scenario) -> tuple[MotionSpline, IntArray, ImuRecord | None]:
    assert isinstance(scenario.trajectory, Path)
    csv = scenario.imu if isinstance(scenario.imu, Path) else None
    flight = read_flight(scenario.trajectory, scenario.frame_times, csv)
    motion = flight.motion
    times = flight.frame_times_ns
    if scenario.frame_times is None:
        times = _regular(
            motion.start_ns, (motion.end_ns - motion.start_ns) / NS_PER_S, scenario.rate_hz
        )
    if scenario.duration_s is not None:
        times = times[times < times[0] + round(scenario.duration_s * NS_PER_S)]
    if flight.imu is not None and (
        flight.imu.times_ns[0] > times[0] or flight.imu.times_ns[-1] < times[-1]
    ):
        raise DataError(
            f"{csv} does not span the frames ({times[0]} to {times[-1]} ns, the IMU "
            f"{flight.imu.times_ns[0]} to "
            f"{flight.imu.times_ns[-1]} ns); use files of one flight and one clock"
        )
    return motion, times, flight.imu


def _ready(scenario: Scenario) -> tuple[MotionSpline, IntArray, None]:
    if scenario.frame_times is not None:
        raise SimulationError("frame times need a recorded trajectory; give a rate instead")
    if isinstance(scenario.imu, Path):
        raise SimulationError(
            "a recorded IMU needs its own recorded trajectory; simulate one instead"
        )
    duration_s = 30.0 if scenario.duration_s is None else scenario.duration_s
    # A whole number of frame periods, so that sensors of that rate sample at the frame times.
    before = math.ceil(_SCENE.margin_s * scenario.rate_hz)
    motion = _motion(scenario, duration_s + before / scenario.rate_hz + _SCENE.margin_s)
    if scenario.rig in _EUROC_AXES:
        motion = rotate_body_axes(motion, R_FLU_EUROC_IMU)
    return motion, _regular(motion.start_ns, duration_s, scenario.rate_hz, first=before), None


def _motion(scenario: Scenario, duration_s: float) -> MotionSpline:
    if scenario.trajectory == "car":
        return car_loop(duration_s=duration_s, seed=scenario.seed)
    if scenario.scene in ("corridor", "doors"):
        return _walk(duration_s, scenario.seed)
    if scenario.scene == "street":
        centre = (0.0, -37.8, 1.5)
    else:
        centre = (0.0, 0.0, 1.4)
    return hand_held(centre=centre, duration_s=duration_s, seed=scenario.seed)


def _walk(duration_s: float, seed: int) -> MotionSpline:
    """Walk up and down the corridor, turning near its ends, with hand shake."""
    interval_s = 0.5
    t = np.arange(0.0, duration_s + interval_s, interval_s)
    rng = np.random.default_rng([seed, 13])
    phase = 0.5 + t * (1.2 / 12.5)  # 1.2 m/s in the middle
    x = 15.0 - 12.5 * np.cos(phase)
    y = 0.15 + 0.1 * np.sin(0.7 * t)
    yaw = np.pi / 2 * (1 - np.tanh(4 * np.sin(phase)))
    R = look_rotation(np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(t)], axis=1))
    T = se3_from_parts(R, np.stack([x, y, np.full_like(t, 1.5)], axis=1))
    shake = rng.standard_normal((len(t), 6)) * [0.015, 0.015, 0.015, 0.04, 0.04, 0.08]
    return spline_from_waypoints(T @ se3_exp(shake), interval_s)


def _regular(start_ns: int, duration_s: float, rate_hz: float, *, first: int = 0) -> IntArray:
    count = max(1, int(duration_s * rate_hz + 1e-6))
    return start_ns + np.round(np.arange(first, first + count) * (NS_PER_S / rate_hz)).astype(
        np.int64
    )


# --- scenes
# --------------------------------------------------------------------------------------------------


def _world(scenario: Scenario, motion: MotionSpline) -> World:
    hard = scenario.conditions
    seed = scenario.seed
    walks: tuple[Walk, ...] = ()
    if hard.people:
        reach_m, clearance_m = (6.0, 2.0) if scenario.scene == "street" else (2.0, 0.5)
        free = _scene(scenario, motion, furnished=False)
        walks = plan_walks(
            free, motion, hard.people, seed=seed, reach_m=reach_m, clearance_m=clearance_m
        )
    moving = walking_people(walks, seed=seed)
    if hard.moving:
        moving = (*_moving_boxes(scenario, motion, _scene(scenario, motion)), *moving)
    return _scene(scenario, motion, moving, walks)


def _scene(
    scenario: Scenario,
    motion: MotionSpline,
    moving: Sequence[MovingBox] = (),
    walks: Sequence[Walk] = (),
    *,
    furnished: bool = True,
) -> World:
    """The scene with some boxes moving in it; the furniture of a room stays off the ways of
    people.
    """
    hard = scenario.conditions
    seed = scenario.seed
    if scenario.scene == "street":
        return street(seed, moving=moving, sunlit=hard.lighting, bare_houses=hard.bare_wall)
    if scenario.scene == "doors":
        return equal_doors(seed)
    if scenario.scene == "corridor":
        sides = ("+y", "-y") if hard.bare_wall else ("+y",)
        return corridor(seed, bare_walls=sides, bare_kind=_bare_kind(hard), moving=moving)
    return _room(scenario, motion, moving, walks, furnished=furnished)


def _bare_kind(hard: Conditions) -> TextureKind:
    """Return the texture of a bare wall: in uneven light even a blank one shows something."""
    return "plaster" if hard.lighting else "bare"


def _room(
    scenario: Scenario,
    motion: MotionSpline,
    moving: Sequence[MovingBox],
    walks: Sequence[Walk],
    *,
    furnished: bool,
) -> World:
    """Return the room with boxes moving in it; its furniture stays off the ways of people."""
    hard = scenario.conditions
    seed = scenario.seed
    walls = ("+x", "+y") if hard.bare_wall else ()
    windows = _SCENE.windows if hard.lighting else 0
    inside = functools.partial(
        room, seed, bare_walls=walls, bare_kind=_bare_kind(hard), moving=moving, windows=windows
    )
    recorded = isinstance(scenario.trajectory, Path)
    if recorded:
        around = room_around(motion, seed=seed)
    else:
        around = room(seed)
    if not furnished:
        return inside(bounds=around.bounds, furniture=0, pictures=0)
    if not (walks or recorded):
        return inside()
    if not (walls or moving or windows):
        return around
    times = np.arange(motion.start_ns, motion.end_ns, 100_000_000)
    keep_clear = np.concatenate(
        [motion_at(motion, times).T_world_imu[:, :3, 3], along_walks(walks)]
    )
    return inside(bounds=around.bounds, furniture=20, pictures=20, keep_clear=keep_clear)


def _moving_boxes(scenario: Scenario, motion: MotionSpline, empty: World) -> tuple[MovingBox, ...]:
    if scenario.scene == "street":
        return _traffic(motion, scenario.seed)
    if scenario.scene == "corridor":
        return (
            _oscillating_box(
                np.array([[3.0, 0.95, 1.1], [27.0, 0.95, 1.1]]), motion.start_ns, 25.0
            ),
        )
    return _boxes_along_walls(empty, motion)


def _boxes_along_walls(world: World, motion: MotionSpline) -> tuple[MovingBox, ...]:
    """Boxes that move back and forth along the four walls, clear of all camera trajectories."""
    low = world.bounds[0] + _SCENE.wall_gap_m
    high = world.bounds[1] - _SCENE.wall_gap_m
    z = (world.bounds[0, 2] + world.bounds[1, 2]) / 2
    corners = [
        (low[0], low[1]),
        (high[0], low[1]),
        (high[0], high[1]),
        (low[0], high[1]),
    ]
    lanes = []
    for i in range(4):
        begin = [*corners[i], z]
        end = [*corners[(i + 1) % 4], z]
        lanes.append(np.array([begin, end]))
    return tuple(_oscillating_box(lane, motion.start_ns, 8.0 + i) for i, lane in enumerate(lanes))


def _oscillating_box(lane: FloatArray, start_ns: int, period_s: float) -> MovingBox:
    """A box that oscillates between the two ends (2, 3) of a lane."""

    def pose(time_ns: int) -> FloatArray:
        along = 0.5 - 0.5 * np.cos(2 * np.pi * (time_ns - start_ns) / NS_PER_S / period_s)
        return se3_from_parts(np.eye(3), lane[0] + along * (lane[1] - lane[0]))

    return MovingBox(np.array([0.45, 0.45, 0.6]), pose)


def _traffic(motion: MotionSpline, seed: int) -> tuple[MovingBox, ...]:
    """A car ahead in the same lane, and an oncoming one that circles the inner lane."""
    seconds = (motion.end_ns - motion.start_ns) / NS_PER_S
    ahead = car_loop(
        duration_s=seconds,
        start_m=_SCENE.lead_m,
        height_m=0.85,
        seed=seed,
        start_ns=motion.start_ns,
    )
    inner = car_loop(loop_m=(103.6, 63.6), corner_m=5.0, height_m=0.85, seed=seed + 1)
    loop_ns = inner.end_ns - inner.start_ns

    def leading(time_ns: int) -> FloatArray:
        return motion_at(ahead, int(np.clip(time_ns, ahead.start_ns, ahead.end_ns))).T_world_imu[0]

    def oncoming(time_ns: int) -> FloatArray:
        return motion_at(inner, inner.end_ns - (time_ns - motion.start_ns) % loop_ns).T_world_imu[0]

    size = np.array([4.2, 1.8, 1.5])
    return MovingBox(size, leading, texel_m=0.01), MovingBox(size, oncoming, texel_m=0.01)


# --- rendering in several processes
# ---------------------------------------------------------------------------------


class ParallelRecording(SimulatedRecording, contextlib.AbstractContextManager["ParallelRecording"]):
    """A scenario's recording, rendered ahead by other processes; the images equal those of one
    process to the bit.

    Use it as a context manager, and request frames in order. Every process plans the scenario
    itself, from the same seed.
    """

    def __init__(
        self, scenario: Scenario, *, workers: int, simulation: Simulation | None = None
    ) -> None:
        """Prepare a pool of `workers` processes, started with the first request."""
        super().__init__(plan(scenario) if simulation is None else simulation)
        self._scenario = scenario
        self._workers = workers
        self._pool = ProcessPoolExecutor(
            workers, multiprocessing.get_context("spawn"), start_worker
        )
        self._waiting: dict[int, Future[tuple[Image, Image]]] = {}

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def images(self, index: int) -> tuple[Image, Image]:
        """Return both images (H, W) of one frame with all effects, and schedule the next ones.

        Raises:
            SimulationError: a process ended unexpectedly.
        """
        try:
            for ahead in range(index, min(index + _AHEAD * self._workers, len(self))):
                if ahead not in self._waiting:
                    self._waiting[ahead] = self._pool.submit(_render_pair, self._scenario, ahead)
            return self._waiting.pop(index).result()
        except BrokenProcessPool as error:
            raise SimulationError(
                "a rendering process ended unexpectedly, perhaps for lack of memory; render in one "
                "process"
            ) from error


def default_workers(frames: int) -> int:
    """Default number of processes: one for short recordings, which finish before a second one
    has started.
    """
    if frames >= 100:
        return min(2, os.cpu_count() or 1)
    return 1


@functools.lru_cache(maxsize=1)
def _opened(scenario: Scenario) -> SimulatedRecording:
    return SimulatedRecording(plan(scenario))


def _render_pair(scenario: Scenario, index: int) -> tuple[Image, Image]:
    return _opened(scenario).images(index)


def flight_files(folder: Path) -> tuple[Path, Path | None, Path | None]:
    """Ground truth, image times and IMU of a recorded flight's folder; the latter two where they
    exist.

    Raises:
        DataError: the folder holds no ground truth.
    """
    truth, times, imu = (folder / name for name in FLIGHT_FILES)
    if not truth.is_file():
        raise DataError(
            f"{folder} holds no {FLIGHT_FILES[0]}; give the folder of a recorded flight, or a TUM "
            "file"
        )
    return truth, times if times.is_file() else None, imu if imu.is_file() else None


READY_MOTIONS: tuple[str, ...] = get_args(ReadyMotion)


@dataclass(frozen=True, slots=True)
class _Drive:
    """The recording of a drive along a road."""

    rate_hz: float = 10.0
    start_m: float = 12.0  # the drive then covers a straight, a corner and another straight


_DRIVE = _Drive()
_DURATION_S = 14.0
_WIDTH_PX = 800


def write_demo_recording(out: Path, progress: Progress | None = None) -> Path:
    """Render the demo's recording as a KITTI folder with ground truth, velocities and extrinsics;
    return the folder.

    Raises:
        VioError: the folder cannot be written, or holds foreign files.
    """
    simulation = simulate(
        street(seed=4),
        kitti_like_rig(_WIDTH_PX),
        car_loop(duration_s=_DURATION_S, start_m=_DRIVE.start_m, seed=4),
        rate_hz=_DRIVE.rate_hz,
        velocity=VelocityNoise(),
        effects=SensorEffects(read_noise=1.5, vignetting=0.2),
        seed=4,
    )
    export_kitti(SimulatedRecording(simulation), out, replace=True, progress=progress)
    return out
