"""Bundle adjustment with the calibration free, against exact tracks of rigs that are off by
known amounts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vio.calibration.findings import NotObservable
from vio.calibration.intrinsics import Intrinsics, judge_intrinsics, judged_observable
from vio.errors import EstimationError
from vio.geometry.lie import (
    FloatArray,
    se3_from_parts,
    se3_inverse,
    so3_exp,
    so3_log,
    transform_points,
)
from vio.geometry.stereo import StereoCamera, project
from vio.offline.points import PointTracks
from vio.offline.self_calibration import (
    NAMES,
    Segment,
    SelfCalibration,
    _as_before_the_fit,
    _derivatives,
    _larger,
    intrinsics_of,
    project_off,
    self_calibrate,
)

CAMERA = StereoCamera(460.0, 458.0, 370.0, 240.0, 0.11, 752, 480)
KEYFRAMES, POINTS, NOISE_PX = 12, 250, 0.15


def _off(**values: float) -> FloatArray:
    return np.array([values.get(name, 0.0) for name in NAMES])


def _poses(turning: float) -> FloatArray:
    """Left cameras `T_world_cam0` (K, 4, 4) that move ahead and aside, and turn about all axes
    by up to an angle.
    """
    s = np.linspace(0, 1, KEYFRAMES)
    turns = turning * np.stack(
        [np.sin(5 * s), np.sin(4 * s + 1) - np.sin(1), 0.5 * np.sin(6 * s)], axis=1
    )
    places = np.stack([0.6 * np.sin(3 * s), 0.2 * s, 1.5 * s], axis=1)
    return np.array([se3_from_parts(so3_exp(w), t) for w, t in zip(turns, places, strict=True)])


def _segment(x: FloatArray, turning: float, seed: int = 0) -> Segment:
    """Noisy rows of a pair that is off by parameters (18,), with poses and points as the given
    calibration has them.
    """
    rng = np.random.default_rng(seed)
    T = _poses(turning)
    p = rng.uniform([-1.2, -0.8, 3.0], [1.2, 0.8, 12.0], (POINTS, 3)) * [1, 1, 1]
    p[:, :2] *= p[:, 2:] / 2
    point, keyframe, z = [], [], []
    for k, T_world_cam0 in enumerate(T):
        q = transform_points(se3_inverse(T_world_cam0), p)
        q = np.where((q[:, 2] > 1.0)[:, None], q, [0.0, 0.0, -1.0])
        seen = project_off(CAMERA, x, np.where(q[:, 2:] > 0, q, [0.0, 0.0, 1.0]))
        good = (
            (q[:, 2] > 0)
            & (np.abs(seen[:, ::2] - 376) < 376).all(axis=1)
            & (np.abs(seen[:, 1] - 240) < 240)
        )
        ids = np.flatnonzero(good)
        point.append(ids)
        keyframe.append(np.full(len(ids), k))
        z.append(seen[ids] + rng.normal(0, NOISE_PX, (len(ids), 4)))
    everything = np.concatenate(point)
    used = np.flatnonzero(np.bincount(everything, minlength=POINTS) > 2)
    rows = np.isin(everything, used)
    tracks = PointTracks(
        used,
        p[used],
        np.searchsorted(used, everything[rows]),
        np.concatenate(keyframe)[rows],
        np.concatenate(z)[rows],
        np.ones(int(rows.sum()), dtype=np.bool_),
    )
    return Segment(T, tracks, frames=36)


def _found(x: FloatArray, turning: float = 0.3, *, intrinsics: bool = False) -> SelfCalibration:
    return self_calibrate(CAMERA, [_segment(x, turning)], intrinsics=intrinsics)


def test_a_pair_that_is_right_projects_as_the_rectified_camera() -> None:
    p = np.array([[0.3, -0.2, 4.0], [-1.0, 0.5, 9.0]])
    np.testing.assert_allclose(project_off(CAMERA, np.zeros(18), p), project(CAMERA, p))


def test_turn_and_lenses_of_the_right_camera_are_found_with_their_uncertainty() -> None:
    """Half a degree about each axis and 2e-3 of tangential distortion at once."""
    turn = np.radians([0.4, -0.5, 0.3])
    x = _off(wx=turn[0], wy=turn[1], wz=turn[2], p2=2e-3, k=3e-3)
    found = _found(x)
    errors = (found.values - x) / np.maximum(found.sigmas, 1e-12)
    free = [k for k, name in enumerate(NAMES) if name not in ("focal", "aspect", "cu", "cv")]
    assert np.all(np.abs(errors[free]) < 3.5)
    assert np.sqrt(np.mean(errors[free] ** 2)) < 1.6, "consistent"
    assert found.sigmas[NAMES.index("wy")] < np.radians(0.2)
    R, direction, rotation_deg, direction_deg = found.right_camera()
    assert np.degrees(np.linalg.norm(so3_log(R @ so3_exp(turn).T))) < 3 * rotation_deg < 0.15
    assert np.degrees(np.arccos(direction[0])) < 3 * direction_deg
    assert found.residual_px == pytest.approx(NOISE_PX, rel=0.15)


@pytest.mark.parametrize("focal", [0.0, -0.05, 0.05])
def test_a_wrong_focal_length_is_named_and_a_right_one_is_not(focal: float) -> None:
    found = intrinsics_of(CAMERA, _found(_off(focal=focal), intrinsics=True))
    assert found.focal_off == pytest.approx(focal, abs=0.01)
    assert [f.fault for f in judge_intrinsics(found)] == (["focal length wrong"] if focal else [])
    if focal:
        assert f"{460 * (1 + found.focal_off):.0f} px in place of 460" in str(
            judge_intrinsics(found)[0]
        )


def test_a_wrong_principal_point_is_named() -> None:
    found = intrinsics_of(CAMERA, _found(_off(cu=0.09), intrinsics=True))
    assert [f.fault for f in judge_intrinsics(found)] == ["principal point wrong"]


def test_a_camera_that_does_not_turn_tells_nothing_of_its_focal_length() -> None:
    """The scene is stretched by as much as the focal length is off."""
    found = intrinsics_of(CAMERA, _found(_off(focal=0.05), turning=0.0, intrinsics=True))
    assert isinstance(found, NotObservable)
    assert "turn too little" in str(found)
    assert judge_intrinsics(found) == ()


def test_uncertainty_that_lens_models_leave_is_in_the_verdict() -> None:
    """Exact estimates of real lenses are a per cent off: 3 % is no fault, 4 % is."""
    for off, faults in ((0.03, 0), (0.04, 1)):
        found = judged_observable(CAMERA, off, 1e-4, (0.0, 0.0), (1e-4, 1e-4))
        assert isinstance(found, Intrinsics)
        assert len(judge_intrinsics(found)) == faults


def test_rows_of_a_region_share_their_error() -> None:
    """An error that all rows of each region share counts once a region, not once a row."""
    segment = _segment(_off(), 0.3)
    alone = self_calibrate(CAMERA, [segment], intrinsics=False)
    cell = (segment.tracks.z[:, 0] // 94 + 8 * (segment.tracks.z[:, 1] // 120)).astype(int)
    shared = np.random.default_rng(3).normal(0, 0.3, 32)[cell]
    z = segment.tracks.z + np.outer(shared, [0.0, 0.0, 1.0, 0.0])
    off = self_calibrate(
        CAMERA, [replace(segment, tracks=replace(segment.tracks, z=z))], intrinsics=False
    )
    k = NAMES.index("right_fu")
    assert off.sigmas[k] > 2 * alone.sigmas[k]
    assert abs(off.values[k]) < 3.5 * off.sigmas[k]


def test_the_larger_of_two_matrices_is_not_smaller_than_either() -> None:
    rng = np.random.default_rng(0)
    A, B = (m @ m.T for m in rng.normal(size=(2, 5, 5)))
    both = _larger(A, B)
    for one in (A, B):
        assert np.linalg.eigvalsh(both - one)[0] > -1e-9 * np.trace(both)
    np.testing.assert_allclose(_larger(A, 3 * A), 3 * A)


def test_what_is_no_rigid_scene_is_refused() -> None:
    segment = _segment(_off(), 0.3)
    z = segment.tracks.z + np.random.default_rng(0).normal(0, 20, segment.tracks.z.shape)
    with pytest.raises(EstimationError, match=r"disagree by|no track"):
        self_calibrate(
            CAMERA, [replace(segment, tracks=replace(segment.tracks, z=z))], intrinsics=False
        )
    empty = replace(segment.tracks, ids=np.zeros(0, dtype=np.int64))
    with pytest.raises(EstimationError, match="no track is consistent"):
        self_calibrate(CAMERA, [replace(segment, tracks=empty)], intrinsics=False)


def test_derivatives_are_those_of_the_projection() -> None:
    rng = np.random.default_rng(4)
    x = 0.03 * rng.normal(size=len(NAMES))
    q = rng.uniform([-3, -2, 2], [3, 2, 12], (40, 3))
    J_q, J_x = _derivatives(CAMERA, x, q)
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        numeric = (project_off(CAMERA, x, q + step) - project_off(CAMERA, x, q - step)) / 2e-6
        np.testing.assert_allclose(J_q[:, :, k], numeric, rtol=1e-6, atol=1e-4)
    for k, name in enumerate(NAMES):
        step = 1e-6 * np.eye(len(NAMES))[k]
        numeric = (project_off(CAMERA, x + step, q) - project_off(CAMERA, x - step, q)) / 2e-6
        np.testing.assert_allclose(J_x[:, :, k], numeric, rtol=1e-6, atol=1e-4, err_msg=name)


def test_scores_before_the_fit_give_the_scatter_of_fits_without_a_region() -> None:
    """What the parameters take of a region's error is not in the scatter that is left: standard
    deviations of few regions were too small by a quarter to a half.
    """
    rng = np.random.default_rng(0)
    J = rng.normal(0, 1, (6, 5, 3))  # 6 regions of 5 rows, 3 parameters
    J[0] *= 3
    y = J @ [1.0, -2.0, 0.5] + rng.normal(0, 1, (6, 1)) + rng.normal(0, 0.2, (6, 5))

    def fit(regions: list[int]) -> FloatArray:
        found, *_ = np.linalg.lstsq(J[regions].reshape(-1, 3), y[regions].ravel(), rcond=None)
        return np.asarray(found)

    whole = fit(list(range(6)))
    information = np.swapaxes(J, 1, 2) @ J
    A = information.sum(axis=0)
    scores = np.einsum("gri,gr->gi", J, y - J @ whole)
    enlarged = _as_before_the_fit(scores, information, A)
    without = [fit([k for k in range(6) if k != region]) for region in range(6)]
    np.testing.assert_allclose(np.linalg.solve(A, enlarged.T).T, whole - without, atol=1e-10)


def test_a_short_piece_leaves_more_to_lens_models() -> None:
    whole = self_calibrate(CAMERA, [_segment(_off(), 0.3)], intrinsics=False)
    short = replace(whole, frames=9)
    assert whole.lens_deg == pytest.approx(0.01)
    assert short.lens_deg == pytest.approx(0.04)
    assert short.right_camera()[2] > whole.right_camera()[2]
    assert short.disparity_off(CAMERA, 20.0)[1] > whole.disparity_off(CAMERA, 20.0)[1]
