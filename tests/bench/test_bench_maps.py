"""Maps in `vio bench`: loops against ground truth, places in another sequence's map."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.dataset_makers import make_drive, make_mat, utias_arrays
from vio.bench.bench import Place, bench
from vio.bench.engines import run_here
from vio.bench.execute import rendered_sources
from vio.bench.identity import InputDigests
from vio.bench.maps import loop_figures, placement_figures, wrong_share
from vio.bench.suite import chosen, suite_from
from vio.bench.tasks import tasks_of
from vio.bench.worker import perform
from vio.datasets import open_dataset
from vio.errors import ConfigError
from vio.files.trajectories import write_tum
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_inverse, so3_exp
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.mapping.features import KeyframeFeatures
from vio.mapping.map_store import KeyframeRow, LoopRow, MapStore, SessionRow
from vio.records import NS_PER_S, Trajectory

CAMERA = StereoCamera(200.0, 200.0, 159.5, 119.5, 0.1, 320, 240)
T_CAM0_BODY = se3_exp([0.1, 0.2, -0.1, 0.3, -0.2, 0.1])


def _cameras() -> FloatArray:
    """Out, there, back near the start, back again looking the other way, and there again (5, 4,
    4).
    """
    positions = np.array([[0.0, 0, 0], [10, 0, 0], [0.5, 0, 0], [0.2, 0, 0], [10.2, 0, 0]])
    turned = np.array([np.eye(3)] * 5)
    turned[3] = so3_exp(np.array([0.0, np.pi, 0.0]))
    return se3_from_parts(turned, positions)


def _store(path: Path, loops: list[tuple[int, int, float, bool]]) -> Path:
    """A map of these cameras, a keyframe each 20 s, with loops (first, second, error in m,
    kept).
    """
    T = _cameras()
    none = KeyframeFeatures(
        np.zeros((0, 4)), np.zeros(0, dtype=bool), np.zeros(0), np.zeros((0, 32), dtype=np.uint8)
    )
    store = MapStore(path, create=True)
    store.add_session(SessionRow("here", CAMERA, True, 0))
    for k in range(5):
        store.add_keyframe(
            KeyframeRow(0, 10 * k, 20 * k * NS_PER_S, T[k], T[k], np.eye(6), 0.0, None, 0.0), none
        )
    for first, second, error_m, kept in loops:
        off = se3_from_parts(np.eye(3), np.array([error_m, 0.0, 0.0]))
        store.add_loop(
            LoopRow(
                first,
                second,
                RelativePose(se3_inverse(T[first]) @ T[second] @ off, np.eye(6)),
                30,
                kept,
            )
        )
    store.close()
    return path


def test_loops_are_scored_against_the_true_poses(tmp_path: Path) -> None:
    """Keyframes 2 and 4 are at places seen before; 3 is, too, but looks the other way."""
    frames, T_world_body = np.arange(0, 50, 10), _cameras() @ T_CAM0_BODY

    def score(*loops: tuple[int, int, float, bool]) -> tuple[float | None, ...]:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.map"
        return tuple(
            loop_figures(_store(path, list(loops)), frames, T_world_body, T_CAM0_BODY).values()
        )

    assert score() == (0, 0, None, 0.0)
    assert score((0, 2, 0.1, True)) == (1, 0, pytest.approx(0.1), 0.5)
    assert score((0, 2, 0.1, True), (1, 4, 2.0, True)) == (2, 1, pytest.approx(1.05), 1.0)
    assert score((0, 2, 0.1, True), (1, 4, 2.0, False)) == (1, 0, pytest.approx(0.1), 0.5), (
        "it was dropped"
    )


def test_recall_is_undefined_where_no_place_is_seen_again(tmp_path: Path) -> None:
    frames, T_world_body = np.array([0, 10]), _cameras()[:2] @ T_CAM0_BODY
    assert (
        loop_figures(_store(tmp_path / "a.map", []), frames, T_world_body, T_CAM0_BODY)[
            "loop_recall"
        ]
        is None
    )


@pytest.mark.parametrize("wrong", [{"map_of": "other"}, {"map_of": "a", "map": True}, {"map": 3}])
def test_a_map_of_what_is_not_in_the_suite_is_named(
    wrong: dict[str, object], tmp_path: Path
) -> None:
    with pytest.raises(
        ConfigError, match=r"map_of of b names another sequence|map takes true or false"
    ):
        suite_from(
            {"sequences": {"a": "a", "b": {"source": "b", **wrong}}}, tmp_path / "suite.yaml"
        )


@pytest.fixture
def tasks_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do the tasks of a bench in this process; in `test_bench` each has a process of its own."""

    def perform_here(job: dict[str, Any], cache: str) -> dict[str, Any]:
        return perform({**rendered_sources(job, Path(cache)), "scratch": cache})

    engine = partial(run_here, perform=perform_here)
    monkeypatch.setattr(
        "vio.bench.bench.run_here", lambda jobs, cache, *, workers: engine(jobs, cache, workers=1)
    )


@pytest.mark.usefixtures("tasks_here")
def test_a_map_is_built_and_another_sequence_is_localised_in_it(tmp_path: Path) -> None:
    render = "--scene room --trajectory handheld --rig small --width 200 --rate 10 --duration 6"
    covers = [["2s", "2.8s"], ["4s", "4.8s"]]
    suite = suite_from(
        {
            "sequences": {
                "first": {"render": render, "stop": "5s", "map": True},
                "second": {"render": render, "start": "1s", "map_of": "first", "covered": covers},
            },
            "configurations": {"imu": {"motion": "imu"}, "images": {"motion": "none"}},
        },
        tmp_path / "suite.yaml",
    )
    assert [s.name for s in chosen(suite, ["second"], []).sequences] == ["first", "second"]
    result = bench(suite, Place(tmp_path, tmp_path / "out", tmp_path / "cache"))
    first, second, _, lost = result.outcomes
    assert not result.failures
    assert first.figures["map_ate_m"] < 0.05
    assert first.figures["loops"] >= first.figures["loops_false"] == 0
    assert first.figures["place_s"] == 0.0
    assert (first.figures["loops"] == 0) == (first.absent.get("map_nees_95") == "there is no loop")
    assert first.absent["again_s"] == "nothing covered the cameras"
    assert second.absent["loops"] == "no map was built"
    assert second.figures["map_causal_ate_m"] < 0.1
    assert second.figures["again_s"] == 0.0, "the IMU carries the place"
    assert lost.figures["again_s"] == pytest.approx(1.0), (
        "from the next keyframe's result on, ten frames later"
    )
    assert 0 < lost.figures["placed_again"] < second.figures["placed_again"] == 1
    assert lost.figures["placed_wrong"] == second.figures["placed_wrong"] == 0
    assert 0 < lost.figures["placed"] < second.figures["placed"] < 1
    assert lost.figures["map_nees"] < 30, (
        "poses that are not localised, or of a dark camera, are left out"
    )
    tables = (tmp_path / "out" / "tables.md").read_text()
    assert "localised again s" in tables.partition("## Maps")[2]


def test_a_place_is_found_again_after_each_time_that_the_cameras_were_covered() -> None:
    """Frames of 0.1 s from number 5 on, dark from 10 to 12 and from 20 to 24."""
    frames = np.arange(5, 30)
    times_ns = frames * (NS_PER_S // 10)

    def figures(*places: tuple[int, int]) -> dict[str, float | None]:
        placed = np.any([(frames >= first) & (frames < end) for first, end in places], axis=0)
        return placement_figures(frames, times_ns, placed, [(10, 13), (20, 25)])

    found = figures((6, 10), (14, 20), (28, 30))
    assert found["place_s"] == pytest.approx(0.1)
    assert found["again_s"] == pytest.approx(0.3), "the longer of 0.1 and 0.3 s"
    assert found["placed_again"] == pytest.approx((6 + 2) / (7 + 5))
    assert found["placed"] == pytest.approx((4 + 6 + 2) / 25)
    assert "again_s" not in figures((6, 10), (14, 20)), "not after the second time"
    assert "placed_again" not in placement_figures(frames, times_ns, frames > 0, [])


def test_wrong_places_are_those_off_by_half_a_metre_or_five_degrees() -> None:
    truth = np.tile(T_CAM0_BODY, (4, 1, 1))
    off = se3_exp(
        [[0.4, 0, 0, 0, 0, 0.05], [0.6, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0.1, 0], [0, 0, 0, 0, 0, 0]]
    )
    assert wrong_share(truth @ off, truth) == 0.5


def test_a_slam_systems_trajectories_stand_beside_ours_in_the_map(tmp_path: Path) -> None:
    """As known at the end and at the time: neither is odometry; the second begins later."""
    (tmp_path / "peers").mkdir()
    make_mat(tmp_path / "drive.mat", utias_arrays(make_drive(14, seed=0, pixel_sigma=0.3)))
    recording = open_dataset(str(tmp_path / "drive.mat")).recording
    truth, times_ns = make_drive(14, seed=0, pixel_sigma=0.3).T_world_imu, recording.frame_times_ns
    for name, first in (("final", 0), ("causal", 4)):
        path = tmp_path / "peers" / f"a.slam_{name}.tum"
        write_tum(path, Trajectory(truth[first:], times_ns[first:], "imu"))
        path.write_text(f"# map: {name}\n{path.read_text()}")
    suite = suite_from({"sequences": {"a": {"source": "drive.mat"}}}, tmp_path / "suite.yaml")
    tasks = tasks_of(suite, tmp_path, InputDigests(tmp_path / "i.json"), tmp_path / "peers")
    records = {t.system: perform({**t.job, "scratch": None}) for t in tasks if t.seed is None}
    final, causal = records["slam_final"], records["slam_causal"]
    assert final["figures"]["map_ate_m"] < 1e-6
    assert "map_causal_ate_m" not in final["figures"]
    assert causal["figures"]["placed"] == pytest.approx(10 / 14)
    assert causal["figures"]["place_s"] == pytest.approx(
        float(times_ns[4] - times_ns[0]) / NS_PER_S
    )
    for record in (final, causal):
        assert "ate_m" not in record["figures"]
        assert record["absent"]["ate_m"] == "its poses are those in a map"
        assert record["absent"]["loops"] == "a trajectory of another system does not say"
