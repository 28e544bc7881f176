"""Each limit of the fits behind a calibration's verdicts, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.calibration.test_limits import _matches
from tests.calibration.test_pair_rotation import CAMERA as RIG
from tests.calibration.test_pair_rotation import MOVED, points, seen
from tests.guard.test_matches import CAMERA
from vio.calibration import egomotion, gyro, lever_arm, readings, stereo, stereo_field
from vio.calibration.egomotion import CameraMotion, camera_motion, stereo_twists
from vio.calibration.findings import NotObservable
from vio.calibration.inertial import ImuAlignment, Rates
from vio.calibration.intrinsics import Intrinsics, judge_intrinsics, judged_observable
from vio.calibration.lever_arm import LeverArm, estimate_lever_arm, judge_lever_arms
from vio.calibration.pair_rotation import (
    is_turned_by_rows,
    rotation_by_motion,
    rotation_by_rows,
)
from vio.calibration.stereo_field import disparity_off
from vio.cameras.rectification_error import error_basis, vertical_disparity_terms
from vio.cameras.rig import Rig
from vio.errors import CalibrationError
from vio.geometry.lie import FloatArray, se3_exp, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.records import (
    FIELD_TERMS,
    ROW_TERMS,
    FeatureTracks,
    StereoFieldEstimate,
    imu_matrices,
)

Says = Callable[[float], bool]
NONE: Any = None


# The gyro


class _Problem:
    """A fit of given uncertainty."""

    rotation_deg = 0.0

    def __init__(self, *_: object) -> None:
        self.covered = np.ones(100, np.bool_)

    def coarse_offset(self) -> float:
        return 0.0

    def start(self, offset: float) -> FloatArray:
        return np.zeros(7)

    def fit(self, x: FloatArray, keep: object) -> FloatArray:
        return x

    def spread(self, x: FloatArray, keep: object) -> float:
        return 1e-6

    def formal_sigma(self, *_: object) -> FloatArray:
        return np.array([np.radians(self.rotation_deg), *[1e-6] * 6])


def _alignment(rate: float = 1.0, rotation_deg: float = 0.0) -> ImuAlignment | NotObservable:
    """The alignment of a camera that turns to and fro."""
    twists = np.zeros((100, 6))
    twists[:, 5] = rate * (-1.0) ** np.arange(100)
    motion: Any = SimpleNamespace(twists=twists)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gyro, "_GyroProblem", _Problem)
        patch.setattr(_Problem, "rotation_deg", rotation_deg)
        return gyro.align_gyro(motion, NONE)


def _is_weak(deg: float) -> bool:
    found = _alignment(rotation_deg=deg)
    assert isinstance(found, ImuAlignment)
    return found.weak is not None


def _swing(t: FloatArray) -> FloatArray:
    """An angle that turns to and fro ever faster."""
    return np.sin(3.0 * t + 0.4 * t**2)


def _problem(late_s: float = 0.0, inertial: bool = True) -> Any:
    """A gyro whose stamps are late, beside a camera that turns with it."""
    times = np.linspace(-1.0, 7.0, 1601)
    angular = np.zeros((1601, 3))
    angular[:, 2] = np.gradient(_swing(times - late_s), times)
    frames_s = 0.05 * np.arange(121)
    twists = np.zeros((120, 6))
    twists[:, 5] = np.diff(_swing(frames_s)) / 0.05
    motion = CameraMotion((1e9 * frames_s).astype(np.int64), np.arange(120), twists)
    rates = Rates((1e9 * times).astype(np.int64), angular, np.zeros((1601, 3)), inertial)
    return gyro._GyroProblem(motion, rates)


def _finds_offset(late_s: float) -> bool:
    return abs(_problem(late_s).coarse_offset() - late_s) < 0.006


def _velocity_counts() -> float:
    """Which rate off counts as much as a velocity that is off by 1 m/s."""
    problem = _problem(inertial=False)
    v_cam, v_imu = problem._velocities
    problem._velocities = v_cam + 1.0, v_imu
    return float(problem.residuals(np.zeros(7))[0, 3])


GYRO: dict[str, tuple[Says, float, float]] = {
    "rotates": (lambda x: isinstance(_alignment(x), ImuAlignment), 0.017, 0.023),
    "weak": (_is_weak, 0.87, 1.13),
    "offset": (lambda x: not _finds_offset(x), 0.09, 0.115),
    "velocities": (lambda x: _velocity_counts() < x, 0.017, 0.023),
}


# Focal length and principal point


def _intrinsics(
    focal: float = 0.0, sigma: float = 0.0, centre: float = 0.0, across: float = 0.0
) -> list[str] | None:
    """What is said of intrinsics that are off; None: they are not observable."""
    found = judged_observable(CAMERA, focal, sigma, (centre, 0.0), (across, across))
    if isinstance(found, NotObservable):
        return None
    return [finding.fault for finding in judge_intrinsics(found)]


def test_a_principal_point_is_off_in_rows_by_their_focal_length() -> None:
    """Of pixels that are not square, each axis has its own."""
    camera = StereoCamera(500.0, 250.0, 320.0, 120.0, 0.1, 640, 240)
    found = judged_observable(camera, 0.0, 1e-3, (0.1, 0.1), (1e-3, 1e-3))
    assert isinstance(found, Intrinsics)
    np.testing.assert_allclose(found.centre_off_px, (50.0, 25.0))
    assert found.centre_sigma_px[0] == pytest.approx(2 * found.centre_sigma_px[1])


INTRINSICS: dict[str, tuple[Says, float, float]] = {
    # three times 1.2 %, and three times the hypotenuse with 2.5 %
    "focal length": (lambda x: _intrinsics(x) != [], 0.031, 0.041),
    "focal length: sigmas": (lambda x: _intrinsics(x, 0.025) != [], 0.078, 0.088),
    "focal length: known": (lambda x: _intrinsics(sigma=x) is None, 0.024, 0.031),
    "centre": (lambda x: _intrinsics(centre=x) != [], 0.053, 0.068),
    "centre: known": (lambda x: _intrinsics(across=x) is None, 0.041, 0.051),
}


# The lever arm


def _arm(windows: int = 20, sigma_m: float = 1e-3) -> bool:
    """Whether a lever arm is known by so many windows, which scatter it."""
    values = iter([0.0, *[sigma_m / 3.0, -sigma_m / 3.0] * 5])
    rates: Any = SimpleNamespace(inertial=True)
    alignment: Any = SimpleNamespace(weak=None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lever_arm, "_windows", lambda *_: list(range(windows)))
        patch.setattr(lever_arm, "_solve_windows", lambda _: np.full(6, next(values)))
        return isinstance(estimate_lever_arm(NONE, rates, alignment), LeverArm)


def _windows(seconds: float) -> int:
    """Windows of an uninterrupted motion of so many seconds, over 0.8 of one each."""
    count = round(10 * seconds)
    times = (1e8 * np.arange(count + 1)).astype(np.int64)
    motion = CameraMotion(times, np.arange(count), np.zeros((count, 6)))
    stamps = (5e6 * np.arange(-20, 20 * count + 20)).astype(np.int64)
    rates = Rates(stamps, np.zeros((len(stamps), 3)), np.ones((len(stamps), 3)), True)
    alignment: Any = SimpleNamespace(time_offset_s=0.0, gyro_bias=np.zeros(3), R_cam0_imu=np.eye(3))
    return len(lever_arm._windows(motion, rates, alignment))


def _pulled() -> float:
    """By how much outliers, one of five, pull a place beside noise of one."""
    rng = np.random.default_rng(0)
    signal = rng.normal(size=(500, 3))
    y = rng.normal(size=(500, 3))
    y[::5] += 40.0 * np.sign(signal[::5])
    return lever_arm._fit_place(y, signal, np.ones((500, 1)))


def _verdict(intervals: int = 60, place: float = 1.0, scatter: float = 0.0) -> Any:
    """The verdict on two lever arms of a camera whose place on the line between them scatters."""
    seen = CameraMotion(NONE, np.arange(intervals), np.ones((intervals, 6)))
    values = iter([place, *[place + scatter, place - scatter] * 6])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lever_arm, "stereo_twists", lambda *_: seen)
        patch.setattr(lever_arm, "_fit_place", lambda *_: next(values))
        return judge_lever_arms(
            CAMERA,
            NONE,
            NONE,
            np.ones((intervals + 1, 6)),
            np.eye(3),
            (np.zeros(3), np.array([0.1, 0.0, 0.0])),
        )


LEVER_ARM: dict[str, tuple[Says, float, float]] = {
    "windows": (lambda n: _arm(int(n)), 11, 12),
    "sigma": (lambda x: not _arm(sigma_m=x), 0.017, 0.023),
    "window": (lambda s: _windows(s) > 1, 1.7, 1.9),
    "outliers": (lambda x: _pulled() < x, 1.0, 2.2),
    "judged: intervals": (lambda n: _verdict(int(n)).better is not None, 39, 40),
    # 2 x over the square of a tenth, and of a scatter: sqrt(11) times it by a jackknife
    "judged: odds": (lambda x: _verdict(place=x).better is not None, 0.042, 0.058),
    "judged: least sigma": (lambda x: _verdict(place=9.0).place_sigma < x, 0.087, 0.113),
}


# Motion between frames


def _tracks(count: int, disparity_px: float = 20.0) -> FeatureTracks:
    """Features of one disparity that two frames show."""
    rng = np.random.default_rng(0)
    depth = CAMERA.fu * CAMERA.baseline_m / disparity_px
    p = np.column_stack([rng.uniform(-0.4, 0.4, (count, 2)) * depth, np.full(count, depth)])
    p[:, 2] *= rng.uniform(0.95, 1.0, count)
    later = transform_points(se3_exp([0.01, 0.0, 0.0, 0.0, 0.002, 0.0]), p)
    z = np.concatenate([project(CAMERA, p), project(CAMERA, later)])
    return FeatureTracks(
        np.array([0, count, 2 * count]),
        np.tile(np.arange(count), 2),
        z,
        np.ones(2 * count, np.bool_),
        np.zeros(2 * count, np.bool_),
    )


def _has_twist(count: int = 40, disparity_px: float = 20.0) -> bool:
    times = np.array([0, 10**8])
    found = stereo_twists(CAMERA, _tracks(count, disparity_px), times, np.zeros((1, 6)))
    return len(found.frames) > 0


def _moves(intervals: int = 60, step_s: float = 0.1) -> bool:
    """Whether a camera's motion is known by so many intervals between frames."""
    times = (1e9 * step_s * np.arange(intervals + 1)).astype(np.int64)
    seen = CameraMotion(times, np.arange(intervals), np.zeros((intervals, 6)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(egomotion, "stereo_twists", lambda *_: seen)
        return isinstance(camera_motion(CAMERA, NONE, times), CameraMotion)


MOTION: dict[str, tuple[Says, float, float]] = {
    "links": (lambda n: _has_twist(int(n)), 7, 8),
    "intervals": (lambda n: _moves(int(n)), 39, 40),
    "interval": (lambda x: not _moves(step_s=x), 0.21, 0.29),
    "disparity": (lambda x: _has_twist(disparity_px=x), 1.7, 2.4),
}


# Pairs


def _pairs(count: int, at: FloatArray | None = None) -> FloatArray:
    z = np.random.default_rng(0).uniform(50.0, 430.0, (count, 4))
    if at is not None:
        z[:, :2] = at
    z[:, 2] = z[:, 0] - (0.0 if at is not None else 20.0)
    z[:, 3] = z[:, 1]
    return z


def _is_near(rows_px: float) -> bool:
    z = _pairs(200)
    z[0, 3] += rows_px
    found = rotation_by_rows(CAMERA, z)
    assert found is not None
    return found.share == 1.0


def _row_sigma_px() -> float:
    """Standard deviation of a row by that of the pitch which 100 exact matches at the centre give."""
    found = rotation_by_rows(CAMERA, _pairs(100, np.array([CAMERA.cu, CAMERA.cv])))
    assert found is not None
    return float(found.sigmas[0]) * CAMERA.fv * 10.0


def _reads(other: float = 0.0, also: float = 9.0) -> str | None:
    """What is said of rows of half a pixel that two other readings leave a share of."""
    found = iter([0.5 * other, 0.5 * also])
    now = SimpleNamespace(rms_px=0.5)
    rig: Any = SimpleNamespace(cam0=SimpleNamespace(width=640, height=480))
    both = [("first", rig, NONE), ("second", rig, NONE)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(readings, "row_residuals", lambda *_: now)
        patch.setattr(readings, "_raw_pixels", lambda *_: [])
        patch.setattr(readings, "_readings", lambda _: both)
        patch.setattr(readings, "_rows_px", lambda *_: next(found))
        reading = readings.other_reading(rig, NONE, NONE)
    return None if reading is None else reading.words


def _in_front(share: float) -> bool:
    rows = SimpleNamespace(rms_px=0.1, positive_disparity=share)
    camera = SimpleNamespace(width=640, height=480)
    rig: Any = SimpleNamespace(cam0=camera, cam1=camera)
    seen = np.zeros((10, 2)), np.ones(10, np.bool_)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(readings, "rectifying_rotations", lambda _: (NONE, NONE))
        patch.setattr(readings, "rectify_pixels", lambda *_: seen)
        patch.setattr(readings, "row_residuals", lambda *_: rows)
        return readings._rows_px(rig, NONE, [np.zeros((10, 2))] * 2) is not None


def _yaw_sigma(moves: bool = False) -> float:
    """Standard deviation of a yaw that a bundle adjustment finds, rad."""
    p = points()
    z = [seen(each, np.zeros(3)) for each in (p, transform_points(MOVED, p) if moves else p)]
    found = rotation_by_motion(RIG, z[0], z[1], np.zeros(3))
    assert found is not None
    return float(found.sigmas[1])


def _is_believed(p2: float) -> bool:
    """Whether a rotation is found of right images with tangential distortion."""
    p = points()
    z = [seen(each, np.zeros(3), p2) for each in (p, transform_points(MOVED, p))]
    return rotation_by_motion(RIG, z[0], z[1], np.zeros(3)) is not None


def _lines(sigmas: float) -> int:
    """Parameters that are named of a rig which is off by so many standard deviations."""
    count = len(stereo_field.PARAMETERS)
    off = np.zeros(count)
    off[stereo_field.PARAMETERS.index("k")] = sigmas
    found: Any = SimpleNamespace(parameters=off, covariance=np.eye(count), scale=None)
    return len(stereo_field.CalibratedRig.lines(found))


def _rig_found(left_px: float) -> bool:
    """Whether a rig is returned that leaves so much of what a run saw."""
    camera: Any = SimpleNamespace(is_cylinder=False)
    estimate: Any = SimpleNamespace(stereo_field=SimpleNamespace(rows_rms_px=1.0))
    with pytest.MonkeyPatch.context() as patch:
        found = SimpleNamespace(left_px=left_px)
        patch.setattr(stereo_field, "calibrated_rig", lambda *_: found)
        try:
            stereo_field.estimated_rig(NONE, estimate, camera, "here")
        except CalibrationError:
            return False
    return True


def _left_px() -> float:
    """What a rig leaves of columns and rows that no rig makes, over the image (root mean square)."""
    rng = np.random.default_rng(2)
    columns = 4e-3 * rng.normal(size=FIELD_TERMS)
    rows = 4e-3 * rng.normal(size=ROW_TERMS)
    field = StereoFieldEstimate(
        columns, 1e-8 * np.eye(FIELD_TERMS), 0.3, rows, 1e-8 * np.eye(ROW_TERMS)
    )
    given = Rig.rectified(400.0, 400.0, 319.5, 239.5, 0.1, 640, 480)
    return float(stereo_field._with_field(given, field).left_px)


PAIRS: dict[str, tuple[Says, float, float]] = {
    "turned: rows": (lambda x: is_turned_by_rows(np.array([x, 0.0, 0.0])), 0.17, 0.23),
    "turned: yaw": (lambda x: is_turned_by_rows(np.array([0.0, x, 0.0])), 0.78, 1.02),
    "rows: points": (lambda n: rotation_by_rows(CAMERA, _pairs(int(n))) is not None, 29, 30),
    "rows: near": (lambda x: not _is_near(x), 1.3, 1.7),
    "rows: sigma": (lambda x: _row_sigma_px() < x, 0.26, 0.34),
    # two times a distortion: what it does to rows
    "motion: distortion": (lambda x: _yaw_sigma() < 2.0 * x, 1.7e-3, 2.3e-3),
    "motion: largest distortion": (lambda x: not _is_believed(x), 5.3e-3, 6.9e-3),
    "named": (lambda x: _lines(x) > 0, 2.6, 3.4),
    "points over the image": (lambda x: _left_px() < x, 0.61, 0.71),
    "no such rig": (lambda x: not _rig_found(x), 4.3, 5.7),
    "reading: straighter": (lambda x: _reads(x) is None, 0.17, 0.23),
    "reading: alike": (lambda x: _reads(0.1, 0.1 * x) == "first", 1.3, 1.7),
    "reading: in front": (_in_front, 0.75, 0.85),
}


# Two cameras


def _refined(rotation_deg: float = 0.0, direction_deg: float = 0.0) -> Any:
    """A refinement of given standard deviations."""
    sigmas = np.radians(rotation_deg), np.radians(direction_deg)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stereo, "_fit_stereo", lambda matches, R, d, spread: (R, d))
        patch.setattr(stereo, "_jackknife_sigmas", lambda *_: sigmas)
        patch.setattr(stereo, "_lens_pose", lambda *_: (np.zeros(3), 0.0))
        return stereo.refine_stereo(_matches(), np.eye(3), np.array([1.0, 0.0, 0.0]))


def _fitted(off_deg: float, which: int) -> bool:
    """Whether matches that are off by an angle are in one of the successive fits."""
    exact = _matches()
    off = _matches(off_deg)
    both = replace(exact, ray1=np.where(np.arange(300)[:, None] < 30, off.ray1, exact.ray1))
    counts: list[int] = []

    def fit(matches: Any, R: FloatArray, d: FloatArray, spread: float) -> Any:
        counts.append(len(matches.pair))
        return R, d

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stereo, "_fit_stereo", fit)
        patch.setattr(stereo, "_jackknife_sigmas", lambda *_: (0.0, 0.0))
        patch.setattr(stereo, "_lens_pose", lambda *_: (np.zeros(3), 0.0))
        stereo.refine_stereo(both, np.eye(3), np.array([1.0, 0.0, 0.0]))
    return counts[which] == 300


def _bends_more(share: float) -> bool:
    """Whether a lens bends a ray by more than 0.15 degrees that is off the axis by so much of the
    largest angle.
    """
    angle = np.radians(np.linspace(0.0, 30.0, 1001))
    rays = np.column_stack([np.sin(angle), np.zeros(1001), np.cos(angle)])
    bend = stereo._bends(rays)[0]
    return bool(bend[round(1000 * share), 0] > np.radians(0.15))


def _disparity_sigma(sigma: float) -> float:
    """Of the mean disparity, focal lengths, where the field has one of its own."""
    covariance = sigma**2 * np.eye(FIELD_TERMS)
    return disparity_off(StereoFieldEstimate(np.zeros(FIELD_TERMS), covariance, 0.0))[1]


def _cell_count() -> int:
    angles = np.random.default_rng(0).normal(size=(4000, 2))
    return len(np.unique(stereo._cells(angles)))


STEREO: dict[str, tuple[Says, float, float]] = {
    "rotation": (lambda x: isinstance(_refined(x), NotObservable), 0.17, 0.23),
    "direction": (lambda x: isinstance(_refined(0.0, x), NotObservable), 1.7, 2.3),
    "lens": (lambda x: _refined().rotation_sigma_deg < x, 0.13, 0.17),
    "gate": (lambda x: not _fitted(x, 0), 0.87, 1.13),
    "gate: narrower": (lambda x: not _fitted(x, 1), 0.26, 0.34),
    "cell": (
        lambda n: np.isfinite(stereo._structure(np.ones(int(n)), np.zeros(int(n), np.int64))),
        14,
        15,
    ),
    "cells": (lambda n: _cell_count() < n, 17, 35),
    "edge": (_bends_more, 0.92, 0.97),
    "field": (lambda x: _disparity_sigma(x) > 1.414 * x, 1.1e-4, 0.9e-4),
}
TABLES = {
    f"{what}: {name}": row
    for what, table in (
        ("gyro", GYRO),
        ("intrinsics", INTRINSICS),
        ("lever arm", LEVER_ARM),
        ("motion", MOTION),
        ("pairs", PAIRS),
        ("stereo", STEREO),
    )
    for name, row in table.items()
}


@pytest.mark.parametrize(("says", "below", "above"), TABLES.values(), ids=TABLES)
def test_limits_of_calibrating(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


def test_terms_of_a_rectification_error_are_as_many_as_stated() -> None:
    z = np.array([[100.0, 80.0, 90.0, 80.0]])
    rows, common = vertical_disparity_terms(CAMERA, z)
    assert f"(N, 4, {error_basis(CAMERA, z).shape[2]})" in str(error_basis.__doc__)
    stated = str(vertical_disparity_terms.__doc__)
    assert f"(N, {rows.shape[1]}) of right" in stated
    assert f"(N, {common.shape[1]}) by" in stated


def test_terms_of_an_imu_fill_its_matrices() -> None:
    """Equation (A1): those of the accelerometer from the diagonal up, all of the gyro."""
    by_term = np.array([imu_matrices(unit) for unit in np.eye(15)]) - np.eye(3)
    assert (by_term.sum(axis=0) == [np.triu(np.ones((3, 3))), np.ones((3, 3))]).all()
