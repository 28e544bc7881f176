"""Pixels of a rolling shutter, moved to the time of the middle row."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

import vio
from vio.cameras.rig import Rig, rectifier_of
from vio.errors import ConfigError
from vio.findings import Finding
from vio.frontend.readout_time import RowShares
from vio.frontend.rolling_shutter import RollingShutter
from vio.geometry.distortion import CameraModel, project_point
from vio.geometry.lie import FloatArray, se3_exp, transform_points
from vio.geometry.stereo import StereoCamera, left_rays, project
from vio.records import Image, Observations, StereoFrame, observations
from vio.runs.pipeline import RunResult
from vio.sim.effects import CLEAN
from vio.sim.motion import hand_held
from vio.sim.rigs import euroc_like_rig, euroc_rectified_rig
from vio.sim.scenarios import scaled
from vio.sim.sequence import SimulatedRecording, Simulation, simulate
from vio.sim.world import room

_STEP_S = 0.05
_READOUT_S = 0.02
_CAMERA = StereoCamera(280.0, 280.0, 240.0, 155.0, 0.11, 480, 306, readout_s=_READOUT_S)
_POINTS = np.random.default_rng(0).uniform([-3, -2, 2], [3, 2, 8], (300, 3))
_TWIST = np.array([0.5, 0.2, 0.3, 0.4, -0.6, 0.5])  # of the points, m/s and rad/s
_ACCELERATION = np.array([0.5, -1.0, 0.5, 1.0, 2.0, -1.0])


def _at(camera: StereoCamera, points: FloatArray, time_s: float) -> FloatArray:
    """Pixels (N, 4) of points at one time."""
    T = se3_exp(_TWIST * time_s + 0.5 * _ACCELERATION * time_s**2)
    return project(camera, transform_points(T, points))


def _late_s(camera: StereoCamera, rows: FloatArray) -> FloatArray:
    """Times of rows after the middle one."""
    assert camera.height is not None
    return (rows - 0.5 * (camera.height - 1)) * camera.readout_s / camera.height


def _rolled(camera: StereoCamera, time_s: float) -> FloatArray:
    """Pixels (N, 4) where a rolling shutter shows the points."""
    z = _at(camera, _POINTS, time_s)
    for _ in range(8):
        late_s = _late_s(camera, z[:, 1])
        z = np.array(
            [_at(camera, p, time_s + late) for p, late in zip(_POINTS, late_s, strict=True)]
        )
    return z


def _frame(index: int, z: FloatArray, has_right: bool = True) -> Observations:
    ids = np.arange(len(z))
    inside = (z >= 0).all(axis=1) & (z[:, 0] < 480) & (z[:, 1] < 306)
    time_ns = round(1e9 * _STEP_S * index)
    right = np.full(int(inside.sum()), has_right)
    return observations(index, time_ns, ids[inside], z[inside], right)


def _worst(seen: Observations, truth: FloatArray) -> float:
    columns = 4 if seen.has_right.all() else 2
    return float(np.abs(seen.z - truth[seen.ids])[:, :columns].max())


@pytest.mark.parametrize("projection", ["pinhole", "cylinder"])
@pytest.mark.parametrize("readout_s", [_READOUT_S, -_READOUT_S])
def test_features_get_the_pixels_of_one_exposure(readout_s: float, projection: str) -> None:
    camera = replace(_CAMERA, readout_s=readout_s, projection=projection)
    shutter = RollingShutter(camera)
    for k in range(6):
        truth = _at(camera, _POINTS, _STEP_S * k)
        seen = _frame(k, _rolled(camera, _STEP_S * k))
        out = shutter.corrected(seen)
        if k == 0:
            # there is no velocity yet
            assert np.abs(_late_s(camera, out.z[:, 1])).max() < 0.16 * _READOUT_S
            assert 20 < len(out) < 0.5 * len(seen)
        elif k > 1:
            assert len(out) == len(seen) > 150
            assert _worst(seen, truth) > 1.5
            assert _worst(out, truth) < 0.12


def test_features_without_depth_move_by_their_own_speed() -> None:
    shutter = RollingShutter(_CAMERA)
    shutter.corrected(_frame(0, _rolled(_CAMERA, 0.0), has_right=False))
    seen = _frame(1, _rolled(_CAMERA, _STEP_S), has_right=False)
    out = shutter.corrected(seen)
    truth = _at(_CAMERA, _POINTS, _STEP_S)
    assert len(out) > 150
    before = set(_frame(0, _rolled(_CAMERA, 0.0)).ids)
    moved = out.take(np.isin(out.ids, list(before)))
    assert _worst(seen, truth) > 1.5
    assert _worst(moved, truth) < 0.3  # the speed of half a step before
    unmoved = seen.take(~np.isin(seen.ids, list(before)))
    middle = np.abs(_late_s(_CAMERA, unmoved.z[:, 1])) < 0.15 * _READOUT_S
    assert set(out.ids) == before & set(seen.ids) | set(unmoved.ids[middle])


def test_right_pixels_that_do_not_count_may_be_anything() -> None:
    frames = [_frame(k, _rolled(_CAMERA, _STEP_S * k)) for k in range(3)]
    for alone in (np.nan, 1e9):
        shutter = RollingShutter(_CAMERA)
        outs = []
        for seen in frames:
            odd = seen.ids % 2 == 1
            z = np.where(odd[:, None] & [False, False, True, True], alone, seen.z)
            outs.append(shutter.corrected(replace(seen, z=z, has_right=~odd)))
        out = outs[-1]
        assert len(out) > 0.95 * len(frames[-1])
        both = out.take(out.has_right)
        assert _worst(both, _at(_CAMERA, _POINTS, 2 * _STEP_S)) < 0.15
        left = out.take(~out.has_right)
        truth = _at(_CAMERA, _POINTS, 2 * _STEP_S)[left.ids]
        assert np.abs(left.z - truth)[:, :2].max() < 0.4


def test_a_new_feature_needs_its_depth() -> None:
    shutter = RollingShutter(_CAMERA)
    shutter.corrected(_frame(0, _rolled(_CAMERA, 0.0)))
    seen = _frame(1, _rolled(_CAMERA, _STEP_S))
    early = np.abs(_late_s(_CAMERA, seen.z[:, 1])) > 0.3 * _READOUT_S
    renamed = replace(seen, ids=np.where(early, seen.ids + 1000, seen.ids))
    alone = early & (np.arange(len(seen)) % 2 == 0)
    renamed.has_right[alone] = False
    out = shutter.corrected(renamed)
    assert set(out.ids) == set(renamed.ids[~alone])


def test_without_a_recent_velocity_the_middle_rows_are_left() -> None:
    shutter = RollingShutter(_CAMERA)
    for k in (0, 1):
        out = shutter.corrected(_frame(k, _rolled(_CAMERA, _STEP_S * k)))
    assert len(out) > 150
    few = _frame(2, _rolled(_CAMERA, 2 * _STEP_S))
    few = few.take(np.abs(few.z[:, 1] - 152.5) > 60.0).take(np.arange(5))
    fresh = replace(few, ids=few.ids + 1000)
    assert len(shutter.corrected(fresh)) == 5  # the velocity goes on
    later = replace(fresh, ids=fresh.ids + 1000, time_ns=fresh.time_ns + 400_000_000)
    assert len(shutter.corrected(later)) == 0


def test_wrong_matches_do_not_bend_the_velocity() -> None:
    shutter = RollingShutter(_CAMERA)
    rng = np.random.default_rng(1)
    for k in range(4):
        z = _rolled(_CAMERA, _STEP_S * k)
        wrong = rng.random(len(z)) < 0.2
        z[wrong] += rng.uniform(-8, 8, (int(wrong.sum()), 1))
        seen = _frame(k, z)
        out = shutter.corrected(seen)
    good = out.take(~wrong[out.ids])
    assert len(good) > 100
    assert _worst(good, _at(_CAMERA, _POINTS, _STEP_S * 3)) < 0.2


def test_rows_of_the_raw_image_count() -> None:
    rectifier = rectifier_of(euroc_like_rig())
    camera = replace(rectifier.camera, readout_s=_READOUT_S)
    assert camera.width is not None
    assert camera.height is not None
    u = np.array([camera.width // 2, 20])
    v = np.array([30, camera.height - 30])
    pixels = np.stack([u, v, u, v], axis=1).astype(float)
    late_s = _READOUT_S * RowShares(camera, rectifier).of(pixels)
    for number, lens in enumerate(rectifier.cameras):
        T = rectifier.rig.T_imu_cam0 if number == 0 else rectifier.rig.T_imu_cam1
        R_rect_cam = rectifier.T_rect0_imu[:3, :3] @ T[:3, :3]
        raw, _ = project_point(lens, left_rays(camera, pixels[:, :2]) @ R_rect_cam)
        assert np.abs(raw[:, 1] - v).max() > 5.0
        expected = (raw[:, 1] - 0.5 * (lens.height - 1)) * _READOUT_S / lens.height
        np.testing.assert_allclose(late_s[:, number], expected, atol=1.1 * _READOUT_S / lens.height)


@pytest.mark.parametrize("depth_noise", [None, 0.0015])
def test_rows_of_the_raw_image_of_one_camera_count(depth_noise: float | None) -> None:
    """Where a lens is undistorted, of an image alone or with its depths."""
    lens = CameraModel(280.0, 280.0, 240.0, 155.0, 480, 306, "radtan", (-0.3, 0.1, 0.0, 0.0))
    rectifier = Rig(lens, depth_factor=1000.0).rectifier(depth_noise=depth_noise)
    pixels = np.array([[40.0, 20.0, 30.0, 20.0], [400.0, 290.0, 390.0, 290.0]])
    shares = RowShares(rectifier.camera, rectifier).of(pixels)
    for number in range(2):
        uv = pixels[:, 2 * number : 2 * number + 2]
        raw, _ = project_point(lens, left_rays(rectifier.camera, uv))
        assert np.abs(raw[:, 1] - uv[:, 1]).max() > 5.0
        expected = (raw[:, 1] - 0.5 * (lens.height - 1)) / lens.height
        np.testing.assert_allclose(shares[:, number], expected, atol=0.6 / lens.height)


def test_features_without_an_image_size_are_refused() -> None:
    with pytest.raises(ConfigError, match="height of the images"):
        RollingShutter(replace(_CAMERA, height=None))


class _Kept(SimulatedRecording):
    """A simulation whose images are rendered once."""

    @functools.cache  # noqa: B019 - as long as the test
    def images(self, index: int) -> tuple[Image, Image]:
        return super().images(index)


@pytest.fixture(scope="module")
def plan() -> Simulation:
    rig = scaled(euroc_rectified_rig(), 320)
    motion = hand_held(duration_s=3.5)
    rolling = replace(CLEAN, readout_ms=20.0)
    return simulate(room(1, texel_m=0.01), rig, motion, rate_hz=20.0, effects=rolling)


@pytest.fixture(scope="module")
def rolled(plan: Simulation) -> _Kept:
    return _Kept(plan)


def _run(dataset: _Kept, readout_ms: str) -> tuple[RunResult, float]:
    config = vio.load_config(overrides=["motion=none", f"frontend.readout_ms={readout_ms}"])
    result = vio.run(dataset, config)
    score = vio.evaluate(result.trajectory, dataset.reference, T_cam0_imu=result.T_cam0_body)
    return result, score.ate_m.rmse


def _shutters(findings: Iterable[Finding]) -> list[str]:
    return [f.code for f in findings if "shutter" in f.code or "readout" in f.code]


def test_a_run_finds_the_readout_time_and_is_like_one_of_a_global_shutter(
    plan: Simulation, rolled: _Kept
) -> None:
    global_shutter = _Kept(replace(plan, effects=CLEAN))
    at_once, exposed_at_once = _run(global_shutter, "null")
    wrongly, as_wrongly_stated = _run(global_shutter, "20")
    as_rolled, uncorrected = _run(rolled, "0")  # states a global shutter
    stated, corrected = _run(rolled, "20")
    found, by_itself = _run(rolled, "null")
    assert uncorrected > 8 * exposed_at_once
    assert corrected < uncorrected / 3
    assert by_itself < uncorrected / 3
    assert not _shutters((*at_once.findings, *as_rolled.findings, *stated.findings))
    assert _shutters(found.findings) == ["shutter-put-right"]
    assert as_wrongly_stated > 8 * exposed_at_once
    assert _shutters(wrongly.findings) == ["readout-contradicted"]
    assert found.repair.readout_s == pytest.approx(0.02, rel=0.1)
    assert {e.integrity for e in found.estimates} == {"nominal"}
    calibrated = found.calibrated_rig()
    assert calibrated is not None
    assert calibrated.rig.readout_s == found.repair.readout_s


def test_live_use_goes_on_with_features_of_one_time(rolled: _Kept) -> None:
    odometry = vio.Odometry(rolled.recording.camera)
    for event in rolled.events():
        if isinstance(event, StereoFrame):
            assert event.left is not None
            assert event.right is not None
            odometry.add_stereo(event.time_ns, event.left, event.right)
    (finding,) = [f for f in odometry.findings if "shutter" in f.code]
    assert (finding.code, finding.effect, finding.since) == ("rolling-shutter", "unusable", 0)
    assert finding.figures["readout_ms"] == pytest.approx(20.0, rel=0.1)
