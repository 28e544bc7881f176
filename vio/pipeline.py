"""A whole recording through the chain: events in, front end, selector, filter, result out."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from vio.chain import BACKENDS, STAGES, FrameLog, FrameResult, build_backend
from vio.config import BackendName, Config
from vio.errors import ConfigError, DataError
from vio.filters.vislam import Vislam
from vio.frontend_package import frontend_module
from vio.geometry.lie import FloatArray
from vio.odometry import Odometry
from vio.protocols import Backend, Dataset, Frontend, Selector, Viewer
from vio.records import (
    BodyFrame,
    Estimate,
    Event,
    FrontendOutput,
    Landmarks,
    MotionSample,
    MotionSource,
    Observations,
    Recording,
    StereoFrame,
    Trajectory,
    UpdateReport,
)
from vio.selectors import build_selector
from vio.threads import one_blas_thread

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
    estimates: tuple[Estimate, ...]
    dead_reckoning: Trajectory | None
    landmarks: Landmarks
    frames: tuple[FrameLog, ...]
    observations: tuple[Observations, ...] | None  # kept on request
    motion_samples: tuple[MotionSample, ...] | None  # kept on request
    warnings: tuple[str, ...]  # what went wrong in the run, or with its IMU
    wall_s: float

    @property
    def trajectory(self) -> Trajectory:
        """The estimated poses of the body, one per frame."""
        return _trajectory([e.T_world_imu for e in self.estimates], self.frames, self.body)


class NullViewer:
    """Shows nothing."""

    def frame(self, output: FrontendOutput, estimate: Estimate, report: UpdateReport) -> None:
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

    Raises:
        VioError: the configuration, the data or the estimation is at fault; the message says which.
    """
    recording = dataset.recording
    _check(recording, config, start, stop)
    motion = resolve_motion(recording, config)
    body: BodyFrame = "cam0" if recording.T_cam0_imu is None else "imu"
    T_cam0_body = np.eye(4) if recording.T_cam0_imu is None else recording.T_cam0_imu

    features = _feature_source(dataset, config)
    odometry = Odometry(
        recording.camera,
        replace(config, motion=motion or "none"),
        T_cam0_imu=T_cam0_body,
        frontend=frontend or _build_frontend(features, config),
        selector=selector or _build_selector(features, config),
        backend=backend or build_backend(recording.camera, T_cam0_body, config, motion),
    )
    viewer = viewer or NullViewer()
    dead_reckoning = _DeadReckoning(recording, config, T_cam0_body) if motion == "velocity" else None
    recorder = _RunRecorder(odometry, config.lag_frames, keep_observations=keep_observations)
    began, reading = time.perf_counter(), _ReadTimer()
    try:
        for event in reading.timed(dataset.events(start, stop, images=_needs_images(dataset, config))):
            if dead_reckoning is not None:
                dead_reckoning.add(event)
            if not isinstance(event, StereoFrame):
                recorder.sample(event)
            for result in odometry.add_event(event):
                recorder.frame(result, reading.take_ms())
                viewer.frame(result.output, result.estimate, result.report)
            if _LEAST_REFUSED <= odometry.frames_refused > len(recorder.frames):
                break
        for result in odometry.finish():
            recorder.frame(result, reading.take_ms())
            viewer.frame(result.output, result.estimate, result.report)
    finally:
        viewer.close()
    if not recorder.frames and not odometry.frames_refused:
        raise DataError(f"{recording.path}: no frame could be read between {start} and {stop}; see the warnings above")
    if odometry.frames_refused > len(recorder.frames):
        raise DataError(f"most frames were refused: {odometry.warnings[-1]}")
    recorder.finish()
    return RunResult(
        recording=recording,
        config=config,
        motion=motion,
        body=body,
        T_cam0_body=T_cam0_body,
        estimates=tuple(recorder.estimates),
        dead_reckoning=_trajectory(dead_reckoning.poses, recorder.frames, body) if dead_reckoning is not None else None,
        landmarks=odometry.landmarks(),
        frames=tuple(recorder.frames),
        observations=tuple(recorder.observations) if keep_observations else None,
        motion_samples=tuple(recorder.samples) if keep_observations else None,
        warnings=odometry.warnings,
        wall_s=time.perf_counter() - began,
    )


def _check(recording: Recording, config: Config, start: int, stop: int | None) -> None:
    """Refuse what no run can be made of.

    Raises:
        ConfigError: the range of frames is empty, or the settings contradict one another.
    """
    if start < 0 or (stop is not None and stop <= start):
        raise ConfigError(f"frames {start} to {stop} are no range; give 0 <= start < stop")
    if start >= len(recording.frame_times_ns):
        raise ConfigError(f"--start {start} lies past the last frame, {len(recording.frame_times_ns) - 1}")
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


class _RunRecorder:
    """What a run keeps: an estimate and a row of the log per frame and, on request, what went in."""

    def __init__(self, odometry: Odometry, lag_frames: int, *, keep_observations: bool) -> None:
        self._odometry, self._lag, self._keep = odometry, lag_frames, keep_observations
        self.estimates: list[Estimate] = []
        self.frames: list[FrameLog] = []
        self.observations: list[Observations] = []
        self.samples: list[MotionSample] = []

    def sample(self, sample: MotionSample) -> None:
        if self._keep:
            self.samples.append(sample)

    def frame(self, result: FrameResult, read_ms: float) -> None:
        if self._lag:
            self._revise(len(self.estimates) - self._lag, len(self.estimates) - self._lag + 1)
        self.estimates.append(result.estimate)
        self.frames.append(replace(result.log, read_ms=read_ms))
        if self._keep:
            self.observations.append(result.output.observations)

    def finish(self) -> None:
        if self._lag:
            self._revise(len(self.estimates) - self._lag, len(self.estimates))

    def _revise(self, first: int, end: int) -> None:
        """Replace estimates by the smoothed ones: pose, covariance, velocity and biases."""
        for k in range(max(first, 0), end):
            smoothed = self._odometry.smoothed(self.frames[k].index)
            if smoothed is not None:
                self.estimates[k] = replace(
                    self.estimates[k],
                    T_world_imu=smoothed.T_world_imu,
                    covariance=smoothed.covariance,
                    velocity_world=smoothed.velocity_world,
                    gyro_bias=smoothed.gyro_bias,
                    accel_bias=smoothed.accel_bias,
                )


class _DeadReckoning:
    """The paper's first result: prediction alone, beside the filter."""

    def __init__(self, recording: Recording, config: Config, T_cam0_body: FloatArray) -> None:
        settings = replace(config.vislam, mode="dead_reckoning", motion_model="input")
        self._filter = Vislam(recording.camera, T_cam0_body, settings, motion_sensor=True)
        self.poses: list[FloatArray] = []

    def add(self, event: Event) -> None:
        if isinstance(event, StereoFrame):
            self._filter.advance(event.time_ns)
            self.poses.append(self._filter.estimate().T_world_imu)
        else:
            self._filter.propagate(event)


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
    build_frontend = frontend_module().build_frontend
    name = config.frontend.name if config.frontend.features is None else "precomputed"
    return build_frontend(name, features.recording.camera, config.frontend, features)


def _build_selector(features: Dataset, config: Config) -> Selector:
    recording = features.recording
    indices = range(len(recording.frame_times_ns))
    precomputed = features.observations(0) is not None
    camera = recording.camera

    def whole_record() -> list[Observations]:
        return [o for o in map(features.observations, indices) if o is not None]

    return build_selector(
        config.selector,
        image_size=None if camera.width is None or camera.height is None else (camera.width, camera.height),
        whole_record=whole_record if precomputed else None,
        camera=camera,
    )


def _needs_images(dataset: Dataset, config: Config) -> bool:
    front = config.frontend
    return dataset.recording.has_images and front.name != "precomputed" and front.features is None


def _trajectory(poses: list[FloatArray], frames: list[FrameLog] | tuple[FrameLog, ...], body: BodyFrame) -> Trajectory:
    return Trajectory(
        T_world_body=np.array(poses),
        times_ns=np.array([f.time_ns for f in frames], dtype=np.int64),
        body=body,
        frame_indices=np.array([f.index for f in frames], dtype=np.int64),
    )
