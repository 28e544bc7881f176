"""The calibration from the graph: CameraInfo of each camera, and the IMU's pose from /tf_static."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from vio.cameras.rig import Rig
from vio.datasets.bags.cdr import decoded
from vio.datasets.bags.index import BagIndex, camera_info_of
from vio.datasets.bags.topics import CAMERA_INFO, IMU, TF
from vio.datasets.rigs.camera_info import rig_from_camera_infos
from vio.errors import CalibrationError
from vio.ros2.sensors import SensorTopics
from vio.ros2.transport import Transport

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
        for name in self.kinds:
            transport.subscribe(name, CAMERA_INFO, self._info_taker(name), "sensor")
        transport.subscribe(
            STATIC, TF, lambda data: self._index.add_frames(decoded(data, TF, STATIC)), "latched"
        )
        if topics.imu is not None:
            transport.subscribe(topics.imu, IMU, self._imu, "sensor")

    def _info_taker(self, topic: str) -> Callable[[bytes], None]:
        def take(data: bytes) -> None:
            fields: Any = decoded(data, CAMERA_INFO, topic)
            self.received[topic] += 1
            self._frames[topic] = str(fields.header.frame_id).lstrip("/")
            self._index.infos[topic] = camera_info_of(fields, topic)

        return take

    def _imu(self, data: bytes) -> None:
        assert self._topics.imu is not None
        self._frames[self._topics.imu] = str(
            decoded(data, IMU, self._topics.imu).header.frame_id
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
