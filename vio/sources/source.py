"""What a live source is, and which there are."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal, Protocol, TypeAlias

from vio.cameras.rig import Rig
from vio.errors import ConfigError
from vio.geometry.lie import FloatArray
from vio.imu.two_sensors import GAPS
from vio.numerics.kinds import Capacity
from vio.records import Image, ImuSample

# without an image or sample, after which a device has gone
LOST_S = 5.0
_HELD_SAMPLES: Capacity[int] = 4000  # of a gyro beside a silent accelerometer: seconds

Layout: TypeAlias = Literal["side-by-side", "top-bottom", "single"]
# images beside and below one another in a picture
IN_A_PICTURE: dict[Layout, tuple[int, int]] = {
    "side-by-side": (2, 1),
    "top-bottom": (1, 2),
    "single": (1, 1),
}


@dataclass(frozen=True, slots=True)
class SourceFrame:
    """Images of one exposure, raw as the camera gives them."""

    time_ns: int
    left: Image  # (H, W) uint8
    right: Image | None  # None: one camera


# samples on the IMU's own clock as the rig states it
SourceEvent: TypeAlias = "SourceFrame | ImuSample"


class LiveSource(Protocol):
    """A camera, with or without an IMU."""

    # the calibration that the device has stored; None: it has none, and the user gives one
    rig: Rig | None
    has_imu: bool  # whether samples come
    image_size: tuple[int, int] | None  # width and height of one image; None: not known yet

    def events(self) -> Iterator[SourceEvent | None]:
        """Yield frames and samples as they come, each kind in order of time; None at least each
        second without any.

        It ends where the source ends.

        Raises:
            DataError: the device does not deliver any more.
        """

    def close(self) -> None:
        """Let the device go."""


_NETWORK = ("rtsp", "http", "https", "udp", "tcp")
# Module and class of each kind, imported when it is needed.
SOURCES = {
    **dict.fromkeys(("v4l2", "video", *_NETWORK), "video:VideoSource"),
    "realsense": "realsense:RealSenseSource",
    "oak": "oak:OakSource",
}


def is_recorded(name: str) -> bool:
    """Tell whether a source is a file, which gives its frames as fast as they are taken."""
    scheme, _, rest = name.partition(":")
    return scheme in ("video", "realsense") and Path(rest).is_file()


def _whole(layout: Layout, size: tuple[int, int]) -> tuple[int, int]:
    """Return width and height of a picture of images of a size."""
    across, down = IN_A_PICTURE[layout]
    return across * size[0], down * size[1]


def layout_hint(layout: Layout, half: tuple[int, int], size: tuple[int, int]) -> str:
    """Return why the images of a video have another width and height than a calibration.

    Args:
        layout: by which the picture was taken apart.
        half: of an image.
        size: of the calibration.
    """
    whole = _whole(layout, half)
    text = f"the picture is {whole[0]}x{whole[1]} pixels"
    if layout != "single":
        text += f", and each image {layout} in it {half[0]}x{half[1]}"
    other = next((name for name in IN_A_PICTURE if _whole(name, size) == whole), None)
    if other == "single":
        why = "it is that of one camera: give --layout single, with an IMU, or the camera that sends both"
    elif other is not None:
        why = f"give --layout {other}"
    elif half[0] * size[1] == half[1] * size[0]:
        why = "let the camera send that size, or give the calibration of this one"
    else:
        why = "check that calibration and camera belong together, and --layout"
    return f"{text}, but the calibration is for {size[0]}x{size[1]}; {why}"


def _no_source(name: str) -> ConfigError:
    """Return the error for a name without a kind of source, with the name that may be meant."""
    known = f"give one of {', '.join(f'{scheme}:' for scheme in SOURCES)}"
    path = Path(name)
    if name.isdigit() or name.startswith("/dev/video"):
        known = f"did you mean v4l2:{name}?"
    elif path.is_dir():
        known = f"is it a recording: vio run {name}?"
    elif path.is_file():
        known = f"did you mean video:{name}?"
    elif name in SOURCES:
        known = f"did you mean {name}:?"
    elif " ! " in name:
        known += "; pipelines of GStreamer are not taken: let one send rtsp: or udp:"
    return ConfigError(f"{name!r} is no live source; {known}")


def open_source(name: str, layout: Layout = "side-by-side") -> LiveSource:
    """Open a source by its name.

    Args:
        name: `v4l2:/dev/video0`, `video:FILE`, a URL that OpenCV opens (`rtsp://…`),
            `realsense:[SERIAL or FILE.bag]`, `oak:[ID]`.
        layout: how the two images of a pair lie in one video.

    Raises:
        ConfigError: there is no such kind of source.
        DataError: the device is absent or cannot be opened.
        MissingDependencyError: its package is not installed.
    """
    scheme, colon, rest = name.partition(":")
    if not colon or scheme not in SOURCES:
        raise _no_source(name)
    module, kind = SOURCES[scheme].split(":")
    made: Callable[..., LiveSource] = getattr(import_module(f"vio.sources.{module}"), kind)
    if module == "video":
        return made(name if scheme in _NETWORK else rest, layout)
    return made(rest)


class ImuInterpolation:
    """Holds samples of the gyro until the accelerometer has samples around them.

    The accelerometer's readings are interpolated linearly; samples of the gyro before its first
    one, and in a gap of it, are left out, as where both are joined in a file
    (`vio.imu.two_sensors`).
    """

    def __init__(self) -> None:
        self._gyro: deque[tuple[int, FloatArray]] = deque(maxlen=_HELD_SAMPLES)
        self._accel: deque[tuple[int, FloatArray]] = deque()
        self._accel_step_ns = 0  # the shortest so far

    def gyro(self, time_ns: int, value: FloatArray) -> Iterator[ImuSample]:
        """Take a sample (3,) rad/s of the gyro; yield what is complete."""
        if not self._gyro or time_ns > self._gyro[-1][0]:
            self._gyro.append((time_ns, value))
        yield from self._complete()

    def accel(self, time_ns: int, value: FloatArray) -> Iterator[ImuSample]:
        """Take a sample (3,) m/s^2 of the accelerometer; yield what is complete."""
        step_ns = time_ns - self._accel[-1][0] if self._accel else 0
        if not self._accel or step_ns > 0:
            self._accel.append((time_ns, value))
        if step_ns > 0:
            self._accel_step_ns = min(step_ns, self._accel_step_ns or step_ns)
        yield from self._complete()

    def _complete(self) -> Iterator[ImuSample]:
        longest_ns = max(GAPS.usual_intervals * self._accel_step_ns, GAPS.min_ns)
        while self._gyro and self._accel and self._gyro[0][0] <= self._accel[-1][0]:
            time_ns, gyro = self._gyro.popleft()
            while len(self._accel) > 1 and self._accel[1][0] <= time_ns:
                self._accel.popleft()
            (t0, a0) = self._accel[0]
            (t1, a1) = self._accel[min(1, len(self._accel) - 1)]
            if time_ns < t0 or t1 - t0 > longest_ns:
                continue
            share = (time_ns - t0) / (t1 - t0) if t1 > t0 else 0.0
            yield ImuSample(time_ns, gyro, a0 + share * (a1 - a0))
