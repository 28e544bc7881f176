"""Runs beside the first of them: figures that changed, and how far apart the paths are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from vio.evaluation.alignment import align_poses
from vio.evaluation.trajectories import metres_texts
from vio.geometry.lie import FloatArray, se3_from_parts
from vio.report.words import run_figures, smaller_is_better
from vio.runs.finished import FinishedRun

_Value = TypeVar("_Value")
_SAME_PERCENT = 0.5  # of a change that rounds to none
_MIN_FRAMES = 3  # in common, for an alignment


@dataclass(frozen=True, slots=True)
class Apart:
    """How far a run is from another at the K frames that both have, after one rigid alignment."""

    seconds: FloatArray  # (K,) since the other's first frame
    distance_m: FloatArray  # (K,)

    def __str__(self) -> str:
        rms, most = metres_texts(
            float(np.sqrt(np.mean(self.distance_m**2))), float(self.distance_m.max())
        )
        return f"{rms} (rms), at most {most}, {len(self.seconds)} frames"


def apart(first: FinishedRun, other: FinishedRun) -> Apart | None:
    """Return how far a run is from the first; None: of other recordings, or of other frames."""
    if first.metrics.get("source") != other.metrics.get("source"):
        return None
    if first.metrics.get("body") != other.metrics.get("body"):
        return None
    _, i, j = np.intersect1d(
        first.estimates["time_ns"], other.estimates["time_ns"], return_indices=True
    )
    if len(i) < _MIN_FRAMES:
        return None
    reference = np.array(first.estimates["T_world_imu"][i])
    T = np.array(other.estimates["T_world_imu"][j])
    alignment = align_poses(T, reference, "se3")
    moved = se3_from_parts(alignment.R, alignment.t) @ T
    distance = np.linalg.norm(moved[:, :3, 3] - reference[:, :3, 3], axis=1)
    return Apart(first.seconds[i], distance)


def compared_figures(runs: Sequence[FinishedRun]) -> dict[str, list[tuple[str, bool]]]:
    """Return the figures of each run by name, with their change from the first run in per cent, and
    whether a figure is the best.

    Figures of different recordings are not compared.
    """
    columns = [run_figures(run) for run in runs]
    rows = {name: [(text, False) for text in _cells(columns, name)] for name in columns[0]}
    sources = {str(run.metrics.get("source")) for run in runs}
    if len(runs) > 1 and len(sources) == 1:
        numbers = [smaller_is_better(run) for run in runs]
        for name in numbers[0]:
            rows[name] = _with_changes(_cells(columns, name), _cells(numbers, name))
    return rows


def _cells(columns: Sequence[Mapping[str, _Value]], name: str) -> list[_Value]:
    """Return a row of a table that is given by columns."""
    return [column[name] for column in columns]


def _with_changes(texts: Sequence[str], values: Sequence[float | None]) -> list[tuple[str, bool]]:
    """Return the texts of one figure with the changes from the first value, and which is the
    smallest; where less than two are known, neither.
    """
    known = [value for value in values if value is not None]
    if len(known) < 2:
        return [(text, False) for text in texts]
    best = min(known)
    return [
        (text + _change(values[0], value), value == best != max(known))
        for text, value in zip(texts, values, strict=True)
    ]


def _change(first: float | None, value: float | None) -> str:
    """Return the change of a figure in words; nothing where there is none."""
    if not first or value is None or value == first:
        return ""
    percent = 100 * (value / first - 1)
    if abs(percent) < _SAME_PERCENT:
        return " (the same)"
    return f" ({percent:+.0f} %)"
