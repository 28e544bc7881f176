"""Machine code in an extension module is used for the loops and on the machines that it was made
for, nowhere else.
"""

from __future__ import annotations

import inspect
import json
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from tools.prebuild import TARGETS, Target, tag_of, write_code
from vio.errors import NOTE
from vio.numerics import prebuilt
from vio.numerics.compiled import Loop, compiled, compiled_sums

ROOT = Path(__file__).parents[2]
HALF = 0.5


@compiled
def halved(x: float) -> float:
    return HALF * x


@compiled
def add_halves(values: Any, out: Any) -> float | None:
    """Add to `out` half of each value; return the last one's."""
    last = np.nan
    for k in range(len(values)):
        last = halved(values[k])
        out[k] += last
    if np.isnan(last):
        return None
    return last


@compiled_sums
def total(values: Any, first: int) -> float:
    out = 0.0
    for k in range(first, len(values)):
        out += values[k]
    return out / (len(values) - first)


@compiled
def longest(values: Any) -> float:
    out = 0.0
    for k in range(len(values) - 1):
        out = max(out, np.hypot(values[k], values[k + 1]))
    return out


LOOPS = {"halved": halved, "add_halves": add_halves, "total": total, "longest": longest}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An extension module with the loops of this file."""
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler")
    folder = tmp_path_factory.mktemp("made") / "machine_code"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prebuilt, "_extension", lambda: (None, {}))
        write_code(folder, _called_loops(), "host", prebuilt.processor_flags())
    return folder


def _called_loops() -> list[Loop]:
    loops = [Loop(loop.function, loop.options) for loop in LOOPS.values()]
    add_halves_, total_, longest_ = loops[1:]
    assert longest_(np.array([3.0, 4.0, 0.0])) == 5.0
    add_halves_(np.arange(3.0), np.zeros(3))
    total_(np.arange(5.0), 0)
    total_(np.arange(5.0, dtype=np.float32), 0)
    return loops


@pytest.fixture
def folder(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, in which this process looks for code."""
    copy = shutil.copytree(made, tmp_path / "machine_code")
    monkeypatch.setattr(prebuilt, "FOLDER", copy)
    monkeypatch.setattr(prebuilt, "_extension", prebuilt._extension.__wrapped__)
    return copy


def _edit(folder: Path, **changes: object) -> None:
    path = folder / prebuilt.MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def _fresh(name: str) -> Loop:
    return Loop(LOOPS[name].function, LOOPS[name].options)  # type: ignore[attr-defined]


def _is_loaded(loop: Loop, *arguments: Any) -> bool:
    """Call a loop; return whether numba was not needed."""
    loop(*arguments)
    return "by_numba" not in vars(loop)


def test_machine_code_is_used_and_gives_the_same(folder: Path) -> None:
    values, out, expected = np.arange(4.0), np.zeros(4), np.zeros(4)
    loop = _fresh("add_halves")
    assert loop(values, out) == add_halves(values, expected) == 1.5
    assert loop(values[:0], out) is None
    np.testing.assert_array_equal(out, expected)
    assert "by_numba" not in vars(loop)


def test_each_set_of_types_has_its_code(folder: Path) -> None:
    loop = _fresh("total")
    for dtype in (np.float64, np.float32):
        assert _is_loaded(loop, np.arange(6, dtype=dtype), np.int64(1))
        assert loop(np.arange(6, dtype=dtype), 1) == 3.0
    assert np.isnan(loop(np.zeros(2), 2)), "divisions follow IEEE 754"


@pytest.mark.parametrize(
    "values",
    [
        np.arange(3),
        np.arange(3.0).astype(">f8"),
        np.arange(6.0)[::2],
        np.zeros((3, 1)),
        np.arange(3.0).view(np.recarray),
    ],
    ids=["whole numbers", "other order of bytes", "gaps", "two dimensions", "another class"],
)
def test_arrays_of_other_types_are_left_to_numba(values: Any, folder: Path) -> None:
    loop = _fresh("total")
    loop(np.arange(3.0), 0)
    (code, _) = prebuilt.code_of(loop.function, lambda: loop.fingerprint)
    with pytest.raises(TypeError):
        code(values, 0)
    if values.ndim == 1 and values.dtype.isnative:
        assert not _is_loaded(loop, values, 0)
        assert loop(values, 0) == np.mean(values)


@pytest.mark.parametrize(
    "arguments", [(None, 0), ([1.0], 0), ("text", 0), (1.0, 0), (np.zeros(2), 0.5), (np.zeros(2),)]
)
def test_other_arguments_are_an_error(arguments: tuple[Any, ...], folder: Path) -> None:
    loop = _fresh("total")
    for code in prebuilt.code_of(loop.function, lambda: loop.fingerprint):
        with pytest.raises(TypeError):
            code(*arguments)


def test_what_must_not_be_written_to_is_left_to_numba(folder: Path) -> None:
    loop, out = _fresh("add_halves"), np.zeros(3)
    out.flags.writeable = False
    (code,) = prebuilt.code_of(loop.function, lambda: loop.fingerprint)
    with pytest.raises(TypeError):
        code(np.arange(3.0), out)


def test_a_process_with_machine_code_does_not_load_numba(folder: Path) -> None:
    code = f"""
import sys
from pathlib import Path
import numpy as np
from vio.numerics import prebuilt
from vio.numerics.compiled import Loop, compiled_sums
prebuilt.FOLDER = Path({str(folder)!r})
exec({inspect.getsource(total.function)!r})
total.function.__module__ = {__name__!r}
print(total(np.arange(6.0), 1), "numba" in sys.modules)
"""
    command = [sys.executable, "-c", "from typing import Any\n" + code]
    assert subprocess.check_output(command, text=True, cwd=ROOT).split() == ["3.0", "False"]


def _no_code(folder: Path) -> None:
    next(folder.glob("*vio_loops*")).unlink()


def _damaged_code(folder: Path) -> None:
    path = next(folder.glob("*vio_loops*"))
    code = bytearray(path.read_bytes())
    code[::50] = bytes(len(code[::50]))
    path.unlink()
    path.write_bytes(code)


def _cut_manifest(folder: Path) -> None:
    path = folder / prebuilt.MANIFEST
    path.write_bytes(path.read_bytes()[:100])


def _other_manifest(folder: Path) -> None:
    (folder / prebuilt.MANIFEST).write_text("[]")


def _another_environment(name: str) -> Callable[[Path], None]:
    return lambda folder: _edit(folder, environment=prebuilt.environment() | {name: "another"})


def _another_processor(folder: Path) -> None:
    _edit(folder, flags=["an instruction set to come"])


@pytest.mark.parametrize(
    "change",
    [
        _no_code,
        _damaged_code,
        _cut_manifest,
        _other_manifest,
        _another_processor,
        *map(_another_environment, prebuilt.environment()),
    ],
)
def test_code_that_is_damaged_or_for_another_machine_is_not_used(
    change: Callable[[Path], None], folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    change(folder)
    loop = _fresh("total")
    with caplog.at_level(NOTE):
        assert not _is_loaded(loop, np.arange(3.0), 0)
    assert loop(np.arange(3.0), 0) == 1.0
    assert f"the compiled loops in {folder} are not used: " in caplog.text


@pytest.mark.parametrize("name", ["flags\t\t", "Features\t"])
def test_instruction_sets_are_those_that_linux_lists(name: str, tmp_path: Path) -> None:
    (tmp_path / "cpuinfo").write_text(
        f"processor\t: 0\n{name}: fpu sse avx2\nbugs\t: some\n{name}: fpu\n"
    )
    assert prebuilt.processor_flags(tmp_path / "cpuinfo") == {"fpu", "sse", "avx2"}
    assert prebuilt.processor_flags(tmp_path / "no file") == {platform.node()}


def test_settings_of_numba_are_for_what_numba_compiles(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert _is_loaded(_fresh("total"), np.arange(3.0), 0)
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    assert not _is_loaded(_fresh("total"), np.arange(3.0), 0)


def test_a_loop_that_was_edited_is_compiled_anew(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert _is_loaded(_fresh("add_halves"), np.arange(3.0), np.zeros(3))
    monkeypatch.setattr(sys.modules[__name__], "HALF", 0.25)
    monkeypatch.setattr(sys.modules[__name__], "halved", _fresh("halved"))
    loop, out = _fresh("add_halves"), np.zeros(3)
    # as a constant of a function that it calls is another
    assert not _is_loaded(loop, np.arange(3.0), out)


def test_a_record_that_a_loop_makes_belongs_to_it() -> None:
    def made_with(fields: list[tuple[str, type]]) -> str:
        scope = {"Pair": NamedTuple("Pair", fields), "np": np}
        exec("def loop(x):\n    return Pair(x, x)", scope)
        return prebuilt.fingerprint(scope["loop"], {})  # type: ignore[arg-type]

    one = made_with([("a", float), ("b", float)])
    assert one == made_with([("a", float), ("b", float)])
    assert one != made_with([("b", float), ("a", float)])


def test_options_belong_to_a_loop(folder: Path) -> None:
    loop = Loop(total.function, halved.options)  # type: ignore[attr-defined]
    assert not _is_loaded(loop, np.arange(3.0), 0)


# of the header of an ELF file: the machine that its code is for
_ELF_MACHINES = {"x86_64": 62, "aarch64": 183}


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.machine)
def test_a_module_for_a_wheel_is_for_its_machine_and_loads_with_older_libraries(
    target: Target, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if sys.platform != "linux" or shutil.which(f"{target.tools}g++") is None:
        pytest.skip(f"needs {target.tools}g++ on Linux")
    monkeypatch.setattr(prebuilt, "_extension", lambda: (None, {}))
    folder = tmp_path / "machine_code"
    write_code(folder, _called_loops(), target.processor, target.flags.split(), target)
    (file,) = folder.glob("*.so")
    assert int.from_bytes(file.read_bytes()[18:20], "little") == _ELF_MACHINES[target.machine]
    manifest = json.loads((folder / prebuilt.MANIFEST).read_text())
    assert manifest["environment"]["system"] == f"linux {target.machine}"
    assert manifest["file"] == file.name
    assert sorted(manifest["flags"]) == sorted(target.flags.split())
    # the newest symbols are pow, exp and log; hypot would ask for glibc 2.35
    assert tag_of(folder, target).endswith(f"manylinux_2_29_{target.machine}")
