"""Faults that are drawn: the same for a seed, valid for a recording, scored by what was stated."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.bench.test_faults import PERIOD, STEP_NS, _Sorted
from tools.faults.drawn_page import is_observable, page, summary, tables
from tools.faults.draws import draw, rows_of
from tools.faults.kinds import HALVES, KINDS
from tools.faults.recordings import SOURCES
from tools.faults.scores import (
    UNUSABLE,
    Usual,
    flagged_frame,
    new_flags,
    pose_errors,
    score,
)
from vio.findings import Finding
from vio.geometry.lie import se3_exp
from vio.records import ImuSample, StereoFrame, Trajectory

NAMES = list(KINDS)


def test_a_draw_depends_on_its_seed_and_number_alone() -> None:
    first = [draw(5, k, NAMES, SOURCES) for k in range(40)]
    assert [draw(5, k, NAMES, SOURCES) for k in reversed(range(40))] == first[::-1]
    assert [draw(6, k, NAMES, SOURCES) for k in range(40)] != first
    assert {d.half for d in first} == {"work", "kept", None}
    for d in first:
        if d.half is not None:
            kind = KINDS[d.kind]
            assert kind.smallest <= d.size <= kind.largest * (1 + 1e-12)
            assert kind.group == "cameras" or d.motion == "imu"


def test_halves_share_no_kind_and_no_recording() -> None:
    for half in ("work", "kept"):
        kinds = [name for name in KINDS if HALVES[name] == half]
        sources = [source for source in SOURCES if source.half == half]
        drawn = [draw(1, k, kinds, sources) for k in range(100)]
        assert {d.source for d in drawn} == {source.name for source in sources}
        assert {d.half for d in drawn} == {half, None}
    assert abs(sum(half == "kept" for half in HALVES.values()) - len(HALVES) / 2) <= 1


@pytest.mark.parametrize("name", NAMES)
def test_every_kind_gives_valid_events_that_differ(name: str) -> None:
    kind = KINDS[name]
    rng = np.random.default_rng(2)
    size = kind.drawn_size(rng)
    changed = kind.make(size, rng)(_Sorted(), PERIOD)
    events = list(changed.events())
    frames = [event for event in events if isinstance(event, StereoFrame)]
    samples = [event for event in events if isinstance(event, ImuSample)]
    assert [frame.index for frame in frames] == list(range(len(changed.recording.frame_times_ns)))
    assert all(a.time_ns <= b.time_ns for a, b in itertools.pairwise(events))
    assert all(a.time_ns < b.time_ns for a, b in itertools.pairwise(samples))
    source = list(_Sorted().events())
    same = len(events) == len(source) and all(_same(a, b) for a, b in zip(events, source))  # noqa: B905
    unlike = name != "accelerometer clipped"  # whose range the flight's readings do not reach
    assert not (same and unlike) or changed.recording.camera != _Sorted().recording.camera
    if kind.lasting != "always":
        before = [x for x in source if x.time_ns < PERIOD.begin_ns]
        assert all(_same(a, b) for a, b in zip(events, before))  # noqa: B905


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, ImuSample) and isinstance(b, ImuSample):
        equal = np.array_equal(a.gyro, b.gyro) and np.array_equal(a.accel, b.accel)
        return a.time_ns == b.time_ns and equal
    if isinstance(a, StereoFrame) and isinstance(b, StereoFrame):
        return np.array_equal(a.left, b.left) and np.array_equal(a.right, b.right)
    return False


def test_flags_are_what_the_clean_recording_does_not_say() -> None:
    found = [
        Finding("features-refused", "frame 3: many", 3),
        Finding("bands", "frame 4: bands are taken out", 4),
        Finding("right-image-frozen", "frame 12: look", 12),
        Finding("imu-readings", "7 of 90 samples were spikes"),
    ]
    said = new_flags(found, ["features-refused"])
    assert [flag.code for flag in said] == ["right-image-frozen", "imu-readings"]
    assert flagged_frame(said, 10) == 12
    assert flagged_frame(said, 13) is None


def _result(error_m: float, sigma_m: float, *findings: Finding, unusable: bool = False) -> Any:
    """Ten poses on a line in a turned world, the last of them off by an error."""
    steps = np.array([se3_exp(np.array([0.1 * k, 0, 0, 0, 0, 0])) for k in range(10)])
    times = STEP_NS * np.arange(10)
    wrong = steps.copy()
    wrong[-1, 1, 3] += error_m
    reference = Trajectory(se3_exp(np.array([1, 2, 3, 0.1, 0.2, 0.3])) @ steps, times, "cam0")
    columns: dict[str, Any] = {"covariance": [np.eye(6) * sigma_m**2 / 3] * 10}
    columns |= {"index": list(range(10)), "gravity_world": [np.full(3, np.nan)] * 10}
    columns |= {"tilt_sigma_rad": [np.nan] * 10, "integrity": [UNUSABLE * unusable] * 10}
    return SimpleNamespace(
        recording=SimpleNamespace(reference=reference, path=Path("x")),
        T_cam0_body=np.eye(4),
        body="cam0",
        trajectory=Trajectory(wrong, times, "cam0"),
        estimates=SimpleNamespace(column=columns.__getitem__),
        findings=findings,
    )


def test_an_error_is_covered_up_to_three_stated_standard_deviations() -> None:
    errors = pose_errors(_result(0.2, 0.1), 0.0)
    assert errors.ratio[-1] == pytest.approx(2.0, rel=1e-3)
    assert errors.ratio[:-1].max() < 1e-6
    assert score(_result(0.2, 0.1), Usual(), 2, 0.0)["covered"]
    at_end = Finding("imu-readings", "spikes")
    silent = score(_result(0.4, 0.1, at_end), Usual(), 2, 0.0)
    assert silent["silent"]
    assert silent["beyond_since"] == 9
    assert silent["misleading"] == 1
    flags = Finding("imu-gap", "before", 1), Finding("imu-gap", "x", 6)
    named = score(_result(0.4, 0.1, *flags), Usual(), 2, 0.0)
    assert not named["silent"]
    assert named["flagged_after"] == 4
    assert score(_result(0.4, 0.1, *flags, unusable=True), Usual(), 2, 0.0)["misleading"] == 0
    assert score(_result(0.4, 0.1), Usual(ratio=3.9), 2, 0.0)["covered"]
    assert score(_result(0.4, 0.1), Usual(), 2, 0.3)["covered"]  # as the truth is no better


def test_the_page_counts_by_kind(tmp_path: Path) -> None:
    base = {"seed": 1, "number": 0, "source": "a", "motion": None, "size": 1.0, "onset": 0}
    base |= {"clean_ate_m": 0.01, "ate_m": 0.02, "said": [], "ratio": 1.0, "covered": True}
    base |= {"flagged_after": None, "silent": False}
    missed = base | {"covered": False, "ratio": 12.0, "silent": True}
    soon = base | {"covered": False, "ratio": 12.0, "flagged_after": 4}
    rows = [row | {"kind": "object", "half": "work"} for row in (base, missed, soon)]
    rows += [base | {"kind": "night", "half": None, "said": ["wrong"]}]
    rows += [{"kind": "clean", "source": "a", "motion": None, "ate_m": 0.01, "ratio": 1.5}]
    kinds, healthy = tables(rows)
    assert "| 3 | 1 | 1 | 0 | 1 | 1 | 0 | 67 % | 12, 12 | 2, 2 |" in kinds
    assert "1 of 1 are flagged (night)." in healthy
    assert "| night | 1 | wrong |" in healthy
    assert "seeds 1" in page(rows, "abc")


def test_a_scale_that_images_alone_cannot_show_is_counted_apart() -> None:
    base = {"size": 5.0, "ratio": 9.0, "covered": False, "flagged_after": None, "silent": True}
    by_images = base | {"kind": "baseline", "motion": None, "ratio": 18.0}
    with_imu = base | {"kind": "baseline", "motion": "imu"}
    covered = base | {"kind": "object", "motion": None, "covered": True, "silent": False}
    assert [is_observable(row) for row in (by_images, with_imu, covered)] == [False, True, True]
    text = summary([by_images, with_imu, covered])
    assert "all 3 faults: 33 % covered or flagged soon, 1 silent beyond 10" in text
    assert "the 2 that the sensors can show: 50 %, 0 silent" in text
    # the settings' 0.5 % and 0.3 % together
    assert "8.6 to 8.6 times the 0.58 %" in text
    assert "2.1 to 2.1 times that" in text


def test_rows_that_are_cut_are_run_again(tmp_path: Path) -> None:
    file = tmp_path / "rows.jsonl"
    file.write_text('{"kind": "clean"}\n{"kind": "obj')
    assert rows_of(file) == [{"kind": "clean"}]
    assert rows_of(tmp_path / "none.jsonl") == []
