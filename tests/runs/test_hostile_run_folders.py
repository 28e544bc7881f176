"""A run's folder that comes from elsewhere writes nothing outside of itself, and wrong values in it
are named.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.commands import refused
from tests.runs.test_unfinished_runs import Stop, _flight_log
from vio.bench.suite import read_suite
from vio.cli import main
from vio.datasets import open_dataset
from vio.errors import ConfigError, DataError
from vio.files.schema import NUMBER, TEXT, WHOLE, a_list, an_object
from vio.runs.files import RunFile
from vio.runs.folder import growing_folder
from vio.runs.pipeline import RunControl, run
from vio.runs.stated import METRICS_SHAPE, REQUEST_SHAPE, read_metrics

FRAMES = 12
COMPARED = (RunFile.TRAJECTORY, RunFile.ESTIMATES, RunFile.LANDMARKS, RunFile.OBSERVATIONS)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _flight_log(tmp_path_factory.mktemp("hostile") / "flight.npz", frames=FRAMES)


@pytest.fixture(scope="module")
def whole(recording: Path) -> Path:
    out = recording.parent / "whole"
    command = ["run", str(recording), "--quiet", "--no-plot", "--save-observations"]
    assert main([*command, "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def stopped_folder(recording: Path) -> Path:
    """The folder of a run that was stopped."""
    from vio.config import Config

    out = recording.parent / "stopped"
    dataset = open_dataset(recording)
    request = {
        "source": f"log:{recording}",
        "reference": None,
        "start": 0,
        "stop": FRAMES,
        "lengths_m": None,
        "save_observations": True,
        "save_calibration": None,
        "map": None,
        "map_density": None,
        "localise": False,
        "plot": False,
        "command": None,
    }
    folder = growing_folder(out, dataset, Config(), request)
    control = RunControl(folder, should_stop=Stop(8))
    assert run(dataset, Config(), keep_observations=True, control=control).stopped is not None
    return out


@pytest.fixture
def stopped(stopped_folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(stopped_folder, tmp_path / "run"))


def _state(folder: Path, **values: Any) -> None:
    """Change what a run's folder says it was asked for."""
    path = folder / "unfinished" / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


@pytest.mark.parametrize(
    ("key", "flag"), [("save_calibration", "--save-calibration"), ("map", "--map")]
)
@pytest.mark.parametrize("content", [None, "mine\n"])
def test_a_file_outside_is_written_only_where_it_is_named_again(
    key: str, flag: str, content: str | None, stopped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outside = stopped.parent / "outside.yaml"
    if content is not None:
        outside.write_text(content)
    _state(stopped, **{key: str(outside)})
    said = refused(capsys, "run", "--resume", stopped, "--quiet")
    assert f"writes {outside}, which lies outside of its folder" in said
    assert said.rstrip().endswith(f"{flag} {outside}")
    other = refused(capsys, "run", "--resume", stopped, "--quiet", flag, stopped.parent / "b.yaml")
    assert f"began with {outside}; name that one" in other
    assert outside.exists() == (content is not None)
    if content is not None:  # all checks of a new run are made
        refused(capsys, "run", "--resume", stopped, "--quiet", flag, outside)
        assert outside.read_text() == content


def test_a_run_goes_on_with_the_file_that_is_named_again(stopped: Path) -> None:
    outside = stopped.parent / "rig.yaml"
    _state(stopped, save_calibration=str(outside))
    again = ["run", "--resume", str(stopped), "--quiet", "--save-calibration", str(outside)]
    assert main(again) == 0
    assert outside.read_text().startswith("# by vio run")


def test_a_calibration_in_the_folder_needs_no_name(stopped: Path) -> None:
    moved = stopped.rename(stopped.parent / "moved")
    _state(moved, save_calibration=RunFile.CALIBRATION)
    assert main(["run", "--resume", str(moved), "--quiet"]) == 0
    assert (moved / RunFile.CALIBRATION).is_file()


def test_code_is_run_only_where_it_is_named_again(
    stopped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = stopped.parent / "code.py"
    code.write_text("raise SystemExit('was run')\n")
    _state(stopped, frontend=f"{code}:Mine")
    said = refused(capsys, "run", "--resume", stopped, "--quiet")
    assert said.rstrip().endswith(f"name it again: --frontend {code}:Mine")
    _state(stopped, frontend=None)
    said = refused(capsys, "run", "--resume", stopped, "--quiet", "--frontend", f"{code}:Mine")
    assert "leave --frontend out" in said


def test_flags_that_the_run_began_without_are_refused(
    stopped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(capsys, "run", "--resume", stopped, "--map", stopped.parent / "a.map")
    assert "--map: the run in" in said
    assert "began without; leave it out" in said


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"source": 5}, "source must be a text, got 5"),
        ({"start": "0"}, "start must be a whole number, got '0'"),
        ({"start": True}, "start must be a whole number"),
        ({"stop": 1.5}, "stop must be a whole number or null"),
        ({"start": 10**30}, "start must be a whole number"),
        ({"start": 5, "stop": 2}, "5"),
        ({"reference": [1]}, "reference must be a text or null"),
        ({"lengths_m": "far"}, "lengths_m must be a list or null"),
        ({"lengths_m": [1, "a"]}, "lengths_m.1 must be a finite number"),
        ({"save_observations": None}, "save_observations must be true or false"),
        ({"save_calibration": 1}, "save_calibration must be a text or null"),
        ({"map": {}}, "map must be a text or null"),
        ({"map_density": "2"}, "map_density must be a whole number or null"),
        ({"map_density": 0}, "map_density is 0, not at least 1"),
        ({"localise": "no"}, "localise must be true or false"),
        ({"plot": 1}, "plot must be true or false"),
        ({"command": 1}, "command must be a text or null"),
    ],
)
def test_wrong_values_in_the_request_are_named(
    change: dict[str, Any], named: str, stopped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _state(stopped, **change)
    assert named in refused(capsys, "run", "--resume", stopped, "--quiet")


METRICS_CHANGES: list[tuple[dict[str, Any], str]] = [
    ({"T_cam0_imu": [[1, 2], [3]]}, "T_cam0_imu|inhomogeneous"),
    ({"T_cam0_imu": "eye"}, "T_cam0_imu must be a list"),
    ({"complete": "yes"}, "complete must be true or false"),
    ({"source": 5}, "source must be a text"),
    ({"warnings": 5}, "warnings must be a list"),
    ({"warnings": [5]}, r"warnings\.0 must be a text"),
    ({"first_frame": "a"}, "first_frame must be a whole number"),
    ({"innovation_ratio": "a"}, "innovation_ratio must be a finite number"),
    ({"stereo_field": 7}, "stereo_field must be an object"),
    ({"stereo_field": {"rig": {"lines": 3}}}, r"stereo_field\.rig\.lines must be a list"),
    ({"stereo_scale": {"baseline": 1}}, r"stereo_scale\.baseline must be an object"),
    ({"stereo_scale": {"baseline": {"percent": 1}}}, r"baseline\.sigma_percent is missing"),
    ({"camera_imu": {"rotation_deg": [1]}}, r"camera_imu\.rotation_sigma_deg is missing"),
    ({"camera_imu": {"time_offset_ms": None}}, r"camera_imu\.time_offset_ms must be a finite"),
    ({"camera": 3}, "camera must be an object"),
    ({"camera": {"fu": "a"}}, r"camera\.fu must be a finite number"),
    ({"map": []}, "map must be an object"),
]


@pytest.mark.parametrize(("change", "named"), METRICS_CHANGES)
def test_wrong_values_in_the_metrics_are_named(
    change: dict[str, Any], named: str, whole: Path, tmp_path: Path
) -> None:
    path = tmp_path / RunFile.METRICS
    path.write_text(json.dumps({**json.loads((whole / RunFile.METRICS).read_text()), **change}))
    with pytest.raises(DataError, match=named):
        read_metrics(tmp_path)


def test_what_a_run_writes_fits_the_shapes(whole: Path, stopped: Path) -> None:
    metrics = json.loads((whole / RunFile.METRICS).read_text())
    request = json.loads((stopped / "unfinished" / "run.json").read_text())
    assert METRICS_SHAPE.fault(metrics, "") is None
    assert REQUEST_SHAPE.fault(request, "") is None
    missing = set(METRICS_SHAPE.members) - set(metrics)
    assert missing <= {"map"}, "a member that no run writes is not read"


def test_shapes_name_the_place_of_a_fault() -> None:
    shape = an_object({"a": a_list(an_object({"b": NUMBER}, "b"))}, "a", each=TEXT)
    assert shape.fault({"a": [{"b": 1}], "c": "x"}, "") is None
    assert shape.fault({"a": [{"b": 1}, {}]}, "") == "a.1.b is missing"
    assert shape.fault({"a": [{"b": float("nan")}]}, "") == "a.0.b must be a finite number, got nan"
    assert shape.fault({"a": [], "c": 1}, "") == "c must be a text, got 1"
    assert WHOLE.fault(2**63, "n") is not None
    assert WHOLE.fault(2**63 - 1, "n") is None


def test_a_picture_does_not_follow_a_link(whole: Path, tmp_path: Path) -> None:
    from vio.runs.picture import write_picture

    class Blank:
        def savefig(self, stream: Any, **_: Any) -> None:
            stream.write(b"picture")

    mine = tmp_path / "mine"
    mine.write_bytes(b"mine")
    (tmp_path / "p.png").symlink_to(mine)
    write_picture(tmp_path / "p.png", Blank)
    assert mine.read_bytes() == b"mine"
    assert (tmp_path / "p.png").read_bytes() == b"picture"


@pytest.mark.parametrize("word", ["--out=x", "--out", "--ou", "--o=x", "--see", "--js"])
def test_a_suite_cannot_say_where_its_renders_go(word: str, tmp_path: Path) -> None:
    suite = tmp_path / "s.yaml"
    suite.write_text(f"sequences:\n  a:\n    render: ['{word}', '/elsewhere']\n")
    with pytest.raises(ConfigError, match="is set by the bench; leave it out"):
        read_suite(str(suite))


@pytest.mark.parametrize("content", [b"notes of mine", b"RRF2 of another program"])
def test_a_view_replaces_no_file_of_others(content: bytes, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from vio.view.stream import open_stream

    mine = tmp_path / "a.rrd"
    mine.write_bytes(content)
    with pytest.raises(DataError, match="was not made by this command"):
        open_stream(str(mine), "a")
    assert mine.read_bytes() == content
    link = tmp_path / "b.rrd"
    link.symlink_to(tmp_path / "c")
    with pytest.raises(DataError, match="was not made by this command"):
        open_stream(str(link), "b")


# Killed


class Killed(BaseException):
    """Takes the place of a signal that no program survives."""


class Killer:
    """Ends a process, as far as its files are concerned, before its n-th change of a folder."""

    def __init__(self) -> None:
        self.folder: str | None = None
        self.left = 0
        sys.addaudithook(self._hook)

    def arm(self, folder: Path, after: int) -> None:
        self.folder = str(folder)
        self.left = after

    def disarm(self) -> None:
        self.folder = None

    def _hook(self, event: str, args: tuple[Any, ...]) -> None:
        if self.folder is None or not self._changes(event, args):
            return
        self.left -= 1
        if self.left < 0:  # dead: nothing more is written, whatever cleans up
            raise Killed

    def _changes(self, event: str, args: tuple[Any, ...]) -> bool:
        if event == "open":
            flags = args[2] or 0
            writes = bool(flags & (os.O_WRONLY | os.O_RDWR))
            return writes and self._inside(args[0])
        if event in ("os.rename", "os.mkdir"):
            return self._inside(args[0])
        if event in ("os.remove", "os.rmdir"):
            return self._inside(args[0]) or args[1] != -1  # of a tree that is being removed
        return False

    def _inside(self, path: Any) -> bool:
        return isinstance(path, (str, Path)) and str(path).startswith(str(self.folder))


@pytest.fixture(scope="module")
def killer() -> Iterator[Killer]:
    made = Killer()
    yield made
    made.disarm()


def _finish_arguments(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Go on with a run up to where its results are moved in; return what does that."""
    from vio.cli import running

    original = running.finish_run_folder
    held: list[Callable[[], Any]] = []

    def hold(*args: Any, **options: Any) -> Any:
        held.append(lambda: original(*args, **options))
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(running, "finish_run_folder", hold)
        with pytest.raises(Killed):
            main(["run", "--resume", str(folder), "--quiet"])
    return held[0]


def _left(folder: Path) -> tuple[tuple[str, bytes], ...]:
    """What a process left, but for results that no later process looks at."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    kept = sorted(path for path in files if path.parent.name != "final")
    return tuple((path.name, path.read_bytes()) for path in kept)


def test_a_run_killed_at_any_moment_of_its_end_can_be_gone_on_with(
    stopped: Path,
    whole: Path,
    killer: Killer,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    finish = _finish_arguments(stopped, monkeypatch)
    before = Path(shutil.copytree(stopped, stopped.parent / "before"))
    seen: set[tuple[tuple[str, bytes], ...]] = set()
    moments = 0
    while True:
        shutil.rmtree(stopped)
        shutil.copytree(before, stopped)
        killer.arm(stopped, moments)
        try:
            finish()
            break
        except Killed:
            moments += 1
        finally:
            killer.disarm()
        state = _left(stopped)
        if state in seen:
            continue
        seen.add(state)
        if (stopped / "unfinished" / "run.json").is_file():
            assert main(["run", "--resume", str(stopped), "--quiet"]) == 0
            assert not (stopped / "unfinished").exists()
        else:
            assert "its run is complete" in refused(capsys, "run", "--resume", stopped)
        for name in COMPARED:
            assert (stopped / name).read_bytes() == (whole / name).read_bytes(), (moments, name)
        assert json.loads((stopped / RunFile.METRICS).read_text())["complete"] is True
    assert moments > 30, "each file is written, moved, and what the run needed is removed"
    assert len(seen) > 15
