"""The conclusion of the comparison of a run with COLMAP's reconstructions, in one sentence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vio.calibration.severity import Grade, length_grade
from vio.evaluation.errors_along_path import path_length_m
from vio.offline.colmap.reconstruction import Mapper, Reconstructed
from vio.offline.comparison import KeyframeComparison, Segment, motion_differences
from vio.records import IntArray


class _TurnRules(NamedTuple):
    """Which motions are named."""

    named_deg: float = 1.0  # turns from which they are named
    turn_deg: float = 0.2  # a motion that differs by more turns the rest of the path
    # by which lengths may differ without a word: matches that are off by 0.1 px make as much at far
    # points
    scale_share: float = 0.01


_TURNS = _TurnRules()


@dataclass(frozen=True, slots=True)
class MapperResult:
    """The reconstruction of a run's keyframes by one of COLMAP's mappers, and its comparison
    with the run.
    """

    mapper: Mapper
    total: int  # keyframes given
    found: tuple[Reconstructed, KeyframeComparison] | None  # None: it could not connect them

    @property
    def verdict(self) -> str:
        """A short summary of this mapper alone."""
        if self.found is None:
            return (
                "not observable because COLMAP could not connect the keyframes; too few images, no "
                "overlap between "
                "them, or too little texture"
            )
        comparison = self.found[1]
        left_out = unconnected(self.total, comparison)
        if comparison.scale is None:
            return (
                f"{left_out}poses compared, scale not observable because {comparison.why_no_scale}"
            )
        where = (
            f"disagrees in {len(comparison.segments)} segments"
            if comparison.segments
            else "agrees throughout"
        )
        return f"{left_out}{where}"


def unconnected(total: int, comparison: KeyframeComparison) -> str:
    """Return which of the keyframes are not compared, as the beginning of a sentence; nothing if
    all are.
    """
    missing = total - len(comparison.frames)
    compared = comparison.frames[comparison.piece]
    text = f"{missing} of {total} keyframes not connected" if missing else ""
    if comparison.pieces > 1:
        text += f"{', the others' if missing else 'keyframes connected'} in {comparison.pieces} pieces, of which "
        text += f"frames {compared[0]} to {compared[-1]} are compared"
    return f"{text}; " if text else ""


def overall_verdict(results: Sequence[MapperResult]) -> str:
    """Say whether the run and COLMAP agree, and where they do not, which of them is the likelier
    one to be wrong.

    COLMAP's two mappers share their matches but no poses. Where both differ from the run by the
    same motion, the run is suspected; where one of them agrees with the run, the other one; where
    all three differ, nobody.
    """
    found = {result.mapper: result.found[1] for result in results if result.found is not None}
    if not found:
        return f"none: {results[0].verdict}"
    agreeing = [
        name
        for name, comparison in found.items()
        if _grade(comparison, comparison.segments) == "negligible"
    ]
    agreeing.sort(key=lambda name: -int(found[name].piece.sum()))
    compared = (
        found[agreeing[0]] if agreeing else max(found.values(), key=lambda c: int(c.piece.sum()))
    )
    return unconnected(results[0].total, compared) + _judged(found, agreeing) + _revisits(results)


def _revisits(results: Sequence[MapperResult]) -> str:
    """Say where COLMAP sees a place again that the run did not close."""
    for result in results:
        if (
            result.found is not None
            and len(result.found[0].revisits)
            and not len(result.found[0].shared)
        ):
            frames = dict(
                zip(
                    result.found[0].keyframes.tolist(), result.found[1].frames.tolist(), strict=True
                )
            )
            a, b = (frames[k] for k in result.found[0].revisits[0].tolist())
            return f"; frames {a} and {b} show one place, which the run did not close as a loop"
    return ""


def _judged(found: dict[Mapper, KeyframeComparison], agreeing: Sequence[Mapper]) -> str:
    """Say whether a run and COLMAP agree where they are compared; models that do, that of most
    keyframes first.
    """
    if not agreeing:
        return _disagreement(found)
    comparison = found[agreeing[0]]
    text = f"the run and COLMAP agree: {_metres(comparison.ate_m)} (rms) apart over {_length(comparison):.3g} m"
    if comparison.segments:
        text += f"; the difference of {_size(comparison, comparison.segments)} at frames "
        text += f"{_ranges(comparison.segments)} is negligible"
    if comparison.scale is None:
        text += f"; lengths could not be compared, {comparison.why_no_scale}"
    elif abs(comparison.scale - 1) > max(_TURNS.scale_share, 3 * (comparison.scale_sigma or 0.0)):
        grade = length_grade(100 * abs(comparison.scale - 1))
        text += f", but COLMAP's path is {_longer(comparison.scale)}, {grade}: one of both has disparities that are off"
    for name in found.keys() - set(agreeing):
        text += f"; COLMAP's {name} model breaks at frames {_ranges(found[name].segments)}, the other one does not"
    return text


def _disagreement(found: dict[Mapper, KeyframeComparison]) -> str:
    """Say what differs where no reconstruction agrees with the run throughout."""
    if len(found) == 1:
        ((name, only),) = found.items()
        where = f"the run and COLMAP's {name} model differ at frames {_ranges(only.segments)}"
        size = _size(only, only.segments)
        return f"{where} by {size}, elsewhere by {_metres(only.ate_m)} (rms); one of both is wrong there"
    first, second = found.values()
    shared = _shared(first, second)
    if shared:
        unusable = ", unusable" if _grade(first, shared) == "unusable" else ""
        where = f"the run is probably off by {_size(first, shared)} at frames {_ranges(shared)}{unusable}"
        return f"{where}: both of COLMAP's reconstructions differ from it there, and agree with one another"
    where = " and ".join(f"{_ranges(c.segments)} ({name})" for name, c in found.items())
    return f"undecided at frames {where}: COLMAP's two reconstructions contradict one another there"


def _length(comparison: KeyframeComparison) -> float:
    return path_length_m(comparison.aligned[comparison.piece, :3, 3])


def _per_100_m(comparison: KeyframeComparison, segments: Sequence[Segment]) -> float:
    """Return the largest difference of a motion over the length of the path, m per 100 m."""
    return (
        100 * max((s.difference_m for s in segments), default=0.0) / max(_length(comparison), 1e-9)
    )


def _grade(comparison: KeyframeComparison, segments: Sequence[Segment]) -> Grade:
    turned = any(s.difference_deg > _TURNS.turn_deg for s in segments)
    grade = length_grade(_per_100_m(comparison, segments))
    return "worth calibrating" if turned and grade == "negligible" else grade


def _size(comparison: KeyframeComparison, segments: Sequence[Segment]) -> str:
    by = max((s.difference_m for s in segments), default=0.0)
    turned = max((s.difference_deg for s in segments), default=0.0)
    text = f"{_metres(by)} ({_per_100_m(comparison, segments):.2g} m per 100 m)"
    if turned < _TURNS.named_deg:
        return text
    return f"{text} and {turned:.3g} deg"


def _shared(first: KeyframeComparison, second: KeyframeComparison) -> list[Segment]:
    """Return the first one's segments in which the second one differs from the run by the same
    motion.
    """
    _, rows, others = np.intersect1d(first.frames, second.frames, return_indices=True)
    frames: IntArray = first.frames[rows]
    if len(frames) < 2:
        return []
    apart_m, apart_deg = motion_differences(first.aligned[rows], second.aligned[others])
    shared = []
    for segment in first.segments:
        inside = (frames[:-1] < segment.last_frame) & (frames[1:] > segment.first_frame)
        met = any(
            s.first_frame < segment.last_frame and s.last_frame > segment.first_frame
            for s in second.segments
        )
        close = (apart_m[inside] <= 0.5 * segment.difference_m) | (segment.difference_m == 0)
        turned = apart_deg[inside] <= max(0.5 * segment.difference_deg, 0.05)
        if met and inside.any() and bool((close & turned).all()):
            shared.append(segment)
    return shared


def _ranges(segments: Sequence[Segment]) -> str:
    shown = ", ".join(f"{s.first_frame} to {s.last_frame}" for s in segments[:3])
    return shown + (f" and {len(segments) - 3} more" if len(segments) > 3 else "")


def _metres(value: float) -> str:
    if value < 0.1:
        return f"{1e3 * value:.3g} mm"
    return f"{value:.3g} m"


def _longer(scale: float) -> str:
    return f"{100 * abs(scale - 1):.2f} % {'longer' if scale > 1 else 'shorter'}"
