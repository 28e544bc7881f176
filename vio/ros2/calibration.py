"""The calibration from the graph: CameraInfo of each camera, and the IMU's pose from /tf_static."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from vio.cameras.rig import Rig
from vio.datasets.bags.cdr import live_decoded
from vio.datasets.bags.index import BagIndex, camera_info_of
from vio.datasets.bags.topics import CAMERA_INFO, IMU, TF
from vio.datasets.rigs.camera_info import rig_from_camera_infos
from vio.errors import CalibrationError, VioError
from vio.ros2.sensors import SensorTopics
from vio.ros2.transport import Transport

log = logging.getLogger(__name__)

STATIC = "/tf_static"


def info_topic(image: str) -> str:
    """Return the CameraInfo topic of an image topic: `camera_info` beside it."""
    return f"{image.removesuffix('/compressed').rpartition('/')[0]}/camera_info"


class CameraInfos:
    """Collects the messages that make a rig."""

    def __init__(self, transport: Transport, topics: SensorTopics) -> None:
        self._topics = topics
        self._index = BagIndex()
        self._frames = dict[str, str]()
        self.kinds = {info_topic(camera): CAMERA_INFO for camera in topics.cameras}
        self.received = dict.fromkeys(self.kinds, 0)
        self._named: set[str] = set()  # topics of which a message was left out
        for name in self.kinds:
            take = functools.partial(self._info, name)
            transport.subscribe(name, CAMERA_INFO, self._guarded(name, take), "sensor")
        transport.subscribe(STATIC, TF, self._guarded(STATIC, self._transforms), "latched")
        if topics.imu is not None:
            transport.subscribe(topics.imu, IMU, self._guarded(topics.imu, self._imu), "sensor")

    def _guarded(self, topic: str, take: Callable[[bytes], None]) -> Callable[[bytes], None]:
        """Return what takes the messages of a topic, and leaves out those that cannot be used."""

        def guarded(data: bytes) -> None:
            try:
                take(data)
            except VioError as error:
                if topic not in self._named:
                    self._named.add(topic)
                    log.warning("%s; such messages are left out", error)

        return guarded

    def _info(self, topic: str, data: bytes) -> None:
        fields: Any = live_decoded(data, CAMERA_INFO, topic)
        info = camera_info_of(fields, topic)
        self.received[topic] += 1
        self._frames[topic] = str(fields.header.frame_id).lstrip("/")
        self._index.infos[topic] = info

    def _transforms(self, data: bytes) -> None:
        self._index.add_frames(live_decoded(data, TF, STATIC))

    def _imu(self, data: bytes) -> None:
        assert self._topics.imu is not None
        self._frames[self._topics.imu] = str(
            live_decoded(data, IMU, self._topics.imu).header.frame_id
        ).lstrip("/")

    def rig(self) -> Rig | None:
        """Return the rig once all messages have come that it is made of; None before.

        Raises:
            CalibrationError: the messages describe no rig.
        """
        names = list(self.kinds)
        if len(names) < len(self._topics.cameras):
            raise CalibrationError(f"{names[0]} belongs to both images; give --calibration FILE")
        if not all(name in self._index.infos for name in names):
            return None
        rig = rig_from_camera_infos(
            [self._index.infos[name] for name in names],
            rectified="rect" in self._topics.left.rpartition("/")[2],
        )
        imu = self._topics.imu
        if imu is None:
            return rig
        frame = self._imu_frame()
        if frame is None:
            return None
        T_cam0_imu = self._index.transform(self._frames[names[0]], frame)
        return None if T_cam0_imu is None else replace(rig, T_cam0_imu=T_cam0_imu)

    def _imu_frame(self) -> str | None:
        """Return the frame of the IMU's messages; before the first one, the only frame named
        after an IMU.
        """
        if self._topics.imu in self._frames:
            return self._frames[self._topics.imu]
        named = {name for pair in self._index.frames for name in pair if "imu" in name.lower()}
        return named.pop() if len(named) == 1 else None

    def waits_for(self) -> str:
        """What is missing, and what to do."""
        missing = [name for name in self.kinds if name not in self._index.infos]
        if missing:
            return f"no CameraInfo on {' and '.join(missing)} yet; give --calibration FILE"
        frame = self._imu_frame()
        camera = self._frames[next(iter(self.kinds))]
        if frame is None:
            return f"no message on {self._topics.imu} yet, whose frame is needed; give --calibration FILE"
        return f"{STATIC} does not connect {frame} with {camera}; give --calibration FILE with T_cam_imu"
