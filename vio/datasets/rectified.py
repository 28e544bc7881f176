"""Recordings of real, unrectified cameras: frames are rectified as they are read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vio.datasets.common import frame_range, merge_events
from vio.datasets.images import BadFrame, UnreadableImageError, load_gray, readable_frames
from vio.datasets.settings import DatasetSettings, Interpolation
from vio.errors import CalibrationError, DataError
from vio.geometry.distortion import StereoRig
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.rectify import MapArray, rectified_pair, rectify
from vio.geometry.stereo import StereoCamera
from vio.records import Event, Image, IntArray, MotionSample, Observations, Recording, StereoFrame

_PNG_LEVEL = 1  # files a tenth larger than at the usual level 3, in a third of the time


@dataclass(frozen=True, slots=True)
class ImuDensities:
    """Noise of an inertial measurement unit as its calibration states it (continuous time)."""

    gyro: float  # white noise, rad/s/sqrt(Hz)
    gyro_walk: float  # bias random walk, rad/s^2/sqrt(Hz)
    accel: float  # white noise, m/s^2/sqrt(Hz)
    accel_walk: float  # bias random walk, m/s^3/sqrt(Hz)


@dataclass(frozen=True, slots=True)
class Rectifier:
    """How raw images of a rig become rectified ones."""

    rig: StereoRig
    camera: StereoCamera  # rectified
    T_rect0_imu: FloatArray  # (4, 4)
    maps: tuple[tuple[MapArray, MapArray], tuple[MapArray, MapArray]] | None  # left, right; None: nothing to do
    interpolation: Interpolation

    def __call__(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Rectify one raw pair, each image (H, W) as large as its camera's."""
        if self.maps is None:
            return left, right
        return _remap(left, self.maps[0], self.interpolation), _remap(right, self.maps[1], self.interpolation)


def make_rectifier(rig: StereoRig, interpolation: Interpolation, where: Path) -> Rectifier:
    """Prepare the rectification of a rig; one that is rectified already is passed through untouched.

    Args:
        rig: both cameras as calibrated.
        interpolation: how gray values between pixels are found.
        where: the calibration's place, for messages.

    Raises:
        CalibrationError: the cameras coincide, look apart, are swapped, or share no field of view.
    """
    if (pair := rectified_pair(rig)) is not None:
        return Rectifier(rig, pair, se3_inverse(rig.T_imu_cam0), None, interpolation)
    try:
        done = rectify(rig)
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error
    return Rectifier(rig, done.camera, done.T_rect0_imu, (done.map0, done.map1), interpolation)


def _remap(image: Image, maps: tuple[MapArray, MapArray], interpolation: Interpolation) -> Image:
    import cv2

    codes = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos4": cv2.INTER_LANCZOS4}
    # The maps stay inside the image, so the border is met by the outermost taps of the interpolation only.
    out = cv2.remap(image, maps[0], maps[1], codes[interpolation], borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class RectifiedDataset:
    """Implements `vio.protocols.Dataset` over image files of real cameras; its frames are rectified."""

    recording: Recording
    pairs: tuple[tuple[Path, Path], ...]  # left and right image of each frame, raw
    motion: tuple[MotionSample, ...]  # in time order
    rectifier: Rectifier
    calibrated_in: tuple[Path, Path]  # files that state the raw size of the left and the right image
    settings: DatasetSettings
    imu_noise: ImuDensities | None = None

    def events(self, start: int = 0, stop: int | None = None, *, images: bool = True) -> Iterator[Event]:
        """Yield events of the frames `start <= index < stop` in time order.

        A frame with an unreadable image is left out with a warning, up to `max_bad_frames` of them.

        Raises:
            DataError: the range holds no frame, an image has not the calibrated size, or too many are unreadable.
        """
        chosen = frame_range(self.recording, start, stop)
        frames = (
            readable_frames(self._load, chosen, self.settings)
            if images
            else (self._frame(k, None, None) for k in chosen)
        )
        return merge_events(self.recording, chosen, self.motion, frames)

    def observations(self, index: int) -> Observations | None:
        """Return None: the recording holds images only."""
        return None

    def _frame(self, index: int, left: Image | None, right: Image | None) -> StereoFrame:
        return StereoFrame(index, int(self.recording.frame_times_ns[index]), left, right)

    def _load(self, index: int) -> StereoFrame | BadFrame:
        """Read and rectify one frame; runs in the prefetch thread."""
        try:
            left, right = (load_gray(path)[0] for path in self.pairs[index])
        except UnreadableImageError as error:
            return BadFrame(index, str(error))
        rig = self.rectifier.rig
        for image, path, camera, calibration in zip(
            (left, right), self.pairs[index], (rig.cam0, rig.cam1), self.calibrated_in, strict=True
        ):
            if image.shape != (camera.height, camera.width):
                raise DataError(
                    f"{path} is {image.shape[1]} x {image.shape[0]} pixels but {calibration} is for {camera.width} x "
                    f"{camera.height}; give the calibration of these images"
                )
        return self._frame(index, *self.rectifier(left, right))


def refuse_rectified(dataset: RectifiedDataset) -> None:
    """Raise DataError where a recording is rectified already, so that rectifying it would only copy it."""
    if dataset.rectifier.maps is None:
        raise DataError(
            f"{dataset.recording.path} is rectified already (equal pinhole cameras, rows aligned): there is nothing to "
            "do; use it as it is"
        )


def write_frames(
    dataset: RectifiedDataset, name: Callable[[StereoFrame, int], tuple[Path, Path]], progress: Callable[[], None]
) -> IntArray:
    """Write every readable frame as two PNG files; return the times (N,) of those written.

    Args:
        dataset: what to rectify.
        name: the two files of a frame, given the frame and how many were written before it; folders must exist.
        progress: called after each frame.

    Raises:
        DataError: too many images are unreadable, or one has the wrong size.
    """
    times: list[int] = []
    for frame in _only_frames(dataset.events()):
        assert frame.left is not None
        assert frame.right is not None
        for path, image in zip(name(frame, len(times)), (frame.left, frame.right), strict=True):
            path.write_bytes(_png(image))
        times.append(frame.time_ns)
        progress()
    if not times:
        raise DataError(f"{dataset.recording.path}: no frame could be read; see the warnings above")
    return np.array(times, dtype=np.int64)


def _only_frames(events: Iterable[Event]) -> Iterator[StereoFrame]:
    return (event for event in events if isinstance(event, StereoFrame))


def _png(image: Image) -> bytes:
    import cv2

    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    return bytes(data.tobytes())
