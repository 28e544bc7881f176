"""Whether the matches of the right image agree with the left one: a displaced or unsynchronised
right camera is not used.

Points of known depth, moved by the motion that the left image shows, must appear in the right image
where their depth says, but for an offset that all have in common (`frontend.stereo_fit`). Where
most do not, right and left contradict each other, and the frame is used with its left image alone
until they agree again. That its image is frozen or dark, `vio.guard` sees before.
"""

from __future__ import annotations

from typing import NamedTuple

from vio.findings import Finder, Finding
from vio.frontend.columns import share_of
from vio.records import BoolArray


class _ContradictionRules(NamedTuple):
    """When right and left images contradict each other."""

    min_points: int = 20  # with fewer points of known depth, matches say nothing
    # but so few suffice to agree, as hardly any wrong one is found where it should be
    min_agreeing: int = 6
    # share of confirmed points below which the images contradict each other; usual is 0.8 to 1
    contradicting_share: float = 0.3
    agreeing_share: float = 0.6  # share above which they agree again
    # in a row before it is reported, or before images that agree are used again; that agreed, before
    # which it is one from the start: nothing has shown lengths yet
    frames: int = 3
    # after as many without points to test by, the right image is tried again
    blind_frames: int = 40


_CONTRADICTION = _ContradictionRules()
_CODE = "right-contradicts-left"
_UNKNOWN_CODE = "right-matches-missing"


def _most_contradict(matched: BoolArray) -> bool:
    """Whether so few of the points (K,) of known depth are in the right image where they should be
    that it is not a matter of single matches.
    """
    return (
        len(matched) >= _CONTRADICTION.min_points
        and share_of(matched) < _CONTRADICTION.contradicting_share
    )


class RightCamera(Finder):
    """Decides frame by frame whether the right image may be used."""

    def __init__(self) -> None:
        super().__init__()
        self._lives = True  # the right image of this frame is neither frozen nor dark
        self._contradicts = False  # matches contradicted each other, and have not agreed since
        self._since = 0  # first such frame
        self._count = 0  # frames in a row
        self._agreeing = 0
        self._untested = 0
        self._reported = False
        self._agreed = 0  # frames so far
        self._unknown = False  # it is reported that nothing has shown lengths yet

    @property
    def contradicts(self) -> bool:
        """Whether the right image is not used because its matches contradict the left one, for
        no known cause.
        """
        return self._lives and self._contradicts

    @property
    def usable(self) -> bool:
        """Whether the right image of the last frame was used."""
        return self._lives and not self._contradicts

    def by_image(self, index: int, *, usable: bool) -> None:
        """Take whether the image itself of a frame is usable: neither frozen nor dark.

        Once it is another one again, whether it fits is for the matches to say.
        """
        if not usable:
            if not self._contradicts:
                self._begin(index)
            self._agreeing = 0
        self._lives = usable

    def explained(self) -> None:
        """Trust the right image again at once: another cause was found and taken out.

        What is not yet reported is not.
        """
        self._found = []
        self._unknown = False
        self._reset()

    def _reset(self) -> None:
        self._contradicts = False
        self._reported = False
        self._count = 0
        self._agreeing = 0
        self._untested = 0

    def _begin(self, index: int) -> None:
        self._contradicts = True
        self._since = index
        self._count = 0
        self._untested = 0
        self._agreeing = 0

    def doubts(self, matched: BoolArray) -> bool:
        """Whether so few of the points (K,) of known depth are where they should be that a cause
        is looked for.
        """
        return (
            self._lives
            and len(matched) >= _CONTRADICTION.min_points
            and share_of(matched) < _CONTRADICTION.agreeing_share
        )

    def check_matches(self, index: int, matched: BoolArray, *, moved: bool) -> bool:
        """Judge the matches of a frame near their known depths, and return whether the right image
        may be used.

        Args:
            index: frame number.
            matched: which of the points (K,) of known depth were found in the right image where
                they should be.
            moved: whether the points were moved by a motion that the left image confirms.
        """
        if not self._lives:
            return False
        tested = moved and len(matched) >= _CONTRADICTION.min_points
        share = share_of(matched) if len(matched) else 0.0
        if self._contradicts:
            agrees = (
                moved
                and len(matched) >= _CONTRADICTION.min_agreeing
                and share >= _CONTRADICTION.agreeing_share
            )
            self._count_agreement(index, tested=tested, agrees=agrees)
        elif moved and _most_contradict(matched):
            self._begin(index)
        else:
            self._agreed += tested and share >= _CONTRADICTION.agreeing_share
        return not self._contradicts

    def _count_agreement(self, index: int, *, tested: bool, agrees: bool) -> None:
        """Use right images again once they agree, or were not tested, for so many frames; report
        those that contradict for so many.
        """
        if tested or agrees:
            self._untested = 0
        else:
            self._untested = self._untested + 1
        self._agreeing = self._agreeing + 1 if agrees else 0
        self._count += not agrees
        if self._agreeing >= _CONTRADICTION.frames or self._untested >= _CONTRADICTION.blind_frames:
            self._end(
                f"frame {index}: the right images agree with the left ones again, and are used",
                index,
            )
        elif self._count >= _CONTRADICTION.frames:
            self._report(index)

    def try_again(self, index: int) -> None:
        """Use right images again that contradicted depths of which none is left, where no sensor
        measures the scale.

        Depths from the left images since then have an arbitrary scale, and would be contradicted
        for ever.
        """
        if self.contradicts:
            message = (
                f"frame {index}: no feature is left that contradicts the right images; they are "
                "used again"
            )
            self._end(message, index)

    def _report(self, index: int) -> None:
        if self._reported:
            return
        self._reported = True
        message = (
            f"frame {index}: the right image contradicts the left one, as most points of known "
            "depth do not appear in it where they should; the right camera has been turned or "
            f"covered, or has lost its synchronisation, since frame {self._since - 1}; going on "
            "with the left images"
        )
        self._found.append(Finding(_CODE, message, index, self._since, lasts=True))
        if self._agreed < _CONTRADICTION.frames:
            self._unknown = True
            message = (
                f"frame {index}: the right images have contradicted the left ones almost from the "
                "start, so lengths are unknown; the right camera may be turned (vio inspect)"
            )
            self._found.append(Finding(_UNKNOWN_CODE, message, index, 0, lasts=True))

    def _end(self, message: str, index: int) -> None:
        if self._reported:
            self._found.append(Finding(_CODE, message, index, ended=True))
        if self._unknown:
            self._unknown = False
            self._found.append(Finding(_UNKNOWN_CODE, message, index, ended=True))
        self._reset()
