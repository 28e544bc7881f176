"""Right matches that fail nearly all at once: the right image is dark, covered or turned away."""

from __future__ import annotations

from dataclasses import dataclass

from vio.findings import begun, ended
from vio.guard.match_check import Hysteresis, MatchCheck, SharedMatches
from vio.records import Observations


@dataclass(frozen=True, slots=True)
class _LostRules:
    """When right matches count as lost."""

    min_features: int = 20  # in a frame that tells
    # share of features with a right match, below which few of them are usual
    min_usual_share: float = 0.3
    gain: float = 0.1  # how fast the usual share is learned
    lost_share: float = 0.2  # of the usual share, below which matches are lost …
    back_share: float = 0.5  # … and from which on they are back


_LOST = _LostRules()
_CODE = "right-matches-lost"


class LostMatches(MatchCheck):
    """Reports that hardly any feature has a right match any more; it changes nothing."""

    def __init__(self) -> None:
        super().__init__()
        self._state = Hysteresis(to_report=3, to_end=1, blind=40)
        self._usual: float | None = None

    def inspect(self, seen: Observations, shared: SharedMatches) -> Observations:
        """Compare how many features have a right match with how many usually have one."""
        index = seen.frame_index
        state = self._state
        share = None
        if len(seen) >= _LOST.min_features:
            share = float(seen.has_right.mean())
        state.show(index, self._is_lost(share))
        if share is not None and state.since is None:
            usual = share if self._usual is None else self._usual
            self._usual = usual + _LOST.gain * (share - usual)
        if share is not None and state.to_report():
            text = (
                f"hardly any feature has a right match since frame {state.since} "
                f"({100 * share:.0f} % instead of {100 * (self._usual or 0.0):.0f} %); the right "
                "camera may be dark, covered or turned; going on with the left pixels"
            )
            figures = {"share": share, "usual_share": self._usual or 0.0}
            self._found.append(begun(_CODE, index, text, state.since, figures=figures))
        if state.ends():
            self._found.append(ended(_CODE, index, "features have right matches again"))
        return seen

    def _is_lost(self, share: float | None) -> bool | None:
        if share is None or self._usual is None or self._usual < _LOST.min_usual_share:
            return None
        if share < _LOST.lost_share * self._usual:
            return True
        return False if share >= _LOST.back_share * self._usual else None
