"""A rolling shutter that nobody stated: found by the pattern that it leaves in the pixels."""

from __future__ import annotations

import numpy as np
import pytest

from tests.monitor.test_misfit import updated
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.guard.unstated_shutter import UnstatedShutter
from vio.monitor.run import RunMonitor
from vio.records import Observations, observations

CAMERA = StereoCamera(400, 400, 320, 240, 0.1, width=640, height=480)
STEP_S = 0.05
FRAMES = 80


def _hand_held(t: float) -> FloatArray:
    """Pose (4, 4) of cam0 in the world."""
    swing = np.sin(t * np.array([2.9, 4.1, 3.3, 5.3, 3.7, 4.7]) + np.arange(6))
    return se3_exp(swing * [0.08, 0.06, 0.08, 0.05, 0.07, 0.04])


def _frames(
    readout_s: float = 0.0, growth: float = 0.0, disparity_px: float = 0.0
) -> list[Observations]:
    """Frames whose rows are exposed over some time about their stamp; the image also grows with
    time, and right pixels are off.
    """
    rng = np.random.default_rng(2)
    rays = rng.uniform([-0.6, -0.45], [0.6, 0.45], (150, 2))
    depth = rng.uniform(1.5, 5.0, (150, 1))
    points = np.concatenate([rays * depth, depth], axis=1)
    out = []
    for k in range(FRAMES):
        first, z, last = (
            project(
                CAMERA,
                transform_points(se3_inverse(_hand_held(k * STEP_S + 0.5 * s * readout_s)), points),
            )
            for s in (-1, 0, 1)
        )
        late = 2.0 * z[:, 1:2] / 480.0 - 1.0  # of half the readout time
        z = z + late * (last - first) / 2.0 + late**2 * (first - 2.0 * z + last) / 2.0
        z[:, :2] += growth * k * STEP_S * (z[:, :2] - (CAMERA.cu, CAMERA.cv))
        z[:, 2] += disparity_px
        z += rng.normal(0.0, 0.15, z.shape)
        out.append(observations(k, round(k * STEP_S * 1e9), np.arange(len(points)), z))
    return out


def _named_ms(frames: list[Observations]) -> list[float]:
    shutter = UnstatedShutter(CAMERA)
    found = [finding for seen in frames for finding in shutter.frame(seen)]
    assert all(finding.first_frame == 0 and finding.lasts for finding in found)
    return [finding.figures["readout_ms"] for finding in found]


@pytest.mark.parametrize("readout_ms", [20.0, -20.0, 10.0])
def test_a_readout_time_is_found_once_with_its_sign(readout_ms: float) -> None:
    assert _named_ms(_frames(1e-3 * readout_ms)) == [pytest.approx(readout_ms, rel=0.3)]


def test_one_exposure_of_all_rows_is_not_taken_for_several() -> None:
    assert _named_ms(_frames()) == []
    assert _named_ms(_frames(growth=0.005)) == []
    assert _named_ms(_frames(disparity_px=1.0)) == []


def test_a_readout_of_less_than_any_rolling_shutter_is_not_named() -> None:
    assert _named_ms(_frames(0.004)) == []


def test_one_camera_shows_none() -> None:
    shutter = UnstatedShutter(StereoCamera(400, 400, 320, 240, 1.0, kind="mono"))
    assert [shutter.frame(seen) for seen in _frames()] == [[]] * FRAMES


def test_no_more_pairs_are_compared_once_the_shutter_is_known_to_be_global(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    compared = []
    compare = UnstatedShutter._compare
    monkeypatch.setattr(
        UnstatedShutter, "_compare", lambda self: compared.append(1) or compare(self)
    )
    assert _named_ms(_frames()) == []
    assert 10 <= len(compared) < FRAMES // 5


def test_a_run_marks_all_frames_from_the_first() -> None:
    monitor = RunMonitor(CAMERA, np.eye(4), imu=False)
    for seen in _frames(0.02):
        updated(monitor, seen)
    assert [finding.code for finding in monitor.findings] == ["rolling-shutter"]
    mark = monitor.take_marks()[0]
    assert (mark.since, mark.integrity) == (0, "degraded")
