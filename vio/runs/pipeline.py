"""A whole recording through the pipeline: events in, front end, selector, filter, result out."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import field, replace
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from vio.calibration.stereo_field import CalibratedRig, estimated_rig
from vio.cameras.rig import Rig, rig_of_rectified
from vio.config import Config
from vio.dataclass import dataclass
from vio.datasets.features import FeatureDataset
from vio.datasets.frame_times import used_frames
from vio.errors import ConfigError, DataError, StoppedError, VioError
from vio.files.tables import Records
from vio.filters.settings import VislamSettings
from vio.findings import Finding
from vio.frontend import one_opencv_thread
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import StereoCamera
from vio.guard.repairing import AS_READ, Repair, repaired
from vio.live.build import (
    CONFIGURED,
    MapUse,
    Parts,
    build_processor,
    recorded_source,
    refuse_other_types,
)
from vio.live.processor import EventProcessor
from vio.numerics.threads import one_blas_thread
from vio.protocols import Dataset, Detector, Frontend, RectifyingDataset, Viewer
from vio.records import (
    STAGES,
    BodyFrame,
    Estimate,
    Event,
    FrameLog,
    FrameResult,
    ImuSample,
    Landmarks,
    MotionSample,
    MotionSource,
    Observations,
    Recording,
    StereoFrame,
    Trajectory,
)
from vio.runs.recorder import GrowingFolder, RunRecorder

if TYPE_CHECKING:
    from vio.mapping.session import MapSession
    from vio.runs.mapped import MappedRun

__all__ = ["STAGES", "FrameLog", "RunControl", "RunResult", "Viewers", "run"]

log = logging.getLogger(__name__)

_MAX_NAMED = 5  # frames that could not be read
# frames that the front end refused, and more of them than not, before a run gives up
_MIN_REFUSED = 10


@dataclass(frozen=True, slots=True)
class RunResult:
    """All that a run leaves behind."""

    recording: Recording
    config: Config
    motion: MotionSource | None  # what carried the pose between frames
    body: BodyFrame  # what the trajectory describes
    T_cam0_body: FloatArray  # (4, 4)
    estimates: Records[Estimate]
    dead_reckoning: Trajectory | None
    landmarks: Landmarks
    frames: Records[FrameLog]
    observations: Sequence[Observations] | None  # kept on request
    motion_samples: Sequence[MotionSample] | None  # kept on request
    findings: tuple[Finding, ...]  # what went wrong in the run, or with its IMU
    wall_s: float
    stopped: str | None = None  # why the run ended before the recording; None: it did not
    rig: Rig | None = None  # the calibration as given; None: features without an image size
    repair: Repair = AS_READ  # what the run put right of the recording's images
    mapped: MappedRun | None = None  # where a map was built or used
    # standard deviation that motion sensor and field of disparities add to what the settings state
    # of the scale, over it
    scale_doubt: float = 0.0

    def calibrated_rig(self) -> CalibratedRig | None:
        """Return the calibration with what the run found it to be off by; None: features without an
        image size.

        On a cylinder left and right stay as given: its rectification error is not expressed as a
        rig.

        Raises:
            CalibrationError: no rig of the given lens models is off as the run found it.
        """
        if self.rig is None:
            return None
        recording = self.recording
        given = self.rig
        if self.repair.readout_s:
            given = replace(given, readout_s=self.repair.readout_s)
        found = estimated_rig(given, self.estimates[-1], recording.camera, str(recording.path))
        turn = self.repair.turn
        if turn is None:
            return found
        return found.with_turned(np.array(turn), given)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What went wrong in the run, or with its IMU, one line each."""
        return tuple(finding.message for finding in self.findings)

    @property
    def trajectory(self) -> Trajectory:
        """The estimated poses of the body, one per frame."""
        T_world_body, times_ns, indices = (
            np.array(self.estimates.column(name)) for name in ("T_world_imu", "time_ns", "index")
        )
        return Trajectory(
            T_world_body=T_world_body, times_ns=times_ns, body=self.body, frame_indices=indices
        )


class Viewers:
    """Several viewers as one."""

    def __init__(self, viewers: Sequence[Viewer]) -> None:
        self._viewers = viewers

    def frame(self, result: FrameResult) -> None:
        """Show one frame."""
        for viewer in self._viewers:
            viewer.frame(result)

    def skip(self, frames: int) -> None:
        """Count frames that an earlier process has done, in the viewers that count."""
        for viewer in self._viewers:
            skip = getattr(viewer, "skip", None)
            if skip is not None:
                skip(frames)

    def close(self) -> None:
        """Close all, whatever happens to one of them."""
        with contextlib.ExitStack() as stack:
            for viewer in self._viewers:
                stack.callback(viewer.close)


@dataclass(frozen=True, slots=True)
class RunControl:
    """Where a run is written while it goes on, and what may end it."""

    folder: GrowingFolder | None = None  # None: everything stays in memory
    resume: bool = False  # go on from the checkpoint in the folder
    # asked after each frame; a reason ends the run in order
    should_stop: Callable[[], str | None] = lambda: None


_TO_THE_END = RunControl()


@one_blas_thread()
def run(
    dataset: Dataset,
    config: Config,
    *,
    start: int = 0,
    stop: int | None = None,
    keep_observations: bool = False,
    viewer: Viewer | None = None,
    parts: Parts = CONFIGURED,
    map: MapUse | None = None,
    control: RunControl = _TO_THE_END,
) -> RunResult:
    """Process a recording from its frame `start` to before frame `stop`, with BLAS pinned to one
    thread meanwhile.

    Args:
        dataset: the recording.
        config: every setting.
        start: first frame.
        stop: frame after the last one; None: to the end.
        keep_observations: keep what the front end gave, for writing an observation log.
        viewer: watches each frame.
        parts: front end, selector or back end in place of the configured ones.
        map: a map to begin, to continue or to be localised in; on resuming, the same.
        control: where the run is written while it goes on, and what may end it.

    Raises:
        VioError: the configuration, the data or the estimation is at fault; the message says which.
            With a folder, a fault after the first frame ends the run in order instead, and the
            result names it.
        TypeError: a path is given in the place of the recording, a dictionary for the settings, or
            a name for a part, a map or a folder.
    """
    refuse_other_types(config, dataset=dataset)
    _check_arguments(parts, map, control)
    _check_range(dataset.recording, start, stop)
    with contextlib.closing(Viewers(() if viewer is None else (viewer,))) as shown:
        what = _Run(dataset, config, start, stop, keep_observations, shown, parts, map, control)
        repair = AS_READ
        while True:  # each time something else is put right
            try:
                return what.process(repair)
            except _BeginAgainError as found:
                repair = found.repair
                if found.others:
                    log.warning("warnings so far are of images that are put right now; forget them")


def _check_arguments(parts: object, map_use: object, control: object) -> None:
    """Raise TypeError where a name, a path or a class is given in the place of an argument."""
    folder = control.folder if isinstance(control, RunControl) else None
    for name, value, wanted, call in (
        ("parts", parts, Parts, "vio.Parts(…)"),
        ("map", map_use, MapUse | None, "vio.MapUse(…)"),
        ("control", control, RunControl, "vio.RunControl(…)"),
        ("folder", folder, GrowingFolder | None, "vio.runs.recorder.GrowingFolder(path, {})"),
    ):
        if not isinstance(value, wanted):
            raise TypeError(f"{name}: give {call}, not {type(value).__name__}")


class _BeginAgainError(Exception):
    """The first frames show what is wrong with all images."""

    def __init__(self, repair: Repair, others: int) -> None:
        super().__init__(f"images are put right: {repair}")
        self.repair = repair
        self.others = others  # findings so far, beside those on what is put right


@dataclass(frozen=True, slots=True)
class _Run:
    """The arguments of `run`."""

    dataset: Dataset
    config: Config
    start: int
    stop: int | None
    keep_observations: bool
    shown: Viewers
    parts: Parts
    map: MapUse | None
    control: RunControl

    @property
    def can_begin_again(self) -> bool:
        """Whether all parts can be built anew, and nothing outside of the run has seen a frame."""
        return self.parts == CONFIGURED and self.map is None and not self.control.resume

    def process(self, repair: Repair) -> RunResult:
        """Process the recording, its images put right."""
        return _process(self, repair)


def _process(what: _Run, repair: Repair) -> RunResult:
    """Process a recording; see `run`.

    Raises:
        _BeginAgainError: the run is to begin again with images put right.
    """
    dataset = what.dataset
    config = what.config
    start = what.start
    stop = what.stop
    shown = what.shown
    parts = what.parts
    map = what.map
    control = what.control
    recording = dataset.recording
    folder = control.folder
    source = recorded_source(dataset, config)
    source = replace(source, right_delay=repair.delay, readout_s=repair.readout_s)
    body: BodyFrame = "cam0" if recording.T_cam0_imu is None else "imu"
    began = time.perf_counter()
    recorder = RunRecorder(
        body, lag_frames=config.lag_frames, keep_observations=what.keep_observations, folder=folder
    )
    features = source.features or dataset
    if control.resume:
        state = recorder.restore(features)
        _reopen_map(state.processor.map, map)
        shown.skip(len(recorder))
    else:
        reckoned = source.motion == "velocity"
        state = _RunState(
            build_processor(source, config, parts, map),
            DeadReckoning(source.camera, source.T_cam0_body, config.vislam) if reckoned else None,
            start,
            repair=repair,
        )
    processor = state.processor
    monitor = processor.pipeline.monitor
    if not control.resume:
        for code, line in repair.lines():
            monitor.say(line, code)
        monitor.repair = repair
    monitor.ends_at_repair = what.can_begin_again
    stopped = None
    with contextlib.closing(recorder), contextlib.closing(processor):
        taken = _taken_frames(dataset, config, start, stop)
        # these lack the images that come with later ones
        taken -= set(sorted(taken)[len(taken) - abs(state.repair.delay) :])
        loop = _Loop(state, recorder, shown, taken)
        try:
            with _opencv_threads(dataset, config, parts.frontend):
                images = _needs_images(dataset, config) or processor.map is not None
                events = dataset.events(state.next_frame, stop, images=images)
                events = repaired(events, state.repair, source.camera)
                stopped = loop.run(events, features, control.should_stop)
        except VioError as error:
            if folder is None or not len(recorder):
                raise
            stopped = str(error)
        if not len(recorder):
            _nothing_done(recording, processor, stopped)
        reckoned = state.dead_reckoning is not None
        session = processor.map
        dead_reckoning = None
        if reckoned:
            dead_reckoning = _dead_reckoned(recorder, body)
        mapped = None
        if session is not None:
            mapped = _mapped(session, recorder)
        return RunResult(
            recording=recording,
            config=config,
            motion=source.motion,
            body=body,
            T_cam0_body=source.T_cam0_body,
            estimates=recorder.estimates,
            dead_reckoning=dead_reckoning,
            landmarks=recorder.landmarks(processor.pipeline.backend.landmarks()),
            frames=recorder.frames,
            observations=recorder.observations,
            motion_samples=recorder.samples,
            findings=tuple(processor.pipeline.monitor.findings),
            wall_s=time.perf_counter() - began,
            stopped=stopped,
            rig=given_rig(dataset),
            repair=state.repair,
            mapped=mapped,
            scale_doubt=recorder.scale_doubt,
        )


def _mapped(session: MapSession, recorder: RunRecorder) -> MappedRun:
    """Return what a run has made of its map."""
    from vio.runs.mapped import mapped_run

    return mapped_run(session, recorder.estimates, recorder.mapped)


def given_rig(dataset: Dataset) -> Rig | None:
    """Return the calibration of a recording's images; None: it holds features, and no image size or
    a cylinder.

    For features it is that of the rectified images that they come from.
    """
    recording = dataset.recording
    stereo = recording.camera.kind == "stereo"
    if not (stereo and isinstance(dataset, RectifyingDataset)) or dataset.rectifier.maps is None:
        return rig_of_rectified(recording.camera, recording.T_cam0_imu)
    made = dataset.rectifier
    T_cam0_imu = recording.T_cam0_imu
    rig = made.rig
    if T_cam0_imu is not None:
        T_cam0_imu = se3_inverse(rig.T_imu_cam0)
    return Rig(
        rig.cam0,
        rig.cam1,
        se3_inverse(rig.T_cam0_cam1),
        T_cam0_imu,
        dataset.imu_noise,
        made.time_offset_s,
    )


def _reopen_map(session: MapSession | None, use: MapUse | None) -> None:
    """Give a restored session its map's file; the checkpoint itself names no file."""
    if (session is None) != (use is None):
        raise ConfigError(
            f"the run began {'without' if session is None else 'with'} a map; go on in the same way"
        )
    if session is not None and use is not None:
        session.reopen(use.path)


def _nothing_done(recording: Recording, processor: EventProcessor, stopped: str | None) -> NoReturn:
    """Say why a run has no frame."""
    if stopped is not None:
        raise StoppedError(
            f"{stopped} before the first frame was done; nothing was written", status=130
        )
    if waiting := processor.pipeline.monitor.frames_waiting:
        waited = f"none of the {waiting} frames has a pose"
        raise DataError(f"{recording.path}: {waited}; see the warnings above")
    raise DataError(f"{recording.path}: no frame could be read; see the warnings above")


@dataclass(slots=True)
class _RunState:
    """What a checkpoint holds of a run."""

    processor: EventProcessor
    dead_reckoning: DeadReckoning | None
    # where to take up the recording's events: the last frame taken, or the first one
    next_frame: int
    frame_ns: int | None = None  # newest time of a frame that was taken
    # numbers of frames that the recording lists and did not give
    unread: list[int] = field(default_factory=list)
    sample_ns: int | None = None  # newest time of a motion sample that was taken
    repair: Repair = AS_READ  # of the recording's images

    def not_taken(self, events: Iterable[Event]) -> Iterator[Event]:
        """Yield the events of a recording that is read again which were not taken before."""
        for event in events:
            if isinstance(event, StereoFrame):
                known = self.frame_ns
            else:
                known = self.sample_ns
            if known is None or event.time_ns > known:
                yield event


@dataclass(frozen=True, slots=True)
class _Read:
    """Events that a recording has given."""

    samples: list[MotionSample]
    frame: StereoFrame | None  # after them; None: at the end
    ms: float  # for which they were waited


def _read(events: Iterable[Event]) -> Iterator[_Read]:
    """Yield each frame with the samples since the one before it."""
    samples: list[MotionSample] = []
    start = time.perf_counter()
    for event in events:
        if type(event) is ImuSample or not isinstance(event, StereoFrame):
            samples.append(event)
        else:
            yield _Read(samples, event, 1e3 * (time.perf_counter() - start))
            samples = []
            start = time.perf_counter()
    yield _Read(samples, None, 1e3 * (time.perf_counter() - start))


class _Loop:
    """Takes a recording's events through the processor into the recorder."""

    def __init__(
        self,
        state: _RunState,
        recorder: RunRecorder,
        viewer: Viewer,
        frames: set[int],
    ) -> None:
        """Prepare.

        Args:
            state: of the run, new or of a checkpoint.
            recorder: takes the results.
            viewer: watches each frame.
            frames: numbers of the recording's frames that the run is to take.
        """
        self._state = state
        self._recorder = recorder
        self._viewer = viewer
        self._frames = frames
        self._end = 1 + max(frames, default=-1)
        self._read_ms = 0.0  # that the recording took to give its events since the last result

    def run(
        self, events: Iterable[Event], dataset: Dataset, should_stop: Callable[[], str | None]
    ) -> str | None:
        """Take events to their end; return why they ended before."""
        state = self._state
        recorder = self._recorder
        processor = self._state.processor
        monitor = processor.pipeline.monitor
        stopped = None
        resumed = state.frame_ns is not None
        for read in _read(state.not_taken(events) if resumed else events):
            if read.samples:
                self._take_samples(read.samples)
            self._read_ms += read.ms
            if read.frame is not None and read.frame.index in self._frames:
                self._take_frame(read.frame)
            if _MIN_REFUSED <= monitor.frames_refused > len(recorder):
                break
            stopped = should_stop()
            if recorder.is_save_due or (stopped and recorder.can_save):
                recorder.save(state, dataset, processor.pipeline.backend.take_landmarks())
            if stopped:
                break
        else:
            if state.frame_ns is not None:
                state.unread += self._between(state.next_frame + 1, self._end)
        if state.unread:
            last = max(state.next_frame, *state.unread)
            line = _unread_line(state.unread, sum(index <= last for index in self._frames))
            monitor.say(line, "frames-unread")
        self._record(processor.finish())
        recorder.revise(processor.pipeline.backend.smoothed)
        if monitor.frames_refused > len(recorder):
            raise DataError(f"most frames were refused: {monitor.refusal}")
        return stopped

    def _between(self, first: int, end: int) -> list[int]:
        """Frames `first <= index < end` that the run is to take."""
        return [index for index in range(first, end) if index in self._frames]

    def _take_samples(self, samples: list[MotionSample]) -> None:
        state = self._state
        self._recorder.take_samples(samples)
        self._take_results(state.processor.add_samples(samples))
        if state.dead_reckoning is not None:
            for sample in samples:
                state.dead_reckoning.add(sample)
        state.sample_ns = samples[-1].time_ns

    def _take_frame(self, frame: StereoFrame) -> None:
        state = self._state
        begun = state.frame_ns is not None
        state.unread += self._between(state.next_frame + begun, frame.index)
        self._take_results(state.processor.add(frame))
        state.frame_ns = frame.time_ns
        state.next_frame = frame.index

    def _take_results(self, results: list[FrameResult]) -> None:
        monitor = self._state.processor.pipeline.monitor
        if monitor.ends_at_repair and monitor.repair != self._state.repair:
            known = len(self._state.repair.lines()) + 1
            raise _BeginAgainError(monitor.repair, len(monitor.findings) - known)
        if results:
            self._record(results)

    def _record(self, results: list[FrameResult]) -> None:
        state = self._state
        for result in results:
            self._recorder.frame(result, self._read_ms, state.processor.pipeline.backend.smoothed)
            self._read_ms = 0.0
            if state.dead_reckoning is not None:
                self._recorder.dead_reckoning(state.dead_reckoning.pose_at(result.log.time_ns))
            self._viewer.frame(result)
        self._recorder.replace(state.processor.pipeline.take_revised())
        self._recorder.mark(state.processor.pipeline.monitor.take_marks())


def _check_range(recording: Recording, start: int, stop: int | None) -> None:
    """Raise ConfigError where a range of frames is empty, or its ends are no whole numbers."""
    for end in (start, stop):
        if end is not None and not isinstance(end, int | np.integer):
            raise ConfigError(f"start and stop are numbers of frames, not {end!r}")
    if start < 0 or (stop is not None and stop <= start):
        last = "the last one" if stop is None else stop
        raise ConfigError(f"frames {start} to {last} are no range; give 0 <= start < stop")
    if start >= len(recording.frame_times_ns):
        raise ConfigError(
            f"--start {start} lies past the last frame, {len(recording.frame_times_ns) - 1}"
        )


def _taken_frames(dataset: Dataset, config: Config, start: int, stop: int | None) -> set[int]:
    """Numbers of the frames of a recording that a run is to take; of features, those that the
    recording has.
    """
    most_hz = config.dataset.max_frame_rate
    times_ns = dataset.recording.frame_times_ns
    if most_hz is None:
        indices = range(len(times_ns))
    else:
        indices = used_frames(times_ns, most_hz).tolist()
    present = (
        range(len(times_ns))
        if not isinstance(dataset, FeatureDataset)
        else set(dataset.present.tolist())
    )
    return {
        index
        for index in indices
        if index >= start and (stop is None or index < stop) and index in present
    }


def _unread_line(unread: list[int], frames: int) -> str:
    """The line on frames that could not be read."""
    named = ", ".join(map(str, unread[:_MAX_NAMED])) + (", …" if len(unread) > _MAX_NAMED else "")
    return f"{len(unread)} of {frames} frames could not be read and were skipped: {named}"


def _opencv_threads(
    dataset: Dataset, config: Config, given: Frontend | Detector | None
) -> AbstractContextManager[None]:
    """Limit OpenCV to one thread where the front end is `klt`, whose steps are too short for
    more.
    """
    if (
        given is not None
        or config.frontend.name not in ("auto", "klt")
        or not _needs_images(dataset, config)
    ):
        return contextlib.nullcontext()
    return one_opencv_thread()


def _needs_images(dataset: Dataset, config: Config) -> bool:
    front = config.frontend
    return dataset.recording.has_images and front.name != "precomputed" and front.features is None


def _dead_reckoned(rows: RunRecorder, body: BodyFrame) -> Trajectory:
    """Return the poses by dead reckoning of the frames with an estimate; a run that an error
    ends may have one less.
    """
    T = rows.dead_reckoned()
    times_ns, indices = (
        np.asarray(rows.estimates.column(name))[: len(T)] for name in ("time_ns", "index")
    )
    return Trajectory(T, times_ns, body, indices)


class DeadReckoning:
    """The paper's filter without its updates."""

    def __init__(
        self, camera: StereoCamera, T_cam0_body: FloatArray, settings: VislamSettings
    ) -> None:
        settings = replace(settings, mode="dead_reckoning", motion_model="input")
        from vio.filters.vislam import Vislam

        self._filter = Vislam(camera, T_cam0_body, settings, motion_sensor=True)
        self._begun = False

    def add(self, sample: MotionSample) -> None:
        """Take a motion sample."""
        self._filter.propagate(sample)
        self._begun = True

    def pose_at(self, time_ns: int) -> FloatArray:
        """The pose (4, 4) of the body at a frame, which may not be older than the last one."""
        if not self._begun:  # at its start, as velocities may begin after the images
            return np.eye(4)
        self._filter.advance(time_ns)
        return self._filter.estimate().T_world_imu
