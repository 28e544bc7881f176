"""Maps in `vio bench`: loops against ground truth, places in another sequence's map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vio.bench.bench import Place, bench
from vio.bench.maps import LoopScore, loop_score
from vio.bench.suite import chosen, suite_from
from vio.errors import ConfigError
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, se3_inverse, so3_exp
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.mapping.features import KeyframeFeatures
from vio.mapping.map_store import KeyframeRow, LoopRow, MapStore, SessionRow
from vio.records import NS_PER_S

CAMERA = StereoCamera(200.0, 200.0, 159.5, 119.5, 0.1, 320, 240)
T_CAM0_BODY = se3_exp([0.1, 0.2, -0.1, 0.3, -0.2, 0.1])


def _cameras() -> FloatArray:
    """Out, there, back near the start, back again looking the other way, and there again (5, 4, 4)."""
    positions = np.array([[0.0, 0, 0], [10, 0, 0], [0.5, 0, 0], [0.2, 0, 0], [10.2, 0, 0]])
    turned = np.array([np.eye(3)] * 5)
    turned[3] = so3_exp(np.array([0.0, np.pi, 0.0]))
    return se3_from_parts(turned, positions)


def _store(path: Path, loops: list[tuple[int, int, float, bool]]) -> Path:
    """A map of these cameras, a keyframe each 20 s, with loops (first, second, error in m, kept)."""
    T = _cameras()
    none = KeyframeFeatures(np.zeros((0, 4)), np.zeros(0, dtype=bool), np.zeros(0), np.zeros((0, 32), dtype=np.uint8))
    store = MapStore(path, create=True)
    store.add_session(SessionRow("here", CAMERA, True, 0))
    for k in range(5):
        store.add_keyframe(KeyframeRow(0, 10 * k, 20 * k * NS_PER_S, T[k], T[k], np.eye(6), 0.0, None, 0.0), none)
    for first, second, error_m, kept in loops:
        off = se3_from_parts(np.eye(3), np.array([error_m, 0.0, 0.0]))
        store.add_loop(
            LoopRow(first, second, RelativePose(se3_inverse(T[first]) @ T[second] @ off, np.eye(6)), 30, kept)
        )
    store.close()
    return path


def test_loops_are_scored_against_the_true_poses(tmp_path: Path) -> None:
    """Keyframes 2 and 4 are at places seen before; 3 is, too, but looks the other way."""
    frames, T_world_body = np.arange(0, 50, 10), _cameras() @ T_CAM0_BODY

    def score(*loops: tuple[int, int, float, bool]) -> LoopScore:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.map"
        return loop_score(_store(path, list(loops)), frames, T_world_body, T_CAM0_BODY)

    assert score() == LoopScore(0, 0, None, 0.0)
    assert score((0, 2, 0.1, True)) == LoopScore(1, 0, pytest.approx(0.1), 0.5)
    assert score((0, 2, 0.1, True), (1, 4, 2.0, True)) == LoopScore(2, 1, pytest.approx(1.05), 1.0)
    assert score((0, 2, 0.1, True), (1, 4, 2.0, False)) == LoopScore(1, 0, pytest.approx(0.1), 0.5), "it was dropped"


def test_recall_is_undefined_where_no_place_is_seen_again(tmp_path: Path) -> None:
    frames, T_world_body = np.array([0, 10]), _cameras()[:2] @ T_CAM0_BODY
    assert loop_score(_store(tmp_path / "a.map", []), frames, T_world_body, T_CAM0_BODY).recall is None


@pytest.mark.parametrize("wrong", [{"map_of": "other"}, {"map_of": "a", "map": True}, {"map": 3}])
def test_a_map_of_what_is_not_in_the_suite_is_named(wrong: dict[str, object], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"map_of of b names another sequence|map takes true or false"):
        suite_from({"sequences": {"a": "a", "b": {"source": "b", **wrong}}}, tmp_path / "suite.yaml")


def test_a_map_is_built_and_another_sequence_is_localised_in_it(tmp_path: Path) -> None:
    render = "--scene room --trajectory handheld --rig small --width 200 --rate 10 --duration 6"
    suite = suite_from(
        {
            "sequences": {
                "first": {"render": render, "stop": "5s", "map": True},
                "second": {"render": render, "start": "1s", "map_of": "first"},
            },
            "configurations": {"imu": {"motion": "imu"}},
        },
        tmp_path / "suite.yaml",
    )
    assert [s.name for s in chosen(suite, ["second"], []).sequences] == ["first", "second"]
    result = bench(suite, Place(tmp_path, tmp_path / "out", tmp_path / "cache"))
    first, second = result.outcomes
    assert (first.failure, second.failure) == (None, None)
    assert first.figures["map_ate_m"] < 0.05
    assert first.figures["loops"] >= first.figures["loops_false"] == 0
    assert first.figures["place_s"] == 0.0
    assert second.absent["loops"] == "no map was built"
    assert 0 < second.figures["placed"] <= 1
    assert second.figures["map_causal_ate_m"] < 0.1
