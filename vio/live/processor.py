"""Events in any order of arrival in, results of frames out: the loop that live use and recordings share."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from vio.live.event_order import EventOrder
from vio.live.frame_pipeline import FramePipeline
from vio.records import Estimate, Event, FrameResult, Landmarks, MotionSample, StereoFrame

if TYPE_CHECKING:
    from vio.mapping.session import MapSession

_LEAST_WAIT_S = 1e-3  # a velocity carries the pose that far as well as the IMU does
_CLEAR = 3.0  # standard deviations of a time offset that is waited for


def _wait_ns(estimate: Estimate) -> int:
    """How long after its stamp a frame is processed, ns, so that the IMU's samples reach its exposure."""
    offset_s, sigma_s = estimate.time_offset_s, estimate.time_offset_sigma_s
    if offset_s is None or sigma_s is None or offset_s < max(_LEAST_WAIT_S, _CLEAR * sigma_s):
        return 0
    return round(1e9 * offset_s)


class EventProcessor:
    """Takes events through the pipeline and, where there is one, into the map."""

    def __init__(self, pipeline: FramePipeline, *, wait_for_imu: bool, map: MapSession | None) -> None:
        """Begin a trajectory.

        Args:
            pipeline: processes one event at a time.
            wait_for_imu: whether a frame waits for the first sample at or after it.
            map: the trajectory's part of a map; None: no map.
        """
        self._pipeline, self._order, self.map = pipeline, EventOrder(wait_for_imu=wait_for_imu), map
        self.estimate: Estimate | None = None  # newest; None before the first
        self._last_index = 0  # of the frame that it is of

    def add(self, event: Event) -> list[FrameResult]:
        """Take an event, whose image is rectified, and return the results of the frames that it completed."""
        self._order.put(event)
        results: list[FrameResult] = []
        while events := self._order.due():
            results += self._process(events)
        return results

    def finish(self) -> list[FrameResult]:
        """Process the frames that still wait, and let the checks report what they have not yet reported."""
        results = self._process(self._order.flush())
        self._pipeline.monitor.close()
        if self.estimate is not None:
            self._pipeline.begin_again(self._last_index)
        self.estimate = self._pipeline.newest(self._last_index, self.estimate)
        if self.map is not None:
            self.map.finish()
        return results

    def close(self) -> None:
        """Write the map and release its file; without a map, nothing is held."""
        if self.map is not None:
            self.map.close()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the checks have found so far, one line each."""
        return tuple(self._pipeline.monitor.lines)

    def say(self, line: str) -> None:
        """Log a line on the events, and add it to the warnings."""
        self._pipeline.monitor.say(line)

    @property
    def frames_refused(self) -> int:
        """Number of frames that the front end refused."""
        return self._pipeline.monitor.frames_refused

    @property
    def refusal(self) -> str:
        """Why the last frame of those was refused."""
        return self._pipeline.monitor.refusal

    @property
    def frames_waiting(self) -> int:
        """Number of frames without a pose, as the back end could not be initialised yet."""
        return self._pipeline.monitor.frames_waiting

    def landmarks(self) -> Landmarks:
        """Return the points of the map so far, after the first frame with a pose."""
        return self._pipeline.backend.landmarks()

    def take_landmarks(self) -> Landmarks:
        """Return the points that will not change any more, and forget them; `landmarks` has the others."""
        return self._pipeline.backend.take_landmarks()

    def usable(self, sample: MotionSample) -> MotionSample | None:
        """Return a motion sample as the estimator takes it; None: it does not, as the sensor was found to be wrong."""
        return self._pipeline.usable(sample)

    def take_revised(self) -> dict[int, Estimate]:
        """Return the estimates, by frame number, that replace earlier ones, and forget them.

        There are some where the IMU was found to be wrong, once, in the first minute.
        """
        return self._pipeline.take_revised()

    def smoothed(self, frame_index: int) -> Estimate | None:
        """Return the estimate at a past frame with all frames since; None where the window does not hold it."""
        return self._pipeline.backend.smoothed(frame_index)

    def _process(self, events: list[Event]) -> list[FrameResult]:
        """Give events that are due to the pipeline."""
        results: list[FrameResult] = []
        for event in events:
            if not isinstance(event, StereoFrame):
                self._pipeline.sample(event)
                continue
            result = self._pipeline.frame(event)
            if result is not None:
                results.append(self._in_map(event, result))
                self.estimate, self._last_index = results[-1].estimate, event.index
                self._order.exposed_after_ns = _wait_ns(self.estimate)
        return results

    def _in_map(self, frame: StereoFrame, result: FrameResult) -> FrameResult:
        """Add what the map says of a frame."""
        if self.map is None:
            return result
        loops = self.map.frame(frame, result.output.observations, result.estimate, self._pipeline.backend.relative)
        T = self.map.T_map_odom
        if T is not None:
            T_map_body, covariance = T @ result.estimate.T_world_imu, self.map.covariance
            estimate = replace(result.estimate, T_map_body=T_map_body, T_map_body_covariance=covariance)
            result = replace(result, estimate=estimate)
        return replace(result, loops=loops, is_keyframe=self.map.newest_keyframe == frame.index)
