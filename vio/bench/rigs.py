"""What the drives of one rig say of its stereo calibration: do they agree within their covariances?

Of one drive, two runs take in the same images: forward and backward in time, or with another prior.
They share errors, so a consistent filter has a NEES below 1. Of two drives the errors are
independent: it has 1 where the rig is the same, as in renders. A real rig moves in its mount from
drive to drive, so there a larger NEES alone says nothing against the covariance.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any, Literal, TypeAlias

import numpy as np

from vio.bench.suite import Sequence as Recorded
from vio.bench.suite import Suite
from vio.bench.tables import Outcome, number
from vio.evaluation.field_agreement import DisparityField, FieldDifference, field_difference

Kind: TypeAlias = Literal["backward", "another configuration", "another drive"]
_KINDS: tuple[Kind, ...] = ("backward", "another configuration", "another drive")


@dataclass(frozen=True, slots=True)
class Agreement:
    """Two runs on one rig that differ in one thing."""

    rig: str
    kind: Kind
    runs: tuple[str, str]
    difference: FieldDifference

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class _Run:
    rig: str
    images: Hashable  # which ones it took in
    backward: bool
    system: str
    name: str
    field: DisparityField


def agreements(suite: Suite, outcomes: Iterable[Outcome]) -> tuple[Agreement, ...]:
    """Compare the stereo fields of all pairs of runs on one rig that differ in one thing.

    That is the direction in time, the configuration (against the suite's first), or the drive.
    Where seeds draw no renders, the first one alone counts.
    """
    first = next(iter(suite.configurations))
    found = []
    for a, b in combinations(_runs(suite, outcomes), 2):
        kind = _kind(a, b, first)
        if kind is None:
            difference = None
        else:
            difference = field_difference(a.field, b.field)
        if kind is not None and difference is not None:
            found.append(Agreement(a.rig, kind, (a.name, b.name), difference))
    return tuple(found)


def _runs(suite: Suite, outcomes: Iterable[Outcome]) -> list[_Run]:
    sequences = {sequence.name: sequence for sequence in suite.sequences}
    runs = []
    for outcome in outcomes:
        sequence = sequences[outcome.sequence]
        if sequence.rig is None or outcome.stereo_field is None:
            continue
        drawn = sequence.render_each_seed
        if not drawn and outcome.seed != suite.seeds[0]:
            continue
        seed = f" {outcome.seed}" if drawn else ""
        runs.append(
            _Run(
                sequence.rig,
                (*_images(sequence), outcome.seed if drawn else None),
                sequence.reverse,
                outcome.system,
                f"{outcome.sequence}{seed}, {outcome.system}",
                DisparityField.of(outcome.stereo_field),
            )
        )
    return runs


def _images(sequence: Recorded) -> tuple[Hashable, ...]:
    return sequence.source, sequence.render, sequence.start, sequence.stop


def _kind(a: _Run, b: _Run, first: str) -> Kind | None:
    """Return the one thing in which two runs differ; None: it is none, or more."""
    if a.rig != b.rig:
        return None
    both_first = a.system == b.system == first
    if a.images == b.images and a.backward != b.backward:
        return "backward" if both_first else None
    if a.backward or b.backward:
        return None
    if a.images != b.images:
        return "another drive" if both_first else None
    differ = a.system != b.system and first in (a.system, b.system)
    return "another configuration" if differ else None


def agreement_lines(found: Sequence[Agreement]) -> Iterator[str]:
    """Yield a Markdown table of rigs, then one of all pairs."""
    yield "| rig | differs in | pairs | difference px | stated px | NEES of 1 | largest |"
    yield "|---|---|---:|---:|---:|---:|---:|"
    for rig in dict.fromkeys(one.rig for one in found):
        for kind in _KINDS:
            own = [one.difference for one in found if (one.rig, one.kind) == (rig, kind)]
            if own:
                yield _table_row([rig, kind, str(len(own))], _summary_of(own))
    yield ""
    yield "| rig | differs in | runs | difference px | stated px | NEES of 1 |"
    yield "|---|---|---|---:|---:|---:|"
    for one in found:
        values = (one.difference.rms_px, one.difference.sigma_px, one.difference.nees)
        yield _table_row([one.rig, one.kind, " / ".join(one.runs)], values)


def _summary_of(differences: Sequence[FieldDifference]) -> tuple[float, float, float, float]:
    """Return RMS difference and stated sigma in px, and the median and the largest NEES."""
    nees = [one.nees for one in differences]
    return (
        _rms([one.rms_px for one in differences]),
        _rms([one.sigma_px for one in differences]),
        float(np.median(nees)),
        max(nees),
    )


def _table_row(labels: Sequence[str], values: Iterable[float]) -> str:
    return "| " + " | ".join([*labels, *map(_text, values)]) + " |"


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _text(value: float) -> str:
    return number(value, 2)
