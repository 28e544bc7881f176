"""Keeps what a live source gives as a plain folder, so that the run can be repeated."""

from __future__ import annotations

import queue
import threading
from pathlib import Path

import cv2

from vio.cameras.rig import Rig
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import DataError
from vio.files.atomic import atomic_write_text
from vio.files.text import exact_text, seconds_text
from vio.records import Image
from vio.sources.source import SourceEvent, SourceFrame

_WAITING = 100  # frames that may wait for the disk; beyond, the source waits
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # fast
IMU_HEADER = "timestamp [ns],wx,wy,wz,ax,ay,az\n"


class Recorder:
    """Writes `left/`, `right/`, `times.txt`, `imu.csv` and the calibration, in a thread of its own.

    Times and samples are written out each frame, so that a recording that ended early is whole up to its last frame.
    """

    def __init__(self, folder: Path, rig: Rig) -> None:
        """Begin a recording.

        Args:
            folder: new or empty.
            rig: calibration of the raw images.

        Raises:
            DataError: the folder holds something, or cannot be written.
        """
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise DataError(f"{folder}: is not empty; give --record a new folder")
        self._folder = folder
        names = ("left",) if rig.cam1 is None else ("left", "right")
        try:
            for name in names:
                (folder / name).mkdir(parents=True)
            imu = rig.T_cam0_imu is not None
            atomic_write_text(folder / ("camchain-imucam.yaml" if imu else "camchain.yaml"), kalibr_text(rig))
            self._times = (folder / "times.txt").open("w", encoding="utf-8")
            self._imu = (folder / "imu.csv").open("w", encoding="utf-8") if imu else None
        except OSError as error:
            raise DataError(f"{folder}: cannot be written: {error.strerror}; check disk and rights") from error
        if self._imu is not None:
            self._imu.write(IMU_HEADER)
        self._frames: queue.Queue[SourceFrame | None] = queue.Queue(_WAITING)
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="record", daemon=True)
        self._thread.start()

    def add(self, event: SourceEvent) -> None:
        """Take a frame or a sample.

        Raises:
            DataError: an earlier one could not be written.
        """
        if self._failure is not None:
            raise self._failure
        if isinstance(event, SourceFrame):
            self._frames.put(event)
        elif self._imu is not None:
            self._imu.write(f"{event.time_ns},{exact_text([*event.gyro, *event.accel], ',')}\n")

    def close(self) -> None:
        """Wait for what is not yet written.

        Raises:
            DataError: something could not be written.
        """
        self._frames.put(None)
        self._thread.join()
        self._times.close()
        if self._imu is not None:
            self._imu.close()
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        while (frame := self._frames.get()) is not None:
            if self._failure is None:
                self._write(frame)

    def _write(self, frame: SourceFrame) -> None:
        for name, image in (("left", frame.left), ("right", frame.right)):
            if image is not None:
                self._write_image(self._folder / name / f"{frame.time_ns:019d}.png", image)
        self._times.write(f"{seconds_text(frame.time_ns)}\n")
        self._times.flush()
        if self._imu is not None:
            self._imu.flush()

    def _write_image(self, path: Path, image: Image) -> None:
        if not cv2.imwrite(str(path), image, _PNG):
            self._failure = DataError(f"{path}: cannot be written; check the free space of the disk")
