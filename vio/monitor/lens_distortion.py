"""Whether rectified pixels still have the distortion of the lenses, or one too much taken out.

Raw images under a rectified calibration, and rectified ones under a raw one, move both pixels of a
point by a share of their squared distances from the principal point. As left and right pixels lie
at other distances, the rows of a near point differ from those of a far one beside it: by
`k1 y (xr^2 - x^2)`, for the normalised pixels `x, y` and `xr` (equation (R2) of docs/math.md). No
turn, shift or focal length of a camera does that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.cameras.rectification_error import vertical_disparity_terms
from vio.findings import Finding, begun
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics.arrays import distinct
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import cauchy_fit, fits_without_blocks, jackknife, median
from vio.records import IntArray, Observations


class _LensRules(NamedTuple):
    """When pixels are distorted."""

    # frames with matches, after which it is asked
    looked_at: tuple[int, ...] = (20, 40, 80, 160)
    most: int = 10  # whose matches are kept, spread over all so far
    # Of features, each of which is left out once: all matches of a feature have its error, which
    # none of them shows. So are cells of the image, along u and v: features at the rim of a near
    # thing, and those of a texture that repeats, have errors in common.
    blocks: Tolerance[int] = 10
    cells: tuple[int, int] = (4, 3)
    min_features: int = 100
    sigmas: float = 6.0  # beyond which it is known
    # … where these are small: of a scene that hardly shows it, what is no noise comes to more
    max_sigma: float = 0.01
    # Share of its distance from the principal point by which a pixel moves where that squared is half
    # the corners'. Healthy recordings have up to .014, of KITTI's own rectification.
    min_share: float = 0.03
    steps: Tolerance[int] = 10  # of the robust fit, and of each that leaves a block out
    further_steps: Tolerance[int] = 2
    least_px: float = 0.1  # width of a row's error, at least


_LENS = _LensRules()
_CODE = "other-calibration"


def lens_check(camera: StereoCamera) -> LensCheck | None:
    """Return the check of a rectified pair; None: one camera, or one of another projection."""
    is_pair = camera.kind == "stereo" and not camera.is_cylinder
    return LensCheck(camera) if is_pair else None


class LensCheck:
    """Asks after some frames of a run whether their pixels are distorted."""

    def __init__(self, camera: StereoCamera) -> None:
        """Begin, with the rectified pair."""
        self._camera = camera
        self._matches: list[Observations] = []  # of every so many-th frame
        self._every = 1
        self._frames = 0
        width = camera.width or 2.0 * camera.cu
        height = camera.height or 2.0 * camera.cv
        corner = (0.5 * width / camera.fu) ** 2 + (0.5 * height / camera.fv) ** 2
        self._squares = np.array([0.5 * corner, (0.5 * corner) ** 2])  # of the radius: r^2, r^4

    @property
    def done(self) -> bool:
        """Whether it is not asked any more."""
        return self._frames >= _LENS.looked_at[-1]

    def frame(self, seen: Observations) -> Finding | None:
        """Return the finding after a frame."""
        if self.done or not seen.has_right.any():
            return None
        if self._frames % self._every == 0:
            self._matches.append(seen.take(seen.has_right))
        self._frames += 1
        if len(self._matches) > _LENS.most:
            del self._matches[1::2]
            self._every *= 2
        if self._frames not in _LENS.looked_at:
            return None
        found = self._share()
        if self.done:
            self._matches.clear()
        if found is None:
            return None
        share, sigma = found
        if abs(share) <= max(_LENS.min_share, _LENS.sigmas * sigma) or sigma > _LENS.max_sigma:
            return None
        self._frames = _LENS.looked_at[-1]
        self._matches.clear()
        index = seen.frame_index
        text = (
            "rows of near and far points differ as lens distortion makes them, by "
            f"{100 * abs(share):.0f} % of a pixel's way from the middle: raw images were given with a "
            "rectified calibration, rectified ones with a raw one, or the lenses are others; give the "
            "calibration of these images"
        )
        figures = {"distorted_share": share, "distorted_share_sigma": sigma}
        return begun(_CODE, index, text, 0, figures=figures)

    def _share(self) -> tuple[float, float] | None:
        """By which share of its distance from the principal point a pixel is off where that squared
        is half the corners', and the standard error; None: too few features.
        """
        ids = np.concatenate([seen.ids for seen in self._matches])
        if len(distinct(ids)) < _LENS.min_features:
            return None
        z = np.concatenate([seen.z for seen in self._matches])
        terms = self._terms(z)
        rows = (z[:, 3] - z[:, 1]) / self._camera.fv
        least = _LENS.least_px / self._camera.fv
        start = np.zeros(terms.shape[1])
        start[2] = median(rows)
        whole = cauchy_fit(terms, rows, start, least, _LENS.steps)
        sigmas = []
        for block in (_blocks(ids, _LENS.blocks), self._cells(z)):
            without = fits_without_blocks(terms, rows, whole, block, least, _LENS.further_steps)
            sigmas.append(float(jackknife(without[:, :2] @ self._squares)))
        return float(self._squares @ whole[:2]), max(sigmas)

    def _cells(self, z: FloatArray) -> IntArray:
        """The cell (N,) of the image that left pixels of `[ul vl ur vr]` (N, 4) lie in."""
        columns, rows = _LENS.cells
        u = z[:, 0] / (self._camera.width or 2.0 * self._camera.cu)
        v = z[:, 1] / (self._camera.height or 2.0 * self._camera.cv)
        column = np.clip(u * columns, 0, columns - 1).astype(np.int64)
        out: IntArray = column + columns * np.clip(v * rows, 0, rows - 1).astype(np.int64)
        return out

    def _terms(self, z: FloatArray) -> FloatArray:
        """The terms (N, 13) of rows, those of k1 and k2 first: then those of (R2), the cubic ones of
        lenses that differ, and tangential distortion.
        """
        rows, common = vertical_disparity_terms(self._camera, z)
        x = (z[:, 0] - self._camera.cu) / self._camera.fu
        y = (z[:, 1] - self._camera.cv) / self._camera.fv
        return np.column_stack([common[:, :2], rows, x * x * y, y**3, common[:, 2:]])


def _blocks(ids: IntArray, count: int) -> IntArray:
    """The block (N,) of matches by the ids of their features: those that were found together are in
    one, and all of a feature.
    """
    _, feature, matches = np.unique(ids, return_inverse=True, return_counts=True)
    before = np.cumsum(matches) - matches
    out: IntArray = (before * count // len(ids))[feature]
    return out
