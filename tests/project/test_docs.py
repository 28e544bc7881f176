"""The documentation's commands and Python blocks run, and all that they name exists.

The commands of the README, of the page on installing and of that on commands run word for word
in a folder where every path that they name exists, small. A line added there therefore fails here
unless it works, and a line that is too long for a test needs an entry in `_SMALLER` or
`_ELSEWHERE`.
"""

from __future__ import annotations

import argparse
import logging
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

import vio.sim.scenarios
from tests.dataset_makers import T_CAM0_IMU, ece276a_arrays, make_drive, make_npz
from tools.bad_inputs import PAGE
from tools.site_hooks import _apart
from vio.cli import build_parser, main
from vio.cli.arguments import config_from
from vio.cli.render import scenario_from
from vio.config import Config, describe, merge
from vio.geometry.lie import se3_inverse
from vio.records import ImuSample, StereoFrame

ROOT = Path(__file__).resolve().parents[2]
README = "README.md"
COMMANDS = "docs/commands.md"
INSTALL = "docs/install.md"
EXECUTED = (README, INSTALL, COMMANDS)
DOCS = (
    README,
    "CHANGELOG.md",
    *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))),
)
GENERATED = {ROOT / "docs" / PAGE}  # of the site, and in no folder
_OF_COMMANDS = (
    *DOCS,
    "CONTRIBUTING.md",
    "vio/course/README.md",
    *(
        path.relative_to(ROOT).as_posix()
        for folder in ("tutorials", "notes")
        for path in sorted((ROOT / "docs" / folder).glob("*.md"))
    ),
)
NOTES = tuple(f"docs/notes/{path.name}" for path in sorted((ROOT / "docs" / "notes").glob("*.md")))

# Options behind a command of the README that make it small; the command itself is run as written.
_SMALLER = {
    "vio render --scene room --trajectory handheld --duration 10 --out room": "--duration 0.2 "
    "--rig small --width 200",
    "vio calibrate FOLDER": "--pairs 3",
    "vio check RUN": "--keyframes 4",
    "vio run FOLDER --map yard.map": "--stop 20",
}


def _make(target: str) -> list[str]:
    """What `make TARGET` would do, line by line."""
    if shutil.which("make") is None:
        pytest.skip("needs make")
    argv = ["make", "--dry-run", "--always-make", target]
    return subprocess.run(
        argv, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()


def _make_demo() -> None:
    """The environment, then the command that `readme_folder` has run."""
    lines = _make("demo")
    (demo,) = (k for k, line in enumerate(lines) if line.endswith("/vio demo --out demo"))
    before = lines[:demo]
    assert any("-m venv" in line for line in before)
    assert any("pip install" in line and line.endswith("-e . setuptools") for line in before)
    assert not any("tools.prebuild" in line for line in before)
    assert any("tools.prebuild" in line for line in lines[demo:]), "all other loops come after it"


def _make_quick() -> None:
    """Tests that exist."""
    recipe = _make("quick")[-1]
    files = re.findall(r"tests/[\w/]+\.py", recipe)
    assert "-m pytest" in recipe
    assert len(files) > 10
    assert all((ROOT / file).is_file() for file in files)


def _make_test() -> None:
    """Style, types, tests."""
    recipe = "\n".join(_make("test"))
    for part in ("pip install", "ruff check .", "ruff format --check .", "/mypy", "-m pytest"):
        assert part in recipe


def _installs() -> None:
    """What is installed exists: the project here, the wheel's name with the present version, the
    extras.
    """
    for command in (command for command in _commands(INSTALL) if "-m pip install" in command):
        target = shlex.split(command)[4]
        if target.endswith(".whl"):
            assert target == f"stereo_vio-{vio.__version__}-py3-none-any.whl"
    table = re.findall(
        r"^\| `(\w+)` \|",
        _text(INSTALL).partition("## Extras")[2].partition("\n## ")[0],
        re.MULTILINE,
    )
    declared = (
        _text("pyproject.toml").partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    )
    assert sorted(table) == sorted(re.findall(r"^(\w+) = \[", declared, re.MULTILINE))


def _vio_demo() -> None:
    """What `readme_folder` has run, smaller: here it would take the place of that recording."""
    assert build_parser().parse_args(["demo"]).out == Path("demo")


def _docker() -> None:
    """The image is built from this folder, and its default command is the demo with results in
    the mounted folder.
    """
    assert 'CMD ["demo", "--out", "/data/demo"]' in _text("Dockerfile")


# Commands of the README that are no `vio …`, and what is tested of them here.
_ELSEWHERE: dict[str, Callable[[], None]] = {
    "python -m pip install .": _installs,
    "python -m pip install stereo_vio-0.3.0-py3-none-any.whl": _installs,
    "docker build -t stereo-vio .": _docker,
    'docker run --rm -v "$PWD/out:/data" stereo-vio': _docker,
    "make demo": _make_demo,
    "vio demo": _vio_demo,
    "make quick": _make_quick,
    "make test": _make_test,
}


# --- contents of the documents
# --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Block:
    """A block of code."""

    language: str  # of the fence; empty for a plain fence or an indented block
    line: int  # of its first line, from 0
    text: str


def _text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def _blocks(name: str) -> Iterator[_Block]:
    """Yield fenced blocks, and indented ones between empty lines."""
    text = _text(name)
    for found in re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        yield _Block(found.group(1), text[: found.start(2)].count("\n"), found.group(2))
    without = re.sub(
        r"^```.*?^```$",
        lambda m: "\n" * m.group().count("\n"),
        text,
        flags=re.DOTALL | re.MULTILINE,
    )
    for found in re.finditer(r"(?<=\n\n)((?: {4}\S.*\n)+)(?=\n)", without):
        yield _Block(
            "",
            without[: found.start()].count("\n"),
            re.sub(r"^ {4}", "", found.group(), flags=re.MULTILINE),
        )


def _python(name: str) -> list[_Block]:
    return [block for block in _blocks(name) if block.language == "python"]


def _commands(name: str) -> list[str]:
    """Every command line of a document's blocks, without its comment; `a ; b` are two."""
    lines = [
        line
        for block in _blocks(name)
        if block.language in ("", "bash", "sh")
        for line in block.text.splitlines()
    ]
    bare = (re.sub(r"\s+# .*", "", line) for line in lines)
    return [
        part.strip()
        for line in bare
        for part in line.split(" ; ")
        if re.match(r"(vio|make|python|docker)\b", part)
    ]


def _snippets(name: str) -> list[str]:
    """Inline code outside blocks."""
    text = re.sub(r"^```.*?^```$", "", _text(name), flags=re.DOTALL | re.MULTILINE)
    return [" ".join(found.split()) for found in re.findall(r"`([^`]+)`", text)]


# --- the README, executed
# -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def readme_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with everything that the README's commands name: a short drive, a short flight, a
    course file, runs.
    """
    root = tmp_path_factory.mktemp("readme_folder")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        # A second of the demo's drive instead of fourteen; otherwise it is the demo.
        patch.setattr(vio.sim.scenarios, "_DURATION_S", 1.2)
        patch.setattr(vio.sim.scenarios, "_WIDTH_PX", 400)
        assert main(["demo", "--out", "demo"]) == 0
        flight = "vio render --rig euroc --width 320 --duration 0.5 --workers 1 --out path/to/MH_03_medium"
        assert main(shlex.split(flight)[1:]) == 0
        drive = Path("demo/street")
        sequence = Path("path/to/sequences/07")
        sequence.mkdir(parents=True)
        Path("path/to/poses").mkdir()
        # as KITTI publishes it: no motion, no extrinsics
        for part in ("image_0", "image_1", "calib.txt", "times.txt"):
            Path(sequence / part).symlink_to((drive / part).resolve())
        shutil.copy(drive / "poses.txt", "path/to/poses/07.txt")
        Path("path/to/folder").symlink_to(drive.resolve())
        Path("FOLDER").symlink_to(drive.resolve())
        shutil.copy(drive / "poses.txt", "poses.txt")
        shutil.copy(drive / "poses.txt", "truth.txt")
        course = make_drive(25)
        make_npz(Path("0027.npz"), ece276a_arrays(course))
        cam0 = course.T_world_imu @ se3_inverse(T_CAM0_IMU)
        np.savetxt("poses_07.txt", (se3_inverse(cam0[0]) @ cam0)[:, :3].reshape(-1, 12))
        assert main(["run", "FOLDER", "--save-observations", "--out", "RUN"]) == 0
        # of the lines before; made here so that each test runs alone
        shutil.copytree("RUN", "results")
        shutil.copytree("RUN", "first")
        shutil.copytree("RUN", "runs/folder")
    return root


@pytest.mark.parametrize("command", dict.fromkeys(c for name in EXECUTED for c in _commands(name)))
def test_readme_commands_run(
    command: str,
    readme_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.chdir(readme_folder)
    program, *argv = shlex.split(f"{command} {_SMALLER.get(command, '')}")
    if program == "vio" and command not in _ELSEWHERE:
        assert main(argv) == 0
        complaints = [r.getMessage() for r in caplog.records if "not used" in r.getMessage()]
        assert not complaints, "the reference that the README gives does not fit"
    else:
        assert command in _ELSEWHERE, f"no test runs '{command}': add it to _ELSEWHERE with one"
        _ELSEWHERE[command]()


def test_exception_entries_are_in_the_readme() -> None:
    assert set(_SMALLER) | set(_ELSEWHERE) <= {c for name in EXECUTED for c in _commands(name)}


def test_readme_blocks_hold_commands_or_the_demos_output() -> None:
    """Every line is either a command, tested above, or output of the demo."""
    commands = [*_commands(README), *_commands(INSTALL)]
    plain = [
        block.text
        for name in (README, INSTALL)
        for block in _blocks(name)
        if block.language not in ("python", "bibtex")
    ]
    outputs = [text for text in plain if text.startswith("frames ")]
    lines = [line for text in plain if text not in outputs for line in text.splitlines()]
    assert len(outputs) == 1
    assert all(any(line.startswith(command) for command in commands) for line in lines), lines


def test_readme_shows_what_the_demo_prints(
    readme_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Line by line, numbers apart; the small demo is too short for the line `drift`."""
    from vio.cli.output import print_result
    from vio.cli.running import metric_rows

    monkeypatch.chdir(readme_folder)
    metrics = yaml.safe_load((readme_folder / "demo/run/metrics.json").read_text(encoding="utf-8"))
    shown_drift = {
        "start_s": 0.0,
        "t_err_percent": 0.05,
        "r_err_deg_per_100m": 0.039,
        "drift_lengths_m": [100],
    }
    print_result({}, metric_rows({**metrics, **shown_drift}), as_json=False)
    shown = next(block.text for block in _blocks(INSTALL) if block.text.startswith("frames "))
    printed, shown = (
        re.sub(r"[+-]?[\d.]+\d( m?m\b)?", "#", text) for text in (capsys.readouterr().out, shown)
    )
    assert printed == shown


def test_readme_python_runs(
    readme_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(readme_folder)
    (block,) = _python(README)
    _execute(README, block, {})
    printed = re.search(r"ATE (\d\.\d+) m over (\d+\.\d) m", capsys.readouterr().out)
    assert float(printed.group(1)) < 0.1
    assert float(printed.group(2)) > 5


def test_live_use_runs(
    readme_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(readme_folder)
    scope: dict[str, object] = {}
    for block in _python("docs/live.md"):
        _execute("docs/live.md", block, scope)
        assert len(capsys.readouterr().out.splitlines()) > 5


def test_the_output_files_of_a_run_exist(readme_folder: Path) -> None:
    text = _text(COMMANDS).partition("## Output of a run")[2].partition("```")[0]
    named = set(re.findall(r"`(\w+\.\w+)`", text))
    assert len(named) > 5
    assert named <= {path.name for path in (readme_folder / "RUN").iterdir()}


# --- Python blocks of the other documents
# ---------------------------------------------------------------------------


def _execute(name: str, block: _Block, scope: dict[str, object]) -> None:
    # so that a failure names its line
    exec(compile("\n" * block.line + block.text, name, "exec"), scope)


@pytest.fixture(scope="module")
def simulation() -> dict[str, object]:
    """What the example of docs/simulation.md leaves behind."""
    scope: dict[str, object] = {}
    _execute("docs/simulation.md", _python("docs/simulation.md")[0], scope)
    return scope


def test_conventions_run() -> None:
    scope: dict[str, object] = {}
    for block in _python("docs/conventions.md"):
        _execute("docs/conventions.md", block, scope)


def test_simulation_example_runs(simulation: dict[str, object]) -> None:
    assert len(simulation["seen"].ids) > 90  # type: ignore[attr-defined]
    assert simulation["in_right"].shape == (2, 2)  # type: ignore[attr-defined]
    assert np.asarray(simulation["visible"]).all()
    assert simulation["left"].shape == (180, 320)  # type: ignore[attr-defined]


def test_inertial_check_runs(
    simulation: dict[str, object], caplog: pytest.LogCaptureFixture
) -> None:
    from vio.monitor.inertial import InertialCheck

    dataset, oracle = simulation["recording"], simulation["oracle"]
    events = list(dataset.events(images=False))  # type: ignore[attr-defined]
    frame = next(event for event in events if isinstance(event, StereoFrame))
    scope: dict[str, object] = {
        "InertialCheck": InertialCheck,
        "camera": dataset.recording.camera,  # type: ignore[attr-defined]
        "T_cam0_imu": dataset.recording.T_cam0_imu,  # type: ignore[attr-defined]
        "sample": next(event for event in events if isinstance(event, ImuSample)),
        "seen": oracle.process(frame).observations,  # type: ignore[attr-defined]
        "log": logging.getLogger("doc"),
    }
    (block,) = _python("docs/inertial.md")
    _execute("docs/inertial.md", block, scope)
    assert not caplog.records


def test_client_of_a_served_map_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The names are those of an answer; `test_map_service` asks a server."""
    from vio.mapping.lookup import FoundPose

    images = np.zeros((2, 20, 30), dtype=np.uint8)
    found = FoundPose(np.eye(4), np.eye(6), 80, 3)
    monkeypatch.setattr("vio.live.map_service.ask", lambda url, left, right: found)
    scope: dict[str, object] = {"left": images[0], "right": images[1]}
    (block,) = _python("docs/maps.md")
    _execute("docs/maps.md", block, scope)
    assert scope["found"] is found


def test_every_python_block_is_run_by_one_of_the_tests_above() -> None:
    counts = {name: len(_python(name)) for name in DOCS}
    tested = {
        README: 1,
        "docs/live.md": 1,
        "docs/simulation.md": 1,
        "docs/inertial.md": 1,
        "docs/maps.md": 1,
    }
    tested["docs/conventions.md"] = 8
    assert {name: count for name, count in counts.items() if count} == tested


# --- what the documents name exists
# ---------------------------------------------------------------------------------


def _subcommands() -> dict[str, argparse.ArgumentParser]:
    parser = build_parser()
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return dict(commands.choices)


_ALL_COMMANDS = [(name, command) for name in _OF_COMMANDS for command in _commands(name)]
_SETTINGS = {row.key for row in describe(Config())}


@pytest.mark.parametrize(("name", "command"), [c for c in _ALL_COMMANDS if c[1].startswith("vio ")])
def test_commands_of_the_docs_parse(name: str, command: str) -> None:
    """Options exist, and every `--set` names a setting and a value that it takes."""
    args = build_parser().parse_args(shlex.split(command)[1:])
    if args.command == "render":
        if not (args.trajectory in ("handheld", "car") or Path(args.trajectory).exists()):
            args.trajectory = "handheld"  # a placeholder of the document
        scenario_from(args)
    elif hasattr(args, "set"):
        config_from(args)


@pytest.mark.parametrize(
    ("name", "command"), [c for c in _ALL_COMMANDS if c[1].startswith("make ")]
)
def test_make_of_the_docs_knows_its_targets_and_variables(name: str, command: str) -> None:
    _, target, *assignments = shlex.split(command)
    makefile = _text("Makefile")
    assert re.search(rf"^{target}:", makefile, re.MULTILINE)
    for assignment in assignments:
        assert re.search(rf"^{assignment.partition('=')[0]} \?=", makefile, re.MULTILINE), (
            assignment
        )


_TOOL = re.compile(r"python (?:-m (tools[.\w]+)|(tools/\w+)\.py)(.*)")
_TOOL_CALLS = [
    (name, found)
    for name in _OF_COMMANDS
    for command in (*_commands(name), *_snippets(name))
    if (found := _TOOL.fullmatch(command))
]


@pytest.mark.parametrize(("name", "call"), _TOOL_CALLS, ids=lambda value: str(value)[-60:])
def test_tools_of_the_docs_take_their_options(name: str, call: re.Match[str]) -> None:
    """The module exists, and its source names the options."""
    tool = ROOT / (call[1] or call[2]).replace(".", "/")
    file = tool / "__main__.py" if tool.is_dir() else tool.with_suffix(".py")
    source = file.read_text(encoding="utf-8")
    options = [word for word in shlex.split(call[3]) if word.startswith("--")]
    assert [option for option in options if f'"{option}"' not in source] == []


def test_the_docs_name_tools() -> None:
    assert len(_TOOL_CALLS) >= 10


def test_every_dependency_has_its_row() -> None:
    tomllib = pytest.importorskip("tomllib", reason="part of Python 3.11")
    project = tomllib.loads(_text("pyproject.toml"))["project"]
    declared = [
        *project["dependencies"],
        *(r for extra in project["optional-dependencies"].values() for r in extra),
    ]
    plain = [requirement.partition(";")[0].strip() for requirement in declared]
    rows = re.findall(
        r"^\| ([\w-]+) \| ([<>=][^|]*) \|", _text("docs/dependencies.md"), re.MULTILINE
    )
    assert sorted("".join(row) for row in rows) == sorted(set(plain))


@pytest.mark.parametrize("name", _OF_COMMANDS)
def test_inline_code_names_what_exists(name: str) -> None:
    """Subcommands with their options, settings, files, tools with their options, make's targets."""
    commands = _subcommands()
    sections = {key.rpartition(".")[0] for key in _SETTINGS} - {""}
    wrong = []
    for code in _snippets(name):
        words = code.split()
        if words[0] == "vio" and len(words) > 1:
            known = commands.get(words[1])
            options = (
                []
                if known is None
                else [o for action in known._actions for o in action.option_strings]
            )
            if known is None or any(
                word.startswith("--") and word not in options for word in words
            ):
                wrong.append(code)
        elif words[0] == "python" and len(words) > 1 and words[1].startswith("tools/"):
            source = (
                (ROOT / words[1]).read_text(encoding="utf-8") if (ROOT / words[1]).is_file() else ""
            )
            if (
                any(f'"{option}"' not in source for option in re.findall(r"--[\w-]+", code))
                or not source
            ):
                wrong.append(code)
        elif words[0] == "make":
            if not re.search(rf"^{words[1]}:", _text("Makefile"), re.MULTILINE):
                wrong.append(code)
        elif found := re.fullmatch(
            r"(?:--set )?((?:frontend|selector|vislam|msckf|dataset)(?:\.[a-z]\w*)+)(?:[=:].*)?",
            code,
        ):
            is_module = (ROOT / (found.group(1).replace(".", "/") + ".py")).is_file()
            if found.group(1) not in _SETTINGS | sections and not is_module:
                wrong.append(code)
        elif found := re.fullmatch(
            r"((?:vio|frontend|tools|tests|docs|configs)/[\w./]*)(?:::\w+)?", code
        ):
            if not (ROOT / found.group(1)).exists():
                wrong.append(code)
        elif (found := re.fullmatch(r"(\w+): \S+", code)) and found.group(1) not in {
            key.rpartition(".")[2] for key in _SETTINGS
        }:
            wrong.append(code)
    assert not wrong


@pytest.mark.parametrize(
    "name", [name for name in DOCS if any(b.language == "yaml" for b in _blocks(name))]
)
def test_yaml_of_the_docs_is_a_configuration(name: str) -> None:
    for block in _blocks(name):
        if block.language == "yaml":
            merge(Config(), yaml.safe_load(block.text), where=name)


def test_nothing_installs_this_package_from_an_index() -> None:
    """It is on none, and the name is anybody's."""
    pages = [ROOT / name for name in DOCS] + sorted((ROOT / "docs").rglob("*.md"))
    code = [*(ROOT / "vio").rglob("*.py"), *(ROOT / "frontend").rglob("*.py")]
    notebooks = [*(ROOT / "vio").rglob("*.ipynb"), *(ROOT / "examples").rglob("*.ipynb")]
    found = [
        f"{path}: {line.strip()}"
        for path in (*pages, *code, *notebooks)
        for line in path.read_text(encoding="utf-8").splitlines()
        if "pip install" in line and re.search(r"stereo[-_]vio(\[|'|\"|\s|$)", line)
    ]
    assert not found


@pytest.mark.parametrize("name", [*DOCS, *NOTES])
def test_links_are_valid(name: str) -> None:
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", _text(name)):
        path, _, heading = target.partition("#")
        if path.startswith("https://"):
            continue
        file = (ROOT / name).parent / path if path else ROOT / name
        if file in GENERATED and name != README:
            continue  # in the site, which is built with all links checked
        if not file.is_file() or (heading and heading not in _anchors(file)):
            broken.append(target)
    assert not broken


def test_every_page_is_reached_from_the_readme() -> None:
    linked = {
        target
        for name in (README, *DOCS)
        for target in re.findall(r"\]\(([^)\s#]+\.md)", _text(name))
    }
    assert {Path(name).name for name in (*DOCS[2:], *NOTES)} <= {
        Path(target).name for target in linked
    }


def _anchors(file: Path) -> set[str]:
    """The anchors of a document's headings, as GitHub forms them, and those that it states."""
    text = file.read_text(encoding="utf-8")
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    formed = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
    return formed | set(re.findall(r'<a id="([\w-]+)"></a>', text))


def test_formulas_side_by_side_may_be_put_below_one_another() -> None:
    latex = r"a = \left[b \quad c\right], \qquad d = \text{e \quad f} \quad g"
    assert _apart(latex) == [r"a = \left[b \quad c\right],", r"d = \text{e \quad f}", "g"]
    matrix = r"\begin{pmatrix} 1 \quad 2 \end{pmatrix} \rightarrow \{x\}"
    assert _apart(matrix) == [matrix]
