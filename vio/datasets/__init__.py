"""Readers of recordings.

A source is a path whose kind is detected from its content, or `kind:path`.
"""

from __future__ import annotations

import difflib
import os
import zipfile
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from vio.datasets.settings import DatasetSettings
from vio.errors import DataError
from vio.files.inputs import check_regular
from vio.protocols import Dataset

__all__ = ["READERS", "DatasetSettings", "in_colour", "open_dataset"]


# Module and function of the reader of each kind, imported when it is needed.
READERS = {
    "kitti": "plain:read_kitti",
    "kitti_raw": "plain:read_kitti_raw",
    "euroc": "euroc:read_euroc",
    "plain": "plain:read_plain",
    "mono": "plain:read_mono",
    "rgbd": "plain:read_rgbd",
    "bag": "bags.reader:read_bag",
    "video": "videos:read_video",
    "ece276a": "ece276a:read_ece276a",
    "utias": "utias:read_utias",
    "gtsam": "gtsam:read_gtsam",
    "log": "observation_log:read_observation_log",
}
_LOOKED_FOR = (
    "a KITTI folder (image_0 image_1 calib.txt times.txt), a KITTI raw drive (image_00 image_01), "
    "an EuRoC folder "
    "(mav0), a plain folder (left right and a calibration), one camera (left or cam0, a "
    "calibration and an IMU), one "
    "with depth images (rgb.txt depth.txt, or left depth), a ROS bag (.bag, .db3, .mcap), two "
    "videos (left.mp4 "
    "right.mp4), an ECE276A .npz, a UTIAS .mat, GTSAM's stereo factors (*stereo_factors*.txt) or "
    "an observation log "
    ".npz"
)


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
    kind, path = _parse(os.fspath(source))
    if path.is_symlink() and not path.exists():
        raise DataError(
            f"{path} is a link to {os.readlink(path)}, which leads nowhere; give {_LOOKED_FOR}"
        )
    if not path.exists():
        raise DataError(_missing(path))
    settings = options or DatasetSettings()
    if kind is None:
        kind = "plain" if settings.folders is not None and path.is_dir() else _detect(path)
    module, reader = READERS[_for_settings(kind, path, settings)].split(":")
    read: Callable[[Path, DatasetSettings], Dataset] = getattr(
        import_module(f"vio.datasets.{module}"), reader
    )
    dataset = read(path, settings)
    # The settings of a run that took the left camera also serve its observations, which are of that
    # camera.
    if settings.camera == "both" or (
        not dataset.recording.has_images and dataset.recording.camera.kind == "mono"
    ):
        return dataset
    from vio.datasets.left_camera import left_camera

    return left_camera(dataset)


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
    if settings.calibration is None or kind in ("plain", "mono", "rgbd", "bag", "video"):
        return kind
    if kind in ("kitti", "kitti_raw", "euroc"):
        return "plain"  # which reads these folders, too, with any calibration
    raise DataError(
        f"{path}: --calibration takes the place of a camera's calibration, but kind {kind} has its "
        "own"
    )


def _parse(source: str) -> tuple[str | None, Path]:
    """Split `kind:path`. An existing path is never split, and a drive letter is no kind."""
    if not source.strip():
        raise DataError(f"no recording is named; give {_LOOKED_FOR}")
    head, colon, tail = source.partition(":")
    if not colon or len(head) < 2 or not head.replace("_", "").isalnum() or Path(source).exists():
        return None, Path(source)
    if head not in READERS:
        near = difflib.get_close_matches(head, READERS, 1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise DataError(
            f"'{head}' in '{source}' is no kind of recording; choose one of "
            f"{', '.join(READERS)}{hint}"
        )
    if not tail:
        raise DataError(f"'{source}' names no path; write {head}:PATH")
    return head, Path(tail)


def _detect(path: Path) -> str:
    """Detect the kind of a recording from its content."""
    kind = _folder_kind(path) if path.is_dir() else _file_kind(path)
    if kind is None:
        raise DataError(_unknown(path))
    return kind


def _missing(path: Path) -> str:
    """Say that a path does not exist, and from where on it is wrong."""
    folder = path.parent
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
        return f"{path}: is one video; give a folder with left.mp4, right.mp4 and the calibration of the pair"
    return f"{path}: no known recording; looked for {_LOOKED_FOR}"


def _folder_kind(path: Path) -> str | None:
    from vio.datasets.bags import is_bag

    try:
        names = sorted(child.name for child in path.iterdir())
    except OSError as error:
        raise DataError(f"cannot list {path}: {error.strerror or error}") from error
    if not names:
        raise DataError(f"{path} is empty; give {_LOOKED_FOR}")
    if "metrics.json" in names and "config.yaml" in names:
        raise DataError(
            f"{path} holds the results of a run, not a recording; show it with vio report, compare "
            "it by vio eval, or "
            "give its observations.npz (of --save-observations)"
        )
    if is_bag(path):
        return "bag"
    kind = _image_kind(path)
    if kind is None and "sequences" in names:
        raise DataError(
            f"{path} holds several KITTI sequences; name one of them, such as "
            f"{path / 'sequences' / '00'}"
        )
    return kind


def _image_kind(path: Path) -> str | None:
    """Return the kind of a folder of images, videos or factors; None: it is none."""
    from vio.datasets import plain
    from vio.datasets.euroc import is_euroc_folder
    from vio.datasets.gtsam import factor_files
    from vio.datasets.videos import video_files

    if plain.is_kitti_folder(path):
        return "plain" if plain.holds_more_than_kitti(path) else "kitti"
    if plain.is_kitti_raw_folder(path):
        return "kitti_raw"
    if is_euroc_folder(path) and not plain.is_plain_folder(path) and plain.is_mono_folder(path):
        return "mono"
    if is_euroc_folder(path):
        return "plain" if plain.lacks_sensor_yaml(path) else "euroc"
    if plain.is_plain_folder(path):
        return "plain"
    videos = video_files(path)
    if videos is not None and videos[0] != videos[1]:
        return "video"
    if factor_files(path):
        return "gtsam"
    if plain.is_rgbd_folder(path):
        return "rgbd"
    if plain.side_by_side(path) is not None:
        return "plain"
    if plain.is_mono_folder(path):
        return "mono"
    return None if videos is None else "video"


def _file_kind(path: Path) -> str | None:
    from vio.datasets.bags import is_bag
    from vio.datasets.gtsam import is_factor_file
    from vio.datasets.observation_log import is_observation_log

    try:
        check_regular(path)
        with path.open("rb") as stream:
            start = stream.read(128)
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    if start.startswith(b"MATLAB"):
        return "utias"
    if is_bag(path):
        return "bag"
    if is_factor_file(path):
        return "gtsam"
    if not start.startswith(b"PK"):
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
    except (zipfile.BadZipFile, OSError) as error:
        raise DataError(f"{path}: is damaged ({error}); copy it again") from error
    return "log" if is_observation_log(names) else "ece276a"
