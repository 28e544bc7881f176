"""The order in which a run takes its events: each frame after the first IMU sample at or after its exposure.

Where the filter estimates that frames are exposed after their stamps on the IMU's clock, the sample is that later one.

A live camera and a live IMU deliver on their own schedules. The order made here depends on the time stamps, so a live
run gives the same poses as the same recording replayed, however the events arrived.
"""

from __future__ import annotations

from collections import deque

from vio.records import Event, MotionSample, StereoFrame

LONGEST_WAIT_NS = 100_000_000  # a frame waits until one that is so much newer has come: then the IMU is silent
_MOST_SAMPLES = 100_000  # that wait: minutes in which no frame came


class EventOrder:
    """Holds frames until their IMU samples have come, and samples until a frame needs them."""

    def __init__(self, *, wait_for_imu: bool) -> None:
        """Create an empty queue.

        Args:
            wait_for_imu: whether a frame waits for the first sample at or after it; False: it passes at once.
        """
        self._wait = wait_for_imu
        self._frames: deque[StereoFrame] = deque()
        self._samples: deque[MotionSample] = deque(maxlen=_MOST_SAMPLES)
        self._newest_ns: int | None = None  # sample that has come
        self._released_ns: int | None = None  # newest sample that was released
        self.exposed_after_ns = 0  # from a frame's stamp to its exposure on the IMU's clock, 0 or more, as estimated

    def add(self, event: Event) -> list[Event]:
        """Take an event, and return what can be processed now, in order.

        Frames come in order of time, and samples do; a frame may come before or after its samples.
        """
        self.put(event)
        ready: list[Event] = []
        while events := self.due():
            ready += events
        return ready

    def put(self, event: Event) -> None:
        """Take an event."""
        if isinstance(event, StereoFrame):
            self._frames.append(event)
        else:
            self._samples.append(event)
            self._newest_ns = event.time_ns

    def due(self) -> list[Event]:
        """The next frame that can be processed now, after its samples; empty where there is none.

        Whether a second frame is due may depend on the time offset that was estimated with the first.
        """
        return self._release() if self._frames and self._is_due(self._frames[0]) else []

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
        """The oldest frame after the samples up to its time and, where it waits, one at or after it to interpolate."""
        frame = self._frames.popleft()
        ready: list[Event] = []
        while self._samples and (self._samples[0].time_ns <= self._exposed_ns(frame) or self._lacks_sample(frame)):
            sample = self._samples.popleft()
            self._released_ns = sample.time_ns
            ready.append(sample)
        return [*ready, frame]

    def _lacks_sample(self, frame: StereoFrame) -> bool:
        """Whether no sample at or after the frame has been released that it waits for."""
        return self._wait and (self._released_ns is None or self._released_ns < self._exposed_ns(frame))

    def _exposed_ns(self, frame: StereoFrame) -> int:
        """Time on the IMU's clock that a frame's samples must reach."""
        return frame.time_ns + self.exposed_after_ns
