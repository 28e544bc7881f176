"""A live source through the odometry, with recording and results, until it ends or is asked to
stop.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from vio.cameras.rig import Rig
from vio.config import Config
from vio.errors import CalibrationError, DataError
from vio.live.build import MapUse
from vio.live.figures import LiveFigures
from vio.live.live_odometry import LiveOdometry
from vio.live.worker import Drop
from vio.records import FrameResult
from vio.runs.live_folder import LiveFolder, LiveRunSettings
from vio.sources.recorder import Form, Recorder
from vio.sources.source import LiveSource, SourceFrame


@dataclass(frozen=True, slots=True)
class LiveRun:
    """What a live run leaves behind."""

    figures: LiveFigures
    warnings: tuple[str, ...]
    samples: int  # of the IMU


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """What a live run keeps, and how it takes what comes."""

    kept: LiveRunSettings | None = None  # the run folder; None: there is none
    record: Path | None = None  # new folder for what the source gave, which `vio run` repeats
    record_as: Form = "plain"  # its form, see `Recorder`
    map: MapUse | None = None  # a map to begin or to continue
    drop: Drop = "oldest"  # see `LiveOdometry`


def run_source(
    source: LiveSource,
    config: Config,
    rig: Rig | None,
    options: LiveOptions,
    *,
    should_stop: Callable[[], object],
    say: Callable[[str], None],
    on_start: Callable[
        [LiveOdometry, Rig], Callable[[FrameResult], None] | None
    ] = lambda odometry, rig: None,
) -> LiveRun:
    """Run until the source ends or is asked to stop; what was asked for is written meanwhile.

    Args:
        source: opened; it is closed at the end.
        config: every setting.
        rig: calibration in place of the device's.
        options: what is kept.
        should_stop: asked with each event, and about each second.
        say: reports that it is ready.
        on_start: may return what is called with each result, a viewer's.

    Raises:
        VioError: there is no calibration, images do not fit it, or source, disk or estimation have
            failed.
    """
    kept = options.kept
    with contextlib.closing(source):
        rig = _rig_of(source, rig)
        if not source.has_imu:
            config = replace(config, motion="none")
        watcher: Callable[[FrameResult], None] | None = None
        has_poses = False

        def on_frame(result: FrameResult) -> None:
            nonlocal has_poses
            has_poses = True
            if watcher is not None:
                watcher(result)

        if kept is None:
            folder = None
        else:
            folder = LiveFolder(kept, config, rig)
        odometry = LiveOdometry(
            rig,
            config,
            on_frame=on_frame,
            map=options.map,
            drop=options.drop,
            copy_images=False,
            sink=folder,
        )
        try:
            with odometry, contextlib.ExitStack() as stack:
                say("warming up")
                odometry.warm_up()
                watcher = on_start(odometry, rig)
                recorder = None
                if options.record is not None:
                    recorder = Recorder(options.record, rig, options.record_as)
                    stack.callback(recorder.close)
                say("ready")
                samples = _feed(source, odometry, recorder, should_stop)
        finally:  # however it ends, what was computed is kept
            if folder is not None:
                folder.close()
        if kept is not None and not has_poses:
            raise DataError(f"{kept.out}: no frame has a pose; nothing was written")
        return LiveRun(odometry.figures, odometry.warnings, samples)


def _rig_of(source: LiveSource, given: Rig | None) -> Rig:
    """Return the calibration that is given, else the source's; without an IMU where that has none.

    Raises:
        CalibrationError: there is none, or it lacks the pose of the source's IMU.
    """
    rig = given or source.rig
    if rig is None:
        raise CalibrationError("this source has no calibration of its own; give --calibration FILE")
    if not source.has_imu:
        return replace(rig, T_cam0_imu=None)
    if rig.T_cam0_imu is None:
        raise CalibrationError(
            "the calibration has no T_cam_imu for this camera's IMU; give one that has"
        )
    return rig


def _feed(
    source: LiveSource,
    odometry: LiveOdometry,
    recorder: Recorder | None,
    should_stop: Callable[[], object],
) -> int:
    """Give all events to odometry and recorder, and return the number of IMU samples."""
    samples = 0
    for event in source.events():
        if should_stop():
            break
        odometry.check()
        if event is None:
            continue
        if recorder is not None:
            recorder.add(event)
        if isinstance(event, SourceFrame):
            odometry.add_images(event.time_ns, event.left, event.right)
        else:
            samples += 1
            odometry.add_imu(event.time_ns, event.gyro, event.accel)
    return samples
