"""The images of a run's recording, as the run corrected their calibration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.calibration.stereo_field import DisplacementField
from vio.cameras.rig import Rectifier
from vio.config import load_config
from vio.datasets import DatasetSettings, in_colour, open_dataset
from vio.datasets.common import read_npz
from vio.datasets.image_pairs import ImageDataset
from vio.errors import DataError
from vio.files.trajectories import read_trajectory
from vio.geometry.distortion import rig_from_rectified
from vio.geometry.lie import FloatArray
from vio.geometry.rectify import pinhole_maps, pinhole_within
from vio.geometry.stereo import StereoCamera
from vio.guard.repairing import AS_READ, Repair, repaired
from vio.protocols import Dataset
from vio.records import FIELD_TERMS, ROW_TERMS, IntArray, StereoFrame
from vio.runs.files import RunFile

_DATED_NS = 630_000_000_000_000_000  # 1990: later times are dates, and tell recordings apart
_MAX_APART_NS = 1_000_000_000  # of a frame's time from the run's: features may be of another sensor


@dataclass(frozen=True, slots=True)
class RunImages:
    """Where the images of a run are, and how they are corrected."""

    where: Path  # the run's folder, for messages
    source: str  # the recording, as `kind:path`
    seen: StereoCamera  # of the images that the front end saw
    camera: StereoCamera  # of the corrected images: a pinhole's, without the field
    # what the run found its stereo calibration to be off by; None: nothing
    field: DisplacementField | None
    repair: Repair = AS_READ  # of the recording's right images

    def frames(
        self, indices: IntArray, source: str | None = None, *, colour: bool = False
    ) -> Iterator[StereoFrame]:
        """Yield the corrected images of frames (K,), in order, with the depths of a camera that has
        them.

        Args:
            indices: frame numbers, increasing.
            source: the recording, if it is not at the path stored in the run.
            colour: keep the images' colours, (H, W, 3).

        Raises:
            DataError: the recording is missing, has no images or another camera, is another one by
                the times of its frames, or a frame cannot be read.
        """
        dataset = self._opened(source)
        times_ns = self._times_ns()
        correct = self._correction(dataset.recording.camera)
        shown = in_colour(dataset) if colour else dataset
        for frame in _chosen(shown, indices.tolist(), self.repair):
            assert frame.left is not None
            own_ns = times_ns.get(frame.index, frame.time_ns)
            dated = min(frame.time_ns, own_ns) > _DATED_NS
            if dated and abs(frame.time_ns - own_ns) > _MAX_APART_NS:
                raise DataError(
                    f"{dataset.recording.path} is another recording than that of the run {self.where}: "
                    f"frame {frame.index} is of {1e-9 * frame.time_ns:.3f} s, the run's of "
                    f"{1e-9 * own_ns:.3f} s; name the run's with --source"
                )
            if correct is None:
                yield frame
            elif frame.right is None:
                if frame.depth is None:
                    depth = None
                else:
                    depth = correct.depth(frame.depth)
                yield replace(frame, left=correct.left(frame.left), depth=depth)
            else:
                left, right = correct(frame.left, frame.right)
                yield replace(frame, left=left, right=right)

    def _times_ns(self) -> dict[int, int]:
        """Return the times of the run's frames, by their numbers; none where it states none."""
        file = self.where / RunFile.TRAJECTORY
        if not file.is_file():
            return {}
        run = read_trajectory(file)
        if run.times_ns is None or run.frame_indices is None:
            return {}
        return dict(zip(run.frame_indices.tolist(), run.times_ns.tolist(), strict=True))

    def _opened(self, source: str | None) -> Dataset:
        file = self.where / RunFile.CONFIG
        if file.is_file():
            settings = load_config(file).dataset
        else:
            settings = DatasetSettings()
        settings = replace(
            settings, projection=self.seen.projection, max_frame_rate=None, camera="both"
        )
        try:
            dataset = open_dataset(source or self.source, settings)
        except DataError as error:
            raise DataError(
                f"the images of {self.where} are not available: {error}; name the recording with "
                "--source"
            ) from error
        recording = dataset.recording
        if not recording.has_images:
            raise DataError(
                f"{source or self.source} contains no images; name the recording with --source"
            )
        ours = self.seen if self.seen.is_cylinder else self.camera
        theirs = recording.camera
        if not np.allclose(
            [ours.fu, ours.fv, ours.cu, ours.cv, ours.baseline_m],
            [theirs.fu, theirs.fv, theirs.cu, theirs.cv, theirs.baseline_m],
            rtol=1e-9,
        ):
            raise DataError(
                f"{recording.path} has another calibration than the run {self.where}; repeat the "
                "run"
            )
        return dataset

    def _correction(self, shown: StereoCamera) -> Rectifier | None:
        """Return the map of images, of the camera that is `shown`, to the corrected ones.

        None: they are the same.
        """
        # features may state no size
        camera = replace(self.camera, width=shown.width, height=shown.height)
        if self.seen.is_cylinder:
            maps = (pinhole_maps(self.seen, camera),) * 2
        elif self.field is not None:
            maps = replace(self.field, camera=camera).maps()
        else:
            return None
        return Rectifier(rig_from_rectified(camera, np.eye(4)), camera, np.eye(4), maps, "linear")


def _spans(dataset: Dataset, indices: list[int]) -> list[tuple[int, int]]:
    """Return which frames, each from one on to before another, are read to get some of them."""
    if isinstance(dataset, ImageDataset):
        return [(k, k + 1) for k in indices]
    if not indices:
        return []
    return [(indices[0], indices[-1] + 1)]


def _chosen(dataset: Dataset, indices: list[int], repair: Repair) -> Iterator[StereoFrame]:
    """Yield some frames: image files one by one, others, which are read in order, in one pass.

    Images that belong to those of other frames come with these.
    """
    waiting = iter(indices)
    due = next(waiting, None)
    for start, stop in _spans(dataset, indices):
        events = dataset.events(start, stop + abs(repair.delay))
        for event in repaired(events, repair, dataset.recording.camera):
            if isinstance(event, StereoFrame) and event.index == due and event.left is not None:
                yield event
                due = next(waiting, None)
        if due is not None and due < stop:
            break
    if due is not None:
        raise DataError(
            f"{dataset.recording.path}: frame {due} cannot be read; see the warnings above"
        )


def run_images(folder: Path, metrics: dict[str, Any]) -> RunImages:
    """Return where the images of a run are, from the metrics in its folder.

    Raises:
        DataError: the metrics are damaged.
    """
    try:
        seen = StereoCamera(**metrics["camera"])
        source = f"{metrics['kind']}:{metrics['source']}"
    except (KeyError, TypeError) as error:
        raise DataError(
            f"{folder}: its metrics.json does not hold camera and source; repeat the run"
        ) from error
    if metrics["kind"] == "log":
        source = original_source(Path(metrics["source"]))
    if seen.kind == "rgbd":
        coefficients = None
    else:
        coefficients = field_coefficients(folder, seen, metrics)
    field = (
        None if coefficients is None or seen.is_cylinder else DisplacementField(seen, coefficients)
    )
    return RunImages(
        folder,
        source,
        seen,
        pinhole_within(seen) if seen.is_cylinder else seen,
        field,
        Repair.of_json(metrics.get("right_images")),
    )


def field_coefficients(
    folder: Path, camera: StereoCamera, metrics: dict[str, Any]
) -> FloatArray | None:
    """Return the coefficients (15,) of (R3) and (R2) in a run's metrics; None: the run estimated
    none.

    Raises:
        DataError: the metrics are damaged.
    """
    stated = metrics.get("stereo_field")
    if stated is None or stated.get("rows_px") is None:
        return None
    try:
        of_columns, of_rows = (
            np.array(stated[name], dtype=np.float64) for name in ("coefficients_px", "rows_px")
        )
        coefficients = np.concatenate([of_columns / camera.fu, of_rows / camera.fv])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{folder}: stereo_field of its metrics is damaged ({error}); repeat the run"
        ) from error
    if coefficients.shape != (FIELD_TERMS + ROW_TERMS,) or not np.isfinite(coefficients).all():
        raise DataError(
            f"{folder}: stereo_field of its metrics holds no {FIELD_TERMS + ROW_TERMS} finite "
            "numbers; repeat the run"
        )
    return coefficients


def original_source(log: Path) -> str:
    """Return the recording of the images, through any number of replayed logs."""
    source = str(read_npz(log, ["source"])["source"])
    kind, _, path = source.partition(":")
    seen = {log.resolve()}
    while kind == "log" and Path(path).is_file() and Path(path).resolve() not in seen:
        seen.add(Path(path).resolve())
        source = str(read_npz(Path(path), ["source"])["source"])
        kind, _, path = source.partition(":")
    return source
