"""The picture of a run: which plane the map shows, and that it never decides about the run; names that are no text."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.dataset_makers import ece276a_arrays, make_drive, make_npz
from vio.cli import main
from vio.config import Config, load_config, to_yaml
from vio.files.printable import json_text, printable
from vio.runs.canvas import Canvas, Panel, rgb, ticks
from vio.runs.picture import _view


def test_the_map_holds_the_path_however_small() -> None:
    drive = np.stack([np.zeros(50), np.linspace(0, 200, 50)], axis=1)
    for scale in (1.0, 0.005):
        low, high = _view(scale * drive, 0.5)
        assert (low, high) == (pytest.approx(scale * np.array([-60, -20])), pytest.approx(scale * np.array([60, 220])))
    low, high = _view(drive[:, ::-1], 0.5)
    assert (low, high) == (pytest.approx([-20, -240]), pytest.approx([220, 240]))
    assert np.allclose(_view(drive[:1], 1.0), ([-0.02, -0.02], [0.02, 0.02]))


@pytest.mark.parametrize(
    ("limits", "most", "expected"),
    [
        ((0.0, 4.45), 9, ["0.0", "0.5", "1.0", "1.5", "2.0", "2.5", "3.0", "3.5", "4.0"]),
        ((-0.31, 0.34), 3, ["−0.25", "0.00", "0.25"]),
        ((-42.0, 6.0), 3, ["−40", "−20", "0"]),
        ((3e8, 3.2e8), 2, ["3e+08", "3.1e+08", "3.2e+08"]),
    ],
)
def test_ticks_are_round_values_with_the_digits_that_they_need(
    limits: tuple[float, float], most: float, expected: list[str]
) -> None:
    found = ticks(limits, most)
    assert [text for _, text in found] == expected
    assert all(limits[0] <= value <= limits[1] for value, _ in found)


def test_a_panel_draws_its_values_where_its_axes_say() -> None:
    canvas, panel = Canvas(300, 200), Panel((50, 20, 250, 120), (0.0, 10.0), (0.0, 1.0))
    x = np.array([0.0, 2.0, np.nan, 6.0, 10.0, 1e9])
    panel.line(x, np.full(6, 0.5), "#ff0000")
    panel.band(np.array([0.0, 10.0]), np.zeros(2), np.full(2, 0.2), "#0000ff", 0.5, "band")
    panel.dots(np.array([5.0, 50.0]), np.array([0.8, 0.8]), "#00ff00")
    panel.draw(canvas, title="title", x_label="x", y_label="y", legend=1)
    assert canvas.png().startswith(b"\x89PNG")
    at = canvas.pixels
    for u in (70, 190, 240):
        assert np.abs(at[70, u].astype(int) - rgb("#ff0000")).max() < 30  # the middle of an anti-aliased line
    assert at[70, 110].min() > 200  # between the two parts of the curve
    assert tuple(at[40, 150]) == rgb("#00ff00")
    assert tuple(at[110, 140]) in {(127, 127, 255), (128, 128, 255)}
    assert (at[:20] == 255).all()
    assert (at[130:] == 255).all()


def test_the_picture_of_a_run_loads_no_matplotlib(strange: Path) -> None:
    script = (
        "import sys; from vio.cli import main; "
        "code = main(sys.argv[1:]); sys.exit(code or ('matplotlib.figure' in sys.modules))"
    )
    out = strange.parent / "light"
    run = subprocess.run([sys.executable, "-c", script, "run", str(strange), "--out", str(out)], check=False)
    assert run.returncode == 0
    assert (out / "trajectory.png").is_file()


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
    assert main(["run", str(strange) + "x", "--out", str(out)]) == 1
    assert r"b\xff\x1b[31m.npzx does not exist" in capsys.readouterr().err


def test_config_with_a_foreign_byte_reads_back(strange: Path, tmp_path: Path) -> None:
    config = replace(Config(), frontend=replace(Config().frontend, features=strange))
    (tmp_path / "a.yaml").write_text(to_yaml(config), encoding="utf-8")
    assert load_config(tmp_path / "a.yaml") == config


def test_a_picture_that_cannot_be_drawn_is_one_warning(
    strange: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise RuntimeError("latex could not be found")

    monkeypatch.setattr("vio.runs.canvas.Canvas.png", fail)
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
    assert json.loads(json_text({"a": [os.fsdecode(b"\xff"), 1, None]})) == {"a": [r"\xff", 1, None]}
