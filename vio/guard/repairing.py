"""A recording whose right images belong to the left images of other frames, paired anew."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from vio.records import Event, Image, StereoFrame


def repaired(events: Iterable[Event], delay: int) -> Iterator[Event]:
    """Yield events with the images of each pair those of one time.

    No image comes before its exposure: where right images are early, the left ones are late, and
    take the stamps of the frames that the right ones came with. Of two frames in a row, the image
    that is late is taken from the second; the last frame is left out.

    Args:
        events: as the recording gives them, in time order.
        delay: frames by which right images are late: 1, 0, or -1 for early ones.
    """
    return iter(events) if delay == 0 else _paired(events, right_is_late=delay > 0)


def _paired(events: Iterable[Event], *, right_is_late: bool) -> Iterator[Event]:
    held: StereoFrame | None = None
    behind: list[Event] = []  # events after the frame that waits
    for event in events:
        if not isinstance(event, StereoFrame):
            behind.append(event)
            continue
        if held is not None and right_is_late:
            yield replace(held, right=event.right)
        elif held is not None:
            yield replace(held, left=event.left)
        yield from behind
        behind = []
        held = replace(event, left=_copied(event.left), right=_copied(event.right))
    yield from behind


def _copied(image: Image | None) -> Image | None:
    """A copy, as a reader may reuse its buffer."""
    return None if image is None else image.copy()
