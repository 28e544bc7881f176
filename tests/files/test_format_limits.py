"""Limits of files, settings and what is read of them, from both sides, and codes of formats."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pytest

from tests.refused import is_refused
from vio import config, setting, testing
from vio.files import meshes
from vio.files.stamps import FRAME_PACE
from vio.files.trajectories import read_trajectory
from vio.inspection import inertial, pictures
from vio.live import first_use
from vio.numerics import compiling, prebuilt
from vio.records import ImuRecord, observations
from vio.setting import Range
from vio.sim.rigs import small_rig

Says = Callable[[float], bool]
ROOT = Path(__file__).resolve().parents[2]


# Settings


def _settings_named(count: int) -> int:
    """In the message on an unknown one of a section of so many."""
    names = [f"a{k}" for k in range(count)]
    with patch.object(config, "_nearest_setting", lambda *_: None):
        said = config._suggestion("b", names, "", config.Config)
    return said.partition(" and ")[0].count(", ") + 1


def _config_is_read(megabytes: float) -> bool:
    """As large as `vio.files.yaml_text` allows."""
    with TemporaryDirectory() as folder:
        file = Path(folder, "a.yaml")
        file.write_bytes(b"#" * round(1e6 * megabytes))
        with patch.object(config, "read_yaml", lambda text: {}):
            return not is_refused(lambda: config.load_config(file))


def _setting_fits(value: float) -> bool:
    return not is_refused(lambda: setting._check("a", value, Range()))


# Rows and stamps


def _trajectory_is_read(columns: int) -> bool:
    with TemporaryDirectory() as folder:
        file = Path(folder, "a.txt")
        rows = [" ".join([f"{k}.5", *["0.5"] * (columns - 1)]) for k in range(9)]
        file.write_text("\n".join(rows) + "\n")
        return not is_refused(lambda: read_trajectory(file))


def _unit_is_told(frames: int) -> bool:
    """Whether stamps that are no nanoseconds are told by so many frames."""
    return FRAME_PACE.fault(50 * np.arange(frames)) is not None


# Inspection


def _nearest_averaging(tau_s: float) -> float:
    """How near to a time one is over which the noise of an IMU is averaged; 0: at it."""

    def deviation(values: Any, step_s: float, tau: float) -> float:
        return float((1.0 + abs(np.log(tau / tau_s))) / np.sqrt(tau))

    times = np.arange(0, 20 * 10**9, 5_000_000)
    noise = 1e-3 * np.random.default_rng(0).normal(size=(len(times), 6))
    values = noise + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81])
    record = ImuRecord(times, values[:, :3], values[:, 3:])
    with patch.object(inertial, "allan_deviation", deviation):
        part = inertial.noise_part(record, None)
    assert part is not None
    return float(part.facts["gyro_density"]) - 1.0


def _points_looked_for() -> int:
    """In an image, to be matched."""
    counts: list[int] = []
    create = cv2.SIFT_create  # type: ignore[attr-defined]

    def recorded(count: int) -> Any:
        counts.append(count)
        return create(count)

    image = np.random.default_rng(0).integers(0, 255, (60, 80), dtype=np.uint8)
    with patch.object(cv2, "SIFT_create", recorded):
        pictures.sift_points(image, image)
    return counts[0]


# A test bench's report


def _compared(off_px: float = 0.0, from_border_px: float = 100.0) -> testing.FrontendErrors:
    """Two frames of a front end with one point, off as much and so far from the border."""
    view = SimpleNamespace(camera=small_rig(320, 240).cam0)

    def correspondence(scene: Any, a: Any, b: Any, uv: Any) -> Any:
        return uv, np.ones(len(uv), np.bool_)

    errors = testing.FrontendErrors()
    z = np.array([[from_border_px, 100.0, from_border_px, 100.0]])
    with (
        patch.object(testing, "_views", lambda *_: (view, view)),
        patch.object(testing, "correspondence", correspondence),
    ):
        frames = [observations(k, k, [7], z + k * off_px * np.eye(4)[0]) for k in range(2)]
        simulation: Any = SimpleNamespace(world=None)
        testing.compare(errors, simulation, frames[0], frames[1])
    return errors


# The first run


def _said_s(caplog: pytest.LogCaptureFixture) -> float:
    """How long the first run of an installation computes, as it says."""
    with (
        patch.object(prebuilt, "is_usable", lambda: False),
        patch.object(first_use, "is_cached", lambda: False),
        patch.object(compiling, "before_first_call", None),
        caplog.at_level(logging.DEBUG, logger="vio"),
        first_use.compiled_beside((), "none"),
    ):
        pass
    found = re.search(r"about (\d+) s", caplog.text)
    assert found
    return float(found[1])


LIMITS: dict[str, tuple[Says, float, float]] = {
    "settings: named": (lambda n: _settings_named(30) < n, 8, 9),
    "settings: shown": (lambda n: "…" in config._short("a" * int(n)), 200, 201),
    "settings: file": (lambda x: not _config_is_read(x), 4.0, 4.4),
    "settings: largest": (lambda x: not _setting_fits(x), 0.95e6, 1.05e6),
    "settings: smallest": (_setting_fits, 0.95e-9, 1.05e-9),
    "stamps: unit": (lambda n: _unit_is_told(int(n)), 2, 3),
    "noise: shortest average": (lambda x: _nearest_averaging(x) < 0.1, 0.08, 0.1),
    "noise: longest average": (lambda x: _nearest_averaging(x) < 0.1, 0.6, 0.5),
    "points: looked for": (lambda n: _points_looked_for() < n, 1400, 1600),
    "test bench: followed": (lambda x: _compared(x).followed == 0, 0.9, 1.1),
    "test bench: border": (lambda x: _compared(0.0, x).visible == 1, 11.0, 13.0),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_files(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


@pytest.mark.parametrize("columns", range(3, 7))
def test_positions_alone_have_four_columns(columns: int) -> None:
    assert _trajectory_is_read(columns) == (columns == 4)


def test_codes_are_those_of_the_formats() -> None:
    """OpenGL's ARRAY_BUFFER and ELEMENT_ARRAY_BUFFER, and what map_server's map_saver writes."""
    points = np.zeros((3, 3), np.float32)
    data = meshes.glb_mesh(
        points, points, np.zeros((3, 3), np.uint8), np.array([[0, 1, 2]], np.uint32), np.eye(3)
    )
    views = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])["bufferViews"]
    assert [view["target"] for view in views] == [0x8892] * 3 + [0x8893]
    assert [255 - level for level in (meshes.OCCUPIED, meshes.FREE, meshes.UNKNOWN)] == [255, 1, 50]


def test_a_first_run_says_what_the_page_on_speed_measured(caplog: pytest.LogCaptureFixture) -> None:
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    measured = re.search(r"first run of an installation compiles: about (\d+) s of CPU", page)
    assert measured
    assert _said_s(caplog) == float(measured[1])
