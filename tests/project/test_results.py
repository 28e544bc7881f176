"""The tables and figures of the documents against docs/results.json, and the tool that writes
them.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import tools.results as results
from tests.dataset_makers import make_drive, make_mat, utias_arrays
from tools.results import (
    DOCUMENTS,
    PEERS,
    SUITES,
    Results,
    read_results,
    taken,
    with_figures,
    write_json,
)
from vio.bench.suite import read_suite

ROOT = Path(__file__).resolve().parents[2]
TEXTS = {name: (ROOT / name).read_text(encoding="utf-8") for name in DOCUMENTS}


@pytest.mark.parametrize("name", DOCUMENTS)
def test_documents_say_what_was_measured(name: str) -> None:
    """Every marked table and figure; the command writes them from docs/results.json."""
    assert with_figures(TEXTS[name], read_results()) == TEXTS[name], (
        "python -m tools.results --tables"
    )


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_changed_figure_is_found(name: str) -> None:
    """In a table of any suite, in its line of origin, and in a sentence."""
    known = read_results()
    changed = [
        *(
            re.sub(r"(\| [^|\n]*?)\d", r"\g<1>x", found[0], count=1)
            for found in results._TABLE.finditer(TEXTS[name])
        ),
        *(found[0].replace("Suite", "Suits") for found in results._TABLE.finditer(TEXTS[name])),
        *(found[1] + "0.0" + found[3] for found in results._FIGURE.finditer(TEXTS[name])),
    ]
    assert len(changed) > 1
    for text in changed:
        if "has not been run yet" in text and "Suits" not in text:
            continue
        assert with_figures(text, known) != text


_UTIAS = ("0001", "0005", "0036", "0051", "0020")
_RECORDINGS = {  # of the two filters from images alone: suite, sequence, and their names there
    "KITTI raw 0039": ("drives", "kitti_0039", "paper_images", "window_images"),
    "KITTI odometry 06": ("drives", "kitti_06_head", "paper_images", "window_images"),
    "ECE276A 0027": ("paper", "0027", "recommended_images", "window_images"),
    **{f"UTIAS {n}": ("tracks", f"drive_{n}", "paper_images", "window_images") for n in _UTIAS},
    "UTIAS Starry Night": ("tracks", "starry", "paper_velocity", "window_velocity"),
}


def test_the_results_name_where_the_papers_filter_is_better() -> None:
    """All of these, and no other."""
    known = read_results()
    lost = [
        name
        for name, (suite, sequence, *systems) in _RECORDINGS.items()
        if suite in known.suites
        for paper, window in [
            [float(known.figure(f"{suite}/{sequence}/{s}/ate_m/3")) for s in systems]
        ]
        if paper < window
    ]
    text = " ".join(TEXTS["docs/results.md"].split())
    assert (
        f"on {', '.join(lost[:-1])} and {lost[-1]} the paper's filter is better than the sliding "
        "window" in text
    )


def test_every_table_of_results_is_written_by_a_suite() -> None:
    """A table between no markers would be checked by nobody; those of inputs and of studies say
    where they are from.
    """
    loose = results._ORIGINS.sub("", results._TABLE.sub("", TEXTS["docs/results.md"]))
    heads = re.findall(r"^(\|.*)\n\|[-:| ]+\|$", loose, re.MULTILINE)
    assert heads == [*_STUDIES, "| below VIO_DATA | what it is |"]
    heads = re.findall(
        r"^(\|.*)\n\|[-:| ]+\|$", results._TABLE.sub("", TEXTS["README.md"]), re.MULTILINE
    )
    assert heads == [
        "| sensors | `vio run` | live, Python | live, ROS 2 | map, loops | calibration |",
        "| you are | begin with | then |",
    ]


def test_the_readme_shows_real_recordings_alone_and_no_table_hides_rendered_ones() -> None:
    (table,) = (found[0] for found in results._TABLE.finditer(TEXTS["README.md"]))
    assert table.startswith("<!-- suite: real ")
    suites = read_results().suites
    for name in ("flights", "rendered", "realistic", "maps"):
        sequences = {run[0] for run in suites[name]["runs"]}
        titles = [suites[name]["titles"][sequence] for sequence in sequences]
        assert all("rendered" in title for title in titles), name


def test_a_table_joins_systems_and_states_lengths() -> None:
    runs = [
        ["a", "x", 0, {"ate_m": 0.1, "reference_m": 20.4, "coverage": 1.0}, {}, None, {}],
        ["a", "peer", None, {"ate_m": 0.2, "coverage": 1.0}, {}, None, {}],
        ["b", "x", 0, {"ate_m": 0.3, "reference_m": 7.0, "coverage": 1.0}, {}, None, {}],
        ["b", "other", None, {"ate_m": 0.4, "coverage": 1.0}, {}, None, {}],
    ]
    text = "<!-- suite: paper figure=ate_m length=m systems=x,peer+other -->\n<!-- end -->"
    lines = with_figures(text, _results(runs=runs)).splitlines()
    assert lines[1:5] == [
        "| ATE m | length | x | peer |",
        "|---|---:|---:|---:|",
        "| drive A | 20 m | **0.100** | 0.200 |",
        "| b | 7 m | **0.300** | 0.400 |",
    ]


_STUDIES = (  # measured once: on rigs turned on purpose, and beside Basalt on a quiet machine
    "| right camera turned by | as given | estimated | angle about y found |",
    "|  | CPU | wall | peak MiB |",
)


def test_every_suite_has_a_table_and_is_read() -> None:
    marked = {found[2] for text in TEXTS.values() for found in results._TABLE.finditer(text)}
    assert marked == set(SUITES)
    assert set(PEERS) <= set(SUITES)
    for name, (path, *_) in SUITES.items():
        suite = read_suite(path)
        assert suite.name == name
        names = {*(s.name for s in suite.sequences), *suite.configurations}
        assert not names - set(suite.titles) or name == "rendered", name


def test_results_hold_what_their_suites_run() -> None:
    """A sequence or configuration that was added or renamed is to be measured."""
    for name, facts in read_results().suites.items():
        suite = read_suite(SUITES[name][0])
        runs = {(r[0], r[1]) for r in facts["runs"] if r[2] is not None}
        wanted = {(s.name, c) for s in suite.sequences for c in suite.configurations}
        assert runs == wanted, name


def _results(**more: Any) -> Results:
    runs = [
        ["a", "x", 0, {"ate_m": 0.1234, "coverage": 1.0}, {}, None, {"drift_percent": "too short"}],
        ["a", "x", 1, {"ate_m": 0.1236, "coverage": 1.0}, {}, None, {"drift_percent": "too short"}],
        ["b", "x", 0, {}, {}, "it is corrupt", {}],
        ["a", "peer", None, {"ate_m": 0.05, "coverage": 0.8}, {}, None, {}],
    ]
    facts = {
        "suite": "paper",
        "version": "1",
        "commit": "abc",
        "machine": "2 x Z80",
        "written": "2030-01-02T03:04:05",
    }
    return Results(
        {"paper": {**facts, "packages": {}, "titles": {"a": "drive A"}, "runs": runs, **more}}
    )


def test_tables_and_figures_change_between_the_markers_only() -> None:
    text = "a | 1 |\n<!-- suite: paper figure=ate_m -->\nold\n<!-- end -->\n| 2 |\n"
    text += "it is <!-- figure: paper/a/x/ate_m/2 -->9<!-- end figure --> m"
    new = with_figures(text, _results())
    assert new.startswith("a | 1 |\n<!-- suite: paper figure=ate_m -->\n| ATE m | x | peer |\n")
    assert "| drive A | 0.123 | **0.0500 [80 % of the frames]** |" in new
    assert "| b | failed 1 of 1 | – [1] |" in new
    assert "*Suite `paper`, commit abc, 2030-01-02.*\n<!-- end -->\n| 2 |\n" in new
    assert new.endswith("<!-- figure: paper/a/x/ate_m/2 -->0.12<!-- end figure --> m")
    assert with_figures(new, _results()) == new


def test_a_table_lists_figures_with_the_reason_of_each_dash() -> None:
    text = (
        "<!-- suite: paper figures=ate_m,drift_percent sequences=a systems=peer,x -->\n<!-- end -->"
    )
    lines = with_figures(text, _results()).splitlines()
    assert lines[1] == "| system | ATE m | drift % |"
    assert [line.split("|")[1].strip() for line in lines[3:5]] == ["peer", "x"], (
        "in the order asked for"
    )
    assert lines[6] == "[1] not reported; [2] too short."


def test_a_table_says_how_many_runs_succeeded() -> None:
    known = {"ate_m": 0.1, "coverage": 1.0, "reference_m": 20.0}
    runs = [
        ["a", "x", 0, known, {}, None, {}],
        ["a", "x", 1, {**known, "ate_m": 0.3}, {}, None, {}],
    ]
    text = "<!-- suite: paper figures=ate_m,success -->\n<!-- end -->"
    lines = with_figures(
        text, _results(runs=[*runs, ["a", "x", 2, {}, {}, "lost", {}]])
    ).splitlines()
    assert lines[1] == "| system | ATE m | runs | success |"
    assert lines[3] == "| x | 0.200 ± 0.14, n = 2 | 2 of 3 | 33 % |"


def test_machines_and_versions_are_listed_once() -> None:
    new = with_figures("<!-- origins -->\nold\n<!-- end -->", _results())
    assert "- `paper`: stereo-vio 1, 2 x Z80; " in new
    assert "old" not in new


@pytest.mark.parametrize(
    "words",
    [
        "figure=ate_cm",
        "figures=ate_m figure=ate_m",
        "figure=ate_m systems=z",
        "figure=ate_m colour=red",
        "systems=x",
    ],
)
def test_a_table_that_cannot_be_made_is_named(words: str) -> None:
    with pytest.raises(KeyError, match=r"ate_cm|figure=|no z in suite paper"):
        with_figures(f"<!-- suite: paper {words} -->\n<!-- end -->", _results())
    with pytest.raises(KeyError):
        with_figures("<!-- figure: paper/b/x/ate_m/2 -->0<!-- end figure -->", _results())


def test_the_json_is_written_in_order_and_read_back(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    suites = read_results().suites
    write_json(dict(reversed(suites.items())), tmp_path)
    assert read_results(tmp_path).suites == suites
    changed = {"paper": {**suites["paper"], "commit": "other"}}
    write_json(changed, tmp_path)
    assert read_results(tmp_path).suites == {**suites, **changed}, "what was not measured stays"
    assert (ROOT / results.FIGURES).read_text(encoding="utf-8").count("\n") > len(
        suites["paper"]["runs"]
    )


def test_a_suite_is_run_and_its_figures_are_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From recordings to documents; what fails is kept with its reason, and other documents
    stay.
    """
    data, root = tmp_path / "data", tmp_path / "root"
    (root / "docs").mkdir(parents=True)
    data.mkdir()
    make_mat(data / "drive.mat", utias_arrays(make_drive(20)))
    suite = tmp_path / "paper.yaml"
    configurations = {"window": {"motion": "none"}, "imu": {"motion": "imu"}}
    suite.write_text(
        json.dumps({"sequences": {"0027": "drive.mat"}, "configurations": configurations})
    )
    monkeypatch.setattr(results, "SUITES", {"paper": (str(suite),)})
    monkeypatch.setattr(results, "write_json", lambda suites: write_json(suites, root))
    monkeypatch.setattr(results, "read_results", lambda: read_results(root))
    argv = ["results", "--data", str(data), "--work", str(tmp_path / "work"), "--workers", "1"]
    monkeypatch.setattr(sys, "argv", argv)
    (root / "README.md").write_text("<!-- suite: paper figure=ate_m -->\n<!-- end -->\n")
    (root / "docs" / "results.md").write_text("nothing")
    write = results.write_documents
    monkeypatch.setattr(results, "write_documents", lambda found: write(found, root))
    assert results.main() == 0
    facts = read_results(root).suites["paper"]
    assert {(r[0], r[1], r[5] is None) for r in facts["runs"]} == {
        ("0027", "window", True),
        ("0027", "imu", False),
    }
    assert "| 0027 | 0.0" in (root / "README.md").read_text()
    assert taken(tmp_path / "work" / "paper") == facts


@pytest.mark.parametrize("argv", [[], ["--data", ""], ["--data", "nowhere"]])
def test_without_recordings_it_says_where_to_read(
    argv: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["results", *argv])
    with pytest.raises(SystemExit) as stop:
        results.main()
    assert stop.value.code == 2
    assert "docs/results.md" in capsys.readouterr().err


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_results_hands_on_its_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VIO_DATA", raising=False)
    for given, wanted in (
        ([], '--data "" --work "results"'),
        (
            ["VIO_DATA=my recordings", "WORK=w", "RESULTS=--only paper"],
            '--data "my recordings" --work "w" --only paper',
        ),
    ):
        done = subprocess.run(
            ["make", "-n", "results", *given], cwd=ROOT, capture_output=True, text=True, check=True
        )
        assert done.stdout.rstrip().endswith(f"python -m tools.results {wanted}")


def test_the_command_of_ci_runs_the_small_suite() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(r"^bench:.*\n\t\$\(BIN\)/vio bench small ", makefile, re.MULTILINE)
    assert "make bench" in Path(ROOT / ".ci" / "run").read_text(encoding="utf-8")
