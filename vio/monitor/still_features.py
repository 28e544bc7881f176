"""Whether features that stay at the same pixels are those of the scene, by images alone.

A reflection on a windscreen or dirt on it may show more contrast than the road behind, and then all
features are its own: the rig seems to stand still. But at standstill the view stays as it is, up to
noise and exposure, and what moves covers a part of it; behind a reflection nearly all of it changes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.findings import Finding
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity
from vio.records import Image


class _StillRules(NamedTuple):
    """When features stay while the view changes."""

    still_px: float = 0.5  # median flow of features that stay
    every: Capacity[int] = 3  # frames are compared, each with the one before
    checks: int = 2  # in a row, in which the view changes
    moved_frames: int = 5  # in a row in which features move, before it is over
    # Cells of the image, each by the median of some pixels, which rain and snow leave as it is.
    cell_px: Capacity[int] = 40
    stride_px: Capacity[int] = 4
    min_cells: int = 24
    changed_gray: float = 2.0  # change of a cell beside that of the exposure
    # Share of the cells that change. KITTI and MH_01 behind three reflections: 0.55 and more; at
    # standstill with noise, snow or changing exposure 0.18 and less, with objects or leaves over half of
    # the view 0.48 and less, with leaves over nearly all of it 0.29 to 0.64.
    changed_share: float = 0.55
    steps: int = 4  # of the fit of the exposure


_STILL = _StillRules()
_CODE = "rig-in-view"


class StillFeatures:
    """Reports that features stay while the view changes, until they move."""

    def __init__(self) -> None:
        self._last: Image | None = None  # left image of the frame before
        self._since: int | None = None  # first frame since which features stay
        self._count = 0  # frames since then
        self._changed = 0  # checks in a row in which the view changes
        self._moved = 0  # frames in a row in which features move
        self._reported = False

    def frame(self, index: int, image: Image | None, flow_px: float | None) -> list[Finding]:
        """Return what a frame shows.

        Args:
            index: frame number.
            image: (H, W) its left image; None: it has none.
            flow_px: median flow of its features since the frame before; None: nothing tells, or a
                motion sensor does.
        """
        before = self._last
        self._last = image
        if flow_px is None or flow_px > _STILL.still_px:
            return self._moves(index)
        self._moved = 0
        if self._since is None:
            self._since = index
        self._count += 1
        if self._reported or self._count % _STILL.every or image is None or before is None:
            return []
        share = _changed_share(before, image)
        self._changed = self._changed + 1 if share >= _STILL.changed_share else 0
        if self._changed < _STILL.checks:
            return []
        self._reported = True
        message = (
            f"frame {index}: all features stay at the same pixels since frame {self._since}, while "
            f"{100 * share:.0f} % of the view changes: a reflection or a pattern on a window is taken "
            "for the scene, or something moves nearly everywhere before a rig that stands still"
        )
        figures = {"changed_share": share}
        return [Finding(_CODE, message, index, self._since, lasts=True, figures=figures)]

    def _moves(self, index: int) -> list[Finding]:
        self._since = None
        self._count = 0
        self._changed = 0
        self._moved += 1
        if not self._reported or self._moved < _STILL.moved_frames:
            return []
        self._reported = False
        message = f"frame {index}: features move again"
        return [Finding(_CODE, message, index, ended=True)]


def _changed_share(before: Image, image: Image) -> float:
    """Share of the cells of an image (H, W) that differ from those before, with the exposure as it
    was or as it fits them: the smaller one, as an object over half of them misleads the fit.
    """
    if before.shape != image.shape:
        return 0.0
    old = _cells(before)
    new = _cells(image)
    if len(old) < _STILL.min_cells:
        return 0.0
    as_was = _share(new - old)
    of_exposure = np.stack([old, np.ones_like(old)], axis=1)
    weight = np.ones_like(old)
    left = new - old
    for _ in range(_STILL.steps):
        normal = of_exposure.T @ (weight[:, None] * of_exposure)
        gain, offset = np.linalg.lstsq(normal, of_exposure.T @ (weight * new), rcond=None)[0]
        left = new - gain * old - offset
        weight = 1.0 / (1.0 + (left / _STILL.changed_gray) ** 2)
    return min(as_was, _share(left))


def _share(change: FloatArray) -> float:
    return float((np.abs(change) > _STILL.changed_gray).mean())


def _cells(image: Image) -> FloatArray:
    """Gray levels (N,) of the cells of an image (H, W)."""
    step = _STILL.stride_px
    size = _STILL.cell_px // step
    thin = image[step // 2 :: step, step // 2 :: step]
    rows = thin.shape[0] // size
    columns = thin.shape[1] // size
    whole = thin[: rows * size, : columns * size].astype(np.float64)
    parts = whole.reshape(rows, size, columns, size).swapaxes(1, 2)
    return np.asarray(np.median(parts.reshape(rows * columns, size * size), axis=1))
