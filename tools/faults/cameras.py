"""Faults of the cameras."""

from __future__ import annotations

from dataclasses import replace

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


def _late(dataset: Dataset, period: Period, late: int) -> PairChange:
    """One camera's image (0: left) is that of the frame before, all the time."""
    last: list[Image] = []

    def delayed(frame: StereoFrame, *pair: Image) -> Pair:
        before = last.pop() if last else pair[late]
        last.append(pair[late])
        return (before, pair[1]) if late == 0 else (pair[0], before)

    return delayed


def _frozen(dataset: Dataset, period: Period, *cameras: int) -> PairChange:
    """The image of some cameras stays what it was before the fault."""
    held: dict[int, Image] = {}

    def frozen(frame: StereoFrame, *pair: Image) -> Pair:
        if not period.holds(frame.time_ns):
            held.update(enumerate(pair))
            return pair[0], pair[1]
        left, right = (held.get(k, pair[k]) if k in cameras else pair[k] for k in range(2))
        return left, right

    return frozen


def _moving_object(dataset: Dataset, period: Period, speed_px: float) -> PairChange:
    """A textured wall that covers the middle half of both images and moves sideways, pixels a
    frame.
    """
    disparity_px = 30
    texture = blurred(np.random.default_rng(7).integers(0, 256, (1200, 6000)).astype(np.uint8), 3.0)
    texture = np.asarray(
        cv2.normalize(texture, texture.copy(), 20, 235, cv2.NORM_MINMAX), dtype=np.uint8
    )
    first: list[int] = []

    def covered(frame: StereoFrame, left: Image, right: Image) -> Pair:
        if not period.holds(frame.time_ns):
            return left, right
        first.append(frame.index)
        height, width = left.shape
        at = 1000 + round(speed_px * (frame.index - first[0]))
        wall = texture[:height, at : at + width // 2]
        left = left.copy()
        right = right.copy()
        for image, begin in ((left, width // 4), (right, width // 4 - disparity_px)):
            image[:, begin : begin + width // 2] = wall
        return left, right

    return covered


def _turned_right(
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


def _shaking_right(dataset: Dataset, period: Period, degrees: float) -> PairChange:
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


def _repeated_tenth(dataset: Dataset, period: Period) -> PairChange:
    """Every tenth pair is that of the frame before."""
    last: list[Pair] = []

    def repeated(frame: StereoFrame, *pair: Image) -> Pair:
        if frame.index % 10 != 0 or not last:
            last[:] = [(pair[0], pair[1])]
        return last[0]

    return repeated


def _calibration(**factors: float) -> Variant:
    """Entries of the calibration off by factors."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        camera = dataset.recording.camera
        wrong = {name: getattr(camera, name) * factor for name, factor in factors.items()}
        return with_events(dataset, iter, camera=replace(camera, **wrong))

    return variant


CAMERAS: dict[str, Variant] = {
    "right late": pairs(_late, 1),
    "left late": pairs(_late, 0),
    "right frozen": pairs(_frozen, 1),
    "left frozen": pairs(_frozen, 0),
    "both frozen": pairs(_frozen, 0, 1),
    "exchanged 3 s": pairs_during(lambda frame, left, right: (right, left)),
    "exchanged": every_pair(lambda frame, left, right: (right, left)),
    "black": pairs_during(lambda frame, left, right: (np.zeros_like(left), np.zeros_like(right))),
    "object": pairs(_moving_object, 6.0),
    "slow object": pairs(_moving_object, 1.5),
    "right turned": pairs(_turned_right, 1.0, (0.3, 1.0, 0.3), all_along=True),
    "right yaw later": pairs(_turned_right, 1.0, (0.0, 1.0, 0.0), all_along=False),
    "right shaking": pairs(_shaking_right, 0.1),
    "focal +5 %": _calibration(fu=1.05, fv=1.05),
    "baseline +10 %": _calibration(baseline_m=1.1),
    "every 10th repeated": pairs(_repeated_tenth),
    "no frames": gap(frames=True, samples=False),
    "nothing": gap(frames=True, samples=True),
}
