"""The checks of the images, the same for every front end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA, flight, stereo_frame
from tests.guards import codes
from tools.faults.cameras import Wall, moving_object
from tools.faults.changes import Changed, Period
from vio.calibration.pair_rotation import turned_pixels
from vio.findings import CODES
from vio.frontend import build_frontend
from vio.frontend.precomputed import PrecomputedFrontend
from vio.frontend.settings import FrontendSettings, GridSettings
from vio.guard.exchange import ExchangeDetector
from vio.guard.guarded import GuardedFrontend, guarded
from vio.guard.image_check import images_of
from vio.guard.pairing import PairingCheck, find_delay, told_delay
from vio.guard.probe import RowProbe
from vio.guard.repairing import Repair, repaired
from vio.records import (
    FrontendOutput,
    ImuSample,
    Recording,
    StereoFrame,
    TrackPrior,
    no_features,
    observations,
)

FRAMES = 12
FAULT = range(4, 8)
FRONT_ENDS = ("klt", "orb", "sift")
SETTINGS = FrontendSettings(grid=GridSettings(target_features=150))
Change = Callable[[StereoFrame], StereoFrame]


@cache
def frames() -> tuple[StereoFrame, ...]:
    return tuple(stereo_frame(k, pose) for k, pose in enumerate(flight(FRAMES)))


def run(name: str, change: Change | None = None) -> list[FrontendOutput]:
    """Outputs of a front end between the checks; `change` makes the fault."""
    frontend = guarded(build_frontend(name, CAMERA, SETTINGS), CAMERA)
    changed = [change(frame) if change and frame.index in FAULT else frame for frame in frames()]
    return [frontend.process(frame) for frame in changed]


def _frozen_right(frame: StereoFrame) -> StereoFrame:
    return replace(frame, right=frames()[FAULT.start - 1].right)


def _frozen_left(frame: StereoFrame) -> StereoFrame:
    return replace(frame, left=frames()[FAULT.start - 1].left)


def _dark_right(frame: StereoFrame) -> StereoFrame:
    assert frame.right is not None
    return replace(frame, right=np.full_like(frame.right, 5))


def _exchanged(frame: StereoFrame) -> StereoFrame:
    return replace(frame, left=frame.right, right=frame.left)


def _black(frame: StereoFrame) -> StereoFrame:
    assert frame.left is not None
    return replace(frame, left=np.zeros_like(frame.left), right=np.zeros_like(frame.left))


@pytest.mark.parametrize("name", FRONT_ENDS)
def test_healthy_images_are_silent(name: str) -> None:
    outputs = run(name)
    assert codes(outputs) == []
    assert all(output.observations.has_right.mean() > 0.5 for output in outputs)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (_frozen_right, "right-image-frozen"),
        (_dark_right, "right-image-dark"),
        (_exchanged, "images-exchanged"),
    ],
    ids=["frozen", "dark", "exchanged"],
)
@pytest.mark.parametrize("name", FRONT_ENDS)
def test_every_front_end_reports_a_faulty_camera_once(name: str, change: Change, code: str) -> None:
    assert codes(run(name, change)) == [code, f"-{code}"]


@pytest.mark.parametrize("name", FRONT_ENDS)
def test_no_right_pixel_of_a_frozen_image_is_output(name: str) -> None:
    outputs = run(name, _frozen_right)
    for output in outputs:
        index = output.observations.frame_index
        assert not (index in FAULT and output.observations.has_right.any())
    assert outputs[-1].observations.has_right.mean() > 0.5
    assert min(len(output.observations) for output in outputs) > 30


@pytest.mark.parametrize("name", FRONT_ENDS)
def test_exchanged_images_are_put_back_to_the_bit(name: str) -> None:
    for expected, found in zip(run(name), run(name, _exchanged), strict=True):
        np.testing.assert_array_equal(found.observations.ids, expected.observations.ids)
        np.testing.assert_array_equal(found.observations.z, expected.observations.z)


@pytest.mark.parametrize("name", ["orb", "sift"])
def test_a_right_camera_that_turns_is_reported_by_its_rows(name: str) -> None:
    """It rolls by a degree; `klt` finds that by its own matches."""
    turns = cv2.getRotationMatrix2D((CAMERA.cu, CAMERA.cv), 1.0, 1.0)
    frontend = guarded(build_frontend(name, CAMERA, SETTINGS), CAMERA)
    outputs = []
    for frame in frames():
        if frame.index >= 7:
            assert frame.right is not None
            turned = cv2.warpAffine(frame.right, turns, frame.right.shape[::-1])
            frame = replace(frame, right=np.asarray(turned, dtype=np.uint8))
        outputs.append(frontend.process(frame))
    assert codes(outputs) == ["right-contradicts-left"]
    assert [bool(o.observations.has_right.any()) for o in outputs] == [k < 7 for k in range(FRAMES)]


def with_wall(name: str) -> list[FrontendOutput]:
    """Outputs of a front end, with a wall that moves over half of the image from frame 6 on."""
    recording = Recording(
        "images", Path("made"), CAMERA, None, np.arange(FRAMES), True, frozenset(), None
    )
    dataset = Changed(None, recording, iter)  # type: ignore[arg-type]
    begin_ns = frames()[6].time_ns
    wall = moving_object(dataset, Period(begin_ns, 10**18), Wall(6.0, 0.5, 0.3, 20))
    frontend = guarded(build_frontend(name, CAMERA, SETTINGS), CAMERA)
    outputs = []
    for frame in frames():
        left, right = wall(frame, frame.left, frame.right)
        outputs.append(frontend.process(replace(frame, left=left, right=right)))
    return outputs


@pytest.mark.parametrize("name", FRONT_ENDS)
def test_an_object_over_half_the_image_is_not_output(name: str) -> None:
    """It comes when the scene has been seen for some frames; both have as much texture. Key points
    on it are hardly taken, so that it need not be named.
    """
    outputs = with_wall(name)
    assert codes(outputs) == (["object-covers-image"] if name == "klt" else [])
    for before, output in pairwise(outputs[7:]):
        u = output.observations.z[np.isin(output.observations.ids, before.observations.ids), 0]
        covered = (u > 0.33 * CAMERA.width) & (u < 0.77 * CAMERA.width)
        assert covered.mean() < 0.1
        assert (~covered).sum() > 20


@pytest.mark.parametrize("name", FRONT_ENDS)
def test_features_are_followed_in_the_right_image_while_the_left_one_is_frozen(name: str) -> None:
    outputs = run(name, _frozen_left)
    assert codes(outputs) == ["left-image-frozen", "-left-image-frozen"]
    healthy = run(name)
    for k in FAULT:
        seen = outputs[k].observations
        assert len(seen) > 30
        assert np.isin(seen.ids, healthy[FAULT.start - 1].observations.ids).all()


@pytest.mark.parametrize("name", FRONT_ENDS)
def test_tracks_outlast_black_frames(name: str) -> None:
    outputs = run(name, _black)
    before = outputs[FAULT.start - 1].observations.ids
    after = outputs[FAULT.stop].observations.ids
    assert [len(outputs[k].observations) for k in FAULT] == [0] * len(FAULT)
    assert np.isin(before, after).mean() > 0.2


class OwnFrontend:
    """A front end of one's own, which knows nothing of checks: it believes every right image."""

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        z = np.tile([200.0, 100.0, 190.0, 100.0], (30, 1))
        seen = observations(frame.index, frame.time_ns, np.arange(30), z)
        return FrontendOutput(seen, 30, 30, 0)


def test_a_front_end_of_ones_own_loses_the_right_pixels_of_a_frozen_camera() -> None:
    frontend = GuardedFrontend(OwnFrontend(), CAMERA)
    outputs = [frontend.process(_frozen_right(f) if f.index in FAULT else f) for f in frames()]
    used = [bool(output.observations.has_right.all()) for output in outputs]
    assert used == [k not in FAULT for k in range(FRAMES)]
    assert codes(outputs) == ["right-image-frozen", "-right-image-frozen"]
    assert outputs[5].matched == 0


def test_frames_without_images_are_handed_on() -> None:
    seen = observations(0, 0, [1], [[200.0, 100.0, 190.0, 100.0]])
    frontend = GuardedFrontend(PrecomputedFrontend(lambda index: seen), CAMERA)
    output = frontend.process(StereoFrame(0, 0, None, None))
    assert output.observations is seen
    assert guarded(frontend, CAMERA) is frontend


def test_every_code_is_documented() -> None:
    for name, code in CODES.items():
        assert name == name.lower()
        assert code.meaning
        assert code.effect in ("nominal", "degraded", "unusable")


# Pairs of different times


def shifted(delay: int) -> list[StereoFrame]:
    """Frames whose right images are late by some frames."""
    pairs = frames()
    return [
        replace(pair, right=pairs[pair.index - delay].right)
        for pair in pairs
        if 0 <= pair.index - delay < FRAMES
    ]


@pytest.mark.parametrize("delay", range(-3, 4))
def test_finds_by_how_many_frames_right_images_are_late(delay: int) -> None:
    assert find_delay(shifted(delay), CAMERA) == delay


@cache
def long_flight() -> tuple[StereoFrame, ...]:
    return tuple(stereo_frame(k, pose) for k, pose in enumerate(flight(28)))


@pytest.mark.parametrize(("delay", "found"), [(5, 5), (-8, -8), (10, 10), (12, None)])
def test_finds_right_images_that_are_up_to_ten_frames_late(delay: int, found: int | None) -> None:
    """As of two videos that were begun one after the other."""
    pairs = long_flight()
    late = [
        replace(pair, right=pairs[pair.index - delay].right)
        for pair in pairs
        if 0 <= pair.index - delay < len(pairs)
    ]
    assert find_delay(late, CAMERA) == found


@pytest.mark.parametrize("moved", [4, -10])
def test_a_right_camera_whose_rows_are_off_is_not_late(moved: int) -> None:
    turned = [replace(pair, right=np.roll(pair.right, moved, axis=0)) for pair in long_flight()]
    assert find_delay(turned, CAMERA) in (0, None)


@pytest.mark.parametrize("delay", [-1, 1])
def test_rows_that_were_found_before_hide_no_delay(delay: int) -> None:
    """Images of two times may match best at rows that are those of no camera."""
    probe = RowProbe()
    pair = images_of(frames()[0], pair=True)
    assert pair is not None
    left, right = pair.halves
    probe.positive(left, np.roll(right, 6, axis=0), probe.corners(left))
    assert probe.on_rows(left, np.roll(right, 6, axis=0), probe.corners(left)) > 0
    check = PairingCheck(probe)
    for frame in shifted(delay):
        images = images_of(frame, pair=True)
        assert images is not None
        check.inspect(images)
    assert check.delay == delay


@pytest.mark.parametrize("rows", [-4, -3, -2, -1, 1, 2, 3, 4])
def test_a_pitched_right_camera_is_none_of_another_time(rows: int) -> None:
    """Among these is what the images move by in a frame, so that those of another frame match."""
    pitched = [replace(pair, right=np.roll(pair.right, rows, axis=0)) for pair in frames()]
    assert find_delay(pitched, CAMERA) in (0, None)


def _turned_later(rotation_deg: list[float]) -> list[StereoFrame]:
    """Frames whose right camera turns in its mount in the first frame of the fault."""
    H = turned_pixels(CAMERA, np.radians(rotation_deg))
    out = []
    for frame in frames():
        assert frame.right is not None
        right = cv2.warpPerspective(frame.right, H, frame.right.shape[::-1])
        later = replace(frame, right=np.asarray(right, dtype=np.uint8))
        out.append(later if frame.index >= FAULT.start else frame)
    return out


@pytest.mark.parametrize(
    "rotation_deg",
    [
        *([pitch, 0.0, 0.0] for pitch in (-1.2, -0.8, -0.4, 0.4, 0.8, 1.2)),
        *([0.0, yaw, 0.0] for yaw in (3.5, 4.5)),  # disparities of 15 px are negative
    ],
)
def test_a_right_camera_that_turns_is_neither_late_nor_exchanged(rotation_deg: list[float]) -> None:
    """The rows are off by what the images move by in a frame, or disparities are negative."""
    frontend = guarded(build_frontend("klt", CAMERA, SETTINGS), CAMERA)
    found = codes([frontend.process(frame) for frame in _turned_later(rotation_deg)])
    assert set(found) == {"right-contradicts-left"}


def test_pairs_of_a_rig_at_standstill_are_not_judged() -> None:
    still = [replace(frames()[0], index=k, time_ns=k) for k in range(10)]
    assert find_delay(still, CAMERA) is None


@pytest.mark.parametrize(
    ("counts", "delay"),
    [
        ((80, {0: 60, 1: 20, -1: 20}), 0),
        ((80, {0: 20, 1: 60, -1: 20}), 1),
        ((80, {0: 20, 1: 20, -1: 60}), -1),
        ((80, {0: 20, 1: 35, 2: 60}), 2),
        ((80, {0: 50, 1: 60, -1: 20}), None),  # not clearly
        ((80, {0: 20, 1: 50, 2: 60}), None),
        ((80, {0: 5, 1: 20, -1: 5}), None),  # hardly any match
        ((20, {0: 0, 1: 20, -1: 0}), None),  # few corners
    ],
)
def test_a_pairing_must_be_clearly_the_best(
    counts: tuple[int, dict[int, int]], delay: int | None
) -> None:
    assert told_delay(*counts) == delay


@pytest.mark.parametrize(
    ("name", "delay"),
    [(name, delay) for name in FRONT_ENDS for delay in (-1, 1)]
    + [("klt", delay) for delay in (-3, -2, 2, 3)],
)
def test_shifted_pairs_are_reported_in_the_first_frames(name: str, delay: int) -> None:
    frontend = guarded(build_frontend(name, CAMERA, SETTINGS), CAMERA)
    outputs = [frontend.process(frame) for frame in shifted(delay)]
    found = [f for output in outputs for f in output.findings if f.code == "pairs-shifted"]
    (finding,) = found
    assert finding.figures["delay_frames"] == delay
    assert finding.first_frame == 0
    assert finding.frame is not None
    assert finding.frame < 6 + abs(delay)


@pytest.mark.parametrize("delay", [-3, 2])
def test_shifted_pairs_are_found_although_their_images_look_exchanged(
    delay: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rig that turns gives images of two times negative disparities."""
    monkeypatch.setattr(ExchangeDetector, "order", lambda *args, **kwargs: "exchanged")
    frontend = guarded(build_frontend("klt", CAMERA, SETTINGS), CAMERA)
    outputs = [frontend.process(frame) for frame in shifted(delay)]
    assert "pairs-shifted" in [f.code for output in outputs for f in output.findings]


def test_exchanged_images_say_nothing_of_the_pairing() -> None:
    """Their matches are none of the pairs that come after them."""
    check = PairingCheck(RowProbe())
    exchanged = [replace(pair, left=pair.right, right=pair.left) for pair in frames()]
    for pair in [*exchanged, *exchanged[::-1], *frames()]:
        images = images_of(pair, pair=True)
        assert images is not None
        check.inspect(images)
    assert check.delay == 0


@pytest.mark.parametrize("delay", range(-3, 4))
def test_repaired_pairs_are_those_of_one_time_in_order(delay: int) -> None:
    sample = ImuSample(0, np.zeros(3), np.zeros(3))
    events: list[StereoFrame | ImuSample] = []
    for frame in shifted(delay):
        events += [frame, replace(sample, time_ns=frame.time_ns + 1)]
    out = list(repaired(events, Repair(delay), CAMERA))
    times = [event.time_ns for event in out]
    assert times == sorted(times)
    for event in out:
        if isinstance(event, StereoFrame):
            # right images that are early are those of their time: the left ones are late
            true = frames()[event.index - min(delay, 0)]
            np.testing.assert_array_equal(event.left, true.left)
            np.testing.assert_array_equal(event.right, true.right)
    count = sum(isinstance(event, StereoFrame) for event in out)
    assert count == FRAMES - 2 * abs(delay)


def test_no_features_has_no_findings() -> None:
    assert no_features(frames()[0]).findings == ()
