"""A recording of precomputed features: no images, observations and motion samples in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from vio.dataclass import dataclass
from vio.datasets.common import blank_frames, frame_range, merge_events
from vio.records import Event, FeatureTracks, IntArray, MotionSample, Observations, Recording


@dataclass(frozen=True, slots=True)
class FeatureDataset:
    """Implements `vio.protocols.Dataset` over feature tracks."""

    recording: Recording
    tracks: FeatureTracks
    motion: Sequence[MotionSample]  # in time order
    present: IntArray  # (P,) numbers of the frames that events may yield, increasing

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        """Yield events of the frames `start <= index < stop` in time order, without images.

        Raises:
            DataError: the range holds no frame.
        """
        chosen = frame_range(self.recording, start, stop)
        low, high = np.searchsorted(self.present, [chosen.start, chosen.stop])
        frames = blank_frames(self.recording, self.present[low:high].tolist())
        return merge_events(self.recording, chosen, self.motion, frames)

    def observations(self, index: int) -> Observations | None:
        """Return the features of one frame; none for a frame that events omit."""
        chosen = frame_range(self.recording, index, index + 1)
        return self.tracks.at(chosen.start, int(self.recording.frame_times_ns[chosen.start]))
