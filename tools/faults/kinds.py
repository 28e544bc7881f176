"""Kinds of faults whose size is drawn: name, range of sizes, and how a recording is changed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from tools.faults.cameras import (
    Cover,
    Wall,
    covering_object,
    cut,
    frozen_images,
    late_images,
    moving_object,
    reordered,
    repeated_pairs,
    shaking_right,
    torn_images,
    turned_right,
    wrong_calibration,
)
from tools.faults.changes import (
    Changed,
    Pair,
    Period,
    SampleChange,
    Variant,
    gap,
    imu_readings,
    imu_samples,
    pairs,
    pairs_during,
    with_events,
)
from tools.faults.imu import ZERO, as_is, noisy_imu, plus, restamped, spikes, stuck_samples
from tools.faults.views import (
    Arm,
    dirt,
    drops,
    exposure_steps,
    losing_focus,
    mirror,
    reflection,
    robot_arm,
    zoom,
)
from vio.geometry.lie import FloatArray, so3_exp
from vio.protocols import Dataset
from vio.records import Event, Image, ImuSample, StereoFrame

Group: TypeAlias = Literal["cameras", "imu"]
Half: TypeAlias = Literal["work", "kept"]
Lasting: TypeAlias = Literal["period", "onwards", "always"]
Make: TypeAlias = Callable[[float, np.random.Generator], Variant]


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault."""

    group: Group
    lasting: Lasting
    smallest: float  # sizes are drawn evenly in their logarithm
    largest: float
    unit: str
    make: Make  # of a size, and random numbers for what else is drawn
    # False: a sensor of the motion is needed to show it, as images are explained by another scale
    by_images: bool = True

    def drawn_size(self, rng: np.random.Generator) -> float:
        """Draw a size."""
        low = np.log(self.smallest)
        high = np.log(self.largest)
        return float(np.exp(rng.uniform(low, high)))


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _direction(rng: np.random.Generator) -> FloatArray:
    vector = rng.normal(0.0, 1.0, 3)
    out: FloatArray = vector / np.linalg.norm(vector)
    return out


def _late(camera: int) -> Make:
    return lambda size, rng: pairs(late_images, camera, round(size))


def _frozen(*cameras: int) -> Make:
    return lambda size, rng: pairs(frozen_images, *cameras)


def _exchanged(size: float, rng: np.random.Generator) -> Variant:
    return pairs_during(lambda frame, left, right: (right, left))


def _black(size: float, rng: np.random.Generator) -> Variant:
    return pairs_during(lambda frame, left, right: (np.zeros_like(left), np.zeros_like(right)))


def _noise(size: float, rng: np.random.Generator) -> Variant:
    """Images of noise alone."""

    def noise(frame: StereoFrame, *pair: Image) -> Pair:
        left, right = (rng.integers(0, 256, image.shape, dtype=np.uint8) for image in pair)
        return left, right

    return pairs_during(noise)


def _object(size: float, rng: np.random.Generator) -> Variant:
    share = size
    speed_px = _sign(rng) * float(np.exp(rng.uniform(np.log(1.0), np.log(8.0))))
    begin = float(rng.uniform(0.05, 0.95 - share))
    disparity_px = int(rng.integers(10, 40))
    seed = int(rng.integers(1000))
    return pairs(moving_object, Wall(speed_px, share, begin, disparity_px, seed))


def _covered(size: float, rng: np.random.Generator) -> Variant:
    frames = int(rng.integers(2, 16))
    disparity_px = int(rng.integers(15, 60))
    axis = int(rng.integers(2))
    sway_px = float(rng.uniform(0.0, 0.6))
    seed = int(rng.integers(1000))
    return pairs(covering_object, Cover(size, frames, disparity_px, axis, sway_px, seed))


def _torn(size: float, rng: np.random.Generator) -> Variant:
    cameras = _cameras(rng)
    return pairs(torn_images, int(rng.integers(2, 6)), size, *cameras)


def _cameras(rng: np.random.Generator) -> tuple[int, ...]:
    """Left, right, or both."""
    return [(0,), (1,), (0, 1)][int(rng.integers(3))]


def _exposure(size: float, rng: np.random.Generator) -> Variant:
    return pairs(exposure_steps, size, int(rng.integers(1, 6)), *_cameras(rng))


def _dirt(size: float, rng: np.random.Generator) -> Variant:
    radius = float(rng.uniform(0.01, 0.04))
    return pairs(dirt, round(size), radius, *_cameras(rng), seed=int(rng.integers(1000)))


def _drops(size: float, rng: np.random.Generator) -> Variant:
    radius = float(rng.uniform(0.02, 0.07))
    return pairs(drops, round(size), radius, *_cameras(rng), seed=int(rng.integers(1000)))


def _arm(size: float, rng: np.random.Generator) -> Variant:
    sway_px = float(rng.choice([0.0, 40.0]))
    disparity_px = int(rng.integers(20, 60))
    return pairs(robot_arm, Arm(size, sway_px, 75.0, disparity_px, seed=int(rng.integers(1000))))


def _reflection(size: float, rng: np.random.Generator) -> Variant:
    speed_px = float(rng.choice([0.0, 3.0]))
    return pairs(reflection, size, speed_px, seed=int(rng.integers(1000)))


def _unsharp(size: float, rng: np.random.Generator) -> Variant:
    return pairs(losing_focus, int(rng.integers(2)), size, int(rng.integers(5, 30)))


def _mounted(size: float, rng: np.random.Generator) -> Variant:
    """An arm of the rig that is always in view, and still."""
    arm = Arm(size, 0.0, 75.0, int(rng.integers(20, 60)), seed=int(rng.integers(1000)))
    return _always(pairs(robot_arm, arm))


def _mirror(size: float, rng: np.random.Generator) -> Variant:
    begin = float(rng.uniform(0.0, 1.0 - size))
    disparity_px = int(rng.integers(40, 80))
    return _always(pairs(mirror, begin, size, disparity_px))


def _always(variant: Variant) -> Variant:
    """A variant whose period is the whole recording."""
    return lambda dataset, period: variant(dataset, Period(0, 2**62))


def _zoom(size: float, rng: np.random.Generator) -> Variant:
    return pairs(zoom, 0.01 * size, float(rng.uniform(1.0, 5.0)), *_cameras(rng))


def _rescaled(size: float, rng: np.random.Generator) -> Variant:
    """Both images are scaled at once, as of a stream that negotiates another size."""
    return pairs(zoom, 0.01 * _sign(rng) * size, 1e-9, 0, 1)


def _cut(size: float, rng: np.random.Generator) -> Variant:
    return cut(samples=rng.random() < 0.5)


def _turned(*, all_along: bool) -> Make:
    def make(size: float, rng: np.random.Generator) -> Variant:
        axes = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), tuple(_direction(rng))]
        axis = axes[int(rng.integers(len(axes)))]
        return pairs(turned_right, _sign(rng) * size, axis, all_along=all_along)

    return make


def _shaking(size: float, rng: np.random.Generator) -> Variant:
    return pairs(shaking_right, size)


def _factor(*names: str) -> Make:
    def make(size: float, rng: np.random.Generator) -> Variant:
        factor = 1 + _sign(rng) * size / 100
        return wrong_calibration(**dict.fromkeys(names, factor))

    return make


def _repeated(size: float, rng: np.random.Generator) -> Variant:
    return pairs(repeated_pairs, round(size))


def _repeated_noisily(size: float, rng: np.random.Generator) -> Variant:
    return pairs(repeated_pairs, round(size), 1.0)


def _reordered(size: float, rng: np.random.Generator) -> Variant:
    return reordered(round(size))


def _constant(variant: Variant) -> Make:
    return lambda size, rng: variant


def _readings_after(change: SampleChange) -> Variant:
    return imu_samples(change, after=True)


def _jump(*, gyro: bool) -> Make:
    def make(size: float, rng: np.random.Generator) -> Variant:
        bias = size * _direction(rng)
        parts = (plus(*bias), as_is) if gyro else (as_is, plus(*bias))
        return _readings_after(imu_readings(*parts))

    return make


def _shock(size: float, rng: np.random.Generator) -> Variant:
    """A blow that both sensors feel and the body does not make, as on a mount that gives."""
    blow = imu_readings(plus(*(size * _direction(rng))), plus(*(20 * size * _direction(rng))))
    length_ns = round(1e9 * float(np.exp(rng.uniform(np.log(0.01), np.log(0.2)))))

    def variant(dataset: Dataset, period: Period) -> Changed:
        during = Period(period.begin_ns, period.begin_ns + length_ns)
        return imu_samples(blow, during=True)(dataset, during)

    return variant


def _offset(*, gyro: bool) -> Make:
    def make(size: float, rng: np.random.Generator) -> Variant:
        bias = size * _direction(rng)
        parts = (plus(*bias), as_is) if gyro else (as_is, plus(*bias))
        return imu_samples(imu_readings(*parts))

    return make


def _gyro_clipped(size: float, rng: np.random.Generator) -> Variant:
    return imu_samples(imu_readings(lambda g: np.clip(g, -size, size), as_is))


def _accel_clipped(size: float, rng: np.random.Generator) -> Variant:
    return imu_samples(imu_readings(as_is, lambda a: np.clip(a, -size, size)))


def _slow(size: float, rng: np.random.Generator) -> Variant:
    """Samples at a lower rate, in Hz."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        def thinned(events: Iterable[Event]) -> Iterator[Event]:
            next_ns: int | None = None
            for event in events:
                if isinstance(event, ImuSample):
                    if next_ns is not None and event.time_ns < next_ns:
                        continue
                    next_ns = event.time_ns + round(1e9 / size) - 2_000_000
                yield event

        return with_events(dataset, thinned)

    return variant


def _lost(size: float, rng: np.random.Generator) -> Variant:
    """A share of the samples is lost, one by one."""
    return imu_samples(lambda sample: None if rng.random() < size else sample)


def _imu_turned(size: float, rng: np.random.Generator) -> Variant:
    R = so3_exp(np.radians(size) * _direction(rng))
    return imu_samples(imu_readings(lambda g: R @ g, lambda a: R @ a))


def _scaled(*, gyro: bool) -> Make:
    def make(size: float, rng: np.random.Generator) -> Variant:
        factor = 1 + _sign(rng) * size / 100
        parts = (lambda x: factor * x, as_is) if gyro else (as_is, lambda x: factor * x)
        return imu_samples(imu_readings(*parts))

    return make


def _axes_exchanged(size: float, rng: np.random.Generator) -> Variant:
    order = [[1, 0, 2], [2, 1, 0], [0, 2, 1]][int(rng.integers(3))]
    return imu_samples(imu_readings(lambda g: g[order], lambda a: a[order]))


def _sign_changed(size: float, rng: np.random.Generator) -> Variant:
    signs = np.ones(3)
    signs[int(rng.integers(3))] = -1.0
    parts = (lambda g: g * signs, as_is) if rng.random() < 0.5 else (as_is, lambda a: a * signs)
    return imu_samples(imu_readings(*parts))


def _units(size: float, rng: np.random.Generator) -> Variant:
    parts = (np.degrees, as_is) if rng.random() < 0.5 else (as_is, lambda a: a / 9.80665)
    return imu_samples(imu_readings(*parts))


KINDS: dict[str, Kind] = {
    "right late": Kind("cameras", "always", 1, 3, "frames", _late(1)),
    "left late": Kind("cameras", "always", 1, 3, "frames", _late(0)),
    "object": Kind("cameras", "period", 0.2, 0.6, "of the width", _object),
    "right turned": Kind("cameras", "always", 0.1, 2.0, "deg", _turned(all_along=True)),
    "right turns": Kind("cameras", "onwards", 0.1, 2.0, "deg", _turned(all_along=False)),
    "right shaking": Kind("cameras", "always", 0.02, 0.3, "deg", _shaking),
    "right frozen": Kind("cameras", "period", 1, 1, "", _frozen(1)),
    "left frozen": Kind("cameras", "period", 1, 1, "", _frozen(0)),
    "both frozen": Kind("cameras", "period", 1, 1, "", _frozen(0, 1)),
    "exchanged": Kind("cameras", "period", 1, 1, "", _exchanged),
    "black": Kind("cameras", "period", 1, 1, "", _black),
    "noise": Kind("cameras", "period", 1, 1, "", _noise),
    "focal length": Kind("cameras", "always", 1, 6, "%", _factor("fu", "fv"), by_images=False),
    "baseline": Kind("cameras", "always", 2, 15, "%", _factor("baseline_m"), by_images=False),
    "pairs repeated": Kind("cameras", "always", 3, 12, "frames", _repeated),
    "no frames": Kind("cameras", "period", 1, 1, "", _constant(gap(frames=True, samples=False))),
    "gyro bias jumps": Kind("imu", "onwards", 0.03, 0.3, "rad/s", _jump(gyro=True)),
    "accelerometer bias jumps": Kind("imu", "onwards", 0.3, 3.0, "m/s^2", _jump(gyro=False)),
    "gyro clipped": Kind("imu", "always", 0.1, 0.6, "rad/s", _gyro_clipped),
    "accelerometer clipped": Kind("imu", "always", 9.0, 14.0, "m/s^2", _accel_clipped),
    "slow": Kind("imu", "always", 3.0, 40.0, "Hz", _slow),
    "samples lost": Kind("imu", "always", 0.2, 0.9, "of all", _lost),
    "gyro scale": Kind("imu", "always", 2, 20, "%", _scaled(gyro=True)),
    "accelerometer scale": Kind("imu", "always", 2, 20, "%", _scaled(gyro=False)),
    "gyro bias": Kind("imu", "always", 0.03, 0.4, "rad/s", _offset(gyro=True)),
    "accelerometer bias": Kind("imu", "always", 0.2, 2.0, "m/s^2", _offset(gyro=False)),
    "imu turned": Kind("imu", "always", 2.0, 20.0, "deg", _imu_turned),
    "axes exchanged": Kind("imu", "always", 1, 1, "", _axes_exchanged),
    "sign": Kind("imu", "always", 1, 1, "", _sign_changed),
    "units": Kind("imu", "always", 1, 1, "", _units),
    "clock": Kind(
        "imu",
        "always",
        0.01,
        0.2,
        "s",
        lambda size, rng: restamped(_sign(rng) * size),
    ),
    "jitter": Kind("imu", "always", 5e-4, 5e-3, "s", lambda size, rng: restamped(0.0, size)),
    "spikes": Kind(
        "imu",
        "always",
        0.5,
        30.0,
        "rad/s",
        lambda size, rng: spikes(rng, 0.015, size, 4 * size),
    ),
    "vibration": Kind(
        "imu",
        "always",
        0.03,
        0.5,
        "rad/s",
        lambda size, rng: imu_samples(noisy_imu(rng, size, 15 * size)),
    ),
    "zero": Kind("imu", "period", 1, 1, "", _constant(imu_samples(ZERO, during=True))),
    "stuck": Kind("imu", "period", 1, 1, "", _constant(stuck_samples)),
    "silent": Kind("imu", "period", 1, 1, "", _constant(gap(frames=False, samples=True))),
    "dead": Kind("imu", "onwards", 1, 1, "", _constant(_readings_after(lambda sample: None))),
    "shock": Kind("imu", "onwards", 0.3, 6.0, "rad/s", _shock),
    "covered": Kind("cameras", "period", 0.7, 1.0, "of the image", _covered),
    "torn": Kind("cameras", "period", 0.2, 0.8, "of the rows", _torn),
    "cut": Kind("cameras", "onwards", 1, 1, "", _cut),
    "exposure steps": Kind("cameras", "period", 1.0, 8.0, "stops", _exposure),
    "dirt": Kind("cameras", "onwards", 10, 200, "grains", _dirt),
    "drops": Kind("cameras", "onwards", 5, 50, "drops", _drops),
    "arm": Kind("cameras", "period", 0.2, 0.6, "of the height", _arm),
    "reflection": Kind("cameras", "period", 0.1, 0.6, "of its contrast", _reflection),
    "focus": Kind("cameras", "period", 1.0, 6.0, "px of blur", _unsharp),
    "part of the rig": Kind("cameras", "always", 0.2, 0.6, "of the height", _mounted),
    "mirror": Kind("cameras", "always", 0.2, 0.6, "of the width", _mirror),
    "zoom": Kind("cameras", "onwards", 0.5, 3.0, "%", _zoom),
    "rescaled": Kind("cameras", "onwards", 1.0, 10.0, "%", _rescaled),
    "repeated, noisy": Kind("cameras", "always", 2, 4, "frames", _repeated_noisily),
    "out of order": Kind("cameras", "onwards", 2, 4, "frames", _reordered),
}
# Every second kind is kept aside: the two of a similar pair come to different halves.
HALVES: dict[str, Half] = {
    name: "kept" if number % 2 else "work" for number, name in enumerate(KINDS)
}
