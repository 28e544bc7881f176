"""The tables of docs/results.md and of the README, and the sentences that repeat their figures, from docs/results.json.

A table stands between `<!-- table: NAME -->` and `<!-- end -->` and is written by the function of that name here;
`tools/results.py` measures what the figures are.
"""

from __future__ import annotations

import itertools
import json
import re
import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
FIGURES = "docs/results.json"
DOCUMENTS = ("docs/results.md", "README.md")
NOISE_SEEDS = 10

DRIVE_METHODS = ("paper/none", "paper/velocity", "window/none", "window/velocity")
KITTI = {"kitti_0039": "KITTI raw 2011_09_26 0039", "kitti_06_head": "KITTI odometry 06, frames 0-29"}
UTIAS = ("2011_09_26 0001", "2011_09_26 0005", "2011_09_26 0036", "2011_09_26 0051", "2011_09_30 0020")
FLIGHTS = {"v102_sim": "V1_02, simulated IMU", "v102_real": "V1_02, real IMU", "mh03_real": "MH_03, real IMU"}
REAL = {  # rendered with --realism real: what the table says, and the sensor beside the images
    "real_v102": ("flight V1_02", "imu"),
    "real_mh03": ("flight MH_03", "imu"),
    "real_street": ("street", "velocity"),
}
PAPER_ROWS = {  # name of `vio reproduce`: what the table says
    "dead reckoning": "dead reckoning",
    "mapping only": "mapping only (pose from dead reckoning)",
    "paper, all features": "paper to the letter, all features",
    "paper, most seen 1/7": "paper to the letter, most seen 1/7",
    "paper, most seen 1/7 so far": "paper to the letter, most seen 1/7 so far",
    "consistent W, gate, all": "consistent W, gate, landmark covariance, all",
    "consistent W, gate, most seen 1/7": "the same, most seen 1/7",
    "consistent W, gate, all, renamed tracks": "the same, all, tracks renamed at stale frames",
    "recommended, ids as filed": "recommended, as filed",
    "recommended, most seen 1/7": "recommended, most seen 1/7",
    "recommended, most seen 1/7 so far": "recommended, most seen 1/7 so far",
    "recommended": "recommended",
    "recommended, images alone": "recommended, images alone",
    "sliding window": "sliding window",
    "sliding window, most seen 1/7 so far": "sliding window, most seen 1/7 so far",
    "sliding window, images alone": "sliding window, images alone",
}
STARRY = {
    "paper": "paper's filter",
    "paper_8px": "paper's filter, `vislam.pixel_sigma_px=8`",
    "window": "sliding window",
    "window_8px": "sliding window, `msckf.pixel_sigma_px=8`, `msckf.pixel_sigma_max_px=10`",
}
_DRIFT = ("ate_m", "t_percent", "r_deg_per_100m")


@dataclass(frozen=True, slots=True)
class Figure:
    """A measured number and the digits behind the point to which it is told."""

    value: float
    digits: int

    def __str__(self) -> str:
        return f"{self.value:.{self.digits}f}"


class Figures:
    """All figures, by run and name."""

    def __init__(self, runs: Mapping[str, Mapping[str, Figure]]) -> None:
        self._runs = runs

    def at(self, run: str, name: str) -> Figure:
        """Return one figure.

        Raises:
            KeyError: it was not measured.
        """
        try:
            return self._runs[run][name]
        except KeyError:
            raise KeyError(f"docs/results.json has no figure {name} of {run}; measure it with make results") from None

    def value(self, run: str, name: str) -> float:
        """Return one figure's number."""
        return self.at(run, name).value

    def has(self, run: str, name: str) -> bool:
        """Say whether a figure was measured."""
        return name in self._runs.get(run, {})

    def tell(self, run: str, name: str, digits: int | None = None) -> str:
        """Return one figure as it is told, or to other digits."""
        figure = self.at(run, name)
        return str(figure) if digits is None else f"{figure.value:.{digits}f}"


def read_runs(root: Path = ROOT) -> dict[str, Any]:
    """Read docs/results.json: by run, its command and its figures; empty where there is none yet."""
    path = root / FIGURES
    return dict(json.loads(path.read_text(encoding="utf-8"))["runs"]) if path.is_file() else {}


def figures_of(runs: Mapping[str, Any]) -> Figures:
    """Return the figures of runs as docs/results.json holds them."""
    return Figures(
        {run: {name: Figure(*pair) for name, pair in facts["figures"].items()} for run, facts in runs.items()}
    )


# --- the tables -----------------------------------------------------------------------------------------------------


def _row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _head(*names: str, left: int = 1) -> Iterator[str]:
    yield _row(names)
    yield "|" + "---|" * left + "---:|" * (len(names) - left)


def _best(cells: Sequence[str]) -> list[str]:
    """Set the smallest number of some cells in bold; all that tell the same one."""
    numbers = [float(cell.split()[0]) if re.match(r"\d", cell) else float("inf") for cell in cells]
    return [f"**{cell}**" if number == min(numbers) else cell for cell, number in zip(cells, numbers, strict=True)]


def _best_of_columns(rows: Sequence[Sequence[str]], columns: int) -> list[list[str]]:
    """The same down each of the first columns."""
    best = [_best([row[k] for row in rows]) for k in range(columns)]
    return [[*(column[k] for column in best), *row[columns:]] for k, row in enumerate(rows)]


def _paper(f: Figures) -> Iterator[str]:
    yield from _head("setting", "ATE m", "t %", "deg/100 m", "used a frame", "landmarks", "innovation px")
    names = (*_DRIFT, "used_per_frame", "landmarks")
    rows = [[f.tell("paper", f"{row}: {name}") for name in names] for row in PAPER_ROWS]
    for row, label, cells in zip(PAPER_ROWS, PAPER_ROWS.values(), _best_of_columns(rows, 3), strict=True):
        updated = row != "dead reckoning"
        yield _row([label, *cells, f.tell("paper", f"{row}: innovation_px") if updated else "–"])


def _flights(f: Figures) -> Iterator[str]:
    yield from _head("flight", "images alone", "with IMU", "with IMU, two seconds without features")
    for name, label in FLIGHTS.items():
        facts = f"{f.tell(f'flights/{name}/none', 'length_m')} m, {f.tell(f'flights/{name}/none', 'frames')} frames"
        runs = (f"flights/{name}/none", f"flights/{name}/imu", f"gaps/{name}/imu/blackout")
        yield _row([f"{label} ({facts})", *(f"{f.tell(run, 'ate_m')} m" for run in runs)])


def _gaps(f: Figures) -> Iterator[str]:
    yield from _head("V1_02, simulated IMU", "all frames", "one in a hundred empty", "two seconds without features")
    for motion, label in (("none", "images alone"), ("imu", "with IMU")):
        runs = (f"flights/v102_sim/{motion}", *(f"gaps/v102_sim/{motion}/{gap}" for gap in ("sparse", "blackout")))
        yield _row([label, *(f"{f.tell(run, 'ate_m')} m" for run in runs)])


def _still(f: Figures) -> Iterator[str]:
    yield from _head("a minute at rest", "images alone", "with IMU")
    yield _row(["ATE", *(f"{f.tell(f'still/{motion}', 'ate_mm')} mm" for motion in ("none", "imu"))])


def _real(f: Figures) -> Iterator[str]:
    yield from _head("rendered with `--realism real`", "images alone", "with IMU", "with velocities")
    for name, (label, sensor) in REAL.items():
        alone = f"real/{name}/none"
        facts = f"{f.tell(alone, 'length_m')} m, {f.tell(alone, 'frames')} frames"
        both = f"{f.tell(f'real/{name}/{sensor}', 'ate_m')} m"
        cells = (both, "–") if sensor == "imu" else ("–", both)
        yield _row([f"{label} ({facts})", f"{f.tell(alone, 'ate_m')} m", *cells])


def _alone(f: Figures) -> Iterator[str]:
    yield from _head("recording, images alone", "sliding window", "paper's filter, recommended")
    for label, windows, papers in _beside(f):
        yield _row([label, *_best([f"{windows} m", f"{papers} m"])])


def _beside(f: Figures) -> Iterator[tuple[str, str, str]]:
    """Yield recordings with the ATE of both filters from images alone."""
    recordings = {
        f"KITTI raw 0039 ({f.tell('drives/kitti_0039/window/none', 'length_m')} m)": (
            ("drives/kitti_0039/window/none", "ate_m", 3),
            ("drives/kitti_0039/paper/none", "ate_m", 3),
        ),
        "KITTI odometry 06, frames 0-29": (
            ("drives/kitti_06_head/window/none", "ate_m", 3),
            ("drives/kitti_06_head/paper/none", "ate_m", 3),
        ),
        f"ECE276A 0027 ({f.tell('ece276a', 'length_m')} m), features of the file": (
            ("paper", "sliding window, images alone: ate_m", 2),
            ("paper", "recommended, images alone: ate_m", 2),
        ),
        **{
            f"UTIAS {name} ({f.tell(f'utias/{name}/window/none', 'length_m')} m), features of the file": (
                (f"utias/{name}/window/none", "ate_m", 2),
                (f"utias/{name}/paper/none", "ate_m", 2),
            )
            for name in UTIAS
        },
    }
    for label, (window, paper) in recordings.items():
        yield label, f.tell(*window), f.tell(*paper)


def _drives(f: Figures) -> Iterator[str]:
    yield from _head("recording", "method", "ATE m", "t %", "deg/100 m", left=2)
    methods = {
        "dead reckoning, OXTS velocities": ("window/velocity", "dead_reckoning_"),
        "paper's filter, images alone": ("paper/none", ""),
        "paper's filter, OXTS velocities": ("paper/velocity", ""),
        "sliding window, images alone": ("window/none", ""),
        "sliding window, OXTS velocities": ("window/velocity", ""),
    }
    for recording, label in KITTI.items():
        rows = [
            [f.tell(f"drives/{recording}/{run}", prefix + name) for name in _DRIFT] for run, prefix in methods.values()
        ]
        for k, (method, cells) in enumerate(zip(methods, _best_of_columns(rows, 3), strict=True)):
            length = f.tell(f"drives/{recording}/window/none", "length_m")
            yield _row(["" if k else f"{label} ({length} m)", method, *cells])


def _noise(f: Figures) -> Iterator[str]:
    yield from _head("recording", "", "ATE m", "t %", "deg/100 m", left=2)
    for recording, label in KITTI.items():
        alone = [f.tell(f"drives/{recording}/window/none", name, 4) for name in _DRIFT]
        seeds = {
            text: [_spread(_of_seeds(f, recording, prefix + name)) for name in _DRIFT]
            for text, prefix in (("velocities alone", "dead_reckoning_"), ("both", ""))
        }
        rows = {"images alone": alone, **seeds}
        for k, (text, cells) in enumerate(zip(rows, _best_of_columns(list(rows.values()), 3), strict=True)):
            yield _row(["" if k else label, text, *cells])


def _of_seeds(f: Figures, recording: str, name: str) -> list[float]:
    return [f.value(f"noise/{recording}/{seed}", name) for seed in range(NOISE_SEEDS)]


def _spread(values: Sequence[float]) -> str:
    return f"{statistics.median(values):.4f} ({min(values):.4f}, {max(values):.4f})"


def _utias(f: Figures) -> Iterator[str]:
    yield from _head(
        "drive", "dead reckoning", "paper's filter, images", "velocities", "sliding window, images", "velocities"
    )
    for name in UTIAS:
        runs = [(f"utias/{name}/window/velocity", "dead_reckoning_ate_m")]
        runs += [
            (f"utias/{name}/{method}/{m}", "ate_m") for method in ("paper", "window") for m in ("none", "velocity")
        ]
        length = f.tell(f"utias/{name}/window/none", "length_m")
        yield _row([f"{name} ({length} m)", *_best([f"{f.tell(*run)} m" for run in runs])])


def _starry(f: Figures) -> Iterator[str]:
    yield from _head("", "ATE m", "landmarks m")
    rows = [[f.tell("starry/window/velocity", "dead_reckoning_ate_m"), "–"]]
    rows += [[f.tell(f"starry/{run}/velocity", name) for name in ("ate_m", "landmarks_m")] for run in STARRY]
    for label, cells in zip(("dead reckoning", *STARRY.values()), _best_of_columns(rows, 2), strict=True):
        yield _row([label, *cells])
    frame = f.tell("starry/paper/none", "diverged_at_frame")
    yield _row([f"{STARRY['paper']}, images alone", f"diverges at frame {frame}", "–"])
    yield _row(
        [f"{STARRY['window']}, images alone", *(f.tell("starry/window/none", n) for n in ("ate_m", "landmarks_m"))]
    )


def _speed(f: Figures) -> Iterator[str]:
    yield from _head("recording", "front end", "filter", "total", "95 %", "frames/s", "peak memory MiB")
    for run, label in SPEED.items():
        names = ("frontend_ms", "filter_ms", "total_ms", "total_95_ms", "frames_per_s", "memory_mib")
        run = f"speed/{run}"
        yield _row([label, *(f.tell(run, name) if f.has(run, name) else "–" for name in names)])


SPEED = {
    "kitti_0039": "KITTI raw 0039, 1242x375, images alone",
    "v102_sim": "rendered V1_02, 752x480, with simulated IMU",
}


def _readme(f: Figures) -> Iterator[str]:
    def paper(row: str, name: str, digits: int) -> str:
        return f.tell("paper", f"{row}: {name}", digits)

    def both(rows: tuple[str, str], name: str, digits: int) -> str:
        return " / ".join(paper(row, name, digits) for row in rows)

    letter = ("paper, all features", "paper, most seen 1/7")
    window = ("sliding window", "sliding window, images alone")
    yield from _head("", "ATE", "drift")
    yield _row(
        [
            f"ECE276A 0027 ({f.tell('ece276a', 'length_m')} m), dead reckoning",
            f"{paper('dead reckoning', 'ate_m', 2)} m",
            f"{paper('dead reckoning', 't_percent', 2)} %",
        ]
    )
    yield _row(
        [
            "the same, the paper's filter to the letter, all features / most seen 1/7",
            f"{both(letter, 'ate_m', 1)} m",
            f"{both(letter, 't_percent', 1)} %",
        ]
    )
    yield _row(
        [
            "the same, the paper's filter in its recommended setting, with velocities",
            f"{paper('recommended', 'ate_m', 2)} m",
            f"{paper('recommended', 't_percent', 2)} %",
        ]
    )
    yield _row(
        [
            "the same, sliding window, with velocities / images alone",
            f"**{both(window, 'ate_m', 2)} m**",
            f"**{both(window, 't_percent', 2)} %**",
        ]
    )
    for recording, label, over in (
        ("kitti_0039", f"KITTI raw 0039 ({f.tell('drives/kitti_0039/window/none', 'length_m')} m)", "25, 50 m"),
        ("kitti_06_head", "KITTI odometry 06, first 30 frames", "25 m"),
    ):
        run = f"drives/{recording}/window/none"
        yield _row([f"{label}, images alone", f"{f.tell(run, 'ate_m')} m", f"{f.tell(run, 't_percent')} % over {over}"])
    reckoned = f.tell("drives/kitti_06_head/window/velocity", "dead_reckoning_ate_m")
    yield _row(["the same 30 frames, dead reckoning with OXTS velocities", f"{reckoned} m", ""])
    for flight in ("v102_real", "mh03_real"):
        run = f"flights/{flight}/imu"
        name = FLIGHTS[flight].partition(",")[0]
        length = f.tell(run, "length_m")
        yield _row(
            [f"rendered flight along EuRoC {name} ({length} m), its real IMU", f"{f.tell(run, 'ate_m', 3)} m", ""]
        )


TABLES: Mapping[str, Callable[[Figures], Iterator[str]]] = {
    "paper": _paper,
    "flights": _flights,
    "gaps": _gaps,
    "still": _still,
    "real": _real,
    "alone": _alone,
    "drives": _drives,
    "noise": _noise,
    "utias": _utias,
    "starry": _starry,
    "speed": _speed,
    "readme": _readme,
}
_MARKED = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def with_tables(text: str, figures: Figures) -> str:
    """Return a document's text with its marked tables as the figures say; nothing else changes.

    Raises:
        KeyError: a table or figure is not known.
    """
    return _MARKED.sub(lambda m: m[1] + "".join(f"{line}\n" for line in TABLES[m[2]](figures)) + m[3], text)


def write_tables(figures: Figures, root: Path = ROOT) -> None:
    """Write the marked tables of all documents."""
    for name in DOCUMENTS:
        path = root / name
        path.write_text(with_tables(path.read_text(encoding="utf-8"), figures), encoding="utf-8", newline="\n")


# --- sentences that repeat figures ----------------------------------------------------------------------------------


def sentences(f: Figures) -> Iterator[tuple[str, str]]:
    """Yield pieces of prose that must stand in a document, with the figures as they are; line breaks do not count."""

    def paper(row: str, digits: int = 2, name: str = "ate_m") -> str:
        return f.tell("paper", f"{row}: {name}", digits)

    results, readme = DOCUMENTS
    yield (
        results,
        f"({paper('dead reckoning')} m to {paper('paper, all features', 0)} and {paper('paper, most seen 1/7', 0)} m)",
    )
    yield results, f"bring {paper('consistent W, gate, all', 1)} m from the same inputs"
    yield results, f"({paper('paper, most seen 1/7', 1)} against {paper('paper, all features', 1)} m to the letter)"
    yield (
        results,
        f"{paper('consistent W, gate, all', 1)} m against {paper('consistent W, gate, most seen 1/7', 1)} m, and "
        f"{paper('recommended')} against {paper('recommended, most seen 1/7 so far')} (causal) or "
        f"{paper('recommended, most seen 1/7')} (whole record)",
    )
    yield (
        results,
        f"it follows them ({paper('recommended, ids as filed', 1)} m), where the held input resists "
        f"({paper('consistent W, gate, all', 1)} m)",
    )
    yield results, f"({paper('recommended')} m with, {paper('recommended, images alone')} m without)"
    yield results, f"the sliding window has {f.tell('drives/kitti_0039/window/none', 't_percent_50m')} % on 0039"
    apart = [f.at(f"apart/{one}/{other}", "ate_mm") for one, other in itertools.combinations(DRIVE_METHODS, 2)]
    least, most = (choose(apart, key=lambda figure: figure.value) for choose in (min, max))
    yield results, f"within {least} to {most} mm of one another"
    losses = [
        re.sub(r" \(.*|\d+_\d+_\d+ ", "", label) for label, window, paper in _beside(f) if float(paper) < float(window)
    ]
    if f.value("starry/paper/velocity", "ate_m") < f.value("starry/window/velocity", "ate_m"):
        losses.append("UTIAS Starry Night")
    yield readme, f"on {', '.join(losses[:-1])} and {losses[-1]} the paper's filter is better than the sliding window"
    better = [
        [
            value < f.value(f"drives/{drive}/window/none", "r_deg_per_100m")
            for value in _of_seeds(f, drive, "r_deg_per_100m")
        ]
        for drive in KITTI
    ]
    gains = [
        100 * (1 - statistics.median(_of_seeds(f, drive, "r_deg_per_100m")) / f.value(run, "r_deg_per_100m"))
        for drive in KITTI
        for run in [f"drives/{drive}/window/none"]
    ]
    yield (
        results,
        f"Rotation is better with them for {sum(better[0])} and {sum(better[1])} of {NOISE_SEEDS} seeds, "
        f"by {gains[0]:.1f} and {gains[1]:.1f} % in the median",
    )


def differences(figures: Figures, root: Path = ROOT) -> Iterator[str]:
    """Yield what the documents say otherwise than the figures: tables as a whole, sentences one by one."""
    for name in DOCUMENTS:
        text = (root / name).read_text(encoding="utf-8")
        for found in _MARKED.finditer(text):
            if with_tables(found.group(), figures) != found.group():
                yield f"{name}: table {found[2]} differs from docs/results.json"
        plain = " ".join(text.split())
        for document, sentence in sentences(figures):
            if document == name and sentence not in plain:
                yield f"{name}: the figures want it to say '{sentence}'"
