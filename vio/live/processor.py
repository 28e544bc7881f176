"""Events in any order of arrival in, results of frames out: the loop that live use and
recordings share.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from vio.live.frame_pipeline import FramePipeline
from vio.records import Estimate, Event, FrameResult, MotionSample, StereoFrame

if TYPE_CHECKING:
    from vio.mapping.session import MapSession


# a frame waits until one that is so much newer has come: then the IMU is silent
LONGEST_WAIT_NS = 100_000_000


class _WaitRules(NamedTuple):
    """How long a frame waits for samples."""

    max_samples: int = 100_000  # that wait: minutes in which no frame came
    min_s: float = 1e-3  # a velocity carries the pose that far as well as the IMU does
    clear_sigmas: float = 3.0  # standard deviations of a time offset that is waited for


_WAIT = _WaitRules()


class EventOrder:
    """The order in which a run takes its events: each frame after the first IMU sample at or after
    its exposure.

    Where the filter estimates that frames are exposed after their stamps on the IMU's clock, the
    sample is that later one. A live camera and a live IMU deliver on their own schedules. This
    order depends on the time stamps alone, so a live run gives the same poses as the same recording
    replayed, however the events arrived.
    """

    def __init__(self, *, wait_for_imu: bool) -> None:
        """Create an empty queue; with `wait_for_imu`, a frame waits for the first sample at or
        after it.
        """
        self._wait = wait_for_imu
        self._frames: deque[StereoFrame] = deque()
        self._samples: deque[MotionSample] = deque(maxlen=_WAIT.max_samples)
        self._newest_ns: int | None = None  # sample that has come
        self._released_ns: int | None = None  # newest sample that was released
        # from a frame's stamp to its exposure on the IMU's clock, 0 or more, as estimated
        self.exposed_after_ns = 0

    def add(self, event: Event) -> Iterator[Event]:
        """Take an event, and yield what can be processed now, in order.

        Frames come in order of time, and samples do; a frame may come before or after its samples.
        Whether a second frame is due may depend on the time offset that was estimated with the
        first, so take one after the other.
        """
        if isinstance(event, StereoFrame):
            self._frames.append(event)
        else:
            self._samples.append(event)
            self._newest_ns = event.time_ns
        while self._frames and self._is_due(self._frames[0]):
            yield from self._release()

    def flush(self) -> list[Event]:
        """Return all that is held, in order; what has not come will not come."""
        ready: list[Event] = []
        while self._frames:
            ready += self._release()
        ready += self._samples
        self._samples.clear()
        return ready

    def _is_due(self, frame: StereoFrame) -> bool:
        if not self._wait:
            return True
        if self._newest_ns is not None and self._newest_ns >= self._exposed_ns(frame):
            return True
        return self._frames[-1].time_ns - frame.time_ns >= LONGEST_WAIT_NS

    def _release(self) -> list[Event]:
        """The oldest frame after the samples up to its time and, where it waits, one at or after
        it to interpolate.
        """
        frame = self._frames.popleft()
        ready: list[Event] = []
        while self._samples and (
            self._samples[0].time_ns <= self._exposed_ns(frame) or self._lacks_sample(frame)
        ):
            sample = self._samples.popleft()
            self._released_ns = sample.time_ns
            ready.append(sample)
        return [*ready, frame]

    def _lacks_sample(self, frame: StereoFrame) -> bool:
        """Whether no sample at or after the frame has been released that it waits for."""
        return self._wait and (
            self._released_ns is None or self._released_ns < self._exposed_ns(frame)
        )

    def _exposed_ns(self, frame: StereoFrame) -> int:
        """Time on the IMU's clock that a frame's samples must reach."""
        return frame.time_ns + self.exposed_after_ns


def _wait_ns(estimate: Estimate) -> int:
    """How long after its stamp a frame is processed, ns, so that the IMU's samples reach its
    exposure.
    """
    offset_s = estimate.time_offset_s
    sigma_s = estimate.time_offset_sigma_s
    if (
        offset_s is None
        or sigma_s is None
        or offset_s < max(_WAIT.min_s, _WAIT.clear_sigmas * sigma_s)
    ):
        return 0
    return round(1e9 * offset_s)


class EventProcessor:
    """Takes events through the pipeline and, where there is one, into the map."""

    def __init__(
        self, pipeline: FramePipeline, *, wait_for_imu: bool, map: MapSession | None
    ) -> None:
        """Begin a trajectory, and its part of a map where there is one; `wait_for_imu` as of
        `EventOrder`.
        """
        self.pipeline = pipeline
        self._order = EventOrder(wait_for_imu=wait_for_imu)
        self.map = map
        self.estimate: Estimate | None = None  # newest; None before the first
        self._last_index = 0  # of the frame that it is of

    def add(self, event: Event) -> list[FrameResult]:
        """Take an event, whose image is rectified, and return the results of the frames that it
        completed.
        """
        return self._process(self._order.add(event))

    def finish(self) -> list[FrameResult]:
        """Process the frames that still wait, and let the checks report what they have not yet
        reported.
        """
        results = self._process(self._order.flush())
        self.pipeline.monitor.close()
        if self.estimate is not None:
            self.pipeline.begin_again(self._last_index)
        self.estimate = self.pipeline.newest(self._last_index, self.estimate)
        if self.map is not None:
            self.map.finish()
        return results

    def close(self) -> None:
        """Write the map and release its file; without a map, nothing is held."""
        if self.map is not None:
            self.map.close()

    def _process(self, events: Iterable[Event]) -> list[FrameResult]:
        """Give events that are due to the pipeline."""
        results: list[FrameResult] = []
        for event in events:
            if not isinstance(event, StereoFrame):
                self.pipeline.sample(event)
                continue
            result = self.pipeline.frame(event)
            if result is not None:
                results.append(self._in_map(event, result))
                self.estimate = results[-1].estimate
                self._last_index = event.index
                self._order.exposed_after_ns = _wait_ns(self.estimate)
        return results

    def _in_map(self, frame: StereoFrame, result: FrameResult) -> FrameResult:
        """Add what the map says of a frame."""
        if self.map is None:
            return result
        loops = self.map.frame(
            frame, result.output.observations, result.estimate, self.pipeline.backend.relative
        )
        T = self.map.T_map_odom
        if T is not None:
            T_map_body = T @ result.estimate.T_world_imu
            covariance = self.map.covariance
            estimate = replace(
                result.estimate, T_map_body=T_map_body, T_map_body_covariance=covariance
            )
            result = replace(result, estimate=estimate)
        return replace(result, loops=loops, is_keyframe=self.map.newest_keyframe == frame.index)
