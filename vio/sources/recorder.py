"""Keeps what a live source gives as a plain folder or a ROS 2 bag, so that the run can be
repeated.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import cv2

from vio.cameras.rig import Rig
from vio.datasets.bags.writer import bag_writer
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import DataError
from vio.files.atomic import atomic_write_text
from vio.files.text import exact_text, seconds_text
from vio.numerics.kinds import Capacity
from vio.sources.source import SourceEvent, SourceFrame

Form: TypeAlias = Literal["plain", "rosbag2", "mcap"]

_WAITING: Capacity[int] = 100  # frames that may wait for the disk; beyond, the source waits
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # fast
_CAMERAS = ("cam0", "cam1")
IMU_HEADER = "timestamp [ns],wx,wy,wz,ax,ay,az\n"


@dataclass(frozen=True, slots=True)
class Recorded:
    """What a source gives."""

    pair: bool  # whether there is a right image
    imu: bool


class Recorder:
    """Writes images, times, samples and the calibration, in a thread of its own."""

    def __init__(
        self,
        folder: Path,
        rig: Rig | None,
        form: Form = "plain",
        recorded: Recorded | None = None,
    ) -> None:
        """Begin a recording.

        Args:
            folder: new or empty.
            rig: calibration of the raw images; None: it is not known yet, and none is written.
            form: a plain folder, which is whole up to its last frame however it ends, or a bag,
                which has to be closed.
            recorded: what the source gives; None: what the rig has.

        Raises:
            DataError: the folder holds something, or cannot be written.
        """
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise DataError(f"{folder}: is not empty; give --record a new folder")
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._unwritable(error) from error
        if rig is not None:
            name = "camchain.yaml" if rig.T_cam0_imu is None else "camchain-imucam.yaml"
            atomic_write_text(folder / name, kalibr_text(rig))
            recorded = recorded or Recorded(rig.cam1 is not None, rig.T_cam0_imu is not None)
        assert recorded is not None, "a source without a rig says what it gives"
        if form == "plain":
            self._open = _plain(folder, recorded)
        else:
            self._open = _bag(folder, form)
        self._events: queue.SimpleQueue[SourceEvent | None] = queue.SimpleQueue()
        self._room = threading.Semaphore(_WAITING)
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
            self._room.acquire()
        self._events.put(event)

    def close(self) -> None:
        """Wait for what is not yet written.

        Raises:
            DataError: something could not be written.
        """
        self._events.put(None)
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        try:
            with self._open as write:
                while (event := self._events.get()) is not None:
                    write(event)
                    if isinstance(event, SourceFrame):
                        self._room.release()
        except OSError as error:
            self._failure = self._unwritable(error)
        except Exception as error:  # noqa: BLE001 # raised by the next call
            self._failure = error
        self._room.release(1)  # who waits for room is the only one, and raises with its next event

    def _unwritable(self, error: OSError) -> DataError:
        return DataError(
            f"{self._folder}: cannot be written: {error.strerror}; check disk and rights"
        )


@contextlib.contextmanager
def _plain(folder: Path, recorded: Recorded) -> Iterator[Callable[[SourceEvent], None]]:
    """Open `left/`, `right/`, `times.txt` and `imu.csv`; times and samples are written out each
    frame.
    """
    for name in ("left", "right") if recorded.pair else ("left",):
        (folder / name).mkdir()
    with contextlib.ExitStack() as stack:
        times = stack.enter_context((folder / "times.txt").open("w", encoding="utf-8"))
        imu = None
        if recorded.imu:
            imu = stack.enter_context((folder / "imu.csv").open("w", encoding="utf-8"))
            imu.write(IMU_HEADER)

        def write(event: SourceEvent) -> None:
            if not isinstance(event, SourceFrame):
                if imu is not None:
                    imu.write(f"{event.time_ns},{exact_text([*event.gyro, *event.accel], ',')}\n")
                return
            for name, image in (("left", event.left), ("right", event.right)):
                path = folder / name / f"{event.time_ns:019d}.png"
                if image is not None and not cv2.imwrite(str(path), image, _PNG):
                    raise DataError(f"{path}: cannot be written; check the free space of the disk")
            times.write(f"{seconds_text(event.time_ns)}\n")
            times.flush()
            if imu is not None:
                imu.flush()

        yield write


@contextlib.contextmanager
def _bag(
    folder: Path, storage: Literal["rosbag2", "mcap"]
) -> Iterator[Callable[[SourceEvent], None]]:
    """Open a bag with the topics of EuRoC's; the calibration is the file beside it."""
    with bag_writer(folder, storage) as bag:

        def write(event: SourceEvent) -> None:
            if not isinstance(event, SourceFrame):
                bag.imu("/imu0", "imu", event)
                return
            for name, image in zip(_CAMERAS, (event.left, event.right), strict=True):
                if image is not None:
                    bag.image(f"/{name}/image_raw", name, event.time_ns, image)

        yield write
