"""References whose clock or axes are others than the estimate's: named, and not where an estimate is
merely wrong.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vio.errors import DataError, EvaluationError
from vio.evaluation import reference_faults
from vio.evaluation.alignment import Alignment
from vio.evaluation.association import take
from vio.evaluation.trajectories import evaluate
from vio.files.epochs import epoch_hint
from vio.files.trajectories import read_trajectory
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, so3_exp
from vio.records import Trajectory

COUNT = 400
START_NS = 1_700_000_000_000_000_000


def _positions(times: FloatArray) -> FloatArray:
    """A path that turns, climbs, and changes its speed."""
    phase = 0.4 * times + 0.3 * np.sin(0.7 * times)
    return np.stack(
        [3 * np.sin(phase), 2 * np.cos(1.3 * phase), 0.6 * np.sin(2.1 * phase) + 0.1 * times], 1
    )


def _trajectory(*, shift_s: float = 0.0, count: int = COUNT) -> Trajectory:
    times = 0.05 * np.arange(count)
    R = so3_exp(np.stack([0.1 * np.sin(times), 0.2 * times, 0.1 * np.cos(times)], 1))
    stamps = START_NS + np.round(1e9 * (times + shift_s)).astype(np.int64)
    return Trajectory(se3_from_parts(R, _positions(times)), stamps, "imu")


def _odometry(scale: float, turn_rad: float, noise: float) -> Trajectory:
    """An estimate that drifts: of a wrong scale, turning by an angle a frame, with noise."""
    truth = _trajectory()
    rng = np.random.default_rng(3)
    poses = [truth.T_world_body[0]]
    for step in se3_inverse(truth.T_world_body[:-1]) @ truth.T_world_body[1:]:
        length = float(np.linalg.norm(step[:3, 3]))
        moved = scale * step[:3, 3] + noise * length * rng.standard_normal(3)
        R = step[:3, :3] @ so3_exp(np.array([0.0, 0.0, turn_rad]))
        poses.append(poses[-1] @ se3_from_parts(R, moved))
    return replace(truth, T_world_body=np.array(poses))


@pytest.mark.parametrize(
    ("shift_s", "words"), [(0.5, "0.500 s late"), (-1.0, "1.000 s early"), (3.0, "3.000 s late")]
)
def test_a_reference_of_another_clock_is_named(shift_s: float, words: str) -> None:
    notes = evaluate(_odometry(1.02, 1e-4, 0.02), _trajectory(shift_s=shift_s)).notes
    assert [note for note in notes if words in note and "its clock is not the estimate's" in note]
    assert not [note for note in notes if "body with other axes" in note]


@pytest.mark.parametrize("shift_s", [-0.1, 0.1])
def test_a_clock_is_named_however_long_the_path(shift_s: float) -> None:
    """0.1 s are 0.3 % of a path of a minute to and fro, whose estimate is right to millimetres."""
    count = 1200
    truth = _trajectory(count=count)
    noisy = truth.T_world_body.copy()
    noisy[:, :3, 3] += 0.003 * np.random.default_rng(5).standard_normal((count, 3))
    estimate = replace(truth, T_world_body=noisy)
    notes = evaluate(estimate, _trajectory(shift_s=shift_s, count=count)).notes
    words = "0.100 s late" if shift_s > 0 else "0.100 s early"
    assert [note for note in notes if words in note]
    assert not [note for note in evaluate(estimate, truth).notes if "clock" in note]


def test_an_antenna_ahead_of_a_car_is_no_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a constant speed a point 1 m ahead is where the car is 0.1 s later: either explains it."""
    times = 0.05 * np.arange(2400)
    heading = 0.6 * np.sin(0.12 * times)
    path = np.cumsum(0.5 * np.stack([np.cos(heading), np.sin(heading), 0 * heading], 1), axis=0)
    R = so3_exp(np.stack([0 * heading, 0 * heading, heading], 1))
    stamps = START_NS + np.round(1e9 * times).astype(np.int64)
    reference = Trajectory(se3_from_parts(R, path), stamps, "imu")
    ahead = _moved(reference, np.array([1.0, 0, 0]))
    assert not [note for note in evaluate(reference, ahead).notes if "clock" in note]
    monkeypatch.setattr(reference_faults, "_explaining_arm", lambda *_: None)
    assert [note for note in evaluate(reference, ahead).notes if "clock" in note]


def test_a_left_handed_reference_is_named() -> None:
    truth = _trajectory()
    poses = truth.T_world_body.copy()
    poses[:, 1, 3] *= -1
    notes = evaluate(_odometry(1.0, 1e-4, 0.02), replace(truth, T_world_body=poses)).notes
    assert len([note for note in notes if "its axes are left-handed" in note]) == 1


def test_inverse_poses_are_named() -> None:
    estimate = _odometry(1.02, 1e-4, 0.02)
    inverse = replace(estimate, T_world_body=se3_inverse(estimate.T_world_body))
    notes = evaluate(inverse, _trajectory()).notes
    assert len([note for note in notes if "poses of one of the two are inverted" in note]) == 1
    alone = replace(inverse, orientations="none")
    assert not [note for note in evaluate(alone, _trajectory()).notes if "inverted" in note]


def test_an_inverse_reference_in_another_world_is_named() -> None:
    # of a world whose origin is far from the estimate's, as a laboratory's is
    T_lab_world = se3_from_parts(so3_exp(np.array([0.0, 0.0, 2.0])), np.array([3.0, -4.0, 1.0]))
    truth = _trajectory()
    inverse = replace(truth, T_world_body=se3_inverse(T_lab_world @ truth.T_world_body))
    notes = evaluate(_odometry(1.02, 1e-4, 0.02), inverse).notes
    assert len([note for note in notes if "poses of the reference are inverted" in note]) == 1


def _holding(moves: bool) -> tuple[Trajectory, Trajectory]:
    """Truth and odometry of which the truth holds its pose over a quarter; the body moves or not."""
    truth = _trajectory()
    poses = truth.T_world_body.copy()
    poses[200:300] = poses[199]
    held = replace(truth, T_world_body=poses)
    if moves:
        estimate = _odometry(1.0, 1e-4, 0.02)
    else:
        noise = 0.02 * np.random.default_rng(1).standard_normal((COUNT, 3))
        estimate = replace(
            held, T_world_body=se3_from_parts(poses[:, :3, :3], poses[:, :3, 3] + noise)
        )
    return estimate, held


def test_a_reference_that_holds_its_last_pose_is_named() -> None:
    notes = evaluate(*_holding(moves=True)).notes
    (note,) = (note for note in notes if "repeat the one before to the bit" in note)
    assert note.startswith("100 positions of the reference")


def test_a_body_at_rest_holds_no_pose() -> None:
    assert not [note for note in evaluate(*_holding(moves=False)).notes if "to the bit" in note]


def test_milliseconds_in_decimals_are_named() -> None:
    own = (300_000_000, 6_200_000_000)
    assert "in ms: state" in epoch_hint(own, (300_000_000_000, 6_200_000_000_000), "the reference")
    assert "in us: state" in epoch_hint(own, (300_000 * 10**9, 6_200_000 * 10**9), "the reference")
    # the reference of a day, and one of another hour
    assert "in ms" not in epoch_hint(own, (10**10, 86_400 * 10**9), "the reference")
    assert "in ms" not in epoch_hint(own, (3600 * 10**9, 3606 * 10**9), "the reference")


def test_times_that_count_are_named() -> None:
    truth = _trajectory()
    counted = replace(truth, times_ns=10**9 * np.arange(COUNT, dtype=np.int64))
    estimate = replace(truth, times_ns=50_000_000 * np.arange(COUNT, dtype=np.int64))
    (note,) = (n for n in evaluate(estimate, counted).notes if n.startswith("only 20 poses match"))
    assert "the times of the reference count by one" in note


def test_rounded_quaternions_are_read_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rows = [(0.1 * k, 0, 0, 0, 0.0, 0.0, 0.38, 0.93) for k in range(5)]  # norm 1.0046
    np.savetxt(tmp_path / "two.txt", rows)
    read = read_trajectory(tmp_path / "two.txt")
    angle = np.arctan2(read.T_world_body[0, 1, 0], read.T_world_body[0, 0, 0])
    assert angle == pytest.approx(2 * np.arctan2(0.38, 0.93), abs=1e-12)
    assert "with too few digits" in caplog.text
    np.savetxt(tmp_path / "one.txt", [(*row[:7], 0.95) for row in rows])
    with pytest.raises(DataError, match=r"norm 1\.023"):
        read_trajectory(tmp_path / "one.txt")


def _moved(trajectory: Trajectory, arm: FloatArray) -> Trajectory:
    """The same motion of another point of the body, with other axes."""
    T_body_point = se3_from_parts(so3_exp(np.array([0.0, 0.0, np.pi / 2])), arm)
    return replace(trajectory, T_world_body=trajectory.T_world_body @ T_body_point)


ARM = np.array([0.5, -0.3, 0.2])


@pytest.mark.parametrize("scale", [1.0, 1.002])
def test_a_reference_of_another_point_of_the_body_is_named(scale: float) -> None:
    notes = evaluate(_odometry(scale, 1e-5, 0.002), _moved(_trajectory(), ARM)).notes
    (note,) = [note for note in notes if "another point of the body" in note]
    length, *found = [float(text) for text in re.findall(r"[-+]?\d+\.\d+", note)[:4]]
    assert length == pytest.approx(np.linalg.norm(ARM), abs=0.03)
    np.testing.assert_allclose(found, ARM, atol=0.03)


@pytest.mark.parametrize("scale", [0.9, 1.0, 1.05])
@pytest.mark.parametrize("turn_rad", [0.0, 1e-4, 1e-3])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_an_estimate_that_drifts_is_no_other_point_of_the_body(
    scale: float, turn_rad: float, noise: float
) -> None:
    notes = evaluate(_odometry(scale, turn_rad, noise), _trajectory()).notes
    assert not [note for note in notes if "another point of the body" in note]


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_a_scale_that_diverges_is_no_other_point_of_the_body() -> None:
    T_ref = _trajectory().T_world_body[::10]
    start = Alignment(R=np.eye(3), t=np.zeros(3), scale=1e-9)
    error_m, _ = reference_faults._beside_arm(
        T_ref, T_ref[:, :3, 3] + 1.0, start, scaled=True, arm=True
    )
    assert error_m == np.inf


def test_an_estimate_without_a_scale_is_called_so() -> None:
    truth = _trajectory()
    poses = _odometry(1.0, 1e-5, 0.002).T_world_body.copy()
    poses[:, :3, 3] *= 0.37
    (note,) = evaluate(replace(truth, T_world_body=poses), truth).notes
    assert "scaled by 2.7" in note
    assert "its lengths have no scale" in note
    other = truth.T_world_body.copy()
    other[:, :3, 3] = 3 * _positions(0.05 * np.arange(COUNT)[::-1] ** 2 / COUNT)
    (note,) = [
        note
        for note in evaluate(truth, replace(truth, T_world_body=other)).notes
        if "over the same poses" in note
    ]
    assert note.endswith("is it the reference of this recording?")


def test_placeholders_amid_an_estimate_are_named() -> None:
    poses = _odometry(1.0, 1e-4, 0.02).T_world_body.copy()
    poses = se3_inverse(poses[0]) @ poses
    poses[:5] = np.eye(4)  # as where a body stands at first
    whole = replace(_trajectory(), T_world_body=poses)
    assert not [n for n in evaluate(whole, _trajectory()).notes if "placeholders" in n]
    poses = poses.copy()
    poses[100:108] = np.eye(4)
    (note,) = [
        note
        for note in evaluate(replace(whole, T_world_body=poses), _trajectory()).notes
        if "placeholders" in note
    ]
    assert note.startswith("8 poses of the estimate, from row 100 on, are the identity")


@pytest.mark.parametrize(
    ("shift_s", "words"),
    [
        (36.9, "reference were late by 37 s (TAI and UTC)"),
        (-18.2, "reference were early by 18 s (GPS time and UTC) or 19 s (TAI and GPS"),
        (7200.0, "late by 7200 s (time zones)"),
        (-START_NS / 1e9, "count from the start of a device"),
        (55.0, None),
        (7300.0, None),
    ],
)
def test_usual_clocks_explain_times_that_do_not_overlap(shift_s: float, words: str | None) -> None:
    with pytest.raises(EvaluationError, match="check the clocks") as caught:
        evaluate(_trajectory(count=300), _trajectory(shift_s=shift_s, count=300))
    text = str(caught.value)
    if words is None:
        assert text.endswith("allow a larger difference")
    else:
        assert words in text


def test_long_recordings_are_not_explained_by_whole_hours() -> None:
    own = (START_NS, START_NS + 3000 * 10**9)
    later = (START_NS + 7200 * 10**9, START_NS + 10200 * 10**9)
    assert not epoch_hint(own, later, "the IMU")


@pytest.mark.parametrize("scale", [0.9, 1.0, 1.1])
@pytest.mark.parametrize("turn_rad", [0.0, 1e-3, -3e-3])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_an_estimate_that_drifts_is_no_fault_of_its_reference(
    scale: float, turn_rad: float, noise: float
) -> None:
    notes = evaluate(_odometry(scale, turn_rad, noise), _trajectory()).notes
    assert not [note for note in notes if "the positions agree where" in note]


def test_few_poses_say_nothing_of_a_clock() -> None:
    short = _trajectory(count=19)
    notes = evaluate(short, _trajectory(shift_s=0.2)).notes
    assert not [note for note in notes if "the positions agree where" in note]


def test_degrees_are_no_metres(tmp_path: Path) -> None:
    file = tmp_path / "gnss.csv"
    for names in ("time,lat,lon,alt", "timestamp,Latitude [deg],Longitude [deg],Height"):
        file.write_text(f"{names}\n1700000000.0,48.1,11.5,510\n1700000001.0,48.2,11.6,511\n")
        with pytest.raises(DataError, match="latitude and longitude, which are no metres"):
            read_trajectory(file)
    file.write_text("time,x,y,z\n1700000000.0,48.1,11.5,510\n1700000001.0,48.2,11.6,511\n")
    assert len(read_trajectory(file)) == 2


@pytest.mark.parametrize("name", ["estimate", "reference"])
def test_placeholders_before_a_body_is_found_are_named(name: str) -> None:
    """They were taken for another clock."""
    whole = _trajectory()
    poses = whole.T_world_body.copy()
    poses[:, :3, 3] += [4.0, -2.0, 1.0]
    moved = replace(whole, T_world_body=poses.copy())
    poses[:7] = np.eye(4)
    lost = replace(whole, T_world_body=poses)
    given = (lost, moved) if name == "estimate" else (moved, lost)
    (note,) = [note for note in evaluate(*given).notes if "placeholders" in note]
    assert note.startswith(f"the first 7 poses of the {name} are the same to the bit")
    assert not [note for note in evaluate(*given).notes if "clock" in note]


def test_a_gap_of_a_recording_after_its_start_leaves_no_placeholders() -> None:
    whole = _trajectory()
    assert whole.times_ns is not None
    for standing in (1, 20):
        kept = np.r_[0:standing, 100 : len(whole)]
        poses = whole.T_world_body[kept].copy()
        poses[:standing] = poses[0]
        gap = replace(whole, T_world_body=poses, times_ns=whole.times_ns[kept])
        assert not [n for n in evaluate(gap, gap).notes if "placeholders" in n]


def test_a_body_that_stands_at_its_start_has_no_placeholders() -> None:
    whole = _trajectory()
    poses = whole.T_world_body.copy()
    poses[:7] = poses[7]
    standing = replace(whole, T_world_body=poses)
    assert not [n for n in evaluate(standing, standing).notes if "placeholders" in n]


# --- a reference that jumps


def _jumping(first: int, last: int, by_m: float) -> Trajectory:
    truth = _trajectory()
    poses = truth.T_world_body.copy()
    poses[first:last, :3, 3] += np.array([by_m, -0.4 * by_m, 0.1 * by_m])
    return replace(truth, T_world_body=poses)


@pytest.mark.parametrize(("last", "count"), [(260, "2 times"), (COUNT, "1 time")])
@pytest.mark.parametrize("by_m", [0.5, 8.0])
def test_a_reference_that_jumps_is_named(last: int, count: str, by_m: float) -> None:
    notes = evaluate(_odometry(1.01, 0.0, 0.005), _jumping(150, last, by_m)).notes
    (note,) = [note for note in notes if "jumps" in note]
    assert f"the reference jumps {count} by up to" in note
    assert f"first at pose 151 of {COUNT}" in note
    assert not [note for note in notes if "clock" in note]


@pytest.mark.parametrize("seed", range(4))
def test_other_errors_are_no_jumps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    estimate = _odometry(1.0 + 0.03 * rng.standard_normal(), 0.01 * rng.standard_normal(), 0.1)
    noisy = _trajectory().T_world_body.copy()
    noisy[:, :3, 3] += 0.01 * rng.standard_normal((COUNT, 3))
    truth = replace(_trajectory(), T_world_body=noisy)
    # the estimate's own jump is no fault of the reference
    jumped = replace(estimate, T_world_body=_jumping(200, 300, 0.5).T_world_body)
    for case in (estimate, jumped):
        assert not [note for note in evaluate(case, truth).notes if "jumps" in note]


def _lost(first: int, last: int) -> Trajectory:
    """The estimate of a body that goes on while it is taken to stand, from one pose to another."""
    estimate = _odometry(1.01, 0.0, 0.005)
    poses = estimate.T_world_body.copy()
    away = poses[last - 1, :3, 3] - poses[first, :3, 3]
    poses[first:last, :3, 3] = poses[first, :3, 3]
    poses[last:, :3, 3] -= away
    return replace(estimate, T_world_body=poses)


@pytest.mark.parametrize(("first", "last"), [(COUNT - 20, COUNT), (150, 170)])
def test_an_estimate_that_loses_the_body_is_no_jump_of_the_reference(first: int, last: int) -> None:
    notes = evaluate(_lost(first, last), _trajectory()).notes
    assert not [note for note in notes if "jumps" in note]


def test_a_step_over_a_gap_that_an_estimate_loses_is_no_jump_of_the_reference() -> None:
    kept = np.r_[0:150, 170:COUNT]
    lost = take(_lost(150, 170), kept)
    assert not [n for n in evaluate(lost, take(_trajectory(), kept)).notes if "jumps" in n]


def test_a_short_drive_after_a_long_rest_is_no_jump() -> None:
    moved = np.diff(_trajectory().positions[:20], axis=0, prepend=_trajectory().positions[:1])
    steps = np.zeros((COUNT, 3))
    steps[10:30] = moved
    truth = _trajectory()
    poses = truth.T_world_body.copy()
    poses[:, :3, 3] = np.cumsum(steps, axis=0)
    reference = replace(truth, T_world_body=poses)
    poses = poses.copy()
    shares = np.linspace(0.7, 1.3, 20)[:, None]
    steps[10:30] *= shares
    poses[:, :3, 3] = np.cumsum(steps, axis=0)
    poses[:, :3, 3] += 1e-4 * np.random.default_rng(0).standard_normal((COUNT, 3))
    estimate = replace(truth, T_world_body=poses)
    assert not [note for note in evaluate(estimate, reference).notes if "jumps" in note]
