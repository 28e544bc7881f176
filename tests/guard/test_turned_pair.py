"""A right camera that is turned from the start, in rendered images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import vio
from tests.frontend.test_frontend_scene import CAMERA, flight, stereo_frame
from tests.guards import codes
from tools.faults.cameras import turned_right
from tools.faults.changes import Changed, Period, pairs
from vio.calibration.pair_rotation import turned_pixels
from vio.config import load_config
from vio.findings import Finding
from vio.frontend import build_frontend
from vio.frontend.settings import FrontendSettings, GridSettings
from vio.geometry.lie import FloatArray
from vio.guard.guarded import GuardedFrontend, guarded
from vio.guard.image_check import images_of
from vio.guard.probe import RowProbe
from vio.guard.repairing import AS_READ, Repair, repaired
from vio.guard.turned_pair import TurnedPair, turned_back
from vio.offline.run_images import run_images
from vio.protocols import Dataset
from vio.records import FrontendOutput, Image, StereoFrame
from vio.runs.checkpoint import load_checkpoint, save_checkpoint
from vio.runs.folder import write_run_folder
from vio.runs.pipeline import RunResult, run
from vio.sim.export import export_euroc
from vio.sim.scenarios import Scenario, plan
from vio.sim.sequence import SimulatedRecording

FRAMES = 10
SETTINGS = FrontendSettings(grid=GridSettings(target_features=150))
ROLLED = (0.0, 0.0, 1.0)
YAWED = (0.0, 1.0, 0.0)
TURNED = (0.6, -0.5, 0.62)  # a unit vector


@cache
def frames() -> tuple[StereoFrame, ...]:
    return tuple(stereo_frame(k, pose) for k, pose in enumerate(flight(FRAMES)))


def turned(axis: tuple[float, float, float], degrees: float) -> list[StereoFrame]:
    """The frames of a right camera that is turned."""
    H = turned_pixels(CAMERA, np.radians(degrees) * np.array(axis))
    return [replace(frame, right=_warped(frame.right, H)) for frame in frames()]


def _warped(image: Image | None, H: FloatArray) -> Image:
    assert image is not None
    return np.asarray(cv2.warpPerspective(image, H, image.shape[::-1]), dtype=np.uint8)


def angles_deg(finding: Finding) -> list[float]:
    return [finding.figures[f"turned_{axis}_deg"] for axis in "xyz"]


@pytest.mark.parametrize(
    ("name", "axis", "degrees"),
    [("klt", ROLLED, -2.0), ("klt", TURNED, 1.2), ("orb", TURNED, -2.0), ("sift", ROLLED, 1.2)],
)
def test_a_turned_camera_is_found_and_turned_back_for_every_front_end(
    name: str, axis: tuple[float, float, float], degrees: float
) -> None:
    frontend = guarded(build_frontend(name, CAMERA, SETTINGS), CAMERA)
    outputs = [frontend.process(frame) for frame in turned(axis, degrees)]
    (finding,) = [f for output in outputs for f in output.findings]
    assert finding.code == "right-camera-turned"
    assert (finding.frame, finding.first_frame) == (5, 0)
    np.testing.assert_allclose(angles_deg(finding), degrees * np.array(axis), atol=0.06)
    assert [len(output.observations) > 0 for output in outputs] == [False] * 5 + [True] * 5
    healthy = guarded(build_frontend(name, CAMERA, SETTINGS), CAMERA)
    expected = [healthy.process(frame) for frame in frames()]
    matched = outputs[-1].observations.has_right.mean()
    assert matched > 0.9 * expected[-1].observations.has_right.mean()


def _same(image: Image, other: Image) -> float:
    """Mean difference inside of the border."""
    inner = slice(40, -40)
    return float(np.abs(image[inner, inner].astype(float) - other[inner, inner]).mean())


def test_images_are_turned_back_to_what_a_calibrated_camera_shows() -> None:
    rotation = np.radians(1.0) * np.array(TURNED)
    (frame, *_) = turned(TURNED, 1.0)
    assert frame.right is not None
    true = frames()[0].right
    assert true is not None
    back = turned_back(frame.right, CAMERA, rotation)
    assert _same(back, true) < 2.5 < 5 * _same(back, true) < _same(frame.right, true)


def outputs_of(given: list[StereoFrame]) -> list[FrontendOutput]:
    frontend = guarded(build_frontend("klt", CAMERA, SETTINGS), CAMERA)
    return [frontend.process(frame) for frame in given]


def _mirrored(frame: StereoFrame) -> StereoFrame:
    assert frame.left is not None
    assert frame.right is not None
    return replace(frame, left=frame.right[:, ::-1].copy(), right=frame.left[:, ::-1].copy())


def _dark(frame: StereoFrame) -> StereoFrame:
    assert frame.left is not None
    assert frame.right is not None
    return replace(frame, left=frame.left // 6, right=frame.right // 6)


@pytest.mark.parametrize(
    "change", [lambda f: f, _mirrored, _dark], ids=["as is", "mirrored", "dark"]
)
def test_healthy_pairs_are_left_as_they_are(change: Callable[[StereoFrame], StereoFrame]) -> None:
    camera = CAMERA
    check = TurnedPair(camera, RowProbe())
    for frame in frames():
        images = images_of(change(frame), pair=True)
        assert images is not None
        assert check.inspect(images) is images
    assert codes(outputs_of([change(frame) for frame in frames()])) == []


@pytest.mark.parametrize("axis", [ROLLED, (1.0, 0.0, 0.0)])
def test_a_tenth_of_a_degree_is_left_to_the_filter(axis: tuple[float, float, float]) -> None:
    assert "right-camera-turned" not in codes(outputs_of(turned(axis, 0.12)))


@pytest.mark.parametrize("delay", [-3, -2, -1, 1, 2, 3])
def test_pairs_of_two_times_are_not_those_of_a_turned_camera(delay: int) -> None:
    """Here the rig turns by nearly the same in each frame, so that rows are alike in all pairs."""
    late = [
        replace(frame, right=frames()[frame.index - delay].right)
        for frame in frames()
        if 0 <= frame.index - delay < FRAMES
    ]
    assert "right-camera-turned" not in codes(outputs_of(late))


def test_a_rig_at_standstill_is_waited_for_and_then_judged_by_its_rows() -> None:
    still = [replace(turned(ROLLED, 1.0)[0], index=k, time_ns=k * 50_000_000) for k in range(30)]
    outputs = outputs_of(still)
    (finding,) = [f for o in outputs for f in o.findings if f.code == "right-camera-turned"]
    assert angles_deg(finding)[2] == pytest.approx(1.0, abs=0.05)
    assert finding.frame == 25  # 20 frames without motion, and six pairs


def test_a_checkpoint_amid_the_pairs_goes_on_to_the_same_rotation(tmp_path: Path) -> None:
    def fed(check: TurnedPair, given: list[StereoFrame]) -> TurnedPair:
        for frame in given:
            images = images_of(frame, pair=True)
            assert images is not None
            check.inspect(images)
        return check

    given = turned(ROLLED, 1.2)
    check = fed(TurnedPair(CAMERA, RowProbe()), given[:3])
    source: Any = SimpleNamespace(observations=None)
    save_checkpoint(tmp_path / "state", check, source)
    again = fed(load_checkpoint(tmp_path / "state", source), given[3:])
    np.testing.assert_array_equal(again.rotation, fed(check, given[3:]).rotation)
    assert again.rotation is not None


def test_one_camera_and_cylinders_have_no_such_check() -> None:
    cylinder = replace(CAMERA, projection="cylinder")
    check = TurnedPair(cylinder, RowProbe())
    for frame in turned(ROLLED, 1.0):
        images = images_of(frame, pair=True)
        assert images is not None
        assert check.inspect(images) is images
    frontend = GuardedFrontend(
        build_frontend("klt", replace(CAMERA, kind="mono"), SETTINGS), replace(CAMERA, kind="mono")
    )
    assert frontend.turned_back is None


# Whole runs


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("turned") / "flight"
    scenario = Scenario(duration_s=2.0, width=376, seed=4)
    export_euroc(SimulatedRecording(plan(scenario)), folder)
    return vio.open_dataset(folder)


def run_turned(dataset: Dataset, axis: tuple[float, float, float], degrees: float) -> RunResult:
    source = Changed(dataset, dataset.recording, iter)
    changed = pairs(turned_right, degrees, axis, all_along=True)(source, Period(0, 1))
    return run(changed, load_config(overrides=["motion=none"]))


def worst_m(result: RunResult, other: RunResult) -> float:
    T, T_other = result.trajectory, other.trajectory
    np.testing.assert_array_equal(T.frame_indices, T_other.frame_indices)
    return float(np.linalg.norm(T.positions - T_other.positions, axis=1).max())


@pytest.mark.parametrize(
    ("axis", "degrees"), [(ROLLED, 1.0), (YAWED, 1.5), (YAWED, -0.6), (TURNED, 2.0)]
)
def test_a_run_begins_again_and_goes_the_healthy_way(
    rendered: Dataset, axis: tuple[float, float, float], degrees: float
) -> None:
    healthy = run_turned(rendered, axis, 0.0)
    result = run_turned(rendered, axis, degrees)
    assert "right-turn-put-right" in [f.code for f in result.findings]
    assert "right-camera-turned" not in [f.code for f in result.findings]
    assert result.repair.turn is not None
    np.testing.assert_allclose(np.degrees(result.repair.turn), degrees * np.array(axis), atol=0.12)
    assert worst_m(result, healthy) < 0.004  # of 1 m
    assert not [f for f in healthy.findings if "turn" in f.code]


def test_the_saved_calibration_holds_the_turn(rendered: Dataset) -> None:
    result = run_turned(rendered, ROLLED, 1.0)
    found = result.calibrated_rig()
    assert found is not None
    assert np.degrees(found.parameters[2]) == pytest.approx(1.0, abs=0.05)
    _, T = found.rig.right
    assert np.degrees(np.arctan2(T[1, 0], T[0, 0])) == pytest.approx(1.0, abs=0.05)


def test_the_folder_says_what_was_put_right_and_gives_such_images(
    rendered: Dataset, tmp_path: Path
) -> None:
    result = run_turned(rendered, ROLLED, 1.0)
    metrics = write_run_folder(tmp_path / "out", result, None)
    repair = Repair.of_json(metrics["right_images"])
    assert repair == result.repair
    images = run_images(tmp_path / "out", metrics)
    # the recording itself is as calibrated: turned back once more, it is turned by -1 degree
    (frame,) = images.frames(np.array([3]), str(rendered.recording.path))
    ((seen,)) = [event for event in rendered.events(3, 4) if isinstance(event, StereoFrame)]
    assert frame.right is not None
    assert seen.right is not None
    assert repair.turn is not None
    expected = turned_back(seen.right, result.recording.camera, np.array(repair.turn))
    assert _same(frame.right, expected) < 2.0 < _same(seen.right, expected)


def test_live_use_goes_on_with_images_turned_back(rendered: Dataset) -> None:
    camera = rendered.recording.camera
    odometry = vio.Odometry(camera)
    source = Changed(rendered, rendered.recording, iter)
    changed = pairs(turned_right, 1.0, ROLLED, all_along=True)(source, Period(0, 1))
    for event in changed.events():
        if isinstance(event, StereoFrame):
            odometry.add_stereo(event.time_ns, event.left, event.right)
    assert [f.code for f in odometry.findings if f.effect != "nominal"] == ["right-camera-turned"]
    found = odometry.calibrated_rig().parameters[2]
    assert np.degrees(found) == pytest.approx(1.0, abs=0.05)
    assert odometry.estimate is not None
    assert odometry.estimate.integrity == "nominal"


# What is put right


def test_a_repair_holds_each_kind_once() -> None:
    def found(code: str, since: int = 0, **figures: float) -> Finding:
        return Finding(code, "text", 5, since, figures=figures)

    three = {"turned_x_deg": 1.0, "turned_y_deg": 0.0, "turned_z_deg": -2.0}
    late = AS_READ.adding(found("pairs-shifted", delay_frames=-2.0))
    assert (late.delay, bool(late), bool(AS_READ)) == (-2, True, False)
    both = late.adding(found("right-camera-turned", **three))
    np.testing.assert_allclose(np.degrees(both.turn), [1.0, 0.0, -2.0])
    assert both.adding(found("pairs-shifted", delay_frames=1.0)) is both
    assert both.adding(found("right-camera-turned", **three)) is both
    assert AS_READ.adding(found("right-camera-turned", since=3, **three)) is AS_READ
    assert AS_READ.adding(found("right-camera-turned", turned_deg=1.0)) is AS_READ
    assert [code for code, _ in both.lines()] == ["right-turn-put-right", "pairs-put-right"]
    assert Repair.of_json(both.to_json()) == both
    assert AS_READ.to_json() is None


def test_late_pairs_of_a_turned_camera_are_put_right_together() -> None:
    rotation = tuple(np.radians([0.0, 0.0, 1.0]).tolist())
    rolled = turned(ROLLED, 1.0)
    late: list[StereoFrame] = [
        replace(frame, right=rolled[frame.index - 1].right) for frame in rolled[1:]
    ]
    out = list(repaired(late, Repair(1, rotation), CAMERA))
    for event in out:
        assert isinstance(event, StereoFrame)
        assert event.right is not None
        true = frames()[event.index].right
        assert true is not None
        assert _same(event.right, true) < 2.5


def test_nothing_to_put_right_changes_nothing() -> None:
    given = list(frames())
    assert list(repaired(given, AS_READ, CAMERA)) == given


def _turning(begin: int, end: int, count: int = 36) -> list[StereoFrame]:
    """Frames of a right camera that is turned in some of them."""
    H = turned_pixels(CAMERA, np.radians(1.2) * np.array(TURNED))
    found = []
    for k, pose in enumerate(flight(count)):
        frame = stereo_frame(k, pose)
        is_turned = begin <= k < end
        found.append(replace(frame, right=_warped(frame.right, H)) if is_turned else frame)
    return found


@pytest.mark.parametrize("name", ["klt", "orb"])
def test_a_camera_that_turns_during_a_run_is_turned_back_once_it_contradicts(name: str) -> None:
    frontend = guarded(build_frontend(name, CAMERA, SETTINGS), CAMERA)
    outputs = [frontend.process(frame) for frame in _turning(8, 36)]
    assert codes(outputs) == [
        "right-contradicts-left",
        "right-camera-turned",
        "-right-contradicts-left",
    ]
    finding = next(f for output in outputs for f in output.findings if "turned" in f.code)
    assert finding.first_frame in (8, 9)
    np.testing.assert_allclose(angles_deg(finding), 1.2 * np.array(TURNED), atol=0.06)
    assert AS_READ.adding(finding) == AS_READ  # it was in order before
    assert outputs[-1].observations.has_right.mean() > 0.7


def test_a_camera_that_turns_to_and_fro_is_used_as_given_again() -> None:
    frontend = guarded(build_frontend("klt", CAMERA, SETTINGS), CAMERA)
    outputs = [frontend.process(frame) for frame in _turning(8, 24)]
    assert codes(outputs).count("-right-contradicts-left") == 2
    assert frontend.turned_back is None
    assert outputs[-1].observations.has_right.mean() > 0.7


def test_images_that_are_turned_back_to_no_avail_are_used_as_given() -> None:
    check = TurnedPair(CAMERA, RowProbe())
    check.take([Finding("right-contradicts-left", "", 5, 3, lasts=True)])
    check.rotation = np.array([0.01, 0.0, 0.0])
    given = images_of(frames()[0], pair=True)
    assert given is not None
    for k in range(21):
        assert check.rotation is not None, k
        check._looks_at = None
        check.inspect(given)
    assert check.rotation is None
    assert check.inspect(given).raw[1] is given.raw[1]
