"""How late the right camera exposes against the left one, by the rows of matches, and stereo
matches at one time.

A right image that is late by `delay` frames shows a feature where it was then: its row differs from
the left one by `-delay` times the feature's motion along v in the last frame. The differences that
a wrong rectification makes are constant over time instead, so both are fitted together: six terms
over the image, and the delay.

Where the right camera is early by one frame, its last image belongs to the present left one, and
takes the place of the one that came with it: they were paired wrongly.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.findings import Finder, Finding
from vio.frontend.tracks import Tracks
from vio.frontend.weighted_fit import ROW_SIGMA_PX, add_equations
from vio.geometry.lie import FloatArray, se3_exp, se3_log, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, left_rays
from vio.numerics.compiled import solve_positive
from vio.numerics.robust import median, robust_sigma
from vio.records import Image


class _DelayRules(NamedTuple):
    """When the right camera exposes late."""

    memory: float = 0.97  # per frame, of the normal equations
    min_matches: int = 30  # in a frame that is learned from
    min_frames: int = 10  # before a delay is believed
    # frames; less does little harm, and small errors of the rows look like it
    min_delay_frames: float = 0.25
    # share of the rows' scatter about the constant field that the delay must explain
    explained_share: float = 0.5
    # standard deviations of the delay: errors of a feature's rows last for as long as the feature
    min_sigmas: float = 10.0
    # a delay this near to whole frames is one of whole frames: an image was paired with the wrong
    # one
    whole_slack_frames: float = 0.15
    forget_frames: float = 0.1  # delay below which the images are taken to be simultaneous again
    first_steps: int = 9  # between frames, whose median is the frame that a delay is counted in
    jitter_share: float = 0.25  # of it, by which the time between two frames differs as usual


_DELAY = _DelayRules()


class _OtherPairing(NamedTuple):
    """When right images belong to another frame."""

    min_share: float = 0.4  # least share of features that match in another pairing …
    clear_factor: float = 1.5  # … over those that match in this one
    frames: int = 2  # in a row


_OTHER = _OtherPairing()
_TERMS = 6
_PRIOR: FloatArray = 1e-6 * np.eye(_TERMS + 1)  # keeps the fit solvable


@dataclass(frozen=True, slots=True)
class PairingCounts:
    """How many features match in three pairings of left and right images."""

    points: int  # that were tried
    same: int  # left and right image of this frame
    late: int  # the left image before, and this right one
    early: int  # this left image, and the right one before


class RightDelay(Finder):
    """Estimates the right camera's delay from the matches of all frames."""

    def __init__(self, camera: StereoCamera, *, keeps_images: bool = True) -> None:
        """Begin; `keeps_images`: right images that are early are kept for their left ones."""
        super().__init__()
        self._camera = camera
        self._keeps_images = keeps_images
        self._normal: FloatArray = np.zeros((_TERMS + 1, _TERMS + 1))
        self._moment: FloatArray = np.zeros(_TERMS + 1)
        self._square = self._count = 0.0  # sums of squared rows and of weights
        self._frames = 0
        self._solution: FloatArray = np.zeros(_TERMS + 1)
        self._suspected = (0.0, 0)  # delay by the pairings, and in how many frames in a row
        self.frames = 0.0  # the delay in frames to be taken out; 0: none is significant
        self._code = "right-image-late"  # of the last finding
        self._early = False  # each right image is used with the next left one
        self._steps_s: list[float] = []  # the first times between frames
        # that came with the last frame, where it is used with this one
        self._last_right: Image | None = None

    @property
    def shown_frames(self) -> float:
        """The delay in frames of right images as they come, with that of images that are kept for
        their left ones.
        """
        return self.frames - 1.0 if self._early else self.frames

    @property
    def explained(self) -> float:
        """Share of the rows' scatter about the constant field that the delay explains."""
        return self._significance()[2]

    def paired(self, right: Image) -> Image | None:
        """Return the right image (H, W) of the present left image's time; None: it was not kept."""
        if not self._early:
            return right
        before = self._last_right
        self._last_right = right.copy()
        return before

    def know(self, frames: int) -> None:
        """Take a delay in whole frames that is known from elsewhere."""
        self._forget()
        self.frames = float(frames)

    def count(self, step_s: float) -> float:
        """Return how many frames a time between two is; more than one where frames are missing."""
        if len(self._steps_s) < _DELAY.first_steps:
            self._steps_s.append(step_s)
        frames = step_s / median(self._steps_s)
        return 1.0 if abs(frames - 1.0) <= _DELAY.jitter_share else frames

    def update(
        self, index: int, left: FloatArray, flow: FloatArray, rows: FloatArray, frame_s: float
    ) -> bool:
        """Learn from the matches of a frame; return whether a delay has just begun or ended.

        Args:
            index: frame number.
            left: left pixels (N, 2).
            flow: their motion (N, 2) in the time of a frame, pixels.
            rows: right rows minus left rows (N,), pixels, as measured.
            frame_s: that time.
        """
        if len(left) < _DELAY.min_matches:
            return False
        camera = self._camera
        x = (left[:, 0] - camera.cu) / camera.fu
        y = (left[:, 1] - camera.cv) / camera.fv
        terms = np.array([np.ones(len(x)), x, y, x * y, x * x, y * y, flow[:, 1]]).T.copy()
        self._normal = _DELAY.memory * self._normal
        self._moment = _DELAY.memory * self._moment
        # rows noisier than that, few of which would weigh, are alike in what a left pixel's error
        # adds to its row and to its flow, as a delay does
        sigma = np.inf
        if self._frames:
            sigma = max(ROW_SIGMA_PX, robust_sigma(rows - terms @ self._solution))
        count, square = add_equations(
            terms, rows, self._solution, sigma, self._normal, self._moment
        )
        self._square = _DELAY.memory * self._square + square
        self._count = _DELAY.memory * self._count + count
        self._frames += 1
        self._solution = self._moment.copy()
        solve_positive(self._normal + _PRIOR, self._solution)
        before = self.frames == 0.0, self._early
        self._decide(index, frame_s)
        return before != (self.frames == 0.0, self._early)

    def _decide(self, index: int, frame_s: float) -> None:
        """Take a delay out where it is significant, and report it once."""
        small = abs(self._solution[_TERMS]) <= _DELAY.min_delay_frames
        if self._frames < _DELAY.min_frames or (self.frames == 0.0 and small):
            return
        delay, sigma, explained = self._significance()
        if _DELAY.min_sigmas * sigma > _DELAY.min_delay_frames:
            return
        rounded = _rounded(delay)
        if self.frames != 0.0:
            if abs(delay) < _DELAY.forget_frames:
                self._end(index)
            elif rounded != 0.0:
                self.frames = rounded
        elif abs(delay) > _DELAY.min_delay_frames and explained > _DELAY.explained_share:
            self._begin(index, rounded, delay, frame_s)

    def suspect(self, index: int, counts: PairingCounts, frame_s: float) -> bool:
        """Test whether a right image that contradicts the left one belongs to the frame before, or
        to the next one.

        Args:
            index: frame number.
            counts: matches of the frame in the three pairings.
            frame_s: time since the last frame.

        Returns:
            Whether a delay has just begun: two frames in a row say the same.
        """
        best = max(counts.late, counts.early)
        clear = (
            best >= _OTHER.min_share * counts.points and best >= _OTHER.clear_factor * counts.same
        )
        clear &= counts.points >= _DELAY.min_matches and best >= _OTHER.clear_factor * min(
            counts.late, counts.early
        )
        delay = 1.0 if counts.late == best else -1.0
        self._suspected = (
            (delay, self._suspected[1] + 1 if self._suspected[0] == delay else 1)
            if clear
            else (0.0, 0)
        )
        if self._suspected[1] < _OTHER.frames or self.frames != 0.0:
            return False
        self._forget()
        self._begin(index, delay, delay, frame_s)
        return True

    def _forget(self) -> None:
        """Forget what was learned of the rows."""
        self._normal = np.zeros_like(self._normal)
        self._moment = np.zeros_like(self._moment)
        self._square = self._count = 0.0
        self._frames = 0
        self._solution = np.zeros(_TERMS + 1)
        self._suspected = (0.0, 0)

    def _begin(self, index: int, rounded: float, delay: float, frame_s: float) -> None:
        if self._keeps_images and rounded == (1.0 if self._early else -1.0):
            self._early = not self._early
            self._last_right = None
            self._forget()
            if not self._early:
                self._end(index)
                return
        else:
            self.frames = rounded
        late = "late" if delay > 0 else "early"
        message = (
            f"frame {index}: the right camera is {late} by {1e3 * abs(delay) * frame_s:.0f} ms "
            f"({abs(delay):.2f} frames) against the left one, by how its image moves; it is taken "
            "out of the matches; pair the images by their times of exposure, or synchronise the "
            "cameras"
        )
        self._code = f"right-image-{late}"
        figures = {"delay_frames": delay, "delay_ms": 1e3 * delay * frame_s}
        self._found.append(Finding(self._code, message, index, lasts=True, figures=figures))

    def _end(self, index: int) -> None:
        self.frames = 0.0
        message = f"frame {index}: the right camera is no longer late or early"
        self._found.append(Finding(self._code, message, index, ended=True))

    def _significance(self) -> tuple[float, float, float]:
        """The delay in frames, its standard deviation, and the share of the rows' scatter that
        it explains.
        """
        A = self._normal + _PRIOR
        b = self._moment
        constant = np.linalg.solve(
            A[:_TERMS, :_TERMS], np.column_stack([A[:_TERMS, _TERMS], b[:_TERMS]])
        )
        information = float(A[_TERMS, _TERMS] - A[_TERMS, :_TERMS] @ constant[:, 0])
        scatter = max(self._square - float(b[:_TERMS] @ constant[:, 1]), 1e-12)
        delay = -float(self._solution[_TERMS])
        explained = min(delay**2 * information / scatter, 1.0)
        variance = scatter * (1 - explained) / max(self._count, 1.0)
        return delay, float(np.sqrt(variance / max(information, 1e-12))), explained


def at_exposure(tracks: Tracks, flow: FloatArray, T_curr_prev: FloatArray, delay: float) -> Tracks:
    """Return tracks as they were when the right image was exposed, by their motion in the last
    frame.

    Args:
        tracks: now.
        flow: their motion (N, 2) since the last frame, pixels.
        T_curr_prev: motion (4, 4) of the camera since then.
        delay: of the right camera, frames.
    """
    left = tracks.left - delay * flow
    warp = tracks.warp.copy()
    warp[:, :, 2] -= delay * flow
    T_then_curr = se3_exp(-delay * se3_log(T_curr_prev))
    return replace(tracks, left=left, warp=warp, point=transform_points(T_then_curr, tracks.point))


def at_present(
    camera: StereoCamera, tracks: Tracks, then: Tracks, T_curr_prev: FloatArray, delay: float
) -> Tracks:
    """Return tracks with the right pixels that they would have now, given their matches when the
    image was exposed.

    Args:
        camera: rectified pair.
        tracks: now, without matches.
        then: `at_exposure`, matched.
        T_curr_prev: motion (4, 4) of the camera in the last frame.
        delay: of the right camera, frames.
    """
    moved = transform_points(se3_exp(delay * se3_log(T_curr_prev)), then.point)
    depth = depth_of(camera, moved)
    ahead = depth > 1e-2
    depth = np.where(ahead, depth, 1.0)
    right = tracks.left + np.stack(
        [-camera.fu * camera.baseline_m / depth, then.right[:, 1] - then.left[:, 1]], axis=1
    )
    matched = then.has_right & then.has_point & ahead
    return replace(
        tracks,
        right=np.where(matched[:, None], right, tracks.right),
        has_right=matched,
        skew=then.skew,
        point=np.where(
            matched[:, None], left_rays(camera, tracks.left) * depth[:, None], tracks.point
        ),
        has_point=tracks.has_point | matched,
    )


def _rounded(delay: float) -> float:
    """Return a delay in frames, a whole number where it is close to one."""
    whole = float(np.rint(delay))
    if abs(delay - whole) < _DELAY.whole_slack_frames:
        return whole
    return delay
