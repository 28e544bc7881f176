"""The map's file: what is written comes back, a crash leaves the last good state, foreign files
are refused.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import ROOT
from tests.replaced_rules import replaced
from vio.calibration.stereo_field import DisplacementField
from vio.errors import ConfigError, DataError, VioError
from vio.geometry.lie import se3_exp
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.mapping import map_database
from vio.mapping.builder import MapBuilder
from vio.mapping.features import KeyframeFeatures
from vio.mapping.files import check_map
from vio.mapping.map_database import VERSION
from vio.mapping.map_store import KeyframeRow, LoopRow, MapStore, SessionRow
from vio.mapping.merging import merge_maps

CAMERA = StereoCamera(400.0, 401.0, 319.5, 179.5, 0.12, 640, 360)


def _features(seed: int) -> KeyframeFeatures:
    rng = np.random.default_rng(seed)
    z = rng.uniform(0, 300, (13, 4)).astype(np.float32).astype(np.float64)
    return KeyframeFeatures(
        z, rng.random(13) < 0.5, np.full(13, 1.5), rng.integers(0, 256, (13, 32), dtype=np.uint8)
    )


def _row(k: int) -> KeyframeRow:
    T = se3_exp(np.full(6, 0.1 * k))
    up = np.array([0.0, 0.6, 0.8]) if k % 2 else None
    return KeyframeRow(
        0, 5 * k, 10**18 + k, T, se3_exp(np.full(6, 0.2)), 0.1 * np.eye(6), 1.5 * k, up, 0.01
    )


def _pose(k: int) -> RelativePose:
    return RelativePose(se3_exp(np.full(6, 0.01 * k)), (1 + k) * np.eye(6))


def fill(path: Path, count: int = 4) -> MapStore:
    store = MapStore(path, create=True)
    store.add_session(SessionRow("a place", CAMERA, True, 0))
    for k in range(count):
        store.add_keyframe(_row(k), _features(k))
        if k:
            store.add_odometry(k - 1, k, _pose(k))
    store.add_loop(LoopRow(0, count - 1, _pose(9), 40, True))
    return store


def test_the_stereo_field_of_a_session_comes_back(tmp_path: Path) -> None:
    store = fill(tmp_path / "a.map")
    rng = np.random.default_rng(0)
    field = DisplacementField(CAMERA, rng.normal(size=15), np.diag(rng.random(15)))
    store.set_field(0, field)
    store.close()
    found = MapStore(tmp_path / "a.map", read_only=True).sessions()[0].field
    np.testing.assert_array_equal(found.coefficients, field.coefficients)
    np.testing.assert_array_equal(found.covariance, field.covariance)


def test_what_is_written_comes_back_to_the_bit(tmp_path: Path) -> None:
    fill(tmp_path / "a.map").close()
    store = MapStore(tmp_path / "a.map", read_only=True)
    assert store.sessions() == [SessionRow("a place", CAMERA, True, 0)]
    rows = store.keyframes()
    for k, row in enumerate(rows):
        expected = _row(k)
        assert (row.frame, row.time_ns, row.path_m) == (
            expected.frame,
            expected.time_ns,
            expected.path_m,
        )
        np.testing.assert_array_equal(row.T_map_cam, expected.T_map_cam)
        np.testing.assert_array_equal(row.drift, expected.drift)
        assert (row.up_cam is None) == (expected.up_cam is None)
        features, given = store.features(k), _features(k)
        for name in ("z", "has_right", "sigma_px", "descriptors"):
            np.testing.assert_array_equal(getattr(features, name), getattr(given, name))
    assert [(i, j) for i, j, _ in store.odometry()] == [(0, 1), (1, 2), (2, 3)]
    np.testing.assert_array_equal(store.odometry()[1][2].covariance, _pose(2).covariance)
    (loop,) = store.loops()
    assert (loop.first, loop.second, loop.inliers, loop.kept) == (0, 3, 40, True)
    store.close()


def test_what_came_after_a_checkpoint_is_forgotten(tmp_path: Path) -> None:
    store = fill(tmp_path / "a.map", 6)
    store.truncate(1, 4, 0)
    assert len(store.keyframes()) == 4
    assert [j for _, j, _ in store.odometry()] == [1, 2, 3]
    assert store.loops() == []
    with pytest.raises(DataError, match="keyframe 4 has no features"):
        store.features(4)
    store.close()


CRASH = """
import os, sys
from pathlib import Path
import numpy as np
from tests.mapping.test_map_store import _features, _row, fill
store = fill(Path(sys.argv[1]))
store.commit()
store.add_keyframe(_row(4), _features(4))
store.set_poses({k: np.eye(4) for k in range(5)})
print("written", flush=True)
os.kill(os.getpid(), 9)
"""


def test_a_killed_process_leaves_the_last_commit(tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    done = subprocess.run(
        [sys.executable, "-c", CRASH, str(path)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.returncode) == ("written\n", -signal.SIGKILL)
    store = MapStore(path)
    assert len(store.keyframes()) == 4
    np.testing.assert_array_equal(store.keyframes()[2].T_map_cam, _row(2).T_map_cam)
    store.close()


def test_a_missing_map_is_refused_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="there is no such map; vio run --map"):
        MapStore(tmp_path / "none.map")


def test_files_that_are_no_map_are_refused_and_left_alone(tmp_path: Path) -> None:
    text, other = tmp_path / "text.map", tmp_path / "other.map"
    text.write_text("not a database, but long enough to look like one: " * 40)
    with pytest.raises(DataError, match="is no map of this program, or its beginning"):
        MapStore(text, create=True)
    foreign = sqlite3.connect(other)
    foreign.execute("CREATE TABLE mine (x)")
    foreign.commit()
    foreign.close()
    before = other.read_bytes()
    with pytest.raises(DataError, match="is no map of this program"):
        MapStore(other, create=True)
    assert other.read_bytes() == before


def test_a_map_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    fill(path).close()
    database = sqlite3.connect(path)
    database.execute(f"PRAGMA user_version = {VERSION + 1}")
    database.close()
    with pytest.raises(
        DataError, match=f"is a map of version {VERSION + 1}, this program reads {VERSION}"
    ):
        MapStore(path)


def _make_older(path: Path, version: int) -> None:
    """Make a map as earlier versions wrote it."""
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.create_function("row_crc32", -1, map_database._row_crc32, deterministic=True)
        for table in map_database.KEYS:
            if map_database.SINCE.get(table, 1) > version:
                database.execute(f"DROP TABLE {table}")
                continue
            columns = [
                name
                for (name,) in database.execute("SELECT name FROM pragma_table_info(?)", (table,))
            ]
            newer = [name for name in columns if map_database.SINCE.get(name, 1) > version]
            for column in newer:
                database.execute(f"ALTER TABLE {table} DROP COLUMN {column}")
            if "crc32" not in newer:
                kept = ", ".join(name for name in columns if name not in (*newer, "crc32"))
                database.execute(f"UPDATE {table} SET crc32 = row_crc32({kept})")
        database.execute(f"PRAGMA user_version = {version}")
        database.commit()


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_a_map_of_an_older_version_is_read_and_continued(version: int, tmp_path: Path) -> None:
    """The first one did not say of what cameras its images were; none what the calibration is
    off by.
    """
    path = tmp_path / "a.map"
    fill(path).close()
    _make_older(path, version)
    for read_only in (True, False, True):
        store = MapStore(path, read_only=read_only)
        assert store.sessions() == [SessionRow("a place", CAMERA, True, 0)]
        if not read_only:
            store.add_session(SessionRow("another", replace(CAMERA, fu=300.0), True, 0))
            store.truncate(1, 4, 1)
        store.close()
    assert MapStore(path, read_only=True).version == VERSION


@pytest.mark.parametrize(
    ("session", "recording"), [({"kind": "rgbd"}, {}), ({}, {"projection": "cylinder"})]
)
def test_another_kind_of_camera_is_refused_in_a_line(
    session: dict[str, Any], recording: dict[str, Any], tmp_path: Path
) -> None:
    store = MapStore(tmp_path / "a.map", create=True)
    store.add_session(SessionRow("a place", replace(CAMERA, **session), True, 0))
    with pytest.raises(
        VioError, match=r"a\.map: (is a map of one camera|a map is made of .* pinhole)"
    ) as error:
        MapBuilder(store, "here", replace(CAMERA, **recording), upright=True, localise=False)
    assert "\n" not in str(error.value)
    assert isinstance(error.value, ConfigError if recording else DataError)


@pytest.mark.parametrize(
    ("change", "warned"), [({"fu": 1.01 * CAMERA.fu}, False), ({"baseline_m": 0.5}, True)]
)
def test_another_rig_is_warned_of(
    change: dict[str, Any], warned: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = fill(tmp_path / "a.map")
    MapBuilder(store, "here", replace(CAMERA, **change), upright=True, localise=True)
    assert ("a.map: was made with another rig" in caplog.text) == warned
    store.close()


def test_a_merge_of_two_rigs_names_files_that_the_user_knows(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    fill(tmp_path / "a.map").close()
    store = MapStore(tmp_path / "b.map", create=True)
    store.add_session(SessionRow("there", replace(CAMERA, baseline_m=0.5), True, 0))
    store.close()
    with pytest.raises(DataError, match="shows no place of"):
        merge_maps(tmp_path / "a.map", tmp_path / "b.map", tmp_path / "both.map")
    assert f"{tmp_path / 'a.map'}: was made with another rig" in caplog.text
    assert f"{tmp_path / 'b.map'} is of a stereo pair" in caplog.text
    assert "partial" not in caplog.text


def test_a_map_in_use_is_refused(tmp_path: Path) -> None:
    store = fill(tmp_path / "a.map")
    with pytest.raises(DataError, match="wait for the run that uses it"):
        MapStore(tmp_path / "a.map", create=True)
    store.close()


def test_a_truncated_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    fill(path).close()
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataError, match="is damaged or no map"):
        MapStore(path, read_only=True).features(3)


def test_a_map_that_cannot_be_made_says_why(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is a folder; a map is one file"):
        MapStore(tmp_path, create=True)
    with pytest.raises(DataError, match=r"its folder .*nowhere does not exist"):
        MapStore(tmp_path / "nowhere" / "a.map", create=True)


# Damage


def _content(path: Path) -> list[Any]:
    """Everything that a map gives."""
    store = MapStore(path, read_only=True)
    with contextlib.closing(store):
        rows = [store.sessions(), store.keyframes(), store.odometry(), store.loops()]
        return [repr(rows), *(repr(store.features(k)) for k in range(4))]


ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x FROM n"


@pytest.mark.parametrize(
    "change",
    [
        f"DROP TABLE loops; CREATE VIEW loops AS {ENDLESS}",
        f"CREATE VIEW more AS {ENDLESS}",
        "CREATE TRIGGER t AFTER UPDATE ON keyframes BEGIN DELETE FROM sessions; END",
        "CREATE TABLE mine (x)",
        "CREATE INDEX mine ON loops (first)",
        "DROP TABLE loops",
        "ALTER TABLE loops ADD COLUMN x INTEGER",
        "ALTER TABLE loops ADD COLUMN x AS (first + 1)",
        "DROP TABLE loops; CREATE VIRTUAL TABLE loops USING rtree(id, first, second)",
    ],
    ids=lambda change: change[:30],
)
def test_a_file_with_another_schema_is_refused(change: str, tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    fill(path).close()
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.executescript(change)
    for read_only in (True, False):
        with pytest.raises(
            DataError, match=r"is not as this program makes it.*; restore a copy or build it again"
        ) as error:
            MapStore(path, read_only=read_only)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("UPDATE keyframes SET T_map_cam = x'00' WHERE id = 1", "row 1 of keyframes"),
        (
            "UPDATE keyframes SET T_map_cam = zeroblob(128) WHERE id = 1",
            "row 1 of keyframes: a pose is none",
        ),
        ("UPDATE keyframes SET drift = 'text' WHERE id = 1", "row 1 of keyframes"),
        ("UPDATE keyframes SET session = 77 WHERE id = 2", "belongs to no session"),
        ("UPDATE keyframes SET time_ns = 'soon' WHERE id = 2", "soon is no integer"),
        ("UPDATE keyframes SET path_m = 9e999 WHERE id = 2", "inf is no finite number"),
        ("DELETE FROM keyframes WHERE id = 2", "row 2 is missing"),
        ("UPDATE keyframes SET up_cam = x'000000000000f87f' WHERE id = 1", "row 1 of keyframes"),
        ("UPDATE loops SET second = 9999", "keyframes that are not there"),
        ("UPDATE odometry SET first = 3 WHERE second = 2", "keyframes that are not there"),
        ("UPDATE odometry SET covariance = x'' WHERE second = 2", "row 2 of odometry"),
        ("DELETE FROM features WHERE keyframe = 3", "has no features"),
        ("UPDATE features SET z = substr(z, 1, 20) WHERE keyframe = 1", "row 1 of features"),
        (
            "UPDATE features SET has_right = x'' WHERE keyframe = 1",
            "row 1 of features: its arrays are of different",
        ),
        (
            "UPDATE features SET sigma_px = substr(sigma_px, 5) WHERE keyframe = 1",
            "its arrays are of different lengths",
        ),
        ("UPDATE sessions SET fu = 0", "its camera is none"),
        ("UPDATE sessions SET kind = x'00'", "a name is no text"),
    ],
)
@pytest.mark.parametrize("version", [2, VERSION])
def test_values_that_do_not_fit_together_are_one_line(
    version: int, change: str, message: str, tmp_path: Path
) -> None:
    """Version 2 has no checksums, which find any change."""
    path = tmp_path / "a.map"
    fill(path).close()
    if version == 2:
        _make_older(path, version)
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute(change)
        database.commit()
    with pytest.raises(
        DataError, match=r"a\.map: is damaged or no map \(.*\); restore a copy"
    ) as error:
        _content(path)
    assert "\n" not in str(error.value)
    assert re.search(
        message if version == 2 or "DELETE" in change else "checksum does not agree",
        str(error.value),
    )


def _is_same_or_refused(path: Path, expected: list[Any]) -> bool:
    """Read a map: whether it gives what is expected; False: it is refused in one line."""
    try:
        found = _content(path)
    except DataError as error:
        if "\n" in str(error):
            raise
        return False
    assert found == expected
    return True


def test_a_map_whose_bytes_have_flipped_is_refused_or_the_same(tmp_path: Path) -> None:
    path, flipped = tmp_path / "a.map", tmp_path / "b.map"
    fill(path).close()
    expected, whole, refused = _content(path), path.read_bytes(), 0
    for place in np.random.default_rng(0).integers(len(whole), size=200).tolist():
        data = bytearray(whole)
        data[place] ^= 0x41
        flipped.write_bytes(data)
        refused += not _is_same_or_refused(flipped, expected)
    assert refused > 20


def test_a_long_step_ends_with_a_signal_and_with_its_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    store = fill(tmp_path / "a.map")
    before = signal.signal(signal.SIGALRM, stop)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        with pytest.raises(KeyboardInterrupt), store._errors():
            store._db.execute(f"SELECT count(*) FROM ({ENDLESS})").fetchone()
        monkeypatch.setattr(
            "vio.mapping.map_database._LIMITS",
            replaced("vio.mapping.map_database._LIMITS", max_s=0.2),
        )
        with pytest.raises(DataError, match="a step took more than"), store._errors():
            store._db.execute(f"SELECT count(*) FROM ({ENDLESS})").fetchone()
    finally:
        signal.signal(signal.SIGALRM, before)
    store.close()


def test_damage_is_still_found_after_an_upgrade(tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    fill(path).close()
    _make_older(path, 3)
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.execute("UPDATE features SET sigma_px = zeroblob(length(sigma_px)) WHERE keyframe = 2")
        db.commit()
    MapStore(path).close()
    with pytest.raises(DataError, match="row 2 of features"):
        check_map(path)
