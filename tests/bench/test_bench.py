"""`vio bench`: suites, keys of tasks, tables, whole benches on this machine.

Clusters: tests/bench/test_bench_cluster.py.
"""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.commands import refused, wait_for
from tests.dataset_makers import FRAME_S, make_drive, make_kitti, make_mat, utias_arrays
from vio.bench import execute
from vio.bench.bench import Place, bench, has_succeeded, read_bench
from vio.bench.engines import _check_workers, run_here
from vio.bench.figures import coverage, figures_of, pose_nees
from vio.bench.identity import ROOT, InputDigests, code_and_packages, commit_of, imported_code
from vio.bench.report import _as_html, latex_of, write_bench_report
from vio.bench.revision import _as_yaml
from vio.bench.store import Store
from vio.bench.suite import Suite, config_of, read_suite, shipped_suites, suite_from
from vio.bench.tables import BY_NAME, METRICS, Outcome, cell_text, markdown, number, summary_rows
from vio.bench.tasks import tasks_of
from vio.bench.worker import perform
from vio.cli import main
from vio.datasets import open_dataset
from vio.errors import ConfigError, VioError
from vio.evaluation.trajectories import evaluate
from vio.files.trajectories import read_trajectory, write_tum
from vio.geometry.lie import se3_exp, se3_inverse
from vio.records import Trajectory

ATE = METRICS[0]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives of features with ground truth, and one whose file is cut off."""
    folder = tmp_path_factory.mktemp("recordings")
    for k in range(2):
        make_mat(
            folder / f"drive{k}.mat", utias_arrays(make_drive(14 + 2 * k, seed=k, pixel_sigma=0.3))
        )
    (folder / "corrupt.mat").write_bytes((folder / "drive0.mat").read_bytes()[:3000])
    return folder


_GIVEN: dict[str, Any] = {
    "sequences": {"first": "drive0.mat", "second": "drive1.mat"},
    "configurations": {"images": {"motion": "none"}},
}


_OTHER = {
    "system": "Other",
    "source": "https://example.org/paper",
    "sensors": "stereo",
    "causal": True,
}


def _suite(folder: Path, **values: Any) -> Suite:
    return suite_from({**_GIVEN, **values}, folder / "suite.yaml")


def _keys(
    suite: Suite, data: Path, cache: Path, identity: Any = "content"
) -> dict[tuple[str, str, int | None], str]:
    digests = InputDigests(cache / "inputs.json", identity)
    return {(t.sequence, t.system, t.seed): t.key for t in tasks_of(suite, data, digests)}


# --- suites
# --------------------------------------------------------------------------------------------------


def test_shipped_suites_are_read_by_name() -> None:
    assert set(shipped_suites()) == {"euroc", "kitti", "realistic", "rendered", "small", "tumvi"}
    suites = {name: read_suite(name) for name in shipped_suites()}
    assert len(suites["kitti"].sequences) == len(suites["euroc"].sequences) == 11
    for suite in suites.values():
        names = {sequence.name for sequence in suite.sequences}
        for published in suite.published:
            assert "https://" in published.source, "every published figure names where it stands"
            assert all(
                set(of_sequences) <= {*names, "all"} for of_sequences in published.figures.values()
            )
    assert {p.system.partition(",")[0] for p in suites["euroc"].published} >= {
        "Basalt",
        "ORB-SLAM3",
        "VINS-Fusion",
    }


def test_settings_come_from_configuration_then_sequence_then_seed(tmp_path: Path) -> None:
    sequences = {"one": {"source": "a", "settings": {"msckf.clones": 9}}, "two": "b"}
    configurations = {"c": {"msckf.clones": 11, "msckf": {"max_landmarks": 25}, "motion": "none"}}
    suite = _suite(tmp_path, sequences=sequences, configurations=configurations, seeds=[4])
    one, two = (config_of(suite, sequence, "c", 4) for sequence in suite.sequences)
    assert (one.msckf.clones, two.msckf.clones) == (9, 11)
    assert (one.msckf.max_landmarks, one.motion, one.frontend.consensus.seed) == (25, "none", 4)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sequences": {}}, "no sequences"),
        ({"sequences": {"a b": "x"}}, "'a b' is no name"),
        ({"sequences": {"a": {"source": "x", "render": "--rig small"}}}, "either source or render"),
        ({"sequences": {"a": {"sorce": "x"}}}, "unknown key 'sorce'; did you mean 'source'"),
        ({"sequences": {"a": {"render": "--seed 3"}}}, "--seed is set by the bench"),
        (
            {"sequences": {"a": {"source": "x", "start": "soon"}}},
            "start and stop are frames or times",
        ),
        ({"sequences": {"a": {"source": "x", "lengths_m": [0]}}}, "lengths_m"),
        (
            {"sequences": {"a": {"source": "x", "positions_only": 1}}},
            "positions_only takes true or false",
        ),
        ({"configurations": {"c": {"msckf.clone": 3}}}, "did you mean 'msckf.clones'"),
        ({"configurations": {"c": {"msckf.clones": 1}}}, "msckf.clones"),
        ({"seeds": [1, 1]}, "different whole numbers"),
        ({"seeds": 0}, "different whole numbers"),
        ({"published": [{"system": "X", "ate_m": {"first": 1}}]}, "a system and a source"),
        ({"published": [{**_OTHER, "ate_m": {"first": "1 cm"}}]}, "is a number, got '1 cm'"),
        ({"published": [{**_OTHER, "sensors": None}]}, "needs sensors"),
        (
            {"published": [{**_OTHER, "loops": "some"}]},
            "causal and loops of Other take true, false",
        ),
        (
            {"published": [{**_OTHER, "ate_cm": {"first": 1}}]},
            "unknown 'ate_cm'; figures are ate_m",
        ),
        (
            {"published": [{**_OTHER, "ate_m": {"third": 1}}]},
            "names third, which is no sequence of the suite",
        ),
        ({"time_limit_s": -1}, "time_limit_s is a number above 0"),
        ({"sequence": {}}, "did you mean 'sequences'"),
    ],
)
def test_a_wrong_suite_is_named(values: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)) as error:
        _suite(tmp_path, **values)
    assert "\n" not in str(error.value)


def test_a_suite_that_is_missing_or_no_yaml_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere: no suite.*euroc"):
        read_suite("nowhere")
    (tmp_path / "s.yaml").write_text("sequences: [")
    with pytest.raises(ConfigError, match=r"s\.yaml: not valid YAML"):
        read_suite(str(tmp_path / "s.yaml"))


# --- keys: what a result depends on
# ---------------------------------------------------------------------------------


def test_the_key_follows_content_and_settings_not_names(data: Path, tmp_path: Path) -> None:
    key = _keys(_suite(tmp_path), data, tmp_path)["first", "images", 0]
    moved = tmp_path / "moved"
    shutil.copytree(data, moved)
    renamed = _suite(
        tmp_path, sequences={"other": "drive0.mat"}, configurations={"same": {"motion": "none"}}
    )
    assert _keys(renamed, moved, tmp_path)["other", "same", 0] == key
    changes: list[dict[str, Any]] = [
        {"configurations": {"images": {"motion": "none", "msckf.clones": 12}}},
        {"sequences": {"first": {"source": "drive0.mat", "stop": 9}}},
        {"sequences": {"first": {"source": "drive0.mat", "lengths_m": [5]}}},
        {"sequences": {"first": {"source": "drive1.mat"}}},
        {"sequences": {"first": {"source": "drive0.mat", "reference": "drive1.mat"}}},
    ]
    others = [_keys(_suite(tmp_path, **c), data, tmp_path)["first", "images", 0] for c in changes]
    others.append(_keys(_suite(tmp_path, seeds=[1]), data, tmp_path)["first", "images", 1])
    assert len({key, *others}) == len(changes) + 2
    bytes_of = bytearray((moved / "drive0.mat").read_bytes())
    bytes_of[-1] ^= 1
    (moved / "drive0.mat").write_bytes(bytes_of)
    assert _keys(_suite(tmp_path), moved, tmp_path)["first", "images", 0] != key


def test_other_code_is_another_task(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = _keys(_suite(tmp_path), data, tmp_path)
    monkeypatch.setattr("vio.bench.tasks.code_digest", lambda: "other code")
    assert not set(keys.values()) & set(_keys(_suite(tmp_path), data, tmp_path).values())


def test_content_is_read_once(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Digests are kept with sizes and times of change; identity stat reads no content at all."""
    first = InputDigests(tmp_path / "inputs.json")
    known = first.of(data)
    first.save()

    def never(path: Path) -> str:
        raise AssertionError(path)

    monkeypatch.setattr("vio.bench.identity._digest_file", never)
    assert InputDigests(tmp_path / "inputs.json").of(data) == known
    assert InputDigests(tmp_path / "other.json", "stat").of(data).startswith("stat:")
    os.utime(data / "drive0.mat", ns=(1, 1))
    with pytest.raises(AssertionError):
        InputDigests(tmp_path / "inputs.json").of(data)


def test_a_render_is_known_by_its_arguments_and_files(tmp_path: Path) -> None:
    (tmp_path / "flight.tum").write_text("0 0 0 0 0 0 0 1\n")

    def key(words: str, seed: int = 0, each: bool = False) -> str:
        sequences = {"r": {"render": words, "render_each_seed": each}}
        suite = _suite(tmp_path, sequences=sequences, seeds=[seed])
        (task,) = tasks_of(suite, tmp_path, InputDigests(tmp_path / "inputs.json"))
        return str(task.job["render"]["key"])

    one = key("--trajectory flight.tum")
    assert one == key("--trajectory flight.tum", seed=3), "seed 0 of the render, whatever the run's"
    assert one != key("--trajectory flight.tum", seed=3, each=True)
    assert one != key("--trajectory flight.tum --width 100")
    (tmp_path / "flight.tum").write_text("1 0 0 0 0 0 0 1\n")
    assert one != key("--trajectory flight.tum")


@pytest.mark.parametrize(
    ("root", "later", "loaded"),
    [
        (
            "vio.cli.render",
            ("vio.cli.render", "vio.sim."),
            "vio.sim.export, vio.sim.scenarios, vio.sim.sequence",
        ),
        (
            "vio.bench.worker",
            ("vio.",),
            "vio.runs.pipeline, vio.frontend.klt, vio.filters.msckf, vio.mapping.session",
        ),
    ],
)
def test_all_code_that_a_task_loads_is_in_its_key(
    root: str, later: tuple[str, ...], loaded: str
) -> None:
    """Of our modules, only those of the command line are not; a render does not depend on the
    filters.
    """
    code = (
        f"import sys, vio.cli; before = set(sys.modules); import {root}, {loaded}\n"
        "print(*(m.__file__ for n, m in sys.modules.items() if n.split('.')[0] == 'vio' and n not "
        "in before))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    names = {Path(name).relative_to(ROOT).as_posix() for name in done.stdout.split()}
    known = set(imported_code(root, later))
    assert not {name for name in names - known if not name.startswith("vio/cli/")}
    # readers are loaded by their names
    assert ("vio/datasets/bags/reader.py" in known) == (root == "vio.bench.worker")
    assert ("vio/filters/msckf.py" in known) == (root == "vio.bench.worker")
    assert not {name for name in known if name.startswith(("vio/report/", "vio/inspection/"))}
    assert ("vio/offline/map_adjustment.py" in known) == (root == "vio.bench.worker")


# --- figures
# --------------------------------------------------------------------------------------------------


def test_nees_of_poses_with_errors_of_their_covariance_is_six() -> None:
    rng = np.random.default_rng(0)
    steps = np.array([se3_exp(rng.normal(0, 0.3, 6)) for _ in range(3000)])
    sigma = np.array([0.02, 0.01, 0.03, 0.004, 0.006, 0.002])
    T_true = [np.eye(4)]
    for step in steps:
        T_true.append(T_true[-1] @ step)
    truth = np.array(T_true)
    errors = rng.normal(0, 1, (len(truth), 6)) * sigma
    errors[0] = 0.0  # the filter starts where the reference does
    # T_imu_world = exp(xi) T_imu_world_hat, so T_hat = T_world_imu exp(xi)
    estimate = truth @ np.array([se3_exp(xi) for xi in errors])
    covariances = np.tile(np.diag(sigma**2), (len(truth), 1, 1))
    covariances[0] = 0.0
    T_other_world, T_cam0_imu = (
        se3_exp([5, 1, 2, 0.3, 0.2, 2.0]),
        se3_exp([0.1, 0, 0.2, 1.2, -1.2, 1.2]),
    )
    times_ns = np.arange(len(truth), dtype=np.int64) * 10**8
    reference = Trajectory(T_other_world @ truth @ se3_inverse(T_cam0_imu), times_ns, "cam0")
    score = evaluate(Trajectory(estimate, times_ns, "imu"), reference, T_cam0_imu=T_cam0_imu)
    for scale, expected in ((1, 6.0), (4, 1.5)):
        values = pose_nees(score, estimate, scale * covariances, T_cam0_imu, upright=False)
        assert values.mean() == pytest.approx(expected, rel=0.03)
        # chi-square of 6 degrees of freedom
        assert np.percentile(values, 95) == pytest.approx(12.6 / scale, rel=0.05)
    assert pose_nees(score, estimate, 0 * covariances, T_cam0_imu, upright=False) is None


def test_nees_of_an_upright_world_knows_that_the_first_inclination_was_uncertain() -> None:
    """With an IMU; identified with the first pose, all later poses would seem to have its error."""
    rng = np.random.default_rng(1)
    truth = np.array([se3_exp([0.1 * k, 0.02 * k, 0, 0, 0, 0.01 * k]) for k in range(2000)])
    errors = rng.normal(0, 0.001, (len(truth), 6))
    errors[0] = [0, 0, 0, 0.003, -0.004, 0]
    estimate = se3_exp([3, 4, 5, 0, 0, 2.5]) @ truth @ np.array([se3_exp(xi) for xi in errors])
    covariances = np.tile(1e-6 * np.eye(6), (len(truth), 1, 1))
    times_ns = np.arange(len(truth), dtype=np.int64) * 10**8
    score = evaluate(Trajectory(estimate, times_ns, "imu"), Trajectory(truth, times_ns, "imu"))
    upright, whole = (
        pose_nees(score, estimate, covariances, np.eye(4), upright=flag) for flag in (True, False)
    )
    assert upright.mean() == pytest.approx(6.0, rel=0.05)
    assert whole.mean() > 20


def test_coverage_counts_frames_with_a_pose() -> None:
    frames = np.arange(10, dtype=np.int64) * 50_000_000
    poses = np.tile(np.eye(4), (6, 1, 1))
    assert coverage(frames, Trajectory(poses, frames[4:] + 1000, "imu")) == 0.6
    assert coverage(frames, Trajectory(poses, frames[4:] + 20_000_000, "imu")) == 0.0


def test_positions_alone_give_no_figures_of_orientation() -> None:
    T = np.array([se3_exp([k, 0.1 * k * k, 0, 0, 0, 0.05 * k]) for k in range(30)])
    times_ns = np.arange(30, dtype=np.int64) * 10**8
    score = evaluate(
        Trajectory(T, times_ns, "imu"), Trajectory(T, times_ns, "imu"), lengths_m=[5.0]
    )
    full, bare = (figures_of(score, positions_only=flag) for flag in (False, True))
    assert all(full[name] is not None for name in ("ate_m", "rpe_m", "drift_percent", "ate_deg"))
    assert {name for name, value in bare.items() if value is None} == {
        "ate_deg", "rpe_m", "rpe_deg", "drift_percent", "drift_deg_per_100m"
    }  # fmt: skip


# --- tables
# --------------------------------------------------------------------------------------------------


def outcome(
    sequence: str, system: str, seed: int | None, ate_m: float | None, **more: Any
) -> Outcome:
    """A run with an ATE; None: it failed."""
    failure = "it is corrupt" if ate_m is None else None
    figures = {} if ate_m is None else {"ate_m": ate_m, "coverage": 1.0, **more}
    return Outcome(
        sequence,
        system,
        seed,
        f"{sequence}{system}{seed}",
        figures,
        {"cpu_ms": 20.0},
        failure,
        None,
    )


def test_rows_hold_median_worst_and_spread_over_seeds() -> None:
    rows = summary_rows(
        [outcome("a", "x", seed, value) for seed, value in enumerate([0.3, 0.1, 0.2, None])]
    )
    (row,) = rows
    cell = row.cells["ate_m"]
    assert (cell.median, cell.worst, cell.spread, cell.count) == (0.2, 0.3, pytest.approx(0.2), 3)
    assert (row.runs, row.failed) == (4, 1)
    assert cell_text(cell, ATE, 3) == "0.2 (0.2 ± 0.1)"
    assert cell_text(cell, ATE, row.runs) == "0.2 (0.2 ± 0.1), n = 3"
    covered = summary_rows(
        [outcome("a", "x", s, 0.1, coverage=c) for s, c in enumerate([0.5, 1.0])]
    )[0].cells["coverage"]
    assert covered.worst == 0.5
    assert (
        cell_text(covered, next(m for m in METRICS if m.name == "coverage")) == "0.75 (0.75 ± 0.35)"
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.00123456, "0.00123"), (12345.6, "12300"), (0.0, "0"), (4.2e-6, "0.0000042")],
)
def test_numbers_have_three_digits_and_no_exponent(value: float, text: str) -> None:
    assert number(value, 3) == text


def test_the_table_is_complete_whatever_failed(tmp_path: Path) -> None:
    """Our runs, a failed one, another system, and published figures with their conditions."""
    published = [{**_OTHER, "alignment": "Sim3", "ate_m": {"a": 0.5}}]
    suite = _suite(tmp_path, sequences={"a": "a", "b": "b"}, published=published)
    absent = {"drift_percent": "the way is too short"}
    runs = [
        replace(outcome("a", "x", 0, 0.2), absent=absent, succeeded=True),
        replace(outcome("b", "x", 0, None), succeeded=False),
        outcome("a", "peer|1", None, 0.1, coverage=0.8),
    ]
    text = markdown(
        suite, summary_rows(runs), runs, {"version": "1", "commit": "abc", "packages": {}}
    )
    assert "| ATE m | x | peer\\|1 |" in text
    assert "| a | 0.2 | **0.1 [80 % of the frames]** |" in text
    assert "| b | failed 1 of 1 | – [1] |" in text
    assert "[1] there is no trajectory of this system." in text
    assert "- b, x, seed 0: it is corrupt" in text
    assert (
        "| Other | stereo | yes | Sim3 | ? | 0.5 | 0.5 over 1 | https://example.org/paper |" in text
    )
    assert "[2] the way is too short" in text
    assert "[3] no result: it is corrupt" in text
    assert "| 100 % |" in text
    assert "| 50 % of 2 |" in text, "a run without a result is none below the limit"
    dashes = [
        cell
        for line in text.splitlines()
        if line.startswith("| ")
        for cell in line.split("|")
        if "– [" in cell
    ]
    assert dashes
    page = _as_html(text)
    assert "<td>peer|1</td>" in page
    assert "<b>0.1 [80 % of the frames]</b>" in page
    assert '<a href="https://example.org/paper">' in page
    assert page.count("<tr>") == text.count("\n| ")
    latex = latex_of(text)
    assert latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == page.count("<table>")
    assert r"a & 0.2 & \textbf{0.1 [80 \% of the frames]} \\" in latex
    assert r"ATE m & x & peer|1 \\" in latex


def test_an_undefined_figure_says_why(data: Path, tmp_path: Path) -> None:
    suite = _suite(tmp_path, sequences={"first": {"source": "drive0.mat", "lengths_m": [500]}})
    (task,) = tasks_of(suite, data, InputDigests(tmp_path / "i.json"))
    record = perform({**task.job, "scratch": str(tmp_path)})
    undefined = {
        name
        for name in BY_NAME
        if record["figures"].get(name, record["measured"].get(name)) is None
    }
    assert {"drift_percent", "nees", "nees_95"} <= undefined
    assert {name: record["absent"][name] for name in undefined}
    assert record["absent"]["drift_percent"] == "the path is shorter than the drift's lengths"


@pytest.mark.filterwarnings("error", "ignore::DeprecationWarning")
def test_a_report_of_many_systems_is_drawn(tmp_path: Path) -> None:
    """Their names fit into the figures, which otherwise collapse with a warning."""
    curve = {
        "seconds": [0, 1],
        "error_m": [0, 0.1],
        "quantiles_m": [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
    }
    systems = [f"recommended_seventh_causal_{k}" for k in range(16)]
    runs = [replace(outcome("first", system, 0, 0.2), curve=curve) for system in systems]
    facts = {"version": "1", "packages": {}}
    write_bench_report(tmp_path / "report.html", _suite(tmp_path), summary_rows(runs), runs, facts)
    assert (tmp_path / "report.html").read_text().count("<svg") == 3


def test_success_is_a_small_error_over_most_frames() -> None:
    record = {"failure": None, "figures": {"ate_m": 0.4, "reference_m": 50.0, "coverage": 1.0}}
    assert has_succeeded(record, 1.0) is True
    assert has_succeeded(record, 0.5) is False
    assert (
        has_succeeded({**record, "figures": {**record["figures"], "coverage": 0.5}}, 1.0) is False
    )  # type: ignore[dict-item]
    assert has_succeeded({**record, "figures": {}}, 1.0) is None
    assert has_succeeded({**record, "failure": "lost"}, 1.0) is False


# --- whole benches
# --------------------------------------------------------------------------------------------------


def test_a_damaged_result_is_made_again(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.get("abcd") is None
    store.put("abcd", {"figures": {"ate_m": 0.1 + 0.2}, "failure": None})
    kept = store.get("abcd")
    assert kept["figures"]["ate_m"] == 0.1 + 0.2, "all digits"
    store.path("abcd").write_text('{"figures": ')
    assert store.get("abcd") is None


def test_only_what_has_no_result_is_run(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also after an interruption in the middle; failures of the machine are tried again, those
    of the data are not.
    """
    done: list[str] = []

    def counted(job: dict[str, Any], cache: str) -> dict[str, Any]:
        done.append(job["source"])
        if len(done) == 2:
            raise KeyboardInterrupt
        own = "drive1" in job["source"]
        failure = "the file is damaged" if own else "no space" if len(done) == 3 else None
        return {**execute.failed(failure or "", keep=own or failure is None), "failure": failure}

    def engine(jobs: Any, cache: str, *, workers: int) -> Iterator[tuple[str, Any]]:
        return run_here(jobs, cache, workers=1, perform=counted)

    monkeypatch.setattr("vio.bench.bench.run_here", engine)
    place = Place(data=data, out=tmp_path / "out", cache=tmp_path / "cache")
    assert (data / "drive1.mat").stat().st_size > (data / "drive0.mat").stat().st_size, (
        "the largest is done first"
    )
    suite = _suite(tmp_path, sequences={"b": "drive0.mat", "a": "drive1.mat"})
    (tmp_path / "suite.yaml").write_text(
        json.dumps({**_GIVEN, "sequences": {"b": "drive0.mat", "a": "drive1.mat"}})
    )
    argv = ["bench", str(tmp_path / "suite.yaml"), "--data", str(data), "--out", str(place.out)]
    assert main([*argv, "--cache", str(place.cache)]) == 130
    assert "the same command goes on" in capsys.readouterr().err
    assert [Path(name).name for name in done] == ["drive1.mat", "drive0.mat"]
    result = bench(suite, place)
    assert (result.reused, len(done)) == (1, 3)
    assert [o.failure for o in result.failures] == ["no space", "the file is damaged"]
    result = bench(suite, place)
    assert (result.reused, len(done)) == (1, 4), "a full disk may have been emptied"
    assert [o.failure for o in result.failures] == ["the file is damaged"]
    assert (bench(suite, place).reused, len(done)) == (2, 4)


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_a_bench_that_is_killed_goes_on_where_it_was(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """After kill -9 no process stays, what was done is not repeated, and a run in this process
    gives the same bits.
    """
    sequences = {
        "bad": "corrupt.mat",
        "a": {"source": "drive0.mat", "exact_truth": True},
        "gone": "nothing.mat",
    }
    suite = {"sequences": sequences, "configurations": {"w": {}}}
    (tmp_path / "suite.yaml").write_text(json.dumps(suite))
    argv = [
        "bench",
        str(tmp_path / "suite.yaml"),
        "--data",
        str(data),
        "--out",
        str(tmp_path / "out"),
    ]
    argv += ["--cache", str(tmp_path / "cache"), "--workers", "1", "--quiet"]
    results = tmp_path / "cache" / "results"
    with subprocess.Popen(
        [sys.executable, "-m", "vio", *argv], cwd=ROOT, stderr=subprocess.PIPE
    ) as process:
        wait_for(lambda: len(list(results.glob("*/*.json"))) == 1)
        wait_for(lambda: len(_workers(tmp_path)) == 1)
        os.kill(process.pid, signal.SIGKILL)
    wait_for(lambda: not _workers(tmp_path))
    assert len(list((tmp_path / "cache").glob("task-*"))) == 1, "which the next call removes"
    before = {path: path.stat().st_mtime_ns for path in results.glob("*/*.json")}
    assert len(before) == 1, "the second task was in its middle"
    assert main([*argv, "--json"]) == 1, "two rows have no result"
    printed = capsys.readouterr()
    assert json.loads(printed.out)["reused"] == 1
    assert {path: path.stat().st_mtime_ns for path in before} == before
    outcomes = {o.sequence: o for o in read_bench(tmp_path / "out")[0]}
    assert "corrupt.mat" in (outcomes["bad"].failure or "")
    assert "nothing.mat does not exist" in (outcomes["gone"].failure or "")
    assert printed.err.count("failed: ") == 2
    assert not list((tmp_path / "cache").glob("task-*"))
    _check_files(tmp_path / "out")
    (job,) = [
        t.job
        for t in tasks_of(read_suite(argv[1]), data, InputDigests(tmp_path / "i.json"))
        if t.sequence == "a"
    ]
    assert perform({**job, "scratch": str(tmp_path)})["figures"] == outcomes["a"].figures, (
        "to the bit"
    )


def _workers(folder: Path) -> list[str]:
    """Processes that do a task in a folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            text = path.read_bytes().decode(errors="replace")
        except OSError:
            continue
        if "vio.bench.worker" in text and str(folder) in text:
            found.append(text)
    return found


def _check_files(out: Path) -> None:
    """Tables as CSV, and a report that loads nothing."""
    with (out / "table.csv").open() as stream:
        (row,) = [row for row in csv.DictReader(stream) if row["sequence"] == "a"]
    assert 0 < float(row["ate_m_median"]) < 0.1
    assert float(row["nees_median"]) > 0
    assert float(row["cpu_ms_median"]) > 0
    assert float(row["memory_mib_median"]) > 50
    page = (out / "report.html").read_text()
    assert page.count("<svg") == 3
    assert not re.search(
        r'(?:src|href)="(?!https://example|#)[^"]*\.(?:js|css|png)|<script|@import', page
    )
    poses = read_trajectory(out / "trajectories" / "a.w.0.tum")
    assert poses.frame_indices.tolist() == list(range(14))


def test_another_systems_trajectory_joins_the_table(data: Path, tmp_path: Path) -> None:
    """It is evaluated as our runs are; a part of the recording is a coverage below one, a wrong
    file says why.
    """
    drive = make_drive(14, seed=0, pixel_sigma=0.3)
    suite = _suite(tmp_path, sequences={"first": {"source": "drive0.mat", "lengths_m": [3]}})
    recording = open_dataset(str(data / "drive0.mat")).recording
    peers = tmp_path / "peers"
    peers.mkdir()
    T = se3_exp([1, 2, 3, 0, 0, 1]) @ drive.T_world_imu[4:14]
    T[:, :3, 3] *= 1.02
    write_tum(peers / "first.other_imu.tum", Trajectory(T, recording.frame_times_ns[4:14], "imu"))
    (peers / "first.broken.tum").write_text("1 2 3\n")
    tasks = {
        t.system: t
        for t in tasks_of(suite, data, InputDigests(tmp_path / "i.json"), peers)
        if t.seed is None
    }
    good, broken = (
        perform({**tasks[name].job, "scratch": None}) for name in ("other_imu", "broken")
    )
    assert good["failure"] is None
    assert good["figures"]["coverage"] == pytest.approx(10 / 14)
    assert good["figures"]["drift_percent"] == pytest.approx(2.0, rel=0.15)
    assert "3 columns fit no known format" in broken["failure"]
    with pytest.raises(ConfigError, match=r"no file SEQUENCE\.SYSTEM\.tum"):
        tasks_of(suite, data, InputDigests(tmp_path / "i.json"), tmp_path)


def test_a_worker_with_other_code_says_so(data: Path, tmp_path: Path) -> None:
    (task, _) = tasks_of(_suite(tmp_path), data, InputDigests(tmp_path / "i.json"))
    record = perform({**task.job, "code": "other"})
    assert "has other code than the command that sent the task" in record["failure"]
    assert record["keep"] is False


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals")
def test_a_process_that_is_killed_is_started_again_and_named_at_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[list[str]] = []

    def killed(command: list[str], limit_s: float | None = None) -> tuple[int, str]:
        calls.append(command)
        if len(calls) == 5:
            Path(command[-1], "result.json").write_text(
                '{"figures": {"ate_m": 1}, "failure": null}'
            )
            return 0, ""
        return (-9, "") if len(calls) < 5 else (1, "Traceback\nIndexError: no such row\n")

    monkeypatch.setattr(execute, "_call", killed)
    job = {"render": None}
    record = execute.perform_job(job, str(tmp_path))
    assert len(calls) == 3
    assert record["failure"].startswith("its process was ended by SIGKILL, 3 times; out of memory?")
    record = execute.perform_job(job, str(tmp_path))
    assert (record["lost_processes"], record["figures"]) == (1, {"ate_m": 1})
    record = execute.perform_job(job, str(tmp_path))
    assert record["failure"] == "the program failed, please report it: IndexError: no such row"
    assert record["keep"] is False


def test_what_cannot_be_run_is_named_before_the_first_task(
    data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "truth.tum").write_text("1 2 3\n")
    shutil.copy(data / "drive0.mat", tmp_path)
    make_kitti(tmp_path / "kitti", 6)
    for name in ("T_cam0_imu.txt", "velocity.csv"):
        (tmp_path / "kitti" / name).unlink()
    times_ns = open_dataset(str(data / "drive0.mat")).recording.frame_times_ns
    poses = np.tile(np.eye(4), (14, 1, 1))
    write_tum(tmp_path / "elsewhere.tum", Trajectory(poses, times_ns + 10**15, "imu"))
    write_tum(
        tmp_path / "few.tum", Trajectory(poses, np.r_[times_ns[:2], times_ns[2:] + 10**15], "imu")
    )
    write_tum(
        tmp_path / "imu.tum", Trajectory(poses[:6], np.arange(6) * round(1e9 * FRAME_S), "imu")
    )
    sequences = {
        "gone": "gone.mat",
        "damaged": {"source": "drive0.mat", "reference": "truth.tum"},
        "fine": "drive0.mat",
        "elsewhere": {"source": "drive0.mat", "reference": "elsewhere.tum"},
        "few": {"source": "drive0.mat", "reference": "few.tum"},
        "other_body": {"source": "kitti", "reference": "imu.tum"},
    }
    named: list[str] = []
    ready: list[str] = []

    def run(jobs: Any, cache: str, *, workers: int) -> Any:
        named.extend(
            record.getMessage()
            for record in caplog.records
            if " cannot be run: " in record.getMessage()
        )
        ready.extend(jobs)
        yield from ()

    monkeypatch.setattr("vio.bench.bench.run_here", run)
    result = bench(
        _suite(tmp_path, sequences=sequences), Place(tmp_path, tmp_path / "out", tmp_path / "cache")
    )
    lines = {name: why for name, _, why in (line.partition(" cannot be run: ") for line in named)}
    assert list(lines) == ["gone", "damaged", "elsewhere", "few", "other_body"]
    assert ready == [o.key for o in result.outcomes if o.sequence == "fine"]
    assert "gone.mat does not exist" in lines["gone"]
    assert "3 columns fit no known format" in lines["damaged"]
    assert (
        "is not that of the recording: no poses within 0.01 s of each other" in lines["elsewhere"]
    )
    assert "it has poses of 2 of 14 frames" in lines["few"]
    assert (
        "it describes the IMU, whose place on the rig (T_cam0_imu) the recording does not know"
        in lines["other_body"]
    )
    assert {o.failure for o in result.failures if o.sequence != "fine"} == set(lines.values())


def test_ground_truth_of_another_body_is_doubted(data: Path, tmp_path: Path) -> None:
    """A reference that turns as another body does."""
    runs = [
        replace(outcome("a", "x", seed, 0.2), notes=("the reference looks wrong",))
        for seed in (0, 1)
    ]
    text = markdown(_suite(tmp_path), summary_rows(runs), runs, {"version": "1", "packages": {}})
    assert text.count("- a, x: the reference looks wrong") == 1
    poses = make_drive(14, seed=0, pixel_sigma=0.3).T_world_imu @ se3_exp(
        [0.0, 0.0, 0.0, 1.2, 0.0, 0.0]
    )
    times_ns = open_dataset(str(data / "drive0.mat")).recording.frame_times_ns
    write_tum(tmp_path / "turned.tum", Trajectory(poses, times_ns, "imu"))
    shutil.copy(data / "drive0.mat", tmp_path)
    suite = _suite(tmp_path, sequences={"a": {"source": "drive0.mat", "reference": "turned.tum"}})
    (task,) = tasks_of(suite, tmp_path, InputDigests(tmp_path / "i.json"))
    record = perform({**task.job, "scratch": str(tmp_path)})
    assert record["notes"], record["figures"]


def test_dask_workers_with_other_code_are_named_before_the_first_task() -> None:
    code, packages = code_and_packages()
    jobs = {"k": {"code": code, "packages": packages}}

    class Client:
        def __init__(self, *found: tuple[str, dict[str, str]]) -> None:
            self.found = {f"tcp://10.0.0.{k}:1": facts for k, facts in enumerate(found)}

        def run(self, function: Any) -> Any:
            return self.found

    _check_workers(Client(), jobs)
    _check_workers(Client((code, packages)), jobs)
    with pytest.raises(VioError, match=r"worker tcp://10\.0\.0\.1:1 has other code than"):
        _check_workers(Client((code, packages), ("old", packages)), jobs)
    with pytest.raises(VioError, match=r"other packages \(numpy 1\.0\)"):
        _check_workers(Client((code, {**packages, "numpy": "1.0"})), jobs)


def test_a_task_over_its_time_limit_has_no_result(data: Path, tmp_path: Path) -> None:
    suite = _suite(tmp_path, time_limit_s=0.05)
    (task, _) = tasks_of(suite, data, InputDigests(tmp_path / "i.json"))
    record = execute.perform_job(task.job, str(tmp_path / "cache"))
    assert record["failure"] == "it took longer than the time limit of 0.05 s"
    assert record["keep"] is False
    assert not execute._running


def test_a_dry_run_names_what_is_missing(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "mine.yaml"
    sequences = {
        "here": "drive0.mat",
        "gone": {"source": "utias:gone.mat", "reference": "truth.tum"},
        "flight": {"render": "--trajectory V1_02 --imu=simulated"},
        "room": {"render": "--trajectory handheld"},
    }
    file.write_text(json.dumps({"sequences": sequences, "publisher": "https://example.org/data"}))
    argv = ["bench", str(file), "--data", str(data), "--list"]
    assert main(argv) == 1
    printed = capsys.readouterr().out
    assert f"missing: {data / 'gone.mat'}, {data / 'truth.tum'}" in printed
    assert f"missing: {data / 'V1_02'}" in printed
    assert "https://example.org/data" in printed
    assert main([*argv, "--json", "--only", "here,room"]) == 0
    assert json.loads(capsys.readouterr().out)["missing"] == {}
    assert not (Path.cwd() / "bench" / "mine").exists()


def test_another_revision_runs_in_turns_and_is_compared(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the same code: the figures are equal; the tables of both lie beside each other."""
    if commit_of(ROOT) is None:
        pytest.skip("the code is no git checkout")
    file, out = tmp_path / "mine.yaml", tmp_path / "out"
    # the checkout compiles all loops of the back end anew
    small = {"images": {"motion": "none", "backend": "vislam"}}
    file.write_text(json.dumps({"sequences": {"first": "drive0.mat"}, "configurations": small}))
    argv = [
        "bench",
        str(file),
        "--data",
        str(data),
        "--out",
        str(out),
        "--cache",
        str(tmp_path / "cache"),
    ]
    assert "has no such revision" in refused(capsys, *argv, "--revision", "no-such-revision")
    assert main([*argv, "--revision", "HEAD", "--workers", "1"]) in (0, 1, 3)
    assert "ATE m" in capsys.readouterr().out
    codes = [read_bench(folder)[1]["code"] for folder in (out, tmp_path / "out@HEAD")]
    assert len(codes) == 2
    assert (tmp_path / "out@HEAD" / "tables.md").is_file()


@pytest.mark.parametrize(
    "name", ["realistic", "euroc", str(ROOT / "tools" / "suites" / "maps.yaml")]
)
def test_another_revision_is_given_all_of_the_suite(name: str) -> None:
    suite = replace(read_suite(name), time_limit_s=9.0, success_percent=0.5)
    again = suite_from(_as_yaml(suite), suite.folder / "again.yaml")
    assert (again.sequences, again.time_limit_s, again.seeds) == (suite.sequences, 9.0, suite.seeds)
    assert again.success_percent == 0.5


def test_a_render_that_fails_is_a_failed_row_and_one_that_works_is_made_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[list[str]] = []

    def called(command: list[str], limit_s: float | None = None) -> tuple[int, str]:
        calls.append(command)
        if "render" not in command:
            Path(command[-1], "result.json").write_text('{"figures": {}, "failure": null}')
            return 0, ""
        if "--scene" in command:
            return 1, "error: no such scene; choose room\n"
        Path(command[command.index("--out") + 1]).mkdir()
        return 0, ""

    monkeypatch.setattr(execute, "_call", called)
    wrong = {"render": {"words": ["--scene", "moon"], "key": "0" * 8}}
    right = {"render": {"words": ["--rig", "small"], "key": "1" * 8}}
    assert (
        execute.perform_job(wrong, str(tmp_path))["failure"]
        == "vio render --scene moon: no such scene; choose room"
    )
    for _ in range(2):
        assert execute.perform_job(right, str(tmp_path))["failure"] is None
    assert ["render" in command for command in calls] == [True, True, False, False]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["small", "--workers", "0"], "--workers takes 1 to 1024"),
        (["small", "--seeds", "a"], "--seeds takes whole numbers"),
        (["small", "--only", "rom"], "did you mean 'room'"),
        (["small", "other"], "to compare: vio bench compare"),
        (["compare", "one"], "takes two output folders, or one with --between X Y, got 1"),
        (["compare", "one", "two"], "one: no results"),
    ],
)
def test_wrong_arguments_are_named(
    argv: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message.lower() in refused(capsys, "bench", *argv).lower()


def test_wrong_options_of_a_render_are_named_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "s.yaml").write_text(
        "sequences: {a: {render: --rig small}, b: {render: --rigg small}}\n"
    )
    assert main(["bench", str(tmp_path / "s.yaml"), "--out", str(tmp_path / "out")]) == 1
    assert (
        "s, sequence b: vio render: unrecognized arguments: --rigg small" in capsys.readouterr().err
    )
    assert not (tmp_path / "out").exists()
