"""Each limit of what is done after a run, and of surfaces, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from tests.offline.test_limits import _run
from vio.dense import preview
from vio.dense.occupancy import occupancy_grid
from vio.dense.stereo_depth import StereoMatcher, depth_sigma_m
from vio.dense.surface import Mesh
from vio.errors import EstimationError
from vio.files.meshes import OCCUPIED
from vio.geometry.lie import FloatArray, se3_exp
from vio.geometry.stereo import StereoCamera
from vio.offline import refine, self_calibration, verdict
from vio.offline.check import expected_minutes
from vio.offline.colmap.model import ModelImages
from vio.offline.comparison import _expected_end, _longest_piece
from vio.offline.georeference import _is_one_path
from vio.offline.inertial_refinement import inertial_keyframes
from vio.offline.keyframes import choose_keyframes, loop_ends, tracked_segments

Says = Callable[[float], bool]
CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)


def _breaks(poses: int) -> bool:
    """Whether a jump between so many poses makes two pieces."""
    own = np.tile(np.eye(4), (poses, 1, 1))
    own[:, 0, 3] = 0.1 * np.arange(poses)
    other = own.copy()
    other[3:, 1, 3] += 5.0
    return not _longest_piece(own, other, np.ones(poses - 1, np.bool_))[0].all()


def _end(sigma_m: float = 0.0, sigma_deg: float = 0.0, path_m: float = 0.0) -> tuple[float, float]:
    run: Any = SimpleNamespace(sigmas=np.array([[0.0, 0.0], [sigma_m, sigma_deg]]))
    return _expected_end(run, np.array([0, 1]), path_m)


def _least_share() -> float:
    """Of the keyframes that are allowed, how many a long run has at least."""
    run = _run(0.1, 400, kept=1.0)

    def after(T: FloatArray, step_m: float, turn_deg: float) -> list[int]:
        return [*range(int(2000 / turn_deg)), len(T) - 1]

    with patch("vio.offline.keyframes.after_motion", after):
        return min(len(choose_keyframes(run, most=k)) / k for k in range(50, 300, 10))


def _all_loops(most: int) -> bool:
    loops = tuple(SimpleNamespace(frame=20 + k, keyframe_frame=k) for k in range(10))
    run: Any = SimpleNamespace(loops=loops, frames=np.arange(100))
    with patch(
        "vio.offline.keyframes.loop_pairs", lambda loops, frames: np.arange(20).reshape(10, 2)
    ):
        return len(loop_ends(run, most)) == 20


def _is_piece(frames: int) -> bool:
    motion: Any = SimpleNamespace(
        frames=np.arange(frames),
        times_ns=10**8 * np.arange(frames + 1),
        twists=np.zeros((frames, 6)),
    )
    tracks: Any = None
    return bool(tracked_segments(Path("a"), CAMERA, tracks, motion, longest=100, most=3))


def _steps_s() -> float:
    """From keyframe to keyframe of an adjustment with an IMU."""
    path: Any = SimpleNamespace(loops=(), frames=np.arange(401))
    with patch("vio.offline.inertial_refinement._seconds", lambda path: 0.025 * np.arange(401)):
        return float(np.median(np.diff(inertial_keyframes(path, None)))) * 0.025


def _is_one(off_m: float, step_m: float = 0.0) -> bool:
    """Whether two paths are of one map, whose motions differ."""
    before = np.array([se3_exp([step_m * k, 0, 0, 0, 0, 0]) for k in range(9)])
    now = np.array([se3_exp([(step_m + off_m) * k, 0, 0, 0, 0, 0]) for k in range(9)])
    return _is_one_path(before, now)


def _warns(sigmas: float) -> bool:
    path: Any = SimpleNamespace(sigmas=np.full((5, 2), 0.1))
    with patch.object(refine, "log") as log:
        refine._warn_of_distance(path, 0.1 * sigmas)
    return bool(log.warning.called)


def _names_length(off: float) -> bool:
    """Whether another length of COLMAP's path is named."""
    comparison: Any = SimpleNamespace(
        segments=(),
        scale=1.0 + off,
        scale_sigma=0.0,
        ate_m=0.1,
        aligned=np.tile(np.eye(4), (3, 1, 1)),
        piece=np.ones(3, np.bool_),
    )
    return "COLMAP's path is" in verdict._judged({"global": comparison}, ["global"])


def _minutes_of_measured(mappers: int) -> float:
    """Against those measured of 30 keyframes."""
    names: Any = ["incremental", "global"][:mappers]
    measured_s = 30 * (1.8 + sum([1.0, 0.7][:mappers]))
    return expected_minutes(30, names) / (measured_s / 60)


# COLMAP


def _reconstruction() -> Any:
    return pytest.importorskip("vio.offline.colmap.reconstruction", exc_type=ImportError)


def _is_matched_with(count: int, first: str, second: str) -> bool:
    """Whether images of a rig's keyframes are matched; one loop joins keyframes 10 and 100."""
    names = ModelImages(tuple(f"l{k}" for k in range(count)), tuple(f"r{k}" for k in range(count)))
    pairs = _reconstruction().pairs_to_match(names, np.array([[10, 100]]))
    return (first, second) in pairs


def _is_linked(apart: int = 1, points: int = 100) -> bool:
    shared = np.full((2, 2), points)
    return bool(_reconstruction().linked_steps(shared, np.array([0, apart]))[0])


# Self-calibration


def _known(frames: int = 36) -> self_calibration.SelfCalibration:
    """A calibration by so many frames that is known but for what lens models leave."""
    size = len(self_calibration.NAMES)
    none = np.zeros(size)
    return self_calibration.SelfCalibration(none, none, np.zeros((size, size)), 1, 9, 0.1, frames)


def _disparity_sigma_deg() -> float:
    sigma = _known().disparity_off(CAMERA, 10.0)[1]
    return float(np.degrees(sigma / CAMERA.fu))


def _is_observable(residual_px: float) -> bool:
    segment: Any = SimpleNamespace(tracks=SimpleNamespace(ids=[1]))
    with (
        patch.object(self_calibration, "_optimum", lambda camera, x, pieces, width: (x, pieces)),
        patch.object(self_calibration, "_spread", lambda *_: residual_px),
        patch.object(self_calibration, "_without_outliers", lambda camera, x, piece, sigma: piece),
        patch.object(self_calibration, "_with_covariance", lambda *_: None),
    ):
        try:
            self_calibration.self_calibrate(CAMERA, [segment], intrinsics=False)
        except EstimationError:
            return False
    return True


def _counts(sigmas: float) -> float:
    """What a residual adds to the cost for its square, over a small one."""

    def cost(r: float) -> float:
        rows = (np.full((1, 4), r),)
        piece: Any = None
        with patch.object(self_calibration, "_residuals", lambda *_: rows):
            return self_calibration._cost(CAMERA, 1.0, np.ones(18), (np.zeros(18), [piece]))

    step = 1e-3
    slope = (cost(sigmas + step) - cost(sigmas)) / ((sigmas + step) ** 2 - sigmas**2)
    return float(slope / (cost(step) / step**2))


def _is_kept(sigmas: float) -> bool:
    rows = (np.array([[sigmas, 0.0, 0.0, 0.0]]),) * 3
    kept: list[Any] = []
    piece: Any = SimpleNamespace(tracks=None)
    with (
        patch.object(self_calibration, "_residuals", lambda *_: rows),
        patch.object(
            self_calibration,
            "keep_rows",
            lambda tracks, good: kept.append(good) or SimpleNamespace(ids=[]),
        ),
    ):
        self_calibration._without_outliers(CAMERA, np.zeros(18), piece, 1.0)
    return bool(kept[0].any())


# Surfaces


def _picture_of_points() -> np.ndarray[Any, Any]:
    points = np.random.default_rng(0).normal(size=(500, 3))
    return preview._splat(points, np.zeros((500, 3)), np.full(500, 0.01), 1)


def _looks_down_deg() -> float:
    return float(np.degrees(np.arcsin(-preview._view(np.array([0.0, 1.0]))[2, 2])))


def _looks_aside_deg() -> float:
    """Of a path that leads ahead."""
    right = preview._view(np.array([0.0, 1.0]))[0]
    return float(np.degrees(np.arccos(right[0])))


def test_a_picture_of_a_surface_has_the_size_that_is_stated() -> None:
    image = _picture_of_points()
    assert str(image.shape) in str(preview.preview.__doc__)
    assert image.max() > 230


def _plan(points: FloatArray) -> FloatArray:
    none = np.zeros((0, 3))
    mesh = Mesh(
        points.astype(np.float32),
        none.astype(np.float32),
        none.astype(np.uint8),
        none.astype(np.uint32),
    )
    grid = occupancy_grid(mesh, np.eye(3), 0.05)
    assert grid is not None
    return np.asarray(grid.levels == OCCUPIED)


def _floor(width_m: float = 4.0) -> FloatArray:
    at = np.arange(0.025, width_m, 0.05)
    x, y = np.meshgrid(at, at[:40])
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def _is_obstacle(height_m: float, vertices: int = 5) -> bool:
    thing = np.tile([2.05, 1.05, height_m], (vertices, 1))
    return bool(_plan(np.concatenate([_floor(), thing])).any())


def _edge_m() -> float:
    """How much of a platform beside the ground is called an obstacle, from its edge on."""
    points = _floor(8.0)
    points[points[:, 0] > 4.0, 2] = 0.5
    return float(_plan(points).any(axis=0).sum()) * 0.1


def _is_matched(disparity_px: int) -> bool:
    rng = np.random.default_rng(0)
    wide = rng.integers(0, 255, (60, 640 + disparity_px), dtype=np.uint8)
    depth = StereoMatcher(CAMERA, 640).depth(wide[:, :640], wide[:, disparity_px:])
    expected = CAMERA.fu * CAMERA.baseline_m / disparity_px
    return bool(abs(np.median(depth[20:40, 200:600]) - expected) < 0.05 * expected)


LIMITS: dict[str, tuple[Says, float, float]] = {
    "check: motions": (lambda n: _breaks(int(n)), 7, 8),
    "check: sigmas": (lambda x: _end(1.0)[0] < x, 2.8, 3.2),
    "check: turn": (lambda x: _end()[1] < x, 0.45, 0.55),
    "check: turn of a path": (lambda x: _end(path_m=100.0)[1] - _end()[1] < x, 0.9, 1.1),
    "check: length": (_names_length, 0.009, 0.011),
    "check: time": (lambda x: _minutes_of_measured(1) < x, 1.0, 1.15),
    "check: time of two": (lambda x: _minutes_of_measured(2) < x, 1.03, 1.25),
    "keyframes: share": (lambda x: _least_share() < x, 0.8, 1.01),
    "keyframes: loops": (lambda n: _all_loops(int(n)), 59, 60),
    "keyframes: piece": (lambda n: _is_piece(int(n)), 4, 5),
    "keyframes: with an IMU": (lambda x: _steps_s() < x, 0.24, 0.26),
    "map: motion": (lambda x: not _is_one(x), 0.045, 0.055),
    "map: share of a motion": (lambda x: not _is_one(x, 10.0), 1.0, 1.1),
    "refined: apart": (_warns, 2.8, 3.2),
    "COLMAP: all": (lambda n: not _is_matched_with(int(n), "l0", f"l{int(n) - 1}"), 60, 61),
    "COLMAP: next": (lambda n: not _is_matched_with(200, "l0", f"l{int(n)}"), 16, 17),
    "COLMAP: across": (lambda n: not _is_matched_with(200, "r0", f"l{int(n)}"), 1, 2),
    "COLMAP: loops": (
        lambda n: not _is_matched_with(200, f"l{10 + int(n)}", f"l{100 - int(n)}"),
        1,
        2,
    ),
    "COLMAP: linked": (lambda n: not _is_linked(int(n)), 6, 7),
    "COLMAP: shared": (lambda n: _is_linked(points=int(n)), 14, 15),
    "rig: lens": (lambda x: _disparity_sigma_deg() < x, 0.009, 0.011),
    "rig: lens of few frames": (lambda n: _known(int(n)).lens_deg > _known(36).lens_deg, 36, 35),
    "rig: direction": (lambda x: _known().right_camera()[3] < x, 0.28, 0.32),
    "rig: residual": (lambda x: not _is_observable(x), 1.4, 1.6),
    "rig: half": (lambda x: _counts(x) < 0.5, 1.9, 2.1),
    "rig: outlier": (lambda x: not _is_kept(x), 4.8, 5.2),
    "picture: down": (lambda x: _looks_down_deg() < x, 36.0, 44.0),
    "picture: aside": (lambda x: _looks_aside_deg() < x, 55.0, 65.0),
    "plan: step": (_is_obstacle, 0.18, 0.22),
    "plan: clearance": (lambda x: not _is_obstacle(x), 1.9, 2.1),
    "plan: vertices": (lambda n: _is_obstacle(1.0, int(n)), 1, 2),
    "plan: ground": (lambda x: _edge_m() < x, 1.35, 1.75),
    "depth: sigma": (lambda x: depth_sigma_m(CAMERA, 1.0) * 40.0 < x, 0.23, 0.27),
    "depth: nearest": (lambda n: not _is_matched(int(n)), 70, 90),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_after_a_run(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
