"""Checks of what a live program gives: times, samples and images as arrays of the types that the
filter takes.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.datasets.feature_forms import features_fault, without_placeholders
from vio.datasets.frame_times import FrameRateLimit
from vio.errors import ConfigError, DataError, OrderError
from vio.filters.inputs import LARGEST
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import (
    Image,
    ImuSample,
    IntArray,
    MotionSample,
    MotionSource,
    Observations,
    VelocitySample,
    feature_tracks,
    observations,
)


class _StampRules(NamedTuple):
    """Which stamps of a live program are doubted."""

    max_ns: int = 2**62  # differences of times stay within 64 bits
    # a stamp so far ahead, and so many times the last step, is to be confirmed
    jump_ns: int = 2_000_000_000
    jump_steps: int = 5
    # Steps that are shorter from the start are of another unit: frames at 2 kHz, samples at 100
    # kHz.
    min_frame_step_ns: int = 500_000
    min_sample_step_ns: int = 10_000
    short_steps: int = 2  # in a row before the unit is doubted: two frames may share an arrival


_STAMPS = _StampRules()


# numbers of frames of features, from the start, after which all so far are examined together
_EXAMINED_AFTER = (3, 10)

Kind: TypeAlias = Literal["stereo", "mono", "rgbd"]
# height and width of each camera's images; None: any
Shapes: TypeAlias = "tuple[tuple[int, int] | None, ...]"

_CAME = {"stereo": "two images", "mono": "one image", "rgbd": "an image with depths"}
_TAKES = {
    "stereo": "two images; give both, or load_rig(..., cameras=1)",
    "mono": "one image without depth_m; depths need a rig with a depth_factor",
    "rgbd": "an image with its depth_m",
}


@dataclass(frozen=True, slots=True)
class GivenFrame:
    """A frame as a program gave it, checked and numbered."""

    index: int
    time_ns: int
    images: tuple[npt.NDArray[np.uint8], ...] = ()  # left, right: (H, W) gray or (H, W, 3) BGR
    depth_m: FloatArray | None = None
    seen: Observations | None = None  # in the place of images


class Inputs:
    """Checks, copies and numbers what a live program gives; a call that raises has changed nothing.

    Frames may come from one thread and samples from another, each in order of time.
    """

    def __init__(
        self,
        camera: StereoCamera,
        shapes: Shapes,
        motion: MotionSource | None,
        offset_ns: int,
        most_hz: float | None,
        say: Callable[[str], None],
    ) -> None:
        """Begin a trajectory.

        Args:
            camera: the rectified one; its kind says what a frame consists of.
            shapes: of the images, as they are given.
            motion: the sensor that samples may come from; None: none.
            offset_ns: subtracted from the samples' stamps, so that they are on the camera's clock.
            most_hz: frames a second that are used; None: all.
            say: takes a line about a stamp that is left out.
        """
        self._rectified = camera
        self._camera = camera.kind
        self._shapes = shapes
        self._motion = motion
        self._offset_ns = offset_ns
        self._limit = FrameRateLimit(most_hz)
        self._say = say
        self._frames = _Stamps("frame", _STAMPS.min_frame_step_ns)
        self._samples = _Stamps("sample", _STAMPS.min_sample_step_ns)
        self._count = 0  # of frames
        self._kind: str | None = None  # of frames: images or observations
        # features of the first frames, until all are examined; None: they were
        self._first_seen: list[Observations] | None = []

    def images(
        self,
        t_ns: Any,
        left: npt.ArrayLike,
        right: npt.ArrayLike | None = None,
        depth_m: npt.ArrayLike | None = None,
        *,
        copy: bool = True,
    ) -> GivenFrame | None:
        """Return a frame of images; None: its stamp jumps ahead, or it comes sooner than the frame
        rate allows.

        Without `copy`, contiguous arrays with memory of their own are taken as they are.

        Raises:
            DataError: a wrong type, shape or size, a time not after the last frame's, or images of
                another rig's kind.
        """
        if left is None:
            raise DataError(
                "the left image is None, as OpenCV's imread and VideoCapture.read return where "
                "nothing could be read"
            )
        given = "stereo" if right is not None else "mono" if depth_m is None else "rgbd"
        if given != self._camera:
            raise DataError(f"{_CAME[given]} came, but this rig takes {_TAKES[self._camera]}")
        images = self._checked_images(left, right)
        if depth_m is None:
            depth = None
        else:
            depth = checked_depths(depth_m, images[0].shape[:2])
        numbered = self._numbered(t_ns, "images")
        if numbered is None:
            return None
        for k, image in enumerate(images):
            if copy or not (image.flags.carray and image.flags.owndata):
                images[k] = _copied(image)
        return GivenFrame(*numbered, tuple(images), depth)

    def _checked_images(self, left: npt.ArrayLike, right: npt.ArrayLike | None) -> list[Image]:
        images = [_checked_image(left, "left", self._shapes[0])]
        if right is not None:
            images.append(_checked_image(right, "right", self._shapes[1]))
            if self._shapes[0] is None and images[0].shape[:2] != images[1].shape[:2]:
                sizes = [image.shape[:2] for image in images]
                raise DataError(f"the images differ in size: {sizes[0]} left, {sizes[1]} right")
        return images

    def observations(
        self, t_ns: Any, ids: npt.ArrayLike, z: npt.ArrayLike, has_right: npt.ArrayLike | None
    ) -> GivenFrame | None:
        """Return a frame of observations; None: as of `images`.

        Raises:
            DataError: shapes disagree, an id occurs twice, a pixel is not finite, a time not after
                the last one, or the first frames show pixels or ids that are not what they must be
                (`vio.datasets.feature_forms`).
        """
        seen = checked_observations(self._count, t_ns, ids, z, has_right)
        self._examine(seen)
        numbered = self._numbered(t_ns, "observations")
        if self._first_seen is not None:
            self._first_seen.append(seen)
            if len(self._first_seen) == _EXAMINED_AFTER[-1]:
                self._first_seen = None
        return (
            None
            if numbered is None
            else GivenFrame(*numbered, seen=replace(seen, time_ns=numbered[1]))
        )

    def _examine(self, seen: Observations) -> None:
        """Raise DataError where the features of the first frames, with these, are not rectified
        pixels of points with ids.
        """
        if self._first_seen is None:
            return
        so_far = [*self._first_seen, seen]
        if len(so_far) not in _EXAMINED_AFTER:
            return
        tracks, _ = without_placeholders(feature_tracks(dict(enumerate(so_far)), len(so_far)))
        if fault := features_fault(self._rectified, tracks):
            raise DataError(f"features of the first {len(so_far)} frames: {fault}")

    def samples(
        self, source: MotionSource, t_ns: Any, first: npt.ArrayLike, second: npt.ArrayLike
    ) -> list[MotionSample]:
        """Return samples on the camera's clock, without those whose stamps jump ahead.

        Args:
            source: the sensor.
            t_ns: time, or times (N,), in nanoseconds.
            first: gyro or linear velocity, (3,) or (N, 3).
            second: accelerometer or angular velocity, likewise.

        Raises:
            DataError: a wrong shape, a value that is not finite, or a time not after the last
                sample's.
            ConfigError: samples of this sensor are not used.
        """
        if self._motion != source:
            raise ConfigError(
                f"{source} samples came, but this odometry runs on motion "
                f"{self._motion or 'none'}; set the "
                "configuration's motion, and for an IMU give the rig its T_cam0_imu"
            )
        names = ("gyro", "accel") if source == "imu" else ("linear", "angular")
        times, rows = checked_samples(t_ns, dict(zip(names, (first, second), strict=True)))
        if times:
            self._samples.check_order(times[0])
            self._samples.check_steps(times)
        sample = ImuSample if source == "imu" else VelocitySample
        return [
            sample(time_ns - self._offset_ns, a, b)
            for time_ns, a, b in zip(times, *rows, strict=True)
            if self._samples.takes(time_ns, self._say)
        ]

    def _numbered(self, t_ns: Any, kind: str) -> tuple[int, int] | None:
        """Return the number and the time of a frame; None: it is left out, and keeps its number."""
        time_ns = checked_time(t_ns)
        self._frames.check_order(time_ns)
        if self._kind not in (None, kind):
            raise DataError(f"{kind} came after {self._kind}; one trajectory takes one of them")
        self._kind = kind
        self._count += 1
        if not (self._frames.takes(time_ns, self._say) and self._limit.takes(time_ns)):
            return None
        return self._count - 1, time_ns


class _Stamps:
    """Leaves out a stamp that jumps ahead until the next one confirms it, lest all later ones be
    refused for it.
    """

    def __init__(self, of: str, min_step_ns: int) -> None:
        """Begin; no sensor gives `of` at steps below `min_step_ns` all the time."""
        self._of = of
        self._min_step_ns = min_step_ns
        self._short = 0  # steps so far, where all of them are shorter than that
        self._units_known = False  # one was longer
        self._last_ns: int | None = None  # taken
        self._refused_ns: int | None = None  # the last one, where steps are too short
        self._step_ns = 0
        self._held_ns: int | None = None  # left out

    def check_order(self, time_ns: int) -> None:
        """Raise DataError unless a stamp is after the last one that was taken."""
        if self._last_ns is not None and time_ns <= self._last_ns:
            raise OrderError(
                f"{self._of} at {time_ns} ns is not after the last one at {self._last_ns} ns; give "
                "them in order of "
                "time, each once"
            )
        self._check_unit(time_ns)

    def _check_unit(self, time_ns: int) -> None:
        """Raise DataError where all steps so far are too short for nanoseconds."""
        last_ns = self._last_ns
        if last_ns is None or self._units_known or self._short < _STAMPS.short_steps:
            return
        # Refused stamps count as well: steps over several of them are as long as right ones.
        if self._refused_ns is not None and last_ns < self._refused_ns < time_ns:
            last_ns = self._refused_ns
        self._refused_ns = time_ns
        self._refuse(time_ns - last_ns)

    def check_steps(self, times_ns: list[int]) -> None:
        """Raise DataError where all steps between several first stamps are too short."""
        if len(times_ns) > _STAMPS.short_steps and not self._units_known:
            self._refuse(max(b - a for a, b in pairwise(times_ns)))

    def _refuse(self, step_ns: int) -> None:
        """Raise DataError if a step is too short for nanoseconds."""
        if step_ns < self._min_step_ns:
            raise DataError(
                f"{self._of}s come {step_ns} ns apart, which no sensor does: the stamps are "
                "numbers, milliseconds or microseconds; give integer nanoseconds"
            )

    def takes(self, time_ns: int, say: Callable[[str], None]) -> bool:
        """Whether an event may be taken; its time is after the last one that was."""
        last_ns = self._last_ns
        step_ns = 0 if last_ns is None else time_ns - last_ns
        if step_ns > max(_STAMPS.jump_ns, _STAMPS.jump_steps * self._step_ns) and self._step_ns:
            if self._held_ns is None:
                since_held_ns = 0
            else:
                since_held_ns = time_ns - self._held_ns
            # as of a camera whose frames come so slowly, after a first step that was quicker
            is_as_long = 2 * since_held_ns >= step_ns - since_held_ns >= since_held_ns // 2 > 0
            if not (0 < since_held_ns <= _STAMPS.jump_ns or is_as_long):
                self._held_ns = time_ns
                say(
                    f"{self._of} at {time_ns} ns: its stamp is {step_ns * 1e-9:.1f} s ahead of the "
                    "last one; left out, "
                    "as are others so far ahead until two in a row agree"
                )
                return False
            step_ns = since_held_ns if is_as_long else self._step_ns
        if last_ns is not None:
            self._units_known |= step_ns >= self._min_step_ns
            self._short += 1
        self._last_ns = time_ns
        self._held_ns = None
        self._step_ns = step_ns or self._step_ns
        return True


def checked_time(t_ns: Any) -> int:
    """Return a time as an integer.

    Raises:
        DataError: it is none, or further from the epoch than 146 years.
    """
    try:
        time_ns = operator.index(t_ns)
    except TypeError as error:
        raise DataError(f"a time must be an integer number of nanoseconds, got {t_ns!r}") from error
    if abs(time_ns) > _STAMPS.max_ns:
        raise DataError(f"{time_ns} ns is no time of a clock; give nanoseconds")
    return time_ns


def checked_samples(
    t_ns: Any, values: dict[str, npt.ArrayLike]
) -> tuple[list[int], list[FloatArray]]:
    """Return times (N,) and arrays (N, 3) of one sample or several.

    Raises:
        DataError: a wrong shape or type, a value that is not finite, or times that do not increase.
    """
    # one sample, as drivers give it
    if hasattr(t_ns, "__index__") and not getattr(t_ns, "ndim", 0):
        time_ns = checked_time(t_ns)
        return [time_ns], [
            _checked_values(name, value, (3,), time_ns)[None] for name, value in values.items()
        ]
    times: IntArray = np.asarray(t_ns)
    if not np.issubdtype(times.dtype, np.integer) or times.ndim != 1:
        raise DataError(
            f"times must be integer nanoseconds, () or (N,), got {times.dtype} {times.shape}"
        )
    first_ns = times[0] if len(times) else 0
    rows = [
        _checked_values(name, value, (len(times), 3), first_ns) for name, value in values.items()
    ]
    if np.any((times > _STAMPS.max_ns) | (times < -_STAMPS.max_ns)):
        raise DataError(f"{times[0]} to {times[-1]} ns are no times of a clock; give nanoseconds")
    if (times[1:] <= times[:-1]).any():  # differences of unsigned ones are never negative
        raise DataError("times of samples must increase; sort them and give each once")
    return times.tolist(), rows


def _checked_values(
    name: str, value: npt.ArrayLike, shape: tuple[int, ...], time_ns: int
) -> FloatArray:
    """Return a copy of the values of samples, the first of which is at a time."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{name} is not numeric: {error}") from error
    if array.shape != shape:
        raise DataError(f"{name} has shape {array.shape}, expected {shape}")
    # Of a single sample, without NumPy's functions: they take a driver's thread several times as
    # long.
    fits = (
        all(abs(x) < LARGEST for x in array.tolist())
        if len(shape) == 1
        else (np.abs(array) < LARGEST).all()
    )
    if not fits:  # nor is NaN
        raise DataError(
            f"{name} at {time_ns} ns is not finite, or beyond any sensor ({LARGEST:g}): {array}"
        )
    return array


def checked_observations(
    index: int, time_ns: Any, ids: npt.ArrayLike, z: npt.ArrayLike, has_right: npt.ArrayLike | None
) -> Observations:
    """Return what a front end saw in a frame.

    Raises:
        DataError: shapes disagree, an id occurs twice, or a pixel that is seen is not finite or in
            no image.
    """
    try:
        seen = observations(index, 0, ids, z, has_right)
    except (ValueError, TypeError) as error:
        raise DataError(f"observations at {time_ns} ns: {error}") from error
    left = seen.z[:, :2]
    right = seen.z[seen.has_right, 2:]
    used = np.concatenate([left.ravel(), right.ravel()])
    wrong = int((~(np.abs(used) < LARGEST)).sum())
    if wrong:
        raise DataError(
            f"observations at {time_ns} ns: {wrong} pixels are not finite, or in no image"
        )
    return seen


def _copied(image: Image) -> Image:
    # Without letting another thread run, which would give way after 5 ms only.
    return np.frombuffer(bytearray(image.data), dtype=np.uint8).reshape(image.shape)


def _checked_image(
    image: npt.ArrayLike, name: str, shape: tuple[int, int] | None
) -> npt.NDArray[np.uint8]:
    """Return an image as it is, (H, W) gray or (H, W, 3) BGR, of the calibration's height and
    width.
    """
    array = np.asarray(image)
    if (
        array.dtype != np.uint8
        or not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3))
        or not array.size
    ):
        raise DataError(
            f"the {name} image has shape {array.shape} and type {array.dtype}; give uint8, (H, W) "
            "gray or (H, W, 3) BGR"
        )
    if shape is not None and array.shape[:2] != shape:
        raise DataError(
            f"the {name} image is {array.shape[1]}x{array.shape[0]}, but the calibration is for "
            f"{shape[1]}x{shape[0]}; check that calibration and camera belong together"
        )
    return array


def gray(image: npt.NDArray[np.uint8]) -> Image:
    """Return an image (H, W) gray or (H, W, 3) BGR as (H, W)."""
    if image.ndim == 2:
        return image
    import cv2

    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def checked_depths(depth_m: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return depths as (H, W) float64.

    Raises:
        DataError: they are not of the image's shape.
    """
    array = np.array(depth_m, dtype=np.float64)
    if array.shape != shape:
        raise DataError(
            f"the depths have shape {array.shape}, but the image {shape}; register them to the "
            "image"
        )
    return array
