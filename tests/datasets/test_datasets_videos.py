"""Two video files: the same recording to the bit where they are lossless, times, and one-line
errors.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.plain_maker import rig_of
from tests.same_events import assert_same_events, frames_of
from vio.cli import main
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.frame_times import Seconds, frames_between, parse_bound
from vio.datasets.rigs import load_rig
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import DataError, VioError
from vio.geometry.distortion import rig_from_rectified


def write_video(path: Path, images: list[np.ndarray], rate_hz: float = 20.0) -> None:
    """Write gray images without loss."""
    size = images[0].shape[1], images[0].shape[0]
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter_fourcc(*"FFV1"), rate_hz, size, isColor=True
    )
    assert writer.isOpened(), "this OpenCV has no FFV1"
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()


@pytest.fixture(scope="module")
def videos(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rendered flight as two videos."""
    return make_videos(flight, tmp_path_factory.mktemp("videos") / "videos")


def make_videos(flight: Path, folder: Path) -> Path:
    """Write a flight's images as two videos, with Kalibr's calibration and the IMU."""
    folder.mkdir()
    for camera, side in (("cam0", "left"), ("cam1", "right")):
        files = sorted((flight / "mav0" / camera / "data").iterdir(), key=lambda f: int(f.stem))
        write_video(
            folder / f"{side}.avi", [cv2.imread(str(f), cv2.IMREAD_GRAYSCALE) for f in files]
        )
        (folder / "times.txt").write_text(
            "# [ns]\n" + "".join(f"{int(f.stem) / 1e9:.9f}\n" for f in files)
        )
    (folder / "camchain-imucam.yaml").write_text(kalibr_text(load_rig(flight)))
    shutil.copyfile(flight / "mav0" / "imu0" / "data.csv", folder / "imu.csv")
    return folder


def test_side_by_side_images_and_video_are_the_same_recording(
    videos: Path, flight: Path, tmp_path: Path
) -> None:
    """As a ZED records: the left image beside the right one."""
    both = []
    stamps = sorted((f.stem for f in (flight / "mav0" / "cam0" / "data").iterdir()), key=int)
    for stamp in stamps:
        sides = [
            cv2.imread(str(flight / "mav0" / cam / "data" / f"{stamp}.png"), cv2.IMREAD_GRAYSCALE)
            for cam in ("cam0", "cam1")
        ]
        both.append(np.hstack(sides))
    companions = ("times.txt", "camchain-imucam.yaml", "imu.csv")
    video = tmp_path / "video"
    images = tmp_path / "images"
    (images / "images").mkdir(parents=True)
    video.mkdir()
    write_video(video / "HD720_SN123.avi", both)
    for stamp, image in zip(stamps, both, strict=True):
        assert cv2.imwrite(str(images / "images" / f"{stamp}.png"), image)
    usual = open_dataset(videos)
    for folder, kind in ((video, "video"), (images, "plain")):
        for name in companions:
            shutil.copyfile(videos / name, folder / name)
        dataset = open_dataset(folder)
        assert dataset.recording.kind == kind
        assert any("side by side" in note for note in dataset.recording.notes)
        assert_same_events(dataset, usual)
        left = open_dataset(folder, DatasetSettings(camera="left"))
        assert all(frame.right is None for frame in frames_of(left))


@pytest.mark.parametrize("stacked", [False, True])
def test_a_calibration_without_a_size_tells_what_one_video_holds(
    stacked: bool, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (48, 64), dtype=np.uint8) for _ in range(3)]
    stack = np.vstack if stacked else np.hstack
    write_video(tmp_path / "both.avi", [stack([image, image]) for image in images])
    (tmp_path / "calib.txt").write_text("fx: 60\ncx: 31\ncy: 23\nbaseline: 0.2\n")
    if stacked:
        with pytest.raises(DataError, match=r"whole width, not of its left half.* above the other"):
            open_dataset(tmp_path)
    else:
        assert open_dataset(tmp_path).recording.camera.width == 64


def test_one_video_of_one_camera_is_not_cut(videos: Path, tmp_path: Path) -> None:
    shutil.copytree(videos, tmp_path / "r")
    (tmp_path / "r" / "right.avi").unlink()
    with pytest.raises(DataError, match=r"is the only video, of .* side by side they would have"):
        open_dataset(tmp_path / "r")


def test_two_lossless_videos_are_the_same_recording_to_the_bit(videos: Path, flight: Path) -> None:
    euroc, video = open_dataset(flight), open_dataset(videos)
    assert video.recording.kind == "video"
    assert euroc.recording.camera == video.recording.camera
    np.testing.assert_array_equal(euroc.recording.T_cam0_imu, video.recording.T_cam0_imu)
    assert_same_events(euroc, video)
    assert_same_events(euroc, video, 3, 7)


def test_a_plain_folder_with_kalibrs_file_is_the_same_recording_to_the_bit(
    videos: Path, flight: Path, tmp_path: Path
) -> None:
    for camera, side in (("cam0", "left"), ("cam1", "right")):
        shutil.copytree(flight / "mav0" / camera / "data", tmp_path / side)
    for name in ("camchain-imucam.yaml", "imu.csv", "times.txt"):
        shutil.copyfile(videos / name, tmp_path / name)
    euroc, plain = open_dataset(flight), open_dataset(tmp_path)
    assert (euroc.recording.camera, plain.recording.kind) == (plain.recording.camera, "plain")
    np.testing.assert_array_equal(euroc.recording.T_cam0_imu, plain.recording.T_cam0_imu)
    assert_same_events(euroc, plain)


def test_the_left_camera_alone_needs_no_right_image(flight: Path, tmp_path: Path) -> None:
    shutil.copytree(flight, tmp_path / "f")
    for file in (tmp_path / "f" / "mav0" / "cam1" / "data").iterdir():
        file.write_bytes(b"no image")
    pairs = frames_of(open_dataset(flight), 0, 6)
    left = open_dataset(tmp_path / "f", DatasetSettings(camera="left"))
    alone = frames_of(left, 0, 6)
    assert len(alone) == len(pairs)
    for one, pair in zip(alone, pairs, strict=True):
        assert one.right is None
        np.testing.assert_array_equal(one.left, pair.left)


def test_the_left_video_alone_is_decoded(
    videos: Path, flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = frames_of(open_dataset(flight), 0, 4)
    left = open_dataset(videos, DatasetSettings(camera="left"))
    opened, real = [], cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", lambda name: opened.append(name) or real(name))
    alone = frames_of(left, 0, 4)
    assert [Path(name).name for name in opened] == ["left.avi"]
    for one, pair in zip(alone, pairs, strict=True):
        np.testing.assert_array_equal(one.left, pair.left)


def copy_of(videos: Path, folder: Path, *leave_out: str) -> Path:
    """A copy of the videos' folder without some files."""
    return Path(shutil.copytree(videos, folder, ignore=shutil.ignore_patterns(*leave_out)))


def test_without_times_the_rate_of_the_file_counts_and_it_is_said(
    videos: Path, tmp_path: Path
) -> None:
    recording = open_dataset(copy_of(videos, tmp_path / "v", "times.txt", "imu.csv")).recording
    assert np.diff(recording.frame_times_ns).tolist() == [50_000_000] * (
        len(recording.frame_times_ns) - 1
    )
    assert (
        "no times.txt: frames are 50 ms apart, as left.avi states; real cameras jitter"
        in recording.notes
    )


def spectacular_ai(videos: Path, folder: Path, leave_out: int = 0) -> Path:
    """Write the videos and the IMU as Spectacular AI records them: all times in `data.jsonl`, without
    those of some frames at the end.
    """
    path = copy_of(videos, folder, "times.txt", "imu.csv")
    (path / "left.avi").rename(path / "data.avi")
    (path / "right.avi").rename(path / "data2.avi")
    lines = []
    for row in (videos / "imu.csv").read_text().splitlines()[1:]:
        t, *values = row.split(",")
        for name, triple in (("gyroscope", values[:3]), ("accelerometer", values[3:])):
            sensor = f'{{"type": "{name}", "values": [{", ".join(triple)}]}}'
            lines.append(f'{{"sensor": {sensor}, "time": {int(t) / 1e9:.9f}}}')
    times = (videos / "times.txt").read_text().splitlines()[1:]
    for t in times[: len(times) - leave_out]:
        frames = f'[{{"cameraInd": 0, "time": {t}}}, {{"cameraInd": 1, "time": {t}}}]'
        lines.append(f'{{"frames": {frames}, "number": 1, "time": 0.5}}')
    (path / "data.jsonl").write_text("\n".join(lines) + "\n")
    return path


def test_a_recording_of_spectacular_ai_has_the_times_of_its_frames(
    videos: Path, tmp_path: Path
) -> None:
    dataset = open_dataset(spectacular_ai(videos, tmp_path / "v"))
    assert dataset.recording.kind == "video"
    assert_same_events(open_dataset(videos), dataset)
    cut = open_dataset(spectacular_ai(videos, tmp_path / "cut", leave_out=2)).recording
    count = len(dataset.recording.frame_times_ns)
    assert len(cut.frame_times_ns) == count - 2
    assert (
        f"data.jsonl has {count - 2} frames, the videos {count}; the first ones count" in cut.notes
    )


def test_each_video_may_lie_in_a_folder_of_its_own(videos: Path, tmp_path: Path) -> None:
    path = copy_of(videos, tmp_path / "v")
    for side in ("left", "right"):
        (path / side).mkdir()
        (path / f"{side}.avi").rename(path / side / "output.avi")
    moved, together = open_dataset(path), open_dataset(videos)
    assert moved.recording.kind == "video"
    assert_same_events(together, moved, 0, 3)


@pytest.mark.parametrize("name", ["timestamps.txt", "output.csv"])
def test_a_list_of_times_beside_each_video_in_its_folder_is_read(
    name: str, videos: Path, tmp_path: Path
) -> None:
    path = copy_of(videos, tmp_path / "v", "times.txt")
    for side in ("left", "right"):
        (path / side).mkdir()
        (path / f"{side}.avi").rename(path / side / "output.avi")
        shutil.copy(videos / "times.txt", path / side / name)
    moved, together = open_dataset(path), open_dataset(videos)
    assert_same_events(together, moved, 0, 3)
    assert not any("no times.txt" in note for note in moved.recording.notes)


def write_uneven(path: Path, images: list[np.ndarray], ticks: list[int]) -> None:
    """Write gray images as JPEG, image k presented at a multiple of 50 ms."""
    size = images[0].shape[1], images[0].shape[0]
    code = cv2.VideoWriter_fourcc(*"MJPG")
    even = path.with_suffix(".even.avi")
    writer = cv2.VideoWriter(str(even), code, 20.0, size)
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    packets = cv2.VideoCapture(str(even), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    raw = [cv2.VIDEOWRITER_PROP_RAW_VIDEO, 1]
    copy = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, 20.0, size, raw)
    assert copy.isOpened(), "this OpenCV has no Matroska"
    for tick in ticks:
        found, packet = packets.read()
        assert found
        copy.set(cv2.VIDEOWRITER_PROP_PTS, tick)
        copy.set(cv2.VIDEOWRITER_PROP_KEY_FLAG, 1)
        copy.write(packet)
    copy.release()
    packets.release()
    even.unlink()


@pytest.mark.skipif(
    not hasattr(cv2, "VIDEOWRITER_PROP_PTS"), reason="this OpenCV writes no times of frames"
)
def test_frames_of_an_uneven_video_have_the_times_that_it_states(
    videos: Path, flight: Path, tmp_path: Path
) -> None:
    """Each recorder has dropped frames of its own: pairs have one time, not one number."""
    folder = copy_of(videos, tmp_path / "v", "times.txt", "imu.csv", "left.avi", "right.avi")
    pairs = [(f.left, f.right) for f in frames_of(open_dataset(videos), 0, 16)]
    kept = {"left": [k for k in range(16) if k not in (5, 6)], "right": [*range(9), *range(10, 16)]}
    for camera, (side, ticks) in enumerate(kept.items()):
        write_uneven(folder / f"{side}.mkv", [pairs[k][camera] for k in ticks], ticks)
    dataset = open_dataset(folder)
    both = [k for k in range(16) if k not in (5, 6, 9)]
    assert dataset.recording.frame_times_ns.tolist() == [50_000_000 * k for k in both]
    notes = " | ".join(dataset.recording.notes)
    assert "have the presentation times of left.mkv, 50 to 150 ms apart" in notes
    assert "1 frames of left.mkv and 2 of right.mkv have no partner of their time" in notes
    for start in (0, 4):  # decoding from a later frame, too
        for frame, k in zip(frames_of(dataset, start), both[start:], strict=True):
            for seen, true in zip((frame.left, frame.right), pairs[k], strict=True):
                assert np.abs(seen.astype(int) - true).mean() < 4.0


def _truncate(folder: Path) -> None:
    data = (folder / "right.avi").read_bytes()
    (folder / "right.avi").write_bytes(data[: len(data) // 2])


def _other_rate(folder: Path) -> None:
    write_video(folder / "right.avi", [np.zeros((100, 160), np.uint8)] * 3, 25.0)


def _other_size(folder: Path) -> None:
    camera = load_rig(folder).camera
    other = rig_of(rig_from_rectified(camera, np.eye(4)))
    text = kalibr_text(other).replace(f"resolution: [{camera.width},", "resolution: [99,")
    (folder / "camchain-imucam.yaml").write_text(text)


BAD = {
    "no calibration": (lambda f: (f / "camchain-imucam.yaml").unlink(), "no calibration; add one"),
    "not a video": (
        lambda f: (f / "left.avi").write_bytes(b"no video" * 99),
        r"left\.avi: no frame can be decoded",
    ),
    "a truncated video": (
        _truncate,
        r"right\.avi: (frame \d+ of 16 cannot be decoded|no frame can be decoded)",
    ),
    "another rate": (_other_rate, r"left\.avi has 20 and right\.avi 25 frames per second"),
    "another size": (_other_size, "is 160 x .* pixels but .* is for 99 x"),
    "an IMU without times": (
        lambda f: (f / "times.txt").unlink(),
        r"imu\.csv: needs the times of the images",
    ),
    "too many times": (
        lambda f: (f / "times.txt").write_text("1\n" * 99),
        "holds 99 times for 16 image pairs",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_videos_are_refused_in_one_line(
    name: str, videos: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    change: Callable[[Path], object]
    change, message = BAD[name]
    folder = copy_of(videos, tmp_path / "v")
    change(folder)
    with pytest.raises(VioError, match=message) as caught:
        list(open_dataset(folder).events())
    assert "\n" not in str(caught.value).strip()


# --- seconds instead of frames
# --------------------------------------------------------------------------------------


def test_bounds_in_seconds(videos: Path) -> None:
    recording = open_dataset(videos, DatasetSettings()).recording  # 20 Hz
    assert parse_bound("12") == 12
    assert parse_bound("0.25s") == Seconds(0.25)
    assert frames_between(recording, Seconds(0.25), Seconds(0.5)) == (5, 10)
    assert frames_between(recording, Seconds(0.26), None) == (6, None)
    assert frames_between(recording, 2, 4) == (2, 4)
    with pytest.raises(ValueError, match="invalid literal"):
        parse_bound("12m")
    with pytest.raises(DataError, match=r"--start 9s is after its last frame at 0.7\d* s"):
        frames_between(recording, Seconds(9.0), None)


def test_run_takes_seconds(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    arguments = [
        "run",
        str(flight),
        "--start",
        "0.1s",
        "--end",
        "0.25s",
        "--out",
        str(out),
        "--quiet",
    ]
    assert main(arguments) == 0
    text = (out / "trajectory.tum").read_text()
    assert "# frames: 2-4" in text
    assert len(frames_of(open_dataset(flight), 2, 5)) == 3


@pytest.mark.parametrize("name", ["timestamps.csv", "timestamps.txt"])
def test_times_of_videos_may_be_named_as_those_of_folders(
    videos: Path, tmp_path: Path, name: str
) -> None:
    folder = copy_of(videos, tmp_path / "v")
    expected = open_dataset(folder).recording.frame_times_ns
    rows = [f"{k},{t}\n" for k, t in enumerate(expected.tolist())]
    (folder / "times.txt").unlink()
    (folder / name).write_text("frame,timestamp [ns]\n" + "".join(rows))
    np.testing.assert_array_equal(open_dataset(folder).recording.frame_times_ns, expected)


@pytest.mark.parametrize("names", ["{}.txt", "{}_timestamps.csv", "times-{}.txt"])
def test_a_list_for_each_of_two_videos_pairs_their_frames(
    names: str, videos: Path, tmp_path: Path
) -> None:
    folder = copy_of(videos, tmp_path / "v")
    usual = open_dataset(folder)
    times = usual.recording.frame_times_ns.tolist()
    (folder / "times.txt").unlink()
    frames = frames_of(usual)
    lost = [k for k in range(len(times)) if k not in (2, 3)]
    rights = [frame.right for frame in frames_of(usual)]
    assert all(right is not None for right in rights)
    write_video(folder / "right.avi", [rights[k] for k in lost])  # type: ignore[misc]
    for side, kept in (("left", range(len(times))), ("right", lost)):
        text = "frame,timestamp [ns]\n" + "".join(f"{n},{times[k]}\n" for n, k in enumerate(kept))
        (folder / names.format(side)).write_text(text)
    dataset = open_dataset(folder)
    assert dataset.recording.frame_times_ns.tolist() == [times[k] for k in lost]
    assert any("2 images of left.avi" in note for note in dataset.recording.notes)
    assert not any("not used" in note for note in dataset.recording.notes)
    for frame, k in zip(frames_of(dataset), lost, strict=True):
        np.testing.assert_array_equal(frame.left, frames[k].left)
        np.testing.assert_array_equal(frame.right, frames[k].right)


def test_a_list_of_all_frames_of_the_longer_video_serves(videos: Path, tmp_path: Path) -> None:
    folder = copy_of(videos, tmp_path / "v")
    usual = open_dataset(folder)
    rights = [frame.right for frame in frames_of(usual)]
    write_video(folder / "right.avi", rights[:-3])  # type: ignore[arg-type]
    dataset = open_dataset(folder)
    expected = usual.recording.frame_times_ns[:-3]
    np.testing.assert_array_equal(dataset.recording.frame_times_ns, expected)


def test_a_single_video_is_not_decoded_to_its_middle(
    videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = copy_of(videos, tmp_path / "v", "right.avi")
    asked: list[int] = []

    def note(count: int, load: Callable[[int], np.ndarray]) -> None:
        asked.append(count)

    monkeypatch.setattr("vio.datasets.videos.alternating_note", note)
    monkeypatch.setattr("vio.datasets.videos._LOOKED_AT", 5)
    with pytest.raises(DataError, match="is the only video"):
        open_dataset(folder)
    assert asked == [5]


def test_a_single_video_of_twice_the_height_may_hold_both_cameras(
    videos: Path, tmp_path: Path
) -> None:
    folder = copy_of(videos, tmp_path / "v", "right.avi")
    stacked = [np.vstack([frame.left] * 2) for frame in frames_of(open_dataset(videos), 0, 4)]
    write_video(folder / "left.avi", stacked)
    with pytest.raises(DataError, match="one above the other"):
        open_dataset(folder)
