"""The KLT front end on rendered images with known ground truth: errors, effects, occlusion, ids,
determinism.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest

from tools.frontend_accuracy import Tally, accuracy_scenario, evaluate, figures
from vio.frontend import FrontendSettings, build_frontend
from vio.frontend.settings import GridSettings
from vio.geometry.distortion import rectified_camera
from vio.geometry.lie import se3_from_parts
from vio.protocols import Frontend
from vio.records import FrontendOutput, StereoFrame, TrackPrior
from vio.sim.motion import look_rotation, spline_from_waypoints
from vio.sim.render import correspondence
from vio.sim.rigs import small_rig
from vio.sim.scenarios import EFFECTS, plan
from vio.sim.sequence import SimulatedRecording, Simulation, simulate, views
from vio.sim.world import MovingBox, World, room

FEATURES = 150
FRAMES = 16
SIZE_PX = 376
BARE_SURFACES = (0, 2)  # the walls +x and +y are the first surfaces of a room
ON_THE_IMAGE = [name for name in EFFECTS if name not in ("dropped", "duplicated", "time-offset")]


class Recorder:
    """A front end that records the outputs of another one."""

    def __init__(self, frontend: Frontend) -> None:
        self._frontend = frontend
        self.outputs: list[FrontendOutput] = []

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        self.outputs.append(self._frontend.process(frame, prior))
        return self.outputs[-1]


@dataclass(frozen=True)
class Case:
    simulation: Simulation
    frames: list[StereoFrame]
    outputs: list[FrontendOutput]
    tally: Tally
    figures: dict[str, Any]


def run(simulation: Simulation, frames: list[StereoFrame]) -> Case:
    recording = SimulatedRecording(simulation)
    settings = FrontendSettings(grid=GridSettings(target_features=FEATURES))
    recorder = Recorder(
        build_frontend("klt", rectified_camera(simulation.rig), settings, recording)
    )
    tally = evaluate(simulation, frames, recorder)
    return Case(simulation, frames, recorder.outputs, tally, figures(tally))


def rendered(simulation: Simulation) -> list[StereoFrame]:
    recording = SimulatedRecording(simulation)
    return [recording.frame(k) for k in range(len(recording))]


def latest(simulation: Simulation) -> Simulation:
    """The last frames only."""
    return replace(
        simulation, taken_ns=simulation.taken_ns[-FRAMES:], stamps_ns=simulation.stamps_ns[-FRAMES:]
    )


@pytest.fixture(scope="module")
def world() -> World:
    return room(1)


@pytest.fixture(scope="module")
def case(world: World) -> Callable[[str | None], Case]:
    """The last frames of a two-second flight, at full speed, under an effect; each is rendered
    once.
    """
    made: dict[str | None, Case] = {}

    def build(effect: str | None) -> Case:
        if effect not in made:
            simulation = plan(accuracy_scenario(effect, frames=40 + FRAMES, width=SIZE_PX))
            if effect not in ("bare-wall", "moving"):
                simulation = replace(simulation, world=world)
            simulation = latest(simulation)
            made[effect] = run(simulation, rendered(simulation))
        return made[effect]

    return build


# --- accuracy
# --------------------------------------------------------------------------------------------------


def test_tracks_and_disparities_in_the_room_are_accurate(
    case: Callable[[str | None], Case],
) -> None:
    measured = case(None).figures
    step, birth, disparity, row = (
        measured[name] for name in ("step", "since_birth", "disparity", "row")
    )
    assert step["count"] > 0.8 * FEATURES * (FRAMES - 1)
    assert step["median_px"] < 0.06
    assert step["outliers"] < 0.01
    assert np.abs(step["bias_px"]).max() < 0.01
    assert birth["median_px"] < 0.09
    assert birth["outliers"] < 0.03
    assert disparity["count"] > 0.8 * FEATURES * FRAMES
    assert disparity["median_px"] < 0.05
    assert disparity["outliers"] < 0.025
    assert abs(disparity["bias_px"]) < 0.01
    assert row["median_px"] < 0.03


def test_tracks_in_the_room_are_long_and_corners_repeatable(
    case: Callable[[str | None], Case],
) -> None:
    measured = case(None).figures
    assert measured["recall"] > 0.97
    assert measured["life_mean"] > 0.5 * FRAMES
    # the strongest 150 corners are closer together than tracks may be
    assert measured["corner_recall"] > 0.25


@pytest.mark.parametrize("effect", ON_THE_IMAGE)
def test_errors_stay_small_under_every_effect(
    effect: str, case: Callable[[str | None], Case]
) -> None:
    """Noise doubles the error; darkness, with a signal of 8 gray levels, makes it six times as
    large.
    """
    measured = case(effect).figures
    if effect == "dark" and measured["step"] is None:
        return  # no corners, so no errors
    assert measured["step"]["median_px"] < {"noise": 0.2, "dark": 0.5}.get(effect, 0.1)
    assert measured["disparity"]["median_px"] < {"noise": 0.12, "dark": 0.4}.get(effect, 0.1)
    for name, share in (("step", 0.02), ("disparity", 0.1 if effect == "dark" else 0.04)):
        count = measured[name]["count"]
        assert measured[name]["outliers"] * count <= share * count + 2


@pytest.mark.parametrize("effect", [name for name in ON_THE_IMAGE if name != "dark"])
def test_tracks_survive_every_effect_but_darkness(
    effect: str, case: Callable[[str | None], Case]
) -> None:
    measured = case(effect).figures
    assert measured["features_least"] > 0.7 * FEATURES
    assert measured["stereo_least"] > 0.6 * FEATURES
    assert measured["recall"] > 0.93


def test_darkness_gives_few_tracks(case: Callable[[str | None], Case]) -> None:
    assert case("dark").figures["features_median"] < 0.5 * case(None).figures["features_median"]


def test_bare_wall_has_no_tracks() -> None:
    """Noise on an untextured surface gives no corners: all features are near an outline."""
    # ends before a bare wall
    facing = plan(accuracy_scenario("bare-wall", frames=100, width=SIZE_PX))
    tracked = run(last := latest(facing), rendered(last))
    recording = SimulatedRecording(last)
    share, on_wall, features = [], 0, 0
    for time_ns, output in zip(last.taken_ns.tolist(), tracked.outputs, strict=True):
        bare = np.isin(recording.depth(0, time_ns)[1], BARE_SURFACES).astype(np.uint8)
        share.append(bare.mean())
        inner = cv2.erode(bare, np.ones((17, 17), np.uint8), borderValue=1)
        at = np.rint(output.observations.z[:, :2]).astype(int)
        on_wall += int(inner[at[:, 1], at[:, 0]].sum())
        features += len(output.observations)
    assert np.mean(share) > 0.7
    assert features > 20 * FRAMES
    assert on_wall <= 0.01 * features


# --- dropped and duplicated frames
# ------------------------------------------------------------------------------------


def with_times(simulation: Simulation, source: list[int]) -> Simulation:
    """The simulation with the frames `source`; with duplicates, stamps continue at the frame
    rate.
    """
    taken = simulation.taken_ns[source]
    stamps = simulation.stamps_ns[: len(source)] if len(set(source)) < len(source) else taken
    return replace(simulation, taken_ns=taken, stamps_ns=stamps)


def test_tracks_bridge_dropped_frames(case: Callable[[str | None], Case]) -> None:
    plain = case(None)
    kept = [0, 1, 2, 4, 5, 8, 9, 10, 13, 14]
    frames = [replace(plain.frames[k], index=i) for i, k in enumerate(kept)]
    dropped = run(with_times(plain.simulation, kept), frames)
    assert dropped.figures["recall"] > 0.9
    assert dropped.figures["step"]["median_px"] < 0.08
    assert dropped.figures["step"]["outliers"] < 0.02


def test_tracks_do_not_move_in_duplicated_frames(case: Callable[[str | None], Case]) -> None:
    plain = case(None)
    source = [0, 1, 2, 2, 3, 4, 5, 5, 5, 6, 7, 8]
    simulation = with_times(plain.simulation, source)
    frames = [
        replace(plain.frames[k], index=i, time_ns=int(simulation.stamps_ns[i]))
        for i, k in enumerate(source)
    ]
    repeated = run(simulation, frames)
    assert repeated.figures["recall"] > 0.97
    assert repeated.figures["step"]["median_px"] < 0.06
    assert repeated.figures["step"]["outliers"] < 0.01
    for k, (a, b) in enumerate(pairwise(source)):
        if a == b:
            before, after = repeated.outputs[k].observations, repeated.outputs[k + 1].observations
            _, i, j = np.intersect1d(before.ids, after.ids, return_indices=True)
            assert len(i) > 0.95 * len(before)
            moved = np.abs(before.z[i, :2] - after.z[j, :2]).max(axis=1)
            assert np.median(moved) < 0.02
            assert moved.max() < 0.5


# --- occlusion
# --------------------------------------------------------------------------------------------------


def test_tracks_end_at_occlusions() -> None:
    """Poles in front of the wall occlude tracks while the camera passes by."""
    y = np.linspace(-0.9, 0.9, 19)
    R = look_rotation(np.tile([1.0, 0.0, 0.0], (len(y), 1)))
    T = se3_from_parts(R, np.stack([-0.4 + 0.2 * y, y, 1.4 + 0.2 * np.sin(5 * y)], axis=1))
    scene = room(
        3, moving=[_pole(side) for side in (-0.9, -0.3, 0.3, 0.9)], furniture=0, texel_m=0.004
    )
    simulation = simulate(
        scene, small_rig(SIZE_PX, 240), spline_from_waypoints(T, 0.1), rate_hz=20.0, seed=3
    )
    passed = run(simulation, rendered(simulation))
    hidden = _hidden(passed)
    assert hidden > 30
    assert passed.figures["step"]["outliers"] < 0.02
    stays = np.array(list(passed.tally.crossed.values()), dtype=int)
    assert np.sum(stays > 3) <= 0.05 * hidden
    assert stays.max(initial=0) <= 8


def _pole(y: float) -> MovingBox:
    """A stationary box in the shape of a pole; a moving box can be placed anywhere."""
    T = se3_from_parts(np.eye(3), np.array([1.6, y, 1.4]))
    return MovingBox(np.array([0.15, 0.15, 1.8]), lambda time_ns: T)


def _hidden(case: Case) -> int:
    """Count the features whose point is occluded in the next frame."""
    count = 0
    for k, output in enumerate(case.outputs[:-1]):
        times = case.simulation.taken_ns[k : k + 2].tolist()
        last, now = (views(case.simulation, time_ns)[0] for time_ns in times)
        there, visible = correspondence(
            case.simulation.world, last, now, output.observations.z[:, :2]
        )
        inside = ((there > 12) & (there < [SIZE_PX - 13, 227])).all(axis=1)
        count += int((inside & ~visible).sum())
    return count


# --- contract
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", [None, *ON_THE_IMAGE])
def test_ids_are_never_reused_and_disparities_are_positive(
    effect: str | None, case: Callable[[str | None], Case]
) -> None:
    outputs = case(effect).outputs
    assert case(effect).tally.reused == 0
    newest, before = -1, set[int]()
    for output in outputs:
        seen = output.observations
        ids = set(seen.ids.tolist())
        assert all(name > newest for name in ids - before)
        newest, before = max([newest, *ids]), ids
        stereo = seen.z[seen.has_right]
        assert (stereo[:, 0] - stereo[:, 2] > 0).all()


def test_equal_images_give_identical_output(case: Callable[[str | None], Case]) -> None:
    once = case("noise")
    again = run(once.simulation, rendered(once.simulation))
    for a, b in zip(once.outputs, again.outputs, strict=True):
        for name in ("ids", "z", "has_right", "stale"):
            np.testing.assert_array_equal(
                getattr(a.observations, name), getattr(b.observations, name)
            )
