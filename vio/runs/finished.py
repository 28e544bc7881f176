"""Reader of a run's folder for those who show it: estimates, the log of the frames, map,
reference, settings.
"""

from __future__ import annotations

import csv
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from vio.config import Config, describe, load_config
from vio.errors import ConfigError, DataError, EvaluationError
from vio.evaluation.numbering import numbered_by_images
from vio.evaluation.trajectories import Evaluation, evaluate
from vio.files.inputs import read_input
from vio.files.tables import Rows
from vio.files.trajectories import read_trajectory
from vio.geometry.lie import FloatArray
from vio.geometry.upright import up_of
from vio.numerics.kinds import Capacity
from vio.records import LoopEvent, MapKeyframes, Trajectory
from vio.runs.files import RunFile
from vio.runs.mapped import read_keyframes, read_lines, read_loops
from vio.runs.stated import read_image_numbers, read_metrics
from vio.runs.tables import ESTIMATE

log = logging.getLogger(__name__)

_FORMER = {"watch_ms": "monitor_ms"}  # columns of frames.csv by their names until 0.2

_PLY_POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "sigma")])
_MAX_PLY_BYTES: Capacity[int] = 2 << 30


@dataclass(frozen=True, slots=True)
class FinishedRun:
    """What `vio run` wrote, read again; N frames."""

    folder: Path
    name: str  # of the folder, and of as many folders above it as distinguish it from other runs
    metrics: dict[str, Any]
    estimates: Rows  # (N,) rows of `vio.runs.tables.ESTIMATE`
    frames: dict[str, FloatArray]  # columns (N,) of frames.csv
    points: FloatArray  # (M, 3) landmarks, world, metres
    point_sigmas: FloatArray  # (M,) largest standard deviation of any direction, metres
    trajectory: Trajectory
    evaluation: Evaluation | None  # against the reference; None: there is none
    dead_reckoning: Trajectory | None
    # settings that differ from the default: (value, default)
    changed: Mapping[str, tuple[Any, Any]]
    T_cam0_body: FloatArray  # (4, 4)
    mapped: Trajectory | None  # poses of all frames in the map; None: the run had no map
    loops: tuple[LoopEvent, ...]  # places seen again
    map_keyframes: MapKeyframes  # that share the frame of `mapped`

    @property
    def seconds(self) -> FloatArray:
        """Time (N,) of the frames since the first one."""
        times = self.estimates["time_ns"]
        return np.asarray((times - times[0]) * 1e-9, dtype=np.float64)


def read_finished_run(folder: Path, reference: Path | None = None) -> FinishedRun:
    """Read the folder of a run.

    Raises:
        DataError: it is no run's folder, or a file in it is missing or damaged.
    """
    metrics, T_cam0_body = read_metrics(folder)
    if not (folder / RunFile.ESTIMATES).is_file() and (folder / RunFile.UNFINISHED).is_dir():
        raise DataError(
            f"{folder}: this run was ended before its end; `vio run --resume {folder}` goes on "
            "with it"
        )
    estimates = read_estimates(folder / RunFile.ESTIMATES)
    points = read_points(folder / RunFile.LANDMARKS)
    trajectory = Trajectory(
        np.array(estimates["T_world_imu"]),
        np.array(estimates["time_ns"]),
        "cam0" if metrics.get("body") == "cam0" else "imu",
        frame_indices=np.array(estimates["index"]),
    )
    reckoned = folder / RunFile.DEAD_RECKONING
    in_map = folder / RunFile.MAP_TRAJECTORY
    dead_reckoning = None
    if reckoned.is_file():
        dead_reckoning = read_trajectory(reckoned)
    mapped = None
    if in_map.is_file():
        mapped = read_trajectory(in_map)
    return FinishedRun(
        folder=folder,
        name=folder.resolve().name,
        metrics=metrics,
        estimates=estimates,
        frames=_read_frames(folder / RunFile.FRAMES, len(estimates)),
        points=_positions(points),
        point_sigmas=points["sigma"].astype(np.float64),
        trajectory=trajectory,
        evaluation=_evaluation(folder, trajectory, reference, T_cam0_body),
        dead_reckoning=dead_reckoning,
        changed=_changed_settings(folder / RunFile.CONFIG),
        T_cam0_body=T_cam0_body,
        mapped=mapped,
        loops=read_loops(folder),
        map_keyframes=read_keyframes(folder),
    )


def with_distinct_names(runs: Sequence[FinishedRun]) -> list[FinishedRun]:
    """Return runs whose names differ, by folders above theirs where necessary."""
    parts = [run.folder.resolve().parts for run in runs]
    deepest = max((len(p) for p in parts), default=1)
    for depth in range(1, deepest + 1):
        names = ["/".join(p[-depth:]) for p in parts]
        if len(set(names)) == len(set(parts)):
            break
    return [replace(run, name=name) for run, name in zip(runs, names, strict=True)]


def read_estimates(path: Path) -> Rows:
    """Read the table of estimates; columns that an older version did not write are NaN."""
    try:
        found = np.load(path, allow_pickle=False)
    except (
        OSError,
        ValueError,
        EOFError,
        TokenError,
    ) as error:  # NumPy takes a damaged header for one of Python 2
        reason = " ".join(str(error).split())
        raise DataError(
            f"{path}: cannot be read ({reason}); the run wrote no estimates, repeat it"
        ) from error
    needed = {"index", "time_ns", "T_world_imu", "covariance"}
    if (
        found.dtype.names is None
        or not needed <= set(found.dtype.names)
        or found.ndim != 1
        or not len(found)
    ):
        raise DataError(f"{path}: is no table of estimates; repeat the run")
    rows = np.zeros(len(found), dtype=ESTIMATE)
    for name in ESTIMATE.names or ():
        known = name in found.dtype.names and found[name].shape == rows[name].shape
        rows[name] = found[name] if known else np.nan
    return rows


def _read_frames(path: Path, count: int) -> dict[str, FloatArray]:
    """Read the log of the frames by column; missing values are NaN."""
    header, *lines = list(csv.reader(read_lines(path))) or [[]]
    if len(lines) != count or any(len(line) != len(header) for line in lines):
        raise DataError(
            f"{path}: has {len(lines)} frames where estimates.npy has {count}; repeat the run"
        )
    try:
        return {
            _FORMER.get(name, name): np.array(
                [float(line[k]) if line[k] else np.nan for line in lines]
            )
            for k, name in enumerate(header)
        }
    except ValueError as error:
        raise DataError(f"{path}: {error}; repeat the run") from error


def read_points(path: Path) -> np.ndarray[Any, Any]:
    """Read the points (M,) of `write_landmarks_ply`; a missing file has none."""
    if not path.is_file():
        return np.zeros(0, dtype=_PLY_POINT)
    data = read_input(path, _MAX_PLY_BYTES)
    end = data.find(b"end_header\n")
    body = data[end + len(b"end_header\n") :]
    if end < 0 or len(body) % _PLY_POINT.itemsize:
        raise DataError(f"{path}: is damaged; repeat the run")
    return np.frombuffer(body, dtype=_PLY_POINT)


def point_positions(folder: Path) -> FloatArray:
    """Return the points (M, 3) of a run in the world of its odometry.

    Raises:
        DataError: the file cannot be used.
    """
    p = _positions(read_points(folder / RunFile.LANDMARKS))
    return p[np.isfinite(p).all(axis=1)]


def _positions(points: np.ndarray[Any, Any]) -> FloatArray:
    return np.stack([points[name] for name in "xyz"], axis=1).astype(np.float64)


def up_of_odometry(folder: Path, metrics: dict[str, Any]) -> FloatArray | None:
    """Return the direction (3,) that is up in the world of a run's odometry, as its end knows it,
    see `up_of`.

    Raises:
        DataError: the file of the estimates is damaged.
    """
    path = folder / RunFile.ESTIMATES
    gravity = None
    if path.is_file():
        gravity = np.array(read_estimates(path)["gravity_world"][-1])
    return up_of(metrics.get("motion"), gravity)


def _evaluation(
    folder: Path, trajectory: Trajectory, reference: Path | None, T_cam0_body: FloatArray
) -> Evaluation | None:
    """Compare with a given reference, or with the one that the run left in its folder."""
    if reference is None:
        path = folder / RunFile.REFERENCE
    else:
        path = reference
    if reference is None and not path.is_file():
        return None
    try:
        truth = numbered_by_images(read_trajectory(path), read_image_numbers(folder))
        return evaluate(trajectory, truth, T_cam0_imu=T_cam0_body)
    except EvaluationError as error:
        log.warning("%s: the reference was not used: %s", path, error)
        return None


def _changed_settings(path: Path) -> dict[str, tuple[Any, Any]]:
    """Return the settings of a run that are not the default, with the default."""
    if not path.is_file():
        return {}
    try:
        values = {row.key: row.default for row in describe(load_config(path))}
    except ConfigError as error:
        log.warning("%s", error)
        return {}
    return {
        row.key: (values[row.key], row.default)
        for row in describe(Config())
        if values[row.key] != row.default
    }
