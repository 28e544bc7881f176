"""Layouts of public data sets and of other programs' exports, and what is given in the place of a
recording.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import vio
from tests.plain_maker import STEP_S, make_plain
from vio.datasets import open_dataset
from vio.datasets.image_pairs import ImageDataset
from vio.datasets.plain import pair_layout
from vio.datasets.sides import first_pair, pairs_of, stamped_sides
from vio.errors import CalibrationError, DataError
from vio.records import StereoFrame

FIRST_NS = 1700000000_000000000


def paired_names(dataset: object) -> list[tuple[str, str]]:
    """Return the names of the images of each pair."""
    assert isinstance(dataset, ImageDataset)
    return [(left.name, right.name) for left, right in dataset.pairs]


def in_one_folder(
    path: Path, folder: str, name: Callable[[int, int], str], frames: int = 5
) -> Path:
    """Write a plain recording whose images all lie in one folder."""
    make_plain(path, frames, name=name, times=False, imu=False, reference=False)
    (path / folder).mkdir(parents=True)
    for side in ("left", "right"):
        for image in (path / side).iterdir():
            image.rename(path / folder / image.name)
        (path / side).rmdir()
    return path


@pytest.mark.parametrize(
    ("folder", "left", "right"),
    [
        ("images", "infra1_{k:04d}.png", "infra2_{k:04d}.png"),
        ("images", "{k:04d}_cam1.png", "{k:04d}_cam2.png"),
        ("render", "{k:04d}_L.png", "{k:04d}_R.png"),
    ],
)
def test_pairs_in_one_folder_are_found_by_their_names(
    folder: str, left: str, right: str, tmp_path: Path
) -> None:
    path = in_one_folder(tmp_path, folder, lambda side, k: (left, right)[side].format(k=k))
    dataset = open_dataset(path)
    assert dataset.recording.kind == "plain"
    assert paired_names(dataset) == [(left.format(k=k), right.format(k=k)) for k in range(5)]


def stamped(side: int, k: int, apart_ns: int) -> str:
    """Return the name of an image as a simulator gives it: vehicle, camera, kind, time."""
    words = ("left", "right")[side]
    return f"img_Drone_front_{words}_0_{FIRST_NS + k * 50_000_000 + side * apart_ns}.png"


def test_pairs_in_one_folder_may_have_times_of_their_own(tmp_path: Path) -> None:
    path = in_one_folder(tmp_path, "images", lambda side, k: stamped(side, k, 2_000_000))
    dataset = open_dataset(path)
    assert dataset.recording.kind == "plain"
    expected = [tuple(stamped(side, k, 2_000_000) for side in (0, 1)) for k in range(5)]
    assert paired_names(dataset) == expected
    assert (np.diff(dataset.recording.frame_times_ns) == 50_000_000).all()


def test_images_of_two_cameras_that_fit_in_no_pairs_are_not_those_of_one(tmp_path: Path) -> None:
    path = in_one_folder(tmp_path, "images", lambda side, k: stamped(side, k, 20_000_000))
    with pytest.raises(DataError, match=r"20 ms apart \(right from left, median\)"):
        open_dataset(path)


def test_turns_to_both_sides_are_those_of_one_camera(tmp_path: Path) -> None:
    names = [
        f"turn_{word}_{FIRST_NS + k * 50_000_000}"
        for k, word in enumerate(["left"] * 4 + ["right"] * 4)
    ]
    assert stamped_sides(names) is None
    assert stamped_sides([]) is None

    both = [stamped(side, k, 20_000_000) for side in (0, 1) for k in range(4)]
    assert stamped_sides(both) == (both[:4], both[4:])


def test_a_number_in_the_word_of_a_side_is_no_frame(tmp_path: Path) -> None:
    names = ("town_000000_{k:06d}_leftImg8bit.png", "town_000000_{k:06d}_rightImg8bit.png")
    make_plain(
        tmp_path, 4, folders=("leftImg8bit", "rightImg8bit"),
        name=lambda side, k: names[side].format(k=k), imu=False,
    )  # fmt: skip
    (tmp_path / "rightImg8bit" / names[1].format(k=2)).unlink()
    dataset = open_dataset(tmp_path)
    kept = [tuple(name.format(k=k) for name in names) for k in (0, 1, 3)]
    assert paired_names(dataset) == kept


def with_list(path: Path, name: str, rows: int) -> Path:
    """Write a plain recording whose list of times, in microseconds, has another name."""
    make_plain(path, 4, times=False, imu=False)
    file = path / name
    file.write_text("".join(f"{FIRST_NS // 1000 + 50_000 * k}.000\n" for k in range(rows)))
    return path


@pytest.mark.parametrize("name", ["left/image_timestamps_left.txt", "image_times.txt"])
def test_a_list_of_times_may_have_another_name(name: str, tmp_path: Path) -> None:
    recording = open_dataset(with_list(tmp_path, name, 4)).recording
    expected = FIRST_NS + (np.arange(4) * STEP_S * 1e9).astype(np.int64)
    np.testing.assert_array_equal(recording.frame_times_ns, expected)
    assert any(f"{tmp_path / name}: taken for the times" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("image_times.txt", 3),
        ("imu_timestamps.txt", 4),
        ("right/timestamps_right.txt", 4),
        ("exposures.txt", 4),
        ("exposure_times.txt", 4),
        ("wheel_timestamps.csv", 4),
        ("ground_truth_times.txt", 4),
    ],
)
def test_other_lists_are_not_taken_for_times(name: str, rows: int, tmp_path: Path) -> None:
    recording = open_dataset(with_list(tmp_path, name, rows)).recording
    assert int(recording.frame_times_ns[1]) == 100_000_000
    assert any("no times.txt" in note for note in recording.notes)


@pytest.mark.parametrize(
    "names", [("cam0_times.txt", "cam1_times.txt"), ("times_l.csv", "times_r.csv")]
)
def test_of_lists_of_both_cameras_the_left_ones_counts(
    names: tuple[str, str], tmp_path: Path
) -> None:
    path = with_list(tmp_path, names[0], 4)
    times = [float(line) + 400 for line in (path / names[0]).read_text().split()]
    (path / names[1]).write_text("".join(f"{time:.3f}\n" for time in times))
    assert int(open_dataset(path).recording.frame_times_ns[0]) == FIRST_NS


def test_lists_that_differ_are_not_taken_for_times(tmp_path: Path) -> None:
    path = with_list(tmp_path, "image_times.txt", 4)
    (path / "sync_times.txt").write_text("".join(f"{0.1 * k + 5}\n" for k in range(4)))
    assert int(open_dataset(path).recording.frame_times_ns[0]) == 0


@pytest.mark.parametrize("name", ["f.csv", "f.txt", "f.json", "f.pkl", "f.npy"])
def test_features_of_another_form_are_told_how_to_become_a_recording(
    name: str, tmp_path: Path
) -> None:
    rows = np.arange(12.0).reshape(2, 6)
    file = tmp_path / name
    if name.endswith(".npy"):
        np.save(file, rows)
    else:
        file.write_text("frame,id,ul,vl,ur,vr\n0,1,2,3,4,5\n")
    with pytest.raises(DataError, match=rf"{name}: .* one by vio\.write_observations"):
        open_dataset(file)


def test_a_folder_of_images_of_any_name_is_named(tmp_path: Path) -> None:
    make_plain(tmp_path, 3, imu=False)
    (tmp_path / "left").rename(tmp_path / "results")
    shutil.rmtree(tmp_path / "right")
    with pytest.raises(DataError, match=r"holds images in results, .* into left and right"):
        open_dataset(tmp_path)


@pytest.mark.parametrize("source", [None, ["a", "b"], b"a", 3])
def test_a_source_is_one_path(source: object) -> None:
    with pytest.raises(DataError, match=r"named by one path, as text or pathlib\.Path, not by"):
        open_dataset(source)  # type: ignore[arg-type] # what is refused


@pytest.mark.parametrize(
    ("centre", "size", "said"),
    [
        ((180.0, 600.0), (1200, 370), "are exchanged"),
        ((600.0, 180.0), (370, 1200), "are exchanged"),
        ((600.0, 180.0), (1200, 370), None),
        ((-20.0, 180.0), (1200, 370), None),  # as of a part that was cut out of an image
        ((640.0, 360.0), (600, 720), None),  # as of the left side of one
        ((500.0, 200.0), (480, 640), None),
        ((200.0, 260.0), (640, 240), None),
    ],
)
def test_a_principal_point_of_exchanged_numbers_is_refused(
    centre: tuple[float, float], size: tuple[int, int], said: str | None
) -> None:
    K = np.array([[700.0, 0, centre[0]], [0, 700.0, centre[1]], [0, 0, 1]])
    T_cam1_cam0 = np.eye(4)
    T_cam1_cam0[0, 3] = -0.5
    makers = (
        lambda: vio.Rig.rectified(700.0, 700.0, *centre, 0.5, *size),
        lambda: vio.Rig.raw(K, K, T_cam1_cam0, *size),
    )
    for make in makers:
        if said is None:
            assert (make().cam0.cu, make().cam0.cv) == centre
        else:
            with pytest.raises(CalibrationError, match=said):
                make()


def test_a_rendered_drive_has_its_views_beside_depths_and_its_truth(tmp_path: Path) -> None:
    """As Virtual KITTI 2: frames/rgb/Camera_0 beside frames/depth/Camera_0, 4 by 4 to the cameras."""
    folders = ("frames/rgb/Camera_0", "frames/rgb/Camera_1")
    make_plain(tmp_path, 3, folders=folders, calibration=False, imu=False, reference=False)
    for kind in ("depth", "classSegmentation"):
        shutil.copytree(tmp_path / "frames" / "rgb", tmp_path / "frames" / kind)
    lenses = ["frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"]
    poses = ["frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1"]
    for frame in range(3):
        for camera in range(2):
            lenses.append(f"{frame} {camera} 60 60 32 24")
            shift = -2.0 * frame  # of the world, as the camera drives forward
            poses.append(f"{frame} {camera} 1 0 0 {-0.5 * camera} 0 1 0 0 0 0 1 {shift} 0 0 0 1")
    (tmp_path / "intrinsic.txt").write_text("\n".join(lenses) + "\n")
    (tmp_path / "extrinsic.txt").write_text("\n".join(poses) + "\n")
    recording = open_dataset(tmp_path).recording
    assert recording.camera.baseline_m == pytest.approx(0.5)
    assert recording.reference is not None
    np.testing.assert_allclose(recording.reference.positions, [[0, 0, 0], [0, 0, 2], [0, 0, 4]])
    assert not any("extrinsic" in note for note in recording.notes)
    last = len(poses) - 2
    (tmp_path / "extrinsic.txt").write_text("\n".join(poses[:last]) + "\n")
    assert len(open_dataset(tmp_path).recording.reference or ()) == 2


def test_numbered_parts_of_one_camera_are_no_pair(tmp_path: Path) -> None:
    """Folders 000, 001 and 002: the first two had been taken for the left and the right camera."""
    for part in range(3):
        folders = (f"left/{part:03d}", f"right/{part:03d}")
        make_plain(tmp_path, 2, folders=folders, imu=False, reference=False)
    for path in (tmp_path, tmp_path / "left"):
        with pytest.raises(DataError, match="not clear which is the left and which the right"):
            open_dataset(path)
    assert first_pair(pairs_of(["000", "001"])) == ("000", "001")
    assert first_pair(pairs_of(["cam0", "cam1", "cam2"])) == ("cam0", "cam1")


@pytest.mark.parametrize(("image", "inside"), [("frame", "results"), ("left", "")])
def test_depth_images_may_lie_beside_the_images(image: str, inside: str, tmp_path: Path) -> None:
    """As Replica's results/frame000000.jpg and depth000000.png with cam_params.json above, and a
    ZED's export of left images and depths.
    """
    scene = tmp_path / "room0"
    folder = scene / inside
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    gray = rng.integers(0, 255, (4, 48, 64), dtype=np.uint8)
    for k in range(4):
        assert cv2.imwrite(str(folder / f"{image}{k:06d}.jpg"), gray[k])
        depth = np.full((48, 64), 6553 * (k + 1), dtype=np.uint16)
        assert cv2.imwrite(str(folder / f"depth{k:06d}.png"), depth)
    camera = {"w": 64, "h": 48, "fx": 60.0, "fy": 61.0, "cx": 31.5, "cy": 23.5, "scale": 6553.0}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    poses = [f"1 0 0 {k} 0 1 0 0 0 0 1 0 0 0 0 1" for k in range(4)]
    (scene / "traj.txt").write_text("\n".join(poses) + "\n")
    dataset = open_dataset(scene)
    assert dataset.recording.kind == "rgbd"
    assert dataset.recording.camera.fu == 60.0
    assert dataset.recording.reference is not None
    np.testing.assert_allclose(dataset.recording.reference.positions[:, 0], range(4))
    frames = [event for event in dataset.events() if isinstance(event, StereoFrame)]
    medians = [float(np.median(frame.depth)) for frame in frames if frame.depth is not None]
    np.testing.assert_allclose(medians, [1.0, 2.0, 3.0, 4.0])
    assert cv2.imwrite(str(folder / "right000000.jpg"), gray[0])
    with pytest.raises(DataError):
        open_dataset(scene)


def test_a_folder_with_kittis_names_may_have_a_calibration_by_hand(tmp_path: Path) -> None:
    folders = ("image_0", "image_1")
    make_plain(tmp_path, 3, folders=folders, calibration=False, imu=False, times=False)
    (tmp_path / "calib.txt").write_text("fx: 60\ncx: 32\ncy: 24\nbaseline: 0.2\n")
    recording = open_dataset(tmp_path).recording
    assert recording.kind == "plain"
    assert (recording.camera.fu, recording.camera.baseline_m) == (60.0, pytest.approx(0.2))
    (tmp_path / "calib.txt").write_text("fx: 60\ncx: 32\ncy: 24\n")
    with pytest.raises(CalibrationError, match=r"lines begin with 'P\d:'"):
        open_dataset(tmp_path)


@pytest.mark.parametrize(
    "others",
    [
        ("normal/left", "normal/right"),  # of an exposure
        ("depth/infra_left", "depth/infra_right"),  # of a depth camera's module
        ("seg_1/left", "seg_1/right"),  # of a recording
    ],
)
def test_views_are_not_left_out_by_their_names(tmp_path: Path, others: tuple[str, str]) -> None:
    """Of two pairs, neither is taken without a word."""
    for folders in (others, ("dark/left", "dark/right")):
        make_plain(tmp_path, 1, folders=folders, calibration=False, imu=False, reference=False)
    assert pair_layout(tmp_path) is None


@pytest.mark.parametrize("held", [b"\xff\xfe\x00", b"", b"1 0 0 0\n0 1 0 0\n0 0 1 0\n"])
def test_an_extrinsic_txt_of_another_kind_is_not_used(tmp_path: Path, held: bytes) -> None:
    make_plain(tmp_path, 2, reference=False)
    (tmp_path / "extrinsic.txt").write_bytes(held)
    recording = open_dataset(tmp_path).recording
    assert recording.reference is None
    assert "not used: extrinsic.txt" in recording.notes
