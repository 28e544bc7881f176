"""The front door for live cameras, robots and own loops: samples and frames in, poses out."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from vio.calibration.stereo_field import CalibratedRig, estimated_rig
from vio.cameras.rig import Rig, rig_of_rectified
from vio.config import Config
from vio.errors import ConfigError, DataError
from vio.filters.inputs import checked_extrinsics
from vio.findings import Finding
from vio.frontend import build_frontend
from vio.frontend.precomputed import PrecomputedFrontend
from vio.frontend.settings import FrontendSettings
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.live.build import (
    CONFIGURED,
    MapUse,
    Parts,
    build_processor,
    live_source,
    refuse_other_types,
)
from vio.live.event_inputs import EventInputs
from vio.live.inputs import GivenFrame, Inputs, Shapes, checked_time, gray
from vio.live.prediction import PosePredictor, PredictedPose
from vio.numerics.threads import BlasLimit
from vio.protocols import ChecksMatches, FollowsRight, Frontend
from vio.records import (
    CheckedFrame,
    Estimate,
    Event,
    FrameResult,
    FrontendOutput,
    Landmarks,
    LoopEvent,
    MotionSample,
    Observations,
    StereoFrame,
    TrackPrior,
    no_features,
)

if TYPE_CHECKING:
    from vio.cameras.rig import Rectifier
    from vio.mapping.session import MapSession
    from vio.monitor.integrity import Mark


class Odometry(EventInputs["Estimate | None"]):
    """Stereo visual-inertial odometry, one event at a time.

    Times are nanoseconds on the clock of the camera's stamps; units are metres, seconds and
    radians; frames are those of docs/conventions.md. A frame is processed as soon as the first IMU
    sample at or after it has come, by the call that brings the later of the two. Where no sample
    comes, it waits until a frame 0.1 s newer has come.

    Calls may come from several threads; a lock lets one at a time process. `estimate` and `predict`
    never wait. A call that raises has changed nothing: the next one goes on as if it had not been
    made.
    """

    def __init__(
        self,
        rig: Rig | StereoCamera,
        config: Config | None = None,
        *,
        T_cam0_imu: FloatArray | None = None,
        parts: Parts = CONFIGURED,
        on_frame: Callable[[FrameResult], None] | None = None,
        map: Path | str | MapUse | None = None,
        localise: bool = False,
    ) -> None:
        """Prepare; the first frame begins the trajectory.

        Args:
            rig: the calibration, as `vio.load_rig` returns it; or a rectified pair. One camera
                needs an IMU or, where it has a `depth_factor`, depth images.
            config: every setting; None: the defaults. `motion` auto means the IMU where the rig has
                one.
            T_cam0_imu: (4, 4) extrinsics, only beside a rectified pair; a `Rig` has its own.
            parts: front end, selector or back end in place of the configured ones.
            on_frame: called with the result of each frame, by the call that processed it.
            map: file of a map to begin or to continue (docs/maps.md): estimates have `T_map_body`,
                and `close` ends it; or its use in full.
            localise: find poses in the map, and leave it as it is; with the file of a map.

        Raises:
            CalibrationError: the rig cannot be rectified.
            ConfigError: the settings ask for what the rig does not have, or a map for a back end
                without a window.
            DataError: the map cannot be used.
            TypeError: a path is given in the place of the rig, or a dictionary for the settings.
        """
        self._config = Config() if config is None else config
        refuse_other_types(self._config, rig=rig)
        self._rectifier: Rectifier | None = None
        self._rig: Rig | None = None  # as given; None: a rectified pair
        self._offset_ns = 0
        if isinstance(rig, StereoCamera):
            self.camera = rig
            T_cam0_imu = None if T_cam0_imu is None else checked_extrinsics(T_cam0_imu)
        else:
            self._rig = rig
            # Maps know pinholes only.
            self._rectifier = rig.rectifier(
                projection=self._config.dataset.projection if map is None else "pinhole",
                depth_noise=None if rig.depth_factor is None else self._config.dataset.depth_noise,
            )
            self.camera = self._rectifier.camera
            T_cam0_imu = rig.T_rect0_imu
            self._offset_ns = round(1e9 * rig.time_offset_s)
        self._source = live_source(self.camera, T_cam0_imu, self._config, self._rectifier)
        # Extrinsics (4, 4) of the estimated body in the rectified left camera, and what propagates
        # its pose between frames; None: images alone.
        self.T_cam0_body = self._source.T_cam0_body
        self.T_cam0_imu = T_cam0_imu  # (4, 4); None: without, the body is the left camera
        self.motion = self._source.motion
        self._parts = parts
        self._map = MapUse(Path(map), localise) if isinstance(map, (str, Path)) else map
        self._on_frame = on_frame
        self._lock = self._checking = threading.RLock()
        self._blas = BlasLimit()
        self._begin()

    def reset(self) -> None:
        """Forget all: the next frame begins a new trajectory in a new world frame.

        A map is written, and takes the new trajectory as another session, which finds its place in
        it like one of a later day.

        Raises:
            ConfigError: parts of the caller's own were given, which only the caller can make new.
            DataError: the map cannot be written, or opened again.
        """
        if self._parts != CONFIGURED:
            raise ConfigError(
                "reset: front end, selector or back end were given; build a new Odometry with new "
                "ones"
            )
        with self._lock:
            if self._map is not None:
                self._processor.close()
            self._begin()

    def _begin(self) -> None:
        """Begin a trajectory."""
        self._frontend = _LiveFrontend(self.camera, self._config.frontend)
        parts = replace(self._parts, frontend=self._parts.frontend or self._frontend)
        self._processor = build_processor(self._source, self._config, parts, self._map)
        self._predictor = PosePredictor(self._config.imu.gravity_mps2)
        self._inputs = Inputs(
            self.camera,
            _image_shapes(self.camera, self._rectifier),
            self.motion,
            self._offset_ns,
            self._config.dataset.max_frame_rate,
            self._processor.pipeline.monitor.say,
        )

    # What goes in

    @property
    def inputs(self) -> Inputs:
        """The checks of the present trajectory."""
        return self._inputs

    def take(self, given: GivenFrame | Sequence[MotionSample] | None) -> Estimate | None:
        """Process what `inputs` has checked, maybe in another thread; the return value is that
        of `add_stereo`.
        """
        with self._lock:
            if given is None:
                return None
            if isinstance(given, GivenFrame):
                results = self._add(self._frame(given))
                return results[-1].estimate if results else None
            for sample in given:
                if (usable := self.usable(sample)) is not None:
                    self._predictor.sample(usable)
                self._add(sample)
            return None

    def usable(self, sample: MotionSample) -> MotionSample | None:
        """Return a sample as the filter takes it: in the units and axes that were found to be the
        right ones.

        None: it does not, as the sensor was found to be wrong.
        """
        return self._processor.pipeline.usable(sample)

    def finish(self) -> list[FrameResult]:
        """Process the frames that still wait, and let the checks report what is left."""
        with self._lock:
            with self._blas():
                results = self._processor.finish()
            self._deliver(results)
            return results

    def close(self) -> None:
        """Write the map and let its file go; without a map, nothing is held."""
        with self._lock:
            self._processor.close()

    def prepare(self) -> None:
        """Build what the first images would build: the front end, and the maps of the
        rectification.

        Raises:
            VioError: the settings contradict the camera, or name a file that cannot be read.
        """
        with self._lock:
            if self._parts.frontend is None:
                self._frontend.open()
            if self._rectifier is not None:
                shapes = _image_shapes(self.camera, self._rectifier)
                black = [np.zeros(shape or (1, 1), dtype=np.uint8) for shape in shapes]
                depth = None
                if self.camera.kind == "rgbd":
                    depth = np.zeros(black[0].shape)
                self._rectifier.frame(0, 0, *black, depth_m=depth)

    # What comes out

    @property
    def estimate(self) -> Estimate | None:
        """The newest estimate; None before the first."""
        return self._processor.estimate

    def calibrated_rig(self) -> CalibratedRig:
        """Return the rig with what the estimate says that its calibration is off by; `rig` of it
        begins the next run.

        Raises:
            DataError: there is no estimate yet, the size of the rectified images is not known, or
                they are a cylinder's or of one camera and the rig of the raw cameras was not given.
            CalibrationError: no rig of the given lens models is off as the estimate says.
        """
        estimate = self.estimate
        if estimate is None:
            raise DataError("there is no calibration before the first frame")
        rig = self._rig or rig_of_rectified(
            self.camera, None if self.motion is None else self.T_cam0_body
        )
        if rig is None:
            if self.camera.is_cylinder:
                raise DataError(
                    "no lens model holds a cylinder; give Odometry the rig of the raw cameras"
                )
            if self.camera.kind != "stereo":
                raise DataError("one camera was given without its lens; give Odometry its rig")
            raise DataError(
                "the rectified camera has no image size; give StereoCamera its width and height"
            )
        found = estimated_rig(rig, estimate, self.camera, "live images")
        from vio.guard.guarded import GuardedFrontend  # loads OpenCV

        frontend = self._processor.pipeline.frontend
        turn = frontend.turned_back if isinstance(frontend, GuardedFrontend) else None
        return found if turn is None else found.with_turned(turn, rig)

    @property
    def loops(self) -> tuple[LoopEvent, ...]:
        """The places of the map that were seen again so far."""
        session = self._processor.map
        return () if session is None else tuple(session.loops)

    @property
    def map_session(self) -> MapSession | None:
        """The present trajectory's part of the map; None: there is no map."""
        return self._processor.map

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the checks have found so far, one line each."""
        return tuple(self._processor.pipeline.monitor.lines)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the checks have found so far, with codes."""
        return tuple(self._processor.pipeline.monitor.findings)

    @property
    def frames_refused(self) -> int:
        """Number of frames that the front end refused."""
        return self._processor.pipeline.monitor.frames_refused

    @property
    def frames_waiting(self) -> int:
        """Number of frames without a pose, as the scale of one camera was not observable yet."""
        return self._processor.pipeline.monitor.frames_waiting

    def predict(self, t_ns: int) -> PredictedPose:
        """Return the pose at a time at or after the newest estimate, from the samples added since.

        It takes well under a millisecond and waits for no other call. Beyond the last sample the
        motion is held, for half a second at most.

        Raises:
            DataError: there is no estimate yet, or the time is before it.
        """
        return self._predictor.predict(checked_time(t_ns))

    def landmarks(self) -> Landmarks:
        """Return the points of the map so far.

        Raises:
            DataError: no frame has a pose yet.
        """
        with self._lock:
            if self.estimate is None:
                raise DataError("there is no map before the first frame")
            return self._processor.pipeline.backend.landmarks()

    def take_landmarks(self) -> Landmarks:
        """Return the points of the map that will not change any more, and forget them, so that
        memory stays flat.

        `landmarks` then returns the others.
        """
        with self._lock:
            return self._processor.pipeline.backend.take_landmarks()

    def smoothed(self, frame_index: int) -> Estimate | None:
        """Return the estimate at a past frame with all frames since, as the filter states it:
        without integrity, and without what findings add to the covariance.

        None where the window no longer holds it.
        """
        with self._lock:
            return self._processor.pipeline.backend.smoothed(frame_index)

    def take_corrections(self) -> tuple[dict[int, Estimate], tuple[Mark, ...]]:
        """Return what has changed of earlier frames, and forget it: estimates that replace others,
        by frame number, and marks of frames in which a fault had begun before it was found.
        """
        with self._lock:
            pipeline = self._processor.pipeline
            return pipeline.take_revised(), pipeline.monitor.take_marks()

    def __enter__(self) -> Odometry:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish, unless an error ended the block."""
        try:
            if kind is None:
                self.finish()
        finally:
            self.close()

    # How

    def _frame(self, given: GivenFrame) -> StereoFrame:
        """Return a frame for the front end, rectified where the rig is raw."""
        index = given.index
        time_ns = given.time_ns
        if given.seen is not None:
            self._frontend.given[index] = given.seen
            return StereoFrame(index, time_ns, None, None)
        if self._parts.frontend is None:
            self._frontend.open()
        images = map(gray, given.images)
        left = next(images)
        right = next(images, None)
        if self._rectifier is None:
            return StereoFrame(index, time_ns, left, right, given.depth_m)
        return self._rectifier.frame(index, time_ns, left, right, depth_m=given.depth_m)

    def _deliver(self, results: list[FrameResult]) -> None:
        for result in results:
            self._predictor.estimate(result.estimate)
            if self._on_frame is not None:
                self._on_frame(result)

    def _add(self, event: Event) -> list[FrameResult]:
        with self._blas():
            results = self._processor.add(event)
        self._deliver(results)
        return results


def _image_shapes(camera: StereoCamera, rectifier: Rectifier | None) -> Shapes:
    """Return height and width of the images of each camera, as they are to be given."""
    if rectifier is not None and camera.kind == "stereo":
        rig = rectifier.rig
        return (rig.cam0.height, rig.cam0.width), (rig.cam1.height, rig.cam1.width)
    if camera.width is None or camera.height is None:
        shape = None
    else:
        shape = (camera.height, camera.width)
    if camera.kind == "stereo":
        return (shape, shape)
    return (shape,)


class _LiveFrontend:
    """The configured front end for images; frames without images have the observations that the
    caller gave.
    """

    def __init__(self, camera: StereoCamera, settings: FrontendSettings) -> None:
        self._camera = camera
        self._settings = settings
        self.given: dict[int, Observations] = {}  # by frame, until it is processed
        self._replay = PrecomputedFrontend(lambda index: self.given.pop(index, None))
        self._images: Frontend | None = None
        self._last: Frontend = self._replay  # that processed the last frame

    def open(self) -> None:
        """Build the front end for images, which observations do not need."""
        if self._images is None:
            self._images = build_frontend(self._settings.name, self._camera, self._settings)

    @property
    def checks_matches(self) -> bool:
        """Whether the front end of the last frame does; see `vio.protocols.ChecksMatches`."""
        return isinstance(self._last, ChecksMatches) and self._last.checks_matches

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Process a frame, see `Frontend`."""
        frontend = self._replay if frame.left is None else self._images
        assert frontend is not None
        self._last = frontend
        return frontend.process(frame, prior)

    def follow_right(self, frame: CheckedFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Go on with the right image where the front end can; see `vio.guard.FollowsRight`."""
        if isinstance(self._images, FollowsRight):
            return self._images.follow_right(frame, prior)
        return no_features(frame)
