"""A plain folder of stereo images: two image folders, a calibration, and what else lies there.

Images: `left right`, `image_0 image_1`, `cam0 cam1` and other usual names, the files in the folder or in its `data` or
`images`. Calibration: any that `vio.load_rig` reads. Optional: `times.txt`, `imu.csv`, `velocity.csv`,
`T_cam0_imu.txt`, and ground truth in `reference.tum`. TUM-VI in both of its forms is such a folder. What lies there
and is not used is named in the recording's notes.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from vio.datasets.common import naming
from vio.datasets.companions import (
    IMU_FILES,
    calibration_beside,
    find_calibration_of,
    read_motion,
    read_reference,
    sources_of,
    with_extrinsics,
)
from vio.datasets.dates import drive_times, is_date
from vio.datasets.euroc_files import stamped_rows
from vio.datasets.image_files import FilePairs, ImageFiles
from vio.datasets.image_pairs import ImagePairs, ImageSize, first_readable, full_scale
from vio.datasets.images import SUFFIXES, list_images
from vio.datasets.pairing import pair_stamps
from vio.datasets.rectified import RectifiedDataset
from vio.datasets.rigs import find_calibration, load_rig
from vio.datasets.settings import DatasetSettings
from vio.datasets.tables import parse_stamps
from vio.datasets.unused import Layout, unused_note
from vio.errors import DataError
from vio.files.text import text_lines
from vio.records import NS_PER_S, IntArray, Recording

_FOLDERS = (
    ("left", "right"),
    ("Left", "Right"),
    ("cam0", "cam1"),
    ("image_0", "image_1"),
    ("image_00", "image_01"),
    ("image_2", "image_3"),
    ("image_02", "image_03"),
    ("images_left", "images_right"),
    ("image_left", "image_right"),
    ("left_images", "right_images"),
    ("image_lcam_front", "image_rcam_front"),
    ("infra1", "infra2"),
)
_INSIDE = ("data", "images", "")
_ASSUMED_HZ = 10.0  # where no times are given and no other sensor needs them


def is_plain_folder(path: Path) -> bool:
    """Return whether a folder holds two image folders of known names."""
    return _layout(path) is not None


def holds_more_than_kitti(path: Path) -> bool:
    """Return whether a folder with KITTI's names has an IMU, or another calibration that goes before `calib.txt`."""
    if not is_plain_folder(path):
        return False
    if any((path / name).is_file() for name in IMU_FILES) or not any((path / f"image_{k}").is_dir() for k in (0, 2)):
        return True
    return find_calibration(path) not in (None, path / "calib.txt")


def lacks_sensor_yaml(path: Path) -> bool:
    """Return whether a folder with EuRoC's names has its calibration elsewhere, as TUM-VI's export."""
    layout = _layout(path)
    if layout is None or any((base / "cam0" / "sensor.yaml").is_file() for base in (layout.base, layout.root)):
        return False
    return calibration_beside(layout) is not None


def image_folders(path: Path) -> tuple[Path, Path] | None:
    """Return the left and right image folder of a plain folder; None: it has none."""
    found = _layout(path)
    return None if found is None else (found.left, found.right)


def _layout(path: Path) -> Layout | None:
    for base in (path, path / "mav0"):
        for names in _FOLDERS:
            for inside in _INSIDE:
                left, right = (base / name / inside for name in names)
                if _holds_images(left) and _holds_images(right):
                    return Layout(path, base, left, right)
    return None


def _holds_images(folder: Path) -> bool:
    return folder.is_dir() and any(child.suffix.lower() in SUFFIXES for child in folder.iterdir())


def read_plain(path: Path, settings: DatasetSettings) -> RectifiedDataset:
    """Read a plain folder.

    Raises:
        DataError: images, times or samples cannot be used; the message names file and remedy.
        CalibrationError: there is no calibration, or it is invalid.
    """
    layout = _layout(path)
    if layout is None:
        names = ", ".join(f"{a} {b}" for a, b in _FOLDERS[:4])
        raise DataError(f"{path}: holds no pair of image folders ({names} or others); give one with left/ and right/")
    pairs, notes = pair_files(list_images(layout.left), list_images(layout.right))
    measured, image, bits = first_readable(pairs)
    white, depth_notes = full_scale(pairs)
    if bits == 16 and not depth_notes:
        depth_notes = (f"images have 16 bits ({measured.name}); scaled to 8 bits by 1/257",)
    file = settings.calibration or find_calibration_of(layout)
    rig = load_rig(file, image_size=(image.shape[1], image.shape[0]))
    rig, used = with_extrinsics(rig, layout, file)
    times_ns, times_file, time_notes = frame_times(layout, pairs)
    motion, motion_files, motion_notes = read_motion(layout, rig, times_ns, times_file is not None)
    with naming(file):
        rectifier = rig.rectifier(settings.interpolation, settings.projection)
    reference, reference_file = read_reference(layout, rig, rectifier, times_ns)
    sources = [file, times_file, *used, *motion_files, reference_file]
    recording = Recording(
        kind="plain",
        path=path,
        camera=rectifier.camera,
        T_cam0_imu=None if rig.T_cam0_imu is None else rectifier.T_rect0_imu,
        frame_times_ns=times_ns,
        has_images=True,
        motion=sources_of(motion_files),
        reference=reference,
        notes=(
            *notes,
            *depth_notes,
            *rig.notes,
            *rectifier.notes,
            *time_notes,
            *motion_notes,
            *unused_note(layout, [s for s in sources if s is not None]),
        ),
    )
    sizes = (ImageSize(rig.cam0.width, rig.cam0.height, file), ImageSize(rig.cam1.width, rig.cam1.height, file))
    return RectifiedDataset(recording, pairs, motion, sizes, settings, rectifier, rig.imu_noise, white=white)


# --- images and times -----------------------------------------------------------------------------------------------


def pair_files(lefts: ImageFiles, rights: ImageFiles) -> tuple[ImagePairs, tuple[str, ...]]:
    """Pair image files by equal names, by the last number in their names, or by stamps in their names.

    Raises:
        DataError: the names share nothing.
    """
    keys: list[list[str | int]] = [[p.stem for p in lefts], [p.stem for p in rights]]
    if not set(keys[0]) & set(keys[1]):
        keys = [[_last_number(p) for p in files] for files in (lefts, rights)]
    if not set(keys[0]) & set(keys[1]) and all(_is_stamp(p.stem) for p in (*lefts, *rights)):
        a, b = pair_stamps(*(np.array([int(p.stem) for p in files], dtype=np.int64) for files in (lefts, rights)))
        keys = [list(range(len(lefts))), [-1] * len(rights)]
        for i, j in zip(a.tolist(), b.tolist(), strict=True):
            keys[1][j] = i
    right_of = {key: k for k, key in enumerate(keys[1])}
    if len(right_of) < len(rights) and -1 not in right_of:
        raise DataError(f"{rights[0].parent}: several images have the same number; number them uniquely")
    rows = [(k, right_of[key]) for k, key in enumerate(keys[0]) if key in right_of]
    pairs = FilePairs(lefts.take(k for k, _ in rows), rights.take(k for _, k in rows))
    if not pairs:
        raise DataError(
            f"{lefts[0].parent} and {rights[0].parent}: no name of the one fits one of the other ({lefts[0].name}, "
            f"{rights[0].name}); give both images of a pair the same name or number"
        )
    alone = len(lefts) - len(pairs), len(rights) - len(pairs)
    if not any(alone):
        return pairs, ()
    return pairs, (f"{alone[0]} left and {alone[1]} right images have no partner and are skipped",)


def _last_number(path: Path) -> int | str:
    found = re.findall(r"\d+", path.stem)
    return int(found[-1]) if found else path.stem


def _is_stamp(stem: str) -> bool:
    """Return whether a name is a time since 1970 in milliseconds to nanoseconds."""
    return re.fullmatch(r"\d{13,19}", stem) is not None


def frame_times(layout: Layout, pairs: ImagePairs) -> tuple[IntArray, Path | None, tuple[str, ...]]:
    """Return the times (F,) of the pairs, where they come from (None: assumed), and notes.

    Raises:
        DataError: `times.txt` does not fit the images, or the times do not increase.
    """
    for folder in dict.fromkeys((layout.base, layout.root, layout.left, layout.left.parent)):
        for name in ("times.txt", "timestamps.txt"):
            if (file := folder / name).is_file():
                return times_of(file, pairs), file, ()
    stems = [left.stem for left, _ in pairs]
    if all(_is_stamp(stem) or re.fullmatch(r"\d{9,10}\.\d{1,9}", stem) for stem in stems):
        return parse_stamps(stems, lambda k: str(pairs[k][0])), layout.left, ()
    if (file := layout.left.parent / "data.csv").is_file():
        return _listed_times(file, pairs), file, ()
    note = (
        f"{layout.root}: no times.txt; frames are taken to be {1 / _ASSUMED_HZ:g} s apart, so speeds are unknown; "
        "write one time an image (seconds or nanoseconds) into times.txt"
    )
    return np.arange(len(pairs), dtype=np.int64) * round(NS_PER_S / _ASSUMED_HZ), None, (note,)


def _listed_times(file: Path, pairs: ImagePairs) -> IntArray:
    """Read the times (F,) of images from EuRoC's list of a camera.

    Raises:
        DataError: it lacks an image, or cannot be read.
    """
    times_ns, rows, _ = stamped_rows(file, 2, "timestamp [ns], filename")
    time_of = dict(zip(rows, times_ns.tolist(), strict=True))
    missing = next((left.name for left, _ in pairs if left.name not in time_of), None)
    if missing is not None:
        raise DataError(f"{file}: does not list {missing}; copy both again, or remove the image")
    return np.array([time_of[left.name] for left, _ in pairs], dtype=np.int64)


def times_of(file: Path, pairs: ImagePairs) -> IntArray:
    """Read the times (F,) of image pairs: one a line, or `name time` where the first column names the images.

    Dates are those of a KITTI raw drive, which is a plain folder where it is run with another calibration.

    Raises:
        DataError: the file does not fit the images, or the times do not increase.
    """
    numbers = [_last_number(left) for left, _ in pairs]
    if is_date(next((line for _, line in text_lines(file)), "")) and all(isinstance(n, int) for n in numbers):
        return drive_times(file, np.array(numbers, dtype=np.int64))
    rows = [(n, line.replace(",", " ").split()) for n, line in text_lines(file) if line.strip()[:1] not in ("#", "")]
    by_name = {Path(fields[0]).stem: (n, fields[1]) for n, fields in rows if len(fields) > 1}
    if by_name and all(left.stem in by_name for left, _ in pairs):
        chosen = [by_name[left.stem] for left, _ in pairs]
    elif len(rows) == len(pairs):
        chosen = [(n, fields[0]) for n, fields in rows]
    else:
        raise DataError(
            f"{file} holds {len(rows)} times for {len(pairs)} image pairs; there must be one time an image, or lines "
            "'name time'"
        )
    return parse_stamps([text for _, text in chosen], lambda k: f"{file}, line {chosen[k][0]}")
