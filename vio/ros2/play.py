"""A recording, published as a robot's drivers would."""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from vio.datasets.bags.topics import CAMERA_INFO, IMAGE, IMU
from vio.datasets.bags.writer import BagWriter
from vio.errors import NOTE
from vio.geometry.lie import se3_inverse
from vio.numerics.kinds import Capacity
from vio.protocols import Dataset
from vio.records import Event, ImuSample, Recording, StereoFrame
from vio.ros2.calibration import info_topic
from vio.ros2.sensors import SensorTopics
from vio.ros2.transport import Quality, Transport, publisher

logger = logging.getLogger(__name__)

CAMERA_FRAMES = ("cam0", "cam1")
IMU_FRAME = "imu"
_WAIT_S: Capacity[float] = 0.05
_OTHERS_S = 1.0  # after the first subscriber, for those to other topics


@dataclass(frozen=True, slots=True)
class Played:
    """Counts of what was published."""

    frames: int
    samples: int


@dataclass(frozen=True, slots=True)
class Playing:
    """How a recording is published."""

    rate: float | None  # times real time; None: as fast as it goes
    quality: Quality  # "reliable" waits for slow subscribers
    wait: bool = True  # for a subscriber to the left images, before the first one
    stop: int | None = None  # frame after the last one; None: to the end


def play(
    transport: Transport,
    dataset: Dataset,
    topics: SensorTopics,
    how: Playing,
    should_stop: Callable[[], object],
) -> Played:
    """Publish the rectified images of a recording with their CameraInfo, its IMU samples, and the
    IMU's pose.

    Args:
        transport: of the graph.
        dataset: the recording.
        topics: names; the right camera and the IMU are left out where the recording has none.
        how: rate, quality and span.
        should_stop: asked before each message.
    """
    recording = dataset.recording
    imu = _topic_of_imu(recording, topics)
    if recording.camera.kind == "stereo":
        cameras = topics.cameras
    else:
        cameras = topics.cameras[:1]
    sensors = dict.fromkeys(cameras, IMAGE)
    if imu is not None:
        sensors[imu] = IMU
    infos = {info_topic(name): CAMERA_INFO for name in cameras}
    out = publisher(transport, sensors | infos, default=how.quality)
    if imu is not None:
        first_ns = int(recording.frame_times_ns[0])
        out.static_transforms(
            first_ns, [(IMU_FRAME, CAMERA_FRAMES[0], se3_inverse(recording.T_cam0_body))]
        )
    if how.wait:
        _wait_for_subscribers(
            transport, list(sensors), lambda: _publish_infos(out, cameras, recording), should_stop
        )
    frames = samples = 0
    for event in itertools.takewhile(
        lambda _: not should_stop(), _in_time(dataset.events(0, how.stop), how.rate)
    ):
        if isinstance(event, StereoFrame):
            frames += 1
            _publish_frame(out, cameras, recording, event)
        elif isinstance(event, ImuSample) and imu is not None:
            samples += 1
            out.imu(imu, IMU_FRAME, event)
    return Played(frames, samples)


def _topic_of_imu(recording: Recording, topics: SensorTopics) -> str | None:
    """Return the topic of the samples; None: the recording has none, or not their pose."""
    has_imu = recording.T_cam0_imu is not None and "imu" in recording.motion
    return topics.imu if has_imu else None


def _wait_for_subscribers(
    transport: Transport,
    topics: list[str],
    announce: Callable[[], None],
    should_stop: Callable[[], object],
) -> None:
    """Wait for a subscriber to the left images, and a little longer for those to the others.

    Meanwhile the calibration is announced: a node may need it before it subscribes to images.
    """
    others_until: float | None = None
    if not transport.subscribers(topics[0]):
        logger.log(NOTE, "waiting for a subscriber to %s; --now does not wait", topics[0])
    while not should_stop():
        if transport.subscribers(topics[0]):
            others_until = others_until or time.monotonic() + _OTHERS_S
            if all(map(transport.subscribers, topics)) or time.monotonic() > others_until:
                return
        announce()
        transport.spin(_WAIT_S)


def _publish_infos(out: BagWriter, cameras: tuple[str, ...], recording: Recording) -> None:
    for name, body in zip(cameras, CAMERA_FRAMES, strict=False):
        time_ns = int(recording.frame_times_ns[0])
        out.camera_info(
            info_topic(name), body, time_ns, recording.camera, right=body == CAMERA_FRAMES[1]
        )


def _publish_frame(
    out: BagWriter, cameras: tuple[str, ...], recording: Recording, frame: StereoFrame
) -> None:
    for name, body, image in zip(cameras, CAMERA_FRAMES, (frame.left, frame.right), strict=False):
        if image is not None:
            right = body == CAMERA_FRAMES[1]
            out.camera_info(info_topic(name), body, frame.time_ns, recording.camera, right=right)
            out.image(name, body, frame.time_ns, image)


def _in_time(events: Iterator[Event], rate: float | None) -> Iterator[Event]:
    """Yield events when their time has come; the first one at once."""
    start: tuple[int, float] | None = None  # of the recording, ns, and of this computer, s
    for event in events:
        start = start or (event.time_ns, time.monotonic())
        if rate is not None:
            due = start[1] + (event.time_ns - start[0]) * 1e-9 / rate
            time.sleep(max(0.0, due - time.monotonic()))
        yield event
