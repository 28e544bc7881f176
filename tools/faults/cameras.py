"""Faults of the cameras."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tools.faults.changes import (
    Changed,
    Pair,
    PairChange,
    Period,
    Variant,
    blurred,
    every_pair,
    gap,
    pairs,
    pairs_during,
    to_gray,
    with_events,
    with_frames,
)
from vio.geometry.lie import so3_exp
from vio.protocols import Dataset
from vio.records import Event, Image, ImuSample, StereoFrame


def late_images(dataset: Dataset, period: Period, late: int, frames: int = 1) -> PairChange:
    """One camera's image (0: left) is that of some frames before, all the time."""
    earlier: deque[Image] = deque(maxlen=frames)

    def delayed(frame: StereoFrame, *pair: Image) -> Pair:
        before = earlier[0] if earlier else pair[late]
        earlier.append(pair[late])
        return (before, pair[1]) if late == 0 else (pair[0], before)

    return delayed


def frozen_images(dataset: Dataset, period: Period, *cameras: int) -> PairChange:
    """The image of some cameras stays what it was before the fault."""
    held: dict[int, Image] = {}

    def frozen(frame: StereoFrame, *pair: Image) -> Pair:
        if not period.holds(frame.time_ns):
            held.update(enumerate(pair))
            return pair[0], pair[1]
        left, right = (held.get(k, pair[k]) if k in cameras else pair[k] for k in range(2))
        return left, right

    return frozen


@dataclass(frozen=True, slots=True)
class Wall:
    """A textured wall before the cameras that moves sideways."""

    speed_px: float  # a frame
    share: float = 0.5  # of the image's width
    begin: float = 0.25  # its left edge in the left image, share of the width
    disparity_px: int = 30
    seed: int = 7  # of its texture


def moving_object(dataset: Dataset, period: Period, wall: Wall) -> PairChange:
    """A wall covers a part of both images during the fault's period."""
    texture = _texture(np.random.default_rng(wall.seed), 1200)
    first: list[int] = []

    def covered(frame: StereoFrame, left: Image, right: Image) -> Pair:
        if not period.holds(frame.time_ns):
            return left, right
        first.append(frame.index)
        height, width = left.shape
        at = 1000 + round(wall.speed_px * (frame.index - first[0]))
        columns = round(wall.share * width)
        begin = round(wall.begin * width)
        left = left.copy()
        right = right.copy()
        for image, column in ((left, begin), (right, begin - wall.disparity_px)):
            seen = slice(max(column, 0), max(column + columns, 0))
            image[:, seen] = texture[:height, at + seen.start - column : at + seen.stop - column]
        return left, right

    return covered


@dataclass(frozen=True, slots=True)
class Cover:
    """Something near that slides into the view, stays with the rig, and slides out again."""

    share: float  # of the image, once it is there
    frames: int  # that it slides for
    disparity_px: int = 40
    axis: int = 1  # slides along columns (1) or rows (0)
    sway_px: float = 0.0  # standard deviation of its place, in a frame
    seed: int = 7  # of its texture


def covering_object(dataset: Dataset, period: Period, cover: Cover) -> PairChange:
    """Something covers most of both images and moves with the rig during the fault's period."""
    rng = np.random.default_rng(cover.seed)
    texture = _texture(rng, 4000)
    at = 0  # how far it is in, in frames

    def covered(frame: StereoFrame, left: Image, right: Image) -> Pair:
        nonlocal at
        at = min(at + 1, cover.frames) if period.holds(frame.time_ns) else max(at - 1, 0)
        if at == 0:
            return left, right
        size = left.shape[cover.axis]
        seen = round(cover.share * size * at / cover.frames)
        sway = np.rint(rng.normal(0.0, 1.0, 2) * cover.sway_px).astype(np.int64)
        out = []
        for k, image in enumerate((left, right)):
            # it comes from the end of the rows, or from below
            height, width = image.shape
            row = 2000 + int(sway[1])
            column = 3000 + int(sway[0]) + k * cover.disparity_px
            hidden = np.zeros(image.shape, dtype=np.bool_)
            if cover.axis == 1:
                column += seen - size
                hidden[:, max(size - seen - k * cover.disparity_px, 0) :] = True
            else:
                row += seen - size
                hidden[size - seen :] = True
            wall = texture[row : row + height, column : column + width]
            noisy = to_gray(wall + rng.normal(0.0, 2.0, image.shape))
            out.append(np.where(hidden, noisy, image))
        return out[0], out[1]

    return covered


def _texture(rng: np.random.Generator, rows: int) -> Image:
    """A texture of blurred noise, wider than images."""
    noise = rng.integers(0, 256, (rows, 6000)).astype(np.uint8)
    texture = blurred(noise, 3.0)
    return np.asarray(
        cv2.normalize(texture, texture.copy(), 20, 235, cv2.NORM_MINMAX), dtype=np.uint8
    )


def torn_images(
    dataset: Dataset, period: Period, every: int, share: float, *cameras: int
) -> PairChange:
    """The upper part of every some image of some cameras is that of the frame before."""
    before: list[Pair] = []

    def torn(frame: StereoFrame, *pair: Image) -> Pair:
        out = list(pair)
        if before and period.holds(frame.time_ns) and frame.index % every == 0:
            for k in cameras:
                rows = round(share * len(pair[k]))
                out[k] = np.concatenate([before[0][k][:rows], pair[k][rows:]])
        before[:] = [(pair[0], pair[1])]
        return out[0], out[1]

    return torn


def cut(*, samples: bool) -> Variant:
    """The frames of the fault's period are left out, and the stamps go on as if they had not been;
    `samples`: those of the IMU, too.
    """

    def variant(dataset: Dataset, period: Period) -> Changed:
        recording = dataset.recording
        times_ns = recording.frame_times_ns
        inside = np.array([period.holds(time_ns) for time_ns in times_ns.tolist()])
        # a whole number of frames is missing
        gone_ns = int(times_ns[inside][-1] - times_ns[inside][0]) + int(
            np.median(np.diff(times_ns))
        )
        end_ns = int(times_ns[inside][0]) + gone_ns

        def now_ns(time_ns: int) -> int:
            return time_ns if time_ns < end_ns else time_ns - gone_ns

        def shifted(events: Iterable[Event]) -> Iterator[Event]:
            moved = []
            for event in events:
                of_imu = isinstance(event, ImuSample)
                if of_imu and not samples:
                    moved.append(event)
                elif not (of_imu and period.begin_ns <= event.time_ns < end_ns):
                    moved.append(replace(event, time_ns=now_ns(event.time_ns)))
            yield from sorted(moved, key=lambda e: (e.time_ns, isinstance(e, StereoFrame)))

        reference = recording.reference
        if reference is not None and reference.times_ns is not None:
            left = (reference.times_ns < period.begin_ns) | (reference.times_ns >= end_ns)
            stamps = np.array([now_ns(t) for t in reference.times_ns[left].tolist()])
            reference = replace(
                reference,
                T_world_body=reference.T_world_body[left],
                times_ns=stamps,
                frame_indices=None,
            )
        stamps = np.array([now_ns(t) for t in times_ns[~inside].tolist()])
        changed = with_frames(dataset, ~inside, shifted)
        recording = replace(changed.recording, frame_times_ns=stamps, reference=reference)
        return replace(changed, recording=recording)

    return variant


def turned_right(
    dataset: Dataset,
    period: Period,
    degrees: float,
    axis: tuple[float, float, float],
    *,
    all_along: bool,
) -> PairChange:
    """The right camera is turned in its mount, from the start or from the fault's begin on."""
    camera = dataset.recording.camera
    K = np.array([[camera.fu, 0.0, camera.cu], [0.0, camera.fv, camera.cv], [0.0, 0.0, 1.0]])
    direction = np.asarray(axis) / np.linalg.norm(axis)
    H = K @ so3_exp(np.radians(degrees) * direction) @ np.linalg.inv(K)

    def turned(frame: StereoFrame, left: Image, right: Image) -> Pair:
        if all_along or frame.time_ns >= period.begin_ns:
            right = np.asarray(cv2.warpPerspective(right, H, right.shape[::-1]), dtype=np.uint8)
        return left, right

    return turned


def shaking_right(dataset: Dataset, period: Period, degrees: float) -> PairChange:
    """The right camera turns about its vertical axis by a random angle of its own in each frame."""
    fu = dataset.recording.camera.fu
    rng = np.random.default_rng(1)

    def shaken(frame: StereoFrame, left: Image, right: Image) -> Pair:
        shift = np.array([[1.0, 0.0, fu * np.radians(rng.normal(0.0, degrees))], [0.0, 1.0, 0.0]])
        border = cv2.BORDER_REPLICATE
        return left, np.asarray(
            cv2.warpAffine(right, shift, right.shape[::-1], borderMode=border), dtype=np.uint8
        )

    return shaken


def repeated_pairs(
    dataset: Dataset, period: Period, every: int = 10, noise: float = 0.0
) -> PairChange:
    """Every pair of some number is that of the frame before, with new noise in gray levels."""
    last: list[Pair] = []
    rng = np.random.default_rng(1)

    def repeated(frame: StereoFrame, *pair: Image) -> Pair:
        if frame.index % every != 0 or not last:
            last[:] = [(pair[0], pair[1])]
            return last[0]
        if noise == 0.0:
            return last[0]
        left, right = (to_gray(image + rng.normal(0.0, noise, image.shape)) for image in last[0])
        return left, right

    return repeated


def reordered(count: int) -> Variant:
    """In each block of so many frames from the fault's begin on, the images come in the opposite
    order.
    """

    def variant(dataset: Dataset, period: Period) -> Changed:
        def changed(events: Iterable[Event]) -> Iterator[Event]:
            block: list[Event] = []
            frames: list[int] = []  # where they are in the block
            for event in events:
                if not (isinstance(event, StereoFrame) and event.time_ns >= period.begin_ns):
                    block.append(event)
                    continue
                frames.append(len(block))
                block.append(event)
                if len(frames) == count:
                    yield from _backwards(block, frames)
                    block.clear()
                    frames.clear()
            yield from block

        return with_events(dataset, changed)

    return variant


def _backwards(block: list[Event], frames: list[int]) -> list[Event]:
    """Events, of which some are frames, with the images of these in the opposite order."""
    out = list(block)
    for to, of in zip(frames, reversed(frames), strict=True):
        frame = block[to]
        shown = block[of]
        assert isinstance(frame, StereoFrame)
        assert isinstance(shown, StereoFrame)
        out[to] = replace(frame, left=shown.left, right=shown.right)
    return out


def wrong_calibration(**factors: float) -> Variant:
    """Entries of the calibration off by factors."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        camera = dataset.recording.camera
        wrong = {name: getattr(camera, name) * factor for name, factor in factors.items()}
        return with_events(dataset, iter, camera=replace(camera, **wrong))

    return variant


CAMERAS: dict[str, Variant] = {
    "right late": pairs(late_images, 1),
    "left late": pairs(late_images, 0),
    "right frozen": pairs(frozen_images, 1),
    "left frozen": pairs(frozen_images, 0),
    "both frozen": pairs(frozen_images, 0, 1),
    "exchanged 3 s": pairs_during(lambda frame, left, right: (right, left)),
    "exchanged": every_pair(lambda frame, left, right: (right, left)),
    "black": pairs_during(lambda frame, left, right: (np.zeros_like(left), np.zeros_like(right))),
    "object": pairs(moving_object, Wall(6.0)),
    "slow object": pairs(moving_object, Wall(1.5)),
    "right turned": pairs(turned_right, 1.0, (0.3, 1.0, 0.3), all_along=True),
    "right yaw later": pairs(turned_right, 1.0, (0.0, 1.0, 0.0), all_along=False),
    "right shaking": pairs(shaking_right, 0.1),
    "focal +5 %": wrong_calibration(fu=1.05, fv=1.05),
    "baseline +10 %": wrong_calibration(baseline_m=1.1),
    "every 10th repeated": pairs(repeated_pairs),
    "no frames": gap(frames=True, samples=False),
    "nothing": gap(frames=True, samples=True),
}
