"""Corners of a board in an image: seeds, growth over the grid, refinement, and a check of each.

Seeds are markers that are read, or a whole checkerboard. From them the place of every
further corner is predicted by the homography of its nearest neighbours, refined in the image, and
kept if the image there looks like the board. In blurred images the print itself is aligned, see
`vio.targets.blurred`. No corner is taken from OpenCV's refinements of
markers and ChArUco boards, which are off by half a pixel in some versions.
References: Förstner & Gülch, A fast operator for detection and precise location of distinct points
(1987), for the refinement that `cv2.cornerSubPix` implements; Duda & Frese, Accurate detection and
localization of checkerboard corners for calibration (2018), for `findChessboardCornersSB`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray
from vio.records import Image, IntArray
from vio.targets.blurred import PrintAligner
from vio.targets.description import Marker, Target
from vio.targets.homography import derivative, gray_at, homographies, mapped, predict
from vio.targets.seeds import MarkerReader, checkerboard_seeds

BoolArray = npt.NDArray[np.bool_]


class _GrowthRules(NamedTuple):
    """How corners are found from their neighbours."""

    min_tag_px: float = 12.0  # side of a tag below which its corners cannot be told apart
    min_neighbours: int = 4
    reach_pitches: float = 1.45  # pitches from a known corner within which others are predicted
    rounds: int = 16  # of growth over the grid
    tries: int = 5  # to find a corner, as its neighbours become known
    min_corners: int = 8  # of a view


_GROWTH = _GrowthRules()


class _RefinementRules(NamedTuple):
    """How a corner is refined."""

    min_window_px: int = 2  # half the side of the window of a refinement
    max_window_px: int = 9
    # blur beyond which the print is aligned in place of its saddle points
    max_sharp_px: float = 1.5
    min_print_likeness: float = 0.8  # correlation of the image with the print, blurred as much
    margin_px: float = 3.0  # corners nearer to the border are not used: their window is cut


_REFINEMENT = _RefinementRules()


class _CheckRules(NamedTuple):
    """Which corners are believed."""

    # normalised correlation with the board, of a tag or the squares at a corner
    min_likeness: float = 0.5
    samples: int = 16  # along a side of what is correlated
    min_contrast: float = 12.0  # standard deviation of the gray values there
    outlier_sigmas: float = 6.0  # of a corner against the homography of its neighbours
    min_outlier_px: float = 0.3


_CHECK = _CheckRules()


@dataclass(frozen=True, slots=True)
class Corners:
    """Corners of a board in one image."""

    ids: IntArray  # (K,) rows of `Target.points_m`, increasing
    uv: FloatArray  # (K, 2) pixels

    def __len__(self) -> int:
        return len(self.ids)


NO_CORNERS = Corners(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))


def numbered_alike(corners: Corners, other: Corners, target: Target) -> Corners:
    """Number the corners of a board that looks the same when it is turned as in another image.

    Args:
        corners: of an image.
        other: of an image in which the board is turned by less than 45 degrees against it, such as
            that of the pair's other camera, or the one before.
        target: the board.
    """
    orders = target.symmetries()
    if len(orders) == 1 or not len(corners) or not len(other):
        return corners
    expected = _uv_D_board(other.ids, other.uv, target)
    numbered = [np.argsort(order)[corners.ids] for order in orders]
    alike = [np.sum(expected * _uv_D_board(ids, corners.uv, target)) for ids in numbered]
    ids = numbered[int(np.argmax(alike))]
    rows = np.argsort(ids)
    return Corners(ids[rows], corners.uv[rows])


def _uv_D_board(ids: IntArray, uv: FloatArray, target: Target) -> FloatArray:
    """Return the affine part (2, 2) of how corners are mapped, transposed."""
    board = target.points_m[ids]
    return np.linalg.lstsq(board - board.mean(axis=0), uv - uv.mean(axis=0), rcond=None)[0]


def _uprightness(grid: FloatArray) -> float:
    """Return how far the rows and columns of corners (R, C, 2) lead right and down, pixels."""
    across = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    down = grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    return float(across[0] + down[1])


class CornerDetector:
    """Finds the corners of one board in images (H, W)."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self.points_m = target.points_m
        self._markers = {marker.id: marker for marker in target.markers()}
        self._templates = _Templates(target, self._markers)
        self._aligner = PrintAligner(target)
        self._symmetries = target.symmetries()
        # Places in which the inner corners, without colours, are the same.
        self._turns = 4 if target.rows == target.cols else 2
        # No turn of such a checkerboard brings a dark square to where a light one is.
        self._may_begin_light = (
            target.kind == "checkerboard" and len(self._symmetries) == self._turns
        )
        if target.kind == "checkerboard":
            self._seeding = None
        else:
            self._seeding = MarkerReader(target)

    def detect(self, image: Image) -> Corners:
        """Return the corners of the board; none where it is not seen."""
        board, uv = self._seeds(image)
        if len(uv) < _GROWTH.min_neighbours:
            return NO_CORNERS
        found = self._grown(image, board, uv, self._blur_px(image, board, uv))
        ids = np.flatnonzero(np.isfinite(found[:, 0]))
        ids = ids[self._agree(ids, found[ids])]
        if len(ids) >= _GROWTH.min_corners:
            return Corners(ids, found[ids])
        return NO_CORNERS

    def _seeds(self, image: Image) -> tuple[FloatArray, FloatArray]:
        """Places on the board (S, 2) and pixels (S, 2) of what is found without prediction."""
        if self._seeding is None:
            return self._turned_by_colour(image, *checkerboard_seeds(image, self.target))
        found = self._seeding.find(image)
        if not found:
            return np.zeros((0, 2)), np.zeros((0, 2))
        board = np.concatenate([self._markers[read.id].corners_m for read in found])
        uv = np.concatenate([read.uv for read in found])
        keep = _plausible(board, uv, self.target.pitch_m)
        return board[keep], uv[keep]

    def _blur_px(self, image: Image, board: FloatArray, uv: FloatArray) -> float:
        """Return the image's blur around the corners that lie next to the seeds."""
        near = self._within_reach(np.arange(len(self.points_m)), board)
        predicted, H = predict(self.points_m[near], board, uv)
        return self._aligner.blur_px(image, near, predicted, H)

    def _turned_by_colour(
        self, image: Image, board: FloatArray, uv: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Turn a checkerboard to where its first square is dark, and of its places that look alike
        to the most upright one.
        """
        if not len(uv):
            return board, uv
        shape = (self.target.rows - 1, self.target.cols - 1, 2)
        if not self._may_begin_light:
            _, H = predict(board, board, uv, leave_out=True)
            every = np.arange(len(board))
            like = self._templates.likeness(image, every, np.zeros_like(uv), H)
            if float(np.median(like)) < 0:
                uv = np.rot90(uv.reshape(shape), 4 // self._turns).reshape(-1, 2)
        alike = [uv[order] for order in self._symmetries]
        return board, max(alike, key=lambda one: _uprightness(one.reshape(shape)))

    def _grown(self, image: Image, board: FloatArray, uv: FloatArray, blur_px: float) -> FloatArray:
        """Pixels (N, 2) of the board's corners; NaN: not found."""
        found = np.full((len(self.points_m), 2), np.nan)
        tried = np.zeros(len(self.points_m), dtype=np.int64)
        for turn in range(_GROWTH.rounds):
            missing = np.flatnonzero(np.isnan(found[:, 0]) & (tried < _GROWTH.tries))
            near = self._within_reach(missing, board)
            if not len(near):
                break
            predicted, H = predict(self.points_m[near], board, uv)
            refined, good = self._refined(image, near, predicted, H, blur_px)
            tried[near] += 1
            found[near[good]] = refined[good]
            have = np.isfinite(found[:, 0])
            if have.sum() >= _GROWTH.min_neighbours:
                board = self.points_m[have]
                uv = found[have]
            if turn and not good.any():
                break
        if blur_px > _REFINEMENT.max_sharp_px and len(board) > _GROWTH.min_neighbours:
            # Again, as neighbours on all sides show the print.
            have = np.flatnonzero(np.isfinite(found[:, 0]))
            predicted, H = predict(self.points_m[have], board, uv)
            refined, good = self._refined(image, have, predicted, H, blur_px)
            found[have] = np.where(good[:, None], refined, np.nan)
        return found

    def _within_reach(self, missing: IntArray, board: FloatArray) -> IntArray:
        if not len(missing):
            return missing
        apart = np.linalg.norm(self.points_m[missing, None] - board, axis=2).min(axis=1)
        return missing[apart < _GROWTH.reach_pitches * self.target.pitch_m]

    def _refined(
        self, image: Image, ids: IntArray, uv: FloatArray, H: FloatArray, blur_px: float
    ) -> tuple[FloatArray, BoolArray]:
        """Refined pixels (K, 2) of corners predicted by homographies (K, 3, 3), and which (K,)
        look like the board's.
        """
        height, width = image.shape
        uv_D_board = derivative(H, self.points_m[ids], uv)
        scale_px = np.linalg.svd(uv_D_board, compute_uv=False)[:, 1]  # pixels per metre, least
        tag_px = scale_px * self.target.size_m
        limit = (uv > _REFINEMENT.margin_px) & (
            uv < np.array([width, height]) - 1 - _REFINEMENT.margin_px
        )
        good = limit.all(axis=1) & (tag_px > _GROWTH.min_tag_px) & (np.linalg.det(uv_D_board) > 0)
        if blur_px > _REFINEMENT.max_sharp_px:
            return self._aligned(image, ids, uv, H, blur_px, good)
        window = np.clip(
            self._free_m() * scale_px * 0.7, _REFINEMENT.min_window_px, _REFINEMENT.max_window_px
        )
        out = uv.copy()
        windows = window.astype(int)
        for size in np.unique(windows[good]).tolist():
            rows = np.flatnonzero(good & (windows == size))
            out[rows] = subpixel(image, uv[rows], size)
        moved = np.linalg.norm(out - uv, axis=1)
        good &= moved < np.maximum(1.0, 0.8 * window)
        inside = (out > _REFINEMENT.margin_px) & (
            out < np.array([width, height]) - 1 - _REFINEMENT.margin_px
        )
        good &= inside.all(axis=1)
        like = self._templates.likeness(image, ids, out - uv, H)
        if self._may_begin_light:
            like = np.abs(like)  # its first square may be light
        good &= like > _CHECK.min_likeness
        return out, good

    def _aligned(
        self,
        image: Image,
        ids: IntArray,
        uv: FloatArray,
        H: FloatArray,
        blur_px: float,
        good: BoolArray,
    ) -> tuple[FloatArray, BoolArray]:
        """As `_refined`, by alignment of the print, for corners (K,) that are `good` so far."""
        out = uv.copy()
        rows = np.flatnonzero(good)
        good = good.copy()
        if len(rows):
            out[rows], like = self._aligner.aligned(image, ids[rows], uv[rows], H[rows], blur_px)
            if self._may_begin_light:
                like = np.abs(like)
            good[rows] = like > _REFINEMENT.min_print_likeness
        return out, good

    def _free_m(self) -> float:
        """Distance from a corner to the next edge that does not end in it."""
        t = self.target
        if t.kind == "aprilgrid":
            return min(t.ratio * t.size_m, 0.2 * t.size_m)
        if t.kind == "charuco":
            return 0.5 * t.size_m * (1 - t.ratio) * np.sqrt(2)
        return t.size_m

    def _agree(self, ids: IntArray, uv: FloatArray) -> BoolArray:
        """Return which corners (K,) agree with the homography of their neighbours."""
        if len(ids) < _GROWTH.min_corners:
            return np.zeros(len(ids), dtype=bool)
        keep = np.ones(len(ids), dtype=bool)
        for _ in range(2):
            board = self.points_m[ids[keep]]
            predicted, _ = predict(self.points_m[ids], board, uv[keep], leave_out=True)
            off = np.linalg.norm(predicted - uv, axis=1)
            limit = max(
                _CHECK.outlier_sigmas * float(np.median(off[keep])) / 1.18, _CHECK.min_outlier_px
            )
            keep = off < limit
            if keep.sum() < _GROWTH.min_corners:
                return np.zeros(len(ids), dtype=bool)
        return keep


def subpixel(image: Image, uv: FloatArray, half: int) -> FloatArray:
    """Return the saddle points (K, 2) next to pixels (K, 2), by windows of `2 half + 1` pixels."""
    import cv2

    start = np.ascontiguousarray(uv.reshape(-1, 1, 2), dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)
    out = cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop)
    return np.asarray(out, dtype=np.float64).reshape(-1, 2)


def _plausible(board: FloatArray, uv: FloatArray, pitch_m: float) -> BoolArray:
    """Which markers' corners (S,), four by four, are where their neighbours expect them.

    A marker that is misread, or belongs to another board, is not.
    """
    count = len(uv) // 4
    keep = np.ones(len(uv), dtype=bool)
    side = np.linalg.norm(uv[0::4] - uv[2::4], axis=1)
    if count < 3:
        return keep
    centre = board.reshape(count, 4, 2).mean(axis=1)
    for n in range(count):
        others = np.argsort(np.linalg.norm(centre - centre[n], axis=1))[1:4]
        rows = (4 * others[:, None] + np.arange(4)).ravel()
        mine = np.arange(4 * n, 4 * n + 4)
        H = homographies(board[None, rows], uv[None, rows])
        q = np.column_stack([board[mine], np.ones(4)]) @ H[0].T
        off = np.linalg.norm(q[:, :2] / q[:, 2:] - uv[mine], axis=1)
        far = np.linalg.norm(centre[others] - centre[n], axis=1).min() / pitch_m
        keep[mine] = off.max() < 0.35 * side[n] * max(far, 1.0)
    return keep


class _Templates:
    """What the board looks like around each corner, to be compared with an image."""

    def __init__(self, target: Target, markers: dict[int, Marker]) -> None:
        self._points = target.points_m
        steps = (np.arange(_CHECK.samples) + 0.5) / _CHECK.samples
        grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        count = len(self._points)
        if target.kind == "aprilgrid":
            # The whole tag, whose code tells it from its neighbours.
            self._offset = np.empty((count, _CHECK.samples**2, 2))
            self._light = np.empty((count, _CHECK.samples**2))
            for n, marker in enumerate(markers.values()):
                side = marker.corners_m[2] - marker.corners_m[0]
                at = marker.corners_m[0] + grid * side
                modules = len(marker.is_dark)
                cells = np.minimum((grid * modules).astype(int), modules - 1)
                for k in range(4):
                    self._offset[4 * n + k] = at - marker.corners_m[k]
                    self._light[4 * n + k] = ~marker.is_dark[cells[:, 1], cells[:, 0]]
            return
        reach = 0.5 * target.size_m
        if target.kind == "charuco":
            reach = 0.5 * target.size_m * (1 - target.ratio)
        offset = (grid - 0.5) * 2 * reach
        self._offset = np.tile(offset, (count, 1, 1))
        self._light = np.empty((count, _CHECK.samples**2))
        for n, point in enumerate(self._points):
            cells = np.floor((point + offset) / target.size_m).astype(int)
            self._light[n] = [not target.square_is_dark(row, col) for col, row in cells.tolist()]

    def likeness(self, image: Image, ids: IntArray, moved: FloatArray, H: FloatArray) -> FloatArray:
        """Normalised correlation (K,) of the image with the board around corners that refinement
        moved (K, 2) from where homographies (K, 3, 3) predict them.
        """
        if not len(ids):
            return np.zeros(0)
        samples = self._points[ids][:, None] + self._offset[ids]
        at = mapped(H, samples) + moved[:, None]
        at = np.clip(at, -1e4, 2e4).astype(np.float32)
        inside = (at >= 0).all(axis=2) & (at[..., 0] <= image.shape[1] - 1)
        inside &= at[..., 1] <= image.shape[0] - 1
        values = gray_at(image, at)
        weight = inside.astype(np.float64)
        total = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
        light = self._light[ids]
        a = (values - (values * weight).sum(axis=1, keepdims=True) / total) * weight
        b = (light - (light * weight).sum(axis=1, keepdims=True) / total) * weight
        length = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
        contrast = np.linalg.norm(a, axis=1) / np.sqrt(total[:, 0])
        like = (a * b).sum(axis=1) / np.maximum(length, 1e-9)
        enough = weight.mean(axis=1) > 0.3
        return np.where(enough & (contrast > _CHECK.min_contrast), like, 0.0)
