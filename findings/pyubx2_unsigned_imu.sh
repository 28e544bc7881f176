#!/usr/bin/env bash
# pyubx2 1.4.0: readings of the IMU of u-blox's dead-reckoning receivers (ESF-MEAS) come without their sign: a turn of -1.5 degrees/s is 16771072 units of 1/4096, 4094.5 degrees/s.
# Positive ones are right. ESF-INS, from which the same package reads the same receiver's turn, has its sign and is in degrees/s.
# Guessed: a number that the protocol calls signed comes with its sign, as all other signed fields do.
# Matters here: to use the receiver's IMU beside cameras each value above 2^23 must be lowered by 2^24, then divided by 4096 for a gyro (types 5, 13, 14: z, y, x), by 1024 for an accelerometer (16 to 18:
# x, y, z). A rig that turns to the left only, or a test with gravity upwards, shows nothing.
# Source: ublox_msgs/msg/EsfMEAS.msg of the ROS driver `ublox` for types, units and "signed"; ESF-MEAS (X24) in pyubx2/ubxtypes_get.py; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pyubx2==1.4.0
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import struct
from importlib.metadata import version

from pyubx2 import GET, UBXMessage, UBXReader

GYRO_Z, FORCE_Z = 5, 18  # types of data, and units a degree/s and a m/s^2
UNITS = {GYRO_Z: 4096, FORCE_Z: 1024}
print("pyubx2", version("pyubx2"))
for turn, force in ((1.5, 9.81), (-1.5, -9.81)):
    bits = [(round(x * UNITS[kind]) & 0xFFFFFF) | kind << 24 for x, kind in ((turn, GYRO_Z), (force, FORCE_Z))]
    message = UBXMessage("ESF", "ESF-MEAS", GET, payload=struct.pack("<IHHII", 1000, 2 << 11, 0, *bits))
    parsed = UBXReader.parse(message.serialize())
    assert (parsed.dataType_01, parsed.dataType_02) == (GYRO_Z, FORCE_Z)
    read = parsed.dataField_01 / UNITS[GYRO_Z], parsed.dataField_02 / UNITS[FORCE_Z]
    print(f"turn {turn} degrees/s, force {force} m/s^2: read as {read[0]:.1f} and {read[1]:.1f}")
    wraps = 2**24 if turn < 0 else 0
    assert abs(read[0] - turn - wraps / UNITS[GYRO_Z]) < 1e-3
    assert abs(read[1] - force - wraps / UNITS[FORCE_Z]) < 1e-3

rates = struct.pack("<IIIiiiiii", 0x3F01, 0, 1000, 0, 0, -1500, 0, 0, -981)
other = UBXReader.parse(UBXMessage("ESF", "ESF-INS", GET, payload=rates).serialize())
print("ESF-INS:", other.zAngRate, "degrees/s,", other.zAccel, "m/s^2")
assert (other.zAngRate, other.zAccel) == (-1.5, -9.81)
PYTHON
