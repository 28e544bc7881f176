"""Matches of the tracked features in the right image, as far as that can be used: it may be
late, or another one.
"""

from __future__ import annotations

import numpy as np

from vio.findings import Finding
from vio.frontend.frame_images import FrameImages
from vio.frontend.one_camera import with_depths, with_prior_depths
from vio.frontend.outliers import Consensus
from vio.frontend.patches import ImageLevels
from vio.frontend.right_delay import PairingCounts, at_exposure, at_present
from vio.frontend.right_images import RightImages
from vio.frontend.right_turn import PairShake, RightTurn
from vio.frontend.stereo_fit import StereoFit
from vio.frontend.stereo_match import ROW_SEARCH, mirrored, shifted_rows
from vio.frontend.tracks import AnchorBank, PreviousFrame, Tracks, no_tracks
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics.robust import median
from vio.records import BoolArray, Image, IntArray, SigmaArray, TrackPrior

_NEARLY_ALL = 0.9  # of the matches without an offset, that one with it may have
# tried row differences, pixels at half resolution
_ROW_OFFSETS = range(-ROW_SEARCH.max_rows_half, ROW_SEARCH.max_rows_half + 1)
_PAIRING_POINTS = 150  # features that are tried with images of other frames


class RightMatcher:
    """Match features of known depth in the right image, and judge by the matches whether it may
    be used.
    """

    def __init__(self, camera: StereoCamera) -> None:
        """Prepare; what is known of the right images is updated with each frame."""
        self._camera = camera
        self.images = RightImages(camera)
        self._right = self.images.camera
        self._delay = self.images.delay
        self._turn = RightTurn(camera.fu)
        self._shake = PairShake(camera.fu)
        # by which the rows of the first contradicting frame match best, pixels at half resolution
        self._rows_off: int | None = None

    def take_findings(self) -> tuple[Finding, ...]:
        """Return what was found since the last call."""
        parts = (self.images, self._turn, self._shake)
        return tuple(found for part in parts for found in part.take_findings())

    def sigma(self, tracks: Tracks, bank: AnchorBank) -> SigmaArray:
        """Standard deviations (N, 3) of features as in `Observations`, which cover what shakes the
        right camera.
        """
        sigma = bank.sigma(tracks.slot, depth_image=self._camera.kind == "rgbd")
        if self._shake.right_factor > 1.0:
            sigma[:, 2] *= self._shake.right_factor
        return sigma

    def try_again(self, index: int, prior: TrackPrior | None) -> None:
        """Take the right image anew where nothing is tracked, as it was not at fault perhaps."""
        if prior is None or prior.measured_motion is None:
            self._right.try_again(index)

    def match(
        self,
        images: FrameImages,
        previous: PreviousFrame,
        tracks: Tracks,
        prior: TrackPrior | None,
        motion: Consensus | None,
    ) -> Tracks:
        """Match features of known depth in the right image; no match where the right image cannot
        be used.

        While it cannot, or there is none, depths come from the prior, where it has them.
        """
        frame = images.frame
        left = images.left
        right = images.right
        stereo = images.stereo
        if right is None:
            return with_prior_depths(self._camera, tracks, prior)
        if not self._right.usable:
            tracks = with_prior_depths(self._camera, tracks, prior)
        testable = stereo.testable(tracks)
        step_s = (frame.time_ns - previous.time_ns) * 1e-9
        frames = self._delay.count(step_s)
        frame_s = step_s / frames
        delay = self._delay.frames / frames  # in the time since the last frame
        flow = tracks.left - previous.tracks.left[_rows_by_slot(previous.tracks, tracks)]
        # Wrong matches, of rows far apart, contradict the right image that the search for the rows
        # will need.
        tested = motion is not None and not stereo.has_few_matches
        if delay == 0.0:
            matched = stereo.track_right(tracks, right, motion is not None)
            flow_px = median(flow[:, 0]) / frames if len(flow) else 0.0
            matched = self._take_turn(
                images, right, tracks, matched, testable, tested=tested, flow_px=flow_px
            )
        else:
            self._shake.explained(frame.index)
            T = _motion_between(prior, motion)
            matched = self._match_delayed(images, previous, tracks, right, flow, T, delay)
        if not self._right.check_matches(frame.index, matched.has_right[testable], moved=tested):
            if self._right.contradicts and self._delay.suspect(
                frame.index, self._count_pairings(previous, left, tracks, right, stereo), frame_s
            ):
                self._right.explained()
                return self._begin_again(frame.index, stereo)
            return tracks
        self._rows_off = None
        seen = matched.has_right
        disparity_v = matched.right[seen, 1] - matched.left[seen, 1]
        rows = disparity_v - delay * flow[seen, 1]
        in_frame = flow[seen] / frames
        if self._delay.update(frame.index, matched.left[seen], in_frame, rows, frame_s):
            return self._begin_again(frame.index, stereo)
        return matched

    def _begin_again(self, index: int, stereo: StereoFit) -> Tracks:
        """Return no features, as their depths are those of images of different times; a turn that
        was the delay is no more taken out.
        """
        stereo.restart_rows()
        if self._turn.explained(index, self._delay.shown_frames):
            stereo.take_out(0.0)
            stereo.forget_offset()
        return no_tracks()

    def complete(self, images: FrameImages, tracks: Tracks) -> Tracks:
        """Return all features of a frame with the virtual matches that a depth image gives; learn
        from true ones the rows in which right images show features.
        """
        if images.right is not None and self.images.of_present:
            images.stereo.update_rows(tracks)
        depth = images.frame.depth
        if self._camera.kind == "rgbd" and depth is not None:
            return with_depths(self._camera, tracks, depth)
        return tracks

    def _take_turn(
        self,
        images: FrameImages,
        right: ImageLevels,
        tracks: Tracks,
        matched: Tracks,
        testable: BoolArray,
        *,
        tested: bool,
        flow_px: float = 0.0,
    ) -> Tracks:
        """Return the matches of a frame, of a right image whose rows are off where more are found
        so; then the right camera has turned, or shakes.
        """
        index = images.frame.index
        stereo = images.stereo
        few = self._right.doubts(matched.has_right[testable])
        common_px = stereo.common_px
        self._shake.frame(index, common_px, int(matched.has_right.sum()))
        # one that stays may be too small to lose matches by
        if tested and (few or self._turn.may_stay or self._turn.is_jump(common_px)):
            off = stereo.track_off_right(
                tracks, images.left, right, by_motion=not self._right.usable
            )
            least = matched.has_right.sum() * (1.0 if few else _NEARLY_ALL)
            if off.has_right.sum() > least and self._turn.is_offset(stereo.offset_px):
                matched = off
            else:
                stereo.forget_offset()
        turn_px = self._turn.frame(index, stereo.offset_px, flow_px)
        if turn_px is not None:
            stereo.take_out(turn_px)
        return matched

    def _count_pairings(
        self,
        previous: PreviousFrame,
        left: ImageLevels,
        tracks: Tracks,
        right: ImageLevels,
        stereo: StereoFit,
    ) -> PairingCounts:
        """Count the features that match if the right image belongs to this frame, the one
        before, or the next one.

        A camera that has turned shows all rows off by the same from then on: what the rows of the
        first such frame were off by counts for the next ones as well. Its disparities may be
        negative, so that those of another pairing, moved by the rig's motion, match instead.
        """
        assert previous.right_half is not None
        before = previous.tracks.left[_rows_by_slot(previous.tracks, tracks)][:_PAIRING_POINTS]
        now = tracks.left[:_PAIRING_POINTS]
        first = self._rows_off is None
        offsets = _ROW_OFFSETS if self._rows_off is None else {0, self._rows_off}
        same = {
            rows: _count_either_sign(stereo, left.half, shifted_rows(right.half, rows), now)
            for rows in offsets
        }
        if first:
            self._rows_off = max(offsets, key=lambda rows: same[rows])
        return PairingCounts(
            points=len(now),
            same=same[0] if first else max(same.values()),
            late=stereo.count_on_rows(previous.left.half, right.half, before),
            early=stereo.count_on_rows(left.half, previous.right_half, now),
        )

    def _match_delayed(
        self,
        images: FrameImages,
        previous: PreviousFrame,
        tracks: Tracks,
        right: ImageLevels,
        flow: FloatArray,
        T: FloatArray,
        delay: float,
    ) -> Tracks:
        """Match features in a right image of another time, and bring the matches to the present.

        Features without depth are searched in the two images that were exposed nearest to one
        another.

        Args:
            images: of this frame.
            previous: the last frame.
            tracks: features at their new left pixels.
            right: the right image.
            flow: motion (N, 2) of the features since the last frame, pixels.
            T: motion (4, 4) of the camera, `T_curr_prev`.
            delay: of the right image, in the time since the last frame.
        """
        stereo = images.stereo
        then = stereo.track_right(at_exposure(tracks, flow, T, delay), right, True)
        rows = (~then.has_right & ~then.has_point).nonzero()[0]
        left_half = images.left.half
        right_half = right.half
        points = tracks.left
        if delay > 0.5:
            left_half = previous.left.half
            points = tracks.left - flow
        elif delay < -0.5 and previous.right_half is not None:
            right_half = previous.right_half
        disparity, unique = stereo.search(left_half, right_half, points[rows])
        then = stereo.match_near(then, right, rows[unique], disparity[unique])
        stereo.update_rows(then)
        return at_present(self._camera, tracks, then, T, delay)


def _count_either_sign(
    stereo: StereoFit, left_half: Image, right_half: Image, points: FloatArray
) -> int:
    """Count the left pixels (N, 2) that match on their row, with the sign of disparities that more
    have.
    """
    positive = stereo.count_on_rows(left_half, right_half, points)
    return max(positive, stereo.count_on_rows(*mirrored(left_half, right_half, points)))


def _rows_by_slot(old: Tracks, now: Tracks) -> IntArray:
    """Rows (N,) in `old` of the features (N,) of `now`, all of which it contains: an active
    feature keeps its slot.
    """
    rows = np.empty(old.slot.max(initial=-1) + 1, dtype=np.int64)
    rows[old.slot] = np.arange(len(old))
    return rows[now.slot]


def _motion_between(prior: TrackPrior | None, motion: Consensus | None) -> FloatArray:
    """Return the motion (4, 4) by the images, else as predicted, else none."""
    if motion is not None:
        return motion.T_curr_prev
    if prior is None or prior.motion is None:
        return np.eye(4)
    return prior.motion.T_curr_prev
