"""Each limit of calibration in motion, adjustments and COLMAP's models, from both sides."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, patch

import cv2
import numpy as np
import pytest

from tests.offline.test_limits import _run
from tests.refused import is_refused
from vio.calibration.stereo import RayMatches, RowResiduals, StereoEstimate
from vio.cameras.rig import Rig
from vio.errors import VioError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, se3_exp, so3_exp
from vio.geometry.stereo import StereoCamera, project
from vio.interop import pycolmap, rerun
from vio.offline import (
    georeference,
    inertial_refinement,
    keyframes,
    map_adjustment,
    points,
    refine,
    self_calibration,
    verdict,
)
from vio.offline.inertial_adjustment import InertialAdjustment
from vio.offline.points import PointTracks
from vio.records import FeatureTracks

Says = Callable[[float], bool]
CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)
LENS = CameraModel(400.0, 400.0, 319.5, 239.5, 640, 480, "pinhole", ())
NONE: Any = None


def _needing_colmap(module: str) -> Any:
    return pytest.importorskip(module, exc_type=ImportError)


# Calibration in motion


def _pieces(motions: int) -> list[Any]:
    """The pieces of a recording with the motions of so many frames, whose
    points are what they are built with.
    """
    calibrate = _needing_colmap("vio.offline.calibrate")
    motion: Any = SimpleNamespace(
        frames=np.arange(motions),
        times_ns=10**8 * np.arange(motions + 1),
        twists=np.zeros((motions, 6)),
    )
    with (
        patch.object(calibrate, "stereo_twists", lambda *_: motion),
        patch.object(
            calibrate, "choose_keyframes", lambda piece, most: np.arange(most)[: len(piece.frames)]
        ),
        patch.object(calibrate, "build_tracks", lambda *_, gate_px: gate_px),
    ):
        source: Any = SimpleNamespace(path=Path("a"))
        return list(calibrate._segments(source, CAMERA, NONE, motion.times_ns))


def _rounds(left_deg: float) -> int:
    """How often a calibration is repeated that is off by so much each time."""
    calibrate = _needing_colmap("vio.offline.calibrate")
    found = MagicMock()
    found.right_camera.return_value = (
        so3_exp([np.radians(left_deg), 0.0, 0.0]),
        np.array([1.0, 0.0, 0.0]),
        0.0,
        0.0,
    )
    found.after.return_value.right_camera.return_value = (np.eye(3), np.zeros(3), 9.0, 9.0)
    found.after.return_value.rig_parameters.return_value = np.zeros(len(calibrate.PARAMETERS))
    held = MagicMock(return_value=found)
    source = MagicMock()
    source.image_size.return_value = (640.0, 480.0)
    source.dataset.recording.camera = CAMERA
    tracks = FeatureTracks(
        np.zeros(1, np.int64),
        np.zeros(0, np.int64),
        np.zeros((0, 4)),
        np.zeros(0, np.bool_),
        np.zeros(0, np.bool_),
    )
    with (
        patch.object(calibrate, "_segments", lambda *_: [MagicMock()]),
        patch.object(calibrate, "self_calibrate", held),
    ):
        calibrate._measure_in_motion(source, _estimate(0.0), tracks)
    return sum(not call.kwargs["intrinsics"] for call in held.call_args_list)


def _estimate(turn_deg: float) -> StereoEstimate:
    R = so3_exp([np.radians(turn_deg), 0.0, 0.0])
    return StereoEstimate(R, np.array([1.0, 0.0, 0.0]), 0.01, 0.1, 100, 9, 0.01)


def _frames_matched(pairs: int) -> int:
    calibrate = _needing_colmap("vio.offline.calibrate")
    seen = np.tile([300.0, 200.0, 290.0, 200.0], (100, 1))
    no = np.zeros(100, np.bool_)
    tracks = FeatureTracks(np.arange(101), np.arange(100), seen, ~no, no)
    recording: Any = SimpleNamespace(camera=CAMERA)
    return len(np.unique(calibrate._match_tracks(recording, tracks, pairs).rays.pair))


def _is_measured_again(turn_deg: float) -> bool:
    calibrate = _needing_colmap("vio.offline.calibrate")
    source = MagicMock(T_cam0_cam1=np.eye(4))
    return calibrate._again(source, _estimate(turn_deg), ()) is not None


def _rows_are_at_fault(off_px: float) -> bool:
    calibrate = _needing_colmap("vio.offline.calibrate")
    rows = RowResiduals(-0.5 * off_px, 0.5 * off_px, np.zeros((3, 3)), 1.0, 99, off_px, 9.0)
    return calibrate._fault_of_rows(rows, ()) is not None


# Checks


def _drawn(ratio: float = 1.0, beside: float = 0.0) -> tuple[bool, bool]:
    """Whether the distances of a check's picture are drawn by their logarithms, the largest of which
    is so many times the median; and whether poses that are beside the path are in the picture, by
    shares of its length.
    """
    check = _needing_colmap("vio.offline.check")
    T = np.tile(np.eye(4), (9, 1, 1))
    T[:, 0, 3] = np.arange(9)
    T[:, 1, 3] = 1e-3 * (np.arange(9) % 2)
    aligned = T.copy()
    aligned[4, 1, 3] = 8.0 * beside
    difference_m = np.full(9, 0.1)
    difference_m[4] *= ratio
    comparison: Any = SimpleNamespace(
        aligned=aligned, frames=np.arange(9), difference_m=difference_m, segments=()
    )
    trajectory: Any = SimpleNamespace(positions=T[:, :3, 3])
    result: Any = SimpleNamespace(mapper="global", found=(None, comparison))
    with patch.object(check, "overall_verdict", lambda results: "ok"):
        above, along = check.draw_check(trajectory, [result]).axes
    return along.get_yscale() == "log", "outside" not in str(above.get_legend_handles_labels()[1])


def _names_turn(deg: float) -> bool:
    segment: Any = SimpleNamespace(difference_m=0.1, difference_deg=deg)
    comparison: Any = SimpleNamespace(
        aligned=np.tile(np.eye(4), (3, 1, 1)), piece=np.ones(3, np.bool_)
    )
    return "deg" in verdict._size(comparison, [segment])


def _turn_is_negligible(deg: float) -> bool:
    segment: Any = SimpleNamespace(difference_m=0.0, difference_deg=deg)
    comparison: Any = SimpleNamespace(
        aligned=np.tile(np.eye(4), (3, 1, 1)), piece=np.ones(3, np.bool_)
    )
    return verdict._grade(comparison, [segment]) == "negligible"


def _is_of_map(poses: int) -> bool:
    """Whether a run is one of a map by so many keyframes of both."""
    store = MagicMock()
    T = np.array([se3_exp([0.1 * k, 0, 0, 0, 0, 0]) for k in range(poses)]).reshape(-1, 4, 4)
    run = MagicMock()
    with (
        patch.object(georeference, "MapStore", store),
        patch.object(georeference, "read_metrics", lambda run: ({"map": {"joined": True}}, NONE)),
        patch.object(georeference, "_common", lambda run, home: (T, T)),
        patch.object(georeference, "cKDTree", side_effect=RuntimeError),
    ):
        try:
            georeference.place_by_map(MagicMock(), run, Path("a"), Path("b"))
        except VioError:
            return False
        except RuntimeError:
            return True
    return False


# Keyframes and points


def _may_be_keyframe(features: int) -> bool:
    """Whether a frame that alone shows so many features, and before which much of the view is lost,
    becomes a keyframe.
    """
    run: Any = _run(0.1, 41, kept=0.95)
    few = MagicMock(wraps=run)
    few.frames = run.frames
    few.loops = run.loops
    few.tracks = run.tracks
    few.camera = run.camera
    few.fresh = lambda k: run.fresh(k).take(np.arange(40) < (features if k % 2 else 40))
    chosen = keyframes.keyframes_by_overlap(few, most=40)
    return bool((chosen[1:-1] % 2).any())


def _stretch_counts(motions: int) -> bool:
    """Whether so many motions in a row are a piece, beside a long one."""
    frames = np.concatenate([np.arange(motions), 100 + np.arange(50)])
    motion: Any = SimpleNamespace(
        frames=frames,
        times_ns=10**8 * np.arange(200),
        twists=np.zeros((len(frames), 6)),
    )
    found = keyframes.tracked_segments(Path("a"), CAMERA, NONE, motion, longest=100, most=9)
    return len(found) == 2


def _tracks(p: FloatArray, views: int = 1) -> PointTracks:
    """Points that so many keyframes at the origin show."""
    count = len(p)
    z = np.tile(project(CAMERA, p), (views, 1))
    keyframe = np.repeat(np.arange(views), count)
    point = np.tile(np.arange(count), views)
    return PointTracks(np.arange(count), p, point, keyframe, z, np.ones(len(z), np.bool_))


def _is_ahead(depth_m: float) -> bool:
    T = np.eye(4)[None]
    return bool(points.reprojection(CAMERA, T, _tracks(np.array([[0.0, 0.0, depth_m]])))[1][0])


def _is_point(views: int) -> bool:
    tracks = _tracks(np.array([[0.0, 0.0, 3.0]]), views)
    return len(points.keep_rows(tracks, np.ones(views, np.bool_)).ids) == 1


def _is_aligned(rows: int) -> bool:
    p = np.random.default_rng(0).uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 4.0], (rows, 3))
    z = project(CAMERA, p)
    return refine.align_to_points(CAMERA, np.eye(4), p, z, np.ones(rows, np.bool_)) is not None


def _last_step() -> int:
    """The number of the last step that a refinement reports, after three others."""
    steps: list[int] = []

    def adjust(*_: Any, progress: Callable[[], None], **__: Any) -> Any:
        progress()
        progress()
        return MagicMock(T_world_cam0=np.zeros((2, 4, 4)))

    names = ("choose_keyframes", "build_tracks", "_scores", "aligned_distance_m", "fill_between")
    names += ("landmarks_of", "loop_pairs", "Refinement", "_warn_of_distance")
    with ExitStack() as stack:
        for name in (*names, "_check_choice"):
            mock = stack.enter_context(patch.object(refine, name))
            mock.return_value = (MagicMock(), MagicMock())
        stack.enter_context(patch.object(refine, "replace"))
        stack.enter_context(patch.object(refine, "adjust", adjust))
        refine.refine_run(MagicMock(), most=None, priors=False, threads=1, progress=steps.append)
    assert steps[:-1] == [1, 2, 3]
    return steps[-1]


# Adjustment with an IMU


def _widths(count: int = 40) -> list[float]:
    """The width of the pixels' weights in each step of a descent that changes nothing."""
    widths: list[float] = []

    def system(self: Any, at: Any, steps: Any, width: float) -> Any:
        widths.append(width)
        return MagicMock()

    own = MagicMock()
    own._system = lambda at, steps, width: system(own, at, steps, width)
    own._cost = lambda at, steps, width: 1.0
    own._after_step = lambda at, system, damping: at
    InertialAdjustment._descend(own, NONE, lambda: None)
    return widths


def _shares_errors(apart_s: float) -> bool:
    """Whether tracks that end in one direction, so long after one another, share their errors."""
    tracks = _tracks(np.array([[0.1, 0.1, 2.0], [0.1, 0.1, 2.0]]))
    tracks = PointTracks(
        tracks.ids, tracks.p_world, tracks.point, np.arange(2), tracks.z, tracks.has_right
    )
    own: Any = SimpleNamespace(tracks=tracks, camera=CAMERA, seconds=np.array([0.0, apart_s]))
    return len(np.unique(InertialAdjustment._clusters(own))) == 1


def _row_sigma() -> float:
    """Of rows whose pixels scatter by one pixel."""
    rng = np.random.default_rng(0)
    tracks = MagicMock(by_loop=np.zeros(4000, np.bool_), has_right=np.ones(4000, np.bool_))
    with patch.object(
        inertial_refinement, "reprojection", lambda *_: (rng.normal(size=(4000, 4)), NONE)
    ):
        return float(inertial_refinement._row_sigmas(MagicMock(), NONE, tracks)[0])


def _map_is_moved(sigmas: float) -> bool:
    """Whether an adjustment is taken that moves a map by so many of its standard deviations."""
    names = ("_path", "feature_tracks", "InertialRun", "replace", "without_field")
    with ExitStack() as stack:
        for name in names:
            stack.enter_context(patch.object(map_adjustment, name))
        for name, value in {
            "inertial_keyframes": lambda *_: np.arange(3),
            "_solve": lambda *_: MagicMock(
                T_world_cam0=np.tile(np.eye(4), (3, 1, 1)),
                best=MagicMock(covariance=np.zeros((3, 6, 6))),
            ),
            "corrected": lambda *_: np.tile(np.eye(4), (3, 1, 1)),
            "_sigmas_moved": lambda *_: sigmas,
        }.items():
            stack.enter_context(patch.object(map_adjustment, name, value))
        path = map_adjustment.replace.return_value  # type: ignore[attr-defined]
        path.frames = np.arange(3)
        path.trajectory.T_world_body = np.tile(np.eye(4), (3, 1, 1))
        result = MagicMock(T_cam0_body=np.eye(4))
        result.estimates.__getitem__.return_value.stereo_field = None
        mapped = MagicMock(T_map_body=np.tile(np.eye(4), (3, 1, 1)))
        mapped.in_map.frame = np.arange(3)
        return not is_refused(lambda: map_adjustment._adjusted(result, mapped, lambda: None))


# Self-calibration


def _regions(across: int, down: int) -> int:
    """How many regions of the image points are in that are spread over it."""
    u, v = (a.ravel() for a in np.meshgrid(np.arange(across) + 0.5, np.arange(down) + 0.5))
    z = np.column_stack([640.0 * u / across, 480.0 * v / down])
    tracks: Any = SimpleNamespace(point=np.arange(len(z)), ids=np.arange(len(z)), z=z)
    return len(np.unique(self_calibration._regions(CAMERA, tracks)))


def _enlarged() -> float:
    """By how much the score of a region grows that alone determines the parameters."""
    A = np.eye(2)
    scores = np.array([[1.0, 0.0]])
    return float(self_calibration._as_before_the_fit(scores, A[None], A)[0, 0])


# COLMAP


def _centre_px() -> float:
    """Where COLMAP's model has the centre of an image of 640 px whose first pixel's centre is 0."""
    camera = StereoCamera(400.0, 400.0, 319.5, 239.5, 0.1, 640, 480)
    model = _needing_colmap("vio.offline.colmap.model")
    names = model.numbered_images(1)
    built = model.build_model(camera, np.eye(4)[None], _tracks(np.array([[0, 0, 3.0]])), names)
    return float(built.camera(model.LEFT).params[2])


def _level_of_points() -> float:
    model = _needing_colmap("vio.offline.colmap.model")
    names = model.numbered_images(1)
    built = model.build_model(CAMERA, np.eye(4)[None], _tracks(np.array([[0, 0, 3.0]])), names)
    return float(np.mean(built.point3D(1).color))


def _texture() -> np.ndarray[Any, np.dtype[np.uint8]]:
    small = np.random.default_rng(0).integers(0, 255, (450, 600)).astype(np.float32)
    large = cv2.resize(small, (1200, 900), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(large, 0, 255), np.uint8)


def _sift_features() -> int:
    image = _texture()
    return len(_needing_colmap("vio.offline.colmap.pairs").sift_matches(image, image)[0])


def _sift_pairs(ratio: float) -> bool:
    """Whether features pair whose second best is so much less alike, as a ratio of distances."""
    pairs = _needing_colmap("vio.offline.colmap.pairs")
    left = np.zeros((2, 128), np.float32)
    left[1, 0] = 1000.0
    right = left.copy()
    right[0, 1] = 100.0 * ratio
    right[1] = [0.0, 0.0, 100.0, *[0.0] * 125]
    keys = [SimpleNamespace(pt=(float(k), 0.0)) for k in range(2)]
    sift = MagicMock()
    sift.detectAndCompute.side_effect = [(keys, left), (keys, right)]
    with patch.object(pairs.cv2, "SIFT_create", lambda *_, **__: sift):
        return [0.0, 0.0] in pairs.sift_matches(NONE, NONE)[0].tolist()


def _ray_agrees(off_mrad: float) -> bool:
    """Whether the pose of a pair counts a match among those that agree, whose ray of the right camera
    is off across the rows.
    """
    pairs = _needing_colmap("vio.offline.colmap.pairs")
    rng = np.random.default_rng(0)
    p = rng.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 4.0], (200, 3))
    p[0] = [0.1, 0.0, 3.0]
    rays = [q / q[:, 2:] for q in (p, p - [0.5, 0.0, 0.0])]
    rays[1][0, 1] += 1e-3 * off_mrad
    unit = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays]
    estimate = pairs.pycolmap.estimate_essential_matrix
    found: list[Any] = []

    def kept(*args: Any) -> Any:
        found.append(estimate(*args))
        return found[-1]

    with patch.object(pairs.pycolmap, "estimate_essential_matrix", kept):
        pairs.relative_pose(RayMatches(np.zeros(200, np.int64), *unit))
    return int(found[0]["num_inliers"]) == 200


def _is_model(poses: int) -> bool:
    """Whether a model of so many keyframes is one."""
    reconstruction = _needing_colmap("vio.offline.colmap.reconstruction")
    T = [(k, np.eye(4)) for k in range(poses)]
    names = _needing_colmap("vio.offline.colmap.model").numbered_images(9)
    mapping = {0: MagicMock()}
    with (
        patch.object(reconstruction, "pycolmap") as pycolmap,
        patch.object(reconstruction, "_poses", lambda model, names: T),
        patch.object(reconstruction, "_global_options"),
        patch.object(
            reconstruction, "_common_points", lambda *_: np.zeros((poses, poses), np.int64)
        ),
        patch.object(reconstruction, "mean_reprojection_error_px", lambda model: 0.0),
        patch.object(reconstruction, "Reconstructed"),
    ):
        pycolmap.global_mapping.return_value = mapping
        none = np.zeros((0, 2), np.int64)
        done = reconstruction.reconstruct(
            Path("a"), Path("b"), names, "global", MagicMock(), none, threads=1
        )
    return done is not None


@contextmanager
def _unchanged_model(adjustment: Any, tracks: PointTracks) -> Iterator[None]:
    """An adjustment that leaves all as it is, of pixels with a standard deviation of 1."""
    with (
        patch.object(adjustment, "_solve", lambda camera, T, kept, *_, **__: (T, kept.p_world)),
        patch.object(adjustment, "_sigma_px", lambda *_: 1.0),
    ):
        yield


def _row_is_kept(off_px: float) -> bool:
    adjustment = _needing_colmap("vio.offline.colmap.adjustment")
    tracks = _tracks(np.array([[0.1, 0.0, 3.0], [0.2, 0.0, 3.0]]), 3)
    tracks.z[0, 0] += off_px
    T = np.tile(np.eye(4), (3, 1, 1))
    with _unchanged_model(adjustment, tracks):
        return adjustment.adjust(CAMERA, T, tracks).rows_dropped == 0


def _interop_centre_px() -> float:
    pytest.importorskip("pycolmap", exc_type=ImportError)
    return float(pycolmap.to_camera(LENS).params[2])


def _rerun_centre_px() -> float:
    pytest.importorskip("rerun", exc_type=ImportError)
    camera = StereoCamera(400.0, 400.0, 319.5, 239.5, 0.1, 640, 480)
    columns = rerun.to_pinhole(camera).image_from_camera.as_arrow_array().to_pylist()[0]
    return float(columns[6])


LIMITS: dict[str, tuple[Says, float, float]] = {
    "motion: length": (lambda n: _pieces(400)[0].frames < n, 37, 38),
    "motion: pieces": (lambda n: len(_pieces(400)) < n, 6, 7),
    "motion: keyframes": (lambda n: len(_pieces(400)[0].T_world_cam0) < n, 20, 21),
    "motion: gate": (lambda x: bool(_pieces(400)[0].tracks < x), 7.5, 8.5),
    "motion: rounds": (lambda n: _rounds(1.0) < n, 5, 6),
    "motion: settled": (lambda x: _rounds(x) > 1, 0.045, 0.055),
    "motion: frames of a pair": (lambda n: _frames_matched(2) < n, 10, 11),
    "motion: turned": (lambda x: not _is_measured_again(x), 14.0, 16.0),
    "motion: rows": (_rows_are_at_fault, 1.9, 2.1),
    "check: logarithms": (lambda x: _drawn(x)[0], 28.0, 32.0),
    "check: margin": (lambda x: not _drawn(beside=x)[1], 0.14, 0.16),
    "check: turn is named": (_names_turn, 0.95, 1.05),
    "check: turn counts": (lambda x: not _turn_is_negligible(x), 0.19, 0.21),
    "map: keyframes": (lambda n: _is_of_map(int(n)), 2, 3),
    "keyframes: features": (lambda n: _may_be_keyframe(int(n)), 9, 10),
    "keyframes: stretch": (lambda n: _stretch_counts(int(n)), 19, 20),
    "points: ahead": (_is_ahead, 0.045, 0.055),
    "points: views": (lambda n: _is_point(int(n)), 1, 2),
    "refined: rows": (lambda n: _is_aligned(int(n)), 5, 6),
    "refined: steps": (lambda n: _last_step() < n, 4, 5),
    "IMU: first width": (lambda x: _widths()[0] < x * _widths()[-1], 3.9, 4.1),
    "IMU: width": (lambda x: _widths()[-1] < x, 2.9, 3.1),
    "IMU: steps": (lambda n: len(_widths()) < n, 9, 10),
    "IMU: cells": (lambda x: not _shares_errors(x), 0.95, 1.05),
    "IMU: tracks": (lambda x: _row_sigma() < x, 1.9, 2.1),
    "IMU: map": (lambda x: not _map_is_moved(x), 2.9, 3.1),
    "rig: across": (lambda n: _regions(int(n), 1) < n, 8, 9),
    "rig: down": (lambda n: _regions(1, int(n)) < n, 4, 5),
    "rig: taken": (lambda x: _enlarged() < x, 19.0, 21.0),
    "COLMAP: centre": (lambda x: _centre_px() < x, 319.9, 320.1),
    "COLMAP: level": (lambda x: _level_of_points() < x, 120.0, 136.0),
    "COLMAP: features": (lambda n: _sift_features() < n, 1450, 1550),
    "COLMAP: second best": (lambda x: not _sift_pairs(x), 0.78, 0.82),
    "COLMAP: rays": (lambda x: not _ray_agrees(x), 2.7, 2.95),
    "COLMAP: keyframes": (lambda n: _is_model(int(n)), 2, 3),
    "COLMAP: outlier": (lambda x: not _row_is_kept(x), 4.8, 5.2),
    "Rerun: centre": (lambda x: _rerun_centre_px() < x, 319.9, 320.1),
    "COLMAP: exchange": (lambda x: _interop_centre_px() < x, 319.9, 320.1),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_refinement(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


def test_images_of_a_model_have_different_numbers_from_one_on() -> None:
    model = _needing_colmap("vio.offline.colmap.model")
    ids = [model.image_id(k, camera) for k in range(3) for camera in (model.LEFT, model.RIGHT)]
    assert len(set(ids)) == len(ids)
    assert min(ids) > 0


def test_cameras_of_a_rig_of_colmap_have_the_numbers_that_are_stated() -> None:
    pytest.importorskip("pycolmap", exc_type=ImportError)
    T = np.eye(4)
    T[0, 3] = -0.1
    _, cameras = pycolmap.to_rig(Rig(LENS, LENS, T))
    assert [camera.camera_id for camera in cameras] == [1, 2]
