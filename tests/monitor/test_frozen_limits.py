"""Each limit of what tells a repeated pair from a rig at standstill, from both sides."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.guard.test_frozen_images import (
    IDS,
    LEFT,
    RIGHT,
    STEP_NS,
    Z,
    _expected,
    _frame,
    _noisy,
    _shifted,
    _watching,
)
from vio.monitor.frozen import IMAGES, FrozenImages, Repeated, RepeatReport
from vio.records import Image, observations

Says = Callable[[float], bool]


def _nearly_equal(
    px: float = 2.0, off_px: float = 0.1, moved_px: float = 0.0, features: int = len(IDS)
) -> bool:
    """Whether a noisy copy of a pair is a repetition of it, where features are predicted to move."""
    frozen = _watching(off_px=off_px)
    frozen.observations(observations(0, 0, IDS[:features], Z[:features]))
    left = _noisy(_shifted(LEFT, moved_px), 5)
    right = _noisy(_shifted(RIGHT, moved_px), 6)
    return frozen.check(_frame(1, left, right), _expected(px)) is not None


def _partly_moved(share: float) -> bool:
    """Whether a pair of which a share of the rows has moved on is a repetition."""
    rows = round(share * LEFT.shape[0])

    def again(image: Image, seed: int) -> Image:
        out = _noisy(image, seed)
        out[:rows] = _shifted(image, 3.0)[:rows]
        return out

    frozen = _watching()
    return frozen.check(_frame(1, again(LEFT, 5), again(RIGHT, 6)), _expected()) is not None


def _after_flow(flow_px: float, features: int = len(IDS)) -> Repeated | None:
    """What equal images are after features have flown by so much in the frame before."""
    frozen = FrozenImages()
    pixels = [-2.0 * flow_px, 0.0, flow_px]
    for k, px in enumerate(pixels):
        frozen.check(_frame(k, _shifted(LEFT, px), _shifted(RIGHT, px)), None)
        frozen.observations(observations(k, k * STEP_NS, IDS[:features], Z[:features] + px))
    left = _shifted(LEFT, pixels[-1])
    right = _shifted(RIGHT, pixels[-1])
    return frozen.check(_frame(3, left, right), None)


def _held(moved_px: float, before_px: float = 0.0, lost: float = 0.0) -> bool:
    """Whether equal images were no standstill, by the motion that ends them."""
    frozen = FrozenImages()
    pixels = [0.0, 0.0, *[before_px] * 6, before_px + moved_px]
    for k, px in enumerate(pixels):
        last = k == len(pixels) - 1
        ids = np.where(np.arange(len(IDS)) < lost * len(IDS), IDS + 1000 * last, IDS)
        frozen.check(_frame(k, _shifted(LEFT, px), _shifted(RIGHT, px)), None)
        frozen.observations(observations(k, k * STEP_NS, ids, Z + px))
    return frozen.take_held() is not None


def _left_out(pixels: list[float]) -> list[int]:
    """Frames that are repetitions, of images shifted by so many pixels, with noise."""
    frozen = FrozenImages()
    out: list[int] = []
    for k, px in enumerate(pixels):
        left = _noisy(_shifted(LEFT, px), 2 * k)
        right = _noisy(_shifted(RIGHT, px), 2 * k + 1)
        if frozen.check(_frame(k, left, right), _expected(0.0)) is not None:
            out.append(k)
        else:
            frozen.observations(observations(k, k * STEP_NS, IDS, Z + np.array([px, 0.0, px, 0.0])))
    return out


def _twice(flow_px: float, rest_px: float = 0.0, frames: int = 13, period: int = 2) -> bool:
    """Whether the last of some frames repeats the one before, where the first one of each period
    hardly moves, and the view moves on by so much a frame meanwhile.
    """
    pixels = [0.0]
    for k in range(1, frames):
        pixels.append(flow_px * k if k % period else pixels[-1] + rest_px)
    return frames - 1 in _left_out(pixels)


def _with_pauses(period: int) -> list[float]:
    """A rig that really stops in each first frame of a period."""
    return np.cumsum([0.0 if k % period == 0 else 1.0 for k in range(40)]).tolist()


def _shaken(period: int) -> list[float]:
    """A rig that turns back between two frames, twice in so many."""
    return (2.0 * np.cos(2.0 * np.pi * (np.arange(40) + 0.5) / period)).tolist()


@pytest.mark.parametrize(
    "pixels",
    [_with_pauses(3), _with_pauses(4), _shaken(4), _shaken(6), _shaken(8)],
    ids=["stops every third", "stops every fourth", "turns 4", "turns 6", "turns 8"],
)
def test_a_rig_that_stops_or_turns_back_for_a_frame_repeats_none(pixels: list[float]) -> None:
    """Repetitions are followed by twice the motion, as it goes on meanwhile."""
    assert _left_out(pixels) == []


def test_features_of_which_none_is_shared_have_no_flow() -> None:
    frozen = FrozenImages()
    flows: list[float | None] = []
    for k in range(3):
        frozen.check(_frame(k, _shifted(LEFT, 9.0 * k), _shifted(RIGHT, 9.0 * k)), None)
        frozen.observations(observations(k, k * STEP_NS, IDS + 1000 * max(k - 1, 0), Z))
        flows.append(frozen.flow_px)
    assert flows == [None, 0.0, None]


def _lines(rows: int) -> int:
    """Lines on so many repetitions, each of which ends with the next frame."""
    report = RepeatReport(IMAGES)
    said = 0
    for k in range(rows):
        said += len(report.frame(_frame(2 * k, LEFT, RIGHT), Repeated(2 * k - 1, True)))
        said += len(report.frame(_frame(2 * k + 1, LEFT, RIGHT), None))
    return said


LIMITS: dict[str, tuple[Says, float, float]] = {
    "predicted to move": (_nearly_equal, 0.85, 1.15),
    "predictions are off": (lambda x: not _nearly_equal(off_px=x), 0.43, 0.57),
    "twice: moved": (lambda x: _twice(x, frames=15), 0.14, 0.16),
    "twice: unmoved": (lambda x: not _twice(1.0, x), 0.1, 0.2),
    "twice: frames": (lambda x: _twice(1.0, frames=round(x)), 7, 9),
    "every third one twice": (lambda x: _twice(x, period=3), 0.28, 0.32),
    "every fourth one twice": (lambda x: _twice(1.0, frames=round(x), period=4), 13, 17),
    "unmoved": (lambda x: not _nearly_equal(moved_px=x), 0.11, 0.2),
    "unmoved: share": (lambda x: not _partly_moved(x), 0.1, 0.35),
    "unmoved: features": (lambda n: _nearly_equal(features=int(n)), 14, 15),
    "lines": (lambda n: _lines(9) < n, 3, 4),
    "moved": (lambda x: _after_flow(x) is not None, 0.17, 0.24),
    "moved: features": (lambda n: _after_flow(2.0, int(n)) is not None, 14, 15),
    "begun": (_held, 1.8, 2.3),
    "begun: features are lost": (lambda x: _held(1.0, lost=x), 0.75, 0.85),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_repetitions(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
