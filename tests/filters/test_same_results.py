"""Results of the filters on fixed flights are those of the last commit that says why they changed.

Bounds of accuracy and consistency leave room for a prior, a gate or a weight that is half as large
again. These figures leave none: a commit that moves them renews the file by

    python -m tests.filters.test_same_results

and says in its message what moved, by how much, and why.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, EXACT_RIG, STEP_NS, T_CAM0_IMU, Flight
from vio.filters.mono_msckf import MonoMsckf
from vio.filters.msckf import Msckf
from vio.filters.settings import MsckfSettings
from vio.geometry.stereo import left_alone
from vio.records import ImuSample, Observations

FILE = Path(__file__).with_name("same_results.json")
SETTINGS = MsckfSettings()
BIAS = np.array([0.01, -0.02, 0.015, 0.1, -0.05, 0.08])
Figures = dict[str, float]


def _figures(estimate: Any) -> Figures:
    """Return the length of each field that is made of numbers, and of its parts where it has some."""
    out = {}
    for field in fields(estimate):
        value = getattr(estimate, field.name)
        if isinstance(value, (float, np.floating)):
            out[field.name] = float(value)
        elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
            out[field.name] = float(np.linalg.norm(value))
            if value.ndim == 2 and len(value) > 3:
                out[f"{field.name} diagonal"] = float(np.sqrt(np.prod(value.diagonal()[:3])))
        elif is_dataclass(value):
            out |= {f"{field.name} {name}": number for name, number in _figures(value).items()}
    return out


def _flown(
    motion: str | None,
    spoil: Any = None,
    bias: Any = None,
    settings: MsckfSettings = SETTINGS,
    *,
    still: bool = False,
) -> Figures:
    reports = []

    class Noted(Msckf):
        def update(self, observations: Observations) -> Any:
            reports.append(super().update(observations))
            return reports[-1]

    _, _, filt = Flight(frames=40, still=still).run(
        settings, motion, bias=bias, spoil=spoil, filter_class=Noted
    )
    counts = {
        "used": sum(report.used for report in reports),
        "gated": sum(report.gated for report in reports),
        "landmarks": reports[-1].landmarks,
        "innovation": sum(report.innovation_median_px or 0.0 for report in reports),
        "NIS": sum(report.nis_per_dof or 0.0 for report in reports),
        "map": float(np.linalg.norm(filt.landmarks().covariance)),
    }
    return _figures(filt.estimate()) | {name: float(value) for name, value in counts.items()}


def _moving(k: int, seen: Observations, noise: Any) -> Observations:
    """A part of the scene moves, another is seen on wrong rows by the right camera."""
    z = seen.z.copy()
    moves = seen.ids % 5 == 0
    z[moves] += 0.6 * max(k - 20, 0)
    z[seen.ids % 7 == 0, 3] += 3.0
    return replace(seen, z=z)


def _blind(k: int, seen: Observations, noise: Any) -> Observations:
    """Nothing is seen for a while, and nothing by the right camera after that."""
    if 18 <= k < 22:
        return seen.take(np.zeros(len(seen), dtype=np.bool_))
    return replace(seen, has_right=seen.has_right & (not 22 <= k < 30))


def _rows_off(k: int, seen: Observations, noise: Any) -> Observations:
    """The right camera is turned and its scale is off."""
    z = seen.z.copy()
    z[:, 3] += 0.4 + 0.002 * (z[:, 0] - CAMERA.cu)
    z[:, 2] -= 0.02 * (z[:, 0] - z[:, 2])
    return replace(seen, z=z)


class _Jumping(Flight):
    """The gyro's bias jumps."""

    def imu(self, noise: np.random.Generator, bias: Any) -> list[ImuSample]:
        """Samples at 200 Hz."""
        return [
            replace(s, gyro=s.gyro + (0.15 if s.time_ns > 40 * STEP_NS else 0.0))
            for s in super().imu(noise, bias)
        ]


def _jumped() -> Figures:
    _, _, filt = _Jumping(frames=55).run(SETTINGS, "imu")
    return _figures(filt.estimate())


def _one_camera() -> Figures:
    flight = Flight(frames=45)
    noise = np.random.default_rng(0)
    filt = MonoMsckf(left_alone(CAMERA), T_CAM0_IMU, SETTINGS)
    samples = flight.imu(noise, BIAS)
    begun = -1
    for k in range(flight.frames):
        while samples and samples[0].time_ns <= k * STEP_NS:
            filt.propagate(samples.pop(0))
        seen = flight.observe(k, 0.3, noise, 80)
        left = replace(seen, has_right=np.zeros(len(seen), dtype=np.bool_))
        if filt.update(left).started and begun < 0:
            begun = k
    return _figures(filt.estimate()) | {"begun": float(begun)}


RUNS: dict[str, Callable[[], Figures]] = {
    "images": lambda: _flown(None),
    "IMU": lambda: _flown("imu", bias=BIAS),
    "known rig": lambda: _flown(None, settings=EXACT_RIG),
    "known rig with IMU": lambda: _flown("imu", bias=BIAS, settings=EXACT_RIG),
    "still": lambda: _flown("imu", bias=BIAS, still=True),
    "velocity": lambda: _flown("velocity"),
    "moving": lambda: _flown("imu", _moving),
    "blind": lambda: _flown(None, _blind),
    "blind with IMU": lambda: _flown("imu", _blind),
    "rows off": lambda: _flown(None, _rows_off),
    "jump": _jumped,
    "one camera": _one_camera,
}


@pytest.mark.parametrize("name", RUNS)
def test_results_are_those_of_the_last_change(name: str) -> None:
    kept = json.loads(FILE.read_text(encoding="utf-8"))
    assert RUNS[name]() == pytest.approx(kept[name], rel=1e-6, abs=1e-12)


if __name__ == "__main__":
    found = {name: each() for name, each in RUNS.items()}
    FILE.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
