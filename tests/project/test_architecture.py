"""Layered imports, and lazy loading of heavy packages."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.dataset_makers import make_kitti
from tools.draw_structure import layers, read_packages
from tools.parts import ORDER, PARTS, part_of, read_edges, source_files, wrong_way

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted([*(ROOT / "vio").rglob("*.py"), *(ROOT / "frontend").rglob("*.py")])

# Only the configuration, live use, the pipeline, the test bench and the command line know
# the front end.
USES_FRONTEND = (
    "vio.config",
    "vio.guard",
    "vio.live",
    "vio.runs",
    "vio.sim.oracle",
    "vio.cli",
    "vio.testing",
    "vio.frontend",
)
# The estimator, free of images and files.
ESTIMATOR = (
    "vio.filters",
    "vio.geometry",
    "vio.records",
    "vio.selection",
    "vio.protocols",
    "vio.evaluation",
)
# They clean up, or hand what ended a thread to others.
_CATCH_ALL = ("atomic.py", "images.py", "worker.py", "live_odometry.py")
# Imports forbidden to each package, lower layers first; the command line, forbidden to all, is
# tested separately.
_ABOVE_READERS = ("vio.config", "vio.live", "vio.runs", "vio.filters", "vio.mapping", "vio.offline")
MUST_NOT_IMPORT = {
    "vio.numerics": ("vio.records", "vio.calibration", "vio.files"),
    "vio.files": ("vio.datasets", *_ABOVE_READERS),
    "vio.calibration": ("vio.monitor", "vio.datasets", *_ABOVE_READERS),
    "vio.monitor": ("vio.datasets", *_ABOVE_READERS),
    "vio.datasets": _ABOVE_READERS,
    "vio.mapping": ("vio.datasets", "vio.live", "vio.runs", "vio.filters", "vio.offline"),
    "vio.offline.colmap": ("vio.datasets", "vio.live", "vio.runs", "vio.filters"),
    "vio.frontend": ("vio.live", "vio.runs", "vio.filters"),
}


def _name(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == "vio" else ("vio", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def _nodes(file: Path) -> tuple[list[ast.stmt], list[ast.AST]]:
    """The statements of a module, and of all its nodes those that the rules are about."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    about = (ast.Import, ast.ImportFrom, ast.Call, ast.ExceptHandler)
    return tree.body, [node for node in ast.walk(tree) if isinstance(node, about)]


@cache
def _imports(file: Path, *, top_level_only: bool) -> tuple[str, ...]:
    names: list[str] = []
    for node in _nodes(file)[0 if top_level_only else 1]:
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{file}: relative import"
            names.append(node.module or "")
    return tuple(names)


def _heads(file: Path, *, top_level_only: bool) -> set[str]:
    return {name.split(".")[0] for name in _imports(file, top_level_only=top_level_only)}


def _within(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}.")


def _unrelated_assignment(node: ast.stmt) -> bool:
    """Whether a statement is `a, b = x, y` whose values do not use what it assigns, unlike a swap."""
    if not (isinstance(node, ast.Assign) and len(node.targets) == 1):
        return False
    target = node.targets[0]
    value = node.value
    if not (isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)):
        return False
    roots = set()
    for element in target.elts:
        while isinstance(element, ast.Subscript):
            element = element.value
        roots.add(ast.unparse(element))
    return not roots & {ast.unparse(part) for part in ast.walk(value) if isinstance(part, ast.expr)}


@pytest.mark.parametrize("file", FILES, ids=_name)
def test_a_statement_assigns_one_thing(file: Path) -> None:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    statements = [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]
    assert [node.lineno for node in statements if _unrelated_assignment(node)] == []


def test_packages_of_import_rules_exist() -> None:
    names = [_name(file) for file in FILES]
    packages = {
        *MUST_NOT_IMPORT,
        *(other for others in MUST_NOT_IMPORT.values() for other in others),
    }
    assert {
        package for package in packages if not any(_within(name, package) for name in names)
    } == set()


@pytest.mark.parametrize("file", FILES, ids=_name)
def test_imports_go_one_way(file: Path) -> None:
    name = _name(file)
    everything = set(_imports(file, top_level_only=False))
    if name.startswith(ESTIMATOR):
        forbidden = {"cv2", "torch", "kornia", "matplotlib", "pycolmap"}
        assert not forbidden & {i.split(".")[0] for i in everything}
    if not any(_within(name, user) for user in USES_FRONTEND):
        assert not any(_within(i, "vio.frontend") for i in everything), (
            "only the pipeline imports the front end"
        )
    for package, others in MUST_NOT_IMPORT.items():
        if _within(name, package):
            assert not {i for i in everything for other in others if _within(i, other)}, (
                f"{package} is below these"
            )
    if not name.startswith(("vio.cli", "vio.__main__")):
        assert not any(i.startswith("vio.cli") for i in everything), (
            "nothing imports the command line"
        )
    assert not {"torch", "kornia"} & _heads(file, top_level_only=True)


def test_every_module_is_in_a_part() -> None:
    modules = source_files(ROOT)
    assert {part_of(module) for module in modules} == set(PARTS)
    named = [name for names in PARTS.values() for name in names]
    assert len(named) == len(set(named))
    assert [name for name in named if not any(_within(m, name) for m in modules)] == []


def test_parts_import_from_themselves_and_from_below() -> None:
    edges = read_edges(ROOT)
    assert len(edges) > 2000
    assert wrong_way(edges) == []
    # Most imports between parts that are allowed exist: the order is no table of exceptions.
    between = {(ORDER[part_of(a)], ORDER[part_of(b)]) for a, b in edges}
    assert len([pair for pair in between if pair[0] > pair[1]]) > len(PARTS) * (len(PARTS) - 1) // 3


def test_an_import_of_a_part_above_is_found() -> None:
    edges = [("vio.filters.msckf", "vio.guard.bands"), ("vio.guard.bands", "vio.filters.msckf")]
    assert wrong_way(edges) == edges[:1]


# A transport is chosen by importing it: vio/ros2/transport.py.
_MODULES_IN_A_CIRCLE = {
    ("vio.ros2.dds", "vio.ros2.transport"),
    ("vio.ros2.rclpy_transport", "vio.ros2.transport"),
}


def test_modules_have_no_import_circle_inside_functions() -> None:
    edges = read_edges(ROOT)
    assert _circles(edges) <= _MODULES_IN_A_CIRCLE
    assert _circles([("a", "b"), ("b", "c"), ("c", "a"), ("c", "d")]) == {
        ("a", "b"),
        ("a", "c"),
        ("b", "c"),
    }


def _circles(edges: list[tuple[str, str]]) -> set[tuple[str, str]]:
    """Pairs of modules, in the order of the alphabet, one of which imports the other and is
    reached from it.
    """
    imports: dict[str, set[str]] = {}
    for module, imported in edges:
        imports.setdefault(module, set()).add(imported)

    @cache
    def reached(module: str) -> frozenset[str]:
        seen: set[str] = set()
        waiting = [module]
        while waiting:
            new = imports.get(waiting.pop(), set()) - seen
            seen |= new
            waiting += new
        return frozenset(seen)

    return {(min(a, b), max(a, b)) for a, b in edges if a in reached(b)}


def test_packages_have_no_import_cycle() -> None:
    packages = read_packages(ROOT)
    assert {"vio.filters", "vio.datasets", "vio.frontend", "vio.runs"} <= set(packages)
    assert layers(packages)[1] == []


def test_detects_an_import_cycle(tmp_path: Path) -> None:
    (tmp_path / "frontend").mkdir()
    for name, text in (
        ("a", "def f():\n    from vio.b import g\n"),
        ("b", "from vio import c\n"),
        ("c", "import vio.a"),
    ):
        (tmp_path / "vio").mkdir(exist_ok=True)
        (tmp_path / "vio" / f"{name}.py").write_text(text)
    layer, closing = layers(read_packages(tmp_path))
    assert closing == [("vio.c", "vio.a")]
    assert layer == {"vio.a": 2, "vio.b": 1, "vio.c": 0}


@pytest.mark.parametrize(
    ("library", "package"), [("pycolmap", "vio.offline.colmap"), ("rosbags", "vio.datasets.bags")]
)
def test_a_library_stays_in_its_package(library: str, package: str) -> None:
    users = [_name(f) for f in FILES if library in _heads(f, top_level_only=False)]
    assert users
    assert all(_within(name, package) for name in users), users


def test_dask_stays_in_its_module() -> None:
    users = [_name(f) for f in FILES if {"distributed", "dask"} & _heads(f, top_level_only=False)]
    assert users == ["vio.bench.engines"]
    assert not {"distributed", "dask"} & _heads(
        ROOT / "vio" / "bench" / "engines.py", top_level_only=True
    )


def test_dds_ros_and_cameras_stay_in_their_modules() -> None:
    for package, module in (
        ("cyclonedds", "vio.ros2.dds"),
        ("rclpy", "vio.ros2.rclpy_transport"),
        ("pyrealsense2", "vio.sources.realsense"),
        ("depthai", "vio.sources.oak"),
    ):
        assert [_name(f) for f in FILES if package in _heads(f, top_level_only=False)] == [module]


def test_matplotlib_stays_out_of_import_time() -> None:
    assert not [_name(f) for f in FILES if "matplotlib" in _heads(f, top_level_only=True)]


def _loaded(code: str, suspects: set[str]) -> set[str]:
    """Return which of these modules a new interpreter has loaded after running the code."""
    report = f"\nimport sys\nprint(*({suspects!r} & set(sys.modules)), file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", code + report], capture_output=True, text=True, cwd=ROOT, check=True
    )
    return set(done.stderr.split())


HEAVY = {
    "numpy",
    "scipy",
    "numba",
    "cv2",
    "torch",
    "kornia",
    "matplotlib",
    "pycolmap",
    "yaml",
    "threadpoolctl",
    "tqdm",
}
HEAVY |= {"rosbags", "distributed", "dask", "cyclonedds", "pyrealsense2", "depthai"}
HELP = """
import contextlib, vio.cli
with contextlib.suppress(SystemExit):
    vio.cli.main(["--help"])
"""
HELP_OF_EACH = """
import argparse, vio.cli
(commands,) = (a for a in vio.cli.build_parser()._actions if isinstance(a, argparse._SubParsersAction))
assert len(commands.choices) > 9
for parser in commands.choices.values():
    parser.format_help()
"""


@pytest.mark.parametrize(
    "code",
    ["import vio", HELP, HELP_OF_EACH],
    ids=["import vio", "vio --help", "vio COMMAND --help"],
)
def test_no_heavy_import_before_a_command_runs(code: str) -> None:
    assert not _loaded(code, HEAVY)


def test_the_estimator_does_not_import_slow_parts_of_scipy() -> None:
    # `scipy.stats` and what it pulls in were 3.5 of the 6.1 seconds that importing the pipeline
    # took.
    beyond = {
        "cv2",
        "torch",
        "kornia",
        "matplotlib",
        "pycolmap",
        "scipy.stats",
        "scipy.optimize",
        "scipy.io",
    }
    code = "import vio.runs.pipeline, vio.filters.msckf, vio.evaluation.trajectories"
    # Whole packages cost a fifth of a run of two frames: vio/numerics/scipy_extensions.py.
    beyond |= {"scipy", "scipy.linalg", "scipy.special", "email"}
    assert _loaded(code, {*beyond, "numpy"}) == {"numpy"}, "which shows that the test can fail"


# What a run of two frames of a EuRoC recording does without; each of these was loaded once.
UNUSED_BY_A_SHORT_RUN = {
    "vio.calibration.gyro",
    "vio.calibration.inertial",
    "vio.calibration.lever_arm",
    "vio.calibration.stereo",
    "vio.calibration.verdicts",
    "vio.datasets.gtsam",
    "vio.datasets.observation_log",
    "vio.datasets.rigs.formats",
    "vio.datasets.rigs.kalibr",
    "vio.datasets.rigs.opencv",
    "vio.datasets.utias",
    "vio.datasets.videos",
    "vio.filters.mono_msckf",
    "vio.filters.mono_start",
    "vio.filters.vislam",
    "vio.frontend.descriptors",
    "vio.frontend.keypoints",
    "vio.frontend.given_corners",
    "vio.live.live_odometry",
    "vio.live.odometry",
    "vio.live.prediction",
    "vio.mapping.session",
    "vio.monitor.accelerometer",
    "vio.monitor.gyro",
    "vio.report.html",
    "vio.runs.curves",
    "vio.runs.finished",
    "vio.runs.live_folder",
    "vio.runs.mapped",
    "vio.runs.picture",
}
# numba, which compiles what no machine code is at hand for, loads some of these.
UNUSED_WITH_MACHINE_CODE = {"scipy", "numpy.ma", "sqlite3", "xml"}


def test_a_run_of_two_frames_loads_only_what_it_uses(flight: Path, tmp_path: Path) -> None:
    command = ["run", str(flight), "--stop", "2", "--no-plot", "--quiet"]
    command += ["--out", str(tmp_path / "out")]
    code = f"""
import contextlib, io, vio.cli
with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    assert vio.cli.main({command!r}) in (0, None)
"""
    used = {"vio.filters.msckf", "vio.frontend.klt", "numba"}
    found = _loaded(code, {*UNUSED_BY_A_SHORT_RUN, *UNUSED_WITH_MACHINE_CODE, *used})
    compiling = "numba" in found
    assert used - {"numba"} <= found, "which shows that the test can fail"
    assert not found & UNUSED_BY_A_SHORT_RUN
    assert compiling or not found & UNUSED_WITH_MACHINE_CODE


def test_kitti_is_read_without_the_readers_of_other_calibrations(tmp_path: Path) -> None:
    folder = make_kitti(tmp_path / "seq", frames=2)
    code = f"import vio.datasets\nvio.datasets.open_dataset({str(folder)!r})"
    formats = {"vio.datasets.rigs.formats", "vio.datasets.rigs.basalt", "vio.datasets.rigs.opencv"}
    used = "vio.datasets.rigs.kitti_odometry"
    assert _loaded(code, {*formats, used}) == {used}, "which shows that the test can fail"


def test_no_print_or_exit_outside_the_command_line() -> None:
    for file in FILES:
        if _name(file).startswith("vio.cli") or _name(file) == "vio.__main__":
            continue
        for node in _nodes(file)[1]:
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("print", "exit", "quit"), f"{file}:{node.lineno}"
            if isinstance(node, ast.ExceptHandler):
                broad = node.type is None or (
                    isinstance(node.type, ast.Name) and node.type.id == "BaseException"
                )
                assert not broad or file.name in _CATCH_ALL, f"{file}:{node.lineno}: broad except"


def test_functions_of_scipy_are_those_of_its_packages() -> None:
    code = """
from vio.numerics.scipy_extensions import lapack, special
import scipy.linalg, scipy.special
assert scipy.linalg.lapack.dpotrf(4.0)[0] == lapack.dpotrf(4.0)[0] == 2.0
assert scipy.special.gammaincinv(3, 0.9) == special.gammaincinv(3, 0.9)
"""
    assert _loaded(code, {"scipy.linalg"}) == {"scipy.linalg"}
