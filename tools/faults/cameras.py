"""Faults of the cameras."""

from __future__ import annotations

from collections import deque
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
    with_events,
)
from vio.geometry.lie import so3_exp
from vio.protocols import Dataset
from vio.records import Image, StereoFrame


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
    noise = np.random.default_rng(wall.seed).integers(0, 256, (1200, 6000)).astype(np.uint8)
    texture = blurred(noise, 3.0)
    texture = np.asarray(
        cv2.normalize(texture, texture.copy(), 20, 235, cv2.NORM_MINMAX), dtype=np.uint8
    )
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


def repeated_pairs(dataset: Dataset, period: Period, every: int = 10) -> PairChange:
    """Every pair of some number is that of the frame before."""
    last: list[Pair] = []

    def repeated(frame: StereoFrame, *pair: Image) -> Pair:
        if frame.index % every != 0 or not last:
            last[:] = [(pair[0], pair[1])]
        return last[0]

    return repeated


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
