"""`vio report`: one HTML page about finished runs."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vio.cli.arguments import examples
from vio.cli.waiting import stage
from vio.errors import NOTE, DataError

log = logging.getLogger(__name__)

_OTHER_FORMS = (".pdf", ".png", ".md", ".csv", ".json", ".txt")  # whose readers take no HTML


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "report",
        help="write a page about one or several runs",
        description="Write one self-contained HTML page about finished runs: summary, path, "
        "attitude, errors, "
        "features, innovations, biases, time, warnings and settings. Several runs are shown side "
        "by side. The page needs no network.",
        **examples(
            "vio report runs/flight --open  # shown in the browser",
            "vio report with_imu images_alone --out both.html  # two runs compared",
            "vio report runs/flight --reference truth.txt  # with other ground truth",
        ),
    )
    parser.add_argument(
        "runs", type=Path, nargs="+", metavar="RUN", help="folders that `vio run` wrote"
    )
    parser.add_argument(
        "--reference", type=Path, metavar="F", help="ground truth in place of that of the runs"
    )
    parser.add_argument(
        "--out", type=Path, metavar="F", help="the page (default report.html in the first RUN)"
    )
    parser.add_argument("--open", action="store_true", help="show it in the browser")


def execute(args: argparse.Namespace) -> int:
    print(write(args.runs, args.reference, args.out, shown=args.open))
    return 0


def write(
    folders: Sequence[Path],
    reference: Path | None = None,
    out: Path | None = None,
    *,
    shown: bool = False,
) -> Path:
    """Write the page about runs and return its path; `shown`: also show it in the browser."""
    from vio.files.atomic import check_new_file
    from vio.runs.files import RunFile
    from vio.runs.finished import read_finished_run, with_distinct_names

    try:
        from vio.report.page import write_report
    except ImportError as error:  # pragma: no cover - plotly is installed with this package
        raise DataError(
            f"the report needs plotly ({error}); install it with: pip install plotly"
        ) from error
    runs = with_distinct_names([read_finished_run(folder, reference) for folder in folders])
    out = out or folders[0] / RunFile.REPORT
    if out.suffix.lower() in _OTHER_FORMS:
        raise DataError(f"{out}: the page is HTML; name it {out.with_suffix('.html').name}")
    check_new_file(out, b'<p class="remark">stereo-vio')
    with stage("writing the report"):
        write_report(out, runs)
    if shown:
        import webbrowser

        if not webbrowser.open(out.resolve().as_uri()):
            log.log(NOTE, "no browser was found here; open %s in one", out.resolve())
    return out
