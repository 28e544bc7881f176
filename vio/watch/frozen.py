"""Find image pairs that show no motion although the rig moves: frames that a camera or driver gives again.

Equal to the last bit is the same exposure, as noise differs from one to the next. Nearly equal pairs (encoded again, or
with noise on top) are the same where the tracked corners have not moved, while the motion predicted since the last
frame moves them by more than its uncertainty allows and the IMU is not at standstill. A rig at standstill gives nearly
equal images, too; there the prediction agrees, and they are used.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from vio.filters.imu_start import imu_start
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import FloatArray, se3_log
from vio.records import Image, ImuSample, MotionPrior, Observations, Prediction, StereoFrame
from vio.statistics import chi_square_quantile

_RADIUS = 4  # of the patches whose flow is measured, pixels
_CORNERS = 60  # measured per image
_LEAST_CORNERS = 15
_PREDICTED_PX = 0.6  # a corner that is predicted to move less tells nothing
_UNMOVED_PX = 0.15  # the flow of an unmoved corner under noise of a few gray levels
_SHARE = 0.8  # of the corners that must be unmoved
_PROBABILITY = 0.9999  # chi-square limit of the predicted motion for no motion to be possible
_IMU_S = 0.6  # samples kept, for the last half second
_NS = 1e-9


@dataclass(frozen=True, slots=True)
class Repeated:
    """A pair that shows the exposure of an earlier frame."""

    of_index: int  # that frame's number
    exact: bool  # equal to the last bit


class FrozenImages:
    """Compares each pair with the last one that showed something new."""

    def __init__(self) -> None:
        self._imu: deque[ImuSample] = deque()
        self._shown: StereoFrame | None = None  # the last frame that is no repetition
        self._seen: Observations | None = None  # its features
        self._repeating: Repeated | None = None  # of the frame before

    def sample(self, sample: ImuSample) -> None:
        """Take a sample of the IMU."""
        self._imu.append(sample)
        while (sample.time_ns - self._imu[0].time_ns) * _NS > _IMU_S:
            self._imu.popleft()

    def observations(self, seen: Observations) -> None:
        """Take the features of a frame that `check` let pass."""
        self._seen = seen

    def check(self, frame: StereoFrame, expected: Prediction | None) -> Repeated | None:
        """Return which frame a pair repeats; None: it shows something new, or a rig at standstill.

        Args:
            frame: the pair, with or without images; frames come in time order.
            expected: the back end's prediction of this frame, its motion since the last frame with features.
        """
        self._repeating = self._compare(frame, expected)
        if self._repeating is None:
            self._shown = frame
        return self._repeating

    def _compare(self, frame: StereoFrame, expected: Prediction | None) -> Repeated | None:
        shown = self._shown
        if shown is None or frame.left is None or frame.right is None:
            return None
        assert shown.left is not None
        assert shown.right is not None
        if np.array_equal(frame.left, shown.left) and np.array_equal(frame.right, shown.right):
            again = self._repeating is not None and self._repeating.exact
            return Repeated(shown.index, True) if again or self._moves(frame.time_ns, expected) else None
        if expected is None or self._seen is None or not self._contradicts(expected.motion):
            return None
        if self._unmoved(shown, frame, self._seen, expected) and not self._at_standstill(frame.time_ns):
            return Repeated(shown.index, False)
        return None

    def _moves(self, time_ns: int, expected: Prediction | None) -> bool:
        """Whether the rig moves: by the IMU's samples, else by the prediction."""
        if self._imu:
            return not self._at_standstill(time_ns)
        return expected is not None and self._contradicts(expected.motion)

    def _at_standstill(self, time_ns: int) -> bool:
        """Whether the IMU's last half second shows noise alone, and gravity."""
        if not self._imu or not any(x.accel.any() for x in self._imu):
            return False
        return imu_start(tuple(self._imu), time_ns, MsckfSettings()).still

    def _contradicts(self, motion: MotionPrior | None) -> bool:
        """Whether no motion at all contradicts the predicted one, by chi-square."""
        if motion is None:
            return False
        xi = se3_log(motion.T_curr_prev)
        C = motion.covariance
        scale = float(np.trace(C)) + 1e-18
        return bool(xi @ np.linalg.solve(C + 1e-9 * scale * np.eye(6), xi) > chi_square_quantile(_PROBABILITY, 6))

    def _unmoved(self, before: StereoFrame, now: StereoFrame, seen: Observations, expected: Prediction) -> bool:
        """Whether the corners that are predicted to move have not moved, in both images."""
        if expected.tracks is None:
            return False
        _, a, b = np.intersect1d(seen.ids, expected.tracks.ids, assume_unique=True, return_indices=True)
        z, moved = seen.z[a], expected.tracks.z[b] - seen.z[a]
        has_right = seen.has_right[a]
        for old, new, columns, there in (
            (before.left, now.left, slice(0, 2), np.ones(len(a), dtype=np.bool_)),
            (before.right, now.right, slice(2, 4), has_right),
        ):
            assert old is not None
            assert new is not None
            rows = np.flatnonzero(there & (np.linalg.norm(moved[:, columns], axis=1) > _PREDICTED_PX))[:_CORNERS]
            flow = corner_flow(old, new, z[rows, columns])
            if len(flow) < _LEAST_CORNERS or np.mean(np.linalg.norm(flow, axis=1) < _UNMOVED_PX) < _SHARE:
                return False
        return True


def corner_flow(before: Image, after: Image, pixels: FloatArray) -> FloatArray:
    """Flow (M, 2) of patches at pixels (N, 2) between two images by one Lucas-Kanade step, offsets of gray removed.

    Exact for no motion; for motions of many pixels it only says that there is one. Patches that leave the image are
    left out, so M <= N.
    """
    height, width = before.shape
    margin, at = _RADIUS + 1, np.rint(pixels).astype(np.int64)
    inside = np.all((at >= margin) & (at < np.array([width, height]) - margin), axis=1)
    y, x = np.mgrid[-margin : margin + 1, -margin : margin + 1]
    rows, columns = at[inside, 1, None, None] + y, at[inside, 0, None, None] + x
    old, new = before[rows, columns].astype(np.float64), after[rows, columns].astype(np.float64)
    inner = slice(1, -1)
    gu = (old[:, inner, 2:] - old[:, inner, :-2]).reshape(len(old), -1) / 2
    gv = (old[:, 2:, inner] - old[:, :-2, inner]).reshape(len(old), -1) / 2
    change = (new - old)[:, inner, inner].reshape(len(old), -1)
    change = change - change.mean(axis=1, keepdims=True)
    g = np.stack([gu, gv], axis=1)
    normal = g @ g.transpose(0, 2, 1) + 1.0 * np.eye(2)  # one gray level squared, against patches without texture
    flow: FloatArray = -np.linalg.solve(normal, (g @ change[..., None]))[..., 0]
    return flow
