"""What the chain made of one frame: what viewers, callbacks and the run's folder get."""

from __future__ import annotations

from dataclasses import dataclass, field

from vio.loops import LoopEvent
from vio.records import Estimate, FrontendOutput, Selection, StereoFrame, UpdateReport

STAGES = ("read", "frontend", "watch", "select", "filter")  # of a frame's wall time


@dataclass(frozen=True, slots=True)
class FrameLog:
    """What happened in one frame: one row of frames.csv."""

    index: int
    time_ns: int
    read_ms: float
    frontend_ms: float
    watch_ms: float
    select_ms: float
    filter_ms: float
    detected: int
    tracked: int
    matched: int
    selected: int
    stale: int
    used: int
    gated: int
    landmarks: int
    innovation_median_px: float | None
    nis_per_dof: float | None
    stages_ms: dict[str, float] = field(default_factory=dict)  # the front end's own stages

    @property
    def total_ms(self) -> float:
        """Wall time of the whole frame."""
        return sum(getattr(self, f"{stage}_ms") for stage in STAGES)


@dataclass(frozen=True, slots=True)
class FrameResult:
    """All that the chain made of one frame."""

    frame: StereoFrame
    output: FrontendOutput
    selection: Selection
    report: UpdateReport
    estimate: Estimate
    log: FrameLog
    loops: tuple[LoopEvent, ...] = ()  # places of the map seen again, whose results have come with this frame
    is_keyframe: bool = False  # whether the frame becomes a keyframe of the map
