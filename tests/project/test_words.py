"""How many words the documents have, which words they avoid, and which figures no hand types.

Plain reading of the pages. A page that grows past its limit is rewritten, or its limit is raised
on purpose. Pages made from code (`GENERATED`) have limits only: their words are the code's.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tools.results import read_results

ROOT = Path(__file__).resolve().parents[2]
PAGES = (
    "README.md",
    "CHANGELOG.md",
    *(path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs").rglob("*.md"))),
)
GENERATED = {
    "docs/commands.md",
    "docs/fault_draws.md",
    "docs/faults.md",
    "docs/findings.md",
    "docs/results.md",
    "docs/settings.md",
}
# Pages that are rewritten elsewhere at the same time: take them out once they are.
LATER: set[str] = set()

# Words of a page, without displayed formulas; other pages have _ELSE at most.
_ELSE = 800
LIMITS = {
    "README.md": 930,
    "CHANGELOG.md": 1400,
    "docs/architecture.md": 1230,
    "docs/bench.md": 1300,
    "docs/cameras.md": 960,
    "docs/commands.md": 860,
    "docs/conventions.md": 910,
    "docs/fault_draws.md": 1100,
    "docs/faults.md": 1300,
    "docs/findings.md": 1150,
    "docs/frontend.md": 1170,
    "docs/inertial.md": 1290,
    "docs/live.md": 1320,
    "docs/maps.md": 1340,
    "docs/math.md": 6400,
    "docs/neighbours.md": 1500,
    "docs/notes/consistency.md": 880,
    "docs/recordings.md": 1750,
    "docs/results.md": 2950,
    "docs/settings.md": 1550,
    "docs/simulation.md": 1040,
    "docs/tutorials/target.md": 1390,
}
ALL_PAGES = 45_700

# Each with what to write in its place.
BANNED = {
    r"\bexchang(e|es|ed|ing)\b": "swap, swapped",
    r"\bbent\b|\bbends\b|\bbend (it|them|both|a point|points|images?)\b": "distort, deform",
    r"\breach(es|ed|ing)?\b": "range, extend, arrive",
    r"\bsaid\b": "stated, reported",
    r"\b(stands?|stood) (at|on|above|below|beside|where|there)\b": "is, are",
    r"\b[Ww]ho(ever)? (reads|uses|knows)\b": "name the reader, or the action",
    r"\bfor good\b": "permanently",
    r"pip install '?stereo-vio": "the package is on no index: install from the folder or the wheel",
}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_keeps_its_limit_of_words(name: str) -> None:
    assert _words(name) <= LIMITS.get(name, _ELSE)


def test_all_pages_together_keep_a_limit() -> None:
    assert sum(map(_words, PAGES)) <= ALL_PAGES


def test_limits_are_of_pages_that_exist_and_are_close() -> None:
    """A limit far above its page would let it grow unseen."""
    assert set(LIMITS) <= set(PAGES)
    assert not [name for name, limit in LIMITS.items() if limit > max(3 * _words(name), _ELSE)]


@pytest.mark.parametrize("name", [name for name in PAGES if name not in GENERATED | LATER])
def test_plain_words(name: str) -> None:
    text = _prose(name)
    found = {
        f"{hit.group()!r}: {better}"
        for pattern, better in BANNED.items()
        for hit in re.finditer(pattern, text)
    }
    assert not found


def test_words_are_found_where_prose_has_them_only() -> None:
    code = "```\nexchanged\n```\n`bent` [exchange](exchange.md) $reach$\n"
    assert not any(re.search(pattern, _without_code(code)) for pattern in BANNED)
    prose = "Cameras were exchanged, it is said."
    assert sum(bool(re.search(pattern, prose)) for pattern in BANNED) == 2


@pytest.mark.parametrize("name", [name for name in PAGES if not name.startswith("docs/notes/")])
def test_figures_of_recordings_come_from_their_suite(name: str) -> None:
    """No table but a marked one has errors of recordings that the suite of real ones measures."""
    text = re.sub(r"<!-- suite:.*?<!-- end -->", "", _text(name), flags=re.DOTALL)
    if name in ("docs/faults.md", "docs/fault_draws.md"):
        return  # written by tools.faults
    recordings = _recordings()
    typed = [
        row
        for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
        for row in table.splitlines()[2:]
        if re.search(r"\bATE\b", table.partition("\n")[0])
        and re.match(rf"\|\s*(EuRoC )?({recordings})\b[^|]*\|.*\d", row)
    ]
    assert not typed, "link to docs/results.md, or let tools.results write the table"


def test_every_folder_of_tests_is_described() -> None:
    page = _text("docs/testing.md")
    folders = {path.parent.name for path in (ROOT / "tests").glob("*/test_*.py")}
    assert {name for name in folders if f"`tests/{name}`" not in page} == set()


def test_every_note_names_the_commit_with_its_study() -> None:
    for name in PAGES:
        if name.startswith("docs/notes/"):
            text = _text(name)
            assert f"git show 84261867:{name}" in text, name
            rows = re.findall(r"^\| [^|]+ \| .* \| (.*) \|$", text, re.MULTILINE)
            dated = [row for row in rows if re.fullmatch(r"\d{4}-\d\d-\d\d, `[0-9a-f]{8}`", row)]
            assert len(dated) >= 3, name


def _text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def _words(name: str) -> int:
    text = re.sub(r"\$\$.*?\$\$", "", _text(name), flags=re.DOTALL)
    return sum(1 for word in text.split() if re.search(r"\w", word))


def _prose(name: str) -> str:
    """A page without tables that a tool writes, and without code."""
    written = r"<!-- (suite|table|figure).*?<!-- end"
    return _without_code(re.sub(written, "", _text(name), flags=re.DOTALL))


def _without_code(text: str) -> str:
    text = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"`[^`]*`|\$[^$]+\$", "", text)
    return re.sub(r"\[[^\]]*\]\([^)]*\)", "", text)


def _recordings() -> str:
    """Names by which documents call the recordings of the suite of real ones."""
    facts = read_results().suites["real"]
    keys = {run[0] for run in facts["runs"]}
    numbers = {key.split("_")[1] for key in keys if key.startswith("kitti_")}
    names = [*keys, *(f"KITTI {number}" for number in sorted(numbers)), "MH_01", "Karlsruhe"]
    return "|".join(map(re.escape, names))
