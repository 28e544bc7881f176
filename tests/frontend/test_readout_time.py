"""The readout time of a rolling shutter, found by changes of velocity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from vio.frontend.readout_time import ReadoutTime, RowShares
from vio.frontend.rolling_shutter import RollingShutter
from vio.geometry.lie import FloatArray, se3_exp
from vio.geometry.stereo import StereoCamera, project
from vio.guard.repairing import AS_READ, Repair
from vio.records import Observations, observations

_CAMERA = StereoCamera(280.0, 280.0, 240.0, 155.0, 0.11, 480, 306)
_STEP_S = 0.05
_RNG = np.random.default_rng(0)
_POINTS = _RNG.uniform([-4, -3, 2], [4, 3, 8], (500, 3))
_AMPLITUDES = np.array([0.08, 0.05, 0.06, 0.05, 0.06, 0.04])  # m and rad
_RATES = np.array([3.0, 4.0, 2.5, 4.5, 3.5, 5.0])  # rad/s
_Pose = Callable[[FloatArray], FloatArray]  # (N, 6) at times (N,)


def _shaken(time_s: FloatArray) -> FloatArray:
    return _AMPLITUDES * np.sin(_RATES * time_s[:, None] + np.arange(6.0))


def _steady(time_s: FloatArray) -> FloatArray:
    return np.array([0.1, 0.02, -0.4, 0.02, 0.05, 0.0]) * time_s[:, None]


def _seen(
    index: int,
    pose: _Pose,
    readout_s: float,
    *,
    noise_px: float = 0.1,
    late_s: float = 0.0,
    camera: StereoCamera = _CAMERA,
) -> Observations:
    """A frame of a rolling shutter, whose stamp is early by `late_s`."""
    time_s = _STEP_S * index + late_s
    shown_s = np.full(len(_POINTS), time_s)
    for _ in range(8):
        T = se3_exp(pose(shown_s)).reshape(-1, 4, 4)
        z = project(camera, (T[:, :3, :3] @ _POINTS[:, :, None])[:, :, 0] + T[:, :3, 3])
        shown_s = time_s + readout_s * RowShares(camera, None).of(z)[:, 0]
    inside = (z[:, 0] > 0) & (z[:, 0] < 479) & (z[:, 1] > 0) & (z[:, 1] < 305)
    z = z[inside] + np.random.default_rng(index).normal(0.0, noise_px, (int(inside.sum()), 4))
    ids = inside.nonzero()[0]
    return observations(index, round(1e9 * _STEP_S * index), ids, z, np.ones(len(z), np.bool_))


def _search(frames: list[Observations], stated_s: float = 0.0) -> ReadoutTime:
    search = ReadoutTime(replace(_CAMERA, readout_s=stated_s), RowShares(_CAMERA, None))
    for seen in frames:
        search.frame(seen)
    return search


@pytest.mark.parametrize("readout_s", [0.005, 0.02, -0.02])
def test_the_readout_time_is_found(readout_s: float) -> None:
    search = _search([_seen(k, _shaken, readout_s) for k in range(240)])
    assert search.readout_s
    (finding,) = search.take_findings()
    figures = finding.figures
    assert (finding.code, finding.since) == ("rolling-shutter", 0)
    assert 1e3 * search.readout_s == figures["readout_ms"]
    error_ms = figures["readout_ms"] - 1e3 * readout_s
    assert abs(error_ms) < max(0.06 * abs(1e3 * readout_s), 0.5)
    assert figures["sigma_ms"] < 2.5
    assert ("last one on" in finding.message) == (readout_s < 0)
    assert not search.take_findings()


@pytest.mark.parametrize("noise_px", [0.02, 0.3])
def test_a_global_shutter_is_known_as_one(noise_px: float) -> None:
    frames = [_seen(k, _shaken, 0.0, noise_px=noise_px) for k in range(240)]
    search = _search(frames)
    assert not search.readout_s
    assert not search.take_findings()
    if noise_px < 0.1:
        assert not search._open  # no more work
    shutter = RollingShutter(_CAMERA)
    assert all(shutter.corrected(seen) is seen for seen in frames)
    assert not shutter.take_findings()


@pytest.mark.parametrize(
    ("stated_s", "readout_s"), [(0.02, 0.0), (0.02, -0.02), (0.02, 0.01), (-0.01, 0.02)]
)
def test_a_stated_time_that_is_not_the_cameras_is_named(stated_s: float, readout_s: float) -> None:
    search = _search([_seen(k, _shaken, readout_s) for k in range(160)], stated_s)
    (finding,) = search.take_findings()
    assert (finding.code, finding.effect, finding.since) == ("readout-contradicted", "unusable", 0)
    assert finding.figures["readout_ms"] == pytest.approx(1e3 * readout_s, rel=0.1, abs=0.5)
    assert f"the stated readout time of {1e3 * stated_s:.1f} ms" in finding.message
    assert not search.readout_s  # what is stated is used
    assert AS_READ.adding(finding) is AS_READ


@pytest.mark.parametrize("readout_s", [0.02, -0.02, 0.005])
def test_a_stated_time_that_is_about_the_cameras_is_not(readout_s: float) -> None:
    frames = [_seen(k, _shaken, readout_s) for k in range(160)]
    for share in (0.85, 1.0, 1.15):
        assert not _search(frames, share * readout_s).take_findings()
    search = _search(frames, readout_s)
    assert not search._open  # no more work


def test_a_steady_velocity_shows_nothing() -> None:
    for readout_s in (0.0, 0.02):
        frames = [_seen(k, _steady, readout_s) for k in range(80)]
        assert not _search(frames).readout_s
        assert not _search(frames, 0.02).take_findings()


@pytest.mark.parametrize("stated_s", [0.0, 0.02])
def test_what_never_shows_is_looked_for_seldom(stated_s: float) -> None:
    search = ReadoutTime(replace(_CAMERA, readout_s=stated_s), RowShares(_CAMERA, None))
    slow = lambda t: 0.3 * _steady(t)  # noqa: E731 - in view for longer
    looked = []
    for k in range(260):
        search.frame(_seen(k, slow, stated_s))
        looked.append(search._looked)
    assert looked[-1] - looked[-101] == 10


def test_what_else_moves_pixels_is_no_readout_time() -> None:
    rng = np.random.default_rng(1)
    jitter = [_seen(k, _shaken, 0.0, late_s=rng.uniform(-5e-3, 5e-3)) for k in range(160)]
    wrong_lens = [_seen(k, _shaken, 0.0) for k in range(160)]
    for seen in wrong_lens:
        for u in (0, 2):  # both cameras: barrel distortion of 2 px in the corners
            r = (seen.z[:, u : u + 2] - [240.0, 155.0]) / 285.0
            seen.z[:, u : u + 2] += 2.0 * r * (r * r).sum(axis=1, keepdims=True)
    longer = [
        _seen(k, _shaken, 0.0, camera=replace(_CAMERA, fu=294.0, fv=294.0)) for k in range(160)
    ]
    for frames in (jitter, wrong_lens, longer):
        assert not _search(frames).readout_s


def test_an_impossible_readout_time_is_none() -> None:
    # rows of a frame are exposed before the next one begins
    frames = [_seen(k, _shaken, 0.09, noise_px=0.02) for k in range(120)]
    assert not _search(frames).readout_s


def test_one_camera_and_images_of_unknown_height_are_not_searched() -> None:
    frames = [_seen(k, _shaken, 0.02) for k in range(80)]
    shutter = RollingShutter(replace(_CAMERA, height=None))
    assert all(shutter.corrected(seen) is seen for seen in frames)
    assert not shutter.take_findings()


def test_features_are_moved_once_it_is_known() -> None:
    shutter = RollingShutter(_CAMERA)
    changed = [
        shutter.corrected(seen) is not seen
        for seen in (_seen(k, _shaken, 0.02) for k in range(120))
    ]
    assert not any(changed[:16])
    assert all(changed[80:])


def test_a_run_that_begins_again_states_the_readout_time() -> None:
    search = _search([_seen(k, _shaken, 0.02) for k in range(120)])
    (finding,) = search.take_findings()
    repair = AS_READ.adding(finding)
    assert repair.readout_s == pytest.approx(search.readout_s)
    assert repair
    assert repair.adding(finding) is repair
    assert Repair.of_json(repair.to_json()) == repair
    ((code, line),) = repair.lines()
    assert code == "shutter-put-right"
    assert f"frontend.readout_ms to {1e3 * search.readout_s:.1f}" in line
