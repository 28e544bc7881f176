"""A run in its map: poses as known at the time and at the end, and the files of its loops and
keyframes.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vio.datasets.common import read_npz
from vio.errors import DataError
from vio.files.inputs import read_input
from vio.files.tables import Records, Rows
from vio.files.trajectories import read_trajectory
from vio.geometry.lie import (
    FloatArray,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    se3_log,
)
from vio.records import (
    Estimate,
    IntArray,
    LoopEvent,
    LoopMatches,
    MapKeyframes,
    Trajectory,
    no_map_keyframes,
)
from vio.runs.files import RunFile

if TYPE_CHECKING:
    from vio.mapping.session import MapSession

_LOOP_COLUMNS = (
    *(
        "frame",
        "time_ns",
        "keyframe",
        "keyframe_time_ns",
        "inliers",
        "gap_m",
        "joined",
        "keyframe_frame",
        "kept",
    ),
)
_MATCH_COLUMNS = ("z_keyframe", "z_frame", "has_right_keyframe", "has_right_frame")
_KEYFRAME_COLUMNS = (
    "keyframe",
    "frame",
    "time_ns",
    "own",
    "tx",
    "ty",
    "tz",
    "qx",
    "qy",
    "qz",
    "qw",
)


@dataclass(frozen=True, slots=True)
class MappedRun:
    """What a map made of a run."""

    T_map_body: FloatArray  # (N, 4, 4) of all frames, optimised at the end
    causal: Rows  # (M,) rows of MAPPED: poses as known at the time, of the frames that had one
    joined: bool  # whether `T_map_body` is in the map's frame; else in one of the run's own
    keyframes: int  # of this run
    loops: tuple[LoopEvent, ...]
    in_map: MapKeyframes  # all keyframes that share the frame of `T_map_body`
    # what became of the adjustment with the IMU; None: there was nothing to adjust
    adjustment: str | None = None


def mapped_run(session: MapSession, estimates: Records[Estimate], causal: Rows) -> MappedRun:
    """Return the poses of all frames in the map; `causal` are those known at the time."""
    T_odom_body, index = (np.array(estimates.column(name)) for name in ("T_world_imu", "index"))
    frames, T_map, T_odom = session.keyframes()
    T = corrected(T_odom_body, index, frames, T_map, T_odom)
    in_map = _with_scale(session.map_keyframes(), session.scale_sigma)
    return MappedRun(T, causal, session.is_joined, len(frames), session.settled_loops(), in_map)


def _with_scale(in_map: MapKeyframes, sigma: float) -> MapKeyframes:
    """Return keyframes with a scale in their covariance that none of their motions and loops
    knows: (G6).
    """
    T = in_map.T_map_body
    xi_D_scale = np.zeros((len(T), 6))
    from_first = T[:, :3, 3] - T[:1, :3, 3]
    xi_D_scale[:, :3] = np.einsum("kji,kj->ki", T[:, :3, :3], from_first)
    considered = sigma**2 * xi_D_scale[:, :, None] * xi_D_scale[:, None, :]
    return replace(in_map, covariance=in_map.covariance + considered)


def corrected(
    T_odom_body: FloatArray,
    index: IntArray,
    frames: IntArray,
    T_map: FloatArray,
    T_odom: FloatArray,
) -> FloatArray:
    """Return poses (N, 4, 4) in the map: the odometry, with the corrections of the keyframes spread
    between them.

    Args:
        T_odom_body: (N, 4, 4) odometry.
        index: (N,) frame numbers.
        frames: (K,) frame numbers of the keyframes, increasing.
        T_map: (K, 4, 4) their poses in the map.
        T_odom: (K, 4, 4) their poses by the odometry.
    """
    if not len(frames):
        return T_odom_body
    before = np.clip(np.searchsorted(frames, index, side="right") - 1, 0, len(frames) - 1)
    after = np.minimum(before + 1, len(frames) - 1)
    out = T_map[before] @ se3_inverse(T_odom[before]) @ T_odom_body
    # The correction of the next keyframe, in its own frame, comes in with the share of the frames
    # that have passed.
    end = T_map[before] @ se3_inverse(T_odom[before]) @ T_odom[after]
    xi = se3_log(se3_inverse(end) @ T_map[after])
    share = (index - frames[before]) / np.maximum(frames[after] - frames[before], 1)
    return out @ se3_exp(np.clip(share, 0.0, 1.0)[:, None] * xi)


def read_trajectories(folder: Path) -> tuple[Trajectory, Trajectory]:
    """Return the poses of a run's frames, in its map where it had one, and the same by odometry, as
    the landmarks are.

    Raises:
        DataError: a file cannot be used, or they are not of the same frames.
    """
    odometry = read_trajectory(folder / RunFile.TRAJECTORY)
    if not (folder / RunFile.MAP_TRAJECTORY).is_file():
        return odometry, odometry
    in_map = read_trajectory(folder / RunFile.MAP_TRAJECTORY)
    if len(odometry) != len(in_map):
        raise DataError(
            f"{folder}: its trajectories in the map and by odometry differ in length; repeat the "
            "run"
        )
    return in_map, odometry


def write_loops(folder: Path, loops: Sequence[LoopEvent]) -> None:
    """Write the loops of a run, one a line, and the features that agree with them."""
    _write_rows(
        folder / RunFile.LOOPS,
        _LOOP_COLUMNS,
        [[getattr(o, name) for name in _LOOP_COLUMNS] for o in loops],
    )
    known = [(n, o.matches) for n, o in enumerate(loops) if o.matches is not None]
    indices = [n for n, _ in known]
    counts = [len(found) for _, found in known]
    of_loop = np.repeat(indices, counts).astype(np.int64)
    none = np.zeros((0, 4)), np.zeros(0, dtype=np.bool_)
    columns: dict[str, Any] = {
        name: np.concatenate([none[name.startswith("has")], *(getattr(m, name) for _, m in known)])
        for name in _MATCH_COLUMNS
    }
    np.savez_compressed(folder / RunFile.LOOP_MATCHES, loop=of_loop, **columns)


def write_keyframes(folder: Path, keyframes: MapKeyframes) -> None:
    """Write the keyframes of a map, one a line, and their covariances."""
    np.save(folder / RunFile.MAP_KEYFRAMES_COVARIANCE, keyframes.covariance)
    T = keyframes.T_map_body
    poses = np.concatenate([T[:, :3, 3], quat_xyzw_from_rotation(T[:, :3, :3])], axis=1).tolist()
    columns = (
        keyframes.keyframe,
        keyframes.frame,
        keyframes.time_ns,
        keyframes.own.astype(np.int64),
    )
    numbers = np.stack(columns, axis=1).tolist()
    rows = [[*row, *pose] for row, pose in zip(numbers, poses, strict=True)]
    _write_rows(folder / RunFile.MAP_KEYFRAMES, _KEYFRAME_COLUMNS, rows)


def read_loops(folder: Path) -> tuple[LoopEvent, ...]:
    """Read what `write_loops` wrote; a run without a map has none.

    Raises:
        DataError: a file is damaged.
    """
    path = folder / RunFile.LOOPS
    if not path.is_file():
        return ()
    matches = _read_matches(folder / RunFile.LOOP_MATCHES)
    try:
        rows = csv.DictReader(read_lines(path))
        return tuple(
            LoopEvent(
                **{name: int(row[name]) for name in _LOOP_COLUMNS[:5]},
                gap_m=float(row["gap_m"]),
                joined=row["joined"] == "True",
                keyframe_frame=int(row["keyframe_frame"]) if row.get("keyframe_frame") else None,
                kept=row.get("kept", "True") == "True",
                matches=matches.get(n),
            )
            for n, row in enumerate(rows)
        )
    except (KeyError, ValueError, TypeError) as error:
        raise DataError(f"{path}: is damaged ({error}); repeat the run") from error


def read_keyframes(folder: Path) -> MapKeyframes:
    """Read what `write_keyframes` wrote; a run without a map has none.

    Raises:
        DataError: the file is damaged.
    """
    path = folder / RunFile.MAP_KEYFRAMES
    if not path.is_file():
        return no_map_keyframes()
    try:
        rows = [*csv.DictReader(read_lines(path))]
        keyframe, frame, time_ns, own = (
            np.array([int(row[name]) for row in rows], dtype=np.int64)
            for name in _KEYFRAME_COLUMNS[:4]
        )
        values = [[float(row[name]) for name in _KEYFRAME_COLUMNS[4:]] for row in rows]
    except (KeyError, ValueError, TypeError) as error:
        raise DataError(f"{path}: is damaged ({error}); repeat the run") from error
    poses = np.array(values).reshape(-1, 7)
    P = _read_covariances(folder / RunFile.MAP_KEYFRAMES_COVARIANCE, len(poses))
    if (
        not np.isfinite(poses).all()
        or (np.abs(np.linalg.norm(poses[:, 3:], axis=1) - 1) > 1e-3).any()
    ):
        raise DataError(f"{path}: is damaged (a pose is none); repeat the run")
    T = se3_from_parts(rotation_from_quat_xyzw(poses[:, 3:]), poses[:, :3])
    return MapKeyframes(keyframe, frame, time_ns, own > 0, T, P)


def _read_covariances(path: Path, count: int) -> FloatArray:
    """Read matrices (K, 6, 6); NaN where an older version wrote none."""
    if not path.is_file():
        return np.full((count, 6, 6), np.nan)
    try:
        P = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{path}: cannot be read ({error}); repeat the run") from error
    if P.shape != (count, 6, 6) or P.dtype != np.float64:
        raise DataError(f"{path}: is damaged; repeat the run")
    return P


def _write_rows(path: Path, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    lines = [
        ",".join("" if value is None else str(value) for value in row) for row in [columns, *rows]
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file of a run.

    Raises:
        DataError: it cannot be read.
    """
    try:
        return read_input(path).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read ({error}); repeat the run") from error


def _read_matches(path: Path) -> dict[int, LoopMatches]:
    """Read the features of each loop; a missing file has none."""
    if not path.is_file():
        return {}
    held = read_npz(path)
    shapes = [held[name].shape for name in _MATCH_COLUMNS if name in held]
    loop = held.get("loop")
    expected = None
    if loop is not None:
        count = len(loop)
        expected = [(count, 4), (count, 4), (count,), (count,)]
    if loop is None or shapes != expected:
        raise DataError(f"{path}: is damaged; repeat the run")
    return {
        int(n): LoopMatches(*(held[name][loop == n] for name in _MATCH_COLUMNS))
        for n in np.unique(loop)
    }
