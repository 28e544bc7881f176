"""The faults and healthy variants of `tools.faults`: what they do to events, calibration and
reference.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA
from tools.faults import CAMERAS, GROUPS, HEALTHY, IMU
from tools.faults import __main__ as command
from tools.faults.__main__ import FIGURES, PAGE, RUNS, tasks
from tools.faults.cameras import reordered
from tools.faults.changes import Changed, Period
from tools.faults.page import page
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.records import Event, ImuSample, Observations, Recording, StereoFrame, Trajectory

FRAMES, STEP_NS = 20, 50_000_000
T_CAM0_IMU = se3_exp(np.array([0.05, -0.02, 0.01, 0.3, -0.2, 1.2]))
POSES = np.array(
    [se3_exp(k * np.array([0.02, -0.01, 0.05, 0.01, -0.02, 0.004])) for k in range(FRAMES)]
)
PERIOD = Period(8 * STEP_NS, 16 * STEP_NS)


@dataclass(frozen=True)
class _Flight:
    """Frames of noise and IMU samples; the reference is that of the IMU."""

    @property
    def recording(self) -> Recording:
        times = STEP_NS * np.arange(FRAMES)
        truth = Trajectory(T_world_body=POSES, times_ns=times, body="imu", frame_indices=None)
        return Recording(
            "fake", Path("flight"), CAMERA, T_CAM0_IMU, times, True, frozenset({"imu"}), truth
        )

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        for k in range(start, FRAMES if stop is None else stop):
            for part in range(16):
                rng = np.random.default_rng([k, part])
                yield ImuSample(
                    k * STEP_NS - part * STEP_NS // 16 + 15 * STEP_NS // 16,
                    *rng.normal(0, 1, (2, 3)),
                )
            left, right = np.random.default_rng(k).integers(0, 256, (2, 300, 480), dtype=np.uint8)
            yield StereoFrame(k, k * STEP_NS + 15 * STEP_NS // 16, left, right)

    def observations(self, index: int) -> Observations | None:
        return None


def _events() -> list[Event]:
    held = list(_Flight().events())
    return sorted(held, key=lambda event: (event.time_ns, isinstance(event, StereoFrame)))


class _Sorted(_Flight):
    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        yield from _events()


@pytest.mark.parametrize(
    ("group", "name"), [(g, n) for g, variants in GROUPS.items() for n in variants]
)
def test_every_variant_gives_valid_events_of_its_recording(group: str, name: str) -> None:
    changed = GROUPS[group][name](_Sorted(), PERIOD)
    events, recording = list(changed.events()), changed.recording
    frames = [event for event in events if isinstance(event, StereoFrame)]
    assert [frame.index for frame in frames] == list(range(len(recording.frame_times_ns)))
    assert all(a.time_ns <= b.time_ns for a, b in itertools.pairwise(events))
    samples = [event.time_ns for event in events if isinstance(event, ImuSample)]
    assert all(a < b for a, b in itertools.pairwise(samples))
    size = recording.camera.height, recording.camera.width
    assert all(image is not None and image.shape == size and image.dtype == np.uint8
               for frame in frames for image in (frame.left, frame.right))  # fmt: skip
    again = list(changed.source.events())
    assert len(again) == len(_events())
    if name not in ("clean", "focal +5 %", "baseline +10 %"):
        assert not _equal(events, again)


@pytest.mark.parametrize(("group", "name"), [("healthy", "every 2nd"), ("cameras", "no frames")])
def test_a_part_of_a_variant_with_fewer_frames_has_all_of_its_frames(group: str, name: str) -> None:
    """Recordings of which a part is run lacked half of it every second frame."""
    changed = GROUPS[group][name](_Flight(), PERIOD)
    stop = len(changed.recording.frame_times_ns) - 1
    found = [e.index for e in changed.events(1, stop) if isinstance(e, StereoFrame)]
    assert found == list(range(1, stop))


def test_images_out_of_order_keep_the_stamps_and_numbers_of_their_places() -> None:
    flight = _Sorted()
    changed = list(reordered(3)(flight, PERIOD).events())
    assert [event.time_ns for event in changed] == [event.time_ns for event in _events()]
    frames = [event for event in changed if isinstance(event, StereoFrame)]
    held = [event for event in _events() if isinstance(event, StereoFrame)]
    # the period begins with frame 8
    shown = [*range(8), 10, 9, 8, 13, 12, 11, 16, 15, 14, 19, 18, 17]
    assert [frame.index for frame in frames] == list(range(FRAMES))
    for frame, of in zip(frames, shown, strict=True):
        np.testing.assert_array_equal(frame.left, held[of].left)
        np.testing.assert_array_equal(frame.right, held[of].right)


def test_a_part_of_the_reversed_recording_is_that_of_the_whole() -> None:
    """The first frames had the pixels of the first ones of the source, and times of the end."""
    changed = HEALTHY["reverse"](_Flight(), PERIOD)
    whole = [event for event in changed.events() if isinstance(event, StereoFrame)]
    part = [event for event in changed.events(2, 7) if isinstance(event, StereoFrame)]
    assert [frame.index for frame in part] == list(range(2, 7))
    for frame in part:
        same = whole[frame.index]
        assert (frame.index, frame.time_ns) == (same.index, same.time_ns)
        np.testing.assert_array_equal(frame.left, same.left)


def test_the_reference_of_a_reversed_recording_may_be_shorter_than_it() -> None:
    flight = _Flight()
    truth = Trajectory(POSES[:12], None, "imu")
    recording = replace(flight.recording, reference=truth)
    changed = HEALTHY["reverse"](Changed(flight, recording, iter), PERIOD)
    reference = changed.recording.reference
    assert reference is not None
    assert reference.frame_indices is not None
    np.testing.assert_array_equal(reference.frame_indices, np.arange(FRAMES - 12, FRAMES))
    np.testing.assert_array_equal(reference.T_world_body, POSES[11::-1])


def _equal(a: list[Event], b: list[Event]) -> bool:
    if [type(x) for x in a] != [type(x) for x in b] or [x.time_ns for x in a] != [
        x.time_ns for x in b
    ]:
        return False
    return all(
        np.array_equal(x.left, y.left) and np.array_equal(x.right, y.right)
        if isinstance(x, StereoFrame) and isinstance(y, StereoFrame)
        else np.array_equal(x.gyro, y.gyro) and np.array_equal(x.accel, y.accel)  # type: ignore[union-attr]
        for x, y in zip(a, b, strict=True)
    )


def test_faults_leave_what_is_outside_their_period() -> None:
    for name in ("black", "object", "right frozen", "exchanged 3 s"):
        changed = CAMERAS[name](_Sorted(), PERIOD)
        for new, old in zip(changed.events(), _events(), strict=True):
            if isinstance(new, StereoFrame) and isinstance(old, StereoFrame):
                same = np.array_equal(new.left, old.left) and np.array_equal(new.right, old.right)
                assert same == (not PERIOD.holds(old.time_ns))


def _pixels(
    camera: StereoCamera, T_cam0_imu: FloatArray, T_world_imu: FloatArray, p_world: FloatArray
) -> FloatArray:
    return project(camera, transform_points(T_cam0_imu @ se3_inverse(T_world_imu), p_world))


def test_the_reference_of_the_mirrored_pair_is_the_path_of_its_images() -> None:
    """A point, mirrored with the world, is seen where the exchanged and mirrored images show it."""
    changed = HEALTHY["mirror"](_Sorted(), PERIOD).recording
    assert changed.T_cam0_imu is not None
    M = np.diag([-1.0, 1.0, 1.0])
    points = transform_points(
        POSES[5] @ se3_inverse(T_CAM0_IMU), np.array([[0.3, -0.2, 4.0], [-1.0, 0.5, 7.0]])
    )
    old = _pixels(CAMERA, T_CAM0_IMU, POSES[5], points)
    new = _pixels(changed.camera, changed.T_cam0_imu, changed.reference.T_world_body[5], points @ M)
    np.testing.assert_allclose(new[:, [0, 2]], CAMERA.width - 1 - old[:, [2, 0]], atol=1e-9)
    np.testing.assert_allclose(new[:, [1, 3]], old[:, [1, 3]], atol=1e-9)


@pytest.mark.parametrize("name", ["mirror", "reverse"])
def test_the_imu_of_a_mirrored_or_reversed_flight_measures_its_motion(name: str) -> None:
    """Readings of a turn at a constant rate: the changed reference turns as the changed gyro
    says.
    """
    rate, dt = np.array([0.3, -0.2, 0.5]), STEP_NS * 1e-9
    poses = np.array([se3_exp(np.concatenate([np.zeros(3), k * dt * rate])) for k in range(FRAMES)])
    times = STEP_NS * np.arange(FRAMES)

    class _Turn(_Flight):
        @property
        def recording(self) -> Recording:
            truth = Trajectory(T_world_body=poses, times_ns=times, body="imu", frame_indices=None)
            return Recording(
                "fake", Path("turn"), CAMERA, T_CAM0_IMU, times, True, frozenset({"imu"}), truth
            )

        def events(
            self, start: int = 0, stop: int | None = None, *, images: bool = True
        ) -> Iterator[Event]:
            image = np.zeros((300, 480), dtype=np.uint8)
            for k in range(FRAMES):
                yield ImuSample(k * STEP_NS, rate, np.zeros(3))
                yield StereoFrame(k, k * STEP_NS, image, image)

    changed = HEALTHY[name](_Turn(), PERIOD)
    R = changed.recording.reference.T_world_body[:2, :3, :3]
    sample = next(event for event in changed.events() if isinstance(event, ImuSample))
    expected = se3_exp(np.concatenate([np.zeros(3), dt * sample.gyro]))[:3, :3]
    np.testing.assert_allclose(R[0].T @ R[1], expected, atol=1e-9)


def test_half_the_size_sees_points_at_half_the_pixels() -> None:
    small = HEALTHY["half"](_Sorted(), PERIOD).recording.camera
    points = np.array([[0.3, -0.2, 4.0], [-1.0, 0.5, 7.0]])
    centre = (project(CAMERA, points) + 0.5) / 2 - 0.5  # of the four pixels that become one
    np.testing.assert_allclose(project(small, points), centre, atol=1e-9)


def test_a_wrong_unit_is_on_every_sample() -> None:
    for new, old in zip(IMU["gyro in deg/s"](_Sorted(), PERIOD).events(), _events(), strict=True):
        if isinstance(new, ImuSample) and isinstance(old, ImuSample):
            np.testing.assert_allclose(new.gyro, np.degrees(old.gyro))
            np.testing.assert_array_equal(new.accel, old.accel)


def test_the_tables_show_errors_ratios_and_codes_that_the_recording_as_it_is_has_not() -> None:
    row = {
        "recording": "r",
        "motion": "none",
        "group": "healthy",
        "variant": "clean",
        "ate_m": 0.004,
        "ratio": 1.0,
        "codes": ["rows-off"],
    }
    rows = [
        row,
        row | {"variant": "night", "ate_m": 0.0051, "codes": ["rows-off", "bands"]},
        row | {"group": "cameras", "variant": "black", "ratio": 0.25, "codes": ["no-features"]},
        row | {"group": "imu", "variant": "zero", "error": "DataError: refused"},
    ]
    text = page(
        {
            "version": "1",
            "commit": "abc",
            "machine": "m",
            "written": "2026",
            "packages": {},
            "runs": rows,
        }
    )
    assert "commit abc" in text
    assert "| variant | r, images alone |" in text
    assert "| clean | 4 |" in text
    assert "| night | 5.1 `bands` |" in text
    assert "### r, images alone" in text
    assert "| black | 4 | 0.2 | `no-features` |" in text
    assert "| zero | 4 | 1.0 | DataError: refused |" in text


def test_the_page_shows_what_was_run() -> None:
    facts = json.loads(FIGURES.read_text(encoding="utf-8"))
    assert PAGE.read_text(encoding="utf-8") == page(facts)
    keys = ("recording", "motion", "group", "variant")
    wanted = [(Path(s.source).name, s.motion, group, name) for s, group, name in tasks()]
    assert sorted(tuple(row[key] for key in keys) for row in facts["runs"]) == sorted(wanted)
    assert all("ate_m" in row for row in facts["runs"] if row["group"] == "healthy")


def test_a_part_of_the_runs_is_named() -> None:
    some = list(tasks(["MH_01_head"], ["imu", "nothing"]))
    assert [name for s, group, name in some if s.motion == "imu"] == ["nothing", *IMU]
    assert [(group, name) for s, group, name in some if s.motion == "none"] == [
        ("cameras", "nothing")
    ]
    assert len(list(tasks())) == sum(len(GROUPS[group]) for s in RUNS for group in s.groups)


def test_an_interrupted_call_goes_on_after_its_last_whole_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = list(tasks())[:3]
    monkeypatch.setattr(command, "tasks", lambda *some: wanted)
    monkeypatch.setattr(command, "commit_of", lambda root: "abc")
    row = {"recording": Path(wanted[0][0].source).name, "motion": wanted[0][0].motion}
    rows = [row | {"group": group, "variant": name} for _, group, name in wanted]
    (tmp_path / "faults-abc.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows)[:-9])
    asked: list[Any] = []
    written: list[dict[str, Any]] = []

    def run(work: Any, left: list[Any], workers: int) -> list[dict[str, Any]]:
        asked.extend(left)
        return rows[2:]

    monkeypatch.setattr(command, "_run", run)
    monkeypatch.setattr(command, "write", written.append)
    monkeypatch.setattr(sys, "argv", ["faults", "--data", str(tmp_path), "--work", str(tmp_path)])
    assert command.main() == 0
    assert asked == wanted[2:]
    assert written[0]["runs"] == rows
    assert [
        json.loads(line) for line in (tmp_path / "faults-abc.jsonl").read_text().splitlines()
    ] == rows
