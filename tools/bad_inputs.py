"""The site's page of bad inputs: every bad input that the tests make, and the line that a user gets.

    python -m tools.bad_inputs          # prints the page

The cases are the dictionaries `BAD` of the tests of the readers. The page is made when the site is
built (`tools/site_hooks.py`), and is kept nowhere else.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.rigs import load_rig
from vio.errors import VioError
from vio.files.trajectories import read_trajectory

PAGE = "bad_inputs.md"  # among the site's pages
_MAKERS = {
    "tests.datasets.test_datasets_euroc": "make_euroc",
    "tests.datasets.test_datasets_kitti_raw": "make_kitti_raw",
}
MODULES = {
    "tests.datasets.test_rig": "Calibration files (`vio.load_rig`)",
    "tests.datasets.test_datasets_plain": "Plain folders",
    "tests.datasets.test_datasets_bags": "ROS bags",
    "tests.datasets.test_datasets_videos": "Videos",
    "tests.datasets.test_datasets_euroc": "EuRoC folders",
    "tests.datasets.test_datasets_kitti_raw": "KITTI raw drives",
    "tests.datasets.test_datasets_gtsam": "GTSAM's stereo factors",
    "tests.datasets.test_hostile_recordings": "Damaged and hostile files",
    "tests.files.test_trajectory_io": "Trajectories",
}
_HEAD = """# Bad inputs

An input that cannot be used ends in one line, which says what is wrong, where, and what to do, and in exit status 1.
Each row is a test, and this page is made from the same cases. What a run can read but makes no sense of (swapped
cameras, readings in g, black images) is found by `vio inspect`, see [recordings](recordings.md).
"""


def cases(module: str) -> dict[str, Any]:
    """Return the cases of one test module."""
    found: dict[str, Any] = importlib.import_module(module).BAD
    return found


def message_of(module: str, case: Any, folder: Path) -> str:
    """Return the line that a case gives, with its folder written as '…'."""
    try:
        if module == "tests.datasets.test_rig":
            load_rig(case[0](folder), cameras=2)
        elif module == "tests.datasets.test_datasets_videos":
            case[0](folder)
            list(open_dataset(folder).events())
        elif module == "tests.files.test_trajectory_io":
            (folder / "a.txt").write_text(case[0], encoding="utf-8")
            read_trajectory(folder / "a.txt", fmt=case[1])
        elif module in _MAKERS:
            whole = getattr(importlib.import_module("tests.euroc_maker"), _MAKERS[module])(folder)
            case[0](whole / "mav0" if (whole / "mav0").is_dir() else whole)
            # Of itself, an EuRoC folder without cam1 is a recording of one camera.
            list(open_dataset(f"euroc:{folder}" if (whole / "mav0").is_dir() else folder).events())
        else:
            settings = DatasetSettings(topics=case[1]) if len(case) == 3 else DatasetSettings()
            list(open_dataset(case[0](folder / "r"), settings).events())
    except VioError as error:
        text = " ".join(str(error).split())
        return text.replace(str(folder), "…").replace("|", "\\|")
    raise AssertionError(f"{module}: a case gives no error")


def page() -> str:
    """Return the page as Markdown; takes some ten seconds, in which every case is read."""
    parts = [_HEAD]
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        videos = _videos(root)
        for module, title in MODULES.items():
            parts.append(f"\n## {title}\n\n| input | message |\n|---|---|\n")
            for k, (label, case) in enumerate(cases(module).items()):
                folder = root / f"{title[:3]}{k}"
                if module == "tests.datasets.test_datasets_videos":
                    shutil.copytree(videos, folder)
                else:
                    folder.mkdir()
                if module == "tests.datasets.test_datasets_bags":
                    (folder / "r").mkdir()
                parts.append(f"| {label} | {message_of(module, case, folder)} |\n")
    return "".join(parts)


def main() -> int:
    """Print the page."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    sys.stdout.write(page())
    return 0


def _videos(root: Path) -> Path:
    """Return the folder of videos that the tests' cases change."""
    from vio.cli import main as vio

    flight = root / "flight"
    options = [
        "--rig",
        "small",
        "--width",
        "160",
        "--rate",
        "20",
        "--duration",
        "0.8",
        "--format",
        "euroc",
    ]
    with contextlib.redirect_stdout(io.StringIO()):
        assert vio(["render", "--out", str(flight), "--workers", "1", "--json", *options]) == 0
    folder: Path = importlib.import_module("tests.datasets.test_datasets_videos").make_videos(
        flight, root / "videos"
    )
    return folder


if __name__ == "__main__":
    sys.exit(main())
