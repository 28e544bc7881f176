"""Readers of recordings.

A source is a path whose kind is detected from its content, or `kind:path`.
"""

from __future__ import annotations

import contextlib
import difflib
import os
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from vio.datasets.reader import Reader
from vio.datasets.settings import DatasetSettings
from vio.errors import DataError
from vio.files.inputs import check_regular
from vio.protocols import Dataset

if TYPE_CHECKING:
    from vio.datasets.unused import Layout

__all__ = ["MODULES", "DatasetSettings", "in_colour", "open_dataset", "readers"]


# Modules of the readers, imported when a recording is opened. Where a path has the signs of
# several kinds, that of the earlier module counts, see `vio.datasets.reader`.
MODULES = [
    "bags",
    "plain",
    "videos",
    "gtsam",
    "observation_log",
    "ece276a",
    "utias",
]
_FILES = (".npz", ".mat", ".bag", ".db3", ".mcap")  # recordings that are one file
# forms of tables and of Python's objects, as trackers write their features
_OF_NUMBERS = (".npy", ".csv", ".tsv", ".txt", ".json", ".jsonl", ".pkl", ".pickle", ".parquet")
_MAX_LOOKED_AT = 200  # of what a folder holds that is no recording itself
_MAX_NAMED = 3  # of the recordings in it
_LEVELS_ABOVE = 3  # folders in which a file of a recording may lie
_DEMO = Path("demo/street")  # that the documentation's examples read


def readers() -> dict[str, Reader]:
    """Return the readers by the kinds of recordings that they read, in the order of `MODULES`."""
    return {reader.kind: reader for reader in _readers()}


def _readers() -> Iterator[Reader]:
    """Yield the readers in the order of `MODULES`, each module imported when it is come to."""
    for name in MODULES:
        yield from import_module(name if "." in name else f"vio.datasets.{name}").READERS


def _reader(kind: str) -> Reader:
    return next(reader for reader in _readers() if reader.kind == kind)


def _looked_for() -> str:
    *others, last = [reader.looked_for for reader in readers().values()]
    return f"{', '.join(others)} or {last}"


def open_dataset(source: str | os.PathLike[str], options: DatasetSettings | None = None) -> Dataset:
    """Open a recording.

    Args:
        source: a path whose kind is detected from its content, or `kind:path`.
        options: reader settings.

    Raises:
        DataError: the path does not exist, or its content is of no known kind; the message lists
            the known kinds.
        CalibrationError: the recording's calibration is invalid.
    """
    if not isinstance(source, str | os.PathLike):
        raise DataError(
            f"a recording is named by one path, as text or pathlib.Path, not by {type(source).__name__}"
        )
    kind, path = _parse(os.fspath(source))
    _check_there(path)
    settings = options or DatasetSettings()
    if kind is None:
        kind = "plain" if settings.folders is not None and path.is_dir() else _detect(path)
    dataset = _reader(_for_settings(kind, path, settings)).read(path, settings)
    # The settings of a run that took the left camera also serve its observations, which are of that
    # camera.
    if settings.camera == "both" or (
        not dataset.recording.has_images and dataset.recording.camera.kind == "mono"
    ):
        return dataset
    from vio.datasets.left_camera import left_camera

    return left_camera(dataset)


def _check_there(path: Path) -> None:
    """Raise DataError where a path does not exist, or is a link to one that does not."""
    if path.is_symlink() and not path.exists():
        raise DataError(
            f"{path} is a link to {os.readlink(path)}, which leads nowhere; give {_looked_for()}"
        )
    if not path.exists():
        raise DataError(_missing(path))


def in_colour(dataset: Dataset) -> Dataset:
    """Return a recording whose frames keep the colours of its images, (H, W, 3) red, green, blue;
    gray ones stay gray.

    No front end takes such frames: they are for those who show images or write them.
    """
    from vio.datasets.image_pairs import ImageRecording

    return replace(dataset, colour=True) if isinstance(dataset, ImageRecording) else dataset


def _for_settings(kind: str, path: Path, settings: DatasetSettings) -> str:
    """Return the kind that reads a recording with another calibration or named topics."""
    if settings.topics is not None and kind != "bag":
        raise DataError(
            f"{path}: --topics names topics of a ROS bag, but this is of kind {kind}; leave it out"
        )
    if settings.folders is not None and kind != "plain":
        raise DataError(
            f"{path}: dataset.folders names two folders of images, but this is of kind {kind}; "
            "leave it out"
        )
    if settings.calibration is None:
        return kind
    calibrated = _reader(kind).calibrated_as
    if calibrated is None:
        raise DataError(
            f"{path}: --calibration takes the place of a camera's calibration, but kind {kind} "
            "has its own"
        )
    return calibrated


def _parse(source: str) -> tuple[str | None, Path]:
    """Split `kind:path`. An existing path is never split, and a drive letter is no kind."""
    if not source.strip():
        raise DataError(f"no recording is named; give {_looked_for()}")
    head, colon, tail = source.partition(":")
    if not colon or len(head) < 2 or not head.replace("_", "").isalnum() or Path(source).exists():
        return None, Path(source)
    kinds = list(readers())
    if head not in kinds:
        near = difflib.get_close_matches(head, kinds, 1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise DataError(
            f"'{head}' in '{source}' is no kind of recording; choose one of "
            f"{', '.join(kinds)}{hint}"
        )
    if not tail:
        raise DataError(f"'{source}' names no path; write {head}:PATH")
    return head, Path(tail)


def _detect(path: Path) -> str:
    """Detect the kind of a recording from its content."""
    from vio.datasets.unused import ARCHIVES, foreign_file

    # the beginning of others' files is that of a bag or of NumPy's archives, too
    packed = path.is_file() and (path.suffix.lower() in ARCHIVES or foreign_file(path) is not None)
    kind = None if packed else _folder_kind(path) if path.is_dir() else _file_kind(path)
    if kind is None:
        raise DataError(_unknown(path))
    return kind


def _missing(path: Path) -> str:
    """Say that a path does not exist, and from where on it is wrong."""
    folder = path.parent
    if path == _DEMO:
        return f"{path} does not exist; 'vio demo' renders it"
    if not folder.is_dir():
        return f"{path} does not exist, nor does {folder}; check the path"
    near = difflib.get_close_matches(
        path.name, os.listdir(folder) if os.access(folder, os.R_OK) else (), 1, 0.75
    )
    hint = f"did you mean {folder / near[0]}?" if near else "check the path"
    return f"{path} does not exist; {hint}"


def _unknown(path: Path) -> str:
    """Say what is missing where there are images or a video, else what was looked for."""
    from vio.datasets import images, plain, videos
    from vio.datasets.plain import ALONE, images_of_one_camera
    from vio.datasets.unused import foreign_file, listed, unread_files

    if foreign_file(path) is None and (whole := _recording_of(path)) is not None:
        return f"{path}: is a part of the recording {whole}; give that folder"
    if path.is_dir() and len(plain.image_folders(path)) > 1:
        return (
            f"{path}: holds {plain.seen_folders(path)}, but it is not clear which is the left and "
            "which the right camera's; name them with --set dataset.folders=LEFT,RIGHT"
        )
    if path.is_dir() and (found := images_of_one_camera(path)) is not None:
        if found == path:
            return (
                f"{path}: holds images, but not in folders; put those of a stereo camera into left "
                "and right, with "
                "its calibration beside them, or those of one camera into left, with "
                "calibration.yaml and imu.csv"
            )
        name = found.relative_to(path)
        if not set(name.parts) & set(ALONE):
            return f"{path}: holds images in {name} but none of a left camera; add them"
        return (
            f"{path}: holds images in {name} but no right camera's and no calibration; add the "
            "right images, "
            "or for one camera a calibration.yaml (Kalibr's camchain with cam0) and imu.csv"
        )
    if path.suffix.lower() in images.SUFFIXES:
        return f"{path}: is one image; give a folder with left and right images and the calibration of the pair"
    if path.suffix.lower() in videos.SUFFIXES:
        return (
            f"{path}: is one video; give a folder with left.mp4, right.mp4 and the calibration of the "
            "pair, or with this video alone where it shows left and right side by side"
        )
    if path.is_file() and path.suffix.lower() in _OF_NUMBERS:
        return (
            f"{path}: no known recording, but numbers or text; features of another program become "
            "one by vio.write_observations, and tables of a recording are read in its folder"
        )
    if (unread := unread_files(path)) is not None:
        return unread
    if path.is_dir() and (folders := plain.image_folders(path)):
        (name,) = folders
        return (
            f"{path}: holds images in {name}, of which it is not clear what they show; put those of a "
            "stereo camera into left and right, or those of one camera into left, with their "
            "calibration (and for one camera imu.csv, or its depths in depth) beside these folders"
        )
    if path.is_dir():
        films = [file.name for file in path.iterdir() if file.suffix.lower() in videos.SUFFIXES]
        if len(films) > 1:
            return (
                f"{path}: holds the videos {listed(sorted(films))}, which are no pair by their names; "
                "name them left and right, the parts of a long one joined"
            )
    return f"{path}: no known recording; looked for {_looked_for()}"


def _recording_of(path: Path) -> Path | None:
    """Return the folder that holds a file or a folder beside, or of, the images of two cameras; None:
    none does.
    """
    from vio.datasets.plain import pair_layout

    given = path.absolute()
    for folder in given.parents[:_LEVELS_ABOVE]:
        with contextlib.suppress(OSError, DataError):  # cannot be listed
            layout = pair_layout(folder)
            if layout is not None:
                return _home_of(given, layout)
    return None


def _home_of(given: Path, layout: Layout) -> Path | None:
    """Return the folder of a recording, of which a path is a camera's or an IMU's, or a file beside
    those; None: it is something else there.
    """
    home = Path(os.path.commonpath([layout.left, layout.right]))
    if home not in given.parents:
        return None
    within = given.relative_to(home).parts
    if within[0] in {image.relative_to(home).parts[0] for image in (layout.left, layout.right)}:
        return home
    is_beside = len(within) == 1 or within[0].startswith("imu")
    return home if is_beside and given.is_file() else None


def _folder_kind(path: Path) -> str | None:
    try:
        names = sorted(child.name for child in path.iterdir())
    except OSError as error:
        raise DataError(f"cannot list {path}: {error.strerror or error}") from error
    if not names:
        raise DataError(f"{path} is empty; give {_looked_for()}")
    if "metrics.json" in names and "config.yaml" in names:
        raise DataError(
            f"{path} holds the results of a run, not a recording; its poses are in trajectory.tum; show "
            "it with vio report, compare it by vio eval, or give its observations.npz (of "
            "--save-observations)"
        )
    kind = _kind_of_folder(path)
    if kind is None and "sequences" in names:
        raise DataError(
            f"{path} holds several KITTI sequences; name one of them, such as "
            f"{path / 'sequences' / '00'}"
        )
    return kind


def _kind_of_folder(path: Path) -> str | None:
    """Return the kind of the first reader that recognises a folder, else of one that may read it.

    Raises:
        DataError: it is no recording, but holds some.
    """
    sure = next((reader.kind for reader in _readers() if reader.is_folder(path)), None)
    if sure is not None:
        return sure
    inside = _recordings_in(path)
    possible = next((reader.kind for reader in _readers() if reader.may_be_folder(path)), None)
    if possible is not None:  # files beside images are what a run or a tracker wrote
        inside = {name: kind for name, kind in inside.items() if (path / name).is_dir()}
    if not inside:
        return possible
    first = [f"{name} ({kind})" for name, kind in list(inside.items())[:_MAX_NAMED]]
    if len(inside) > len(first):
        more = f" and {len(inside) - len(first)} more"
    else:
        more = ""
    raise DataError(
        f"{path}: is no recording, but holds {', '.join(first)}{more}; name one of them, such as "
        f"{path / next(iter(inside))}"
    )


def _is_named(file: Path, reader: Reader) -> bool:
    """Tell whether a reader takes a file, which is also called as recordings are: an archive
    begins as a `.npz` does.
    """
    return file.suffix in _FILES and file.is_file() and reader.is_file(file)


def _recordings_in(path: Path) -> dict[str, str]:
    """Return the kinds of the recordings in a folder, by their names."""
    found = {}
    for child in sorted(path.iterdir())[:_MAX_LOOKED_AT]:
        try:
            kinds = [
                reader.kind
                for reader in _readers()
                if (reader.is_folder(child) if child.is_dir() else _is_named(child, reader))
            ]
        except (OSError, DataError):  # not readable, or damaged
            continue
        if kinds:
            found[child.name] = kinds[0]
    return found


def _file_kind(path: Path) -> str | None:
    try:
        check_regular(path)
        return next((each.kind for each in _readers() if each.is_file(path)), None)
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
