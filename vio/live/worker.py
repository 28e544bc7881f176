"""The thread that does the processing of live use: calls in the order of arrival, of which few
may be frames.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import queue
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, TypeAlias, TypeVar

from vio.errors import VioError
from vio.numerics.kinds import Capacity

Answer = TypeVar("Answer")
Drop: TypeAlias = Literal["oldest", "none", "block"]
DROPS: tuple[Drop, ...] = ("oldest", "none", "block")
# running: calls are made; failed: one ended the worker; closed: its owner did
WorkerState: TypeAlias = Literal["running", "failed", "closed"]


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


class ClosedError(VioError):
    """The odometry was closed."""

    def __init__(self) -> None:
        super().__init__("this odometry is closed; build a new one")


class EventQueue:
    """Calls from any thread to one worker. Samples always find room; of frames, only so many wait.

    Samples are put without a lock, which a worker could hold when the computer halts it.
    """

    def __init__(self, most_frames: int, drop: Drop) -> None:
        """Create an empty queue.

        Args:
            most_frames: that wait.
            drop: what a frame too many does: "oldest" takes the place of the one that has waited
                longest, "none" waits behind all others, "block" makes `put` wait for room.
        """
        self._most = most_frames
        self._drop = drop
        self._calls: queue.SimpleQueue[QueuedCall | None] = queue.SimpleQueue()  # None: the end
        self._frames: deque[QueuedCall] = deque()  # those of the calls that bring frames
        self._changed = threading.Condition()
        self._closed = self._discards = False

    def put(self, call: QueuedCall, *, may_wait: bool = True) -> bool:
        """Add a call; False: another frame, which waited longer, was left out for it.

        `may_wait` is false for the worker itself, as nobody else makes room.

        Raises:
            ClosedError: the queue is closed.
        """
        if not call.frame and call.answer is None:
            self._add(call)
            return True
        with self._changed:
            fits = not call.frame or self._queue(call, may_wait)
            self._add(call)
            return fits

    def _queue(self, call: QueuedCall, may_wait: bool) -> bool:
        """Add a frame to those that wait, once there is room, or for the oldest of them; False:
        that one is left out.
        """
        waits = self._drop == "block" and may_wait
        while waits and len(self._frames) >= self._most and not self._closed:
            self._changed.wait()
        if self._closed:
            return True
        fits = self._drop != "oldest" or len(self._frames) < self._most
        if not fits:
            self._frames.popleft().make = None
        self._frames.append(call)
        return fits

    def _add(self, call: QueuedCall) -> None:
        if self._closed:
            raise ClosedError
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
            self._closed = True
            self._discards = self._discards or discard
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

    @property
    def is_closed(self) -> bool:
        """Whether no call can be added any more."""
        return self._closed


class Worker:
    """Makes calls in a thread of its own, and is running, failed or closed.

    What a call raises ends it, of whatever class; all later calls raise it, too. Every method
    answers by the state: none waits for a thread that has ended.
    """

    def __init__(
        self,
        most_frames: int,
        drop: Drop,
        *,
        finish: Callable[[], object],
        close: Callable[[], object],
    ) -> None:
        """Start the thread; `most_frames` and `drop` are those of `EventQueue`.

        `finish` is called after the last call, unless the worker failed or was asked to forget what
        waits; `close` last, in any case.
        """
        self._queue = EventQueue(most_frames, drop)
        self._finish = finish
        self._close = close
        self._failure: Exception | None = None
        self._failed_at: TracebackType | None = None
        self._forgets = False
        self._thread = threading.Thread(target=self._run, name="vio", daemon=True)
        self._thread.start()
        atexit.register(self._at_exit)

    @property
    def frames(self) -> int:
        """Number of frames that wait."""
        return self._queue.frames

    @property
    def state(self) -> WorkerState:
        """What the worker does; once it is not running, it will never be again."""
        if self._failure is not None:
            return "failed"
        return "closed" if self._queue.is_closed else "running"

    @property
    def failure(self) -> Exception | None:
        """What the worker failed with; None: it has not."""
        return self._failure

    def put(self, make: Callable[[], object], *, frame: bool = False) -> bool:
        """Add a call; False: a frame that waited was left out for it.

        Raises:
            Exception: what the worker failed with.
            ClosedError: it was closed.
            VioError: this process is a fork of the one that made it.
        """
        self._check_usable()
        own_thread = threading.current_thread() is self._thread
        try:
            return self._queue.put(QueuedCall(make, frame), may_wait=not own_thread)
        except ClosedError:
            self.raise_failure()  # which closed the queue meanwhile
            raise

    def ask(self, function: Callable[[], Answer]) -> Answer:
        """Call a function in the thread, after all calls so far, and return or raise what it
        does.

        Raises:
            Exception: what the worker failed with, also meanwhile.
            ClosedError: it was closed, or was told meanwhile to forget what waits.
        """
        if threading.current_thread() is self._thread:
            return function()
        self._check_usable()
        answer: Future[Answer] = Future()

        def make() -> None:
            try:
                answer.set_result(function())
            except BaseException as error:  # noqa: BLE001 # raised in the caller's thread
                answer.set_exception(error)

        try:
            self._queue.put(QueuedCall(make, answer=answer))
            return answer.result()
        except (ClosedError, CancelledError) as error:
            self.raise_failure()
            raise ClosedError from error

    def fail(self, error: BaseException) -> None:
        """End the worker with an error; what waits is forgotten.

        What would end a program or a thread without a word, as SystemExit, is named by a VioError:
        it is raised in threads of others.
        """
        if self._failure is None:
            failure = error if isinstance(error, Exception) else _named(error)
            self._failed_at = failure.__traceback__
            self._failure = failure
        self._queue.close(discard=True)

    def raise_failure(self) -> None:
        """Raise what the worker failed with, if it did."""
        if self._failure is not None:
            # else each raise would add to its traceback, for a driver that tries again and again
            raise self._failure.with_traceback(self._failed_at)

    def _check_usable(self) -> None:
        """Raise what the worker failed with, and in a forked process, which has no such thread."""
        self.raise_failure()
        if not self._thread.is_alive() and not self._queue.is_closed:
            raise VioError(
                "this odometry's thread runs in the process that made it, of which this one is a "
                "fork; build a new one here"
            )

    def end(self, *, discard: bool) -> None:
        """Make the calls that wait, or forget them, and end the thread."""
        self._forgets = self._forgets or discard
        self._queue.close(discard=discard)
        if threading.current_thread() is not self._thread:
            self._thread.join()
        atexit.unregister(self._at_exit)

    def _at_exit(self) -> None:
        """Without a call of `end`, the program's end must not find the thread at work."""
        self.end(discard=True)

    def _run(self) -> None:
        try:
            while (make := self._queue.take()) is not None:
                make()
            if self._failure is None and not self._forgets:
                self._finish()
        except BaseException as error:  # noqa: BLE001 # raised by the next call
            self.fail(error)
        try:
            self._close()
        except BaseException as error:  # noqa: BLE001 # likewise
            self.fail(error)


def _named(error: BaseException) -> VioError:
    """Return an error that says which exception, that is no error, ended the worker."""
    named = VioError(f"{type(error).__name__} {error} ended this odometry; build a new one")
    named.__cause__ = error
    return named


# Objects more than before until the young ones are searched. Frames make no cycles, so that few are
# ever found, and what lives in a run is some ten thousand objects, through which a search takes a
# few milliseconds.
_YOUNG: Capacity[int] = 20_000


class QuietCollector:
    """Keeps what is loaded out of Python's searches for reference cycles: one through all modules
    takes 50 to 100 ms.

    The collector belongs to the process: the first user sets it up, and the last one restores it.
    """

    _users = 0
    _before = (0, 0, 0)
    _lock = threading.Lock()

    def __init__(self) -> None:
        self._holds = False

    def hold(self) -> None:
        """Search a last time, and then through newer objects only; calling it again adds what
        has come since.
        """
        gc.collect()
        gc.freeze()
        if not self._holds:
            with self._lock:
                if QuietCollector._users == 0:
                    QuietCollector._before = gc.get_threshold()
                    gc.set_threshold(_YOUNG, *QuietCollector._before[1:])
                QuietCollector._users += 1
                self._holds = True

    def renew(self) -> None:
        """Search everything once more, as after a reset: what was held before and is no longer
        used has cycles, which would stay for ever.
        """
        gc.unfreeze()
        if self._holds:
            self.hold()

    def release(self) -> None:
        """Let the collector do as before."""
        if not self._holds:
            return
        with self._lock:
            self._holds = False
            QuietCollector._users -= 1
            if QuietCollector._users == 0:
                gc.set_threshold(*QuietCollector._before)
                gc.unfreeze()
