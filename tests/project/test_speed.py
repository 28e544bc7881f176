"""What `make bench` says of a frame's cost."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools import speed

_LAST = {"calls": 1000, "cpu": 1.0, "wall": 1.0}


@pytest.mark.parametrize(
    ("now", "status"),
    [
        (_LAST, 0),
        ({"calls": 1090, "cpu": 1.9, "wall": 9.0}, 0),
        (_LAST | {"calls": 1110}, 1),
        (_LAST | {"cpu": 2.1}, 1),
    ],
)
def test_more_calls_or_twice_the_time_are_an_error(
    now: dict[str, float], status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(speed, "measured", lambda _: now)
    monkeypatch.setattr(speed, "REFERENCE", tmp_path / "speed.json")
    speed.REFERENCE.write_text(json.dumps(_LAST))
    assert speed.main(["flight"]) == status
    assert speed.main(["flight", "--write"]) == 0
    assert speed.main(["flight"]) == 0


def test_calls_are_counted_in_python_and_c() -> None:
    def work() -> None:
        for _ in range(10):
            len("abc")

    assert speed._calls(work) - speed._calls(lambda: None) == 10


def test_the_kept_figures_are_complete() -> None:
    assert json.loads(speed.REFERENCE.read_text()).keys() == _LAST.keys()
