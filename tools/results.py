"""Run the suites behind the tables of README and docs/results.md, and write both.

    python -m tools.results --data DIR [--peers DIR] [--work DIR] [--only SUITE …] [--workers N]
    python -m tools.results --tables

Each suite is run by `vio bench` among the recordings (docs/results.md says what lies where), which
keeps the results of tasks: an interrupted call goes on where it stopped. docs/results.json holds
the figures with commit, machine and date. A table of a document stands between
`<!-- suite: NAME key=value … -->` and `<!-- end -->`:

    figure=ate_m              sequences down, systems across; `a+b` is the first of two that has
                              the sequence, `length=m` adds the length of each
    figures=ate_m,cpu_ms      a line for each sequence and system, a column for each figure, or for
    `success` sequences=… systems=…     these alone, in this order

the machines and versions of all suites between `<!-- origins -->` and `<!-- end -->`, and a figure
in a sentence between `<!-- figure: SUITE/SEQUENCE/SYSTEM/FIGURE/DECIMALS -->` and
`<!-- end figure -->`. `--tables` writes them from docs/results.json.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from vio.bench.bench import has_succeeded, read_bench
from vio.bench.suite import SUCCESS_PERCENT, read_suite
from vio.bench.tables import BY_NAME, Outcome, Row, full_table, matrix, summary_rows

ROOT = Path(__file__).resolve().parent.parent
FIGURES = "docs/results.json"
DOCUMENTS = ("docs/results.md", "README.md")
OWN = ROOT / "tools" / "suites"
SUITES: Mapping[str, tuple[str, ...]] = {  # by name: what `vio bench` is called with
    "paper": (str(OWN / "paper.yaml"),),
    "drives": (str(OWN / "drives.yaml"),),
    "tracks": (str(OWN / "tracks.yaml"),),
    "real": (str(OWN / "real.yaml"),),
    "real_imu": (str(OWN / "real_imu.yaml"),),
    "flights": (str(OWN / "flights.yaml"),),
    "rendered": ("rendered", "--seeds", "0"),
    "realistic": ("realistic",),
    "maps": (str(OWN / "maps.yaml"),),
    "speed": (str(OWN / "speed.yaml"), "--workers", "1"),
}
# suites beside trajectories of other systems, where there are any
PEERS = ("real", "real_imu", "flights", "maps")
_KEPT = ("suite", "version", "commit", "machine", "written", "packages", "titles")
_DIGITS = 6  # significant, of figures in the file
_TABLE = re.compile(r"(<!-- suite: (\w+)((?: \w+=\S+)+) -->\n).*?(<!-- end -->)", re.DOTALL)
_ORIGINS = re.compile(r"(<!-- origins -->\n).*?(<!-- end -->)", re.DOTALL)
_FIGURE = re.compile(r"(<!-- figure: (\S+) -->).*?(<!-- end figure -->)", re.DOTALL)


class Results:
    """All figures of docs/results.json."""

    def __init__(self, suites: Mapping[str, Any]) -> None:
        self.suites = suites
        self._rows = {
            name: summary_rows(map(_outcome, facts["runs"])) for name, facts in suites.items()
        }

    def rows(
        self, suite: str, sequences: Sequence[str] = (), systems: Sequence[str] = ()
    ) -> list[Row]:
        """Return the rows of a suite, or those asked for, in that order.

        Raises:
            KeyError: there is none of a name.
        """
        rows = self._rows[suite]
        for name, known in [(s, [r.sequence for r in rows]) for s in sequences] + [
            (s, [r.system for r in rows]) for s in systems
        ]:
            if name not in known:
                raise KeyError(
                    f"{FIGURES} has no {name} in suite {suite}; it holds "
                    f"{', '.join(dict.fromkeys(known))}"
                )
        order = [list(names) for names in (sequences, systems)]
        own = [
            r
            for r in rows
            if (not sequences or r.sequence in sequences) and (not systems or r.system in systems)
        ]
        return sorted(
            own,
            key=lambda r: [
                o.index(n) if o else 0 for o, n in zip(order, (r.sequence, r.system), strict=True)
            ],
        )

    def table(self, suite: str, words: str) -> str:
        """Return a table with the line of its origin, or say that its suite has not been run."""
        if suite in SUITES and suite not in self.suites:
            return f"*Suite `{suite}` has not been run yet: `make results`.*\n"
        given = dict(word.split("=", 1) for word in words.split())
        lists = {
            key: given.pop(key).split(",") if key in given else []
            for key in ("sequences", "systems", "figures")
        }
        figure = given.pop("figure", None)
        length = given.pop("length", None)
        if given or bool(lists["figures"]) == bool(figure):
            raise KeyError(
                f"table of {suite}: figure= or figures=, sequences= and systems=; not "
                f"'{words.strip()}'"
            )
        systems = [name for joined in lists["systems"] for name in joined.split("+")]
        rows = self.rows(suite, lists["sequences"], systems)
        facts = self.suites[suite]
        lines: Iterable[str]
        if figure:
            rows = _joined(rows, lists["systems"])
            shown = [joined.partition("+")[0] for joined in lists["systems"]]
            metric = BY_NAME[figure]
            lines = matrix(rows, metric, shown, facts["titles"], for_documents=True)
            if length:
                lines = _with_lengths(lines, rows)
        else:
            metrics = [BY_NAME[name] for name in lists["figures"] if name != "success"]
            success = "success" in lists["figures"]
            lines = full_table(rows, metrics, facts["titles"], for_documents=True, success=success)
        origin = f"*Suite `{suite}`, commit {facts['commit']}, {facts['written'][:10]}.*"
        return "\n".join([*lines, "", origin, ""])

    def origins(self) -> str:
        """Return a list of the machines and versions behind the suites."""
        suites_of: dict[str, list[str]] = {}
        for name, facts in self.suites.items():
            packages = (f"{key} {value}" for key, value in facts["packages"].items())
            where = f"stereo-vio {facts['version']}, {facts['machine']}; {', '.join(packages)}"
            suites_of.setdefault(where, []).append(f"`{name}`")
        rows = [f"- {', '.join(names)}: {where}" for where, names in suites_of.items()]
        return "\n".join([*rows, ""])

    def figure(self, address: str) -> str:
        """Return the median of a figure by SUITE/SEQUENCE/SYSTEM/FIGURE/DECIMALS.

        KeyError where there is none.
        """
        suite, sequence, system, name, decimals = address.split("/")
        (row,) = self.rows(suite, [sequence], [system])
        return f"{row.cells[name].median:.{int(decimals)}f}"


def _joined(rows: Sequence[Row], systems: Sequence[str]) -> list[Row]:
    """Return rows in which systems `a+b` are one, `a`: for each sequence the first that has it."""
    names = {own: joined.split("+") for joined in systems for own in joined.split("+")}
    held = {(r.sequence, r.system) for r in rows}
    found = []
    for row in rows:
        same = names.get(row.system, [row.system])
        first = next(name for name in same if (row.sequence, name) in held)
        if row.system == first:
            found.append(replace(row, system=same[0]))
    return found


def _with_lengths(lines: Iterable[str], rows: Sequence[Row]) -> list[str]:
    """Return a table with the length of each sequence in its second column."""
    lengths = dict.fromkeys((row.sequence for row in rows), " – ")
    for row in rows:
        if "reference_m" in row.cells:
            lengths[row.sequence] = f" {row.cells['reference_m'].median:.0f} m "
    added = iter([" length ", "---:", *lengths.values()])
    whole = []
    for line in lines:
        cell = next(added, None)
        if cell is None:  # a line below the table
            whole.append(line)
            continue
        _, first, *others = line.split("|")
        whole.append("|".join(["", first, cell, *others]))
    return whole


def _outcome(values: Sequence[Any]) -> Outcome:
    sequence, system, seed, figures, measured, failure, absent = values
    succeeded = has_succeeded({"figures": figures, "failure": failure}, SUCCESS_PERCENT)
    return Outcome(
        sequence,
        system,
        seed,
        "",
        figures,
        measured,
        failure,
        None,
        absent=absent,
        succeeded=succeeded,
    )


def read_results(root: Path = ROOT) -> Results:
    """Read docs/results.json."""
    return Results(json.loads((root / FIGURES).read_text(encoding="utf-8")))


def taken(folder: Path) -> dict[str, Any]:
    """Return what is kept of a bench's folder."""
    outcomes, facts = read_bench(folder)
    runs = [
        [
            o.sequence,
            o.system,
            o.seed,
            _rounded(o.figures),
            _rounded(o.measured),
            o.failure,
            dict(o.absent),
        ]
        for o in outcomes
    ]
    return {**{name: facts[name] for name in _KEPT}, "runs": runs}


def _rounded(values: Mapping[str, Any]) -> dict[str, float]:
    known = {name: values[name] for name in BY_NAME if values.get(name) is not None}
    return {name: float(f"{value:.{_DIGITS}g}") for name, value in known.items()}


def write_json(suites: Mapping[str, Any], root: Path = ROOT) -> None:
    """Write docs/results.json, one run a line; suites that are not given stay."""
    path = root / FIGURES
    known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    merged = {name: facts for name, facts in sorted({**known, **suites}.items()) if name in SUITES}
    lines = ",\n".join(
        f'{json.dumps(name)}: {json.dumps({k: facts[k] for k in _KEPT})[:-1]}, "runs": [\n'
        + ",\n".join(json.dumps(run) for run in facts["runs"])
        + "\n]}"
        for name, facts in merged.items()
    )
    path.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8", newline="\n")


def with_figures(text: str, results: Results) -> str:
    """Return a document's text with its marked tables and figures as measured; nothing else
    changes.

    Raises:
        KeyError: a suite, sequence, system or figure is not known.
    """
    text = _TABLE.sub(lambda m: m[1] + results.table(m[2], m[3]) + m[4], text)
    text = _ORIGINS.sub(lambda m: m[1] + results.origins() + m[2], text)
    return _FIGURE.sub(lambda m: m[1] + results.figure(m[2]) + m[3], text)


def write_documents(results: Results, root: Path = ROOT) -> None:
    """Write the marked tables and figures of all documents."""
    for name in DOCUMENTS:
        path = root / name
        path.write_text(
            with_figures(path.read_text(encoding="utf-8"), results), encoding="utf-8", newline="\n"
        )


def run_suite(name: str, args: argparse.Namespace) -> dict[str, Any]:
    """Run one suite, and take its figures; runs that fail are figures, too.

    Raises:
        SystemExit: it wrote no results.
    """
    out = args.work / name
    words = [
        *SUITES[name],
        "--data",
        str(args.data),
        "--out",
        str(out),
        "--cache",
        str(args.work / "cache"),
    ]
    names = {s.name for s in read_suite(SUITES[name][0]).sequences if name in PEERS}
    if args.peers is not None and any(
        path.name.split(".")[0] in names for path in args.peers.glob("*.tum")
    ):
        words += ["--peers", str(args.peers)]
    words += (
        ["--workers", str(args.workers)]
        if args.workers is not None and "--workers" not in words
        else []
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    (out / "bench.json").unlink(missing_ok=True)
    subprocess.run([sys.executable, "-m", "vio", "bench", *words], env=environment, check=False)
    if not (out / "bench.json").is_file():
        raise SystemExit(f"vio bench {' '.join(words)}: wrote no results")
    return taken(out)


def main() -> int:
    """Run the suites, then write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    folder = partial(_folder, parser)
    parser.add_argument(
        "--data", type=folder, metavar="DIR", help="the recordings (make results VIO_DATA=DIR)"
    )
    parser.add_argument("--peers", type=folder, metavar="DIR", help="trajectories of other systems")
    parser.add_argument(
        "--work",
        type=Path,
        default=Path("results"),
        metavar="DIR",
        help="renders and results, kept",
    )
    parser.add_argument(
        "--only", nargs="+", choices=SUITES, metavar="SUITE", help=f"of {' '.join(SUITES)}"
    )
    parser.add_argument("--workers", type=int, metavar="N", help="as of vio bench")
    parser.add_argument(
        "--tables",
        action="store_true",
        help="run nothing, write the documents from docs/results.json",
    )
    args = parser.parse_args()
    if not args.tables:
        if args.data is None:
            parser.error(
                "--data takes the folder of recordings; the end of docs/results.md says what lies "
                "there"
            )
        write_json({name: run_suite(name, args) for name in args.only or SUITES})
    results = read_results()
    write_documents(results)
    commits = {str(facts["commit"]) for facts in results.suites.values()}
    if len(commits) > 1 or any(commit.endswith("+") for commit in commits):
        print(f"the tables are of several states of the code: {', '.join(sorted(commits))}")
    return 0


def _folder(parser: argparse.ArgumentParser, text: str) -> Path:
    path = Path(text)
    if not text or not path.is_dir():
        parser.error(
            f"'{text}' is no folder; the end of docs/results.md says what lies in the folder of "
            "recordings"
        )
    return path.resolve()


if __name__ == "__main__":
    sys.exit(main())
