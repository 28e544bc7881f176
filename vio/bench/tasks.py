"""The tasks of a bench: runs of a sequence with a configuration and seed, and trajectories of other systems."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vio.bench.identity import InputDigests, code_digest, digest_of, package_versions, render_code_digest
from vio.bench.suite import Sequence, Suite, config_of
from vio.config import as_dict
from vio.datasets import READERS
from vio.errors import ConfigError, DataError
from vio.files.trajectories import read_trajectory

_NO_FILES = ("handheld", "car", "simulated", "none")  # values of `vio render` in the place of a file
_FORM = 2  # of jobs and records: another one makes other keys
# Settings that name files, relative to the folder of the recordings.
_FILE_SETTINGS = re.compile(
    r"dataset\.calibration|frontend\.features|frontend\.klt\.mask|frontend\.learned\.\w+_weights"
)


@dataclass(frozen=True, slots=True)
class Task:
    """One row of the table of runs."""

    sequence: str
    system: str  # the configuration, or the other system
    seed: int | None  # None: another system's trajectory
    key: str  # digest of all that the figures depend on
    job: dict[str, Any]  # what a worker needs; empty where the task cannot be done
    failure: str | None = None  # why it cannot
    size: float = 0.0  # of the inputs in bytes, infinite for what must be rendered: the largest tasks are done first


def tasks_of(suite: Suite, data: Path, digests: InputDigests, peers: Path | None = None) -> list[Task]:
    """Return all tasks of a suite, in the order of its tables; an input that is missing makes a failed task.

    Raises:
        ConfigError: the folder of other systems' trajectories does not exist or holds none of a sequence of the suite.
    """
    tasks = [*_runs(suite, data, digests), *(() if peers is None else _peers(suite, data, digests, peers))]
    for task in tasks:
        task.job["time_limit_s"] = suite.time_limit_s  # no part of the key: a result does not depend on it
    return tasks


def inputs_of(sequence: Sequence, data: Path) -> list[Path]:
    """Return what a sequence reads: its recording or the files of its render, and its ground truth."""
    words = sequence.render
    paths = [] if sequence.source is None else [_source(sequence.source, data)[1]]
    for k, word in enumerate(words):
        option, equals, value = word.rpartition("=") if word.startswith("--") else ("", "", word)
        if (equals or not word.startswith("-")) and _takes_a_path(list(words), k, option) and value not in _NO_FILES:
            paths.append(data / value)
    return paths + ([] if sequence.reference is None else [data / sequence.reference])


def render_of(sequence: Sequence, data: Path, digests: InputDigests, seed: int) -> dict[str, Any]:
    """Return the arguments of a render, with files as absolute paths, and the key of its folder.

    Raises:
        DataError: a file that it reads cannot be read.
    """
    words, known = list(sequence.render), []
    for k, word in enumerate(words):
        option, equals, value = word.rpartition("=") if word.startswith("--") else ("", "", word)
        path = data / value
        if value and not value.startswith("-") and path.exists() and _takes_a_path(words, k, option):
            words[k] = f"{option}{equals}{path.absolute()}"
            known.append([f"{option}{equals}", digests.of(path)])
        else:
            known.append([words[k]])
    words += ["--seed", str(seed)]
    key = digest_of([_FORM, known, seed, render_code_digest(), package_versions()])
    return {"words": words, "key": key}


def _takes_a_path(words: list[str], k: int, option: str) -> bool:
    return (option or (words[k - 1] if k else "")) in ("--trajectory", "--imu", "--frame-times")


def _runs(suite: Suite, data: Path, digests: InputDigests) -> Iterator[Task]:
    """Yield the runs; of one configuration all sequences first, so that renders are made side by side."""
    for name in suite.configurations:
        for sequence in suite.sequences:
            for seed in suite.seeds:
                yield _task(suite, sequence, name, seed, data, digests)


def _task(suite: Suite, sequence: Sequence, name: str, seed: int, data: Path, digests: InputDigests) -> Task:
    task = Task(sequence.name, name, seed, "", {})
    try:
        job, identity = _common(sequence, data, digests, seed)
        if sequence.map_of is not None:
            (first,) = (s for s in suite.sequences if s.name == sequence.map_of)
            job["first"], identity["first"] = _common(first, data, digests, seed)
            job["first"]["config"], identity["first"]["config"] = _settings(suite, first, name, seed, data, digests)
        config, known = _settings(suite, sequence, name, seed, data, digests)
    except DataError as error:
        return replace(task, failure=" ".join(str(error).split()))
    job |= {"kind": "run", "config": config}
    size = math.inf if identity["bytes"] is None else identity["bytes"]
    return replace(task, job=job, key=digest_of([_FORM, "run", identity, known]), size=size)


def _settings(
    suite: Suite, sequence: Sequence, name: str, seed: int, data: Path, digests: InputDigests
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the settings of a run, and the part of them that the result depends on: files by their content."""
    config = as_dict(config_of(suite, sequence, name, seed))
    files: dict[str, str] = {}
    for setting, holder, key in _file_settings(config):
        holder[key] = str((data / holder[key]).absolute())
        files[setting] = digests.of(Path(holder[key]))
    return config, {**_without(config, files), "files": files}


def _common(sequence: Sequence, data: Path, digests: InputDigests, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what a worker needs for a sequence, and the part of it that the result depends on."""
    job: dict[str, Any] = {"source": None, "render": None, "reference": None, "scratch": None, "first": None}
    shared: dict[str, Any] = {
        "start": sequence.start,
        "stop": sequence.stop,
        "lengths_m": None if sequence.lengths_m is None else list(sequence.lengths_m),
        "positions_only": sequence.positions_only,
        "exact_truth": _has_exact_truth(sequence),
        "map": sequence.map,
        "covered": [list(span) for span in sequence.covered],
        "code": code_digest(),
        "packages": package_versions(),
    }
    identity: dict[str, Any] = {}
    if sequence.source is not None:
        kind, path = _source(sequence.source, data)
        job["source"] = f"{kind}{path}"
        identity["source"] = [kind, digests.of(path)]
        identity["bytes"] = digests.bytes_of(path)
    else:
        job["render"] = render_of(sequence, data, digests, seed if sequence.render_each_seed else 0)
        identity["render"] = job["render"]["key"]
        identity["bytes"] = None
    if sequence.reference is not None:
        job["reference"] = str((data / sequence.reference).absolute())
        identity["reference"] = digests.of(Path(job["reference"]))
        read_trajectory(Path(job["reference"]))  # damaged: named before the first task runs
    return {**job, **shared}, {**identity, **shared}


def _has_exact_truth(sequence: Sequence) -> bool:
    exact = bool(sequence.render) if sequence.exact_truth is None else sequence.exact_truth
    return exact and not sequence.positions_only


def _source(text: str, data: Path) -> tuple[str, Path]:
    """Split `kind:path` into `kind:` (or nothing) and an absolute path."""
    head, colon, tail = text.partition(":")
    if colon and head in READERS and not (data / text).exists():
        return f"{head}:", (data / tail).absolute()
    return "", (data / text).absolute()


def _file_settings(config: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield settings that name a file: their path a.b.c, and where the value is."""

    def walk(section: dict[str, Any], prefix: str) -> Iterator[tuple[str, dict[str, Any], str]]:
        for key, value in section.items():
            if isinstance(value, dict):
                yield from walk(value, f"{prefix}{key}.")
            elif isinstance(value, str) and _FILE_SETTINGS.fullmatch(f"{prefix}{key}"):
                yield f"{prefix}{key}", section, key

    return walk(config, "")


def _without(config: dict[str, Any], settings: Iterable[str], prefix: str = "") -> dict[str, Any]:
    """Return nested settings without some, by their paths: where a file lies does not matter, what is in it does."""
    return {
        key: _without(value, settings, f"{prefix}{key}.") if isinstance(value, dict) else value
        for key, value in config.items()
        if f"{prefix}{key}" not in settings
    }


def _peers(suite: Suite, data: Path, digests: InputDigests, folder: Path) -> Iterator[Task]:
    """Yield one task for each file SEQUENCE.SYSTEM.tum whose sequence is in the suite."""
    if not folder.is_dir():
        raise ConfigError(f"--peers {folder}: no such folder; give one with files SEQUENCE.SYSTEM.tum")
    found = False
    for sequence in suite.sequences:
        for path in sorted(folder.glob("*.tum")):
            if not path.name.startswith(f"{sequence.name}."):
                continue
            found = True
            system = path.name[len(sequence.name) + 1 : -len(".tum")]
            task = Task(sequence.name, system, None, "", {})
            try:
                job, identity = _common(sequence, data, digests, 0)
                identity["trajectory"] = digests.of(path)
                config = as_dict(config_of(suite, sequence, next(iter(suite.configurations)), 0))["dataset"]
                job |= {"kind": "peer", "config": {"dataset": config}, "trajectory": str(path.absolute())}
                yield replace(task, job=job, key=digest_of([_FORM, "peer", identity, config]))
            except DataError as error:
                yield replace(task, failure=" ".join(str(error).split()))
    if not found:
        names = ", ".join(s.name for s in suite.sequences[:5])
        raise ConfigError(f"--peers {folder}: no file SEQUENCE.SYSTEM.tum of a sequence of the suite ({names}, …)")
