"""The life of a map: readers beside a writer, parts of a map, and merges that would do harm."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.mapping.test_map_store import CAMERA, _features, _pose, _row, fill
from vio.cli import main
from vio.errors import DataError
from vio.geometry.lie import se3_exp
from vio.geometry.relative_pose import RelativePose
from vio.mapping.files import check_map, describe_map, drop_session, extract_map, prune_map
from vio.mapping.map_graph import MapGraph
from vio.mapping.map_store import KeyframeRow, LoopRow, MapStore, PlacesRow, SessionRow
from vio.mapping.merging import merge_maps
from vio.mapping.place_index import SEGMENT, Segment


def _two_sessions(path: Path) -> None:
    """Of four keyframes and of two, joined by a loop between keyframes 1 and 5."""
    store = fill(path)
    store.add_session(SessionRow("another", CAMERA, True, 0))
    for k in (4, 5):
        store.add_keyframe(replace(_row(k), session=1), _features(k))
    store.add_odometry(4, 5, _pose(5))
    store.add_loop(LoopRow(1, 5, _pose(3), 30, True))
    store.close()


def test_a_reader_sees_the_last_commit_while_another_process_writes(tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    writer = fill(path)
    writer.commit()
    writer.add_keyframe(_row(4), _features(4))
    with closing(MapStore(path, read_only=True)) as reader:
        assert len(reader.keyframes()) == 4
        writer.commit()
        assert len(reader.keyframes()) == 4, "one state for as long as it is open"
    with closing(MapStore(path, read_only=True)) as reader:
        assert len(reader.keyframes()) == 5
    with pytest.raises(DataError, match="wait for the run that uses it"):
        MapStore(path)
    writer.close()
    assert [file.name for file in tmp_path.iterdir()] == ["a.map"], "one file again"


def test_a_map_that_grows_while_it_is_opened_is_in_use_and_not_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, read = tmp_path / "a.map", MapStore.keyframes
    writer = fill(path)
    writer.commit()

    def meanwhile(store: MapStore) -> list[KeyframeRow]:
        rows = read(store)
        writer.add_keyframe(_row(4), _features(4))
        writer.add_odometry(3, 4, _pose(4))
        writer.commit()
        return rows

    monkeypatch.setattr(MapStore, "keyframes", meanwhile)
    with pytest.raises(DataError, match="wait for the run that uses it"):
        MapStore(path)
    writer.close()


def test_check_reads_features_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.map"
    fill(path).close()
    assert check_map(path)["keyframes"] == 4
    assert main(["map", "check", str(path)]) == 0
    assert "every row agrees with its checksum" in capsys.readouterr().out
    with closing(sqlite3.connect(path)) as database:
        database.execute(
            "UPDATE features SET sigma_px = zeroblob(length(sigma_px)) WHERE keyframe = 2"
        )
        database.commit()
    assert main(["map", "show", str(path)]) == 0
    assert main(["map", "check", str(path)]) == 1
    assert "row 2 of features: its checksum does not agree" in capsys.readouterr().err


def test_check_reads_places_too(tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    with closing(fill(path)) as store:
        words = Segment(np.zeros((4, 2**14 + 1), dtype=np.uint32), np.zeros((4, 0), dtype=np.uint8))
        store.add_places(
            PlacesRow(words, np.zeros((SEGMENT, 32, 3)), np.zeros(SEGMENT, dtype=np.int64))
        )
    check_map(path)
    with closing(sqlite3.connect(path)) as database:
        database.execute("UPDATE places SET points = zeroblob(8)")
        database.commit()
    with pytest.raises(DataError, match="row 0 of places: its checksum does not agree"):
        check_map(path)


def test_a_session_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    _two_sessions(path)
    with pytest.raises(DataError, match="has no session 2, but 0 to 1"):
        drop_session(path, 2)
    facts = drop_session(path, 0)
    assert [s["source"] for s in facts["sessions"]] == ["another"]
    with closing(MapStore(path, read_only=True)) as store:
        assert [(k.session, k.frame) for k in store.keyframes()] == [(0, 20), (0, 25)]
        ((first, second, motion),) = store.odometry()
        assert (first, second) == (0, 1)
        np.testing.assert_array_equal(motion.T_i_j, _pose(5).T_i_j)
        np.testing.assert_array_equal(store.features(1).z, _features(5).z)
        assert store.loops() == []
    for session, message in ((0, "has session 0 alone, and no map"), (7, "no session 7, but 0 al")):
        with pytest.raises(DataError, match=message):
            drop_session(path, session)


def test_pruning_leaves_loops_and_puts_motions_together(tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    store = fill(path)  # with a loop from keyframe 0 to 3
    store.set_poses({k: se3_exp([0.1 * k, 0, 0, 0, 0, 0]) for k in range(4)})
    store.close()
    prune_map(path, 2)
    with closing(MapStore(path, read_only=True)) as left:
        assert [k.frame for k in left.keyframes()] == [0, 15]
        ((_, _, motion),) = left.odometry()
        expected = _pose(1).then(_pose(2)).then(_pose(3))
        np.testing.assert_allclose(motion.T_i_j, expected.T_i_j)
        np.testing.assert_allclose(motion.covariance, expected.covariance)
        assert [(o.first, o.second) for o in left.loops()] == [(0, 1)]
    assert prune_map(path, 2)["keyframes"] == 2


def test_a_part_of_a_map_is_taken_out(tmp_path: Path) -> None:
    path, out = tmp_path / "a.map", tmp_path / "part.map"
    _two_sessions(path)
    with closing(MapStore(path)) as store:
        store.set_poses({k: se3_exp([2.0 * k, 0, 0, 0, 0, 0]) for k in range(6)})
    before = path.read_bytes()
    arguments = [
        "map",
        "extract",
        str(path),
        "--around",
        "7,0,0",
        "--radius",
        "2",
        "--out",
        str(out),
    ]
    assert main(arguments) == 0
    assert path.read_bytes() == before
    with closing(MapStore(out, read_only=True)) as part:
        assert [(k.session, k.frame) for k in part.keyframes()] == [(0, 15), (1, 20)]
        assert part.odometry() == []
    assert main(arguments) == 1, "exists"
    with pytest.raises(DataError, match="no keyframe would be left"):
        extract_map(path, tmp_path / "none.map", (100.0, 0.0, 0.0), 1.0)
    assert not (tmp_path / "none.map").exists()


def test_a_recording_is_not_merged_twice(tmp_path: Path) -> None:
    a, b, out = (tmp_path / f"{name}.map" for name in ("a", "b", "out"))
    for path, seeds in ((a, range(4)), (b, range(3, 7))):
        with closing(MapStore(path, create=True)) as store:
            store.add_session(SessionRow("a place", CAMERA, True, 0))
            for k in seeds:
                rich = np.random.default_rng(k).integers(0, 256, (30, 32), dtype=np.uint8)
                rows = np.arange(30) % 13
                f = _features(k)
                store.add_keyframe(
                    replace(_row(k), time_ns=k + 10**9 * seeds.start),
                    replace(
                        f,
                        z=f.z[rows],
                        has_right=f.has_right[rows],
                        sigma_px=f.sigma_px[rows],
                        descriptors=rich,
                    ),
                )
    with pytest.raises(
        DataError, match=r"1 of its keyframes are in .* already: both hold one recording"
    ):
        merge_maps(a, b, out)
    assert not out.exists()


def test_maps_without_a_common_place_are_not_merged(tmp_path: Path) -> None:
    a, b, out = (tmp_path / f"{name}.map" for name in ("a", "b", "out"))
    fill(a).close()
    fill(b).close()
    with pytest.raises(DataError, match="shows no place of"):
        merge_maps(a, b, out)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.map", "b.map"]


def test_a_map_without_keyframes_is_not_merged(tmp_path: Path) -> None:
    """The other one begins at time 0 and without an IMU, as KITTI's drives do."""
    a, b, out = (tmp_path / f"{name}.map" for name in ("a", "b", "out"))
    MapStore(a, create=True).close()
    with closing(MapStore(b, create=True)) as store:
        store.add_session(SessionRow("drive", CAMERA, False, 0))
        store.add_keyframe(replace(_row(0), time_ns=0), _features(0))
    with pytest.raises(DataError, match="shows no place of"):
        merge_maps(a, b, out)


def test_sessions_that_a_dropped_one_had_joined_stay_where_they_are(tmp_path: Path) -> None:
    path = tmp_path / "a.map"
    store = fill(path)
    for n, (a, b) in ((1, (4, 5)), (2, (6, 7))):
        store.add_session(SessionRow(f"s{n}", CAMERA, True, 0))
        for k in (a, b):
            store.add_keyframe(replace(_row(k), session=n), _features(k))
        store.add_odometry(a, b, _pose(5))
    store.add_loop(LoopRow(1, 5, _pose(3), 30, True))
    store.add_loop(LoopRow(5, 7, _pose(3), 30, True))
    store.close()
    drop_session(path, 1)
    with closing(MapStore(path, read_only=True)) as left:
        graph = MapGraph(left)
        before = graph.T_map_cam.rows[4].copy()
        graph.optimise_part(0)
        np.testing.assert_allclose(graph.T_map_cam.rows[4, :3, 3], before[:3, 3], atol=1e-9)


def test_a_frame_that_is_not_level_stays_so_without_its_first_session(tmp_path: Path) -> None:
    """A session with an IMU, joined to one of images alone, which a tilted camera has begun."""
    path = tmp_path / "a.map"
    T_map_odom = se3_exp([0.0, 0.0, 0.0, 0.5, 0.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    with closing(MapStore(path, create=True)) as store:
        for n in range(2):
            store.add_session(SessionRow(f"s{n}", CAMERA, n == 1, 0))
        store.add_keyframe(_row(0), _features(0))
        for k in (1, 2):
            row = replace(_row(k), session=1, T_map_cam=T_map_odom, T_odom_cam=np.eye(4), up_cam=up)
            store.add_keyframe(row, _features(k))
        store.add_odometry(1, 2, RelativePose(np.eye(4), np.eye(6)))
    drop_session(path, 0)
    with closing(MapStore(path, read_only=True)) as left:
        graph = MapGraph(left)
        graph.optimise_part(0)
        np.testing.assert_allclose(graph.T_map_cam.rows, [T_map_odom, T_map_odom], atol=1e-9)


def test_a_map_behind_a_link_is_changed_where_it_is(tmp_path: Path) -> None:
    real, link = tmp_path / "real" / "a.map", tmp_path / "a.map"
    real.parent.mkdir()
    fill(real).close()
    real.chmod(0o600)
    link.symlink_to(real)
    kept = prune_map(link, 1)["keyframes"]
    assert link.is_symlink()
    assert describe_map(real)["keyframes"] == kept < 4
    assert real.stat().st_mode & 0o777 == 0o600
