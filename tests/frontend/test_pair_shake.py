"""A pair that shakes: what the disparities of a frame have in common makes its right pixels count
less.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA, flight, stereo_frame
from vio.frontend.klt import KltFrontend
from vio.frontend.right_turn import PairShake
from vio.frontend.settings import FrontendSettings, GridSettings
from vio.geometry.lie import so3_exp
from vio.records import FrontendOutput, StereoFrame

FRAMES = 16
SETTINGS = FrontendSettings(grid=GridSettings(target_features=150))


def _turned(frame: StereoFrame, yaw_px: float) -> StereoFrame:
    """A frame whose right camera is turned by what moves its centre by some pixels."""
    assert frame.right is not None
    K = np.array([[CAMERA.fu, 0.0, CAMERA.cu], [0.0, CAMERA.fv, CAMERA.cv], [0.0, 0.0, 1.0]])
    H = K @ so3_exp([0.0, yaw_px / CAMERA.fu, 0.0]) @ np.linalg.inv(K)
    right = cv2.warpPerspective(frame.right, H, frame.right.shape[::-1])
    return replace(frame, right=np.asarray(right, dtype=np.uint8))


def _outputs(shake_px: float) -> list[FrontendOutput]:
    rng = np.random.default_rng(4)
    frontend = KltFrontend(CAMERA, SETTINGS)
    frames = [stereo_frame(k, pose) for k, pose in enumerate(flight(FRAMES))]
    return [frontend.process(_turned(f, shake_px * rng.normal())) for f in frames]


@pytest.mark.parametrize("shake_px", [0.25, 0.4])
def test_a_pair_that_shakes_is_named_and_counts_less(shake_px: float) -> None:
    outputs = _outputs(shake_px)
    found = [f for output in outputs for f in output.findings]
    named = [f for f in found if f.code == "right-camera-shakes" and not f.ended]
    assert len(named) == 1
    assert named[0].frame is not None
    assert named[0].frame <= 12
    assert named[0].figures["common_px"] == pytest.approx(shake_px, rel=0.6)
    sigma = outputs[-1].observations.sigma
    assert sigma is not None
    seen = outputs[-1].observations.has_right
    assert np.median(sigma[seen, 2]) > 2.0 * np.median(sigma[seen, 0])


def test_a_firm_pair_is_not_named() -> None:
    outputs = _outputs(0.0)
    assert not [f for output in outputs for f in output.findings]
    sigma = outputs[-1].observations.sigma
    assert sigma is not None
    seen = outputs[-1].observations.has_right
    assert np.median(sigma[seen, 2]) < 1.5 * np.median(sigma[seen, 0])


def test_one_frame_that_is_off_is_no_shaking() -> None:
    shake = PairShake(300.0)
    for k in range(30):
        shake.frame(k, 1.5 if k in (9, 10) else 0.02, 100)
    assert shake.right_factor == 1.0
    assert not shake.take_findings()


def test_events_in_many_of_the_frames_are_no_shaking() -> None:
    """A car that fills the view for a third of the frames whose disparities are known at all: so
    on Karlsruhe 0019, in most of its healthy variants.
    """
    shake = PairShake(645.0)
    rng = np.random.default_rng(7)
    for k in range(40):
        event = k % 3 == 1
        shake.frame(k, float(rng.choice([-1, 1]) * 0.8) if event else 0.05 * rng.normal(), 100)
    assert shake.right_factor == 1.0
    assert not shake.take_findings()


def test_what_a_drive_with_a_wrong_calibration_shows_is_no_shaking() -> None:
    """A drive of KITTI comes to 0.15 px at a focal length of 722 px, as cars do not shake by."""
    rng = np.random.default_rng(6)
    common_px = np.diff(rng.normal(0.0, 0.15, 80)).tolist()
    shakes = []
    for focal_px in (722.0, 300.0):
        shake = PairShake(focal_px)
        for k, off in enumerate(common_px):
            shake.frame(k, off, 100)
        shakes.append(bool(shake.take_findings()))
    assert shakes == [False, True]


def test_errors_that_change_slowly_are_no_shaking() -> None:
    """So where a rig turns whose calibration is off: Karlsruhe 0019, frames 54 to 75, half size."""
    common_px = [0.08, 0.09, 0.08, 0.13, 0.42, 0.67, 0.66, 0.78, -0.28, -0.1, -0.02, 0.68, 0.84]
    common_px += [0.92, 0.95, 0.93, 0.47, 0.61, 0.53]
    shake = PairShake(322.0)
    for k, off in enumerate(common_px):
        shake.frame(k, off, 100)
    assert not shake.take_findings()
    # the same errors in another order
    shake = PairShake(322.0)
    for k, off in enumerate(np.random.default_rng(0).permutation(common_px)):
        shake.frame(k, float(off * (-1) ** k), 100)
    assert shake.take_findings()


def test_the_factor_is_that_of_an_error_that_all_share() -> None:
    shake = PairShake(300.0)
    rng = np.random.default_rng(1)
    common_px = rng.normal(0.0, 0.2, 400)
    for k, off in enumerate(np.diff(common_px)):
        shake.frame(k, float(off), 120)
    # a mean of 120 right pixels is as uncertain as what they have in common
    mean_px = shake.right_factor * 0.3 / np.sqrt(120)
    assert mean_px == pytest.approx(np.hypot(0.2, 0.3 / np.sqrt(120)), rel=0.5)
    for k in range(40):
        shake.frame(400 + k, 0.0, 120)
    assert shake.right_factor == 1.0
    assert [f.ended for f in shake.take_findings()][-1]


def test_right_images_of_another_time_are_no_shaking_once_that_is_known() -> None:
    shake = PairShake(300.0)
    for k in range(12):
        shake.frame(k, 0.9 if k % 2 else -0.9, 100)
    assert shake.right_factor > 1.0
    shake.explained(12)
    shake.explained(13)
    assert shake.right_factor == 1.0
    assert [f.ended for f in shake.take_findings()] == [False, True]
