"""Limits of landmarks, weights, predictions and scale tests of the filters, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, T_CAM0_IMU
from tests.filters.test_start_limits import _rows, _seen_at, _step_views, _vislam
from vio.filters import new_landmarks
from vio.filters.imu_gaps import ImuHistory
from vio.filters.imu_start import imu_start
from vio.filters.mono_msckf import _for_one_camera
from vio.filters.multiview import residuals, robust_weights
from vio.filters.new_landmarks import NewLandmarks
from vio.filters.online_calibration import Calibration
from vio.filters.propagation import Propagation
from vio.filters.rig_calibration import RigCalibration
from vio.filters.scale_test import ScaleTest
from vio.filters.settings import MsckfSettings
from vio.filters.step_by_images import linked_points, step_by_images
from vio.filters.track_records import Residuals, Views
from vio.filters.window import Window
from vio.filters.window_fit import WindowFit
from vio.imu.settings import DEFAULT_IMU
from vio.records import ImuSample

Says = Callable[[float], bool]
SETTINGS = MsckfSettings()
NONE: Any = None


def _promoted(by_depth: float = 9.0, by_stereo: float = 9.0, scale: float = 0.0) -> bool:
    """Whether a point becomes a landmark that is known so well by all views, or by the right ones
    alone, while the scale is known to a share.
    """
    information = SimpleNamespace(
        q=None,
        point_covariance=lambda chosen: np.tile(np.eye(3), (len(chosen), 1, 1)),
        point_D_clones=lambda chosen: np.zeros((len(chosen), 3, 6)),
    )
    tracks: Any = SimpleNamespace(
        at=None, information=information, rows=np.arange(1), p_world=np.ones((1, 3))
    )
    fit: Any = SimpleNamespace(
        variance=1.0, tracks=SimpleNamespace(variance=1.0, table=SimpleNamespace(ids=lambda x: x))
    )
    rig: Any = SimpleNamespace(field=lambda _: None)
    state = SimpleNamespace(size=6, jacobian=lambda points, stereo: points)
    window: Any = SimpleNamespace(landmarks=[], state=state, add_landmarks=lambda *_: None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(new_landmarks, "_scale_sigma", lambda _: scale)
        patch.setattr(new_landmarks, "relative_stereo_sigma", lambda *_: np.array([by_stereo]))
        made = NewLandmarks(rig, fit, 9).promote(
            window, tracks, None, np.ones(1, np.bool_), np.array([by_depth]), True
        )
    return len(made) > 0


def _weight(px: float, others_px: float = 0.0) -> float:
    """Weight of a view that is off by so much, in noise of one pixel, among ten that are off too."""
    r = np.zeros((11, 1, 4))
    r[:, 0, 0] = others_px
    r[0, 0, 0] = px
    J = np.ones((11, 1, 4, 3))
    at = Residuals(r, J, np.ones(11, np.bool_), np.ones(r.shape))
    return float(robust_weights(at, 1.0)[0, 0])


def _is_ahead(baselines: float) -> bool:
    p = np.array([[0.0, 0.0, baselines * CAMERA.baseline_m]])
    views = Views(np.ones((1, 1, 4)), np.ones((1, 1, 4)))
    return bool(residuals(CAMERA, np.eye(4)[None], p, views).ahead[0])


def _is_predicted(seconds: float) -> bool:
    """Whether a frame is predicted that comes so long after the first, by images alone."""
    settings = replace(SETTINGS, angular_acceleration_density=1e-6)
    propagation = Propagation(None, settings, DEFAULT_IMU)
    window = Window(propagation.motion, *propagation.motion.start(0), Calibration(T_CAM0_IMU))
    propagation.begin(window, 0, 0)
    window.add_clone(0, 0)
    return propagation.predict(window, round(1e9 * seconds)) is not None


def _rows_have_moved(px: float) -> bool:
    """Whether columns are in doubt again where all rows move by so much after a hundred frames."""
    inflated: list[object] = []

    window: Any = SimpleNamespace(
        state=SimpleNamespace(blocks={"stereo_field": slice(0, 8)}),
        prior=SimpleNamespace(inflate=lambda *arguments: inflated.append(arguments)),
        calibration=None,
    )
    rig = RigCalibration(CAMERA, SETTINGS)
    for k in range(106):
        rig.learn_rows(window, _rows(offset_px=0.0 if k < 100 else px))
    return bool(inflated)


def _clones(settings: int) -> int:
    """Clones of a filter with one camera, for which a setting asks for so many."""
    return _for_one_camera(replace(SETTINGS, clones=settings)).clones


def _measured_anew(samples: int) -> bool:
    """Whether the period of 80 samples is measured again after so many more."""
    history = ImuHistory()
    sample = [ImuSample(5_000_000 * k, np.zeros(3), np.zeros(3)) for k in range(80 + samples)]
    history.take(sample[:80])
    history._measure(80)
    for each in sample[80:]:
        history.take([each])
    return history._unmeasured < samples


def _tilt_deg() -> float:
    """Standard deviation of the tilt by an accelerometer that shakes about gravity."""
    rng = np.random.default_rng(0)
    samples = []
    for k in range(101):
        force = np.array([0.0, 0.0, DEFAULT_IMU.gravity_mps2]) + 0.5 * rng.normal(size=3)
        force *= DEFAULT_IMU.gravity_mps2 / np.linalg.norm(force)
        samples.append(ImuSample(5_000_000 * k, 0.5 * rng.normal(size=3), force))
    begin = imu_start(samples, 500_000_000, DEFAULT_IMU)
    return float(np.degrees(begin.accel_sigma_mps2 / DEFAULT_IMU.gravity_mps2))


def _contradicted(log: float) -> bool:
    """Whether a scale is contradicted of which each frame says as much as fifty units of noise."""
    test = ScaleTest()
    V = np.array([1.0])
    for _ in range(4000):
        test.absorb(V, 50.0 * V, np.array([50.0 * log]), np.zeros((1, 1)))
        test.end_frame()
    return test.is_confirmed


def _doubt_in_noise() -> float:
    """What a scale may be off by that many frames tell no better than noise does."""
    test = ScaleTest()
    V = np.array([1.0])
    test.absorb(V, 900.0 * V, np.array([900.0 * 0.1]), np.zeros((1, 1)))
    for _ in range(5000):
        test.end_frame()
    return test.doubt()


def _explains(share: float) -> bool:
    """Whether a motion is found of features of which a share follows it; others are off by some
    pixels.
    """
    views = _step_views(200)
    z = views.z.copy()
    wrong = round(200 * (1.0 - share))
    angle = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, wrong)
    z[:wrong, 1, :2] += 9.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    return step_by_images(CAMERA, *linked_points(CAMERA, Views(z, views.weight))) is not None


def _pose_trace(features: int) -> float:
    """Trace of the covariance of a pose after so many features were seen twice."""
    vislam = _vislam()
    vislam.update(_seen_at(5.0, features))
    vislam.update(_seen_at(5.0, features, 1))
    return float(np.trace(vislam.estimate().covariance))


def _point_steps() -> int:
    """How often the points of a window's tracks move after its poses did."""
    own = MagicMock()
    own.information.return_value = (np.eye(1), np.zeros(1), NONE)
    WindowFit.fit(own, NONE, MagicMock(rows=np.arange(3)), NONE, None)
    return int(own.linearise.call_args.args[2])


LIMITS: dict[str, tuple[Says, float, float]] = {
    "landmark: all views": (lambda x: not _promoted(by_depth=x), 0.0087, 0.0113),
    "landmark: right views": (lambda x: not _promoted(by_stereo=x), 0.087, 0.113),
    "landmark: scale": (lambda x: not _promoted(0.0, scale=x), 0.87e-3, 1.13e-3),
    "weight": (lambda x: _weight(x) < 0.5, 5.2, 6.8),
    # the squared scale is that of the median over 2.37
    "weight: scale": (lambda x: _weight(6.0, np.sqrt(x)) > 0.501, 2.1, 2.7),
    "steps of points": (lambda n: _point_steps() < n, 1, 2),
    "ahead": (_is_ahead, 0.43, 0.57),
    "predicted": (lambda s: not _is_predicted(s), 0.17, 0.23),
    "rows have moved": (_rows_have_moved, 0.135, 0.175),
    "clones of one camera": (lambda n: _clones(int(n)) == n, 19, 20),
    "period": (lambda n: _measured_anew(int(n)), 10, 11),
    "tilt": (lambda x: _tilt_deg() < x, 7.5, 10.5),
    "scale: noise": (_contradicted, 0.056, 0.065),
    "scale: largest noise": (lambda x: _doubt_in_noise() < x, 0.0275, 0.030),
    "step: share": (_explains, 0.45, 0.55),
    "pose: features": (lambda n: _pose_trace(int(n)) < 0.9 * _pose_trace(1), 2, 3),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_windows(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
