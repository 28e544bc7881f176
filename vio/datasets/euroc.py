"""EuRoC folders in the ASL form: unrectified stereo images, a raw inertial record and ground truth.

`mav0/` holds `cam0 cam1 imu0`, each with `sensor.yaml` and `data.csv`, images in `camN/data/`, and
ground truth in `state_groundtruth_estimate0/data.csv`. A `groundtruth_tum.txt` beside `mav0` is
read as well.

`T_BS` maps sensor coordinates to the body frame. EuRoC's body is the IMU; where the IMU has a
`T_BS` of its own, all poses are transformed to the IMU's frame. Frames are rectified as they are
read: `Recording.camera` and `Recording.T_cam0_imu` are those of the rectified left camera.
Reference: Burri et al., The EuRoC micro aerial vehicle datasets (2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from vio.cameras.rig import rectifier_of
from vio.dataclass import dataclass
from vio.datasets.common import naming
from vio.datasets.companions import Beside, check_overlap, parts_of
from vio.datasets.euroc_files import STATE_CSV, TUM_FILE, read_camera_yaml, read_imu_yaml
from vio.datasets.frame_times import paired
from vio.datasets.image_files import FilePairs, ImageFiles, stem_of
from vio.datasets.image_pairs import ImageDataset, gray_levels
from vio.datasets.images import list_images
from vio.datasets.rigs.plausible import check_camera
from vio.datasets.samples import MotionSamples, imu_samples, in_time_order
from vio.datasets.settings import DatasetSettings
from vio.datasets.tables import read_imu_table, stamped_rows
from vio.datasets.unused import Layout
from vio.errors import DataError
from vio.files.trajectories import read_trajectory
from vio.geometry.distortion import CameraModel, StereoRig
from vio.geometry.lie import FloatArray, se3_inverse
from vio.records import ImuDensities, IntArray, MotionSample, Trajectory


@dataclass(frozen=True, slots=True)
class _Camera:
    """The contents of one camera's folder."""

    model: CameraModel
    T_body_cam: FloatArray  # (4, 4)
    times_ns: IntArray  # (N,) strictly increasing
    files: ImageFiles  # N
    renamed: int  # number of images whose extension differs from their list
    unlisted: int  # number of images that the list does not name
    missing: int  # number of images at the end of the list that are not there


def is_euroc_folder(path: Path) -> bool:
    """Return whether a folder holds `mav0`, or is one."""
    return (path / "mav0").is_dir() or any(
        (path / "cam0" / name).is_file() for name in ("sensor.yaml", "data.csv")
    )


def read_euroc(path: Path, settings: DatasetSettings) -> ImageDataset:
    """Read an EuRoC folder.

    Raises:
        DataError: files are missing, lists and clocks are wrong, or no images match; the message
            names the remedy.
        CalibrationError: a `sensor.yaml` is missing or invalid.
    """
    mav = euroc_base(path)
    left, right = (_read_camera(mav / name) for name in ("cam0", "cam1"))
    for name, camera in (("cam0", left), ("cam1", right)):
        check_camera(camera.model, mav / name / "sensor.yaml")
    T_body_imu, noise, samples, imu_notes = _read_imu(mav / "imu0")
    T_imu_body = se3_inverse(T_body_imu)
    rig = StereoRig(
        left.model, right.model, T_imu_body @ left.T_body_cam, T_imu_body @ right.T_body_cam
    )
    with naming(mav):
        rectifier = rectifier_of(rig, settings.interpolation, settings.projection)
    of_left, of_right, notes = _pair(left, right, mav)
    times_ns = left.times_ns[of_left]
    if samples:
        check_overlap(times_ns, samples.times_ns, mav / "imu0")
    pairs = FilePairs(left.files.take(of_left.tolist()), right.files.take(of_right.tolist()))
    levels, depth_notes = gray_levels(pairs)
    candidates = (mav / STATE_CSV, mav.absolute().parent / TUM_FILE)
    truth = next((file for file in candidates if file.is_file()), None)
    folders = [mav / name for name in ("cam0", "cam1", "imu0")]
    read = [folder / file for folder in folders for file in ("sensor.yaml", "data.csv")]
    layout = Layout(path, mav, mav / "cam0" / "data", mav / "cam1" / "data")
    if truth is None:
        reference = None
    else:
        reference = _read_reference(truth, T_body_imu, rig.T_imu_cam0)
    beside = Beside(
        samples,
        imu_notes,
        reference,
        read if truth is None else [*read, truth],
        (*notes, *depth_notes),
        [mav / "cam0" / "sensor.yaml", mav / "cam1" / "sensor.yaml"],
    )
    parts = parts_of("euroc", layout, rectifier, settings, times_ns, beside)
    return ImageDataset(*parts, pairs, imu_noise=noise, levels=levels)


def euroc_base(path: Path) -> Path:
    """Return the folder of an EuRoC recording that holds cam0 and cam1."""
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    missing = [name for name in ("cam0", "cam1") if not (mav / name).is_dir()]
    if missing:
        raise DataError(
            f"{mav}: holds no {' and no '.join(missing)}; give an EuRoC folder with mav0/cam0 and "
            "mav0/cam1 (stereo)"
        )
    return mav


# --- cameras
# --------------------------------------------------------------------------------------------------


def _read_camera(folder: Path) -> _Camera:
    model, T_body_cam = read_camera_yaml(folder / "sensor.yaml")
    path = folder / "data.csv"
    times_ns, names, lines = stamped_rows(path, 2, "timestamp [ns],filename")
    there = list_images(folder / "data")
    files, renamed = _find_images(there, names, path, lines)
    unlisted = len(set(there.names) - set(files.names))
    missing = len(times_ns) - len(files.names)
    return _Camera(
        model, T_body_cam, times_ns[: len(files.names)], files, renamed, unlisted, missing
    )


def _find_images(
    there: ImageFiles, names: Sequence[str], path: Path, lines: Sequence[int]
) -> tuple[ImageFiles, int]:
    """Return the listed images, and how many have another extension than listed.

    Those missing at the end are left out: the copy of a recording ended early.
    """
    by_name = set(there.names)
    by_stem = {stem_of(name): name for name in there.names}
    found = [name if name in by_name else by_stem.get(Path(name).stem) for name in names]
    present = tuple(file for file in found if file is not None)
    missing = len(found) - len(present)
    if missing and (not present or found[: len(present)] != list(present)):
        first = found.index(None)
        raise DataError(
            f"{path}, line {lines[first]}: {there.folder / names[first]} is missing "
            f"({missing} of "
            f"{len(names)} listed images are); copy it again, or remove such lines"
        )
    others = sum(file != name for file, name in zip(present, names, strict=False))
    return ImageFiles(there.folder, present), others


def _pair(left: _Camera, right: _Camera, mav: Path) -> tuple[IntArray, IntArray, tuple[str, ...]]:
    """Indices (F,), (F,) of the left and right images that form pairs, and notes about the
    pairing.
    """
    a, b, differing = paired(left.times_ns, right.times_ns, ("cam0", "cam1"), mav)
    notes: list[str] = []
    if renamed := left.renamed + right.renamed:
        notes.append(
            f"{renamed} images have another extension than listed in their data.csv; matched by "
            "their stem"
        )
    for name, camera in (("cam0", left), ("cam1", right)):
        if camera.missing:
            listed = len(camera.times_ns) + camera.missing
            notes.append(
                f"the last {camera.missing} of {listed} listed images of {name} are missing; "
                f"{len(a)} pairs are used"
            )
    if left.unlisted or right.unlisted:
        notes.append(
            f"{left.unlisted} images of cam0 and {right.unlisted} of cam1 are not listed in their "
            "data.csv and are "
            "skipped"
        )
    return a, b, (*notes, *differing)


# --- inertial record and ground truth
# -------------------------------------------------------------------------------


def _read_imu(
    folder: Path,
) -> tuple[FloatArray, ImuDensities | None, MotionSamples[MotionSample], tuple[str, ...]]:
    """Return `T_body_imu` (4, 4), noise, samples and notes; the body is the IMU where there is
    no folder of one.
    """
    T_body_imu = np.eye(4)
    noise = None
    notes = list[str]()
    if not folder.is_dir():
        return T_body_imu, noise, in_time_order(), ()
    if (path := folder / "sensor.yaml").is_file():
        T_body_imu, noise = read_imu_yaml(path)
    else:
        notes.append(
            f"{path} is missing; the IMU is assumed to be the body frame, its noise is unknown"
        )
    record, notes_read = read_imu_table(folder / "data.csv", cut=notes, whole_ns=True)
    return T_body_imu, noise, in_time_order(imu_samples(record)), (*notes, *notes_read)


def _read_reference(file: Path, T_body_imu: FloatArray, T_imu_cam0: FloatArray) -> Trajectory:
    """Read the ground truth of the IMU.

    EuRoC's describes the body; a TUM file may describe the (raw) cam0.
    """
    euroc = file.name == STATE_CSV.name
    truth = (
        read_trajectory(file, fmt="euroc", body="imu")
        if euroc
        else read_trajectory(file, fmt="tum")
    )
    if truth.body == "cam0":
        return truth.in_imu(se3_inverse(T_imu_cam0))
    return replace(truth, T_world_body=truth.T_world_body @ T_body_imu)
