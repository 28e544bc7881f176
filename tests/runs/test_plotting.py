"""The picture of a run: which plane the map shows, and that it never decides about the run;
names that are no text.
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.commands import refused
from tests.dataset_makers import ece276a_arrays, make_drive, make_npz
from vio.cli import main
from vio.config import Config, load_config, to_yaml
from vio.files.printable import json_text, printable
from vio.runs.picture import _view


def test_the_map_holds_the_path_however_small() -> None:
    drive = np.stack([np.zeros(50), np.linspace(0, 200, 50)], axis=1)
    for scale in (1.0, 0.005):
        low, high = _view(scale * drive, 0.5)
        assert (low, high) == (
            pytest.approx(scale * np.array([-60, -20])),
            pytest.approx(scale * np.array([60, 220])),
        )
    low, high = _view(drive[:, ::-1], 0.5)
    assert (low, high) == (pytest.approx([-20, -240]), pytest.approx([220, 240]))
    assert np.allclose(_view(drive[:1], 1.0), ([-0.02, -0.02], [0.02, 0.02]))


NAME = os.fsdecode(b"a$1_$2 \\frac{ b\xff\x1b[31m.npz")


@pytest.fixture(scope="module")
def strange(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("names")
    return make_npz(folder / NAME, ece276a_arrays(make_drive(8)))


def test_names_that_are_no_text_do_not_fail_the_run(
    strange: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    out = strange.parent / "out"
    assert main(["run", str(strange), "--out", str(out), "--save-observations"]) == 0
    assert (out / "trajectory.png").stat().st_size > 10_000
    assert "was not drawn" not in caplog.text
    metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["source"].endswith(r"a$1_$2 \frac{ b\xff\x1b[31m.npz")
    assert main(["run", str(strange), "--out", os.fsdecode(b"%s\xff" % os.fsencode(out))]) == 0
    assert r"out\xff" in capsys.readouterr().out
    assert r"b\xff\x1b[31m.npzx does not exist" in refused(
        capsys, "run", str(strange) + "x", "--out", out
    )


def test_config_with_a_foreign_byte_reads_back(strange: Path, tmp_path: Path) -> None:
    config = replace(Config(), frontend=replace(Config().frontend, features=strange))
    (tmp_path / "a.yaml").write_text(to_yaml(config), encoding="utf-8")
    assert load_config(tmp_path / "a.yaml") == config


def test_a_picture_that_cannot_be_drawn_is_one_warning(
    strange: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise RuntimeError("latex could not be found")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", fail)
    out = strange.parent / "plain"
    assert main(["run", str(strange), "--out", str(out)]) == 0
    assert [r.message for r in caplog.records if "drawn" in r.message] == [
        "trajectory.png was not drawn (RuntimeError: latex could not be found)"
    ]
    assert (out / "metrics.json").is_file()
    assert not (out / "trajectory.png").exists()


def test_printable_escapes_what_a_terminal_would_obey() -> None:
    assert printable("Straße ±1.npz") == "Straße ±1.npz"
    assert printable(os.fsdecode(b"a\xffb\n\x1b[2J")) == r"a\xffb\n\x1b[2J"
    assert json.loads(json_text({"a": [os.fsdecode(b"\xff"), 1, None]})) == {
        "a": [r"\xff", 1, None]
    }
