"""Machine code that a wheel holds is used as it was made for, and nowhere else."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numba
import numpy as np
import pytest

from tools.prebuild import write_code
from vio.numerics import prebuilt
from vio.numerics.compiled import _OPTIONS, solve_positive


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The machine code of a package of one file, for this process."""
    made = tmp_path / "vio" / "numerics" / "machine_code"
    monkeypatch.setattr(prebuilt, "FOLDER", made)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    loop = numba.njit(solve_positive.__wrapped__, cache=True, **_OPTIONS)
    loop(np.eye(2), np.ones(2))
    write_code(made, [loop])
    (tmp_path / "vio" / "part.py").write_text("x = 1\n")
    _edit(made, sources=prebuilt.source_hash())
    yield made
    prebuilt._loops.cache_clear()


def _edit(folder: Path, **changes: object) -> None:
    path = folder / prebuilt.MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def _loads() -> bool:
    """Return whether a fresh process would load a function's machine code; either way, the function is right."""
    prebuilt._loops.cache_clear()
    loop = prebuilt.attach(numba.njit(solve_positive.__wrapped__, **_OPTIONS))
    b = np.array([2.0, 8.0])
    loop(np.diag([1.0, 4.0]), b)
    np.testing.assert_array_equal(b, [2.0, 2.0])
    return sum(loop.stats.cache_hits.values()) == 1


def test_machine_code_is_loaded_where_it_was_made_for(folder: Path) -> None:
    assert _loads()


def _another_source(folder: Path) -> None:
    (folder.parent.parent / "part.py").write_text("x = 2\n")


def _more_sources(folder: Path) -> None:
    (folder.parent.parent / "other.py").write_text("")


def _damaged_code(folder: Path) -> None:
    code = bytearray((folder / prebuilt.CODE).read_bytes())
    code[::50] = bytes(len(code[::50]))
    (folder / prebuilt.CODE).write_bytes(code)


def _no_code(folder: Path) -> None:
    (folder / prebuilt.CODE).unlink()


def _cut_manifest(folder: Path) -> None:
    path = folder / prebuilt.MANIFEST
    path.write_bytes(path.read_bytes()[:100])


def _other_manifest(folder: Path) -> None:
    (folder / prebuilt.MANIFEST).write_text("[]")


@pytest.mark.parametrize(
    "change", [_another_source, _more_sources, _damaged_code, _no_code, _cut_manifest, _other_manifest]
)
def test_stale_or_damaged_machine_code_is_not_used(change: Callable[[Path], None], folder: Path) -> None:
    change(folder)
    assert not _loads()


@pytest.mark.parametrize("name", prebuilt.environment())
def test_machine_code_of_another_version_is_not_used(name: str, folder: Path) -> None:
    _edit(folder, environment=prebuilt.environment() | {name: "another"})
    assert not _loads()


def test_machine_code_is_not_used_by_a_processor_that_lacks_an_instruction(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lacking = dict(numba.core.codegen.ll.get_host_cpu_features()) | {"avx2": False}
    monkeypatch.setattr("llvmlite.binding.get_host_cpu_features", lambda: lacking)
    assert not _loads()


def test_a_processor_that_the_user_names_is_compiled_for(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CPU_NAME", "generic")
    assert not _loads()
