"""A user's own `frontend` beside a script: vio still runs with its own front end, and the script with its own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.dataset_makers import make_kitti

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = """
import sys
import vio
from vio.cli import main
status = main(["run", sys.argv[1], "--frontend", "klt", "--out", sys.argv[2], "--quiet"])
import frontend
assert frontend.OWNER == "the user", frontend
assert "vio._frontend.klt" in sys.modules
assert sys.modules["vio._frontend"].__file__.startswith(sys.argv[3])
sys.exit(status)
"""


def _installed(folder: Path) -> Path:
    """Lay out the packages as a wheel does in site-packages."""
    for name in ("vio", "frontend"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.mark.parametrize("layout", ["checkout", "wheel"])
def test_foreign_frontend_beside_the_script_does_not_shadow_ours(layout: str, tmp_path: Path) -> None:
    place = ROOT if layout == "checkout" else _installed(tmp_path / "site-packages")
    (tmp_path / "work" / "frontend").mkdir(parents=True)
    (tmp_path / "work" / "frontend" / "__init__.py").write_text("OWNER = 'the user'\n")
    (tmp_path / "work" / "script.py").write_text(SCRIPT)
    recording = make_kitti(tmp_path / "kitti")
    argv = [sys.executable, "script.py", str(recording), str(tmp_path / "out"), str(place)]
    done = subprocess.run(
        argv,
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path / "work",
        env={**os.environ, "PYTHONPATH": str(place)},
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "trajectory.tum").is_file()


def test_names_a_missing_front_end(tmp_path: Path) -> None:
    place = _installed(tmp_path)
    shutil.rmtree(place / "frontend")
    env = {**os.environ, "PYTHONPATH": str(place)}
    argv = [sys.executable, "-S", "-c", "from vio.frontend_package import frontend_module; frontend_module()"]
    done = subprocess.run(argv, capture_output=True, text=True, check=False, cwd=tmp_path, env=env)
    assert f"{place / 'frontend'} is missing" in done.stderr
