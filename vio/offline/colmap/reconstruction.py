"""Reconstruction of keyframes from their images alone, by COLMAP's features, matches and
mappers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import pycolmap

from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import HALF_PX, StereoCamera
from vio.offline.colmap import SEED, SIFT_FEATURES
from vio.offline.colmap.model import (
    ModelImages,
    mean_reprojection_error_px,
    pose_rows,
    rectified_rig,
)
from vio.records import BoolArray, IntArray

Mapper: TypeAlias = Literal["incremental", "global"]
_NEXT = (1, 2, 3, 5, 8, 16)  # index offsets of later keyframes that left images are matched with
_CROSS_NEXT = (1,)  # likewise between right images and later left ones


class _ModelRules(NamedTuple):
    """Which images are joined."""

    # keyframes up to which all left images are matched, so that a loop that the run missed is found
    exhaustive_images: int = 60
    min_registered: int = 3
    # keyframes across which a step of the path may be joined; those further apart are joined by a
    # loop
    linked_images: int = 6


_MODEL = _ModelRules()
# index offsets from both keyframes of a loop, whose left images are matched with one another
_AROUND_LOOP = (-1, 0, 1)
MIN_SHARED = 15  # points that two left images show, from which the model counts as joined there


@dataclass(frozen=True, slots=True)
class Reconstructed:
    """A reconstruction by COLMAP."""

    mapper: Mapper
    # (R, 4, 4) of the registered keyframes, in COLMAP's world frame, metric by the rig
    T_world_cam0: FloatArray
    keyframes: IntArray  # (R,) their indices, increasing
    points: int
    mean_reprojection_error_px: float
    shared: IntArray  # (L,) points that both left images of each loop show
    # (R - 1,) whether the model is joined from each keyframe to the next, and not by a loop alone
    linked: BoolArray
    # (M, 2) keyframes far apart in time that show one place by the model, best first
    revisits: IntArray


def match_images(
    database: Path,
    images: Path,
    names: ModelImages,
    camera: StereoCamera,
    loops: IntArray,
    *,
    threads: int = 1,
) -> None:
    """Find SIFT features in image files and match them within and between keyframes, into a new
    COLMAP database.

    Args:
        database: the file to create.
        images: folder that the names are relative to; left images must be in one folder, right ones
            in another.
        names: the keyframes' images.
        camera: the rectified pair, intrinsics and baseline of the rig.
        loops: (L, 2) keyframes that show one place, which are matched as well, and those next to
            them.
        threads: for all steps; one makes the result repeatable.
    """
    pycolmap.set_random_seed(SEED)
    reader = pycolmap.ImageReaderOptions(
        camera_model="PINHOLE",
        camera_params=f"{camera.fu!r},{camera.fv!r},{camera.cu + HALF_PX!r},{camera.cv + HALF_PX!r}",
    )
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads)
    extraction.sift.max_num_features = SIFT_FEATURES
    pycolmap.extract_features(
        database,
        images,
        image_names=[*names.left, *names.right],
        camera_mode=pycolmap.CameraMode.PER_FOLDER,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    left, right = (f"{Path(side[0]).parent.as_posix()}/" for side in (names.left, names.right))
    rig = pycolmap.RigConfig(
        cameras=[
            pycolmap.RigConfigCamera(ref_sensor=True, image_prefix=left),
            pycolmap.RigConfigCamera(image_prefix=right, cam_from_rig=rectified_rig(camera)),
        ]
    )
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([rig], opened)
    pairs = database.with_name("pairs.txt")
    pairs.write_text(
        "".join(f"{a} {b}\n" for a, b in pairs_to_match(names, loops)), encoding="utf-8"
    )
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


def pairs_to_match(names: ModelImages, loops: IntArray) -> list[tuple[str, str]]:
    """Return the pairs of image files to match, each once."""
    count = len(names.left)
    out = list(zip(names.left, names.right, strict=True))
    steps: Sequence[int] = _NEXT
    if count <= _MODEL.exhaustive_images:
        steps = range(1, count)
    out += [(names.left[k], names.left[k + step]) for step in steps for k in range(count - step)]
    out += [
        (names.right[k], names.left[k + step]) for step in _CROSS_NEXT for k in range(count - step)
    ]
    around = [(a, b) for a, b in _around(loops) if 0 <= a < b < count]
    out += [(names.left[a], names.left[b]) for a, b in around]
    return list(dict.fromkeys(out))


def _around(loops: IntArray) -> list[tuple[int, int]]:
    """Return the pairs of keyframes that loops (L, 2) join, and those of their neighbours."""
    steps = list(product(_AROUND_LOOP, repeat=2))
    return sorted({(a + i, b + j) for a, b in loops.tolist() for i, j in steps})


def _poses(model: pycolmap.Reconstruction, names: ModelImages) -> list[tuple[int, FloatArray]]:
    """Return the keyframes whose left images a model has a pose of, and these poses (4, 4) of the
    world in the camera, in order.
    """
    place = {name: k for k, name in enumerate(names.left)}
    return sorted(
        (place[image.name], pose_rows(image.cam_from_world()))
        for image in model.images.values()
        if image.has_pose and image.name in place
    )


def reconstruct(
    database: Path,
    images: Path,
    names: ModelImages,
    mapper: Mapper,
    out: Path,
    loops: IntArray,
    *,
    threads: int = 1,
) -> Reconstructed | None:
    """Reconstruct keyframes from a database of matches, with fixed rig and intrinsics; None: not
    successful.

    Args:
        database: made by `match_images`; not modified.
        images: folder that the names are relative to.
        names: the keyframes' images.
        mapper: COLMAP's incremental or global mapper.
        out: folder for the model, created if missing.
        loops: (L, 2) keyframes that show one place.
        threads: for all steps.
    """
    pycolmap.set_random_seed(SEED)
    out.mkdir(parents=True, exist_ok=True)
    if mapper == "incremental":
        models = pycolmap.incremental_mapping(
            database, images, out, options=_incremental_options(threads)
        )
    else:
        models = pycolmap.global_mapping(database, images, out, options=_global_options(threads))
    if not models:
        return None
    model = max(models.values(), key=lambda m: int(m.num_reg_images()))
    found = _poses(model, names)
    if len(found) < _MODEL.min_registered:
        return None
    keyframes = np.array([k for k, _ in found], dtype=np.int64)
    points = _common_points(model, [names.left[k] for k in keyframes.tolist()])
    ends = np.searchsorted(keyframes, loops).clip(0, len(keyframes) - 1)
    both_ends = (keyframes[ends] == loops).all(axis=1)
    of_loops = np.where(both_ends, points[ends[:, 0], ends[:, 1]], 0)
    return Reconstructed(
        mapper,
        se3_inverse(np.array([T for _, T in found])),
        keyframes,
        int(model.num_points3D()),
        mean_reprojection_error_px(model),
        of_loops.astype(np.int64),
        linked_steps(points, keyframes),
        _revisits(points, keyframes),
    )


def _common_points(model: pycolmap.Reconstruction, names: Sequence[str]) -> IntArray:
    """Return how many points of a model each two of the images (R,) show, (R, R)."""
    images = [model.find_image_with_name(name) for name in names]
    seen = [{p.point3D_id for p in image.points2D if p.has_point3D()} for image in images]
    return np.array([[len(a & b) for b in seen] for a in seen], dtype=np.int64)


def linked_steps(points: IntArray, keyframes: IntArray) -> BoolArray:
    """Return whether a model is joined from each keyframe (R,) to the next (R - 1,), by the
    points (R, R) shared.
    """
    near = np.abs(keyframes[None, :] - keyframes[:, None]) <= _MODEL.linked_images
    joined = near & (points >= MIN_SHARED)
    return np.array([joined[:n, n:].any() for n in range(1, len(points))], dtype=np.bool_)


def _revisits(points: IntArray, keyframes: IntArray) -> IntArray:
    far = keyframes[None, :] - keyframes[:, None] > _NEXT[-1]
    a, b = np.nonzero(far & (points >= MIN_SHARED))
    best = np.argsort(-points[a, b], kind="stable")
    return np.stack([keyframes[a[best]], keyframes[b[best]]], axis=1)


def _incremental_options(threads: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=SEED)
    options.multiple_models = options.extract_colors = False
    options.min_model_size = _MODEL.min_registered
    options.ba_refine_focal_length = options.ba_refine_principal_point = (
        options.ba_refine_extra_params
    ) = False
    options.ba_refine_sensor_from_rig = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = (
        False
    )
    # keyframes of one drive see the scene from nearly one direction
    options.mapper.init_min_tri_angle = 4.0
    options.mapper.init_min_num_inliers = 50
    options.mapper.filter_max_reproj_error = 2.0
    options.mapper.filter_min_tri_angle = 0.5
    options.triangulation.min_angle = 0.5
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
    return options


def _global_options(threads: int) -> pycolmap.GlobalPipelineOptions:
    options = pycolmap.GlobalPipelineOptions(num_threads=threads, random_seed=SEED)
    mapper = options.mapper
    mapper.num_threads = threads
    mapper.random_seed = SEED
    mapper.refine_sensor_from_rig = False
    mapper.min_tri_angle_deg = 0.5
    mapper.global_positioning.use_gpu = False
    adjustment = mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_principal_point = (
        adjustment.refine_extra_params
    ) = False
    adjustment.refine_sensor_from_rig = False
    adjustment.ceres.use_gpu = False
    mapper.retriangulation.min_angle = 0.5
    return options
