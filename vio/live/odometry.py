"""The front door for live cameras, robots and own loops: samples and frames in, poses out."""

from __future__ import annotations

import logging
import operator
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from vio.calibration.estimated_rig import estimated_rig
from vio.calibration.stereo_field import CalibratedRig
from vio.cameras.rig import Rig
from vio.config import Config
from vio.datasets.frame_rate import FrameRateLimit
from vio.errors import ConfigError, DataError
from vio.filters.msckf import Msckf
from vio.frontend import build_frontend
from vio.frontend.precomputed import PrecomputedFrontend
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.live.chain import BACKENDS, Chain, build_backend
from vio.live.event_order import EventOrder
from vio.live.prediction import PosePredictor, PredictedPose
from vio.numerics.threads import BlasLimit
from vio.protocols import Backend, Frontend, Selector
from vio.records import (
    Estimate,
    Event,
    FrameResult,
    Image,
    ImuSample,
    IntArray,
    Landmarks,
    LoopEvent,
    MotionSource,
    Observations,
    StereoFrame,
    VelocitySample,
    no_landmarks,
    observations,
)
from vio.selection.selectors import build_selector

if TYPE_CHECKING:
    from vio.cameras.rig import Rectifier
    from vio.mapping.session import MapSession

log = logging.getLogger(__name__)

_LEAST_WAIT_S = 1e-3  # a velocity carries the pose that far as well as the IMU does
_CLEAR = 3.0  # standard deviations of a time offset that is waited for


def _wait_ns(estimate: Estimate) -> int:
    """How long after its stamp a frame is processed, ns, so that the IMU's samples reach its exposure."""
    offset_s, sigma_s = estimate.time_offset_s, estimate.time_offset_sigma_s
    if offset_s is None or sigma_s is None or offset_s < max(_LEAST_WAIT_S, _CLEAR * sigma_s):
        return 0
    return round(1e9 * offset_s)


def rig_of_rectified(camera: StereoCamera, T_cam0_imu: FloatArray | None) -> Rig | None:
    """Return a rectified pair with the pose (4, 4) of its IMU as a rig of two pinholes.

    None: one camera, no known image size, or a cylinder, which no lens model holds.
    """
    if camera.width is None or camera.height is None or camera.kind != "stereo" or camera.is_cylinder:
        return None
    c = camera
    return Rig.rectified(c.fu, c.fv, c.cu, c.cv, c.baseline_m, camera.width, camera.height, T_cam0_imu)


class Odometry:
    """Stereo visual-inertial odometry, one event at a time.

    Times are nanoseconds on the clock of the camera's stamps; units are metres, seconds and radians; frames are those
    of docs/conventions.md. A frame is processed as soon as the first IMU sample at or after it has come, by the call
    that brings the later of the two. Where no sample comes, it waits until a frame 0.1 s newer has come.

    Calls may come from several threads; a lock lets one at a time process. `estimate` and `predict` never wait.
    A call that raises has changed nothing: the next one goes on as if it had not been made.
    """

    def __init__(
        self,
        rig: Rig | StereoCamera,
        config: Config | None = None,
        *,
        T_cam0_imu: FloatArray | None = None,
        frontend: Frontend | None = None,
        selector: Selector | None = None,
        backend: Backend | None = None,
        on_frame: Callable[[FrameResult], None] | None = None,
        map: Path | str | MapSession | None = None,
        localise: bool = False,
    ) -> None:
        """Prepare; the first frame begins the trajectory.

        Args:
            rig: the calibration, as `vio.load_rig` returns it; or a rectified pair. One camera needs an IMU or, where
                it has a `depth_factor`, depth images.
            config: every setting; None: the defaults. `motion` auto means the IMU where the rig has one.
            T_cam0_imu: (4, 4) extrinsics, only beside a rectified pair; a `Rig` has its own.
            frontend: used in place of the configured front end.
            selector: used in place of the configured selector.
            backend: used in place of the configured back end.
            on_frame: called with the result of each frame, by the call that processed it.
            map: file of a map to begin or to continue (docs/maps.md): estimates have `T_map_body`, and `close` ends it.
            localise: find poses in the map, and leave it as it is.

        Raises:
            CalibrationError: the rig cannot be rectified.
            ConfigError: the settings ask for what the rig does not have, or a map for another back end than msckf.
            DataError: the map cannot be used.
        """
        self._config = Config() if config is None else config
        self._rectifier: Rectifier | None = None
        self._rig: Rig | None = None  # as given; None: a rectified pair
        self._offset_ns = 0
        if isinstance(rig, StereoCamera):
            self.camera = rig
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
        self.motion = _motion_source(self._config, has_imu=T_cam0_imu is not None)
        self.T_cam0_body: FloatArray = np.eye(4) if T_cam0_imu is None else T_cam0_imu
        self._parts = frontend, selector, backend
        self._on_frame = on_frame
        self._lock = threading.RLock()
        self._blas = BlasLimit()
        if map is not None and (self._config.backend != "msckf" or backend is not None):
            raise ConfigError("a map needs the back end msckf, which gives the covariance of motions; configure that")
        self._map = self._opened(map, localise=localise) if isinstance(map, (str, Path)) else map
        self.reset()

    def reset(self) -> None:
        """Forget all: the next frame begins a new trajectory in a new world frame.

        Raises:
            ConfigError: parts of the caller's own were given, which only the caller can make new.
        """
        if getattr(self, "_chain", None) is not None and any(part is not None for part in self._parts):
            raise ConfigError("reset: front end, selector or back end were given; build a new Odometry with new ones")
        if getattr(self, "_chain", None) is not None and self._map is not None:
            raise ConfigError("reset: a map takes one trajectory of an Odometry; close it, and build a new one")
        self._chain: Chain | None = None
        self._order = EventOrder(wait_for_imu=self.motion == "imu")
        self._predictor = PosePredictor(self._config.msckf.gravity_mps2)
        self._given: dict[int, Observations] = {}  # observations of frames that wait
        self._kind: str | None = None  # of frames: images or observations
        self._frames = 0
        self._limit = FrameRateLimit(self._config.dataset.max_frame_rate)
        self._last_ns: dict[str, int] = {}  # newest time of each kind of event
        self._estimate: Estimate | None = None

    # What goes in

    def add_imu(self, t_ns: int | npt.ArrayLike, gyro: npt.ArrayLike, accel: npt.ArrayLike) -> None:
        """Take one IMU sample, or several in order of time.

        Args:
            t_ns: time, or times (N,), in nanoseconds on the IMU's clock.
            gyro: (3,) or (N, 3) rad/s.
            accel: (3,) or (N, 3) m/s^2, specific force: about +9.81 upwards at rest.

        Raises:
            DataError: a wrong shape, a value that is not finite, or a time not after the last sample's.
            ConfigError: this odometry does not use an IMU.
        """
        self._expect("imu")
        times, (a, b) = _samples(t_ns, {"gyro": gyro, "accel": accel})
        self._add_samples([ImuSample(t - self._offset_ns, *row) for t, *row in zip(times, a, b, strict=True)])

    def add_velocity(self, t_ns: int | npt.ArrayLike, linear: npt.ArrayLike, angular: npt.ArrayLike) -> None:
        """Take one sample of body velocity, or several in order of time.

        Args:
            t_ns: time, or times (N,), in nanoseconds on the sensor's clock.
            linear: (3,) or (N, 3) m/s, body frame.
            angular: (3,) or (N, 3) rad/s, body frame.

        Raises:
            DataError: a wrong shape, a value that is not finite, or a time not after the last sample's.
            ConfigError: this odometry does not use velocities; set `motion` to velocity.
        """
        self._expect("velocity")
        times, (a, b) = _samples(t_ns, {"linear": linear, "angular": angular})
        self._add_samples([VelocitySample(t - self._offset_ns, *row) for t, *row in zip(times, a, b, strict=True)])

    def add_stereo(self, t_ns: int, left: npt.ArrayLike, right: npt.ArrayLike) -> Estimate | None:
        """Take a pair of images and return the newest estimate that it brought; None: it waits for IMU samples.

        A pair that the front end refuses (of swapped cameras, for instance) gives a warning and no estimate. None is
        also returned for a frame that comes sooner than `dataset.max_frame_rate` allows, which is left out.

        Args:
            t_ns: time of the exposure in nanoseconds.
            left: (H, W) uint8 gray or (H, W, 3) uint8 BGR, raw or rectified as the rig says.
            right: likewise.

        Raises:
            DataError: a wrong type, shape or size, or a time not after the last frame's.
        """
        with self._lock:
            if self.camera.kind != "stereo":
                raise DataError("this rig has one camera; give its images to add_images")
            images = [_gray(image, name) for image, name in ((left, "left"), (right, "right"))]
            if images[0].shape != images[1].shape and self._rectifier is None:
                raise DataError(f"the images differ in size: {images[0].shape} left, {images[1].shape} right")
            if self._rectifier is not None:
                for image, name, lens in zip(
                    images, ("left", "right"), (self._rectifier.rig.cam0, self._rectifier.rig.cam1), strict=True
                ):
                    _check_size(image, (lens.height, lens.width), name)
            elif self.camera.width is not None and self.camera.height is not None:
                _check_size(images[0], (self.camera.height, self.camera.width), "left")
            time_ns = self._new_time("frame", t_ns, kind="images")
            if not self._is_used(time_ns):
                return None
            return self._add_frame(self._rectified(time_ns, *images))

    def add_images(
        self,
        t_ns: int,
        left: npt.ArrayLike,
        right: npt.ArrayLike | None = None,
        *,
        depth_m: npt.ArrayLike | None = None,
    ) -> Estimate | None:
        """Take the image of one camera, with depths where it has them; with a right image, as `add_stereo`.

        One camera with an IMU has no estimate until the scale is observable: the return value is None until then.

        Args:
            t_ns: time of the exposure in nanoseconds.
            left: (H, W) uint8 gray or (H, W, 3) uint8 BGR, distorted or not as the rig says.
            right: likewise, where the rig has two cameras.
            depth_m: (H, W) metres along the optical axis of each pixel of the image, 0 where it is not known.

        Raises:
            DataError: a wrong type, shape or size, a time not after the last frame's, or images of another rig's kind.
        """
        if right is not None:
            return self.add_stereo(t_ns, left, right)
        with self._lock:
            if self.camera.kind == "stereo":
                raise DataError("this rig has two cameras, but one image came; give both, or load_rig(..., cameras=1)")
            if (depth_m is not None) != (self.camera.kind == "rgbd"):
                raise DataError(
                    "depths came, but the rig has no depth_factor; give the rig one"
                    if depth_m is not None
                    else "this rig has depth images (a depth_factor), but no depths came; give depth_m"
                )
            image = _gray(left, "left")
            if self.camera.width is not None and self.camera.height is not None:
                _check_size(image, (self.camera.height, self.camera.width), "left")
            depth = None if depth_m is None else _depths(depth_m, image.shape)
            time_ns = self._new_time("frame", t_ns, kind="images")
            if not self._is_used(time_ns):
                return None
            return self._add_frame(self._rectified(time_ns, image, depth_m=depth))

    def add_observations(
        self, t_ns: int, ids: npt.ArrayLike, z: npt.ArrayLike, has_right: npt.ArrayLike | None = None
    ) -> Estimate | None:
        """Take what a front end of the caller's own saw in a frame; the return value is that of `add_stereo`.

        Args:
            t_ns: time of the exposure in nanoseconds.
            ids: (N,) unique; an id names one feature for ever.
            z: (N, 4) rectified pixels [ul vl ur vr].
            has_right: (N,) whether the feature is seen in the right image; None: all are.

        Raises:
            DataError: shapes disagree, an id occurs twice, a pixel is not finite, or a time not after the last one.
        """
        with self._lock:
            try:
                seen = observations(self._frames, 0, ids, z, has_right)
            except (ValueError, TypeError) as error:
                raise DataError(f"observations at {t_ns} ns: {error}") from error
            used = np.concatenate([seen.z[:, :2].ravel(), seen.z[seen.has_right, 2:].ravel()])
            if not np.isfinite(used).all():
                raise DataError(f"observations at {t_ns} ns: {int((~np.isfinite(used)).sum())} pixels are not finite")
            time_ns = self._new_time("frame", t_ns, kind="observations")
            if not self._is_used(time_ns):
                return None
            self._given[self._frames] = observations(self._frames, time_ns, seen.ids, seen.z, seen.has_right)
            return self._add_frame(StereoFrame(self._frames, time_ns, None, None))

    def add_event(self, event: Event) -> list[FrameResult]:
        """Take an event of a recording, whose images are rectified and whose stamps are of one clock.

        Returns:
            the results of the frames that it completed.
        """
        with self._lock:
            if isinstance(event, StereoFrame) and not self._limit.takes(event.time_ns):
                return []
            return self._add(event)

    def finish(self) -> list[FrameResult]:
        """Process the frames that still wait, and let the checks report what is left."""
        with self._lock:
            results = self._process(self._order.flush())
            self._deliver(results)
            if self._chain is not None:
                self._chain.watch.close()
            if self._map is not None:
                self._map.finish()
            return results

    def close(self) -> None:
        """Write the map and let its file go; without a map, nothing is held."""
        with self._lock:
            if self._map is not None:
                self._map.close()

    # What comes out

    @property
    def estimate(self) -> Estimate | None:
        """The newest estimate; None before the first."""
        return self._estimate

    def calibrated_rig(self) -> CalibratedRig:
        """Return the rig with what the estimate says that its calibration is off by; `rig` of it begins the next run.

        Raises:
            DataError: there is no estimate yet, the size of the rectified images is not known, or they are a cylinder's
                and the rig of the raw cameras was not given.
            CalibrationError: no rig of the given lens models is off as the estimate says.
        """
        estimate = self._estimate
        if estimate is None:
            raise DataError("there is no calibration before the first frame")
        rig = self._rig or rig_of_rectified(self.camera, None if self.motion is None else self.T_cam0_body)
        if rig is None:
            if self.camera.is_cylinder:
                raise DataError("no lens model holds a cylinder; give Odometry the rig of the raw cameras")
            raise DataError("the rectified camera has no image size; give StereoCamera its width and height")
        return estimated_rig(rig, estimate, is_cylinder=self.camera.is_cylinder, where="live images")

    @property
    def map_session(self) -> MapSession | None:
        """The trajectory's part of the map; None without a map."""
        return self._map

    @property
    def loops(self) -> tuple[LoopEvent, ...]:
        """The places of the map that were seen again so far."""
        return () if self._map is None else tuple(self._map.loops)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the checks have found so far, one line each."""
        return () if self._chain is None else tuple(self._chain.watch.lines)

    @property
    def frames_refused(self) -> int:
        """Number of frames that the front end refused."""
        return 0 if self._chain is None else self._chain.watch.frames_refused

    @property
    def frames_waiting(self) -> int:
        """Number of frames without a pose, as the scale of one camera was not observable yet."""
        return 0 if self._chain is None else self._chain.watch.frames_waiting

    def predict(self, t_ns: int) -> PredictedPose:
        """Return the pose at a time at or after the newest estimate, from the samples added since.

        It takes well under a millisecond and waits for no other call. Beyond the last sample the motion is held, for
        half a second at most.

        Raises:
            DataError: there is no estimate yet, or the time is before it.
        """
        return self._predictor.predict(_time(t_ns))

    def landmarks(self) -> Landmarks:
        """Return the points of the map so far.

        Raises:
            DataError: no frame has been processed.
        """
        with self._lock:
            if self._chain is None:
                raise DataError("there is no map before the first frame")
            return self._chain.backend.landmarks()

    def take_landmarks(self) -> Landmarks:
        """Return the points of the map that will not change any more, and forget them, so that memory stays flat.

        `landmarks` then returns the others.
        """
        with self._lock:
            if self._chain is None:
                return no_landmarks()
            return self._chain.backend.take_landmarks()

    def smoothed(self, frame_index: int) -> Estimate | None:
        """Return the estimate at a past frame with all frames since; None where the window no longer holds it."""
        with self._lock:
            return None if self._chain is None else self._chain.backend.smoothed(frame_index)

    def __enter__(self) -> Odometry:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish, unless an error ended the block."""
        try:
            if kind is None:
                self.finish()
        finally:
            self.close()

    # How

    def __getstate__(self) -> dict[str, Any]:
        """State for a checkpoint: all but locks and the caller's function."""
        return {key: value for key, value in self.__dict__.items() if key not in ("_lock", "_blas", "_on_frame")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a checkpoint."""
        self.__dict__.update(state)
        self._lock, self._blas, self._on_frame = threading.RLock(), BlasLimit(), None

    def _expect(self, source: MotionSource) -> None:
        if self.motion != source:
            raise ConfigError(
                f"{source} samples came, but this odometry runs on motion {self.motion or 'none'}; set the "
                "configuration's motion, and for an IMU give the rig its T_cam0_imu"
            )

    def _new_time(self, of: str, t_ns: Any, *, kind: str) -> int:
        """Check and note a frame's time and kind."""
        time_ns = _time(t_ns)
        last = self._last_ns.get(of)
        if last is not None and time_ns <= last:
            raise DataError(f"{of} at {time_ns} ns is not after the last one at {last} ns; give them in order of time")
        if self._kind not in (None, kind):
            raise DataError(f"{kind} came after {self._kind}; one trajectory takes one of them")
        self._kind = kind
        self._last_ns[of] = time_ns
        return time_ns

    def _is_used(self, time_ns: int) -> bool:
        """Whether the limit on the frame rate lets a frame through; one that it leaves out keeps its number."""
        used = self._limit.takes(time_ns)
        self._frames += not used
        return used

    def _add_samples(self, samples: list[Any]) -> None:
        with self._lock:
            last = self._last_ns.get("sample")
            if last is not None and samples and samples[0].time_ns <= last:
                raise DataError(
                    f"sample at {samples[0].time_ns + self._offset_ns} ns is not after the last one at "
                    f"{last + self._offset_ns} ns; give them in order of time, each once"
                )
            for sample in samples:
                self._last_ns["sample"] = sample.time_ns
                self._predictor.sample(sample)
                self._deliver(self._add(sample))

    def _rectified(
        self, time_ns: int, left: Image, right: Image | None = None, *, depth_m: FloatArray | None = None
    ) -> StereoFrame:
        if self._rectifier is None:
            return StereoFrame(self._frames, time_ns, left, right, depth_m)
        return self._rectifier.frame(self._frames, time_ns, left, right, depth_m=depth_m)

    def _add_frame(self, frame: StereoFrame) -> Estimate | None:
        self._frames += 1
        results = self._add(frame)
        self._deliver(results)
        return results[-1].estimate if results else None

    def _deliver(self, results: list[FrameResult]) -> None:
        for result in results:
            self._predictor.estimate(result.estimate)
            if self._on_frame is not None:
                self._on_frame(result)

    def _add(self, event: Event) -> list[FrameResult]:
        """Take an event, and process what is due, frame by frame."""
        self._order.put(event)
        results: list[FrameResult] = []
        while events := self._order.due():
            results += self._process(events)
        return results

    def _process(self, events: list[Event]) -> list[FrameResult]:
        """Give events that are due to the chain."""
        if not events:
            return []
        results: list[FrameResult] = []
        with self._blas():
            for event in events:
                self._chain = self._chain or self._build()
                if not isinstance(event, StereoFrame):
                    self._chain.sample(event)
                    continue
                result = self._chain.frame(event)
                if result is not None:
                    result = self._in_map(event, result)
                    results.append(result)
                    self._estimate = result.estimate
                    self._order.exposed_after_ns = _wait_ns(result.estimate)
        return results

    def _opened(self, path: Path | str, *, localise: bool) -> MapSession:
        from vio.mapping.session import MapSession

        return MapSession(
            Path(path),
            self.camera,
            self.T_cam0_body,
            source="live",
            imu=self.motion == "imu",
            localise=localise,
            alone=self.motion is None,
        )

    def _in_map(self, frame: StereoFrame, result: FrameResult) -> FrameResult:
        """Add what the map says of a frame."""
        if self._map is None or self._chain is None:
            return result
        backend = self._chain.backend
        assert isinstance(backend, Msckf)
        loops = self._map.frame(frame, result.output.observations, result.estimate, backend.relative)
        T = self._map.T_map_odom
        if T is not None:
            T_map_body, covariance = T @ result.estimate.T_world_imu, self._map.covariance
            estimate = replace(result.estimate, T_map_body=T_map_body, T_map_body_covariance=covariance)
            result = replace(result, estimate=estimate)
        return replace(result, loops=loops, is_keyframe=self._map.newest_keyframe == frame.index)

    def _build(self) -> Chain:
        """Build the chain once the first frame says whether images or observations come."""
        frontend, selector, backend = self._parts
        config, camera = self._config, self.camera
        if frontend is None and self._kind == "observations":
            frontend = PrecomputedFrontend(self._take_given)
        if frontend is None:
            name = "klt" if config.frontend.name == "auto" else config.frontend.name
            frontend = build_frontend(name, camera, config.frontend)
        if selector is None:
            selector = build_selector(config.selector, whole_record=None, camera=camera)
        if backend is None:
            backend = build_backend(camera, self.T_cam0_body, config, self.motion)
        return Chain(
            camera,
            self.T_cam0_body,
            self.motion,
            frontend=frontend,
            selector=selector,
            backend=backend,
            use_prior=config.frontend.prior,
        )

    def _take_given(self, index: int) -> Observations | None:
        return self._given.pop(index, None)


def _motion_source(config: Config, *, has_imu: bool) -> MotionSource | None:
    """What carries the pose between frames.

    Raises:
        ConfigError: an IMU without extrinsics, or a motion that the back end has no model for.
    """
    known = BACKENDS[config.backend].motion_sources
    if config.motion == "none":
        return None
    if config.motion == "auto":
        return "imu" if has_imu and "imu" in known else None
    if config.motion not in known:
        raise ConfigError(f"backend {config.backend} has no model for motion {config.motion}; it takes {known}")
    if config.motion == "imu" and not has_imu:
        raise ConfigError("motion imu needs the extrinsics T_cam0_imu; give the rig them")
    return config.motion


def _time(t_ns: Any) -> int:
    """Return a time as an integer.

    Raises:
        DataError: it is none.
    """
    try:
        return operator.index(t_ns)
    except TypeError as error:
        raise DataError(f"a time must be an integer number of nanoseconds, got {t_ns!r}") from error


def _samples(t_ns: Any, values: dict[str, npt.ArrayLike]) -> tuple[list[int], list[FloatArray]]:
    """Return times (N,) and arrays (N, 3) of one sample or several.

    Raises:
        DataError: a wrong shape or type, a value that is not finite, or times that do not increase.
    """
    times: IntArray = np.asarray(t_ns)
    if not np.issubdtype(times.dtype, np.integer) or times.ndim > 1:
        raise DataError(f"times must be integer nanoseconds, () or (N,), got {times.dtype} {times.shape}")
    rows = []
    for name, value in values.items():
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise DataError(f"{name} is not numeric: {error}") from error
        if array.shape != (*times.shape, 3):
            raise DataError(f"{name} has shape {array.shape}, expected {(*times.shape, 3)}")
        if not np.isfinite(array).all():
            raise DataError(f"{name} at {np.atleast_1d(times)[0]} ns is not finite: {array}")
        rows.append(array.reshape(-1, 3).copy())
    times = np.atleast_1d(times)
    if (np.diff(times) <= 0).any():
        raise DataError("times of samples must increase; sort them and give each once")
    return times.tolist(), rows


def _gray(image: npt.ArrayLike, name: str) -> Image:
    """Return an image as (H, W) uint8.

    Raises:
        DataError: it is neither 8-bit gray nor BGR.
    """
    array = np.asarray(image)
    if array.dtype != np.uint8 or not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)) or not array.size:
        raise DataError(
            f"the {name} image has shape {array.shape} and type {array.dtype}; give uint8, (H, W) gray or (H, W, 3) BGR"
        )
    if array.ndim == 3:
        import cv2

        array = cv2.cvtColor(array, cv2.COLOR_BGR2GRAY)
    return np.array(array, dtype=np.uint8, order="C")  # a copy: the caller may fill its buffer again


def _depths(depth_m: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return depths as (H, W) float64.

    Raises:
        DataError: they are not of the image's shape.
    """
    array = np.array(depth_m, dtype=np.float64)
    if array.shape != shape:
        raise DataError(f"the depths have shape {array.shape}, but the image {shape}; register them to the image")
    return array


def _check_size(image: Image, expected: tuple[int, int], name: str) -> None:
    if image.shape != expected:
        raise DataError(
            f"the {name} image is {image.shape[1]}x{image.shape[0]}, but the calibration is for "
            f"{expected[1]}x{expected[0]}; check that calibration and camera belong together"
        )
