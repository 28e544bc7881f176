"""The default front end: corners tracked in time by Lucas-Kanade and matched from left to right along the row."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from vio.compiled import compiled
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_log, transform_points
from vio.geometry.stereo import StereoCamera, left_rays, project
from vio.records import BoolArray, FrontendOutput, Image, IntArray, StereoFrame, TrackPrior

from .align import align, on_peak, rounded, scale_change, shift_warps, template_points
from .columns import joined, take
from .detect import detect_corners, half_mask, load_mask, min_distance_px
from .exchange import ExchangeDetector, MatchCounts
from .flicker import BandRemoval
from .flow import lost_contrast, track_with_retries
from .frames import FrameValidator, Stopwatch, SwapDetector, make_output
from .moving_object import ObjectReport, choose_motion
from .outliers import Consensus, RansacProblem, epipolar_distance, pixel_errors, predicted_motion, static_tracks
from .patches import FloatImage, View, half_image, inside
from .prediction import moved_pixels, prior_depths, prior_pixels, usable_prior
from .right_camera import RightCamera
from .right_delay import PairingCounts, RightDelay, at_exposure, at_present
from .settings import FrontendSettings
from .stereo_fit import StereoFit
from .tracks import AnchorBank, Tracks, new_tracks, no_tracks

_ITERATIONS = 5
_ANCHOR_LOST = 0.5  # correlation with the anchor below which a feature is lost
_PAIRING_POINTS = 150  # features that are tried with images of other frames
_EXCHANGE_POINTS = 80  # points that matches of either sign are counted at
_SWAP_FEW = 0.3  # share of matches below which left and right may be swapped
_NEIGHBOURS = 3  # matched features whose median depth replaces an unknown one
_FAR_M = 1e6  # depth assumed where too few features have one
_FEW = 0.5  # share of the least number of features below which corners without depth are added
_TRIED = 1.5  # corners aligned per missing feature
_VERY_FEW = 0.25  # share of the target below which new features are output at once
_LONG_GAP_S = 0.8  # a rig that flies or is carried shows other things after it …
_LONG_GAP_STEPS = 5.0  # … where frames usually come so many times as often
_BANK_SPARE = 3  # templates allocated, over the number of features


@dataclass(frozen=True, slots=True)
class _PreviousFrame:
    """State kept from the previous frame."""

    time_ns: int
    left: View
    right_half: Image
    tracks: Tracks
    twist_per_s: FloatArray  # (6,) camera motion `[rho; phi]` per second, from the last consensus
    trusted: bool  # the last motion had a consensus


@dataclass(frozen=True, slots=True)
class _Start:
    """Start of the alignment of the previous frame's features with their anchors."""

    pixels: FloatArray  # (N, 2) left pixels
    scale: FloatArray  # (N,) predicted change of scale since the previous frame
    point: FloatArray  # (N, 3) moved by the camera motion where it is known, cam0 frame, metres
    tried: BoolArray  # (N,) to be aligned


class KltFrontend:
    """Track corners from frame to frame in the left image and match them into the right one.

    One instance processes one recording: ids increase and are never reused. The result is deterministic to the bit: it
    depends on the images, the priors and the settings only.
    """

    def __init__(self, camera: StereoCamera, settings: FrontendSettings | None = None) -> None:
        settings = FrontendSettings() if settings is None else settings
        self._settings, self._grid = settings.klt, settings.grid
        self._consensus, self._disparity = settings.consensus, settings.disparity
        self._camera = camera
        self._clahe = cv2.createCLAHE(2.0, (8, 8)) if self._settings.equalise == "clahe" else None
        self._mask = None if self._settings.mask is None else load_mask(self._settings.mask)
        self._validator = FrameValidator(camera, "klt")
        self._swap = SwapDetector(_SWAP_FEW)
        self._bands = BandRemoval()
        self._exchange = ExchangeDetector()
        self._right = RightCamera()
        self._delay = RightDelay(camera)
        self._objects = ObjectReport()
        self._lines: list[str] = []  # of the frame, for the log
        self._bank = AnchorBank(_BANK_SPARE * self._grid.target_features, self._settings.anchor_radius_px)
        self._previous: _PreviousFrame | None = None
        self._setup: tuple[StereoFit, BoolArray | None] | None = None  # made with the image size of the first frame
        self._next_id = 0
        self._skipped = 0  # frames in a row
        self._step_ns: int | None = None  # between the last two frames

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Track, match and detect in one rectified stereo pair; see `vio.protocols.Frontend`.

        Raises:
            ConfigError: the mask is not of the images' size.
        """
        watch = Stopwatch()
        images = self._validator.validate(frame)
        left, right = (self._view(image) for image in self._bands(frame.index, *images))
        stereo, allowed = self._set_up(left)
        watch.lap("prepare")
        if self._contrast_lost(left):
            return make_output(frame, no_tracks(), 0, watch)
        order = self._exchange.order(
            frame.index,
            left.half,
            right.half,
            lambda: self._count_matches(left, right, stereo),
            suspicious=not self._right.usable,
        )
        if order == "refused":
            return make_output(frame, no_tracks(), 0, watch, self._take_lines())
        if order == "exchanged":
            left, right = right, left
        if self._right.left_is_frozen(frame.index, left.half, right.half):
            return make_output(frame, no_tracks(), 0, watch, self._take_lines())
        tracks, motion = self._track(frame, left, right, usable_prior(prior), stereo, watch)
        missing = self._grid.target_features - len(tracks)
        wanted = round(missing * (1.0 + self._settings.spare_corners))
        corners = detect_corners(left.half, tracks.left, wanted, self._grid, self._settings, allowed)
        watch.lap("detect")
        tracks = self._add_new_features(left, right, tracks, corners, motion, stereo)
        if self._right.usable and self._delay.frames == 0.0:
            stereo.update_rows(tracks)
        watch.lap("stereo")
        points, matched = tracks.left, int(tracks.has_right.sum())
        self._swap.check(frame, len(points), matched, lambda: stereo.count_mirrored(left, right, points))
        tracks = self._promote(tracks)
        seen = take(tracks, tracks.shown)
        tracked = self._count_tracked(seen)
        self._store(frame, left, right, tracks, motion)
        watch.lap("check")
        return make_output(frame, seen, tracked, watch, self._take_lines())

    def _take_lines(self) -> tuple[str, ...]:
        """Return what the frame says of the images, one line an event."""
        lines, self._lines = (
            (
                *self._bands.take_lines(),
                *self._exchange.take_lines(),
                *self._right.take_lines(),
                *self._delay.take_lines(),
                *self._lines,
            ),
            [],
        )
        return lines

    def _view(self, image: Image) -> View:
        """Equalise and convert an image; the result does not share memory with it."""
        if self._clahe is not None:
            image = np.asarray(self._clahe.apply(image), dtype=np.uint8)
        return View(image.astype(np.float32), half_image(image))

    def _set_up(self, left: View) -> tuple[StereoFit, BoolArray | None]:
        """Return the stereo matcher and the mask (H/2, W/2) of allowed corners, set up with the first frame."""
        if self._setup is None:
            height, width = left.full.shape
            allowed = None if self._mask is None else half_mask(self._mask, left.full.shape, left.half.shape)
            stereo = StereoFit(self._camera, self._settings, self._disparity, self._bank, (width, height))
            self._setup = stereo, allowed
        return self._setup

    def _contrast_lost(self, left: View) -> bool:
        """Whether the image has no contrast although the previous one had: black, saturated or covered for a moment.

        Such a frame is skipped and tracking continues from the one before, for at most `max_blind_frames` frames.
        """
        previous, before = self._previous, self._skipped
        self._skipped = 0
        if previous is None or len(previous.tracks) == 0 or before >= self._settings.max_blind_frames:
            return False
        if lost_contrast(left.half, previous.left.half):
            self._skipped = before + 1
        return self._skipped > 0

    def _count_matches(self, left: View, right: View, stereo: StereoFit) -> MatchCounts:
        """Count matches of either sign, at the points that the other camera saw last."""
        previous = self._previous
        if previous is None:
            return MatchCounts(0, 0, 0)
        tracks = previous.tracks
        points = np.where(tracks.has_right[:, None], tracks.right, tracks.left)
        points = points[inside(left.full, points, 0.0)][:_EXCHANGE_POINTS]
        positive = int(stereo.search(left, right, points)[1].sum())
        return MatchCounts(len(points), positive, stereo.count_mirrored(left, right, points))

    def _count_tracked(self, seen: Tracks) -> int:
        """Count the features that were output in the previous frame, too."""
        if self._previous is None:
            return 0
        old = self._previous.tracks
        return int(np.isin(seen.ids, old.ids[old.shown], assume_unique=True).sum())

    def _store(self, frame: StereoFrame, left: View, right: View, tracks: Tracks, motion: Consensus | None) -> None:
        """Store the state that the next frame needs."""
        self._bank.keep_only(tracks.slot)
        before = self._previous
        self._step_ns = None if before is None else frame.time_ns - before.time_ns
        twist = np.zeros(6) if before is None else before.twist_per_s
        if before is not None and motion is not None:
            twist = se3_log(motion.T_curr_prev) / ((frame.time_ns - before.time_ns) * 1e-9)
        self._previous = _PreviousFrame(frame.time_ns, left, right.half, tracks, twist, motion is not None)

    # --- features of the previous frame -------------------------------------------------------------------------------

    def _track(
        self,
        frame: StereoFrame,
        left: View,
        right: View,
        prior: TrackPrior | None,
        stereo: StereoFit,
        watch: Stopwatch,
    ) -> tuple[Tracks, Consensus | None]:
        """Track the features of the previous frame into both images; return those kept and the consensus motion."""
        previous = self._previous
        if previous is None or len(previous.tracks) == 0 or (prior is None and self._after_gap(frame)):
            return no_tracks(), None
        old, settings = previous.tracks, self._settings
        expected = se3_exp(previous.twist_per_s * ((frame.time_ns - previous.time_ns) * 1e-9))
        guess = self._guess(old, prior, expected, left.full)
        trusted = prior is not None or previous.trusted
        found, seen = track_with_retries(previous.left.half, left, old.left, guess, trusted, settings)
        watch.lap("track")
        rng = np.random.default_rng((self._consensus.seed, frame.index))
        problem = RansacProblem(self._camera, self._consensus, settings.consensus_px, rng)
        near_px = stereo.max_disparity_px
        seen, motion = self._reject_outliers(problem, old, found, seen, prior, expected, near_px, frame.index)
        watch.lap("reject")
        tracks = self._align_with_anchors(previous, left, found, seen, motion)
        watch.lap("align")
        tracks = self._match_right(frame, tracks, left, right, prior, stereo, motion)
        watch.lap("stereo")
        return tracks, motion

    def _match_right(
        self,
        frame: StereoFrame,
        tracks: Tracks,
        left: View,
        right: View,
        prior: TrackPrior | None,
        stereo: StereoFit,
        motion: Consensus | None,
    ) -> Tracks:
        """Match features of known depth in the right image; no match where the right image cannot be used.

        While it cannot, depths come from the prior, where it has them.
        """
        previous = self._previous
        assert previous is not None
        if not self._right.usable and prior is not None:
            depth, known = prior_depths(self._camera, np.where(tracks.shown, tracks.ids, -1), prior)
            point = np.where(known[:, None], left_rays(self._camera, tracks.left) * depth[:, None], tracks.point)
            tracks = replace(tracks, point=point, has_point=tracks.has_point | known)
        has_point, delay = tracks.has_point, self._delay.frames
        flow = tracks.left - previous.tracks.left[_rows_by_slot(previous.tracks, tracks)]
        if delay == 0.0:
            matched = stereo.track_right(tracks, right, motion is not None)
        else:
            T = np.eye(4) if prior is None or prior.motion is None else prior.motion.T_curr_prev
            T = T if motion is None else motion.T_curr_prev
            matched = self._match_delayed(previous, tracks, right, flow, T, stereo)
        frame_s = (frame.time_ns - previous.time_ns) * 1e-9
        # Wrong matches, of rows far apart, contradict the right image that the search for the rows will need.
        tested = motion is not None and not stereo.has_few_matches
        if not self._right.check_matches(frame.index, matched.has_right[has_point], moved=tested):
            if self._right.contradicts and self._delay.suspect(
                frame.index, self._count_pairings(previous, left, tracks, right, stereo), frame_s
            ):
                self._right.explained()
                stereo.restart_rows()
                return no_tracks()
            return tracks
        seen = matched.has_right
        rows = matched.right[seen, 1] - matched.left[seen, 1] - delay * flow[seen, 1]
        if self._delay.update(frame.index, matched.left[seen], flow[seen], rows, frame_s):
            stereo.restart_rows()
            return no_tracks()  # their depths are those of images of different times
        return matched

    def _count_pairings(
        self, previous: _PreviousFrame, left: View, tracks: Tracks, right: View, stereo: StereoFit
    ) -> PairingCounts:
        """Count the features that match if the right image belongs to this frame, the one before, or the next one."""
        before = previous.tracks.left[_rows_by_slot(previous.tracks, tracks)][:_PAIRING_POINTS]
        now = tracks.left[:_PAIRING_POINTS]
        return PairingCounts(
            points=len(now),
            same=stereo.count_on_rows(left.half, right.half, now),
            late=stereo.count_on_rows(previous.left.half, right.half, before),
            early=stereo.count_on_rows(left.half, previous.right_half, now),
        )

    def _match_delayed(
        self,
        previous: _PreviousFrame,
        tracks: Tracks,
        right: View,
        flow: FloatArray,
        T: FloatArray,
        stereo: StereoFit,
    ) -> Tracks:
        """Match features in a right image of another time, and bring the matches to the present.

        Args:
            previous: the last frame.
            tracks: features at their new left pixels.
            right: the right image.
            flow: motion (N, 2) of the features since the last frame, pixels.
            T: motion (4, 4) of the camera, `T_curr_prev`.
            stereo: the matcher.
        """
        delay = self._delay.frames
        then = stereo.track_right(at_exposure(tracks, flow, T, delay), right, True)
        rows = np.flatnonzero(~then.has_right & ~then.has_point)
        disparity, unique = stereo.search(previous.left, right, (tracks.left - flow)[rows])
        then = stereo.match_near(then, right, rows[unique], disparity[unique])
        stereo.update_rows(then)
        return at_present(self._camera, tracks, then, T, delay)

    def _after_gap(self, frame: StereoFrame) -> bool:
        """Whether so many frames are missing that similar patches are no evidence of the same points."""
        if self._previous is None or self._step_ns is None:
            return False
        gap_ns = frame.time_ns - self._previous.time_ns
        return gap_ns > max(_LONG_GAP_S * 1e9, _LONG_GAP_STEPS * self._step_ns)

    def _guess(self, old: Tracks, prior: TrackPrior | None, expected: FloatArray, image: FloatImage) -> FloatArray:
        """Predict the left pixels (N, 2) in the current frame: from the prior, else by the last motion."""
        if prior is not None and prior.R_cam_prev is not None:
            expected = se3_from_parts(prior.R_cam_prev, expected[:3, 3])
        guess = moved_pixels(self._camera, expected, self._points_with_borrowed_depth(old), old.left)
        if prior is not None:
            rows, predicted = _prior_rows(old, np.arange(len(old)), prior)
            guess[rows] = predicted
        # A prediction outside the image cannot be tracked; the search then starts at the old pixel.
        outside = ~inside(image, guess, 0.0)
        guess[outside] = old.left[outside]
        return guess

    def _points_with_borrowed_depth(self, old: Tracks) -> FloatArray:
        """Points (N, 3) of the features; unknown depths are the median depth of the nearest neighbours in the image."""
        known, unknown = np.flatnonzero(old.has_point), np.flatnonzero(~old.has_point)
        if len(unknown) == 0 or len(known) < _NEIGHBOURS:
            return np.where(old.has_point[:, None], old.point, left_rays(self._camera, old.left) * _FAR_M)
        gap = np.abs(old.left[unknown, None] - old.left[known]).sum(axis=2)
        nearest = known[np.argpartition(gap, _NEIGHBOURS - 1, axis=1)[:, :_NEIGHBOURS]]
        point = old.point.copy()
        point[unknown] = left_rays(self._camera, old.left[unknown]) * np.median(old.point[nearest, 2], axis=1)[:, None]
        return point

    def _reject_outliers(
        self,
        problem: RansacProblem,
        old: Tracks,
        found: FloatArray,
        seen: BoolArray,
        prior: TrackPrior | None,
        expected: FloatArray,
        max_disparity_px: float,
        index: int,
    ) -> tuple[BoolArray, Consensus | None]:
        """Return the mask (N,) of the found features that are static, and the consensus motion if there is one."""
        camera, rows = self._camera, np.flatnonzero(seen)
        has_depth = (old.has_point & (old.has_right | (not self._right.usable)))[rows]
        R_prior = T_prior = None
        if prior is not None:
            known, predicted = _prior_rows(old, rows[has_depth], prior)
            R_prior = prior.R_cam_prev
            T_prior = predicted_motion(camera, old.point[known], predicted, expected)
        before, after = old.left[rows], found[rows]
        kept, motion = static_tracks(problem, before, old.point[rows], has_depth, after, expected, R_prior, T_prior)
        if motion is not None:
            expected_motion = None if prior is None else prior.motion
            chosen = choose_motion(
                problem,
                old.point[rows[has_depth]],
                after[has_depth],
                motion,
                expected_motion,
                in_event=self._objects.active,
            )
            motion, kept[has_depth] = chosen.motion, chosen.motion.inliers
            self._lines += self._objects.frame(index, chosen)
        if motion is not None and not has_depth.all():
            near_m = camera.fu * camera.baseline_m / max_disparity_px
            distance = epipolar_distance(camera, motion.T_curr_prev, before[~has_depth], after[~has_depth], near_m)
            kept[~has_depth] = distance <= problem.limit_px
        keep = np.zeros(len(old), dtype=np.bool_)
        keep[rows[kept]] = True
        return keep, motion

    # --- alignment with anchors ---------------------------------------------------------------------------------------

    def _align_with_anchors(
        self, previous: _PreviousFrame, left: View, found: FloatArray, seen: BoolArray, motion: Consensus | None
    ) -> Tracks:
        """Align the features with their anchors; return those kept, with their new pixels.

        Lucas-Kanade from frame to frame drifts; the anchor does not. Features that Lucas-Kanade lost are searched at
        the pixels predicted by the consensus motion. Features that were found, but differ from their anchor, get a new
        anchor from the previous frame.
        """
        settings, old = self._settings, previous.tracks
        start = self._start(old, left, found, seen, motion)
        rows = np.flatnonzero(start.tried)
        warp = old.warp[rows]
        warp[:, :, :2] *= start.scale[rows, None, None]
        warp[:, :, 2] = start.pixels[rows]
        warp, score = align(self._bank.store, old.slot[rows], left.full, warp, _ITERATIONS)
        change = np.abs(np.log(scale_change(warp)))
        good = (score >= settings.min_anchor_correlation) & on_peak(warp[:, :, 2], start.pixels[rows])
        good &= change <= np.log(2 * settings.max_anchor_scale)
        kept, has_point = good.copy(), old.has_point.copy()
        retry = np.flatnonzero(~good & seen[rows] & (score >= _ANCHOR_LOST))
        if len(retry):
            warp[retry], kept[retry] = self._realign(previous, left, rows[retry], start)
        if motion is not None:
            deviates = (
                pixel_errors(self._camera, motion.T_curr_prev, old.point[rows], warp[:, :, 2]) > settings.consensus_px
            )
            kept &= ~(deviates & old.has_point[rows] & old.has_right[rows])
            has_point[rows[deviates]] = False  # its depth was propagated without a measurement, and was wrong
        rescaled = good & (change > np.log(settings.max_anchor_scale))
        rows, warp, rescaled = rows[kept], warp[kept], rescaled[kept]
        if rescaled.any():
            centres = rounded(warp[rescaled, :, 2])
            self._bank.replace(old.slot[rows[rescaled]], left.full, centres)
            warp[rescaled] = shift_warps(centres)
        now = replace(
            take(old, rows),
            left=warp[:, :, 2].copy(),
            warp=warp,
            point=start.point[rows],
            has_point=has_point[rows],
            age=old.age[rows] + 1,
            has_right=np.zeros(len(rows), dtype=np.bool_),
        )
        height, width = left.full.shape
        return take(now, _spaced(now.left, 0.5 * min_distance_px(width, height, self._grid)))

    def _start(self, old: Tracks, left: View, found: FloatArray, seen: BoolArray, motion: Consensus | None) -> _Start:
        """Start the alignment at the pixel found by Lucas-Kanade, else at the pixel predicted by the motion."""
        if motion is None:
            return _Start(found, np.ones(len(old)), old.point, seen)
        point = transform_points(motion.T_curr_prev, old.point)
        predicted = moved_pixels(self._camera, motion.T_curr_prev, old.point, old.left)
        margin = self._settings.anchor_radius_px + 2.0
        ahead = old.has_point & (point[:, 2] > 0.1)
        return _Start(
            np.where(seen[:, None], found, predicted),
            np.where(ahead, old.point[:, 2] / np.where(ahead, point[:, 2], 1.0), 1.0),
            point,
            seen | (old.has_point & inside(left.full, predicted, margin)),
        )

    def _realign(
        self, previous: _PreviousFrame, left: View, rows: IntArray, start: _Start
    ) -> tuple[FloatArray, BoolArray]:
        """Align features with a new anchor from the previous frame; return warps (N, 2, 3) and a mask (N,)."""
        old = previous.tracks
        centres = rounded(old.left[rows])
        self._bank.replace(old.slot[rows], previous.left.full, centres)
        warp = shift_warps(start.pixels[rows] + centres - old.left[rows])
        warp[:, :, :2] *= start.scale[rows, None, None]
        warp, score = align(self._bank.store, old.slot[rows], left.full, warp, _ITERATIONS)
        # The anchor was cut at a rounded pixel; correct the offset to the feature.
        warp[:, :, 2] = template_points(warp, old.left[rows] - centres)
        return warp, (score >= self._settings.min_anchor_correlation) & on_peak(warp[:, :, 2], start.pixels[rows])

    # --- new features -------------------------------------------------------------------------------------------------

    def _add_new_features(
        self,
        left: View,
        right: View,
        tracks: Tracks,
        corners: FloatArray,
        motion: Consensus | None,
        stereo: StereoFit,
    ) -> Tracks:
        """Search right matches for new corners and for features without one; add the best new corners."""
        tracks, disparity_new, unique = self._search_right(left, right, tracks, corners, motion, stereo)
        stays = self._stay_visible(corners, disparity_new, motion, left.full)
        chosen, with_depth = self._select_corners(tracks, unique, stays)
        centres = rounded(corners[chosen])
        new = new_tracks(centres, self._bank.add(left.full, centres))
        new = stereo.match_near(new, right, np.arange(with_depth), disparity_new[chosen[:with_depth]])
        new = replace(new, left_only_frames=np.where(new.has_right, 0, 1))
        room = max(0, self._grid.target_features - len(tracks))
        good = np.flatnonzero(new.has_right | (len(chosen) > with_depth))
        return joined(tracks, take(new, good[np.argsort(~new.has_right[good], kind="stable")][:room]))

    def _search_right(
        self,
        left: View,
        right: View,
        tracks: Tracks,
        corners: FloatArray,
        motion: Consensus | None,
        stereo: StereoFit,
    ) -> tuple[Tracks, FloatArray, BoolArray]:
        """Search features without a right match and corners (K, 2) along the row.

        Returns:
            The features, without those that had no match for too long; disparities (K,) of the corners in pixels; a
            mask (K,) of the corners found. Where the right image cannot be used, nothing is searched or dropped.
        """
        nothing = np.zeros(len(corners)), np.zeros(len(corners), dtype=np.bool_)
        if not self._right.usable:
            return tracks, *nothing
        if self._delay.frames != 0.0:  # a corner can be matched once it has been seen in two frames
            return self._without_old_left_only(tracks), *nothing
        unmatched = ~tracks.has_right
        if motion is not None:
            # A feature with a known point that was not matched near it must not be matched elsewhere.
            unmatched &= ~tracks.has_point
        rows = np.flatnonzero(unmatched)
        disparity, unique = stereo.search(left, right, np.concatenate([tracks.left[rows], corners]))
        disparity_old, disparity_new = np.split(disparity, [len(rows)])
        known, unique = np.split(unique, [len(rows)])
        tracks = stereo.match_near(tracks, right, rows[known], disparity_old[known])
        return self._without_old_left_only(tracks), disparity_new, unique

    def _without_old_left_only(self, tracks: Tracks) -> Tracks:
        """Count frames without a right match, and drop the features that had none for too long."""
        tracks = replace(tracks, left_only_frames=np.where(tracks.has_right, 0, tracks.left_only_frames + 1))
        return take(tracks, tracks.left_only_frames <= self._settings.max_left_only_frames)

    def _select_corners(self, tracks: Tracks, unique: BoolArray, stays: BoolArray) -> tuple[IntArray, int]:
        """Return the rows of the corners (K,) to try, in this order, and how many of them have a depth.

        Corners with depth (`unique` in the coarse search) that will stay in the image come first. Corners that will
        soon leave it are tried only below the least number of matched features, corners without depth only below half
        of that number.
        """
        target, matched = self._grid.target_features, int(tracks.has_right.sum())
        room, least = max(0, target - len(tracks)), self._settings.least_features * target
        tried = round(_TRIED * room)
        staying, leaving = np.flatnonzero(unique & stays)[:tried], np.flatnonzero(unique & ~stays)[:tried]
        leaving = leaving[: max(0, round(_TRIED * (least - matched - len(staying) / _TRIED)))]
        no_depth = np.flatnonzero(~unique)[:room]
        if matched > _FEW * least and self._delay.frames == 0.0:
            no_depth = no_depth[:0]
        return np.concatenate([staying, leaving, no_depth]), len(staying) + len(leaving)

    def _stay_visible(
        self, corners: FloatArray, disparity: FloatArray, motion: Consensus | None, image: FloatImage
    ) -> BoolArray:
        """Mask (K,) of corners that stay in the image for a while if the camera motion continues."""
        if motion is None or self._settings.wanted_life_frames == 0:
            return np.ones(len(corners), dtype=np.bool_)
        T = np.linalg.matrix_power(motion.T_curr_prev, self._settings.wanted_life_frames)
        depth = self._camera.fu * self._camera.baseline_m / np.maximum(disparity, 0.1)
        moved = transform_points(T, left_rays(self._camera, corners) * depth[:, None])
        ahead = moved[:, 2] > 0.5
        pixels = project(self._camera, np.where(ahead[:, None], moved, [0.0, 0.0, 1.0]))[:, :2]
        return np.asarray(ahead & inside(image, pixels, 0.0))

    def _promote(self, tracks: Tracks) -> Tracks:
        """Output features that passed their probation from now on, under new ids; all features if these are few."""
        proven = tracks.has_right | (not self._right.usable)
        proven = tracks.shown | ((tracks.age >= self._settings.probation_frames) & proven)
        if proven.sum() < _VERY_FEW * self._grid.target_features:
            proven[:] = True
        ids, first = tracks.ids.copy(), proven & ~tracks.shown
        ids[first] = np.arange(int(first.sum())) + self._next_id
        self._next_id += int(first.sum())
        return replace(tracks, ids=ids, shown=proven)


def _prior_rows(tracks: Tracks, rows: IntArray, prior: TrackPrior) -> tuple[IntArray, FloatArray]:
    """Return those of the rows that were output and are in a prior, and the left pixels (K, 2) that it predicts."""
    shown = rows[tracks.shown[rows]]
    named, predicted = prior_pixels(tracks.ids[shown], prior)
    return shown[named], predicted


def _rows_by_slot(old: Tracks, now: Tracks) -> IntArray:
    """Rows (N,) in `old` of the features (N,) of `now`, all of which it contains: an active feature keeps its slot."""
    order = np.argsort(old.slot)
    return np.asarray(order[np.searchsorted(old.slot, now.slot, sorter=order)], dtype=np.int64)


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
