"""EuRoC folders in the ASL form: unrectified stereo images, a raw inertial record and ground truth.

`mav0/` holds `cam0 cam1 imu0`, each with `sensor.yaml` and `data.csv`, images in `camN/data/`, and ground truth in
`state_groundtruth_estimate0/data.csv`. A `groundtruth_tum.txt` beside `mav0` serves as well.

`T_BS` maps sensor coordinates to the body frame. EuRoC's body is the IMU; where the IMU has a `T_BS` of its own, all
is moved to the IMU's frame. Frames are rectified as they are read: `Recording.camera` and `Recording.T_cam0_imu` are
those of the rectified left camera.
Reference: Burri et al., The EuRoC micro aerial vehicle datasets (2016).
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from vio.datasets.common import checked_transform, text_lines
from vio.datasets.images import list_images
from vio.datasets.rectified import ImuDensities, RectifiedDataset, make_rectifier, write_frames
from vio.datasets.settings import DatasetSettings
from vio.errors import CalibrationError, DataError
from vio.geometry.distortion import CameraModel, DistortionModel, StereoRig
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.records import ImuSample, IntArray, MotionSource, Recording, StereoFrame, Trajectory
from vio.trajectory_io import read_trajectory

DISTORTION_MODELS: dict[str, DistortionModel] = {
    "radial-tangential": "radtan",
    "radtan": "radtan",
    "plumb_bob": "radtan",
    "equidistant": "equidistant",
    "none": "pinhole",
}
_STATE = Path("state_groundtruth_estimate0", "data.csv")
_TUM = "groundtruth_tum.txt"
_NOISE = (
    "gyroscope_noise_density",
    "gyroscope_random_walk",
    "accelerometer_noise_density",
    "accelerometer_random_walk",
)
_PAIRED_NS = 3_000_000  # stamps further apart belong to different exposures
_JITTER_NS = 1_000_000  # by which the offset between paired stamps may vary around its median
_INT64_MAX = 2**63 - 1


@dataclass(frozen=True, slots=True)
class _Camera:
    """What the folder of one camera says."""

    model: CameraModel
    T_body_cam: FloatArray  # (4, 4)
    times_ns: IntArray  # (N,) strictly increasing
    files: tuple[Path, ...]  # N images
    renamed: int  # images that carry another extension than their list says


@dataclass(frozen=True, slots=True)
class _Imu:
    """What the folder of the IMU says."""

    T_body_imu: FloatArray  # (4, 4)
    noise: ImuDensities | None
    samples: tuple[ImuSample, ...]
    notes: tuple[str, ...]


def is_euroc_folder(path: Path) -> bool:
    """Say whether a folder holds `mav0`, or is one."""
    return (path / "mav0").is_dir() or any((path / "cam0" / name).is_file() for name in ("sensor.yaml", "data.csv"))


def read_euroc(path: Path, settings: DatasetSettings) -> RectifiedDataset:
    """Read an EuRoC folder.

    Raises:
        DataError: files are missing, lists and clocks are wrong, or no images match; the message names the remedy.
        CalibrationError: a `sensor.yaml` is missing or cannot be right.
    """
    mav = _mav(path)
    left, right = (_read_camera(mav / name) for name in ("cam0", "cam1"))
    imu = _read_imu(mav / "imu0")
    T_imu_body = se3_inverse(imu.T_body_imu)
    rig = StereoRig(left.model, right.model, T_imu_body @ left.T_body_cam, T_imu_body @ right.T_body_cam)
    rectifier = make_rectifier(rig, settings.interpolation, mav)
    of_left, of_right, notes = _pair(left, right, mav)
    times_ns = left.times_ns[of_left]
    if imu.samples and (imu.samples[-1].time_ns < times_ns[0] or imu.samples[0].time_ns > times_ns[-1]):
        from vio.inertial_check import judge_clocks  # it imports readers

        (finding,) = judge_clocks(times_ns, np.array([x.time_ns for x in imu.samples], dtype=np.int64))
        raise DataError(
            f"{mav / 'imu0' / 'data.csv'}: no IMU sample falls into the time of the images; {finding.message}; or take "
            "imu0 away"
        )
    motion: frozenset[MotionSource] = frozenset({"imu"}) if imu.samples else frozenset()
    recording = Recording(
        kind="euroc",
        path=path,
        camera=rectifier.camera,
        T_cam0_imu=rectifier.T_rect0_imu,
        frame_times_ns=times_ns,
        has_images=True,
        motion=motion,
        reference=_read_reference(mav, imu.T_body_imu, rig.T_imu_cam0),
        notes=(*notes, *imu.notes),
    )
    return RectifiedDataset(
        recording=recording,
        pairs=tuple((left.files[a], right.files[b]) for a, b in zip(of_left.tolist(), of_right.tolist(), strict=True)),
        motion=imu.samples,
        rectifier=rectifier,
        calibrated_in=(mav / "cam0" / "sensor.yaml", mav / "cam1" / "sensor.yaml"),
        settings=settings,
        imu_noise=imu.noise,
    )


def _mav(path: Path) -> Path:
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    missing = [name for name in ("cam0", "cam1") if not (mav / name).is_dir()]
    if missing:
        raise DataError(
            f"{mav}: holds no {' and no '.join(missing)}; give an EuRoC folder with mav0/cam0 and mav0/cam1 (stereo)"
        )
    return mav


# --- cameras --------------------------------------------------------------------------------------------------------


def _read_camera(folder: Path) -> _Camera:
    model, T_body_cam = read_camera_yaml(folder / "sensor.yaml")
    path = folder / "data.csv"
    times_ns, rows, lines = _stamped_rows(path, 2, "timestamp [ns],filename")
    files, renamed = _find_images(folder / "data", [row[0] for row in rows], path, lines)
    return _Camera(model, T_body_cam, times_ns, files, renamed)


def read_camera_yaml(path: Path) -> tuple[CameraModel, FloatArray]:
    """Read a camera's `sensor.yaml`: its model, and `T_BS` (4, 4) from the camera to the body.

    Raises:
        CalibrationError: the file is missing, lacks an entry, or holds an impossible one.
    """
    sheet = _read_yaml(path)
    if (kind := sheet.get("camera_model", "pinhole")) != "pinhole":
        raise CalibrationError(f"{path}: camera_model {kind!r} is not supported; only 'pinhole' is (with distortion)")
    name = sheet.get("distortion_model", "none")
    if not isinstance(name, str) or name not in DISTORTION_MODELS:
        raise CalibrationError(
            f"{path}: distortion_model {name!r} is unknown; the known ones are {', '.join(DISTORTION_MODELS)}"
        )
    model = DISTORTION_MODELS[name]
    coefficients = () if model == "pinhole" else _numbers(sheet, "distortion_coefficients", path)
    if model == "radtan" and not any(coefficients):
        model, coefficients = "pinhole", ()
    fu, fv, cu, cv = _numbers(sheet, "intrinsics", path, 4)
    width, height = _numbers(sheet, "resolution", path, 2)
    try:
        camera = CameraModel(fu, fv, cu, cv, int(width), int(height), model, coefficients)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error
    return camera, _T_BS(sheet, path)


def _find_images(folder: Path, names: Sequence[str], path: Path, lines: Sequence[int]) -> tuple[tuple[Path, ...], int]:
    """The listed images, and how many of them carry another extension than the list says."""
    there = list_images(folder)
    by_name, by_stem = {file.name: file for file in there}, {file.stem: file for file in there}
    found = [by_name.get(name) or by_stem.get(Path(name).stem) for name in names]
    missing = [k for k, file in enumerate(found) if file is None]
    if missing:
        raise DataError(
            f"{path}, line {lines[missing[0]]}: {folder / names[missing[0]]} is missing ({len(missing)} of "
            f"{len(names)} listed images are); copy it again, or remove such lines"
        )
    files = tuple(file for file in found if file is not None)
    return files, sum(file.name != name for file, name in zip(files, names, strict=True))


def _pair(left: _Camera, right: _Camera, mav: Path) -> tuple[IntArray, IntArray, tuple[str, ...]]:
    """Indices (F,), (F,) of the left and right images that make a pair, and what there is to say about them.

    Raises:
        DataError: no image has a partner.
    """
    a, b = pair_stamps(left.times_ns, right.times_ns)
    if not len(a):
        spans = [f"{c.times_ns[0]} to {c.times_ns[-1]} ns" for c in (left, right)]
        raise DataError(
            f"{mav}: no image of cam0 ({spans[0]}) has one of cam1 ({spans[1]}) within {_PAIRED_NS / 1e6:g} ms; "
            "both data.csv must use one clock and come from one recording"
        )
    notes: list[str] = []
    if renamed := left.renamed + right.renamed:
        notes.append(f"{renamed} images carry another extension than their data.csv says; taken by their stem")
    alone = len(left.times_ns) - len(a), len(right.times_ns) - len(b)
    if any(alone):
        notes.append(f"{alone[0]} images of cam0 and {alone[1]} of cam1 have no partner and are left out")
    offset_ms = float(np.median(right.times_ns[b] - left.times_ns[a])) / 1e6
    if np.any(right.times_ns[b] != left.times_ns[a]):
        notes.append(
            f"the stamps of cam1 differ from those of cam0 (median {offset_ms:+.3f} ms); each left image is paired "
            "with the nearest right one"
        )
    return a, b, tuple(notes)


def pair_stamps(left_ns: IntArray, right_ns: IntArray) -> tuple[IntArray, IntArray]:
    """Indices (F,), (F,) of stamps that belong together: equal ones, or nearest ones at a small, steady offset."""
    _, equal_a, equal_b = np.intersect1d(left_ns, right_ns, assume_unique=True, return_indices=True)
    b = _nearest(left_ns, right_ns)
    a = np.arange(len(left_ns))
    offset = right_ns[b] - left_ns
    near = (np.abs(offset) < _PAIRED_NS) & (_nearest(right_ns, left_ns)[b] == a)
    if 2 * len(equal_a) >= near.sum():
        return equal_a.astype(np.int64), equal_b.astype(np.int64)
    steady = near & (np.abs(offset - np.median(offset[near])) <= _JITTER_NS)
    return a[steady], b[steady]


def _nearest(of: IntArray, among: IntArray) -> IntArray:
    """Index (N,) of the nearest of sorted times (M,) for each of (N,) times."""
    after = np.clip(np.searchsorted(among, of), 1, max(len(among) - 1, 1))
    after = np.minimum(after, len(among) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(among[after] - of) < np.abs(of - among[before]), after, before)


# --- inertial record and ground truth -------------------------------------------------------------------------------


def _read_imu(folder: Path) -> _Imu:
    if not folder.is_dir():
        return _Imu(np.eye(4), None, (), ())
    notes: tuple[str, ...] = ()
    T_body_imu, noise = np.eye(4), None
    if (path := folder / "sensor.yaml").is_file():
        sheet = _read_yaml(path)
        T_body_imu = _T_BS(sheet, path)
        noise = _read_noise(sheet, path)
    else:
        notes = (f"{path} is missing; the IMU is taken for the body frame, its noise is unknown",)
    return _Imu(T_body_imu, noise, read_imu(folder / "data.csv"), notes)


def _read_noise(sheet: Mapping[str, object], path: Path) -> ImuDensities | None:
    """The noise figures; None where none is stated."""
    if not any(key in sheet for key in _NOISE):
        return None
    values = [_numbers(sheet, key, path, 1)[0] for key in _NOISE]
    for key, value in zip(_NOISE, values, strict=True):
        if not value > 0:
            raise CalibrationError(f"{path}: {key} is {value:g}; a noise density must be positive")
    return ImuDensities(gyro=values[0], gyro_walk=values[1], accel=values[2], accel_walk=values[3])


def read_imu(path: Path) -> tuple[ImuSample, ...]:
    """Read `timestamp [ns], gyro x y z [rad/s], accel x y z [m/s^2]`.

    Raises:
        DataError: a line has not seven finite numbers, or the clock does not increase; the message names the line.
    """
    times_ns, rows, lines = _stamped_rows(path, 7, "timestamp [ns], gyro x y z, accel x y z")
    try:
        values = np.array(rows, dtype=np.float64)
    except ValueError:
        values = np.array([[_number(text) for text in row] for row in rows])
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        k = int(np.argmax(bad))
        raise DataError(
            f"{path}, line {lines[k]}: a reading is not a finite number ({','.join(rows[k])}; {int(bad.sum())} lines "
            "in all); remove such lines"
        )
    return tuple(ImuSample(t, row[:3], row[3:]) for t, row in zip(times_ns.tolist(), values, strict=True))


def _read_reference(mav: Path, T_body_imu: FloatArray, T_imu_cam0: FloatArray) -> Trajectory | None:
    """Ground truth of the IMU. EuRoC's describes the body; a TUM file may say that it describes the (raw) cam0."""
    if (path := mav / _STATE).is_file():
        truth = read_trajectory(path, fmt="euroc", body="imu")
    elif (path := mav.absolute().parent / _TUM).is_file():
        truth = read_trajectory(path, fmt="tum")
    else:
        return None
    if truth.body == "cam0":
        return truth.in_imu(se3_inverse(T_imu_cam0))
    return replace(truth, T_world_body=truth.T_world_body @ T_body_imu)


# --- files ----------------------------------------------------------------------------------------------------------


def _stamped_rows(path: Path, columns: int, form: str) -> tuple[IntArray, list[list[str]], list[int]]:
    """Times (N,) of a csv, its other fields, and the lines they stood in; lines that begin with '#' are let be.

    Raises:
        DataError: the file is missing or empty, a line has other fields, or the clock does not increase.
    """
    times: list[int] = []
    rows: list[list[str]] = []
    lines: list[int] = []
    for number, line in text_lines(path):
        if line.startswith("#"):
            continue
        fields = [field.strip() for field in line.split(",")]
        if len(fields) != columns:
            raise DataError(f"{path}, line {number}: {len(fields)} values where {columns} belong ({form})")
        if not re.fullmatch(r"\d{1,19}", fields[0]) or int(fields[0]) > _INT64_MAX:
            raise DataError(f"{path}, line {number}: {fields[0]!r} is no time in whole nanoseconds ({form})")
        time_ns = int(fields[0])
        if times and time_ns <= times[-1]:
            what = "repeats" if time_ns == times[-1] else "runs backwards"
            raise DataError(
                f"{path}, line {number}: the clock {what} ({time_ns} ns after {times[-1]} ns); remove or reorder that "
                "line"
            )
        times.append(time_ns)
        rows.append(fields[1:])
        lines.append(number)
    if not times:
        raise DataError(f"{path}: holds no line of data ({form}); copy it again, or remove its folder")
    return np.array(times, dtype=np.int64), rows, lines


def _read_yaml(path: Path) -> Mapping[str, object]:
    if not path.is_file():
        raise CalibrationError(f"{path} is missing; it holds the sensor's calibration")
    # OpenCV's writer begins with '%YAML:1.0', which is no YAML directive, and tags its matrices.
    lines = [line for _, line in text_lines(path) if not line.startswith("%YAML")]
    try:
        sheet = yaml.safe_load("\n".join(lines).replace("!!opencv-matrix", ""))
    except yaml.YAMLError as error:
        raise CalibrationError(f"{path}: not a YAML file ({' '.join(str(error).split())}); copy it again") from error
    if not isinstance(sheet, dict):
        raise CalibrationError(f"{path}: holds no calibration (expected 'key: value' lines); copy it again")
    return sheet


def _number(value: object) -> float:
    """A number as YAML or csv has it (PyYAML takes 1e-3 for text); NaN where it is none."""
    try:
        return float(value) if isinstance(value, (int, float, str)) else float("nan")
    except ValueError:
        return float("nan")


def _numbers(sheet: Mapping[str, object], key: str, path: Path, count: int | None = None) -> tuple[float, ...]:
    """A list of finite numbers, or a lone one."""
    if key not in sheet:
        raise CalibrationError(f"{path}: has no entry '{key}'; copy the calibration again")
    value = sheet[key]
    numbers = tuple(_number(v) for v in (value if isinstance(value, list) else [value]))
    if (count is not None and len(numbers) != count) or not np.all(np.isfinite(numbers)):
        wanted = "finite numbers" if count is None else f"{count} finite number{'s' * (count > 1)}"
        raise CalibrationError(f"{path}: '{key}' is {value!r} where {wanted} belong")
    return numbers


def _T_BS(sheet: Mapping[str, object], path: Path) -> FloatArray:
    """The transform from the sensor to the body, as an OpenCV matrix or as a list of rows."""
    entry = sheet.get("T_BS")
    values = entry.get("data") if isinstance(entry, dict) else entry
    if isinstance(values, list) and all(isinstance(row, list) for row in values):
        values = [value for row in values for value in row]
    if not isinstance(values, list) or len(values) != 16:
        raise CalibrationError(f"{path}: T_BS must hold 16 numbers, the 4x4 transform from the sensor to the body")
    return checked_transform(np.array([_number(v) for v in values]).reshape(4, 4), f"{path}, T_BS")


# --- writing --------------------------------------------------------------------------------------------------------


def write_rectified_euroc(dataset: RectifiedDataset, out: Path, progress: Callable[[], None]) -> int:
    """Write a recording as an EuRoC folder of rectified images; the IMU and the ground truth are copied as they are.

    Args:
        dataset: an unrectified EuRoC recording.
        out: an existing, empty folder; `mav0` is made in it.
        progress: called after each frame.

    Returns:
        The number of frames written.

    Raises:
        DataError: too many images are unreadable, or a file cannot be copied.
    """
    source, mav = _mav(dataset.recording.path), out / "mav0"
    T_imu_rect0 = se3_inverse(dataset.rectifier.T_rect0_imu)
    T_body_rect0 = _read_imu_pose(source / "imu0" / "sensor.yaml") @ T_imu_rect0
    camera = dataset.recording.camera
    assert camera.width is not None
    assert camera.height is not None
    T_rect0_rect1 = se3_from_parts(np.eye(3), [camera.baseline_m, 0, 0])
    model = CameraModel(camera.fu, camera.fv, camera.cu, camera.cv, camera.width, camera.height)
    folders = [mav / name for name in ("cam0", "cam1")]
    for folder in folders:
        (folder / "data").mkdir(parents=True)

    def name(frame: StereoFrame, count: int) -> tuple[Path, Path]:
        return folders[0] / "data" / f"{frame.time_ns}.png", folders[1] / "data" / f"{frame.time_ns}.png"

    times_ns = write_frames(dataset, name, progress)
    rate_hz = 1e9 / float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 0.0
    rows = "".join(f"{t},{t}.png\n" for t in times_ns.tolist())
    for folder, T_body_cam in zip(folders, (T_body_rect0, T_body_rect0 @ T_rect0_rect1), strict=True):
        text = camera_yaml(model, T_body_cam, comment=f"rectified {folder.name}", rate_hz=rate_hz)
        (folder / "sensor.yaml").write_text(text, encoding="utf-8", newline="\n")
        (folder / "data.csv").write_text(f"#timestamp [ns],filename\n{rows}", encoding="utf-8", newline="\n")
    for part in (Path("imu0", "sensor.yaml"), Path("imu0", "data.csv"), _STATE):
        _copy(source / part, mav / part)
    _copy(source.absolute().parent / _TUM, out / _TUM)
    return len(times_ns)


def camera_yaml(camera: CameraModel, T_body_cam: FloatArray, *, comment: str, rate_hz: float) -> str:
    """The text of a camera's `sensor.yaml`, with all digits; `T_body_cam` (4, 4) becomes its `T_BS`."""
    name = "equidistant" if camera.model == "equidistant" else "radial-tangential"
    rows = ",\n         ".join(", ".join(repr(float(x)) for x in row) for row in T_body_cam)
    return (
        f"%YAML:1.0\nsensor_type: camera\ncomment: {comment}\n\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{rows}]\n\n"
        f"rate_hz: {rate_hz:.6g}\nresolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{_listed((camera.fu, camera.fv, camera.cu, camera.cv))}] #fu, fv, cu, cv\n"
        f"distortion_model: {name}\n"
        f"distortion_coefficients: [{_listed(camera.coefficients or (0.0,) * 4)}]\n"
    )


def _listed(values: Sequence[float]) -> str:
    return ", ".join(repr(float(value)) for value in values)


def _read_imu_pose(path: Path) -> FloatArray:
    return _T_BS(_read_yaml(path), path) if path.is_file() else np.eye(4)


def _copy(source: Path, target: Path) -> None:
    """Copy a file if it is there."""
    if not source.is_file():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        shutil.copyfile(source, target)
    except shutil.SameFileError as error:
        raise DataError(f"{source}: cannot be copied onto itself; choose another folder") from error
