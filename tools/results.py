"""Measure every figure of docs/results.md and of the README's table, and write both.

    python -m tools.results --data DIR --work DIR [--only SECTION …] [--speed] [--benches [--peers DIR]]
        [--check [--tolerance X]] [--tables]

Runs the commands of each section in the folder of recordings (docs/results.md says what lies where), keeps each run's
figures in WORK/measured.jsonl as they come, so that an interrupted call goes on where it stopped, and at last writes
docs/results.json and the tables between the documents' markers. Flights are rendered into WORK where they are absent.
A run is repeated when the code of vio/ or frontend/ has changed. `--check` writes nothing: it tells every figure that
differs from docs/results.json as printed (or, with `--tolerance`, by more than that share), and what the documents
say otherwise, and exits 1. Times are measured only with `--speed`, on an idle machine, and never compared. `--benches`
runs the suites of the tables beside other systems, whose trajectories `vio bench` takes from the folder of `--peers`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tools import bench_results
from tools.result_tables import (
    DRIVE_METHODS,
    FIGURES,
    FLIGHTS,
    KITTI,
    NOISE_SEEDS,
    PAPER_ROWS,
    REAL,
    ROOT,
    SPEED,
    STARRY,
    UTIAS,
    Figure,
    differences,
    figures_of,
    read_runs,
    write_tables,
)
from vio.datasets import open_dataset
from vio.datasets.observation_log import write_observation_log
from vio.records import ImuSample, MotionSample, Observations, VelocitySample

PICTURE = ROOT / "docs" / "images" / "ece276a_0027.png"
Taken = Mapping[str, Figure]


@dataclass(frozen=True, slots=True)
class Place:
    """Where things lie."""

    data: Path  # the recordings
    work: Path  # renders, logs, runs

    def argv(self, command: str) -> list[str]:
        """Return a command's words; WORK/ is the work folder."""
        program, *words = [re.sub(r"^WORK/", f"{self.work}/", word) for word in shlex.split(command)]
        if program == "vio":
            return [sys.executable, "-m", "vio", *words]
        return [sys.executable, str(ROOT / words[0]), *words[1:]]

    def call(self, command: str) -> subprocess.CompletedProcess[str]:
        """Run a command among the recordings, with this checkout's code."""
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        return subprocess.run(
            self.argv(command), cwd=self.data, env=environment, capture_output=True, text=True, check=False
        )


@dataclass(frozen=True, slots=True)
class Run:
    """A command, and which figures are taken from the JSON that it prints."""

    name: str
    command: str
    take: Callable[[Any], Taken]
    prepare: Callable[[Place], None] | None = None  # makes what the command reads, where it is absent
    diverges: bool = False  # then the figure is the frame at which it gives up


# --- what is taken from a run ---------------------------------------------------------------------------------------


def _accuracy(metrics: Any, digits: int = 2, prefix: str = "") -> dict[str, Figure]:
    figures = {"ate_m": (metrics["ate_m"], digits)}
    figures |= {"t_percent": (metrics["t_err_percent"], 2), "r_deg_per_100m": (metrics["r_err_deg_per_100m"], 2)}
    return {prefix + name: Figure(value, places) for name, (value, places) in figures.items() if value is not None}


def _run(metrics: Any, *, digits: int = 2) -> Taken:
    """Figures of `vio run`."""
    figures = _accuracy(metrics, digits)
    figures["frames"] = Figure(metrics["frames"], 0)
    figures["length_m"] = Figure(metrics["evaluation"]["reference_path_length_m"], 0)
    if metrics["dead_reckoning"] is not None:
        figures |= _accuracy(metrics["dead_reckoning"], digits, "dead_reckoning_")
    if metrics["landmark_error"] is not None:
        figures["landmarks_m"] = Figure(metrics["landmark_error"]["rmse_m"], 3)
    for row in (r for r in metrics["evaluation"]["kitti_per_length"] if r["t_err_percent"] is not None):
        figures[f"t_percent_{row['length_m']:.0f}m"] = Figure(row["t_err_percent"], 2)
    return figures


def _millimetres(metrics: Any, digits: int = 2) -> Taken:
    return {"ate_mm": Figure(1e3 * metrics["ate_m"], digits)}


def _paper(tables: Any) -> Taken:
    """Figures of `vio reproduce`."""
    figures: dict[str, Figure] = {}
    for row in tables[0]["rows"]:
        assert row["name"] in PAPER_ROWS, f"{row['name']} has no row in tools/result_tables.py"
        figures |= _accuracy(row, 2, f"{row['name']}: ")
        figures[f"{row['name']}: used_per_frame"] = Figure(row["used_per_frame"], 1)
        figures[f"{row['name']}: landmarks"] = Figure(row["landmarks"], 0)
        if row["innovation_median_px"] is not None:
            figures[f"{row['name']}: innovation_px"] = Figure(row["innovation_median_px"], 2)
    return figures


def _speed(rows: Any) -> Taken:
    """Figures of `tools/bench.py`."""
    _, total, _, total_95 = rows[0]["ms"]["total"]
    return {
        "frontend_ms": Figure(rows[0]["ms"]["frontend"][1], 1),
        "filter_ms": Figure(rows[0]["ms"]["filter"][1], 1),
        "total_ms": Figure(total, 1),
        "total_95_ms": Figure(total_95, 1),
        "frames_per_s": Figure(rows[0]["frames_per_second"], 1),
        "memory_mib": Figure(rows[0]["peak_memory_mib"], 0),
    }


# --- what is made for a run -----------------------------------------------------------------------------------------

_FLIGHT = "vio render --trajectory euroc_real_imu/"
_RENDERS = {
    "v102_sim": f"{_FLIGHT}V1_02 --imu simulated --out WORK/v102_sim",
    "v102_real": f"{_FLIGHT}V1_02 --out WORK/v102_real",
    "mh03_real": f"{_FLIGHT}MH_03 --out WORK/mh03_real",
    "real_v102": f"{_FLIGHT}V1_02 --realism real --imu simulated --duration 20 --out WORK/real_v102",
    "real_mh03": f"{_FLIGHT}MH_03 --realism real --imu simulated --duration 8 --out WORK/real_mh03",
    "real_street": "vio render --scene street --trajectory car --realism real --duration 20 --out WORK/real_street",
    "still": "vio render --trajectory WORK/still.tum --imu simulated --duration 61 --out WORK/still",
}


def _render(place: Place, name: str) -> None:
    """Render a flight unless it lies there already, made by the same command, which a file beside it keeps."""
    made_by = place.work / f"{name}.txt"
    if (place.work / name).exists():
        if not made_by.is_file() or made_by.read_text(encoding="utf-8").strip() != _RENDERS[name]:
            raise SystemExit(f"{place.work / name} was not made by '{_RENDERS[name]}'; remove it")
        return
    if name == "still":
        poses = (f"{1_600_000_000 + k / 10:.1f} 0 0 1.5 0 0 0 1\n" for k in range(620))
        (place.work / "still.tum").write_text("".join(poses), encoding="utf-8")
    print(f"rendering {name} …", flush=True)
    done = place.call(_RENDERS[name])
    if done.returncode:
        raise SystemExit(f"{_RENDERS[name]}: {done.stderr.strip()}")
    made_by.write_text(f"{_RENDERS[name]}\n", encoding="utf-8")


def _rewrite(
    source: Path,
    target: Path,
    *,
    seen: Callable[[Observations], Observations] = lambda o: o,
    samples: list[MotionSample] | None = None,
) -> None:
    """Write an observation log anew with other observations or motion samples."""
    log = open_dataset(str(source))
    count = len(log.recording.frame_times_ns)
    observations = [seen(o) for o in (log.observations(k) for k in range(count)) if o is not None]
    if samples is None:
        samples = [event for event in log.events(images=False) if isinstance(event, (ImuSample, VelocitySample))]
    target.parent.mkdir(exist_ok=True)
    write_observation_log(target, log.recording, observations, samples)


_DARK = range(800, 840)  # two seconds
_SPARSE = 100  # of so many frames one is empty


def _blackout(o: Observations) -> Observations:
    """Nothing for two seconds; what is seen later is seen anew, as a front end would have it."""
    if o.frame_index in _DARK:
        return o.take(np.zeros(len(o), dtype=bool))
    return replace(o, ids=o.ids + 10**9) if o.frame_index >= _DARK.stop else o


def _sparse(o: Observations) -> Observations:
    """One empty frame in a hundred; tracks go on behind it, as the front end passes over a frame without texture."""
    return o.take(np.zeros(len(o), dtype=bool)) if o.frame_index % _SPARSE == _SPARSE // 2 else o


def _gap(place: Place, flight: str, motion: str, kind: str) -> None:
    source = place.work / "runs" / f"flights_{flight}_{motion}" / "observations.npz"
    target = place.work / "logs" / f"{flight}_{motion}_{kind}.npz"
    _rewrite(source, target, seen={"blackout": _blackout, "sparse": _sparse}[kind])


def _noisy(place: Place, recording: str, seed: int) -> None:
    """The images' observations with velocities as noisy as the paper's: 0.5 m/s and 0.05 rad/s of white noise."""
    rng = np.random.default_rng(seed)
    samples: list[MotionSample] = [
        replace(s, linear=s.linear + rng.normal(0, 0.5, 3), angular=s.angular + rng.normal(0, 0.05, 3))
        for s in open_dataset(str(place.data / recording)).events(images=False)
        if isinstance(s, VelocitySample)
    ]
    source = place.work / "runs" / f"drives_{recording}_window_none" / "observations.npz"
    _rewrite(source, place.work / "logs" / f"{recording}_noise{seed}.npz", samples=samples)


# --- the sections ---------------------------------------------------------------------------------------------------

_0027 = "ece276a/0027.npz", "ece276a/kitti_odometry_07_poses.txt"
_BACKENDS = {"paper": "vislam", "window": "msckf"}


def _section_paper() -> Iterator[Run]:
    yield Run("paper", f"vio reproduce {'='.join(_0027)} --out WORK/reproduce", _paper)
    yield Run("ece276a", f"vio run {_0027[0]} --reference {_0027[1]}", _run)


def _section_drives() -> Iterator[Run]:
    for recording in KITTI:
        for method in DRIVE_METHODS:
            backend, motion = _BACKENDS[method.partition("/")[0]], method.partition("/")[2]
            command = f"vio run {recording} --backend {backend} --motion {motion} --lengths 25,50"
            keep = " --save-observations" if method == "window/none" else ""
            yield Run(f"drives/{recording}/{method}", command + keep, partial(_run, digits=3))
    for one, other in combinations(DRIVE_METHODS, 2):
        runs = (f"WORK/runs/drives_kitti_0039_{method.replace('/', '_')}" for method in (one, other))
        yield Run(f"apart/{one}/{other}", f"vio eval {' '.join(runs)}", partial(_millimetres, digits=0))


def _section_noise() -> Iterator[Run]:
    for recording in KITTI:
        for seed in range(NOISE_SEEDS):
            command = f"vio run WORK/logs/{recording}_noise{seed}.npz --lengths 25,50"
            prepare = partial(_noisy, recording=recording, seed=seed)
            yield Run(f"noise/{recording}/{seed}", command, partial(_run, digits=4), prepare)


def _section_utias() -> Iterator[Run]:
    for name in UTIAS:
        file = f"utias_kitti_klt/{name.replace(' ', '_drive_')}_sync_KLT.mat"
        for method, backend in _BACKENDS.items():
            for motion in ("none", "velocity"):
                command = f"vio run {file} --backend {backend} --motion {motion}"
                yield Run(f"utias/{name}/{method}/{motion}", command, _run)


def _section_starry() -> Iterator[Run]:
    for run, label in STARRY.items():
        backend = _BACKENDS[run.partition("_")[0]]
        settings = "".join(f" --set {setting}" for setting in re.findall(r"`(\S+)`", label))
        command = f"vio run utias_starry_night/dataset3.mat --backend {backend}"
        yield Run(f"starry/{run}/velocity", f"{command}{settings}", partial(_run, digits=3))
        if run in _BACKENDS:
            diverges = run == "paper"
            yield Run(f"starry/{run}/none", f"{command} --motion none", partial(_run, digits=3), diverges=diverges)


def _section_flights() -> Iterator[Run]:
    for flight in FLIGHTS:
        for motion in ("none", "imu"):
            command = f"vio run WORK/{flight} --motion {motion} --save-observations"
            prepare = partial(_render, name=flight)
            yield Run(f"flights/{flight}/{motion}", command, partial(_run, digits=4), prepare)


def _section_gaps() -> Iterator[Run]:
    wanted = [(flight, "imu", "blackout") for flight in FLIGHTS]
    wanted += [("v102_sim", "none", "blackout"), ("v102_sim", "none", "sparse"), ("v102_sim", "imu", "sparse")]
    for flight, motion, kind in wanted:
        command = f"vio run WORK/logs/{flight}_{motion}_{kind}.npz --motion {motion}"
        prepare = partial(_gap, flight=flight, motion=motion, kind=kind)
        yield Run(f"gaps/{flight}/{motion}/{kind}", command, partial(_run, digits=4), prepare)


def _section_still() -> Iterator[Run]:
    for motion in ("none", "imu"):
        yield Run(
            f"still/{motion}", f"vio run WORK/still --motion {motion}", _millimetres, partial(_render, name="still")
        )


def _section_real() -> Iterator[Run]:
    for name, (_, sensor) in REAL.items():
        for motion in ("none", sensor):
            command = f"vio run WORK/{name} --motion {motion} --lengths 5,10"
            yield Run(f"real/{name}/{motion}", command, partial(_run, digits=4), partial(_render, name=name))


def _section_speed() -> Iterator[Run]:
    for run in SPEED:
        source, motion = ("kitti_0039", "none") if run == "kitti_0039" else (f"WORK/{run}", "imu")
        prepare = None if run == source else partial(_render, name=run)
        yield Run(f"speed/{run}", f"python tools/bench.py {source} --motion {motion}", _speed, prepare)


SECTIONS: Mapping[str, Callable[[], Iterator[Run]]] = {  # in this order: gaps and noise take what others have saved
    "paper": _section_paper,
    "drives": _section_drives,
    "noise": _section_noise,
    "utias": _section_utias,
    "starry": _section_starry,
    "flights": _section_flights,
    "gaps": _section_gaps,
    "still": _section_still,
    "real": _section_real,
    "speed": _section_speed,
}


def all_runs() -> Iterator[Run]:
    """Yield the runs of all sections."""
    for section in SECTIONS.values():
        yield from section()


SUITES = {  # by name, of `vio bench`: the suite and the folder of its recordings
    "real": ("tools/suites/real.yaml", "data"),
    "real_imu": ("tools/suites/real_imu.yaml", "data"),
    "flights": ("tools/suites/flights.yaml", "work"),
    "rendered": ("rendered", "work"),
}


def run_benches(place: Place, peers: Path | None) -> list[Path]:
    """Run the suites, the flights rendered first, and return their output folders."""
    for flight in FLIGHTS:
        _render(place, flight)
    for name, (suite, data) in SUITES.items():
        options = ["--data", str(getattr(place, data)), "--out", f"WORK/bench/{name}", "--cache", "WORK/bench/cache"]
        if name == "rendered":
            options += ["--seeds", "0"]
        elif peers is not None:
            options += ["--peers", str(peers.resolve())]
        done = place.call(shlex.join(["vio", "bench", str(ROOT / suite) if "/" in suite else suite, *options]))
        if done.returncode:
            raise SystemExit(f"vio bench {suite}: {done.stderr.strip()}")
    return [place.work / "bench" / name for name in SUITES]


# --- measuring ------------------------------------------------------------------------------------------------------


def _code() -> str:
    """A fingerprint of everything that a run's figures depend on here."""
    digest = hashlib.sha256()
    for folder in ("vio", "frontend"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def measure(run: Run, place: Place) -> dict[str, Figure]:
    """Run one command and take its figures.

    Raises:
        SystemExit: it fails, and was not expected to.
    """
    if run.prepare is not None:
        run.prepare(place)
    out = (
        f" --out WORK/runs/{run.name.replace('/', '_').replace(' ', '_')}" if run.command.startswith("vio run") else ""
    )
    done = place.call(f"{run.command}{out} --json")
    if run.diverges:
        found = re.search(r"diverged at frame (\d+)", done.stderr)
        if done.returncode != 1 or found is None:
            raise SystemExit(f"{run.command}: was expected to diverge and did not")
        return {"diverged_at_frame": Figure(int(found[1]), 0)}
    if done.returncode:
        raise SystemExit(f"{run.command}: {done.stderr.strip()}")
    return {
        name: replace(figure, value=float(f"{figure.value:.6g}"))
        for name, figure in run.take(json.loads(done.stdout)).items()
    }


def _measured(path: Path, code: str) -> dict[tuple[str, str], dict[str, Figure]]:
    """What earlier calls have measured with the same code, by name and command."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return {
        (line["run"], line["command"]): {name: Figure(*pair) for name, pair in line["figures"].items()}
        for line in map(json.loads, lines)
        if line["code"] == code
    }


def measure_all(wanted: Iterable[Run], place: Place) -> dict[str, Any]:
    """Measure runs, each kept as soon as it is done; return them as docs/results.json holds them."""
    (place.work / "runs").mkdir(parents=True, exist_ok=True)
    code, log = _code(), place.work / "measured.jsonl"
    done = _measured(log, code)
    runs: dict[str, Any] = {}
    for run in wanted:
        figures = done.get((run.name, run.command))
        if figures is None:
            began = time.perf_counter()
            figures = measure(run, place)
            line = {"run": run.name, "command": run.command, "code": code, "figures": _plain(figures)}
            with log.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(line) + "\n")
            told = ", ".join(f"{name} {figure}" for name, figure in list(figures.items())[:3])
            print(f"{run.name}: {told} ({time.perf_counter() - began:.0f} s)", flush=True)
        runs[run.name] = {"command": run.command, "figures": _plain(figures)}
    return runs


def _plain(figures: Taken) -> dict[str, list[float]]:
    return {name: [figure.value, figure.digits] for name, figure in figures.items()}


# --- writing and checking -------------------------------------------------------------------------------------------


def write_json(runs: Mapping[str, Any], root: Path = ROOT) -> None:
    """Write docs/results.json, one run a line, in the order of the sections; runs that were not measured stay."""
    merged = {**read_runs(root), **runs}
    order = {run.name: k for k, run in enumerate(all_runs())}
    names = sorted((name for name in merged if name in order), key=order.__getitem__)
    made = {"python": platform.python_version(), "numpy": np.__version__, "opencv": cv2.__version__}
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(merged[name])}" for name in names)
    text = f'{{"figures": "[value, digits told]", "made_with": {json.dumps(made)},\n"runs": {{\n{lines}\n}}}}\n'
    (root / FIGURES).write_text(text, encoding="utf-8", newline="\n")


def changes(runs: Mapping[str, Any], known: Mapping[str, Any], tolerance: float) -> Iterator[str]:
    """Yield the figures that differ from known ones, as printed, and by more than a share of their size."""
    for name, facts in runs.items():
        before = known.get(name, {"figures": {}})["figures"]
        for key in dict.fromkeys((*before, *facts["figures"])):
            old, new = (Figure(*f[key]) if key in f else None for f in (before, facts["figures"]))
            if old is None or new is None:
                yield f"{name}: {key} is {new or 'missing'} here and {old or 'missing'} in docs/results.json"
            elif str(old) != str(new) and abs(new.value - old.value) > tolerance * abs(old.value):
                yield f"{name}: {key} is {new} here and {old} in docs/results.json"


def main() -> int:
    """Measure, then write or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", metavar="DIR", help="the recordings (make results VIO_DATA=DIR)")
    parser.add_argument("--work", type=Path, default=Path("results"), metavar="DIR", help="renders, runs, measurements")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help=f"of {' '.join(SECTIONS)}")
    parser.add_argument("--benches", action="store_true", help="also run the suites of vio bench")
    parser.add_argument("--peers", type=Path, metavar="DIR", help="trajectories of other systems, for the benches")
    parser.add_argument("--speed", action="store_true", help="measure times too: on an idle machine")
    parser.add_argument(
        "--check", action="store_true", help="compare and write nothing; exit 1 where something differs"
    )
    parser.add_argument("--tolerance", type=float, default=0.0, metavar="X", help="share by which a figure may differ")
    parser.add_argument(
        "--tables", action="store_true", help="measure nothing, write the tables from docs/results.json"
    )
    args = parser.parse_args()
    runs: dict[str, Any] = {}
    if not args.tables:
        if not args.data or not Path(args.data).is_dir():
            parser.error("--data takes the folder of recordings; the head of docs/results.md says what lies there")
        chosen = {*(args.only or set(SECTIONS) - {"speed"}), *(["speed"] if args.speed else [])}
        names = [name for name in SECTIONS if name in chosen]
        place = Place(Path(args.data).resolve(), args.work.resolve())
        runs = measure_all((run for name in names for run in SECTIONS[name]()), place)
        if args.benches and not args.check:
            bench_results.write(run_benches(place, args.peers))
    if args.tables:
        bench_results.write([])
    return check(runs, args.tolerance) if args.check else write(runs, args.work)


def check(runs: Mapping[str, Any], tolerance: float) -> int:
    """Tell what differs from docs/results.json, and where the documents do; return the exit status."""
    known = read_runs()
    compared = {name: facts for name, facts in runs.items() if not name.startswith("speed/")}
    found = [*changes(compared, known, tolerance), *differences(figures_of(known))]
    print("\n".join(found) or "everything is as docs/results.json and the documents say")
    return int(bool(found))


def write(runs: Mapping[str, Any], work: Path) -> int:
    """Write docs/results.json, the paper's figure and all tables; tell what is left to write by hand."""
    write_json(runs)
    if "paper" in runs:
        shutil.copyfile(work / "reproduce" / "0027" / "trajectories.png", PICTURE)
    known = read_runs()
    if missing := [run.name for run in all_runs() if run.name not in known]:
        print(f"no tables yet: these were not measured: {', '.join(missing)}")
        return 1
    write_tables(figures_of(known))
    left = list(differences(figures_of(known)))
    print("\n".join(left) or "docs/results.json and all tables are written")
    return int(bool(left))


if __name__ == "__main__":
    sys.exit(main())
