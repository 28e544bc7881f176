"""Each limit of the checks, from both sides: a situation that is still healthy, and one that is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.guard.test_matches import CAMERA, STEP_NS
from vio.errors import DataError
from vio.findings import Finding
from vio.guard.bands import BandRemoval
from vio.guard.contrast import LostContrast
from vio.guard.displaced_matches import DisplacedMatches
from vio.guard.exchange import ExchangeDetector, MatchCounts
from vio.guard.exchanged_matches import ExchangedMatches
from vio.guard.frozen_image import FrozenCamera
from vio.guard.frozen_matches import FrozenMatches
from vio.guard.image_change import has_moved, image_change
from vio.guard.image_check import FrameImages
from vio.guard.lost_matches import LostMatches
from vio.guard.match_check import SharedMatches
from vio.guard.never_matched import NeverMatched
from vio.guard.pairing import PairingCheck, told_delay
from vio.guard.probe import RowProbe
from vio.guard.swap import SwapDetector
from vio.guard.turned_pair import TurnedPair
from vio.records import Image, Observations, StereoFrame, observations

Says = Callable[[float], bool]
NOTHING = SharedMatches(np.arange(0), np.zeros((0, 4)), np.zeros((0, 4)), 0.1)
SHAPE = (120, 160)


def _codes(found: tuple[Finding, ...]) -> list[str]:
    return [f"-{finding.code}" if finding.ended else finding.code for finding in found]


# Images


def _grays(contrast: float = 50.0, seed: int = 0) -> Image:
    """Gray levels 128 plus and minus the contrast, at random."""
    signs = np.sign(np.random.default_rng(seed).normal(size=SHAPE))
    return (128.0 + contrast * signs).astype(np.uint8)


def _changed(image: Image, levels: float, seed: int = 1) -> Image:
    """The image with so many gray levels of change in the mean of all pixels."""
    rng = np.random.default_rng(seed)
    step = max(1, round(4 * levels))
    changed = rng.random(image.shape) < levels / step
    signs = rng.choice([-1, 1], image.shape)
    return (image.astype(np.int64) + step * signs * changed).astype(np.uint8)


def _banded_frames(
    changes: list[float], contrast: float = 1.0, period_rows: float = 60.0
) -> tuple[bool, int]:
    """Whether bands are found, and in which frame; the difference of row means changes by so many
    gray levels (root mean square) from frame to frame.
    """
    rows = np.sin(2 * np.pi * np.arange(SHAPE[0]) / period_rows)[:, None]
    removal = BandRemoval()
    level = 0.0
    for k, change in enumerate(changes):
        level += change * (1 if level <= 0 else -1)
        left = _grays(40.0)
        right = 128.0 + (contrast * (left - 128.0)) + level * np.sqrt(2.0) * rows
        removal.flatten(k, left, np.clip(right, 0, 255).astype(np.uint8))
        if removal.take_findings():
            return True, k
    return False, -1


def _bands_by_dark_camera(contrast: float) -> bool:
    rows = np.sin(2 * np.pi * np.arange(SHAPE[0]) / 60.0)[:, None]
    bright = 128.0 + 100.0 * np.sign(np.random.default_rng(0).normal(size=SHAPE))
    removal = BandRemoval()
    for k in range(8):
        banded = bright + 60.0 * rows * (-1) ** k
        dark = 128.0 + contrast * (bright - 128.0)
        removal.flatten(
            k, np.clip(banded, 0, 255).astype(np.uint8), np.clip(dark, 0, 255).astype(np.uint8)
        )
    return bool(removal.take_findings())


def _left_out(contrasts: list[float]) -> list[bool]:
    check = LostContrast()
    out = []
    for k, contrast in enumerate(contrasts):
        image = _grays(contrast)
        images = FrameImages(StereoFrame(k, k * STEP_NS, image, image), (image, image))
        out.append(check.inspect(images).skipped)
    return out


def _right_is_frozen(right: float, left: float, usual_ratio: float = 1.0) -> bool:
    """Whether a right image that changes by so many gray levels is, while the left one changes;
    before, ten frames had a usual ratio of both changes.
    """
    check = FrozenCamera()
    images = [_grays(seed=2), _grays(seed=3)]
    check.left_is_frozen(0, *images)
    if usual_ratio != 1.0:
        for k in range(1, 11):
            images = [
                _changed(_grays(seed=2), 20.0 if k % 2 else 0.0, k),
                _changed(_grays(seed=3), 20.0 * usual_ratio if k % 2 else 0.0, 50 + k),
            ]
            check.left_is_frozen(k, *images)
    check.left_is_frozen(20, _changed(images[0], left, 7), _changed(images[1], right, 8))
    return not check.right_usable


def _frozen_frames(count: int) -> list[str]:
    check = FrozenCamera()
    for k in range(count + 1):
        check.left_is_frozen(k, _grays(seed=k), _grays(seed=3))
    check.left_is_frozen(count + 1, _grays(seed=90), _grays(seed=91))
    return _codes(check.take_findings())


def _right_is_dark(contrast: float) -> bool:
    check = FrozenCamera()
    check.left_is_frozen(0, _grays(100.0), _grays(100.0, 3))
    check.left_is_frozen(1, _grays(100.0, 5), _grays(100.0 * contrast, 6))
    return not check.right_usable


def _clipped_change(unclipped: float) -> float:
    """Change of an image of which a share is not clipped, and all that changes is in it."""
    image = _grays(50.0)
    count = round(unclipped * image.size)
    image.reshape(-1)[count:] = np.where(image.reshape(-1)[count:] > 128, 255, 251)
    other = image.copy()
    other.reshape(-1)[count:] = 255
    return image_change(image, other)


def _order(points: int, negative: int, positive: int = 0) -> str:
    detector = ExchangeDetector(RowProbe())
    count = MatchCounts(points, positive, negative)
    return detector.order(0, _grays(), _grays(seed=1), lambda: count, suspicious=True)


def _swap_refused(corners: int, matched: float, mirrored: float, frames: int = 3) -> bool:
    detector = SwapDetector(RowProbe())
    try:
        for k in range(frames):
            detector.check(k, corners, round(matched), lambda: round(mirrored))
    except DataError:
        return True
    return False


IMAGES: dict[str, tuple[Says, float, float]] = {
    "bands: change": (lambda x: _banded_frames([0.0] + [x] * 6)[0], 21, 29),
    "bands: frames": (lambda n: _banded_frames([0.0] + [40.0] * int(n) + [0.0] * 4)[0], 2, 3),
    "bands: memory": (
        lambda gap: not _banded_frames([0.0] + ([40.0] + [0.0] * int(gap - 1)) * 3)[0],
        4,
        6,
    ),
    "bands: narrow ones of an edge": (
        lambda x: _banded_frames([0.0] + [x] * 6, period_rows=12.0)[0],
        64,
        105,
    ),
    "bands: dark camera": (_bands_by_dark_camera, 0.26, 0.35),
    "contrast: lost": (lambda x: not _left_out([50.0, 50.0 * x])[1], 0.08, 0.12),
    "contrast: frames": (lambda n: not _left_out([50.0] + [1.0] * int(n))[-1], 5, 6),
    "frozen: noise": (lambda x: not _right_is_frozen(x, 30.0), 2.5, 3.6),
    "frozen: other changes more": (lambda x: _right_is_frozen(2.0, x), 5.5, 8.0),
    "frozen: other changes": (lambda x: _right_is_frozen(0.1, x), 0.8, 1.3),
    "frozen: usual ratio": (lambda x: not _right_is_frozen(x, 30.0, 0.5), 1.5, 1.62),
    "frozen: dark": (lambda x: not _right_is_dark(x), 0.08, 0.12),
    "frozen: frames": (lambda n: _frozen_frames(int(n)) != [], 2, 3),
    "moved": (lambda x: has_moved(_changed(_grays(), x, 4), _grays()), 1.6, 2.4),
    "exchanged": (lambda n: _order(100, int(n)) == "exchanged", 37, 43),
    "exchanged: refused": (lambda n: _order(100, int(n)) == "refused", 17, 23),
    "exchanged: points": (lambda n: _order(int(n), int(n)) == "exchanged", 19, 20),
    "exchanged: clearly": (lambda n: _order(100, int(n), 30) == "exchanged", 58, 62),
    "swapped: few": (lambda x: not _swap_refused(100, x, 90.0), 28, 32),
    "swapped: many": (lambda x: _swap_refused(100, 5.0, x), 37, 43),
    "swapped: points": (lambda n: _swap_refused(int(n), 0.0, n), 19, 20),
    "swapped: frames": (lambda n: _swap_refused(100, 0.0, 90.0, int(n)), 2, 3),
    "late: corners": (lambda n: told_delay(int(n), {0: 0, 1: int(n)}) == 1, 29, 30),
    "late: share": (lambda x: told_delay(100, {0: 0, 1: int(x)}) == 1, 37, 43),
    "late: clearly": (lambda x: told_delay(100, {0: 50, 1: int(x)}) == 1, 62, 68),
}


@pytest.mark.parametrize(("says", "below", "above"), IMAGES.values(), ids=IMAGES)
def test_limits_of_images(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


@pytest.mark.parametrize(("unclipped", "left_out"), [(0.085, False), (0.115, True)])
def test_clipped_pixels_are_no_change_where_others_are_left(
    unclipped: float, left_out: bool
) -> None:
    assert (_clipped_change(unclipped) < 1e-9) == left_out


# Matches


def _rows(k: int, count: int, off_px: float, noise_px: float) -> Observations:
    rng = np.random.default_rng(k)
    left = rng.uniform([20, 20], [620, 460], (count, 2))
    off = off_px + rng.normal(0.0, noise_px, count)
    z = np.column_stack([left, left[:, 0] - 20.0, left[:, 1] + off])
    return observations(k, k * STEP_NS, np.arange(count), z, np.ones(count, dtype=np.bool_))


def _displaced(
    off_px: float,
    *,
    noise_px: float = 0.02,
    before: int = 40,
    count: int = 400,
    then_px: float | None = None,
) -> list[str]:
    check = DisplacedMatches(CAMERA)
    offsets = [0.0] * before + [off_px] * 4
    offsets += [] if then_px is None else [then_px] * 5
    for k, px in enumerate(offsets):
        check.inspect(_rows(k, 400 if k < before else count, px, noise_px), NOTHING)
    return _codes(check.take_findings())


def _displaced_after_noisy_frames(frames: int) -> bool:
    """Whether rows that are off by a pixel contradict those of exact frames and some noisy ones."""
    check = DisplacedMatches(CAMERA)
    for k in range(30):
        check.inspect(_rows(k, 400, 0.0, 0.02), NOTHING)
    for k in range(30, 34 + frames):
        check.inspect(_rows(k, 400, 1.05 * (k >= 30 + frames), 0.445), NOTHING)
    return bool(check.take_findings())


def _exchanged(matches: int) -> list[str]:
    check = ExchangedMatches()
    for k in range(4):
        seen = _rows(k, matches, 0.0, 0.0)
        check.inspect(seen if k < 2 else replace(seen, z=seen.z[:, [2, 3, 0, 1]]))
    return _codes(check.take_findings())


def _moving_again(share: float) -> list[str]:
    check = FrozenMatches()
    seen = _rows(0, 30, 0.0, 0.0)
    for right in [0.0] * 3 + [share]:
        now = np.full((30, 4), 100.0) + np.array([10.0, 0.0, 10.0 * right, 0.0])
        check.inspect(seen, SharedMatches(np.arange(30), np.full((30, 4), 100.0), now, 0.1))
    return _codes(check.take_findings())


def _shares(shares: list[float], count: int = 100) -> list[Observations]:
    out = []
    for k, share in enumerate(shares):
        seen = _rows(k, count, 0.0, 0.0)
        out.append(replace(seen, has_right=np.arange(count) < round(share * count)))
    return out


def _lost(shares: list[float], count: int = 100) -> list[str]:
    check = LostMatches()
    for seen in _shares(shares, count):
        check.inspect(seen, NOTHING)
    return _codes(check.take_findings())


def _never(shares: list[float], count: int = 100) -> list[str]:
    check = NeverMatched()
    for seen in _shares(shares, count):
        check.see(seen)
    return _codes(check.take_findings())


MATCHES: dict[str, tuple[Says, float, float]] = {
    "displaced: rows": (lambda x: _displaced(x) != [], 0.65, 0.85),
    "displaced: usual rows": (lambda x: _displaced(x, noise_px=0.445) != [], 1.25, 1.8),
    "displaced: noise is learned": (lambda n: not _displaced_after_noisy_frames(int(n)), 4, 6),
    "displaced: frames": (lambda n: _displaced(3.0, before=int(n)) != [], 4, 5),
    "displaced: matches": (lambda n: _displaced(3.0, count=int(n)) != [], 19, 20),
    "displaced: back": (lambda x: len(_displaced(3.0, then_px=x)) == 1, 0.32, 0.44),
    "exchanged: matches": (lambda n: _exchanged(int(n)) != [], 19, 20),
    "frozen: moves again": (lambda x: len(_moving_again(x)) == 2, 0.45, 0.55),
    "lost: features": (lambda n: _lost([1.0] * 5 + [0.0] * 5, int(n)) != [], 19, 20),
    # The share that was usual is forgotten within some frames.
    "lost: usual share": (
        lambda n: _lost([1.0] * 10 + [0.3] * int(n) + [0.09] * 4) == [],
        12,
        18,
    ),
    "never: features": (lambda n: _never([0.0] * 6, int(n)) != [], 19, 20),
    "never: frames": (lambda n: _never([0.0] * int(n)) != [], 4, 5),
    "never: back": (lambda x: len(_never([0.0] * 6 + [x])) == 2, 0.27, 0.33),
}


@pytest.mark.parametrize(("says", "below", "above"), MATCHES.values(), ids=MATCHES)
def test_limits_of_matches(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


# The first frames: pairs that are late, and a right camera that is turned


class _Counts:
    """A search along rows of images that hold their frame's number, with given counts."""

    def __init__(self, of_delay: dict[int, int], corners: int = 100, negative: int = 0) -> None:
        self._of_delay = of_delay
        self._corners = corners
        self._negative = negative

    def corners(self, image: Image) -> np.ndarray:
        return np.zeros((self._corners, 2))

    def on_rows(self, left: Image, right: Image, points: np.ndarray) -> int:
        """Of images in another order than left and right none match."""
        is_pair = left[3, 12] == 0 and right[3, 12] == 1
        return self._of_delay.get(int(left[3, 3]) - int(right[3, 3]), 0) if is_pair else 0

    def negative(self, left: Image, right: Image, points: np.ndarray) -> int:
        return self._negative

    def near_rows(self, left: Image, right: Image, points: np.ndarray) -> np.ndarray:
        return np.full(3, self.on_rows(left, right, points))


def _images(index: int) -> FrameImages:
    pair = []
    for camera in range(2):
        full = _grays(seed=2 * index + camera)
        full[:16, :16] = index
        full[:16, 16:32] = camera
        pair.append(full)
    return FrameImages(StereoFrame(index, index * STEP_NS, *pair), tuple(pair))


def _decided(of_delay: dict[int, int], frames: int, corners: int = 100) -> int | None:
    check = PairingCheck(_Counts(of_delay, corners))  # type: ignore[arg-type]
    for k in range(frames):
        check.inspect(_images(k))
    return check.delay


def _evidence(on_rows: int, negative: int = 0, corners: int = 100, frames: int = 1) -> str | None:
    """What is looked at after a number of pairs with given counts."""
    probe = _Counts({0: on_rows}, corners, negative)
    check = TurnedPair(CAMERA, probe)  # type: ignore[arg-type]
    check._add_pair = lambda images: None  # type: ignore[method-assign]
    for k in range(frames):
        check.inspect(_images(k))
    return check._looks_at


def _waits(flow_px: float, frames: int) -> bool:
    """Whether a camera is still waited for whose features move by so much a frame."""
    check = TurnedPair(CAMERA, _Counts({0: 100}))  # type: ignore[arg-type]
    check.inspect(_images(0))
    for k in range(frames):
        seen = _rows(0, 100, 0.0, 0.0)
        moved = replace(seen, frame_index=k, z=seen.z + k * flow_px * np.array([1.0, 0, 1.0, 0]))
        check.see(moved)
    return check._looks_at == "features"


FIRST: dict[str, tuple[Says, float, float]] = {
    "pairs: counted frames": (lambda n: _decided({0: 90}, int(n)) is not None, 3, 4),
    "pairs: tests": (lambda n: _decided({0: 5}, int(n)) is not None, 40, 41),
    "pairs: frames apart, soon": (lambda n: _decided({-int(n): 90, 0: 5}, 9) != n, 3, 4),
    "pairs: frames apart": (lambda n: _decided({-int(n): 90, 0: 5}, 24) != n, 10, 11),
    "turned: few corners match": (lambda n: _evidence(int(n)) == "features", 47, 53),
    "turned: negative disparities": (lambda n: _evidence(90, int(n)) == "pairs", 23, 28),
    "turned: corners": (lambda n: _evidence(0, corners=int(n)) == "pairs", 29, 30),
    "turned: tries": (lambda n: _evidence(0, corners=5, frames=int(n)) == "features", 2, 3),
    "turned: flow": (lambda x: not _waits(x, 3), 1.7, 2.3),
    "turned: still": (lambda n: not _waits(0.0, int(n)), 39, 40),
}


@pytest.mark.parametrize(("says", "below", "above"), FIRST.values(), ids=FIRST)
def test_limits_of_the_first_frames(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
