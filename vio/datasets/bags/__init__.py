"""ROS bags: ROS 1 `.bag`, ROS 2 folders, `.db3` and `.mcap` files, read with the library rosbags (extra `bags`)."""

from __future__ import annotations

from pathlib import Path

_ROS1, _SQLITE, _MCAP = b"#ROSBAG V", b"SQLite format 3\0", b"\x89MCAP0\r\n"
_SUFFIXES = (".bag", ".db3", ".mcap")


def is_bag(path: Path) -> bool:
    """Return whether a file or folder is a ROS bag, by its beginning or by ROS 2's `metadata.yaml`."""
    if path.is_dir():
        return bool(bag_files(path))
    with path.open("rb") as stream:
        return stream.read(16).startswith((_ROS1, _SQLITE, _MCAP))


def bag_files(path: Path) -> tuple[Path, ...]:
    """Return what is opened together: a ROS 2 folder or a file itself, or all bags of a folder by name."""
    if not path.is_dir():
        return (path,)
    metadata = path / "metadata.yaml"
    if metadata.is_file() and "rosbag2_bagfile_information" in metadata.read_text(encoding="utf-8", errors="replace"):
        return (path,)
    found = sorted(child for child in path.iterdir() if child.suffix in _SUFFIXES and child.is_file())
    suffixes = {child.suffix for child in found}
    return tuple(found) if len(suffixes) == 1 else ()
