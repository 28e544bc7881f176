"""A whole recording through the chain: events in, front end, selector, filter, result out."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from vio.calibration.estimated_rig import estimated_rig
from vio.calibration.stereo_field import CalibratedRig
from vio.live.chain import BACKENDS, build_backend
from vio.config import BackendName, Config
from vio.errors import ConfigError, DataError, StoppedError, VioError
from vio.filters.vislam import Vislam
from vio.datasets.frame_rate import used_frames
from vio.records import STAGES, FrameLog, FrameResult
from vio.frontend import build_frontend, one_opencv_thread
from vio.geometry.lie import FloatArray, se3_inverse
from vio.runs.mapped import MappedRun, mapped_run
from vio.live.odometry import Odometry, rig_of_rectified
from vio.protocols import Backend, Dataset, Frontend, RectifyingDataset, Selector, Viewer
from vio.records import (
    BodyFrame,
    Estimate,
    Event,
    Landmarks,
    MotionSample,
    MotionSource,
    Observations,
    Recording,
    StereoFrame,
    Trajectory,
    need_stereo,
)
from vio.cameras.rig import Rig
from vio.runs.recorder import GrowingFolder, RunRecorder
from vio.selection.selectors import build_selector
from vio.files.tables import Records
from vio.numerics.threads import one_blas_thread

if TYPE_CHECKING:
    from vio.mapping.session import MapSession

log = logging.getLogger(__name__)

__all__ = ["STAGES", "FrameLog", "NullViewer", "RunResult", "resolve_motion", "run"]

_LEAST_REFUSED = 10  # frames that the front end refused, and more of them than not, before a run gives up


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
    warnings: tuple[str, ...]  # what went wrong in the run, or with its IMU
    wall_s: float
    stopped: str | None = None  # why the run ended before the recording; None: it did not
    rig: Rig | None = None  # the calibration as given; None: features without an image size
    mapped: MappedRun | None = None  # where a map was built or used

    def calibrated_rig(self) -> CalibratedRig | None:
        """Return the calibration with what the run found it to be off by; None: features without an image size.

        On a cylinder left and right stay as given: its stereo field is not expressed as a rig.

        Raises:
            CalibrationError: no rig of the given lens models is off as the run found it.
        """
        if self.rig is None:
            return None
        recording = self.recording
        return estimated_rig(
            self.rig, self.estimates[-1], is_cylinder=recording.camera.is_cylinder, where=str(recording.path)
        )

    @property
    def trajectory(self) -> Trajectory:
        """The estimated poses of the body, one per frame."""
        T_world_body, times_ns, indices = (
            np.array(self.estimates.column(name)) for name in ("T_world_imu", "time_ns", "index")
        )
        return Trajectory(T_world_body=T_world_body, times_ns=times_ns, body=self.body, frame_indices=indices)


class NullViewer:
    """Shows nothing."""

    def frame(self, result: FrameResult) -> None:
        """Ignore the frame."""

    def close(self) -> None:
        """Nothing is held."""


@one_blas_thread()
def run(
    dataset: Dataset,
    config: Config,
    *,
    start: int = 0,
    stop: int | None = None,
    keep_observations: bool = False,
    viewer: Viewer | None = None,
    frontend: Frontend | None = None,
    selector: Selector | None = None,
    backend: Backend | None = None,
    folder: GrowingFolder | None = None,
    resume: bool = False,
    should_stop: Callable[[], str | None] = lambda: None,
    map_file: Path | None = None,
    localise: bool = False,
) -> RunResult:
    """Process a recording from its frame `start` to before frame `stop`, with BLAS pinned to one thread meanwhile.

    Args:
        dataset: the recording.
        config: every setting.
        start: first frame.
        stop: frame after the last one; None: to the end.
        keep_observations: keep what the front end gave, for writing an observation log.
        viewer: watches each frame.
        frontend: used in place of the configured front end.
        selector: used in place of the configured selector.
        backend: used in place of the configured back end.
        folder: where to write while the run goes on; None: everything stays in memory.
        resume: go on from the checkpoint in `folder`.
        should_stop: asked after each event; a reason ends the run in order, and the result names it.
        map_file: a map to begin or to continue.
        localise: find poses in the map, and leave it as it is.

    Raises:
        VioError: the configuration, the data or the estimation is at fault; the message says which. With a folder, a
            fault after the first frame ends the run in order instead, and the result names it.
    """
    recording = dataset.recording
    _check(recording, config, start, stop)
    motion = resolve_motion(recording, config)
    body: BodyFrame = "cam0" if recording.T_cam0_imu is None else "imu"
    T_cam0_body = recording.T_cam0_body
    began = time.perf_counter()
    recorder = RunRecorder(body, lag_frames=config.lag_frames, keep_observations=keep_observations, folder=folder)
    features = _feature_source(dataset, config)
    if resume:
        state = recorder.restore(features)
        viewer = _skipped(viewer, len(recorder))
    else:
        run_config = replace(config, motion=motion or "none")
        session = None if map_file is None else _map_session(map_file, recording, run_config, localise=localise)
        odometry = Odometry(
            recording.camera,
            run_config,
            T_cam0_imu=T_cam0_body,
            frontend=frontend or _build_frontend(features, config),
            selector=selector or _build_selector(features, config),
            backend=backend or (None if session else build_backend(recording.camera, T_cam0_body, config, motion)),
            map=session,
        )
        dead_reckoning = _DeadReckoning(recording, config, T_cam0_body) if motion == "velocity" else None
        state = _RunState(odometry, dead_reckoning, start)
    stopped = None
    with (
        contextlib.closing(recorder),
        contextlib.closing(viewer or NullViewer()) as shown,
        contextlib.closing(state.odometry),
    ):
        loop = _Loop(state, recorder, shown)
        try:
            with _opencv_threads(dataset, config, frontend):
                images = _needs_images(dataset, config) or state.odometry.map_session is not None
                events = _limited(dataset.events(state.next_frame, stop, images=images), recording, config)
                stopped = loop.run(events, features, should_stop)
        except VioError as error:
            if folder is None or not len(recorder):
                raise
            stopped = str(error)
        odometry = state.odometry
        if not len(recorder):
            _nothing_done(recording, odometry, stopped)
        reckoned, session = state.dead_reckoning is not None, odometry.map_session
        return RunResult(
            recording=recording,
            config=config,
            motion=motion,
            body=body,
            T_cam0_body=T_cam0_body,
            estimates=recorder.estimates,
            dead_reckoning=_trajectory(recorder.dead_reckoned(), recorder, body) if reckoned else None,
            landmarks=recorder.landmarks(odometry.landmarks()),
            frames=recorder.frames,
            observations=recorder.observations,
            motion_samples=recorder.samples,
            warnings=odometry.warnings,
            wall_s=time.perf_counter() - began,
            stopped=stopped,
            rig=given_rig(dataset),
            mapped=None if session is None else mapped_run(session, recorder.estimates, recorder.mapped),
        )


def given_rig(dataset: Dataset) -> Rig | None:
    """Return the calibration of a recording's images; None: it holds features, and no image size or a cylinder.

    For features it is that of the rectified images that they come from.
    """
    recording = dataset.recording
    stereo = recording.camera.kind == "stereo"
    if not (stereo and isinstance(dataset, RectifyingDataset)) or dataset.rectifier.maps is None:
        return rig_of_rectified(recording.camera, recording.T_cam0_imu)
    made, T_cam0_imu = dataset.rectifier, recording.T_cam0_imu
    rig = made.rig
    if T_cam0_imu is not None:
        T_cam0_imu = se3_inverse(rig.T_imu_cam0)
    return Rig(rig.cam0, rig.cam1, se3_inverse(rig.T_cam0_cam1), T_cam0_imu, dataset.imu_noise, made.time_offset_s)


def _map_session(path: Path, recording: Recording, config: Config, *, localise: bool) -> MapSession:
    """Open a map for a recording.

    Raises:
        ConfigError: the recording has no images, or the back end is not msckf.
        DataError: the map cannot be used.
    """
    from vio.mapping.session import MapSession

    need_stereo(recording, "a map")
    if not recording.has_images:
        raise ConfigError(f"{recording.path}: a map is made of images, and this recording has features only")
    if config.backend != "msckf":
        raise ConfigError(f"a map needs the back end msckf, not {config.backend}; leave --backend out")
    return MapSession(
        path,
        recording.camera,
        recording.T_cam0_body,
        source=str(recording.path.absolute()),
        imu=config.motion == "imu",
        localise=localise,
        alone=config.motion == "none",
    )


def _nothing_done(recording: Recording, odometry: Odometry, stopped: str | None) -> NoReturn:
    """Say why a run has no frame.

    Raises:
        StoppedError: it was asked to stop.
        DataError: its frames could not be read, or a start was observable in none.
    """
    if stopped is not None:
        raise StoppedError(f"{stopped} before the first frame was done; nothing was written", status=130)
    if odometry.frames_waiting:
        waited = f"none of the {odometry.frames_waiting} frames has a pose"
        raise DataError(f"{recording.path}: {waited}; see the warnings above")
    raise DataError(f"{recording.path}: no frame could be read; see the warnings above")


@dataclass(slots=True)
class _RunState:
    """What a checkpoint holds of a run."""

    odometry: Odometry
    dead_reckoning: _DeadReckoning | None
    next_frame: int  # where to take up the recording's events: the last frame taken, or the first one
    frame_ns: int | None = None  # newest time of a frame that was taken
    sample_ns: int | None = None  # newest time of a motion sample that was taken

    def is_new(self, event: Event) -> bool:
        """Whether an event of a recording that is read again has not been taken before."""
        known = self.frame_ns if isinstance(event, StereoFrame) else self.sample_ns
        return known is None or event.time_ns > known

    def note(self, event: Event) -> None:
        """Note that an event was taken."""
        if isinstance(event, StereoFrame):
            self.frame_ns, self.next_frame = event.time_ns, event.index
        else:
            self.sample_ns = event.time_ns


class _Loop:
    """Takes a recording's events through the odometry into the recorder."""

    def __init__(self, state: _RunState, recorder: RunRecorder, viewer: Viewer) -> None:
        self._state, self._recorder, self._viewer = state, recorder, viewer
        self._reading = _ReadTimer()

    def run(self, events: Iterable[Event], dataset: Dataset, should_stop: Callable[[], str | None]) -> str | None:
        """Take events to their end; return why they ended before.

        Raises:
            VioError: data or estimation are at fault.
        """
        state, recorder, odometry = self._state, self._recorder, self._state.odometry
        stopped = None
        resumed = state.frame_ns is not None
        for event in self._reading.timed(events):
            if resumed and not state.is_new(event):
                continue
            self._take(event)
            state.note(event)
            if _LEAST_REFUSED <= odometry.frames_refused > len(recorder):
                break
            stopped = should_stop()
            if recorder.is_save_due or (stopped and recorder.can_save):
                recorder.save(state, dataset, odometry.take_landmarks())
            if stopped:
                break
        self._record(odometry.finish())
        recorder.revise(odometry.smoothed)
        if odometry.frames_refused > len(recorder):
            raise DataError(f"most frames were refused: {odometry.warnings[-1]}")
        return stopped

    def _take(self, event: Event) -> None:
        state = self._state
        if not isinstance(event, StereoFrame):
            self._recorder.sample(event)
        self._record(state.odometry.add_event(event))
        if state.dead_reckoning is not None:
            state.dead_reckoning.add(event)

    def _record(self, results: list[FrameResult]) -> None:
        state = self._state
        for result in results:
            self._recorder.frame(result, self._reading.take_ms(), state.odometry.smoothed)
            if state.dead_reckoning is not None:
                self._recorder.dead_reckoning(state.dead_reckoning.pose_at(result.log.time_ns))
            self._viewer.frame(result)


def _skipped(viewer: Viewer | None, frames: int) -> Viewer | None:
    """Tell a viewer that knows it of frames that an earlier process has done."""
    skip = getattr(viewer, "skip", None)
    if skip is not None:
        skip(frames)
    return viewer


def _check(recording: Recording, config: Config, start: int, stop: int | None) -> None:
    """Refuse what no run can be made of.

    Raises:
        ConfigError: the range of frames is empty, or the settings contradict one another.
    """
    if start < 0 or (stop is not None and stop <= start):
        raise ConfigError(f"frames {start} to {stop} are no range; give 0 <= start < stop")
    if start >= len(recording.frame_times_ns):
        raise ConfigError(f"--start {start} is past the last frame, {len(recording.frame_times_ns) - 1}")
    if config.lag_frames and (config.backend != "msckf" or config.lag_frames >= config.msckf.clones):
        raise ConfigError(f"lag_frames={config.lag_frames}: needs backend msckf, and must be below msckf.clones")


def resolve_motion(recording: Recording, config: Config) -> MotionSource | None:
    """Decide what carries the pose between frames: a motion source, or None for images alone.

    Raises:
        ConfigError: the recording lacks what was asked for, or the back end has no model for it.
    """
    taken = BACKENDS[config.backend].motion_sources
    if config.motion == "none":
        return None
    if config.motion == "auto":
        return _auto_motion(recording, config.backend)
    if config.motion not in taken:
        raise ConfigError(
            f"backend {config.backend} has no model for --motion {config.motion}; it takes {', '.join(taken)} or none"
        )
    if config.motion not in recording.motion:
        held = ", ".join(sorted(recording.motion)) or "no motion sensor"
        raise ConfigError(f"{recording.path}: --motion {config.motion} asked for, but the recording holds {held}")
    return config.motion


def _auto_motion(recording: Recording, backend: BackendName) -> MotionSource | None:
    """Return what the run behind an observation log used, else the best that recording and back end share."""
    taken = BACKENDS[backend].motion_sources
    if recording.run_motion == "none":
        return None
    if recording.run_motion in taken and recording.run_motion in recording.motion:
        return recording.run_motion
    found = next((source for source in taken if source in recording.motion), None)
    if found is None and recording.motion:
        held = ", ".join(sorted(recording.motion))
        log.warning("%s: backend %s has no model for its %s; images alone", recording.path, backend, held)
    elif found is not None and recording.kind == "log" and recording.run_motion is None:
        log.warning(
            "%s: the log does not say which motion its run used; motion auto takes its %s, --motion none images alone",
            recording.path,
            found,
        )
    return found


def _limited(events: Iterable[Event], recording: Recording, config: Config) -> Iterable[Event]:
    """The events without the frames that the limit on the frame rate leaves out, counted from the first of all."""
    most_hz = config.dataset.max_frame_rate
    if most_hz is None:
        return events
    used = set(used_frames(recording.frame_times_ns, most_hz).tolist())
    return (event for event in events if not isinstance(event, StereoFrame) or event.index in used)


class _ReadTimer:
    """Wall time that the recording takes to give its events."""

    def __init__(self) -> None:
        self._ms = 0.0

    def timed(self, events: Iterable[Event]) -> Iterator[Event]:
        """Yield the events, and note how long each took to come."""
        iterator = iter(events)
        while True:
            start = time.perf_counter()
            event = next(iterator, None)
            self._ms += 1e3 * (time.perf_counter() - start)
            if event is None:
                return
            yield event

    def take_ms(self) -> float:
        """Return the time since the last call, and begin anew."""
        taken, self._ms = self._ms, 0.0
        return taken


class _DeadReckoning:
    """The paper's first result: prediction alone, beside the filter."""

    def __init__(self, recording: Recording, config: Config, T_cam0_body: FloatArray) -> None:
        settings = replace(config.vislam, mode="dead_reckoning", motion_model="input")
        self._filter = Vislam(recording.camera, T_cam0_body, settings, motion_sensor=True)
        self._begun = False

    def add(self, event: Event) -> None:
        """Take a motion sample."""
        if not isinstance(event, StereoFrame):
            self._filter.propagate(event)
            self._begun = True

    def pose_at(self, time_ns: int) -> FloatArray:
        """The pose (4, 4) of the body at a frame, which may not be older than the last one."""
        if not self._begun:  # at its start, as velocities may begin after the images
            return np.eye(4)
        self._filter.advance(time_ns)
        return self._filter.estimate().T_world_imu


def _feature_source(dataset: Dataset, config: Config) -> Dataset:
    """The recording itself, or the file of features that takes the place of its images."""
    if config.frontend.features is None:
        return dataset
    if config.frontend.name not in ("auto", "precomputed"):
        raise ConfigError(f"frontend.features is given, but frontend.name is {config.frontend.name}; use precomputed")
    from vio.datasets import open_dataset

    features = open_dataset(config.frontend.features, config.dataset)
    ours, theirs = dataset.recording, features.recording
    if not np.isin(theirs.frame_times_ns, ours.frame_times_ns).all():
        raise ConfigError(
            f"{config.frontend.features}: its frames are not those of {ours.path} (other times); give the features of "
            "this very recording"
        )
    return features


def _build_frontend(features: Dataset, config: Config) -> Frontend:
    name = config.frontend.name if config.frontend.features is None else "precomputed"
    return build_frontend(name, features.recording.camera, config.frontend, features)


def _build_selector(features: Dataset, config: Config) -> Selector:
    recording = features.recording
    indices = range(len(recording.frame_times_ns))
    precomputed = features.observations(0) is not None

    def whole_record() -> list[Observations]:
        return [o for o in map(features.observations, indices) if o is not None]

    return build_selector(
        config.selector,
        whole_record=whole_record if precomputed else None,
        camera=recording.camera,
    )


def _opencv_threads(dataset: Dataset, config: Config, given: Frontend | None) -> AbstractContextManager[None]:
    """Limit OpenCV to one thread where the front end is `klt`, whose steps are too short for more."""
    if given is not None or config.frontend.name not in ("auto", "klt") or not _needs_images(dataset, config):
        return contextlib.nullcontext()
    return one_opencv_thread()


def _needs_images(dataset: Dataset, config: Config) -> bool:
    front = config.frontend
    return dataset.recording.has_images and front.name != "precomputed" and front.features is None


def _trajectory(T_world_body: FloatArray, rows: RunRecorder, body: BodyFrame) -> Trajectory:
    """Return poses (N, 4, 4) of the first N frames with an estimate; a run that an error ends may have one less."""
    times_ns, indices = (np.asarray(rows.estimates.column(name))[: len(T_world_body)] for name in ("time_ns", "index"))
    return Trajectory(T_world_body=T_world_body, times_ns=times_ns, body=body, frame_indices=indices)
