"""The record of a loop, which live callers get."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LoopEvent:
    """A place of the map seen again."""

    frame: int  # number of the frame that shows it
    time_ns: int
    keyframe: int  # number in the map of the keyframe that showed it before
    keyframe_time_ns: int
    inliers: int
    gap_m: float  # by which the loop moved the position of the frame, before the optimisation
    joined: bool  # whether it is the first link between two sessions
