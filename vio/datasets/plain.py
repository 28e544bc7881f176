"""A plain folder of stereo images: two image folders, a calibration, and what else lies there.

Images: `left right`, `image_0 image_1`, `cam0 cam1` and other usual names, the files in the folder or in its `data` or
`images`. Calibration: any that `vio.load_rig` reads. Optional: `times.txt`, `imu.csv`, `velocity.csv`,
`T_cam0_imu.txt`, and ground truth in `reference.tum`. TUM-VI in both of its forms is such a folder. What lies there
and is not used is named in the recording's notes.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vio.datasets.common import imu_samples, naming
from vio.datasets.image_pairs import ImagePairs, ImageSize, first_readable
from vio.datasets.images import SUFFIXES, list_images
from vio.datasets.kitti import read_extrinsics
from vio.datasets.overlap import check_overlap, reference_of_body
from vio.datasets.pairing import pair_stamps
from vio.datasets.rectified import RectifiedDataset, make_rectifier
from vio.datasets.rigs import find_calibration, load_rig
from vio.datasets.settings import DatasetSettings
from vio.datasets.tables import parse_stamps, read_imu_table, read_velocity_table
from vio.errors import CalibrationError, DataError
from vio.records import NS_PER_S, IntArray, MotionSample, MotionSource, Recording, Trajectory
from vio.rig import Rectifier, Rig
from vio.text_files import text_lines
from vio.trajectory_io import read_trajectory

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
_IMU = ("imu.csv", "imu.txt", "imu0.csv", "imu_data.csv", "imu0/data.csv")
_REFERENCES = (
    "reference.tum",
    "reference.txt",
    "groundtruth.tum",
    "groundtruth_tum.txt",
    "groundtruth.txt",
    "gt_imu.csv",
    "mocap0/data.csv",
    "state_groundtruth_estimate0/data.csv",
    "poses.txt",
)
_CALIBRATION_FOLDERS = ("", "dso", "calibration", "calib")
_SILENT = ("readme*", "license*", "*.md", "simulation.json", "rectification.json", "conversion.json")  # no data
_ASSUMED_HZ = 10.0  # where nothing tells the times and no other sensor needs them
_NAMED = 12  # unused files listed by name


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where the parts of a recording lie."""

    root: Path  # the folder that was given
    base: Path  # holds the image folders: the root, or its mav0
    left: Path  # folder of the images
    right: Path


def is_plain_folder(path: Path) -> bool:
    """Return whether a folder holds two image folders of known names."""
    return _layout(path) is not None


def holds_more_than_kitti(path: Path) -> bool:
    """Return whether a folder with KITTI's names has an IMU, or another calibration in the place of `calib.txt`."""
    if not is_plain_folder(path):
        return False
    if any((path / name).is_file() for name in _IMU) or not any((path / f"image_{k}").is_dir() for k in (0, 2)):
        return True
    return not (path / "calib.txt").is_file() and find_calibration(path) is not None


def lacks_sensor_yaml(path: Path) -> bool:
    """Return whether a folder with EuRoC's names has its calibration elsewhere, as TUM-VI's export."""
    layout = _layout(path)
    if layout is None or any((base / "cam0" / "sensor.yaml").is_file() for base in (layout.base, layout.root)):
        return False
    return _calibration_beside(layout) is not None


def image_folders(path: Path) -> tuple[Path, Path] | None:
    """Return the left and right image folder of a plain folder; None: it has none."""
    found = _layout(path)
    return None if found is None else (found.left, found.right)


def _layout(path: Path) -> _Layout | None:
    for base in (path, path / "mav0"):
        for names in _FOLDERS:
            for inside in _INSIDE:
                left, right = (base / name / inside for name in names)
                if _holds_images(left) and _holds_images(right):
                    return _Layout(path, base, left, right)
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
    measured, image, bits = first_readable(pairs, settings.max_bad_frames)
    file = settings.calibration or _find_calibration(layout)
    rig = load_rig(file, image_size=(image.shape[1], image.shape[0]))
    rig, used = _with_extrinsics(rig, layout, file)
    times_ns, times_file, time_notes = _frame_times(layout, pairs)
    motion, motion_files, motion_notes = _read_motion(layout, rig, times_ns, times_file is not None)
    rectifier = make_rectifier(rig.stereo, settings.interpolation, file)
    reference, reference_file = _read_reference(layout, rig, rectifier, times_ns)
    sources = [file, times_file, *used, *motion_files, reference_file]
    recording = Recording(
        kind="plain",
        path=path,
        camera=rectifier.camera,
        T_cam0_imu=None if rig.T_cam0_imu is None else rectifier.T_rect0_imu,
        frame_times_ns=times_ns,
        has_images=True,
        motion=_sources_of(motion_files),
        reference=reference,
        notes=(
            *notes,
            *([] if bits == 8 else [f"images have {bits} bits ({measured.name}); they are scaled to 8 bits"]),
            *rig.notes,
            *time_notes,
            *motion_notes,
            *unused_note(layout, [s for s in sources if s is not None]),
        ),
    )
    sizes = (ImageSize(rig.cam0.width, rig.cam0.height, file), ImageSize(rig.cam1.width, rig.cam1.height, file))
    return RectifiedDataset(recording, pairs, motion, sizes, settings, rectifier, rig.imu_noise)


# --- images and times -----------------------------------------------------------------------------------------------


def pair_files(lefts: Sequence[Path], rights: Sequence[Path]) -> tuple[ImagePairs, tuple[str, ...]]:
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
    right_of = dict(zip(keys[1], rights, strict=True))
    if len(right_of) < len(rights) and -1 not in right_of:
        raise DataError(f"{rights[0].parent}: several images have the same number; number them uniquely")
    pairs = tuple((p, right_of[key]) for key, p in zip(keys[0], lefts, strict=True) if key in right_of)
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


def _frame_times(layout: _Layout, pairs: ImagePairs) -> tuple[IntArray, Path | None, tuple[str, ...]]:
    """Return the times (F,) of the pairs, where they come from (None: assumed), and notes.

    Raises:
        DataError: `times.txt` does not fit the images, or the times do not increase.
    """
    for folder in dict.fromkeys((layout.base, layout.root, layout.left, layout.left.parent)):
        for name in ("times.txt", "timestamps.txt"):
            if (file := folder / name).is_file():
                return _times_of(file, pairs), file, ()
    stems = [left.stem for left, _ in pairs]
    if all(_is_stamp(stem) or re.fullmatch(r"\d{9,10}\.\d{1,9}", stem) for stem in stems):
        return parse_stamps(stems, lambda k: str(pairs[k][0])), layout.left, ()
    note = (
        f"{layout.root}: no times.txt; frames are taken to be {1 / _ASSUMED_HZ:g} s apart, so speeds are unknown; "
        "write one time an image (seconds or nanoseconds) into times.txt"
    )
    return np.arange(len(pairs), dtype=np.int64) * round(NS_PER_S / _ASSUMED_HZ), None, (note,)


def _times_of(file: Path, pairs: ImagePairs) -> IntArray:
    """Read one time an image, or `name time` where the first column names the images."""
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


# --- calibration, motion, ground truth ------------------------------------------------------------------------------


def _calibration_beside(layout: _Layout) -> Path | None:
    for base in dict.fromkeys(
        (layout.root, layout.base, *([layout.root.parent] if layout.root.name == "mav0" else []))
    ):
        for inside in _CALIBRATION_FOLDERS:
            if (base / inside).is_dir() and (found := find_calibration(base / inside)) is not None:
                return found
    return None


def _find_calibration(layout: _Layout) -> Path:
    if (found := _calibration_beside(layout)) is not None:
        return found
    raise CalibrationError(
        f"{layout.root}: no calibration; add one as calibration.yaml (Kalibr's camchain, OpenCV's M1 D1 M2 D2 R T), "
        "calib.txt (KITTI's) or another that vio.load_rig reads, or name it with --calibration FILE"
    )


def _with_extrinsics(rig: Rig, layout: _Layout, file: Path) -> tuple[Rig, list[Path]]:
    """Add `T_cam0_imu.txt` where the calibration itself has none."""
    path = layout.root / "T_cam0_imu.txt"
    if rig.T_cam0_imu is not None or not path.is_file():
        return rig, [path] if file.name == "calib.txt" else []
    return replace(rig, T_cam0_imu=read_extrinsics(path)), [path]


def _read_motion(
    layout: _Layout, rig: Rig, times_ns: IntArray, timed: bool
) -> tuple[tuple[MotionSample, ...], list[Path], list[str]]:
    """Read the IMU and the velocities, on the clock of the images; return the samples, their files and notes."""
    imu = next((f for base in (layout.root, layout.base) for n in _IMU if (f := base / n).is_file()), None)
    velocity = layout.root / "velocity.csv"
    files = [f for f in (imu, velocity) if f is not None and f.is_file()]
    if not files:
        return (), [], []
    if not timed:
        raise DataError(f"{files[0]}: needs the times of the images on the same clock; add times.txt, or remove it")
    if rig.T_cam0_imu is None:
        raise CalibrationError(
            f"{files[0]}: needs the pose of its sensor; add T_cam0_imu.txt (IMU to left camera), or use a calibration "
            "with T_cam_imu (Kalibr's camchain-imucam), or remove the file to use the images alone"
        )
    samples: list[MotionSample] = []
    notes: list[str] = []
    if imu is not None:
        record, found = read_imu_table(imu)
        shift_ns = round(rig.time_offset_s * NS_PER_S)
        record = replace(record, times_ns=record.times_ns - shift_ns)
        notes += found
        if shift_ns:
            notes.append(f"the IMU's stamps are moved by {-1e3 * rig.time_offset_s:+.3f} ms, as the calibration states")
        check_overlap(times_ns, record.times_ns, imu)
        samples += imu_samples(record)
    if velocity.is_file():
        speeds = read_velocity_table(velocity)
        check_overlap(times_ns, np.array([s.time_ns for s in speeds], dtype=np.int64), velocity)
        samples += speeds
    return tuple(sorted(samples, key=lambda s: s.time_ns)), files, notes


def _sources_of(files: Sequence[Path]) -> frozenset[MotionSource]:
    return frozenset("velocity" if file.name == "velocity.csv" else "imu" for file in files)


def _read_reference(
    layout: _Layout, rig: Rig, rectifier: Rectifier, times_ns: IntArray
) -> tuple[Trajectory | None, Path | None]:
    """Read the ground truth as that of the body: the IMU, or the rectified left camera where there is none."""
    bases = (layout.root, layout.base, layout.root / "dso")
    file = next((f for n in _REFERENCES for base in bases if (f := base / n).is_file()), None)
    if file is None:
        return None, None
    truth = read_trajectory(file)
    if truth.times_ns is None:
        if len(truth) > len(times_ns):
            raise DataError(f"{file} holds {len(truth)} poses for {len(times_ns)} pairs; give one line for each pair")
        truth = replace(truth, times_ns=times_ns[: len(truth)], frame_indices=np.arange(len(truth)))
    with naming(file):
        return reference_of_body(truth, rig, rectifier), file


# --- what is not used -----------------------------------------------------------------------------------------------


def unused_note(layout: _Layout, used: Sequence[Path]) -> list[str]:
    """Return one note that names what lies in the folder and was not read."""
    kept = {layout.left.absolute(), layout.right.absolute(), *(file.absolute() for file in used)}
    kept |= {parent for path in kept for parent in path.parents}
    for path in used:  # the other files of a calibration that lies in several
        if path.suffix.lower() in (".yaml", ".yml", ".txt", ".xml"):
            kept |= {other.absolute() for other in path.parent.iterdir() if _belongs(other, path)}
    folders = dict.fromkeys(
        (layout.root, layout.base, layout.left, layout.right, layout.left.parent, layout.right.parent)
    )
    found = []
    for folder in folders:
        if folder != layout.root and layout.root not in folder.parents:
            continue
        for child in sorted(folder.iterdir()):
            image = folder in (layout.left, layout.right) and child.suffix.lower() in SUFFIXES
            silent = child.name.startswith(".") or any(fnmatch.fnmatch(child.name.lower(), s) for s in _SILENT)
            if not image and not silent and child.absolute() not in kept:
                found.append(str(child.relative_to(layout.root)) + ("/" if child.is_dir() else ""))
    if not found:
        return []
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    return [f"not used: {', '.join(found[:_NAMED])}{more}"]


def _belongs(other: Path, calibration: Path) -> bool:
    """Return whether a file is read together with a calibration file."""
    partners = {"left": "right", "intrinsic": "extrinsic", "camchain": "imu", "calibration": "imu"}
    named = any(a in calibration.name and b in other.name for a, b in partners.items())
    return (named and other.suffix in (".yaml", ".yml")) or (
        calibration.name.startswith("calib_cam_to_cam")
        and (other.name in ("calib_velo_to_cam.txt", "calib_imu_to_velo.txt"))
    )
