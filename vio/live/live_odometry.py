"""Odometry with a thread of its own: what adds samples and images never waits for the processing."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from vio.calibration.stereo_field import CalibratedRig
from vio.cameras.rig import Rig
from vio.config import Config
from vio.datasets.frame_rate import FrameRateLimit
from vio.errors import ConfigError, DataError
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.live.build import CONFIGURED, MapUse, Parts
from vio.live.collector import QuietCollector
from vio.live.event_queue import DROPS, Drop
from vio.live.figures import LiveFigures, LiveMonitor
from vio.live.inputs import check_image, check_size, checked_depths, checked_observations, checked_samples, checked_time
from vio.live.odometry import Odometry
from vio.live.prediction import PredictedPose
from vio.live.shared_prediction import SharedPredictor
from vio.live.stream import EstimateStream
from vio.live.warm_up import warm_up
from vio.live.worker import Worker
from vio.records import Estimate, FrameResult, ImuSample, Landmarks, MotionSample, MotionSource, VelocitySample

log = logging.getLogger(__name__)

_LANDMARK_FRAMES = 100  # results after which the points that will not change any more are taken from the filter


class LiveOdometry:
    """`Odometry` with a queue and a worker: calls that add return at once, results come from the worker.

    Units, frames and clocks are those of `Odometry`; where no frame is left out, poses are the same to the bit. Samples
    and images may come from different threads, each in order of its own time. An error of the processing ends the
    worker, and is raised by the next call that adds, by the iterator and by `close`.
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
        drop: Drop = "oldest",
        queue_frames: int = 3,
        keep_landmarks: int = 100_000,
    ) -> None:
        """Start the worker; the first frame begins the trajectory.

        Args:
            rig: as of `Odometry`, like `config`, `T_cam0_imu`, `parts`, `map` and `localise`; a map never makes
                a frame wait.
            config: every setting.
            T_cam0_imu: (4, 4) extrinsics, only beside a rectified pair.
            parts: front end, selector or back end in place of the configured ones.
            on_frame: called with the result of each frame, by the worker: what takes long in it delays the next frame.
            map: file of a map to begin or to continue.
            localise: find poses in the map, and leave it as it is.
            drop: what happens where `queue_frames` wait already: "oldest" leaves out the frame that has waited longest,
                so that latency is bounded; "none" leaves out none; "block" makes the call wait, for recordings.
            queue_frames: that may wait.
            keep_landmarks: of the points that do not change any more, how many are kept for `landmarks`, at least.

        Raises:
            VioError: as `Odometry`.
        """
        if drop not in DROPS or queue_frames < 1:
            raise ConfigError(
                f"drop={drop!r}, queue_frames={queue_frames}: give one of {', '.join(DROPS)}, and 1 or more"
            )
        self._config, self._T_cam0_imu = Config() if config is None else config, T_cam0_imu
        use = MapUse(Path(map), localise) if isinstance(map, (str, Path)) else map
        self._odometry = Odometry(
            rig,
            self._config,
            T_cam0_imu=T_cam0_imu,
            parts=parts,
            on_frame=self._take_result,
            map=None if use is None else replace(use, wait=False),
        )
        self._on_frame, self._with_map = on_frame, use is not None
        if isinstance(rig, Rig):
            self._T_cam0_imu = rig.T_rect0_imu
        self._predictor = SharedPredictor(self._config.msckf.gravity_mps2)
        self._monitor = LiveMonitor(judges_latency=drop != "block")
        self._collector = QuietCollector()
        self._streams: list[EstimateStream] = []
        self._points: deque[Landmarks] = deque()  # that do not change any more
        self._keep_landmarks = keep_landmarks
        self._lines: list[str] = []
        self._forget()
        self._worker = Worker(queue_frames, drop, finish=self._odometry.finish, close=self._let_go)

    def warm_up(self) -> None:
        """Process made-up images of the camera's size, so that the first frame takes no longer than others.

        Loops are compiled or loaded, the front end is built, memory is touched; this takes some seconds, on a new
        machine twenty. Of the caller's own parts, none is used.

        Raises:
            DataError: the camera's image size is not known.
        """
        self._worker.ask(self._warm_up)

    def _warm_up(self) -> None:
        odometry = self._odometry
        warm_up(odometry.camera, self._T_cam0_imu, self._config, with_map=self._with_map)
        if odometry.camera.width is not None:
            odometry.prepare()
        self._collector.hold()

    # What goes in

    def add_imu(self, t_ns: int | npt.ArrayLike, gyro: npt.ArrayLike, accel: npt.ArrayLike) -> None:
        """Take one IMU sample, or several in order of time, see `Odometry.add_imu`; in microseconds.

        Raises:
            VioError: as `Odometry.add_imu`, or the worker has ended.
        """
        self._odometry.expect("imu")
        times, (a, b) = checked_samples(t_ns, {"gyro": gyro, "accel": accel})
        offset = self._odometry.time_offset_ns
        self._add_samples(times, [ImuSample(t - offset, *row) for t, *row in zip(times, a, b, strict=True)])

    def add_velocity(self, t_ns: int | npt.ArrayLike, linear: npt.ArrayLike, angular: npt.ArrayLike) -> None:
        """Take one sample of body velocity, or several in order of time, see `Odometry.add_velocity`.

        Raises:
            VioError: as `Odometry.add_velocity`, or the worker has ended.
        """
        self._odometry.expect("velocity")
        times, (a, b) = checked_samples(t_ns, {"linear": linear, "angular": angular})
        offset = self._odometry.time_offset_ns
        self._add_samples(times, [VelocitySample(t - offset, *row) for t, *row in zip(times, a, b, strict=True)])

    def add_stereo(self, t_ns: int, left: npt.ArrayLike, right: npt.ArrayLike) -> None:
        """Take a pair of images, see `Odometry.add_stereo`; they are copied, and processed by the worker.

        Raises:
            VioError: a wrong type, shape or size, a time not after the last frame's, or the worker has ended.
        """
        if self._odometry.camera.kind != "stereo":
            raise DataError("this rig has one camera; give its images to add_images")
        images = [
            _copied(self._checked(image, name, k)) for k, (image, name) in enumerate(((left, "left"), (right, "right")))
        ]
        self._add_frame(t_ns, lambda time_ns: self._odometry.add_stereo(time_ns, *images))

    def add_images(
        self,
        t_ns: int,
        left: npt.ArrayLike,
        right: npt.ArrayLike | None = None,
        *,
        depth_m: npt.ArrayLike | None = None,
    ) -> None:
        """Take the image of one camera, with depths where it has them, see `Odometry.add_images`.

        Raises:
            VioError: as `add_stereo`, or images of another rig's kind.
        """
        if right is not None:
            self.add_stereo(t_ns, left, right)
            return
        kind = self._odometry.camera.kind
        if kind == "stereo" or (depth_m is not None) != (kind == "rgbd"):
            needed = {"stereo": "two images", "rgbd": "an image with depth_m", "mono": "one image without depths"}[kind]
            raise DataError(f"this rig takes {needed}")
        image = _copied(self._checked(left, "left", 0))
        depth = None if depth_m is None else checked_depths(depth_m, image.shape[:2])
        self._add_frame(t_ns, lambda time_ns: self._odometry.add_images(time_ns, image, depth_m=depth))

    def add_observations(
        self, t_ns: int, ids: npt.ArrayLike, z: npt.ArrayLike, has_right: npt.ArrayLike | None = None
    ) -> None:
        """Take what a front end of the caller's own saw in a frame, see `Odometry.add_observations`.

        Raises:
            VioError: shapes disagree, an id occurs twice, a pixel is not finite, a time not after the last one, or the
                worker has ended.
        """
        seen = checked_observations(0, t_ns, ids, z, has_right)
        self._add_frame(
            t_ns, lambda time_ns: self._odometry.add_observations(time_ns, seen.ids, seen.z, seen.has_right)
        )

    def reset(self) -> None:
        """Forget all: the next frame begins a new trajectory in a new world frame.

        Raises:
            ConfigError: there is a map, or parts of the caller's own were given.
        """
        self._worker.ask(self._reset)

    def _reset(self) -> None:
        self._odometry.reset()
        self._forget()

    def _forget(self) -> None:
        """Begin with an empty trajectory."""
        self._limit = FrameRateLimit(self._config.dataset.max_frame_rate)
        self._last_ns: dict[str, int] = {}
        self._predictor = SharedPredictor(self._config.msckf.gravity_mps2)
        self._points.clear()

    def close(self) -> None:
        """Process what waits, write the map, and end the worker; calling it again does nothing.

        Raises:
            Exception: what the worker ended with, where it failed.
        """
        self._worker.end(discard=False)
        self._worker.raise_failure()

    def check(self) -> None:
        """Raise what the worker ended with, if it failed; calls that add do the same.

        Raises:
            Exception: that error.
        """
        self._worker.raise_failure()

    # What comes out

    def latest(self) -> Estimate | None:
        """Return the newest estimate; None before the first. It never waits."""
        return self._odometry.estimate

    def __iter__(self) -> EstimateStream:
        """Return the estimates from now on, for a thread of the caller's own; they end when the odometry is closed."""
        stream = EstimateStream(self._worker.raise_failure)
        self._streams.append(stream)
        if not self._worker.is_alive:
            stream.end()
        return stream

    def predict(self, t_ns: int) -> PredictedPose:
        """Return the pose at a time at or after the newest estimate, from all samples added; it waits for no frame.

        Raises:
            DataError: there is no estimate yet, or the time is before it.
        """
        return self._predictor.predict(checked_time(t_ns))

    @property
    def figures(self) -> LiveFigures:
        """How the odometry keeps up: latency, frames that were left out, frames that wait."""
        return self._monitor.figures(self._worker.frames)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the checks have found so far, and whether the computer falls behind, one line each."""
        return (*self._odometry.warnings, *self._lines)

    @property
    def camera(self) -> StereoCamera:
        """The rectified camera."""
        return self._odometry.camera

    @property
    def T_cam0_body(self) -> FloatArray:
        """Extrinsics (4, 4) of the body whose pose is estimated, in the rectified left camera."""
        return self._odometry.T_cam0_body

    @property
    def motion(self) -> MotionSource | None:
        """What propagates the pose between frames; None: images alone."""
        return self._odometry.motion

    def landmarks(self) -> Landmarks:
        """Return the points of the map so far, of those that do not change any more the newest; waits for a frame.

        Raises:
            DataError: no frame has a pose yet.
        """
        return self._worker.ask(self._landmarks)

    def calibrated_rig(self) -> CalibratedRig:
        """Return the rig with what the estimate says that its calibration is off by, see `Odometry.calibrated_rig`."""
        return self._odometry.calibrated_rig()

    def _landmarks(self) -> Landmarks:
        parts = [*self._points, self._odometry.landmarks()]
        names = ("ids", "p_world", "covariance")
        ids, points, covariances = (np.concatenate([getattr(part, name) for part in parts])[::-1] for name in names)
        kept, last = np.unique(ids, return_index=True)  # of a point that came back, the newest
        return Landmarks(kept, points[last], covariances[last])

    def __enter__(self) -> LiveOdometry:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close; where an error ended the block, without processing what waits."""
        if kind is None:
            self.close()
        else:
            self._worker.end(discard=True)

    # How

    def _checked(self, image: npt.ArrayLike, name: str, camera: int) -> npt.NDArray[np.uint8]:
        """Return an image that fits the camera, as it was given."""
        array, shape = check_image(image, name), self._odometry.image_shapes[camera]
        if shape is not None:
            check_size(array, shape, name)
        return array

    def _check_order(self, of: str, times: list[int]) -> None:
        last = self._last_ns.get(of)
        if times and last is not None and times[0] <= last:
            raise DataError(f"{of} at {times[0]} ns is not after the last one at {last} ns; give them in order of time")
        if times:
            self._last_ns[of] = times[-1]

    def _add_samples(self, times: list[int], samples: Sequence[MotionSample]) -> None:
        """Queue samples, and let predictions begin with them at once."""
        self._check_order("sample", times)
        self._put(lambda: self._odometry.add_samples(samples))
        for sample in samples:
            self._predictor.add(sample)

    def _add_frame(self, t_ns: Any, add: Callable[[int], object]) -> None:
        """Queue a frame, unless the limit on the frame rate leaves it out."""
        time_ns = checked_time(t_ns)
        self._check_order("frame", [time_ns])
        if not self._limit.takes(time_ns):
            return
        self._monitor.arrived(time_ns)
        self._monitor.queued(fits=self._put(lambda: add(time_ns), frame=True))

    def _put(self, add: Callable[[], object], *, frame: bool = False) -> bool:
        """Queue a call that adds; False: a frame was left out for it."""
        return self._worker.put(lambda: self._make(add), frame=frame)

    # In the worker

    def _make(self, add: Callable[[], object]) -> None:
        """Make a call that adds; what only the odometry itself refuses is counted and logged."""
        try:
            add()
        except DataError as error:
            self._monitor.refused += 1
            self._say(str(error))
        self._predictor.catch_up()

    def _take_result(self, result: FrameResult) -> None:
        """Hand the result of a frame to all who wait for it."""
        self._predictor.add(result.estimate)
        line = self._monitor.result(result.frame.time_ns)
        if line is not None:
            self._say(line)
        for stream in self._streams:
            stream.put(result.estimate)
        if self._on_frame is not None:
            try:
                self._on_frame(result)
            except Exception as error:  # noqa: BLE001 # raised by the next call
                self._worker.fail(error)
        if self._monitor.results == 1:
            self._collector.hold()
        if self._monitor.results % _LANDMARK_FRAMES == 0:
            self._keep_points()

    def _keep_points(self) -> None:
        """Take the points that will not change any more from the filter, which would keep all of them."""
        self._points.append(self._odometry.take_landmarks())
        while sum(len(part.ids) for part in self._points) - len(self._points[0].ids) >= self._keep_landmarks:
            self._points.popleft()

    def _let_go(self) -> None:
        """Write the map, and leave no iterator waiting."""
        try:
            self._odometry.close()
        finally:
            self._collector.release()
            for stream in self._streams:
                stream.end()

    def _say(self, line: str) -> None:
        log.warning("%s", line)
        self._lines.append(line)


def _copied(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return a copy of an image, made without letting another thread run, which would give way after 5 ms only."""
    return np.frombuffer(image.tobytes(), dtype=np.uint8).reshape(image.shape)
