"""Intel RealSense D400 with an IMU: two infrared imagers, factory calibration, by the package
pyrealsense2.

Reference: librealsense's own documentation of `rs2_intrinsics`, `rs2_extrinsics` and the D435i's
IMU.
"""

from __future__ import annotations

import logging
import queue
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.errors import DataError, MissingDependencyError, extra_text
from vio.geometry.lie import FloatArray, se3_from_parts
from vio.geometry.stereo import intrinsic_matrix
from vio.live.pairing import Pairing
from vio.numerics.kinds import Capacity
from vio.records import Image
from vio.sources.source import LOST_S, ImuInterpolation, SourceEvent, SourceFrame

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Streams:
    """Which streams of the camera are read."""

    width: int = 640
    height: int = 480
    rate_hz: int = 30
    silent_s: Capacity[float] = 0.5  # a step in which silence is counted


_STREAMS = _Streams()
_WAITING: Capacity[int] = 1000  # frames and samples that may wait for the reader

# The distortion of the infrared images, which the device rectifies; of raw ones, OpenCV's.
# `inverse_brown_conrady` distorts as `brown_conrady` does, whatever its name says, but for second
# order terms: below 0.04 px by librealsense's own projection.
_MODELS: dict[str, Any] = {
    "none": "pinhole",
    "brown_conrady": "radtan",
    "inverse_brown_conrady": "radtan",
    "kannala_brandt4": "equidistant",
}


class RealSenseSource:
    """A device, by its serial number or the first one, or a recording of librealsense; see
    `LiveSource`.
    """

    image_size: tuple[int, int] | None = (_STREAMS.width, _STREAMS.height)

    def __init__(self, name: str) -> None:
        """Open the device and start it, with the infrared projector off.

        Args:
            name: serial number, file ending in .bag or .db3, or empty.

        Raises:
            MissingDependencyError: pyrealsense2 or a library that it needs is not installed.
            DataError: there is no such device, or it has no two infrared imagers.
        """
        try:
            import pyrealsense2 as rs
        except ModuleNotFoundError as error:
            raise MissingDependencyError(
                f"realsense: needs the package pyrealsense2; {extra_text('realsense')}"
            ) from error
        except ImportError as error:  # such as libusb, which the system must have
            raise MissingDependencyError(
                f"realsense: pyrealsense2 cannot be loaded: {error}"
            ) from error
        self._rs = rs
        self._name = name or "realsense"
        self._is_file = name.endswith((".bag", ".db3"))
        if self._is_file and not Path(name).is_file():
            raise DataError(f"realsense:{name}: there is no such file")
        self._come: queue.Queue[Any] = queue.Queue(_WAITING)
        self._sensors: list[Any] = []  # that were started
        try:
            self._device = self._opened(name)
            profiles = self._chosen_profiles()
            self.has_imu = {"gyro", "accel"} <= set(profiles)  # D435i, D455
            self.rig: Rig | None = self._calibration(profiles)
            self._start(profiles)
        except RuntimeError as error:
            self.close()
            raise DataError(
                f"realsense:{name}: {error}; check the cable (USB 3), and that no other program "
                "uses the camera"
            ) from error

    def _opened(self, name: str) -> Any:
        """Return the device, or a recording in its place."""
        self._context = self._rs.context()
        if self._is_file:
            playback = self._context.load_device(name)
            playback.set_real_time(False)
            return playback
        found = {
            d.get_info(self._rs.camera_info.serial_number): d for d in self._context.query_devices()
        }
        if not found or (name and name not in found):
            have = ", ".join(found) or "none"
            raise DataError(f"realsense:{name}: no such camera; connected are: {have}")
        return found[name] if name else next(iter(found.values()))

    def _is_usable(self, profile: Any) -> bool:
        """Tell whether an infrared stream is gray, and in a file or of the form that is wanted."""
        video = profile.as_video_stream_profile()
        form = (video.width(), video.height(), video.fps())
        wanted = (_STREAMS.width, _STREAMS.height, _STREAMS.rate_hz)
        return bool(profile.format() == self._rs.format.y8) and (self._is_file or form == wanted)

    def _chosen_profiles(self) -> dict[str, tuple[Any, Any]]:
        """Return sensor and profile of each stream: left, right, and gyro and accel where the
        device has them.
        """
        rs = self._rs
        motion = {rs.stream.gyro: "gyro", rs.stream.accel: "accel"}
        found = dict[str, tuple[Any, Any]]()
        for sensor in self._device.query_sensors():
            for profile in sensor.get_stream_profiles():
                kind = profile.stream_type()
                index = profile.stream_index()
                if kind == rs.stream.infrared and index in (1, 2):
                    if self._is_usable(profile):
                        found[("left", "right")[index - 1]] = sensor, profile
                elif kind in motion:
                    name = motion[kind]
                    if name not in found or profile.fps() > found[name][1].fps():
                        found[name] = sensor, profile
        if not {"left", "right"} <= set(found):
            raise DataError(
                f"realsense:{self._name}: no two infrared imagers; a camera of the D400 series has "
                "them"
            )
        return found

    def _start(self, profiles: dict[str, tuple[Any, Any]]) -> None:
        """Start each sensor with its profiles, and the infrared projector off: its dots move
        with the camera.
        """
        by_sensor: dict[int, tuple[Any, list[Any]]] = {}
        for sensor, profile in profiles.values():
            by_sensor.setdefault(id(sensor), (sensor, []))[1].append(profile)
        for sensor, chosen in by_sensor.values():
            if not self._is_file and sensor.supports(self._rs.option.emitter_enabled):
                sensor.set_option(self._rs.option.emitter_enabled, 0)
            sensor.open(chosen)
            self._sensors.append(sensor)
        playback = self._device.as_playback() if self._is_file else None
        if playback is not None:
            # else it begins with the first sensor, and the others miss its beginning
            playback.pause()
        for sensor in self._sensors:
            sensor.start(self._take)
        if playback is not None:
            playback.resume()

    def _take(self, frame: Any) -> None:
        """Note what librealsense's threads bring; a reader that is too slow loses it, but of a
        file nothing is lost.
        """
        frame.keep()
        try:
            self._come.put(frame, block=self._is_file)
        except queue.Full:
            return

    # Calibration

    def _calibration(self, profiles: dict[str, tuple[Any, Any]]) -> Rig:
        """Return the rig that the device has stored."""
        left, right = (profiles[name][1] for name in ("left", "right"))
        T_cam0_imu = None
        if self.has_imu:
            try:
                T_cam0_imu = _transform(profiles["accel"][1].get_extrinsics_to(left))
            except RuntimeError as error:
                log.warning(
                    "realsense:%s: no pose of the IMU (%s); give --calibration FILE",
                    self._name,
                    error,
                )
        lenses = [self._lens(p.as_video_stream_profile().get_intrinsics()) for p in (left, right)]
        return Rig(lenses[0], lenses[1], _transform(left.get_extrinsics_to(right)), T_cam0_imu)

    def _lens(self, found: Any) -> Any:
        K = intrinsic_matrix(found.fx, found.fy, found.ppx, found.ppy)
        name = str(found.model).rpartition(".")[2]
        if name not in _MODELS:
            if not any(found.coeffs):
                name = "none"
            else:
                raise DataError(
                    f"realsense:{self._name}: its distortion {name} is not known; give "
                    "--calibration FILE"
                )
        model = _MODELS[name]
        number = {"none": 0, "kannala_brandt4": 4}.get(name, 5)
        return camera_from_matrix(
            K, found.width, found.height, model, found.coeffs[:number], self._name
        )

    # Frames

    def events(self) -> Iterator[SourceEvent | None]:
        """Yield pairs and samples.

        Raises:
            DataError: nothing has come for seconds.
        """
        rs = self._rs
        imu = ImuInterpolation()
        silent_s = 0.0
        pairing: Pairing[tuple[int, Image]] = Pairing()
        while True:
            try:
                frame = self._come.get(timeout=_STREAMS.silent_s)
            except queue.Empty:
                silent_s += _STREAMS.silent_s
                if (
                    self._is_file
                    and self._device.as_playback().current_status() == rs.playback_status.stopped
                ):
                    return
                if silent_s >= LOST_S:
                    raise DataError(
                        f"realsense:{self._name}: nothing for {LOST_S:.0f} s; check the cable"
                    ) from None
                yield None
                continue
            silent_s = 0.0  # of ms
            profile = frame.get_profile()
            time_ns = round(1e6 * frame.get_timestamp())
            if frame.is_motion_frame():
                data = frame.as_motion_frame().get_motion_data()
                if profile.stream_type() == rs.stream.gyro:
                    take = imu.gyro
                else:
                    take = imu.accel
                yield from take(time_ns, np.array([data.x, data.y, data.z]))
            else:
                image = np.asarray(frame.as_video_frame().get_data()).copy()
                middle_ns = time_ns - self._half_exposure_ns(frame)
                pair = pairing.add(profile.stream_index() - 1, time_ns, (middle_ns, image))
                if pair is not None:
                    _, (left_ns, left), (_, right) = pair
                    yield SourceFrame(left_ns, left, right)

    def _half_exposure_ns(self, frame: Any) -> int:
        """Return how long before an image's stamp, which is of its readout, the middle of its
        exposure was; 0 where the driver passes no metadata.
        """
        values = self._rs.frame_metadata_value
        instants = values.frame_timestamp, values.sensor_timestamp
        if not all(frame.supports_frame_metadata(instant) for instant in instants):
            return 0
        readout_us, middle_us = (frame.get_frame_metadata(instant) for instant in instants)
        half_us = int(readout_us - middle_us)
        if 0 <= half_us <= 0.5e6 / frame.get_profile().fps():
            return 1000 * half_us
        return 0  # two clocks

    def close(self) -> None:
        """Stop the device."""
        for sensor in self._sensors:
            sensor.stop()
            sensor.close()
        self._sensors.clear()


def _transform(found: Any) -> FloatArray:
    """Return extrinsics of librealsense, whose rotation is in columns, as (4, 4)."""
    return se3_from_parts(np.array(found.rotation).reshape(3, 3).T, np.array(found.translation))
