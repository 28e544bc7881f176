"""What tells an exposure from any other one, and whether one comes again."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from hashlib import blake2b

from vio.numerics.kinds import Capacity
from vio.records import Image

_FRAMES: Capacity[int] = 16  # that are remembered, as many as a ring of buffers may have


def exposure_digest(images: Sequence[Image]) -> bytes:
    """Return what tells images (H, W) from those of any other exposure, whose noise differs; empty
    where each has one gray value, as exposures of darkness have.
    """
    if not any((image != image[:1, :1]).any() for image in images):
        return b""
    digest = blake2b(digest_size=16)
    for image in images:
        digest.update(image.tobytes())
    return digest.digest()


class EarlierExposures:
    """The exposures of some frames ago, which a ring of buffers that is read at the wrong place
    gives again.
    """

    def __init__(self) -> None:
        self._ring = deque[tuple[int, bytes]](maxlen=_FRAMES)

    def add(self, index: int, digest: bytes) -> None:
        """Take the newest exposure, of a frame of that number."""
        self._ring.append((index, digest))

    def find(self, digest: bytes) -> int | None:
        """Return the number of the frame before the newest one that has a digest; None: there is
        none, or nothing tells it from others.
        """
        if not digest:
            return None
        earlier = list(self._ring)[:-1]
        return next((index for index, shown in earlier if shown == digest), None)
