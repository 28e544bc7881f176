"""A recording whose right images belong to the left images of other frames, paired anew."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace

from vio.records import Event, Image, StereoFrame


def repaired(events: Iterable[Event], delay: int) -> Iterator[Event]:
    """Yield events with the images of each pair those of one time.

    No image comes before its exposure: where right images are early, the left ones are late, and
    take the stamps of the frames that the right ones came with. The image that is late is taken from
    a later frame; the last frames are left out.

    Args:
        events: as the recording gives them, in time order.
        delay: frames by which right images are late; negative for early ones.
    """
    return iter(events) if delay == 0 else _paired(events, abs(delay), right_is_late=delay > 0)


def late_text(delay: int) -> str:
    """Say which images of a recording are late and by how many frames, `delay` as of `repaired`."""
    late, other = ("right", "left") if delay > 0 else ("left", "right")
    frames = "a frame" if abs(delay) == 1 else f"{abs(delay)} frames"
    return (
        f"each {late} image comes {frames} later than the {other} one of its time, by the rows that "
        "match"
    )


def _paired(events: Iterable[Event], frames: int, *, right_is_late: bool) -> Iterator[Event]:
    held = deque[Event]()  # from the frame on that waits
    waiting = 0  # frames among them
    for event in events:
        if not isinstance(event, StereoFrame):
            held.append(event)
            continue
        if waiting == frames:
            first = held.popleft()
            while not isinstance(first, StereoFrame):
                yield first
                first = held.popleft()
            yield (
                replace(first, right=event.right)
                if right_is_late
                else replace(first, left=event.left)
            )
            waiting -= 1
        held.append(replace(event, left=_copied(event.left), right=_copied(event.right)))
        waiting += 1
    yield from (event for event in held if not isinstance(event, StereoFrame))


def _copied(image: Image | None) -> Image | None:
    """A copy, as a reader may reuse its buffer."""
    return None if image is None else image.copy()
