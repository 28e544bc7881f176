"""Estimates as the flight controllers want them: forward, right, down, with covariance.

Two frames: the vehicle (`frd`: x forward, y right, z down; its origin is that of the estimated
body), and `local`, which stands still: z down, and x the heading at the start, or north where the
heading is given. Reference: MAVLink common message set, ODOMETRY (331) and
VISION_POSITION_ESTIMATE (102).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from vio.geometry.lie import FloatArray, quat_xyzw_from_rotation, so3_exp
from vio.records import Estimate

# a camera that looks ahead: z of it is forward, x right, y down
_R_FRD_CAM0: FloatArray = np.array(
    [
        [0.0, 0.0, 1.0],
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
    ]
)
_UPPER = np.triu_indices(6)
_MIN_HORIZONTAL = 0.1  # of a unit vector, to have a heading
_QUALITY = {"nominal": 100, "degraded": 50, "unusable": -1}
_CLOCK_NS = 10_000_000_000  # a stamp so near to a clock of this computer is of that clock
_ARRIVALS = 200  # among which the quickest is looked for


@dataclass(frozen=True, slots=True)
class Mounting:
    """How the left camera looks out of the vehicle, degrees.

    Turned by yaw to the right, then by pitch up, then by roll to the right; all 0: it looks ahead,
    level.
    """

    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0

    def R_frd_body(self, T_cam0_body: FloatArray) -> FloatArray:
        """Return the rotation (3, 3) of the estimated body in the vehicle."""
        turned = _R_zyx(*(math.radians(a) for a in (self.yaw_deg, self.pitch_deg, self.roll_deg)))
        return turned @ _R_FRD_CAM0 @ T_cam0_body[:3, :3]


@dataclass(frozen=True, slots=True)
class VehicleState:
    """What a message holds of an estimate."""

    time_ns: int
    p_local: FloatArray  # (3,) metres
    R_local_frd: FloatArray  # (3, 3)
    # (6, 6) of position and of rotations about the axes of `local`, m^2 and rad^2
    pose_covariance: FloatArray
    v_frd: FloatArray | None  # (3,) m/s; None: not estimated
    v_covariance: FloatArray | None  # (3, 3) in `frd`
    reset_counter: int  # 0 to 255: it counts what the position jumped by
    quality: int  # 1 to 100; 0: unknown; -1: failed

    @property
    def quaternion_wxyz(self) -> FloatArray:
        """Unit quaternion (4,) of the vehicle in `local`, w first and not negative."""
        x, y, z, w = quat_xyzw_from_rotation(self.R_local_frd)
        sign = -1.0 if w < 0 else 1.0
        return np.array([w, x, y, z]) * sign

    @property
    def roll_pitch_yaw(self) -> tuple[float, float, float]:
        """Angles of the vehicle in `local`, rad: about z, then y, then x."""
        R = self.R_local_frd
        pitch = math.asin(min(1.0, max(-1.0, -R[2, 0])))
        roll = math.atan2(R[2, 1], R[2, 2])
        yaw = math.atan2(R[1, 0], R[0, 0])
        return roll, pitch, yaw

    @property
    def pose_covariance_21(self) -> list[float]:
        """Upper triangle of the pose's covariance, row by row."""
        return [float(x) for x in self.pose_covariance[_UPPER]]

    @property
    def velocity_covariance_21(self) -> list[float]:
        """Upper triangle of the covariance of velocity and rates; NaN: unknown."""
        full = np.full((6, 6), np.nan)
        if self.v_covariance is not None:
            full[:3, :3] = self.v_covariance
        return [float(x) for x in full[_UPPER]]


class LocalFrame:
    """Turns estimates into `VehicleState`; a new trajectory begins a new frame."""

    def __init__(
        self, R_frd_body: FloatArray, *, is_upright: bool, heading_deg: float | None = None
    ) -> None:
        """Prepare; the first estimate of a trajectory says how the frame lies in its world.

        Args:
            R_frd_body: (3, 3) of the estimated body in the vehicle.
            is_upright: whether z of the world is up, as with an IMU; else the vehicle is taken to
                be level at the start.
            heading_deg: of the vehicle at the start, from north to the right; None: 0.
        """
        self._R_frd_body = R_frd_body
        self._is_upright = is_upright
        self._turn = so3_exp(np.array([0.0, 0.0, math.radians(heading_deg or 0.0)]))
        self._R_local_world: FloatArray | None = None
        self._trajectory = 0

    def state(self, estimate: Estimate, trajectory: int) -> VehicleState:
        """Return an estimate in these frames; `trajectory` counts the resets before it."""
        R_world_body = estimate.T_world_imu[:3, :3]
        R_world_frd = R_world_body @ self._R_frd_body.T
        if self._R_local_world is None or trajectory != self._trajectory:
            self._trajectory = trajectory
            self._R_local_world = self._turn @ self._begun(R_world_frd, estimate)
        R_local_world = self._R_local_world
        R_frd_world = R_world_frd.T
        # xi moves the position by -R rho and the rotation by -R phi, see `Estimate.covariance`
        turn = np.kron(np.eye(2), R_local_world @ R_world_body)
        v = estimate.velocity_world
        P = estimate.velocity_covariance
        return VehicleState(
            estimate.time_ns,
            R_local_world @ estimate.T_world_imu[:3, 3],
            R_local_world @ R_world_frd,
            turn @ estimate.covariance @ turn.T,
            None if v is None else R_frd_world @ v,
            None if v is None or P is None else R_frd_world @ P @ R_frd_world.T,
            trajectory % 256,
            quality_of(estimate),
        )

    def _begun(self, R_world_frd: FloatArray, estimate: Estimate) -> FloatArray:
        """Return the rotation (3, 3) from the world to `local`, whose x is the vehicle's heading
        now.
        """
        if not self._is_upright:
            return np.asarray(R_world_frd.T)
        gravity = estimate.gravity_world
        if gravity is None:
            down = np.array([0.0, 0.0, -1.0])
        else:
            down = gravity / np.linalg.norm(gravity)
        forward, _, below = R_world_frd.T
        level = forward - down * (forward @ down)
        if np.linalg.norm(level) < _MIN_HORIZONTAL:  # the nose points up or down
            belly = below - down * (below @ down)  # which then looks ahead or back
            level = math.copysign(1.0, -(forward @ down)) * belly
        level = level / np.linalg.norm(level)
        return np.array([level, np.cross(down, level), down])


def quality_of(estimate: Estimate) -> int:
    """Return ODOMETRY's quality in percent by the integrity of an estimate; -1: it is not to be
    used.
    """
    return _QUALITY[estimate.integrity]


class StampClock:
    """The clock that is told to the autopilot, in which stamps are sent.

    It is the computer's wall clock or its time since boot where the stamps are of either; else that
    since boot, in which a stamp is placed by the quickest arrival: by so much they are too late.
    """

    def __init__(self, wall_ns: int, boot_ns: int, stamp_ns: int) -> None:
        """Choose by a stamp, and by both clocks when it came."""
        self.is_wall = abs(wall_ns - stamp_ns) < _CLOCK_NS
        self.is_known = self.is_wall or abs(boot_ns - stamp_ns) < _CLOCK_NS
        self._delays: deque[int] = deque(maxlen=_ARRIVALS)

    def placed_ns(self, stamp_ns: int, now_ns: int) -> int:
        """Return a stamp on this clock; `now_ns` is its time as the stamp came."""
        if self.is_known:
            return stamp_ns
        self._delays.append(now_ns - stamp_ns)
        return stamp_ns + min(self._delays)


def _R_zyx(yaw: float, pitch: float, roll: float) -> FloatArray:
    """Rotation (3, 3) about z, then y, then x, rad."""
    about_z = so3_exp(np.array([0.0, 0.0, yaw]))
    about_y = so3_exp(np.array([0.0, pitch, 0.0]))
    return np.asarray(about_z @ about_y @ so3_exp(np.array([roll, 0.0, 0.0])))
