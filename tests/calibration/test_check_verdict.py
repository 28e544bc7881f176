"""The sentence of `vio check`, and its picture: who is wrong where a run and COLMAP's
reconstructions differ.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vio.geometry.lie import FloatArray, se3_exp, se3_inverse
from vio.geometry.stereo import StereoCamera
from vio.offline.check import draw_check, expected_minutes
from vio.offline.colmap.reconstruction import Mapper, Reconstructed
from vio.offline.comparison import compare_keyframes
from vio.offline.keyframes import TrackedPath
from vio.offline.verdict import MapperResult, overall_verdict
from vio.records import FeatureTracks, Trajectory

COUNT = 30
MAPPERS: tuple[Mapper, ...] = ("incremental", "global")
CAMERA = StereoCamera(fu=400.0, fv=400.0, cu=320.0, cv=240.0, baseline_m=0.1, width=640, height=480)
NOTHING = FeatureTracks(
    offsets=np.zeros(COUNT + 1, dtype=np.int64),
    ids=np.zeros(0, dtype=np.int64),
    z=np.zeros((0, 4)),
    has_right=np.zeros(0, dtype=bool),
    stale=np.zeros(0, dtype=bool),
)


def _poses(seed: int | None = None) -> FloatArray:
    """A bend of 30 m, with errors of 2 mm and 0.01 deg where there is a seed."""
    angle = np.linspace(0.0, 1.0, COUNT)
    p = 30 * np.column_stack([np.sin(angle), 0.02 * np.sin(9 * angle), 1 - np.cos(angle)])
    T = se3_exp(np.column_stack([np.zeros((COUNT, 4)), angle, np.zeros(COUNT)]))
    T[:, :3, 3] = p
    if seed is None:
        return T
    rng = np.random.default_rng(seed)
    return T @ se3_exp(
        np.column_stack([2e-3 * rng.normal(size=(COUNT, 3)), 2e-4 * rng.normal(size=(COUNT, 3))])
    )


def _result(
    mapper: Mapper,
    T_run: FloatArray,
    T_world_cam0: FloatArray,
    connected: Sequence[int] = range(COUNT),
) -> MapperResult:
    path = TrackedPath(
        Path("run"),
        CAMERA,
        Trajectory(T_run, None, "cam0", frame_indices=10 * np.arange(COUNT)),
        NOTHING,
    )
    rows = np.array(connected)
    no_pairs = np.zeros((0, 2), dtype=np.int64)
    linked = np.diff(connected) <= 3
    model = Reconstructed(
        mapper, T_world_cam0[rows], rows, 1000, 0.5, np.zeros(0, dtype=np.int64), linked, no_pairs
    )
    return MapperResult(
        mapper, COUNT, (model, compare_keyframes(path, rows, T_world_cam0[rows], linked=linked))
    )


def _jumped(T: FloatArray, by_m: float, row: int = 20) -> FloatArray:
    T = T.copy()
    T[row:, :3, 3] += [0.0, 0.0, by_m]
    return T


def test_agreement_says_how_far_apart_they_are() -> None:
    text = overall_verdict(
        [_result("incremental", _poses(), _poses(1)), _result("global", _poses(), _poses(2))]
    )
    assert text.startswith("the run and COLMAP agree: ")
    assert " mm (rms) apart over 30" in text
    assert "but" not in text


def test_a_jump_of_the_run_is_laid_at_its_door() -> None:
    run = _jumped(_poses(), 0.5)
    text = overall_verdict(
        [_result("incremental", run, _poses(1)), _result("global", run, _poses(2))]
    )
    assert re.match(
        r"the run is probably off by 0\.50\d m \(1\.7 m per 100 m\) at frames 190 to 200: both",
        text,
    )


def test_a_jump_of_millimetres_is_negligible() -> None:
    run = _jumped(_poses(), 0.03)
    results = [_result("incremental", run, _poses(1)), _result("global", run, _poses(2))]
    assert all(result.found is not None and result.found[1].segments for result in results)
    text = overall_verdict(results)
    assert text.startswith("the run and COLMAP agree: ")
    assert re.search(
        r"the difference of 3[\d.]+ mm \(0\.1 m per 100 m\) at frames 190 to 200 is negligible",
        text,
    )


def test_a_model_that_broke_in_two_is_not_held_against_the_run() -> None:
    broken = _result("global", _poses(), _jumped(_poses(2), 58.0))
    text = overall_verdict([_result("incremental", _poses(), _poses(1)), broken])
    assert text.startswith("the run and COLMAP agree: ")
    assert "COLMAP's global model breaks at frames 190 to 200, the other one does not" in text
    comparison = broken.found[1]
    assert comparison.piece.sum() == 20
    assert comparison.ate_m < 0.01, "the longer piece is compared, not the two as one"
    assert comparison.scale == pytest.approx(1.0, abs=0.005)


def test_motions_across_a_gap_are_not_compared() -> None:
    """COLMAP connected both ends of the run, which a loop joins, and nothing between them."""
    run, ends = _poses(), [*range(12), *range(18, COUNT)]
    results = [
        _result(m, run, _jumped(_poses(s), 3.0, row=15), ends) for s, m in enumerate(MAPPERS)
    ]
    text = overall_verdict(results)
    assert text.startswith(
        "6 of 30 keyframes not connected, the others in 2 pieces, of which frames 0 to 110 are "
        "compared; "
    )
    assert "the run and COLMAP agree" in text
    assert "off" not in text


def test_a_run_that_bends_evenly_does_not_agree() -> None:
    """No motion stands out from the others: 60 degrees over 29 of them."""
    turn = se3_exp([0.0, 0.0, 0.0, 0.0, np.radians(60 / (COUNT - 1)), 0.0])
    run = [np.eye(4)]
    for motion in se3_inverse(_poses()[:-1]) @ _poses()[1:]:
        run.append(run[-1] @ motion @ turn)
    results = [
        _result("incremental", np.array(run), _poses(1)),
        _result("global", np.array(run), _poses(2)),
    ]
    text = overall_verdict(results)
    assert re.match(
        r"the run is probably off by [\d.]+ m \(.* m per 100 m\) and 60.* deg at frames 0 to 290",
        text,
    )


def test_a_missed_loop_is_named() -> None:
    result = _result("incremental", _poses(), _poses(1))
    model = replace(result.found[0], revisits=np.array([[1, 28], [2, 29]]))
    text = overall_verdict([replace(result, found=(model, result.found[1]))])
    assert text.endswith(
        "; frames 10 and 280 show one place, which the run did not close as a loop"
    )


def test_models_that_contradict_one_another_convict_nobody() -> None:
    results = [
        _result("incremental", _poses(), _jumped(_poses(1), 3.0)),
        _result("global", _poses(), _jumped(_poses(2), -4.0, row=12)),
    ]
    text = overall_verdict(results)
    assert text.startswith("undecided at frames 190 to 200 (incremental) and 110 to 120 (global)")


def test_one_mapper_alone_cannot_tell_who_is_wrong() -> None:
    text = overall_verdict([_result("incremental", _poses(), _jumped(_poses(1), 0.5))])
    assert "differ at frames 190 to 200" in text
    assert "one of both is wrong" in text


def test_a_wrong_length_is_said() -> None:
    longer = _poses(1)
    longer[:, :3, 3] *= 1.05
    assert "but COLMAP's path is 5." in overall_verdict([_result("incremental", _poses(), longer)])


def test_no_reconstruction_no_verdict() -> None:
    assert overall_verdict([MapperResult("incremental", COUNT, None)]).startswith(
        "none: not observable because"
    )


def test_a_broken_model_does_not_flatten_the_picture() -> None:
    broken = _result("global", _poses(), _jumped(_poses(2), 58.0))
    trajectory = Trajectory(_poses(), None, "cam0", frame_indices=10 * np.arange(COUNT))
    figure = draw_check(trajectory, [_result("incremental", _poses(), _poses(1)), broken])
    figure.canvas.draw()
    above, along = figure.axes
    assert np.ptp(above.get_xlim()) < 60
    assert np.ptp(above.get_ylim()) < 60
    assert along.get_yscale() == "log"
    labels = [text.get_text() for text in above.get_legend().get_texts()]
    assert "COLMAP, global (10 of 30 outside the picture)" in labels


def test_the_expected_time_grows_with_keyframes_and_mappers() -> None:
    one, both = (
        expected_minutes(40, mappers) for mappers in (("global",), ("incremental", "global"))
    )
    assert 0.5 < one < both < 10
    assert expected_minutes(20, ("global",)) < one
