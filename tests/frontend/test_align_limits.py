"""Limits of the alignment of anchors, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from vio.frontend.align import align, cut_patches, rounded, shift_warps
from vio.frontend.anchor_fit import AnchorFit
from vio.frontend.tracks import AnchorBank
from vio.geometry.lie import FloatArray
from vio.records import Image

Says = Callable[[float], bool]
AT = np.array([[60.0, 60.0]])


def _texture(contrast: float, seed: int = 0) -> FloatArray:
    """A smooth texture of 120 pixels."""
    noise = np.random.default_rng(seed).normal(size=(140, 140))
    smooth = cv2.GaussianBlur(noise, (0, 0), 3.0)
    return np.asarray(contrast * smooth / smooth.std())[:121, :121]


def _image(levels: FloatArray) -> Image:
    return np.clip(np.rint(128.0 + levels), 0, 255).astype(np.uint8)


def _row_px(contrast: float) -> float:
    """Where an anchor of a contrast is found that the image shows a pixel below its expected row."""
    texture = _texture(contrast)
    bank = AnchorBank(2, 9)
    slots = bank.add(_image(texture), AT)
    moved = _image(np.roll(texture, 1, axis=0))
    warp, _ = align(bank.store, slots, moved, shift_warps(AT), 20, AT[:, 1])
    return float(warp[0, 1, 2] - AT[0, 1])


def _worst_sigma() -> float:
    """Standard deviation of an anchor's pixel in an image that is its negative, over what it would
    be for as much noise as signal.
    """
    texture = _texture(30.0)
    bank = AnchorBank(2, 9)
    slots = bank.add(_image(texture), AT)
    noisy = _image(texture + _texture(15.0, 1))
    _, score = align(bank.store, slots, noisy, shift_warps(AT), 1)
    known = float(bank.store.sigma[slots[0], 0]) / np.sqrt(score[0] ** -2 - 1.0)
    align(bank.store, slots, _image(-texture), shift_warps(AT), 1)
    return float(bank.store.sigma[slots[0], 0] / known)


def _is_inside(border_px: float) -> bool:
    """Whether an anchor is aligned so near to the image's border."""
    texture = _image(_texture(30.0))
    bank = AnchorBank(2, 9)
    slots = bank.add(texture, AT)
    image = texture[:, round(60.0 - border_px) :].copy()
    at = np.array([[round(60.0 - round(60.0 - border_px)), 60.0]])
    _, score = align(bank.store, slots, image, shift_warps(at), 1)
    return bool(score[0] > -1.0)


def _moved_px(shift: int, iterations: int = 1) -> float:
    """How far an anchor moves in its first steps towards a shift."""
    texture = cv2.GaussianBlur(_texture(100.0), (0, 0), 6.0)
    texture = 40.0 * texture / texture.std()
    bank = AnchorBank(2, 9)
    slots = bank.add(_image(texture), AT)
    warp, _ = align(
        bank.store, slots, _image(np.roll(texture, shift, axis=1)), shift_warps(AT), iterations
    )
    return float(warp[0, 0, 2] - AT[0, 0])


def _followed_px() -> float:
    """How far an anchor is from where it belongs after the steps of a frame, in an image that is so
    blurred that each step is short.
    """
    texture = _texture(30.0)
    bank = AnchorBank(2, 9)
    slots = bank.add(_image(texture), AT)
    blurred = cv2.GaussianBlur(np.roll(texture, 1, axis=1), (0, 0), 4.0)
    before: Any = SimpleNamespace(full=_image(texture))
    after: Any = SimpleNamespace(full=_image(blurred))
    own: Any = SimpleNamespace(_bank=bank)
    warp, _ = AnchorFit._realign(own, before, after, AT, slots, AT.copy(), np.ones(1))
    return float(AT[0, 0] + 1.0 - warp[0, 0, 2])


LIMITS: dict[str, tuple[Says, float, float]] = {
    "row": (lambda x: _row_px(7.0) < x, 0.42, 0.58),
    "worst score": (lambda x: _worst_sigma() < x, 8.0, 12.0),
    "inside": (_is_inside, 8.0, 9.0),
    "steps of a frame": (lambda x: _followed_px() < x, 2.23, 2.33),
    "step": (lambda x: _moved_px(4) < x, 1.05, 1.6),
}


def test_anchors_are_cut_at_fractions_of_a_pixel_that_float32_holds_exactly() -> None:
    """A gray level between four pixels is then a multiple of the square of the fraction."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (120, 120)).astype(np.uint8)
    centres = rng.uniform(40.0, 80.0, (50, 2))
    cut = rounded(centres)
    assert np.abs(cut - centres).max() <= 1.001 / 64.0
    levels = 1024.0 * cut_patches(image, cut, 9).astype(np.float64)
    assert np.array_equal(levels, np.rint(levels))


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_alignment(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
