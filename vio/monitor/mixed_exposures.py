"""Whether images show the frame before as well: a temporal noise filter, a conversion of the frame
rate by blending, or temporal anti-aliasing of a simulator.

A part of the corners then stays where the frame before has them, and features follow something
between the two. Around where a feature was, the image is fitted by what has come there since, as
features move, by what the frame before shows there, and by what the one before that does: a pattern
that stays, as dirt on a lens, is in both of these alike. While the view moves evenly, what is seen
twice moves with it, and does no harm.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.findings import Finding, begun, ended
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled, dot
from vio.numerics.kinds import Capacity
from vio.numerics.robust import median
from vio.records import Image, IntArray, Observations, shared_rows


class _MixedRules(NamedTuple):
    """When images show the frame before as well."""

    radius_px: Capacity[int] = 8  # of the patches
    step_px: Capacity[int] = 2  # to each side, of the differences that are compared
    # by less, what a feature has left and what has come there are too alike
    min_moved_px: float = 5.0
    min_gradient: float = 6.0  # gray levels, root mean square of a patch's differences
    noise: float = 2.0  # of differences, gray levels
    # of a frame that tells: fewer are of one near thing, as 10 to 18 in healthy renders were
    min_features: int = 25
    sigmas: float = 3.0  # that the share is beyond what it may be by chance
    most_features: Capacity[int] = 50
    # Share of the frame before in an image, which it has at least.
    share: float = 0.08
    most_share: float = 0.9  # more, and it is the frame before itself, which others name
    frames: int = 6  # the newest that tell, of which …
    mixed: int = 2  # … so many have it before it is reported
    clear_frames: int = 20  # in a row that do not, before it is over
    # After so many frames that tell, and while none of the newest has it, two in a row of so many
    # are looked at: every second frame may be a blend. A prime, so that no other pattern is missed.
    first_frames: int = 20
    period: int = 7


_MIXED = _MixedRules()
_STEP_PX = _MIXED.step_px
_INNER_PX = _MIXED.radius_px - _STEP_PX  # of the differences' centres in a patch
_DIFFERENCES = 2 * (2 * _INNER_PX + 1) ** 2  # of a patch
_CODE = "exposures-mixed"


@dataclass(frozen=True, slots=True)
class _Frame:
    since: int  # number of the frame before it, or before those that were passed over last
    share: float  # of the frame before in its image
    least: float  # what that is at least

    @property
    def is_mixed(self) -> bool:
        """Whether it clearly shows the frame before."""
        return self.least > _MIXED.share


class MixedExposures:
    """Reports that images show the frame before as well, and when that is over."""

    def __init__(self) -> None:
        self._images = deque[Image](maxlen=3)
        self._seen = deque[Observations](maxlen=3)
        self._frames = deque[_Frame](maxlen=_MIXED.frames)
        self._told = 0  # frames
        self._number = 0  # of frames with two before
        self._passes = False  # the present frame is not looked at
        self._passed_since: int | None = None  # frame before those that were passed over last
        self._reported = False
        self._clear = 0  # frames in a row

    def frame(self, seen: Observations, image: Image | None) -> list[Finding]:
        """Return what a frame shows, by its features and its left image (H, W); None: it has
        none.
        """
        if image is None or (self._images and self._images[-1].shape != image.shape):
            self._images.clear()
            self._seen.clear()
            if image is None:
                return []
        self._images.append(image)
        self._seen.append(seen)
        if len(self._images) < 3:
            return []
        before = self._seen[1].frame_index
        self._choose(before)
        if self._passes:
            return []
        since = before if self._passed_since is None else self._passed_since
        found = _share_of_before(list(self._seen), list(self._images))
        if found is None or found[0] > _MIXED.most_share:
            return []
        self._told += 1
        self._frames.append(_Frame(since, *found))
        return self._judged(seen.frame_index)

    def _choose(self, before: int) -> None:
        """Choose whether the present frame is passed over, as nothing has been found for long.

        `before`: number of the frame before.
        """
        passed = self._passes
        self._number = (self._number + 1) % _MIXED.period
        suspected = self._reported or any(frame.is_mixed for frame in self._frames)
        is_rare = not suspected and self._told >= _MIXED.first_frames
        self._passes = is_rare and self._number > 1
        if not is_rare:
            self._passed_since = None
        elif self._passes and not passed:
            self._passed_since = before

    def _judged(self, index: int) -> list[Finding]:
        mixed = [frame for frame in self._frames if frame.is_mixed]
        self._clear = 0 if self._frames[-1].is_mixed else self._clear + 1
        if self._reported:
            if self._clear < _MIXED.clear_frames:
                return []
            self._reported = False
            return [ended(_CODE, index, "images do not show the frame before any more")]
        if len(mixed) < _MIXED.mixed:
            return []
        self._reported = True
        share = min(max(frame.share for frame in mixed), 1.0)
        text = (
            f"images show the frame before as well, with {100 * share:.0f} % of its "
            "contrast, and features follow a motion between the two; switch off temporal noise "
            "reduction, blending of frames and temporal anti-aliasing"
        )
        # where both have the same contrast, either motion may be taken for that of the rig
        doubted = min(share / max(1.0 - share, share), 1.0)
        figures = {"share": share, "doubted_share": doubted}
        # the motion into the first such frame is in doubt already
        return [begun(_CODE, index, text, mixed[0].since, figures=figures)]


def _share_of_before(seen: list[Observations], images: list[Image]) -> tuple[float, float] | None:
    """The share of the frame before in an image, beyond that of the one before it, and what it is
    at least; None: too few features tell.

    Args:
        seen: features of the last three frames, the newest one last.
        images: of these, (H, W).
    """
    place, source = _places(*seen)
    size = np.array(images[0].shape[::-1])
    inside = np.minimum(place, source).min(axis=1) >= _MIXED.radius_px
    inside &= (np.maximum(place, source) < size - _MIXED.radius_px).all(axis=1)
    place = place[inside]
    source = source[inside]
    every = 1 + len(place) // _MIXED.most_features
    place = place[::every]
    source = source[::every]
    if len(place) < _MIXED.min_features:
        return None
    products = np.empty((len(place), 4, 3))
    # of one type for the compiled loop, which would be compiled anew for others
    first, last, newest = (np.require(image, requirements=["C", "W"]) for image in images)
    _products((first, last, newest), place, source, products)
    mean_square = products[:, 1, 1] / _DIFFERENCES
    products = products[mean_square >= _MIXED.min_gradient**2]
    count = len(products)
    if count < _MIXED.min_features:
        return None
    normal = products[:, :3] + _MIXED.noise**2 * _DIFFERENCES * np.eye(3)
    shares = np.linalg.solve(normal, products[:, 3, :, None])[:, :, 0]
    of_before = shares[:, 1]
    middle = median(of_before)
    # of the median of normal errors, by their median deviation
    sigma = 1.4826 * median(np.abs(of_before - middle)) * np.sqrt(0.5 * np.pi / count)
    share = middle - max(median(shares[:, 2]), 0.0)
    return share, float(share - _MIXED.sigmas * sigma)


def _places(
    earlier: Observations, before: Observations, seen: Observations
) -> tuple[IntArray, IntArray]:
    """Pixels (N, 2) of features in the frame before, and of what has come there since, as their
    neighbours move as they do.

    Features that are lost, as two exposures may lose them, have moved as from frame to frame
    before.
    """
    moved = np.zeros((len(before), 2))
    old, new = shared_rows(earlier.ids, before.ids)
    moved[new] = before.z[new, :2] - earlier.z[old, :2]
    old, new = shared_rows(before.ids, seen.ids)
    moved[old] = seen.z[new, :2] - before.z[old, :2]
    far = np.hypot(moved[:, 0], moved[:, 1]) >= _MIXED.min_moved_px
    at = before.z[far, :2]
    return np.rint(at).astype(np.int64), np.rint(at - moved[far]).astype(np.int64)


@compiled
def _products(
    images: tuple[Image, Image, Image], place: IntArray, source: IntArray, products: FloatArray
) -> None:
    """Write what fits the last of three images in patches about pixels (N, 2).

    Args:
        images: of three frames, (H, W), the newest one last.
        place: pixels of features in the frame before.
        source: pixels in that frame of what has come to these since.
        products: (N, 4, 3), sums of products of differences of gray levels in a patch: in each row,
            of what has come there, of the frame before, of the one before that, and of the newest
            image, with the first three.
    """
    first, last, newest = images
    parts = np.empty((4, _DIFFERENCES))
    for n in range(len(place)):
        u, v = place[n]
        _differences(last, source[n, 0], source[n, 1], parts[0])
        _differences(last, u, v, parts[1])
        _differences(first, u, v, parts[2])
        _differences(newest, u, v, parts[3])
        for i in range(4):
            for j in range(min(i + 1, 3)):
                # of whole numbers, so exact, whatever the order
                products[n, i, j] = dot(parts[i], parts[j])
                if i < 3:
                    products[n, j, i] = products[n, i, j]


@compiled
def _differences(image: Image, u: int, v: int, differences: FloatArray) -> None:
    """Write the differences (K,) of gray levels along rows and columns in a patch about a pixel."""
    k = 0
    for y in range(v - _INNER_PX, v + _INNER_PX + 1):
        for x in range(u - _INNER_PX, u + _INNER_PX + 1):
            along = np.int32(image[y, x + _STEP_PX]) - np.int32(image[y, x - _STEP_PX])
            down = np.int32(image[y + _STEP_PX, x]) - np.int32(image[y - _STEP_PX, x])
            differences[k] = along
            differences[k + 1] = down
            k += 2
