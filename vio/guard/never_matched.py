"""Right matches that hardly any feature has had yet: the right images are turned, or belong to
other left ones.
"""

from __future__ import annotations

from dataclasses import dataclass

from vio.findings import Finder, begun, ended
from vio.records import Observations


@dataclass(frozen=True, slots=True)
class _NeverRules:
    """When right matches count as missing."""

    min_features: int = 20  # in a frame that tells
    # share of features with a right match: one frame with more of them shows a pair. The least
    # median of healthy recordings is 0.29 (Karlsruhe, a hood in view).
    matched_share: float = 0.06
    frames: int = 5  # that tell, before it is reported
    back_share: float = 0.3  # share from which on a reported loss has ended


_NEVER = _NeverRules()
_CODE = "right-matches-missing"


class NeverMatched(Finder):
    """Reports that no frame has had more than a few right matches; it changes nothing.

    What a pair loses later is for the checks of right matches to say.
    """

    def __init__(self) -> None:
        super().__init__()
        self._since: int | None = None  # first frame that told
        self._frames = 0
        self._reported = False
        self._over = False

    def see(self, seen: Observations) -> None:
        """Take the features of a frame whose right image may be used."""
        if self._over or len(seen) < _NEVER.min_features:
            return
        index = seen.frame_index
        share = float(seen.has_right.mean())
        if self._reported:
            if share >= _NEVER.back_share:
                self._over = True
                self._found.append(ended(_CODE, index, "features have right matches"))
            return
        if share > _NEVER.matched_share:
            self._over = True
            return
        self._since = index if self._since is None else self._since
        self._frames += 1
        if self._frames < _NEVER.frames:
            return
        self._reported = True
        text = (
            "hardly any feature has a right match since the first frame "
            f"({100 * share:.0f} %), so lengths are unknown; the right images may be turned, "
            "the left ones again, or not belong to the left ones or the calibration (vio inspect)"
        )
        figures = {"share": share}
        self._found.append(begun(_CODE, index, text, self._since, figures=figures))
