"""Each limit of what a run says while it works, and of what is drawn of it, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vio.cli.waiting import line_due
from vio.report.compared import apart
from vio.runs import folder

Says = Callable[[float], bool]


def _slow(times: float) -> bool:
    """Whether one frame of a hundred, of so many times the usual time, is counted as slow."""
    work = np.full(100, 10.0)
    work[3] = 10.0 * times
    return folder.start_s(work) > 0.0


def _finished(frames: int) -> Any:
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, :3, 3] = np.random.default_rng(0).normal(size=(frames, 3))
    return SimpleNamespace(
        metrics={"source": "a", "body": "cam0"},
        estimates={"time_ns": np.arange(frames), "T_world_imu": T},
        seconds=np.arange(frames) * 0.1,
    )


LIMITS: dict[str, tuple[Says, float, float]] = {
    "line: at first": (lambda x: line_due(0.0, x), 4.5, 5.5),
    "line: later": (lambda x: line_due(100.0, x), 18.0, 22.0),
    "line: at most": (lambda x: line_due(1e4, x), 27.0, 33.0),
    "frames: slow": (_slow, 9.0, 11.0),
    "compared: frames": (
        lambda n: apart(_finished(int(n)), _finished(int(n))) is not None,
        2,
        3,
    ),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_runs(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
