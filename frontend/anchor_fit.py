"""Alignment of the features with their anchors in the left image, which does not drift as
Lucas-Kanade does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.cameras.projection import CameraArgs, camera_args, moved_pixel, turn_to
from vio.frontend.align import (
    ITERATIONS,
    MIN_CORRELATION,
    align,
    on_peak,
    rounded,
    scale_change,
    shift_warps,
    template_points,
)
from vio.frontend.detect import min_distance_px
from vio.frontend.motion_blur import MotionBlur
from vio.frontend.outliers import Consensus
from vio.frontend.patches import ImageLevels
from vio.frontend.settings import GridSettings
from vio.frontend.tracks import ANCHOR_REACH_PX, INLIER_PX, AnchorBank, Tracks
from vio.geometry.lie import FloatArray, transform_points
from vio.geometry.stereo import StereoCamera
from vio.numerics.compiled import compiled
from vio.records import BoolArray, IntArray


class _AnchorRules(NamedTuple):
    """When an anchor is replaced."""

    lost_correlation: float = 0.5  # below, the feature is lost
    max_scale: float = 1.25  # change of scale at which the anchor is replaced


_ANCHORS = _AnchorRules()
_MIN_DEPTH_M = 0.1  # after the motion, of a point whose pixel and scale are predicted
_NEAREST_M = 0.05  # of a point that has a pixel to compare with


class AnchorFit:
    """Align features with their anchors, and replace anchors that no longer fit."""

    def __init__(self, camera: StereoCamera, grid: GridSettings, bank: AnchorBank) -> None:
        """Prepare; the bank contains the features' anchors."""
        self._camera = camera
        self._grid = grid
        self._bank = bank
        self._blur = MotionBlur(bank)

    def track(
        self,
        old: Tracks,
        before: ImageLevels,
        left: ImageLevels,
        found: FloatArray,
        seen: BoolArray,
        motion: Consensus | None,
        step_s: float,
    ) -> Tracks:
        """Align the features with their anchors; return those kept, with their new pixels.

        Features that Lucas-Kanade lost are searched at the pixels predicted by the consensus
        motion. Features that were found, but differ from their anchor, get a new anchor from the
        previous frame.

        Args:
            old: features of the previous frame.
            before: its left image.
            left: the left image of this frame.
            found: pixels (N, 2) by Lucas-Kanade.
            seen: mask (N,) of the static features that it found.
            motion: consensus motion since the previous frame, if there is one.
            step_s: time since the previous frame.
        """
        camera = camera_args(self._camera)
        (height, width) = left.full.shape
        if motion is None:
            T = np.eye(4)
        else:
            T = motion.T_curr_prev
        if motion is None:
            point = old.point
        else:
            point = transform_points(T, old.point)
        rows = np.empty(len(old), np.int64)
        start = np.empty((len(old), 2))
        scale = np.empty(len(old))
        moved = _Moved(camera, T, old.point, point, old.has_point)
        count = _begin(
            moved,
            motion is not None,
            (width, height),
            old.left,
            _Found(found, seen),
            _Starts(rows, start, scale),
        )
        rows = rows[:count]
        start = start[:count]
        scale = scale[:count]
        warp = old.warp.take(rows, axis=0)
        slots = old.slot.take(rows)
        warp[:, :, :2] *= scale[:, None, None]
        warp[:, :, 2] = start
        before_px = old.left.take(rows, axis=0)
        self._blur.apply(slots, warp, (start - before_px) / step_s)
        warp, score = align(self._bank.store, slots, left.full, warp, ITERATIONS)
        change = scale_change(warp)
        change = np.maximum(change, 1.0 / change)
        good = (
            (score >= MIN_CORRELATION)
            & on_peak(warp[:, :, 2], start)
            & (change <= 2 * _ANCHORS.max_scale)
        )
        kept = good.copy()
        has_point = old.has_point.copy()
        retry = (~good & seen[rows] & (score >= _ANCHORS.lost_correlation)).nonzero()[0]
        if len(retry):
            again = old.left.take(rows[retry], axis=0), slots[retry], start[retry], scale[retry]
            warp[retry], kept[retry] = self._realign(before, left, *again)
        distance = 0.5 * min_distance_px(width, height, self._grid)
        if motion is not None:
            moved = moved._replace(has_point=has_point)
            _reject_deviating(moved, old.has_right, rows, warp, kept)
        _reject_crowded(warp, distance, kept)
        chosen = kept.nonzero()[0]
        rows = rows[chosen]
        slots = slots[chosen]
        warp = warp.take(chosen, axis=0)
        moved_px = warp[:, :, 2] - before_px.take(chosen, axis=0)
        self._blur.learn(left.full, slots, warp, moved_px, step_s)
        rescaled = (good & (change > _ANCHORS.max_scale))[chosen]
        if rescaled.any():
            centres = rounded(warp[rescaled, :, 2])
            self._bank.replace(slots[rescaled], left.full, centres)
            warp[rescaled] = shift_warps(centres)
        return Tracks(
            ids=old.ids.take(rows),
            left=warp[:, :, 2].copy(),
            right=old.right.take(rows, axis=0),
            has_right=np.zeros(len(rows), dtype=np.bool_),
            left_only_frames=old.left_only_frames.take(rows),
            age=old.age.take(rows) + 1,
            shown=old.shown.take(rows),
            point=point.take(rows, axis=0),
            has_point=has_point.take(rows),
            slot=slots,
            warp=warp,
            skew=old.skew.take(rows, axis=0),
        )

    def _realign(
        self,
        before: ImageLevels,
        left: ImageLevels,
        pixels: FloatArray,
        slots: IntArray,
        start: FloatArray,
        scale: FloatArray,
    ) -> tuple[FloatArray, BoolArray]:
        """Align features with a new anchor from the previous frame; return warps (N, 2, 3) and a
        mask (N,).

        Args:
            before: left image of the previous frame.
            left: that of this frame.
            pixels: features (N, 2) in the former.
            slots: their anchors (N,), which are replaced.
            start: pixels (N, 2) in the latter to start from.
            scale: predicted change of scale (N,).
        """
        centres = rounded(pixels)
        self._bank.replace(slots, before.full, centres)
        warp = shift_warps(start + centres - pixels)
        warp[:, :, :2] *= scale[:, None, None]
        warp, score = align(self._bank.store, slots, left.full, warp, ITERATIONS)
        # The anchor was cut at a rounded pixel; correct the offset to the feature.
        warp[:, :, 2] = template_points(warp, pixels - centres)
        return warp, (score >= MIN_CORRELATION) & on_peak(warp[:, :, 2], start)


class _Moved(NamedTuple):
    """The points of N features, moved by the consensus motion."""

    camera: CameraArgs
    T: FloatArray  # (4, 4)
    before: FloatArray  # (N, 3)
    after: FloatArray  # (N, 3)
    has_point: BoolArray  # (N,)


class _Found(NamedTuple):
    """Features by Lucas-Kanade."""

    pixels: FloatArray  # (N, 2)
    seen: BoolArray  # (N,)


class _Starts(NamedTuple):
    """Where alignments start; room for N features."""

    rows: IntArray  # (K,)
    pixels: FloatArray  # (K, 2) in the left image
    scale: FloatArray  # (K,) predicted change


@compiled
def _begin(
    points: _Moved,
    moved: bool,
    size: tuple[int, int],
    left: FloatArray,
    found: _Found,
    out: _Starts,
) -> int:
    """Write which of the previous frame's features, at pixels (N, 2), are aligned, and return their
    number K.

    They start where they were found; with a consensus motion (`moved`), others with a point start
    at the pixel where it takes that. The size is the image's width and height.
    """
    camera = points.camera
    old_point = points.before
    point = points.after
    has_point = points.has_point
    width, height = size
    count = 0
    margin = ANCHOR_REACH_PX + 2.0
    for n in range(len(left)):
        u = found.pixels[n, 0]
        v = found.pixels[n, 1]
        change = 1.0
        if moved and has_point[n]:
            depth = turn_to(camera, point[n, 1], point[n, 2])[4]
            if depth > _MIN_DEPTH_M:
                change = turn_to(camera, old_point[n, 1], old_point[n, 2])[4] / depth
        if not found.seen[n]:
            if not (moved and has_point[n]):
                continue
            u, v, depth = moved_pixel(
                camera, points.T, old_point[n, 0], old_point[n, 1], old_point[n, 2]
            )
            if not depth > _MIN_DEPTH_M:
                u = left[n, 0]
                v = left[n, 1]
            if not (margin <= u <= width - 1 - margin and margin <= v <= height - 1 - margin):
                continue
        out.rows[count] = n
        out.pixels[count, 0] = u
        out.pixels[count, 1] = v
        out.scale[count] = change
        count += 1
    return count


@compiled
def _reject_deviating(
    points: _Moved, has_right: BoolArray, rows: IntArray, warp: FloatArray, kept: BoolArray
) -> None:
    """Clear the mask (K,) of aligned features that are not where the motion takes their points.

    A point whose depth was propagated without a measurement is dropped in place of its feature, in
    `points.has_point`.
    """
    point = points.before
    has_point = points.has_point
    for k, n in enumerate(rows):
        u, v, depth = moved_pixel(points.camera, points.T, point[n, 0], point[n, 1], point[n, 2])
        du = u - warp[k, 0, 2]
        dv = v - warp[k, 1, 2]
        if not depth > _NEAREST_M or np.sqrt(du * du + dv * dv) > INLIER_PX:
            kept[k] &= not (has_point[n] and has_right[n])
            has_point[n] = False


@compiled
def _reject_crowded(warp: FloatArray, distance: float, kept: BoolArray) -> None:
    """Clear the mask (K,) of features closer than a distance, in the maximum norm, to an earlier
    one that has it.
    """
    given = kept.copy()
    for n in range(len(kept)):
        for m in range(n if given[n] else 0):
            du = warp[n, 0, 2] - warp[m, 0, 2]
            dv = warp[n, 1, 2] - warp[m, 1, 2]
            if given[m] and abs(du) < distance and abs(dv) < distance:
                kept[n] = False
                break
