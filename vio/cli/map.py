"""`vio map`: show and check what a map holds, make one of two, take parts out of one, serve one."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from vio.cli.output import print_result
from vio.cli.waiting import working
from vio.errors import ConfigError

DENSITY = 10
_POLL_S = 0.2  # between two looks at whether to stop


def parse_point(text: str) -> tuple[float, float, float]:
    """Return three coordinates.

    Raises:
        argparse.ArgumentTypeError: there are not three finite numbers.
    """
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise argparse.ArgumentTypeError(f"{text} is no point; give three numbers, such as 1,2.5,0")
    return x, y, z


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "map",
        help="show, check, merge, prune and serve maps",
        description="Show what a map holds, check it, merge two maps that show places in common, "
        "or keep a part of "
        "one. `vio run --map` makes maps.",
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    show = actions.add_parser("show", help="what a map holds")
    show.add_argument("map", type=Path, metavar="MAP", help="a map's file")
    merge = actions.add_parser(
        "merge",
        help="make one map of two, in any order; the frame is that of the one recorded first",
    )
    merge.add_argument("first", type=Path, metavar="A", help="a map's file")
    merge.add_argument("second", type=Path, metavar="B", help="a map's file")
    merge.add_argument(
        "--out", type=Path, required=True, metavar="MAP", help="the merged map, a new file"
    )
    merge.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="processes that look for places (default 1)",
    )
    check = actions.add_parser("check", help="read everything in a map against its checksums")
    drop = actions.add_parser(
        "drop", help="take a session out of a map, as `vio map show` numbers it"
    )
    prune = actions.add_parser(
        "prune", help="keep the most informative keyframes of each cubic metre"
    )
    extract = actions.add_parser("extract", help="a new map of the keyframes around a point")
    for action in (check, drop, prune, extract):
        action.add_argument("map", type=Path, metavar="MAP", help="a map's file")
    drop.add_argument("session", type=int, metavar="SESSION", help="its number")
    prune.add_argument(
        "--density",
        type=int,
        default=DENSITY,
        metavar="N",
        help=f"in a cubic metre (default {DENSITY})",
    )
    extract.add_argument(
        "--around",
        type=parse_point,
        required=True,
        metavar="X,Y,Z",
        help="m, in the map (--around=-1,2,0)",
    )
    extract.add_argument("--radius", type=float, required=True, metavar="M", help="m")
    extract.add_argument("--out", type=Path, required=True, metavar="MAP", help="a new file")
    serve = actions.add_parser(
        "serve", help="find image pairs of clients in a map, over HTTP, until Ctrl-C"
    )
    serve.add_argument("map", type=Path, metavar="MAP", help="a map's file; it stays as it is")
    serve.add_argument(
        "--host", default="127.0.0.1", help="address to listen at (default 127.0.0.1, this machine)"
    )
    serve.add_argument("--port", type=int, default=8734, help="port (default 8734)")
    serve.add_argument(
        "--session", type=int, metavar="N", help="whose rig the clients have (default the newest)"
    )
    for action in (show, merge, check, drop, prune, extract):
        action.add_argument("--json", action="store_true", help="print one JSON object")


def execute(args: argparse.Namespace) -> int:
    from vio.mapping import files

    if args.action == "serve":
        with working(lambda: None):  # until it is interrupted: a silence is no wait
            return _serve(args)
    if args.action == "prune" and args.density < 1:
        raise ConfigError("--density must be at least 1")
    if args.action == "merge" and not 1 <= args.workers <= 64:
        raise ConfigError(f"--workers takes 1 to 64 processes, got {args.workers}")
    actions = {
        "show": lambda: files.describe_map(args.map),
        "merge": lambda: _merge(args),
        "check": lambda: files.check_map(args.map),
        "drop": lambda: files.drop_session(args.map, args.session),
        "prune": lambda: files.prune_map(args.map, args.density),
        "extract": lambda: files.extract_map(args.map, args.out, args.around, args.radius),
    }
    facts = actions[args.action]()
    rows = _rows(facts)
    if args.action == "check":
        rows.append(("checked", "every row agrees with its checksum"))
    return print_result(facts, rows, as_json=args.json)


def _merge(args: argparse.Namespace) -> dict[str, Any]:
    from vio.mapping.merging import merge_maps
    from vio.numerics.threads import one_blas_thread

    with one_blas_thread():
        return merge_maps(args.first, args.second, args.out, workers=args.workers)


def _serve(args: argparse.Namespace) -> int:
    """Answer clients until a signal."""
    import sys
    import threading
    import time

    from vio.cli.stopping import StopRequest
    from vio.live.map_service import MapServer
    from vio.mapping.lookup import MapLookup
    from vio.numerics.threads import one_blas_thread

    with one_blas_thread(), StopRequest() as asked:
        lookup = MapLookup(args.map, args.session)
        server = MapServer(lookup, args.host, args.port)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        host, port = server.server_address[:2]
        print(
            f"serving {lookup.keyframes} keyframes at http://{host!s}:{port}",
            file=sys.stderr,
            flush=True,
        )
        while asked.reason() is None:
            time.sleep(_POLL_S)
        server.shutdown()
        server.server_close()
        lookup.close()
    return 0


def _rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what a map holds as table rows."""
    extent = " x ".join(f"{length:.1f}" for length in facts["extent_m"])
    rows = [
        ("map", f"{facts['map']} ({facts['bytes'] / 1e6:.1f} MB, version {facts['version']})"),
        ("keyframes", f"{facts['keyframes']}, within {extent} m"),
        ("loops", f"{facts['loops']}, and {facts['loops_rejected']} that contradict the others"),
    ]
    if facts["earth"] is not None:
        latitude, longitude, height = facts["earth"]["origin"]
        rows.append(("earth", f"at {latitude:.7f}, {longitude:.7f}, {height:.2f} m (WGS84)"))
    for number, session in enumerate(facts["sessions"]):
        joined = "" if session["joined"] else "; not joined to the first session"
        path = f"{session['keyframes']} keyframes, path {session['path_m']:.1f} m"
        c = session["camera"]
        size = ""
        if c["width"]:
            size = f"{c['width']}x{c['height']} px, "
        rig = f"{size}f {c['fu']:.1f} px, baseline {c['baseline_m']:.4g} m"
        rows.append((f"session {number}", f"{session['source']}: {path}; {rig}{joined}"))
    return rows
