"""Recordings with faults of camera and IMU, and healthy variants of them, made in memory;
`tools.faults` runs them.

A variant changes the events of a recording: the images after rectification, the samples of the IMU,
the stamps, the calibration. *Healthy* ones are what a good rig may deliver, so no check may act on
them. A *fault* lasts for a period, unless its name says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import cv2
import numpy as np

from vio.geometry.lie import FloatArray
from vio.protocols import Dataset
from vio.records import (
    BoolArray,
    Event,
    Image,
    ImuSample,
    IntArray,
    Observations,
    Recording,
    StereoFrame,
)

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
    kept: IntArray | None = None  # (F,) the source's frames; None: all

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        """Yield the changed events of some frames."""
        if self.kept is not None:
            start = int(self.kept[start])
            stop = None if stop is None else int(self.kept[stop - 1]) + 1
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


def with_events(dataset: Dataset, change: EventChange, **fields: Any) -> Changed:
    """All events changed, and fields of the recording."""
    return Changed(dataset, replace(dataset.recording, **fields), change)


def with_frames(dataset: Dataset, kept: BoolArray, change: EventChange = iter) -> Changed:
    """Only some frames (F,), numbered anew."""
    number = np.cumsum(kept) - 1

    def changed(events: Iterable[Event]) -> Iterator[Event]:
        for event in change(events):
            if not isinstance(event, StereoFrame):
                yield event
            elif kept[event.index]:
                yield replace(event, index=int(number[event.index]))

    recording = dataset.recording
    times_ns = recording.frame_times_ns[kept]
    return Changed(dataset, replace(recording, frame_times_ns=times_ns), changed, kept.nonzero()[0])


def with_pairs(change: PairChange) -> EventChange:
    """Change of events that changes their pairs of images."""

    def changed(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if (
                isinstance(event, StereoFrame)
                and event.left is not None
                and event.right is not None
            ):
                left, right = change(event, event.left, event.right)
                event = replace(
                    event, left=np.ascontiguousarray(left), right=np.ascontiguousarray(right)
                )
            yield event

    return changed


def pairs(make: Callable[..., PairChange], *args: Any, **options: Any) -> Variant:
    """The pairs changed by what `make(dataset, period, …)` returns for a recording."""
    return lambda dataset, period: with_events(
        dataset, with_pairs(make(dataset, period, *args, **options))
    )


def every_pair(change: PairChange) -> Variant:
    """Every pair changed."""
    return pairs(lambda dataset, period: change)


def every_image(change: Callable[[Image], Image]) -> Variant:
    """Every image changed by itself."""
    return every_pair(lambda frame, left, right: (change(left), change(right)))


def seeded(variant: Callable[[np.random.Generator], Variant]) -> Variant:
    """A variant with random numbers, the same ones in every run."""
    return lambda dataset, period: variant(np.random.default_rng(1))(dataset, period)


def pairs_during(change: PairChange) -> Variant:
    """The pairs of the fault's period changed."""
    return pairs(
        lambda dataset, period: (
            lambda frame, *pair: change(frame, *pair) if period.holds(frame.time_ns) else pair
        )
    )


def imu_samples(change: SampleChange, *, during: bool = False, after: bool = False) -> Variant:
    """IMU samples changed or, by None, lost: all of them, those during the fault's period, or
    all after its begin.
    """

    def variant(dataset: Dataset, period: Period) -> Changed:
        def affected(time_ns: int) -> bool:
            return period.holds(time_ns) if during else not after or time_ns >= period.begin_ns

        def changed(events: Iterable[Event]) -> Iterator[Event]:
            for event in events:
                new = (
                    change(event)
                    if isinstance(event, ImuSample) and affected(event.time_ns)
                    else event
                )
                if new is not None:
                    yield new

        return with_events(dataset, changed)

    return variant


def imu_readings(
    gyro: Callable[[FloatArray], FloatArray], accel: Callable[[FloatArray], FloatArray]
) -> SampleChange:
    """Change of both readings of a sample."""
    return lambda s: ImuSample(s.time_ns, gyro(s.gyro), accel(s.accel))


def to_gray(image: FloatArray) -> Image:
    """Round and clip to 8 bits."""
    return np.asarray(np.clip(np.rint(image), 0, 255), dtype=np.uint8)


def with_gain(gain: float, offset: float = 0.0) -> Callable[[Image], Image]:
    """Change of an image by gain and offset."""
    return lambda image: to_gray(gain * np.asarray(image, dtype=np.float64) + offset)


def blurred(image: Image, sigma_px: float) -> Image:
    """An image after a Gaussian filter."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), dtype=np.uint8)


def gap(*, frames: bool, samples: bool) -> Variant:
    """No frames or no samples during the fault's period."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        times_ns = dataset.recording.frame_times_ns
        kept = np.array([not (frames and period.holds(time_ns)) for time_ns in times_ns.tolist()])

        def silent(events: Iterable[Event]) -> Iterator[Event]:
            return (
                e
                for e in events
                if not (samples and isinstance(e, ImuSample) and period.holds(e.time_ns))
            )

        return with_frames(dataset, kept, silent)

    return variant
