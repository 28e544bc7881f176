"""Guidance while a board is recorded: what is missing, and when it is enough."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.board_views import GRID, LEFT, T_RIGHT_LEFT, made_views
from vio.cameras.rig import Rig
from vio.cli import main
from vio.geometry.distortion import project_point
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp, transform_points
from vio.records import Image, ImuSample
from vio.sources.board import film_board
from vio.sources.source import SourceEvent, SourceFrame
from vio.targets import guidance
from vio.targets.corners import NO_CORNERS, Corners
from vio.targets.description import Target, target_text
from vio.targets.guidance import Guidance
from vio.targets.recording import open_raw
from vio.targets.rendering import board_points

STEP_NS = 50_000_000
_RIGHT_IMAGES = 100  # numbers of images of the right camera begin there


@dataclass
class NumberedCorners:
    """Stands in for the detector: an image is filled with the number of its corners."""

    known: dict[int, Corners]

    def __call__(self, target: Target) -> NumberedCorners:
        return self

    def detect(self, image: Image) -> Corners:
        return self.known.get(int(image[0, 0]), NO_CORNERS)


@dataclass
class FakeSource:
    """Frames and samples as a device would give them."""

    frames: list[SourceFrame]
    has_imu: bool = False
    rig: Rig | None = None
    image_size: tuple[int, int] | None = None
    given: int = 0
    closed: bool = False
    pause_s: float = 0.0  # between frames

    def events(self) -> Iterator[SourceEvent | None]:
        rng = np.random.default_rng(0)
        for frame in self.frames:
            self.given += 1
            yield frame
            yield None
            time.sleep(self.pause_s)
            if self.has_imu:
                for k in range(10):
                    time_ns = frame.time_ns + k * STEP_NS // 10
                    yield ImuSample(time_ns, rng.normal(size=3), np.array([0, 0, 9.8]))

    def close(self) -> None:
        self.closed = True


def _image(number: int) -> Image:
    return np.full((480, 752), number, dtype=np.uint8)


def _frame(number: int) -> SourceFrame:
    return SourceFrame(number * STEP_NS, _image(number), _image(_RIGHT_IMAGES + number))


@pytest.fixture
def source(monkeypatch: pytest.MonkeyPatch) -> FakeSource:
    """Frames that show all that is needed, in some ninety views."""
    views = made_views(4, 90)
    known = {k: view.corners[0] for k, view in enumerate(views)}
    known |= {_RIGHT_IMAGES + k: view.corners[1] for k, view in enumerate(views)}
    monkeypatch.setattr(guidance, "CornerDetector", NumberedCorners(known))
    return FakeSource([_frame(k) for k in range(90)])


def test_stops_when_nothing_is_missing(source: FakeSource, tmp_path: Path) -> None:
    said: list[str] = []
    lacks = film_board(
        source,
        GRID,
        should_stop=lambda: False,
        say=said.append,
        record=tmp_path / "kept",
        every_frame=True,
    )
    assert lacks.wanted == ()
    assert lacks.views >= guidance.ENOUGH_VIEWS
    assert source.given < 90
    assert source.closed
    assert "empty at" in said[0]
    assert "tilt the board" in said[0]
    assert said[-1].startswith("enough")
    assert len(set(said)) == len(said)  # nothing is said twice
    raw = open_raw(str(tmp_path / "kept"))
    assert len(raw.times_ns) == source.given
    assert [image.shape for image in next(raw.load([3]))[1]] == [(480, 752)] * 2


def test_does_not_wait_for_the_search(source: FakeSource) -> None:
    said: list[str] = []
    source.pause_s = 2e-3
    lacks = film_board(source, GRID, should_stop=lambda: False, say=said.append)
    assert lacks.views > 3
    assert len(said) > 3


def test_the_imu_is_asked_to_turn(source: FakeSource) -> None:
    source.has_imu = True
    lacks = film_board(
        source, GRID, should_stop=lambda: False, say=lambda line: None, every_frame=True
    )
    assert source.given == 90  # the end of the source came first: 4.5 s are too few
    assert len(lacks.wanted) == 1
    assert "25 s more for the IMU" in lacks.wanted[0] or "26 s more" in lacks.wanted[0]
    still = Guidance(GRID)
    still.add_images((_image(0), _image(_RIGHT_IMAGES)))
    for k in range(3):
        still.add_sample(ImuSample(k * STEP_NS, np.array([1.0 + k, 0, 0]), np.zeros(3)))
    assert any("about the IMU's y, z" in text for text in still.lacks().wanted)


def _corners(R: FloatArray, z: float, x: float = 0.0) -> Corners:
    centre = np.array([*(0.5 * np.array(GRID.extent_m)), 0.0])
    T = se3_from_parts(R, [x, 0.0, z] - R @ centre)
    uv, _ = project_point(LEFT, transform_points(T, board_points(GRID)))
    inside = (uv > 0).all(axis=1) & (uv < [LEFT.width, LEFT.height]).all(axis=1)
    ids = np.flatnonzero(inside)
    return Corners(ids, uv[ids])


@pytest.mark.parametrize(
    ("turn", "side"),
    [
        ([0, -0.5, 0.2], "right"),
        ([0, 0.5, 0], "left"),
        ([0.5, 0, 0], "lower"),
        ([-0.5, 0, 0.2], "upper"),
    ],
)
def test_knows_the_side_that_is_away(
    turn: list[float], side: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = {k: _corners(so3_exp(turn), 1.0, 0.1 * k) for k in range(3)}
    monkeypatch.setattr(guidance, "CornerDetector", NumberedCorners(known))
    found = Guidance(GRID)
    for k in known:
        assert found.add_images((_image(k),))
    tilt = next(text for text in found.lacks().wanted if "tilt" in text)
    assert f"its {side}" not in tilt
    assert tilt.count("its") == 3


def test_a_board_held_still_is_one_view(monkeypatch: pytest.MonkeyPatch) -> None:
    known = {0: _corners(np.eye(3), 1.0), 1: _corners(np.eye(3), 1.001)}
    monkeypatch.setattr(guidance, "CornerDetector", NumberedCorners(known))
    found = Guidance(GRID)
    assert found.add_images((_image(0),))
    assert not found.add_images((_image(1),))
    assert not found.add_images((_image(9),))  # no board
    lacks = found.lacks()
    assert lacks.views == 1
    assert any("nearer and from farther" in text for text in lacks.wanted)


def test_asks_for_views_of_both_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    assert T_RIGHT_LEFT[0, 3] < 0
    known = {k: _corners(np.eye(3), 1.0, 0.1 * k) for k in range(3)}
    monkeypatch.setattr(guidance, "CornerDetector", NumberedCorners(known))
    found = Guidance(GRID)
    for k in known:
        found.add_images((_image(k), _image(_RIGHT_IMAGES)))
    assert found.lacks().wanted[0] == "show the board to both cameras at once"


def test_the_command_films_a_board(
    source: FakeSource,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("vio.sources.source.open_source", lambda name, layout: source)
    target = tmp_path / "board.yaml"
    target.write_text(target_text(GRID))
    kept = tmp_path / "kept"
    command = ["live", "video:fake", "--target", str(target), "--record", str(kept)]
    assert main([*command, "--drop", "none"]) == 0
    shown = capsys.readouterr()
    assert "enough" in shown.out
    assert f"vio calibrate-rig {kept} --target {target}" in shown.out
    assert "of 30 views" in shown.err
