"""How often `vio bench compare` calls a change that is none, and sees one that is: simulated
comparisons.

    python -m tools.verdicts [--repeat 1000]

The ATE of A is log-normal over the sequences, and B is A times the change times noise. The other
judged figures change with the ATE (correlation 0.7). Prints the table, of which docs/bench.md has a part.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np

from vio.bench.compare import Comparison, compare_outcomes
from vio.bench.tables import Outcome
from vio.geometry.lie import FloatArray

SIZES = (5, 10, 20)
CHANGES = (1.0, 1.1, 1.25, 1.5, 1.9)
_FIGURES = ("ate_m", "rpe_m", "drift_percent", "drift_deg_per_100m")
_SIGMA = 0.25  # of the logarithm of a ratio of one sequence
_CORRELATION = 0.7
Noise = Callable[[np.random.Generator, int], FloatArray]
NOISES: dict[str, Noise] = {
    "normal": lambda rng, n: rng.normal(0, _SIGMA, (n, len(_FIGURES) + 1)),
    "heavy tails": lambda rng, n: rng.standard_t(3, (n, len(_FIGURES) + 1)) * _SIGMA,
    "one in ten breaks": lambda rng, n: (
        rng.normal(0, _SIGMA, (n, len(_FIGURES) + 1))
        + np.where(rng.random((n, 1)) < 0.1, rng.choice([-1.0, 1.0], (n, 1)) * np.log(3), 0.0)
    ),
}


def simulated(n: int, change: float, noise: Noise, rng: np.random.Generator) -> Comparison:
    """Compare n sequences of one seed, whose figures changed by a factor."""
    before = rng.lognormal(-3, 1, (n, len(_FIGURES)))
    common, *own = noise(rng, n).T
    rest = np.sqrt(1 - _CORRELATION)
    logs = np.sqrt(_CORRELATION) * common[:, None] + rest * np.transpose(own)
    after = before * change * np.exp(logs)

    def runs(values: FloatArray) -> Iterator[Outcome]:
        for k, row in enumerate(values.tolist()):
            yield Outcome(str(k), "x", 0, "", dict(zip(_FIGURES, row, strict=True)), {}, None, None)

    return compare_outcomes(runs(before), runs(after))


def verdicts(n: int, change: float, noise: str, repeat: int) -> tuple[Counter[str], Counter[str]]:
    """Count what is said of the ATE alone, and of the whole."""
    rng = np.random.default_rng([0, n, round(100 * change)])
    ate = Counter[str]()
    whole = Counter[str]()
    for _ in range(repeat):
        result = simulated(n, change, NOISES[noise], rng)
        ate[result.changes[0].verdict] += 1
        whole[result.verdict] += 1
    return ate, whole


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeat", type=int, default=1000, help="comparisons of each case")
    repeat = parser.parse_args().repeat
    print(
        "| ratios | true change | "
        + " | ".join(f"n = {n}" for n in SIZES)
        + " |\n|---|---:|"
        + "---:|" * len(SIZES)
    )
    for noise in NOISES:
        for change in CHANGES:
            cells = []
            for n in SIZES:
                ate, whole = verdicts(n, change, noise, repeat)
                cells.append(
                    " / ".join(
                        f"{100 * c / repeat:.0f}"
                        for c in (ate["worse"], whole["worse"], ate["cannot tell"])
                    )
                )
            print(f"| {noise} | {change:g} | {' | '.join(cells)} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
