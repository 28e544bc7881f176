"""Front ends that follow features from frame to frame in the left image, align them with anchors,
and match them from left to right along the row. They differ in how features are followed and found:
`vio.frontend.klt`, `vio.frontend.descriptors`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.frontend.anchor_fit import AnchorFit
from vio.frontend.columns import take
from vio.frontend.flow import Flow
from vio.frontend.frame_images import FrameImages, ImagePreparation
from vio.frontend.frames import Stopwatch, make_output, usable_prior
from vio.frontend.new_features import NewFeatures
from vio.frontend.outliers import Consensus, RansacProblem
from vio.frontend.prediction import guessed_pixels
from vio.frontend.reappearance import is_long_gap, motion_after_gap
from vio.frontend.right_alone import RightFollower
from vio.frontend.right_match import RightMatcher
from vio.frontend.settings import FrontendSettings
from vio.frontend.static_features import StaticFeatures
from vio.frontend.tracks import INLIER_PX, AnchorBank, PreviousFrame, Tracks, no_tracks
from vio.geometry.stereo import StereoCamera
from vio.protocols import Detector
from vio.records import CheckedFrame, FrontendOutput, SigmaArray, StereoFrame, TrackPrior


class TrackingFrontend:
    """Follow features from frame to frame in the left image and match them into the right one.

    One instance processes one recording: ids increase and are never reused. The result is
    deterministic to the bit: it depends on the images, the priors and the settings only.
    """

    # by the motion of the left image, as it matches
    checks_matches = True
    checks_objects = True

    def __init__(
        self,
        camera: StereoCamera,
        settings: FrontendSettings,
        name: str,
        bank: AnchorBank,
        flow: Flow,
        detector: Detector | None,
    ) -> None:
        """Prepare.

        Args:
            camera: rectified pair, or one camera.
            settings: of the front end.
            name: of the front end, in messages.
            bank: gets the features' anchors.
            flow: follows features.
            detector: finds new ones; None: the built-in one.
        """
        self._camera = camera
        self._seed = settings.consensus.seed
        self._bank = bank
        self._flow = flow
        self._matcher = RightMatcher(camera)
        self._right = self._matcher.images
        self._prepare = ImagePreparation(camera, settings, bank, self._right, name)
        self._static = StaticFeatures(self._right)
        self._anchor_fit = AnchorFit(camera, settings.grid, bank)
        self._new_features = NewFeatures(camera, settings.grid, bank, self._right, detector)
        # while the left camera is frozen
        self._alone = RightFollower(bank, settings.klt.pyramid_levels)
        self._previous: PreviousFrame | None = None
        self._step_ns: int | None = None  # between the last two frames

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Track, match and detect in one rectified stereo pair, or in one camera; see
        `vio.protocols.Frontend`.

        Raises:
            ConfigError: the mask is not of the images' size.
        """
        watch = Stopwatch()
        images = self._images(frame)
        if images is None:
            return self._output(frame, no_tracks(), 0, watch)
        watch.lap("prepare")
        if self._flow.see(images.left.full):
            watch.lap("extract")
        tracks, motion = self._track(images, usable_prior(prior), watch)
        corners = self._new_features.detect(images, tracks)
        watch.lap("detect")
        tracks = self._new_features.add(images, tracks, corners, motion)
        tracks = self._matcher.complete(images, tracks)
        watch.lap("stereo")
        tracked = int(tracks.shown.sum())  # those shown now that were shown before
        tracks = self._new_features.output(tracks)
        self._store(images, tracks, motion)
        watch.lap("check")
        sigma = self._matcher.sigma(tracks, self._bank)
        return self._output(frame, tracks, tracked, watch, sigma)

    def follow_right(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Follow the features of the last good pair in the right image of a frame whose left one
        is frozen; see `vio.guard.guarded.FollowsRight`.
        """
        watch = Stopwatch()
        images = self._images(frame)
        alone = no_tracks()
        if images is not None and self._previous is not None and self._right.of_present:
            problem = self._problem(frame.index, INLIER_PX)
            prior = usable_prior(prior)
            alone = self._alone.follow(images, self._previous, problem, prior)
        return self._output(frame, alone, len(alone), watch)

    def _images(self, frame: StereoFrame) -> FrameImages | None:
        """Return the images of a frame; None: the right image of its time was not kept."""
        images = self._prepare(frame)
        if isinstance(frame, CheckedFrame) and frame.begin_again and self._previous is not None:
            # their depths are those of images of different times
            self._previous = replace(self._previous, tracks=no_tracks())
        return images

    def _problem(self, index: int, limit_px: float) -> RansacProblem:
        """The consensus of a frame, with random numbers of its own."""
        return RansacProblem(self._camera, limit_px, np.random.default_rng((self._seed, index)))

    def _track(
        self, images: FrameImages, prior: TrackPrior | None, watch: Stopwatch
    ) -> tuple[Tracks, Consensus | None]:
        """Track the features of the previous frame; return those kept and the consensus motion.

        They are matched in the right image, if there is one.
        """
        frame = images.frame
        left = images.left
        images.stereo.forget_offset()
        previous = self._previous
        if previous is None or len(previous.tracks) == 0:
            self._matcher.try_again(frame.index, prior)
            return no_tracks(), None
        old = previous.tracks
        expected = previous.expected_motion(frame.time_ns)
        # its motion is that since the last right image
        if prior is not None and self._alone.active:
            prior = replace(prior, R_cam_prev=None, motion=None)
        if self._after_gap(frame, previous):
            again = None
            if self._right.of_present:
                problem = self._problem(frame.index, 2 * INLIER_PX)
                again = motion_after_gap(problem, images, previous, expected, prior)
            if again is not None:
                expected = again
                prior = None
            elif prior is None:
                return no_tracks(), None
        guess = guessed_pixels(self._camera, old, prior, expected, left.full)
        trusted = prior is not None or previous.trusted
        found, seen = self._flow.follow(previous, left, guess, trusted=trusted)
        watch.lap("track")
        problem = self._problem(frame.index, INLIER_PX)
        seen, motion, slow = self._static.select(problem, old, found, seen, prior, expected, images)
        if slow is not None:
            followed = ~slow
            old = take(old, followed)
            found = found[followed]
            seen = seen[followed]
        watch.lap("reject")
        step_s = (frame.time_ns - previous.time_ns) * 1e-9
        tracks = self._anchor_fit.track(old, previous.left, left, found, seen, motion, step_s)
        watch.lap("align")
        tracks = self._matcher.match(images, previous, tracks, prior, motion)
        watch.lap("stereo")
        return tracks, motion

    def _after_gap(self, frame: StereoFrame, previous: PreviousFrame) -> bool:
        """Whether too much time has passed since the previous frame to track its features."""
        if self._step_ns is None:
            return False
        return is_long_gap(frame.time_ns - previous.time_ns, self._step_ns)

    def _store(self, images: FrameImages, tracks: Tracks, motion: Consensus | None) -> None:
        """Store the state that the next frame needs."""
        time_ns = images.frame.time_ns
        right = images.right
        self._bank.keep_only(tracks.slot)
        self._flow.keep(tracks)
        before = self._previous
        if before is None:
            self._step_ns = None
        else:
            self._step_ns = time_ns - before.time_ns
        if before is None:
            twist = np.zeros(6)
        else:
            twist = before.twist_per_s
        if before is not None and motion is not None:
            twist = before.twist_until(time_ns, motion.T_curr_prev)
        right_half = None if right is None else right.half
        self._alone.end()
        self._previous = PreviousFrame(
            time_ns, images.left.kept(), right_half, tracks, twist, motion is not None
        )

    def _output(
        self,
        frame: StereoFrame,
        tracks: Tracks,
        tracked: int,
        watch: Stopwatch,
        sigma: SigmaArray | None = None,
    ) -> FrontendOutput:
        """Return the output of a frame, with what was found since the last one."""
        found = self._matcher.take_findings() + self._static.take_findings()
        return make_output(frame, tracks, tracked, watch, found, shown=tracks.shown, sigma=sigma)
