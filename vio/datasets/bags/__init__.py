"""ROS bags: ROS 1 `.bag`, ROS 2 folders, `.db3` and `.mcap` files, read with the library
rosbags.
"""

from __future__ import annotations

from pathlib import Path

from vio.datasets.bags.kinds import is_bag
from vio.datasets.reader import Reader
from vio.datasets.settings import DatasetSettings
from vio.protocols import Dataset


def _read(path: Path, settings: DatasetSettings) -> Dataset:
    from vio.datasets.bags.reader import read_bag

    return read_bag(path, settings)


READERS = (
    Reader(
        kind="bag",
        looked_for="a ROS bag (.bag, .db3, .mcap)",
        read=_read,
        is_folder=is_bag,
        is_file=is_bag,
        calibrated_as="bag",
    ),
)
