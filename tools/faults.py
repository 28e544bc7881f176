"""Run recordings with faults of camera and IMU, and in healthy variants; print one JSON line a run, or a table of them.

    python tools/faults.py euroc/MH_01_head kitti_05_clip --motion none --variants healthy >> runs.jsonl
    python tools/faults.py --table runs.jsonl > docs/faults.md

A variant changes the events of a recording in memory: the images after rectification, the samples of the IMU, the
stamps, the calibration. *Healthy* ones are what a good rig may deliver, so no check may act on them. *Faults* begin at
40 % of the recording and last three seconds, or to its last fifth, unless their name says otherwise. The error is the
ATE after SE(3) alignment; `ratio` is its largest value over the largest stated standard deviation of a position.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np

from vio import evaluate, load_config, open_dataset
from vio.errors import VioError
from vio.files.trajectories import read_trajectory
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, so3_exp
from vio.protocols import Dataset
from vio.records import BoolArray, Event, Image, ImuSample, Observations, Recording, StereoFrame, Trajectory
from vio.runs.pipeline import RunResult, run

_BEGIN, _END, _LENGTH_S = 0.4, 0.8, 3.0  # of a fault: shares of the recording, and how long it lasts at most
_MIRROR = np.diag([-1.0, 1.0, 1.0])
_NS = 1e-9

Pair: TypeAlias = tuple[Image, Image]
PairChange: TypeAlias = Callable[[StereoFrame, Image, Image], Pair]
SampleChange: TypeAlias = Callable[[ImuSample], ImuSample | None]
EventChange: TypeAlias = Callable[[Iterable[Event]], Iterator[Event]]


@dataclass(frozen=True, slots=True)
class Changed:
    """A recording whose events are changed on their way; see `vio.protocols.Dataset`."""

    source: Dataset
    recording: Recording
    change: EventChange

    def events(self, start: int = 0, stop: int | None = None, *, images: bool = True) -> Iterator[Event]:
        """Yield the changed events of some frames."""
        return self.change(self.source.events(start, stop, images=images))

    def observations(self, index: int) -> Observations | None:
        """Return nothing: faults are those of images."""
        return None


@dataclass(frozen=True, slots=True)
class Period:
    """When a fault is there, by the recording's clock."""

    begin_ns: int
    end_ns: int

    def holds(self, time_ns: int) -> bool:
        """Whether a time is within the period."""
        return self.begin_ns <= time_ns < self.end_ns


Variant: TypeAlias = Callable[[Dataset, Period], Changed]


# --- ways to change a recording ---------------------------------------------------------------------------------------


def _with_events(dataset: Dataset, change: EventChange, **fields: Any) -> Changed:
    return Changed(dataset, replace(dataset.recording, **fields), change)


def _with_frames(dataset: Dataset, kept: BoolArray, change: EventChange = iter) -> Changed:
    """Only some frames (F,), numbered anew."""
    number = np.cumsum(kept) - 1

    def changed(events: Iterable[Event]) -> Iterator[Event]:
        for event in change(events):
            if not isinstance(event, StereoFrame):
                yield event
            elif kept[event.index]:
                yield replace(event, index=int(number[event.index]))

    return _with_events(dataset, changed, frame_times_ns=dataset.recording.frame_times_ns[kept])


def _with_pairs(change: PairChange) -> EventChange:
    def changed(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, StereoFrame) and event.left is not None and event.right is not None:
                left, right = change(event, event.left, event.right)
                event = replace(event, left=np.ascontiguousarray(left), right=np.ascontiguousarray(right))
            yield event

    return changed


def _pairs(change: PairChange) -> Variant:
    """Every pair changed."""
    return lambda dataset, period: _with_events(dataset, _with_pairs(change))


def _each(change: Callable[[Image], Image]) -> Variant:
    """Every image changed by itself."""
    return _pairs(lambda frame, left, right: (change(left), change(right)))


def _seeded(variant: Callable[[np.random.Generator], Variant]) -> Variant:
    """A variant with random numbers, the same ones in every run."""
    return lambda dataset, period: variant(np.random.default_rng(1))(dataset, period)


def _while(change: PairChange) -> Variant:
    """The pairs of the fault's period changed."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        def within(frame: StereoFrame, left: Image, right: Image) -> Pair:
            return change(frame, left, right) if period.holds(frame.time_ns) else (left, right)

        return _with_events(dataset, _with_pairs(within))

    return variant


def _samples(change: SampleChange, *, during: bool = False, after: bool = False) -> Variant:
    """IMU samples changed or, by None, lost: all of them, those during the fault's period, or all after its begin."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        def affected(time_ns: int) -> bool:
            return period.holds(time_ns) if during else not after or time_ns >= period.begin_ns

        def changed(events: Iterable[Event]) -> Iterator[Event]:
            for event in events:
                new = change(event) if isinstance(event, ImuSample) and affected(event.time_ns) else event
                if new is not None:
                    yield new

        return _with_events(dataset, changed)

    return variant


def _imu(gyro: Callable[[FloatArray], FloatArray], accel: Callable[[FloatArray], FloatArray]) -> SampleChange:
    return lambda s: ImuSample(s.time_ns, gyro(s.gyro), accel(s.accel))


def _gray(image: FloatArray) -> Image:
    return np.asarray(np.clip(np.rint(image), 0, 255), dtype=np.uint8)


def _gain(gain: float, offset: float = 0.0) -> Callable[[Image], Image]:
    return lambda image: _gray(gain * np.asarray(image, dtype=np.float64) + offset)


def _blurred(image: Image, sigma_px: float) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), dtype=np.uint8)


# --- healthy variants -------------------------------------------------------------------------------------------------


def _mirror(dataset: Dataset, period: Period) -> Changed:
    """Both images mirrored and exchanged; the path of the mirrored right camera is the reference."""
    recording = dataset.recording
    camera, T_cam0_imu, reference = recording.camera, recording.T_cam0_imu, recording.reference
    assert camera.width is not None
    T_cam1_cam0 = se3_from_parts(np.eye(3), np.array([-camera.baseline_m, 0.0, 0.0]))
    M = se3_from_parts(_MIRROR, np.zeros(3))
    T_new = None if T_cam0_imu is None else M @ T_cam1_cam0 @ T_cam0_imu @ M
    if reference is not None:
        T_body_new = np.eye(4) if reference.body == "imu" else se3_inverse(T_cam1_cam0)
        reference = replace(reference, T_world_body=M @ reference.T_world_body @ T_body_new @ M)

    def changed(events: Iterable[Event]) -> Iterator[Event]:
        exchange = _with_pairs(lambda frame, left, right: (right[:, ::-1], left[:, ::-1]))
        sample = _imu(lambda gyro: -_MIRROR @ gyro, lambda accel: _MIRROR @ accel)  # axial and polar vectors
        for event in exchange(events):
            yield sample(event) or event if isinstance(event, ImuSample) else event

    other = replace(camera, cu=camera.width - 1 - camera.cu)
    return _with_events(dataset, changed, camera=other, T_cam0_imu=T_new, reference=reference)


def _reverse(dataset: Dataset, period: Period) -> Changed:
    """From the end to the start: velocities and rates change their sign, accelerations do not."""
    recording = dataset.recording
    times_ns, reference = recording.frame_times_ns, recording.reference
    both_ends = int(times_ns[0] + times_ns[-1])
    if reference is not None:
        back, times = reference.T_world_body[::-1], reference.times_ns
        frames = np.arange(len(back)) if times is None else None
        times = None if times is None else both_ends - times[::-1]
        reference = Trajectory(T_world_body=back, times_ns=times, body=reference.body, frame_indices=frames)

    def changed(events: Iterable[Event]) -> Iterator[Event]:
        held = list(events)
        number = sum(isinstance(event, StereoFrame) for event in held) - 1
        for event in sorted(held, key=lambda event: (-event.time_ns, isinstance(event, StereoFrame))):
            if isinstance(event, ImuSample):
                yield ImuSample(both_ends - event.time_ns, -event.gyro, event.accel)
            elif isinstance(event, StereoFrame):
                yield replace(event, index=number - event.index, time_ns=both_ends - event.time_ns)

    return _with_events(dataset, changed, frame_times_ns=both_ends - times_ns[::-1], reference=reference)


def _half(dataset: Dataset, period: Period) -> Changed:
    """Images of half the size, with their calibration."""
    camera = dataset.recording.camera
    assert camera.width is not None
    assert camera.height is not None
    width, height = camera.width // 2, camera.height // 2

    def smaller(image: Image) -> Image:
        whole = image[: 2 * height, : 2 * width]
        return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)

    other = replace(
        camera,
        fu=camera.fu / 2,
        fv=camera.fv / 2,
        cu=(camera.cu + 0.5) / 2 - 0.5,
        cv=(camera.cv + 0.5) / 2 - 0.5,
        width=width,
        height=height,
    )
    return _with_events(dataset, _with_pairs(lambda frame, *pair: (smaller(pair[0]), smaller(pair[1]))), camera=other)


def _every_second(dataset: Dataset, period: Period) -> Changed:
    return _with_frames(dataset, np.arange(len(dataset.recording.frame_times_ns)) % 2 == 0)


def _night(rng: np.random.Generator) -> Callable[[Image], Image]:
    return lambda image: _gray(0.3 * image + rng.normal(0.0, 3.0, image.shape))


def _rain(rng: np.random.Generator) -> Callable[[Image], Image]:
    def streaks(image: Image) -> Image:
        out = image.copy()
        for u, v, du, dv, gray in _places(rng, image, 250, [(-2, 3), (4, 16), (180, 256)]):
            cv2.line(out, (u, v), (u + du, v + dv), gray)
        return out

    return streaks


def _snow(rng: np.random.Generator) -> Callable[[Image], Image]:
    def flakes(image: Image) -> Image:
        out = image.copy()
        for u, v, radius, gray in _places(rng, image, 150, [(1, 5), (200, 256)]):
            cv2.circle(out, (u, v), radius, gray, -1)
        return out

    return flakes


def _places(rng: np.random.Generator, image: Image, count: int, ranges: list[tuple[int, int]]) -> list[list[int]]:
    """Random pixels of an image, each with further random numbers."""
    within = [(0, image.shape[1]), (0, image.shape[0]), *ranges]
    return np.column_stack([rng.integers(low, high, count) for low, high in within]).tolist()


def _jpeg(image: Image) -> Image:
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 15])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def _hood(image: Image) -> Image:
    """Stripes that stay in the lower fifth of an image, as those of a car's hood."""
    out = image.copy()
    out[int(0.78 * len(out)) :] = 60 + 40 * ((np.arange(image.shape[1]) // 9) % 2)
    return out


def _dirty(image: Image) -> Image:
    """A blurred spot over the middle of an image."""
    height, width = image.shape
    spot = np.zeros(image.shape, dtype=np.float32)
    cv2.ellipse(spot, (width // 2, height // 2), (width // 4, height // 3), 0, 0, 360, 1.0, -1)
    spot = np.asarray(cv2.GaussianBlur(spot, (0, 0), 8.0), dtype=np.float32)
    return _gray(image * (1 - spot) + _blurred(image, 6.0) * spot)


def _swinging_gains(frame: StereoFrame, left: Image, right: Image) -> Pair:
    phase = 0.35 * frame.index
    return _gain(1 + 0.3 * np.sin(phase))(left), _gain(1 + 0.3 * np.sin(phase + 1.0))(right)


def _jumping_gains(frame: StereoFrame, left: Image, right: Image) -> Pair:
    gains = (1.0 if (frame.index + later) // 7 % 2 else 0.5 for later in (0, 3))
    return _gain(next(gains))(left), _gain(next(gains))(right)


def _random_gains(rng: np.random.Generator) -> PairChange:
    return lambda frame, left, right: (_gain(rng.uniform(0.35, 1.4))(left), _gain(rng.uniform(0.35, 1.4))(right))


# --- faults of the cameras --------------------------------------------------------------------------------------------


def _late(late: int) -> Variant:
    """One camera's image (0: left) is that of the frame before, all the time."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        last: list[Image] = []

        def delayed(frame: StereoFrame, *pair: Image) -> Pair:
            before = last.pop() if last else pair[late]
            last.append(pair[late])
            return (before, pair[1]) if late == 0 else (pair[0], before)

        return _with_events(dataset, _with_pairs(delayed))

    return variant


def _frozen(*cameras: int) -> Variant:
    """The image of some cameras stays what it was before the fault."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        held: dict[int, Image] = {}

        def frozen(frame: StereoFrame, *pair: Image) -> Pair:
            if not period.holds(frame.time_ns):
                held.update(enumerate(pair))
                return pair[0], pair[1]
            left, right = (held.get(k, pair[k]) if k in cameras else pair[k] for k in range(2))
            return left, right

        return _with_events(dataset, _with_pairs(frozen))

    return variant


def _moving_object(speed_px: float) -> Variant:
    """A textured wall that covers the middle half of both images and moves sideways, pixels a frame."""
    disparity_px = 30
    rng = np.random.default_rng(7)
    texture = _blurred(rng.integers(0, 256, (1200, 6000)).astype(np.uint8), 3.0)
    texture = np.asarray(cv2.normalize(texture, texture.copy(), 20, 235, cv2.NORM_MINMAX), dtype=np.uint8)

    def variant(dataset: Dataset, period: Period) -> Changed:
        first: list[int] = []

        def covered(frame: StereoFrame, left: Image, right: Image) -> Pair:
            if not period.holds(frame.time_ns):
                return left, right
            first.append(frame.index)
            height, width = left.shape
            at = 1000 + round(speed_px * (frame.index - first[0]))
            wall, left, right = texture[:height, at : at + width // 2], left.copy(), right.copy()
            for image, begin in ((left, width // 4), (right, width // 4 - disparity_px)):
                image[:, begin : begin + width // 2] = wall
            return left, right

        return _with_events(dataset, _with_pairs(covered))

    return variant


def _turned_right(degrees: float, axis: tuple[float, float, float], *, all_along: bool) -> Variant:
    """The right camera is turned in its mount, from the start or from the fault's begin on."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        camera = dataset.recording.camera
        K = np.array([[camera.fu, 0.0, camera.cu], [0.0, camera.fv, camera.cv], [0.0, 0.0, 1.0]])
        direction = np.asarray(axis) / np.linalg.norm(axis)
        H = K @ so3_exp(np.radians(degrees) * direction) @ np.linalg.inv(K)

        def turned(frame: StereoFrame, left: Image, right: Image) -> Pair:
            if all_along or frame.time_ns >= period.begin_ns:
                right = np.asarray(cv2.warpPerspective(right, H, right.shape[::-1]), dtype=np.uint8)
            return left, right

        return _with_events(dataset, _with_pairs(turned))

    return variant


def _shaking_right(rng: np.random.Generator, degrees: float) -> Variant:
    """The right camera turns about its vertical axis by a random angle of its own in each frame."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        fu = dataset.recording.camera.fu

        def shaken(frame: StereoFrame, left: Image, right: Image) -> Pair:
            shift = np.array([[1.0, 0.0, fu * np.radians(rng.normal(0.0, degrees))], [0.0, 1.0, 0.0]])
            border = cv2.BORDER_REPLICATE
            return left, np.asarray(cv2.warpAffine(right, shift, right.shape[::-1], borderMode=border), dtype=np.uint8)

        return _with_events(dataset, _with_pairs(shaken))

    return variant


def _calibration(**factors: float) -> Variant:
    """Entries of the calibration off by factors."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        camera = dataset.recording.camera
        wrong = {name: getattr(camera, name) * factor for name, factor in factors.items()}
        return _with_events(dataset, iter, camera=replace(camera, **wrong))

    return variant


def _gap(*, frames: bool, samples: bool) -> Variant:
    """No frames or no samples during the fault's period."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        times_ns = dataset.recording.frame_times_ns
        kept = np.array([not (frames and period.holds(time_ns)) for time_ns in times_ns.tolist()])

        def silent(events: Iterable[Event]) -> Iterator[Event]:
            return (e for e in events if not (samples and isinstance(e, ImuSample) and period.holds(e.time_ns)))

        return _with_frames(dataset, kept, silent)

    return variant


def _repeated_tenth(dataset: Dataset, period: Period) -> Changed:
    """Every tenth pair is that of the frame before."""
    last: list[Pair] = []

    def repeated(frame: StereoFrame, *pair: Image) -> Pair:
        if frame.index % 10 != 0 or not last:
            last[:] = [(pair[0], pair[1])]
        return last[0]

    return _with_events(dataset, _with_pairs(repeated))


# --- faults of the IMU ------------------------------------------------------------------------------------------------


def _stuck(dataset: Dataset, period: Period) -> Changed:
    last: list[ImuSample] = []

    def stuck(sample: ImuSample) -> ImuSample:
        last.append(sample)
        return ImuSample(sample.time_ns, last[0].gyro, last[0].accel)

    return _samples(stuck, during=True)(dataset, period)


def _spikes(rng: np.random.Generator, share: float, gyro: float, accel: float) -> Variant:
    def spike(s: ImuSample) -> ImuSample:
        signs = rng.choice([-1.0, 1.0], (2, 3)) * (rng.random() < share)
        return ImuSample(s.time_ns, s.gyro + gyro * signs[0], s.accel + accel * signs[1])

    return _samples(spike)


def _restamped(shift_s: float, jitter_s: float = 0.0) -> Variant:
    """IMU stamps shifted, and scattered."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        def changed(events: Iterable[Event]) -> Iterator[Event]:
            held = list(events)
            old = np.array([e.time_ns for e in held if isinstance(e, ImuSample)], dtype=np.int64)
            scatter = np.random.default_rng(10).normal(shift_s, jitter_s, len(old)) / _NS
            new = np.sort(old + scatter.astype(np.int64)) if jitter_s else old + scatter.astype(np.int64)
            times = iter((np.maximum.accumulate(new - np.arange(len(new))) + np.arange(len(new))).tolist())
            moved = [replace(e, time_ns=next(times)) if isinstance(e, ImuSample) else e for e in held]
            yield from sorted(moved, key=lambda e: (e.time_ns, isinstance(e, StereoFrame)))

        return _with_events(dataset, changed)

    return variant


def _noisy_imu(rng: np.random.Generator, gyro: float, accel: float) -> SampleChange:
    return _imu(lambda g: g + rng.normal(0.0, gyro, 3), lambda a: a + rng.normal(0.0, accel, 3))


def _as_is(values: FloatArray) -> FloatArray:
    return values


def _plus(*bias: float) -> Callable[[FloatArray], FloatArray]:
    return lambda values: values + np.array(bias)


_ROT5 = so3_exp(np.radians(5.0) * np.ones(3) / np.sqrt(3.0))
_ZERO = _imu(np.zeros_like, np.zeros_like)

HEALTHY: dict[str, Variant] = {
    "clean": lambda dataset, period: _with_events(dataset, iter),
    "mirror": _mirror,
    "reverse": _reverse,
    "half": _half,
    "every 2nd": _every_second,
    "night": _seeded(lambda rng: _each(_night(rng))),
    "contrast 0.5": _each(_gain(0.5, 64.0)),
    "contrast 1.6": _each(_gain(1.6, -76.8)),
    "fog": _each(_gain(0.25, 118.0)),
    "blur": _each(partial(_blurred, sigma_px=2.0)),
    "JPEG 15": _each(_jpeg),
    "rain": _seeded(lambda rng: _each(_rain(rng))),
    "snow": _seeded(lambda rng: _each(_snow(rng))),
    "hood": _each(_hood),
    "dirty right": _pairs(lambda frame, left, right: (left, _dirty(right))),
    "right gain": _pairs(lambda frame, left, right: (left, _gain(0.55, 10.0)(right))),
    "swinging gains": _pairs(_swinging_gains),
    "jumping gains": _pairs(_jumping_gains),
    "random gains": _seeded(lambda rng: _pairs(_random_gains(rng))),
}
CAMERAS: dict[str, Variant] = {
    "right late": _late(1),
    "left late": _late(0),
    "right frozen": _frozen(1),
    "left frozen": _frozen(0),
    "both frozen": _frozen(0, 1),
    "exchanged 3 s": _while(lambda frame, left, right: (right, left)),
    "exchanged": _pairs(lambda frame, left, right: (right, left)),
    "black": _while(lambda frame, left, right: (np.zeros_like(left), np.zeros_like(right))),
    "object": _moving_object(6.0),
    "slow object": _moving_object(1.5),
    "right turned": _turned_right(1.0, (0.3, 1.0, 0.3), all_along=True),
    "right yaw later": _turned_right(1.0, (0.0, 1.0, 0.0), all_along=False),
    "right shaking": _seeded(lambda rng: _shaking_right(rng, 0.1)),
    "focal +5 %": _calibration(fu=1.05, fv=1.05),
    "baseline +10 %": _calibration(baseline_m=1.1),
    "every 10th repeated": _repeated_tenth,
    "no frames": _gap(frames=True, samples=False),
    "nothing": _gap(frames=True, samples=True),
}
IMU: dict[str, Variant] = {
    "zero": _samples(_ZERO, during=True),
    "zero always": _samples(_ZERO),
    "stuck": _stuck,
    "silent": _gap(frames=False, samples=True),
    "dead later": _samples(lambda sample: None, after=True),
    "spikes": _seeded(lambda rng: _spikes(rng, 0.01, 30.0, 100.0)),
    "small spikes": _seeded(lambda rng: _spikes(rng, 0.02, 1.0, 5.0)),
    "jitter 3 ms": _restamped(0.0, 3e-3),
    "50 ms early": _restamped(-0.05),
    "axes exchanged": _samples(_imu(lambda g: g[[1, 0, 2]], lambda a: a[[1, 0, 2]])),
    "gyro x inverted": _samples(_imu(lambda g: g * [-1, 1, 1], _as_is)),
    "accelerometer z inverted": _samples(_imu(_as_is, lambda a: a * [1, 1, -1])),
    "accelerometer in g": _samples(_imu(_as_is, lambda a: a / 9.80665)),
    "gyro in deg/s": _samples(_imu(np.degrees, _as_is)),
    "accelerometer bias": _samples(_imu(_as_is, _plus(0.7, 0.5, -0.5))),
    "gyro bias": _samples(_imu(_plus(0.2, -0.2, 0.1), _as_is)),
    "bias jump": _samples(_imu(_plus(0.1, -0.1, 0.05), _plus(0.5, 0.3, -0.3)), after=True),
    "gyro clipped": _samples(_imu(lambda g: np.clip(g, -0.3, 0.3), _as_is)),
    "vibration": _seeded(lambda rng: _samples(_noisy_imu(rng, 0.3, 5.0))),
    "turned 5 deg": _samples(_imu(lambda g: _ROT5 @ g, lambda a: _ROT5 @ a)),
    "scale 1.1": _samples(_imu(lambda g: 1.1 * g, lambda a: 1.1 * a)),
}
GROUPS = {"healthy": HEALTHY, "cameras": CAMERAS, "imu": IMU}


# --- runs and their table ---------------------------------------------------------------------------------------------


def run_variant(
    source: Path, group: str, name: str, motion: str, reference: Path | None, overrides: list[str], stop: int | None
) -> dict[str, Any]:
    """Run one variant of a recording, and return what the table shows of it."""
    dataset = open_dataset(source)
    recording = dataset.recording
    if reference is not None:
        recording = replace(recording, reference=read_trajectory(reference))
    times_ns = recording.frame_times_ns[:stop]
    begin_ns, end_ns = (int(times_ns[0] + share * (times_ns[-1] - times_ns[0])) for share in (_BEGIN, _END))
    cut = Changed(dataset, replace(recording, frame_times_ns=times_ns), _to_frame(stop))
    changed = GROUPS[group][name](cut, Period(begin_ns, min(end_ns, begin_ns + int(_LENGTH_S / _NS))))
    out: dict[str, Any] = {"recording": source.name, "motion": motion, "group": group, "variant": name}
    try:
        result = run(changed, load_config(overrides=[f"motion={motion}", *overrides]))
    except VioError as error:
        return out | {"error": f"{type(error).__name__}: {error}".replace(str(source), source.name)}
    return out | _figures(result)


def _to_frame(stop: int | None) -> EventChange:
    """Pass the events to before a frame, with the samples up to the last one."""

    def changed(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if stop is not None and isinstance(event, StereoFrame) and event.index >= stop:
                return
            yield event

    return changed


def _figures(result: RunResult) -> dict[str, Any]:
    covariance = np.array(result.estimates.column("covariance"))
    sigma_m = float(np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2).max()))
    matched, tracked = (np.array(result.frames.column(name)) for name in ("matched", "tracked"))
    out: dict[str, Any] = {
        "frames": len(result.estimates),
        "without_right": int(((matched == 0) & (tracked > 0)).sum()),
        "sigma_m": sigma_m,
        "said": list(result.warnings),
    }
    reference = result.recording.reference
    if reference is not None:
        evaluation = evaluate(result.trajectory, reference, T_cam0_imu=result.T_cam0_body)
        worst_m = evaluation.ate_m.max
        out |= {"ate_m": evaluation.ate_m.rmse, "ratio": worst_m / max(sigma_m, 1e-9)}
        out |= {"path_m": evaluation.reference_path_length_m}
    return out


_PAGE = """# Faults and healthy variants

Real recordings, changed in memory by `tools/faults.py`; ATE in millimetres after SE(3) alignment. This page is made by
`python tools/faults.py --table RUNS`, with the lines that its runs printed.

## Healthy variants

What a good rig may deliver: no check may act on it. The mirrored pair has exchanged cameras, so the path of the other
camera is estimated, and compared with its own truth. Numbers in brackets: lines that are said of the variant, but not
of the recording as it is.

{healthy}

## Faults

From 40 % of the recording on, for three seconds or to its last fifth, unless the name says otherwise. *Ratio*: largest
error over the largest stated standard deviation of a position; images alone, and short recordings with little motion,
state too little already without a fault. *Before*: an earlier revision. What was said is cut to its beginning.

{faults}
"""


def table(rows: list[dict[str, Any]], before: list[dict[str, Any]] | None = None) -> str:
    """Return the page of the docs, Markdown: healthy variants, and faults with the ATE of an earlier revision."""
    healthy = [row for row in rows if row["group"] == "healthy"]
    faults = [row for row in rows if row["group"] != "healthy"]
    return _PAGE.format(
        healthy="\n".join(_healthy_table(healthy)), faults="\n".join(_fault_table(faults, before or []))
    )


def _healthy_table(rows: list[dict[str, Any]]) -> list[str]:
    """ATE of each variant on each recording, with the lines that are said of it but not of the recording as it is."""
    heads = list(dict.fromkeys((row["recording"], row["motion"]) for row in rows))
    cells = {(row["recording"], row["motion"], row["variant"]): row for row in rows}
    lines = ["| variant | " + " | ".join(f"{name}, {motion}" for name, motion in heads) + " |"]
    lines.append("|---|" + "---|" * len(heads))
    notes: list[str] = []
    for variant in dict.fromkeys(row["variant"] for row in rows):
        shown = []
        for head in heads:
            row, clean = cells.get((*head, variant)), cells.get((*head, "clean"), {})
            extra = [] if row is None else _unlike(row.get("said", []), clean.get("said", []))
            extra = extra if row is None or "error" not in row else [row["error"]]
            marks = ""
            for line in extra:
                notes.append(f"{head[0]}, {head[1]}, {variant}: {line}")
                marks += f" [{len(notes)}]"
            shown.append("" if row is None else _millimetres(row) + marks)
        lines.append(f"| {variant} | " + " | ".join(shown) + " |")
    return [*lines, "", *(f"{k}. {note}" for k, note in enumerate(notes, 1))]


def _fault_table(rows: list[dict[str, Any]], before: list[dict[str, Any]]) -> list[str]:
    lines = ["| recording | fault | ATE mm before | now | ratio | said |", "|---|---|---|---|---|---|"]
    old = {_key(row): row for row in before}
    for row in rows:
        lines_said = [re.sub(r"^(frame \d+|gyro \w+|accelerometer \w+): ", "", line) for line in row.get("said", [])]
        said = row.get("error") or "; ".join(dict.fromkeys(re.split(r"[:;,] ", line)[0] for line in lines_said))
        ratio = f"{row['ratio']:.1f}" if "ratio" in row else ""
        name = f"{row['group']}: {row['variant']}"
        shown = f"{_millimetres(old.get(_key(row), {}))} | {_millimetres(row)}"
        lines.append(f"| {row['recording']}, {row['motion']} | {name} | {shown} | {ratio} | {said} |")
    return lines


def _key(row: dict[str, Any]) -> tuple[str, ...]:
    """What names a run."""
    return tuple(str(row[name]) for name in ("recording", "motion", "group", "variant"))


def _unlike(said: list[str], usual: list[str]) -> list[str]:
    """The lines that differ from the usual ones by more than numbers."""
    known = {re.sub(r"[\d.]+", "", line) for line in usual}
    return [line for line in said if re.sub(r"[\d.]+", "", line) not in known]


def _millimetres(row: dict[str, Any]) -> str:
    if "ate_m" not in row:
        return "–"
    error_mm = 1e3 * row["ate_m"]
    return f"{error_mm:.0f}" if error_mm >= 100 else f"{error_mm:.3g}"


def _lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def main() -> int:
    """Run what the command line names."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("recordings", nargs="*", help="folders, relative to VIO_DATA")
    parser.add_argument("--motion", default="auto")
    parser.add_argument("--variants", nargs="*", default=["healthy"], help="groups, or names of variants")
    parser.add_argument("--stop", type=int, help="frame after the last one")
    parser.add_argument("--reference", type=Path, help="trajectory, where the recording itself holds none")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--table", type=Path, help="print the tables of these lines")
    parser.add_argument("--before", type=Path, help="lines of an earlier revision, to compare with in the tables")
    options = parser.parse_args()
    if options.table is not None:
        print(table(_lines(options.table), [] if options.before is None else _lines(options.before)), end="")
        return 0
    logging.basicConfig(level=logging.ERROR)
    folder = Path(os.environ.get("VIO_DATA", "."))
    for name in options.recordings:
        for group, variants in GROUPS.items():
            for variant in variants:
                if group in options.variants or variant in options.variants:
                    row = run_variant(
                        folder / name,
                        group,
                        variant,
                        options.motion,
                        None if options.reference is None else folder / options.reference,
                        options.overrides,
                        options.stop,
                    )
                    print(json.dumps(row), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
