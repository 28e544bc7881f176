"""Machine code of the compiled loops that a wheel holds, so that its first run compiles nothing.

`tools/prebuild.py` writes it for x86-64-v3. It is used only by the sources, the versions and the settings of numba that
it was compiled from and with, on processors that have all of its instructions; everywhere else loops are compiled.
"""

from __future__ import annotations

import functools
import hashlib
import json
import pickle
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba
import numpy as np

FOLDER = Path(__file__).with_name("machine_code")
MANIFEST, CODE = "manifest.json", "loops.bin"
CPU_NAME = "x86-64-v3"
_ADDED = "sse3 ssse3 sse4.1 sse4.2 popcnt cx16 sahf avx avx2 bmi bmi2 f16c fma lzcnt movbe xsave"  # to plain x86-64
FEATURES = ",".join(f"+{name}" for name in _ADDED.split())


def environment() -> dict[str, str]:
    """Return what machine code depends on beside sources and processor."""
    config: Any = numba.config
    return {
        "python": str(sys.implementation.cache_tag),
        "numba": numba.__version__,
        "llvmlite": llvmlite.__version__,
        "numpy": np.__version__.partition(".")[0],
        "triple": llvmlite.binding.get_process_triple(),
        "options": f"{config.OPT} {config.BOUNDSCHECK} {config.DEBUGINFO_DEFAULT} {config.DISABLE_JIT}",
    }


def source_hash() -> str:
    """Return a hash of the names and contents of this package's Python files."""
    package, digest = FOLDER.parent.parent, hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(package).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()


@functools.cache
def _loops() -> Mapping[str, Mapping[str, tuple[int, int, str]]]:
    """Return begin, length and hash of the code of each function and signature; none where it must not be used."""
    config: Any = numba.config
    if config.CPU_NAME is not None or config.CPU_FEATURES is not None:  # another processor is asked for
        return {}
    try:
        manifest = json.loads((FOLDER / MANIFEST).read_bytes())
        loops: Mapping[str, Mapping[str, tuple[int, int, str]]] = manifest["loops"]
        same = manifest["environment"] == environment() and _runs_here() and manifest["sources"] == source_hash()
    except (OSError, ValueError, KeyError, TypeError):  # there is none, or it is damaged
        return {}
    return loops if same else {}


def _runs_here() -> bool:
    """Return whether processor and operating system allow all instructions."""
    try:
        has = llvmlite.binding.get_host_cpu_features()
    except RuntimeError:  # LLVM does not know the processor
        return False
    return all(has.get(name, False) for name in _ADDED.split())


class PrebuiltCache:
    """Gives numba the machine code of one function, and asks its own cache for signatures that are missing."""

    def __init__(self, cache: Any, signatures: Mapping[str, tuple[int, int, str]]) -> None:
        self._cache, self._signatures = cache, signatures

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cache, name)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the function as compiled for a signature, or None."""
        target_context.refresh()
        code = self._code(str(signature))
        if code is None:
            return self._cache.load_overload(signature, target_context)
        rebuild: Any = numba.core.compiler.CompileResult._rebuild
        return rebuild(target_context, *pickle.loads(code))

    def _code(self, signature: str) -> bytes | None:
        """Read the code of a signature; None where there is none, or it is damaged."""
        if signature not in self._signatures:
            return None
        begin, length, digest = self._signatures[signature]
        try:
            with open(FOLDER / CODE, "rb") as file:
                file.seek(begin)
                code = file.read(length)
        except OSError:
            return None
        return code if hashlib.sha256(code).hexdigest() == digest else None


def attach(loop: Any) -> Any:
    """Give a function compiled by numba its machine code, where there is some; return the function."""
    signatures = _loops().get(name_of(getattr(loop, "py_func", loop)))
    if signatures:
        loop._cache = PrebuiltCache(loop._cache, signatures)
    return loop


def name_of(function: Any) -> str:
    """Return the name that a function has in the manifest."""
    return f"{function.__module__}.{function.__qualname__}"
