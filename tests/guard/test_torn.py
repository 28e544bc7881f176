"""Torn images: rows of the frame before are told from what always is equal, and left out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from vio.guard.image_check import FrameImages
from vio.guard.torn import TornImages
from vio.records import Image, StereoFrame

SHAPE = (120, 160)
Change = Callable[[int, Image, Image], Image]  # of a frame's number and image, and the one before


def _image(seed: int) -> Image:
    return np.random.default_rng(seed).integers(60, 190, SHAPE).astype(np.uint8)


def _as_is(index: int, image: Image, before: Image) -> Image:
    return image


def _torn(first: int, last: int, at: int = 4) -> Change:
    """Some rows of a frame are those of the frame before."""

    def change(index: int, image: Image, before: Image) -> Image:
        out = image.copy()
        if index == at:
            out[first:last] = before[first:last]
        return out

    return change


def _bonnet(index: int, image: Image, before: Image) -> Image:
    """The lower rows never change."""
    out = image.copy()
    out[90:] = _image(1000)[90:]
    return out


def _stops(index: int, image: Image, before: Image) -> Image:
    """The upper rows are those of a rendered scene that moves no more from frame 4 on."""
    out = image.copy()
    if index >= 4:
        out[:60] = _image(2000)[:60]
    return out


def _black(index: int, image: Image, before: Image) -> Image:
    """The upper rows are black where the frame's number is even."""
    out = image.copy()
    if index >= 4:
        out[:60] = 0
    return out


def _frozen(index: int, image: Image, before: Image) -> Image:
    return before if index == 4 else image


def _inspected(left: Change, right: Change = _as_is) -> tuple[TornImages, list[FrameImages]]:
    check = TornImages()
    out = []
    for k in range(8):
        raw = (
            left(k, _image(k), _image(k - 1 + 500 * (k == 0))),
            right(k, _image(100 + k), _image(99 + k)),
        )
        out.append(check.inspect(FrameImages(StereoFrame(k, 50_000_000 * k, *raw), raw)))
    return check, out


@pytest.mark.parametrize(("first", "last"), [(0, 60), (60, 120), (0, 15), (0, 100)])
def test_a_frame_whose_left_image_is_torn_is_left_out(first: int, last: int) -> None:
    check, out = _inspected(_torn(first, last))
    assert [images.skipped for images in out] == [k == 4 for k in range(8)]
    (finding,) = check.take_findings()
    assert (finding.code, finding.frame) == ("frames-repeated", 4)
    assert f"{round(100 * (last - first) / 120)} % of the rows of the left one" in finding.message


def test_a_torn_right_image_is_not_used() -> None:
    check, out = _inspected(_as_is, _torn(0, 60))
    assert [images.right_usable for images in out] == [k != 4 for k in range(8)]
    assert not any(images.skipped for images in out)
    assert "rows of the right one" in check.take_findings()[0].message


@pytest.mark.parametrize("change", [_as_is, _bonnet, _black, _frozen, _torn(40, 80), _torn(0, 8)])
def test_rows_that_are_equal_for_another_reason_are_no_tear(change: Change) -> None:
    """A border, black rows, a whole image, a block in the middle, fewer than a tenth."""
    check, out = _inspected(change)
    assert not any(images.skipped for images in out)
    assert check.take_findings() == ()


def test_a_part_that_moves_no_more_costs_one_frame() -> None:
    _, out = _inspected(_stops)
    assert [images.skipped for images in out] == [k == 5 for k in range(8)]


def test_torn_frames_of_a_second_are_one_event() -> None:
    def change(index: int, image: Image, before: Image) -> Image:
        return _torn(0, 60, index)(index, image, before) if index in (2, 4, 6) else image

    check, out = _inspected(change)
    assert [images.index for images in out if images.skipped] == [2, 4, 6]
    assert [finding.frame for finding in check.take_findings()] == [2]
