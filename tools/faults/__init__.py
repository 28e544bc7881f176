"""Recordings with faults of camera and IMU, and in healthy variants, run and tabled:
`python -m tools.faults`.
"""

from tools.faults.cameras import CAMERAS
from tools.faults.changes import Variant
from tools.faults.healthy import HEALTHY
from tools.faults.imu import IMU

GROUPS: dict[str, dict[str, Variant]] = {"healthy": HEALTHY, "cameras": CAMERAS, "imu": IMU}
