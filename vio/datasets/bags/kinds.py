"""Which files and folders are ROS bags."""

from __future__ import annotations

import re
from pathlib import Path

_ROS1 = b"#ROSBAG V"
_SQLITE = b"SQLite format 3\0"
_MCAP = b"\x89MCAP0\r\n"
_SUFFIXES = (".bag", ".db3", ".mcap")
# at the level of the whole bag, as topics with none are usual
_NO_MESSAGE = re.compile(r"^  message_count: *0 *$", re.MULTILINE)


def is_bag(path: Path) -> bool:
    """Return whether a file or folder is a ROS bag, by its beginning or by ROS 2's
    `metadata.yaml`.
    """
    if path.is_dir():
        return bool(bag_files(path))
    with path.open("rb") as stream:
        return stream.read(16).startswith((_ROS1, _SQLITE, _MCAP))


def bag_files(path: Path) -> tuple[Path, ...]:
    """Return what is opened together: a ROS 2 folder or a file itself, or all bags of one kind
    of a folder by name.
    """
    if not path.is_dir() or _is_ros2_folder(path):
        return (path,)
    children = sorted(path.iterdir())
    found = tuple(child for child in children if child.suffix in _SUFFIXES and child.is_file())
    suffixes = {child.suffix for child in found}
    if len(suffixes) > 1:
        return ()
    return found or tuple(filter(_is_folder_of_ros2, children))


def _is_folder_of_ros2(path: Path) -> bool:
    return path.is_dir() and _is_ros2_folder(path)


def _is_ros2_folder(path: Path) -> bool:
    """Tell whether a folder's `metadata.yaml` is that of its files.

    A recorder that was killed leaves one that counts no message, and files that were renamed are
    not in it: then they are opened without.
    """
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        return False
    text = metadata.read_text(encoding="utf-8", errors="replace")
    if "rosbag2_bagfile_information" not in text:
        return False
    named = {name.strip(" -'\"").replace("\\", "/").rsplit("/", 1)[-1] for name in text.split("\n")}
    files = [child for child in path.iterdir() if child.suffix in _SUFFIXES[1:]]
    counted = _NO_MESSAGE.search(text) is None
    return not files or (counted and any(child.name in named for child in files))
