"""Helpers shared by the readers: integer clocks, events in time order, checked calibrations and
archives.
"""

from __future__ import annotations

import contextlib
import lzma
import math
import struct
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from tokenize import TokenError
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.datasets.frame_times import used_frames
from vio.datasets.samples import MotionSamples, motion_samples
from vio.errors import CalibrationError, DataError
from vio.files.inputs import check_regular
from vio.files.text import check_increasing
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Tolerance
from vio.records import NS_PER_S, BoolArray, Event, IntArray, MotionSample, Recording, StereoFrame


class _GravityRules(NamedTuple):
    """When readings hold gravity."""

    # m/s^2; by what accelerations and biases move the median of a motion's readings
    usual_mps2: float = 9.81
    max_off_mps2: float = 1.5


_GRAVITY_RULES = _GravityRules()
# the largest published course file takes 140 MB; a bomb of kilobytes claims terabytes
_MAX_ARRAY_BYTES = 2**31
# What a damaged or encrypted archive also raises: an unknown compression, a header that is no
# literal.
_DAMAGE = (
    RuntimeError,
    MemoryError,
    TypeError,
    SyntaxError,
    TokenError,
    lzma.LZMAError,
    struct.error,
)
_EXACT_ENTRY: Tolerance[float] = 1e-8  # tolerance of the zeros and the one of an intrinsic matrix


def check_gravity_column(values: FloatArray, where: str, form: str, remedy: str) -> None:
    """Raise DataError where gravity is among the gyro's columns of readings (N, 6) and not among
    the accelerometer's.

    Args:
        values: in the order of `form`, rad/s and m/s^2.
        where: the file.
        form: what its columns are, for the message.
        remedy: what to do.
    """
    first, second = (float(np.median(np.linalg.norm(values[:, k : k + 3], axis=1))) for k in (0, 3))
    if (
        abs(first - _GRAVITY_RULES.usual_mps2)
        < _GRAVITY_RULES.max_off_mps2
        < abs(second - _GRAVITY_RULES.usual_mps2)
    ):
        raise DataError(
            f"{where}: gravity is in the columns 2 to 4 (median {first:.2f}), where {form} has the "
            f"gyro; {remedy}"
        )


def seconds_to_ns(seconds: npt.ArrayLike) -> IntArray:
    """Integer nanoseconds (N,) of float seconds (N,); whole seconds are split off first, so that
    no digit is lost.
    """
    s = np.asarray(seconds, dtype=np.float64)
    whole = np.floor(s)
    return whole.astype(np.int64) * NS_PER_S + np.rint((s - whole) * NS_PER_S).astype(np.int64)


def clock_ns(seconds: npt.ArrayLike, where: Callable[[int], str]) -> IntArray:
    """Convert float seconds (N,) to nanoseconds (N,) and check that they are finite and increasing.

    Args:
        seconds: times, seconds.
        where: returns the location of an entry for the error message ("times.txt, line 3").

    Raises:
        DataError: the message names the entry.
    """
    s = np.asarray(seconds, dtype=np.float64)
    bad = ~np.isfinite(s) | (np.abs(s) > 9e9)
    if bad.any():
        k = int(np.argmax(bad))
        raise DataError(
            f"{where(k)}: the time {s[k]:g} is not a time in seconds; write a finite number there"
        )
    return check_increasing(seconds_to_ns(s), where)


def numbers_in(text: str, count: int, where: str) -> FloatArray:
    """Parse the numbers (count,) in one entry of a calibration file.

    Raises:
        CalibrationError: the count is wrong, or a value is not a finite number.
    """
    try:
        values = np.array([float(value) for value in text.split()])
    except ValueError as error:
        raise CalibrationError(
            f"{where} holds no number ({error}); copy the calibration again"
        ) from error
    if values.shape != (count,):
        raise CalibrationError(
            f"{where} holds {len(values)} values, expected {count}; copy it again"
        )
    if not np.isfinite(values).all():
        raise CalibrationError(f"{where} holds values that are not finite; copy it again")
    return values


def check_intrinsics(K: FloatArray, where: str) -> None:
    """Raise CalibrationError unless K (3, 3) is an intrinsic matrix with positive focal lengths."""
    form = np.allclose(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1], atol=_EXACT_ENTRY)
    if not (form and K[0, 0] > 0 and K[1, 1] > 0):
        raise CalibrationError(
            f"{where} is no intrinsic matrix [fu 0 cu; 0 fv cv; 0 0 1], fu and fv positive, but "
            f"{K.tolist()}; "
            "check the order"
        )


def image_size(values: Sequence[float], where: str) -> tuple[int, int]:
    """Return width and height in whole pixels from a calibration.

    Raises:
        CalibrationError: they are not positive whole numbers.
    """
    if not all(math.isfinite(value) and value >= 1 and value == int(value) for value in values):
        raise CalibrationError(
            f"{where}: an image of {values[0]:g} x {values[1]:g} pixels; give whole, positive "
            "numbers"
        )
    width, height = (int(value) for value in values)
    return width, height


def finite_rows(values: FloatArray, what: str) -> FloatArray:
    """Return per-frame values (F, k) after checking that all are finite.

    Raises:
        DataError: a value is not finite; the message begins with `what`, which names file and
            variable.
    """
    bad: BoolArray = np.asarray(~np.isfinite(values).all(axis=1))
    if bad.any():
        raise DataError(
            f"{what} is not finite in {int(bad.sum())} of {len(bad)} frames, first in frame "
            f"{int(np.argmax(bad))}; "
            "remove or repair them"
        )
    return values


def shape_text(array: np.ndarray) -> str:
    """Format the shape of an array for a message: '4 x 3', or 'one value'."""
    return " x ".join(map(str, array.shape)) or "one value"


@contextlib.contextmanager
def naming(where: Path | str) -> Iterator[None]:
    """Prefix a CalibrationError raised within the block with its location."""
    try:
        yield
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error


def frame_range(recording: Recording, start: int, stop: int | None) -> range:
    """Return the frame numbers `start <= index < stop` of the recording.

    Raises:
        DataError: the range is empty or begins after the last frame.
    """
    count = len(recording.frame_times_ns)
    end = count if stop is None else min(stop, count)
    if not 0 <= start < end:
        limit = "the end" if stop is None else str(stop)
        raise DataError(
            f"{recording.path}: holds frames 0 to {count - 1}; none is between start {start} and "
            f"{limit}"
        )
    return range(start, end)


def chosen_frames(
    recording: Recording, start: int, stop: int | None, most_hz: float | None
) -> Sequence[int]:
    """Return the frames `start <= index < stop` that a limit on the frame rate lets through,
    increasing.

    Which ones does not depend on `start`, so that a run that goes on takes the frames that it would
    have taken.

    Args:
        recording: the frame times.
        start: first frame number.
        stop: after the last one; None: the end.
        most_hz: frames a second; None: no limit.

    Raises:
        DataError: the range is empty or begins after the last frame, or the limit lets none of it
            through.
    """
    chosen = frame_range(recording, start, stop)
    if most_hz is None:
        return chosen
    taken = [k for k in used_frames(recording.frame_times_ns, most_hz).tolist() if k in chosen]
    if not taken:
        raise DataError(
            f"{recording.path}: dataset.max_frame_rate {most_hz:g} leaves no frame of {start} to "
            f"{chosen.stop}; take "
            "more frames, or raise it"
        )
    return taken


def blank_frames(recording: Recording, chosen: Sequence[int]) -> Generator[StereoFrame]:
    """Yield chosen frames without their images."""
    for index in chosen:
        yield StereoFrame(index, int(recording.frame_times_ns[index]), None, None)


def merge_events(
    recording: Recording,
    chosen: Sequence[int],
    motion: Sequence[MotionSample],
    frames: Generator[StereoFrame],
) -> Iterator[Event]:
    """Yield the motion samples and chosen frames in time order, a sample before a frame of the same
    time.

    Raw IMU begins a second before the first frame, so that an estimator can determine gravity
    before the first image, and ends with the first sample at or after the last frame, so that
    readings can be interpolated to its exposure.

    Args:
        recording: the frame times.
        chosen: frame numbers, increasing.
        motion: samples of the whole recording, in time order.
        frames: the frames of the range, in time order; some may be missing. The generator is closed
            at the end.
    """
    first_ns, last_ns = (int(recording.frame_times_ns[k]) for k in (chosen[0], chosen[-1]))
    samples = _samples_between(motion_samples(motion), first_ns, last_ns)
    given = 0
    with contextlib.closing(frames):
        for frame in frames:
            until = int(samples.times_ns.searchsorted(frame.time_ns, side="right"))
            yield from samples.records(slice(given, until))
            given = max(given, until)
            yield frame
    yield from samples.take(slice(given, None))


def _samples_between(
    motion: MotionSamples[MotionSample], first_ns: int, last_ns: int
) -> MotionSamples[MotionSample]:
    """Return the samples that go with the frames between two times, see `merge_events`."""
    times_ns = motion.times_ns
    is_imu = motion.is_imu
    after = times_ns[is_imu & (times_ns >= last_ns)]
    begin_ns = np.where(is_imu, first_ns - NS_PER_S, first_ns)
    end_ns = np.where(is_imu, after[0] if len(after) else last_ns, last_ns)
    inside = (begin_ns <= times_ns) & (times_ns <= end_ns)
    if not inside.any():
        return motion.take(inside)
    span = slice(int(inside.argmax()), len(inside) - int(inside[::-1].argmax()))
    around = motion.take(span)  # no copy of an hour of samples, where all of them belong to it
    if inside[span].all():
        return around
    return around.take(inside[span])


def npz_names(path: Path) -> frozenset[str]:
    """Return the names of the arrays in an `.npz`.

    Raises:
        DataError: the file is missing, corrupt or no archive.
    """
    with _open_npz(path) as archive:
        return frozenset(name.removesuffix(".npy") for name in archive.namelist())


def read_npz(path: Path, keys: Iterable[str] | None = None) -> Mapping[str, np.ndarray]:
    """Read those of some arrays that an `.npz` holds, without pickle; others are not read at all.

    Args:
        path: the archive.
        keys: names of the arrays; None: all.

    Raises:
        DataError: the file is missing, corrupt, no archive, holds pickled objects, or its arrays
            would take more than 2 GiB.
    """
    with _open_npz(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        wanted = {
            key: members[key] for key in (members if keys is None else keys) if key in members
        }
        check_array_bytes({key: info.file_size for key, info in wanted.items()}, path)
        return {key: _read_member(archive, info) for key, info in wanted.items()}


def check_array_bytes(sizes: Mapping[str, int], path: Path) -> None:
    """Raise DataError if arrays of these sizes in bytes take more memory than a recording may."""
    if (total := sum(sizes.values())) > _MAX_ARRAY_BYTES:
        largest = max(sizes, key=lambda key: sizes[key])
        raise DataError(
            f"{path}: its arrays take {total / 2**30:.1f} GiB ({largest} alone "
            f"{sizes[largest] / 2**30:.1f}), more "
            f"than {_MAX_ARRAY_BYTES / 2**30:g} GiB; split the recording"
        )


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """Read one array; its header must not state more than the archive says that it holds."""
    with archive.open(info) as stream:
        major = np.lib.format.read_magic(stream)[0]
        read_header = (
            np.lib.format.read_array_header_1_0
            if major == 1
            else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read_header(stream)
        if math.prod(shape) * dtype.itemsize > info.file_size:
            raise ValueError(
                f"{info.filename} states the shape {shape}, but has {info.file_size} bytes"
            )
    with archive.open(info) as stream:
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


@contextlib.contextmanager
def _open_npz(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive; what goes wrong inside the block is a DataError that names the file."""
    try:
        check_regular(path)
        if not zipfile.is_zipfile(path) and path.is_file():
            raise DataError(
                f"{path}: is damaged or no .npz archive of named arrays; copy it again, or give "
                "another file"
            )
        with zipfile.ZipFile(path) as archive:
            yield archive
    except (ValueError, zipfile.BadZipFile, zlib.error, EOFError, KeyError, *_DAMAGE) as error:
        why = "holds pickled objects" if "pickle" in str(error) else "is damaged"
        remedy = (
            "save it again as plain numeric arrays with numpy.savez"
            if "pickle" in str(error)
            else "copy it again"
        )
        raise DataError(f"{path}: {why} ({' '.join(str(error).split())}); {remedy}") from error
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}; give a readable file"
        ) from error


def begins_as_zip(path: Path) -> bool:
    """Return whether a file begins as an archive such as `.npz`."""
    with path.open("rb") as stream:
        return stream.read(2) == b"PK"
