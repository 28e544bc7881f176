"""Sends each estimate to a flight controller, and answers its questions for the time."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, Literal, TypeAlias

from vio.errors import ConfigError, MissingDependencyError
from vio.live.live_odometry import EstimateStream, LiveOdometry
from vio.mavlink.link import MISSING, Link, open_link
from vio.mavlink.messages import LocalFrame, Mounting, StampClock, VehicleState

log = logging.getLogger(__name__)

Message: TypeAlias = Literal["odometry", "vision"]
_HEARTBEAT_S = 1.0
_NS_PER_US = 1000


@dataclass(frozen=True, slots=True)
class MavlinkSettings:
    """Where estimates go, and how the camera is mounted."""

    address: str  # udp:HOST:PORT or serial:DEVICE[:BAUD]
    message: Message = "odometry"  # "vision": VISION_POSITION_ESTIMATE, without velocity
    mounting: Mounting = field(default_factory=Mounting)
    # of the vehicle at the start, from north to the right; None: the frame begins with its heading
    heading_deg: float | None = None
    system: int = 1  # that of the vehicle


def mavlink_dialect() -> ModuleType:
    """Return pymavlink's common messages, version 2 of the protocol.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        from pymavlink.dialects.v20 import common
    except ImportError as error:
        raise MissingDependencyError(MISSING) from error
    module: ModuleType = common
    return module


class MavlinkOutput:
    """A thread that sends, and one that listens; both end with `close`."""

    def __init__(self, odometry: LiveOdometry, settings: MavlinkSettings) -> None:
        """Open the way, and begin to send.

        Raises:
            VioError: pymavlink is missing, or the way cannot be opened.
        """
        self._dialect = mavlink_dialect()
        self._link: Link = open_link(settings.address)
        self._settings = settings
        self._frame = LocalFrame(
            settings.mounting.R_frd_body(odometry.T_cam0_body),
            is_upright=odometry.motion == "imu",
            heading_deg=settings.heading_deg,
        )
        own = self._dialect.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
        self._mav: Any = self._dialect.MAVLink(self._link, settings.system, own)
        self._mav.robust_parsing = True  # what is no message is passed over
        self._sending = threading.Lock()
        self._clock: StampClock | None = None
        self._ended = threading.Event()
        self._said: set[str] = set()
        self._threads = [
            threading.Thread(target=self._send_all, args=(iter(odometry),), name="mavlink"),
            threading.Thread(target=self._listen, name="mavlink in"),
        ]
        for thread in self._threads:
            thread.daemon = True
            thread.start()

    def close(self) -> None:
        """Send what is left, after the odometry was closed, and let the way go."""
        self._threads[0].join()
        self._ended.set()
        self._threads[1].join()
        self._link.close()

    def __enter__(self) -> MavlinkOutput:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Out

    def _send_all(self, estimates: EstimateStream) -> None:
        while True:
            try:
                estimate = next(estimates, None)
            except Exception:  # noqa: BLE001 # what the odometry has failed with, raised elsewhere
                return
            if estimate is None:
                return
            state = self._frame.state(estimate, estimates.trajectory)
            with self._named_failures():
                self._send(state)

    def _send(self, state: VehicleState) -> None:
        time_us = max(0, self._placed_ns(state.time_ns) // _NS_PER_US)
        if self._settings.message == "odometry" and state.v_frd is not None:
            self._send_odometry(time_us, state)
            return
        if self._settings.message == "odometry":
            self._say("no velocity is estimated: VISION_POSITION_ESTIMATE is sent, not ODOMETRY")
        if state.quality < 0:  # which this message cannot state
            self._say("poses that are unusable are not sent, as their message has no quality")
            return
        with self._sending:
            self._mav.vision_position_estimate_send(
                time_us,
                *state.p_local.tolist(),
                *state.roll_pitch_yaw,
                state.pose_covariance_21,
                state.reset_counter,
            )

    def _send_odometry(self, time_us: int, state: VehicleState) -> None:
        names = self._dialect
        assert state.v_frd is not None
        is_north = self._settings.heading_deg is not None
        rates = [float("nan")] * 3  # neither autopilot uses them
        with self._sending:
            self._mav.odometry_send(
                time_us,
                names.MAV_FRAME_LOCAL_NED if is_north else names.MAV_FRAME_LOCAL_FRD,
                names.MAV_FRAME_BODY_FRD,
                *state.p_local.tolist(),
                state.quaternion_wxyz.tolist(),
                *state.v_frd.tolist(),
                *rates,
                state.pose_covariance_21,
                state.velocity_covariance_21,
                state.reset_counter,
                names.MAV_ESTIMATOR_TYPE_VIO,
                state.quality,
            )

    def _placed_ns(self, stamp_ns: int) -> int:
        if self._clock is None:
            self._clock = StampClock(time.time_ns(), time.monotonic_ns(), stamp_ns)
            if not self._clock.is_known:
                self._say(
                    "the stamps are of no clock of this computer; they are placed by the quickest "
                    "arrival, so that they are too late by its delay: set the autopilot's delay"
                )
        return self._clock.placed_ns(stamp_ns, self._now_ns())

    def _now_ns(self) -> int:
        """Return the time of the clock in which stamps are sent."""
        is_wall = self._clock is not None and self._clock.is_wall
        return time.time_ns() if is_wall else time.monotonic_ns()

    # In

    def _listen(self) -> None:
        beaten_s = 0.0
        while not self._ended.is_set():
            with self._named_failures():
                if time.monotonic() - beaten_s > _HEARTBEAT_S:
                    beaten_s = time.monotonic()
                    self._beat()
                self._answer(self._link.read())

    def _beat(self) -> None:
        names = self._dialect
        with self._sending:
            self._mav.heartbeat_send(
                names.MAV_TYPE_ONBOARD_CONTROLLER,
                names.MAV_AUTOPILOT_INVALID,
                0,
                0,
                names.MAV_STATE_ACTIVE,
            )

    def _answer(self, data: bytes) -> None:
        """Answer TIMESYNC, once it is known of which clock the stamps are; all else is passed
        over.
        """
        for message in self._mav.parse_buffer(data) or ():
            if message.get_type() == "TIMESYNC" and message.tc1 == 0 and self._clock is not None:
                with self._sending:
                    self._mav.timesync_send(self._now_ns(), message.ts1)

    @contextlib.contextmanager
    def _named_failures(self) -> Iterator[None]:
        """Name once why nothing can be sent or received; the next message is tried again."""
        try:
            yield
        except OSError as error:
            self._say(f"{self._settings.address}: {error.strerror or error}; tried again")
            self._ended.wait(0.1)

    def _say(self, line: str) -> None:
        if line not in self._said:
            self._said.add(line)
            log.warning("%s", line)


def checked_mounting(text: str) -> Mounting:
    """Return the mounting of ROLL,PITCH,YAW in degrees.

    Raises:
        ConfigError: these are no three numbers.
    """
    try:
        roll, pitch, yaw = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--mount {text}: give three angles in degrees, ROLL,PITCH,YAW") from None
    if not all(abs(angle) <= 360 for angle in (roll, pitch, yaw)):
        raise ConfigError(f"--mount {text}: angles are -360 to 360 degrees")
    return Mounting(roll, pitch, yaw)
