#!/usr/bin/env bash
# foxglove-sdk 0.30.3: a message of foxglove.messages cannot be read: it has no attributes for its fields, only
# `encode` and `get_schema`, and a Timestamp is the exception.
# Guessed: what is given as keyword argument is an attribute of the object.
# Matters here: a conversion from Foxglove must decode protobuf by the message's own schema; vio.interop.foxglove
# writes only.
# Source: foxglove.messages; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" foxglove-sdk==0.30.3
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

from foxglove import messages

pose = messages.Pose(position=messages.Vector3(x=1.0, y=2.0, z=3.0))
print("foxglove-sdk", version("foxglove-sdk"), pose)
names = [name for name in dir(pose) if not name.startswith("_")]
print("public names of a Pose:", names)
assert names == ["encode", "get_schema"]
assert (messages.Timestamp(5, 6).sec, messages.Timestamp(5, 6).nsec) == (5, 6)
try:
    pose.position
except AttributeError as error:
    print("pose.position:", error)
else:
    raise SystemExit("changed: a Pose has its position as an attribute")
PYTHON
