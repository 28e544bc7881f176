"""What a run consists of: motion source, front end, selector, back end and map, for recordings
and for live use.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vio.config import Config
from vio.dataclass import dataclass
from vio.errors import ConfigError
from vio.filters import backend_class
from vio.frontend import build_frontend
from vio.frontend.rolling_shutter import RollingShutter
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.live.frame_pipeline import FramePipeline, RunParts
from vio.live.imu_trial import ImuTrial
from vio.live.processor import EventProcessor
from vio.monitor.reading import ReadingCheck, pair_as_read, raw_pair
from vio.protocols import Backend, Dataset, Detector, Frontend, RectifyingDataset, Selector
from vio.records import MotionSource, Observations, Recording, RunMotion, need_stereo
from vio.selection.selectors import build_selector

if TYPE_CHECKING:
    from vio.cameras.rig import Rectifier
    from vio.mapping.session import MapSession

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Parts:
    """Parts of the caller's own, each used in place of the configured one; None: as configured."""

    frontend: Frontend | Detector | None = None  # a detector: `klt` with corners by it
    selector: Selector | None = None
    backend: Backend | None = None


CONFIGURED = Parts()


@dataclass(frozen=True, slots=True)
class MapUse:
    """The map that a run begins or continues."""

    path: Path
    localise: bool = False  # find poses in the map, and leave it as it is
    # Wait for the map's thread, so that results repeat to the bit; False: keyframes and results
    # come when it is ready.
    wait: bool = True
    density: int | None = None  # keyframes a cubic metre that can be found again; None: all


@dataclass(frozen=True, slots=True)
class Source:
    """Where the events of a run come from, as far as its parts depend on it."""

    camera: StereoCamera  # rectified
    T_cam0_body: FloatArray  # (4, 4)
    motion: MotionSource | None  # what propagates the pose between frames; None: images alone
    recording: Recording | None = None  # None: live
    # the recording, or the features used in place of its images; None: live
    features: Dataset | None = None
    right_delay: int = 0  # frames by which right images and pixels are known to be late
    readout_s: float = 0.0  # of a rolling shutter that was found; 0: the camera's own
    # of a live rig's raw images; None: a recording, which has its own, or rectified images
    rectifier: Rectifier | None = None

    def reading_check(self) -> ReadingCheck | None:
        """Return what tries other readings of the calibration; None: it is of rectified images, or
        of one camera.
        """
        if self.rectifier is None:
            pair = pair_as_read(self.features)
        else:
            pair = raw_pair(self.rectifier)
        return None if pair is None else ReadingCheck(*pair)


def recorded_source(dataset: Dataset, config: Config) -> Source:
    """Return a recording as the source of a run.

    Raises:
        ConfigError: the recording lacks the motion or the features that the configuration names.
    """
    recording = dataset.recording
    motion = resolve_motion(recording, config)
    return Source(
        recording.camera, recording.T_cam0_body, motion, recording, _features(dataset, config)
    )


def refuse_other_types(config: Config, **given: object) -> None:
    """Raise TypeError, with the call that makes the right one, where a program gives something
    else, such as a path, a dictionary, or a recording in the place of its camera.

    Args:
        config: settings.
        given: `rig` or `dataset`.
    """
    if not isinstance(config, Config):
        raise TypeError(
            f"config: give what vio.load_config(...) returns, not {type(config).__name__}"
        )
    wanted = {"rig": "vio.load_rig(path)", "dataset": "vio.open_dataset(path)"}
    needs = {"rig": ("cam0", "fu"), "dataset": ("recording",)}
    for name, value in given.items():
        if not any(hasattr(value, attribute) for attribute in needs[name]):
            raise TypeError(f"{name}: give what {wanted[name]} returns, not {type(value).__name__}")


def live_source(
    camera: StereoCamera,
    T_cam0_imu: FloatArray | None,
    config: Config,
    rectifier: Rectifier | None = None,
) -> Source:
    """Return a live rig as the source of a run.

    Args:
        camera: the rectified camera.
        T_cam0_imu: (4, 4); None: there is no IMU.
        config: every setting.
        rectifier: of raw images; None: they are rectified.

    Raises:
        ConfigError: `motion` is imu without extrinsics, or the back end has no model for it.
    """
    sensors: set[MotionSource] = set() if T_cam0_imu is None else {"imu"}
    if config.motion == "velocity":  # any rig may have the sensor
        sensors.add("velocity")
    motion = _motion(
        config, sensors, missing="motion imu needs the extrinsics T_cam0_imu; give the rig them"
    )
    T_cam0_body = np.eye(4) if T_cam0_imu is None else T_cam0_imu
    return Source(camera, T_cam0_body, motion, rectifier=rectifier)


def resolve_motion(recording: Recording, config: Config) -> MotionSource | None:
    """Decide what propagates the pose between the frames of a recording; None: images alone.

    Raises:
        ConfigError: the recording lacks what was asked for, or the back end has no model for it.
    """
    path = recording.path
    logged = recording.run_motion
    held = ", ".join(sorted(recording.motion)) or "no motion sensor"
    missing = f"{path}: --motion {config.motion} asked for, but the recording holds {held}"
    motion = _motion(config, recording.motion, logged=logged, missing=missing)
    if config.motion != "auto" or logged == "none":
        return motion
    if motion is None and recording.motion:
        log.warning(
            "%s: backend %s has no model for its %s; images alone", path, config.backend, held
        )
    elif motion is not None and recording.kind == "log" and logged is None:
        log.warning(
            "%s: the log does not say which motion its run used; motion auto takes its %s, "
            "--motion none images alone",
            path,
            motion,
        )
    return motion


def _motion(
    config: Config,
    sensors: Collection[MotionSource],
    *,
    missing: str,
    logged: RunMotion | None = None,
) -> MotionSource | None:
    """Return the configured motion; auto: that of a logged run, else the best that sensors and
    back end share.
    """
    known = backend_class(config.backend).motion_sources
    if config.motion == "none":
        return None
    if config.motion == "auto":
        if logged == "none":
            return None
        if logged in known and logged in sensors:
            return logged
        return next((sensor for sensor in known if sensor in sensors), None)
    if config.motion not in known:
        able = ", ".join((*known, "none"))
        raise ConfigError(
            f"backend {config.backend} has no model for --motion {config.motion}; it takes {able}"
        )
    if config.motion not in sensors:
        raise ConfigError(missing)
    return config.motion


def _features(dataset: Dataset, config: Config) -> Dataset:
    """Return the recording itself, or the file of features that takes the place of its images."""
    if config.frontend.features is None:
        return dataset
    if config.frontend.name not in ("auto", "precomputed"):
        raise ConfigError(
            f"frontend.features is given, but frontend.name is {config.frontend.name}; use "
            "precomputed"
        )
    from vio.datasets import open_dataset

    features = open_dataset(config.frontend.features, config.dataset)
    ours = dataset.recording
    theirs = features.recording
    if not np.isin(theirs.frame_times_ns, ours.frame_times_ns).all():
        raise ConfigError(
            f"{config.frontend.features}: its frames are not those of {ours.path} (other times); "
            "give the features of "
            "this very recording"
        )
    return features


def _frontend(source: Source, config: Config, parts: Parts, seen: StereoCamera) -> Frontend:
    """Return the caller's own front end, or the configured one, for a camera."""
    from vio.frontend.given import as_frontend  # they load OpenCV
    from vio.frontend.precomputed import PrecomputedFrontend

    name = "precomputed"
    if config.frontend.features is None:
        name = config.frontend.name
    if parts.frontend is None:
        frontend = build_frontend(name, seen, config.frontend, source.features)
    else:
        frontend = as_frontend(parts.frontend, seen, config.frontend)
    if isinstance(frontend, PrecomputedFrontend):
        frontend.right_delay = source.right_delay
    return frontend


def _shutter(camera: StereoCamera, config: Config, source: Source) -> RollingShutter | None:
    """Return what moves the pixels of a rolling shutter, or finds that there is one; None: the
    settings state that all rows are exposed at once.
    """
    if config.frontend.readout_ms is not None:
        camera = replace(camera, readout_s=1e-3 * config.frontend.readout_ms)
        if not camera.readout_s:
            return None
    elif source.readout_s:
        camera = replace(camera, readout_s=source.readout_s)
    rectifier = source.rectifier
    if isinstance(source.features, RectifyingDataset):
        rectifier = source.features.rectifier
    return RollingShutter(camera, rectifier)


def _trial(source: Source, parts: Parts, backend: Backend, map: MapUse | None) -> ImuTrial | None:
    """Return what tries other readings of an IMU beside the run; None: it is used as given.

    One camera has no scale without its IMU; a map holds keyframes of the poses that were replaced.
    """
    has_scale_alone = source.motion == "imu" and source.camera.kind != "mono"
    if not has_scale_alone or parts.backend is not None or map is not None:
        return None
    return ImuTrial(backend)


def build_processor(
    source: Source, config: Config, parts: Parts, map: MapUse | None = None
) -> EventProcessor:
    """Connect the parts of a run, those of the caller's own and the configured ones.

    Raises:
        ConfigError: the settings contradict one another, the camera or the back end.
        DataError: the map cannot be used.
    """
    from vio.guard.guarded import guarded  # loads OpenCV

    camera = source.camera
    features = source.features
    backend = parts.backend or build_backend(camera, source.T_cam0_body, config, source.motion)
    if config.lag_frames and config.lag_frames >= backend.window_frames:
        raise ConfigError(
            f"lag_frames={config.lag_frames}: needs backend msckf, and must be below msckf.clones"
        )
    seen = camera if features is None else features.recording.camera
    frontend = _frontend(source, config, parts, seen)
    pipeline = FramePipeline(
        camera,
        source.T_cam0_body,
        source.motion,
        RunParts(
            frontend=guarded(frontend, seen, checks=config.frontend.checks),
            selector=parts.selector
            or build_selector(config.selector, whole_record=_record(features), camera=seen),
            backend=backend,
            shutter=_shutter(seen, config, source),
        ),
        use_prior=config.frontend.prior,
        trial=_trial(source, parts, backend, map),
        reading=source.reading_check(),
        extrinsics_known=config.msckf.calibrate_camera_imu not in ("extrinsics", "both"),
        gravity_mps2=config.imu.gravity_mps2,
    )
    if map is None:
        session = None
    else:
        session = _open_map(map, source, config, backend)
    return EventProcessor(pipeline, wait_for_imu=source.motion == "imu", map=session)


def build_backend(
    camera: StereoCamera, T_cam0_body: FloatArray, config: Config, motion: MotionSource | None
) -> Backend:
    """Build the configured back end; `T_cam0_body` is (4, 4)."""
    settings = getattr(config, config.backend, None)
    return backend_class(config.backend).build(camera, T_cam0_body, settings, motion, config.imu)


def _record(features: Dataset | None) -> Callable[[], list[Observations]] | None:
    """Return a function that reads all observations of a recording.

    None: it has images, or it is live.
    """
    if features is None or features.observations(0) is None:
        return None
    indices = range(len(features.recording.frame_times_ns))
    return lambda: [seen for seen in map(features.observations, indices) if seen is not None]


def _open_map(use: MapUse, source: Source, config: Config, backend: Backend) -> MapSession:
    """Open the map of a run."""
    from vio.filters.rig_calibration import constant_sigmas
    from vio.mapping.session import MapSession

    recording = source.recording
    if recording is not None:
        need_stereo(recording, "a map")
        if not recording.has_images:
            raise ConfigError(
                f"{recording.path}: a map is made of images, and this recording has features only"
            )
    if not backend.window_frames:
        raise ConfigError(
            f"a map needs the back end msckf, not {config.backend}; leave --backend out"
        )
    sigmas = constant_sigmas(config.msckf)
    return MapSession(
        use.path,
        source.camera,
        source.T_cam0_body,
        source="live" if recording is None else str(recording.path.absolute()),
        imu=source.motion == "imu",
        localise=use.localise,
        wait=use.wait,
        alone=source.motion is None,
        density=use.density,
        rig_sigmas=(float(np.hypot(*sigmas[:2])), float(sigmas[2])),
    )
