"""Sub-pixel stereo matching: the anchors of features are aligned with the right image near the
expected row.

The alignment starts at the disparity of a known depth, else at the result of a search along the row
(`frontend.stereo_match`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.cameras.projection import CameraArgs, camera_args, point_at
from vio.frontend.align import ITERATIONS, MAX_MOVE_PX, MIN_CORRELATION, align, is_on_peak
from vio.frontend.columns import changed, share_of
from vio.frontend.patches import ImageLevels
from vio.frontend.settings import DisparitySettings
from vio.frontend.stereo_match import (
    MIN_MATCH_DISPARITY_PX,
    ROW_SEARCH,
    EpipolarRowModel,
    match_rows,
    shifted_rows,
)
from vio.frontend.tracks import ANCHOR_REACH_PX, INLIER_PX, AnchorBank, Tracks
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera, depth_of
from vio.numerics.compiled import compiled
from vio.numerics.robust import median, quantile
from vio.records import BoolArray, Image, IntArray


class _StereoRules(NamedTuple):
    """How features are matched in the right image."""

    max_skew: float = 0.8  # change of disparity per pixel; the road under a car reaches about 0.4
    # how much lower the correlation of the coarse search may be than that of the alignment
    coarse_slack: float = 0.2
    min_depth_m: float = 0.05
    min_disparity_px: float = 0.1  # below, a point is too far away to be located
    row_search_frames: int = 10  # between two such searches, while matches are few
    reach_frames: int = 10  # between two searches beyond the present reach
    # of the points without a match that must have one beyond the reach for it to be doubled …
    beyond_share: float = 0.1
    min_beyond: int = 10  # … and this many at least …
    within_reach: float = 0.9  # … until this share of them is within it
    depth_slack: float = 0.1  # standard deviation of a point's depth by motion alone, over it
    min_spread_px: float = 2.0  # between near and far disparities, to tell an offset from a factor


_STEREO = _StereoRules()
_MAX_ROW_DIFFERENCE_PX = 1.0  # of a match, after the estimated row differences are subtracted


class _RowRules(NamedTuple):
    """When rows are off by a turn of the right camera."""

    min_points: int = 20
    # A pair turns so much in its mount, three times the prior of its calibration, or exposes so far
    # apart.
    max_turn_rad: float = 0.3 * np.pi / 180.0


_ROWS = _RowRules()


class StereoFit:
    """Match features in the right image, and estimate the row differences of matches over the
    image.
    """

    def __init__(
        self,
        camera: StereoCamera,
        disparity: DisparitySettings,
        bank: AnchorBank,
        size: tuple[int, int],
    ) -> None:
        """Prepare for images of one size (width, height); the bank contains the features'
        anchors.
        """
        # doubled where the scene is nearer
        self.max_disparity_px = disparity.max_disparity * size[0]
        self._most_reach_px = ROW_SEARCH.max_disparity * size[0]
        self._reach_wait = 0  # frames until the reach is tried again
        self._camera = camera
        self._bank = bank
        self._rows = EpipolarRowModel(*size)
        self._unmatched = 0  # frames in a row with hardly any match
        self._offset_px = 0.0  # that is taken out of all disparities of the present frame
        # the same of all frames: what a right camera that has turned adds to disparities
        self._turn_px = 0.0
        # by how much the disparities of the present frame exceed those that the depths of the frame
        # before give (median); None: too few
        self.common_px: float | None = None

    def track_right(self, tracks: Tracks, right: ImageLevels, moved: bool) -> Tracks:
        """Match features of known depth; with a consensus motion (`moved`), check the disparity
        against the depth.

        Args:
            tracks: features at their new left pixels; right pixels are still those of the last
                frame.
            right: the right image.
            moved: whether the depths were propagated with a consensus motion.
        """
        rows, expected = self._expected(tracks)
        if moved:
            self._follow(expected[tracks.has_right[rows]])
        shown = self._shown(tracks.left[rows], expected)
        pixels, skew, valid = self._fit(tracks, rows, right, shown)
        off = tracks.left[rows, 0] - pixels[:, 0] - shown
        if moved:
            valid &= np.abs(off) <= INLIER_PX
        self.common_px = None
        if moved and valid.sum() >= _ROWS.min_points:
            self.common_px = median(off[valid])
        return self._with_right_pixels(tracks, rows, pixels, skew, valid)

    def track_off_right(
        self, tracks: Tracks, left: ImageLevels, right: ImageLevels, *, by_motion: bool
    ) -> Tracks:
        """Match features of known depth anywhere on their rows, as far as a common offset explains
        their disparities.

        A pair that turns a little in its mount, or whose cameras expose a millisecond apart while
        the rig turns, has disparities that are off by as much at all depths, (R1). That is taken
        out of all matches of the frame. No match where it is more than a pair may turn by.

        Args:
            tracks: as for `track_right`, whose matches with it are too few.
            left: the left image.
            right: the right image.
            by_motion: whether depths come from the camera's motion alone: they have a factor in
                common, and are known less well.
        """
        rows, expected = self._expected(tracks)
        coarse, unique = self.search(left.half, right.half, tracks.left[rows])
        rows = rows[unique]
        expected = expected[unique]
        shown = self._shown(tracks.left[rows], coarse[unique])
        pixels, skew, valid = self._fit(tracks, rows, right, shown)
        rows = rows[valid]
        expected = expected[valid]
        pixels = pixels[valid]
        skew = skew[valid]
        off = tracks.left[rows, 0] - pixels[:, 0] - expected
        grows = self._offset_growth(tracks.left[rows])
        if len(off) < _ROWS.min_points:
            return tracks
        offset, slope = (
            common_offset(expected / grows, off / grows)
            if by_motion
            else (median(off / grows), 0.0)
        )
        if abs(offset - self._turn_px) > self._camera.fu * _ROWS.max_turn_rad:
            return tracks
        tolerance = INLIER_PX + (_STEREO.depth_slack * expected if by_motion else 0.0)
        agree = np.abs(off - offset * grows - slope * expected) <= tolerance
        self._offset_px = offset
        return self._with_right_pixels(tracks, rows, pixels, skew, agree)

    @property
    def offset_px(self) -> float | None:
        """What was taken out of the disparities of this frame alone; None: nothing."""
        return None if self._offset_px == self._turn_px else self._offset_px

    def take_out(self, turn_px: float) -> None:
        """Take an offset of the disparities in the image's centre out of all matches from now on."""
        self._turn_px = turn_px

    def _shown(self, left: FloatArray, disparity: FloatArray) -> FloatArray:
        """Disparities (K,) at left pixels (K, 2) as a right camera that has turned shows them."""
        if not self._turn_px:
            return disparity
        return disparity + self._turn_px * self._offset_growth(left)

    def _offset_growth(self, left: FloatArray) -> FloatArray:
        """By how much more (N,) a turn of the right camera moves pixels at left pixels (N, 2)
        than in the centre.
        """
        x = (left[:, 0] - self._camera.cu) / self._camera.fu
        return 1.0 + x * x

    def _expected(self, tracks: Tracks) -> tuple[IntArray, FloatArray]:
        """Rows (K,) of the features of known depth, and the disparities (K,) that follow from
        it.
        """
        depth = depth_of(self._camera, tracks.point)
        rows = (tracks.has_point & (depth > _STEREO.min_depth_m)).nonzero()[0]
        return rows, self._camera.fu * self._camera.baseline_m / depth[rows]

    def match_near(
        self, tracks: Tracks, right: ImageLevels, rows: IntArray, disparity: FloatArray
    ) -> Tracks:
        """Match the given rows (K,) near their disparities (K,)."""
        if not len(rows):
            return tracks
        shown = self._shown(tracks.left[rows], disparity)
        return self._with_right_pixels(tracks, rows, *self._fit(tracks, rows, right, shown))

    def search(
        self, left_half: Image, right_half: Image, points: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Coarse disparities (N,) of left pixels (N, 2), and a mask (N,) of those that are
        unique.
        """
        offset = round(self._rows.offset_px / 2)
        if self._unmatched % _STEREO.row_search_frames == 1:
            offset = self._best_offset(left_half, right_half, points, offset)
        correlation = MIN_CORRELATION - _STEREO.coarse_slack
        right_half = shifted_rows(right_half, offset)
        disparity, unique = self._search(left_half, right_half, points, correlation)
        if not self._reach_wait:
            self._reach_wait = _STEREO.reach_frames
            if self._reaches_further(left_half, right_half, points[~unique]):
                disparity, unique = self._search(left_half, right_half, points, correlation)
        if self._turn_px:
            disparity = disparity - self._turn_px * self._offset_growth(points)
        return disparity, unique

    def _reaches_further(self, left_half: Image, right_half: Image, points: FloatArray) -> bool:
        """Search further from now on if enough of the left pixels (N, 2) without a match have
        one beyond the reach.
        """
        beyond = self._beyond(left_half, right_half, points)
        if not _are_enough(len(beyond), len(points)):
            return False
        farthest = min(quantile(beyond, _STEREO.within_reach), self._most_reach_px)
        while self.max_disparity_px < farthest:
            self._double_reach()
        return True

    def _beyond(self, left_half: Image, right_half: Image, points: FloatArray) -> FloatArray:
        """Disparities (K,) of left pixels (N, 2) whose good match is beyond the present reach."""
        reach = self.max_disparity_px
        most = self._most_reach_px
        if reach >= most:
            return np.zeros(0)
        disparity, good = match_rows(
            left_half, right_half, points, most, ROW_SEARCH.good_correlation, ROW_SEARCH.min_margin
        )
        return disparity[good & (disparity > reach)]

    def _follow(self, expected: FloatArray) -> None:
        """Search further from now on if enough features matched in the last frame come nearer,
        by disparity (K,).
        """
        if _are_enough(int((expected > self.max_disparity_px - MAX_MOVE_PX).sum()), len(expected)):
            self._double_reach()

    def _double_reach(self) -> None:
        self.max_disparity_px = min(2.0 * self.max_disparity_px, self._most_reach_px)

    def _best_offset(
        self, left_half: Image, right_half: Image, points: FloatArray, offset: int
    ) -> int:
        """Row difference, in pixels at half resolution, at which most points match well; the
        present one if in doubt.

        Rows may be far apart where the right camera has been pitched since it was calibrated.
        """
        # learned rows may lie beyond those that are searched
        most = max(ROW_SEARCH.max_rows_half, abs(offset))
        tried = range(-most, most + 1)
        counts = [
            self.count_on_rows(left_half, shifted_rows(right_half, rows), points) for rows in tried
        ]
        best = int(np.argmax(counts))
        if counts[best] < max(_ROWS.min_points, 2 * counts[offset + most]):
            return offset
        self._rows.restart(2.0 * tried[best])
        return tried[best]

    def count_on_rows(self, left_half: Image, right_half: Image, points: FloatArray) -> int:
        """Count the left pixels (N, 2) that match well on their row between two images at half
        resolution.
        """
        good = self._search(left_half, right_half, points, ROW_SEARCH.good_correlation)[1]
        return int(good.sum())

    def forget_offset(self) -> None:
        """Take nothing out of the disparities that follow but what all frames have."""
        self._offset_px = self._turn_px

    @property
    def has_few_matches(self) -> bool:
        """Whether hardly any feature of the last frame had a right match, so that those matches
        may be wrong ones.
        """
        return self._unmatched > 0

    @property
    def disparity_error_px(self) -> float:
        """Bound of the error of disparities that the rows suggest, pixels; 0: they agree."""
        return self._rows.disparity_error_px(self._camera.fu)

    def row_differences(self, left: FloatArray) -> FloatArray:
        """Right minus left rows (N,) that are expected at left pixels (N, 2)."""
        return self._rows.rows(left) - left[:, 1]

    def restart_rows(self) -> None:
        """Forget the row differences."""
        self._rows.restart(0.0)

    def update_rows(self, tracks: Tracks) -> None:
        """Update the row differences with the matches of a frame."""
        few = len(tracks) >= _ROWS.min_points and share_of(tracks.has_right) < ROW_SEARCH.few_share
        self._unmatched = self._unmatched + 1 if few else 0
        self._rows.update(tracks.left[tracks.has_right], tracks.right[tracks.has_right])
        self._reach_wait = max(0, self._reach_wait - 1)

    def testable(self, tracks: Tracks) -> BoolArray:
        """Mask (N,) of the features whose known depth says that the right image shows them
        within the reach.
        """
        rows, expected = self._expected(tracks)
        in_reach = expected <= self.max_disparity_px - MAX_MOVE_PX
        right_u = tracks.left[rows, 0] - expected
        out = np.zeros(len(tracks), dtype=np.bool_)
        out[rows] = in_reach & (right_u >= ANCHOR_REACH_PX)
        return out

    def _search(
        self, left_half: Image, right_half: Image, points: FloatArray, min_correlation: float
    ) -> tuple[FloatArray, BoolArray]:
        return match_rows(
            left_half,
            right_half,
            points,
            self.max_disparity_px,
            min_correlation,
            ROW_SEARCH.min_margin,
        )

    def _fit(
        self, tracks: Tracks, rows: IntArray, right: ImageLevels, disparity: FloatArray
    ) -> _Matches:
        """Align anchors of rows (K,) with the right image near expected disparities (K,)."""
        count = len(rows)
        left = np.empty((count, 2))
        start = np.empty((count, 2, 3))
        _begin(tracks.left, tracks.warp, tracks.skew, rows, disparity, left, start)
        expected = self._rows.rows(left)
        start[:, 1, 2] = expected
        warp, score = align(
            self._bank.store, tracks.slot.take(rows), right.full, start, ITERATIONS, expected
        )
        found = _Matches(
            np.empty((count, 2)), np.empty((count, 2, 2)), np.empty(count, dtype=np.bool_)
        )
        fits = _Fits(left, start, warp, score)
        _judge(tracks.warp, rows, fits, self.max_disparity_px, found)
        return found

    def _with_right_pixels(
        self, tracks: Tracks, rows: IntArray, pixels: FloatArray, skew: FloatArray, good: BoolArray
    ) -> Tracks:
        """Set right pixels (K, 2), skews (K, 2, 2) and triangulated points of those rows (K,)
        that are `good`.
        """
        if self._offset_px:
            growth = self._offset_growth(tracks.left[rows])
            pixels = pixels + self._offset_px * np.stack([growth, np.zeros(len(rows))], 1)
        right = tracks.right.copy()
        has_right = tracks.has_right.copy()
        skews = tracks.skew.copy()
        point = tracks.point.copy()
        has_point = tracks.has_point.copy()
        f_baseline = self._camera.fu * self._camera.baseline_m
        matches = _Matches(pixels, skew, good)
        columns = _RightColumns(right, has_right, skews, point, has_point)
        _match(camera_args(self._camera), f_baseline, tracks.left, rows, matches, columns)
        return changed(
            tracks, right=right, has_right=has_right, skew=skews, point=point, has_point=has_point
        )


def _are_enough(beyond: int, points: int) -> bool:
    """Whether so many of some points are beyond the reach that the search is to go further."""
    return beyond >= max(_STEREO.min_beyond, _STEREO.beyond_share * points)


@compiled
def _begin(
    left: FloatArray,
    warp: FloatArray,
    skew: FloatArray,
    rows: IntArray,
    disparity: FloatArray,
    pixels: FloatArray,
    start: FloatArray,
) -> None:
    """Write the left pixels (K, 2) of rows (K,) of features, and the warps (K, 2, 3) to start
    from, without the row.
    """
    for k, n in enumerate(rows):
        for i in range(2):
            pixels[k, i] = left[n, i]
            start[k, i, 2] = warp[n, i, 2]
            for j in range(2):
                start[k, i, j] = warp[n, i, j] + skew[n, i, j]
        start[k, 0, 2] -= disparity[k]


class _Fits(NamedTuple):
    """Alignments of K anchors with the right image."""

    left: FloatArray  # (K, 2) left pixels
    start: FloatArray  # (K, 2, 3) warps before, in the expected row
    warp: FloatArray  # (K, 2, 3) warps after
    score: FloatArray  # (K,) correlations


class _Matches(NamedTuple):
    """Matches of K features in the right image."""

    pixels: FloatArray  # (K, 2) in the right image
    skew: FloatArray  # (K, 2, 2) change of the warp's linear part
    good: BoolArray  # (K,)


class _RightColumns(NamedTuple):
    """Columns of `Tracks` that a match sets."""

    right: FloatArray
    has_right: BoolArray
    skew: FloatArray
    point: FloatArray
    has_point: BoolArray


@compiled
def _judge(
    before: FloatArray, rows: IntArray, fits: _Fits, max_disparity: float, out: _Matches
) -> None:
    """Write matches; good are those that a point ahead of the camera may have.

    `before` are the warps (N, 2, 3) of the left image, of which rows (K,) were aligned.
    """
    pixels = out.pixels
    skew = out.skew
    valid = out.good
    warp = fits.warp
    for k, n in enumerate(rows):
        steep = 0.0
        for i in range(2):
            pixels[k, i] = warp[k, i, 2]
            for j in range(2):
                skew[k, i, j] = warp[k, i, j] - before[n, i, j]
                steep = max(steep, abs(skew[k, i, j]))
        du = pixels[k, 0] - fits.start[k, 0, 2]
        dv = pixels[k, 1] - fits.start[k, 1, 2]
        valid[k] = (
            fits.score[k] >= MIN_CORRELATION and is_on_peak(du, dv) and steep <= _STEREO.max_skew
        )
        valid[k] &= abs(dv) <= _MAX_ROW_DIFFERENCE_PX
        valid[k] &= MIN_MATCH_DISPARITY_PX <= fits.left[k, 0] - pixels[k, 0] <= max_disparity


def common_offset(expected: FloatArray, off: FloatArray) -> tuple[float, float]:
    """Offset and slope of deviations (N,) over expected disparities (N,): the line through two
    medians.

    The slope is the factor that is unknown of depths by the motion of one camera; the offset is
    what is left.
    Reference: Tukey, Exploratory Data Analysis (1977), resistant lines.
    """
    order = expected.argsort()
    near = order[len(order) // 2 :]
    far = order[: len(order) // 2]
    d_near = median(expected[near])
    d_far = median(expected[far])
    if d_near - d_far < _STEREO.min_spread_px:
        return median(off), 0.0
    slope = (median(off[near]) - median(off[far])) / (d_near - d_far)
    return median(off - slope * expected), slope


@compiled
def _match(
    camera: CameraArgs,
    f_baseline: float,
    left: FloatArray,
    rows: IntArray,
    matches: _Matches,
    out: _RightColumns,
) -> None:
    """Set the columns of features, at left pixels (N, 2), in those rows (K,) whose match is good.

    A point has the mean row of both images.
    """
    pixels = matches.pixels
    for k, n in enumerate(rows):
        if not matches.good[k]:
            continue
        out.has_right[n] = True
        out.right[n, 0] = pixels[k, 0]
        out.right[n, 1] = pixels[k, 1]
        for i in range(2):
            for j in range(2):
                out.skew[n, i, j] = matches.skew[k, i, j]
        disparity = left[n, 0] - pixels[k, 0]
        if disparity >= _STEREO.min_disparity_px:
            v = (left[n, 1] + pixels[k, 1]) / 2.0
            out.point[n, 0], out.point[n, 1], out.point[n, 2] = point_at(
                camera, left[n, 0], v, f_baseline / disparity
            )
            out.has_point[n] = True
