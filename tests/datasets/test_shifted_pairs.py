"""Pairs by numbers that the two cameras count apart, and lists of times for all images of a camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.plain_maker import make_plain
from vio.datasets import open_dataset
from vio.records import doubts_among


def _doubts(folder: Path) -> tuple[str, ...]:
    return doubts_among(open_dataset(folder).recording.notes)


def _without(folder: Path, side: str, numbers: list[int]) -> Path:
    for k in numbers:
        (folder / side / f"{k}.png").unlink()
    return folder


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (lambda side, k: f"{k + side}.png", "first 1 left and the last 1 right ones"),
        (lambda side, k: f"{k + 10 - 2 * side}.png", "first 2 right and the last 2 left ones"),
    ],
)
def test_pairs_of_numbers_counted_from_different_ones_are_doubted(
    name: Callable[[int, int], str], said: str, tmp_path: Path
) -> None:
    folder = make_plain(tmp_path, 6, name=name, times=False, imu=False, reference=False)
    (doubt,) = _doubts(folder)
    assert said in doubt
    assert "give them one number" in doubt


def test_pairs_without_a_shift_are_not_doubted(tmp_path: Path) -> None:
    made = lambda name: make_plain(tmp_path / name, 6, times=False, imu=False, reference=False)  # noqa: E731
    assert _doubts(made("all")) == ()
    assert _doubts(_without(made("right begins late"), "right", [0])) == ()
    assert _doubts(_without(made("holes"), "right", [2, 3])) == ()
    folder = _without(made("both"), "right", [0])
    assert _doubts(_without(folder, "left", [3])) == ()


def test_pairs_of_times_are_not_doubted(tmp_path: Path) -> None:
    name = lambda side, k: f"{1700000000_000000000 + 50_000_000 * (k + side)}.png"  # noqa: E731
    folder = make_plain(tmp_path, 6, name=name, times=False, imu=False, reference=False)
    assert _doubts(folder) == ()


@pytest.mark.parametrize(("side", "lost"), [("right", [0]), ("right", [2, 4]), ("left", [0, 5])])
def test_times_of_all_images_of_a_camera_serve_those_with_a_partner(
    side: str, lost: list[int], tmp_path: Path
) -> None:
    """They were 'n times for n - 1 image pairs'."""
    times = open_dataset(make_plain(tmp_path / "whole", 6)).recording.frame_times_ns.tolist()
    folder = _without(make_plain(tmp_path / "lost", 6), side, lost)
    found = open_dataset(folder).recording.frame_times_ns.tolist()
    assert found == [t for k, t in enumerate(times) if k not in lost]


def test_a_table_of_an_imu_by_another_name_is_named(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    (folder / "imu.csv").rename(folder / "imuData.csv")
    (folder / "imu_notes.txt").write_text("mounted below the left camera\n")
    notes = open_dataset(folder).recording.notes
    (note,) = [n for n in notes if "name it imu.csv" in n]
    assert "imuData.csv" in note
