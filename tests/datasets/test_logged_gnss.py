"""Tables of GNSS positions as programs write messages, and as loggers write their own columns."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vio.datasets.gnss import read_gnss
from vio.errors import DataError

FIRST_NS = 1700000000_000000000
Row = Callable[[int, float, float, float], str]
POSITIONS = [(49.0 + 1e-6 * k, 8.4 - 2e-6 * k, 116.0 + 0.1 * k) for k in range(5)]
TIMES_NS = [FIRST_NS + 200_000_000 * k for k in range(5)]
COVARIANCE = "0.04,0,0,0,0.09,0,0,0,0.16"


def written(path: Path, header: str, row: Row) -> Path:
    """Write a table with a row for each of the positions."""
    rows = (row(t, *position) for t, position in zip(TIMES_NS, POSITIONS, strict=True))
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def covariances(form: str) -> str:
    """Return the nine names of a covariance's columns."""
    return ",".join(form.format(k) for k in range(9))


ECHOED = (
    "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.status.status,"
    "field.status.service,field.latitude,field.longitude,field.altitude,"
    + covariances("field.position_covariance{}")
)
IN_PARTS = (
    "Time,header.seq,header.stamp.secs,header.stamp.nsecs,header.frame_id,status.status,"
    "latitude,longitude,altitude," + covariances("position_covariance_{}")
)
PHONE = "time,seconds_elapsed,horizontalAccuracy,speed,bearing,altitude,longitude,latitude"


@pytest.mark.parametrize(
    ("header", "row", "stated"),
    [
        (ECHOED, lambda t, a, o, h: f"{t + 7},1,{t},gps,0,1,{a!r},{o!r},{h!r},{COVARIANCE}", True),
        (
            IN_PARTS,
            lambda t, a, o, h: f"{t / 1e9},1,{t // 10**9},{t % 10**9},gps,0,{a!r},{o!r},{h!r},{COVARIANCE}",
            True,
        ),
        (PHONE, lambda t, a, o, h: f"{t},0.5,4,1,2,{h!r},{o!r},{a!r}", False),
        (
            "time_ns,x,lat_rad,lon_rad,alt,q,r,s",
            lambda t, a, o, h: f"{t},0,{math.radians(a)!r},{math.radians(o)!r},{h!r},1,1,1",
            False,
        ),
        (
            "time_ns,lat,lon,alt,vn,ve,vd",  # speeds in the places of standard deviations
            lambda t, a, o, h: f"{t},{a!r},{o!r},{h!r},0.1,0.1,0.1",
            False,
        ),
        ("time_ns,alt,lat,lon", lambda t, a, o, h: f"{t},{h!r},{a!r},{o!r}", False),
        # units of a short table, the time behind what it belongs to, and a name with "vel" in it
        (
            "time_ns,lat [rad],lon [rad],alt (mm)",
            lambda t, a, o, h: f"{t},{math.radians(a)!r},{math.radians(o)!r},{1e3 * h!r}",
            False,
        ),
        (
            "altitude(feet),lat,lon,x,y,z,w,time_ns",
            lambda t, a, o, h: f"{h / 0.3048!r},{a!r},{o!r},1,1,1,1,{t}",
            False,
        ),
        (
            "time_ns,lat,lon,altitude_above_sea_level,x,y,z,w",
            lambda t, a, o, h: f"{t},{a!r},{o!r},{h!r},1,1,1,1",
            False,
        ),
        (  # a covariance that the message says is not known
            f"{ECHOED},field.position_covariance_type",
            lambda t, a, o, h: f"{t + 7},1,{t},gps,0,1,{a!r},{o!r},{h!r},{COVARIANCE},0",
            False,
        ),
    ],
)  # fmt: skip
def test_positions_are_found_by_the_names_of_columns(
    header: str, row: Row, stated: bool, tmp_path: Path
) -> None:
    fixes = read_gnss(written(tmp_path / "gps.csv", header, row))
    assert fixes.times_ns.tolist() == TIMES_NS
    np.testing.assert_allclose(fixes.geodetic, POSITIONS, rtol=1e-14)
    variances = np.diagonal(fixes.covariance[0])
    expected = [0.04, 0.09, 0.16] if stated else [9.0, 9.0, 36.0]
    np.testing.assert_allclose(variances, expected, atol=2e-4)


@pytest.mark.parametrize("status", [-1, -2])  # none, and not known yet
def test_messages_without_a_fix_are_left_out(status: int, tmp_path: Path) -> None:
    path = written(
        tmp_path / "fix.csv", ECHOED,
        lambda t, a, o, h: f"{t},1,{t},gps,{status if t == TIMES_NS[1] else 0},1,{a},{o},{h},{COVARIANCE}",
    )  # fmt: skip
    fixes = read_gnss(path)
    assert fixes.times_ns.tolist() == [TIMES_NS[0], *TIMES_NS[2:]]
    assert any("1 rows say that there is no fix" in note for note in fixes.notes)


def test_accuracies_that_are_not_read_are_named(tmp_path: Path) -> None:
    path = written(tmp_path / "gps.csv", PHONE, lambda t, a, o, h: f"{t},0.5,4,1,2,{h},{o},{a}")
    assert any("horizontalaccuracy: accuracies" in note for note in read_gnss(path).notes)


def test_a_speed_is_no_height(tmp_path: Path) -> None:
    path = written(
        tmp_path / "gps.csv", "time_ns,lat,lon,speed", lambda t, a, o, h: f"{t},{a},{o},7"
    )
    assert not read_gnss(path).has_height.any()


@pytest.mark.parametrize(
    "kept", [20, 60]
)  # letters of the last line: fewer columns than seven, more
def test_a_last_line_that_was_cut_is_left_out(kept: int, tmp_path: Path) -> None:
    path = written(
        tmp_path / "fix.csv", ECHOED,
        lambda t, a, o, h: f"{t},1,{t},gps,0,1,{a},{o},{h},{COVARIANCE}",
    )  # fmt: skip
    *rows, last = path.read_text().splitlines()
    path.write_text("\n".join([*rows, last[:kept]]))
    fixes = read_gnss(path)
    assert fixes.times_ns.tolist() == TIMES_NS[:-1]
    assert any("the last line ends too early" in note for note in fixes.notes)


def test_letters_of_a_hemisphere_are_not_passed_over(tmp_path: Path) -> None:
    path = written(
        tmp_path / "gps.csv", "time_ns,latitude,N/S,longitude,E/W,height,a,b",
        lambda t, a, o, h: f"{t},{a},S,{o},W,{h},1,2",
    )  # fmt: skip
    with pytest.raises(DataError, match=r"hemispheres by letters \(n/s, e/w\) are not read"):
        read_gnss(path)


@pytest.mark.parametrize(
    ("name", "header", "said"),
    [
        (
            "a.csv",
            "time,x,y,z,a,b,c,d",
            "no header names one column of latitude and one of longitude",
        ),
        ("a.csv", "time,lat_gps,lat_rtk,lon,alt,a,b,c", "no header names one column of latitude"),
        ("a.gpx", "<gpx>", r"a\.gpx: GPX is not read; write its positions as a table time_s"),
        ("a.pos", "% GPST", r"a\.pos: RTKLIB's solution \(its time is that of GPS\) is not read"),
    ],
)
def test_other_tables_and_forms_are_named(
    name: str, header: str, said: str, tmp_path: Path
) -> None:
    path = written(tmp_path / name, header, lambda t, a, o, h: f"{t},1,2,3,4,5,6,7")
    with pytest.raises(DataError, match=said):
        read_gnss(path)
