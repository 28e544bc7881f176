"""Corners of a board in an image: seeds, growth over the grid, refinement, and a check of each.

Seeds are markers found at several scales, or a whole checkerboard. From them the place of every
further corner is predicted by the homography of its nearest neighbours, refined in the image, and
kept if the image there looks like the board. No corner is taken from OpenCV's refinements of
markers and ChArUco boards, which are off by half a pixel in some versions.
References: Förstner & Gülch, A fast operator for detection and precise location of distinct points
(1987), for the refinement that `cv2.cornerSubPix` implements; Duda & Frese, Accurate detection and
localization of checkerboard corners for calibration (2018), for `findChessboardCornersSB`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray
from vio.records import Image, IntArray
from vio.targets.description import Marker, Target, marker_dictionary

BoolArray = npt.NDArray[np.bool_]

_SCALES = (0.5, 1.0, 0.25)  # of the image in which seeds are looked for
_ENOUGH_SEEDS = 8  # markers, from which all others are found
_MIN_TAG_PX = 12.0  # side of a tag below which its corners cannot be told apart
_NEIGHBOURS = 12  # nearest corners that predict another one
_MIN_NEIGHBOURS = 4
_REACH = 1.45  # pitches from a known corner within which others are predicted
_ROUNDS = 16  # of growth over the grid
_TRIES = 5  # to find a corner, as its neighbours become known
_MIN_WINDOW_PX = 2  # half the side of the window of a refinement
_MAX_WINDOW_PX = 9
_MARGIN_PX = 3.0  # corners nearer to the border are not used: their window is cut
_MIN_LIKENESS = 0.5  # normalised correlation with the board, of a tag or the squares at a corner
_SAMPLES = 16  # along a side of what is correlated
_MIN_CONTRAST = 12.0  # standard deviation of the gray values there
_OUTLIER_SIGMAS = 6.0  # of a corner against the homography of its neighbours
_MIN_OUTLIER_PX = 0.3
_MIN_CORNERS = 8  # of a view


@dataclass(frozen=True, slots=True)
class Corners:
    """Corners of a board in one image."""

    ids: IntArray  # (K,) rows of `Target.points_m`, increasing
    uv: FloatArray  # (K, 2) pixels

    def __len__(self) -> int:
        return len(self.ids)


NO_CORNERS = Corners(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))


class CornerDetector:
    """Finds the corners of one board in images (H, W)."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self.points_m = target.points_m
        self._markers = {marker.id: marker for marker in target.markers()}
        self._templates = _Templates(target, self._markers)
        squares = target.rows + target.cols
        self._looks_the_same_turned = target.kind == "checkerboard" and squares % 2 == 0
        self._seeding = None if target.kind == "checkerboard" else _MarkerSeeds(target)

    def detect(self, image: Image) -> Corners:
        """Return the corners of the board; none where it is not seen."""
        board, uv = self._seeds(image)
        if len(uv) < _MIN_NEIGHBOURS:
            return NO_CORNERS
        found = self._grown(image, board, uv)
        ids = np.flatnonzero(np.isfinite(found[:, 0]))
        ids = ids[self._agree(ids, found[ids])]
        return Corners(ids, found[ids]) if len(ids) >= _MIN_CORNERS else NO_CORNERS

    def _seeds(self, image: Image) -> tuple[FloatArray, FloatArray]:
        """Places on the board (S, 2) and pixels (S, 2) of what is found without prediction."""
        if self._seeding is None:
            return self._turned_by_colour(image, *_checkerboard_seeds(image, self.target))
        found = self._seeding.find(image)
        known = [number for number in found if number in self._markers]
        if not known:
            return np.zeros((0, 2)), np.zeros((0, 2))
        board = np.concatenate([self._markers[number].corners_m for number in known])
        uv = np.concatenate([found[number] for number in known])
        keep = _plausible(board, uv, self.target.pitch_m)
        return board[keep], uv[keep]

    def _turned_by_colour(
        self, image: Image, board: FloatArray, uv: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Turn a checkerboard by 180 degrees where its first square would be light."""
        if not len(uv) or self._looks_the_same_turned:
            return board, uv
        _, H = _predict(board, board, uv, leave_out=True)
        every = np.arange(len(board))
        like = self._templates.likeness(image, every, np.zeros_like(uv), H)
        if float(np.median(like)) >= 0:
            return board, uv
        return board, uv[::-1]

    def _grown(self, image: Image, board: FloatArray, uv: FloatArray) -> FloatArray:
        """Pixels (N, 2) of the board's corners; NaN: not found."""
        found = np.full((len(self.points_m), 2), np.nan)
        tried = np.zeros(len(self.points_m), dtype=np.int64)
        for turn in range(_ROUNDS):
            missing = np.flatnonzero(np.isnan(found[:, 0]) & (tried < _TRIES))
            near = self._within_reach(missing, board)
            if not len(near):
                break
            predicted, H = _predict(self.points_m[near], board, uv)
            refined, good = self._refined(image, near, predicted, H)
            tried[near] += 1
            found[near[good]] = refined[good]
            have = np.isfinite(found[:, 0])
            if have.sum() >= _MIN_NEIGHBOURS:
                board = self.points_m[have]
                uv = found[have]
            if turn and not good.any():
                break
        return found

    def _within_reach(self, missing: IntArray, board: FloatArray) -> IntArray:
        if not len(missing):
            return missing
        apart = np.linalg.norm(self.points_m[missing, None] - board, axis=2).min(axis=1)
        return missing[apart < _REACH * self.target.pitch_m]

    def _refined(
        self, image: Image, ids: IntArray, uv: FloatArray, H: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Refined pixels (K, 2) of corners predicted by homographies (K, 3, 3), and which (K,)
        look like the board's.
        """
        height, width = image.shape
        uv_D_board = _derivative(H, self.points_m[ids], uv)
        scale_px = np.linalg.svd(uv_D_board, compute_uv=False)[:, 1]  # pixels per metre, least
        tag_px = scale_px * self.target.size_m
        limit = (uv > _MARGIN_PX) & (uv < np.array([width, height]) - 1 - _MARGIN_PX)
        good = limit.all(axis=1) & (tag_px > _MIN_TAG_PX) & (np.linalg.det(uv_D_board) > 0)
        window = np.clip(self._free_m() * scale_px * 0.7, _MIN_WINDOW_PX, _MAX_WINDOW_PX)
        out = uv.copy()
        windows = window.astype(int)
        for size in np.unique(windows[good]).tolist():
            rows = np.flatnonzero(good & (windows == size))
            out[rows] = _subpixel(image, uv[rows], size)
        moved = np.linalg.norm(out - uv, axis=1)
        good &= moved < np.maximum(1.0, 0.8 * window)
        inside = (out > _MARGIN_PX) & (out < np.array([width, height]) - 1 - _MARGIN_PX)
        good &= inside.all(axis=1)
        like = self._templates.likeness(image, ids, out - uv, H)
        if self._looks_the_same_turned:
            like = np.abs(like)  # its first square may be light
        good &= like > _MIN_LIKENESS
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
        if len(ids) < _MIN_CORNERS:
            return np.zeros(len(ids), dtype=bool)
        keep = np.ones(len(ids), dtype=bool)
        for _ in range(2):
            board = self.points_m[ids[keep]]
            predicted, _ = _predict(self.points_m[ids], board, uv[keep], leave_out=True)
            off = np.linalg.norm(predicted - uv, axis=1)
            limit = max(_OUTLIER_SIGMAS * float(np.median(off[keep])) / 1.18, _MIN_OUTLIER_PX)
            keep = off < limit
            if keep.sum() < _MIN_CORNERS:
                return np.zeros(len(ids), dtype=bool)
        return keep


def _subpixel(image: Image, uv: FloatArray, half: int) -> FloatArray:
    import cv2

    start = np.ascontiguousarray(uv.reshape(-1, 1, 2), dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)
    out = cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop)
    return np.asarray(out, dtype=np.float64).reshape(-1, 2)


def _predict(
    at: FloatArray, board: FloatArray, uv: FloatArray, *, leave_out: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Pixels (K, 2) of places (K, 2) on the board by the homographies (K, 3, 3) of the nearest
    known corners, and these.

    With `leave_out` a known corner at the place itself is not used.
    """
    apart = np.linalg.norm(at[:, None] - board, axis=2)
    if leave_out:
        apart = np.where(apart < 1e-9, np.inf, apart)
    count = min(_NEIGHBOURS, len(board) - leave_out)
    rows = np.argsort(apart, axis=1, kind="stable")[:, :count]
    H = _homographies(board[rows], uv[rows])
    return _mapped(H, at[:, None])[:, 0], H


def _mapped(H: FloatArray, board: FloatArray) -> FloatArray:
    """Pixels (K, S, 2) of places (K, S, 2) on the board by homographies (K, 3, 3)."""
    q = board @ np.swapaxes(H[:, :, :2], 1, 2) + H[:, None, :, 2]
    depth = np.where(np.abs(q[..., 2:]) < 1e-12, 1e-12, q[..., 2:])
    return np.asarray(q[..., :2] / depth)


def _derivative(H: FloatArray, board: FloatArray, uv: FloatArray) -> FloatArray:
    """Derivatives (K, 2, 2) of pixels (K, 2) by places (K, 2) on the board."""
    depth = np.einsum("ki,ki->k", H[:, 2, :2], board) + H[:, 2, 2]
    depth = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
    return np.asarray((H[:, :2, :2] - uv[..., None] * H[:, 2:, :2]) / depth[:, None, None])


def _homographies(board: FloatArray, uv: FloatArray) -> FloatArray:
    """Homographies (K, 3, 3) from the board to pixels by S corners each (K, S, 2)."""
    T_board = _normalising(board)
    T_uv = _normalising(uv)
    a = board * T_board[:, :1, 0][..., None] + T_board[:, :2, 2][:, None]
    b = uv * T_uv[:, :1, 0][..., None] + T_uv[:, :2, 2][:, None]
    one = np.ones(a.shape[:2])
    zero = np.zeros((*one.shape, 3))
    p = np.stack([a[..., 0], a[..., 1], one], axis=-1)
    upper = np.concatenate([p, zero, -b[..., :1] * p], axis=-1)
    lower = np.concatenate([zero, p, -b[..., 1:] * p], axis=-1)
    A = np.concatenate([upper, lower], axis=1)
    _, vectors = np.linalg.eigh(np.swapaxes(A, 1, 2) @ A)
    H = vectors[..., 0].reshape(-1, 3, 3)
    H = np.linalg.inv(T_uv) @ H @ T_board
    return np.asarray(H / np.where(np.abs(H[:, 2:, 2:]) < 1e-15, 1e-15, H[:, 2:, 2:]))


def _normalising(p: FloatArray) -> FloatArray:
    """Similarities (K, 3, 3) that move points (K, S, 2) around the origin, at unit distance."""
    centre = p.mean(axis=1)
    scale = 1 / np.maximum(np.linalg.norm(p - centre[:, None], axis=2).mean(axis=1), 1e-12)
    out = np.zeros((len(p), 3, 3))
    out[:, 0, 0] = scale
    out[:, 1, 1] = scale
    out[:, 2, 2] = 1
    out[:, :2, 2] = -scale[:, None] * centre
    return out


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
        H = _homographies(board[None, rows], uv[None, rows])
        q = np.column_stack([board[mine], np.ones(4)]) @ H[0].T
        off = np.linalg.norm(q[:, :2] / q[:, 2:] - uv[mine], axis=1)
        far = np.linalg.norm(centre[others] - centre[n], axis=1).min() / pitch_m
        keep[mine] = off.max() < 0.35 * side[n] * max(far, 1.0)
    return keep


class _MarkerSeeds:
    """Finds coded squares in an image at several scales."""

    def __init__(self, target: Target) -> None:
        import cv2

        settings = cv2.aruco.DetectorParameters()
        settings.markerBorderBits = target.border_bits
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        settings.minMarkerPerimeterRate = 0.02
        settings.adaptiveThreshWinSizeMin = 9
        settings.adaptiveThreshWinSizeMax = 33
        settings.adaptiveThreshWinSizeStep = 24
        settings.perspectiveRemovePixelPerCell = 6
        self._turned = target.kind == "aprilgrid"
        dictionary = marker_dictionary(target.dictionary)
        self._detector: Any = cv2.aruco.ArucoDetector(dictionary, settings)
        self._wanted = len(target.markers())

    def find(self, image: Image) -> dict[int, FloatArray]:
        """Return the corners (4, 2) of markers by id: tl tr br bl as printed."""
        out: dict[int, FloatArray] = {}
        twice = set[int]()
        for scale, source in self._tries(image):
            found, ids, _ = self._detector.detectMarkers(source)
            if ids is None or not len(ids):
                continue
            numbers = np.ravel(ids).tolist()
            twice |= {number for number in numbers if numbers.count(number) > 1}
            for number, corners in zip(numbers, found, strict=True):
                uv = np.asarray(corners, dtype=np.float64).reshape(4, 2)
                uv = (uv + 0.5) / scale - 0.5
                # OpenCV's 36h11 is Kalibr's print turned by 180 degrees.
                out.setdefault(number, np.roll(uv, 2, axis=0) if self._turned else uv)
            if len(out) >= min(_ENOUGH_SEEDS, 0.6 * self._wanted):
                break
        return {number: uv for number, uv in out.items() if number not in twice}

    @staticmethod
    def _tries(image: Image) -> Iterator[tuple[float, Image]]:
        """Scaled images in the order in which seeds are looked for.

        Light that grows parts tags from the dark squares that touch their corners.
        """
        import cv2

        cross = np.ones((3, 3), dtype=np.uint8)
        for scale in _SCALES:
            size = (round(scale * image.shape[1]), round(scale * image.shape[0]))
            scaled = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            small = np.asarray(scaled, dtype=np.uint8)
            yield scale, np.asarray(cv2.dilate(small, cross), dtype=np.uint8)
            yield scale, small


def _checkerboard_seeds(image: Image, target: Target) -> tuple[FloatArray, FloatArray]:
    """All inner corners of a checkerboard: (N, 2) on the board, (N, 2) pixels; or none."""
    import cv2

    size = (target.cols - 1, target.rows - 1)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    done, found = cv2.findChessboardCornersSB(image, size, flags=flags)
    if not done:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        done, found = cv2.findChessboardCorners(image, size, flags=flags | cv2.CALIB_CB_FAST_CHECK)
    if not done:
        return np.zeros((0, 2)), np.zeros((0, 2))
    uv = np.asarray(found, dtype=np.float64).reshape(-1, 2)
    grid = uv.reshape(target.rows - 1, target.cols - 1, 2)
    across = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    down = grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    # A board without codes looks the same when turned by 180 degrees, and not when mirrored.
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
        across = -across
    if across[0] + down[1] < 0:
        grid = grid[::-1, ::-1]
    return target.points_m, grid.reshape(-1, 2)


class _Templates:
    """What the board looks like around each corner, to be compared with an image."""

    def __init__(self, target: Target, markers: dict[int, Marker]) -> None:
        self._points = target.points_m
        steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        count = len(self._points)
        if target.kind == "aprilgrid":
            # The whole tag, whose code tells it from its neighbours.
            self._offset = np.empty((count, _SAMPLES**2, 2))
            self._light = np.empty((count, _SAMPLES**2))
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
        self._light = np.empty((count, _SAMPLES**2))
        for n, point in enumerate(self._points):
            cells = np.floor((point + offset) / target.size_m).astype(int)
            self._light[n] = [not target.square_is_dark(row, col) for col, row in cells.tolist()]

    def likeness(self, image: Image, ids: IntArray, moved: FloatArray, H: FloatArray) -> FloatArray:
        """Normalised correlation (K,) of the image with the board around corners that refinement
        moved (K, 2) from where homographies (K, 3, 3) predict them.
        """
        import cv2

        if not len(ids):
            return np.zeros(0)
        at = _mapped(H, self._points[ids][:, None] + self._offset[ids]) + moved[:, None]
        at = np.clip(at, -1e4, 2e4).astype(np.float32)
        inside = (at >= 0).all(axis=2) & (at[..., 0] <= image.shape[1] - 1)
        inside &= at[..., 1] <= image.shape[0] - 1
        values = cv2.remap(
            image,
            np.ascontiguousarray(at[..., 0]),
            np.ascontiguousarray(at[..., 1]),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        ).astype(np.float64)
        weight = inside.astype(np.float64)
        total = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
        light = self._light[ids]
        a = (values - (values * weight).sum(axis=1, keepdims=True) / total) * weight
        b = (light - (light * weight).sum(axis=1, keepdims=True) / total) * weight
        length = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
        contrast = np.linalg.norm(a, axis=1) / np.sqrt(total[:, 0])
        like = (a * b).sum(axis=1) / np.maximum(length, 1e-9)
        enough = weight.mean(axis=1) > 0.3
        return np.where(enough & (contrast > _MIN_CONTRAST), like, 0.0)
