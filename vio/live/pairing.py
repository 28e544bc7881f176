"""Left and right images that were exposed together, as they come."""

from __future__ import annotations

from typing import Generic, TypeVar

from vio.datasets.frame_times import PAIRED_NS

T = TypeVar("T")

_MAX = 10  # images of one side that wait for the other's


class Pairing(Generic[T]):
    """Pairs two streams, each in order of time, by stamps that are equal or near."""

    def __init__(self) -> None:
        self._waiting: tuple[dict[int, T], dict[int, T]] = ({}, {})
        self.alone = 0  # images that found no partner

    def add(self, side: int, time_ns: int, image: T) -> tuple[int, T, T] | None:
        """Take an image of the left (0) or right (1) camera; return its pair with the left one's
        time, if complete.
        """
        own = self._waiting[side]
        others = self._waiting[1 - side]
        near = min(others, key=lambda t: abs(t - time_ns), default=None)
        if near is None or abs(near - time_ns) > PAIRED_NS:
            own[time_ns] = image
            if len(own) > _MAX:
                own.pop(next(iter(own)))
                self.alone += 1
            return None
        partner = others.pop(near)
        for waiting in (own, others):  # what is older waits in vain
            for t in [t for t in waiting if t < max(near, time_ns)]:
                waiting.pop(t)
                self.alone += 1
        if side == 0:
            return (time_ns, image, partner)
        return (near, partner, image)
