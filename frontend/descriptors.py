"""Front ends that detect key points in every image and match them by descriptor, in time and
from left to right.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from vio.frontend.align import (
    MIN_CORRELATION,
    align,
    cut_patches,
    on_peak,
    rounded,
    shift_warps,
    template_points,
    templates,
)
from vio.frontend.columns import joined, take
from vio.frontend.detect import spread_evenly
from vio.frontend.frames import FrameValidator, Stopwatch, make_output, usable_prior
from vio.frontend.moving_object import MovedPoints
from vio.frontend.outliers import MotionPriors, RansacProblem, predicted_motion, static_tracks
from vio.frontend.patches import inside
from vio.frontend.prediction import moved_pixels, prior_pixels
from vio.frontend.right_camera import most_contradict
from vio.frontend.scene_motion import SceneMotion
from vio.frontend.settings import FrontendSettings, MatchSettings
from vio.frontend.stereo_match import MIN_MATCH_DISPARITY_PX, EpipolarRowModel
from vio.frontend.tracks import ANCHOR_RADIUS_PX
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_log, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, left_rays, triangulate
from vio.numerics.compiled import compiled, compiled_sums
from vio.numerics.kinds import Tolerance
from vio.records import (
    BoolArray,
    CheckedFrame,
    FrontendOutput,
    Image,
    IntArray,
    StereoFrame,
    TrackPrior,
)

Vectors: TypeAlias = npt.NDArray[np.float32]
Descriptors: TypeAlias = Vectors | npt.NDArray[np.uint8]


class _MatchRules(NamedTuple):
    """Which key points match."""

    max_ratio: float = 0.8  # of a descriptor's distance to that of the second-nearest
    # half side of the search window around the predicted pixel, over the image width
    search_share: float = 0.06
    # largest reprojection error of a static feature under the consensus motion
    inlier_px: float = 1.5
    far_m: Tolerance[float] = 1e6  # depth assumed where it is unknown
    min_depth_m: Tolerance[float] = 0.05
    # key points closer to the image border are dropped: their patch would not fit
    border_px: float = 8.0


_MATCHES = _MatchRules()
_MAX_ROW_DIFFERENCE_PX = 1.5  # of a stereo match
_REFINEMENTS: Tolerance[int] = 6  # iterations on a match


@dataclass(frozen=True, slots=True)
class Keypoints:
    """The key points of one image, strongest first."""

    pixels: FloatArray  # (N, 2)
    descriptors: Descriptors  # (N, D) unit vectors, or (N, D / 8) bytes of D bits

    def __len__(self) -> int:
        return len(self.pixels)


class Extractor(Protocol):
    """Finds and describes key points."""

    def __call__(self, *images: Image) -> list[Keypoints]:
        """Return the key points of each of some images of one size, strongest first."""


class Matcher(Protocol):
    """Pairs key points of two images."""

    def __call__(self, a: Keypoints, b: Keypoints, allowed: BoolArray) -> IntArray:
        """Return pairs (K, 2) of rows of `a` and `b`; only pairs in `allowed` (N, M), no row
        twice.
        """


@dataclass(frozen=True, slots=True)
class MutualNearest:
    """Mutual nearest neighbours among the allowed pairs that pass the ratio test.

    Reference: Lowe, Distinctive image features from scale-invariant keypoints, IJCV (2004), section
    7.1.
    """

    ratio: float = _MATCHES.max_ratio  # largest distance over that of the second-nearest

    def __call__(self, a: Keypoints, b: Keypoints, allowed: BoolArray) -> IntArray:
        """Return pairs (K, 2); see `Matcher`."""
        if len(a) == 0 or len(b) == 0:
            return np.zeros((0, 2), dtype=np.int64)
        best = np.empty(len(a), dtype=np.int64)
        good = np.empty(len(a), dtype=np.bool_)
        bits = a.descriptors.dtype == np.uint8
        ratio = np.float32(self.ratio)
        _nearest(_vectors(a.descriptors), _vectors(b.descriptors), bits, allowed, ratio, best, good)
        return np.stack([good.nonzero()[0], best[good]], axis=1)


def _vectors(descriptors: Descriptors) -> Vectors:
    """Vectors (N, D) whose products give the distances: the descriptors, or -1 and 1 for the
    bits of bytes.
    """
    if descriptors.dtype != np.uint8:
        return np.ascontiguousarray(descriptors, dtype=np.float32)
    return 2 * np.unpackbits(descriptors.astype(np.uint8), axis=1).astype(np.float32) - 1


@compiled
def _nearest(
    a: Vectors,
    b: Vectors,
    bits: bool,
    allowed: BoolArray,
    ratio: np.float32,
    best: IntArray,
    good: BoolArray,
) -> None:
    """Write the nearest of the allowed rows of b (M, D) for each of a (N, D), and whether it is a
    match.

    The distance is Euclidean for unit vectors, Hamming for `bits`. Of equal distances the first one
    counts.
    """
    size = np.float32(a.shape[1])
    far = np.float32(np.inf)
    least = np.empty(len(b), np.float32)
    back = np.empty(len(b), np.int64)
    for j in range(len(b)):
        least[j] = far
        back[j] = -1
    for i in range(len(a)):
        first = second = far
        best[i] = 0
        for j in range(len(b)):
            if not allowed[i, j]:
                continue
            product = _product(a[i], b[j])
            if bits:
                distance = np.float32(0.5) * (size - product)
            else:
                distance = np.sqrt(
                    max(np.float32(2.0) - np.float32(2.0) * product, np.float32(0.0))
                )
            if distance < first:
                first, second, best[i] = distance, first, j
            elif distance < second:
                second = distance
            if distance < least[j]:
                least[j] = distance
                back[j] = i
        good[i] = first < far and first <= ratio * second
    for i in range(len(a)):
        good[i] &= back[best[i]] == i


@compiled_sums
def _product(a: Vectors, b: Vectors) -> np.float32:
    total = np.float32(0.0)
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


_OPENCV: dict[str, Callable[[int], cv2.Feature2D]] = {
    "orb": lambda most: cv2.ORB.create(nfeatures=most, fastThreshold=10),
    "sift": lambda most: cv2.SIFT.create(nfeatures=most, contrastThreshold=0.02),
}


@dataclass(frozen=True, slots=True)
class OpenCvExtractor:
    """ORB or SIFT of OpenCV, which an unfinished run keeps as its settings."""

    name: str
    max_keypoints: int
    engine: cv2.Feature2D = field(init=False, repr=False, compare=False)  # without a state

    def __post_init__(self) -> None:
        object.__setattr__(self, "engine", _OPENCV[self.name](self.max_keypoints))

    def __getstate__(self) -> dict[str, Any]:
        return {"name": self.name, "max_keypoints": self.max_keypoints}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for key, value in state.items():
            object.__setattr__(self, key, value)
        self.__post_init__()

    def __call__(self, *images: Image) -> list[Keypoints]:
        """Return the key points of each image; see `Extractor`."""
        return [self._keypoints(image) for image in images]

    def _keypoints(self, image: Image) -> Keypoints:
        found, descriptors = self.engine.detectAndCompute(image, None)
        described = (
            np.zeros((0, 32), dtype=np.uint8) if descriptors is None else np.asarray(descriptors)
        )
        values = np.array([(*k.pt, k.response) for k in found], dtype=np.float64).reshape(-1, 3)
        order = np.lexsort((values[:, 1], values[:, 0], -values[:, 2]))
        pixels = values[order, :2]
        described = described[order]
        if self.name == "orb":
            return Keypoints(pixels, described.astype(np.uint8))
        # Root-SIFT. Reference: Arandjelovic & Zisserman, Three things everyone should know, CVPR
        # (2012).
        unit = described.astype(np.float32)
        return Keypoints(pixels, np.sqrt(unit / np.maximum(unit.sum(axis=1, keepdims=True), 1e-6)))


def orb_extractor(settings: MatchSettings) -> OpenCvExtractor:
    """ORB. Reference: Rublee et al., ORB: an efficient alternative to SIFT or SURF, ICCV (2011)."""
    return OpenCvExtractor("orb", settings.max_keypoints)


def sift_extractor(settings: MatchSettings) -> OpenCvExtractor:
    """SIFT.

    Reference: Lowe, Distinctive image features from scale-invariant keypoints, IJCV (2004).
    """
    return OpenCvExtractor("sift", settings.max_keypoints)


@dataclass(frozen=True, slots=True)
class _MatchedKeypoints:
    """The key points of the left image and their right pixels."""

    keypoints: Keypoints  # (N,)
    right: FloatArray  # (N, 2) pixels, arbitrary where has_right is False
    has_right: BoolArray  # (N,)


@dataclass(frozen=True, slots=True)
class _Tracks:
    """The active features after a frame."""

    ids: IntArray  # (N,)
    left: FloatArray  # (N, 2) pixels
    right: FloatArray  # (N, 2) pixels, arbitrary where has_right is False
    has_right: BoolArray  # (N,)
    age: IntArray  # (N,) frames since detection
    keypoints: Keypoints  # (N,) of the last frame

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class _PreviousFrame:
    """State kept from the previous frame."""

    time_ns: int
    left: Image
    tracks: _Tracks
    twist_per_s: FloatArray  # (6,) camera motion `[rho; phi]` per second, from the last consensus


class DescriptorFrontend:
    """Match key points from frame to frame in the left image, and into the right one.

    One instance processes one recording: ids increase and are never reused.
    """

    checks_objects = True

    def __init__(
        self,
        camera: StereoCamera,
        settings: FrontendSettings,
        name: str,
        extract: Extractor,
        match: Matcher,
    ) -> None:
        self._camera = camera
        self._grid = settings.grid
        self._disparity = settings.disparity
        self._seed = settings.consensus.seed
        self._extract = extract
        self._match = match
        self._validator = FrameValidator(camera, name)
        self._previous: _PreviousFrame | None = None
        self._next_id = 0
        self._scene = SceneMotion()
        self._rows: EpipolarRowModel | None = None

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Extract, match and reject in one rectified stereo pair; see `vio.protocols.Frontend`."""
        watch = Stopwatch()
        images = self._validator.validate(frame)
        watch.lap("prepare")
        if isinstance(frame, CheckedFrame) and frame.begin_again:
            self._previous = None
        usable = not isinstance(frame, CheckedFrame) or frame.right_usable
        shown = images if usable else images[:1]
        extracted = [
            take(points, inside(images[0], points.pixels, _MATCHES.border_px))
            for points in self._extract(*shown)
        ]
        watch.lap("extract")
        left = extracted[0]
        if usable:
            pair = self._stereo(left, extracted[1], images)
        else:
            pair = _unmatched(left)
        matched = pair.has_right
        self._row_model(images[0]).update(left.pixels[matched], pair.right[matched])
        watch.lap("stereo")
        tracks, twist, used = self._track(frame, pair, images[0], usable_prior(prior))
        watch.lap("track")
        tracked = len(tracks)
        tracks = self._add_new_features(tracks, pair, used, images[0])
        self._previous = _PreviousFrame(frame.time_ns, images[0].copy(), tracks, twist)
        watch.lap("check")
        return make_output(frame, tracks, tracked, watch, self._scene.take_findings())

    # --- left and right
    # ----------------------------------------------------------------------------------------------

    def _allowed(self, left: Keypoints, right: Keypoints, width: int) -> BoolArray:
        """Pairs (N, M) near one row with a disparity in range."""
        allowed = np.empty((len(left), len(right)), dtype=np.bool_)
        _on_row(
            left.pixels,
            np.ascontiguousarray(right.pixels.T),
            self._disparity.max_disparity * width,
            allowed,
        )
        return allowed

    def _stereo(
        self, left: Keypoints, right: Keypoints, views: tuple[Image, Image]
    ) -> _MatchedKeypoints:
        """Match the key points of the left image into the right one."""
        right_pixels = np.zeros((len(left), 2))
        has_right = np.zeros(len(left), dtype=np.bool_)
        pairs = self._match(left, right, self._allowed(left, right, views[0].shape[1]))
        rows = pairs[:, 0]
        target = right.pixels[pairs[:, 1]]
        right_pixels[rows], alike = self._refine(
            views[0], left.pixels[rows], views[1], target, target[:, 1]
        )
        disparity = left.pixels[rows, 0] - right_pixels[rows, 0]
        has_right[rows] = alike & (disparity >= MIN_MATCH_DISPARITY_PX)
        return _MatchedKeypoints(left, right_pixels, has_right)

    def _refine(
        self,
        source: Image,
        points: FloatArray,
        target: Image,
        start: FloatArray,
        rows: FloatArray | None = None,
    ) -> tuple[FloatArray, BoolArray]:
        """Align the patches around source points with the target; return pixels (N, 2) and a
        mask (N,) of good fits.
        """
        if len(points) == 0:
            return start, np.ones(len(start), dtype=np.bool_)
        centres = rounded(points)
        offset = points - centres
        store = templates(cut_patches(source, centres, ANCHOR_RADIUS_PX))
        slots = np.arange(len(points))
        warp, score = align(store, slots, target, shift_warps(start - offset), _REFINEMENTS, rows)
        pixels = template_points(warp, offset)
        good = (score >= MIN_CORRELATION) & on_peak(pixels, start)
        return np.where(good[:, None], pixels, start), good

    # --- tracking in time
    # ---------------------------------------------------------------------------------------------

    def _track(
        self, frame: StereoFrame, pair: _MatchedKeypoints, view: Image, prior: TrackPrior | None
    ) -> tuple[_Tracks, FloatArray, BoolArray]:
        """Match the previous tracks to key points; return tracks, motion per second, and the
        mask of used points.
        """
        previous = self._previous
        used = np.zeros(len(pair.keypoints), dtype=np.bool_)
        if previous is None or len(previous.tracks) == 0:
            nothing = np.zeros(0, dtype=np.int64)
            empty = _Tracks(
                nothing,
                np.zeros((0, 2)),
                np.zeros((0, 2)),
                np.zeros(0, np.bool_),
                nothing,
                take(pair.keypoints, nothing),
            )
            return empty, np.zeros(6) if previous is None else previous.twist_per_s, used
        old = previous.tracks
        left = pair.keypoints.pixels
        seconds = (frame.time_ns - previous.time_ns) * 1e-9
        expected = se3_exp(previous.twist_per_s * seconds)
        p_prev, has_depth = triangulate(self._camera, np.concatenate([old.left, old.right], axis=1))
        has_depth &= old.has_right
        far = left_rays(self._camera, old.left) * _MATCHES.far_m
        guess = self._guess(old, np.where(has_depth[:, None], p_prev, far), expected, prior)
        pairs = self._match(
            old.keypoints, pair.keypoints, self._near_guess(old, guess, left, view.shape[1])
        )
        rows = pairs[:, 0]
        found = pairs[:, 1]
        pixels, alike = self._refine(previous.left, old.left[rows], view, left[found])
        rows = rows[alike]
        found = found[alike]
        pixels = pixels[alike]
        priors = MotionPriors()
        if prior is not None:
            named, predicted = prior_pixels(old.ids[has_depth], prior)
            priors = MotionPriors(
                prior.R_cam_prev,
                predicted_motion(self._camera, p_prev[has_depth][named], predicted, expected),
            )
        rng = np.random.default_rng((self._seed, frame.index))
        problem = RansacProblem(self._camera, _MATCHES.inlier_px, rng)
        known = has_depth[rows]
        p_rows = p_prev[rows]
        keep, motion = static_tracks(
            problem, old.left[rows], p_rows, known, pixels, expected, priors
        )
        # The right pixel belongs to the key point; it is shifted by the refinement.
        right = pair.right[found] + pixels - left[found]
        agrees = pair.has_right[found]
        twist = previous.twist_per_s
        if motion is not None:
            points = MovedPoints(p_rows[known], pixels[known], old.age[rows[known]])
            error_px = self._row_model(view).disparity_error_px(self._camera.fu)
            chosen = self._scene.choose(frame.index, problem, points, motion, prior, error_px)
            motion = chosen.motion
            keep[known] = chosen.static
            keep[~known] = False
            twist = se3_log(motion.T_curr_prev) / seconds
            depth = depth_of(self._camera, transform_points(motion.T_curr_prev, p_rows))
            depth = np.maximum(depth, _MATCHES.min_depth_m)
            change = np.abs(
                pixels[:, 0] - right[:, 0] - self._camera.fu * self._camera.baseline_m / depth
            )
            fits = ~known | (change <= _MATCHES.inlier_px)
            # where most do not fit, the right camera is to be judged, by `vio.guard`
            if not most_contradict(fits[known & keep & agrees]):
                agrees = agrees & fits
        rows = rows[keep]
        found = found[keep]
        used[found] = True
        tracks = _Tracks(
            old.ids[rows],
            pixels[keep],
            right[keep],
            agrees[keep],
            old.age[rows] + 1,
            take(pair.keypoints, found),
        )
        return tracks, twist, used

    def _row_model(self, view: Image) -> EpipolarRowModel:
        """The row differences of matches over the image, made with the first image's size."""
        if self._rows is None:
            height, width = view.shape
            self._rows = EpipolarRowModel(width, height)
        return self._rows

    def _guess(
        self, old: _Tracks, p_prev: FloatArray, expected: FloatArray, prior: TrackPrior | None
    ) -> FloatArray:
        """Predict the left pixels (N, 2) of tracks at points (N, 3) in the current frame."""
        if prior is not None and prior.R_cam_prev is not None:
            expected = se3_from_parts(prior.R_cam_prev, expected[:3, 3])
        guess = moved_pixels(self._camera, expected, p_prev, old.left)
        if prior is not None:
            rows, predicted = prior_pixels(old.ids, prior)
            guess[rows] = predicted
        return guess

    def _near_guess(
        self, old: _Tracks, guess: FloatArray, points: FloatArray, width: int
    ) -> BoolArray:
        """Pairs (N, M) of tracks and left key points (M, 2) close to the predicted (N, 2) or the
        old pixel.
        """
        near = np.empty((len(old), len(points)), dtype=np.bool_)
        # The last motion may be wrong, so the old pixel is a second centre of the search.
        _near_either(
            guess, old.left, np.ascontiguousarray(points.T), _MATCHES.search_share * width, near
        )
        return near

    def _add_new_features(
        self, tracks: _Tracks, pair: _MatchedKeypoints, used: BoolArray, image: Image
    ) -> _Tracks:
        """Add new features from key points with a right match, spread evenly over the image."""
        height, width = image.shape
        left = pair.keypoints.pixels
        free = np.flatnonzero(~used & pair.has_right)
        chosen = free[spread_evenly(left[free], tracks.left, (width, height), self._grid)]
        ids = np.arange(len(chosen), dtype=np.int64) + self._next_id
        self._next_id += len(chosen)
        new = _Tracks(
            ids,
            left[chosen],
            pair.right[chosen],
            pair.has_right[chosen],
            np.zeros(len(chosen), dtype=np.int64),
            take(pair.keypoints, chosen),
        )
        return joined(tracks, new)


def _unmatched(left: Keypoints) -> _MatchedKeypoints:
    """The key points of a left image whose right one is not used."""
    count = len(left)
    return _MatchedKeypoints(left, np.zeros((count, 2)), np.zeros(count, dtype=np.bool_))


@compiled
def _on_row(left: FloatArray, right: FloatArray, most: float, out: BoolArray) -> None:
    """Write which pixels left (N, 2) and right (2, M) are near one row, with a disparity up to
    `most`.
    """
    us = right[0]
    vs = right[1]
    for i in range(len(left)):
        u = left[i, 0]
        v = left[i, 1]
        row = out[i]
        for j in range(len(us)):
            in_range = (u - us[j] >= MIN_MATCH_DISPARITY_PX) & (u - us[j] <= most)
            row[j] = in_range & (abs(v - vs[j]) <= _MAX_ROW_DIFFERENCE_PX)


@compiled
def _near_either(
    one: FloatArray, other: FloatArray, points: FloatArray, reach: float, out: BoolArray
) -> None:
    """Write which points (2, M) are in the squares (half side `reach`) around one or other
    centres (N, 2).
    """
    us = points[0]
    vs = points[1]
    for i in range(len(one)):
        u = one[i, 0]
        v = one[i, 1]
        u_other = other[i, 0]
        v_other = other[i, 1]
        row = out[i]
        for j in range(len(us)):
            in_one = (abs(u - us[j]) <= reach) & (abs(v - vs[j]) <= reach)
            row[j] = in_one | ((abs(u_other - us[j]) <= reach) & (abs(v_other - vs[j]) <= reach))
