"""Seeded scenes of textured rectangles and boxes: a room, a street around a block, a corridor with
a bare wall.

World frame: z up, metres. A surface is a rectangle seen from its front: s runs right, t down, both
in metres from the upper left corner (`origin`). Surfaces are one-sided; boxes are visible from
outside.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.errors import SimulationError
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp
from vio.records import IntArray
from vio.sim.lighting import Light, Lighting, illumination, sun, window
from vio.sim.textures import MipTexture, TextureKind, build_mips, lit, paint

SceneName: TypeAlias = Literal["room", "street", "corridor", "doors"]
ObjectMotion: TypeAlias = Callable[[int], FloatArray]  # time_ns to T_world_object (4, 4)

_OF_WOOD: tuple[TextureKind, ...] = ("wood", "crate")


@dataclass(frozen=True, slots=True)
class _WorldRules:
    """How rooms and streets are built."""

    clear_m: float = 0.05  # of a camera from what it may not be in
    doors: int = 10  # of a corridor of equal doors, and from one to the next
    door_m: float = 3.0
    street_m: float = 15.0  # width
    parked: int = 36  # boxes
    onward_m: float = 80.0  # length of the streets beyond the block
    corner_free_m: float = 13.0  # no parked box this close to a corner, which cars cut
    mover_light: float = 0.7  # illumination of moving boxes, which is the same wherever they are
    # at which illumination is computed; also the width of a shadow's soft edge
    light_cell_m: float = 0.25
    max_light_cells: int = 400  # along each side of a surface
    room_ambient: float = 0.22
    street_ambient: float = 0.4
    sun_elevation_rad: float = 0.3
    bare_houses: int = 3  # one house in so many has a blank wall


_WORLD = _WorldRules()
_CORRIDOR_M = np.array([30.0, 2.6, 2.7])  # length, width, height
# Radiance over the texture's own gray levels, of what is bright by itself: nine stops of a room's
# light and a window do not fit one exposure, and a bright sky is about a stop above sunlit walls.
_EMISSION: dict[TextureKind, float] = {"window": 7.0, "sky": 1.5, "skyline": 1.3}
_FACES: dict[str, tuple[int, int]] = {
    "+x": (0, 1), "-x": (0, -1), "+y": (1, 1), "-y": (1, -1), "+z": (2, 1), "-z": (2, -1),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Patch:
    """One textured rectangle of an object."""

    origin: FloatArray  # (3,) upper left corner, object frame, m
    axis_s: FloatArray  # (3,) unit, right as seen from the front
    axis_t: FloatArray  # (3,) unit, down as seen from the front
    size: FloatArray  # (2,) m along s and t
    kind: TextureKind
    texel_m: float
    # patches with equal numbers look the same; None: this one looks like no other
    twins: int | None = None


@dataclass(frozen=True, slots=True)
class Solid:
    """A box that no camera may be in."""

    T_world_box: FloatArray  # (4, 4) to the centre
    half_size: FloatArray  # (3,) m


@dataclass(frozen=True, slots=True)
class MovingBox:
    """A textured box that moves on its own."""

    size: FloatArray  # (3,) m
    motion: ObjectMotion  # pose of its centre over time
    kind: TextureKind = "crate"
    texel_m: float = 0.004


@dataclass(frozen=True, slots=True)
class Surfaces:
    """All rectangles of a world at one time, as arrays."""

    origin: FloatArray  # (S, 3) world, m
    axis_s: FloatArray  # (S, 3)
    axis_t: FloatArray  # (S, 3)
    size: FloatArray  # (S, 2) m
    mover: IntArray  # (S,) 0: the fixed scene; k: the k-th moving box, from 1

    @property
    def normal(self) -> FloatArray:
        """Unit normals (S, 3) towards the side from which the rectangle is seen."""
        return np.cross(self.axis_t, self.axis_s)


class TextureStore:
    """The textures of a world, each painted from its own seed on first use."""

    def __init__(
        self,
        patches: Sequence[Patch],
        seed: int,
        lighting: Lighting | None = None,
        movers: Sequence[int] = (),
    ) -> None:
        """Store what to paint; `lighting` shades it, alike all over surfaces that move (`movers`
        > 0).
        """
        self._patches = tuple(patches)
        self._seed = seed
        self._lighting = lighting
        self._movers = tuple(movers)
        self._painted: dict[int, MipTexture] = {}
        self._lock = threading.Lock()

    def __getitem__(self, surface: int) -> MipTexture:
        with self._lock:
            if surface not in self._painted:
                twins = self._patches[surface].twins
                twin = surface
                if twins is not None:
                    twin = next(k for k, other in enumerate(self._patches) if other.twins == twins)
                if twin not in self._painted:
                    self._painted[twin] = self._paint(twin)
                self._painted[surface] = self._painted[twin]
            return self._painted[surface]

    def _paint(self, surface: int) -> MipTexture:
        patch = self._patches[surface]
        texture = paint(
            patch.kind, patch.size, patch.texel_m, np.random.default_rng([self._seed, surface])
        )
        if self._lighting is None:
            return build_mips(texture)
        if patch.kind in _EMISSION or self._movers[surface]:
            return replace(build_mips(texture), gain=_EMISSION.get(patch.kind, _WORLD.mover_light))
        light = _light_on(patch, self._lighting)
        shaded, gain = lit(texture, light, np.random.default_rng([self._seed, surface, 1]))
        return replace(build_mips(shaded), gain=gain)


def _light_on(patch: Patch, lighting: Lighting) -> FloatArray:
    """Illumination (R, C) at the middles of a grid of cells over a fixed surface."""
    columns, rows = np.clip(
        np.ceil(patch.size / _WORLD.light_cell_m), 2, _WORLD.max_light_cells
    ).astype(int)
    s, t = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    along = (
        s.reshape(-1, 1) * patch.size[0] * patch.axis_s
        + t.reshape(-1, 1) * patch.size[1] * patch.axis_t
    )
    return illumination(
        lighting, patch.origin + along, np.cross(patch.axis_t, patch.axis_s)
    ).reshape(rows, columns)


@dataclass(frozen=True, slots=True)
class World:
    """A scene: its surfaces, their textures, and the space free for cameras."""

    name: str
    surfaces: Surfaces  # moving boxes in their own frames; `surfaces_at` places them
    textures: TextureStore
    solids: tuple[Solid, ...]
    bounds: FloatArray  # (2, 3) lower and upper corner of the space a camera may be in, m
    movers: tuple[MovingBox, ...] = ()
    lights: tuple[Light, ...] = ()  # that a lens may flare from; none without lighting


def surfaces_at(world: World, time_ns: int) -> Surfaces:
    """Return all surfaces at their poses of one time."""
    if not world.movers:
        return world.surfaces
    fixed = world.surfaces
    origin = fixed.origin.copy()
    axis_s = fixed.axis_s.copy()
    axis_t = fixed.axis_t.copy()
    for number, box in enumerate(world.movers, start=1):
        mine = fixed.mover == number
        T = box.motion(time_ns)
        origin[mine] = fixed.origin[mine] @ T[:3, :3].T + T[:3, 3]
        axis_s[mine] = fixed.axis_s[mine] @ T[:3, :3].T
        axis_t[mine] = fixed.axis_t[mine] @ T[:3, :3].T
    return replace(fixed, origin=origin, axis_s=axis_s, axis_t=axis_t)


def check_clear(world: World, positions: npt.ArrayLike, what: str = "the camera") -> None:
    """Check that positions (N, 3) are inside the scene and in no box.

    Raises:
        SimulationError: a position is not; the message names the first one.
    """
    p = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    low = world.bounds[0] + _WORLD.clear_m
    high = world.bounds[1] - _WORLD.clear_m
    outside = ((p < low) | (p > high)).any(axis=1) | ~np.isfinite(p).all(1)
    if outside.any():
        i = int(np.flatnonzero(outside)[0])
        raise SimulationError(
            f"{what} leaves the {world.name} at position {i} of {len(p)}, ({_metres(p[i])}) m; it "
            f"spans ({_metres(world.bounds[0])}) to ({_metres(world.bounds[1])}) m: "
            "choose a larger scene, such as street, or another trajectory"
        )
    for number, solid in enumerate(world.solids):
        local = (p - solid.T_world_box[:3, 3]) @ solid.T_world_box[:3, :3]
        inside = (np.abs(local) < solid.half_size + _WORLD.clear_m).all(axis=1)
        if inside.any():
            i = int(np.flatnonzero(inside)[0])
            raise SimulationError(
                f"{what} is inside box {number} of the {world.name} at position {i} of {len(p)}, "
                f"({_metres(p[i])}) m; "
                "choose another seed or trajectory, or pass the positions as keep_clear"
            )


def _metres(p: FloatArray) -> str:
    return ", ".join(f"{x:.2f}" for x in p)


def room(
    seed: int = 0,
    *,
    bounds: npt.ArrayLike = ((-4.0, -3.0, 0.0), (4.0, 3.0, 2.8)),
    furniture: int = 12,
    pictures: int = 10,
    keep_clear: npt.ArrayLike | None = None,
    bare_walls: tuple[str, ...] = (),
    moving: Sequence[MovingBox] = (),
    windows: int = 0,
    bare_kind: TextureKind = "bare",
    texel_m: float | None = None,
) -> World:
    """Build an indoor room with furniture boxes on the floor and framed pictures on the walls.

    Args:
        seed: seed of all random numbers.
        bounds: lower and upper corner (2, 3) of the room, metres.
        furniture: boxes to place; fewer where there is no space.
        pictures: thin boxes on the walls.
        keep_clear: positions (N, 3) from which furniture stays 0.6 m away; None keeps the middle of
            the room free.
        bare_walls: sides without texture, of "+x" "-x" "+y" "-y".
        moving: boxes that move.
        bare_kind: texture of the bare walls; "plaster" has a few marks.
        windows: bright windows, each on a wall of its own (up to 4), which light the room; 0: even
            light everywhere.
        texel_m: texture resolution; None chooses 2.5 mm, coarser in halls.
    """
    box = _bounds(bounds)
    rng = np.random.default_rng([seed, 1])
    texel = (
        texel_m
        if texel_m is not None
        else max(0.0025, 0.0025 * float(np.prod(box[1, :2] - box[0, :2]) / 60) ** 0.5)
    )
    patches = _shell(box, bare_walls, texel, bare_kind)
    clear = (
        _default_clear(box)
        if keep_clear is None
        else np.asarray(keep_clear, dtype=np.float64).reshape(-1, 3)
    )
    solids: list[Solid] = []
    scale = float(np.clip((box[1, 2] - box[0, 2]) / 2.8, 0.7, 2.5))
    for _ in range(furniture):
        solid = _place_furniture(box, clear, solids, rng, scale)
        if solid is not None:
            solids.append(solid)
            patches += _box_patches(solid, _OF_WOOD[rng.choice(2)], texel, hidden=("-z",))
            top = _stack(solid, rng, scale)
            if top is not None and _is_clear(top, clear, 0.6):
                solids.append(top)
                patches += _box_patches(top, "crate", texel, hidden=("-z",))
    for _ in range(pictures):
        picture = _hang_picture(box, rng, scale, bare_walls)
        if picture is not None and _is_clear(picture, clear, 0.3):
            patches += _box_patches(picture, "picture", texel)
            solids.append(picture)
    lights, panes = _windows(box, windows, seed, scale)
    lighting = Lighting(lights, _WORLD.room_ambient) if lights else None
    return _build("room", patches + panes, solids, box, seed, moving, lighting)


def _windows(
    box: FloatArray, count: int, seed: int, scale: float
) -> tuple[tuple[Light, ...], list[Patch]]:
    """Windows on different walls of a room: their lights and their panes."""
    rng = np.random.default_rng([seed, 4])
    lights = []
    panes = []
    # Illumination 0.9 at half the width of a square room of that area, from each of them.
    power = 0.9 * float(np.prod(box[1, :2] - box[0, :2])) / 4
    for face in rng.permutation(["+x", "-x", "+y", "-y"])[:count]:
        axis, sign = _FACES[str(face)]
        normal = np.zeros(3)
        up = np.array([0.0, 0.0, 1.0])
        normal[axis] = -sign
        wall = (box[1] - box[0])[[1 - axis, 2]]
        size = np.minimum(np.array([1.9, 1.3]) * scale, 0.6 * wall)
        middle = box[0] + (box[1] - box[0]) * np.array(
            [*rng.uniform(0.3, 0.7, 2), rng.uniform(0.5, 0.62)]
        )
        middle[axis] = box[1 if sign > 0 else 0, axis] - sign * 0.05  # in front of pictures
        pane = _rectangle(middle, normal, -up, size, "window", 0.005)
        half = np.stack([pane.axis_s * size[0], pane.axis_t * size[1]]) / 2
        lights.append(window(middle, normal, half, power=power, radiance=235 * _EMISSION["window"]))
        panes.append(pane)
    return tuple(lights), panes


def corridor(
    seed: int = 0,
    *,
    bare_walls: tuple[str, ...] = ("+y",),
    bare_kind: TextureKind = "bare",
    moving: Sequence[MovingBox] = (),
    texel_m: float = 0.003,
) -> World:
    """Build a corridor along x whose left wall (`bare_walls`) is bare, with cupboards along the
    right one.
    """
    length_m, width_m, height_m = _CORRIDOR_M
    box = np.array(
        [
            [0.0, -width_m / 2, 0.0],
            [length_m, width_m / 2, height_m],
        ]
    )
    rng = np.random.default_rng([seed, 2])
    patches = _shell(box, bare_walls, texel_m, bare_kind)
    solids: list[Solid] = []
    x = rng.uniform(2.0, 4.0)
    while x < length_m - 2:
        size = rng.uniform((0.5, 0.25, 0.6), (1.2, 0.4, 1.9))
        at_wall = -width_m / 2 + size[1] / 2
        solid = Solid(_pose((x, at_wall, size[2] / 2), 0.0), size / 2)
        solids.append(solid)
        patches += _box_patches(solid, _OF_WOOD[rng.choice(2)], texel_m, hidden=("-z",))
        x += rng.uniform(2.0, 4.5)
    for _ in range(int(length_m / 2.5)):
        picture = _hang_picture(box, rng, 0.8, bare_walls)
        if picture is not None:
            patches += _box_patches(picture, "picture", texel_m)
            solids.append(picture)
    return _build("corridor", patches, solids, box, seed, moving)


def equal_doors(seed: int = 0, *, texel_m: float = 0.003) -> World:
    """Build a corridor along x that repeats to the texel from door to door: walls, floor, ceiling,
    doors, pictures.

    Only its two end walls differ. Whoever recognises places by their looks alone takes one door for
    another.
    """
    _, width_m, height_m = _CORRIDOR_M
    box = np.array(
        [
            [0.0, -width_m / 2, 0.0],
            [_WORLD.doors * _WORLD.door_m, width_m / 2, height_m],
        ]
    )
    ends: dict[str, TextureKind] = {"+x": "wall", "-x": "wall"}
    centre = _pose((box[0] + box[1]) / 2, 0.0)
    patches = _axis_rectangles(centre, (box[1] - box[0]) / 2, ends, texel_m, inwards=True)
    kinds: dict[str, TextureKind] = {"+y": "wall", "-y": "wall", "-z": "floor", "+z": "ceiling"}
    half = np.array([_WORLD.door_m, width_m, height_m]) / 2
    rng = np.random.default_rng([seed, 4])
    places = [
        (side * (width_m / 2 - 0.02), rng.uniform(0.5, _WORLD.door_m - 0.5))
        for side in (-1, 1)
        for _ in range(2)
    ]
    solids: list[Solid] = []
    for number in range(_WORLD.doors):
        middle = np.array([(number + 0.5) * _WORLD.door_m, 0.0, height_m / 2])
        cell = _axis_rectangles(_pose(middle, 0.0), half, kinds, texel_m, inwards=True)
        half_size = np.array([0.45, 0.03, 1.0])
        door = Solid(_pose((middle[0], -width_m / 2 + 0.03, 1.0), 0.0), half_size)
        solids.append(door)
        cell += _box_patches(door, "wood", texel_m, hidden=("-z",))
        for y, along in places:
            picture = Solid(
                _pose((number * _WORLD.door_m + along, y, 1.6), 0.0), np.array([0.3, 0.02, 0.25])
            )
            solids.append(picture)
            cell += _box_patches(picture, "picture", texel_m)
        patches += [replace(patch, twins=k) for k, patch in enumerate(cell)]
    return _build("doors", patches, solids, box, seed, ())


def street(
    seed: int = 0,
    *,
    loop_m: tuple[float, float] = (110.0, 70.0),
    moving: Sequence[MovingBox] = (),
    sunlit: bool = False,
    bare_houses: bool = False,
    texel_m: float = 0.015,
) -> World:
    """Build a street around a block of houses, with facades at both sides, parked boxes, poles, a
    distant skyline.

    The middle of the street is a rectangle of `loop_m` (along x, along y) about the origin, so a
    car loop along it is about twice their sum long. `sunlit`: a low sun shines, with hard shadows,
    instead of even light; `bare_houses`: the facades of every third house are blank.
    """
    rng = np.random.default_rng([seed, 3])
    half = np.array(loop_m) / 2
    if min(loop_m) < 2.5 * _WORLD.street_m:
        raise SimulationError(
            f"a street {_WORLD.street_m:g} m wide needs loop_m of at least {2.5 * _WORLD.street_m:g} m each way"
        )
    inner = half - _WORLD.street_m / 2
    outer = half + _WORLD.street_m / 2
    patches: list[Patch] = []
    solids: list[Solid] = []
    houses = [*_house_row(inner, rng, outwards=True), *_house_row(outer, rng, outwards=False)]
    for number, (solid, back) in enumerate(houses):
        solids.append(solid)
        onward = bool(abs(solid.T_world_box[0, 3]) > outer[0] + 10)
        kind: TextureKind = (
            "plaster" if bare_houses and number % _WORLD.bare_houses == 0 else "facade"
        )
        patches += _box_patches(
            solid, kind, (2 if onward else 1) * texel_m, hidden=("-z", "+z", back)
        )
    patches += _road(inner, outer, 0.8 * texel_m)
    for solid in _roadside(half, rng):
        solids.append(solid)
        patches += _box_patches(solid, "crate", 0.6 * texel_m, hidden=("-z",))
    reach = float(max(outer)) + 250.0
    patches += _far_box(reach)
    bounds = np.array(
        [
            [-outer[0], -outer[1], 0.0],
            [outer[0], outer[1], 40.0],
        ]
    )
    lighting = _sunlight(solids, seed) if sunlit else None
    solids.append(
        Solid(_pose((0.0, 0.0, 10.0), 0.0), np.array([inner[0] - 3.0, inner[1] - 3.0, 10.0]))
    )
    return _build("street", patches, solids, bounds, seed, moving, lighting)


def _sunlight(casters: Sequence[Solid], seed: int) -> Lighting:
    """A low sun along the longer streets, half into the driver's face, and the shadows of all
    boxes.
    """
    azimuth = np.random.default_rng([seed, 5]).choice([0.0, np.pi]) + 0.25
    light = sun(float(azimuth), _WORLD.sun_elevation_rad, power=1.1, radiance=60_000.0)
    poses = np.stack([s.T_world_box for s in casters])
    halves = np.stack([s.half_size for s in casters])
    return Lighting((light,), _WORLD.street_ambient, poses, halves)


def _bounds(bounds: npt.ArrayLike) -> FloatArray:
    box = np.asarray(bounds, dtype=np.float64)
    has_form = box.shape == (2, 3)
    if not has_form or not np.all(np.isfinite(box)) or np.any(box[1] - box[0] < 0.5):
        raise SimulationError(
            "scene bounds must be a lower and an upper corner (2, 3) at least 0.5 m apart each way"
        )
    return box


def _build(
    name: str,
    patches: list[Patch],
    solids: list[Solid],
    bounds: FloatArray,
    seed: int,
    moving: Sequence[MovingBox],
    lighting: Lighting | None = None,
) -> World:
    mover = [0] * len(patches)
    every = list(patches)
    for number, box in enumerate(moving, start=1):
        faces = _box_patches(Solid(np.eye(4), np.asarray(box.size) / 2), box.kind, box.texel_m)
        every += faces
        mover += [number] * len(faces)
    surfaces = Surfaces(
        np.array([p.origin for p in every]),
        np.array([p.axis_s for p in every]),
        np.array([p.axis_t for p in every]),
        np.array([p.size for p in every]),
        np.array(mover, dtype=np.int64),
    )
    store = TextureStore(every, seed, lighting, mover)
    lights = () if lighting is None else lighting.lights
    return World(name, surfaces, store, tuple(solids), bounds, tuple(moving), lights)


def _pose(centre: npt.ArrayLike, yaw: float) -> FloatArray:
    return se3_from_parts(so3_exp([0.0, 0.0, yaw]), centre)


def _rectangle(
    centre: FloatArray,
    normal: FloatArray,
    down: FloatArray,
    size: FloatArray,
    kind: TextureKind,
    texel_m: float,
) -> Patch:
    """Return the rectangle with the given middle, seen against `normal` with `down` pointing
    down.
    """
    right = np.cross(normal, down)
    origin = centre - right * size[0] / 2 - down * size[1] / 2
    return Patch(origin, right, down, np.asarray(size, dtype=np.float64), kind, texel_m)


def _axis_rectangles(
    T: FloatArray, half: FloatArray, kinds: dict[str, TextureKind], texel_m: float, *, inwards: bool
) -> list[Patch]:
    """Faces of a box, seen from inside or from outside."""
    out = []
    for face, kind in kinds.items():
        axis, sign = _FACES[face]
        side = np.zeros(3)
        side[axis] = sign
        if axis == 2:
            down = np.array([0.0, -1.0, 0.0])
        else:
            down = np.array([0.0, 0.0, -1.0])
        across = 1 - axis if axis != 2 else 0
        size = 2 * np.array([half[across], half[1] if axis == 2 else half[2]])
        patch = _rectangle(side * half[axis], -side if inwards else side, down, size, kind, texel_m)
        R = T[:3, :3]
        t = T[:3, 3]
        out.append(
            replace(
                patch, origin=R @ patch.origin + t, axis_s=R @ patch.axis_s, axis_t=R @ patch.axis_t
            )
        )
    return out


def _box_patches(
    solid: Solid, kind: TextureKind, texel_m: float, *, hidden: tuple[str, ...] = ()
) -> list[Patch]:
    kinds = {face: kind for face in _FACES if face not in hidden}
    return _axis_rectangles(solid.T_world_box, solid.half_size, kinds, texel_m, inwards=False)


def _shell(
    box: FloatArray, bare_walls: tuple[str, ...], texel_m: float, bare: TextureKind
) -> list[Patch]:
    unknown = set(bare_walls) - set(_FACES)
    if unknown:
        raise SimulationError(f"unknown walls {sorted(unknown)}; use some of {', '.join(_FACES)}")
    kinds: dict[str, TextureKind] = dict.fromkeys(("+x", "-x", "+y", "-y"), "wall")
    kinds |= {"-z": "floor", "+z": "ceiling"}
    kinds |= dict.fromkeys(bare_walls, bare)
    return _axis_rectangles(
        _pose((box[0] + box[1]) / 2, 0.0), (box[1] - box[0]) / 2, kinds, texel_m, inwards=True
    )


def _default_clear(box: FloatArray) -> FloatArray:
    """An ellipse of positions at mid height that leaves the border of the room to furniture."""
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    middle = (box[0] + box[1]) / 2
    half = (box[1] - box[0]) / 2
    along = np.cos(angle) * half[0]
    across = np.sin(angle) * half[1]
    ring = np.stack([along, across, 0 * angle], axis=1)
    return np.concatenate([middle + ring * radius for radius in (0.0, 0.2, 0.4, 0.55)])


def _is_clear(solid: Solid, positions: FloatArray, distance_m: float) -> bool:
    local = (positions - solid.T_world_box[:3, 3]) @ solid.T_world_box[:3, :3]
    gap = np.linalg.norm(np.maximum(np.abs(local) - solid.half_size, 0.0), axis=1)
    return bool(gap.min(initial=np.inf) > distance_m)


def _overlaps(a: Solid, others: Sequence[Solid]) -> bool:
    """Whether bounding circles on the floor intersect."""
    radius = float(np.linalg.norm(a.half_size[:2]))
    return any(
        np.linalg.norm(a.T_world_box[:2, 3] - b.T_world_box[:2, 3])
        < 0.8 * (radius + np.linalg.norm(b.half_size[:2]))
        for b in others
    )


def _place_furniture(
    box: FloatArray,
    clear: FloatArray,
    solids: Sequence[Solid],
    rng: np.random.Generator,
    scale: float,
) -> Solid | None:
    """Find a free place on the floor; None after many attempts."""
    for _ in range(60):
        size = rng.uniform((0.35, 0.35, 0.35), (1.1, 0.9, 1.5)) * scale
        size = np.minimum(size, 0.6 * (box[1] - box[0]))
        reach = np.linalg.norm(size[:2]) / 2 + 0.02
        if np.any(box[1, :2] - box[0, :2] < 2 * reach):
            continue
        xy = rng.uniform(box[0, :2] + reach, box[1, :2] - reach)
        middle_z = box[0, 2] + size[2] / 2
        yaw = rng.uniform(-np.pi, np.pi)
        solid = Solid(_pose((*xy, middle_z), yaw), size / 2)
        if _is_clear(solid, clear, 0.6) and not _overlaps(solid, solids):
            return solid
    return None


def _stack(below: Solid, rng: np.random.Generator, scale: float) -> Solid | None:
    """Put a smaller box on top, half of the time."""
    if rng.random() < 0.5 or below.half_size[2] > 0.55 * scale:
        return None
    size = 2 * below.half_size * rng.uniform((0.4, 0.4, 0.4), (0.75, 0.75, 0.9))
    above_m = below.half_size[2] + size[2] / 2
    centre = below.T_world_box[:3, 3] + np.array([0, 0, above_m])
    yaw_below = np.arctan2(below.T_world_box[1, 0], below.T_world_box[0, 0])
    yaw = yaw_below + rng.uniform(-0.4, 0.4)
    return Solid(_pose(centre, yaw), size / 2)


def _hang_picture(
    box: FloatArray, rng: np.random.Generator, scale: float, bare_walls: tuple[str, ...]
) -> Solid | None:
    """Hang a thin framed box on a wall that has texture; None where it would not fit."""
    walls = [face for face in ("+x", "-x", "+y", "-y") if face not in bare_walls]
    if not walls:
        return None
    axis, sign = _FACES[walls[int(rng.integers(len(walls)))]]
    along = 1 - axis
    width = rng.uniform(0.4, 1.1) * scale
    height = rng.uniform(0.4, 0.9) * scale
    thick = 0.04
    low = box[0] + 0.15
    high = box[1] - 0.15
    if high[along] - low[along] < width or high[2] - low[2] < height:
        return None
    centre = np.zeros(3)
    centre[along] = rng.uniform(low[along] + width / 2, high[along] - width / 2)
    centre[2] = rng.uniform(low[2] + height / 2, high[2] - height / 2)
    if sign > 0:
        centre[axis] = box[1, axis] - thick / 2
    else:
        centre[axis] = box[0, axis] + thick / 2
    half = np.zeros(3)
    half[axis] = thick / 2
    half[along] = width / 2
    half[2] = height / 2
    return Solid(_pose(centre, 0.0), half)


def _house_row(
    rim: FloatArray, rng: np.random.Generator, *, outwards: bool
) -> list[tuple[Solid, str]]:
    """Houses along a rectangle of half size `rim`, each with its hidden face: inside it facing
    out, or around it.
    """
    houses = []
    depth = 8.0
    for axis in (0, 1):
        for sign in (-1, 1):
            # The streets along x continue beyond the block, towards the skyline.
            extent = (
                rim[axis]
                if outwards
                else (rim[0] + _WORLD.onward_m if axis == 0 else rim[1] - _WORLD.street_m)
            )
            x = -extent
            while x < extent - 3:
                width = min(rng.uniform(9.0, 18.0), extent - x)
                if extent - x - width < 5:
                    width = extent - x
                height = rng.uniform(7.0, 16.0)
                setback = rng.uniform(0.1, 1.2)
                across = rim[1 - axis] + (
                    -(setback + depth / 2) if outwards else setback + depth / 2
                )
                centre = np.zeros(3)
                half = np.zeros(3)
                centre[axis] = x + width / 2
                centre[1 - axis] = sign * across
                centre[2] = height / 2
                half[axis] = width / 2
                half[1 - axis] = depth / 2
                half[2] = height / 2
                back = ("-" if (sign > 0) == outwards else "+") + "xy"[1 - axis]
                houses.append((Solid(_pose(centre, 0.0), half), back))
                x += width + (rng.uniform(1.5, 5.0) if rng.random() < 0.3 else 0.0)
    return houses


def _road(inner: FloatArray, outer: FloatArray, texel_m: float) -> list[Patch]:
    """Four strips around the block, extending under the facades, above one coarse ground plane."""
    low = inner - 2.0
    high = outer + 2.0
    up = np.array([0.0, 0.0, 1.0])
    down = np.array([0.0, -1.0, 0.0])
    out = []
    for sign in (-1, 1):
        x = sign * (low[0] + high[0]) / 2
        y = sign * (low[1] + high[1]) / 2
        long_size = np.array([2 * high[0], high[1] - low[1]])
        short_size = np.array([high[0] - low[0], 2 * low[1]])
        out.append(_rectangle(np.array([0.0, y, 0.0]), up, down, long_size, "asphalt", texel_m))
        out.append(_rectangle(np.array([x, 0.0, 0.0]), up, down, short_size, "asphalt", texel_m))
        for other in (-1, 1):
            size = np.array([_WORLD.onward_m, high[1] - low[1]])
            middle = np.array([other * (high[0] + _WORLD.onward_m / 2), y, 0.0])
            out.append(_rectangle(middle, up, down, size, "asphalt", 2 * texel_m))
    plain = np.array([2 * (max(high) + 250.0)] * 2)
    out.append(_rectangle(np.array([0.0, 0.0, -0.05]), up, down, plain, "asphalt", 0.25))
    return out


def _roadside(half: FloatArray, rng: np.random.Generator) -> list[Solid]:
    """Parked boxes the size of cars and vans, and poles, at both sides of the middle line."""
    out: list[Solid] = []
    perimeter = 4 * float(half.sum())
    for number in range(_WORLD.parked + _WORLD.parked // 2):
        is_pole = number >= _WORLD.parked
        for _ in range(20):
            place = rng.uniform(0, perimeter)
            point, heading, to_corner = _on_rectangle(half, place)
            if to_corner < _WORLD.corner_free_m:
                continue
            side = rng.choice([-1.0, 1.0]) * (
                _WORLD.street_m / 2 - (0.7 if is_pole else rng.uniform(1.5, 1.9))
            )
            normal = np.array([-np.sin(heading), np.cos(heading)])
            size = (
                np.array([0.22, 0.22, rng.uniform(3, 6)])
                if is_pole
                else rng.uniform((3.4, 1.6, 1.3), (5.2, 2.0, 2.4))
            )
            yaw = heading + rng.normal(0, 0.03)
            beside = point + side * normal
            solid = Solid(_pose((*beside, size[2] / 2), yaw), size / 2)
            if not _overlaps(solid, out):
                out.append(solid)
                break
    return out


def _on_rectangle(half: FloatArray, s: float) -> tuple[FloatArray, float, float]:
    """Point, heading and distance to the nearest corner at arc length s along a rectangle,
    counter-clockwise.
    """
    sides = [
        (np.array([-1, -1]), np.array([1, 0])),
        (np.array([1, -1]), np.array([0, 1])),
        (np.array([1, 1]), np.array([-1, 0])),
        (np.array([-1, 1]), np.array([0, -1])),
    ]
    for start, direction in sides:
        length = 2 * float(np.abs(direction) @ half)
        if s <= length:
            heading = float(np.arctan2(direction[1], direction[0]))
            return start * half + direction * s, heading, min(s, length - s)
        s -= length
    return -half, 0.0, 0.0


def _far_box(reach: float) -> list[Patch]:
    """A closed box of skyline and sky, so that every ray ends somewhere."""
    kinds: dict[str, TextureKind] = dict.fromkeys(("+x", "-x", "+y", "-y"), "skyline")
    T = _pose((0.0, 0.0, 40.0), 0.0)
    half = np.array([reach, reach, 50.0])
    sky: dict[str, TextureKind] = {"+z": "sky"}
    return _axis_rectangles(T, half, kinds, 0.2, inwards=True) + _axis_rectangles(
        T, half, sky, 0.5, inwards=True
    )
