"""ROS bags of both generations: the same recording to the bit, topics, encodings, stamps, and
one-line errors.
"""

from __future__ import annotations

import gzip
import importlib
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

rosbags = pytest.importorskip("rosbags", reason="needs rosbags")

from tests.bag_maker import Script, noise_frames, of_stereo  # noqa: E402
from tests.same_events import assert_same_events, frames_of  # noqa: E402
from vio.cameras.rig import Rig  # noqa: E402
from vio.datasets import DatasetSettings, open_dataset  # noqa: E402
from vio.datasets.bags.pictures import gray_of, raw_gray  # noqa: E402
from vio.datasets.images import UnreadableImageError  # noqa: E402
from vio.datasets.levels import Levels, levels_of  # noqa: E402
from vio.datasets.rigs.kalibr import kalibr_text  # noqa: E402
from vio.errors import CalibrationError, DataError, VioError  # noqa: E402
from vio.geometry.lie import se3_exp, se3_inverse  # noqa: E402
from vio.protocols import Dataset  # noqa: E402
from vio.records import ImuSample, StereoFrame, VelocitySample  # noqa: E402

START_NS = 10**18
T_CAM0_IMU = se3_exp([0.1, -0.05, 0.02, 1.2, -1.2, 1.2])
T_BASE_IMU = se3_exp([0.3, 0.2, -0.1, 0.1, 0.0, 0.4])
RIG = Rig.rectified(40.0, 40.0, 31.5, 23.5, 0.11, 64, 48)
STORAGES = ("bag", "db3", "mcap")


def bag_of(dataset: Dataset, storage: str, path: Path) -> Path:
    """Write a recording's frames, IMU and ground truth as a bag, with a millisecond between
    stamp and log.
    """
    script = Script(storage)
    for event in dataset.events():
        if isinstance(event, StereoFrame):
            of_stereo(script, [(event.time_ns, event.left, event.right)])
        elif isinstance(event, ImuSample):
            script.imu("/imu0", event, event.time_ns + 1_000_000)
    truth = dataset.recording.reference
    for time_ns, T in zip(truth.times_ns.tolist(), truth.T_world_body, strict=True):
        script.pose("/vicon/pose", time_ns, T)
    return script.write(path)


def test_the_left_camera_alone_needs_no_right_image(flight: Path, tmp_path: Path) -> None:
    script = Script("mcap")
    pairs = frames_of(open_dataset(flight), 0, 4)
    for pair in pairs:
        # right images of a wrong size
        of_stereo(script, [(pair.time_ns, pair.left, pair.left[:8, :8])])
    path = script.write(tmp_path / "f")
    rig = Rig.rectified(40.0, 40.0, 31.5, 23.5, 0.11, *reversed(pairs[0].left.shape))  # type: ignore[union-attr,misc]
    (tmp_path / "camchain.yaml").write_text(kalibr_text(rig))
    settings = DatasetSettings(calibration=tmp_path / "camchain.yaml", camera="left")
    alone = frames_of(open_dataset(path, settings))
    assert len(alone) == len(pairs)
    for one, pair in zip(alone, pairs, strict=True):
        np.testing.assert_array_equal(one.left, pair.left)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_is_the_same_recording_to_the_bit(storage: str, flight: Path, tmp_path: Path) -> None:
    euroc = open_dataset(flight)
    path = bag_of(euroc, storage, tmp_path / ("f.bag" if storage == "bag" else "f"))
    sources = [path] if storage == "bag" else [path, next(path.glob(f"*.{storage}"))]
    for source in sources:
        bag = open_dataset(source, DatasetSettings(calibration=flight))
        a, b = euroc.recording, bag.recording
        assert b.kind == "bag"
        assert (a.camera, a.motion) == (b.camera, b.motion)
        np.testing.assert_array_equal(a.T_cam0_imu, b.T_cam0_imu)
        np.testing.assert_array_equal(a.frame_times_ns, b.frame_times_ns)
        np.testing.assert_allclose(a.reference.T_world_body, b.reference.T_world_body, atol=1e-12)
        assert_same_events(euroc, bag)
        assert_same_events(euroc, bag, 5, 9)
        assert euroc.imu_noise == bag.imu_noise is not None  # type: ignore[attr-defined]
        assert b.notes == ()


# --- calibration and topics
# -----------------------------------------------------------------------------------------


def plain_script(storage: str = "mcap", frames: int = 4, *, imu: bool = True) -> Script:
    """A stereo pair with CameraInfo, an IMU of 200 Hz, and its place in /tf_static by way of a
    base frame.
    """
    script = of_stereo(Script(storage), noise_frames(frames))
    for side in ("left", "right"):
        script.camera_info(f"/{side}/camera_info", START_NS, RIG.camera, right=side == "right")
    if imu:
        script.static(START_NS, "base", "imu", T_BASE_IMU)
        script.static(START_NS, "base", "left", T_BASE_IMU @ se3_inverse(T_CAM0_IMU))
        for k in range(-4, 10 * frames - 6):
            script.imu(
                "/imu",
                ImuSample(
                    START_NS + 5_000_000 * k, np.array([0.1, 0.2, k]), np.array([0.0, 0, 9.8])
                ),
            )
    return script


@pytest.mark.parametrize("storage", STORAGES)
def test_camera_info_and_static_frames_are_the_calibration(storage: str, tmp_path: Path) -> None:
    path = plain_script(storage).write(tmp_path / ("f.bag" if storage == "bag" else "f"))
    recording = open_dataset(path).recording
    assert recording.camera.baseline_m == pytest.approx(0.11, abs=1e-12)
    assert (recording.camera.width, recording.camera.height) == (64, 48)
    np.testing.assert_allclose(recording.T_cam0_imu, T_CAM0_IMU, atol=1e-12)
    assert recording.motion == {"imu"}
    assert "the IMU's pose is that of /tf_static (imu in left)" in recording.notes


def test_without_its_pose_the_imu_is_left_out_and_it_is_said(tmp_path: Path) -> None:
    script = plain_script()
    script.notes = [note for note in script.notes if note.topic != "/tf_static"]
    recording = open_dataset(script.write(tmp_path / "f")).recording
    assert recording.motion == frozenset()
    assert any(
        "/imu cannot be used: its pose in the camera is unknown" in note for note in recording.notes
    )


def test_compressed_images_and_empty_topics(tmp_path: Path) -> None:
    script = of_stereo(plain_script(imu=False, frames=0), noise_frames(4), compressed=True)
    script.empty += [("/bob/imu", "sensor_msgs/msg/Imu"), ("/lidar", "sensor_msgs/msg/PointCloud2")]
    dataset = open_dataset(script.write(tmp_path / "f"))
    expected = list(noise_frames(4))
    frames = frames_of(dataset)
    for frame, (time_ns, left, right) in zip(frames, expected, strict=True):
        assert frame.time_ns == time_ns
        np.testing.assert_array_equal(frame.left, left)
        np.testing.assert_array_equal(frame.right, right)
    assert "topics without a message: /bob/imu, /lidar" in dataset.recording.notes


@pytest.mark.parametrize("packing", ["gzip", "zstd"])
def test_images_of_zstd_transport_are_read(packing: str, tmp_path: Path) -> None:
    """Its earlier versions name gzip so."""
    script = plain_script(imu=False, frames=0)
    zstd = vars(importlib.import_module("rosbags.rosbag2.reader"))["zstd"]
    pack = gzip.compress if packing == "gzip" else zstd.compress
    kind = "sensor_msgs/msg/CompressedImage"
    for time_ns, *images in noise_frames(4):
        for side, image in zip(("left", "right"), images, strict=True):
            height, width = image.shape
            head = struct.pack("<IIBII", height, width, 0, width, 5) + b"mono8"
            data = np.frombuffer(head + pack(image.tobytes()), np.uint8)
            fields = script.make(kind, script.header(time_ns, side), "zstd", data)
            script.add(f"/{side}/image_raw/zstd", kind, time_ns, fields)
    frames = frames_of(open_dataset(script.write(tmp_path / "f")))
    for frame, (_, left, right) in zip(frames, noise_frames(4), strict=True):
        np.testing.assert_array_equal(frame.left, left)
        np.testing.assert_array_equal(frame.right, right)


@pytest.mark.parametrize(
    "data", [b"", b"\1" * 17, struct.pack("<IIBII", 2, 2, 0, 2, 5) + b"mono8(\xb5/\xfdx"]
)
def test_damaged_images_of_zstd_transport_are_named(data: bytes) -> None:
    fields = SimpleNamespace(format="zstd", data=data)
    with pytest.raises(UnreadableImageError, match="frame 3: does not decompress"):
        gray_of(fields, "frame 3", compressed=True)


def test_compressed_images_that_ros_rectified_stay_as_they_are(tmp_path: Path) -> None:
    """The lens of CameraInfo is that of the raw images."""
    script = plain_script(imu=False, frames=0)
    for note in script.notes:
        note.fields.d = np.array([-0.3, 0.1, 0.0, 0.0, 0.0])
    for time_ns, left, right in noise_frames(4):
        script.compressed("/left/image_rect/compressed", time_ns, left)
        script.compressed("/right/image_rect/compressed", time_ns, right)
    frames = frames_of(open_dataset(script.write(tmp_path / "f")))
    for frame, (_, left, right) in zip(frames, noise_frames(4), strict=True):
        np.testing.assert_array_equal(frame.left, left)
        np.testing.assert_array_equal(frame.right, right)


def test_topics_may_be_named(tmp_path: Path) -> None:
    script = plain_script(imu=False)
    for time_ns, left, right in noise_frames(4):
        script.image("/a", time_ns, left)
        script.image("/b", time_ns, right)
    path = script.write(tmp_path / "f")
    calibration = tmp_path / "rig.yaml"
    calibration.write_text(kalibr_text(RIG))
    dataset = open_dataset(
        path, DatasetSettings(topics="left=/a, right=b", calibration=calibration)
    )
    assert [topic.name for topic in dataset.topics] == ["/a", "/b"]
    assert "not used: /left/image_raw, /right/image_raw" in dataset.recording.notes


def test_odometry_is_velocity_and_reference(tmp_path: Path) -> None:
    script = plain_script(imu=False)
    script.static(START_NS, "left", "base", T_CAM0_IMU)
    for k in range(4):
        script.odometry(
            "/odom",
            START_NS + 50_000_000 * k,
            se3_exp([k, 0, 0, 0, 0, 0]),
            [1.0, 0, 0],
            [0, 0, 0.1 * k],
        )
    calibration = tmp_path / "rig.yaml"
    calibration.write_text(
        kalibr_text(Rig.rectified(40.0, 40.0, 31.5, 23.5, 0.11, 64, 48, T_CAM0_IMU))
    )
    settings = DatasetSettings(topics="velocity=/odom,reference=/odom", calibration=calibration)
    named = script.write(tmp_path / "f")
    dataset = open_dataset(named, settings)
    samples = [event for event in dataset.events() if isinstance(event, VelocitySample)]
    assert [s.angular[2] for s in samples] == [0.0, 0.1, 0.2, pytest.approx(0.3)]
    assert dataset.recording.reference.body == "imu"
    np.testing.assert_allclose(dataset.recording.reference.positions[:, 0], range(4))
    by_itself = open_dataset(named, DatasetSettings(calibration=calibration)).recording
    assert by_itself.motion == {"velocity"}
    assert any(
        "/odom may be ground truth: if so, give --topics reference=/NAME" in n
        for n in by_itself.notes
    )


def test_a_file_beside_the_bag_that_is_no_calibration_leaves_camera_info(tmp_path: Path) -> None:
    path = plain_script().write(tmp_path / "f")
    (path / "calibration.yaml").write_text("rate: 20\n")
    recording = open_dataset(path).recording
    assert recording.camera.baseline_m == pytest.approx(0.11, abs=1e-12)
    (note,) = [note for note in recording.notes if "CameraInfo" in note]
    assert note.startswith("the bag's CameraInfo serves, as ")
    assert "calibration.yaml: is no calibration of a known format" in note


def test_the_moving_frames_of_tf_are_ground_truth_where_they_are_named(tmp_path: Path) -> None:
    """/tf moves a base, which carries the IMU; the origin of the odometry moves, too, in the
    frame of a map.
    """
    script = plain_script()
    expected = []
    for k in range(4):
        T_odom_base = se3_exp([k, 0.5 * k, 0, 0, 0, 0.1 * k])
        expected.append(T_odom_base @ T_BASE_IMU)
        script.moving(START_NS + 50_000_000 * k, "odom", "base", T_odom_base)
        script.moving(START_NS + 50_000_000 * k, "map", "odom", se3_exp([0, 0, 7.0, 0, 0, 0]))
    path = script.write(tmp_path / "f")
    assert open_dataset(path).recording.reference is None
    truth = open_dataset(path, DatasetSettings(topics="reference=/tf")).recording.reference
    assert truth.body == "imu"
    np.testing.assert_allclose(truth.T_world_body, expected, atol=1e-12)


@pytest.mark.parametrize("storage", ["bag", "mcap"])
def test_several_bags_of_a_folder_are_joined(storage: str, tmp_path: Path) -> None:
    """Files, or the folders of ROS 2."""
    frames = list(noise_frames(6))
    names = ("a.bag", "b.bag") if storage == "bag" else ("a", "b")
    for name, part in zip(names, (frames[:3], frames[3:]), strict=True):
        script = of_stereo(Script(storage), part)
        for side in ("left", "right"):
            script.camera_info(
                f"/{side}/camera_info", part[0][0], RIG.camera, right=side == "right"
            )
        script.write(tmp_path / name)
    dataset = open_dataset(tmp_path)
    assert [event.time_ns for event in dataset.events()] == [time_ns for time_ns, _, _ in frames]
    assert f"2 bags are joined: {', '.join(names)}" in dataset.recording.notes


# --- stamps
# --------------------------------------------------------------------------------------------------


def test_messages_out_of_order_are_sorted_and_said(tmp_path: Path) -> None:
    script = plain_script()
    notes = [n for n in script.notes if n.topic == "/imu"]
    first, second = notes[6], notes[7]
    script.notes[script.notes.index(first)] = type(first)(
        first.topic, first.kind, second.logged_ns + 1, first.fields
    )
    dataset = open_dataset(script.write(tmp_path / "f"))
    times = [event.time_ns for event in dataset.events() if isinstance(event, ImuSample)]
    assert times == sorted(times)
    assert "1 messages of /imu were recorded out of order and are sorted" in dataset.recording.notes


def test_frames_logged_late_come_in_the_order_of_their_stamps(tmp_path: Path) -> None:
    """The right image of frame 1 is logged after both images of frame 2."""
    script = plain_script(imu=False)
    late = [n for n in script.notes if n.topic == "/right/image_raw"][1]
    script.notes[script.notes.index(late)] = type(late)(
        late.topic, late.kind, START_NS + 130_000_000, late.fields
    )
    frames = frames_of(open_dataset(script.write(tmp_path / "f")))
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    for frame, (_, left, right) in zip(frames, noise_frames(4), strict=True):
        np.testing.assert_array_equal(frame.left, left)
        np.testing.assert_array_equal(frame.right, right)


def test_a_right_camera_that_is_late_and_drops_frames(tmp_path: Path) -> None:
    script = plain_script(imu=False, frames=0)
    for k, (time_ns, left, right) in enumerate(noise_frames(6)):
        script.image("/left/image_raw", time_ns, left)
        if k != 2:
            script.image("/right/image_raw", time_ns + 2_000_000, right)
    recording = open_dataset(script.write(tmp_path / "f")).recording
    assert len(recording.frame_times_ns) == 5
    assert (
        "1 images of /left/image_raw and 0 of /right/image_raw have no partner and are skipped"
        in recording.notes
    )
    assert any("/left/image_raw (median +2.000 ms)" in note for note in recording.notes)


def test_images_without_stamps_take_the_times_of_logging(tmp_path: Path) -> None:
    script = plain_script(imu=False)
    for note in script.notes:
        note.fields.header.stamp.sec = note.fields.header.stamp.nanosec = 0
    dataset = open_dataset(script.write(tmp_path / "f"))
    assert [event.time_ns for event in dataset.events()] == [
        time_ns for time_ns, _, _ in noise_frames(4)
    ]
    assert any(
        "headers of /left/image_raw have no stamps" in note for note in dataset.recording.notes
    )


def test_a_truncated_image_is_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    script = plain_script(imu=False, frames=0)
    for k, (time_ns, left, right) in enumerate(noise_frames(4)):
        script.image("/left/image_raw", time_ns, left, cut=100 if k == 1 else 0)
        script.image("/right/image_raw", time_ns, right)
    frames = frames_of(open_dataset(script.write(tmp_path / "f")))
    assert [frame.index for frame in frames] == [0, 2, 3]
    assert "frame 1 is skipped" in caplog.text
    assert "the message is truncated" in caplog.text


# --- encodings
# --------------------------------------------------------------------------------------------------


class Fields:
    """An image message's fields."""

    def __init__(
        self, pixels: np.ndarray, encoding: str, *, big: bool = False, pad: int = 0
    ) -> None:
        self.height, self.width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).reshape(self.height, -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, pad)), constant_values=77)
        self.data, self.encoding = rows.reshape(-1), encoding
        self.step, self.is_bigendian = rows.shape[1], int(big)


GRAY = np.random.default_rng(0).integers(0, 256, (8, 12)).astype(np.uint8)
COLOUR = np.random.default_rng(1).integers(0, 256, (8, 12, 3)).astype(np.uint8)
ALPHA = np.dstack([COLOUR, GRAY])


def _planar(encoding: str, *, pad: int = 0) -> Fields:
    """A gray image whose rows of colour follow behind its height."""
    fields = Fields(np.vstack([GRAY, GRAY[:4]]), encoding, pad=pad)
    fields.height = len(GRAY)
    return fields


ENCODINGS = {
    "mono8": (Fields(GRAY, "mono8"), GRAY),
    "8UC1, padded rows": (Fields(GRAY, "8UC1", pad=4), GRAY),
    "bgr8": (Fields(COLOUR, "bgr8"), cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY)),
    "rgb8": (Fields(COLOUR, "rgb8"), cv2.cvtColor(COLOUR, cv2.COLOR_RGB2GRAY)),
    "bgra8": (Fields(ALPHA, "bgra8"), cv2.cvtColor(ALPHA, cv2.COLOR_BGRA2GRAY)),
    "rgba8": (Fields(ALPHA, "rgba8"), cv2.cvtColor(ALPHA, cv2.COLOR_RGBA2GRAY)),
    "8UC3": (Fields(COLOUR, "8UC3"), cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY)),
    "mono16": (Fields(GRAY.astype(np.uint16) * 257, "mono16"), GRAY.astype(np.uint16) * 257),
    "mono16, big-endian": (Fields(GRAY.astype(">u2"), "mono16", big=True), GRAY.astype(np.uint16)),
    "yuv422_yuy2": (Fields(np.dstack([GRAY, GRAY // 2]), "yuv422_yuy2"), GRAY),
    "nv12": (_planar("nv12"), GRAY),
    "nv21, padded rows": (_planar("nv21", pad=4), GRAY),
    "yuv422": (Fields(np.dstack([GRAY // 2, GRAY]), "yuv422"), GRAY),
}


@pytest.mark.parametrize("name", ENCODINGS)
def test_every_encoding_becomes_gray(name: str) -> None:
    fields, expected = ENCODINGS[name]
    np.testing.assert_array_equal(raw_gray(fields, "test"), expected)


def test_colours_are_kept_where_they_are_asked_for() -> None:
    for name, expected in (
        ("bgr8", COLOUR[..., ::-1]),
        ("rgb8", COLOUR),
        ("bgra8", COLOUR[..., ::-1]),
        ("mono8", GRAY),
    ):
        np.testing.assert_array_equal(raw_gray(ENCODINGS[name][0], "test", colour=True), expected)
    red = np.zeros((16, 16), np.uint8)
    red[::2, ::2] = 200
    shown = raw_gray(Fields(red, "bayer_rggb8"), "test", colour=True)[4:-4, 4:-4]
    np.testing.assert_allclose(shown.reshape(-1, 3).mean(axis=0), [200, 0, 0], atol=2)
    yuv = raw_gray(ENCODINGS["yuv422"][0], "test", colour=True)
    assert yuv.shape == (8, 12, 3)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_are_told_apart(pattern: str) -> None:
    """A uniformly red scene, mosaicked by hand: its gray is that of red under the right pattern
    only.
    """
    mosaic = np.zeros((16, 16), np.uint8)
    for k, letter in enumerate(pattern):
        if letter == "r":
            mosaic[k // 2 :: 2, k % 2 :: 2] = 200
    gray = raw_gray(Fields(mosaic, f"bayer_{pattern}8"), "test")[4:-4, 4:-4]
    np.testing.assert_allclose(gray, 0.299 * 200, atol=1.5)
    other = raw_gray(Fields(mosaic, f"bayer_{pattern[::-1]}8"), "test")[4:-4, 4:-4]
    assert abs(float(other.mean()) - 0.299 * 200) > 10


@pytest.mark.parametrize(
    ("level", "white"), [(900, 1023), (4000, 4095), (16000, 16383), (60000, 65535), (65520, 65535)]
)
def test_sixteen_bits_are_scaled_by_the_bits_in_use(level: float, white: int) -> None:
    assert levels_of([(0.0, level)]) == Levels(0, white)


def test_twelve_bits_in_sixteen_are_scaled_and_said(tmp_path: Path) -> None:
    script = plain_script(imu=False, frames=0)
    frames = list(noise_frames(4))
    for time_ns, left, right in frames:
        script.image("/left/image_raw", time_ns, left.astype(np.uint16) * 16, "mono16")
        script.image("/right/image_raw", time_ns, right.astype(np.uint16) * 16, "mono16")
    dataset = open_dataset(script.write(tmp_path / "f"))
    assert (
        "the images have 16 bits but use 12: the levels 0 to 4095 are scaled to 8 bits"
        in dataset.recording.notes
    )
    frame = next(iter(dataset.events()))
    np.testing.assert_allclose(frame.left, frames[0][1], atol=1)


# --- bad bags
# --------------------------------------------------------------------------------------------------


def _bad(change: Callable[[Script], object]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        script = plain_script()
        change(script)
        return script.write(folder / "f")

    return make


def _without(*topics: str) -> Callable[[Script], None]:
    def change(script: Script) -> None:
        script.notes = [note for note in script.notes if note.topic not in topics]

    return change


def _cut(storage: str, kept: float) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = plain_script(storage).write(folder / ("f.bag" if storage == "bag" else "f"))
        file = path if path.is_file() else next(path.glob(f"*.{storage}"))
        data = file.read_bytes()
        file.write_bytes(data[: int(kept * len(data))])
        return path

    return make


def _more_images(script: Script) -> None:
    for time_ns, left, right in noise_frames(4):
        script.image("/front/left/image_raw", time_ns, left)
        script.image("/front/right/image_raw", time_ns, right)


def _mixed(script: Script) -> None:
    script.image("/left/image_raw", START_NS + 999, np.zeros((48, 64), np.uint16), "mono16")


def _gyro_alone(script: Script) -> None:
    _without("/imu")(script)
    for k in range(100):
        script.imu("/imu", ImuSample(START_NS + 5_000_000 * k, np.ones(3), np.zeros(3)))


def _other_clock(script: Script) -> None:
    _without("/imu")(script)
    for k in range(100):
        script.imu(
            "/imu", ImuSample(5_000_000 * k + 1, np.zeros(3), np.array([0, 0, 9.8])), START_NS + k
        )


def _unsynchronised(script: Script) -> None:
    _without("/right/image_raw")(script)
    for time_ns, _, right in noise_frames(4):
        script.image("/right/image_raw", time_ns + 20_000_000, right)


def _uncalibrated(script: Script) -> None:
    _without("/left/camera_info")(script)
    script.camera_info("/left/camera_info", START_NS, RIG.camera, right=False)
    script.notes[-1].fields.k = np.zeros(9)


def _odd_encoding(script: Script) -> None:
    _without("/left/image_raw")(script)
    for time_ns, left, _ in noise_frames(4):
        script.image("/left/image_raw", time_ns, left, "32FC1")


def _other_size(script: Script) -> None:
    _without("/left/image_raw")(script)
    for time_ns, left, _ in noise_frames(4):
        script.image("/left/image_raw", time_ns, left[:40])


BAD = {
    "truncated ROS 1 bag": (
        _cut("bag", 0.6),
        None,
        r"f\.bag: the bag is truncated or damaged .*; copy it",
    ),
    "truncated db3": (_cut("db3", 0.5), None, "the bag is truncated or damaged"),
    "truncated mcap": (_cut("mcap", 0.6), None, "the bag is truncated or damaged"),
    "empty file": (_cut("bag", 0.0), None, "no known recording"),
    "no images": (
        _bad(_without("/left/image_raw", "/right/image_raw")),
        None,
        r"holds 0 image topics with messages \(none\); one camera needs one, stereo two",
    ),
    "one camera named as the right one": (
        _bad(_without("/right/image_raw")),
        "right=/left/image_raw",
        r"holds 1 image topics with messages \(/left/image_raw\); stereo needs two",
    ),
    "one camera of several named": (
        _bad(_more_images),
        "left=/right/image_raw",
        "no two topics are named as left and right .*; name them with --topics left=/A,right=/B",
    ),
    "one camera without CameraInfo": (
        _bad(_without("/right/image_raw", "/left/camera_info")),
        None,
        "holds no CameraInfo for /left/image_raw; give the camera's calibration with --calibration "
        "FILE",
    ),
    "one camera with an IMU without its pose": (
        _bad(_without("/right/image_raw", "/tf_static")),
        None,
        "the pose of /imu in the camera is unknown, and one camera needs its IMU; give "
        "--calibration FILE with",
    ),
    "a /tf of other frames": (
        _bad(lambda script: script.moving(START_NS, "map", "door", np.eye(4))),
        "reference=/tf",
        r"/tf: of its moving frames \(map to door\) none carries imu; name another "
        r"reference=/TOPIC",
    ),
    "two pairs": (
        _bad(_more_images),
        None,
        "several topics could be the pair .*; name them with --topics",
    ),
    "a wrong topic": (
        _bad(lambda s: None),
        "left=/nose,right=/right/image_raw",
        "holds no topic '/nose' for left",
    ),
    "a topic of another type": (
        _bad(lambda s: None),
        "imu=/left/image_raw",
        "sensor_msgs/msg/Image, not sensor_msgs",
    ),
    "a topic without a name": (
        _bad(lambda s: None),
        "left",
        "'left' is no ROLE=/TOPIC; roles are left, right, imu",
    ),
    "an empty topic": (
        _bad(lambda s: s.empty.append(("/e", "sensor_msgs/msg/Imu"))),
        "imu=/e",
        r"/e \(imu\) holds no message",
    ),
    "no CameraInfo": (
        _bad(_without("/left/camera_info")),
        None,
        "holds no CameraInfo for /left/image_raw; give",
    ),
    "CameraInfo of zeros": (
        _bad(_uncalibrated),
        None,
        r"/left/camera_info: not calibrated \(K or P is zero\)",
    ),
    "mixed encodings": (
        _bad(_mixed),
        None,
        "/left/image_raw mixes mono8, mono16; record one encoding",
    ),
    "an odd encoding": (
        _bad(_odd_encoding),
        None,
        "images of encoding '32FC1' are not read; use mono8",
    ),
    "another size": (
        _bad(_other_size),
        None,
        r"is 64 x 40 pixels but /left/camera_info is for 64 x 48",
    ),
    "an IMU without acceleration": (
        _bad(_gyro_alone),
        None,
        "/imu holds no acceleration .0 in all 100 messages.*--topics imu=/GYRO,accel=/ACCEL",
    ),
    "an IMU of another clock": (
        _bad(_other_clock),
        None,
        "no sample is within the time of the images",
    ),
    "cameras without synchronisation": (
        _bad(_unsynchronised),
        None,
        "within 3 ms; the cameras must be synchronised",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_bags_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    make, topics, message = BAD[name]
    with pytest.raises(VioError, match=message) as caught:
        list(open_dataset(make(tmp_path), DatasetSettings(topics=topics)).events())
    assert "\n" not in str(caught.value).strip()
    assert isinstance(caught.value, (DataError, CalibrationError))


def test_s3e(data_dir: Path, tmp_path: Path) -> None:
    """A real ROS 2 bag: compressed images whose right stamps are 2 ms late, ten topics without a
    message.
    """
    path = data_dir / "ros2_s3e_db3"
    with pytest.raises(
        CalibrationError, match="holds no CameraInfo for /Alpha/left_camera/compressed; give"
    ):
        open_dataset(path)
    (tmp_path / "rig.yaml").write_text(
        kalibr_text(Rig.rectified(700, 700, 400, 300, 0.36, 1224, 1024, np.eye(4)))
    )
    dataset = open_dataset(path, DatasetSettings(calibration=tmp_path / "rig.yaml"))
    recording = dataset.recording
    assert (len(recording.frame_times_ns), recording.motion) == (2, {"imu"})
    empty = next(note for note in recording.notes if note.startswith("topics without a message"))
    assert empty.count(",") == 10
    assert "not used: /Alpha/velodyne_points" in recording.notes
    assert sum(isinstance(event, ImuSample) for event in dataset.events()) > 5
