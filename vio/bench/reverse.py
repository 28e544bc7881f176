"""A recording played backward: the same images, of which an estimate must say the same."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vio.protocols import Dataset
from vio.records import Event, IntArray, Observations, Recording, StereoFrame, Trajectory


@dataclass(frozen=True)
class Reversed:
    """Frames of a recording in reverse order; motion samples are left out."""

    source: Dataset
    first: int  # of its frames: the last one here
    end: int  # the one after the last

    @cached_property
    def recording(self) -> Recording:
        """That of the source, with times that go on as long as they went."""
        whole = self.source.recording
        reference = None
        if whole.reference is not None:
            reference = self.backward(whole.reference)
        return replace(
            whole,
            frame_times_ns=self._mirrored(whole.frame_times_ns[self.first : self.end]),
            reference=reference,
            motion=frozenset(),
        )

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        """Yield frames in reverse order, each read by itself."""
        count = self.end - self.first
        times_ns = self.recording.frame_times_ns
        for index in range(start, count if stop is None else min(stop, count)):
            k = self._source_index(index)
            for event in self.source.events(k, k + 1, images=images):
                if isinstance(event, StereoFrame):
                    yield replace(event, index=index, time_ns=int(times_ns[index]))

    def observations(self, index: int) -> Observations | None:
        """Return the features of one frame."""
        seen = self.source.observations(self._source_index(index))
        if seen is None:
            return None
        time_ns = int(self.recording.frame_times_ns[index])
        return replace(seen, frame_index=index, time_ns=time_ns)

    def backward(self, reference: Trajectory) -> Trajectory:
        """Return a trajectory of the source in reverse order, numbered as the frames are here."""
        numbered = reference.numbered()
        times_ns = numbered.times_ns
        frames = numbered.frame_indices
        rows = np.arange(len(numbered))[::-1]
        if frames is not None:
            rows = rows[(frames[rows] >= self.first) & (frames[rows] < self.end)]
        return replace(
            numbered,
            T_world_body=numbered.T_world_body[rows],
            times_ns=None if times_ns is None else self._sum_ns - times_ns[rows],
            frame_indices=None if frames is None else self.end - 1 - frames[rows],
        )

    def _source_index(self, index: int) -> int:
        return self.end - 1 - index

    @property
    def _sum_ns(self) -> int:
        """Time of a moment here and in the source, together."""
        times_ns = self.source.recording.frame_times_ns
        return int(times_ns[self.first]) + int(times_ns[self.end - 1])

    def _mirrored(self, times_ns: IntArray) -> IntArray:
        return np.asarray(self._sum_ns - times_ns[::-1], dtype=np.int64)
