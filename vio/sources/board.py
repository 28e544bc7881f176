"""A live source that films a board: guidance while it is recorded, for its calibration."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from vio.records import Image
from vio.sources.recorder import Form, Recorded, Recorder
from vio.sources.source import LiveSource, SourceFrame
from vio.targets.description import Target
from vio.targets.guidance import Guidance, Lacks


def film_board(
    source: LiveSource,
    target: Target,
    *,
    should_stop: Callable[[], object],
    say: Callable[[str], None],
    record: Path | None = None,
    record_as: Form = "plain",
    every_frame: bool = False,
) -> Lacks:
    """Record a board until nothing is missing, the source ends, or it is asked to stop.

    Args:
        source: opened; it is closed at the end.
        target: the board.
        should_stop: asked with each event, and about each second.
        say: reports what is missing whenever that changes.
        record: new folder for what the source gives.
        record_as: its form, see `Recorder`.
        every_frame: wait for the search in each frame; otherwise frames that come meanwhile are
            recorded and not searched.

    Raises:
        VioError: source or disk have failed.
    """
    guidance = Guidance(target)
    said = ""
    with contextlib.closing(source), contextlib.ExitStack() as stack:
        search = _Search(guidance, stack.enter_context(ThreadPoolExecutor(1)), wait=every_frame)
        recorder: Recorder | None = None
        for event in source.events():
            if should_stop():
                break
            if event is None:
                continue
            if record is not None and recorder is None and isinstance(event, SourceFrame):
                shape = Recorded(pair=event.right is not None, imu=source.has_imu)
                recorder = Recorder(record, source.rig, record_as, shape)
                stack.callback(recorder.close)
            if recorder is not None:
                recorder.add(event)
            if not isinstance(event, SourceFrame):
                guidance.add_sample(event)
            elif search.take(event):
                lacks = guidance.lacks()
                if str(lacks) != said:
                    said = str(lacks)
                    say(said)
                if not lacks.wanted:
                    break
    return guidance.lacks()


class _Search:
    """The search for the board in one frame at a time, in a thread."""

    def __init__(self, guidance: Guidance, thread: ThreadPoolExecutor, *, wait: bool) -> None:
        self._guidance = guidance
        self._thread = thread
        self._wait = wait
        self._running: Future[bool] | None = None

    def take(self, frame: SourceFrame) -> bool:
        """Begin with a frame where none is searched; return whether a search has ended."""
        if self._running is None:
            images: tuple[Image, ...] = (frame.left,)
            if frame.right is not None:
                images = (frame.left, frame.right)
            self._running = self._thread.submit(self._guidance.add_images, images)
        if not self._wait and not self._running.done():
            return False
        self._running.result()
        self._running = None
        return True
