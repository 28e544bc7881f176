"""Whether the images are scaled, stretched or cropped otherwise from one frame to the next.

A stream that negotiates another size, a driver that bins pixels, or a zoom lens changes where the
calibration holds. Points of known depth then move by a share of their distance from the principal
point, or all by the same pixels, which no motion of a rig explains. Both are fitted, beside the
motion, where features lie far from where they were predicted. Where few features or a flat scene
leave the fit of both unknown, a shift alone or a scale alone decides that explains the pixels as
well. A change that explains them no better than the motion alone is none.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.findings import Finding, begun, ended
from vio.geometry.lie import FloatArray, circledot, length, se3_exp, transform_points
from vio.geometry.stereo import DEPTH_DISPARITY_PX, StereoCamera, project, triangulate, z_D_p_cam
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import cauchy_equations
from vio.records import BoolArray, Observations, shared_rows


class _GeometryRules(NamedTuple):
    """When the geometry of images has changed."""

    # Nothing is fitted below this median innovation over its standard deviation, unless fewer
    # features than this share of those of the frame before are left.
    min_sigmas: float = 2.0
    left_share: float = 0.75
    min_features: int = 30  # that both frames show, with a depth
    steps: Tolerance[int] = 6  # of Gauss-Newton
    least_px: float = 0.02  # error of a pixel, at least
    # standard deviations, beyond which a change is there. A fit of any two frames of eight healthy
    # recordings and their variants gives growths up to .006 at 3, .002 at 10, and shifts up to 2 px
    # at 20, 7 px at 5.
    sigmas: float = 8.0
    # Times the least change, or times the change, as which these are at most: else a part of it is
    # not known. A fit of 63 features of KITTI with their outliers gives a growth of .05 at 15, known
    # to 3.
    most_uncertain: float = 2.0
    share_uncertain: float = 0.3
    min_growth: float = 0.005
    min_shift_px: float = 3.0
    # variance of the pixels by a simple change, over that by a free one, up to which it explains
    # them as well; likewise by none at all, over that by a change, which then is none
    as_well: float = 1.3
    # how far all disparities may be off: by as much, times the way over the baseline, so may pixels
    disparity_px: float = 1.0


_RULES = _GeometryRules()
_CODE = "image-geometry-changed"
_MIN_DEPTH_M: Tolerance[float] = 0.05
_NONE = np.array([1.0, 1.0, 0.0, 0.0])
# What may change (4, K), of `_Change.value`: all of it, the shifts, or one scale of columns and
# rows.
_FREE = np.eye(4)
_NOTHING = _FREE[:, :0]
_SIMPLE = _FREE[:, 2:], np.array([[1.0], [1.0], [0.0], [0.0]])


@dataclass(frozen=True, slots=True)
class _Change:
    """By how much pixels of a frame are off those that the motion explains."""

    value: FloatArray  # (4,) growth of columns and rows about the principal point, their shifts, px
    least: FloatArray  # (4,) up to which it counts as none, however well it is known
    limit: FloatArray  # (4,) likewise, as it is known
    variance: float  # of the pixels, px^2

    @property
    def known(self) -> BoolArray:
        """Which parts (4,) of it are known well enough."""
        most = np.maximum(
            _RULES.most_uncertain * self.least, _RULES.share_uncertain * np.abs(self.value)
        )
        return self.limit <= most

    @property
    def is_clear(self) -> bool:
        """Whether a part of it is known, and beyond its limit."""
        return bool((self.known & (np.abs(self.value) > self.limit)).any())

    def beyond(self, size: FloatArray, limit: FloatArray) -> _Change:
        """What is known of it beyond sizes (4,) either way, by the larger one of two limits."""
        left = np.copysign(np.maximum(np.abs(self.value) - size, 0.0), self.value)
        change = replace(self, value=left, limit=np.maximum(self.limit, limit))
        return replace(change, value=np.where(change.known, left, 0.0))


class ImageGeometry:
    """Reports that images are scaled or cropped otherwise, and when they are as before again."""

    def __init__(self, camera: StereoCamera) -> None:
        """Prepare for the frames of a rectified camera."""
        self._camera = camera
        self._has_depth = camera.kind != "mono"
        self._frames = deque[Observations](maxlen=3)
        # (4,) factors of columns and rows, and shifts in px, since the first frame
        self._since_first = _NONE.copy()
        self._changed = False  # as reported
        # (4,) what the frame before was found to differ by: not what pairs usually differ by
        self._counted = np.zeros(4)

    def frame(self, seen: Observations, innovation_ratio: float | None) -> list[Finding]:
        """Return what a frame shows, whose innovation over its standard deviation is given; None:
        no feature was predicted.
        """
        frames = self._frames
        frames.append(seen)
        counted = self._counted
        self._counted = np.zeros(4)
        if len(frames) < 3 or not self._has_depth:
            return []
        is_off = innovation_ratio is not None and innovation_ratio >= _RULES.min_sigmas
        is_looked_at = is_off or self._changed
        if not is_looked_at and len(seen) > _RULES.left_share * len(frames[1]):
            return []
        change = self._change(counted)
        if change is None:
            return []
        self._counted = change.value
        factors = 1.0 + change.value[:2]
        self._since_first[:2] *= factors
        self._since_first[2:] = factors * self._since_first[2:] + change.value[2:]
        changed = bool((np.abs(self._since_first - _NONE) > change.limit).any())
        if changed == self._changed:
            return []
        self._changed = changed
        if not changed:
            return [
                ended(_CODE, seen.frame_index, "scale and crop of the images are as before again")
            ]
        return [_changed(seen.frame_index, self._since_first)]

    def _change(self, counted: FloatArray) -> _Change | None:
        """By how much the last frame clearly differs from the one before, less what that differed
        from the one before it beyond what was `counted` (4,); None: nothing is clear.
        """
        first, before, seen = self._frames
        points = _shared_points(self._camera, before, seen)
        if points is None:
            return None
        free = _fitted(self._camera, *points)
        if free is None:
            return None
        candidates = [(free, _FREE)]
        if not free.known.all():
            simple = [(_fitted(self._camera, *points, kind), kind) for kind in _SIMPLE]
            as_well = _RULES.as_well * free.variance
            candidates += [
                (c, kind) for c, kind in simple if c is not None and c.variance < as_well
            ]
        clear = [(change, kind) for change, kind in candidates if change.is_clear]
        still = _fitted(self._camera, *points, _NOTHING) if clear else None
        if still is None:
            return None
        for change, kind in clear:
            if _RULES.as_well * change.variance > still.variance:
                continue
            usual = _between(self._camera, first, before, kind)
            if usual is None:
                continue
            change = change.beyond(np.abs(usual.value - counted), usual.limit)
            if change.is_clear:
                return change
        return None


def _between(
    camera: StereoCamera, before: Observations, after: Observations, kind: FloatArray = _FREE
) -> _Change | None:
    """How the geometry of images differs between two frames, of what may change; None: they do not
    tell.
    """
    points = _shared_points(camera, before, after)
    return None if points is None else _fitted(camera, *points, kind)


def _shared_points(
    camera: StereoCamera, before: Observations, after: Observations
) -> tuple[FloatArray, FloatArray] | None:
    """The points (N, 3) of the frame before that another one shows, and their pixels (N, 3)
    [ul vl ur] in it; None: there are few.
    """
    old, new = shared_rows(before.ids, after.ids)
    usable = before.has_right[old] & after.has_right[new]
    usable &= ~(before.stale[old] | after.stale[new])
    p, valid = triangulate(camera, before.z[old[usable]], min_disparity_px=DEPTH_DISPARITY_PX)
    if int(valid.sum()) < _RULES.min_features:
        return None
    return p[valid], after.z[new[usable][valid], :3]


def _fitted(
    camera: StereoCamera, p: FloatArray, z: FloatArray, kind: FloatArray = _FREE
) -> _Change | None:
    """Fit a motion and a change of geometry to points (N, 3) of the frame before and pixels (N, 3)
    [ul vl ur], with Cauchy's weights; None: they do not determine them.

    `kind` (4, K): the columns that a change is made of.
    """
    center = np.array([camera.cu, camera.cv, camera.cu])
    of_columns = np.array([1.0, 0.0, 1.0])
    of_rows = np.array([0.0, 1.0, 0.0])
    T = np.eye(4)
    value = np.zeros(4)
    for _ in range(_RULES.steps):
        q = transform_points(T, p)
        q[:, 2] = np.maximum(q[:, 2], _MIN_DEPTH_M)
        off = project(camera, q)[:, :3] - center
        growth = value[0] * of_columns + value[1] * of_rows
        shift = value[2] * of_columns + value[3] * of_rows
        r = z - center - (1.0 + growth) * off - shift
        J = np.empty((len(p), 3, 10))
        J[:, :, :6] = z_D_p_cam(camera, q)[:, :3] @ circledot(q)[:, :3] * (1.0 + growth)[:, None]
        J[:, :, 6] = off * of_columns
        J[:, :, 7] = off * of_rows
        J[:, :, 8] = of_columns
        J[:, :, 9] = of_rows
        J = np.concatenate([J[:, :, :6], J[:, :, 6:] @ kind], axis=2)
        equations = cauchy_equations(r, J, _RULES.least_px)
        try:
            inverse = np.linalg.inv(equations.matrix)
        except np.linalg.LinAlgError:
            return None
        step = inverse @ equations.vector
        if not np.isfinite(step).all():
            return None
        T = se3_exp(step[:6]) @ T
        value = value + kind @ step[6:]
    # of Cauchy's weights, which half of the features of normal errors have halved
    of_kind = 2.0 * equations.variance * inverse.diagonal()[6:]
    if not (of_kind > 0.0).all():
        return None
    of_change = kind**2 @ of_kind
    off_px = _RULES.disparity_px * length(T[:3, 3]) / camera.baseline_m
    least = np.array(
        [
            _RULES.min_growth + off_px / camera.fu,
            _RULES.min_growth + off_px / camera.fv,
            _RULES.min_shift_px + off_px,
            _RULES.min_shift_px + off_px,
        ]
    )
    limit = np.maximum(least, _RULES.sigmas * np.sqrt(of_change))
    return _Change(value, least, limit, equations.variance)


def _changed(index: int, since_first: FloatArray) -> Finding:
    columns, rows, right_px, down_px = since_first.tolist()
    text = (
        f"columns and rows of the images are scaled by {columns:.3f} and {rows:.3f}, "
        f"and shifted by {right_px:.1f} and {down_px:.1f} px, from here on: another size, crop or "
        "zoom, for which the calibration is not"
    )
    figures = {
        "columns_factor": columns,
        "rows_factor": rows,
        "right_px": right_px,
        "down_px": down_px,
    }
    return begun(_CODE, index, text, figures=figures)
