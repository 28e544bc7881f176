"""When the images of a folder were taken, and which belong together: by a list of times, or by
their names.

What a file states goes before what a name looks like: `data.csv` names each image beside its time,
in the unit of its header. Names alone are read by their size, and by how far apart frames can be.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from vio.datasets.frame_times import PAIRED_NS, nearest, pair_stamps
from vio.datasets.image_files import FilePairs, ImageFiles, stem_of
from vio.datasets.image_pairs import ImagePairs
from vio.datasets.images import SUFFIXES, list_images
from vio.datasets.lost_images import CountedApart
from vio.datasets.sides import frame_words, pairs_of, side_word, split_sides, without_side
from vio.datasets.tables import drive_times, is_date, table_rows
from vio.datasets.unused import Layout
from vio.errors import DataError
from vio.files.dates import dates_in_names
from vio.files.stamps import ASSUMED_STEP_NS, FRAME_PACE, check_digits, parse_stamps
from vio.files.text import text_lines
from vio.files.units import TIME_UNITS, time_unit, time_unit_in_words
from vio.numerics.robust import median
from vio.records import NS_PER_S, IntArray

_MIN_LEFT_OUT = 10  # numbers between the last image and the first one of such a recording
_MIN_FULL = 999  # the largest number of a camera's counter has so many nines, or more
TIME_LISTS = ("times.txt", "timestamps.txt", "times.csv", "timestamps.csv", "left_images.txt")
# in the names of lists of times that are not those of images
_OTHER_TIMES = frozenset(
    (
        "imu", "gyro", "accel", "mag", "baro", "gps", "gnss", "lidar", "velodyne", "radar", "sonar",
        "depth", "events", "wheel", "wheels", "encoder", "encoders", "odom", "odometry", "pose", "poses",
        "mocap", "vicon", "groundtruth", "ground", "gt", "truth", "exposure", "exposures", "shutter",
        "processing",
    )
)  # fmt: skip
_LARGEST_COUNT = 10**9  # of frames: a year at 30 a second
_TIMED = 100  # images, of which names that are times show it
_LIST_FORM = "timestamp [ns], filename"
_NUMBER = r"\d+(?:\.\d*)?(?:[eE][+-]?\d+)?"
# `cam0_1403636579763555584`, `stereo_front_left_315966070522`, `1403636579763555584_left`,
# `1700000001.33713`, `17000000013371ms`, `000012_1403636579763555584`, with the number of the frame, and
# `1403636579_763555584`, seconds and nanoseconds
_STAMP = re.compile(
    # words, a number of theirs, or the frame's
    r"(?:(?:[A-Za-z]+\d?(?:[_-][A-Za-z]+\d?)*(?:[_-]\d{1,7})?|(?P<number>\d{1,7}))[_-])?"
    r"(?P<time>\d{10,19}|\d{1,10}\.\d{1,9}|1\d{9}[_-]\d{1,9})(?:_?(?P<unit>ns|us|ms|s))?"
    r"(?:[_-][A-Za-z]+\d?)?"
)
# Since 1970: milliseconds to nanoseconds, or seconds with a point.
_SINCE_1970 = re.compile(r"\d{13,19}|\d{9,10}\.\d{1,9}")
_SECONDS = re.compile(r"\d{9,10}(\.\d{1,9})?")  # whose zeros may be cut, and the point with them
# `000000_cam0`: the camera's number behind that of the frame
_OF_CAMERA = re.compile(
    r"(.*\d)[_-](?:cam(?:era)?|infra(?:red)?|image|img|left|right)[_-]?\d?", re.I
)


def pair_files(lefts: ImageFiles, rights: ImageFiles) -> tuple[ImagePairs, tuple[str, ...]]:
    """Pair image files by equal names, by stamps in their names, by names without their camera
    (`000012_cam0`), or by the last number in them.

    Raises:
        DataError: the names share nothing.
    """
    keys = _keys_of_lists(lefts, rights) or _partner_keys(lefts, rights)
    right_of = {key: k for k, key in enumerate(keys[1])}
    if len(right_of) < len(rights) and -1 not in right_of:
        raise DataError(
            f"{rights[0].parent}: several images have the same number; number them uniquely"
        )
    rows = [(k, right_of[key]) for k, key in enumerate(keys[0]) if key in right_of]
    pairs = FilePairs(lefts.take(k for k, _ in rows), rights.take(k for _, k in rows))
    if not pairs:
        _check_stamps_apart(lefts, rights)
        raise DataError(
            f"{lefts[0].parent} and {rights[0].parent}: no name of the one fits one of the other "
            f"({lefts[0].name}, "
            f"{rights[0].name}); give both images of a pair the same name or number"
        )
    alone = len(lefts) - len(pairs), len(rights) - len(pairs)
    rolled = rolled_doubt(lefts)
    if not any(alone):
        return pairs, rolled
    skipped = f"{alone[0]} left and {alone[1]} right images have no partner and are skipped"
    return pairs, (skipped, *rolled, *_shift_doubt(lefts, rights, rows))


def counted_apart(lefts: ImageFiles, rights: ImageFiles, pairs: ImagePairs) -> CountedApart | None:
    """Return all files where those of one number are paired, the first ones have one number, no number
    is left out, and one camera has more images; None: their names tell which belong together.
    """
    if len(lefts) == len(rights) or len(pairs) != min(len(lefts), len(rights)):
        return None
    if any(_last_number(left) != _last_number(right) for left, right in (pairs[0], pairs[-1])):
        return None  # paired by times
    numbers = [[_last_number(file) for file in files] for files in (lefts, rights)]
    first = numbers[0][0]
    if not isinstance(first, int) or any(
        found != list(range(first, first + len(found))) for found in numbers
    ):
        return None
    return None if _name_times(lefts) is not None else CountedApart(lefts, rights)


def rolled_doubt(files: ImageFiles) -> tuple[str, ...]:
    """Doubt the order of images whose numbers are 0 and the largest of their digits, with one hole
    between them: as of a counter that began again at 0.
    """
    numbers = [re.findall(r"\d+", stem_of(name))[-1:] for name in files.names]
    widths = {len(number[0]) for number in numbers if number}
    if len(widths) != 1 or not all(numbers):
        return ()
    width = widths.pop()
    found = np.array([int(number[0]) for number in numbers])
    steps = np.diff(found)
    if found[0] != 0 or found[-1] != 10**width - 1 or (steps <= 0).any():
        return ()
    usual = int(median(steps))
    holes = np.flatnonzero(steps != usual)
    if len(holes) != 1:
        return ()
    last, first = (files.names[int(holes[0]) + k] for k in (0, 1))
    return (
        f"{files.folder}: doubtful: images are taken in the order of their numbers, which lack those "
        f"between {last} and {first}; if the counter began again at 0, {first} is the first image: "
        "number them on",
    )


def _shift_doubt(
    lefts: ImageFiles, rights: ImageFiles, rows: Sequence[tuple[int, int]]
) -> tuple[str, ...]:
    """Doubt pairs of equal numbers, not of equal times, where the first images of one camera and the
    last of the other have no partner, and no others: as where each counts its own from another
    number.

    Args:
        lefts: all left images, in order.
        rights: all right images, in order.
        rows: the left and the right image of each pair.
    """
    first = rows[0]
    last = rows[-1]
    before = first[0], first[1]
    after = len(lefts) - 1 - last[0], len(rights) - 1 - last[1]
    shifted = (before[0] and after[1] and not (before[1] or after[0])) or (
        before[1] and after[0] and not (before[0] or after[1])
    )
    held = len(lefts) - len(rows) == before[0] + after[0]
    held = held and len(rights) - len(rows) == before[1] + after[1]
    if not (shifted and held) or _name_times(lefts) is not None:
        return ()
    early, late = ("left", "right") if before[0] else ("right", "left")
    frames = max(before)
    apart = "a frame" if frames == 1 else f"{frames} frames"
    return (
        f"{lefts.folder} and {rights.folder}: doubtful: images of one number are paired, and the "
        f"first {frames} {early} and the last {max(after)} {late} ones have none; if each camera "
        f"counts its own images, those of a pair are {apart} apart: give them one number",
    )


def _check_stamps_apart(lefts: ImageFiles, rights: ImageFiles) -> None:
    """Raise DataError where the names of both are times, which are too far apart for a pair."""
    left_ns = _name_times(lefts)
    right_ns = _name_times(rights)
    if left_ns is None or right_ns is None:
        return
    apart_ms = median((right_ns[nearest(left_ns, right_ns)] - left_ns) / 1e6)
    raise DataError(
        f"{lefts[0].parent} and {rights[0].parent}: the times that images are named by are "
        f"{apart_ms:+.4g} ms apart (right from left, median), and those of a pair must be within "
        f"{PAIRED_NS / 1e6:g} ms; if they are of one exposure, give both the same name"
    )


def _partner_keys(lefts: ImageFiles, rights: ImageFiles) -> list[list[str | int]]:
    """Return what left and right files are paired by; -1: no left file's."""
    keys: list[list[str | int]] = [[p.stem for p in lefts], [p.stem for p in rights]]
    shared = len(set(keys[0]) & set(keys[1]))
    left_ns = _name_times(lefts)
    right_ns = _name_times(rights)
    if left_ns is not None and right_ns is not None and 2 * shared < min(len(lefts), len(rights)):
        return _keys_of_times(left_ns, right_ns)
    return keys if shared else _keys_in_names(lefts, rights)


def _keys_of_lists(lefts: ImageFiles, rights: ImageFiles) -> list[list[str | int]] | None:
    """Return what files are paired by where each camera has its own list of times, and these pair more
    of them than their names; None: names decide.
    """
    left_ns = _own_times(lefts, rights.folder)
    right_ns = _own_times(rights, lefts.folder)
    if left_ns is None or right_ns is None:
        return None
    right_of = {file.stem: k for k, file in enumerate(rights)}
    rows = [(k, right_of[file.stem]) for k, file in enumerate(lefts) if file.stem in right_of]
    left_rows, right_rows = np.array(rows, dtype=np.int64).reshape(-1, 2).T
    apart_ns = np.abs(right_ns[right_rows] - left_ns[left_rows])
    keys = _keys_of_times(left_ns, right_ns)
    by_time = sum(key != -1 for key in keys[1])
    return keys if by_time > int((apart_ns <= PAIRED_NS).sum()) else None


def _own_times(files: ImageFiles, other: Path) -> IntArray | None:
    """Return the times (F,) of all images of a camera by a list in its folder or the one above it,
    which is not that of the other camera's images; None: it has none.
    """
    folders = [f for f in (files.folder, files.folder.parent) if f not in (other, other.parent)]
    named = (f / name for f in folders for name in (*TIME_LISTS, "data.csv"))
    file = next((file for file in named if file.is_file()), None)
    if file is None:
        return None
    with contextlib.suppress(DataError):
        if file.name == "data.csv":
            return _listed_times(file, files, [])
        return times_of(file, FilePairs(files, files))
    return None


def _keys_in_names(lefts: ImageFiles, rights: ImageFiles) -> list[list[str | int]]:
    """Return the names without their sides where some are shared then, else their last numbers."""
    for key_of in (without_side, _frame_of):
        keys: list[list[str | int]] = [
            [key_of(stem_of(name)) for name in files.names] for files in (lefts, rights)
        ]
        if set(keys[0]) & set(keys[1]):
            return keys
    return [[_last_number(p) for p in files] for files in (lefts, rights)]


def _frame_of(stem: str) -> str:
    """Return the words of an image's name without that of its side, separated by spaces."""
    return " ".join(frame_words(stem))


def _keys_of_times(left_ns: IntArray, right_ns: IntArray) -> list[list[str | int]]:
    """Return the rows of the left files, and for each right one that of the nearest left one."""
    rights: list[str | int] = [-1] * len(right_ns)
    a, b = pair_stamps(left_ns, right_ns)
    for i, j in zip(a.tolist(), b.tolist(), strict=True):
        rights[j] = i
    return [list(range(len(left_ns))), rights]


def _last_number(path: Path) -> int | str:
    of_camera = _OF_CAMERA.fullmatch(path.stem)
    found = re.findall(r"\d+", path.stem if of_camera is None else of_camera[1])
    return int(found[-1]) if found else path.stem


def _name_times(
    files: Sequence[Path], doubts: list[str] | None = None, *, since_1970_alone: bool = False
) -> IntArray | None:
    """Return the times (F,) that all files are named by; None: they are named by something else.

    Args:
        files: the images.
        doubts: where to note a unit that how far apart the frames are decided.
        since_1970_alone: whether other numbers, as those since a boot, are no times.

    Raises:
        DataError: nanoseconds lack their leading zeros.
    """
    dates_ns = dates_in_names([file.stem for file in files])
    if dates_ns is not None:
        return dates_ns if (np.diff(dates_ns) > 0).all() else None
    named = _stamps_in_names(files)
    if named is None:
        return None
    texts, unit, numbered = named
    stated = None if unit is None else TIME_UNITS[unit]
    seconds = _are_seconds(texts)
    if seconds:
        check_digits(texts, lambda k: str(files[k]))
    may_be_since_boot = not (since_1970_alone or numbered)
    since_boot = may_be_since_boot and (stated is not None or _could_be_times(texts))
    if not since_boot and not seconds and not all(map(_SINCE_1970.fullmatch, texts)):
        return None
    try:
        return parse_stamps(texts, lambda k: str(files[k]), stated, pace=FRAME_PACE, doubts=doubts)
    except DataError:  # numbers of something else, which do not increase
        return None


def _stamps_in_names(files: Sequence[Path]) -> tuple[list[str], str | None, bool] | None:
    """Return the stamps that all files are named by, the unit in their names, where there is one,
    and whether numbers of frames are beside them; None: some are named otherwise.
    """
    found = [match for file in files if (match := _STAMP.fullmatch(file.stem)) is not None]
    units = {match["unit"] for match in found}
    if len(found) < len(files) or len(units) != 1:
        return None
    texts = [match["time"] for match in found]
    apart = [re.fullmatch(r"(\d+)[_-](\d+)", text) for text in texts]
    if any(apart):
        # of nanoseconds a tenth has fewer digits without leading zeros; a frame's number has always fewer
        if not all(apart) or 2 * sum(len(part[2]) == 9 for part in apart if part) < len(apart):
            return None
        texts = [f"{part[1]}.{part[2]}" for part in apart if part]
    return texts, units.pop(), any(match["number"] for match in found)


def _are_seconds(texts: Sequence[str]) -> bool:
    """Tell whether all are times of a date in seconds, with decimals."""
    return any("." in text for text in texts) and all(map(_SECONDS.fullmatch, texts))


def _could_be_times(texts: Sequence[str]) -> bool:
    """Return whether numbers that are no times since 1970 can be times since a boot.

    Whole numbers of ten digits and more, in microseconds or nanoseconds, or decimals of seconds,
    as far apart as frames are; numbers of frames are one apart.
    """
    values = np.array([float(text) for text in texts])
    if len(values) < 2 or any(text.startswith("00") for text in texts):
        return False
    step = median(np.diff(values))
    if all("." in text for text in texts):
        return FRAME_PACE.least_s <= step <= FRAME_PACE.most_s
    return step * 1e-6 >= FRAME_PACE.least_s and bool((np.diff(values) > 0).all())


def frame_times(layout: Layout, pairs: ImagePairs) -> tuple[IntArray, Path | None, tuple[str, ...]]:
    """Return the times (F,) of the pairs, where they come from (None: assumed), and notes.

    Raises:
        DataError: `times.txt` does not fit the images, or the times do not increase.
    """
    doubts = list[str]()
    file = _file_of_times(layout)
    if file is not None:
        times_ns = times_of(file, pairs, doubts)
        return times_ns, file, (*doubts, *_slow_note(file, times_ns))
    return _unlisted_times(layout, pairs, doubts)


def _unlisted_times(
    layout: Layout, pairs: ImagePairs, doubts: list[str]
) -> tuple[IntArray, Path | None, tuple[str, ...]]:
    """Return times, their source and notes as `frame_times`, where no list has a usual name."""
    lefts = [left for left, _ in pairs]
    file = layout.left.parent / "data.csv"
    missing: tuple[str, ...] = ()
    if file.is_file():
        missing = _missing_note(file, pairs)
        listed_ns = _listed_times(file, lefts, doubts)
        if listed_ns is not None:
            return listed_ns, file, (*missing, *doubts)
    named_ns = _name_times(lefts, doubts, since_1970_alone=file.is_file())
    if named_ns is not None:
        return named_ns, layout.left, (*missing, *doubts)
    if file.is_file():
        listed = file.read_text(encoding="utf-8", errors="replace")
        unlisted = next((left.name for left in lefts if left.stem not in listed), lefts[0].name)
        raise DataError(
            f"{file}: does not list {unlisted} ({_LIST_FORM}); copy both again, or remove the image"
        )
    found = _list_of_another_name(layout, pairs)
    if found is not None:
        return found
    counts = _frame_counts(lefts)
    holes = int(counts[-1]) + 1 - len(counts)
    counted = f" (with the {holes} that the numbers leave out)" if holes else ""
    note = (
        f"{layout.root}: no times.txt; frames{counted} are taken to be {ASSUMED_STEP_NS / NS_PER_S:g} s apart, "
        "so speeds are unknown; write one time an image (seconds or nanoseconds) into times.txt"
    )
    return counts * ASSUMED_STEP_NS, None, (note,)


def _left_files(pairs: ImagePairs) -> Sequence[Path]:
    return pairs.left if isinstance(pairs, FilePairs) else [left for left, _ in pairs]


def _numbers_of(files: Sequence[Path]) -> list[int | str]:
    """Return the numbers in the names of images; the name where there is none."""
    names = files.names if isinstance(files, ImageFiles) else [file.name for file in files]
    stems = [stem_of(name) for name in names]
    if all(map(str.isdecimal, stems)):
        return list[int | str](map(int, stems))
    return list(map(_last_number, files))


def overflow_notes(pairs: ImagePairs) -> tuple[str, ...]:
    """Doubt the order of images whose numbers begin at 0 or 1, end with nines alone, and leave a
    part out: a camera's counter that began again amid a recording.
    """
    numbers = [number for number in _numbers_of(_left_files(pairs)) if isinstance(number, int)]
    if len(numbers) < max(len(pairs), 2) or max(numbers) >= _LARGEST_COUNT:
        return ()
    ordered = np.sort(np.array(numbers, dtype=np.int64))
    last = int(ordered[-1])
    steps = np.diff(ordered)
    gap = int(np.argmax(steps))
    others = np.delete(steps, gap)
    begun_again = (
        last >= _MIN_FULL
        and set(str(last)) == {"9"}
        and ordered[0] <= 1
        and steps[gap] >= _MIN_LEFT_OUT
        and (others == 1).all()
    )
    if not begun_again:
        return ()
    return (
        f"doubtful: images are numbered {ordered[0]} to {ordered[gap]} and {ordered[gap + 1]} to "
        f"{last}: a camera whose counter began again at {ordered[0]} took the first of these last; "
        f"rename them to go on from {last + 1}",
    )


def numbers_in_names(pairs: ImagePairs) -> IntArray | None:
    """Return the numbers (F,) by which left images are named where they count frames, that is
    increase and are no times; None: they do not.
    """
    files = _left_files(pairs)
    numbers = _numbers_of(files)
    counted = [number for number in numbers if isinstance(number, int)]
    if len(counted) < len(numbers) or max(counted, default=0) >= _LARGEST_COUNT:
        return None
    found = np.array(counted, dtype=np.int64)
    increase = len(found) > 0 and bool((found[1:] > found[:-1]).all())
    return found if increase and _name_times(files[:_TIMED]) is None else None


def _frame_counts(files: Sequence[Path]) -> IntArray:
    """Return how many frames after the first each image was taken (F,), with those that the numbers
    of an even series leave out: lost images, or pairs without their partner.

    Where numbers are no series, or half of it is missing (images that were chosen, a counter that
    began again), images follow one another.
    """
    in_order = np.arange(len(files), dtype=np.int64)
    numbers = [_last_number(file) for file in files]
    if len(files) < 2 or not all(isinstance(number, int) for number in numbers):
        return in_order
    if max(map(int, numbers)) > np.iinfo(np.int64).max:
        return in_order
    values: IntArray = np.array(numbers, dtype=np.int64)
    steps = values[1:] - values[:-1]
    usual = int(median(steps))
    if usual < 1 or (steps < usual).any() or (steps % usual != 0).any():
        return in_order
    counts = np.concatenate([[0], np.cumsum(steps // usual)])
    return counts if counts[-1] < 2 * len(files) else in_order


def _file_of_times(layout: Layout) -> Path | None:
    """Return the list of times beside the images; None: there is none."""
    beside = (layout.left, layout.left.parent, *layout.above(layout.left))
    folders = dict.fromkeys((layout.base, layout.root, *beside))
    named = (folder / name for folder in folders for name in TIME_LISTS)
    return next((file for file in named if file.is_file()), None)


def _list_of_another_name(
    layout: Layout, pairs: ImagePairs
) -> tuple[IntArray, Path, tuple[str, ...]] | None:
    """Return the times (F,) of the list that names itself one of times, and has one for each image
    (`image_timestamps_left.txt`), the file and a note; None: there is none, or several that differ.

    Of lists of both cameras the left one's counts.
    """
    folders = dict.fromkeys((layout.left, *layout.above(layout.left), layout.base, layout.root))
    files = (file for folder in folders if folder.is_dir() for file in sorted(folder.iterdir()))
    listed = [file for file in files if _is_named_list(file)]
    found: dict[Path, IntArray] = {}
    for file in listed:
        with contextlib.suppress(DataError):
            found[file] = times_of(file, pairs)
    named = {file.stem: file for file in found}
    for pair in pairs_of(list(named)):
        if split_sides(pair) is not None:  # of cam0 and cam1
            found.pop(named[pair[1]], None)
    if not found:
        return None
    file, times_ns = next(iter(found.items()))
    if any(not np.array_equal(other, times_ns) for other in found.values()):
        return None
    note = f"{file}: taken for the times of the images, of which it has one each"
    return times_ns, file, (note, *_slow_note(file, times_ns))


def _is_named_list(file: Path) -> bool:
    """Tell whether a file is a table whose name says that it holds times, not those of another
    sensor, of exposures or of the right camera.
    """
    if file.suffix.lower() not in (".txt", ".csv") or not file.is_file():
        return False
    words = re.findall(r"[a-z]+", file.stem.lower())
    return (
        any(re.fullmatch("time|times|(?:time)?stamps?", word) for word in words)
        and not set(words) & _OTHER_TIMES
        and side_word(file.stem) != "right"
    )


def _slow_note(file: Path, times_ns: IntArray) -> tuple[str, ...]:
    """Doubt the unit of times that are further apart than those of any camera that moves."""
    if len(times_ns) > 1:
        apart_s = median(np.diff(times_ns)) / NS_PER_S
    else:
        apart_s = 0.0
    if apart_s <= FRAME_PACE.most_s:  # times in milliseconds are further apart
        return ()
    return (
        f"{file}: frames are {apart_s:g} s apart, as its times are taken for seconds; if they are "
        "not, write seconds",
    )


def _missing_note(file: Path, pairs: ImagePairs) -> tuple[str, ...]:
    """Say how many of the images in EuRoC's list of a camera are there, if not all are."""
    listed = sum(line.strip()[:1] not in ("#", "") for _, line in text_lines(file))
    return (
        (f"{file} lists {listed} images; the {len(pairs)} that are there are used",)
        if listed > len(pairs)
        else ()
    )


def _listed_times(file: Path, lefts: Sequence[Path], doubts: list[str]) -> IntArray | None:
    """Read the times (F,) of images from EuRoC's list of a camera; None: it does not list them
    all.
    """
    try:
        (_, header), *rows = table_rows(file, 2, _LIST_FORM)
    except DataError:
        return None
    row_of = {Path(name).stem: k for k, (_, (_, name)) in enumerate(rows)}
    if not all(left.stem in row_of for left in lefts):
        return None
    chosen = [rows[row_of[left.stem]] for left in lefts]
    stated = time_unit(header[0]) if header else None
    return parse_stamps(
        [time for _, (time, _) in chosen],
        lambda k: f"{file}, line {chosen[k][0]}",
        stated,
        pace=FRAME_PACE,
        doubts=doubts,
    )


def times_of(file: Path, pairs: ImagePairs, doubts: list[str] | None = None) -> IntArray:
    """Read the times (F,) of image pairs: one a line, or `name time` where the first column names
    the images.

    A comment or a header may state their unit. Dates are those of a KITTI raw drive, which is a
    plain folder where it is run with another calibration.

    Args:
        file: the list.
        pairs: the images.
        doubts: where to note a unit that how far apart the frames are decided.

    Raises:
        DataError: the file does not fit the images, or the times do not increase.
    """
    numbers = [_last_number(left) for left, _ in pairs]
    if is_date(next((line for _, line in text_lines(file)), "")) and all(
        isinstance(n, int) for n in numbers
    ):
        return drive_times(file, np.array(numbers, dtype=np.int64))
    rows, stated = time_lines(file)
    rows, stated = _seconds_and_nanoseconds(rows, stated)
    chosen = (
        _by_name_first(rows, pairs)
        or _by_name_last(rows, pairs)
        or _by_number_or_time_first(rows, pairs)
        or _of_left_camera(rows, pairs)
        or _in_order(rows, pairs)
        or _of_all_images(rows, pairs)
    )
    if chosen is None:
        raise DataError(_unlike(file, rows, pairs))
    return parse_stamps(
        [text for _, text in chosen],
        lambda k: f"{file}, line {chosen[k][0]}",
        stated,
        pace=FRAME_PACE,
        doubts=doubts,
    )


def _unlike(file: Path, rows: Sequence[tuple[int, list[str]]], pairs: ImagePairs) -> str:
    """Return how a list of times does not fit the images."""
    held = f"{file} holds {len(rows)} times for {len(pairs)} image pairs"
    if rows and len(rows) == len(pairs):
        number, fields = next((row for row in rows if len(row[1]) != 1), rows[0])
        shown = " ".join(fields)[:40]
        held = f"{file}, line {number}: {shown!r} is not one time, nor the name of an image and one"
    return f"{held}; there must be one time an image, or lines 'name time'; decimals need a point"


def _seconds_and_nanoseconds(
    rows: list[tuple[int, list[str]]], stated: str | None
) -> tuple[list[tuple[int, list[str]]], str | None]:
    """Return lines of seconds since 1970 and nanoseconds as times in seconds; others as they are."""
    if not all(
        len(fields) == 2
        and re.fullmatch(r"1\d{9}", fields[0])
        and re.fullmatch(r"\d{1,9}", fields[1])
        for _, fields in rows
    ):
        return rows, stated
    # of nanoseconds a tenth is smaller; a number of frames is
    if not rows or 2 * sum(int(fields[1]) >= 10**8 for _, fields in rows) < len(rows):
        return rows, stated
    return [(n, [f"{fields[0]}.{int(fields[1]):09d}"]) for n, fields in rows], "s"


def _by_name_first(
    rows: Sequence[tuple[int, list[str]]], pairs: ImagePairs
) -> list[tuple[int, str]] | None:
    """Return line and time of each pair from lines 'name time'; None: the lines are others."""
    by_name = {Path(fields[0]).stem: (n, fields[1]) for n, fields in rows if len(fields) > 1}
    if not by_name or not all(left.stem in by_name for left, _ in pairs):
        return None
    if all(Path(time).suffix.lower() in SUFFIXES for _, time in by_name.values()):
        return None  # 'time name', where the name is the time
    return [by_name[left.stem] for left, _ in pairs]


def _by_name_last(
    rows: Sequence[tuple[int, list[str]]], pairs: ImagePairs
) -> list[tuple[int, str]] | None:
    """Return line and time of each pair from lines 'number time name'; None: they are others."""
    if not rows or any(len(fields) != 3 or not fields[0].isdigit() for _, fields in rows):
        return None
    return _by_name_first([(n, [fields[2], fields[1]]) for n, fields in rows], pairs)


def _in_order(
    rows: Sequence[tuple[int, list[str]]], pairs: ImagePairs
) -> list[tuple[int, str]] | None:
    """Return line and time of each pair from lines with a time alone; None: they are others."""
    if len(rows) != len(pairs) or any(len(fields) != 1 for _, fields in rows):
        return None
    return [(n, fields[0]) for n, fields in rows]


def _by_number_or_time_first(
    rows: Sequence[tuple[int, list[str]]], pairs: ImagePairs
) -> list[tuple[int, str]] | None:
    """Return line and time of each pair from lines 'time name', or 'number time' where numbers are
    those of the images, or count them; None: the lines are others.
    """
    if not rows or any(len(fields) != 2 for _, fields in rows):
        return None
    swapped = [(n, fields[::-1]) for n, fields in rows]
    by_name = _by_name_first(swapped, pairs)
    if by_name is not None:
        return by_name
    if not all(fields[0].isdigit() for _, fields in rows):
        return None
    return _by_number({int(fields[0]): (n, fields[1]) for n, fields in rows}, pairs)


def _of_left_camera(
    rows: Sequence[tuple[int, list[str]]], pairs: ImagePairs
) -> list[tuple[int, str]] | None:
    """Return line and time of each pair from lines 'number left right', whose two times are closer
    than those of two frames; None: the lines are others.
    """
    if len(rows) < 2 or not all(
        len(fields) == 3
        and fields[0].isdigit()
        and all(re.fullmatch(_NUMBER, field) for field in fields)
        for _, fields in rows
    ):
        return None
    left, right = np.array([fields[1:] for _, fields in rows], dtype=np.float64).T
    if np.abs(right - left).max() >= median(np.abs(np.diff(left))):
        return None
    return _by_number({int(fields[0]): (n, fields[1]) for n, fields in rows}, pairs)


def _by_number(
    lines: Mapping[int, tuple[int, str]], pairs: ImagePairs
) -> list[tuple[int, str]] | None:
    """Return line and time of each pair from those of numbers, which are the images' or count
    them; None: they are others.
    """
    numbers = [_last_number(left) for left, _ in pairs]
    if all(number in lines for number in numbers):
        return [lines[int(number)] for number in numbers]
    counted = sorted(lines) == list(range(min(lines), min(lines) + len(pairs)))
    return [lines[k] for k in sorted(lines)] if counted else None


def _of_all_images(
    rows: Sequence[tuple[int, list[str]]], pairs: ImagePairs
) -> list[tuple[int, str]] | None:
    """Return line and time of each pair where there is a line for each image of one camera, of which
    some have no partner; None: there is not.
    """
    if not isinstance(pairs, FilePairs) or any(len(fields) != 1 for _, fields in rows):
        return None
    for side in (0, 1):
        row_of = {name: k for k, name in enumerate(list_images(pairs[0][side].parent).names)}
        if len(row_of) == len(rows):
            chosen = [rows[row_of[pair[side].name]] for pair in pairs]
            return [(n, fields[0]) for n, fields in chosen]
    return None


def time_lines(file: Path) -> tuple[list[tuple[int, list[str]]], str | None]:
    """Return the lines of a list of times, as their numbers and fields, and the unit that a comment
    or a header states (None: none does).

    Raises:
        DataError: the file cannot be read.
    """
    rows: list[tuple[int, list[str]]] = []
    above: list[str] = []
    for number, line in text_lines(file):
        text = line.strip()
        fields = text.replace(",", " ").split()
        header = not rows and not any(re.fullmatch(_NUMBER, field) for field in fields)
        if text[:1] in ("#", "%", "") or header:
            above.append(text.lstrip("#% "))
        else:
            rows.append((number, fields))
    stated = _unit_stated_in(above)
    # nanoseconds have no decimals: such a comment is of something else
    decimals = any(re.search(r"\.\d*[1-9]", fields[:2][-1]) for _, fields in rows)
    return rows, None if stated == "ns" and decimals else stated


def _unit_stated_in(texts: Sequence[str]) -> str | None:
    """Return the unit of times that comments or headers state in a cell, else in words."""
    cells = [cell for text in texts for cell in re.split(r"[,;\t]|\s(?=[A-Za-z])", text)]
    units = (unit for cell in cells if (unit := time_unit(cell)) is not None)
    return next(units, None) or time_unit_in_words(texts)
