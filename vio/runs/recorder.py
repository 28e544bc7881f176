"""What a run leaves behind, frame by frame: in memory, or in a folder that grows while the run goes
on.

A folder that is being written holds `unfinished/`: the tables, and checkpoints to go on from. A
process that dies leaves all but the last second of it readable.
"""

from __future__ import annotations

import bisect
import contextlib
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.errors import DataError
from vio.files.atomic import atomic_write_text, check_own, open_own
from vio.files.tables import KeptRows, Records, Rows, Table, check_table
from vio.files.trajectories import tum_text
from vio.findings import INTEGRITIES
from vio.geometry.lie import FloatArray
from vio.monitor.integrity import Mark, inflated, marked
from vio.numerics.kinds import Capacity
from vio.protocols import Dataset
from vio.records import (
    NS_PER_S,
    BodyFrame,
    Estimate,
    FrameLog,
    FrameResult,
    Landmarks,
    MotionSample,
    Observations,
)
from vio.runs.checkpoint import (
    NotSavableError,
    checkpoint_id,
    load_checkpoint,
    save_checkpoint,
)
from vio.runs.files import CHECKPOINT, RunFile
from vio.runs.tables import (
    ESTIMATE,
    FRAME,
    MAPPED,
    OBSERVATION,
    POINT,
    SAMPLE,
    SEEN,
    FrameRows,
    estimate_of,
    estimate_row,
    frames_csv,
    mapped_row,
    observation_rows,
    observations_of,
    sample_of,
    sample_rows,
)

log = logging.getLogger(__name__)

_TEXTS = (RunFile.TRAJECTORY, RunFile.FRAMES)  # that grow


class _WriteTimes(NamedTuple):
    """When files are written."""

    flush_s: Capacity[float] = 1.0
    checkpoint_s: float = 5.0


_TIMES = _WriteTimes()
_CHUNK: Capacity[int] = 100_000  # points at a time
_POSE = np.dtype([("T", "<f8", (4, 4))])
_TABLES = {
    "estimates": ESTIMATE,
    "frames": FRAME,
    "dead_reckoning": _POSE,
    "points": POINT,
    "seen": SEEN,
    "observations": OBSERVATION,
    "samples": SAMPLE,
    "mapped": MAPPED,
}
Smoothed = Callable[[int], Estimate | None]  # of a frame by its number, with all frames since


@dataclass(frozen=True, slots=True)
class GrowingFolder:
    """Where a run writes while it goes on."""

    path: Path
    # files written at the beginning, by name: what is known of the run before its first frame
    texts: Mapping[str, str]
    # names of an earlier run's files, removed when the first frame has been processed
    replaces: Sequence[str] = ()
    # JSON values by name: must be the same when it goes on
    inputs: Mapping[str, Any] = field(default_factory=dict)


class RunRecorder:
    """Tables of a run; with a folder they are files, and text files grow beside them."""

    def __init__(
        self,
        body: BodyFrame,
        *,
        lag_frames: int,
        keep_observations: bool,
        folder: GrowingFolder | None = None,
    ) -> None:
        """Prepare; files begin with the first frame. Without a folder everything stays in memory.

        After `lag_frames` an estimate is final, smoothed by those; `keep_observations` keeps motion
        samples, too.
        """
        self._body = body
        self._lag = lag_frames
        self._keep = keep_observations
        self._folder = folder
        self._rows = FrameRows()
        self._tables: dict[str, Table] = {}
        self._early: list[Rows] = []  # samples before the first frame
        # by what motion sensor and field let the scale be off at the newest frame, over it
        self.scale_doubt = 0.0
        self._written = 0  # frames in the text files
        self._csv_stages: list[str] | None = None  # columns of frames.csv
        self._flushed_s = self._saved_s = time.monotonic()
        self._savable = True
        self._summed: dict[str, int] = {}  # rows of each table that the last checkpoint rests on
        self._kept: dict[str, KeptRows] = {}  # what was replaced since, by the table's name

    # What goes in

    def take_samples(self, samples: Sequence[MotionSample]) -> None:
        """Take motion samples."""
        if not self._keep:
            return
        if self._tables:
            with self._writing():
                self._tables["samples"].append(sample_rows(samples))
        else:
            self._early.append(sample_rows(samples))

    def dead_reckoning(self, T_world_body: FloatArray) -> None:
        """Take the pose (4, 4) of a frame by dead reckoning, after the frame itself."""
        row = np.zeros(1, dtype=_POSE)
        row["T"] = T_world_body
        with self._writing():
            self._tables["dead_reckoning"].append(row)

    def frame(self, result: FrameResult, read_ms: float, smoothed: Smoothed) -> None:
        """Take the result of a frame.

        Raises:
            DataError: the folder cannot be written.
        """
        if not self._tables:
            self._begin()
        estimates = self._tables["estimates"]
        index = result.log.index
        self.scale_doubt = result.report.scale_doubt
        self.revise(smoothed, len(estimates) - self._lag, len(estimates) - self._lag + 1)
        with self._writing():
            estimates.append(estimate_row(index, result.estimate))
            self._tables["frames"].append(self._rows.row(result.log, read_ms))
            if result.estimate.T_map_body is not None:
                self._tables["mapped"].append(mapped_row(index, result.estimate))
            if self._keep:
                seen = result.output.observations
                self._tables["observations"].append(observation_rows(seen))
                self._tables["seen"].append(
                    np.array([(seen.frame_index, seen.time_ns, len(seen))], dtype=SEEN)
                )
        if time.monotonic() - self._flushed_s > _TIMES.flush_s:
            self.flush()

    def revise(self, smoothed: Smoothed, first: int = 0, end: int | None = None) -> None:
        """Replace estimates by the smoothed ones: pose, covariance, velocity and biases; without
        a lag, nothing. What findings leave in doubt stays so.
        """
        if not self._lag or not self._tables:
            return
        estimates = self._tables["estimates"]
        stop = len(estimates) if end is None else end
        for k in range(max(first, stop - self._lag, 0), stop):
            row = estimates.rows()[k]
            late = smoothed(int(row["index"]))
            if late is not None:
                was = estimate_of(row)
                now = replace(
                    was,
                    T_world_imu=late.T_world_imu,
                    covariance=inflated(late.covariance, was.position_doubt_m),
                    velocity_world=late.velocity_world,
                    gyro_bias=late.gyro_bias,
                    accel_bias=late.accel_bias,
                    gravity_world=late.gravity_world,
                )
                estimates.replace(k, estimate_row(int(row["index"]), now))

    def replace(self, estimates: Mapping[int, Estimate]) -> None:
        """Replace the estimates of frames by others, by frame number; the text files begin anew."""
        if not estimates or not self._tables:
            return
        table = self._tables["estimates"]
        with self._writing():
            known = table.rows()
            places = {_place(known, index): index for index in sorted(estimates)}
            rows = [k for k, i in places.items() if k < len(known) and known["index"][k] == i]
            self._keep_rows("estimates", rows)
            self._keep_rows("frames", rows)
            for k in rows:
                self._replace(k, places[k], estimates[places[k]])
        self._written = 0
        self._saved_s = -np.inf  # the last checkpoint is that of other rows

    def mark(self, marks: Sequence[Mark]) -> None:
        """Mark the estimates of earlier frames; the text files begin anew."""
        if not marks or not self._tables:
            return
        estimates = self._tables["estimates"]
        with self._writing():
            for mark in marks:
                rows = estimates.rows()  # not copied: those of an hour are hundreds of megabytes
                held = range(_place(rows, mark.since), _place(rows, mark.before))
                sigma_m = _may_be_off_m(rows, held, mark)
                self._keep_rows("estimates", held)
                self._keep_rows("frames", held)
                for k, more_m in zip(held, sigma_m.tolist(), strict=True):
                    estimate = marked(estimate_of(rows[k]), mark, more_m)
                    self._replace(k, int(rows[k]["index"]), estimate)
        self._written = 0
        self._saved_s = -np.inf  # the last checkpoint is that of other rows

    def _replace(self, row: int, index: int, estimate: Estimate) -> None:
        """Replace the estimate of a frame in its row of the tables."""
        self._tables["estimates"].replace(row, estimate_row(index, estimate))
        frames = self._tables["frames"]
        log_row = np.array(frames.rows(row, row + 1))
        log_row["integrity"] = INTEGRITIES.index(estimate.integrity)
        frames.replace(row, log_row)

    def flush(self) -> None:
        """Bring all that is final to the disk: the tables, trajectory.tum and frames.csv."""
        if self._folder is None or not self._tables:
            return
        with self._writing():
            for table in self._tables.values():
                table.flush()
            final = len(self._tables["frames"]) - self._lag
            if final > self._written:
                self._append_texts(self._folder.path, self._written, final)
                self._written = final
        self._flushed_s = time.monotonic()

    # What comes out

    def __len__(self) -> int:
        return len(self._tables["frames"]) if self._tables else 0

    @property
    def estimates(self) -> Records[Estimate]:
        """Estimates of all frames."""
        return Records(self._tables["estimates"], estimate_of)

    @property
    def frames(self) -> Records[FrameLog]:
        """Logs of all frames."""
        return Records(self._tables["frames"], self._rows.frame)

    @property
    def mapped(self) -> Rows:
        """The poses in the map as known at the time, one row a frame that had one."""
        return self._tables["mapped"].rows()

    @property
    def observations(self) -> Records[Observations] | None:
        """Observations of all frames; None: not kept."""
        if not self._keep:
            return None
        seen = self._tables["seen"]
        rows = self._tables["observations"]
        ends = dict(
            zip(
                seen.rows()["index"].tolist(), np.cumsum(seen.rows()["count"]).tolist(), strict=True
            )
        )
        return Records(seen, lambda row: observations_of(row, rows, ends[int(row["index"])]))

    @property
    def samples(self) -> Records[MotionSample] | None:
        """All motion samples; None: not kept."""
        if not self._keep:
            return None
        return Records(self._tables["samples"], sample_of)

    def dead_reckoned(self) -> FloatArray:
        """Poses (N, 4, 4) by dead reckoning."""
        return np.asarray(self._tables["dead_reckoning"].rows()["T"])

    def landmarks(self, newest: Landmarks) -> Landmarks:
        """Join the points put away in the run's folder with the newest; a point that came back
        counts once.
        """
        stored = self._tables["points"]
        if not len(stored):
            return newest
        with self._writing():
            self._put_away(newest)
            rows = stored.rows()
            _, last = np.unique(rows["id"][::-1], return_index=True)
            # a file, as the map of an hour fills memory
            joined = Table(POINT, self._unfinished / "landmarks.npy")
            for part in np.array_split(len(rows) - 1 - last, 1 + len(last) // _CHUNK):
                joined.append(rows[part])
            joined.close()
        rows = joined.rows()
        return Landmarks(rows["id"], rows["p_world"], rows["covariance"])

    def put_away(self, points: Landmarks) -> None:
        """Take points of the map that will not change any more, after the first frame.

        Raises:
            DataError: the folder cannot be written.
        """
        with self._writing():
            self._put_away(points)

    def _put_away(self, points: Landmarks) -> None:
        rows = np.zeros(len(points.ids), dtype=POINT)
        rows["id"] = points.ids
        rows["p_world"] = points.p_world
        rows["covariance"] = points.covariance
        self._tables["points"].append(rows)

    # Checkpoints

    @property
    def can_save(self) -> bool:
        """Whether there is something to save, a folder to save it in, and nothing that cannot be
        saved.
        """
        return self._folder is not None and self._savable and bool(self._tables)

    @property
    def is_save_due(self) -> bool:
        """Whether it is time for a checkpoint."""
        return self.can_save and time.monotonic() - self._saved_s > _TIMES.checkpoint_s

    def save(self, state: Any, dataset: Dataset, finished: Landmarks) -> None:
        """Write a checkpoint of a run's state, less the recording, where `can_save` says so.

        `finished` are points of the map that will not change any more, and that the state no longer
        has.
        """
        assert self._folder is not None
        self.put_away(finished)
        self.flush()
        settled = max(len(self) - self._lag, 0)  # estimates after these will be replaced
        tables = {}
        with self._writing():
            for name, table in self._tables.items():
                table.sync()
                summed = settled if name == "estimates" else len(table)
                tables[name] = len(table), (summed, table.checksum(summed))
        late = np.array(self._tables["estimates"].rows(settled))
        own = {"tables": tables, "late": late, "stages": self._rows.stages}
        try:
            save_checkpoint(
                self._unfinished / CHECKPOINT,
                {"recorder": own, "run": state},
                dataset,
                self._folder.inputs,
            )
        except NotSavableError as error:
            self._savable = False
            log.warning("this run cannot go on with --resume if it is interrupted: %s", error)
        else:
            self._summed = {name: summed for name, (_, (summed, _)) in tables.items()}
            for kept in self._kept.values():
                kept.forget()
        self._saved_s = time.monotonic()

    def _keep_rows(self, name: str, indices: Sequence[int]) -> None:
        """Keep those of a table's rows that the last checkpoint rests on and that are replaced."""
        of_checkpoint = [k for k in indices if k < self._summed.get(name, 0)]
        if not of_checkpoint:
            return
        if name not in self._kept:
            self._kept[name] = self._kept_rows(name)
        checkpoint = checkpoint_id(self._unfinished / CHECKPOINT)
        self._kept[name].keep(self._tables[name], of_checkpoint, checkpoint)

    def _kept_rows(self, name: str) -> KeptRows:
        return KeptRows(self._unfinished / f"{name}_kept.npy", _TABLES[name])

    def restore(self, dataset: Dataset | None) -> Any:
        """Go on from the folder's checkpoint; return the state that `save` was given.

        `dataset` is what the state refers to; None: to no recording.

        Raises:
            DataError: there is none, it or a table is damaged, or the run depends on what has
                changed since.
        """
        assert self._folder is not None
        for name in (RunFile.UNFINISHED, *_TEXTS):
            check_own(self._folder.path / name)
        state = load_checkpoint(self._unfinished / CHECKPOINT, dataset, self._folder.inputs)
        own = state["recorder"]
        self._rows.stages = list(own["stages"])
        paths = {name: self._unfinished / f"{name}.npy" for name in _TABLES}
        checkpoint = checkpoint_id(self._unfinished / CHECKPOINT)
        for name in ("estimates", "frames"):
            self._kept_rows(name).take_back(paths[name], checkpoint)
        self._summed = {name: summed for name, (_, (summed, _)) in own["tables"].items()}
        for name, dtype in _TABLES.items():
            check_table(paths[name], dtype, *own["tables"][name])
        for name, (keep, summed) in own["tables"].items():
            self._tables[name] = Table(_TABLES[name], paths[name], keep=keep, summed=summed)
        estimates = self._tables["estimates"]
        for k, row in enumerate(own["late"], start=len(estimates) - len(own["late"])):
            estimates.replace(k, row[None])
        return state["run"]

    def close(self) -> None:
        """Flush and let all files go; the tables can still be read."""
        self.flush()
        for table in self._tables.values():
            with self._writing():
                table.close()

    # How

    @property
    def _unfinished(self) -> Path:
        assert self._folder is not None
        return self._folder.path / RunFile.UNFINISHED

    def _begin(self) -> None:
        """Create the tables and, in a folder, remove what an earlier run left there."""
        if self._folder is None:
            self._tables = {name: Table(dtype) for name, dtype in _TABLES.items()}
        else:
            with self._writing():
                _claim(self._folder)
                self._tables = {
                    name: Table(dtype, self._unfinished / f"{name}.npy")
                    for name, dtype in _TABLES.items()
                }
        for row in self._early:
            self._tables["samples"].append(row)
        self._early = []

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if self._folder is None:
                where = ""
            else:
                where = f" {self._folder.path}"
            raise DataError(f"cannot write{where}: {error.strerror or error}") from error

    def _append_texts(self, folder: Path, start: int, stop: int) -> None:
        """Append frames to trajectory.tum and frames.csv, and wait until the disk has them."""
        rows = self._tables["estimates"].rows(start, stop)
        frames = self.frames[start:stop]
        if self._csv_stages is None:
            self._csv_stages = sorted(self._rows.stages)
        first = start == 0
        body = None
        if first:
            body = self._body
        tum = tum_text(rows["time_ns"], rows["T_world_imu"], body=body)
        for name, text in zip(
            _TEXTS, (tum, frames_csv(frames, self._csv_stages, header=first)), strict=True
        ):
            with open_own(folder / name, "wb" if first else "ab") as stream:
                stream.write(text.encode())
                stream.flush()
                os.fsync(stream.fileno())


def _place(rows: Rows, index: int) -> int:
    """The first of the estimates (N,) of a frame with that number or a later one."""
    return bisect.bisect_left(rows, index, key=lambda row: int(row["index"]))


def _may_be_off_m(rows: Rows, held: range, mark: Mark) -> FloatArray:
    """What the positions of a range (M,) of estimates (N,) may be off by more, as a mark of them says."""
    if not held or not (mark.scale > 0.0 or mark.share > 0.0):
        return np.zeros(len(held))
    own = rows[held.start : held.stop]
    if mark.scale > 0.0:
        position = own["T_world_imu"][:, :3, 3]
        begin = rows[0]["T_world_imu"][:3, 3]
        return np.asarray(mark.scale * np.linalg.norm(position - begin, axis=1))
    elapsed_s = (own["time_ns"] - own["time_ns"][0]) / NS_PER_S
    return np.asarray(mark.share * _fastest_mps(rows) * elapsed_s)


def _fastest_mps(rows: Rows) -> float:
    """The largest speed between the estimates (N,) of frames that may be used."""
    usable = rows["integrity"] < INTEGRITIES.index("unusable")
    if np.count_nonzero(usable) < 2:
        return 0.0
    position = rows["T_world_imu"][:, :3, 3][usable]
    steps_m = np.linalg.norm(np.diff(position, axis=0), axis=1)
    return float(np.max(steps_m / (np.diff(rows["time_ns"][usable]) / NS_PER_S)))


def _claim(folder: GrowingFolder) -> None:
    """Make a folder that of a run, and remove what an earlier one left there.

    The texts that say whose folder it is come first.
    """
    folder.path.mkdir(parents=True, exist_ok=True)
    texts = folder.texts
    early = [name for name in texts if not name.startswith(RunFile.UNFINISHED)]
    for name in early:
        atomic_write_text(folder.path / name, texts[name])
    stale = [name for name in folder.replaces if name not in texts]
    for name in (RunFile.UNFINISHED, *stale):
        if (old := folder.path / name).is_dir() and not old.is_symlink():
            shutil.rmtree(old)
        else:
            old.unlink(missing_ok=True)
    (folder.path / RunFile.UNFINISHED).mkdir()
    for name in sorted(texts.keys() - early):
        atomic_write_text(folder.path / name, texts[name])
