"""The observation log: bit-exact replay, atomic writing, versions and corrupt files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vio
from tests.dataset_makers import CAMERA, T_CAM0_IMU, make_npz
from vio.cameras.rig import Rig
from vio.datasets import open_dataset
from vio.datasets.common import read_npz
from vio.datasets.observation_log import (
    _DEFAULTED,
    _OPTIONAL,
    _REQUIRED,
    FORMAT,
    read_observation_log,
    write_observation_log,
)
from vio.errors import CalibrationError, DataError
from vio.geometry.stereo import StereoCamera
from vio.records import (
    ImuSample,
    Landmarks,
    MotionSample,
    Observations,
    Recording,
    RunMotion,
    StereoFrame,
    Trajectory,
    VelocitySample,
)

finite = st.floats(allow_nan=False, width=64)
triple = st.tuples(finite, finite, finite).map(np.array)


@st.composite
def logs(draw: st.DrawFn) -> tuple[Recording, list[Observations], list[MotionSample]]:
    """A recording, what was seen in some of its frames, and the samples in between."""
    count = draw(st.integers(1, 6))
    times = np.cumsum(draw(st.lists(st.integers(10**6, 2**40), min_size=count, max_size=count)))
    seen = sorted(draw(st.sets(st.integers(0, count - 1))))
    observed = []
    for k in seen:
        n = draw(st.integers(0, 4))
        ids = draw(st.lists(st.integers(0, 2**62), min_size=n, max_size=n, unique=True))
        z = draw(st.lists(finite, min_size=4 * n, max_size=4 * n))
        flags = np.array(
            draw(st.lists(st.booleans(), min_size=2 * n, max_size=2 * n)), dtype=np.bool_
        )
        sigma = draw(
            st.none() | st.lists(st.floats(0.125, 8.0, width=32), min_size=3 * n, max_size=3 * n)
        )
        sigmas = None if sigma is None else np.array(sigma, dtype=np.float32).reshape(n, 3)
        columns = (
            np.array(ids, dtype=np.int64),
            np.array(z).reshape(n, 4),
            flags[:n],
            flags[n:],
            sigmas,
        )
        observed.append(Observations(k, int(times[k]), *columns))
    ticks = sorted(draw(st.lists(st.integers(int(times[0]), int(times[-1])), max_size=5)))
    maker = st.sampled_from([ImuSample, VelocitySample])
    samples = [draw(maker)(t, draw(triple), draw(triple)) for t in ticks]
    size = draw(st.sampled_from([(None, None), (640, 480)]))
    reference = draw(
        st.sampled_from(
            [
                None,
                Trajectory(np.tile(T_CAM0_IMU, (3, 1, 1)), None, "cam0"),
                Trajectory(
                    np.tile(T_CAM0_IMU, (2, 1, 1)), np.array([5, 7]), "imu", np.array([0, 3])
                ),
            ]
        )
    )
    landmarks = draw(
        st.sampled_from([None, Landmarks(np.array([4]), np.ones((1, 3)), np.zeros((1, 3, 3)))])
    )
    recording = Recording(
        kind="made",
        path=Path("somewhere"),
        camera=StereoCamera(700.1, 710.0, 600.0, 180.0, 0.54, *size),
        T_cam0_imu=draw(st.sampled_from([None, T_CAM0_IMU])),
        frame_times_ns=times.astype(np.int64),
        has_images=True,
        motion=frozenset(),
        reference=reference,
        landmarks_reference=landmarks,
        notes=draw(st.sampled_from([(), ("one", "two\u00e9")])),
    )
    return recording, observed, samples


def _same_bits(a: object, b: object) -> bool:
    if a is None or b is None:
        return a is b
    first, second = np.asarray(a), np.asarray(b)
    return (
        first.dtype == second.dtype
        and first.shape == second.shape
        and first.tobytes() == second.tobytes()
    )


@settings(deadline=None)
@given(logs())
def test_round_trip_keeps_every_bit(
    tmp_path_factory: pytest.TempPathFactory,
    log: tuple[Recording, list[Observations], list[MotionSample]],
) -> None:
    recording, observed, samples = log
    path = tmp_path_factory.mktemp("log") / "run.npz"
    write_observation_log(path, recording, observed, samples)
    dataset = open_dataset(path)
    read = dataset.recording
    assert (read.kind, read.has_images, read.camera, read.notes) == (
        "log",
        False,
        recording.camera,
        recording.notes,
    )
    assert read.motion == {
        "imu" if isinstance(sample, ImuSample) else "velocity" for sample in samples
    }
    assert _same_bits(read.frame_times_ns, recording.frame_times_ns)
    assert _same_bits(read.T_cam0_imu, recording.T_cam0_imu)
    for name in ("reference", "landmarks_reference"):
        ours, theirs = getattr(read, name), getattr(recording, name)
        assert (ours is None) == (theirs is None)
        for field in () if ours is None else type(ours).__slots__:
            a, b = getattr(ours, field), getattr(theirs, field)
            assert a == b if isinstance(a, str) else _same_bits(a, b)

    events = list(dataset.events())
    frames = [event for event in events if isinstance(event, StereoFrame)]
    assert [frame.index for frame in frames] == [o.frame_index for o in observed]
    for expected in observed:
        found = dataset.observations(expected.frame_index)
        assert (found.frame_index, found.time_ns) == (expected.frame_index, expected.time_ns)
        for field in ("ids", "z", "has_right", "stale"):
            assert _same_bits(getattr(found, field), getattr(expected, field))
        given = (
            np.zeros((len(expected), 3), np.float32) if expected.sigma is None else expected.sigma
        )
        assert _same_bits(np.zeros_like(given) if found.sigma is None else found.sigma, given)
    replayed = [event for event in events if not isinstance(event, StereoFrame)]
    assert [type(sample) for sample in replayed] == [type(sample) for sample in samples]
    for a, b in zip(replayed, samples, strict=True):
        assert a.time_ns == b.time_ns
        for field in ("gyro", "accel") if isinstance(a, ImuSample) else ("linear", "angular"):
            assert _same_bits(getattr(a, field), getattr(b, field))


def _recording(count: int = 3) -> Recording:
    times = np.arange(count) * 100_000_000
    return Recording("made", Path("x"), CAMERA, None, times, False, frozenset(), None)


def _seen(k: int, time_ns: int) -> Observations:
    return Observations(
        k, time_ns, np.array([7]), np.array([[3.0, 2, 1, 2]]), np.array([True]), np.array([False])
    )


def test_a_left_only_feature_keeps_its_arbitrary_right_pixels(tmp_path: Path) -> None:
    z = np.array([[1.0, 2.0, np.nan, -0.0]])
    seen = Observations(1, 100_000_000, np.array([3]), z, np.array([False]), np.array([True]))
    write_observation_log(tmp_path / "a.npz", _recording(), [seen], [])
    found = read_observation_log(tmp_path / "a.npz").observations(1)
    assert found.z.tobytes() == z.tobytes()


def test_frames_that_were_not_processed_yield_no_event_and_no_features(tmp_path: Path) -> None:
    write_observation_log(tmp_path / "a.npz", _recording(), [_seen(2, 200_000_000)], [])
    dataset = read_observation_log(tmp_path / "a.npz")
    assert [frame.time_ns for frame in dataset.events()] == [200_000_000]
    empty = dataset.observations(0)
    assert len(empty) == 0
    assert dataset.observations(2) is not None


def test_the_bytes_do_not_depend_on_when_they_are_written(tmp_path: Path) -> None:
    for name in ("a.npz", "b.npz"):
        write_observation_log(tmp_path / name, _recording(), [_seen(2, 200_000_000)], [])
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.mark.parametrize(
    "observed",
    [
        [_seen(2, 200_000_000), _seen(1, 100_000_000)],
        [_seen(1, 100_000_000), _seen(1, 100_000_000)],
        [_seen(1, 100_000_001)],
    ],
)
def test_rejects_observations_of_another_recording(
    observed: list[Observations], tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match="not in the order of the recording's frames"):
        write_observation_log(tmp_path / "a.npz", _recording(), observed, [])
    assert list(tmp_path.iterdir()) == []


def test_error_names_an_unwritable_path_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cannot write .*nowhere.a\.npz"):
        write_observation_log(tmp_path / "nowhere" / "a.npz", _recording(), [], [])
    assert list(tmp_path.iterdir()) == []


def _corrupt_log(tmp_path: Path, **changes: object) -> Path:
    write_observation_log(
        tmp_path / "good.npz", _recording(), [_seen(0, 0), _seen(2, 200_000_000)], []
    )
    arrays = {
        **read_npz(tmp_path / "good.npz"),
        **{k: np.asarray(v) for k, v in changes.items() if v is not None},
    }
    return make_npz(
        tmp_path / "bad.npz",
        {k: v for k, v in arrays.items() if k not in changes or changes[k] is not None},
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "else"}, "no observation log"),
        ({"version": 3}, "an observation log of version 3, this program reads up to 2; upgrade"),
        ({"z": None}, "the observation log lacks z"),
        ({"z": np.zeros((2, 4), dtype=np.complex128)}, "z of the observation log has type complex"),
        ({"z": np.zeros((3, 4))}, "inconsistent: 2 ids, but z is"),
        ({"offsets": [0, 2, 1]}, "the offsets do not split 2 rows into 2 frames"),
        ({"offsets": [0, 2, 2]}, "an id occurs twice in a frame"),
        ({"frame_indices": [0, 3]}, "frame numbers do not increase within 0 to 2"),
        ({"frame_times_ns": [0, 0, 200_000_000]}, "a clock does not increase"),
        ({"motion_values": np.zeros((1, 6))}, "0 motion times"),
        ({"frame_times_ns": [0, 1, 2]}, "inconsistent: frames come 1 ns apart"),
        ({"image_numbers": [1]}, "1 numbers of images for 3 frames"),
        ({"image_size": [640]}, r"image_size is \[640\], not width and height"),
        ({"intrinsics": [7e2, 7e2, 600, 180]}, "intrinsics has 4 numbers, not the five"),
        ({"residual_px": -0.5}, "residual_px is -0.5, no number of pixels"),
        ({"sigma": np.ones((1, 2))}, "but sigma is"),
        ({"run_motion": "wheels"}, "run_motion is 'wheels', none of imu, velocity, none"),
        ({"landmark_ids": [1]}, "landmark_ids lacks landmark_p_world"),
        (
            {"reference_T_world_body": np.zeros((2, 3, 4)), "reference_body": "imu"},
            "reference poses",
        ),
        (
            {"reference_T_world_body": np.zeros((2, 4)), "reference_body": "imu"},
            "reference_T_world_body of the .* 2-D",
        ),
        (
            {"reference_times_ns": "x"},
            "reference_times_ns of the observation log has type <U1, 0-D",
        ),
        ({"T_cam0_imu": "x"}, "T_cam0_imu of the observation log has type <U1"),
        ({"version": [1, 2]}, "version of the observation log has type int64, 1-D"),
    ],
)
def test_rejects_a_corrupt_log(changes: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=message) as caught:
        read_observation_log(_corrupt_log(tmp_path, **changes))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"intrinsics": [700.0, 700, 0, 0, 0]}, "baseline must be positive"),
        ({"T_cam0_imu": np.diag([1.0, 2, 1, 1])}, "T_cam0_imu: not a rotation"),
    ],
)
def test_rejects_a_log_with_corrupt_calibration(
    changes: dict[str, object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError, match=message):
        read_observation_log(_corrupt_log(tmp_path, **changes))


def test_the_required_arrays_alone_are_a_recording(tmp_path: Path) -> None:
    """In 32 bits, as another program may write them."""
    arrays = {
        "intrinsics": np.array([700, 700, 600, 180, 0.5], dtype=np.float32),
        "frame_times_ns": np.array([5, 105]),
        "offsets": np.array([0, 2, 3], dtype=np.int32),
        "ids": np.array([1, 2, 1], dtype=np.int32),
        "z": np.array([[10, 5, 8, 5], [20, 6, 0, 0], [11, 5, 9, 5]], dtype=np.float32),
        "has_right": np.array([True, False, True]),
    }
    dataset = open_dataset(make_npz(tmp_path / "features.npz", arrays))
    assert dataset.recording.kind == "log"
    assert dataset.recording.T_cam0_imu is None
    assert [type(event) for event in dataset.events()] == [StereoFrame, StereoFrame]
    seen = dataset.observations(0)
    assert (seen.ids.dtype, seen.z.dtype) == (np.int64, np.float64)
    assert seen.ids.tolist() == [1, 2]
    assert seen.has_right.tolist() == [True, False]
    assert not seen.stale.any()


def test_features_of_another_program_are_written_and_read(tmp_path: Path) -> None:
    rig = Rig.rectified(700.0, 700.0, 600.0, 180.0, 0.5, 1200, 370, T_CAM0_IMU)
    frames = [([1, 2], [[10, 5, 8, 5], [20, 6, 0, 0]], [True, False]), ([1], [[11, 5, 9, 5]], None)]
    sample = ImuSample(50, np.zeros(3), np.array([0.0, 0.0, 9.8]))
    vio.write_observations(tmp_path / "features.npz", rig, [0, 100], frames, motion=[sample])
    dataset = vio.open_dataset(tmp_path / "features.npz")
    assert dataset.recording.camera == rig.camera
    assert _same_bits(dataset.recording.T_cam0_imu, rig.T_cam0_imu)
    assert [type(event) for event in dataset.events()] == [StereoFrame, ImuSample, StereoFrame]
    assert [dataset.observations(k).has_right.tolist() for k in range(2)] == [[True, False], [True]]


@pytest.mark.parametrize(
    ("times", "frames", "message"),
    [
        ([0.0, 0.1], [([1], [[1, 2, 0, 2]], None)] * 2, "one integer, in nanoseconds"),
        ([0], [], "for 0 frames"),
        ([5, 5], [([1], [[1, 2, 0, 2]], None)] * 2, "frame times, entry 1"),
        ([0], [([1, 1], [[1, 2, 0, 2]] * 2, None)], "an id occurs twice"),
        (
            [0, 1, 2],
            [([1], [[1, 2, 0, 2]], None)] * 3,
            "frames come 1 ns apart, which no sensor does",
        ),
        ([5, 38, 71], [([1], [[1, 2, 0, 2]], None)] * 3, "frames come 33 ns apart"),  # ms
        ([0], [([1], [[1, 2, 0]], None)], "frame 0"),
        ([0], [{"ids": [1], "z": [[1, 2, 0, 2]]}], r"of the type dict; give \(ids, z, has_right\)"),
    ],
)
def test_malformed_features_are_not_written(
    times: object, frames: object, message: str, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=message):
        vio.write_observations(tmp_path / "a.npz", CAMERA, times, frames)
    assert list(tmp_path.iterdir()) == []


def test_features_without_a_camera_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="camera is of the type ndarray; give a Rig"):
        vio.write_observations(tmp_path / "a.npz", np.eye(3), [0], [([1], [[1, 2, 0, 2]], None)])


def test_features_may_come_from_a_generator(tmp_path: Path) -> None:
    frames = ([1, 2], [[9, 2, 7, 2], [5, 6, 4, 6]], None), ([1], [[9.5, 2, 7, 2]], None)
    vio.write_observations(tmp_path / "a.npz", CAMERA, [0, 10**8], (frame for frame in frames))
    assert len(open_dataset(tmp_path / "a.npz").observations(1)) == 1


def test_the_tutorial_describes_every_array() -> None:
    page = (Path(__file__).parents[2] / "docs/tutorials/features.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`[^|]+`) \| ([^|]*) \|.*\| (yes|no)[^|]*\|$", page, re.MULTILINE)
    named = {
        name: needed == "yes" for names, _, needed in rows for name in re.findall(r"`(\w+)`", names)
    }
    known = {**dict.fromkeys(_REQUIRED, True), **dict.fromkeys([*_DEFAULTED, *_OPTIONAL], False)}
    assert named == known


def test_format_name_is_what_is_written(tmp_path: Path) -> None:
    write_observation_log(tmp_path / "a.npz", _recording(), [], [])
    arrays = read_npz(tmp_path / "a.npz")
    assert (str(arrays["format"]), int(arrays["version"])) == (FORMAT, 2)


@pytest.mark.parametrize("run_motion", [None, "none", "velocity", "imu"])
def test_log_keeps_the_motion_of_its_run(run_motion: RunMotion | None, tmp_path: Path) -> None:
    write_observation_log(tmp_path / "a.npz", _recording(), [], [], run_motion=run_motion)
    assert read_observation_log(tmp_path / "a.npz").recording.run_motion == run_motion
    assert ("run_motion" in read_npz(tmp_path / "a.npz")) == (run_motion is not None)
