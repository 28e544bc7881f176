"""Each limit of what gyro, accelerometer and stamps show beside the images, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.guard.test_matches import CAMERA
from tests.monitor.test_limits import _estimate
from vio.geometry.lie import FloatArray
from vio.monitor import frozen, gyro, gyro_fit, inertial, samples
from vio.monitor.accelerometer import _opposite, _wrong_axes, _wrong_scale, judge_force
from vio.monitor.force_fit import WINDOW_S, Evidence, ForceFit, _windows, fit_force
from vio.monitor.frozen import FrozenImages
from vio.monitor.gyro_fit import judge_offset, judge_stamps
from vio.monitor.health import RefusalReport
from vio.monitor.imu_faults import _FrameTimes
from vio.monitor.inertial import InertialCheck
from vio.monitor.motion import CameraTwists, Record
from vio.monitor.reading import ReadingCheck
from vio.monitor.samples import judge_size
from vio.records import ImuSample, UpdateReport, observations

Says = Callable[[float], bool]
I3 = np.eye(3)


# The accelerometer


def _force(windows: int = 3, **costs: Any) -> Any:
    return SimpleNamespace(windows=windows, window_s=WINDOW_S, **costs)


def _other_axes(ratio: float, windows: int) -> bool:
    """Whether other axes are named that fit better than the given ones by a ratio."""

    def cost(C: FloatArray) -> float:
        return 1.0 if np.array_equal(np.abs(C), I3) else 1.0 / ratio

    return _wrong_axes(_force(windows, cost=cost), I3) is not None


def _other_sign(ratio: float) -> bool:
    """Whether the opposite sign is named that fits better than the given one by a ratio."""

    def cost(C: FloatArray) -> float:
        return 1.0 if C[0, 0] > 0.0 else 1.0 / ratio

    return _opposite(_force(2, cost=cost, sign=lambda C: (-1.0, 0.1)), I3) is not None


def _sign_is_known(sigmas: float) -> bool:
    evidence: Any = SimpleNamespace(
        gyro_fit=SimpleNamespace(force=np.zeros((4, 3)), covered=np.ones(4, np.bool_)),
        force=_force(sign=lambda C: (1.0, 1.0 / sigmas)),
        early_force=None,
        R_cam0_imu=I3,
        last=False,
    )
    return judge_force(evidence, 1.0, None)[1]


def _scaled(factor: float = 9.0, explained: float = 99.0) -> bool:
    """Whether a camera's motion is of another scale, by a factor that explains its path."""

    def cost(C: FloatArray) -> float:
        return {0.0: explained, 1.0: 99.0}.get(float(C[0, 0]), 1.0)

    return _wrong_scale(_force(sign=lambda C: (factor, 0.01), cost=cost), I3, CAMERA) is not None


def _record(intervals: int, dt: float = 0.125) -> Record:
    t = np.linspace(-1.0, intervals * dt + 1.0, 40 * (intervals + 16))
    rng = np.random.default_rng(0)
    begin = dt * np.arange(intervals)
    return Record(
        t, np.cumsum(rng.normal(size=(len(t), 6)), 0), begin, begin + dt,
        rng.normal(size=(intervals, 6)), 0,
    )  # fmt: skip


def _gyro_of(record: Record, **more: Any) -> Any:
    count = len(record.begin)
    rng = np.random.default_rng(1)
    return SimpleNamespace(
        gyro=np.zeros((count, 3)),
        A=I3,
        b=np.zeros(3),
        unexplained=0.0,
        covered=np.ones(count, np.bool_),
        force=rng.normal(size=(count, 3)),
        **more,
    )


def _window_count(intervals: int) -> int:
    """Windows of so many intervals of an eighth of a second."""
    record = _record(intervals)
    return len(list(_windows(record, _gyro_of(record), WINDOW_S)))


def _is_fitted(windows: int) -> bool:
    record = _record(16 * windows)
    return fit_force(record, _gyro_of(record), np.zeros(3)) is not None


def _is_final(windows: int) -> bool:
    check = InertialCheck(CAMERA, np.eye(4), extrinsics_known=False)
    size: Any = SimpleNamespace(unit=1.0)
    fit: Any = SimpleNamespace(count=100)
    nothing: Any = None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inertial, "fit_force", lambda *_: _force(windows))
        return check._evidence(size, nothing, fit, last=False).force is not None


def _evidence(**more: Any) -> Evidence:
    given: Any = {
        "R_cam0_imu": I3, "gyro_fit": None, "force": None, "early_force": None,
        "force_final": True, "clipped": False, "last": False,
    }  # fmt: skip
    return Evidence(**(given | more))


def _is_brief(count: int) -> bool:
    fit: Any = SimpleNamespace(count=count)
    return _evidence(gyro_fit=fit).brief


def _unexplained(column: int, sigma: float) -> float:
    """Misfit that is left of one of a standard deviation where a bias or a lever arm may explain
    it, which nothing else shows.
    """
    h = np.zeros((1, 15))
    h[0, column] = 0.02**2 / sigma
    fit = ForceFit(np.zeros((1, 15, 15)), h, np.full(1, 0.02**2), np.ones(1))
    return fit.reduced()[2]


FORCE: dict[str, tuple[Says, float, float]] = {
    "axes": (lambda x: _other_axes(x, 3), 2.6, 3.4),
    "axes: early": (lambda x: _other_axes(x, 2), 7.8, 10.2),
    "sign: early": (_other_sign, 7.8, 10.2),
    "sign": (_sign_is_known, 5.3, 6.7),
    "scale": (_scaled, 2.6, 3.4),
    "scale: explained": (lambda x: _scaled(explained=x), 3.5, 4.5),
    "window": (lambda n: _window_count(int(n)) > 0, 15, 16),
    "windows": (lambda n: _is_fitted(int(n)), 1, 2),
    "windows: final": (lambda n: _is_final(int(n)), 2, 3),
    "first evaluation": (lambda n: not _is_brief(int(n)), 59, 60),
    "bias": (lambda x: _unexplained(9, x) > 0.0, 0.26, 0.34),
    "lever arm": (lambda x: _unexplained(12, x) > 0.0, 0.87, 1.13),
}


# The gyro


def _gyro_says(
    unexplained: float = 0.0,
    excess: float = 0.0,
    *,
    clipped: bool = False,
    count: int = 100,
    last: bool = False,
    scale: float = 3.0,
    words: str | None = None,
) -> list[str]:
    """The faults that are found; with `words`, of the messages that have them alone."""
    fit: Any = SimpleNamespace(
        unexplained=unexplained,
        tolerance=0.2,
        excess=lambda C, scale: excess,
        fits=lambda C: True,
        scale=lambda C: scale,
        count=count,
        S_cc=I3,
        S_gg=I3,
        is_chance=False,
        dead_axes=lambda R: [],
    )
    evidence = _evidence(gyro_fit=fit, clipped=clipped, last=last)
    return [f.fault for f in gyro.judge_gyro(evidence, 1.0) if words is None or words in f.message]


def _of_times(scale: float) -> bool:
    """Whether a factor on the gyro may be that of all times."""
    words = "are 0.1 times the true ones"
    return _gyro_says(excess=1.0, scale=scale, words=words) == ["gyro units"]


def _agrees(unexplained: float) -> bool:
    fit: Any = SimpleNamespace(unexplained=unexplained)
    return _evidence(gyro_fit=fit).gyro_agrees


def _offset_is_named(offset_s: float = 0.1, as_stamped: float = 0.9) -> bool:
    fit: Any = SimpleNamespace(offset_s=offset_s, unexplained=0.1, noise_radps=0.0, is_chance=False)
    stamped = SimpleNamespace(unexplained=as_stamped)
    nothing: Any = None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gyro_fit, "_at_offset", lambda *_: stamped)
        return judge_offset(fit, nothing, 10) is not None


def _is_chance(offset_s: float = 1.0, stretch: float = 3.0) -> bool:
    """Whether a map that stretches one axis is one by chance, at an offset of the clocks."""
    gyro_rates = np.random.default_rng(0).normal(size=(200, 3))
    camera = gyro_rates * [stretch, 1.0, 1.0]
    S_cc, S_cg, S_gg = (
        a.T @ b / 200 for a, b in ((camera, camera), (camera, gyro_rates), (gyro_rates,) * 2)
    )
    rest = (np.zeros((200, 3)), np.ones(200, np.bool_), np.ones(200))
    fit = gyro_fit.GyroFit(
        offset_s, S_cc, S_cg, S_gg, I3, np.zeros(3), 0.0, 0.0, 200, camera, gyro_rates, *rest
    )
    return fit.is_chance


def _jitters(
    count: int = 200,
    rate: float = 1.0,
    sigma_s: float = 2e-3,
    slope: float = 1.0,
    correlation: float = 1.0,
) -> bool:
    """Whether stamps jitter whose intervals scatter by a deviation, of which the gyro misses a
    part, and more that is not correlated.
    """
    rng = np.random.default_rng(0)
    off = rng.normal(size=count)
    off -= np.median(off)
    off *= sigma_s / (1.4826 * np.median(np.abs(off)))
    other = rng.normal(size=count)
    other -= off * (off @ other) / (off @ off)
    other *= np.linalg.norm(off) / np.linalg.norm(other) * np.sqrt(correlation**-2 - 1.0)
    dt = 0.05 + off
    end = np.cumsum(dt)
    t = np.linspace(-1.0, end[-1] + 1.0, 2000)
    integral = np.zeros((2000, 6))
    integral[:, 2] = rate * t
    twists = np.zeros((count, 6))
    twists[:, 5] = rate * (dt - slope * (off + other)) / dt
    return judge_stamps(Record(t, integral, end - dt, end, twists, 0)) is not None


GYRO: dict[str, tuple[Says, float, float]] = {
    "disagrees": (lambda x: _gyro_says(x) == ["gyro disagrees"], 0.45, 0.55),
    # 0.3 + 0.775**2 is 0.9
    "as none": (lambda x: _gyro_says(0.3, x) == ["gyro disagrees"], 0.73, 0.82),
    "as none: short": (lambda n: _gyro_says(0.3, 1.0, count=int(n), last=True) != [], 19, 20),
    "as none: end": (lambda last: _gyro_says(0.3, 1.0, count=20, last=last > 0.5) != [], 0, 1),
    "times: little": (lambda x: _of_times(x), 9.4, 9.7),
    "times: much": (lambda x: not _of_times(x), 10.3, 10.6),
    "clipped": (lambda x: _gyro_says(excess=x, clipped=True) == [], 0.55, 0.45),
    "brief": (lambda x: _gyro_says(excess=x, count=30) == [], 0.77, 0.63),
    "agrees": (lambda x: not _agrees(x), 0.17, 0.23),
    "offset": (lambda x: _offset_is_named(x), 0.017, 0.023),
    "offset: clearly": (lambda x: _offset_is_named(as_stamped=x), 0.18, 0.225),
    "chance: offset": (lambda x: _is_chance(offset_s=x), 0.09, 0.11),
    "chance: stretch": (lambda x: _is_chance(stretch=x), 1.4, 1.7),
    "stamps: intervals": (lambda n: _jitters(int(n)), 39, 40),
    "stamps: rate": (lambda x: _jitters(rate=x), 0.085, 0.115),
    "stamps: deviation": (lambda x: _jitters(sigma_s=x), 4.3e-4, 5.7e-4),
    "stamps: correlation": (lambda x: _jitters(correlation=x), 0.64, 0.76),
    "stamps: too little": (lambda x: _jitters(slope=x), 0.6, 0.8),
    "stamps: too much": (lambda x: not _jitters(slope=x), 1.2, 1.4),
}


# Evaluations


class _Motion:
    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count


def _judged(seen: int, new: int) -> bool:
    """Whether an IMU is judged after so many new intervals, beside those seen before."""
    check: Any = InertialCheck(CAMERA, np.eye(4))
    judged: list[int] = []
    check._seen = seen
    check._camera = SimpleNamespace(frame=lambda _: _Motion(new))
    check._motion = SimpleNamespace(add=lambda _: None, joined=lambda: None)
    check._judge = lambda *, last: judged.append(1) or []
    check._compare(None)
    return bool(judged)


def _needed() -> int:
    """Intervals that a fit needs at the end of a run."""
    check: Any = InertialCheck(CAMERA, np.eye(4))
    needed: list[int] = []
    check._samples = SimpleNamespace(table=lambda: (np.arange(2) * 10**7, np.ones((2, 6))))
    check._motion = SimpleNamespace(joined=lambda: object())
    check._judge_stationary = lambda *_, **__: []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inertial, "record_of", lambda *_: None)
        patch.setattr(inertial, "fit_gyro", lambda record, least: needed.append(least))
        check._judge(last=True)
    return needed[0]


def _kept_tracks(count: int) -> int:
    twists = CameraTwists(CAMERA)
    z = np.random.default_rng(0).uniform(50.0, 400.0, (count, 4))
    twists.frame(observations(0, 0, np.arange(count), z))
    return len(twists._kept[0])


def _twists(links: int = 40, step_s: float = 0.1) -> int:
    """Intervals whose motion is known, of frames that share so many features."""
    twists = CameraTwists(CAMERA)
    rng = np.random.default_rng(0)
    z = rng.uniform([100.0, 100.0, 60.0, 100.0], [500.0, 400.0, 80.0, 400.0], (40, 4))
    z[:, 2] = z[:, 0] - rng.uniform(5.0, 20.0, 40)
    for k in range(2):
        ids = np.where(np.arange(40) < links, np.arange(40), np.arange(40) + 100 * k)
        twists.frame(observations(k, round(1e9 * step_s * k), ids, z))
    found = twists.flush()
    return 0 if found is None else len(found)


def _looks(frames: int) -> list[int]:
    """Matches that are looked at, in each look, of frames with one match each."""
    nothing: Any = None
    check = ReadingCheck(nothing, nothing)
    looks: list[int] = []
    off: Any = SimpleNamespace(code="stereo-calibration-off")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "vio.calibration.readings.other_reading", lambda rig, camera, z: looks.append(len(z))
        )
        for k in range(frames):
            check.frame(observations(k, k, [1], np.ones((1, 4))), [off])
    return looks


def _first_known(frames: int) -> bool:
    """Whether the first of so many frames is known as the first one after a time."""
    times = _FrameTimes()
    for k in range(frames):
        times.add(k, 10 + k)
    return times.first_after(5) == 0


def _size_fault(magnitude: float) -> str:
    accel = np.tile([0.0, 0.0, magnitude], (200, 1))
    finding = judge_size((1e7 * np.arange(200)).astype(np.int64), accel).finding
    return "" if finding is None else finding.explanation


@pytest.mark.parametrize(
    ("shown", "is_set", "words"),
    [
        (9.81, 1.62, "leave out the setting"),
        (9.81, 9.78, ""),
        (1.62, 1.62, ""),
        (3.71, 3.71, ""),
        (1.0, 1.0, "in g"),  # the Earth's, whatever is set
        (25.0, 25.0, ""),
    ],
)
def test_gravity_may_be_set_to_another_planets(shown: float, is_set: float, words: str) -> None:
    times_ns = (1e7 * np.arange(200)).astype(np.int64)
    finding = judge_size(times_ns, np.tile([0.0, 0.0, shown], (200, 1)), is_set).finding
    if words:
        assert finding is not None
        assert words in finding.explanation
    else:
        assert finding is None


def _is_together(places: int) -> bool:
    """Whether features are said to lie together that are refused in so many places of an image of
    600 by 400 pixels, each 100 pixels from the next.
    """
    report = RefusalReport(imu=False)
    found = []
    u, v = np.meshgrid(np.arange(0.0, 601.0, 10.0), np.arange(0.0, 401.0, 10.0))
    z = np.column_stack([u.ravel(), v.ravel(), u.ravel() - 5.0, v.ravel()])
    at = [[50.0 + 100.0 * (k % 6), 50.0 + 100.0 * (k // 6)] for k in range(places)]
    near = np.abs(z[:, None, :2] - np.array(at)).max(axis=2) < 15.0
    gone = np.flatnonzero(near.any(axis=1))
    for k in range(25):
        seen = observations(k, 50_000_000 * k, np.arange(len(z)), z)
        update = UpdateReport(10, 90, 0, 0, 0.3, 1.0, gone)
        found += report.frame(seen, update, _estimate(0.05 * k))
    return "lie together" in found[0].message


def _ends(run: int, levels: int = 200, held: int = 20) -> bool:
    """Whether readings end at a range that stay at their largest for a run, after as many levels
    before, each of which is held for some readings.
    """
    x = np.repeat(np.arange(float(levels - 1)), held)
    x = np.concatenate([x, np.full(run, float(levels))])
    values = np.random.default_rng(0).normal(size=(len(x), 6))
    values[:, 0] = x
    at = x == x.max()
    return samples._run_at_end(values, values[1:] == values[:-1], at, 0) > 0


def _is_smooth(turns: float) -> bool:
    """Whether axes have no noise whose changes have another sign than the one before in a share."""
    signs = np.cumprod(np.where(np.arange(1000) % 100 < round(100 * turns), -1.0, 1.0))
    values = np.tile(np.concatenate([[0.0], np.cumsum(signs)])[:, None], 6)
    return samples._has_no_noise(values, np.ones(1001, np.bool_), 0)


EVALUATIONS: dict[str, tuple[Says, float, float]] = {
    "later": (lambda n: _judged(1000, int(n)), 149, 150),
    "enough": (lambda n: not _judged(int(n) - 60, 60), 399, 400),
    "at the end": (lambda n: _needed() < n, 17, 24),
    "tracks": (lambda n: _kept_tracks(int(n)) < n, 80, 81),
    "links": (lambda n: _twists(int(n)) > 0, 14, 15),
    "interval": (lambda x: _twists(step_s=x) == 0, 0.21, 0.29),
    "looks: first": (lambda n: len(_looks(int(n))) > 0, 9, 10),
    "looks: second": (lambda n: len(_looks(int(n))) > 1, 39, 40),
    "looks: matches": (lambda n: _looks(40)[1] < n, 17, 24),
    "frames with stamps": (lambda n: not _first_known(int(n)), 200, 201),
    "size: gravity": (lambda x: _size_fault(x) == "", 4.5, 5.3),
    "size: mg": (lambda x: "in mg" not in _size_fault(x), 1500.0, 1700.0),
    "clipped: chance": (lambda n: _ends(int(n)), 355, 364),
    "clipped: levels": (lambda n: _ends(30, int(n), 1), 19, 20),
    "clipped: smooth": (lambda x: not _is_smooth(x), 0.08, 0.12),
    "refused together": (lambda n: not _is_together(int(n)), 8, 12),
}


# Repeated images


def _frozen() -> Any:
    return FrozenImages()


def _unmoved_until(rows: int) -> bool:
    """Whether features have not moved, of which those from one on have."""
    seen = observations(0, 0, np.arange(100), np.ones((100, 4)))
    flow = np.where(np.arange(100)[:, None] < rows, 0.0, np.full((100, 2), 9.0))
    frame: Any = None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frozen, "_images", lambda _: [0])
        patch.setattr(frozen, "corner_flow", lambda old, new, pixels: flow[: len(pixels)])
        return frozen._unmoved(frame, frame, seen.z, seen.has_right)


def _remembers(frames: int) -> bool:
    errors = _frozen()._errors_px
    errors.append(9.0)
    errors.extend([0.0] * frames)
    return bool(max(errors) > 0.0)


def _has_stopped(frames: int) -> bool:
    images = _frozen()
    images._errors_px.extend([0.1] * frames)
    images._contradicts = lambda motion: True
    seen = observations(0, 0, [1], np.ones((1, 4)))
    expected: Any = SimpleNamespace(motion=None, tracks=seen)
    frame: Any = None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frozen, "_unmoved", lambda *_: True)
        return bool(images._has_stopped(frame, frame, seen, expected))


def _creeps(px: float) -> bool:
    images = _frozen()
    images._flow_px = images._flow_before_px = px
    return bool(images._creeps())


def _crept(frames: int) -> bool:
    """Whether the last of some equal frames of a rig that crept counts as a standstill."""
    images = _frozen()
    images._moves = lambda _: False
    images._creeps = lambda: True
    frame: Any = SimpleNamespace(index=0)
    return [images._judge_equal(frame, frame, None) for _ in range(frames)][-1] is None


def _has_begun(px: float) -> bool:
    """Whether a motion ends equal images after a flow of half a pixel."""
    images = _frozen()
    ids = list(range(20))
    images.observations(observations(0, 0, ids, np.ones((20, 4))))
    images._ended_still = 3, 0.5
    images.observations(observations(1, 1, ids, np.ones((20, 4)) + np.array([px, 0.0, px, 0.0])))
    return images.take_held() is not None


def _is_still(gyro_radps: float = 0.0, accel_mps2: float = 0.0) -> bool:
    """Whether an IMU stands still whose readings change their sign each tenth of a second."""
    images = _frozen()
    for k in range(101):
        sign = 1.0 - 2.0 * (((100 - k) // 20) % 2)
        unit = np.array([sign, 0.0, 0.0])
        images.samples([ImuSample(5_000_000 * k, gyro_radps * unit, accel_mps2 * unit)])
    return bool(images._at_standstill())


def _is_still_after(seconds: float) -> bool:
    """Whether an IMU stands still that moved until some time ago."""
    images = _frozen()
    for k in range(201):
        moves = k < 200 - 200 * seconds
        images.samples([ImuSample(5_000_000 * k, np.full(3, 0.5 * moves * k % 0.7), np.zeros(3))])
    return bool(images._at_standstill())


REPEATED: dict[str, tuple[Says, float, float]] = {
    "corners": (lambda n: _unmoved_until(int(n)), 46, 50),
    "errors": (lambda n: not _remembers(int(n)), 19, 20),
    "frames": (lambda n: _has_stopped(int(n)), 4, 5),
    "crept": (_creeps, 0.043, 0.057),
    "crept: frames": (lambda n: _crept(int(n)), 2, 3),
    "begun": (_has_begun, 4.3, 5.7),
    "standstill": (_is_still_after, 0.43, 0.57),
    "noise: gyro": (lambda x: not _is_still(gyro_radps=x), 7.0e-3, 9.6e-3),
    "noise: accelerometer": (lambda x: not _is_still(accel_mps2=x), 0.42, 0.58),
}
TABLES = {
    f"{what}: {name}": row
    for what, table in (
        ("force", FORCE),
        ("gyro", GYRO),
        ("evaluations", EVALUATIONS),
        ("repeated", REPEATED),
    )
    for name, row in table.items()
}


@pytest.mark.parametrize(("says", "below", "above"), TABLES.values(), ids=TABLES)
def test_limits_of_fits_and_repetitions(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
