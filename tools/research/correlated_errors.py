"""Tell whether the front end's errors are independent, as the filter takes them to be, and what it costs if not.

    python tools/research/correlated_errors.py [--scenes room corridor street] [--seed 0]

Ten seconds of each scene are rendered, 480 or 800 pixels wide, and run from images alone. The point that a track
follows is the one on the rendered surface from which its left pixels deviate by zero in the median. Prints the
correlation of a feature's errors with those some frames later, and the pose's NEES with these errors, with the same
errors dealt out at random among all observations, and with white noise. The figures in docs/notes/consistency.md are
from this tool.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vio.config import load_config
from vio.evaluation.trajectories import nees
from vio.geometry.distortion import unproject_pixel
from vio.geometry.lie import FloatArray, se3_inverse, se3_log, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.live.odometry import Odometry
from vio.records import BoolArray, FrameResult, IntArray
from vio.runs.pipeline import run
from vio.sim.render import View, cast, surface_points
from vio.sim.scenarios import Scenario, plan
from vio.sim.sequence import SimulatedRecording, views
from vio.sim.world import Surfaces, surfaces_at

_GROSS_PX = 1.5  # larger errors are wrong matches, which gates and robust weights are for
_CLIP_PX = 0.6  # errors beyond are left out of the correlation, which a few would decide
_LAGS = (1, 2, 3, 5, 8, 12)
_FIRST = 5  # frames left out of NEES, in which the pose is that of the start
_WHITE_PX = 0.1
_SETTINGS = load_config(overrides=["motion=none"])


@dataclass(frozen=True, slots=True)
class Record:
    """What a front end saw in a rendered scene, and the truth; M observations, in order of track and frame."""

    camera: StereoCamera
    times_ns: IntArray  # (K,) of the frames
    T_world_cam0: FloatArray  # (K, 4, 4) true
    ids: IntArray  # (M,)
    frame: IntArray  # (M,) 0 to K - 1
    z: FloatArray  # (M, 4) pixels
    true: FloatArray  # (M, 4)
    has_right: BoolArray  # (M,)

    @property
    def errors(self) -> FloatArray:
        """Seen minus true pixels (M, 4)."""
        return self.z - self.true

    def take(self, rows: BoolArray) -> Record:
        """Return the observations of a mask (M,)."""
        return replace(
            self,
            ids=self.ids[rows],
            frame=self.frame[rows],
            z=self.z[rows],
            true=self.true[rows],
            has_right=self.has_right[rows],
        )


def record(scene: str, seed: int) -> Record:
    """Render a scene, run on it, and find the true pixels; observations with gross errors are left out."""
    street = scene == "street"
    simulation = plan(
        Scenario(
            scene=scene,  # type: ignore[arg-type]
            trajectory="car" if street else "handheld",
            rig="kitti" if street else "euroc-rectified",
            width=800 if street else 480,
            rate_hz=10.0 if street else 20.0,
            duration_s=10.0,
            seed=seed,
        )
    )
    result = run(SimulatedRecording(simulation), _SETTINGS, keep_observations=True)
    assert result.observations is not None
    seen = list(result.observations)
    ids, z, right = (np.concatenate([getattr(o, name) for o in seen]) for name in ("ids", "z", "has_right"))
    frame = np.repeat(np.arange(len(seen)), [len(o) for o in seen])
    order = np.lexsort((frame, ids))
    ids, z, right, frame = ids[order], z[order], right[order], frame[order]
    left = [views(simulation, int(simulation.taken_ns[o.frame_index]))[0] for o in seen]
    camera, surfaces, true = result.recording.camera, surfaces_at(simulation.world, 0), np.full(z.shape, np.nan)
    first = np.flatnonzero(np.r_[True, ids[1:] != ids[:-1]])
    for start, stop in zip(first, np.r_[first[1:], len(ids)], strict=True):
        true[start:stop] = _followed(camera, surfaces, [left[k] for k in frame[start:stop]], z[start:stop, :2])
    times = np.array([o.time_ns for o in seen])
    made = Record(camera, times, np.array([v.T_world_cam for v in left]), ids, frame, z, true, right)
    off = np.where(right[:, None], np.abs(made.errors), np.abs(made.errors[:, [0, 1, 0, 1]]))
    return made.take(off.max(axis=1) < _GROSS_PX)  # False for NaN


def _followed(camera: StereoCamera, surfaces: Surfaces, left: list[View], pixels: FloatArray) -> FloatArray:
    """True pixels (K, 4) of the point that a track of left pixels (K, 2) follows; NaN where it hits nothing."""
    m = len(left) // 2
    at, true = pixels[m], np.full((len(left), 4), np.nan)
    for _ in range(2):
        ray, _ = unproject_pixel(left[m].camera, at[None])
        hit = cast(surfaces, left[m].T_world_cam, ray)
        if not hit.found[0]:
            return np.full((len(left), 4), np.nan)
        p = surface_points(surfaces, hit.surface, hit.coordinates)
        true = np.concatenate([project(camera, transform_points(se3_inverse(v.T_world_cam), p)) for v in left])
        at = true[m, :2] + np.median(pixels - true[:, :2], axis=0)
    return true


def correlations(seen: Record, values: FloatArray) -> list[float]:
    """Correlation of a feature's values (M,), an error, with those some frames later (`_LAGS`)."""
    out = []
    for lag in _LAGS:
        a, b = values[:-lag], values[lag:]
        same = (seen.ids[:-lag] == seen.ids[lag:]) & (seen.frame[lag:] - seen.frame[:-lag] == lag)
        same &= (np.abs(a) < _CLIP_PX) & (np.abs(b) < _CLIP_PX)
        out.append(float(np.sum(a[same] * b[same]) / np.sqrt(np.sum(a[same] ** 2) * np.sum(b[same] ** 2))))
    return out


def pose_nees(seen: Record, z: FloatArray) -> float:
    """Mean NEES of the poses, 6 if consistent, that the filter finds from pixels (M, 4) in place of those seen."""
    results: list[FrameResult] = []
    odometry = Odometry(seen.camera, _SETTINGS, on_frame=results.append)
    for k, time_ns in enumerate(seen.times_ns.tolist()):
        now = seen.frame == k
        odometry.add_observations(time_ns, seen.ids[now], z[now], seen.has_right[now])
    odometry.finish()
    T = np.array([r.estimate.T_world_imu for r in results])
    P = np.array([r.estimate.covariance for r in results])
    true = T[0] @ se3_inverse(seen.T_world_cam0[0]) @ seen.T_world_cam0
    errors = se3_log(se3_inverse(true) @ T)
    return float(nees(errors[_FIRST:], P[_FIRST:]).mean())


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["room", "corridor", "street"])
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args(argv)
    print("correlation with the error so many frames later:", *_LAGS)
    for scene in arguments.scenes:
        seen = record(scene, arguments.seed)
        errors, both = seen.errors, seen.take(seen.has_right)
        disparity = both.errors[:, 0] - both.errors[:, 2]
        for name, of, values in (
            ("ul", seen, errors[:, 0]),
            ("vl", seen, errors[:, 1]),
            ("disparity", both, disparity),
        ):
            sigma = 1.4826 * np.median(np.abs(values))
            row = " ".join(f"{c:.2f}" for c in correlations(of, values))
            print(f"{scene:9} {name:9} {sigma:.3f} px: {row}")
        rng = np.random.default_rng(arguments.seed)
        dealt = errors.copy()
        for group in (seen.has_right, ~seen.has_right):
            dealt[group] = rng.permutation(errors[group])
        white = _WHITE_PX * rng.standard_normal(errors.shape)
        kinds = {"as they are": errors, "dealt out": dealt, f"white, {_WHITE_PX} px": white}
        for name, kind in kinds.items():
            print(f"{scene:9} NEES with errors {name}: {pose_nees(seen, seen.true + kind):.1f} of 6", flush=True)


if __name__ == "__main__":
    main()
