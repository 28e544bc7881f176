"""The tables of the documents against docs/results.json, and the tool that measures, on a recording of a second."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numpy as np
import pytest

import tools.result_tables as tables
import tools.results as results
from tests.dataset_makers import make_drive, make_mat, utias_arrays
from tools.result_tables import Figure, Figures, differences, figures_of, read_runs, with_tables
from tools.results import Place, Run, _run, measure, measure_all, write_json
from vio.datasets import open_dataset
from vio.datasets.observation_log import write_observation_log
from vio.records import Observations, Recording, VelocitySample, observations

ROOT = Path(__file__).resolve().parent.parent


def test_documents_say_what_was_measured() -> None:
    """Every number of every marked table, and the sentences that repeat one."""
    assert list(differences(figures_of(read_runs()))) == []


def test_every_table_stands_in_a_document() -> None:
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in tables.DOCUMENTS]
    marked = re.findall(r"<!-- table: (\w+) -->", "".join(texts))
    assert sorted(marked) == sorted(tables.TABLES)
    assert sum(text.count("<!-- end -->") for text in texts) == len(marked)


def test_every_run_stands_in_the_json_with_its_command() -> None:
    commands = {name: facts["command"] for name, facts in read_runs().items()}
    assert commands == {run.name: run.command for run in results.all_runs()}


def test_a_changed_number_is_found(tmp_path: Path) -> None:
    """In a table and in a sentence."""
    (tmp_path / "docs").mkdir()
    for name in tables.DOCUMENTS:
        text = (ROOT / name).read_text(encoding="utf-8")
        (tmp_path / name).write_text(text, encoding="utf-8")
    figures = figures_of(read_runs())
    assert list(differences(figures, tmp_path)) == []
    document, sentence = next(iter(tables.sentences(figures)))
    path = tmp_path / document
    text = path.read_text(encoding="utf-8")
    cell = figures.tell("paper", "dead reckoning: t_percent")
    path.write_text(text.replace(sentence, "").replace(f"| {cell} |", "| 0.01 |"), encoding="utf-8")
    assert [d.partition(":")[2].split()[0] for d in differences(figures, tmp_path)] == ["table", "the"]


def test_tables_change_between_the_markers_only() -> None:
    figures = figures_of(read_runs())
    text = "a | 1 |\n<!-- table: still -->\n| old |\n<!-- end -->\n| 2 | b\n<!-- end -->"
    new = with_tables(text, figures)
    assert new.startswith("a | 1 |\n<!-- table: still -->\n| a minute at rest |")
    assert new.endswith("<!-- end -->\n| 2 | b\n<!-- end -->")
    assert "old" not in new
    assert with_tables(new, figures) == new


def test_a_figure_that_was_not_measured_is_named() -> None:
    with pytest.raises(KeyError, match="no figure ate_m of still/none"):
        Figures({"still/none": {"ate_mm": Figure(0.2, 2)}}).at("still/none", "ate_m")


def test_the_smallest_is_bold() -> None:
    assert tables._best(["1.20 m", "–", "0.9 (0.8, 1.0)", "0.90"]) == ["1.20 m", "–", "**0.9 (0.8, 1.0)**", "**0.90**"]


def test_figures_are_compared_as_printed() -> None:
    def runs(**figures: list[float]) -> dict[str, Any]:
        return {"run": {"command": "", "figures": figures}}

    known = runs(a=[1.204, 2], b=[1.204, 2])
    assert list(results.changes(runs(a=[1.196, 2], b=[1.204, 2]), known, 0.0)) == []
    assert list(results.changes(runs(a=[1.194, 2], b=[1.2, 2]), known, 0.0)) == [
        "run: a is 1.19 here and 1.20 in docs/results.json"
    ]
    assert list(results.changes(runs(a=[1.194, 2], b=[1.2, 2]), known, 0.01)) == []
    assert len(list(results.changes(runs(a=[1.3, 2]), known, 0.01))) == 2, "one has changed, one is missing"


# --- measuring, on recordings of a second ---------------------------------------------------------------------------


@pytest.fixture
def place(tmp_path: Path) -> Place:
    (tmp_path / "data").mkdir()
    make_mat(tmp_path / "data" / "drive.mat", utias_arrays(make_drive(20)))
    return Place(tmp_path / "data", tmp_path / "work")


def test_a_run_gives_its_figures(place: Place) -> None:
    positions = make_drive(20).T_world_imu[:, :3, 3]
    figures = measure(Run("drive", "vio run drive.mat --lengths 5", _run), place)
    assert (figures["frames"], figures["length_m"].digits) == (Figure(20, 0), 0)
    assert figures["length_m"].value == pytest.approx(
        np.linalg.norm(np.diff(positions, axis=0), axis=1).sum(), rel=1e-4
    )
    assert figures["ate_m"].value < figures["dead_reckoning_ate_m"].value < 0.1
    assert figures["t_percent"].value == figures["t_percent_5m"].value
    with pytest.raises(SystemExit, match=r"nothing\.mat.* does not exist"):
        measure(Run("wrong", "vio run nothing.mat", _run), place)


def test_runs_are_kept_and_not_repeated(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """An interrupted call goes on where it stopped; other code is measured anew."""
    asked: list[str] = []

    def counted(run: Run, _: Place) -> dict[str, Figure]:
        asked.append(run.name)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return {"ate_m": Figure(0.125, 2)}

    monkeypatch.setattr(results, "measure", counted)
    runs = [Run(name, f"vio run {name}", _run) for name in ("one", "two")]
    with pytest.raises(KeyboardInterrupt):
        measure_all(runs, place)
    measured = measure_all(runs, place)
    assert asked == ["one", "two", "two"]
    assert measured["one"] == {"command": "vio run one", "figures": {"ate_m": [0.125, 2]}}
    measure_all([Run("one", "vio run one --motion none", _run)], place)
    assert asked[3:] == ["one"], "another command is another run"
    monkeypatch.setattr(results, "_code", lambda: "other")
    assert measure_all(runs, place) == measured
    assert asked[4:] == ["one", "two"]


def test_a_run_that_diverges_tells_where(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its frame is the figure; a run that was expected to diverge and does not is told, not taken."""
    with pytest.raises(SystemExit, match="was expected to diverge and did not"):
        measure(Run("calm", "vio run drive.mat", _run, diverges=True), place)
    lost = CompletedProcess([], 1, "", "WARNING: no features\nerror: msckf diverged at frame 130: too few features\n")
    monkeypatch.setattr(Place, "call", lambda self, command: lost)
    assert measure(Run("lost", "vio run drive.mat", _run, diverges=True), place) == {
        "diverged_at_frame": Figure(130, 0)
    }
    with pytest.raises(SystemExit, match="diverged at frame 130"):
        measure(Run("lost", "vio run drive.mat", _run), place)


def test_the_json_is_written_in_order_and_read_back(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    runs = read_runs()
    names = list(runs)
    write_json({name: runs[name] for name in reversed(names)}, tmp_path)
    assert list(read_runs(tmp_path)) == names
    changed = {names[0]: {**runs[names[0]], "command": "other"}}
    write_json(changed, tmp_path)
    assert read_runs(tmp_path) == {**runs, **changed}, "what was not measured stays"


def test_flights_are_rendered_once(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def rendered(self: Place, command: str) -> CompletedProcess[str]:
        asked.append(command)
        (self.work / "still").mkdir()
        return CompletedProcess([], 0, "", "")

    monkeypatch.setattr(Place, "call", rendered)
    place.work.mkdir()
    results._render(place, "still")
    results._render(place, "still")
    assert asked == [results._RENDERS["still"]]
    assert len((place.work / "still.tum").read_text(encoding="utf-8").splitlines()) == 620
    monkeypatch.setitem(results._RENDERS, "still", "vio render --seed 1 --out WORK/still")
    with pytest.raises(SystemExit, match="was not made by 'vio render --seed 1"):
        results._render(place, "still")


def _log(place: Place, name: str, recording: Recording) -> Path:
    """A log that shows the same three features in every frame of a recording."""
    seen = [observations(k, int(t), [1, 2, 3], [[10, 5, 8, 5]] * 3) for k, t in enumerate(recording.frame_times_ns)]
    path = place.work / "runs" / name / "observations.npz"
    path.parent.mkdir(parents=True)
    write_observation_log(path, recording, seen, [])
    return path


def test_gaps_are_what_they_are_said_to_be(place: Place) -> None:
    recording = open_dataset(str(place.data / "drive.mat")).recording
    times_ns = np.arange(850, dtype=np.int64) * 50_000_000
    _log(place, "flights_f_imu", replace(recording, frame_times_ns=times_ns, reference=None))
    for kind in ("blackout", "sparse"):
        results._gap(place, "f", "imu", kind)
    logs = {kind: open_dataset(str(place.work / "logs" / f"f_imu_{kind}.npz")) for kind in ("blackout", "sparse")}
    ids = {kind: [_ids(log.observations(k)) for k in range(850)] for kind, log in logs.items()}
    dark = [k for k, seen in enumerate(ids["blackout"]) if not seen]
    assert dark == list(range(800, 840)), "two seconds at 20 Hz"
    assert not set(ids["blackout"][799]) & set(ids["blackout"][840]), "what is seen later is new"
    assert ids["blackout"][840] == ids["blackout"][849]
    assert [k for k, seen in enumerate(ids["sparse"]) if not seen] == list(range(50, 850, 100))
    assert ids["sparse"][49] == ids["sparse"][51], "tracks go on"


def _ids(seen: Observations | None) -> list[int]:
    assert seen is not None
    return seen.ids.tolist()


def test_noisy_velocities_are_the_papers(place: Place) -> None:
    """Always the same for one seed, with the paper's standard deviations, and the images' features as they were."""
    long = make_mat(place.data / "long.mat", utias_arrays(make_drive(100)))
    log = _log(place, "drives_long.mat_window_none", open_dataset(str(long)).recording)
    for seed in (0, 1):
        results._noisy(place, "long.mat", seed)
    given, zero, one = (
        np.array([[*s.linear, *s.angular] for s in open_dataset(str(p)).events() if isinstance(s, VelocitySample)])
        for p in (place.data / "long.mat", *(place.work / "logs" / f"long.mat_noise{seed}.npz" for seed in (0, 1)))
    )
    noise = zero - given
    assert noise[:, :3].std() == pytest.approx(0.5, rel=0.1)
    assert noise[:, 3:].std() == pytest.approx(0.05, rel=0.1)
    assert np.abs(zero - one).max() > 0.1
    results._noisy(place, "long.mat", 0)
    noisy = open_dataset(str(place.work / "logs" / "long.mat_noise0.npz"))
    assert np.array_equal([[*s.linear, *s.angular] for s in noisy.events() if isinstance(s, VelocitySample)], zero)
    assert _ids(noisy.observations(7)) == _ids(open_dataset(str(log)).observations(7))


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
        (["VIO_DATA=my recordings", "WORK=w", "RESULTS=--check"], '--data "my recordings" --work "w" --check'),
    ):
        done = subprocess.run(["make", "-n", "results", *given], cwd=ROOT, capture_output=True, text=True, check=True)
        assert done.stdout.rstrip().endswith(f"python -m tools.results {wanted}")
