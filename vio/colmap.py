"""COLMAP: models written and read, bundle adjustment, reconstruction. The only file that knows pycolmap.

Two conventions of COLMAP end here. Its pixels put the *corner* of the top-left pixel at (0, 0), ours its centre: half a
pixel is added on the way in and taken off on the way out. Its poses map the world to the camera (`cam_from_world`, our
`T_cam_world`), ours the other way.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vio.errors import DataError, EstimationError, MissingDependencyError
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import StereoCamera
from vio.mapping import PointTracks, keep_rows, reprojection
from vio.records import Trajectory

try:
    import pycolmap
except ImportError as _error:  # pragma: no cover
    raise MissingDependencyError(
        "this command needs pycolmap; install it with `pip install 'pycolmap>=4.2'`"
    ) from _error

log = logging.getLogger(__name__)

ColourArray = npt.NDArray[np.uint8]

HALF_PX = 0.5  # COLMAP's pixel coordinates minus ours
SEED = 0
_LEFT, _RIGHT = 1, 2  # camera ids
_RIG = 1
_GRAY = 128  # of points without an image
_MODEL_FILES = ("images.bin", "images.txt")
_STAMP = re.compile(r"\d{15,19}")  # nanoseconds, as in EuRoC's file names
_NS_PER_S = 1_000_000_000


def quiet() -> None:
    """Keep COLMAP's own log to errors."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)


# --- models ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ModelImages:
    """The keyframes of a model as files."""

    left: tuple[str, ...]  # K names relative to the folder of images
    right: tuple[str, ...]


def build_model(
    camera: StereoCamera,
    T_world_cam0: FloatArray,
    tracks: PointTracks,
    names: ModelImages,
    colours: ColourArray | None = None,
) -> pycolmap.Reconstruction:
    """Build a COLMAP model: two pinhole cameras in a rig, a frame for each keyframe, points with tracks and colours.

    Args:
        camera: the rectified pair; its image size must be known.
        T_world_cam0: (K, 4, 4) poses of the keyframes, metres.
        tracks: the points.
        names: image files of the keyframes.
        colours: (M, 3) of the points; None: gray.

    Raises:
        DataError: the image size is unknown.
    """
    if camera.width is None or camera.height is None:
        raise DataError("a COLMAP model needs the image size, which these features lack; run on images")
    model = pycolmap.Reconstruction()
    for camera_id in (_LEFT, _RIGHT):
        model.add_camera(
            pycolmap.Camera(
                camera_id=camera_id,
                model="PINHOLE",
                width=camera.width,
                height=camera.height,
                params=[camera.fu, camera.fv, camera.cu + HALF_PX, camera.cv + HALF_PX],
                has_prior_focal_length=True,
            )
        )
    model.add_rig(_rig(model, np.array([camera.baseline_m, 0.0, 0.0])))
    begins = np.searchsorted(tracks.keyframe, np.arange(len(T_world_cam0) + 1))
    right_index = np.full(len(tracks.point), -1, dtype=np.int64)
    for k, T_cam0_world in enumerate(se3_inverse(T_world_cam0)):
        rows = slice(int(begins[k]), int(begins[k + 1]))
        z, right = tracks.z[rows], tracks.has_right[rows]
        right_index[rows][right] = np.arange(int(right.sum()))
        _add_frame(model, k, T_cam0_world, names, z[:, :2], z[right, 2:])
    by_point = np.argsort(tracks.point, kind="stable")
    parts = np.searchsorted(tracks.point[by_point], np.arange(len(tracks.ids) + 1))
    for m, p in enumerate(tracks.p_world):
        elements = []
        for row in by_point[parts[m] : parts[m + 1]].tolist():
            k = int(tracks.keyframe[row])
            elements.append(pycolmap.TrackElement(_image_id(k, _LEFT), row - int(begins[k])))
            if tracks.has_right[row]:
                elements.append(pycolmap.TrackElement(_image_id(k, _RIGHT), int(right_index[row])))
        colour = np.full(3, _GRAY, dtype=np.uint8) if colours is None else colours[m]
        model.add_point3D(p, pycolmap.Track(elements), colour)
    model.update_point_3d_errors()
    return model


def _image_id(keyframe: int, camera_id: int) -> int:
    return 2 * keyframe + camera_id


def _frame_id(keyframe: int) -> int:
    return keyframe + 1


def _rig(model: pycolmap.Reconstruction, right_in_left: FloatArray) -> pycolmap.Rig:
    rig = pycolmap.Rig(rig_id=_RIG)
    rig.add_ref_sensor(model.camera(_LEFT).sensor_id)
    rig.add_sensor(model.camera(_RIGHT).sensor_id, pycolmap.Rigid3d(pycolmap.Rotation3d(), -right_in_left))
    return rig


def _add_frame(
    model: pycolmap.Reconstruction,
    keyframe: int,
    T_cam0_world: FloatArray,
    names: ModelImages,
    left: FloatArray,
    right: FloatArray,
) -> None:
    images = [
        pycolmap.Image(
            name=name,
            camera_id=camera_id,
            image_id=_image_id(keyframe, camera_id),
            points2D=pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in uv + HALF_PX]),
        )
        for name, camera_id, uv in (
            (names.left[keyframe], _LEFT, left),
            (names.right[keyframe], _RIGHT, right),
        )
    ]
    frame = pycolmap.Frame(frame_id=_frame_id(keyframe), rig_id=_RIG)
    for image in images:
        image.frame_id = frame.frame_id
        frame.add_data_id(image.data_id)
    frame.rig_from_world = _rigid(T_cam0_world)
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    model.register_frame(frame.frame_id)


def _rigid(T: FloatArray) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(np.ascontiguousarray(T[:3]))


def _matrix(T: pycolmap.Rigid3d | None) -> FloatArray:
    assert T is not None
    out = np.eye(4)
    out[:3] = T.matrix()
    return out


def mean_reprojection_error_px(model: pycolmap.Reconstruction) -> float:
    """Mean length of the residuals over all observations, as COLMAP computes it."""
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model in COLMAP's binary form; the folder must exist."""
    model.write_binary(folder)


def nerfstudio_transforms(camera: StereoCamera, T_world_cam0: FloatArray, names: ModelImages) -> str:
    """Return the text of nerfstudio's `transforms.json`; file names as given, the point cloud beside it.

    Poses are camera to world with x right, y up, z back (OpenGL); the world is the run's own, metric.
    """
    T_cam0_cam1 = np.eye(4)
    T_cam0_cam1[0, 3] = camera.baseline_m
    to_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": name, "transform_matrix": (T @ to_opengl).tolist()}
        for k, T_world in enumerate(T_world_cam0)
        for name, T in ((names.left[k], T_world), (names.right[k], T_world @ T_cam0_cam1))
    ]
    document = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fu,
        "fl_y": camera.fv,
        "cx": camera.cu + HALF_PX,
        "cy": camera.cv + HALF_PX,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "ply_file_path": "points.ply",
        "frames": frames,
    }
    return json.dumps(document, indent=1) + "\n"


def read_colmap_trajectory(folder: Path) -> Trajectory:
    """Read the poses of a COLMAP model as a trajectory of cam0: the rig's reference camera, or the only one.

    A file name of 15 to 19 digits is a time in nanoseconds; otherwise its last number is taken for the frame's.

    Raises:
        DataError: no model, or its images carry no numbers.
    """
    place = model_folder(folder)
    if place is None:
        raise DataError(f"{folder}: no COLMAP model (images.bin or images.txt, also looked for in sparse/0)")
    try:
        model = pycolmap.Reconstruction(place)
    except (ValueError, RuntimeError, OSError) as error:
        raise DataError(f"{place}: pycolmap cannot read the model ({_one_line(error)}); export it again") from error
    images = [image for image in model.images.values() if image.has_pose and _is_reference(model, image)]
    if not images:
        raise DataError(f"{place}: the model holds no image with a pose")
    stamps = [_number(image.name, place) for image in images]
    order = np.argsort(stamps)
    numbers = np.array(stamps, dtype=np.int64)[order]
    if (np.diff(numbers) <= 0).any():
        raise DataError(f"{place}: two images of the reference camera carry one number; keep one camera in the model")
    poses = se3_inverse(np.array([_matrix(images[k].cam_from_world()) for k in order.tolist()]))
    if all(_STAMP.fullmatch(Path(image.name).stem) for image in images):
        return Trajectory(poses, numbers, "cam0")
    return Trajectory(poses, None, "cam0", numbers)


def model_folder(folder: Path) -> Path | None:
    """The folder that holds a model's files: this one, or `sparse/0` or `sparse` in it; None where there is none."""
    places = (folder, folder / "sparse" / "0", folder / "sparse")
    return next((place for place in places if any((place / name).is_file() for name in _MODEL_FILES)), None)


def _is_reference(model: pycolmap.Reconstruction, image: pycolmap.Image) -> bool:
    frame = model.frame(image.frame_id)
    return bool(model.rig(frame.rig_id).is_ref_sensor(model.camera(image.camera_id).sensor_id))


def _number(name: str, place: Path) -> int:
    found = re.findall(r"\d+", Path(name).stem)
    if not found:
        raise DataError(f"{place}: the image {name!r} carries no frame number or time; name images by number")
    return int(found[-1])


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:160]


# --- bundle adjustment ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Adjustment:
    """What a bundle adjustment made of keyframes and points."""

    T_world_cam0: FloatArray  # (K, 4, 4)
    tracks: PointTracks  # with moved points, without outliers
    rms_before_px: float  # over all rows that were kept, each coordinate
    rms_after_px: float
    rows_dropped: int
    sigma_px: float  # robust spread of a coordinate's residual after the first round


@dataclass(frozen=True, slots=True)
class PositionPriors:
    """Where the keyframes' left cameras are believed to be."""

    positions: FloatArray  # (K, 3) world, metres
    covariances: FloatArray  # (K, 3, 3) m^2


def adjust(
    camera: StereoCamera,
    T_world_cam0: FloatArray,
    tracks: PointTracks,
    *,
    priors: PositionPriors | None = None,
    gate_sigma: float = 5.0,
    threads: int = 1,
    progress: Callable[[], None] = lambda: None,
) -> Adjustment:
    """Bundle-adjust keyframes and points under the stereo rig, intrinsics and extrinsics held fixed.

    Two rounds: all rows under a robust loss, then again from the start without the rows that it calls outliers. The
    first keyframe stays where it is.

    Args:
        camera: the rectified pair.
        T_world_cam0: (K, 4, 4) where to start.
        tracks: points and rows.
        priors: a Gaussian on each camera position, weighted against the pixels' own spread.
        gate_sigma: rows off by more than so many robust standard deviations leave the second round.
        threads: of the solver; one makes the result repeatable.
        progress: called after each of the two rounds.

    Raises:
        EstimationError: the solver failed.
    """
    before, _ = reprojection(camera, T_world_cam0, tracks)
    first_T, first_points = _solve(camera, T_world_cam0, tracks, None, 1.0, threads)
    progress()
    residual, ahead = reprojection(camera, first_T, replace(tracks, p_world=first_points))
    entries = np.abs(np.concatenate([residual[:, :2].ravel(), residual[tracks.has_right, 2:].ravel()]))
    sigma_px = max(1.4826 * float(np.median(entries)), 1e-3)
    good = ahead & (np.abs(residual).max(axis=1) < gate_sigma * sigma_px)
    start = keep_rows(tracks, good)
    if not len(start.ids):
        raise EstimationError("not observable because no track is consistent over the keyframes; check the run's poses")
    T, points = _solve(camera, T_world_cam0, start, priors, 2 * sigma_px, threads, sigma_px=sigma_px)
    progress()
    done = replace(start, p_world=points)
    after, _ = reprojection(camera, T, done)
    kept = np.isin(np.arange(len(good)), np.flatnonzero(good))
    return Adjustment(
        T, done, _rms(before[kept]), _rms(after), int(len(tracks.point) - len(start.point)), float(sigma_px)
    )


def _rms(residual: FloatArray) -> float:
    return float(np.sqrt(np.mean(residual**2)))


def _solve(
    camera: StereoCamera,
    T_world_cam0: FloatArray,
    tracks: PointTracks,
    priors: PositionPriors | None,
    loss_px: float,
    threads: int,
    *,
    sigma_px: float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """Poses (K, 4, 4) and points (M, 3) of one bundle adjustment."""
    count = len(T_world_cam0)
    blank = tuple(f"{k}" for k in range(count))
    model = build_model(camera, T_world_cam0, tracks, ModelImages(blank, tuple(f"{k}r" for k in range(count))))
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    for camera_id in (_LEFT, _RIGHT):
        config.set_constant_cam_intrinsics(camera_id)
    config.set_constant_sensor_from_rig_pose(model.camera(_RIGHT).sensor_id)
    config.set_constant_rig_from_world_pose(_frame_id(0))
    options = _solver_options(loss_px, threads)
    if priors is None:
        adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    else:
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(
            options, pycolmap.PosePriorBundleAdjustmentOptions(), config, _pose_priors(model, priors, sigma_px), model
        )
    summary = adjuster.solve()
    if not summary.is_solution_usable():
        raise EstimationError(f"the bundle adjustment failed ({summary.brief_report()}); check the run's poses")
    T_cam0_world = np.array([_matrix(model.frame(_frame_id(k)).rig_from_world) for k in range(count)])
    points = np.array([model.point3D(m + 1).xyz for m in range(len(tracks.ids))])
    return se3_inverse(T_cam0_world), points


def _solver_options(loss_px: float, threads: int) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = 60
    options.ceres.solver_options.function_tolerance = 1e-7
    return options


def _pose_priors(model: pycolmap.Reconstruction, priors: PositionPriors, sigma_px: float) -> list[pycolmap.PosePrior]:
    """One prior for each keyframe's left image; covariances scaled so that pixels may keep unit weight."""
    out = []
    for k, (position, covariance) in enumerate(zip(priors.positions, priors.covariances, strict=True)):
        out.append(
            pycolmap.PosePrior(
                pose_prior_id=k + 1,
                corr_data_id=model.image(_image_id(k, _LEFT)).data_id,
                position=position,
                position_covariance=covariance / sigma_px**2,
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
        )
    return out
