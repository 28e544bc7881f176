"""Odometry with a thread of its own: what adds samples and images never waits for the
processing.
"""

from __future__ import annotations

import logging
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from vio.calibration.stereo_field import CalibratedRig
from vio.cameras.rig import Rig
from vio.config import Config
from vio.errors import ConfigError, DataError
from vio.filters.point_map import newest_points
from vio.findings import Finding
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.live.build import CONFIGURED, MapUse, Parts
from vio.live.event_inputs import EventInputs
from vio.live.figures import LiveFigures, LiveMonitor
from vio.live.inputs import GivenFrame, Inputs, checked_time
from vio.live.odometry import Odometry
from vio.live.prediction import PredictedPose, SharedPredictor
from vio.live.sink import LiveSink
from vio.live.warm_up import warm_up
from vio.live.worker import DROPS, Drop, QuietCollector, Worker, WorkerState
from vio.numerics.kinds import Capacity
from vio.records import Estimate, FrameResult, Landmarks, MotionSample

log = logging.getLogger(__name__)

# results after which the points that will not change any more are taken from the filter
_LANDMARK_FRAMES: Capacity[int] = 100
# estimates that wait for the reader; of a slower one, the oldest are forgotten
_MAX_WAITING: Capacity[int] = 1000
# lines that are kept of frames that were refused, and of a computer that falls behind: the newest
_MAX_LINES: Capacity[int] = 1000


class EstimateStream(Iterator[Estimate]):
    """Estimates as they come; it ends when the odometry is closed. `trajectory` counts the
    resets before the last. Of a reader that is slower, the oldest of 1000 estimates are forgotten.
    """

    def __init__(self, raise_failure: Callable[[], None]) -> None:
        """Create an empty stream; `raise_failure` raises what the odometry ended with, if it
        failed.
        """
        self.trajectory = self._resets = 0
        self._estimates: deque[tuple[int, Estimate]] = deque(maxlen=_MAX_WAITING)
        self._changed = threading.Condition()
        self._ended = False
        self._raise_failure = raise_failure

    def put(self, estimate: Estimate) -> None:
        """Add the newest estimate."""
        with self._changed:
            self._estimates.append((self._resets, estimate))
            self._changed.notify()

    def reset(self) -> None:
        """Begin a new trajectory."""
        self._resets += 1

    def end(self) -> None:
        """Nothing more will come."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def __next__(self) -> Estimate:
        """Wait for the next estimate."""
        with self._changed:
            while not self._estimates and not self._ended:
                self._changed.wait()
            if self._estimates:
                self.trajectory, estimate = self._estimates.popleft()
                return estimate
        self._raise_failure()
        raise StopIteration


class _Streams:
    """The streams that somebody still reads; one that nobody holds any more is forgotten."""

    def __init__(self) -> None:
        self._held: list[weakref.ref[EstimateStream]] = []
        self._lock = threading.Lock()
        self._ended = False

    def open(self, raise_failure: Callable[[], None]) -> EstimateStream:
        """Return a new stream, which has ended already where all have."""
        stream = EstimateStream(raise_failure)
        with self._lock:
            if self._ended:
                stream.end()
            else:
                self._held = [held for held in self._held if held() is not None]
                self._held.append(weakref.ref(stream))
        return stream

    def read(self) -> list[EstimateStream]:
        """Return the streams that are read."""
        with self._lock:
            found = [held() for held in self._held]
        return [stream for stream in found if stream is not None]

    def end(self) -> None:
        """End all streams, and those that will be opened."""
        with self._lock:
            self._ended = True
        for stream in self.read():
            stream.end()

    def __len__(self) -> int:
        return len(self.read())


class LiveOdometry(EventInputs[None]):
    """`Odometry` with a queue and a worker: calls that add return at once, results come from the
    worker.

    Units, frames and clocks are those of `Odometry`; where no frame is left out, poses are the same
    to the bit. Samples and images may come from different threads, each in order of its own time.

    It is running, failed or closed (`state`). What the processing or a callback raises ends the
    worker: then every call that adds or waits raises it, and so do `predict`, the iterator and
    `close`. After `close`, calls that add or wait raise VioError. `latest`, `figures`, `warnings`
    and `calibrated_rig` answer in any state.
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
        copy_images: bool = True,
        sink: LiveSink | None = None,
    ) -> None:
        """Start the worker; the first frame begins the trajectory.

        Arguments that are not named here are those of `Odometry`; a map never makes a frame wait.

        Args:
            on_frame: called with the result of each frame, by the worker: what takes long in it
                delays the next frame.
            drop: what happens where `queue_frames` wait already: "oldest" leaves out the frame that
                has waited longest, so that latency is bounded; "none" leaves out none; "block"
                makes the call wait, for recordings.
            queue_frames: that may wait.
            keep_landmarks: of the points that do not change any more, how many are kept for
                `landmarks`, at least.
            copy_images: False: the caller does not write into an array again that it has added.
            sink: keeps the results, as `vio.runs.live_folder.LiveFolder`.

        Raises:
            VioError: as `Odometry`.
        """
        if drop not in DROPS or queue_frames < 1:
            raise ConfigError(
                f"drop={drop!r}, queue_frames={queue_frames}: give one of {', '.join(DROPS)}, and "
                "1 or more"
            )
        self._config = Config() if config is None else config
        use = MapUse(Path(map), localise) if isinstance(map, (str, Path)) else map
        self._odometry = odometry = Odometry(
            rig,
            self._config,
            T_cam0_imu=T_cam0_imu,
            parts=parts,
            on_frame=self._take_result,
            map=None if use is None else replace(use, wait=False),
        )
        self.camera = odometry.camera
        self.T_cam0_body = odometry.T_cam0_body
        self.motion = odometry.motion
        self.T_cam0_imu = odometry.T_cam0_imu
        self._on_frame = on_frame
        self._sink = sink
        self._with_map = use is not None
        self._predictor = SharedPredictor(self._config.imu.gravity_mps2)
        self._monitor = LiveMonitor(judges_latency=drop != "block")
        self._collector = QuietCollector()
        self._streams = _Streams()
        self._points: deque[Landmarks] = deque()  # that do not change any more
        self._keep_landmarks = keep_landmarks
        self._copies = copy_images
        self._lines: deque[str] = deque(maxlen=_MAX_LINES)
        self._worker = Worker(queue_frames, drop, finish=self._finish, close=self._let_go)

    def warm_up(self) -> None:
        """Process made-up images of the camera's size, so that the first frame takes no longer than
        others.

        Loops are compiled or loaded, the front end is built, memory is touched; this takes some
        seconds, on a new machine twenty. Of the caller's own parts, none is used.

        Raises:
            DataError: the camera's image size is not known.
        """
        self._worker.ask(self._warm_up)

    def _warm_up(self) -> None:
        warm_up(self.camera, self.T_cam0_imu, self._config, with_map=self._with_map)
        self._odometry.prepare()
        self._collector.hold()

    # What goes in

    @property
    def inputs(self) -> Inputs:
        """The checks of the present trajectory."""
        return self._odometry.inputs

    def take(self, given: GivenFrame | Sequence[MotionSample] | None) -> None:
        """Queue what was checked; predictions begin with samples at once.

        Raises:
            VioError: the worker has ended.
        """
        if isinstance(given, GivenFrame):
            self._monitor.arrived(given.time_ns)
            if self._sink is not None:
                self._sink.given(given.index, given.time_ns)
            self._monitor.queued(fits=self._worker.put(lambda: self._process(given), frame=True))
        elif given is not None:
            self._worker.put(lambda: self._process(given))
            for sample in given:
                if (usable := self._odometry.usable(sample)) is not None:
                    self._predictor.add(usable)

    def reset(self) -> None:
        """Forget all: the next frame begins a new trajectory in a new world frame; see
        `Odometry.reset`.

        Raises:
            ConfigError: parts of the caller's own were given.
        """
        self._worker.ask(self._reset)

    def _reset(self) -> None:
        self._end_trajectory(is_last=False)
        self._odometry.reset()
        for stream in self._streams.read():
            stream.reset()
        self._forget()
        self._collector.renew()

    def _forget(self) -> None:
        """Begin with an empty trajectory."""
        self._predictor = SharedPredictor(self._config.imu.gravity_mps2)
        self._points.clear()

    def close(self) -> None:
        """Process what waits, write the map, and end the worker; calling it again does nothing.

        Raises:
            Exception: what the worker ended with, where it failed.
        """
        self._worker.end(discard=False)
        self._worker.raise_failure()

    @property
    def state(self) -> WorkerState:
        """Whether the worker is running, has failed, or was closed."""
        return self._worker.state

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
        """Return the estimates from now on, for a thread of the caller's own; they end when the
        odometry is closed.
        """
        return self._streams.open(self._worker.raise_failure)

    def predict(self, t_ns: int) -> PredictedPose:
        """Return the pose at a time, from the estimates and all samples added; it waits for no
        frame.

        A time before the newest estimate, as of a reader that lags, is answered from what was
        known of the last seconds.

        Raises:
            DataError: there is no estimate yet, or the time is seconds before the newest one.
            Exception: what the worker failed with: no pose will come any more.
        """
        self._worker.raise_failure()
        return self._predictor.predict(checked_time(t_ns))

    @property
    def figures(self) -> LiveFigures:
        """How the odometry keeps up: latency, frames that were left out, frames that wait."""
        return self._monitor.figures(self._worker.frames)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the checks have found so far, and whether the computer falls behind, one line
        each.
        """
        return (*self._odometry.warnings, *self._lines)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the checks have found so far, with codes; see `vio.findings`."""
        return self._odometry.findings

    def landmarks(self) -> Landmarks:
        """Return the points of the map so far, of those that do not change any more the newest;
        waits for a frame.

        Raises:
            DataError: no frame has a pose yet.
        """
        return self._worker.ask(lambda: newest_points([*self._points, self._odometry.landmarks()]))

    def calibrated_rig(self) -> CalibratedRig:
        """Return the rig with what the estimate says that its calibration is off by, see
        `Odometry.calibrated_rig`.
        """
        return self._odometry.calibrated_rig()

    def __enter__(self) -> LiveOdometry:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close; where an error ended the block, without processing what waits."""
        if kind is None:
            self.close()
        else:
            self._worker.end(discard=True)

    # In the worker

    def _process(self, given: GivenFrame | Sequence[MotionSample]) -> None:
        """Process what was added; what only the odometry itself refuses is counted and logged."""
        if self._sink is not None and not isinstance(given, GivenFrame):
            self._sink.samples(given)
        try:
            self._odometry.take(given)
        except DataError as error:
            self._monitor.refused += 1
            self._say(str(error))
        if self._sink is not None:
            self._sink.corrections(self._odometry)
        self._predictor.catch_up()

    def _finish(self) -> None:
        """Process the frames that still wait."""
        self._odometry.finish()
        if self._sink is not None:
            self._sink.corrections(self._odometry)

    def _end_trajectory(self, *, is_last: bool) -> None:
        """Let the results so far be written."""
        if self._sink is not None:
            failure = self._worker.failure
            text = None if failure is None else str(failure)
            self._sink.end(self._odometry, failure=text, is_last=is_last)

    def _take_result(self, result: FrameResult) -> None:
        """Hand the result of a frame to all who wait for it."""
        self._predictor.add(result.estimate)
        line = self._monitor.result(result.frame.time_ns)
        if line is not None:
            self._say(line)
        for stream in self._streams.read():
            stream.put(result.estimate)
        if self._sink is not None:
            self._sink.frame(result, self._odometry)
        if self._on_frame is not None:
            try:
                self._on_frame(result)
            except BaseException as error:  # noqa: BLE001 # raised by the next call
                self._worker.fail(error)
        if self._monitor.results == 1:
            self._collector.hold()
        if self._monitor.results % _LANDMARK_FRAMES == 0:
            self._keep_points()

    def _keep_points(self) -> None:
        """Take the points that will not change any more from the filter, which would keep all of
        them.
        """
        settled = self._odometry.take_landmarks()
        self._points.append(settled)
        if self._sink is not None:
            self._sink.points(settled)
        while (
            sum(len(part.ids) for part in self._points) - len(self._points[0].ids)
            >= self._keep_landmarks
        ):
            self._points.popleft()

    def _let_go(self) -> None:
        """Write the map, and leave no iterator waiting."""
        try:
            self._end_trajectory(is_last=True)
            self._odometry.close()
        finally:
            self._collector.release()
            self._streams.end()

    def _say(self, line: str) -> None:
        log.warning("%s", line)
        self._lines.append(line)
