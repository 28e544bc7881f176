"""What keeps the results of a live odometry: the worker gives it everything that a file's run
keeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from vio.live.odometry import Odometry
from vio.records import FrameResult, Landmarks, MotionSample


class LiveSink(Protocol):
    """Takes the results of a live odometry; it raises nothing, and waits for no disk.

    All but `given` are called by the worker, in the order of the frames.
    """

    def given(self, index: int, time_ns: int) -> None:
        """Note the number and the time of a frame that was added, whether or not it is processed;
        called in the thread that adds.
        """

    def samples(self, samples: Sequence[MotionSample]) -> None:
        """Take motion samples."""

    def frame(self, result: FrameResult, odometry: Odometry) -> None:
        """Take the result of a frame."""

    def corrections(self, odometry: Odometry) -> None:
        """Take what has changed of earlier frames, with `Odometry.take_corrections`."""

    def points(self, points: Landmarks) -> None:
        """Take points of the map that will not change any more."""

    def end(self, odometry: Odometry, *, failure: str | None, is_last: bool) -> None:
        """End a trajectory, before the odometry forgets it.

        `failure` says what the odometry ended with; `is_last`: no other trajectory follows.
        """
