#!/usr/bin/env bash
# rosbags 0.11.9: `end_time` of a reader is 1 ns after the last message and `duration` 1 ns longer than the bag's own metadata
# say, so that `messages(stop=end_time)`, whose stop is exclusive, gives all of them.
# Guessed: the time of the last message, and an inclusive stop.
# Matters here: who asks for the messages up to a frame's time loses those at it; stop must be one more.
# Source: rosbags.rosbag2.Reader; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" rosbags==0.11.9
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import tempfile
from importlib.metadata import version
from pathlib import Path

from rosbags.rosbag2 import Reader, Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_HUMBLE)
kind = "std_msgs/msg/String"
path = Path(tempfile.mkdtemp()) / "bag"
with Writer(path, version=9) as writer:
    topic = writer.add_connection("/a", kind, typestore=store)
    for time_ns in (1000, 2000, 3000):
        writer.write(topic, time_ns, store.serialize_cdr(store.types[kind](data="x"), kind))
stated = "nanoseconds: 2000" in (path / "metadata.yaml").read_text()
with Reader(path) as reader:
    to_last = [time_ns for _, time_ns, _ in reader.messages(stop=3000)]
    print("rosbags", version("rosbags"), "last message at 3000 ns: end_time", reader.end_time)
    print("duration", reader.duration, "metadata state 2000:", stated, "messages(stop=3000)", to_last)
    assert (reader.end_time, reader.duration, stated) == (3001, 2001, True)
    assert to_last == [1000, 2000]
PYTHON
