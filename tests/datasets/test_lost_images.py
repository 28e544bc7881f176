"""Cameras that number their own images, one of which lost some of them."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pytest

from tests.frontend.test_frontend_scene import CAMERA, flight, stereo_frame
from tests.guards import guarded_klt
from vio.datasets import open_dataset
from vio.datasets.image_pairs import ImageDataset
from vio.datasets.images import write_png
from vio.inspection.finding import Inspection
from vio.inspection.inspect import inspect_recording
from vio.records import Image

FRAMES = 50


@cache
def _images() -> list[tuple[Image, Image]]:
    frames = [stereo_frame(k, pose) for k, pose in enumerate(flight(FRAMES))]
    return [(f.left, f.right) for f in frames if f.left is not None and f.right is not None]


def _numbered(folder: Path, lost: tuple[Iterable[int], Iterable[int]]) -> Path:
    """Write the images as cameras number them that lose some."""
    for side, missing in enumerate(lost):
        out = folder / ("left", "right")[side]
        out.mkdir(parents=True)
        kept = [images[side] for k, images in enumerate(_images()) if k not in set(missing)]
        for number, image in enumerate(kept):
            write_png(out / f"{number:06d}.png", image)
    K = f"{CAMERA.fu} 0 {CAMERA.cu} {{}} 0 {CAMERA.fv} {CAMERA.cv} 0 0 0 1 0"
    bf = -CAMERA.fu * CAMERA.baseline_m
    (folder / "calib.txt").write_text(f"P0: {K.format(0)}\nP1: {K.format(bf)}\n")
    return folder


def _read(folder: Path) -> tuple[ImageDataset, list[tuple[int, int]]]:
    """Return a recording, and which images of the whole flight each of its pairs are."""
    dataset = open_dataset(folder)
    assert isinstance(dataset, ImageDataset)
    shown = [{images[side].tobytes(): k for k, images in enumerate(_images())} for side in (0, 1)]
    rows = []
    for frame in dataset.frames(range(len(dataset.pairs))):
        assert frame.left is not None
        assert frame.right is not None
        rows.append((shown[0][frame.left.tobytes()], shown[1][frame.right.tobytes()]))
    return dataset, rows


@pytest.mark.parametrize(
    ("lost", "least"),
    [
        (((), (25,)), 47),
        (((31,), ()), 46),
        (((), (12, 13)), 44),
        (((), (10, 35)), 44),
        (((), range(5)), 45),
        ((range(2), (40,)), 40),
    ],
)
def test_images_are_paired_by_their_rows_where_one_camera_lost_some(
    lost: tuple[Iterable[int], Iterable[int]], least: int, tmp_path: Path
) -> None:
    dataset, rows = _read(_numbered(tmp_path, lost))
    assert [row for row in rows if row[0] != row[1]] == []
    assert len(rows) >= least
    (note,) = [n for n in dataset.recording.notes if "numbered without a hole" in n]
    assert "give both images of a pair one number" in note


def test_a_camera_that_stopped_earlier_lost_nothing(tmp_path: Path) -> None:
    dataset, rows = _read(_numbered(tmp_path, ((), range(FRAMES - 3, FRAMES))))
    assert rows == [(k, k) for k in range(FRAMES - 3)]
    assert not any("numbered without" in note for note in dataset.recording.notes)


@pytest.mark.parametrize("name", ["times.txt", "data.csv"])
@pytest.mark.parametrize("lost", [((30,), (12,)), ((), range(5))])
def test_images_are_paired_by_the_lists_of_both_cameras(
    lost: tuple[Iterable[int], Iterable[int]], name: str, tmp_path: Path
) -> None:
    """Numbers pair images of other times, even where each camera has as many."""
    folder = _numbered(tmp_path, lost)
    for side, missing in enumerate(lost):
        images = folder / ("left", "right")[side]
        stamps = [10**18 + 50_000_000 * k for k in range(FRAMES) if k not in set(missing)]
        if name == "times.txt":
            (images / name).write_text("".join(f"{stamp}\n" for stamp in stamps))
            continue
        listed = [f"{stamp},{number:06d}.png" for number, stamp in enumerate(stamps)]
        (folder / f"cam{side}").mkdir()
        images.rename(folder / f"cam{side}" / "data")
        (folder / f"cam{side}" / name).write_text("\n".join(["#timestamp [ns],filename", *listed]))
    dataset, rows = _read(folder)
    kept = [k for k in range(FRAMES) if k not in {*lost[0], *lost[1]}]
    assert rows == [(k, k) for k in kept]
    assert (dataset.recording.frame_times_ns - 10**18).tolist() == [50_000_000 * k for k in kept]
    assert not any("not used" in note for note in dataset.recording.notes)


def _inspected(folder: Path) -> Inspection:
    dataset = open_dataset(folder)
    return inspect_recording(dataset, lambda _: guarded_klt(CAMERA), pairs=2, tracked=2)


def test_inspect_names_images_that_both_cameras_lost(tmp_path: Path) -> None:
    """There are as many of both, and pairs are a frame apart in between."""
    (fault,) = _inspected(_numbered(tmp_path, ((38,), (12,)))).faults
    assert "each right image comes a frame" in fault or "each left image comes a frame" in fault
    assert "a camera has lost images" in fault


def test_inspect_passes_over_an_image_that_cannot_be_read(tmp_path: Path) -> None:
    folder = _numbered(tmp_path, ((), ()))
    (folder / "right" / "000000.png").write_bytes(b"nothing")
    assert _inspected(folder).faults == ()
