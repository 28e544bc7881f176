"""Each limit of the evaluation of trajectories and of the files that they are in, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from scipy import constants

from vio.bench import figures as bench_figures
from vio.bench import maps
from vio.bench.bench import has_succeeded
from vio.bench.compare import Effect, _cases, _verdict, effect_of
from vio.bench.report import _worst_sequences
from vio.bench.suite import SUCCESS_PERCENT, _seeds
from vio.bench.tables import METRICS, _part
from vio.earth.alignment import _rigid_fit
from vio.errors import DataError, VioError
from vio.evaluation import quaternion_order, reference_axes, trajectories
from vio.evaluation.association import _by_time
from vio.evaluation.errors_along_path import kitti_error, relative_error_distance
from vio.evaluation.field_agreement import DisparityField, field_difference
from vio.evaluation.trajectories import _notes, metres_text, rotation_drift_text
from vio.files import schema
from vio.files import trajectories as files
from vio.files.stamps import FRAME_PACE, parse_stamps
from vio.files.text import check_increasing
from vio.files.units import ACCEL_UNITS
from vio.files.yaml_text import read_yaml
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp, so3_log
from vio.records import NS_PER_S, Trajectory

Says = Callable[[float], bool]


def _is_refused(call: Callable[[], object]) -> bool:
    try:
        call()
    except (VioError, ValueError):
        return True
    return False


# Figures


def _straight(steps: int, step_m: float = 1.0) -> FloatArray:
    T = np.tile(np.eye(4), (steps + 1, 1, 1))
    T[:, 0, 3] = step_m * np.arange(steps + 1)
    return T


def _segments(steps: int, lengths_m: tuple[float, ...] | None = None) -> int:
    T = _straight(steps)
    found = kitti_error(T, T) if lengths_m is None else kitti_error(T, T, lengths_m)
    return 0 if found is None else found.segments


def _has_pair(step_m: float) -> bool:
    T = _straight(9, step_m)
    found = relative_error_distance(T, T, 1.0)
    return found is not None


def _trajectory(count: int, position_m: float = 0.0) -> Trajectory:
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3] = position_m
    return Trajectory(T, np.arange(count) * NS_PER_S, "imu")


def _suspicion(
    long_m: float = 10.0,
    short_m: float = 10.0,
    matched: int = 100,
    last: int = 99,
    reference: int = 100,
) -> str:
    rows = np.linspace(0, last, matched).astype(np.int64)
    return " ".join(_notes(short_m, long_m, rows, _trajectory(100), _trajectory(reference), None))


def _has_scale(poses: int) -> bool:
    T = se3_from_parts(np.tile(np.eye(3), (poses, 1, 1)), np.eye(3)[np.arange(poses) % 3])
    return trajectories._scale_free(T, T) is not None


def _is_matched(limit_s: float) -> bool:
    times = np.arange(5) * NS_PER_S
    return not _is_refused(lambda: _by_time(times, times, limit_s))


def _other_order(as_read_deg: float, exchanged_deg: float) -> bool:
    """Whether quaternions are read in the other order, by what both leave of attitudes."""
    assumed = Trajectory(
        np.tile(np.eye(4), (5, 1, 1)), np.arange(5), "imu", orientations="w last, assumed"
    )
    spreads = iter([as_read_deg, exchanged_deg, 1e3, 1e3])
    with patch.object(quaternion_order, "_spread_deg", lambda *_, **__: next(spreads)):
        return bool(quaternion_order.settled_orders(assumed, _trajectory(5), 0.01)[2])


def _axes_of_world(ratio: float) -> bool:
    """Whether other axes of the world explain attitudes, that explain them better by a ratio."""
    R = np.tile(np.eye(3), (9, 1, 1))
    turned = R @ so3_exp([0.0, 0.0, np.radians(70.0)])
    spreads = iter([10.0] + [90.0] * 6 + [10.0 * ratio])
    with patch.object(reference_axes, "_spread_deg", lambda differences: next(spreads)):
        note = reference_axes.attitude_note(turned, R, 0.0)
    return "in a world with other axes" in str(note)


def _field(focal: float = 400.0) -> DisparityField:
    # terms of the right columns and of the rows
    return DisparityField(
        np.array([focal, focal, 320.0, 240.0]), (640, 480), np.zeros(10), 1e-6 * np.eye(10)
    )


def _spread_of_places(axis: int) -> float:
    """Their standard deviation over that of all pixels."""
    size = (640, 480)[axis]
    return float(_field().places()[:, axis].std() / (size / np.sqrt(12.0)))


def _turn_of_fit(metres: float) -> float:
    """How much of a turn of all attitudes a rigid fit takes up, whose positions contradict it at
    such a distance from their middle.
    """
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :2, 3] = metres * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    turned = T.copy()
    turned[:, :3, :3] = so3_exp([0.0, 0.0, 1e-3])
    return float(so3_log(_rigid_fit(T, turned)[0][:3, :3])[2] / 1e-3)


# Files


def _pose_is_read(norm: float = 1.0, metres: float = 0.0) -> bool:
    with TemporaryDirectory() as folder:
        file = Path(folder, "a.tum")
        file.write_text("".join(f"{k}.0 {metres!r} 0 0 0 0 0 {norm!r}\n" for k in range(3)))
        return not _is_refused(lambda: files.read_trajectory(file))


def _matrix_is_read(deviation: float) -> bool:
    """Of KITTI's form, whose rotations are so far from orthonormal."""
    scale = float(np.sqrt(1.0 + deviation))
    with TemporaryDirectory() as folder:
        file = Path(folder, "a.txt")
        row = f"{scale!r} 0 0 0 0 {scale!r} 0 0 0 0 {scale!r} 0\n"
        file.write_text(3 * row)
        return not _is_refused(lambda: files.read_trajectory(file))


def _frames_are_listed(letters: int) -> bool:
    frames = np.array([1, 2])
    trajectory = Trajectory(np.tile(np.eye(4), (2, 1, 1)), None, "cam0", frames)
    with (
        TemporaryDirectory() as folder,
        patch.object(files, "frames_text", lambda frames: "a" * letters),
        patch.object(files, "logger") as log,
    ):
        files.write_kitti(Path(folder, "a.txt"), trajectory)
    return "gaps" not in str(log.warning.call_args)


def _times_are_rounded(repeated: int) -> bool:
    times = np.arange(200)
    times[1 : 2 * repeated : 2] -= 1
    with pytest.raises(DataError) as error:
        check_increasing(times, str)
    return "too few digits" in str(error.value)


def _unit_of_step(step: float) -> int:
    """The nanoseconds of one count of stamps that are so far apart."""
    texts = [str(round(step * k)) for k in range(4)]
    found = parse_stamps(texts, str, pace=FRAME_PACE, doubts=[])
    return round(float(found[1]) / round(step))


# The bench


def _verdict_of(p: float = 1e-3, ratio: float = 1.5) -> bool:
    """Whether a change is called one."""
    return _verdict(Effect(9, ratio, None, None, p), p, 0.1) == "worse"


def _interval() -> float:
    """The half width of the interval of two cases, in their standard error."""
    effect = effect_of([0.0, 0.02])
    assert effect.high is not None
    return float((np.log(effect.high) - 0.01) / 0.01)


def _differs_from_rest(ate_m: float) -> bool:
    old, new = (SimpleNamespace(sequence="a", value=lambda m, v=v: v) for v in (1e-6, ate_m))
    return _cases([(old, new)], METRICS[0]) != {"a": [0.0]}  # type: ignore[list-item]


def _are_left_out(sequences: int) -> bool:
    cells = {METRICS[0].name: SimpleNamespace(worst=1.0)}
    rows: Any = [SimpleNamespace(sequence=str(k), cells=cells) for k in range(sequences)]
    return len(_worst_sequences(rows)) < sequences


def _succeeds(coverage: float = 1.0, percent: float = 0.1) -> bool:
    figures = {"ate_m": percent, "reference_m": 100.0, "coverage": coverage}
    return bool(has_succeeded({"failure": None, "figures": figures}, SUCCESS_PERCENT))


def _says_coverage(share: float) -> bool:
    names = ("coverage", METRICS[0].name)
    row: Any = SimpleNamespace(cells=dict.fromkeys(names, SimpleNamespace(median=share)))
    return _part(row, METRICS[0]) != ""


def _is_wrong(metres: float = 0.0, degrees: float = 0.0) -> bool:
    return maps._is_false((metres, degrees))


def _is_revisit(metres: float = 0.0, degrees: float = 0.0) -> bool:
    T = np.eye(4)
    T[0, 3] = metres
    T[:3, :3] = so3_exp([0.0, np.radians(degrees), 0.0])
    return bool(maps._revisits({0: np.eye(4), 1: T}, np.array([0, 60 * NS_PER_S])))


def _is_covered(late_ms: float) -> bool:
    frames = np.arange(5) * NS_PER_S
    late = Trajectory(np.tile(np.eye(4), (5, 1, 1)), frames + round(1e6 * late_ms), "imu")
    return bool(bench_figures.coverage(frames, late) > 0.5)


LIMITS: dict[str, tuple[Says, float, float]] = {
    "words: millimetres": (lambda x: "mm" not in metres_text(x), 0.009, 0.011),
    "words: per metre": (lambda x: "100 m" in rotation_drift_text(1.0, [x]), 9.0, 11.0),
    "far": (
        lambda x: _is_refused(lambda: trajectories._require_finite("a", _trajectory(3, x))),
        0.9e12,
        1.1e12,
    ),
    "scale: poses": (lambda n: _has_scale(int(n)), 2, 3),
    "paths: ratio": (lambda x: "travels" in _suspicion(10.0 * x), 1.45, 1.55),
    "paths: short": (lambda x: "travels" in _suspicion(x, 0.01), 0.9, 1.1),
    "paths: unit": (lambda x: "milli" not in _suspicion(10e3 * (1.0 + x)), 0.09, 0.11),
    "match: a part": (lambda n: "this part" not in _suspicion(last=int(n)), 18, 21),
    "match: few": (
        lambda n: "poses match" not in _suspicion(matched=int(n)),
        48,
        52,
    ),
    "match: time": (lambda x: not _is_matched(x), 0.95e9, 1.05e9),
    "KITTI: shortest": (lambda n: _segments(int(n)) > 0, 99, 102),
    "KITTI: longest": (
        lambda n: _segments(int(n)) > _segments(int(n), tuple(np.arange(1, 8) * 100.0)),
        799,
        802,
    ),
    "KITTI: step": (lambda n: _segments(int(n), (100.0,)) > 1, 110, 111),
    "RPE: distance": (lambda x: not _has_pair(x), 1.09, 1.11),
    "order: large": (lambda x: _other_order(x, 0.01), 4.5, 5.5),
    "order: better": (lambda x: _other_order(50.0, 50.0 / x), 4.8, 5.2),
    "axes: better": (_axes_of_world, 2.8, 3.2),
    "field: columns": (lambda x: _spread_of_places(0) < x, 0.982, 0.99),
    "field: rows": (lambda x: _spread_of_places(1) < x, 0.92, 0.96),
    "field: cameras": (
        lambda x: field_difference(_field(), _field(400.0 * (1 + x))) is None,
        0.009,
        0.011,
    ),
    "earth: attitudes": (lambda x: _turn_of_fit(x) < 0.5, 90.0, 110.0),
    "file: norm": (lambda x: not _pose_is_read(1.0 + x), 0.019, 0.021),
    "file: rotation": (lambda x: not _matrix_is_read(x), 0.9e-3, 1.1e-3),
    "file: far": (lambda x: not _pose_is_read(metres=x), 0.9e12, 1.1e12),
    "file: frames": (lambda n: not _frames_are_listed(int(n)), 100, 101),
    "times: rounded": (lambda n: _times_are_rounded(int(n)), 11, 12),
    "times: unit": (lambda x: _unit_of_step(x) != 1000, 1.9e6, 2.1e6),
    "JSON: whole numbers": (lambda x: not schema._is_usable(int(x)), 2**62.9, 2**63.1),
    "JSON: shown": (lambda n: "…" in schema._shown("a" * (int(n) - 2)), 40, 41),
    "YAML: values": (
        lambda n: _is_refused(lambda: read_yaml(f"[{'1,' * int(n)}]")),
        19_000,
        21_000,
    ),
    "YAML: depth": (lambda n: _is_refused(lambda: read_yaml("[" * int(n) + "]" * int(n))), 32, 33),
    "bench: chance": (lambda x: not _verdict_of(p=x), 0.045, 0.055),
    "bench: change": (lambda x: _verdict_of(ratio=1.0 + x), 0.009, 0.011),
    "bench: interval": (lambda x: _interval() < x, 12.0, 13.5),
    "bench: floor": (_differs_from_rest, 0.9e-5, 1.1e-5),
    "bench: worst": (lambda n: _are_left_out(int(n)), 24, 25),
    "bench: covered": (lambda x: _succeeds(coverage=x), 0.88, 0.92),
    "bench: success": (lambda x: not _succeeds(percent=x), 0.9, 1.1),
    "bench: all frames": (lambda x: _says_coverage(1.0 - x), 0.004, 0.006),
    "bench: seeds": (lambda n: _is_refused(lambda: _seeds(int(n), "a")), 1000, 1001),
    "maps: false": (lambda x: _is_wrong(x), 0.45, 0.55),
    "maps: false turn": (lambda x: _is_wrong(0.0, x), 4.5, 5.5),
    "maps: revisit": (lambda x: not _is_revisit(x), 2.8, 3.2),
    "maps: revisit, turned": (lambda x: not _is_revisit(0.0, x), 28.0, 32.0),
    "frames: covered": (lambda x: not _is_covered(x), 9.0, 11.0),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_evaluation_and_files(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


def test_g_is_the_standard_one() -> None:
    assert ACCEL_UNITS["g"] == pytest.approx(constants.g)
