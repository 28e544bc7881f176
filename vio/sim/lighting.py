"""Light in a scene: bright windows or a sun, ambient light, and the illumination that they give to
each surface.

A simplified model: windows are small diffuse sources and cast no shadows, the sun casts the hard
shadows of boxes and houses, light between surfaces is one ambient constant. Illumination 1 leaves a
texture's gray levels as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray


class _LightRules(NamedTuple):
    """How light falls."""

    # illumination right at a window; the model of a small source would go to infinity there
    max_factor: float = 3.0
    # share of a window's light that arrives from around it, off the walls beside it
    wrap_share: float = 0.35
    # a shadow's ray begins so far off its surface, outside the surface's own box
    shadow_start_m: float = 0.01


_LIGHT = _LightRules()


@dataclass(frozen=True, slots=True)
class Light:
    """A window (a bright rectangle) or the sun."""

    position: FloatArray  # (3,) world, m: its middle; of a distant light a unit vector towards it
    normal: FloatArray  # (3,) unit, the direction in which it shines
    extent: FloatArray  # (2, 3) half its sides, world, m; zero for the sun
    power: float  # illumination of a surface that faces it, at 1 m; of a distant light anywhere
    radiance: float  # gray levels of the source itself, which the sensor clips
    distant: bool = False


@dataclass(frozen=True, slots=True)
class Lighting:
    """The light of a scene; `casters` are boxes that keep a distant light off."""

    lights: tuple[Light, ...] = ()
    ambient: float = 1.0
    caster_poses: FloatArray | None = None  # (B, 4, 4) world to the box's middle
    caster_half_sizes: FloatArray | None = None  # (B, 3) m


def illumination(lighting: Lighting, points: npt.ArrayLike, normal: npt.ArrayLike) -> FloatArray:
    """Return the illumination (N,) of points (N, 3) of one surface, world, m, with its unit
    normal (3,).
    """
    p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    n = np.asarray(normal, dtype=np.float64)
    total = np.full(len(p), lighting.ambient)
    for light in lighting.lights:
        if light.distant:
            facing = max(0.0, float(n @ light.position))
            if facing > 0:
                total += (
                    light.power
                    * facing
                    * _sunlit(lighting, p + _LIGHT.shadow_start_m * n, light.position)
                )
            continue
        towards = light.position - p
        square = np.einsum("ni,ni->n", towards, towards)
        ray = towards / np.sqrt(np.maximum(square, 1e-12))[:, None]
        received = _LIGHT.wrap_share + (1 - _LIGHT.wrap_share) * (ray @ n)
        sent = _LIGHT.wrap_share + (1 - _LIGHT.wrap_share) * -(ray @ light.normal)
        total += (
            light.power * np.maximum(received, 0) * np.maximum(sent, 0) / np.maximum(square, 1e-2)
        )
    return np.minimum(total, _LIGHT.max_factor + lighting.ambient)


def _sunlit(lighting: Lighting, points: FloatArray, direction: FloatArray) -> FloatArray:
    """1 where the ray from a point (N, 3) towards the sun meets no box, else 0; the slab test,
    box by box.
    """
    lit = np.ones(len(points))
    if lighting.caster_poses is None or lighting.caster_half_sizes is None:
        return lit
    for T, half in zip(lighting.caster_poses, lighting.caster_half_sizes, strict=True):
        start = (points - T[:3, 3]) @ T[:3, :3]
        ray = direction @ T[:3, :3]
        safe = np.where(np.abs(ray) < 1e-9, 1e-9, ray)
        near = (-half - start) / safe
        far = (half - start) / safe
        enters = np.minimum(near, far).max(axis=1)
        leaves = np.maximum(near, far).min(axis=1)
        lit[(enters < leaves) & (leaves > 0)] = 0.0
    return lit


def sun(azimuth_rad: float, elevation_rad: float, *, power: float, radiance: float) -> Light:
    """Return the sun at an azimuth (from world x towards y) and elevation."""
    level = np.cos(elevation_rad)
    towards = np.array(
        [level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), np.sin(elevation_rad)]
    )
    return Light(towards, -towards, np.zeros((2, 3)), power, radiance, distant=True)


def window(
    middle: npt.ArrayLike,
    normal: npt.ArrayLike,
    extent: npt.ArrayLike,
    *,
    power: float,
    radiance: float,
) -> Light:
    """Return a window with its middle (3,), its normal (3,) into the room and half its sides (2,
    3), world, m.
    """
    return Light(
        np.asarray(middle, float),
        np.asarray(normal, float),
        np.asarray(extent, float),
        power,
        radiance,
    )
