"""Alignment of the features with their anchors in the left image, which does not drift as Lucas-Kanade does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.frontend.align import align, on_peak, rounded, scale_change, shift_warps, template_points
from vio.frontend.columns import changed, take
from vio.frontend.detect import min_distance_px
from vio.frontend.outliers import Consensus, pixel_errors
from vio.frontend.patches import ImageLevels, inside
from vio.frontend.prediction import moved_pixels
from vio.frontend.settings import GridSettings
from vio.frontend.tracks import ANCHOR_RADIUS_PX, INLIER_PX, AnchorBank, Tracks
from vio.geometry.lie import FloatArray, transform_points
from vio.geometry.stereo import StereoCamera, depth_of
from vio.numerics.compiled import compiled
from vio.records import BoolArray, IntArray

_ITERATIONS = 5
_MIN_CORRELATION = 0.8  # normalised, with the anchor; below, the anchor is replaced
_ANCHOR_LOST = 0.5  # below, the feature is lost
_MAX_SCALE = 1.25  # change of scale at which the anchor is replaced


@dataclass(frozen=True, slots=True)
class _Start:
    """Start of the alignment of the previous frame's features with their anchors."""

    pixels: FloatArray  # (N, 2) left pixels
    scale: FloatArray  # (N,) predicted change of scale since the previous frame
    point: FloatArray  # (N, 3) moved by the camera motion where it is known, cam0 frame, metres
    tried: BoolArray  # (N,) to be aligned


class AnchorFit:
    """Align features with their anchors, and replace anchors that no longer fit."""

    def __init__(self, camera: StereoCamera, grid: GridSettings, bank: AnchorBank) -> None:
        """Prepare; the bank contains the features' anchors."""
        self._camera, self._grid, self._bank = camera, grid, bank

    def track(
        self,
        old: Tracks,
        before: ImageLevels,
        left: ImageLevels,
        found: FloatArray,
        seen: BoolArray,
        motion: Consensus | None,
    ) -> Tracks:
        """Align the features with their anchors; return those kept, with their new pixels.

        Features that Lucas-Kanade lost are searched at the pixels predicted by the consensus motion. Features that were
        found, but differ from their anchor, get a new anchor from the previous frame.

        Args:
            old: features of the previous frame.
            before: its left image.
            left: the left image of this frame.
            found: pixels (N, 2) by Lucas-Kanade.
            seen: mask (N,) of the static features that it found.
            motion: consensus motion since the previous frame, if there is one.
        """
        start = self._start(old, left, found, seen, motion)
        rows = start.tried.nonzero()[0]
        warp, pixels, point = old.warp.take(rows, axis=0), start.pixels.take(rows, axis=0), old.point.take(rows, axis=0)
        warp[:, :, :2] *= start.scale[rows, None, None]
        warp[:, :, 2] = pixels
        warp, score = align(self._bank.store, old.slot[rows], left.full, warp, _ITERATIONS)
        change = np.abs(np.log(scale_change(warp)))
        good = (score >= _MIN_CORRELATION) & on_peak(warp[:, :, 2], pixels)
        good &= change <= np.log(2 * _MAX_SCALE)
        kept, has_point = good.copy(), old.has_point.copy()
        retry = (~good & seen[rows] & (score >= _ANCHOR_LOST)).nonzero()[0]
        if len(retry):
            warp[retry], kept[retry] = self._realign(old, before, left, rows[retry], start)
        if motion is not None:
            deviates = pixel_errors(self._camera, motion.T_curr_prev, point, warp[:, :, 2]) > INLIER_PX
            kept &= ~(deviates & old.has_point[rows] & old.has_right[rows])
            has_point[rows[deviates]] = False  # its depth was propagated without a measurement, and was wrong
        rescaled = good & (change > np.log(_MAX_SCALE))
        kept_rows = kept.nonzero()[0]
        height, width = left.full.shape
        apart = _spaced(warp[kept_rows, :, 2], 0.5 * min_distance_px(width, height, self._grid))
        kept_rows = kept_rows[apart]
        rows, warp, rescaled = rows[kept_rows], warp.take(kept_rows, axis=0), rescaled[kept_rows]
        if rescaled.any():
            centres = rounded(warp[rescaled, :, 2])
            self._bank.replace(old.slot[rows[rescaled]], left.full, centres)
            warp[rescaled] = shift_warps(centres)
        return changed(
            take(old, rows),
            left=warp[:, :, 2].copy(),
            warp=warp,
            point=start.point.take(rows, axis=0),
            has_point=has_point[rows],
            age=old.age[rows] + 1,
            has_right=np.zeros(len(rows), dtype=np.bool_),
        )

    def _start(
        self, old: Tracks, left: ImageLevels, found: FloatArray, seen: BoolArray, motion: Consensus | None
    ) -> _Start:
        """Start the alignment at the pixel found by Lucas-Kanade, else at the pixel predicted by the motion."""
        if motion is None:
            return _Start(found, np.ones(len(old)), old.point, seen)
        point = transform_points(motion.T_curr_prev, old.point)
        predicted = moved_pixels(self._camera, motion.T_curr_prev, old.point, old.left)
        margin = ANCHOR_RADIUS_PX + 2.0
        depth, before = depth_of(self._camera, point), depth_of(self._camera, old.point)
        ahead = old.has_point & (depth > 0.1)
        return _Start(
            np.where(seen[:, None], found, predicted),
            np.where(ahead, before / np.where(ahead, depth, 1.0), 1.0),
            point,
            seen | (old.has_point & inside(left.full, predicted, margin)),
        )

    def _realign(
        self, old: Tracks, before: ImageLevels, left: ImageLevels, rows: IntArray, start: _Start
    ) -> tuple[FloatArray, BoolArray]:
        """Align features with a new anchor from the previous frame; return warps (N, 2, 3) and a mask (N,)."""
        centres = rounded(old.left[rows])
        self._bank.replace(old.slot[rows], before.full, centres)
        warp = shift_warps(start.pixels[rows] + centres - old.left[rows])
        warp[:, :, :2] *= start.scale[rows, None, None]
        warp, score = align(self._bank.store, old.slot[rows], left.full, warp, _ITERATIONS)
        # The anchor was cut at a rounded pixel; correct the offset to the feature.
        warp[:, :, 2] = template_points(warp, old.left[rows] - centres)
        return warp, (score >= _MIN_CORRELATION) & on_peak(warp[:, :, 2], start.pixels[rows])


def _spaced(points: FloatArray, distance: float) -> BoolArray:
    """Mask (N,) of points (N, 2) without an earlier point closer than `distance` in the maximum norm."""
    out = np.ones(len(points), dtype=np.bool_)
    _mark_crowded(points, distance, out)
    return out


@compiled
def _mark_crowded(points: FloatArray, distance: float, apart: BoolArray) -> None:
    for n in range(len(points)):
        for m in range(n):
            du, dv = points[n, 0] - points[m, 0], points[n, 1] - points[m, 1]
            if abs(du) < distance and abs(dv) < distance:
                apart[n] = False
                break
