"""The examples run as their first lines say, and are short; the bench for front ends tells good
from bad ones.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vio.cli import main
from vio.errors import DataError
from vio.frontend import FrontendSettings, build_frontend
from vio.geometry.stereo import StereoCamera
from vio.records import FrontendOutput, StereoFrame, observations
from vio.testing import check_frontend

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def _run(name: str, *arguments: object, process: bool = False) -> str:
    """Run an example as a program, in this process or one of its own, and return what it prints."""
    argv, printed = [str(ROOT / "examples" / name), *map(str, arguments)], io.StringIO()
    if process:
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        ended = subprocess.run(
            [sys.executable, *argv], env=env, capture_output=True, text=True, timeout=600
        )
        assert ended.returncode == 0, ended.stderr
        return ended.stdout
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(sys, "argv", argv)
        runpy.run_path(argv[0], run_name="__main__")
    return printed.getvalue()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_are_short_and_tested(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) < 90  # at 100 columns, one thing a line
    assert f"python examples/{path.name}" in text
    assert f'_run("{path.name}"' in Path(__file__).read_text(encoding="utf-8")


def test_a_live_loop_prints_a_pose_for_every_frame(flight: Path) -> None:
    text = _run("live_loop.py", flight, process=True)
    # A machine at full load may leave out frames, and says how many.
    found = re.search(r"(\d+) frames with a pose, (\d+) left out; latency", text)
    poses, dropped = int(found[1]), int(found[2])
    assert poses + dropped == 16
    assert len(re.findall(r"^\d+\.\d{3} s .* m$", text, re.MULTILINE)) == poses


def test_image_files_give_poses(flight: Path, tmp_path: Path) -> None:
    """Also where names are numbers without leading zeros."""
    cameras = [tmp_path / name for name in ("cam0", "cam1")]
    for camera in cameras:
        camera.mkdir()
        images = sorted((flight / "mav0" / camera.name / "data").glob("*.png"))
        for k, image in enumerate(images, start=1):
            (camera / f"{k}.png").symlink_to(image)
    lines = _run("image_files.py", *cameras, flight).splitlines()
    poses = [line.split()[0] for line in lines if ".png" in line]
    assert poses == [f"{k}.png" for k in range(1, len(images) + 1)][-len(poses) :]
    assert len(poses) > 10
    assert lines[-1].endswith(" landmarks"), "and no warning"


def test_a_detector_of_ones_own_is_checked() -> None:
    text = _run("own_detector.py")
    assert float(re.search(r"survival +([\d.]+)", text)[1]) > 0.9
    assert "reused_ids           0" in text


def test_precomputed_features_run_again(flight: Path) -> None:
    assert len(re.findall(r"window of +\d+ frames", _run("precomputed_features.py", flight))) == 3


def test_features_of_another_program_give_the_path(tmp_path: Path) -> None:
    ahead = re.search(
        r"at the end ([\d.]+) m ahead", _run("foreign_features.py", tmp_path / "features.npz")
    )
    assert float(ahead[1]) == pytest.approx(29, abs=0.1)


def test_results_are_read_as_arrays(flight: Path, tmp_path: Path) -> None:
    assert main(["run", str(flight), "--quiet", "--out", str(tmp_path / "run")]) == 0
    text = _run("read_results.py", tmp_path / "run")
    assert "16 frames" in text
    assert "(ATE)" in text


def test_a_front_end_of_ones_own_is_checked_and_used(flight: Path) -> None:
    text = _run("own_frontend.py", flight, process=True)
    assert "survival" in text
    ate = re.search(r"ATE ([\d.]+) m", text)
    assert float(ate[1]) < 0.02


def test_a_viewer_of_ones_own_makes_an_animated_picture(flight: Path, tmp_path: Path) -> None:
    assert "8 pictures" in _run("animated_picture.py", flight, tmp_path / "run.webp", process=True)
    with Image.open(tmp_path / "run.webp") as found:
        assert found.n_frames == 8
        assert found.size[0] == 960
        first = np.array(found.convert("RGB"))
        found.seek(7)
        last = np.array(found.convert("RGB"))
    assert first[:, :480].std() > 10
    blue = [
        (picture[:, 480:, 2].astype(int) - picture[:, 480:, 0] > 60).sum()
        for picture in (first, last)
    ]
    assert blue[1] > max(2 * blue[0], 10), "the path grows"


@pytest.mark.parametrize(
    ("name", "shorter"), [("rendered_recording", ('"6"', '"1.5"')), ("frontend_under_test", None)]
)
def test_notebooks_run_from_top_to_bottom(
    name: str, shorter: tuple[str, str] | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over fewer frames; what they show was made by all of them."""
    monkeypatch.chdir(tmp_path)
    cells = json.loads((ROOT / "examples" / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    scope: dict[str, object] = {}
    for cell in (cell for cell in cells if cell["cell_type"] == "code"):
        assert cell["outputs"] or "print" not in "".join(cell["source"]), (
            "saved with what it printed"
        )
        text = re.sub(r"frames=\d+", "frames=4", "".join(cell["source"]))
        exec(text if shorter is None else text.replace(*shorter), scope)


@pytest.fixture(scope="module")
def klt() -> object:
    return check_frontend(
        lambda camera: build_frontend("klt", camera, FrontendSettings()), frames=12
    )


def test_the_bench_finds_the_built_in_front_end_good(klt: object) -> None:
    report = klt
    assert report.survival > 0.95  # type: ignore[attr-defined]
    assert report.step_error_px < 0.1  # type: ignore[attr-defined]
    assert report.disparity_error_px < 0.1  # type: ignore[attr-defined]
    assert abs(report.disparity_bias_px) < 0.02  # type: ignore[attr-defined]
    assert report.reused_ids == 0  # type: ignore[attr-defined]


class Shifted:
    """The built-in front end with a known error."""

    def __init__(self, camera: StereoCamera) -> None:
        self._inner = build_frontend("klt", camera, FrontendSettings())

    def process(self, frame: StereoFrame, prior: object = None) -> FrontendOutput:
        seen = self._inner.process(frame).observations
        z = seen.z + np.array([0.3 * (frame.index % 2), 0.0, 0.3 * (frame.index % 2) - 0.2, 0.0])
        # every third frame half of them are lost, and come back
        shown = (seen.ids % 2 == 0) | (frame.index % 3 > 0)
        found = observations(
            frame.index, frame.time_ns, seen.ids[shown], z[shown], seen.has_right[shown]
        )
        return FrontendOutput(found, 0, 0, 0)


def test_the_bench_measures_what_is_wrong() -> None:
    report = check_frontend(Shifted, frames=12)
    assert report.disparity_bias_px == pytest.approx(0.2, abs=0.03)
    assert report.step_error_px == pytest.approx(0.3, abs=0.05)
    assert report.reused_ids > 0
    assert report.survival < 0.9
    assert "disparity_bias_px" in str(report)


def test_the_bench_refuses_what_is_no_front_end() -> None:
    class Silent:
        def __init__(self, camera: StereoCamera) -> None:
            pass

        def process(self, frame: StereoFrame, prior: object = None) -> list[int]:
            return []

    with pytest.raises(DataError, match="FrontendOutput"):
        check_frontend(Silent, frames=2)  # type: ignore[arg-type]
