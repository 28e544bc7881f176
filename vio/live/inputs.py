"""Checks of what a live program gives: times, samples and images as arrays of the types that the filter takes."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
import numpy.typing as npt

from vio.errors import DataError
from vio.filters.inputs import LARGEST
from vio.geometry.lie import FloatArray
from vio.records import Image, IntArray, Observations, observations

_MOST_NS = 2**62  # differences of times stay within 64 bits
_JUMP_NS, _JUMP_STEPS = 2_000_000_000, 5  # a stamp so far ahead, and so many times the last step, is to be confirmed


class JumpGuard:
    """Leaves out a stamp that jumps ahead until the next one confirms it, lest all later ones be refused for it."""

    def __init__(self) -> None:
        self._last_ns: int | None = None  # taken
        self._step_ns = 0
        self._held_ns: int | None = None  # left out

    def takes(self, time_ns: int) -> bool:
        """Whether an event may be taken; its time is after the last one that was."""
        last_ns = self._last_ns
        step_ns = 0 if last_ns is None else time_ns - last_ns
        if step_ns > max(_JUMP_NS, _JUMP_STEPS * self._step_ns) and self._step_ns:
            confirmed = self._held_ns is not None and 0 < time_ns - self._held_ns <= _JUMP_NS
            if not confirmed:
                self._held_ns = time_ns
                return False
            step_ns = self._step_ns
        self._last_ns, self._held_ns = time_ns, None
        self._step_ns = step_ns or self._step_ns
        return True

    @property
    def ahead_s(self) -> float:
        """By how much the stamp that was left out is ahead of the last one."""
        assert self._held_ns is not None
        assert self._last_ns is not None
        return (self._held_ns - self._last_ns) * 1e-9


def checked_time(t_ns: Any) -> int:
    """Return a time as an integer.

    Raises:
        DataError: it is none, or further from the epoch than 146 years.
    """
    try:
        time_ns = operator.index(t_ns)
    except TypeError as error:
        raise DataError(f"a time must be an integer number of nanoseconds, got {t_ns!r}") from error
    if abs(time_ns) > _MOST_NS:
        raise DataError(f"{time_ns} ns is no time of a clock; give nanoseconds")
    return time_ns


def checked_samples(t_ns: Any, values: dict[str, npt.ArrayLike]) -> tuple[list[int], list[FloatArray]]:
    """Return times (N,) and arrays (N, 3) of one sample or several.

    Raises:
        DataError: a wrong shape or type, a value that is not finite, or times that do not increase.
    """
    times: IntArray = np.asarray(t_ns)
    if not np.issubdtype(times.dtype, np.integer) or times.ndim > 1:
        raise DataError(f"times must be integer nanoseconds, () or (N,), got {times.dtype} {times.shape}")
    rows = []
    for name, value in values.items():
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise DataError(f"{name} is not numeric: {error}") from error
        if array.shape != (*times.shape, 3):
            raise DataError(f"{name} has shape {array.shape}, expected {(*times.shape, 3)}")
        if not (np.abs(array) < LARGEST).all():  # nor is NaN
            at = f"{name} at {np.atleast_1d(times)[0]} ns"
            raise DataError(f"{at} is not finite, or beyond any sensor ({LARGEST:g}): {array}")
        rows.append(array.reshape(-1, 3).copy())
    if times.ndim == 0 and abs(time_ns := int(times)) <= _MOST_NS:  # one sample, as drivers give it
        return [time_ns], rows
    times = np.atleast_1d(times)
    if np.any((times > _MOST_NS) | (times < -_MOST_NS)):
        raise DataError(f"{times[0]} to {times[-1]} ns are no times of a clock; give nanoseconds")
    if (np.diff(times) <= 0).any():
        raise DataError("times of samples must increase; sort them and give each once")
    return times.tolist(), rows


def checked_observations(
    index: int, time_ns: Any, ids: npt.ArrayLike, z: npt.ArrayLike, has_right: npt.ArrayLike | None
) -> Observations:
    """Return what a front end saw in a frame.

    Raises:
        DataError: shapes disagree, an id occurs twice, or a pixel that is seen is not finite or in no image.
    """
    try:
        seen = observations(index, 0, ids, z, has_right)
    except (ValueError, TypeError) as error:
        raise DataError(f"observations at {time_ns} ns: {error}") from error
    used = np.concatenate([seen.z[:, :2].ravel(), seen.z[seen.has_right, 2:].ravel()])
    wrong = int((~(np.abs(used) < LARGEST)).sum())
    if wrong:
        raise DataError(f"observations at {time_ns} ns: {wrong} pixels are not finite, or in no image")
    return seen


def check_image(image: npt.ArrayLike, name: str) -> npt.NDArray[np.uint8]:
    """Return an image as it is, (H, W) gray or (H, W, 3) BGR.

    Raises:
        DataError: it is neither 8-bit gray nor BGR.
    """
    array = np.asarray(image)
    if array.dtype != np.uint8 or not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)) or not array.size:
        raise DataError(
            f"the {name} image has shape {array.shape} and type {array.dtype}; give uint8, (H, W) gray or (H, W, 3) BGR"
        )
    return array


def gray(image: npt.ArrayLike, name: str) -> Image:
    """Return an image as (H, W) uint8.

    Raises:
        DataError: it is neither 8-bit gray nor BGR.
    """
    array = check_image(image, name)
    if array.ndim == 3:
        import cv2

        array = np.asarray(cv2.cvtColor(array, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    return np.array(array, dtype=np.uint8, order="C")  # a copy: the caller may fill its buffer again


def checked_depths(depth_m: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return depths as (H, W) float64.

    Raises:
        DataError: they are not of the image's shape.
    """
    array = np.array(depth_m, dtype=np.float64)
    if array.shape != shape:
        raise DataError(f"the depths have shape {array.shape}, but the image {shape}; register them to the image")
    return array


def check_size(image: npt.NDArray[np.uint8], expected: tuple[int, int], name: str) -> None:
    """Raise DataError unless an image has the height and width that the calibration states."""
    if image.shape[:2] != expected:
        raise DataError(
            f"the {name} image is {image.shape[1]}x{image.shape[0]}, but the calibration is for "
            f"{expected[1]}x{expected[0]}; check that calibration and camera belong together"
        )
