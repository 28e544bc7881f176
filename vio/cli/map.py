"""`vio map`: show what a map holds, and make one of two."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "map",
        help="show or merge maps",
        description="Show what a map holds, or merge two maps that show places in common. `vio run --map` makes maps.",
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    show = actions.add_parser("show", help="what a map holds")
    show.add_argument("map", type=Path, metavar="MAP", help="a map's file")
    merge = actions.add_parser("merge", help="make one map of two; the frame is that of the first")
    merge.add_argument("first", type=Path, metavar="A", help="a map's file")
    merge.add_argument("second", type=Path, metavar="B", help="a map's file")
    merge.add_argument("--out", type=Path, required=True, metavar="MAP", help="the merged map, a new file")
    for action in (show, merge):
        action.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(execute=execute)


def execute(args: argparse.Namespace) -> int:
    """Run the subcommand."""
    from vio.cli.output import print_result
    from vio.mapping.files import describe_map, merge_maps

    facts = describe_map(args.map) if args.action == "show" else merge_maps(args.first, args.second, args.out)
    return print_result(facts, _rows(facts), as_json=args.json)


def _rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what a map holds as table rows."""
    extent = " x ".join(f"{length:.1f}" for length in facts["extent_m"])
    rows = [
        ("map", f"{facts['map']} ({facts['bytes'] / 1e6:.1f} MB, version {facts['version']})"),
        ("keyframes", f"{facts['keyframes']}, within {extent} m"),
        ("loops", f"{facts['loops']}, and {facts['loops_rejected']} that contradict the others"),
    ]
    for number, session in enumerate(facts["sessions"]):
        joined = "" if session["joined"] else "; not joined to the first session"
        path = f"{session['keyframes']} keyframes, path {session['path_m']:.1f} m"
        c = session["camera"]
        size = f"{c['width']}x{c['height']} px, " if c["width"] else ""
        rig = f"{size}f {c['fu']:.1f} px, baseline {c['baseline_m']:.4g} m"
        rows.append((f"session {number}", f"{session['source']}: {path}; {rig}{joined}"))
    return rows
