"""A live source that films a board: guidance while it is recorded, for its calibration."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

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
        searcher = stack.enter_context(ThreadPoolExecutor(1))
        recorder: Recorder | None = None
        search: Future[bool] | None = None
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
                continue
            if search is None:
                images = (event.left,) if event.right is None else (event.left, event.right)
                search = searcher.submit(guidance.add_images, images)
            if not every_frame and not search.done():
                continue
            search.result()
            search = None
            lacks = guidance.lacks()
            if str(lacks) != said:
                said = str(lacks)
                say(said)
            if not lacks.wanted:
                break
    return guidance.lacks()
