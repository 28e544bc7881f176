"""Reader of a run's folder with its observations, and of its images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vio.calibration.stereo_field import DisplacementField
from vio.cameras.rectification_error import METRIC_TERMS, TERMS
from vio.datasets.features import FeatureDataset
from vio.datasets.images import write_png
from vio.datasets.observation_log import read_observation_log
from vio.errors import DataError
from vio.files.trajectories import read_trajectory
from vio.filters.stereo_calibration import StereoCorrection
from vio.filters.track_records import Views
from vio.filters.tracks import measured
from vio.geometry.lie import FloatArray, se3_inverse, so3_hat
from vio.geometry.rectify import pinhole_pixels, pinhole_within
from vio.geometry.stereo import StereoCamera
from vio.guard.repairing import Repair
from vio.offline.comparison import GroundTruth
from vio.offline.keyframes import TrackedPath
from vio.offline.run_images import RunImages, field_coefficients, original_source
from vio.records import FIELD_TERMS, FeatureTracks, Image, IntArray, LoopEvent, need_stereo
from vio.runs.files import RunFile
from vio.runs.finished import read_estimates
from vio.runs.mapped import read_loops
from vio.runs.stated import read_metrics

if TYPE_CHECKING:
    from vio.offline.colmap.model import ModelImages


@dataclass(frozen=True, slots=True)
class SavedRun:
    """Contents of a run's folder, with its observations."""

    # the left camera's trajectory with its observations; `tracked.where` is the folder
    tracked: TrackedPath
    source: str  # the recording of the images, as `kind:path`
    dataset: FeatureDataset  # observations of every frame, as a recording
    T_cam0_imu: FloatArray  # (4, 4)
    metrics: dict[str, Any]
    # what the run found its stereo calibration to be off by; None: nothing
    field: DisplacementField | None = None

    @property
    def images(self) -> RunImages:
        """The recording's images as the tracks see them."""
        return RunImages(
            self.tracked.where,
            self.source,
            self.dataset.recording.camera,
            self.tracked.camera,
            self.field,
            Repair.of_json(self.metrics.get("right_images")),
        )

    @property
    def truth(self) -> GroundTruth | None:
        """The ground truth in the recording; None: there is none."""
        reference = self.dataset.recording.reference
        return None if reference is None else GroundTruth(reference, self.T_cam0_imu)


def read_saved_run(folder: Path) -> SavedRun:
    """Read the folder of `vio run --save-observations`.

    Where the run estimated what its stereo calibration is off by, the tracks are those of a
    rectified pair without it; where its images were rectified to a cylinder, those of a pinhole
    inside it, as other programs know no cylinder. `dataset` holds the pixels as the front end saw
    them. Where the run had a map and closed loops between its own frames, the poses are those in
    the map, and the tracks have the loops.

    Raises:
        DataError: no such folder, or the observations were not saved.
    """
    metrics, T_cam0_imu = read_metrics(folder)
    log = folder / RunFile.OBSERVATIONS
    if not log.is_file():
        raise DataError(
            f"{folder} has no {RunFile.OBSERVATIONS}; repeat its run with --save-observations"
        )
    dataset = read_observation_log(log)
    need_stereo(replace(dataset.recording, path=folder), "checking, refining or exporting a run")
    loops = closing_loops(read_loops(folder))
    poses = RunFile.MAP_TRAJECTORY if loops else RunFile.TRAJECTORY
    trajectory = read_trajectory(folder / poses)
    frames = trajectory.frame_indices
    if (
        frames is None
        or not np.array_equal(frames, dataset.present)
        or not np.isfinite(trajectory.T_world_body).all()
    ):
        raise DataError(
            f"{folder}: {poses} and {RunFile.OBSERVATIONS} are not of the same complete run; "
            "repeat the run"
        )
    camera = dataset.recording.camera
    tracks = dataset.tracks
    coefficients = field_coefficients(folder, camera, metrics)
    field = None
    if camera.is_cylinder:
        camera, tracks = _in_pinhole(camera, tracks, coefficients)
    elif coefficients is not None:
        field = DisplacementField(camera, coefficients)
    sigmas = _sigmas(folder / RunFile.ESTIMATES, T_cam0_imu)
    tracked = TrackedPath(folder, camera, trajectory.in_cam0(T_cam0_imu), tracks, loops, sigmas)
    if field is not None:
        tracked = without_field(tracked, field)
    return SavedRun(tracked, original_source(log), dataset, T_cam0_imu, metrics, field)


def closing_loops(loops: Sequence[LoopEvent]) -> tuple[LoopEvent, ...]:
    """Return the loops between frames of the run itself that agree with the others, with
    features.
    """
    return tuple(
        o for o in loops if o.kept and o.keyframe_frame is not None and o.matches is not None
    )


def without_field(path: TrackedPath, field: DisplacementField) -> TrackedPath:
    """Return a path with the pixels of a rectified pair without the field, in its tracks and its
    loops.
    """
    tracks = replace(path.tracks, z=field.without(path.tracks.z, path.tracks.has_right))
    return replace(path, tracks=tracks, loops=tuple(_without(field, o) for o in path.loops))


def _sigmas(path: Path, T_cam0_imu: FloatArray) -> FloatArray | None:
    """Return standard deviations (N, 2) of the left camera's position and attitude.

    None: the run has no such file.
    """
    if not path.is_file():
        return None
    rows = read_estimates(path)
    P = np.array(rows["covariance"])
    c = se3_inverse(T_cam0_imu)[:3, 3]
    p_D_xi = np.concatenate([-np.eye(3), so3_hat(c)], axis=1)
    position = np.trace(p_D_xi @ P @ p_D_xi.T, axis1=1, axis2=2)
    return np.sqrt(
        np.stack(
            [position, np.degrees(np.degrees(np.trace(P[:, 3:, 3:], axis1=1, axis2=2)))], axis=1
        )
    )


def _without(field: DisplacementField, loop: LoopEvent) -> LoopEvent:
    """Return a loop with the pixels of a rectified pair without the field."""
    m = loop.matches
    if m is None:
        return loop
    z = (
        field.without(m.z_keyframe, m.has_right_keyframe),
        field.without(m.z_frame, m.has_right_frame),
    )
    return replace(loop, matches=replace(m, z_keyframe=z[0], z_frame=z[1]))


def _in_pinhole(
    camera: StereoCamera, tracks: FeatureTracks, coefficients: FloatArray | None
) -> tuple[StereoCamera, FeatureTracks]:
    """Return the pinhole inside a cylinder, and those of the tracks' pixels that it shows.

    They are without the rectification error of the coefficients (15,) of (R3) and (R2), where there
    is one.
    """
    z = tracks.z
    if coefficients is not None:
        states = np.concatenate([coefficients[:FIELD_TERMS], np.zeros(METRIC_TERMS)])
        stereo = StereoCorrection(camera, coefficients[FIELD_TERMS:], states, np.arange(TERMS))
        z = stereo.corrected(Views(z, measured(tracks.has_right))).z
        z[:, 3] = z[:, 1]
    pinhole = pinhole_within(camera)
    left, kept = pinhole_pixels(camera, pinhole, z[:, :2])
    right, has_right = pinhole_pixels(camera, pinhole, z[:, 2:])
    has_right &= tracks.has_right
    offsets = np.concatenate([[0], np.cumsum(kept)])[tracks.offsets]
    z = np.concatenate([left, right], axis=1)[kept]
    return pinhole, FeatureTracks(offsets, tracks.ids[kept], z, has_right[kept], tracks.stale[kept])


def with_poses(run: SavedRun, folder: Path) -> SavedRun:
    """Return the run with the poses of another folder, such as that of `vio refine`.

    Raises:
        DataError: that folder does not exist or contains other frames.
    """
    if not (folder / RunFile.TRAJECTORY).is_file():
        raise DataError(
            f"{folder} contains no trajectory; create it with `vio refine {run.tracked.where}`"
        )
    trajectory = read_trajectory(folder / RunFile.TRAJECTORY).in_cam0(run.T_cam0_imu)
    if trajectory.frame_indices is None or not np.array_equal(
        trajectory.frame_indices, run.tracked.frames
    ):
        raise DataError(f"{folder} contains other frames than {run.tracked.where}; refine again")
    return replace(run, tracked=replace(run.tracked, trajectory=trajectory))


def write_images(
    run: SavedRun,
    source: str | None,
    keyframes: IntArray,
    names: ModelImages,
    folder: Path,
    each: Callable[[int, Image], None] = lambda keyframe, left: None,
) -> None:
    """Write the rectified images of the keyframes, in colour where the recording has any.

    Args:
        run: the run.
        source: the recording, if it is not at the path stored in the run.
        keyframes: (K,) rows of the trajectory, increasing.
        names: file names relative to the folder.
        folder: created if missing.
        each: called with each keyframe's index and left image.

    Raises:
        DataError: the images are not available.
    """
    for name in (names.left[0], names.right[0]):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(
        run.images.frames(run.tracked.frames[keyframes], source, colour=True)
    ):
        assert frame.left is not None
        assert frame.right is not None
        for name, image in ((names.left[k], frame.left), (names.right[k], frame.right)):
            write_png(folder / name, image)
        each(k, frame.left)
