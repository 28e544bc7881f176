"""Saved runs: path of the images, consistency of the files, and messages where they are
inconsistent.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.dataset_makers import calib_text, ece276a_arrays, make_drive, make_kitti, make_npz
from vio.cli import main
from vio.errors import DataError
from vio.offline.saved_run import SavedRun, read_saved_run, with_poses

FRAMES = 6


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a feature file, its saved run, and the saved run of that run's observations."""
    place = tmp_path_factory.mktemp("places")
    recording = make_npz(place / "drive.npz", ece276a_arrays(make_drive(FRAMES)))
    for source, out in ((recording, "first"), (place / "first" / "observations.npz", "second")):
        assert (
            main(["run", str(source), "--save-observations", "--out", str(place / out), "--json"])
            == 0
        )
    return place


@pytest.fixture
def run(places: Path) -> SavedRun:
    return read_saved_run(places / "first")


def _without_the_last_pose(file: Path) -> None:
    lines = (
        file.read_text()
        .replace(f"# frames: 0-{FRAMES - 1}", f"# frames: 0-{FRAMES - 2}")
        .splitlines(keepends=True)
    )
    file.write_text("".join(lines[:-1]))


def test_a_replayed_run_names_the_original_recording(places: Path) -> None:
    first, second = (read_saved_run(places / name) for name in ("first", "second"))
    assert first.source == second.source == f"ece276a:{places / 'drive.npz'}"
    np.testing.assert_array_equal(
        second.tracked.trajectory.T_world_body, first.tracked.trajectory.T_world_body
    )
    assert first.truth is None


def test_rejects_a_trajectory_of_another_run(places: Path, tmp_path: Path) -> None:
    folder = tmp_path / "spoiled"
    shutil.copytree(places / "first", folder)
    _without_the_last_pose(folder / "trajectory.tum")
    with pytest.raises(DataError, match="are not of the same complete run; repeat the run"):
        read_saved_run(folder)


def test_rejects_missing_refined_poses_and_those_of_other_frames(
    run: SavedRun, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match="contains no trajectory; create it with `vio refine"):
        with_poses(run, tmp_path)
    shutil.copy(run.tracked.where / "trajectory.tum", tmp_path)
    same = with_poses(run, tmp_path)
    np.testing.assert_allclose(
        same.tracked.trajectory.T_world_body, run.tracked.trajectory.T_world_body
    )
    _without_the_last_pose(tmp_path / "trajectory.tum")
    with pytest.raises(DataError, match=r"contains other frames than .*first; refine again"):
        with_poses(run, tmp_path)


def test_rejects_recordings_without_the_images_of_the_run(run: SavedRun, tmp_path: Path) -> None:
    rows = np.array([0, 2])
    with pytest.raises(DataError, match="contains no images; name the recording with --source"):
        list(run.images.frames(run.tracked.frames[rows]))
    with pytest.raises(
        DataError, match=r"are not available: .*does not exist.*; name the recording with --source"
    ):
        list(run.images.frames(run.tracked.frames[rows], str(tmp_path / "gone")))
    kitti = make_kitti(tmp_path / "kitti", frames=FRAMES)
    with pytest.raises(DataError, match="has another calibration than the run"):
        list(run.images.frames(run.tracked.frames[rows], str(kitti)))


def test_yields_images_in_order_and_reports_an_unreadable_one(
    run: SavedRun, tmp_path: Path
) -> None:
    kitti = make_kitti(tmp_path / "kitti", frames=FRAMES)
    (kitti / "calib.txt").write_text(calib_text(0.0, 0.54))
    camera = replace(run.tracked.camera, fu=700.0, fv=700.0, cu=16.0, cv=12.0, baseline_m=0.54)
    run = replace(run, tracked=replace(run.tracked, camera=camera))
    frames = list(run.images.frames(run.tracked.frames[np.array([1, 4])], str(kitti)))
    assert [frame.index for frame in frames] == [1, 4]
    broken = kitti / "image_1" / "000004.png"
    broken.write_bytes(broken.read_bytes()[:40])
    with pytest.raises(
        DataError,
        match=r"^\S*000004\.png: the PNG is truncated",
    ):
        list(run.images.frames(run.tracked.frames[np.array([1, 4])], str(kitti)))
