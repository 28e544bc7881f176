"""A suite with the code of another revision, in turns with ours: on a shared machine times
compare only so.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from vio.bench.bench import Place
from vio.bench.identity import ROOT
from vio.bench.suite import Sequence, Suite
from vio.errors import ConfigError, DataError
from vio.files.atomic import atomic_write_text


def revision_folder(place: Place, revision: str) -> Path:
    """Return where the results of a revision are."""
    return place.out.with_name(f"{place.out.name}@{revision.replace('/', '_')}")


def run_in_turns(
    suite: Suite, place: Place, revision: str, say: Callable[[str], None] = lambda text: None
) -> None:
    """Run each sequence with the revision's code, then with ours; at last write the tables of both.

    The revision's results are beside `place.out`; published figures are left out. `say` is called
    with what is run.

    Raises:
        ConfigError: this is no checkout, or it has no such revision.
        DataError: a bench cannot be run.
    """
    if place.scheduler is not None:
        raise ConfigError("--revision and --scheduler exclude each other: in turns on one machine")
    found = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "--verify", f"{revision}^{{commit}}"],
        capture_output=True,
        text=True,
        check=False,
    )
    if found.returncode:
        raise ConfigError(
            f"--revision {revision}: {ROOT} has no such revision "
            f"({found.stderr.strip() or 'no git'})"
        )
    tree = _checked_out(found.stdout.strip(), place.cache.absolute() / "revisions")
    place.out.mkdir(parents=True, exist_ok=True)
    file = place.out / "suite.yaml"
    atomic_write_text(file, yaml.safe_dump(_as_yaml(suite), sort_keys=False, allow_unicode=True))
    trees = {revision_folder(place, revision): tree, place.out: ROOT}
    for only in (*([s.name] for s in suite.sequences), []):
        for out, code in trees.items():
            say(f"{', '.join(only) or 'tables'}: {'this code' if code == ROOT else revision}")
            _run(file, place, out, code, only)


def _run(file: Path, place: Place, out: Path, code: Path, only: list[str]) -> None:
    folders = {"--data": place.data, "--out": out, "--cache": place.cache}
    command = [sys.executable, "-m", "vio", "bench", str(file.absolute()), "--quiet", "--json"]
    command += [
        word for option, folder in folders.items() for word in (option, str(folder.absolute()))
    ]
    command += ["--workers", str(place.workers), "--identity", place.identity]
    command += ["--only", ",".join(only)] if only else []
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(code), os.environ.get("PYTHONPATH", "")])
    }
    # its default: with a setting of numba, numba loads the loops of both
    environment.setdefault("NUMBA_OPT", "3")
    done = subprocess.run(
        command, cwd=code, env=environment, capture_output=True, text=True, check=False
    )
    # with results, a run has failed, which the comparison says
    if done.returncode and not done.stdout:
        last = (done.stderr.strip() or "no message").splitlines()[-1]
        raise DataError(f"vio bench with the code of {code}: {last}")


def _checked_out(commit: str, folder: Path) -> Path:
    """Unpack a commit into a folder of its own, once."""
    tree = folder / commit
    if not tree.is_dir():
        partial = folder / f"{commit}.partial"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        archive = subprocess.run(
            ["git", "-C", str(ROOT), "archive", commit], capture_output=True, check=True
        )
        subprocess.run(["tar", "-x", "-C", str(partial)], input=archive.stdout, check=True)
        partial.rename(tree)
    return tree


def _as_yaml(suite: Suite) -> dict[str, Any]:
    """Return a suite for any revision: without what only tables use, with absolute paths.

    Older revisions do not know all keys: what has its default is left out.
    """
    sequences = {
        s.name: {key: value for key, value in _changed(s).items() if key != "name"}
        for s in suite.sequences
    }
    configurations = {
        name: {
            **values,
            **(
                {"config": str(suite.folder / str(values["config"]))}
                if values.get("config")
                else {}
            ),
        }
        for name, values in suite.configurations.items()
    }
    limits = {
        key: value
        for key, value in _changed(suite).items()
        if key in ("time_limit_s", "success_percent")
    }
    known = {
        "name": suite.name,
        "sequences": sequences,
        "configurations": configurations,
        "seeds": list(suite.seeds),
    }
    return known | limits


def _changed(record: Suite | Sequence) -> dict[str, Any]:
    return {
        f.name: value for f in fields(record) if (value := getattr(record, f.name)) != f.default
    }
