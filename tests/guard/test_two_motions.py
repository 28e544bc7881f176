"""Features that follow two motions: found over as many frames as it takes them to come apart."""

from __future__ import annotations

import numpy as np
import pytest

from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.guard.two_motions import Apart, TwoMotions
from vio.monitor.misfit import TrackMisfit
from vio.records import Observations, observations

CAMERA = StereoCamera(400, 400, 320, 240, 0.1, width=640, height=480)
STEP_NS = 50_000_000
SCENE = 120
# of the camera, a frame: m and rad; 1 px by the way and 1 px by the turn, in the middle of the scene
SLOW = np.array([0.01, 0.0, 0.004, 0.0, 0.0025, 0.0])
_RNG = np.random.default_rng(4)


def _points(count: int, near_m: float, far_m: float) -> FloatArray:
    rays = _RNG.uniform([-0.5, -0.4], [0.5, 0.4], (count, 2))
    depth = _RNG.uniform(near_m, far_m, (count, 1))
    return np.concatenate([rays * depth, depth], axis=1)


def _frames(
    share: float, other: FloatArray, frames: int = 40, step: FloatArray = SLOW, since: int = 0
) -> list[Observations]:
    """Frames of a camera that moves in a scene; a share of the features is that of points which move
    by `other` (6,) a frame in its own view, from some frame on.
    """
    rng = np.random.default_rng(1)
    scene = _points(SCENE, 2.0, 6.0)
    carried = _points(round(share / (1 - share) * SCENE), 0.6, 1.2)
    out = []
    for k in range(frames):
        T_cam_world = se3_inverse(se3_exp(k * step))
        p = transform_points(T_cam_world, scene)
        ids = np.arange(SCENE)
        if k >= since:
            p = np.concatenate([p, transform_points(se3_exp((k - since) * other), carried)])
            ids = np.arange(len(p))
        z = project(CAMERA, p)
        out.append(observations(k, k * STEP_NS, ids, z + rng.normal(0.0, 0.2, z.shape)))
    return out


def _last(frames: list[Observations]) -> Apart | None:
    motions = TwoMotions(CAMERA)
    found = None
    for seen in frames:
        found = motions.frame(seen)
    return found


STILL = np.zeros(6)
ASIDE = np.array([0.004, 0.002, 0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("still", [True, False])
def test_what_the_rig_carries_is_found_where_it_moves_slowly(still: bool) -> None:
    found = _last(_frames(0.3, STILL if still else ASIDE))
    assert found is not None
    assert found.share == pytest.approx(0.3, abs=0.05)
    assert found.since == 0
    assert found.still == still


def test_it_holds_since_its_features_were_used() -> None:
    found = _last(_frames(0.3, STILL, since=17))
    assert found is not None
    assert 15 <= found.since <= 17  # every third frame is compared


def test_a_share_of_a_tenth_is_named() -> None:
    assert _last(_frames(0.12, STILL)) is not None
    assert _last(_frames(0.09, STILL)) is None


@pytest.mark.parametrize(
    "step",
    [
        SLOW,
        np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0]),  # forwards: what is ahead stays
        np.array([0.0, 0.0, 0.0, 0.0, 0.01, 0.002]),  # a turn alone
        np.array([0.04, 0.0, 0.0, 0.0, -0.01, 0.0]),  # about a point of the scene
        STILL,
    ],
)
def test_one_motion_is_one(step: FloatArray) -> None:
    assert _last(_frames(0.0, STILL, step=step)) is None


def test_far_points_that_stay_are_of_the_scene_though_their_disparities_are_off() -> None:
    """A way of ten baselines and disparities that are a pixel too large: 10 px of motion."""
    frames = []
    for k in range(15):
        T_cam_world = se3_inverse(se3_exp(k * np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])))
        p = np.concatenate([_GROUND, _FAR])
        z = project(CAMERA, transform_points(T_cam_world, p))
        z[:, 2] -= 1.0
        frames.append(observations(k, k * STEP_NS, np.arange(len(p)), z))
    assert _last(frames) is None


_GROUND = _points(80, 4.0, 8.0)
_FAR = _points(60, 5e3, 6e3)


def test_one_camera_has_no_depths_to_compare() -> None:
    motions = TwoMotions(StereoCamera(400, 400, 320, 240, 1.0, kind="mono"))
    assert [motions.frame(seen) for seen in _frames(0.3, STILL)] == [None] * 40


def test_it_is_named_by_features_without_stated_errors_and_ends() -> None:
    check = TrackMisfit()
    seen = _frames(0.0, STILL, 1)[0]
    apart = Apart(0.3, 2, still=True)
    found = []
    for k in range(40):
        found += check.frame(seen, None, apart if 5 <= k < 10 else None)
    assert [(f.code, f.first_frame, f.ended) for f in found] == [
        ("tracks-disagree", 2, False),
        ("tracks-disagree", 0, True),
    ]
    assert "30 % of the tracks stay at the same pixels" in found[0].message
