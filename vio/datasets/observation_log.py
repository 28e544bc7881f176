"""The log of a run's observations and motion samples: a source that replays to the bit, and the
form of other features.

One `.npz` without pickle. The rows of all frames are concatenated; `offsets` separates them. Data
that the recording lacks (extrinsics, reference, …) are absent from the archive, never coded by a
special number. The arrays are described in docs/tutorials/features.md; a file of another program
needs the first six of them only.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias, cast, get_args

import numpy as np
import numpy.typing as npt

from vio.cameras.rig import Rig
from vio.datasets.common import begins_as_zip, naming, read_npz, shape_text
from vio.datasets.feature_forms import features_doubt, features_fault, without_placeholders
from vio.datasets.features import FeatureDataset
from vio.datasets.reader import Reader
from vio.datasets.samples import MotionSamples
from vio.datasets.samples import motion_samples as as_arrays
from vio.datasets.settings import DatasetSettings, are_repeats_used
from vio.errors import DataError
from vio.files.atomic import atomic_write_bytes
from vio.files.stamps import FRAME_PACE, SAMPLE_PACE
from vio.files.text import check_increasing
from vio.geometry.lie import FloatArray, checked_transform
from vio.geometry.stereo import CameraKind, Projection, StereoCamera
from vio.numerics.kinds import Tolerance
from vio.records import (
    BodyFrame,
    FeatureTracks,
    IntArray,
    Landmarks,
    MotionSample,
    Observations,
    Recording,
    RunMotion,
    Trajectory,
    feature_tracks,
    joined_sigmas,
)
from vio.records import observations as frame_observations

FORMAT = "stereo-vio observation log"
VERSION = 2  # 2 adds run_motion
_REQUIRED: dict[str, tuple[str, int]] = {  # array kinds (numpy's letters) and dimensions
    "intrinsics": ("f", 1),
    "frame_times_ns": ("i", 1),
    "offsets": ("i", 1),
    "ids": ("i", 1),
    "z": ("f", 2),
    "has_right": ("b", 1),
}
# likewise; `_with_defaults` says what an absent one means
_DEFAULTED: dict[str, tuple[str, int]] = {
    "version": ("i", 0),
    "source": ("U", 0),
    "notes": ("U", 1),
    "image_size": ("i", 1),
    "frame_indices": ("i", 1),
    "stale": ("b", 1),
    "motion_times_ns": ("i", 1),
    "motion_is_imu": ("b", 1),
    "motion_values": ("f", 2),
}
_OPTIONAL: dict[str, tuple[str, int]] = {
    "format": ("U", 0),
    "projection": ("U", 0),
    "run_motion": ("U", 0),
    "camera_kind": ("U", 0),
    "residual_px": ("f", 0),
    "image_numbers": ("i", 1),
    "sigma": ("f", 2),
    "T_cam0_imu": ("f", 2),
    "reference_T_world_body": ("f", 3),
    "reference_body": ("U", 0),
    "reference_times_ns": ("i", 1),
    "reference_frame_indices": ("i", 1),
    "landmark_ids": ("i", 1),
    "landmark_p_world": ("f", 2),
    "landmark_covariance": ("f", 3),
}
_KINDS = {**_REQUIRED, **_DEFAULTED, **_OPTIONAL}
_KIND_NAMES = {"f": "numbers", "i": "integers", "b": "true or false", "U": "text"}
_EXACT: Tolerance[float] = 2.0**53  # whole numbers below it are exact as floats
_COARSE_NS = 2**16  # times of which all are multiples of this power of 2 have lost digits
_GROUPS = {  # keys that need others
    "reference_T_world_body": ("reference_body",),
    "landmark_ids": ("landmark_p_world", "landmark_covariance"),
}


def write_observation_log(
    path: Path,
    recording: Recording,
    observations: Sequence[Observations],
    motion_samples: Sequence[MotionSample],
    run_motion: RunMotion | None = None,
) -> None:
    """Write the observations of a run and its motion samples atomically, exact to the bit.

    Args:
        path: the file to write; its folder must exist.
        recording: the source of the run.
        observations: one record for each processed frame, in time order.
        motion_samples: every sample that the estimator received, in time order.
        run_motion: what carried the pose in that run, for `motion: auto` in a replay; None: not
            known.

    Raises:
        DataError: the file cannot be written.
        ValueError: observations disagree with the recording's frames, or are out of order.
    """
    frames = np.array([o.frame_index for o in observations], dtype=np.int64)
    times_ns = np.array([o.time_ns for o in observations], dtype=np.int64)
    if (np.diff(frames) <= 0).any() or not np.array_equal(
        times_ns, recording.frame_times_ns[frames]
    ):
        raise ValueError(
            "the observations are not in the order of the recording's frames, or have other times"
        )
    motion = as_arrays(motion_samples)
    entries = {
        "format": FORMAT,
        "version": np.int64(VERSION),
        "source": f"{recording.kind}:{recording.path}",
        "notes": np.array(recording.notes, dtype=np.str_),
        **_camera_entries(recording.camera),
        "frame_times_ns": recording.frame_times_ns,
        "frame_indices": frames,
        **_observation_entries(observations),
        "motion_times_ns": motion.times_ns,
        "motion_is_imu": motion.is_imu,
        "motion_values": motion.values,
        "T_cam0_imu": recording.T_cam0_imu,
        **_reference_entries(recording),
        "run_motion": run_motion,
        "image_numbers": recording.image_numbers,
    }
    arrays = {key: np.asarray(value) for key, value in entries.items() if value is not None}
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type] # the stubs take every keyword for allow_pickle
    atomic_write_bytes(path, stream.getvalue())


# Arrays by their keys; None: absent.
_Entries: TypeAlias = dict[str, npt.ArrayLike | None]


def _camera_entries(camera: StereoCamera) -> _Entries:
    return {
        "intrinsics": np.array(
            [camera.fu, camera.fv, camera.cu, camera.cv, camera.baseline_m], dtype=np.float64
        ),
        "image_size": np.array(
            [k for k in (camera.width, camera.height) if k is not None], dtype=np.int64
        ),
        "projection": None if camera.projection == "pinhole" else camera.projection,
        "camera_kind": None if camera.kind == "stereo" else camera.kind,
        "residual_px": camera.residual_px or None,
    }


def _observation_entries(observations: Sequence[Observations]) -> _Entries:
    sigma = joined_sigmas(observations)
    return {
        "offsets": np.cumsum([0, *(len(o) for o in observations)], dtype=np.int64),
        "ids": np.concatenate([np.zeros(0, dtype=np.int64), *(o.ids for o in observations)]),
        "z": np.concatenate([np.zeros((0, 4)), *(o.z for o in observations)]),
        "has_right": np.concatenate(
            [np.zeros(0, dtype=np.bool_), *(o.has_right for o in observations)]
        ),
        "stale": np.concatenate([np.zeros(0, dtype=np.bool_), *(o.stale for o in observations)]),
        "sigma": None if sigma is None or not sigma.any() else sigma,
    }


def _reference_entries(recording: Recording) -> _Entries:
    reference = recording.reference
    landmarks = recording.landmarks_reference
    return {
        "reference_T_world_body": None if reference is None else reference.T_world_body,
        "reference_body": None if reference is None else reference.body,
        "reference_times_ns": None if reference is None else reference.times_ns,
        "reference_frame_indices": None if reference is None else reference.frame_indices,
        "landmark_ids": None if landmarks is None else landmarks.ids,
        "landmark_p_world": None if landmarks is None else landmarks.p_world,
        "landmark_covariance": None if landmarks is None else landmarks.covariance,
    }


def write_observations(
    path: str | Path,
    camera: StereoCamera | Rig,
    frame_times_ns: npt.ArrayLike,
    frames: Iterable[tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike | None]],
    *,
    motion: Sequence[MotionSample] = (),
    T_cam0_imu: FloatArray | None = None,
    reference: Trajectory | None = None,
) -> None:
    """Write the features of another program as a recording that `vio run` and `open_dataset` read.

    Args:
        path: the `.npz` to write; its folder must exist.
        camera: the rectified pair that the pixels belong to, or the rig whose `Rig.camera` that is.
        frame_times_ns: (F,) exposure times, integer nanoseconds, increasing.
        frames: for each frame ids (N,), pixels (N, 4) `[ul vl ur vr]`, rectified, and which rows
            have a right match (N,) (None: all whose right pixels are numbers, and no placeholder
            like -1 -1). An id belongs to one point, and occurs once in a frame.
        motion: samples of an IMU or velocities on the clock of the frames, in time order.
        T_cam0_imu: (4, 4) extrinsics of the motion sensor; None: those of a `Rig`.
        reference: ground truth, for the errors of a run.

    Raises:
        DataError: times or features are malformed, times are closer than those of any sensor (frame
            numbers, milliseconds), pixels or ids are not what they must be as they tell themselves
            (`vio.datasets.feature_forms`), or the file cannot be written.
        CalibrationError: the extrinsics are no rigid transform.
    """
    if isinstance(camera, Rig):
        T_cam0_imu = camera.T_cam0_imu if T_cam0_imu is None else T_cam0_imu
        camera = camera.camera
    if not isinstance(camera, StereoCamera):
        raise DataError(
            f"camera is of the type {type(camera).__name__}; give a Rig (vio.load_rig, "
            "vio.Rig.rectified) or a recording's camera"
        )
    frames = list(frames)
    times_ns = np.asarray(frame_times_ns)
    if times_ns.ndim != 1 or times_ns.dtype.kind not in "iu" or len(times_ns) != len(frames):
        raise DataError(
            f"frame times are {shape_text(times_ns)} of {times_ns.dtype} for {len(frames)} frames; "
            "give one integer, "
            "in nanoseconds, for each"
        )
    times_ns = check_increasing(times_ns.astype(np.int64), lambda k: f"frame times, entry {k}")
    samples = as_arrays(motion)
    if fault := FRAME_PACE.fault(times_ns) or SAMPLE_PACE.fault(samples.times_ns):
        raise DataError(fault)
    seen = [_one_frame(k, int(times_ns[k]), frame) for k, frame in enumerate(frames)]
    tracks, notes = _examined(feature_tracks(dict(enumerate(seen)), len(seen)), camera, "features")
    T = None if T_cam0_imu is None else checked_transform(T_cam0_imu, "T_cam0_imu")
    recording = Recording(
        "features", Path(path), camera, T, times_ns, False, samples.kinds, reference
    )
    recording = replace(recording, notes=notes)
    seen = [tracks.at(k, int(times_ns[k])) for k in range(len(seen))]
    write_observation_log(Path(path), recording, seen, samples)


def _one_frame(index: int, time_ns: int, frame: object) -> Observations:
    """Return the features of one frame, given as ids, pixels and, where known, right matches."""
    if not isinstance(frame, tuple | list) or len(frame) not in {2, 3}:
        raise DataError(
            f"frame {index} is of the type {type(frame).__name__}; give (ids, z, has_right), arrays "
            "of one row a feature"
        )
    return frame_observations(index, time_ns, *frame)


def is_observation_log(names: Sequence[str]) -> bool:
    """Return whether the member names of an `.npz` are those of a log."""
    return {"offsets", "ids", "z"} <= set(names) or "format" in names


def read_observation_log(path: Path, settings: DatasetSettings | None = None) -> FeatureDataset:
    """Read a log; frames that were not processed when it was written yield no event.

    Raises:
        DataError: the file is no log, was written by a newer version, or is inconsistent.
    """
    arrays = read_npz(path, tuple(_KINDS))
    is_foreign = "format" not in arrays
    arrays = _checked(arrays, path)
    frames = arrays["frame_indices"]
    offsets = arrays["offsets"]
    times_ns = arrays["frame_times_ns"]
    dense_offsets = offsets[np.searchsorted(frames, np.arange(len(times_ns) + 1))]
    sigma = None
    if "sigma" in arrays:
        sigma = arrays["sigma"].astype(np.float32)
    tracks = FeatureTracks(
        dense_offsets, arrays["ids"], arrays["z"], arrays["has_right"], arrays["stale"], sigma
    )
    with naming(path):
        camera = _camera(arrays)
    notes = tuple(str(note) for note in arrays["notes"])
    if is_foreign:
        tracks, found = _examined(tracks, camera, path)
        notes = (*notes, *(f"{path}: {text}" for text in found))
    motion = MotionSamples[MotionSample](
        arrays["motion_times_ns"], arrays["motion_values"], arrays["motion_is_imu"]
    )
    run_motion = None
    if "run_motion" in arrays:
        run_motion = cast(RunMotion, str(arrays["run_motion"]))
    recording = Recording(
        kind="log",
        path=path,
        camera=camera,
        T_cam0_imu=_extrinsics(arrays, path),
        frame_times_ns=times_ns,
        has_images=False,
        motion=motion.kinds,
        reference=_reference(arrays),
        landmarks_reference=_landmarks(arrays),
        notes=notes,
        run_motion=run_motion,
        repeats_settled=are_repeats_used(settings),
        image_numbers=arrays.get("image_numbers"),
    )
    return FeatureDataset(recording, tracks, motion, frames)


def _examined(
    tracks: FeatureTracks, camera: StereoCamera, where: object
) -> tuple[FeatureTracks, tuple[str, ...]]:
    """Return the features of another program without placeholders, and notes on them.

    Raises:
        DataError: they are not what they must be; `where` begins it.
    """
    tracks, note = without_placeholders(tracks)
    if fault := features_fault(camera, tracks):
        raise DataError(f"{where}: {fault}")
    found = (note, features_doubt(camera, tracks))
    return tracks, tuple(text for text in found if text is not None)


def _checked(arrays: Mapping[str, np.ndarray], path: Path) -> Mapping[str, np.ndarray]:
    """Return all arrays but the optional ones, in 64 bits; absent ones have their defaults."""
    if "format" in arrays and str(arrays["format"]) != FORMAT:
        raise DataError(
            f"{path}: no observation log; create one with `vio run SOURCE --save-observations`"
        )
    version = arrays.get("version", np.zeros((), dtype=np.int64))
    if version.dtype.kind == "i" and version.ndim == 0 and version > VERSION:
        raise DataError(
            f"{path}: an observation log of version {version}, this program reads up to {VERSION}; "
            "upgrade stereo-vio"
        )
    arrays = {key: _as_kind(array, _KINDS[key][0]) for key, array in arrays.items()}
    _check_arrays(arrays, path)
    whole = _with_defaults(arrays)
    if problem := _inconsistency(whole):
        raise DataError(f"{path}: the observation log is inconsistent: {problem}; write it again")
    return whole


def _check_arrays(arrays: Mapping[str, np.ndarray], path: Path) -> None:
    """Raise DataError where an array is missing, or has another type or other dimensions."""
    for key in _REQUIRED:
        if key not in arrays:
            raise DataError(
                f"{path}: the observation log lacks {key}; vio.write_observations writes all that is "
                "needed"
            )
    for key, (kind, dimensions) in _KINDS.items():
        if key in arrays and (arrays[key].dtype.kind != kind or arrays[key].ndim != dimensions):
            least = "one value" if dimensions == 0 else f"{dimensions}-D"
            whole = ", whole nanoseconds" if key.endswith("_ns") else ""
            raise DataError(
                f"{path}: {key} of the observation log has type {arrays[key].dtype}, "
                f"{arrays[key].ndim}-D; write {_KIND_NAMES[kind]}{whole}, {least}"
            )


def _as_kind(array: np.ndarray, kind: str) -> np.ndarray:
    """Return an array in another kind of numbers where that loses nothing: integers as floats, 0
    and 1 as booleans, whole floats that are exact as integers.
    """
    if kind == "f" and array.dtype.kind in "iu":
        return array.astype(np.float64)
    if kind == "b" and array.dtype.kind in "iuf" and np.isin(array, (0, 1)).all():
        return array.astype(np.bool_)
    if kind == "i" and array.dtype.kind == "u" and (array <= np.iinfo(np.int64).max).all():
        return array.astype(np.int64)
    if kind == "i" and array.dtype.kind == "f" and (np.abs(array) < _EXACT).all():
        whole = array.astype(np.int64)
        return whole if (whole == array).all() else array
    return array


def _with_defaults(arrays: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
    """Add what is absent: every frame was processed, no row repeats an earlier one, there are no
    motion samples.
    """
    wide = {"i": np.int64, "f": np.float64}
    given = {
        key: array.astype(wide.get(array.dtype.kind, array.dtype), copy=False)
        for key, array in arrays.items()
    }
    nothing = np.zeros(0, dtype=np.int64)
    return {
        "notes": np.zeros(0, dtype=np.str_),
        "image_size": nothing,
        "frame_indices": np.arange(len(given["frame_times_ns"])),
        "stale": np.zeros(len(given["ids"]), dtype=np.bool_),
        "motion_times_ns": nothing,
        "motion_is_imu": nothing.astype(np.bool_),
        "motion_values": np.zeros((0, 6)),
        **given,
    }


def _inconsistency(arrays: Mapping[str, np.ndarray]) -> str | None:
    """Describe an inconsistency; None: there is none."""
    checks = (_of_rows, _of_times, _of_camera, _of_words, _of_reference)
    return next((fault for check in checks if (fault := check(arrays)) is not None), None)


def _of_rows(arrays: Mapping[str, np.ndarray]) -> str | None:
    """Whether the rows of observations fit each other and the frames."""
    rows = len(arrays["ids"])
    offsets = arrays["offsets"]
    frames = arrays["frame_indices"]
    if arrays["z"].shape != (rows, 4) or {len(arrays["has_right"]), len(arrays["stale"])} != {rows}:
        return f"{rows} ids, but z is {arrays['z'].shape} with {len(arrays['stale'])} stale marks"
    ends_fit = len(offsets) == len(frames) + 1 and offsets[0] == 0 and offsets[-1] == rows
    if not ends_fit or (np.diff(offsets) < 0).any():
        ends = f", from {offsets[0]} to {offsets[-1]}" if len(offsets) else ""
        return (
            f"the offsets do not split {rows} rows into {len(frames)} frames ({len(offsets)} "
            f"entries{ends}; {len(frames) + 1} are needed, none below the one before, from 0 to "
            f"{rows})"
        )
    in_frame = np.stack([arrays["ids"], np.repeat(np.arange(len(frames)), np.diff(offsets))])
    in_order = in_frame[:, np.lexsort(in_frame)]
    twice = np.flatnonzero((in_order[:, 1:] == in_order[:, :-1]).all(axis=0))
    if len(twice):
        feature, frame = in_order[:, twice[0]].tolist()
        return f"an id occurs twice in a frame: {feature} in processed frame {frame}"
    if "sigma" in arrays and arrays["sigma"].shape != (rows, 3):
        return f"{rows} ids, but sigma is {shape_text(arrays['sigma'])}"
    return None


def _of_times(arrays: Mapping[str, np.ndarray]) -> str | None:
    """Whether frames and motion samples are in the order of time."""
    frames = arrays["frame_indices"]
    times_ns = arrays["frame_times_ns"]
    samples = len(arrays["motion_times_ns"])
    for key, least in (("frame_times_ns", 1), ("motion_times_ns", 0)):
        late = np.flatnonzero(np.diff(arrays[key]) < least)
        if len(late):
            k = int(late[0])
            before, after = arrays[key][k : k + 2].tolist()
            return (
                f"a clock does not increase: {key} has {after} (entry {k + 1}) after {before}"
                f"{_lost_digits(arrays[key])}"
            )
    if len(frames) and (
        frames[0] < 0 or frames[-1] >= len(times_ns) or (np.diff(frames) <= 0).any()
    ):
        return f"frame numbers do not increase within 0 to {len(times_ns) - 1}"
    numbers = arrays.get("image_numbers", frames[:0])
    if len(numbers) not in (0, len(times_ns)) or (np.diff(numbers) <= 0).any():
        return (
            f"{len(numbers)} numbers of images for {len(times_ns)} frames, or they do not increase"
        )
    if arrays["motion_values"].shape != (samples, 6) or len(arrays["motion_is_imu"]) != samples:
        return f"{samples} motion times, but values {arrays['motion_values'].shape}"
    return FRAME_PACE.fault(times_ns)


def _lost_digits(times_ns: IntArray) -> str:
    """What is said of times that repeat, and all are multiples of what 32-bit floats hold."""
    step = int(np.bitwise_or.reduce(times_ns)) if len(times_ns) else 0
    coarse = step and (step & -step) >= _COARSE_NS
    if not coarse or (np.diff(times_ns) < 0).any():
        return ""
    return f", and all are multiples of {step & -step} ns: they went through 32-bit floats"


def _of_camera(arrays: Mapping[str, np.ndarray]) -> str | None:
    """Whether the camera is complete."""
    if arrays["intrinsics"].shape != (5,):
        return (
            f"intrinsics has {len(arrays['intrinsics'])} numbers, not the five fu fv cu cv and the "
            "baseline in metres"
        )
    if len(arrays["image_size"]) not in (0, 2):
        return f"image_size is {arrays['image_size'].tolist()}, not width and height"
    residual = arrays.get("residual_px", np.zeros(()))
    if not 0 <= residual < np.inf:
        return f"residual_px is {residual.tolist()!r}, no number of pixels"
    return None


def _of_words(arrays: Mapping[str, np.ndarray]) -> str | None:
    """Whether keys have those that they need, and words are known."""
    for first, group in _GROUPS.items():
        if first in arrays and any(key not in arrays for key in group):
            return f"{first} lacks {' '.join(key for key in group if key not in arrays)}"
    for key, names in (
        ("projection", Projection),
        ("run_motion", RunMotion),
        ("camera_kind", CameraKind),
    ):
        if key in arrays and str(arrays[key]) not in get_args(names):
            return f"{key} is {str(arrays[key])!r}, none of {', '.join(get_args(names))}"
    return None


def _of_reference(arrays: Mapping[str, np.ndarray]) -> str | None:
    """Whether the reference has a time or frame number for each pose."""
    poses = arrays.get("reference_T_world_body", np.zeros((0, 4, 4)))
    stamps = [
        len(arrays[key])
        for key in ("reference_times_ns", "reference_frame_indices")
        if key in arrays
    ]
    if poses.shape[1:] != (4, 4) or any(count != len(poses) for count in stamps):
        return f"reference poses {poses.shape} with {stamps} times or frame numbers"
    return None


def _camera(arrays: Mapping[str, np.ndarray]) -> StereoCamera:
    fu, fv, cu, cv, b = arrays["intrinsics"].tolist()
    width, height = arrays["image_size"].tolist() or (None, None)
    projection = cast(Projection, str(arrays.get("projection", "pinhole")))
    kind = cast(CameraKind, str(arrays.get("camera_kind", "stereo")))
    residual_px = float(arrays.get("residual_px", 0.0))
    return StereoCamera(fu, fv, cu, cv, b, width, height, projection, kind, residual_px)


def _extrinsics(arrays: Mapping[str, np.ndarray], path: Path) -> FloatArray | None:
    if "T_cam0_imu" not in arrays:
        return None
    checked_transform(arrays["T_cam0_imu"], f"{path}, T_cam0_imu")
    return arrays["T_cam0_imu"]  # the stored bits, not the orthonormalised ones


def _reference(arrays: Mapping[str, np.ndarray]) -> Trajectory | None:
    if "reference_T_world_body" not in arrays:
        return None
    return Trajectory(
        arrays["reference_T_world_body"],
        arrays.get("reference_times_ns"),
        cast(BodyFrame, str(arrays["reference_body"])),
        arrays.get("reference_frame_indices"),
    )


def _landmarks(arrays: Mapping[str, np.ndarray]) -> Landmarks | None:
    if "landmark_ids" not in arrays:
        return None
    return Landmarks(
        arrays["landmark_ids"], arrays["landmark_p_world"], arrays["landmark_covariance"]
    )


def _is_log(path: Path) -> bool:
    """Whether a file is a log, by the names of its members.

    Raises:
        DataError: it is a damaged `.npz`.
    """
    if not begins_as_zip(path):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
    except (zipfile.BadZipFile, OSError) as error:
        raise DataError(f"{path}: is damaged ({error}); copy it again") from error
    return is_observation_log(names)


READERS = (
    Reader(
        kind="log",
        looked_for="an observation log .npz",
        read=read_observation_log,
        is_file=_is_log,
    ),
)
