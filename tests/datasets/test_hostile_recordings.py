"""Recordings of damaged or hostile files, over all readers: each is an error in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.dataset_makers import (
    ece276a_arrays,
    make_drive,
    make_kitti,
    make_mat,
    make_npz,
    utias_arrays,
)
from tests.files.test_hostile_files import add_bomb, png_stating
from tests.plain_maker import make_plain
from vio.datasets import open_dataset
from vio.errors import VioError
from vio.records import StereoFrame


def _kitti(change: Callable[[Path], object]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        change(make_kitti(folder))
        return folder

    return make


def _images(data: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for path in sorted((folder / "image_0").iterdir()):
            path.write_bytes(data(path.read_bytes()))

    return change


def _npz(**changes: np.ndarray) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        folder.mkdir(parents=True)
        return make_npz(folder / "a.npz", ece276a_arrays(make_drive(6)) | changes)

    return make


def _bomb(folder: Path) -> Path:
    folder.mkdir(parents=True)
    arrays = ece276a_arrays(make_drive(6))
    del arrays["features"]
    add_bomb(path := make_npz(folder / "a.npz", arrays), "features", 3.9)
    return path


def _cut(make: Callable[[Path], Path]) -> Callable[[Path], Path]:
    def cut(folder: Path) -> Path:
        path = make(folder)
        path.write_bytes(path.read_bytes()[:-200])
        return path

    return cut


def _mat(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return make_mat(folder / "a.mat", utias_arrays(make_drive(6)))


def _empty(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


def _text(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "a.csv").write_text("1,2,3\n")
    return folder / "a.csv"


BAD = {
    "an empty folder": (_empty, "is empty; give a ROS bag"),
    "a file of another kind": (_text, r"a\.csv: no known recording"),
    "pickled arrays": (
        _npz(features=np.array([{}], dtype=object)),
        r"a\.npz: holds pickled objects .*save it again as plain numeric arrays",
    ),
    "an array of gigabytes in kilobytes": (
        _bomb,
        r"a\.npz: is damaged \(features\.npy states the shape",
    ),
    "a truncated npz": (_cut(_npz()), r"a\.npz: is damaged"),
    "a truncated mat": (_cut(_mat), r"cannot read .*a\.mat: could not read bytes; copy it again"),
    "images that state 2^31 pixels a side": (
        _kitti(_images(lambda _: png_stating(2**31 - 1, 2**31 - 1))),
        "its header states 2147483647 x 2147483647 pixels, more than 64 Mpx",
    ),
    "truncated images": (_kitti(_images(lambda data: data[:-20])), "the PNG is truncated"),
    "images with a wrong checksum": (
        _kitti(_images(lambda data: data[:-20] + bytes([data[-20] ^ 1]) + data[-19:])),
        "the PNG is damaged",
    ),
    "empty images": (_kitti(_images(lambda _: b"")), "the file is empty"),
    "images that are text": (_kitti(_images(lambda _: b"hello " * 99)), "neither PNG nor JPEG"),
    "times that are no text": (
        _kitti(lambda f: (f / "times.txt").write_bytes(b"\xc3\x280\n")),
        r"times\.txt.*(not a text|no text|UTF-8|decode)",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_hostile_recordings_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    make, message = BAD[name]
    with pytest.raises(VioError, match=message) as caught:
        list(open_dataset(make(tmp_path / "r")).events())
    assert "\n" not in str(caught.value).strip()


def test_names_of_any_alphabet_are_read(tmp_path: Path) -> None:
    folder = make_plain(tmp_path / "Fahrt über 東京, 2")
    assert folder.parent == tmp_path
    assert sum(isinstance(event, StereoFrame) for event in open_dataset(folder).events()) == 4
