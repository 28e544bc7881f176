"""What the JSON files of a run's folder state, checked before it is used: the folder may be of
another hand.
"""

from __future__ import annotations

import difflib
import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.dataclass import dataclass
from vio.errors import DataError
from vio.files.inputs import read_input
from vio.files.schema import (
    NUMBER,
    NUMBER_OR_NULL,
    TEXT,
    TEXT_OR_NULL,
    TRUTH,
    WHOLE,
    WHOLE_OR_NULL,
    Shape,
    a_list,
    an_object,
)
from vio.files.trajectories import frame_spans, read_trajectory
from vio.geometry.lie import FloatArray, checked_transform
from vio.numerics.kinds import Capacity
from vio.records import IntArray, Trajectory
from vio.runs.files import RunFile

log = logging.getLogger(__name__)

_MAX_BYTES: Capacity[int] = 2**26
_MAX_FRAMES: Capacity[int] = 10**8  # of a recording: a month at 30 a second
_NUMBERS = a_list(NUMBER)

REQUEST_SHAPE = an_object(
    {
        "source": TEXT,
        "reference": TEXT_OR_NULL,
        "start": WHOLE,
        "stop": WHOLE_OR_NULL,
        "lengths_m": a_list(NUMBER, or_null=True),
        "save_observations": TRUTH,
        "save_calibration": TEXT_OR_NULL,
        "map": TEXT_OR_NULL,
        "map_density": WHOLE_OR_NULL,
        "localise": TRUTH,
        "plot": TRUTH,
        "frontend": TEXT_OR_NULL,
        "command": TEXT_OR_NULL,
    },
    "source",
    "reference",
    "start",
    "stop",
    "lengths_m",
    "save_observations",
)


@dataclass(frozen=True, slots=True)
class RunRequest:
    """What a run was asked to do, as its folder keeps it while it can go on: `REQUEST_SHAPE`.

    Files outside of the folder are absolute; defaults are those of folders that do not say.
    """

    source: str  # kind:path
    reference: str | None  # file of the ground truth; None: that of the recording
    start: int  # first frame
    stop: int | None  # frame after the last one; None: the end
    lengths_m: list[float] | None  # of the drift; None: the usual ones
    save_observations: bool
    save_calibration: str | None = None  # file, by its name alone where it is in the folder
    map: str | None = None  # file
    map_density: int | None = None
    localise: bool = False  # leave the map as it is
    plot: bool = True
    frontend: str | None = None  # code of the caller's own, FILE.py:CLASS or module:CLASS
    command: str | None = None  # as typed

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> RunRequest:
        """Return what JSON of `REQUEST_SHAPE` states."""
        known = {field.name for field in fields(cls)}
        return cls(**{name: value for name, value in values.items() if name in known})

    def values(self) -> dict[str, Any]:
        """Return it as values of JSON."""
        return asdict(self)

    @property
    def writes_map(self) -> bool:
        """Whether the run makes or continues a map."""
        return self.map is not None and not self.localise


_CAMERA = an_object(
    {
        **dict.fromkeys(("fu", "fv", "cu", "cv", "baseline_m"), NUMBER),
        **dict.fromkeys(("width", "height"), WHOLE_OR_NULL),
        **dict.fromkeys(("projection", "kind"), TEXT),
    }
)
_STEREO_FIELD = an_object(
    {
        "text": TEXT_OR_NULL,
        "coefficients_px": _NUMBERS,
        "rows_px": a_list(NUMBER, or_null=True),
        "rig": an_object({"lines": a_list(TEXT)}, "lines", or_null=True),
    },
    or_null=True,
)
_RIGHT_IMAGES = an_object(
    {"late_frames": WHOLE, "turned_rad": a_list(NUMBER, or_null=True)}, or_null=True
)
_SCALE = an_object({"percent": NUMBER, "sigma_percent": NUMBER}, "percent", "sigma_percent")
_CAMERA_IMU = an_object(
    {
        "rotation_deg": _NUMBERS,
        "rotation_sigma_deg": _NUMBERS,
        "translation_mm": _NUMBERS,
        "translation_sigma_mm": _NUMBERS,
        "time_offset_ms": NUMBER,
        "time_offset_sigma_ms": NUMBER,
    },
    or_null=True,
)
_TOGETHER = (  # members of `camera_imu`: all, or none
    ("rotation_deg", "rotation_sigma_deg", "translation_mm", "translation_sigma_mm"),
    ("time_offset_ms", "time_offset_sigma_ms"),
)

METRICS_SHAPE = an_object(
    {
        "T_cam0_imu": a_list(_NUMBERS),
        "complete": TRUTH,
        **dict.fromkeys(("source", "kind", "version"), TEXT),
        **dict.fromkeys(
            ("stopped", "backend", "motion", "body", "command", "image_numbers"), TEXT_OR_NULL
        ),
        **dict.fromkeys(("frames", "first_frame", "last_frame", "landmarks"), WHOLE),
        **dict.fromkeys(("innovation_ratio", "ate_m", "path_length_m"), NUMBER_OR_NULL),
        "warnings": a_list(TEXT, or_null=True),
        "right_images": _RIGHT_IMAGES,
        "stereo_field": _STEREO_FIELD,
        "stereo_scale": an_object({}, each=_SCALE, or_null=True),
        "camera_imu": _CAMERA_IMU,
        "camera": _CAMERA,
        "map": an_object({"joined": TRUTH}, or_null=True),
    },
    "T_cam0_imu",
)


def read_stated(path: Path, shape: Shape, remedy: str) -> dict[str, Any]:
    """Read a JSON file of a run's folder.

    Raises:
        DataError: it cannot be read, or a value is of the wrong type; the message ends with the
            remedy.
    """
    try:
        values = json.loads(read_input(path, _MAX_BYTES))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: is damaged ({error}); {remedy}") from error
    fault = shape.fault(values, "") or _parted(values)
    if fault is not None:
        raise DataError(f"{path}: is damaged ({fault}); {remedy}")
    checked: dict[str, Any] = values
    return checked


def read_run(path: Path) -> tuple[Trajectory, FloatArray | None]:
    """Read a trajectory file, or the trajectory and extrinsics of a run's folder.

    Raises:
        DataError: the path contains no trajectory.
    """
    if not path.is_dir():
        trajectory = read_trajectory(path)
        beside = path.with_name(RunFile.TRAJECTORY)
        if path.name == RunFile.TRAJECTORY_KITTI and beside.is_file():
            numbered = read_trajectory(beside).frame_indices
            if numbered is not None and len(numbered) == len(trajectory):
                trajectory = replace(trajectory, frame_indices=numbered)
        return trajectory, None
    _, T_cam0_imu = read_metrics(path)
    return read_trajectory(path / RunFile.TRAJECTORY), T_cam0_imu


def read_image_numbers(path: Path) -> IntArray | None:
    """Return by which numbers the images (F,) of a run's recording are named; None: a path that is no
    run's folder or its trajectory, or no such names.

    Raises:
        DataError: the metrics are damaged.
    """
    folder = path if path.is_dir() else path.parent
    of_run = path.is_dir() or path.name in (RunFile.TRAJECTORY, RunFile.TRAJECTORY_KITTI)
    if not of_run or not (folder / RunFile.METRICS).is_file():
        return None
    text = read_stated(folder / RunFile.METRICS, METRICS_SHAPE, "repeat the run").get(
        "image_numbers"
    )
    if text is None:
        return None
    spans = frame_spans(text)
    if not spans or not 0 < sum(map(len, spans)) <= _MAX_FRAMES:
        raise DataError(
            f"{folder / RunFile.METRICS}: is damaged (image_numbers are {text[:60]!r}); repeat the run"
        )
    return np.concatenate(
        [np.arange(span.start, span.stop, span.step, dtype=np.int64) for span in spans]
    )


def read_metrics(folder: Path) -> tuple[dict[str, Any], FloatArray]:
    """Read the metrics of a run's folder, and `T_cam0_imu` (4, 4) from them.

    Raises:
        DataError: the folder is not a run's, or its metrics are damaged.
    """
    path = folder / RunFile.METRICS
    if not path.is_file():
        from vio.mapping.map_store import is_map

        if is_map(folder):
            raise DataError(
                f"{folder}: is a map, not a run; give the folder of a run with it (vio run --map), or "
                "show the map by vio map show"
            )
        raise DataError(_no_run(folder))
    metrics = read_stated(path, METRICS_SHAPE, "repeat the run")
    try:
        T_cam0_imu = np.array(metrics["T_cam0_imu"], dtype=np.float64)
    except ValueError as error:  # rows of different lengths
        raise DataError(f"{path}: is damaged ({error}); repeat the run") from error
    if metrics.get("complete") is False:
        log.warning(
            "%s: the run has not reached the end of its recording; these are its results so far",
            folder,
        )
    return metrics, checked_transform(T_cam0_imu, f"{path}, T_cam0_imu")


def _no_run(path: Path) -> str:
    """Say that a path is no run's folder, and which may be meant: the one that a file lies in, one
    in the folder, or one of a name like it.
    """
    wanted = "give a folder that `vio run` wrote"
    if not path.exists():
        beside = path.absolute().parent
        names = [run.name for run in _runs_in(beside)]
        near = difflib.get_close_matches(path.name, names, 1)
        hint = f"did you mean {path.parent / near[0]}?" if near else wanted
        return f"{path} does not exist; {hint}"
    if path.is_file() and (path.parent / RunFile.METRICS).is_file():
        return f"{path}: is a file of a run; give the folder of the run, {path.parent}"
    held = [str(path / run.name) for run in _runs_in(path)]
    if held:
        return f"{path}: holds the results of runs; give one of them, such as {held[0]}"
    return f"{path}: no run folder (it has no {RunFile.METRICS}); {wanted}"


def _runs_in(folder: Path) -> list[Path]:
    """Return the folders of runs in a folder, by name; none: it is no folder, or cannot be
    listed.
    """
    try:
        return sorted(run.parent for run in folder.glob(f"*/{RunFile.METRICS}"))
    except OSError:
        return []


def _parted(values: dict[str, Any]) -> str | None:
    """Say which member lacks the others that belong to it."""
    found = values.get("camera_imu") or {}
    for names in _TOGETHER:
        there = [name in found for name in names]
        if any(there) and not all(there):
            return f"camera_imu.{names[there.index(False)]} is missing"
    return None
