"""A recording whose right images belong to the left images of other frames, paired anew."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from vio.records import Event, Image, StereoFrame


def repaired(events: Iterable[Event], delay: int) -> Iterator[Event]:
    """Yield events with each left image paired with the right one of its own time.

    Frames without such a right image, at one end of the recording, are left out.

    Args:
        events: as the recording gives them, in time order.
        delay: frames by which right images are late: 1, 0, or -1 for early ones.
    """
    if delay == 0:
        return iter(events)
    return _late(events) if delay > 0 else _early(events)


def _late(events: Iterable[Event]) -> Iterator[Event]:
    """Each left image waits for the right one of the next frame."""
    held: StereoFrame | None = None
    behind: list[Event] = []  # events after the frame that waits
    for event in events:
        if not isinstance(event, StereoFrame):
            behind.append(event)
            continue
        if held is not None:
            yield replace(held, right=event.right)
        yield from behind
        behind = []
        held = replace(event, left=_copied(event.left))


def _early(events: Iterable[Event]) -> Iterator[Event]:
    """Each right image waits for the left one of the next frame."""
    right: Image | None = None
    for event in events:
        if not isinstance(event, StereoFrame):
            yield event
            continue
        before = right
        right = _copied(event.right)
        if before is not None:
            yield replace(event, right=before)


def _copied(image: Image | None) -> Image | None:
    """A copy, as a reader may reuse its buffer."""
    return None if image is None else image.copy()
