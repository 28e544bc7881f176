#!/usr/bin/env bash
# pymavlink 2.4.50: unless MAVLINK20 is set in the environment before it is imported, `mavutil` speaks MAVLink 1. There a vision position has no
# covariance: the covariance that is given after the yaw is taken for the argument `force_mavlink1` and is not sent, without a word. ODOMETRY does not exist.
# Guessed: MAVLink 2, the present protocol; or an error for an argument that the message does not have.
# Matters here: poses of a visual-inertial system that a script sends on arrive without covariance, and the autopilot uses its own constant noise.
# `pymavlink.dialects.v20.common`, which `vio live --mavlink` imports, does not ask the environment.
# Source: https://mavlink.io/en/mavgen_python/ (MAVLINK20); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pymavlink==2.4.50
cat >"$folder/send.py" <<'PYTHON'
from importlib.metadata import version

from pymavlink import mavutil


class Wire:
    data = b""

    def write(self, data):
        self.data += data


wire = Wire()
sender = mavutil.mavlink.MAVLink(wire)
covariance = [float(k) for k in range(1, 22)]  # the upper triangle, row by row
sender.vision_position_estimate_send(1_000_000, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3, covariance)
received = mavutil.mavlink.MAVLink(Wire()).parse_buffer(wire.data)[0]
print(
    "pymavlink", version("pymavlink"), "wire protocol", mavutil.mavlink.WIRE_PROTOCOL_VERSION, "bytes:", len(wire.data),
    "covariance:", getattr(received, "covariance", None), "ODOMETRY:", hasattr(mavutil.mavlink, "MAVLink_odometry_message"),
)
PYTHON
default=$(env -u MAVLINK20 PYTHONPATH="$folder/packages" python3 "$folder/send.py")
second=$(MAVLINK20=1 PYTHONPATH="$folder/packages" python3 "$folder/send.py")
echo "default:     $default"
echo "MAVLINK20=1: $second"
[[ $default == *"protocol 1.0"*"covariance: None ODOMETRY: False" ]]
[[ $second == *"protocol 2.0"*"covariance: [1.0, 2.0, "*"ODOMETRY: True" ]]
