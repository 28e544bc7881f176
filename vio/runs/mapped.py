"""The poses of a run in its map: as they were known at the time, and as they are known at the end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, se3_log
from vio.records import LoopEvent, MapKeyframes
from vio.records import Estimate, IntArray
from vio.files.tables import Records, Rows

if TYPE_CHECKING:
    from vio.mapping.session import MapSession


@dataclass(frozen=True, slots=True)
class MappedRun:
    """What a map made of a run."""

    T_map_body: FloatArray  # (N, 4, 4) of all frames, optimised at the end
    causal: Rows  # (M,) rows of MAPPED: poses as known at the time, of the frames that had one
    joined: bool  # whether `T_map_body` is in the map's frame; else in one of the run's own
    keyframes: int  # of this run
    loops: tuple[LoopEvent, ...]
    in_map: MapKeyframes  # all keyframes that share the frame of `T_map_body`


def mapped_run(session: MapSession, estimates: Records[Estimate], causal: Rows) -> MappedRun:
    """Return the poses of all frames in the map; `causal` are those known at the time."""
    T_odom_body, index = (np.array(estimates.column(name)) for name in ("T_world_imu", "index"))
    frames, T_map, T_odom = session.keyframes()
    T = corrected(T_odom_body, index, frames, T_map, T_odom)
    return MappedRun(T, causal, session.is_joined, len(frames), session.settled_loops(), session.map_keyframes())


def corrected(
    T_odom_body: FloatArray, index: IntArray, frames: IntArray, T_map: FloatArray, T_odom: FloatArray
) -> FloatArray:
    """Return poses (N, 4, 4) in the map: the odometry, with the corrections of the keyframes spread between them.

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
    # The correction of the next keyframe, in its own frame, comes in with the share of the frames that have passed.
    end = T_map[before] @ se3_inverse(T_odom[before]) @ T_odom[after]
    xi = se3_log(se3_inverse(end) @ T_map[after])
    share = (index - frames[before]) / np.maximum(frames[after] - frames[before], 1)
    return out @ se3_exp(np.clip(share, 0.0, 1.0)[:, None] * xi)
