"""Events in any order of arrival in, results of frames out: the loop that live use and
recordings share.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from vio.dataclass import dataclass
from vio.live.frame_pipeline import FramePipeline
from vio.numerics.kinds import Capacity
from vio.records import Estimate, Event, FrameResult, MotionSample, StereoFrame

if TYPE_CHECKING:
    from vio.mapping.session import MapSession


# a frame waits until one that is so much newer has come: then the IMU is silent
LONGEST_WAIT_NS = 100_000_000


class _WaitRules(NamedTuple):
    """How long a frame waits for samples."""

    max_samples: Capacity[int] = 100_000  # that wait: minutes in which no frame came
    min_s: float = 1e-3  # a velocity carries the pose that far as well as the IMU does
    clear_sigmas: float = 3.0  # standard deviations of a time offset that is waited for


_WAIT = _WaitRules()


@dataclass(frozen=True, slots=True)
class Due:
    """What can be processed now: samples, then a frame."""

    samples: list[MotionSample]  # since the frame before, in order of time
    frame: StereoFrame | None  # None: no other frame will come


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
        self._samples: list[MotionSample] = []
        self._newest_ns: int | None = None  # sample that has come
        self._released_ns: int | None = None  # newest sample that was released
        # from a frame's stamp to its exposure on the IMU's clock, 0 or more, as estimated
        self.exposed_after_ns = 0

    def add(self, event: Event) -> Iterator[Due]:
        """Take an event, and yield what can be processed now, in order.

        Frames come in order of time, and samples do; a frame may come before or after its samples.
        Whether a second frame is due may depend on the time offset that was estimated with the
        first, so take one after the other.
        """
        if not isinstance(event, StereoFrame):
            return self.add_samples([event])
        self._frames.append(event)
        return self._due()

    def add_samples(self, samples: Sequence[MotionSample]) -> Iterator[Due]:
        """Take one or more samples at once, as `add` does one after the other."""
        self._samples += samples
        self._newest_ns = samples[-1].time_ns
        del self._samples[: -_WAIT.max_samples]
        return self._due()

    def flush(self) -> Iterator[Due]:
        """Yield all that is held, in order; what has not come will not come."""
        while self._frames:
            yield self._release()
        samples = self._samples
        self._samples = []
        yield Due(samples, None)

    def _due(self) -> Iterator[Due]:
        while self._frames and self._is_due(self._frames[0]):
            yield self._release()

    def _is_due(self, frame: StereoFrame) -> bool:
        if not self._wait:
            return True
        exposed_ns = frame.time_ns + self.exposed_after_ns
        if self._newest_ns is not None and self._newest_ns >= exposed_ns:
            return True
        return self._frames[-1].time_ns - frame.time_ns >= LONGEST_WAIT_NS

    def _release(self) -> Due:
        """The oldest frame after the samples up to its exposure on the IMU's clock and, where it
        waits, one at or after it to interpolate.
        """
        frame = self._frames.popleft()
        exposed_ns = frame.time_ns + self.exposed_after_ns
        released_ns = self._released_ns
        count = 0
        for sample in self._samples:
            lacks_sample = self._wait and (released_ns is None or released_ns < exposed_ns)
            if sample.time_ns > exposed_ns and not lacks_sample:
                break
            released_ns = sample.time_ns
            count += 1
        self._released_ns = released_ns
        samples = self._samples[:count]
        del self._samples[:count]
        return Due(samples, frame)


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

    def add_samples(self, samples: Sequence[MotionSample]) -> list[FrameResult]:
        """Take one or more motion samples at once, as `add` does one after the other."""
        return self._process(self._order.add_samples(samples))

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

    def _process(self, due: Iterable[Due]) -> list[FrameResult]:
        """Give what is due to the pipeline."""
        results: list[FrameResult] = []
        for step in due:
            frame = step.frame
            if step.samples:
                self.pipeline.samples(step.samples)
            if frame is None:
                result = None
            else:
                result = self.pipeline.frame(frame)
            if frame is not None and result is not None:
                results.append(self._in_map(frame, result))
                self.estimate = results[-1].estimate
                self._last_index = frame.index
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
