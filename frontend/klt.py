"""The default front end: corners tracked in time by Lucas-Kanade and matched from left to right
along the row.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

import cv2
import numpy as np

from vio.findings import Finding
from vio.frontend.anchor_fit import AnchorFit
from vio.frontend.columns import changed
from vio.frontend.detect import detect_corners, half_mask, load_mask
from vio.frontend.flow import track_with_retries
from vio.frontend.frames import FrameValidator, Stopwatch, make_output
from vio.frontend.moving_object import (
    ObjectReport,
    choose_motion,
    one_motion_explains,
    static_by_prediction,
    voters,
)
from vio.frontend.new_features import NewFeatures
from vio.frontend.one_camera import with_depths, with_prior_depths
from vio.frontend.outliers import (
    Consensus,
    MotionPriors,
    RansacProblem,
    epipolar_distance,
    predicted_motion,
    static_tracks,
)
from vio.frontend.patches import ImageLevels, half_image
from vio.frontend.prediction import guessed_pixels, prior_rows, usable_prior
from vio.frontend.reappearance import contradicts_gyro, motion_across
from vio.frontend.right_alone import RightAlone
from vio.frontend.right_camera import RightCamera
from vio.frontend.right_delay import RightDelay
from vio.frontend.right_match import FrameImages, RightMatcher
from vio.frontend.settings import FrontendSettings
from vio.frontend.stereo_fit import StereoFit
from vio.frontend.tracks import (
    ANCHOR_RADIUS_PX,
    INLIER_PX,
    AnchorBank,
    PreviousFrame,
    Tracks,
    no_tracks,
)
from vio.geometry.lie import FloatArray, se3_exp, se3_log
from vio.geometry.stereo import StereoCamera
from vio.protocols import Detector
from vio.records import (
    BoolArray,
    CheckedFrame,
    FrontendOutput,
    Image,
    StereoFrame,
    TrackPrior,
)


class _NewRules(NamedTuple):
    """When new corners are added and output."""

    # extra corners tried, over the number of missing features; the best stereo matches are kept
    spare_corners: float = 1.5
    # for which a new corner must be tracked, in time and stereo, before it is output
    probation_frames: int = 1
    # share of the features; detection takes more time than it is worth for fewer
    few_missing_share: float = 0.1
    very_few_share: float = 0.25  # share of the target below which new features are output at once
    bank_factor: int = 3  # templates allocated, over the number of features


_NEW = _NewRules()


class _LongGapRules(NamedTuple):
    """When tracks are not followed over a gap."""

    min_s: float = 0.8  # a rig that flies or is carried shows other things after it …
    min_steps: float = 5.0  # … where frames usually come so many times as often


_LONG_GAP = _LongGapRules()


class KltFrontend:
    """Track corners from frame to frame in the left image and match them into the right one.

    One instance processes one recording: ids increase and are never reused. The result is
    deterministic to the bit: it depends on the images, the priors and the settings only.
    """

    # by the motion of the left image, as it matches
    checks_matches = True

    def __init__(
        self,
        camera: StereoCamera,
        settings: FrontendSettings | None = None,
        detector: Detector | None = None,
    ) -> None:
        """Prepare; a `detector` finds the corners in place of the built-in one."""
        settings = FrontendSettings() if settings is None else settings
        self._detector = detector
        self._settings = settings.klt
        self._grid = settings.grid
        self._seed = settings.consensus.seed
        self._disparity = settings.disparity
        self._camera = camera
        self._clahe = cv2.createCLAHE(2.0, (8, 8)) if self._settings.equalise == "clahe" else None
        self._mask = None if self._settings.mask is None else load_mask(self._settings.mask)
        self._validator = FrameValidator(camera, "klt")
        self._right = RightCamera()
        self._delay = RightDelay(camera)
        self._objects = ObjectReport()
        self._bank = AnchorBank(_NEW.bank_factor * self._grid.target_features, ANCHOR_RADIUS_PX)
        self._anchor_fit = AnchorFit(camera, self._grid, self._bank)
        self._new_features = NewFeatures(camera, self._grid, self._bank)
        self._matcher = RightMatcher(camera, self._right, self._delay)
        self._previous: PreviousFrame | None = None
        self._alone: RightAlone | None = None  # while the left camera is frozen
        # made with the image size of the first frame
        self._setup: tuple[StereoFit, BoolArray | None] | None = None
        self._next_id = 0
        self._rested = False  # whether the last frame was one in which no corners were detected
        self._step_ns: int | None = None  # between the last two frames

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Track, match and detect in one rectified stereo pair, or in one camera; see
        `vio.protocols.Frontend`.

        Raises:
            ConfigError: the mask is not of the images' size.
        """
        watch = Stopwatch()
        kind = self._camera.kind
        images, allowed = self._images(frame)
        if images is None:
            return make_output(frame, no_tracks(), 0, watch, self._take_findings())
        stereo = images.stereo
        left = images.left
        right = images.right
        watch.lap("prepare")
        tracks, motion = self._track(images, usable_prior(prior), watch)
        wanted = self._wanted_corners(len(tracks))
        corners = self._corners(left, tracks.left, wanted, allowed)
        watch.lap("detect")
        # Without a second camera no corner is searched along the row; `delayed` takes them without
        # a depth.
        usable = right if self._right.usable else None
        delayed = right is None or self._delay.frames != 0.0
        tracks = self._new_features.add(
            left, usable, tracks, corners, motion, stereo, delayed=delayed
        )
        if usable is not None and not delayed:
            stereo.update_rows(tracks)
        if kind == "rgbd" and frame.depth is not None:
            tracks = with_depths(self._camera, tracks, frame.depth)
        watch.lap("stereo")
        tracked = int(tracks.shown.sum())  # those shown now that were shown before
        tracks = self._promote(tracks)
        self._store(images, tracks, motion)
        watch.lap("check")
        sigma = self._bank.sigma(tracks.slot, depth_image=kind == "rgbd")
        if self._matcher.shake.right_factor > 1.0:
            sigma[:, 2] *= self._matcher.shake.right_factor
        found = self._take_findings()
        return make_output(frame, tracks, tracked, watch, found, shown=tracks.shown, sigma=sigma)

    def _corners(
        self, left: ImageLevels, occupied: FloatArray, wanted: int, allowed: BoolArray | None
    ) -> FloatArray:
        """Return new corners (K, 2), best first, by the built-in detector or the caller's."""
        if self._detector is None:
            return detect_corners(left.half, occupied, wanted, self._grid, allowed)
        from vio.frontend.given_corners import given_corners

        return given_corners(self._detector, left.full, occupied, wanted, self._grid, allowed)

    def follow_right(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Follow the features of the last good pair in the right image of a frame whose left one
        is frozen; see `vio.guard.guarded.FollowsRight`.
        """
        watch = Stopwatch()
        images, _ = self._images(frame)
        alone = no_tracks()
        if images is not None:
            alone = self._follow_in_right(images, usable_prior(prior))
        return make_output(frame, alone, len(alone), watch, self._take_findings())

    @property
    def _needs_right(self) -> bool:
        """Whether a feature must be seen in the right image to be trusted."""
        return self._camera.kind == "stereo" and self._right.usable

    def _wanted_corners(self, active: int) -> int:
        """Number of corners to detect beside active features; none in every other frame while
        few are missing.
        """
        target = self._grid.target_features
        missing = target - active
        self._rested = not self._rested and missing <= _NEW.few_missing_share * target
        return 0 if self._rested else round(missing * (1.0 + _NEW.spare_corners))

    def _take_findings(self) -> tuple[Finding, ...]:
        """Return what was found since the last frame."""
        matcher = self._matcher
        parts = (self._right, self._delay, matcher.turn, matcher.shake, self._objects)
        return tuple(found for part in parts for found in part.take_findings())

    def _images(self, frame: StereoFrame) -> tuple[FrameImages | None, BoolArray | None]:
        """Return the images of a frame, and the mask (H/2, W/2) of allowed corners.

        None: the right image of its time was not kept.
        """
        if self._camera.kind != "stereo":
            (left,) = self._validator.validate_one(frame)
            stereo, allowed = self._set_up(left.shape)
            return FrameImages(frame, self._view(left, _half(frame, "left")), None, stereo), allowed
        left, right = self._validator.validate(frame)
        stereo, allowed = self._set_up(left.shape)
        lives = not isinstance(frame, CheckedFrame) or frame.right_usable
        self._right.by_image(frame.index, usable=lives)
        right_half = _half(frame, "right")
        if isinstance(frame, CheckedFrame) and frame.begin_again:
            self._delay.know(frame.right_delay)
            self._begin_again(stereo)
        paired = self._delay.paired(right)
        if paired is not right:
            right_half = None
        if paired is None:
            return None, allowed
        levels = self._view(paired, right_half)
        return FrameImages(frame, self._view(left, _half(frame, "left")), levels, stereo), allowed

    def _begin_again(self, stereo: StereoFit) -> None:
        """Forget all features: their depths are those of images of different times."""
        self._right.explained()
        stereo.restart_rows()
        if self._previous is not None:
            self._previous = replace(self._previous, tracks=no_tracks())

    def _view(self, image: Image, half: Image | None) -> ImageLevels:
        """Equalise and convert an image; the result may share memory with it.

        `half` is the image as given at half resolution, where that is known.
        """
        if self._clahe is not None:
            image = np.asarray(self._clahe.apply(image), dtype=np.uint8)
            half = None
        return ImageLevels(image, half_image(image) if half is None else half)

    def _set_up(self, shape: tuple[int, ...]) -> tuple[StereoFit, BoolArray | None]:
        """Return the stereo matcher and the mask (H/2, W/2) of allowed corners, set up with the
        first frame's shape.
        """
        if self._setup is None:
            height, width = shape
            allowed = None if self._mask is None else half_mask(self._mask, shape)
            stereo = StereoFit(self._camera, self._disparity, self._bank, (width, height))
            self._setup = stereo, allowed
        return self._setup

    def _follow_in_right(self, images: FrameImages, prior: TrackPrior | None) -> Tracks:
        """The features of the last good pair, by the right image of a frame whose left one is
        frozen.
        """
        frame = images.frame
        right = images.right
        if (
            self._previous is None
            or right is None
            or not self._right.usable
            or self._delay.frames != 0.0
        ):
            return no_tracks()
        last = self._alone or RightAlone.after(self._camera, self._previous)
        problem = RansacProblem(
            self._camera, INLIER_PX, np.random.default_rng((self._seed, frame.index))
        )
        alone = last.next(
            frame.time_ns, problem, self._bank, right, prior, self._settings.pyramid_levels
        )
        if alone is None:
            return no_tracks()
        self._alone = alone
        return alone.in_left(self._camera, images.stereo)

    def _store(self, images: FrameImages, tracks: Tracks, motion: Consensus | None) -> None:
        """Store the state that the next frame needs."""
        frame = images.frame
        left = images.left
        right = images.right
        self._bank.keep_only(tracks.slot)
        before = self._previous
        self._step_ns = None if before is None else frame.time_ns - before.time_ns
        twist = np.zeros(6) if before is None else before.twist_per_s
        if before is not None and motion is not None:
            twist = se3_log(motion.T_curr_prev) / ((frame.time_ns - before.time_ns) * 1e-9)
        left = ImageLevels(left.full.copy(), left.half)  # a reader may reuse its buffer
        right_half = None if right is None else right.half
        self._alone = None
        self._previous = PreviousFrame(
            frame.time_ns, left, right_half, tracks, twist, motion is not None
        )

    def _track(
        self, images: FrameImages, prior: TrackPrior | None, watch: Stopwatch
    ) -> tuple[Tracks, Consensus | None]:
        """Track the features of the previous frame; return those kept and the consensus motion.

        They are matched in the right image, if there is one.
        """
        frame = images.frame
        left = images.left
        right = images.right
        stereo = images.stereo
        stereo.forget_offset()
        previous = self._previous
        if previous is None or len(previous.tracks) == 0:
            if prior is None or prior.measured_motion is None:
                self._right.try_again(frame.index)
            return no_tracks(), None
        old = previous.tracks
        levels = self._settings.pyramid_levels
        expected = se3_exp(previous.twist_per_s * ((frame.time_ns - previous.time_ns) * 1e-9))
        # its motion is that since the last right image
        if prior is not None and self._alone is not None:
            prior = replace(prior, R_cam_prev=None, motion=None)
        if self._after_gap(frame):
            again = self._found_again(images, previous, expected, prior)
            if again is not None:
                expected = again
                prior = None
            elif prior is None:
                return no_tracks(), None
        guess = guessed_pixels(self._camera, old, prior, expected, left.full)
        trusted = prior is not None or previous.trusted
        found, seen = track_with_retries(previous.left.half, left, old.left, guess, trusted, levels)
        watch.lap("track")
        rng = np.random.default_rng((self._seed, frame.index))
        problem = RansacProblem(self._camera, INLIER_PX, rng)
        seen, motion = self._reject_outliers(problem, old, found, seen, prior, expected, images)
        watch.lap("reject")
        tracks = self._anchor_fit.track(old, previous.left, left, found, seen, motion)
        watch.lap("align")
        if right is None:
            tracks = with_prior_depths(self._camera, tracks, prior)
        else:
            tracks = self._matcher.match(images, right, previous, tracks, prior, motion)
        watch.lap("stereo")
        return tracks, motion

    def _found_again(
        self,
        images: FrameImages,
        previous: PreviousFrame,
        expected: FloatArray,
        prior: TrackPrior | None,
    ) -> FloatArray | None:
        """The motion (4, 4) since the last good pair by key points of both pairs; None: none is
        proved.

        A facade repeats itself at the same depth; a gyro that contradicts tells.
        """
        right = images.right
        if (
            right is None
            or previous.right_half is None
            or not self._right.usable
            or self._delay.frames != 0.0
        ):
            return None
        rng = np.random.default_rng((self._seed, images.frame.index))
        problem = RansacProblem(self._camera, 2 * INLIER_PX, rng)
        T = motion_across(
            problem, images.stereo, previous, images.left, right, np.stack([expected, np.eye(4)])
        )
        return None if T is None or (prior is not None and contradicts_gyro(T, prior.motion)) else T

    def _after_gap(self, frame: StereoFrame) -> bool:
        """Whether so many frames are missing that similar patches are no evidence of the same
        points.
        """
        if self._previous is None or self._step_ns is None:
            return False
        gap_ns = frame.time_ns - self._previous.time_ns
        return gap_ns > max(_LONG_GAP.min_s * 1e9, _LONG_GAP.min_steps * self._step_ns)

    def _reject_outliers(
        self,
        problem: RansacProblem,
        old: Tracks,
        found: FloatArray,
        seen: BoolArray,
        prior: TrackPrior | None,
        expected: FloatArray,
        images: FrameImages,
    ) -> tuple[BoolArray, Consensus | None]:
        """Return the mask (N,) of the found features that are static, and the consensus motion
        if there is one.
        """
        camera = self._camera
        stereo = images.stereo
        index = images.frame.index
        rows = seen.nonzero()[0]
        has_depth = (old.has_point & (old.has_right | (not self._needs_right)))[rows]
        deep = has_depth.nonzero()[0]
        point = old.point.take(rows, axis=0)
        deep_point = old.point.take(rows[deep], axis=0)
        priors = MotionPriors()
        if prior is not None:
            known, predicted = prior_rows(old, rows[deep], prior)
            priors = MotionPriors(
                prior.R_cam_prev, predicted_motion(camera, old.point[known], predicted, expected)
            )
        before = old.left.take(rows, axis=0)
        after = found.take(rows, axis=0)
        kept, motion = static_tracks(problem, before, point, has_depth, after, expected, priors)
        expected_motion = None if prior is None else prior.motion
        near_m = camera.fu * camera.baseline_m / stereo.max_disparity_px
        measured = None if prior is None else prior.measured_motion
        if motion is None and measured is not None:
            kept = static_by_prediction(problem, before, after, kept, measured, near_m)
        if motion is not None:
            after_deep = after.take(deep, axis=0)
            voting = voters(old.age[rows[deep]])
            error_px = stereo.disparity_error_px
            chosen = choose_motion(
                problem,
                deep_point,
                after_deep,
                motion,
                expected_motion,
                voting=voting,
                in_event=self._objects.active,
                disparity_error_px=error_px,
            )
            if stereo.rows_are_off and one_motion_explains(
                problem, chosen, deep_point, after_deep, error_px
            ):
                chosen = replace(chosen, object_share=0.0)
            if chosen.decision is None and expected_motion is not None and measured is None:
                chosen = self._objects.questioned(
                    chosen, camera, deep_point, expected_motion, voting, error_px
                )
            motion = chosen.motion
            kept[has_depth] = chosen.motion.inliers
            self._objects.frame(index, chosen)
            if self._objects.hides_scene(index, chosen) and measured is None:
                return np.zeros(len(old), dtype=np.bool_), None
        if motion is not None and not has_depth.all():
            distance = epipolar_distance(
                camera, motion.T_curr_prev, before[~has_depth], after[~has_depth], near_m
            )
            kept[~has_depth] = distance <= problem.limit_px
        keep = np.zeros(len(old), dtype=np.bool_)
        keep[rows[kept]] = True
        return keep, motion

    def _promote(self, tracks: Tracks) -> Tracks:
        """Output features that passed their probation from now on, under new ids; all features
        if these are few.
        """
        proven = tracks.has_right | (not self._needs_right)
        proven = tracks.shown | ((tracks.age >= _NEW.probation_frames) & proven)
        if proven.sum() < _NEW.very_few_share * self._grid.target_features:
            proven[:] = True
        ids = tracks.ids.copy()
        first = proven & ~tracks.shown
        ids[first] = np.arange(int(first.sum())) + self._next_id
        self._next_id += int(first.sum())
        return changed(tracks, ids=ids, shown=proven)


def _half(frame: StereoFrame, camera: Literal["left", "right"]) -> Image | None:
    """The image (H/2, W/2) of a camera at half resolution, where the guards have made it."""
    if not isinstance(frame, CheckedFrame):
        return None
    return frame.left_half if camera == "left" else frame.right_half
