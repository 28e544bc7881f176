"""Folders of images: KITTI's, and plain ones of one camera, two, or one with depth images.

A plain folder has images in `left right`, `image_0 image_1`, `cam0 cam1` and other usual names, in
the folder or in its `data` or `images`. Calibration: any that `vio.load_rig` reads. Optional:
`times.txt`, `imu.csv`, `velocity.csv`, `T_cam0_imu.txt`, and ground truth in `reference.tum`.
TUM-VI in both of its forms is such a folder. What lies there and is not used is named in the
recording's notes.

Without the right images it is a recording of one camera (`mono`). With `depth/`, whose files are
named as the images, or in the layout of TUM RGB-D, it is one with depth images (`rgbd`): they have
16 bits, 0 being unknown, and show what the images show, pixel by pixel.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vio.cameras.rig import Rig
from vio.dataclass import dataclass
from vio.datasets import rigs
from vio.datasets.alternation import alternating_note
from vio.datasets.companions import (
    ReadImages,
    calibration_beside,
    find_calibration_of,
    imu_files,
    read_companions,
    reference_of_images,
)
from vio.datasets.euroc import is_euroc_folder, read_euroc
from vio.datasets.halves import halves_note
from vio.datasets.image_files import FilePairs, ImageFiles
from vio.datasets.image_pairs import (
    ImageDataset,
    ImagePairs,
    measured_images,
    pair_images,
    stacked_hint,
)
from vio.datasets.image_times import (
    counted_apart,
    frame_times,
    numbers_in_names,
    overflow_notes,
    pair_files,
    times_of,
)
from vio.datasets.images import SUFFIXES, UnreadableImageError, list_images, load_gray
from vio.datasets.kitti_raw import CAMERAS, PERSPECTIVE, find_above
from vio.datasets.lost_images import CountedApart, pairs_in_step
from vio.datasets.reader import Reader
from vio.datasets.rigs.bare import NAMES as BARE_NAMES
from vio.datasets.rigs.eth3d import FOLDERS as ETH3D_FOLDERS
from vio.datasets.rigs.eth3d import is_eth3d
from vio.datasets.rigs.names import named_calibration
from vio.datasets.rigs.rectified_pair import is_rectified_pair
from vio.datasets.settings import DatasetSettings
from vio.datasets.sides import (
    first_pair,
    pairs_of,
    split_depths,
    split_sides,
    stamped_sides,
    words_of,
)
from vio.datasets.tables import drive_times
from vio.datasets.tum_rgbd import (
    DEPTH_FACTOR,
    LISTS,
    associated_images,
    is_tum_folder,
    published_camera,
)
from vio.datasets.unused import Layout
from vio.errors import CalibrationError, DataError
from vio.files.stamps import ASSUMED_STEP_NS
from vio.files.trajectories import read_trajectory
from vio.geometry.lie import FloatArray, se3_inverse
from vio.records import Image, IntArray, Trajectory

_PAIRS: tuple[tuple[str, ...], ...] = (
    ("left", "right"), ("Left", "Right"), ("cam0", "cam1"), ("image_0", "image_1"), ("image_00", "image_01"),
    ("image_2", "image_3"), ("image_02", "image_03"), ("images_left", "images_right"),
    ("image_left", "image_right"), ("left_images", "right_images"), ("camera_left", "camera_right"), ("L", "R"),
    ("image_lcam_front", "image_rcam_front"), ("infra1", "infra2"), ("fisheye1", "fisheye2"),
    ("stereo_left", "stereo_right"), ("stereo/left", "stereo/right"), ("img_l", "img_r"),
    ("undistorted_images/cam0", "undistorted_images/cam1"),
)  # fmt: skip
ALONE = (
    "left", "Left", "cam0", "image_0", "image_00", "image", "images", "Images", "img", "rgb", "color", "mono",
)  # fmt: skip
_GRAY = (0, 1)  # of KITTI
_COLOUR = (2, 3)
_INSIDE = ("data", "images", "")
# words of folders of images that show no view, beside those that do (Virtual KITTI, TartanAir,
# Isaac)
_OTHER_THAN_VIEWS = frozenset((
    "depth", "depths", "disparity", "disparities", "disp", "flow", "instance", "label", "labels",
    "mask", "masks", "normals", "segmentation", "semantic", "semantics",
))  # fmt: skip
_OF_VIEWS = frozenset(("infra", "infrared", "ir"))  # also in the folder of a depth camera


class _FolderRules(NamedTuple):
    """Which folders are looked into."""

    max_depth: int = 3  # levels of folders that are looked into for images
    max_folders: int = 200


_FOLDERS = _FolderRules()


def is_kitti_folder(path: Path) -> bool:
    """Return whether a folder looks like a KITTI sequence."""
    return any((path / f"image_{k}").is_dir() for k in range(4))


def is_kitti_raw_folder(path: Path) -> bool:
    """Return whether a folder looks like a KITTI raw drive."""
    return (path / "image_00").is_dir()


def is_plain_folder(path: Path) -> bool:
    """Return whether a folder holds two image folders of known names, or of names that differ in
    their side alone.
    """
    if is_eth3d(path) and is_tum_folder(path):  # as RGB-D, unless it is asked for as plain:PATH
        return False
    return pair_layout(path) is not None


def pair_layout(path: Path, folders: str | None = None) -> Layout | None:
    """Return where the images of a pair lie; None: it is not clear.

    Args:
        path: of the recording.
        folders: the left and the right folder, by setting; None: found by their names.

    Raises:
        DataError: the setting names no two folders of images.
    """
    if folders is not None:
        return _named_layout(path, folders)
    if is_eth3d(path):
        return Layout(path, path, *(path / name for name in ETH3D_FOLDERS))
    known = _layout(path)
    if known is not None:
        return known
    names = [str(folder) for folder in image_folders(path)]
    views = [name for name in names if _may_show_views(name)]
    pair = first_pair(pairs_of(views)) or first_pair(pairs_of(names))
    if pair is None:
        return None
    left, right = (path / name for name in pair)
    # as where an archive was unpacked: what belongs to the images lies beside them
    base = left.parent if left.parent == right.parent else path
    return Layout(path, base, left, right)


def _may_show_views(name: str) -> bool:
    """Return whether a folder of images is not, by its name, one of depths, segments or masks."""
    words = set(words_of(name))
    return bool(words & _OF_VIEWS) or not words & _OTHER_THAN_VIEWS


def side_by_side(path: Path, calibration: Path | None = None) -> Layout | None:
    """Return where images lie each of which holds a pair, left and right; None: there are none.

    They are twice as wide as the calibration of a pair states.
    """
    layout = _layout_of_one(path)
    if layout is None and _holds_images(path):
        layout = Layout(path, path, path, path)
    if layout is None:
        return None
    file = calibration or calibration_beside(layout)
    if file is None:
        return None
    try:
        image = load_gray(list_images(layout.left)[0])[0]
        half = (image.shape[1] // 2, image.shape[0])
        # a size that the file does not state cannot tell; a ZED's states several
        stated = half if file.suffix.lower() == ".conf" else None
        rig = rigs.load_rig(file, image_size=stated, cameras=2)
    except (UnreadableImageError, CalibrationError):
        return None
    return layout if (rig.cam0.width, rig.cam0.height) == half else None


def _pair_in_one_folder(path: Path) -> tuple[Layout, _Images] | None:
    """Return where the images of both cameras lie in one folder, by names that tell them apart, and
    the images; None: there are none.

    Raises:
        DataError: each image has a time or number of its own, and those of the cameras fit none of
            each other's.
    """
    found = _in_one_folder(path)
    if found is None:
        return None
    layout, files = found
    sides = split_sides(files.names)
    if sides is None:
        sides = stamped_sides(files.names)
        if sides is None:
            return None
        lefts, rights = (ImageFiles(files.folder, tuple(names)) for names in sides)
        return layout, _Images(*pair_files(lefts, rights))
    pairs = FilePairs(*(ImageFiles(files.folder, tuple(names)) for names in sides))
    alone = len(files) - 2 * len(pairs)
    lone = (f"{alone} images have no partner and are skipped",) if alone else ()
    return layout, _Images(pairs, lone)


def _depths_in_one_folder(path: Path) -> tuple[Layout, _Images] | None:
    """Return where images and their depth images lie in one folder, and both; None: there are none."""
    found = _in_one_folder(path)
    if found is None:
        return None
    layout, files = found
    parts = split_depths(files.names)
    if parts is None:
        return None
    images, depths = (ImageFiles(files.folder, tuple(names)) for names in parts)
    return layout, _Images(FilePairs(images, images), depths=depths)


def _in_one_folder(path: Path) -> tuple[Layout, ImageFiles] | None:
    """Return the layout of the folder in which all images of a recording lie, and the images; None:
    there is none, or there are several.
    """
    layout = _layout_of_one(path)
    if layout is None and _holds_images(path):
        layout = Layout(path, path, path, path)
    if layout is None:
        layout = _only_folder(path)
    return None if layout is None else (layout, list_images(layout.left))


def _only_folder(path: Path) -> Layout | None:
    """Return the layout of the one folder below a folder that holds images, whatever its name;
    None: there are none, or several.
    """
    found = list(image_folders(path))
    if len(found) != 1:
        return None
    images = path / found[0]
    return Layout(path, images.parent, images, images)


def _named_layout(path: Path, folders: str) -> Layout:
    names = [name.strip() for name in folders.split(",")]
    sides = [path / name for name in names]
    if (
        len(set(names)) != 2
        or len(names) != 2
        or not all(_holds_images(folder) for folder in sides)
    ):
        raise DataError(
            f"{path}: dataset.folders is {folders!r}, which names no two folders of images, LEFT,RIGHT; it "
            f"holds {seen_folders(path)}"
        )
    return Layout(path, path, *sides)


def image_folders(path: Path) -> dict[Path, int]:
    """Return the folders below a folder that hold images, and how many each."""
    found: dict[Path, int] = {}
    waiting = [(path, 0)]
    looked = 0
    while waiting and looked < _FOLDERS.max_folders:
        folder, depth = waiting.pop(0)
        looked = looked + 1
        try:
            entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        except OSError:
            continue
        count = sum(os.path.splitext(entry.name)[1].lower() in SUFFIXES for entry in entries)
        if count and depth:
            found[folder.relative_to(path)] = count
        if depth < _FOLDERS.max_depth:
            waiting += [(Path(entry.path), depth + 1) for entry in entries if entry.is_dir()]
    return found


def seen_folders(path: Path) -> str:
    """Return the folders of images in words: 'img_l and img_r with 90 images each'."""
    found = image_folders(path)
    if not found:
        return "no folder of images"
    names = [str(folder) for folder in found]
    if len(names) > 1:
        listed = f"{', '.join(names[:-1])} and {names[-1]}"
    else:
        listed = names[0]
    counts = set(found.values())
    if len(counts) == 1:
        return f"{listed} with {counts.pop()} images{' each' if len(names) > 1 else ''}"
    return ", ".join(f"{folder} with {count} images" for folder, count in found.items())


def holds_more_than_kitti(path: Path) -> bool:
    """Return whether a folder with KITTI's names has an IMU, another calibration that goes before
    `calib.txt`, or one of another form by that name.
    """
    if not is_plain_folder(path):
        return False
    if imu_files(path):
        return True
    found = named_calibration(path) or rigs.find_calibration(path)
    if found != path / "calib.txt":
        return found is not None
    return is_rectified_pair(found)


def lacks_sensor_yaml(path: Path) -> bool:
    """Return whether a folder with EuRoC's names has its calibration elsewhere, as TUM-VI's
    export.
    """
    layout = pair_layout(path)
    if layout is None or any(
        (base / "cam0" / "sensor.yaml").is_file() for base in (layout.base, layout.root)
    ):
        return False
    return calibration_beside(layout) is not None


def image_layout(path: Path) -> Layout | None:
    """Return where a folder has the images of two cameras, else of one; None: it has none."""
    return _layout(path) or _layout_of_one(path)


def images_of_one_camera(path: Path) -> Path | None:
    """Return the folder of images that a folder holds or is, whether or not anything else
    identifies them.
    """
    layout = _layout_of_one(path) or _layout(path, [(names[-1],) for names in _PAIRS])
    return layout.left if layout is not None else path if _holds_images(path) else None


def is_mono_folder(path: Path) -> bool:
    """Return whether a folder holds the images of one camera, and a calibration identifies them."""
    layout = _layout_of_one(path)
    if layout is not None:
        names = list_images(layout.left).names
        if split_sides(names) is not None or stamped_sides(names) is not None:
            return False
    return layout is not None and calibration_beside(layout) is not None


def is_rgbd_folder(path: Path) -> bool:
    """Return whether a folder holds images and depth images."""
    layout = _layout_of_one(path)
    if is_tum_folder(path) or (layout is not None and _holds_images(layout.base / "depth")):
        return True
    return _depths_in_one_folder(path) is not None


def _layout(path: Path, choices: Sequence[tuple[str, ...]] = _PAIRS) -> Layout | None:
    for base in (path, path / "mav0"):
        for names in choices:
            for inside in _INSIDE:
                folders = [base / name / inside for name in names]
                if all(map(_holds_images, folders)):
                    return Layout(path, base, folders[0], folders[-1])
    return None


def _layout_of_one(path: Path) -> Layout | None:
    return _layout(path, [(name,) for name in ALONE])


def _holds_images(folder: Path) -> bool:
    return folder.is_dir() and any(child.suffix.lower() in SUFFIXES for child in folder.iterdir())


@dataclass(frozen=True, slots=True)
class _Images:
    """The image files of the frames."""

    pairs: ImagePairs  # of one camera, each image twice
    notes: tuple[str, ...] = ()
    depths: Sequence[Path] | None = None  # depth images; None: there are none
    listed_ns: IntArray | None = None  # times in TUM's lists; None: those of any plain folder
    side_by_side: bool = False  # each file holds a pair
    counted: CountedApart | None = None  # each camera may have numbered its own images


def read_plain(path: Path, settings: DatasetSettings) -> ImageDataset:
    """Read a plain folder of stereo images.

    Raises:
        DataError: images, times or samples cannot be used; the message names file and remedy.
        CalibrationError: there is no calibration, or it is invalid.
    """
    layout = pair_layout(path, settings.folders)
    if layout is None and (found := _pair_in_one_folder(path)) is not None:
        return _read("plain", *found, settings)
    if layout is None and (layout := side_by_side(path, settings.calibration)) is not None:
        files = list_images(layout.left)
        images = _Images(FilePairs(files, files), side_by_side=True)
        return _read("plain", layout, images, settings)
    if layout is None:
        names = ", ".join(" ".join(names) for names in _PAIRS[:4])
        raise DataError(
            f"{path}: holds no pair of image folders ({names} or others) but {seen_folders(path)}; "
            "name the two with --set dataset.folders=LEFT,RIGHT"
        )
    lefts = list_images(layout.left)
    rights = list_images(layout.right)
    pairs, notes = pair_files(lefts, rights)
    images = _Images(pairs, notes, counted=counted_apart(lefts, rights, pairs))
    return _read("plain", layout, images, settings)


def read_kitti(path: Path, settings: DatasetSettings) -> ImageDataset:
    """Read a KITTI odometry folder.

    Official: `sequences/NN/` with `image_0 image_1 calib.txt times.txt` (and `image_2 image_3` in
    colour), poses in `../../poses/NN.txt`. Self-contained: the same with, where there are any,
    `poses.txt`, `velocity.csv` (in the IMU's frame) and `T_cam0_imu.txt`. Poses and extrinsics of
    KITTI's camera 0 are transformed to the left camera used.

    Raises:
        DataError: files are missing, counts differ or a clock is wrong; the message names file and
            remedy.
        CalibrationError: the calibration is missing or invalid.
    """
    cameras = _choose_cameras(path, settings.colour)
    layout = Layout(path, path, *(path / f"image_{k}" for k in cameras))
    pairs = pair_images(layout.left, layout.right)
    size, levels, notes = measured_images(pairs)
    file = path / "calib.txt"
    times_file = path / "times.txt"
    rig, T_left_cam0 = rigs.kitti_rig(file, size, cameras)
    if not times_file.is_file():
        raise DataError(f"{times_file} is missing; it holds one time in seconds for each image")
    doubts = list[str]()
    times_ns = times_of(times_file, pairs, doubts)
    notes = (*notes, *doubts)
    poses = _poses_file(path)
    numbers = numbers_in_names(pairs)
    reference = None if poses is None else _read_reference(poses, times_ns, numbers, T_left_cam0)
    used = [] if poses is None else [poses]
    times = times_ns, times_file
    read = ReadImages("kitti", layout, (file, rig), times, notes, used, numbers=numbers)
    parts = read_companions(read, settings, reference)
    return ImageDataset(*parts, pairs, levels=levels)


def read_kitti_raw(path: Path, settings: DatasetSettings) -> ImageDataset:
    """Read the gray pair of a KITTI raw drive: `image_00/data/0000000000.png`, `image_01/data/…`.

    The drives named `_extract` are unrectified: they are rectified as they are read, with rotations
    computed here (`R_rect_00` and `P_rect_00` belong to KITTI's). The drives named `_sync` are
    rectified already; the image size distinguishes the two. The IMU's record (`oxts`) is not read.

    Raises:
        DataError: images are missing, counts differ or a clock is wrong; the message names file and
            remedy.
        CalibrationError: the calibration is missing or invalid.
    """
    inside = "data_rect" if (path / "image_00" / "data_rect").is_dir() else "data"  # KITTI-360
    layout = Layout(path, path, *(path / name / inside for name in ("image_00", "image_01")))
    for folder in (layout.left, layout.right):
        if not folder.is_dir():
            raise DataError(
                f"{path}: holds no {folder.relative_to(path)}; give a KITTI raw drive with both "
                "cameras"
            )
    pairs = pair_images(layout.left, layout.right)
    file = find_above(path, CAMERAS) or find_above(path, f"calibration/{PERSPECTIVE}")
    if file is None:
        raise CalibrationError(
            f"{path}: {CAMERAS} is neither there nor in the folders above; copy KITTI's "
            "calibration of that day there"
        )
    size, levels, notes = measured_images(pairs)
    rig = rigs.load_rig(file, image_size=size, cameras=2)
    # one trigger: the left ones serve
    used = [path / name / "timestamps.txt" for name in ("image_00", "image_01")]
    numbers = _frame_numbers(pairs)
    if used[0].is_file():
        times_ns = drive_times(used[0], numbers)
    else:
        times_ns = numbers * ASSUMED_STEP_NS
        notes = (f"{used[0]} is missing; times follow from the frame numbers at 10 Hz", *notes)
    times = (times_ns, used[0])
    read = ReadImages("kitti_raw", layout, (file, rig), times, notes, used, numbers=numbers)
    parts = read_companions(read, settings)
    return ImageDataset(*parts, pairs, levels=levels)


def read_mono(path: Path, settings: DatasetSettings) -> ImageDataset:
    """Read a folder of one camera.

    Raises:
        DataError: as `read_plain`.
        CalibrationError: as `read_plain`.
    """
    layout = _layout_of_one(path)
    if layout is None:
        raise DataError(
            f"{path}: holds no folder of images ({', '.join(ALONE[:4])} or others); give one with "
            "left/"
        )
    files = list_images(layout.left)

    def load(k: int) -> Image:
        return load_gray(files[k])[0]

    doubts = (alternating_note(len(files), load), halves_note(len(files), load))
    notes = (*_empty_partner_note(layout), *filter(None, doubts))
    images = _Images(FilePairs(files, files), notes)
    return _read("mono", layout, images, settings)


def _check_not_stacked(first: Path, size: tuple[int, int], file: Path, rig: Rig) -> None:
    """Raise DataError where the images of one camera seem to hold those of two, one above the other.

    Args:
        first: one of the images.
        size: their width and height, pixels.
        file: the calibration.
        rig: what it states.
    """
    stated = (rig.cam0.width, rig.cam0.height)
    if hint := stacked_hint(size, stated):
        raise DataError(
            f"{first} is {size[0]} x {size[1]} pixels but {file} is for {stated[0]} x "
            f"{stated[1]}{hint}"
        )


def _empty_partner_note(layout: Layout) -> tuple[str, ...]:
    """State that the folder of the right images is there, without any."""
    for left, right in _PAIRS:
        for inside in _INSIDE:
            folder = layout.base / right
            if layout.left == layout.base / left / inside and folder.is_dir():
                return (f"{folder} holds no images: {layout.left} is read as one camera alone",)
    return ()


def read_rgbd(path: Path, settings: DatasetSettings) -> ImageDataset:
    """Read a folder of images and depth images.

    Raises:
        DataError: as `read_plain`.
        CalibrationError: as `read_plain`, or the unit of the depths is not given.
    """
    if is_tum_folder(path):
        listed, depths, times_ns, notes = associated_images(path)
        folder = listed[0].parent
        images = _Images(FilePairs(listed, listed), notes, depths, times_ns)
        return _read("rgbd", Layout(path, path, folder, folder), images, settings)
    layout = _layout_of_one(path)
    if layout is None or not _holds_images(layout.base / "depth"):
        if (found := _depths_in_one_folder(path)) is not None:
            return _read("rgbd", *found, settings)
        raise DataError(
            f"{path}: holds no images beside depth/; give rgb.txt and depth.txt, or left/ and "
            "depth/"
        )
    lefts = list_images(layout.left)
    depth_images = list_images(layout.base / "depth")
    depth_of = {file.stem: k for k, file in enumerate(depth_images)}
    files = lefts.take(k for k, file in enumerate(lefts) if file.stem in depth_of)
    if not files:
        raise DataError(
            f"{layout.base / 'depth'}: no file is named as one of {layout.left}; name them alike"
        )
    _check_depths(depth_images[0], files[0])
    depths_of_files = depth_images.take(depth_of[file.stem] for file in files)
    return _read("rgbd", layout, _Images(FilePairs(files, files), depths=depths_of_files), settings)


def _check_depths(depth: Path, image: Path) -> None:
    """Raise DataError where a depth image has 8 bits and the size of the image, as the right ones of a
    stereo camera have that RTAB-Map writes there.
    """
    with contextlib.suppress(UnreadableImageError):
        pixels, bits = load_gray(depth)
        if bits == 8 and pixels.shape == load_gray(image)[0].shape:
            raise DataError(
                f"{depth}: has 8 bits, too few for depths; where depth/ holds the right images of a "
                "stereo camera, as RTAB-Map's export does, name the folders left and right"
            )


def _read(kind: str, layout: Layout, images: _Images, settings: DatasetSettings) -> ImageDataset:
    """Read what goes with the images: calibration, times, motion samples and ground truth."""
    size, levels, notes = measured_images(images.pairs)
    notes = (*notes, *_page_notes(images.pairs[0]), *overflow_notes(images.pairs))
    if images.side_by_side:
        size = (size[0] // 2, size[1])
        notes = (*notes, "each image holds the left and the right one side by side")
    used = list[Path]()
    is_tum = images.listed_ns is not None
    file, rig = _file_and_rig(kind, layout, size, settings, is_tum=is_tum)
    if kind == "mono":
        _check_not_stacked(images.pairs[0][0], size, file, rig)
    depth_factor = 1.0
    if images.depths is not None:
        depth_factor, factor_notes = _depth_factor(rig, settings, layout.root)
        notes = (*notes, *factor_notes)
        used += [layout.base / "depth", *(layout.root / name for name in LISTS)]
    if images.listed_ns is None:
        times_ns, times_file, time_notes = frame_times(layout, images.pairs)
        notes = (*notes, *time_notes)
    else:
        times_ns = images.listed_ns
        times_file = layout.root / LISTS[0]
    used += _other_lists(kind, layout, times_file)
    times = (times_ns, times_file)
    notes = (*images.notes, *notes)
    has_depths = images.depths is not None
    numbers = numbers_in_names(images.pairs)
    read = ReadImages(kind, layout, (file, rig), times, notes, used, has_depths, numbers)
    parts = read_companions(read, settings)
    dataset = ImageDataset(
        *parts,
        images.pairs,
        imu_noise=rig.imu_noise,
        levels=levels,
        depths=images.depths,
        depth_factor=depth_factor,
        side_by_side=images.side_by_side,
    )
    if images.counted is None or settings.cameras == 1:
        return dataset
    found = pairs_in_step(dataset, images.counted)
    if found is None:
        return dataset
    return _read(kind, layout, _Images(found[0], (found[1],)), settings)


def _page_notes(files: tuple[Path, Path]) -> tuple[str, ...]:
    """Doubt images that hold several, of which the first one is read."""
    for file in dict.fromkeys(files):
        if file.suffix.lower() not in (".tif", ".tiff"):
            continue
        import cv2

        if (count := cv2.imcount(str(file))) > 1:
            return (
                f"doubtful: {file} holds {count} images, of which the first one is read; write each "
                "into a file of its own",
            )
    return ()


def _file_and_rig(
    kind: str,
    layout: Layout,
    size: tuple[int, int],
    settings: DatasetSettings,
    *,
    is_tum: bool,
) -> tuple[Path, Rig]:
    """Return the calibration of images of a size, and its file; the published one of a TUM
    recording without a file.
    """
    file = settings.calibration or (
        calibration_beside(layout) if is_tum else find_calibration_of(layout)
    )
    if file is None:
        return layout.root / LISTS[0], published_camera(layout.root, size)
    rig = rigs.load_rig(file, image_size=size, cameras=2 if kind == "plain" else 1)
    if is_tum and rig.depth_factor is None and file.name in BARE_NAMES:
        rig = replace(rig, depth_factor=DEPTH_FACTOR)
    return file, rig


def _other_lists(kind: str, layout: Layout, times_file: Path | None) -> Iterator[Path]:
    """Yield the lists of the right camera, and of EuRoC's form, that repeat times of the images."""
    of_left = layout.left.parent / "data.csv"
    if kind != "plain" and times_file == layout.left:
        yield of_left
    if times_file == of_left:
        yield layout.right.parent / "data.csv"
    if times_file is not None and times_file.parent == layout.left:
        yield layout.right / times_file.name


def _choose_cameras(path: Path, colour: bool | None) -> tuple[int, int]:
    wanted = [_GRAY, _COLOUR] if colour is None else [_COLOUR] if colour else [_GRAY]
    for cameras in wanted:
        if (path / f"image_{cameras[0]}").is_dir() and (path / f"image_{cameras[1]}").is_dir():
            return cameras
    looked = " or ".join(f"image_{a} with image_{b}" for a, b in wanted)
    hint = "" if colour is None else f" (dataset.colour is {str(colour).lower()})"
    raise DataError(
        f"{path}: holds no {looked}{hint}; give a KITTI odometry folder with both images of each "
        "pair"
    )


def _poses_file(path: Path) -> Path | None:
    """Return the ground truth of a folder, or of a sequence of KITTI's own; None: there is none."""
    absolute = path.absolute()
    candidates = [path / "poses.txt", absolute.parent.parent / "poses" / f"{absolute.name}.txt"]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _read_reference(
    file: Path, times_ns: IntArray, image_numbers: IntArray | None, T_left_cam0: FloatArray
) -> Trajectory:
    """Read the ground truth of camera 0 and move it, and the world, to the left camera; identity
    stays identity.
    """
    truth = read_trajectory(file, fmt="kitti")
    if np.any(T_left_cam0 != np.eye(4)):
        moved = T_left_cam0 @ truth.T_world_body @ se3_inverse(T_left_cam0)
        truth = replace(truth, T_world_body=moved)
    return reference_of_images(truth, times_ns, image_numbers, file)


def _depth_factor(
    rig: Rig, settings: DatasetSettings, where: Path
) -> tuple[float, tuple[str, ...]]:
    """Return the levels per metre of depth images, and a note where setting and calibration
    differ.
    """
    factor = settings.depth_factor or rig.depth_factor
    if factor is None:
        raise CalibrationError(
            f"{where}: the unit of its depth images is not given; add depth_factor (levels per "
            "metre, 1000 for "
            "millimetres) to cam0 of the calibration, or --set dataset.depth_factor=1000"
        )
    if settings.depth_factor is None or rig.depth_factor in (None, factor):
        return factor, ()
    return factor, (
        f"dataset.depth_factor {factor:g} takes the place of the calibration's "
        f"{rig.depth_factor:g}",
    )


def _frame_numbers(pairs: ImagePairs) -> IntArray:
    """Read the frame numbers (F,) from the image names."""
    bad = next((left for left, _ in pairs if not re.fullmatch(r"\d{1,18}", left.stem)), None)
    if bad is not None:
        raise DataError(
            f"{bad}: an image of KITTI raw is named by its frame number (0000000000.png); rename it"
        )
    numbers = np.array([int(left.stem) for left, _ in pairs], dtype=np.int64)
    if (np.diff(numbers) <= 0).any():
        k = int(np.argmax(np.diff(numbers) <= 0))
        raise DataError(
            f"{pairs[k + 1][0]}: its frame number does not increase after {pairs[k][0].name}; name "
            "all images with the "
            "same number of digits"
        )
    return numbers


def _is_both_in_one(path: Path) -> bool:
    try:
        return _pair_in_one_folder(path) is not None or side_by_side(path) is not None
    except DataError:  # of two cameras, but in no pairs, as the reader says
        return True


def _is_mono_of_euroc(path: Path) -> bool:
    return is_euroc_folder(path) and not is_plain_folder(path) and is_mono_folder(path)


def _is_euroc(path: Path) -> bool:
    if is_kitti_folder(path) or not is_euroc_folder(path):
        return False
    return not _is_mono_of_euroc(path) and not lacks_sensor_yaml(path)


READERS = (
    Reader(
        kind="kitti",
        looked_for="a KITTI folder (image_0 image_1 calib.txt times.txt)",
        read=read_kitti,
        is_folder=lambda path: is_kitti_folder(path) and not holds_more_than_kitti(path),
        calibrated_as="plain",
    ),
    Reader(
        kind="kitti_raw",
        looked_for="a KITTI raw drive (image_00 image_01)",
        read=read_kitti_raw,
        is_folder=lambda path: is_kitti_raw_folder(path) and not is_kitti_folder(path),
        calibrated_as="plain",
    ),
    Reader(
        kind="rgbd",
        looked_for="one camera with depth images (rgb.txt depth.txt, or left depth)",
        read=read_rgbd,
        may_be_folder=is_rgbd_folder,
        calibrated_as="rgbd",
    ),
    Reader(
        kind="euroc",
        looked_for="an EuRoC folder (mav0)",
        read=read_euroc,
        is_folder=_is_euroc,
        calibrated_as="plain",
    ),
    Reader(
        kind="plain",
        looked_for="a plain folder (left right and a calibration)",
        read=read_plain,
        is_folder=is_plain_folder,
        may_be_folder=_is_both_in_one,
        calibrated_as="plain",
    ),
    Reader(
        kind="mono",
        looked_for="one camera (left or cam0, a calibration and an IMU)",
        read=read_mono,
        is_folder=_is_mono_of_euroc,
        may_be_folder=is_mono_folder,
        calibrated_as="mono",
    ),
)
