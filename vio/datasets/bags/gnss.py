"""GNSS positions in a ROS bag: sensor_msgs/NavSatFix."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vio.datasets.bags.index import stamp_of
from vio.datasets.bags.store import Bag
from vio.earth.gnss import GnssFixes, checked_fixes
from vio.errors import DataError

NAVSATFIX = "sensor_msgs/msg/NavSatFix"
_NO_FIX, _UNKNOWN = -1, 0  # of status.status and of position_covariance_type


def read_navsatfix(path: Path, topic: str | None) -> GnssFixes:
    """Read the positions of a bag's only topic of NavSatFix, or of the one named.

    Raises:
        DataError: there is no such topic, or several, or the bag is damaged.
    """
    times, positions, covariances, lost = [], [], [], 0
    with Bag(path) as bag:
        found = [t.name for t in bag.topics if t.kind == NAVSATFIX and t.count and topic in (None, t.name)]
        if len(found) != 1:
            names = ", ".join(found) or "none"
            raise DataError(f"{path}: topics of NavSatFix: {names}; name one with --topic, or give another bag")
        for message in bag.messages(found):
            fix = bag.decoded(message)
            if int(fix.status.status) <= _NO_FIX:
                lost += 1
                continue
            known = int(fix.position_covariance_type) != _UNKNOWN
            times.append(stamp_of(fix) or message.logged_ns)
            positions.append([float(fix.latitude), float(fix.longitude), float(fix.altitude)])
            covariances.append(
                np.array(fix.position_covariance, dtype=np.float64).reshape(3, 3) if known else np.full((3, 3), np.nan)
            )
    notes = (f"{lost} messages of {found[0]} say that there is no fix",) if lost else ()
    if not times:
        raise DataError(f"{path}: {found[0]} holds no position; give a record with a fix")
    return checked_fixes(
        np.array(times, dtype=np.int64), np.array(positions), np.array(covariances), f"{path}, {found[0]}", notes
    )
