"""Find images and depth images that show no motion although the rig moves: a camera or driver gives
them again.

Equal to the last bit is the same exposure, as noise differs from one to the next, unless images
without noise, of a simulator, show a rig at standstill: what moved up to the frame before has not
stopped at once. A ring of buffers that is read at the wrong place gives an earlier exposure than
the last one again. By images alone, a rig that crept and did not slow down may have: the first such
frames are left out, and nothing is said of them. Nearly equal
pairs (encoded again, or with noise on top) are the same where the tracked corners have not moved,
while the motion predicted since the last frame moves them by more than its uncertainty allows and
the IMU is not at standstill, or while single frames have shown no motion again and again, each with
twice the motion of its neighbours after it. A rig at
standstill gives nearly equal images, too; there the prediction agrees, and they are used.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray, lengths, se3_log
from vio.guard.exposure import EarlierExposures, exposure_digest
from vio.imu.standstill import STANDSTILL_S, blocks_agree
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Capacity
from vio.numerics.robust import median
from vio.numerics.statistics import chi_square_quantile, squared_distance
from vio.records import (
    S_PER_NS,
    BoolArray,
    Image,
    ImuSample,
    IntArray,
    MotionPrior,
    Observations,
    Prediction,
    StereoFrame,
    TrackPrior,
    shared_rows,
)

_RADIUS = 4  # of the patches whose flow is measured, pixels


class _FlowRules(NamedTuple):
    """When images show no motion although the rig moves."""

    corners: int = 60  # measured per image
    min_corners: int = 15
    min_predicted_px: float = 1.0  # a corner that is predicted to move less is no evidence …
    # … nor one that moves by less than so many times what predictions were off by …
    prediction_errors: float = 3.0
    recent_frames: int = 20  # … at most in so many frames
    min_recent_frames: int = 5
    # flow between the two frames before (median), beyond which no rig stands still at once
    moved_px: float = 0.3
    # the same of a rig that creeps, and does not slow down to less at the present frame …
    crept_px: float = 0.05
    max_crept: int = 2  # … of whose equal frames in a row so many are left out
    unmoved_px: float = 0.15  # the flow of an unmoved corner under noise of a few gray levels
    unmoved_share: float = 0.8  # of the corners that must be unmoved
    first_rows: Capacity[int] = 8  # compared before all others
    ring_stride_px: Capacity[int] = 32  # of the rows that tell earlier frames
    # The newest, at most and at least, of which so many have not moved, each between two that have …
    twice_frames: int = 12
    min_twice_frames: int = 8
    min_paused: int = 3
    # … and of which so large a share is followed by a motion on the same way so many times that of
    # the frames beside it, as the motion goes on unseen meanwhile. Repetitions come to 2; a rig that
    # stops for a frame comes to 1, one that turns back to -1.
    jump: float = 1.6
    jumping_share: float = 0.6


_FLOW = _FlowRules()


class _BegunRules(NamedTuple):
    """When a motion has begun during images that were taken for a standstill."""

    # Equal images that were taken for a standstill are ended by a motion that begins. One that is
    # there at once, beyond so many pixels and times the flow before, or loses so many features, has
    # gone on unseen.
    min_px: float = 3.0
    factor: float = 10.0
    lost_share: float = 0.2


_BEGUN = _BegunRules()
# of the predicted motion for no motion to be possible
_LIMIT = float(chi_square_quantile(0.9999, 6))
_MAX_LINES = 3  # rows of repetitions that are reported one by one


class _StillNoise(NamedTuple):
    """Noise of an IMU at rest by its data sheet."""

    # rad/s/sqrt(Hz) and m/s^2/sqrt(Hz), of a rig's IMU by its data sheet
    gyro_density: float = 2e-4
    accel_density: float = 1.2e-2


_STILL = _StillNoise()


@dataclass(frozen=True, slots=True)
class _Flow:
    """Motion of the features since the frame before."""

    frame: int  # its number
    px: float | None  # median; 0: the frame repeats the one before, None: they share too few
    # Along the last motion before, over that one (median of the features); None: not known.
    advance: float | None


@dataclass(frozen=True, slots=True)
class Repeated:
    """A pair that shows the exposure of an earlier frame."""

    of_index: int  # that frame's number
    exact: bool  # equal to the last bit
    certain: bool = True  # False: a rig that crept and has stopped at once looks the same
    since: int | None = None  # first frame of others like it, that were used; None: there are none
    older: bool = False  # others were shown since that frame


@dataclass(frozen=True, slots=True)
class _Motion:
    """Motion in the left image of the features that two sets share."""

    ids: IntArray  # (N,)
    px: FloatArray  # (N, 2)
    rows: IntArray  # (N,) of the first set


class FrozenImages:
    """Compares each pair with the last one that showed something new."""

    def __init__(self) -> None:
        self._imu: list[ImuSample] = []  # the last half second
        self._shown: StereoFrame | None = None  # the last frame that is no repetition
        self._earlier = EarlierExposures()  # of the last frames that are none, by some rows
        self._seen: Observations | None = None  # its features
        # median flow of them, and of those of the frame before; None: too few were seen twice
        self._flow_px: float | None = None
        self._flow_before_px: float | None = None
        self._crept = 0  # equal frames in a row that were left out as the rig crept
        self._still: tuple[int, float] | None = None  # first frame of equal ones, flow before it
        self._ended_still: tuple[int, float] | None = None  # with the present frame
        self._held_since: int | None = None
        self._repeating: Repeated | None = None  # of the frame before
        # the last frame with a depth image that is no repetition
        self._deep: StereoFrame | None = None
        self._same_depth = False  # that of the frame before was one
        self._expected: Prediction | None = None  # of the present frame
        self._flows = deque[_Flow](maxlen=_FLOW.twice_frames)
        self._last_motion: _Motion | None = None  # in the last frame in which features moved
        # median error of each frame's predicted pixels
        self._errors_px: deque[float] = deque(maxlen=_FLOW.recent_frames)

    def samples(self, samples: Sequence[ImuSample]) -> None:
        """Take samples of the IMU."""
        self._imu += samples
        old = 0
        for sample in self._imu:
            if (self._imu[-1].time_ns - sample.time_ns) * S_PER_NS <= STANDSTILL_S:
                break
            old += 1
        del self._imu[:old]

    def observations(self, seen: Observations) -> None:
        """Take the features of a frame that `check` let pass."""
        if self._expected is not None:
            off = _motion(seen, self._expected.tracks)
            if len(off.ids):
                self._errors_px.append(median(lengths(off.px)))
        before = self._seen
        self._seen = seen
        advance = None
        if before is not None:
            motion = _motion(before, seen)
            flow_px = median(lengths(motion.px)) if len(motion.ids) >= _FLOW.min_corners else None
            self._flow_before_px = self._flow_px
            self._flow_px = flow_px
            if flow_px is not None and flow_px >= _FLOW.unmoved_px:
                advance = self._advance(motion)
            if self._ended_still is not None and len(before):
                since, before_px = self._ended_still
                begun = (flow_px or 0.0) > max(_BEGUN.min_px, _BEGUN.factor * before_px)
                if begun or len(motion.ids) < _BEGUN.lost_share * len(before):
                    self._held_since = since
        self._flows.append(_Flow(seen.frame_index, self._flow_px, advance))
        self._ended_still = None

    def check(self, frame: StereoFrame, expected: Prediction | None) -> Repeated | None:
        """Return which frame a pair repeats; None: it shows something new, or a rig at standstill.

        Frames come in time order, with or without images, each with the back end's prediction,
        whose motion is that since the last frame with features.
        """
        rows = _digest(frame)
        self._repeating = self._compare(frame, expected) or self._older(rows, expected)
        self._expected = expected
        if self._repeating is None:
            self._shown = frame
            self._earlier.add(frame.index, rows)
        else:
            self._flows.append(_Flow(frame.index, 0.0, None))
        return self._repeating

    def _advance(self, motion: _Motion) -> float | None:
        """A motion of the features along their last one, over that one; None: the two share too
        few.
        """
        last = self._last_motion
        self._last_motion = motion
        if last is None:
            return None
        a, b = shared_rows(last.ids, motion.ids)
        squared = (last.px[a] ** 2).sum(axis=1)
        along = (motion.px[b] * last.px[a]).sum(axis=1)[squared > 0.0]
        if len(along) < _FLOW.min_corners:
            return None
        return median(along / squared[squared > 0.0])

    @property
    def flow_px(self) -> float | None:
        """Median flow of the features of the present frame; None: the last two share too few."""
        return self._flows[-1].px if self._flows else None

    def take_held(self) -> int | None:
        """Return the first of the equal frames that were taken for a rig at standstill, and were
        not, as the present frame shows; None: there are none.
        """
        since = self._held_since
        self._held_since = None
        return since

    def check_depth(self, frame: StereoFrame) -> Repeated | None:
        """Return which frame's depth image a frame repeats; None: it is new, or the rig is at
        standstill.

        Call it after `check`, with frames whose images are new.
        """
        before = self._deep
        depth = frame.depth
        if depth is None:
            return None
        if before is None or before.depth is None or not _same_depths(depth, before.depth):
            self._deep = frame
            self._same_depth = False
            return None
        self._same_depth = self._same_depth or self._moves(self._expected)
        return Repeated(before.index, True) if self._same_depth else None

    def _compare(self, frame: StereoFrame, expected: Prediction | None) -> Repeated | None:
        shown = self._shown
        if shown is None or frame.left is None:
            return None
        images = _images(frame)
        before = _images(shown)
        if [image.shape for image in images] != [image.shape for image in before]:
            return None  # the front end refuses it
        if all(_equal(new, old) for new, old in zip(images, before, strict=True)):
            return self._judge_equal(frame, shown, expected)
        return self._judge_changed(frame, shown, expected)

    def _older(self, rows: bytes, expected: Prediction | None) -> Repeated | None:
        """Return which frame before the last one shows the same rows, while the rig moves."""
        index = self._earlier.find(rows)
        if index is None or not self._moves(expected):
            return None
        return Repeated(index, True, older=True)

    def _judge_equal(
        self, frame: StereoFrame, shown: StereoFrame, expected: Prediction | None
    ) -> Repeated | None:
        """Judge a frame of the same images as the last one, as a rig at standstill shows them."""
        # what was given again once is, until it changes
        if (self._repeating is not None and self._repeating.certain) or self._moves(expected):
            return Repeated(shown.index, True)
        if self._crept < _FLOW.max_crept and self._creeps():
            self._crept += 1
            return Repeated(shown.index, True, certain=False)
        self._still = self._still or (frame.index, self._flow_px or 0.0)
        return None

    def _judge_changed(
        self, frame: StereoFrame, shown: StereoFrame, expected: Prediction | None
    ) -> Repeated | None:
        """Judge a frame whose images differ from the last ones: perhaps by their noise alone."""
        self._ended_still = self._still
        self._still = None
        self._crept = 0
        if self._seen is None or expected is None:
            return None
        if self._repeating is not None and self._repeating.certain:
            frozen = _unmoved(shown, frame, self._seen.z, self._seen.has_right)
            return Repeated(shown.index, False) if frozen else None
        since = self._paused_since()
        if since is not None:
            unmoved = _unmoved(shown, frame, self._seen.z, self._seen.has_right)
            frozen = unmoved and not self._at_standstill()
        else:
            frozen = self._has_stopped(frame, shown, self._seen, expected)
        return Repeated(shown.index, False, since=since) if frozen else None

    def _paused_since(self) -> int | None:
        """The first of single frames that have not moved, among others that have, as the last one has,
        with a jump after most of them; None: there are few, or frames that may be either.
        """
        flows = list(self._flows)
        if len(flows) < _FLOW.min_twice_frames or flows[-1].px is None or _pauses(flows[-1]):
            return None
        paused = [k for k, flow in enumerate(flows) if _pauses(flow)]
        unclear = any(
            flow.px is not None and _FLOW.unmoved_px <= flow.px <= _FLOW.moved_px for flow in flows
        )
        if unclear or any(after - k == 1 for k, after in pairwise(paused)):
            return None
        jumps = sum(_jumps_after(flows, k) for k in paused)
        if jumps < max(_FLOW.min_paused, _FLOW.jumping_share * len(paused)):
            return None
        return flows[paused[0]].frame

    def _has_stopped(
        self, frame: StereoFrame, shown: StereoFrame, seen: Observations, expected: Prediction
    ) -> bool:
        """Whether features that the prediction moves stay where they were, while the rig moves."""
        if len(self._errors_px) < _FLOW.min_recent_frames or not self._contradicts(expected.motion):
            return False
        predicted_px = max(_FLOW.min_predicted_px, _FLOW.prediction_errors * max(self._errors_px))
        moving = _motion(seen, expected.tracks)
        rows = moving.rows[lengths(moving.px) > predicted_px]
        # The IMU comes last, as nearly every new frame has moved.
        unmoved = _unmoved(shown, frame, seen.z[rows], seen.has_right[rows])
        return unmoved and not self._at_standstill()

    def _moves(self, expected: Prediction | None) -> bool:
        """Whether the rig moves: by the last frames' features, the IMU's samples, else by the
        prediction.
        """
        if (self._flow_px or 0.0) > _FLOW.moved_px:
            return True
        if self._imu:
            return not self._at_standstill()
        return expected is not None and self._contradicts(expected.motion)

    def _creeps(self) -> bool:
        """Whether the rig moves slowly, and would move on as its features' flow has changed; with
        an IMU, that decides.
        """
        now_px = self._flow_px
        before_px = self._flow_before_px
        if self._imu or now_px is None or before_px is None:
            return False
        return min(now_px, 2.0 * now_px - before_px) > _FLOW.crept_px

    def _at_standstill(self) -> bool:
        """Whether the IMU's last half second shows noise alone; steady motion looks the same,
        but no rig is steady.
        """
        if not self._imu:
            return False
        times_s = np.array([x.time_ns - self._imu[-1].time_ns for x in self._imu]) * S_PER_NS
        gyro = np.array([x.gyro for x in self._imu])
        accel = np.array([x.accel for x in self._imu])
        return blocks_agree(times_s, gyro, _STILL.gyro_density) and blocks_agree(
            times_s, accel, _STILL.accel_density
        )

    def _contradicts(self, motion: MotionPrior | None) -> bool:
        """Whether no motion at all contradicts the predicted one, by chi-square."""
        if motion is None:
            return False
        xi = se3_log(motion.T_curr_prev)
        C = motion.covariance
        return squared_distance(xi, C, 1e-9 * (float(C.trace()) + 1e-18)) > _LIMIT


def _equal(a: Image, b: Image) -> bool:
    """Whether two images (H, W) are the same to the bit; most differ in their first rows, and
    need no more.
    """
    return np.array_equal(a[: _FLOW.first_rows], b[: _FLOW.first_rows]) and np.array_equal(a, b)


def _digest(frame: StereoFrame) -> bytes:
    """What tells some rows of a frame's images from those of other exposures and sizes; empty where
    these rows have one gray value each.
    """
    images = _images(frame)
    digest = exposure_digest([image[:: _FLOW.ring_stride_px] for image in images])
    return digest and str([image.shape for image in images]).encode() + digest


def _motion(before: Observations, now: Observations | TrackPrior) -> _Motion:
    """How the features that two sets share have moved in the left image."""
    a, b = shared_rows(before.ids, now.ids)
    return _Motion(now.ids[b], now.z[b, :2] - before.z[a, :2], a)


def _pauses(flow: _Flow) -> bool:
    """Whether features have not moved in a frame."""
    return flow.px is not None and flow.px < _FLOW.unmoved_px


def _jumps_after(flows: Sequence[_Flow], paused: int) -> bool:
    """Whether the frame after a pause moves more than those beside it on the same way; where each
    of them comes after a pause as well, as much.
    """
    after = flows[paused + 1].advance
    before_px = flows[paused - 2].px if paused >= 2 else None
    is_plain_before = before_px is not None and before_px >= _FLOW.unmoved_px
    if after is None or after < (_FLOW.jump if is_plain_before else 1.0 / _FLOW.jump):
        return False
    if paused + 2 >= len(flows) or _pauses(flows[paused + 2]):
        return True
    next_one = flows[paused + 2].advance
    return next_one is not None and 0.0 < next_one < 1.0 / _FLOW.jump


def _same_depths(a: FloatArray, b: FloatArray) -> bool:
    """Whether two depth images (H, W) are the same to the bit; without any depth they are of a
    scene out of range.
    """
    return a.shape == b.shape and np.array_equal(a, b, equal_nan=True) and bool(np.any(a > 0))


def _images(frame: StereoFrame) -> list[Image]:
    """The images of a frame: left and right, or that of one camera."""
    return [image for image in (frame.left, frame.right) if image is not None]


def _unmoved(before: StereoFrame, now: StereoFrame, z: FloatArray, has_right: BoolArray) -> bool:
    """Whether features have not moved since they were seen at pixels (N, 4), in both images."""
    of_images = z[: _FLOW.corners, :2], z[has_right][: _FLOW.corners, 2:]
    for old, new, pixels in zip(_images(before), _images(now), of_images, strict=False):
        flow = corner_flow(old, new, pixels)
        if (
            len(flow) < _FLOW.min_corners
            or (lengths(flow) < _FLOW.unmoved_px).mean() < _FLOW.unmoved_share
        ):
            return False
    return True


@dataclass(frozen=True, slots=True)
class RepeatWords:
    """How a report names what was given again."""

    what: str
    exact: str
    exact_of_one: str  # of one camera
    cause: str
    effect: str
    summary: str


IMAGES = RepeatWords(
    "images",
    "both images are the same to the last bit",
    "the image is the same to the last bit",
    "the camera or its driver gave them again",
    "the pose is a prediction",
    "repeated earlier images and were left out",
)
DEPTHS = RepeatWords(
    "depth images",
    "the depth image is the same to the last bit",
    "the depth image is the same to the last bit",
    "the depth camera or its driver gave it again",
    "its features have no depth",
    "repeated earlier depth images, which were left out",
)


class RepeatReport:
    """Reports what was given again: the first time, long rows of it, and its number."""

    def __init__(self, words: RepeatWords) -> None:
        self._words = words
        self._row: list[StereoFrame] = []  # frames of the present row
        self._reported = 0
        self._total = 0

    def frame(self, frame: StereoFrame, repeated: Repeated | None) -> list[str]:
        """Take a frame and what it repeats; return the lines that follow from it."""
        if repeated is None:
            row = self._row
            self._row = []
            seconds = 0.0
            if row:
                seconds = (frame.time_ns - row[0].time_ns) * S_PER_NS
            after = f"after {len(row)} repetitions ({seconds:.2f} s)"
            return (
                [f"frame {frame.index}: the {self._words.what} change again, {after}"]
                if len(row) > 1
                else []
            )
        self._row.append(frame)
        self._total += 1
        if len(self._row) > 1 or self._reported >= _MAX_LINES:
            return []
        self._reported += 1
        if all(image.min() == image.max() for image in _images(frame)):  # black, or blown out
            return [
                f"frame {frame.index}: the {self._words.what} have one gray value everywhere, as "
                "those of frame "
                f"{repeated.of_index}: the lens is covered, the exposure failed, or the images "
                "were not delivered; "
                f"left out, {self._words.effect}"
            ]
        seen = self._seen(frame, exact=repeated.exact)
        when = "as in" if repeated.older else "since"
        cause = (
            self._words.cause
            if repeated.exact
            else f"{self._words.cause}, or it sees only what moves with it"
        )
        return [
            f"frame {frame.index}: {seen} {when} frame {repeated.of_index} although the rig moves: "
            f"{cause}; "
            f"left out, {self._words.effect}"
        ]

    def _seen(self, frame: StereoFrame, *, exact: bool) -> str:
        """Return what was seen of a frame's images."""
        if len(_images(frame)) > 1:
            both = "both images show nothing that has moved"
            return self._words.exact if exact else both
        return self._words.exact_of_one if exact else "the image shows nothing that has moved"

    def finish(self) -> list[str]:
        """Return the line at the end of the run."""
        what = self._words.what
        effect = self._words.summary
        still = (
            [f"the {what} stayed the same from frame {self._row[0].index} to the end"]
            if self._row
            else []
        )
        if self._total > 1:
            return [*still, f"{self._total} frames {effect}"]
        return still


def corner_flow(before: Image, after: Image, pixels: FloatArray) -> FloatArray:
    """Flow (M, 2) of patches at pixels (N, 2) between two images by one Lucas-Kanade step, offsets
    of gray removed.

    Exact for no motion; for motions of many pixels it only says that there is one. Patches that
    leave the image are left out, so M <= N.
    """
    flow = np.empty((len(pixels), 2))
    count = _write_flow(before, after, np.ascontiguousarray(pixels), flow)
    return flow[:count]


@compiled
def _write_flow(before: Image, after: Image, pixels: FloatArray, flow: FloatArray) -> int:
    """Write the flow (M, 2) of patches around pixels (N, 2) that are inside; return their number."""
    size = (2 * _RADIUS + 1) ** 2
    margin = _RADIUS + 1
    height, width = before.shape
    m = 0
    for n in range(len(pixels)):
        u = np.rint(pixels[n, 0])
        v = np.rint(pixels[n, 1])
        if not (margin <= u < width - margin and margin <= v < height - margin):
            continue
        column = int(u)
        row = int(v)
        uu = 1.0  # one gray level squared, against patches without texture
        uv = 0.0
        vv = 1.0
        ut = 0.0
        vt = 0.0
        u_sum = 0.0
        v_sum = 0.0
        change = 0.0
        for y in range(row - _RADIUS, row + _RADIUS + 1):
            for x in range(column - _RADIUS, column + _RADIUS + 1):
                gu = 0.5 * (float(before[y, x + 1]) - float(before[y, x - 1]))
                gv = 0.5 * (float(before[y + 1, x]) - float(before[y - 1, x]))
                t = float(after[y, x]) - float(before[y, x])
                uu = uu + gu * gu
                uv = uv + gu * gv
                vv = vv + gv * gv
                ut = ut + gu * t
                vt = vt + gv * t
                u_sum = u_sum + gu
                v_sum = v_sum + gv
                change = change + t
        ut = ut - u_sum * change / size  # less the mean change
        vt = vt - v_sum * change / size
        det = uu * vv - uv * uv
        flow[m, 0] = -(vv * ut - uv * vt) / det
        flow[m, 1] = -(uu * vt - uv * ut) / det
        m += 1
    return m
