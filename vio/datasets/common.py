"""What the readers share: integer clocks, events in time order, checked transforms and text tables."""

from __future__ import annotations

import contextlib
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vio.errors import CalibrationError, DataError
from vio.geometry.lie import FloatArray, nearest_rotation, se3_from_parts
from vio.records import Event, ImuSample, IntArray, MotionSample, Recording, StereoFrame, VelocitySample

NS_PER_S = 10**9
_ROTATION_TOLERANCE = 1e-3  # largest entry of R^T R - I that is still read as rounding
_EXACT = 1e-12  # rotations this close to orthonormal keep their bits


def seconds_to_ns(seconds: npt.ArrayLike) -> IntArray:
    """Integer nanoseconds (N,) of float seconds (N,); whole seconds are split off first, so that no digit is lost."""
    s = np.asarray(seconds, dtype=np.float64)
    whole = np.floor(s)
    return whole.astype(np.int64) * NS_PER_S + np.rint((s - whole) * NS_PER_S).astype(np.int64)


def clock_ns(seconds: npt.ArrayLike, where: Callable[[int], str]) -> IntArray:
    """Turn float seconds (N,) into nanoseconds (N,), refusing a clock that is not finite or does not increase.

    Args:
        seconds: times, seconds.
        where: names the entry of a given number, for the message ("times.txt, line 3").

    Raises:
        DataError: the message names the entry.
    """
    s = np.asarray(seconds, dtype=np.float64)
    bad = ~np.isfinite(s) | (np.abs(s) > 9e9)
    if bad.any():
        k = int(np.argmax(bad))
        raise DataError(f"{where(k)}: the time {s[k]:g} is not a time in seconds; write a finite number there")
    times_ns = seconds_to_ns(s)
    steps = np.diff(times_ns)
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0)) + 1
        what = "repeats" if steps[k - 1] == 0 else "runs backwards"
        raise DataError(
            f"{where(k)}: the clock {what} ({s[k]:.9f} s after {s[k - 1]:.9f} s); remove or reorder that entry"
        )
    return times_ns


def checked_transform(T: npt.ArrayLike, where: str) -> FloatArray:
    """Return a rigid transform (4, 4) whose rotation is orthonormal to rounding.

    Args:
        T: (4, 4) or its first three rows.
        where: names the file and the entry, for the message.

    Raises:
        CalibrationError: entries are not finite, or the rotation stretches, shears or mirrors.
    """
    T_ = np.asarray(T, dtype=np.float64)
    if T_.shape not in ((3, 4), (4, 4)) or not np.isfinite(T_).all():
        raise CalibrationError(f"{where}: not a finite 3x4 or 4x4 transform (shape {T_.shape}); check the calibration")
    if T_.shape == (4, 4) and not np.allclose(T_[3], [0, 0, 0, 1], atol=1e-9):
        raise CalibrationError(f"{where}: the last row of the transform is {T_[3].tolist()}, not 0 0 0 1")
    R = T_[:3, :3]
    deviation = float(np.abs(R.T @ R - np.eye(3)).max())
    if not deviation <= _ROTATION_TOLERANCE:
        raise CalibrationError(
            f"{where}: not a rotation (R^T R differs from identity by {deviation:.2g}); check the calibration"
        )
    if np.linalg.det(R) < 0:
        raise CalibrationError(f"{where}: not a rotation but a reflection (determinant -1); check the axes' order")
    return se3_from_parts(R if deviation <= _EXACT else nearest_rotation(R), T_[:3, 3])


def velocity_samples(times_ns: IntArray, linear: FloatArray, angular: FloatArray) -> tuple[VelocitySample, ...]:
    """Build samples from times (N,), m/s (N, 3) and rad/s (N, 3), all in the imu frame."""
    return tuple(
        VelocitySample(int(t), v, w)
        for t, v, w in zip(times_ns.tolist(), np.ascontiguousarray(linear), np.ascontiguousarray(angular), strict=True)
    )


def frame_range(recording: Recording, start: int, stop: int | None) -> range:
    """The frame numbers `start <= index < stop` that the recording has.

    Raises:
        DataError: the range is empty or begins past the last frame.
    """
    count = len(recording.frame_times_ns)
    end = count if stop is None else min(stop, count)
    if not 0 <= start < end:
        asked = "the end" if stop is None else str(stop)
        raise DataError(f"{recording.path}: holds frames 0 to {count - 1}; none lies between start {start} and {asked}")
    return range(start, end)


def merge_events(
    recording: Recording, chosen: range, motion: Sequence[MotionSample], frames: Generator[StereoFrame]
) -> Iterator[Event]:
    """Yield the motion samples and frames of a range in time order, a sample before a frame of the same time.

    Raw IMU begins a second before the first frame, so that an estimator can see gravity before it sees an image.

    Args:
        recording: names the frames' times.
        chosen: frame numbers.
        motion: samples of the whole recording, in time order.
        frames: the frames of the range, in time order; some may be missing. Closed at the end.
    """
    first_ns, last_ns = (int(recording.frame_times_ns[k]) for k in (chosen[0], chosen[-1]))
    begins = {ImuSample: first_ns - NS_PER_S, VelocitySample: first_ns}
    samples = iter([sample for sample in motion if begins[type(sample)] <= sample.time_ns <= last_ns])
    waiting = next(samples, None)
    with contextlib.closing(frames):
        for frame in frames:
            while waiting is not None and waiting.time_ns <= frame.time_ns:
                yield waiting
                waiting = next(samples, None)
            yield frame
    if waiting is not None:
        yield waiting
        yield from samples


def read_numbers(path: Path, columns: int, *, separator: str | None = None, skip: int = 0) -> FloatArray:
    """Read a text table of numbers (N, columns), skipping the first `skip` lines and blank ones at the end.

    Raises:
        DataError: the file cannot be read, or a line holds something else; the message names the line.
    """
    rows: list[list[float]] = []
    for number, line in text_lines(path)[skip:]:
        fields = line.split(separator)
        if len(fields) != columns:
            raise DataError(f"{path}, line {number}: {len(fields)} values where {columns} belong")
        try:
            rows.append([float(value) for value in fields])
        except ValueError as error:
            raise DataError(f"{path}, line {number}: not a number ({error}); write plain decimals") from error
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def text_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a text file with their numbers from 1, blank lines at its end dropped.

    Raises:
        DataError: the file is missing or is no text.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file ({error.reason}); give the original file") from error
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    while lines and not lines[-1].strip():
        lines.pop()
    return list(enumerate(lines, start=1))


def read_npz(path: Path) -> Mapping[str, np.ndarray]:
    """All arrays of an `.npz`, without pickle.

    Raises:
        DataError: the file is missing, damaged, no archive, or holds pickled objects.
    """
    try:
        loaded = np.load(path, allow_pickle=False)
        if not isinstance(loaded, np.lib.npyio.NpzFile):
            raise DataError(f"{path}: one array, not an .npz archive of named arrays")
        with loaded as archive:
            return {key: archive[key] for key in archive.files}
    except (ValueError, zipfile.BadZipFile, zlib.error, EOFError, KeyError) as error:
        why = "holds pickled objects" if "pickle" in str(error) else "is damaged or no .npz archive"
        remedy = "save it again as plain numeric arrays with numpy.savez" if "pickle" in str(error) else "copy it again"
        raise DataError(f"{path}: {why} ({' '.join(str(error).split())}); {remedy}") from error
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
