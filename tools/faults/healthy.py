"""What a good rig may deliver: no check may act on it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from tools.faults.changes import (
    Changed,
    Pair,
    Period,
    Variant,
    blurred,
    every_image,
    every_pair,
    imu_readings,
    seeded,
    to_gray,
    with_events,
    with_frames,
    with_gain,
    with_pairs,
)
from vio.geometry.lie import se3_from_parts, se3_inverse
from vio.protocols import Dataset
from vio.records import Event, Image, ImuSample, StereoFrame

_MIRROR = np.diag([-1.0, 1.0, 1.0])


def _mirror(dataset: Dataset, period: Period) -> Changed:
    """Both images mirrored and exchanged; the path of the mirrored right camera is the
    reference.
    """
    recording = dataset.recording
    camera = recording.camera
    T_cam0_imu = recording.T_cam0_imu
    reference = recording.reference
    assert camera.width is not None
    T_cam1_cam0 = se3_from_parts(np.eye(3), np.array([-camera.baseline_m, 0.0, 0.0]))
    M = se3_from_parts(_MIRROR, np.zeros(3))
    T_new = None if T_cam0_imu is None else M @ T_cam1_cam0 @ T_cam0_imu @ M
    if reference is not None:
        T_body_new = np.eye(4) if reference.body == "imu" else se3_inverse(T_cam1_cam0)
        reference = replace(reference, T_world_body=M @ reference.T_world_body @ T_body_new @ M)

    def changed(events: Iterable[Event]) -> Iterator[Event]:
        exchange = with_pairs(lambda frame, left, right: (right[:, ::-1], left[:, ::-1]))
        # axial and polar vectors
        sample = imu_readings(lambda gyro: -_MIRROR @ gyro, lambda accel: _MIRROR @ accel)
        for event in exchange(events):
            yield sample(event) or event if isinstance(event, ImuSample) else event

    other = replace(camera, cu=camera.width - 1 - camera.cu)
    return with_events(dataset, changed, camera=other, T_cam0_imu=T_new, reference=reference)


@dataclass(frozen=True, slots=True)
class _Backward(Changed):
    """A recording from its end: the first frames are the source's last ones."""

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        """Yield the changed events of some frames, numbered from the end."""
        count = len(self.recording.frame_times_ns)
        end = count if stop is None else min(stop, count)
        return self.change(self.source.events(count - end, count - start, images=images))


def _reverse(dataset: Dataset, period: Period) -> Changed:
    """From the end to the start: velocities and rates change their sign, accelerations do not."""
    recording = dataset.recording
    times_ns = recording.frame_times_ns
    reference = recording.reference
    both_ends = int(times_ns[0] + times_ns[-1])
    last = len(times_ns) - 1
    if reference is not None:
        reference = reference.numbered()
        times = reference.times_ns
        frames = reference.frame_indices
        reference = replace(
            reference,
            T_world_body=reference.T_world_body[::-1],
            times_ns=None if times is None else both_ends - times[::-1],
            frame_indices=None if frames is None else last - frames[::-1],
        )

    def changed(events: Iterable[Event]) -> Iterator[Event]:
        held = list(events)
        for event in sorted(
            held, key=lambda event: (-event.time_ns, isinstance(event, StereoFrame))
        ):
            if isinstance(event, ImuSample):
                yield ImuSample(both_ends - event.time_ns, -event.gyro, event.accel)
            elif isinstance(event, StereoFrame):
                yield replace(event, index=last - event.index, time_ns=both_ends - event.time_ns)

    other = replace(recording, frame_times_ns=both_ends - times_ns[::-1], reference=reference)
    return _Backward(dataset, other, changed)


def _half(dataset: Dataset, period: Period) -> Changed:
    """Images of half the size, with their calibration."""
    camera = dataset.recording.camera
    assert camera.width is not None
    assert camera.height is not None
    width = camera.width // 2
    height = camera.height // 2

    def smaller(image: Image) -> Image:
        whole = image[: 2 * height, : 2 * width]
        return np.asarray(
            cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )

    other = replace(
        camera,
        fu=camera.fu / 2,
        fv=camera.fv / 2,
        cu=(camera.cu + 0.5) / 2 - 0.5,
        cv=(camera.cv + 0.5) / 2 - 0.5,
        width=width,
        height=height,
    )
    return with_events(
        dataset, with_pairs(lambda frame, *pair: (smaller(pair[0]), smaller(pair[1]))), camera=other
    )


def _every_second(dataset: Dataset, period: Period) -> Changed:
    return with_frames(dataset, np.arange(len(dataset.recording.frame_times_ns)) % 2 == 0)


def _night(rng: np.random.Generator, image: Image) -> Image:
    return to_gray(0.3 * image + rng.normal(0.0, 3.0, image.shape))


def _rain(rng: np.random.Generator, image: Image) -> Image:
    out = image.copy()
    for u, v, du, dv, gray in _places(rng, image, 250, [(-2, 3), (4, 16), (180, 256)]):
        cv2.line(out, (u, v), (u + du, v + dv), gray)
    return out


def _snow(rng: np.random.Generator, image: Image) -> Image:
    out = image.copy()
    for u, v, radius, gray in _places(rng, image, 150, [(1, 5), (200, 256)]):
        cv2.circle(out, (u, v), radius, gray, -1)
    return out


def _places(
    rng: np.random.Generator, image: Image, count: int, ranges: list[tuple[int, int]]
) -> list[list[int]]:
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
    return to_gray(image * (1 - spot) + blurred(image, 6.0) * spot)


def _swinging_gains(frame: StereoFrame, left: Image, right: Image) -> Pair:
    phase = 0.35 * frame.index
    return with_gain(1 + 0.3 * np.sin(phase))(left), with_gain(1 + 0.3 * np.sin(phase + 1.0))(right)


def _jumping_gains(frame: StereoFrame, left: Image, right: Image) -> Pair:
    gains = (1.0 if (frame.index + later) // 7 % 2 else 0.5 for later in (0, 3))
    return with_gain(next(gains))(left), with_gain(next(gains))(right)


def _random_gains(rng: np.random.Generator, frame: StereoFrame, left: Image, right: Image) -> Pair:
    return with_gain(rng.uniform(0.35, 1.4))(left), with_gain(rng.uniform(0.35, 1.4))(right)


HEALTHY: dict[str, Variant] = {
    "clean": lambda dataset, period: with_events(dataset, iter),
    "mirror": _mirror,
    "reverse": _reverse,
    "half": _half,
    "every 2nd": _every_second,
    "night": seeded(lambda rng: every_image(partial(_night, rng))),
    "contrast 0.5": every_image(with_gain(0.5, 64.0)),
    "contrast 1.6": every_image(with_gain(1.6, -76.8)),
    "fog": every_image(with_gain(0.25, 118.0)),
    "blur": every_image(partial(blurred, sigma_px=2.0)),
    "JPEG 15": every_image(_jpeg),
    "rain": seeded(lambda rng: every_image(partial(_rain, rng))),
    "snow": seeded(lambda rng: every_image(partial(_snow, rng))),
    "hood": every_image(_hood),
    "dirty right": every_pair(lambda frame, left, right: (left, _dirty(right))),
    "right gain": every_pair(lambda frame, left, right: (left, with_gain(0.55, 10.0)(right))),
    "swinging gains": every_pair(_swinging_gains),
    "jumping gains": every_pair(_jumping_gains),
    "random gains": seeded(lambda rng: every_pair(partial(_random_gains, rng))),
}
