"""The records of loops and keyframes, which live callers and readers of a run's folder get."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vio.geometry.lie import FloatArray
from vio.records import BoolArray, IntArray


@dataclass(frozen=True, slots=True)
class LoopMatches:
    """The features that agree with a loop: what the keyframe and the frame show of the same points."""

    z_keyframe: FloatArray  # (P, 4) rectified pixels [ul vl ur vr] in the keyframe
    z_frame: FloatArray  # (P, 4) likewise in the frame that shows the place again
    has_right_keyframe: BoolArray  # (P,)
    has_right_frame: BoolArray  # (P,)

    def __len__(self) -> int:
        return len(self.z_frame)


@dataclass(frozen=True, slots=True)
class LoopEvent:
    """A place of the map seen again."""

    frame: int  # number of the frame that shows it
    time_ns: int
    keyframe: int  # number in the map of the keyframe that showed it before
    keyframe_time_ns: int
    inliers: int  # corners of the frame that agree, with this keyframe or with those around it
    gap_m: float  # by which the loop moved the position of the frame, before the optimisation
    joined: bool  # whether it is the first link between two sessions
    keyframe_frame: int | None = None  # number of the keyframe's frame in this run; None: an earlier session's
    kept: bool = True  # at the end of a run: whether it agrees with the other loops; those that do not move nothing
    matches: LoopMatches | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class MapKeyframes:
    """The keyframes of a map that share a run's frame, at the end of the run."""

    keyframe: IntArray  # (K,) number in the map
    frame: IntArray  # (K,) number of the frame in its own recording
    time_ns: IntArray  # (K,)
    own: BoolArray  # (K,) whether it is of this run
    T_map_body: FloatArray  # (K, 4, 4) pose in the map of this run's body with its left camera at the keyframe's


def no_map_keyframes() -> MapKeyframes:
    """Return none, as of a run without a map."""
    none = np.zeros(0, dtype=np.int64)
    return MapKeyframes(none, none, none, np.zeros(0, dtype=np.bool_), np.zeros((0, 4, 4)))
