"""ROS bags with one image topic: the same recording of one camera as a folder's, to the bit."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

rosbags = pytest.importorskip("rosbags", reason="needs rosbags")

from tests.bag_maker import Script, noise_frames  # noqa: E402
from tests.same_events import assert_same_events, frames_of  # noqa: E402
from vio.cameras.rig import Rig  # noqa: E402
from vio.config import Config  # noqa: E402
from vio.datasets import DatasetSettings, open_dataset  # noqa: E402
from vio.datasets.bags.reader import BagDataset  # noqa: E402
from vio.datasets.rigs.kalibr import kalibr_text  # noqa: E402
from vio.errors import CalibrationError, ConfigError  # noqa: E402
from vio.geometry.distortion import CameraModel  # noqa: E402
from vio.geometry.lie import se3_exp, se3_inverse  # noqa: E402
from vio.geometry.stereo import one_camera  # noqa: E402
from vio.records import ImuSample, StereoFrame  # noqa: E402
from vio.runs.pipeline import run  # noqa: E402

START_NS = 10**18
T_CAM0_IMU = se3_exp([0.1, -0.05, 0.02, 1.2, -1.2, 1.2])
T_BASE_IMU = se3_exp([0.3, 0.2, -0.1, 0.1, 0.0, 0.4])
LENS = (-0.3, 0.1, 0.001, -0.002)
RIG = Rig(CameraModel(40.0, 41.0, 31.0, 23.0, 64, 48, "radtan", LENS), T_cam0_imu=T_CAM0_IMU)
FRAMES = [(time_ns, left) for time_ns, left, _ in noise_frames(4)]
SAMPLES = [
    ImuSample(START_NS + 5_000_000 * k, np.array([0.1, 0.2, k]), np.array([0.0, 0, 9.8]))
    for k in range(-4, 34)
]


@pytest.fixture(scope="module")
def mono_flight(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rendered flight as an EuRoC folder with cam0 alone."""
    folder = tmp_path_factory.mktemp("mono_flight")
    shutil.copytree(flight, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("cam1"))
    times_ns = open_dataset(flight).recording.frame_times_ns.tolist()
    (folder / "times.txt").write_text("\n".join(f"{time_ns * 1e-9:.9f}" for time_ns in times_ns))
    return folder


@pytest.mark.parametrize("storage", ["bag", "db3", "mcap"])
def test_a_flight_of_one_camera_is_the_same_recording_to_the_bit(
    storage: str, mono_flight: Path, tmp_path: Path
) -> None:
    folder = open_dataset(mono_flight)
    script = Script(storage)
    for event in folder.events():
        if isinstance(event, StereoFrame):
            script.image("/camera/image_raw", event.time_ns, event.left)
        elif isinstance(event, ImuSample):
            script.imu("/imu0", event, event.time_ns + 1_000_000)
    truth = folder.recording.reference
    for time_ns, T in zip(truth.times_ns.tolist(), truth.T_world_body, strict=True):
        script.pose("/vicon/pose", time_ns, T)
    path = script.write(tmp_path / ("f.bag" if storage == "bag" else "f"))
    bag = open_dataset(path, DatasetSettings(calibration=mono_flight))
    a, b = folder.recording, bag.recording
    assert (a.kind, b.kind, b.camera.kind) == ("mono", "bag", "mono")
    assert (a.camera, a.motion) == (b.camera, b.motion)
    np.testing.assert_array_equal(a.T_cam0_imu, b.T_cam0_imu)
    np.testing.assert_array_equal(a.frame_times_ns, b.frame_times_ns)
    assert b.reference.body == truth.body
    np.testing.assert_allclose(truth.T_world_body, b.reference.T_world_body, atol=1e-12)
    assert_same_events(folder, bag)
    assert_same_events(folder, bag, 5, 9)
    assert isinstance(bag, BagDataset)
    assert b.notes == ()


# --- calibration
# --------------------------------------------------------------------------------------------------


def script_of(storage: str = "mcap", *, imu: bool = True, images: bool = True) -> Script:
    """Four frames with a CameraInfo of a lens, an IMU of 200 Hz, and its place in /tf_static by
    way of a base frame.
    """
    script = Script(storage)
    if images:
        for time_ns, image in FRAMES:
            script.image("/left/image_raw", time_ns, image)
    c = RIG.cam0
    camera = one_camera(c.fu, c.fv, c.cu, c.cv, c.width, c.height)
    script.camera_info("/left/camera_info", START_NS, camera, right=False)
    setattr(script.notes[-1].fields, "D" if storage == "bag" else "d", np.array([*LENS, 0.0]))
    if imu:
        script.static(START_NS, "base", "imu", T_BASE_IMU)
        script.static(START_NS, "base", "left", T_BASE_IMU @ se3_inverse(T_CAM0_IMU))
        for sample in SAMPLES:
            script.imu("/imu", sample)
    return script


@pytest.fixture(scope="module")
def folder_of_one(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `script_of` holds as a plain folder."""
    folder = tmp_path_factory.mktemp("one")
    (folder / "left").mkdir()
    for time_ns, image in FRAMES:
        cv2.imwrite(str(folder / "left" / f"{time_ns}.png"), image)
    (folder / "calibration.yaml").write_text(kalibr_text(RIG))
    rows = [
        ",".join([str(s.time_ns), *(repr(float(x)) for x in (*s.gyro, *s.accel))]) for s in SAMPLES
    ]
    header = "#timestamp [ns],w_x [rad s^-1],w_y,w_z,a_x [m s^-2],a_y,a_z"
    (folder / "imu.csv").write_text("\n".join([header, *rows]))
    return folder


@pytest.mark.parametrize("storage", ["bag", "mcap"])
def test_camera_info_and_static_frames_are_the_calibration(
    storage: str, folder_of_one: Path, tmp_path: Path
) -> None:
    folder = open_dataset(folder_of_one)
    bag = open_dataset(script_of(storage).write(tmp_path / ("f.bag" if storage == "bag" else "f")))
    recording = bag.recording
    assert recording.camera == folder.recording.camera
    np.testing.assert_allclose(recording.T_cam0_imu, T_CAM0_IMU, atol=1e-12)
    assert_same_events(folder, bag)
    assert recording.motion == {"imu"}
    assert recording.notes == ("the IMU's pose is that of /tf_static (imu in left)",)
    (first, *_), (_, image) = frames_of(bag), FRAMES[0]
    assert not np.array_equal(first.left, image)  # the lens was taken out


def test_a_file_beside_the_bag_is_read_before_camera_info(
    folder_of_one: Path, tmp_path: Path
) -> None:
    path = script_of().write(tmp_path / "f")
    other = replace(RIG, cam0=replace(RIG.cam0, fu=50.0))
    (path / "calibration.yaml").write_text(kalibr_text(other))
    recording = open_dataset(path).recording
    assert recording.camera == other.rectifier().camera
    assert "the calibration is calibration.yaml, not the bag's CameraInfo" in recording.notes
    settings = DatasetSettings(calibration=folder_of_one / "calibration.yaml")
    assert open_dataset(path, settings).recording.camera == RIG.rectifier().camera


def test_rectified_images_take_the_projection_matrix_alone(tmp_path: Path) -> None:
    script = script_of(images=False)
    for time_ns, image in FRAMES:
        script.compressed("/left/image_rect/compressed", time_ns, image)
    dataset = open_dataset(script.write(tmp_path / "f"))
    assert dataset.recording.camera == one_camera(40.0, 41.0, 31.0, 23.0, 64, 48)
    for frame, (_, image) in zip(frames_of(dataset), FRAMES, strict=True):
        np.testing.assert_array_equal(frame.left, image)


def test_camera_info_of_zeros_is_refused(tmp_path: Path) -> None:
    script = script_of(imu=False)
    script.notes[-1].fields.k = np.zeros(9)
    with pytest.raises(
        CalibrationError,
        match=r"/left/camera_info: not calibrated \(K is zero\); give a calibration",
    ):
        open_dataset(script.write(tmp_path / "f"))


@pytest.mark.parametrize(
    ("raw", "compressed", "taken"),
    [(4, 4, "/camera/image_raw"), (1, 4, "/camera/image_raw/compressed")],
    ids=["both", "raw images of a moment"],
)
def test_raw_and_compressed_images_of_one_camera_are_one_camera(
    raw: int, compressed: int, taken: str, tmp_path: Path
) -> None:
    script = Script("mcap")
    for time_ns, image in FRAMES[:raw]:
        script.image("/camera/image_raw", time_ns, image)
    for time_ns, image in FRAMES[:compressed]:
        script.compressed("/camera/image_raw/compressed", time_ns, image)
    for sample in SAMPLES:
        script.imu("/imu", sample)
    (tmp_path / "c.yaml").write_text(kalibr_text(RIG))
    path = script.write(tmp_path / "f")
    bag = open_dataset(path, DatasetSettings(calibration=tmp_path / "c.yaml"))
    assert bag.recording.camera.kind == "mono"
    assert len(frames_of(bag)) == 4
    assert any(
        note.startswith(f"{taken} is taken; ") and "same camera" in note
        for note in bag.recording.notes
    )
    for right in ("", ",right=none"):
        named = DatasetSettings(
            calibration=tmp_path / "c.yaml", topics=f"left=/camera/image_raw{right}"
        )
        assert len(frames_of(open_dataset(path, named))) == raw


# --- topics
# --------------------------------------------------------------------------------------------------


def test_depth_images_beside_one_camera_leave_one(tmp_path: Path) -> None:
    script = script_of()
    for time_ns, image in FRAMES:
        script.image("/depth/image_raw", time_ns, image.astype(np.uint16), "16UC1")
    recording = open_dataset(script.write(tmp_path / "f")).recording
    assert recording.camera.kind == "mono"
    assert "not used: /depth/image_raw" in recording.notes


def test_the_only_topic_may_be_named(folder_of_one: Path, tmp_path: Path) -> None:
    """Also one whose name speaks against gray images."""
    script = script_of()
    script.notes = [
        replace(note, topic=note.topic.replace("/left/image_raw", "/left/thermal/image_raw"))
        for note in script.notes
    ]
    path = script.write(tmp_path / "f")
    bag = open_dataset(path, DatasetSettings(topics="left=/left/thermal/image_raw,imu=/imu"))
    assert_same_events(open_dataset(folder_of_one), bag)


def test_without_an_imu_a_run_says_what_it_says_of_a_folder(
    folder_of_one: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "folder"
    shutil.copytree(folder_of_one, folder, ignore=shutil.ignore_patterns("imu.csv"))
    named = DatasetSettings(topics="imu=none")
    bags = (
        open_dataset(script_of(imu=False).write(tmp_path / "f")),
        open_dataset(script_of().write(tmp_path / "g"), named),
    )
    for dataset in (open_dataset(folder), *bags):
        assert dataset.recording.motion == frozenset()
        with pytest.raises(ConfigError, match="one camera alone knows no scale: add an IMU"):
            run(dataset, Config())


def test_the_left_camera_of_one_is_that_camera(tmp_path: Path) -> None:
    alone = open_dataset(script_of().write(tmp_path / "f"), DatasetSettings(camera="left"))
    assert "there is one camera only: --camera left changes nothing" in alone.recording.notes


# --- stamps
# --------------------------------------------------------------------------------------------------


def test_images_logged_late_come_in_the_order_of_their_stamps(
    folder_of_one: Path, tmp_path: Path
) -> None:
    """Image 1 is logged after image 2, and image 3 comes twice."""
    script = script_of()
    images = [note for note in script.notes if note.topic == "/left/image_raw"]
    late = replace(images[1], logged_ns=START_NS + 130_000_000)
    script.notes[script.notes.index(images[1])] = late
    script.notes.append(replace(images[3], logged_ns=START_NS + 160_000_000))
    bag = open_dataset(script.write(tmp_path / "f"))
    assert_same_events(open_dataset(folder_of_one), bag)
    assert_same_events(open_dataset(folder_of_one), bag, 1, 2)
    assert "1 images repeat a stamp and are skipped" in bag.recording.notes
