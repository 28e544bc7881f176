"""The replaceable boxes: dataset, front end or its detector, selector, back end, viewer."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeAlias, runtime_checkable

from vio.errors import EstimationError
from vio.geometry.lie import FloatArray
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.imu.settings import ImuSettings
from vio.records import (
    CheckedFrame,
    Estimate,
    Event,
    FrameResult,
    FrontendOutput,
    Image,
    ImuDensities,
    Initialisation,
    Landmarks,
    MotionPrior,
    MotionSample,
    MotionSource,
    Observations,
    Prediction,
    Recording,
    RotationComparison,
    Selection,
    StereoFrame,
    TrackPrior,
    UpdateReport,
    no_landmarks,
)

if TYPE_CHECKING:
    from vio.cameras.rig import Rectifier

# called after each frame: frames done, frames in all
Progress: TypeAlias = Callable[[int, int], None]


class Dataset(Protocol):
    """A recording as events in time order."""

    @property
    def recording(self) -> Recording:
        """Calibration, times and ground truth, known without reading any frame."""

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        """Yield events of the frames `start <= index < stop` in time order.

        A motion sample with the time of a frame comes before it. Motion samples from the time of
        frame `start` (raw IMU: from a second before it) to the time of frame `stop - 1` (raw IMU:
        to the first sample at or after it) are included. With `images=False` frames carry
        None for both images.

        Raises:
            DataError: a file cannot be used; the message names it and the remedy.
        """

    def observations(self, index: int) -> Observations | None:
        """Return the precomputed features of one frame.

        None where the recording holds images only.
        """


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
            frame: a rectified pair, 8-bit gray, of the size that the camera states, for front ends
                that look at images.
            prior: predicted pixels by id and predicted rotation since the last frame, where the
                filter has them.

        Raises:
            DataError: the frame lacks what the front end needs, its images have a wrong size or
                type, its time is not after the last one's, or left and right look swapped.
        """


@runtime_checkable
class Detector(Protocol):
    """One image in, corners out; the front end `klt` tracks them and matches them in the right
    image.

    Wherever a front end of the caller's own is taken, a detector is taken too.
    """

    def detect(self, image: Image) -> FloatArray:
        """Return corners (K, 2) `[u v]` of an image, pixels, the best first.

        They may lie anywhere: those near tracked features, near the edge or too many in one place
        are not used. It is called in frames that lack features.

        Args:
            image: (H, W), left, rectified, 8-bit gray; it must not be changed.
        """


@runtime_checkable
class FollowsRight(Protocol):
    """A front end that goes on with the right images while the left camera is frozen."""

    def follow_right(self, frame: CheckedFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Return the features of the last good pair, followed in the right image of a frame."""


@runtime_checkable
class ChecksMatches(Protocol):
    """A front end that may check its right matches itself, so that `vio.guard` need not."""

    @property
    def checks_matches(self) -> bool:
        """Whether those of the last frame are checked."""


@runtime_checkable
class ChecksRepeats(Protocol):
    """A front end that may know which features repeat old pixels, so that `vio.guard` need not ask."""

    @property
    def checks_repeats(self) -> bool:
        """Whether it knows those of its features."""


@runtime_checkable
class ChecksObjects(Protocol):
    """A front end that tells objects that cover much of the image from the scene itself, so that
    `vio.guard` need not.
    """

    @property
    def checks_objects(self) -> bool:
        """Whether the features of the last frame are of the scene."""


class Selector(Protocol):
    """Decides which observations enter the filter's update."""

    def select(self, observations: Observations, motion: MotionPrior | None = None) -> Selection:
        """Rank the observations of one frame; called once per frame, in time order.

        Args:
            observations: all that the front end saw in the frame.
            motion: what the back end expects of the motion since the last frame, where it can
                predict it.
        """


class Backend(Protocol):
    """An estimator fed with motion samples and observations in time order.

    Back ends inherit from it: what has a body here is optional. A new one is a file and a line in
    `vio.filters.BACKENDS`.
    """

    # what it has a motion model for, the best first
    motion_sources: ClassVar[tuple[MotionSource, ...]] = ()
    # whether observations without a right match are of no use to it
    stereo_only: ClassVar[bool] = False

    @classmethod
    def build(
        cls,
        camera: StereoCamera,
        T_cam0_body: FloatArray,
        settings: Any,
        motion: MotionSource | None,
        imu: ImuSettings,
    ) -> Backend:
        """Build the back end of a run; without an implementation, by the constructor with these
        arguments but the last.

        Args:
            camera: the rectified camera or pair.
            T_cam0_body: (4, 4) extrinsics of the body that is estimated.
            settings: the configuration's section of the back end's name; None: it has none.
            motion: which motion samples will come; None: images alone.
            imu: the section `imu` of the configuration.

        Raises:
            ConfigError: it cannot estimate from this camera or motion with these settings.
        """
        constructor: Callable[..., Backend] = cls
        return constructor(camera, T_cam0_body, settings, motion)

    @abstractmethod
    def propagate(self, sample: MotionSample) -> None:
        """Take one motion sample; samples come in time order."""

    def propagate_all(self, samples: Sequence[MotionSample]) -> None:
        """Take motion samples as `propagate` takes them one by one: those before the next frame."""
        for sample in samples:
            self.propagate(sample)

    @abstractmethod
    def update(self, observations: Observations) -> UpdateReport:
        """Move to the time of the observations and take them in.

        Raises:
            DivergedError: the state is lost, and `restart` may be called with the same
                observations.
            EstimationError: the state is lost for good.
        """

    @abstractmethod
    def estimate(self) -> Estimate:
        """Return the current estimate."""

    @abstractmethod
    def landmarks(self) -> Landmarks:
        """Return the current map, less what `take_landmarks` has returned."""

    def predict(self, time_ns: int) -> Prediction | None:
        """Predict a frame at a coming time, without changing anything.

        None where no prediction is possible.
        """
        return None

    def take_landmarks(self) -> Landmarks:
        """Return the points that will not change any more, and forget them."""
        return no_landmarks()

    def restart(self, observations: Observations) -> UpdateReport:
        """Go on from the last plausible state after a divergence, with the frame that `update`
        failed at.

        Raises:
            EstimationError: there is no such state.
        """
        raise EstimationError(f"{type(self).__name__} cannot restart after a divergence")

    def begin_anew(self, good: Estimate) -> Estimate | None:
        """Forget a state that no working rig can have, and begin again by the last seconds of
        samples and frames, or as soon as that is possible.

        Args:
            good: the last estimate that could be used; the trajectory goes on from its position
                and heading, with the uncertainty of the time since.

        Returns:
            The estimate of the newest frame; None: nothing has changed, as it cannot begin again.
        """
        return None

    @property
    def initialisation(self) -> Initialisation:
        """How the state was initialised; asked after an update."""
        return Initialisation()

    def take_rotation_comparison(self, comparison: RotationComparison | None) -> None:
        """Take how the camera's rotation compares with the gyro's so far.

        None: not compared yet.
        """
        return

    @property
    def window_frames(self) -> int:
        """How many past frames `smoothed` and `relative` know at most; a map and `lag_frames`
        need some.
        """
        return 0

    def smoothed(self, frame_index: int) -> Estimate | None:
        """Return the estimate at a past frame with all frames since taken into account.

        None where it is not kept.
        """
        return None

    def relative(self, older: int, newer: int) -> RelativePose | None:
        """Return the body's motion between two past frames, by index.

        None where one is not kept.
        """
        return None


class Viewer(Protocol):
    """Watches a run; must not change it."""

    def frame(self, result: FrameResult) -> None:
        """Show one processed frame."""

    def close(self) -> None:
        """Release whatever the viewer holds."""
