"""The output folder of a run: configuration, trajectory, map, per-frame log, metrics, plot."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import platform
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, field, fields, is_dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from vio._version import __version__
from vio.calibration.severity import StereoError
from vio.calibration.stereo_field import PARAMETERS, disparity_off
from vio.config import Config, describe, to_yaml
from vio.dataclass import dataclass
from vio.errors import CalibrationError, DataError, EvaluationError
from vio.evaluation.errors_along_path import error_statistics, path_length_m
from vio.evaluation.numbering import numbered_by_images
from vio.evaluation.trajectories import Evaluation, evaluate
from vio.files.atomic import atomic_folder, check_own
from vio.files.printable import json_text, printable
from vio.files.trajectories import frames_text, in_first_cam0, write_kitti, write_tum
from vio.filters.rig_calibration import scale_sigma
from vio.findings import INTEGRITIES
from vio.geometry.lie import FloatArray, se3_inverse, se3_log, transform_points
from vio.numerics import robust
from vio.numerics.compiled import has_compiled
from vio.numerics.kinds import Capacity
from vio.protocols import Dataset
from vio.records import IMU_ENTRIES, Landmarks, Trajectory
from vio.runs.files import FILES, REQUEST, RunFile
from vio.runs.pipeline import STAGES, RunResult, given_rig
from vio.runs.recorder import GrowingFolder
from vio.runs.stated import REQUEST_SHAPE, RunRequest, read_metrics, read_stated
from vio.runs.tables import frames_csv

if TYPE_CHECKING:
    from vio.files.tables import Records
    from vio.records import FrameLog
    from vio.runs.mapped import MappedRun
    from vio.runs.picture import RunPicture

log = logging.getLogger(__name__)

# Of a request: it may move, or be compared anew.
_OF_THE_OUTPUT = ("source", "reference", "lengths_m", "save_calibration", "command", "plot")
_SLOW = 10.0  # times the median; frames that take longer compile, or wait for something else


class _Chunks(NamedTuple):
    """How much is written at a time."""

    rows: Capacity[int] = 100_000  # points and frames at a time
    frames: Capacity[int] = 5_000


_CHUNKS = _Chunks()


def write_run_folder(
    folder: Path,
    result: RunResult,
    reference: Trajectory | None,
    *,
    lengths_m: Sequence[float] | None = None,
    save_observations: bool = False,
) -> dict[str, Any]:
    """Write all results of a run atomically, and return the metrics.

    Args:
        folder: replaced if it is an earlier run's folder.
        result: the run.
        reference: ground truth; None without one.
        lengths_m: path lengths of the drift, see `evaluate`.
        save_observations: also write `observations.npz`; the result must contain them.

    Raises:
        VioError: the folder cannot be written, or contains something else.
    """
    how = Finishing(lengths_m, save_observations)
    with atomic_folder(folder, replace=True, marker=RunFile.METRICS, own=FILES) as temporary:
        np.save(temporary / RunFile.ESTIMATES, result.estimates.rows)
        metrics, picture = _write_files(temporary, folder, result, reference, how)
        assert picture is not None
        picture.write(temporary / RunFile.PICTURE)
    return metrics


@dataclass(frozen=True, slots=True)
class Finishing:
    """What is written of a run that ends beside its results."""

    lengths_m: Sequence[float] | None  # path lengths of the drift, see `evaluate`
    save_observations: bool
    more: Mapping[str, Any] = field(default_factory=dict)  # into the metrics
    plot: bool = True
    # gets the metrics before the picture is drawn
    finished: Callable[[dict[str, Any]], None] = lambda metrics: None


def finish_run_folder(
    folder: Path, result: RunResult, reference: Trajectory | None, how: Finishing
) -> dict[str, Any]:
    """Write the results of a run into the folder in which it grew, and return the metrics.

    What a run that ended early needs to go on stays in `unfinished/`. That of a whole run goes last
    of all, so that a process which is killed at any moment leaves either a run that can be gone on
    with, or all results. The first arguments are those of `write_run_folder`.

    Raises:
        VioError: the folder cannot be written.
    """
    unfinished = folder / RunFile.UNFINISHED
    final = unfinished / "final"
    check_own(unfinished)
    check_own(final)
    with _writing_results(folder):
        if final.exists():  # of a process that died
            shutil.rmtree(final)
        final.mkdir()
        metrics, picture = _write_files(final, folder, result, reference, how)
        shutil.copyfile(unfinished / RunFile.ESTIMATES, final / RunFile.ESTIMATES)
        for name in sorted(path.name for path in final.iterdir() if path.name != RunFile.METRICS):
            (final / name).replace(folder / name)
        (final / RunFile.METRICS).replace(folder / RunFile.METRICS)
        shutil.rmtree(final)
    how.finished(metrics)
    if picture is not None:
        try:
            picture.write(folder / RunFile.PICTURE)
        except KeyboardInterrupt:
            log.warning(
                "%s was not drawn: interrupted; all other results are complete", RunFile.PICTURE
            )
    if result.stopped is None:
        with _writing_results(folder):
            (unfinished / REQUEST).unlink(missing_ok=True)  # without it, the run is over
            shutil.rmtree(unfinished)
    return metrics


@contextlib.contextmanager
def _writing_results(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise DataError(
            f"cannot write {folder}: {error.strerror or error}; the trajectory so far is there"
        ) from error


def growing_folder(
    folder: Path, dataset: Dataset, config: Config, request: Mapping[str, Any]
) -> GrowingFolder:
    """Describe a run before its first frame, as its folder says it while the run goes on."""
    recording = dataset.recording
    metrics = {
        "out": str(folder),
        "complete": False,
        "source": str(recording.path),
        "kind": recording.kind,
        "version": __version__,
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "T_cam0_imu": recording.T_cam0_body.tolist(),
    }
    texts = {
        RunFile.CONFIG: to_yaml(config),
        RunFile.METRICS: json_text(metrics, indent=2) + "\n",
        # names of files as they are
        f"{RunFile.UNFINISHED}/{REQUEST}": json.dumps(request, indent=2) + "\n",
    }
    return GrowingFolder(folder, texts, replaces=FILES, inputs=_inputs(dataset, config, request))


def _inputs(dataset: Dataset, config: Config, request: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the results depend on beside the images and samples themselves: settings,
    calibration, frames.
    """
    recording = dataset.recording
    times_ns = recording.frame_times_ns
    values = {row.key: row.default for row in describe(config)}
    values |= {name: value for name, value in request.items() if name not in _OF_THE_OUTPUT}
    values |= {
        "number of frames": len(times_ns),
        "checksum of their times": zlib.crc32(times_ns.tobytes()),
    }
    values |= _flat("camera", recording.camera) | _flat("T_cam0_imu", recording.T_cam0_imu)
    values |= _flat("calibration", given_rig(dataset))
    return {
        name: str(value) if isinstance(value, Path) else value for name, value in values.items()
    }


def _flat(name: str, value: Any) -> dict[str, Any]:
    """Return the fields of a record by their full names, as values of JSON."""
    if is_dataclass(value):
        parts = [_flat(f"{name}.{part.name}", getattr(value, part.name)) for part in fields(value)]
        return {key: own for part in parts for key, own in part.items()}
    return {name: value.tolist() if isinstance(value, np.ndarray) else value}


def read_request(folder: Path) -> RunRequest:
    """Read what an unfinished run was asked to do.

    Raises:
        DataError: the folder is no run's, the run is complete, or the file is damaged.
    """
    path = folder / RunFile.UNFINISHED / REQUEST
    if not path.is_file():
        read_metrics(folder)
        raise DataError(f"{folder}: its run is complete; there is nothing to go on with")
    return RunRequest.of(read_stated(path, REQUEST_SHAPE, "repeat the run from its start"))


def _write_files(
    target: Path, folder: Path, result: RunResult, reference: Trajectory | None, how: Finishing
) -> tuple[dict[str, Any], RunPicture | None]:
    """Write all results but `estimates.npy` into `target`; return the metrics, which name
    `folder`, and the picture where it is to be drawn.
    """
    evaluation, dead_reckoning = score(result, reference, lengths_m=how.lengths_m)
    metrics = {**metrics_of(result, evaluation, dead_reckoning, folder), **how.more}
    (target / RunFile.CONFIG).write_text(to_yaml(result.config), encoding="utf-8")
    write_tum(target / RunFile.TRAJECTORY, result.trajectory)
    write_kitti(
        target / RunFile.TRAJECTORY_KITTI, in_first_cam0(result.trajectory, result.T_cam0_body)
    )
    if evaluation is not None:
        _write_compared(target, result, evaluation)
    if result.dead_reckoning is not None:
        write_tum(target / RunFile.DEAD_RECKONING, result.dead_reckoning)
    if result.mapped is not None:
        metrics["map"] = _write_mapped(target, result, result.mapped, reference)
    write_landmarks_ply(target / RunFile.LANDMARKS, result.landmarks)
    _write_frames(target, result.frames)
    if how.save_observations:
        _write_observations(target, result)
    (target / RunFile.METRICS).write_text(json_text(metrics, indent=2) + "\n", encoding="utf-8")
    if not how.plot:
        return metrics, None
    from vio.runs.picture import RunPicture

    return metrics, RunPicture.of(result, evaluation, dead_reckoning)


def _write_compared(target: Path, result: RunResult, evaluation: Evaluation) -> None:
    """Write the poses of the reference that were compared, each at the time of its estimate: the
    folder alone then gives the errors.
    """
    times_ns = result.trajectory.times_ns
    assert times_ns is not None
    write_tum(
        target / RunFile.REFERENCE,
        replace(evaluation.reference, times_ns=times_ns[evaluation.rows]),
    )


def _write_frames(target: Path, frames: Records[FrameLog]) -> None:
    """Write the table of the frames, some at a time."""
    stages = sorted({name for frame in frames for name in frame.stages_ms})
    with (target / RunFile.FRAMES).open("w", encoding="utf-8", newline="\n") as stream:
        for start in range(0, len(frames), _CHUNKS.frames):
            stream.write(
                frames_csv(frames[start : start + _CHUNKS.frames], stages, header=start == 0)
            )


def _write_observations(target: Path, result: RunResult) -> None:
    from vio.datasets.observation_log import write_observation_log

    seen = result.observations
    samples = result.motion_samples
    assert seen is not None
    assert samples is not None
    run_motion = result.motion or "none"
    write_observation_log(
        target / RunFile.OBSERVATIONS, result.recording, seen, samples, run_motion=run_motion
    )


def _write_mapped(
    target: Path, result: RunResult, mapped: MappedRun, reference: Trajectory | None
) -> dict[str, Any]:
    """Write the poses in the map and the loops, and return their metrics."""
    from vio.runs.mapped import write_keyframes, write_loops

    final = replace(result.trajectory, T_world_body=mapped.T_map_body)
    write_tum(target / RunFile.MAP_TRAJECTORY, final)
    causal = mapped.causal
    if len(causal):
        poses = Trajectory(np.array(causal["T_map_body"]), np.array(causal["time_ns"]), result.body)
        write_tum(target / RunFile.MAP_CAUSAL, poses)
    np.save(target / RunFile.MAP_COVARIANCE, causal["covariance"])
    write_loops(target, mapped.loops)
    write_keyframes(target, mapped.in_map)
    evaluation, _ = score(
        replace(result, dead_reckoning=None), reference, T_world_body=mapped.T_map_body
    )
    return {
        "joined": mapped.joined,
        "keyframes": mapped.keyframes,
        "loops": len(mapped.loops),
        "placed": len(causal) / len(final),
        "ate_m": None if evaluation is None else evaluation.as_dict()["ate_m"],
        "adjustment": mapped.adjustment,
    }


def score(
    result: RunResult,
    reference: Trajectory | None,
    *,
    lengths_m: Sequence[float] | None = None,
    T_world_body: FloatArray | None = None,
) -> tuple[Evaluation | None, Evaluation | None]:
    """Evaluate a run's trajectory and its dead reckoning; None without a reference or dead
    reckoning.

    A reference that cannot be compared (too short, no common time) gives a warning only.
    `T_world_body` (N, 4, 4) takes the place of the run's own poses.
    """
    if reference is None:
        return None, None
    try:
        truth = numbered_by_images(reference, result.recording.image_numbers)
        poses = result.trajectory
        if T_world_body is not None:
            poses = replace(poses, T_world_body=T_world_body)
        own = evaluate(poses, truth, T_cam0_imu=result.T_cam0_body, lengths_m=lengths_m)
        for note in own.notes:
            log.warning("%s", note)
        other = result.dead_reckoning
        if other is None:
            return own, None
        return own, evaluate(other, truth, T_cam0_imu=result.T_cam0_body, lengths_m=lengths_m)
    except EvaluationError as error:
        log.warning("the reference was not used: %s", error)
        return None, None


def start_s(work_ms: FloatArray) -> float:
    """Return the seconds that slow frames took beyond the median: those that compile loops,
    where any were compiled.
    """
    median = robust.median(work_ms)
    return float(np.sum(work_ms[work_ms > _SLOW * median] - median)) * 1e-3


def refused_share(used: npt.ArrayLike, gated: npt.ArrayLike) -> float | None:
    """Return which share of the observations the gates refused, by the numbers (F,) used and gated
    in each frame.

    None: there was nothing to refuse.
    """
    kept = float(np.nansum(used))
    refused = float(np.nansum(gated))
    if kept + refused:
        return refused / (kept + refused)
    return None


def metrics_of(
    result: RunResult,
    evaluation: Evaluation | None,
    dead_reckoning: Evaluation | None,
    folder: Path,
) -> dict[str, Any]:
    """Collect the metrics for `--json` and metrics.json; null where there is no reference."""
    frames = result.frames
    work_ms = np.array([f.total_ms for f in frames])
    innovations = np.asarray(frames.column("innovation_ratio"), dtype=np.float64)
    scores = {} if evaluation is None else evaluation.as_dict()
    numbers = result.recording.image_numbers
    return {
        "out": str(folder),
        "complete": result.stopped is None,
        "stopped": result.stopped,
        "source": str(result.recording.path),
        "kind": result.recording.kind,
        "version": __version__,
        "python": platform.python_version(),
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "backend": result.config.backend,
        "motion": result.motion or "none",
        "body": result.body,
        "frames": len(frames),
        "image_numbers": None if numbers is None else frames_text(numbers),
        "first_frame": frames[0].index,
        "last_frame": frames[-1].index,
        "path_length_m": path_length_m(result.trajectory.positions),
        "ms_per_frame": float(work_ms.mean()),
        "ms_per_frame_median": robust.median(work_ms),
        "ms_per_frame_95": robust.quantile(work_ms, 0.95),
        "start_s": start_s(work_ms) if has_compiled() else 0.0,
        "stages_ms": {
            name: robust.median([getattr(f, f"{name}_ms") for f in frames]) for name in STAGES
        },
        "refused_share": refused_share(frames.column("used"), frames.column("gated")),
        "innovation_ratio": None
        if np.isnan(innovations).all()
        else robust.median(innovations[~np.isnan(innovations)]),
        "landmarks": len(result.landmarks.ids),
        **{name: scores.get(name) for name in ("ate_m", "rpe")},
        "drift_lengths_m": scores.get("drift_lengths_m", []),
        **{name: scores.get(name) for name in ("t_err_percent", "r_err_deg_per_100m")},
        "evaluation": scores or None,
        "dead_reckoning": None if dead_reckoning is None else dead_reckoning.as_dict(),
        "landmark_error": landmark_error(result, evaluation),
        "warnings": list(result.warnings),
        "findings": [finding.to_json() for finding in result.findings],
        "integrity": integrity_counts(result),
        "doubts": list(result.recording.doubts),
        "right_images": result.repair.to_json(),
        "stereo_field": stereo_field(result),
        "stereo_scale": stereo_scale(result),
        "scale_sigma": final_scale_sigma(result),
        "rig_scale_sigma": rig_scale_sigma(result),
        "camera_imu": camera_imu(result),
        "imu": imu_calibration(result),
        "T_cam0_imu": result.T_cam0_body.tolist(),
        "camera": asdict(result.recording.camera),
    }


def stereo_field(result: RunResult) -> dict[str, Any] | None:
    """Return what the stereo calibration was found to be off by at the end of the run; None: it was
    not estimated.

    Coefficients of equations (R3) and (R2) of docs/math.md and their standard deviations, times the
    focal length; and what the rig is off by, as `vio.calibration.stereo_field` names it; None where
    no rig of the given lens models is.
    """
    field = result.estimates[-1].stereo_field
    if field is None:
        return None
    camera = result.recording.camera
    f = camera.fu
    found = None
    coefficients = f * field.coefficients
    sigmas = f * np.sqrt(np.diag(field.covariance))
    seen = [px for px in result.frames.column("disparity_median_px") if px is not None and px == px]
    disparity, sigma = disparity_off(field)
    off = StereoError(field.rows_rms_px, robust.median(seen or [0.0]), f * disparity, f * sigma)
    if not result.recording.camera.is_cylinder:
        try:
            found = result.calibrated_rig()
        except CalibrationError as error:  # the results of the run do not depend on it
            log.warning("%s", error)
    rig = None
    if found is not None:
        rig = {
            "off": dict(zip(PARAMETERS, found.parameters.tolist(), strict=True)),
            "sigma": dict(zip(PARAMETERS, found.sigmas.tolist(), strict=True)),
            "not_expressed_px": found.left_px,
            "lines": list(found.lines()),
        }
    return {
        "rows_rms_px": field.rows_rms_px,
        "grade": off.grade,
        "text": str(off),
        "coefficients_px": coefficients.tolist(),
        "sigma_px": sigmas.tolist(),
        "rows_px": None if field.rows is None else (camera.fv * field.rows).tolist(),
        "rig": rig,
    }


def stereo_scale(result: RunResult) -> dict[str, Any] | None:
    """Return by what baseline and focal length were found to differ at the end of the run.

    None: not estimated.
    """
    scale = result.estimates[-1].stereo_scale
    if scale is None:
        return None
    return {
        name.replace(" ", "_"): {"percent": p, "sigma_percent": s}
        for name, (p, s) in scale.percent().items()
    }


def final_scale_sigma(result: RunResult) -> float | None:
    """Return the median standard deviation of the scale over the frames, over it.

    None: not of one camera.
    """
    known = [
        sigma
        for sigma in result.estimates.column("scale_sigma")
        if sigma is not None and sigma == sigma
    ]
    return robust.median(known) if known else None


def integrity_counts(result: RunResult) -> dict[str, int]:
    """Return how many estimates are nominal, degraded and unusable."""
    states = np.array(result.frames.column("integrity"))
    return {name: int((states == k).sum()) for k, name in enumerate(INTEGRITIES)}


def rig_scale_sigma(result: RunResult) -> float | None:
    """Return the standard deviation of the scale by the calibration, over it, with what the run
    found against it.

    None: it is estimated or left out.
    """
    if (
        result.config.backend != "msckf"
        or result.recording.camera.kind == "mono"
        or result.estimates[-1].stereo_scale is not None
    ):
        return None
    return float(np.hypot(scale_sigma(result.config.msckf), result.scale_doubt))


def camera_imu(result: RunResult) -> dict[str, Any] | None:
    """Return the extrinsics and the time offset as estimated at the end of the run; None: neither
    was.

    Rotation and translation are those of `T_given^-1 T_cam0_imu` on the IMU's side, the correction
    of the given one.
    """
    estimate = result.estimates[-1]
    out: dict[str, Any] = {}
    if estimate.time_offset_s is not None and estimate.time_offset_sigma_s is not None:
        out["time_offset_ms"] = 1e3 * estimate.time_offset_s
        out["time_offset_sigma_ms"] = 1e3 * estimate.time_offset_sigma_s
    if estimate.T_cam0_imu is not None and estimate.T_cam0_imu_covariance is not None:
        xi = se3_log(se3_inverse(result.T_cam0_body) @ estimate.T_cam0_imu)
        sigma = np.sqrt(np.diag(estimate.T_cam0_imu_covariance))
        out |= {
            "T_cam0_imu": estimate.T_cam0_imu.tolist(),
            "rotation_deg": np.degrees(xi[3:]).tolist(),
            "rotation_sigma_deg": np.degrees(sigma[3:]).tolist(),
            "translation_mm": (1e3 * xi[:3]).tolist(),
            "translation_sigma_mm": (1e3 * sigma[:3]).tolist(),
        }
    return out or None


def imu_calibration(result: RunResult) -> dict[str, Any] | None:
    """Return scale and misalignment of the IMU as estimated at the end of the run; None: they were
    not.

    Entries of `M - I` of equation (A1) of docs/math.md, which multiply the readings: by sensor, the
    scales of x, y, z in %, and the others by row and column in degrees, with their standard
    deviations.
    """
    estimate = result.estimates[-1]
    terms = estimate.imu_terms
    sigmas = estimate.imu_terms_sigma
    if terms is None or sigmas is None:
        return None
    out: dict[str, Any] = {}
    for (sensor, row, column), value, sigma in zip(
        IMU_ENTRIES, terms.tolist(), sigmas.tolist(), strict=True
    ):
        own = out.setdefault(("accelerometer", "gyro")[sensor], {})
        kind, factor = (
            ("scale_percent", 100.0) if row == column else ("misalignment_deg", math.degrees(1.0))
        )
        if row == column:
            axes = "xyz"[row]
        else:
            axes = "xyz"[row] + "xyz"[column]
        if sigma > 0:
            own.setdefault(kind, {})[axes] = factor * value
            own.setdefault(f"{kind}_sigma", {})[axes] = factor * sigma
    return out


def landmark_error(result: RunResult, evaluation: Evaluation | None) -> dict[str, Any] | None:
    """Compare the map with surveyed landmarks, after alignment of the trajectory.

    None: no such landmarks.
    """
    truth = result.recording.landmarks_reference
    if truth is None or evaluation is None:
        return None
    _, own, theirs = np.intersect1d(result.landmarks.ids, truth.ids, return_indices=True)
    if len(own) == 0:
        return None
    aligned = transform_points(
        evaluation.T_ref_est, evaluation.scale * result.landmarks.p_world[own]
    )
    errors_m = np.linalg.norm(aligned - truth.p_world[theirs], axis=1)
    return {
        "matched": len(own),
        "surveyed": len(truth.ids),
        **{f"{name}_m": value for name, value in asdict(error_statistics(errors_m)).items()},
    }


def calibration_text(result: RunResult) -> str:
    """Return the calibration with what a run found it to be off by, as Kalibr's camchain, which
    `vio.load_rig` reads.

    Raises:
        DataError: the recording holds features without an image size.
        CalibrationError: no rig of the given lens models is off as the run found it.
    """
    from vio.datasets.rigs.kalibr import kalibr_text  # with all other formats of a calibration

    found = result.calibrated_rig()
    if found is None:
        raise DataError(
            f"{result.recording.path}: states no image size, which a calibration needs; nothing "
            "was saved"
        )
    lines = [f"by vio run {__version__}, of {result.recording.path.name}"]
    lines += found.lines() or ["nothing was found to be off: the calibration as given"]
    if found.left_px:
        lines.append(
            f"what this calibration cannot express of it: {found.left_px:.2f} px (rms over the "
            "images)"
        )
    if result.recording.camera.is_cylinder and result.estimates[-1].stereo_field is not None:
        lines.append(
            "left and right are as given, though found to be off; run with "
            "dataset.projection=pinhole"
        )
    if not result.recording.has_images:
        lines.append("of the rectified images that the features come from")
    return "".join(f"# {printable(line)}\n" for line in lines) + kalibr_text(found.rig)


def write_landmarks_ply(path: Path, landmarks: Landmarks) -> None:
    """Write the map as a binary PLY: x y z in metres, and the largest standard deviation of any
    direction.
    """
    count = len(landmarks.ids)
    names = ("x", "y", "z", "sigma")
    header = "ply\nformat binary_little_endian 1.0\ncomment landmarks in the world frame, metres\n"
    header += (
        f"element vertex {count}\n"
        + "".join(f"property float {name}\n" for name in names)
        + "end_header\n"
    )
    with path.open("wb") as stream:
        stream.write(header.encode("ascii"))
        for start in range(0, count, _CHUNKS.rows):
            part = slice(start, start + _CHUNKS.rows)
            points = np.zeros(
                min(_CHUNKS.rows, count - start), dtype=[(name, "<f4") for name in names]
            )
            points["x"], points["y"], points["z"] = landmarks.p_world[part].T
            largest = np.linalg.eigvalsh(landmarks.covariance[part])[:, -1]
            points["sigma"] = np.sqrt(np.maximum(largest, 0.0))
            stream.write(points.tobytes())
