"""The commands of the tutorials run as printed, and the site's pages are all in its menu."""

from __future__ import annotations

import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("rosbags", reason="needs rosbags")

import vio
from tests.bag_maker import Script
from tools.bad_inputs import PAGE
from vio.cli import main
from vio.datasets import open_dataset
from vio.records import ImuSample, StereoFrame

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
_SLOW = ("vio calibrate",)  # tests/cli/test_calibrate_cli.py runs it


def _blocks(page: Path) -> list[tuple[str, str]]:
    """The fenced blocks of a page: what follows the opening fence, and the text."""
    text = page.read_text(encoding="utf-8")
    return re.findall(r"^```([^`\n]*)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)


def _commands(page: Path) -> list[str]:
    lines = [line for fence, text in _blocks(page) if not fence for line in text.splitlines()]
    return [line.partition("  #")[0] for line in lines if line.startswith("vio ")]


@pytest.fixture(scope="module")
def workplace(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the recordings that the tutorials name."""
    folder = tmp_path_factory.mktemp("tutorials")
    assert main(["convert", str(flight), "--to", "plain", "--out", str(folder / "cameras")]) == 0
    drive = folder / "dataset" / "sequences" / "07"
    drive.parent.mkdir(parents=True)
    assert main(["convert", str(flight), "--to", "kitti", "--out", str(drive)]) == 0
    shutil.copytree(flight, folder / "MH_01_easy")
    _write_bag(flight, folder / "flight.bag")
    return folder


def _write_bag(flight: Path, path: Path) -> None:
    """Write a rectified flight as a ROS 1 bag with its calibration."""
    dataset = open_dataset(flight)
    recording, script = dataset.recording, Script("bag")
    script.static(int(recording.frame_times_ns[0]), "left", "imu", recording.T_cam0_imu)
    for event in dataset.events():
        if isinstance(event, ImuSample):
            script.imu("/imu0", event)
        elif isinstance(event, StereoFrame) and event.left is not None and event.right is not None:
            for topic, image, right in (
                ("/cam0/left", event.left, False),
                ("/cam1/right", event.right, True),
            ):
                name = topic.rpartition("/")[0]
                script.image(f"{name}/image_raw", event.time_ns, image)
                script.camera_info(
                    f"{name}/camera_info", event.time_ns, recording.camera, right=right
                )
    script.write(path)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_commands_of_a_tutorial_run(
    page: Path, workplace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(workplace)
    for command in _commands(page):
        if not command.startswith(_SLOW):
            assert main(shlex.split(command)[1:]) == 0, command


def test_every_page_is_in_the_menu() -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    named = set(re.findall(r"[\w/]+\.md", text))
    assert named - {PAGE} == {
        path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")
    }
    yaml.safe_load(text)


def test_tutorials_name_every_example_and_show_them_as_they_are() -> None:
    """The code is in the pages, so that a forge shows it; a long one is named alone."""
    shown = {fence: text for page in PAGES for fence, text in _blocks(page) if "title=" in fence}
    files = {
        f'python title="examples/{path.name}"': path.read_text(encoding="utf-8")
        for path in (ROOT / "examples").glob("*.py")
    }
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert len(shown) > 5
    assert shown == {fence: files.get(fence) for fence in shown}
    unnamed = [
        p.name for p in (ROOT / "examples").glob("*.py") if f"examples/{p.name}" not in pages
    ]
    assert unnamed == []


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("mkdocs", "latex2mathml")),
    reason="needs the extra docs",
)
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    built: Any = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert built.returncode == 0, built.stderr
    site = tmp_path / "site"
    assert (site / "tutorials" / "folder.html").is_file()
    assert "var __index" in (site / "search" / "search_index.js").read_text(encoding="utf-8")[:20]
    page = (site / "math.html").read_text(encoding="utf-8")
    numbers = re.findall(r"\\tag\{(\w+)\}", (ROOT / "docs" / "math.md").read_text(encoding="utf-8"))
    assert len(numbers) > 50
    assert re.findall(r'</math></div><span id="\w+">\((\w+)\)</span>', page) == numbers
    assert "arithmatex" not in page
    assert not re.search(r'(src|href)="https?://[^"]+\.(js|css|woff2?)', page), "needs no network"
    reference = (site / "reference.html").read_text(encoding="utf-8")
    assert "__init__" not in reference
    assert {f'id="vio.{name}"' for name in vio.__all__ if not name.startswith("_")} <= set(
        re.findall(r'id="vio\.\w+"', reference)
    )
