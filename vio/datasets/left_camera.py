"""A stereo recording as one of its left camera alone: images and features without what the right
camera shows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from vio.errors import DataError
from vio.geometry.stereo import left_alone
from vio.protocols import Dataset
from vio.records import Event, Observations, Recording, StereoFrame


@dataclass(frozen=True, slots=True)
class LeftCameraDataset:
    """Implements `vio.protocols.Dataset` over the left camera of another recording."""

    pair: Dataset  # the stereo recording
    recording: Recording

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        """Yield the events of the stereo recording, frames without their right image."""
        for event in self.pair.events(start, stop, images=images):
            yield replace(event, right=None) if isinstance(event, StereoFrame) else event

    def observations(self, index: int) -> Observations | None:
        """Return the precomputed features of one frame without their right pixels.

        None: images only.
        """
        seen = self.pair.observations(index)
        return (
            None if seen is None else replace(seen, has_right=np.zeros(len(seen), dtype=np.bool_))
        )


def left_camera(dataset: Dataset) -> Dataset:
    """Return the recording of the left camera alone; images stay rectified as those of the pair
    are.

    One camera alone stays what it is, with a note.

    Raises:
        DataError: the recording has one camera with depth images.
    """
    recording = dataset.recording
    if recording.camera.kind == "mono":
        note = "there is one camera only: --camera left changes nothing"
        return LeftCameraDataset(dataset, replace(recording, notes=(*recording.notes, note)))
    if recording.camera.kind != "stereo":
        raise DataError(
            f"{recording.path}: --camera left takes one camera of two, but this has one; leave it "
            "out"
        )
    return LeftCameraDataset(dataset, replace(recording, camera=left_alone(recording.camera)))
