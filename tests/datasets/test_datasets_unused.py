"""What lies in a recording's folder and is not read is named once, whatever the kind of the
recording.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.dataset_makers import make_images, make_kitti
from tests.euroc_maker import make_euroc, make_kitti_raw
from vio.datasets import open_dataset


def notes_of(folder: Path, kind: str) -> list[str]:
    recording = open_dataset(folder).recording
    assert recording.kind == kind
    return [note for note in recording.notes if "not used" in note or "not listed" in note]


@pytest.mark.parametrize("relative", [False, True])
def test_kitti_names_what_it_does_not_read(
    relative: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = make_kitti(tmp_path / "kitti")
    assert notes_of(folder, "kitti") == []
    make_images(folder / "image_2", 1)
    (folder / "velodyne").mkdir()
    (folder / "gps.csv").write_text("0,1\n")
    (folder / "README.txt").write_text("no data\n")
    monkeypatch.chdir(tmp_path)
    expected = ["not used: gps.csv, image_2/, velodyne/"]
    assert notes_of(Path("kitti") if relative else folder, "kitti") == expected


def test_kitti_raw_names_the_inertial_record_that_it_does_not_read(tmp_path: Path) -> None:
    folder = make_kitti_raw(tmp_path / "drive_sync")
    assert notes_of(folder, "kitti_raw") == []
    (folder / "oxts" / "data").mkdir(parents=True)
    (folder / "velodyne_points").mkdir()
    (folder / "image_00" / "exposure.txt").write_text("1\n")
    assert notes_of(folder, "kitti_raw") == [
        "not used: oxts/, velodyne_points/, image_00/exposure.txt"
    ]


def test_euroc_names_other_sensors_and_counts_images_that_no_list_names(tmp_path: Path) -> None:
    folder = make_euroc(tmp_path / "flight")
    assert notes_of(folder, "euroc") == []
    mav = folder / "mav0"
    (mav / "leica0").mkdir()
    (mav / "cam0" / "exposure.csv").write_text("0,1\n")
    image = next((mav / "cam1" / "data").iterdir())
    shutil.copy(image, image.with_name("9" * 19 + image.suffix))
    assert notes_of(folder, "euroc") == [
        "0 images of cam0 and 1 of cam1 are not listed in their data.csv and are skipped",
        "not used: mav0/leica0/, mav0/cam0/exposure.csv",
    ]
