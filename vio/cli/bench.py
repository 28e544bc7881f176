"""`vio bench`: many recordings, configurations and seeds in one table; comparison of two of
them.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from vio.cli.output import ProgressBar, print_result
from vio.errors import ConfigError, StoppedError
from vio.files.printable import printable

if TYPE_CHECKING:
    from vio.bench.bench import Place
    from vio.bench.suite import Suite


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "bench",
        help="run a suite of recordings into one table, or compare two",
        description="Run every sequence of a suite with every configuration and seed, side by "
        "side, and write tables "
        "and a report. SUITE is a YAML file or the name of a shipped suite: small, rendered, "
        "realistic, kitti, euroc, "
        "tumvi. 'vio bench compare A B' says what became better or worse from one output folder to "
        "another, and "
        "'vio bench compare A --between X Y' from one configuration or system to another.",
    )
    parser.add_argument(
        "suite", metavar="SUITE", help="YAML file, name of a shipped suite, or 'compare'"
    )
    parser.add_argument(
        "folders", metavar="FOLDER", nargs="*", type=Path, help="compare: output folders"
    )
    parser.add_argument(
        "--between", nargs=2, metavar=("X", "Y"), help="compare: these systems, X of A and Y of B"
    )
    parser.add_argument(
        "--data", type=Path, metavar="DIR", help="folder of the recordings (default: the suite's)"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of tables and report (default bench/NAME)"
    )
    parser.add_argument(
        "--cache",
        type=Path,
        metavar="DIR",
        help="results of tasks and renders, kept (default bench/cache)",
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help="processes (default: one a processor)"
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="a Dask scheduler, tcp://…; needs the extra cluster"
    )
    parser.add_argument(
        "--peers",
        type=Path,
        metavar="DIR",
        help="other systems' SEQUENCE.SYSTEM.tum, for the tables",
    )
    parser.add_argument(
        "--run-peer",
        choices=("spectacularai", "basalt"),
        help="first run this system on the suite's recordings, as further rows of the tables: "
        "spectacularai in an environment of its own below --cache (made on request; its licence is "
        "said: free for non-commercial use), basalt by --peer-program",
    )
    parser.add_argument(
        "--peer-program", type=Path, metavar="PATH", help="a basalt_vio that you have built"
    )
    parser.add_argument(
        "--peer-settings", type=Path, metavar="FILE", help="its settings (default: its own)"
    )
    parser.add_argument("--only", default="", metavar="NAME,…", help="these sequences alone")
    parser.add_argument(
        "--configurations", default="", metavar="NAME,…", help="these configurations alone"
    )
    parser.add_argument("--seeds", metavar="N,…", help="in the place of the suite's seeds")
    parser.add_argument(
        "--time-limit", type=float, metavar="S", help="seconds of a task; then it has no result"
    )
    parser.add_argument(
        "--list",
        action="store_true",
        help="say which recordings are there and which not; run nothing",
    )
    parser.add_argument(
        "--revision",
        metavar="REV",
        help="run this git revision too, interleaved, and compare: A is the revision, B this code",
    )
    parser.add_argument(
        "--identity",
        choices=("content", "stat"),
        default="content",
        help="what an input is known by: its bytes, read once (default), or names, sizes and times "
        "of change",
    )
    parser.add_argument(
        "--factor",
        type=float,
        default=2.0,
        metavar="X",
        help="compare: a single sequence that changes by more than this is shown (default 2)",
    )
    parser.add_argument(
        "--margin",
        type=float,
        default=1.1,
        metavar="X",
        help="compare: a change below this is none (default 1.1)",
    )
    parser.add_argument(
        "--folds",
        action="store_true",
        help="choose a configuration on one half of the rigs and judge it on the other, both ways; "
        "compare: A and B are the choice",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def execute(args: argparse.Namespace) -> int:
    if args.suite == "compare":
        if len(args.folders) != 2 and not (args.between and len(args.folders) == 1):
            raise ConfigError(
                "vio bench compare takes two output folders, or one with --between X Y, got "
                f"{len(args.folders)}"
            )
        return _compare(args)
    if args.folders:
        raise ConfigError(
            f"vio bench takes one suite; what is {args.folders[0]}? To compare: vio bench compare "
            "A B"
        )
    return _bench(args)


def _bench(args: argparse.Namespace) -> int:
    from vio.bench.bench import bench
    from vio.bench.revision import revision_folder, run_in_turns

    if args.workers is not None and not 1 <= args.workers <= 1024:
        raise ConfigError(f"--workers takes 1 to 1024 processes, got {args.workers}")
    suite = _suite_of(args)
    place = _place(suite, args)
    if args.list:
        return _list(suite, place.data, args)
    if args.run_peer is not None:
        place = _with_peer(suite, place, args)
    if args.revision is not None:
        run_in_turns(
            suite,
            place,
            args.revision,
            say=lambda text: None if args.quiet else print(text, file=sys.stderr),
        )
        args.folders = [revision_folder(place, args.revision), place.out]
        return _compare(args)
    try:
        with ProgressBar(suite.name, unit="tasks") as bar:
            result = bench(suite, place, (lambda done, total: None) if args.quiet else bar.update)
    except KeyboardInterrupt as stop:  # or another signal, which has a number
        text = f"interrupted; finished tasks are kept in {place.cache}, and the same command goes on with the others"
        raise StoppedError(text, status=128 + getattr(stop, "number", 2)) from stop
    return _report(args, place.out, result)


def _place(suite: Suite, args: argparse.Namespace) -> Place:
    """Return where the suite's recordings, results and cache are, and where it runs."""
    from vio.bench.bench import Place
    from vio.bench.suite import SHIPPED

    data = args.data
    if data is None:
        if suite.folder == SHIPPED:
            data = Path()
        else:
            data = suite.folder
    return Place(
        data=data,
        out=args.out or Path("bench") / suite.name,
        cache=args.cache or Path("bench") / "cache",
        workers=args.workers or os.cpu_count() or 1,
        scheduler=args.scheduler,
        identity=args.identity,
        peers=args.peers,
    )


def _suite_of(args: argparse.Namespace) -> Suite:
    """Return the suite that is named, with the parts, seeds and time limit that are asked for."""
    from vio.bench.suite import chosen, read_suite

    suite = chosen(read_suite(args.suite), _names(args.only), _names(args.configurations))
    _check_renders(suite)
    if args.seeds is not None:
        suite = _with_seeds(suite, args.seeds)
    if args.time_limit is not None:
        if not args.time_limit > 0:
            raise ConfigError(f"--time-limit takes seconds above 0, got {args.time_limit:g}")
        suite = replace(suite, time_limit_s=args.time_limit)
    return suite


def _with_peer(suite: Any, place: Any, args: argparse.Namespace) -> Any:
    """Run another system, and return the place with its trajectories."""
    from vio.bench.run_peers import Program, run_peer

    if args.peers is not None:
        raise ConfigError("give --peers or --run-peer, not both")
    folder = run_peer(
        args.run_peer,
        suite,
        place.data,
        place.cache,
        lambda text: None if args.quiet else print(text, file=sys.stderr),
        None if args.peer_program is None else Program(args.peer_program, args.peer_settings),
    )
    return replace(place, peers=folder)


def _list(suite: Any, data: Path, args: argparse.Namespace) -> int:
    """Print what is there and what is missing; the status is 1 where something is."""
    from vio.bench.tasks import inputs_of

    missing: dict[str, list[str]] = {}
    lines = []
    for sequence in suite.sequences:
        paths = [str(path) for path in inputs_of(sequence, data) if not path.exists()]
        if paths:
            missing[sequence.name] = paths
        lines.append((sequence.name, f"missing: {', '.join(paths)}" if paths else "there"))
    runs = len(suite.sequences) * len(suite.configurations) * len(suite.seeds)
    seeds = ", ".join(map(str, suite.seeds))
    lines.append(("runs", f"{runs}: {', '.join(suite.configurations)}; seeds {seeds}"))
    if missing and suite.publisher is not None:
        lines.append(("from", suite.publisher))
    facts = {
        "suite": suite.name,
        "missing": missing,
        "publisher": suite.publisher,
        "runs": runs,
    }
    width = max(len(name) for name, _ in lines)
    print_result(facts, lines, as_json=args.json, name_width=width)
    return 1 if missing else 0


def _report(args: argparse.Namespace, out: Path, result: Any) -> int:
    """Print the result; the status is 1 where a run has none."""
    from vio.bench.folds import cross_validate, fold_lines
    from vio.bench.tables import summary_of, summary_rows

    lines = [
        (system, f"{done} of {count} sequences; median {_medians(cells) or 'nothing'}")
        for system, (done, count, cells) in summary_of(summary_rows(result.outcomes)).items()
    ]
    lines.append(("tasks", f"{len(result.outcomes)}, of which {result.reused} were done before"))
    lines.append(("report", f"{out / 'report.html'}, tables.md, tables.tex, table.csv, runs.csv"))
    facts = {**result.facts, "out": str(out), "reused": result.reused}
    folds = None
    if args.folds and not result.failures:
        folds = cross_validate(result.outcomes)
    if folds is not None:
        facts["folds"] = folds.as_dict()
    width = max(10, *(len(name) for name, _ in lines))
    print_result(facts, lines, as_json=args.json, name_width=width)
    if folds is not None and not args.json:
        print("\n".join(fold_lines(folds)))
    for outcome in result.failures:
        print(
            printable(f"failed: {outcome.sequence}, {outcome.system}: {outcome.failure}"),
            file=sys.stderr,
        )
    return int(bool(result.failures))


def _medians(cells: Mapping[str, Any]) -> str:
    """Return the medians of a system's figures with their titles."""
    from vio.bench.tables import METRICS, number

    return ", ".join(
        f"{m.title} {number(cells[m.name].median, m.digits)}" for m in METRICS if m.name in cells
    )


def _compare(args: argparse.Namespace) -> int:
    """Print what changed; the status is 1 where something became worse, 3 where that is
    undecided.
    """
    from vio.bench.compare import EXIT_STATUS, compare, comparison_lines

    a = args.folders[0]
    b = args.folders[-1]
    if args.between is None:
        between = None
    else:
        between = tuple(args.between)
    if args.folds:
        return _compare_folds(a, b, args)
    result = compare(a, b, between=between, factor=args.factor, margin=args.margin)
    if args.json:
        print_result(result.as_dict(), (), as_json=True)
    else:
        print("\n".join(comparison_lines(result)))
    return EXIT_STATUS[result.verdict]


def _compare_folds(a: Path, b: Path, args: argparse.Namespace) -> int:
    """Print whether B wins over A on rigs that it was not chosen on; the status is 3 where it does
    not.
    """
    from vio.bench.bench import read_bench
    from vio.bench.folds import cross_validate, fold_lines

    if args.between is not None and a == b:
        sides = [
            (a, args.between[0], "A"),
            (a, args.between[1], "B"),
        ]
    else:
        of_a, of_b = args.between or (None, None)
        sides = [(a, of_a, "A"), (b, of_b, "B")]
    outcomes = [
        replace(outcome, system=f"{side}: {outcome.system}")
        for folder, system, side in sides
        for outcome in read_bench(folder)[0]
        if system in (None, outcome.system)
    ]
    result = cross_validate(outcomes)
    if args.json:
        print_result(result.as_dict(), (), as_json=True)
    else:
        print("\n".join(fold_lines(result)))
    return 0 if result.wins else 3


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _check_renders(suite: Any) -> None:
    """Name options that `vio render` does not take, before anything is rendered."""
    from vio.cli import render
    from vio.errors import ConfigError

    class Parser(argparse.ArgumentParser):  # of the subcommand, too
        def error(self, message: str) -> NoReturn:
            raise ConfigError(message)

    parser = Parser()
    render.add_parser(parser.add_subparsers())
    for sequence in suite.sequences:
        try:
            # one without a render passes
            parser.parse_args(["render", *sequence.render, "--out", "."])
        except ConfigError as error:
            raise ConfigError(
                f"{suite.name}, sequence {sequence.name}: vio render: {error}"
            ) from error


def _with_seeds(suite: Any, text: str) -> Any:
    try:
        seeds = tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"--seeds takes whole numbers such as 0,1,2, got '{text}'") from error
    if len(set(seeds)) != len(seeds) or any(not 0 <= seed < 2**32 for seed in seeds):
        raise ConfigError(f"--seeds takes different numbers from 0 to 2^32 - 1, got '{text}'")
    return replace(suite, seeds=seeds)
