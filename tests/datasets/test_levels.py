"""Black and white of 16-bit images, and raw mosaics, by one rule on every path of reading."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.plain_maker import make_plain
from vio.datasets import image_pairs, open_dataset
from vio.datasets.bags.pictures import band_of_message, gray_of
from vio.datasets.images import levels_in, load_gray
from vio.datasets.levels import FULL_SCALE, Levels, band_of, is_mosaic, levels_of, to_8_bits
from vio.datasets.plain import image_folders
from vio.geometry.lie import FloatArray
from vio.records import StereoFrame

RNG = np.random.default_rng(5)


def _scene(height: int = 60, width: int = 80) -> FloatArray:
    """A smooth scene (H, W) from 0 to 1."""
    scene = cv2.GaussianBlur(RNG.random((height, width)), (0, 0), 3)
    return (scene - scene.min()) / (scene.max() - scene.min())


THERMAL = np.rint(29400 + 1275 * _scene()).astype(np.uint16)
TWELVE_BITS = np.rint(4000 * _scene()).astype(np.uint16)


class _Message:
    """A sensor_msgs/CompressedImage."""

    format = "png"  # tells zstd apart; decoders look at the data

    def __init__(self, data: bytes) -> None:
        self.data = data


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".pgm"])
@pytest.mark.parametrize(("pixels", "least"), [(THERMAL, 100), (TWELVE_BITS, 200)])
def test_files_and_compressed_messages_have_one_contrast(
    pixels: np.ndarray, least: int, suffix: str, tmp_path: Path
) -> None:
    path = tmp_path / f"a{suffix}"
    assert cv2.imwrite(str(path), pixels)
    levels = levels_in([path])
    assert levels == levels_of([band_of(pixels)])
    gray = load_gray(path, levels)[0]
    assert np.ptp(gray) > least, "not five gray levels, and not black"
    message = _Message(path.read_bytes())
    band = band_of_message(message, "t", compressed=True)
    assert band is not None
    again = gray_of(message, "t", compressed=True, levels=levels_of([band]))
    np.testing.assert_array_equal(again, gray)


def test_thermal_folder_has_contrast_in_every_frame_and_says_so(tmp_path: Path) -> None:
    make_plain(tmp_path, frames=3, imu=False)
    for k, offset in enumerate((0, 100, 200)):
        for side in ("left", "right"):
            file = tmp_path / side / f"{k}.png"
            size = load_gray(file)[0].shape
            scene = cv2.resize(THERMAL, size[::-1]) + offset
            assert cv2.imwrite(str(file), scene.astype(np.uint16))
    dataset = open_dataset(tmp_path)
    assert any("as of a thermal camera: the levels" in note for note in dataset.recording.notes)
    frames = [event for event in dataset.events() if isinstance(event, StereoFrame)]
    means = [float(frame.left.mean()) for frame in frames if frame.left is not None]
    assert means[0] < means[1] < means[2], "one pair of levels serves all frames"
    assert all(np.ptp(frame.left) > 60 for frame in frames if frame.left is not None)


def test_levels_of_usual_cameras_keep_black_at_zero() -> None:
    assert levels_of([]) == FULL_SCALE
    assert levels_of([(64.0, 1000.0)]) == Levels(0, 1023), "a sensor's black level"
    assert levels_of([(20.0, 4000.0), (100.0, 150.0)]) == Levels(0, 4095), "one flat frame"
    image = np.array([[0, 100, 4095]], dtype=np.uint16)
    np.testing.assert_array_equal(to_8_bits(image, Levels(0, 4095)), [[0, 6, 255]])


def test_dead_pixels_and_borders_do_not_hide_a_thermal_band() -> None:
    pixels = THERMAL.copy()
    pixels[:5] = 0
    assert levels_of([band_of(pixels)]).black > 25000


def _mosaic(gains: tuple[float, float, float]) -> np.ndarray:
    """A coloured scene as a sensor of pattern RGGB records it."""
    colours = 40 + 200 * np.stack([_scene(), _scene(), _scene()], axis=-1)
    out = np.zeros(colours.shape[:2])
    for (row, column), channel in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
        part = colours[row::2, column::2, channel]
        out[row::2, column::2] = gains[channel] * part
    return np.rint(out).astype(np.uint8)


def test_raw_mosaic_is_told_from_gray_images() -> None:
    assert is_mosaic(_mosaic((0.6, 1.0, 0.5)))
    assert is_mosaic(_mosaic((1.0, 1.0, 1.0)))
    assert not is_mosaic(RNG.integers(0, 256, (60, 80)).astype(np.uint8)), "white noise"
    assert not is_mosaic(np.rint(255 * _scene()).astype(np.uint8))
    assert not is_mosaic(np.full((60, 80), 7, dtype=np.uint8))
    stripes = np.tile([0, 255], (60, 40)).astype(np.uint8)
    assert not is_mosaic(stripes), "along one axis only"


def test_folder_of_raw_mosaics_is_doubted(tmp_path: Path) -> None:
    make_plain(tmp_path, frames=2, imu=False)
    for side in ("left", "right"):
        for k in range(2):
            file = tmp_path / side / f"{k}.png"
            size = load_gray(file)[0].shape
            assert cv2.imwrite(str(file), _mosaic((0.6, 1.0, 0.5))[: size[0], : size[1]])
    notes = open_dataset(tmp_path).recording.notes
    assert sum("as in raw images of a colour camera (Bayer)" in note for note in notes) == 1


def test_real_gray_images_are_no_mosaics(data_dir: Path) -> None:
    folders = ("kitti_03_head/image_0", "euroc/MH_01_head/mav0/cam0/data", "boofcv_library/left")
    for name in (*folders, "tumvi_room1_head/cam0/images"):
        path = sorted((data_dir / name).iterdir())[0]
        assert not is_mosaic(load_gray(path)[0]), name


@pytest.mark.parametrize(("frames", "looked_at"), [(3, 3), (100, 8)])
def test_levels_are_those_of_eight_frames_over_the_recording(
    frames: int, looked_at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Decoding more of a long recording would take minutes before its first pose."""
    seen = list[Path]()
    monkeypatch.setattr(image_pairs, "levels_in", lambda paths: (seen.extend(paths), FULL_SCALE)[1])
    monkeypatch.setattr(image_pairs, "_mosaic_notes", lambda pairs: ())
    monkeypatch.setattr(image_pairs, "_turn_notes", lambda pairs: ())
    pairs = [(tmp_path / f"left{k}.png", tmp_path / f"right{k}.png") for k in range(frames)]
    image_pairs.gray_levels(pairs)
    assert len(seen) == 2 * looked_at
    assert seen[:2] == list(pairs[0])
    assert seen[-2:] == list(pairs[-1])


@pytest.mark.parametrize(("others", "found"), [(190, 1), (210, 0)])
def test_a_tree_of_many_folders_is_not_searched_for_images_for_ever(
    others: int, found: int, tmp_path: Path
) -> None:
    for k in range(others):
        (tmp_path / f"a{k:03}").mkdir()
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.png").touch()
    assert len(image_folders(tmp_path)) == found


@pytest.mark.parametrize(("depth", "found"), [(3, 1), (4, 0)])
def test_images_lie_a_few_levels_deep(depth: int, found: int, tmp_path: Path) -> None:
    folder = tmp_path.joinpath(*"abcd"[:depth])
    folder.mkdir(parents=True)
    (folder / "0.png").touch()
    assert len(image_folders(tmp_path)) == found
