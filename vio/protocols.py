"""The four replaceable boxes: dataset, front end, selector, viewer (and the back end they feed)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Protocol, TypeAlias, runtime_checkable

from vio.records import (
    Estimate,
    Event,
    FrameResult,
    FrontendOutput,
    ImuDensities,
    Landmarks,
    MotionPrior,
    MotionSample,
    Observations,
    Prediction,
    Recording,
    Selection,
    StereoFrame,
    TrackPrior,
    UpdateReport,
)

if TYPE_CHECKING:
    from vio.cameras.rig import Rectifier

Progress: TypeAlias = Callable[[int, int], None]  # called after each frame: frames done, frames in all


class Dataset(Protocol):
    """A recording as events in time order."""

    @property
    def recording(self) -> Recording:
        """Calibration, times and ground truth, known without reading any frame."""

    def events(self, start: int = 0, stop: int | None = None, *, images: bool = True) -> Iterator[Event]:
        """Yield events of the frames `start <= index < stop` in time order.

        A motion sample with the time of a frame comes before it. Motion samples from the time of frame `start` (raw
        IMU: from a second before it) to the time of frame `stop - 1` (raw IMU: to the first sample at or after it) are
        included. With `images=False` frames carry
        None for both images.

        Raises:
            DataError: a file cannot be used; the message names it and the remedy.
        """

    def observations(self, index: int) -> Observations | None:
        """Return the precomputed features of one frame; None where the recording holds images only."""


@runtime_checkable
class RectifyingDataset(Protocol):
    """A recording of raw images, which it rectifies as it reads them."""

    @property
    def rectifier(self) -> Rectifier:
        """The rectification, with the raw cameras as calibrated."""

    @property
    def imu_noise(self) -> ImuDensities | None:
        """Noise densities of the IMU, where the calibration states them."""


class Frontend(Protocol):
    """Images in, tracked stereo observations out."""

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Track, match and detect in one frame; frames come in time order.

        Args:
            frame: a rectified pair, 8-bit gray, of the size that the camera states, for front ends that look at images.
            prior: predicted pixels by id and predicted rotation since the last frame, where the filter has them.

        Raises:
            DataError: the frame lacks what the front end needs, its images have a wrong size or type, its time is not
                after the last one's, or left and right look swapped.
        """


class Selector(Protocol):
    """Decides which observations enter the filter's update."""

    def select(self, observations: Observations, motion: MotionPrior | None = None) -> Selection:
        """Rank the observations of one frame; called once per frame, in time order.

        Args:
            observations: all that the front end saw in the frame.
            motion: what the back end expects of the motion since the last frame, where it can predict it.
        """


class Backend(Protocol):
    """An estimator fed with motion samples and observations in time order."""

    @property
    def stereo_only(self) -> bool:
        """Whether observations without a right match are of no use to it."""

    def propagate(self, sample: MotionSample) -> None:
        """Take one motion sample; samples come in time order."""

    def predict(self, time_ns: int) -> Prediction | None:
        """Predict a frame at a coming time, without changing anything; None where no prediction is possible."""

    def update(self, observations: Observations) -> UpdateReport:
        """Move to the time of the observations and take them in."""

    def estimate(self) -> Estimate:
        """Return the current estimate."""

    def smoothed(self, frame_index: int) -> Estimate | None:
        """Return the estimate at a past frame with all frames since taken into account; None where it is not kept."""

    def landmarks(self) -> Landmarks:
        """Return the current map, less what `take_landmarks` has returned."""

    def take_landmarks(self) -> Landmarks:
        """Return the points that will not change any more, and forget them."""


class Viewer(Protocol):
    """Watches a run; must not change it."""

    def frame(self, result: FrameResult) -> None:
        """Show one processed frame."""

    def close(self) -> None:
        """Release whatever the viewer holds."""
