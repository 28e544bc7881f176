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
from vio.findings import Finding
from vio.geometry.lie import FloatArray
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
    min_features: int = 10
    sigmas: float = 3.0  # that the share is beyond what it may be by chance
    most_features: Capacity[int] = 50
    # Share of the frame before in an image, which it has at least.
    share: float = 0.08
    most_share: float = 0.9  # more, and it is the frame before itself, which others name
    frames: int = 6  # the newest that tell, of which …
    mixed: int = 2  # … so many have it before it is reported
    clear_frames: int = 20  # in a row that do not, before it is over


_MIXED = _MixedRules()
_CODE = "exposures-mixed"


@dataclass(frozen=True, slots=True)
class _Frame:
    before: int  # number of the frame before
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
        found = _share_of_before(list(self._seen), list(self._images))
        if found is None or found[0] > _MIXED.most_share:
            return []
        self._frames.append(_Frame(self._seen[-2].frame_index, *found))
        return self._judged(seen.frame_index)

    def _judged(self, index: int) -> list[Finding]:
        mixed = [frame for frame in self._frames if frame.is_mixed]
        self._clear = 0 if self._frames[-1].is_mixed else self._clear + 1
        if self._reported:
            if self._clear < _MIXED.clear_frames:
                return []
            self._reported = False
            message = f"frame {index}: images do not show the frame before any more"
            return [Finding(_CODE, message, index, ended=True)]
        if len(mixed) < _MIXED.mixed:
            return []
        self._reported = True
        share = min(max(frame.share for frame in mixed), 1.0)
        message = (
            f"frame {index}: images show the frame before as well, with {100 * share:.0f} % of its "
            "contrast, and features follow a motion between the two; switch off temporal noise "
            "reduction, blending of frames and temporal anti-aliasing"
        )
        # where both have the same contrast, either motion may be taken for that of the rig
        doubted = min(share / max(1.0 - share, share), 1.0)
        figures = {"share": share, "doubted_share": doubted}
        # the motion into the first such frame is in doubt already
        return [Finding(_CODE, message, index, mixed[0].before, lasts=True, figures=figures)]


def _share_of_before(seen: list[Observations], images: list[Image]) -> tuple[float, float] | None:
    """The share of the frame before in an image, beyond that of the one before it, and what it is at
    least; None: too few features tell.

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
    first, last, image = images
    came = _differences(last, source)
    parts = np.stack([came, _differences(last, place), _differences(first, place)], axis=2)
    usable = np.sqrt(np.mean(parts[:, :, 1] ** 2, axis=1)) >= _MIXED.min_gradient
    count = int(usable.sum())
    if count < _MIXED.min_features:
        return None
    parts = parts[usable]
    now = _differences(image, place[usable])
    across = parts.transpose(0, 2, 1)
    normal = across @ parts + _MIXED.noise**2 * parts.shape[1] * np.eye(3)
    shares = np.linalg.solve(normal, across @ now[:, :, None])[:, :, 0]
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

    Features that are lost, as two exposures may lose them, have moved as from frame to frame before.
    """
    moved = np.zeros((len(before), 2))
    old, new = shared_rows(earlier.ids, before.ids)
    moved[new] = before.z[new, :2] - earlier.z[old, :2]
    old, new = shared_rows(before.ids, seen.ids)
    moved[old] = seen.z[new, :2] - before.z[old, :2]
    far = np.hypot(moved[:, 0], moved[:, 1]) >= _MIXED.min_moved_px
    at = before.z[far, :2]
    return np.rint(at).astype(np.int64), np.rint(at - moved[far]).astype(np.int64)


def _differences(image: Image, place: IntArray) -> FloatArray:
    """Differences (N, K) of gray levels along rows and columns in patches about pixels (N, 2)."""
    offset = np.arange(-_MIXED.radius_px, _MIXED.radius_px + 1)
    rows = (place[:, 1, None] + offset)[:, :, None]
    columns = (place[:, 0, None] + offset)[:, None, :]
    patch = image[rows, columns].astype(np.float64)
    step = _MIXED.step_px
    inner = slice(step, -step)
    along = patch[:, inner, 2 * step :] - patch[:, inner, : -2 * step]
    down = patch[:, 2 * step :, inner] - patch[:, : -2 * step, inner]
    return np.concatenate([along, down], axis=1).reshape(len(place), -1)
