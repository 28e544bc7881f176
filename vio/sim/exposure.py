"""Exposure control: each camera meters its images and sets shutter time and gain for later ones,
with a lag.

The loop is planned for all frames from a coarse grid of rays before anything is rendered, so any
frame can be rendered at any time and in any process. It follows what industrial sensors do: the
exposure changes at every third frame, from an image two frames old, towards a mean gray level; the
shutter opens longer first, then gain is added in coarse steps whose true values are off by some per
cent, so that the brightness jumps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.geometry.distortion import CameraModel, StereoRig, unproject_pixel
from vio.geometry.lie import FloatArray
from vio.records import IntArray
from vio.sim.effects import Exposure, SensorEffects, camera_factor, sensitivity
from vio.sim.motion import MotionSpline, motion_at
from vio.sim.render import cast
from vio.sim.world import World, surfaces_at


@dataclass(frozen=True, slots=True)
class _ExposureControl:
    """The automatic exposure of a simulated camera."""

    grid: tuple[int, int] = (12, 8)  # metered rays across and down
    # frames between changes of the exposure, and from an image to the change it causes
    every: int = 3
    latency: int = 2
    dead_band: float = 0.1  # octaves of brightness that are left alone
    speed: float = 0.6  # share of the error taken back at once, and the most, octaves
    largest_step: float = 0.6
    gain_step: float = 2**0.5
    gain_error: float = 0.05  # standard deviation of a gain step's true value, relative
    shortest_ms: float = 0.02


_CONTROL = _ExposureControl()


@dataclass(frozen=True, slots=True)
class ExposurePlan:
    """Exposure of every frame by both cameras."""

    shutter_ms: FloatArray  # (F, 2) left, right
    gain: FloatArray  # (F, 2) true gain of the amplifier, at least about 1
    brightness: FloatArray  # (F, 2) mean gray level that the exposure gives the metered rays

    def at(self, frame: int, camera: int) -> Exposure:
        """Return the exposure of one image."""
        return Exposure(float(self.shutter_ms[frame, camera]), float(self.gain[frame, camera]))


def plan_exposures(
    world: World,
    rig: StereoRig,
    motion: MotionSpline,
    taken_ns: IntArray,
    effects: SensorEffects,
    *,
    seed: int,
) -> ExposurePlan:
    """Return the exposures that the cameras' loops set along a motion.

    Args:
        world: scene.
        rig: the true cameras.
        motion: motion of their body.
        taken_ns: true times (F,) of the frames; a repeated time is a repeated frame.
        effects: limits and target of the loops, and how much the two cameras differ.
        seed: of the gain steps' errors and of that difference.
    """
    times, frame = np.unique(taken_ns, return_inverse=True)
    loops = []
    for camera, (model, T_imu_cam) in enumerate(
        ((rig.cam0, rig.T_imu_cam0), (rig.cam1, rig.T_imu_cam1))
    ):
        metered = _meter(world, model, motion_at(motion, times).T_world_imu @ T_imu_cam, times)
        loops.append(_control(metered, effects, camera, seed))
    shutter, gain, brightness = (
        np.stack(column, axis=1)[frame] for column in zip(*loops, strict=True)
    )
    return ExposurePlan(shutter, gain, brightness)


def _meter(
    world: World, camera: CameraModel, T_world_cam: FloatArray, times: IntArray
) -> FloatArray:
    """Radiance (F, M) along a grid of rays."""
    u, v = (
        (np.arange(n) + 0.5) / n * side
        for n, side in zip(_CONTROL.grid, (camera.width, camera.height), strict=True)
    )
    rays, found = unproject_pixel(camera, np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    rays = rays[found]
    out = np.empty((len(times), len(rays)))
    for k, (T, time_ns) in enumerate(zip(T_world_cam, times.tolist(), strict=True)):
        hits = cast(surfaces_at(world, time_ns), T, rays)
        share = hits.coordinates / world.surfaces.size[hits.surface]
        for surface in np.unique(hits.surface):
            mine = hits.surface == surface
            out[k, mine] = world.textures[int(surface)].coarse(share[mine])
    return out


def _control(
    radiance: FloatArray, effects: SensorEffects, camera: int, seed: int
) -> tuple[FloatArray, ...]:
    """Shutter times (F,), true gains (F,) and mean gray levels (F,) of one camera's loop, from
    radiance (F, M).
    """
    rng = np.random.default_rng([seed, camera, 61])
    target = effects.exposure_target * camera_factor(effects, camera, seed)
    phase = int(rng.integers(_CONTROL.every))
    steps = int(np.log(effects.gain_max) / np.log(_CONTROL.gain_step) + 1e-9)
    true_gain = _CONTROL.gain_step ** np.arange(steps + 1) * (
        1 + _CONTROL.gain_error * rng.standard_normal(steps + 1)
    )
    true_gain[0] = 1.0
    per_ms = sensitivity(effects, camera) / effects.shutter_ms
    limits = np.log2([_CONTROL.shortest_ms, effects.shutter_max_ms * _CONTROL.gain_step**steps])
    # octaves of 1 ms at gain 1
    wanted = float(np.log2(target / max(float(radiance[0].mean()) * per_ms, 1e-6)))
    rows: list[tuple[float, float, float]] = []
    for k, seen in enumerate(radiance):
        if k >= _CONTROL.latency and k % _CONTROL.every == phase:
            error = float(np.log2(target / max(rows[k - _CONTROL.latency][2], 1.0)))
            if abs(error) > _CONTROL.dead_band:
                wanted += float(
                    np.clip(_CONTROL.speed * error, -_CONTROL.largest_step, _CONTROL.largest_step)
                )
        wanted = float(np.clip(wanted, *limits))
        missing = np.log(2**wanted / effects.shutter_max_ms) / np.log(_CONTROL.gain_step)
        step = int(np.clip(np.ceil(missing - 1e-9), 0, steps))
        shutter = 2**wanted / _CONTROL.gain_step**step
        gain = float(true_gain[step])
        rows.append((shutter, gain, float(np.minimum(seen * per_ms * shutter * gain, 255).mean())))
    shutters, gains, means = (np.array(column) for column in zip(*rows, strict=True))
    return shutters, gains, means
