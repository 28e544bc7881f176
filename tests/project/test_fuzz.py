"""The fuzzing tool finds what it looks for; it itself runs outside of the tests (docs/testing.md)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tools.fuzz import Messages, _changed_value
from vio.ros2.sensors import Sensors


def test_changed_messages_end_nothing() -> None:
    Messages()(np.random.default_rng(0))


def test_an_error_that_a_message_raises_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(self: Sensors, topic: str, why: str) -> None:
        raise ZeroDivisionError(why)

    monkeypatch.setattr(Sensors, "_refuse", fails)
    with pytest.raises(ZeroDivisionError):
        Messages()(np.random.default_rng(0))


def test_values_are_changed_at_any_depth(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    content = {"a": 1, "b": {"c": [1, 2]}}
    seen = set()
    for seed in range(400):
        path.write_text(json.dumps(content))
        _changed_value(path, ("x",), np.random.default_rng(seed))
        seen.add(path.read_text())
    assert json.dumps(content) not in seen
    assert json.dumps({"a": 1, "b": {"c": [1, "x"]}}) in seen
    assert json.dumps({"b": {"c": [1, 2]}}) in seen
