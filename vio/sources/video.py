"""Webcams, network cameras and videos, by OpenCV: the two images of a pair lie in one picture."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from vio.cameras.rig import Rig
from vio.errors import DataError
from vio.numerics.kinds import Capacity
from vio.records import Image
from vio.sources.source import IN_A_PICTURE, Layout, SourceEvent, SourceFrame

_MAX_FAILED = 50  # reads in a row without an image, after which a device has gone
_PAUSE_S: Capacity[float] = 0.02  # between them


class VideoSource:
    """A device, a URL or a file that OpenCV opens; see `LiveSource`.

    A file's frames have the times of the file and come as fast as they are taken; those of a device
    or a URL have the time at which they arrived, on the computer's monotonic clock.
    """

    rig: Rig | None = None  # a video has no calibration
    has_imu = False

    def __init__(self, name: str, layout: Layout) -> None:
        """Open it.

        Args:
            name: /dev/video0, its number, a URL, or a file.
            layout: how the two images lie in one picture.

        Raises:
            DataError: it cannot be opened.
        """
        self._name = name
        self._layout = layout
        self._is_file = Path(name).is_file()
        device = name.isdigit() or name.startswith("/dev/")
        path = Path(f"/dev/video{name}" if name.isdigit() else name)
        if device and not path.exists():
            have = ", ".join(str(path) for path in sorted(Path("/dev").glob("video*"))) or "none"
            raise DataError(f"{path}: there is no such device; video devices are: {have}")
        where = int(name) if name.isdigit() else name
        if device:
            self._video = cv2.VideoCapture(where, cv2.CAP_V4L2)
        else:
            self._video = cv2.VideoCapture(where)
        if not self._video.isOpened():
            raise DataError(f"{name}: OpenCV cannot open it; {self._remedy(path, device=device)}")
        self.image_size = self._size_of_a_half()

    def _remedy(self, path: Path, *, device: bool) -> str:
        if device:
            return "check that it is a camera, and that no other program uses it"
        if self._is_file:
            return "check that it is a video, and play it with another program"
        if "://" in self._name:
            return "check address, user and password, and that the camera sends"
        return "it is a folder" if path.is_dir() else "there is no such file"

    def _size_of_a_half(self) -> tuple[int, int] | None:
        """Return width and height of one image as the video states them; None: it does not."""
        width = round(self._video.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = round(self._video.get(cv2.CAP_PROP_FRAME_HEIGHT))
        across, down = IN_A_PICTURE[self._layout]
        width //= across
        height //= down
        return (width, height) if width > 0 and height > 0 else None

    def events(self) -> Iterator[SourceEvent | None]:
        """Yield frames until the file ends.

        Raises:
            DataError: a device does not deliver any more, or the picture cannot be halved.
        """
        failed = 0
        while True:
            grabbed = self._video.grab()
            arrived_ns = time.monotonic_ns()
            read, picture = self._video.retrieve() if grabbed else (False, None)
            if not read or picture is None:
                if self._is_file:
                    return
                failed += 1
                if failed > _MAX_FAILED:
                    raise DataError(
                        f"{self._name}: no image for {failed * _PAUSE_S:.0f} s; check the cable or "
                        "the network"
                    )
                time.sleep(_PAUSE_S)
                yield None
                continue
            failed = 0
            stamp_ns = (
                round(1e6 * self._video.get(cv2.CAP_PROP_POS_MSEC)) if self._is_file else arrived_ns
            )
            yield SourceFrame(stamp_ns, *self._halves(np.asarray(picture, dtype=np.uint8)))

    def _halves(self, picture: Image) -> tuple[Image, Image | None]:
        """Return the left and the right image (H, W) of a picture (H, W, 3) BGR or (H, W)."""
        gray = (
            np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
            if picture.ndim == 3
            else picture
        )
        if self._layout == "single":
            return gray, None
        axis = 1 if self._layout == "side-by-side" else 0
        if gray.shape[axis] % 2:
            raise DataError(
                f"{self._name}: {gray.shape[1]}x{gray.shape[0]} is no picture of two images "
                f"{self._layout}"
            )
        left, right = (np.ascontiguousarray(half) for half in np.split(gray, 2, axis=axis))
        return left, right

    def close(self) -> None:
        """Let the device go."""
        self._video.release()
