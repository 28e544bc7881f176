"""What a run keeps of each frame, as rows of tables: estimates, the frame's log, observations,
motion samples.

A value that is missing (None) is NaN in a row.
"""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import numpy as np

from vio.datasets.samples import motion_samples
from vio.files.tables import Rows, Table
from vio.findings import INTEGRITIES
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity
from vio.records import (
    Estimate,
    FrameLog,
    ImuSample,
    MotionSample,
    Observations,
    StereoFieldEstimate,
    StereoScaleEstimate,
    VelocitySample,
)

# Optional fields of an estimate, with their shapes.
_KEPT = {
    field.name: field.metadata["shape"]
    for field in dataclasses.fields(Estimate)
    if "shape" in field.metadata
}
_kept = attrgetter(*_KEPT)
ESTIMATE = np.dtype(
    [
        ("index", "<i8"),  # number of the frame
        ("time_ns", "<i8"),
        ("T_world_imu", "<f8", (4, 4)),
        ("covariance", "<f8", (6, 6)),
        *((name, "<f8", shape) for name, shape in _KEPT.items()),
        ("stereo_field", "<f8", (8,)),
        ("stereo_field_covariance", "<f8", (8, 8)),
        ("stereo_rows_rms_px", "<f8"),
        ("stereo_rows", "<f8", (7,)),
        ("stereo_rows_covariance", "<f8", (7, 7)),
        ("stereo_scale", "<f8", (2,)),
        ("stereo_scale_covariance", "<f8", (2, 2)),
        ("integrity", "i1"),  # index in `vio.findings.INTEGRITIES`
    ]
)
# Columns of an estimate's records, by their fields there.
_FIELD = {
    "stereo_field": "coefficients",
    "stereo_field_covariance": "covariance",
    "stereo_rows_rms_px": "rows_rms_px",
    "stereo_rows": "rows",
    "stereo_rows_covariance": "rows_covariance",
}
_SCALE = {"stereo_scale": "logs", "stereo_scale_covariance": "covariance"}
_STAGES: Capacity[int] = 16  # of the front end, at most
_COUNTS = (
    "detected",
    "tracked",
    "matched",
    "selected",
    "stale",
    "used",
    "gated",
    "landmarks",
    "integrity",
)
_TIMES = ("read_ms", "frontend_ms", "monitor_ms", "select_ms", "filter_ms")
_NUMBERS = ("innovation_median_px", "nis_per_dof", "disparity_median_px", "innovation_ratio")
FRAME = np.dtype(
    [
        ("index", "<i8"),
        ("time_ns", "<i8"),
        *((name, "<f8") for name in _TIMES),
        *((name, "<i4") for name in _COUNTS),
        *((name, "<f8") for name in _NUMBERS),
        ("stages_ms", "<f8", (_STAGES,)),
    ]
)
_LOGGED = tuple(field.name for field in dataclasses.fields(FrameLog))[:-1]  # as columns
_logged = attrgetter(*_LOGGED)
OBSERVATION = np.dtype(
    [
        ("id", "<i8"),
        ("z", "<f8", (4,)),
        ("has_right", "?"),
        ("stale", "?"),
        ("sigma", "<f4", (3,)),
    ]
)
# one row a frame: its observations
SEEN = np.dtype(
    [
        ("index", "<i8"),
        ("time_ns", "<i8"),
        ("count", "<i8"),
    ]
)
SAMPLE = np.dtype(
    [
        ("time_ns", "<i8"),
        ("is_imu", "?"),
        ("values", "<f8", (6,)),
    ]
)
MAPPED = np.dtype(
    [
        ("index", "<i8"),
        ("time_ns", "<i8"),
        ("T_map_body", "<f8", (4, 4)),
        ("covariance", "<f8", (6, 6)),
    ]
)
POINT = np.dtype(
    [
        ("id", "<i8"),
        ("p_world", "<f8", (3,)),
        ("covariance", "<f8", (3, 3)),
    ]
)


def mapped_row(index: int, estimate: Estimate) -> Rows:
    """Return the place in the map of an estimate that has one as a row (1,)."""
    row = np.zeros(1, dtype=MAPPED)
    row["index"] = index
    row["time_ns"] = estimate.time_ns
    row["T_map_body"] = estimate.T_map_body
    covariance = estimate.T_map_body_covariance
    row["covariance"] = np.nan if covariance is None else covariance
    return row


def estimate_row(index: int, estimate: Estimate) -> Rows:
    """Return an estimate of frame `index` as a row (1,)."""
    row = np.zeros(1, dtype=ESTIMATE)
    row["index"] = index
    row["time_ns"] = estimate.time_ns
    row["T_world_imu"] = estimate.T_world_imu
    row["covariance"] = estimate.covariance
    row["integrity"] = INTEGRITIES.index(estimate.integrity)
    for name, value in zip(_KEPT, _kept(estimate), strict=True):
        row[name] = np.nan if value is None else value
    for record, columns in ((estimate.stereo_field, _FIELD), (estimate.stereo_scale, _SCALE)):
        for column, name in columns.items():
            value = None if record is None else getattr(record, name)
            row[column] = np.nan if value is None else value
    return row


def estimate_of(row: np.void) -> Estimate:
    """Return the estimate of a row."""
    optional: dict[str, Any] = {
        name: _array(row[name]) if shape else _number(row[name]) for name, shape in _KEPT.items()
    }
    scale = _array(row["stereo_scale"])
    S = _array(row["stereo_scale_covariance"])
    if scale is None or S is None:
        stereo_scale = None
    else:
        stereo_scale = StereoScaleEstimate(scale, S)
    return Estimate(
        int(row["time_ns"]),
        np.array(row["T_world_imu"]),
        np.array(row["covariance"]),
        **optional,
        stereo_field=_stereo_field(row),
        stereo_scale=stereo_scale,
        integrity=INTEGRITIES[int(row["integrity"])],
    )


def _stereo_field(row: np.void) -> StereoFieldEstimate | None:
    coefficients = _array(row["stereo_field"])
    P = _array(row["stereo_field_covariance"])
    if coefficients is None or P is None:
        return None
    rows = _array(row["stereo_rows"])
    rows_P = _array(row["stereo_rows_covariance"])
    return StereoFieldEstimate(coefficients, P, row["stereo_rows_rms_px"], rows, rows_P)


class FrameRows:
    """Frame logs as rows; the names of the front end's stages are kept beside the table."""

    def __init__(self) -> None:
        self.stages: list[str] = []  # in the order of first appearance

    def row(self, frame: FrameLog, read_ms: float) -> Rows:
        """Return a frame's log as a row (1,), with the time that reading took."""
        row = np.zeros(1, dtype=FRAME)
        for name, value in zip(_LOGGED, _logged(frame), strict=True):
            row[name] = np.nan if value is None else value
        row["read_ms"] = read_ms
        row["stages_ms"] = np.nan
        for name, ms in frame.stages_ms.items():
            if name not in self.stages and len(self.stages) < _STAGES:
                self.stages.append(name)
            if name in self.stages:
                row["stages_ms"][0, self.stages.index(name)] = ms
        return row

    def frame(self, row: np.void) -> FrameLog:
        """Return the log of a row."""
        values: dict[str, Any] = {name: int(row[name]) for name in ("index", "time_ns", *_COUNTS)}
        values |= {name: float(row[name]) for name in _TIMES}
        stages = {
            name: float(ms)
            for name, ms in zip(self.stages, row["stages_ms"], strict=False)
            if ms == ms
        }
        values |= {name: _number(row[name]) for name in _NUMBERS}
        return FrameLog(**values, stages_ms=stages)


def observation_rows(seen: Observations) -> Rows:
    """Return the observations of a frame as rows (N,)."""
    rows = np.zeros(len(seen), dtype=OBSERVATION)
    rows["id"] = seen.ids
    rows["z"] = seen.z
    rows["has_right"] = seen.has_right
    rows["stale"] = seen.stale
    if seen.sigma is None:
        rows["sigma"] = 0.0
    else:
        rows["sigma"] = seen.sigma
    return rows


def observations_of(row: np.void, table: Table, end: int) -> Observations:
    """Return the observations of a frame by its row in the table of frames; `end` is that of its
    rows in `table`.
    """
    own = table.rows(end - int(row["count"]), end)
    columns = (np.array(own[name]) for name in ("id", "z", "has_right", "stale", "sigma"))
    return Observations(int(row["index"]), int(row["time_ns"]), *columns)


def sample_rows(samples: Sequence[MotionSample]) -> Rows:
    """Return motion samples as rows (N,)."""
    arrays = motion_samples(samples)
    rows = np.zeros(len(arrays), dtype=SAMPLE)
    rows["time_ns"] = arrays.times_ns
    rows["is_imu"] = arrays.is_imu
    rows["values"] = arrays.values
    return rows


def sample_of(row: np.void) -> MotionSample:
    """Return the motion sample of a row."""
    kind = ImuSample if row["is_imu"] else VelocitySample
    return kind(int(row["time_ns"]), np.array(row["values"][:3]), np.array(row["values"][3:]))


def frames_csv(frames: Sequence[FrameLog], stages: Sequence[str], *, header: bool = True) -> str:
    """Return logs as CSV text; the front end's stages are the last columns."""
    text = io.StringIO()
    own = list(_LOGGED)
    writer = csv.writer(text, lineterminator="\n")
    if header:
        writer.writerow([*own, *(f"frontend_{name}_ms" for name in stages)])
    for frame in frames:
        values = [
            *(getattr(frame, name) for name in own),
            *(frame.stages_ms.get(name) for name in stages),
        ]
        writer.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in values])
    return text.getvalue()


def _array(value: FloatArray) -> FloatArray | None:
    if np.isnan(value).all():
        return None
    return np.array(value)


def _number(value: float) -> float | None:
    return None if value != value else float(value)
