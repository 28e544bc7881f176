"""Effect of a prior on the front ends: a good one bridges jumps, a bad one of any kind does no
harm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.frontend.test_frontend_outliers import CAMERA, T_TRUE, make_problem, pixels, scene
from tools.frontend_accuracy import accuracy_scenario
from vio.frontend import FrontendSettings, build_frontend, descriptors, outliers
from vio.frontend.frames import usable_prior
from vio.frontend.outliers import pixel_errors, predicted_motion, rigid_consensus
from vio.frontend.settings import GridSettings, MatchSettings
from vio.geometry.distortion import rectified_camera
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse
from vio.records import FrontendOutput, Observations, StereoFrame, TrackPrior
from vio.sim.render import correspondence
from vio.sim.scenarios import plan
from vio.sim.sequence import SimulatedRecording, Simulation, views

FRAMES = 7
NOISE_PX = 0.7
OFF_PX = 30.0
SETTINGS = FrontendSettings(
    grid=GridSettings(target_features=150), match=MatchSettings(max_keypoints=400)
)
NAMES = ["klt", "orb", "sift"]

Corruption = Callable[[TrackPrior, np.random.Generator], TrackPrior]


@dataclass(frozen=True)
class Clip:
    simulation: Simulation
    frames: list[StereoFrame]


@pytest.fixture(scope="module")
def clip() -> Clip:
    """Frames of a flight through the room at full speed."""
    simulation = plan(accuracy_scenario(None, frames=40 + FRAMES, width=376))
    simulation = replace(
        simulation, taken_ns=simulation.taken_ns[-FRAMES:], stamps_ns=simulation.stamps_ns[-FRAMES:]
    )
    recording = SimulatedRecording(simulation)
    return Clip(simulation, [recording.frame(k) for k in range(FRAMES)])


def true_prior(clip: Clip, seen: Observations, now: int, rng: np.random.Generator) -> TrackPrior:
    """True pixels of the previous frame's features with the noise of a filter, and the true
    rotation.
    """
    before, (left, right) = (
        views(clip.simulation, int(clip.simulation.taken_ns[k])) for k in (now - 1, now)
    )
    to_left, _ = correspondence(clip.simulation.world, before[0], left, seen.z[:, :2])
    to_right, _ = correspondence(clip.simulation.world, before[0], right, seen.z[:, :2])
    z = np.concatenate([to_left, to_right], axis=1) + NOISE_PX * rng.standard_normal((len(seen), 4))
    return TrackPrior(seen.ids, z, (se3_inverse(left.T_world_cam) @ before[0].T_world_cam)[:3, :3])


def moved(prior: TrackPrior, off: FloatArray) -> TrackPrior:
    return replace(prior, z=prior.z + np.tile(off, (1, 2)))


def turned(prior: TrackPrior) -> TrackPrior:
    return replace(
        prior,
        R_cam_prev=se3_exp([0.0, 0.0, 0.0, 0.0, np.radians(5.0), 0.0])[:3, :3] @ prior.R_cam_prev,
    )


def nothing_but_rotation(prior: TrackPrior) -> TrackPrior:
    return replace(prior, ids=prior.ids[:0], z=prior.z[:0])


def half_scattered(prior: TrackPrior, rng: np.random.Generator) -> TrackPrior:
    angle = rng.uniform(0, 2 * np.pi, len(prior.ids))
    off = OFF_PX * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return moved(prior, off * (rng.uniform(size=(len(off), 1)) < 0.5))


def half_shifted(prior: TrackPrior, rng: np.random.Generator) -> TrackPrior:
    return moved(prior, np.array([[OFF_PX, 0.0]]) * (rng.uniform(size=(len(prior.ids), 1)) < 0.5))


CORRUPTIONS: dict[str, Corruption] = {
    "right": lambda prior, _: prior,
    "right rotation alone": lambda prior, _: nothing_but_rotation(prior),
    "all off to one side": lambda prior, _: moved(prior, np.array([[OFF_PX, 0.0]])),
    "half off to one side": half_shifted,
    "half off anywhere": half_scattered,
    "no numbers": lambda prior, _: replace(prior, z=np.full_like(prior.z, np.nan)),
    "half no numbers": lambda prior, _: replace(
        prior, z=np.where(np.arange(len(prior.z))[:, None] % 2 == 0, np.nan, prior.z)
    ),
    "unknown ids": lambda prior, _: replace(prior, ids=prior.ids + 10**6),
    "rotation wrong": lambda prior, _: turned(prior),
    "wrong rotation alone": lambda prior, _: turned(nothing_but_rotation(prior)),
    "rotation without numbers": lambda prior, _: replace(prior, R_cam_prev=np.full((3, 3), np.nan)),
    "a mirror for a rotation": lambda prior, _: replace(prior, R_cam_prev=-np.ones((3, 3))),
    "everything wrong": lambda prior, _: turned(moved(prior, np.array([[OFF_PX, 20.0]]))),
}


@dataclass(frozen=True)
class Quality:
    median_px: float
    outliers: float
    survived: float
    stereo: float


def quality(clip: Clip, outputs: list[FrontendOutput]) -> Quality:
    errors, kept, could = [], 0, 0
    for k in range(len(outputs) - 1):
        seen, later = outputs[k].observations, outputs[k + 1].observations
        a, b = (views(clip.simulation, int(clip.simulation.taken_ns[i]))[0] for i in (k, k + 1))
        there, visible = correspondence(clip.simulation.world, a, b, seen.z[:, :2])
        size = np.array([clip.frames[0].left.shape[1], clip.frames[0].left.shape[0]])  # type: ignore[union-attr]
        visible &= ((there > 10) & (there < size - 10)).all(axis=1)
        _, i, j = np.intersect1d(seen.ids, later.ids, return_indices=True)
        error = np.linalg.norm(later.z[j, :2] - there[i], axis=1)[visible[i]]
        errors.append(error)
        kept, could = kept + len(error), could + int(visible.sum())
    error = np.concatenate(errors)
    rows = float(np.mean([output.matched for output in outputs]))
    return Quality(float(np.median(error)), float(np.mean(error > 1)), kept / could, rows)


def run(clip: Clip, name: str, corrupt: Corruption | None) -> Quality:
    recording = SimulatedRecording(clip.simulation)
    frontend = build_frontend(name, rectified_camera(clip.simulation.rig), SETTINGS, recording)
    rng, outputs = np.random.default_rng(3), [frontend.process(clip.frames[0])]
    for k in range(1, FRAMES):
        prior = (
            None
            if corrupt is None
            else corrupt(true_prior(clip, outputs[-1].observations, k, rng), rng)
        )
        outputs.append(frontend.process(clip.frames[k], prior))
    return quality(clip, outputs)


@pytest.fixture(scope="module")
def alone(clip: Clip) -> dict[str, Quality]:
    """Without any prior."""
    return {name: run(clip, name, None) for name in NAMES}


@pytest.mark.parametrize("kind", CORRUPTIONS)
@pytest.mark.parametrize("name", NAMES)
def test_prior_of_any_kind_does_not_degrade_tracks(
    name: str, kind: str, clip: Clip, alone: dict[str, Quality]
) -> None:
    """Within 0.01 px in the median, 1 % of outliers, 2 % of the tracks and 4 % of the stereo
    matches.
    """
    plain, with_prior = alone[name], run(clip, name, CORRUPTIONS[kind])
    assert with_prior.median_px < plain.median_px + 0.01
    assert with_prior.outliers < plain.outliers + 0.01
    assert with_prior.survived > plain.survived - 0.02
    assert with_prior.stereo > 0.96 * plain.stereo


@pytest.mark.parametrize("name", NAMES)
def test_prior_bridges_a_gap_too_wide_for_tracking_alone(
    name: str, clip: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five consecutive frames are lost.

    Lucas-Kanade has one level, and the search radius of descriptors is small.
    """
    simulation = replace(
        clip.simulation,
        taken_ns=clip.simulation.taken_ns[::6],
        stamps_ns=clip.simulation.stamps_ns[::6],
    )
    apart = Clip(simulation, [replace(clip.frames[k], index=i) for i, k in enumerate((0, 6))])
    monkeypatch.setattr(descriptors, "_MATCHES", descriptors._MATCHES._replace(search_share=0.02))
    settings = replace(SETTINGS, klt=replace(SETTINGS.klt, pyramid_levels=0))
    kept = []
    for with_prior in (False, True):
        frontend = build_frontend(
            name, rectified_camera(simulation.rig), settings, SimulatedRecording(simulation)
        )
        seen = frontend.process(apart.frames[0]).observations
        prior = true_prior(apart, seen, 1, np.random.default_rng(4)) if with_prior else None
        kept.append(frontend.process(apart.frames[1], prior).tracked / len(seen))
    assert kept[1] > 1.5 * kept[0]
    assert kept[1] > 0.25


def test_invalid_parts_of_a_prior_are_ignored() -> None:
    z = np.arange(16.0).reshape(4, 4)
    z[1, 0], z[2, 3] = np.nan, np.inf  # the right pixel is not needed
    kept = usable_prior(TrackPrior(np.array([7, 3, 5, 7]), z, np.eye(3)))
    assert kept.ids.tolist() == [5, 7]
    np.testing.assert_array_equal(kept.z[:, :2], z[[2, 0], :2])
    assert kept.R_cam_prev is not None
    assert usable_prior(None) is None
    nothing = TrackPrior(np.array([1]), np.full((1, 4), np.nan), 2 * np.eye(3))
    assert usable_prior(nothing) is None


def test_predicted_motion_reuses_an_expected_motion_that_fits() -> None:
    p = scene(300, 30)
    near = se3_exp([0.01, 0.0, -0.02, 0.0, 0.0005, 0.0]) @ T_TRUE
    uv = pixels(T_TRUE, p, 31, noise=0.0)
    assert predicted_motion(CAMERA, p, uv, near) is near
    hard_turn = se3_exp([0.1, 0.0, -0.3, 0.0, 0.2, 0.05])
    for T in (T_TRUE, hard_turn):  # from far away, the result is a start near the truth
        far = predicted_motion(CAMERA, p, pixels(T, p, 31, noise=0.0), np.eye(4))
        assert np.median(pixel_errors(CAMERA, far, p, pixels(T, p, 31, noise=0.0))) < 2.0
    scattered = np.random.default_rng(36).uniform([0, 0], [1242, 375], (300, 2))
    assert predicted_motion(CAMERA, p, scattered, np.eye(4)) is None
    assert predicted_motion(CAMERA, p[:5], uv[:5], near) is None


@pytest.mark.parametrize("share", [0.5, 0.65, 0.75])
def test_prior_overrides_truck_of_any_size_with_enough_support(
    share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a required support of 30 %, a third of the truck's points is enough."""
    monkeypatch.setattr(outliers, "_RANSAC", outliers._RANSAC._replace(prior_min_support_share=0.3))
    wall, truck = scene(200, 32, (15.0, 40.0)), scene(200, 33, (7.0, 8.0))
    still, passing = round(200 * (1 - share)), round(200 * share)
    p = np.concatenate([wall[:still], truck[:passing]])
    uv = np.concatenate(
        [
            pixels(np.eye(4), wall[:still], 34),
            pixels(se3_exp([0.8, 0.0, 0.0, 0.0, 0.1, 0.0]), truck[:passing], 35),
        ]
    )
    predicted = se3_exp([0.05, 0.0, -0.1, 0.0, 0.002, 0.0])
    for R_prior, T_prior in ((np.eye(3), None), (None, predicted)):
        found = rigid_consensus(make_problem(), p, uv, np.eye(4), R_prior, T_prior)
        assert found.inliers[:still].mean() > 0.95
        assert not found.inliers[still:].any()
