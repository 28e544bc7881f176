"""Whether the rows of the images are exposed one after the other though no readout time is stated.

A rolling shutter moves pixels by their motion times how late their row is: a pattern that no motion
of the rig explains. It is fitted to what the motion between two frames leaves of the pixels, beside a
growth of the image about its centre and an error of all disparities, which a wrong calibration
leaves. How the pairs of frames scatter says how well the readout time is known.
Reference: Ait-Aider, Andreff, Lavest & Martinet, Simultaneous object pose and velocity computation
using a single view from a rolling shutter camera, ECCV (2006).
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.findings import Finding
from vio.frontend.outliers import RansacProblem, best_motion
from vio.geometry.lie import FloatArray, transform_points
from vio.geometry.stereo import StereoCamera, project, triangulate, z_D_p_cam
from vio.numerics.kinds import Capacity, Tolerance
from vio.numerics.robust import median
from vio.records import S_PER_NS, BoolArray, IntArray, Observations


class _PatternRules(NamedTuple):
    """How patterns are fitted, and when that of the rows counts."""

    spans: tuple[int, ...] = (8, 4, 2)  # frames of a pair: the first that shares enough features
    every: Capacity[int] = 4  # frames, a pair
    pairs: Capacity[int] = 250  # the newest that are kept
    min_pairs: int = 10
    min_features: int = 30
    inlier_px: float = 4.0  # of the motion, with what the patterns leave
    # errors of pixels and disparities that features are weighed by
    pixel_px: float = 0.15
    disparity_px: float = 0.2
    robust: float = 4.0  # times the usual residual, at which a feature counts by half
    damping: Tolerance[float] = 1e-9
    # of the readout time, beyond which it is one: healthy recordings have up to 4.5
    sigmas: float = 7.0
    # The least that is named, and how well it must be known. Rolling shutters have 10 to 33 ms;
    # global ones come to 5 where that is known less well.
    min_s: float = 0.006
    max_sigma_s: float = 0.003
    # a shutter is global, and not looked at any more, that is known so well to have less
    global_s: float = 0.003
    global_sigma_s: float = 0.0005


_PATTERNS = _PatternRules()
_READOUT, _GROWTH, _DISPARITY = range(3)  # what is fitted, in this order
_STILL = np.eye(4)


@dataclass(frozen=True, slots=True)
class _Pair:
    """What a pair of frames says of the patterns: normal equations without the motion."""

    normal: FloatArray  # (3, 3)
    moment: FloatArray  # (3,)


class UnstatedShutter:
    """Reports a rolling shutter once, for all frames."""

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        self._frames = deque[Observations](maxlen=_PATTERNS.spans[0] + 3)
        self._pairs = deque[_Pair](maxlen=_PATTERNS.pairs)
        self._count = 0
        self._open = camera.kind != "mono"  # not known yet; one camera shows no depth

    def frame(self, seen: Observations) -> list[Finding]:
        """Return what a frame shows, with those before it."""
        if not self._open:
            return []
        self._frames.append(seen)
        self._count += 1
        pair = self._compare() if self._count % _PATTERNS.every == 0 else None
        if pair is None:
            return []
        self._pairs.append(pair)
        if len(self._pairs) < _PATTERNS.min_pairs:
            return []
        readout_s, sigma_s = _readout(self._pairs)
        if sigma_s < _PATTERNS.global_sigma_s and abs(readout_s) < _PATTERNS.global_s:
            self._open = False
            return []
        least_s = max(_PATTERNS.min_s, _PATTERNS.sigmas * sigma_s)
        if sigma_s > _PATTERNS.max_sigma_s or abs(readout_s) < least_s:
            return []
        self._open = False
        return [_rolling(seen.frame_index, readout_s)]

    def _compare(self) -> _Pair | None:
        """Compare the frame before the newest one with an earlier one; None: too few are shared."""
        frames = list(self._frames)
        for span in _PATTERNS.spans:
            if span + 3 > len(frames):
                continue
            both = _shared(frames[-span - 3 : -span], frames[-3:])
            if both is not None:
                return self._patterns(*both)
        return None

    def _patterns(self, before: _Seen, after: _Seen) -> _Pair | None:
        """Return what the motion between two frames leaves to the patterns; None: too few follow
        it.
        """
        camera = self._camera
        p, valid = triangulate(camera, before.z)
        before = before.take(valid)
        after = after.take(valid)
        p = p[valid]
        if len(p) < _PATTERNS.min_features:
            return None
        problem = RansacProblem(
            camera, _PATTERNS.inlier_px, np.random.default_rng((0, after.index))
        )
        T, follow = best_motion(problem, p, after.z[:, :2], _STILL[None])
        if int(follow.sum()) < _PATTERNS.min_features:
            return None
        before = before.take(follow)
        after = after.take(follow)
        p = p[follow]
        q = transform_points(T, p)
        residual = after.z[:, :2] - project(camera, q)[:, :2]
        uv_D_p = z_D_p_cam(camera, q)[:, :2]
        motion = np.concatenate([uv_D_p, np.cross(q[:, None, :], uv_D_p)], axis=2)
        of_disparity = -p / (before.z[:, :1] - before.z[:, 2:3])
        patterns = np.empty((len(p), 2, 3))
        patterns[..., _READOUT] = self._of_rows(after) - self._of_rows(before)
        seconds = (after.time_ns - before.time_ns) * S_PER_NS
        patterns[..., _GROWTH] = (after.z[:, :2] - (camera.cu, camera.cv)) * seconds
        patterns[..., _DISPARITY] = np.einsum("nij,nj->ni", uv_D_p, of_disparity @ T[:3, :3].T)
        sigma = np.hypot(_PATTERNS.pixel_px, _PATTERNS.disparity_px * patterns[..., _DISPARITY])
        normal, moment = _left_by(motion, patterns, residual, sigma)
        return _Pair(normal, moment)

    def _of_rows(self, seen: _Seen) -> FloatArray:
        """By how much pixels (N, 2) move, in px/s, times how far their rows are from the middle."""
        height = self._camera.height or 2.0 * self._camera.cv
        return seen.px_per_s * (seen.z[:, 1:2] / height - 0.5)


@dataclass(frozen=True, slots=True)
class _Seen:
    """Features of a frame that the frames around it show, too."""

    index: int
    time_ns: int
    z: FloatArray  # (N, 4)
    px_per_s: FloatArray  # (N, 2) of the left pixels

    def take(self, rows: BoolArray) -> _Seen:
        """Return some of the features."""
        return _Seen(self.index, self.time_ns, self.z[rows], self.px_per_s[rows])


def _shared(before: list[Observations], after: list[Observations]) -> tuple[_Seen, _Seen] | None:
    """Return the features of the middle ones of three frames each that all of them show, with a
    right match in the earlier one; None: too few.
    """
    ids = before[1].ids[before[1].has_right & ~before[1].stale]
    for seen in (before[0], before[2], *after):
        ids = np.intersect1d(ids, seen.ids)
    if len(ids) < _PATTERNS.min_features:
        return None
    return _with_velocity(before, ids), _with_velocity(after, ids)


def _with_velocity(frames: list[Observations], ids: IntArray) -> _Seen:
    z = []
    for seen in frames:
        order = np.argsort(seen.ids)
        z.append(seen.z[order[np.searchsorted(seen.ids, ids, sorter=order)]])
    seconds = (frames[2].time_ns - frames[0].time_ns) * S_PER_NS
    return _Seen(
        frames[1].frame_index, frames[1].time_ns, z[1], (z[2][:, :2] - z[0][:, :2]) / seconds
    )


def _left_by(
    motion: FloatArray, patterns: FloatArray, residual: FloatArray, sigma: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normal equations (3, 3), (3,) of patterns (N, 2, 3) in residuals (N, 2), px, of standard
    deviations (N, 2), with the motion (N, 2, 6) taken out of both.
    """
    whitened = (residual / sigma).reshape(-1)
    usual = max(median(np.abs(whitened)), 1.0)
    weight = 1.0 / np.sqrt(1.0 + (whitened / (_PATTERNS.robust * usual)) ** 2)
    scale = weight / sigma.reshape(-1)
    Q, _ = np.linalg.qr(motion.reshape(-1, 6) * scale[:, None])
    A = patterns.reshape(len(scale), -1) * scale[:, None]
    b = residual.reshape(-1) * scale
    A = A - Q @ (Q.T @ A)
    b = b - Q @ (Q.T @ b)
    return A.T @ A, A.T @ b


def _readout(pairs: deque[_Pair]) -> tuple[float, float]:
    """The readout time as pairs of frames show it, and its standard deviation by how they scatter,
    s.
    """
    normals = np.array([pair.normal for pair in pairs])
    moments = np.array([pair.moment for pair in pairs])
    normal = normals.sum(axis=0)
    inverse = np.linalg.inv(normal + _PATTERNS.damping * np.diag(normal.diagonal() + 1.0))
    value = inverse @ moments.sum(axis=0)
    errors = (moments - normals @ value) @ inverse[:, _READOUT]
    few = len(pairs) / (len(pairs) - 1.0)
    return float(value[_READOUT]), float(np.sqrt(few * np.sum(errors**2)))


def _rolling(index: int, readout_s: float) -> Finding:
    message = (
        f"frame {index}: pixels move as those of a rolling shutter of about {1e3 * readout_s:.0f} ms "
        "do, and none is stated: state frontend.readout_ms; where the shutter is global, lenses or "
        "focal lengths are not those of the calibration"
    )
    figures = {"readout_ms": 1e3 * readout_s}
    return Finding("rolling-shutter", message, index, 0, lasts=True, figures=figures)
