"""The node: waits for the calibration, then feeds an odometry from the graph and publishes what
it finds.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from vio.cameras.rig import Rig
from vio.config import Config
from vio.errors import CalibrationError, VioError
from vio.live.build import MapUse
from vio.live.live_odometry import LiveOdometry
from vio.live.worker import Drop
from vio.mavlink.output import MavlinkOutput, MavlinkSettings
from vio.numerics.kinds import Capacity
from vio.ros2.calibration import CameraInfos
from vio.ros2.outputs import RESET, SAVE, FrameNames, Outputs
from vio.ros2.sensors import SILENT_S, Sensors, SensorTopics, Silence, check_types
from vio.ros2.transport import Quality, Transport
from vio.runs.live_folder import LiveFolder, LiveRunSettings

log = logging.getLogger(__name__)

_SPIN_S: Capacity[float] = 0.1
_EMPTY = "std_msgs/msg/Empty"


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """What a node subscribes to, and how it publishes."""

    topics: SensorTopics
    frames: FrameNames = field(default_factory=FrameNames)
    prefix: str = "/vio"  # of the names of what it publishes, and of reset and save
    # of the subscriptions: "reliable" loses nothing, and needs reliable publishers
    quality: Quality = "sensor"
    drop: Drop = "oldest"  # see `LiveOdometry`
    with_tf: bool = True
    kept: LiveRunSettings | None = None  # run folder, which grows
    map: MapUse | None = None
    mavlink: MavlinkSettings | None = None  # where poses also go


def run_node(
    transport: Transport,
    settings: NodeSettings,
    config: Config,
    rig: Rig | None,
    *,
    should_stop: Callable[[], object],
    say: Callable[[str], None],
) -> None:
    """Run until it is asked to stop; the map and the run folder are written as results come, and
    finished however the node ends.

    Raises:
        VioError: a topic has another type, the estimation has failed, or the folder could not be
            written, which ends nothing before.
    """
    topics = settings.topics
    check_types(topics.kinds, transport)
    found = rig or _awaited(transport, topics, should_stop, say)
    if found is None:
        return
    if topics.imu is None:
        config = replace(config, motion="none")
    elif found.T_cam0_imu is None:
        raise CalibrationError(
            f"the calibration has no T_cam_imu, so that {topics.imu} cannot be used; leave --imu "
            "out"
        )
    outputs: Outputs | None = None
    others = contextlib.ExitStack()
    if settings.kept is None:
        folder = None
    else:
        folder = LiveFolder(settings.kept, config, found)
    odometry = LiveOdometry(
        found, config, drop=settings.drop, map=settings.map, copy_images=False, sink=folder
    )
    try:
        with others, odometry:  # which is closed first
            say("warming up")
            odometry.warm_up()
            if settings.mavlink is not None:
                others.enter_context(MavlinkOutput(odometry, settings.mavlink))
            sensors = Sensors(transport, topics, odometry, settings.quality)
            outputs = Outputs(
                transport,
                odometry,
                sensors,
                frames=settings.frames,
                prefix=settings.prefix,
                with_tf=settings.with_tf,
            )
            _take_requests(transport, settings, odometry, folder)
            say(f"ready: {', '.join(topics.kinds)} to {settings.prefix}")
            silence = Silence(topics.kinds)
            while not should_stop():
                transport.spin(_SPIN_S)
                for line in silence.check(sensors.received, transport):
                    log.warning("%s", line)
                odometry.check()
                outputs.check()
    finally:
        if outputs is not None:
            outputs.finish()
        if folder is not None:
            folder.close()


def _take_requests(
    transport: Transport,
    settings: NodeSettings,
    odometry: LiveOdometry,
    folder: LiveFolder | None,
) -> None:
    """Subscribe to the topics of reset and save; what cannot be done is said, and ends nothing."""

    def reset(_: bytes) -> None:
        try:
            odometry.reset()
        except VioError as error:
            odometry.check()
            log.warning("reset: %s", error)

    def save(_: bytes) -> None:
        if folder is None:
            log.warning(
                "save was asked for, but the node has no folder; start it with --out FOLDER"
            )
        elif folder.has_poses:
            folder.save()
        else:
            log.warning("save: there is no pose yet, nothing was written")

    transport.subscribe(f"{settings.prefix}/{RESET}", _EMPTY, reset, "reliable")
    transport.subscribe(f"{settings.prefix}/{SAVE}", _EMPTY, save, "reliable")


def _awaited(
    transport: Transport,
    topics: SensorTopics,
    should_stop: Callable[[], object],
    say: Callable[[str], None],
) -> Rig | None:
    """Wait for the calibration from the graph; None: it was asked to stop."""
    infos = CameraInfos(transport, topics)
    silence = None
    since = time.monotonic()
    while not should_stop():
        rig = infos.rig()
        if rig is not None:
            return rig
        transport.spin(_SPIN_S)
        if silence is None and time.monotonic() - since > SILENT_S:
            silence = True
            say(infos.waits_for())
    return None
