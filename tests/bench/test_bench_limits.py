"""Limits of benchmarks, of the selection of features, and of robust fits, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from tests.offline.test_limits import ORIGIN
from vio.bench import execute, maps
from vio.bench.figures import error_curve
from vio.datasets.gnss_fixes import GnssFixes
from vio.earth.alignment import Path as MapPath
from vio.earth.alignment import georeference
from vio.earth.geodesy import LocalFrame
from vio.geometry.lie import FloatArray, se3_exp, se3_from_parts, so3_exp
from vio.geometry.stereo import StereoCamera, project
from vio.numerics import robust
from vio.records import MotionPrior, observations
from vio.selection.information import motion_rows
from vio.selection.selectors import InformationGain, SelectorSettings

Says = Callable[[float], bool]
CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)


# Benchmarks


def _is_done(killed: int) -> bool:
    """Whether a task is done whose process is killed so many times."""
    ended: list[tuple[Any, int]] = [(None, 9)] * killed
    results = iter([*ended, ({}, 0)])
    with (
        TemporaryDirectory() as cache,
        patch.object(execute, "rendered_sources", lambda job, cache: job),
        patch.object(execute, "_in_process", lambda job, cache: next(results)),
    ):
        return "failure" not in execute.perform_job({}, cache)


def _is_placed(sigma_m: float) -> bool:
    """Whether a frame is localised in a map, whose position is known so well."""
    kinds = [("index", int), ("time_ns", int), ("covariance", float, (6, 6))]
    causal = np.zeros(1, [*kinds, ("T_map_body", float, (4, 4))])
    causal["covariance"] = np.diag([sigma_m**2 / 3] * 3 + [1e-6] * 3)
    mapped = SimpleNamespace(causal=causal, T_map_body=np.eye(4)[None], loops=())
    result: Any = SimpleNamespace(
        mapped=mapped,
        trajectory=SimpleNamespace(T_world_body=np.eye(4)[None]),
        T_cam0_body=np.eye(4),
        estimates=SimpleNamespace(column=lambda name: [0]),
        body="cam0",
    )
    ate = SimpleNamespace(ate_m=SimpleNamespace(rmse=0.1))
    with (
        patch.object(maps, "replace", lambda *_, **__: None),
        patch.object(maps, "evaluate", lambda *_, **__: ate),
        patch.object(maps, "_causal_figures", lambda *_: {}),
    ):
        nothing: Any = None
        figures = maps.map_figures(result, nothing, nothing, store=None, T_ref_map=None, covered=())
    return bool(figures["placed"] == 1.0)


def test_errors_are_summed_up_as_box_plots_show_them() -> None:
    """Ends, the middle half, the median, and nine of ten."""
    errors = np.random.default_rng(0).permutation(np.linspace(0.0, 1.0, 1001))
    evaluation: Any = SimpleNamespace(rows=np.arange(1001), errors_m=errors)
    least, low, first, median, third, high, most = error_curve(evaluation, None)["quantiles_m"]
    assert (least, median, most) == (0.0, 0.5, 1.0)
    assert third - first == pytest.approx(0.5)
    assert high - low == pytest.approx(0.9)


# Selection


def _is_foreseen(depth_m: float) -> bool:
    """Whether a point counts at the horizon, of a camera that approaches it by a metre a frame."""
    selector = InformationGain(SelectorSettings(name="information"), CAMERA)
    motion = MotionPrior(se3_exp([0.0, 0.0, -1.0, 0.0, 0.0, 0.0]), 1e-4 * np.eye(6))
    for k in (0, 1):
        z = project(CAMERA, np.array([[0.0, 0.0, depth_m + 1.0 - k]]))
        seen = observations(k, k, [7], z, [True])
        L = selector._model.add_frame(seen, motion)
        selector._model.mark_used(seen, np.ones(1, np.bool_))
    return bool(L[0, -1].any())


def _pixel_sigma() -> float:
    """Of what a point tells that was seen once before: its pixels are predicted as well as they
    are measured, so it has half the information of a known one.
    """
    selector = InformationGain(SelectorSettings(name="information"), CAMERA)
    p = np.array([[0.3, 0.2, 4.0]])
    for k in (0, 1):
        seen = observations(k, k, [7], project(CAMERA, p), [True])
        L = selector._model.add_frame(seen, None)
        selector._model.mark_used(seen, np.ones(1, np.bool_))
    known = motion_rows(CAMERA, p)[0]
    return float(np.linalg.norm(known) / np.sqrt(2.0) / np.linalg.norm(L[0, 0]))


# Robust fits


def _aligned(off_m: float) -> tuple[bool, list[float]]:
    """Whether a fix of a drive is used that is off, and how convex the steps of the fit are."""
    t = np.arange(60) * 5.0
    p = np.column_stack([3.0 * t, 0.002 * t**2, 0.0 * t])
    T = se3_from_parts(so3_exp(np.zeros((60, 3))), p)
    times = np.asarray(1e9 * t, dtype=np.int64)
    none = np.zeros(0, dtype=np.int64)
    path = MapPath(times, T, none, none, np.array([0.0, 0.0, 1.0]), 0.01, none)
    p[30, 1] += off_m
    fixes = GnssFixes(
        times, LocalFrame(ORIGIN).geodetic(p), np.tile(np.eye(3), (60, 1, 1)), t >= 0.0
    )
    steps: list[float] = []

    def recorded(squared: FloatArray, mu: FloatArray, limit: FloatArray) -> FloatArray:
        steps.append(float(mu[0]))
        return robust.truncated_weights(squared, mu, limit)

    with patch("vio.earth.alignment.truncated_weights", recorded):
        found = georeference(path, fixes, np.zeros(3))
    return bool(found.used[30]), steps


def _sharper() -> float:
    """From step to step."""
    mu = _aligned(50.0)[1]
    return mu[1] / mu[0]


LIMITS: dict[str, tuple[Says, float, float]] = {
    "bench: killed": (lambda n: not _is_done(int(n)), 2, 3),
    "bench: placed": (lambda x: not _is_placed(x), 0.95, 1.05),
    "selection: horizon": (_is_foreseen, 3.9, 4.3),
    "selection: pixels": (lambda x: _pixel_sigma() < x, 0.45, 0.55),
    "fit: cut off": (lambda x: not _aligned(x)[0], 3.4, 4.1),
    "fit: sharper": (lambda x: _sharper() < x, 1.5, 1.7),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_benchmarks(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
