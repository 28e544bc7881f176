"""Luxonis OAK with two mono cameras and an IMU, calibration of the device, by the package depthai
3.

Not tried on a device: written against the types and docstrings of depthai 3.12.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.errors import DataError, MissingDependencyError, extra_text
from vio.geometry.distortion import CameraModel, DistortionModel
from vio.live.pairing import Pairing
from vio.numerics.kinds import Capacity
from vio.records import Image
from vio.sources.source import LOST_S, ImuInterpolation, SourceEvent, SourceFrame


@dataclass(frozen=True, slots=True)
class _Streams:
    """Which streams of the camera are read."""

    width: int = 640
    height: int = 400
    rate_hz: float = 20.0
    imu_hz: int = 200


_STREAMS = _Streams()
# of OpenCV's rational polynomial; the device stores thin prisms and tilt behind them
_COEFFICIENTS = 8
_FISHEYE_COEFFICIENTS = 4


_PAUSE_S: Capacity[float] = 0.002  # where nothing has come


class OakSource:
    """A device, by its ID or the first one; see `LiveSource`.

    A frame's stamp is the middle of the left image's exposure.
    """

    image_size: tuple[int, int] | None = (_STREAMS.width, _STREAMS.height)

    def __init__(self, name: str) -> None:
        """Open the device and start it.

        Args:
            name: ID or IP address; empty: the first device.

        Raises:
            MissingDependencyError: depthai is not installed.
            DataError: there is no such device, or it has no calibration of a pair.
        """
        try:
            import depthai as dai
        except ImportError as error:
            raise MissingDependencyError(
                f"oak: needs the package depthai; {extra_text('oak')}"
            ) from error
        self._dai = dai
        self._name = f"oak:{name}"
        devices = dai.Device.getAllAvailableDevices()
        found = [info for info in devices if not name or name in (info.getDeviceId(), info.name)]
        if not found:
            have = ", ".join(info.getDeviceId() for info in devices) or "none"
            raise DataError(f"{self._name}: no such device; connected are: {have}; check the cable")
        try:
            self._open(found[0])
        except (
            RuntimeError
        ) as error:  # what depthai raises of a device and of a calibration that lacks an entry
            raise DataError(
                f"{self._name}: {error}; check the cable and its calibration"
            ) from error

    def _open(self, info: Any) -> None:
        dai = self._dai
        self._device = dai.Device(info)
        self._pipeline = dai.Pipeline(self._device)
        sockets = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C  # left and right
        self._images = [
            self._pipeline.create(dai.node.Camera)
            .build(socket)
            .requestOutput(
                (_STREAMS.width, _STREAMS.height),
                type=dai.ImgFrame.Type.GRAY8,
                fps=_STREAMS.rate_hz,
            )
            .createOutputQueue()
            for socket in sockets
        ]
        stored = self._device.readCalibration()
        self._imu: Any = None
        T_cam0_imu = None
        if self._device.getConnectedIMU() not in ("", "NONE"):
            node = self._pipeline.create(dai.node.IMU)
            node.enableIMUSensor(
                [dai.IMUSensor.ACCELEROMETER_RAW, dai.IMUSensor.GYROSCOPE_RAW], _STREAMS.imu_hz
            )
            node.setBatchReportThreshold(1)
            node.setMaxBatchReports(10)
            self._imu = node.out.createOutputQueue()
            T_cam0_imu = _metres(stored.getImuToCameraExtrinsics(sockets[0]))
        lenses = [self._lens(stored, socket) for socket in sockets]
        self.has_imu = self._imu is not None
        self.rig: Rig | None = Rig(
            lenses[0], lenses[1], _metres(stored.getCameraExtrinsics(*sockets)), T_cam0_imu
        )
        self._pipeline.start()

    def _lens(self, stored: Any, socket: Any) -> CameraModel:
        """Return the lens of a camera as the device has stored it.

        Raises:
            DataError: it is none of OpenCV's models, or lacks its coefficients.
        """
        K = np.array(
            stored.getCameraIntrinsics(socket, _STREAMS.width, _STREAMS.height), dtype=np.float64
        )
        models = self._dai.CameraModel
        model = stored.getDistortionModel(socket)
        # depthai ends the process where it is asked for those of a fisheye lens that has none
        values = list(stored.getEepromData().cameraData[socket].distortionCoeff)
        if model == models.Fisheye:
            if len(values) < _FISHEYE_COEFFICIENTS:
                raise DataError(
                    f"{self._name}: a fisheye lens with {len(values)} stored coefficients, where "
                    f"{_FISHEYE_COEFFICIENTS} are needed; calibrate the device, or give "
                    "--calibration FILE"
                )
            found = values[:_FISHEYE_COEFFICIENTS]
            return camera_from_matrix(
                K, _STREAMS.width, _STREAMS.height, "equidistant", found, self._name
            )
        if model != models.Perspective:
            raise DataError(
                f"{self._name}: its lens model {getattr(model, 'name', model)} is not known; give "
                "--calibration FILE"
            )
        if any(values[_COEFFICIENTS:]):
            raise DataError(
                f"{self._name}: its lens model has thin prisms or tilt; give --calibration FILE"
            )
        kind: DistortionModel = "radtan" if values else "pinhole"
        return camera_from_matrix(
            K, _STREAMS.width, _STREAMS.height, kind, values[:_COEFFICIENTS], self._name
        )

    def _imu_packets(self) -> list[Any]:
        """Return the packets of samples that have come."""
        if self._imu is None:
            messages = []
        else:
            messages = self._imu.tryGetAll()
        return [packet for message in messages for packet in message.packets]

    def events(self) -> Iterator[SourceEvent | None]:
        """Yield pairs and samples.

        Raises:
            DataError: nothing has come for seconds.
        """
        imu = ImuInterpolation()
        last_s = time.monotonic()
        middle = self._dai.CameraExposureOffset.MIDDLE
        pairing: Pairing[tuple[int, Image]] = Pairing()
        while True:
            packets = self._imu_packets()
            came = bool(packets)
            for packet in packets:
                for take, read in (
                    (imu.accel, packet.acceleroMeter),
                    (imu.gyro, packet.gyroscope),
                ):
                    yield from take(
                        _ns(read.getTimestampDevice()), np.array([read.x, read.y, read.z])
                    )
            for side, images in enumerate(self._images):
                for message in images.tryGetAll():
                    came = True
                    image = np.asarray(message.getCvFrame(), dtype=np.uint8)
                    # what two cameras share is the end of their exposures, the plain stamp
                    end_ns = _ns(message.getTimestampDevice())
                    middle_ns = _ns(message.getTimestampDevice(middle))
                    pair = pairing.add(side, end_ns, (middle_ns, image))
                    if pair is not None:
                        _, (time_ns, left), (_, right) = pair
                        yield SourceFrame(time_ns, left, right)
            if came:
                last_s = time.monotonic()
                continue
            if time.monotonic() - last_s > LOST_S:
                raise DataError(f"{self._name}: nothing for {LOST_S:.0f} s; check the cable")
            time.sleep(_PAUSE_S)
            yield None

    def close(self) -> None:
        """Stop the device."""
        self._pipeline.stop()
        self._device.close()


def _metres(T_cm: Any) -> Any:
    """Return extrinsics (4, 4) of the device, which are in centimetres, in metres."""
    T = np.array(T_cm, dtype=np.float64)
    T[:3, 3] *= 0.01
    return T


def _ns(stamp: Any) -> int:
    """Return a time of depthai, a timedelta, in nanoseconds; it has microseconds."""
    return (stamp.days * 86_400 + stamp.seconds) * 1_000_000_000 + stamp.microseconds * 1000
