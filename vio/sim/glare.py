"""Light that a lens scatters: a halo about bright sources, also outside the image, and ghosts that
move against them.

The halo falls with the square of the angle from the source (the veiling glare of dust and of the
lens barrel); ghosts are discs on the line through the image's centre, reflections between lens
surfaces. Both are light added before the shutter closes, so they follow the exposure and saturate.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Tolerance
from vio.sim.lighting import Light
from vio.sim.render import CameraRays, Radiance, View, cast
from vio.sim.world import Surfaces, World, surfaces_at


@dataclass(frozen=True, slots=True)
class _GlareRules:
    """How lamps and the sun look in an image."""

    grid_px: Tolerance[int] = 4  # pixels between computed values; halos and ghosts are smooth
    core_rad: float = 0.012  # the sun's bright centre: its radius, and its light over the source's
    core: float = 3.0
    halo_rad: float = 0.12  # the wide part of the halo: its radius, and its light over the source's
    halo: float = 0.035
    # solid angle of a source for which these hold; the sun's light is stated for its small disc
    usual_sr: float = 0.05
    sun_strength: float = 0.025  # the sun instead of a source of that solid angle
    distant_m: float = 100.0  # what is farther away than this is sky and does not hide the sun
    # place, radius, level
    ghosts: tuple[tuple[float, ...], ...] = (
        (-0.45, 0.05, 70.0),
        (-0.9, 0.03, 120.0),
        (0.4, 0.022, 90.0),
        (-1.5, 0.09, 40.0),
    )
    ghost_reach_rad: float = 0.9  # beyond this angle from the axis a source makes no ghosts


_GLARE = _GlareRules()


def glare(world: World, view: View, rays: CameraRays, strength: float) -> Radiance:
    """Return the scattered light (H, W) in one image, gray levels of the scene."""
    surfaces = surfaces_at(world, view.time_ns)
    coarse = rays.centre[:, :: _GLARE.grid_px, :: _GLARE.grid_px].astype(np.float32)
    directions = coarse / np.linalg.norm(coarse, axis=0)
    total = np.zeros(directions.shape[1:], dtype=np.float32)
    for light in world.lights:
        sources, weight = _sources(light, view, surfaces)
        for source in sources:
            total += np.float32(weight) * _halo(directions, source, light)
        if len(sources):
            share = min(1.0, weight * len(sources))
            total += _ghosts(directions, sources.mean(axis=0), np.float32(share))
    height = view.camera.height
    width = view.camera.width
    size = (directions.shape[2] * _GLARE.grid_px, directions.shape[1] * _GLARE.grid_px)
    # Values belong to every fourth pixel; `resize` puts them at the middles of four by four.
    shift = np.array(
        [
            [1, 0, -(_GLARE.grid_px - 1) / 2],
            [0, 1, -(_GLARE.grid_px - 1) / 2],
        ],
        dtype=np.float32,
    )
    large = cv2.resize(strength * total, size, interpolation=cv2.INTER_LINEAR)
    out = cv2.warpAffine(large, shift, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return out.astype(np.float32, copy=False)


def _sources(light: Light, view: View, surfaces: Surfaces) -> tuple[FloatArray, float]:
    """Visible points of a light as unit rays (N, 3) of the camera frame, and the strength of
    each of them.
    """
    R = view.T_world_cam[:3, :3]
    centre = view.T_world_cam[:3, 3]
    if light.distant:
        rays = (light.position @ R)[None]
        hits = cast(surfaces, view.T_world_cam, rays)
        open_sky = ~hits.found | (hits.distance > _GLARE.distant_m)
        return rays[open_sky], _GLARE.sun_strength
    corners = np.array([(i, j) for i in (-0.7, 0.0, 0.7) for j in (-0.7, 0.0, 0.7)])
    towards = light.position + corners @ light.extent - centre
    distance = np.linalg.norm(towards, axis=1)
    rays = (towards / distance[:, None]) @ R
    hits = cast(surfaces, view.T_world_cam, rays)
    seen = hits.found & (hits.distance > distance - 0.05)
    facing = max(0.0, float(-(light.normal @ towards[4]) / distance[4]))
    area = 4 * float(np.linalg.norm(np.cross(*light.extent)))
    solid_angle = area * facing / max(float(distance[4]) ** 2, 0.1)
    return rays[seen], min(solid_angle / _GLARE.usual_sr, 3.0) / len(corners)


def _halo(
    directions: npt.NDArray[np.float32], source: FloatArray, light: Light
) -> npt.NDArray[np.float32]:
    """Halo (h, w) of a point of a source along unit rays (3, h, w)."""
    cosine = np.tensordot(source.astype(np.float32), directions, axes=1)
    square = 2 * np.maximum(1 - cosine, 0)  # of the chord, about the angle
    out = _GLARE.halo * light.radiance / (1 + square / _GLARE.halo_rad**2)
    if light.distant:  # a window's own surface shows its bright centre
        out += _GLARE.core * light.radiance / (1 + square / _GLARE.core_rad**2) ** 2
    return out.astype(np.float32)


def _ghosts(
    directions: npt.NDArray[np.float32], source: FloatArray, share: np.float32
) -> npt.NDArray[np.float32]:
    """Ghosts (h, w): discs on the line from the source through the optical axis."""
    total = np.zeros(directions.shape[1:], dtype=np.float32)
    angle = float(np.arccos(np.clip(source[2] / np.linalg.norm(source), -1, 1)))
    if angle > _GLARE.ghost_reach_rad:
        return total
    x = directions[0] / directions[2]
    y = directions[1] / directions[2]
    at = source[:2] / source[2]
    fade = float(np.cos(angle / _GLARE.ghost_reach_rad * np.pi / 2))
    for place, radius, level in _GLARE.ghosts:
        distance = np.hypot(x - place * at[0], y - place * at[1])
        from_edge = (distance - radius) / (0.2 * radius)
        total += (
            share * np.float32(level * fade) * np.clip(0.5 - from_edge, 0, 1).astype(np.float32)
        )
    return total
