"""What waits for the worker of live use: calls in the order of their arrival, of which few may be frames."""

from __future__ import annotations

import contextlib
import queue
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

    def cancel(self) -> None:
        """Tell who waits for an answer that the call is never made."""
        if self.answer is not None:
            self.answer.cancel()


class EventQueue:
    """Calls from any thread to one worker. Samples always find room; of frames, only so many wait.

    Samples are put without a lock, which a worker could hold when the computer halts it.
    """

    def __init__(self, most_frames: int, drop: Drop) -> None:
        """Create an empty queue, in which `most_frames` wait.

        One too many takes the place of the one that has waited longest ("oldest"), waits behind all others ("none"), or
        makes `put` wait for room ("block").
        """
        self._most, self._drop = most_frames, drop
        self._calls: queue.SimpleQueue[QueuedCall | None] = queue.SimpleQueue()  # None: the end
        self._frames: deque[QueuedCall] = deque()  # those of the calls that bring frames
        self._changed = threading.Condition()
        self._closed = self._discards = False

    def put(self, call: QueuedCall) -> bool:
        """Add a call; False: another frame, which waited longer, was left out for it.

        Raises:
            VioError: the queue is closed.
        """
        if not call.frame and call.answer is None:
            self._add(call)
            return True
        with self._changed:
            fits = True
            while call.frame and self._drop == "block" and len(self._frames) >= self._most and not self._closed:
                self._changed.wait()
            if call.frame and not self._closed:
                if self._drop == "oldest" and len(self._frames) >= self._most:
                    self._frames.popleft().make, fits = None, False
                self._frames.append(call)
            self._add(call)
            return fits

    def _add(self, call: QueuedCall) -> None:
        if self._closed:
            raise VioError("this odometry is closed; build a new one")
        self._calls.put(call)

    def take(self) -> Callable[[], object] | None:
        """Wait for the oldest call and return it; None: the queue is closed, and nothing waits."""
        while (call := self._calls.get()) is not None:
            with self._changed if call.frame or call.answer else contextlib.nullcontext():
                if self._discards:
                    call.cancel()
                    continue
                if call.make is None:
                    continue
                if call.frame:
                    self._frames.popleft()
                    self._changed.notify_all()
            return call.make
        return None

    def close(self, *, discard: bool) -> None:
        """Let `take` end once nothing waits; with `discard`, what waits is forgotten."""
        with self._changed:
            self._closed, self._discards = True, self._discards or discard
            while discard:
                try:
                    call = self._calls.get_nowait()
                except queue.Empty:
                    break
                if call is not None:
                    call.cancel()
            if discard:
                self._frames.clear()
            self._calls.put(None)
            self._changed.notify_all()

    @property
    def frames(self) -> int:
        """Number of frames that wait."""
        return len(self._frames)
