"""The default front end: corners tracked in time by Lucas-Kanade and matched left to right along the row."""

from __future__ import annotations

import logging
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from frontend.align import (
    Templates,
    align,
    cut_patches,
    empty_templates,
    rounded,
    scale_change,
    shift_warps,
    templates,
)
from frontend.detect import detect_corners, min_distance_px
from frontend.frames import FrameGate, Stopwatch, SwapAlarm, half_mask, load_mask, usable_prior
from frontend.outliers import (
    Consensus,
    Vote,
    epipolar_distance,
    pixel_errors,
    predicted_motion,
    static_tracks,
)
from frontend.patches import FloatImage, inside
from frontend.settings import FrontendSettings, KltSettings
from frontend.stereo_match import RowField, half_image, match_rows
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_log, transform_points
from vio.geometry.stereo import StereoCamera, left_rays, project, triangulate
from vio.records import BoolArray, FrontendOutput, Image, IntArray, StereoFrame, TrackPrior, observations

logger = logging.getLogger(__name__)

_LK_EPSILON_PX = 0.02
_LK_MIN_EIGENVALUE = 1e-4
_TIME_ITERATIONS = 5
_STEREO_ITERATIONS = 5
_ALIGN_MAX_PX = 2.5  # a fit that moves further than this has left its peak
_ANCHOR_LOST = 0.5  # correlation with its anchor below which a feature is taken for another
_MAX_STRETCH = 0.8  # change of disparity per pixel; the road under a car reaches about 0.4
_COARSE_SLACK = 0.2  # by how much the coarse stereo search may correlate worse than the fine fit
_SWAP_FEW = 0.3  # share of matches below which a frame is suspicious
_SWAP_MIN_POINTS = 20
_NEIGHBOURS = 3  # matched features whose depths stand in for an unknown one
_FEW = 0.5  # share of the least number of features below which corners without depth are taken
_TRIED = 1.5  # corners aligned for each one that is missing
_VERY_FEW = 0.25  # share below which new features are shown at once
_RETRY_SHARE = 0.25  # share of failures at which tracking is tried again with all pyramid levels
_SPARSE = 4  # every so many pixels of the half image tell its brightness
_SPARSE_CONTRAST = 1.0  # gray levels; less is no contrast to compare
_BLIND_CONTRAST = 0.1  # share of the last image's contrast below which an image shows nothing
_SAME_GAIN = 0.06  # change of contrast, and
_SAME_LEVEL = 6.0  # of the mean gray level, that tracking bears
_MAX_GAIN = 4.0
_BANK_SPARE = 3  # templates in memory, over the number of features


@dataclass(frozen=True, slots=True)
class _Tracks:
    """The features alive after a frame; older features come first."""

    ids: IntArray  # (N,) given when a feature is first shown; arbitrary before
    left: FloatArray  # (N, 2) pixels
    right: FloatArray  # (N, 2) pixels, arbitrary where has_right is False
    has_right: BoolArray  # (N,)
    blind: IntArray  # (N,) frames in a row without a right match
    age: IntArray  # (N,) frames since birth
    shown: BoolArray  # (N,) handed out as observations
    point: FloatArray  # (N, 3) cam0 frame, metres; arbitrary where placed is False
    placed: BoolArray  # (N,)
    slot: IntArray  # (N,) row of the anchor in the bank
    warp: FloatArray  # (N, 2, 3) from offsets in the anchor to pixels of the left image
    skew: FloatArray  # (N, 2, 2) what is added to the warp's linear part for the right image

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, index: BoolArray | IntArray) -> _Tracks:
        """Return the rows named by a mask or by indices."""
        return _Tracks(**{column.name: getattr(self, column.name)[index] for column in fields(self)})


def _newborn(left: FloatArray, slot: IntArray) -> _Tracks:
    n = len(left)
    return _Tracks(
        np.zeros(n, dtype=np.int64),
        left,
        right=np.zeros((n, 2)),
        has_right=np.zeros(n, dtype=np.bool_),
        blind=np.zeros(n, dtype=np.int64),
        age=np.zeros(n, dtype=np.int64),
        shown=np.zeros(n, dtype=np.bool_),
        point=np.zeros((n, 3)),
        placed=np.zeros(n, dtype=np.bool_),
        slot=slot,
        warp=shift_warps(left),
        skew=np.zeros((n, 2, 2)),
    )


@dataclass(frozen=True, slots=True)
class _View:
    """One image in the forms that the stages need."""

    full: FloatImage  # (H, W) gray levels
    half: Image  # (H/2, W/2)


@dataclass(frozen=True, slots=True)
class _Memory:
    """What the front end keeps of the frame before."""

    time_ns: int
    left: _View
    right_half: Image
    tracks: _Tracks
    twist_per_s: FloatArray  # (6,) camera motion `[rho; phi]` of the last consensus, over its time
    trusted: bool  # the last motion was one that most features followed


class _AnchorBank:
    """Templates of the living features, in slots that are used again: anchors stay where they are while tracks move."""

    def __init__(self, count: int, radius: int) -> None:
        self.store = empty_templates(count, radius)
        self._taken = np.zeros(count, dtype=np.bool_)

    def put(self, new: Templates) -> IntArray:
        """Store templates; return their slots (N,)."""
        free = np.flatnonzero(~self._taken)[: len(new)]
        if len(free) < len(new):
            more = empty_templates(len(self._taken) + len(new), round(len(self.store.patch[0]) ** 0.5) // 2)
            parts = (np.concatenate([getattr(self.store, f.name), getattr(more, f.name)]) for f in fields(Templates))
            self.store = Templates(*parts)
            self._taken = np.concatenate([self._taken, np.zeros(len(more), dtype=np.bool_)])
            free = np.flatnonzero(~self._taken)[: len(new)]
        self._taken[free] = True
        self.renew(free, new)
        return free

    def renew(self, slots: IntArray, new: Templates) -> None:
        """Replace the templates of slots (N,)."""
        for column in fields(Templates):
            getattr(self.store, column.name)[slots] = getattr(new, column.name)

    def keep_only(self, slots: IntArray) -> None:
        """Free all slots but these."""
        self._taken[:] = False
        self._taken[slots] = True


class KltFrontend:
    """Track corners from frame to frame in the left image and match them into the right one.

    One instance serves one recording: ids count up for ever and are never reused. The result depends on the images,
    the priors and the settings only, to the bit.
    """

    def __init__(self, camera: StereoCamera, settings: FrontendSettings | None = None) -> None:
        settings = FrontendSettings() if settings is None else settings
        self._camera = camera
        self._settings, self._grid = settings.klt, settings.grid
        self._disparity, self._consensus = settings.disparity, settings.consensus
        self._clahe = cv2.createCLAHE(2.0, (8, 8)) if self._settings.equalise == "clahe" else None
        self._mask = None if self._settings.mask is None else load_mask(self._settings.mask)
        self._allowed: BoolArray | None = None
        self._gate = FrameGate(camera, "klt")
        self._swap = SwapAlarm()
        self._bank = _AnchorBank(_BANK_SPARE * self._grid.target_features, self._settings.anchor_radius_px)
        self._memory: _Memory | None = None
        self._rows: RowField | None = None
        self._next_id = 0
        self._blind = 0  # frames in a row that were passed over

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Track, match and detect in one rectified stereo pair; frames come in time order.

        Args:
            frame: the pair, 8-bit gray, of the size that the camera states.
            prior: predicted pixels by id and predicted rotation since the previous frame, where the filter has them.

        Raises:
            DataError: the frame has no images, images of a wrong size or type, or a time not after the last one's; or
                left and right look swapped.
            ConfigError: the mask is not of the images' size.
        """
        watch = Stopwatch()
        left, right = (self._view(image) for image in self._gate.admit(frame))
        if self._rows is None:
            self._rows = RowField(left.full.shape[1], left.full.shape[0])
        if self._mask is not None and self._allowed is None:
            self._allowed = half_mask(self._mask, left.full.shape, left.half.shape)
        watch.lap("prepare")
        if self._blinded(left):
            return FrontendOutput(
                observations(frame.index, frame.time_ns, [], np.zeros((0, 4))), 0, 0, 0, watch.stages_ms
            )
        tracks, motion = self._tracked(frame, left, right, usable_prior(prior), watch)
        missing = self._grid.target_features - len(tracks)
        corners = detect_corners(
            left.half,
            tracks.left,
            round(missing * (1.0 + self._settings.spare_corners)),
            self._grid,
            self._settings,
            self._allowed,
        )
        watch.lap("detect")
        tracks = self._completed(left, right, tracks, corners, motion)
        self._rows.learn(tracks.left[tracks.has_right], tracks.right[tracks.has_right])
        watch.lap("stereo")
        self._check_swap(frame, left, right, tracks)
        tracks = self._with_shown(tracks)
        self._bank.keep_only(tracks.slot)
        before = self._memory
        seconds = 0.0 if before is None else (frame.time_ns - before.time_ns) * 1e-9
        twist = np.zeros(6) if before is None else before.twist_per_s
        if motion is not None:
            twist = se3_log(motion.T_curr_prev) / seconds
        self._memory = _Memory(frame.time_ns, left, right.half, tracks, twist, motion is not None)
        old_ids = np.zeros(0, dtype=np.int64) if before is None else before.tracks.ids[before.tracks.shown]
        seen = tracks.take(tracks.shown)
        carried = int(np.isin(seen.ids, old_ids, assume_unique=True).sum())
        z = np.concatenate([seen.left, seen.right], axis=1)
        watch.lap("check")
        return FrontendOutput(
            observations(frame.index, frame.time_ns, seen.ids, z, seen.has_right),
            tracked=carried,
            matched=int(seen.has_right.sum()),
            detected=len(seen) - carried,
            stages_ms=watch.stages_ms,
        )

    def _blinded(self, left: _View) -> bool:
        """Whether the image shows nothing where the one before did: black, saturated or covered for a moment.

        Such a frame is passed over, and tracking goes on from the one before, for as many frames as the setting says.
        """
        memory, before = self._memory, self._blind
        self._blind = 0
        if memory is None or len(memory.tracks) == 0 or before >= self._settings.max_blind_frames:
            return False
        if _contrast(left.half) < _BLIND_CONTRAST * _contrast(memory.left.half):
            self._blind = before + 1
        return self._blind > 0

    def _view(self, image: Image) -> _View:
        """Equalise an image and convert it; nothing of the result shares memory with it."""
        if self._clahe is not None:
            image = np.asarray(self._clahe.apply(image), dtype=np.uint8)
        return _View(image.astype(np.float32), half_image(image))

    # --- features of the frame before -------------------------------------------------------------------------------

    def _tracked(
        self, frame: StereoFrame, left: _View, right: _View, prior: TrackPrior | None, watch: Stopwatch
    ) -> tuple[_Tracks, Consensus | None]:
        """Follow the features of the frame before into both images; return the survivors and the voted motion."""
        memory = self._memory
        nothing = np.zeros(0, dtype=np.int64)
        if memory is None or len(memory.tracks) == 0:
            return _newborn(np.zeros((0, 2)), nothing), None
        seconds = (frame.time_ns - memory.time_ns) * 1e-9
        expected = se3_exp(memory.twist_per_s * seconds)
        found, seen = self._flow_all(memory, left, prior, expected)
        watch.lap("track")
        seen, motion = self._vote(memory.tracks, found, seen, prior, expected, frame.index)
        watch.lap("reject")
        tracks = self._aligned(memory, left, found, seen, motion)
        watch.lap("align")
        tracks = self._with_right(memory, tracks, right, motion is not None)
        watch.lap("stereo")
        return tracks, motion

    def _flow_all(
        self, memory: _Memory, left: _View, prior: TrackPrior | None, expected: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Follow the features of the frame before; return pixels (N, 2) and the mask (N,) of those found.

        Where the pixels are predicted, few pyramid levels are searched; should many fail, all levels; should most fail
        even so, the prediction as a whole was wrong, and the search starts from where the features were.
        """
        old, settings = memory.tracks, self._settings
        previous = _as_bright(memory.left.half, left.half)
        guess = self._predict(old, prior, expected, left.full)
        trusted = prior is not None or (memory.trusted and settings.guess == "motion")
        few = min(settings.trusted_levels, settings.pyramid_levels)
        found, good = self._flow_both_ways(previous, left, old.left, guess, few if trusted else settings.pyramid_levels)
        attempts = [old.left] if not trusted else [guess, old.left]
        for k, start in enumerate(attempts):
            retry = np.flatnonzero(~good)
            limit = 0.5 if k == len(attempts) - 1 else _RETRY_SHARE
            if len(retry) <= limit * len(old):
                break
            found[retry], good[retry] = self._flow_both_ways(
                previous, left, old.left[retry], start[retry], settings.pyramid_levels
            )
        return found, good

    def _predict(self, old: _Tracks, prior: TrackPrior | None, expected: FloatArray, image: FloatImage) -> FloatArray:
        """Guess the left pixels (N, 2) in the coming frame."""
        guess = old.left.copy()
        if prior is not None and prior.R_cam_prev is not None:
            expected = se3_from_parts(prior.R_cam_prev, expected[:3, 3])
        if self._settings.guess == "motion" or prior is not None:
            guess = self._moved(old, self._with_neighbours(old), expected)
        if prior is not None and len(prior.ids):
            row, given = _common(old, np.arange(len(old)), prior.ids)
            guess[row] = prior.z[given, :2]
        # A guess outside the image cannot be tracked; the old pixel may still be found inside.
        outside = ~inside(image, guess, 0.0)
        guess[outside] = old.left[outside]
        return guess

    def _with_neighbours(self, old: _Tracks) -> FloatArray:
        """Points (N, 3) of the features, those of unknown depth as deep as their nearest neighbours in the image."""
        known, unknown = np.flatnonzero(old.placed), np.flatnonzero(~old.placed)
        if len(unknown) == 0 or len(known) < _NEIGHBOURS:
            return np.where(old.placed[:, None], old.point, left_rays(self._camera, old.left) * 1e6)
        gap = np.abs(old.left[unknown, None] - old.left[known]).sum(axis=2)
        nearest = known[np.argpartition(gap, _NEIGHBOURS - 1, axis=1)[:, :_NEIGHBOURS]]
        point = old.point.copy()
        point[unknown] = left_rays(self._camera, old.left[unknown]) * np.median(old.point[nearest, 2], axis=1)[:, None]
        return point

    def _moved(self, old: _Tracks, point: FloatArray, T_curr_prev: FloatArray) -> FloatArray:
        """Pixels (N, 2) of old points (N, 3) after a camera motion; those that end up behind stay where they were."""
        moved = transform_points(T_curr_prev, point)
        ahead = moved[:, 2] > 0.1
        pixels = project(self._camera, np.where(ahead[:, None], moved, [0.0, 0.0, 1.0]))[:, :2]
        return np.where(ahead[:, None], pixels, old.left)

    def _flow_both_ways(
        self, previous_half: Image, left: _View, points: FloatArray, guess: FloatArray, levels: int
    ) -> tuple[FloatArray, BoolArray]:
        """Track points (N, 2) forth and back; return the new pixels and the mask of those that came back."""
        forth, seen = flow(previous_half, left.half, points, guess, levels, self._settings)
        back, seen_back = flow(left.half, previous_half, forth, points, levels, self._settings)
        error = np.linalg.norm(back - points, axis=1)
        margin = self._settings.anchor_radius_px + 2
        good = seen & seen_back & (error <= self._settings.max_forward_backward_px) & inside(left.full, forth, margin)
        return forth, good

    def _vote(
        self,
        old: _Tracks,
        found: FloatArray,
        seen: BoolArray,
        prior: TrackPrior | None,
        expected: FloatArray,
        frame_index: int,
    ) -> tuple[BoolArray, Consensus | None]:
        """Mask (N,) of the found features that move as the static world does, and that motion where there is one."""
        camera, limit_px = self._camera, self._settings.consensus_px
        rows = np.flatnonzero(seen)
        deep = (old.has_right & old.placed)[rows]
        R_prior = T_prior = None
        if prior is not None:
            row, given = _common(old, rows[deep], prior.ids)
            R_prior = prior.R_cam_prev
            T_prior = predicted_motion(camera, old.point[row], prior.z[given, :2], expected)
        rng = np.random.default_rng((self._consensus.seed, frame_index))
        vote = Vote(camera, self._consensus, limit_px, rng)
        before, after = old.left[rows], found[rows]
        kept, motion = static_tracks(vote, before, old.point[rows], deep, after, expected, R_prior, T_prior)
        if motion is not None and not deep.all():
            near_m = camera.fu * camera.baseline_m / self._max_disparity(self._width())
            distance = epipolar_distance(camera, motion.T_curr_prev, before[~deep], after[~deep], near_m)
            kept[~deep] = distance <= limit_px
        keep = np.zeros(len(old), dtype=np.bool_)
        keep[rows[kept]] = True
        return keep, motion

    def _width(self) -> int:
        assert self._memory is not None
        return int(self._memory.left.full.shape[1])

    def _max_disparity(self, width: int) -> float:
        return self._disparity.max_disparity * width

    def _aligned(
        self, memory: _Memory, left: _View, found: FloatArray, seen: BoolArray, motion: Consensus | None
    ) -> _Tracks:
        """Align the features with their anchors; return the survivors as they are now.

        Lucas-Kanade steps add up to a drift; the anchor does not drift. Features that Lucas-Kanade lost are looked
        for where the consensus motion puts them. Features that were found, but look unlike their anchor, are aligned
        with their looks in the frame before, which become their new anchor.
        """
        settings, old = self._settings, memory.tracks
        start, tried, scale, placed = found.copy(), seen.copy(), np.ones(len(old)), old.placed.copy()
        point = old.point
        if motion is not None:
            point = transform_points(motion.T_curr_prev, old.point)
            predicted = self._moved(old, old.point, motion.T_curr_prev)
            tried |= old.placed & inside(left.full, predicted, settings.anchor_radius_px + 2.0)
            start[~seen] = predicted[~seen]
            ahead = old.placed & (point[:, 2] > 0.1)
            scale = np.where(ahead, old.point[:, 2] / np.where(ahead, point[:, 2], 1.0), 1.0)
        rows = np.flatnonzero(tried)
        warp = old.warp[rows]
        warp[:, :, :2] *= scale[rows, None, None]
        warp[:, :, 2] = start[rows]
        warp, score = align(self._bank.store, old.slot[rows], left.full, warp, _TIME_ITERATIONS)
        moved_px = np.abs(warp[:, :, 2] - start[rows]).max(axis=1)
        change = np.abs(np.log(scale_change(warp)))
        good = (score >= settings.min_anchor_correlation) & (moved_px <= _ALIGN_MAX_PX)
        good &= change <= np.log(2 * settings.max_anchor_scale)
        kept = good.copy()
        again = np.flatnonzero(~good & seen[rows] & (score >= _ANCHOR_LOST))
        if len(again):
            warp[again], kept[again] = self._realigned(memory, left, rows[again], start[rows[again]], scale)
        if motion is not None:
            error = pixel_errors(self._camera, motion.T_curr_prev, old.point[rows], warp[:, :, 2])
            astray = error > settings.consensus_px
            kept &= ~(astray & old.placed[rows] & old.has_right[rows])
            placed[rows[astray]] = False  # its depth was carried along without being measured, and was wrong
        rows, warp, change = rows[kept], warp[kept], change[kept]
        place = warp[:, :, 2].copy()
        far = np.flatnonzero(good[kept] & (change > np.log(settings.max_anchor_scale)))
        if len(far):
            place[far] = rounded(place[far])
            self._bank.renew(old.slot[rows[far]], self._cut(left, place[far]))
            warp[far] = shift_warps(place[far])
        now = replace(
            old.take(rows),
            left=place,
            warp=warp,
            point=point[rows],
            placed=placed[rows],
            age=old.age[rows] + 1,
            has_right=np.zeros(len(rows), dtype=np.bool_),
        )
        return now.take(_apart(place, 0.5 * min_distance_px(left.full.shape[1], left.full.shape[0], self._grid)))

    def _cut(self, left: _View, centres: FloatArray) -> Templates:
        return templates(cut_patches(left.full, centres, self._settings.anchor_radius_px))

    def _realigned(
        self, memory: _Memory, left: _View, rows: IntArray, start: FloatArray, scale: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Align features with a new anchor cut from the frame before; return warps (N, 2, 3) and a mask (N,)."""
        old, settings = memory.tracks, self._settings
        centres = rounded(old.left[rows])
        self._bank.renew(old.slot[rows], self._cut(memory.left, centres))
        warp = shift_warps(start + centres - old.left[rows])
        warp[:, :, :2] *= scale[rows, None, None]
        warp, score = align(self._bank.store, old.slot[rows], left.full, warp, _TIME_ITERATIONS)
        # The anchor was cut beside the feature by the rounding; give the feature its own place back.
        beside = (old.left[rows] - centres)[:, :, None]
        warp[:, :, 2] += (warp[:, :, :2] @ beside)[:, :, 0]
        moved_px = np.abs(warp[:, :, 2] - start).max(axis=1)
        return warp, (score >= settings.min_anchor_correlation) & (moved_px <= _ALIGN_MAX_PX)

    # --- the right image --------------------------------------------------------------------------------------------

    def _with_right(self, memory: _Memory, tracks: _Tracks, right: _View, moved: bool) -> _Tracks:
        """Align features of known depth with the right image; with a known motion, the disparity must agree with it."""
        rows = np.flatnonzero(tracks.placed & (tracks.point[:, 2] > 0.05))
        expected = self._camera.fu * self._camera.baseline_m / tracks.point[rows, 2]
        place, skew, valid = self._right_of(tracks.take(rows), right, expected)
        if moved:
            valid &= np.abs(tracks.left[rows, 0] - place[:, 0] - expected) <= self._settings.consensus_px
        if self._settings.circle_check:
            valid &= self._closes_circle(memory, right, tracks.take(rows), place)
        return self._taken_in(tracks, rows[valid], place[valid], skew[valid])

    def _closes_circle(self, memory: _Memory, right: _View, tracks: _Tracks, place: FloatArray) -> BoolArray:
        """Mask (N,) of right pixels (N, 2) that tracking in time from the last right image leads to as well.

        Features that had no right match in the last frame have no circle to close, and pass. The tracks hold their
        right pixels of that frame.
        """
        closes = tracks.blind > 0
        rows = np.flatnonzero(~closes)
        previous = _as_bright(memory.right_half, right.half)
        gap = circle_gaps(previous, right.half, tracks.right[rows], place[rows], self._settings)
        closes[rows] = gap <= self._settings.max_circle_px
        return closes

    def _right_of(
        self, tracks: _Tracks, right: _View, disparity: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Align features with the right image near expected disparities (N,).

        Returns:
            Right pixels (N, 2), the change of the warp's linear part (N, 2, 2), and a mask (N,) of the good ones.
        """
        settings = self._settings
        assert self._rows is not None
        rows = self._rows.rows(tracks.left)
        warp = tracks.warp.copy()
        warp[:, :, :2] += tracks.skew
        warp[:, 0, 2] -= disparity
        warp[:, 1, 2] = rows
        start = warp[:, :, 2].copy()
        warp, score = align(self._bank.store, tracks.slot, right.full, warp, _STEREO_ITERATIONS, rows)
        place, skew = warp[:, :, 2], warp[:, :, :2] - tracks.warp[:, :, :2]
        found = tracks.left[:, 0] - place[:, 0]
        valid = (
            (score >= settings.min_correlation)
            & (np.abs(place - start).max(axis=1) <= _ALIGN_MAX_PX)
            & (np.abs(skew).max(axis=(1, 2)) <= _MAX_STRETCH)
            & (np.abs(rows - place[:, 1]) <= settings.max_epipolar_px)
            & (found >= self._disparity.min_disparity_px)
            & (found <= self._max_disparity(right.full.shape[1]))
        )
        return place, skew, valid

    def _taken_in(self, tracks: _Tracks, rows: IntArray, place: FloatArray, skew: FloatArray) -> _Tracks:
        """Give the named rows their right pixels (K, 2), and the depth that follows."""
        right, has_right, skews = tracks.right.copy(), tracks.has_right.copy(), tracks.skew.copy()
        right[rows], has_right[rows], skews[rows] = place, True, skew
        p, valid = triangulate(self._camera, np.concatenate([tracks.left[rows], place], axis=1))
        point, placed = tracks.point.copy(), tracks.placed.copy()
        point[rows[valid]], placed[rows[valid]] = p[valid], True
        return replace(tracks, right=right, has_right=has_right, skew=skews, point=point, placed=placed)

    def _completed(
        self, left: _View, right: _View, tracks: _Tracks, corners: FloatArray, motion: Consensus | None
    ) -> _Tracks:
        """Search right matches for features that lack one and for new corners; add the best new ones."""
        settings = self._settings
        lacking = ~tracks.has_right
        if motion is not None:
            # What was placed before, but was not found again near its place, must not turn up elsewhere.
            lacking &= ~tracks.placed
        rows = np.flatnonzero(lacking)
        disparity, unique = match_rows(
            left.half,
            right.half,
            np.concatenate([tracks.left[rows], corners]),
            self._max_disparity(left.full.shape[1]),
            settings.min_correlation - _COARSE_SLACK,
            settings.min_peak_margin,
        )
        again, fresh = np.split(disparity, [len(rows)])
        known, unique = np.split(unique, [len(rows)])
        tracks = self._matched(tracks, right, rows[known], again[known])
        tracks = replace(tracks, blind=np.where(tracks.has_right, 0, tracks.blind + 1))
        tracks = tracks.take(tracks.blind <= settings.max_left_only_frames)
        return _joined(tracks, self._born(left, right, tracks, corners, fresh, unique, motion))

    def _matched(self, tracks: _Tracks, right: _View, rows: IntArray, disparity: FloatArray) -> _Tracks:
        """Give the named rows right pixels near their disparities (K,), where they are found."""
        place, skew, valid = self._right_of(tracks.take(rows), right, disparity)
        return self._taken_in(tracks, rows[valid], place[valid], skew[valid])

    def _born(
        self,
        left: _View,
        right: _View,
        tracks: _Tracks,
        corners: FloatArray,
        disparity: FloatArray,
        unique: BoolArray,
        motion: Consensus | None,
    ) -> _Tracks:
        """New features from corners (K, 2), the best first, with coarse disparities (K,) where they are unique (K,).

        Wanted are those with depth that will stay in the image. Those that will soon leave are taken only while less
        than the least number of features is there; those without depth only while few are.
        """
        target, matched = self._grid.target_features, int(tracks.has_right.sum())
        room = max(0, target - len(tracks))
        least = self._settings.least_features * target
        stays = self._stays(corners, disparity, motion, left.full)
        tried = round(_TRIED * room)
        lasting, leaving = np.flatnonzero(unique & stays)[:tried], np.flatnonzero(unique & ~stays)[:tried]
        leaving = leaving[: max(0, round(_TRIED * (least - matched - len(lasting) / _TRIED)))]
        flat = np.flatnonzero(~unique)[:room]
        if matched > _FEW * least:
            flat = flat[:0]
        chosen = np.concatenate([lasting, leaving, flat])
        centres = rounded(corners[chosen])
        born = _newborn(centres, self._bank.put(self._cut(left, centres)))
        deep = np.arange(len(lasting) + len(leaving))
        born = self._matched(born, right, deep, disparity[chosen[deep]])
        born = replace(born, blind=np.where(born.has_right, 0, 1))
        good = np.flatnonzero(born.has_right | (len(flat) > 0))
        return born.take(good[np.argsort(~born.has_right[good], kind="stable")][:room])

    def _stays(
        self, corners: FloatArray, disparity: FloatArray, motion: Consensus | None, image: FloatImage
    ) -> BoolArray:
        """Mask (K,) of corners that remain in view for a while if the camera goes on as it does."""
        if motion is None or self._settings.wanted_life_frames == 0:
            return np.ones(len(corners), dtype=np.bool_)
        T = np.linalg.matrix_power(motion.T_curr_prev, self._settings.wanted_life_frames)
        depth = self._camera.fu * self._camera.baseline_m / np.maximum(disparity, 0.1)
        moved = transform_points(T, left_rays(self._camera, corners) * depth[:, None])
        ahead = moved[:, 2] > 0.5
        pixels = project(self._camera, np.where(ahead[:, None], moved, [0.0, 0.0, 1.0]))[:, :2]
        return np.asarray(ahead & inside(image, pixels, 0.0))

    def _with_shown(self, tracks: _Tracks) -> _Tracks:
        """Show features that outlived their probation, under new ids; all of them where few would be left."""
        proven = tracks.shown | ((tracks.age >= self._settings.probation_frames) & tracks.has_right)
        if proven.sum() < _VERY_FEW * self._grid.target_features:
            proven[:] = True
        ids, first = tracks.ids.copy(), proven & ~tracks.shown
        ids[first] = np.arange(int(first.sum())) + self._next_id
        self._next_id += int(first.sum())
        return replace(tracks, ids=ids, shown=proven)

    def _check_swap(self, frame: StereoFrame, left: _View, right: _View, tracks: _Tracks) -> None:
        """Raise when several frames in a row match only with negative disparities."""
        n, matched = len(tracks), int(tracks.has_right.sum())
        if n < _SWAP_MIN_POINTS or matched >= _SWAP_FEW * n:
            self._swap.clear()
            return
        settings = self._settings
        flipped = tracks.left * [-1.0, 1.0] + [2.0 * (left.half.shape[1] - 1), 0.0]
        disparity, unique = match_rows(
            np.ascontiguousarray(left.half[:, ::-1]),
            np.ascontiguousarray(right.half[:, ::-1]),
            flipped,
            self._max_disparity(left.full.shape[1]),
            settings.min_correlation,
            settings.min_peak_margin,
        )
        self._swap.check(frame, n, matched, int((unique & (disparity >= 1.0)).sum()))


def flow(
    source: Image, target: Image, points: FloatArray, guess: FloatArray, levels: int, settings: KltSettings
) -> tuple[FloatArray, BoolArray]:
    """Track points (N, 2) between half-resolution images by Lucas-Kanade, all in pixels of the full image.

    Returns:
        The new pixels (N, 2), and a mask (N,) of those found; the others stay where they were.
    """
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        (points / 2).astype(np.float32).reshape(-1, 1, 2),
        (guess / 2).astype(np.float32).reshape(-1, 1, 2),
        winSize=(settings.window_px, settings.window_px),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, settings.iterations, _LK_EPSILON_PX),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_LK_MIN_EIGENVALUE,
    )
    pixels = 2 * np.asarray(found, dtype=np.float64).reshape(-1, 2)
    seen = (np.asarray(status).reshape(-1) == 1) & np.isfinite(pixels).all(axis=1)
    return np.where(seen[:, None], pixels, points), seen


def circle_gaps(
    previous: Image, current: Image, before: FloatArray, after: FloatArray, settings: KltSettings
) -> FloatArray:
    """Distances (N,) in pixels between right pixels and where tracking in the right images leads; infinite where lost.

    Args:
        previous: last right image at half resolution.
        current: present one.
        before: right pixels (N, 2) matched in the last frame.
        after: right pixels (N, 2) matched in the present one.
        settings: of the tracking.
    """
    if len(before) == 0:
        return np.zeros(0)
    found, seen = flow(previous, current, before, after, settings.trusted_levels, settings)
    return np.where(seen, np.linalg.norm(found - after, axis=1), np.inf)


def _contrast(image: Image) -> float:
    """Standard deviation of an image's gray levels, from a sparse grid of them."""
    return float(image[::_SPARSE, ::_SPARSE].astype(np.float64).std())


def _as_bright(image: Image, other: Image) -> Image:
    """The image with the other's mean and contrast where they differ clearly: Lucas-Kanade compares gray levels."""
    a, b = (part[::_SPARSE, ::_SPARSE].astype(np.float64) for part in (image, other))
    gain = float(b.std() / max(a.std(), _SPARSE_CONTRAST))
    if (abs(gain - 1) < _SAME_GAIN and abs(float(b.mean() - a.mean())) < _SAME_LEVEL) or gain <= 0:
        return image
    gain = min(max(gain, 1 / _MAX_GAIN), _MAX_GAIN)
    levels = gain * (np.arange(256) - a.mean()) + b.mean()
    return np.asarray(cv2.LUT(image, np.clip(np.rint(levels), 0, 255).astype(np.uint8)), dtype=np.uint8)


def _common(tracks: _Tracks, rows: IntArray, ids: IntArray) -> tuple[IntArray, IntArray]:
    """Those of the rows whose feature is among the ids, and where among the ids it is."""
    shown = rows[tracks.shown[rows]]
    _, a, b = np.intersect1d(tracks.ids[shown], ids, assume_unique=True, return_indices=True)
    return shown[a], b


def _apart(points: FloatArray, distance: float) -> BoolArray:
    """Mask (N,) of points (N, 2) without an earlier point closer than `distance` in the maximum norm."""
    u, v = points[:, 0], points[:, 1]
    near = (np.abs(u[:, None] - u) < distance) & (np.abs(v[:, None] - v) < distance)
    return np.asarray(~np.tril(near, -1).any(axis=1), dtype=np.bool_)


def _joined(a: _Tracks, b: _Tracks) -> _Tracks:
    return _Tracks(
        **{column.name: np.concatenate([getattr(a, column.name), getattr(b, column.name)]) for column in fields(a)}
    )
