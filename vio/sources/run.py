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
from vio.geometry.lie import FloatArray
from vio.live.build import MapUse
from vio.live.figures import LiveFigures
from vio.live.live_odometry import LiveOdometry
from vio.live.results import write_results
from vio.live.worker import Drop
from vio.records import FrameResult
from vio.sources.recorder import Form, Recorder
from vio.sources.source import LiveSource, SourceFrame


@dataclass(frozen=True, slots=True)
class LiveRun:
    """What a live run leaves behind."""

    figures: LiveFigures
    warnings: tuple[str, ...]
    samples: int  # of the IMU


def run_source(
    source: LiveSource,
    config: Config,
    rig: Rig | None,
    *,
    should_stop: Callable[[], object],
    say: Callable[[str], None],
    out: Path | None = None,
    record: Path | None = None,
    record_as: Form = "plain",
    map: MapUse | None = None,
    drop: Drop = "oldest",
    on_start: Callable[
        [LiveOdometry, Rig], Callable[[FrameResult], None] | None
    ] = lambda odometry, rig: None,
) -> LiveRun:
    """Run until the source ends or is asked to stop; then write what was asked for.

    Args:
        source: opened; it is closed at the end.
        config: every setting.
        rig: calibration in place of the device's.
        should_stop: asked with each event, and about each second.
        say: reports that it is ready.
        out: folder for `trajectory.tum` and the calibration that was found.
        record: new folder for what the source gave, which `vio run` repeats.
        record_as: its form, see `Recorder`.
        map: a map to begin or to continue.
        drop: see `LiveOdometry`.
        on_start: may return what is called with each result, a viewer's.

    Raises:
        VioError: there is no calibration, images do not fit it, or source, disk or estimation have
            failed.
    """
    with contextlib.closing(source):
        rig = rig or source.rig
        if rig is None:
            raise CalibrationError(
                "this source has no calibration of its own; give --calibration FILE"
            )
        if source.has_imu and rig.T_cam0_imu is None:
            raise CalibrationError(
                "the calibration has no T_cam_imu for this camera's IMU; give one that has"
            )
        if not source.has_imu:
            config = replace(config, motion="none")
            rig = replace(rig, T_cam0_imu=None)
        poses: list[tuple[int, FloatArray]] = []
        watcher: Callable[[FrameResult], None] | None = None

        def on_frame(result: FrameResult) -> None:
            poses.append((result.estimate.time_ns, result.estimate.T_world_imu))
            if watcher is not None:
                watcher(result)

        samples = 0
        odometry = LiveOdometry(
            rig, config, on_frame=on_frame, map=map, drop=drop, copy_images=False
        )
        try:
            with odometry, contextlib.ExitStack() as stack:
                say("warming up")
                odometry.warm_up()
                watcher = on_start(odometry, rig)
                recorder = None if record is None else Recorder(record, rig, record_as)
                if recorder is not None:
                    stack.callback(recorder.close)
                say("ready")
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
        finally:  # however it ends, what was computed is kept
            if out is not None and poses:
                write_results(out, odometry, poses)
        if out is not None and not poses:
            raise DataError(f"{out}: no frame has a pose; nothing was written")
        return LiveRun(odometry.figures, odometry.warnings, samples)
