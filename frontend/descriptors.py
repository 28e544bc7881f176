"""Front ends that find key points in every image and match them by descriptor: in time, and from left to right."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Protocol, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from frontend.align import align, cut_patches, rounded, shift_warps, templates
from frontend.detect import spread_evenly
from frontend.frames import FrameGate, Stopwatch, SwapAlarm, usable_prior
from frontend.outliers import Vote, predicted_motion, static_tracks
from frontend.patches import FloatImage, inside
from frontend.settings import FrontendSettings, MatchSettings
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_log, transform_points
from vio.geometry.stereo import StereoCamera, left_rays, project, triangulate
from vio.records import BoolArray, FrontendOutput, Image, IntArray, StereoFrame, TrackPrior, observations

Descriptors: TypeAlias = npt.NDArray[np.float32] | npt.NDArray[np.uint8]

_REFINE_RADIUS = 6
_REFINE_ITERATIONS = 6
_REFINE_MAX_PX = 2.5
_REFINE_MIN_CORRELATION = 0.8
_FAR_M = 1e6
_SWAP_FEW = 0.2
_SWAP_MIN_POINTS = 20
_BORDER_PX = 8.0


@dataclass(frozen=True, slots=True)
class Keypoints:
    """What an extractor finds in one image, strongest first."""

    pixels: FloatArray  # (N, 2)
    descriptors: Descriptors  # (N, D) unit vectors, or (N, D / 8) bytes of D bits
    size_px: FloatArray  # (N,) diameter of what was described, pixels
    angle_deg: FloatArray  # (N,) its orientation; 0 where the extractor has none

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, index: BoolArray | IntArray) -> Keypoints:
        """Return the rows named by a mask or by indices."""
        return Keypoints(*(getattr(self, column.name)[index] for column in fields(self)))


class Extractor(Protocol):
    """Finds and describes key points."""

    def __call__(self, image: Image) -> Keypoints:
        """Return the key points of one image, strongest first."""


class Matcher(Protocol):
    """Pairs key points of two images."""

    def __call__(self, a: Keypoints, b: Keypoints, allowed: BoolArray) -> IntArray:
        """Return pairs (K, 2) of rows of `a` and `b`; only pairs in `allowed` (N, M), no row twice."""


def distances(a: Descriptors, b: Descriptors) -> npt.NDArray[np.float32]:
    """Distances (N, M) between descriptors: angles' chords for unit vectors, differing bits for bytes."""
    if a.dtype == np.uint8:
        bits_a, bits_b = (np.unpackbits(d.astype(np.uint8), axis=1).astype(np.float32) for d in (a, b))
        return bits_a.sum(axis=1)[:, None] + bits_b.sum(axis=1) - 2 * bits_a @ bits_b.T
    product = a.astype(np.float32) @ b.astype(np.float32).T
    return np.sqrt(np.maximum(2.0 - 2.0 * product, 0.0)).astype(np.float32)


@dataclass(frozen=True, slots=True)
class MutualNearest:
    """Pairs that are each other's nearest among the allowed ones, and clearly nearer than the second.

    Reference: Lowe, Distinctive image features from scale-invariant keypoints, IJCV (2004), section 7.1.
    """

    ratio: float  # largest distance over that of the second-nearest

    def __call__(self, a: Keypoints, b: Keypoints, allowed: BoolArray) -> IntArray:
        """Return pairs (K, 2); see `Matcher`."""
        if len(a) == 0 or len(b) == 0:
            return np.zeros((0, 2), dtype=np.int64)
        distance = np.where(allowed, distances(a.descriptors, b.descriptors), np.float32(np.inf))
        rows = np.arange(len(a))
        best = distance.argmin(axis=1)
        least = distance[rows, best]
        others = distance.copy()
        others[rows, best] = np.inf
        second = others.min(axis=1)
        mutual = distance.argmin(axis=0)[best] == rows
        good = np.isfinite(least) & mutual & (least <= self.ratio * second)
        return np.stack([rows[good], best[good]], axis=1)


@dataclass(frozen=True, slots=True)
class OpenCvExtractor:
    """ORB or SIFT of OpenCV."""

    engine: cv2.Feature2D
    name: str

    def __call__(self, image: Image) -> Keypoints:
        """Return the key points of one image, strongest first; see `Extractor`."""
        found, descriptors = self.engine.detectAndCompute(image, None)
        described = np.zeros((0, 32), dtype=np.uint8) if descriptors is None else np.asarray(descriptors)
        values = np.array([(*k.pt, k.size, k.angle, k.response) for k in found], dtype=np.float64).reshape(-1, 5)
        order = np.lexsort((values[:, 1], values[:, 0], -values[:, 4]))
        values, described = values[order], described[order]
        pixels, size, angle = values[:, :2].copy(), values[:, 2].copy(), values[:, 3].copy()
        if self.name == "orb":
            return Keypoints(pixels, described.astype(np.uint8), size, angle)
        # Root-SIFT. Reference: Arandjelovic & Zisserman, Three things everyone should know, CVPR (2012).
        unit = described.astype(np.float32)
        return Keypoints(pixels, np.sqrt(unit / np.maximum(unit.sum(axis=1, keepdims=True), 1e-6)), size, angle)


def orb_extractor(settings: MatchSettings) -> OpenCvExtractor:
    """ORB. Reference: Rublee et al., ORB: an efficient alternative to SIFT or SURF, ICCV (2011)."""
    return OpenCvExtractor(cv2.ORB.create(nfeatures=settings.max_keypoints, fastThreshold=10), "orb")


def sift_extractor(settings: MatchSettings) -> OpenCvExtractor:
    """SIFT. Reference: Lowe, Distinctive image features from scale-invariant keypoints, IJCV (2004)."""
    return OpenCvExtractor(cv2.SIFT.create(nfeatures=settings.max_keypoints, contrastThreshold=0.02), "sift")


@dataclass(frozen=True, slots=True)
class _Tracks:
    """The features alive after a frame."""

    ids: IntArray  # (N,)
    left: FloatArray  # (N, 2) pixels
    right: FloatArray  # (N, 2) pixels, arbitrary where has_right is False
    has_right: BoolArray  # (N,)
    looks: Keypoints  # (N,) as last seen

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, index: BoolArray | IntArray) -> _Tracks:
        return _Tracks(
            self.ids[index], self.left[index], self.right[index], self.has_right[index], self.looks.take(index)
        )


@dataclass(frozen=True, slots=True)
class _Memory:
    time_ns: int
    image: FloatImage  # left
    tracks: _Tracks
    twist_per_s: FloatArray  # (6,)


class DescriptorFrontend:
    """Match key points from frame to frame in the left image, and into the right one.

    One instance serves one recording: ids count up for ever and are never reused.
    """

    def __init__(
        self, camera: StereoCamera, settings: FrontendSettings, name: str, extract: Extractor, match: Matcher
    ) -> None:
        self._camera = camera
        self._settings, self._grid = settings.match, settings.grid
        self._disparity, self._consensus = settings.disparity, settings.consensus
        self._extract = extract
        self._match = match
        self._gate = FrameGate(camera, name)
        self._swap = SwapAlarm()
        self._memory: _Memory | None = None
        self._next_id = 0

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Extract, match and reject in one rectified stereo pair; frames come in time order.

        Args:
            frame: the pair, 8-bit gray, of the size that the camera states.
            prior: predicted pixels by id and predicted rotation since the previous frame, where the filter has them.

        Raises:
            DataError: the frame has no images, images of a wrong size or type, or a time not after the last one's; or
                left and right look swapped.
        """
        watch = Stopwatch()
        left_image, right_image = self._gate.admit(frame)
        views = left_image.astype(np.float32), right_image.astype(np.float32)
        watch.lap("prepare")
        left, right = (
            found.take(inside(left_image, found.pixels, _BORDER_PX))
            for found in (self._extract(left_image), self._extract(right_image))
        )
        watch.lap("extract")
        place, has_right = self._stereo(left, right, views)
        watch.lap("stereo")
        tracks, twist, used = self._tracked(frame, left, place, has_right, views[0], usable_prior(prior))
        watch.lap("track")
        carried = len(tracks)
        tracks = self._completed(tracks, left, place, has_right, used, left_image)
        self._memory = _Memory(frame.time_ns, views[0], tracks, twist)
        self._check_swap(frame, left, right, int(has_right.sum()))
        watch.lap("check")
        z = np.concatenate([tracks.left, tracks.right], axis=1)
        return FrontendOutput(
            observations(frame.index, frame.time_ns, tracks.ids, z, tracks.has_right),
            tracked=carried,
            matched=int(tracks.has_right.sum()),
            detected=len(tracks) - carried,
            stages_ms=watch.stages_ms,
        )

    def _allowed(self, left: Keypoints, right: Keypoints, width: int) -> BoolArray:
        """Pairs (N, M) near one row with a disparity in range."""
        limits = self._disparity
        disparity = left.pixels[:, :1] - right.pixels[:, 0]
        return np.asarray(
            (np.abs(left.pixels[:, 1:] - right.pixels[:, 1]) <= self._settings.max_epipolar_px)
            & (disparity >= limits.min_disparity_px)
            & (disparity <= limits.max_disparity * width)
        )

    def _stereo(
        self, left: Keypoints, right: Keypoints, views: tuple[FloatImage, FloatImage]
    ) -> tuple[FloatArray, BoolArray]:
        """Right pixels (N, 2) of the left key points, and the mask (N,) of those matched."""
        place, has_right = np.zeros((len(left), 2)), np.zeros(len(left), dtype=np.bool_)
        pairs = self._match(left, right, self._allowed(left, right, views[0].shape[1]))
        rows = pairs[:, 0]
        target = right.pixels[pairs[:, 1]]
        place[rows], alike = self._refined(views[0], left.pixels[rows], views[1], target, target[:, 1])
        disparity = left.pixels[rows, 0] - place[rows, 0]
        has_right[rows] = alike & (disparity >= self._disparity.min_disparity_px)
        return place, has_right

    def _refined(
        self,
        source: FloatImage,
        points: FloatArray,
        target: FloatImage,
        start: FloatArray,
        rows: FloatArray | None = None,
    ) -> tuple[FloatArray, BoolArray]:
        """Pixels (N, 2) in the target where the patches around source points lie, and a mask (N,) of those that fit."""
        if self._settings.refine == "none" or len(points) == 0:
            return start, np.ones(len(start), dtype=np.bool_)
        centres = rounded(points)
        store = templates(cut_patches(source, centres, _REFINE_RADIUS))
        beside = points - centres
        warp, score = align(
            store, np.arange(len(points)), target, shift_warps(start - beside), _REFINE_ITERATIONS, rows
        )
        place = warp[:, :, 2] + (warp[:, :, :2] @ beside[:, :, None])[:, :, 0]
        good = (score >= _REFINE_MIN_CORRELATION) & (np.abs(place - start).max(axis=1) <= _REFINE_MAX_PX)
        return np.where(good[:, None], place, start), good

    def _tracked(
        self,
        frame: StereoFrame,
        left: Keypoints,
        place: FloatArray,
        has_right: BoolArray,
        view: FloatImage,
        prior: TrackPrior | None,
    ) -> tuple[_Tracks, FloatArray, BoolArray]:
        """Tracks of the frame before found among the key points; the motion per second; the mask of points used."""
        memory, used = self._memory, np.zeros(len(left), dtype=np.bool_)
        if memory is None or len(memory.tracks) == 0:
            nothing = np.zeros(0, dtype=np.int64)
            empty = _Tracks(nothing, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.bool_), left.take(nothing))
            return empty, np.zeros(6) if memory is None else memory.twist_per_s, used
        settings, old = self._settings, memory.tracks
        seconds = (frame.time_ns - memory.time_ns) * 1e-9
        expected = se3_exp(memory.twist_per_s * seconds)
        R_prior = None if prior is None else prior.R_cam_prev
        told = expected if R_prior is None else se3_from_parts(R_prior, expected[:3, 3])
        p, deep = triangulate(self._camera, np.concatenate([old.left, old.right], axis=1))
        deep &= old.has_right
        guess = self._moved(old.left, np.where(deep[:, None], p, left_rays(self._camera, old.left) * _FAR_M), told)
        if prior is not None and len(prior.ids):
            _, a, b = np.intersect1d(old.ids, prior.ids, assume_unique=True, return_indices=True)
            guess[a] = prior.z[b, :2]
        reach = settings.search_radius * view.shape[1]
        # The last motion may be wrong, so that the old pixel is a second centre of the search.
        allowed = np.zeros((len(old), len(left)), dtype=np.bool_)
        for centre in (guess, old.left):
            allowed |= np.abs(centre[:, None] - left.pixels).max(axis=2) <= reach
        pairs = self._match(old.looks, left, allowed)
        rows, found = pairs[:, 0], pairs[:, 1]
        pixels, alike = self._refined(memory.image, old.left[rows], view, left.pixels[found])
        rows, found, pixels = rows[alike], found[alike], pixels[alike]
        T_prior = None
        if prior is not None:
            _, a, b = np.intersect1d(old.ids, prior.ids, assume_unique=True, return_indices=True)
            T_prior = predicted_motion(self._camera, p[a[deep[a]]], prior.z[b[deep[a]], :2], expected)
        rng = np.random.default_rng((self._consensus.seed, frame.index))
        vote = Vote(self._camera, self._consensus, settings.consensus_px, rng)
        voters = deep[rows]
        keep, motion = static_tracks(vote, old.left[rows], p[rows], voters, pixels, expected, R_prior, T_prior)
        agrees, twist = has_right[found].copy(), memory.twist_per_s
        # The right pixel belongs to the key point; it moves along with the refinement.
        right = place[found] + np.stack([pixels[:, 0] - left.pixels[found, 0], np.zeros(len(found))], axis=1)
        if motion is not None:
            keep[~voters] = False
            twist = se3_log(motion.T_curr_prev) / seconds
            depth = np.maximum(transform_points(motion.T_curr_prev, p[rows])[:, 2], 0.05)
            expected_disparity = self._camera.fu * self._camera.baseline_m / depth
            change = np.abs(pixels[:, 0] - right[:, 0] - expected_disparity)
            agrees &= ~voters | (change <= settings.consensus_px)
        rows, found = rows[keep], found[keep]
        used[found] = True
        tracks = _Tracks(old.ids[rows], pixels[keep], right[keep], agrees[keep], left.take(found))
        return tracks, twist, used

    def _moved(self, left: FloatArray, point: FloatArray, T_curr_prev: FloatArray) -> FloatArray:
        moved = transform_points(T_curr_prev, point)
        ahead = moved[:, 2] > 0.1
        pixels = project(self._camera, np.where(ahead[:, None], moved, [0.0, 0.0, 1.0]))[:, :2]
        return np.where(ahead[:, None], pixels, left)

    def _completed(
        self,
        tracks: _Tracks,
        left: Keypoints,
        place: FloatArray,
        has_right: BoolArray,
        used: BoolArray,
        image: Image,
    ) -> _Tracks:
        """Add new features from key points with a right match, evenly over the image."""
        height, width = image.shape
        free = np.flatnonzero(~used & has_right)
        chosen = free[spread_evenly(left.pixels[free], tracks.left, (width, height), self._grid)]
        ids = np.arange(len(chosen), dtype=np.int64) + self._next_id
        self._next_id += len(chosen)
        return _Tracks(
            np.concatenate([tracks.ids, ids]),
            np.concatenate([tracks.left, left.pixels[chosen]]),
            np.concatenate([tracks.right, place[chosen]]),
            np.concatenate([tracks.has_right, has_right[chosen]]),
            _joined(tracks.looks, left.take(chosen)),
        )

    def _check_swap(self, frame: StereoFrame, left: Keypoints, right: Keypoints, matched: int) -> None:
        """Raise when several frames in a row match only with negative disparities."""
        n = len(left)
        if n < _SWAP_MIN_POINTS or matched >= _SWAP_FEW * n:
            self._swap.clear()
            return
        assert frame.left is not None
        mirrored = self._match(right, left, self._allowed(right, left, frame.left.shape[1]))
        self._swap.check(frame, n, matched, len(mirrored))


def _joined(a: Keypoints, b: Keypoints) -> Keypoints:
    return replace(
        a, **{column.name: np.concatenate([getattr(a, column.name), getattr(b, column.name)]) for column in fields(a)}
    )
