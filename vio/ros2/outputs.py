"""What the node publishes: odometry, frames, path, landmarks, diagnostics."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vio.errors import VioError
from vio.findings import INTEGRITIES
from vio.geometry.lie import FloatArray, se3_inverse
from vio.interop.ros import to_fixed_axes_covariance
from vio.live.live_odometry import EstimateStream, LiveOdometry
from vio.records import NS_PER_S, BodyFrame, Estimate, Trajectory
from vio.ros2.sensors import Sensors
from vio.ros2.transport import Transport, publisher

log = logging.getLogger(__name__)

ODOMETRY = "odometry"
PATH = "path"
POINTS = "landmarks"
RESET = "reset"
SAVE = "save"
KINDS = {
    ODOMETRY: "nav_msgs/msg/Odometry",
    PATH: "nav_msgs/msg/Path",
    POINTS: "sensor_msgs/msg/PointCloud2",
}
_SLOW_NS = NS_PER_S  # between paths, landmarks and diagnostics


class _OutputRules(NamedTuple):
    """What messages hold."""

    path_poses: int = 2000  # the newest ones
    max_points: int = 20_000  # likewise
    unknown_variance: float = 1e6  # variance of what is not measured
    # (rad/s)^2 of a single sample: 0.01 rad/s, of cheap gyros at some hundred hertz
    gyro_variance: float = 1e-4


_OUTPUT = _OutputRules()


@dataclass(frozen=True, slots=True)
class FrameNames:
    """Names of the frames of /tf: the map, the odometry's world, and the body (IMU, or left
    camera without one).
    """

    map: str = "map"
    odom: str = "odom"
    base: str = "base_link"


class Outputs:
    """Publishes each estimate, in a thread of its own that ends with the odometry."""

    def __init__(
        self,
        transport: Transport,
        odometry: LiveOdometry,
        sensors: Sensors,
        *,
        frames: FrameNames,
        prefix: str,
        with_tf: bool,
    ) -> None:
        """Advertise, and begin to publish."""
        self._odometry = odometry
        self._sensors = sensors
        self._frames = frames
        self._with_tf = with_tf
        self._names = {name: f"{prefix}/{name}" for name in KINDS}
        topics = {self._names[name]: kind for name, kind in KINDS.items()}
        if with_tf:
            topics["/tf"] = "tf2_msgs/msg/TFMessage"
        late = (self._names[PATH], self._names[POINTS])
        self._out = publisher(transport, topics, latched=late)
        self._recent: deque[tuple[int, FloatArray]] = deque(maxlen=_OUTPUT.path_poses)
        self._failure: Exception | None = None
        self._slow_ns: int | None = None  # newest time of path, landmarks and diagnostics
        self._thread = threading.Thread(
            target=self._run, args=(iter(odometry),), name="ros2", daemon=True
        )
        self._thread.start()

    def check(self) -> None:
        """Raise what publishing has failed with.

        Raises:
            Exception: that error.
        """
        if self._failure is not None:
            raise self._failure

    def finish(self) -> None:
        """Publish what is left, after the odometry was closed or has failed."""
        self._thread.join()

    def _run(self, estimates: EstimateStream) -> None:
        trajectory = 0
        while (estimate := _next(estimates)) is not None:
            try:
                if estimates.trajectory != trajectory:
                    trajectory = estimates.trajectory
                    self._recent.clear()
                    self._slow_ns = None
                self._publish(estimate)
            except Exception as error:  # noqa: BLE001 # raised by `check`
                self._failure = error
                return

    def _publish(self, estimate: Estimate) -> None:
        time_ns = estimate.time_ns
        T = estimate.T_world_imu
        self._recent.append((time_ns, T))
        names = self._frames
        covariance = to_fixed_axes_covariance(T, estimate.covariance)
        self._out.odometry(
            self._names[ODOMETRY],
            (names.odom, names.base),
            time_ns,
            T,
            covariance,
            self._twist(estimate),
        )
        if self._with_tf:
            self._out.transform(names.odom, names.base, time_ns, T)
            if estimate.T_map_body is not None:
                self._out.transform(
                    names.map, names.odom, time_ns, estimate.T_map_body @ se3_inverse(T)
                )
        if self._slow_ns is None or time_ns - self._slow_ns >= _SLOW_NS:
            self._slow_ns = time_ns
            self._publish_slowly(time_ns, estimate)

    def _publish_slowly(self, time_ns: int, estimate: Estimate) -> None:
        self._out.path(self._names[PATH], self._frames.odom, self._path(), time_ns)
        figures = self._odometry.figures
        with contextlib.suppress(VioError):  # the odometry is being closed
            points = self._odometry.landmarks()
            sigmas = np.sqrt(
                np.trace(points.covariance[-_OUTPUT.max_points :], axis1=1, axis2=2) / 3.0
            )
            self._out.points(
                self._names[POINTS],
                self._frames.odom,
                time_ns,
                points.p_world[-_OUTPUT.max_points :],
                sigmas,
            )
        warnings = self._odometry.warnings
        integrity = estimate.integrity
        values = {
            "integrity": integrity,
            "findings": ", ".join(estimate.findings),
            "results": str(figures.results),
            "dropped": str(figures.dropped),
            "refused messages": str(self._sensors.refused + figures.refused),
            "latency median, ms": _number(figures.latency_median_ms),
            "latency 95 %, ms": _number(figures.latency_95_ms),
            "latency worst, ms": _number(figures.latency_worst_ms),
            "warnings": str(len(warnings)),
        }
        text = warnings[-1] if warnings else "running"
        level = max(INTEGRITIES.index(integrity), 1 if warnings else 0)
        self._out.diagnostics("vio", time_ns, level, text, values)

    def _path(self) -> Trajectory:
        """Return the newest poses."""
        body: BodyFrame = "cam0" if self._odometry.T_cam0_imu is None else "imu"
        times_ns = np.array([time_ns for time_ns, _ in self._recent], dtype=np.int64)
        return Trajectory(np.array([T for _, T in self._recent]), times_ns, body)

    def _twist(self, estimate: Estimate) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return linear and angular velocity (3,) of the body in its own axes, and their
        covariance (6, 6).
        """
        linear = np.zeros(3)
        angular = np.zeros(3)
        spread = np.eye(6) * _OUTPUT.unknown_variance
        R_body_world = estimate.T_world_imu[:3, :3].T
        if estimate.velocity_world is not None:
            linear = R_body_world @ estimate.velocity_world
            if estimate.velocity_covariance is not None:
                spread[:3, :3] = R_body_world @ estimate.velocity_covariance @ R_body_world.T
        if self._sensors.gyro is not None and estimate.gyro_bias is not None:
            angular = self._sensors.gyro - estimate.gyro_bias
            spread[3:, 3:] = np.eye(3) * _OUTPUT.gyro_variance
        return linear, angular, spread


def _next(estimates: EstimateStream) -> Estimate | None:
    """Return the next estimate; None: the odometry was closed, or has failed, which the node itself
    notices.
    """
    try:
        return next(estimates, None)
    except Exception:  # noqa: BLE001 # what the odometry has failed with
        return None


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
