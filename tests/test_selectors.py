"""Selectors: one contract for all, and what is particular to each."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vio.errors import ConfigError
from vio.records import Observations, observations
from vio.selectors import Selector, SelectorSettings, build_selector


def _frame(index: int, ids: list[int], seed: int = 0) -> Observations:
    rng = np.random.default_rng((seed, index))
    return observations(index, index * 10**8, ids, rng.uniform(0, [640, 360, 640, 360], (len(ids), 4)))


def _build(name: str, record: list[Observations], fraction: float = 0.3, minimum: int = 2) -> Selector:
    settings = SelectorSettings(name=name, keep_fraction=fraction, minimum=minimum)  # type: ignore[arg-type]
    return build_selector(settings, image_size=(640, 360), whole_record=lambda: record)


@pytest.mark.parametrize("name", ["all", "visibility", "visibility_whole", "grid"])
@given(seen=st.lists(st.lists(st.integers(0, 40), unique=True, max_size=30), min_size=1, max_size=8))
def test_contract(name: str, seen: list[list[int]]) -> None:
    """A mask of the right length, no more than asked for, the same every time."""
    record = [_frame(k, ids) for k, ids in enumerate(seen)]
    first, second = _build(name, record), _build(name, record)
    for frame in record:
        a, b = first.select(frame), second.select(frame)
        assert a.chosen.shape == a.score.shape == (len(frame),)
        np.testing.assert_array_equal(a.chosen, b.chosen)
        if name in ("visibility", "grid"):
            assert a.chosen.sum() == min(len(frame), max(int(np.ceil(0.3 * len(frame))), 2))
        if name == "all":
            assert a.chosen.all()


def test_causal_visibility_prefers_what_was_seen_most() -> None:
    record = [_frame(0, [1, 2]), _frame(1, [2, 3]), _frame(2, [1, 2, 3, 4])]
    selector = _build("visibility", record, fraction=0.25, minimum=1)
    chosen = [frame.ids[selector.select(frame).chosen].tolist() for frame in record]
    assert chosen[0] == [1]  # a tie goes to the older feature
    assert chosen[2] == [2]


def test_whole_record_keeps_the_first_share_of_all_features() -> None:
    # Feature k is seen in k + 1 frames; of seven features one is kept.
    record = [_frame(k, list(range(k, 7))) for k in range(7)]
    selector = _build("visibility_whole", record, fraction=1 / 7)
    for frame in record:
        assert frame.ids[selector.select(frame).chosen].tolist() == [6]


def test_grid_gives_up_no_cell() -> None:
    """Forty long-lived features crowd one corner, three young ones lie elsewhere: all three cells survive."""
    z = np.zeros((43, 4))
    z[:40, :2] = [10, 10]
    z[40:, :2] = [[600, 10], [10, 350], [600, 350]]
    selector = _build("grid", [], fraction=0.1, minimum=4)
    for k in range(5):
        selector.select(observations(k, k, np.arange(40), z[:40]))
    chosen = selector.select(observations(5, 5, np.arange(43), z)).chosen
    assert chosen[40:].all()
    assert chosen.sum() == 5
    crowd_only = _build("visibility", [], fraction=0.1, minimum=4)
    for k in range(5):
        crowd_only.select(observations(k, k, np.arange(40), z[:40]))
    assert not crowd_only.select(observations(5, 5, np.arange(43), z)).chosen[40:].any()


def test_whole_record_without_a_record_says_what_to_do() -> None:
    with pytest.raises(ConfigError, match="--save-observations"):
        build_selector(SelectorSettings(name="visibility_whole"), image_size=None, whole_record=None)


def test_grid_without_image_size_says_what_to_do() -> None:
    with pytest.raises(ConfigError, match="image size"):
        build_selector(SelectorSettings(name="grid"), image_size=None, whole_record=None)


@pytest.mark.parametrize("fraction", [0.0, -0.1, 1.5])
def test_fraction_out_of_range(fraction: float) -> None:
    with pytest.raises(ConfigError, match="keep_fraction"):
        build_selector(SelectorSettings(keep_fraction=fraction), image_size=None, whole_record=None)


def test_cells_out_of_range() -> None:
    with pytest.raises(ConfigError, match="grid_columns"):
        build_selector(SelectorSettings(name="grid", grid_columns=0), image_size=(2, 2), whole_record=None)
