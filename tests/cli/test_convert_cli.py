"""`vio convert`: what it writes is the same recording again."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.commands import json_of
from tests.dataset_makers import ece276a_arrays, make_drive, make_kitti, make_npz
from tests.euroc_maker import make_euroc
from tests.plain_maker import make_plain
from tests.same_events import assert_same_events
from vio.cli import main
from vio.config import load_config
from vio.datasets import open_dataset
from vio.records import ImuSample, StereoFrame, VelocitySample
from vio.runs.pipeline import run

BAGS = ("rosbag2", "mcap")


@pytest.mark.parametrize("form", ["euroc", "plain", "kitti", *BAGS])
def test_a_converted_flight_is_the_same_recording(form: str, flight: Path, tmp_path: Path) -> None:
    _needs_rosbags(form)
    out = tmp_path / "out"
    assert main(["convert", str(flight), "--to", form, "--out", str(out)]) == 0
    before, after = open_dataset(flight), open_dataset(out)
    a, b = before.recording, after.recording
    assert b.kind == {"euroc": "euroc", "plain": "plain", "kitti": "plain"}.get(form, "bag")
    assert a.camera.baseline_m == pytest.approx(b.camera.baseline_m, abs=1e-15)
    np.testing.assert_allclose(a.T_cam0_imu, b.T_cam0_imu, atol=1e-15)
    assert a.motion == b.motion
    moved = []
    for recording in (a, b):
        assert recording.reference.times_ns is not None
        at = np.searchsorted(recording.reference.times_ns, recording.frame_times_ns)
        moved.append(
            np.linalg.norm(
                recording.reference.positions[at[9]] - recording.reference.positions[at[0]]
            )
        )
    assert moved[0] == pytest.approx(moved[1], rel=1e-9)
    if form != "kitti":  # whose clock begins at zero
        assert a.camera == b.camera
        np.testing.assert_array_equal(a.T_cam0_imu, b.T_cam0_imu)
        assert_same_events(before, after)
        ours, theirs = (
            run(dataset, load_config(), stop=6).trajectory for dataset in (before, after)
        )
        np.testing.assert_array_equal(ours.T_world_body, theirs.T_world_body)
        assert after.imu_noise == before.imu_noise  # type: ignore[attr-defined]


def test_a_conversion_never_removes_its_source_nor_what_others_put_beside_it(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = tmp_path / "first"
    assert main(["convert", str(flight), "--to", "plain", "--out", str(first), "--stop", "3"]) == 0
    for source, out in ((first, first), (first, tmp_path)):
        assert main(["convert", str(source), "--to", "kitti", "--out", str(out)]) == 1
        assert "itself and will not be replaced; choose another path" in capsys.readouterr().err
    assert (
        main(["convert", str(flight), "--to", "kitti", "--out", str(first), "--stop", "2"]) == 0
    ), "an earlier result"
    (first / "run").mkdir()
    (first / "run" / "notes.txt").write_text("mine")
    assert main(["convert", str(flight), "--to", "plain", "--out", str(first), "--stop", "2"]) == 1
    assert "holds run beside an earlier result" in capsys.readouterr().err
    assert (first / "run" / "notes.txt").is_file()


def _needs_rosbags(form: str) -> None:
    if form in BAGS:
        pytest.importorskip("rosbags", reason="needs rosbags")


@pytest.mark.parametrize("form", BAGS)
def test_a_bag_without_the_files_beside_it_has_its_calibration(
    form: str, flight: Path, tmp_path: Path
) -> None:
    """CameraInfo and /tf_static, whose quaternions cost the last bits of the extrinsics."""
    _needs_rosbags(form)
    out = tmp_path / "out"
    assert main(["convert", str(flight), "--to", form, "--out", str(out), "--stop", "4"]) == 0
    beside = open_dataset(out).recording
    assert "the calibration is camchain-imucam.yaml, not the bag's CameraInfo" in beside.notes
    for name in ("camchain-imucam.yaml", "imu.yaml"):
        (out / name).unlink()
    alone = open_dataset(out).recording
    assert alone.camera == beside.camera
    np.testing.assert_allclose(alone.T_cam0_imu, beside.T_cam0_imu, atol=1e-15)
    assert any("/tf_static" in note for note in alone.notes)
    np.testing.assert_array_equal(alone.reference.T_world_body, beside.reference.T_world_body)


def test_a_bag_keeps_velocities_and_says_how_they_are_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _needs_rosbags("mcap")
    source = make_kitti(tmp_path / "kitti")
    assert (
        json_of(capsys, "convert", source, "--to", "mcap", "--out", tmp_path / "bag")["notes"] == []
    )
    a, b = (
        [event for event in open_dataset(path).events() if isinstance(event, VelocitySample)]
        for path in (source, tmp_path / "bag")
    )
    assert [s.time_ns for s in a] == [s.time_ns for s in b]
    np.testing.assert_array_equal([s.linear for s in a], [s.linear for s in b])
    np.testing.assert_array_equal([s.angular for s in a], [s.angular for s in b])


def test_a_raw_recording_is_written_rectified(tmp_path: Path) -> None:
    source = make_euroc(tmp_path / "raw")
    out = tmp_path / "out"
    assert (
        main(
            [
                "convert",
                str(source),
                "--to",
                "plain",
                "--out",
                str(out),
                "--start",
                "1",
                "--stop",
                "3",
            ]
        )
        == 0
    )
    before, after = open_dataset(source), open_dataset(out)
    assert after.recording.camera == before.recording.camera
    ours, theirs = list(before.events(1, 3)), list(after.events())
    assert [event.time_ns for event in ours] == [event.time_ns for event in theirs]
    for x, y in zip(ours, theirs, strict=True):
        if hasattr(x, "left") and hasattr(y, "left"):
            np.testing.assert_array_equal(x.left, y.left)


def test_names_of_rendered_images_sort_by_time_as_text(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["convert", str(flight), "--to", "plain", "--out", str(out)]) == 0
    names = sorted(path.name for path in (out / "left").iterdir())
    assert names == sorted(names, key=lambda name: int(name.split(".")[0]))


def test_names_agree_with_their_list_where_the_last_frame_is_unreadable(tmp_path: Path) -> None:
    """Of a clock from zero, the last frame's time has more digits than those of the frames that
    were written.
    """
    source = make_plain(tmp_path / "plain")
    (source / "imu.csv").unlink(missing_ok=True)
    (source / "times.txt").write_text("0.85\n0.9\n0.95\n1.0\n")
    last = sorted((source / "left").iterdir())[-1]
    last.write_bytes(last.read_bytes()[:-30])
    out = tmp_path / "out"
    assert main(["convert", str(source), "--to", "euroc", "--out", str(out)]) == 0
    assert open_dataset(out).recording.frame_times_ns.tolist() == [
        850_000_000,
        900_000_000,
        950_000_000,
    ]
    names = sorted(path.name for path in (out / "mav0" / "cam0" / "data").iterdir())
    assert names == ["0850000000.png", "0900000000.png", "0950000000.png"]
    assert names[0] in (out / "mav0" / "cam0" / "data.csv").read_text()


def test_velocities_and_poses_at_the_frames_go_to_kitti(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = make_kitti(tmp_path / "kitti")
    out = tmp_path / "out"
    facts = json_of(capsys, "convert", source, "--to", "kitti", "--out", out)
    before, after = open_dataset(source), open_dataset(out)
    assert (after.recording.kind, facts["notes"]) == ("kitti", [])
    a, b = (
        [event for event in dataset.events() if isinstance(event, VelocitySample)]
        for dataset in (before, after)
    )
    np.testing.assert_array_equal([s.linear for s in a], [s.linear for s in b])
    assert len(after.recording.reference) == len(before.recording.reference)
    assert main(["convert", str(source), "--to", "euroc", "--out", str(tmp_path / "e")]) == 0
    assert "velocities have no place in EuRoC's form" in capsys.readouterr().out


def test_features_cannot_be_converted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = make_npz(tmp_path / "a.npz", ece276a_arrays(make_drive(6)))
    assert main(["convert", str(path), "--to", "plain", "--out", str(tmp_path / "out")]) == 1
    assert "holds no images, so there is nothing to convert" in capsys.readouterr().err


def test_rectify_names_convert_for_other_kinds(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = tmp_path / "plain"
    assert main(["convert", str(flight), "--to", "plain", "--out", str(plain)]) == 0
    assert main(["rectify", str(plain), "--out", str(tmp_path / "r")]) == 1
    assert "is of kind plain; rectify it with vio convert --to euroc" in capsys.readouterr().err


def test_a_recording_becomes_one_of_spectacular_ai(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    given = ["convert", str(flight), "--to", "spectacularai", "--out", str(out), "--stop", "5"]
    assert main(given) == 0
    dataset = open_dataset(flight)
    events = list(dataset.events(0, 5))
    frames = [event for event in events if isinstance(event, StereoFrame)]
    samples = [event for event in events if isinstance(event, ImuSample)]
    rows = [json.loads(line) for line in (out / "data.jsonl").read_text().splitlines()]
    origin_ns = events[0].time_ns
    for kind, name in (("gyroscope", "gyro"), ("accelerometer", "accel")):
        found = [row for row in rows if row.get("sensor", {}).get("type") == kind]
        assert [row["sensor"]["values"] for row in found] == [
            getattr(sample, name).tolist() for sample in samples
        ]
        assert [origin_ns + round(1e9 * row["time"]) for row in found] == [
            sample.time_ns for sample in samples
        ]
    assert [row["number"] for row in rows if "frames" in row] == [0, 1, 2, 3, 4]
    settings = (out / "vio_config.yaml").read_text()
    assert "wrapper-base" in settings
    cameras = json.loads((out / "calibration.json").read_text())["cameras"]
    T0, T1 = (np.array(camera["imuToCamera"]) for camera in cameras)
    np.testing.assert_array_equal(T0, dataset.recording.T_cam0_imu)
    assert (T1 @ np.linalg.inv(T0))[0, 3] == pytest.approx(-dataset.recording.camera.baseline_m)
    for side, name in (("left", "data.avi"), ("right", "data2.avi")):
        video = cv2.VideoCapture(str(out / name))
        for frame in frames:
            read, image = video.read()
            assert read
            assert np.abs(image[:, :, 0].astype(int) - getattr(frame, side)).max() <= 1
        assert not video.read()[0]


def test_spectacular_ai_needs_an_imu(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = make_kitti(tmp_path / "drive")
    given = ["convert", str(source), "--to", "spectacularai", "--out", str(tmp_path / "out")]
    assert main(given) == 1
    assert "needs an IMU" in capsys.readouterr().err


def _matrices(folder: Path) -> Path:
    folder.mkdir()
    for k in range(5):
        np.savetxt(
            folder / f"{k}.txt", np.diag([1.0, 1, 1, 1]) + k * np.eye(4)[:, :1] @ [[0, 0, 0, 1]]
        )
    return folder


def _over_four_lines(folder: Path) -> Path:
    folder.mkdir()
    lines = [file.read_text() for file in sorted(_matrices(folder / "each").iterdir())]
    (folder / "poses.log").write_text("".join(lines))
    return folder / "poses.log"


def _without_times(folder: Path) -> Path:
    folder.mkdir()
    rows = "".join(f"{k} 0 0 0 0 0 1\n" for k in range(5))
    (folder / "poses.txt").write_text("# tx ty tz qx qy qz qw\n" + rows)
    return folder / "poses.txt"


@pytest.mark.parametrize("make", [_matrices, _over_four_lines, _without_times])
def test_all_forms_of_trajectories_that_are_read_are_converted(
    make: Callable[[Path], Path], tmp_path: Path
) -> None:
    out = tmp_path / "out.kitti"
    source = make(tmp_path / "source")
    assert main(["convert", str(source), "--to", "kitti", "--out", str(out)]) == 0
    np.testing.assert_allclose(np.loadtxt(out)[:, 3], np.arange(5))
