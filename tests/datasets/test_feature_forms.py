"""Features as other programs write them: read as they are meant, or refused with what to write."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import vio
from tests.dataset_makers import make_npz
from vio.datasets import open_dataset
from vio.datasets.observation_log import read_observation_log
from vio.errors import DataError
from vio.geometry.lie import FloatArray, so3_exp
from vio.geometry.stereo import StereoCamera

CAMERA = StereoCamera(700.0, 700.0, 610.0, 180.0, 0.5, 1200, 370)
Arrays = dict[str, np.ndarray]
Change = Callable[[Arrays], Arrays]


def _features(seed: int = 0, frames: int = 6, motion: str = "forward") -> Arrays:
    """The arrays of a tracker's file: 300 points that a pair drives by, or turns before."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-15, -4, 5], [15, 2, 80], (300, 3))
    ids, z, counts = [], [], []
    for k in range(frames):
        if motion == "forward":
            p = points - [0, 0, 1.0 * k]
        else:  # a roll of 6 degrees a frame
            p = points @ so3_exp([0, 0, np.radians(6.0 * k)]).T
        uv = 700 * p[:, :2] / p[:, 2:] + [610, 180]
        pixels = np.column_stack([uv, uv])
        pixels[:, 2] -= 700 * 0.5 / p[:, 2]
        pixels += rng.normal(0, 0.3, pixels.shape)
        inside = (p[:, 2] > 3) & (pixels > 0).all(axis=1)
        seen = np.flatnonzero(inside & (uv < [1200, 370]).all(axis=1))
        ids.append(seen)
        z.append(pixels[seen])
        counts.append(len(seen))
    rows = sum(counts)
    return {
        "intrinsics": np.array([700.0, 700, 610, 180, 0.5]),
        "frame_times_ns": 10**8 * np.arange(frames),
        "offsets": np.concatenate([[0], np.cumsum(counts)]),
        "ids": np.concatenate(ids),
        "z": np.concatenate(z),
        "has_right": np.arange(rows) % 10 != 0,
        "image_size": np.array([1200, 370]),
    }


def _columns(*order: int) -> Change:
    return lambda a: {**a, "z": a["z"][:, order]}


def _pixels(change: Callable[[FloatArray], FloatArray]) -> Change:
    return lambda a: {**a, "z": change(a["z"].copy())}


def _column(which: int, change: Callable[[FloatArray], FloatArray]) -> Change:
    def changed(z: FloatArray) -> FloatArray:
        z[:, which] = change(z)
        return z

    return _pixels(changed)


def _by_rows(arrays: Arrays) -> Arrays:
    return {**arrays, "ids": np.concatenate([np.arange(n) for n in np.diff(arrays["offsets"])])}


def _between_two(arrays: Arrays) -> Arrays:
    frames = np.repeat(np.arange(len(arrays["offsets"]) - 1), np.diff(arrays["offsets"]))
    return {**arrays, "ids": arrays["ids"] + frames}


def _always_new(arrays: Arrays) -> Arrays:
    return {**arrays, "ids": np.arange(len(arrays["ids"]))}


def _other_rows(arrays: Arrays) -> Arrays:
    z = arrays["z"].copy()
    for first, last in zip(arrays["offsets"], arrays["offsets"][1:], strict=False):
        z[first:last, 2:] = z[first:last][np.argsort(z[first:last, 0])][:, 2:]
    return {**arrays, "z": z}


def _sixteenths(arrays: Arrays) -> Arrays:
    """Disparities as OpenCV's block matchers compute them: 16 times as large, whole numbers."""
    z = arrays["z"].copy()
    z[:, 2] = z[:, 0] - np.rint(16 * (z[:, 0] - z[:, 2]))
    return {**arrays, "z": z}


CENTRE = np.array([610.0, 180, 610, 180])
REFUSED: dict[str, tuple[Change, str]] = {
    "u and v": (_columns(1, 0, 3, 2), "in the order vl ul vr ur"),
    "u of both first": (_columns(0, 2, 1, 3), "in the order ul ur vl vr"),
    "v and u, right first": (_columns(3, 2, 1, 0), "in the order vr ur vl ul"),
    "right first": (_columns(2, 3, 0, 1), "are negative in 100 % of the rows: the right camera's"),
    "u from the right edge": (
        _pixels(lambda z: z * [-1, 1, -1, 1] + [1199, 0, 1199, 0]),
        "or u counts from the right edge",
    ),
    "a disparity": (_column(2, lambda z: z[:, 0] - z[:, 2]), "a disparity; write ur = ul - dis"),
    "sixteenths": (_sixteenths, "sixteenths of a pixel, .*divide these by 16"),
    "right from the centre": (
        _column(2, lambda z: z[:, 2] - 610),
        r"lie left of the image \(ur from -.*\); write ur vr in pixels of the right image",
    ),
    "an image of both": (_column(2, lambda z: z[:, 2] + 1200), "subtract the width of one"),
    "no right rows": (_column(3, lambda z: 0 * z[:, 3]), "vr is 0 in all .* rows"),
    "right in another order": (_other_rows, "rows vl and vr of one id differ by .* another order"),
    "normalised": (_pixels(lambda z: (z - CENTRE) / 700), "normalised coordinates"),
    "shares": (_pixels(lambda z: z / [1200, 370, 1200, 370]), "shares of the image"),
    "from the centre": (_pixels(lambda z: z - CENTRE), "add cu and cv"),
    "twice the size": (_pixels(lambda z: 2 * z), "outside of the image of 1200 x 370"),
    "half the size": (_pixels(lambda z: z / 2), "of images of half the size; halve fu fv cu cv"),
    "rows as ids": (_by_rows, "ids are not those of points"),
    "matches of two frames": (_between_two, "ids are not those of points"),
    "new ids": (_always_new, "features 0 have an id that the next frame has"),
    "no left pixel": (
        _pixels(lambda z: np.where(np.arange(z.size).reshape(z.shape) == 8, np.nan, z)),
        r"row 2 \(processed frame 0, id .*leave it out",
    ),
    "order of intrinsics": (
        lambda a: {**a, "intrinsics": np.array([700.0, 610, 700, 180, 0.5])},
        "as if their order were fu cu fv cv",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_names_how_features_of_another_program_were_written(name: str, tmp_path: Path) -> None:
    change, words = REFUSED[name]
    arrays = change(_features())
    with pytest.raises(DataError, match=words) as caught:
        open_dataset(make_npz(tmp_path / "features.npz", arrays))
    assert "\n" not in str(caught.value)
    if name == "order of intrinsics":
        return
    rows = zip(arrays["offsets"], arrays["offsets"][1:], strict=False)
    frames = [(arrays["ids"][a:b], arrays["z"][a:b], arrays["has_right"][a:b]) for a, b in rows]
    times = arrays["frame_times_ns"]
    with pytest.raises(DataError, match=words):
        vio.write_observations(tmp_path / "written.npz", CAMERA, times, frames)


def _frames(arrays: Arrays, which: slice) -> Arrays:
    """Some frames alone, at the times of the first of them."""
    ends = arrays["offsets"]
    parts = {key: np.split(arrays[key], ends[1:-1])[which] for key in ("ids", "z", "has_right")}
    return {
        **arrays,
        **{key: np.concatenate(part) for key, part in parts.items()},
        "offsets": np.concatenate([[0], np.cumsum([len(part) for part in parts["ids"]])]),
        "frame_times_ns": arrays["frame_times_ns"][: len(parts["ids"])],
    }


def _without(*keys: str) -> Change:
    return lambda a: {key: array for key, array in a.items() if key not in keys}


HEALTHY: dict[str, Change] = {
    "as they are": lambda a: a,
    "reversed": lambda a: _frames(a, slice(None, None, -1)),
    "mirrored, cameras exchanged": _pixels(
        lambda z: [1199, 0, 1199, 0] + [-1, 1, -1, 1] * z[:, [2, 3, 0, 1]]
    ),
    "upside down": _pixels(lambda z: [0, 369, 0, 369] + [1, -1, 1, -1] * z),
    "half size": lambda a: {
        **a,
        "z": a["z"] / 2,
        "intrinsics": a["intrinsics"] / [2, 2, 2, 2, 1],
        "image_size": np.array([600, 185]),
    },
    "no size": _without("image_size"),
    "one camera": lambda a: {**a, "has_right": 0 * a["has_right"] == 1},
    "rows 6 px off": _column(3, lambda z: z[:, 3] + 6),
    "integers": _pixels(np.rint),
    "a fifth of the right pixels wrong": _column(
        2, lambda z: np.where(np.arange(len(z)) % 5 == 1, z[:, 2][::-1], z[:, 2])
    ),
    "every second frame": lambda a: _frames(a, slice(0, None, 2)),
    "negative ids": lambda a: {**a, "ids": -1 - a["ids"]},
}


@pytest.mark.parametrize("name", HEALTHY)
@pytest.mark.parametrize("motion", ["forward", "roll"])
def test_says_nothing_of_healthy_features(name: str, motion: str, tmp_path: Path) -> None:
    arrays = HEALTHY[name](_features(1, motion=motion))
    dataset = open_dataset(make_npz(tmp_path / "features.npz", arrays))
    assert dataset.recording.notes == ()


def test_pixels_far_beyond_the_principal_point_are_doubted(tmp_path: Path) -> None:
    arrays = _without("image_size")(_features())
    arrays["z"] = 2 * arrays["z"]
    recording = open_dataset(make_npz(tmp_path / "features.npz", arrays)).recording
    assert len(recording.doubts) == 1
    assert re.search(r"and the principal point is \(610, 180\)", recording.doubts[0])
    rows = zip(arrays["offsets"], arrays["offsets"][1:], strict=False)
    frames = [(arrays["ids"][a:b], arrays["z"][a:b], arrays["has_right"][a:b]) for a, b in rows]
    camera = StereoCamera(700.0, 700.0, 610.0, 180.0, 0.5)
    vio.write_observations(tmp_path / "w.npz", camera, arrays["frame_times_ns"], frames)
    (again,) = open_dataset(tmp_path / "w.npz").recording.doubts
    assert recording.doubts[0].endswith(again)


@pytest.mark.parametrize(("count", "first_px"), [(8, (20, 10)), (60, (300, 90))])
def test_a_thing_may_lie_in_the_upper_left_quarter(
    count: int, first_px: tuple[float, float], tmp_path: Path
) -> None:
    """As do the corners of a board: few, or in a part of the quarter alone."""
    rng = np.random.default_rng(0)
    corners = rng.uniform(first_px, (590, 178), (count, 2))
    corners[:2] = first_px, (590, 178)
    frames = []
    for k in range(5):
        uv = corners - [2.0 * k, 1.0 * k]
        z = np.column_stack([uv, uv - [20.0, 0.0]]) + rng.normal(0, 0.2, (count, 4))
        frames.append((np.arange(count), z, None))
    vio.write_observations(tmp_path / "board.npz", CAMERA, 10**8 * np.arange(5), frames)
    assert open_dataset(tmp_path / "board.npz").recording.notes == ()


def test_far_points_have_the_same_whole_pixel_in_both_images(tmp_path: Path) -> None:
    arrays = _features()
    far = arrays["ids"] % 3 == 0
    arrays["z"][far, 2:] = arrays["z"][far, :2]
    arrays["z"] = np.rint(arrays["z"])
    dataset = open_dataset(make_npz(tmp_path / "features.npz", arrays))
    assert dataset.recording.notes == ()
    seen = dataset.observations(0)
    assert seen is not None
    assert seen.has_right.sum() == arrays["has_right"][: len(seen)].sum()


def test_the_left_pixel_itself_is_no_right_one(tmp_path: Path) -> None:
    arrays = _features()
    lost = ~arrays["has_right"]
    arrays["z"][lost, 2:] = arrays["z"][lost, :2]
    arrays["has_right"] = np.ones(len(lost), dtype=np.bool_)
    dataset = open_dataset(make_npz(tmp_path / "features.npz", arrays))
    first = dataset.observations(0)
    assert first is not None
    assert first.has_right.tolist() == (~lost[: len(first)]).tolist()
    assert f"ur vr are ul vl in {lost.sum()} rows" in dataset.recording.notes[0]


@pytest.mark.parametrize("pixel", [-1.0, 0.0, np.nan])
def test_right_pixels_that_stand_for_nothing_are_not_measured(pixel: float, tmp_path: Path) -> None:
    arrays = _features()
    lost = ~arrays["has_right"]
    arrays["z"][lost, 2:] = pixel
    arrays["has_right"] = np.ones(len(lost), dtype=np.bool_)
    dataset = open_dataset(make_npz(tmp_path / "features.npz", arrays))
    first = dataset.observations(0)
    assert first is not None
    assert first.has_right.tolist() == (~lost[: len(first)]).tolist()
    (note,) = dataset.recording.notes
    assert f"in {lost.sum()} rows that has_right marks as measured" in note

    rows = zip(arrays["offsets"], arrays["offsets"][1:], strict=False)
    frames = [(arrays["ids"][a:b], arrays["z"][a:b], None) for a, b in rows]
    vio.write_observations(tmp_path / "w.npz", CAMERA, arrays["frame_times_ns"], frames)
    written = open_dataset(tmp_path / "w.npz")
    kept = written.observations(0)
    assert kept is not None
    assert kept.has_right.tolist() == first.has_right.tolist()
    assert len(written.recording.notes) == 1


def test_one_right_pixel_at_the_corner_is_kept(tmp_path: Path) -> None:
    arrays = _features()
    arrays["z"][1] = [3.0, 0.0, -0.5, -0.25]
    dataset = open_dataset(make_npz(tmp_path / "features.npz", arrays))
    seen = dataset.observations(0)
    assert seen is not None
    assert bool(seen.has_right[1])


def test_numbers_of_another_type_are_read_where_nothing_is_lost(tmp_path: Path) -> None:
    arrays = _features()
    same = {
        **arrays,
        "z": np.rint(arrays["z"]).astype(np.int32),
        "ids": arrays["ids"].astype(np.float64),
        "has_right": arrays["has_right"].astype(np.uint8),
        "offsets": arrays["offsets"].astype(np.uint64),
    }
    seen = read_observation_log(make_npz(tmp_path / "a.npz", same)).observations(2)
    assert (seen.ids.dtype, seen.z.dtype, seen.has_right.dtype) == (np.int64, np.float64, np.bool_)
    first, last = arrays["offsets"][2:4]
    assert seen.ids.tolist() == arrays["ids"][first:last].tolist()
    assert seen.has_right.tolist() == arrays["has_right"][first:last].tolist()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frame_times_ns": 0.1 * np.arange(6)}, "float64, 1-D; write integers, whole nanoseconds"),
        ({"ids": np.arange(2) + 0.5}, "ids of .* has type float64, 1-D; write integers, 1-D"),
        ({"has_right": np.full(3, 2)}, "has_right of .* write true or false, 1-D"),
        (
            {"frame_times_ns": (1.6e18 + 10**8 * np.arange(6)).astype(np.float32).astype(np.int64)},
            r"frame_times_ns has \d+ \(entry 1\) after \d+, and all .* through 32-bit floats",
        ),
        ({"offsets": np.arange(6)}, r"6 entries, from 0 to 5; 7 are needed, .*from 0 to \d+"),
        ({"ids": "twice"}, "an id occurs twice in a frame: 5 in processed frame 0"),
    ],
)
def test_says_what_an_array_must_be(changes: Arrays, words: str, tmp_path: Path) -> None:
    arrays = {**_features(), **changes}
    if isinstance(changes.get("ids"), str):
        arrays["ids"] = np.full(len(arrays["z"]), 5)
    with pytest.raises(DataError, match=words):
        open_dataset(make_npz(tmp_path / "features.npz", arrays))


def test_disparities_at_the_end_of_a_search_are_not_measured(tmp_path: Path) -> None:
    arrays = _features()
    z = arrays["z"].copy()
    near = arrays["has_right"] & (z[:, 0] - z[:, 2] > 32)
    z[near, 2] = z[near, 0] - 32
    recording = open_dataset(make_npz(tmp_path / "capped.npz", {**arrays, "z": z}))
    (note,) = recording.recording.notes
    assert f"at the largest disparity, 32 px, in {near.sum()} rows" in note
    seen = [recording.observations(k) for k in range(6)]
    kept = np.concatenate([o.has_right for o in seen])
    np.testing.assert_array_equal(kept, arrays["has_right"] & ~near)


def test_most_disparities_at_the_end_of_a_search_are_doubted(tmp_path: Path) -> None:
    arrays = _features()
    z = arrays["z"].copy()
    near = arrays["has_right"] & (z[:, 0] - z[:, 2] > 7)
    assert near.sum() > 0.5 * arrays["has_right"].sum()
    z[near, 2] = z[near, 0] - 7
    recording = open_dataset(make_npz(tmp_path / "capped.npz", {**arrays, "z": z})).recording
    (note,) = recording.notes
    assert "of the disparities are 7 px, the largest: if a matcher searches no farther" in note


def test_a_plane_that_is_seen_without_noise_keeps_its_right_pixels(tmp_path: Path) -> None:
    arrays = _features()
    z = arrays["z"].copy()
    z[:, 2] = z[:, 0] - 35.25
    recording = open_dataset(make_npz(tmp_path / "plane.npz", {**arrays, "z": z}))
    assert recording.recording.notes == ()
    assert recording.observations(0).has_right.sum() > 100


def test_the_nearest_point_at_rest_keeps_its_right_pixel(tmp_path: Path) -> None:
    arrays = _features(frames=1)
    arrays |= {key: arrays[key][:60] for key in ("ids", "z", "has_right")}
    z = arrays["z"].copy()
    z[:, 2] = z[:, 0] - np.rint(z[:, 0] - z[:, 2])
    disparity = np.where(arrays["has_right"], z[:, 0] - z[:, 2], 0.0)
    assert (disparity > disparity.max() - 2).sum() == 1
    rest = 60
    counts = len(z) * np.arange(rest + 1)
    arrays = {**arrays, "z": z, "offsets": counts, "frame_times_ns": 10**8 * np.arange(rest)}
    arrays |= {key: np.concatenate([arrays[key]] * rest) for key in ("ids", "z", "has_right")}
    recording = open_dataset(make_npz(tmp_path / "rest.npz", arrays))
    assert recording.recording.notes == ()
    nearest = int(np.argmax(disparity))
    assert recording.observations(30).has_right[nearest]


def _given_live(odometry: vio.Odometry, arrays: Arrays) -> int:
    """Give frames until one is refused, and return how many were taken."""
    for k, (a, b) in enumerate(zip(arrays["offsets"], arrays["offsets"][1:], strict=False)):
        frame = arrays["ids"][a:b], arrays["z"][a:b], arrays["has_right"][a:b]
        try:
            odometry.add_observations(10**8 * k, *frame)
        except DataError:
            return k
    return len(arrays["offsets"]) - 1


@pytest.mark.parametrize("name", sorted({*REFUSED} - {"no left pixel", "order of intrinsics"}))
def test_live_features_are_examined_as_those_of_files(name: str) -> None:
    change, words = REFUSED[name]
    arrays = change(_features(frames=12))
    odometry = vio.Odometry(CAMERA, vio.load_config(overrides=["motion=none"]))
    taken = _given_live(odometry, arrays)
    assert taken in (2, 9)
    rows = slice(*arrays["offsets"][taken : taken + 2])
    frame = arrays["ids"][rows], arrays["z"][rows], arrays["has_right"][rows]
    with pytest.raises(DataError, match=f"first {taken + 1} frames: .*{words}"):
        odometry.add_observations(10**8 * taken, *frame)


def test_healthy_live_features_are_taken() -> None:
    odometry = vio.Odometry(CAMERA, vio.load_config(overrides=["motion=none"]))
    assert _given_live(odometry, _features(frames=14)) == 14
    estimate = odometry.estimate
    assert estimate is not None
    np.testing.assert_allclose(estimate.T_world_imu[:3, 3], [0, 0, 13], atol=0.1)


def _begins_anew(arrays: Arrays) -> Arrays:
    """Ids of a tracker that loses all points in each of its first frames, as exposure settles."""
    frames = np.repeat(np.arange(len(arrays["offsets"]) - 1), np.diff(arrays["offsets"]))
    return {**arrays, "ids": arrays["ids"] + 1000 * np.minimum(frames, 3)}


def _marked_by_numbers(arrays: Arrays) -> Arrays:
    z = arrays["z"].copy()
    z[~arrays["has_right"] | (np.arange(len(z)) % 3 == 0), 2:] = -100
    return {**arrays, "z": z, "has_right": np.ones(len(z), dtype=bool)}


@pytest.mark.parametrize("change", [_begins_anew, _marked_by_numbers])
def test_live_features_that_files_may_hold_are_taken(change: Change) -> None:
    odometry = vio.Odometry(CAMERA, vio.load_config(overrides=["motion=none"]))
    assert _given_live(odometry, change(_features(frames=12))) == 12
