"""Readers of GNSS positions: a table, KITTI's `oxts`, and NavSatFix messages of a bag."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vio.datasets.bags.index import stamp_of
from vio.datasets.bags.kinds import is_bag
from vio.datasets.bags.store import Bag
from vio.datasets.gnss_fixes import UP_SHARE, GnssFixes, checked_fixes
from vio.datasets.tables import (
    NumberTable,
    column_count,
    drive_times,
    read_logged_table,
    read_table,
    stamps_ns,
)
from vio.errors import DataError
from vio.files.stamps import Pace
from vio.files.text import check_increasing, text_lines
from vio.geometry.lie import FloatArray
from vio.records import BoolArray

_FORM = "time_s,latitude_deg,longitude_deg,height_m,sigma_east_m,sigma_north_m,sigma_up_m"
_SIGMA_WORDS = ("sigma", "std", "sd", "dev", "acc", "err")
# steps of receivers, whose stamps may be in ms, us or ns
_FIX_PACE = Pace("positions", 5e-3, 15.0, 5e-3)
_MOST_COLUMNS = 7  # of a table in the form above
# latitude, longitude and height, in names of columns; and in those of something else about them
_PLACES = tuple(
    re.compile(rf"(?:^|[^a-z]){words}(?:[^a-z]|$)")
    for words in (
        "lat(?:itude)?",
        "(?:lon|lng|long|longitude)",
        "(?:alt|altitude|height|elevation)",
    )
)
_NO_PLACE = re.compile("|".join((*_SIGMA_WORDS, "cov", "(?<!le)vel", "speed", "ref")))  # no level
_RADIANS = re.compile(r"[^a-z]rad")
# units of heights in names of columns, and their lengths in metres
_LENGTHS_M = tuple(
    (re.compile(rf"[^a-z](?:{names})(?:[^a-z]|$)"), length)
    for names, length in (("ft|feet|foot", 0.3048), ("mm", 1e-3), ("cm", 1e-2), ("km", 1e3))
)
# columns of letters that say on which side of the equator and of Greenwich a position lies
_HEMISPHERE = re.compile(r"\bn ?/ ?s\b|\be ?/ ?w\b|hemi|(?:lat|lon|lng)[a-z]*[ _.]?(?:dir|ref)")
_STATUS = re.compile(r"(?:^|[^a-z])status[./]status$")
_COVARIANCE = re.compile(r"position_covariance[^a-z]*\d\]?$")
_ACCURACY = re.compile(r"sigma|std|accuracy|^[hv]_?acc")  # in any form
_COVARIANCE_KIND = re.compile(r"position_covariance_type$")
_OTHER_FORMS = {
    ".gpx": "GPX",
    ".kml": "KML",
    ".nmea": "a receiver's NMEA",
    ".ubx": "a receiver's UBX",
    ".pos": "RTKLIB's solution (its time is that of GPS)",
    ".json": "JSON",
    ".geojson": "GeoJSON",
}
_OXTS_COLUMNS = 30
_OXTS_ACCURACY = 23  # column of pos_accuracy, m
_OXTS_MIN_M = 0.02
_NAVSATFIX = "sensor_msgs/msg/NavSatFix"
_NO_FIX = -1  # of status.status and of position_covariance_type
_UNKNOWN = 0


def read_gnss(path: Path, topic: str | None = None) -> GnssFixes:
    """Read positions from a table, a KITTI raw drive or its `oxts`, or a ROS bag.

    Raises:
        DataError: it holds no positions, or they are damaged.
    """
    oxts = path if path.name == "oxts" else path / "oxts"
    if (oxts / "data").is_dir():
        return _read_oxts(oxts)
    if path.exists() and is_bag(path):
        return _read_navsatfix(path, topic)
    if not path.is_file():
        raise DataError(
            f"{path}: holds no GNSS positions; give a table {_FORM}, a drive with oxts/data, or a "
            "bag"
        )
    return _read_csv(path)


def _read_csv(path: Path) -> GnssFixes:
    """Read a table with or without the standard deviations; empty or NaN: not known."""
    if path.suffix.lower() in _OTHER_FORMS:
        raise DataError(
            f"{path}: {_OTHER_FORMS[path.suffix.lower()]} is not read; write its positions as a table "
            f"{_FORM}"
        )
    if column_count(path) > _MOST_COLUMNS:
        return _read_logged(path)
    columns = 4 if _width_of_last_row(path) == 4 else 7
    table = read_table(path, columns, _FORM)
    values = table.values
    if table.header:
        order = _order(table.header)
        if order is None and _places_in(table.header) is not None:
            return _read_logged(path)
        if order is None:
            raise DataError(f"{path}: has the columns {','.join(table.header)}; expected {_FORM}")
        values = values[:, [*order, *range(2, columns - 1)]]
    if columns == 7:
        sigmas = values[:, 3:].copy()
    else:
        sigmas = np.full((len(values), 3), np.nan)
    no_up = np.isnan(sigmas[:, 2])
    sigmas[no_up, 2] = UP_SHARE * sigmas[no_up, :2].max(axis=1)
    notes = list[str]()
    times_ns = check_increasing(stamps_ns(table, _FIX_PACE, notes), table.where)
    covariance = np.eye(3) * sigmas[:, None, :] ** 2
    return checked_fixes(times_ns, values[:, :3], covariance, str(path), tuple(notes))


def _read_logged(path: Path) -> GnssFixes:
    """Read a table of more columns, or in another order, by the names in its header: NavSatFix
    messages that a program wrote a row each, or a logger's.
    """
    notes = list[str]()
    table = read_logged_table(path, _FORM, notes)
    places = _places_in(table.header)
    if places is None:
        raise DataError(
            f"{path}: no header names one column of latitude and one of longitude; name them, or write "
            f"{_FORM}"
        )
    values = table.values
    sides = [
        name
        for k, name in enumerate(table.header[1:])
        if _HEMISPHERE.search(name) and np.isnan(values[:, k]).all()
    ]
    if sides:
        raise DataError(
            f"{path}: hemispheres by letters ({', '.join(sides)}) are not read; write south and west "
            "as negative degrees, without these columns"
        )
    position = np.full((len(values), 3), np.nan)
    for k, column in enumerate(places):
        if column is not None:
            position[:, k] = _unit(table.header[1 + column], k == 2) * values[:, column]
    times_ns = stamps_ns(table, _FIX_PACE, notes)
    fixed = _have_a_fix(table)
    if not fixed.all():
        notes.append(f"{path}: {int((~fixed).sum())} rows say that there is no fix")
    covariance = _covariance_in(table)[fixed]
    unread = [name for name in table.header[1:] if _ACCURACY.search(name)]
    if unread and np.isnan(covariance).all():
        notes.append(
            f"{path}: {', '.join(unread)}: accuracies beside other columns are not read; write {_FORM} "
            "where they count"
        )
    return checked_fixes(times_ns[fixed], position[fixed], covariance, str(path), tuple(notes))


def _unit(name: str, is_height: bool) -> float:
    """Return the unit that the name of a column states, in degrees, or in metres of a height."""
    if is_height:
        return next((length for unit, length in _LENGTHS_M if unit.search(name)), 1.0)
    return 180.0 / np.pi if _RADIANS.search(name) else 1.0


def _places_in(header: Sequence[str]) -> tuple[int, int, int | None] | None:
    """Return which columns behind the stamp are latitude, longitude and height (None: there is
    none); None: no header names both of the former, or several columns do.
    """
    found = [
        [
            k
            for k, name in enumerate(header[1:])
            if place.search(name) and not _NO_PLACE.search(name)
        ]
        for place in _PLACES
    ]
    latitude, longitude, height = found
    if len(latitude) != 1 or len(longitude) != 1:
        return None
    return latitude[0], longitude[0], height[0] if len(height) == 1 else None


def _have_a_fix(table: NumberTable) -> BoolArray:
    """Return which rows (N,) have a fix by the status of their NavSatFix; all: none is stated."""
    status = [k for k, name in enumerate(table.header[1:]) if _STATUS.search(name)]
    if len(status) != 1:
        return np.ones(len(table.values), dtype=np.bool_)
    return ~(table.values[:, status[0]] <= _NO_FIX)


def _covariance_in(table: NumberTable) -> FloatArray:
    """Return the covariance (N, 3, 3) of east, north and up, m^2, by nine columns; NaN: there are
    none.
    """
    names = [_COVARIANCE.search(name) for name in table.header[1:]]
    columns = [k for k, name in enumerate(names) if name]
    if len(columns) != 9:
        return np.full((len(table.values), 3, 3), np.nan)
    covariance = table.values[:, columns].reshape(-1, 3, 3)
    kinds = [k for k, name in enumerate(table.header[1:]) if _COVARIANCE_KIND.search(name)]
    if len(kinds) == 1:
        covariance[table.values[:, kinds[0]] == _UNKNOWN] = np.nan
    return covariance


def _order(header: Sequence[str]) -> tuple[int, int] | None:
    """Return which columns behind the stamp are latitude and longitude, by a header whose further
    columns are height and standard deviations; None: it names others, or other units.
    """
    if len(header) < 3 or not re.search("time|stamp|^t$", header[0]):
        return None
    if any(not any(word in name for word in _SIGMA_WORDS) for name in header[4:]):
        return None
    if any(_NO_PLACE.search(name) for name in header[3:4]):  # a speed
        return None
    if any(_unit(name, k == 2) != 1.0 for k, name in enumerate(header[1:4])):
        return None
    for order in ((0, 1), (1, 0)):
        if "lat" in header[1 + order[0]] and re.search("lon|lng", header[1 + order[1]]):
            return order
    return None


def _width_of_last_row(path: Path) -> int:
    """Return how many cells the last row of a table has that is no comment; 0: there is none."""
    last = ""
    for _, line in text_lines(path):
        if line.strip() and not line.lstrip().startswith("#"):
            last = line.replace(";", ",")
    return len(last.split("," if "," in last else None))


def _read_oxts(folder: Path) -> GnssFixes:
    """Read KITTI's records of its GNSS/INS unit; the position is that of the IMU."""
    files = sorted(file for file in (folder / "data").glob("*.txt") if file.stem.isdecimal())
    if not files:
        raise DataError(f"{folder / 'data'}: holds no record; copy it again")
    rows = []
    for file in files:
        words = " ".join(line for _, line in text_lines(file)).split()
        if len(words) != _OXTS_COLUMNS:
            raise DataError(
                f"{file}: has {len(words)} values, not the {_OXTS_COLUMNS} of KITTI's oxts; copy "
                "it again"
            )
        try:
            rows.append([float(word) for word in words])
        except ValueError as error:
            raise DataError(f"{file}: {error}; copy it again") from error
    values = np.array(rows)
    times_ns = drive_times(
        folder / "timestamps.txt", np.array([int(file.stem) for file in files], dtype=np.int64)
    )
    sigma = np.maximum(values[:, _OXTS_ACCURACY], _OXTS_MIN_M)
    return checked_fixes(
        times_ns, values[:, :3], sigma[:, None, None] ** 2 * np.eye(3), str(folder)
    )


def _read_navsatfix(path: Path, topic: str | None) -> GnssFixes:
    """Read the positions of a bag's only topic of NavSatFix, or of the one named."""
    times = []
    positions = []
    covariances = []
    lost = 0
    with Bag(path) as bag:
        name = _topic_of_fixes(bag, path, topic)
        for message in bag.messages([name]):
            fix = bag.decoded(message)
            if int(fix.status.status) <= _NO_FIX:
                lost += 1
                continue
            times.append(stamp_of(fix) or message.logged_ns)
            positions.append([float(fix.latitude), float(fix.longitude), float(fix.altitude)])
            covariance = np.full(9, np.nan)
            if int(fix.position_covariance_type) != _UNKNOWN:
                covariance = np.array(fix.position_covariance, dtype=np.float64)
            covariances.append(covariance.reshape(3, 3))
    notes = (f"{lost} messages of {name} say that there is no fix",) if lost else ()
    if not times:
        raise DataError(f"{path}: {name} holds no position; give a record with a fix")
    return checked_fixes(
        np.array(times, dtype=np.int64),
        np.array(positions),
        np.array(covariances),
        f"{path}, {name}",
        notes,
    )


def _topic_of_fixes(bag: Bag, path: Path, named: str | None) -> str:
    """Return the only topic of NavSatFix that has messages, or the one named.

    Raises:
        DataError: there are none or several.
    """
    found = [
        t.name for t in bag.topics if t.kind == _NAVSATFIX and t.count and named in (None, t.name)
    ]
    if len(found) != 1:
        names = ", ".join(found) or "none"
        raise DataError(
            f"{path}: topics of NavSatFix: {names}; name one with --topic, or give another bag"
        )
    return found[0]
