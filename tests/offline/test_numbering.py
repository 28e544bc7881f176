"""Which frame a pose of a reference without times belongs to, where images were lost or a recording
is a part of a longer one.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.plain_maker import make_plain
from vio.cli import main
from vio.datasets import open_dataset
from vio.errors import DataError, EvaluationError
from vio.evaluation.numbering import numbered_by_images
from vio.evaluation.trajectories import evaluate
from vio.files.trajectories import frames_text, write_kitti, write_tum
from vio.records import FloatArray, Trajectory
from vio.runs.stated import read_image_numbers

HOLES = (0, 1, 2, 3, 6, 7, 8, 9, 11, 12, 13, 16, 18, 20)
LATER = tuple(range(100, 140))
EVEN = (0, 2, 6, 8)  # every second frame, one lost


def path(poses: int) -> FloatArray:
    """Poses (N, 4, 4) along x, pose k at k squared."""
    T = np.tile(np.eye(4), (poses, 1, 1))
    T[:, 0, 3] = np.arange(poses) ** 2
    return T


@pytest.mark.parametrize(
    ("numbers", "poses", "rows"),
    [
        (HOLES, 14, range(14)),  # one for each image
        (HOLES, 21, HOLES),  # one for each number
        (HOLES, 1101, HOLES),  # of the whole sequence
        (LATER, 40, range(40)),
        (LATER, 140, LATER),
        (LATER, 139, range(99, 139)),  # from 1
        (LATER, 1101, LATER),
        (LATER, 30, range(30)),  # ends early
        (EVEN, 4, range(4)),
        (EVEN, 5, (0, 1, 3, 4)),  # one for each second frame
        (EVEN, 9, EVEN),
        (range(30), 30, range(30)),
        (range(30), 20, range(20)),
        (range(30), 1101, range(30)),
        (range(1, 31), 35, range(30)),  # numbered from 1
        ((5,), 1, (0,)),
    ],
)
def test_the_number_of_poses_tells_whether_rows_are_images_or_numbers(
    numbers: tuple[int, ...], poses: int, rows: tuple[int, ...]
) -> None:
    found = numbered_by_images(Trajectory(path(poses), None, "cam0"), np.array(numbers))
    assert found.frame_indices is not None
    np.testing.assert_array_equal(found.frame_indices, np.arange(len(rows)))
    np.testing.assert_array_equal(found.positions[:, 0], np.array(rows) ** 2)


@pytest.mark.parametrize(
    ("numbers", "poses"), [(HOLES, 12), (HOLES, 17), (LATER, 120), (range(5, 45), 38), (EVEN, 3)]
)
def test_a_number_of_poses_that_fits_several_frames_is_refused(
    numbers: tuple[int, ...], poses: int
) -> None:
    with pytest.raises(EvaluationError, match=rf"has {poses} poses without times.* is not known"):
        numbered_by_images(Trajectory(path(poses), None, "cam0"), np.array(numbers))


def test_numbers_of_a_model_are_those_of_images_or_of_frames() -> None:
    numbers = np.array(HOLES)

    def model(*stated: int) -> Trajectory:
        return Trajectory(path(len(stated)), None, "cam0", np.array(stated))

    by_image = numbered_by_images(model(2, 6, 20), numbers)
    assert by_image.frame_indices is not None
    assert by_image.frame_indices.tolist() == [2, 4, 13]
    by_frame = numbered_by_images(model(0, 4, 5), numbers)
    assert by_frame.frame_indices is not None
    assert by_frame.frame_indices.tolist() == [0, 4, 5]
    with pytest.raises(EvaluationError, match="is not known"):
        numbered_by_images(model(0, 6, 7), numbers)


def test_times_or_unknown_numbers_leave_a_reference_as_it_is() -> None:
    bare = Trajectory(path(9), None, "cam0")
    assert numbered_by_images(bare, None) is bare
    timed = replace(bare, times_ns=np.arange(9))
    assert numbered_by_images(timed, np.array(HOLES)) is timed


def write_run(folder: Path, *, first: int = 0) -> Path:
    """Write what `vio eval` reads of a run without error over images with lost ones."""
    folder.mkdir()
    numbers = np.array(HOLES)
    frames = np.arange(first, len(HOLES))
    poses = Trajectory(path(21)[numbers[first:]], 100_000_000 * numbers[first:], "cam0", frames)
    write_tum(folder / "trajectory.tum", poses)
    write_kitti(folder / "trajectory.kitti", poses)
    metrics = {"T_cam0_imu": np.eye(4).tolist(), "image_numbers": frames_text(numbers)}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


@pytest.mark.parametrize("first", [0, 3])
@pytest.mark.parametrize("name", ["", "trajectory.tum", "trajectory.kitti"])
def test_eval_pairs_a_run_over_lost_images_by_their_numbers(
    name: str, first: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run", first=first)
    write_kitti(tmp_path / "truth.txt", Trajectory(path(30), None, "cam0"))
    assert main(["eval", str(run / name), str(tmp_path / "truth.txt"), "--json"]) == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert found["ate_m"] < 1e-9
    assert found["matched"] == len(HOLES) - first
    assert printed.err == ""
    write_kitti(tmp_path / "short.txt", Trajectory(path(12), None, "cam0"))
    assert main(["eval", str(run / name), str(tmp_path / "short.txt")]) == 1
    assert "is not known" in capsys.readouterr().err


def test_rows_taken_for_frames_are_doubted_where_their_numbers_differ() -> None:
    numbers = np.array(HOLES)
    estimate = Trajectory(path(21)[numbers], None, "cam0")
    found = evaluate(estimate, Trajectory(path(30), None, "cam0"))
    assert any(
        "row k of the estimate and the reference is taken for frame k" in note
        and "14 frames and the reference 30" in note
        for note in found.notes
    )
    same = evaluate(estimate, Trajectory(path(21)[numbers], None, "cam0"))
    assert same.notes == ()
    stated = replace(estimate, times_ns=numbers, frame_indices=np.arange(14))
    (note,) = evaluate(stated, Trajectory(path(15), None, "cam0"), align="none").notes[-1:]
    assert "row k of the reference is taken for frame k" in note


def test_damaged_numbers_of_images_are_named(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    for text in ("3-0", "0-999999999", "x"):
        metrics = {"T_cam0_imu": np.eye(4).tolist(), "image_numbers": text}
        (run / "metrics.json").write_text(json.dumps(metrics))
        with pytest.raises(DataError, match=r"is damaged \(image_numbers are"):
            read_image_numbers(run)


@pytest.mark.parametrize("poses", [4, 6, 9])
def test_poses_in_a_folder_that_lost_images_are_those_of_their_numbers(
    poses: int, tmp_path: Path
) -> None:
    folder = make_plain(
        tmp_path,
        times=False,
        imu=False,
        reference=False,
        name=lambda side, k: f"{(0, 1, 3, 5)[k]}.png",
    )
    (folder / "poses.txt").write_text("".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(poses)))
    recording = open_dataset(folder).recording
    truth = recording.reference
    assert truth is not None
    assert truth.times_ns is not None
    np.testing.assert_array_equal(truth.times_ns, recording.frame_times_ns)
    rows = [0, 1, 2, 3] if poses == 4 else [0, 1, 3, 5]
    np.testing.assert_allclose(np.diff(truth.positions[:, 0]), np.diff(rows), atol=1e-12)
    assert recording.image_numbers is not None
    assert recording.image_numbers.tolist() == [0, 1, 3, 5]
