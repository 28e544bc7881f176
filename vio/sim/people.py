"""People who walk through a scene: three boxes each, which sway, rise and fall with their steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp
from vio.numerics.kinds import Capacity
from vio.records import NS_PER_S, IntArray
from vio.sim.motion import MotionSpline, motion_at
from vio.sim.world import MovingBox, ObjectMotion, Solid, World


@dataclass(frozen=True, slots=True)
class _PeopleRules:
    """How people look and walk."""

    steps_per_s: float = 1.8
    pause_s: float = 1.2  # at each end of the way, in which the person turns round
    sway_m: float = 0.03
    bob_m: float = 0.025
    twist_rad: float = 0.08
    lean_rad: float = 0.03
    radius_m: float = 0.3  # of the space that a person takes
    height_m: float = 1.8
    spacing_ns: int = 50_000_000  # between the times at which camera and person are kept apart
    coarse: Capacity[int] = 20  # of these times one is tried first
    attempts: Capacity[int] = 300  # for each person
    keep_clear_m: float = 0.3  # height of the points on a way that keep furniture off


_PEOPLE = _PeopleRules()


@dataclass(frozen=True, slots=True)
class Walk:
    """A person's way to and fro along a straight line."""

    start: FloatArray  # (3,) world, m, on the ground
    end: FloatArray  # (3,)
    speed: float  # m/s
    phase_s: float  # time since the start of the way at `origin_ns`
    origin_ns: int


def plan_walks(
    world: World, motion: MotionSpline, count: int, *, seed: int, reach_m: float, clearance_m: float
) -> tuple[Walk, ...]:
    """Return ways that cross a camera's surroundings and never touch a box or come close to the
    camera.

    Args:
        world: the scene; its boxes are walked around.
        motion: motion of the cameras' body.
        count: people wanted; fewer where there is no room for them.
        seed: seed of all random numbers.
        reach_m: standard deviation of the ways' middles about the path.
        clearance_m: least distance from the camera.
    """
    rng = np.random.default_rng([seed, 6])
    times: IntArray = np.arange(motion.start_ns, motion.end_ns, _PEOPLE.spacing_ns, dtype=np.int64)
    path = motion_at(motion, times).T_world_imu[:, :3, 3]
    walks: list[Walk] = []
    for _ in range(count):
        for _ in range(_PEOPLE.attempts):
            walk = _random_walk(world, path, rng, reach_m, motion.start_ns)
            # A few of the times show at once that most ways will not do.
            if _unobstructed(world, walk) and all(
                _clearance(walk, times[::step], path[::step]) > clearance_m
                for step in (_PEOPLE.coarse, 1)
            ):
                walks.append(walk)
                break
    return tuple(walks)


def along_walks(walks: Sequence[Walk]) -> FloatArray:
    """Return points (N, 3) along the ways, a little above the ground, from which furniture is to
    stay away.
    """
    shares = np.linspace(0, 1, 12)[:, None]
    points = [
        walk.start + shares * (walk.end - walk.start) + [0.0, 0.0, _PEOPLE.keep_clear_m]
        for walk in walks
    ]
    if points:
        return np.concatenate(points)
    return np.zeros((0, 3))


def walking_people(walks: Sequence[Walk], *, seed: int) -> tuple[MovingBox, ...]:
    """Return the boxes of people on their ways, three for each of them."""
    rng = np.random.default_rng([seed, 7])
    return tuple(box for walk in walks for box in _body(walk, rng))


def _random_walk(
    world: World, path: FloatArray, rng: np.random.Generator, reach_m: float, origin_ns: int
) -> Walk:
    near = path[rng.integers(len(path))]
    middle = np.array([*(near[:2] + reach_m * rng.standard_normal(2)), world.bounds[0, 2]])
    angle = rng.uniform(0, 2 * np.pi)
    half = rng.uniform(0.8, 2.0) * max(1.0, reach_m / 2)
    along = half * np.array([np.cos(angle), np.sin(angle), 0.0])
    return Walk(
        middle - along, middle + along, rng.uniform(0.9, 1.5), rng.uniform(0.0, 10.0), origin_ns
    )


def _unobstructed(world: World, walk: Walk) -> bool:
    """Whether the way is within the scene and clear of its boxes."""
    points = walk.start + np.linspace(0, 1, 30)[:, None] * (walk.end - walk.start)
    low = world.bounds[0, :2] + _PEOPLE.radius_m
    high = world.bounds[1, :2] - _PEOPLE.radius_m
    if ((points[:, :2] < low) | (points[:, :2] > high)).any():
        return False
    return all(_apart(solid, points) for solid in world.solids)


def _apart(solid: Solid, points: FloatArray) -> bool:
    """Whether people at points (N, 3) on the ground stay off a box."""
    T = solid.T_world_box
    half = solid.half_size
    if T[2, 3] - half[2] > points[0, 2] + _PEOPLE.height_m:
        return True
    local = (points - T[:3, 3]) @ T[:3, :3]
    outside = np.abs(local[:, :2]) > half[:2] + _PEOPLE.radius_m
    return bool(outside.any(axis=1).all())


def _clearance(walk: Walk, times: IntArray, path: FloatArray) -> float:
    """Least distance (m) of a camera at positions (N, 3) at times (N,) from a person."""
    at = np.array([_place(walk, int(t))[0] for t in times])
    distance_m = np.linalg.norm(path[:, :2] - at[:, :2], axis=1)
    aside = np.maximum(distance_m - _PEOPLE.radius_m, 0.0)
    above = np.maximum(path[:, 2] - at[:, 2] - _PEOPLE.height_m, 0.0)
    return float(np.hypot(aside, above).min())


def _place(walk: Walk, time_ns: int) -> tuple[FloatArray, float, float]:
    """Position (3,) on the ground, heading in radians, and whether the person walks (1) or turns
    (0).
    """
    way = walk.end - walk.start
    length = float(np.linalg.norm(way))
    leg_s = length / walk.speed + _PEOPLE.pause_s
    elapsed = (time_ns - walk.origin_ns) / NS_PER_S + walk.phase_s
    leg, within = divmod(elapsed, leg_s)
    forth = leg % 2 == 0
    share = min(within * walk.speed / length, 1.0)
    walking = share < 1.0
    if walking:
        turned = 0.0
    else:
        turned = (within - length / walk.speed) / _PEOPLE.pause_s * np.pi
    heading = float(np.arctan2(way[1], way[0])) + (0.0 if forth else np.pi) + turned
    return walk.start + way * (share if forth else 1 - share), heading, float(walking)


def _body(walk: Walk, rng: np.random.Generator) -> Sequence[MovingBox]:
    """Legs, trunk and head of one person."""
    scale = rng.uniform(0.92, 1.06)

    def part(height: float) -> ObjectMotion:
        return lambda time_ns: (
            _step(walk, time_ns) @ se3_from_parts(np.eye(3), [0.0, 0.0, height * scale])
        )

    def size(depth: float, width: float, height: float) -> FloatArray:
        return scale * np.array([depth, width, height])

    return (
        MovingBox(size(0.24, 0.36, 0.84), part(0.42), "clothes"),
        MovingBox(size(0.26, 0.48, 0.66), part(1.17), "clothes"),
        MovingBox(size(0.20, 0.17, 0.25), part(1.65), "skin"),
    )


def _step(walk: Walk, time_ns: int) -> FloatArray:
    """Pose (4, 4) of a person's middle line on the ground."""
    ground, heading, walking = _place(walk, time_ns)
    step = np.pi * _PEOPLE.steps_per_s * (time_ns - walk.origin_ns) / NS_PER_S
    swing = walking * float(np.sin(step))  # from foot to foot, so once in two steps
    left = np.array([-np.sin(heading), np.cos(heading), 0.0])
    at = (
        ground
        + _PEOPLE.sway_m * swing * left
        + np.array([0.0, 0.0, _PEOPLE.bob_m * walking * abs(float(np.cos(step)))])
    )
    turn = so3_exp([0.0, 0.0, heading + _PEOPLE.twist_rad * swing]) @ so3_exp(
        [_PEOPLE.lean_rad * swing, 0.0, 0.0]
    )
    return se3_from_parts(turn, at)
