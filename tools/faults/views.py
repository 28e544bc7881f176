"""Faults of the view: exposure, and what is on a lens or before it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tools.faults.changes import Pair, PairChange, Period, blurred, to_gray
from vio.geometry.lie import FloatArray
from vio.protocols import Dataset
from vio.records import S_PER_NS, Image, StereoFrame

_NOISE = 2.0  # gray levels, standard deviation, of what is drawn into images
_DIRT_GRAY = 40.0


def exposure_steps(
    dataset: Dataset, period: Period, stops: float, every: int, *cameras: int
) -> PairChange:
    """The exposure of some cameras steps up and down by `stops` in all, every some frames."""
    rng = np.random.default_rng(1)

    def stepped(frame: StereoFrame, *pair: Image) -> Pair:
        out = list(pair)
        if period.holds(frame.time_ns):
            gain = 2.0 ** (stops * (-0.75, -0.25, 0.25, -0.25)[frame.index // every % 4])
            for k in cameras:
                out[k] = to_gray(gain * out[k] + rng.normal(0.0, _NOISE, out[k].shape))
        return out[0], out[1]

    return stepped


def dirt(
    dataset: Dataset, period: Period, count: int, radius: float, *cameras: int, seed: int = 1
) -> PairChange:
    """Dark grains stay at the same pixels of some cameras; radii are shares of the height."""
    rng = np.random.default_rng(seed)
    masks: dict[int, FloatArray] = {}

    def dirty(frame: StereoFrame, *pair: Image) -> Pair:
        out = list(pair)
        for k in cameras:
            if k not in masks:
                masks[k] = 0.9 * _grains(rng, out[k].shape, count, radius)
            if period.holds(frame.time_ns):
                out[k] = to_gray(out[k] * (1 - masks[k]) + _DIRT_GRAY * masks[k])
        return out[0], out[1]

    return dirty


def _grains(
    rng: np.random.Generator, shape: tuple[int, ...], count: int, radius: float
) -> FloatArray:
    """Soft grains of an image, 0 to 1."""
    mask = np.zeros(shape, dtype=np.float32)
    for _ in range(count):
        at = (int(rng.integers(shape[1])), int(rng.integers(shape[0])))
        width, height = (rng.uniform(0.5, 1.3, 2) * radius * shape[0]).astype(np.int64).tolist()
        turn = float(rng.uniform(0.0, 180.0))
        cv2.ellipse(mask, at, (width, height), turn, 0, 360, 1.0, -1)
    return np.asarray(cv2.GaussianBlur(mask, (0, 0), 2.0), dtype=np.float64)


def drops(
    dataset: Dataset, period: Period, count: int, radius: float, *cameras: int, seed: int = 1
) -> PairChange:
    """Drops stay on some lenses: each shows a part of the view upside down and small."""
    rng = np.random.default_rng(seed)
    places: dict[int, list[tuple[int, int, int]]] = {}

    def wet(frame: StereoFrame, *pair: Image) -> Pair:
        out = list(pair)
        height, width = pair[0].shape
        for k in cameras:
            if k not in places:
                radii = (3 + radius * height * rng.uniform(0.6, 1.4, count)).astype(np.int64)
                places[k] = [
                    (int(rng.integers(r, width - r)), int(rng.integers(r, height - r)), r)
                    for r in radii.tolist()
                ]
            if period.holds(frame.time_ns):
                out[k] = _through_drops(out[k], places[k])
        return out[0], out[1]

    return wet


def _through_drops(image: Image, places: list[tuple[int, int, int]]) -> Image:
    """An image with drops of some centres and radii."""
    out = image.copy()
    height, width = image.shape
    for u, v, radius in places:
        size = 2 * radius + 1
        left = int(np.clip(u - 2 * size, 0, width - 4 * size))
        top = int(np.clip(v - size, 0, height - 2 * size))
        seen = image[top : top + 2 * size, left : left + 4 * size][::-1, ::-1]
        small = cv2.resize(seen, (size, size), interpolation=cv2.INTER_AREA)
        mask = np.zeros((size, size), dtype=np.float32)
        cv2.circle(mask, (radius, radius), radius - 1, 1.0, -1)
        mask = np.asarray(cv2.GaussianBlur(mask, (0, 0), 1.0), dtype=np.float32)
        place = out[v - radius : v + radius + 1, u - radius : u + radius + 1]
        place[:] = to_gray(place * (1 - mask) + small * mask)
    return out


@dataclass(frozen=True, slots=True)
class Arm:
    """A textured part of the rig at the lower edge of both images."""

    share: float  # of the height
    sway_px: float = 0.0  # how far it moves to each side
    sway_frames: float = 75.0  # in which it comes back
    disparity_px: int = 40
    seed: int = 5  # of its texture


def robot_arm(dataset: Dataset, period: Period, arm: Arm) -> PairChange:
    """An arm of the rig is in view, and still or moving by itself."""
    rng = np.random.default_rng(arm.seed)
    texture = _texture(rng, 3000)

    def held(frame: StereoFrame, *pair: Image) -> Pair:
        if not period.holds(frame.time_ns):
            return pair[0], pair[1]
        phase = 2.0 * np.pi * frame.index / arm.sway_frames
        aside = round(arm.sway_px * np.sin(phase))
        up = round(0.5 * arm.sway_px * np.sin(1.7 * phase))
        out = []
        for k, image in enumerate(pair):
            rows = round(arm.share * len(image)) - up
            begin = 1000 + aside + k * arm.disparity_px
            seen = texture[500 : 500 + rows, begin : begin + image.shape[1]]
            changed = image.copy()
            changed[len(image) - rows :] = to_gray(seen + rng.normal(0.0, _NOISE, seen.shape))
            out.append(changed)
        return out[0], out[1]

    return held


def reflection(
    dataset: Dataset,
    period: Period,
    strength: float,
    speed_px: float,
    disparity_px: int = 15,
    seed: int = 6,
) -> PairChange:
    """A second image on a windscreen, which stays in its place or moves by itself, in pixels a
    frame.
    """
    texture = 3.0 * np.maximum(_texture(np.random.default_rng(seed), 2500) - 120.0, 0.0)

    def reflected(frame: StereoFrame, *pair: Image) -> Pair:
        if not period.holds(frame.time_ns):
            return pair[0], pair[1]
        out = []
        for k, image in enumerate(pair):
            height, width = image.shape
            begin = 1500 + round(speed_px * frame.index) + k * disparity_px
            second = texture[300 : 300 + height, begin : begin + width]
            out.append(to_gray(image * (1 - 0.3 * strength) + strength * second))
        return out[0], out[1]

    return reflected


def _texture(rng: np.random.Generator, rows: int) -> FloatArray:
    """Gray levels of blurred noise, wider than images."""
    noise = rng.normal(0.0, 1.0, (rows, 6000)).astype(np.float32)
    texture = np.asarray(cv2.GaussianBlur(noise, (0, 0), 3.0), dtype=np.float64)
    return np.asarray(120.0 + 45.0 * texture / texture.std(), dtype=np.float64)


def losing_focus(
    dataset: Dataset, period: Period, camera: int, sigma_px: float, frames: int
) -> PairChange:
    """One camera loses its focus over some frames, and finds it again after the fault's period."""
    at = 0

    def unsharp(frame: StereoFrame, *pair: Image) -> Pair:
        nonlocal at
        at = min(at + 1, frames) if period.holds(frame.time_ns) else max(at - 1, 0)
        out = list(pair)
        if at:
            out[camera] = blurred(out[camera], sigma_px * at / frames)
        return out[0], out[1]

    return unsharp


def mirror(
    dataset: Dataset, period: Period, begin: float, share: float, disparity_px: int
) -> PairChange:
    """A mirror covers some columns of both images, from a share of the width on: it shows the view
    from right to left.
    """

    def mirrored(frame: StereoFrame, *pair: Image) -> Pair:
        if not period.holds(frame.time_ns):
            return pair[0], pair[1]
        out = []
        for k, image in enumerate(pair):
            width = image.shape[1]
            near_px = k * disparity_px // 3  # the frame of the mirror is nearer than what it shows
            columns = np.arange(round(begin * width), round((begin + share) * width)) - near_px
            columns = columns[(columns >= 0) & (columns < width)]
            seen = np.clip(width - 1 - columns - k * disparity_px, 0, width - 1)
            changed = image.copy()
            changed[:, columns] = image[:, seen]
            out.append(changed)
        return out[0], out[1]

    return mirrored


def zoom(
    dataset: Dataset, period: Period, growth: float, seconds: float, *cameras: int
) -> PairChange:
    """The focal length of some cameras grows by a share over some seconds, and stays so."""
    camera = dataset.recording.camera

    def zoomed(frame: StereoFrame, *pair: Image) -> Pair:
        out = list(pair)
        passed = np.clip((frame.time_ns - period.begin_ns) * S_PER_NS / seconds, 0.0, 1.0)
        scale = 1.0 + growth * float(passed)
        moved = np.array(
            [[scale, 0.0, camera.cu * (1.0 - scale)], [0.0, scale, camera.cv * (1.0 - scale)]]
        )
        for k in cameras:
            if passed > 0.0:
                size = out[k].shape[::-1]
                border = cv2.BORDER_REPLICATE
                warped = cv2.warpAffine(out[k], moved, size, borderMode=border)
                out[k] = np.asarray(warped, dtype=np.uint8)
        return out[0], out[1]

    return zoomed
