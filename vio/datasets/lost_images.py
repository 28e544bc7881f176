"""Which images belong together where each camera numbers its own, and one of them lost some.

Numbers that begin alike, have no hole and do not end alike are of a camera that stopped earlier, that
began later, or that lost images and numbered on: from then on, images of one number are apart. The
rows of the images tell which, by `vio.guard.pairing`, as long as the rig moves.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.datasets.image_files import FilePairs, ImageFiles
from vio.datasets.image_pairs import ImageDataset
from vio.errors import DataError
from vio.records import StereoFrame


class _WindowRules(NamedTuple):
    """Which frames are looked at."""

    frames: int = 8  # in a row that tell by how many frames images are apart
    tried: int = 6  # windows from an end inwards, as the rig may stand still there


_WINDOW = _WindowRules()


class CountedApart(NamedTuple):
    """All image files of two cameras whose numbers are alike, but not how many there are."""

    left: ImageFiles
    right: ImageFiles

    @property
    def more(self) -> int:
        """Right images more than left ones."""
        return len(self.right) - len(self.left)


class _Step(NamedTuple):
    """Left images from one to before another, and by how much the numbers of their right ones are
    higher.
    """

    first: int
    end: int
    offset: int


def pairs_in_step(dataset: ImageDataset, files: CountedApart) -> tuple[FilePairs, str] | None:
    """Return the pairs by the rows that match, and a note; None: those of equal numbers are right, or
    the images do not tell.

    Args:
        dataset: the pairs of equal numbers.
        files: all images.
    """
    steps = _Search(dataset, files).steps()
    if steps is None or {step.offset for step in steps} == {0}:
        return None
    rows = _rows(steps, files)
    pairs = FilePairs(
        files.left.take(left for left, _ in rows), files.right.take(right for _, right in rows)
    )
    return pairs, _note(steps, files)


def _rows(steps: list[_Step], files: CountedApart) -> list[tuple[int, int]]:
    """Return the left and the right image of each pair, without those around a loss."""
    rows = []
    for number, step in enumerate(steps):
        before = steps[max(number - 1, 0)]
        after = steps[min(number + 1, len(steps) - 1)]
        first = step.first + abs(step.offset - before.offset)
        end = step.end - abs(after.offset - step.offset)
        rows += [(k, k + step.offset) for k in range(first, end)]
    return [(left, right) for left, right in rows if 0 <= right < len(files.right)]


def _note(steps: list[_Step], files: CountedApart) -> str:
    """Say what was found, and where."""
    firsts = [max(step.first, -step.offset) for step in steps]
    said = " and ".join(
        f"from {files.left.names[first]} with {files.right.names[first + step.offset]} on"
        for first, step in zip(firsts, steps, strict=True)
    )
    return (
        f"{files.left.folder} and {files.right.folder} hold {len(files.left)} and "
        f"{len(files.right)} images, numbered without a hole, as cameras do that number their own; by "
        f"the rows that match, they are paired {said}; give both images of a pair one number"
    )


class _Search:
    """Looks for the offsets of some left images."""

    def __init__(self, dataset: ImageDataset, files: CountedApart) -> None:
        self._dataset = dataset
        self._files = files

    def steps(self) -> list[_Step] | None:
        """Return all offsets; None: the images do not tell them.

        Images at an end that do not tell are left out, unless no number is off there.
        """
        left, right = self._files
        early = max(-self._files.more, 0)  # left images that may come before the first right one
        late = min(len(left), len(right)) - _WINDOW.frames
        strides = range(0, _WINDOW.tried * _WINDOW.frames, _WINDOW.frames)
        first = self._first_told(early + k for k in strides)
        last = self._first_told(late - k for k in strides)
        if first is None or last is None or last.first < first.first:
            return None
        steps = self._between(first, last)
        if first.first == early or first.offset == 0:
            steps[0] = steps[0]._replace(first=0)
        if last.first == late or last.offset == self._files.more:
            steps[-1] = steps[-1]._replace(end=len(left))
        return steps

    def _between(self, first: _Step, last: _Step) -> list[_Step]:
        """Return all offsets from a window to a later one, without images that do not tell."""
        if first.offset == last.offset:
            return [first._replace(end=last.end)]
        if last.first <= first.end + _WINDOW.frames:
            change = self._change(first, last)
            return [first._replace(end=change), last._replace(first=change)]
        middle = (first.first + last.first) // 2
        reach = range(0, (last.first - first.first) // 2, _WINDOW.frames)
        found = self._first_told(k for step in reach for k in (middle + step, middle - step))
        if found is None or not first.first < found.first < last.first:
            return [first, last]
        before = self._between(first, found)
        after = self._between(found, last)
        joined = before[-1]._replace(end=after[0].end)
        return [*before[:-1], joined, *after[1:]]

    def _first_told(self, windows: Iterable[int]) -> _Step | None:
        for first in windows:
            if first >= 0 and (offset := self._offset(first)) is not None:
                return _Step(first, first + _WINDOW.frames, offset)
        return None

    def _offset(self, first: int) -> int | None:
        """Return the offset of the left images of a window; None: they do not tell."""
        from vio.guard.pairing import find_delay

        for guess in dict.fromkeys((0, self._files.more)):
            window = range(first, first + _WINDOW.frames)
            frames = self._frames([(k, k + guess) for k in window])
            delay = find_delay(frames, self._dataset.recording.camera)
            if delay is not None:
                return guess + delay
        return None

    def _change(self, first: _Step, last: _Step) -> int:
        """Return the left image that another offset begins with, by how many corners match at
        either one.
        """
        gains = [
            self._matched(k, k + first.offset) - self._matched(k, k + last.offset)
            for k in range(first.first, last.end)
        ]
        sums = np.concatenate([[0], np.cumsum(gains)])
        return first.first + int(np.argmax(sums))

    def _matched(self, left: int, right: int) -> int:
        """Count the corners of a left image that match on their rows of a right one."""
        from vio.guard.image_check import images_of
        from vio.guard.probe import RowProbe

        probe = RowProbe()
        for frame in self._frames([(left, right)]):
            images = images_of(frame, pair=True)
            if images is not None:
                left_half, right_half = images.halves
                return probe.on_rows(left_half, right_half, probe.corners(left_half))
        return 0

    def _frames(self, rows: list[tuple[int, int]]) -> list[StereoFrame]:
        """Return frames of left and right images, as far as there are any."""
        left, right = self._files
        known = [(a, b) for a, b in rows if 0 <= a < len(left) and 0 <= b < len(right)]
        pairs = FilePairs(left.take(a for a, _ in known), right.take(b for _, b in known))
        with contextlib.suppress(DataError):
            return list(replace(self._dataset, pairs=pairs).frames(range(len(known))))
        return []
