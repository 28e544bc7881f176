"""The run folder of a live odometry: what a file's run keeps, written while the robot moves.

A thread of its own writes. Of a process that dies, all but the last second can be read, and
`vio run --resume FOLDER` writes the other results, as of the last checkpoint.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.cameras.rig import Rig
from vio.config import Config, load_config
from vio.errors import NOTE, CalibrationError, DataError
from vio.files.atomic import atomic_write_text, check_writable, locked_folder
from vio.findings import Finding
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.live.odometry import Odometry
from vio.monitor.integrity import Mark
from vio.numerics.kinds import Capacity
from vio.records import (
    BodyFrame,
    Estimate,
    Event,
    FrameResult,
    IntArray,
    Landmarks,
    MotionSample,
    MotionSource,
    Observations,
    Recording,
    no_landmarks,
)
from vio.runs.files import CHECKPOINT, RunFile
from vio.runs.folder import Finishing, calibration_text, finish_run_folder, growing_folder
from vio.runs.mapped import MappedRun, mapped_run
from vio.runs.pipeline import RunResult
from vio.runs.recorder import GrowingFolder, RunRecorder
from vio.runs.stated import RunRequest

log = logging.getLogger(__name__)

# Results and samples that wait for the disk, some twenty seconds of them; where a disk stalls for
# longer, the writing ends, and the odometry goes on.
_MAX_WAITING: Capacity[int] = 5000
_LIVE = "live:"  # how the source of a live run begins in what its folder was asked for


@dataclass(frozen=True, slots=True)
class LiveRunSettings:
    """What is kept of a live run, and how it is named."""

    out: Path  # its folder; where that holds something, the first free of OUT-2, OUT-3, …
    source: str  # camera or topics, for people
    save_observations: bool = False  # also write the log of observations
    waits: bool = False  # let the odometry wait for a slow disk: nothing moves meanwhile
    command: str | None = None  # that began it


@dataclass(frozen=True, slots=True)
class LiveRecording:
    """A live source in the place of a recording: there are no events to read again."""

    recording: Recording

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        """Yield nothing."""
        return iter(())

    def observations(self, index: int) -> Observations | None:
        """Return None: it has no features of its own."""
        return None


class LiveFolder:
    """Keeps the results of a live odometry as a file's run keeps them; see `LiveSink`.

    Each trajectory has a folder of its own. What the disk refuses ends the writing, with a warning;
    the odometry goes on, and `close` raises it.
    """

    def __init__(self, settings: LiveRunSettings, config: Config, rig: Rig) -> None:
        """Check that the folder can be written; it is made with the first result.

        Args:
            settings: what is kept.
            config: that of the odometry.
            rig: the calibration as given.

        Raises:
            DataError: it cannot be written.
        """
        if settings.out.exists() and not settings.out.is_dir():
            raise DataError(f"{settings.out}: is a file; --out takes a folder")
        check_writable(settings.out)
        self._settings = settings
        self._config = config
        self._rig = rig
        self._failure: Exception | None = None
        self._calls: queue.Queue[Callable[[], None] | None] = queue.Queue(_MAX_WAITING)
        # frames whose estimates the lag may still replace
        self._recent: deque[int] = deque(maxlen=config.lag_frames)
        self._begin()
        self._thread = threading.Thread(target=self._run, name="run folder", daemon=True)
        self._thread.start()

    def _begin(self) -> None:
        """Be ready for a trajectory."""
        self._trajectory = _Trajectory(self._settings, self._config, self._rig)
        self._has_poses = False
        self._recent.clear()

    # What the odometry gives

    def given(self, index: int, time_ns: int) -> None:
        """Note the time of a frame."""
        self._trajectory.times_ns[index] = time_ns

    def samples(self, samples: Sequence[MotionSample]) -> None:
        """Take motion samples, which the log of observations has."""
        if self._settings.save_observations:
            self._do(functools.partial(self._trajectory.samples, tuple(samples)))

    def frame(self, result: FrameResult, odometry: Odometry) -> None:
        """Take the result of a frame."""
        # a frame that was given before a reset is another trajectory's there
        self._trajectory.times_ns[result.log.index] = result.log.time_ns
        late: dict[int, Estimate] = {}
        if self._recent and len(self._recent) == self._recent.maxlen:
            late = _smoothed(odometry, [self._recent[0]])
        self._recent.append(result.log.index)
        if not self._has_poses:
            self._has_poses = True
            self._do(functools.partial(self._trajectory.begin, odometry))
        frame = replace(result.frame, left=None, right=None, depth=None)
        kept = replace(result, frame=frame)
        findings = odometry.findings
        self._do(functools.partial(self._trajectory.frame, kept, late, findings))

    def corrections(self, odometry: Odometry) -> None:
        """Take what has changed of earlier frames."""
        revised, marks = odometry.take_corrections()
        if self._has_poses and (revised or marks):
            self._do(functools.partial(self._trajectory.correct, revised, marks))

    def points(self, points: Landmarks) -> None:
        """Take points of the map that will not change any more."""
        if self._has_poses:
            self._do(functools.partial(self._trajectory.put_away, points))

    def end(self, odometry: Odometry, *, failure: str | None, is_last: bool) -> None:
        """Write all results of the trajectory, and be ready for another; the picture only of the
        last one, as drawing takes a second.
        """
        trajectory = self._trajectory
        late = _smoothed(odometry, self._recent)
        had_poses = self._has_poses
        self._begin()
        if not had_poses:
            return
        self._do(functools.partial(trajectory.settle, late))
        mapped = None
        if odometry.map_session is not None:
            self._calls.join()
            if self._failure is None:
                mapped = trajectory.mapped(odometry)
        end = _End(odometry.findings, odometry.landmarks(), mapped, failure)
        self._do(functools.partial(trajectory.finish, end, plot=is_last))

    # What its owner asks

    @property
    def has_poses(self) -> bool:
        """Whether the present trajectory has a pose."""
        return self._has_poses

    def save(self) -> None:
        """Bring what is known so far to the disk."""
        if self._has_poses:
            self._do(self._trajectory.flush)

    def close(self) -> None:
        """Wait until all is written, after the odometry was closed.

        Raises:
            Exception: what writing has failed with.
        """
        self._calls.put(None)
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    # How

    def _do(self, call: Callable[[], None]) -> None:
        """Let the thread make a call."""
        if self._failure is not None:
            return
        try:
            self._calls.put(call, block=self._settings.waits)
        except queue.Full:
            self._fail(DataError(f"{self._settings.out}: the disk is too slow; use another one"))

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            if self._failure is None:
                try:
                    call()
                except Exception as error:  # noqa: BLE001 # raised by `close`
                    self._fail(error)
            self._calls.task_done()

    def _fail(self, error: Exception) -> None:
        if self._failure is None:
            self._failure = error
            log.warning("%s; nothing more is written, the odometry goes on", error)


@dataclass(frozen=True, slots=True)
class _End:
    """What is known at the end of a trajectory alone."""

    findings: tuple[Finding, ...]
    landmarks: Landmarks
    mapped: MappedRun | None
    failure: str | None


@dataclass(frozen=True, slots=True)
class _LiveState:
    """What a checkpoint holds of a live run beside its tables."""

    source: str
    camera: StereoCamera  # rectified
    T_cam0_imu: FloatArray | None  # (4, 4); None: the body is the left camera
    motion: MotionSource | None
    rig: Rig  # the calibration as given
    frame_times_ns: IntArray  # (F,) of all frames that were given
    findings: tuple[Finding, ...]
    wall_s: float

    @property
    def recording(self) -> Recording:
        """The run's source as a recording."""
        motion: frozenset[MotionSource] = frozenset(() if self.motion is None else (self.motion,))
        return Recording(
            kind="live",
            path=Path(self.source),
            camera=self.camera,
            T_cam0_imu=self.T_cam0_imu,
            frame_times_ns=self.frame_times_ns,
            has_images=True,
            motion=motion,
            reference=None,
        )

    @property
    def body(self) -> BodyFrame:
        """Whose poses are estimated."""
        return "cam0" if self.T_cam0_imu is None else "imu"


class _Trajectory:
    """One trajectory in its folder. Its methods are called by the thread that writes."""

    def __init__(self, settings: LiveRunSettings, config: Config, rig: Rig) -> None:
        self.times_ns: dict[int, int] = {}  # of all frames that were given, by number
        self._settings = settings
        self._config = config
        self._rig = rig
        self._began_s = time.monotonic()
        self._early: list[MotionSample] = []  # before the first pose
        self._lock = contextlib.ExitStack()
        self._folder = settings.out
        self._recorder: RunRecorder | None = None

    def begin(self, odometry: Odometry) -> None:
        """Make the folder."""
        settings = self._settings
        self._folder = _free_folder(settings.out)
        self._lock.enter_context(locked_folder(self._folder))
        request = RunRequest(
            source=f"{_LIVE}{settings.source}",
            reference=None,
            start=0,
            stop=None,
            lengths_m=None,
            save_observations=settings.save_observations,
            command=settings.command,
        )
        self._state = _LiveState(
            source=settings.source,
            camera=odometry.camera,
            T_cam0_imu=odometry.T_cam0_imu,
            motion=odometry.motion,
            rig=self._rig,
            frame_times_ns=np.zeros(0, dtype=np.int64),
            findings=(),
            wall_s=0.0,
        )
        source = LiveRecording(self._state.recording)
        growing = growing_folder(self._folder, source, self._config, request.values())
        # there is no recording that could have changed since
        growing = replace(growing, replaces=(), inputs={})
        keeps = settings.save_observations
        self._recorder = _recorder(growing, self._state.body, self._config, keeps=keeps)
        self._recorder.take_samples(self._early)
        self._early = []

    @property
    def recorder(self) -> RunRecorder:
        """What it is recorded by; there is one after the first pose."""
        assert self._recorder is not None
        return self._recorder

    def samples(self, samples: Sequence[MotionSample]) -> None:
        """Take motion samples."""
        if self._recorder is None:
            self._early += samples
            return
        self._recorder.take_samples(samples)

    def frame(
        self, result: FrameResult, late: Mapping[int, Estimate], findings: tuple[Finding, ...]
    ) -> None:
        """Take the result of a frame, and the smoothed estimate of the one that leaves the lag."""
        self.recorder.frame(result, 0.0, late.get)
        if self.recorder.is_save_due:
            state = self._stated(findings, result.log.index)
            self.recorder.save(state, LiveRecording(state.recording), no_landmarks())

    def correct(self, revised: Mapping[int, Estimate], marks: Sequence[Mark]) -> None:
        """Replace and mark estimates of earlier frames."""
        self.recorder.replace(revised)
        self.recorder.mark(marks)

    def put_away(self, points: Landmarks) -> None:
        """Take points of the map that will not change any more."""
        self.recorder.put_away(points)

    def flush(self) -> None:
        """Bring the trajectory so far to the disk."""
        self.recorder.flush()

    def settle(self, late: Mapping[int, Estimate]) -> None:
        """Take the last smoothed estimates."""
        self.recorder.revise(late.get)

    def mapped(self, odometry: Odometry) -> MappedRun | None:
        """Return what the map made of the trajectory; called by the odometry's worker, while
        nothing is written.
        """
        session = odometry.map_session
        if session is None:
            return None
        return mapped_run(session, self.recorder.estimates, self.recorder.mapped)

    def finish(self, end: _End, *, plot: bool) -> None:
        """Write all results, and let the folder go."""
        last = int(self.recorder.frames[-1].index)
        state = self._stated(end.findings, last)
        settings = self._settings
        with self._lock:
            result = _result(self._config, state, self.recorder, end)
            self.recorder.close()
            _write(self._folder, result, settings.save_observations, settings.command, plot=plot)
        log.log(NOTE, "the results are in %s", self._folder)

    def _stated(self, findings: tuple[Finding, ...], last: int) -> _LiveState:
        """Return what is known beside the tables, up to the frame of a number."""
        return replace(
            self._state,
            frame_times_ns=_times_ns(self.times_ns, last),
            findings=findings,
            wall_s=time.monotonic() - self._began_s,
        )


def _times_ns(known: Mapping[int, int], last: int) -> IntArray:
    """Return the times of the frames up to a number; of one that was given to the trajectory
    before a reset, the time between its neighbours.
    """
    found = [(k, t) for k in range(last + 1) if (t := known.get(k)) is not None]
    numbers = [k for k, _ in found]
    first_ns = found[0][1]
    since_ns = np.interp(np.arange(last + 1), numbers, [t - first_ns for _, t in found])
    return first_ns + np.rint(since_ns).astype(np.int64)


def is_live(request: RunRequest) -> bool:
    """Return whether what a folder was asked for is a live run."""
    return request.source.startswith(_LIVE)


def finish_live_folder(folder: Path, request: RunRequest) -> dict[str, Any]:
    """Write all results of a live run whose process died, up to its last checkpoint, and return
    the metrics.

    Raises:
        DataError: it died before its first checkpoint, or a file is damaged.
    """
    config = load_config(folder / RunFile.CONFIG)
    keeps = request.save_observations
    if not (folder / RunFile.UNFINISHED / CHECKPOINT).is_file():
        raise DataError(
            f"{folder}: its program ended within seconds; {RunFile.TRAJECTORY} and "
            f"{RunFile.FRAMES} are all that is known"
        )
    with locked_folder(folder), _named_damage(folder):
        recorder = _recorder(GrowingFolder(folder, {}), "imu", config, keeps=keeps)
        with contextlib.closing(recorder):
            state = recorder.restore(None)
            if not isinstance(state, _LiveState):
                raise TypeError("its checkpoint is of another run")
            end = _End(state.findings, no_landmarks(), None, "the program was ended")
            result = _result(config, state, recorder, end)
        return _write(folder, result, keeps, request.command, plot=True)


@contextlib.contextmanager
def _named_damage(folder: Path) -> Iterator[None]:
    """Name what the parts of a checkpoint raise that are not what they were, as someone changed
    them and its checksum.
    """
    try:
        yield
    except (AttributeError, TypeError, ValueError, LookupError, ArithmeticError) as error:
        raise DataError(f"{folder}: its checkpoint is damaged ({error})") from error


def _recorder(
    folder: GrowingFolder, body: BodyFrame, config: Config, *, keeps: bool
) -> RunRecorder:
    return RunRecorder(body, lag_frames=config.lag_frames, keep_observations=keeps, folder=folder)


def _result(config: Config, state: _LiveState, recorder: RunRecorder, end: _End) -> RunResult:
    """Return what a live run leaves behind, as that of a recording."""
    recording = state.recording
    return RunResult(
        recording=recording,
        config=config,
        motion=state.motion,
        body=state.body,
        T_cam0_body=recording.T_cam0_body,
        estimates=recorder.estimates,
        dead_reckoning=None,
        landmarks=recorder.landmarks(end.landmarks),
        frames=recorder.frames,
        observations=recorder.observations,
        motion_samples=recorder.samples,
        findings=end.findings,
        wall_s=state.wall_s,
        stopped=end.failure,
        rig=state.rig,
        mapped=end.mapped,
        scale_doubt=recorder.scale_doubt,
    )


def _write(
    folder: Path, result: RunResult, save_observations: bool, command: str | None, *, plot: bool
) -> dict[str, Any]:
    """Write all results, with the calibration as it was found, and return the metrics."""
    file = folder / RunFile.CALIBRATION
    text = None
    try:
        text = calibration_text(result)
    except CalibrationError as error:
        log.warning("no calibration was saved: %s", error)

    def finished(_: dict[str, Any]) -> None:
        if text is not None:
            atomic_write_text(file, text)

    more = {"command": command, "calibration": None if text is None else str(file.absolute())}
    how = Finishing(None, save_observations, more, plot, finished)
    return finish_run_folder(folder, result, None, how)


def _smoothed(odometry: Odometry, frames: Iterable[int]) -> dict[int, Estimate]:
    """Return the estimates of past frames with all frames since, of those that are known."""
    found = ((index, odometry.smoothed(index)) for index in frames)
    return {index: estimate for index, estimate in found if estimate is not None}


def _free_folder(out: Path) -> Path:
    """Return the first of OUT, OUT-2, … that is missing or empty."""
    names = (out if n == 1 else out.with_name(f"{out.name}-{n}") for n in itertools.count(1))
    return next(name for name in names if not name.exists() or _is_empty(name))


def _is_empty(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())
