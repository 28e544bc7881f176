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
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.calibration.stereo import RayMatches
from vio.errors import DataError, EstimationError, MissingDependencyError
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import StereoCamera
from vio.mapping import PointTracks, keep_rows, reprojection
from vio.records import BoolArray, Image, IntArray, Trajectory

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
    pycolmap.logging.verbose_level = -1


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
    """Mean over the points of the mean length of their residuals: COLMAP's own figure."""
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
    except (ValueError, RuntimeError, OSError, IndexError, MemoryError) as error:
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
    model = build_model(camera, T_world_cam0, tracks, _numbered(count))
    config = _whole(model)
    config.set_constant_sensor_from_rig_pose(model.camera(_RIGHT).sensor_id)
    config.set_constant_rig_from_world_pose(_frame_id(0))
    options = _solver_options(loss_px, threads)
    if priors is None:
        adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    else:
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(
            options, pycolmap.PosePriorBundleAdjustmentOptions(), config, _pose_priors(model, priors, sigma_px), model
        )
    _solved(adjuster)
    T_cam0_world = np.array([_matrix(model.frame(_frame_id(k)).rig_from_world) for k in range(count)])
    points = np.array([model.point3D(m + 1).xyz for m in range(len(tracks.ids))])
    return se3_inverse(T_cam0_world), points


def _solved(adjuster: pycolmap.BundleAdjuster) -> None:
    summary = adjuster.solve()
    if not summary.is_solution_usable():
        raise EstimationError(f"the bundle adjustment failed ({summary.brief_report()}); check poses and calibration")


def adjust_rig_in_motion(
    camera: StereoCamera, T_world_cam0: FloatArray, tracks: PointTracks, *, gate_sigma: float = 5.0
) -> tuple[FloatArray, FloatArray]:
    """Bundle-adjust the pose of cam1 in cam0 together with keyframes and points, over tracks in time.

    Motion shows what a single pair leaves to the lens model: a turn of one camera about the vertical shifts all
    disparities, which the way between two frames contradicts.

    Returns `R_cam1_cam0` (3, 3) and the unit direction (3,) from cam0 to cam1 in cam0, of the rectified pair.

    Raises:
        EstimationError: the solver failed, or no track is consistent.
    """
    good = np.ones(len(tracks.point), dtype=np.bool_)
    R, direction = np.eye(3), np.array([1.0, 0.0, 0.0])
    for loss_px in (1.0, 0.5):
        kept = keep_rows(tracks, good)
        if not len(kept.ids):
            raise EstimationError("not observable because no track is consistent over the keyframes")
        count = len(T_world_cam0)
        model = build_model(camera, T_world_cam0, kept, _numbered(count))
        config = _whole(model)
        config.set_constant_rig_from_world_pose(_frame_id(0))
        options = _solver_options(loss_px, 1)
        options.refine_sensor_from_rig = True
        _solved(pycolmap.create_default_bundle_adjuster(options, config, model))
        T_cam1_cam0 = _matrix(model.rig(_RIG).sensor_from_rig(model.camera(_RIGHT).sensor_id))
        R = T_cam1_cam0[:3, :3]
        direction = -R.T @ T_cam1_cam0[:3, 3]
        direction /= np.linalg.norm(direction)
        model.update_point_3d_errors()
        errors = np.array([model.point3D(m + 1).error for m in range(len(kept.ids))])
        limit = gate_sigma * float(np.median(errors))
        good = np.isin(tracks.ids[tracks.point], kept.ids[errors < limit])
    return R, direction


def _numbered(count: int) -> ModelImages:
    return ModelImages(tuple(f"{k}" for k in range(count)), tuple(f"{k}r" for k in range(count)))


def _whole(model: pycolmap.Reconstruction) -> pycolmap.BundleAdjustmentConfig:
    """All images of a model, intrinsics held fixed."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    for camera_id in (_LEFT, _RIGHT):
        config.set_constant_cam_intrinsics(camera_id)
    return config


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


# --- reconstruction -------------------------------------------------------------------------------------------------

Mapper: TypeAlias = Literal["incremental", "global"]
_FEATURES = 1500  # per image
_NEXT = (1, 2, 3, 5, 8, 16)  # keyframes ahead that the left camera is matched with
_CROSS_NEXT = (1,)  # keyframes ahead of the left camera that the right one is matched with
_LEAST_REGISTERED = 3


@dataclass(frozen=True, slots=True)
class Reconstructed:
    """What COLMAP made of images alone."""

    mapper: Mapper
    T_world_cam0: FloatArray  # (R, 4, 4) of the registered keyframes, in COLMAP's own world, metric by the rig
    keyframes: IntArray  # (R,) their indices, increasing
    points: int
    mean_reprojection_error_px: float


def match_images(database: Path, images: Path, names: ModelImages, camera: StereoCamera, *, threads: int = 1) -> None:
    """Find SIFT features in image files and match them within and between keyframes, into a new COLMAP database.

    Args:
        database: the file to make.
        images: folder that the names are relative to; left images must lie in one folder, right ones in another.
        names: the keyframes' images.
        camera: the rectified pair, intrinsics and baseline of the rig.
        threads: for all steps; one makes the result repeatable.
    """
    pycolmap.set_random_seed(SEED)
    reader = pycolmap.ImageReaderOptions(
        camera_model="PINHOLE",
        camera_params=f"{camera.fu!r},{camera.fv!r},{camera.cu + HALF_PX!r},{camera.cv + HALF_PX!r}",
    )
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads)
    extraction.sift.max_num_features = _FEATURES
    pycolmap.extract_features(
        database,
        images,
        image_names=[*names.left, *names.right],
        camera_mode=pycolmap.CameraMode.PER_FOLDER,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    right_from_rig = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-camera.baseline_m, 0.0, 0.0]))
    left, right = (f"{Path(side[0]).parent.as_posix()}/" for side in (names.left, names.right))
    rig = pycolmap.RigConfig(
        cameras=[
            pycolmap.RigConfigCamera(ref_sensor=True, image_prefix=left),
            pycolmap.RigConfigCamera(image_prefix=right, cam_from_rig=right_from_rig),
        ]
    )
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([rig], opened)
    pairs = database.with_name("pairs.txt")
    pairs.write_text("".join(f"{a} {b}\n" for a, b in _pairs(names)), encoding="utf-8")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    verification.ransac.max_error = 2.0
    pycolmap.match_image_pairs(
        database,
        matching_options=pycolmap.FeatureMatchingOptions(num_threads=threads),
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=pairs),
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )
    pairs.unlink()


def _pairs(names: ModelImages) -> list[tuple[str, str]]:
    count = len(names.left)
    out = list(zip(names.left, names.right, strict=True))
    out += [(names.left[k], names.left[k + step]) for step in _NEXT for k in range(count - step)]
    out += [(names.right[k], names.left[k + step]) for step in _CROSS_NEXT for k in range(count - step)]
    return out


def reconstruct(
    database: Path, images: Path, names: ModelImages, mapper: Mapper, out: Path, *, threads: int = 1
) -> Reconstructed | None:
    """Reconstruct keyframes from a database of matches, rig and intrinsics held fixed; None: nothing came of it.

    Args:
        database: made by `match_images`; left as it is.
        images: folder that the names are relative to.
        names: the keyframes' images.
        mapper: COLMAP's incremental mapper, or its global one.
        out: folder for the model, made if missing.
        threads: for all steps.
    """
    pycolmap.set_random_seed(SEED)
    out.mkdir(parents=True, exist_ok=True)
    if mapper == "incremental":
        models = pycolmap.incremental_mapping(database, images, out, options=_incremental_options(threads))
    else:
        models = pycolmap.global_mapping(database, images, out, options=_global_options(threads))
    if not models:
        return None
    model = max(models.values(), key=lambda m: int(m.num_reg_images()))
    place = {name: k for k, name in enumerate(names.left)}
    found = sorted(
        (place[image.name], _matrix(image.cam_from_world()))
        for image in model.images.values()
        if image.has_pose and image.name in place
    )
    if len(found) < _LEAST_REGISTERED:
        return None
    return Reconstructed(
        mapper,
        se3_inverse(np.array([T for _, T in found])),
        np.array([k for k, _ in found], dtype=np.int64),
        int(model.num_points3D()),
        mean_reprojection_error_px(model),
    )


def _incremental_options(threads: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=SEED)
    options.multiple_models = options.extract_colors = False
    options.min_model_size = _LEAST_REGISTERED
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.ba_refine_sensor_from_rig = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.mapper.init_min_tri_angle = 4.0  # keyframes of one drive see the scene from nearly one direction
    options.mapper.init_min_num_inliers = 50
    options.mapper.filter_max_reproj_error = 2.0
    options.mapper.filter_min_tri_angle = 0.5
    options.triangulation.min_angle = 0.5
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
    return options


def _global_options(threads: int) -> pycolmap.GlobalPipelineOptions:
    options = pycolmap.GlobalPipelineOptions(num_threads=threads, random_seed=SEED)
    mapper = options.mapper
    mapper.num_threads, mapper.random_seed = threads, SEED
    mapper.refine_sensor_from_rig = False
    mapper.min_tri_angle_deg = 0.5
    mapper.global_positioning.use_gpu = False
    adjustment = mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_principal_point = adjustment.refine_extra_params = False
    adjustment.refine_sensor_from_rig = False
    adjustment.ceres.use_gpu = False
    mapper.retriangulation.min_angle = 0.5
    return options


# --- stereo pairs ---------------------------------------------------------------------------------------------------

_RATIO = 0.8  # of the distances to the best and the second best descriptor
_VIRTUAL_PX = 500.0  # focal length of the camera that rays are turned into pixels with
_ESSENTIAL_PX = 1.0


def sift_matches(left: Image, right: Image, *, threads: int = 1) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) and (N, 2) of mutual best SIFT matches of two images (H, W), outliers among them."""
    options = pycolmap.FeatureExtractionOptions(num_threads=threads)
    options.sift.max_num_features = _FEATURES
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    (keys0, features0), (keys1, features1) = (_features(extractor, image) for image in (left, right))
    if len(keys0) < 2 or len(keys1) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    likeness = features0 @ features1.T
    norm0, norm1 = np.sum(features0**2, axis=1), np.sum(features1**2, axis=1)
    distance = norm0[:, None] + norm1[None, :] - 2 * likeness
    best1, best0 = np.argmin(distance, axis=1), np.argmin(distance, axis=0)
    two = np.partition(distance, 1, axis=1)[:, :2]
    good = (best0[best1] == np.arange(len(keys0))) & (two[:, 0] < _RATIO**2 * two[:, 1])
    uv0, uv1 = (keys - HALF_PX for keys in (keys0, keys1))
    return uv0[good], uv1[best1[good]]


def _features(extractor: pycolmap.FeatureExtractor, image: Image) -> tuple[FloatArray, npt.NDArray[np.float32]]:
    """COLMAP's pixels (N, 2) of the features of an image, and their descriptors (N, 128)."""
    keypoints, descriptors = extractor.extract_from_uint8_array(np.ascontiguousarray(image))
    if not len(keypoints):
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    matrix = np.asarray(pycolmap.keypoints_to_matrix(keypoints), dtype=np.float64)
    return matrix[:, :2], np.asarray(descriptors.data, dtype=np.float32)


def relative_pose(matches: RayMatches) -> tuple[FloatArray, FloatArray] | None:
    """Rotation `R_cam1_cam0` (3, 3) and unit direction (3,) of cam1 in cam0, by RANSAC over the matches of all pairs.

    None: no consensus.
    """
    pixels = [_VIRTUAL_PX * ray[:, :2] / ray[:, 2:] for ray in (matches.ray0, matches.ray1)]
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=1000, height=1000, params=[_VIRTUAL_PX, _VIRTUAL_PX, 0.0, 0.0]
    )
    options = pycolmap.RANSACOptions(
        max_error=_ESSENTIAL_PX, random_seed=SEED, min_num_trials=200, max_num_trials=2000, num_threads=1
    )
    found = pycolmap.estimate_essential_matrix(pixels[0], pixels[1], camera, camera, options)
    if found is None:
        return None
    T_cam1_cam0 = _matrix(found["cam2_from_cam1"])
    # COLMAP gives the length one; the position of cam1 in cam0 is -R^T t.
    direction = -T_cam1_cam0[:3, :3].T @ T_cam1_cam0[:3, 3]
    return T_cam1_cam0[:3, :3], direction / np.linalg.norm(direction)


def adjust_rig(matches: RayMatches, R_cam1_cam0: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bundle-adjust the pose of cam1 in a rig over the matches (inliers) of all pairs; same form as the input.

    Each pair is a frame of one rig with its own points; only the rig's inner transform and the points move, and the
    scale, which two cameras leave open, is taken out again.

    Raises:
        EstimationError: the solver failed.
    """
    model = pycolmap.Reconstruction()
    for camera_id in (_LEFT, _RIGHT):
        model.add_camera(
            pycolmap.Camera(
                camera_id=camera_id,
                model="PINHOLE",
                width=1000,
                height=1000,
                params=[_VIRTUAL_PX, _VIRTUAL_PX, 0.0, 0.0],
            )
        )
    rig = pycolmap.Rig(rig_id=_RIG)
    rig.add_ref_sensor(model.camera(_LEFT).sensor_id)
    right = model.camera(_RIGHT).sensor_id
    rig.add_sensor(right, pycolmap.Rigid3d(pycolmap.Rotation3d(R_cam1_cam0), -R_cam1_cam0 @ direction))
    model.add_rig(rig)
    points, valid = _two_view_points(matches, R_cam1_cam0, direction)
    matches, points = matches.take(valid), points[valid]
    names, pair = np.unique(matches.pair, return_inverse=True)
    order = np.argsort(pair, kind="stable")
    for k in range(len(names)):
        rows = order[pair[order] == k]
        left, other = (_VIRTUAL_PX * ray[rows, :2] / ray[rows, 2:] - HALF_PX for ray in (matches.ray0, matches.ray1))
        _add_frame(model, k, np.eye(4), _numbered(len(names)), left, other)
        for at, row in enumerate(rows.tolist()):
            track = pycolmap.Track(
                [pycolmap.TrackElement(_image_id(k, _LEFT), at), pycolmap.TrackElement(_image_id(k, _RIGHT), at)]
            )
            model.add_point3D(points[row], track, np.zeros(3, dtype=np.uint8))
    config = _whole(model)
    for k in range(len(names)):
        config.set_constant_rig_from_world_pose(_frame_id(k))
    options = _solver_options(0.5, 1)
    options.refine_sensor_from_rig = True
    options.refine_rig_from_world = False
    _solved(pycolmap.create_default_bundle_adjuster(options, config, model))
    T_cam1_cam0 = _matrix(model.rig(_RIG).sensor_from_rig(right))
    moved = -T_cam1_cam0[:3, :3].T @ T_cam1_cam0[:3, 3]
    return T_cam1_cam0[:3, :3], moved / np.linalg.norm(moved)


def _two_view_points(
    matches: RayMatches, R_cam1_cam0: FloatArray, direction: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Points (N, 3) in cam0 in units of the baseline, nearest to both rays, and a mask of those ahead of both."""
    a, b = matches.ray0, matches.ray1 @ R_cam1_cam0
    cosine = np.sum(a * b, axis=1)
    along_a, along_b = a @ direction, b @ direction
    sine2 = 1 - cosine**2
    valid = sine2 > 1e-6
    safe = np.where(valid, sine2, 1.0)
    s, t = (along_a - cosine * along_b) / safe, (cosine * along_a - along_b) / safe
    valid &= (s > 0.5) & (t > 0.5)
    points = (s[:, None] * a + direction + t[:, None] * b) / 2
    return points, valid
