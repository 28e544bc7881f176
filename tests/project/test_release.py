"""What keeps a release back, and that a release could be made of what is here."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tools.release import problems
from vio._version import __version__

ROOT = Path(__file__).resolve().parents[2]
_READY = {
    "CHANGELOG.md": "# Changelog\n\n## [Unreleased]\n\n## [1.2.3] - 2027-01-02\n\n- One.\n",
    "CITATION.cff": "title: x\nversion: 1.2.3\ndate-released: 2027-01-02\n",
    "README.md": "pip install stereo_vio-1.2.3-py3-none-any.whl\n",
}


@pytest.mark.parametrize(
    ("name", "old", "new", "found"),
    [
        ("README.md", "", "", []),
        ("README.md", "1.2.3", "1.2.2", ["README.md"]),
        ("CHANGELOG.md", "[Unreleased]\n", "[Unreleased]\n\n- Two.\n", ["CHANGELOG.md"]),
        ("CHANGELOG.md", "[1.2.3]", "[1.2.2]", ["CHANGELOG.md"]),
        ("CITATION.cff", "version: 1.2.3", "version: 1.2.2", ["CITATION.cff"]),
        ("CITATION.cff", "2027-01-02", "2027-01-03", ["CITATION.cff"]),
    ],
)
def test_a_release_is_held_back_where_the_version_disagrees(
    name: str, old: str, new: str, found: list[str], tmp_path: Path
) -> None:
    for file, text in _READY.items():
        (tmp_path / file).write_text(
            text.replace(old, new) if file == name else text, encoding="utf-8"
        )
    assert [line.partition(":")[0] for line in problems(tmp_path, "1.2.3")] == found


def test_the_present_version_is_named_alike_everywhere() -> None:
    assert [line for line in problems(ROOT, __version__) if "Unreleased" not in line] == []


def test_the_workflow_uploads_without_a_password() -> None:
    text = (ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8")
    jobs = yaml.safe_load(text)["jobs"]
    assert jobs["publish"]["permissions"] == {"id-token": "write"}
    assert jobs["publish"]["needs"] == ["build", "compiled", "arm"]
    assert "secrets." not in text
    assert any(step.get("run") == "make release" for step in jobs["build"]["steps"])
