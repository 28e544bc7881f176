"""What programs give in the place of a calibration, a recording or settings is refused with the call
that makes it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vio
from tests.plain_maker import make_plain
from vio.config import Config
from vio.errors import ConfigError
from vio.records import Trajectory

RIG = vio.Rig.rectified(300.0, 300.0, 159.5, 119.5, 0.1, 320, 240)


@pytest.mark.parametrize("given", ["recording", Path("recording"), None, {"fx": 1.0}])
@pytest.mark.parametrize("live", [vio.Odometry, vio.LiveOdometry])
def test_a_rig_is_no_path(live: Any, given: object) -> None:
    with pytest.raises(TypeError, match=r"give what vio.load_rig\(path\) returns"):
        live(given)


def test_a_recording_is_no_rig(tmp_path: Path) -> None:
    recording: Any = vio.open_dataset(make_plain(tmp_path / "plain"))
    for given in (recording, recording.recording):
        with pytest.raises(TypeError, match=r"rig: give what vio.load_rig\(path\) returns, not"):
            vio.Odometry(given)


@pytest.mark.parametrize("live", [vio.Odometry, vio.LiveOdometry])
def test_settings_are_no_dictionary(live: Any) -> None:
    with pytest.raises(TypeError, match=r"give what vio.load_config\(...\) returns, not dict"):
        live(RIG, {"motion": "none"})


@pytest.mark.parametrize("given", ["recording", Path("recording"), None])
def test_a_recording_is_no_path(given: Any) -> None:
    with pytest.raises(TypeError, match=r"give what vio.open_dataset\(path\) returns"):
        vio.run(given, Config())


def test_settings_of_a_run_are_no_path() -> None:
    dataset: Any = object()
    settings: Any = "settings.yaml"
    with pytest.raises(TypeError, match=r"give what vio.load_config\(...\) returns, not str"):
        vio.run(dataset, settings)


@pytest.mark.parametrize(
    ("argument", "given", "asked"),
    [
        ("parts", "orb", "parts: give vio.Parts"),
        ("map", "yard.map", "map: give vio.MapUse"),
        ("control", "runs/first", "control: give vio.RunControl"),
        ("control", vio.RunControl(folder="runs/first"), "folder: give vio.runs.recorder.Growing"),  # type: ignore[arg-type]
    ],
)
def test_parts_maps_and_folders_of_a_run_are_no_names(
    argument: str, given: Any, asked: str, tmp_path: Path
) -> None:
    dataset: Any = vio.open_dataset(make_plain(tmp_path / "plain"))
    with pytest.raises(TypeError, match=asked):
        vio.run(dataset, Config(), **{argument: given})


def test_trajectories_and_lists_are_asked_for_where_paths_and_texts_are_given() -> None:
    poses = Trajectory(np.tile(np.eye(4), (3, 1, 1)), None, "cam0")
    with pytest.raises(TypeError, match=r"reference: give a Trajectory, .*, not str"):
        vio.evaluate(poses, "truth.txt")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"estimate: give a Trajectory, .*, not ndarray"):
        vio.evaluate(poses.T_world_body, poses)  # type: ignore[arg-type]
    for given in ("motion=none", {"motion": "none"}):
        with pytest.raises(ConfigError, match=r"give a list such as \['motion=none'\], not"):
            vio.load_config(overrides=given)  # type: ignore[arg-type]
