"""The default front end: corners tracked in time by Lucas-Kanade and matched left to right along the row."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field, fields, replace

import cv2
import numpy as np

from frontend.align import align, cut_patches, shift_warps, templates
from frontend.detect import detect_corners, min_distance_px
from frontend.outliers import Consensus, epipolar_distance, fit_motion, pixel_errors, rigid_consensus
from frontend.patches import Patches, inside
from frontend.settings import KltSettings
from frontend.stereo_match import RowPyramid, match_rows, mirrored, row_pyramid
from vio.errors import DataError
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_log, transform_points
from vio.geometry.stereo import StereoCamera, project, triangulate
from vio.records import BoolArray, FrontendOutput, Image, IntArray, StereoFrame, TrackPrior, observations

logger = logging.getLogger(__name__)

_SWAP_FRAMES = 3  # frames without matches before the mirrored search is believed
_SWAP_FEW = 0.3  # share of matches below which a frame is suspicious
_SWAP_MANY = 0.4  # share of matches in the mirrored images that proves the swap
_SWAP_MIN_POINTS = 20
_LK_EPSILON_PX = 0.01
_ALIGN_ITERATIONS = 4
_ALIGN_MAX_PX = 2.5
_ANCHOR_LOST = 0.5  # correlation with its anchor below which a feature is taken for another
_LK_MIN_EIGENVALUE = 1e-4


@dataclass(frozen=True, slots=True)
class _Tracks:
    """The features alive after a frame; older features come first."""

    ids: IntArray  # (N,) increasing
    left: FloatArray  # (N, 2) pixels
    right: FloatArray  # (N, 2) pixels, arbitrary where has_right is False
    has_right: BoolArray  # (N,)
    blind: IntArray  # (N,) frames in a row without a right match
    velocity: FloatArray  # (N, 2) pixels moved since the frame before; zero for new features
    anchor: Patches  # (N, 2r+3, 2r+3) what the feature looked like when its anchor was cut
    warp: FloatArray  # (N, 3, 3) from offsets in the anchor to pixels of the current left image

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, index: BoolArray | IntArray) -> _Tracks:
        """Return the rows named by a mask or by indices."""
        return _Tracks(**{column.name: getattr(self, column.name)[index] for column in fields(self)})


def _new_tracks(image: Image, ids: IntArray, left: FloatArray, radius: int) -> _Tracks:
    n = len(ids)
    return _Tracks(
        ids,
        left,
        right=np.zeros((n, 2)),
        has_right=np.zeros(n, dtype=np.bool_),
        blind=np.zeros(n, dtype=np.int64),
        velocity=np.zeros((n, 2)),
        anchor=cut_patches(image, left, radius),
        warp=shift_warps(left),
    )


@dataclass(frozen=True, slots=True)
class _Memory:
    """What the front end keeps of the frame before."""

    index: int
    time_ns: int
    image: Image  # left
    tracks: _Tracks
    twist_per_s: FloatArray  # (6,) camera motion `[rho; phi]` of the last consensus, over its time


@dataclass(slots=True)
class _Stopwatch:
    """Wall time per stage in milliseconds."""

    stages_ms: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.stages_ms[stage] = self.stages_ms.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now


class KltFrontend:
    """Track corners from frame to frame in the left image and match them into the right one.

    One instance serves one recording: ids count up for ever and are never reused. The result depends on the images,
    the priors and the settings only, to the bit.
    """

    def __init__(self, camera: StereoCamera, settings: KltSettings | None = None) -> None:
        self._camera = camera
        self._settings = KltSettings() if settings is None else settings
        self._clahe = cv2.createCLAHE(2.0, (8, 8)) if self._settings.equalise == "clahe" else None
        self._memory: _Memory | None = None
        self._next_id = 0
        self._suspicious = 0  # frames in a row that look swapped

    @property
    def settings(self) -> KltSettings:
        """The settings in effect."""
        return self._settings

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Track, match and detect in one rectified stereo pair; frames come in time order.

        Args:
            frame: the pair, 8-bit gray, of the size that the camera states.
            prior: predicted pixels by id and predicted rotation since the previous frame, where the filter has them.

        Raises:
            DataError: the frame has no images, images of a wrong size or type, or a time not after the last one's; or
                left and right look swapped.
        """
        watch = _Stopwatch()
        left_image, right_image = self._images(frame)
        left, right = row_pyramid(left_image), row_pyramid(right_image)
        watch.lap("prepare")
        memory = self._memory
        tracks = self._fresh(left_image, np.zeros((0, 2)))
        twist = np.zeros(6)
        disparity = np.zeros(0)
        motion: Consensus | None = None
        if memory is not None and len(memory.tracks):
            seconds = (frame.time_ns - memory.time_ns) * 1e-9
            found, seen = self._flow_all(memory, left_image, prior, seconds)
            watch.lap("track")
            seen, motion = self._consensus(memory, found, seen, prior, seconds, frame.index)
            watch.lap("reject")
            before, tracks = self._aligned(memory.tracks, left_image, found, seen, motion)
            twist = memory.twist_per_s if motion is None else se3_log(motion.T_curr_prev) / seconds
            disparity = self._expected_disparity(before, motion)
            watch.lap("align")
        carried = len(tracks)
        missing = self._settings.target_features - carried
        tried = round(missing * (1.0 + self._settings.spare_corners))
        corners = detect_corners(left_image, tracks.left, tried, self._settings)
        watch.lap("detect")
        expected = np.concatenate([disparity, np.full(len(corners), np.nan)])
        match = match_rows(left, right, np.concatenate([tracks.left, corners]), expected, self._settings)
        # Of the new corners, those with a right match come first, the best of them as the detector ranked them.
        chosen = np.argsort(~match.valid[carried:], kind="stable")[: max(0, missing)]
        rows = np.concatenate([np.arange(carried), carried + chosen])
        tracks = _joined(tracks, self._fresh(left_image, corners[chosen]))
        tracks = self._with_right(tracks, match.right[rows], match.valid[rows], expected[rows], motion is not None)
        watch.lap("stereo")
        self._check_swap(frame, left, right, tracks)
        tracks = tracks.take(tracks.blind <= self._settings.max_left_only_frames)
        watch.lap("check")
        self._memory = _Memory(frame.index, frame.time_ns, left_image, tracks, twist)
        z = np.concatenate([tracks.left, tracks.right], axis=1)
        return FrontendOutput(
            observations(frame.index, frame.time_ns, tracks.ids, z, tracks.has_right),
            tracked=carried,
            matched=int(tracks.has_right.sum()),
            detected=len(chosen),
            stages_ms=watch.stages_ms,
        )

    def _images(self, frame: StereoFrame) -> tuple[Image, Image]:
        """Check and equalise the images of a frame."""
        if frame.left is None or frame.right is None:
            raise DataError(
                f"frame {frame.index} has no images, but the klt front end needs them; "
                "use the precomputed front end, or a recording with images"
            )
        camera, memory = self._camera, self._memory
        if memory is not None and frame.time_ns <= memory.time_ns:
            raise DataError(
                f"frame {frame.index} is not later than frame {memory.index} ({frame.time_ns} ns after "
                f"{memory.time_ns} ns); sort the frames by time"
            )
        known = (camera.height, camera.width)
        for name, image in (("left", frame.left), ("right", frame.right)):
            if image.ndim != 2 or image.dtype != np.uint8:
                raise DataError(
                    f"frame {frame.index}: the {name} image has shape {image.shape} and type {image.dtype}; "
                    "the klt front end needs 8-bit gray images"
                )
            size = image.shape
            if None not in known and size != known:
                raise DataError(
                    f"frame {frame.index}: the {name} image is {size[1]}x{size[0]}, but the calibration is for "
                    f"{camera.width}x{camera.height}; check that calibration and images belong together"
                )
            if size != frame.left.shape or (memory is not None and size != memory.image.shape):
                raise DataError(
                    f"frame {frame.index}: the {name} image is {size[1]}x{size[0]}, unlike the images before; "
                    "all images of a recording must have one size"
                )
        if self._clahe is None:
            # The next frame is tracked from this one, so the pixels must not change under us.
            return frame.left.copy(), np.ascontiguousarray(frame.right)
        left, right = self._clahe.apply(frame.left), self._clahe.apply(frame.right)
        return np.asarray(left, dtype=np.uint8), np.asarray(right, dtype=np.uint8)

    def _fresh(self, image: Image, points: FloatArray) -> _Tracks:
        """Give new points (N, 2) of the left image their ids and anchors."""
        ids = np.arange(self._next_id, self._next_id + len(points), dtype=np.int64)
        self._next_id += len(points)
        return _new_tracks(image, ids, points, self._settings.anchor_radius_px)

    def _flow_all(
        self, memory: _Memory, image: Image, prior: TrackPrior | None, seconds: float
    ) -> tuple[FloatArray, BoolArray]:
        """Follow the features of the frame before; return pixels (N, 2) and the mask (N,) of those found."""
        old = memory.tracks
        guess, informed = self._predict(memory, prior, seconds)
        found, good = self._flow_both_ways(memory.image, image, old.left, guess)
        retry = np.flatnonzero(~good & informed)
        if 2 * len(retry) > len(old):  # the prediction as a whole was wrong: start from where the features were
            found[retry], good[retry] = self._flow_both_ways(memory.image, image, old.left[retry], old.left[retry])
        return found, good

    def _aligned(
        self, old: _Tracks, image: Image, found: FloatArray, seen: BoolArray, motion: Consensus | None
    ) -> tuple[_Tracks, _Tracks]:
        """Align the features with their anchors; return the survivors, as they were and as they are.

        Lucas-Kanade steps add up to a drift; the anchor does not drift. Features that Lucas-Kanade lost are looked
        for where the consensus motion puts them. Features that were found, but look somewhat different from their
        anchor, stay where they were found and get a new one; those that look altogether different are dropped.
        """
        settings = self._settings
        start, tried, scale = found.copy(), seen.copy(), np.ones(len(old))
        if motion is not None:
            p, valid = self._points(old)
            predicted = self._moved(old, motion.T_curr_prev)
            tried |= valid & inside(image, predicted, settings.anchor_radius_px + 2.0)
            start[~seen] = predicted[~seen]
            depth = transform_points(motion.T_curr_prev, p)[:, 2]
            scale = np.where(valid & (depth > 0.1), p[:, 2] / np.maximum(depth, 0.1), 1.0)
        rows = np.flatnonzero(tried)
        warp = old.warp[rows]
        warp[:, :2, :2] *= scale[rows, None, None]
        warp[:, :2, 2] = start[rows]
        warp, score = align(templates(old.anchor[rows]), image, warp, "affine", _ALIGN_ITERATIONS)
        place = warp[:, :2, 2].copy()
        size = np.sqrt(np.abs(np.linalg.det(warp)))
        good = (
            (score >= settings.min_anchor_correlation)
            & (np.abs(place - start[rows]).max(axis=1) <= _ALIGN_MAX_PX)
            & (np.abs(np.log(np.maximum(size, 1e-3))) <= np.log(2 * settings.max_anchor_scale))
        )
        if motion is not None:
            error = pixel_errors(self._camera, motion.T_curr_prev, p[rows], place)
            good &= ~valid[rows] | (error <= settings.consensus_px)
        kept = good | (seen[rows] & (score >= _ANCHOR_LOST))
        rows, warp, place, size, good = rows[kept], warp[kept], place[kept], size[kept], good[kept]
        place[~good] = found[rows[~good]]
        renew = np.flatnonzero(~good | (np.abs(np.log(np.maximum(size, 1e-3))) > np.log(settings.max_anchor_scale)))
        anchor = old.anchor[rows]
        anchor[renew] = cut_patches(image, place[renew], settings.anchor_radius_px)
        warp[renew] = shift_warps(place[renew])
        before = old.take(rows)
        now = replace(before, left=place, velocity=place - before.left, anchor=anchor, warp=warp)
        alone = _apart(place, 0.5 * min_distance_px(image.shape[1], image.shape[0], settings))
        return before.take(alone), now.take(alone)

    def _predict(self, memory: _Memory, prior: TrackPrior | None, seconds: float) -> tuple[FloatArray, BoolArray]:
        """Guess the left pixels (N, 2) in the coming frame, and tell which differ from the old ones."""
        old, settings = memory.tracks, self._settings
        guess = old.left.copy()
        T = self._expected_motion(memory, prior, seconds)
        if settings.guess == "velocity" and prior is None:
            guess += old.velocity
        elif settings.guess == "motion" or prior is not None:
            guess = self._moved(old, T)
        if prior is not None and len(prior.ids):
            row = np.searchsorted(old.ids, prior.ids)
            row = np.minimum(row, len(old) - 1)
            known = (old.ids[row] == prior.ids) & np.isfinite(prior.z[:, :2]).all(axis=1)
            guess[row[known]] = prior.z[known, :2]
        # A guess outside the image cannot be tracked; the old pixel may still be found inside.
        outside = ~inside(memory.image, guess, 0.0)
        guess[outside] = old.left[outside]
        informed = np.linalg.norm(guess - old.left, axis=1) > 0.5
        return guess, informed

    def _expected_motion(self, memory: _Memory, prior: TrackPrior | None, seconds: float) -> FloatArray:
        """Motion (4, 4) `T_curr_prev` expected from the last one, its rotation replaced by a predicted one."""
        T = se3_exp(memory.twist_per_s * seconds)
        if prior is not None and prior.R_cam_prev is not None:
            return se3_from_parts(prior.R_cam_prev, T[:3, 3])
        return T

    def _moved(self, old: _Tracks, T_curr_prev: FloatArray) -> FloatArray:
        """Pixels (N, 2) of the old features after a camera motion; those of unknown depth count as infinitely far."""
        camera = self._camera
        p, valid = self._points(old)
        rays = np.stack(
            [(old.left[:, 0] - camera.cu) / camera.fu, (old.left[:, 1] - camera.cv) / camera.fv, np.ones(len(old))],
            axis=1,
        )
        moved = np.where(valid[:, None], transform_points(T_curr_prev, p), rays @ T_curr_prev[:3, :3].T)
        ahead = moved[:, 2] > 0.1
        pixels = project(camera, np.where(ahead[:, None], moved, [0.0, 0.0, 1.0]))[:, :2]
        return np.where(ahead[:, None], pixels, old.left)

    def _points(self, tracks: _Tracks) -> tuple[FloatArray, BoolArray]:
        """Points (N, 3) in cam0 of features with a right match, and the mask (N,) of those."""
        z = np.concatenate([tracks.left, tracks.right], axis=1)
        p, valid = triangulate(self._camera, z)
        return p, valid & tracks.has_right

    def _flow_both_ways(
        self, previous: Image, current: Image, points: FloatArray, guess: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Track points (N, 2) forth and back; return the new pixels and the mask of those that came back."""
        forth, seen = self._flow(previous, current, points, guess)
        back, seen_back = self._flow(current, previous, forth, points)
        error = np.linalg.norm(back - points, axis=1)
        margin = self._settings.stereo_radius_px + 2
        good = seen & seen_back & (error <= self._settings.max_forward_backward_px) & inside(current, forth, margin)
        return forth, good

    def _flow(
        self, source: Image, target: Image, points: FloatArray, guess: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        settings = self._settings
        start = guess.astype(np.float32).reshape(-1, 1, 2)
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            source,
            target,
            points.astype(np.float32).reshape(-1, 1, 2),
            start,
            winSize=(settings.window_px, settings.window_px),
            maxLevel=settings.pyramid_levels,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, settings.iterations, _LK_EPSILON_PX),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=_LK_MIN_EIGENVALUE,
        )
        pixels = np.asarray(found, dtype=np.float64).reshape(-1, 2)
        seen = (np.asarray(status).reshape(-1) == 1) & np.isfinite(pixels).all(axis=1)
        return np.where(seen[:, None], pixels, points), seen

    def _consensus(
        self,
        memory: _Memory,
        found: FloatArray,
        seen: BoolArray,
        prior: TrackPrior | None,
        seconds: float,
        frame_index: int,
    ) -> tuple[BoolArray, Consensus | None]:
        """Mask (N,) of the found features that move as the static world does, and that motion where there is one."""
        camera, settings, old = self._camera, self._settings, memory.tracks
        p, valid = self._points(old)
        known = np.flatnonzero(valid & seen)
        expected = self._expected_motion(memory, prior, seconds)
        R_prior = None if prior is None else prior.R_cam_prev
        T_prior = None
        if prior is not None:
            _, a, b = np.intersect1d(old.ids[known], prior.ids, assume_unique=True, return_indices=True)
            T_prior = fit_motion(camera, p[known[a]], prior.z[b, :2], expected, settings)
        rng = np.random.default_rng((settings.seed, frame_index))
        motion = rigid_consensus(camera, p[known], found[known], expected, R_prior, T_prior, rng, settings)
        if motion is None:
            return seen, None
        keep = seen.copy()
        keep[known] = motion.inliers
        flat = np.flatnonzero(seen & ~valid)
        near_m = camera.fu * camera.baseline_m / (settings.max_disparity * memory.image.shape[1])
        distance = epipolar_distance(camera, motion.T_curr_prev, old.left[flat], found[flat], near_m)
        keep[flat] = distance <= settings.consensus_px
        return keep, motion

    def _expected_disparity(self, before: _Tracks, motion: Consensus | None) -> FloatArray:
        """Disparity (N,) in the current frame: the old point moved, or the old disparity; NaN where unknown."""
        p, valid = self._points(before)
        disparity = before.left[:, 0] - before.right[:, 0]
        if motion is not None:
            depth = transform_points(motion.T_curr_prev, p)[:, 2]
            disparity = self._camera.fu * self._camera.baseline_m / np.maximum(depth, 0.05)
        return np.where(valid, disparity, np.nan)

    def _with_right(
        self, tracks: _Tracks, right: FloatArray, valid: BoolArray, expected: FloatArray, moved: bool
    ) -> _Tracks:
        """Take in the right pixels; with a known motion, a disparity must agree with the one expected from it."""
        if moved:
            change = np.abs(tracks.left[:, 0] - right[:, 0] - expected)
            valid = valid & ~(change > self._settings.consensus_px)  # NaN, nothing expected, passes
        return replace(tracks, right=right, has_right=valid, blind=np.where(valid, 0, tracks.blind + 1))

    def _check_swap(self, frame: StereoFrame, left: RowPyramid, right: RowPyramid, tracks: _Tracks) -> None:
        """Raise when several frames in a row match only with negative disparities."""
        n, matched = len(tracks), int(tracks.has_right.sum())
        if n < _SWAP_MIN_POINTS or matched >= _SWAP_FEW * n:
            self._suspicious = 0
            return
        flipped = tracks.left * [-1.0, 1.0] + [left.full.shape[1] - 1.0, 0.0]
        nothing = np.full(n, np.nan)
        negative = int(match_rows(mirrored(left), mirrored(right), flipped, nothing, self._settings).valid.sum())
        self._suspicious = self._suspicious + 1 if negative >= max(_SWAP_MANY * n, 2 * matched) else 0
        if self._suspicious >= _SWAP_FRAMES:
            raise DataError(
                f"frame {frame.index}: left and right images look swapped ({negative} of {n} features match with a "
                f"negative disparity, {matched} with a positive one, in {_SWAP_FRAMES} frames); exchange the image "
                "folders or the cameras' calibration"
            )


def _apart(points: FloatArray, distance: float) -> BoolArray:
    """Mask (N,) of points (N, 2) without an earlier point closer than `distance` in the maximum norm."""
    u, v = points[:, 0], points[:, 1]
    near = (np.abs(u[:, None] - u) < distance) & (np.abs(v[:, None] - v) < distance)
    return np.asarray(~np.tril(near, -1).any(axis=1), dtype=np.bool_)


def _joined(a: _Tracks, b: _Tracks) -> _Tracks:
    return _Tracks(
        **{column.name: np.concatenate([getattr(a, column.name), getattr(b, column.name)]) for column in fields(a)}
    )
