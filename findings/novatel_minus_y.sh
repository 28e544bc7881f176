#!/usr/bin/env bash
# novatel-edie 2.10.11, NovAtel's own decoder: `accel_y` and `gyro_y` of RAWIMUS and RAWIMUSX, and `del_vel_body_y` and `del_ang_body_y` of RAWIMU, are the fields that the receiver's manual calls
# -(Y Accel) and -(Y Gyro): readings along -y. Names, values and JSON have no sign of it, x and z are as they are called, and the sign stays when a log is converted.
# Guessed: `accel_y` is the acceleration along y; a minus sign of the wire format is taken off, or is in the name (in ROS's novatel_oem6_msgs it is: `accel_y_neg`).
# Matters here: such an IMU is left-handed, and no rotation of its extrinsics mends that: one that is calibrated fits some of the motions. `vio check` names the axis, the gyro's first.
# All readings are counts of increments, too: times scale and rate of the IMU's type.
# Source: https://docs.novatel.com/OEM7/Content/SPAN_Logs/RAWIMUSX.htm, whose example is decoded here; novatel_oem6_msgs/msg/RAWIMUS.msg for the sign; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" novatel-edie==2.10.11
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import json
from importlib.metadata import version

import novatel_edie as edie
from novatel_edie import oem

# by the manual: Z, -(Y), X of the change of velocity, then of the change of angle
WIRE = {"z": (329308016, 196192), "-y": (-2706935, 417138), "x": (4508389, -1000837)}
EXAMPLE = (
    "%RAWIMUSXA,2209,491674.014;04,41,2209,491674.013699,ea59fe00,"
    "329308016,-2706935,4508389,196192,417138,-1000837*038422a7\r\n"
)
parser = oem.Parser()
parser.write(EXAMPLE.encode())
(log,) = parser
fields = log.to_dict()
print("novatel-edie", version("novatel-edie"), log.name)
print({name: fields[name] for name in fields if name.startswith(("accel", "gyro"))})
assert (fields["accel_x"], fields["gyro_x"]) == WIRE["x"]
assert (fields["accel_z"], fields["gyro_z"]) == WIRE["z"]
assert (fields["accel_y"], fields["gyro_y"]) == WIRE["-y"]
assert "y_neg" not in str(list(fields))
stored = bytes(log.to_json().message).decode()
print("JSON:", [part for part in stored.split(",") if "_y" in part])
assert '"accel_y": -2706935' in stored
with edie.default_json_db_path() as path:
    database = json.loads(path.read_text())
for message in database["messages"]:
    if message["name"] in ("RAWIMU", "RAWIMUS", "RAWIMUSX"):
        (definition,) = list(message["fields"].values())[-1:]
        along_y = [field for field in definition if field["name"].endswith("_y")]
        print(message["name"], [(field["name"], field.get("description")) for field in along_y])
        assert len(along_y) == 2
        assert not any("-" in (field.get("description") or "") for field in along_y)
PYTHON
