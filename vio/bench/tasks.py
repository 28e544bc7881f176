"""The tasks of a bench: runs of a sequence with a configuration and seed, and trajectories of
other systems.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from vio.bench.identity import (
    InputDigests,
    code_digest,
    digest_of,
    package_versions,
    render_code_digest,
)
from vio.bench.suite import Sequence, Suite, config_of
from vio.config import as_dict
from vio.datasets import readers
from vio.errors import ConfigError, DataError
from vio.files.trajectories import read_trajectory

# values of `vio render` in the place of a file
_NO_FILES = ("handheld", "car", "simulated", "none")
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
    # of the inputs in bytes, infinite for what must be rendered: the largest tasks are done first
    size: float = 0.0


def tasks_of(
    suite: Suite, data: Path, digests: InputDigests, peers: Path | None = None
) -> list[Task]:
    """Return all tasks of a suite, in the order of its tables; an input that is missing makes a
    failed task.

    Raises:
        ConfigError: the folder of other systems' trajectories does not exist or holds none of a
            sequence of the suite.
    """
    tasks = [  # of one configuration all sequences first, so that renders are made side by side
        _task(suite, sequence, name, seed, data, digests)
        for name, sequence, seed in product(suite.configurations, suite.sequences, suite.seeds)
    ]
    if peers is not None:
        tasks += _peers(suite, data, digests, peers)
    for task in tasks:
        # no part of the key: a result does not depend on it
        task.job["time_limit_s"] = suite.time_limit_s
    return tasks


def inputs_of(sequence: Sequence, data: Path) -> list[Path]:
    """Return what a sequence reads: its recording or the files of its render, and its ground
    truth.
    """
    if sequence.source is None:
        paths = []
    else:
        paths = [_source(sequence.source, data)[1]]
    paths += [
        data / value
        for head, value in _render_words(sequence)
        if head is not None and value not in _NO_FILES
    ]
    return paths + ([] if sequence.reference is None else [data / sequence.reference])


def render_of(sequence: Sequence, data: Path, digests: InputDigests, seed: int) -> dict[str, Any]:
    """Return the arguments of a render, with files as absolute paths, and the key of its folder.

    Raises:
        DataError: a file that it reads cannot be read.
    """
    words = []
    known = []
    for head, value in _render_words(sequence):
        if head is not None and value and not value.startswith("-") and (data / value).exists():
            words.append(f"{head}{(data / value).absolute()}")
            known.append([head, digests.of(data / value)])
        else:
            words.append(f"{head or ''}{value}")
            known.append([words[-1]])
    words += ["--seed", str(seed)]
    key = digest_of([_FORM, known, seed, render_code_digest(), package_versions()])
    return {"words": words, "key": key}


def _render_words(sequence: Sequence) -> Iterator[tuple[str | None, str]]:
    """Yield the words of a render in two parts: of a path what stands before it, maybe nothing;
    of others None.
    """
    before = ""
    for word in sequence.render:
        option, equals, value = word.rpartition("=") if word.startswith("--") else ("", "", word)
        takes_path = (option or before) in ("--trajectory", "--imu", "--frame-times")
        yield (
            (f"{option}{equals}", value)
            if takes_path and (equals or not word.startswith("-"))
            else (None, word)
        )
        before = word


def _task(
    suite: Suite, sequence: Sequence, name: str, seed: int, data: Path, digests: InputDigests
) -> Task:
    task = Task(sequence.name, name, seed, "", {})
    try:
        job, identity = _common(sequence, data, digests, seed)
        if sequence.map_of is not None:
            (first,) = (s for s in suite.sequences if s.name == sequence.map_of)
            job["first"], identity["first"] = _common(first, data, digests, seed)
            job["first"]["config"], identity["first"]["config"] = _settings(
                suite, first, name, seed, data, digests
            )
        config, known = _settings(suite, sequence, name, seed, data, digests)
    except DataError as error:
        return replace(task, failure=" ".join(str(error).split()))
    job |= {"kind": "run", "config": config}
    if identity["bytes"] is None:
        size = math.inf
    else:
        size = identity["bytes"]
    return replace(task, job=job, key=digest_of([_FORM, "run", identity, known]), size=size)


def _settings(
    suite: Suite, sequence: Sequence, name: str, seed: int, data: Path, digests: InputDigests
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the settings of a run, and the part of them that the result depends on: files by
    their content.
    """
    config = as_dict(config_of(suite, sequence, name, seed))
    files = dict[str, str]()
    return config, {**_without_files(config, data, digests, files), "files": files}


def _common(
    sequence: Sequence, data: Path, digests: InputDigests, seed: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what a worker needs for a sequence, and the part of it that the result depends on."""
    job: dict[str, Any] = {
        "source": None,
        "render": None,
        "reference": None,
        "scratch": None,
        "first": None,
    }
    if sequence.exact_truth is None:
        exact = bool(sequence.render)
    else:
        exact = sequence.exact_truth
    shared: dict[str, Any] = {
        "start": sequence.start,
        "stop": sequence.stop,
        "lengths_m": None if sequence.lengths_m is None else list(sequence.lengths_m),
        "positions_only": sequence.positions_only,
        "exact_truth": exact and not sequence.positions_only,
        "map": sequence.map,
        "covered": [list(span) for span in sequence.covered],
        "reverse": sequence.reverse,
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


def _source(text: str, data: Path) -> tuple[str, Path]:
    """Split `kind:path` into `kind:` (or nothing) and an absolute path."""
    head, colon, tail = text.partition(":")
    if colon and head in readers() and not (data / text).exists():
        return f"{head}:", (data / tail).absolute()
    return "", (data / text).absolute()


def source_of(text: str, data: Path) -> str:
    """Return a sequence's source with an absolute path, as `open_dataset` takes it."""
    kind, path = _source(text, data)
    return f"{kind}{path}"


def _without_files(
    config: dict[str, Any],
    data: Path,
    digests: InputDigests,
    files: dict[str, str],
    prefix: str = "",
) -> dict[str, Any]:
    """Return settings without those that name files: where a file lies does not matter, what is in
    it does.

    In `config` these become absolute paths; `files` takes their digests by the settings' names.
    """
    others = {}
    for key, value in config.items():
        setting = f"{prefix}{key}"
        if isinstance(value, dict):
            others[key] = _without_files(value, data, digests, files, f"{setting}.")
        elif isinstance(value, str) and _FILE_SETTINGS.fullmatch(setting):
            config[key] = str((data / value).absolute())
            files[setting] = digests.of(Path(config[key]))
        else:
            others[key] = value
    return others


def _peers(suite: Suite, data: Path, digests: InputDigests, folder: Path) -> Iterator[Task]:
    """Yield one task for each file SEQUENCE.SYSTEM.tum whose sequence is in the suite."""
    if not folder.is_dir():
        raise ConfigError(
            f"--peers {folder}: no such folder; give one with files SEQUENCE.SYSTEM.tum"
        )
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
                config = as_dict(config_of(suite, sequence, next(iter(suite.configurations)), 0))[
                    "dataset"
                ]
                job |= {
                    "kind": "peer",
                    "config": {"dataset": config},
                    "trajectory": str(path.absolute()),
                }
                yield replace(task, job=job, key=digest_of([_FORM, "peer", identity, config]))
            except DataError as error:
                yield replace(task, failure=" ".join(str(error).split()))
    if not found:
        names = ", ".join(s.name for s in suite.sequences[:5])
        raise ConfigError(
            f"--peers {folder}: no file SEQUENCE.SYSTEM.tum of a sequence of the suite ({names}, …)"
        )
