"""Each limit of evaluation, geodesy and comparison, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path as FilePath

import numpy as np
import pytest

from vio.datasets.gnss_fixes import GnssFixes, checked_fixes
from vio.earth.alignment import Georeference, Path, georeference
from vio.earth.geodesy import LocalFrame
from vio.errors import DataError, EstimationError
from vio.evaluation.alignment import align_poses, settle_rotation
from vio.evaluation.reference_axes import attitude_note
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp
from vio.geometry.stereo import StereoCamera
from vio.offline.comparison import _longest_piece, _scale_ratio, _stands_out, compare_keyframes
from vio.offline.keyframes import TrackedPath, choose_keyframes, keyframes_by_overlap
from vio.records import FeatureTracks, ImuRecord, Trajectory, observations
from vio.targets.noise import allan_curve, measure_noise

Says = Callable[[float], bool]


# Evaluation


def _rotation_from(
    sideways_m: float, attitude_deg: float = 0.0, about_deg: float = 0.0, noise_m: float = 0.01
) -> str:
    """What determines the rotation about a straight path, by what it leaves the line, by the noise
    of attitudes and positions, and by what attitudes contradict positions.
    """
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 1.0, 80)
    p = np.column_stack([20.0 * t, sideways_m * np.sin(40 * t), 0.3 * sideways_m * np.sin(23 * t)])
    T_ref = np.tile(np.eye(4), (80, 1, 1))
    T_ref[:, :3, 3] = p
    noise = np.radians(attitude_deg) * rng.normal(size=80)
    phi = np.zeros((80, 3))
    phi[:, 0] = noise + np.radians(about_deg)
    T_est = se3_from_parts(so3_exp(phi), p + noise_m * rng.normal(size=(80, 3)))
    return settle_rotation(align_poses(T_est, T_ref, "se3"), T_est, T_ref).rotation_from


def _attitudes(seed: int = 0) -> FloatArray:
    return so3_exp(0.8 * np.random.default_rng(seed).normal(size=(200, 3)))


def _note(deg: float, sigma_deg: float = 0.0, jitter_deg: float = 0.0) -> str | None:
    """What is said of attitudes of a body that is turned, with a part that varies."""
    R = _attitudes()
    phi = np.zeros((200, 3))
    phi[:, 2] = np.radians(deg)
    jitter = so3_exp(np.radians(jitter_deg) * np.random.default_rng(1).normal(size=(200, 3)))
    return attitude_note(R @ so3_exp(phi) @ jitter, R, np.radians(sigma_deg))


EVALUATION: dict[str, tuple[Says, float, float]] = {
    "loose": (lambda x: _rotation_from(x) == "positions", 0.27, 0.34),
    "attitudes are exact": (lambda x: _rotation_from(0.03, x) == "positions", 2.0, 4.0),
    "attitudes contradict": (lambda x: _rotation_from(0.15, 0.0, x) == "positions", 24.0, 32.0),
    "attitudes: large": (lambda x: _note(x) is not None, 18.0, 22.0),
    "attitudes: uncertain": (lambda x: _note(x, 10.0) is not None, 45.0, 55.0),
    "attitudes: constant": (
        lambda x: "no exchange of axes" in str(_note(60.0, 0.0, x)),
        6.0,
        9.0,
    ),
    "attitudes: whole axes": (lambda x: "deg about x y z" in str(_note(90.0 - x)), 4.5, 5.5),
}


@pytest.mark.parametrize(("says", "below", "above"), EVALUATION.values(), ids=EVALUATION)
def test_limits_of_evaluation(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


# The earth

ORIGIN = np.array([48.0, 8.0, 200.0])


def _drive(
    sigma_m: float = 1.0,
    step_s: float = 5.0,
    count: int = 60,
    stretched: float = 1.0,
    fixes: int | None = None,
    heights: bool = True,
) -> Georeference:
    """A bend of a drive with exact positions, whose trajectory is stretched."""
    t = np.arange(count) * step_s
    angle = np.linspace(0.0, 1.5, count)
    p = 400.0 * np.column_stack([np.sin(angle), 1 - np.cos(angle), np.zeros(count)])
    phi = np.zeros((count, 3))
    phi[:, 2] = angle
    times = np.asarray(1e9 * t, dtype=np.int64)
    none = np.zeros(0, dtype=np.int64)
    T = se3_from_parts(so3_exp(phi), stretched * p)
    path = Path(times, T, none, none, np.array([0.0, 0.0, 1.0]), 0.01, none)
    rows = np.arange(count)[1 : None if fixes is None else 1 + fixes]
    geodetic = LocalFrame(ORIGIN).geodetic(p[rows])
    covariance = np.tile(sigma_m**2 * np.eye(3), (len(rows), 1, 1))
    has_height = np.full(len(rows), heights)
    return georeference(path, GnssFixes(times[rows], geodetic, covariance, has_height), np.zeros(3))


def _sigma_m(found: Georeference) -> float:
    return float(np.sqrt(found.position_covariance[30, 0, 0]))


def _enough(fixes: int) -> bool:
    try:
        _drive(fixes=fixes)
    except EstimationError:
        return False
    return True


def _unstated(heights_m: float = 100.0) -> GnssFixes:
    return checked_fixes(
        np.arange(3) * 10**9, np.tile([48.0, 8.0, heights_m], (3, 1)), None, "table"
    )


def _stated_sigma_m(sigma_m: float) -> float:
    covariance = np.tile(sigma_m**2 * np.eye(3), (3, 1, 1))
    fixes = checked_fixes(
        np.arange(3) * 10**9, np.tile([48.0, 8.0, 100.0], (3, 1)), covariance, "table"
    )
    return float(np.sqrt(fixes.covariance[0, 0, 0]))


EARTH: dict[str, tuple[Says, float, float]] = {
    "fixes": (lambda n: _enough(int(n)), 2, 3),
    # A shorter time between positions makes them no better than so many independent ones.
    "correlated": (lambda x: _sigma_m(_drive(step_s=1.0)) < x, 0.35, 0.415),
    "timing": (lambda x: _sigma_m(_drive(0.001)) < x, 0.049, 0.063),
    "drift": (lambda x: _drive(0.01).scale_sigma < 1e-3 * x, 0.76, 0.94),
    "scale": (lambda x: _drive(1e5).scale_sigma < 0.01 * x, 0.85, 1.15),
    "height": (
        lambda x: float(np.sqrt(_drive(heights=False).position_covariance[30, 2, 2])) < 1e3 * x,
        0.85,
        1.2,
    ),
    "unstated": (lambda x: float(np.sqrt(_unstated().covariance[0, 0, 0])) < x, 2.6, 3.4),
    "unstated, up": (lambda x: float(np.sqrt(_unstated().covariance[0, 2, 2])) < x, 5.2, 6.8),
    "stated too well": (lambda x: _stated_sigma_m(1e-4) < x, 0.008, 0.012),
    "low": (lambda x: not _unstated(-1000.0 * x).has_height[0], 0.9, 1.1),
    "high": (lambda x: not _unstated(50_000.0 * x).has_height[0], 0.9, 1.1),
}


@pytest.mark.parametrize(("says", "below", "above"), EARTH.values(), ids=EARTH)
def test_limits_of_geodesy(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


# Keyframes, and their comparison with another reconstruction

CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)


def _run(
    step_m: float, count: int, seen: int = 40, kept: float = 0.9, turn_deg: float = 0.0
) -> TrackedPath:
    """A straight path past points 4 m away, of which a share is seen again in the next frame."""
    parts = []
    first = 0
    for k in range(count):
        first += round((1.0 - kept) * seen)
        z = np.tile([320.0, 240.0, 310.0, 240.0], (seen, 1))
        parts.append(observations(k, k, first + np.arange(seen), z))
    offsets = seen * np.arange(count + 1)
    tracks = FeatureTracks(
        offsets,
        np.concatenate([o.ids for o in parts]),
        np.concatenate([o.z for o in parts]),
        np.concatenate([o.has_right for o in parts]),
        np.concatenate([o.stale for o in parts]),
    )
    phi = np.zeros((count, 3))
    phi[:, 1] = np.radians(turn_deg) * np.arange(count)
    p = np.column_stack([step_m * np.arange(count), np.zeros((count, 2))])
    trajectory = Trajectory(
        se3_from_parts(so3_exp(phi), p), None, "cam0", frame_indices=np.arange(count)
    )
    return TrackedPath(FilePath("run"), CAMERA, trajectory, tracks)


def _steps(step_m: float, turn_deg: float = 0.0) -> int:
    """Frames from keyframe to keyframe of a long run."""
    return int(np.median(np.diff(choose_keyframes(_run(step_m, 400, turn_deg=turn_deg)))))


def _other(
    run: TrackedPath, scale: float = 1.0, noise_m: float = 0.0, end_m: float = 0.0
) -> FloatArray:
    T = run.trajectory.T_world_body.copy()
    count = len(T)
    T[:, :3, 3] *= scale
    T[:, 1, 3] += end_m * (np.arange(count) / (count - 1)) ** 2
    T[:, :3, 3] += noise_m * np.random.default_rng(0).normal(size=(count, 3))
    return T


def _has_scale(noise_m: float) -> bool:
    run = _run(0.1, 100)
    return _scale_ratio(_other(run, 1.0, noise_m), run.trajectory.T_world_body, 0.1)[0] is not None


def _outlier(sigmas: float) -> bool:
    values = np.random.default_rng(0).normal(1.0, 0.2, 200)
    values[7] = 1.0 + 0.2 * sigmas
    return bool(_stands_out(values, np.ones(200, dtype=np.bool_))[7])


def _pieces(jump: float) -> bool:
    """Whether a jump of so many steps makes two pieces."""
    own = _run(0.1, 40).trajectory.T_world_body
    other = own.copy()
    other[:, :3, 3] += 1e-3 * np.random.default_rng(0).normal(size=(40, 3))
    other[20:, 1, 3] += 0.1 * jump
    return not _longest_piece(own, other, np.ones(39, dtype=np.bool_))[0].all()


def _agree_at_end(end_m: float) -> bool:
    run = _run(0.5, 60)
    return not compare_keyframes(run, np.arange(60), _other(run, end_m=end_m)).segments


KEYFRAMES: dict[str, tuple[Says, float, float]] = {
    "all": (lambda n: len(choose_keyframes(_run(0.01, int(n)))) < n, 280, 320),
    "step": (lambda x: _steps(x) < 10, 0.03, 0.037),
    "turn": (lambda x: _steps(1e-6, x) < 10, 0.6, 0.72),
    "overlap": (
        lambda n: len(keyframes_by_overlap(_run(0.1, 41, kept=0.95), most=40)) < n,
        10,
        13,
    ),
    "scale is known": (lambda x: not _has_scale(x), 0.3, 0.42),
    "stands out": (_outlier, 5.0, 7.2),
    "jump": (_pieces, 0.85, 1.15),
    "ends apart": (lambda x: not _agree_at_end(x), 0.25, 0.35),
}


@pytest.mark.parametrize(("says", "below", "above"), KEYFRAMES.values(), ids=KEYFRAMES)
def test_limits_of_keyframes(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


# Noise of an IMU at rest


def _rest(seconds: float, gap_periods: float = 1.0, shift: float = 0.0) -> bool:
    """Whether a record at 10 Hz is taken for one at rest: with a gap, and a shift by so many
    standard deviations of a mean over a second.
    """
    rng = np.random.default_rng(0)
    count = round(10 * seconds) + 1
    times = 0.1 * np.arange(count)
    times[count // 2 :] += 0.1 * (gap_periods - 1.0)
    values = 1e-3 * rng.normal(size=(count, 6))
    values[count // 2 :, 0] += 1e-3 * shift / np.sqrt(10.0)
    values[:, 5] += 9.81
    try:
        measure_noise(ImuRecord((1e9 * times).astype(np.int64), values[:, :3], values[:, 3:]))
    except DataError:
        return False
    return True


def _averaging_times() -> int:
    return len(allan_curve(np.random.default_rng(0).normal(size=90_000), 10.0).tau_s)


REST: dict[str, tuple[Says, float, float]] = {
    "time": (_rest, 280.0, 320.0),
    "gap": (lambda x: not _rest(400.0, x), 2.8, 3.2),
    "shift": (lambda x: not _rest(400.0, 1.0, x), 9.5, 13.0),
    "longest averages": (
        lambda x: allan_curve(np.zeros(9000) + 1e-9, 10.0).tau_s[-1] < x,
        90.0,
        115.0,
    ),
    "averages of a decade": (lambda n: _averaging_times() < n, 30, 42),
}


@pytest.mark.parametrize(("says", "below", "above"), REST.values(), ids=REST)
def test_limits_of_noise_at_rest(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
