"""Nothing that this program did not write is replaced; what is given by mistake is named."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.commands import refused
from tests.plain_maker import make_plain
from vio.cli import main
from vio.datasets import open_dataset
from vio.datasets.settings import DatasetSettings
from vio.errors import DataError


@pytest.fixture(scope="module")
def run(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("foreign") / "run"
    assert main(["run", str(flight), "--quiet", "--save-observations", "--out", str(folder)]) == 0
    return folder


def test_files_of_others_are_not_replaced(
    flight: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, arguments in (
        ("notes.txt", ["convert", str(flight), "--to", "tum", "--out"]),
        ("page.html", ["report", str(run), "--out"]),
        (
            "rig.yaml",
            ["run", str(flight), "--quiet", "--out", str(tmp_path / "out"), "--save-calibration"],
        ),
    ):
        file = tmp_path / name
        file.write_text("mine\n")
        message = refused(capsys, *arguments, file)
        assert "remove it, or choose another name" in message
        # convert cannot tell its trajectories from others'
        assert ("was not made by this command" in message) == (arguments[0] != "convert")
        assert file.read_text() == "mine\n"
        file.unlink()
        assert main([*arguments, str(file)]) == 0
        capsys.readouterr()
    assert main(["report", str(run), "--out", str(tmp_path / "page.html")]) == 0, (
        "our own page may be replaced"
    )


def test_results_are_no_recording(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "holds the results of a run, not a recording" in refused(capsys, "run", run)
    assert "no recording is named" in refused(capsys, "run", "")


def test_what_takes_the_place_of_another_thing_is_named(
    flight: Path,
    run: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    table = flight / "mav0" / "imu0" / "data.csv"
    (tmp_path / "yard.map").write_bytes(b"SQLite format 3\0")
    message = f"{flight} is a recording, and {run} a run: name the run first"
    assert message in refused(capsys, "eval", flight, run)
    truth = tmp_path / "truth.tum"
    shutil.copy(run / "trajectory.tum", truth)
    for reference in (run, run / "trajectory.tum"):
        assert main(["eval", str(truth), str(reference)]) == 0
        assert "the estimate goes first" in caplog.text
        caplog.clear()
    capsys.readouterr()
    beside = run / "ground_truth.tum"  # as people copy it to a run, and as `reference.tum`
    shutil.copy(truth, beside)
    shutil.copy(truth, run / "reference.tum")
    for estimate, reference in (
        (run, truth), (run, run), (truth, beside), (truth, run / "reference.tum"),
    ):  # fmt: skip
        assert main(["eval", str(estimate), str(reference)]) == 0
        assert "the estimate goes first" not in caplog.text
    assert "the page is HTML; name it page.html" in refused(
        capsys, "report", run, "--out", tmp_path / "page.pdf"
    )
    for part in (table, flight / "mav0" / "cam0", flight / "mav0" / "cam0" / "data"):
        assert "is a part of the recording" in refused(capsys, "inspect", part)
    other = flight / "mav0" / "notes" / "readme.txt"
    other.parent.mkdir()
    other.write_text("mine\n")
    for beside in (other, other.parent):
        assert "no known recording" in refused(capsys, "inspect", beside)
    shutil.rmtree(other.parent)
    assert "is a folder; give one file of all poses" in refused(
        capsys, "run", flight, "--reference", flight, "--out", tmp_path / "out"
    )
    assert "is a map of vio run, which is not read; give the recording" in refused(
        capsys, "run", tmp_path / "yard.map"
    )
    assert "is neither the folder of a run nor a map; that comes first" in refused(
        capsys, "georeference", table, run, "--out", tmp_path / "earth"
    )
    assert "is no map of this program" in refused(capsys, "map", "check", table)


@pytest.mark.parametrize(("arm", "named"), [("30,0,120", True), ("1.5,0,3", False)])
def test_a_lever_arm_longer_than_a_vehicle_is_doubted(
    arm: str, named: bool, caplog: pytest.LogCaptureFixture
) -> None:
    from vio.cli.georeference import _lever_arm

    _lever_arm(arm)
    assert ("longer than a vehicle; --lever-arm takes metres" in caplog.text) == named


def test_pixels_of_other_types_are_named(tmp_path: Path) -> None:
    import cv2

    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        cv2.imwrite(str(tmp_path / side / "0.tiff"), np.zeros((48, 64), dtype=np.float32))
    with pytest.raises(
        DataError, match="its pixels are float32, and images of 8 or 16 bits are read"
    ):
        open_dataset(tmp_path)


def test_files_that_may_be_calibrations_are_named_where_none_is_read(
    flight: Path, tmp_path: Path
) -> None:
    for side, camera in (("left", "cam0"), ("right", "cam1")):
        shutil.copytree(flight / "mav0" / camera / "data", tmp_path / side)
    (tmp_path / "settings.yaml").write_text("Feature: {max: 2000}\n")
    (tmp_path / "imu.yaml").write_text("gyroscope_noise_density: 1e-4\n")
    with pytest.raises(
        DataError, match=r"no calibration; .*; of no form that is read: settings.yaml$"
    ):
        open_dataset(tmp_path)


def test_images_without_a_calibration_are_named(flight: Path, tmp_path: Path) -> None:
    shutil.copytree(flight / "mav0" / "cam0" / "data", tmp_path / "left")
    with pytest.raises(
        DataError,
        match=r"holds images in left but no right camera's and no calibration; add the right",
    ):
        open_dataset(tmp_path)


def test_a_run_that_can_go_on_is_not_said_to_be_lost(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run" / "unfinished").mkdir()
    (tmp_path / "run" / "estimates.npy").rename(tmp_path / "run" / "unfinished" / "estimates.npy")
    assert f"`vio run --resume {tmp_path / 'run'}` goes on with it" in refused(
        capsys, "report", tmp_path / "run"
    )


def test_settings_of_a_left_camera_serve_its_observations(run: Path) -> None:
    """A log of the left camera alone is of one camera already."""
    pair = open_dataset(run / "observations.npz", DatasetSettings(camera="left"))
    assert pair.recording.camera.kind == "mono"


def test_an_euroc_folder_of_one_camera_takes_its_times_from_its_list(
    flight: Path, tmp_path: Path
) -> None:
    """Rendered files are named by the nanoseconds since the start, which are no dates."""
    shutil.copytree(flight, tmp_path / "flight")
    shutil.rmtree(tmp_path / "flight" / "mav0" / "cam1")
    one, two = open_dataset(tmp_path / "flight").recording, open_dataset(flight).recording
    assert one.camera.kind == "mono"
    np.testing.assert_array_equal(one.frame_times_ns, two.frame_times_ns)
    listed = tmp_path / "flight" / "mav0" / "cam0" / "data.csv"
    listed.write_text("\n".join(listed.read_text().splitlines()[:-1]) + "\n")
    with pytest.raises(DataError, match=r"data\.csv: does not list .*\.png"):
        open_dataset(tmp_path / "flight")


def test_image_folders_of_trees_of_their_own_are_parts_of_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As Sintel's final_left/alley_1 and final_right/alley_1, Cityscapes' and DSEC's."""
    make_plain(tmp_path / "sintel", folders=("final_left/alley_1", "final_right/alley_1"))
    part = tmp_path / "sintel" / "final_right" / "alley_1"
    message = refused(capsys, "inspect", part)
    assert f"is a part of the recording {tmp_path / 'sintel'}; give that folder" in message
