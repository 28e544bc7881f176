"""The contract of all selectors, and the properties of each."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vio.errors import ConfigError
from vio.geometry.lie import se3_exp, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.records import MotionPrior, Observations, observations
from vio.selection import selectors
from vio.selection.selectors import Selector, SelectorSettings, build_selector

CAMERA = StereoCamera(430.0, 430.0, 320.0, 180.0, 0.11, 640, 360)
BUDGETED = ("visibility", "information")


def _frame(index: int, ids: list[int], seed: int = 0) -> Observations:
    rng = np.random.default_rng((seed, index))
    z = rng.uniform(0, [640, 360, 640, 360], (len(ids), 4))
    return observations(index, index * 10**8, ids, z, rng.random(len(ids)) < 0.9)


@pytest.fixture(autouse=True, scope="module")
def least_kept() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(selectors, "_SELECTION", selectors._SELECTION._replace(min_kept=2))
        yield


def _build(
    name: str, record: list[Observations], fraction: float = 0.3, budget: int | None = None
) -> Selector:
    settings = SelectorSettings(
        name=name,  # type: ignore[arg-type]
        keep_fraction=fraction,
        budget=budget,
    )
    return build_selector(settings, whole_record=lambda: record, camera=CAMERA)


def _scene(frames: int, points: int = 120, seed: int = 0) -> list[Observations]:
    """A camera that moves sideways past points ahead of it; a point out of the image is not
    seen.
    """
    rng = np.random.default_rng(seed)
    p = rng.uniform([-6, -2, 2], [12, 2, 9], (points, 3))
    record = []
    for k in range(frames):
        p_cam = transform_points(se3_exp([-0.1 * k, 0, 0, 0, 0, 0]), p)
        z = project(CAMERA, p_cam)
        inside = (z[:, 0] >= 0) & (z[:, 0] < 640) & (z[:, 1] >= 0) & (z[:, 1] < 360)
        record.append(
            observations(k, k * 10**8, np.flatnonzero(inside), z[inside], z[inside, 2] >= 0)
        )
    return record


@pytest.mark.parametrize("name", ["all", "visibility", "visibility_whole", "information"])
@settings(max_examples=40)
@given(
    seen=st.lists(st.lists(st.integers(0, 40), unique=True, max_size=30), min_size=1, max_size=8)
)
def test_contract(name: str, seen: list[list[int]]) -> None:
    """A mask of the right length, within the budget, and reproducible."""
    record = [_frame(k, ids) for k, ids in enumerate(seen)]
    first, second = _build(name, record), _build(name, record)
    for frame in record:
        a, b = first.select(frame), second.select(frame)
        assert a.chosen.shape == a.score.shape == (len(frame),)
        np.testing.assert_array_equal(a.chosen, b.chosen)
        if name == "visibility":
            assert a.chosen.sum() == min(len(frame), max(int(np.ceil(0.3 * len(frame))), 2))
        if name == "information":
            assert a.chosen.sum() <= min(len(frame), max(int(np.ceil(0.3 * len(frame))), 2))
        if name == "all":
            assert a.chosen.all()


def test_causal_visibility_prefers_the_most_observed_features(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(selectors, "_SELECTION", selectors._SELECTION._replace(min_kept=1))
    record = [_frame(0, [1, 2]), _frame(1, [2, 3]), _frame(2, [1, 2, 3, 4])]
    selector = _build("visibility", record, fraction=0.25)
    chosen = [frame.ids[selector.select(frame).chosen].tolist() for frame in record]
    assert chosen[0] == [1]  # a tie goes to the older feature
    assert chosen[2] == [2]


def test_causal_visibility_counts_a_bounded_number_of_features(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(selectors, "_MOST_COUNTED", 20)
    selector = selectors.CausalVisibility(SelectorSettings(name="visibility", budget=2))
    for k in range(50):
        new = list(range(100 + 3 * k, 103 + 3 * k))
        selection = selector.select(_frame(k, [7, *new, 9]))
    assert len(selector._seen._count) == 20
    assert selection.score.tolist() == [50, 1, 1, 1, 50]


def test_whole_record_keeps_the_first_share_of_all_features() -> None:
    # Feature k is seen in k + 1 frames; of seven features one is kept.
    record = [_frame(k, list(range(k, 7))) for k in range(7)]
    selector = _build("visibility_whole", record, fraction=1 / 7)
    for frame in record:
        assert frame.ids[selector.select(frame).chosen].tolist() == [6]


def test_whole_record_without_a_record_states_the_remedy() -> None:
    with pytest.raises(ConfigError, match="--save-observations"):
        build_selector(SelectorSettings(name="visibility_whole"), whole_record=None)


@pytest.mark.parametrize("fraction", [0.0, -0.1, 1.5])
def test_fraction_out_of_range(fraction: float) -> None:
    with pytest.raises(ConfigError, match="keep_fraction"):
        build_selector(SelectorSettings(keep_fraction=fraction), whole_record=None)


@pytest.mark.parametrize("name", [*BUDGETED, "visibility_whole"])
def test_budget_is_an_absolute_number(name: str) -> None:
    record = _scene(6)
    selector = _build(name, record, budget=17)
    assert [int(selector.select(frame).chosen.sum()) for frame in record] == [17] * len(record)


def test_information_spreads_over_the_image_and_chooses_near_points() -> None:
    """Many far points in one corner add little more than one of them; a near one elsewhere adds
    translation.
    """
    far = np.stack([np.linspace(10, 12, 30), np.linspace(-8, -7, 30), np.full(30, 30.0)], axis=1)
    near = np.array([[-1.0, 0.5, 2.0], [0.2, 0.6, 2.0], [-0.8, -0.5, 2.0]])
    z = project(CAMERA, np.concatenate([far, near]))
    selector = _build("information", [], budget=6)
    for k in range(3):
        chosen = selector.select(observations(k, k, np.arange(33), z)).chosen
    assert chosen[30:].all()
    assert chosen[:30].sum() == 3


def test_information_predicts_features_that_leave_the_image() -> None:
    """Of two points symmetric in the image, the camera's rotation will hide one: the other is
    chosen.
    """
    p = np.array([[-3.2, 0.0, 5.0], [3.2, 0.0, 5.0]])
    z = project(CAMERA, p)
    turn = MotionPrior(se3_exp([0, 0, 0, 0, 0.1, 0]), 1e-4 * np.eye(6))  # points move to the right
    selector = _build("information", [], budget=1)
    for k in range(2):
        chosen = selector.select(observations(k, k, [1, 0], z), turn).chosen
    assert chosen.tolist() == [True, False]


def test_information_needs_no_stereo_once_the_point_is_triangulated() -> None:
    record = _scene(3, points=30)
    for placed_before in (True, False):
        selector = _build("information", [], budget=100)
        stereo = np.ones(len(record[0]), dtype=np.bool_)
        first = observations(0, 0, record[0].ids, record[0].z, stereo if placed_before else ~stereo)
        selector.select(first)
        left_only = observations(
            1, 1, record[1].ids, record[1].z, np.zeros(len(record[1]), dtype=np.bool_)
        )
        chosen = selector.select(left_only).chosen
        old = np.isin(record[1].ids, record[0].ids)
        assert chosen[old].all() == placed_before
        assert not chosen[~old].any()


def test_information_skips_stale_and_invalid_rows() -> None:
    frame = _scene(1)[0]
    stale = np.arange(len(frame)) % 2 == 0
    z = frame.z.copy()
    z[1, 2] = z[1, 0] + 5  # behind the cameras
    selector = _build("information", [], budget=1000)
    chosen = selector.select(observations(0, 0, frame.ids, z, frame.has_right, stale)).chosen
    assert not chosen[stale].any()
    assert not chosen[1]
    assert chosen[3::2].sum() == frame.has_right[3::2].sum()


def test_information_without_calibration_states_the_remedy() -> None:
    with pytest.raises(ConfigError, match="calibration"):
        build_selector(SelectorSettings(name="information"), whole_record=None)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"budget": 0}, "budget"), ({"keep_fraction": 0.0}, "keep_fraction")],
)
def test_settings_out_of_range(change: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build_selector(SelectorSettings(**change), whole_record=None)  # type: ignore[arg-type]
