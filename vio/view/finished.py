"""A finished run in the rerun viewer, from its folder."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.observation_log import read_observation_log
from vio.errors import DataError, VioError
from vio.files.inputs import read_input
from vio.files.meshes import R_GLTF_UPRIGHT
from vio.geometry.stereo import Projection, StereoCamera
from vio.records import Image, Landmarks, LoopEvent, StereoFrame, UpdateReport
from vio.runs.files import MeshFile, RunFile
from vio.runs.finished import FinishedRun
from vio.runs.tables import estimate_of
from vio.view.live import SERIES, RerunViewer, ViewedRig, states_of

if TYPE_CHECKING:
    import rerun as rr

log = logging.getLogger(__name__)

_EVERY_IMAGE = 5  # frames of a finished run of which one shows its image
_NOTHING_DONE = UpdateReport(0, 0, 0, 0, None, None)


def show_finished_run(stream: rr.RecordingStream, run: FinishedRun) -> None:
    """Show a run from its folder, with its features where they were saved, and its images where
    they still are.

    Raises:
        DataError: the folder was written by a version that did not keep the camera.
    """
    rig = _rig_of(run)
    viewer = RerunViewer(stream, rig, share=1.0)
    saved = run.folder / RunFile.OBSERVATIONS
    log_of_features = read_observation_log(saved) if saved.is_file() else None
    images = _images_of(run, rig.camera.projection)
    names = {
        "features": ("tracked", "matched", "selected", "used", "gated"),
        "innovation": ("innovation_median_px", "nis_per_dof"),
        "time": [f"{name}_ms" for name in SERIES["time"]],
    }
    loops: dict[int, list[LoopEvent]] = {}
    for loop in run.loops:
        loops.setdefault(loop.frame, []).append(loop)
    keyframes = set(run.map_keyframes.frame[run.map_keyframes.own].tolist())
    for row, estimate in enumerate(map(estimate_of, run.estimates)):
        index = int(run.estimates["index"][row])
        numbers = {
            curve: [float(run.frames[name][row]) for name in columns]
            for curve, columns in names.items()
        }
        seen = None if log_of_features is None else log_of_features.observations(index)
        if seen is None:
            states = None
        else:
            states = states_of(seen, seen.has_right, _NOTHING_DONE)
        image = None
        if row % _EVERY_IMAGE == 0:
            image = next(images, None)
        viewer.show(index, estimate, numbers, image, seen, states)
        viewer.places(index, estimate, is_keyframe=index in keyframes, loops=loops.get(index, ()))
    ids = np.arange(len(run.points))
    viewer.landmarks(Landmarks(ids, run.points, np.zeros((len(ids), 3, 3))))
    _show_mesh(stream, run.folder / MeshFile.FOLDER)
    viewer.close()


def _show_mesh(stream: rr.RecordingStream, folder: Path) -> None:
    """Show the mesh of `vio mesh`, where there is one; its file has y up, the run's world need
    not.
    """
    import rerun as rr

    if not (folder / MeshFile.GLTF).is_file() or not (folder / MeshFile.FACTS).is_file():
        return
    try:
        R = np.array(
            json.loads(read_input(folder / MeshFile.FACTS))["R_upright_world"], dtype=np.float64
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{folder / MeshFile.FACTS}: is damaged ({error}); repeat vio mesh"
        ) from error
    stream.log("world/run/mesh", rr.Transform3D(mat3x3=(R_GLTF_UPRIGHT @ R).T), static=True)
    stream.log("world/run/mesh", rr.Asset3D(path=folder / MeshFile.GLTF), static=True)


def _rig_of(run: FinishedRun) -> ViewedRig:
    """Return the rig of a run from its folder."""
    try:
        camera = StereoCamera(**run.metrics["camera"])
    except (KeyError, TypeError) as error:
        raise DataError(
            f"{run.folder}: its metrics.json does not hold the camera; repeat the run"
        ) from error
    reference = None if run.evaluation is None else run.evaluation.reference
    return ViewedRig(camera, run.T_cam0_body, run.metrics.get("motion"), reference)


def _images_of(run: FinishedRun, projection: Projection) -> Iterator[Image]:
    """Yield the left images of every fifth frame of a run; none where the recording is not there
    any more.
    """
    source = f"{run.metrics.get('kind')}:{run.metrics.get('source')}"
    try:
        dataset = open_dataset(source, DatasetSettings(projection=projection))
    except VioError as error:
        log.warning("the images are not shown: %s", error)
        return
    if not dataset.recording.has_images:
        return
    for index in run.estimates["index"][::_EVERY_IMAGE].tolist():
        found = [
            e
            for e in dataset.events(index, index + 1)
            if isinstance(e, StereoFrame) and e.left is not None
        ]
        if not found or found[0].left is None:
            return
        yield found[0].left
