"""Whether features that stay at the same pixels are those of the scene, by images alone.

A reflection on a windscreen or dirt on it may show more contrast than the road behind, and then all
features are its own: the rig seems to stand still. But at standstill the view stays as it is, up to
noise, exposure and lamps that flicker over the rows, and what moves covers a part of it; behind a
reflection nearly all of it changes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.findings import Finding, begun, ended
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity
from vio.numerics.robust import medians
from vio.records import BoolArray, Image


class _StillRules(NamedTuple):
    """When features stay while the view changes."""

    still_px: float = 0.5  # median flow of features that stay
    every: Capacity[int] = 3  # frames are compared, each with the one before
    checks: int = 2  # in a row, in which the view changes
    moved_frames: int = 5  # in a row in which features move, before it is over …
    calm_checks: int = 4  # … or checks in a row in which the view stays
    # Cells of the image, each by the median of some pixels, which rain and snow leave as it is.
    cell_px: Capacity[int] = 40
    stride_px: Capacity[int] = 4
    min_cells: int = 24
    changed_gray: float = 2.0  # change of a cell beside that of the exposure …
    noise_sigmas: float = 2.0  # … which is as many times what noise changes it by
    # Gray levels beyond which pixels are saturated, and share of a cell's that may be.
    dark_gray: int = 2
    bright_gray: int = 253
    saturated_share: float = 0.1
    # Share of the cells that change. KITTI behind reflections: 0.61 and more; at standstill with noise,
    # snow, changing exposure or lamps that flicker by a fifth 0.18 and less, with objects or leaves over
    # half of the view 0.49 and less, with leaves over nearly all of it 0.29 to 0.64.
    changed_share: float = 0.55
    steps: int = 4  # of the fit of the exposure


_STILL = _StillRules()
_CODE = "rig-in-view"


class StillFeatures:
    """Reports that features stay while the view changes, until they move or it stays as well."""

    def __init__(self) -> None:
        self._last: Image | None = None  # left image of the frame before
        self._since: int | None = None  # first frame since which features stay
        self._count = 0  # frames since then
        self._changed = 0  # checks in a row in which the view changes
        self._calm = 0  # checks in a row in which it stays, since it was reported
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
        if self._count % _STILL.every or image is None or before is None:
            return []
        share = _changed_share(before, image)
        if self._reported:
            self._calm = self._calm + 1 if share < _STILL.changed_share else 0
            return self._stays(index)
        self._changed = self._changed + 1 if share >= _STILL.changed_share else 0
        if self._changed < _STILL.checks:
            return []
        self._reported = True
        self._calm = 0
        text = (
            f"all features stay at the same pixels since frame {self._since}, while "
            f"{100 * share:.0f} % of the view changes: a reflection or a pattern on a window is taken "
            "for the scene, or something moves nearly everywhere before a rig that stands still"
        )
        figures = {"changed_share": share}
        return [begun(_CODE, index, text, self._since, figures=figures)]

    def _stays(self, index: int) -> list[Finding]:
        if self._calm < _STILL.calm_checks:
            return []
        self._reported = False
        self._since = None
        self._count = 0
        self._changed = 0
        return [ended(_CODE, index, "the view stays as the features do")]

    def _moves(self, index: int) -> list[Finding]:
        self._since = None
        self._count = 0
        self._changed = 0
        self._moved += 1
        if not self._reported or self._moved < _STILL.moved_frames:
            return []
        self._reported = False
        return [ended(_CODE, index, "features move again")]


def _changed_share(before: Image, image: Image) -> float:
    """Share of the cells of an image (H, W) that differ from those before by more than noise.

    With the exposure as it was, as it fits the cells, or as it is in each row: the smallest one, as an
    object over half of them misleads a fit.
    """
    if before.shape != image.shape:
        return 0.0
    usable = ~(_saturated(before) | _saturated(image))
    if usable.sum() < _STILL.min_cells:
        return 0.0
    noise = np.hypot(_noise(before), _noise(image))[usable]
    # standard deviation of the median of as many values
    noise *= np.sqrt(0.5 * np.pi) / (_STILL.cell_px // _STILL.stride_px)
    limit = np.maximum(_STILL.changed_gray, _STILL.noise_sigmas * noise)
    old = _thin(before)
    new = _thin(image)
    of_rows = medians(((new + 1.0) / (old + 1.0)).T)[:, None]
    was = _cells(old)[usable]
    now = _cells(new)[usable]
    gain, offset = _exposure(was, now)
    changes = now - was, now - gain * was - offset, _cells(new / of_rows)[usable] - was
    return min(float((np.abs(change) > limit).mean()) for change in changes)


def _exposure(old: FloatArray, new: FloatArray) -> tuple[float, float]:
    """Gain and offset from gray levels (N,) to others (N,) of the same cells, robustly."""
    of_exposure = np.stack([old, np.ones_like(old)], axis=1)
    weight = np.ones_like(old)
    fit = np.array([1.0, 0.0])
    for _ in range(_STILL.steps):
        normal = of_exposure.T @ (weight[:, None] * of_exposure)
        fit = np.linalg.lstsq(normal, of_exposure.T @ (weight * new), rcond=None)[0]
        weight = 1.0 / (1.0 + ((new - of_exposure @ fit) / _STILL.changed_gray) ** 2)
    return float(fit[0]), float(fit[1])


def _thin(image: Image, right: int = 0) -> FloatArray:
    """Gray levels (h, w) of some pixels of whole cells of an image (H, W), or of those `right` of
    them.
    """
    step = _STILL.stride_px
    height, width = (side // _STILL.cell_px * _STILL.cell_px for side in image.shape)
    return image[step // 2 : height : step, step // 2 + right : width : step].astype(np.float64)


def _by_cell(thin: FloatArray) -> FloatArray:
    """Values (N, K) of the cells of an image by its values at some pixels (h, w)."""
    size = _STILL.cell_px // _STILL.stride_px
    rows = thin.shape[0] // size
    columns = thin.shape[1] // size
    parts = thin.reshape(rows, size, columns, size).swapaxes(1, 2)
    return parts.reshape(rows * columns, size * size)


def _cells(thin: FloatArray) -> FloatArray:
    """Medians (N,) of cells."""
    return medians(_by_cell(thin).T)


def _saturated(image: Image) -> BoolArray:
    """Which cells (N,) of an image (H, W) have many saturated pixels."""
    thin = _thin(image)
    is_saturated = (thin <= _STILL.dark_gray) | (thin >= _STILL.bright_gray)
    return np.asarray(
        _by_cell(is_saturated.astype(np.float64)).mean(axis=1) > _STILL.saturated_share
    )


def _noise(image: Image) -> FloatArray:
    """Standard deviation (N,) of the noise of pixels in the cells of an image (H, W), with its finest
    texture: by second differences along the rows.
    """
    bent = _thin(image, -1) - 2.0 * _thin(image) + _thin(image, 1)
    return _cells(np.abs(bent)) / (0.6745 * np.sqrt(6.0))
