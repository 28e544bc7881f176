"""Whether the features that are taken for the scene follow two motions, over as many frames as it
takes them to move.

From one frame to the next, what a slow rig carries in its view, a mirror or a second image on a
windscreen moves as the scene does, to within the noise of pixels, and the consensus of a frame holds
both. Over more frames they come apart.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.frontend.outliers import RansacProblem, best_motion, pixel_errors
from vio.geometry.lie import FloatArray, length, lengths
from vio.geometry.stereo import StereoCamera, triangulate
from vio.numerics.kinds import Capacity
from vio.numerics.robust import median, quantile
from vio.records import IntArray, Observations, shared_rows


class _MotionRules(NamedTuple):
    """When features follow two motions."""

    spans: tuple[int, ...] = (1, 2, 4, 8, 16)  # frames: the shortest over which features move
    every: Capacity[int] = 3  # frames are compared
    checks: int = 3  # the newest, of which the median counts
    min_features: int = 30  # that both frames show, with a depth
    # of which a quarter moves by so much over a span
    moved_share: float = 0.25
    moved_px: float = 4.0
    # by less, a feature may stay where it is while others move: it says nothing of their motion
    still_px: float = 3.0
    inlier_px: float = 1.5  # of a motion
    # from where the first motion has a feature of the second, at least, and how far disparities may
    # be off: by as much, times the way over the baseline, so may its pixel
    apart_px: float = 4.0
    disparity_px: float = 1.5
    min_inliers: float = 0.5  # share of the moved features that follow the first motion
    min_second: int = 12  # features of the second
    # Share of all that follow it. Healthy recordings and their variants have 0 in all checks, the
    # course's drives up to 0.5 in single ones.
    min_share: float = 0.1


_MOTIONS = _MotionRules()
_STILL = np.eye(4)


@dataclass(frozen=True, slots=True)
class Apart:
    """What follows a second motion at present."""

    share: float  # of the features
    since: int  # frame from which these features were used
    still: bool  # it stays at the same pixels


class TwoMotions:
    """Compares frames with earlier ones, every few frames."""

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        self._has_depth = camera.kind != "mono"
        self._frames = deque[Observations](maxlen=_MOTIONS.spans[-1] + 1)
        # features of the last frame that was compared, and the frames that they were seen in first,
        # or the one after that compared before
        self._ids: IntArray = np.zeros(0, dtype=np.int64)
        self._first: IntArray = np.zeros(0, dtype=np.int64)
        self._index: int | None = None  # of that frame
        self._found = deque[Apart](maxlen=_MOTIONS.checks)
        self._count = 0

    def frame(self, seen: Observations) -> Apart | None:
        """Return what follows a second motion, by this frame and those before it."""
        if not self._has_depth:
            return None
        self._frames.append(seen)
        self._count += 1
        if self._count % _MOTIONS.every == 0:
            self._see(seen)
            self._found.append(self._compare(seen) or Apart(0.0, seen.frame_index, False))
        if len(self._found) < _MOTIONS.checks:
            return None
        share = median(np.array([found.share for found in self._found]))
        if share < _MOTIONS.min_share:
            return None
        named = [found for found in self._found if found.share >= share]
        return Apart(share, min(found.since for found in named), named[-1].still)

    def _see(self, seen: Observations) -> None:
        """Keep the frames that features were seen in first."""
        earliest = self._frames[0].frame_index if self._index is None else self._index + 1
        first = np.full(len(seen), earliest)
        rows, others = shared_rows(seen.ids, self._ids)
        first[rows] = self._first[others]
        self._ids = seen.ids
        self._first = first
        self._index = seen.frame_index

    def _compare(self, seen: Observations) -> Apart | None:
        """Compare a frame with the last one since which its features have moved."""
        for span in _MOTIONS.spans:
            if span >= len(self._frames):
                return None
            shared = self._shared(self._frames[-1 - span], seen)
            if len(shared.p) < _MOTIONS.min_features:
                return None
            moved_px = lengths(shared.pixels - shared.before)
            if quantile(moved_px, 1.0 - _MOTIONS.moved_share) >= _MOTIONS.moved_px:
                return self._second_motion(seen.frame_index, shared, moved_px)
        return None

    def _shared(self, before: Observations, seen: Observations) -> _Shared:
        old, new = shared_rows(before.ids, seen.ids)
        usable = before.has_right[old] & ~(before.stale[old] | seen.stale[new])
        old = old[usable]
        new = new[usable]
        point, valid = triangulate(self._camera, before.z[old])
        old = old[valid]
        new = new[valid]
        return _Shared(self._first[new], point[valid], before.z[old, :2], seen.z[new, :2])

    def _second_motion(self, index: int, shared: _Shared, moved_px: FloatArray) -> Apart | None:
        camera = self._camera
        moved = moved_px > _MOTIONS.still_px
        problem = RansacProblem(camera, _MOTIONS.inlier_px, np.random.default_rng((0, index)))
        T, follow = best_motion(problem, shared.p[moved], shared.pixels[moved], _STILL[None])
        if follow.mean() < _MOTIONS.min_inliers:
            return None
        way = length(T[:3, 3]) / camera.baseline_m
        limit_px = _MOTIONS.apart_px + _MOTIONS.disparity_px * way
        apart = pixel_errors(camera, T, shared.p, shared.pixels) > limit_px
        if int(apart.sum()) < _MOTIONS.min_second:
            return None
        p = shared.p[apart]
        pixels = shared.pixels[apart]
        _, second = best_motion(problem, p, pixels, _STILL[None])
        if int(second.sum()) < _MOTIONS.min_second:
            return None
        since = int(shared.first[apart][second].min())
        still = median(moved_px[apart][second]) < _MOTIONS.inlier_px
        return Apart(float(second.sum()) / len(shared.p), since, still)


@dataclass(frozen=True, slots=True)
class _Shared:
    """Features of two frames."""

    first: IntArray  # (K,) frames that they were seen in first
    p: FloatArray  # (K, 3) metres, cam0 frame of the earlier one
    before: FloatArray  # (K, 2) left pixels in the earlier one
    pixels: FloatArray  # (K, 2) left pixels in the later one
