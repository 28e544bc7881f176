"""The left camera's twists from frame to frame, in batches, and the IMU's readings on the same
clock.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.calibration.egomotion import stereo_twists
from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.monitor.samples import GAP_S, MEMORY_S
from vio.numerics.kinds import Capacity, Tolerance
from vio.numerics.robust import median
from vio.records import S_PER_NS, BoolArray, IntArray, Observations, feature_tracks, shared_rows

BATCH: Capacity[int] = 20  # frames whose motion is computed at once


class _TwistRules(NamedTuple):
    """From what the camera's motion is computed."""

    tracks_per_frame: int = 80  # tracks of a frame that the camera's motion is computed from
    min_links: int = 15  # tracks between two frames
    # Between the frames that are compared: from one to the next of a fast camera, the errors of
    # pixels are as large as a slow motion. Up to 30 frames/s every frame counts.
    min_interval_s: float = 0.03
    max_interval_s: float = 0.25
    same_s: Tolerance[float] = 1e-6  # intervals whose end and start differ by less are contiguous


_TWISTS = _TwistRules()


@dataclass(frozen=True, slots=True)
class Intervals:
    """Frame intervals whose camera motion is known, in time order."""

    begin_ns: IntArray  # (K,)
    end_ns: IntArray  # (K,)
    twists: FloatArray  # (K, 6) [v; omega] of cam0, cam0 frame, m/s and rad/s

    def __len__(self) -> int:
        return len(self.begin_ns)


class CameraTwists:
    """Compute the left camera's twists from frame to frame, from a subset of the tracks, in
    batches.
    """

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        self._kept: list[Observations] = []
        self._guess: list[FloatArray] = []
        self._links: list[int] = []
        self._passed = 0  # frames since the last one that counted
        self.spacing = 1  # of the frames that count, in frames

    def frame(self, seen: Observations) -> Intervals | None:
        """Add one frame; every `BATCH` frames that count, return the motions since the last
        batch.
        """
        self._passed += 1
        if self._kept and self._is_soon(seen.time_ns - self._kept[-1].time_ns):
            return None
        self.spacing = self._passed
        self._passed = 0
        rows = (seen.has_right & ~seen.stale).nonzero()[0]
        if len(rows) > _TWISTS.tracks_per_frame:
            # The same random choice of ids in every frame, so that tracks continue.
            hashed = (seen.ids[rows] * np.int64(2654435761)) & np.int64(0xFFFFFFFF)
            count = _TWISTS.tracks_per_frame
            rows = rows[hashed.argpartition(count)[:count]]
            rows.sort()
        kept = seen.take(rows)
        if self._kept:
            last = self._kept[-1]
            a, b = shared_rows(last.ids, kept.ids)
            self._links.append(len(a))
            self._guess.append(self._initial_rotation(last, kept, kept.z[b, :2] - last.z[a, :2]))
        self._kept.append(kept)
        return self.flush() if len(self._kept) > BATCH else None

    def _is_soon(self, interval_ns: int) -> bool:
        """Whether a frame follows the last one that counts too soon."""
        return 0 < interval_ns * S_PER_NS < _TWISTS.min_interval_s

    def _initial_rotation(
        self, last: Observations, kept: Observations, flow: FloatArray
    ) -> FloatArray:
        """Return the initial twist of a pure rotation: flow du = -fu wy dt, dv = fv wx dt."""
        out = np.zeros(6)
        dt = (kept.time_ns - last.time_ns) * S_PER_NS
        if len(flow) and dt > 0:
            du = median(flow[:, 0])
            dv = median(flow[:, 1])
            out[3] = dv / self._camera.fv / dt
            out[4] = -du / self._camera.fu / dt
        return out

    def flush(self) -> Intervals | None:
        """Return the motions since the last batch; None: there are none."""
        if len(self._kept) < 2:
            return None
        kept = self._kept
        links = np.array(self._links)
        tracks = feature_tracks(dict(enumerate(kept)), len(kept))
        times_ns = np.array([o.time_ns for o in kept], dtype=np.int64)
        found = stereo_twists(self._camera, tracks, times_ns, np.array(self._guess))
        good = (links[found.frames] >= _TWISTS.min_links) & (
            np.diff(times_ns)[found.frames] * S_PER_NS < _TWISTS.max_interval_s
        )
        frames = found.frames[good]
        self._kept = kept[-1:]
        self._guess = []
        self._links = []
        return Intervals(times_ns[frames], times_ns[frames + 1], found.twists[good])


class RecentMotion:
    """The intervals of the last minute."""

    def __init__(self) -> None:
        self._parts: list[Intervals] = []

    def add(self, motion: Intervals) -> None:
        """Add the next intervals, and drop old ones."""
        if not len(motion):
            return
        self._parts.append(motion)
        while motion.end_ns[-1] - self._parts[0].end_ns[-1] > MEMORY_S / S_PER_NS:
            del self._parts[0]

    def joined(self) -> Intervals | None:
        """Return all intervals; None: there are none."""
        if not self._parts:
            return None
        return Intervals(
            np.concatenate([i.begin_ns for i in self._parts]),
            np.concatenate([i.end_ns for i in self._parts]),
            np.concatenate([i.twists for i in self._parts]),
        )


@dataclass(frozen=True, slots=True)
class Record:
    """Intervals and samples on one clock of seconds, with the running integrals of the readings."""

    t: FloatArray  # (S,)
    integral: FloatArray  # (S, 6) of [gyro; accel] over time
    begin: FloatArray  # (K,)
    end: FloatArray  # (K,)
    twists: FloatArray  # (K, 6)
    origin_ns: int

    @property
    def joined(self) -> BoolArray:
        """Whether each interval (K,) starts where the previous one ends."""
        return np.concatenate([[False], np.abs(self.begin[1:] - self.end[:-1]) < _TWISTS.same_s])

    def means(self, offsets: npt.NDArray[np.floating]) -> tuple[FloatArray, BoolArray]:
        """Return mean readings (M, K, 6) over the intervals shifted by offsets (M,), and a mask
        (M, K) of coverage.
        """
        edges = [edge[None, :] + offsets[:, None] for edge in (self.begin, self.end)]
        low, high = (
            np.stack(
                [
                    np.interp(at.ravel(), self.t, self.integral[:, k]).reshape(at.shape)
                    for k in range(6)
                ],
                axis=-1,
            )
            for at in edges
        )
        covered = (edges[0] >= self.t[0]) & (edges[1] <= self.t[-1])
        for k in (np.diff(self.t) > GAP_S).nonzero()[0]:
            covered &= (edges[1] <= self.t[k]) | (edges[0] >= self.t[k + 1])
        return (high - low) / (self.end - self.begin)[None, :, None], covered


def record_of(intervals: Intervals, times_ns: IntArray, values: FloatArray) -> Record:
    """Convert intervals and readings (S, 6) [gyro; accel] at times (S,) to one clock."""
    origin = int(intervals.begin_ns[0])
    t, begin, end = (
        np.asarray((x - origin) * S_PER_NS, dtype=np.float64)
        for x in (times_ns, intervals.begin_ns, intervals.end_ns)
    )
    steps = np.diff(t)[:, None] * (values[1:] + values[:-1]) / 2
    integral = np.concatenate([np.zeros((1, 6)), np.cumsum(steps, axis=0)])
    return Record(t, integral, begin, end, intervals.twists, origin)
