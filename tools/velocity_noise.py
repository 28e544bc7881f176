"""What velocities as noisy as the paper's add to images: many seeds over one recording.

    python tools/velocity_noise.py SOURCE [--seeds 10] [--json]

The front end runs once; each seed adds white noise of 0.5 m/s and 0.05 rad/s to the recording's velocities and
replays the same observations through dead reckoning and through the filter with and without those velocities.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from vio.config import load_config
from vio.datasets import open_dataset
from vio.evaluation import Evaluation, evaluate
from vio.pipeline import run
from vio.protocols import Dataset
from vio.records import Event, FrontendOutput, Observations, Recording, StereoFrame, TrackPrior, VelocitySample
from vio.threads import one_blas_thread

_LENGTHS_M = (25.0, 50.0, 75.0, 100.0, 200.0, 400.0)


@dataclass(frozen=True, slots=True)
class NoisyVelocities:
    """A dataset whose velocities carry extra white noise, always the same for one seed."""

    dataset: Dataset
    seed: int

    @property
    def recording(self) -> Recording:
        """The recording underneath."""
        return self.dataset.recording

    def events(self, start: int = 0, stop: int | None = None, *, images: bool = True) -> Iterator[Event]:
        """Yield the events, velocities with noise."""
        rng = np.random.default_rng(self.seed)
        for event in self.dataset.events(start, stop, images=images):
            if isinstance(event, VelocitySample):
                event = replace(
                    event,
                    linear=event.linear + rng.normal(0, 0.5, 3),
                    angular=event.angular + rng.normal(0, 0.05, 3),
                )
            yield event

    def observations(self, index: int) -> Observations | None:
        """Return the observations underneath."""
        return self.dataset.observations(index)


class Replay:
    """A front end that hands out what an earlier run saw."""

    def __init__(self, seen: tuple[Observations, ...]) -> None:
        self._seen = {o.frame_index: o for o in seen}

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        """Return the observations of the frame."""
        found = self._seen[frame.index]
        return FrontendOutput(found, 0, int(found.has_right.sum()), 0)


def main() -> int:
    """Run all seeds and print a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", metavar="SOURCE")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    dataset = open_dataset(args.source)
    truth = dataset.recording.reference
    if truth is None or "velocity" not in dataset.recording.motion:
        print(f"error: {args.source} holds no ground truth or no velocities", file=sys.stderr)
        return 1

    def config(motion: str, *more: str):  # type: ignore[no-untyped-def]
        return load_config(None, [*args.set, f'motion="{motion}"', *more])

    def score(result) -> Evaluation:  # type: ignore[no-untyped-def]
        return evaluate(result.trajectory, truth, T_cam0_imu=result.T_cam0_body, lengths_m=_LENGTHS_M)

    with one_blas_thread():
        first = run(dataset, config("none"), keep_observations=True)
        assert first.observations is not None
        rows: dict[str, list[Evaluation]] = {"images alone": [score(first)], "velocities alone": [], "both": []}
        for seed in range(args.seeds):
            noisy = NoisyVelocities(dataset, seed)
            for name, more in (("velocities alone", ["backend=vislam", "vislam.mode=dead_reckoning"]), ("both", [])):
                rows[name].append(score(run(noisy, config("velocity", *more), frontend=Replay(first.observations))))
    table = {
        name: {
            "ate_m": [e.ate_m.rmse for e in scores],
            "ate_deg": [e.ate_deg.rmse for e in scores],
            "rpe_deg": [e.rpe.rot_rmse_deg for e in scores if e.rpe is not None],
            "t_err_percent": [e.kitti.t_err_percent for e in scores if e.kitti is not None],
            "r_err_deg_per_100m": [e.kitti.r_err_deg_per_100m for e in scores if e.kitti is not None],
        }
        for name, scores in rows.items()
    }
    if args.json:
        print(json.dumps(table))
        return 0
    print(f"{'':<18}" + "".join(f"{key:>28}" for key in next(iter(table.values()))))
    for name, figures in table.items():
        cells = [f"{np.median(v):.4f} [{min(v):.4f} {max(v):.4f}]" for v in figures.values()]
        print(f"{name:<18}" + "".join(f"{cell:>28}" for cell in cells))
    return 0


if __name__ == "__main__":
    sys.exit(main())
