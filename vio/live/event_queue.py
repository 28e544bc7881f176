"""What waits for the worker of live use: calls in the order of their arrival, of which few may be frames."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from vio.errors import VioError

Drop: TypeAlias = Literal["oldest", "none", "block"]
DROPS: tuple[Drop, ...] = ("oldest", "none", "block")


@dataclass(slots=True, eq=False)
class QueuedCall:
    """A call that the worker is to make."""

    make: Callable[[], object] | None  # None: it was left out
    frame: bool = False  # whether it brings a frame
    answer: Future[Any] | None = None  # cancelled where the call is never made


class EventQueue:
    """Calls from any thread to one worker. Samples always find room; of frames, only so many wait.

    The lock is held for a few instructions at a time, so `put` does not wait for the worker's work.
    """

    def __init__(self, most_frames: int, drop: Drop) -> None:
        """Create an empty queue.

        Args:
            most_frames: that wait.
            drop: what a frame too many does: "oldest" takes the place of the one that has waited longest, "none" waits
                behind all others, "block" makes `put` wait for room.
        """
        self._most, self._drop = most_frames, drop
        self._calls: deque[QueuedCall] = deque()
        self._frames: deque[QueuedCall] = deque()  # those of the calls that bring frames
        self._changed = threading.Condition()
        self._closed = False

    def put(self, call: QueuedCall) -> bool:
        """Add a call; False: another frame, which waited longer, was left out for it.

        Raises:
            VioError: the queue is closed.
        """
        with self._changed:
            fits = True
            while call.frame and self._drop == "block" and len(self._frames) >= self._most and not self._closed:
                self._changed.wait()
            if self._closed:
                raise VioError("this odometry is closed; build a new one")
            if call.frame:
                if self._drop == "oldest" and len(self._frames) >= self._most:
                    self._frames.popleft().make, fits = None, False
                self._frames.append(call)
            self._calls.append(call)
            self._changed.notify_all()
            return fits

    def take(self) -> Callable[[], object] | None:
        """Wait for the oldest call and return it; None: the queue is closed, and nothing waits."""
        with self._changed:
            while True:
                while self._calls:
                    call = self._calls.popleft()
                    if call.make is not None:
                        if call.frame:
                            self._frames.popleft()
                            self._changed.notify_all()
                        return call.make
                if self._closed:
                    return None
                self._changed.wait()

    def close(self, *, discard: bool) -> None:
        """Let `take` end once nothing waits; with `discard`, what waits is forgotten."""
        with self._changed:
            self._closed = True
            if discard:
                for call in self._calls:
                    if call.answer is not None:
                        call.answer.cancel()
                self._calls.clear()
                self._frames.clear()
            self._changed.notify_all()

    @property
    def frames(self) -> int:
        """Number of frames that wait."""
        return len(self._frames)
